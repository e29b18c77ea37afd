"""``lbsfit bench pairs`` as people run it: what it writes and says, options, stops, and bad usage."""

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from cli_runs import QUICK_LEARNING, one_line
from registered_sets import WHO, fits_are_given, learning_is_given, result_of, what_fits_are_told, write_meshes

import lbsfit_np as lbs
from lbsfit_np.bench.pairs import choose_pairs, measure_pairs
from lbsfit_np.bench.truth import VertexOrder
from lbsfit_np.bench.truth_file import read_truth
from lbsfit_np.cli.pair_runs import PairsProgress
from lbsfit_np.cli.progress import SILENCE
from lbsfit_np.io.write import write_points_ply
from lbsfit_np.learning.checkpoint import Checkpoint
from lbsfit_np.synthesis import sample_surface

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]


def _command(folder, out, *more):
    return ("bench", "pairs", folder, "--truth", folder / "truth.csv", "--rig", folder / "tube.npz", "-o", out, *more)


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_a_run_that_learns_and_what_the_next_one_keeps(pair_folder, tmp_path, run, pair_meshes, tube_rig, monkeypatch):
    """The one test that learns, though in a hurry: what the loop leaves is what the benchmark takes."""
    code, out, err = run(*_command(pair_folder, tmp_path / "out", *QUICK_LEARNING, "--points", 50, "--pictures", 1))
    assert code in (0, 1), err  # so little training may end in a fit that says it failed
    assert "intra" in out and "inter" in out and "learned together" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert {"numpy", "commit", "cpus"} <= set(report["environment"]) and report["settings"]["seed"] == 0
    assert [s["subject"] for s in report["scans"]] == list(WHO) and len(report["pairs"]) == 12 and report["history"]
    registered = lbs.FitResult.load(tmp_path / "out" / "fits" / "s1.npz")
    assert registered.model_digest
    entry = next(e for e in report["pairs"] if (e["a"], e["b"]) == ("s0", "s1"))
    assert entry["points"] == 50 and all(0 < e["before"]["mean"] < 0.1 * tube_rig.size for e in report["pairs"])
    assert (tmp_path / "out" / "gallery.png").stat().st_size > 1000
    assert lbs.LBSFitter.load(tmp_path / "out" / "model.npz").template_.keys() == {"ann", "bob"}
    fits_are_given(monkeypatch, {})  # nothing may be fitted any more
    monkeypatch.setattr(lbs.LBSFitter, "fit", None)
    (tmp_path / "out" / "fits" / "s3.npz").unlink()
    fits_are_given(monkeypatch, {"s3": pair_meshes[3]})
    code, out, _ = run(*_command(pair_folder, tmp_path / "out", *QUICK_LEARNING, "--points", 50, "--markdown"))
    assert "kept existing fits of 3 scans" in out and "[1/1] s3: fitted" in out and "| intra | before the snap |" in out
    assert json.loads((tmp_path / "out" / "results.json").read_text())["history"] == report["history"]


def test_fits_one_by_one(pair_folder, tmp_path, run, pair_meshes, monkeypatch):
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    code, out, err = run(*_command(pair_folder, tmp_path / "out", "--no-learn", "--unit", "ft", "--pictures", 1))
    assert (code, err) == (0, "") and "fitted one by one" in out and "(ft)" in out
    assert "measuring errors: 12 pairs\n" in out and "gallery.png, from top to bottom: s0\n" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert report["figures"]["inter"]["before"]["mean"] < 1e-9 and report["cm_per_unit"] == pytest.approx(30.48)
    assert not (tmp_path / "out" / "model.npz").exists() and "rounds" not in report["settings"]
    assert report["gallery"] == ["s0"] and report["folder"] == str(pair_folder) and report["rig"]["file"].endswith("tube.npz")
    assert report["truth_file"]["path"].endswith("truth.csv") and len(report["truth_file"]["sha256"]) == 64
    code, out, err = run(*_command(pair_folder, tmp_path / "out", "--no-learn", "--unit", "ft", "--seed", 1))
    assert code == 2 and "fits made with seed 0; expected seed 1" in one_line(err)
    other = shutil.copytree(pair_folder, tmp_path / "other")
    write_points_ply(other / "s1.ply", pair_meshes[1][:50])
    code, out, err = run(*_command(other, tmp_path / "out", "--no-learn", "--existing", "replace"))
    assert code == 2 and "scans of 242 and 50 vertices" in one_line(err)
    left = {path.name for path in (tmp_path / "out").iterdir()}  # what is refused takes nothing away
    assert left == {"fits", "fits.json", "results.json", "gallery.png"}
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == report


@pytest.mark.parametrize("layout", ["vertex order", "registrations"])
def test_scans_of_the_bundled_body(layout, tmp_path, run, monkeypatch):
    """Meshes that are registrations themselves, or clouds with a registration each; fits that are exact, but for one."""
    body, rng = lbs.load_rig("body-coarse"), np.random.default_rng(0)
    people = [body.subject(seed) for seed in (3, 4)]
    templates = [(person.vertices, person.joints) for person in people]
    meshes = [s.vertices for s in lbs.synthesize(body, 4, templates=templates, random_state=1, n_points=50)]
    name = "s{}.ply" if layout == "vertex order" else "reg/r{}.ply"
    write_meshes(tmp_path / "scans" / "reg", body, meshes, f"../{name}")
    lines = ["scan,subject"] if layout == "vertex order" else ["scan,subject,registration"]
    for i, vertices in enumerate(meshes):
        lines.append(f"s{i},{WHO[i]}" + f",reg/r{i}.ply" * (layout == "registrations"))
        if layout == "registrations":
            points = sample_surface(vertices, body.faces, 400, rng)[0]
            write_points_ply(tmp_path / "scans" / f"s{i}.ply", points)
    (tmp_path / "scans" / "truth.csv").write_text("\n".join(lines))
    off = np.array([0.03, 0.0, 0.04])
    fits_are_given(monkeypatch, {f"s{i}": v + off * (i == 3) for i, v in enumerate(meshes)})
    command = ("bench", "pairs", tmp_path / "scans", "--truth", tmp_path / "scans" / "truth.csv", "--rig", "body-coarse")
    code, out, err = run(*command, "-o", tmp_path / "out", "--no-learn", "--unit", "m", "--pictures", 0)
    assert (code, err) == (0, "") and "intra" in out
    for entry in json.loads((tmp_path / "out" / "results.json").read_text())["pairs"]:
        if entry["a"] != "s3":  # whose own places are looked for on a mesh that is off
            assert entry["before"]["mean"] == pytest.approx(0.05 * (entry["b"] == "s3"), abs=1e-6), entry


def test_the_options_reach_what_they_are_for(pair_folder, pair_scans, tmp_path, run, pair_meshes, tube_rig, monkeypatch):
    rng, out = np.random.default_rng(0), tmp_path / "out"
    given = {f"s{i}": v + 0.02 * rng.standard_normal(v.shape) for i, v in enumerate(pair_meshes)}
    asked = fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    options = ("--no-learn", "--pictures", 0, "--pairs", 3, "--points", 7, "--seed", 4)
    assert run(*_command(pair_folder, out, *options, "--samples", 50))[0] == 0
    assert {f.random_state for _, f in told.values()} == {4}
    assert {len(lbs.FitResult.load(path).labels) for path in (out / "fits").iterdir()} == {50}
    report = json.loads((out / "results.json").read_text())
    truth = VertexOrder(242)
    pairs = choose_pairs(pair_scans, truth, 3, 4)
    assert report["pairs"] == measure_pairs(pair_scans, truth, given, tube_rig.faces, pairs, points=7, seed=4)["pairs"]
    assert len(report["pairs"]) == 6 and {e["points"] for e in report["pairs"]} == {7}
    code, _, err = run(*_command(pair_folder, out, *options, "--samples", 60))
    assert code == 2 and "fits made with samples 50; expected samples 60" in one_line(err)
    asked.clear()
    assert run(*_command(pair_folder, out, *options, "--samples", 50))[0] == 0 and asked == []
    assert run(*_command(pair_folder, out, *options, "--samples", 50, "--existing", "replace"))[0] == 0
    assert asked == ["s0", "s1", "s2", "s3"]


@pytest.mark.slow
def test_fits_are_told_the_unit(pair_folder, tmp_path, run, pair_meshes, monkeypatch):
    """And are not taken for others', as lengths and scales are judged by it."""
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    told = what_fits_are_told(monkeypatch)
    command = _command(pair_folder, tmp_path / "out", "--no-learn", "--unit")
    assert run(*command, "ft")[0] == 0 and {fitter.unit for _, fitter in told.values()} == {"ft"}
    code, _, err = run(*command, "mm")
    assert code == 2 and "with fits made with unit ft" in one_line(err)
    code, _, err = run(*command, "mm", "--existing", "replace")
    assert code == 1 and "unit: got 'mm', in which the scan's extent" in err


@pytest.mark.slow
def test_a_run_that_begins_anew_keeps_no_fits_of_others(pair_folder, tmp_path, run, pair_meshes, monkeypatch):
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    assert run(*_command(pair_folder, tmp_path / "out", "--no-learn"))[0] == 0
    table = tmp_path / "two.csv"
    table.write_text("scan,subject\ns0,ann\ns1,ann\n")
    command = _command(pair_folder, tmp_path / "out", "--no-learn", "--existing", "replace")
    assert run(*(table if word == pair_folder / "truth.csv" else word for word in command))[0] == 0
    assert sorted(path.name for path in (tmp_path / "out" / "fits").iterdir()) == ["s0.npz", "s1.npz"]


def test_a_run_that_is_refused_leaves_no_folder(pair_folder, tmp_path, run, tube_rig, pair_meshes):
    folder = shutil.copytree(pair_folder, tmp_path / "scans")
    write_points_ply(folder / "s1.ply", pair_meshes[1][:50])
    code, _, err = run(*_command(folder, tmp_path / "out" / "deep", "--no-learn"))
    assert code == 2 and "scans of 242 and 50 vertices" in one_line(err) and not (tmp_path / "out").exists()


def test_a_run_that_breaks_leaves_no_folder_without_fits(pair_folder, tmp_path, run, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda self, **options: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(*_command(pair_folder, tmp_path / "out" / "deep", "--no-learn"))
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*"))
    assert left == ["out", "out/deep", "out/deep/fits.json"]


def test_a_picture_that_cannot_be_drawn_loses_no_figure(pair_folder, tmp_path, run, pair_meshes, monkeypatch):
    def write_png(path, image):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lbsfit_np.report.render.write_png", write_png)
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    (tmp_path / "gallery.png").write_bytes(b"of an earlier run")
    code, out, err = run(*_command(pair_folder, tmp_path, "--no-learn", "--pictures", 1, "--existing", "replace"))
    assert code == 2 and "No space left" in one_line(err) and "before the snap" in out
    report = json.loads((tmp_path / "results.json").read_text())
    assert len(report["pairs"]) == 12 and report["gallery"] == [] and not (tmp_path / "gallery.png").exists()


def test_what_an_earlier_run_wrote_is_no_scan(tube_rig, pair_meshes, tmp_path, run, monkeypatch):
    write_meshes(tmp_path / "scans", tube_rig, pair_meshes)
    (tmp_path / "truth.csv").write_text("scan,subject\ns0,ann\ns1,ann\ns2,bob\n")
    tube_rig.save(tmp_path / "tube.npz")
    learning_is_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
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


def test_scans_that_fail_are_named_and_their_pairs_missing(pair_folder, tmp_path, run, pair_meshes, tube_rig, monkeypatch):
    for path in pair_folder.glob("s?.ply"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "s1.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\n")
    for name in ("truth.csv", "tube.npz"):
        (tmp_path / name).write_bytes((pair_folder / name).read_bytes())
    fits_are_given(monkeypatch, {"s0": pair_meshes[0], "s2": (pair_meshes[2], {"status": "failed"}), "s3": pair_meshes[3]})
    code, out, _ = run(*_command(tmp_path, tmp_path / "out", "--no-learn", "--pictures", 0))
    assert code == 1 and "failed: s1: " in out and "s1.ply" in out and "failed: s2: made up" in out
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert {k: (f["pairs"], f["missing"]) for k, f in report["figures"].items()} == {"intra": (2, 2), "inter": (4, 4)}
    assert "failed" in report["scans"][1] and not (tmp_path / "out" / "gallery.png").exists()


def test_a_run_that_is_stopped_says_what_is_kept(pair_folder, tmp_path, run, pair_meshes, monkeypatch):
    fits_are_given(monkeypatch, {"s0": pair_meshes[0], "s1": KeyboardInterrupt()})
    code, out, _ = run(*_command(pair_folder, tmp_path / "out", "--no-learn"))
    assert code == 130 and f"stopped: 1 fit is kept in {tmp_path / 'out'}; run the same command to continue" in out
    for name in ("results.json", "gallery.png"):
        (tmp_path / "out" / name).write_text("of fits that are to be gone")
    fits_are_given(monkeypatch, {"s0": pair_meshes[0], "s1": pair_meshes[1], "s2": KeyboardInterrupt()})
    code, out, _ = run(*_command(pair_folder, tmp_path / "out", "--no-learn", "--existing", "replace"))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"fits", "fits.json"}
    assert code == 130 and "2 fits are kept" in out and "; run the same command without --existing replace to continue" in out


def test_a_loop_that_is_stopped_says_what_is_kept(pair_folder, tmp_path, run, monkeypatch):
    """And how to go on from there: --existing replace would begin anew."""
    out, keeps = tmp_path / "out", []

    def stopped(self, *args, checkpoint, **options):
        for step in keeps:
            Checkpoint(checkpoint).slot(step).keep(1)
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "fit", stopped)
    code, text, _ = run(*_command(pair_folder, out))
    assert code == 130 and text.endswith("stopped before any scan was fitted\n")
    keeps.append("first-fit")
    kept = f"to continue from the steps kept in {out / 'model.npz.unfinished'}\n"
    assert run(*_command(pair_folder, out))[1].endswith(f"stopped before any scan was fitted; run the same command {kept}")
    text = run(*_command(pair_folder, out))[1]
    assert f"note: found 1 saved step of an interrupted run in {out / 'model.npz.unfinished'}; those that match" in text
    text = run(*_command(pair_folder, out, "--existing", "replace"))[1]
    again = "run the same command without --existing replace"
    assert " of an interrupted run" not in text and text.endswith(f"stopped before any scan was fitted; {again} {kept}")


def test_sigterm_stops_a_run_as_ctrl_c_does(pair_folder, tmp_path, run, pair_meshes, monkeypatch):
    def unhandled(signum, frame):
        raise AssertionError("SIGTERM went past the run")

    def terminating(self, scan, **options):
        if scan.name == "s1":
            os.kill(os.getpid(), signal.SIGTERM)
        return result_of(self.rig, pair_meshes[0], len(scan.points))

    fits_are_given(monkeypatch, {})
    monkeypatch.setattr(lbs.LBSFitter, "fit_scan", terminating)
    before = signal.signal(signal.SIGTERM, unhandled)
    try:
        code, out, _ = run(*_command(pair_folder, tmp_path / "out", "--no-learn"))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert code == 143 and "stopped: 1 fit is kept" in out


def test_measuring_says_a_line_a_minute(capsys):
    now = [0.0]
    progress = PairsProgress(1, terminal=False, clock=lambda: now[0])
    for done in range(6):
        now[0] += 0.6 * SILENCE
        progress.measured(done, 5)
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["measuring errors: 5 pairs", "measuring errors: 2 of 5 pairs", "measuring errors: 4 of 5 pairs"]
    progress.written(0, 1)
    progress.written(1, 1)
    assert capsys.readouterr().out.splitlines() == ["writing the challenge files: 1 pair"]
    progress = PairsProgress(1, terminal=True)
    for done in range(3):
        progress.measured(done, 2)
    told = capsys.readouterr()
    assert told.out == "" and "measuring errors" in told.err


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
def test_bad_usage(pair_folder, tmp_path, run, change, words):
    options = {"--truth": pair_folder / "truth.csv", "--rig": pair_folder / "tube.npz", "-o": tmp_path / "out"} | change
    try:
        code, _, err = run("bench", "pairs", pair_folder, *(x for pair in options.items() if pair[1] is not None for x in pair))
    except SystemExit as error:
        code, err = error.code, None
    assert code == 2 and not (tmp_path / "out").exists()
    for word in words if err else ():
        assert word in one_line(err)


def test_the_truth_must_fit_the_scans(pair_folder, tmp_path, run, tube_rig):
    scans = write_meshes(tmp_path / "in", tube_rig, [tube_rig.vertices])
    np.savetxt(scans / "s1.xyz", tube_rig.vertices[:200])
    (scans / "truth.csv").write_text("scan,subject\ns0,a\ns1,b\n")
    (scans / "tube.npz").write_bytes((pair_folder / "tube.npz").read_bytes())
    code, _, err = run(*_command(scans, tmp_path / "out"))
    assert code == 2 and "242 and 200 vertices" in one_line(err) and "(name, vertex)" in err and "s1.xyz" in err
    (scans / "truth.csv").write_text("scan,subject,name,vertex\ns0,a,tip,1\ns1,b,end,1\n")
    code, _, err = run(*_command(scans, tmp_path / "out"))
    assert code == 2 and "no two scans with places in common" in one_line(err)


def test_an_input_is_never_overwritten(tube_rig, pair_folder, tmp_path, run):
    (tmp_path / "fits").mkdir()
    for i in range(2):
        np.savez(tmp_path / "fits" / f"s{i}.npz", points=tube_rig.vertices)
    (tmp_path / "fits" / "truth.csv").write_text("scan,subject\ns0,a\ns1,b\n")
    (tmp_path / "fits" / "tube.npz").write_bytes((pair_folder / "tube.npz").read_bytes())
    code, _, err = run(*_command(tmp_path / "fits", tmp_path))
    assert code == 2 and "never overwritten" in one_line(err)


@pytest.mark.parametrize("theirs", ["results.json", "gallery.png", "fits/s0.npz", "model.npz"])
def test_what_others_have_made_is_replaced_only_on_demand(pair_folder, tmp_path, run, pair_meshes, monkeypatch, theirs):
    asked = fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    there = tmp_path / "out" / theirs
    there.parent.mkdir(parents=True)
    there.write_bytes(b'{"benchmark": "starts"}')
    command = _command(pair_folder, tmp_path / "out", "--no-learn", "--pictures", 0)
    code, _, err = run(*command)
    assert code == 2 and asked == [] and there.read_bytes() == b'{"benchmark": "starts"}'
    for word in ("lbsfit: error: -o: got", f"{there.name} exists already", "--existing replace"):
        assert word in one_line(err)
    assert run(*command, "--existing", "replace")[0] == 0 and len(asked) == 4
    assert run(*command)[0] == 0 and len(asked) == 4  # what it has written itself


@pytest.mark.parametrize("option, name", [("--truth", "results.json"), ("--rig", "model.npz")])
def test_neither_the_truth_nor_the_rig_is_overwritten(pair_folder, tmp_path, run, monkeypatch, option, name):
    fits_are_given(monkeypatch, {})
    source = pair_folder / {"--truth": "truth.csv", "--rig": "tube.npz"}[option]
    (tmp_path / name).write_bytes(source.read_bytes())
    code, _, err = run(*_command(pair_folder, tmp_path, "--no-learn", option, tmp_path / name))
    assert code == 2 and f"{name} is an input" in one_line(err) and "never overwritten" in err
    assert (tmp_path / name).read_bytes() == source.read_bytes()


@pytest.mark.parametrize("name", ["model.npz", "fits/s0.npz"])
def test_registrations_are_not_overwritten(pair_folder, tmp_path, run, pair_meshes, tube_rig, monkeypatch, name):
    fits_are_given(monkeypatch, {f"s{i}": v for i, v in enumerate(pair_meshes)})
    (tmp_path / "fits").mkdir()
    truth = ["scan,registration"]
    for i, there in enumerate((name, "others/s1.npz", "others/s2.npz")):
        (tmp_path / there).parent.mkdir(exist_ok=True)
        np.savez(tmp_path / there, vertices=pair_meshes[i], faces=tube_rig.faces)
        truth.append(f"s{i},{there}")
    (tmp_path / "truth.csv").write_text("\n".join(truth))
    before = (tmp_path / name).read_bytes()
    more = ("--no-learn", "--truth", tmp_path / "truth.csv", "--existing", "replace")
    code, _, err = run(*_command(pair_folder, tmp_path, *more))
    assert (tmp_path / name).read_bytes() == before
    assert code == 2 and f"{Path(name).name} is an input" in one_line(err) and "never overwritten" in err
    assert run(*_command(pair_folder, tmp_path / "out", *more))[0] == 0


@pytest.mark.parametrize("option, value", [("--rounds", 5), ("--held-out", 0.3)])
def test_options_of_learning_without_learning(pair_folder, tmp_path, run, option, value):
    code, _, err = run(*_command(pair_folder, tmp_path / "out", "--no-learn", option, value))
    assert code == 2 and f"{option}: got {value} with --no-learn" in one_line(err) and not (tmp_path / "out").exists()
