"""What the parameters of an LBSFitter and of its fits may be, checked before any work."""

from collections.abc import Mapping
from numbers import Real

import numpy as np

from ..errors import InputError, as_array, brief, check_array, check_unmasked, counted, did_you_mean
from ..fitting.checks import SCALES, check_suits, check_whole
from ..fitting.effort import EFFORTS
from ..fitting.scan_fit import FitSettings
from ..losses.checks import check_choice, check_flag
from ..losses.objective import as_weights, check_compare
from ..rig.frames import AXES
from ..rig.rig import Rig
from ..rig.units import METRES
from ..scan import check_points, count_distinct
from ..seeds import check_random_state
from ..segmentation.segmenter import Segmenter, jobs_of
from ..skinning import JOINT_MODES
from ..starts.turns import ORIENTATIONS
from ..synthesis import Synthesis
from .free_form import LOOSE
from .plain import plain
from .variants import as_variant

__all__ = [
    "check_learned",
    "check_names",
    "check_parameters",
    "check_scan",
    "check_segmenter",
    "fit_settings",
    "learned_with",
]

# Of a start: eight turns of the root, one of other joints.
_MOST_TURN, _MOST_BEND = 50.0, 2 * np.pi


def check_names(parameters, known):
    """Raise InputError unless every name is one of a fitter's parameters."""
    for name in parameters:
        if name == "subject":
            remedy = "To fit a scan of a learned subject: LBSFitter.load(model).fit_scan(points, subject=...)."
            raise InputError(name, "an argument for fits with a model", "no subject, as a rig alone knows none", remedy)
        if name in known:
            continue
        remedy = did_you_mean(name, known)
        if name in Synthesis.__dataclass_fields__:
            remedy = f"Pass training={{{name!r}: ...}}: it is a setting of the training scans."
            remedy = f"For scans that show one side only, pass partial=True. {remedy}" if name == "one_sided" else remedy
        raise InputError(name, "an unknown argument", f"one of {', '.join(known)}", remedy)


def check_parameters(fitter):
    """Raise InputError unless every parameter of the fitter can be used."""
    if not isinstance(fitter.rig, Rig):
        raise InputError("rig", type(fitter.rig).__name__, "a Rig", "Read one with load_rig.")
    weights = as_weights(fitter.weights)
    if not isinstance(fitter.training, (type(None), Mapping, Synthesis)):
        raise InputError("training", type(fitter.training).__name__, "a dict of fields of synthesis.Synthesis")
    choices = {"joints": JOINT_MODES, "scale": SCALES, "orientation": ORIENTATIONS, "effort": EFFORTS}
    for name, known in choices.items():
        check_choice(name, getattr(fitter, name), known)
    check_choice("up", fitter.up, AXES, optional=True)
    if fitter.up is not None and fitter.orientation == "any":
        remedy = "Leave it out, or choose 'upright'."
        raise InputError("up", f"{fitter.up!r} with orientation 'any'", "an orientation that has an up axis", remedy)
    check_choice("unit", fitter.unit, METRES, optional=True)
    variant = as_variant(fitter.variant)
    if variant.skinning:  # without it the weights of the data are others anyway
        check_compare(weights, variant.labels)
    check_random_state(fitter.random_state)
    for name, most in (("held_out", 0.9), ("smooth", 1e6)):
        value = getattr(fitter, name)
        if isinstance(value, bool) or not isinstance(value, Real) or not 0 <= value <= most:
            raise InputError(name, brief(value), f"a number of at least 0 and at most {most:g}")
    for name in ("sequence", "partial", "cropped", "registration"):
        check_flag(name, getattr(fitter, name))
    if fitter.smooth and not fitter.sequence:
        got = f"{float(fitter.smooth):g} without sequence"
        raise InputError("smooth", got, "a sequence", "Pass sequence=True, or leave it out.")
    jobs_of(fitter.n_jobs, None)
    for name in ("max_points", "training_scans", "rounds"):
        check_whole(name, getattr(fitter, name), 1)
    check_suits(fitter.rig, max_points=fitter.max_points, unit=fitter.unit)


def check_segmenter(segmenter, rig):
    """Raise InputError unless it is None or a Segmenter of the rig."""
    if segmenter is None:
        return
    if not isinstance(segmenter, Segmenter):
        raise InputError("segmenter", f"a {type(segmenter).__name__}", "a Segmenter", "Read one with Segmenter.load.")
    segmenter.check_rig(rig)


def learned_with(fitter):
    """What a fitter's learned state belongs to: the rig's digest, whether there is skinning, and are labels; the variant."""
    variant = as_variant(fitter.variant)
    return fitter.rig.digest, variant.skinning, variant.labels, variant.name


def check_learned(fitter):
    """Raise InputError unless a fitter has learned, with the rig and the variant that it now has."""
    if getattr(fitter, "template_", None) is None:
        from .not_learned import NotLearnedError

        raise NotLearnedError("fitter", "one that has not learned", "one that has learned", "Call fit(scans) first.")
    learned, (rig, skinning, labels, variant) = fitter._learned_with, learned_with(fitter)
    if rig != learned[0]:
        raise InputError("rig", f"{fitter.rig.name!r}", "the rig that the fitter learned with", "Learn again with this one.")
    if skinning != learned[1]:
        expected = f"one {'with' if learned[1] else 'without'} skinning, as the fitter learned with"
        raise InputError("variant", repr(fitter.variant), expected, "Learn again with this one.")
    if labels != learned[2]:
        expected = f"one {'with' if learned[2] else 'without'} labels, as the fitter learned with"
        raise InputError("variant", repr(fitter.variant), expected, "Learn again with this one.")
    if variant != learned[3]:  # which has a say in how large and how posed s and the library take a scan to be
        expected, remedy = f"{learned[3]!r}, as the fitter learned with", "Set it back, or learn again with this one."
        raise InputError("variant", repr(fitter.variant), expected, remedy)
    if fitter.segmenter_ is not None:
        fitter.segmenter_.check_rig(fitter.rig)


def fit_settings(fitter):
    """The FitSettings of a fitter."""
    skinning = as_variant(fitter.variant).skinning
    free = isinstance(fitter.weights, str) and fitter.weights == "default" and not skinning
    given = {name: getattr(fitter, name) for name in ("scale", "unit", "effort", "max_points")}
    given["unit"] = plain(fitter.unit)  # as it becomes part of digests
    given |= {"partial": bool(fitter.partial), "cropped": bool(fitter.cropped) and skinning}
    given["registration"] = bool(fitter.registration)
    return FitSettings(weights=LOOSE if free else as_weights(fitter.weights), **given)


def check_scan(rig, variant, points, theta0, labels, point_weights):
    """A scan and what is known of it, as arrays, or InputError.

    Parameters
    ----------
    rig : Rig
    variant : str
    points : (n, 3) array or Scan
    theta0 : (J, 3) array or None
    labels : (n,) int array or None
    point_weights : (n,) array or None

    Returns
    -------
    points, theta0, labels, point_weights
    """
    points = check_points(points, minimum=len(rig.parts))
    if theta0 is not None:
        theta0 = check_array("theta0", theta0, rig.lower.shape, "a row for each joint")
        most = np.maximum(_MOST_BEND, np.maximum(np.abs(rig.lower), np.abs(rig.upper)))
        most[rig.root] = _MOST_TURN
        j, axis = np.unravel_index((np.abs(theta0) / most).argmax(), theta0.shape)
        if abs(theta0[j, axis]) > most[j, axis] + 1e-3:
            got = f"an angle of {theta0[j, axis]:.3g} for joint {rig.joint_names[j]!r}"
            raise InputError("theta0", got, f"rotation vectors in radians, of at most {most[j, axis]:.3g}", "Are these degrees?")
    if point_weights is not None:
        point_weights = check_array("point_weights", point_weights, (len(points),), "one for each point")
        if point_weights.min() < 0:
            got = counted(int((point_weights < 0).sum()), "negative value")
            raise InputError("point_weights", got, "values of at least 0")
        positive = point_weights > 0
        if (distinct := count_distinct(points[positive], len(rig.parts))) < len(rig.parts):
            got = counted(int(positive.sum()), "positive value")
            got += f", of {counted(distinct, 'distinct point')}" if positive.sum() > distinct else ""
            expected = f"at least {len(rig.parts)}, as many as the rig has parts"
            raise InputError("point_weights", got, expected, "Only points that are not of the body need a weight of 0.")
        point_weights = point_weights / point_weights.max()  # whose sum is finite
    if labels is not None:
        labels = _checked_labels(labels, len(points), rig.parts)
        if as_variant(variant).skinning and not as_variant(variant).labels:
            expected = f"None: the variant {variant!r} does not use labels"
            raise InputError("labels", "known labels", expected, "Leave them out, or choose another variant.")
    return points, theta0, labels, point_weights


def _checked_labels(labels, n, parts):
    check_unmasked("labels", labels)
    labels = as_array("labels", labels, f"whole numbers of shape ({n},), one for each point")
    if labels.shape != (n,):
        of_parts = labels.shape == (n, len(parts))
        remedy = "For probabilities, pass the most probable parts: proba.argmax(axis=1)." if of_parts else None
        raise InputError("labels", f"shape {labels.shape}", f"shape ({n},), one for each point", remedy)
    if labels.dtype.kind not in "iu":
        raise InputError("labels", f"values of type {labels.dtype}", "integers that index rig.parts")
    bad = np.flatnonzero((labels < -1) | (labels >= len(parts)))
    if len(bad):
        got = f"{labels[bad[0]]} at index {bad[0]}"
        expected = f"integers from 0 to {len(parts) - 1}, which index rig.parts, or -1 where the part is not known"
        raise InputError("labels", got, expected)
    if (labels < 0).all():
        raise InputError("labels", "-1 for all points", "the part of at least one point", "Leave labels out.")
    return labels.astype(int)
