"""The study's page: its tables in Markdown, beside the paper's, written from the report and nothing else."""

from urllib.parse import quote

from . import tables
from .cells import cells_of
from .rows import ROWS

__all__ = ["FIGURES", "console_table", "page"]

# Kinds of figures, in reading order.
FIGURES = (
    *("diagram", "triplet", "partitions", "mixture", "local-optimum"),
    *("accuracy", "ablation", "gallery", "correspondence"),
)

_INTRODUCTION = """\
# The paper's study

Written by `lbsfit bench study`; change that command, not this page. The experiments of LBS-AE (CVPR 2019) in their
classical form: the paper's networks are fits and small scikit-learn models here, and what else differs stands
[below](#where-the-protocols-differ). The paper's figures, where it has them, stand in square brackets. Its FAUST table is
`lbsfit bench faust`, for those who have that data.

Scans X of made people are registered, and what is found is compared with the truth. U is the rig's template, U^gt the true
one of a person, U^d what a fit made of U; Θ are the angles of the joints. Goals are this project's own.
"""

_REGISTRATIONS = """\
Means over the test scans.

- **Recon**: √L_c, L_c the Chamfer distance between scan and registered vertices. **at the truth**: its value at the true mesh
  on the same scan. **÷**: one by the other, below 1 where a fit follows the scan's noise and missing areas more closely.
- **Pose**: ‖joints − true joints‖, mean over the unlocked ones, and its **median** over the scans. Joints of free-form rows
  are regressed from the vertices. It says nothing of how a head or a hand is turned about its bone.
- **vertices**: ‖registered − true vertices‖. **unfitted**: scans without a fit, which all these leave out. **s**: of learning
  and all fits of the row, pretraining not counted; – of a row that found steps of a run that was stopped. What rows
  of one run have in common counts in the first of these: the training scans' fits by themselves, where labels teach, and those
  from the template without skinning.
"""

_CORRESPONDENCES = """\
- **Corre.**: how far from its true place on scan B a point of scan A is carried by the two registrations: mean and percentiles
  over {points} points of each of at most {pairs:,} ordered pairs of scans (the paper: 4,000 pairs).
- **snapped**: the same after the step to the nearest point of B, as in the paper. It ends on a point of the scan: even the best
  row is off by the distance between points, and by more where B has none. Goals are of the figures before it.
"""

_LABELS = """\
The share of the test scans' points that are put into the right chain of joints.

- **before learning**, **as kept**: of the segmenter alone, after pretraining and in the round that was kept
  (**round kept**); of its **single scans** the worst and the best. **labels of its fits**: the same of the registrations.
"""

_TEMPLATES = """\
- **before** is ‖U − U^gt‖, **after** ‖U^d − U^gt‖, mean over the vertices in the rest pose, U^d grown by its scale about the
  root joint, **÷** one by the other; and both with the two moved to a common centre ("up to a shift"), as no scan shows where the
  rest pose stands. **whose**: templates that scans share, or one of each test scan's own. The paper has 0.03 and 0.02 for bodies.
"""

_ORDERS = """\
In the order of the ablations ≈ stands between rows that are nearer to each other than 3 %, and an order with such a pair is
called level: neither kept nor missed. Medians are over the scans (Pose) and over the points of all pairs (Corre.).
"""

_PROTOCOL = """\
## Where the protocols differ

- Hands: the paper poses its synthetic hands with what it inferred from its own captures, which are not public. Here
  {natural_hand:.0%} of the poses are near natural ones of the rig's own library, the others uniform within the joint
  limits. Every fourth pose of the library is for the test alone; what of the others is within 0.3 rad of one of these
  is left out, so that neither training nor the library of starts sees it.
- Bodies: in place of SURREAL's poses, natural ones as above; in place of its bent bodies (3,000 of 23,000), poses
  uniform within the limits.
- People: changed shapes of the bundled rigs, a length and a thickness of ±12 % for each chain of joints (`bench/subjects.py`).
  Training changes each bone by itself, Gaussian by 8 %; a fit's proportions can lengthen bones as these people's are, widen them
  across, and widen the skin alone of those that branch (palm, pelvis, chest), but move no skin along its normals, as thickness
  does.
- The people of the test are others than those learned from. Each of their scans is fitted as somebody else's, on U with
  proportions of its own: templates that were learned show in the figures of the training scans and in `lbsfit bench learn`, not
  in the tables.
- Scans: {n_points} points, one or two missing areas, uneven density, noise of {noise:g}; they face the rig's way up to
  what the root joint may turn, which the fitter is told. Lengths are in half sizes of the rig, so that the template fills
  [−1, 1]³; the paper scales every shape to it.
- Fits: the paper's networks look at a test scan once. Here pose and shape of each are searched for and optimised by
  themselves, from labels, from a library of poses and from f; the whole objective (Chamfer, structured Chamfer, Laplacian) ends
  each fit. Joints follow the template's proportions; the paper's stay where the rig has them.
- The rows differ by more than in the paper. What all poses found tell of each other is used in joint and pose-only, not in rand
  and cd: angles that a scan leaves open are as other poses have them. cd is without the library of poses, too. oracle-labels
  starts from the labels given and looks for nothing else.
- Learning is told which training scans are of one person, who share a template; the paper's is not. Test scans come without.
  Three times the data has three times as many people, too.
- Seeds are of the scans; what is trained has one seed, {training_seed}, so that ranges over seeds say nothing of training.
- Labels: the paper's segmenter learns from uniform poses of U, and the gaps between its rows are what that leaves open. Here, in
  all rows, half of the uniform poses are correlated, so that fists occur, and bones of U are lengthened and thickened at random,
  as the shipped training does: part of both gaps is closed before anything is learned.
- Templates are found before a round's segmenter learns, and in turn with poses after it. So after one round rows that learn from
  labels have templates that hardly differ.
- The free-form rows play 3D-CODED's part: the template's vertices move under Chamfer and Laplacian, from the template, from
  the best of this and of several synthetic scans that look alike ("augmented"), or from what a regressor says that was taught
  with true vertices ("supervised"). Taught by few scans, it knows these alone: compare its row with its figures on the
  training scans. 3D-CODED is a network that has seen thousands of shapes and so knows what bodies look like; here the first two
  deform a resting template scan by scan, without any such knowledge, and do worse where limbs are far from rest.
- Recon is compared with its value at the true mesh on the same scan, as √CD is not 0 there. Corre. carries points of
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
    parts = [_INTRODUCTION, _sizes(report), _rows(report)]
    for name in report["rigs"]:
        parts += [f"## {name.capitalize()}", *_of_rig(report, name)]
    parts.append(_protocol(report))
    if captions:
        parts.append("## Figures")
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
    return "\n\n".join(filter(None, parts))


def _of_rig(report, name):
    """The section of a rig: tables, those of the first rig with what their columns are, and what was to be reached."""
    from .measures import POINTS

    first = name == next(iter(report["rigs"]))
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
            yield words if first else ""
            yield made


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
        f"seed{'s' * (len(e['seeds']) > 1)} {', '.join(e['seeds'])}; "
        f"{e['size']['training_scans']:,} synthetic scans for the segmenter before learning and as many in each round"
        for name, e in report["rigs"].items()
    ]
    several = any(len(e["seeds"]) > 1 for e in report["rigs"].values())
    many = "Figures are means over the seeds, with their range. " if several else ""
    fewer = [words for name, e in report["rigs"].items() for words in _with_fewer_seeds(name, e["seeds"])]
    many += f"Fewer seeds: {'; '.join(fewer)}. " if fewer else ""
    listed = "\n".join(sizes)
    return f"Size `{report['size']}`:\n\n{listed}\n\n{many}Lengths are in half sizes of the rig ([−1, 1]³). Rows:"


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
    return _PROTOCOL.format(natural_hand=NATURAL["hand"], more="" if size == "paper" else _PAPERS_SIZE, **given)


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
    """The commit that rows are of; of several, each with its rows, which are not to be compared as if they were of one."""
    of = {}
    for name, entry in report["rigs"].items():
        for seed, rows in entry["seeds"].items():
            for row, c in rows.items():
                commit, *changes = (c["environment"].get("commit") or "").partition("+")
                if commit:
                    of.setdefault("".join((commit[:12], *changes)), []).append(f"{name} {seed} {row}")
    if len(of) > 1:
        listed = "; ".join(f"{commit}: {', '.join(rows)}" for commit, rows in sorted(of.items()))
        return f"Rows are of several states of the code, by commit: {listed}. "
    return "".join(f"Commit {commit}; " for commit in of)


def _made_on(e):
    """Versions and machine of a row."""
    machine = f"{e['cpus']} CPUs" + (f" ({e['processor']})" if e["processor"] else "")
    libraries = f"numpy {e['numpy']}, scipy {e['scipy']}, scikit-learn {e['scikit-learn']}"
    return f"lbsfit_np {e['lbsfit_np']}, Python {e['python']}, {libraries}, {machine}"
