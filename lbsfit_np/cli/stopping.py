"""SIGTERM handled as Ctrl-C is, and both held back while what is half done would be left."""

import signal
from contextlib import contextmanager

__all__ = ["Terminated", "exit_code", "held", "terminable"]


class Terminated(KeyboardInterrupt):
    """SIGTERM, handled as Ctrl-C is."""


def exit_code(stopped):
    """Of a program that a KeyboardInterrupt ended: 143 for SIGTERM, 130 for Ctrl-C."""
    return 143 if isinstance(stopped, Terminated) else 130


@contextmanager
def terminable():
    """Within it, SIGTERM raises Terminated."""

    def terminate(signum, frame):
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, terminate)
    except ValueError:  # not the main thread: signals are somebody else's
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def held():
    """Within it Ctrl-C and SIGTERM wait, in a worker process as well; what they do is done at its end."""
    came, before = [], {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                signal.signal(number, lambda *given: came.append(given))
                before[number] = handler
    except ValueError:
        pass  # not the main thread: no signal arrives here
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in came[:1]:
            before[number](number, frame)
