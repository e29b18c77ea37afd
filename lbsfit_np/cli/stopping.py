"""SIGTERM handled as Ctrl-C is: what is half done is removed, what is finished stays."""

import signal
from contextlib import contextmanager

__all__ = ["Terminated", "exit_code", "terminable"]


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
