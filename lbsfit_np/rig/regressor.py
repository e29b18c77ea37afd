"""The joint regressor R: joint positions as fixed combinations of template vertices, so that joints follow a changed template."""

import numpy as np
from scipy import sparse

__all__ = ["regressor_from_weights", "exact_regressor"]


def regressor_from_weights(vertices, weights, parents, joints, n_nearest=32):
    """A sparse regressor from the skinning weights, R U = J exactly.

    A joint sits where the weight of all that hangs on it goes from 0 to 1: with s_i the summed weight of joint j and its
    descendants at vertex i, row j starts as s (1 − s), the ring of skin around the joint. Where no such ring exists (the
    root, a tip without weight) the ``n_nearest`` vertices around the joint serve.

    Parameters
    ----------
    vertices : (m, 3) array
    weights : (m, J) sparse array, rows sum to 1
    parents : (J,) int array
    joints : (J, 3) array

    Returns
    -------
    (J, m) sparse csr_array, rows sum to 1
    """
    m, J = weights.shape
    subtree = sparse.csr_array(weights).toarray().astype(float)
    for j in _leaves_first(parents):
        if parents[j] >= 0:
            subtree[:, parents[j]] += subtree[:, j]
    rows = []
    for j in range(J):
        s = np.clip(subtree[:, j], 0.0, 1.0)
        ring = s * (1.0 - s)
        ring[ring < 0.02] = 0.0
        if np.count_nonzero(ring) < 8 or parents[j] < 0:
            d2 = np.einsum("ij,ij->i", vertices - joints[j], vertices - joints[j])
            near = np.argpartition(d2, min(n_nearest, m - 1))[: min(n_nearest, m)]
            ring = np.zeros(m)
            ring[near] = 1.0
        rows.append(sparse.csr_array((ring / ring.sum())[None, :]))
    return exact_regressor(sparse.csr_array(sparse.vstack(rows)), vertices, joints)


def exact_regressor(regressor, vertices, joints):
    """The regressor nearest to ``regressor``, on the same vertices, with R 1 = 1 and R U = J.

    Each row r is corrected by the weighted least change: r ← r + D C (Cᵀ D C)⁺ (c − Cᵀ r), C = [1, U], D = |r|,
    c = [1, J_j]. Where the support is too flat to reach J_j, the rest stays as a constant that ``skin`` keeps
    (joints move by R · offsets from their exact rest positions).
    """
    regressor = sparse.csr_array(regressor, dtype=float)
    data, indices, indptr = regressor.data.copy(), regressor.indices, regressor.indptr
    size = max(float(np.ptp(vertices, axis=0).max()), np.finfo(float).tiny)
    for j in range(len(joints)):
        span = slice(indptr[j], indptr[j + 1])
        r = data[span]
        if not len(r):
            continue
        C = np.column_stack([np.ones(len(r)), (vertices[indices[span]] - joints[j]) / size])
        lack = np.array([1.0, 0.0, 0.0, 0.0]) - C.T @ r
        if np.abs(lack).max() < 1e-14:
            continue
        D = np.maximum(np.abs(r), 1e-3 * np.abs(r).max())
        gram = C.T @ (D[:, None] * C)
        data[span] = r + D * (C @ (np.linalg.pinv(gram, rcond=1e-6, hermitian=True) @ lack))
    return sparse.csr_array((data, indices.copy(), indptr.copy()), shape=regressor.shape)


def _leaves_first(parents):
    depth = []
    for j in range(len(parents)):
        d, k = 0, j
        while parents[k] >= 0:
            d, k = d + 1, parents[k]
        depth.append(d)
    return np.argsort(depth, kind="stable")[::-1]
