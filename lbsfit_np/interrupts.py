"""Ctrl-C and SIGTERM where they come at a bad time: held back, or passed on through code that swallows them."""

import signal
from contextlib import contextmanager

__all__ = ["held", "passing_interrupts"]


@contextmanager
def held():
    """Within it Ctrl-C and SIGTERM wait, in a worker process as well; what they do is done at its end."""
    came = []
    try:
        with _handlers(lambda handler: lambda *given: came.append((handler, given))):
            yield
    finally:  # whatever else went wrong, it is not forgotten
        for handler, given in came[:1]:
            handler(*given)


@contextmanager
def passing_interrupts():
    """Raise what Ctrl-C raised in the block (or SIGTERM, where it has such a handler), even if the block has caught it.

    scikit-learn's networks catch KeyboardInterrupt, warn, and return as if the training were complete.
    """
    raised = []

    def noting(handler):
        def handle(signum, frame):
            try:
                handler(signum, frame)
            except KeyboardInterrupt as interrupt:
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
    before = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                signal.signal(number, changed(handler))
                before[number] = handler
    except ValueError:
        pass  # not the main thread: no signal arrives here
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
