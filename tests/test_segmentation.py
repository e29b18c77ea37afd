"""The segmenter: what its descriptors do not see, training by seed, files that run nothing, and the cache."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data, make_tube_rig

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.segmentation import cache
from lbsfit_np.segmentation.descriptors import Descriptor
from lbsfit_np.segmentation.segmenter import Segmenter, train_segmenter


def _scans(rig, n, seed=0, **settings):
    return [(s.points, s.labels, 1.0) for s in lbs.synthesize(rig, n, random_state=seed, n_points=400, **settings)]


def _train(rig, seed=0, n=4):
    return train_segmenter(rig, _scans(rig, n), points_per_scan=60, random_state=seed)


@pytest.fixture(scope="module")
def small(tube_rig):
    """A segmenter that knows little and trains fast."""
    return _train(tube_rig)


@pytest.fixture(scope="module")
def scan(tube_rig):
    return lbs.synthesize(tube_rig, 1, random_state=50)[0]


# ---- descriptors ----


def _describe(points, rig, **options):
    return Descriptor()(points / (rig.size / 2), **options)


def test_a_row_a_point(tube_rig, scan):
    found = _describe(scan.points, tube_rig)
    assert found.shape == (len(scan.points), Descriptor().size)
    assert np.isfinite(found).all()
    rows = np.array([5, 3, 900])
    np.testing.assert_array_equal(_describe(scan.points, tube_rig, rows=rows), found[rows])


def test_the_order_of_the_points_does_not_matter(tube_rig, scan):
    order = np.random.default_rng(0).permutation(len(scan.points))
    found = _describe(scan.points, tube_rig)
    np.testing.assert_allclose(_describe(scan.points[order], tube_rig), found[order], atol=1e-5)


@pytest.mark.parametrize("shift", [[0.5, 1.0, -1.5], [0.013, 0.2, -0.4], [100.0, -30.0, 7.0], [1e5, -2e5, 3e5]])
def test_where_the_scan_stands_does_not_matter(tube_rig, scan, shift):
    away = np.abs(_describe(scan.points + shift, tube_rig) - _describe(scan.points, tube_rig))
    assert away.max() < 1e-4


def test_the_description_has_a_unit(tube_rig, scan):
    """Half sizes of the rig: a scan in millimetres of a rig in metres is described the same."""
    in_mm = tube_rig.scaled(1000.0)
    np.testing.assert_allclose(_describe(1000 * scan.points, in_mm), _describe(scan.points, tube_rig), atol=1e-4)
    far = np.abs(_describe(1.3 * scan.points, tube_rig) - _describe(scan.points, tube_rig))
    assert far.max() > 0.1


def test_uneven_density_hardly_moves_the_centroid(tube_rig):
    """Half of the body at a third of the density: the mean of the points moves by far more than what s sees of it."""
    rng = np.random.default_rng(0)
    for s in lbs.synthesize(tube_rig, 3, random_state=3, n_points=8000, density=0.0, holes=0):
        y = s.points[:, 1]
        keep = rng.random(len(y)) < np.where(y > np.median(y), 1.0, 0.3)
        X = s.points / (tube_rig.size / 2)
        mean = np.linalg.norm(X.mean(axis=0) - X[keep].mean(axis=0))
        position = slice(-9, -6)
        seen = _describe(s.points, tube_rig)[keep, position] - _describe(s.points[keep], tube_rig)[:, position]
        assert mean > 0.1
        assert np.linalg.norm(seen.mean(axis=0)) < 0.4 * mean


def test_clutter_far_away_is_described_without_harm(tube_rig, scan):
    far = np.vstack([scan.points, [[50.0, 0.0, 0.0]]])
    found = _describe(far, tube_rig)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:-1], _describe(scan.points, tube_rig), atol=1e-4)


@pytest.mark.parametrize("points", [[[0.0, 0, 0]], [[0.0, 0, 0], [0.0, 0, 0.1]], [[-9.0, 0, 0], [9.0, 0, 0]]])
def test_few_points_are_described_too(points):
    assert np.isfinite(Descriptor()(np.array(points))).all()


# ---- training ----


def test_it_learns_the_parts(tube_fitter, tube_rig):
    for s in lbs.synthesize(tube_rig, 3, random_state=77):
        proba = tube_fitter.segmenter_.predict_proba(s.points)
        assert proba.shape == (len(s.points), 4)
        np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-5)
        assert (proba >= 0).all()
        found = tube_fitter.segmenter_.predict(s.points)
        np.testing.assert_array_equal(found, proba.argmax(axis=1))
        assert (found == s.labels).mean() > 0.75


def test_a_seed_trains_the_same_segmenter(tube_rig, small, scan):
    np.testing.assert_array_equal(_train(tube_rig).predict_proba(scan.points), small.predict_proba(scan.points))
    assert not np.array_equal(_train(tube_rig, seed=1).predict_proba(scan.points), small.predict_proba(scan.points))


def test_training_leaves_its_scans_alone(tube_rig):
    scans = _scans(tube_rig, 2)
    kept = [(p.copy(), y.copy()) for p, y, _ in scans]
    train_segmenter(tube_rig, scans, points_per_scan=20, random_state=0)
    for (p, y, _), (q, z) in zip(scans, kept):
        np.testing.assert_array_equal(p, q)
        np.testing.assert_array_equal(y, z)


def test_predicting_leaves_the_points_alone(small, scan):
    kept = scan.points.copy()
    small.predict_proba(scan.points)
    np.testing.assert_array_equal(scan.points, kept)


def test_the_scans_scale_is_taken_out(small, scan):
    np.testing.assert_allclose(small.predict_proba(1000 * scan.points, scale=1000.0), small.predict_proba(scan.points), atol=2e-3)


def test_rows_are_a_choice_of_points(small, scan):
    rows = np.arange(0, 1000, 7)
    np.testing.assert_allclose(small.predict_proba(scan.points, rows=rows), small.predict_proba(scan.points)[rows], atol=1e-6)


def _in_parts(parts):
    return build_rig(replace(make_tube_data(), partitions={"few": parts}), parts="few")


ONE = {"all": ("root",)}
TWO = {"arm": ("root",), "fingers": ("long", "short")}


@pytest.mark.parametrize("parts", [ONE, TWO])
def test_rigs_of_one_and_two_parts(tmp_path, parts, scan):
    rig = _in_parts(parts)
    assert rig.parts == tuple(parts)
    s = _train(rig)
    proba = s.predict_proba(scan.points)
    assert proba.shape == (len(scan.points), len(parts))
    np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-5)
    s.save(tmp_path / "s.npz")
    np.testing.assert_array_equal(Segmenter.load(tmp_path / "s.npz").predict_proba(scan.points), proba)


def test_a_part_that_no_scan_shows_is_never_found(tube_rig, scan):
    scans = [(p[y != 1], y[y != 1], 1.0) for p, y, _ in _scans(tube_rig, 2)]
    proba = train_segmenter(tube_rig, scans, points_per_scan=20, random_state=0).predict_proba(scan.points)
    assert proba.shape == (len(scan.points), 4)
    assert (proba[:, 1] == 0).all() and (proba[:, [0, 2, 3]].max(axis=0) > 0).all()


def test_it_belongs_to_one_rig(small, tube_rig):
    small.check_rig(tube_rig)
    small.check_rig(make_tube_rig())
    data = make_tube_data()
    others = [
        tube_rig.with_parts("arm and fingers"),
        tube_rig.scaled(2.0),
        build_rig(replace(data, upper=data.upper + 0.1)),
        build_rig(replace(data, vertices=data.vertices * [1, 1, 1.1])),
    ]
    for other in others:
        with pytest.raises(InputError, match="segmenter: got one that was trained on another rig.*pretrain"):
            small.check_rig(other)


# ---- files ----


@pytest.fixture
def saved(small, tmp_path):
    small.save(tmp_path / "s.npz")
    return tmp_path / "s.npz"


def _arrays(path):
    with np.load(path, allow_pickle=False) as z:
        return {k: z[k] for k in z.files}


def test_loaded_is_bit_equal(small, saved, scan):
    again = Segmenter.load(saved)
    np.testing.assert_array_equal(again.predict_proba(scan.points), small.predict_proba(scan.points))
    assert (again.rig_digest, again.n_parts, again.half, again.descriptor) == (
        small.rig_digest,
        small.n_parts,
        small.half,
        small.descriptor,
    )


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
        {"mean": None},
        {"deviation": None},
        {"classes": None},
        {"intercepts_0": None},
        {"lbsfit_np_segmenter": None},
        {"lbsfit_np_segmenter": np.array("{")},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 1}))},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 999}))},
        {"mean": np.array([{"an": "object"}], dtype=object)},
    ],
)
def test_a_file_that_lacks_something_is_one_clear_error(saved, changes):
    _rewritten(saved, **changes)
    with pytest.raises(FileError, match=r"s\.npz"):
        Segmenter.load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"mean": np.zeros(3, np.float32)},
        {"classes": np.array([0, 1, 2, 9])},
        {"classes": np.array([0, 1])},
        {"coefs_0": np.zeros((4, 4), np.float32)},
    ],
)
def test_arrays_that_do_not_fit_together_are_one_clear_error(saved, changes):
    _rewritten(saved, **changes)
    with pytest.raises(FileError, match=r"s\.npz"):
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
    members["mean.npy"] = trap.getvalue()
    with zipfile.ZipFile(saved, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError):
        Segmenter.load(saved)
    saved.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(FileError):
        Segmenter.load(saved)
    assert not (tmp_path / "sprung").exists()


# ---- the cache ----


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_MEMORY", {})
    return tmp_path / "cache"


class Trainer:
    """Trains nothing, and counts how often it was asked to."""

    def __init__(self, segmenter):
        self.segmenter, self.calls = segmenter, 0

    def __call__(self):
        self.calls += 1
        return self.segmenter


def test_the_cache_trains_once(empty_cache, small, scan):
    train = Trainer(small)
    first = cache.cached_segmenter(("a", 1), train)
    assert cache.cached_segmenter(("a", 1), train) is first and train.calls == 1
    assert len(list(empty_cache.iterdir())) == 1
    cache._MEMORY.clear()  # another process
    again = cache.cached_segmenter(("a", 1), train)
    assert train.calls == 1
    np.testing.assert_array_equal(again.predict_proba(scan.points), small.predict_proba(scan.points))
    cache.cached_segmenter(("a", 2), train)
    assert train.calls == 2
    assert len(list(empty_cache.iterdir())) == 2


def test_the_folder_is_the_users_to_choose(monkeypatch, tmp_path):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "mine"))
    assert cache.cache_folder() == tmp_path / "mine"
    monkeypatch.delenv("LBSFIT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "lbsfit_np"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / ".cache" / "lbsfit_np"


@pytest.mark.parametrize("broken", [b"", b"not a zip"])
def test_a_broken_file_in_the_cache_is_trained_again(empty_cache, small, broken):
    train = Trainer(small)
    cache.cached_segmenter("key", train)
    (file,) = empty_cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(broken)
    cache._MEMORY.clear()
    cache.cached_segmenter("key", train)
    assert train.calls == 2
    assert file.read_bytes() == whole


def test_a_cache_that_cannot_be_made_is_no_error(empty_cache, small):
    empty_cache.write_text("a file where the folder should be")
    train = Trainer(small)
    assert cache.cached_segmenter("key", train) is small
    assert cache.cached_segmenter("key", train) is small and train.calls == 1


def test_a_cache_that_cannot_be_written_to_is_no_error(empty_cache, small, monkeypatch):
    import os

    empty_cache.mkdir()

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    assert cache.cached_segmenter("key", Trainer(small)) is small


def test_pretraining_uses_the_cache_when_asked(empty_cache, tube_rig, scan):
    def fitter(**changes):
        return lbs.LBSFitter(tube_rig, **{"training_scans": 2, "training": {"n_points": 200}, "random_state": 0, **changes})

    a = fitter().pretrain(cache=True)
    assert len(list(empty_cache.iterdir())) == 1
    cache._MEMORY.clear()

    def no_progress(indices):
        raise AssertionError("trained again")

    b = fitter().pretrain(cache=True, progress=no_progress)
    np.testing.assert_array_equal(a.segmenter_.predict_proba(scan.points), b.segmenter_.predict_proba(scan.points))
    for changes in ({"random_state": 1}, {"training_scans": 3}, {"training": {"n_points": 300}}):
        with pytest.raises(AssertionError, match="trained again"):
            fitter(**changes).pretrain(cache=True, progress=no_progress)
    with pytest.raises(AssertionError, match="trained again"):
        lbs.LBSFitter(
            tube_rig.with_parts("arm and fingers"), training_scans=2, training={"n_points": 200}, random_state=0
        ).pretrain(cache=True, progress=no_progress)
    with pytest.raises(AssertionError, match="trained again"):
        fitter().pretrain(progress=no_progress)
