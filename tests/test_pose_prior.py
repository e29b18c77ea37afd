"""The prior of poses: found again from made ones, and poses drawn to it no further than their own scans leave them open."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting.drawn import PosePrior, drawn, prior_of
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.learning.pose_prior import looked_at, pose_prior
from lbsfit_np.learning.tasks import Held
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout
from lbsfit_np.optimize.visibility import WHOLE

TURNING = np.array([[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0]], dtype=bool)
ROOT = 0


def _made(n, seed, noise):
    """True and found poses of a rig of which two angles go together, and how precisely each angle was found."""
    rng = np.random.default_rng(seed)
    mean, T = np.array([0.3, -0.2, 1.0]), np.diag([0.04, 0.01, 0.0025])
    T[0, 1] = T[1, 0] = 0.016
    own = rng.multivariate_normal(mean, T, n)
    angles = np.column_stack([rng.uniform(-3, 3, (n, 3)), own])
    std = np.concatenate([np.full(3, 0.01), noise])
    found = angles + std * rng.standard_normal(angles.shape)
    poses = []
    for row in found:
        theta = np.zeros(TURNING.shape)
        theta[TURNING] = row
        poses.append(theta)
    return own, poses, [np.diag(std**2)] * n, mean, T


def test_mean_and_spread_of_made_poses_are_found_again():
    _, poses, told, mean, T = _made(4000, 1, np.array([0.1, 0.05, 0.1]))
    prior = pose_prior(poses, told, TURNING, ROOT)
    np.testing.assert_allclose(prior.mean[TURNING][3:], mean, atol=0.02)
    np.testing.assert_allclose(np.linalg.inv(prior.precision[3:, 3:]), T, atol=0.006)
    assert not prior.mean[ROOT].any() and not prior.precision[:3].any() and not prior.precision[:, :3].any()


def test_while_a_template_is_found_angles_are_held_by_how_little_their_scan_tells_them():
    """(T + κ T C⁻¹ T)⁻¹; the root's turn never."""
    _, poses, told, *_ = _made(60, 3, np.array([0.1, 0.05, 0.1]))
    prior, noise, t = pose_prior(poses, told, TURNING, ROOT), 1e-4, slice(3, None)
    T, C = np.linalg.inv(prior.precision[t, t]), np.diag([1e-6, 0.04, 10.0])
    whole = np.eye(len(prior.precision)) * 1e-4
    whole[t, t] = C
    mean, weights = prior.where_open(whole, noise)
    assert mean is prior.mean and not weights[:3].any() and not weights[:, :3].any()
    np.testing.assert_allclose(weights[t, t], 2 * noise * np.linalg.inv(T + 0.3 * T @ np.linalg.inv(C) @ T), rtol=1e-6)
    np.testing.assert_allclose(weights, weights.T, rtol=1e-9, atol=1e-15)
    fully = prior.of(noise)[1][t, t]
    assert weights[3, 3] < 0.1 * fully[0, 0] and weights[5, 5] > 0.9 * fully[2, 2]


@pytest.mark.parametrize("n, most", [(300, 0.6), (12, 0.85)])
def test_poses_drawn_to_it_are_nearer_to_the_true_ones(n, most):
    """An angle that is told to 0.3 rad and varies by 0.2 and less; one that its scan tells stays where it was found."""
    noise = np.array([0.3, 0.004, 0.3])
    before, after, moved = [], [], []
    for seed in range(8):
        own, poses, told, *_ = _made(n, seed, noise)
        prior = pose_prior(poses, told, TURNING, ROOT)
        mean, weights = prior.mean, prior.precision
        for truth, theta, C in zip(own, poses, told):
            known = np.linalg.inv(C)
            drawn = np.linalg.solve(known + weights, known @ theta[TURNING] + weights @ mean[TURNING])
            before.append(np.abs(theta[TURNING][3:] - truth))
            after.append(np.abs(drawn[3:] - truth))
            moved.append(np.abs(drawn - theta[TURNING]))
    before, after, moved = (np.mean(x, axis=0) for x in (before, after, moved))
    assert (after[[0, 2]] < most * before[[0, 2]]).all()
    assert moved[1 + 3] < 0.001 and moved[:3].max() < 1e-12


def test_few_poses_that_are_alike_still_leave_room():
    """Three poses that are the same to a thousandth say little of how poses vary."""
    rng = np.random.default_rng(3)
    poses = [0.001 * rng.standard_normal(TURNING.shape) * TURNING for _ in range(3)]
    prior = pose_prior(poses, [np.eye(6) * 1e-4] * 3, TURNING, ROOT)
    assert (1 / np.sqrt(np.diag(prior.precision)[3:]) > 0.1).all()
    assert pose_prior(poses[:2], [np.eye(6) * 1e-4] * 2, TURNING, ROOT) is None


def test_of_very_many_poses_some_are_looked_at():
    np.testing.assert_array_equal(looked_at(5), np.arange(5))
    some = looked_at(23000)
    assert len(some) == 400 and some[0] == 0 and some[-1] == 22999 and (np.diff(some) > 50).all()


def test_smoothing_holds_what_all_poses_tell_as_well(tube_rig):
    poses, turning = _poses_like(tube_rig, 40, 2)
    t = int(turning.sum())
    prior = pose_prior(poses, [np.eye(t) * 1e-4] * 40, turning, tube_rig.root)
    (scan,) = lbs.synthesize(tube_rig, poses=[poses[0]], random_state=1, n_points=300, shape=0.0)
    model, X = Model(tube_rig), scan.points / (tube_rig.size / 2)
    state = model.rest().replace(theta=scan.pose, translation=scan.translation / (tube_rig.size / 2))
    wanted = state.theta + 0.2, 1e-3
    refit = Refit(model)
    for noise in (0.0, 1e-3):
        found = Held({0: model}, WHOLE, prior)((0, X, state, wanted, noise))
        expected = refit.polish(Problem(X), state, prior=prior_of(prior, noise, turning, wanted))
        np.testing.assert_array_equal(found.theta, expected.theta)
    assert np.abs(found.theta - refit.polish(Problem(X), state, prior=wanted).theta).max() > 1e-3


def test_two_priors_in_one_are_their_sum_but_for_a_constant():
    rng = np.random.default_rng(4)
    A = rng.standard_normal((6, 6))
    prior = PosePrior(rng.standard_normal(TURNING.shape), A @ A.T)
    prior.precision[:3] = prior.precision[:, :3] = 0.0  # the root's
    one, other = prior.of(0.3), (rng.standard_normal(TURNING.shape), 0.7)
    np.testing.assert_array_equal(one[1], 0.6 * prior.precision)  # E has each distance twice
    both = prior_of(prior, 0.3, TURNING, other)

    def value(prior, theta):
        away = (theta - prior[0])[TURNING]
        return away @ (prior[1] if np.ndim(prior[1]) else prior[1] * np.eye(6)) @ away

    poses = rng.standard_normal((5, *TURNING.shape))
    differences = [value(both, theta) - value(one, theta) - value(other, theta) for theta in poses]
    np.testing.assert_allclose(differences, differences[0])
    np.testing.assert_allclose(both[0][ROOT], other[0][ROOT])
    assert prior_of(None, 0.3, TURNING, other) is other and prior_of(prior, 0.0, TURNING, other) is other
    np.testing.assert_array_equal(prior_of(prior, 0.3, TURNING)[1], one[1])
    assert prior_of(None, 0.3, TURNING) is None and prior_of(prior, 0.0, TURNING) is None


def _poses_like(rig, n, seed, *, spread=0.1):
    """Poses near one, each angle by itself."""
    rng = np.random.default_rng(seed)
    turning = Layout(rig, ("pose",), 0).turning
    middle = np.clip((rig.lower + rig.upper) / 2, rig.lower, rig.upper)
    poses = middle + spread * rng.standard_normal((n, *turning.shape)) * turning
    poses[:, rig.root] = rng.uniform(-1, 1, (n, 3))
    return np.clip(poses, rig.lower, rig.upper), turning


def test_a_joint_that_is_unusual_is_put_where_the_rest_would_have_it():
    _, poses, told, *_ = _made(400, 5, np.array([0.01, 0.01, 0.01]))
    prior = pose_prior(poses, told, TURNING, ROOT)
    theta = prior.mean.copy()
    assert prior.usual(theta, TURNING) == []
    theta[ROOT] = 3.0  # turns of the whole are never unusual
    assert prior.usual(theta, TURNING) == []
    theta[2, 1] += 0.5  # ten standard deviations
    (other,) = prior.usual(theta, TURNING)
    np.testing.assert_allclose(np.delete(other, 2, axis=0), np.delete(theta, 2, axis=0))
    # E[c | a, b] of a Gaussian, by blocks of its covariance; c is the third angle.
    T = np.linalg.inv(prior.precision[3:, 3:])
    a = (theta - prior.mean)[TURNING][3:5]
    assert other[2, 1] == pytest.approx(prior.mean[2, 1] + T[2, :2] @ np.linalg.solve(T[:2, :2], a))
    theta[1, 0] += 2.0
    assert len(prior.usual(theta, TURNING)) == 2
    assert not np.isclose(prior.usual(theta, TURNING)[0][1, 0], theta[1, 0])  # the more unusual one first


def test_a_joint_in_a_wrong_minimum_comes_home_where_other_poses_tell(tube_rig):
    """From a pose with one joint far off, whose own scan's steps lead nowhere."""
    poses, turning = _poses_like(tube_rig, 60, 1, spread=0.05)
    refit = Refit(Model(tube_rig))
    half, t = tube_rig.size / 2, int(turning.sum())
    prior = pose_prior(poses, [np.eye(t) * 1e-5] * 60, turning, tube_rig.root)
    homes = drawn_home = plain_home = 0
    for k in range(6):
        theta = poses[k].copy()
        theta[tube_rig.root] = 0.0
        (scan,) = lbs.synthesize(tube_rig, poses=[theta], random_state=k, n_points=500, shape=0.0, holes=0)
        problem = Problem(scan.points / half)
        true = Model(tube_rig).rest().replace(theta=scan.pose, translation=scan.translation / half)
        wrong = true.replace(theta=np.where(np.arange(len(theta))[:, None] == 2, tube_rig.lower, scan.pose))
        alone = refit.polish(problem, wrong)
        _, noise = refit.told_angles(problem, alone)
        found = drawn(refit, problem, alone, prior, noise)
        away = [np.abs(s.theta - scan.pose)[1:].max() for s in (alone, found)]
        homes += 1
        plain_home += away[0] < 0.15
        drawn_home += away[1] < 0.15
        again = drawn(refit, problem, found, prior, noise)
        np.testing.assert_allclose(again.theta, found.theta, atol=0.02)
    assert drawn_home == homes
    assert plain_home <= homes - 2


@pytest.mark.parametrize("gain, taken", [(-1.0, False), (2.9, False), (3.1, True)])
def test_an_unusual_joint_stays_unless_another_place_is_clearly_better(gain, taken):
    """By more than 3 σ²/n; what is tried is not believed because it is usual."""
    _, poses, told, *_ = _made(400, 5, np.array([0.01, 0.01, 0.01]))
    prior, noise = pose_prior(poses, told, TURNING, ROOT), 0.01
    theta = prior.mean.copy()
    theta[2, 1] += 0.5

    class Pose:
        def __init__(self, theta):
            self.theta = theta

        def replace(self, *, theta):
            return Pose(theta)

    class Steps:
        turning = TURNING

        def to_the_end(self, problem, state, *, prior):
            return state, 1.0 if state is began else 1.0 - gain * noise

    began = Pose(theta)
    assert (drawn(Steps(), None, began, prior, noise) is not began) == taken
