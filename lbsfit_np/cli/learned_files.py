"""The files that ``lbsfit learn`` reads and writes: whether their names can be used, before any work."""

import os
from pathlib import Path

from ..errors import FileError, InputError
from ..learning.variants import VARIANTS
from . import outputs, same_files
from .models import is_model
from .subjects import check_no_table

__all__ = ["checked_files"]

# Endings of files, beside those of scans and rigs, that a model may be called by mistake; others are dots within a name.
_OTHER_ENDINGS = (".pkl", ".json", ".toml", ".h5", ".bvh", ".fbx")


def checked_files(rig_path, scans, values, inputs):
    """The files of the results, none where they are not asked for, once no name can go wrong any more.

    Parameters
    ----------
    rig_path : str
    scans : list of str
    values : dict
        Of every option of ``lbsfit learn``.
    inputs : sequence of str
        Further files that must not be overwritten.

    Returns
    -------
    tuple of outputs.ScanFiles

    Raises
    ------
    InputError
        A name that cannot be used, or that two things would have.
    """
    from ..io.scans import SCAN_EXTENSIONS

    model, existing = Path(values["output"]), values["existing"]
    if model.suffix.lower() != ".npz":
        got = f"{model}, which ends in {model.suffix!r}" if model.suffix else f"{model}, which has no ending"
        other = model.suffix.lower() in (*SCAN_EXTENSIONS, *_OTHER_ENDINGS)  # else a dot within the name
        name = model.with_suffix(".npz") if other else f"{model}.npz"
        if model.is_dir():
            got, name = f"{model}, which is a folder", model / "model.npz"
        raise InputError("-o/--output", got, "a name that ends in .npz", f"Call it {name}.")
    if values["smooth"] and not values["sequence"] and VARIANTS[values["variant"]].skinning:
        raise InputError("--smooth", f"{values['smooth']:g} without --sequence", "a sequence", "Add --sequence, or leave it out.")
    card = values["card"] if values["card"] != "none" else None
    others = [p for p in (rig_path, card, values["subjects"], *inputs) if p]
    outputs.check_sources(scans)
    given = values["subjects"] is not None
    check_no_table(scans, "Leave it out of the scans: --subjects is given." if given else "Give it as --subjects {}.")
    _check_twice(scans)
    outputs.check_file(model, inputs=[(path, f"an input ({path})") for path in (*scans, *others)], existing=existing)
    if model.is_file() and not _was_model(model):
        got = f"{model}, a file that is not a model and would be replaced"
        raise InputError("-o/--output", got, "a new name, or an existing model", "Choose another name, or delete that file.")
    _check_steps(model)
    if values["results"] is None:
        if values["pictures"]:
            raise InputError("--pictures", "no --results", "a folder for the fits and their pictures", "Add --results OUT.")
        return ()
    _check_apart(model, values["results"])
    names = {"existing": existing, "argument": "--results", "pictures": values["pictures"]}
    files = tuple(outputs.plan(scans, values["results"], inputs=others, **names))
    for path in (p for f in files for p in f.paths.values()):
        if same_files.same_file(path, model):
            raise InputError("-o/--output", f"{model}, which is a file of --results", "another name")
    return files


def _check_steps(model):
    """Whether steps can be kept beside the model: the name that they get is longer, and may be another file's."""
    from ..io.write import check_folder
    from ..learning.checkpoint import Checkpoint, checkpoint_of

    with outputs.named_by("-o/--output"):
        check_folder(model.parent)
    try:
        Checkpoint(checkpoint_of(model))
    except InputError as error:
        remedy = "Choose another name" + f", or remove {checkpoint_of(model)}" * os.path.lexists(checkpoint_of(model)) + "."
        raise InputError("-o/--output", f"{model}, whose steps cannot be kept ({error.got})", error.expected, remedy) from None


def _check_apart(model, results):
    """The folder of the results is none that the model's own names would be, or lie below."""
    from ..learning.checkpoint import checkpoint_of

    folder = Path(same_files.folded(os.path.abspath(results)))
    for path in (model, checkpoint_of(model)):
        if Path(same_files.folded(os.path.abspath(path))) in (folder, *folder.parents):
            expected = f"a folder other than {path.name} and those in it"
            raise InputError("--results", f"{results}, with {model} as the model", expected)


def _was_model(path):
    try:
        return is_model(path)
    except FileError:  # an NPZ cut short, or no NPZ
        return False


def _check_twice(scans):
    seen = set()
    for scan in scans:
        real = os.path.realpath(scan)
        if real in seen:
            raise InputError("SCAN", f"{scan} twice", "each scan once", "Leave one out.")
        seen.add(real)
