"""Models of the SMPL family, made by hand: .npz and .pkl, dense and sparse, with chumpy and without."""

import pickle
import sys
import types
import zipfile

import numpy as np
import pytest
from npy_files import DAMAGED_HEADERS, npy
from scipy import sparse

from lbsfit_np.errors import FileError
from lbsfit_np.io.smpl import read_smpl

ROOT = 2**32 - 1
SMPL_PARENTS = [ROOT, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


def model(parents=SMPL_PARENTS, m=60, seed=0):
    """A random model: the keys, types and shapes of the real ones."""
    rng = np.random.default_rng(seed)
    J = len(parents)
    weights = rng.random((m, J)) * (rng.random((m, J)) < 0.2) + 1e-3
    regressor = rng.random((J, m)) * (rng.random((J, m)) < 0.2) + 1e-3
    return {
        "v_template": rng.normal(size=(m, 3)),
        "f": rng.integers(0, m, (100, 3)).astype(np.uint32),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([parents, range(J)], dtype=np.uint32),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "shapedirs": rng.normal(size=(m, 3, 10)),
        "posedirs": rng.normal(size=(m, 3, 9)),
        "bs_type": "lrotmin",
    }


def save(tmp_path, content, suffix):
    path = tmp_path / f"model{suffix}"
    if suffix == ".npz":
        np.savez(path, **content)
    else:
        path.write_bytes(pickle.dumps(content, protocol=2))
    return path


class _Ch:
    """Keeps its state as chumpy's classes do."""

    def __init__(self, **state):
        self.__dict__.update(state, _dirty_vars={"x"}, _itr=None)


def with_chumpy(tmp_path, monkeypatch, content):
    """The content as a pickle that names chumpy's classes, with chumpy gone again when it is read."""
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    made = {}
    for module, name in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select"), ("chumpy.ch", "MatVecMult")):
        made[name] = type(name, (_Ch,), {"__module__": module})
        setattr(modules[module], name, made[name])
    path = tmp_path / "chumpy.pkl"
    with monkeypatch.context() as m:
        for name, module in modules.items():
            m.setitem(sys.modules, name, module)
        path.write_bytes(pickle.dumps(content(made), protocol=2))
    return path


def check(rig, content, parents=SMPL_PARENTS):
    np.testing.assert_array_equal(rig.vertices, content["v_template"])
    np.testing.assert_array_equal(rig.faces, content["f"])
    np.testing.assert_allclose(rig.weights.toarray(), content["weights"], rtol=1e-15)
    np.testing.assert_array_equal(rig.parents, [-1 if p == ROOT else p for p in parents])
    np.testing.assert_allclose(rig.joints, content["J_regressor"] @ content["v_template"], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rig.regressor @ rig.vertices, rig.joints)
    np.testing.assert_array_equal(rig.frames, np.tile(np.eye(3), (len(parents), 1, 1)))
    assert rig.regressor.format == rig.weights.format == "csr"
    assert rig.metres_per_unit == 1.0


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_recovers_the_model(tmp_path, suffix):
    content = model()
    path = save(tmp_path, content, suffix)
    rig = read_smpl(path)
    check(rig, content)
    assert (rig.up, rig.forward, rig.name, rig.path) == ("+y", "+z", "model", path)
    assert any("shapedirs and posedirs left out" in note for note in rig.notes)


@pytest.mark.parametrize("make", [sparse.csc_matrix, sparse.csr_matrix, sparse.coo_matrix])
def test_sparse_regressor_and_text_path(tmp_path, make):
    content = model()
    path = save(tmp_path, content | {"J_regressor": make(content["J_regressor"])}, ".pkl")
    check(read_smpl(str(path)), content)


def test_chumpy_model_without_chumpy(tmp_path, monkeypatch):
    content = model()
    regressor = sparse.csc_matrix(content["J_regressor"])

    def chumpy_model(ch):
        base = ch["Ch"](x=np.vstack([content["v_template"][::-1], np.ones((5, 3))]))
        idxs = np.arange(content["v_template"].size).reshape(-1, 3)[::-1].ravel()
        return content | {
            "v_template": ch["Select"](a=base, idxs=idxs, preferred_shape=content["v_template"].shape),
            "weights": ch["Ch"](x=content["weights"]),
            "J_regressor": regressor,
            "J": ch["MatVecMult"](mtx=regressor, vec=base),  # would have to be computed, and is not needed
        }

    path = with_chumpy(tmp_path, monkeypatch, chumpy_model)
    assert b"chumpy.reordering" in path.read_bytes() and "chumpy" not in sys.modules
    check(read_smpl(path), content)


def test_chumpy_value_that_would_need_computing(tmp_path, monkeypatch):
    path = with_chumpy(tmp_path, monkeypatch, lambda ch: model() | {"v_template": ch["MatVecMult"](mtx=np.eye(3))})
    with pytest.raises(FileError, match="v_template as a chumpy.ch.MatVecMult"):
        read_smpl(path)


@pytest.mark.parametrize(
    ("J", "first", "last", "up"),
    [
        (24, ["pelvis", "left_hip", "right_hip", "spine1"], ["left_hand", "right_hand"], "+y"),
        (52, ["pelvis", "left_hip", "right_hip", "spine1"], ["right_thumb1", "right_thumb2", "right_thumb3"], "+y"),
        (55, ["pelvis", "left_hip", "right_hip", "spine1"], ["right_thumb2", "right_thumb3"], "+y"),
        (16, ["wrist", "index1", "index2", "index3", "middle1"], ["ring3", "thumb1", "thumb2", "thumb3"], None),
        (5, ["joint_00"], ["joint_04"], None),
        (120, ["joint_000"], ["joint_119"], None),
    ],
)
def test_names_by_the_number_of_joints(tmp_path, J, first, last, up):
    rig = read_smpl(save(tmp_path, model([ROOT, *range(J - 1)]), ".npz"))
    names = rig.joint_names
    assert len(names) == len(set(names)) == J
    assert names[: len(first)] == first and names[-len(last) :] == last
    assert rig.up == up
    assert any("match no known model" in note for note in rig.notes) == (J in (5, 120))


def test_known_rows_of_smplx(tmp_path):
    names = read_smpl(save(tmp_path, model([ROOT, *range(54)]), ".npz")).joint_names
    assert [names[k] for k in (12, 15, 20, 22, 23, 24)] == ["neck", "head", "left_wrist", "jaw", "left_eye", "right_eye"]
    assert [names[k] for k in (25, 34, 37, 40)] == ["left_index1", "left_ring1", "left_thumb1", "right_index1"]


def test_hands_mean_is_noted(tmp_path):
    rig = read_smpl(save(tmp_path, model([ROOT, *range(15)]) | {"hands_mean": np.zeros(45)}, ".npz"))
    assert any("flat hand" in note for note in rig.notes)


@pytest.mark.parametrize("root, kind", [(-1, np.int64), (ROOT, np.int64), (2**64 - 1, np.uint64), (ROOT, float)])
def test_kintree_of_ids_in_any_order(tmp_path, root, kind):
    content = model([ROOT, 0, 1])
    content["kintree_table"] = np.array([[7, root, 9], [5, 7, 4]], dtype=kind)
    with pytest.raises(FileError, match="parent 9 of joint 4"):
        read_smpl(save(tmp_path, content, ".npz"))
    content["kintree_table"][0, 2] = 5
    np.testing.assert_array_equal(read_smpl(save(tmp_path, content, ".npz")).parents, [1, -1, 0])


def test_joints_without_a_regressor(tmp_path):
    content = model([ROOT, 0, 1])
    del content["J_regressor"]
    content["J"] = np.arange(9.0).reshape(3, 3)
    rig = read_smpl(save(tmp_path, content, ".pkl"))
    assert rig.regressor is None
    np.testing.assert_array_equal(rig.joints, content["J"])


def test_faces_under_their_other_name_and_as_floats(tmp_path):
    content = model()
    content["faces"] = content.pop("f").astype(float)
    np.testing.assert_array_equal(read_smpl(save(tmp_path, content, ".npz")).faces, content["faces"].astype(int))


# ---- bad files ----


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("key", ["v_template", "f", "weights", "kintree_table", "J_regressor"])
def test_missing_keys(tmp_path, key, suffix):
    content = model()
    del content[key]
    with pytest.raises(FileError, match=f"no {key}"):
        read_smpl(save(tmp_path, content, suffix))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("v_template", np.zeros((60, 2)), r"v_template of shape \(60, 2\); expected shape \(any, 3\)"),
        ("v_template", np.zeros((0, 3)), "at least one row"),
        ("v_template", np.array([["a"] * 3]), "v_template of <U1 values"),
        ("f", np.zeros((5, 4), int), r"f of shape \(5, 4\)"),
        ("f", np.full((5, 3), 0.5), "f with values that are not whole numbers"),
        ("f", np.full((5, 3), np.nan), "f with values that are not whole numbers"),
        ("weights", np.zeros((59, 24)), r"weights of shape \(59, 24\); expected shape \(60, 24\)"),
        ("weights", sparse.csr_matrix((60, 23)), r"weights of shape \(60, 23\)"),
        ("kintree_table", np.zeros(24, int), r"kintree_table of shape \(24,\)"),
        ("kintree_table", np.zeros((2, 24), int), "ids that repeat"),
        ("J_regressor", np.zeros((23, 60)), r"J_regressor of shape \(23, 60\)"),
        ("J_regressor", sparse.csc_matrix((24, 61)), r"J_regressor of shape \(24, 61\)"),
        ("J_regressor", "none", "J_regressor of type str"),
    ],
)
def test_wrong_arrays(tmp_path, key, value, words):
    with pytest.raises(FileError, match=words):
        read_smpl(save(tmp_path, model() | {key: value}, ".pkl"))


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated(tmp_path, suffix, share):
    path = save(tmp_path, model(), suffix)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileError, match="truncated|broken or not NPZ") as e:
        read_smpl(path)
    assert e.value.argument == str(path)


def test_damaged_npz(tmp_path):
    path = save(tmp_path, model(), ".npz")
    data = bytearray(path.read_bytes())
    data[300:340] = bytes(40)  # inside the first array: its checksum fails
    path.write_bytes(data)
    with pytest.raises(FileError, match="'v_template' cannot be unpacked"):
        read_smpl(path)


@pytest.mark.parametrize("header", DAMAGED_HEADERS)
def test_damaged_npy_headers_in_an_npz(tmp_path, header):
    path = save(tmp_path, model(), ".npz")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, npy(header) if name == "weights.npy" else content)
    with pytest.raises(FileError, match="'weights' cannot be unpacked"):
        read_smpl(path)


def test_npz_with_pickled_objects(tmp_path):
    content = model() | {"J_regressor": np.array(sparse.csc_matrix(model()["J_regressor"]), dtype=object)}
    with pytest.raises(FileError, match="Python objects in 'J_regressor'"):
        read_smpl(save(tmp_path, content, ".npz"))


def test_objects_under_other_keys_do_not_matter(tmp_path):
    content = model() | {"part2num": np.array({"head": 1}, dtype=object)}
    check(read_smpl(save(tmp_path, content, ".npz")), content)


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_missing_file(tmp_path, suffix):
    with pytest.raises(FileError, match="(?i)no such file"):
        read_smpl(tmp_path / f"nowhere{suffix}")


def test_pickle_of_something_else(tmp_path):
    with pytest.raises(FileError, match="a pickled list"):
        read_smpl(save(tmp_path, [1, 2], ".pkl"))


def test_array_file_under_the_name_of_npz(tmp_path):
    path = tmp_path / "a.npz"
    with path.open("wb") as f:
        np.save(f, np.zeros(3))
    with pytest.raises(FileError, match="a single array"):
        read_smpl(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("v_template", sparse.csr_matrix((1, 2**45))),
        ("weights", sparse.coo_matrix((2**27, 1))),
        ("v_template", sparse.csc_matrix((2**40, 3))),
        ("J_regressor", sparse.csr_matrix((24, 2**40))),
    ],
)
def test_shapes_are_looked_at_before_arrays_are_written_out(tmp_path, key, value):
    with pytest.raises(FileError, match=rf"{key} of shape \({value.shape[0]}, {value.shape[1]}\)"):
        read_smpl(save(tmp_path, model() | {key: value}, ".pkl"))
