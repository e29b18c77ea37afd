"""``lbsfit bench faust``: the MPI-FAUST data set, for people who have it."""

import functools
from pathlib import Path

from ..errors import counted
from . import pair_runs
from .parsing import Option, positive
from .progress import say

__all__ = ["add_parser"]

_OWN = (Option("scans", "use only the first N scans of each subject, to try it out", positive, metavar="N"),)

_DESCRIPTION = """\
Learn from the training scans of MPI-FAUST, then fit them and the test scans. Print the error of correspondences between
training scans, whose registrations give the truth, beside the paper's table: for pairs of one subject (intra) and of different
ones (inter), in cm, with percentiles, before and after the snap onto the nearest point of the other scan.

DIR is the folder MPI-FAUST as published, or the folder that it is in: training/scans, training/registrations,
training/ground_truth_vertices, test/scans, test/challenge_pairs. Anything missing is named, and left out where the rest still
makes sense. The data set does not come with this package, as its licence forbids it: see http://faust.is.tue.mpg.de.
"""

_EPILOG = """\
examples:
  lbsfit bench faust MPI-FAUST --scans 2 -o faust-try --jobs 2
  lbsfit bench faust MPI-FAUST -o faust --jobs 2

OUT gets results.json (every figure of every pair, settings, versions), gallery.png, fits/NAME.npz for each scan, and model.npz,
which lbsfit fit takes. For each challenge whose pairs are listed it also gets challenge-intra/ or challenge-inter/, with a file
for each pair (012_023.txt: for each vertex of test_scan_012 its point on test_scan_023), and challenge-intra.zip or
challenge-inter.zip to submit. Run the same command again to do what is missing; what an interrupted loop has done is in
model.npz.unfinished.
"""


def add_parser(benches):
    """Add ``lbsfit bench faust`` to the subparsers ``benches``."""
    pair_runs.add_command(
        benches,
        "faust",
        _run,
        _OWN,
        help="the MPI-FAUST data set, for people who have it",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        argument={"metavar": "DIR", "help": "MPI-FAUST, or the folder that it is in"},
        samples=20_000,
    )


def _run(folder, values):
    from ..bench.faust import challenge_files, challenge_left, faust_bench, faust_table, read_faust
    from ..io.write import write_json

    found = read_faust(folder, most=values["scans"], learn=values["learn"])
    fitter = pair_runs.fitter_of(values)
    scans = [*found.training, *found.test]
    more = [file for archive, files in challenge_files(Path(values["output"]), found).values() for file in (archive, *files)]
    out = pair_runs.made_output(values, [s.name for s in scans], inputs=[*(s.path for s in scans), *found.files], more=more)
    people = len({s.subject for s in found.training})
    training, test = counted(len(found.training), "training scan"), counted(len(found.test), "test scan")
    say(f"{training} of {counted(people, 'subject')}, {test}")
    for note in found.notes:
        say(f"note: {note}")

    def work(progress):
        on_figures = functools.partial(write_json, out / pair_runs.RESULTS)
        options = pair_runs.bench_keywords(values, out, fitter, challenge_left(out)) | {"reporter": progress}
        report, fits = faust_bench(fitter, found, out, on_figures=on_figures, **options)
        words = [faust_table(report, markdown=values["markdown"])]
        words += [_written(kind, written) for kind, written in report["challenge"].items()]
        return pair_runs.finished(out, report, "\n".join(words), fitter.rig, scans, fits, values)

    return pair_runs.run_stoppable(work, values, out)


def _written(kind, written):
    n, missing = written["written"], written["missing"]
    words = f"{kind}-subject challenge: {counted(n, 'file')} in challenge-{kind}"
    if missing:
        words += f", {counted(missing, 'pair')} missing because a scan has no fit"
    return words + (f"; to submit: {written['archive']}" if written["archive"] else "; no archive, as it would be incomplete")
