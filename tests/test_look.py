"""The look of a scan: one vector whatever the points, the place and the unit; under a turn, that of the scan turned back."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.segmentation.descriptors import directions
from lbsfit_np.starts.look import LOOK_SIZE, look

SHIFTS = ([0.5, 0.0, 0.0], [10.0, -3.3, 7.1], [0.01, 0.02, 0.03])


@pytest.fixture(scope="module")
def scans(tube_rig):
    return lbs.synthesize(tube_rig, 20, random_state=2, n_points=500)


@pytest.fixture(scope="module")
def x(scans):
    return scans[0].points


def _away(a, b):
    return np.linalg.norm(look(a).vectors - look(b).vectors)


def test_order_does_not_matter(x):
    seen = look(x)
    assert seen.vectors.shape == (1, LOOK_SIZE) and seen.vectors.dtype == np.float32 and (seen.vectors >= 0).all()
    mixed = look(x[np.random.default_rng(0).permutation(len(x))])
    np.testing.assert_allclose(mixed.vectors, seen.vectors, atol=1e-5)
    assert mixed.radius == pytest.approx(seen.radius, rel=1e-9)


@pytest.mark.parametrize("shift", SHIFTS)
def test_place_does_not_matter(x, shift):
    seen, moved = look(x), look(x + shift)
    np.testing.assert_allclose(moved.vectors, seen.vectors, atol=1e-4)
    assert moved.radius == pytest.approx(seen.radius, rel=1e-6)


@pytest.mark.parametrize("unit", [1e-3, 0.0254, 39.37, 1000.0, 1e6])
def test_the_unit_does_not_matter(x, unit):
    seen, other = look(x), look(unit * x)
    np.testing.assert_allclose(other.vectors, seen.vectors, atol=1e-4)
    assert other.radius / seen.radius == pytest.approx(unit, rel=1e-6)


def test_far_from_the_origin_it_is_the_same(x):
    far = np.array([4e6, -7e5, 2e6])  # as in a national grid, millimetres apart
    seen, moved = look(x), look(x + far)
    np.testing.assert_allclose(moved.vectors, seen.vectors, atol=1e-3)


def test_the_pose_matters_more_than_the_points(scans, x):
    thinned = x[np.random.default_rng(0).choice(len(x), 300, replace=False)]
    assert _away(thinned, x) < 0.3 * min(_away(s.points, x) for s in scans[1:])


def test_a_few_wild_points_matter_less_than_the_pose(scans, x):
    wild = np.vstack([x, np.random.default_rng(0).uniform(-30, 30, (4, 3))])
    assert _away(wild, x) < 0.5 * np.median([_away(s.points, x) for s in scans[1:]])


@pytest.mark.parametrize("seed", range(3))
def test_under_a_turn_it_is_the_look_of_the_scan_turned_back(scans, x, seed):
    rng = np.random.default_rng(seed)
    turns = matrix_from_rotvec(rng.uniform(-2, 2, (5, 3)))
    seen = look(x, turns)
    assert seen.vectors.shape == (5, LOOK_SIZE)
    for row, turn in zip(seen.vectors, turns):
        alone = look(x, turn[None])
        np.testing.assert_array_equal(alone.vectors[0], row)
        back = look(x @ turn)
        assert np.abs(back.vectors[0] - row).mean() < 0.04  # half a voxel: voxels do not turn
        assert np.linalg.norm(back.vectors[0] - row) < 0.4 * min(_away(s.points, x) for s in scans[1:])
        assert back.radius == pytest.approx(seen.radius, rel=0.03)


def test_the_radius_is_the_points_own(x):
    middle = x - x.mean(axis=0)
    assert look(x).radius == pytest.approx(np.sqrt((middle**2).sum(axis=1).mean()), rel=0.1)


def test_it_measures_distances():
    """On a sphere of radius 1 each basis point is as far from the surface as its own distance from the centre tells."""
    sphere = directions(20_000, 5)
    seen = look(sphere)
    expected = np.abs(np.geomspace(0.25, 2.4, LOOK_SIZE) - 1.0)
    assert seen.radius == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(seen.vectors[0], expected, atol=0.09)  # a voxel is 0.08 wide


def test_an_extent_without_width_is_no_error():
    line = np.zeros((50, 3))
    line[:, 1] = np.linspace(0, 1e-3, 50)
    seen = look(line)
    assert np.isfinite(seen.vectors).all() and seen.radius > 0
    two = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.isfinite(look(two).vectors).all()
