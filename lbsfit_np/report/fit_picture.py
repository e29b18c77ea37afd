"""A fit as a picture: the scan by its parts beside the registered mesh, from two sides."""

import numpy as np

from ..optimize.frame import root_turn
from .colors import part_colors
from .render import Mesh, Points, montage, render

__all__ = ["fit_picture"]

_VIEWS = ("front", "oblique")
# Of a larger scan, so many points are drawn.
_MOST_POINTS = 30_000


def fit_picture(rig, points, result, *, truth=None, size=(420, 480)):
    """Draw a fit.

    Parameters
    ----------
    rig : Rig
    points : (n, 3) array
        The scan.
    result : FitResult
        Of it.
    truth : (m, 3) array, optional
        The true mesh, drawn between the two in grey.
    size : (int, int)
        Of each of the pictures, pixels.

    Returns
    -------
    (h, w, 3) uint8 array
        From left to right the scan coloured by the parts found, the true mesh, the registered mesh in the same colours; the first
        line seen from the front, the second obliquely. All turned back as the rig stands, so that subjects are seen from their
        own front however their scans lie.
    """
    turn, colors = root_turn(rig, result.pose), part_colors(len(rig.parts))
    rows = np.linspace(0, len(points) - 1, min(len(points), _MOST_POINTS)).astype(int)
    found = result.vertices @ turn
    items = [Points(np.asarray(points)[rows] @ turn, colors[result.labels[rows]])]
    if truth is not None:
        items.append(Mesh(truth @ turn, rig.faces))
    items.append(Mesh(found, rig.faces, colors[rig.vertex_labels]))
    # What of the scan lies off the mesh is to be seen, too, but for single wild points.
    around = np.clip(items[0].points, *np.percentile(items[0].points, [1, 99], axis=0))
    frame = np.vstack([found, around] if truth is None else [found, around, truth @ turn])
    up = rig.up or "+y"
    forward = None if rig.forward and rig.forward[-1] == up[-1] else rig.forward  # where up is but assumed
    axes = {"up": up, "forward": forward, "frame": frame}
    return montage([[render(item, view=view, size=size, **axes) for item in items] for view in _VIEWS])
