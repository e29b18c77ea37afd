"""Fits of earlier runs where a scan cannot be fitted now: they stay, and nothing takes them for this run's."""

import json
import os

import numpy as np
import pytest
from cli_runs import QUICK

import lbsfit_np as lbs
from lbsfit_np.cli import fit, scan_results
from lbsfit_np.cli.summary import earlier_fits
from lbsfit_np.io.npz import RESULT_KEY
from lbsfit_np.report.render import write_png

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")

STILL = "; an earlier fit is still there: one.fit.npz"


@pytest.fixture
def out(fitted, tmp_path):
    """A folder with the fits of one and two, and a picture of the first that this package has drawn."""
    out = tmp_path / "out"
    out.mkdir()
    for path in fitted[0].iterdir():
        (out / path.name).write_bytes(path.read_bytes())
    write_png(out / "one.png", np.zeros((2, 2, 3), np.uint8))
    return out


def _results(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "summary.json"}


def _entries(folder):
    return {entry["name"]: entry for entry in json.loads((folder / "summary.json").read_text())["scans"]}


@pytest.mark.parametrize("existing, missing", [("replace", ""), ("replace", "one.labels.ply"), ("skip", "one.mesh.ply")])
def test_of_what_cannot_be_read_now_an_earlier_fit_stays(existing, missing, made, out, tmp_path, run):
    """With skip it is to be fitted again, as its mesh is gone."""
    scan = tmp_path / "one.ply"
    scan.write_bytes(b"ply")
    if missing:
        (out / missing).unlink()
    before = _results(out)
    arguments = ("fit", made / "tube.npz", scan, "-o", out, "--existing", existing, *QUICK)
    for _ in range(2):
        code, text, err = run(*arguments)
        assert code == 1 and err.startswith("[1/1] one: failed: ") and err.endswith(f"{STILL}\n") and f"{STILL}\n" in text
        assert "0 of 1 scan fitted, 1 could not be fitted; results in" in text
        assert _results(out) == before and earlier_fits(out) == {"one.fit.npz"}
        (entry,) = _entries(out).values()
        assert (entry["status"], entry["earlier"]) == ("failed", "one.fit.npz") and "files" not in entry
        assert entry["message"].endswith(STILL) and ".;" not in entry["message"]


def test_files_of_others_in_the_place_of_a_fits_stay_too(made, tmp_path, run):
    scan, out, others = tmp_path / "one.ply", tmp_path / "out", ("one.fit.npz", "one.mesh.ply", "one.labels.ply", "one.png")
    out.mkdir()
    for name in others:
        (out / name).write_bytes(b"of others")
    scan.write_bytes(b"ply")
    code, text, err = run("fit", made / "tube.npz", scan, "-o", out, "--existing", "replace", "--pictures", *QUICK)
    assert code == 1 and "earlier" not in text + err and "earlier" not in _entries(out)["one"]
    assert _results(out) == dict.fromkeys(others, b"of others")


@pytest.mark.parametrize("at", range(3))
def test_a_disk_that_is_full_at_last_costs_no_earlier_fit(at, made, out, run, monkeypatch):
    """Some file systems say so only once all is to be on the disk."""
    sync, done = os.fsync, []

    def full(handle):
        done.append(handle)
        if len(done) > 3 + at:  # the first three are of the files as they are written
            raise OSError(28, "No space left on device")
        sync(handle)

    before = _results(out)
    with monkeypatch.context() as patch:
        patch.setattr("lbsfit_np.io.write.write_json", lambda *given: None)
        patch.setattr(os, "fsync", full)
        code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", out, "--existing", "replace", *QUICK)
    assert code == 1 and "No space left on device" in err and STILL in err and _results(out) == before


def test_a_file_that_another_program_holds_costs_no_earlier_fit(made, out, run, monkeypatch):
    move = os.replace

    def held(source, target):
        if str(target).endswith("one.labels.ply") and "older" not in str(source):
            raise PermissionError(13, "Permission denied")
        move(source, target)

    before = _results(out)
    monkeypatch.setattr(os, "replace", held)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", out, "--existing", "replace", *QUICK)
    assert code == 1 and "one.labels.ply: got an error while writing (Permission denied)" in err and STILL in err
    assert _results(out) == before


def test_a_fit_that_was_written_before_its_process_ended_is_no_earlier_one(made, out, run, monkeypatch):
    write = scan_results.Writer.__call__

    def killed(self, index, scan, result):
        write(self, index, scan, result)
        raise RuntimeError("killed as it drew a picture")

    monkeypatch.setattr(scan_results.Writer, "__call__", killed)
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", out, "--existing", "replace", *QUICK)
    assert code == 0 and "1 of 1 scan fitted" in text and "note: one: RuntimeError: killed as it drew a picture" in text
    entry = _entries(out)["one"]
    assert set(entry["files"]) == {"fit", "mesh", "labels"} and "earlier" not in entry


def test_a_fit_of_another_version_is_left_to_it(made, out, run):
    """Also where its mesh is gone; one that is damaged besides is fitted again."""
    path = out / "one.fit.npz"
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {RESULT_KEY: np.array(8)})
    arguments = ("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", "-o", out, "--existing", "skip", *QUICK)
    for missing in ("one.png", "one.mesh.ply"):
        (out / missing).unlink()
        before = _results(out)
        code, text, _ = run(*arguments)
        why = "one.fit.npz is not kept: it has result format 8, this version reads format 9; --existing replace fits the scan "
        assert code == 1 and f"one: {why}again{STILL}\n" in text and "kept existing fits of 1 of 2 scans" in text
        assert "fitted again" not in text and _results(out) == before
        one, two = map(_entries(out).get, ("one", "two"))
        assert (one["status"], one["earlier"]) == ("failed", "one.fit.npz") and "files" not in one and two["kept"]
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    code, text, _ = run(*arguments)
    assert code == 0 and "so the scan is fitted again" in text and lbs.FitResult.load(path).status == "ok"


def test_earlier_fits_of_what_failed_are_among_those_that_skip_would_keep(made, out, tmp_path, run, monkeypatch):
    fit_all = fit._fit

    def interrupted(fitter, todo, *more):
        fit_all(fitter, todo[:1], *more)
        raise KeyboardInterrupt

    scan = tmp_path / "one.ply"
    scan.write_bytes(b"ply")
    monkeypatch.setattr(fit, "_fit", interrupted)
    scans = (scan, made / "two.xyz")
    code, text, _ = run("fit", made / "tube.npz", *scans, "-o", out, "--existing", "replace", *QUICK)
    told = "stopped before any scan was fitted; run the same command to start again; 2 scans have fits from an earlier run"
    assert code == 130 and text.endswith(f"{told}, which --existing skip would keep\n")


def test_an_animation_names_frames_of_earlier_runs(made, out, tmp_path, run, monkeypatch):
    scan = tmp_path / "one.ply"
    scan.write_bytes(b"ply")
    command = ("animate", made / "tube.npz", *sorted(out.glob("*.fit.npz")), "-o", tmp_path / "a.glb", "--existing", "replace")
    assert "earlier" not in run(*command)[1]
    assert run("fit", made / "tube.npz", scan, made / "two.xyz", "-o", out, "--existing", "replace", *QUICK)[0] == 1
    note = "note: 1 fit is of an earlier run, as the last one could not fit the scan: one.fit.npz\n"
    code, text, _ = run(*command)
    assert code == 0 and note in text
    monkeypatch.chdir(out)
    assert note in run("animate", made / "tube.npz", "one.fit.npz", "two.fit.npz", "-o", tmp_path / "b.glb")[1]
    for content in ("[1]", "no JSON", '{"versions": {"lbsfit_np": "0"}}', '{"versions": {"lbsfit_np": "0"}, "scans": [1, {}]}'):
        (out / "summary.json").write_text(content)
        assert earlier_fits(out) == set()
