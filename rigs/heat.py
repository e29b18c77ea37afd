"""Skinning weights by heat diffusion over the skin from the bones (after Baran and Popović, 2007). Build time only.

For each joint the steady state of −Δw + H w = H p on the surface, where p is 1 on the vertices whose nearest bone belongs to the
joint and H = c / d² with d the distance to that bone: near the bone the skin follows it, and between bones heat evens out.
"""

import numpy as np
from scipy import sparse

__all__ = ["bone_distances", "cotangent_laplacian", "diffused", "exact_rows", "heat_weights"]


def cotangent_laplacian(vertices, faces):
    """Stiffness matrix (positive semidefinite, cotangents clamped at 0) and lumped vertex areas.

    Returns
    -------
    stiffness : (n, n) csc_array
    areas : (n,) array
    """
    n = len(vertices)
    p = vertices[faces]
    rows, cols, values = [], [], []
    for k in range(3):
        a, b = p[:, (k + 1) % 3] - p[:, k], p[:, (k + 2) % 3] - p[:, k]
        cot = 0.5 * np.einsum("ij,ij->i", a, b) / np.linalg.norm(np.cross(a, b), axis=1)
        rows.append(faces[:, (k + 1) % 3])
        cols.append(faces[:, (k + 2) % 3])
        values.append(cot)
    i, j, c = (np.concatenate(x) for x in (rows, cols, values))
    W = sparse.csr_array((np.concatenate([c, c]), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(n, n))
    W.sum_duplicates()
    W.data = np.maximum(W.data, 0)
    stiffness = sparse.diags_array(np.asarray(W.sum(axis=1)).ravel()) - W
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / 2
    areas = np.zeros(n)
    for k in range(3):
        np.add.at(areas, faces[:, k], area / 3)
    return sparse.csc_array(stiffness), areas


def bone_distances(vertices, bones):
    """Distance of every vertex to every bone: (n, B) for bones (B, 2, 3), segments from start to end."""
    start, axis = bones[:, 0], bones[:, 1] - bones[:, 0]
    t = np.einsum("nbk,bk->nb", vertices[:, None] - start, axis) / np.einsum("bk,bk->b", axis, axis)
    nearest = start + np.clip(t, 0, 1)[..., None] * axis
    return np.linalg.norm(vertices[:, None] - nearest, axis=2)


def heat_weights(vertices, faces, bones, owner, n_joints, *, heat=1.0, influences=8, least=0.004):
    """Smooth weights of every vertex on the joints, in exact rows.

    Parameters
    ----------
    vertices, faces, bones, owner, n_joints, heat
        As for :func:`diffused`.
    influences : int, default 8
        At most that many joints a vertex.
    least : float
        Weights below this are dropped.

    Returns
    -------
    (n, n_joints) csr_array
        Rows sum to exactly 1.
    """
    weights = diffused(vertices, faces, bones, owner, n_joints, heat=heat)
    return exact_rows(weights, influences=influences, least=least)


def diffused(vertices, faces, bones, owner, n_joints, *, heat=1.0):
    """The steady state of the diffusion, before anything is cut or rounded.

    Parameters
    ----------
    vertices, faces : (n, 3), (F, 3)
        Closed manifold skin.
    bones : (B, 2, 3) array
        Segments; a joint may own several.
    owner : (B,) int array
        The joint that each bone follows.
    n_joints : int
    heat : float or (B,) array, default 1
        c: larger keeps the transition between bones shorter.

    Returns
    -------
    (n, n_joints) array
        Rows sum to 1 but for rounding.
    """
    from scipy.sparse.linalg import splu

    distance = bone_distances(vertices, bones)
    nearest = distance.argmin(axis=1)
    H = np.broadcast_to(heat, len(bones))[nearest] / distance.min(axis=1) ** 2
    stiffness, areas = cotangent_laplacian(vertices, faces)
    source = np.zeros((len(vertices), n_joints))
    source[np.arange(len(vertices)), np.asarray(owner)[nearest]] = areas * H
    return splu(sparse.csc_array(stiffness + sparse.diags_array(areas * H))).solve(source)


def exact_rows(weights, *, influences=8, least=0.004, steps=1 << 14):
    """Sparse weights in whole steps of 1/``steps``, so that every row sums to 1 without any rounding."""
    w = np.maximum(weights, 0)
    order = np.argsort(-w, axis=1, kind="stable")
    np.put_along_axis(w, order[:, influences:], 0.0, axis=1)
    w = w / w.sum(axis=1, keepdims=True)
    w[w < least] = 0
    whole = np.rint(w / w.sum(axis=1, keepdims=True) * steps).astype(np.int64)
    whole[np.arange(len(w)), order[:, 0]] += steps - whole.sum(axis=1)
    return sparse.csr_array(whole / steps)
