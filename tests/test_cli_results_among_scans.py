"""Results that were written into the folder of the scans: patterns name both, and results are no scans then."""

import json

import numpy as np
import pytest
from cli_runs import QUICK, one_line

import lbsfit_np as lbs
from lbsfit_np.cli import learn
from lbsfit_np.cli.earlier_results import results_beside, without_results
from lbsfit_np.cli.subjects import read_subjects
from lbsfit_np.errors import FileError
from lbsfit_np.report.render import write_png

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")


@pytest.fixture
def folder(fitted, made, tmp_path):
    """A folder with the scans one.ply and two.xyz, their fits, and the summary."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for path in (made / "one.ply", made / "two.xyz", *fitted[0].iterdir()):
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def test_the_same_pattern_means_the_same_scans_once_there_are_results(folder, made, run):
    before = {path: path.stat().st_mtime_ns for path in folder.glob("*.fit.npz")}
    arguments = ("fit", made / "tube.npz", *sorted(folder.iterdir()), "-o", folder, *QUICK)
    code, text, err = run(*arguments, "--existing", "skip")
    assert (code, err) == (0, "") and "2 of 2 scans fitted, 2 of them kept from earlier runs" in text
    told = "skipped 7 of 9 files, which are results that lbsfit has written beside their scans: one.fit.npz, one.labels.ply, "
    told += "one.mesh.ply and 4 more; to fit such a file as a scan, give it without its scan\n"
    assert text.startswith(told)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    code, _, err = run(*arguments)
    assert code == 2 and "one.fit.npz" in one_line(err) and "exist already" in err and "--existing skip" in err


def test_results_are_not_fitted_into_another_folder(folder, made, tmp_path, run):
    code, text, _ = run("fit", made / "tube.npz", *sorted(folder.glob("one.*")), "-o", tmp_path / "out", *QUICK)
    assert code == 0 and "skipped 3 of 4 files, which are results " in text and "1 of 1 scan fitted" in text
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [scan["name"] for scan in summary["scans"]] == ["one"]


def test_a_registration_can_be_registered(folder, made, tmp_path, run):
    """On purpose: its scan is not given."""
    scans = (folder / "one.mesh.ply", folder / "two.xyz")
    code, text, _ = run("fit", made / "tube.npz", *scans, "-o", tmp_path / "out", *QUICK)
    assert code == 0 and "left out" not in text and "2 of 2 scans fitted" in text
    assert (tmp_path / "out" / "one.mesh.mesh.ply").is_file()


def test_learning_leaves_results_out_as_well(folder, made, tmp_path, run, monkeypatch):
    read = []

    def stopped(fitter, reading, *given):
        read.extend(reading.paths)
        raise KeyboardInterrupt

    monkeypatch.setattr(learn, "_learn", stopped)
    code, text, _ = run("learn", made / "tube.npz", *sorted(folder.iterdir()), "-o", tmp_path / "m.npz", "--results", folder,
                        "--existing", "replace")  # fmt: skip
    assert code == 130 and text.startswith("skipped 7 of 9 files") and read == [str(folder / n) for n in ("one.ply", "two.xyz")]


@pytest.mark.parametrize("relative", [False, True])
def test_what_is_a_result(relative, folder, fitted, capsys, monkeypatch):
    (folder / "sub").mkdir()
    write_png(folder / "one.png", np.zeros((4, 4, 3), dtype=np.uint8))
    (folder / "two.png").write_bytes(b"a texture")
    names = ("three.ply", "three.mesh.ply", "four.ply", "four.labels.ply", "four.fit.npz", "sub/one.ply", "sub/two.mesh.ply")
    for name in names:  # without a fit, with one that is none, elsewhere
        (folder / name).write_bytes(b"ply")
    np.savez(folder / "three.fit.npz", a=1)
    if relative:
        monkeypatch.chdir(folder)

    def given(*names):
        return list(names) if relative else [str(folder / name) for name in names]

    assert without_results(given("one.png", "one.mesh.ply", "one.ply", "two.png")) == given("one.ply", "two.png")
    assert "skipped 2 of 4 files, which are results that lbsfit has written beside their scans: one.png, one.mesh.ply; " in (
        capsys.readouterr().out
    )
    assert without_results(given("one.ply", "one.mesh.ply")) == given("one.ply")
    assert "skipped 1 of 2 files, which is a result that lbsfit has written beside its scan: one.mesh.ply; " in (
        capsys.readouterr().out
    )
    scans = given(*names, "three.fit.npz", "summary.json", "two.png", "two.xyz", "one.mesh.ply", "one.labels.ply", "one.png")
    assert without_results(scans) == scans and capsys.readouterr().out == ""
    (folder / "four.fit.npz").write_bytes((fitted[0] / "one.fit.npz").read_bytes())
    assert without_results(given(*names)) == given("three.ply", "three.mesh.ply", "four.ply", *names[5:])
    deep = given("three.ply", "three.mesh.ply", "three.mesh.mesh.ply")  # a registration that was registered
    lbs.FitResult.load(fitted[0] / "one.fit.npz").save(folder / "three.mesh.fit.npz")
    assert without_results(deep) == deep[:2]


def test_a_table_may_name_results_that_are_left_out(folder, tmp_path, capsys):
    """As a list of all files in the folder does; whether they are given or not."""
    table, files = tmp_path / "who.csv", sorted(map(str, folder.iterdir()))
    scans = without_results(files)
    assert results_beside(scans) == [path for path in files if path not in scans]
    for names in (files, [path.rpartition("/")[2] for path in files], ["one.ply", "one.labels", "two", "two.fit", "summary"]):
        table.write_text("".join(f"{name},{'ann' if 'one' in name else 'ben'}\n" for name in names))
        assert read_subjects(table, scans) == ["ann", "ben"] == read_subjects(table, scans, others=True)
    table.write_text("one,ann\ntwo,ben\nthree.mesh.ply,ben\n")
    with pytest.raises(FileError, match="'three.mesh.ply' in line 3, which is none of the scans given"):
        read_subjects(table, scans)
    (folder / "one.fit.npz").unlink()  # then nobody has left the mesh out
    table.write_text("one,ann\ntwo,ben\none.mesh.ply,ann\n")
    with pytest.raises(FileError, match="'one.mesh.ply' in line 3, which is none of the scans given"):
        read_subjects(table, scans)


def test_results_are_found_however_paths_are_written(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    scan = str(folder / "one.ply")
    assert without_results([scan, "one.mesh.ply", "../scans/one.fit.npz", "./summary.json", "two.xyz"]) == [scan, "two.xyz"]
    assert "skipped 3 of 5 files" in capsys.readouterr().out
