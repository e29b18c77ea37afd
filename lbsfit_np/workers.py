"""The same work on many tasks, in this process or in others, with the same answers."""

import os
import pickle
import traceback
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from .errors import InputError, LbsfitError, ToldError, Unforeseen, in_words
from .interrupts import passing_interrupts
from .processes import Note, Unsent, Workers
from .threads import one_thread

__all__ = ["ProcessEnded", "as_they_may", "beside", "each", "processors", "startable"]


class ProcessEnded(InputError):
    """A worker process that was killed; ``death`` says by what."""

    def __init__(self, death):
        self.death = death
        super().__init__("n_jobs", f"a worker process that ended ({death})", "processes that stay alive", "Use fewer processes.")

    @property
    def of_its_scan(self):
        """Why the one scan is lost that the process was fitting."""
        return Unforeseen(f"the process that fitted it ended: {self.death}")

    def __reduce__(self):
        return type(self), (self.death,), self._notes()


def processors():
    """How many processors this process may use, which on shared machines are fewer than there are."""
    allotted = getattr(os, "sched_getaffinity", None)
    return len(allotted(0)) if allotted else os.cpu_count() or 1


def startable(jobs):
    """How many of so many processes there can be: one, this one, where it is daemonic, as those of a ``multiprocessing.Pool``."""
    import multiprocessing

    return 1 if multiprocessing.current_process().daemon else jobs  # such a process may not start others


def each(work, tasks, *, jobs=1, done=None, answered=None, failed=None):
    """[work(task) for task in tasks].

    Parameters
    ----------
    work : callable (task) → answer
        Picklable where ``jobs`` is more than 1; its errors pass on.
    tasks : sequence
    jobs : int, default 1
        As far as they are :func:`startable`.
    done : callable (share), optional
        Called after each task with the share done.
    answered : callable (k, answer), optional
        Called with each answer as it comes, before ``done``.
    failed : callable (error) → answer, optional
        What stands in place of the answer of a task that failed, with ProcessEnded where its process was killed; by default the
        first error ends all.

    Returns
    -------
    list

    Raises
    ------
    ProcessEnded
        A process was killed.
    """
    tasks, jobs = list(tasks), startable(jobs)
    done, answered = done or (lambda share: None), answered or (lambda k, answer: None)
    answers = {}
    if min(jobs, len(tasks)) <= 1:
        with one_thread():  # as in the processes: results must not depend on where they were made
            for k, task in enumerate(tasks):
                try:
                    with passing_interrupts():  # also where the work takes them for a failure of the task
                        answers[k] = work(task)
                except Exception as error:
                    if failed is None:
                        raise
                    answers[k] = failed(error)
                answered(k, answers[k])
                done((k + 1) / len(tasks))
        return [answers[k] for k in range(len(tasks))]
    todo = list(enumerate(tasks))[::-1]

    def come(k, answer):
        answers[k] = answer
        answered(k, answer)
        done(len(answers) / len(tasks))

    how = {"answered": come, "failed": None if failed is None else lambda k, error: come(k, failed(error))}
    as_they_may(work, lambda: todo.pop() if todo else None, jobs=min(jobs, len(tasks)), **how)
    return [answers[k] for k in range(len(tasks))]


def as_they_may(work, take, *, jobs, answered, heard=None, failed=None):
    """Have tasks done by other processes, of which some may have to wait for others.

    Parameters
    ----------
    work : callable (task) → answer
        Picklable.
    take : callable () → (k, task) or None
        The next task, and what its answer is known by; None where none may begin yet, or all have. It is asked again after each
        answer and note; all is over where nothing is being done, either.
    jobs : int
        Processes.
    answered, heard : callable (k, answer), (note), the latter optional
        Called with each answer, and with what tasks :func:`tell`, as they come. Where all ends with an error, such as Ctrl-C's or
        one of these calls, that comes after calls for all others that have come.
    failed : callable (k, error), optional
        Called with errors of tasks, ProcessEnded where a process was killed; by default the first ends all.
    """

    come = deque()

    def take_in(word, ending=False):
        (k, _), answer, death = word
        if isinstance(answer, Note):
            if heard is not None:
                heard(answer.what)
            return
        answer, error = _outcome(answer, death)
        if error is None:
            answered(k, answer)
        elif failed is None and not ending:
            raise error
        elif not ending:
            failed(k, error)

    with Workers(_Caught(work), jobs) as workers:
        try:
            while True:
                while workers.idle and (given := take()) is not None:
                    workers.give(given)
                if not workers.busy:
                    return
                come.extend(workers.answers())
                while come:
                    take_in(come.popleft())
        except BaseException:
            workers.stop_after(come, partial(take_in, ending=True))
            raise


@contextmanager
def beside(work):
    """Have ``work()`` done in a process of its own while other work goes on here.

    ``with beside(work) as answer:`` and in there ``answer()``, which waits for it. Work is picklable; its errors pass on.
    ProcessEnded where the process was killed.
    """
    with Workers(_Caught(_Alone(work)), 1) as workers:
        workers.give((0, None))
        found = []

        def answer():
            while not found:  # first comes word that the process is ready
                found.extend(_outcome(word, death) for _, word, death in workers.answers() if not isinstance(word, Note))
            if found[0][1] is not None:
                raise found[0][1]
            return found[0][0]

        yield answer


def _outcome(answer, death):
    """(answer of ``_Caught`` work, None), or (None, what went wrong)."""
    if death is not None:
        return None, ProcessEnded(death)
    if isinstance(answer, Unsent):
        got = f"more than 1 where {'a task' if answer.task else 'an answer'} cannot be sent between processes ({answer.why})"
        return None, InputError("n_jobs", got, "picklable work", "Use functions from the top level of a module, or n_jobs=1.")
    answer, error, trace = answer
    if trace is not None:
        error.__cause__ = _Elsewhere(trace)  # whoever mends it must know where it came from
    return answer, error


class _Elsewhere(Exception):
    """Where an error came from in another process, its traceback as text."""

    def __str__(self):
        return f"in another process:\n{self.args[0]}"


@dataclass(frozen=True)
class _Alone:
    """Work without a task, as if it had one."""

    work: object

    def __call__(self, task):
        return self.work()


@dataclass(frozen=True)
class _Caught:
    """(k, task) → (answer, None, None), or (None, the error, and its traceback as text where nobody foresaw it)."""

    work: object

    def __call__(self, task):
        try:
            return self.work(task[1]), None, None
        except Exception as error:  # noqa: BLE001 (raised again where the answer arrives)
            return None, _as_sent(error), None if isinstance(error, LbsfitError) else traceback.format_exc()


def _as_sent(error):
    """An error, or one with its words where it would not arrive as itself."""
    try:
        if type(pickle.loads(pickle.dumps(error))) is type(error):
            return error
    except Exception:  # noqa: BLE001 (whatever its class does there)
        pass
    sent = ToldError(in_words(error))
    for note in getattr(error, "__notes__", ()):
        sent.add_note(note)
    return sent
