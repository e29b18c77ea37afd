"""Scan: the unordered points X that a fit is given, with what the file knew about them."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import InputError, as_array, brief, check_unmasked, counted, is_whole, its_array, own_words
from .seeds import generator

__all__ = ["Scan", "check_points", "count_distinct", "some_rows"]

# Points that are looked at for an order, how many rows apart, and how much nearer they are then: squared distances.
_LOOKED_AT, _LAGS, _IN_ORDER = 4000, range(1, 9), 0.7

_DENSER = "A denser scan is needed."
_NO_ROWS = "rows of different lengths or entries that are not numbers"
_NONE_LEFT = "Check how the scan was made: drop_invalid (--drop-invalid) would leave no point."
_LEFT_OUT = "Remove them, or read the file with load_scan(path, drop_invalid=True) (--drop-invalid), which leaves them out."
# Points at a time where distinct ones are counted: nearly always the first ones are enough.
_BLOCK = 1024
# Tables of points have no more columns than this; depth images have.
_COLUMNS = 64


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """An unordered point cloud in its own frame and unit, checked and immutable.

    Parameters
    ----------
    points : (n, 3) array
        X. Kept as float64; n ≥ 1, finite, not all equal.
    normals : (n, 3) array, optional
        As the source has them; length and orientation are not changed.
    labels : (n,) int array, optional
        The part of each point, if the source knows it; −1 and other numbers mean what the source means by them.
    name : str, default "scan"
        The name that results of this scan are given.
    path : Path, optional
        The file it came from.
    notes : tuple of str, or str
        What was noticed or decided while reading; one text is one note.

    Raises
    ------
    InputError
        Points, normals or labels that cannot be used.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    labels: np.ndarray | None = None
    name: str = "scan"
    path: Path | None = None
    notes: tuple = ()

    def __post_init__(self):
        points = check_points(self.points)
        object.__setattr__(self, "points", _frozen(points, np.float64))
        n = len(points)
        if self.normals is not None:
            check_unmasked("normals", self.normals)
            normals = as_array("normals", self.normals, f"numbers of shape ({n}, 3), one row per point")
            if normals.shape != (n, 3) or normals.dtype.kind not in "iuf":
                raise InputError("normals", _described(normals), f"numbers of shape ({n}, 3), one row per point")
            object.__setattr__(self, "normals", _frozen(normals, np.float64))
        if self.labels is not None:
            check_unmasked("labels", self.labels)
            labels = as_array("labels", self.labels, f"whole numbers of shape ({n},), one per point")
            if labels.shape != (n,) or labels.dtype.kind not in "iu":
                raise InputError("labels", _described(labels), f"whole numbers of shape ({n},), one per point")
            if labels.dtype.kind == "u" and labels.max() > np.iinfo(np.int64).max:
                raise InputError("labels", f"{labels.max()}", "whole numbers of at most 63 bits")
            object.__setattr__(self, "labels", _frozen(labels, np.int64))
        object.__setattr__(self, "notes", (self.notes,) if isinstance(self.notes, str) else tuple(self.notes))

    def __setstate__(self, state):
        self.__dict__.update(state)
        for array in (self.points, self.normals, self.labels):  # pickle and copy forget that they are read-only
            if array is not None:
                array.flags.writeable = False

    def __len__(self):
        return len(self.points)

    def __repr__(self):
        more = "".join(f", {name}" for name in ("normals", "labels") if getattr(self, name) is not None)
        size = " x ".join(f"{extent:.4g}" for extent in np.ptp(self.points, axis=0))
        return f"<Scan {self.name!r}: {counted(len(self), 'point')}{more}, {size}>"

    def thinned(self, n, random_state=0):
        """Draw the rows of a random subset of the points; every subset is equally likely.

        Parameters
        ----------
        n : int
            Number of points wanted; all are taken if the scan has no more.
        random_state : int or numpy.random.Generator, default 0

        Returns
        -------
        (min(n, len(scan)),) int array
            Rows in ascending order, none twice.

        Raises
        ------
        InputError
            ``n`` is not a positive whole number.
        """
        if not is_whole(n, 1):
            raise InputError("n", brief(n), "a positive whole number of points")
        if n >= len(self.points):
            return np.arange(len(self.points))
        rng = generator(random_state, "thinned")
        return np.sort(rng.choice(len(self.points), n, replace=False, shuffle=False))


def check_points(points, *, argument="points", minimum=1, drop_invalid=False):
    """Return points that a computation can use, or raise one clear error.

    Parameters
    ----------
    points : (n, 3) array-like, or anything with such an attribute ``points`` (a Scan)
    argument : str, default "points"
        What an error calls the points.
    minimum : int, default 1
        The fewest points that are enough; copies of a point do not count.
    drop_invalid : bool, default False
        Leave out points with a coordinate that is NaN or infinite instead of refusing them.

    Returns
    -------
    (n, 3) float64 array
        The input itself where nothing had to change.

    Raises
    ------
    InputError
        Wrong shape, not numbers, empty, NaN or infinite (with their count and the first index), fewer than ``minimum``
        distinct points, two or more points that are all equal, or a mask that leaves points out.
    """
    if isinstance(points, (str, bytes, os.PathLike)):
        got, remedy = f"the path {brief(os.fsdecode(points))}", "Read a file with load_scan(path)."
        raise InputError(argument, got, "numbers of shape (n, 3)", remedy)
    expected = f"at least {counted(max(minimum, 1), 'point')}"
    try:
        raw = getattr(points, "points", points)
        given = np.asarray(raw)
    except (ValueError, TypeError, RuntimeError) as error:
        words = own_words(raw, error)
        got = type(raw).__name__ if words else _NO_ROWS
        raise InputError(argument, got, "numbers of shape (n, 3)", words) from None
    try:
        if given.dtype.kind == "O":
            given = given.astype(float)
    except (ValueError, TypeError):
        rows = isinstance(points, (list, tuple)) or hasattr(points, "points") or hasattr(points, "__array__")
        got = _NO_ROWS if rows else f"a {type(points).__name__}"
        raise InputError(argument, got, "numbers of shape (n, 3)", its_array(points, ["vertices"])) from None
    except OverflowError:
        raise InputError(argument, "whole numbers beyond double precision", "numbers of shape (n, 3)") from None
    if points is None or given.dtype.kind not in "iuf":
        got = "None" if points is None else f"values of type {given.dtype}"
        raise InputError(argument, got, "numbers of shape (n, 3)")
    if given.size == 0:
        raise InputError(argument, "an empty cloud (0 points)", f"{expected} of shape (n, 3)")
    if given.ndim != 2 or given.shape[1] != 3:
        raise InputError(argument, f"an array of shape {given.shape}", "shape (n, 3), one point per row", _reshaping(given.shape))
    of_array = ": points[~np.ma.getmaskarray(points).any(axis=1)]" if isinstance(raw, np.ma.MaskedArray) else ""
    check_unmasked(argument, raw, rows="points", remedy=f"Leave masked points out{of_array}.")
    with np.errstate(invalid="ignore"):  # of NaN whose bits signal, which is told below
        array = given.astype(np.float64, copy=False)
    finite = np.isfinite(array)
    dropped = ""
    if not finite.all():
        bad = ~finite.all(axis=1)
        count, first = int(bad.sum()), int(np.argmax(bad))
        if not drop_invalid:
            raise InputError(
                argument,
                f"{count} of {len(array)} points with a coordinate that is NaN or infinite, the first at index {first}",
                "finite numbers",
                _NONE_LEFT if bad.all() else _LEFT_OUT,
            )
        array = array[~bad]
        dropped = f" after {count} with a coordinate that is NaN or infinite were left out"
    if not len(array):
        remedy = f"{'No points are left; check' if dropped else 'Check'} how the scan was made."
        raise InputError(argument, f"0 points{dropped}", expected, remedy)
    if len(array) < minimum:
        raise InputError(argument, f"{counted(len(array), 'point')}{dropped}", expected, _DENSER)
    if len(array) > 1 and (array == array[0]).all():
        raise InputError(
            argument, f"{len(array)} points that are all equal, at {_short(array[0])}{dropped}", "points of a surface"
        )
    if (distinct := count_distinct(array, minimum)) < minimum:
        got = f"{len(array)} points, of which {distinct} are distinct{dropped}"
        raise InputError(argument, got, f"at least {minimum} distinct points", _DENSER)
    return array


def some_rows(points, most):
    """Rows of at most ``most`` of the points, in their order; the same whenever they are asked for, without a seed.

    Parameters
    ----------
    points : (n, 3) array
    most : int

    Returns
    -------
    (k,) int array
        Evenly spread. Of points that stand in an order they are drawn: where those of several cameras stand in turn, evenly
        spread rows could all be of one.
    """
    n = len(points)
    if n <= most:
        return np.arange(n)
    if _in_an_order(points):
        return np.sort(np.random.default_rng(0).choice(n, most, replace=False))
    return np.linspace(0, n - 1, most).astype(int)


def _in_an_order(points):
    """Whether points some rows apart are nearer to each other than any two, of which the mean squared distance is 2 σ²."""
    n = len(points) - max(_LAGS)
    if n < 1:
        return False
    at = np.linspace(0, n - 1, min(n, _LOOKED_AT)).astype(int)  # of a stretch alone, all would be near each other
    some = points[at]
    of_any = 2 * ((some - some.mean(axis=0)) ** 2).sum()
    return any(((points[at + lag] - some) ** 2).sum() < _IN_ORDER * of_any for lag in _LAGS)


def count_distinct(points, enough):
    """How many points (n, 3) differ from each other; no more are looked at once there are ``enough``."""
    seen = set()
    for start in range(0, len(points), _BLOCK):
        if len(seen) >= enough:
            break
        seen.update(map(tuple, points[start : start + _BLOCK].tolist()))
    return len(seen)


def _frozen(array, dtype):
    """The array, read-only and contiguous; a copy wherever the caller could still write to it.

    A read-only array that does not own its data is a view of something that may well be written to.
    """
    out = np.ascontiguousarray(array, dtype=dtype)
    if np.may_share_memory(out, array) and (out.flags.writeable or not out.flags.owndata):
        out = out.copy()
    out.flags.writeable = False
    return out


def _described(array):
    return f"{array.dtype} values of shape {array.shape}"


def _short(point):
    return "(" + ", ".join(f"{c:.6g}" for c in point) + ")"


def _reshaping(shape):
    if len(shape) == 2 and shape[0] == 3:
        return "Transpose it: points.T."
    if len(shape) == 2 and shape[1] > _COLUMNS:
        return "Turn a depth image into points by its camera's intrinsics first; of a table pass the coordinates: points[:, :3]."
    if len(shape) == 2 and shape[1] > 3:
        return "Pass the coordinates only: points[:, :3]."
    if len(shape) == 3 and shape[-1] == 3:
        return "Pass one cloud at a time; flatten an organised cloud with points.reshape(-1, 3)."
    return None
