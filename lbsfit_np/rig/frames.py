"""Rest frames from bones: for rigs whose files say where the bones lie, but not about which axes they turn."""

import numpy as np

__all__ = ["AXES", "bone_directions", "bone_frames", "child_directions", "frames_along", "up_axis"]

# The names that files, cards and rigs use for directions.
AXES = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}

# Bones that point forward more than this (a cosine) take their third axis from the up direction: feet, muzzles.
_FORWARD = 0.8


def up_axis(rig):
    """Unit vector of a rig's up direction, (3,); y where the rig does not say."""
    return np.array(AXES[rig.up or "+y"])


def bone_frames(directions, up, forward):
    """Frames that make limits per axis mean something: y along the bone, z towards the front, x = y × z across.

    A turn about x bends the limb forward or back (flexion), about y twists it, about z swings it sideways. Left and right
    limbs of a symmetric rig get mirrored frames: the same x angle bends both alike; y and z angles have opposite signs.

    Parameters
    ----------
    directions : (J, 3) array
        Along the bones, any length but 0.
    up, forward : str
        The rig's axes, such as "+y", "+z".

    Returns
    -------
    (J, 3, 3) array
        Columns are the axes. z is the part of ``forward`` across the bone; for bones that point within 37° of the forward
        axis, of ``up``.
    """
    directions = np.asarray(directions, dtype=float)
    y = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    forward, up = np.array(AXES[forward]), np.array(AXES[up])
    reference = np.where(np.abs(y @ forward)[:, None] > _FORWARD, up, forward)
    z = reference - np.einsum("ja,ja->j", reference, y)[:, None] * y
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=2)


def frames_along(bones, joints, parents, up, forward):
    """Frames of a skeleton along its bones, those of roots the rig's: the whole turns about the up axis and leans to its sides.

    Parameters
    ----------
    bones : (J, 3) array
        Along the bones, of any length; 0 to go by the children.
    joints : (J, 3) array
    parents : (J,) int array
    up, forward : str

    Returns
    -------
    (J, 3, 3) array
        As of :func:`bone_frames`.
    """
    frames = bone_frames(bone_directions(bones, joints, parents), up, forward)
    frames[parents < 0] = np.eye(3)
    return frames


def bone_directions(bones, joints, parents):
    """(J, 3), of any length but 0: along the bones where these are known, as for :func:`frames_along`, else to the children."""
    by_children = child_directions(joints, parents)
    if bones is None:
        return by_children
    long_enough = np.linalg.norm(bones, axis=1) > 1e-6 * max(float(np.ptp(joints, axis=0).max()), 1e-30)
    return np.where(long_enough[:, None], bones, by_children)


def child_directions(joints, parents):
    """Where each joint's bone points: to the mean of its children; a tip goes on as its parent's bone does.

    Returns
    -------
    (J, 3) array
        Unit vectors; (0, 1, 0) for a joint that stands alone.
    """
    J = len(parents)
    sums = np.zeros((J, 3))
    has = parents >= 0
    np.add.at(sums, parents[has], joints[has] - joints[parents[has]])
    size = max(float(np.ptp(joints, axis=0).max()), np.finfo(float).tiny)
    out = np.zeros((J, 3))
    for j in range(J):
        k = j
        while np.linalg.norm(sums[k]) <= 1e-6 * size and parents[k] >= 0:
            k = parents[k]
        bone = sums[k] if np.linalg.norm(sums[k]) > 1e-6 * size else np.array([0.0, 1.0, 0.0])
        out[j] = bone / np.linalg.norm(bone)
    return out
