"""Rotation vectors: the exponential map and its left Jacobian, at every angle that a joint can take."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lbsfit_np.rotations import (
    angle_between,
    cross_matrix,
    left_jacobian,
    matrix_from_quaternion,
    matrix_from_rotvec,
    nearest_rotvec,
    rotvec_from_matrix,
)

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-3, 9.999e-3, 1.0001e-2, 0.1, 1.0, 2.5, np.pi - 1e-6, np.pi, np.pi + 1e-6, 6.0, 9.0]


def _vectors(angle, n=20):
    d = np.random.default_rng(3).standard_normal((n, 3))
    d = np.concatenate([d, np.eye(3), -np.eye(3)])
    return angle * d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
def test_the_exponential_is_scipys(angle):
    omega = _vectors(angle)
    np.testing.assert_allclose(matrix_from_rotvec(omega), Rotation.from_rotvec(omega).as_matrix(), rtol=0, atol=4e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_matrices_are_rotations(angle):
    R = matrix_from_rotvec(_vectors(angle))
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=4e-15)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=4e-15)


def test_zero_gives_exactly_the_identity():
    for zero in (np.zeros(3), np.full(3, -0.0), np.zeros((4, 2, 3))):
        R = matrix_from_rotvec(zero)
        assert R.shape == zero.shape + (3,)
        assert (R == np.eye(3)).all()
        assert (left_jacobian(zero) == np.eye(3)).all()


def test_small_angles_keep_their_relative_precision():
    """A series, not a guarded division: the rotation by 1e-9 rad differs from I by 1e-9, to all digits."""
    omega = _vectors(1e-9)
    first_order = matrix_from_rotvec(omega) - np.eye(3)
    np.testing.assert_allclose(first_order - np.swapaxes(first_order, 1, 2), 2 * cross_matrix(omega), rtol=1e-14, atol=1e-24)


def test_cross_matrix_is_the_cross_product():
    rng = np.random.default_rng(0)
    v, x = rng.standard_normal((2, 5, 3))
    np.testing.assert_allclose(np.einsum("nab,nb->na", cross_matrix(v), x), np.cross(v, x), atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_left_jacobian_by_finite_differences(angle):
    h = 1e-6
    for omega in _vectors(angle, 5):
        J = left_jacobian(omega)
        back = matrix_from_rotvec(omega).T
        for k in range(3):
            step = h * np.eye(3)[k]
            twist = (matrix_from_rotvec(omega + step) - matrix_from_rotvec(omega - step)) / (2 * h) @ back
            np.testing.assert_allclose(twist, cross_matrix(J[:, k]), atol=3e-9)


def test_left_jacobian_is_continuous_where_the_series_takes_over():
    d = np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(left_jacobian(d * (0.01 - 1e-12)), left_jacobian(d * (0.01 + 1e-12)), rtol=0, atol=2e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-7])
def test_there_and_back(angle):
    omega = _vectors(angle)
    np.testing.assert_allclose(rotvec_from_matrix(matrix_from_rotvec(omega)), omega, atol=1e-8 if angle > 3.1 else 1e-14)
    assert rotvec_from_matrix(matrix_from_rotvec(omega.reshape(2, -1, 3))).shape == (2, len(omega) // 2, 3)


def test_the_nearest_of_the_vectors_of_a_rotation():
    rng = np.random.default_rng(5)
    omega, other = 4 * rng.standard_normal((200, 3)), 7 * rng.standard_normal((200, 3))
    nearest = nearest_rotvec(omega, other)
    np.testing.assert_allclose(matrix_from_rotvec(nearest), matrix_from_rotvec(omega), atol=1e-13)
    angle = np.linalg.norm(omega, axis=1, keepdims=True)
    ways = np.stack([omega * (1 + 2 * np.pi * k / angle) for k in range(-6, 7)])
    best = np.linalg.norm(ways - other, axis=2).min(axis=0)
    np.testing.assert_allclose(np.linalg.norm(nearest - other, axis=1), best, rtol=1e-12)
    assert np.array_equal(nearest_rotvec(omega, omega), omega) and not nearest_rotvec(np.zeros(3), other[0]).any()


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.8, 3.0, np.pi])
def test_the_angle_between_rotations_is_that_of_the_one_from_one_to_the_other(angle):
    first = matrix_from_rotvec(np.array([0.3, -1.0, 0.5]))
    other = first @ matrix_from_rotvec(angle * np.array([0.6, 0.0, -0.8]))
    assert angle_between(first, other) == pytest.approx(angle, abs=1e-7) == angle_between(other, first)


def test_matrices_of_quaternions_are_those_of_scipy():
    q = np.random.default_rng(0).standard_normal((2, 5, 4))
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    expected = Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(2, 5, 3, 3)
    np.testing.assert_allclose(matrix_from_quaternion(*np.moveaxis(q, -1, 0)), expected, atol=1e-12)
