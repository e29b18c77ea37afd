"""The skin of the bundled body as an implicit surface: trunk, limbs and head blended into one, exactly symmetric."""

import numpy as np

from .body_hand import hand
from .body_head import head
from .body_limbs import arm, leg
from .body_skeleton import HEIGHT, Figure, skeleton
from .body_torso import neck, trunk
from .implicit import smooth_union

__all__ = ["BOX", "surface"]

# Holds the left half (x ≥ 0) of the neutral figure, metres.
BOX = (np.array([0.0, -0.02, -0.20]), np.array([0.78, 1.75, 0.24]))


def surface(figure=None):
    """The skin of one figure in the rest pose (see :mod:`rigs.implicit`).

    Parameters
    ----------
    figure : Figure, optional
        The neutral one by default.

    Returns
    -------
    callable
        Of points (n, 3), metres, both halves.
    """
    figure = figure or Figure()
    unscaled = Figure(**{**vars(figure), "height": HEIGHT})
    bones = skeleton(unscaled)
    body = smooth_union([trunk(bones, unscaled), neck(bones, unscaled)], 0.035)
    body = smooth_union([body, head(bones, unscaled)], 0.016)
    body = smooth_union([body, leg(bones, unscaled)], 0.05)
    upper = smooth_union([arm(bones, unscaled), hand(bones, unscaled)], 0.014)
    body = smooth_union([body, upper], 0.035)
    scale = figure.height / HEIGHT

    def shape(points):
        return scale * body(np.abs(points * [1 / scale, 0, 0]) + points * [0, 1 / scale, 1 / scale])

    return shape
