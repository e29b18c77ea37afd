"""Signals that come at a bad time: held back until it is over, and whatever else happens the handlers are those of before."""

import signal
import threading

import pytest

from lbsfit_np.cli.stopping import Terminated, terminable
from lbsfit_np.interrupts import held, passing_interrupts

BOTH = signal.SIGINT, signal.SIGTERM


@pytest.mark.parametrize("number, raised", [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_signals_wait_while_they_are_held(number, raised):
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(raised), terminable():
        with held():
            for _ in range(2):
                signal.raise_signal(number)
            done = True
        pytest.fail("it was not raised at the end")
    assert done and [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before
    with pytest.raises(raised), terminable(), held():
        signal.raise_signal(number)
        raise OSError("a full disk, say: the signal is not forgotten for it")
    with held():
        pass


def test_elsewhere_than_in_the_main_thread_nothing_is_held():
    found = []

    def work():
        with held():
            found.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [True]


@pytest.mark.parametrize("number", BOTH)
@pytest.mark.parametrize("block", [held, passing_interrupts])
@pytest.mark.parametrize("at", range(4))
def test_a_signal_among_the_changes_of_handlers_leaves_none_changed(at, block, number, monkeypatch):
    """Between any two of: one handler set, the other set, one put back, the other put back."""
    change, calls = signal.signal, []

    def signalled(*given):
        calls.append(given)
        if len(calls) == at + 1:
            signal.raise_signal(number)
        return change(*given)

    with terminable():
        before = [signal.getsignal(n) for n in BOTH]
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(signal, "signal", signalled)
            with block():
                pass
        assert len(calls) > at and [signal.getsignal(n) for n in BOTH] == before


@pytest.mark.parametrize("number", BOTH)
def test_what_a_signal_ends_a_process_by_is_passed_on_too(number):
    """In worker processes it is SystemExit, of which libraries make errors as well."""

    def end(signum, frame):
        raise SystemExit(128 + signum)

    before = signal.signal(number, end)
    try:
        with pytest.raises(SystemExit) as ended, passing_interrupts():
            try:
                signal.raise_signal(number)
            except SystemExit:
                raise TypeError("of a library") from None
    finally:
        signal.signal(number, before)
    assert ended.value.code == 128 + number
