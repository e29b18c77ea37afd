"""The round trip of bundled rigs: what is scanned, what is counted, and the command."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import content_with_few_starts
from learning_runs import learning_is_hurried

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


@pytest.mark.slow
def test_command(run, tmp_path, monkeypatch):
    content_with_few_starts(monkeypatch)
    learning_is_hurried(monkeypatch)
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
    before = (out / "results.json").read_bytes()
    code, _, err = run("hand-coarse", "-o", out, "--seeds", "3,4", *QUICK, "--scans", "3")
    words = "-o: got results with scans_a_seed 2; expected scans_a_seed 3. Choose another folder, or --existing replace."
    assert code == 2 and words in err and (out / "results.json").read_bytes() == before
    again = roundtrip(["hand-coarse"], n_scans=1, seeds=[3], training_scans=60)
    (once_more,) = again["rigs"]["hand-coarse"]["seeds"]["3"]["scans"]
    assert once_more["joint_error"] == entry["seeds"]["3"]["scans"][0]["joint_error"]


# ---- going on ----


class Known:
    """A fitter that is told the truth, and misses it by what the number of its scan decides."""

    def __init__(self, rig, **parameters):
        self.rig = rig

    def pretrain(self, *, cache, progress):
        self.trained.append(self.rig.name)

    def fit_scan(self, points):
        k, truth = next((k, s) for k, s in enumerate(self.truth) if s.points is points)
        joints = truth.joints + np.array([0.01 * (k + abs(truth.pose).max()) * self.rig.size, 0, 0])
        known = {"joints": joints, "vertices": truth.vertices, "labels": truth.labels}
        return SimpleNamespace(**known, seconds=0.5, converged=True, status="ok", message="")


@pytest.fixture
def known(monkeypatch):
    """Fits without fitting."""

    def scans(*given, **more):
        Known.truth = roundtrip_scans(*given, **more)
        return Known.truth

    monkeypatch.setattr(Known, "trained", [], raising=False)
    monkeypatch.setattr(module, "roundtrip_scans", scans)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter", Known)
    return Known


RIGS_OF_A_RUN = ["hand-coarse", "body-coarse"]


def _found(report):
    """Its figures, without what hangs on when they were made."""
    entries = json.loads(json.dumps(report["rigs"]))
    for entry in entries.values():
        for run in entry["seeds"].values():
            del run["wall_seconds"]
    return entries


def test_a_run_that_is_stopped_goes_on_to_the_same_figures(run, known, tmp_path, monkeypatch):
    whole = roundtrip(RIGS_OF_A_RUN, n_scans=2, seeds=[10, 9])
    out, done, fit_seed = tmp_path / "out", [], module._fit_seed

    def stopping(*given):
        if len(done) in stops:
            raise KeyboardInterrupt
        done.append(given[1].name)
        return fit_seed(*given)

    monkeypatch.setattr(module, "_fit_seed", stopping)
    command, stops = (*RIGS_OF_A_RUN, "--scans", "2", "--seeds", "10,9"), {0}
    code, text, _ = run(*command, "-o", out)
    assert code == 130 and "kept" not in text and not out.exists()
    for stops in ({1}, {1}, {3}):
        code, text, _ = run(*command, "-o", out)
        assert code == 130 and f"stopped: finished work is kept in {out}; run the same command to continue\n" in text
        report = json.loads((out / "results.json").read_text(encoding="utf-8"))
        assert not report["complete"] and sum(len(e["seeds"]) for e in report["rigs"].values()) == max(stops)
    stops = ()
    known.trained.clear()
    code, text, _ = run(*command, "-o", out)
    assert code == 0 and len(done) == 4 and known.trained == [done[-1]]
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert _found(report) == _found(whole) and report["complete"] and whole["complete"]
    assert text.rstrip().endswith(roundtrip_table(whole))
    # Nothing is left to do; and more seeds are added, of the rigs that are asked for.
    code, text, _ = run(*command, "-o", out, "--markdown")
    assert code == 0 and len(done) == 4 and text.strip() == roundtrip_table(whole, markdown=True)
    assert run("body-coarse", "--scans", "2", "--seeds", "9,11", "-o", out)[0] == 0 and len(done) == 5
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert not report["complete"] and [len(report["rigs"][name]["seeds"]) for name in RIGS_OF_A_RUN] == [2, 3]
    # Without a folder there is nothing to go on with.
    stops = {6}
    code, text, _ = run(*command)
    assert code == 130 and "kept" not in text


@pytest.mark.parametrize("change", [{"metres_per_unit": 0.01}, {"forward": "-x"}, {"up": "+x"}, {"poses": None}])
def test_results_of_another_rig_are_not_gone_on_with(known, monkeypatch, change):
    rig = lbs.load_rig("hand-coarse")
    report = json.loads(json.dumps(roundtrip(["hand-coarse"], n_scans=1, seeds=[3])))
    known.trained.clear()
    key, value = next(iter(change.items()))
    value = dict(list(rig.poses.items())[1:]) if key == "poses" else value
    monkeypatch.setattr(module, "load_rig", lambda name: replace(rig, **{key: value}))
    words = f"before: got results of 'hand-coarse' with other {key.replace('_', ' ')}.* than this run's.*--existing replace"
    with pytest.raises(InputError, match=words):
        roundtrip(["hand-coarse"], n_scans=1, seeds=[3, 4], before=report)
    assert not known.trained


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"n_scans": 2}, "results with scans_a_seed 1; expected scans_a_seed 2"),
        ({"training_scans": 60}, "results with training_scans 4000; expected training_scans 60"),
    ],
)
def test_results_of_other_settings_are_left_alone(known, monkeypatch, given, words):
    report = roundtrip(["hand-coarse"], n_scans=1, seeds=[3])
    with pytest.raises(InputError, match=f"before: got {words}.*--existing replace"):
        roundtrip(["hand-coarse"], **{"n_scans": 1, "seeds": [3], "before": report} | given)
    with pytest.raises(InputError, match="results of starts; expected results of roundtrip"):
        roundtrip(["hand-coarse"], n_scans=1, seeds=[3], before={"benchmark": "starts"})
    monkeypatch.setattr(module, "CLOSE", 0.03)
    with pytest.raises(InputError, match="results with close 0.02; expected close 0.03"):
        roundtrip(["hand-coarse"], n_scans=1, seeds=[3], before=report)
    assert len(known.trained) == 1


def test_the_aim_is_that_of_this_version(known):
    whole = json.loads(json.dumps(roundtrip(["hand-coarse"], n_scans=1, seeds=[3])))
    report = roundtrip(["hand-coarse"], n_scans=1, seeds=[3], before=whole | {"aim": 0.5})
    assert report == whole and "at least 95 %" in roundtrip_table(report)


def test_seeds_of_several_commits_are_told(known):
    report = roundtrip(["hand-coarse"], n_scans=1, seeds=[3, 4], jobs=1)
    seeds = report["rigs"]["hand-coarse"]["seeds"]
    assert all("numpy" in run["environment"] and run["jobs"] == 1 for run in seeds.values())
    assert "several states" not in roundtrip_table(report)
    seeds["4"]["environment"] = {"commit": "0123456789abcdef"}
    assert roundtrip_table(report).endswith("; 0123456789ab: hand-coarse 4.")


def test_usage(run, tmp_path, tube_rig):
    tube_rig.save(tmp_path / "tube.npz")
    code, _, err = run(tmp_path / "tube.npz", *QUICK)
    assert code == 2 and "no library of natural poses" in err and err.count("\n") == 1
    (tmp_path / "mine").mkdir()
    for out in (tmp_path / "new" / "out", tmp_path / "mine" / "out", tmp_path / "mine"):
        code, _, err = run("hnad", "-o", out, *QUICK)
        assert code == 2 and "hand-coarse" in err and err.count("\n") == 1
    assert {path.name for path in tmp_path.rglob("*")} == {"tube.npz", "mine"}  # no empty folder is left
    for seeds in ("1,1", "1" * 5000):
        code, _, err = run("hand", "--seeds", seeds)
        assert code == 2 and "different whole numbers" in err and len(err) < 400
    code, text, _ = run("--help")
    assert code == 0 and "(default: 40)" in " ".join(text.split()) and "lbsfit bench roundtrip hand" in text
    for seeds in ([], [1, 1], [-1], [1.7], "12", 5, None):
        with pytest.raises(InputError, match="seeds: got .*different numbers of at least 0"):
            roundtrip(["hand"], seeds=seeds)


def test_rigs_are_checked_before_anything_is_trained(monkeypatch, tube_rig):
    without = replace(lbs.load_rig("hand-coarse"), poses={})
    monkeypatch.setattr(module, "load_rig", lambda name: without)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained"))
    with pytest.raises(InputError, match="no library"):
        roundtrip(["hand-coarse"])
