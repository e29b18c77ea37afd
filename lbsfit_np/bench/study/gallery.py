"""Figures of rendered scans and meshes: the LBS triplet, partitions, the ablations, galleries, correspondence in colour."""

import numpy as np

from ...correspondence import at_places, surface_places, transfer
from ...report.colors import part_colors
from ...report.fit_picture import axes_of
from ...report.render import Mesh, Points, render
from .canvas import tiles
from .data import part_groups
from .measures import true_places

__all__ = ["ablation", "correspondence", "gallery", "partitions", "triplet"]

SKIN = (224, 186, 164)
# Width and height of tiles, pixels: of many, of few; and the radius of points in them.
_TILE, _LARGE = (150, 178), (236, 276)
_RADIUS = {_TILE: 1.35, _LARGE: 1.9}
_N_SCANS = 4


def triplet(shown, path):
    """Template, posed, deformed, both, beside the scan: of the better half of the fits, that whose person differs most."""
    rig, scans, half = shown.rig, shown.test, shown.rig.size / 2
    fits = shown.cells.get("joint", {})
    if "template" in fits:
        ranked = [i for i in shown.from_worst_to_best("joint", len(scans)) if i < len(fits["template"])]
    else:
        ranked = list(range(len(scans)))
    if not ranked:
        return None
    changed = {i: np.linalg.norm(scans[i].template - rig.vertices, axis=1).mean() / half for i in ranked[len(ranked) // 2 :]}
    i = max(changed, key=lambda k: round(changed[k], 6))
    scan = scans[i]
    if "template" in fits:
        posed, template, vertices = (fits[key][i] for key in ("posed", "template", "vertices"))
    else:
        posed, template, vertices = rig.pose(scan.pose, scan.translation, scan.scale), scan.template, scan.vertices
    rest, frame = np.concatenate([rig.vertices, template]), np.concatenate([posed, vertices, scan.points])
    row = [
        *(_mesh(rig, U, size=_LARGE, view="oblique", frame=rest) for U in (rig.vertices, template)),
        *(_mesh(rig, V, size=_LARGE, view="oblique", frame=frame) for V in (posed, vertices)),
        _points(rig, scan.points, None, size=_LARGE, view="oblique", frame=frame),
    ]
    titles = ["template $U$", "deformed, $U^d$", "posed, $V$", "posed and deformed, $V^d$", "scan $X$"]
    tiles(path, [row], titles=titles)
    whose = "what the whole loop found for the scan" if "template" in fits else "the scan's true ones"
    return (
        f"Linear blend skinning of the {shown.called}: the template U; deformed, U^d; posed, V = M(Θ, U); posed and deformed, "
        f"V^d = M(Θ, U^d); a held-out scan X. Θ and U^d are {whose}."
    )


def partitions(shown, path):
    """The template by part and by group of parts, two sides."""
    rig = shown.rig
    groups, labels = part_groups(rig), rig.vertex_labels
    row = []
    for colors in (part_colors(len(rig.parts))[labels], part_colors(groups.max() + 1)[groups[labels]]):
        row += [_mesh(rig, rig.vertices, colors, size=_LARGE, view=view) for view in ("front", "back")]
    n = len(np.unique(groups))
    named = [(f"parts, {len(rig.parts)}", 0, 1), (f"groups, {n}", 2, 3)]
    tiles(path, [row], titles=["front", "back"] * 2, groups=named)
    return (
        f"Joint partitions of the {shown.called}, from the skinning weights: the {len(rig.parts)} parts that the structured "
        f"Chamfer distance and the segmenter work with, and the {n} groups (chains of joints) that segmentation is judged by."
    )


def ablation(shown, path):
    """Labels and reconstructions of Chamfer alone, of pose-only and of joint, from the worst of joint's labels to the best.

    As in the paper, beside Chamfer alone are the labels of a segmenter that has learned from uniform poses alone.
    """
    rig, colors, groups = shown.rig, part_colors(len(shown.rig.parts)), part_groups(shown.rig)
    blocks = [("cd", "Chamfer alone"), ("pose-only", "pose-only"), ("joint", "joint")]
    rows, notes, right = [], {}, {row: shown.right(row) for row in ("rand", "pose-only", "joint")}
    for r, i in enumerate(shown.from_worst_to_best("joint", _N_SCANS, by=1.0 - right["joint"])):
        scan = shown.test[i]
        found = [shown.cells[row]["vertices"][i] for row, _ in blocks]
        frame = _frame(scan, found)
        line = [_points(rig, scan.points, None, frame=frame)]
        for b, ((row, _), V) in enumerate(zip(blocks, found)):
            labelled_by, fitted = "rand" if row == "cd" else row, _nearest_labels(rig, scan.points, V)
            labels = shown.labels(labelled_by)[i]
            line.append(_points(rig, scan.points, colors[labels], frame=frame))
            line.append(_mesh(rig, V, colors[rig.vertex_labels], frame=frame))
            notes[r, 1 + 2 * b] = f"{right[labelled_by][i]:.0%}"
            share = "" if fitted is None else f" · {np.mean(groups[fitted] == groups[scan.labels]):.0%}"
            notes[r, 2 + 2 * b] = _said(shown.errors(row)[i]) + share
        rows.append(line)
    if not rows:
        return None
    over = [(title, 1 + 2 * b, 2 + 2 * b) for b, (_, title) in enumerate(blocks)]
    titles = ["input", "rand's labels", "reconstruction", *["labels", "reconstruction"] * 2]
    tiles(path, rows, titles=titles, groups=over, notes=notes)
    return (
        f"Ablation on held-out scans of the {shown.called}, evenly from the worst to the best of joint's labels; below labels "
        "the share in the right group of parts, below reconstructions the joint error in half sizes of the rig, and the "
        "share that the nearest registered vertices put right. Chamfer alone has no segmenter: beside it are the labels of "
        "rand's, which has learned from uniform poses. In pose-only the segmenter learns from "
        "inferred poses, but not from inferred templates: bones of the rig's own are changed at random; in joint, from inferred "
        "ones, too. The modality gap of the paper is what the labels of pose-only lack."
    )


def gallery(shown, path):
    """Input, segmentation, and the reconstructions of free-form, Chamfer alone and joint: the first scans, in no order.

    The free-form fits are those with augmented starts, as the paper's galleries show its baseline.
    """
    rig, colors = shown.rig, part_colors(len(shown.rig.parts))
    names = ["free-form-augmented", "cd", "joint"]
    rows, notes = [], {}
    for r, i in enumerate(range(min(_N_SCANS, len(shown.test)))):
        scan = shown.test[i]
        found = [shown.cells[row]["vertices"][i] for row in names]
        frame = _frame(scan, found)
        said = colors[shown.labels("joint")[i]]
        line = [_points(rig, scan.points, c, frame=frame) for c in (None, said)]
        for k, (row, V) in enumerate(zip(names, found)):
            line.append(_mesh(rig, V, frame=frame))
            notes[r, 2 + k] = _said(shown.errors(row)[i])
        rows.append([*line, _mesh(rig, scan.vertices, frame=frame)])
    tiles(path, rows, titles=["input", "segmentation", "free-form", "Chamfer alone", "joint", "truth"], notes=notes)
    return (
        f"The first held-out scans of the {shown.called}: input, the segmentation that joint infers, registered meshes of the "
        "free-form baseline (from the best of the template and of synthetic scans that look alike), of skinning with Chamfer "
        "alone and of joint, and the true mesh; below, joint errors in half sizes of the rig."
    )


def correspondence(shown, path):
    """A scan coloured by place, its colours on a scan of someone else through the registrations, and the true ones."""
    rig = shown.rig
    names = [row for row in ("cd", "joint") if row in shown.cells]
    rows, notes = [], {}
    pairs, whence = _pairs(shown)
    for r, (i, k) in enumerate(pairs):
        a, b = shown.test[i], shown.test[k]
        true = [_colors_at(rig, *true_places(rig, s)) for s in (a, b)]
        line = [_points(rig, a.points, true[0], size=_LARGE, frame=_frame(a, []))]
        for c, row in enumerate(names):
            V = shown.cells[row]["vertices"]
            if not np.isfinite(V[[i, k]]).all():
                line.append(None)
                notes[r, 1 + c] = _said(np.nan)
                continue
            there = transfer(b.points, V[k], V[i], rig.faces)
            line.append(_points(rig, b.points, _rest_colors(rig, there, a.vertices), size=_LARGE, frame=_frame(b, [])))
            notes[r, 1 + c] = _said(_transfer_error(rig, a, b, there))
        rows.append([*line, _points(rig, b.points, true[1], size=_LARGE, frame=_frame(b, []))])
    if not rows:
        return None
    called = {"cd": "B, by Chamfer alone", "joint": "B, by joint"}
    tiles(path, rows, titles=["A", *(called[row] for row in names), "B, truth"], notes=notes)
    return (
        f"Correspondence on the {shown.called}: scan A coloured by place on the template; scan B, of someone else (pairs from "
        f"{whence}), where each point has the colour of the place on A that the registrations carry it to, before the snap; B "
        "by its true places. Below, the mean distance between the places on A that points of B are carried to and the true "
        "ones, in half sizes of the rig."
    )


# ---- little pictures ----


def _mesh(rig, vertices, colors=SKIN, *, size=_TILE, view="front", frame=None):
    if not np.isfinite(vertices).all():
        return None
    item = Mesh(np.asarray(vertices, dtype=float), rig.faces, np.asarray(colors))
    return render(item, size=size, view=view, **axes_of(rig), frame=frame)


def _points(rig, points, colors, *, size=_TILE, view="front", frame=None):
    item = Points(points, np.array((128, 138, 150)) if colors is None else colors, _RADIUS[size])
    return render(item, size=size, view=view, **axes_of(rig), frame=frame)


def _frame(scan, found):
    return np.concatenate([scan.points, scan.vertices, *(V for V in found if np.isfinite(V).all())])


def _said(error):
    return "not fitted" if not np.isfinite(error) else f"{error:.3f}"


# ---- labels and colours ----


def _nearest(points, to):
    from scipy.spatial import cKDTree

    return cKDTree(points).query(to)[1]


def _nearest_labels(rig, points, vertices):
    """(n,) int: the part of the nearest vertex; None where there are none."""
    return rig.vertex_labels[_nearest(vertices, points)] if np.isfinite(vertices).all() else None


def _rest_colors(rig, points, vertices):
    """(n, 3) RGB by where points of a posed mesh lie on the template: smooth in space, different at any two places."""
    return _colors_at(rig, *surface_places(points, vertices, rig.faces))


def _colors_at(rig, corners, barycentric):
    """The same for places on the mesh."""
    rest = at_places(corners, barycentric, rig.vertices)
    low, high = rig.vertices.min(axis=0), rig.vertices.max(axis=0)
    x, y, z = ((rest - low) / np.maximum(high - low, 1e-9 * rig.size)).T
    return _from_oklab(0.74 + 0.2 * (z - 0.5), 0.5 * (x - 0.5), 0.44 * (y - 0.5))


def _from_oklab(lightness, a, b):
    """(n, 3) RGB 0–255 of colours in Oklab (Ottosson, 2020), where equal steps look about equal."""
    lms = np.stack(
        [
            lightness + 0.3963377774 * a + 0.2158037573 * b,
            lightness - 0.1055613458 * a - 0.0638541728 * b,
            lightness - 0.0894841775 * a - 1.2914855480 * b,
        ]
    )
    linear = np.array(
        [
            [4.0767416621, -3.3077115913, 0.2309699292],
            [-1.2684380046, 2.6097574011, -0.3413193965],
            [-0.0041960863, -0.7034186147, 1.7076147010],
        ]
    ) @ lms**3
    return (255 * np.clip(linear, 0.0, 1.0).T ** (1 / 2.2)).round()


def _pairs(shown):
    """Two pairs (A, B) of scans of different people, fewer where there are none, and which scans they are from, in words.

    From the better two thirds by joint's error, where these have two pairs, or as many as there are.
    """
    everybody = shown.from_worst_to_best("joint", len(shown.test))
    better, every = (_paired(shown, ranked) for ranked in (everybody[len(everybody) // 3 :], everybody))
    if len(better) < len(every):
        return every, "all scans"
    return better, "the better two thirds of the scans by the error of joint"


def _paired(shown, ranked):
    out = []
    for a in ranked:
        used = {i for pair in out for i in pair}
        others = [b for b in ranked if shown.test_subjects[b] != shown.test_subjects[a] and b not in used]
        if a not in used and others:
            out.append((a, others[len(others) // 2]))
        if len(out) == 2:
            break
    return out


def _transfer_error(rig, a, b, there):
    true = at_places(*true_places(rig, b), a.vertices)
    return np.linalg.norm(there - true, axis=1).mean() / (rig.size / 2)
