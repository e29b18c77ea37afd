"""The skeleton of the bundled body: SMPL's 24 joints at anatomical places, anatomical axes, and limits from published tables.

Frame: metres, y up, soles at y = 0, facing +z, so the figure's left is +x. The rest pose is an A-pose: straight legs a little
apart, arms 45° below the horizontal, palms towards the thighs. Every number's source is in README.md.

Axes (columns of a rest frame). Pelvis, spine, neck and head have the rig's axes: x bends forward, y turns to the figure's left,
z tilts to its right. Limbs, right side: z runs along the bone, away from the trunk; x is flexion, y abduction (away from the
body, or towards the thumb's side), z outward twist. Left side: F_left = −S F_right with S = diag(−1, 1, 1), which makes the same
angles and limits the mirrored pose; its z axes run towards the trunk.

Angles, positive x, y, z:

==========  ===============================  ===================================  ==================================
joint       x                                y                                    z
==========  ===============================  ===================================  ==================================
hip         thigh forward                    thigh sideways, away                 knee turns outward
knee        heel backwards                   locked                               locked
ankle       toes up                          locked                               inversion: outer edge of foot down
foot        toes up                          locked                               locked
collar      shoulder forward                 shoulder up                          locked
shoulder    arm forward                      arm up, sideways                     outward turn of the upper arm
elbow       hand forward and up              locked                               supination: thumb turns outward
wrist       hand towards the palm            hand towards the thumb               locked
hand        fingers towards the palm         locked                               locked
==========  ===============================  ===================================  ==================================
"""

from dataclasses import dataclass

import numpy as np

from .implicit import frame_along

__all__ = [
    "HEIGHT", "JOINT_NAMES", "LIMITS", "PARENTS", "Figure", "Skeleton", "level", "limits", "mirrored_frame", "skeleton",
    "smpl_rest",
]  # fmt: skip

HEIGHT = 1.72
JOINT_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle", "spine3",
    "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
PARENTS = np.array([-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21])

_S = np.diag([-1.0, 1.0, 1.0])
_CENTRE = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist", "hand")

# Degrees about the rest frames' axes: (x, y, z) lower, upper; from the A-pose, so the tables' figures less what the rest
# pose has already (arms 45° abducted, elbows 6° and knees 2° bent, thighs 4° abducted).
LIMITS = {
    "pelvis": ((-34.4, -34.4, -34.4), (34.4, 34.4, 34.4)),  # ±0.6 rad: how far sampled poses turn as a whole
    "spine1": ((-12, -10, -14), (35, 10, 14)),
    "spine2": ((-10, -15, -12), (25, 15, 12)),
    "spine3": ((-8, -20, -9), (20, 20, 9)),
    "neck": ((-25, -30, -25), (25, 30, 25)),
    "head": ((-20, -40, -20), (20, 40, 20)),
    "hip": ((-30, -34, -45), (120, 41, 45)),
    "knee": ((0, 0, 0), (139, 0, 0)),
    "ankle": ((-50, 0, -20), (20, 0, 35)),
    "foot": ((-30, 0, 0), (60, 0, 0)),
    "collar": ((-15, -10, 0), (20, 35, 0)),
    "shoulder": ((-55, -65, -70), (130, 95, 90)),
    "elbow": ((-6, 0, -80), (144, 0, 80)),
    "wrist": ((-70, -30, 0), (80, 20, 0)),
    "hand": ((-20, 0, 0), (70, 0, 0)),
}


@dataclass(frozen=True)
class Figure:
    """What makes one person different from the neutral one, which has the defaults."""

    height: float = HEIGHT  # metres
    fat: float = 0.0  # padding, in units that add about 10 kg
    figure: float = 0.0  # −1 more like the mean man, 1 more like the mean woman
    muscle: float = 0.0  # −1 slight, 1 athletic
    legs: float = 0.0  # share by which the legs are longer; the trunk is shorter by as many metres
    shoulders: float = 0.0  # metres by which the shoulder joints are further apart


@dataclass(frozen=True)
class Skeleton:
    """Joints (24, 3) and frames (24, 3, 3), columns x, y, z of each joint's rest frame."""

    joints: np.ndarray
    frames: np.ndarray

    def row(self, name):
        return JOINT_NAMES.index(name)

    def left(self, name):
        """Position of a joint of the left limbs, or of a joint in the middle."""
        return self.joints[JOINT_NAMES.index(name if name in _CENTRE else f"left_{name}")]


# Places at a height of 1.72 m, left limbs: x towards the figure's left, y above the soles, z forward, metres.
_PLACES = {
    "pelvis": (0.0, 0.960, -0.012),
    "spine1": (0.0, 1.050, -0.028),
    "spine2": (0.0, 1.165, -0.030),
    "spine3": (0.0, 1.280, -0.045),
    "neck": (0.0, 1.462, -0.040),
    "head": (0.0, 1.560, -0.008),
    "hip": (0.088, 0.909, 0.0),
    "collar": (0.030, 1.396, 0.000),
    "shoulder": (0.172, 1.388, -0.020),
}
_THIGH, _SHANK, _ANKLE = 0.245 * HEIGHT, 0.246 * HEIGHT, 0.039 * HEIGHT  # lengths, height of the ankle joint
_LEG_OUT, _THIGH_BACK, _SHANK_BACK = np.radians([4.2, 1.9, 4.1])
_TOES_OUT = np.radians(8.0)
_UPPER_ARM, _FOREARM, _KNUCKLES = 0.172 * HEIGHT, 0.148 * HEIGHT, 0.0485 * HEIGHT
_ARM_DOWN, _ARM_BACK, _ELBOW_BENT = np.radians([45.0, 2.0, 6.0])
_BALL = (0.133, 0.024)  # of the foot: in front of the ankle, above the sole


def level(y, figure):
    """Where the neutral figure's height ``y`` lies in a figure with other legs, before it is scaled to its stature: longer
    legs lift the hips and shorten the trunk between hips and neck."""
    hip, neck = _PLACES["hip"][1], _PLACES["neck"][1]
    raised = hip + figure.legs * (hip - _ANKLE)
    return np.interp(y, [-1.0, _ANKLE, hip, neck, 3.0], [-1.0, _ANKLE, raised, neck, 3.0])


def skeleton(figure=None):
    """Joint positions and anatomical rest frames, exactly symmetric.

    Parameters
    ----------
    figure : Figure, optional
        The neutral one by default.

    Returns
    -------
    Skeleton
    """
    figure = figure or Figure()
    place = {name: np.array([at[0], level(at[1], figure), at[2]]) for name, at in _PLACES.items()}
    place["hip"][0] += 0.003 * figure.figure
    place["shoulder"][0] += figure.shoulders / 2 - 0.012 * figure.figure + 0.004 * figure.muscle
    axis = _axes()
    place["knee"] = place["hip"] + (1 + figure.legs) * _THIGH * axis["hip"][0]
    place["ankle"] = place["knee"] + (1 + figure.legs) * _SHANK * axis["knee"][0]
    place["foot"] = place["ankle"] + _BALL[0] * axis["ankle"][0] / axis["ankle"][0][2]
    place["foot"][1] = _BALL[1]
    place["elbow"] = place["shoulder"] + _UPPER_ARM * axis["shoulder"][0]
    place["wrist"] = place["elbow"] + _FOREARM * axis["elbow"][0]
    place["hand"] = place["wrist"] + _KNUCKLES * axis["wrist"][0]
    joints, frames = np.empty((24, 3)), np.empty((24, 3, 3))
    for row, name in enumerate(JOINT_NAMES):
        side, _, limb = name.rpartition("_")
        joints[row] = place[limb]
        if not side:
            frames[row] = np.eye(3)
            continue
        right = frame_along(*(_S @ a for a in axis[limb]))
        frames[row] = right if side == "right" else mirrored_frame(right)
        if side == "right":
            joints[row] = _S @ joints[row]
    return Skeleton(joints * (figure.height / HEIGHT), frames)


def _axes():
    """Of each left limb: direction along the bone, and the y axis's direction before mirroring (made perpendicular later)."""
    out, back = np.array([1.0, 0, 0]), np.array([0, 0, -1.0])
    thigh = _direction(np.sin(_LEG_OUT), -np.cos(_LEG_OUT), -np.tan(_THIGH_BACK))
    shank = _direction(np.sin(_LEG_OUT), -np.cos(_LEG_OUT), -np.tan(_SHANK_BACK))
    foot = np.array([np.sin(_TOES_OUT), 0, np.cos(_TOES_OUT)])
    arm = _direction(np.cos(_ARM_DOWN), -np.sin(_ARM_DOWN), -np.tan(_ARM_BACK))
    forward = np.cross(arm, np.cross(arm, back))  # perpendicular to the arm
    fore = _direction(*(np.cos(_ELBOW_BENT) * arm + np.sin(_ELBOW_BENT) * forward))
    dorsal = np.array([np.sin(_ARM_DOWN), np.cos(_ARM_DOWN), 0])
    return {
        "hip": (thigh, back),
        "knee": (shank, -back),
        "ankle": (foot, np.array([0, -1.0, 0])),
        "foot": (foot, np.array([0, -1.0, 0])),
        "collar": (out, back),
        "shoulder": (arm, back),
        "elbow": (fore, back),
        "wrist": (fore, dorsal),
        "hand": (fore, dorsal),
    }


def _direction(*v):
    return np.array(v) / np.linalg.norm(v)


def mirrored_frame(frame):
    """−S F: the frame in which the same angles give the mirrored pose."""
    return -_S @ frame


def limits():
    """Lower and upper limits, (24, 3) each, radians."""
    rows = [LIMITS[name.rpartition("_")[2]] for name in JOINT_NAMES]
    return tuple(np.radians([r[k] for r in rows]) for k in (0, 1))


# Directions of the left limbs in SMPL's rest pose (T-pose), to a degree or so: along thigh, shank, upper arm, forearm, hand.
_SMPL_DIRECTIONS = {
    "hip": (0.09, -1.0, -0.01),
    "knee": (-0.035, -1.0, -0.11),
    "shoulder": (1.0, -0.05, -0.11),
    "elbow": (1.0, 0.035, -0.01),
    "wrist": (1.0, -0.10, -0.17),
    "hand": (1.0, -0.10, -0.17),
}


def smpl_rest():
    """Rotations A_j (24, 3, 3), rig frame, that turn each rest segment to where it points in SMPL's rest pose.

    Arms and legs turn the shortest way from this rig's direction to SMPL's; the palms, towards the thighs here, then look
    down as SMPL's do. All else stands alike in both.
    """
    out = np.tile(np.eye(3), (24, 1, 1))
    for limb, direction in _SMPL_DIRECTIONS.items():
        turn = _shortest(_axes()[limb][0], _direction(*direction))
        out[JOINT_NAMES.index(f"left_{limb}")] = turn
        out[JOINT_NAMES.index(f"right_{limb}")] = _S @ turn @ _S
    return out


def _shortest(a, b):
    """The rotation with the smallest angle that takes the unit vector a to b."""
    v, c = np.cross(a, b), a @ b
    K = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + K + K @ K / (1 + c)
