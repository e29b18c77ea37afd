"""Ctrl-C while ``lbsfit fit`` runs: what is finished is kept."""

import json
import os
import signal
import time

import pytest
from cli_runs import QUICK, started, stopped

import lbsfit_np as lbs
import lbsfit_np.io.write

pytestmark = pytest.mark.usefixtures("own_cache")


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
    )
    deadline = time.monotonic() + 120
    # More than are written at a time: of one that is stopped half way all files are removed.
    while len(list(out.glob("*.fit.npz"))) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    text, err = stopped(process, sent)
    assert process.returncode == code, err
    assert err == "" and "--existing skip does the rest" in text
    summary = json.loads((out / "summary.json").read_text())
    finished = {scan["name"] for scan in summary["scans"]}
    assert summary["stopped"] and 1 <= len(finished) < len(scans)
    assert {p.name.split(".")[0] for p in out.iterdir()} == finished | {"summary"}  # nothing half done, no temporary file
    assert len(summary["not_done"]) == len(scans) - len(finished)
    for name in finished:
        assert lbs.FitResult.load(out / f"{name}.fit.npz").status == "ok"

    code, text, _ = run("fit", made / "tube.npz", *scans[: len(finished) + 1], "-o", out, "--existing", "skip", *QUICK)
    assert code == 0 and "fitted already and kept" in text


def test_ctrl_c_before_the_first_fit_leaves_nothing(made, tmp_path, run, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "pretrain", interrupted)
    code, text, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert (code, err) == (130, "") and "before a scan was fitted" in text
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
