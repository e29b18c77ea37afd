"""``lbsfit bench``: the figures of the documentation, measured again on real rigs."""

import argparse
from contextlib import nullcontext
from dataclasses import replace

from ..errors import brief, from_digits
from ..io.write import without_empty
from . import bench_faust, bench_pairs, bench_people
from . import bench_runs as runs
from .bench_study import run_study
from .fit import OPTIONS, TRAINING_SCANS
from .parsing import Option, add_options, formatter, natural, positive, settings

__all__ = ["add_parser"]

ROW_NAMES = ("own", "plain", "oracle", "paper")
CONDITION_NAMES = (
    *("0.3", "0.6", "1.0", "turned", "rotated", "unit", "touching", "partial", "cropped", "edge", "dirty", "subjects", "arm"),
)
FIT_NAMES = ("own", "plain", "oracle")
VARIANT_NAMES = ("joint", "pose-only", "rand", "cd", "free-form")
STUDY_NAMES = (
    *("free-form", "free-form-augmented", "free-form-supervised", "free-form-supervised-3x"),
    *("cd", "rand", "pose-only", "joint", "oracle-labels", "oracle-fit"),
)

_HELP = {
    "hand": "an artist's hand: changed shapes in uniform and in natural poses",
    "body": "a body: two other people in poses from motion capture",
}

_DESCRIPTION = {
    "hand": """\
Fit the hand of DIR/webxr_hand to synthetic scans of changed shapes, half in uniform poses and half near the natural ones of
DIR/hand_poses, and compare the fits with the truth. Lengths are in half sizes of the rig.
""",
    "body": """\
Fit one body of DIR/mpfb2_body to synthetic scans of its two other shapes in poses from DIR/motion, and compare the fits with
the truth. Lengths are in cm.
""",
}

_MORE = """
Rows: the fit as users get it (own); plain Chamfer from the rest pose (plain); the fit with the true labels given
(oracle); and, if asked for, the fit with the paper's weights, without registration (paper). OUT gets results.json (every
figure, settings, versions), rewritten after each row, and for each seed a picture of own fits from worst to best. Run the
same command again to do only what is missing.
"""

_ROUNDTRIP = """\
Scan bundled rigs in their own shape and in poses near their libraries of natural poses, fit these scans, and compare the fits
with the truth. Mean joint errors are in shares of the rig's size; the goal is at most 2 % for at least 95 % of the scans. OUT
gets results.json, rewritten after each seed of each rig. Run the same command again to do only what is missing.
"""

_LEARN = """\
Learn from synthetic scans of three changed shapes of a rig in DIR, with the whole loop and with its ablations, and compare
joints, vertices, templates and labels with the truth. OUT gets results.json, rewritten after each row.
"""

_STARTS = """\
Scan bundled rigs under the conditions that fits have to cope with, fit these scans, and compare with the truth: what share of
the scans has a mean joint error of at most 1.5 % (in some rows 3 %) of the rig's size, whether the fits know which scans miss
that, and whether joint_std tells which joints are wrong.

Rows: 0.3, 0.6 and 1.0 rad per joint, facing known; natural poses under any turn about the up axis (turned) and any rotation
(rotated), in an unknown unit and scale (unit), seen from one side (partial), cut off (cropped), seen from one side up to where
the picture ends (edge), with clutter, noise and holes (dirty); touching fingers and fists (touching; hands only); other people
(subjects); an arm beyond the wrist (arm; hands only). Fits: as users get them (own); plain Chamfer from the rest pose (plain);
with the true labels given (oracle). OUT gets results.json, rewritten after each row. Run the same command again to do only what
is missing.
"""

_STUDY = """\
Register synthetic hands and bodies by every row of the paper's Table 1 and some more, and compare them with the truth: Recon,
Pose, Corre., labels and templates, beside the paper's figures.

OUT gets results.json and the registrations (cells/), updated after each row, and at the end README.md with the tables, and
pictures, which need the extra "viz" installed. Run the same command again to do only what is missing.

--rows: free-form... have no skinning: they start from the template or from synthetic scans that look alike, or are taught by
true correspondences; cd, rand, pose-only and joint are the variants of lbsfit learn; oracle-labels and oracle-fit are given
true labels or true correspondences. README.md says more about each.

With --jobs, several rows run at once where that is faster, one process each; at the medium size each process takes up to 5 GB.
--size small takes five to ten minutes on two cores with --jobs 2, medium some hours per rig and seed, paper days.
"""

_EPILOG = """\
example:
  lbsfit bench {example}

Exit code: 0 all fitted, 1 some scans failed (named with reasons), 2 usage or {unusable}, 130 stopped by Ctrl-C, 143 by SIGTERM.
"""


def add_parser(commands):
    """Add ``lbsfit bench`` and its benchmarks to the subparsers ``commands``."""
    parser = commands.add_parser("bench", help="measure the documented figures again", formatter_class=formatter)
    parser.description = "Run benchmarks on real rigs, which do not come with the package, and on the bundled ones."
    benches = parser.add_subparsers(metavar="BENCHMARK", required=True, title="benchmarks")
    for name, n_scans in (("hand", 40), ("body", 20)):
        bench = benches.add_parser(
            name,
            help=_HELP[name],
            description=_DESCRIPTION[name] + _MORE,
            epilog=_epilog(f"{name} --data rigs -o bench-{name} --jobs 2", unusable="unreadable data"),
            formatter_class=formatter,
        )
        options = (
            *_of_data("folder to write to; created if needed"),
            Option("scans", "scans per seed", positive, n_scans, metavar="N"),
            _seeds_option("the test scans", "100,101,102"),
            Option(
                "rows",
                f"ways of fitting, comma-separated: {', '.join(ROW_NAMES)}",
                _some_of(ROW_NAMES),
                "own,plain,oracle",
                "NAME,…",
            ),
            *_TRAINING,
            Option("pictures", "fits to show for each seed, from worst to best", natural, 3, metavar="K"),
            _MARKDOWN,
            _RESUMING,
        )
        _add_options(bench, options, lambda arguments, values, name=name: runs.run_data(name, values))
    _add_roundtrip(benches)
    _add_learn(benches)
    _add_starts(benches)
    bench_people.add_parser(benches)
    bench_pairs.add_parser(benches)
    bench_faust.add_parser(benches)
    _add_study(benches)


def _add_roundtrip(benches):
    bench = benches.add_parser(
        "roundtrip",
        help="bundled rigs in natural poses, scanned and fitted again",
        description=_ROUNDTRIP,
        epilog=_epilog("roundtrip hand --scans 40 -o roundtrip"),
        formatter_class=formatter,
    )
    bench.add_argument("rigs", **_RIGS)
    options = (
        _OUTPUT_OR_TABLE,
        Option("scans", "scans per rig and seed", positive, 40, metavar="N"),
        _seeds_option("the scans", "100"),
        *_TRAINING,
        _MARKDOWN,
        _RESUMING,
    )
    _add_options(bench, options, lambda arguments, values: runs.run_roundtrip(arguments.rigs, values))


def _add_learn(benches):
    bench = benches.add_parser(
        "learn",
        help="the loop over a collection of scans, and its ablations",
        description=_LEARN,
        epilog=_epilog("learn hand --data rigs -o bench-learn --jobs 2", unusable="unreadable data"),
        formatter_class=formatter,
    )
    bench.add_argument("collection", choices=("hand", "body"), help="which rig in DIR")
    options = (
        *_of_data("folder for results.json; created if needed"),
        Option("scans", "scans to learn from, of all subjects together", positive, 60, metavar="N"),
        _seeds_option("the collections", "100,101,102"),
        Option(
            "variants",
            f"variants to learn with, comma-separated: {', '.join(VARIANT_NAMES)}",
            _some_of(VARIANT_NAMES),
            "joint,pose-only,rand,cd",
            "NAME,…",
        ),
        *_TRAINING,
        _MARKDOWN,
        _RESUMING,
    )
    _add_options(bench, options, lambda arguments, values: runs.run_learn(arguments.collection, values))


def _add_starts(benches):
    bench = benches.add_parser(
        "starts",
        help="bundled rigs turned, bent, partial and dirty: how many scans are fitted correctly, and which are not",
        description=_STARTS,
        epilog=_epilog("starts hand --rows 0.6,turned --scans 20 -o bench-starts"),
        formatter_class=formatter,
    )
    bench.add_argument("rigs", **_RIGS)
    rows, fits = ",".join(CONDITION_NAMES), _some_of(FIT_NAMES)
    options = (
        _OUTPUT_OR_TABLE,
        Option("scans", "scans per row", positive, 100, metavar="N"),
        Option("seed", "seed of the scans; training has its own", natural, 200, metavar="N"),
        Option(
            "rows",
            "which rows, comma-separated; each rig takes part in the rows meant for it",
            _some_of(CONDITION_NAMES),
            rows,
            "NAME,…",
        ),
        Option("fits", f"ways of fitting, comma-separated: {', '.join(FIT_NAMES)}", fits, "own", "NAME,…"),
        Option(
            "effort", "how many starts a fit follows, and how far", default="balanced", choices=("fast", "balanced", "thorough")
        ),
        replace(TRAINING_SCANS, help=f"{TRAINING_SCANS.help}, for the row edge twice as many"),
        _JOBS,
        _MARKDOWN,
        _RESUMING,
    )
    _add_options(bench, options, lambda arguments, values: runs.run_starts(arguments.rigs, values))


def _add_study(benches):
    bench = benches.add_parser(
        "study",
        help="the paper's tables and figures",
        description=_STUDY,
        epilog=_epilog("study --size small -o study --jobs 2"),
        formatter_class=formatter,
    )
    options = (
        Option("output", "folder to write to; created if needed", metavar="OUT", flag="-o"),
        Option("size", "how much of everything", default="small", choices=("small", "medium", "paper")),
        Option(
            "rig",
            "rigs, comma-separated: names of bundled ones, or files; by default hand,body-coarse, or hand,body for larger sizes",
            metavar="RIG,…",
        ),
        Option("rows", "which rows, comma-separated", _some_of(STUDY_NAMES), ",".join(STUDY_NAMES), "NAME,…"),
        Option(
            "seeds", "comma-separated seeds of the scans; by default 300, or 300,301,302 for larger sizes", _seeds, None, "N,N"
        ),
        _JOBS,
        Option("figures", "draw the figures", bool, True),
        Option("page", "only write OUT's page anew, with figures where all registrations are there; runs no row", bool, False),
        _MARKDOWN,
        _RESUMING,
    )
    _add_options(bench, options, lambda arguments, values: run_study(values))


# ---- what benchmarks share ----

_RIGS = {"metavar": "RIG", "nargs": "*", "help": "bundled rigs, or rig files with natural poses; default: hand body"}
_OUTPUT_OR_TABLE = Option(
    "output", "folder for results.json, created if needed; without it only a table is printed", metavar="OUT", flag="-o"
)
_MARKDOWN = Option("markdown", "print the table as Markdown", bool, False)
_EXISTING = "continue with existing results of the same settings, or start again without any"
_RESUMING = Option("existing", _EXISTING, default="resume", choices=("resume", "replace"))
_JOBS = next(o for o in OPTIONS if o.name == "jobs")
_TRAINING = (TRAINING_SCANS, _JOBS)


def _of_data(output):
    return (
        Option("data", "the folder of real rigs, poses and motion", metavar="DIR"),
        Option("output", output, metavar="OUT", flag="-o"),
    )


def _seeds_option(whose, default):
    return Option("seeds", f"comma-separated seeds of {whose}; training has its own", _seeds, default, metavar="N,N")


def _epilog(example, *, unusable="an unusable rig"):
    return _EPILOG.format(example=example, unusable=unusable)


def _add_options(bench, options, run):
    """Options, and what runs with them: ``run(arguments, values)``."""
    add_options(bench, options)
    # The report of an earlier run is in that folder.
    bench.set_defaults(flags=bench.get_default("flags") | {"before": "-o", "n_scans": "--scans"})

    def in_its_folder(arguments):
        values = settings(arguments, options)
        with without_empty(values["output"]) if values["output"] else nullcontext():  # of what is wrong after it was made
            return run(arguments, values)

    bench.set_defaults(run=in_its_folder)


def _seeds(text):
    """The text itself, once it is known to be different whole numbers with commas between them."""
    seeds = [from_digits(part.strip()) for part in text.split(",")]
    if None in seeds or len(set(seeds)) < len(seeds):
        expected = "different whole numbers separated by commas, such as 100,101,102"
        raise argparse.ArgumentTypeError(f"got {brief(text)}; expected {expected}")
    return text


def _some_of(known):
    """A parser of text: the text itself, once it is known to be different ones of these names with commas between them."""

    def names(text):
        given = text.split(",")
        if not set(given) <= set(known) or len(set(given)) < len(given):
            raise argparse.ArgumentTypeError(f"got {text!r}; expected some of {', '.join(known)}, separated by commas")
        return text

    return names
