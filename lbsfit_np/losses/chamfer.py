"""Chamfer distance L_c(X, V)."""

import numpy as np

from ..neighbors import PointIndex
from .checks import check_index, check_set, check_weights

__all__ = ["chamfer", "neighbors", "one_sided_terms"]


def chamfer(X, V, *, x_weights=None, v_weights=None, x_index=None):
    """L_c(X, V) = 1/n Σ_i ‖x_i − N_V(x_i)‖² + 1/m Σ_j ‖v_j − N_X(v_j)‖²  (eq. 3 of the paper).

    Parameters
    ----------
    X : (n, 3) array
        Scan points.
    V : (m, 3) array
        Model vertices.
    x_weights : (n,) array, optional
        Non-negative weights of the scan points: the first mean becomes Σ_i a_i ‖·‖² / Σ_i a_i. The second is unchanged.
    v_weights : (m,) array, optional
        Non-negative weights b_j of the vertices, used in the same way in the second mean; 0 for what a scan cannot show.
    x_index : PointIndex, optional
        A search structure over X, for reuse between calls.

    Returns
    -------
    value : float
        In squared units of X.
    grad : (m, 3) array
        ∂L_c/∂V, exact wherever every nearest neighbour is unique.

    Raises
    ------
    InputError
        Wrong shapes, an empty set, numbers that are not finite or beyond 1e150, weights that are negative or all 0.
    """
    X, V = check_set("X", X), check_set("V", V)
    x_weights, v_weights = check_weights("x_weights", x_weights, len(X)), check_weights("v_weights", v_weights, len(V))
    if x_index is not None:
        check_index("x_index", x_index, X)
    return one_sided_terms(X, V, *neighbors(X, V, x_index), x_weights, v_weights)


def neighbors(X, V, x_index=None):
    """Rows of the vertices nearest to the points, (n,), and of the points nearest to the vertices, (m,)."""
    return PointIndex(V, moving=True).nearest(X), (x_index or PointIndex(X)).nearest(V)


def one_sided_terms(X, V, to_V, to_X, x_weights=None, v_weights=None):
    """Value of both means and gradient with respect to V, for given neighbours; −1 marks a point that contributes 0."""
    n, m = len(X), len(V)
    a = np.full(n, 1.0 / n) if x_weights is None else x_weights / x_weights.sum()
    a = np.where(to_V < 0, 0.0, a)
    away = V[to_V] - X
    pull = a[:, None] * away
    value = float(np.vdot(pull, away))
    grad = np.stack([np.bincount(np.maximum(to_V, 0), 2 * pull[:, k], minlength=m) for k in range(3)], axis=1)
    away = V - X[to_X]
    away[to_X < 0] = 0.0
    if v_weights is None:
        value += float(np.vdot(away, away)) / m
        return value, grad + (2.0 / m) * away
    pull = (v_weights / v_weights.sum())[:, None] * away
    return value + float(np.vdot(pull, away)), grad + 2 * pull
