"""The prior of poses: found again from made ones, and poses drawn to it no further than their own scans leave them open."""

import numpy as np
import pytest

from lbsfit_np.learning.pose_prior import joined, looked_at, pose_prior

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


@pytest.mark.parametrize("n, most", [(300, 0.6), (12, 0.85)])
def test_poses_drawn_to_it_are_nearer_to_the_true_ones(n, most):
    """An angle that is told to 0.3 rad and varies by 0.2 and less; one that its scan tells stays where it was found."""
    noise = np.array([0.3, 0.004, 0.3])
    before, after, moved = [], [], []
    for seed in range(8):
        own, poses, told, *_ = _made(n, seed, noise)
        prior = pose_prior(poses, told, TURNING, ROOT)
        mean, weights = prior.of(1.0)
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


def test_two_priors_in_one_are_their_sum_but_for_a_constant():
    rng = np.random.default_rng(4)
    A = rng.standard_normal((6, 6))
    one = rng.standard_normal(TURNING.shape), A @ A.T
    one[1][:3] = one[1][:, :3] = 0.0  # the root's
    other = rng.standard_normal(TURNING.shape), 0.7
    both = joined(one, other, TURNING)

    def value(prior, theta):
        away = (theta - prior[0])[TURNING]
        return away @ (prior[1] if np.ndim(prior[1]) else prior[1] * np.eye(6)) @ away

    poses = rng.standard_normal((5, *TURNING.shape))
    differences = [value(both, theta) - value(one, theta) - value(other, theta) for theta in poses]
    np.testing.assert_allclose(differences, differences[0])
    np.testing.assert_allclose(both[0][ROOT], other[0][ROOT])
    assert joined(None, other, TURNING) is other and joined(one, None, TURNING) is one
