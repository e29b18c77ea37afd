"""Work that is done in one process has linear algebra on one thread, as in many processes; afterwards all is as before."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 (its BLAS is not NumPy's)
from threadpoolctl import threadpool_info, threadpool_limits

from lbsfit_np.bench.baseline import PlainChamfer
from lbsfit_np.bench.study import free_form
from lbsfit_np.bench.study.oracle import OracleFit
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.learning import new_scan
from lbsfit_np.learning.loop import Loop
from lbsfit_np.segmentation.segmenter import Segmenter
from lbsfit_np.segmentation.stage import Training, train_stage
from lbsfit_np.starts import library
from lbsfit_np.threads import one_thread
from lbsfit_np.workers import each


class _Seen(Exception):
    """Ends the work as soon as it is known on how many threads it is done."""


def _blas():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def _look(*given, **more):
    raise _Seen(_blas())


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2):
        if _blas() != {2}:
            pytest.skip("a BLAS that cannot have two threads")
        yield
        assert _blas() == {2}


def _regressor(monkeypatch):
    monkeypatch.setattr("sklearn.neural_network.MLPRegressor.fit", _look)
    return library._trained(np.eye(4), np.ones(4), np.zeros((4, 2, 3)), 0)


def _baseline(monkeypatch):
    monkeypatch.setattr("sklearn.decomposition.PCA.fit", _look)
    scan = SimpleNamespace(points=np.random.default_rng(0).random((50, 3)), vertices=np.zeros((4, 3)))
    return free_form.taught(SimpleNamespace(size=1.0), [scan] * 3, 0)


def _new_scan(monkeypatch):
    monkeypatch.setattr(new_scan, "taking_part", lambda *of, **more: None)
    monkeypatch.setattr(new_scan, "_fit_new", _look)
    monkeypatch.setattr(new_scan, "_facing", lambda fitter: SimpleNamespace(floors=None))
    settings = FitSettings(max_points=1, scale="fixed", effort="fast")
    monkeypatch.setattr(new_scan, "fit_settings", lambda fitter: settings)
    fitter = SimpleNamespace(regressor_=1, rig=None, _seed=lambda: 0)
    return new_scan.fit_new(fitter, None, ("ann",), None, None, None)


X = np.random.default_rng(0).random((40, 3))
MADE = {"facing": SimpleNamespace(floors=None), "model": SimpleNamespace(source=None), "settings": SimpleNamespace(effort="fast")}
WORK = {
    "a stage": lambda _: train_stage(X, np.arange(40) % 2, 2, Training(epochs=1), 0, "a", _look),
    "labels": lambda _: Segmenter.predict_proba(SimpleNamespace(half=1.0, turn=0.0, _proba=_look), X),
    "the regressor f": _regressor,
    "the loop": lambda _: Loop.run(SimpleNamespace(_first_fits=_look)),
    "a fit": lambda _: ScanFit.fit(SimpleNamespace(taking_part=lambda *of, **more: None, _fit=_look, **MADE), X),
    "what takes part": lambda _: ScanFit.fit(SimpleNamespace(taking_part=_look, **MADE), X),
    "a new scan": _new_scan,
    "tasks": lambda _: each(_look, [0]),
    "the oracle": lambda _: OracleFit.__call__(SimpleNamespace(_fit=_look), None),
    "plain Chamfer": lambda _: PlainChamfer.fit_scan(SimpleNamespace(_fit=_look), SimpleNamespace(points=X)),
    "the supervised baseline": _baseline,
}


@pytest.mark.parametrize("what", WORK)
def test_work_is_done_on_one_thread(what, monkeypatch):
    with pytest.raises(_Seen) as seen:
        WORK[what](monkeypatch)
    assert seen.value.args == ({1},)


def test_beside_each_other_the_last_to_leave_lifts_the_limit():
    """Threads of one process share its limit, in whatever order they come and go."""
    both_in, first_out, seen = threading.Barrier(2), threading.Event(), {}

    def first():
        with one_thread():
            both_in.wait(10)
        first_out.set()

    def second():
        with one_thread():
            both_in.wait(10)
            seen["first out"], seen["inside"] = first_out.wait(10), _blas()

    threads = [threading.Thread(target=work) for work in (first, second)]
    for t in threads:
        t.start()
    for t in threads:
        t.join(20)
    assert seen == {"first out": True, "inside": {1}} and _blas() == {2}


def test_within_each_other_the_outer_one_holds():
    with one_thread():
        with one_thread():
            pass
        assert _blas() == {1}
