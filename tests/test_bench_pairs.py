"""The benchmark of pairs: what it measures where the truth is known, what it keeps of fits, and the command."""

import json
import os
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import QUICK_LEARNING, one_line
from registered_sets import (
    fits_are_given,
    learning_is_given,
    posed_meshes,
    result_of,
    what_fits_are_told,
    write_meshes,
)

import lbsfit_np as lbs
from lbsfit_np.bench.pair_fits import Fits, fit_scans_of
from lbsfit_np.bench.pair_pictures import gallery, gallery_of
from lbsfit_np.bench.pairs import choose_pairs, measure_pairs, pairs_table, summary, unit_of
from lbsfit_np.bench.truth import Landmarks, PairScan, Registrations, VertexOrder
from lbsfit_np.bench.truth_file import read_truth
from lbsfit_np.cli.pair_runs import PairsProgress
from lbsfit_np.cli.progress import SILENCE
from lbsfit_np.errors import InputError
from lbsfit_np.learning.archive import model_digest
from lbsfit_np.report.colors import part_colors

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]

WHO = ("ann", "ann", "bob", "bob")
SHIFT = np.array([0.03, 0, 0.04])


@pytest.fixture(scope="module")
def meshes(tube_rig):
    return posed_meshes(tube_rig, 4)


@pytest.fixture(scope="module")
def folder(tube_rig, meshes, tmp_path_factory):
    """Scans s0 … s3 of two people, and truth.csv."""
    folder = write_meshes(tmp_path_factory.mktemp("pairs"), tube_rig, meshes)
    (folder / "truth.csv").write_text("\n".join(["scan,subject", *(f"s{i},{who}" for i, who in enumerate(WHO))]))
    tube_rig.save(folder / "tube.npz")
    return folder


@pytest.fixture
def scans(folder):
    return [PairScan(f"s{i}", folder / f"s{i}.ply", who) for i, who in enumerate(WHO)]


def _fits(folder, rig, registrations):
    """Fits that are there: a registration for each name, None for a scan without a fit."""
    (folder / "fits").mkdir(exist_ok=True)
    fits = Fits(folder)
    for name, vertices in registrations.items():
        fits.entries[name] = {"failed": "no points"} if vertices is None else {"status": "ok", "recon": 0.1, "scale": 1.0}
        if vertices is not None:
            result_of(rig, vertices, 5).save(folder / "fits" / f"{name}.npz")
    return fits


def _truth(kind, rig, meshes):
    if kind == "order":
        return VertexOrder(len(meshes[0]))
    if kind == "registrations":
        return Registrations(tuple(meshes), rig.faces)
    rows = dict(zip("abcdef", (0, 50, 100, 150, 200, 241)))
    places = [rows if i % 2 else {n: tuple(meshes[i][r]) for n, r in rows.items()} for i in range(len(meshes))]
    return Landmarks(tuple(places), ({},) * len(meshes))


# ---- measures ----


@pytest.mark.parametrize("kind", ["order", "registrations", "landmarks"])
def test_exact_registrations_give_no_error(scans, tube_rig, meshes, tmp_path, kind):
    truth = _truth(kind, tube_rig, meshes)
    fits = _fits(tmp_path, tube_rig, {s.name: v for s, v in zip(scans, meshes)})
    pairs = choose_pairs(scans, truth, 99, 0)
    assert len(pairs["intra"]) == 4 and len(pairs["inter"]) == 8
    found = measure_pairs(scans, truth, fits, tube_rig.faces, pairs)
    for kind in ("intra", "inter"):
        figures = found["figures"][kind]
        assert figures["pairs"] == len(pairs[kind]) and figures["missing"] == 0
        for when in ("before", "after"):
            assert max(figures[when].values()) < 1e-9
    assert len(found["pairs"]) == 12


@pytest.mark.parametrize("kind", ["order", "registrations", "landmarks"])
def test_a_shifted_registration_is_off_by_the_shift(scans, tube_rig, meshes, tmp_path, kind):
    """Onto a scan whose registration is shifted every place is off by as much; the snap brings it back where it is small."""
    truth = _truth(kind, tube_rig, meshes)
    given = {s.name: v for s, v in zip(scans, meshes)} | {"s1": meshes[1] + SHIFT}
    found = measure_pairs(scans, truth, _fits(tmp_path, tube_rig, given), tube_rig.faces, {"intra": [(0, 1)], "inter": [(2, 1)]})
    for entry in found["pairs"]:
        assert entry["b"] == "s1"
        for value in entry["before"].values():
            assert value == pytest.approx(0.05, rel=1e-9)
    given["s1"] = meshes[1] + 1e-6
    found = measure_pairs(scans, truth, _fits(tmp_path, tube_rig, given), tube_rig.faces, {"intra": [(0, 1)], "inter": []})
    assert found["figures"]["intra"]["before"]["mean"] == pytest.approx(3**0.5 * 1e-6)
    assert found["figures"]["intra"]["after"]["mean"] < 1e-12
    assert found["figures"]["inter"] == {"pairs": 0, "missing": 0, "before": summary([]), "after": summary([])}


def test_only_places_that_both_scans_know_count(scans, tube_rig, meshes, tmp_path):
    places = ({"tip": 3, "end": 100, "side": 200}, {"end": 100, "side": 200, "none": 7}, {}, {})
    fits = _fits(tmp_path, tube_rig, {s.name: v for s, v in zip(scans, meshes)} | {"s1": meshes[1] + SHIFT})
    truth = Landmarks(places, ({},) * 4)
    pairs = choose_pairs(scans, truth, 99, 0)
    assert pairs == {"intra": [(0, 1), (1, 0)], "inter": []}
    entry = measure_pairs(scans, truth, fits, tube_rig.faces, {"intra": [(0, 1)], "inter": []})["pairs"][0]
    assert entry["points"] == 2 and entry["before"]["p95"] == pytest.approx(0.05)


def test_the_measure_is_what_transfer_finds(scans, tube_rig, meshes, tmp_path):
    rng = np.random.default_rng(0)
    given = {s.name: v + 0.02 * rng.standard_normal(v.shape) for s, v in zip(scans, meshes)}
    fits = _fits(tmp_path, tube_rig, given)
    found = measure_pairs(scans, VertexOrder(242), fits, tube_rig.faces, {"intra": [(0, 1), (3, 2)], "inter": [(0, 3)]})
    pooled = []
    for a, b in ((0, 1), (3, 2), (0, 3)):
        entry = next(e for e in found["pairs"] if (e["a"], e["b"]) == (f"s{a}", f"s{b}"))
        for when, snap in (("before", None), ("after", meshes[b])):
            at = lbs.transfer(meshes[a], given[f"s{a}"], given[f"s{b}"], tube_rig.faces, snap_to=snap)
            away = np.linalg.norm(at - meshes[b], axis=1)
            assert entry[when]["mean"] == pytest.approx(away.mean())
            assert entry[when]["median"] == pytest.approx(np.median(away))
            assert entry[when]["p90"] == pytest.approx(np.percentile(away, 90))
            assert entry[when]["p95"] == pytest.approx(np.percentile(away, 95))
            if when == "before" and (a, b) != (0, 3):
                pooled.append(away)
    assert found["figures"]["intra"]["before"]["p90"] == pytest.approx(np.percentile(np.concatenate(pooled), 90))


def test_pairs_of_scans_without_a_fit_are_missing(scans, tube_rig, meshes, tmp_path):
    fits = _fits(tmp_path, tube_rig, {s.name: v for s, v in zip(scans, meshes)} | {"s3": None})
    truth = VertexOrder(242)
    found = measure_pairs(scans, truth, fits, tube_rig.faces, choose_pairs(scans, truth, 99, 0), points=10)
    assert {k: (f["pairs"], f["missing"]) for k, f in found["figures"].items()} == {"intra": (2, 2), "inter": (4, 4)}
    assert {e["points"] for e in found["pairs"]} == {10}


def test_points_are_chosen_by_the_seed(scans, tube_rig, meshes, tmp_path):
    rng = np.random.default_rng(0)
    fits = _fits(tmp_path, tube_rig, {s.name: v + 0.02 * rng.standard_normal(v.shape) for s, v in zip(scans, meshes)})
    a, b, c = (
        measure_pairs(scans, VertexOrder(242), fits, tube_rig.faces, {"intra": [(0, 1)], "inter": []}, points=20, seed=seed)
        for seed in (1, 1, 2)
    )
    assert a == b != c


def test_points_of_different_scans_are_chosen_apart(scans, tube_rig, meshes, tmp_path):
    asked = {}

    class Watched(VertexOrder):
        def asked(self, i, points, most, rng):
            found = super().asked(i, points, most, rng)
            asked[i] = found.keys.tolist()
            return found

    fits = _fits(tmp_path, tube_rig, {s.name: v for s, v in zip(scans, meshes)})
    measure_pairs(scans, Watched(242), fits, tube_rig.faces, {"intra": [(0, 1), (1, 0)], "inter": [(0, 2)]}, points=20)
    assert len(asked[0]) == len(asked[1]) == 20 and set(asked) == {0, 1} and asked[0] != asked[1]


def test_measuring_is_told_from_its_beginning(scans, tube_rig, meshes, tmp_path):
    fits, told = _fits(tmp_path, tube_rig, {s.name: v for s, v in zip(scans, meshes)}), []
    pairs = {"intra": [(0, 1), (1, 0)], "inter": []}
    measure_pairs(scans, VertexOrder(242), fits, tube_rig.faces, pairs, points=5, on_pair=lambda *a: told.append(a))
    assert told == [(0, 2), (1, 2), (2, 2)]


def test_pairs_are_chosen_by_the_seed(scans):
    truth = VertexOrder(5)
    chosen = choose_pairs(scans, truth, 3, 1)
    assert [len(pairs) for pairs in chosen.values()] == [3, 3] and all(a != b for pairs in chosen.values() for a, b in pairs)
    assert all((WHO[a] == WHO[b]) == (kind == "intra") for kind, pairs in chosen.items() for a, b in pairs)
    assert chosen == choose_pairs(scans, truth, 3, 1) != choose_pairs(scans, truth, 3, 2)


@pytest.mark.parametrize(
    "scale, metres, given, expected",
    [
        (1.05, 1.0, "auto", ("m", 100.0)),
        (930.0, 1.0, "auto", ("mm", 0.1)),
        (1.0, 0.01, "auto", ("cm", 1.0)),
        (7.0, 1.0, "auto", ("unknown", None)),
        (1.0, None, "auto", ("unknown", None)),
        (1.0, None, "in", ("in", 2.54)),
    ],
)
def test_the_unit_is_told_by_the_scale(scale, metres, given, expected):
    fits = SimpleNamespace(entries={"a": {"scale": scale}, "b": {"failed": "x"}})
    assert unit_of(SimpleNamespace(metres_per_unit=metres), fits, given) == expected


def test_one_fit_of_a_wrong_scale_does_not_change_the_unit():
    fits = SimpleNamespace(entries={name: {"scale": scale} for name, scale in zip("abc", (1.0, 1.1, 40.0))})
    assert unit_of(SimpleNamespace(metres_per_unit=1.0), fits) == ("m", 100.0)


def test_the_table_has_centimetres_where_the_unit_is_known():
    figures = {"pairs": 2, "missing": 1, "before": summary([0.01, 0.03]), "after": summary([0.0, 0.01])}
    nothing = {"pairs": 0, "missing": 0, "before": summary([]), "after": summary([])}
    report = {
        "figures": {"intra": figures, "inter": nothing},
        "settings": {"points": 10, "pairs": 5, "learn": True, "seed": 0},
        "environment": {"lbsfit_np": "1"},
        "rig": {"name": "tube"},
        "scans": [{"name": "a"}, {"failed": "x"}],
        "truth": "vertex order",
        "unit": "m",
        "cm_per_unit": 100.0,
    }
    text = pairs_table(report, markdown=True)
    row = [cell.strip() for cell in text.splitlines()[2].split("|")[1:-1]]
    assert row == ["intra", "before the snap", "2", "1", "0.02", "0.02", "0.028", "0.029", "2.00", "2.00", "2.80", "2.90"]
    assert "inter" not in text and "1 of them without a fit" in text
    text = pairs_table(report | {"unit": "unknown", "cm_per_unit": None})
    assert "cm" not in text and "not known" in text


def test_the_gallery_goes_from_the_worst_to_the_best():
    recons = zip("abcde", (0.3, 0.1, 0.5, 0.2, 0.4))
    fits = Fits(None, {n: {"status": "ok", "recon": r} for n, r in recons} | {"f": {"failed": "x"}})
    assert gallery_of(fits, 3) == ["c", "a", "b"] and gallery_of(fits, 9) == ["c", "e", "a", "d", "b"]
    assert gallery_of(fits, 0) == [] == gallery_of(Fits(None), 3)


def test_the_gallery_shows_the_labels_found(tube_rig, meshes, monkeypatch):
    drawn = []

    def render(*items, **options):
        drawn.append(items)
        return np.zeros((4, 4, 3), dtype=np.uint8)

    monkeypatch.setattr("lbsfit_np.bench.pair_pictures.render", render)
    labels = np.arange(242) % 4
    gallery(tube_rig, [(meshes[0], replace(result_of(tube_rig, meshes[1], 242), labels=labels))])
    colors = part_colors(4)
    (cloud,), (mesh,), (over, plain) = drawn[:3]
    for points in (cloud, over):
        np.testing.assert_array_equal(points.points, meshes[0])
        np.testing.assert_array_equal(points.colors, colors[labels])
    np.testing.assert_array_equal(mesh.vertices, meshes[1])
    np.testing.assert_array_equal(mesh.colors, colors[tube_rig.vertex_labels])
    assert len(drawn) == 6 and np.array_equal(plain.vertices, meshes[1])


# ---- what is kept ----


@pytest.fixture
def fitter(tube_rig):
    return lbs.LBSFitter(tube_rig, random_state=0)


def test_fits_are_kept_and_taken_up(scans, fitter, meshes, tmp_path, monkeypatch):
    given = {s.name: v for s, v in zip(scans, meshes)} | {"s2": ValueError("bad"), "s3": KeyboardInterrupt()}
    asked = fits_are_given(monkeypatch, given)
    with pytest.raises(KeyboardInterrupt):
        fit_scans_of(fitter, scans, tmp_path, settings={"seed": 0})
    assert sorted(p.name for p in (tmp_path / "fits").iterdir()) == ["s0.npz", "s1.npz"]
    asked.clear()
    given["s3"] = meshes[3], {"status": "failed"}
    fits = fit_scans_of(fitter, scans, tmp_path, settings={"seed": 0})
    assert asked == ["s2", "s3"] and [fits.entries[s.name].get("kept") for s in scans] == [True, True, None, False]
    assert dict(fits.failures()) == {"s2": "ValueError: bad", "s3": "made up for 4 joints"}
    assert fits.has("s3") and not fits.has("s2") and np.array_equal(fits.load("s0").vertices, meshes[0])


def test_fits_of_other_settings_or_scans_are_not_taken(folder, fitter, tube_rig, meshes, tmp_path, monkeypatch):
    copies = write_meshes(tmp_path / "in", tube_rig, meshes[:2])
    scans = [PairScan(f"s{i}", copies / f"s{i}.ply", "ann") for i in range(2)]
    given = {s.name: v for s, v in zip(scans, meshes)}
    asked = fits_are_given(monkeypatch, given)
    out = tmp_path / "out"
    out.mkdir()
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    asked.clear()
    with pytest.raises(InputError, match="fits of seed 0; expected seed 1.*--existing replace"):
        fit_scans_of(fitter, scans, out, settings={"seed": 1})
    with pytest.raises(InputError, match="learned from nothing; expected fits that learned from 2 scans"):
        fit_scans_of(fitter, scans, out, learn_from=scans, settings={"seed": 0})
    assert asked == []
    write_meshes(copies, tube_rig, meshes[2:3], "s1.ply")  # another scan of the same name
    given["s1"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        fit_scans_of(fitter, scans, out, settings={"seed": 0})
    given["s1"], asked[:] = meshes[2], []
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    assert asked == ["s1"]
    (out / "fits" / "s0.npz").write_bytes(b"broken")
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    assert asked == ["s1", "s0"]
    result_of(tube_rig.subject(1), meshes[1], 242).save(out / "fits" / "s1.npz")  # as of another run with the same names
    fit_scans_of(fitter, scans, out, settings={"seed": 0})
    assert asked == ["s1", "s0", "s1"]
    asked[:] = ["s1", "s0"]
    fit_scans_of(fitter, scans[:1], out, settings={"seed": 0})
    fit_scans_of(fitter, scans, out, settings={"seed": 0})  # fewer scans in between lose nothing
    assert asked == ["s1", "s0"]
    fit_scans_of(fitter, scans, out, settings={"seed": 1}, existing="replace")
    assert asked == ["s1", "s0", "s0", "s1"]
    (out / "fits.json").write_text("{}")
    with pytest.raises(InputError, match="fits.json.*cannot be read"):
        fit_scans_of(fitter, scans, out, settings={"seed": 1})


@pytest.mark.parametrize(
    "change, words",
    [
        ({"up": "+z"}, "rig's up [+]y; expected rig's up [+]z"),
        ({"forward": "-z"}, "rig's forward [+]z; expected rig's forward -z"),
        ({"metres_per_unit": 1.0}, "rig's metres per unit 0.25; expected rig's metres per unit 1.0"),
        ({"poses": {"wave": np.full((4, 3), 0.1)}}, "rig's poses .*; expected rig's poses "),
        ({"locked": np.arange(4) == 2}, "rig's joints that are still"),
    ],
)
def test_fits_of_a_rig_with_other_axes_or_poses_are_not_taken(scans, tube_rig, meshes, tmp_path, monkeypatch, change, words):
    asked = fits_are_given(monkeypatch, {s.name: v for s, v in zip(scans, meshes)})
    rig = replace(tube_rig, granularity="arm and fingers")
    other = replace(rig, **change)
    assert other.digest == rig.digest
    fit_scans_of(lbs.LBSFitter(rig), scans[:2], tmp_path)
    with pytest.raises(InputError, match=words + ".*--existing replace"):
        fit_scans_of(lbs.LBSFitter(other), scans[:2], tmp_path)
    assert asked == ["s0", "s1"]
    fit_scans_of(lbs.LBSFitter(other), scans[:2], tmp_path, existing="replace")
    assert asked == ["s0", "s1", "s0", "s1"]


def test_what_was_learned_from_is_fitted_as_its_subjects(scans, tube_rig, meshes, tmp_path, monkeypatch):
    """Learning leaves s1; s3 was not learned from, and somebody of the same name may be another person."""
    given = {s.name: v for s, v in zip(scans, meshes)}
    asked = fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    learned = learning_is_given(monkeypatch, given | {"s1": None})

    def fit(n_jobs=None):
        told.clear(), asked.clear()
        return fit_scans_of(lbs.LBSFitter(tube_rig, n_jobs=n_jobs), scans, tmp_path, learn_from=scans[:3])

    def subjects():
        return {name: subject for name, (subject, _) in told.items()}

    fit()
    assert learned == [[("s0", "ann"), ("s1", "ann"), ("s2", "bob")]] and subjects() == {"s1": "ann", "s3": None}
    assert [e["kept"] for e in fit().entries.values()] == [True] * 4 and asked == []
    for name in ("s0", "s2", "s3"):
        (tmp_path / "fits" / f"{name}.npz").unlink()
    fit(n_jobs=2)
    assert subjects() == {"s0": "ann", "s2": "bob", "s3": None} and {f.n_jobs for _, f in told.values()} == {2}
    assert [e["kept"] for e in fit().entries.values()] == [True] * 4 and asked == []
    assert list(json.loads((tmp_path / "fits.json").read_text())["learned_from"]) == ["s0", "s1", "s2"]
    # Fits of other models, and of s3 as its namesake's, are not what would be made now.
    named = model_digest(lbs.LBSFitter.load(tmp_path / "model.npz"), named=True)
    for name, digest in (("s0", ""), ("s2", "another"), ("s3", named)):
        replace(result_of(tube_rig, meshes[0], 242), model_digest=digest).save(tmp_path / "fits" / f"{name}.npz")
    fit()
    assert subjects() == {"s0": "ann", "s2": "bob", "s3": None} and len(learned) == 1


def test_a_subject_of_whom_nothing_was_learned_is_anybody(scans, fitter, meshes, tmp_path, monkeypatch):
    given = {s.name: v for s, v in zip(scans, meshes)}
    fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    learning_is_given(monkeypatch, given | {"s2": None, "s3": None})
    fit_scans_of(fitter, scans, tmp_path, learn_from=scans)
    assert {name: subject for name, (subject, _) in told.items()} == {"s2": None, "s3": None}


# ---- the command ----


def _command(folder, out, *more):
    return ("bench", "pairs", folder, "--truth", folder / "truth.csv", "--rig", folder / "tube.npz", "-o", out, *more)


def test_a_run_that_learns_and_what_the_next_one_keeps(folder, tmp_path, run, meshes, tube_rig, monkeypatch):
    """The one test that learns in earnest, some 10 s: what the loop leaves is what the benchmark takes."""
    code, out, err = run(*_command(folder, tmp_path / "out", *QUICK_LEARNING, "--points", 50, "--pictures", 1))
    assert code in (0, 1), err  # so little training may end in a fit that says it failed
    assert "intra" in out and "inter" in out and "learned together" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert {"numpy", "commit", "cpus"} <= set(report["environment"]) and report["settings"]["seed"] == 0
    assert [s["subject"] for s in report["scans"]] == list(WHO) and len(report["pairs"]) == 12 and report["history"]
    registered = lbs.FitResult.load(tmp_path / "out" / "fits" / "s1.npz")
    assert registered.model_digest
    entry = next(e for e in report["pairs"] if (e["a"], e["b"]) == ("s0", "s1"))
    assert entry["points"] == 50 and 0 < entry["before"]["mean"] < tube_rig.size
    assert (tmp_path / "out" / "gallery.png").stat().st_size > 1000
    assert lbs.LBSFitter.load(tmp_path / "out" / "model.npz").template_.keys() == {"ann", "bob"}
    fits_are_given(monkeypatch, {})  # nothing may be fitted any more
    monkeypatch.setattr(lbs.LBSFitter, "fit", None)
    (tmp_path / "out" / "fits" / "s3.npz").unlink()
    fits_are_given(monkeypatch, {"s3": meshes[3]})
    code, out, _ = run(*_command(folder, tmp_path / "out", *QUICK_LEARNING, "--points", 50, "--markdown"))
    assert "3 scans are fitted already and kept" in out and "[1/1] s3: fitted" in out and "| intra | before the snap |" in out
    assert json.loads((tmp_path / "out" / "results.json").read_text())["history"] == report["history"]


def test_fits_one_by_one(folder, tmp_path, run, meshes, monkeypatch):
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(meshes)})
    code, out, err = run(*_command(folder, tmp_path / "out", "--no-learn", "--unit", "mm", "--pictures", 1))
    assert (code, err) == (0, "") and "fitted one by one" in out and "(mm)" in out
    assert "measuring the errors: 12 pairs\n" in out and "gallery.png, from top to bottom: s0\n" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert report["figures"]["inter"]["before"]["mean"] < 1e-9 and report["cm_per_unit"] == 0.1
    assert not (tmp_path / "out" / "model.npz").exists() and "rounds" not in report["settings"]
    assert report["gallery"] == ["s0"]
    code, out, err = run(*_command(folder, tmp_path / "out", "--no-learn", "--seed", 1))
    assert code == 2 and "fits of seed 0; expected seed 1" in one_line(err)


def test_the_options_reach_what_they_are_for(folder, scans, tmp_path, run, meshes, tube_rig, monkeypatch):
    rng, out = np.random.default_rng(0), tmp_path / "out"
    given = {f"s{i}": v + 0.02 * rng.standard_normal(v.shape) for i, v in enumerate(meshes)}
    asked = fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    options = ("--no-learn", "--pictures", 0, "--pairs", 3, "--points", 7, "--seed", 4)
    assert run(*_command(folder, out, *options, "--samples", 50))[0] == 0
    assert {f.random_state for _, f in told.values()} == {4}
    assert {len(lbs.FitResult.load(path).labels) for path in (out / "fits").iterdir()} == {50}
    report = json.loads((out / "results.json").read_text())
    truth, fits = VertexOrder(242), _fits(tmp_path, tube_rig, given)
    pairs = choose_pairs(scans, truth, 3, 4)
    assert report["pairs"] == measure_pairs(scans, truth, fits, tube_rig.faces, pairs, points=7, seed=4)["pairs"]
    assert len(report["pairs"]) == 6 and {e["points"] for e in report["pairs"]} == {7}
    code, _, err = run(*_command(folder, out, *options, "--samples", 60))
    assert code == 2 and "fits of samples 50; expected samples 60" in one_line(err)
    asked.clear()
    assert run(*_command(folder, out, *options, "--samples", 50))[0] == 0 and asked == []
    assert run(*_command(folder, out, *options, "--samples", 50, "--existing", "replace"))[0] == 0
    assert asked == ["s0", "s1", "s2", "s3"]


def test_a_picture_that_cannot_be_drawn_loses_no_figure(folder, tmp_path, run, meshes, monkeypatch):
    def write_png(path, image):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lbsfit_np.report.render.write_png", write_png)
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(meshes)})
    (tmp_path / "gallery.png").write_bytes(b"of an earlier run")
    code, out, err = run(*_command(folder, tmp_path, "--no-learn", "--pictures", 1))
    assert code == 2 and "No space left" in one_line(err) and "before the snap" in out
    report = json.loads((tmp_path / "results.json").read_text())
    assert len(report["pairs"]) == 12 and report["gallery"] == [] and not (tmp_path / "gallery.png").exists()


def test_what_an_earlier_run_wrote_is_no_scan(tube_rig, meshes, tmp_path, run, monkeypatch):
    write_meshes(tmp_path / "scans", tube_rig, meshes)
    (tmp_path / "truth.csv").write_text("scan,subject\ns0,ann\ns1,ann\ns2,bob\n")
    tube_rig.save(tmp_path / "tube.npz")
    learning_is_given(monkeypatch, {f"s{i}": v for i, v in enumerate(meshes)})
    told = []
    for _ in range(2):  # the second time OUT, which is in DIR, has a model and fits
        code, out, err = run(*_command(tmp_path, tmp_path / "out", "--pictures", 0))
        assert (code, err) == (0, "")
        told.append(next(line for line in out.splitlines() if line.startswith("note: ") and "left out" in line))
    assert "2 of 5 scan files" in told[0] and told[0] == told[1]
    assert (tmp_path / "out" / "model.npz").exists() and len(list((tmp_path / "out" / "fits").iterdir())) == 3
    (tmp_path / "out" / "other.ply").write_bytes((tmp_path / "scans" / "s0.ply").read_bytes())
    notes = read_truth(tmp_path / "truth.csv", tmp_path, output=tmp_path / "out")[2]
    assert "3 of 6 scan files" in notes[0]  # what somebody else has put there counts
    (tmp_path / "out" / "fits.json").unlink()
    assert "7 of 10 scan files" in read_truth(tmp_path / "truth.csv", tmp_path, output=tmp_path / "out")[2][0]


def test_scans_that_fail_are_named_and_their_pairs_missing(folder, tmp_path, run, meshes, tube_rig, monkeypatch):
    for path in folder.glob("s?.ply"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "s1.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\n")
    for name in ("truth.csv", "tube.npz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    fits_are_given(monkeypatch, {"s0": meshes[0], "s2": (meshes[2], {"status": "failed"}), "s3": meshes[3]})
    code, out, _ = run(*_command(tmp_path, tmp_path / "out", "--no-learn", "--pictures", 0))
    assert code == 1 and "failed: s1: " in out and "s1.ply" in out and "failed: s2: made up" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert {k: (f["pairs"], f["missing"]) for k, f in report["figures"].items()} == {"intra": (2, 2), "inter": (4, 4)}
    assert "failed" in report["scans"][1] and not (tmp_path / "out" / "gallery.png").exists()


def test_a_run_that_is_stopped_says_what_is_kept(folder, tmp_path, run, meshes, monkeypatch):
    fits_are_given(monkeypatch, {"s0": meshes[0], "s1": KeyboardInterrupt()})
    code, out, _ = run(*_command(folder, tmp_path / "out", "--no-learn"))
    assert code == 130 and "stopped: 1 fits are kept" in out


def test_sigterm_stops_a_run_as_ctrl_c_does(folder, tmp_path, run, meshes, monkeypatch):
    def unhandled(signum, frame):
        raise AssertionError("SIGTERM went past the run")

    def terminating(self, scan, **options):
        if scan.name == "s1":
            os.kill(os.getpid(), signal.SIGTERM)
        return result_of(self.rig, meshes[0], len(scan.points))

    fits_are_given(monkeypatch, {})
    monkeypatch.setattr(lbs.LBSFitter, "fit_scan", terminating)
    before = signal.signal(signal.SIGTERM, unhandled)
    try:
        code, out, _ = run(*_command(folder, tmp_path / "out", "--no-learn"))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert code == 143 and "stopped: 1 fits are kept" in out


def test_measuring_says_a_line_a_minute(capsys):
    now = [0.0]
    progress = PairsProgress(1, terminal=False, clock=lambda: now[0])
    for done in range(6):
        now[0] += 0.6 * SILENCE
        progress.measured(done, 5)
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["measuring the errors: 5 pairs", "measuring the errors: 2 of 5 pairs", "measuring the errors: 4 of 5 pairs"]
    progress.written(0, 1)
    progress.written(1, 1)
    assert capsys.readouterr().out.splitlines() == ["writing what the challenge asks for: 1 pair"]
    progress = PairsProgress(1, terminal=True)
    for done in range(3):
        progress.measured(done, 2)
    told = capsys.readouterr()
    assert told.out == "" and "measuring the errors" in told.err


@pytest.mark.parametrize(
    "change, words",
    [
        ({"-o": None}, ["-o/--output: got nothing"]),
        ({"--truth": None}, ["--truth: got nothing", "Add --truth FILE"]),
        ({"--truth": "none.csv"}, ["none.csv", "no such file"]),
        ({"--rig": "none.npz"}, ["none.npz"]),
        ({"--subject-column": "who"}, ["a column 'who'"]),
        ({"--unit": "km"}, ["invalid choice: 'km'"]),
        ({"--pairs": "0"}, ["at least 1"]),
    ],
)
def test_bad_usage(folder, tmp_path, run, change, words):
    options = {"--truth": folder / "truth.csv", "--rig": folder / "tube.npz", "-o": tmp_path / "out"} | change
    try:
        code, _, err = run("bench", "pairs", folder, *(x for pair in options.items() if pair[1] is not None for x in pair))
    except SystemExit as error:
        code, err = error.code, None
    assert code == 2 and not (tmp_path / "out").exists()
    for word in words if err else ():
        assert word in one_line(err)


def test_the_truth_must_fit_the_scans(folder, tmp_path, run, tube_rig):
    scans = write_meshes(tmp_path / "in", tube_rig, [tube_rig.vertices])
    np.savetxt(scans / "s1.xyz", tube_rig.vertices[:200])
    (scans / "truth.csv").write_text("scan,subject\ns0,a\ns1,b\n")
    (scans / "tube.npz").write_bytes((folder / "tube.npz").read_bytes())
    code, _, err = run(*_command(scans, tmp_path / "out"))
    assert code == 2 and "242 and 200 vertices" in one_line(err) and "name and vertex" in err and "s1.xyz" in err
    (scans / "truth.csv").write_text("scan,subject,name,vertex\ns0,a,tip,1\ns1,b,end,1\n")
    code, _, err = run(*_command(scans, tmp_path / "out"))
    assert code == 2 and "no two scans of which it knows the same places" in one_line(err)


def test_an_input_is_never_overwritten(tube_rig, folder, tmp_path, run):
    (tmp_path / "fits").mkdir()
    for i in range(2):
        np.savez(tmp_path / "fits" / f"s{i}.npz", points=tube_rig.vertices)
    (tmp_path / "fits" / "truth.csv").write_text("scan,subject\ns0,a\ns1,b\n")
    (tmp_path / "fits" / "tube.npz").write_bytes((folder / "tube.npz").read_bytes())
    code, _, err = run(*_command(tmp_path / "fits", tmp_path))
    assert code == 2 and "never overwritten" in one_line(err)


@pytest.mark.parametrize("option, name", [("--truth", "results.json"), ("--rig", "model.npz")])
def test_neither_the_truth_nor_the_rig_is_overwritten(folder, tmp_path, run, monkeypatch, option, name):
    fits_are_given(monkeypatch, {})
    source = folder / {"--truth": "truth.csv", "--rig": "tube.npz"}[option]
    (tmp_path / name).write_bytes(source.read_bytes())
    code, _, err = run(*_command(folder, tmp_path, "--no-learn", option, tmp_path / name))
    assert code == 2 and f"{name} is an input" in one_line(err) and "never overwritten" in err
    assert (tmp_path / name).read_bytes() == source.read_bytes()
