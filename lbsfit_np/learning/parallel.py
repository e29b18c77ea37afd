"""The same work on many tasks, in this process or in several: answers in the tasks' order, whatever the number of processes."""

from dataclasses import dataclass

from ..errors import InputError
from ..workers import Workers

__all__ = ["each"]


def each(work, tasks, *, jobs=1, done=None):
    """[work(task) for task in tasks].

    Parameters
    ----------
    work : callable (task) → answer
        Picklable where ``jobs`` is more than 1; its errors pass on.
    tasks : sequence
    jobs : int, default 1
    done : callable (share), optional
        Called after each task with the share done.

    Returns
    -------
    list

    Raises
    ------
    InputError
        A process was killed.
    """
    tasks = list(tasks)
    done = done or (lambda share: None)
    answers = {}
    if min(jobs, len(tasks)) <= 1:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1):  # as in the processes: results must not depend on where they were made
            for k, task in enumerate(tasks):
                answers[k] = work(task)
                done((k + 1) / len(tasks))
        return [answers[k] for k in range(len(tasks))]
    todo = list(enumerate(tasks))[::-1]
    with Workers(_Caught(work), min(jobs, len(tasks)), argument="n_jobs") as workers:
        while len(answers) < len(tasks):
            while todo and workers.idle:
                workers.give(todo.pop())
            for (k, _), answer, death in workers.answers():
                if death is not None:
                    raise InputError("n_jobs", f"a process that ended ({death})", "processes that live", "Use fewer of them.")
                answers[k], error = answer
                if error is not None:
                    raise error
                done(len(answers) / len(tasks))
    return [answers[k] for k in range(len(tasks))]


@dataclass(frozen=True)
class _Caught:
    """(k, task) → (answer, None), or (None, the error)."""

    work: object

    def __call__(self, task):
        try:
            return self.work(task[1]), None
        except Exception as error:  # noqa: BLE001 (raised again where the answer arrives)
            return None, error
