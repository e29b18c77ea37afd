"""The study's tables of one rig, beside the paper's figures: registrations, correspondences, labels, templates, goals, orders."""

from itertools import pairwise

import numpy as np

from ..table import layout
from .cells import cells_of, compared, kept_round, mean, number, over, value, with_measure
from .paper import GOALS, OF_GAPS, ON_TRAINING, PAPER
from .rows import ROWS

__all__ = ["correspondences", "goals", "labels", "more", "orders", "registrations", "templates", "timed"]

_MEASURES = (("recon", "Recon"), ("pose", "Pose"), ("corre", "Corre."), ("vertices", "vertices"))
# What the ablations are ordered by, and the medians that an order is to hold in, too.
_ORDERED = (
    ("recon above the truth", "Recon ÷ its value at the truth, 1 where it is less", ".2f"),
    ("pose", "Pose", ".4f"),
    ("corre", "Corre.", ".4f"),
    ("label errors", "Label errors of the segmenter alone", ".4f"),
)
# Those that scans have without a fit, too.
_WITHOUT_FITS = ("label errors",)
_MEDIANS = {"pose": "pose_median", "corre": "corre median"}
_ABLATIONS, _PAPERS_ORDER = ("joint", "pose-only", "rand", "cd"), ("joint", "rand", "cd")
# What is nearer to each other than by this factor is level.
_LEVEL = 1.03
# Over fewer test scans than these, one of them decides the order.
_TELLING = 20
_PERCENTILES = ("p50", "p90", "p95")


def registrations(report, name, *, markdown):
    """How near the registrations are."""
    lines = [("", "Recon", "at the truth", "÷", "Pose", "median", "vertices", "unfitted", "s")]
    for row, cells, (recon, pose, _) in _rows(report, name):
        lines.append(
            (
                row,
                _with(over(cells, "recon"), recon),
                over(cells, "recon_truth"),
                number([c["recon"] / c["recon_truth"] for c in cells if "recon" in c], ".2f"),
                _with(over(cells, "pose"), pose),
                over(cells, "pose_median"),
                over(cells, "vertices"),
                str(sum(c["unfitted"] for c in cells)),
                number(timed(cells), ".0f"),
            )
        )
    return layout(lines, markdown=markdown)


def correspondences(report, name, *, markdown):
    """How far off their places points are carried; empty where no row has two fits."""
    lines = [("", "Corre.", *_PERCENTILES, "snapped", *(f"snapped {p}" for p in _PERCENTILES))]
    for row, cells, (_, _, known) in _rows(report, name):
        if with_measure(cells, "corre"):
            figures = [[over(cells, which, p) for p in _PERCENTILES] for which in ("corre", "corre_snapped")]
            before, snapped = (_with(over(cells, which, "mean"), known) for which in ("corre", "corre_snapped"))
            lines.append((row, before, *figures[0], snapped, *figures[1]))
    return layout(lines, markdown=markdown) if len(lines) > 1 else ""


def labels(report, name, *, markdown):
    """The share of right labels; empty where no row has a segmenter."""
    lines = [("", "before learning", "as kept", "single scans", "round kept", "labels of its fits")]
    for row in ROWS:
        cells = [c for c in cells_of(report, name, row) if c["accuracy"]]
        if cells:
            single = [share for c in cells for share in c["kept_accuracy_scans"] if share is not None]
            lines.append(
                (
                    row,
                    number([c["accuracy"][0] for c in cells], ".1%"),
                    over(cells, "kept_accuracy", style=".1%"),
                    f"{min(single):.0%} to {max(single):.0%}",
                    ", ".join(f"{k} of {n}" for k, n in sorted({(kept_round(c), len(c["accuracy"]) - 1) for c in cells})),
                    over(cells, "fitted_labels", style=".1%"),
                )
            )
    return layout(lines, markdown=markdown) if len(lines) > 1 else ""


def templates(report, name, *, markdown):
    """How far templates are from the true ones; empty where no row learns any."""
    lines = [("", "whose", "before", "after", "÷", "before, up to a shift", "after", "÷")]
    for row in ROWS:
        cells = [c["gap"] for c in cells_of(report, name, row) if c["gap"]]
        for whose, called in (("subjects", "people learned from"), ("test scans", "test scans")):
            gaps = [c[whose] for c in cells if whose in c]
            if gaps:
                figures = [
                    (over(gaps, "before" + of), over(gaps, "after" + of), number([_share(g, of) for g in gaps], ".2f"))
                    for of in ("", ", up to a shift")
                ]
                lines.append((row, called, *figures[0], *figures[1]))
    return layout(lines, markdown=markdown) if len(lines) > 1 else ""


def goals(report, name, *, markdown):
    """What joint was to reach; empty where it was not run, or where the rig is no hand and no body."""
    cells, kind = with_measure(cells_of(report, name, "joint"), "pose"), report["rigs"][name]["kind"]
    if not cells or kind not in PAPER:
        return ""
    known = [
        ("Recon ÷ its value at the truth", [c["recon"] / c["recon_truth"] for c in cells], "≤", GOALS["ratio"], ".2f"),
        ("Pose", [c["pose"] for c in cells], "≤", GOALS["pose"], ".4f"),
        ("Pose, aim beyond the goal", [c["pose"] for c in cells], "≤", GOALS["pose aim"], ".4f"),
        ("Corre. before the snap", [value(c, "corre") for c in with_measure(cells, "corre")], "≤", GOALS["corre"], ".4f"),
        ("labels of the segmenter alone", _there(cells, "kept_accuracy"), "≥", GOALS["accuracy"][kind], ".3f"),
    ]
    gaps = {whose: [c["gap"][whose] for c in cells if whose in c["gap"]] for whose in ("subjects", "test scans")}
    paper = f"(the paper's bodies: {OF_GAPS[1] / OF_GAPS[0]:.2f})"
    for called, whose, of in (
        (f"template gap of the people learned from, ÷ before {paper}", "subjects", ""),
        ("the same up to a shift", "subjects", ", up to a shift"),
        ("template gap of the test scans, each a template of its own, ÷ before", "test scans", ""),
    ):
        known.append((called, [_share(g, of) for g in gaps[whose]], "≤", GOALS["gap"], ".2f"))
    lines = [("row joint", "found", "goal", "reached")]
    for what, values, sign, goal, style in known:
        if values:
            met = np.mean(values) <= goal if sign == "≤" else np.mean(values) >= goal
            lines.append((what, number(values, style), f"{sign} {goal:g}", "yes" if met else "no"))
    made, n = layout(lines, markdown=markdown), len(cells)
    if lost := sum(c.get("unfitted", 0) for c in cells_of(report, name, "joint")):
        made += f"\n\nWithout {lost} scan{'s' * (lost > 1)} that could not be fitted."
    if n < GOALS["seeds"]:
        made += f"\n\nThe goals are for {GOALS['seeds']} seeds; here {'is one' if n == 1 else f'are {n}'}."
    return made


def orders(report, name):
    """The ablations from the best to the worst, and whether that is the paper's order; empty without two of them."""
    found = [line for key, what, style in _ORDERED if (line := _order(report, name, key, what, style))]
    if not found:
        return ""
    return "\n".join(["The ablations from the best to the worst, and what that makes of the paper's order:", "", *found])


def more(report, name):
    """Training scans, the way out of a local optimum, and what joint is compared with."""
    lines = []
    for row, known in ON_TRAINING.items():
        cells = [c["on_training"] for c in cells_of(report, name, row) if "on_training" in c]
        if cells:
            paper = f" [{known:.3f}]" if report["rigs"][name]["kind"] == "body" else ""
            found = f"Corre. {over(cells, 'corre', 'mean')}{paper}, Pose {over(cells, 'pose')}"
            lines.append(f"- On the training scans, {row}: {found}.")
    path = report["rigs"][name].get("local_optimum")
    if path:
        falls = (np.diff(path["structured"]) <= 0).all()
        swing = f"- Where the chain {path['chain']} swings from the place of {path['from']} to beside {path['to']}"
        other = "falls" if falls else f"never rises above {path['structured_rise']:.2f} times its own"
        lines.append(f"{swing}, L_c rises to {path['rise']:.2f} times its value at the start before it falls; L_s {other}.")
    else:
        lines.append("- No chain lies between two others that it could be mistaken for, so no local optimum is drawn.")
    both = [(key, what, compared(report, name, ("joint", "oracle-fit"), key)) for key, what in _MEASURES]
    means = [(what, *(mean(cells, key) for cells in rows.values())) for key, what, rows in both if len(rows) == 2]
    shares = [f"{what} {joint / oracle:.2f}" for what, joint, oracle in means if oracle > 0]
    if shares:
        lines.append(f"- Joint ÷ oracle fit: {', '.join(shares)}.")
    floor = _there(cells_of(report, name, "joint"), "pose_truth")
    if floor:
        words = "of the exact template in the exact pose, with the joint regressor's joints where people have their own"
        lines.append(f"- Pose {words}: {np.mean(floor):.4f}. A fit's Pose can be less: its angles make up for the joints.")
    return "\n".join(lines)


def timed(cells):
    """Seconds of the rows that were made at one go."""
    return [c["seconds"] for c in cells if c["seconds"] is not None]


def _rows(report, name):
    """(row, its cells, the paper's Recon, Pose and Corre. or None) of what was run."""
    paper = PAPER.get(report["rigs"][name]["kind"], {})
    for row in ROWS:
        cells = cells_of(report, name, row)
        if cells:
            yield row, cells, paper.get(row, (None,) * 3)


def _order(report, name, key, what, style):
    """The ablations from the best to the worst by a measure, and whether that is the paper's order."""
    rows = compared(report, name, _ABLATIONS, key)
    ranked = sorted((mean(found, key), row) for row, found in rows.items())
    if len(ranked) < 2:
        return ""
    words = f"{ranked[0][1]} {ranked[0][0]:{style}}"
    for (a, _), (b, row) in pairwise(ranked):
        words += f" {'<' if _LEVEL * a < b else '≈'} {row} {b:{style}}"
    wanted = [row for row in _PAPERS_ORDER if row in rows]
    if len(wanted) < 2:
        return f"- {what}: {words}."
    verdict = _verdict([mean(rows[row], key) for row in wanted])
    medians = _MEDIANS.get(key)
    if medians and all(value(c, medians) is not None for row in wanted for c in rows[row]):
        middle = _verdict([mean(rows[row], medians) for row in wanted])
        verdict += f" by the means, {middle} by the medians" if middle != verdict else ""
    scans = report["rigs"][name]["size"]["test"] * len(next(iter(rows.values())))
    few = f", of {scans} scans, which are few" if scans < _TELLING else ""
    of_fits = {} if key in _WITHOUT_FITS else rows
    lacking = [f"{row} {lost}" for row, found in of_fits.items() if (lost := sum(c.get("unfitted", 0) for c in found))]
    without = f" Without scans that could not be fitted: {', '.join(lacking)}." if lacking else ""
    return f"- {what}: {words}. {' before '.join(wanted).capitalize()}: {verdict}{few}.{without}"


def _verdict(values):
    """Whether values in the paper's order rise: "kept", "missed", or "level" where some are too near to each other to tell."""
    if any(a > _LEVEL * b for a, b in pairwise(values)):
        return "missed"
    return "kept" if all(_LEVEL * a < b for a, b in pairwise(values)) else "level"


def _there(cells, key):
    return [c[key] for c in cells if c.get(key) is not None]


def _share(gap, of):
    return gap["after" + of] / gap["before" + of]


def _with(text, paper):
    return text if paper is None else f"{text} [{paper:.3f}]"
