"""The study's page: its tables in Markdown, beside the paper's, written from the report and nothing else."""

from itertools import pairwise

import numpy as np

from ..table import layout
from .rows import ROWS

__all__ = ["FIGURES", "GOALS", "PAPER", "console_table", "kept_round", "page"]

# Kinds of figures, in reading order.
FIGURES = (
    *("diagram", "triplet", "partitions", "mixture", "local-optimum"),
    *("accuracy", "ablation", "gallery", "correspondence"),
)

# Table 1 of the paper: Recon, Pose, Corre.
PAPER = {
    "hand": {
        "free-form": (0.099, 0.035, 0.176),
        "free-form-augmented": (0.069, 0.049, 0.140),
        "free-form-supervised": (0.062, 0.047, 0.135),
        "cd": (0.082, 0.069, 0.168),
        "rand": (0.069, 0.050, 0.137),
        "joint": (0.053, 0.035, 0.111),
    },
    "body": {
        "free-form": (0.076, 0.082, 0.136),
        "free-form-augmented": (0.081, 0.081, 0.132),
        "free-form-supervised": (0.073, 0.071, 0.104),
        "free-form-supervised-3x": (None, None, 0.095),
        "cd": (0.051, 0.152, 0.147),
        "rand": (0.041, 0.058, 0.100),
        "joint": (0.037, 0.048, 0.091),
    },
}
# Corre. on the training set, of bodies.
_PAPER_ON_TRAINING = {"free-form-supervised": 0.065, "joint": 0.069}
# To be reached by joint: Recon ÷ its value at the truth, Pose, Corre. before the snap; labels; template gap ÷ gap before.
GOALS = {"ratio": 1.05, "pose": 0.020, "corre": 0.030, "accuracy": {"hand": 0.95, "body": 0.96}, "gap": 0.5}

_INTRODUCTION = """\
# The paper's study

Written by `lbsfit bench study`; change that command, not this page. Every experiment of LBS-AE (CVPR 2019) in its
classical form: the paper's networks are fits and small scikit-learn models here, what else differs stands below. The
paper's figures, where it has them, stand in square brackets.

Scans X of made people are registered, and what is found is compared with the truth. U is the rig's template, U^gt the true
one of a person, U^d what a fit made of U; Θ are the angles of the joints. Goals are this project's own.
"""

_COLUMNS = """\
Columns of the tables; means over the test scans, the paper's figures in square brackets:

- **Recon**: √L_c, L_c the Chamfer distance between scan and registered vertices. **at the truth**: its value at the true mesh
  on the same scan. **÷**: one by the other, below 1 where a fit follows the scan's noise and missing areas more closely.
- **Pose**: ‖joints − true joints‖, mean over the unlocked ones, and its **median** over the scans. Joints of free-form rows
  are regressed from the vertices.
- **Corre.**: how far from its true place on scan B a point of scan A is carried by the two registrations: mean and percentiles
  over all points of all pairs of scans. **snapped**: the same after the step to the nearest point of B.
- **vertices**: ‖registered − true vertices‖. **unfitted**: scans without a fit, which all these leave out. **s**: of learning
  and all fits of the row, pretraining not counted; – of a row that found steps of a run that was stopped. What rows
  of one run have in common counts in the first of these: the training scans' fits by themselves, where labels teach, and those
  from the template without skinning.

Below each table: in the order of the ablations, ≈ stands between rows that are nearer to each other than 3 %; an order with such
rows is level, and does not reach what was to be reached any more than one that is missed. The **template gap** is ‖U^d − U^gt‖,
mean over the vertices in the rest pose, U^d grown by its scale about the root joint, and the same with both moved to a
common centre ("up to a shift"), as no scan shows where the rest pose stands; before is ‖U − U^gt‖.
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
  does. The people of the test are others than those learned from, so that each of their
  scans is fitted as somebody else's, on U with proportions of its own: templates that were learned show in the figures of the
  training scans and in `lbsfit bench learn`, not in the tables.
- Scans: {n_points} points, one or two missing areas, uneven density, noise of {noise:g}; they face the rig's way up to
  what the root joint may turn. Lengths are in half sizes of the rig, so that the template fills [−1, 1]³; the paper
  scales every shape to it.
- Learning is told which training scans are of one person, who share a template; the paper's is not. Test scans come without.
  Three times the data has three times as many people, too.
- Seeds are of the scans; what is trained has one seed, so that ranges over seeds say nothing of training.
- Labels: the paper's segmenter learns from uniform poses of U, and the gaps between its rows are what that leaves open. Here, in
  all rows, half of the uniform poses are correlated, so that fists occur, and bones of U are lengthened and thickened at random,
  as the shipped training does: part of both gaps is closed before anything is learned.
- Rounds: poses are found by Levenberg–Marquardt steps on distances to the surface, from labels, from the library and from f;
  the whole objective (Chamfer, structured Chamfer, Laplacian) ends each fit after the last round. Templates of a round are made
  before its segmenter learns, so that rows that keep the first round have the same templates.
- The free-form rows play 3D-CODED's part: the template's vertices move under Chamfer and Laplacian, from the template,
  from the best of several synthetic scans that look alike ("augmented"), or from what a regressor says that was taught
  with true vertices ("supervised"). Taught by few scans, it knows these alone: compare its row with its figures on the
  training scans. 3D-CODED is a network that has seen thousands of shapes and so knows what bodies look like; here the first two
  deform a resting template scan by scan, without any such knowledge, and do worse where limbs are far from rest.
- Recon is compared with its value at the true mesh on the same scan, as √CD is not 0 there. Corre. carries points of
  scan A by their closest surface point on A's registration to B's, {points} points of each; "snapped" goes on to the
  nearest point of scan B, as the paper does.
- Size "{size}": the paper learns from 1,500 hands and 23,000 bodies and tests on 300 and 2,300{more}.
"""
# Of all sizes but "paper".
_PAPERS_SIZE = "; `--size paper` is\n  there for that, and has not been run"


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
    parts = [_INTRODUCTION, _sizes(report), _rows(report), _COLUMNS]
    for name in report["rigs"]:
        parts += [f"## {name.capitalize()}", _main(report, name, markdown=True), _reached(report, name), _more(report, name)]
    parts.append(_protocol(report))
    if captions:
        parts.append("## Figures")
        files = sorted(captions, key=_place)
        parts += [f"![{file.removesuffix('.png')}]({file})\n\n{captions[file]}" for file in files]
    parts.append(_provenance(report))
    return "\n\n".join(p.strip("\n") for p in parts if p) + "\n"


def console_table(report, *, markdown=False):
    """The main table of each rig, and what was to be reached."""
    parts = []
    for name in report["rigs"]:
        parts += [name, _main(report, name, markdown=markdown), _reached(report, name)]
    return "\n\n".join(filter(None, parts))


def _place(file):
    """Of a picture on the page: by its kind, then by its rig."""
    kinds = [k for k, kind in enumerate(FIGURES) if file.startswith(kind)]
    return (kinds or [len(FIGURES)])[0], file


def _rows(report):
    """What the rows are that were run."""
    run = [row for row in ROWS if any(_cells(report, name, row) for name in report["rigs"])]
    return "\n".join(f"- **{row}**: {_described(row)}." for row in run)


def _described(row):
    paper = ROWS[row].paper
    return ROWS[row].what + (f" (the paper's {paper})" if paper else "")


# ---- tables ----


def _main(report, name, *, markdown):
    paper = PAPER.get(report["rigs"][name]["kind"], {})
    carried = ("p50", "p90", "p95")
    heads = ("Recon", "at the truth", "÷", "Pose", "median", "Corre.", *carried, "snapped", *carried, "vertices", "unfitted", "s")
    lines = [("", *heads)]
    for row in ROWS:
        cells = _cells(report, name, row)
        if not cells:
            continue
        known = paper.get(row, (None,) * 3)
        ratio = [c["recon"] / c["recon_truth"] for c in cells if "recon" in c]
        lines.append(
            (
                row,
                _with(_over(cells, "recon"), known[0]),
                _over(cells, "recon_truth"),
                _number(ratio, ".2f"),
                _with(_over(cells, "pose"), known[1]),
                _over(cells, "pose_median"),
                _with(_over(cells, "corre", "mean"), known[2]),
                *(_over(cells, "corre", p) for p in carried),
                _with(_over(cells, "corre_snapped", "mean"), known[2]),
                *(_over(cells, "corre_snapped", p) for p in carried),
                _over(cells, "vertices"),
                str(sum(c["unfitted"] for c in cells)),
                _number(_seconds(cells), ".0f"),
            )
        )
    return layout(lines, markdown=markdown)


def _more(report, name):
    """Training scans, labels and templates."""
    lines = []
    for row, known in _PAPER_ON_TRAINING.items():
        cells = [c["on_training"] for c in _cells(report, name, row) if "on_training" in c]
        if cells:
            paper = f" (paper, bodies: {known})"
            text = f"- On the training scans, {row}: Corre. {_over(cells, 'corre', 'mean')}{paper}, Pose {_over(cells, 'pose')}."
            lines.append(text)
    for row in ("rand", "pose-only", "joint"):
        cells = [c for c in _cells(report, name, row) if c["accuracy"]]
        if cells:
            first, kept = [c["accuracy"][0] for c in cells], [c["kept_accuracy"] for c in cells]
            spread = f"{np.mean(first):.1%} before learning, {np.mean(kept):.1%} as kept ({_rounds(cells)})"
            fits = [c["fitted_labels"] for c in cells if c.get("fitted_labels") is not None]
            more = f"; of its fits {np.mean(fits):.1%}" if fits else ""
            lines.append(f"- Labels of the segmenter alone on test scans, chains of joints as parts, {row}: {spread}{more}.")
    for row in ("cd", "rand", "pose-only", "joint"):
        cells = [c["gap"] for c in _cells(report, name, row) if c["gap"]]
        for whose in ("subjects", "test scans"):
            both = [c[whose] for c in cells if whose in c]
            if both:
                gaps = {key: _over(both, key) for key in both[0]}
                text = f"‖U − U^gt‖ {gaps['before']}, ‖U^d − U^gt‖ {gaps['after']} (paper, bodies: 0.03 and 0.02); up to a shift"
                shift = f"of all vertices {gaps['before, up to a shift']} and {gaps['after, up to a shift']}"
                lines.append(f"- Templates of the {whose}, {row}: {text} {shift}.")
    path = report["rigs"][name].get("local_optimum")
    if path:
        low = max(np.divide(path["structured"], path["structured"][0]))
        swing = f"- The {path['chain']} chain swung from {path['from']}'s place to beside {path['to']}"
        rise = f"L_c rises to {path['rise']:.2f} times its start before it falls, L_s never above {low:.2f} times its own"
        lines.append(f"{swing}: {rise}.")
    both = [(key, what, _compared(report, name, ("joint", "oracle-fit"), key)) for key, what in _MEASURES]
    means = [(what, *(_mean(cells, key) for cells in rows.values())) for key, what, rows in both if len(rows) == 2]
    shares = [f"{what} {joint / oracle:.2f}" for what, joint, oracle in means if oracle > 0]
    if shares:
        lines.append(f"- Joint ÷ oracle fit: {', '.join(shares)}.")
    floor = [c["pose_truth"] for c in _cells(report, name, "joint") if "pose_truth" in c]
    if floor:
        words = "of the exact template in the exact pose, with the joint regressor's joints where people have their own"
        lines.append(f"- Pose {words}: {np.mean(floor):.4f}. A fit's Pose can be less: its angles make up for the joints.")
    return "\n".join(lines)


def _reached(report, name):
    """What joint was to reach, and the order of the ablations."""
    cells, kind = [c for c in _cells(report, name, "joint") if "pose" in c], report["rigs"][name]["kind"]
    orders = "\n\n".join(filter(None, (_order(report, name, key, what) for key, what in _ORDERED)))
    if not cells or kind not in PAPER:  # the goals are for hands and bodies
        return orders
    found = [
        ("Recon ÷ its value at the truth", np.mean([c["recon"] / c["recon_truth"] for c in cells]), GOALS["ratio"], "≤"),
        ("Pose", _mean(cells, "pose"), GOALS["pose"], "≤"),
    ]
    if _with_measure(cells, "corre"):
        found.append(("Corre. before the snap", _mean(cells, "corre"), GOALS["corre"], "≤"))
    labels = [c["kept_accuracy"] for c in cells if c.get("kept_accuracy") is not None]
    if labels:
        found.append(("labels of the segmenter alone", np.mean(labels), GOALS["accuracy"][kind], "≥"))
    gaps = [c["gap"]["subjects"] for c in cells if c["gap"]]
    for more in ("", ", up to a shift") if gaps else ():
        share = np.mean([g["after" + more] / g["before" + more] for g in gaps])
        found.append((f"template gap of the people learned from ÷ before{more}", share, GOALS["gap"], "≤"))
    others = [c["gap"]["test scans"] for c in cells if "test scans" in c["gap"]]
    if others:
        share = np.mean([g["after"] / g["before"] for g in others])
        found.append(("of the test scans, of other people, one scan each,", share, GOALS["gap"], "≤"))
    words = []
    for what, value, goal, sign in found:
        met = value <= goal if sign == "≤" else value >= goal
        words.append(f"{what} {value:.3f} (goal {sign} {goal:g}{'' if met else ', missed'})")
    fitted = [c["fitted_labels"] for c in cells if c.get("fitted_labels") is not None]
    if fitted:
        words.append(f"labels of its fits {np.mean(fitted):.3f}")
    trained = report["rigs"][name]["size"]["training_scans"]
    told = f"The segmenters had {trained:,} synthetic scans before learning, and as many in each round."
    return f"Joint: {'; '.join(words)}. {told}\n\n{orders}"


def _order(report, name, key, what):
    """The ablations from the best to the worst by a measure, and whether that is the paper's order."""
    compared = _compared(report, name, _ORDER, key)
    ranked = sorted((_mean(found, key), row) for row, found in compared.items())
    if len(ranked) < 2:
        return ""
    scans = report["rigs"][name]["size"]["test"] * len(next(iter(compared.values())))
    values = {row: value for value, row in ranked}
    wanted = [row for row in ("joint", "rand", "cd") if row in values]
    verdict = _verdict([values[row] for row in wanted])
    medians = _MEDIANS.get(key)
    if medians and all(_value(c, medians) is not None for row in wanted for c in compared[row]):
        middle = _verdict([_mean(compared[row], medians) for row in wanted])
        verdict += f" by the means, {middle} by the medians" if middle != verdict else ""
    if scans < _TELLING:
        verdict += f", of {scans} scans, which are few"
    words = ranked[0][1] + f" {ranked[0][0]:.4f}"
    for (a, _), (b, row) in pairwise(ranked):
        words += f" {'<' if _LEVEL * a < b else '≈'} {row} {b:.4f}"
    more = f" (the paper's order, {' before '.join(wanted)}: {verdict})" if len(wanted) > 1 else ""
    return f"{what}, from the best of the ablations to the worst: {words}{more}."


def _verdict(values):
    """Whether values in the paper's order rise: "kept", "missed", or "level" where some are too near to each other to tell."""
    if any(a > _LEVEL * b for a, b in pairwise(values)):
        return "missed"
    return "kept" if all(_LEVEL * a < b for a, b in pairwise(values)) else "level"


def _mean(cells, key):
    """Over the seeds."""
    return np.mean([_value(c, key) for c in _with_measure(cells, key)])


def _with_measure(cells, key):
    """Those that have it: nothing fitted has none, a single fit no correspondences."""
    return [c for c in cells if _value(c, key) is not None]


def _value(cell, key):
    """A measure of a cell, None where it has none; of one with percentiles, its mean."""
    if key == "label errors":
        return None if cell.get("kept_accuracy") is None else 1.0 - cell["kept_accuracy"]
    if key == "corre median":
        return (cell.get("corre") or {}).get("p50")
    value = cell.get(key)
    return value["mean"] if isinstance(value, dict) else value


_MEASURES = (("recon", "Recon"), ("pose", "Pose"), ("corre", "Corre."), ("vertices", "vertices"))
# What the ablations are ordered by, and the medians over scans that an order is to hold in, too.
_ORDERED = (*_MEASURES[:3], ("label errors", "Label errors of the segmenter alone"))
_MEDIANS = {"pose": "pose_median", "corre": "corre median"}
_ORDER = ("joint", "pose-only", "rand", "cd")
# What is nearer to each other than by this factor is level.
_LEVEL = 1.03
# Over fewer test scans than these, one of them decides the order.
_TELLING = 20


def _sizes(report):
    sizes = [
        f"{name}: {e['size']['train']} scans of {e['size']['train_subjects']} people to learn from, {e['size']['test']} of "
        f"{e['size']['test_subjects']} others to be tested on, seed{'s' * (len(e['seeds']) > 1)} {', '.join(e['seeds'])}"
        for name, e in report["rigs"].items()
    ]
    several = any(len(e["seeds"]) > 1 for e in report["rigs"].values())
    many = "Figures are means over the seeds, with their range. " if several else ""
    fewer = [words for name, e in report["rigs"].items() for words in _with_fewer_seeds(name, e["seeds"])]
    many += f"Fewer seeds: {'; '.join(fewer)}. " if fewer else ""
    return (
        f"Size `{report['size']}`; {'; '.join(sizes)}. {many}Lengths are in half sizes of the rig ([−1, 1]³)."
    )


def _with_fewer_seeds(name, seeds):
    """"hand, cd: 300 alone" of each row that not all seeds have."""
    for row in ROWS:
        has = [seed for seed, rows in seeds.items() if row in rows]
        if 0 < len(has) < len(seeds):
            yield f"{name}, {row}: {', '.join(has)}" + (" alone" if len(has) == 1 else "")


def _protocol(report):
    from .data import NATURAL
    from .measures import POINTS

    scan, size = report["scan"], report["size"]
    more = "" if size == "paper" else _PAPERS_SIZE
    given = {"n_points": scan["n_points"], "noise": scan["noise"], "size": size, "more": more}
    return _PROTOCOL.format(natural_hand=NATURAL["hand"], points=POINTS, **given)


def _provenance(report):
    e = report["environment"]
    versions = f"Python {e['python']}, numpy {e['numpy']}, scipy {e['scipy']}, scikit-learn {e['scikit-learn']}"
    machine = f"{e['cpus']} CPUs" + (f" ({e['processor']})" if e["processor"] else "")
    cells = [c for rig in report["rigs"].values() for rows in rig["seeds"].values() for c in rows.values()]
    commits = sorted({c["commit"][:12] for c in cells if c.get("commit")})
    commit = f", commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}" if commits else ""
    jobs = sorted({c["jobs"] for c in cells})
    of, timed = len(cells), _seconds(cells)
    rows = "all" if len(timed) == of else f"{len(timed)} of {of}"
    took = f"{sum(timed) / 60:.1f} min for {rows} rows" if timed else "not timed"
    took += f", with {' or '.join(map(str, jobs))} process{'es' * (jobs != [1])}"
    known = "`results.json` beside this page has every figure."
    return f"---\n\nlbsfit_np {e['lbsfit_np']}{commit}; {versions}; {machine}; {took}. {known}"


# ---- cells ----


def _cells(report, name, row):
    return [rows[row] for rows in report["rigs"][name]["seeds"].values() if row in rows]


def _compared(report, name, rows, key):
    """Row → its cells of the seeds in which all of these rows have a measure: only these can be compared.

    Rows that have it in no seed are left out first; empty where no seed is left.
    """
    rows = [row for row in rows if _with_measure(_cells(report, name, row), key)]
    found = [[_with_measure([done.get(row, {})], key) for row in rows] for done in report["rigs"][name]["seeds"].values()]
    seeds = [cells for cells in found if all(cells)]
    return {row: [cells[k][0] for cells in seeds] for k, row in enumerate(rows)} if seeds else {}


def _over(cells, *keys):
    values = []
    for cell in cells:
        for key in keys:
            cell = None if cell is None else cell.get(key)
        if cell is not None:
            values.append(cell)
    return _number(values, ".4f")


def _number(values, style):
    """Mean, and the range where there are several."""
    if not values:
        return "–"
    text = format(np.mean(values), style)
    return text if len(values) == 1 else f"{text} ({format(min(values), style)}–{format(max(values), style)})"


def _seconds(cells):
    """Of the rows that were made at one go."""
    return [c["seconds"] for c in cells if c["seconds"] is not None]


def _with(text, paper):
    return text if paper is None else f"{text} [{paper:.3f}]"


def _rounds(cells):
    """Which round was kept, of how many."""
    kept = sorted({(kept_round(c), len(c["accuracy"]) - 1) for c in cells})
    return "round " + ", ".join(f"{k} of {n}" for k, n in kept)


def kept_round(cell):
    """The round whose segmenter was kept."""
    return next(entry["round"] for entry in cell["history"] if entry["kept"])
