"""Natural poses for a rig: hand poses and motion capture turned into Θ."""

import logging

import numpy as np

from ..errors import InputError
from ..io.handpose import WEBXR_JOINTS
from ..rig.frames import AXES, up_axis
from ..rotations import matrix_from_rotvec, rotvec_from_matrix

__all__ = ["bvh_thetas", "handpose_theta", "limit_excess", "theta_from_globals", "theta_residual"]

_log = logging.getLogger(__name__)

# Bones whose rest direction is a matter of the pose (arms out or down, feet apart or together) and not of anatomy: joint and
# the child that its bone leads to. Trunk, hips, collar bones and head keep the rig's own shape at the motion's rest.
_LIMBS = {
    f"{side}{bone}": f"{side}{child}"
    for side in ("Left", "Right")
    for bone, child in (
        ("Arm", "ForeArm"),
        ("ForeArm", "Hand"),
        ("UpLeg", "Leg"),
        ("Leg", "Foot"),
    )
}


def theta_from_globals(rig, G):
    """Θ that gives each joint a wanted global rotation: A_j = A_parent exp([F_j θ_j]×) solved for θ_j, from the root down.

    Joints that cannot move (locked, merged, no room between their limits) take their parent's rotation; their children still
    reach the wanted one. Limits are not enforced, neither whole joints' nor single axes'.

    Parameters
    ----------
    rig : Rig
    G : (..., J, 3, 3) array
        Wanted global rotations relative to the rest orientation, in the rig's frame; rows of unmoving joints are not read.

    Returns
    -------
    (..., J, 3) array
        Rotation vectors in the rest frames; zero rows for joints that cannot move. See :func:`theta_residual` for what is lost.
    """
    G = np.asarray(G, dtype=float)
    A = G.copy()
    local = G.copy()  # the root's is its global rotation
    for level, up in rig.levels:
        moving = rig.moving[level][:, None, None]
        A[..., level, :, :] = np.where(moving, G[..., level, :, :], A[..., up, :, :])
        local[..., level, :, :] = np.swapaxes(A[..., up, :, :], -1, -2) @ A[..., level, :, :]
    theta = np.einsum("jba,...jb->...ja", rig.frames, rotvec_from_matrix(local))
    return np.where(rig.moving[:, None], theta, 0.0)


def theta_residual(rig, theta, G):
    """Angle between each joint's global rotation under Θ and the wanted one, (J,) radians; see :func:`theta_from_globals`."""
    A = matrix_from_rotvec(np.einsum("jab,jb->ja", rig.frames, theta))
    for level, up in rig.levels:
        A[level] = A[up] @ A[level]
    return np.linalg.norm(rotvec_from_matrix(np.swapaxes(A, 1, 2) @ G), axis=1)


def limit_excess(rig, theta):
    """By how much Θ is outside the rig's limits, (..., J, 3) radians: 0 inside, positive above, negative below; 0 at the root."""
    excess = np.maximum(theta - rig.upper, 0.0) + np.minimum(theta - rig.lower, 0.0)
    excess[..., rig.root, :] = 0.0
    return excess


def handpose_theta(rig, matrices):
    """Θ of a WebXR hand rig for a pose of :func:`lbsfit_np.io.handpose.read_handpose`.

    The joints' frames are those of the WebXR specification in the pose and in the rig alike, so orientations carry over as they
    are, whatever the proportions of the two hands: with T_wrist_joint = [Q | t] and the rest frames F, A_j = F_wrist Q_j F_jᵀ.

    Parameters
    ----------
    rig : Rig
        With the 25 joint names of the specification, rest frames from its inverse bind matrices, and the wrist as its root.
    matrices : (25, 4, 4) array
        T_wrist_joint in the order of ``WEBXR_JOINTS``.

    Returns
    -------
    (J, 3) array
        The wrist's row is 0. Angles beyond the rig's limits are kept, and logged (see :func:`limit_excess`).
    """
    G = np.broadcast_to(np.eye(3), (len(rig.parents), 3, 3)).copy()
    row = _rows(rig, WEBXR_JOINTS)
    wrist = rig.frames[row["wrist"]]
    for name, T in zip(WEBXR_JOINTS, matrices, strict=True):
        j = row[name]
        G[j] = wrist @ T[:3, :3] @ rig.frames[j].T
    theta = theta_from_globals(rig, G)
    excess = np.abs(limit_excess(rig, theta))
    if excess.max() > 0:
        j, axis = np.unravel_index(excess.argmax(), excess.shape)
        outside = int((excess.max(axis=1) > 0).sum())
        _log.info(
            "%d joints outside the limits, most %s about %s by %.2f rad", outside, rig.joint_names[j], "xyz"[axis], excess.max()
        )
    return theta


def bvh_thetas(rig, motion, frames=None, *, face_forward=False):
    """Θ of a body rig for frames of a motion whose skeleton has the rig's joint names.

    The two rest poses differ (arms out in the motion's, hanging in the rig's), so that rotations alone would pose the limbs
    wrongly. Each limb joint j gets a constant correction C_j, the least rotation after its parent's that turns its bone from the
    rig's rest direction d_j to the motion's b_j; other joints take their parent's correction (the identity at the root):

        C_j = turn(C_parent d_j → b_j) C_parent,   A_j(t) = Q_j(t) C_j,

    with Q_j(t) the motion's global rotations. Posed limbs then point exactly where the motion's do. Joints without a namesake in
    the motion take their parent's rotation.

    Parameters
    ----------
    rig : Rig
        Where its up and forward axes are unknown, they are taken for the motion's: +y and +z.
    motion : Motion
    frames : sequence of int, optional
        Rows of the motion; all by default.
    face_forward : bool, default False
        Remove the root's turn about the up axis from each frame, so that the body faces the rig's forward axis. By default the
        body faces where the motion does.

    Returns
    -------
    (T, J, 3) array
        Rotation vectors in the rest frames, the root's included; not clipped to the limits. The root's translation is left out.
    """
    row = {name: k for k, name in enumerate(motion.joint_names)}
    shared = np.array([row.get(name, -1) for name in rig.joint_names])
    if shared[rig.root] != 0:
        raise InputError(
            "motion",
            f"a skeleton whose root is {motion.joint_names[0]}",
            f"the rig's root, {rig.joint_names[rig.root]}",
            "Rig and motion are matched by the names of their joints.",
        )
    local = motion.rotations if frames is None else motion.rotations[np.asarray(frames)]
    Q = local.copy()
    for k in range(1, len(motion.parents)):  # parents stand before their children
        Q[:, k] = Q[:, motion.parents[k]] @ Q[:, k]
    C = _corrections(rig, motion, row)
    basis = _rig_basis(rig)
    G = basis @ Q[:, shared] @ basis.T @ C
    for level, up in rig.levels:
        nameless = shared[level] < 0
        G[:, level[nameless]] = G[:, up[nameless]]
    if face_forward:
        G = _turn_back(G[:, rig.root], basis)[:, None] @ G
    return theta_from_globals(rig, G)


def _corrections(rig, motion, row):
    """(J, 3, 3) C_j, in the rig's frame."""
    basis = _rig_basis(rig)
    joint = {name: j for j, name in enumerate(rig.joint_names)}
    C = np.broadcast_to(np.eye(3), (len(rig.parents), 3, 3)).copy()
    for level, up in rig.levels:
        C[level] = C[up]
        for j in level:
            name = rig.joint_names[j]
            child = _LIMBS.get(name)
            if child not in joint or child not in row or name not in row:
                continue
            bone = C[j] @ (rig.joints[joint[child]] - rig.joints[j])
            C[j] = _least_turn(bone, basis @ _rest_offset(motion, row[name], row[child])) @ C[j]
    return C


def _rest_offset(motion, ancestor, k):
    offset = np.zeros(3)
    while k != ancestor:
        offset = offset + motion.offsets[k]
        k = motion.parents[k]
    return offset


def _least_turn(a, b):
    """The rotation by the least angle that turns the direction of a to that of b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis), a @ b
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return matrix_from_rotvec(np.pi * axis / np.linalg.norm(axis))
    return matrix_from_rotvec(np.arctan2(sine, cosine) * axis / sine)


def _rig_basis(rig):
    """Rotation from the motion's axes (y up, facing +z) to the rig's."""
    up, forward = up_axis(rig), np.array(AXES[rig.forward or "+z"])
    return np.column_stack([np.cross(up, forward), up, forward])


def _turn_back(root, basis):
    """(T, 3, 3) turns about the up axis that bring the root's forward direction back to the rig's; root (T, 3, 3)."""
    facing = root @ basis[:, 2] @ basis
    return matrix_from_rotvec(-np.arctan2(facing[:, 0], facing[:, 2])[:, None] * basis[:, 1])


def _rows(rig, names):
    row = {name: j for j, name in enumerate(rig.joint_names)}
    missing = [n for n in names if n not in row]
    if missing:
        raise InputError("rig", f"no joint {', '.join(missing[:3])}", "a rig with the joint names of the WebXR hand")
    return row
