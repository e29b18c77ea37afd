"""The round trip of bundled rigs: what is scanned, what is counted, and the command."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import content_with_few_starts

import lbsfit_np as lbs
from lbsfit_np.bench import roundtrip as module
from lbsfit_np.bench.roundtrip import AIM, CLOSE, RIGS, roundtrip, roundtrip_scans, roundtrip_table
from lbsfit_np.errors import InputError

pytestmark = pytest.mark.usefixtures("own_cache")

QUICK = ("--scans", "2", "--training-scans", "60")


@pytest.fixture
def run(run):
    """Run ``lbsfit bench roundtrip``."""
    return partial(run, "bench", "roundtrip")


def test_aim_is_the_issues():
    assert (CLOSE, AIM, RIGS) == (0.02, 0.95, ("hand", "body"))


def test_scans_are_of_the_rigs_own_shape_in_natural_poses():
    rig = lbs.load_rig("hand-coarse")
    scans = roundtrip_scans(rig, 4, seed=1)
    for scan in scans:
        assert scan.template is rig.vertices and scan.template_joints is rig.joints and scan.scale == 1.0
        np.testing.assert_allclose(rig.pose(scan.pose), scan.vertices, atol=1e-12)
        assert ((scan.pose >= rig.lower) & (scan.pose <= rig.upper))[1:].all()
        assert 4000 < len(scan.points) <= 5000
    library = np.stack(list(rig.poses.values()))[:, 1:]
    assert max(np.sqrt(((s.pose[1:] - library) ** 2).mean(axis=(1, 2))).min() for s in scans) < 0.25
    again = roundtrip_scans(rig, 2, seed=1)
    assert np.array_equal(again[1].points, scans[1].points)
    assert not np.array_equal(roundtrip_scans(rig, 1, seed=2)[0].points[:10], scans[0].points[:10])


class Moved:
    """A fitter that knows the truth and is off by a given share of the rig's size; None is a failure."""

    def __init__(self, rig, shares):
        self.rig, self.shares = rig, iter(shares)

    def _is_pretrained(self):
        return True

    def fit_scan(self, points):
        share = next(self.shares)
        if share is None:
            raise InputError("points", "nothing", "something")
        truth = next(s for s in self.truth if s.points is points)
        joints = truth.joints + np.array([share * self.rig.size, 0, 0])
        known = {"joints": joints, "vertices": truth.vertices, "labels": truth.labels}
        return SimpleNamespace(**known, seconds=0.5, converged=True, status="ok", message="")


def test_figures_are_shares_of_the_size():
    rig = lbs.load_rig("hand-coarse")
    scans = roundtrip_scans(rig, 4, seed=0)
    fitter = Moved(rig, [0.01, 0.0199, 0.03, None])
    fitter.truth = scans
    figures = module._fit_seed(fitter, rig, scans, 1, None)
    assert [e.get("joint_error") for e in figures["scans"]] == pytest.approx([0.01, 0.0199, 0.03, None])
    assert figures["median"] == pytest.approx(0.0199) and 0.0289 < figures["p95"] < 0.03
    assert figures["close"] == 0.5 and figures["failed"] == 1 and figures["labels"] == 1.0
    assert "points: got nothing" in figures["scans"][3]["failed"]
    nothing = module._fit_seed(Moved(rig, [None]), rig, scans[:1], 1, None)
    assert nothing["median"] is None and nothing["close"] == 0.0


def test_command(run, tmp_path, monkeypatch):
    content_with_few_starts(monkeypatch)
    out = tmp_path / "out"
    code, text, err = run("hand-coarse", "-o", out, "--seeds", "3,4", *QUICK)
    assert (code, err) == (0, "")
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    entry = report["rigs"]["hand-coarse"]
    assert list(entry["seeds"]) == ["3", "4"] and len(entry["seeds"]["3"]["scans"]) == 2
    errors = [e["joint_error"] for s in entry["seeds"].values() for e in s["scans"]]
    assert entry["all"]["median"] == pytest.approx(np.median(errors)) and 0 < min(errors) and max(errors) < 0.3
    assert entry["all"]["close"] == np.mean(np.array(errors) <= 0.02)
    assert report["settings"]["training_scans"] == 60 and report["settings"]["test_scans"]["shape"] == 0.0
    assert text.rstrip().endswith(roundtrip_table(report))
    assert roundtrip_table(report, markdown=True).startswith("| rig | seed | median |")
    for words in ("hand-coarse", " all ", "2 scans a seed", "at least 95 %", "60 synthetic scans"):
        assert words in text, words
    code, _, err = run("hand-coarse", "-o", out, *QUICK)
    assert code == 2 and "results.json exists already" in err
    again = roundtrip(["hand-coarse"], n_scans=1, seeds=[3], training_scans=60)
    (once_more,) = again["rigs"]["hand-coarse"]["seeds"]["3"]["scans"]
    assert once_more["joint_error"] == entry["seeds"]["3"]["scans"][0]["joint_error"]


def test_usage(run, tmp_path, tube_rig):
    tube_rig.save(tmp_path / "tube.npz")
    code, _, err = run(tmp_path / "tube.npz", *QUICK)
    assert code == 2 and "no library of natural poses" in err and err.count("\n") == 1
    (tmp_path / "mine").mkdir()
    for out in (tmp_path / "new" / "out", tmp_path / "mine" / "out", tmp_path / "mine"):
        code, _, err = run("hnad", "-o", out, *QUICK)
        assert code == 2 and "hand-coarse" in err and err.count("\n") == 1
    assert {path.name for path in tmp_path.rglob("*")} == {"tube.npz", "mine"}  # no empty folder is left
    code, _, err = run("hand", "--seeds", "1,1")
    assert code == 2 and "different whole numbers" in err
    code, text, _ = run("--help")
    assert code == 0 and "(default: 40)" in " ".join(text.split()) and "lbsfit bench roundtrip hand" in text
    with pytest.raises(InputError, match="seeds"):
        roundtrip(["hand"], seeds=[])


def test_rigs_are_checked_before_anything_is_trained(monkeypatch, tube_rig):
    without = replace(lbs.load_rig("hand-coarse"), poses={})
    monkeypatch.setattr(module, "load_rig", lambda name: without)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained"))
    with pytest.raises(InputError, match="no library"):
        roundtrip(["hand-coarse"])
