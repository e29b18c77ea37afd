"""What a well-made skin has to be: closed, manifold, in one piece, outward, free of self-intersections. Build time and tests."""

import numpy as np

__all__ = ["bending_volume", "components", "edge_uses", "euler_characteristic", "self_intersections", "volume"]


def edge_uses(faces):
    """How often each directed edge occurs and whether its opposite does: a closed oriented manifold has (1, True) for all.

    Returns
    -------
    most : int
        The largest number of triangles that use one directed edge.
    closed : bool
        Every directed edge has its opposite.
    """
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    unique, counts = np.unique(directed, axis=0, return_counts=True)
    closed = np.array_equal(unique, np.unique(directed[:, ::-1], axis=0))
    return int(counts.max()), bool(closed)


def euler_characteristic(faces):
    """V − E + F over the vertices in use: 2 for a sphere."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    return len(np.unique(faces)) - len(edges) + len(faces)


def components(faces, n):
    """Number of connected pieces among ``n`` vertices; unused vertices count as pieces."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    i, j = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    return connected_components(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)), directed=False)[0]


def volume(vertices, faces):
    """Signed volume: positive when the triangles face outward."""
    p = vertices[faces]
    return float(np.einsum("ij,ij->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6)


def self_intersections(vertices, faces):
    """Pairs of triangles (k, 2) without a common vertex where an edge of one passes through the other."""
    from scipy.spatial import cKDTree

    p = vertices[faces]
    centre = p.mean(axis=1)
    reach = np.linalg.norm(p - centre[:, None], axis=2).max()
    pairs = cKDTree(centre).query_pairs(2 * reach, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    low, high = p.min(axis=1), p.max(axis=1)
    a, b = pairs.T
    touch = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
    touch &= ~(faces[a][:, :, None] == faces[b][:, None, :]).any(axis=(1, 2))
    pairs = pairs[touch]
    hit = np.zeros(len(pairs), dtype=bool)
    for one, other in (pairs.T, pairs.T[::-1]):
        for k in range(3):
            hit |= _crosses(p[one, k], p[one, (k + 1) % 3], p[other])
    return pairs[hit]


def _crosses(start, end, triangle):
    """Whether segments pass through triangles (Möller and Trumbore's test, row by row)."""
    d = end - start
    e1, e2 = triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]
    h = np.cross(d, e2)
    det = np.einsum("ij,ij->i", e1, h)
    flat = np.abs(det) < 1e-30
    inv = 1 / np.where(flat, 1.0, det)
    s = start - triangle[:, 0]
    q = np.cross(s, e1)
    u, v, t = inv * np.einsum("ij,ij->i", s, h), inv * np.einsum("ij,ij->i", d, q), inv * np.einsum("ij,ij->i", e2, q)
    return ~flat & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)


def bending_volume(rig, row, angles, axis=0):
    """How well the skin keeps its volume when one joint turns alone.

    Parameters
    ----------
    rig : Rig
    row : int
        The joint.
    angles : sequence of float
        Radians about the joint's own ``axis``.

    Returns
    -------
    (len(angles),) array
        1 + (volume posed − volume at rest) / (volume of a cube with the limb's thickness at that joint, twice the mean distance
        of the 16 nearest vertices): 1 is kept; a limb that folds flat loses its whole cube.
    """
    thickness = 2 * np.sort(np.linalg.norm(rig.vertices - rig.joints[row], axis=1))[:16].mean()
    theta = np.zeros((len(angles), len(rig.parents), 3))
    theta[:, row, axis] = angles
    posed = np.array([volume(rig.pose(t), rig.faces) for t in theta])
    return 1 + (posed - volume(rig.vertices, rig.faces)) / thickness**3
