"""Many scans with one fitter, one after the other or by worker processes: the same results in both cases."""

import pickle
import time
import traceback
from collections import deque
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np

from ..errors import InputError, LbsfitError, brief, check_callables, in_words, is_whole
from ..interrupts import passing_interrupts
from ..processes import Unsent, Workers
from ..scan import check_points
from ..workers import ProcessEnded, startable
from .reading import as_scans
from .subjects import as_subjects, known_subjects
from .variants import as_variant

__all__ = ["ScanOutcome", "each_scan", "fit_scans"]


@dataclass(frozen=True)
class ScanOutcome:
    """What became of one scan.

    Attributes
    ----------
    index : int
        Which of the scans this is.
    result : FitResult or other
        The fit, or what ``finish`` made of it; None where there is none. The fit's own ``status`` may be "suspect" or "failed".
    error : str or None
        Why there is no fit, in words, ``errors.Unforeseen`` where it may not be the scan's fault; None where there is one.
    details : str or None
        The traceback of an unforeseen failure.
    seconds : float
        Time taken to read, fit and finish the scan.
    """

    index: int
    result: object = None
    error: str | None = None
    details: str | None = None
    seconds: float = 0.0


def fit_scans(fitter, scans, *, subjects=None, n_jobs=1, finish=None, on_result=None, pretrain=None):
    """Fit many scans; one that fails does not stop the others.

    Parameters
    ----------
    fitter : LBSFitter
        If it has no library of starts yet and has not learned, it is pretrained once, in this process, as soon as a scan that
        can be fitted has been read; a segmenter that it already has is kept.
    scans : iterable
        For each scan the (n, 3) points, a Scan, or a callable without arguments that returns one of these, such as
        ``functools.partial(load_scan, path)``. A callable is called in the process that fits its scan, or in this one if it
        cannot be sent to another. Its errors are failures of its scan alone.
    subjects : sequence of str, int or None, optional
        For a fitter that has learned: the subject of each scan, as for ``LBSFitter.fit_scan``; None where it is not known.
    n_jobs : int, default 1
        Number of worker processes; with 1, and in a process that may not start others, such as one of a ``multiprocessing.Pool``,
        everything happens in this process. Workers are started afresh ("spawn"), so a script must call this function under
        ``if __name__ == "__main__":``. With an int as the fitter's ``random_state``, results are the same to the last bit
        whatever ``n_jobs`` is.
    finish : callable (index, scan, result) → object, optional
        What to do with a fit in the process that made it, such as writing it to files. Its return value replaces the result
        in the outcome. With several jobs it must be picklable.
    on_result : callable (ScanOutcome), optional
        Called in this process for each scan as it is done, in order of completion.
    pretrain : callable (fitter), optional
        Called instead of ``fitter.pretrain(segmenter=...)``.

    Returns
    -------
    list of ScanOutcome
        In the order of ``scans``.

    Raises
    ------
    InputError
        ``fitter`` is no LBSFitter; ``n_jobs``, ``subjects`` or its parameters cannot be used; an argument that must be a function
        is not one; the rig or the variant is not what the fitter learned with.
    KeyboardInterrupt
        On Ctrl-C, once the workers have ended and ``on_result`` has been called for every finished scan.
    """
    check_callables(pretrain=(pretrain, (("fitter",),)))
    if isinstance(fitter, type) or not hasattr(fitter, "_check_alone"):  # the class itself cannot be imported here
        got = brief(fitter) if isinstance(fitter, type) else f"a {type(fitter).__name__}"
        raise InputError("fitter", got, "an LBSFitter", "Make one of a rig with LBSFitter(rig).")
    batch = _Batch(scans, n_jobs, finish, on_result)
    learned, n = getattr(fitter, "template_", None), len(batch.scans)
    subjects = [None] * n if subjects is None else as_subjects(subjects, n)
    fitter._check()  # here, as a parameter that cannot be used would fail every scan in turn
    if learned is not None:
        fitter._check_learned()
    subjects = known_subjects(learned, subjects, n)
    batch.check_sent()
    read = _pretrained(fitter, batch.scans, batch.report, pretrain)
    return batch.fitted(fitter, subjects, read, sent=_without_results)


def each_scan(method, scans, *, n_jobs=1, finish=None, on_result=None):
    """The same for anything that fits a scan, with no training and no subjects.

    Parameters
    ----------
    method : object with fit_scan(scan) → FitResult
        With several jobs it must be picklable.
    scans, n_jobs, finish, on_result
        As in :func:`fit_scans`.

    Returns
    -------
    list of ScanOutcome
        In the order of ``scans``.
    """
    batch = _Batch(scans, n_jobs, finish, on_result)
    batch.check_sent()
    return batch.fitted(method, [None] * len(batch.scans), {})


class _Batch:
    """Scans to be fitted, and what has become of them."""

    def __init__(self, scans, n_jobs, finish, on_result):
        if not is_whole(n_jobs, 1):
            raise InputError("n_jobs", repr(n_jobs), "a positive whole number of worker processes")
        check_callables(finish=(finish, (("index", "scan", "result"),)), on_result=(on_result, (("outcome",),)))
        self.scans, self.n_jobs = as_scans(scans), startable(int(n_jobs))
        self.finish, self.on_result = finish, on_result
        self.outcomes = {}

    def check_sent(self):
        """Raise InputError, before any training, where ``finish`` cannot go to other processes and has to."""
        if self.n_jobs > 1 and len(self.scans) > 1 and self.finish is not None:
            _check_sent("finish", self.finish)

    def report(self, outcome):
        self.outcomes[outcome.index] = outcome
        if self.on_result is not None:
            self.on_result(outcome)

    def fitted(self, method, subjects, read, *, sent=lambda method: method):
        """The outcomes of all; ``read`` are scans, by index, that have been read, ``sent`` makes what goes to other processes."""
        scans, n = self.scans, len(self.scans)
        todo = [i for i in range(n) if i not in self.outcomes]
        if self.n_jobs == 1 or len(todo) < 2:
            for i in todo:
                self.report(_fit_one(method, self.finish, i, read.pop(i, scans[i]), subjects[i]))
        else:
            _fit_by_workers(_Work(sent(method), self.finish), scans, subjects, deque(todo), self.n_jobs, self.report)
        return [self.outcomes[i] for i in range(n)]


def _without_results(fitter):
    """A copy of a fitter without what it has made of a collection, of which fits of other scans need nothing."""
    fitter = copy(fitter)
    vars(fitter).pop("results_", None)
    return fitter


def _check_sent(argument, value):
    """Raise InputError where something cannot go to another process."""
    try:
        pickle.dumps(value)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        remedy = "Define it at the top level of a module, or pass n_jobs=1."
        raise InputError(argument, f"what cannot be sent to a worker process ({error})", "what can be pickled", remedy) from None


def _pretrained(fitter, scans, report, pretrain):
    """Pretrain the fitter where it wants that; returns the scan, by index, that was read to see that this is worth while."""
    if getattr(fitter, "template_", None) is not None or not as_variant(fitter.variant).skinning:
        return {}  # learned, or free-form, which has nothing to train
    if fitter._is_pretrained():
        return {}
    for i, source in enumerate(scans):
        started = time.perf_counter()
        try:
            with passing_interrupts():
                scan = source() if callable(source) else source
                fitter._check_alone(check_points(scan, minimum=len(fitter.rig.parts)))
        except Exception as error:  # noqa: BLE001 (whatever is wrong with one scan is that scan's failure)
            report(_failure(i, error, started))
            continue
        if pretrain is None:
            fitter._pretrain_alone()
        else:
            pretrain(fitter)
        return {i: scan}
    return {}


def _fit_one(fitter, finish, index, source, subject):
    started = time.perf_counter()
    try:
        with passing_interrupts():  # of which libraries make errors of their own, which would be the scan's
            scan = source() if callable(source) else source
            result = fitter.fit_scan(scan) if subject is None else fitter.fit_scan(scan, subject=subject)
            if not np.isfinite(result.vertices).all():
                return ScanOutcome(index, error=result.message, seconds=time.perf_counter() - started)
            if finish is not None:
                result = finish(index, scan, result)
    except Exception as error:  # noqa: BLE001 (the same)
        return _failure(index, error, started)
    return ScanOutcome(index, result, seconds=time.perf_counter() - started)


def _failure(index, error, started):
    seconds = time.perf_counter() - started
    details = {} if isinstance(error, LbsfitError) else {"details": traceback.format_exc()}
    return ScanOutcome(index, error=in_words(error), seconds=seconds, **details)


@dataclass
class _Work:
    """What every worker is given once: a task of its is (index, source, subject)."""

    fitter: object
    finish: object

    def __call__(self, task):
        return _fit_one(self.fitter, self.finish, *task)


def _fit_by_workers(work, scans, subjects, todo, jobs, report):
    come, called = deque(), set()
    with Workers(work, min(jobs, len(todo))) as workers:

        def take_in(word, again=True):
            (index, *_), outcome, death = word
            if death is not None:
                report(ScanOutcome(index, error=ProcessEnded(death).of_its_scan))
            elif not isinstance(outcome, Unsent):
                report(outcome)
            elif again and outcome.task and callable(scans[index]) and index not in called:
                called.add(index)  # what it returns may be no better
                _give_called(workers, index, scans, subjects, report)
            else:
                what = "it cannot be sent to" if outcome.task else "its fit cannot be sent back from"
                report(ScanOutcome(index, error=f"{what} a worker process: {outcome.why}"))

        try:
            while todo or workers.busy:
                while todo and workers.idle:
                    _give(workers, todo.popleft(), scans, subjects, report)
                if workers.busy:
                    come.extend(workers.answers())
                while come:  # what is left where this is stopped in the middle is taken in then
                    take_in(come.popleft())
        except BaseException:
            workers.stop_after(come, partial(take_in, again=False))
            raise


def _give(workers, index, scans, subjects, report):
    source = scans[index]
    try:
        with passing_interrupts():
            workers.give((index, source, subjects[index]))
    except Exception as error:  # noqa: BLE001 (whatever a class does when it is written)
        if callable(source):
            _give_called(workers, index, scans, subjects, report)
        else:
            report(ScanOutcome(index, error=f"it cannot be sent to a worker process: {error}"))


def _give_called(workers, index, scans, subjects, report):
    """Of a callable that cannot be sent, such as a lambda, what it returns."""
    started = time.perf_counter()
    try:
        with passing_interrupts():
            workers.give((index, scans[index](), subjects[index]))
    except Exception as error:  # noqa: BLE001 (the same as in _fit_one)
        report(_failure(index, error, started))
