"""The last stages of a fit: which pose comes out, and which it is judged by."""

from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting import last_stages
from lbsfit_np.fitting.last_stages import LastStages
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.sensor import sample_surface

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def hand():
    return Model(lbs.load_rig("hand-coarse"))


@pytest.fixture(scope="module")
def posed(hand):
    """A true state, 1,500 points of its surface, and their Problem."""
    rng = np.random.default_rng(3)
    theta = np.clip(0.2 * rng.standard_normal(hand.rig.lower.shape), hand.rig.lower, hand.rig.upper)
    truth = hand.rest().replace(theta=np.where(hand.rig.turning, theta, 0.0))
    X, _, _ = sample_surface(hand.deformed(truth).vertices, hand.rig.faces, 1500, rng)
    return truth, Problem(X + 0.002 * rng.standard_normal(X.shape))


def _ended(model, problem, state, *, polish=True, **settings):
    settings = FitSettings(**settings)
    return LastStages(model, settings, Refit(model), polish=polish)(problem, problem, state, None)


def _off(model, state, truth):
    return np.linalg.norm(model.deformed(state).joints - model.deformed(truth).joints, axis=1).mean()


def test_without_registration_what_is_judged_comes_out(hand, posed):
    truth, problem = posed
    end, registered = (_ended(hand, problem, truth, registration=r) for r in (False, True))
    assert end.last.state is end.judged and end.judged.residual is not None
    np.testing.assert_array_equal(end.judged.theta, registered.judged.theta)
    assert (end.joint_std != registered.joint_std).any()  # each is of what comes out


def test_without_a_polish_the_pose_is_that_of_the_full_objective(hand, posed):
    truth, problem = posed
    end = _ended(hand, problem, truth, polish=False)
    np.testing.assert_array_equal(end.last.state.theta, end.judged.theta)
    assert end.last.state.displacement is not None and end.judged.displacement is None


def test_a_pose_is_polished_before_its_skin_is_registered(hand, posed):
    """Which would take up what it is off by."""
    truth, problem = posed
    beside = truth.replace(theta=truth.theta + 0.02 * hand.rig.turning)
    end = _ended(hand, problem, beside)
    assert _off(hand, end.last.state, truth) < 0.1 * _off(hand, beside, truth)
    assert end.last.state.residual is None and end.last.state.displacement is not None


@pytest.mark.parametrize("alike", [0.0, None])
def test_what_is_said_is_about_the_pose_that_comes_out(hand, posed, monkeypatch, alike):
    """Of two poses, the full objective's residual counts as long as it has led to the same one."""
    truth, problem = posed
    if alike is not None:
        monkeypatch.setattr(last_stages, "ALIKE", alike)
    beside = truth.replace(theta=truth.theta + 0.02 * hand.rig.turning)
    end = _ended(hand, problem, beside)
    assert (end.judged.residual is None) == (alike is not None)
    assert (end.judged.theta == end.last.state.theta).all() == (alike is not None)
    assert end.last.state.displacement is not None and end.judged.displacement is None


def test_poses_are_told_apart_by_angles_alone(hand, posed):
    truth, _ = posed
    stages = LastStages(hand, FitSettings(), None)
    skin = truth.replace(residual=0.1 * hand.rig.vertices, scale=2.0, translation=np.ones(3))
    assert stages._apart(truth, skin) == 0.0
    other = truth.theta.copy()
    other[hand.rig.parents == hand.rig.root] += 0.5
    assert stages._apart(truth, truth.replace(theta=other)) > last_stages.ALIKE


def test_fits_of_coarse_meshes_have_nearer_joints(hand):
    scans = lbs.synthesize(hand.source, 2, random_state=11, n_points=1500, shape=0.0)
    off = {}
    for registration in (False, True):
        fit = ScanFit(hand, FitSettings(registration=registration))
        results = [fit.fit(s.points, labels=s.labels, random_state=0) for s in scans]
        off[registration] = [np.linalg.norm(r.joints - s.joints, axis=1).mean() for r, s in zip(results, scans, strict=True)]
    assert (np.array(off[True]) < 0.9 * np.array(off[False])).all()


def test_states_of_what_a_scan_shows_become_the_whole_models(hand, posed):
    class Shown:
        @staticmethod
        def whole(state, model):
            return state, model

    truth, problem = posed
    end = _ended(hand, problem, truth)
    assert end.whole(None, hand) is end
    whole = end.whole(Shown, hand)
    assert whole.last.state == (end.last.state, hand) and whole.judged == (end.judged, hand)
    assert replace(whole.last, state=None) == replace(end.last, state=None)
