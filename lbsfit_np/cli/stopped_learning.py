"""What ``lbsfit learn`` keeps and says where it is stopped, or ends with an error, and how to go on."""

import itertools
import os
import shlex

from ..errors import FileError, listed
from ..segmentation.cache import could_not_keep
from .progress import of_all
from .stopping import terminable
from .summary import written_of

__all__ = ["goes_on", "is_result_of", "results_so_far", "stopped_early"]

# Letters of scans' names up to which a command has them all.
_SHORT = 200


def stopped_early(fitter, model, scans, failed, subjects, values):
    """What of the work is kept before learning was over, and how to go on, in words; a model, where a round has learned one.

    A model that is there was finished, or is at least another: it stays, and this one gets a name beside it.

    ``scans``: their paths as given; ``failed``: which of them, by number, cannot be used. ``subjects``: whose each scan is, by
    the table of ``--subjects``; None without one.
    """
    if getattr(fitter, "history_", None):  # a round has been kept
        unfinished = _free_name(model)
        with terminable():
            fitter.save(unfinished)
        kept = next(entry["round"] for entry in fitter.history_ if entry["kept"])
        replace = values["existing"] == "replace"
        existing = "replace" if replace and values["results"] and unfinished == model else None
        # In the results' folder those of an earlier run may be; they go with its model, which may have stayed.
        known = [scans[i] for i in _of_the_known(fitter, subjects, len(scans)) if i not in failed]
        to_fit = _to_fit(unfinished, values if unfinished == model else {**values, "results": None}, existing, known)
        anew = f"run the same command{'' if replace else ' with --existing replace'} {goes_on(model) or 'to start again'}"
        which = "scans with it"
        if subjects is not None:
            which = f"these scans with it{_but_for_strangers(fitter, subjects)}"
            which += " (fit others without --subjects, or with an empty id in its file)"
        stays = f"; {model} is left as it was" if unfinished != model else ""
        return f"stopped: {unfinished} has what round {kept} learned, without results{stays}; {anew}; to fit {which}: {to_fit}"
    if words := goes_on(model):
        return f"stopped before the model was learned; run the same command {words}"
    # Training is over only when all of it is; what could not be written is gone, as was warned of.
    if getattr(fitter, "regressor_", None) is None or could_not_keep():
        return "stopped before the model was learned; run the same command to start again"
    kept = "the first training is kept; run the same command to start the rounds again"
    return f"stopped before the model was learned; {kept}"


def _free_name(model):
    """Where to write a model that is not finished: a name that is free, beside the model's if that is not."""
    beside = (model.with_name(f"{model.stem}.stopped{f'-{k}' if k > 1 else ''}{model.suffix}") for k in itertools.count(1))
    return next(path for path in itertools.chain([model], beside) if not os.path.exists(path))


def goes_on(model):
    """What a later run does with what is kept, in words; nothing where nothing is."""
    from ..learning.checkpoint import checkpoint_of, steps_in

    kept = checkpoint_of(model)
    return f"to continue from the steps kept in {kept}" if steps_in(kept) else ""


def results_so_far(fitter, model, files, entries, subjects, values):
    """How many results are written once the model is there, and how those that nobody came to are made, in words.

    ``subjects`` as for :func:`stopped_early`.
    """
    from ..learning.archive import learned_digests

    left, useless = [f for f in files if f.name not in entries], {e["name"] for e in entries.values() if "files" not in e}
    words = f", {of_all(written_of(entries), len(files), 'result')} in {values['results']}"
    if not left:
        return words
    unwritten = [f for f in files if f in left or f.name in useless]  # of those that failed, an earlier run's may be there
    there = [f for f in unwritten if any(os.path.lexists(path) for path in (f.fit, f.mesh, f.labels))]
    learned = set(learned_digests(fitter).values())
    anew = not all(is_result_of(learned, f) for f in there)  # which --existing skip would refuse, or keep though they are others
    known = [files[i] for i in _of_the_known(fitter, subjects, len(files))]
    known = [f.source for f in known if f in left or (not anew and f.name not in useless)]
    command = _to_fit(model, values, "replace" if anew else "skip", known)
    only, replacing = ("only ", ", replacing files of an earlier run") if anew else ("", "")
    return f"{words}; to write {only}the rest{replacing}{_but_for_strangers(fitter, subjects)}: {command}"


def _strangers(fitter, subjects):
    """Subjects of whom nothing was learned, as all their scans have failed."""
    return [s for s in dict.fromkeys(subjects or ()) if s not in fitter.template_]


def _of_the_known(fitter, subjects, n):
    """Which of n scans are of subjects of whom something was learned."""
    unknown = _strangers(fitter, subjects)
    return [i for i in range(n) if subjects is None or subjects[i] not in unknown]


def _but_for_strangers(fitter, subjects):
    """Whose scans have to be left out of a command with the table; nothing where there are none."""
    strangers = listed([repr(s) for s in _strangers(fitter, subjects)])
    return f", except scans of {strangers}, of whom nothing was learned" if strangers else ""


def is_result_of(learned, files):
    """Whether all files of a scan are there but for a picture, and its fit has one of the digests that learning's own have."""
    from ..fitting.result import FitResult

    try:
        there = files.mesh.is_file() and files.labels.is_file()
        return there and FitResult.load(files.fit).model_digest in learned
    except FileError:
        return False


def _to_fit(model, values, existing, scans):
    """The command that fits scans, these where their names are short, with the model, read and written as here."""
    scans = " ".join(map(shlex.quote, scans))
    words = ["lbsfit", "fit", shlex.quote(str(model)), scans if 0 < len(scans) <= _SHORT else "SCAN..."]
    words += ["-o", shlex.quote(values["results"] or "OUT")]
    words += ["--samples", str(values["samples"])] if values["samples"] is not None else []
    words += [f"--{name}" for name in ("drop-invalid", "pictures") if values[name.replace("-", "_")]]
    words += ["--subjects", shlex.quote(values["subjects"])] if values["subjects"] is not None else []
    return " ".join(words + (["--existing", existing] if existing else []))
