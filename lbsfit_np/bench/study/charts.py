"""Figures of numbers: the mixture that training poses are drawn from, the local optimum, the segmenter's accuracy over rounds."""

import numpy as np

from ...learning.mixture import Mixture
from ...report.fit_picture import axes_of
from ...report.render import Mesh, Points, render
from ...rig.chains import chains
from ...synthesis import Synthesis
from .canvas import GREY, INK, ROW_COLORS, axes_at, put, sheet
from .cells import kept_round
from .local_optimum import along_path, limbs, swings, target_scan
from .paper import GOALS

__all__ = ["accuracy", "local_optimum", "mixture"]

_N_POSES = 1000
_UNIFORM, _INFERRED = "#7f9fb5", "#d55e00"
_LEARNED = ("rand", "joint")


def mixture(shown, path):
    """Two angles of the training poses Θ': uniform, inferred with noise, and the mixture."""
    rig = shown.rig
    angles = _telling_angles(rig)
    if angles is None or not shown.train:
        return None
    inferred = np.stack([s.pose for s in shown.train])
    mixed, uniform = (
        np.stack([Mixture(rig, Synthesis(), poses, (), 0, 1).pose(i) for i in range(_N_POSES)])
        for poses in (inferred, np.empty((0, *rig.lower.shape)))
    )
    # The first draw is the same in both: where poses differ, the mixture took an inferred one.
    near = np.any(mixed != uniform, axis=(1, 2))
    (jx, ax), (jy, ay) = angles

    def xy(poses):
        return np.degrees(poses[:, jx, ax]), np.degrees(poses[:, jy, ay])

    sets = [
        ("(1) uniform within the limits", [(uniform[: _N_POSES // 2], _UNIFORM)]),
        (r"(2) $f(X_i)+\epsilon_i$", [(mixed[near], _INFERRED)]),
        (r"mixture, $\Theta'$", [(mixed[~near], _UNIFORM), (mixed[near], _INFERRED)]),
    ]
    low, high = np.degrees([rig.lower[jx, ax], rig.lower[jy, ay]]), np.degrees([rig.upper[jx, ax], rig.upper[jy, ay]])
    room = 0.06 * (high - low)
    limits = {"xlim": (low[0] - room[0], high[0] + room[0]), "ylim": (low[1] - room[1], high[1] + room[1])}
    corners = np.array([[0, 1, 1, 0, 0], [0, 0, 1, 1, 0]])
    side, aside, gap, left, top = 250, 46, 6, 62, 100
    with sheet(path, left + 3 * (side + aside + gap) + 2 * 34 + 14, top + side + 52) as figure:
        for k, (title, parts) in enumerate(sets):
            x = left + k * (side + aside + gap + 34)
            main = axes_at(figure, x, top, side, side, **limits)
            above = axes_at(figure, x, top - aside - gap, side, aside, xlim=limits["xlim"])
            beside = axes_at(figure, x + side + gap, top, aside, side, ylim=limits["ylim"])
            for marginal in (above, beside):
                marginal.axis("off")
            above.set_title(title)
            for poses, color in parts:
                main.scatter(*xy(poses), s=5, color=color, alpha=0.55, lw=0)
            if k:
                main.scatter(*xy(inferred), s=26, marker="+", color=INK, lw=1.1, zorder=3)
            colors = [color for _, color in parts]
            for ax_, d, orientation in ((above, 0, "vertical"), (beside, 1, "horizontal")):
                values = [xy(poses)[d] for poses, _ in parts]
                bins = np.linspace(low[d], high[d], 31)
                ax_.hist(values, bins=bins, color=colors, stacked=True, orientation=orientation)
            main.plot(low[0] + corners[0] * (high - low)[0], low[1] + corners[1] * (high - low)[1], color=GREY, lw=0.8, ls="--")
            main.set_xlabel(f"{_said(rig, jx)}, degrees")
            if k == 0:
                main.set_ylabel(f"{_said(rig, jy)}, degrees")
    return (
        f"The mixture distribution of training poses on the {shown.called}, two of its angles (bending at {_said(rig, jx)} and "
        f"{_said(rig, jy)}) with their marginals: (1) uniform within the limits (dashed), in half of the poses correlated, (2) "
        "poses inferred from scans (crosses) with uniform noise, and both in equal shares. Here the true poses of the training "
        "scans stand for inferred ones."
    )


def local_optimum(shown, path, steps=41):
    """Chamfer and structured Chamfer along the path, and the template at three points of it."""
    rig = shown.rig
    found = along_path(rig, steps=steps)
    if found is None:
        return None
    swing = next(s for s in swings(rig) if rig.joint_names[s.toward] == found["to"])
    points, _ = target_scan(rig, swing)
    plain, structured = (np.array(found[key]) / found[key][0] for key in ("chamfer", "structured"))
    t, top = np.array(found["t"]), int(np.argmax(found["chamfer"]))
    poses, chain = swing.poses(steps), chains(rig)
    colors = np.full((len(rig.vertices), 3), (224, 186, 164))
    led = np.isin(rig.vertex_labels, rig.part_of_joint[chain == chain[swing.joint]])
    colors[led] = (0, 114, 178)
    views = []
    scan = np.concatenate([points, *(rig.pose(poses[i]) for i in (0, -1))])
    # Where y is up, the upper part: the fingers of a hand.
    ends = scan[scan[:, 1] > np.quantile(scan[:, 1], 0.45)] if rig.up in (None, "+y") else scan
    for i in (0, top, steps - 1):
        items = Mesh(rig.pose(poses[i]), rig.faces, colors), Points(points, np.array((40, 40, 40)), 1.1)
        views.append(render(*items, size=(236, 200), view="front", **axes_of(rig), frame=ends))
    finger = " finger" if any("thumb" in name for name in rig.joint_names) else ""
    name, away, toward = (found[key].rstrip("0123456789") + finger for key in ("chain", "from", "to"))
    with sheet(path, 3 * 240 + 500, 310) as figure:
        for k, (view, title) in enumerate(zip(views, ("a: estimate", "b: on the way, $\\mathcal{L}_c$ highest", "c: target"))):
            put(figure, view, 10 + 240 * k, 60, title)
        ax = axes_at(figure, 3 * 240 + 75, 30, 380, 225, xlim=(-0.04, 1.04), ylim=(0, 1.12 * plain.max()))
        ax.axhline(1.0, color=GREY, lw=0.8, ls=":")
        ax.plot(t, plain, color=ROW_COLORS["cd"], lw=2)
        ax.plot(t, structured, color=ROW_COLORS["joint"], lw=2)
        ax.text(0.97, plain[-1] + 0.08, r"$\mathcal{L}_c$", color=ROW_COLORS["cd"], ha="right", fontsize=11)
        ax.text(0.3, structured[int(0.3 * steps)] + 0.06, r"$\mathcal{L}_s$", color=ROW_COLORS["joint"], fontsize=11)
        for i, letter in zip((0, top, steps - 1), "abc"):
            ax.plot(t[i], plain[i], "o", color=ROW_COLORS["cd"], ms=5)
            ax.annotate(letter, (t[i], plain[i]), xytext=(0, 6), textcoords="offset points", ha="center")
        ax.set_xticks([0, 1], [f"place of the {away}", "target"])
        ax.set_xlabel(f"path of the {name}", labelpad=-4)
        ax.set_ylabel("loss / loss at the start")
    falls = (np.diff(structured) <= 0).all()
    other = "falls all the way" if falls else f"never rises above {structured.max():.2f} times its own"
    return (
        f"A local optimum on the {shown.called}: dots are the target scan, on which the {name} lies beside the "
        f"{toward}; the estimate has it in the place of the {away}. On the way the Chamfer distance rises to "
        f"{found['rise']:.2f} times its value at the start; the structured one, with true labels, {other}."
    )


def accuracy(report, path):
    """Accuracy of labels on held-out scans over rounds, Random against Joint, one panel a rig."""
    lines = {name: _with_accuracies(entry) for name, entry in report["rigs"].items()}
    lines = {name: rows for name, rows in lines.items() if rows}
    if not lines:
        return None
    width, height = 370, 250
    least = min(100 * share for rows in lines.values() for cells in rows.values() for c in cells for share in c["accuracy"])
    goals = {name: GOALS["accuracy"].get(report["rigs"][name].get("kind")) for name in lines}
    with sheet(path, 20 + len(lines) * (width + 75), height + 120) as figure:
        for k, (name, rows) in enumerate(lines.items()):
            ax = axes_at(figure, 70 + k * (width + 75), 35, width, height, ylim=(5 * (least // 5), 100))
            if goals[name]:
                ax.axhline(100 * goals[name], color=GREY, lw=1.0, ls="--")
                where = {"x": 1.0, "y": 100 * goals[name], "transform": ax.get_yaxis_transform(), "ha": "right", "va": "center"}
                box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
                ax.text(s="goal of joint ", color=GREY, fontsize=8, zorder=4, bbox=box, **where)
            for row, cells in rows.items():
                color, seeds = ROW_COLORS[row], [100 * np.array(cell["accuracy"]) for cell in cells]
                for values, cell in zip(seeds, cells, strict=True):
                    ax.plot(values, color=color, lw=0.8, alpha=0.5)
                    kept = kept_round(cell)
                    ax.scatter([kept], [values[kept]], s=90, facecolors="none", edgecolors=color)
                rounds = min(map(len, seeds))
                mean = np.mean([values[:rounds] for values in seeds], axis=0)
                ax.plot(mean, color=color, lw=2, marker="o", ms=4, label=row)
            most = max(len(cell["accuracy"]) for cells in rows.values() for cell in cells)
            ax.set_xticks(range(most), ["before", *map(str, range(1, most))])
            ax.set_xlabel("round")
            if k == 0:
                ax.set_ylabel("points in the right group of parts, %")
            ax.set_title(name)
            ax.grid(axis="y", color="#e6e6e6", lw=0.8)
            ax.set_axisbelow(True)
        figure.legend(*ax.get_legend_handles_labels(), loc="lower center", ncol=len(_LEARNED))
    several = any(len(cells) > 1 for rows in lines.values() for cells in rows.values())
    scans = " and ".join(f"{report['rigs'][name]['size']['test']} of the {name}" for name in lines)
    return (
        f"Segmentation accuracy of the segmenter alone on scans of held-out shapes ({scans}), before the first round and after "
        "each: the one that learns from uniform poses only (rand, the paper's Random) and the one that learns from inferred "
        "poses and templates, too (joint). Rings: the round that was kept, by the fits' loss on scans held out of learning."
        + " Thin lines are seeds." * several
    )


def _with_accuracies(entry):
    """row → its cells that have accuracies over rounds, over the seeds; empty unless both rows are there."""
    rows = {}
    for row in _LEARNED:
        found = [cells[row] for cells in entry["seeds"].values() if cells.get(row, {}).get("accuracy")]
        if found:
            rows[row] = found
    return rows if len(rows) == 2 else {}


def _telling_angles(rig):
    """((joint, axis), (joint, axis)): the widest angles of the first two joints of a limb; None without one.

    Of the limb where these are widest; where several are alike, of the longest.
    """
    chain, room = chains(rig), rig.upper - rig.lower
    best = None
    for c, limb in limbs(rig).items():
        joints = np.flatnonzero((chain == c) & rig.moving)[:2]
        rank = (round(float(room[joints].max(axis=1).sum()), 6), limb.length)
        if len(joints) == 2 and (best is None or rank > best[0]):
            best = rank, tuple((int(j), int(room[j].argmax())) for j in joints)
    return best and best[1]


def _said(rig, joint):
    return rig.joint_names[joint].replace("_", " ")
