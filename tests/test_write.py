"""Written files: whole or not at all, and read back as they were."""

import errno
import json
import os
import stat
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io.scans import load_scan
from lbsfit_np.io.write import (
    atomic_path,
    atomic_paths,
    write_json,
    write_mesh_ply,
    write_npz,
    write_points_ply,
)
from lbsfit_np.rig.card import write_card

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(40, 3)) * 1e3 / 3
FACES = RNG.permutation(40)[:39].reshape(-1, 3)
LABELS = np.arange(40) % 7 - 1
COLORS = RNG.integers(256, size=(40, 3), dtype=np.uint8)
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_a_file_appears_only_when_its_block_ends(tmp_path):
    path = tmp_path / "a.fit.npz"
    path.write_text("old")
    with atomic_path(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".npz"
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and names(tmp_path) == ["a.fit.npz"]


@pytest.mark.skipif(os.name != "posix", reason="links and pipes are POSIX files")
@pytest.mark.parametrize("write", [write_json, lambda path, _: write_card(make_tube_data(), path)])
def test_links_stay_and_devices_are_no_files_to_write(tmp_path, write):
    (tmp_path / "far").mkdir()
    (tmp_path / "far" / "b.json").write_text("old")
    for link, target in (("a.json", "b.json"), ("new.json", "c.json")):  # the second leads to nothing yet
        (tmp_path / link).symlink_to(Path("far") / target)
        write(tmp_path / link, {"x": 1})
        assert (tmp_path / link).is_symlink() and (tmp_path / "far" / target).read_text() not in ("", "old")
    (tmp_path / "a.npz").symlink_to(Path("far") / "c.json")
    with atomic_path(tmp_path / "a.npz") as temporary:  # with the ending that was asked for, where the link leads to
        assert temporary.suffix == ".npz" and temporary.parent == (tmp_path / "far").resolve()
        temporary.write_text("npz")
    assert (tmp_path / "far" / "c.json").read_text() == "npz"
    (tmp_path / "a.npz").unlink()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match="pipe: got a device"):
        write(tmp_path / "pipe", {"x": 1})
    assert names(tmp_path) == ["a.json", "far", "new.json", "pipe"] and names(tmp_path / "far") == ["b.json", "c.json"]
    assert not (tmp_path / "pipe").is_file()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, FileError])
def test_nothing_is_left_behind_on_failure(tmp_path, error):
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(error), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise error("a", "b", "c") if error is FileError else error
    assert path.read_text() == "old" and names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("there", ["", "a", "b", "ab"])
@pytest.mark.parametrize("fails", ["block", "disk", "aside", "name", "stop", None])
def test_files_that_belong_together_appear_together_or_not_at_all(fails, there, tmp_path, monkeypatch):
    files, before = [tmp_path / "a", tmp_path / "b"], dict.fromkeys(there, "old")
    for name in there:
        (tmp_path / name).write_text("old")
    move = os.replace

    def synced(handle, done=[]):  # noqa: B006 (how many were)
        done.append(handle)
        if fails == "disk" and len(done) == 2:
            raise OSError(28, "No space left on device")

    def moved(source, target):
        if (fails == "aside" and source == files[1]) or (fails == "name" and target == files[1] and source.suffix == ".tmp"):
            raise PermissionError(13, "Permission denied")
        if fails == "stop" and target == files[1] and source.suffix == ".tmp":
            raise KeyboardInterrupt
        move(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", moved)
    wrong = fails is not None and not (fails == "aside" and "b" not in there)
    words = {"block": "nothing foreseen", "stop": "", "disk": "b: got .*No space left"}.get(fails, "b: got .*Permission denied")
    with pytest.raises((FileError, RuntimeError, KeyboardInterrupt), match=words) if wrong else nullcontext():
        with atomic_paths(*files) as temporary:
            for path in temporary:
                path.write_text("new")
            if fails == "block":
                raise RuntimeError("nothing foreseen")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == (before if wrong else dict.fromkeys("ab", "new"))


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
@pytest.mark.parametrize("mask, mode", [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_permissions_follow_the_umask(tmp_path, mask, mode):
    before = os.umask(mask)
    try:
        write_json(tmp_path / "a.json", {})
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == mode


def test_places_that_cannot_be_written(tmp_path):
    with pytest.raises(FileError, match="folder that does not exist.*Create it"):
        write_json(tmp_path / "none" / "a.json", {})
    with pytest.raises(FileError, match="got a folder"):
        write_json(tmp_path, {})
    with pytest.raises(FileError, match="disk is full"), atomic_path(tmp_path / "a.json") as temporary:
        temporary.write_text("half")
        raise OSError(28, "disk is full")
    assert names(tmp_path) == []


def test_a_process_told_to_end_as_soon_as_the_file_is_there_leaves_none(tmp_path, monkeypatch):
    def told_to_end(descriptor):
        really(descriptor)
        raise SystemExit(143)

    really = os.close
    monkeypatch.setattr(os, "close", told_to_end)
    with pytest.raises(SystemExit), atomic_path(tmp_path / "a.json"):
        pass
    assert names(tmp_path) == []


def test_long_names_still_fit(tmp_path):
    path = tmp_path / ("x" * 245 + ".npz")
    write_npz(path, a=1)
    assert path.exists()
    for name in ("界" * 80 + ".fit.npz", "é" * 100 + "." + "x" * 54):  # up to 255 bytes, which are fewer letters
        with atomic_path(tmp_path / name) as temporary:
            temporary.write_text("new")
        assert (tmp_path / name).read_text() == "new"


@pytest.mark.parametrize(
    ("path", "words"),
    [("x" * 300 + ".npz", "too long"), ("a\0b.npz", "null"), ("", "a folder"), (".", "a folder"), ("..", "a folder")],
)
def test_names_that_cannot_be_are_refused_before_the_block(tmp_path, monkeypatch, path, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileError, match=words), atomic_path(path):
        raise RuntimeError("too late")
    assert names(tmp_path) == []


@pytest.mark.parametrize("path", [None, 3, b"a.npz"])
def test_what_is_no_path(path):
    with pytest.raises(InputError, match=f"path: got {type(path).__name__}; expected the name of a file"):
        write_npz(path, a=1)


def test_mesh_comes_back_by_load_scan(tmp_path):
    path = tmp_path / "m.ply"
    write_mesh_ply(path, POINTS, FACES, vertex_labels=LABELS, colors=COLORS, normals=NORMALS, part_names=["palm", "Zehe ü\nx"])
    scan = load_scan(path)
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-6)
    header = path.read_bytes().split(b"end_header")[0].decode("ascii")
    assert "comment part 0 palm\n" in header and "comment part 1 Zehe \\xfc x\n" in header


def test_mesh_comes_back_by_trimesh(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_mesh_ply(tmp_path / "m.ply", POINTS, FACES, vertex_labels=LABELS, colors=COLORS)
    mesh = trimesh.load(tmp_path / "m.ply", process=False, maintain_order=True)
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], COLORS)


def test_points_come_back(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_points_ply(tmp_path / "p.ply", POINTS, labels=LABELS, confidence=np.linspace(0, 1, 40), colors=COLORS)
    np.testing.assert_array_equal(load_scan(tmp_path / "p.ply").labels, LABELS)
    cloud = trimesh.load(tmp_path / "p.ply")
    np.testing.assert_array_equal(cloud.vertices, POINTS)
    np.testing.assert_array_equal(np.asarray(cloud.colors)[:, :3], COLORS)
    write_points_ply(tmp_path / "q.ply", POINTS)
    np.testing.assert_array_equal(load_scan(tmp_path / "q.ply").points, POINTS)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"labels": LABELS[:5]}, r"labels: .*\(5,\).*\(40,\)"),
        ({"labels": LABELS / 2}, "labels: got float64.*whole numbers"),
        ({"colors": COLORS / 255}, "colors: got float64.*unsigned bytes"),
        ({"normals": POINTS[:, :2]}, "normals"),
        ({"confidence": np.zeros((40, 2))}, "confidence"),
        ({"labels": LABELS + 2**40}, "labels: got .*whole numbers from -2147483648 to 2147483647"),
        ({"colors": np.full((40, 3), 300, dtype=np.uint16)}, "colors: got 300 to 300; expected whole numbers from 0 to 255"),
    ],
)
def test_arrays_that_do_not_fit_the_points(tmp_path, wrong, words):
    with pytest.raises(InputError, match=words):
        write_points_ply(tmp_path / "p.ply", POINTS, **wrong)
    with pytest.raises(InputError, match="faces"):
        write_mesh_ply(tmp_path / "p.ply", POINTS, FACES[:, :2])
    for wrong in (FACES + 40, FACES - 40, FACES + 2**33):
        with pytest.raises(InputError, match="faces: got .*whole numbers from 0 to 39"):
            write_mesh_ply(tmp_path / "p.ply", POINTS, wrong)
    with pytest.raises(InputError, match="points: got complex numbers"):
        write_points_ply(tmp_path / "p.ply", POINTS * 1j)
    for points, words in (([["a", "b", "c"]], "values of type <U1"), ([[1, 2, None]], "values of type object")):
        with pytest.raises(InputError, match=f"points: got {words}; expected numbers"):
            write_points_ply(tmp_path / "p.ply", points)
    with pytest.raises(InputError, match="points: got a masked array with 1 of 40 rows masked"):
        write_points_ply(tmp_path / "p.ply", np.ma.masked_array(POINTS, POINTS == POINTS[3, 1]))
    assert names(tmp_path) == []


def test_json_holds_names_of_files_that_are_not_unicode(tmp_path):
    name = os.fsdecode(b"caf\xe9.ply")
    write_json(tmp_path / "a.json", {"name": name, "more": "ü"})
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"name": name, "more": "ü"}


def test_json_holds_numpy_and_no_nan(tmp_path):
    obj = {
        "z": np.float32(0.5), "a": [np.int64(3), float("nan"), (True, np.bool_(False))], "path": Path("a") / "b",
        "array": np.array([[1.0, np.inf], [2.0, 3.0]]), 7: None, "text": "é",
    }  # fmt: skip
    write_json(tmp_path / "a.json", obj)
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    expected = {
        "7": None, "a": [3, None, [True, False]], "array": [[1.0, None], [2.0, 3.0]], "path": str(Path("a") / "b"),
        "text": "é", "z": 0.5,
    }  # fmt: skip
    assert json.loads(text) == expected
    assert list(json.loads(text)) == sorted(expected) and text.endswith("}\n") and "é" in text
    with pytest.raises(TypeError):
        write_json(tmp_path / "b.json", {"a": object()})
    assert names(tmp_path) == ["a.json"]


def test_npz_comes_back_without_pickle_and_with_the_same_bytes(tmp_path):
    arrays = {"file": np.arange(5), "allow_pickle": np.float32(2), "path": np.array(["a", "bc"]), "empty": np.zeros((0, 3))}
    write_npz(tmp_path / "a.npz", **arrays)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as back:
        assert set(back.files) == set(arrays)
        for key, value in arrays.items():
            np.testing.assert_array_equal(back[key], value)
            assert back[key].dtype == value.dtype
    write_npz(tmp_path / "b.npz", **arrays)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_npz_refuses_python_objects(tmp_path):
    with pytest.raises(InputError, match="thing: got an array of Python objects"):
        write_npz(tmp_path / "a.npz", fine=[1, 2], thing=[None, {}])
    assert names(tmp_path) == []


def test_what_is_written_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(os, "fsync", lambda handle: seen.append((os.fstat(handle).st_size, names(tmp_path))))
    write_json(tmp_path / "a.json", {"a": 1})
    ((size, there),) = seen
    assert size == (tmp_path / "a.json").stat().st_size > 0 and "a.json" not in there


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTSUP])
def test_file_systems_that_cannot_say_when_are_good_enough(code, tmp_path, monkeypatch):
    def cannot(handle):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", cannot)
    write_json(tmp_path / "a.json", {"a": 1})
    assert names(tmp_path) == ["a.json"]


def test_an_error_names_what_was_asked_for_and_what_was_wrong(tmp_path, monkeypatch):
    """Where the disk is full while a file is written in the place of another, and what is left of it cannot be removed."""

    def full(handle):
        raise OSError(28, "No space left on device")

    def read_only(self, missing_ok=False):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "fsync", full)
    monkeypatch.setattr(Path, "unlink", read_only)
    path = tmp_path / "a.mesh.ply"
    with pytest.raises(FileError, match="No space left on device") as told, atomic_path(path) as temporary:
        write_mesh_ply(temporary, POINTS, FACES)
    assert told.value.argument == str(path)


def test_a_table_that_does_not_fit_tells_why(tmp_path):
    resource = pytest.importorskip("resource", reason="limits of a process are POSIX")
    import signal

    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400, before[1]))
    try:
        with pytest.raises(FileError, match=r"File too large"):
            write_points_ply(tmp_path / "a.ply", POINTS)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert names(tmp_path) == []
