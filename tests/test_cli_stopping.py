"""Ctrl-C while ``lbsfit fit`` runs: what is finished is kept."""

import json
import os
import shutil
import signal
import time

import pytest
from cli_runs import QUICK, started, stopped

import lbsfit_np as lbs
import lbsfit_np.io.write
from lbsfit_np.cli import outputs, scan_results
from lbsfit_np.cli.stopped_fits import named, settled

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
@pytest.mark.parametrize("jobs, sent, code", [(1, signal.SIGINT, 130), (2, signal.SIGINT, 130), (1, signal.SIGTERM, 143)])
def test_ctrl_c_keeps_what_is_finished(jobs, sent, code, fitted, made, cli_cache, tmp_path, run):
    scans = [tmp_path / f"scan{i:02}.ply" for i in range(40)]
    for path in scans:
        path.write_bytes((made / "one.ply").read_bytes())
    out = tmp_path / "out"
    process = started(
        *("fit", made / "tube.npz", *scans, "-o", out, "--jobs", jobs, *QUICK),
        cache=cli_cache,
        hurried=True,
    )
    deadline = time.monotonic() + 120
    while not list(out.glob("*.fit.npz")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    text, err = stopped(process, sent)
    assert process.returncode == code, err
    assert err == "" and "--existing skip to continue" in text
    summary = json.loads((out / "summary.json").read_text())
    finished = {scan["name"] for scan in summary["scans"]}
    assert summary["stopped"] and 1 <= len(finished) < len(scans)
    assert {p.name.split(".")[0] for p in out.iterdir()} == finished | {"summary"}  # nothing half done, no temporary file
    assert len(summary["not_done"]) == len(scans) - len(finished)
    for name in finished:
        assert lbs.FitResult.load(out / f"{name}.fit.npz").status == "ok"

    code, text, _ = run("fit", made / "tube.npz", *scans[: len(finished) + 1], "-o", out, "--existing", "skip", *QUICK)
    assert code == 0 and "kept existing fits of " in text


def test_ctrl_c_before_the_first_fit_leaves_nothing(made, tmp_path, run, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "pretrain", interrupted)
    code, text, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert (code, err) == (130, "") and "before any scan was fitted" in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("at", [0, 1])
@pytest.mark.parametrize("what", ["write_mesh_ply", "write_points_ply"])
def test_ctrl_c_while_a_fit_is_written_leaves_nothing_of_it(what, at, made, tmp_path, run, monkeypatch):
    write, calls = getattr(lbsfit_np.io.write, what), []

    def interrupted(path, *given, **more):
        calls.append(path)
        if len(calls) > at:
            path.write_bytes(b"half")
            raise KeyboardInterrupt
        return write(path, *given, **more)

    command = ("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", "-o", tmp_path / "out", *QUICK)
    with monkeypatch.context() as patch:
        patch.setattr(lbsfit_np.io.write, what, interrupted)
        code, text, err = run(*command)
    assert (code, err) == (130, "")
    there = {p.name for p in (tmp_path / "out").iterdir()} if (tmp_path / "out").exists() else set()
    assert there - {"summary.json"} == {f"one.{kind}" for kind in ("fit.npz", "labels.ply", "mesh.ply") if at}
    code, text, _ = run(*command, *("--existing", "skip") * bool(there))
    assert code == 0 and "2 of 2 scans fitted" in text and len(list((tmp_path / "out").iterdir())) == 7


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("at", ["fit.npz", "mesh.ply", "labels.ply"])
def test_a_fit_that_is_being_written_at_ctrl_c_is_finished_and_counted(at, number, code, made, tmp_path, run, monkeypatch):
    """The signal comes while one of its files gets its name."""
    command, out, replace = ("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", *QUICK), tmp_path / "out", os.replace

    def signalled(one, other):
        replace(one, other)
        if str(other).endswith(f"one.{at}"):
            signal.raise_signal(number)

    with monkeypatch.context() as patch:
        patch.setattr(lbsfit_np.io.write.os, "replace", signalled)
        code_, text, err = run(*command, "-o", out)
    assert (code_, err) == (code, "") and "1 of 2 scans is fitted and kept" in text
    assert {p.name for p in out.iterdir()} == {"summary.json", "one.fit.npz", "one.mesh.ply", "one.labels.ply"}
    summary = json.loads((out / "summary.json").read_text())
    assert [scan["name"] for scan in summary["scans"]] == ["one"] and summary["not_done"] == ["two"]
    code, text, _ = run(*command, "-o", out, "--existing", "skip")
    assert code == 0 and "kept existing fits of 1 of 2 scans" in text


def test_fits_of_an_earlier_run_are_not_counted_at_ctrl_c(made, fitted, tmp_path, run, monkeypatch):
    """Those that were written since are, noted or not."""
    out, write = tmp_path / "out", scan_results.Writer.__call__
    shutil.copytree(fitted[0], out)

    def interrupted(self, index, scan, result):
        write(self, index, scan, result)
        raise KeyboardInterrupt

    monkeypatch.setattr(scan_results.Writer, "__call__", interrupted)
    command = ("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", *QUICK, "-o", out, "--existing", "replace")
    code, text, _ = run(*command)
    assert code == 130 and "1 of 2 scans is fitted and kept" in text and "1 of the others has a fit from an earlier run" in text
    assert [scan["name"] for scan in json.loads((out / "summary.json").read_text())["scans"]] == ["one"]


@pytest.mark.parametrize("at", ["fit.npz", "mesh.ply"])
def test_killed_among_the_files_of_a_fit_nothing_is_taken_for_one(at, made, fitted, tmp_path, run, monkeypatch):
    """An earlier run's mesh beside a new fit, say."""
    out, replace = tmp_path / "out", os.replace
    shutil.copytree(fitted[0], out)

    def killed(one, other):
        replace(one, other)
        if str(other).endswith(f"one.{at}"):
            raise KeyboardInterrupt  # nothing is done after it, as if the process were gone

    command = ("fit", made / "tube.npz", made / "one.ply", "-o", out, *QUICK)
    with monkeypatch.context() as patch:
        patch.setattr(lbsfit_np.io.write.os, "replace", killed)
        assert run(*command, "--existing", "replace")[0] == 130
    assert (out / "one.fit.npz").exists() and not (out / "one.labels.ply").exists()
    code, text, _ = run(*command, "--existing", "skip")
    assert code == 0 and "already" not in text and "1 of 1 scan fitted" in text


@pytest.mark.parametrize("links", [False, True])
@pytest.mark.parametrize("new", [(), ("fit",), ("fit", "mesh"), ("fit", "mesh", "labels")])
def test_a_fit_counts_where_all_of_its_files_are_new(new, links, made, fitted, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(fitted[0], out)
    for path in list(out.glob("one.*")) if links else ():
        path.rename(out / f"{path.name}.kept")
        path.symlink_to(f"{path.name}.kept")
    files = outputs.plan([str(made / "one.ply")], out, inputs=[], existing="replace")
    before = named(files)
    assert set(before) == {files[0].fit, files[0].mesh, files[0].labels} and settled(files, before) == {}
    for kind in new:
        path = files[0].paths[kind]
        path.with_suffix(".new").write_bytes(path.read_bytes())
        os.replace(path.with_suffix(".new"), os.path.realpath(path))
    assert list(settled(files, before)) == ["one"] * (len(new) == 3)
    if len(new) == 3:
        files[0].fit.write_bytes(b"cut short")
        assert settled(files, before) == {}


@pytest.mark.parametrize("pictures", [True, False])
def test_a_picture_of_an_earlier_fit_is_not_listed_at_ctrl_c(pictures, made, tmp_path, run, monkeypatch):
    """It goes with its fit, whether a new one is to be drawn or not."""
    out, replace = tmp_path / "out", os.replace
    command = ("fit", made / "tube.npz", made / "one.ply", "-o", out, *QUICK)
    assert run(*command, "--pictures")[0] == 0

    def signalled(one, other):
        replace(one, other)
        if str(other).endswith("one.labels.ply"):
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(lbsfit_np.io.write.os, "replace", signalled)
        assert run(*command, "--existing", "replace", *["--pictures"] * pictures)[0] == 130
    (entry,) = json.loads((out / "summary.json").read_text())["scans"]
    assert set(entry["files"]) == {"fit", "mesh", "labels"} and not (out / "one.png").exists()


@pytest.mark.skipif(os.name != "posix", reason="SIGTERM is a POSIX signal")
@pytest.mark.parametrize(
    ("command", "runs"),
    [
        (("starts", "hand"), "lbsfit_np.bench.starts.starts_bench"),
        (("roundtrip", "hand"), "lbsfit_np.bench.roundtrip.roundtrip"),
        (("hand", "--data", "DATA"), "lbsfit_np.bench.run.run_bench"),
    ],
)
def test_sigterm_stops_benchmarks_as_ctrl_c_does(command, runs, tmp_path, run, monkeypatch, request):
    if "DATA" in command:
        command = [str(request.getfixturevalue("shared_rigs")) if word == "DATA" else word for word in command]
    monkeypatch.setattr(runs, lambda *_, **__: os.kill(os.getpid(), signal.SIGTERM))
    before = signal.signal(signal.SIGTERM, lambda *_: pytest.fail("SIGTERM went past the run"))
    try:
        code, _, err = run("bench", *command, "-o", tmp_path / "out")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert code == 143 and err == "lbsfit: stopped\n"


def test_a_program_whose_output_nobody_reads_any_more_ends_as_shells_have_it(tmp_path):
    """Not as one that has done something."""
    process = started("rig", "list", cache=tmp_path)
    process.stdout.close()
    assert process.wait(timeout=60) == 141 and process.stderr.read() == ""
