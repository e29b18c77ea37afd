"""Rows of the study beside each other, a process each.

Within a row all processes but one wait while that trains a segmenter, or fits the last scan.
"""

import warnings
from contextlib import suppress
from dataclasses import dataclass

from ...errors import InputError, in_words
from ...learning.checkpoint import state_of_the_code
from ...processes import tell
from ...workers import as_they_may
from .making import cell_name, first_fits_name, has_steps, made
from .rows import FIRST_FITS, PRETRAINING, ROWS

__all__ = ["Batch", "batches", "is_faster", "made_at_once"]


@dataclass(frozen=True)
class Batch:
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

    @property
    def weight(self):
        """How long it takes, as the weights of rows."""
        return sum(ROWS[row].weight for row in self.rows)


def batches(todo, *, in_common):
    """What can be made beside each other; what takes long comes first, and what waits for something after what brings it.

    Parameters
    ----------
    todo : dict of (str, int) to sequence of str
        The rows to be made of a rig, by its name, and a seed.
    in_common : callable (name, seed) → bool
        Whether first fits are kept, so that rows have them in common.

    Returns
    -------
    list of Batch
    """
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
        if any(ROWS[row].in_common for row in rows) and in_common(name, seed):
            needs.add(("first fits", name, seed))
        out.append(Batch(name, seed, tuple(rows), frozenset(needs & brought), frozenset(needs - brought)))
        brought |= needs
    return out


def is_faster(batches, jobs):
    """Whether so many processes are at work most of the time where each makes a batch: none takes too long, or waits too long."""
    brought = frozenset().union(*(b.brings for b in batches))
    pretrained = sum(kind == "pretrained" for kind, *_ in brought)

    def end(b):
        """When it ends, if it begins as soon as it may."""
        waits = {kind for kind, *_ in b.waits}
        return b.weight + PRETRAINING * any(ROWS[row].pretrained for row in b.rows) + FIRST_FITS * ("first fits" in waits)

    return jobs * max(map(end, batches), default=0.0) <= sum(b.weight for b in batches) + PRETRAINING * pretrained


def made_at_once(batches, rigs, sizes, *, jobs, steps, progress, on_row):
    """Make all rows of batches, as many batches at once as there are processes.

    Parameters
    ----------
    batches : list of Batch
        Of :func:`batches`.
    rigs, sizes : dict of str to Rig, Size
    jobs : int
    steps, progress : callable
        As for ``making.made``.
    on_row : callable (name, seed, row, entry, arrays)
        Called with each row as soon as it is there.

    Raises
    ------
    Exception
        That of the first row that failed, InputError where its process was killed or has read other code than this one. After a
        warning no more batches were begun; those of other processes were made to their end.
    """
    left, there, folders, begun, wrong = list(batches), set(), {}, {}, []
    for b in batches:
        for cell in (first_fits_name(b.name, b.seed), *(cell_name(b.name, b.seed, row) for row in b.rows)):
            folders[cell] = steps(cell)
    gone_on = {b: _brings_first_fits(b) and has_steps(folders[first_fits_name(b.name, b.seed)]) for b in batches}

    def take():
        for k, batch in enumerate(left if not wrong else ()):
            if batch.waits <= there:
                del left[k]
                for row in batch.rows:
                    folder = folders[cell_name(batch.name, batch.seed, row)] if ROWS[row].in_common else None
                    if folder is not None and not folder.exists():
                        begun[folder] = folders[first_fits_name(batch.name, batch.seed)]
                        with suppress(OSError):  # which the checkpoint has words for
                            folder.mkdir(parents=True)  # so that no other run takes first fits for left
                return batch, (batch, gone_on[batch])
        return None

    def warned(text):
        warnings.warn(text, stacklevel=2)

    def failed(batch, error):
        if not hasattr(error, "__notes__"):
            error.add_note(f"{batch.name}, seed {batch.seed}, {' or '.join(batch.rows)}")
        wrong.append(error)
        then = "no further rows are started; rows that other processes have begun are finished first"
        warned(f"{error.__notes__[-1]} failed: {in_words(error)}; {then}")

    heard = {"share": progress, "row": on_row, "reached": there.add, "warning": warned}
    try:
        as_they_may(
            _Made(rigs, sizes, folders, jobs, state_of_the_code()),
            take,
            jobs=jobs,
            answered=lambda batch, _: there.update(batch.brings),  # also where it has found all of them done
            heard=lambda note: heard[note[0]](*note[1:]),
            failed=failed,
        )
    finally:
        for folder, first_fits in begun.items():  # of a run that was stopped before there was anything to keep
            if not has_steps(first_fits):
                with suppress(OSError):
                    folder.rmdir()
    if wrong:
        raise wrong[0]


def _brings_first_fits(batch):
    return ("first fits", batch.name, batch.seed) in batch.brings


@dataclass(frozen=True)
class _Made:
    """(batch, whether fits that it makes for others go on from a run that was stopped) → None; what it makes it tells."""

    rigs: dict
    sizes: dict
    folders: dict
    at_once: int
    code: str

    def __call__(self, task):
        batch, gone_on = task
        name, seed = batch.name, batch.seed
        if state_of_the_code() != self.code:  # its rows would be said to be of the code that this process has read
            got = "files or libraries that have changed since this run began"
            remedy = "Finished rows are kept; run the same command (without --existing replace) to continue."
            raise InputError("lbsfit_np", got, "the same ones in all processes", remedy)
        row = batch.rows[0]

        def said(*share):
            nonlocal row
            row = share[2]
            tell(("share", *share))

        def reached(event):
            for what in batch.brings:
                if what[0] == event:
                    tell(("reached", what))

        with warnings.catch_warnings():
            # In words, as not all classes can be made again there.
            warnings.showwarning = lambda message, *_, **__: tell(("warning", f"{name}, seed {seed}, {row}: {message}"))
            how = {"jobs": 1, "at_once": self.at_once, "steps": self.folders.get, "gone_on": gone_on}
            of = name, self.rigs[name], self.sizes[name], seed, batch.rows
            for made_row in made(*of, progress=said, reached=reached, **how):
                tell(("row", name, seed, *made_row))
