"""L-BFGS-B over the free blocks of a State."""

from dataclasses import dataclass

import numpy as np

from .state import Layout, State

__all__ = ["Outcome", "minimise"]


@dataclass(frozen=True)
class Outcome:
    """Where a minimisation ended."""

    state: State
    value: float
    converged: bool
    message: str
    evaluations: int


def minimise(evaluate, state, rig, free, *, max_iterations, tolerance=1e-5):
    """Minimise an objective over some blocks of a state, within the joint limits.

    Parameters
    ----------
    evaluate : callable
        State → an object with ``value`` and gradients to the State's fields.
    state : State
        Where to start.
    rig : Rig
    free : collection of str
        Blocks to change, as in :class:`Layout`.
    max_iterations : int
    tolerance : float, default 1e-5
        Decrease of the objective in one iteration below which the fit has converged, as a share of its value at the start.

    Returns
    -------
    Outcome
        ``converged`` is False when the iterations ran out or the objective was not finite; the best finite state is returned.
    """
    from scipy.optimize import Bounds, minimize

    layout = Layout(rig, free, len(state.coefficients))
    state = layout.inside(state)
    best = [np.inf, state]
    finite, unit = True, None

    def fun(x):
        nonlocal finite, unit
        s = layout.unpack(x, state)
        e = evaluate(s)
        if unit is None:
            # The optimiser's own test compares a decrease with max(|f|, 1): in units of the first value it means the same
            # whatever the weights and the scale.
            unit = abs(e.value) if 0 < abs(e.value) < np.inf else 1.0
        finite = finite and bool(np.isfinite(e.value))
        if e.value < best[0]:
            best[:] = e.value, s
        return e.value / unit, layout.gradient(s, e.theta, e.translation, e.scale, e.coefficients, e.residual) / unit

    result = minimize(
        fun,
        layout.pack(state),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(*layout.bounds()),
        options={"maxiter": max_iterations, "maxfun": 2 * max_iterations + 20, "ftol": tolerance, "gtol": 1e-8, "maxcor": 20},
    )
    # Status 2 is a line search that could not go on, which at a non-smooth optimum (nearest neighbours switch) is an end, too.
    converged = finite and result.status in (0, 2)
    message = result.message if isinstance(result.message, str) else result.message.decode()
    if not finite:
        message = "the objective is not finite"
    return Outcome(best[1], float(best[0]), converged, message, int(result.nfev))
