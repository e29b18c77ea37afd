"""Walls that stand on a floor go with it, whichever way they face; bodies stay."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from learning_runs import collected

import lbsfit_np as lbs
from lbsfit_np.learning.new_scan import scan_fit
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.clean import clean_rows, taking_part
from lbsfit_np.starts.floor import off_floor
from lbsfit_np.starts.turns import facing_of

UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


def _in_a_room(body, rng, planes, *, turn=0.0, n=2500, lean=0.0):
    """Points of a body and of some planes, and the plane of each point, −1 of the body.

    ``planes``: "floor", "back", "side", and so on; walls stand at a third of the body's size from it, on a floor under it, all
    turned about the up axis by ``turn``; they lean by ``lean``, radians.
    """
    R = matrix_from_rotvec(turn * UP)
    x = body @ R
    low, size = x.min(axis=0), np.ptp(x, axis=0).max()
    near, far = low - size / 3, low + 2.5 * size
    points, of = [body], [np.full(len(body), -1)]
    for k, name in enumerate(planes):
        p = rng.uniform(near, far, (n, 3))
        p[:, 1] = rng.uniform(low[1], low[1] + 1.2 * size, n)
        axis = {"side": 0, "floor": 1, "back": 2}[name]
        p[:, axis] = low[1] if axis == 1 else near[axis] + (p[:, 1] - low[1]) * np.tan(lean)
        points.append((p + 0.003 * size * rng.standard_normal(p.shape)) @ R.T)
        of.append(np.full(n, k))
    return np.vstack(points), np.concatenate(of)


def _kept(points, **options):
    kept = np.zeros(len(points), dtype=bool)
    kept[off_floor(points, np.arange(len(points)), **options)[0]] = True
    return kept


@pytest.mark.parametrize("one_sided", [False, True])
@pytest.mark.parametrize("planes", [["floor", "back"], ["floor", "side", "back"]], ids="+".join)
@pytest.mark.parametrize("name", ["hand-coarse", "body-coarse"])
def test_walls_go_with_the_floor_and_the_body_stays(name, planes, one_sided):
    rig = lbs.load_rig(name)
    sides = facing_of(rig, "upright").floors
    for i, scan in enumerate(lbs.synthesize(rig, 6, poses="natural", random_state=1, one_sided=one_sided)):
        points, of = _in_a_room(scan.points, np.random.default_rng(i), planes, turn=0.4 + i)
        kept = _kept(points, ups=sides)
        assert kept[of < 0].mean() > 0.85
        assert [kept[of == k].mean() < 0.05 for k in range(len(planes))] == [True] * len(planes)


def test_they_go_where_any_side_may_be_down(hand):
    for i, scan in enumerate(lbs.synthesize(hand, 6, poses="natural", random_state=1)):
        points, of = _in_a_room(scan.points, np.random.default_rng(i), ["floor", "back"], turn=i)
        kept = _kept(points @ matrix_from_rotvec(np.array([1.4, 0.2 * i, -0.5])).T)
        assert kept[of < 0].mean() > 0.85 and kept[of == 0].mean() < 0.05 and kept[of == 1].mean() < 0.05


@pytest.mark.parametrize(
    "planes, below", [(["side", "floor"], 0), (["back", "side"], 4), (["side", "back"], 2), (["back", "floor", "side"], 0)]
)
def test_the_floor_is_taken_first_or_else_the_largest_wall(hand, planes, below):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    points, of = _in_a_room(scan.points, np.random.default_rng(0), planes)
    if "floor" not in planes:  # the first is the largest
        more, _ = _in_a_room(scan.points, np.random.default_rng(1), planes[:1])
        points = np.vstack([points, more[len(scan.points) :]])
        of = np.concatenate([of, np.zeros(len(more) - len(scan.points), int)])
    rows, dropped, first, walls = off_floor(points, np.arange(len(points)), ups=facing_of(hand, "upright").floors)
    n = (of == (planes.index("floor") if below == 0 else 0)).sum()
    assert first == below and abs(dropped - n) < 0.05 * n + 0.1 * len(scan.points)
    assert (of[rows] >= 0).mean() < 0.05 and len(rows) + dropped + walls == len(points)


def test_where_only_what_is_sure_to_be_a_floor_goes_walls_stay(hand):
    """As where a fit without them is in doubt, and they may be a side of the body."""
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    points, of = _in_a_room(scan.points, np.random.default_rng(0), ["floor", "back"])
    sides = facing_of(hand, "upright").floors
    for ups in (sides, sides[:1]):
        kept = _kept(points, ups=ups, sure=True)
        assert kept[of == 0].mean() < 0.05 and kept[of == 1].mean() > 0.9
        assert _kept(points, ups=ups)[of >= 0].mean() < 0.05
        assert off_floor(points, np.arange(len(points)), ups=ups, sure=True)[3] == 0
    wall = points[of != 0]
    assert not _kept(wall, ups=sides)[of[of != 0] == 1].any() and _kept(wall, ups=sides, sure=True).all()


@pytest.mark.parametrize("degrees, n, stays", [(0, 2500, False), (10, 2500, False), (35, 2500, True), (25, 5000, True)])
def test_what_leans_is_no_wall(hand, degrees, n, stays):
    """By however many points, of which enough lie near an upright plane, too."""
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    points, of = _in_a_room(scan.points, np.random.default_rng(0), ["floor", "back"], turn=0.7, n=n, lean=-np.radians(degrees))
    kept = _kept(points, ups=facing_of(hand, "upright").floors)
    assert kept[of == 0].mean() < 0.05 and (kept[of == 1].mean() > 0.5 if stays else kept[of == 1].mean() < 0.05)


def test_small_walls_go_as_they_are_known_to_stand_upright(hand):
    """Three points of one are rarely drawn together: with these, 10 of the 20 are found, with two 15."""
    gone = []
    for i, scan in enumerate(lbs.synthesize(hand, 20, poses="natural", random_state=5)):
        points, of = _in_a_room(scan.points, np.random.default_rng(i), ["floor", "back"], turn=0.4 + i, n=600)
        gone.append(_kept(points, ups=facing_of(hand, "upright").floors)[of == 1].mean() < 0.05)
    assert sum(gone) >= 13


@pytest.mark.parametrize("name", ["hand-coarse", "body-coarse"])
def test_sides_of_bodies_on_a_floor_are_no_walls(name):
    rig = lbs.load_rig(name)
    scans = lbs.synthesize(rig, 20, poses="natural", random_state=1, one_sided=True, floor=1.0)
    sides = facing_of(rig, "upright").floors
    lost = [off_floor(s.points, np.arange(len(s.points)), ups=sides)[3] for s in scans]
    assert np.count_nonzero(lost) <= 1  # such as a palm that faces the camera


def test_where_there_is_no_floor_nothing_stands_on_it(hand):
    for scan in lbs.synthesize(hand, 5, poses="natural", random_state=1, one_sided=True):
        assert off_floor(scan.points, np.arange(len(scan.points)), ups=facing_of(hand, "upright").floors)[3] == 0


def test_known_points_are_of_no_wall(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    points, of = _in_a_room(scan.points, np.random.default_rng(0), ["floor", "back"])
    known = of < 0
    known[np.flatnonzero(of == 1)[:100]] = True
    kept = _kept(points, ups=facing_of(hand, "upright").floors, body=known)
    assert kept[known].all() and kept[~known].mean() < 0.05


def test_a_note_counts_them_and_says_that_they_are_doubtful(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    points, _ = _in_a_room(scan.points, np.random.default_rng(0), ["floor", "back"])
    rows = np.arange(len(points))
    for ups in (facing_of(hand, "upright").floors, facing_of(hand, "upright", "+y").floors, None):
        _, note, doubtful = clean_rows(points, rows, ups=ups)
        assert "points of a floor left out; " in note and note.endswith("points of walls left out") and doubtful == "walls"
        _, note, doubtful = clean_rows(points, rows, ups=ups, sure=True)
        assert "walls" not in note and doubtful is None
    # Below another axis than the likeliest the floor itself is in doubt, whatever stands on it.
    _, note, doubtful = clean_rows(points[:, [2, 0, 1]], rows, ups=facing_of(hand, "upright").floors)
    assert "points of a floor or wall on the -z side left out; " in note and note.endswith("of walls left out") and doubtful == 4


# ---- fits and collections ----


def test_a_fit_in_a_corner_is_right(tube_rig, fitter, tube_scan):
    points, of = _in_a_room(tube_scan.points, np.random.default_rng(0), ["floor", "side", "back"], turn=0.5, n=1500)
    r = copy.copy(fitter).fit_scan(points)
    alone = copy.copy(fitter).fit_scan(tube_scan.points)
    assert r.status == "ok" and "of walls left out" in r.message
    assert np.linalg.norm(r.joints - alone.joints, axis=1).max() < 0.02 * tube_rig.size
    assert r.left_out[of >= 0].mean() > 0.95 and r.left_out[of < 0].mean() < 0.1


@pytest.mark.parametrize("ends, kept", [([0.3, 0.9], 1), ([0.3, 0.2], 0), ([0.9], 0)])
def test_walls_take_part_where_a_fit_without_them_is_in_doubt(ends, kept, tube_rig, tube_scan, tube_result, monkeypatch):
    """They may be a flat side of the body; what it stands on is a floor all the same."""
    points, _ = _in_a_room(tube_scan.points, np.random.default_rng(0), ["floor", "back"], n=800)
    fit, parts, left = scan_fit(lbs.LBSFitter(tube_rig, effort="fast")), [], list(ends)

    def made(points, theta0, labels, point_weights, part, *_, once):
        parts.append(part)
        p = left.pop(0)
        return replace(tube_result, status="ok" if p > 0.5 else "suspect", probability=p, message=f"fit {len(parts)}")

    monkeypatch.setattr(fit, "_fit", made)
    r = fit.fit(points, random_state=0)
    assert len(parts) == len(ends) and r.message.startswith(f"fit {kept + 1}") and r.probability == ends[kept]
    assert "of walls" in parts[0].note
    if len(parts) == 2:
        assert "of walls" not in parts[1].note and "of a floor" in parts[1].note and len(parts[1].rows) > len(parts[0].rows) + 700


@pytest.mark.parametrize("n, gone", [(1, False), (2, True)])
def test_walls_that_most_scans_of_a_collection_lack_are_sides_of_bodies(tube_rig, n, gone):
    scans = lbs.synthesize(tube_rig, 4, random_state=5, n_points=400, shape=0.0)
    clouds = [
        _in_a_room(s.points, np.random.default_rng(i), ["floor", "back"] if i < n else ["floor"], n=500)[0]
        for i, s in enumerate(scans)
    ]
    members = collected(tube_rig, clouds, held_out=0.0, ups=facing_of(tube_rig, "upright").floors).members
    assert ["of walls" in m.part.note for m in members] == [gone and i < n for i in range(4)]
    assert all("of a floor" in m.part.note for m in members)
    assert [m.sure for m in members] == [not gone and i < n for i in range(4)]  # what its first fit goes by


def test_they_say_nothing_of_the_unit(hand):
    (scan,) = lbs.synthesize(hand, 1, poses="natural", random_state=1)
    points, _ = _in_a_room(scan.points, np.random.default_rng(0), ["floor", "side", "back"])
    known = {"rng": np.random.default_rng(0), "scale": "fixed", "ups": facing_of(hand, "upright").floors}
    assert taking_part(points, hand, most=100_000, **known).scale == 1.0
