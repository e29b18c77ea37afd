"""What ``lbsfit learn`` says where it is stopped: what is kept, and how to go on."""

import os
import shlex

from ..errors import FileError, listed
from ..learning.variants import VARIANTS
from .progress import of_all
from .stopping import terminable
from .summary import written_of

__all__ = ["is_result_of", "results_so_far", "stopped_early"]


def stopped_early(fitter, model, subjects, values):
    """What of the work is kept before learning was over, and how to go on, in words; the model, where a round has learned one.

    ``subjects``: whose each scan is, by the table of ``--subjects``; None without one.
    """
    if getattr(fitter, "history_", None):  # a round has been kept
        with terminable():
            fitter.save(model)
        kept = next(entry["round"] for entry in fitter.history_ if entry["kept"])
        replace = values["existing"] == "replace"
        # In the results' folder those of an earlier run may be.
        to_fit = _to_fit(model, values, "replace" if replace and values["results"] else None)
        anew = "the same command begins anew" if replace else "the same command with --existing replace begins anew"
        which = "scans"
        if subjects is not None:
            others = "others without --subjects, or with an empty id in it"
            which = f"these scans{_but_for_strangers(fitter, subjects)} ({others})"
        return f"stopped: {model} has what round {kept} learned, without results; {anew}; to fit {which} with it: {to_fit}"
    if getattr(fitter, "regressor_", None) is None:  # training is over only when all of it is
        return "stopped before the model was learned; the same command begins anew"
    kept = "what was trained first is kept, and the rounds begin anew with the same command"
    return f"stopped before the model was learned; {kept}"


def results_so_far(fitter, model, files, entries, subjects, values):
    """How many results are written once the model is there, and how those that nobody came to are made, in words.

    ``subjects`` as for :func:`stopped_early`.
    """
    left = [f for f in files if f.name not in entries]
    whole = bool(left) and is_result_of(fitter, left[0])  # stopped before its picture was drawn, or on the way to its entry
    left = left[whole:]
    words = f", {of_all(written_of(entries) + whole, len(files), 'result')} in {values['results']}"
    if not left:
        return words
    if any(os.path.lexists(path) for f in left for path in (f.fit, f.mesh, f.labels)):  # which --existing skip refuses
        alone = f"alone, where files of an earlier run are{_but_for_strangers(fitter, subjects)}"
        return f"{words}; the rest {alone}: {_to_fit(model, values, 'replace')}"
    several = len(fitter.template_) > 1 and VARIANTS[fitter.variant].skinning
    which = ", each on the template that explains it best" if several and subjects is None else ""
    return f"{words}; the rest{which}{_but_for_strangers(fitter, subjects)}: {_to_fit(model, values, 'skip')}"


def _but_for_strangers(fitter, subjects):
    """Whose scans have to be left out of a command with the table, as all of them have failed; nothing where there are none."""
    strangers = [repr(s) for s in dict.fromkeys(subjects or ()) if s not in fitter.template_]
    return f", but for those of {listed(strangers)}, of whom nothing was learned" if strangers else ""


def is_result_of(fitter, files):
    """Whether all files of a scan are there but for a picture, and its fit is one that ``--existing skip`` keeps."""
    from ..fitting.result import FitResult
    from ..learning.archive import learned_digests

    try:
        there = files.mesh.is_file() and files.labels.is_file()
        return there and FitResult.load(files.fit).model_digest in learned_digests(fitter).values()
    except FileError:
        return False


def _to_fit(model, values, existing):
    """The command that fits scans with the model, read and written as here."""
    words = ["lbsfit", "fit", shlex.quote(str(model)), "SCAN...", "-o", shlex.quote(values["results"] or "OUT")]
    words += ["--samples", str(values["samples"])] if values["samples"] is not None else []
    words += [f"--{name}" for name in ("drop-invalid", "pictures") if values[name.replace("-", "_")]]
    words += ["--subjects", shlex.quote(values["subjects"])] if values["subjects"] is not None else []
    return " ".join(words + (["--existing", existing] if existing else []))
