"""Starts without labels: poses that look like a scan under some turn and in some unit, and the regressor f."""

import signal
from dataclasses import dataclass, replace

import numpy as np
import pytest
from sklearn.neural_network import MLPRegressor

import lbsfit_np as lbs
from lbsfit_np.errors import FileError
from lbsfit_np.learning.training import StartScans
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.segmentation import cache
from lbsfit_np.starts.library import PoseLibrary, build_library
from lbsfit_np.starts.look import LOOK_SIZE, look
from lbsfit_np.starts.turns import facing_of
from lbsfit_np.synthesis import Synthesis

pytestmark = pytest.mark.usefixtures("one_thread")

N = 600


@dataclass(frozen=True)
class Kept:
    """i → scan i of a list; picklable."""

    scans: list

    def __call__(self, i):
        return self.scans[i]


@pytest.fixture(scope="module")
def scans(tube_rig):
    return lbs.synthesize(tube_rig, N + 60, random_state=2, n_points=500)


@pytest.fixture(scope="module")
def library(scans):
    return build_library(Kept(scans), N, random_state=0)


def _joints_away(rig, pose, scan):
    """Mean distance of the joints from the scan's, of the rig's own template, in half sizes."""
    return np.linalg.norm(rig.pose_joints(pose) - rig.pose_joints(scan.pose), axis=1).mean() / (rig.size / 2)


# ---- poses that look alike ----


def test_nearest_poses_are_near(tube_rig, library, scans):
    near, random = [], []
    for k, s in enumerate(scans[N:]):
        poses = library.nearest(s.points, 6)
        assert poses.shape == (6, 4, 3)
        near.append(_joints_away(tube_rig, poses[0], s))
        random.append(_joints_away(tube_rig, library.poses[k], s))
    assert np.mean(near) < 0.6 * np.mean(random)


def test_a_scan_of_the_library_is_its_own_nearest(library, scans):
    for s in scans[:5]:
        np.testing.assert_array_equal(library.nearest(s.points, 1)[0], s.pose)
        start = library.starts(s.points, np.eye(3)[None], 3)[0]
        assert start.turn == 0 and start.scale == pytest.approx(1.0) and start.away == pytest.approx(0.0, abs=1e-2)
    all_of_them = library.nearest(scans[0].points, 10_000)
    assert all_of_them.shape == library.poses.shape


@pytest.mark.parametrize("orientation, k", [("upright", 7), ("any", 333)])
@pytest.mark.parametrize("factor, shift", [(1.0, 0.0), (1000.0, 0.0), (0.0254, 3.0), (7.7, [1e3, -2e3, 50.0])])
def test_the_turn_and_the_unit_of_a_scan_are_told(tube_rig, library, scans, orientation, k, factor, shift):
    """A scan of the library, turned, moved, and in another unit, is found as itself, with its turn and its unit."""
    turns = facing_of(tube_rig, orientation).turns
    s = scans[3]
    start = library.starts(factor * s.points @ turns[k].T + shift, turns, 4)[0]
    np.testing.assert_array_equal(start.theta, s.pose)
    assert start.turn == k and start.scale / s.scale == pytest.approx(factor, rel=0.02)  # voxels do not turn along


def test_starts_are_sorted_and_come_once_under_one_turn(tube_rig, library, scans):
    turns, binding = facing_of(tube_rig, "upright").turns, 0
    for scan in scans[N : N + 6]:
        points = scan.points @ turns[5].T
        starts = library.starts(points, turns, 12)
        assert len(starts) == 12 and (np.diff([s.away for s in starts]) >= 0).all()
        assert len({s.theta.tobytes() for s in starts}) == 12
        assert max(np.bincount([s.turn for s in starts])) <= 4  # a third
        binding += max(np.bincount([s.turn for s in library.starts(points, turns, N)[:12]])) > 4
    assert binding
    alone = library.starts(scans[N].points, np.eye(3)[None], 12)
    assert len(alone) == 12 and {s.turn for s in alone} == {0}


def test_distances_of_looks_are_what_starts_are_sorted_by(library, scans):
    seen = look(scans[N].points).vectors[0]
    expected = np.sort(((library.looks - seen) ** 2).sum(axis=1))[:5]
    found = [s.away for s in library.starts(scans[N].points, np.eye(3)[None], 5)]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


def test_in_a_known_unit_only_poses_of_that_size_are_taken(library, scans):
    points, none = scans[N].points, np.eye(3)[None]
    for unit, factor in ((1.0, 1.0), (1000.0, 1000.0)):
        starts = library.starts(factor * points, none, 20, unit=unit)
        assert len(starts) == 20 and all(1 / 1.35 < s.scale / unit < 1.35 for s in starts)
    scales = np.array([s.scale for s in library.starts(points, none, N)])
    assert len(scales) == N
    small = np.sort(scales)[-7:]  # the smallest poses need the largest scale
    unit = 1.35 * (small[0] + np.sort(scales)[-8]) / 2
    some = library.starts(points, none, 7, unit=unit)
    assert {s.scale for s in some} == set(small)


def test_a_scan_of_no_poses_size_has_starts_all_the_same(library, scans):
    points, none = scans[N].points, np.eye(3)[None]
    scales = np.sort([s.scale for s in library.starts(points, none, N)])
    for unit, nearest in ((1e6, scales[-5:]), (1e-6, scales[:5])):
        assert {s.scale for s in library.starts(points, none, 5, unit=unit)} == set(nearest)


# ---- f ----


def test_f_is_better_than_the_mean_pose_on_scans_that_it_has_not_seen(tube_rig, library, scans):
    mean = library.poses.mean(axis=0)
    found, plain, joints, plain_joints = [], [], [], []
    for s in scans[N:]:
        pose = library.regress(s.points)
        assert pose.shape == (4, 3) and pose.dtype == np.float64
        found.append(((pose - s.pose) ** 2).mean())
        plain.append(((mean - s.pose) ** 2).mean())
        joints.append(_joints_away(tube_rig, pose, s))
        plain_joints.append(_joints_away(tube_rig, mean, s))
    assert np.mean(found) < 0.6 * np.mean(plain)
    assert np.mean(joints) < 0.5 * np.mean(plain_joints)


def test_f_is_the_network_that_was_trained(library, scans):
    """The layers written out, against the loss they were trained with: on its own scans f errs little."""
    own = np.mean([((library.regress(s.points) - s.pose) ** 2).mean() for s in scans[:100]])
    spread = library.poses.var(axis=0).mean()
    assert own < 0.2 * spread
    assert len(library.layers) == 3 and library.layers[0][0].shape[0] == library.looks.shape[1] == LOOK_SIZE


@pytest.mark.parametrize("most, epochs", [(40, 60), (20, 30), (10, 15), (0.1, 1)])
def test_f_takes_no_more_steps_for_more_scans(scans, monkeypatch, most, epochs):
    taken, fit = [], MLPRegressor.fit
    monkeypatch.setattr(MLPRegressor, "fit", lambda f, *given: taken.append(f) or fit(f, *given))
    monkeypatch.setattr("lbsfit_np.starts.library._SO_MANY", most)
    assert build_library(Kept(scans[:40]), 40, random_state=0).layers
    assert [f.n_iter_ for f in taken] == [epochs]


def test_f_does_not_depend_on_unit_or_place(library, scans):
    for s in scans[N : N + 5]:
        np.testing.assert_allclose(library.regress(1000 * s.points + 5.0), library.regress(s.points), atol=2e-3)


# ---- building ----


def test_what_a_library_keeps_is_the_scans(library, scans):
    np.testing.assert_array_equal(library.poses, [s.pose for s in scans[:N]])
    for k in (0, 17):
        seen = look(scans[k].points)
        np.testing.assert_array_equal(library.looks[k], seen.vectors[0])
        assert library.radii[k] == seen.radius / scans[k].scale


def test_a_scan_of_another_size_has_its_radius_in_rig_units(scans):
    doubled = [replace(s, points=2 * s.points, scale=2 * s.scale) for s in scans[:6]]
    a, b = (build_library(Kept(some), 6, random_state=0) for some in (scans[:6], doubled))
    np.testing.assert_allclose(a.radii, b.radii, rtol=1e-12)
    np.testing.assert_allclose(a.looks, b.looks, atol=1e-5)


def test_a_seed_decides_f(scans):
    a, b, c = (build_library(Kept(scans[:40]), 40, random_state=seed) for seed in (0, 0, 1))
    for x, y in zip(a.arrays("l").values(), b.arrays("l").values()):
        np.testing.assert_array_equal(x, y)
    assert not np.array_equal(a.layers[0][0], c.layers[0][0])


def test_processes_change_nothing(tube_rig):
    made = StartScans(tube_rig, Synthesis(n_points=200), 3)
    seen = []
    a = build_library(made, 30, random_state=0, progress=seen.append)
    b = build_library(made, 30, random_state=0, jobs=2)
    for x, y in zip(a.arrays("l").values(), b.arrays("l").values()):
        np.testing.assert_array_equal(x, y)
    assert seen[-1] == 1.0 and (np.diff(seen) > 0).all()


def test_a_library_of_few_scans(scans):
    few = build_library(Kept(scans[:3]), 3, random_state=0)
    assert np.isfinite(few.layers[-1][1]).all()
    assert len(few.starts(scans[5].points, np.eye(3)[None], 8)) == 3


class Terminated(KeyboardInterrupt):
    """What a program's own handler of SIGTERM may raise."""


def _terminate(number, frame):
    raise Terminated


@pytest.mark.parametrize(
    "raised, by_signal", [(KeyboardInterrupt, signal.SIGINT), (Terminated, signal.SIGTERM), (KeyboardInterrupt, None)]
)
def test_ctrl_c_in_the_middle_of_training_is_no_library(raised, by_signal, scans, tmp_path, monkeypatch):
    """scikit-learn's networks catch KeyboardInterrupt and return as if the training were complete."""
    from sklearn.neural_network import _multilayer_perceptron as mlp

    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_MEMORY", {})
    batches, calls = mlp.gen_batches, []

    def gen_batches(*arguments):
        calls.append(1)
        if len(calls) == 3:
            if by_signal is None:
                raise KeyboardInterrupt  # as another thread can raise here
            signal.raise_signal(by_signal)
        return batches(*arguments)

    monkeypatch.setattr(mlp, "gen_batches", gen_batches)
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _terminate}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        with pytest.raises(raised):
            cache.cached("library", "key", lambda: build_library(Kept(scans), 20, random_state=0), PoseLibrary.load)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert len(calls) == 3 and not cache._MEMORY and not list(tmp_path.iterdir())


def test_scans_for_starts_face_the_rigs_way_and_half_are_natural():
    rig = lbs.load_rig("hand-coarse")
    made = StartScans(rig, Synthesis(n_points=50), 0)
    natural = np.stack(list(rig.poses.values()))[:, 1:]
    away = [np.sqrt(((made(i).pose[1:] - natural) ** 2).mean(axis=(1, 2))).min() for i in range(12)]
    assert max(away[1::2]) < 0.25 < np.median(away[::2])
    poses = np.array([made(i).pose[rig.root] for i in range(0, 12, 2)])
    assert ((poses >= rig.lower[rig.root]) & (poses <= rig.upper[rig.root])).all()
    np.testing.assert_array_equal(made(7).points, StartScans(rig, Synthesis(n_points=50), 0)(7).points)
    assert not np.array_equal(made(7).pose, made(9).pose)


def test_a_rig_without_natural_poses_has_starts_within_its_limits(tube_rig):
    for i in range(4):
        pose = StartScans(tube_rig, Synthesis(n_points=50), 0)(i).pose
        assert ((pose >= tube_rig.lower) & (pose <= tube_rig.upper)).all()


# ---- files ----


def test_arrays_there_and_back(library, scans):
    arrays = library.arrays("model_library")
    assert all(key.startswith("model_library_") and a.dtype.kind == "f" for key, a in arrays.items())
    again = PoseLibrary.from_arrays(arrays | {"other_weights_0": np.zeros(3)}, "model_library")
    _assert_same(again, library, scans[N].points)
    with pytest.raises(KeyError):
        PoseLibrary.from_arrays({k: a for k, a in arrays.items() if k != "model_library_bias_1"}, "model_library")


def test_files_there_and_back(library, scans, tmp_path):
    library.save(tmp_path / "library.npz")
    with np.load(tmp_path / "library.npz", allow_pickle=False) as file:
        assert {"library_looks", "library_radii", "library_poses", "library_mean", "library_weights_0"} <= set(file.files)
    _assert_same(PoseLibrary.load(tmp_path / "library.npz"), library, scans[N].points)


def _assert_same(a, b, points):
    turns = np.array([np.eye(3), matrix_from_rotvec(np.array([0.0, 1.0, 0.0]))])
    np.testing.assert_array_equal(a.regress(points), b.regress(points))
    for x, y in zip(a.starts(points, turns, 5), b.starts(points, turns, 5), strict=True):
        assert (x.turn, x.scale, x.away) == (y.turn, y.scale, y.away)
        np.testing.assert_array_equal(x.theta, y.theta)


def _without(key):
    return lambda arrays: arrays.pop(key)


BROKEN = {
    "no looks": _without("library_looks"),
    "no layer": lambda arrays: [arrays.pop(k) for k in [*arrays] if "weights" in k or "bias" in k],
    "a layer too few": _without("library_weights_2"),
    "fewer poses": lambda arrays: arrays.update(library_poses=arrays["library_poses"][:-1]),
    "no poses": lambda arrays: arrays.update({f"library_{k}": arrays[f"library_{k}"][:0] for k in ("looks", "radii", "poses")}),
    "fewer radii": lambda arrays: arrays.update(library_radii=arrays["library_radii"][:-1]),
    "another joint": lambda arrays: arrays.update(library_poses=arrays["library_poses"][:, :-1]),
    "short looks": lambda arrays: arrays.update(library_looks=arrays["library_looks"][:, :-1]),
    "flat poses": lambda arrays: arrays.update(library_poses=arrays["library_poses"].reshape(N, -1)),
    "a long bias": lambda arrays: arrays.update(library_bias_1=np.zeros(7, np.float32)),
    "a table of radii": lambda arrays: arrays.update(library_radii=arrays["library_radii"][:, None]),
    "radii of 0": lambda arrays: arrays.update(library_radii=0 * arrays["library_radii"]),
    "deviations of 0": lambda arrays: arrays.update(library_deviation=0 * arrays["library_deviation"]),
    "a mean of another length": lambda arrays: arrays.update(library_mean=np.zeros(3, np.float32)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_named(name, library, tmp_path):
    arrays = library.arrays("library")
    BROKEN[name](arrays)
    np.savez(tmp_path / "library.npz", **arrays)
    with pytest.raises(FileError, match="library.npz: got a file whose content does not fit.*expected a library of poses"):
        PoseLibrary.load(tmp_path / "library.npz")


def test_no_file_is_named(tmp_path):
    with pytest.raises(FileError, match=r"none.npz: got no such file"):
        PoseLibrary.load(tmp_path / "none.npz")


def test_the_cache_keeps_libraries_beside_segmenters(tube_rig, tmp_path, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_MEMORY", {})

    def fitter(rig=tube_rig, **changes):
        return lbs.LBSFitter(rig, **{"training_scans": 6, "training": {"n_points": 100}, "random_state": 0} | changes)

    first = fitter().pretrain(cache=True).regressor_
    assert sorted(p.name.partition("-")[0] for p in tmp_path.iterdir()) == ["library", "segmenter"]
    assert fitter(orientation="any", effort="fast", max_points=9).pretrain(cache=True).regressor_ is first
    cache._MEMORY.clear()  # another process
    monkeypatch.setattr("lbsfit_np.learning.pretraining.build_library", lambda *a, **k: pytest.fail("built again"))
    again = fitter().pretrain(cache=True).regressor_
    for x, y in zip(first.arrays("l").values(), again.arrays("l").values(), strict=True):
        np.testing.assert_array_equal(x, y)
    posed = replace(tube_rig, poses={"bent": np.array(0.5 * tube_rig.upper)})
    other = replace(tube_rig, poses={"bent": np.array(0.4 * tube_rig.upper)})
    changes = ({"random_state": 1}, {"training_scans": 8}, {"training": {"n_points": 100, "noise": 0.1}}, {"partial": True})
    for changed in ({"rig": posed}, *changes):
        with pytest.raises(pytest.fail.Exception, match="built again"):
            fitter(**changed).pretrain(cache=True)
    monkeypatch.undo()
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path))
    fitter(posed).pretrain(cache=True)
    monkeypatch.setattr("lbsfit_np.learning.pretraining.build_library", lambda *a, **k: pytest.fail("built again"))
    with pytest.raises(pytest.fail.Exception, match="built again"):
        fitter(other).pretrain(cache=True)  # the digest and the names are the same, the poses are not


def test_a_library_of_numbers_that_are_none_is_told_when_it_is_loaded(library, tmp_path):
    for change in (lambda a: np.full_like(a, np.nan), lambda a: a.astype(str)):
        arrays = library.arrays("library")
        for key in arrays:
            np.savez(tmp_path / "l.npz", **arrays | {key: change(arrays[key])})
            with pytest.raises(FileError, match="content does not fit"):
                PoseLibrary.load(tmp_path / "l.npz")


def test_a_library_that_is_not_there_or_called_otherwise_is_told(library, tmp_path):
    with pytest.raises(FileError, match="^[^(]*none.npz: got no such file; expected an NPZ file.$"):
        PoseLibrary.load(tmp_path / "none.npz")
    with pytest.raises(FileError, match="npz"):
        library.save(tmp_path / "library.txt")
