"""The search for one scan's pose, stage by stage: parts to their centroids, labels, the surface, the full objective."""

import numpy as np

from ..losses.objective import BOTH, PLAIN, STRUCTURED
from ..optimize.lbfgs import minimise
from ..optimize.state import IN_UNIT
from ..starts.parts import start_from_parts
from ..starts.place import placed
from .labels import parts_of, refined_labels
from .proportioned import Proportioned

__all__ = ["Search"]


class Search:
    """The stages of one fit. ``outcome`` of the last stage, ``labels`` in use, ``evaluations`` in all.

    Parameters
    ----------
    model : Model
    problem : Problem
    proba : (n, n_parts) array or None
        The segmenter's probabilities, or known labels as ``labels.one_hot``; None leaves the structured term out.
    labels_known : bool
        Known labels are never refined.
    settings : FitSettings
    """

    def __init__(self, model, problem, proba, labels_known, settings):
        self.model, self.problem, self.proba, self.settings = model, problem, proba, settings
        self.labels_known = labels_known
        self.labels = None if proba is None else parts_of(proba)
        # Then the plain term knows no more than they do.
        self._all_known = labels_known and bool((self.labels < proba.shape[1]).all())
        self.place = ("translation",) if settings.scale == "fixed" else ("translation", "scale")
        self.evaluations = 0
        self.outcome = None

    def start(self, theta0=None):
        """The parts brought to their centroids, from the rest pose or a given one, then to their labels; returns self.

        Without labels the whole is brought to the scan.
        """
        model, X, a = self.model.coarse, self.problem.X, self.problem.x_weights
        if self.proba is None:
            theta0 = self.model.rest().theta if theta0 is None else theta0
            given = placed(self.model, self.problem, theta0, coverage=self.settings.coverage)
            self.outcome = self._minimise(given, PLAIN, IN_UNIT, model)
            return self
        if theta0 is None:
            start = start_from_parts(model, X, self.proba, x_weights=a)
        else:
            given = self.model.rest().replace(theta=np.array(theta0, dtype=float))
            start = start_from_parts(model, X, self.proba, x_weights=a, state=given, free=("translation",))
        self.evaluations += start.evaluations
        self.outcome = self._minimise(start.state, STRUCTURED, IN_UNIT, model)
        return self

    def pose(self, others=()):
        """After :meth:`start`, the stages before the full objective: the State with pose, place and proportions.

        Of ``others``, States, the last of these stages goes on as well; what leaves the least unexplained is taken. Without a
        polish there may be none.
        """
        state = self.outcome.state
        for sigma in () if self.proba is None else self.settings.refinements:
            self._relabel(state, sigma)
            state = self._minimise(state, BOTH, ("pose", *self.place, "proportions"), self.model.coarse).state
        if not self._all_known:
            state = self._minimise(
                state,
                PLAIN,
                ("pose", *self.place, "proportions"),
                self.model.coarse,
                max_iterations=self.settings.plain_iterations,
                tolerance=self.settings.full_tolerance,
            ).state
        return self._polished([state, *others])

    def full(self, state, free=None):
        """The full objective, from where the pose stages ended; returns self."""
        self._relabel(state, self.settings.refinements[-1])
        self.outcome = self._minimise(
            state,
            self.settings.weights,
            ("pose", *self.place, "proportions", "residual") if free is None else free,
            self.model,
            max_iterations=self.settings.full_iterations,
            tolerance=self.settings.full_tolerance,
        )
        return self

    def _polished(self, states):
        """The last steps, on the problem's points; the best of some states."""
        if not self.settings.polish:
            return states[0]
        steps = Proportioned(self.model, self.settings, ("pose", *self.place))
        labels = self.labels if self._all_known else None
        if labels is not None and not self.settings.coverage.whole:
            # Until here, points have drawn what the scan does not show to them, too; steps without labels know better.
            states = [*states, steps.to_the_end(self.problem, states[0])[0]]
        return min((steps.to_the_end(self.problem, state, labels=labels) for state in states), key=lambda found: found[1])[0]

    def _relabel(self, state, sigma):
        """Labels by the segmenter's word and the distance to the parts as they stand."""
        if self.proba is not None and not self.labels_known:
            model = self.model.coarse
            V = model.deformed(state).vertices
            self.labels = refined_labels(self.problem.X, self.proba, V, model.labels, sigma, doubt=self.settings.doubt)

    def _minimise(self, state, weights, free, model, *, max_iterations=None, tolerance=3e-3):
        outcome = minimise(
            lambda s: self.problem.evaluate(model, s, weights, self.labels, ridge=self.settings.ridge),
            state,
            model.rig,
            free,
            max_iterations=self.settings.pose_iterations if max_iterations is None else max_iterations,
            tolerance=tolerance,
        )
        self.evaluations += outcome.evaluations
        return outcome
