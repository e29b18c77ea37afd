"""Starts without labels: poses that look like a scan, and the regressor f."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.segmentation.descriptors import describe_scan
from lbsfit_np.starts.library import PoseLibrary, build_library


@pytest.fixture(scope="module")
def scans(tube_rig):
    return lbs.synthesize(tube_rig, 660, random_state=2, n_points=500)


@pytest.fixture(scope="module")
def library(tube_rig, scans):
    half = tube_rig.size / 2
    looks = np.array([describe_scan(s.points / half) for s in scans[:600]])
    return build_library(looks, np.array([s.pose for s in scans[:600]]), random_state=0)


def _joints_away(rig, pose, scan):
    """Mean distance of the joints from the scan's, of the rig's own template, in half sizes."""
    return np.linalg.norm(rig.pose_joints(pose) - rig.pose_joints(scan.pose), axis=1).mean() / (rig.size / 2)


def test_nearest_poses_are_near(tube_rig, library, scans):
    half = tube_rig.size / 2
    near, random = [], []
    for k, s in enumerate(scans[600:]):
        poses = library.nearest(s.points / half, 6)
        assert poses.shape == (6, 4, 3)
        near.append(_joints_away(tube_rig, poses[0], s))
        random.append(_joints_away(tube_rig, library.poses[k], s))
    assert np.mean(near) < 0.6 * np.mean(random)


def test_a_scan_of_the_library_is_its_own_nearest(tube_rig, library, scans):
    half = tube_rig.size / 2
    for s in scans[:5]:
        np.testing.assert_array_equal(library.nearest(s.points / half, 1)[0], s.pose)
    all_of_them = library.nearest(scans[0].points / half, 10_000)
    assert all_of_them.shape == library.poses.shape


def test_f_is_better_than_the_mean_pose_on_scans_that_it_has_not_seen(tube_rig, library, scans):
    half, mean = tube_rig.size / 2, library.poses.mean(axis=0)
    found, plain, joints, plain_joints = [], [], [], []
    for s in scans[600:]:
        pose = library.regress(s.points / half)
        assert pose.shape == (4, 3) and pose.dtype == np.float64
        found.append(((pose - s.pose) ** 2).mean())
        plain.append(((mean - s.pose) ** 2).mean())
        joints.append(_joints_away(tube_rig, pose, s))
        plain_joints.append(_joints_away(tube_rig, mean, s))
    assert np.mean(found) < 0.6 * np.mean(plain)
    assert np.mean(joints) < 0.5 * np.mean(plain_joints)


def test_f_is_the_network_that_was_trained(library, scans, tube_rig):
    """The layers written out, against the loss they were trained with: on its own scans f errs little."""
    half = tube_rig.size / 2
    own = np.mean([((library.regress(s.points / half) - s.pose) ** 2).mean() for s in scans[:100]])
    spread = library.poses.var(axis=0).mean()
    assert own < 0.2 * spread
    assert len(library.layers) == 3 and library.layers[0][0].shape[0] == library.looks.shape[1]


def test_arrays_there_and_back(library, scans, tube_rig):
    arrays = library.arrays("model_library")
    assert all(key.startswith("model_library_") and a.dtype.kind == "f" for key, a in arrays.items())
    again = PoseLibrary.from_arrays(arrays | {"other_weights_0": np.zeros(3)}, "model_library")
    x = scans[600].points / (tube_rig.size / 2)
    np.testing.assert_array_equal(again.regress(x), library.regress(x))
    np.testing.assert_array_equal(again.nearest(x, 3), library.nearest(x, 3))
    with pytest.raises(KeyError):
        PoseLibrary.from_arrays({k: a for k, a in arrays.items() if k != "model_library_bias_1"}, "model_library")


def test_a_seed_decides_f(library):
    small = library.looks[:40], library.poses[:40]
    a, b, c = (build_library(*small, random_state=seed) for seed in (0, 0, 1))
    for x, y in zip(a.arrays("l").values(), b.arrays("l").values()):
        np.testing.assert_array_equal(x, y)
    assert not np.array_equal(a.layers[0][0], c.layers[0][0])


def test_a_library_of_few_scans(library):
    few = build_library(library.looks[:3], library.poses[:3], random_state=0)
    assert np.isfinite(few.layers[-1][1]).all()


# ---- the look of a scan ----


def test_the_look_does_not_depend_on_order_or_place(tube_rig, scans):
    x = scans[0].points / (tube_rig.size / 2)
    look = describe_scan(x)
    assert look.shape == (384,) and look.dtype == np.float32 and (look >= 0).all()
    np.testing.assert_allclose(describe_scan(x[np.random.default_rng(0).permutation(len(x))]), look, atol=1e-5)
    for shift in ([0.5, 0.0, 0.0], [10.0, -3.3, 7.1], [0.01, 0.02, 0.03]):
        np.testing.assert_allclose(describe_scan(x + shift), look, atol=1e-4)


def test_the_look_depends_on_the_pose_more_than_on_the_points(tube_rig, scans):
    half, rng = tube_rig.size / 2, np.random.default_rng(0)
    x = scans[0].points / half
    thinned = x[rng.choice(len(x), 300, replace=False)]
    others = [np.linalg.norm(describe_scan(s.points / half) - describe_scan(x)) for s in scans[1:20]]
    assert np.linalg.norm(describe_scan(thinned) - describe_scan(x)) < 0.3 * np.min(others)


def test_the_look_measures_distances():
    """Points all in one place: each basis point is as far away as it is from the origin."""
    look = describe_scan(np.tile([1.0, 2.0, 3.0], (10, 1)))
    np.testing.assert_allclose(look, np.geomspace(0.15, 1.1, 384), atol=1e-5)
