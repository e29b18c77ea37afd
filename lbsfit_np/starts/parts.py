"""A start from labels: small least-squares inverse kinematics on the parts' centroids.

The labelled scan says where each part's centroid is; the pose is sought that brings the template's parts there:

    min_Θ,t,s  Σ_p a_p ‖c_p(X) − c_p(V)‖² + ρ ‖Θ‖²,

a_p the share of the points in part p, c_p(X) weighted by the segmenter's probabilities, c_p(V) by vertex area. No nearest
neighbours take part, so the basin is wide; holes move the centroids a little, which later stages mend.
"""

import numpy as np

from ..optimize.lbfgs import minimise
from ..optimize.problem import Evaluation
from ..optimize.state import IN_UNIT
from ..skinning import skin_adjoint

__all__ = ["start_from_parts"]


def start_from_parts(model, X, proba, *, state=None, free=IN_UNIT, x_weights=None, pull=2e-3, max_iterations=60):
    """A State whose parts lie where the labels say.

    Parameters
    ----------
    model : Model
    X : (n, 3) array
        Normalised scan points.
    proba : (n, n_parts) array
        Probability of each part at each point.
    state : State, optional
        Where to start; by default the rest pose at the scan's centroid.
    free : collection of str
        Blocks to solve for.
    x_weights : (n,) array, optional
    pull : float
        ρ, which settles what centroids do not (twists), in squared half sizes a squared radian.
    max_iterations : int

    Returns
    -------
    Outcome
    """
    rig = model.rig
    weights = proba if x_weights is None else proba * x_weights[:, None]
    share = weights.sum(axis=0)
    target = (weights.T @ X) / np.maximum(share, 1e-12)[:, None]
    share = np.where(share > 1e-3 * share.sum(), share, 0.0)
    average = np.zeros((proba.shape[1], len(rig.vertices)))
    average[model.labels, np.arange(len(rig.vertices))] = model.areas
    total = average.sum(axis=1, keepdims=True)
    share = np.where(total[:, 0] > 0, share, 0.0)
    share /= max(share.sum(), np.finfo(float).tiny)
    average = average / np.maximum(total, 1e-12)
    if state is None:
        state = model.rest()
        state = state.replace(translation=share @ (target - average @ rig.vertices))
    free_root = np.ones((len(rig.parents), 1))
    free_root[rig.root] = 0.0

    def evaluate(s):
        posed, _ = model.pose(s)
        away = average @ posed.vertices - target
        value = float(share @ np.einsum("pa,pa->p", away, away))
        g = skin_adjoint(posed, average.T @ (2 * share[:, None] * away))
        held = free_root * s.theta
        coefficients, residual = model.offset_gradients(g, 0.0)
        value += pull * float(np.vdot(held, held))
        return Evaluation(value, {}, g.theta + 2 * pull * held, g.translation, g.scale, coefficients, residual)

    return minimise(evaluate, state, rig, free, max_iterations=max_iterations)
