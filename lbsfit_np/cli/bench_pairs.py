"""``lbsfit bench pairs``: correspondence between scans of one's own whose truth is known."""

import functools
from pathlib import Path

from ..bench.truth_file import TRUTH_FILES
from ..errors import InputError, LbsfitError
from .bench_runs import RESULTS
from .fit import OPTIONS as FIT_OPTIONS
from .fit import RIG_OPTIONS, load_rig_with
from .learn import OPTIONS as LEARN_OPTIONS
from .outputs import check_outputs, make_folder
from .parsing import Option, add_options, formatter, natural, positive, settings
from .progress import LearningProgress, Progress, say
from .stopping import exit_code, terminable

__all__ = [
    "GALLERY",
    "MEASURING",
    "RESULTS",
    "PairsProgress",
    "add_parser",
    "draw_gallery",
    "fit_settings",
    "fitter_of",
    "fitting_options",
    "made_output",
    "need_output",
    "run_stoppable",
    "say_failures",
]

GALLERY = "gallery.png"

# Options of the fits that mean the same as in lbsfit fit and lbsfit learn, and are part of what fits are kept by.
_OF_FITS = ("scale", "orientation", "up", "partial", "effort", "max-points", "training-scans", "seed")
_OF_LEARNING = ("rounds", "held-out")


def fitting_options(samples=None):
    """Options of the rig and of the fits; ``samples``: points of a scan for its fit, by default."""
    words = "points to sample from a scan that is a mesh, or to keep of a cloud, for its fit"
    words += "; by default all" if samples is None else ""
    return (
        Option("learn", "learn from the scans first, by the loop; else each is fitted by itself", bool, True),
        *(o for o in LEARN_OPTIONS if o.name in _OF_LEARNING),
        *RIG_OPTIONS,
        *(o for o in FIT_OPTIONS if o.name in _OF_FITS),
        Option("samples", words, positive, samples, metavar="N"),
        next(o for o in FIT_OPTIONS if o.name == "jobs"),
    )


MEASURING = (
    Option("pairs", "pairs of each kind, at most; a random choice where there are more", positive, 500, metavar="N"),
    Option("points", "points of a scan to follow, at most; a random choice", positive, 5000, metavar="N"),
    Option("pictures", "fits to show in the gallery, from the worst to the best", natural, 5, metavar="K"),
    Option("markdown", "print the table as Markdown", bool, False),
    Option("existing", "what to do with fits of the same settings", default="resume", choices=("resume", "replace")),
)

_OPTIONS = (
    Option("output", "folder to write to; made if need be", metavar="OUT", flag="-o"),
    Option("truth", "the table of scans, subjects and what corresponds", metavar="FILE"),
    Option("rig", "a rig file, or a bundled rig, see: lbsfit rig list", default="body", metavar="RIG"),
    Option("subject-column", "the column of FILE that says who was scanned", default="subject", metavar="NAME"),
    Option("unit", "the scans'; auto: what the scale of the fits says", default="auto", choices=("auto", "m", "cm", "mm", "in")),
    *fitting_options(),
    *MEASURING,
)

_DESCRIPTION = f"""\
Fit a rig to the scans in DIR and measure, for pairs of scans, how far each place is from where the truth has it: mean, median,
90th and 95th percentile, for pairs of one subject (intra) and of different ones (inter), before and after the snap onto the
nearest point of the other scan; in the scans' unit, and in cm where the unit is known.

{TRUTH_FILES}
"""

_EPILOG = """\
examples:
  lbsfit bench pairs animals --truth animals/truth.csv --rig horse.glb -o bench-animals --jobs 2
  lbsfit bench pairs scans --truth landmarks.csv --no-learn --subject-column person -o bench-scans

OUT gets results.json (every figure of every pair, settings, versions), gallery.png, fits/NAME.npz for each scan, and, after
learning, model.npz, which lbsfit fit takes. The same command once more does what is not there yet; what an interrupted loop has
learned is not kept. Scans are fitted as their subject's: the column is part of what learning is told.
Exit code: 0 all fitted, 1 some scans could not be fitted (their pairs are missing) or their fits say that they failed (their
pairs count), 2 usage or unreadable data, 130 stopped by Ctrl-C.
"""


def add_parser(benches):
    """Add ``lbsfit bench pairs`` to the subparsers ``benches``."""
    bench = benches.add_parser(
        "pairs",
        help="correspondence between scans of your own whose truth is known",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=formatter,
    )
    bench.add_argument("folder", metavar="DIR", help="where the scans are, in any format that lbsfit fit reads")
    add_options(bench, _OPTIONS)
    bench.set_defaults(run=lambda arguments: _run(arguments.folder, settings(arguments, _OPTIONS)))


def _run(folder, values):
    from ..bench.pairs import pairs_bench, pairs_table
    from ..bench.truth_file import read_truth
    from ..io.write import write_json

    need_output(values)
    if values["truth"] is None:
        raise InputError("--truth", "nothing", "a table of scans and what corresponds", "Add --truth FILE.")
    scans, truth, notes = read_truth(values["truth"], folder, subject_column=values["subject_column"])
    fitter = fitter_of(values)
    out = made_output(values, scans, inputs=[values["truth"]])
    for note in notes:
        say(f"note: {note}")

    def work(progress):
        report, fits = pairs_bench(
            fitter,
            scans,
            truth,
            out,
            learn=values["learn"],
            most_pairs=values["pairs"],
            points=values["points"],
            seed=values["seed"],
            unit=values["unit"],
            settings=fit_settings(values),
            existing=values["existing"],
            n_samples=values["samples"],
            jobs=values["jobs"],
            reporter=progress,
        )
        report["notes"] = notes
        report["gallery"] = draw_gallery(out, fitter.rig, scans, fits, values)
        write_json(out / RESULTS, report)
        say("")
        say(pairs_table(report, markdown=values["markdown"]))
        say(f"\nresults in {out}")
        return say_failures(fits)

    return run_stoppable(work, values, out)


# ---- what the benchmarks of pairs share ----


def need_output(values):
    """Raise where no folder to write to is given."""
    if values["output"] is None:
        raise InputError("-o/--output", "nothing", "a folder", "Add -o OUT.")


def fitter_of(values):
    """The fitter, by the values of ``fitting_options``."""
    from ..learning.fitter import LBSFitter

    rig = load_rig_with(values["rig"], values)
    names = [name.replace("-", "_") for name in (*_OF_FITS, *_OF_LEARNING) if name != "seed"]
    return LBSFitter(rig, **{name: values[name] for name in names}, n_jobs=values["jobs"], random_state=values["seed"])


def fit_settings(values):
    """What fits depend on, beside rig and scans."""
    names = [name.replace("-", "_") for name in (*_OF_FITS, *_OF_LEARNING, "learn", "samples")]
    return {name: values[name] for name in names if values["learn"] or name not in ("rounds", "held_out")}


def made_output(values, scans, inputs, more=()):
    """The folder to write to, made, once it is known that nothing that is read is written there."""
    from ..bench.pair_fits import fit_files

    out = Path(values["output"])
    read = [*(s.path for s in scans), *inputs, *(values[k] for k in ("rig", "card") if values[k] and values[k] != "none")]
    written = [out / RESULTS, out / GALLERY, *fit_files(out, scans), *more]
    check_outputs(written, out, inputs=read, existing="replace")
    make_folder(out)
    return out


def draw_gallery(out, rig, scans, fits, values):
    """Draw the gallery; returns the names of the fits that it shows, from top to bottom."""
    from ..bench.pair_pictures import gallery, gallery_of
    from ..io.scans import load_scan
    from ..report.render import write_png

    paths = {s.name: s.path for s in scans}
    load = functools.partial(load_scan, n_samples=values["samples"], random_state=values["seed"])
    names, shown = gallery_of(fits, values["pictures"]), []
    for name in names:
        try:
            shown.append((load(paths[name]).points, fits.load(name)))
        except LbsfitError:  # it was there when it was fitted
            continue
    if shown:
        write_png(out / GALLERY, gallery(rig, shown))
    return names


def say_failures(fits):
    """Print which scans have no fit, and whose fits say that they failed; the exit code."""
    code = 0
    for name, why in fits.failures():
        say(f"failed: {name}: {why}")
        code = 1
    return code


def run_stoppable(work, values, out):
    """``work(progress)`` → its exit code; Ctrl-C and SIGTERM leave what is finished, and say so."""
    progress = PairsProgress(values["rounds"])
    try:
        with terminable():
            return work(progress)
    except KeyboardInterrupt as stop:
        progress.close()
        n = len(list((out / "fits").glob("*.npz")))
        rest = f"{n} fits are kept in {out}; the same command once more does the rest"
        say(f"stopped: {rest}" if n else "stopped before a scan was fitted")
        return exit_code(stop)
    finally:
        progress.close()


class PairsProgress(Progress):
    """Learning, training and fits as in other commands; pairs as a bar on a terminal."""

    def __init__(self, rounds, terminal=None):
        super().__init__(0, terminal)
        self._learning = LearningProgress(rounds, self.terminal)

    def learning(self, stage, share, figures=None):
        """What the loop does, see ``LBSFitter.fit``."""
        self._learning(stage, share, figures)

    def kept(self, n):
        """So many fits are there already."""
        self.line(f"{n} scan{' is' if n == 1 else 's are'} fitted already and kept")

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

    def measured(self, done, total):
        """So many pairs are measured."""
        self._learning.close()
        if not self.terminal:
            return
        if self._bar is None:
            import sys

            from tqdm import tqdm

            self._bar = tqdm(total=total, desc="pairs", unit="pair", leave=False, file=sys.stderr)
        self._bar.update(done - self._bar.n)
        if done == total:
            self.close()

    def close(self):
        """Leave the terminal in order."""
        self._learning.close()
        super().close()
