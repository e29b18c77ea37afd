"""Checks of the losses' arguments: one clear error for each bad one, at a few microseconds a call."""

import sys
from numbers import Real

import numpy as np

from ..errors import ONE_AT_A_TIME, InputError, as_array, as_floats, brief, check_unmasked, did_you_mean, its_array, not_finite
from ..neighbors import PointIndex

__all__ = [
    "LARGEST",
    "as_float",
    "check_choice",
    "check_flag",
    "check_index",
    "check_labels",
    "check_number",
    "check_same_length",
    "check_set",
    "check_weights",
]

# Searching within parts takes memory, and loses digits, in proportion to the largest label.
_MOST_PARTS = 2**16
# Sums of many squares of coordinates have to stay within double precision.
LARGEST = 1e150


def check_set(argument, value, most=LARGEST):
    """A point set as a finite, non-empty (k, 3) float array, all below ``most``; the input itself where it is one."""
    a = as_floats(argument, value, "numbers of shape (k, 3)", its_array(value))
    if a.ndim != 2 or a.shape[1] != 3:
        remedy = ONE_AT_A_TIME if a.ndim == 3 and a.shape[2] == 3 else None
        raise InputError(argument, f"shape {a.shape}", "shape (k, 3), one point per row", remedy)
    if not len(a):
        raise InputError(argument, "an empty set", "at least one point")
    largest = np.abs(a).max()
    if not largest < most:  # not: NaN fails every comparison
        finite = np.isfinite(a)
        if finite.all():
            raise InputError(argument, f"coordinates of up to {largest:.3g}", f"coordinates below {most:.0e}")
        bad = np.flatnonzero(~finite.all(axis=1))
        raise InputError(argument, f"{not_finite(len(bad), 'point')}, the first at row {bad[0]}", "finite numbers")
    return a


def check_same_length(argument, a, other, b):
    """Raise unless two point sets have as many points."""
    if len(a) != len(b):
        raise InputError(argument, f"{len(a)} points", f"{len(b)}, as many as in {other}")


def check_labels(argument, value, n):
    """Parts of n points as an int array of values from 0."""
    check_unmasked(argument, value)
    a = as_array(argument, value, f"integers of shape ({n},)")
    if a.shape != (n,):
        raise InputError(argument, f"shape {a.shape}", f"shape ({n},), one label per point")
    if a.dtype.kind not in "iu":
        raise InputError(argument, f"values of type {a.dtype}", "integers")
    if a.dtype.kind == "i" and a.min() < 0:
        got = f"{a.min()} at index {a.argmin()}"
        remedy = "Give points without a part one that the other side never has, such as len(rig.parts)."
        raise InputError(argument, got, "integers of at least 0", remedy)
    if a.max() >= _MOST_PARTS:
        got = f"{a.max()} at index {a.argmax()}"
        raise InputError(argument, got, f"integers below {_MOST_PARTS}", "Number the parts from 0.")
    return a.astype(np.intp, copy=False)


def check_weights(argument, value, n):
    """Non-negative weights of n points with a positive sum, as a float array; None stays None."""
    if value is None:
        return None
    a = as_floats(argument, value, f"numbers of shape ({n},)")
    if a.shape != (n,):
        raise InputError(argument, f"shape {a.shape}", f"shape ({n},), one weight per point")
    if not (a.min() >= 0 and 0 < a.sum() < np.inf):  # not: NaN fails every comparison
        raise InputError(argument, "weights that are negative, not finite, or all 0", "finite weights of at least 0, not all 0")
    return a


def check_index(argument, index, points, labels=None):
    """Raise unless a search structure is over these points, with these labels or without any."""
    if not isinstance(index, PointIndex):
        raise InputError(argument, f"a {type(index).__name__}", "a lbsfit_np.neighbors.PointIndex over X, or None")
    if len(index.points) != len(points):
        raise InputError(argument, f"a PointIndex over {len(index.points)} points", f"one over the {len(points)} points of X")
    if (index.labels is None) != (labels is None):
        got, expected = ("with", "without") if labels is None else ("without", "with")
        raise InputError(argument, f"a PointIndex {got} labels", f"one {expected} labels")
    for what, own, given in (("points", index.points, points), ("labels", index.labels, labels)):
        if own is not given and not np.array_equal(own, given):
            raise InputError(argument, f"a PointIndex over other {what} than X has", f"one over these {what}", "Build it again.")


def check_number(argument, value):
    """A finite number of at least 0 as a float, whatever its type: sums with single precision would be of that, too."""
    if not isinstance(value, Real) or not 0 <= (number := as_float(value)) <= sys.float_info.max:
        raise InputError(argument, brief(value), "a finite number of at least 0")
    return number


def check_choice(argument, value, known, *, optional=False):
    """Raise InputError unless a value is one of some names; with ``optional`` it may be None."""
    if (value is None and optional) or (isinstance(value, str) and value in known):
        return
    known = tuple(known)
    some, last = (known, None) if optional else (known[:-1], known[-1])
    raise InputError(argument, brief(value), f"{', '.join(map(repr, some))} or {last!r}", did_you_mean(value, known))


def check_flag(argument, value):
    """True or False, Python's or NumPy's, as Python's; else InputError."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(argument, brief(value), "True or False")
    return bool(value)


def as_float(value):
    """A real number in double precision."""
    try:
        return float(value)
    except OverflowError:  # a whole number beyond double precision
        return np.inf
