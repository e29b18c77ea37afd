"""From the normalised frame back to the scan's: a FitResult out of the last stage of a fit."""

import time

import numpy as np

from ..losses.chamfer import chamfer
from .result import FitResult

__all__ = ["assemble", "registered"]


def registered(model, state, unit, centre):
    """(m', 3): the welded registration V^d in the scan's frame; what labels are read from."""
    return model.pose(state)[0].vertices * unit + centre


def assemble(rig, model, problem, last, *, unit, centre, evaluation, labels, confidence, evaluations, note, started):
    """The fit in the scan's frame and on the rig's original vertices.

    Parameters
    ----------
    rig : Rig
        What offsets refer to.
    model : Model
        That was fitted: of the rig, or of a template of it.
    problem : Problem
    last : Outcome
        Of the last stage.
    unit : float
        Scan units in a unit of the normalised frame.
    centre : (3,) array
        The normalised frame's origin in the scan's.
    evaluation : Evaluation
        The full objective at the end.
    labels, confidence : (n,) arrays
        Of all points.
    evaluations : int
    note : str
        Added to the message.
    started : float
        ``time.perf_counter()`` at the start.

    Returns
    -------
    FitResult
    """
    state, template = last.state, model.source
    scale, translation = float(state.scale * unit / model.half), state.translation * unit + centre
    offsets, rest_joints = template.vertices - rig.vertices, template.joints
    own = model.offsets(state)
    if own is not None:
        offsets = offsets + own[rig.weld] * model.half
        rest_joints = rest_joints + model.joint_offsets(state) * model.half
    place = state.theta, translation, scale, offsets
    V = model.pose(state)[0].vertices
    recon = float(np.sqrt(chamfer(problem.X, V, x_weights=problem.x_weights, x_index=problem.x_index)[0]))
    finite = bool(np.isfinite(evaluation.value))
    ended = "converged" if last.converged else "ended at its limit of iterations"
    return FitResult(
        pose=state.theta.copy(),
        translation=translation,
        scale=scale,
        offsets=offsets,
        rest_joints=np.array(rest_joints),
        vertices=rig.pose(*place, joints=rest_joints),
        joints=rig.pose_joints(*place, joints=rest_joints),
        labels=labels,
        confidence=confidence,
        terms=dict(evaluation.terms, total=evaluation.value, recon=recon),
        converged=last.converged,
        status="ok" if finite else "failed",
        message=f"{ended}; {note}" if finite else "the fit is not finite; check the scan for wild points",
        evaluations=evaluations,
        seconds=time.perf_counter() - started,
        parts=rig.parts,
        rig_digest=rig.digest,
    )
