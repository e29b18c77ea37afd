"""What ``lbsfit learn`` says where it is stopped: what is kept, and how to go on."""

import os
import shlex

from ..errors import FileError
from ..learning.variants import VARIANTS
from .progress import of_all
from .stopping import terminable
from .summary import written_of

__all__ = ["results_so_far", "stopped_early"]


def stopped_early(fitter, model, values):
    """What of the work is kept before learning was over, and how to go on, in words; the model, where a round has learned one."""
    if getattr(fitter, "history_", None):  # a round has been kept
        with terminable():
            fitter.save(model)
        kept = next(entry["round"] for entry in fitter.history_ if entry["kept"])
        replace = values["existing"] == "replace"
        # In the results' folder those of an earlier run may be.
        to_fit = _to_fit(model, values, "replace" if replace and values["results"] else None)
        anew = "the same command begins anew" if replace else "the same command with --existing replace begins anew"
        to_fit += f" --subjects {shlex.quote(values['subjects'])}" if values["subjects"] is not None else ""
        return f"stopped: {model} has what round {kept} learned, without results; {anew}; to fit scans with it: {to_fit}"
    if getattr(fitter, "regressor_", None) is None:  # training is over only when all of it is
        return "stopped before the model was learned; the same command begins anew"
    kept = "what was trained first is kept, and the rounds begin anew with the same command"
    return f"stopped before the model was learned; {kept}"


def results_so_far(fitter, model, files, entries, values):
    """How many results are written once the model is there, and how those that nobody came to are made, in words."""
    left = [f for f in files if f.name not in entries]
    whole = bool(left) and _is_result_of(fitter, left[0])  # stopped before its picture was drawn, or on the way to its entry
    left = left[whole:]
    words = f", {of_all(written_of(entries) + whole, len(files), 'result')} in {values['results']}"
    if not left:
        return words
    if any(os.path.lexists(path) for f in left for path in (f.fit, f.mesh, f.labels)):  # which --existing skip refuses
        return f"{words}; the rest alone, where files of an earlier run are: {_to_fit(model, values, 'replace')}"
    several = len(fitter.template_) > 1 and VARIANTS[fitter.variant].skinning
    which = ", each on the template that explains it best" if several else ""
    return f"{words}; the rest{which}: {_to_fit(model, values, 'skip')}"


def _is_result_of(fitter, files):
    """Whether all files of a scan are there but for a picture, and its fit is one that ``--existing skip`` keeps."""
    from ..fitting.result import FitResult
    from ..learning.archive import model_digest

    try:
        there = files.mesh.is_file() and files.labels.is_file()
        return there and FitResult.load(files.fit).model_digest == model_digest(fitter)
    except FileError:
        return False


def _to_fit(model, values, existing):
    """The command that fits scans with the model, read and written as here."""
    words = ["lbsfit", "fit", shlex.quote(str(model)), "SCAN...", "-o", shlex.quote(values["results"] or "OUT")]
    words += ["--samples", str(values["samples"])] if values["samples"] is not None else []
    words += [f"--{name}" for name in ("drop-invalid", "pictures") if values[name.replace("-", "_")]]
    return " ".join(words + (["--existing", existing] if existing else []))
