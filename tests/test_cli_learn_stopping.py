"""``lbsfit learn`` that is stopped or cannot write: no half model, and no finished result lost."""

import json
import os
import re
import shlex
import signal
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import QUICK, QUICK_LEARNING, as_said, one_line, started, stopped
from registered_sets import result_of
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.cli import learn, outputs, scan_results, stopped_learning
from lbsfit_np.cli.stopped_learning import results_so_far
from lbsfit_np.errors import FileError
from lbsfit_np.io.npz import MODEL_KEY
from lbsfit_np.io.write import make_folder
from lbsfit_np.learning.checkpoint import steps_in
from lbsfit_np.learning.first_fits import FirstFit

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
@pytest.mark.parametrize("jobs, sent, code", [slow(2, signal.SIGINT, 130), (1, signal.SIGTERM, 143)])
def test_ctrl_c_leaves_what_a_finished_round_has_learned(jobs, sent, code, tubes, tube_model, cli_cache, tmp_path):
    text, err, returned = _stopped_after("round 1 of", jobs, sent, tubes, cli_cache, tmp_path)
    assert (returned, err) == (code, ""), err
    scans = " ".join(shlex.quote(str(tubes / name)) for name in ("t0.ply", "t1.ply"))
    scans = re.escape(scans if len(scans) <= stopped_learning._SHORT else "SCAN...")
    how = r"run the same command with --existing replace to continue from the steps kept in .*m\.npz\.unfinished; "
    how += rf"to fit scans with it: lbsfit fit .*m\.npz {scans} -o .*fits"
    round_kept = re.search(rf"stopped: .*m\.npz has what round (\d+) learned, without results; {how}\n$", text)[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.npz", "m.npz.unfinished"]  # no empty folder of results
    learned = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert [entry["round"] for entry in learned.history_ if entry["kept"]] == [int(round_kept)]
    assert learned.fit_scan(lbs.load_scan(sorted(tubes.glob("*.ply"))[0])).vertices.shape == learned.rig.vertices.shape


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
@pytest.mark.parametrize("jobs, sent, code", [(1, signal.SIGINT, 130), slow(2, signal.SIGTERM, 143)])
def test_ctrl_c_before_the_first_round_ends_leaves_no_model(jobs, sent, code, tubes, tube_model, cli_cache, tmp_path):
    how = {"wait": 0.0, "hurried": False}
    text, err, returned = _stopped_after("each scan by itself, with", jobs, sent, tubes, cli_cache, tmp_path, **how)
    assert (returned, err) == (code, ""), err
    folder = tmp_path / "m.npz.unfinished"
    end = f"run the same command to continue from the steps kept in {folder}\n"
    assert text.endswith(f"stopped before the model was learned; {end}")
    assert list(tmp_path.iterdir()) == [folder]


@pytest.mark.skipif(os.name != "posix", reason="a process is killed as POSIX does it")
@pytest.mark.parametrize("jobs", [1, slow(2)])
def test_a_run_that_was_killed_goes_on_with_the_same_command(jobs, tubes, tube_model, cli_cache, tmp_path, run, monkeypatch):
    folder, scans = tmp_path / "m.npz.unfinished", sorted(tubes.glob("*.ply"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *QUICK_LEARNING, "--jobs", jobs)
    process = started(*arguments, cache=cli_cache, hurried=True)
    while process.poll() is None and len(list(folder.glob("first-fit-*.npz"))) < 2:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=120)
    assert process.returncode == -signal.SIGKILL and list(tmp_path.iterdir()) == [folder]
    kept, fitted, call = steps_in(folder), [], FirstFit.__call__
    monkeypatch.setattr(FirstFit, "__call__", lambda self, member: fitted.append(member) or call(self, member))
    code, text, err = run(*arguments[:-1], 1)
    assert (code, err, len(fitted)) == (0, "", max(len(scans) - kept, 0)) and kept >= 2
    some = "those that match this run are reused"
    assert text.startswith(f"note: found {kept} saved steps of an interrupted run in {folder}; {some}\n")
    assert [path.name for path in tmp_path.iterdir()] == ["m.npz"]
    found, expected = (dict(np.load(path)) for path in (tmp_path / "m.npz", tube_model[0]))
    for name in expected.keys() - {MODEL_KEY}:  # which has the seconds of rounds
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def test_what_a_cache_could_not_keep_is_not_said_to_be_kept(tubes, tmp_path, run, monkeypatch):
    def interrupted(self, *given, **options):
        self.pretrain(cache=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "fit", interrupted)
    monkeypatch.setattr("lbsfit_np.segmentation.cache._MEMORY", {})
    arguments = ("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz", "--training-scans", 2)
    (tmp_path / "file").write_text("no folder")
    for folder, kept in (("file", False), ("folder", True)):
        monkeypatch.setattr("lbsfit_np.segmentation.cache._MEMORY", {})
        monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / folder))
        code, text, err = run(*arguments, "--seed", 1)
        assert code == 130 and ("cannot be kept" in err) == (not kept)
        more = "the first training is kept; run the same command to start the rounds again"
        assert text.endswith(f"stopped before the model was learned; {more if kept else 'run the same command to start again'}\n")


def _stopped_after(words, jobs, sent, tubes, cache, folder, *, wait=0.5, hurried=True):
    """What is said after a line that begins so, and the exit code, of a process that gets a signal then.

    Without a hurry what comes next takes longer than the signal does.
    """
    process = started(
        *("learn", tubes / "tube.npz", tubes / "t0.ply", tubes / "t1.ply", "-o", folder / "m.npz", "--results", folder / "fits"),
        *(*QUICK, "--rounds", 1000, "--held-out", 0, "--jobs", jobs),
        cache=cache,
        hurried=hurried,
    )
    for line in process.stdout:
        if line.startswith(words) and "recon" in line:
            break
    time.sleep(wait)
    text, err = stopped(process, sent)
    return text, err, process.returncode


@pytest.mark.parametrize("variant", ["joint", "free-form"])
def test_stopped_before_anything_was_trained_nothing_is_said_to_be_kept(variant, tubes, tmp_path, run, monkeypatch):
    def interrupted(*given, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.learning.pretraining.pretrain_library", interrupted)
    monkeypatch.setattr("lbsfit_np.learning.fitter.fit_free_form", interrupted)
    (tmp_path / "mine").mkdir()
    outputs = ("-o", tmp_path / "new" / "deep" / "m.npz", "--results", tmp_path / "mine")
    code, text, _ = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *outputs, "--variant", variant)
    assert code == 130 and text.endswith("stopped before the model was learned; run the same command to start again\n")
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]  # which was there


def test_ctrl_c_among_the_results_keeps_the_model(tubes, tmp_path, run, monkeypatch):
    write = scan_results.Writer.__call__

    def interrupted(self, index, scan, result):
        if index == 2:
            raise KeyboardInterrupt
        return write(self, index, scan, result)

    monkeypatch.setattr(scan_results.Writer, "__call__", interrupted)
    (tmp_path / "t4.ply").write_bytes(b"")
    scans = (*sorted(tubes.glob("*.ply")), tmp_path / "t4.ply")
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    code, text, err = run(*arguments, "--variant", "free-form")
    assert (code, len(err.splitlines())) == (130, 1) and err.startswith("t4: failed: ")
    assert text.splitlines()[-1].startswith("stopped: ") and "m.npz is complete, 2 of 5 results in" in text
    assert sum(line.startswith("t4 ") for line in text.splitlines()) == 1
    assert len(lbs.LBSFitter.load(tmp_path / "m.npz").template_) == 1
    summary = json.loads((tmp_path / "fits" / "summary.json").read_text())
    assert summary["stopped"] and summary["not_done"] == ["t2", "t3"]  # as the last lines have it
    counts = summary["counts"]
    assert counts["ok"] + counts["suspect"] == 2 and counts["failed"] == counts["unfitted"] == 1


def test_ctrl_c_after_the_results_names_a_scan_that_failed_once(tubes, tmp_path, run, monkeypatch):
    def interrupted(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(learn, "_say_statuses", interrupted)
    (tmp_path / "broken.ply").write_text("ply")
    arguments = ("learn", tubes / "tube.npz", tubes / "t0.ply", tmp_path / "broken.ply", "-o", tmp_path / "m.npz")
    code, text, err = run(*arguments, "--variant", "free-form")
    assert code == 130 and err.startswith("broken: failed: ") and text.splitlines()[-1].endswith("m.npz is complete")
    assert sum(line.startswith("broken ") for line in text.splitlines()) == 1


def _stopped_among_results(
    run, tubes, out, stop_at, monkeypatch, *options, stop_in=scan_results.Writer, method="__call__", letters=0
):
    """The last line of a run that is stopped at some call of a function, and the scans."""
    call, calls = getattr(stop_in, method), []

    def interrupted(*given, **more):
        calls.append(given)
        if len(calls) > stop_at:
            raise KeyboardInterrupt
        return call(*given, **more)

    scans = [str(path) for path in sorted(tubes.glob("t*.ply"))]
    with monkeypatch.context() as patch:
        patch.setattr(stop_in, method, interrupted)
        patch.setattr(stopped_learning, "_SHORT", letters)
        arguments = ("learn", tubes / "tube.npz", *scans, "-o", out / "m n.npz", "--results", out / "fi ts", *options)
        code, text, _ = run(*arguments, "--variant", "free-form")
    assert code == 130
    return text.splitlines()[-1], scans


@pytest.mark.parametrize("where", ["results", "pictures", "before"])
def test_the_rest_of_the_results_after_ctrl_c(where, tubes, tmp_path, run, monkeypatch):
    """Of one whose picture was being drawn the fit is there, and only its picture is made."""
    options, stop_in, method, stop_at = (), scan_results.Writer, "__call__", 2 * (where == "results")
    if where == "pictures":
        options, stop_in, method, stop_at = ("--pictures", "--drop-invalid", "--samples", 300), scan_results, "draw", 1
    how = (tubes, tmp_path, stop_at, monkeypatch, *options)
    line, scans = _stopped_among_results(run, *how, stop_in=stop_in, method=method)
    written, model, fits = (0 if where == "before" else 2), tmp_path / "m n.npz", tmp_path / "fi ts"
    more = " --samples 300 --drop-invalid --pictures" if options else ""
    rest = f"; to write the rest: lbsfit fit '{model}' SCAN... -o '{fits}'{more} --existing skip"
    assert line == f"stopped: {model} is complete, {written} of 4 results in {fits}{rest}"
    before = {path: path.read_bytes() for path in fits.glob("*.fit.npz")}
    if where != "before":
        summary = json.loads((fits / "summary.json").read_text())
        assert summary["not_done"] == ["t2", "t3"] and summary["stopped"]
        first = ["fit", "labels", "mesh", *["picture"] * bool(options)]
        assert {s["name"]: sorted(s["files"]) for s in summary["scans"]} == {"t0": first, "t1": ["fit", "labels", "mesh"]}
    code, text, err = run(*as_said(line, scans))
    assert (code, err) == (0, "") and ("kept existing fits of 2 of 4 scans" in text) == (written == 2)
    assert len(before) == written and all(path.read_bytes() == content for path, content in before.items())
    assert len(list(fits.iterdir())) == 4 * (3 + (where == "pictures")) + 1


def test_the_rest_of_the_results_where_those_of_an_earlier_run_are(tubes, tmp_path, run, monkeypatch):
    """--existing skip would take the model for another one."""
    (tmp_path / "fi ts").mkdir()
    run("fit", tubes / "tube.npz", *sorted(tubes.glob("t*.ply")), "-o", tmp_path / "fi ts", *QUICK)
    how = (run, tubes, tmp_path, 2, monkeypatch, "--existing", "replace")
    line, scans = _stopped_among_results(*how)
    end = "; to write only the rest, replacing files of an earlier run: "
    end += f"lbsfit fit '{tmp_path}/m n.npz' SCAN... -o '{tmp_path}/fi ts'"
    assert "is complete, 2 of 4 results in" in line and line.endswith(end + " --existing replace")
    code, text, err = run(*[word.replace("replace", "skip") for word in as_said(line, scans)])
    assert code == 2 and "t2.fit.npz, a fit without a model" in one_line(err)
    line, _ = _stopped_among_results(*how, letters=10**4)
    code, text, err = run(*shlex.split(line[line.index("lbsfit fit ") :])[1:])  # these alone, by name
    assert (code, err) == (0, "") and "2 of 2 scans fitted" in text


def test_the_rest_of_the_results_where_those_of_the_same_learning_are(tubes, tmp_path, run, monkeypatch):
    """They are what would be written: that of the scan that was stopped at counts, those of the others are kept."""
    scans = sorted(tubes.glob("t*.ply"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m n.npz", "--results", tmp_path / "fi ts")
    assert run(*arguments, "--variant", "free-form")[0] == 0
    how = (run, tubes, tmp_path, 2, monkeypatch, "--existing", "replace")
    line, _ = _stopped_among_results(*how, letters=10**4)
    assert "is complete, 3 of 4 results in" in line and line.endswith("--existing skip")
    assert json.loads((tmp_path / "fi ts" / "summary.json").read_text())["not_done"] == ["t3"]
    code, text, err = run(*shlex.split(line[line.index("lbsfit fit ") :])[1:])
    assert (code, err) == (0, "") and "kept existing fits of 4 of 4 scans" in text


@pytest.mark.parametrize("whole", [True, False])
def test_the_scan_that_was_stopped_at_has_its_notes(whole, tubes, tube_rig, tmp_path, monkeypatch):
    """Where its files were written; those of the next may be of an earlier run."""
    monkeypatch.setattr(learn, "is_result_of", lambda fitter, files: whole)
    files = outputs.plan([str(tubes / f"t{i}.ply") for i in (0, 1)], tmp_path, inputs=[], existing="replace")
    reading, entries = SimpleNamespace(scans=[SimpleNamespace(notes=("odd",))] * 2), {}
    results = [result_of(tube_rig, tube_rig.vertices, 400)] * 2
    learn._settle_the_rest(SimpleNamespace(results_=results), reading, files, entries)
    assert {name: entry["notes"] for name, entry in entries.items()} == ({"t0": ["odd"]} if whole else {})


def _interrupted():
    raise KeyboardInterrupt


def test_all_results_are_there_at_ctrl_c(tubes, tmp_path, run, monkeypatch):
    monkeypatch.setattr("lbsfit_np.cli.learn._say_statuses", lambda *_: _interrupted())
    line, _ = _stopped_among_results(run, tubes, tmp_path, 4, monkeypatch)
    assert line.endswith(f"is complete, 4 of 4 results in {tmp_path / 'fi ts'}")


_AS_IT_IS = {"samples": None, "subjects": None, "drop_invalid": False, "pictures": False}


@pytest.mark.parametrize(
    "there, how",
    [
        (("fit", "mesh", "labels"), "; to write the rest: "),  # of an earlier run that learned the same
        (("fit", "labels"), "; to write only the rest, replacing files of an earlier run: "),  # no fit without its mesh
        (("fit", "mesh"), "; to write only the rest, replacing files of an earlier run: "),
        (("mesh",), "; to write only the rest, replacing files of an earlier run: "),
        (("labels",), "; to write only the rest, replacing files of an earlier run: "),
        ((), "; to write the rest: "),
    ],
)
def test_what_is_there_of_scans_that_nobody_came_to(there, how, tube_model, tubes, tmp_path):
    files = outputs.plan([str(tubes / f"t{i}.ply") for i in (0, 1)], tmp_path, inputs=[], existing="replace")
    earlier = outputs.plan([str(tubes / "t0.ply")], tube_model[1], inputs=[], existing="replace")[0]
    for what in there:
        files[0].paths[what].write_bytes(earlier.paths[what].read_bytes())
    fitter = lbs.LBSFitter.load(tube_model[0])
    words = results_so_far(fitter, tube_model[0], files, {}, None, {"results": str(tmp_path), **_AS_IT_IS})
    existing = "replace" if "earlier run" in how else "skip"
    assert words.startswith(f", 0 of 2 results in {tmp_path}{how}lbsfit fit ") and words.endswith(f" --existing {existing}")


def test_the_rest_of_the_results_by_the_table_of_subjects(tubes, tmp_path, run, monkeypatch):
    """Learning's own results are kept, as their subjects'; a subject of whom nothing was learned is named."""
    (tmp_path / "who.csv").write_text("t0,a\nt1,b\nt2,a\nt3,b\n")
    line, scans = _stopped_among_results(run, tubes, tmp_path, 2, monkeypatch, "--subjects", tmp_path / "who.csv")
    assert f"; to write the rest: lbsfit fit '{tmp_path}/m n.npz'" in line
    assert line.endswith(f" --subjects {tmp_path / 'who.csv'} --existing skip")
    code, text, err = run(*as_said(line, scans))
    assert (code, err) == (0, "") and "kept existing fits of 2 of 4 scans" in text
    monkeypatch.setattr(stopped_learning, "_SHORT", 0)
    fitter, values = lbs.LBSFitter.load(tmp_path / "m n.npz"), {"results": "new", "samples": None, "subjects": "who.csv"}
    files = outputs.plan(scans, tmp_path / "new", inputs=[], existing="replace")
    values |= {"drop_invalid": False, "pictures": False}
    strangers = ", except scans of 'carl', 'dora', of whom nothing was learned"
    for existing, only, replacing in (("skip", "", ""), ("replace", "only ", ", replacing files of an earlier run")):
        words = results_so_far(fitter, "m.npz", files, {}, ["a", "carl", "dora", "b"], values)
        rest = f"; to write {only}the rest{replacing}{strangers}: lbsfit fit m.npz SCAN... -o new"
        assert rest in words and words.endswith(existing)
        make_folder(tmp_path / "new")
        files[0].mesh.write_text("of an earlier run")
    monkeypatch.setattr(stopped_learning, "_SHORT", 10**4)
    words = results_so_far(fitter, "m.npz", files, {}, ["a", "carl", "dora", "b"], values)
    assert f"lbsfit fit m.npz {shlex.join([scans[0], scans[3]])} -o new" in words
    files[0].mesh.unlink()
    entries = {files[3].name: scan_results.unfitted_entry(files[3], "empty")}  # which no command makes better
    words = results_so_far(fitter, "m.npz", files, entries, ["a", "carl", "dora", "b"], values)
    assert f"lbsfit fit m.npz {shlex.join([scans[0]])} -o new" in words and words.endswith("skip")


@pytest.mark.parametrize("same, existing", [(True, "skip"), (False, "replace")])
def test_earlier_fits_of_scans_that_failed_are_in_the_way_of_the_rest(same, existing, tube_model, tubes, tmp_path):
    """Where a command is for all scans: --existing skip would refuse those of others."""
    files = outputs.plan([str(tubes / f"t{i}.ply") for i in (0, 1)], tmp_path, inputs=[], existing="replace")
    earlier = outputs.plan([str(tubes / "t0.ply")], tube_model[1], inputs=[], existing="replace")[0]
    for what in ("fit", "mesh", "labels"):
        files[0].paths[what].write_bytes(earlier.paths[what].read_bytes())
    if not same:
        fit = lbs.FitResult.load(files[0].fit)
        replace(fit, model_digest="another").save(files[0].fit)
    entries = {"t0": scan_results.unfitted_entry(files[0], "empty")}
    words = results_so_far(lbs.LBSFitter.load(tube_model[0]), "m.npz", files, entries, None, {"results": "new", **_AS_IT_IS})
    assert words.endswith(f" {tubes / 't1.ply'} -o new --existing {existing}") or f"SCAN... -o new --existing {existing}" in words


@pytest.mark.parametrize("letters, named", [(200, True), (201, False)])
def test_the_rest_is_named_where_that_is_short(letters, named, tube_model, tmp_path):
    fitter, values = lbs.LBSFitter.load(tube_model[0]), {"results": "new", **_AS_IT_IS}
    files = [outputs.ScanFiles("s" * letters, "s", *(tmp_path / what for what in ("fit", "mesh", "labels")))]
    words = results_so_far(fitter, "m.npz", files, {}, None, values)
    assert ("s" * letters in words, "SCAN..." in words) == (named, not named)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_the_summary_is_written_whatever_becomes_of_the_rest(error, tubes, tmp_path, run, monkeypatch):
    def fails(*given):
        raise error

    monkeypatch.setattr(learn, "_settle_the_rest", fails)
    _stopped_among_results(run, tubes, tmp_path, 2, monkeypatch)
    assert json.loads((tmp_path / "fi ts" / "summary.json").read_text())["not_done"] == ["t2", "t3"]


def test_what_was_not_learned_from_keeps_its_fit_of_an_earlier_run(tubes, tube_rig, tmp_path, run):
    results, earlier = tmp_path / "fits", ("broken.mesh.ply", "broken.labels.ply", "t9.fit.npz")
    results.mkdir()
    (tmp_path / "broken.ply").write_text("ply")
    result_of(tube_rig, tube_rig.vertices, 400).save(results / "broken.fit.npz")
    for name in earlier:
        (results / name).write_text("of an earlier run")
    arguments = ("learn", tubes / "tube.npz", tubes / "t0.ply", tmp_path / "broken.ply", "-o", tmp_path / "m.npz")
    more = ("--results", results, "--existing", "replace", "--variant", "free-form")
    code, text, _ = run(*arguments, *more)
    assert code == 1 and "fitted 1 of 2 scans, each by itself; wrote " in text
    now = {"summary.json", *(f"t0.{kind}" for kind in ("fit.npz", "mesh.ply", "labels.ply"))}
    assert {path.name for path in results.iterdir()} == {*now, *earlier, "broken.fit.npz"}
    assert {(results / name).read_text() for name in earlier} == {"of an earlier run"}
    assert "; an earlier fit is still there: broken.fit.npz\n" in text and "1 of 2 results in" in text
    entry, _ = json.loads((results / "summary.json").read_text())["scans"]
    assert (entry["name"], entry["status"], entry["earlier"]) == ("broken", "failed", "broken.fit.npz") and "files" not in entry


def test_a_result_that_is_not_written_leaves_that_of_an_earlier_run(tubes, tmp_path, run, monkeypatch):
    """One that is not finite, and one whose files cannot be written."""
    fit, write = lbs.LBSFitter.fit, scan_results.Writer.__call__

    def odd(self, *given, **options):
        fit(self, *given, **options)
        self.results_[0] = replace(self.results_[0], vertices=np.full_like(self.results_[0].vertices, np.nan))

    def full(self, index, scan, result):
        if index == 1:
            raise FileError("t1.fit.npz", "a full disk", "room")
        return write(self, index, scan, result)

    monkeypatch.setattr(lbs.LBSFitter, "fit", odd)
    monkeypatch.setattr(scan_results.Writer, "__call__", full)
    results = tmp_path / "fits"
    results.mkdir()
    for name in ("t0", "t1"):
        for kind in ("fit.npz", "mesh.ply", "labels.ply"):
            (results / f"{name}.{kind}").write_text("of an earlier run")
    arguments = ("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz", "--results", results)
    assert run(*arguments, "--existing", "replace", "--variant", "free-form")[0] == 1
    assert {path.name.split(".")[0] for path in results.iterdir()} == {"t0", "t1", "t2", "t3", "summary"}
    assert {path.read_text() for path in results.glob("t[01].*")} == {"of an earlier run"}
    statuses = {e["name"]: e["status"] for e in json.loads((results / "summary.json").read_text())["scans"]}
    assert statuses["t0"] == statuses["t1"] == "failed"


def test_a_full_disk_leaves_no_half_model(tubes, tmp_path, run, monkeypatch):
    def full(entry, array, **_):
        entry.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    scans = sorted(tubes.glob("*.ply"))
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    kept, failed = err.splitlines(keepends=True)
    assert kept.startswith(f"lbsfit: warning: finished steps cannot be kept in {tmp_path / 'm.npz.unfinished'} (an error while ")
    assert code == 2 and "No space left" in one_line(failed) and not list(tmp_path.iterdir())


def test_a_model_that_cannot_be_written_leaves_its_steps_and_says_so(tubes, tmp_path, run, monkeypatch):
    def full(self, path):
        raise FileError(str(path), "a full disk", "room for it", "Make some.")

    monkeypatch.setattr(lbs.LBSFitter, "save", full)
    scans, folder = sorted(tubes.glob("*.ply")), tmp_path / "m.npz.unfinished"
    code, text, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 2 and "a full disk" in one_line(err) and steps_in(folder)
    end = f"fix it, then run the same command to continue from the steps kept in {folder}"
    assert text.splitlines()[-1] == f"an error ended the run before the model was written; {end}"


def test_a_result_that_cannot_be_written_does_not_stop_the_others(tubes, tmp_path, run, monkeypatch):
    import lbsfit_np.io.write

    write = lbsfit_np.io.write.write_points_ply

    def full(path, points, **options):
        if len(points) == 400 and "t1" in Path(path).name:
            raise OSError(28, "No space left on device")
        write(path, points, **options)

    monkeypatch.setattr(lbsfit_np.io.write, "write_points_ply", full)
    scans = sorted(tubes.glob("*.ply"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    code, text, err = run(*arguments, "--variant", "free-form")
    assert code == 1 and "t1: failed: " in err and "3 of 4 results" in text
    assert not list((tmp_path / "fits").glob("*t1*")) and len(list((tmp_path / "fits").iterdir())) == 10
