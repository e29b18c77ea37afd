"""The free-form baseline: no skinning, the template's vertices move freely under Chamfer and Laplacian."""

import time
from dataclasses import dataclass, replace

from ..fitting.assemble import assemble
from ..losses.objective import PRESETS, LossWeights
from ..optimize.lbfgs import minimise
from ..optimize.model import Model
from ..starts.scale import extent_doubt, reference_scale, unit_note
from .checkpoint import NO_CHECKPOINT
from .collection import with_doubt

__all__ = ["LOOSE", "fit_free_form", "free_form"]

# Free vertices have all of a pose to make, and are rougher than offsets. Of λ_lap from 0.3, the fits' own, to 0.003 this one left
# the least joint and vertex errors on the study's tuning seed 5, in so many steps.
LOOSE = PRESETS["default"].replace(lam_lap=0.01)
_LOOSE_STEPS = {"max_iterations": 200, "tolerance": 1e-4}


def fit_free_form(model, collection, settings, *, jobs, progress, checkpoint=NO_CHECKPOINT):
    """Scans fitted without skinning: the template's vertices move freely under Chamfer and Laplacian.

    Returns
    -------
    list of FitResult or None
    """
    for m in collection.members:
        if settings.scale != "fixed" and settings.unit is None:
            m.doubt = extent_doubt(m.x, model.source, m.unit)
        apart = m.doubt or settings.unit is not None  # in a known unit subjects may be of any size
        own = reference_scale(m.x, model.source, settings.scale, settings.unit).scale if apart else m.unit
        m.use_frame(own, model.half)
    work = _FreeForm(model, settings)
    kept = [checkpoint.slot("free-form", m) for m in collection.members]
    answers = collection.work(work, collection.members, jobs=jobs, done=lambda p: progress("free-form fits", p), kept=kept)
    return collection.in_order(answers)


@dataclass(frozen=True)
class _FreeForm:
    model: Model
    settings: object

    def __call__(self, m):
        result = free_form(self.model, self.settings, m.problem, m.points, m.part, m.frame, time.perf_counter())
        return with_doubt(m, result)


def free_form(model, settings, problem, points, part, frame, started):
    """One scan fitted without skinning: place and scale of the model's template, then its vertices; a FitResult."""
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
        **_LOOSE_STEPS,
    )
    # Chamfer shrinks a resting template onto a posed scan: its scale says nothing of the unit, so the offsets take it up.
    grown = outcome.state.scale * (model.rig.vertices + outcome.state.residual)
    outcome = replace(outcome, state=outcome.state.replace(scale=1.0, residual=grown - model.rig.vertices))
    unit = unit_note(frame.unit / model.half, model.source, settings.scale, guessed=True, unit=settings.unit)
    # Vertices that move freely explain any scan, and say nothing of the angles, which stay at rest.
    return assemble(
        model.source,
        model,
        problem,
        outcome,
        points=points,
        part=part,
        frame=frame,
        sigma=settings.refinements[-1],
        weights=weights,
        evaluations=place_only.evaluations + outcome.evaluations,
        notes=["free-form, no skinning: joint angles are not fitted"],
        found=(unit,),
        started=started,
        judged=False,
        unit=settings.unit,
    )
