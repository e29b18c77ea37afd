"""The trunk of the bundled body: ribcage, waist, pelvis, glutes, chest, back and neck as blended volumes.

All shapes are those of the left half; :mod:`rigs.body_shape` folds points onto it. Measures in millimetres in the tables,
metres elsewhere, for a stature of 1.72 m.
"""

import numpy as np

from .body_parts import REACH, along, table
from .body_skeleton import level
from .implicit import Loft, ellipsoid, frame_along, smooth_union

__all__ = ["neck", "trunk"]

# Height above the soles, then half breadth, front, back: of the neutral figure, per unit of fat, of figure, of muscle.
_TRUNK = (
    # y     neutral            fat            figure          muscle
    (850, (48, 74, 84), (8, 8, 6), (3, 0, 2), (0, 0, 0)),
    (870, (88, 87, 94), (10, 12, 8), (6, 0, 3), (0, 0, 1)),
    (895, (118, 97, 101), (11, 15, 8), (8, -1, 3), (0, 0, 2)),
    (930, (145, 105, 103), (12, 19, 8), (8, 0, 3), (0, -1, 2)),
    (970, (149, 107, 97), (13, 24, 7), (6, 1, 2), (0, -2, 0)),
    (1010, (147, 107, 87), (14, 25, 8), (2, 1, 1), (-1, -3, 0)),
    (1060, (142, 104, 81), (15, 26, 10), (-5, 0, 0), (-1, -3, 1)),
    (1115, (137, 101, 84), (15, 26, 11), (-8, -1, -2), (0, -3, 2)),
    (1165, (139, 102, 94), (14, 23, 11), (-8, -3, -4), (2, -1, 4)),
    (1215, (143, 106, 106), (12, 19, 11), (-8, -5, -5), (5, 2, 5)),
    (1265, (145, 102, 116), (8, 14, 10), (-8, -5, -6), (7, 4, 6)),
    (1315, (143, 92, 122), (5, 9, 9), (-8, -5, -6), (7, 4, 6)),
    (1355, (130, 76, 121), (4, 7, 8), (-7, -4, -6), (5, 3, 5)),
    (1390, (104, 58, 113), (5, 5, 7), (-6, -3, -5), (4, 2, 5)),
    (1415, (74, 42, 103), (4, 4, 6), (-4, -2, -4), (3, 1, 4)),
)  # fmt: skip


def trunk(bones, figure):
    """Ribcage, waist and pelvis with the muscles on them, without neck and limbs."""
    rows = table(_TRUNK, figure, columns=(0, 0, 1, 2))
    rows[:, 0] = level(rows[:, 0], figure)
    upright = frame_along([0, 1, 0], [0, 0, 1])
    core = Loft((0, 0, 0), upright, rows, caps=(0.02, 0.03), exponent=2.25, reach=REACH)
    body = smooth_union([core, *_belly(figure)], 0.02)
    body = smooth_union([body, *_chest(bones, figure)], 0.035)
    body = smooth_union([body, *_back(bones, figure)], 0.04)
    body = smooth_union([body, *_shoulder_girdle(bones, figure)], 0.035)
    return smooth_union([body, *_glutes(bones, figure)], 0.03)


def _chest(bones, f):
    """Pectoral muscle and breast."""
    y = level(1.285, f)
    pectoral = ellipsoid(
        (0.078, y + 0.012, 0.062 + 0.006 * f.fat), frame_along([1, 0.25, -0.35], [0, 0, 1]),
        (0.052 + 0.004 * f.muscle, 0.036 + 0.009 * f.muscle + 0.002 * f.fat, 0.080), reach=REACH,
    )  # fmt: skip
    size = 0.044 + 0.010 * f.figure + 0.005 * f.fat
    breast = ellipsoid(
        (0.078, y - 0.036 - 0.004 * (f.figure + f.fat), 0.066 + 0.018 * f.figure + 0.010 * f.fat),
        frame_along([0, 1, 0], [0.25, 0, 1]),
        (size + 0.008, size - 0.006 + 0.006 * f.figure, size + 0.002), reach=REACH,
    )  # fmt: skip
    return [pectoral, breast]


def _belly(f):
    """The straight muscle of the belly, to both sides of the middle line, and the edge of the ribs."""
    rectus = ellipsoid(
        (0.036, level(1.075, f), 0.071 + 0.023 * f.fat), frame_along([-0.02, 1, 0.01], [0.12, 0, 1]),
        (0.034, 0.033 + 0.003 * f.muscle, 0.155), reach=REACH,
    )  # fmt: skip
    ribs = ellipsoid(
        (0.074 + 0.007 * f.fat, level(1.190, f), 0.046 + 0.018 * f.fat), frame_along([0.75, -0.75, -0.50], [0.5, 0.1, 0.8]),
        (0.036, 0.030, 0.062), reach=REACH,
    )  # fmt: skip
    return [rectus, ribs]


def _back(bones, f):
    """Latissimus towards the armpit, and the columns beside the spine."""
    lat = ellipsoid(
        (0.115, level(1.27, f), -0.055), frame_along([0.16, 1, -0.05], [0.6, 0, -1]),
        (0.040, 0.040 + 0.006 * f.muscle, 0.105), reach=REACH,
    )  # fmt: skip
    erector = ellipsoid(
        (0.036, level(1.10, f), -0.052 - 0.006 * f.fat), frame_along([0, 1, 0.02], [0, 0, -1]),
        (0.028, 0.032 + 0.004 * f.muscle, 0.15), reach=REACH,
    )  # fmt: skip
    blade = ellipsoid(
        (0.088, level(1.325, f), -0.088), frame_along([-0.15, 1, 0.1], [0.25, 0, -1]),
        (0.050, 0.034 + 0.005 * f.muscle, 0.080), reach=REACH,
    )  # fmt: skip
    return [lat, erector, blade]


def _shoulder_girdle(bones, f):
    """Trapezius from the neck to the tip of the shoulder, and the collar bone's ridge."""
    tip = bones.left("shoulder") + [-0.004, 0.012, -0.004]
    neck = np.array([0.040, level(1.462, f), -0.050])
    trapezius = along(
        neck, tip, [0, 0, -1],
        [(0.0, 24, 22, 26, 34), (0.35, 24, 22, 26, 36), (0.7, 22, 22, 26, 30), (1.0, 20, 20, 22, 24)],
        scale=1 + 0.12 * f.muscle + 0.04 * f.fat, caps=(0.03, 0.02),
    )  # fmt: skip
    collar = along(
        np.array([0.018, level(1.400, f), 0.034]), bones.left("shoulder") + [-0.012, 0.018, 0.012], [0, 0, 1],
        [(0.0, 12, 12, 10, 12), (0.5, 10, 10, 11, 12), (1.0, 12, 12, 10, 12)], caps=(0.010, 0.012),
    )  # fmt: skip
    girdle = along(
        np.array([0.085, level(1.372, f), -0.034]), bones.left("shoulder") + [-0.010, -0.004, 0], [0, 0, 1],
        [(0.0, 40, 44, 66, 66), (0.5, 42, 44, 60, 58), (1.0, 42, 42, 46, 46)],
        scale=1 + 0.05 * f.muscle + 0.05 * f.fat, caps=(0.03, 0.03),
    )  # fmt: skip
    return [girdle, trapezius, collar]


def _glutes(bones, f):
    hip = bones.left("hip")
    centre = hip + [-0.010 + 0.003 * f.figure, -0.035, -0.065 - 0.004 * f.figure - 0.003 * f.fat - 0.002 * f.muscle]
    size = 1 + 0.05 * f.figure + 0.06 * f.fat + 0.03 * f.muscle
    return [ellipsoid(centre, frame_along([0.10, 1, -0.12], [0, 0, -1]), np.array([0.080, 0.074, 0.092]) * size, reach=REACH)]


def neck(bones, f):
    """Neck with the muscles that run from behind the ears to the breastbone."""
    thick = 1 - 0.07 * f.figure + 0.05 * f.fat + 0.05 * f.muscle
    start, end = np.array([0, level(1.405, f), -0.040]), np.array([0, 1.575, -0.012])
    column = along(
        start, end, [0, 0, 1],
        [(0.0, 70, 70, 60, 60), (0.28, 58, 58, 58, 57), (0.5, 54, 54, 55, 55), (0.75, 54, 54, 52, 58), (1.0, 56, 56, 50, 62)],
        scale=thick, caps=(0.02, 0.02),
    )  # fmt: skip
    strap = along(
        np.array([0.016, level(1.412, f), 0.032]), np.array([0.058, 1.572, -0.022]), [0, 0, 1],
        [(0.0, 9, 9, 8, 10), (0.5, 11, 11, 9, 14), (1.0, 12, 12, 11, 14)], scale=thick, caps=(0.006, 0.01),
    )  # fmt: skip
    throat = ellipsoid((0, 1.487, 0.026), np.eye(3), (0.019, 0.024, 0.017 - 0.002 * f.figure), reach=REACH)
    return smooth_union([column, strap, throat], 0.022)
