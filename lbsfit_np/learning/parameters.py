"""What the parameters of an LBSFitter may be, checked before any work."""

from collections.abc import Mapping

import numpy as np

from ..errors import InputError, brief
from ..losses.objective import as_weights
from ..rig.rig import Rig
from ..skinning import JOINT_MODES
from ..synthesis import Synthesis
from .variants import as_variant

__all__ = ["check_labels", "check_parameters"]


def check_parameters(fitter):
    """Raise InputError unless every parameter of the fitter can be used."""
    if not isinstance(fitter.rig, Rig):
        raise InputError("rig", type(fitter.rig).__name__, "a Rig", "Read one with load_rig.")
    as_weights(fitter.weights)
    if not isinstance(fitter.training, (type(None), Mapping, Synthesis)):
        raise InputError("training", type(fitter.training).__name__, "a dict of fields of synthesis.Synthesis")
    if fitter.joints not in JOINT_MODES:
        raise InputError("joints", repr(fitter.joints), " or ".join(map(repr, JOINT_MODES)))
    if fitter.scale not in ("estimate", "fixed"):
        raise InputError("scale", repr(fitter.scale), "'estimate' or 'fixed'")
    as_variant(fitter.variant)
    for name, low, high in (("held_out", 0, 0.9), ("smooth", 0, np.inf)):
        value = getattr(fitter, name)
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value <= high:
            most = "" if high == np.inf else f" and at most {high}"
            raise InputError(name, brief(value), f"a number of at least {low}{most}")
    if not isinstance(fitter.sequence, (bool, np.bool_)):
        raise InputError("sequence", brief(fitter.sequence), "True or False")
    for name in ("max_points", "training_scans", "rounds"):
        value = getattr(fitter, name)
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise InputError(name, repr(value), "a positive integer")


def check_labels(labels, n, parts):
    """Known labels of n points as integers that index ``parts``, or InputError."""
    labels = np.asarray(labels)
    if labels.shape != (n,):
        raise InputError("labels", f"shape {labels.shape}", f"shape ({n},), one for each point")
    if labels.dtype.kind not in "iu":
        raise InputError("labels", f"values of type {labels.dtype}", "integers that index rig.parts")
    bad = np.flatnonzero((labels < 0) | (labels >= len(parts)))
    if len(bad):
        got = f"{labels[bad[0]]} at index {bad[0]}"
        raise InputError("labels", got, f"integers from 0 to {len(parts) - 1}, which index rig.parts")
    return labels.astype(int)
