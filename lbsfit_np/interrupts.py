"""Ctrl-C and SIGTERM where they come at a bad time: held back, or passed on through code that swallows them."""

import signal
import threading
from contextlib import ExitStack, contextmanager

__all__ = ["held", "passing_interrupts"]


@contextmanager
def held():
    """Within it Ctrl-C waits, and SIGTERM where it has a handler (in commands and workers); what they do is done at its end."""
    came = []
    try:
        with _handlers(lambda handler: lambda *given: came.append((handler, given))):
            yield
    finally:  # whatever else went wrong, it is not forgotten
        for handler, given in came[:1]:
            handler(*given)


@contextmanager
def passing_interrupts():
    """Raise what Ctrl-C or SIGTERM raised in the block, by their handlers, even if the block has caught it.

    scikit-learn's networks catch KeyboardInterrupt, warn, and return as if the training were complete; NumPy makes a TypeError of
    one that comes as it compares rows (``np.unique`` along an axis).
    """
    raised = []

    def noting(handler):
        def handle(signum, frame):
            try:
                handler(signum, frame)
            except BaseException as interrupt:  # SystemExit in worker processes
                raised.append(interrupt)
                raise

        return handle

    try:
        with _handlers(noting):
            yield
    finally:
        if raised:
            raise raised[0]


@contextmanager
def _handlers(changed):
    """Within it each handler of the two signals is what ``changed(handler)`` makes of it."""
    with ExitStack() as after:  # which puts back one handler whatever happens as the other is put back
        if threading.current_thread() is threading.main_thread():  # to others no signal comes
            for number in (signal.SIGINT, signal.SIGTERM):
                handler = signal.getsignal(number)
                if callable(handler):
                    after.callback(_put_back, number, handler)
                    signal.signal(number, changed(handler))
        yield


def _put_back(number, handler):
    try:
        signal.signal(number, handler)
    except BaseException:  # what a signal has raised that came just before: nothing is changed yet
        signal.signal(number, handler)
        raise
