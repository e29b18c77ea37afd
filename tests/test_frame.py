"""The normalised frame: in and out again, and poses of a turned whole."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.optimize.frame import Frame, root_turn, turned_root
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.synthesis import uniform_poses

TURNS = matrix_from_rotvec(np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [1.0, -2.0, 0.7], [0.0, np.pi, 0.0], [3.0, 0.4, -0.3]]))


@pytest.fixture(params=["tube", "hand-coarse", "body-coarse"])
def rig(request, tube_rig):
    return tube_rig if request.param == "tube" else lbs.load_rig(request.param)


@pytest.mark.parametrize("turn", TURNS)
def test_in_and_out_again(turn):
    rng = np.random.default_rng(0)
    frame, x = Frame(rng.uniform(-5, 5, 3), 12.5, turn), rng.uniform(-20, 20, (40, 3))
    X = frame.inside(x)
    np.testing.assert_allclose(frame.outside(X), x, atol=1e-12)
    np.testing.assert_allclose(frame.inside(frame.centre[None]), np.zeros((1, 3)), atol=1e-12)
    np.testing.assert_allclose(frame.outside(np.eye(3)) - frame.centre, 12.5 * turn.T, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(X[1:] - X[0], axis=1) * 12.5, np.linalg.norm(x[1:] - x[0], axis=1), atol=1e-12)


def test_by_default_a_scan_faces_the_rigs_way():
    frame, x = Frame(np.array([1.0, 2.0, 3.0]), 4.0), np.random.default_rng(0).uniform(-20, 20, (10, 3))
    np.testing.assert_array_equal(frame.turn, np.eye(3))
    np.testing.assert_allclose(frame.inside(x), (x - [1.0, 2.0, 3.0]) / 4.0, atol=1e-15)


@pytest.mark.parametrize("turn", TURNS)
def test_a_turned_root_is_the_rotated_mesh(rig, turn):
    """About the root joint, which stays where it is."""
    for k, theta in enumerate(uniform_poses(rig, 3, np.random.default_rng(1))):
        theta[rig.root] *= k  # the first one has none of its own
        turned = turned_root(rig, theta, turn)
        pivot = rig.joints[rig.root]
        np.testing.assert_allclose(rig.pose(turned), (rig.pose(theta) - pivot) @ turn.T + pivot, atol=1e-9 * rig.size)
        expected = (rig.pose_joints(theta) - pivot) @ turn.T + pivot
        np.testing.assert_allclose(rig.pose_joints(turned), expected, atol=1e-9 * rig.size)
        others = np.arange(len(theta)) != rig.root
        np.testing.assert_array_equal(turned[others], theta[others])


@pytest.mark.parametrize("turn", TURNS)
def test_the_roots_turn_is_told(rig, turn):
    theta = uniform_poses(rig, 1, np.random.default_rng(3))[0]
    theta[rig.root] = 0.0
    np.testing.assert_allclose(root_turn(rig, theta), np.eye(3), atol=1e-15)
    turned = turned_root(rig, theta, turn)
    np.testing.assert_allclose(root_turn(rig, turned), turn, atol=1e-12)
    np.testing.assert_allclose(turned_root(rig, turned, root_turn(rig, turned).T), theta, atol=1e-9)


def test_turning_there_and_back_is_nothing(rig):
    theta = uniform_poses(rig, 1, np.random.default_rng(2))[0]
    kept = theta.copy()
    for turn in TURNS:
        back = turned_root(rig, turned_root(rig, theta, turn), turn.T)
        np.testing.assert_allclose(rig.pose(back), rig.pose(theta), atol=1e-9 * rig.size)
    np.testing.assert_array_equal(theta, kept)  # the argument is as it was
