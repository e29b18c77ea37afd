"""Points of a floor, a table or walls in a scan: planes with the body on one side of them, which go on beyond the body."""

import numpy as np

from ..scan import some_rows

__all__ = ["off_floor"]

# Planes tried; how thick a floor is, and from how far below it on few points may be, as shares of the scan's extent.
_TRIES, _THICK, _BELOW = 300, 0.012, 0.03
# Cosine of how far a floor may be from level, where up is known; the sine is of how far walls may lean against it.
_UPRIGHT, _LEANING = np.cos(np.radians(20)), np.sin(np.radians(20))
# Further planes that are looked for: of a corner two, and one more, such as a table's edge.
_WALLS = 3
# As clutter may be anywhere: the share of the points that may lie below, and how many points make a square one with something
# above, as a share of how many there are around the middle one of the points above.
_CLUTTER_BELOW, _SOMETHING = 0.04, 0.07
# A floor covers at least so many times the area that the body takes on it; the flat side of a body does not.
_WIDER = 1.5
# Share of the points that a floor has at least, and of them the share that lies where nothing is above.
_LEAST, _BEYOND = 0.08, 0.4
# Of all points a floor has at most the first share; more than the second, as that of a room has, only if what is above it is at
# least so high for how wide it is: a flat side of a body has but creases on it.
_MOST, _MUCH, _HIGH = 0.98, 0.9, 0.15
# Near the body a plane is thinner than that: so many times its points' median distance from its middle, which is four standard
# deviations of noise, but not less than this share of the extent.
_SPREADS, _THINNEST = 6.0, 0.002
# In fewer points nothing is looked for.
_FEWEST = 50
# Side of the squares that the plane is divided into, as a share of the extent.
_SQUARE = 0.04


def off_floor(points, rows, *, ups=None, sure=False, body=None):
    """Rows of a scan without those of a floor, and of the walls that stand on it.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array
    ups : sequence of (3,) arrays, optional
        Unit vectors that may be up: only planes below all else and within 20 degrees of the horizontal are looked for, by the
        first one, then by the others, of whose planes the largest is taken. By default planes on any side.
    sure : bool, default False
        Look no further than below the first of these, and for no walls: what else is flat may be a side of the body.
    body : (n,) bool array, optional
        Points that are known to be none of a floor's.

    Returns
    -------
    rows : int array
        All where there is no such plane.
    dropped : int
        Of the first plane.
    below : int or None
        Which of ``ups`` it lies below; None without a plane, and where it may lie anywhere.
    walls : int
        Further points, of planes at a right angle to the first. They are looked for upright: of those that lean by
        up to 20 degrees, only such as have enough points near an upright one are found.
    """
    x, ups = _measured(points[rows]), ups[:1] if sure and ups is not None else ups
    if x is None:
        return rows, 0, None, 0
    (on, normal), below = _plane(x, up=None if ups is None else ups[0]), 0
    if ups is not None and not on.any():
        others = [(k, _plane(x, up=up)) for k, up in enumerate(ups)][1:]
        below, (on, normal) = max(others, key=lambda other: np.count_nonzero(other[1][0]), default=(0, (on, normal)))
    on = on if body is None else on & ~body[rows]
    dropped, rows = int(on.sum()), rows[~on]
    if not dropped:
        return rows, 0, None, 0
    left = len(rows)
    for _ in range(0 if sure else _WALLS):
        x = _measured(points[rows])
        on = np.zeros(len(rows), dtype=bool) if x is None else _plane(x, stands_on=normal)[0]
        on = on if body is None else on & ~body[rows]
        if not on.any():
            break
        rows = rows[~on]
    return rows, dropped, None if ups is None else below, left - len(rows)


def _measured(x):
    """Points about their median in units of their extent; None where they are too few, or have none."""
    size = np.ptp(np.percentile(x, [2, 98], axis=0), axis=0).max() if len(x) >= _FEWEST else 0.0
    return (x - np.median(x, axis=0)) / size if size > 0 else None


def _plane(x, *, up=None, stands_on=None):
    """Points of a scan, of extent 1 about the origin, on a plane: below ``up``, at right angles to another, or on any side.

    Returns
    -------
    on : (k,) bool array
    normal : (3,) array or None
        Towards the body; None without a plane.
    """
    none = np.zeros(len(x), dtype=bool), None
    rng = np.random.default_rng(0)  # the same planes for the same points
    some = x if up is None else x[x @ up <= np.quantile(x @ up, 0.5)]
    a, b, c = (some[rng.integers(len(some), size=_TRIES)] for _ in range(3))
    normal = np.cross(b - a, c - a if stands_on is None else stands_on)
    length = np.linalg.norm(normal, axis=1)
    kept = length > 1e-4
    normal, a = normal[kept] / length[kept, None], a[kept]
    few = x[some_rows(x, 1000)]
    height = few @ normal.T - np.einsum("ka,ka->k", normal, a)
    turn = np.where(height.mean(axis=0) < 0, -1.0, 1.0)  # the body is above; most points may be of the floor
    normal, height = normal * turn[:, None], height * turn
    fits = (height < -_BELOW).mean(axis=0) < _CLUTTER_BELOW
    if up is not None:
        fits &= normal @ up > _UPRIGHT
    support = np.where(fits, (np.abs(height) < _THICK).mean(axis=0), 0.0)
    if not len(support) or support.max() < _LEAST:
        return none
    best = int(support.argmax())
    n, origin = normal[best], a[best]
    for _ in range(3):  # the plane of all its points
        on = np.abs((x - origin) @ n) < _THICK
        origin = x[on].mean(axis=0)
        n = np.linalg.svd(x[on] - origin, full_matrices=False)[2][2]
        n = n if ((x - origin) @ n).mean() > 0 else -n
    if (up is not None and n @ up <= _UPRIGHT) or (stands_on is not None and abs(n @ stands_on) >= _LEANING):
        return none
    height = (x - origin) @ n
    on = height < 1.5 * _THICK
    if not _LEAST <= on.mean() <= _MOST:
        return none
    free = _free(x, on, n)
    if free[on].mean() < _BEYOND:
        return none
    if on.mean() > _MUCH:
        above = x[~on]
        wide = np.ptp(np.quantile(above, [0.1, 0.9], axis=0), axis=0).max()
        if np.quantile(height[~on], 0.9) <= _HIGH * wide:
            return none
    thick = max(_SPREADS * np.median(np.abs(height[on & free])), _THINNEST)
    return on & (free | (height < thick)), n  # feet that stand on it stay but for their soles


def _free(x, on, n):
    """(k,) bool: which points' squares have no more than clutter above them; none where a plane is hardly wider than a body."""
    axes = np.linalg.svd(n[None])[2][1:]
    square = np.floor(x @ axes.T / _SQUARE).astype(int)
    around = _around(square, on)
    free = around <= _SOMETHING * np.median(around[~on])
    if len(np.unique(square[on], axis=0)) < _WIDER * len(np.unique(square[~on & ~free], axis=0)):
        return np.zeros(len(x), dtype=bool)
    return free


def _around(square, on):
    """(n,): how many of the points that are not ``on`` are in each one's square, (n, 2) whole numbers, and around it."""
    square = square - square.min(axis=0) + 1
    step = np.array([square[:, 1].max() + 2, 1])  # numbers of squares, of which none is that of one beyond a border
    occupied, count = np.unique(square[~on] @ step, return_counts=True)
    around = np.zeros(len(square))
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            wanted = (square + [dx, dy]) @ step
            at = np.minimum(np.searchsorted(occupied, wanted), len(occupied) - 1)
            around += np.where(occupied[at] == wanted, count[at], 0)
    return around
