"""What rounds do for one scan, or one subject, here or in another process."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..errors import InputError
from ..fitting.drawn import drawn, prior_of
from ..fitting.effort import EFFORTS
from ..fitting.labels import said_of
from ..fitting.refit import LimbSearch, Refit
from ..fitting.template import TemplateSettings, likely_right, shared_template
from ..optimize.model import Model
from ..optimize.problem import Problem
from ..starts.limbs import LimbPoses

__all__ = [
    "Drawn",
    "Held",
    "Labels",
    "Models",
    "Pose",
    "READY",
    "Template",
    "Told",
    "finite",
    "in_full",
    "short",
    "with_right_poses",
]

# Subjects whose templates a process keeps ready, of a body some 30 MB each: scans come by subject.
READY = 4


@dataclass(frozen=True)
class Models:
    """Subject → the Model of its template, made where it is asked for: templates alone are sent to other processes.

    Attributes
    ----------
    templates : dict of id to Rig
    joints, half, shared
        As of ``Model``.
    """

    templates: dict
    joints: str
    half: float
    shared: bool = False

    def __getitem__(self, subject):
        return Model(self.templates[subject], self.joints, half=self.half, shared=self.shared)


@dataclass(frozen=True)
class Template:
    """Points, more points, states, losses and probabilities of a subject's scans → what ``shared_template`` finds.

    ``prior`` is the PosePrior of the poses as they are, None where there is none.
    """

    model: Model
    coverage: object
    prior: object

    def __call__(self, task):
        points, dense, states, losses, proba = task
        problems = [Problem(X) for X in points]
        known = {"settings": TemplateSettings(coverage=self.coverage), "prior": self.prior}
        known["dense"] = [Problem(more) for more in dense]
        if proba is not None:
            known["proba"] = proba
        return shared_template(self.model, problems, states, losses, **known)


@dataclass(frozen=True)
class Labels:
    """Points of a scan in its frame, its Θ, and the size of its template, as ``said_of`` → probabilities in half precision."""

    segmenter: object
    rig: object

    def __call__(self, task):
        return short(said_of(self.segmenter, self.rig, *task))


@dataclass(frozen=True)
class Pose:
    """(Subject, points, state, neighbours' poses, probabilities) → (state, L_c, which start won; 0 for the last pose).

    Attributes
    ----------
    models : Models
    settings : FitSettings
    library : PoseLibrary
    neighbours : int
        Poses of the library that a scan starts from.
    other_limbs : bool
        Whether limbs are tried in other poses.
    """

    models: Models
    settings: object
    library: object
    neighbours: int
    other_limbs: bool

    @cached_property
    def _of(self):
        return lru_cache(READY)(self._made)

    def _made(self, subject):
        model, limbs, effort = self.models[subject], None, EFFORTS[self.settings.effort]
        if self.other_limbs:
            limbs = LimbSearch(LimbPoses(model, self.library.poses), effort)
        refit = Refit(model, coverage=self.settings.coverage, bends=effort.bends, other_limbs=self.other_limbs)
        return refit, limbs

    def __call__(self, task):
        subject, X, state, beside, proba = task
        refit, limbs = self._of(subject)
        poses = [*beside, self.library.regress(X)]
        if self.neighbours:
            poses += list(self.library.nearest(X, self.neighbours))
        state, loss, which = refit(Problem(X), [state], poses=poses, proba=in_full(proba), limbs=limbs)
        return state, finite(loss), which


@dataclass(frozen=True)
class _LastSteps:
    models: Models
    coverage: object

    @cached_property
    def _refit(self):
        return lru_cache(READY)(lambda subject: Refit(self.models[subject], coverage=self.coverage))


@dataclass(frozen=True)
class Told(_LastSteps):
    """(Subject, points, state, whether C is wanted) → (state after the last steps, σ²/n, C or None) of ``told_angles``."""

    def __call__(self, task):
        subject, X, state, wanted = task
        refit, problem = self._refit(subject), Problem(X)
        state = refit.polish(problem, state)
        C, noise = refit.told_angles(problem, state)
        return state, noise, C if wanted else None


@dataclass(frozen=True)
class Drawn(_LastSteps):
    """(Subject, points, more points, state, σ²/n) → (the state drawn to what all poses tell of it, L_c of the points, σ²/n)."""

    prior: object

    def __call__(self, task):
        subject, X, dense, state, noise = task
        refit = self._refit(subject)
        state = state if self.prior is None else drawn(refit, Problem(dense), state, self.prior, noise)
        return state, finite(refit.chamfer(Problem(X), state)), noise


@dataclass(frozen=True)
class Held(_LastSteps):
    """(Subject, points, state, wanted angles and their weight, σ²/n) → the state drawn there, and to what all poses tell.

    It stays where nothing is wanted of it.
    """

    prior: object

    def __call__(self, task):
        subject, X, state, wanted, noise = task
        if wanted is None:
            return state
        refit = self._refit(subject)
        return refit.polish(Problem(X), state, prior=prior_of(self.prior, noise, refit.turning, wanted))


def short(proba):
    """Probabilities in half precision, as they are kept: of thousands of scans they are the most of what is. None of None."""
    return None if proba is None else proba.astype(np.float16)


def in_full(proba):
    """Probabilities as fits compute with them, of those that are kept of a scan; None of None."""
    return None if proba is None else np.asarray(proba, float)


def finite(loss):
    """The loss, unless it would spoil the means and medians that all scans go by."""
    if not np.isfinite(loss):
        raise InputError("points", "a fit that is not finite", "points without extreme outliers")
    return loss


def with_right_poses(members, least=1):
    """Those whose poses are likely right, by how well the scans of each subject are explained; all where too few are."""
    of, right = {}, {}
    for m in members:
        of.setdefault(m.subject, []).append(m)
    for own in of.values():
        right |= dict(zip((m.index for m in own), likely_right([m.loss for m in own]), strict=True))
    likely = [m for m in members if right[m.index]]
    return likely if len(likely) >= least else members
