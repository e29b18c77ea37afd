"""Colours for parts: the same number always has the same colour, and neighbouring numbers look different to most eyes."""

from functools import cache

import numpy as np

__all__ = ["label_colors", "part_colors"]

# The palette of Okabe and Ito, made to be told apart with any of the common kinds of colour vision; its yellow darker, for
# white paper, and in an order that sets neighbours apart.
_FIRST = [(0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0), (222, 205, 40)]

# Labels of less confidence are of points off the mesh or of no body: they have a colour of no part.
_OFF, _OFF_COLOR = 0.05, (205, 205, 205)

# Linear RGB as protanopes and deuteranopes see it (Viénot, Brettel and Mollon, 1999).
_PROTAN = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
_DEUTAN = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])

# Linear RGB to Oklab (Ottosson, 2020), in which distances are about what people see.
_LMS = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def part_colors(n):
    """Colours for parts 0 … n − 1.

    Seven hand-picked colours; each further one is, of a lattice of colours that show on white, the one whose nearest earlier
    colour is farthest, seen by normal, red-blind and green-blind eyes; the four colours just before it want to be three times as
    far. After some hundred colours they repeat.

    Parameters
    ----------
    n : int

    Returns
    -------
    (n, 3) uint8 array
        RGB. ``part_colors(n)[:k]`` is ``part_colors(k)``.
    """
    palette = _palette()
    return palette[np.arange(n) % len(palette)]


def label_colors(labels, confidence, n):
    """Colours of a scan's points by their parts, of ``n``; grey where the label is of no confidence: clutter, a floor.

    Parameters
    ----------
    labels : (k,) int array
    confidence : (k,) array
    n : int

    Returns
    -------
    (k, 3) uint8 array
        RGB.
    """
    return np.where(confidence[:, None] < _OFF, np.array(_OFF_COLOR, np.uint8), part_colors(n)[labels])


@cache
def _palette():
    levels = np.array([30, 80, 130, 180, 225, 250])
    lattice = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    lightness, chroma = _oklab(lattice)[:, 0], np.linalg.norm(_oklab(lattice)[:, 1:], axis=1)
    lattice = lattice[(lightness > 0.35) & (lightness < 0.87) & (chroma > 0.05) & (chroma < 0.2)]
    colors = np.concatenate([_FIRST, lattice])
    seen = [_oklab(colors, matrix) for matrix in (np.eye(3), _PROTAN, _DEUTAN)]
    distance = np.min([np.linalg.norm(lab[:, None] - lab[None], axis=2) for lab in seen], axis=0)
    chosen = list(range(len(_FIRST)))
    left = list(range(len(_FIRST), len(colors)))
    while left:
        apart = np.minimum(distance[np.ix_(left, chosen)].min(axis=1), 0.3 * distance[np.ix_(left, chosen[-4:])].min(axis=1))
        chosen.append(left.pop(int(np.argmax(apart))))
    palette = colors[chosen].astype(np.uint8)
    palette.flags.writeable = False
    return palette


def _oklab(rgb, matrix=None):
    """Oklab coordinates of (n, 3) colours 0–255, as an eye sees them whose vision is a matrix on linear RGB."""
    linear = (np.asarray(rgb) / 255.0) ** 2.2
    if matrix is not None:
        linear = np.clip(linear @ matrix.T, 0.0, 1.0)
    return np.cbrt(linear @ _LMS.T) @ _LAB.T
