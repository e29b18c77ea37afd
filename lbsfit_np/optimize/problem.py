"""Problem: one scan and one rig in a common normalised frame, and the objective between them.

In this frame the template's longest half-extent is 1 and the scan, divided by the same length and by the reference
scale, stands at its centroid, turned back as the frame says: x̃ = Tᵀ (x − centre) / (reference scale · half). All losses are
evaluated here.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..losses.objective import objective
from ..neighbors import PointIndex, neighbour_distances, spacing
from ..scan import some_rows
from ..skinning import skin_adjoint
from .visibility import hull_planes

__all__ = ["Evaluation", "Problem", "merged"]


@dataclass(frozen=True)
class Evaluation:
    """An objective at a State, with its gradients to the State's fields."""

    value: float
    terms: dict
    theta: np.ndarray
    translation: np.ndarray
    scale: float
    coefficients: np.ndarray
    residual: np.ndarray


class Problem:
    """The points of one scan, in the normalised frame, and the objective between them and a Model.

    Parameters
    ----------
    X : (n, 3) array
        Scan points, normalised.
    x_weights : (n,) array, optional
        Shares: they sum to 1. By default all points have the same.
    v_weights : (m,) array, optional
        Weights of the vertices of the whole model, not of a coarse one: 0 where the scan does not show the surface.
    """

    def __init__(self, X, x_weights=None, v_weights=None):
        self.X = X
        self.x_weights = x_weights
        self.v_weights = v_weights
        self._part_index = None, None

    @property
    def shares(self):
        """(n,): ``x_weights``, also where all points have the same."""
        return np.full(len(self.X), 1.0 / len(self.X)) if self.x_weights is None else self.x_weights

    def thinned(self, most):
        """The problem on at most so many of its points, the same ones for the same n."""
        return self if len(self.X) <= most else self.at(some_rows(self.X, most))

    def at(self, rows):
        """The problem on some of its points."""
        a = None if self.x_weights is None else self.x_weights[rows] / self.x_weights[rows].sum()
        return Problem(self.X[rows], a)

    def in_unit(self, q):
        """The problem in a frame of q times the unit."""
        return self if q == 1.0 else Problem(self.X / q, self.x_weights, self.v_weights)

    @cached_property
    def x_index(self):
        """The search structure over the points, without labels."""
        return PointIndex(self.X)

    @cached_property
    def spacing(self):
        """How far apart points are where they are sparse, of those at one place one: see ``neighbors.spacing``."""
        places, _, _ = merged(self.X, self.shares, None)
        return spacing(neighbour_distances(places, 3))

    @cached_property
    def hull(self):
        """Planes about the points, see ``visibility.hull_planes``."""
        return hull_planes(self.X)

    def part_index(self, labels):
        """The search structure for these labels, kept until other labels come."""
        if self._part_index[0] is not labels:
            self._part_index = labels, PointIndex(self.X, labels)
        return self._part_index[1]

    def evaluate(self, model, state, weights, labels=None, *, ridge=0.0):
        """Objective and gradients at a state.

        Parameters
        ----------
        model : Model
        state : State
        weights : LossWeights
        labels : (n,) int array, optional
            Parts of the points; without them the structured term is left out.
        ridge : float
            Weight of ‖c‖², the proportions' own prior.

        Returns
        -------
        Evaluation
        """
        Vd, V = model.pose(state) if weights.lam else (model.deformed(state),) * 2  # V counts for nothing where λ is 0
        L = objective(
            self.X,
            Vd.vertices,
            V.vertices,
            weights=weights,
            x_labels=labels,
            v_labels=None if labels is None else model.labels,
            offsets=Vd.rest - model.rig.vertices,
            K=model.K if weights.lam_lap else None,
            x_weights=self.x_weights,
            v_weights=self.v_weights,
            x_index=self.x_index if weights.chamfer else None,
            x_part_index=None if labels is None else self.part_index(labels),
        )
        g = skin_adjoint(Vd, L.grad_Vd)
        theta, translation, scale = g.theta, g.translation, g.scale
        if weights.lam:  # the undeformed template feels pose, translation and scale, never the offsets
            h = skin_adjoint(V, L.grad_V)
            theta, translation, scale = theta + h.theta, translation + h.translation, scale + h.scale
        coefficients, residual = model.offset_gradients(g, L.grad_offsets)
        c = state.coefficients
        return Evaluation(
            L.value + ridge * float(c @ c), L.terms, theta, translation, scale, coefficients + 2 * ridge * c, residual
        )


def merged(X, w, proba):
    """Points, their weights and probabilities, those at one place as one: they tell no more than that."""
    places, first, of = np.unique(X, axis=0, return_index=True, return_inverse=True)
    if len(places) == len(X):
        return X, w, proba
    return places, np.bincount(of.ravel(), w), None if proba is None else proba[first]
