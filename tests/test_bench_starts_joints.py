"""What the benchmark of starts says of single joints: which are wrong, and whether their precision tells them."""

from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.bench import starts as module
from lbsfit_np.bench.starts import starts_bench, starts_scan, starts_table

ERRORS, STD = (0.001, 0.03, 0.0501, 0.2), (0.001, 0.021, 0.01, 0.3)


def _told(errors, std, statuses=("ok",)):
    scans = [{"status": status, "each_error": errors, "each_std": std} for status in statuses]
    return module._joint_confidence({"rigs": {"hand": {"rows": {"0.3": {"fits": {"own": {"scans": scans}}}}}}})


def test_of_fits_that_call_themselves_right_wrong_joints_are_told_or_not():
    found = {"joints": 8, "wrong": 4, "wrong_told": 0.5, "right_called_guesses": 0.5, "within_two_std": 0.75}
    assert _told(ERRORS, STD, ("ok", "suspect", "ok")) == found
    assert _told(ERRORS, STD, ("suspect",)) is None


@pytest.mark.parametrize(
    "joints, wrong, told, within",
    [
        (slice(0, 4), 2, ", 50 % of them called guesses by joint_std; of the others 50.0 % are.", 75),
        (slice(2, 4), 2, ", 50 % of them called guesses by joint_std.", 50),
        (slice(0, 2), 0, "; 50.0 % are called guesses by joint_std.", 100),
    ],
)
def test_the_table_says_so_whether_some_or_all_or_none_are_wrong(joints, wrong, told, within, monkeypatch):
    monkeypatch.setattr(module._OneScan, "__call__", lambda self, i: {"scan": i, "failed": "not fitted", "seconds": 0.0})
    report = starts_bench(["hand-coarse"], rows=["0.3"], fits=("plain",), n_scans=1)
    report["confidence"] = {"auc": None, "joints": _told(ERRORS[joints], STD[joints])}
    whose = f"Of {len(ERRORS[joints])} joints, hidden ones too, of fits that call themselves right {wrong} are off by"
    words = f"{whose} more than 5 % of the size{told} Within twice their joint_std are {within} % of all."
    assert " ".join(starts_table(report).split()).endswith(words)


def test_joints_are_those_that_move():
    """In shares of the size; where no precision is known, as of plain Chamfer, nothing."""
    body = lbs.load_rig("body-coarse")
    scan = starts_scan(body, "unit", 0, 3)
    off, std = np.zeros((len(body.parents), 3)), np.full(len(body.parents), 0.02 * body.size * scan.scale)
    off[:, 1] = 0.1 * body.size * scan.scale
    still = SimpleNamespace(moving=np.arange(len(off)) != 3, size=body.size)
    one, found = module._OneScan(still, "unit", 3, "own", None), SimpleNamespace(joints=scan.joints + off, joint_std=std)
    assert one._each_joint(found, scan) == {"each_error": [0.1] * (len(off) - 1), "each_std": [0.02] * (len(off) - 1)}
    assert one._each_joint(SimpleNamespace(joints=scan.joints, joint_std=np.nan * std), scan) == {}


def test_a_fit_that_is_not_finite_has_failed():
    """Its error is no number, which would count as no failure."""
    body = lbs.load_rig("body-coarse")
    lost = SimpleNamespace(joints=np.full(body.joints.shape, np.nan), message="the fit is not finite", seconds=2.0)
    one = module._OneScan(body, "0.3", 3, "own", SimpleNamespace(fit_scan=lambda points: lost))
    assert one(0) == {"scan": 0, "failed": "the fit is not finite", "seconds": 2.0}
