"""Natural poses of the bundled hand, written by hand as joint angles in degrees.

Fingers: (bend of the knuckle, of the middle joint, of the end joint, turn towards the thumb's side). Thumb: (flexion,
abduction, twist of its root; bend of its knuckle, of its end joint). Wrist: (flexion, towards the thumb's side, twist).
0 is the rest pose: flat with spread fingers.
"""

import numpy as np

__all__ = ["POSES", "pose_angles", "pose_library"]

STRAIGHT = (0, 0, 0)


def _pose(thumb=(0, 0, 0, 0, 0), wrist=(0, 0, 0), **fingers):
    return {"thumb": thumb, "wrist": wrist, **fingers}


def _with(base, **changes):
    return {**base, **changes}


_FIST = _pose(
    thumb=(18, 27, -11, 54, 53), index=(84, 100, 76, 3), middle=(86, 100, 76, 0), ring=(87, 100, 76, -5), pinky=(86, 98, 76, -10),
)

POSES = {
    "flat": _pose(
        thumb=(2, -14, 0, 0, 0), index=(*STRAIGHT, -9), middle=(*STRAIGHT, -1), ring=(*STRAIGHT, 6), pinky=(2, 2, 2, 12),
    ),
    "spread": _pose(
        thumb=(-10, 6, 0, -5, -5), index=(-5, 0, 0, 7), middle=(-5, 0, 0, -1), ring=(-5, 0, 0, -4), pinky=(-5, 0, 0, -6),
    ),
    "relaxed": _pose(
        thumb=(12, 2, -4, 15, 18), index=(22, 28, 15, -6), middle=(28, 33, 18, -1), ring=(32, 36, 20, 5), pinky=(34, 36, 20, 10),
    ),
    "resting": _pose(
        thumb=(8, -4, -2, 12, 10), index=(10, 18, 10, -7), middle=(12, 20, 12, -1), ring=(14, 22, 12, 5), pinky=(16, 22, 12, 11),
    ),
    "fist": _FIST,
    "loose fist": _pose(
        thumb=(16, 20, -6, 36, 36), index=(62, 80, 45, 0), middle=(66, 84, 46, 0), ring=(68, 84, 46, -2), pinky=(68, 80, 46, -5),
    ),
    "hook": _pose(
        thumb=(8, -6, 0, 10, 10), index=(4, 92, 58, -8), middle=(4, 95, 60, -1), ring=(4, 94, 60, 7), pinky=(6, 90, 58, 15),
    ),
    "tabletop": _pose(
        thumb=(6, -6, 0, 8, 8), index=(80, 4, 2, 0), middle=(82, 4, 2, 0), ring=(82, 4, 2, -5), pinky=(80, 4, 2, -9),
    ),
    "point": _with(_FIST, index=(2, 4, 2, -5), thumb=(18, 27, -11, 54, 53)),
    "one": _with(_FIST, index=(0, 2, 0, -1), thumb=(19, 26, -9, 54, 54)),
    "two": _with(_FIST, index=(0, 2, 0, 2), middle=(0, 2, 0, -6), thumb=(30, 28, -8, 54, 58)),
    "three": _with(_FIST, index=(0, 2, 0, 1), middle=(0, 2, 0, -1), ring=(4, 4, 2, 1), thumb=(38, 35, -14, 55, 40)),
    "four": _pose(thumb=(38, 12, -40, 54, 34), index=(0, 0, 0, 0), middle=(0, 0, 0, -1), ring=(0, 0, 0, 0), pinky=(0, 2, 0, 1)),
    "five": _pose(thumb=(-8, 2, 0, 0, -5), index=(0, 0, 0, 3), middle=(0, 0, 0, -1), ring=(0, 0, 0, -2), pinky=(0, 0, 0, -2)),
    "thumb and index": _with(_FIST, index=(0, 2, 0, 1), thumb=(-10, -2, 0, 0, -5)),
    "thumb, index, middle": _with(_FIST, index=(0, 2, 0, 2), middle=(0, 2, 0, -4), thumb=(-10, -2, 0, 0, -5)),
    "peace": _with(_FIST, index=(0, 2, 0, 6), middle=(0, 2, 0, -11), thumb=(30, 28, -8, 54, 58)),
    "thumbs-up": _with(_FIST, thumb=(-12, -16, 4, -5, -8)),
    "hitchhike": _with(_FIST, thumb=(-14, 10, 4, -8, -12), wrist=(0, 18, 0)),
    "pinch": _pose(
        thumb=(27, 24, -34, 9, 21), index=(49, 50, 28, -4), middle=(60, 62, 36, 0), ring=(64, 66, 38, -2), pinky=(66, 64, 38, -5),
    ),
    "ok": _pose(
        thumb=(28, 24, -35, 8, 21), index=(49, 49, 27, -4), middle=(20, 22, 10, -1), ring=(10, 14, 8, 0), pinky=(2, 8, 4, 0),
    ),
    "tip of middle": _pose(
        thumb=(36, 33, -32, 9, 19), index=(12, 20, 10, 1), middle=(51, 54, 30, 0), ring=(26, 30, 16, 1), pinky=(18, 22, 12, 4),
    ),
    "tip of ring": _pose(
        thumb=(42, 38, -32, 14, 18), index=(8, 14, 8, 1), middle=(24, 28, 14, 0), ring=(50, 51, 28, 3), pinky=(28, 32, 18, 6),
    ),
    "tip of little": _pose(
        thumb=(43, 39, -35, 27, 21), index=(6, 10, 6, 1), middle=(12, 16, 10, -1), ring=(32, 34, 18, 3), pinky=(52, 41, 23, 14),
    ),
    "tripod": _pose(
        thumb=(34, 31, -37, 6, 16), index=(58, 36, 20, -12), middle=(48, 54, 30, 7),
        ring=(66, 70, 40, -1), pinky=(68, 70, 40, -4),
    ),
    "key grip": _with(_FIST, index=(58, 72, 40, -4), thumb=(10, 2, -12, 28, 22)),
    "grasp cylinder": _pose(
        thumb=(14, 26, -16, 16, 22), index=(38, 48, 28, -5), middle=(42, 50, 30, 0), ring=(44, 50, 30, 5), pinky=(46, 48, 30, 11),
    ),
    "grasp bar": _pose(
        thumb=(26, 26, -20, 24, 30), index=(60, 72, 40, 0), middle=(64, 74, 42, 0), ring=(66, 74, 42, -2), pinky=(66, 72, 40, -5),
    ),
    "grasp ball": _pose(
        thumb=(6, 28, -16, 12, 20), index=(28, 34, 20, 5), middle=(30, 36, 22, -1), ring=(30, 36, 22, -3), pinky=(32, 34, 22, -4),
    ),
    "grasp disk": _pose(
        thumb=(-2, 16, -10, 12, 26), index=(16, 36, 24, 7), middle=(16, 38, 26, -1),
        ring=(18, 38, 26, -4), pinky=(20, 36, 24, -6),
    ),
    "claw": _pose(
        thumb=(2, 14, -8, 12, 40), index=(-12, 62, 42, 3), middle=(-12, 64, 44, -1),
        ring=(-12, 64, 44, -2), pinky=(-10, 60, 42, -2),
    ),
    "crossed fingers": _with(_FIST, index=(12, 8, 4, -18), middle=(-4, 14, 8, 8), thumb=(30, 28, -8, 54, 58)),
    "horns": _with(_FIST, index=(0, 2, 0, 1), pinky=(2, 4, 2, 4), thumb=(19, 26, -9, 54, 54)),
    "i love you": _with(_FIST, index=(0, 2, 0, 3), pinky=(0, 4, 2, 0), thumb=(-10, 2, 0, 0, -5)),
    "shaka": _with(_FIST, pinky=(0, 4, 2, -4), thumb=(-12, 4, 0, 0, -10)),
    "little finger": _with(_FIST, pinky=(0, 4, 2, 8), thumb=(19, 26, -9, 54, 54)),
    "vulcan": _pose(thumb=(-6, 0, 0, 0, 0), index=(0, 0, 0, -1), middle=(0, 0, 0, 7), ring=(0, 0, 0, -7), pinky=(0, 0, 0, 3)),
    "gun": _with(_FIST, index=(2, 2, 0, -5), middle=(4, 2, 0, 1), thumb=(-12, -10, 2, 0, -5)),
    "beak": _pose(
        thumb=(36, 33, -34, 7, 10), index=(54, 26, 12, -3), middle=(58, 26, 12, 0), ring=(58, 26, 12, 2), pinky=(58, 26, 12, 4),
    ),
    "cupped": _pose(
        thumb=(10, -8, -6, 12, 8), index=(26, 20, 12, -5), middle=(28, 22, 12, -1), ring=(30, 22, 12, 4), pinky=(34, 22, 12, 8),
    ),
    "wave back": _pose(
        thumb=(-8, 0, 0, 0, -5), index=(-14, 0, 0, 2), middle=(-14, 0, 0, -1),
        ring=(-14, 0, 0, -2), pinky=(-14, 0, 0, -3), wrist=(-24, 0, 0),
    ),
    "typing": _pose(
        thumb=(6, 8, -6, 8, 10), index=(24, 42, 20, 1), middle=(26, 46, 22, -1),
        ring=(26, 44, 22, 0), pinky=(22, 38, 20, 0), wrist=(-18, 0, 0),
    ),
}


def pose_angles(pose, joint_names):
    """Rotation vectors of one pose.

    Parameters
    ----------
    pose : dict
        A value of ``POSES``.
    joint_names : sequence of str
        The rig's joints: "wrist", "index1", ….

    Returns
    -------
    (J, 3) array, radians
    """
    theta = np.zeros((len(joint_names), 3))
    for part, angles in pose.items():
        if part == "wrist":
            theta[joint_names.index("wrist")] = angles
            continue
        first = joint_names.index(f"{part}1")
        if part == "thumb":
            theta[first] = angles[:3]
            theta[first + 1 : first + 3, 0] = angles[3:]
        else:
            theta[first : first + 3, 0] = angles[:3]
            theta[first, 1] = angles[3]
    return np.radians(theta)


def pose_library(joint_names):
    """Names and angles of all poses: tuple of k names, (k, J, 3) array in radians."""
    return tuple(POSES), np.stack([pose_angles(p, list(joint_names)) for p in POSES.values()])
