"""What ``lbsfit learn`` cannot learn from: one clear line, before any work where that is possible."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import QUICK_LEARNING, one_line

import lbsfit_np as lbs
from lbsfit_np.errors import FileError
from lbsfit_np.io.write import write_points_ply
from lbsfit_np.learning.collection import HELD_OUT, LEARNED_FROM

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((), ["RIG", "SCAN"]),
        (("tube.npz",), ["SCAN"]),
        (("tube.npz", "t0.ply"), ["-o/--output", "Add -o MODEL.npz"]),
        (("tube.npz", "t0.ply", "-o", ""), ["-o/--output", "an empty text"]),
        (("tube.npz", "t0.ply", "-o", "model"), ["model, which has no ending", ".npz", "Call it model.npz"]),
        (("tube.npz", "t0.ply", "-o", "model.pkl"), ["ends in '.pkl'", "Call it model.npz."]),
        (("tube.npz", "t0.ply", "-o", "sub/x.PLY"), ["ends in '.PLY'", "Call it sub/x.npz."]),
        (("tube.npz", "t0.ply", "-o", "m.bvh"), ["ends in '.bvh'", "Call it m.npz."]),
        (("tube.npz", "t0.ply", "-o", "m.v2.H5"), ["ends in '.H5'", "Call it m.v2.npz."]),
        (("tube.npz", "t0.ply", "-o", "anna.v2"), ["ends in '.v2'", "Call it anna.v2.npz."]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--pictures"), ["--pictures: got no --results", "Add --results OUT."]),
        (("tube.npz", "t0.ply", "-o", "tube.npz", "--existing", "replace"), ["which is an input", "never overwritten"]),
        (("tube.npz", "t0.ply", "-o", "there.npz", "--card", "there.npz"), ["which is an input", "never overwritten"]),
        (("tube.npz", "t0.ply", "-o", "there.npz", "--subjects", "there.npz"), ["which is an input", "never overwritten"]),
        (("tube.npz", "t0.ply", "cloud.npz", "-o", "cloud.npz", "--existing", "replace"), ["an input (cloud.npz)"]),
        (("tube.npz", "t0.ply", "-o", "there.npz"), ["there.npz", "exists already", "--existing replace"]),
        (("tube.npz", "t0.ply", "-o", "folder.npz"), ["folder.npz", "a folder"]),
        (("tube.npz", "t0.ply", "-o", "m" * 300 + ".npz"), ["mmm", "too long"]),
        (("tube.npz", "t0.ply", "-o", "t0.ply/m.npz"), ["-o/--output: got t0.ply, a file; expected a folder to write to"]),
        (("tube.npz", "t0.ply", "-o", "t0.ply/new/m.npz"), ["-o/--output: got t0.ply, a file; expected a folder to write to"]),
        (("tube.npz", "t0.ply", "-o", "."), ["-o/--output: got ., which is a folder;", "Call it model.npz."]),
        (("tube.npz", "t0.ply", "-o", "sub"), ["-o/--output: got sub, which is a folder;", "Call it sub/model.npz."]),
        (("tube.npz", "t0.ply", "t0.ply", "-o", "m.npz"), ["SCAN: got t0.ply twice"]),
        (("tube.npz", "t0.ply", "./t0.ply", "-o", "m.npz"), ["SCAN", "twice"]),
        (("tube.npz", "t0.ply", "none.ply", "-o", "m.npz"), ["SCAN", "none.ply", "does not exist"]),
        (("tube.npz", ".", "-o", "m.npz"), ["SCAN", "a folder"]),
        (("none.npz", "t0.ply", "-o", "m.npz"), ["none.npz", "no such file"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--results", "t1.ply"), ["--results: got t1.ply, a file; expected a folder"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--results", "old"), ["--results: got old", "exists already"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--results", "m.npz"), ["--results: got m.npz, with m.npz as the model"]),
        (("tube.npz", "t0.ply", "-o", "new/m.npz", "--results", "sub/../new/m.npz/fits"), ["other than m.npz and those"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--results", "m.npz.unfinished"), ["--results", "other than m.npz.unfinished"]),
        (("tube.npz", "t0.ply", "-o", "cut.npz"), ["-o/--output: got cut.npz, whose steps", "or remove cut.npz.unfinished"]),
        (("tube.npz", "t0.ply", "-o", "m" * 248 + ".npz"), ["-o/--output", "steps cannot be kept", "Choose another name."]),
        (("tube.npz", "t0.ply", "-o", "new/t0.fit.npz", "--results", "new"), ["t0.fit.npz", "a file of --results"]),
        (("tube.npz", "t0.ply", "sub/t0.ply", "-o", "m.npz", "--results", "new"), ["both be called", "learn without --results"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--rounds", "0"), ["--rounds", "at least 1"]),
        (("tube.npz", "t0.ply", "-o", "new/m.npz", "--max-points", "3"), ["--max-points: got 3", "at least 4"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--held-out", "1"), ["--held-out", "'1'", "from 0 to 0.9"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--held-out", "nan"), ["--held-out", "from 0 to 0.9"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--smooth", "-1"), ["--smooth", "at least 0"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--smooth", "inf", "--sequence"), ["--smooth", "at least 0"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--smooth", "1e-5"), ["--smooth", "without --sequence"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--variant", "best"), ["--variant", "'best'", "pose-only"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--existing", "skip"), ["'skip'", "'replace'). lbsfit learn never skips"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--jobs", "0"), ["--jobs", "at least 1"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--training", "trun=1"), ["trun", "Did you mean 'turn'?"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--training", f"n_points={10**30}"), ["--training: got n_points: 1", "at most"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--parts", "toes"), ["'toes'", "arm and fingers"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--subjects", "none.csv"), ["none.csv", "no such file"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--subjects", "one.csv"), ["one.csv", "'t1' in line 2", "none of the scans"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "bad.toml"), ["bad.toml", "'round'", "Did you mean 'rounds'"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "share.toml"), ["held-out", "from 0 to 0.9"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "word.toml"), ["smooth = 'much'", "a number"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "skip.toml"), ["existing = 'skip'", "lbsfit learn never skips"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "half.toml"), ["rounds = 1.5", "a whole number"]),
    ],
)
def test_bad_usage_is_found_before_any_work(arguments, words, tubes, tmp_path, run, monkeypatch):
    for name in ("tube.npz", "t0.ply", "t1.ply"):
        (tmp_path / name).write_bytes((tubes / name).read_bytes())
    for folder in ("folder.npz", "old", "sub"):
        (tmp_path / folder).mkdir()
    np.savez(tmp_path / "cloud.npz", points=np.eye(3))
    contents = {"cut.npz.unfinished": "", "there.npz": "x", "old/t0.fit.npz": "x", "one.csv": "t0,a\nt1,b\n", "sub/t0.ply": "x"}
    contents |= {"bad.toml": "round = 3", "share.toml": "held-out = 2"}
    contents |= {"word.toml": 'smooth = "much"', "half.toml": "rounds = 1.5", "skip.toml": 'existing = "skip"'}
    for name, text in contents.items():
        (tmp_path / name).write_text(text)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(lbs.LBSFitter, "fit", None)
    code, _, err = run("learn", *arguments)
    line = one_line(err)
    assert code == 2 and all(word in line for word in words), line
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before


def test_existing_models_are_replaced_where_that_is_asked_for(tube_model, tubes, tmp_path, run):
    before = tube_model[0].read_bytes()
    (tmp_path / "m.npz").write_bytes(before)
    arguments = ("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert run(*arguments)[0] == 2 and (tmp_path / "m.npz").read_bytes() == before
    assert run(*arguments, "--existing", "replace")[0] == 0
    assert list(lbs.LBSFitter.load(tmp_path / "m.npz").template_) == [0] and (tmp_path / "m.npz").read_bytes() != before


@pytest.mark.parametrize("content", ["old", "a rig"])
def test_what_is_no_model_is_not_replaced(content, tubes, tmp_path, run):
    before = b"old" if content == "old" else (tubes / "tube.npz").read_bytes()
    (tmp_path / "m.npz").write_bytes(before)
    arguments = ("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz")
    code, _, err = run(*arguments, "--existing", "replace")
    assert code == 2 and "m.npz, a file that is not a model and would be replaced" in one_line(err)
    assert (tmp_path / "m.npz").read_bytes() == before


def test_too_few_scans_to_hold_any_out(tubes, tmp_path, run):
    code, _, err = run("learn", tubes / "tube.npz", tubes / "t0.ply", tubes / "t1.ply", "-o", tmp_path / "m.npz", *QUICK_LEARNING)
    line = one_line(err)
    assert code == 2 and "2 that can be used" in line and "at least 3" in line and "--held-out 0" in line
    assert not (tmp_path / "m.npz").exists()


def test_scans_in_different_units_are_named(tubes, tmp_path, run):
    write_points_ply(tmp_path / "millimetres.ply", 1000 * lbs.load_scan(tubes / "t3.ply").points)
    scans = [tubes / "t0.ply", tubes / "t1.ply", tmp_path / "millimetres.ply", tubes / "t2.ply"]
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *QUICK_LEARNING)
    assert code == 2 and "different units: scan " in one_line(err) and "millimetres.ply has an extent" in err


def test_one_scan_of_many_in_another_unit_is_named_and_left_out(tubes, tmp_path, run):
    scans = [tmp_path / f"s{i}.ply" for i in range(10)]
    for i, scan in enumerate(scans):
        write_points_ply(scan, (1000 if i == 7 else 1) * lbs.load_scan(tubes / f"t{i % 4}.ply").points)
    code, text, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 1 and "fitted 9 of 10 scans" in text and "fits of 10 scans: " in text
    assert len(err.splitlines()) == 1 and err.startswith(f"s7: failed: {scans[7]}: got an extent of ")


def test_no_scan_that_can_be_used(tubes, tmp_path, run):
    (tmp_path / "empty.ply").write_bytes(b"")
    np.savetxt(tmp_path / "few.xyz", np.eye(3))
    scans = (tmp_path / "empty.ply", tmp_path / "few.xyz")
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *QUICK_LEARNING)
    lines = err.splitlines()
    assert code == 2 and len(lines) == 3
    assert lines[0].startswith("empty: failed: ") and lines[1].startswith("few: failed: ") and "at least 4 points" in lines[1]
    assert lines[2].startswith("lbsfit: error: scans: got 2, none of which can be used")


def test_whatever_is_wrong_with_one_scan_is_its_failure_alone(tubes, tmp_path, run, monkeypatch):
    import lbsfit_np.io.scans

    load = lbsfit_np.io.scans.load_scan

    def careless(path, **options):
        if Path(path).stem == "t1":
            raise ZeroDivisionError("nobody foresaw this")
        return load(path, **options)

    monkeypatch.setattr(lbsfit_np.io.scans, "load_scan", careless)
    scans = sorted(tubes.glob("*.ply"))
    code, text, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 1 and "fitted 3 of 4 scans" in text and (tmp_path / "m.npz").exists()
    assert len(err.splitlines()) == 1 and err.startswith("t1: failed: ") and "ZeroDivisionError: nobody foresaw this" in err


def test_a_scan_that_fails_on_the_way_is_named_and_left_out(tubes, tmp_path, run, monkeypatch):
    from lbsfit_np.learning import free_form

    call = free_form._FreeForm.__call__

    def careless(self, member):
        if member.index == 1:
            raise ZeroDivisionError("nobody foresaw this")
        return call(self, member)

    monkeypatch.setattr(free_form._FreeForm, "__call__", careless)
    options = ("-o", tmp_path / "m.npz", "--results", tmp_path / "fits", "--variant", "free-form")
    code, text, err = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *options)
    assert code == 1 and err.startswith("t1: failed: ZeroDivisionError: nobody foresaw this\n")
    assert "fitted 3 of 4 scans" in text and "3 of 4 results" in text
    entries = json.loads((tmp_path / "fits" / "summary.json").read_text())["scans"]
    (failed,) = (e for e in entries if e["status"] == "failed")
    assert len(entries) == 4 and failed["name"] == "t1" and "ZeroDivisionError" in failed["message"]


def test_what_was_learned_from_is_counted_as_such_without_a_result(tubes, tube_model, tmp_path, run, monkeypatch):
    """One scan is read as a broken one, one teaches and one is held out, but there is no result of either."""
    scans = sorted(tubes.glob("*.ply"))
    failures = {1: "learned from, but it has no result: it", 2: "held out of learning, but it has no result: it"}

    def fit(self, sources, *given, **options):
        learned = lbs.LBSFitter.load(tube_model[0])
        for name in ("template_", "unit_", "learned_unit_", "segmenter_", "regressor_", "history_", "_learned_with"):
            setattr(self, name, getattr(learned, name))
        for source in sources:
            with suppress(FileError):
                source()
        result = lbs.FitResult.load(tube_model[1] / "t0.fit.npz")
        self.results_ = [replace(result, message="learned from; well"), None, None, None]
        self.failures_ = failures | {3: "unread"}
        self.roles_ = [LEARNED_FROM, LEARNED_FROM, HELD_OUT, None]

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit)
    (tmp_path / "learned from.ply").write_bytes(b"")
    code, text, err = run("learn", tubes / "tube.npz", *scans[:3], tmp_path / "learned from.ply", "-o", tmp_path / "m.npz")
    assert code == 1 and all(f"t{i}: failed: {words}\n" in err for i, words in failures.items())
    assert "learned from 2 of 4 scans of 1 subject (1 held out; 1 could not be used) in " in text


def test_a_result_that_is_not_finite_is_a_failure(tubes, tmp_path, run, monkeypatch):
    fit = lbs.LBSFitter.fit

    def odd(self, *arguments, **options):
        fit(self, *arguments, **options)
        vertices = np.full_like(self.results_[2].vertices, np.nan)
        self.results_[2] = replace(self.results_[2], vertices=vertices, status="failed", message="not finite")

    monkeypatch.setattr(lbs.LBSFitter, "fit", odd)
    options = ("-o", tmp_path / "m.npz", "--results", tmp_path / "fits", "--variant", "free-form")
    code, text, err = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *options)
    assert code == 1 and "t2: failed: not finite" in err and "3 of 4 results" in text
    assert json.loads((tmp_path / "fits" / "summary.json").read_text())["counts"]["failed"] == 1


def test_scans_of_one_name_are_called_by_their_paths(tubes, tmp_path, run):
    for k in range(3):
        (tmp_path / f"d{k}").mkdir()
        (tmp_path / f"d{k}" / "scan.ply").write_bytes((tubes / f"t{k}.ply").read_bytes())
    (tmp_path / "d1" / "scan.ply").write_bytes(b"")
    scans = sorted(tmp_path.glob("*/scan.ply"))
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 1 and err.startswith(f"{scans[1]}: failed: ")
