"""How precisely a scan tells a pose: its angles, and where its joints are."""

import numpy as np

from .jacobian import joint_motion
from .state import IN_UNIT

__all__ = ["joint_std", "told_angles"]

# Points near each other lie off the surface together, where the shape is not quite the template's: only so many of them tell
# something of their own, however many there are. Found on scans with known truth, see docs/fitting.md. Where the template is
# known from many scans it is more of them.
_INDEPENDENT, _ON_KNOWN = 35, 300
# No scan is nearer to its template than this, half sizes.
_LEAST_NOISE = 0.002
# Before the scan is looked at, radians: an angle has any value within its limits, or any at all. Half sizes; shares of the scale.
_ALL_ROUND, _ANYWHERE, _ANY_SCALE = 2 * np.pi, 1.0, 0.3


def joint_std(steps, problem, state, *, free=IN_UNIT, proba=None):
    """The standard deviation of each posed joint's place, as the scan's points tell it where the pose is about right.

    P Σ Pᵀ, with Σ the unknowns' covariance and P = ∂joint/∂unknowns.

    Parameters
    ----------
    steps : GaussNewton
    problem : Problem
        Weights of 0 for what is no point of the body.
    state : State
        Where the fit has ended.
    free : collection of {"pose", "translation", "scale"}
        What was looked for.
    proba : (n, n_parts) array, optional
        Probabilities of the points' parts: those that the mesh has in another part tell nothing of it; rows of 0 say nothing.

    Returns
    -------
    (J,) array
        Root of the mean squared distance, half sizes; NaN where the fit is not finite.
    """
    posed = steps.model.deformed(state)
    if not np.isfinite(posed.vertices).all():
        return np.full(len(posed.joints), np.nan)
    C, _, layout = _covariance(steps, problem, state, free, _INDEPENDENT, proba)
    P = joint_motion(state, posed, layout.blocks, layout.turning).dense()
    return np.sqrt(np.maximum(np.einsum("jap,pq,jaq->j", P, C, P), 0.0))


def told_angles(steps, problem, state, *, free=IN_UNIT):
    """How precisely a scan tells the angles of a pose on a template that is known.

    Parameters
    ----------
    steps, problem, state, free
        As for :func:`joint_std`.

    Returns
    -------
    (t, t) array
        Covariance of the angles that turn, radians squared.
    noise : float
        σ²/n: what E is divided by to be the exponent of a likelihood, but for a factor of 2.
    """
    C, noise, layout = _covariance(steps, problem, state, free, _ON_KNOWN)
    t = int(layout.turning.sum())  # they come first
    return C[:t, :t], noise


def _covariance(steps, problem, state, free, independent, proba=None):
    """The unknowns' covariance where a fit has ended, σ²/n, and their Layout.

    The curvature H of what the points leave unexplained says how well they hold each unknown, and what they leave how far they
    can be trusted; joint limits say what is possible where no point tells: Σ = (n/σ² H + D)⁻¹, the Laplace approximation of the
    posterior.
    """
    H, left, layout = steps.told_by_points(problem, state, free=free, proba=proba)
    rig, a = steps.model.rig, problem.x_weights
    n = len(problem.X) if a is None else 1.0 / float(((a / a.sum()) ** 2).sum())
    width = np.minimum(rig.upper - rig.lower, _ALL_ROUND)
    width[rig.root] = _ALL_ROUND
    spread = {"pose": width[layout.turning] / np.sqrt(12), "translation": np.full(3, _ANYWHERE * state.scale)}
    spread["scale"] = np.full(1, _ANY_SCALE * state.scale)
    D = np.concatenate([spread[block] for block in layout.blocks]) ** -2.0
    noise = max(left, _LEAST_NOISE**2) / min(n, independent)
    return np.linalg.inv(H / noise + np.diag(D)), noise, layout
