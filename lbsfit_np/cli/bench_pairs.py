"""``lbsfit bench pairs``: correspondence between scans of one's own whose truth is known."""

from pathlib import Path

from ..bench.truth_file import TRUTH_FILES
from ..errors import InputError
from ..rig.units import METRES
from . import pair_runs
from .parsing import Option
from .progress import say

__all__ = ["add_parser"]

_OWN = (
    Option("truth", "the table of scans, subjects and what corresponds", metavar="FILE"),
    Option("subject-column", "the column of FILE that says who was scanned", default="subject", metavar="NAME"),
    Option(
        "unit",
        "the scans' unit, which fits are told, too, if the rig's own is known; auto: what the scale of the fits says",
        default="auto",
        choices=("auto", *METRES),
    ),
)

_DESCRIPTION = f"""\
Fit a rig to the scans in DIR and measure, for pairs of scans, how far each place of one lands from its true place on the other:
mean, median, 90th and 95th percentile, for pairs of one subject (intra) and of different ones (inter), before and after the
snap onto the nearest point of the other scan. Lengths are in the scans' unit, and in cm where the unit is known.

{TRUTH_FILES}
"""

_EPILOG = """\
examples:
  lbsfit bench pairs animals --truth animals/truth.csv --rig horse.glb -o bench-animals --jobs 2
  lbsfit bench pairs scans --truth landmarks.csv --no-learn --subject-column person -o bench-scans

OUT gets results.json (every figure of every pair, settings, versions), gallery.png, fits/NAME.npz for each scan with fits.json,
which says what they were made of, and, after learning, model.npz, which lbsfit fit takes. First a segmenter is trained for the
rig, once, unless it comes with one: two to three minutes, less with fewer --training-scans. Run the same command again to do what
is missing; what an interrupted loop has done is in model.npz.unfinished. Each scan is fitted as its subject's: the subject column
is part of what learning is told.
"""


def add_parser(benches):
    """Add ``lbsfit bench pairs`` to the subparsers ``benches``."""
    pair_runs.add_command(
        benches,
        "pairs",
        _run,
        _OWN,
        help="correspondence between your own scans, where the truth is known",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        argument={"metavar": "DIR", "help": "folder of the scans, in any format that lbsfit fit reads"},
    )


def _run(folder, values):
    from ..bench.pairs import pairs_bench, pairs_table
    from ..bench.subjects import files_digest
    from ..bench.truth_file import read_truth

    if values["truth"] is None:
        raise InputError("--truth", "nothing", "a table of scans and what corresponds", "Add --truth FILE.")
    column = values["subject_column"]
    scans, truth, notes = read_truth(values["truth"], folder, subject_column=column, output=values["output"])
    fitter, digest = pair_runs.fitter_of(values), files_digest([Path(values["truth"])])
    read = [*(s.path for s in scans), values["truth"], *getattr(truth, "files", ())]
    out = pair_runs.made_output(values, [s.name for s in scans], inputs=read)
    for note in notes:
        say(f"note: {note}")

    def work(progress):
        options = pair_runs.bench_keywords(values, out, fitter) | {"unit": values["unit"], "reporter": progress}
        report, fits = pairs_bench(fitter, scans, truth, out, **options)
        report |= {"notes": notes + report["notes"], "folder": str(folder), "subject_column": column}
        report["truth_file"] = {"path": str(values["truth"]), "sha256": digest}
        return pair_runs.finished(out, report, pairs_table(report, markdown=values["markdown"]), fitter.rig, scans, fits, values)

    return pair_runs.run_stoppable(work, values, out)
