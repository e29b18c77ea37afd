"""What of a scan is the body: wild points and floors are left out before anything is measured."""

from .floor import off_floor
from .scale import checked_extent, near_rows

__all__ = ["clean_rows"]


def clean_rows(points, rows, *, up=None):
    """Rows of a scan that take part in a fit.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array
    up : (3,) array, optional
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
    rows, floor = off_floor(points, rows, up=up)
    told = (wild, "far from all others"), (floor, "of a floor")
    notes = [f"{n} point{'' if n == 1 else 's'} {where} left out" for n, where in told if n]
    return rows, "; ".join(notes) + (looked_at if notes else "")
