"""Rows of the study beside each other, a process each.

Within a row all processes but one wait while that trains a segmenter, or fits the last scan.
"""

import warnings
from dataclasses import dataclass

from ...workers import as_they_may, tell
from .making import cell_name, first_fits_name, has_steps, made
from .rows import ROWS

__all__ = ["Chain", "chains", "made_at_once"]


@dataclass(frozen=True)
class Chain:
    """Rows of a rig and seed that one process makes, one after the other.

    Attributes
    ----------
    name : str
        The rig's.
    seed : int
    rows : tuple of str
    waits, brings : frozenset
        What must be there before it begins, and what others wait for that it makes: ("pretrained", name), ("first fits", name,
        seed).
    """

    name: str
    seed: int
    rows: tuple
    waits: frozenset
    brings: frozenset


def chains(todo):
    """What can be made beside each other of ``todo``, (rig's name, seed) → rows; what takes long comes first."""
    groups = []
    for (name, seed), rows in todo.items():
        of_row = {}
        for row in rows:
            if (before := ROWS[row].goes_on_from) in of_row:
                of_row[before].append(row)
                of_row[row] = of_row[before]
            else:
                of_row[row] = [row]
                groups.append((name, seed, of_row[row]))
    groups.sort(key=lambda group: -sum(ROWS[row].weight for row in group[2]))
    out, brought = [], set()
    for name, seed, rows in groups:
        needs = {("pretrained", name)} if any(ROWS[row].pretrained for row in rows) else set()
        needs |= {("first fits", name, seed)} if any(ROWS[row].in_common for row in rows) else set()
        out.append(Chain(name, seed, tuple(rows), frozenset(needs & brought), frozenset(needs - brought)))
        brought |= needs
    return out


def made_at_once(chains, rigs, sizes, *, jobs, steps, progress, on_row):
    """Make all rows of chains, as many chains at once as there are processes.

    Parameters
    ----------
    chains : list of Chain
        Of :func:`chains`.
    rigs, sizes : dict of str to Rig, Size
    jobs : int
    steps, progress : callable
        As for ``making.made``.
    on_row : callable (name, seed, row, entry, arrays)
        Called with each row as soon as it is there.
    """
    left, there, folders = list(chains), set(), {}
    for c in chains:
        for cell in (first_fits_name(c.name, c.seed), *(cell_name(c.name, c.seed, row) for row in c.rows)):
            folders[cell] = steps(cell)
    gone_on = {cell for cell, folder in folders.items() if has_steps(folder)}

    def take():
        for k, chain in enumerate(left):
            if chain.waits <= there:
                del left[k]
                makes_fits = ("first fits", chain.name, chain.seed) in chain.brings
                return chain, (chain, makes_fits and first_fits_name(chain.name, chain.seed) in gone_on)
        return None

    def warned(message):
        warnings.warn(message, stacklevel=2)

    heard = {"share": progress, "row": on_row, "reached": there.add, "warning": warned}
    as_they_may(
        _Made(rigs, sizes, folders, min(jobs, len(chains))),
        take,
        jobs=jobs,
        answered=lambda chain, _: there.update(chain.brings),  # also where it has found all of them done
        heard=lambda note: heard[note[0]](*note[1:]),
    )


@dataclass(frozen=True)
class _Made:
    """(chain, whether fits that it makes for others go on from a run that was stopped) → None; what it makes it tells."""

    rigs: dict
    sizes: dict
    folders: dict
    at_once: int

    def __call__(self, task):
        chain, gone_on = task
        name, seed = chain.name, chain.seed

        def reached(event):
            for what in chain.brings:
                if what[0] == event:
                    tell(("reached", what))

        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: tell(("warning", message))
            for row, entry, arrays in made(
                *(name, self.rigs[name], self.sizes[name], seed, chain.rows),
                jobs=1,
                at_once=self.at_once,
                steps=self.folders.get,
                gone_on=gone_on,
                progress=lambda *share: tell(("share", *share)),
                reached=reached,
            ):
                tell(("row", name, seed, row, entry, arrays))
