"""Nearest neighbours are exact: the same as brute force, whatever the labels, the distances and the offsets."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from lbsfit_np.errors import InputError
from lbsfit_np.neighbors import PointIndex, neighbour_distances, spacing


def _sets(seed, n=60, k=80, parts=4):
    rng = np.random.default_rng(seed)
    return rng.standard_normal((n, 3)), rng.integers(0, parts, n), rng.standard_normal((k, 3)), rng.integers(0, parts, k)


def _brute(points, labels, queries, asked):
    """Distance of each query to its nearest allowed point; inf where there is none."""
    d = cdist(queries, points)
    if labels is not None:
        d[asked[:, None] != labels[None, :]] = np.inf
    return d.min(axis=1)


def _check(points, labels, queries, asked, moving=False, atol=0.0):
    index = PointIndex(points, labels, moving=moving).nearest(queries, asked)
    expected = _brute(points, labels, queries, asked)
    assert index.shape == (len(queries),)
    np.testing.assert_array_equal(index < 0, np.isinf(expected))
    found = index >= 0
    assert (index[found] < len(points)).all()
    if labels is not None:
        np.testing.assert_array_equal(labels[index[found]], asked[found])
    distance = np.linalg.norm(queries[found] - points[index[found]], axis=1)
    np.testing.assert_allclose(distance, expected[found], rtol=1e-12, atol=atol)
    return index


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_all_points(seed, moving):
    points, _, queries, _ = _sets(seed)
    index = _check(points, None, queries, None, moving)
    np.testing.assert_array_equal(index, cdist(queries, points).argmin(axis=1))


@pytest.mark.parametrize("most", [4, 60000])
def test_points_in_single_precision_are_searched_in_double(most):
    points, labels, queries, asked = _sets(3)
    points, labels, asked = points.astype(np.float32), labels * (most // 4), asked * (most // 4)
    _check(points, labels, queries, asked)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_within_parts(seed, moving):
    points, labels, queries, asked = _sets(seed)
    index = _check(points, labels, queries, asked, moving)
    d = cdist(queries, points)
    d[asked[:, None] != labels] = np.inf
    np.testing.assert_array_equal(index, d.argmin(axis=1))


def test_many_parts():
    _check(*_sets(1, n=400, k=600, parts=163))


def test_parts_that_the_points_do_not_have():
    points, labels, queries, asked = _sets(2)
    labels = np.where(labels == 1, 2, labels)  # a gap in the middle; parts beyond the last are asked for, too
    index = _check(points, labels, queries, asked + 1)
    assert (index < 0).any() and (index >= 0).any()
    for part in (99, -1, -7):  # negative: of none
        assert (PointIndex(points, labels).nearest(queries, np.full(len(queries), part)) == -1).all()
    some = np.where(np.arange(len(asked)) % 3 == 0, -1, asked)
    known = PointIndex(points, labels).nearest(queries, asked)
    np.testing.assert_array_equal(PointIndex(points, labels).nearest(queries, some), np.where(some < 0, -1, known))


@pytest.mark.parametrize("far", [1e1, 1e3, 1e6, 1e12])
def test_queries_far_away_stay_in_their_part(far):
    points, labels, queries, asked = _sets(3)
    queries = queries + far * np.array([1.0, 0.2, -0.3])
    _check(points, labels, queries, asked)
    queries[::2] -= far * np.array([2.0, 0.0, 0.0])
    _check(points, labels, queries, asked)


def test_one_far_query_among_near_ones():
    points, labels, queries, asked = _sets(4)
    queries[7] = [-1e5, 3.0, 0.0]
    _check(points, labels, queries, asked)


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("far", [1e3, 1e6, 1e9, 1e12, 3e38, 1e145])
def test_a_point_far_away_leaves_the_others_their_digits(far, moving):
    """As a camera's largest number in place of no depth."""
    points, labels, queries, asked = _sets(4, n=2000, k=200, parts=20)
    points[7] = [far, -far, 0.0]
    _check(points, labels, queries, asked, moving)


@pytest.mark.parametrize("labelled", [False, True])
@pytest.mark.parametrize("offset", [1e6, -1e6])
def test_far_from_the_origin(labelled, offset):
    """Millimetres in a world frame: the distances are then exact to the coordinates' own rounding."""
    points, labels, queries, asked = _sets(5)
    shift = offset * np.array([1.0, -1.0, 0.5])
    labels, asked = (labels, asked) if labelled else (None, None)
    here, there = PointIndex(points, labels), PointIndex(points + shift, labels)
    np.testing.assert_array_equal(here.nearest(queries, asked), there.nearest(queries + shift, asked))
    _check(points + shift, labels, queries + shift, asked, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-9, 1e-3, 1e3, 1e9])
def test_any_unit(scale):
    points, labels, queries, asked = _sets(6)
    np.testing.assert_array_equal(
        PointIndex(scale * points, labels).nearest(scale * queries, asked), PointIndex(points, labels).nearest(queries, asked)
    )


def test_a_single_point():
    point, label = np.array([[0.1, 0.2, 0.3]]), np.array([2])
    queries = np.random.default_rng(0).standard_normal((5, 3))
    assert (PointIndex(point).nearest(queries) == 0).all()
    np.testing.assert_array_equal(PointIndex(point, label).nearest(queries, np.array([2, 0, 2, 1, 3])), [0, -1, 0, -1, -1])


def test_a_single_query():
    points, labels, queries, asked = _sets(7)
    _check(points, labels, queries[:1], asked[:1])


@pytest.mark.parametrize("moving", [False, True])
def test_duplicates(moving):
    points, labels, queries, asked = _sets(8)
    _check(np.repeat(points, 3, axis=0), np.repeat(labels, 3), queries, asked, moving)


def test_all_points_at_one_place_keep_their_parts():
    points, labels = np.zeros((6, 3)), np.array([0, 1, 2, 0, 1, 2])
    asked = np.array([2, 1, 0, 3])
    for queries in (np.zeros((4, 3)), np.ones((4, 3))):
        index = PointIndex(points, labels).nearest(queries, asked)
        np.testing.assert_array_equal(labels[index[:3]], asked[:3])
        assert index[3] == -1


def test_the_index_leaves_its_points_alone():
    points, labels, queries, asked = _sets(9)
    kept = points.copy(), labels.copy(), queries.copy(), asked.copy()
    PointIndex(points, labels).nearest(queries, asked)
    for a, b in zip((points, labels, queries, asked), kept):
        np.testing.assert_array_equal(a, b)


def test_labels_are_of_both_sides_or_of_none():
    points, labels, queries, asked = _sets(0)
    with pytest.raises(InputError, match="labels: got .*; expected None, as the index was made without labels"):
        PointIndex(points).nearest(queries, asked)
    with pytest.raises(InputError, match="labels: got None; expected parts of the queries, as the index was made with labels"):
        PointIndex(points, labels).nearest(queries)
    index = PointIndex(points, labels)
    np.testing.assert_array_equal(index.nearest(queries.tolist(), asked.tolist()), index.nearest(queries, asked))


@pytest.mark.parametrize("kind", ["uint8", "uint64", "int16"])
def test_labels_of_any_kind_of_whole_numbers(kind):
    points, labels, queries, asked = _sets(5)
    found = PointIndex(points, labels.astype(kind)).nearest(queries, np.maximum(asked, 0).astype(kind))
    np.testing.assert_array_equal(found, PointIndex(points, labels).nearest(queries, np.maximum(asked, 0)))


def test_spacing_goes_by_neighbours_and_does_not_feel_how_much_there_is():
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), axis=-1).reshape(-1, 3)
    for points in (grid, grid[:60]):
        assert spacing(neighbour_distances(points, 3)) == 2.0  # the third of four neighbours at a distance of one
    np.testing.assert_allclose(neighbour_distances(grid, 5)[[0, 210]], [2.0, np.sqrt(2)])
    assert spacing(neighbour_distances(grid[:3], 3)) == np.inf
