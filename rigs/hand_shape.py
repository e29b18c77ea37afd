"""The anatomy of the bundled right hand: where its joints are and which blended volumes make its skin.

Frame: metres, the wrist joint at the origin, fingers up (+y), palm towards the viewer (+z), back of the hand towards −z.
On a right hand the thumb is then on +x: fingers × palm normal = y × z = x. Every number's source is in README.md.
"""

from dataclasses import dataclass

import numpy as np

from .implicit import Loft, capsule, ellipsoid, frame_along, smooth_cut, smooth_union

__all__ = ["BOX", "FINGERS", "JOINT_NAMES", "PARAMETERS", "PARENTS", "Person", "Skeleton", "skeleton", "surface"]

HAND_LENGTH, HAND_BREADTH = 0.187, 0.085
FINGERS = ("index", "middle", "pinky", "ring", "thumb")  # MANO's order
JOINT_NAMES = ("wrist", *(f"{finger}{k}" for finger in FINGERS for k in (1, 2, 3)))
PARENTS = np.array([-1, *(p for f in range(5) for p in (0, 3 * f + 1, 3 * f + 2))])
BOX = (np.array([-0.085, -0.055, -0.035]), np.array([0.125, 0.205, 0.06]))

# In what people differ: lower, upper, default, standard deviation (the others held), unit. See Person and README.md.
PARAMETERS = {
    "length": (0.155, 0.215, HAND_LENGTH, 0.0115, "m"),
    "breadth": (0.070, 0.100, HAND_BREADTH, 0.0045, "m"),
    "thickness": (0.80, 1.20, 1.0, 0.06, ""),
    "fingers": (0.90, 1.10, 1.0, 0.025, ""),
    "thumb": (0.85, 1.15, 1.0, 0.04, ""),
}

# Phalanges: proximal, middle, distal, in hand lengths. Thumb: metacarpal, proximal, distal.
_SEGMENTS = {
    "index": (0.245, 0.143, 0.097),
    "middle": (0.266, 0.170, 0.108),
    "pinky": (0.204, 0.117, 0.093),
    "ring": (0.244, 0.165, 0.107),
    "thumb": (0.251, 0.196, 0.158),
}
_FLESH = 0.010  # soft tissue beyond the last bone, in hand lengths

# Metacarpal's two ends: x in hand breadths (towards the thumb), y in hand lengths, z in metres (the arches of the palm).
_METACARPAL = {
    "index": ((0.126, 0.073, 0.000), (0.252, 0.447, -0.001)),
    "middle": ((0.000, 0.073, -0.001), (0.000, 0.446, -0.003)),
    "pinky": ((-0.223, 0.073, 0.003), (-0.402, 0.368, 0.003)),
    "ring": ((-0.129, 0.073, 0.001), (-0.206, 0.409, -0.001)),
}
_SPREAD = {"index": 10.5, "middle": 1.5, "pinky": -17.5, "ring": -8.0}  # degrees from +y towards the thumb
_ROLL = {"index": 3.0, "middle": 0.0, "pinky": -10.0, "ring": -4.0}  # degrees; fingers face the middle of the palm
_THICKNESS = {"index": 0.96, "middle": 0.985, "pinky": 0.83, "ring": 0.925}

_THUMB_ROOT = (0.235, 0.105, 0.007)  # trapeziometacarpal joint, units as for the metacarpals
_THUMB_DIRECTION = (0.69, 0.66, 0.30)  # of the metacarpal
_THUMB_OUTER = (0.60, 0.76, 0.235)  # of the two phalanges
_THUMB_DORSAL = (0.76, -0.46, -0.46)  # where the thumb's nail looks


@dataclass(frozen=True)
class Person:
    """In what hands differ; the defaults are the bundled hand's.

    Attributes
    ----------
    length : float
        Wrist joint to the tip of the middle finger, metres. Lengthens palm and fingers alike.
    breadth : float
        Across the knuckles, metres. Broadens palm and fingers.
    thickness : float
        From the back of the hand to the palm, of palm and fingers, as a share of the default.
    fingers : float
        Length of the four fingers as a share of what it is for a hand of this length; the palm makes up for it.
    thumb : float
        Length of the thumb, likewise.
    """

    length: float = HAND_LENGTH
    breadth: float = HAND_BREADTH
    thickness: float = 1.0
    fingers: float = 1.0
    thumb: float = 1.0

    @property
    def across(self):
        return self.breadth / HAND_BREADTH

    @property
    def palm(self):
        """Factor of lengths within the palm."""
        knuckle, finger = _METACARPAL["middle"][1][1], sum(_SEGMENTS["middle"])
        return self.length / HAND_LENGTH * ((knuckle + finger * (1 - self.fingers)) / knuckle)

    @property
    def axes(self):
        """Factors along the rig's axes within the palm, (3,)."""
        return np.array([self.across, self.palm, self.thickness])

    def section(self, rows):
        """Rows (s, right, left, dorsal, palmar) of a loft with this person's half-axes."""
        return np.asarray(rows) * [1, self.across, self.across, self.thickness, self.thickness]

    def segments(self, finger):
        """Lengths of a finger's bones, metres."""
        return np.array(_SEGMENTS[finger]) * self.length * (self.thumb if finger == "thumb" else self.fingers)


@dataclass(frozen=True)
class Skeleton:
    """Joints (16, 3), frames (16, 3, 3) with columns flexion, abduction, twist axis, fingertips by finger, and whose it is."""

    joints: np.ndarray
    frames: np.ndarray
    tips: dict
    carpal: dict  # finger -> proximal end of its metacarpal
    person: Person

    def row(self, finger, k):
        return JOINT_NAMES.index(f"{finger}{k}")


def _place(at, person):
    return np.array([at[0] * HAND_BREADTH, at[1] * HAND_LENGTH, at[2]]) * person.axes


def skeleton(person=None):
    """Joint positions and anatomical rest frames of a person, by default the bundled hand's.

    In every frame x is the axis of flexion (positive bends towards the palm), y of abduction (it points out of the back of
    the hand; positive turns towards the thumb's side) and z runs along the bone to the tip (twist). The wrist's frame has
    x = +x, y = −z and z = +y of the rig.
    """
    person = person or Person()
    joints, frames, tips, carpal = np.zeros((16, 3)), np.zeros((16, 3, 3)), {}, {}
    frames[0] = frame_along([0, 1, 0], [0, 0, -1])
    for f, finger in enumerate(FINGERS):
        lengths = person.segments(finger)
        if finger == "thumb":
            carpal[finger] = at = _place(_THUMB_ROOT, person)
            directions = [_THUMB_DIRECTION, _THUMB_OUTER, _THUMB_OUTER]
            dorsal = _THUMB_DORSAL
        else:
            carpal[finger], at = (_place(p, person) for p in _METACARPAL[finger])
            spread, roll = np.radians(_SPREAD[finger]), np.radians(_ROLL[finger])
            directions = [(np.sin(spread), np.cos(spread), 0.0)] * 3
            dorsal = (np.sin(roll), 0.0, -np.cos(roll))
        for k in range(3):
            row = 3 * f + 1 + k
            joints[row], frames[row] = at, frame_along(directions[k], dorsal)
            at = at + lengths[k] * frames[row][:, 2]
        tips[finger] = at + _FLESH * person.length * frames[row][:, 2]
    return Skeleton(joints, frames, tips, carpal, person)


# Cross-sections of a finger of thickness 1: position (bone number + fraction of that bone), half breadth, dorsal, palmar, mm.
_FINGER_STATIONS = (
    (-0.25, 8.5, 8.0, 9.5),
    (0.00, 9.8, 9.2, 11.5),
    (0.35, 9.6, 8.4, 11.2),
    (0.70, 9.2, 7.9, 9.6),
    (1.00, 10.0, 9.0, 8.9),  # proximal interphalangeal joint: knuckle behind, crease in front
    (1.45, 8.8, 7.3, 9.3),
    (2.00, 8.7, 7.3, 7.6),  # distal interphalangeal joint
    (2.45, 8.5, 5.9, 8.4),  # pulp in front, nail behind
    (2.78, 7.9, 4.8, 7.8),
)
_THUMB_STATIONS = (
    (-0.20, 11.0, 9.8, 11.5),
    (0.00, 11.4, 10.6, 11.5),
    (0.45, 9.6, 8.4, 10.3),
    (1.00, 10.7, 9.6, 9.4),  # interphalangeal joint
    (1.42, 10.9, 7.2, 10.9),
    (1.74, 9.8, 5.2, 9.9),
)


def _digit(person, bones, frame, start, stations, scale, tip):
    """A loft along straight bones; ``bones`` are lengths, ``tip`` the distance from ``start`` to the fingertip."""
    ends = np.concatenate([[0.0], np.cumsum(bones)])
    rows = []
    for where, breadth, dorsal, palmar in stations:
        k = int(np.clip(np.floor(where), 0, len(bones) - 1))
        along = ends[k] + (where - k) * bones[k]
        rows.append((along, *(0.001 * scale * np.array([breadth, breadth, dorsal, palmar]))))
    return Loft(start, frame, person.section(rows), caps=(0.006, tip - rows[-1][0]))


def surface(bones=None):
    """The skin of the hand as an implicit shape (see :mod:`rigs.implicit`).

    Parameters
    ----------
    bones : Skeleton, optional
        Of a person; by default the bundled hand's.

    Returns
    -------
    callable
    """
    bones = bones or skeleton()
    axes = bones.person.axes
    palm = smooth_union([_wrist(axes), smooth_union(_metacarpals(bones), 0.010)], 0.018)
    palm = smooth_union([palm, _hypothenar(axes), *_thenar(bones)], 0.014)
    hollow = ellipsoid(np.array([0.000, 0.053, 0.0265]) * axes, np.eye(3), np.array([0.015, 0.026, 0.0105]) * axes)
    palm = smooth_cut(palm, hollow, 0.010)
    fingers = [_finger(bones, finger) for finger in ("index", "middle", "ring", "pinky")]
    thumb = smooth_union([_thumb(bones), *_first_web(bones)], 0.008)
    hand = smooth_union([palm, thumb], 0.008)
    hand = smooth_union([hand, *_knuckles(bones)], 0.008)
    hand = smooth_union([hand, smooth_union(fingers, 0.004)], 0.007)
    return smooth_union([hand, *_webs(bones)], 0.012)


def _wrist(axes):
    across, along, deep = axes
    frame = frame_along([0, 1, 0], [0, 0, -1])
    rows = [  # s, right (thumb side), left, dorsal, palmar
        (-0.034, 0.0295, 0.0295, 0.0205, 0.0200),
        (-0.020, 0.0285, 0.0285, 0.0200, 0.0192),
        (-0.004, 0.0275, 0.0277, 0.0184, 0.0180),
        (0.008, 0.0270, 0.0285, 0.0165, 0.0172),
        (0.022, 0.0245, 0.0290, 0.0140, 0.0160),
    ]
    rows = np.array(rows) * [along, across, across, deep, deep]
    return Loft((0, 0, 0.0010), frame, rows, caps=(0.012, 0.016), exponent=2.15)


def _metacarpals(bones):
    shapes = []
    for finger in ("index", "middle", "ring", "pinky"):
        start, end = bones.carpal[finger], bones.joints[bones.row(finger, 1)]
        roll = np.radians(_ROLL[finger])
        frame = frame_along(end - start, (np.sin(roll), 0, -np.cos(roll)))
        length, t = np.linalg.norm(end - start), _THICKNESS[finger] / 0.96
        right, left = (0.0018 * (finger == name) for name in ("index", "pinky"))  # flesh at the edges of the hand
        rows = [
            (0.0, 0.0100, 0.0100, 0.0115, 0.0135),
            (0.5 * length, 0.0105 * t + right, 0.0105 * t + left, 0.0108 * t, 0.0150 * t),
            (0.85 * length, 0.0108 * t + right, 0.0108 * t + left, 0.0105 * t, 0.0160 * t),
            (length, 0.0108 * t + right, 0.0108 * t + left, 0.0105 * t, 0.0158 * t),
            (length + 0.008, 0.0100 * t + right / 2, 0.0100 * t + left / 2, 0.0085 * t, 0.0145 * t),
        ]
        shapes.append(Loft(start, frame, bones.person.section(rows), caps=(0.010, 0.009), exponent=2.4))
    return shapes


def _hypothenar(axes):
    frame = frame_along([-0.22, 0.97, 0.02], [-0.35, 0, -0.9])
    radii = np.array([0.0135, 0.0110, 0.0330]) * axes[[0, 2, 1]]
    return ellipsoid(np.array([-0.0275, 0.033, 0.0080]) * axes, frame, radii)


def _thenar(bones):
    start, end = bones.joints[bones.row("thumb", 1)], bones.joints[bones.row("thumb", 2)]
    frame = bones.frames[bones.row("thumb", 1)]
    length = np.linalg.norm(end - start)
    rows = [
        (0.0, 0.0105, 0.0115, 0.0110, 0.0120),
        (0.5 * length, 0.0105, 0.0125, 0.0098, 0.0140),
        (length, 0.0108, 0.0108, 0.0102, 0.0122),
    ]
    axes = bones.person.axes
    eminence = (start + end) / 2 + np.array([-0.010, -0.003, 0.004]) * axes
    radii = np.array([0.0165, 0.0135, 0.0300]) * axes[[0, 2, 1]]
    return [
        Loft(start, frame, bones.person.section(rows), caps=(0.009, 0.008)),
        ellipsoid(eminence, frame_along(end - start + [-0.004, 0.014, 0], [0, 0, -1]), radii),
    ]


def _thumb(bones):
    row = bones.row("thumb", 2)
    start = bones.joints[row]
    lengths = bones.person.segments("thumb")[1:]
    tip = np.linalg.norm(bones.tips["thumb"] - start)
    return _digit(bones.person, lengths, bones.frames[row], start, _THUMB_STATIONS, 1.0, tip)


def _first_web(bones):
    """The fold between thumb and index: skin and adductor muscle, thinning towards its free edge."""
    thumb = bones.joints[bones.row("thumb", 1)], bones.joints[bones.row("thumb", 2)]
    index = bones.carpal["index"], bones.joints[bones.row("index", 1)]
    shapes = []
    for along_thumb, along_index, radii in (
        (0.45, 0.35, (0.0105, 0.0115)),
        (0.70, 0.55, (0.0080, 0.0100)),
        (0.90, 0.72, (0.0062, 0.0085)),
    ):
        a = thumb[0] + along_thumb * (thumb[1] - thumb[0])
        b = index[0] + along_index * (index[1] - index[0])
        shapes.append(capsule(a, b, radii))
    return shapes


def _finger(bones, finger):
    row = bones.row(finger, 1)
    start = bones.joints[row]
    lengths = bones.person.segments(finger)
    tip = np.linalg.norm(bones.tips[finger] - start)
    return _digit(bones.person, lengths, bones.frames[row], start, _FINGER_STATIONS, _THICKNESS[finger], tip)


def _knuckles(bones):
    shapes = []
    for finger in ("index", "middle", "ring", "pinky"):
        row, t = bones.row(finger, 1), _THICKNESS[finger]
        across, deep = bones.person.across, bones.person.thickness
        centre = bones.joints[row] + bones.frames[row] @ np.array([0, 0.0055 * t * deep, -0.001])
        shapes.append(ellipsoid(centre, bones.frames[row], np.array([0.0078, 0.0068, 0.0105]) * t * [across, deep, 1]))
    return shapes


def _webs(bones):
    """Skin between neighbouring fingers, reaching almost half-way up the proximal phalanges, nearer the palm's side."""
    shapes = []
    for first, second, reach in (
        ("index", "middle", (0.011, 0.012)),
        ("middle", "ring", (0.012, 0.015)),
        ("ring", "pinky", (0.014, 0.011)),
    ):
        ends = []
        for finger, r in ((first, reach[0]), (second, reach[1])):
            row = bones.row(finger, 1)
            along = r * bones.person.length / HAND_LENGTH * bones.person.fingers
            ends.append(bones.joints[row] + bones.frames[row] @ np.array([0, -0.0030 * bones.person.thickness, along]))
        shapes.append(capsule(*ends, (0.0055, 0.0055)))
    return shapes
