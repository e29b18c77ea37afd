"""Composite losses L_{c²,λ} and L_{s²,λ}: the deformed and the undeformed template under one pose."""

import numpy as np

from .chamfer import chamfer
from .checks import check_number, check_same_length, check_set
from .structured import structured_chamfer

__all__ = ["composite_chamfer", "composite_structured_chamfer"]


def composite_chamfer(X, Vd, V, *, lam=0.5, x_weights=None, v_weights=None, x_index=None):
    """L_{c²,λ} = L_c(X, V^d) + λ L_c(X, V)  (eq. 4 of the paper).

    The second term keeps the pose honest: without it the offsets explain everything and Θ goes to 0.

    Parameters
    ----------
    X : (n, 3) array
    Vd : (m, 3) array
        M(Θ, U^d), the posed deformed template.
    V : (m, 3) array
        M(Θ, U), the posed template.
    lam : float, default 0.5 (the paper's)
    x_weights, v_weights, x_index
        As in :func:`chamfer`.

    Returns
    -------
    value : float
    grad_Vd, grad_V : (m, 3) arrays
    """
    return _composite(chamfer, X, Vd, V, lam, (), x_weights=x_weights, v_weights=v_weights, x_index=x_index)


def composite_structured_chamfer(X, Vd, V, x_labels, v_labels, *, lam=0.5, x_weights=None, v_weights=None, x_index=None):
    """L_{s²,λ} = L_s(X, V^d) + λ L_s(X, V)  (eq. 6 of the paper).

    Arguments are as in :func:`composite_chamfer` and :func:`structured_chamfer`, which it combines.
    """
    labels = x_labels, v_labels
    return _composite(structured_chamfer, X, Vd, V, lam, labels, x_weights=x_weights, v_weights=v_weights, x_index=x_index)


def _composite(loss, X, Vd, V, lam, labels, **options):
    lam, one = check_number("lam", lam), Vd is V
    Vd = check_set("Vd", Vd)  # the loss would call it V
    if not one:
        V = check_set("V", V)
        check_same_length("V", V, "Vd", Vd)
    value, grad_Vd = loss(X, Vd, *labels, **options)
    if one:  # no offsets: one search serves both
        return (1 + lam) * value, grad_Vd, lam * grad_Vd
    if lam == 0:  # searching costs the same whatever λ
        return value, grad_Vd, np.zeros_like(grad_Vd)
    second, grad_V = loss(X, V, *labels, **options)
    return value + lam * second, grad_Vd, lam * grad_V
