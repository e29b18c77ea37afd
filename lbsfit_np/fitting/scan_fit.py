"""The fit of one scan: starts, labels, pose by the structured term, then the full objective."""

import time
from dataclasses import dataclass, field

import numpy as np

from ..errors import InputError
from ..losses.objective import PRESETS, LossWeights
from ..optimize.problem import Problem
from ..seeds import generator
from ..starts.scale import near_rows, reference_scale
from .assemble import assemble
from .search import Search

__all__ = ["FitSettings", "fit_points", "prepare_pose"]


@dataclass(frozen=True)
class FitSettings:
    """How a scan is fitted. Lengths in half sizes of the rig.

    Attributes
    ----------
    weights : LossWeights
        Of the full objective.
    scale : {"estimate", "fixed"}
    max_points : int
        Points that take part in the optimisation; a larger scan is thinned by the seed.
    pose_iterations, plain_iterations, full_iterations : int
        L-BFGS iterations, at most, of each pose stage, of the last pose stage, which has the plain term only, and of the
        full stage.
    full_tolerance : float
        Decrease of the objective in one iteration, as a share of its value at the stage's start, below which the last pose
        stage and the full stage have converged.
    refinements : tuple of float
        σ of each refinement of the labels, each followed by a pose stage.
    polish : int
        Levenberg–Marquardt steps on pose and proportions before the full stage; 0 leaves them out.
    polish_ridge : float
        Weight of ‖c‖² in them.
    ridge : float
        Weight of ‖c‖² on the bones' proportions in the L-BFGS stages.
    doubt : float
        Points whose label is less probable than this take no part in the structured term while labels are refined.
    """

    weights: LossWeights = field(default_factory=lambda: PRESETS["default"])
    scale: str = "estimate"
    max_points: int = 2500
    pose_iterations: int = 40
    plain_iterations: int = 100
    full_iterations: int = 40
    full_tolerance: float = 4e-4
    refinements: tuple = (0.15, 0.1, 0.07, 0.05, 0.035, 0.025)
    polish: int = 12
    polish_ridge: float = 3e-5
    ridge: float = 1e-3
    doubt: float = 0.8


def fit_points(model, points, *, segmenter=None, settings=None, theta0=None, labels=None, point_weights=None, random_state=None):
    """Fit one scan.

    Parameters
    ----------
    model : Model
    points : (n, 3) array
        Checked already.
    segmenter : Segmenter, optional
        Not needed with ``labels``.
    settings : FitSettings, optional
    theta0 : (J, 3) array, optional
        A pose to start from instead of the searched ones.
    labels : (n,) int array, optional
        Known parts; they are kept as they are.
    point_weights : (n,) array, optional
    random_state : int or None

    Returns
    -------
    FitResult
    """
    from threadpoolctl import threadpool_limits

    started = time.perf_counter()
    settings = settings or FitSettings()
    with threadpool_limits(1):  # threads on arrays this small cost more than they give
        return _fit(model, points, segmenter, settings, theta0, labels, point_weights, random_state, started)


def prepare_pose(model, problem, proba, settings):
    """The State of one scan after the pose stages, without the full objective; for those who go on with a shared template.

    Parameters
    ----------
    model : Model
    problem : Problem
    proba : (n, n_parts) array
    settings : FitSettings

    Returns
    -------
    State
    """
    return Search(model, problem, proba, False, settings).pose()


def _fit(model, points, segmenter, settings, theta0, labels, point_weights, random_state, started):
    rows = _thinned(len(points), point_weights, settings.max_points, generator(random_state, "thin"))
    reference = reference_scale(points[rows], model.source, settings.scale)
    rows, wild = near_rows(points, rows, reference.scale, model.half)
    unit = reference.scale * model.half
    centre = points[rows].mean(axis=0)
    X = (points[rows] - centre) / unit
    a = None if point_weights is None else point_weights[rows] / point_weights[rows].sum()
    problem = Problem(X, a)
    if labels is None:
        proba = segmenter.predict_proba(points[rows], scale=reference.scale)
    else:
        proba = np.eye(len(model.source.parts))[labels[rows]]

    search = Search(model, problem, proba, labels is not None, settings).run(theta0)
    return assemble(
        model.source,
        model,
        problem,
        search.outcome,
        points=points,
        rows=rows,
        unit=unit,
        centre=centre,
        sigma=settings.refinements[-1],
        evaluation=problem.evaluate(model, search.outcome.state, settings.weights, search.labels),
        proba=proba,
        labels=labels,
        evaluations=search.evaluations,
        note=reference.note + (f"; {wild} points far from all others left out" if wild else ""),
        started=started,
    )


def _thinned(n, point_weights, most, rng):
    """Rows that take part: all, or as many as allowed; points of weight 0 never."""
    rows = np.arange(n) if point_weights is None else np.flatnonzero(point_weights > 0)
    if not len(rows):
        raise InputError("point_weights", "all zeros", "at least one positive weight")
    return rows if len(rows) <= most else np.sort(rng.choice(rows, most, replace=False))
