"""Scan and check_points: what they take and refuse, what stays as it is, and the thinning of points."""

import copy
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from scan_files import LABELS, NORMALS, POINTS

from lbsfit_np.errors import InputError
from lbsfit_np.scan import Scan, check_points, count_distinct, some_rows


def test_where_the_points_of_an_object_are_is_told():
    with pytest.raises(InputError, match=r"points: got a SimpleNamespace; .* Pass its vertices: \.vertices"):
        check_points(SimpleNamespace(vertices=np.eye(3)))
    with pytest.raises(InputError, match=r"expected numbers of shape \(n, 3\)\.$"):
        check_points(SimpleNamespace(vertices="none"))


def test_check_points_takes_scans_lists_and_integers():
    scan = Scan(POINTS)
    assert check_points(scan) is scan.points
    np.testing.assert_array_equal(check_points([[0, 0, 1], [2, 3, 4]]), [[0, 0, 1], [2, 3, 4]])
    assert check_points(np.array([[1, 2, 3]])).shape == (1, 3)
    large = np.array([[1e308, 1e308, 1e308], [0, 0, 0]])
    np.testing.assert_array_equal(check_points(large), large)


@pytest.mark.parametrize(
    "points, words",
    [
        ([], "cloud: got an empty cloud"),
        (np.zeros((0, 3)), "empty cloud"),
        ([1.0, 2.0, 3.0], r"shape \(3,\)"),
        (np.zeros((5, 2)), r"shape \(5, 2\)"),
        (np.zeros((5, 6)), r"points\[:, :3\]"),
        (np.zeros((3, 50)), "Transpose"),
        (np.zeros((4, 5, 3)), "organised"),
        ([["a", "b", "c"]], "numbers"),
        ([[1, 2, 3], [4, 5]], "different lengths"),
        (np.zeros((4, 3), complex), "complex"),
        ([[0, 0, 0], [1, 2, np.nan], [np.inf, 0, 0]], "2 of 3 points .*first at index 1.*drop_invalid.*--drop-invalid"),
        (np.ones((9, 3)), r"9 points that are all equal, at \(1, 1, 1\)"),
        (None, "numbers"),
        ([[10**400, 0, 0], [1, 2, 3]], "whole numbers beyond double precision"),
    ],
)
def test_check_points_refuses(points, words):
    with pytest.raises(InputError, match=words) as caught:
        check_points(points, argument="cloud")
    assert caught.value.argument == "cloud"


def test_masked_points_are_no_points():
    """Arrays forget masks, and what is masked would be fitted."""
    points = np.ma.masked_array(POINTS, np.zeros(np.shape(POINTS), dtype=bool))
    np.testing.assert_array_equal(check_points(points), POINTS)  # none is
    points[0], points[2, 1] = np.ma.masked, np.ma.masked
    for refuse in (check_points, Scan, lambda p: check_points(SimpleNamespace(points=p))):
        words = rf"points: got a masked array with 2 of {len(POINTS)} points masked; expected points without a mask. Leave masked"
        with pytest.raises(InputError, match=words):
            refuse(points)
    left = points[~np.ma.getmaskarray(points).any(axis=1)]  # as the message says
    np.testing.assert_array_equal(Scan(left).points, np.delete(POINTS, [0, 2], axis=0))
    for rows in (list(points), tuple(points)):
        with pytest.raises(InputError, match=rf"points: got a {type(rows).__name__} with 2 of {len(POINTS)} points masked"):
            check_points(rows)
    np.testing.assert_array_equal(check_points(list(left)), np.delete(POINTS, [0, 2], axis=0))
    for name, values in (("normals", NORMALS), ("labels", LABELS)):
        values = np.ma.masked_array(values, np.arange(np.size(values)).reshape(np.shape(values)) == 1)
        with pytest.raises(InputError, match=rf"{name}: got a masked array with 1 of {len(POINTS)} rows masked"):
            Scan(POINTS, **{name: values})
    with pytest.raises(InputError, match=r"shape \(3,\)"):
        check_points(np.ma.masked_array([1.0, 2, 3], [True, False, False]))


class _Frame:
    """An array in another dress, as data frames are."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype)


@pytest.mark.parametrize(
    "points",
    [
        SimpleNamespace(points=[[1, 2, 3], [4, 5]]),
        SimpleNamespace(points=[[1, 2, "a"], [4, 5, None]]),
        np.array([[1, 2, "a"]], dtype=object),
        _Frame(np.array([["a", 1, 2], ["b", 3, 4]], dtype=object)),
    ],
)
def test_what_holds_rows_is_told_by_them(points):
    with pytest.raises(InputError, match="cloud: got rows of different lengths or entries that are not numbers"):
        check_points(points, argument="cloud")
    with pytest.raises(InputError, match="cloud: got a dict; expected numbers"):
        check_points({"points": points}, argument="cloud")


@pytest.mark.parametrize("error", [TypeError, RuntimeError])
def test_what_cannot_give_its_array_says_why(error):
    """As a tensor on a graphics card, or one that wants a gradient."""

    class Tensor:
        def __array__(self, dtype=None, copy=None):
            raise error("Use Tensor.cpu() to copy the tensor to host memory first.")

    for points in (Tensor(), SimpleNamespace(points=Tensor())):
        with pytest.raises(InputError, match=r"cloud: got Tensor; expected numbers of shape \(n, 3\)\. Use Tensor\.cpu\(\)"):
            check_points(points, argument="cloud")


def test_arrays_in_another_dress_are_taken():
    np.testing.assert_array_equal(check_points(_Frame(POINTS.tolist())), POINTS)


def test_check_points_counts_after_dropping():
    points = np.vstack([POINTS, [[np.nan, 0, 0]]])
    np.testing.assert_array_equal(check_points(points, minimum=4, drop_invalid=True), POINTS)
    with pytest.raises(InputError, match="got 4 points after 1 with.*at least 5"):
        check_points(points, minimum=5, drop_invalid=True)
    with pytest.raises(InputError, match="got 4 points; expected at least 9 points. A denser scan"):
        check_points(POINTS, minimum=9)
    with pytest.raises(InputError, match="0 points after 2 .*at least 1 point(?!s).*No points are left"):
        check_points(np.full((2, 3), np.nan), drop_invalid=True)
    with pytest.raises(InputError, match="got 1 point after 1 with.*at least 2 points. A denser"):
        check_points([[1, 2, 3], [np.nan, 0, 0]], minimum=2, drop_invalid=True)
    with pytest.raises(InputError, match="an empty cloud .*at least 1 point of shape"):
        check_points([])
    with pytest.raises(InputError, match="2 of 2 points with .*numbers. Check how .* leave no point.$"):
        check_points(np.full((2, 3), np.nan))


@pytest.mark.parametrize("copies", [lambda p: np.repeat(p, 2000, axis=0), lambda p: np.tile(p, (2000, 1)), lambda p: p])
def test_copies_of_points_do_not_count(copies):
    points = np.vstack([copies(POINTS), POINTS, 0.0 * POINTS[:1], -0.0 * POINTS[:1]])
    distinct = len(np.unique(points, axis=0))
    assert count_distinct(points, 10**6) == distinct
    assert check_points(points, minimum=distinct) is points
    words = f"got {len(points)} points, of which {distinct} are distinct; expected at least {distinct + 1} distinct points. A den"
    with pytest.raises(InputError, match=words):
        check_points(points, minimum=distinct + 1)


def test_no_more_points_are_counted_than_have_to_be():
    class Counting:
        asked = 0

        def __len__(self):
            return 10**7

        def __getitem__(self, rows):
            self.asked += 1
            return np.arange(3.0 * rows.start, 3.0 * rows.stop).reshape(-1, 3)

    points = Counting()
    assert count_distinct(points, 16) >= 16 and points.asked == 1


def test_scan_is_its_own_and_read_only():
    points, labels = POINTS.copy(), LABELS.copy()
    scan = Scan(points, labels=labels, name="s")
    points[:], labels[:] = 9, 9
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    with pytest.raises(ValueError):
        scan.points[0] = 1
    with pytest.raises(InputError, match="labels"):
        Scan(POINTS, labels=[0.5, 1, 2, 3])
    with pytest.raises(InputError, match="normals"):
        Scan(POINTS, normals=NORMALS[:2])


def test_a_read_only_view_of_what_others_write_to_is_copied():
    points, labels = POINTS.copy(), LABELS.copy()
    views = points.view(), labels.view()
    for view in views:
        view.flags.writeable = False
    scan = Scan(views[0], views[0], views[1])
    points[:], labels[:] = 9, 9
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.normals, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)


def test_a_read_only_array_of_its_own_is_not_copied():
    points = POINTS.copy()
    points.flags.writeable = False
    assert Scan(points).points is points


@pytest.mark.parametrize("again", [lambda scan: pickle.loads(pickle.dumps(scan)), copy.copy, copy.deepcopy])
def test_a_scan_stays_read_only_when_it_travels(again):
    scan = again(Scan(POINTS, NORMALS, LABELS, name="s", notes=("n",)))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert (scan.name, scan.notes, again(Scan(POINTS)).labels) == ("s", ("n",), None)
    for array in (scan.points, scan.normals, scan.labels):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("n", [0, -1, 2.5, True, "3", None])
def test_thinned_wants_a_count(n):
    with pytest.raises(InputError, match="n: got .*a positive whole number of points"):
        Scan(POINTS).thinned(n)


def test_repr_is_a_line():
    points = np.array([[0, 0, 0], [1, 2, 0.123456]])
    assert repr(Scan(points, name="a")) == "<Scan 'a': 2 points, 1 x 2 x 0.1235>"
    assert repr(Scan(points, normals=points, labels=[0, 1])) == "<Scan 'scan': 2 points, normals, labels, 1 x 2 x 0.1235>"


def test_thinned_is_a_sorted_subset_by_seed():
    scan = Scan(np.random.default_rng(0).normal(size=(1000, 3)))
    rows = scan.thinned(100, 5)
    assert len(rows) == 100 and np.all(np.diff(rows) > 0) and rows[-1] < 1000
    np.testing.assert_array_equal(rows, scan.thinned(100, 5))
    assert not np.array_equal(rows, scan.thinned(100, 6))
    np.testing.assert_array_equal(scan.thinned(2000), np.arange(1000))
    often = np.bincount(np.concatenate([scan.thinned(100, s) for s in range(200)]), minlength=1000)
    assert often.min() > 2 and often.max() < 45  # 20 ± 4.2 each


def test_some_rows_are_spread_evenly_and_all_where_there_are_few():
    points = np.random.default_rng(0).normal(size=(1000, 3))
    np.testing.assert_array_equal(some_rows(points, 1000), np.arange(1000))
    np.testing.assert_array_equal(some_rows(points, 1), [0])
    np.testing.assert_array_equal(some_rows(points, 250), np.linspace(0, 999, 250).astype(int))


@pytest.mark.parametrize("n", [1200, 12000, 60000])
@pytest.mark.parametrize("cameras", [2, 3, 5])
def test_of_points_that_stand_in_an_order_rows_are_drawn(cameras, n):
    """Evenly spread, they would be of one camera alone."""
    points = np.random.default_rng(0).normal(size=(n, 3)) * [1.0, 1.0, 0.15]
    points = points[np.argsort(points[:, 1])]  # each camera sees a stretch of it, from below to above
    of = np.arange(n).reshape(cameras, -1).T.ravel()
    rows = some_rows(points[of], n // cameras)
    assert len(np.unique(rows)) == len(rows) and (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(rows, some_rows(points[of], len(rows)))
    seen = np.bincount(of[rows] * cameras // n, minlength=cameras)
    assert seen.min() > 0.7 * len(rows) / cameras


@pytest.mark.parametrize("points", [np.zeros((50, 3)), np.full((50, 3), 1e150), np.eye(3), np.zeros((21, 3))])
def test_some_rows_of_points_at_one_place(points):
    assert len(some_rows(points, 20)) == min(len(points), 20) and len(some_rows(points, 2)) == 2


@pytest.mark.parametrize("notes, kept", [("turned by hand", ("turned by hand",)), (["a", "b"], ("a", "b")), ((), ())])
def test_one_text_is_one_note(notes, kept):
    assert Scan(POINTS, notes=notes).notes == kept
