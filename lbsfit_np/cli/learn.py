"""``lbsfit learn``: learn from a collection of scans, and write what was learned as one model file."""

import time
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError, LbsfitError, counted
from ..interrupts import held
from ..io.write import remove_empty
from ..learning.variants import VARIANTS, note_on, unused
from . import earlier_results, outputs, scan_results
from .fit import OPTIONS as FIT_OPTIONS
from .fit import RIG_OPTIONS, check_training, load_rig_with, scan_options
from .learned_files import checked_files
from .models import about_model, unit_parameter
from .parsing import Option, add_options, amount, formatter, positive, settings, share
from .progress import LearningProgress, Progress, of_all, say, span
from .reading import Reading
from .sequences import order_note, takes_note
from .stopped_learning import goes_on, is_result_of, results_so_far, stopped_early
from .stopping import exit_code, say_steps, terminable
from .subjects import SUBJECT_FILES, read_subjects, who_words
from .summary import counts_of, say_doubtful, write_summary, written_of

__all__ = ["OPTIONS", "add_parser", "learn_files"]

# Options that mean the same here as in lbsfit fit.
_SHARED = (
    *("scale", "unit", "orientation", "up", "partial", "cropped", "effort", "weights", "joints", "samples", "drop-invalid"),
    *("max-points", "registration", "training-scans", "training", "seed", "jobs"),
)

# What is said of these here.
_HELP = {
    "training-scans": "synthetic scans to train the segmenter on, at first and in each round; the library of starts gets half as "
    "many, with --partial --cropped twice, in rounds three eighths",
    "unit": "the scans' unit, if known (subjects' sizes are still found); auto: not known; by default auto",
}
# Scans that the last line names, at most.
_NAMED = 5

OPTIONS = (
    Option("output", "the model to write (required), NAME.npz; its folder is created if needed", metavar="MODEL", flag="-o",
           is_path=True),
    Option("results", "folder to write the scans' fits to as well, as lbsfit fit does", metavar="OUT", is_path=True),
    Option("pictures", "with --results, also draw each fit as NAME.png", bool, False),
    Option("subjects", "a file that says who was scanned; one subject by default", metavar="FILE", is_path=True),
    Option("rounds", "maximum number of rounds", positive, 4, metavar="N"),
    Option("variant", "what to learn from", default="joint", choices=tuple(VARIANTS)),
    Option(
        "held-out",
        "share of the scans (at least one) to hold out of learning, to tell when to stop; 0 holds none out and does every round",
        share,
        0.1,
        metavar="SHARE",
    ),
    Option("sequence", "each subject's scans are given in order of time; each scan also starts from its neighbours", bool, False),
    Option("smooth", "with --sequence, how strongly angles follow their neighbours': 1e-5 a little, 1e-3 a lot", amount, 0,
           metavar="W"),
    *RIG_OPTIONS,
    *(replace(o, help=_HELP[o.name]) if o.name in _HELP else o for o in FIT_OPTIONS if o.name in _SHARED),
    Option(
        "existing",
        "what to do if the model or results already exist",
        default="error",
        choices=("error", "replace"),
        refusals={"skip": "lbsfit learn never skips: only lbsfit fit can, with an existing model."},
    ),
)  # fmt: skip

_DESCRIPTION = f"""\
Learn from a collection of scans. All scans of a subject share one template, found from all their poses; that, and what the poses
tell of each other, makes fits better. The segmenter learns along, so labels of new scans improve, too. All scans must be in one
unit. The result is one file, the model, which `lbsfit fit MODEL SCAN...` takes in place of a rig.

{SUBJECT_FILES}

--variant: joint uses everything. With pose-only, the segmenter learns from the poses found but not from templates; with rand,
from uniform poses only. cd uses no labels at all. free-form uses no skinning at all: the template's vertices move freely.

Each round ends with a line that gives recon, the distance between scans and meshes in half sizes of the rig (the root of the
Chamfer distance), for the scans learned from and for those held out; how many scans got a better pose from a new start; and
how long the remaining rounds may take.
"""

_EPILOG = """\
examples:
  lbsfit learn hand scans/*.ply -o model.npz
  lbsfit learn hand scans/*.ply -o model.npz --subjects who.csv --jobs 2 --results fits
  lbsfit learn body.glb walk/*.ply -o walk.npz --sequence --smooth 1e-5
  lbsfit fit model.npz new.ply -o fits

  Options can be in a TOML file, --config FILE, by their long names; paths are relative to the file:
      output = "model.npz"
      subjects = "who.csv"
      held-out = 0.2

A scan that cannot be used is named with the reason and left out. The model appears once it is complete or, after Ctrl-C, with
what the rounds so far have learned; if there is a model already (--existing replace), that stays until then, and what the
rounds so far have learned goes to MODEL.stopped.npz, or MODEL.stopped-2.npz and so on. Inputs are never overwritten. Until the
model is complete, finished steps are kept in MODEL.npz.unfinished: after a stop or a crash the same command continues from
there, even with more scans added at its end (with --existing replace where there is a model already; after Ctrl-C the last
line has the command).
What is trained for the rig at first is kept in $LBSFIT_CACHE, or else in the user's cache folder. The last lines give the unit of
the scans, how many fits are ok, suspect or failed, and a table of those that are not ok (see lbsfit fit --help).
Exit code: 0 learned, and all scans could be used, even if some were held out or not learned from, 1 some could not be used or
their fits failed, 2 usage, unreadable rig, or no model could be learned, 130 stopped by Ctrl-C, 143 by SIGTERM.
"""


def add_parser(commands):
    """Add ``lbsfit learn`` to the subparsers ``commands``."""
    parser = commands.add_parser(
        "learn", help="learn from a collection of scans", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=formatter
    )
    parser.add_argument("rig", metavar="RIG", help="a rig file (.npz .glb .gltf .pkl) or a bundled rig (see: lbsfit rig list)")
    parser.add_argument(
        "scans", metavar="SCAN", nargs="+", help="scans: .ply .obj .stl .off .xyz .pts .asc .txt .csv .pcd .npy .npz .glb .gltf"
    )
    add_options(parser, OPTIONS)
    parser.add_argument("--config", metavar="FILE", help="a TOML file with these options; the command line wins")
    parser.set_defaults(run=_run)


def _run(arguments):
    values = settings(arguments, OPTIONS, arguments.config)
    if values["output"] is None:
        raise InputError("-o/--output", "nothing", "the model to write", "Add -o MODEL.npz.")
    return learn_files(arguments.rig, arguments.scans, values, inputs=[arguments.config] if arguments.config else [])


def learn_files(rig_path, scans, values, *, inputs=()):
    """Learn from scans in files, write the model, and the scans' fits where asked.

    Parameters
    ----------
    rig_path : str
    scans : list of str
    values : dict
        Of every option in ``OPTIONS``.
    inputs : sequence of str
        Further files that must not be overwritten.

    Returns
    -------
    int
        Exit code.
    """
    from ..learning.checkpoint import checkpoint_of, remove_checkpoint
    from ..learning.parameters import check_parameters

    started = time.perf_counter()
    model, scans = Path(values["output"]), earlier_results.without_results(scans)
    files = checked_files(rig_path, scans, values, inputs)
    subjects = None if values["subjects"] is None else read_subjects(values["subjects"], scans)
    rig = load_rig_with(rig_path, values)
    values = _without_unused(values)
    for note in (order_note(scans, subjects), takes_note(scans, subjects)) if values["sequence"] else ():
        if note:
            say(f"note: {note}")
    for words in who_words(subjects):
        say(words)
    fitter = _fitter(rig, values)
    check_parameters(fitter)  # before a folder is made
    folders = outputs.out_folder(model.parent)
    if files:
        try:
            folders = outputs.out_folder(values["results"], "--results") + folders
        except InputError:
            remove_empty(folders)
            raise
    checkpoint = checkpoint_of(model)
    say_steps(checkpoint)
    progress = LearningProgress(values["rounds"])
    reading = Reading(scans, scan_options(values), len(rig.parts), progress, keep=bool(files))
    entries, written = {}, False
    try:
        with terminable():
            _learn(fitter, reading, subjects, progress, checkpoint)
            with held():  # once the model is there, it is not one to leave alone
                fitter.save(model)
                written = True
            remove_checkpoint(checkpoint)
            say(_learned(fitter, reading, model, time.perf_counter() - started))
            say(_units(fitter))
            if files:
                _write_results(rig_path, fitter, reading, files, entries, values, started)
            else:
                entries = _unwritten(fitter, reading)
            _say_statuses(entries, fitter.roles_, values["results"])
    except KeyboardInterrupt as stop:
        progress.close()
        results = results_so_far(fitter, model, files, entries, subjects, values) if files and written else ""
        early = "" if written else stopped_early(fitter, model, scans, reading.failures, subjects, values)
        end = early or f"stopped: {model} is complete{results}"
        known = {e["input"] for e in entries.values()}  # the lines that named the others may be far above
        say_doubtful([*entries.values(), *(e for e in reading.unused() if e["input"] not in known)])
        say(end)
        return exit_code(stop)
    except Exception:
        progress.close()
        if not written and (words := goes_on(model)):
            say(f"an error ended the run before the model was written; fix it, then run the same command {words}")
        raise
    finally:
        progress.close()
        remove_empty(folders)
    return 1 if counts_of(entries)["failed"] else 0


def _without_unused(values):
    """Options that mean nothing in the variant are named and back at their defaults."""
    defaults = {o.key: o.default for o in OPTIONS}
    given = [key for key, default in defaults.items() if values[key] != default]
    if note := note_on(values["variant"], given):
        say(f"note: {note}")
    return values | {key: defaults[key] for key in unused(values["variant"], given)}


def _fitter(rig, values):
    from ..learning.fitter import LBSFitter

    check_training(values["training"])
    names = ("weights", "joints", "scale", "orientation", "up", "partial", "cropped", "effort", "max_points")
    names += ("registration", "training_scans", "training")
    return LBSFitter(
        rig,
        **{name: values[name] for name in (*names, "variant", "rounds", "held_out", "sequence", "smooth")},
        unit=unit_parameter(values),
        n_jobs=values["jobs"],
        random_state=values["seed"],
    )


def _learn(fitter, reading, subjects, progress, checkpoint):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* scans cannot be used; ")  # each has been named already
        warnings.filterwarnings("ignore", message="most fits have failed: ")  # said at the end, with how many
        show = warnings.showwarning

        def show_on_a_line(*args, **kwargs):
            progress.close()
            show(*args, **kwargs)

        warnings.showwarning = show_on_a_line
        try:
            fitter.fit(reading.sources, subjects, cache=True, checkpoint=checkpoint, progress=progress)
        finally:  # those that were stopped may leave a model, too
            progress.close()
            for i, message in getattr(fitter, "failures_", {}).items():
                reading.fail(i, message)


def _learned(fitter, reading, model, seconds):
    """What was learned, in a line."""
    from ..learning.collection import APART, HELD_OUT, LEARNED_FROM

    n, who = len(reading.paths), len(fitter.template_)
    scans = counted(n, "scan")
    if not VARIANTS[fitter.variant].skinning:
        fitted = n - len(reading.failures)
        return f"fitted {fitted} of {scans}, each by itself; wrote {model}, with their unit, after {span(seconds)}"
    learned, held, set_apart, failed = map(fitter.roles_.count, (LEARNED_FROM, HELD_OUT, APART, None))
    rounds = max((entry["round"] for entry in fitter.history_), default=0)
    apart = [f"{held} held out"] * (held > 0) + [f"{set_apart} not learned from"] * (set_apart > 0)
    apart += [f"{failed} could not be used"] * (failed > 0)
    if set_apart:
        named = [reading.name(i) for i, role in enumerate(fitter.roles_) if role == APART][:_NAMED]
        why = "its first fit" if set_apart == 1 else "their first fits"
        apart[-1 - (failed > 0)] += f", as {why} had another scale: {', '.join(named)}{', …' * (set_apart > _NAMED)}"
    apart = f" ({'; '.join(apart)})" if apart else ""
    early = ", ended early as the held-out scans no longer improved" if 0 < rounds < fitter.rounds else ""
    kept = next((entry["round"] for entry in fitter.history_ if entry["kept"]), rounds)
    which = f", keeping round {kept}" if kept < rounds else ""
    return (
        f"learned from {learned} of {scans} of {counted(who, 'subject')}{apart} "
        f"in {counted(rounds, 'round')}{early}{which}; wrote {model} after {span(seconds)}"
    )


def _units(fitter):
    """The unit of the scans, or of each subject's where they differ, in a line."""
    from ..rig.units import WORDS
    from ..starts.scale import likely_unit, same_unit, unit_scale

    if fitter.unit is not None:
        words = f"scans are in {WORDS[fitter.unit]}, as specified"
        if fitter.scale == "fixed" or not VARIANTS[fitter.variant].skinning:
            return words
        per, own = unit_scale(fitter.rig, fitter.unit), fitter.rig.size  # templates take up part of how large a subject is
        sizes = [unit / per * fitter.template_[subject].size / own for subject, unit in fitter.unit_.items()]
        low, high = f"{min(sizes):.2f}", f"{max(sizes):.2f}"
        return f"{words}; subjects are {low if low == high else f'{low} to {high}'} times as large as the rig"
    if fitter.scale == "fixed":
        return "scans are assumed to be in the rig's unit (scale fixed at 1)"
    told = {}
    for subject, unit in fitter.unit_.items():
        found = likely_unit(unit, fitter.rig)
        name = "the rig's unit" if same_unit(unit) else WORDS.get(found, "another unit, or of another size")
        told.setdefault(name, {})[subject] = unit
    words = []
    for name, units in told.items():
        whose = f" of {', '.join(map(str, units))}" if len(told) > 1 else ""
        low, high = f"{min(units.values()):.4g}", f"{max(units.values()):.4g}"
        per = "" if name == "the rig's unit" else f" ({low if low == high else f'{low} to {high}'} per rig unit)"
        verb = "seem to be" if name in WORDS.values() else "are"
        words.append(f"scans{whose} {verb} in {name}{per}")
    return "; ".join(words)


def _unwritten(fitter, reading):
    """What became of each scan where no results are written: entries by the scans' paths."""
    entries = {}
    for i, (path, result) in enumerate(zip(reading.paths, fitter.results_, strict=True)):
        entry = {"name": reading.name(i), "input": path}
        if result is None:
            entries[path] = entry | {"status": "failed", "message": reading.why(i)}
        else:
            message = result.message if result.status == "ok" else reading.why(i, result.message)
            known = {"probability": result.probability, "evidence": result.evidence}  # by which unsure ones are named
            entries[path] = entry | {"status": result.status, "message": message, **known}
    return entries


def _say_statuses(entries, roles, results):
    """The scans in doubt, and how many there are of each status; ``roles``: what each of them was to learning."""
    from ..learning.collection import most_failed

    say_doubtful(list(entries.values()))
    counts, n = counts_of(entries), len(entries)
    words = ", ".join(f"{counts[status]} {status}" for status in ("ok", "suspect", "failed"))
    written = "" if results is None else f"; {of_all(written_of(entries), n, 'result')} in {results}"
    say(f"fits of {counted(n, 'scan')}: {words}{written}")
    if words := most_failed([entry["status"] for entry in entries.values()], roles):
        say(words)


def _write_results(rig_path, fitter, reading, files, entries, values, started):
    """The files of every scan, as ``lbsfit fit`` writes them, and the summary; ``entries`` fills up."""
    writer = scan_results.Writer(fitter.rig, files)
    progress = Progress(len(files) - len(reading.failures))
    stopped = True
    try:
        for i, (f, result) in enumerate(zip(files, fitter.results_, strict=True)):
            try:
                entries[f.name] = _without_fit(reading, i, f, result) or writer(i, reading.scans[i], result)
            except LbsfitError as error:
                entries[f.name] = scan_results.unfitted_entry(f, str(error))
            if result is None:
                continue
            read = reading.scans[i].notes  # said when it was read
            progress.notes(f.name, [note for note in entries[f.name].get("notes", ()) if note not in read])
            progress.scan(entries[f.name])
        stopped = False
    finally:
        progress.close()
        if stopped:
            with suppress(Exception, KeyboardInterrupt):  # the summary is worth more
                _settle_the_rest(fitter, reading, files, entries)
        facts = {"started": started, "stopped": stopped, "model": about_model(values["output"]), "history": fitter.history_}
        write_summary(Path(values["results"]), rig_path, fitter.rig, files, entries, values, **facts)


def _without_fit(reading, i, files, result):
    """The entry of a scan without a result, or with one that is not finite and so is not written; None for any other."""
    if result is None:
        return scan_results.unfitted_entry(files, reading.why(i))
    if not np.isfinite(result.vertices).all():
        return scan_results.unfitted_entry(files, scan_results.with_reasons(result.message, reading.scans[i].notes))
    return None


def _settle_the_rest(fitter, reading, files, entries):
    """Entries, after a stop, of the scans left that have no fit, and of the first one where its files were written already."""
    from ..learning.archive import learned_digests

    learned = set(learned_digests(fitter).values())
    left = [(i, f, result) for i, (f, result) in enumerate(zip(files, fitter.results_, strict=True)) if f.name not in entries]
    for i, f, result in left:
        if entry := _without_fit(reading, i, f, result):
            entries[f.name] = entry
        elif i == left[0][0] and is_result_of(learned, f):
            entries[f.name] = scan_results.fitted_entry(f, result, notes=reading.scans[i].notes)
