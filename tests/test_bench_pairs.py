"""The benchmark of pairs: what it measures where the truth is known, and its table and gallery."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from registered_sets import WHO, result_of
from scipy.spatial.transform import Rotation

import lbsfit_np as lbs
from lbsfit_np.bench.pair_fits import Fits
from lbsfit_np.bench.pair_pictures import gallery, gallery_of
from lbsfit_np.bench.pairs import choose_pairs, measure_pairs, pairs_table, summary, unit_of
from lbsfit_np.bench.truth import Landmarks, Registrations, VertexOrder
from lbsfit_np.errors import InputError
from lbsfit_np.report.colors import part_colors

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]

SHIFT = np.array([0.03, 0, 0.04])


def _truth(kind, rig, meshes):
    if kind == "order":
        return VertexOrder(len(meshes[0]))
    if kind == "registrations":
        return Registrations(tuple(meshes), rig.faces)
    rows = dict(zip("abcdef", (0, 50, 100, 150, 200, 241)))
    places = [rows if i % 2 else {n: tuple(meshes[i][r]) for n, r in rows.items()} for i in range(len(meshes))]
    return Landmarks(tuple(places), ({},) * len(meshes))


@pytest.mark.parametrize("kind", ["order", "registrations", "landmarks"])
def test_exact_registrations_give_no_error(pair_scans, tube_rig, pair_meshes, kind):
    truth = _truth(kind, tube_rig, pair_meshes)
    fits = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    pairs = choose_pairs(pair_scans, truth, 99, 0)
    assert len(pairs["intra"]) == 4 and len(pairs["inter"]) == 8
    found = measure_pairs(pair_scans, truth, fits, tube_rig.faces, pairs)
    for kind in ("intra", "inter"):
        figures = found["figures"][kind]
        assert figures["pairs"] == len(pairs[kind]) and figures["missing"] == 0
        for when in ("before", "after"):
            assert max(figures[when].values()) < 1e-9
    assert len(found["pairs"]) == 12


@pytest.mark.parametrize("kind", ["order", "registrations", "landmarks"])
def test_a_shifted_registration_is_off_by_the_shift(pair_scans, tube_rig, pair_meshes, kind):
    """Onto a scan whose registration is shifted every place is off by as much; the snap brings it back where it is small."""
    truth = _truth(kind, tube_rig, pair_meshes)
    given = {s.name: v for s, v in zip(pair_scans, pair_meshes)} | {"s1": pair_meshes[1] + SHIFT}
    pairs, fits = {"intra": [(0, 1)], "inter": [(2, 1)]}, given
    found = measure_pairs(pair_scans, truth, fits, tube_rig.faces, pairs)
    for entry in found["pairs"]:
        assert entry["b"] == "s1"
        for value in entry["before"].values():
            assert value == pytest.approx(0.05, rel=1e-9)
    given["s1"] = pair_meshes[1] + 1e-6
    found = measure_pairs(pair_scans, truth, given, tube_rig.faces, {"intra": [(0, 1)], "inter": []})
    assert found["figures"]["intra"]["before"]["mean"] == pytest.approx(3**0.5 * 1e-6)
    assert found["figures"]["intra"]["after"]["mean"] < 1e-12
    assert found["figures"]["inter"] == {"pairs": 0, "missing": 0, "before": summary([]), "after": summary([])}


def test_only_places_that_both_scans_know_count(pair_scans, tube_rig, pair_meshes):
    places = ({"tip": 3, "end": 100, "side": 200}, {"end": 100, "side": 200, "none": 7}, {}, {})
    fits = {s.name: v for s, v in zip(pair_scans, pair_meshes)} | {"s1": pair_meshes[1] + SHIFT}
    truth = Landmarks(places, ({},) * 4)
    pairs = choose_pairs(pair_scans, truth, 99, 0)
    assert pairs == {"intra": [(0, 1), (1, 0)], "inter": []}
    entry = measure_pairs(pair_scans, truth, fits, tube_rig.faces, {"intra": [(0, 1)], "inter": []})["pairs"][0]
    assert entry["points"] == 2 and entry["before"]["p95"] == pytest.approx(0.05)


def test_the_measure_is_what_transfer_finds(pair_scans, tube_rig, pair_meshes):
    rng = np.random.default_rng(0)
    given = {s.name: v + 0.02 * rng.standard_normal(v.shape) for s, v in zip(pair_scans, pair_meshes)}
    fits = given
    found = measure_pairs(pair_scans, VertexOrder(242), fits, tube_rig.faces, {"intra": [(0, 1), (3, 2)], "inter": [(0, 3)]})
    pooled = []
    for a, b in ((0, 1), (3, 2), (0, 3)):
        entry = next(e for e in found["pairs"] if (e["a"], e["b"]) == (f"s{a}", f"s{b}"))
        for when, snap in (("before", None), ("after", pair_meshes[b])):
            at = lbs.transfer(pair_meshes[a], given[f"s{a}"], given[f"s{b}"], tube_rig.faces, snap_to=snap)
            away = np.linalg.norm(at - pair_meshes[b], axis=1)
            assert entry[when]["mean"] == pytest.approx(away.mean())
            assert entry[when]["median"] == pytest.approx(np.median(away))
            assert entry[when]["p90"] == pytest.approx(np.percentile(away, 90))
            assert entry[when]["p95"] == pytest.approx(np.percentile(away, 95))
            if when == "before" and (a, b) != (0, 3):
                pooled.append(away)
    assert found["figures"]["intra"]["before"]["p90"] == pytest.approx(np.percentile(np.concatenate(pooled), 90))


def test_pairs_of_scans_without_a_fit_are_missing(pair_scans, tube_rig, pair_meshes):
    fits = {s.name: v for s, v in zip(pair_scans, pair_meshes)} | {"s3": None}
    truth = VertexOrder(242)
    found = measure_pairs(pair_scans, truth, fits, tube_rig.faces, choose_pairs(pair_scans, truth, 99, 0), points=10)
    assert {k: (f["pairs"], f["missing"]) for k, f in found["figures"].items()} == {"intra": (2, 2), "inter": (4, 4)}
    assert {e["points"] for e in found["pairs"]} == {10}


def test_pairs_of_which_no_place_that_is_drawn_is_known_on_both_are_missing(pair_scans, tube_rig, pair_meshes):
    fits = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    many = {f"p{k}": k for k in range(40)}
    truth = Landmarks((many | {"end": 100}, {"end": 100}, many, {}), ({},) * 4)
    pairs = {"intra": [(0, 1), (1, 0)], "inter": [(0, 2)]}
    found = measure_pairs(pair_scans, truth, fits, tube_rig.faces, pairs, points=1)
    assert {k: (f["pairs"], f["missing"]) for k, f in found["figures"].items()} == {"intra": (1, 1), "inter": (1, 0)}
    assert [(e["a"], e["b"], e["points"]) for e in found["pairs"]] == [("s1", "s0", 1), ("s0", "s2", 1)]


def test_points_are_chosen_by_the_seed(pair_scans, tube_rig, pair_meshes):
    rng = np.random.default_rng(0)
    fits = {s.name: v + 0.02 * rng.standard_normal(v.shape) for s, v in zip(pair_scans, pair_meshes)}
    a, b, c = (
        measure_pairs(pair_scans, VertexOrder(242), fits, tube_rig.faces, {"intra": [(0, 1)], "inter": []}, points=20, seed=seed)
        for seed in (1, 1, 2)
    )
    assert a == b != c


def test_points_of_different_scans_are_chosen_apart(pair_scans, tube_rig, pair_meshes):
    asked = {}

    class Watched(VertexOrder):
        def asked(self, i, points, most, rng):
            found = super().asked(i, points, most, rng)
            asked[i] = found.keys.tolist()
            return found

    fits = {s.name: v for s, v in zip(pair_scans, pair_meshes)}
    measure_pairs(pair_scans, Watched(242), fits, tube_rig.faces, {"intra": [(0, 1), (1, 0)], "inter": [(0, 2)]}, points=20)
    assert len(asked[0]) == len(asked[1]) == 20 and set(asked) == {0, 1} and asked[0] != asked[1]


def test_registrations_of_any_method_are_checked(pair_scans, tube_rig, pair_meshes):
    """Those of another mesh would be compared by their first vertices; a name that no scan has would be a missing pair."""
    given, pairs = {s.name: v for s, v in zip(pair_scans, pair_meshes)}, {"intra": [(0, 1)], "inter": [(0, 2)]}
    for name, V, words in (
        ("s1", np.vstack([pair_meshes[1]] * 2), r"registered\['s1'\]: got shape \(484, 3\); expected shape \(242, 3\)"),
        ("s0", pair_meshes[0][:100], r"registered\['s0'\]: got shape \(100, 3\); expected shape \(242, 3\)"),
        ("s0", pair_meshes[:1], r"registered\['s0'\]: got shape \(1, 242, 3\)"),
        ("s1", np.where(np.arange(242)[:, None] == 3, np.nan, pair_meshes[1]), r"registered\['s1'\]: got 3 values that are NaN"),
        ("s1.ply", pair_meshes[1], r"registered\['s1.ply'\]: got the name of no scan; expected names such as 's0'"),
    ):
        with pytest.raises(InputError, match=words):
            measure_pairs(pair_scans, VertexOrder(242), given | {name: V}, tube_rig.faces, pairs)
    nothing = given | {"s2": np.full((242, 3), np.nan), "s3": None}
    figures = measure_pairs(pair_scans, VertexOrder(242), nothing, tube_rig.faces, pairs)["figures"]
    assert (figures["intra"]["missing"], figures["inter"]["missing"]) == (0, 1)
    as_lists = {name: V.tolist() for name, V in given.items()}
    assert measure_pairs(pair_scans, VertexOrder(242), as_lists, tube_rig.faces, pairs)["figures"]["inter"]["pairs"] == 1


def test_measuring_is_told_from_its_beginning(pair_scans, tube_rig, pair_meshes):
    fits, told = {s.name: v for s, v in zip(pair_scans, pair_meshes)}, []
    pairs = {"intra": [(0, 1), (1, 0)], "inter": []}
    measure_pairs(pair_scans, VertexOrder(242), fits, tube_rig.faces, pairs, points=5, on_pair=lambda *a: told.append(a))
    assert told == [(0, 2), (1, 2), (2, 2)]


def test_pairs_are_chosen_by_the_seed(pair_scans):
    truth = VertexOrder(5)
    chosen = choose_pairs(pair_scans, truth, 3, 1)
    assert [len(pairs) for pairs in chosen.values()] == [3, 3] and all(a != b for pairs in chosen.values() for a, b in pairs)
    assert all((WHO[a] == WHO[b]) == (kind == "intra") for kind, pairs in chosen.items() for a, b in pairs)
    assert chosen == choose_pairs(pair_scans, truth, 3, 1) != choose_pairs(pair_scans, truth, 3, 2)


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


def test_fits_that_were_told_the_unit_say_it():
    fits = SimpleNamespace(entries={"a": {"scale": 0.4, "unit": "cm"}, "b": {"failed": "x"}, "c": {"scale": 0.5, "unit": "cm"}})
    rig = SimpleNamespace(metres_per_unit=0.01)
    assert unit_of(rig, fits) == ("cm", 1.0) and unit_of(rig, fits, "mm") == ("mm", 0.1)


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


def test_the_gallery_shows_the_labels_found(tube_rig, pair_meshes, monkeypatch):
    drawn = []

    def render(*items, **options):
        drawn.append(items)
        return np.zeros((4, 4, 3), dtype=np.uint8)

    monkeypatch.setattr("lbsfit_np.bench.pair_pictures.render", render)
    labels = np.arange(242) % 4
    gallery(tube_rig, [(pair_meshes[0], replace(result_of(tube_rig, pair_meshes[1], 242), labels=labels))])
    colors = part_colors(4)
    (cloud,), (mesh,), (over, plain) = drawn[:3]
    for points in (cloud, over):
        np.testing.assert_array_equal(points.points, pair_meshes[0])
        np.testing.assert_array_equal(points.colors, colors[labels])
    np.testing.assert_array_equal(mesh.vertices, pair_meshes[1])
    np.testing.assert_array_equal(mesh.colors, colors[tube_rig.vertex_labels])
    assert len(drawn) == 6 and np.array_equal(plain.vertices, pair_meshes[1])
    np.testing.assert_array_equal(plain.colors, (205, 205, 210))


def test_the_gallery_shows_fits_as_other_pictures_do(tube_rig, pair_meshes, monkeypatch):
    """Turned back, and no point far away makes a speck of all else."""
    drawn = []

    def render(*items, frame, **options):
        drawn.append((items, frame))
        return np.zeros((4, 4, 3), dtype=np.uint8)

    monkeypatch.setattr("lbsfit_np.bench.pair_pictures.render", render)
    turn = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()
    fit = result_of(tube_rig, pair_meshes[1] @ turn.T, 243)
    fit.pose[tube_rig.root] = [0, np.pi / 2, 0]
    confidence = np.append(np.ones(242), 0.0)
    points = np.vstack([pair_meshes[1] @ turn.T, [[900.0, 0, 0]]])
    gallery(tube_rig, [(points, replace(fit, confidence=confidence))])
    ((cloud,), frame), ((mesh,), _) = drawn[:2]
    np.testing.assert_allclose(mesh.vertices, pair_meshes[1], atol=1e-12)
    np.testing.assert_allclose(cloud.points[:242], pair_meshes[1], atol=1e-12)
    assert cloud.colors[242].tolist() == [205, 205, 205] and np.abs(frame).max() < 3 * tube_rig.size
