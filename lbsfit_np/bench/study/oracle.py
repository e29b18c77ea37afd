"""The oracle fit: pose, proportions and offsets where every point's true place on the surface is known.

    E = mean ‖x_i − V^d_i‖² + λ_lap L_lap + ridge ‖c‖²,

V^d_i the place of the mesh that point x_i was taken from: a fit's objective with the true partners for the nearest ones, and the
λ_lap and ridge that leave the least errors then. That is what a fit could reach whose partners were all right. The term of the
undeformed template is left out: with true partners there is no wrong pose that offsets could hide.
"""

import time
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...correspondence import at_places
from ...fitting.assemble import assemble
from ...fitting.scan_fit import FitSettings
from ...losses.laplacian import laplacian_offsets
from ...optimize.frame import Frame
from ...optimize.lbfgs import minimise
from ...optimize.model import Model
from ...optimize.problem import Evaluation, Problem
from ...skinning import skin_adjoint
from ...starts.clean import TakingPart
from ...threads import one_thread

__all__ = ["OracleFit"]

_RIDGE = 3e-5
# Of λ_lap from 0.3 (the fits' own, against distances both ways) to 0.01, the last leaves the least joint and vertex errors, on
# the tuning seed 5.
_LAPLACIAN, _ITERATIONS = 0.01, 400


@dataclass(frozen=True)
class OracleFit:
    """Fits with true correspondences.

    Attributes
    ----------
    rig : Rig
    settings : FitSettings
        Its weights count here.
    """

    rig: object
    settings: FitSettings = field(default_factory=FitSettings)

    @cached_property
    def _model(self):
        return Model(self.rig)

    def __call__(self, scan):
        """The fit of a SyntheticScan; a FitResult in its frame."""
        with one_thread():
            return self._fit(scan, time.perf_counter())

    def _fit(self, scan, started):
        model, points = self._model, scan.points
        frame = Frame(points.mean(axis=0), scan.scale * model.half)
        places = self.rig.weld[self.rig.faces[scan.triangle]], scan.barycentric
        known = _Known(model, frame.inside(points), *places, self.settings.weights.replace(lam_lap=_LAPLACIAN))
        free = ("pose", "translation", "scale", "proportions")
        start = model.rest()
        start = start.replace(translation=-model.areas @ model.rig.vertices)
        steps = {"max_iterations": _ITERATIONS, "tolerance": 1e-6}
        pose = minimise(known.evaluate, start, model.rig, free, **steps)
        last = minimise(known.evaluate, pose.state, model.rig, (*free, "residual"), **steps)
        problem = Problem(known.X)
        return assemble(
            self.rig,
            model,
            problem,
            last,
            points=points,
            part=TakingPart.only(np.arange(len(points)), len(points)),
            frame=frame,
            sigma=self.settings.refinements[-1],
            weights=self.settings.weights.replace(lam_s=0.0),
            evaluations=pose.evaluations + last.evaluations,
            notes=["true correspondences"],
            started=started,
            labels=scan.labels,
        )


@dataclass(frozen=True)
class _Known:
    """The objective between points and their true places."""

    model: object
    X: np.ndarray
    corners: np.ndarray
    barycentric: np.ndarray
    weights: object

    def evaluate(self, state):
        model, w = self.model, self.weights
        Vd, _ = model.pose(state)
        value, to_Vd = self._distance(Vd.vertices)
        lap, to_offsets = laplacian_offsets(Vd.rest - model.rig.vertices, model.K, squared=w.squared)
        g = skin_adjoint(Vd, to_Vd)
        coefficients, residual = model.offset_gradients(g, w.lam_lap * to_offsets)
        c = state.coefficients
        total = value + w.lam_lap * lap + _RIDGE * float(c @ c)
        return Evaluation(total, {}, g.theta, g.translation, g.scale, coefficients + 2 * _RIDGE * c, residual)

    def _distance(self, vertices):
        """mean ‖x − place‖², and its gradient to the vertices."""
        r = at_places(self.corners, self.barycentric, vertices) - self.X
        pull = (2.0 / len(r)) * self.barycentric[:, :, None] * r[:, None]
        grad = np.zeros_like(vertices)
        np.add.at(grad, self.corners.ravel(), pull.reshape(-1, 3))
        return float((r * r).sum()) / len(r), grad
