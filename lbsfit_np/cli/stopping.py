"""SIGTERM handled as Ctrl-C is: what is half done is removed, what is finished stays; and that a run goes on with it."""

import signal
from contextlib import contextmanager

from ..errors import counted
from .progress import say

__all__ = ["Terminated", "exit_code", "say_steps", "terminable"]


class Terminated(KeyboardInterrupt):
    """SIGTERM, handled as Ctrl-C is."""


def say_steps(folder):
    """Say that there are steps of a run that was stopped, where there are any."""
    from ..learning.checkpoint import steps_in

    if kept := steps_in(folder):
        found = f"found {counted(kept, 'saved step')} of an interrupted run in {folder}"
        say(f"note: {found}; those that match this run are reused")


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
