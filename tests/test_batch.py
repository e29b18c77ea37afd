"""Many scans with one fitter: order, failures, worker processes, Ctrl-C."""

import copy
import functools
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import types
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from fit_checks import assert_same

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.io.write import atomic_path
from lbsfit_np.learning.batch import each_scan, fit_scans
from lbsfit_np.processes import Workers

POSIX = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
PACKAGE_PARENT = str(Path(lbs.__file__).resolve().parents[1])


@pytest.fixture(scope="module")
def clouds(tube_rig):
    return [s.points for s in lbs.synthesize(tube_rig, 3, random_state=5, n_points=400)]


@pytest.fixture(scope="module")
def plain_fitter(tube_rig):
    """A fitter that has nothing to train and fits badly, by few points: for what becomes of fits, right or not."""
    return lbs.LBSFitter(tube_rig, variant="free-form", max_points=100, random_state=0)


@pytest.fixture(scope="module")
def alone(plain_fitter, clouds):
    """What one process finds."""
    return fit_scans(plain_fitter, clouds)


@pytest.mark.parametrize("scans, word", [("a.ply", "a str"), (["a.ply"], "the path 'a.ply'"), (np.zeros((9, 3)), "one array")])
def test_what_is_no_sequence_of_scans_is_named(quick_fitter, scans, word):
    """A text has letters and an array rows, each of which would be a scan that failed."""
    with pytest.raises(InputError, match=f"scans: got {word}"):
        fit_scans(quick_fitter, scans)


@pytest.fixture(scope="module")
def with_labels(quick_fitter):
    """A fitter that fits by way of a segmenter, by few points."""
    return copy.copy(quick_fitter).set_params(max_points=100)


@pytest.fixture(scope="module")
def alone_with_labels(with_labels, clouds):
    """What one process finds by way of a segmenter."""
    return fit_scans(with_labels, clouds[:2])


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_do_not_depend_on_jobs_or_order(with_labels, clouds, alone_with_labels, jobs):
    outcomes = fit_scans(with_labels, clouds[:2][::-1], n_jobs=jobs)
    assert [o.index for o in outcomes] == [0, 1]
    for ours, theirs in zip(outcomes, alone_with_labels[::-1]):
        for name in ("pose", "translation", "scale", "offsets", "vertices", "joints", "labels", "confidence"):
            np.testing.assert_array_equal(getattr(ours.result, name), getattr(theirs.result, name), err_msg=name)
        assert ours.result.terms == theirs.result.terms


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_bad_scan_fails_alone(plain_fitter, clouds, jobs):
    seen = []
    scans = [np.full((9, 3), np.nan), clouds[0], functools.partial(lbs.load_scan, "nowhere.ply"), _broken, clouds[1]]
    outcomes = fit_scans(plain_fitter, scans, n_jobs=jobs, on_result=seen.append)
    assert [o.error is None for o in outcomes] == [False, True, False, False, True]
    assert "NaN" in outcomes[0].error and "nowhere.ply" in outcomes[2].error
    assert outcomes[3].error == "ZeroDivisionError: division by zero" and "_broken" in outcomes[3].details
    assert outcomes[0].details is None and outcomes[0].result is None
    assert sorted(o.index for o in seen) == [0, 1, 2, 3, 4]


def test_finish_takes_the_place_of_the_result(plain_fitter, clouds):
    for jobs in (1, 2):
        outcomes = fit_scans(plain_fitter, clouds[:2], n_jobs=jobs, finish=_described)
        assert [o.result for o in outcomes] == [(0, 400, "ok"), (1, 400, "ok")]


@pytest.mark.usefixtures("own_processes")
@pytest.mark.parametrize("many", [fit_scans, each_scan])
def test_a_process_that_may_not_start_others_fits_by_itself(plain_fitter, clouds, many, monkeypatch):
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # as of a Pool
    outcomes = many(plain_fitter, clouds[:2], n_jobs=2, finish=lambda index, scan, result: (index, result.status))
    assert [o.result for o in outcomes] == [(0, "ok"), (1, "ok")], outcomes


def test_a_result_that_is_not_finite_is_a_failure(plain_fitter, clouds, alone, monkeypatch):
    vertices = np.full_like(alone[0].result.vertices, np.nan)
    bad = replace(alone[0].result, vertices=vertices, status="failed", message="not finite")
    monkeypatch.setattr(type(plain_fitter), "fit_scan", lambda self, scan: bad)
    outcome = fit_scans(plain_fitter, clouds[:1], finish=_described)[0]
    assert (outcome.error, outcome.result) == ("not finite", None)


@pytest.mark.parametrize("status", ["suspect", "failed"])
def test_a_doubtful_fit_is_a_result_all_the_same(plain_fitter, clouds, alone, monkeypatch, status):
    doubtful = replace(alone[0].result, status=status, message="another pose explains the scan nearly as well")
    monkeypatch.setattr(type(plain_fitter), "fit_scan", lambda self, scan: doubtful)
    outcome = fit_scans(plain_fitter, clouds[:1])[0]
    assert outcome.error is None and outcome.result is doubtful


def test_what_is_no_fitter_is_named(tube_rig, clouds):
    with pytest.raises(InputError, match=r"fitter: got a Rig; expected an LBSFitter. Make one of a rig with LBSFitter\(rig\)"):
        fit_scans(tube_rig, clouds[:1])
    with pytest.raises(InputError, match="fitter: got .*LBSFitter.*; expected an LBSFitter"):
        fit_scans(lbs.LBSFitter, clouds[:1])


@pytest.mark.usefixtures("hurried")
def test_what_a_fitter_has_ready_is_used_and_kept(quick_fitter, clouds):
    fitter = copy.copy(quick_fitter)
    fit_scans(fitter, clouds[:1])
    ready = fitter._ready
    fit_scans(fitter, clouds[1:2])
    assert fitter._ready is ready and ready


@dataclass
class _Counting:
    """Anything that fits a scan: its points' mean, and how many there were before, in this process."""

    n: int = 0

    def fit_scan(self, scan):
        if len(scan) < 2:
            raise InputError("points", "one", "two")
        self.n += 1
        return types.SimpleNamespace(vertices=np.mean(scan, axis=0), n=self.n)


@pytest.mark.parametrize("jobs", [1, 2])
def test_anything_that_fits_a_scan_fits_many(jobs, clouds):
    told = []
    outcomes = each_scan(_Counting(), [clouds[0], clouds[1][:1], lambda: clouds[2]], n_jobs=jobs, on_result=told.append)
    assert [o.error for o in outcomes] == [None, "points: got one; expected two.", None] and len(told) == 3
    for k in (0, 2):
        np.testing.assert_array_equal(outcomes[k].result.vertices, clouds[k].mean(axis=0))
    with pytest.raises(InputError, match="n_jobs"):
        each_scan(_Counting(), clouds, n_jobs=0)
    with pytest.raises(InputError, match="finish: got what cannot be sent"):
        each_scan(_Counting(), clouds, n_jobs=2, finish=lambda index, scan, result: result)


@pytest.mark.usefixtures("hurried")
def test_training_waits_for_a_scan_that_can_be_fitted(tube_rig, clouds):
    calls = []
    fitter = lbs.LBSFitter(tube_rig, training_scans=5, effort="fast", random_state=0)
    outcomes = fit_scans(fitter, [np.zeros((9, 3)), np.zeros((2, 3))], pretrain=calls.append)
    assert not calls and "all equal" in outcomes[0].error and "at least 4 points" in outcomes[1].error

    def pretrain(fitter):
        calls.append(fitter)
        fitter.pretrain()

    reads = []
    outcomes = fit_scans(fitter, [np.zeros((9, 3)), lambda: reads.append(1) or clouds[0]], pretrain=pretrain)
    assert calls == [fitter] and outcomes[1].error is None
    assert len(reads) == 1  # what was read before the training is not read again


def test_no_scans_is_no_work(tube_rig):
    assert fit_scans(lbs.LBSFitter(tube_rig), [], n_jobs=2) == []


@pytest.mark.parametrize("jobs", [0, -1, 1.5, True, "2"])
def test_jobs_that_cannot_be(plain_fitter, clouds, jobs):
    with pytest.raises(InputError, match="n_jobs: got .*expected a positive whole number"):
        fit_scans(plain_fitter, clouds, n_jobs=jobs)


@pytest.mark.parametrize("name", ["finish", "on_result", "pretrain"])
def test_what_is_called_late_has_to_be_a_function(plain_fitter, clouds, name, monkeypatch):
    monkeypatch.setattr(type(plain_fitter), "fit_scan", None)  # before any work
    with pytest.raises(InputError, match=f"{name}: got 'x'; expected a function, or None"):
        fit_scans(plain_fitter, clouds, **{name: "x"})


@pytest.mark.parametrize("parameters", [{"weights": "foo"}, {"scale": "big"}, {"max_points": 0}])
@pytest.mark.parametrize("jobs", [1, 2])
def test_parameters_of_the_fitter_that_cannot_be(plain_fitter, clouds, parameters, jobs):
    """One error, not a failure of every scan."""
    fitter = copy.copy(plain_fitter)
    for name, value in parameters.items():
        setattr(fitter, name, value)
    seen = []
    with pytest.raises(InputError, match=next(iter(parameters))):
        fit_scans(fitter, clouds, n_jobs=jobs, on_result=seen.append)
    with pytest.raises(InputError, match="rig: got str"):
        fit_scans(lbs.LBSFitter("x"), clouds, n_jobs=jobs, on_result=seen.append)
    assert not seen


def test_what_cannot_be_sent_to_processes(plain_fitter, clouds):
    untrained = lbs.LBSFitter(plain_fitter.rig, random_state=0)
    with pytest.raises(InputError, match="finish: .*cannot be sent to a worker.*at the top level of a module"):
        fit_scans(untrained, clouds, n_jobs=2, finish=lambda index, scan, result: None, pretrain=pytest.fail)
    sources = [lambda: clouds[0], clouds[1], lambda: 1 / 0, threading.Lock(), lambda: threading.Lock()]
    outcomes = fit_scans(plain_fitter, sources, n_jobs=2)
    assert [o.error is None for o in outcomes] == [True, True, False, False, False]
    _assert_same(outcomes[0].result, fit_scans(plain_fitter, clouds[:1])[0].result)
    assert outcomes[2].error.startswith("ZeroDivisionError")
    assert "cannot be sent" in outcomes[3].error and "lock" in outcomes[4].error


def test_a_function_that_only_this_process_has_is_called_here(plain_fitter, clouds, alone, monkeypatch):
    """Such as of a notebook: pickle takes its name, which other processes do not know."""
    module = types.ModuleType("only_here")
    for k in (0, 1):
        exec(f"def read_{k}():\n    return clouds[{k}]", module.__dict__)
    exec("def broken():\n    return 1 / 0", module.__dict__)
    module.clouds = clouds
    monkeypatch.setitem(sys.modules, "only_here", module)
    outcomes = fit_scans(plain_fitter, [module.read_0, module.broken, module.read_1], n_jobs=2)
    assert [o.error for o in outcomes] == [None, "ZeroDivisionError: division by zero", None]
    for ours, theirs in zip(outcomes[::2], alone, strict=False):
        _assert_same(ours.result, theirs.result)


def test_what_such_a_function_returns_is_called_for_once(plain_fitter, clouds, monkeypatch):
    """Where other processes do not know the class of that either."""
    module, calls = types.ModuleType("only_here"), []
    exec("import numpy\nclass Points(numpy.ndarray):\n    pass", module.__dict__)
    exec("def read():\n    calls.append(0)\n    return cloud.view(Points)", module.__dict__)
    module.calls, module.cloud = calls, clouds[0]
    monkeypatch.setitem(sys.modules, "only_here", module)
    outcomes = fit_scans(plain_fitter, [module.read, clouds[1]], n_jobs=2)
    assert "it cannot be sent to a worker process" in outcomes[0].error and "only_here" in outcomes[0].error
    assert outcomes[1].error is None and len(calls) == 1


def test_a_scan_that_cannot_be_pickled_costs_itself_only(plain_fitter, clouds):
    outcomes = fit_scans(plain_fitter, [_Unpicklable(), clouds[1]], n_jobs=2)
    assert "it cannot be sent to a worker process: not today" in outcomes[0].error and outcomes[1].error is None


def test_what_finish_makes_has_to_come_back(plain_fitter, clouds):
    outcomes = fit_scans(plain_fitter, clouds, n_jobs=2, finish=_locked_at_1)
    assert [o.result for o in outcomes] == [0, None, 2]
    assert "its fit cannot be sent back from a worker process" in outcomes[1].error and "lock" in outcomes[1].error


def test_fits_that_have_come_are_reported_though_one_report_is_stopped(plain_fitter, clouds, monkeypatch):
    seen = []

    class AllAtOnce(Workers):
        def answers(self):
            come = []
            while len(come) < 2:
                come += super().answers()
            return come

    def on_result(outcome):
        seen.append(outcome.index)
        if len(seen) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.learning.batch.Workers", AllAtOnce)
    with pytest.raises(KeyboardInterrupt):
        fit_scans(plain_fitter, clouds[:2], n_jobs=2, on_result=on_result)
    assert sorted(seen) == [0, 1]


@POSIX
def test_the_death_of_a_worker_costs_its_scan_only(plain_fitter, clouds):
    outcomes = fit_scans(plain_fitter, clouds, n_jobs=2, finish=_killed_at_1)
    assert [o.result for o in outcomes] == [0, None, 2]
    assert "SIGKILL" in outcomes[1].error and "memory" in outcomes[1].error


@pytest.mark.usefixtures("own_processes")
@pytest.mark.parametrize("jobs", [1, 2])
def test_an_interrupt_ends_workers_and_passes_on(plain_fitter, clouds, jobs):
    seen = []

    def on_result(outcome):
        seen.append(outcome.index)
        if len(seen) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_scans(plain_fitter, clouds, n_jobs=jobs, on_result=on_result)
    assert 1 <= len(seen) < 3
    assert not multiprocessing.active_children()


@POSIX
@pytest.mark.parametrize("pretrained, jobs", [(True, 1), (False, 1), (True, 2)])
def test_an_interrupt_that_a_library_makes_an_error_of_is_no_failure_of_a_scan(plain_fitter, tube_rig, pretrained, jobs):
    """As NumPy does where it comes in the middle of ``np.unique`` along an axis."""
    reported = []

    def source():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        except KeyboardInterrupt:
            raise TypeError("Cannot compare structured arrays unless they have a common dtype.") from None

    with pytest.raises(KeyboardInterrupt):
        fit_scans(plain_fitter if pretrained else lbs.LBSFitter(tube_rig), [source] * 2, n_jobs=jobs, on_result=reported.append)
    assert not reported


def test_a_script_without_a_main_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("from lbsfit_np.processes import Workers\nw = Workers(len, 1)\nw.give([1])\nw.answers()\n")
    done = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": PACKAGE_PARENT},
        timeout=120,
    )
    assert "InputError: n_jobs: got worker processes that ended before they started work" in done.stderr
    assert 'if __name__ == "__main__":' in done.stderr
    assert done.stderr.count("Traceback") == 1 and "freeze_support" not in done.stderr  # and not by each process


def test_a_script_that_workers_cannot_read_is_told_so(tmp_path):
    """Of which they are given the name of no file."""
    script = "from lbsfit_np.processes import Workers\nw = Workers(len, 1)\nw.give([1])\nw.answers()\n"
    env = os.environ | {"PYTHONPATH": PACKAGE_PARENT}
    done = subprocess.run([sys.executable], input=script, capture_output=True, text=True, env=env, timeout=120)
    assert "save it to a file and run that, or pass n_jobs=1" in done.stderr and "__main__" not in done.stderr.splitlines()[-1]


@pytest.mark.usefixtures("own_processes")
@POSIX
def test_workers_that_are_ended_in_the_middle_tidy_up(tmp_path):
    with Workers(_written, 2) as workers:
        workers.give((tmp_path / "slow", 600))
        workers.give((tmp_path / "quick", 0))
        answers = []
        while not answers or not list(tmp_path.glob(".slow*")):
            if len(answers) == 0:
                answers = workers.answers()
            time.sleep(0.01)
        assert answers == [((tmp_path / "quick", 0), "written", None)] and workers.busy and workers.idle
        assert workers.stop() == []
    assert not multiprocessing.active_children()
    assert [path.name for path in tmp_path.iterdir()] == ["quick"]  # the other's temporary file is gone


def _assert_same(a, b):
    """Of vertices that move freely, which say nothing of how well joints are known."""
    assert np.isnan(a.joint_std).all() and np.isnan(b.joint_std).all()
    assert_same(a, b, leave_out=("seconds", "joint_std"))


def _broken():
    return 1 / 0


def _described(index, scan, result):
    return index, len(scan), result.status


class _Unpicklable:
    def __reduce__(self):
        raise RuntimeError("not today")


def _locked_at_1(index, scan, result):
    return threading.Lock() if index == 1 else index


def _killed_at_1(index, scan, result):
    if index == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return index


def _written(task):
    path, seconds = task
    with atomic_path(path):
        time.sleep(seconds)
    return "written"
