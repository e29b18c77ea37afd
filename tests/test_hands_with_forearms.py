"""Hands with a forearm, which their rig has nothing of, fitted by themselves and learned from; left hands as right ones."""

import warnings
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from learning_runs import FEW
from sklearn.base import clone

import lbsfit_np as lbs
from lbsfit_np.bench.conditions import CONDITIONS, condition_scan
from lbsfit_np.learning import first_fits
from lbsfit_np.learning.loop import LoopSettings


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def fitter(hand):
    quick = {"training_scans": 60, "training": {"n_points": 500}, "max_points": 400}
    return lbs.LBSFitter(hand, orientation="aligned", random_state=0, **quick).pretrain()


def _with_an_arm(hand, i):
    return condition_scan(hand, replace(CONDITIONS["0.3"], arm=True), i, np.random.default_rng(i))


@pytest.mark.study
def test_a_hand_with_a_forearm_is_fitted_and_what_was_left_out_is_said(hand, fitter):
    scan = _with_an_arm(hand, 1)
    assert 1500 < (scan.labels < 0).sum() < 2500
    result = fitter.fit_scan(scan.points)
    error = np.linalg.norm(result.joints - scan.joints, axis=1).mean() / hand.size
    assert error < 0.015 and result.status == "ok", (error, result.message)
    assert "the scan seems to go on beyond the rig" in result.message
    assert result.labels.shape == (len(scan.points),) and result.confidence[scan.labels < 0].mean() < 0.3
    alone = copy(fitter).set_params(effort="fast").fit_scan(scan.points)
    assert alone.status != "ok" and "the scan seems to go on beyond the rig" not in alone.message
    assert "(--effort balanced) looks further, also for what goes on beyond the rig" in alone.message


@pytest.mark.slow
def test_a_left_hand_fails_and_is_asked_about(hand, fitter):
    scan = condition_scan(hand, CONDITIONS["0.3"], 4, np.random.default_rng(4))
    fitter = copy(fitter).set_params(effort="fast")
    left, right = (fitter.fit_scan(points) for points in (scan.points * [-1.0, 1.0, 1.0], scan.points))
    assert left.status != "ok" and "the mirror image of the scan fits" in left.message, left.message
    assert right.status == "ok" and "mirror" not in right.message, right.message


@pytest.mark.study
def test_hands_with_forearms_are_learned_from(hand, fitter, tmp_path, monkeypatch):
    """Their first fits find what lies beyond, and are not made again after a stop; in millimetres."""
    monkeypatch.setattr(LoopSettings, "for_training", lambda n, **others: LoopSettings(**FEW, **others))
    scans = [_with_an_arm(hand, 1), condition_scan(hand, CONDITIONS["0.3"], 4, np.random.default_rng(4))]
    learner = clone(fitter).set_params(rounds=1, held_out=0)
    learner._pretrained = fitter._pretrained
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learner.fit([1000.0 * s.points for s in scans], checkpoint=tmp_path / "steps")
    assert learner.unit_[0] == 1000.0 and learner.history_[0]["beyond"] == 1
    for scan, r in zip(scans, learner.results_, strict=True):
        arm = scan.labels < 0
        error = np.linalg.norm(r.joints - 1000.0 * scan.joints, axis=1).mean() / (1000.0 * hand.size)
        assert error < 0.015 and r.status == "ok", (error, r.message)
        assert ("the scan seems to go on beyond the rig" in r.message) == arm.any()
        assert (r.confidence[~arm] > 0).all() and (r.confidence[arm] == 0).sum() >= 0.75 * arm.sum()
    (scan, *_) = scans  # as if it were a new one
    result = learner.fit_scan(1000.0 * scan.points)
    arm = scan.labels < 0
    assert "the scan seems to go on beyond the rig" in result.message and (result.confidence[arm] == 0).mean() > 0.75
    again = clone(learner)
    again._pretrained = fitter._pretrained
    monkeypatch.setattr(first_fits.FirstFit, "__call__", None)
    again.fit([1000.0 * s.points for s in scans], checkpoint=tmp_path / "steps")
    np.testing.assert_array_equal(again.results_[0].vertices, learner.results_[0].vertices)
