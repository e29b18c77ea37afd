"""``lbsfit bench people``: correspondence between scans of people whom the rig is not of."""

from dataclasses import replace
from pathlib import Path

from ..errors import InputError
from . import pair_runs
from .bench_runs import checked_data
from .outputs import check_outputs
from .parsing import Option, natural, positive
from .progress import say

__all__ = ["add_parser"]

_RIG = replace(pair_runs.RIG, help="the rig to fit, a file or a bundled one; by default hand-left or body", default=None)
_OWN = (
    Option("data", "the folder of real rigs, poses and motion", metavar="DIR"),
    Option(
        "people",
        "how many, at least two; the first hand is the rig of DIR, the first three bodies its shapes",
        positive,
        6,
        metavar="N",
    ),
    Option("scans", "scans of each person", positive, 5, metavar="N"),
    Option("scan-seed", "seed of people, poses and scans; --seed is for training and fits", natural, 600, metavar="N"),
)

_DESCRIPTION = """\
Make scans of people of DIR/webxr_hand near the poses of DIR/hand_poses, or of DIR/mpfb2_body in poses from DIR/motion, with all
joints of every second scan also turned at random. Fit a rig with another mesh and other joints to them, and measure how far
each place of a scan lands from its true place on another scan: for pairs of one person (intra) and of different ones (inter),
in cm. This stands in for registered scans of real people, with exact truth.
"""

_EPILOG = """\
examples:
  lbsfit bench people body --data rigs -o bench-people --jobs 2
  lbsfit bench people hand --data rigs --no-learn -o bench-hands

OUT gets people.json, the scans (scans/), the true meshes (registrations/) and truth.csv, which make a folder for
lbsfit bench pairs OUT/scans --truth OUT/truth.csv; and what that writes: results.json, gallery.png, fits/NAME.npz and model.npz.
Run the same command again to do what is missing.
"""


def add_parser(benches):
    """Add ``lbsfit bench people`` to the subparsers ``benches``."""
    pair_runs.add_command(
        benches,
        "people",
        _run,
        _OWN,
        help="correspondence between scans of people other than the rig's",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        argument={"choices": ("hand", "body"), "metavar": "{hand,body}", "help": "whom to scan"},
        rig=_RIG,
    )


def _run(kind, values):
    from ..bench.pair_fits import fit_files
    from ..bench.pairs import pairs_bench, pairs_table
    from ..bench.people import OTHER_RIGS, SCANS, people_before, people_files, people_names, people_scans, write_people
    from ..bench.truth_file import read_truth

    checked_data(kind, values)
    values["rig"] = values["rig"] or OTHER_RIGS[kind]
    whose, out = {"kind": kind, **{k: values[k] for k in ("people", "scans", "scan_seed")}}, Path(values["output"])
    before, resumes = people_before(out), values["existing"] == "resume"
    files = {*people_files(out, whose), *(() if before is None else people_files(out, before))}
    read = [values[k] for k in ("rig", "card") if values[k] and values[k] != "none"]
    check_outputs(sorted(files), out, inputs=read, existing="error" if before is None and resumes else "replace")
    if resumes and before not in (None, whose):
        remedy = "Choose another folder, or --existing replace."
        raise InputError("-o", f"{out}, which has scans of {_in_words(before)}", f"scans of {_in_words(whose)}", remedy)
    names = people_names(values["people"], values["scans"])
    made, faces = people_scans(
        kind, values["data"], n_people=values["people"], n_scans=values["scans"], seed=values["scan_seed"]
    )
    fitter = pair_runs.fitter_of(values)
    pair_runs.made_output(values, names, inputs=())
    if before not in (None, whose):
        for path in (*people_files(out, before), *fit_files(out, people_names(before["people"], before["scans"]))):
            path.unlink(missing_ok=True)
    scans, truth, notes = read_truth(write_people(out, whose, made, faces), out / SCANS)
    say(f"{out / SCANS} has scans of {_in_words(whose)}")
    for note in notes:
        say(f"note: {note}")

    def work(progress):
        options = pair_runs.bench_keywords(values, out, fitter) | {"unit": "m", "reporter": progress}
        report, fits = pairs_bench(fitter, scans, truth, out, **options)
        report |= {"benchmark": "people", "people": whose}
        table = f"{pairs_table(report, markdown=values['markdown'])}\nScans of {_in_words(whose)}."
        return pair_runs.finished(out, report, table, fitter.rig, scans, fits, values)

    return pair_runs.run_stoppable(work, values, out)


def _in_words(whose):
    """Of whom scans are, by the options."""
    kinds = {"hand": "hands", "body": "bodies"}
    return f"{whose['people']} {kinds[whose['kind']]}, {whose['scans']} each, --scan-seed {whose['scan_seed']}"
