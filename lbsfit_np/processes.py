"""Worker processes that each do one task at a time: the death of one costs its own task only, and Ctrl-C ends them tidily."""

import os
import pickle
import signal
import sys
import warnings
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from .errors import InputError, in_words
from .interrupts import held
from .threads import one_thread

__all__ = ["Note", "Unsent", "Workers", "kept_processes", "tell"]

_READY = "ready"
# In place of work for a process that is to end.
_NOTHING = pickle.dumps(None, protocol=pickle.HIGHEST_PROTOCOL)
# Processes without work, while they are kept.
_SPARE = None
# In a process that does another's work: the connection to that one.
_GIVER = None


@dataclass(frozen=True)
class Unsent:
    """In place of an answer: something that pickle could not take from one process to another, and why.

    ``task``: whether it was the task, with which nothing was done then, or the answer.
    """

    task: bool
    why: str


@dataclass(frozen=True)
class Note:
    """Something that a task tells while it is being done."""

    what: object


def tell(what):
    """From within a task of a process: tell the other side something picklable, which comes as a :class:`Note`."""
    _GIVER.send_bytes(pickle.dumps(Note(what), protocol=pickle.HIGHEST_PROTOCOL))


@contextmanager
def kept_processes():
    """In here, processes that have done their work wait for other work: new ones take time to start. ``with``, or a decorator."""
    global _SPARE
    if _SPARE is not None:  # those around this keep them longer
        yield
        return
    _SPARE = []
    try:
        yield
    finally:
        with held():
            spare, _SPARE = _SPARE, None
            for worker in spare:
                worker.end()


def _spare():
    """A process that waits for work, or None."""
    while _SPARE:
        worker = _SPARE.pop()
        if worker.process.is_alive():
            return worker
        worker.end()
    return None


def _to_start():
    """What lets worker processes start, which read the script first."""
    main = sys.modules.get("__main__")
    script, module = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    if script is not None and module is None and not os.path.exists(script):  # such as <stdin>
        return f"They cannot read the script {script}: save it to a file and run that, or pass n_jobs=1."
    return 'In a script, call this under `if __name__ == "__main__":`.'


class Workers:
    """A context manager that keeps up to ``n`` processes, each of which has its own copy of ``work``.

    Parameters
    ----------
    work : callable (task) → answer
        Sent to each process once; must be picklable, and must not raise.
    n : int

    Raises
    ------
    InputError
        ``work`` cannot be pickled, or processes end before they begin.
    """

    def __init__(self, work, n):
        try:
            self._payload = pickle.dumps(work, protocol=pickle.HIGHEST_PROTOCOL)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            remedy = "Use functions from the top level of a module, or n_jobs=1."
            got = f"more than 1 with work that cannot be sent to processes ({error})"
            raise InputError("n_jobs", got, "picklable work", remedy) from None
        self._n, self._begun, self._unbegun = n, False, None
        self._workers, self._come = [], []

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.stop()

    @property
    def busy(self):
        """Whether a task is being done."""
        return any(w.task is not None for w in self._workers)

    @property
    def idle(self):
        """Whether another task can be given."""
        return len(self._workers) < self._n or any(w.task is None for w in self._workers)

    def give(self, task):
        """Have a process do ``task``, a new one while there are fewer than n."""
        for w in [w for w in self._workers if w.task is None and not w.process.is_alive()]:
            self._leave(w)  # it has died without work, which costs none
        worker = next((w for w in self._workers if w.task is None), None)
        if worker is None:
            worker = self._another()
            worker.take_up(self._payload)
        worker.give(task)

    def _another(self):
        """One more process, without work."""
        with held():  # until it is known here, nothing would end it
            worker = _spare()
            self._begun |= worker is not None  # as it has begun for others
            worker = worker or _Worker()
            worker.ready = False
            self._workers.append(worker)
        return worker

    def answers(self):
        """Wait for some; a list of (task, answer, Unsent or Note, None), or (task, None, how its process died)."""
        from multiprocessing.connection import wait

        ready = set(wait([w.connection for w in self._workers if w.task is not None]))
        for w in list(self._workers):
            if w.connection in ready:
                self._come += self._received(w)  # where they stay if Ctrl-C comes between
        if self._unbegun is not None and not self._begun:
            self._come = [word for word in self._come if word[2] is None]
            raise InputError(
                "n_jobs",
                f"worker processes that ended before they started work ({self._unbegun})",
                "processes that start",
                _to_start(),
            )
        come, self._come = self._come, []
        return come

    def stop(self):
        """End the work, in the middle of a task if need be, while another Ctrl-C waits.

        Returns what had come by then and was not returned, as :meth:`answers`.
        """
        with held():
            self._stop()
        late, self._come = self._come, []
        return late

    def stop_after(self, come, take_in):
        """:meth:`stop` as an error ends all, and take in the words in ``come`` and those that stop gives.

        ``take_in`` is a callable (word); what goes wrong there is warned of, as it is not what has ended all.
        """
        with held():
            for word in [*come, *self.stop()]:
                try:
                    take_in(word)
                except Exception as error:  # noqa: BLE001 (whatever it is, the others are taken in)
                    with suppress(Exception):  # where warnings are errors
                        warnings.warn(f"some finished work could not be kept: {in_words(error)}", stacklevel=2)

    def _stop(self):
        workers, self._workers = self._workers, []
        if _SPARE is not None:
            # One that has not said yet that it is ready would say so to the next.
            idle = [w for w in workers if w.task is None and w.ready]
            for w in idle:
                w.give(None)
            _SPARE.extend(idle)
            workers = [w for w in workers if w not in idle]
        for w in workers:
            self._come += w.last_words()  # one that is amid a long word says it to the end while that is read
            w.ask_to_end()
        for w in workers:
            w.join()
            self._come += w.last_words()
            w.connection.close()

    def _leave(self, worker):
        """Have no more to do with a process that has died."""
        self._workers.remove(worker)
        worker.join()
        worker.connection.close()

    def _received(self, worker):
        task = worker.task
        try:
            answer = worker.receive()
        except (EOFError, OSError):
            self._leave(worker)
            self._unbegun = self._unbegun if worker.ready else worker.death
            return [(task, None, worker.death)]
        if not worker.ready:
            worker.ready = self._begun = True
            return []
        if not isinstance(answer, Note):
            worker.task = None
        return [(task, answer, None)]


class _Worker:
    """One process and the connection to it."""

    def __init__(self):
        import multiprocessing

        if getattr(multiprocessing.current_process(), "_inheriting", False):
            # A script without the guard, which every process runs again: the first one says what is wrong, once.
            raise SystemExit(1)
        context = multiprocessing.get_context("spawn")  # a fork of a process with BLAS threads may hang
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _without_interrupts():
            self.process.start()
        theirs.close()
        self.ready = False
        self.task = None
        self._torn = self._half_sent = False

    def take_up(self, payload):
        """Other work, of which it says when it is ready for tasks."""
        self._send(payload)

    def give(self, task):
        data = pickle.dumps(task, protocol=pickle.HIGHEST_PROTOCOL)
        self.task = task
        self._send(data)

    def _send(self, data):
        self._half_sent = True  # until all of it is there, which waits for a process that is just starting
        try:
            self.connection.send_bytes(data)
            self._half_sent = False
        except OSError:
            pass  # it has died: what is received next says so

    def receive(self):
        self._torn = True  # until all of the message is here: after a Ctrl-C in between, the rest of it means nothing
        data = self.connection.recv_bytes()
        self._torn = False
        try:
            return pickle.loads(data)
        except Exception as error:  # noqa: BLE001 (whatever a class does when it is read)
            return Unsent(False, in_words(error))

    def ask_to_end(self):
        if self.task is None and not self._half_sent:
            self.give(None)
            self._send(_NOTHING)
        else:
            self.process.terminate()

    def end(self):
        """End it where it waits for other work."""
        self._send(_NOTHING)
        self.join()
        self.connection.close()

    def join(self):
        self.process.join(10)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def last_words(self):
        """What has come and was not received, as ``Workers.answers``."""
        words = []
        try:
            while self.task is not None and not self._torn and self.connection.poll():
                word = self.receive()
                words += [(self.task, word, None)] if self.ready else []
                self.ready = True
        except (EOFError, OSError, MemoryError):
            pass
        return words

    @property
    def death(self):
        code = self.process.exitcode
        if code is not None and code < 0:
            try:
                name = signal.Signals(-code).name
            except ValueError:
                name = f"signal {-code}"
            return f"killed by {name}" + (", possibly because memory ran out" if name == "SIGKILL" else "")
        return f"exit code {code}"


@contextmanager
def _without_interrupts():
    """Ctrl-C goes to the parent alone: a process that starts in here never sees it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection):
    """A worker's life: work comes, then its tasks until there are no more, then other work; until it is told to end."""
    global _GIVER
    _GIVER = connection
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end)
    try:
        with one_thread():  # the processes share the cores
            while (work := pickle.loads(connection.recv_bytes())) is not None:
                connection.send(_READY)
                while (data := connection.recv_bytes()) != _NOTHING:
                    connection.send_bytes(_done(work, data))
                del work, data
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the parent is gone


def _done(work, data):
    """The pickled answer to a pickled task."""
    try:
        task = pickle.loads(data)
    except Exception as error:  # noqa: BLE001 (such as of a function that only the other process has)
        return pickle.dumps(Unsent(True, in_words(error)))
    answer = work(task)
    try:
        return pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # noqa: BLE001 (whatever a class does when it is written)
        return pickle.dumps(Unsent(False, in_words(error)))


def _end(signum, frame):
    raise SystemExit(128 + signum)  # unwinds, so that half-written files are removed
