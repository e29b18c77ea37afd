"""Exact nearest neighbours from one point set to another, over all points or only among points of the same part."""

import numpy as np

from .errors import InputError

__all__ = ["PointIndex", "neighbour_distances", "spacing"]

# Parts are set apart along x by this many diameters, so that one tree serves all parts and never mixes them.
_APART = 64.0
# That takes digits off their coordinates: at most this share of the usual extent of so many points. Where it takes more, as where
# one point lies very far from all others, each part is searched by itself.
_LOST, _SOME = 1e-7, 64
# Points in a leaf of the tree of a set that is rebuilt at every evaluation: of 500 to 7,000 vertices, building and searching it
# take up to 15 % less time than with SciPy's 10, which other sets have.
_LEAF = 24


class PointIndex:
    """A search structure over one point set.

    Parameters
    ----------
    points : (n, 3) array
        The points to search in.
    labels : (n,) int array, optional
        Parts, from 0. When given, a query of part p finds the nearest point of part p only.
    moving : bool, default False
        True for a set that is rebuilt at every evaluation: the tree is then built faster and searched a little more slowly.

    Raises
    ------
    InputError
        Labels that are no whole numbers from 0.
    """

    def __init__(self, points, labels=None, *, moving=False):
        from scipy.spatial import cKDTree

        points = np.asarray(points)
        if labels is not None:
            labels = np.asarray(labels)
            if labels.shape != points.shape[:1] or labels.dtype.kind not in "iu":
                got = f"{labels.dtype} values of shape {labels.shape}"
                raise InputError("labels", got, f"whole numbers of shape ({len(points)},), one for each point")
            if len(labels) and labels.min() < 0:
                remedy = "Give points without a part one that the other side never has, such as len(rig.parts)."
                raise InputError("labels", f"{labels.min()} at index {labels.argmin()}", "whole numbers of at least 0", remedy)
            labels = labels.astype(np.intp, copy=False)  # NumPy 2.0 counts no unsigned ones
        self.points = points
        self.labels = labels
        if labels is not None:
            self._centre = points.mean(axis=0, dtype=float)
            radius = np.abs(points - self._centre).max() if len(points) else 1.0
            self._gap = _APART * max(float(radius), 1e-100)  # points at one place: apart still, once squared
            self._present = np.bincount(labels) > 0
            if self._gap * len(self._present) * np.finfo(float).eps > _LOST * _usual_extent(points):
                self._tree = None
                return
        self._tree = cKDTree(self._apart(points, labels), leafsize=_LEAF if moving else 10, balanced_tree=not moving)

    def nearest(self, queries, labels=None):
        """Find the nearest point to each query.

        Parameters
        ----------
        queries : (k, 3) array
        labels : (k,) int array
            Parts of the queries, negative for a query without a part; needed exactly when the index has labels.

        Returns
        -------
        index : (k,) int array
            Row of ``points``; −1 where no point has the query's part.

        Raises
        ------
        InputError
            Labels for an index without them, or none for one with labels.
        """
        if (labels is None) != (self.labels is None):
            got, expected = ("None", "parts of the queries") if labels is None else (f"a {type(labels).__name__}", "None")
            raise InputError("labels", got, f"{expected}, as the index was made with{'out' * (self.labels is None)} labels")
        if labels is None:
            return self._tree.query(queries)[1]
        queries, labels = np.asarray(queries), np.asarray(labels)
        known = (labels >= 0) & (labels < len(self._present))
        known[known] = self._present[labels[known]]
        index = np.full(len(queries), -1)
        if not known.any():
            return index
        if self._tree is not None and np.abs(queries - self._centre).max() < self._gap / 4:
            index[known] = self._tree.query(self._apart(queries[known], labels[known]))[1]
        else:  # a query, or a point, so far away that the gaps could not keep the parts apart
            for p in np.unique(labels[known]):
                rows = np.flatnonzero(self.labels == p)
                asked = np.flatnonzero(labels == p)
                index[asked] = rows[PointIndex(self.points[rows]).nearest(queries[asked])]
        return index

    def _apart(self, points, labels):
        if labels is None:
            return points
        shifted = np.asarray(points, dtype=float) - self._centre  # in single precision the gaps would leave no digits
        shifted[:, 0] += labels * self._gap
        return shifted


def neighbour_distances(points, k):
    """(n,) distance of each point's k-th neighbour, itself not counted; infinite where there are fewer."""
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=[k + 1])[0][:, 0]


def spacing(third):
    """How far apart points of a surface are where they are sparse, by the distances (n,) of their third neighbours."""
    return 2.0 * float(np.median(third))


def _usual_extent(points):
    """How far apart, along an axis, the middle half of some of the points lie."""
    some = np.sort(points[:: max(1, len(points) // _SOME)], axis=0)
    return float((some[-1 - len(some) // 4] - some[len(some) // 4]).max()) if len(some) else 0.0
