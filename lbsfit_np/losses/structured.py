"""Structured Chamfer distance L_s(X, V): nearest neighbours only among points of the same part."""

import numpy as np

from ..neighbors import PointIndex
from .chamfer import one_sided_terms
from .checks import check_index, check_labels, check_set, check_weights

__all__ = ["neighbors_in_parts", "structured_chamfer"]


def structured_chamfer(X, V, x_labels, v_labels, *, x_weights=None, v_weights=None, x_index=None):
    """L_s(X, V) = 1/n Σ_i ‖x_i − N_{V^s(x_i)}(x_i)‖² + 1/m Σ_j ‖v_j − N_{X^s(v_j)}(v_j)‖²  (eq. 5 of the paper).

    Points of a part that is empty on the other side contribute 0; the divisors stay n and m.

    Parameters
    ----------
    X : (n, 3) array
        Scan points.
    V : (m, 3) array
        Model vertices.
    x_labels : (n,) int array
        Part of each scan point, s(x).
    v_labels : (m,) int array
        Part of each vertex, s(v).
    x_weights, v_weights : (n,) and (m,) arrays, optional
        As in :func:`chamfer`.
    x_index : PointIndex, optional
        A search structure over X that was built with ``x_labels``.

    Returns
    -------
    value : float
        In squared units of X.
    grad : (m, 3) array
        ∂L_s/∂V.

    Raises
    ------
    InputError
        As in :func:`chamfer`; also labels of the wrong length, not integers, negative, or 65,536 and more.
    """
    X, V = check_set("X", X), check_set("V", V)
    x_labels, v_labels = check_labels("x_labels", x_labels, len(X)), check_labels("v_labels", v_labels, len(V))
    x_weights, v_weights = check_weights("x_weights", x_weights, len(X)), check_weights("v_weights", v_weights, len(V))
    if x_index is not None:
        check_index("x_index", x_index, X, x_labels)
    return one_sided_terms(X, V, *neighbors_in_parts(X, V, x_labels, v_labels, x_index), x_weights, v_weights)


def neighbors_in_parts(X, V, x_labels, v_labels, x_index=None, *, of_all=None):
    """Rows of the nearest vertices and points of the same part, −1 where there are none.

    Parameters
    ----------
    X, V, x_labels, v_labels, x_index
        As in :func:`structured_chamfer`.
    of_all : ((n,) int array, (m,) int array), optional
        The neighbours among all parts. One of the same part is the nearest of its part, too: only the others are searched for.

    Returns
    -------
    to_V : (n,) int array
    to_X : (m,) int array
    """
    all_V, all_X = (None, None) if of_all is None else of_all
    to_V = _in_parts(X, x_labels, lambda: PointIndex(V, v_labels, moving=True), v_labels, all_V)
    return to_V, _in_parts(V, v_labels, lambda: x_index or PointIndex(X, x_labels), x_labels, all_X)


def _in_parts(queries, parts, index, parts_there, of_all):
    if of_all is None:
        return index().nearest(queries, parts)
    found, asked = of_all.copy(), np.flatnonzero(parts_there[of_all] != parts)
    if len(asked):
        found[asked] = index().nearest(queries[asked], parts[asked])
    return found
