"""The calibration of the probability: what is fitted, how often, which fits are right, and what is made of them."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.bench import calibrate as module
from lbsfit_np.bench.calibrate import Case, calibrate, cases_of, judged
from lbsfit_np.bench.conditions import CONDITIONS, SEEN, condition_scan, conditions_of
from lbsfit_np.bench.run import TRAINING_SEED
from lbsfit_np.bench.starts import PROBABLE
from lbsfit_np.fitting.effort import EFFORTS


@pytest.fixture(scope="module")
def rigs():
    return [lbs.load_rig(name) for name in ("hand-coarse", "hand-left-coarse")]


class Fits:
    """Fits without fitting: the joints of the last scan, changed as a test wants it."""

    def __init__(self):
        self.scout, self.efforts, self.points, self.fitters = SimpleNamespace(effort=None), [], [], []
        self.seeds, self.facing = [], SimpleNamespace(floors="up")
        self.truth, self.changed = None, lambda truth, k: truth.joints

    def fitter(self, rig, **parameters):
        self.fitters.append((rig, parameters))
        return SimpleNamespace(pretrain=lambda cache: None, segmenter_=None, regressor_=None)

    def scan(self, *arguments):
        self.truth = condition_scan(*arguments)
        return self.truth

    def taking_part(self, points, *, random_state, ups):
        self.seeds.append(random_state)
        return points, ups

    def fit(self, points, *, part):
        assert part[0] is points and part[1] == "up"
        self.efforts.append(self.scout.effort)
        self.points.append(points)
        k = len(self.efforts) - 1
        return SimpleNamespace(joints=self.changed(self.truth, k), evidence={"number": k})


@pytest.fixture
def fits(monkeypatch):
    fits = Fits()
    monkeypatch.setattr(module, "condition_scan", fits.scan)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter", fits.fitter)
    monkeypatch.setattr("lbsfit_np.learning.new_scan.scan_fit", lambda *made_of: fits)
    return fits


# ---- which fits are right ----


def test_every_scan_is_fitted_carelessly_and_carefully(fits, rigs):
    found = judged(Case(rigs[0], "turned", CONDITIONS["turned"], rigs[0]), 3, 7, 60)
    assert fits.efforts == 3 * [module._CARELESS, EFFORTS["balanced"]]
    assert [evidence["number"] for evidence, _ in found] == list(range(6))
    for careless, careful in zip(fits.points[::2], fits.points[1::2]):
        assert careless is careful
    assert len({points.tobytes() for points in fits.points}) == 3
    ((rig, parameters),) = fits.fitters
    assert rig is rigs[0] and parameters["training_scans"] == 60
    assert CONDITIONS["turned"].fitter.items() <= parameters.items()
    # The seed is of the scans; what is trained and how it is fitted is the same for all.
    assert fits.seeds == 6 * [TRAINING_SEED] and parameters["random_state"] == TRAINING_SEED != 7


@pytest.mark.parametrize("row", ["turned", "unit"])
def test_right_is_near_in_shares_of_the_size_times_the_scale(fits, rigs, row):
    misses = [0.9 * PROBABLE, 1.1 * PROBABLE]
    fits.changed = lambda truth, k: truth.joints + [misses[k % 2] * rigs[0].size * truth.scale, 0.0, 0.0]
    found = judged(Case(rigs[0], row, CONDITIONS[row], rigs[0]), 2, 7, 60)
    assert [right for _, right in found] == [True, False, True, False]


def test_hidden_joints_do_not_count(fits, rigs):
    rig, condition = rigs[0], CONDITIONS["partial"]
    hidden = []

    def changed(truth, k):
        rows = np.bincount(truth.labels, minlength=len(rig.parts))[rig.part_of_joint] < SEEN
        hidden.append(rows.any())
        return np.where(rows[:, None], truth.joints + 10.0, truth.joints)

    fits.changed = changed
    found = judged(Case(rig, "partial", condition, rig), 4, 7, 60)
    assert any(hidden) and all(right for _, right in found)


def test_no_fit_of_what_is_not_the_rig_is_right(fits, rigs):
    """Not even one that has the joints where the other rig's are."""
    hand, other = rigs
    turned = CONDITIONS["turned"]
    fits.truth = SimpleNamespace(joints=hand.joints, scale=1.0)  # of the solids, which no condition makes
    for shown in (None, other):
        case = Case(hand, "foreign", turned, shown)
        assert case.scan(0, np.random.default_rng(0))[1] is None
        assert [right for _, right in judged(case, 2, 7, 60)] == [False] * 4
    points, truth = Case(hand, "own", turned, hand).scan(0, np.random.default_rng(0))
    assert truth.points is points


# ---- what is fitted ----


def test_cases_are_all_rows_worse_scans_other_rigs_and_solids(rigs):
    hand, other = rigs
    cases = {case.name: case for case in cases_of(hand, rigs)}
    worse = ["1000 points, 2 % noise", "300 points, 1 % noise", "300 points, 2 % noise", "60 points", "one side, not said"]
    worse += ["floor, clutter, 1 % noise"]
    rows = [row for row in conditions_of(hand) if row != "arm"]
    assert list(cases) == [*rows, *worse, f"in truth {other.name}", "in truth a solid"]
    assert all(case.rig is hand for case in cases.values())
    shown = [case.shown for case in cases.values()]
    assert shown[-2:] == [other, None] and all(rig is hand for rig in shown[:-2])
    assert all(cases[row].condition is CONDITIONS[row] for row in rows)
    assert len(cases["60 points"].scan(0, np.random.default_rng(0))[0]) == 60
    _, floor = cases["floor, clutter, 1 % noise"].scan(0, np.random.default_rng(0))
    assert 0.4 < (floor.labels < 0).mean() < 0.5  # 0.7 and 0.1 for each point of the hand


def test_solids_are_as_large_as_the_rig_and_of_three_kinds(rigs):
    solid = cases_of(rigs[0], rigs)[-1]
    clouds = [solid.scan(i, np.random.default_rng(0))[0] / (rigs[0].size / 2) for i in range(4)]
    for points in clouds:
        assert points.shape == (2500, 3) and np.abs(points).max() == pytest.approx(1.0, abs=0.03)
    np.testing.assert_array_equal(clouds[0], clouds[3])
    assert all(not np.allclose(a, b, atol=0.1) for a, b in pairwise(clouds[:3]))


def test_what_is_calibrated_on_is_all_of_them(rigs, monkeypatch):
    told, seen = [], {}

    def judge(case, *settings):
        assert settings == (2, 5, 60)
        return [(case.name, case.shown is case.rig)]

    monkeypatch.setattr(module, "judged", judge)
    monkeypatch.setattr(module, "regression", lambda evidence, right: seen.update(evidence=evidence, right=right) or (0.0, ()))
    names = ("hand-coarse", "hand-left-coarse")
    answer = calibrate(names, n_scans=2, seed=5, training_scans=60, on_case=lambda case, found: told.append(case.name))
    expected = [case.name for rig in rigs for case in cases_of(rig, rigs)]
    assert answer == (0.0, ()) and seen["evidence"] == told == expected
    assert seen["right"].count(False) == 4 and len(seen["right"]) == len(expected)
