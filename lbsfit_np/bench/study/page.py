"""The study's page: its tables in Markdown, beside the paper's, written from the report and nothing else."""

from urllib.parse import quote

from ...learning.checkpoint import digest_of
from ..environment import commits, libraries, several
from . import tables
from .cells import cells_of
from .rows import ROWS

__all__ = ["FIGURES", "console_table", "page", "rows_digest"]

# Kinds of figures, in reading order.
FIGURES = (
    *("diagram", "triplet", "partitions", "mixture", "local-optimum"),
    *("accuracy", "ablation", "gallery", "correspondence"),
)

_INTRODUCTION = """\
# The paper's study

`lbsfit bench study` writes this page; change that command, not the page. It repeats the experiments of LBS-AE (CVPR 2019) in
classical form: fits and small scikit-learn models stand in for the paper's networks. Other differences are listed
[below](#where-the-protocols-differ). The paper's figures, where it has them, are in square brackets. For its FAUST table use
`lbsfit bench faust`, if you have that data.

Scans X of made-up people are registered, and the result is compared with the truth. U is the rig's template, U^gt a person's
true one, U^d the one that a fit made of U; Θ are the joint angles. The goals are this project's own.
"""

_REGISTRATIONS = """\
Means over the test scans.

- **Recon**: √L_c, where L_c is the Chamfer distance between the scan and the registered vertices. **at the truth**: the same
  for the true mesh and the same scan. **÷**: the first over the second; below 1 if a fit follows the scan's noise and gaps
  more closely.
- **Pose**: ‖joints − true joints‖, the mean over the unlocked joints, and its **median** over the scans. For free-form rows
  the joints are regressed from the vertices. It does not show how a head or a hand is turned about its bone.
- **vertices**: ‖registered − true vertices‖. **unfitted**: scans without a fit; they do not count in the other columns.
  **s**: seconds by the clock for learning and all fits of the row, without pretraining; – if the row took up steps of a run
  that was stopped. Work that the rows of one run share counts in the first of them: fits of the single training scans, for
  rows that learn from labels, and fits from the template without skinning.
"""

_CORRESPONDENCES = """\
- **Corre.**: the two registrations carry a point of scan A to scan B; this is its distance from its true place there, as mean
  and percentiles over {points} points of each of at most {pairs:,} ordered pairs of scans (the paper: 4,000 pairs). Where a
  point truly is: at the nearest place of the true mesh, around the triangle that the point was taken from.
- **snapped**: the same after moving to the nearest point of B, as the paper does. The result is a point of the scan, so even
  the best row is off by the spacing of the points, and by more where B has none. Goals refer to the figures before
  the snap.
"""

_LABELS = """\
The share of the test scans' points that get the right chain of joints.

- **before learning**, **as kept**: the segmenter alone, after pretraining and in the round that was kept (**round kept**).
  **single scans**: its worst and its best scan. **labels of its fits**: the labels that the registrations give.
"""

_TEMPLATES = """\
- **before** is ‖U − U^gt‖ and **after** is ‖U^d − U^gt‖, means over the vertices in the rest pose, with U^d scaled about the
  root joint by the fit's scale; **÷** is after over before. Columns "up to a shift" move both to a common centre first,
  because no scan shows where the rest pose stands. **whose**: templates that scans share, or one for each test scan. For
  bodies the paper has 0.03 and 0.02.
"""

_ORDERS = """\
In the order of the ablations, ≈ stands between rows that differ by less than 3 %. An order with such a pair is called level:
neither kept nor missed. Medians are over the scans (Pose) and over the points of all pairs (Corre.).
"""

_PROTOCOL = """\
## Where the protocols differ

- Hands: the paper poses its synthetic hands with poses inferred from its own captures, which are not public. Here
  {natural_hand:.0%} of the poses are close to natural ones from the rig's own library; the others are uniform within the
  joint limits. Every fourth pose of the library is reserved for the test. The library's other poses within 0.3 rad of a
  reserved one are left out, too, so that neither training nor the library of starts sees them.
- Bodies: natural poses as above replace SURREAL's; poses uniform within the limits replace the paper's bent bodies (3,000 of
  23,000).
{others}- People: the rigs with changed shapes, a length and a thickness of ±12 % for each chain of joints
  (`bench/subjects.py`). Training changes each bone separately (Gaussian, 8 %). A fit's proportions can lengthen bones as
  these people's are, widen them across, and widen only the skin of those that branch (palm, pelvis, chest). They cannot move
  skin along its normals, as the people's thickness does.
- The test has other people than those learned from. Each test scan is fitted as a stranger's, on U with its own proportions.
  So learned templates show in the figures of the training scans and in `lbsfit bench learn`, not in these tables.
- Scans: {n_points} points, one or two missing areas, uneven density, noise of {noise:g}. They face the rig's way up to what
  the root joint may turn, and the fitter is told so. Lengths are in half sizes of the rig, so that the template fills [−1,
  1]³; the paper scales every shape to that box.
- Fits: the paper's networks look at a test scan once. Here a search and an optimisation find pose and shape of each scan,
  starting from labels, from a library of poses and from f; each fit goes by the whole objective (Chamfer, structured
  Chamfer, Laplacian), then by what docs/fitting-method.md has after it. Joints follow the template's proportions; the paper's
  stay where the rig has them.
- The rows differ in more than the paper's do. Joint and pose-only use what all the poses found say about each other, so that
  angles which a scan leaves open are as in other poses; rand and cd do not. cd also has no library of poses. oracle-labels
  starts from the given labels alone.
- Learning is told which training scans are of one person, and these share a template; the paper's is not told. Test scans
  come without that. Three times the data also has three times as many people.
- Seeds are those of the scans. All training has one seed, {training_seed}, so ranges over seeds say nothing about training.
- Labels: the paper's segmenter learns from uniform poses of U, and the gaps between its rows come from what that leaves open.
  Here, in all rows, half of the uniform poses are correlated, so that fists occur, and bones of U are lengthened and
  thickened at random, as in the shipped training. This closes part of both gaps before anything is learned.
- Templates are found before a round's segmenter learns, and in turn with poses after it. So after one round the rows that
  learn from labels have nearly the same templates.
- The free-form rows play 3D-CODED's part: the template's vertices move under Chamfer and Laplacian. They start from the
  template, from the best of the template and several synthetic scans that look alike ("augmented"), or from the answer of a
  regressor that was taught with true vertices ("supervised"). Taught by few scans, the regressor knows only these: compare
  its row with its figures on the training scans. 3D-CODED is a network that has seen thousands of shapes and knows what
  bodies look like. The first two rows deform a resting template scan by scan without such knowledge, and do worse where limbs
  are far from rest.
- Recon is compared with its value at the true mesh on the same scan, because √CD is not 0 there. Corre. carries points of
  scan A by their closest surface point on A's registration to B's.
- Size "{size}": the paper learns from 1,500 hands and 23,000 bodies and tests on 300 and 2,300{more}.
"""
# Of all sizes but "paper".
_PAPERS_SIZE = ", as `--size paper` does"


def page(report, captions):
    """The page as Markdown.

    Parameters
    ----------
    report : dict
        Of ``run.study``.
    captions : dict of str to str
        Of the pictures beside it, by file name.

    Returns
    -------
    str
    """
    parts, explained = [_INTRODUCTION, _sizes(report), _rows(report)], set()
    for name in report["rigs"]:
        parts += [f"## {name.capitalize()}", *_of_rig(report, name, explained)]
    parts.append(_protocol(report))
    if captions:
        parts += ["## Figures", _drawn_earlier(report, captions)]
        files = sorted(captions, key=_place)
        parts += [f"![{file.removesuffix('.png').replace('-', ' ')}]({quote(file)})\n\n{captions[file]}" for file in files]
    parts.append(_provenance(report, captions))
    return "\n\n".join(p.strip("\n") for p in parts if p) + "\n"


def console_table(report, *, markdown=False):
    """The tables of registrations and correspondences of each rig, and what was to be reached."""
    parts = []
    for name in report["rigs"]:
        made = [make(report, name, markdown=markdown) for make in (tables.registrations, tables.correspondences, tables.goals)]
        parts += [name, *made, tables.orders(report, name)]
    return "\n\n".join(filter(None, [*parts, _fewer_seeds(report)]))


def _of_rig(report, name, explained):
    """The section of a rig: tables, the first of each kind with what its columns are, and what was to be reached."""
    from .measures import POINTS

    correspondences = _CORRESPONDENCES.format(points=POINTS, pairs=max(e["size"]["pairs"] for e in report["rigs"].values()))
    for title, made, words in (
        ("Registrations", tables.registrations(report, name, markdown=True), _REGISTRATIONS),
        ("Correspondences", tables.correspondences(report, name, markdown=True), correspondences),
        ("Labels", tables.labels(report, name, markdown=True), _LABELS),
        ("Templates", tables.templates(report, name, markdown=True), _TEMPLATES),
        ("Goals", tables.goals(report, name, markdown=True), ""),
        ("Order of the ablations", tables.orders(report, name), _ORDERS),
        ("More", tables.more(report, name), ""),
    ):
        if made:
            yield f"### {title}"
            yield "" if title in explained else words
            yield made
            explained.add(title)


def _place(file):
    """Of a picture on the page: by its kind, then by its rig."""
    kinds = [k for k, kind in enumerate(FIGURES) if file.startswith(kind)]
    return (kinds or [len(FIGURES)])[0], file


def _rows(report):
    """What the rows are that were run."""
    run = [row for row in ROWS if any(cells_of(report, name, row) for name in report["rigs"])]
    return "\n".join(f"- **{row}**: {_described(row)}." for row in run)


def _described(row):
    paper = ROWS[row].paper
    return ROWS[row].what + (f" (the paper's {paper})" if paper else "")


def _sizes(report):
    sizes = [
        f"- {name}: {e['size']['train']} scans of {e['size']['train_subjects']} people to learn from (a tenth, one at least, "
        f"only tells when to stop), {e['size']['test']} of {e['size']['test_subjects']} others to be tested on, "
        f"seed{'s' * (len(e['seeds']) > 1)} {', '.join(e['seeds'])}; {_synthetic(e)}"
        for name, e in report["rigs"].items()
    ]
    several = any(len(e["seeds"]) > 1 for e in report["rigs"].values())
    many = "Figures are means over the seeds, with their range. " if several else ""
    fewer = _fewer_seeds(report)
    many += f"{fewer} " if fewer else ""
    listed = "\n".join(sizes)
    return f"Size `{report['size']}`:\n\n{listed}\n\n{many}Lengths are in half sizes of the rig ([−1, 1]³). Rows:"


def _synthetic(entry):
    """How many synthetic scans the segmenter learns from, in words."""
    in_a_round = entry["size"]["training_scans"]
    first = entry.get("first_scans", in_a_round)  # which older results do not say
    before = f"{first:,} synthetic scans for the segmenter before learning"
    if first == in_a_round:
        return f"{before} and as many in each round"
    return f"{before} (it comes with the package), {in_a_round:,} in each round"


def _fewer_seeds(report):
    """The rows that not all seeds of their rig have: their means are over other scans than those of the other rows."""
    fewer = [words for name, e in report["rigs"].items() for words in _with_fewer_seeds(name, e["seeds"])]
    return f"Fewer seeds: {'; '.join(fewer)}." if fewer else ""


def _with_fewer_seeds(name, seeds):
    """"hand, cd: 300 alone" of each row that not all seeds have."""
    for row in ROWS:
        has = [seed for seed, rows in seeds.items() if row in rows]
        if 0 < len(has) < len(seeds):
            yield f"{name}, {row}: {', '.join(has)}" + (" alone" if len(has) == 1 else "")


def _protocol(report):
    from .data import NATURAL

    scan, size = report["scan"], report["size"]
    given = {"n_points": scan["n_points"], "noise": scan["noise"], "size": size, "training_seed": report["training_seed"]}
    given["others"] = "".join(_otherwise(name, entry) for name, entry in report["rigs"].items())
    return _PROTOCOL.format(natural_hand=NATURAL["hand"], more="" if size == "paper" else _PAPERS_SIZE, **given)


def _otherwise(name, entry):
    """What of this does not hold for a rig."""
    words = ""
    if entry["kind"] == "other":
        words += f"- {name}: by its joints' names neither a hand nor a body, so without figures of the paper and without goals.\n"
    if "library" in entry and not any(entry["library"].values()):
        words += f"- {name}: its rig has no library of natural poses to divide, so all poses are uniform within the limits.\n"
    return words


def _drawn_earlier(report, captions):
    """In words, of which rigs rows were made after the pictures that the page has of them."""
    known = (report.get("drawn_by") or {}).get("of", {})
    stale = [name for name, of in known.items() if name in report["rigs"] and of != rows_digest(report["rigs"][name])]
    if not (captions and stale):
        return ""
    return f"These pictures are of earlier rows than those above: {', '.join(stale)}."


def rows_digest(entry):
    """Hex digest of what the rows of a rig have found, of all that pictures of them show."""
    return digest_of([(seed, row, cell["arrays"]) for seed, rows in entry["seeds"].items() for row, cell in rows.items()])


def _provenance(report, captions):
    cells = [c for rig in report["rigs"].values() for rows in rig["seeds"].values() for c in rows.values()]
    made = [_made_on(c["environment"]) for c in cells]
    commit = _commits(report)
    how = sorted({(c["jobs"], c.get("at_once", 1)) for c in cells})
    of, known = len(cells), tables.timed(cells)
    rows = "all" if len(known) == of else f"{len(known)} of {of}"
    took = f"{sum(known) / 60:.1f} min for {rows} rows" if known else "not timed"
    took += ", added up" * bool(known and any(n > 1 for _, n in how))
    took += f", with {' or '.join(_processes(*one) for one in how)}"
    where = "; and ".join(dict.fromkeys(made))  # each once, in the order of the rows
    drawn = report.get("drawn_by") if captions else None
    pictures = f" Pictures by matplotlib {drawn['matplotlib']}." if drawn and drawn["matplotlib"] else ""
    return f"---\n\n{commit}{where}; {took}.{pictures} `results.json` beside this page has every figure."


def _processes(jobs, at_once):
    return f"{jobs} process{'es' * (jobs > 1)}" + f" each, {at_once} rows at once" * (at_once > 1)


def _commits(report):
    """The state of the code that rows are of; of several, each with its rows."""
    cells = {
        f"{name} {seed} {row}": c
        for name, entry in report["rigs"].items()
        for seed, rows in entry["seeds"].items()
        for row, c in rows.items()
    }
    made = ((called, c["environment"] | {"code": c.get("code")}) for called, c in cells.items())
    of = dict(sorted(commits(made).items()))
    return f"{several(of)} " if len(of) > 1 else "".join(f"Commit {commit}; " for commit in of if commit)


def _made_on(e):
    """Versions and machine of a row."""
    machine = f"{e['cpus']} CPUs" + (f" ({e['processor']})" if e["processor"] else "")
    return f"lbsfit_np {e['lbsfit_np']}, Python {e['python']}, {libraries(e)}, {machine}"
