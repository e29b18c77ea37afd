"""How precisely a scan tells where joints are: against many fits of the same, and where it shows no points of a limb."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from posed_samples import sampled, state_within

import lbsfit_np as lbs
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.optimize import precision
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.precision import joint_std
from lbsfit_np.optimize.problem import Problem

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def tube(tube_rig):
    return Model(tube_rig)


@pytest.fixture(scope="module")
def steps(tube):
    return GaussNewton(tube, tangential=0.02, vertices=10)


def _noisy(model, state, n, noise, seed, parts=4):
    """A problem of points of the first parts of the posed surface, moved along each axis, and their parts."""
    problem, labels = sampled(model, state)
    rng = np.random.default_rng(seed)
    rows = rng.choice(np.flatnonzero(labels < parts), n, replace=False)
    return Problem(problem.X[rows] + noise * rng.standard_normal((n, 3))), labels[rows]


def test_it_is_how_far_fits_of_many_noisy_scans_are_off(tube, steps, monkeypatch):
    """Where all points tell something of their own, as here, all count; vertices do not pull where parts are known."""
    monkeypatch.setattr(precision, "_INDEPENDENT", np.inf)
    state = state_within(tube, 3, 0.5)
    joints, expected = [], []
    for seed in range(40):
        problem, labels = _noisy(tube, state, 150, 0.015, seed)
        found, _ = steps.pose(problem, state, labels=labels, iterations=20)
        joints.append(tube.deformed(found).joints)
        expected.append(joint_std(steps, problem, found))
    off = np.sqrt(((joints - tube.deformed(state).joints) ** 2).sum(axis=2).mean(axis=0))
    ratio = np.median(expected, axis=0) / off
    assert (ratio > 0.65).all() and (ratio < 1.2).all()


def test_a_limb_without_points_is_known_by_its_limits_alone(tube, steps):
    state, stds = tube.rest(), {}
    narrow = copy.copy(tube)
    narrow.rig = replace(tube.rig, lower=0.2 * tube.rig.lower, upper=0.2 * tube.rig.upper)
    for name, model, parts in (("whole", tube, 4), ("lower", tube, 1), ("held", narrow, 1)):
        stds[name] = joint_std(GaussNewton(model, tangential=0.02), _noisy(tube, state, 150, 0.015, 0, parts)[0], state)
    assert (stds["whole"] < 0.02).all() and stds["lower"][:2].max() < 0.1 * stds["lower"][3] and stds["lower"][3] > 0.1
    assert stds["held"][3] < 0.5 * stds["lower"][3]


def test_the_root_may_be_turned_any_way_whatever_its_limits(tube):
    """They are those of poses that are drawn; fits leave it free."""
    state, (problem, _) = tube.rest(), _noisy(tube, tube.rest(), 15, 0.2, 0)
    held = copy.copy(tube)
    lower, upper = tube.rig.lower.copy(), tube.rig.upper.copy()
    lower[tube.rig.root], upper[tube.rig.root] = -0.01, 0.01
    held.rig = replace(tube.rig, lower=lower, upper=upper)
    same = [joint_std(GaussNewton(model, tangential=0.02), problem, state) for model in (tube, held)]
    np.testing.assert_array_equal(*same)


def test_of_a_refit_it_is_of_what_it_looks_for_and_of_points_of_the_part(tube):
    state = state_within(tube, 3, 0.2)
    problem, labels = _noisy(tube, state, 100, 0.01, 0)
    proba = np.eye(4)[np.where(labels > 1, 0, labels)]
    refit = Refit(tube, ("pose", "translation", "scale"))
    found = refit.joint_std(problem, state, proba)
    np.testing.assert_array_equal(found, joint_std(refit._last, problem, state, free=refit.free, proba=proba))
    for other in (refit.joint_std(problem, state), refit.freeing(("pose", "translation")).joint_std(problem, state, proba)):
        assert np.abs(other / found - 1).max() > 0.01


def test_points_of_other_parts_tell_nothing(tube, steps):
    """Such as the trunk's, where an arm that is hidden lies against it; what the probabilities do not say counts."""
    state = state_within(tube, 3, 0.5)
    problem, labels = _noisy(tube, state, 300, 0.01, 0)
    whole, proba = joint_std(steps, problem, state), np.eye(4)[labels]
    own = joint_std(steps, problem, state, proba=proba)
    np.testing.assert_allclose(own, whole, rtol=0.5)
    np.testing.assert_array_equal(joint_std(steps, problem, state, proba=0 * proba), whole)
    proba[labels > 0] = np.eye(4)[0]
    assert joint_std(steps, problem, state, proba=proba)[3] > 5 * whole[3]


def test_a_fit_that_is_not_finite_tells_nothing(tube, steps):
    state = tube.rest()
    problem = Problem(tube.rig.vertices)
    assert np.isnan(joint_std(steps, problem, state.replace(translation=np.array([np.nan, 0.0, 0.0])))).all()


def test_points_that_count_half_are_as_noisy(tube, steps):
    state = state_within(tube, 3, 0.5)
    problem, _ = _noisy(tube, state, 300, 0.01, 0)
    half = steps.told_by_points(problem, state, proba=np.full((300, 4), 0.5))
    whole = steps.told_by_points(problem, state)
    np.testing.assert_allclose(half[0], 0.5 * whole[0])
    assert half[1] == pytest.approx(whole[1])


def test_it_falls_with_noise_and_with_points_until_they_tell_the_same(tube, steps):
    state = state_within(tube, 3, 0.5)
    few, some, many = (joint_std(steps, _noisy(tube, state, n, 0.01, 0)[0], state) for n in (15, 60, 300))
    assert (few > 1.2 * some).all() and (many < 1.5 * some).all() and (many > 0.6 * some).all()
    assert (joint_std(steps, _noisy(tube, state, 60, 0.03, 0)[0], state) > 2 * some).all()
    clean = joint_std(steps, sampled(tube, state)[0], state)
    assert (clean > 1e-4).all()  # no scan is without any noise


def test_weights_say_how_many_points_there_are(tube, steps):
    state = state_within(tube, 3, 0.5)
    problem, _ = _noisy(tube, state, 60, 0.01, 0)
    for hardly, close in ((0.0, 1e-9), (1e-7, 1e-3)):
        weights = np.where(np.arange(60) < 20, 0.05, hardly)
        of_some = joint_std(steps, Problem(problem.X, weights), state)
        np.testing.assert_allclose(of_some, joint_std(steps, Problem(problem.X[:20]), state), rtol=close)


def test_a_scale_that_is_looked_for_makes_what_is_far_from_the_middle_less_certain(tube, steps):
    state = state_within(tube, 3, 0.2)
    problem, _ = _noisy(tube, state, 300, 0.01, 0)
    fixed, free = (joint_std(steps, problem, state, free=("pose", "translation", *more)) for more in ((), ("scale",)))
    assert (free >= fixed).all() and free[3] > 1.01 * fixed[3]


@pytest.mark.parametrize("scale", [0.25, 1.0, 4.0])
def test_before_the_scan_is_looked_at_the_scale_is_known_to_a_share_of_itself(tube, steps, scale):
    """Whatever the unit of the frame; a scan of one point hardly adds to it."""
    state = tube.rest().replace(scale=scale)
    free = ("pose", "translation", "scale")
    C, _, layout = precision._covariance(steps, Problem(np.zeros((1, 3))), state, free, precision._INDEPENDENT)
    assert layout.blocks[-1] == "scale"
    assert 0.1 * scale < np.sqrt(C[-1, -1]) < 1.001 * precision._ANY_SCALE * scale


@pytest.mark.slow
def test_a_fit_says_how_precisely_joints_are_told(tube_rig, tube_fitter, quick_fitter):
    """In the scan's unit; less so where the scan ends far below them."""
    (scan,) = lbs.synthesize(tube_rig, random_state=31, n_points=1500, holes=0)
    fitter = copy.copy(quick_fitter).set_params(scale="fixed", partial=True, training_scans=20)
    whole, cut = (fitter.fit_scan(points, theta0=scan.pose) for points in (scan.points, scan.points[scan.labels < 1]))
    assert (whole.joint_std < 0.02 * tube_rig.size).all() and "joint_std" not in whole.message
    assert cut.joint_std[3] > 2 * whole.joint_std[3] and cut.joint_std[3] > 1.5 * cut.joint_std[0]
    large = quick_fitter.fit_scan(1000 * scan.points)
    np.testing.assert_allclose(large.joint_std, 1000 * quick_fitter.fit_scan(scan.points).joint_std, rtol=0.3)
    known = tube_fitter.fit_scan(scan.points, labels=scan.labels)
    np.testing.assert_allclose(known.joint_std, whole.joint_std, rtol=0.6)
