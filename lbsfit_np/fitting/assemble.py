"""From the normalised frame back to the scan's: a FitResult out of the last stage of a fit."""

import time

import numpy as np

from ..losses.chamfer import chamfer
from ..losses.objective import objective
from ..optimize.frame import turned_root
from ..optimize.visibility import WHOLE
from ..starts.scale import unit_scale
from .confidence import AT_LIMITS, MISFIT, NO_POINTS, evidence_of, lacks_most, probability_of, verdict_of
from .labels import labels_from_mesh
from .result import FitResult

__all__ = ["GUESS", "assemble", "guesses"]

# Of the surface, where more than this share is far from all points, they may be of one side only, or of a part.
_HARDLY_REACHED = 0.1
# A joint is a guess whose place is known to less than this, a share of the rig's size; so many are named.
GUESS = 0.02
_MOST_NAMED = 6
# A subject that would be so many times as large as the rig, in a unit that was said, may be more than one, or a room.
_LARGE = 2.0


def assemble(
    rig,
    model,
    problem,
    last,
    *,
    points,
    part,
    frame,
    sigma,
    weights,
    evaluations,
    started,
    notes=(),
    x_labels=None,
    proba=None,
    labels=None,
    joint_std=None,
    value=None,
    rivals=(),
    coverage=WHOLE,
    shown=None,
    proportions=0.0,
    judged=True,
    judged_by=None,
    unit=None,
    found=(),
    further=(),
    given=(),
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
    part : TakingPart
        What of the scan was looked at; its rows are those of the problem.
    frame : Frame
        Of the problem.
    sigma : float
        Of the vertices' votes for labels, in the normalised frame.
    weights : LossWeights
        Of the full objective, for its terms.
    evaluations : int
    started : float
        ``time.perf_counter()`` at the start.
    notes : sequence of str
        Added to the message, before what the part has left out; an empty one is none.
    x_labels : (k,) int array, optional
        Parts of the problem's points that the structured term goes by; without them it is left out.
    proba : (k, n_parts) array, optional
        The segmenter's probabilities, which count for the labels.
    labels : (n,) int array, optional
        Known ones; where they are −1 the mesh says, and without any the mesh and ``proba``.
    joint_std : (J,) array, optional
        How precisely the scan tells each joint's place, in the normalised frame.
    value : float, optional
    rivals : sequence of float
        What the pose, and others that are not it, left unexplained, as in ``confidence.evidence_of``.
    coverage : Coverage
    shown : Shown, optional
        Where the scan lacks limbs.
    proportions : float
        As for ``confidence.evidence_of``.
    unit : str, optional
        The scan's, where it is known.
    found : sequence of str
        What the fit says of the scan, such as its unit; of one that has failed, with that reserve, of one that is not finite,
        nothing.
    further : sequence of str
        What a fit in doubt says would look further.
    given : sequence of {"theta0", "labels"}
        What the caller knew of the pose, which one that has failed asks about.
    judged : bool, default True
        False where the vertices say nothing of the pose: then there is no evidence, the probability is 0, and what is finite is
        "ok".
    judged_by : State, optional
        By which the evidence goes; that of the last stage by default.

    Returns
    -------
    FitResult
    """
    state, template = last.state, model.source
    offsets, rest_joints = template.vertices - rig.vertices, template.joints
    own = model.offsets(state)
    if own is not None:
        offsets = offsets + own[rig.weld] * model.half
        rest_joints = rest_joints + model.joint_offsets(state) * model.half
    pivot = rest_joints[rig.root] / model.half  # the root joint stays where it is when the frame turns
    translation = frame.outside(state.translation + state.scale * (pivot - frame.turn.T @ pivot))
    scale = float(state.scale * frame.unit / model.half)
    pose = turned_root(rig, state.theta, frame.turn)
    place = pose, translation, scale, offsets
    V, nothing = model.deformed(state).vertices, np.full(rig.vertices.shape, np.nan)
    judged_by = state if judged_by is None else judged_by
    with np.errstate(over="ignore"):
        finite = bool(np.isfinite(np.square(V).sum()))  # distances to it, too
    terms = _terms(model, problem, state, weights, x_labels, pivot, frame.turn) if finite else {"total": np.nan, "recon": np.nan}
    finite = bool(np.isfinite(terms["total"]))
    skin = slice(None) if shown is None else ~shown.missing  # points are not of what the scan lacks
    of_mesh = frame.outside(V)[skin], model.labels[skin], len(rig.parts), sigma * frame.unit
    unknown = np.ones(len(points), dtype=bool) if labels is None else labels < 0
    if labels is None and finite:
        known = {} if proba is None else {"proba": proba, "proba_points": points[part.rows]}
        labels, confidence = labels_from_mesh(points, *of_mesh, **known)
    else:
        labels, confidence = np.where(unknown, 0, 0 if labels is None else labels), np.where(unknown, 0.0, 1.0)
        if unknown.any() and finite:
            labels[unknown], confidence[unknown] = labels_from_mesh(points[unknown], *of_mesh)
    left_out = part.left_out(points)
    confidence = np.where(unknown & part.is_clutter(left_out), 0.0, confidence)
    if part.among is not None:  # labels of what lies beyond the end of the rig say nothing
        confidence = np.where(part.among, confidence, 0.0)
    took_part = np.zeros(len(points), dtype=bool)
    took_part[part.rows] = True
    term_labels = np.full(len(points), len(rig.parts))
    if x_labels is not None:
        term_labels[part.rows] = x_labels
    std = np.full(len(rig.parents), np.nan) if joint_std is None or not finite else joint_std * frame.unit
    unsure, guessed_share = guesses(rig, std, scale)
    evidence, probability, status, reason = {}, 0.0, "failed", "the fit is not finite; check the scan for extreme outliers"
    if finite and not judged:
        status, reason = "ok", ""
    elif finite:
        evidence, worst = evidence_of(
            model,
            V if judged_by is state else model.deformed(judged_by).vertices,
            problem.X,
            proba=proba,
            rivals=rivals,
            value=value,
            theta=judged_by.theta,
            coverage=coverage,
            x_weights=problem.x_weights,
            proportions=proportions,
            shown=shown,
        )
        probability = probability_of(evidence, guessed_share)
        status, reason = verdict_of(evidence, probability, {name: rig.parts[p] for name, p in worst.items() if p >= 0})
        if status != "ok":
            helps = () if lacks_most(evidence, guessed_share) else further
            reason = "; ".join([reason, *helps])
        if status == "failed":
            per = None if unit is None else unit_scale(rig, unit)  # of a known unit, as then the size is told
            large = per is not None and scale / per * template.size / rig.size > _LARGE
            reason += f"; {_asked(given, evidence, large)}"
        if shown is not None:  # what is missing is told by its own note
            unsure = unsure[~shown.joints[unsure]]
        if words := _incomplete(status, evidence, coverage, len(unsure)):
            reason = f"{reason}; {words}" if reason else f"much of the surface has no points near it: {words}"
    if shown is not None:
        notes = [shown.note, *notes] if status != "failed" else notes
    guessed = "" if status == "failed" else _guessed([rig.joint_names[j] for j in unsure])  # it is of a pose that is about right
    if not finite:
        found = ()
    elif status == "failed" and any(found):
        found = [f"if the fit is right nevertheless: {', and '.join(filter(None, found))}"]
    return FitResult(
        pose=pose,
        translation=translation,
        scale=scale,
        offsets=offsets,
        rest_joints=np.array(rest_joints),
        vertices=rig.pose(*place, joints=rest_joints) if finite else nothing,
        joints=rig.pose_joints(*place, joints=rest_joints) if finite else np.full(rig.joints.shape, np.nan),
        joint_std=std,
        labels=labels,
        confidence=confidence,
        left_out=left_out,
        took_part=took_part,
        term_labels=term_labels,
        terms=terms,
        converged=last.converged,
        status=status,
        message="; ".join(filter(None, [reason, guessed, *notes, part.told(left_out), *found])),
        probability=probability,
        evidence=evidence,
        evaluations=evaluations,
        seconds=time.perf_counter() - started,
        parts=rig.parts,
        rig_digest=rig.digest,
        unit=unit or "",
    )


def _terms(model, problem, state, weights, x_labels, pivot, turn):
    """The terms of what comes out, in half sizes of the posed rig: who has the result alone finds the same."""
    Vd, V = (posed.vertices for posed in model.pose(state))
    # The result has one translation, that of U^d, and the frame turns about the root joint, which U has elsewhere.
    away = pivot - model.rig.joints[model.rig.root]
    V = V + state.scale * (away - turn.T @ away)
    X, Vd, V = problem.X / state.scale, Vd / state.scale, V / state.scale
    sides = {"x_weights": problem.x_weights, "v_weights": problem.v_weights}
    own, K = model.offsets(state), model.K if weights.lam_lap else None
    offsets = np.zeros_like(Vd) if own is None else own
    sides |= {"x_labels": x_labels, "v_labels": None if x_labels is None else model.labels}
    L = objective(X, Vd, V, weights=weights, offsets=offsets, K=K, **sides)
    return L.terms | {"total": L.value, "recon": float(np.sqrt(chamfer(X, Vd, x_weights=problem.x_weights)[0]))}


def guesses(rig, joint_std, scale):
    """The joints whose places a scan hardly tells, of those that turn and have skin: no point could tell where others are.

    Such as a root on the ground between the feet.

    Parameters
    ----------
    rig : Rig
    joint_std : (J,) array
        As in ``FitResult``.
    scale : float
        The result's.

    Returns
    -------
    rows : (k,) int array
        The worst first.
    share : float
        Of the joints that turn and have skin.
    """
    told = rig.moving & (rig.weights.sum(axis=0) > 0)
    rows = np.flatnonzero(told & (joint_std > GUESS * rig.size * scale))
    return rows[np.argsort(-joint_std[rows], kind="stable")], len(rows) / max(np.count_nonzero(told), 1)


def _guessed(names):
    """Which joints are guesses, in words."""
    if not names:
        return ""
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f"the scan hardly tells where these joints are (see joint_std): {', '.join(names[:_MOST_NAMED])}{more}"


def _incomplete(status, evidence, coverage, n_guesses):
    """What to pass if the scan does not show all of the body, in words; empty where nothing speaks for that.

    A right fit, too, finds a wrong scale where much is missing. Limbs that are cut off may be laid on what is shown: then little
    of the surface is far from points, but a part has none, and where some joints are is a guess.
    """
    if coverage.whole and evidence["unreached"] > _HARDLY_REACHED:
        words = "if the scan shows one side only, pass partial (--partial)"
        return words + ", or if it ends before the body does, cropped (--cropped)"
    cut = status != "ok" and not coverage.cropped and n_guesses and evidence["part_unreached"] > NO_POINTS
    return f"if the scan ends before the body does, pass cropped{'' if coverage.whole else ', too'} (--cropped)" if cut else ""


def _asked(given, evidence, large):
    """What may be wrong of a fit that has failed, as a question; first of all of one whose subject would be too ``large``."""
    asked = ["is it the right rig"]
    if evidence["at_limits"] > AT_LIMITS:
        asked.append("do its limits let joints turn as they do in the scan")
    if large or evidence["part_unexplained"] > MISFIT:  # these points may be of another thing
        asked.insert(0 if large else len(asked), "does the scan show only the body, floors, walls and single points")
    if given:
        asked.append(f"{'are' if 'labels' in given else 'is'} {' and '.join(given)} right")
    if "theta0" not in given:  # which says how the scan is turned
        asked.append("does the scan stand as orientation and up say (--orientation, --up)")
    return f"{', '.join(asked[:-1])}, and {asked[-1]}?"
