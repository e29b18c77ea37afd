"""The text of a rig card to edit: a rig's present settings in TOML, and comments that say what could be changed."""

import re
from itertools import chain, pairwise

import numpy as np

from .chains import loose_joints
from .clips import under_other_parents
from .data import RigData
from .frames import bone_frames, child_directions
from .limits import all_derived, derived_limits
from .units import unit_name

__all__ = ["card_text", "guessed_chains"]


def card_text(rig):
    """The card of a Rig or a RigData.

    Where joints are not one tree, of several roots or going round in circles, [hierarchy] holds a guess from names and
    positions, for the user to check.

    Returns
    -------
    str
        TOML. Lines that say nothing yet are comments.
    """
    names = list(rig.joint_names)
    parents = np.asarray(rig.parents)
    lines = [f"# Rig card of {_one_line(rig.name)}: {len(names)} joints, {len(rig.vertices)} vertices.", ""]
    lines += _rig_table(rig)
    loose = loose_joints(parents)
    root, guess = names[loose[0]], None
    if len(loose) > 1:
        root, guess = guessed_chains([names[j] for j in loose], np.asarray(rig.joints)[loose])
    lines += _hierarchy_table(rig, names, parents, loose, root, guess)
    merged = _mask(rig, "merged")
    locked = _mask(rig, "locked")
    lines += [
        "[merge]",
        "# Joints that a scan cannot show (tips, toes, a face's bones): their skin moves with the next joint above.",
        f"into_parent = {_list(n for n, on in zip(names, merged) if on)}",
        "",
        "[lock]",
        "# Joints that keep their skin but never turn. Limits below have no effect on them until you remove them from this list.",
        "# Joints that turn the whole mesh like the root, or that the file of a saved rig locks, stay locked even then, unless",
        "# limits give their full names (no glob).",
        f"joints = {_list(n for n, on in zip(names, locked) if on)}",
        "",
        *_frames_table(rig, names, parents),
    ]
    lines += _limits_table(rig, names, parents, root, guess, merged | locked)
    lines += _parts_tables(rig, root)
    return "\n".join(lines) + "\n"


def guessed_chains(names, joints):
    """A root and chains for joints whose file has no hierarchy: groups of names that begin alike, from near to far.

    The root is the joint named wrist, hips, pelvis or root, else the one nearest to the middle of all joints.

    Returns
    -------
    root : str
    chains : list of list of str
        Each from the root outwards.
    """
    joints = np.asarray(joints, dtype=float)
    likely = [
        n
        for word in ("wrist", "hips", "pelvis", "hip", "root")
        for n in names
        if re.search(rf"(^|[^a-z]){word}($|[^a-z])", n.lower())
    ]
    middle = int(np.argmin(np.linalg.norm(joints - joints.mean(axis=0), axis=1)))
    root = likely[0] if likely else names[middle]
    far = np.linalg.norm(joints - joints[names.index(root)], axis=1)
    groups = {}
    for j in np.argsort(far, kind="stable"):
        if names[j] != root:
            first_word = re.split(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])", names[j])
            groups.setdefault(next((w.lower() for w in first_word if w), names[j]), [root]).append(names[j])
    return root, list(groups.values())


def _rig_table(rig):
    unit = rig.metres_per_unit
    name = unit_name(unit)
    named = f'"{name}"' if name else repr(unit and float(unit))  # NumPy's numbers have their type in repr
    granularity = getattr(rig, "granularity", None) or getattr(rig, "parts", None)
    use = granularity if isinstance(granularity, str) else None
    return [
        "[rig]",
        f"unit = {named}"
        if unit is not None
        else '# unit = "m"           # unknown. m, cm, mm, in, ft, or the number of metres in one unit',
        f'up = "{rig.up}"' if rig.up else '# up = "+y"            # unknown',
        f'forward = "{rig.forward}"' if rig.forward else '# forward = "+z"       # unknown: where the rig looks',
        f"use_parts = {_quote(use)}"
        if use and use != "joints"
        else '# use_parts = "NAME"   # one of the partitions below; else one part per moving joint',
        "",
    ]


def _hierarchy_table(rig, names, parents, loose, root, guess):
    lines = [
        "[hierarchy]",
        '# chains: each joint is a child of the one before it. parents = { "child" = "parent" } does the same for single joints,',
        "# which then have no other parent in a chain.",
    ]
    if guess is None and isinstance(rig, RigData):
        return [*lines, "# The hierarchy comes from the file; lines here override it.", f"root = {_quote(root)}", ""]
    if guess is None:  # of a built rig nobody knows whether the file or a card said it: say it all
        chains = [[names[j] for j in row] for row in _chains(parents, names.index(root))]
    else:
        chains, what = guess, "" if (parents[loose] < 0).all() else ", or going round in circles"
        what = f"# The file has {len(loose)} joints without a parent{what}."
        lines.append(f"{what} What follows is a GUESS from names and positions: check it.")
    return [*lines, f"root = {_quote(root)}", "chains = [", *(f"    {_list(names)}," for names in chains), "]", ""]


def _chains(parents, root):
    """The tree as chains of rows, each starting at a joint that an earlier chain has placed (or at the root)."""
    chains, open_ends = [], [root]
    while open_ends:
        at = open_ends.pop(0)
        for child in np.flatnonzero(parents == at):
            chain = [at, child]
            while len(below := np.flatnonzero(parents == chain[-1])) == 1:
                chain.append(below[0])
            chains.append(chain)
            open_ends.append(chain[-1])
    return chains


def _frames_table(rig, names, parents):
    """Of a built rig, axes as a card gives them: nobody knows whether one or the file has. Those by tails are not told."""
    told = "axes of the angles: y along the bone, x across (bending), z forward; \"rig\": the rig's own axes"
    kinds = {}
    if not isinstance(rig, RigData):
        ways = {"rig": np.broadcast_to(np.eye(3), rig.frames.shape)}
        if rig.up and rig.forward:
            ways["bone"] = bone_frames(child_directions(np.asarray(rig.joints), parents), rig.up, rig.forward)
        for kind, frames in ways.items():
            kinds |= {names[j]: kind for j in np.flatnonzero(np.abs(rig.frames - frames).max(axis=(1, 2)) < 1e-9)}
    if not kinds:
        return ["# [frames]", f'# "*" = "bone"     # {told}', ""]
    lines = [f"{_quote(name)} = {_quote(kinds[name])}" for name in names if name in kinds]
    if len(kinds) == len(names) and len(set(kinds.values())) == 1:
        lines = [f'"*" = {_quote(kinds[names[0]])}']
    return ["[frames]", f"# {told[0].upper()}{told[1:]}", *lines, ""]


def _limits_table(rig, names, parents, root, guess, still):
    lower, upper, derived = rig.lower, rig.upper, rig.lower is None or all_derived(rig.notes)
    lines = [
        "[limits]",
        "# How far each joint turns about the x, y, z of its rest frame: [lower], [upper]. Globs, such as *-finger-*, stand for",
        "# several joints; later lines override earlier ones. The root's are used for sampling only: a fit leaves it free.",
    ]
    if lower is None:
        animated = rig.animated
        if guess is not None and animated is not None:
            guessed = np.array(parents)
            for one, other in chain.from_iterable(map(pairwise, guess)):
                guessed[names.index(other)] = names.index(one)
            animated = under_other_parents(np.asarray(animated, dtype=float), np.asarray(rig.frames), parents, guessed)
        lower, upper = derived_limits(names.index(root), len(names), animated)[:2]
    if derived:  # as lines of the card they would pass for what somebody has thought about
        lower, upper = np.round(lower, 3), np.round(upper, 3)
        lines += [
            "# The file has none. These, derived from its animations or defaults, are used until you give others: to do so,",
            "# correct a line and remove its #.",
        ]
    lines.append('unit = "rad"      # of all lines of this table, also of those whose # you remove; or "deg"')
    for j, name in enumerate(names):
        if not still[j]:
            text = f"{_quote(_pattern(name))} = [{_numbers(lower[j])}, {_numbers(upper[j])}]"
            lines.append("# " + text if derived else text)
    return [*lines, ""]


def _parts_tables(rig, root):
    lines = [
        "# [parts.NAME]     # a partition: part = joints. Joints that are not named belong to the part above them.",
        f"# body = [{_quote(root)}]",
        "",
    ]
    for name, parts in rig.partitions.items():
        lines.append(f"[parts.{_quote(name)}]")
        lines += [f"{_quote(part)} = {_list(members)}" for part, members in parts.items()]
        lines.append("")
    return lines


def _mask(rig, field):
    value = getattr(rig, field)
    return np.zeros(len(rig.parents), dtype=bool) if value is None else np.asarray(value)


def _quote(text):
    """A TOML basic string."""
    out = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in out) + '"'


def _pattern(name):
    return "uni[t]" if name == "unit" else name  # the plain word is the table's own key


def _list(texts):
    return "[" + ", ".join(map(_quote, texts)) + "]"


def _numbers(row):
    return "[" + ", ".join(repr(float(a)) for a in row) + "]"


def _one_line(text):
    return "".join(c if c.isprintable() else " " for c in text)
