"""What of a scan is the body: wild points and floors are left out before anything is measured."""

import numpy as np

from ..errors import InputError
from .floor import off_floor
from .scale import checked_extent, near_rows, reference_scale

__all__ = ["clean_rows", "taking_part"]


def taking_part(points, rig, *, most, rng, scale, ups=None, point_weights=None):
    """What of a scan its fit looks at.

    Parameters
    ----------
    points : (n, 3) array
    rig : Rig
    most : int
        Points at most; where there are more they are drawn.
    rng : numpy.random.Generator
    scale : {"estimate", "fixed"}
        As for :func:`~lbsfit_np.starts.scale.reference_scale`.
    ups : sequence of (3,) arrays, optional
        As for :func:`clean_rows`.
    point_weights : (n,) array, optional
        Points of weight 0 never take part.

    Returns
    -------
    rows : int array
        Points that take part.
    left_out : str
        Which do not, in words.
    scale : float
        How many of the scan's units a rig unit seems to have.

    Raises
    ------
    InputError
        Points without an extent that can be worked with, or in another unit than the rig's where the scale is "fixed"; weights
        that are all 0.
    """
    rows = np.arange(len(points)) if point_weights is None else np.flatnonzero(point_weights > 0)
    if not len(rows):
        raise InputError("point_weights", "all zeros", "at least one positive weight")
    if len(rows) > most:
        rows = np.sort(rng.choice(rows, most, replace=False))
    rows, left_out = clean_rows(points, rows, ups=ups)
    return rows, left_out, reference_scale(points[rows], rig, scale).scale


def clean_rows(points, rows, *, ups=None):
    """Rows of a scan that take part in a fit.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array
    ups : sequence of (3,) arrays, optional
        As for :func:`~lbsfit_np.starts.floor.off_floor`.

    Returns
    -------
    rows : int array
    note : str
        What was left out, in words; empty where all take part.

    Raises
    ------
    InputError
        Points without an extent that can be worked with.
    """
    checked_extent(points[rows])
    looked_at = f" (of {len(rows)} that were looked at)" if len(rows) < len(points) else ""
    rows, wild = near_rows(points, rows)
    rows, floor = off_floor(points, rows, ups=ups)
    told = (wild, "far from all others"), (floor, "of a floor")
    notes = [f"{n} point{'' if n == 1 else 's'} {where} left out" for n, where in told if n]
    return rows, "; ".join(notes) + (looked_at if notes else "")
