"""Poses in SMPL's and MANO's convention, for rigs with their joints but another rest pose and other axes.

Both pose each joint by a rotation relative to its parent, SMPL with frames that are parallel to the world's in its own rest pose.
With A_j the rotation from this rig's rest pose to SMPL's (``smpl_rest``) and G_j the global rotations of a pose, SMPL's global
rotations are W_j = G_j A_jᵀ, and what it calls the pose are the rotation vectors of W_parentᵀ W_j.
"""

import numpy as np

from ..errors import InputError, as_array, check_angles
from ..rotations import matrix_from_rotvec, rotvec_from_matrix

__all__ = ["from_smpl_pose", "to_smpl_pose"]


def to_smpl_pose(rig, theta):
    """``Rig.to_smpl_pose``."""
    _check(rig)
    theta = check_angles("theta", theta, rig.lower.shape)
    local = matrix_from_rotvec(np.einsum("jab,jb->ja", rig.frames, theta))
    return rotvec_from_matrix(_to_local(rig, _to_global(rig, local) @ np.swapaxes(rig.smpl_rest, 1, 2)))


def from_smpl_pose(rig, pose):
    """``Rig.from_smpl_pose``."""
    _check(rig)
    J = len(rig.parents)
    shape = as_array("pose", pose, f"shape ({J}, 3) or ({3 * J},)").shape
    if shape not in ((J, 3), (3 * J,)):
        raise InputError("pose", f"shape {shape}", f"shape ({J}, 3) or ({3 * J},)")
    pose = check_angles("pose", pose, shape).reshape(J, 3)
    G = _to_global(rig, matrix_from_rotvec(pose)) @ rig.smpl_rest
    return np.einsum("jab,ja->jb", rig.frames, rotvec_from_matrix(_to_local(rig, G)))


def _to_global(rig, local):
    out = local.copy()
    for level, up in rig.levels:
        out[level] = out[up] @ local[level]
    return out


def _to_local(rig, rotations):
    out = rotations.copy()
    for level, up in rig.levels:
        out[level] = np.swapaxes(rotations[up], 1, 2) @ rotations[level]
    return out


def _check(rig):
    if rig.smpl_rest is None:
        raise InputError(
            "rig",
            f"{rig.name!r}, which does not say how its rest pose relates to SMPL's or MANO's (smpl_rest)",
            "a rig with SMPL's or MANO's joints that has smpl_rest",
            "The bundled rigs body, hand and hand-left have it, and so have their coarse levels.",
        )
