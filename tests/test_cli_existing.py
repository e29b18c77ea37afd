"""Names that clash, inputs that are results, and what is there already: found before any work."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import QUICK, one_line

import lbsfit_np as lbs
from lbsfit_np.cli import fit, kept_fits, outputs
from lbsfit_np.cli.summary import counts_of, doubts_of
from lbsfit_np.errors import FileError
from lbsfit_np.io.write import write_points_ply
from lbsfit_np.report.render import is_signed, write_png

pytestmark = pytest.mark.usefixtures("own_cache")

PIXELS = np.zeros((4, 4, 3), dtype=np.uint8)


def test_missing_scans_are_found_before_any_work(made, tmp_path, run):
    code, _, err = run(
        "fit", made / "tube.npz", made / "one.ply", tmp_path / "a.ply", tmp_path / "b.ply", "-o", tmp_path / "out", *QUICK
    )
    assert code == 2 and "2 files that do not exist" in one_line(err) and "a.ply" in err and "b.ply" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option, value", [("--training", "n_points=0"), ("--max-points", "3")])
def test_wrong_options_are_said_before_what_is_in_their_way(option, value, made, tmp_path, run):
    (tmp_path / "one.fit.npz").write_bytes(b"of an earlier run")
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, *QUICK, option, value)
    assert code == 2 and one_line(err).startswith(f"lbsfit: error: {option}: got ")


@pytest.mark.parametrize("other", ["one.xyz", "ONE.xyz", "sub/one.ply", "one.ply"])
def test_clashing_names_are_found_before_any_work(other, made, tmp_path, run):
    (tmp_path / "sub").mkdir()
    for name in ("one.ply", other):
        (tmp_path / name).write_text("0 0 0\n")
    code, _, err = run("fit", made / "tube.npz", tmp_path / "one.ply", tmp_path / other, "-o", tmp_path / "out", *QUICK)
    assert code == 2 and "SCAN: got" in one_line(err) and ("twice" if other == "one.ply" else "both be called") in err
    assert "fit them into different folders" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("existing", ["error", "skip", "replace"])
@pytest.mark.parametrize("what", ["scan", "rig", "card"])
def test_an_input_is_never_overwritten(what, existing, made, tmp_path, run):
    scan, rig, card = tmp_path / "one.ply", made / "tube.npz", "none"
    scan.write_bytes((made / "one.ply").read_bytes())
    scans = [scan]
    if what == "scan":
        scans.append(tmp_path / "one.mesh.ply")  # a scan as well, and what the first one's mesh would be called
        taken = scans[1]
        taken.write_bytes(scan.read_bytes())
    elif what == "rig":
        rig = taken = tmp_path / "one.fit.npz"
        taken.write_bytes((made / "tube.npz").read_bytes())
    else:
        card = taken = tmp_path / "summary.json"
        taken.write_text('[rig]\nunit = "m"\n')
    before = taken.read_bytes()
    code, _, err = run("fit", rig, *scans, "-o", tmp_path, "--card", card, "--existing", existing, *QUICK)
    assert code == 2 and f"{taken.name} is an input" in one_line(err) and "never overwritten" in err
    assert taken.read_bytes() == before


def test_existing_results(fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "two.labels.ply").unlink()
    old = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    scans = [made / "one.ply", made / "two.xyz"]

    code, _, err = run("fit", made / "tube.npz", *scans, "-o", tmp_path, *QUICK)
    assert code == 2 and "one.fit.npz" in one_line(err) and "--existing" in err
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == old

    code, text, _ = run("fit", made / "tube.npz", *scans, "-o", tmp_path, "--existing", "skip", *QUICK)
    assert code == 0 and "1 of 2 scans is fitted already" in text and "[1/1] two: fitted" in text
    assert (tmp_path / "one.fit.npz").stat().st_mtime_ns == old[tmp_path / "one.fit.npz"]
    assert (tmp_path / "two.labels.ply").is_file()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [(s["status"], s["kept"]) for s in summary["scans"]] == [("ok", True), ("ok", False)]
    assert summary["counts"] == {"ok": 2, "suspect": 0, "failed": 0, "unfitted": 0, "kept": 1}
    assert f"2 of 2 scans fitted, 1 of the fits kept from before; results in {tmp_path}\n" in text
    assert summary["scans"][0]["terms"] == lbs.FitResult.load(tmp_path / "one.fit.npz").terms

    (tmp_path / "one.fit.npz").write_bytes(b"broken")
    code, text, _ = run("fit", made / "tube.npz", scans[0], "-o", tmp_path, "--existing", "skip", *QUICK)
    assert code == 0 and "fitted again" in text and lbs.FitResult.load(tmp_path / "one.fit.npz").status == "ok"

    code, _, _ = run("fit", made / "tube.npz", scans[0], "-o", tmp_path, "--existing", "replace", "--weights", "paper", *QUICK)
    assert code == 0 and (tmp_path / "one.mesh.ply").read_bytes() != (fitted[0] / "one.mesh.ply").read_bytes()


def test_pictures_are_drawn_where_they_are_asked_for(fitted, made, tmp_path, run):
    """Also of fits that are there already, which are not fitted again."""
    for path in fitted[0].iterdir():
        if path.name.startswith("one."):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    before = (tmp_path / "one.fit.npz").read_bytes()
    scans = [made / "one.ply", made / "two.xyz"]
    arguments = ("fit", made / "tube.npz", *scans, "-o", tmp_path, "--existing", "skip", *QUICK)
    assert run(*arguments, "--pictures")[0] == 0
    for name in ("one", "two"):
        picture = (tmp_path / f"{name}.png").read_bytes()
        assert picture.startswith(b"\x89PNG") and len(picture) > 5000
    assert (tmp_path / "one.fit.npz").read_bytes() == before
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [s["files"]["picture"] for s in summary["scans"]] == ["one.png", "two.png"]
    assert run(*arguments)[0] == 0
    assert "picture" not in json.loads((tmp_path / "summary.json").read_text())["scans"][0]["files"]


def test_no_fit_is_lost_for_a_picture(fitted, made, tmp_path, run, monkeypatch):
    def fail(*a, **k):
        raise lbs.errors.InputError("forward", "'+y'", "another axis")

    monkeypatch.setattr("lbsfit_np.report.fit_picture.fit_picture", fail)
    (tmp_path / "one.png").write_bytes(b"of an earlier fit")
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--pictures", *QUICK)
    assert run(*arguments, "--existing", "replace")[0] == 0
    (scan,) = json.loads((tmp_path / "summary.json").read_text())["scans"]
    assert scan["notes"] == ["no picture: forward: got '+y'; expected another axis."] and "picture" not in scan["files"]
    assert lbs.FitResult.load(tmp_path / "one.fit.npz").status == "ok" and not (tmp_path / "one.png").exists()
    code, text, _ = run(*arguments, "--existing", "skip")
    assert code == 0 and "one: no picture: forward" in text


def test_a_picture_is_drawn_once_the_fit_is_there(fitted, made, tube_rig, tmp_path, monkeypatch):
    files, there = _files(tmp_path), []
    for path in files.paths.values():
        path.unlink()

    def fit_picture(*given):
        there.extend(path.name for path in tmp_path.iterdir())
        return PIXELS

    monkeypatch.setattr("lbsfit_np.report.fit_picture.fit_picture", fit_picture)
    result = lbs.FitResult.load(fitted[0] / "one.fit.npz")
    outputs.Writer(tube_rig, (files,))(0, lbs.load_scan(made / "one.ply"), result)
    assert sorted(there) == ["one.fit.npz", "one.labels.ply", "one.mesh.ply"] and files.picture.is_file()


def test_pictures_of_kept_fits_show_what_was_fitted(fitted, made, tmp_path, run, monkeypatch):
    """Not an earlier fit's picture, nor the points that the scan's file has by now or another sample takes."""
    for path in fitted[0].glob("one.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    picture, fit = tmp_path / "one.png", tmp_path / "one.fit.npz"
    write_png(picture, PIXELS)
    of_an_earlier_fit = picture.read_bytes() + b"."
    picture.write_bytes(of_an_earlier_fit)
    os.utime(picture, ns=(0, fit.stat().st_mtime_ns - 10**9))
    shown = []
    monkeypatch.setattr("lbsfit_np.report.fit_picture.fit_picture", lambda rig, points, result: shown.append(points) or PIXELS)
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", "--pictures", *QUICK)
    assert run(*arguments, "--samples", "50", "--seed", "3")[0] == 0
    np.testing.assert_allclose(shown[0], lbs.load_scan(fitted[0] / "one.labels.ply").points)
    assert picture.read_bytes() + b"." == of_an_earlier_fit  # drawn anew, of the same pixels
    assert run(*arguments)[0] == 0 and len(shown) == 1  # it is there, and of this fit


def test_a_picture_of_others_is_none_of_a_kept_fit_and_stays(fitted, made, tmp_path, run):
    """A scan.obj may have its texture beside it."""
    for path in fitted[0].glob("one.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    texture = tmp_path / "one.png"
    texture.write_bytes(b"\x89PNG of others")
    os.utime(texture, ns=(0, 0))
    code, out, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", "--pictures", *QUICK)
    assert code == 0 and "one.png is none that lbsfit has drawn" in out + err
    assert texture.read_bytes() == b"\x89PNG of others"
    assert "picture" not in json.loads((tmp_path / "summary.json").read_text())["scans"][0]["files"]


def test_a_picture_of_others_is_not_drawn_over_where_a_scan_is_still_to_be_fitted(made, tmp_path, run):
    texture = tmp_path / "one.png"
    texture.write_bytes(b"\x89PNG of others")
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--pictures", *QUICK)
    code, _, err = run(*arguments)
    assert code == 2 and "one.png exists already, which lbsfit has not drawn" in one_line(err)
    assert "leaves what others have drawn as it is" in err and "keeps finished fits" not in err
    code, out, _ = run(*arguments, "--existing", "skip")
    assert code == 0 and out.count("one.png is none that lbsfit has drawn, and stays\n") == 1 and "1 of 1 scan fitted" in out
    assert texture.read_bytes() == b"\x89PNG of others" and (tmp_path / "one.fit.npz").is_file()
    (scan,) = json.loads((tmp_path / "summary.json").read_text())["scans"]
    assert sorted(scan["files"]) == ["fit", "labels", "mesh"]
    code, _, err = run(*arguments)
    assert "keeps finished fits" in err and ", of which one.png lbsfit has not drawn" in one_line(err)
    assert run(*arguments, "--existing", "replace")[0] == 0 and is_signed(texture)


def test_files_that_no_fit_belongs_to_are_nothing_to_skip(made, tmp_path, run):
    for name in ("one.mesh.ply", "one.labels.ply"):
        (tmp_path / name).write_bytes(b"of others")
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, *QUICK)
    for more in ((), ("--existing", "skip")):
        code, _, err = run(*arguments, *more)
        assert code == 2 and "one.mesh.ply, one.labels.ply exist already" in one_line(err) and "no fit (NAME.fit.npz)" in err
        assert "--existing replace" in err and "keeps finished fits" not in err
    assert [(tmp_path / name).read_bytes() for name in ("one.mesh.ply", "one.labels.ply")] == [b"of others"] * 2


def test_what_cannot_be_fitted_costs_others_no_picture(tmp_path):
    files = _files(tmp_path)
    files.picture.write_bytes(b"\x89PNG of others")
    outputs.unfitted_entry(files, "no scan")
    assert [path.name for path in tmp_path.iterdir()] == ["one.png"]


def _files(folder):
    """Those of a scan, with an earlier fit's in their place."""
    files = outputs.ScanFiles("one.ply", "one", *(folder / f"one.{e}" for e in ("fit.npz", "mesh.ply", "labels.ply", "png")))
    for path in (files.fit, files.mesh, files.labels):
        path.write_bytes(b"of an earlier fit")
    write_png(files.picture, PIXELS)
    return files


def _held(monkeypatch, *names):
    """Have files that cannot be removed, as where another program holds them open."""
    remove = Path.unlink

    def unlink(self, missing_ok=False):
        if self.name in names:
            raise PermissionError(13, "Permission denied")
        remove(self, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize(
    "error, words",
    [(FileError("one.png", "a full disk", "room"), "one.png: got a full disk"), (MemoryError("1 GB"), "MemoryError: 1 GB")],
)
def test_whatever_is_wrong_with_a_picture_is_a_note(error, words, held, tmp_path, monkeypatch):
    def fail(*given):
        raise error

    files = _files(tmp_path)
    monkeypatch.setattr("lbsfit_np.report.render.write_png", fail)
    monkeypatch.setattr("lbsfit_np.report.fit_picture.fit_picture", lambda *given: PIXELS)
    if held:
        _held(monkeypatch, "one.png")
    note, *more = outputs.draw(files, None, None, None)
    assert note.startswith(f"no picture: {words}") and files.picture.exists() == held and files.fit.exists()
    assert more == (["one.png of an earlier run cannot be removed (Permission denied)"] if held else [])


def test_a_file_that_cannot_be_removed_does_not_stop_the_run(tmp_path, monkeypatch):
    files = _files(tmp_path)
    _held(monkeypatch, "one.mesh.ply")
    entry = outputs.unfitted_entry(files, "no scan", seconds=1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["one.mesh.ply"]
    assert entry["message"] == "no scan; one.mesh.ply of an earlier run cannot be removed (Permission denied)"
    assert (entry["status"], entry["seconds"]) == ("failed", 1.0) and "files" not in entry


@pytest.mark.parametrize("labels, words", [(None, "no such file"), (4, "4 points; expected the 5"), (5, None)])
def test_without_the_points_of_a_kept_fit_there_is_no_picture_of_it(labels, words, tube_rig, tmp_path, monkeypatch, capsys):
    files = _files(tmp_path)
    files.labels.unlink()
    if labels is not None:
        write_points_ply(files.labels, np.random.default_rng(0).random((labels, 3)))
    monkeypatch.setattr("lbsfit_np.report.fit_picture.fit_picture", lambda rig, points, result: PIXELS)
    kept_fits._draw_kept(files, tube_rig, SimpleNamespace(labels=np.zeros(5, dtype=int)))
    said = capsys.readouterr().out
    if words is None:
        assert said == "" and files.picture.read_bytes().startswith(b"\x89PNG")
    else:
        assert said.startswith("one: no picture: ") and words in said and not files.picture.exists()


@pytest.mark.parametrize("later, newer", [(-1, False), (0, True), (1, True)])
def test_a_picture_as_old_as_its_fit_is_of_it(later, newer, tmp_path):
    """Some file systems count in seconds."""
    files = _files(tmp_path)
    for path, second in ((files.fit, 100), (files.picture, 100 + later)):
        os.utime(path, (second, second))
    assert kept_fits._is_newer(files.picture, files.fit) == newer
    files.picture.unlink()
    assert not kept_fits._is_newer(files.picture, files.fit)


@pytest.mark.parametrize(
    "statuses, doubts",
    [
        (["ok", "ok"], ""),
        (["ok", "suspect", "failed", "failed", "none"], ", 1 could not be (of these fits 1 is suspect, 2 have failed)"),
        (["none", "none"], ", 2 could not be"),
        (["failed", "suspect", "suspect"], " (of these fits 2 are suspect, 1 has failed)"),
    ],
)
def test_what_could_not_be_fitted_is_told_from_what_was_fitted_wrongly(statuses, doubts):
    entries = {str(k): {"status": s, "files": {}} for k, s in enumerate(statuses) if s != "none"}
    entries |= {f"none{k}": {"status": "failed"} for k in range(statuses.count("none"))}
    counts = counts_of(entries)
    assert doubts_of(counts) == doubts and counts["unfitted"] == statuses.count("none")
    assert counts["failed"] == statuses.count("failed") + statuses.count("none")
    assert counts_of({"one": {"status": "ok"}})["unfitted"] == 0  # learned from, with no files asked for


@pytest.mark.parametrize("existing, done", [("replace", 0), ("replace", 1), ("skip", 0)])
def test_stopped_while_replacing_it_is_said_that_other_fits_are_older(existing, done, fitted, made, tmp_path, run, monkeypatch):
    """--existing skip would take them for this run's."""
    fit_all = fit._fit

    def interrupted(fitter, todo, *more):
        if done:
            fit_all(fitter, todo[:done], *more)
        raise KeyboardInterrupt

    for path in [*fitted[0].glob("one.*"), *fitted[0].glob("two.fit.npz")]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(fit, "_fit", interrupted)
    scans = [made / name for name in ("one.ply", "two.xyz", "three.npy")]
    code, text, _ = run("fit", made / "tube.npz", *scans, "-o", tmp_path, "--existing", existing, *QUICK)
    told = f"stopped: 1 of 3 scans is fitted and kept in {tmp_path}; 1 of the others has a fit"
    if not done:
        told = "stopped before a scan was fitted; the same command begins again; 2 scans have fits"
    told += " of an earlier run, which --existing skip would keep\n"
    if existing == "skip":
        told = f"stopped: 1 of 3 scans is fitted and kept in {tmp_path}; the same command with --existing skip does the rest\n"
    assert code == 130 and text.endswith(told)


def test_stopped_before_a_scan_was_fitted_the_same_command_begins_again(made, tmp_path, run, monkeypatch):
    monkeypatch.setattr(fit, "_fit", _interrupted)
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 130 and text.endswith("stopped before a scan was fitted; the same command begins again\n")


def test_one_scan_alone_is_told_as_one(fitted, made, tmp_path, run, monkeypatch):
    for path in fitted[0].glob("one.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    _, text, _ = run(*arguments)
    assert "1 of 1 scan is fitted already and kept\n" in text and "1 of 1 scan fitted, 1 of the fits kept from before" in text
    monkeypatch.setattr(fit, "_fit", _interrupted)
    assert f"stopped: 1 of 1 scan is fitted and kept in {tmp_path}; the same" in run(*arguments)[1]


def _interrupted(*given):
    raise KeyboardInterrupt


def test_a_summary_alone_is_in_nobodys_way(fitted, made, tmp_path, run):
    """Of a run whose scans could not be read, or of other scans: their fits stay."""
    (tmp_path / "scan.foo").write_text("0 0 0")
    assert run("fit", made / "tube.npz", tmp_path / "scan.foo", "-o", tmp_path / "out", *QUICK)[0] == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["summary.json"]
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 0 and "right with probability" in text
    before = (tmp_path / "out" / "one.fit.npz").read_bytes()
    assert run("fit", made / "tube.npz", made / "two.xyz", "-o", tmp_path / "out", *QUICK)[0] == 0
    assert (tmp_path / "out" / "one.fit.npz").read_bytes() == before
    code, _, err = run("fit", made / "tube.npz", made / "two.xyz", "-o", tmp_path / "out", *QUICK)
    assert code == 2 and "two.fit.npz" in one_line(err) and "--existing skip, which keeps finished fits" in err
    (tmp_path / "out" / "scan.ply").write_bytes(b"")
    code, _, err = run("demo", "--rig", made / "tube.npz", "-o", tmp_path / "out")
    assert code == 2 and "scan.ply" in one_line(err) and "skip" not in err and "--existing replace" in err


def test_what_cannot_be_fitted_now_has_no_fit_of_an_earlier_run(fitted, made, tmp_path, run):
    """--existing skip would take that for its fit."""
    scan, out = tmp_path / "one.ply", tmp_path / "out"
    out.mkdir()
    for path in fitted[0].glob("one.*"):
        (out / path.name).write_bytes(path.read_bytes())
    scan.write_bytes(b"ply")
    assert run("fit", made / "tube.npz", scan, "-o", out, "--existing", "replace", *QUICK)[0] == 1
    assert [path.name for path in out.iterdir()] == ["summary.json"]
    assert run("fit", made / "tube.npz", scan, "-o", out, "--existing", "skip", *QUICK)[0] == 1


@pytest.mark.parametrize("readable", [True, False])
def test_a_picture_of_a_fit_that_is_replaced_goes_with_it(readable, made, tmp_path, run):
    """Also where no new one is asked for; what others have drawn stays."""
    scan, picture = tmp_path / "one.ply", tmp_path / "out" / "one.png"
    scan.write_bytes((made / "one.ply").read_bytes())
    arguments = ("fit", made / "tube.npz", scan, "-o", tmp_path / "out", *QUICK)
    assert run(*arguments, "--pictures")[0] == 0 and picture.is_file()
    if not readable:
        scan.write_bytes(b"ply")
    ours = picture.read_bytes()
    for drawn in (None, b"of others"):
        if drawn is not None:
            picture.write_bytes(drawn)
        assert run(*arguments, "--existing", "replace")[0] == (0 if readable else 1)
        assert (picture.read_bytes() if picture.exists() else None) == drawn
    for path in picture.parent.glob("one.*"):
        path.unlink()
    picture.write_bytes(ours)  # of nothing that is there: it stays
    assert run(*arguments)[0] == (0 if readable else 1) and picture.read_bytes() == ours


def test_kept_fits_keep_their_status(fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    scans = [made / "one.ply", made / "two.xyz"]
    arguments = ("fit", made / "tube.npz", *scans, "-o", tmp_path, "--existing", "skip", *QUICK)
    for status, words, probability, code in (("suspect", "is suspect", 0.3, 0), ("failed", "has failed", 0.01, 1)):
        doubtful = replace(lbs.FitResult.load(fitted[0] / "two.fit.npz"), status=status, probability=probability, message="odd")
        (tmp_path / "two.fit.npz").unlink()
        doubtful.save(tmp_path / "two.fit.npz")
        found, text, _ = run(*arguments)
        assert found == code
        assert f"2 of 2 scans fitted (of these fits 1 {words}), 2 of the fits kept from before; results in" in text
        assert f"two   {status.ljust(len('status'))}  {probability:.2f}" in text and text.rstrip().count("odd") == 1
        summary = json.loads((tmp_path / "summary.json").read_text())
        assert [(s["name"], s["status"], s["kept"]) for s in summary["scans"]] == [("two", status, True), ("one", "ok", True)]
        assert summary["counts"] == {"ok": 1, "suspect": 0, "failed": 0, "unfitted": 0, "kept": 2} | {status: 1}


def test_skip_does_not_take_fits_of_another_rig(fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    code, _, err = run(*arguments, "--parts", "arm and fingers")
    assert code == 2 and "a fit of another rig" in one_line(err)


def test_names_of_results_that_are_too_long_are_found_before_any_work(made, tmp_path, run):
    scan = tmp_path / ("s" * 246 + ".ply")  # 250 bytes: the scan can be read, but its .labels.ply could not be written
    scan.write_bytes((made / "one.ply").read_bytes())
    code, _, err = run("fit", made / "tube.npz", scan, "-o", tmp_path / "out", *QUICK)
    assert code == 2 and "too long for a file" in one_line(err) and "Rename the scan" in err
    assert not (tmp_path / "out").exists()


def test_files_of_a_scan_appear_together_or_not_at_all(made, tmp_path, run, monkeypatch):
    import lbsfit_np.io.write

    def full(path, *_, **__):
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lbsfit_np.io.write, "write_points_ply", full)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, *QUICK)
    assert code == 1 and "one: failed: " in err and "No space left" in err
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


@pytest.mark.parametrize("last", ["one.fit.npz", "one.mesh.ply"])
def test_what_a_stop_leaves_while_files_get_their_names_is_made_anew(last, made, tmp_path, run, monkeypatch):
    move = os.replace

    def stopped(source, target):
        move(source, target)
        if Path(target).name == last:
            raise KeyboardInterrupt

    command = ["fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", *QUICK]
    monkeypatch.setattr(os, "replace", stopped)
    assert run(*command)[0] == 130
    monkeypatch.setattr(os, "replace", move)
    assert run(*command, "--existing", "skip")[0] == 0
    assert sorted(path.name for path in (tmp_path / "out").glob("one.*")) == ["one.fit.npz", "one.labels.ply", "one.mesh.ply"]
