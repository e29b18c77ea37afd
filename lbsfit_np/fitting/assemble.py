"""From the normalised frame back to the scan's: a FitResult out of the last stage of a fit."""

import time

import numpy as np

from ..losses.chamfer import chamfer
from .labels import labels_from_mesh
from .result import FitResult

__all__ = ["assemble"]


def assemble(
    rig,
    model,
    problem,
    last,
    *,
    points,
    rows,
    unit,
    centre,
    sigma,
    evaluation,
    evaluations,
    note,
    started,
    proba=None,
    labels=None,
):
    """The fit in the scan's frame and on the rig's original vertices, with a label for every point.

    Parameters
    ----------
    rig : Rig
        What offsets refer to.
    model : Model
        That was fitted: of the rig, or of a template of it.
    problem : Problem
    last : Outcome
        Of the last stage.
    points : (n, 3) array
        All of the scan.
    rows : (k,) int array
        Those of the problem.
    unit : float
        Scan units in a unit of the normalised frame.
    centre : (3,) array
        The normalised frame's origin in the scan's.
    sigma : float
        Of the vertices' votes for labels, in the normalised frame.
    evaluation : Evaluation
        The full objective at the end.
    evaluations : int
    note : str
        Added to the message.
    started : float
        ``time.perf_counter()`` at the start.
    proba : (k, n_parts) array, optional
        The segmenter's probabilities, which count for the labels.
    labels : (n,) int array, optional
        Known ones; else the mesh and ``proba`` say.

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
    if labels is None:
        known = {} if proba is None else {"proba": proba, "proba_points": points[rows]}
        labels, confidence = labels_from_mesh(points, V * unit + centre, model.labels, len(rig.parts), sigma * unit, **known)
    else:
        labels, confidence = labels.copy(), np.ones(len(points))
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
