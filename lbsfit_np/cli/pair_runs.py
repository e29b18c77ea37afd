"""What ``lbsfit bench pairs``, ``people`` and ``faust`` share: options, the fitter, what is written, what people are told."""

import functools
import time
from pathlib import Path

from ..errors import InputError, LbsfitError, counted
from ..io.write import without_empty
from .bench_runs import RESULTS, failures_code
from .fit import OPTIONS as FIT_OPTIONS
from .fit import RIG_OPTIONS, load_rig_with
from .learn import OPTIONS as LEARN_OPTIONS
from .outputs import check_outputs, out_folder
from .parsing import Option, add_options, formatter, natural, positive, settings
from .progress import SILENCE, LearningProgress, Progress, bar, say
from .stopping import exit_code, say_steps, terminable

__all__ = [
    *("GALLERY", "RESULTS", "RIG", "PairsProgress", "add_command"),
    *("bench_keywords", "finished", "fitter_of", "made_output", "run_stoppable"),
]

GALLERY = "gallery.png"

_OUTPUT = Option("output", "folder to write to; created if needed", metavar="OUT", flag="-o")
RIG = Option("rig", "a rig file or a bundled rig; see: lbsfit rig list", default="body", metavar="RIG")

# Options of the fits that mean the same as in lbsfit fit and lbsfit learn, and are part of what fits are kept by.
_OF_FITS = ("scale", "orientation", "up", "partial", "cropped", "effort", "max-points", "registration", "training-scans", "seed")
_OF_LEARNING = ("rounds", "held-out")


_EXIT_CODES = """\
Exit code: 0 all fitted, 1 some scans could not be fitted (their pairs are missing) or their fits have the status failed (their
pairs count), 2 usage or unreadable data, 130 stopped by Ctrl-C, 143 by SIGTERM.
"""


def add_command(benches, name, run, own, *, help, description, epilog, argument, rig=RIG, samples=None):
    """Add a benchmark of correspondences.

    Parameters
    ----------
    benches : subparsers of ``lbsfit bench``
    name : str
    run : callable (argument, values) → exit code
    own : sequence of Option
        Those that the others do not have.
    help, description, epilog : str
        The epilog without the exit codes.
    argument : dict
        The positional one, as for ``argparse``.
    rig : Option, optional
        Which one is fitted.
    samples : int, optional
        Points of a scan for its fit, by default.
    """
    options = (_OUTPUT, rig, *own, *_fitting_options(samples), *_MEASURING)
    bench = benches.add_parser(
        name, help=help, description=description, epilog=epilog + _EXIT_CODES, formatter_class=formatter
    )
    bench.add_argument("what", **argument)
    add_options(bench, options)

    def checked(arguments):
        values = settings(arguments, options)
        if values["output"] is None:
            raise InputError("-o/--output", "nothing", "a folder", "Add -o OUT.")
        for option in () if values["learn"] else (o for o in LEARN_OPTIONS if o.name in _OF_LEARNING):
            if values[option.key] != option.default:
                given, expected = f"{values[option.key]} with --no-learn", f"--{option.name} only where the loop learns"
                raise InputError(f"--{option.name}", given, expected, "Leave one of the two out.")
        with without_empty(Path(values["output"]) / "fits"):  # nothing of a run that was refused
            return run(arguments.what, values)

    bench.set_defaults(run=checked)


def _fitting_options(samples):
    words = "points to sample from a scan that is a mesh, or to keep from a point cloud, for its fit"
    words += "; by default all" if samples is None else ""
    return (
        Option("learn", "first learn from the scans, with the loop; otherwise fit each by itself", bool, True),
        *(o for o in LEARN_OPTIONS if o.name in _OF_LEARNING),
        *RIG_OPTIONS,
        *(o for o in FIT_OPTIONS if o.name in _OF_FITS),
        Option("samples", words, positive, samples, metavar="N"),
        next(o for o in FIT_OPTIONS if o.name == "jobs"),
    )


_MEASURING = (
    Option("pairs", "pairs of each kind, at most; chosen at random if there are more", positive, 500, metavar="N"),
    Option("points", "points of a scan to follow, at most; chosen at random", positive, 5000, metavar="N"),
    Option("pictures", "fits to show in the gallery, from worst to best", natural, 5, metavar="K"),
    Option("markdown", "print the table as Markdown", bool, False),
    Option("existing", "what to do with existing fits of the same settings", default="resume", choices=("resume", "replace")),
)


def fitter_of(values):
    """The fitter, by the values of the options; told the scans' unit where that is given and the rig's own is known."""
    from ..learning.fitter import LBSFitter

    rig = load_rig_with(values["rig"], values)
    names = [name.replace("-", "_") for name in (*_OF_FITS, *_OF_LEARNING) if name != "seed"]
    given = {name: values[name] for name in names} | {"n_jobs": values["jobs"], "random_state": values["seed"]}
    told = values.get("unit", "auto") != "auto" and rig.metres_per_unit is not None
    return LBSFitter(rig, **given, unit=values["unit"] if told else None)


def bench_keywords(values, out, fitter, more=()):
    """Keywords of ``pairs_bench`` and ``faust_bench``, by the options' values; ``more`` files in ``out`` are made of fits."""
    return {
        "learn": values["learn"],
        "most_pairs": values["pairs"],
        "points": values["points"],
        "seed": values["seed"],
        "settings": _fit_settings(values) | {"unit": fitter.unit},
        "existing": values["existing"],
        "made_of_fits": (out / RESULTS, out / GALLERY, *more),
        "n_samples": values["samples"],
        "jobs": values["jobs"],
    }


def _fit_settings(values):
    """What fits depend on, beside rig and scans."""
    names = [name.replace("-", "_") for name in (*_OF_FITS, *_OF_LEARNING, "learn", "samples")]
    return {name: values[name] for name in names if values["learn"] or name not in ("rounds", "held_out")}


def made_output(values, names, inputs, more=()):
    """The folder to write to, made, once it is known that neither what is read nor what others have made is replaced there.

    Parameters
    ----------
    values : dict
        Of the options.
    names : iterable of str
        Of the scans.
    inputs : iterable of path-like
        What is read beside the rig and its card.
    more : iterable of Path
        What is written beside results and fits.

    Returns
    -------
    Path
    """
    from ..bench.pair_fits import fit_files, has_record

    out = Path(values["output"])
    read = [*inputs, *(values[k] for k in ("rig", "card") if values[k] and values[k] != "none")]
    written = [out / RESULTS, out / GALLERY, *fit_files(out, names), *more]
    # What this benchmark has left may be gone on with, or replaced; what somebody else has, only where people say so.
    replaced = values["existing"] == "replace" or has_record(out)
    check_outputs(written, out, inputs=read, existing="replace" if replaced else "error")
    out_folder(out)
    return out


# ---- what a run writes and says at its end ----


def finished(out, report, words, rig, scans, fits, values):
    """Write the results, print them, then draw the gallery: a picture that cannot be drawn loses no figure.

    Parameters
    ----------
    out : Path
    report : dict
        Gets "gallery": names of the fits that it shows, from top to bottom.
    words : str
        The table and what else is to be printed.
    rig : Rig
    scans : list of PairScan
    fits : Fits
    values : dict
        Of the options.

    Returns
    -------
    int
        The exit code.
    """
    from ..io.write import write_json

    report["rig"] |= {"file": values["rig"]} | {key: values[key] for key in (o.key for o in RIG_OPTIONS) if values[key]}
    (out / GALLERY).unlink(missing_ok=True)  # of an earlier run
    report["gallery"] = []
    write_json(out / RESULTS, report)
    say("")
    say(words)
    report["gallery"] = _draw_gallery(out, rig, scans, fits, values)
    say("")
    if report["gallery"]:
        write_json(out / RESULTS, report)
        say(f"{GALLERY}, from top to bottom: {', '.join(report['gallery'])}")
    say(f"results in {out}")
    return failures_code(fits.failures())


def _draw_gallery(out, rig, scans, fits, values):
    """Draw the gallery; returns the names of the fits that it shows, from top to bottom."""
    from ..bench.pair_pictures import gallery, gallery_of
    from ..io.scans import load_scan
    from ..report.render import write_png

    paths = {s.name: s.path for s in scans}
    load = functools.partial(load_scan, n_samples=values["samples"], random_state=values["seed"])
    shown = {}
    for name in gallery_of(fits, values["pictures"]):
        try:
            shown[name] = load(paths[name]).points, fits.load(name)
        except LbsfitError:  # it was there when it was fitted
            continue
    if shown:
        write_png(out / GALLERY, gallery(rig, shown.values()))
    return list(shown)


# ---- while it runs ----


def run_stoppable(work, values, out):
    """``work(progress)`` → its exit code; Ctrl-C and SIGTERM leave what is finished, and say so."""
    from ..bench.pair_fits import checkpoint_in
    from ..learning.checkpoint import steps_in

    progress = PairsProgress(values["rounds"])
    if values["existing"] == "resume":
        say_steps(checkpoint_in(out))
    try:
        with terminable():
            return work(progress)
    except KeyboardInterrupt as stop:
        progress.close()
        n, steps = len(list((out / "fits").glob("*.npz"))), checkpoint_in(out)
        again = "run the same command" + (" without --existing replace" if values["existing"] == "replace" else "")
        if n:
            say(f"stopped: {n} fit{' is' if n == 1 else 's are'} kept in {out}; {again} to continue")
        else:
            rest = f"; {again} to continue from the steps kept in {steps}" if steps_in(steps) else ""
            say(f"stopped before any scan was fitted{rest}")
        return exit_code(stop)
    finally:
        progress.close()


class PairsProgress(Progress):
    """Learning, training and fits as in other commands; pairs as a bar on a terminal, a line now and then elsewhere.

    Parameters
    ----------
    rounds : int
        Of learning, at most.
    terminal : bool, optional
        As for ``Progress``.
    clock : callable, optional
        Seconds, for tests.
    """

    def __init__(self, rounds, terminal=None, clock=time.monotonic):
        super().__init__(0, terminal)
        self._learning = LearningProgress(rounds, self.terminal)
        self._clock, self._told = clock, None

    def learning(self, stage, share, figures=None):
        """What the loop does, see ``LBSFitter.fit``."""
        self._learning(stage, share, figures)

    def kept(self, n):
        """So many fits are there already."""
        self.line(f"kept existing fits of {counted(n, 'scan')}")

    def fitted(self, name, entry, total):
        """One of so many scans is done."""
        self._learning.close()
        self.total = total
        if "failed" in entry:
            entry = {"status": "failed", "message": entry["failed"]}
        else:
            entry = entry | {"terms": {"recon": entry["recon"]}}
        self.scan({"name": name, **entry})
        if self.done == total:
            self.close()
            self.done = 0

    def noted(self, words):
        """Something that people should know of the figures."""
        self._learning.close()
        self.line(f"note: {words}")

    def measured(self, done, total):
        """So many pairs are measured; at first none."""
        self._pairs("measuring errors", done, total)

    def written(self, done, total):
        """So many pairs of the challenge are written; at first none."""
        self._pairs("writing the challenge files", done, total)

    def _pairs(self, doing, done, total):
        self._learning.close()
        if not self.terminal:
            if not done:
                say(f"{doing}: {counted(total, 'pair')}")
                self._told = self._clock()
            elif done < total and self._clock() - self._told >= SILENCE:
                say(f"{doing}: {done} of {total} pairs")
                self._told = self._clock()
            return
        if self._bar is None:
            self._bar = bar(total=total, desc=doing, unit="pair", leave=False)
        self._bar.update(done - self._bar.n)
        if done == total:
            self.close()

    def close(self):
        """Leave the terminal in order."""
        self._learning.close()
        super().close()
