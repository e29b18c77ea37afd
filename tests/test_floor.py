"""Floors are taken out of scans; bodies are not."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.clean import clean_rows
from lbsfit_np.starts.floor import off_floor

UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


def _kept(points, **options):
    rows, dropped = off_floor(points, np.arange(len(points)), **options)
    kept = np.zeros(len(points), dtype=bool)
    kept[rows] = True
    assert dropped == (~kept).sum()
    return kept


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_floor_goes_and_the_body_stays(hand, share):
    found = 0
    for scan in lbs.synthesize(hand, 10, poses="natural", random_state=1, floor=share):
        kept, body = _kept(scan.points, up=UP), scan.labels >= 0
        assert (body & ~kept).sum() < 0.06 * body.sum()
        found += (~body & kept).sum() < 0.05 * (~body).sum()
    assert found >= 9


def test_a_scan_without_a_floor_stays_whole(hand):
    for scan in lbs.synthesize(hand, 20, poses="mixed", random_state=2):
        assert _kept(scan.points, up=UP).all() and _kept(scan.points).all()
        assert _kept(1000.0 * scan.points + 5e4, up=UP).all()


def test_a_wall_is_found_where_any_side_may_be_down(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    turned = scan.points @ matrix_from_rotvec(np.array([1.4, 0.2, -0.5])).T
    kept, body = _kept(turned), scan.labels >= 0
    assert kept[body].mean() > 0.94 and kept[~body].mean() < 0.05
    assert _kept(turned, up=UP).all()  # where up is known, walls are not looked for


def test_given_rows_are_kept_to(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    rows, dropped = off_floor(scan.points, np.arange(0, len(scan.points), 2), up=UP)
    assert dropped > 1000 and (rows % 2 == 0).all()


@pytest.mark.parametrize("points", [np.zeros((100, 3)), np.eye(3), np.column_stack([np.arange(80.0), np.zeros((80, 2))])])
def test_points_without_extent_pass(points):
    assert _kept(points).all() and _kept(points, up=UP).all()


def test_clean_rows_says_what_it_left_out(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    points = np.vstack([scan.points, [[9.0, 9.0, 9.0]]])
    rows, note = clean_rows(points, np.arange(len(points)), up=UP)
    assert len(points) - 1 not in rows
    assert "1 points far from all others left out" in note and "points of a floor left out" in note
    (plain,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    rows, note = clean_rows(plain.points, np.arange(len(plain.points)), up=UP)
    assert note == "" and len(rows) == len(plain.points)
