"""A learned fitter in one NPZ, no pickle: a rig file of the package's own format with what was learned beside it.

``load_rig`` reads such a file as the rig, ``LBSFitter.load`` as the fitter.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError
from ..fitting.drawn import PosePrior
from ..losses.objective import LossWeights
from ..optimize.state import free_angles
from ..rig.units import METRES
from ..segmentation.segmenter import Segmenter
from ..starts.library import PoseLibrary
from .plain import plain
from .subjects import check_ids
from .variants import as_variant

__all__ = [
    "learned_arrays",
    "learned_digests",
    "model_digest",
    "plain_parameters",
    "read_fitter",
    "write_fitter",
]

_FORMAT = 5
_EXPECTED = "a model that was saved with LBSFitter.save or written by lbsfit learn"
_OTHERS = "lbs.load_rig reads rigs; lbs.FitResult.load reads results."


def write_fitter(fitter, path):
    """Write a learned LBSFitter.

    Parameters
    ----------
    fitter : LBSFitter
        After ``fit``.
    path : path-like
        Should end in ``.npz``.
    """
    from ..io.npz import MODEL_KEY
    from ..io.npz_rig import rig_arrays
    from ..io.write import check_npz_name, write_npz

    check_npz_name(path)
    subjects = list(fitter.template_)
    header = {
        "format": _FORMAT,
        "parameters": plain_parameters(fitter),
        "subjects": subjects,
        "units": [fitter.unit_[s] for s in subjects],
        "learned_unit": fitter.learned_unit_,
        "history": fitter.history_,
        "rig_digest": fitter.rig.digest,
    }
    segmenter, library = fitter.segmenter_, fitter.regressor_
    if segmenter is not None:
        header["segmenter"] = segmenter.header()
    header["library"], header["pose_prior"] = library is not None, getattr(fitter, "pose_prior_", None) is not None
    try:
        text = json.dumps(header, default=_jsonable)
    except TypeError as error:
        raise InputError("fitter", f"parameters that cannot be saved ({error})", "numbers, text and settings") from None
    write_npz(path, **{MODEL_KEY: np.array(text)}, **rig_arrays(fitter.rig), **_arrays(fitter, fitter.template_.values()))


def plain_parameters(fitter):
    """A fitter's parameters by their names, but for the rig and the processes."""
    parameters = {k: v for k, v in fitter._all_params().items() if k not in ("rig", "n_jobs")}
    if isinstance(parameters["weights"], LossWeights):
        parameters["weights"] = asdict(parameters["weights"])
    training = parameters["training"]
    if training is not None:
        parameters["training"] = dict(training) if isinstance(training, Mapping) else asdict(training)
    if not isinstance(parameters["random_state"], (int, np.integer, type(None))):
        parameters["random_state"] = None
    return parameters


def _jsonable(value):
    """``default`` of ``json.dumps``."""
    known = plain(value)
    if known is value:
        raise TypeError(f"a {type(value).__name__}")
    return known


def model_digest(fitter, subject=None):
    """Hex digest of all that a fit with a learned fitter depends on, but for the settings of the fit; "" before ``fit``.

    The same before and after saving. Of a fit that is told its ``subject`` this one's template alone counts; one that is not may
    take any, and find that the scan is of somebody else.
    """
    if getattr(fitter, "template_", None) is None:
        return ""
    h = hashlib.sha256()
    templates = fitter.template_ if subject is None else {subject: fitter.template_[subject]}
    subjects = [(s, float(fitter.unit_[s])) for s in templates]
    words = plain(fitter.variant), plain(fitter.joints)
    made_of = fitter.rig.digest, *words, subjects, subject is not None, fitter.learned_unit_
    h.update(repr(made_of).encode())
    for name, array in sorted(_arrays(fitter, templates.values()).items()):
        h.update(f"{name} {array.dtype.str} {array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return h.hexdigest()


def learned_digests(fitter):
    """Subject → hex digest of the results that learning itself left of this one's scans; none before ``fit``.

    They are neither fits of scans that might be anybody's nor fits as a subject that was named, and may stand for both.
    """
    whole = model_digest(fitter)
    templates = getattr(fitter, "template_", None) or {}
    return {s: hashlib.sha256(f"{whole} learned {s!r}".encode()).hexdigest() for s in templates}


def _arrays(fitter, templates):
    """Templates, and the fitter's segmenter, library and prior of poses, as the named arrays of a model file."""
    arrays = {
        "model_vertices": np.array([t.vertices for t in templates]),
        "model_joints": np.array([t.joints for t in templates]),
    }
    if (prior := getattr(fitter, "pose_prior_", None)) is not None:
        arrays |= {"model_prior_mean": prior.mean, "model_prior_precision": prior.precision}
    return arrays | learned_arrays(fitter.segmenter_, fitter.regressor_)


def learned_arrays(segmenter, library):
    """A segmenter and a library, or None in place of either, as the named arrays of a model file."""
    arrays = {} if segmenter is None else segmenter.arrays("model_stage")
    return arrays | ({} if library is None else library.arrays("model_library"))


def read_fitter(path, make):
    """What :func:`write_fitter` wrote.

    Parameters
    ----------
    path : path-like
    make : callable (rig, parameters, fields) → fitter

    Returns
    -------
    What ``make`` returns.

    Raises
    ------
    FileError
        No such file, or one that is broken or no model.
    """
    from ..io.npz import MODEL_KEY, RESULT_KEY, npz_keys, read_npz
    from ..io.rigs import load_rig

    if isinstance(path, (str, os.PathLike)) and os.path.isfile(path) and Path(path).suffix.lower() != ".npz":
        got = f"a file that ends in {Path(path).suffix}" if Path(path).suffix else "a file without an ending"
        raise FileError(str(path), got, f"{_EXPECTED}, whose name ends in .npz", _OTHERS)
    keys = npz_keys(path)
    if MODEL_KEY not in keys:
        got = "the result of a fit" if RESULT_KEY in keys else f"an NPZ without the key {MODEL_KEY}"
        raise FileError(str(path), got, _EXPECTED, _OTHERS)
    rig = load_rig(path)  # of a model, without a card that lies beside it
    arrays = read_npz(path)
    try:
        header = json.loads(str(arrays[MODEL_KEY]))
        if header["format"] != _FORMAT:
            raise FileError(str(path), f"model format {header['format']}", f"format {_FORMAT}", "Learn it again.")
        if rig.digest != header["rig_digest"]:
            raise ValueError("its rig is not the one that it was learned with")
        parameters = dict(header["parameters"])
        if isinstance(parameters["weights"], dict):
            parameters["weights"] = LossWeights(**parameters["weights"])
        subjects, units = header["subjects"], [float(unit) for unit in header["units"]]
        _check_subjects(subjects, units)
        U, J = arrays["model_vertices"], arrays["model_joints"]
        if U.shape != (len(subjects), *rig.vertices.shape) or J.shape != (len(subjects), *rig.joints.shape):
            raise ValueError("templates that do not fit the rig")
        segmenter = None
        if "segmenter" in header:
            segmenter = Segmenter.from_arrays(header["segmenter"], arrays, "model_stage")
        library = PoseLibrary.from_arrays(arrays, "model_library") if header["library"] else None
        if library is not None and library.poses.shape[1:] != rig.lower.shape:
            raise ValueError("a library of poses of another rig")
        prior = None
        if header["pose_prior"]:
            prior = PosePrior(arrays["model_prior_mean"], arrays["model_prior_precision"])
            t = int(free_angles(rig).sum())
            if prior.mean.shape != rig.lower.shape or prior.precision.shape != (t, t):
                raise ValueError("a prior of poses of another rig")
            if not (np.isfinite(prior.mean).all() and np.isfinite(prior.precision).all()):
                raise ValueError("a prior of poses with values that are not finite")
        fields = {
            "template_": {s: rig.with_template(u, j) for s, u, j in zip(subjects, U, J, strict=True)},
            "unit_": dict(zip(subjects, units, strict=True)),
            "learned_unit_": _known_unit(header["learned_unit"]),
            "segmenter_": segmenter,
            "regressor_": library,
            "pose_prior_": prior,
            "history_": header["history"],
        }
        fitter = make(rig, parameters, fields)
        variant = as_variant(fitter.variant)
        if (segmenter is not None, library is not None) != (variant.labels, variant.skinning):
            raise ValueError(f"a segmenter or a library that the variant {variant.name!r} has not, or none where it has one")
        return fitter
    except FileError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, RecursionError, OverflowError) as error:
        raise FileError(str(path), f"a model whose content does not fit ({error})", _EXPECTED, "Learn it again.") from None


def _check_subjects(subjects, units):
    """Raise ValueError unless there are subjects, each once, and a unit of each: no broken file is to fail later, or to fit."""
    check_ids(subjects)
    if not isinstance(subjects, list) or not subjects or len(set(subjects)) != len(subjects):
        raise ValueError("no subjects, or one of them twice")
    if not all(np.isfinite(unit) and unit > 0 for unit in units):
        raise ValueError("units of subjects that are not positive")


def _known_unit(name):
    if name is not None and name not in METRES:
        raise ValueError(f"the unknown unit {name!r}")
    return name
