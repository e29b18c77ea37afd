"""The command line as users meet it: files written, exit codes, and one clear line for everything that is wrong."""

import inspect
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.cli import demo, fit, main
from lbsfit_np.cli.progress import Progress
from lbsfit_np.io.write import write_mesh_ply, write_points_ply

PACKAGE_PARENT = str(Path(lbs.__file__).resolve().parents[1])
QUICK = ("--training-scans", "40")  # enough for four parts


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _own_cache(cache, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(cache))


@pytest.fixture(scope="module")
def made(tube_rig, tmp_path_factory):
    """A folder with tube.npz and the scans one.ply, two.xyz and three.npy."""
    folder = tmp_path_factory.mktemp("made")
    tube_rig.save(folder / "tube.npz")
    one, two, three = (s.points for s in lbs.synthesize(tube_rig, 3, random_state=5, n_points=400))
    write_points_ply(folder / "one.ply", one)
    np.savetxt(folder / "two.xyz", two)
    np.save(folder / "three.npy", three)
    return folder


@pytest.fixture
def run(capsys):
    """Run the program in this process; returns its exit code, output and errors."""

    def run(*arguments):
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return run


@pytest.fixture(scope="module")
def fitted(made, cache, tmp_path_factory):
    """A folder with the fits of two scans, made by a program of its own."""
    out = tmp_path_factory.mktemp("fitted") / "fits"
    done = program("fit", made / "tube.npz", made / "one.ply", made / "two.xyz", "-o", out, *QUICK, cache=cache)
    assert (done.returncode, done.stderr) == (0, "")
    return out, done.stdout


def program(*arguments, cache, start=subprocess.run, **options):
    environment = os.environ | {"LBSFIT_CACHE": str(cache), "PYTHONPATH": PACKAGE_PARENT}
    command = [sys.executable, "-m", "lbsfit_np", *map(str, arguments)]
    if start is subprocess.run:
        options |= {"capture_output": True, "timeout": 300}
    return start(command, env=environment, text=True, **options)


def one_line(err):
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("lbsfit: error: "), err
    return lines[0]


# ---- lbsfit fit ----


def test_fit_writes_every_file(fitted, made, tube_rig):
    out, text = fitted
    assert sorted(p.name for p in out.iterdir()) == [
        "one.fit.npz", "one.labels.ply", "one.mesh.ply", "summary.json", "two.fit.npz", "two.labels.ply", "two.mesh.ply",
    ]  # fmt: skip
    result = lbs.FitResult.load(out / "one.fit.npz")
    scan = lbs.load_scan(made / "one.ply")
    assert result.rig_digest == tube_rig.digest and len(result.labels) == len(scan) == 400
    mesh = lbs.load_scan(out / "one.mesh.ply")
    np.testing.assert_array_equal(mesh.points, result.vertices)
    np.testing.assert_array_equal(mesh.labels, tube_rig.vertex_labels)
    labelled = lbs.load_scan(out / "one.labels.ply")
    np.testing.assert_array_equal(labelled.points, scan.points)
    np.testing.assert_array_equal(labelled.labels, result.labels)
    header = (out / "one.labels.ply").read_bytes().split(b"end_header")[0].decode()
    assert "float confidence" in header and "uchar red" in header and "part 2 long" in header
    assert "[1/2] one: fitted" in text and "[2/2] two: fitted" in text and "2 of 2 scans fitted" in text
    assert "\r" not in text  # no bar where there is no terminal


def test_the_summary_tells_all(fitted, made, tube_rig):
    out, _ = fitted
    summary = json.loads((out / "summary.json").read_text())
    assert summary["counts"] == {"ok": 2, "skipped": 0, "failed": 0} and summary["not_done"] == []
    assert summary["rig"]["digest"] == tube_rig.digest and summary["rig"]["parts"] == list(tube_rig.parts)
    assert summary["seed"] == 0 and summary["settings"]["training_scans"] == 40
    assert summary["versions"]["lbsfit_np"] == lbs.__version__ and summary["versions"]["numpy"] == np.__version__
    for name, scan in zip(("one", "two"), summary["scans"]):
        result = lbs.FitResult.load(out / scan["files"]["fit"])
        assert (scan["name"], scan["status"], scan["message"]) == (name, "ok", result.message)
        assert scan["terms"] == result.terms and scan["evaluations"] == result.evaluations
        assert set(scan["files"].values()) <= {p.name for p in out.iterdir()}
    assert summary["scans"][0]["input"] == str(made / "one.ply")


def test_jobs_do_not_change_the_results(fitted, made, tmp_path, run):
    scans = [made / "one.ply", made / "two.xyz"]
    code, _, err = run("fit", made / "tube.npz", *scans, "-o", tmp_path, "--jobs", 2, *QUICK)
    assert (code, err) == (0, "")
    for name in ("one", "two"):
        ours, theirs = (lbs.FitResult.load(folder / f"{name}.fit.npz") for folder in (tmp_path, fitted[0]))
        for field in ("pose", "translation", "scale", "offsets", "vertices", "joints", "labels", "confidence", "terms"):
            np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
        for kind in ("mesh", "labels"):
            assert (tmp_path / f"{name}.{kind}.ply").read_bytes() == (fitted[0] / f"{name}.{kind}.ply").read_bytes()


def test_failed_scans_are_named_and_the_others_written(made, tmp_path, run):
    (tmp_path / "empty.ply").write_bytes(b"")
    code, text, err = run("fit", made / "tube.npz", tmp_path / "empty.ply", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 1
    assert "empty: failed: " in err and "an empty file (0 bytes)" in err and "1 of 2 scans fitted, 1 failed" in text
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "one.fit.npz",
        "one.labels.ply",
        "one.mesh.ply",
        "summary.json",
    ]
    scans = json.loads((tmp_path / "out" / "summary.json").read_text())["scans"]
    assert [s["status"] for s in scans] == ["failed", "ok"]
    assert "an empty file (0 bytes)" in scans[0]["message"] and "details" not in scans[0]


def _truncated_ply(path):
    write_points_ply(path, np.random.default_rng(0).normal(size=(50, 3)))
    path.write_bytes(path.read_bytes()[:-100])


def _points(points):
    return lambda path: np.savetxt(path, points)


_WITH_NAN = [[0, 0, 0], [1, 2, 3], [np.nan, 0, 0], [3, 1, 2], [np.inf, 0, 1]]

BAD_SCANS = {
    "truncated.ply": (_truncated_ply, ["truncated.ply", "cut short|ends|truncated|fewer"]),
    "unknown.foo": (lambda path: path.write_text("1 2 3\n"), ["'.foo'", ".ply .obj"]),
    "empty.xyz": (lambda path: path.write_text(""), ["empty"]),
    "few.xyz": (_points(np.eye(3)), ["3 points", "at least 4 points"]),
    "nan.xyz": (_points(_WITH_NAN), ["2 of 5 points", "index 2", "--drop-invalid"]),
    "equal.xyz": (_points(np.ones((30, 3))), ["30 points that are all equal"]),
    "flat.npy": (lambda path: np.save(path, np.ones((30, 2))), ["(30, 2)", "(n, 3)"]),
    "words.xyz": (lambda path: path.write_text("this is no scan\n"), ["words.xyz"]),
    "not.glb": (lambda path: path.write_bytes(b"glTF" + struct.pack("<II", 2, 900)), ["not.glb"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_SCANS)
def test_bad_scans(name, made, tmp_path, run):
    import re

    make, words = BAD_SCANS[name]
    make(tmp_path / name)
    code, _, err = run("fit", made / "tube.npz", tmp_path / name, "-o", tmp_path / "out", *QUICK)
    assert code == 1
    assert len(err.splitlines()) == 1 and f"{Path(name).stem}: failed: " in err and "expected" in err, err
    for word in words:
        assert word in err or re.search(word, err), (word, err)


def test_drop_invalid_keeps_the_good_points(made, tmp_path, run):
    points = lbs.load_scan(made / "one.ply").points.copy()
    points[[3, 7]] = np.nan
    np.save(tmp_path / "holes.npy", points)
    code, _, _ = run("fit", made / "tube.npz", tmp_path / "holes.npy", "-o", tmp_path / "out", "--drop-invalid", *QUICK)
    assert code == 0 and len(lbs.FitResult.load(tmp_path / "out" / "holes.fit.npz").labels) == 398
    assert "2 of 400" in json.loads((tmp_path / "out" / "summary.json").read_text())["scans"][0]["notes"][0]


def test_samples_of_a_mesh(made, tube_rig, tmp_path, run):
    write_mesh_ply(tmp_path / "mesh.ply", tube_rig.vertices, tube_rig.faces)
    code, _, _ = run("fit", made / "tube.npz", tmp_path / "mesh.ply", "-o", tmp_path / "out", "--samples", 300, *QUICK)
    assert code == 0 and len(lbs.FitResult.load(tmp_path / "out" / "mesh.fit.npz").labels) == 300


# ---- rigs that cannot be used ----


def _changed(**changes):
    def make(path, made):
        with np.load(made / "tube.npz") as z:
            arrays = {key: z[key].copy() for key in z.files}
        for key, change in changes.items():
            arrays[key] = change(arrays[key])
        np.savez(path, **arrays)

    return make


def _set(index, value):
    def change(array):
        array[index] = value
        return array

    return change


class _Evil:
    """Unpickled by a careless reader, it makes a folder."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


BAD_RIGS = {
    "missing.npz": (lambda path, made: None, ["no such file"]),
    "rig.fbx": (lambda path, made: path.write_bytes(b"x"), ["'.fbx'", ".glb"]),
    "cut.npz": (lambda path, made: path.write_bytes((made / "tube.npz").read_bytes()[:900]), ["cut.npz"]),
    "cut.glb": (lambda path, made: path.write_bytes(b"glTF" + struct.pack("<II", 2, 900)), ["cut.glb"]),
    "evil.pkl": (
        lambda path, made: path.write_bytes(pickle.dumps({"v_template": _Evil(path.parent / "ran")})),
        ["evil.pkl", "mkdir"],
    ),
    "negative.npz": (_changed(weights_data=_set(0, -0.5)), ["weights", "negative"]),
    "cycle.npz": (_changed(parents=lambda p: np.array([-1, 2, 1, 1])), ["cycle"]),
    "roots.npz": (_changed(parents=lambda p: np.array([-1, -1, 1, 1])), ["root", "card"]),
    "parents.npz": (_changed(parents=lambda p: np.array([-1, 0, 1, 9])), ["parents", "9"]),
    "faces.npz": (_changed(faces=_set((0, 0), 9999)), ["faces", "9999"]),
    "reversed.npz": (_changed(lower=_set((1, 0), 2.5)), ["limits", "elbow"]),
    "sums.npz": (_changed(weights_data=lambda w: w * 0.7), ["weights", "0.7"]),
}


@pytest.mark.parametrize("name", BAD_RIGS)
def test_bad_rigs(name, made, tmp_path, run):
    make, words = BAD_RIGS[name]
    make(tmp_path / name, made)
    for arguments in (
        ("fit", tmp_path / name, made / "one.ply", "-o", tmp_path / "out", *QUICK),
        ("rig", "show", tmp_path / name),
    ):
        code, _, err = run(*arguments)
        line = one_line(err)
        assert code == 2 and "expected" in line and all(word in line for word in words), line
    assert not (tmp_path / "out").exists() and not (tmp_path / "ran").exists()


def test_a_card_that_names_no_joint(made, tmp_path, run):
    (tmp_path / "tube.toml").write_text('[lock]\njoints = ["elbo"]\n')
    code, _, err = run(
        "fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--card", tmp_path / "tube.toml", *QUICK
    )
    assert code == 2 and "'elbo'" in one_line(err) and "Did you mean 'elbow'" in err


# ---- names, inputs, and what is there already ----


def test_missing_scans_are_found_before_any_work(made, tmp_path, run):
    code, _, err = run(
        "fit", made / "tube.npz", made / "one.ply", tmp_path / "a.ply", tmp_path / "b.ply", "-o", tmp_path / "out", *QUICK
    )
    assert code == 2 and "2 files that do not exist" in one_line(err) and "a.ply" in err and "b.ply" in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("other", ["one.xyz", "ONE.xyz", "sub/one.ply", "one.ply"])
def test_clashing_names_are_found_before_any_work(other, made, tmp_path, run):
    (tmp_path / "sub").mkdir()
    for name in ("one.ply", other):
        (tmp_path / name).write_text("0 0 0\n")
    code, _, err = run("fit", made / "tube.npz", tmp_path / "one.ply", tmp_path / other, "-o", tmp_path / "out", *QUICK)
    assert code == 2 and "SCAN: got" in one_line(err) and ("twice" if other == "one.ply" else "both be called") in err
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
    assert code == 0 and "1 of 2 scans are fitted already" in text and "[1/1] two: fitted" in text
    assert (tmp_path / "one.fit.npz").stat().st_mtime_ns == old[tmp_path / "one.fit.npz"]
    assert (tmp_path / "two.labels.ply").is_file()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [s["status"] for s in summary["scans"]] == ["skipped", "ok"]
    assert summary["scans"][0]["terms"] == lbs.FitResult.load(tmp_path / "one.fit.npz").terms

    (tmp_path / "one.fit.npz").write_bytes(b"broken")
    code, text, _ = run("fit", made / "tube.npz", scans[0], "-o", tmp_path, "--existing", "skip", *QUICK)
    assert code == 0 and "fitted again" in text and lbs.FitResult.load(tmp_path / "one.fit.npz").status == "ok"

    code, _, _ = run("fit", made / "tube.npz", scans[0], "-o", tmp_path, "--existing", "replace", "--weights", "paper", *QUICK)
    assert code == 0 and (tmp_path / "one.mesh.ply").read_bytes() != (fitted[0] / "one.mesh.ply").read_bytes()


def test_skip_does_not_take_fits_of_another_rig(fitted, made, tmp_path, run):
    for path in fitted[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, "--existing", "skip", *QUICK)
    code, _, err = run(*arguments, "--parts", "arm and fingers")
    assert code == 2 and "a fit of another rig" in one_line(err)


def test_files_of_a_scan_appear_together_or_not_at_all(made, tmp_path, run, monkeypatch):
    import lbsfit_np.io.write

    def full(path, *_, **__):
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(lbsfit_np.io.write, "write_points_ply", full)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path, *QUICK)
    assert code == 1 and "one: failed: " in err and "No space left" in err
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
@pytest.mark.parametrize("jobs, sent, code", [(1, signal.SIGINT, 130), (2, signal.SIGINT, 130), (1, signal.SIGTERM, 143)])
def test_ctrl_c_keeps_what_is_finished(jobs, sent, code, fitted, made, cache, tmp_path, run):
    scans = [tmp_path / f"scan{i:02}.ply" for i in range(40)]
    for path in scans:
        path.write_bytes((made / "one.ply").read_bytes())
    out = tmp_path / "out"
    process = program(
        *("fit", made / "tube.npz", *scans, "-o", out, "--jobs", jobs, *QUICK),
        cache=cache,
        start=subprocess.Popen,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # background jobs of a shell ignore it
    )
    deadline = time.monotonic() + 120
    while not list(out.glob("*.fit.npz")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, sent) if sent == signal.SIGINT else process.send_signal(sent)  # a terminal sends it to the group
    text, err = process.communicate(timeout=120)
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
    assert not list((tmp_path / "out").iterdir())


# ---- options ----


def test_configuration_files(made, tmp_path, run):
    config = tmp_path / "fit.toml"
    config.write_text(
        'output = "here"\nseed = 4\ntraining-scans = 40\nmax_points = 300\njoints = "fixed"\ntraining = { noise = 0.01 }\n'
    )
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "--config", config, "--joints", "follow")
    assert (code, err) == (0, "")
    settings = json.loads((tmp_path / "here" / "summary.json").read_text())["settings"]  # relative to the file
    assert (settings["seed"], settings["max_points"], settings["joints"]) == (4, 300, "follow")
    assert settings["training"] == {"noise": 0.01} and settings["scale"] == "estimate"


@pytest.mark.parametrize(
    "text, words",
    [
        ("sede = 3", ["'sede'", "one of output, card", "Did you mean 'seed'"]),
        ('seed = "3"', ["seed", "a whole number"]),
        ("jobs = 0", ["jobs", "at least 1"]),
        ("drop-invalid = 1", ["drop-invalid", "true or false"]),
        ('weights = "papre"', ["weights", "'default' or 'paper'"]),
        ("card = 3", ["card", "text in quotes"]),
        ("training = 3", ["training", "a table of numbers"]),
        ("max-points = 9\nmax_points = 9", ["'max-points' twice"]),
        ("seed = ", ["no", "TOML"]),
        ("seed = " + "1" * 5000, ["that is not TOML", "digits"]),
        ("seed = 0x" + "f" * 5000, ["seed", "thousand digits", "a whole number"]),
        ("seed = 1" + "0" * 400, ["seed = 1000", "…", "a whole number"]),
        ("jobs = 100000000000000000000", ["jobs", "at most 9223372036854775807"]),
        ("training = { turn = 1" + "0" * 400 + " }", ["training", "a table of numbers"]),
        ('output = ""', ["output", "text in quotes"]),
    ],
)
def test_bad_configuration_files(text, words, made, tmp_path, run):
    config = tmp_path / "fit.toml"
    config.write_text(text)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--config", config)
    assert code == 2 and "fit.toml: got" in one_line(err) and all(word in err for word in words), err


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((), ["COMMAND"]),
        (("fti",), ["'fti'", "fit"]),
        (("fit", "tube.npz"), ["SCAN"]),
        (("fit", "tube.npz", "one.ply"), ["-o/--output", "Add -o OUT"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--jobs", "0"), ["--jobs", "'0'", "at least 1"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--seed", "-1"), ["--seed", "at least 0"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--samples", "many"), ["--samples", "'many'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--scale", "free"), ["--scale", "'estimate', 'fixed'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "turn"), ["--training", "NAME=NUMBER"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "trun=1"), ["trun", "turn"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--config", "none.toml"), ["none.toml", "no such file"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--segmenter", "none.npz"), ["none.npz", "no such file"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--parts", "toes"), ["'toes'", "arm and fingers"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--shape", "tall"), ["shape", "'tall'"]),
        (("fit", "tube.npz", "one.ply", "-o", "one.ply"), ["one.ply", "a folder to write to"]),
        (("fit", "tube.npz", ".", "-o", "out"), ["a folder", "Name the files in it"]),
        (("fit", "tube.npz", "one.ply", "-o", ""), ["-o/--output", "an empty text", "OUT (folder to write to"]),
        (("demo", "-o", ""), ["-o/--output", "an empty text"]),
        (("rig", "card", "tube.npz", "-o", ""), ["-o/--output", "an empty text"]),
        (("bench", "roundtrip", "-o", ""), ["-o/--output", "an empty text"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--card", ""), ["--card", "an empty text"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--samples", "9" * 30), ["--samples", "at most 9223372036854775807"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "turn=1" + "0" * 400), ["--training", "NAME=NUMBER"]),
        (("fit", "tube.npz", "one.ply", "-o", "o" * 300), ["ooo", "cannot be made", "too long"]),
        (("fit", "tube.npz", "s" * 300 + ".ply", "-o", "out"), ["SCAN", "does not exist"]),
        (("fit", "r" * 300 + ".npz", "one.ply", "-o", "out"), ["rrr", "no such file"]),
        (("rig", "show", "r" * 300 + ".npz"), ["rrr", "no such file"]),
        (("rig", "card", "tube.npz", "-o", "c" * 300), ["ccc", "too long"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--see", "3"), ["--see"]),
        (("rig", "card", "tube.npz"), ["-o/--output"]),
        (("demo",), ["-o/--output"]),
    ],
)
def test_usage_errors(arguments, words, made, run, monkeypatch):
    monkeypatch.chdir(made)
    code, _, err = run(*arguments)
    line = one_line(err)
    assert code == 2 and all(word in line for word in words), line
    assert not (made / "out").exists() or not list((made / "out").iterdir())


def test_names_of_results_that_are_too_long_are_found_before_any_work(made, tmp_path, run):
    scan = tmp_path / ("s" * 246 + ".ply")  # 250 bytes: the scan can be read, but its .labels.ply could not be written
    scan.write_bytes((made / "one.ply").read_bytes())
    code, _, err = run("fit", made / "tube.npz", scan, "-o", tmp_path / "out", *QUICK)
    assert code == 2 and "too long for a file" in one_line(err) and "Rename the scan" in err
    assert not (tmp_path / "out").exists()


def test_a_nul_in_a_configured_path_is_one_clear_error(made, tmp_path, run):
    (tmp_path / "fit.toml").write_text('output = "a\\u0000b"\n')
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "--config", tmp_path / "fit.toml")
    assert code == 2 and "cannot be made" in one_line(err)


def test_an_error_of_the_system_that_nobody_foresaw_is_one_line(run, monkeypatch):
    def full(rig, **_):
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr("lbsfit_np.rig.describe.describe", full)
    code, _, err = run("rig", "show", "hand")
    assert code == 2 and one_line(err) == "lbsfit: error: somewhere: No space left on device"


def test_a_saved_segmenter(fitted, made, tube_rig, tmp_path, run, monkeypatch):
    fitter = lbs.LBSFitter(tube_rig, training_scans=40, random_state=0).pretrain(cache=True)
    fitter.segmenter_.save(tmp_path / "s.npz")
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", None)  # not needed any more
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--segmenter", tmp_path / "s.npz")
    assert run(*arguments)[0] == 0
    assert (tmp_path / "out" / "one.mesh.ply").read_bytes() == (fitted[0] / "one.mesh.ply").read_bytes()
    code, _, err = run(*arguments[:4], tmp_path / "other", *arguments[5:], "--parts", "arm and fingers")
    assert code == 2 and "segmenter: got one that was trained on another rig" in one_line(err)


def test_defaults_are_the_librarys():
    parameters = inspect.signature(lbs.LBSFitter).parameters
    for option in fit.OPTIONS:
        if option.key in ("weights", "joints", "scale", "max_points", "training_scans"):
            assert option.default == parameters[option.key].default, option.name
        if option.key == "weights":
            assert set(option.choices) == set(lbs.losses.PRESETS)


@pytest.mark.parametrize("command", [(), ("fit",), ("demo",), ("rig",), ("rig", "show"), ("rig", "card"), ("rig", "list")])
def test_help_has_an_example(command, run):
    code, text, err = run(*command, "--help")
    assert (code, err) == (0, "")
    assert "usage: lbsfit" in text and (command == ("rig",) or "example" in text)


def test_help_shows_defaults(run):
    text = run("fit", "--help")[1]
    text = " ".join(text.split())  # help is wrapped
    for option in fit.OPTIONS:
        if option.default not in (None, {}):
            shown = {True: "yes", False: "no"}.get(option.default, option.default) if option.kind is bool else option.default
            assert f"{option.help} (default: {shown})" in text, option.name


def test_help_is_quick(cache):
    code = "import sys; from lbsfit_np.cli import main; main(['fit', '--help']); print([m for m in sys.modules if m in HEAVY])"
    heavy = "HEAVY = ('scipy', 'sklearn', 'trimesh', 'tqdm', 'matplotlib', 'multiprocessing'); "
    done = subprocess.run(
        [sys.executable, "-c", heavy + code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": PACKAGE_PARENT},
        timeout=120,
    )
    assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr


def test_a_bar_on_a_terminal(capsys):
    progress = Progress(2, terminal=True)
    for share in (0.3, 1.0):
        progress.training(share)
    progress.scan({"name": "one", "status": "ok", "seconds": 1.0, "terms": {"recon": 0.01}, "message": "converged"})
    progress.scan({"name": "two", "status": "failed", "message": "no points"})
    progress.close()
    out, err = capsys.readouterr()
    assert out == "" and "training:" in err and "2/2" in err and "two: failed: no points" in err and "one: fitted" not in err


# ---- lbsfit rig, lbsfit demo ----


def test_rig_show(made, tmp_path, run):
    (tmp_path / "c.toml").write_text('[lock]\njoints = ["short"]\n')
    code, text, err = run("rig", "show", made / "tube.npz", "--card", tmp_path / "c.toml", "--degrees")
    assert (code, err) == (0, "")
    assert "elbow" in text and "locked" in text and "degrees" in text


def test_rig_card(made, tmp_path, run):
    card = tmp_path / "tube.toml"
    assert run("rig", "card", made / "tube.npz", "-o", card)[0] == 0
    assert run("rig", "show", made / "tube.npz", "--card", card)[0] == 0
    card.write_text("mine")
    code, _, err = run("rig", "card", made / "tube.npz", "-o", card)
    assert code == 2 and "exists already" in one_line(err) and card.read_text() == "mine"
    assert run("rig", "card", made / "tube.npz", "-o", card, "--existing", "replace")[0] == 0 and "[limits]" in card.read_text()
    rig = tmp_path / "tube.npz"
    rig.write_bytes((made / "tube.npz").read_bytes())
    code, _, err = run("rig", "card", rig, "-o", rig, "--existing", "replace")
    assert code == 2 and "which is the rig itself" in one_line(err) and rig.read_bytes() == (made / "tube.npz").read_bytes()
    code, _, err = run("rig", "card", rig, "-o", tmp_path)
    assert code == 2 and "a folder" in one_line(err)


def test_rig_list(run):
    code, text, _ = run("rig", "list")
    assert code == 0
    heading, *lines = text.splitlines()
    assert heading.split() == ["name", "vertices", "joints", "poses", "what", "it", "is"]
    rows = {line.split()[0]: line.split(maxsplit=4)[1:] for line in lines}
    assert list(rows) == lbs.bundled_rigs()
    assert rows["hand"] == ["1585", "16", "42", "a right hand, MANO's 16 joints"]
    assert rows["hand-left-coarse"][3].startswith("a left hand") and "fewer vertices" in rows["hand-left-coarse"][3]


def test_rig_show_of_a_bundled_rig(run):
    code, text, _ = run("rig", "show", "hand-left")
    assert code == 0
    for words in (
        "42 natural: flat, spread",
        "length 0.155 to 0.215 m, here 0.187",
        "thumb 0.85 to 1.15, here 1",
        "to_smpl_pose and from_smpl_pose",
    ):
        assert words in text, words


def test_demo(made, tmp_path, run):
    out = tmp_path / "demo"
    arguments = ("demo", "-o", out, "--rig", made / "tube.npz", "--points", 500, *QUICK)
    code, text, err = run(*arguments)
    assert (code, err) == (0, "")
    names = {"rig.npz", "scan.ply", "scan.fit.npz", "scan.mesh.ply", "scan.labels.ply", "summary.json", "truth.npz", "demo.png"}
    assert {p.name for p in out.iterdir()} == names and all(name in text for name in names)
    with np.load(out / "truth.npz") as truth:
        result = lbs.FitResult.load(out / "scan.fit.npz")
        error = np.linalg.norm(result.joints - truth["joints"], axis=1).mean()
        assert error < 0.05 and (result.labels == truth["labels"]).mean() > 0.85
        rig = lbs.load_rig(out / "rig.npz").with_template(truth["template"], truth["template_joints"])
        posed = rig.pose(truth["pose"], truth["translation"], float(truth["scale"]))
        np.testing.assert_allclose(posed, truth["vertices"], atol=1e-9)
    assert f"{250 * error:.1f} mm" in text and "% of the rig's size" in text  # one unit of this rig is 250 mm
    assert (out / "demo.png").read_bytes().startswith(b"\x89PNG")

    code, _, err = run(*arguments)
    assert code == 2 and "exist already" in one_line(err)
    code, _, err = run("demo", "-o", out, "--rig", out / "rig.npz", "--existing", "replace", *QUICK)
    assert code == 2 and "never overwritten" in one_line(err)


def test_the_demos_default_is_the_bundled_hand():
    assert {o.name: o.default for o in demo._OPTIONS}["rig"] in lbs.io.rigs.bundled_rigs()
