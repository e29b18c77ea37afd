"""Welding: which vertices are one point of the surface, split only for texture coordinates or normals."""

import numpy as np

__all__ = ["weld_map"]

# Seam copies are written from one float32 position; anything further apart than this share of the size is another point.
_POSITION = 1e-6
# Copies of one vertex carry the same skin; two sheets that touch (lips, a sleeve on an arm) do not, and stay apart.
_WEIGHT = 0.02


def weld_map(vertices, weights):
    """Distinct vertices, numbered in order of first appearance.

    Parameters
    ----------
    vertices : (m, 3) array
    weights : (m, J) sparse array

    Returns
    -------
    (m,) int array
        The distinct vertex that each vertex is.
    """
    size = max(float(np.ptp(vertices, axis=0).max()), np.finfo(float).tiny)
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(vertices).query_pairs(_POSITION * size, output_type="ndarray")
    if len(pairs):
        apart = abs(weights[pairs[:, 0]] - weights[pairs[:, 1]]).sum(axis=1)
        pairs = pairs[np.asarray(apart).ravel() <= _WEIGHT]
    m = len(vertices)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(m, m))
    _, group = connected_components(graph, directed=False)
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=int)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    weld = rank[inverse]
    weld.flags.writeable = False
    return weld
