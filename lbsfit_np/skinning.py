"""Linear blend skinning M(Θ, U) and its adjoint.

With parents K, joint positions J and rest frames F_j (columns are the joint's axes):

    R_j = exp([F_j θ_j]×),   A_j = A_parent(j) R_j,   P_j = P_parent(j) + A_parent(j) (J_j − J_parent(j)),
    m_i = u_i + Σ_j w_ij ((A_j − I) u_i + P_j − A_j J_j),   v_i = scale · m_i + translation.

Written as a displacement from the rest pose, Θ = 0 gives U back to the last bit, whatever the rounding of the weights.
With ``joints="follow"`` the joint positions are J + R (U^d − U), R the rig's joint regressor; with ``"fixed"`` they stay J.
"""

from dataclasses import dataclass

import numpy as np

from .errors import InputError, brief, check_array
from .rotations import left_jacobian, matrix_from_rotvec

__all__ = ["JOINT_MODES", "Posed", "skin", "skin_adjoint"]

JOINT_MODES = ("follow", "fixed")

_I = np.eye(3)


@dataclass(frozen=True)
class Posed:
    """A posed template, with what the adjoint needs.

    Attributes
    ----------
    vertices : (m, 3) array
        scale · M(Θ, U + offsets) + translation.
    joints : (J, 3) array
        Posed joint positions, in the same frame.
    """

    vertices: np.ndarray
    joints: np.ndarray
    rig: object
    scale: float
    follow: bool
    omega: np.ndarray  # (J, 3) F θ
    R: np.ndarray  # (J, 3, 3) local rotations
    A: np.ndarray  # (J, 3, 3) global rotations
    rest: np.ndarray  # (m, 3) U + offsets
    rest_joints: np.ndarray  # (J, 3)
    unscaled: np.ndarray  # (m, 3) M(Θ, U + offsets)
    unscaled_joints: np.ndarray  # (J, 3)
    blended: np.ndarray  # (m, 12) Σ_j w_ij [A_j − I | P_j − A_j J_j]

    def turns(self, rows=slice(None)):
        """(k, 3, 3) Σ_j w_ij A_j of vertices, by which what hangs on the skin turns, such as normals."""
        return self.blended[rows, :9].reshape(-1, 3, 3) + _I


def skin(rig, theta, *, translation=None, scale=1.0, offsets=None, joint_offsets=None, joints="follow"):
    """Pose the template: vertices = scale · M(Θ, U + offsets) + translation.

    Parameters
    ----------
    rig : Rig
    theta : (J, 3) array
        Rotation vectors in the joints' rest frames, radians.
    translation : (3,) array, optional
        In the posed frame's unit; default 0.
    scale : float, default 1
    offsets : (m, 3) array, optional
        Template offsets U^d − U in rig units; default 0.
    joint_offsets : (J, 3) array, optional
        Where the caller knows how the joints move with the template; then the regressor is not asked.
    joints : {"follow", "fixed"}, default "follow"
        Whether joints move with a changed template (J = R U^d) or keep the rig's positions, as in the paper.

    Returns
    -------
    Posed
        Not validated: arrays are trusted. ``Rig.pose`` is the checked door.
    """
    if not isinstance(joints, str) or joints not in JOINT_MODES:  # which would pass for "fixed"
        remedy = "Give rest positions of your own as joint_offsets: what they have moved by from rig.joints."
        got = brief(joints) if isinstance(joints, str) else f"a {type(joints).__name__}"
        raise InputError("joints", got, " or ".join(map(repr, JOINT_MODES)), remedy)
    J = len(rig.parents)
    follow = joints == "follow" and joint_offsets is None
    rest, rest_joints = rig.vertices, rig.joints
    if joint_offsets is not None:
        rest_joints = rest_joints + joint_offsets
    if offsets is not None:
        rest = rest + offsets
        if follow:
            rest_joints = rest_joints + rig.regressor @ offsets
    omega = np.einsum("jab,jb->ja", rig.frames, theta)
    R = matrix_from_rotvec(omega)
    A, shift = np.empty((J, 3, 3)), np.zeros((J, 3))  # shift: posed minus rest joint positions, exactly 0 at rest
    A[rig.root] = R[rig.root]
    for level, up in rig.levels:
        A[level] = A[up] @ R[level]
        shift[level] = shift[up] + np.einsum("jab,jb->ja", A[up] - _I, rest_joints[level] - rest_joints[up])
    turned = A - _I
    moved = np.empty((J, 12))
    moved[:, :9] = turned.reshape(J, 9)
    moved[:, 9:] = shift - np.einsum("jab,jb->ja", turned, rest_joints)
    blended = rig.weights @ moved
    m = rest + np.einsum("iab,ib->ia", blended[:, :9].reshape(-1, 3, 3), rest) + blended[:, 9:]
    t = 0.0 if translation is None else np.asarray(translation, dtype=float)
    unscaled = rest_joints + shift
    vertices, posed_joints = scale * m + t, scale * unscaled + t
    return Posed(vertices, posed_joints, rig, float(scale), follow, omega, R, A, rest, rest_joints, m, unscaled, blended)


@dataclass(frozen=True)
class SkinGradient:
    """Gradients of a scalar to the arguments of :func:`skin`."""

    theta: np.ndarray  # (J, 3)
    translation: np.ndarray  # (3,)
    scale: float
    vertices: np.ndarray  # (m, 3), to U + offsets with the rest joints held
    rest_joints: np.ndarray  # (J, 3), to the rest joint positions
    offsets: np.ndarray  # (m, 3), to the offsets, through the joint regressor too where joints follow


def skin_adjoint(posed, grad_vertices, grad_joints=None):
    """Gradients of a scalar loss to Θ, translation, scale and offsets, from its gradient to the posed vertices.

    Parameters
    ----------
    posed : Posed
        What :func:`skin` returned.
    grad_vertices : (m, 3) array
        ∂loss/∂vertices; it may be a list, or a tensor.
    grad_joints : (J, 3) array, optional
        ∂loss/∂(posed joints), where the loss looks at joints too.

    Returns
    -------
    SkinGradient
        The transpose of the Jacobian of :func:`skin`, applied; the path of offsets through the joint positions included.

    Raises
    ------
    InputError
        Gradients of another shape.
    """
    rig, A, R, rest, rest_joints = posed.rig, posed.A, posed.R, posed.rest, posed.rest_joints
    J, m = len(A), len(rest)
    # They need not be finite: a search may try what overflows.
    grad_vertices = check_array("grad_vertices", grad_vertices, (m, 3), finite=False)
    grad_joints = None if grad_joints is None else check_array("grad_joints", grad_joints, (J, 3), finite=False)
    g_scale = float(np.vdot(grad_vertices, posed.unscaled))
    g_translation = grad_vertices.sum(axis=0)
    g = posed.scale * grad_vertices

    outer = np.empty((m, 12))
    outer[:, :9] = (g[:, :, None] * rest[:, None, :]).reshape(m, 9)
    outer[:, 9:] = g
    g_moved = rig.weights_transposed @ outer
    g_b = g_moved[:, 9:]
    g_A = g_moved[:, :9].reshape(J, 3, 3) - g_b[:, :, None] * rest_joints[:, None, :]
    g_P = g_b.copy()
    g_rest_joints = -np.einsum("jab,ja->jb", A, g_b)
    if grad_joints is not None:
        g_scale += float(np.vdot(grad_joints, posed.unscaled_joints))
        g_translation = g_translation + grad_joints.sum(axis=0)
        g_P += posed.scale * grad_joints

    g_R = np.empty_like(g_A)
    for level, up in reversed(rig.levels):
        g_R[level] = np.swapaxes(A[up], 1, 2) @ g_A[level]
        bone = rest_joints[level] - rest_joints[up]
        to_bone = np.einsum("jab,ja->jb", A[up], g_P[level])
        g_rest_joints[level] += to_bone
        np.add.at(g_rest_joints, up, -to_bone)
        np.add.at(g_P, up, g_P[level])
        np.add.at(g_A, up, g_A[level] @ np.swapaxes(R[level], 1, 2) + g_P[level][:, :, None] * bone[:, None, :])
    g_R[rig.root] = g_A[rig.root]
    g_rest_joints[rig.root] += g_P[rig.root]

    S = g_R @ np.swapaxes(R, 1, 2)
    axial = np.stack([S[:, 2, 1] - S[:, 1, 2], S[:, 0, 2] - S[:, 2, 0], S[:, 1, 0] - S[:, 0, 1]], axis=1)
    g_omega = np.einsum("jab,ja->jb", left_jacobian(posed.omega), axial)
    g_theta = np.einsum("jab,ja->jb", rig.frames, g_omega)

    g_rest = g + np.einsum("iab,ia->ib", posed.blended[:, :9].reshape(m, 3, 3), g)
    g_offsets = g_rest + rig.regressor_transposed @ g_rest_joints if posed.follow else g_rest
    return SkinGradient(g_theta, g_translation, g_scale, g_rest, g_rest_joints, g_offsets)
