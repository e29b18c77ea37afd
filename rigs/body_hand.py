"""The left hand of the bundled body: a palm and five relaxed, slightly spread digits.

Simpler than the bundled hand, whose proportions (table in README.md) it shares. Local axes: u towards the thumb, v out of the
back of the hand, w along the hand.
"""

import numpy as np

from .body_parts import REACH
from .implicit import Loft, capsule, ellipsoid, smooth_union

__all__ = ["hand"]

_LENGTH = 0.186
# Knuckle (u, v, w), direction in degrees towards the thumb, lengths of three phalanges, bends at their three joints in degrees,
# radii at the four ends; metres. The thumb's bend turns it across the palm.
_DIGITS = {
    "index": ((0.0215, 0.000, 0.083), 6.0, (0.0455, 0.0265, 0.0195), (10, 16, 9), (0.0100, 0.0092, 0.0082, 0.0066)),
    "middle": ((0.0005, 0.002, 0.084), 0.5, (0.0490, 0.0315, 0.0210), (12, 18, 10), (0.0102, 0.0094, 0.0084, 0.0068)),
    "ring": ((-0.0185, 0.000, 0.079), -6.0, (0.0450, 0.0305, 0.0210), (14, 20, 11), (0.0097, 0.0089, 0.0080, 0.0064)),
    "little": ((-0.0355, -0.004, 0.071), -14.0, (0.0375, 0.0220, 0.0180), (15, 20, 11), (0.0087, 0.0079, 0.0072, 0.0058)),
}


def hand(bones, f):
    """Palm and digits, joined to the forearm's end."""
    wrist, knuckles = bones.left("wrist"), bones.left("hand")
    # The thumb's direction is the wrist's axis of flexion: x of the right hand, mirrored.
    row = bones.row("left_wrist")
    u = -bones.frames[row][:, 0]
    w = (knuckles - wrist) / np.linalg.norm(knuckles - wrist)
    v = -bones.frames[row][:, 1]
    local = np.stack([u, v, w], axis=1)
    size = 1 - 0.035 * f.figure

    def at(p):
        return wrist + size * (local @ np.asarray(p, dtype=float))

    rows = size * np.array(
        [  # w, thumb's side, other side, back, palm
            (-0.015, 0.0255, 0.0255, 0.0175, 0.0175),
            (0.002, 0.0262, 0.0270, 0.0168, 0.0175),
            (0.025, 0.0290, 0.0330, 0.0150, 0.0165),
            (0.050, 0.0320, 0.0385, 0.0130, 0.0150),
            (0.072, 0.0345, 0.0420, 0.0115, 0.0140),
            (0.086, 0.0330, 0.0390, 0.0100, 0.0120),
        ]
    )
    thick = 1 + 0.03 * f.fat
    rows[:, 3:] *= thick
    palm = Loft(wrist, local, rows, caps=(0.01, 0.008), exponent=2.6, reach=REACH)
    heel = ellipsoid(at((-0.020, -0.009, 0.030)), local, np.array([0.015, 0.012, 0.032]) * size, reach=REACH)
    body = smooth_union([palm, heel], 0.014)
    digits = [_digit(at, size * thick, *row) for row in _DIGITS.values()]
    fingers = smooth_union([shape for digit in digits for shape in digit], 0.003)
    body = smooth_union([body, fingers], 0.007)
    thumb = smooth_union(_thumb(at, size * thick), 0.008)
    return smooth_union([body, thumb], 0.013)


def _digit(at, size, root, spread, lengths, bends, radii):
    p, turn, angle = np.array(root), np.radians(spread), 0.0
    shapes = []
    for k in range(3):
        angle += np.radians(bends[k])
        direction = np.array([np.sin(turn) * np.cos(angle), -np.sin(angle), np.cos(turn) * np.cos(angle)])
        q = p + lengths[k] * direction
        end = q - direction * radii[3] if k == 2 else q
        shapes.append(capsule(at(p), at(end), (size * radii[k], size * radii[k + 1])))
        p = q
    return shapes


def _thumb(at, size):
    base, knuckle, joint, tip = (
        (0.020, -0.008, 0.018), (0.043, -0.022, 0.054), (0.055, -0.030, 0.083), (0.0605, -0.035, 0.108),
    )  # fmt: skip
    return [
        capsule(at(base), at(knuckle), (0.0150 * size, 0.0118 * size)),
        capsule(at(knuckle), at(joint), (0.0110 * size, 0.0103 * size)),
        capsule(at(joint), at(tip), (0.0103 * size, 0.0078 * size)),
        capsule(at((0.012, -0.006, 0.030)), at((0.030, -0.016, 0.050)), (0.0145 * size, 0.0125 * size)),  # ball of the thumb
        capsule(at((0.022, -0.003, 0.055)), at((0.034, -0.013, 0.052)), (0.0085 * size, 0.0080 * size)),  # web
    ]
