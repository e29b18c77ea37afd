"""The reference scale: how many of the scan's units make one of the rig's, guessed from the two extents."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError

__all__ = ["ReferenceScale", "extent", "near_rows", "reference_scale"]

# Half sizes of the rig from a scan's median point beyond which nothing of a body lies.
_REACH = 3.0

# A pose can fold a body to a fraction of its rest extent but hardly stretch it: a ratio in this range is one unit for both.
_SAME_UNIT = 0.4, 1.8
# Metres in the units that scans are usually in.
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}


@dataclass(frozen=True)
class ReferenceScale:
    """The guess, and what it rests on in words."""

    scale: float
    note: str


def reference_scale(points, rig, mode):
    """Scan units in a rig unit.

    Parameters
    ----------
    points : (n, 3) array
    rig : Rig
    mode : {"estimate", "fixed"}
        ``fixed``: scan and rig are in one unit, 1; a scan whose extent cannot be the rig's is an error.

    Returns
    -------
    ReferenceScale
        ``estimate``: 1 where the extents allow it; else from metres, centimetres, millimetres or inches to the rig's unit, where
        that is known and the extents allow one of these; else the ratio of the extents.

    Raises
    ------
    InputError
        An extent of 0, as of a single point, or one too large to compute with; a scan that is not in the rig's unit and shall be.
    """
    own = extent(points)
    if own == 0:
        expected = "points that are spread over a surface"
        raise InputError("points", "an extent of 0, as of points at one place", expected, "Check that the scan has coordinates.")
    ratio = own / extent(rig.vertices)
    if not 0 < ratio < np.inf:
        raise InputError("points", f"an extent of {own:.3g}", "coordinates that double precision can square")
    if mode == "fixed":
        if not 0.2 <= ratio <= 3.0:
            raise InputError(
                "scale",
                f"'fixed' for a scan whose extent is {ratio:.3g} times the rig's",
                "a scan in the rig's unit",
                "Convert the scan, or pass scale='estimate'.",
            )
        return ReferenceScale(1.0, "scale fixed at 1")
    if _SAME_UNIT[0] <= ratio <= _SAME_UNIT[1]:
        return ReferenceScale(1.0, "scan and rig are in one unit")
    fitting = {}
    if rig.metres_per_unit is not None:
        fitting = {name: rig.metres_per_unit / metres for name, metres in _UNITS.items()}
        fitting = {name: unit for name, unit in fitting.items() if _SAME_UNIT[0] <= ratio / unit <= _SAME_UNIT[1]}
    if fitting:
        name, unit = min(fitting.items(), key=lambda item: abs(np.log(ratio / item[1] / 0.9)))
        return ReferenceScale(unit, f"the scan seems to be in {name}: one rig unit is {unit:.6g} scan units")
    return ReferenceScale(ratio, f"the scale is a guess from the extents: one rig unit taken as {ratio:.4g} scan units")


def near_rows(points, rows, scale, half):
    """Rows of a scan without those of wild points, which would pull means and squared distances with them.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array
    scale : float
        Scan units in a rig unit.
    half : float
        Half the rig's size.

    Returns
    -------
    rows : int array
        Those within three half sizes of their median point, which a posed body never reaches; all where none are.
    dropped : int
    """
    with np.errstate(all="ignore"):
        away = np.abs(points[rows] - np.median(points[rows], axis=0)).max(axis=1)
        near = away <= _REACH * scale * half
    kept = rows[near] if near.any() else rows
    return kept, len(rows) - len(kept)


def extent(points):
    """Twice the 95th percentile of the distance from the median point: a size that a few outliers do not change."""
    with np.errstate(all="ignore"):  # what is too large to square comes out as infinite, which the caller refuses
        away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        return 2 * float(np.percentile(away, 95) or away.max())  # 0 where nearly all points are at one place
