"""What of a scan is the body: pixels without depth, wild points and floors are left out before anything is measured."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError, counted
from .floor import off_floor
from .scale import checked_extent, near_rows, reference_scale
from .turns import axis_name

__all__ = ["BEYOND", "TakingPart", "clean_rows", "taking_part"]

# So many points in one place, as a share of all and against what is usual in the scan, are no surface: cameras write pixels
# without depth as zeros, and programs fill a cloud up with its first point.
_LEAST, _SHARE, _TIMES = 20, 0.005, 20
# Where fewer of the points that were drawn are of the body than this share of those wanted, more are drawn.
_ENOUGH = 0.8
# Why points are not ``among`` those that may take part.
BEYOND = "the scan seems to go on beyond the rig"
# Points that are judged by others, at a time.
_AT_ONCE = 200_000
# Points that weigh less than this share of what is usual take no part: the weight that a quarter of those with any reach.
_HARDLY, _USUAL = 0.01, 0.75
# The last steps look at so many times as many points, where there are as many.
_LAST = 4


@dataclass(frozen=True)
class TakingPart:
    """What of a scan its fit looks at.

    Attributes
    ----------
    rows : int array
        Points that take part.
    more : int array
        Further ones of the body, which the last steps look at as well; none where all take part.
    note : str
        Which do not, in words.
    scale : float
        How many of the scan's units a rig unit seems to have.
    doubtful : int, "walls" or None
        What is left out that may be a flat side of the body, such as a palm that faces the camera: what lies below which of the
        directions that may be up, but for the likeliest; or walls on a floor. None where nothing is.
    known : (n,) int8 array
        Of each point of the scan: 1 of the body, 0 looked at and left out, −1 not looked at, −2 never to take part, −3 neither,
        as it weighs next to nothing.
    among : (n,) bool array or None
        Which points of the scan may take part, where others lie beyond the end of the rig, or apart; None where all may.
    """

    rows: np.ndarray
    more: np.ndarray
    note: str
    scale: float
    doubtful: int | str | None
    known: np.ndarray
    among: np.ndarray | None = None

    @property
    def every(self):
        """Rows of the points that the last steps look at, in order."""
        return np.union1d(self.rows, self.more)

    @classmethod
    def only(cls, rows, n):
        """These rows of n points, and nothing left out."""
        return cls(rows, rows[:0], "", 1.0, None, np.ones(n, np.int8))

    def left_out(self, points):
        """(n,) bool: which points of the scan, all of which are given, are none of the body, or shall not take part.

        Few of a large scan's points are looked at: the others are judged by these.
        """
        out = self.known != 1
        others, dropped = np.flatnonzero(self.known == -1), np.flatnonzero(self.known == 0)
        for start in range(0, len(others), _AT_ONCE):
            piece = others[start : start + _AT_ONCE]
            out[piece] = ~_of_the_same(points, self.rows, dropped, piece)
        return out

    def is_clutter(self, left_out):
        """(n,) bool: none of the body's, of what :meth:`left_out` says; points without weight may be of the body.

        So may those that were not looked at, where nothing was left out that they could be of, or only what lies
        beyond the rig, or apart.
        """
        unseen = bool(((self.known == 0) & (True if self.among is None else self.among)).any())
        return left_out & (self.known != -3) & ((self.known != -1) | unseen)

    def told(self, left_out):
        """The note, and where not all of the scan was looked at, how many of all that are, as :meth:`left_out` says.

        Not where the note is of points without weight alone, all of which it counts.
        """
        if not self.note or not (self.known == -1).any() or not np.isin(self.known, (0, -2)).any():
            return self.note
        return f"{self.note}, {np.count_nonzero(left_out & (self.known != -3))} of all {len(left_out)}"


def taking_part(
    points,
    rig,
    *,
    most,
    rng,
    scale,
    unit=None,
    ups=None,
    sure=False,
    point_weights=None,
    labels=None,
    among=None,
    why=BEYOND,
    cropped=False,
):
    """What of a scan its fit looks at.

    Parameters
    ----------
    points : (n, 3) array
    rig : Rig
    most : int
        Points at most; where there are more they are drawn.
    rng : numpy.random.Generator
    scale : {"estimate", "fixed"}
    unit : str, optional
        As for :func:`~lbsfit_np.starts.scale.reference_scale`.
    ups, sure
        As for :func:`clean_rows`.
    point_weights : (n,) array, optional
        Points of weight 0 never take part, nor those of less than 1 % of the weight that a quarter of the others reach.
    labels : (n,) int array, optional
        Known parts: what has one is of no floor; −1 where one is not known.
    among : (n,) bool array, optional
        Which points may take part, where others lie beyond the end of the rig, or apart from the body; by default all.
    why : str
        Why the others may not, in words.
    cropped : bool, default False
        As for :func:`~lbsfit_np.starts.scale.reference_scale`.

    Returns
    -------
    TakingPart

    Raises
    ------
    InputError
        Points without an extent that can be worked with, or in another unit than the rig's where the scale is "fixed", or than
        ``unit``; fewer points than the rig has parts once some are left out; weights that are all 0.
    """
    heavy = np.ones(len(points), dtype=bool) if point_weights is None else _counts(point_weights)
    rows = np.flatnonzero(heavy)
    if not len(rows):
        raise InputError("point_weights", "all zeros", "at least one positive weight")
    light = 0 if point_weights is None else np.count_nonzero(point_weights) - len(rows)
    rows, same = _in_places_of_their_own(points, rows)
    drawn = rows if len(rows) <= most else np.sort(rng.choice(rows, most, replace=False))
    sides = {"ups": ups, "sure": sure, "body": None if labels is None else labels >= 0, "among": among, "why": why}
    body, note, doubtful = _of_the_body(points, drawn, **sides)
    if len(drawn) < len(rows) and len(body) < _ENOUGH * most:
        enough = min(len(rows), int(most * most / max(len(body), most // 50, 1)))
        drawn = np.sort(rng.choice(rows, enough, replace=False))
        body, note, doubtful = _of_the_body(points, drawn, **sides)
    kept = body if len(body) <= most else np.sort(rng.choice(body, most, replace=False))
    told = f"{counted(light, 'point')} of next to no weight left out" if light else ""
    words = "; ".join(filter(None, (told, f"{same} identical points left out" if same else "", note)))
    if words and len(kept) < len(rig.parts):
        got = f"{counted(len(kept), 'point')} that may be of the body ({words})"
        raise InputError("points", got, f"at least {len(rig.parts)} points, one for each part")
    dropped = np.setdiff1d(drawn, body, assume_unique=True)
    others = np.setdiff1d(rows, np.union1d(kept, dropped), assume_unique=True)
    if among is not None:
        others = others[among[others]]
    known = np.where(heavy, -2, -3).astype(np.int8)
    known[others], known[dropped], known[body] = -1, 0, 1
    if labels is not None and labels[kept].min() >= 0:  # where steps go by labels, they go by all
        others = others[labels[others] >= 0]
    more = _alike(points, kept, dropped, others, (_LAST - 1) * most, rng)
    parts = None if labels is None or labels[kept].min() < 0 else np.unique(labels[kept])
    shown = None if parts is None else np.isin(rig.vertex_labels, parts)
    unit = reference_scale(points[kept], rig, scale, unit, whole=labels is None, shown=shown, cropped=cropped).scale
    return TakingPart(kept, more, words, unit, doubtful, known, among)


def _counts(weights):
    """(n,) bool: which points count for enough to take part; the others would be seen, in the search for one, as if they did."""
    some = weights > 0
    return some & (weights >= _HARDLY * np.quantile(weights[some], _USUAL)) if some.any() else some


def _of_the_body(points, drawn, *, among, why, **sides):
    """:func:`clean_rows`, without what is not ``among``, which is told as well."""
    body, note, doubtful = clean_rows(points, drawn, **sides)
    if among is None:
        return body, note, doubtful
    within = body[among[body]]
    share = 1.0 - len(within) / max(len(body), 1)
    others = f"{why}: {share:.0%} of its points left out"
    return within, "; ".join(filter(None, (others, note))), doubtful


def _alike(points, kept, dropped, others, most, rng):
    """Some of the other rows, at most so many, that are of the same as those that were kept."""
    if not len(others) or len(kept) < 2:
        return others[:0]
    others = others if len(others) <= most else np.sort(rng.choice(others, most, replace=False))
    return others[_of_the_same(points, kept, dropped, others)]


def _of_the_same(points, kept, dropped, others):
    """Of other rows, (len(others),) bool, which are as near to a row that was kept as these are to each other.

    What lies nearer to one that was dropped, or is far from all, may be of what that is of.
    """
    from scipy.spatial import cKDTree

    if not len(others) or len(kept) < 2:
        return np.zeros(len(others), dtype=bool)
    tree = cKDTree(points[kept])
    apart = tree.query(points[kept], k=2)[0][:, 1].max()
    within = np.nextafter(apart, np.inf)  # what is further away is not looked for
    away = tree.query(points[others], distance_upper_bound=within)[0]
    near = away <= apart
    if len(dropped) and near.any():
        beside = cKDTree(points[dropped]).query(points[others[near]], distance_upper_bound=within)[0]
        near[near] = away[near] < beside
    return near


def _in_places_of_their_own(points, rows):
    """The rows without those of places that have very many points, and how many these are."""
    x, y, z = points[rows].T
    with np.errstate(over="ignore", invalid="ignore"):
        mixed = np.sqrt(2.0) * x + np.sqrt(3.0) * y + np.sqrt(5.0) * z  # one number a place, to sort by
    _, place, count = np.unique(mixed, return_inverse=True, return_counts=True)
    many = (count >= max(_LEAST, _SHARE * len(rows))) & (count >= _TIMES * np.median(count))
    there = many[place] & np.isfinite(mixed)  # what is too large to be worked with is told of its extent
    return rows[~there], int(there.sum())


def clean_rows(points, rows, *, ups=None, sure=False, body=None):
    """Rows of a scan that take part in a fit.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array
    ups, sure, body
        As for :func:`~lbsfit_np.starts.floor.off_floor`.

    Returns
    -------
    rows : int array
    note : str
        What was left out, in words; empty where all take part.
    doubtful : int, "walls" or None
        As in :class:`TakingPart`.

    Raises
    ------
    InputError
        Points without an extent that can be worked with.
    """
    checked_extent(points[rows])
    looked_at = f" (of {len(rows)} examined)" if len(rows) < len(points) else ""
    rows, wild = near_rows(points, rows)
    rows, floor, below, walls = off_floor(points, rows, ups=ups, sure=sure, body=body)
    # Below another axis than is taken for up, which may be wrong, it may be either.
    where = f"of a floor or wall on the {axis_name(-ups[below])} side" if below else "of a floor"
    told = (wild, "far from all others"), (floor, where), (walls, "of walls")
    notes = [f"{counted(n, 'point')} {where} left out" for n, where in told if n]
    return rows, "; ".join(notes) + (looked_at if notes else ""), below or ("walls" if walls else None)
