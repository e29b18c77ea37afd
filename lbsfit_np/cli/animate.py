"""``lbsfit animate``: fits as an animated rig that other programs open."""

import os

from ..errors import InputError, counted, listed
from ..rig.frames import AXES
from ..rig.units import METRES
from .fit import RIG_OPTIONS, load_rig_with
from .outputs import check_file
from .parsing import Option, add_options, amount, formatter, positive, settings
from .progress import say
from .sequences import order_note
from .summary import earlier_fits

__all__ = ["add_parser"]

_ROUNDING = 1e-4  # % of the rig's size

_OPTIONS = (
    Option("output", "the file to write, which must end in .glb", metavar="OUT.glb", flag="-o"),
    *RIG_OPTIONS,
    Option(
        "offsets",
        "template of the frames: the mean of all, so that bones keep their lengths, or each frame's own, as morph targets",
        default="mean",
        choices=("mean", "each"),
    ),
    Option("fps", "frames per second", amount, 30.0, metavar="N", parameter="frames_per_second"),
    Option(
        "up",
        "the scans' up axis, such as --up=+z; it becomes y, as in glTF; by default the rig's",
        choices=tuple(AXES),
    ),
    Option(
        "unit",
        "the scans' unit, as glTF lengths are metres; auto: what the fits were told, else by the rig's unit and the fits' scales",
        default="auto",
        choices=("auto", *METRES),
    ),
    Option(
        "influences",
        "at most this many joints may move a vertex; by default all that do, of which many programs show only four",
        positive,
        metavar="N",
    ),
    Option("existing", "what to do if OUT.glb already exists", default="error", choices=("error", "replace")),
)

_DESCRIPTION = """\
Write fits as one animated glTF file (.glb) with the rig's mesh, skeleton and skinning weights, and a key frame for each fit, in
the order given. Blender, game engines and viewers open it. A single fit gives the rig in its pose.
"""

_EPILOG = """\
examples:
  lbsfit fit hand scans/*.ply -o fits && lbsfit animate hand fits/*.fit.npz -o hand.glb
  lbsfit animate model.npz fits/*.fit.npz -o walk.glb --fps 60 --up=+z
  lbsfit animate body.glb fits/scan.fit.npz -o posed.glb --card body.toml --unit mm --influences 4

RIG is what the fits were made with: the rig, with the same options for reading it, or the model.
Exit code: 0 written, 2 usage, an unreadable rig or fit, or a fit of another rig; with 2, nothing is written.
"""


def add_parser(commands):
    """Add ``lbsfit animate`` to the subparsers ``commands``."""
    parser = commands.add_parser(
        "animate",
        help="write fits as an animated rig (glTF)",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=formatter,
    )
    rigs = "a rig file (.npz .glb .gltf .pkl), a bundled rig (see: lbsfit rig list), or a model written by lbsfit learn"
    parser.add_argument("rig", metavar="RIG", help=rigs)
    parser.add_argument("fits", metavar="FIT", nargs="+", help="results of lbsfit fit or learn: NAME.fit.npz")
    add_options(parser, _OPTIONS)
    parser.set_defaults(run=_run, flags=parser.get_default("flags") | {"results": "FIT"})


def _run(arguments):
    from ..fitting.result import FitResult
    from ..fitting.several import odd_scales, said_unit, stands_along, unit_of
    from ..report.animation import check_fit, write_animation

    values = settings(arguments, _OPTIONS)
    path, fits = values["output"], arguments.fits
    if path is None:
        raise InputError("-o/--output", "nothing", "the file to write", "Add -o OUT.glb.")
    if not path.lower().endswith(".glb"):
        raise InputError("-o/--output", path, "a name that ends in .glb")
    for fit in fits:
        if not fit.lower().endswith(".npz"):
            raise InputError("FIT", fit, "results written by lbsfit fit or learn: NAME.fit.npz", "For example, fits/*.fit.npz.")
    inputs = [(arguments.rig, "the rig itself"), *((fit, "one of the fits") for fit in fits)]
    check_file(path, inputs=inputs, existing=values["existing"])
    rig = load_rig_with(arguments.rig, values)
    results = []
    for fit in fits:
        results.append(FitResult.load(fit))
        check_fit(rig, results[-1], fit)
    names = _names(fits)
    said = said_unit(results, names) if values["unit"] == "auto" else None
    if note := order_note(fits):
        say(f"note: {note}")
    _say_doubtful(names, results)
    _say_earlier(names, fits)
    people = sorted({result.subject for result in results})
    odd = [names[k] for k in odd_scales(results)]
    if len(people) > 1 and values["offsets"] == "mean":
        who = listed([repr(name) if name else "no learned subject" for name in people])
        size = "" if odd else ", which has one size"
        say(f"note: the fits are of several subjects ({who}): all frames use the mean of their templates{size}")
    if axis := stands_along(rig, results, values["up"]):
        say(f"note: the fits stand along {axis}: use --up={axis} for an upright animation, unless they lie down")
    if odd:
        words = f"the scale of {listed(odd)} differs from the others' by more than people do; are all scans in one unit?"
        say(f"note: {words} Frames keep these scales.")
    away = write_animation(
        path,
        rig,
        results,
        offsets=values["offsets"],
        frames_per_second=values["fps"],
        up=values["up"],
        metres_per_unit=METRES.get(values["unit"]),
        influences=values["influences"],
    )
    if values["unit"] == "auto":
        name = unit_of(rig, results)[0]
        known = f"the scans seem to be in {name}" if name else "the scans' unit is not known, and is assumed to be metres"
        if said:
            told = sum(bool(result.unit) for result in results)
            whose = "they were" if told == len(results) else f"{told} of the {len(results)} {'was' if told == 1 else 'were'}"
            known = f"the scans are {'taken to be ' * (told < len(results))}in {name}, as specified when {whose} fitted"
        say(f"{known} (use --unit to change this)")
    say(f"{path} written: {counted(len(fits), 'frame')}{_distance(rig, results, names, away, values)}")
    return 0


def _names(fits):
    """What files of fits are called in notes: by their names alone where these tell them apart."""
    names = [os.path.basename(fit) for fit in fits]
    return names if len(set(names)) == len(names) else list(map(str, fits))


def _say_doubtful(names, results):
    """Name the fits whose poses may well be wrong: frames of them jump."""
    for status in ("failed", "suspect"):
        of = [name for name, result in zip(names, results, strict=True) if result.status == status]
        if of:
            say(f"note: {counted(len(of), 'fit')} {'has' if len(of) == 1 else 'have'} status {status}: {listed(of)}")


def _say_earlier(names, fits):
    """Name the fits that the last run in their folder could not make again: patterns name them as well."""
    places = [os.path.split(fit) for fit in fits]
    earlier = {folder: earlier_fits(folder) for folder, _ in places}
    of = [name for name, (folder, file) in zip(names, places, strict=True) if file in earlier[folder]]
    if of:
        are = "fit is" if len(of) == 1 else "fits are"
        say(f"note: {len(of)} {are} of an earlier run, as the last one could not fit the scan: {listed(of)}")


def _distance(rig, results, names, away, values):
    """In words, how far the frames are from the registered meshes, where they are not the same."""
    shares = [100 * one / (rig.size * result.scale) for one, result in zip(away, results, strict=True)]
    worst = max(range(len(shares)), key=shares.__getitem__)
    if shares[worst] < _ROUNDING:
        return ""
    mean = values["offsets"] == "mean" and values["influences"] is None and len(results) > 1
    hint = "; with --offsets each, frames are the registered meshes" if mean else ""
    return (
        f", whose vertices are {sum(shares) / len(shares):.2g} % of the rig's size away from the registered meshes on average, "
        f"at most {shares[worst]:.2g} % ({names[worst]}){hint}"
    )
