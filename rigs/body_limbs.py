"""Arms and legs of the bundled body: lofted segments with the muscles that give them their outline.

All shapes are those of the left side. Tables in millimetres for a stature of 1.72 m.
"""

import numpy as np

from .body_parts import REACH, table
from .implicit import Loft, ellipsoid, frame_along, smooth_cut, smooth_union

__all__ = ["arm", "foot", "leg"]

# Share of the way from hip to ankle (in thousandths), then outer, inner, front, back half-axis: neutral, per unit of fat,
# figure, muscle.
_LEG = (
    (0, (77, 74, 82, 82), (8, 2, 8, 8), (6, 1, 1, 2), (2, 1, 3, 2)),
    (60, (83, 80, 89, 90), (9, 2, 9, 9), (8, 1, 1, 2), (2, 2, 4, 3)),
    (120, (83, 83, 91, 92), (9, 2, 9, 9), (8, 1, 0, 2), (3, 2, 4, 4)),
    (200, (76, 82, 89, 86), (8, 3, 8, 8), (5, 1, 0, 1), (3, 3, 5, 5)),
    (280, (69, 76, 84, 77), (7, 4, 7, 7), (2, 1, -1, 0), (4, 3, 5, 5)),
    (360, (61, 67, 76, 68), (5, 5, 5, 5), (0, 1, -1, 0), (4, 4, 4, 4)),
    (430, (56, 60, 66, 60), (4, 4, 4, 4), (-1, 0, -1, 0), (2, 3, 2, 2)),
    (497, (51, 55, 56, 53), (3, 4, 3, 3), (-1, -1, -1, 0), (1, 1, 1, 1)),
    (545, (49, 50, 50, 55), (3, 4, 2, 3), (-1, -1, -1, 0), (1, 1, 1, 2)),
    (600, (53, 51, 47, 65), (3, 3, 2, 4), (-1, 0, -1, 0), (2, 2, 1, 4)),
    (660, (56, 53, 46, 71), (3, 3, 2, 4), (-1, 0, -1, -1), (3, 3, 1, 5)),
    (730, (51, 48, 43, 64), (3, 3, 2, 3), (-1, -1, -1, -1), (2, 2, 1, 4)),
    (810, (42, 39, 38, 48), (2, 2, 2, 2), (-1, -1, -1, -1), (1, 1, 1, 2)),
    (890, (33, 32, 33, 40), (2, 2, 1, 2), (-1, -1, -1, -1), (0, 0, 0, 1)),
    (950, (33, 34, 35, 43), (1, 1, 1, 1), (-1, -1, -1, -1), (0, 0, 0, 0)),
    (1000, (36, 36, 42, 46), (1, 1, 1, 1), (-1, -1, -1, -1), (0, 0, 0, 0)),
)  # fmt: skip


def leg(bones, f):
    """Thigh, knee, calf and foot."""
    hip, knee, ankle = (bones.left(name) for name in ("hip", "knee", "ankle"))
    frame = frame_along(ankle - hip, [0, 0, 1])
    length = np.linalg.norm(ankle - hip)
    rows = table(_LEG, f)
    rows[:, 0] *= length
    core = Loft(hip, frame, rows, caps=(0.13, 0.03), exponent=2.1, reach=REACH)
    m = 1 + 0.12 * f.muscle

    def on(share, out, front):
        return hip + frame @ np.array([out, front, share * length])

    muscles = [
        _muscle(on(0.27, 0.034, 0.040), frame, (0.036 * m, 0.042 * m, 0.150)),  # vastus lateralis and rectus
        _muscle(on(0.395, -0.036, 0.034), frame, (0.026 * m, 0.030 * m, 0.062)),  # vastus medialis
        _muscle(on(0.26, 0.014, -0.042), frame, (0.050 * m, 0.036 * m, 0.150)),  # hamstrings
        _muscle(on(0.640, -0.021, -0.042), frame, (0.030 * m, 0.031 * m, 0.088)),  # inner calf
        _muscle(on(0.625, 0.022, -0.040), frame, (0.029 * m, 0.029 * m, 0.080)),  # outer calf
        _muscle(on(0.70, 0.016, 0.020), frame, (0.026, 0.027, 0.13)),  # shin muscle beside the tibia
    ]
    body = smooth_union([core, *muscles], 0.020)
    patella = _muscle(knee + [0.002, 0.010, 0.041], frame, (0.024, 0.017, 0.030))
    shin = _muscle(on(0.560, 0.0, 0.036), frame, (0.013, 0.013, 0.024))
    body = smooth_union([body, patella, shin], 0.02)
    malleoli = [
        ellipsoid(ankle + [0.032, -0.002, -0.006], np.eye(3), (0.010, 0.017, 0.014), reach=REACH),
        ellipsoid(ankle + [-0.031, 0.008, 0.006], np.eye(3), (0.010, 0.017, 0.014), reach=REACH),
    ]
    return smooth_union([smooth_union([body, foot(bones, f)], 0.028), *malleoli], 0.012)


def _muscle(centre, frame, radii):
    return ellipsoid(centre, frame, radii, reach=REACH)


# From the ankle along the foot, then outer, inner, upper, lower half-axis about a line 28 mm above the sole.
_FOOT = (
    (-42, 28, 27, 30, 28),
    (-20, 32, 31, 44, 28),
    (5, 33, 33, 46, 28),
    (35, 35, 33, 42, 28),
    (65, 39, 35, 34, 28),
    (95, 46, 41, 21, 28),
    (118, 49, 46, 11, 28),
    (137, 47, 45, 4, 27),
)
# Toes, big to small: root (along, inner side positive), tip, radius at both ends.
_TOES = (
    ((140, 25), (184, 27), 14.0, 12.0),
    ((143, 4), (182, 6), 11.0, 9.5),
    ((140, -12), (176, -11), 10.5, 9.0),
    ((134, -27), (167, -28), 10.5, 9.0),
    ((126, -39), (155, -41), 10.5, 9.0),
)


def foot(bones, f):
    """Heel, instep, ball, and five toes with shallow grooves between them."""
    ankle, ball = bones.left("ankle"), bones.left("foot")
    forward = (ball - ankle) * [1, 0, 1]
    frame = frame_along(forward, [0, 1, 0])
    origin = np.array([ankle[0], 0.028, ankle[2]])
    rows = 0.001 * np.array(_FOOT, dtype=float)
    breadth = 1 - 0.03 * f.figure + 0.015 * f.fat
    rows[:, 1:3] *= breadth
    sole = Loft(origin, frame, rows, caps=(0.020, 0.012), exponent=2.7, reach=REACH)
    heel = ellipsoid(origin + frame @ np.array([0, 0.006, -0.036]), frame, (0.028, 0.033, 0.026), reach=REACH)
    arch = ellipsoid(origin + frame @ np.array([-0.048, -0.032, 0.050]), frame, (0.034, 0.021, 0.050), reach=REACH)
    body = smooth_cut(smooth_union([sole, heel], 0.015), arch, 0.012)
    toes = []
    for root, tip, big, small in _TOES:
        a, b = (origin + frame @ (0.001 * np.array([-p[1] * breadth, 0, p[0]])) for p in (root, tip))
        a[1], b[1] = 0.001 * (big + 2), 0.001 * (small + 1)
        toe_frame = frame_along(b - a, [0, 1, 0])
        length = np.linalg.norm(b - a)
        r = 0.001 * np.array([big, small])
        stations = [(0, r[0], r[0], r[0], r[0]), (0.6 * length, *[0.9 * r[1]] * 4), (length, *[r[1]] * 4)]
        toes.append(Loft(a, toe_frame, stations, caps=(0.01, 0.9 * r[1]), exponent=2.2, reach=REACH))
    return _standing(smooth_union([body, smooth_union(toes, 0.003)], 0.014))


def _standing(shape):
    """Flat where the shape would reach below the ground."""
    return smooth_cut(shape, lambda points: points[:, 1], 0.006)


# Share of the upper arm, then upper (outer), lower (inner), front, back half-axis.
_UPPER_ARM = (
    (0, (44, 44, 45, 46), (5, 1, 5, 5), (-3, -2, -4, -3), (3, 3, 4, 4)),
    (200, (44, 46, 46, 47), (6, 2, 5, 5), (-3, -2, -4, -3), (4, 3, 4, 4)),
    (400, (41, 45, 44, 46), (5, 5, 5, 6), (-3, -2, -4, -2), (3, 3, 4, 5)),
    (600, (38, 41, 42, 44), (4, 6, 5, 5), (-3, -2, -4, -2), (2, 3, 4, 4)),
    (800, (36, 37, 37, 39), (4, 4, 4, 4), (-3, -2, -3, -2), (1, 2, 2, 3)),
    (940, (36, 37, 33, 37), (3, 3, 3, 3), (-3, -3, -2, -2), (1, 1, 1, 1)),
    (1020, (36, 37, 33, 36), (3, 3, 3, 3), (-3, -3, -2, -2), (1, 1, 1, 1)),
)  # fmt: skip
_FOREARM = (
    (0, (35, 36, 34, 36), (3, 3, 3, 3), (-3, -3, -2, -2), (1, 1, 1, 1)),
    (130, (39, 39, 40, 37), (3, 3, 3, 3), (-3, -3, -3, -3), (3, 2, 3, 2)),
    (270, (40, 39, 41, 38), (3, 3, 3, 3), (-4, -3, -3, -3), (3, 3, 3, 3)),
    (450, (36, 36, 36, 36), (3, 3, 3, 3), (-3, -3, -3, -3), (2, 2, 2, 2)),
    (650, (30, 30, 31, 31), (2, 2, 2, 2), (-2, -2, -3, -3), (1, 1, 1, 1)),
    (850, (22, 23, 27, 27), (1, 1, 1, 1), (-1, -1, -2, -2), (0, 0, 1, 1)),
    (1000, (18, 19, 26, 26), (1, 1, 1, 1), (-1, -1, -2, -2), (0, 0, 0, 0)),
)  # fmt: skip


def arm(bones, f):
    """Shoulder cap, upper arm, elbow and forearm, without the hand."""
    shoulder, elbow, wrist = (bones.left(name) for name in ("shoulder", "elbow", "wrist"))
    m = 1 + 0.12 * f.muscle - 0.05 * f.figure
    upper, upper_frame = _segment(shoulder, elbow, _UPPER_ARM, f, (0.03, 0.03))
    lower, lower_frame = _segment(elbow, wrist, _FOREARM, f, (0.03, 0.02))
    length = np.linalg.norm(elbow - shoulder)

    def on(share, out, front):
        return shoulder + upper_frame @ np.array([out, front, share * length])

    deltoid = _muscle(on(0.16, 0.014, 0.000), upper_frame, (0.044 * m, 0.056 * m, 0.098))
    biceps = _muscle(on(0.58, -0.002, 0.021), upper_frame, (0.030 * m, 0.029 * m, 0.085))
    triceps = _muscle(on(0.48, -0.004, -0.022), upper_frame, (0.033 * m, 0.031 * m, 0.100))
    point = _muscle(elbow + lower_frame @ np.array([0.0, -0.026, -0.004]), lower_frame, (0.017, 0.014, 0.020))
    reach = np.linalg.norm(wrist - elbow)
    radial = _muscle(elbow + lower_frame @ np.array([0.016, 0.016, 0.24 * reach]), lower_frame, (0.026, 0.026, 0.075))
    flexors = _muscle(elbow + lower_frame @ np.array([-0.018, 0.004, 0.25 * reach]), lower_frame, (0.024, 0.028, 0.075))
    top = smooth_union([upper, deltoid], 0.03)
    top = smooth_union([top, biceps, triceps], 0.02)
    bottom = smooth_union([lower, radial, flexors, point], 0.02)
    return smooth_union([top, bottom], 0.03)


def _segment(start, end, rows, f, caps):
    frame = frame_along(end - start, [0, 0, 1])
    stations = table(rows, f)
    stations[:, 0] *= np.linalg.norm(end - start)
    return Loft(start, frame, stations, caps=caps, exponent=2.15, reach=REACH), frame
