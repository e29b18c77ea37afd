"""Floors are taken out of scans; bodies are not."""

import copy
import re
from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning import new_scan
from lbsfit_np.learning.new_scan import scan_fit
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts import floor
from lbsfit_np.starts.clean import clean_rows, taking_part
from lbsfit_np.starts.floor import off_floor
from lbsfit_np.starts.scale import reference_scale
from lbsfit_np.starts.turns import any_side_up, facing_of

UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


def _kept(points, **options):
    rows, dropped, _, walls = off_floor(points, np.arange(len(points)), **options)
    kept = np.zeros(len(points), dtype=bool)
    kept[rows] = True
    assert dropped + walls == (~kept).sum()
    return kept


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_floor_goes_and_the_body_stays(hand, share):
    found = 0
    for scan in lbs.synthesize(hand, 10, poses="natural", random_state=1, floor=share):
        kept, body = _kept(scan.points, ups=[UP]), scan.labels >= 0
        assert (body & ~kept).sum() < 0.06 * body.sum()
        found += (~body & kept).sum() < 0.05 * (~body).sum()
    assert found >= 9


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.004])
def test_feet_stay_but_for_their_soles(noise):
    """Near the body a floor is as thick as it is elsewhere: as its noise, of a drawn one hardly at all."""
    rig = lbs.load_rig("body-coarse")
    for i, scan in enumerate(lbs.synthesize(rig, 4, poses="natural", random_state=1, noise=0.002)):
        rng, (low, size) = np.random.default_rng(i), (scan.points[:, 1].min(), np.ptp(scan.points, axis=0).max())
        floor = 3 * size * rng.uniform(-0.5, 0.5, (6000, 3))
        floor[:, 1] = low + noise * size * rng.standard_normal(6000)
        kept = _kept(np.vstack([scan.points, floor]), ups=[UP])
        n = len(scan.points)
        assert kept[:n].mean() > 0.98 and kept[n:].sum() < 0.005 * n
        assert kept[:n][scan.points[:, 1] > low + (0.015 + 4 * noise) * size].all()


def test_squares_and_those_around_are_counted():
    """Against a count of all pairs; at the borders, too."""
    rng = np.random.default_rng(0)
    n = np.array([0.0, 1.0, 0.0])
    axes = np.linalg.svd(n[None])[2][1:]
    for seed in range(5):
        x = rng.uniform(-0.5, 0.5, (400, 3)) * [0.2 + 0.2 * seed, 0.1, 1.0]
        on = rng.random(400) < 0.5
        square = np.floor(x @ axes.T / floor._SQUARE).astype(int)
        near = (np.abs(square[:, None] - square[None]).max(axis=2) <= 1)[:, ~on]
        np.testing.assert_array_equal(floor._around(square, on), near.sum(axis=1))


def test_clusters_far_away_take_no_memory(hand):
    """The squares between them and the body are not counted one by one."""
    scan = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)[0]
    kept = _kept(scan.points, ups=[UP])
    rng = np.random.default_rng(0)
    far = [1e7 * np.array(d) + 1e-3 * rng.standard_normal((10, 3)) for d in ((1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1))]
    with_them = _kept(np.vstack([scan.points, *far]), ups=[UP])
    assert not kept.all() and (with_them[: len(kept)] == kept).mean() > 0.95


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_floor_goes_from_among_clutter(hand, share):
    """Points here and there above a floor do not make it a body's."""
    found = 0
    for scan in lbs.synthesize(hand, 10, poses="natural", random_state=1, floor=share, clutter=0.1):
        body = int((scan.labels >= 0).sum())
        kept = _kept(scan.points, ups=[UP])
        assert kept[:body].mean() > 0.94
        found += kept[round(1.1 * body) :].mean() < 0.05  # the floor comes last
    assert found >= 9


def test_one_side_of_a_body_is_no_floor(hand):
    """A palm seen by one camera is flat, with the fingers on one side of it."""
    scans = lbs.synthesize(hand, 20, poses="natural", random_state=3, one_sided=True)
    assert sum(_kept(scan.points).mean() > 0.95 for scan in scans) >= 19


def test_a_scan_without_a_floor_stays_whole(hand):
    for scan in lbs.synthesize(hand, 20, poses="mixed", random_state=2):
        assert _kept(scan.points, ups=facing_of(hand, "upright").floors).all() and _kept(scan.points).all()
        assert _kept(1000.0 * scan.points + 5e4, ups=[UP]).all()


def test_a_wall_is_found_where_any_side_may_be_down(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    turned = scan.points @ matrix_from_rotvec(np.array([1.4, 0.2, -0.5])).T
    kept, body = _kept(turned), scan.labels >= 0
    assert kept[body].mean() > 0.94 and kept[~body].mean() < 0.05
    assert _kept(turned, ups=[UP]).all()  # where up is known, a wall alone is not looked for


@pytest.mark.parametrize("degrees, stays", [(0, False), (15, False), (35, True), (50, True)])
@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
def test_where_up_is_known_a_slope_is_no_floor(hand, axis, degrees, stays):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    kept = _kept(scan.points @ matrix_from_rotvec(np.radians(degrees) * np.array(axis)).T, ups=[UP])
    assert kept.all() if stays else kept[scan.labels < 0].mean() < 0.05


def _on_a_table(n_above, *, noise=0.0, n_below=2000, seed=0):
    """Points of a table at y = 0, 2 wide, and of a box above it."""
    rng = np.random.default_rng(seed)
    across = rng.uniform(-1, 1, (n_below, 2))
    table = np.column_stack([across[:, 0], noise * rng.standard_normal(n_below), across[:, 1]])
    return np.vstack([table, [0.0, 0.35, 0.0] + rng.uniform(-0.3, 0.3, (n_above, 3))])


@pytest.mark.parametrize("seed", range(3))
def test_the_plane_is_that_of_all_its_points(seed):
    """Not that of the three that it was found by: of points along the table's edges, the lower ones go, and no others."""
    rng = np.random.default_rng([seed, 1])
    edges = rng.uniform(-1, 1, (100, 3))
    edges[:50, 0], edges[50:, 2] = np.sign(edges[:50, 0]), np.sign(edges[50:, 2])
    edges[:, 1] = rng.permutation(np.linspace(0.01, 0.06, 100))
    points = np.vstack([_on_a_table(1500, noise=0.005, seed=seed), edges])
    kept = _kept(points, ups=[UP])
    assert not kept[:2000].any() and kept[2000:3500].all() and 0.2 < kept[3500:].mean() < 0.8
    assert points[~kept, 1].max() < points[kept, 1].min()


@pytest.mark.parametrize("n_above, goes", [(20, False), (60, True), (100, True), (400, True)])
def test_of_a_scan_that_is_all_but_a_plane_nothing_is_left_out(n_above, goes):
    """What would be left is no body; a few hundredths of the points may be, as of people in a room."""
    points = _on_a_table(n_above)
    assert _kept(points, ups=[UP])[:2000].any() != goes
    assert _kept(points).all() != goes


@pytest.mark.parametrize("n_above, high, goes", [(100, 0.02, False), (100, 0.6, True), (400, 0.02, True)])
def test_of_a_wide_flat_thing_what_stands_on_it_tells_whether_it_is_a_floor(n_above, high, goes):
    """A flat side of a body has little above it: thumbs and creases of a palm. Where there is more above, it may lie flat."""
    points = _on_a_table(n_above)
    points[2000:, 1] = 0.04 + high * (points[2000:, 1] - points[2000:, 1].min())
    assert _kept(points, ups=[UP])[:2000].any() != goes


def test_given_rows_are_kept_to(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    rows, dropped, *_ = off_floor(scan.points, np.arange(0, len(scan.points), 2), ups=[UP])
    assert dropped > 1000 and (rows % 2 == 0).all()


@pytest.mark.parametrize("points", [np.zeros((100, 3)), np.eye(3), np.column_stack([np.arange(80.0), np.zeros((80, 2))])])
def test_points_without_extent_pass(points):
    assert _kept(points).all() and _kept(points, ups=[UP]).all()


@pytest.mark.parametrize("axis", range(6))
def test_where_up_is_but_likely_a_floor_may_be_below_another_axis(axis, hand):
    facing = facing_of(hand, "upright")
    turn = next(t for t in any_side_up(np.eye(3)[None], facing.up) if np.allclose(t @ UP, facing.floors[axis]))
    for scan in lbs.synthesize(hand, 4, poses="natural", random_state=1, floor=0.4):
        kept, body = _kept(scan.points @ turn.T, ups=facing.floors), scan.labels >= 0
        assert (body & kept).sum() > 0.94 * body.sum() and (~body & kept).sum() < 0.05 * (~body).sum()
        assert off_floor(scan.points @ turn.T, np.arange(len(body)), ups=facing.floors)[2] == axis
        kept_below_up = _kept(scan.points @ turn.T, ups=facing.floors[:1])
        assert kept_below_up.all() == (axis > 0)


def test_clean_rows_says_what_it_left_out(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1, floor=1.0)
    points = np.vstack([scan.points, [[9.0, 9.0, 9.0]]])
    rows, note, _ = clean_rows(points, np.arange(len(points)), ups=[UP])
    assert len(points) - 1 not in rows
    assert "1 point far from all others left out" in note and note.endswith("points of a floor left out")
    (plain,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    rows, note, _ = clean_rows(plain.points, np.arange(len(plain.points)), ups=[UP])
    assert note == "" and len(rows) == len(plain.points)
    assert clean_rows(plain.points, np.arange(0, len(plain.points), 2), ups=[UP])[1] == ""
    rows, note, _ = clean_rows(points, np.arange(0, len(points), 2), ups=[UP])  # its counts are not of the whole scan
    assert note.endswith(f"points of a floor left out (of {(len(points) + 1) // 2} examined)")


def test_a_wide_floor_says_nothing_of_the_unit(hand):
    """The extent that tells the unit is the body's."""
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    rng = np.random.default_rng(0)
    across = 3 * hand.size * rng.uniform(-0.5, 0.5, (4000, 2))
    floor = np.column_stack([across[:, 0], np.full(4000, scan.points[:, 1].min()), across[:, 1]])
    points = np.vstack([scan.points, floor])
    rows, *_ = clean_rows(points, np.arange(len(points)), ups=[UP])
    assert reference_scale(points[rows], hand, "fixed").scale == reference_scale(scan.points, hand, "estimate").scale == 1.0
    with pytest.raises(InputError, match="scale: got 'fixed' for a scan whose extent is"):
        reference_scale(points, hand, "fixed")


class _Told(BaseException):
    """Ends a fit where floors are looked for; nothing takes it for a scan's failure."""


@pytest.mark.parametrize(
    "up, orientation, sides",
    [
        ("+z", "upright", [[0, 0, 1]]),
        (None, "aligned", [[0, 1, 0]]),
        (None, "upright", [[0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]]),
        (None, "any", None),
    ],
)
@pytest.mark.parametrize("what", ["fit of one scan", "fit of a new scan", "learning"])
def test_floors_are_looked_for_where_down_is_told(fitter, tube_scan, what, up, orientation, sides, monkeypatch):
    points, labels = tube_scan.points, tube_scan.labels

    def spy(points, rows, *, ups=None, sure=False, body=None):
        raise _Told(ups)

    monkeypatch.setattr("lbsfit_np.starts.clean.clean_rows", spy)
    fitter.set_params(up=up, orientation=orientation)
    with pytest.raises(_Told) as told:
        if what == "learning":
            fitter.fit([points])
        elif what == "fit of a new scan":  # there is nothing to be learned before it
            fitter.set_params(variant="free-form").fit_scan(points)
        else:
            fitter.fit_scan(points, labels=labels)
    np.testing.assert_array_equal(told.value.args[0], sides)


def _part(points, rig, most=100_000, seed=0, **options):
    part = taking_part(points, rig, most=most, rng=np.random.default_rng(seed), scale="estimate", **options)
    return part.rows, part.note


@pytest.mark.parametrize("where", ["zeros", "first point"])
def test_points_in_one_place_take_no_part(where, hand):
    """Pixels without depth, or what fills a cloud up; where each point is there as often, they are as good as once."""
    (scan,) = lbs.synthesize(hand, random_state=1, n_points=1000)
    filled = np.vstack([scan.points, np.tile(np.zeros(3) if where == "zeros" else scan.points[0], (9000, 1))])
    rows, note = _part(filled[::-1], hand)
    assert (10_000 - 1 - rows < 1000).all() and len(rows) >= 990
    assert note.startswith(f"{9000 + (where != 'zeros')} identical points left out")
    for n in (1, 30):
        again, note = _part(np.tile(scan.points, (n, 1)), hand)
        assert len(again) > 0.99 * n * 1000 and "identical" not in note


def test_where_hardly_any_other_points_are_left_no_pose_is_guessed(hand):
    few, parts = lbs.synthesize(hand, random_state=1, n_points=20)[0].points, len(hand.parts)
    for n in (5, 1):
        filled = np.vstack([few[:n], few[:n] + 1e-3, np.zeros((9000, 3))])
        words = f"got {2 * n} points that may be of the body (9000 identical points left out); expected at least {parts} points"
        with pytest.raises(InputError, match=re.escape(words)):
            _part(filled, hand)
    assert len(_part(few[:5], hand)[0]) == 5  # others say when there are too few to begin with


def test_as_many_points_of_the_body_are_drawn_as_are_wanted(hand):
    (scan,) = lbs.synthesize(hand, poses="natural", random_state=1, n_points=4000, floor=1.5)
    body = np.flatnonzero(scan.labels >= 0)
    for most in (500, 1000):
        rows, note = _part(scan.points, hand, most, ups=[UP])
        assert len(rows) == most and np.isin(rows, body).mean() > 0.97 and "of a floor left out" in note
    labels = np.where((scan.labels >= 0) | (np.arange(len(scan.points)) % 5 == 0), 0, -1)  # known of some of the floor's
    rows, _ = _part(scan.points, hand, 1000, ups=[UP], labels=labels)
    assert len(rows) == 1000 and (labels[rows] == 0).mean() > 0.97 and (~np.isin(rows, body)).mean() > 0.15
    drawn, note = _part(scan.points[body], hand, 1000, ups=[UP])
    np.testing.assert_array_equal(drawn, np.sort(np.random.default_rng(0).choice(len(body), 1000, replace=False)))
    assert note == ""


@pytest.fixture(params=["by itself", "after learning"])
def fitted(request, tube_fitter, tube_result, monkeypatch):
    """Points, and what else is known of them → (result, all that took part) of fits that end with the ``outcomes`` given."""
    fits, outcomes = [], []

    def one(part):
        fits.append(part)
        status, probability = outcomes[len(fits) - 1]
        known = {"message": f"fit {len(fits)}", "evaluations": 10 * len(fits), "seconds": float(len(fits)), "evidence": {}}
        return replace(tube_result, status=status, probability=probability, **known)

    def fit_of(points, ends, *, scale="estimate", **given):
        fits.clear()
        outcomes[:] = ends
        fitter = copy.copy(tube_fitter).set_params(scale=scale, effort="fast")  # which looks for nothing beyond the rig
        given = {"theta0": None, "labels": None, "point_weights": None} | given
        if request.param == "after learning":
            monkeypatch.setattr(new_scan, "_fit_new", lambda fitter, points, part, *_, once: one(part))
            return new_scan.fit_new(fitter, points, ("ann",), **given), list(fits)
        fit = scan_fit(fitter)
        monkeypatch.setattr(fit, "_fit", lambda points, theta0, labels, point_weights, part, *_, once: one(part))
        return fit.fit(points, random_state=0, **given), list(fits)

    return fit_of


def _before_a_wall(rig, axis=2, width=2.0):
    """A scan, and how many of its points are the body's; below the axis a wall, so many times as wide as the body."""
    (scan,) = lbs.synthesize(rig, random_state=5, n_points=400, shape=0.0)
    size = np.ptp(scan.points, axis=0).max()
    wall = scan.points.mean(axis=0) + width * size * (np.random.default_rng(0).random((500, 3)) - 0.5)
    wall[:, axis] = scan.points[:, axis].min() - 0.02 * size
    return np.vstack([scan.points, wall]), len(scan.points)


KEPT = "a flat side that might be a floor or wall is kept, as the fit is more probable with it"


@pytest.mark.parametrize(
    "ends, tries, kept, said",
    [
        ([("failed", 0.1), ("ok", 0.9)], 2, 2, f"; {KEPT}"),
        ([("suspect", 0.5), ("suspect", 0.2)], 2, 1, "; with the points of that floor or wall, the fit is no more probable"),
        ([("ok", 0.9), ("ok", 0.99)], 1, 1, ""),
    ],
)
@pytest.mark.parametrize("given", [(), ("theta0",), ("labels",)])
def test_a_floor_below_another_axis_may_be_a_side_of_the_body(given, ends, tries, kept, said, tube_rig, fitted):
    """Where the fit without it is in doubt it is tried with it, after learning too; what the rig stands on stays a floor."""
    points, _ = _before_a_wall(tube_rig)
    known = {"theta0": np.zeros((4, 3)), "labels": np.full(len(points), -1)}
    result, fits = fitted(points, ends, **{name: known[name] for name in given})
    assert len(fits) == tries and result.message == f"fit {kept}{said}" and result.probability == ends[kept - 1][1]
    assert (result.seconds, result.evaluations) == ((2.0, 30) if tries == 2 else (1.0, 10))
    assert "of a floor or wall on the -z side left out" in fits[0].note and fits[0].doubtful
    assert tries == 1 or fits[1].note == ""
    result, fits = fitted(_before_a_wall(tube_rig, axis=1)[0], ends)
    assert len(fits) == 1 and "of a floor left out" in fits[0].note and fits[0].doubtful is None and result.message == "fit 1"


@pytest.mark.parametrize("random_state", [5, None, "a generator"])
def test_a_second_look_is_at_the_same_points(random_state, tube_rig, tube_result, monkeypatch):
    """What differs between the two is the floor alone; where a seed is given, every time."""
    points, looked_at = np.tile(_before_a_wall(tube_rig)[0], (2, 1)) + 1e-3 * np.random.default_rng(1).random((1800, 3)), []
    fit = scan_fit(lbs.LBSFitter(tube_rig, max_points=300, effort="fast"))

    def taking(points, rig, *, rng, **more):
        looked_at.append(rng.random())
        return taking_part(points, rig, rng=rng, **more)

    monkeypatch.setattr("lbsfit_np.fitting.scan_fit.taking_part", taking)
    monkeypatch.setattr(fit, "_fit", lambda *given, once: replace(tube_result, status="suspect", evidence={}))
    given = np.random.default_rng(5) if random_state == "a generator" else random_state
    for _ in range(2):
        fit.fit(points, random_state=given)
    first, second, *again = looked_at
    assert first == second and again[0] == again[1] and (again[0] == first) == (random_state == 5)


@pytest.mark.parametrize("name, value", [("found", object()), ("once", True)])
def test_what_was_found_and_how_is_of_what_took_part(tube_rig, tube_scan, name, value):
    with pytest.raises(TypeError, match=f"{name} is of a part: give that, too"):
        scan_fit(lbs.LBSFitter(tube_rig)).fit(tube_scan.points, **{name: value})


def test_a_wall_that_cannot_take_part_does_not_take_the_fit_away(tube_rig, fitted):
    """With it the scan is in no unit of the rig's."""
    points, _ = _before_a_wall(tube_rig, width=6.0)
    result, fits = fitted(points, [("suspect", 0.4)], scale="fixed")
    assert len(fits) == 1 and result.message == "fit 1" and "of a floor" in fits[0].note


def test_points_with_a_known_part_are_of_no_floor(tube_rig, fitted):
    points, n = _before_a_wall(tube_rig, axis=1)
    labels = np.full(len(points), -1)
    labels[: n + 100] = 0
    _, (part,) = fitted(points, [("ok", 0.9)], labels=labels)
    assert np.isin(np.arange(n + 100), part.rows).all() and len(part.rows) < n + 150


def test_a_place_is_told_by_all_its_coordinates_and_how_many_points_are_usual():
    """Columns of points, and a scan of few places, have no place with far more points than others."""
    rng, rig = np.random.default_rng(0), lbs.load_rig("hand-coarse")
    (scan,) = lbs.synthesize(rig, poses="natural", random_state=1, n_points=2000)
    for axis in range(3):
        columns = scan.points.copy()
        columns[:, axis] = np.round(columns[:, axis], 1)
        assert "identical" not in _part(columns, rig)[1]
    few = scan.points[rng.choice(2000, 100, replace=False)]
    rows, note = _part(np.repeat(few, 30, axis=0), rig)
    assert len(rows) > 2900 and "identical" not in note


@pytest.mark.filterwarnings("error")
def test_what_is_too_large_is_told_by_its_extent(hand):
    with pytest.raises(InputError, match="points: got an extent of"):
        _part(1e308 * np.random.default_rng(0).uniform(-1, 1, (500, 3)), hand)
