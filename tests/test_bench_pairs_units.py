"""The benchmark of pairs where not all scans are in one unit: their pairs are left out, and people are told."""

import json
import shutil

import numpy as np
import pytest
from registered_sets import WHO, fits_are_given, learning_is_given, write_meshes

import lbsfit_np as lbs
from lbsfit_np.bench.pair_fits import Fits
from lbsfit_np.bench.pairs import in_another_unit
from lbsfit_np.bench.truth import PairScan
from lbsfit_np.io.write import write_points_ply

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]


@pytest.fixture
def mixed(pair_folder, pair_meshes, tube_rig, tmp_path):
    """The scans, the last of them in an unit of its own, and their registrations."""
    meshes = [v * (1000.0 if i == 3 else 1.0) for i, v in enumerate(pair_meshes)]
    folder = write_meshes(tmp_path / "scans", tube_rig, meshes)
    for name in ("truth.csv", "tube.npz"):
        shutil.copy(pair_folder / name, folder)
    return folder, {f"s{i}": (v + 0.01, {"scale": 1000.0 if i == 3 else 1.0}) for i, v in enumerate(meshes)}


def _command(folder, out, *more):
    command = ("bench", "pairs", folder, "--truth", folder / "truth.csv", "--rig", folder / "tube.npz", "-o", out)
    return (*command, "--pictures", 0, *more)


def test_pairs_of_a_scan_in_another_unit_are_left_out_counted_and_told(mixed, tmp_path, run, monkeypatch):
    folder, given = mixed
    fits_are_given(monkeypatch, given)
    code, out, err = run(*_command(folder, tmp_path / "out", "--no-learn", "--unit", "m"))
    assert (code, err) == (0, "")
    said = "s3 seems to be in another unit than the other scans (the scale of its fit is 1000 times theirs): 6 pairs left out"
    assert f"note: {said} of the figures; convert it and run again\n" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    counts = {kind: (f["pairs"], f["missing"], f["other_unit"]) for kind, f in report["figures"].items()}
    assert counts == {"intra": (2, 0, 2), "inter": (4, 0, 4)}
    assert all("s3" not in (e["a"], e["b"]) for e in report["pairs"]) and report["figures"]["intra"]["before"]["p95"] < 0.1
    assert report["notes"][-1].startswith("s3 seems")


def test_where_no_pair_is_in_one_unit_the_run_fails_and_keeps_its_fits(mixed, tmp_path, run, monkeypatch):
    folder, given = mixed
    for name in ("s1", "s2"):
        (folder / f"{name}.ply").unlink()
    rows = (folder / "truth.csv").read_text().splitlines()
    (folder / "truth.csv").write_text("\n".join(r for r in rows if not r.startswith(("s1", "s2"))))
    fits_are_given(monkeypatch, given)
    code, _, err = run(*_command(folder, tmp_path / "out", "--no-learn"))
    assert code == 2 and "in another unit than the others, and no pair without it" in err and "Convert them" in err
    assert len(list((tmp_path / "out" / "fits").glob("*.npz"))) == 2


def test_nothing_is_left_out_where_all_are_in_one_unit(pair_folder, pair_meshes, tmp_path, run, monkeypatch):
    """Not even of a fit whose scale is wrong."""
    fits_are_given(monkeypatch, {f"s{i}": (v, {"scale": 40.0 if i == 3 else 1.0}) for i, v in enumerate(pair_meshes)})
    code, out, _ = run(*_command(pair_folder, tmp_path / "out", "--no-learn"))
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert code == 0 and "in another unit" not in out + "".join(report["notes"])
    assert all(set(figures) == {"pairs", "missing", "before", "after"} for figures in report["figures"].values())
    assert len(report["pairs"]) == 12 and not any("not_learned" in scan for scan in report["scans"])


@pytest.mark.parametrize(
    "scales, odd",
    [
        ((1, 1, 1.2, 1, 1), {}),
        ((1, 0.4, 2.5, 1, 1), {}),  # young and old
        ((1000, 1000, 1000, 10, 1000), {"s3": 0.01}),
        ((1, 1, 1000, 1, 25.4), {"s2": 1000, "s4": 25.4}),
        ((1, 1000, 1000, 1000, 1), {"s0": 0.001, "s4": 0.001}),
    ],
)
def test_scans_that_are_unlike_most_are_in_another_unit(scales, odd, tmp_path):
    cloud = np.random.default_rng(0).standard_normal((50, 3))
    scans = [PairScan(f"s{i}", tmp_path / f"s{i}.ply", "ann") for i in range(len(scales))]
    for scan, scale in zip(scans, scales, strict=True):
        write_points_ply(scan.path, cloud * scale)
    entries = {s.name: {"scale": scale} for s, scale in zip(scans, scales, strict=True)}
    assert in_another_unit(scans, Fits(tmp_path, entries)) == pytest.approx(odd)
    assert in_another_unit(scans, Fits(tmp_path, {s.name: {"failed": "x"} for s in scans})) == {}


def test_scans_that_learning_could_not_use_are_told_also_by_the_next_run(pair_folder, pair_meshes, tmp_path, run, monkeypatch):
    given = {f"s{i}": v for i, v in enumerate(pair_meshes)}
    fits_are_given(monkeypatch, given)
    learning_is_given(monkeypatch, given | {"s2": None})
    fit = lbs.LBSFitter.fit

    def fit_all_but_one(self, *args, **options):
        fit(self, *args, **options)
        self.failures_ = {2: "an extent of 1e+03, where the other scans have about 1"}
        return self

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit_all_but_one)
    for _ in range(2):
        code, out, _ = run(*_command(pair_folder, tmp_path / "out"))
        why = "an extent of 1e+03, where the other scans have about 1"
        assert code == 0 and f"note: 1 of 4 scans without a result of learning: s2: {why}\n" in out
        report = json.loads((tmp_path / "out" / "results.json").read_text())
        assert [scan.get("not_learned") for scan in report["scans"]] == [None, None, why, None]
        assert report["notes"][-1].endswith(why) and [scan["subject"] for scan in report["scans"]] == list(WHO)
        monkeypatch.setattr(lbs.LBSFitter, "fit", None)
