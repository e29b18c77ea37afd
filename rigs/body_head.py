"""The head of the bundled body: cranium, jaw, and a plain face with brow, eyes, nose, lips, chin and ears.

All shapes are those of the left half. Metres, for a stature of 1.72 m; z is forward, y above the soles.
"""

import numpy as np

from .body_parts import REACH
from .implicit import Loft, capsule, ellipsoid, frame_along, smooth_cut, smooth_union

__all__ = ["head"]

# Height, half breadth, front, back about a vertical line 30 mm in front of the plumb line, millimetres.
_FACE = (
    (1506, 25, 54, 18),
    (1520, 39, 63, 38),
    (1538, 50, 66, 56),
    (1560, 58, 67.5, 62),
    (1585, 63.5, 67, 66),
    (1610, 66, 64, 72),
    (1635, 67, 63, 76),
    (1660, 62, 56, 74),
    (1685, 48, 42, 62),
)


def head(bones, f):
    """Head above the neck."""
    cranium = smooth_union(
        [
            _blob((0, 1.627, 0.007), (0.074, 0.093, 0.092)),
            _blob((0, 1.612, -0.028), (0.071, 0.078, 0.060)),  # back of the head
        ],
        0.02,
    )
    rows = 0.001 * np.array([(y, a, a, front, back) for y, a, front, back in _FACE], dtype=float)
    jaw = -0.035 * f.figure + 0.05 * f.fat
    rows[:5, 1:3] *= 1 + jaw
    face = Loft((0, 0, 0.030), frame_along([0, 1, 0], [0, 0, 1]), rows, caps=(0.010, 0.015), exponent=2.3, reach=REACH)
    skull = smooth_union([cranium, face], 0.025)
    chin = _blob((0, 1.511, 0.080), (0.022 - 0.003 * f.figure, 0.014, 0.014))
    cheek = _blob((0.042, 1.578, 0.061), (0.026, 0.024, 0.030))
    brow = ellipsoid((0.028, 1.626, 0.082), frame_along([1, 0.02, -0.45], [0, 0, 1]), (0.010, 0.012, 0.030), reach=REACH)
    skull = smooth_union([skull, chin, cheek, brow], 0.018)
    skull = smooth_cut(skull, _blob((0.033, 1.607, 0.106), (0.018, 0.010, 0.016)), 0.012)
    skull = smooth_union([skull, _blob((0.032, 1.606, 0.081), (0.0155, 0.0105, 0.0135))], 0.004)
    skull = smooth_union([skull, *_lips()], 0.008)
    return smooth_union([smooth_union([skull, *_nose()], 0.009), *_ear()], 0.006)


def _blob(centre, radii):
    return ellipsoid(centre, np.eye(3), radii, reach=REACH)


def _nose():
    return [
        capsule((0, 1.614, 0.091), (0, 1.577, 0.111), (0.0072, 0.0088)),
        _blob((0, 1.572, 0.112), (0.0098, 0.0090, 0.0098)),
        _blob((0.0112, 1.569, 0.102), (0.0076, 0.0078, 0.0105)),
    ]


def _lips():
    return [
        _blob((0.0, 1.5450, 0.0925), (0.0235, 0.0075, 0.0080)),
        _blob((0.0, 1.5325, 0.0915), (0.0210, 0.0078, 0.0076)),
    ]


def _ear():
    frame = frame_along([0.10, 1, -0.22], [1, -0.1, 0.38])
    shell = ellipsoid((0.078, 1.596, -0.012), frame, (0.0165, 0.0060, 0.0315), reach=REACH)
    hollow = ellipsoid((0.0855, 1.597, -0.007), frame, (0.0090, 0.0050, 0.0170), reach=REACH)
    lobe = _blob((0.072, 1.572, 0.000), (0.006, 0.010, 0.008))
    return [smooth_cut(smooth_union([shell, lobe], 0.006), hollow, 0.004)]
