"""The search for one scan's pose: label hypotheses are scouted, the best refined, the winner gets the full objective."""

from dataclasses import dataclass

import numpy as np

from ..losses.chamfer import chamfer
from ..losses.objective import LossWeights
from ..optimize.lbfgs import minimise
from ..optimize.problem import Problem
from ..optimize.state import State
from ..starts.hypotheses import label_hypotheses
from ..starts.parts import start_from_parts
from .labels import refined_labels

__all__ = ["Search"]

# The first pose goes by the labels alone: the plain term would hold it where it happens to stand.
_STRUCTURED = LossWeights(chamfer=0.0, lam=0.0, lam_s=1.0, lam_lap=0.0)
# Later pose stages look for the pose alone: the undeformed template's own term is not needed before there are offsets.
_POSE = LossWeights(chamfer=1.0, lam=0.0, lam_s=1.0, lam_lap=0.0)
# Scouting tells hypotheses apart; it needs neither many points nor many steps.
_SCOUT_POINTS = 1000
_SCOUT_ITERATIONS = 12


@dataclass(frozen=True)
class Candidate:
    """A pose with the probabilities that led to it; ``score`` is lower where it explains the scan better."""

    state: State
    proba: np.ndarray
    score: float


class Search:
    """The stages of one fit. After :meth:`run`: ``outcome`` of the last stage, ``labels`` in use, ``evaluations`` in all.

    Parameters
    ----------
    model : Model
    problem : Problem
    proba : (n, n_parts) array
        The segmenter's probabilities, or known labels as zeros and ones.
    labels_known : bool
        Known labels are never refined, and no other hypotheses than they are tried.
    settings : FitSettings
    """

    def __init__(self, model, problem, proba, labels_known, settings):
        self.model, self.problem, self.proba, self.settings = model, problem, proba, settings
        self.labels_known = labels_known
        self.place = ("translation",) if settings.scale == "fixed" else ("translation", "scale")
        self.evaluations = 0
        self.outcome = None
        self.labels = None

    def run(self, theta0=None):
        """Search, refine, fit; returns self."""
        if self.labels_known or theta0 is not None:
            hypotheses = [self.proba]
        else:
            hypotheses = label_hypotheses(self.model.rig, self.proba)
        scouted = [self._scout(proba, theta0) for proba in hypotheses]
        finalists = sorted(scouted, key=lambda c: c.score)[: self.settings.finalists]
        best = min((self._refine(c) for c in finalists), key=lambda c: c.score)
        self.proba = best.proba
        self.labels = self._relabelled(self.problem, best.state, best.proba, self.settings.refinements[-1])
        self.outcome = self._minimise(
            self.problem,
            best.state,
            self.settings.weights,
            self.labels,
            ("pose", *self.place, "proportions", "residual"),
            self.model,
            max_iterations=self.settings.full_iterations,
            tolerance=1e-6,
        )
        return self

    def _scout(self, proba, theta0):
        """A first pose: the parts brought to their centroids, then a few steps on some of the points."""
        model, X, a = self.model.coarse, self.problem.X, self.problem.x_weights
        rows = slice(None, None, max(1, len(X) // _SCOUT_POINTS))
        few = Problem(X[rows], None if a is None else a[rows] / a[rows].sum())
        if theta0 is None:
            start = start_from_parts(model, few.X, proba[rows], x_weights=few.x_weights)
        else:
            given = self.model.rest().replace(theta=np.array(theta0, dtype=float))
            start = start_from_parts(model, few.X, proba[rows], x_weights=few.x_weights, state=given, free=("translation",))
        self.evaluations += start.evaluations
        labels = proba[rows].argmax(axis=1)
        outcome = self._minimise(few, start.state, _STRUCTURED, labels, ("pose", "translation"), model)
        return Candidate(outcome.state, proba, self._score(few, outcome.state))

    def _refine(self, candidate):
        """Labels by probability and distance in turn with poses and proportions, ever closer."""
        state = candidate.state
        for sigma in self.settings.refinements:
            labels = self._relabelled(self.problem, state, candidate.proba, sigma)
            free = ("pose", *self.place, "proportions")
            state = self._minimise(self.problem, state, _POSE, labels, free, self.model.coarse).state
        return Candidate(state, candidate.proba, self._score(self.problem, state))

    def _score(self, problem, state):
        """Plain Chamfer distance, which no labelling flatters, and what the proportions cost."""
        Vd, _ = self.model.coarse.pose(state)
        value = chamfer(problem.X, Vd.vertices, x_weights=problem.x_weights, x_index=problem.x_index)[0]
        return value + self.settings.ridge * float(state.coefficients @ state.coefficients)

    def _relabelled(self, problem, state, proba, sigma):
        if self.labels_known:
            return proba.argmax(axis=1)
        Vd, _ = self.model.coarse.pose(state)
        return refined_labels(problem.X, proba, Vd.vertices, self.model.coarse.labels, sigma, doubt=self.settings.doubt)

    def _minimise(self, problem, state, weights, labels, free, model, *, max_iterations=None, tolerance=1e-5):
        outcome = minimise(
            lambda s: problem.evaluate(model, s, weights, labels, ridge=self.settings.ridge),
            state,
            model.rig,
            free,
            max_iterations=max_iterations or self.settings.pose_iterations,
            tolerance=tolerance,
        )
        self.evaluations += outcome.evaluations
        return outcome
