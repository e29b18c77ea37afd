"""Pictures of fits: drawn with them, gone with those that others replace, and never in their way."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import QUICK, one_line

import lbsfit_np as lbs
from lbsfit_np.cli import outputs, scan_results
from lbsfit_np.errors import FileError
from lbsfit_np.report.render import is_signed, write_png

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")

PIXELS = np.zeros((4, 4, 3), dtype=np.uint8)


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
    (tmp_path / "one.png").write_bytes(b"of others")
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--pictures", *QUICK)
    assert run(*arguments, "--existing", "replace")[0] == 0
    (scan,) = json.loads((tmp_path / "summary.json").read_text())["scans"]
    note = "no picture: forward: got '+y'; expected another axis"
    assert scan["notes"] == [f"{note}; one.png is not of this fit"] and "picture" not in scan["files"]
    assert lbs.FitResult.load(tmp_path / "one.fit.npz").status == "ok" and (tmp_path / "one.png").read_bytes() == b"of others"
    write_png(tmp_path / "one.png", PIXELS)
    assert run(*arguments, "--existing", "replace")[0] == 0 and not (tmp_path / "one.png").exists()  # of the fit that is gone
    (scan,) = json.loads((tmp_path / "summary.json").read_text())["scans"]
    assert scan["notes"] == [f"{note}."]
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
    scan_results.Writer(tube_rig, (files,))(0, lbs.load_scan(made / "one.ply"), result)
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
    assert code == 0 and "one.png was not drawn by lbsfit" in out + err
    assert texture.read_bytes() == b"\x89PNG of others"
    assert "picture" not in json.loads((tmp_path / "summary.json").read_text())["scans"][0]["files"]


def test_a_picture_of_others_is_not_drawn_over_where_a_scan_is_still_to_be_fitted(made, tmp_path, run):
    texture = tmp_path / "one.png"
    texture.write_bytes(b"\x89PNG of others")
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--pictures", *QUICK)
    code, _, err = run(*arguments)
    assert code == 2 and "one.png exists already, which lbsfit did not draw" in one_line(err)
    assert "keeps pictures that lbsfit did not draw" in err and "keeps finished fits" not in err
    code, out, _ = run(*arguments, "--existing", "skip")
    assert code == 0 and out.count("one.png was not drawn by lbsfit and is kept\n") == 1 and "1 of 1 scan fitted" in out
    assert texture.read_bytes() == b"\x89PNG of others" and (tmp_path / "one.fit.npz").is_file()
    (scan,) = json.loads((tmp_path / "summary.json").read_text())["scans"]
    assert sorted(scan["files"]) == ["fit", "labels", "mesh"]
    code, _, err = run(*arguments)
    assert "keeps finished fits" in err and ", of which one.png lbsfit did not draw" in one_line(err)
    assert run(*arguments, "--existing", "replace")[0] == 0 and is_signed(texture)


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


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize(
    "error, words",
    [(FileError("one.png", "a full disk", "room"), "one.png: got a full disk"), (MemoryError("1 GB"), "MemoryError: 1 GB")],
)
def test_whatever_is_wrong_with_a_picture_is_a_note(error, words, there, tmp_path, monkeypatch):
    def fail(*given):
        raise error

    files = _files(tmp_path)
    monkeypatch.setattr("lbsfit_np.report.render.write_png", fail)
    monkeypatch.setattr("lbsfit_np.report.fit_picture.fit_picture", lambda *given: PIXELS)
    if not there:
        files.picture.unlink()
    note, *more = scan_results.draw(files, None, None, None)
    end = "; one.png is not of this fit" if there else ""
    assert note.startswith(f"no picture: {words}") and note.endswith(end) and not more
    assert files.picture.exists() == there and files.fit.exists()


@pytest.mark.parametrize("held", [(), ("one.png",)])
def test_an_earlier_fits_picture_that_cannot_be_removed_is_a_note(held, fitted, made, tube_rig, tmp_path, monkeypatch):
    files = replace(_files(tmp_path), picture=None)
    _held(monkeypatch, *held)
    result = lbs.FitResult.load(fitted[0] / "one.fit.npz")
    entry = scan_results.Writer(tube_rig, (files,))(0, lbs.load_scan(made / "one.ply"), result)
    assert entry["notes"] == ["one.png of an earlier run cannot be removed (Permission denied)"] * len(held)
    assert (entry["status"], (tmp_path / "one.png").exists()) == ("ok", bool(held))


@pytest.mark.parametrize("later, newer", [(-1, False), (0, True), (1, True)])
def test_a_picture_as_old_as_its_fit_is_of_it(later, newer, tmp_path):
    """Some file systems count in seconds."""
    files = _files(tmp_path)
    for path, second in ((files.fit, 100), (files.picture, 100 + later)):
        os.utime(path, (second, second))
    assert scan_results.is_picture_of(files.fit, files.picture) == newer
    files.picture.unlink()
    assert not scan_results.is_picture_of(files.fit, files.picture)


@pytest.mark.parametrize("readable", [True, False])
def test_a_picture_of_a_fit_that_is_replaced_goes_with_it(readable, made, tmp_path, run):
    """Also where no new one is asked for; it stays with its fit, and what others have drawn stays in any case."""
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
        stays = drawn if readable else drawn or ours
        assert (picture.read_bytes() if picture.exists() else None) == stays
    for path in picture.parent.glob("one.*"):
        path.unlink()
    picture.write_bytes(ours)  # of nothing that is there: it stays
    assert run(*arguments)[0] == (0 if readable else 1) and picture.read_bytes() == ours
