"""From what was learned to results: the scans of the collection, and new ones."""

import time
from dataclasses import dataclass

import numpy as np

from ..fitting.assemble import assemble
from ..fitting.template_fit import TemplateFit
from ..losses.objective import LossWeights
from ..optimize.lbfgs import minimise
from ..optimize.model import Model
from ..optimize.problem import Problem
from ..seeds import generator
from ..starts.scale import near_rows, reference_scale
from ..workers import each

__all__ = ["fit_free_form", "fit_new", "results_of"]

# A scan whose unit differs from its subject's by more than this factor has a unit of its own.
_SAME_UNIT = 2.0
_NEIGHBOURS = 6


def results_of(rig, templates, joints, collection, settings, *, jobs, progress):
    """The results of the scans that the loop has left poses of.

    Returns
    -------
    list of FitResult or None
        One for each scan given.
    """
    half = rig.size / 2
    models = {s: Model(t, joints, half=half) for s, t in templates.items()}
    answers = each(_Finish(rig, models, settings), collection.members, jobs=jobs, done=lambda p: progress("results", p))
    return collection.in_order(answers)


@dataclass(frozen=True)
class _Finish:
    rig: object
    models: dict
    settings: object

    def __call__(self, m):
        fit = TemplateFit(self.rig, self.models[m.subject], self.settings)
        note = "left out of learning" if m.held_out else "learned from"
        place = {"points": m.points, "rows": m.rows, "centre": m.centre, "unit": m.unit}
        return fit.finish(m.problem, m.state, proba=m.proba, prior=m.prior, note=note, **place)


def fit_new(fitter, points, subjects, theta0, labels, point_weights):
    """A new scan on the learned templates of ``subjects``, the best of which it gets; arguments checked already.

    Returns
    -------
    FitResult
    """
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        return _fit_new(fitter, points, subjects, theta0, labels, point_weights)


def _fit_new(fitter, points, subjects, theta0, labels, point_weights):
    started = time.perf_counter()
    rig, settings, half = fitter.rig, fitter._fit_settings(), fitter.rig.size / 2
    rows = np.arange(len(points)) if point_weights is None else np.flatnonzero(point_weights > 0)
    if len(rows) > settings.max_points:
        rows = np.sort(generator(fitter._seed(), "thin").choice(rows, settings.max_points, replace=False))
    guess = reference_scale(points[rows], rig, settings.scale).scale
    rows, _ = near_rows(points, rows, guess, half)
    a = None if point_weights is None else point_weights[rows] / point_weights[rows].sum()
    centre = points[rows].mean(axis=0)
    best = None
    for subject in subjects:
        learned = fitter.unit_[subject]
        unit = learned if 1 / _SAME_UNIT < guess / learned < _SAME_UNIT else guess
        problem = Problem((points[rows] - centre) / (unit * half), a)
        if fitter.regressor_ is None:  # free-form: nothing is learned
            return _free_form(fitter._model(), settings, problem, points, rows, centre, unit, started)
        proba = None
        if labels is not None:
            proba = np.eye(len(rig.parts))[labels[rows]]
        elif fitter.segmenter_ is not None:
            proba = fitter.segmenter_.predict_proba(points[rows], scale=unit)
        fit = fitter._template_fit(subject)
        if unit is not learned:
            fit.refit.free = ("pose", "translation", "scale")
        known = labels is not None
        if theta0 is not None:  # the one start, in place of all others
            poses = [theta0]
        elif known:
            poses = []
        else:
            poses = [fitter.regressor_.regress(problem.X), *fitter.regressor_.nearest(problem.X, _NEIGHBOURS)]
        parts = proba if known or theta0 is None else None
        state, loss, _ = fit.refit(problem, poses=poses, proba=parts, labels_known=known)
        if best is None or loss < best[0]:
            best = loss, subject, fit, problem, state, proba, unit
    _, subject, fit, problem, state, proba, unit = best
    note = f"on the template of subject {subject!r}" if len(fitter.template_) > 1 else "on the learned template"
    return fit.finish(
        problem,
        state,
        points=points,
        rows=rows,
        centre=centre,
        unit=unit,
        proba=proba,
        labels_known=labels,
        note=note,
        started=started,
    )


# ---- the free-form baseline ----


def fit_free_form(model, collection, settings, *, jobs, progress):
    """Scans fitted without skinning: the template's vertices move freely under Chamfer and Laplacian.

    Returns
    -------
    list of FitResult or None
    """
    for m in collection.members:
        m.use_unit(m.unit, model.half)
    work = _FreeForm(model, settings)
    answers = each(work, collection.members, jobs=jobs, done=lambda p: progress("free-form fits", p))
    return collection.in_order(answers)


@dataclass(frozen=True)
class _FreeForm:
    model: Model
    settings: object

    def __call__(self, m):
        return _free_form(self.model, self.settings, m.problem, m.points, m.rows, m.centre, m.unit, time.perf_counter())


def _free_form(model, settings, problem, points, rows, centre, unit, started):
    weights = LossWeights(chamfer=1.0, lam=0.0, lam_s=0.0, lam_lap=settings.weights.lam_lap)
    weights = weights.replace(laplacian=settings.weights.laplacian, squared=settings.weights.squared)
    state = model.rest()
    state = state.replace(translation=problem.X.mean(axis=0) - model.areas @ model.rig.vertices)
    place = ("translation",) if settings.scale == "fixed" else ("translation", "scale")
    place_only = minimise(
        lambda s: problem.evaluate(model, s, weights), state, model.rig, place, max_iterations=settings.pose_iterations
    )
    outcome = minimise(
        lambda s: problem.evaluate(model, s, weights),
        place_only.state,
        model.rig,
        (*place, "residual"),
        max_iterations=settings.full_iterations,
        tolerance=settings.full_tolerance,
    )
    return assemble(
        model.source,
        model,
        problem,
        outcome,
        points=points,
        rows=rows,
        unit=unit * model.half,
        centre=centre,
        sigma=settings.refinements[-1],
        evaluation=problem.evaluate(model, outcome.state, weights),
        evaluations=place_only.evaluations + outcome.evaluations,
        note="free-form, no skinning",
        started=started,
    )
