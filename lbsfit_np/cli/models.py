"""Models on the command line: the files that ``lbsfit learn`` writes, where another command takes a rig."""

import json
import os
from dataclasses import asdict, is_dataclass

from ..errors import FileError, InputError, brief, counted, did_you_mean, listed
from ..learning.variants import note_on, unused
from .progress import say
from .subjects import read_subjects

__all__ = ["about_model", "is_model", "load_model", "model_in_words", "unit_parameter", "say_model_as_rig", "subjects_of"]

# Options of lbsfit fit that a model has settled: its rig's, and those of training.
_SETTLED = ("card", "shape", "skin", "normalize-weights", "parts", "joints", "segmenter", "training-scans", "training")
# Options that a model has settled, too, but that may be changed for another scan.
_FREE = ("scale", "unit", "orientation", "up", "partial", "cropped", "effort", "weights", "max_points", "registration")


def is_model(path):
    """Whether there is a learned model at ``path``; FileError where there is an NPZ that cannot be read."""
    from ..io.npz import MODEL_KEY, npz_keys

    if not str(path).lower().endswith(".npz") or not os.path.isfile(path):
        return False
    return MODEL_KEY in npz_keys(path)


def load_model(path, values, given):
    """The fitter of a model, with the options of ``lbsfit fit``.

    Parameters
    ----------
    path : str
    values : dict
        The value of every option. Those that the model has settled get the model's, in place.
    given : collection of str
        Keys of the options that were given, which win.

    Returns
    -------
    LBSFitter

    Raises
    ------
    FileError
        A broken model.
    InputError
        Options that only concern rigs or learning.
    """
    from ..learning.fitter import LBSFitter

    settled = [f"--{name}" for name in _SETTLED if name.replace("-", "_") in given and not _is_none(name, values)]
    if settled:
        raise InputError(
            settled[0],
            f"{listed(settled)} with {path}, which is a learned model",
            "no option about the rig or about training: a model keeps both as they were when it was learned",
            "Leave it out, or learn a new model with it: lbsfit learn has these options.",
        )
    fitter = LBSFitter.load(path)
    wanted = [key for key in _FREE if key in given]
    if note := note_on(fitter.variant, wanted):
        say(f"note: {note}")
    idle = unused(fitter.variant, wanted)
    for key in wanted:
        if key not in idle:
            setattr(fitter, key, unit_parameter(values) if key == "unit" else values[key])
    if fitter.orientation == "any" and "orientation" in given and "up" not in given:
        fitter.up = None  # no axis is known then, and the model's cannot be unsaid otherwise
    if "seed" in given or type(fitter.random_state) is not int:
        fitter.random_state = values["seed"]
    values |= {key: _plain(getattr(fitter, key)) for key in (*_FREE, "joints", "training_scans")}
    values |= {"training": _plain(fitter.training or {}), "seed": fitter.random_state}
    return fitter


def unit_parameter(values):
    """The parameter ``unit`` by the option of that name; None where nobody knows it."""
    return None if values["unit"] == "auto" else values["unit"]  # the word for what a model's would be otherwise


def about_model(path):
    """What a model says of itself: a dict with path, variant, rounds and subjects (all of them); None where it is no model."""
    from ..io.npz import MODEL_KEY, read_npz

    if not is_model(path):
        return None
    try:
        header = json.loads(str(read_npz(path, [MODEL_KEY])[MODEL_KEY]))
        return {
            "path": str(path),
            "variant": header["parameters"]["variant"],
            "rounds": max((entry["round"] for entry in header["history"]), default=0),
            "subjects": [str(s) for s in header["subjects"]],
        }
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        expected = "a model written by lbsfit learn"
        raise FileError(str(path), f"a model whose content does not fit ({error})", expected, "Learn it again.") from None


def model_in_words(about):
    """``about_model`` in a line."""
    names = about["subjects"]
    who = counted(len(names), "subject") + (f" ({listed(names)})" if names != ["0"] else "")
    rounds = f"{counted(about['rounds'], 'round')}, " if about["rounds"] else ""
    return f"a learned model: {who}, {rounds}variant {about['variant']!r}"


def say_model_as_rig(path):
    """Say that of a model only the rig is used, where ``path`` is one."""
    if is_model(path):
        say(f"{path} is {model_in_words(about_model(path))}; only its rig is used, not what it has learned")


def _is_none(name, values):
    return name == "card" and values["card"] == "none"


def subjects_of(fitter, values, scans):
    """Whose each scan is, by ``--subject`` or ``--subjects``, as ids of the model; None each where neither says.

    Parameters
    ----------
    fitter : LBSFitter
        That has learned.
    values : dict
        Of the options.
    scans : list of str

    Returns
    -------
    list of str, int or None

    Raises
    ------
    FileError
        A table that cannot be read, lacks a scan, or has an id that the model does not know.
    InputError
        Both options; an id that the model does not know.
    """
    one, table = values["subject"], values["subjects"]
    if table is None:
        return [None if one is None else _subject(fitter, one, "--subject")] * len(scans)
    if one is not None:
        raise InputError("--subjects", f"{table} together with --subject {one}", "one of the two", "Leave one out.")
    return read_subjects(table, scans, others=True, known=lambda wanted: _subject(fitter, wanted, "--subjects"))


def _subject(fitter, wanted, option):
    """A subject of a model, by its id as text: ids on the command line are text, in a model they may be numbers."""
    from ..learning.subjects import known_subject

    table = option == "--subjects"
    if list(fitter.template_) == [0] and wanted != "0":
        got = f"{brief(wanted)} for a model that was learned without --subjects"
        remedy = f"Leave {option if table else 'it'} out, or learn with --subjects."
        raise InputError(option, got, "no subject: it has one template", remedy)
    try:
        return known_subject(fitter.template_, wanted, option)
    except InputError as error:
        if table and not did_you_mean(wanted, map(str, fitter.template_)):
            raise InputError(option, error.got, error.expected, "Leave the id empty for scans of other subjects.") from None
        raise


def _plain(value):
    return asdict(value) if is_dataclass(value) else value
