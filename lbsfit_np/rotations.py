"""Rotation vectors: the exponential map, its inverse, and the left Jacobian that its gradient needs."""

import numpy as np

__all__ = [
    "angle_between",
    "cross_matrix",
    "left_jacobian",
    "matrix_from_quaternion",
    "matrix_from_rotvec",
    "nearest_rotvec",
    "rotvec_from_matrix",
]

# Below this squared angle the Taylor series is exact to the last bit of a double, and the closed form is not.
_SERIES = 1e-4


def cross_matrix(v):
    """The matrices [v]× with [v]× x = v × x; (..., 3) → (..., 3, 3)."""
    v = np.asarray(v, dtype=float)
    out = np.zeros(v.shape + (3,))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _coefficients(omega):
    """sin φ / φ, (1 − cos φ) / φ² and (φ − sin φ) / φ³ for φ = ‖ω‖, each (..., 1, 1)."""
    t = np.einsum("...i,...i->...", omega, omega)[..., None, None]
    small = t < _SERIES
    safe = np.where(small, 1.0, t)
    phi = np.sqrt(safe)
    sine, cosine = np.sin(phi), np.cos(phi)
    a = np.where(small, 1 - t / 6 * (1 - t / 20 * (1 - t / 42)), sine / phi)
    b = np.where(small, 0.5 - t / 24 * (1 - t / 30 * (1 - t / 56)), (1 - cosine) / safe)
    c = np.where(small, 1 / 6 - t / 120 * (1 - t / 42 * (1 - t / 72)), (phi - sine) / (safe * phi))
    return a, b, c


def matrix_from_rotvec(omega):
    """Rodrigues' formula: rotation matrices of rotation vectors, exactly I at 0.

    Parameters
    ----------
    omega : (..., 3) array
        Rotation vectors, radians.

    Returns
    -------
    (..., 3, 3) array
        R = I + (sin φ/φ) [ω]× + ((1 − cos φ)/φ²) [ω]×².
    """
    omega = np.asarray(omega, dtype=float)
    a, b, _ = _coefficients(omega)
    K = cross_matrix(omega)
    return np.eye(3) + a * K + b * (K @ K)


def left_jacobian(omega):
    """The left Jacobian J of SO(3): exp([ω + δ]×) ≈ exp([J δ]×) exp([ω]×).

    Parameters
    ----------
    omega : (..., 3) array
        Rotation vectors, radians.

    Returns
    -------
    (..., 3, 3) array
        J = I + ((1 − cos φ)/φ²) [ω]× + ((φ − sin φ)/φ³) [ω]×².
    """
    omega = np.asarray(omega, dtype=float)
    _, b, c = _coefficients(omega)
    K = cross_matrix(omega)
    return np.eye(3) + b * K + c * (K @ K)


def rotvec_from_matrix(R):
    """Rotation vectors of rotation matrices, angles in [0, π]; (..., 3, 3) → (..., 3)."""
    from scipy.spatial.transform import Rotation

    R = np.asarray(R, dtype=float)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def matrix_from_quaternion(x, y, z, w):
    """Rotation matrices (..., 3, 3) of unit quaternions x i + y j + z k + w, each an array (...)."""
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angle_between(R, other):
    """The angle of the rotation from one rotation matrix (3, 3) to another, radians."""
    return float(np.arccos(np.clip((np.trace(R.T @ other) - 1.0) / 2.0, -1.0, 1.0)))


def nearest_rotvec(omega, other):
    """The rotation vectors of the same rotations, whole turns more or fewer, that lie nearest to others.

    Parameters
    ----------
    omega, other : (..., 3) arrays
        Radians. 0 has no axis to turn about and stays.

    Returns
    -------
    (..., 3) array
        ω (1 + 2πk/‖ω‖) with whole k; ω itself where that is the nearest.
    """
    omega = np.asarray(omega, dtype=float)
    angle = np.linalg.norm(omega, axis=-1, keepdims=True)
    safe = np.where(angle > 0, angle, 1.0)
    along = np.sum(omega * other, axis=-1, keepdims=True) / safe
    turns = np.where(angle > 0, np.rint((along - angle) / (2 * np.pi)), 0.0)
    return omega * (1.0 + 2 * np.pi * turns / safe)
