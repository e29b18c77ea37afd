"""Ctrl-C and its like in the middle of training: it ends, and nothing half trained is left."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from segmenter_training import cached, train_small

import lbsfit_np as lbs
from lbsfit_np.segmentation import cache


class Terminated(KeyboardInterrupt):
    """What a program's own handler of SIGTERM may raise."""


def _raise_terminated(signum, frame):
    raise Terminated


def _interrupting(monkeypatch, interrupt, at=3):
    """Have ``interrupt`` called in the middle of scikit-learn's ``partial_fit``, which catches KeyboardInterrupt."""
    from sklearn.neural_network import _multilayer_perceptron as mlp

    batches, calls = mlp.gen_batches, []

    def gen_batches(*args):
        calls.append(1)
        if len(calls) == at:
            interrupt()
        return batches(*args)

    monkeypatch.setattr(mlp, "gen_batches", gen_batches)
    return calls


@pytest.mark.filterwarnings("ignore:Training interrupted")
@pytest.mark.parametrize("number, raised", [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_ctrl_c_in_the_middle_of_training_is_no_segmenter(empty_cache, tube_rig, monkeypatch, number, raised):
    calls = _interrupting(monkeypatch, lambda: signal.raise_signal(number))
    before = signal.getsignal(number)
    mine = signal.default_int_handler if number == signal.SIGINT else _raise_terminated
    signal.signal(number, mine)
    try:
        with pytest.raises(raised):
            cached("key", lambda: train_small(tube_rig))
        assert signal.getsignal(number) is mine
    finally:
        signal.signal(number, before)
    assert len(calls) == 3  # it did not go on
    assert not cache._MEMORY and not (empty_cache.exists() and list(empty_cache.iterdir()))


@pytest.mark.filterwarnings("ignore:Training interrupted")
def test_an_interrupt_that_is_no_signal_passes_too(tube_rig, monkeypatch):
    """As in another thread, where no signal arrives."""

    def interrupt():
        raise KeyboardInterrupt

    calls, raised = _interrupting(monkeypatch, interrupt), []

    def work():
        try:
            train_small(tube_rig)
        except KeyboardInterrupt as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert len(raised) == 1 and len(calls) == 3


@pytest.mark.filterwarnings("ignore:Training interrupted")
@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_training_from_a_start_is_interrupted_too(tube_rig, small_segmenter, monkeypatch, at):
    def interrupt():
        raise KeyboardInterrupt

    calls = _interrupting(monkeypatch, interrupt, at)
    with pytest.raises(KeyboardInterrupt):
        train_small(tube_rig, start=small_segmenter)
    assert len(calls) == at


_SCRIPT = """
import lbsfit_np as lbs
from lbsfit_np.segmentation.segmenter import train_segmenter
from lbsfit_np.learning.training import TrainingScans
from lbsfit_np.synthesis import Synthesis

if __name__ == "__main__":
    rig = lbs.load_rig("hand")
    scans = TrainingScans(rig, Synthesis(), 0)
    train_segmenter(rig.welded, scans, 100_000, random_state=0, n_jobs=2, progress=lambda share: print("going", flush=True))
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.slow
def test_ctrl_c_ends_the_processes_without_their_tracebacks(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(_SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(Path(lbs.__file__).resolve().parents[1])}
    process = subprocess.Popen(
        [sys.executable, str(script)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == "going\n"
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all processes
    _, said = process.communicate(timeout=120)  # its end means that no process holds the pipes any more
    assert said.count("Traceback") == 1 and said.rstrip().endswith("KeyboardInterrupt")
