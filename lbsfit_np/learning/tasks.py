"""What rounds do for one scan, or one subject, here or in another process."""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from ..errors import InputError
from ..fitting.effort import EFFORTS
from ..fitting.refit import LimbSearch, Refit
from ..fitting.scout import Scout
from ..fitting.template import TemplateSettings, shared_template
from ..losses.objective import PLAIN
from ..optimize.model import Model
from ..starts.limbs import LimbPoses

__all__ = ["FirstFit", "Labels", "Pose", "SmoothPose", "Template"]


@dataclass(frozen=True)
class FirstFit:
    """Points of a scan → (Frame, State, L_c, probabilities or None), of the scan by itself on the rig's own template."""

    model: Model
    settings: object
    segmenter: object
    library: object
    facing: object
    nearest: bool

    @cached_property
    def _scout(self):
        return Scout(self.model, self.library, self.facing, self.segmenter, self.settings, nearest=self.nearest)

    def __call__(self, points):
        found = self._scout(points)
        loss = found.problem.evaluate(self.model.coarse, found.state, PLAIN).value
        return found.frame, found.state, _finite(loss), found.proba


@dataclass(frozen=True)
class Template:
    """Problems, states, losses and probabilities of a subject's scans → what ``shared_template`` finds."""

    model: Model
    partial: bool

    def __call__(self, task):
        problems, states, losses, proba = task
        settings = TemplateSettings(partial=self.partial)
        return shared_template(self.model, problems, states, losses, proba=proba, settings=settings)


@dataclass(frozen=True)
class Labels:
    """Points of a scan → probabilities of the parts."""

    segmenter: object

    def __call__(self, points):
        return self.segmenter.predict_proba(points, views=1)


@dataclass(frozen=True)
class Pose:
    """(Subject, problem, state, neighbours' poses, probabilities) → (state, L_c, which start won; 0 for the last pose).

    Attributes
    ----------
    models : dict of id to Model
    settings : FitSettings
    library : PoseLibrary
    neighbours : int
        Poses of the library that a scan starts from.
    other_limbs : bool
        Whether limbs are tried in other poses.
    """

    models: dict
    settings: object
    library: object
    neighbours: int
    other_limbs: bool

    @cached_property
    def _of(self):
        return cache(self._made)  # once in each process

    def _made(self, subject):
        model, limbs = self.models[subject], None
        if self.other_limbs:
            limbs = LimbSearch(LimbPoses(model, self.library.poses), EFFORTS[self.settings.effort])
        return Refit(model, partial=self.settings.partial), limbs

    def __call__(self, task):
        subject, problem, state, beside, proba = task
        refit, limbs = self._of(subject)
        poses = [*beside, self.library.regress(problem.X)]
        if self.neighbours:
            poses += list(self.library.nearest(problem.X, self.neighbours))
        state, loss, which = refit(problem, [state], poses=poses, proba=proba, limbs=limbs)
        return state, _finite(loss), which


@dataclass(frozen=True)
class SmoothPose:
    """(Subject, problem, state, prior) → the state drawn to the prior, a pose Θ and its weight."""

    models: dict
    partial: bool

    @cached_property
    def _refit(self):
        return cache(lambda subject: Refit(self.models[subject], partial=self.partial))  # prepared once in each process

    def __call__(self, task):
        subject, problem, state, prior = task
        return self._refit(subject).polish(problem, state, prior=prior)


def _finite(loss):
    """The loss, unless it would spoil the means and medians that all scans go by."""
    if not np.isfinite(loss):
        raise InputError("points", "a fit that is not finite", "points without wild ones")
    return loss
