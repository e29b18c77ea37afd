"""Things that stand apart in a scan, of which one may be the body: other people, furniture."""

import numpy as np

from ..scan import some_rows

__all__ = ["things_apart"]

# Points further from each other than so many times as most are from their third neighbour, and than this share of the extent, are
# not of one thing, unless others lead from one to the next. Density may vary tenfold, threefold in distance.
_GAP, _MOST, _OF_THE_EXTENT = 3.0, 0.95, 0.02
# Things with less than this share of the points may be limbs that a view shows by themselves.
_LEAST = 0.2
# Points that are linked at most: how many pairs there are grows by the square.
_LINKED = 20_000


def things_apart(points, rows):
    """Parts of a scan that no points lead between, the largest first.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array
        Points that take part; of very many, some are looked at.

    Returns
    -------
    list of (n,) bool arrays
        For each thing, which points may be of it: those of ``rows``, and others that lie nearest to one of these. Empty where no
        two are large enough.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    x = points[rows]
    x = x[some_rows(x, _LINKED)]
    places = np.unique(x, axis=0)  # triangles that share no vertices have each of theirs several times
    if len(places) < 10:
        return []
    third = np.quantile(cKDTree(places).query(places, k=[4])[0], _MOST)
    tree = cKDTree(x)
    size = np.ptp(np.percentile(x, [2, 98], axis=0), axis=0).max()
    pairs = tree.query_pairs(max(_GAP * third, _OF_THE_EXTENT * size), output_type="ndarray")
    linked = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(x), len(x)))
    thing = connected_components(linked, directed=False)[1]
    count = np.bincount(thing)
    large = np.argsort(-count, kind="stable")[: int(1 / _LEAST)]
    large = large[count[large] >= _LEAST * len(x)]
    if len(large) < 2:
        return []
    of = np.append(thing, -1)[tree.query(points)[1]]  # what is too far away to be squared has no nearest point
    return [of == k for k in large]
