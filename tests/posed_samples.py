"""Poses of a model, starts beside them, and points on their surfaces: what steps towards a known truth are tested on."""

import numpy as np

from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout
from lbsfit_np.synthesis import sample_surface, uniform_poses


def state_within(model, seed, amount=1.0):
    """A pose within the limits, at a place, of the undeformed template."""
    rng = np.random.default_rng(seed)
    theta = amount * uniform_poses(model.rig, 1, rng)[0]
    return model.rest().replace(theta=np.clip(theta, model.rig.lower, model.rig.upper), translation=rng.uniform(-0.2, 0.2, 3))


def near(model, state, seed, angle=0.15, place=0.03):
    """A start beside a state, inside the limits."""
    rng = np.random.default_rng([seed, 1])
    free = Layout(model.rig, ("pose",), 0).turning
    theta = state.theta + angle * rng.uniform(-1, 1, state.theta.shape) * free
    others = np.arange(len(theta)) != model.rig.root
    theta[others] = np.clip(theta, model.rig.lower, model.rig.upper)[others]
    return state.replace(theta=theta, translation=state.translation + place * rng.uniform(-1, 1, 3))


def sampled(model, state, n=800, seed=0):
    """A problem of points on the posed surface, and their parts."""
    V = model.pose(state)[0].vertices
    X, triangle, bary = sample_surface(V, model.rig.faces, n, np.random.default_rng([seed, 2]))
    return Problem(X), model.labels[model.rig.faces[triangle, bary.argmax(axis=1)]]


def joint_error(model, found, true):
    return np.linalg.norm(model.pose(found)[0].joints - model.pose(true)[0].joints, axis=1).mean()
