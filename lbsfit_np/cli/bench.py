"""``lbsfit bench``: the figures of the documentation, measured again on real rigs."""

import argparse
import sys
from pathlib import Path

from ..errors import InputError
from .fit import OPTIONS
from .outputs import check_outputs, make_folder
from .parsing import Option, add_options, formatter, natural, positive, settings
from .progress import Progress, say

__all__ = ["add_parser"]

RESULTS = "results.json"
ROW_NAMES = ("own", "plain", "oracle", "paper")

_HELP = {
    "hand": "an artist's hand: changed shapes in uniform and in natural poses",
    "body": "a body: two other people in poses from motion capture",
}

_DESCRIPTION = {
    "hand": """\
Fit the hand of DIR/webxr_hand to synthetic scans of changed shapes, half in uniform poses and half near the natural ones of
DIR/hand_poses, and compare the fits with the truth. Lengths in half sizes of the rig.
""",
    "body": """\
Fit one body of DIR/mpfb2_body to synthetic scans of its two other shapes in poses from DIR/motion, and compare the fits with
the truth. Lengths in cm.
""",
}

_MORE = """
Rows: the fit as users get it (own); plain Chamfer from the rest pose (plain); the fit with the true labels given
(oracle); and, if asked for, the fit with the paper's weights (paper). OUT gets results.json (every figure, settings,
versions), after each row anew, and for each seed a picture of own fits from the worst to the best.
"""

_ROUNDTRIP = """\
Scan bundled rigs in poses near their libraries of natural poses, with their own shape, fit these scans, and compare with the
truth. Mean joint errors in shares of the rig's size; to be reached: at most 2 % for at least 95 % of the scans.
"""

_ROUNDTRIP_EPILOG = """\
example:
  lbsfit bench roundtrip hand --scans 40 -o roundtrip

Exit code: 0 all fitted, 1 some scans failed (named with reasons), 2 usage or an unusable rig, 130 stopped by Ctrl-C.
"""

_LEARN = """\
Learn from synthetic scans of three changed shapes of a rig of DIR, with the whole loop and with its ablations, and compare
joints, vertices, templates and labels with the truth. OUT gets results.json, after each row anew.
"""

_LEARN_EPILOG = """\
example:
  lbsfit bench learn hand --data rigs -o bench-learn --jobs 2

Exit code: 0 all done, 2 usage or unreadable data, 130 stopped by Ctrl-C.
"""

_EPILOG = """\
example:
  lbsfit bench {name} --data rigs -o bench-{name} --jobs 2

Exit code: 0 all fitted, 1 some scans failed (named with reasons), 2 usage or unreadable data, 130 stopped by Ctrl-C.
"""


def add_parser(commands):
    """Add ``lbsfit bench`` and its benchmarks to the subparsers ``commands``."""
    parser = commands.add_parser("bench", help="measure the documented figures again", formatter_class=formatter)
    parser.description = "Benchmarks: of real rigs, which do not come with the package, and of the bundled ones."
    benches = parser.add_subparsers(metavar="BENCHMARK", required=True, title="benchmarks")
    for name, n_scans in (("hand", 40), ("body", 20)):
        bench = benches.add_parser(
            name,
            help=_HELP[name],
            description=_DESCRIPTION[name] + _MORE,
            epilog=_EPILOG.format(name=name),
            formatter_class=formatter,
        )
        options = _options(n_scans)
        add_options(bench, options)
        bench.set_defaults(run=lambda arguments, name=name, options=options: _run(name, settings(arguments, options)))
    _add_roundtrip(benches)
    _add_learn(benches)


def _add_roundtrip(benches):
    bench = benches.add_parser(
        "roundtrip",
        help="bundled rigs in natural poses, scanned and fitted again",
        description=_ROUNDTRIP,
        epilog=_ROUNDTRIP_EPILOG,
        formatter_class=formatter,
    )
    bench.add_argument("rigs", metavar="RIG", nargs="*", help="bundled rigs, or rig files with natural poses; default: hand body")
    options = (
        Option("output", "folder for results.json, made if need be; else only a table is printed", metavar="OUT", flag="-o"),
        Option("scans", "scans a rig and seed", positive, 40, metavar="N"),
        Option("seeds", "seeds of the scans, with commas; training has its own", _seeds, "100", metavar="N,N"),
        *(o for o in OPTIONS if o.name in ("training-scans", "jobs")),
        Option("markdown", "print the table as Markdown", bool, False),
        Option("existing", "what to do where results exist already", default="error", choices=("error", "replace")),
    )
    add_options(bench, options)
    bench.set_defaults(run=lambda arguments: _run_roundtrip(arguments.rigs, settings(arguments, options)))


def _add_learn(benches):
    bench = benches.add_parser(
        "learn",
        help="the loop over a collection of scans, and its ablations",
        description=_LEARN,
        epilog=_LEARN_EPILOG,
        formatter_class=formatter,
    )
    bench.add_argument("collection", choices=("hand", "body"), help="which rig of DIR")
    options = (
        Option("data", "the folder of real rigs, poses and motion", metavar="DIR"),
        Option("output", "folder for results.json; made if need be", metavar="OUT", flag="-o"),
        Option("scans", "scans to learn from, of all subjects together", positive, 60, metavar="N"),
        Option("seeds", "seeds of the collections, with commas; training has its own", _seeds, "100,101,102", metavar="N,N"),
        Option("variants", "what to learn, with commas: joint, pose-only, rand, cd, free-form", str, "joint,pose-only,rand,cd"),
        *(o for o in OPTIONS if o.name in ("training-scans", "jobs")),
        Option("markdown", "print the table as Markdown", bool, False),
        Option("existing", "what to do where results exist already", default="error", choices=("error", "replace")),
    )
    add_options(bench, options)
    bench.set_defaults(run=lambda arguments: _run_learn(arguments.collection, settings(arguments, options)))


def _run_learn(name, values):
    from ..bench.learn import learn_bench, learn_table
    from ..bench.run import BENCHES
    from ..io.write import write_json

    for key, option, example in (("data", "--data", "--data DIR"), ("output", "-o/--output", "-o OUT")):
        if values[key] is None:
            raise InputError(option, "nothing", "a folder", f"Add {example}.")
    BENCHES[name].check_data(values["data"])
    out = Path(values["output"])
    results = out / RESULTS
    check_outputs([results], out, inputs=[], existing=values["existing"])
    make_folder(out)

    def on_row(report, variant, seed):
        write_json(results, report)
        entry = report["rows"][variant][str(seed)]
        error = f"joints {entry['joint_error']:.4f}, vertices {entry['vertex_error']:.4f} {report['unit']}"
        say(f"seed {seed}, {variant}: {error}, {entry['seconds']:.0f} s")

    report = learn_bench(
        name,
        values["data"],
        n_scans=values["scans"],
        seeds=[int(s) for s in values["seeds"].split(",")],
        variants=values["variants"].split(","),
        training_scans=values["training_scans"],
        jobs=values["jobs"],
        on_row=on_row,
    )
    write_json(results, report)
    say("")
    say(learn_table(report, markdown=values["markdown"]))
    return 0


def _run_roundtrip(rigs, values):
    from ..bench.roundtrip import RIGS, roundtrip, roundtrip_table
    from ..io.write import write_json

    results = None
    if values["output"] is not None:
        out = Path(values["output"])
        results = out / RESULTS
        check_outputs([results], out, inputs=[], existing=values["existing"])
        make_folder(out)
    progress = _BenchProgress()

    def on_rig(report, name):
        progress.close()
        if results is not None:
            write_json(results, report)

    try:
        report = roundtrip(
            rigs or RIGS,
            n_scans=values["scans"],
            seeds=[int(s) for s in values["seeds"].split(",")],
            training_scans=values["training_scans"],
            jobs=values["jobs"],
            progress=progress.training,
            on_scan=progress.one_fit,
            on_rig=on_rig,
        )
    finally:
        progress.close()
    say(roundtrip_table(report, markdown=values["markdown"]))
    runs = [(name, seed, run) for name, entry in report["rigs"].items() for seed, run in entry["seeds"].items()]
    failures = [(name, seed, scan) for name, seed, run in runs for scan in run["scans"] if "failed" in scan]
    for name, seed, scan in failures:
        say(f"failed: {name}, seed {seed}, scan {scan['scan']}: {scan['failed']}")
    return 1 if failures else 0


def _options(n_scans):
    return (
        Option("data", "the folder of real rigs, poses and motion", metavar="DIR"),
        Option("output", "folder to write to; made if need be", metavar="OUT", flag="-o"),
        Option("scans", "scans a seed", positive, n_scans, metavar="N"),
        Option("seeds", "seeds of the test's scans, with commas; training has its own", _seeds, "100,101,102", metavar="N,N"),
        Option("rows", "ways of fitting, with commas: own, plain, oracle, paper", _rows, "own,plain,oracle", metavar="NAME,…"),
        *(o for o in OPTIONS if o.name in ("training-scans", "jobs")),
        Option("pictures", "fits to show of each seed, from the worst to the best", natural, 3, metavar="K"),
        Option("markdown", "print the table as Markdown", bool, False),
        Option("existing", "what to do where results exist already", default="error", choices=("error", "replace")),
    )


def _seeds(text):
    """The text itself, once it is known to be different whole numbers with commas between them."""
    parts = text.split(",")
    if not all(part.strip().isdecimal() for part in parts) or len({int(part) for part in parts}) < len(parts):
        raise argparse.ArgumentTypeError(f"got {text!r}; expected different whole numbers with commas, such as 100,101,102")
    return text


def _rows(text):
    """The text itself, once it is known to be different names of rows with commas between them."""
    names = text.split(",")
    if not set(names) <= set(ROW_NAMES) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"got {text!r}; expected some of {', '.join(ROW_NAMES)}, with commas")
    return text


def _run(name, values):
    from ..bench.run import BENCHES, run_bench
    from ..io.write import write_json

    for key, option, example in (("data", "--data", "--data DIR"), ("output", "-o/--output", "-o OUT")):
        if values[key] is None:
            raise InputError(option, "nothing", "a folder", f"Add {example}.")
    bench = BENCHES[name]
    bench.check_data(values["data"])
    seeds = [int(s) for s in values["seeds"].split(",")]
    out = Path(values["output"])
    results = out / RESULTS
    pictures = {seed: out / f"seed-{seed}.png" for seed in seeds} if values["pictures"] and "own" in values["rows"] else {}
    check_outputs([results, *pictures.values()], out, inputs=[], existing=values["existing"])
    make_folder(out)
    progress = _BenchProgress()

    def on_row(report, row, seed):
        write_json(results, report)
        progress.row(report, row, seed)

    try:
        report, fits = run_bench(
            bench,
            values["data"],
            seeds=seeds,
            n_scans=values["scans"],
            training_scans=values["training_scans"],
            jobs=values["jobs"],
            rows=values["rows"].split(","),
            training_progress=progress.training,
            on_scan=progress.one_scan,
            on_row=on_row,
        )
    finally:
        progress.close()
    if pictures:
        report["pictures"] = _draw(bench, values, fits, pictures)
    write_json(results, report)
    return _farewell(report, values, out)


def _draw(bench, values, fits, paths):
    """Draw a picture a seed; returns file → the scans that it shows, from top to bottom."""
    from ..bench.pictures import picture, shown
    from ..report.render import write_png

    rig = bench.load()[0](values["data"])
    drawn = {}
    for seed, path in paths.items():
        rows = shown(fits[seed], values["pictures"])
        if rows:
            write_png(path, picture(rig, fits[seed], rows))
            drawn[path.name] = rows
    return drawn


def _farewell(report, values, out):
    from ..bench.table import table

    say("")
    say(table(report, markdown=values["markdown"]))
    say(f"\nresults in {out}")
    failures = [
        (row, seed, scan)
        for row, content in report["rows"].items()
        for seed, entry in content["seeds"].items()
        for scan in entry["scans"]
        if "failed" in scan
    ]
    for row, seed, scan in failures:
        say(f"failed: {row}, seed {seed}, scan {scan['scan']}: {scan['failed']}")
    return 1 if failures else 0


class _BenchProgress(Progress):
    """Training as in every command; then a bar a row on a terminal, and a line when it is done."""

    def __init__(self):
        super().__init__(0)

    def one_scan(self, row, seed, done, total):
        """``done`` of the ``total`` scans of a row are fitted."""
        from ..bench.run import ROWS

        self.one_fit(ROWS[row], seed, done, total)

    def one_fit(self, what, seed, done, total):
        """``done`` of the ``total`` scans of one thing and seed are fitted."""
        if not self.terminal:
            return
        if self._bar is None:
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc=f"seed {seed}, {what}", unit="scan", leave=False, file=sys.stderr)
        self._bar.update(done - self._bar.n)

    def row(self, report, row, seed):
        """A row of a seed is complete."""
        self.close()
        content = report["rows"][row]
        entry = content["seeds"][str(seed)]
        error = entry["mean"].get("joint_error")
        words = "all failed" if error is None else f"mean joint error {error:.4g} {report['unit']}"
        self.line(f"seed {seed}, {content['what']}: {len(entry['scans'])} scans in {entry['wall_seconds']:.0f} s, {words}")
