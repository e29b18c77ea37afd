"""Segmenters in files, which run nothing: what is loaded is what was saved, and every broken file gives one clear error."""

import io
import json
import zipfile

import numpy as np
import pytest

from lbsfit_np.errors import FileError
from lbsfit_np.segmentation.segmenter import Segmenter


@pytest.fixture
def saved(small_segmenter, tmp_path):
    small_segmenter.save(tmp_path / "s.npz")
    return tmp_path / "s.npz"


def _arrays(path):
    with np.load(path, allow_pickle=False) as z:
        return {k: z[k] for k in z.files}


def test_loaded_is_bit_equal(small_segmenter, saved, tube_scan):
    again = Segmenter.load(saved)
    np.testing.assert_array_equal(again.predict_proba(tube_scan.points), small_segmenter.predict_proba(tube_scan.points))
    assert (again.rig_digest, again.n_parts, again.half, again.descriptor) == (
        small_segmenter.rig_digest,
        small_segmenter.n_parts,
        small_segmenter.half,
        small_segmenter.descriptor,
    )


def test_its_name_has_to_tell_what_it_is(small_segmenter, tmp_path):
    with pytest.raises(FileError, match="a name that ends in .npz"):
        small_segmenter.save(tmp_path / "s")
    assert not list(tmp_path.iterdir())


def test_the_file_holds_numbers_and_text_only(saved):
    arrays = _arrays(saved)  # allow_pickle=False: an object array would raise
    assert {a.dtype.kind for a in arrays.values()} <= set("fiuU")
    with zipfile.ZipFile(saved) as z:
        assert all(name.endswith(".npy") for name in z.namelist())
    json.loads(str(arrays["lbsfit_np_segmenter"]))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_one_clear_error(saved, share):
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileError) as error:
        Segmenter.load(saved)
    assert "s.npz" in str(error.value) and "expected" in str(error.value)


def _rewritten(path, **changes):
    arrays = {**_arrays(path), **changes}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


@pytest.mark.parametrize(
    "changes",
    [
        {"stage_0_mean": None},
        {"stage_0_deviation": None},
        {"stage_0_classes": None},
        {"stage_0_only": None},
        {"stage_0_intercepts_0": None},
        {"stage_0_coefs_1": None},
        {"stage_1_mean": None},
        {"stage_1_classes": None},
        {"stage_1_intercepts_2": None},
        {"lbsfit_np_segmenter": None},
        {"lbsfit_np_segmenter": np.array("{")},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 1}))},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 999}))},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 3}))},
        {"lbsfit_np_segmenter": np.array(json.dumps([2]))},
        {"lbsfit_np_segmenter": np.array("[" * 100_000)},
        {"lbsfit_np_segmenter": np.array("2")},
        {"lbsfit_np_segmenter": np.zeros(3)},
        {"stage_0_mean": np.array([{"an": "object"}], dtype=object)},
    ],
)
def test_a_file_that_lacks_something_is_one_clear_error(saved, changes):
    _rewritten(saved, **changes)
    with pytest.raises(FileError, match=r"s\.npz"):
        Segmenter.load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"stage_0_mean": np.zeros(3, np.float32)},
        {"stage_0_mean": np.float32(0)},
        {"stage_0_classes": np.array([0, 1, 2, 9])},
        {"stage_0_classes": np.array([0, 1])},
        {"stage_0_classes": np.array([0.0, 1, 2, 3])},
        {"stage_0_coefs_0": np.zeros((4, 4), np.float32)},
        {"stage_0_coefs_0": np.zeros(4, np.float32)},
        {"stage_1_mean": np.zeros(3, np.float32)},
        {"stage_1_classes": np.array([-1, 1, 2, 3])},
        {"stage_1_coefs_0": np.zeros((4, 4), np.float32)},
        {"stage_1_intercepts_1": np.zeros(3, np.float32)},
    ],
)
def test_arrays_that_do_not_fit_together_are_one_clear_error(saved, changes):
    _rewritten(saved, **changes)
    with pytest.raises(FileError, match=r"s\.npz"):
        Segmenter.load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"stages": 0},
        {"stages": 3},
        {"stages": "many"},
        {"n_parts": 3},
        {"n_parts": 5},
        {"n_parts": None},
        {"n_parts": float("inf")},
        {"half": 0.0},
        {"half": float("nan")},
        {"half": "long"},
        {"descriptor": {"n_probes": 3}},
        {"descriptor": {"n_probes": "3"}},
        {"descriptor": {"n_probes": 200.0}},
        {"descriptor": {"voxel": 0.0}},
        {"descriptor": {"voxel": float("nan")}},
        {"descriptor": {"nearest": "near"}},
        {"descriptor": {"farthest": float("inf")}},
        {"descriptor": {"nearest": 1.3}},
        {"descriptor": {"wobble": 3}},
        {"descriptor": 5},
    ],
)
def test_a_header_that_does_not_fit_is_one_clear_error(saved, changes):
    header = json.loads(str(_arrays(saved)["lbsfit_np_segmenter"]))
    _rewritten(saved, lbsfit_np_segmenter=np.array(json.dumps(header | changes)))
    with pytest.raises(FileError, match=r"s\.npz.*saved with Segmenter.save.*Train it again"):
        Segmenter.load(saved)


def test_other_files_are_one_clear_error(tmp_path, tube_rig):
    with pytest.raises(FileError, match="no such file"):
        Segmenter.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("not a zip")
    np.save(tmp_path / "array.npy", np.zeros(3))
    tube_rig.save(tmp_path / "rig.npz")
    for name in ("text.npz", "array.npy", "rig.npz"):
        with pytest.raises(FileError, match=name.replace(".", r"\.")):
            Segmenter.load(tmp_path / name)


def test_nothing_in_a_file_is_run(saved, tmp_path):
    """A pickle in the place of an array must not be opened, let alone run."""
    import pickle

    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("sprung").touch, ())

    trap = io.BytesIO()
    np.lib.format.write_array(trap, np.array([Trap()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(saved) as z:
        members = {n: z.read(n) for n in z.namelist()}
    assert "stage_0_mean.npy" in members
    members["stage_0_mean.npy"] = trap.getvalue()
    with zipfile.ZipFile(saved, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError):
        Segmenter.load(saved)
    saved.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(FileError):
        Segmenter.load(saved)
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("key", ["stage_0_coefs_1", "stage_1_intercepts_0", "stage_0_mean", "stage_0_deviation"])
def test_numbers_that_are_none_are_told_when_it_is_loaded(key, saved):
    for change in (lambda a: np.full_like(a, np.nan), lambda a: a.astype(str)):
        arrays = _arrays(saved)
        np.savez(saved, **arrays | {key: change(arrays[key])})
        with pytest.raises(FileError, match="content does not fit .*values that are not finite numbers"):
            Segmenter.load(saved)


def test_deviations_divide(saved):
    arrays = _arrays(saved)
    np.savez(saved, **arrays | {"stage_0_deviation": 0 * arrays["stage_0_deviation"]})
    with pytest.raises(FileError, match="content does not fit .*a mean and deviations"):
        Segmenter.load(saved)


@pytest.mark.parametrize("key, what", [("lbsfit_np_model", "a learned model"), ("mine", "another NPZ")])
def test_another_file_is_told_from_a_broken_one(key, what, tmp_path):
    np.savez(tmp_path / "s.npz", **{key: np.arange(3)})
    with pytest.raises(FileError, match=f"got {what}, without the key lbsfit_np_segmenter; .*Check the path"):
        Segmenter.load(tmp_path / "s.npz")
