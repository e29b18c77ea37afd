"""``lbsfit fit``: fit a rig to scans from files, and write what was found."""

import functools
import time
from dataclasses import replace
from pathlib import Path

from ..errors import FileError, InputError, brief, counted, did_you_mean
from ..io.write import remove_empty
from ..rig.frames import AXES
from ..rig.units import METRES
from . import earlier_results, outputs, scan_results
from .kept_fits import left_alone
from .models import about_model, is_model, load_model, model_in_words, say_model_as_rig, subjects_of, unit_parameter
from .parsing import Option, add_options, chosen, formatter, natural, positive
from .progress import Progress, of_all, say
from .stopped_fits import named, settled
from .stopping import exit_code, terminable
from .subjects import check_no_table
from .summary import counts_of, doubts_of, say_doubtful, write_summary, written_of

__all__ = [
    *("OPTIONS", "RIG_OPTIONS", "TRAINING_SCANS", "add_parser", "check_training", "fit_files", "load_rig_with"),
    *("read_scan", "scan_options"),
]

RIG_OPTIONS = (
    Option(
        "card",
        'the rig card; by default NAME.card.toml beside a rig file NAME.glb, if it exists; "none" for no card',
        metavar="FILE",
        is_path=True,
    ),
    Option("shape", "which shape, if the rig file has several; by default the first", metavar="NAME"),
    Option("skin", "which skin, if the glTF file has several", metavar="NAME"),
    Option("normalize-weights", "divide skinning weights by their sums, however far these are from 1", bool, False),
    Option("parts", "the rig's partition that labels refer to; by default the card's or the rig's own", metavar="NAME"),
)

_TRAINING_SCANS = "synthetic scans to train the segmenter on; the library of starts gets half as many"

OPTIONS = (
    Option("output", "folder to write to (required); created if needed", metavar="OUT", flag="-o", is_path=True),
    *RIG_OPTIONS,
    Option("subject", "with a model: whose template to use; by default the one that explains the scan best", metavar="ID"),
    Option(
        "subjects",
        "a file that gives each scan's subject, as for lbsfit learn; here it may also name other scans, and a scan with an "
        "empty id gets the template that explains it best",
        metavar="FILE",
        is_path=True,
    ),
    Option("scale", "find the scan's scale, or fix it to the rig's", default="estimate", choices=("estimate", "fixed")),
    Option(
        "unit",
        "the scans' unit, if known (their size is still found); auto: not known; by default auto, or with a model the model's",
        choices=("auto", *METRES),
    ),
    Option(
        "orientation",
        "how scans may be turned: about the up axis, not at all, or in any way",
        default="upright",
        choices=("upright", "aligned", "any"),
    ),
    Option(
        "up",
        "the scans' up axis, such as --up=+z; by default the rig's, or another if that does not suit a scan",
        choices=tuple(AXES),
    ),
    Option("partial", "scans show one side only, as single depth views do", bool, False),
    Option("cropped", "scans end before the body does, as where a picture or a box ends", bool, False),
    Option("effort", "how many starts to follow, and how far", default="balanced", choices=("fast", "balanced", "thorough")),
    Option(
        "weights",
        "weights of the objective, which decides the result with --no-registration",
        default="default",
        choices=("default", "paper"),
    ),
    Option("joints", "whether joints follow the changed template", default="follow", choices=("follow", "fixed")),
    Option(
        "samples",
        "points to sample from a scan that is a mesh, or to keep from a point cloud; by default all",
        positive,
        metavar="N",
    ),
    Option("drop-invalid", "leave out points that are NaN or infinite instead of refusing the scan", bool, False),
    Option("max-points", "points of a scan that take part in the optimisation; all are labelled", positive, 2500, metavar="N"),
    Option(
        "registration",
        "bring the skin onto the scan once the pose is found; without it, pose and skin are as the objective has them",
        bool,
        True,
    ),
    Option("pictures", "also draw each fit as NAME.png", bool, False),
    Option("segmenter", "a segmenter saved by Segmenter.save, instead of the rig's own", metavar="FILE", is_path=True),
    Option(
        "training-scans",
        f"{_TRAINING_SCANS}, with --partial --cropped twice",
        positive,
        4000,
        metavar="N",
    ),
    Option(
        "training",
        "how the synthetic scans are made: a field of lbsfit_np.synthesis.Synthesis, such as noise=0.01 or one_sided=true; may "
        "be repeated",
        default={},
        metavar="NAME=VALUE",
        table=True,
        check=lambda given: check_training(given),
        refusals={"one_sided": "For scans that show one side only, set partial = true."},
    ),
    Option("seed", "seed of everything random, training included", natural, 0, metavar="N", parameter="random_state"),
    Option("jobs", "worker processes; the results do not depend on how many", positive, 1, metavar="N", parameter="n_jobs"),
    Option("existing", "what to do if results already exist", default="error", choices=("error", "skip", "replace")),
)

# For commands that know neither --partial nor --cropped.
TRAINING_SCANS = replace(next(o for o in OPTIONS if o.name == "training-scans"), help=_TRAINING_SCANS)

_DESCRIPTION = """\
Fit a rig, or a model written by `lbsfit learn`, to scans. For each scan NAME.EXTENSION, OUT gets

  NAME.fit.npz     joint angles, translation, scale, offsets, registered vertices, joints, labels (FitResult.load reads it)
  NAME.mesh.ply    the registered mesh: the rig's vertices and faces in the scan's frame and unit
  NAME.labels.ply  every point of the scan (with --samples, of the sample) with its part, the confidence, and a colour
  NAME.png         with --pictures: the scan, coloured by its parts, beside the registered mesh, from two sides

and OUT/summary.json says how each of this run's scans went. Files appear only once they are complete. Inputs are never
overwritten. If a scan cannot be fitted, files that an earlier run has left of it stay, and a message names its fit. Judge fits
by their status and probability, not by recon, the distance between scan and mesh in half sizes of the rig (the root of the
Chamfer distance): that is larger for sparse scans and coarse meshes, however right the fit is. After Ctrl-C, run the same
command with --existing skip to do the rest.

A model keeps its rig, its segmenter and how these were made, so options about the rig (--card, --shape, --skin,
--normalize-weights, --parts), --joints, --segmenter, --training-scans and --training are refused with it. --scale, --unit,
--orientation, --up, --partial, --cropped, --effort, --weights, --max-points, --registration and --seed are the model's unless you
give them. If the model was told the unit of the scans it learned from, and the new scans are in another, give --unit.
"""

_EPILOG = """\
examples:
  lbsfit fit hand scan.ply -o fits
  lbsfit fit body.glb scans/*.ply -o fits --card body.toml --jobs 4 --existing skip
  lbsfit fit body.glb scans/*.ply --config fit.toml
  lbsfit fit fox.glb kits/*.ply -o fits --unit cm --card fox.toml   # the card says what unit the rig is in
  lbsfit learn hand scans/*.ply -o model.npz && lbsfit fit model.npz new.ply -o fits
  lbsfit fit model.npz new/*.ply -o fits --subjects who.csv

  fit.toml may have any of the options above, by their long names; paths are relative to the file:
      output = "fits"
      card = "body.toml"
      jobs = 4
      drop-invalid = true
      orientation = "any"
      training = { noise = 0.01, scale = 0.2 }

The segmenter and the library of starts trained for a rig are kept in $LBSFIT_CACHE, or else in the user's cache folder; hand,
hand-left, body and body-coarse bring a segmenter for the default training and seed 0, of whole scans and of one side.
Each fit has a status: ok; suspect, if something speaks against it; or failed, if it is almost certainly wrong (its files are
still written). The summary and the table at the end put failed and suspect fits first, with what speaks against them. Fits
kept by --existing skip have the status in their files, and "kept": true in the summary.
Exit code: 0 all fitted, suspect or not, 1 some scans failed (named with reasons; the others are written), counting kept fits
that had failed, 2 usage or unreadable rig, 130 stopped by Ctrl-C, 143 by SIGTERM.
"""


def add_parser(commands):
    """Add ``lbsfit fit`` to the subparsers ``commands``."""
    parser = commands.add_parser(
        "fit", help="fit a rig to scans", description=_DESCRIPTION, epilog=_EPILOG, formatter_class=formatter
    )
    rigs = "a rig file (.npz .glb .gltf .pkl), a bundled rig (see: lbsfit rig list), or a model written by lbsfit learn"
    parser.add_argument("rig", metavar="RIG", help=rigs)
    parser.add_argument(
        "scans", metavar="SCAN", nargs="+", help="scans: .ply .obj .stl .off .xyz .pts .asc .txt .csv .pcd .npy .npz .glb .gltf"
    )
    add_options(parser, OPTIONS)
    parser.add_argument("--config", metavar="FILE", help="a TOML file with these options; the command line wins")
    parser.set_defaults(run=_run)


def _run(arguments):
    given = chosen(arguments, OPTIONS, arguments.config)
    for name, other in (("subject", "subjects"), ("subjects", "subject")):
        if hasattr(arguments, name) and not hasattr(arguments, other):
            given.pop(other, None)  # the configuration file's: the command line wins
    values = {option.key: option.default for option in OPTIONS} | given
    if values["output"] is None:
        raise InputError("-o/--output", "nothing", "a folder to write to", "Add -o OUT.")
    inputs = [arguments.config] if arguments.config else []
    return fit_files(arguments.rig, arguments.scans, values, inputs=inputs, given=given)


def load_rig_with(path, values, *, quiet=False):
    """The rig with the options of ``RIG_OPTIONS``; prints what was noted about it."""
    from ..io.rigs import load_rig

    names = ("card", "shape", "skin", "normalize_weights", "parts")
    rig = load_rig(path, **{name: values[name] for name in names})
    if not quiet:
        say_model_as_rig(path)
        _say_notes(rig)
    return rig


def check_training(given):
    """Raise InputError where ``--training`` has a name that is no field of Synthesis, or a value out of its range."""
    from ..learning.training import training_settings
    from ..synthesis import Synthesis

    known = Synthesis.__dataclass_fields__
    for name in given:
        if name not in known:
            expected = f"one of {', '.join(known)}"
            raise InputError("--training", f"{name}: an unknown setting", expected, did_you_mean(name, known))
    try:
        training_settings(given)
    except InputError as error:  # in the words of the command line and of TOML
        got = error.got.lower() if isinstance(given.get(error.got.partition(":")[0]), bool) else error.got
        raise InputError("--training", got, error.expected.replace("True or False", "true or false"), error.remedy) from None


def scan_options(values):
    """How ``load_scan`` reads scans, by the options of this command."""
    return {"n_samples": values["samples"], "random_state": values["seed"], "drop_invalid": values["drop_invalid"]}


def read_scan(path, least, options):
    """The scan at ``path``; FileError, which names it, also where points are fewer than ``least`` or cannot be used."""
    from ..io.scans import load_scan
    from ..scan import check_points
    from ..starts.scale import checked_extent

    scan = load_scan(path, **options)
    try:
        check_points(scan, minimum=least)
        checked_extent(scan.points)
    except InputError as error:
        raise FileError(str(path), error.got, error.expected, error.remedy) from None
    return scan


def fit_files(rig_path, scans, values, *, inputs=(), given=()):
    """Fit scans from files and write the results.

    Parameters
    ----------
    rig_path : str
        Of a rig or of a model.
    scans : list of str
    values : dict
        Of every option in ``OPTIONS``.
    inputs : sequence of str
        Further files that must not be overwritten.
    given : collection of str
        Keys of the options that are not just defaults; they win over what a model says.

    Returns
    -------
    int
        Exit code.
    """
    from ..learning.parameters import check_parameters

    started = time.perf_counter()
    out, scans = Path(values["output"]), earlier_results.without_results(scans)
    read = [rig_path, values["segmenter"], values["subjects"], values["card"] if values["card"] != "none" else None, *inputs]
    names = {"existing": values["existing"], "pictures": values["pictures"], "may_skip": True}
    outputs.check_sources(scans)
    a_model = is_model(rig_path) and values["subjects"] is None
    check_no_table(scans, "Give it as --subjects {}." if a_model else "Leave it out of the scans.")
    values = dict(values)  # a model changes some
    fitter, model = _fitter(rig_path, values, given)
    subjects = [None] * len(scans) if model is None else subjects_of(fitter, values, scans)
    check_parameters(fitter)  # what options got wrong is said before what is in their way, and before a folder is made
    files = outputs.plan(scans, out, inputs=[p for p in read if p], **names)
    if values["existing"] == "skip":
        files, notes = outputs.without_pictures_of_others(files)
        for note in notes:
            say(note)
    rig, subjects = fitter.rig, {f.name: subject for f, subject in zip(files, subjects, strict=True)}
    reader = functools.partial(read_scan, least=len(rig.parts), options=scan_options(values))
    entries = left_alone(files, fitter, subjects, reader) if values["existing"] == "skip" else {}
    todo = tuple(f for f in files if f.name not in entries)
    if kept := counts_of(entries)["kept"]:
        say(f"kept existing fits of {of_all(kept, len(files))}")
    folders = outputs.out_folder(out)
    before = named(todo)
    progress = Progress(len(todo))

    def on_result(outcome):
        f = todo[outcome.index]
        if outcome.error is None:
            entries[f.name] = outcome.result
        elif written := settled([f], before, notes=[outcome.error]):  # before its process was killed, say
            entries.update(written)
        else:
            entries[f.name] = scan_results.unfitted_entry(f, outcome.error, seconds=round(outcome.seconds, 3))
            if outcome.details:
                entries[f.name]["details"] = outcome.details
        progress.notes(f.name, entries[f.name].get("notes", ()))
        progress.scan(entries[f.name])

    stopped = None
    try:
        with terminable():
            _fit(fitter, todo, subjects, values, on_result, progress)
    except BaseException as reason:  # noqa: BLE001 (raised again below, once the summary is safe)
        stopped = reason
        entries |= settled([f for f in todo if f.name not in entries], before)
    finally:
        progress.close()
    counts = counts_of(entries) | {"written": written_of(entries)}
    if entries:
        facts = {"started": started, "stopped": stopped is not None, "model": model}
        write_summary(out, rig_path, rig, files, entries, values, **facts)
    remove_empty(folders)
    if stopped is not None and not isinstance(stopped, KeyboardInterrupt):
        raise stopped
    say_doubtful([entries[f.name] for f in files if f.name in entries])
    undone = [f for f in files if "files" not in entries.get(f.name, {})] if values["existing"] == "replace" else []
    older = [f for f in undone if f.fit.is_file()]
    return _farewell(counts, len(files), out, stopped, len(older))


def _fitter(rig_path, values, given):
    """The fitter, and what the summary says about the model; None of a rig."""
    if is_model(rig_path):
        fitter = load_model(rig_path, values, given)
        _say_notes(fitter.rig)
        model = about_model(rig_path) | {"subject": values["subject"]}
        say(f"{rig_path} is {model_in_words(model)}")
        return fitter, model
    from ..learning.fitter import LBSFitter

    rig = load_rig_with(rig_path, values)
    for name in ("subject", "subjects"):
        if values[name] is not None:
            raise InputError(
                f"--{name}",
                f"{brief(values[name])} with {rig_path}, which is a rig",
                "a model written by lbsfit learn, which knows subjects",
                "Leave it out, or give a model instead of the rig.",
            )
    check_training(values["training"])
    fitter = LBSFitter(
        rig,
        weights=values["weights"],
        joints=values["joints"],
        scale=values["scale"],
        unit=unit_parameter(values),
        orientation=values["orientation"],
        up=values["up"],
        partial=values["partial"],
        cropped=values["cropped"],
        effort=values["effort"],
        max_points=values["max_points"],
        registration=values["registration"],
        training_scans=values["training_scans"],
        training=values["training"],
        n_jobs=values["jobs"],
        random_state=values["seed"],
    )
    if values["segmenter"] is not None:
        from ..segmentation.segmenter import Segmenter

        segmenter = Segmenter.load(values["segmenter"])
        segmenter.check_rig(rig)
        fitter.segmenter_ = segmenter
    return fitter, None


def _fit(fitter, todo, subjects, values, on_result, progress):
    from ..learning.batch import fit_scans

    segmenter = getattr(fitter, "segmenter_", None)

    def pretrain(fitter):
        fitter.pretrain(segmenter=segmenter, cache=True, progress=progress.training)
        progress.fitting()

    if todo and getattr(fitter, "template_", None) is not None:  # nothing is trained for what was learned
        progress.fitting()
    fit_scans(
        fitter,
        [functools.partial(read_scan, f.source, len(fitter.rig.parts), scan_options(values)) for f in todo],
        subjects=[subjects[f.name] for f in todo],
        n_jobs=values["jobs"],
        finish=scan_results.Writer(fitter.rig, todo),
        on_result=on_result,
        pretrain=pretrain,
    )


def _farewell(counts, n, out, stopped, older):
    """Say how it ended; ``older``: of the scans that this run has not fitted, how many have fits of an earlier one."""
    done = counts["written"]
    if stopped is not None:
        kept, rest = f"stopped: {of_all(done, n)} {_are(done)} fitted and kept in {out}", ""
        if not done:
            kept = "stopped before any scan was fitted; run the same command to start again"
        elif not older:
            rest = "; run the same command with --existing skip to continue"
        if older:  # which would be skipped
            whose = f"{older} of the others" if done else counted(older, "scan")
            have = "has a fit" if older == 1 else "have fits"
            rest = f"; {whose} {have} from an earlier run, which --existing skip would keep"
        say(kept + rest)
        return exit_code(stopped)
    kept = f", {counts['kept']} of them kept from earlier runs" if counts["kept"] else ""
    say(f"{of_all(done, n)} fitted{doubts_of(counts)}{kept}; results in {out}")
    return 1 if counts["failed"] else 0


def _are(n):
    return "is" if n == 1 else "are"


def _say_notes(rig):
    for note in rig.notes:
        say(f"note: {rig.name}: {note}")
