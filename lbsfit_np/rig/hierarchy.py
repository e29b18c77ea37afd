"""Which joint hangs on which, after a card."""

from itertools import pairwise

from ..errors import InputError
from .card import matching

__all__ = ["parents_by_card"]


def parents_by_card(parents, names, card):
    """The file's parents, overridden by globs in the card's parents, then by its chains and names; its root hangs on nothing."""
    parents = parents.copy()
    where = f"{card.where}, [hierarchy]"
    by_name = {}

    def put(j, up):
        if by_name.setdefault(j, up) != up:
            got = f"two parents for joint {names[j]!r}: {names[by_name[j]]!r} and {names[up]!r}"
            raise InputError(where, got, "one parent for each joint", "Change its chain, or its line in parents.")
        parents[j] = up

    for child, parent in card.parents:
        up = _one(parent, names, where)
        for j in matching(child, names, where):
            if child in names:
                put(j, up)
            elif j != up and j not in by_name:  # a glob may well match the parent itself
                parents[j] = up
    for chain in card.chains:
        for up, j in pairwise([_one(name, names, where) for name in chain]):
            put(j, up)
    if card.root is not None:
        root = _one(card.root, names, where)
        if root in by_name:
            got = f"the root {card.root!r} as a child of {names[by_name[root]]!r}"
            raise InputError(where, got, "a root that neither chains nor parents put below another joint")
        parents[root] = -1
    return parents


def _one(name, names, where):
    """Row of one joint: globs are no use where the order matters."""
    rows = matching(name, names, where)
    if len(rows) > 1:
        raise InputError(where, f"{name!r}, which matches {len(rows)} joints", "the name of one joint")
    return rows[0]
