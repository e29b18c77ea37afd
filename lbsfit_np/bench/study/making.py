"""Rows of the study for one rig and seed, made one after the other, and measured."""

import time
from dataclasses import replace
from functools import cache

import numpy as np

from ...learning.checkpoint import digest_of, state_of_the_code, steps_in
from ..environment import environment
from ..resume import unforeseen
from ..run import TRAINING_SEED
from .data import part_groups, study_set
from .first_segmenter import first_segmenter
from .measures import Truth, measured
from .rows import ROWS, Context, said

__all__ = ["cell_name", "first_fits_name", "has_steps", "made"]


def cell_name(name, seed, row):
    """What the arrays of a row are kept under: "hand-300-joint"."""
    return f"{name}-{seed}-{row}"


def first_fits_name(name, seed):
    """What steps are kept under that several rows have in common: the training scans' fits by themselves."""
    return cell_name(name, seed, "first-fits")


def has_steps(folder):
    """Whether a run that was stopped has left some there; ``folder`` may be None."""
    return folder is not None and steps_in(folder) > 0


def made(name, rig, size, seed, rows, *, jobs, at_once, steps, gone_on, progress, reached=lambda event: None):
    """Make rows, one after the other.

    Parameters
    ----------
    name : str
        The rig's, in the report.
    rig : Rig
    size : Size
    seed : int
        Of the scans.
    rows : sequence of str
        Of ``ROWS``.
    jobs : int
        Processes.
    at_once : int
        Rows that are made beside each other, of which the report tells.
    steps : callable (cell name) → Path or None
        A folder for what a row that takes long has done so far.
    gone_on : bool
        Whether a run that was stopped has left fits that rows have in common: the first of these has no time of its own then.
    progress : callable (name, seed, row, share)
    reached : callable (event), optional
        Called with "pretrained", and with "first fits" once those are there that rows have in common.

    Yields
    ------
    row : str
    entry : dict
        Of the report.
    arrays : dict
        To be kept as :func:`cell_name`.
    """
    at = []

    def told(name, seed, row, share):
        at[:] = [row]
        progress(name, seed, row, share)

    try:
        yield from _made(name, rig, size, seed, rows, jobs, at_once, steps, gone_on, told, reached)
    except Exception as error:
        error.add_note(", ".join([name, f"seed {seed}", *at]))
        raise


def _made(name, rig, size, seed, rows, jobs, at_once, steps, gone_on, progress, reached):
    from ...learning.fitter import LBSFitter

    given = study_set(rig, size, seed)
    groups = part_groups(given.rig)

    def right_of_each(labels):
        """Share of each test scan's points in the right group of parts, None where there are no labels."""
        pairs = zip(labels, given.test, strict=True)
        return [None if found is None else float(np.mean(groups[found] == groups[s.labels])) for found, s in pairs]

    def right(labels):
        """The mean of these; None without scans."""
        shares = [share for share in right_of_each(labels) if share is not None]
        return float(np.mean(shares)) if shares else None

    parameters = {"training_scans": size.training_scans, "rounds": size.rounds, "n_jobs": jobs, "random_state": TRAINING_SEED}
    fitter = LBSFitter(given.rig, orientation="aligned", **parameters)
    if any(ROWS[row].pretrained for row in rows):
        begun = first_segmenter(given.rig, size)
        fitter.pretrain(segmenter=begun, cache=True, progress=lambda p: progress(name, seed, "pretraining", p))
        progress(name, seed, "pretraining", 1.0)  # also where it was in the cache
        reached("pretrained")
    before = cache(lambda: said(fitter.segmenter_, given.test, jobs))
    truth = Truth(given.rig, given.test, size.pairs, seed)
    in_common = {"first_fits": steps(first_fits_name(name, seed)), "first_fitted": lambda: reached("first fits")}
    context = Context(rig, given, size, seed, fitter, before, right, jobs, lambda share: None, **in_common)
    train_truth = None
    for row in rows:
        say = lambda share, row=row: progress(name, seed, row, share)  # noqa: E731
        folder = steps(cell_name(name, seed, row))
        say(0.0)
        whole, started = not has_steps(folder), time.perf_counter()
        found = ROWS[row].find(replace(context, progress=say, steps=folder))
        if ROWS[row].in_common:  # these count in the first row alone
            whole, gone_on = whole and not gone_on, False
        seconds = None if not whole else round(time.perf_counter() - started, 1)  # what went before was not timed
        entry = measured(truth, found.test) | {"seconds": seconds, "jobs": jobs, "at_once": at_once}
        entry |= {key: getattr(found, key) for key in ("accuracy", "gap", "kept_accuracy", "history")}
        entry["kept_accuracy_scans"] = [] if found.labels is None else right_of_each(found.labels)
        if found.fitted_labels is not None:
            entry["fitted_labels"] = right(found.fitted_labels)
        if found.train is not None:
            train_truth = train_truth or Truth(given.rig, given.train, size.pairs, seed)
            entry["on_training"] = measured(train_truth, found.train)
        lost = np.flatnonzero(~found.test.fitted)
        entry["failures"] = {str(i): found.failures.get(int(i), "its fit is not finite") for i in lost}
        entry |= unforeseen(entry["failures"], found.before)
        arrays = _arrays(found)
        entry |= {"arrays": digest_of(arrays), "code": state_of_the_code(), "environment": environment()}
        say(1.0)
        yield row, entry, arrays


def _arrays(found):
    """What pictures need, small."""
    out = {"vertices": np.array(found.test.vertices, np.float32), "joints": np.array(found.test.joints, np.float32)}
    out |= {name: array.astype(np.float32) for name, array in found.stages.items()}
    if found.labels is not None:
        out["labels"] = np.concatenate(found.labels).astype(np.int16)
    return out
