"""The reference scale: how many of the scan's units make one of the rig's, guessed from the two extents."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError

__all__ = ["ReferenceScale", "reference_scale"]

# A pose can fold a body to a fraction of its rest extent but hardly stretch it: a ratio in this range is one unit for both.
_SAME_UNIT = 0.4, 1.8
# Scan units in a rig unit when the two differ by metres, centimetres, millimetres or inches.
_UNITS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001, 39.3701, 1 / 39.3701, 2.54, 1 / 2.54, 25.4, 1 / 25.4)


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
    """
    ratio = _extent(points) / _extent(rig.vertices)
    if not 0 < ratio < np.inf:
        raise InputError("points", f"an extent of {_extent(points):.3g}", "coordinates that double precision can square")
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
    fitting = [u for u in _UNITS if _SAME_UNIT[0] <= ratio / u <= _SAME_UNIT[1]]
    if fitting:
        unit = min(fitting, key=lambda u: abs(np.log(ratio / u / 0.9)))
        return ReferenceScale(unit, f"one rig unit is about {unit:.6g} scan units")
    return ReferenceScale(ratio, f"no known unit: one rig unit taken as {ratio:.4g} scan units")


def _extent(points):
    """Twice the 95th percentile of the distance from the median point: a size that a few outliers do not change."""
    with np.errstate(all="ignore"):  # what is too large to square comes out as infinite, which the caller refuses
        away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        return 2 * float(np.percentile(away, 95) or away.max())  # 0 where nearly all points are at one place
