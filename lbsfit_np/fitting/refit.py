"""The pose of a scan whose template is known: many starts, short steps from each, and the best by plain Chamfer distance.

With free offsets a wrong pose can look as good as the right one. With the template known it cannot: a finger in another's
place leaves points unexplained. So here starts may be many and careless, and the loss chooses.
"""

import numpy as np

from ..losses.objective import LossWeights
from ..optimize.gauss_newton import GaussNewton
from ..optimize.lbfgs import minimise
from ..optimize.problem import Problem
from ..starts.parts import start_from_parts
from .labels import refined_labels

__all__ = ["Refit"]

_PLAIN = LossWeights(chamfer=1.0, lam=0.0, lam_s=0.0, lam_lap=0.0)
_BOTH = LossWeights(chamfer=1.0, lam=0.0, lam_s=1.0, lam_lap=0.0)
_STRUCTURED = LossWeights(chamfer=0.0, lam=0.0, lam_s=1.0, lam_lap=0.0)

# σ of the refined labels that lead a start from part centroids, in half sizes.
_SIGMAS = (0.15, 0.07)
_DOUBT = 0.8
# Short steps look at so many points from so far; the best few starts go on with all points and a short reach.
_FEW, _FAR, _NEAR, _SURVIVORS = 700, 0.2, 0.025, 3
_FAR_STEPS, _NEAR_STEPS = 6, 10


class Refit:
    """Poses of scans for one known template.

    Parameters
    ----------
    model : Model
        Of the template.
    free : collection of {"pose", "translation", "scale"}, default pose and translation
    """

    def __init__(self, model, free=("pose", "translation")):
        self.model, self.free = model, free
        self._far = GaussNewton(model, reach=_FAR, vertices=400)
        self._near = GaussNewton(model, reach=_NEAR, tangential=0.02)

    def __call__(self, problem, states=(), *, poses=(), proba=None, labels_known=False):
        """The best pose found.

        Parameters
        ----------
        problem : Problem
        states : sequence of State
            Starts with their place, such as an earlier fit.
        poses : sequence of (J, 3) arrays
            Starts that are put where the scan is.
        proba : (n, n_parts) array, optional
            Probabilities of the parts; they give one more start.
        labels_known : bool, default False
            The probabilities are known labels, which the steps go by: from the first start alone, or from the one that the
            labels give where there is no other.

        Returns
        -------
        state : State
        value : float
            L_c(X, V), plain Chamfer distance, squared half sizes.
        which : int
            Row of the start that won: states, then poses, then the one from parts.
        """
        starts = [self._mine(s) for s in states] + [self._placed(problem, theta) for theta in poses]
        if labels_known:
            start = starts[0] if starts else self._from_parts(problem, proba, True)
            labels = proba.argmax(axis=1)
            state, _ = self._far.pose(problem, start, free=self.free, labels=labels, iterations=_FAR_STEPS)
            state, _ = self._near.pose(problem, state, free=self.free, labels=labels, iterations=_NEAR_STEPS)
            return state, self._chamfer(problem, state), 0
        if proba is not None:
            starts.append(self._from_parts(problem, proba, False))
        few = _thinned(problem)
        near = [self._far.pose(few, s, free=self.free, iterations=_FAR_STEPS)[0] for s in starts]
        order = np.argsort([self._chamfer(few, s) for s in near], kind="stable")[:_SURVIVORS]
        ends = [self._near.pose(problem, near[k], free=self.free, iterations=_NEAR_STEPS)[0] for k in order]
        values = [self._chamfer(problem, s) for s in ends]
        best = int(np.argmin(values))
        return ends[best], values[best], int(order[best])

    def polish(self, problem, state, **options):
        """The last steps alone; options of :meth:`GaussNewton.pose`."""
        return self._near.pose(problem, state, free=self.free, **options)[0]

    def _chamfer(self, problem, state):
        return problem.evaluate(self.model.coarse, state, _PLAIN).value

    def _mine(self, state):
        """A state of another model as one of this: its template is this model's."""
        return state.replace(coefficients=np.zeros(self.model.n_coefficients), residual=None)

    def _placed(self, problem, theta):
        state = self.model.rest().replace(theta=np.array(theta, dtype=float))
        return state.replace(translation=_centroid(problem) - self.model.areas @ self.model.pose(state)[0].vertices)

    def _from_parts(self, problem, proba, labels_known):
        """Inverse kinematics on the parts' centroids, then the labels, ever closer."""
        model, X = self.model.coarse, problem.X
        state = start_from_parts(model, X, proba, x_weights=problem.x_weights).state
        labels = proba.argmax(axis=1)
        free = self.free

        def go(state, weights, labels, steps):
            def evaluate(s):
                return problem.evaluate(model, s, weights, labels)

            return minimise(evaluate, state, model.rig, free, max_iterations=steps, tolerance=2e-3).state

        state = go(state, _STRUCTURED, labels, 30)
        for sigma in () if labels_known else _SIGMAS:
            V = model.pose(state)[0].vertices
            state = go(state, _BOTH, refined_labels(X, proba, V, model.labels, sigma, doubt=_DOUBT), 30)
        return state


def _centroid(problem):
    return problem.X.mean(axis=0) if problem.x_weights is None else problem.x_weights @ problem.X


def _thinned(problem):
    """The problem on fewer points, evenly taken: scans have no order that this could follow."""
    n = len(problem.X)
    if n <= _FEW:
        return problem
    rows = np.linspace(0, n - 1, _FEW).astype(int)
    a = None if problem.x_weights is None else problem.x_weights[rows] / problem.x_weights[rows].sum()
    return Problem(problem.X[rows], a)
