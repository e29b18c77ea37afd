"""The variant shown beside the fits: plain Chamfer from the rest pose on the scan's centroid. No labels, no segmenter."""

import time
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ..fitting.assemble import assemble
from ..fitting.scan_fit import FitSettings
from ..losses.objective import PLAIN
from ..optimize.frame import Frame
from ..optimize.lbfgs import minimise
from ..optimize.model import Model
from ..optimize.problem import Problem
from ..optimize.state import IN_UNIT, SIZED
from ..scan import some_rows
from ..starts.clean import TakingPart
from ..starts.scale import reference_scale
from ..threads import one_thread

__all__ = ["PlainChamfer"]

# Votes of the mesh for the points' labels, in half sizes; it is the fit alone that labels them.
_SIGMA = 0.025


@dataclass(frozen=True)
class PlainChamfer:
    """Fits scans by L_c alone, with the model, optimiser and objective that the fit proper has.

    First the pose, translation and scale by L_c(X, V) from the rest pose, the template's mean vertex on the scan's centroid;
    then the full objective without its structured term, over pose, translation, scale and offsets together.

    Attributes
    ----------
    rig : Rig
    settings : FitSettings
        Its weights, scale mode, ridge and limit of points count here; the iterations are this variant's own.
    pose_iterations, full_iterations : int
        Enough to converge in: most fits end before.
    """

    rig: object
    settings: FitSettings = field(default_factory=FitSettings)
    pose_iterations: int = 250
    full_iterations: int = 100

    def fit_scan(self, scan):
        """Fit one scan: anything with ``points`` (n, 3). At most ``settings.max_points`` of them, evenly spread rows, take part.

        Returns
        -------
        FitResult
            Labels are those of the nearest fitted vertices.
        """
        with one_thread():
            return self._fit(np.asarray(scan.points, dtype=float), time.perf_counter())

    @cached_property
    def _model(self):
        return Model(self.rig)

    def _fit(self, points, started):
        settings, model = self.settings, self._model
        rows = some_rows(points, settings.max_points)
        reference = reference_scale(points[rows], self.rig, settings.scale)
        frame = Frame(points[rows].mean(axis=0), reference.scale * model.half)
        problem = Problem(frame.inside(points[rows]))
        free = IN_UNIT if settings.scale == "fixed" else SIZED

        start = model.rest()
        V, _ = model.pose(start)
        start = start.replace(translation=-V.vertices.mean(axis=0))
        first = self._minimise(problem, model.coarse, start, PLAIN, free, self.pose_iterations)
        weights = settings.weights.replace(lam_s=0.0)
        free = (*free, "proportions", "residual")
        last = self._minimise(problem, model, first.state, weights, free, self.full_iterations)
        return assemble(
            self.rig,
            model,
            problem,
            last,
            points=points,
            part=TakingPart.only(rows, len(points)),
            frame=frame,
            sigma=_SIGMA,
            weights=weights,
            evaluations=first.evaluations + last.evaluations,
            notes=[reference.note],
            started=started,
        )

    def _minimise(self, problem, model, state, weights, free, iterations):
        return minimise(
            lambda s: problem.evaluate(model, s, weights, ridge=self.settings.ridge),
            state,
            model.rig,
            free,
            max_iterations=iterations,
            tolerance=1e-5,
        )
