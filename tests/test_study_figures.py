"""The study's figures: what is drawn of which rows, the same bytes for the same inputs, and errors."""

import sys
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest

from lbsfit_np import load_rig
from lbsfit_np.bench.study import charts, figures, gallery
from lbsfit_np.bench.study.data import Size, part_groups, study_set
from lbsfit_np.bench.study.diagram import diagram
from lbsfit_np.bench.study.figures import Shown, draw
from lbsfit_np.bench.study.making import cell_name
from lbsfit_np.errors import InputError, MissingExtraError

NAME, SEED = "hand-coarse", 300
TINY = Size(4, 4, 2, 2, 6, 50, 2, 1)
# How far each row's registrations are from the truth, in half sizes.
ERRORS = {"free-form": 0.3, "free-form-augmented": 0.25, "cd": 0.2, "rand": 0.1, "pose-only": 0.05, "joint": 0.02}
# Share of each scan's points that a row's segmenter puts into a wrong group of parts.
WRONG = {"rand": 0.3, "pose-only": 0.2, "joint": 0.1}
ALWAYS = ["diagram.png", *(f"{kind}-{NAME}.png" for kind in ("triplet", "partitions", "mixture", "local-optimum"))]


@pytest.fixture(scope="module")
def rig():
    return load_rig(NAME)


@pytest.fixture(scope="module")
def given(rig):
    return study_set(rig, TINY, SEED)


def labels_with_errors(rig, labels, wrong):
    """A share in other groups, and as many more in another part of the same group, which is no error."""
    groups, labels = part_groups(rig), labels.copy()
    k = round(wrong * len(labels))
    for rows, same in ((slice(0, k), False), (slice(k, 2 * k), True)):
        for i in range(*rows.indices(len(labels))):
            alike = (groups == groups[labels[i]]) == same
            labels[i] = np.flatnonzero(alike)[-1]
    return labels


def history(kept, n):
    return [{"round": k, "kept": k == kept} for k in range(n + 1)]


@pytest.fixture(scope="module")
def report(rig):
    rows = {row: {"accuracy": []} for row in ERRORS}
    rows["rand"] |= {"accuracy": [0.9, 0.91, 0.92], "kept_accuracy": 0.92, "history": history(2, 2)}
    rows["joint"] |= {"accuracy": [0.9, 0.94, 0.95, 0.955], "kept_accuracy": 0.95, "history": history(2, 3)}
    entry = {"digest": rig.digest, "size": asdict(TINY), "seeds": {str(SEED): rows}}
    return {"rigs": {NAME: entry}}


@pytest.fixture(scope="module")
def cells(rig, given):
    """The true registrations, the i-th scan's shifted by (i + 1) / N of the row's error; one scan that "cd" could not fit."""
    out = {}
    share = (np.arange(len(given.test)) + 1)[:, None, None] / len(given.test)
    for row, error in ERRORS.items():
        shift = error * rig.size / 2 * share * [1.0, 0.0, 0.0]
        cell = {
            "vertices": (np.array([s.vertices for s in given.test]) + shift).astype(np.float32),
            "joints": (np.array([s.joints for s in given.test]) + shift).astype(np.float32),
        }
        if row == "joint":
            posed = np.array([rig.pose(s.pose, s.translation, s.scale) for s in given.test])
            cell |= {"posed": posed.astype(np.float32), "template": np.array([s.template for s in given.test], dtype=np.float32)}
        if row in WRONG:
            said = [labels_with_errors(rig, s.labels, WRONG[row]) for s in given.test]
            cell["labels"] = np.concatenate(said).astype(np.int16)
        out[cell_name(NAME, SEED, row)] = cell
    for array in out[cell_name(NAME, SEED, "cd")].values():
        array[1] = np.nan
    return out


@pytest.fixture
def shown(rig, report, cells):
    return Shown(NAME, rig, report["rigs"][NAME], cells.get)


@pytest.fixture
def viz():
    pytest.importorskip("matplotlib", reason="the extra viz is not installed")


@pytest.mark.slow
def test_all_figures_are_drawn_twice_the_same(viz, rig, report, cells, tmp_path):
    from matplotlib.image import imread

    kinds = ("triplet", "partitions", "mixture", "local-optimum", "accuracy", "ablation", "gallery", "correspondence")
    captions = draw(report, cells.get, tmp_path / "new" / "one", rigs={NAME: rig})
    expected = ["diagram.png", *("accuracy.png" if k == "accuracy" else f"{k}-{NAME}.png" for k in kinds)]
    assert list(captions) == expected
    assert sorted(p.name for p in (tmp_path / "new" / "one").iterdir()) == sorted(expected)
    assert draw(report, cells.get, tmp_path / "two", rigs={NAME: rig}, jobs=2) == captions  # whoever draws them
    for name, caption in captions.items():
        data = (tmp_path / "new" / "one" / name).read_bytes()
        assert data == (tmp_path / "two" / name).read_bytes(), name
        assert len(data) < 400_000 and b"Software" not in data and b"Date" not in data, name
        image = imread(tmp_path / "two" / name)
        assert image.ndim == 3 and max(image.shape) < 1300 and image[..., :3].std() > 0.03, name
        assert len(caption) > 60 and caption.endswith(".") and "\n" not in caption


@pytest.mark.slow
def test_figures_whose_rows_are_missing_are_left_out(viz, drawn, rig, report, cells, tmp_path, monkeypatch):
    along = charts.along_path(rig, steps=41)
    monkeypatch.setattr(charts, "along_path", lambda rig, steps: along)  # as it is for each of these
    monkeypatch.setattr(charts, "_N_POSES", 80)
    assert list(draw(report, lambda cell: None, tmp_path / "none", rigs={NAME: rig})) == [*ALWAYS, "accuracy.png"]
    rows = report["rigs"][NAME]["seeds"][str(SEED)]
    partly = {"rigs": {NAME: report["rigs"][NAME] | {"seeds": {str(SEED): {"joint": rows["joint"]}}}}}
    captions = draw(partly, cells.get, tmp_path / "joint", rigs={NAME: rig})
    assert list(captions) == [*ALWAYS, f"correspondence-{NAME}.png"]
    for lacking, kept in (("free-form-augmented", "ablation"), ("rand", "gallery")):
        seeds = {str(SEED): {row: cell for row, cell in rows.items() if row != lacking}}
        partly = {"rigs": {NAME: report["rigs"][NAME] | {"seeds": seeds}}}
        with monkeypatch.context() as patch:
            patch.setattr(figures, "FIGURES", ("ablation", "gallery"))  # the others take their time
            assert list(draw(partly, cells.get, tmp_path / lacking, rigs={NAME: rig})) == [f"{kept}-{NAME}.png"]
    assert list(draw(report, cells.get, tmp_path / "no rig", rigs={})) == ["diagram.png", "accuracy.png"]
    begun = {"rigs": {NAME: report["rigs"][NAME] | {"seeds": {}}}}
    assert list(draw(begun, cells.get, tmp_path / "begun", rigs={NAME: rig})) == ["diagram.png"]


def test_rigs_without_a_local_optimum_have_no_picture_of_one(viz, tube_rig, tmp_path):
    shown = Shown("tube", tube_rig, {"size": asdict(TINY), "seeds": {str(SEED): {}}}, lambda cell: None)
    assert charts.local_optimum(shown, tmp_path / "x.png") is None and not any(tmp_path.iterdir())


def test_captions_say_whose_mesh_it_is(viz, shown, rig, report, tmp_path):
    assert "what the whole loop found" in gallery.triplet(shown, tmp_path / "a.png")
    bare = Shown(NAME, rig, report["rigs"][NAME], lambda cell: None)
    assert "the scan's true ones" in gallery.triplet(bare, tmp_path / "b.png")


def test_the_users_settings_change_nothing(viz, tmp_path):
    import matplotlib

    diagram(tmp_path / "a.png")
    with matplotlib.rc_context({"font.size": 31.0, "savefig.dpi": 30, "figure.facecolor": "red"}):
        diagram(tmp_path / "b.png")
        assert matplotlib.rcParams["font.size"] == 31.0  # nor are they changed
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_without_matplotlib_the_error_names_the_extra(monkeypatch, rig, report, cells, tmp_path):
    for name in [m for m in sys.modules if m.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"needs matplotlib, which is not installed; run: .*lbsfit_np\[viz\]"):
        draw(report, cells.get, tmp_path, rigs={NAME: rig})
    assert not any(tmp_path.iterdir())


# ---- what is shown ----


def test_errors_and_the_order_from_worst_to_best(shown):
    n = len(shown.test)
    assert shown.errors("joint") == pytest.approx(ERRORS["joint"] * (np.arange(n) + 1) / n, rel=1e-4)
    assert shown.from_worst_to_best("joint", n) == list(range(n))[::-1]
    assert shown.from_worst_to_best("joint", 2) == [n - 1, 0]
    assert np.isnan(shown.errors("cd")[1]) and shown.from_worst_to_best("cd", n) == [3, 2, 0]


def test_the_seed_is_the_first_of_those_with_the_most_rows(rig, report):
    entry = report["rigs"][NAME]
    seeds = {"100": {"joint": {}}, str(SEED): entry["seeds"][str(SEED)], "301": entry["seeds"][str(SEED)]}
    assert Shown(NAME, rig, entry | {"seeds": seeds}, lambda cell: None).seed == SEED


def test_labels_are_dealt_out_to_their_scans(shown):
    for said, scan in zip(shown.labels("joint"), shown.test, strict=True):
        assert np.array_equal(said, labels_with_errors(shown.rig, scan.labels, WRONG["joint"]))


def test_arrays_of_other_scans_are_refused(rig, report, cells):
    name = cell_name(NAME, SEED, "joint")
    for change, message in (
        ({"labels": cells[name]["labels"][:-1]}, r"arrays of 'joint': got \d+ labels; expected \d+ labels"),
        ({"vertices": cells[name]["vertices"][1:]}, r"arrays of 'joint': got vertices of shape \(3, 555, 3\)"),
    ):
        other = cells | {name: cells[name] | change}
        with pytest.raises(InputError, match=message):
            Shown(NAME, rig, report["rigs"][NAME], other.get).labels("joint")
    with pytest.raises(InputError, match="arrays of 'cd': got none"):
        Shown(NAME, rig, report["rigs"][NAME], cells.get).labels("cd")


def test_the_test_scans_do_not_depend_on_how_many_training_scans_are_made_again(shown, given, monkeypatch):
    monkeypatch.setattr("lbsfit_np.bench.study.figures._MOST_TRAINING", 2)
    assert len(shown.train) == 2
    assert all(np.array_equal(a.points, b.points) for a, b in zip(shown.test, given.test, strict=True))
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(shown.train, given.train))


def test_true_registrations_carry_colours_to_their_places(shown, rig):
    a, b = shown.test[:2]
    from lbsfit_np.correspondence import transfer

    there = transfer(b.points, b.vertices, a.vertices, rig.faces)
    assert gallery._transfer_error(rig, a, b, there) < 2e-3  # where fingers touch, the nearest place is another's
    assert gallery._transfer_error(rig, a, b, there + [0.0, 0.0, rig.size / 2]) == pytest.approx(1.0, rel=2e-3)
    # Colours: equal for the same place in any pose, different for other places.
    colors = [gallery._rest_colors(rig, s.vertices, s.vertices) for s in (a, b)]
    assert np.abs(colors[0] - colors[1]).max() <= 1 and colors[0].min() >= 0 and colors[0].max() <= 255
    assert np.ptp(colors[0], axis=0).min() > 80


def test_the_mixture_shows_two_joints_that_bend(rig):
    middle = [rig.joint_names.index(name) for name in ("middle1", "middle2")]
    assert charts._telling_angles(rig) == ((middle[0], 0), (middle[1], 0))
    body = load_rig("body-coarse")
    assert [body.joint_names[j].split("_")[1] for j, _ in charts._telling_angles(body)] == ["hip", "knee"]


# ---- what is drawn ----


@pytest.fixture
def drawn(monkeypatch):
    """What figures hand to the canvas: axes in turn, and the arguments of tiles, of pictures of which nothing is rendered."""
    seen = SimpleNamespace(axes=[], tiles=[], meshes=[])
    axes_at, render = charts.axes_at, gallery.render

    def recorded(*place, **options):
        seen.axes.append(axes_at(*place, **options))
        return seen.axes[-1]

    def rendered(item, *, size, **view):
        if hasattr(item, "faces"):
            seen.meshes.append(item.vertices)
        return render(item, size=(24, 28), **view)

    def laid_out(path, rows, *, titles, groups=(), notes=None):
        seen.tiles.append(SimpleNamespace(rows=rows, titles=titles, groups=groups, notes=notes))

    monkeypatch.setattr(charts, "axes_at", recorded)
    monkeypatch.setattr(gallery, "render", rendered)
    monkeypatch.setattr(gallery, "tiles", laid_out)
    return seen


def test_what_is_inferred_in_the_mixture_is_near_the_inferred_poses(viz, shown, rig, drawn, tmp_path, monkeypatch):
    monkeypatch.setattr(charts, "_N_POSES", 80)
    charts.mixture(shown, tmp_path / "mixture.png")
    (jx, ax), (jy, ay) = charts._telling_angles(rig)
    crosses = np.degrees([(s.pose[jx, ax], s.pose[jy, ay]) for s in shown.train])
    noise = np.degrees(0.15) + 1e-6
    points = [[np.asarray(c.get_offsets()) for c in axes.collections] for axes in drawn.axes[::3]]  # without the marginals

    def share_near(xy):
        return (np.abs(xy[:, None] - crosses).max(axis=2).min(axis=1) <= noise).mean()

    (uniform,), (inferred, marks), (far, near, _) = points
    assert len(uniform) == 40 and len(inferred) == len(near) and len(near) + len(far) == 80 and 20 < len(near) < 60
    np.testing.assert_allclose(marks, crosses)
    assert share_near(inferred) == share_near(near) == 1.0
    assert max(share_near(uniform), share_near(far)) < 0.7


def test_the_accuracy_of_every_seed_is_drawn_and_their_mean(viz, drawn, tmp_path):
    from matplotlib.colors import to_rgba

    told = {"rand": ([0.80, 0.81], [0.84, 0.87]), "joint": ([0.80, 0.90, 0.93], [0.84, 0.92])}
    kept = {"rand": (0.81, 0.87), "joint": (0.90, 0.92)}
    cells = {
        row: [{"accuracy": both[k], "kept_accuracy": kept[row][k], "history": history(1, len(both[k]) - 1)} for k in (0, 1)]
        for row, both in told.items()
    }
    seeds = {str(k): {row: cells[row][k] for row in told} for k in (0, 1)}
    entry = {"kind": "hand", "size": asdict(TINY)}
    caption = charts.accuracy({"rigs": {"hand": entry | {"seeds": seeds}}}, tmp_path / "accuracy.png")
    assert caption.endswith(" Thin lines are seeds.") and "(4 of the hand)" in caption
    single = charts.accuracy({"rigs": {"hand": entry | {"seeds": {"0": seeds["0"]}}}}, tmp_path / "single.png")
    assert single and "Thin lines" not in single
    axes, _ = drawn.axes
    goal, *others = axes.lines
    assert list(goal.get_ydata()) == [95.0, 95.0] and axes.get_ylim() == (80.0, 100.0)
    lines = {(line.get_color(), line.get_linewidth() > 1): [] for line in others}
    for line in others:
        lines[line.get_color(), line.get_linewidth() > 1].append(pytest.approx(list(line.get_ydata())))
    for row, both in told.items():
        color = charts.ROW_COLORS[row]
        assert lines[color, False] == [[100 * v for v in values] for values in both]
        mean = [50 * (a + b) for a, b in zip(*both)]  # as far as all seeds go
        assert lines[color, True] == [mean]
    rings = [tuple(ring.get_offsets()[0]) for ring in axes.collections]
    assert axes.get_ylabel()
    edges = [tuple(ring.get_edgecolors()[0]) for ring in axes.collections]
    assert edges == [pytest.approx(to_rgba(charts.ROW_COLORS[row])) for row in told for _ in (0, 1)]
    assert rings == [pytest.approx((1, 100 * value)) for both in kept.values() for value in both]


@pytest.fixture
def exact(rig, given, report):
    """True registrations of "joint"; of the others each scan's are off, the later the less."""
    cells, n = {}, len(given.test)
    for row, error in (ERRORS | {"joint": 0.0}).items():
        shift = error * rig.size / 2 * ((n - np.arange(n)) / n)[:, None, None] * [1.0, 0.0, 0.0]
        cells[cell_name(NAME, SEED, row)] = {
            "vertices": np.array([s.vertices for s in given.test]) + shift,
            "joints": np.array([s.joints for s in given.test]) + shift,
            "labels": np.concatenate([s.labels for s in given.test]),
        }
    return Shown(NAME, rig, report["rigs"][NAME], cells.get)


def test_colours_go_from_the_first_scan_to_the_second(exact, drawn, tmp_path):
    gallery.correspondence(exact, tmp_path / "x.png")
    (sheet,) = drawn.tiles
    assert sheet.titles == ["A", "B, by Chamfer alone", "B, by joint", "B, truth"]
    for r, row in enumerate(sheet.rows):
        assert float(sheet.notes[r, 2]) <= 2e-3 and float(sheet.notes[r, 1]) > 0.02
        joint, truth = (picture.astype(float) for picture in row[2:])
        assert np.abs(joint - truth).mean() < 1e-2 * np.abs(row[0].astype(float) - truth).mean()  # before the snap


def test_the_ablation_goes_from_the_worst_labels_of_joint_to_the_best(shown, rig, drawn, tmp_path):
    """Of "cd" another fit is the best, and one could not be made."""
    n = len(shown.test)
    wrong = [0.1 * (i + 1) for i in range(n)]
    said = [labels_with_errors(rig, s.labels, share) for s, share in zip(shown.test, wrong, strict=True)]
    shown.cells["joint"] = shown.cells["joint"] | {"labels": np.concatenate(said)}
    cd = {what: array.copy() for what, array in shown.cells["cd"].items()}
    cd["vertices"][3], cd["joints"][3] = shown.test[3].vertices, shown.test[3].joints
    shown.cells["cd"] = cd
    gallery.ablation(shown, tmp_path / "x.png")
    (sheet,) = drawn.tiles
    told = {row: [sheet.notes[r, c].split(" · ") for r in range(n)] for row, c in (("cd", 2), ("pose-only", 4), ("joint", 6))}
    errors = {row: [error for error, *_ in notes] for row, notes in told.items()}
    assert told["cd"][0][1] > "95%" and told["cd"][2] == ["not fitted"]  # points' nearest vertices may be of another part
    for row in ("joint", "pose-only"):
        assert list(map(float, errors[row])) == pytest.approx(ERRORS[row] * np.arange(n, 0, -1) / n, abs=6e-4)
    assert errors["cd"] == ["0.000", "0.150", "not fitted", "0.050"]
    assert [title for title, *_ in sheet.groups] == ["Chamfer alone", "pose-only", "joint"]
    assert sheet.titles == ["input", "rand's labels", "reconstruction", *["labels", "reconstruction"] * 2]
    for row, c in (("rand", 1), ("pose-only", 3)):
        assert [sheet.notes[r, c] for r in range(n)] == [f"{1 - WRONG[row]:.0%}"] * n
    assert [sheet.notes[r, 5] for r in range(n)] == [f"{1 - share:.0%}" for share in wrong[::-1]]
    for r, i in enumerate(range(n)[::-1]):
        assert (sheet.rows[r][2] is None) == (i == 1)  # not fitted


def test_the_gallery_has_the_first_scans_and_each_row_in_its_column(shown, drawn, tmp_path):
    gallery.gallery(shown, tmp_path / "x.png")
    (sheet,) = drawn.tiles
    assert sheet.titles[2:] == ["free-form", "Chamfer alone", "joint", "truth"]  # from augmented starts
    n = len(shown.test)
    for c, row in enumerate(("free-form-augmented", "cd", "joint"), start=2):
        for i in range(n):
            if row == "cd" and i == 1:
                assert sheet.notes[i, c] == "not fitted"
            else:
                assert float(sheet.notes[i, c]) == pytest.approx(ERRORS[row] * (i + 1) / n, abs=6e-4)
    meshes = [shown.cells[row]["vertices"][0] for row in ("free-form-augmented", "cd", "joint")] + [shown.test[0].vertices]
    for seen, mesh in zip(drawn.meshes, meshes):
        np.testing.assert_array_equal(seen, mesh)


def test_pairs_are_of_the_better_two_thirds(shown):
    ranked = {"from_worst_to_best": lambda row, n: list(range(n)), "test": [None] * 6}
    assert gallery._pairs(SimpleNamespace(test_subjects=[0, 1] * 3, **ranked)) == (
        [(2, 5), (3, 4)],
        "the better two thirds of the scans by the error of joint",
    )


def test_pairs_are_of_all_scans_where_the_better_ones_have_too_few(shown):
    """From the worst to the best 3, 2, 1, 0, of people 1, 0, 1, 0."""
    assert gallery._pairs(shown) == ([(3, 0), (2, 1)], "all scans")
    ranked = {"from_worst_to_best": lambda row, n: [3, 2, 1, 0], "test": shown.test}
    worst_alone, whence = gallery._pairs(SimpleNamespace(test_subjects=[0, 0, 0, 1], **ranked))
    assert worst_alone == [(3, 1)] and whence == "all scans"
    assert gallery._pairs(SimpleNamespace(test_subjects=[0, 0, 0, 0], **ranked))[0] == []


def test_pairs_share_no_scan():
    ranked = SimpleNamespace(from_worst_to_best=lambda row, n: list(range(6)), test=[None] * 6, test_subjects=[0, 1] * 3)
    pairs, _ = gallery._pairs(ranked)
    assert len(pairs) == 2 and len({i for pair in pairs for i in pair}) == 4
    assert all(ranked.test_subjects[a] != ranked.test_subjects[b] for a, b in pairs)


def test_the_triplet_is_of_the_most_changed_person_of_the_better_half(shown, rig, drawn, tmp_path):
    changed = [np.linalg.norm(s.template - rig.vertices, axis=1).mean() for s in shown.test]
    i = max((0, 1), key=lambda k: changed[k])  # from the worst to the best 3, 2, 1, 0
    gallery.triplet(shown, tmp_path / "x.png")
    cell = shown.cells["joint"]
    expected = rig.vertices, *(cell[name][i] for name in ("template", "posed", "vertices"))
    for mesh, wanted in zip(drawn.meshes, expected, strict=True):
        np.testing.assert_array_equal(mesh, wanted)
    ((row,),) = [sheet.rows for sheet in drawn.tiles]
    assert len(row) == 5


def test_without_fits_the_triplet_is_of_the_truth(shown, rig, drawn, tmp_path, monkeypatch):
    bare = Shown(NAME, rig, shown.entry, lambda cell: None)
    assert "the scan's true ones" in gallery.triplet(bare, tmp_path / "x.png")
    _, deformed, posed, both = drawn.meshes
    (i,) = [k for k, s in enumerate(bare.test) if np.array_equal(s.vertices, both)]
    np.testing.assert_array_equal(deformed, bare.test[i].template)
    np.testing.assert_allclose(posed, rig.pose(bare.test[i].pose), atol=1e-12)
