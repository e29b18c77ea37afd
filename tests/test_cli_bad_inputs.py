"""Scans, rigs and cards that cannot be used: one clear line for each."""

import os
import pickle
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from cli_runs import QUICK, one_line

import lbsfit_np as lbs
from lbsfit_np.io.write import write_points_ply

pytestmark = pytest.mark.usefixtures("own_cache")


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
    "few.xyz": (_points(np.eye(3)), ["few.xyz: got 3 points", "at least 4 points"]),
    "nan.xyz": (_points(_WITH_NAN), ["2 of 5 points", "index 2", "--drop-invalid"]),
    "equal.xyz": (_points(np.ones((30, 3))), ["30 points that are all equal"]),
    "huge.xyz": (_points(1e199 * np.random.default_rng(0).normal(size=(30, 3))), ["huge.xyz: got an extent of", "can square"]),
    "flat.npy": (lambda path: np.save(path, np.ones((30, 2))), ["(30, 2)", "(n, 3)"]),
    "words.xyz": (lambda path: path.write_text("this is no scan\n"), ["words.xyz: got no line of numbers below the first"]),
    "not.glb": (lambda path: path.write_bytes(b"glTF" + struct.pack("<II", 2, 900)), ["not.glb"]),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_SCANS)
def test_bad_scans(name, made, tmp_path, run):
    make, words = BAD_SCANS[name]
    make(tmp_path / name)
    code, _, err = run("fit", made / "tube.npz", tmp_path / name, "-o", tmp_path / "out", *QUICK)
    assert code == 1
    assert len(err.splitlines()) == 1 and f"{Path(name).stem}: failed: " in err and "expected" in err, err
    for word in words:
        assert word in err or re.search(word, err), (word, err)


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


def test_missing_scans_are_said_before_a_missing_rig(tmp_path, run):
    code, _, err = run("fit", tmp_path / "no.npz", tmp_path / "no.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 2 and one_line(err).startswith("lbsfit: error: SCAN: got a file that does not exist") and "no.ply" in err


def test_a_folder_is_told_what_is_in_it(made, tmp_path, run):
    for name in ("a.XYZ", "b.XYZ", "c.obj", "notes.md", "more.md", "others.md"):
        (tmp_path / name).write_text("")
    _, _, err = run("fit", made / "tube.npz", tmp_path, "-o", tmp_path / "out")
    assert one_line(err).endswith(f"Name the files in it, such as {tmp_path / '*.XYZ'}")


def test_a_lack_of_memory_says_what_takes_less(made, tmp_path, run, monkeypatch):
    def full(*arguments, **options):
        raise MemoryError

    monkeypatch.setattr("lbsfit_np.learning.pretraining.train_segmenter", full)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--training-scans", 41)
    assert code == 2 and "out of memory; use fewer training scans" in one_line(err) and "--training-scans, --jobs" in err


def test_a_rig_is_no_scan(made, tmp_path, run):
    code, _, err = run("fit", made / "tube.npz", made / "tube.npz", "-o", tmp_path / "out", *QUICK)
    assert code == 1 and "a rig, or a learned model" in err and "expected a scan" in err
    scan = {"points": np.eye(3), "parents": np.zeros(2), "joints": np.zeros((2, 3)), "weights": np.zeros((3, 2))}
    np.savez(tmp_path / "tracked.npz", **scan)
    assert np.array_equal(lbs.load_scan(tmp_path / "tracked.npz").points, np.eye(3))


def test_a_file_with_the_name_of_an_option_is_no_option(made, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, _, err = run("fit", "card", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 2 and one_line(err).startswith("lbsfit: error: card: got no such file")


def test_a_card_that_names_no_joint(made, tmp_path, run):
    (tmp_path / "tube.toml").write_text('[lock]\njoints = ["elbo"]\n')
    code, _, err = run(
        "fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--card", tmp_path / "tube.toml", *QUICK
    )
    assert code == 2 and "'elbo'" in one_line(err) and "Did you mean 'elbow'" in err


@pytest.mark.parametrize("command", ["fit", "learn"])
def test_a_place_that_cannot_be_written_to_is_said_before_any_work(command, made, tmp_path, run, monkeypatch):
    def denied(**options):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", denied)
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", None)
    out = tmp_path / "new" / ("out" if command == "fit" else "model.npz")
    code, _, err = run(command, made / "tube.npz", made / "one.ply", "-o", out, *QUICK)
    words = "a folder that cannot be written to (Read-only file system); expected a folder to write to"
    assert code == 2 and words in one_line(err) and not (tmp_path / "new").exists()
    assert one_line(err).startswith("lbsfit: error: -o/--output: got ")
