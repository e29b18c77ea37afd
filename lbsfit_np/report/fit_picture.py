"""A fit as a picture: the scan by its parts beside the registered mesh, from two sides."""

import numpy as np

from ..errors import InputError
from ..optimize.frame import root_turn
from ..scan import check_points, some_rows
from .colors import label_colors, part_colors
from .render import Mesh, Points, montage, render

__all__ = ["axes_of", "drawn_fit", "fit_picture"]

_VIEWS = ("front", "oblique")
# Of a larger scan, so many points are drawn.
_MOST_POINTS = 30_000
# The picture ends so far from the mesh, as a share of its extent.
_ROOM = 0.6


def axes_of(rig):
    """How a rig stands, as ``render`` takes it: "up" and "forward"."""
    up = rig.up or "+y"
    forward = None if rig.forward and rig.forward[-1] == up[-1] else rig.forward  # where up is but assumed
    return {"up": up, "forward": forward}


def fit_picture(rig, points, result, *, truth=None, size=(420, 480)):
    """Draw a fit.

    Parameters
    ----------
    rig : Rig
    points : (n, 3) array or Scan
        What was fitted.
    result : FitResult
        Of it.
    truth : (m, 3) array, optional
        The true mesh, drawn between the two in grey.
    size : (int, int)
        Of each of the pictures, pixels.

    Returns
    -------
    (h, w, 3) uint8 array
        From left to right the scan coloured by the parts found, grey where it is off the mesh, the true mesh, the registered
        mesh in the same colours; the first line seen from the front, the second obliquely. All turned back as the rig stands,
        so that subjects are seen from their own front however their scans lie.
    """
    points = check_points(points)
    if len(points) != len(result.labels):
        raise InputError("points", f"{len(points)}", f"{len(result.labels)}, as many as the fit has labels")
    truth = None if truth is None else rig.without_loose(truth) @ root_turn(rig, result.pose)
    cloud, mesh, axes = drawn_fit(rig, points, result, () if truth is None else [truth])
    items = [cloud, *([] if truth is None else [Mesh(truth, rig.faces)]), mesh]
    return montage([[render(item, view=view, size=size, **axes) for item in items] for view in _VIEWS])


def drawn_fit(rig, points, result, more=()):
    """What pictures of a fit are made of, turned back as the rig stands.

    Parameters
    ----------
    rig : Rig
    points : (n, 3) array
        As many as ``result`` has labels.
    result : FitResult
    more : sequence of (k, 3) arrays
        Turned back, what is to be seen as well.

    Returns
    -------
    cloud : Points
        The scan coloured by the parts found, grey where it is off the mesh or left out; of very many points some.
    mesh : Mesh
        The registered one, in the same colours.
    axes : dict
        The rest of what ``render`` takes, with a "frame" that wild points and wide floors do not stretch.
    """
    turn, colors = root_turn(rig, result.pose), part_colors(len(rig.parts))
    rows = some_rows(points, _MOST_POINTS)
    found = rig.without_loose(result.vertices) @ turn
    cloud = Points(points[rows] @ turn, label_colors(result.labels[rows], result.confidence[rows], len(rig.parts)))
    # What of the scan lies off the mesh is to be seen, too, but for single wild points and all of a wide floor.
    around = np.clip(cloud.points, *np.percentile(cloud.points, [1, 99], axis=0))
    room = _ROOM * np.ptp(found, axis=0).max()
    around = np.clip(around, found.min(axis=0) - room, found.max(axis=0) + room)
    axes = axes_of(rig) | {"frame": np.vstack([found, around, *more])}
    return cloud, Mesh(found, rig.faces, colors[rig.vertex_labels]), axes
