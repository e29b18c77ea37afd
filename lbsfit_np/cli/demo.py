"""``lbsfit demo``: a scan with known truth, fitted as a user would fit it, and compared with that truth."""

import shlex
import time
from pathlib import Path

from ..errors import InputError
from ..io.write import remove_empty
from .fit import OPTIONS, RIG_OPTIONS, TRAINING_SCANS, fit_files, load_rig_with
from .models import is_model
from .outputs import check_outputs, out_folder
from .parsing import Option, add_options, formatter, natural, positive, settings
from .progress import say
from .scan_results import remove
from .summary import SUMMARY

__all__ = ["add_parser"]

_OPTIONS = (
    Option("output", "folder to write to (required); created if needed", metavar="OUT", flag="-o"),
    Option("rig", "a bundled rig or a rig file", default="hand", metavar="RIG"),
    *RIG_OPTIONS,
    Option("seed", "seed of the scan and of the fit", natural, 0, metavar="N"),
    Option("points", "points of the scan", positive, 2500, metavar="N"),
    TRAINING_SCANS,
    Option("existing", "what to do if results already exist", default="error", choices=("error", "replace")),
)

_DESCRIPTION = """\
Make a scan of a rig, with noise, holes and uneven density, in a shape and pose that the fit does not know; fit it as
`lbsfit fit` does; print the errors against the truth; and draw a picture. This takes some 20 seconds; with a coarse
hand, a rig of your own, a card, other parts or another seed two to three minutes more, to train a segmenter. That is kept for
the next time.
"""

_EPILOG = """\
example:
  lbsfit demo -o demo
"""

_FILES = """\
In {out}:
  rig.npz          the rig
  scan.ply         the scan that was fitted: points only
  scan.fit.npz     the fit: joint angles, registered vertices, joints, labels, ...; lbsfit_np.FitResult.load reads it
  scan.mesh.ply    the registered mesh in the scan's frame
  scan.labels.ply  the scan's points with their parts and confidence
  summary.json     how the fit went, with all settings and versions
  truth.npz        the true pose, translation, template, vertices, joints and labels, under these keys
  demo.png         left to right: the scan coloured by the parts found, the true mesh, the registered mesh; two views
To fit it again, as you would fit a scan of your own: lbsfit fit {rig} {scan} -o OUT{options}"""


def add_parser(commands):
    """Add ``lbsfit demo`` to the subparsers ``commands``."""
    parser = commands.add_parser(
        "demo",
        help="fit a scan that the package makes itself",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=formatter,
    )
    add_options(parser, _OPTIONS)
    parser.set_defaults(run=_run)


def _run(arguments):
    from ..fitting.result import FitResult
    from ..io.write import write_npz, write_points_ply
    from ..report.fit_picture import fit_picture
    from ..report.render import write_png
    from ..workers import processors

    started = time.perf_counter()
    values = settings(arguments, _OPTIONS)
    if values["output"] is None:
        raise InputError("-o/--output", "nothing", "a folder to write to", "Add -o demo.")
    rig = load_rig_with(values["rig"], values, quiet=True)  # what was noted is in the file that the fit reads, which says it
    if is_model(values["rig"]):
        say(f"note: of the learned model {values['rig']}, the demo takes the rig alone; for all of it: lbsfit fit MODEL SCAN")
    out = Path(values["output"])
    paths = {
        "rig": out / "rig.npz",
        "scan": out / "scan.ply",
        "truth": out / "truth.npz",
        "picture": out / "demo.png",
    }
    chosen = {option.key: option.default for option in OPTIONS} | {
        "output": str(out), "card": "none", "seed": values["seed"], "training_scans": values["training_scans"],
        "jobs": min(2, processors()),
    }  # fmt: skip
    fits = [out / f"scan.{ending}" for ending in ("fit.npz", "mesh.ply", "labels.ply")]
    read = [values[k] for k in ("rig", "card") if values[k] not in (None, "none")]
    check_outputs([*paths.values(), *fits, out / SUMMARY], out, inputs=read, existing=values["existing"])
    folders = out_folder(out)
    truth = _scan_with_truth(rig, values)
    remove(fits)  # of an earlier demo, which would pass for this one's
    try:
        rig.save(paths["rig"])
        write_points_ply(paths["scan"], truth.points)
        write_npz(
            paths["truth"],
            pose=truth.pose, translation=truth.translation, scale=truth.scale, template=truth.template,
            template_joints=truth.template_joints, vertices=truth.vertices, joints=truth.joints, labels=truth.labels,
        )  # fmt: skip
        code = fit_files(str(paths["rig"]), [str(paths["scan"])], chosen | {"existing": "replace"})
    finally:
        if not fits[0].is_file():  # without a fit, nothing that would be in the way of the same command
            remove([*paths.values(), out / SUMMARY])
            remove_empty(folders)
            say(f"the scan was not fitted, so the demo's files in {out} are removed")
    if code > 1 or not fits[0].is_file():  # stopped, or unfitted; a fit that has failed is the one to look at
        return code
    result = FitResult.load(out / "scan.fit.npz")
    write_png(paths["picture"], fit_picture(rig, truth.points, result, truth=truth.vertices))
    say(_report(rig, truth, result))
    defaults = {option.key: option.default for option in OPTIONS}
    same = {"--training-scans": "training_scans", "--seed": "seed"}  # without which the segmenter would be trained anew
    options = "".join(f" {option} {chosen[key]}" for option, key in same.items() if chosen[key] != defaults[key])
    quoted = {name: shlex.quote(str(paths[name])) for name in ("rig", "scan")}
    say(_FILES.format(out=out, options=options, **quoted))
    say(f"{time.perf_counter() - started:.0f} s in total")
    return code


def _scan_with_truth(rig, values):
    """A scan of a changed shape, in a pose within the limits, moved away from the origin; none that training ever sees."""
    from dataclasses import replace

    from ..seeds import generator, integer_seed
    from ..synthesis import synthesize

    seed = integer_seed(values["seed"], "demo")
    truth = synthesize(rig, 1, random_state=seed, n_points=values["points"], least_holes=1)[0]
    t = rig.size * generator(seed, "demo translation").uniform(-1, 1, 3)
    return replace(truth, points=truth.points + t, translation=t, vertices=truth.vertices + t, joints=truth.joints + t)


def _report(rig, truth, result):
    """The errors, in words."""
    import numpy as np

    def mean_distance(a, b):
        return float(np.linalg.norm(a - b, axis=1).mean())

    resting = truth.points.mean(axis=0) - rig.vertices.mean(axis=0)
    moving = rig.moving
    rows = [
        ("joints", result.joints[moving], truth.joints[moving], rig.joints[moving] + resting),
        ("vertices", result.vertices, truth.vertices, rig.vertices + resting),
    ]
    lines = ["", f"Mean errors against the truth (the rig is {_length(rig.size, rig)} long):"]
    for name, found, true, rest in rows:
        error, before = mean_distance(found, true), mean_distance(rest, true)
        lines.append(
            f"  {name:<10}{_length(error, rig):>9}, {100 * error / rig.size:4.1f} % of the rig's size"
            f"   (before the fit, in the rest pose at the scan's centroid: {_length(before, rig)})"
        )
    lines.append(f"  {'labels':<10}{100 * (result.labels == truth.labels).mean():7.1f} % of the points have the right part")
    return "\n".join(lines) + "\n"


def _length(value, rig):
    if rig.metres_per_unit is None:
        return f"{value:.4g}"
    return f"{1000 * rig.metres_per_unit * value:.1f} mm"
