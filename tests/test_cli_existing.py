"""Names that clash, inputs that are results, and what is there already: found before any work."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import QUICK, one_line

import lbsfit_np as lbs
from lbsfit_np.cli import fit
from lbsfit_np.cli.summary import counts_of, doubts_of
from lbsfit_np.io.write import write_points_ply
from lbsfit_np.report.render import write_png

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")


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
    assert ("Leave one out" if other == "one.ply" else "fit them into different folders") in err
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
    assert code == 0 and "kept existing fits of 1 of 2 scans\n" in text and "[1/1] two: fitted" in text
    assert (tmp_path / "one.fit.npz").stat().st_mtime_ns == old[tmp_path / "one.fit.npz"]
    assert (tmp_path / "two.labels.ply").is_file()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [(s["status"], s["kept"]) for s in summary["scans"]] == [("ok", True), ("ok", False)]
    assert summary["counts"] == {"ok": 2, "suspect": 0, "failed": 0, "unfitted": 0, "kept": 1}
    assert f"2 of 2 scans fitted, 1 of them kept from earlier runs; results in {tmp_path}\n" in text
    assert summary["scans"][0]["terms"] == lbs.FitResult.load(tmp_path / "one.fit.npz").terms

    (tmp_path / "one.fit.npz").write_bytes(b"broken")
    code, text, _ = run("fit", made / "tube.npz", scans[0], "-o", tmp_path, "--existing", "skip", *QUICK)
    assert code == 0 and "fitted again" in text and lbs.FitResult.load(tmp_path / "one.fit.npz").status == "ok"

    code, _, _ = run("fit", made / "tube.npz", scans[0], "-o", tmp_path, "--existing", "replace", "--no-registration", *QUICK)
    assert code == 0 and (tmp_path / "one.mesh.ply").read_bytes() != (fitted[0] / "one.mesh.ply").read_bytes()


def test_files_that_no_fit_belongs_to_are_nothing_to_skip(made, tmp_path, run):
    for name in ("one.mesh.ply", "one.labels.ply"):
        (tmp_path / name).write_bytes(b"of others")
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, *QUICK)
    for more in ((), ("--existing", "skip")):
        code, _, err = run(*arguments, *more)
        assert code == 2 and "one.mesh.ply, one.labels.ply exist already" in one_line(err) and "no fit (NAME.fit.npz)" in err
        assert "--existing replace" in err and "keeps finished fits" not in err
    assert [(tmp_path / name).read_bytes() for name in ("one.mesh.ply", "one.labels.ply")] == [b"of others"] * 2


@pytest.mark.parametrize(
    "statuses, doubts",
    [
        (["ok", "ok"], ""),
        (["ok", "suspect", "failed", "failed", "none"], ", 1 could not be fitted (status: 1 ok, 1 suspect, 2 failed)"),
        (["none", "none"], ", 2 could not be fitted"),
        (["failed", "suspect", "suspect"], " (status: 2 suspect, 1 failed)"),
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
        told = "stopped before any scan was fitted; run the same command to start again; 2 scans have fits"
    told += " from an earlier run, which --existing skip would keep\n"
    if existing == "skip":
        told = f"stopped: 1 of 3 scans is fitted and kept in {tmp_path}; run the same command with --existing skip to continue\n"
    assert code == 130 and text.endswith(told)


def test_stopped_before_a_scan_was_fitted_the_same_command_begins_again(made, tmp_path, run, monkeypatch):
    monkeypatch.setattr(fit, "_fit", _interrupted)
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 130 and text.endswith("stopped before any scan was fitted; run the same command to start again\n")


def test_one_scan_alone_is_told_as_one(fitted, made, tmp_path, run, monkeypatch):
    for path in fitted[0].glob("one.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    _, text, _ = run(*arguments)
    assert "kept existing fits of 1 of 1 scan\n" in text and "1 of 1 scan fitted, 1 of them kept from earlier runs" in text
    monkeypatch.setattr(fit, "_fit", _interrupted)
    assert f"stopped: 1 of 1 scan is fitted and kept in {tmp_path}; run the same" in run(*arguments)[1]


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


@pytest.mark.parametrize("content", ['{"my": "data"}', "[1]", '{"versions": {"numpy": "2"}}', "no JSON"])
@pytest.mark.parametrize("existing", ["error", "skip"])
def test_a_summary_of_another_program_is_not_written_over(content, existing, made, tmp_path, run):
    (tmp_path / "summary.json").write_text(content)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, *QUICK, "--existing", existing)
    assert code == 2 and "-o: got" in one_line(err) and "with a summary.json that lbsfit did not write" in err
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]
    assert (tmp_path / "summary.json").read_text() == content


def test_results_that_are_links_stay_links_to_what_is_written(fitted, made, tmp_path, run):
    """As some programs that keep large files elsewhere have them."""
    out, store = tmp_path / "out", tmp_path / "store"
    out.mkdir(), store.mkdir()
    for kind in ("fit.npz", "mesh.ply", "labels.ply", "png"):
        (store / kind).write_text("older")
        (out / f"one.{kind}").symlink_to(store / kind)
    write_png(store / "png", np.zeros((2, 2, 3), np.uint8))
    assert run("fit", made / "tube.npz", made / "one.ply", "-o", out, "--existing", "replace", *QUICK)[0] == 0
    assert json.loads((out / "summary.json").read_text())["scans"][0]["files"].keys() == {"fit", "mesh", "labels"}
    for kind in ("fit.npz", "mesh.ply", "labels.ply"):
        assert (out / f"one.{kind}").is_symlink() and len((store / kind).read_bytes()) > 1000
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", out, "--existing", "skip", *QUICK)
    assert code == 0 and "kept" in text and not (out / "one.png").exists()
    text = run("fit", made / "tube.npz", made / "one.ply", "-o", out, "--existing", "skip", "--pictures", *QUICK)[1]
    assert "no picture" not in text and (out / "one.png").is_symlink() and (store / "png").stat().st_size > 1000


def test_kept_fits_keep_their_status(fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    scans = [made / "one.ply", made / "two.xyz"]
    arguments = ("fit", made / "tube.npz", *scans, "-o", tmp_path, "--existing", "skip", *QUICK)
    for status, probability, code in (("suspect", 0.3, 0), ("failed", 0.01, 1)):
        doubtful = replace(lbs.FitResult.load(fitted[0] / "two.fit.npz"), status=status, probability=probability, message="odd")
        (tmp_path / "two.fit.npz").unlink()
        doubtful.save(tmp_path / "two.fit.npz")
        found, text, _ = run(*arguments)
        assert found == code
        assert f"2 of 2 scans fitted (status: 1 ok, 1 {status}), 2 of them kept from earlier runs; results in" in text
        assert f"two   {status.ljust(len('status'))}  {probability:.2f}" in text and text.rstrip().count("odd") == 1
        summary = json.loads((tmp_path / "summary.json").read_text())
        assert [(s["name"], s["status"], s["kept"]) for s in summary["scans"]] == [("two", status, True), ("one", "ok", True)]
        assert summary["counts"] == {"ok": 1, "suspect": 0, "failed": 0, "unfitted": 0, "kept": 2} | {status: 1}


def test_kept_fits_that_were_made_with_other_options_are_told(fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    first = lbs.FitResult.load(tmp_path / "one.fit.npz")
    assert first.settings["random_state"] == 0 and first.settings["version"] == lbs.__version__
    arguments = ("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", "-o", tmp_path, "--existing", "skip", *QUICK)
    _, text, _ = run(*arguments)
    assert "note" not in text and "other_settings" not in (tmp_path / "summary.json").read_text()
    two = lbs.FitResult.load(tmp_path / "two.fit.npz")
    replace(two, settings=two.settings | {"random_state": 7}).save(tmp_path / "two.fit.npz")
    more = ("--seed", "3", "--partial", "--up=+z", "--training", "noise=0.01")
    code, text, _ = run(*arguments, *more)
    assert code == 0 and "2 of 2 scans fitted, 2 of them kept from earlier runs" in text
    words = "no --partial (not --partial), --seed {} (not --seed 3)"
    words += ", no --training (not --training noise=0.01), no --up (not --up +z)"
    notes = [line for line in text.splitlines() if line.startswith("note: 1 kept fit was made with ")]
    assert [note.partition(" with ")[2].split(";")[0] for note in notes] == [words.format(0), words.format(7)]
    assert all(note.endswith("; --existing replace fits all again") for note in notes)
    entries = {entry["name"]: entry for entry in json.loads((tmp_path / "summary.json").read_text())["scans"]}
    other = {"up": None, "partial": False, "training": {}, "random_state": 0}
    text = run(*arguments)[1]
    assert "note: 1 kept fit was made with --seed 7 (not --seed 0); " in text and text.count("note: ") == 1
    earlier = {name: value for name, value in two.settings.items() if name != "registration"}  # which came later
    replace(two, settings=earlier).save(tmp_path / "two.fit.npz")
    assert "note: 1 kept fit was made with unknown --registration (not --registration); " in run(*arguments)[1]
    replace(two, settings={}).save(tmp_path / "two.fit.npz")
    assert "note: 1 kept fit was made with unknown settings; " in run(*arguments)[1]
    assert '"other_settings": null' in (tmp_path / "summary.json").read_text()
    assert entries["one"]["other_settings"] == other and entries["two"]["other_settings"] == other | {"random_state": 7}


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


def test_skip_leaves_files_alone_that_are_no_fits(fitted, made, tmp_path, run, monkeypatch):
    """Also where mesh or labels are missing, which of a fit would have it made again."""
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    fit = tmp_path / "one.fit.npz"
    np.savez(fit, mine=np.arange(3))
    before = fit.read_bytes()
    code, _, err = run(*arguments)
    assert code == 2 and "one.fit.npz, which is no fit" in one_line(err) and fit.read_bytes() == before
    fit.write_bytes((fitted[0] / "one.fit.npz").read_bytes())
    code, _, err = run(*arguments, "--parts", "arm and fingers")
    assert code == 2 and "a fit of another rig" in one_line(err)
    before = fit.read_bytes()

    def refused(path, *arguments, **options):
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr("lbsfit_np.cli.kept_fits.open", refused, raising=False)
    fit.write_bytes(before[:100])
    code, _, err = run(*arguments)
    assert code == 2 and "--existing skip: got" in one_line(err) and "expected fits that can be read" in err
    assert fit.read_bytes() == before[:100]


def test_a_mesh_without_content_is_missing(fitted, made, tmp_path, run):
    for name in ("one.fit.npz", "one.mesh.ply", "one.labels.ply"):
        (tmp_path / name).write_bytes((fitted[0] / name).read_bytes())
    (tmp_path / "one.mesh.ply").write_bytes(b"")
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    assert code == 0 and "kept" not in text and (tmp_path / "one.mesh.ply").stat().st_size > 0


def test_kept_fits_of_other_points_are_told(fitted, made, tmp_path, run):
    """As of a scan of the same name in another folder."""
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / "one.ply"
    other.write_bytes((made / "one.ply").read_bytes())
    arguments = ("fit", made / "tube.npz", other, made / "two.xyz", "-o", tmp_path, "--existing", "skip", *QUICK)
    code, text, _ = run(*arguments)
    assert code == 0 and "note: " not in text and '"other_points"' not in (tmp_path / "summary.json").read_text()
    moved = lbs.load_scan(made / "two.xyz").points + [0.0, 0.0, 0.01]
    for points in (moved, moved[:300]):
        write_points_ply(other, points)
        run(*arguments)
        os.utime(other, ns=(0, 0))  # what was found is found again
        code, text, _ = run(*arguments)
        said = f"note: 1 kept fit was made of other points than those now in {other}, read with these options; delete their files"
        assert code == 0 and said in text and "kept existing fits of 2 of 2 scans" in text
        entries = {e["name"]: e for e in json.loads((tmp_path / "summary.json").read_text())["scans"]}
        assert entries["one"]["other_points"] and "other_points" not in entries["two"]
    other.write_text("ply")
    text = run(*arguments)[1]
    assert f"note: 1 kept fit was not compared with {other}, which cannot be read with these options: a " in text
    assert '"other_points": null' in (tmp_path / "summary.json").read_text()


def test_points_are_compared_whatever_names_and_times_say(fitted, made, tmp_path, run, monkeypatch):
    """As of two folders whose scans are named alike, and of an older file that was moved into a scan's place."""
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    moved = lbs.load_scan(made / "one.ply").points + [0.0, 0.0, 0.01]
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "one.ply").write_bytes((made / "one.ply").read_bytes())
    write_points_ply(tmp_path / "b" / "one.ply", moved)
    for path in (tmp_path / "a" / "one.ply", tmp_path / "b" / "one.ply"):
        os.utime(path, ns=(0, 0))
    arguments = ("fit", made / "tube.npz", "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    said = "note: 1 kept fit was made of other points than those now in one.ply, read with these options"
    for folder, others in (("a", False), ("b", True), ("a", False)):
        monkeypatch.chdir(tmp_path / folder)
        assert (said in run(*arguments)[1]) == others
    os.replace(tmp_path / "b" / "one.ply", tmp_path / "a" / "one.ply")
    assert said in run(*arguments)[1]


@pytest.mark.parametrize("kind, of", [("labels", "points"), ("mesh", "vertices")])
@pytest.mark.parametrize("damage, got", [("cut", "a file that "), ("of another scan", "4 {of}; expected the ")])
def test_a_scan_whose_labels_or_mesh_cannot_be_used_is_fitted_again(damage, got, kind, of, fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    damaged = tmp_path / f"one.{kind}.ply"
    whole = damaged.read_bytes()
    if damage == "cut":
        damaged.write_bytes(whole[: len(whole) // 2])
    else:
        write_points_ply(damaged, np.random.default_rng(0).random((4, 3)))
    code, text, _ = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    assert code == 0 and f"one: {damaged} cannot be used ({got.format(of=of)}" in text and "so the scan is fitted again" in text
    assert damaged.read_bytes() == whole and "note: " not in text and "kept" not in text
