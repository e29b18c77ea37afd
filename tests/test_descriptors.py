"""Descriptors of points: what they do not see, and what they do."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from segmenter_training import describe

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.segmentation.descriptors import Descriptor, VoxelGrid, within_reach


def test_a_row_a_point(tube_rig, tube_scan):
    found = describe(tube_scan.points, tube_rig)
    assert found.shape == (len(tube_scan.points), Descriptor().size)
    assert np.isfinite(found).all()
    rows = np.array([5, 3, 900])
    np.testing.assert_array_equal(describe(tube_scan.points, tube_rig, rows=rows), found[rows])


def test_the_order_of_the_points_does_not_matter(tube_rig, tube_scan):
    order = np.random.default_rng(0).permutation(len(tube_scan.points))
    found = describe(tube_scan.points, tube_rig)
    np.testing.assert_allclose(describe(tube_scan.points[order], tube_rig), found[order], atol=1e-5)


@pytest.mark.parametrize("shift", [[0.5, 1.0, -1.5], [0.013, 0.2, -0.4], [100.0, -30.0, 7.0], [1e5, -2e5, 3e5]])
def test_where_the_scan_stands_does_not_matter(tube_rig, tube_scan, shift):
    away = np.abs(describe(tube_scan.points + shift, tube_rig) - describe(tube_scan.points, tube_rig))
    assert away.max() < 1e-4


def test_the_description_has_a_unit(tube_rig, tube_scan):
    """Half sizes of the rig: a scan in millimetres of a rig in metres is described the same."""
    in_mm = tube_rig.scaled(1000.0)
    np.testing.assert_allclose(describe(1000 * tube_scan.points, in_mm), describe(tube_scan.points, tube_rig), atol=1e-4)
    far = np.abs(describe(1.3 * tube_scan.points, tube_rig) - describe(tube_scan.points, tube_rig))
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
        seen = describe(s.points, tube_rig)[keep, position] - describe(s.points[keep], tube_rig)[:, position]
        assert mean > 0.1
        assert np.linalg.norm(seen.mean(axis=0)) < 0.4 * mean


def test_clutter_far_away_is_described_without_harm(tube_rig, tube_scan):
    far = np.vstack([tube_scan.points, [[50.0, 0.0, 0.0]]])
    found = describe(far, tube_rig)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:-1], describe(tube_scan.points, tube_rig), atol=1e-4)


@pytest.mark.parametrize("points", [[[0.0, 0, 0]], [[0.0, 0, 0], [0.0, 0, 0.1]], [[-9.0, 0, 0], [9.0, 0, 0]]])
def test_few_points_are_described_too(points):
    assert np.isfinite(Descriptor()(np.array(points))).all()


def test_points_that_are_all_far_from_each_other_take_no_memory():
    """Two of them are equally far from their median: one is kept, not all that lies between."""
    points = np.array([[0.0, 0.0, 0.0], [100.0, 100.0, 100.0]])
    np.testing.assert_array_equal(within_reach(points), [True, False])
    assert np.isfinite(Descriptor()(points)).all()


def test_probes_are_looked_up_within_a_voxel(tube_rig, tube_scan):
    """Of queries near the scan and beyond its grid, along each axis, whatever their shape."""
    scan, rng = tube_scan.points / (tube_rig.size / 2), np.random.default_rng(0)
    grid = VoxelGrid(scan, 0.05)
    scan = scan - grid.centre
    queries = np.concatenate([scan[:100] + rng.normal(0, 0.1, (100, 3)), 3.0 * np.concatenate([np.eye(3), -np.eye(3)])])
    found = grid.distance(*queries.T.astype(np.float32))
    np.testing.assert_allclose(found, cKDTree(scan).query(queries)[0], atol=0.05 * 3**0.5)
    again = grid.distance(*queries[:104].T.astype(np.float32).reshape(3, 8, 13))
    np.testing.assert_array_equal(again.ravel(), found[:104])


@pytest.mark.parametrize(
    "name, value",
    [("n_probes", 0), ("n_basis", 9.5), ("nearest", 0.0), ("farthest", 0.04), ("voxel", -0.05), ("voxel", 1e-4), ("voxel", True)],
)
def test_a_descriptor_that_cannot_be(name, value):
    """Of voxels smaller still a grid would fill the memory."""
    with pytest.raises(InputError, match=f"^{name}: got {value}; expected a .*number"):
        Descriptor(**{name: value})
