"""The collection that is learned from: what is read of it, set aside, held out and refused."""

import functools
import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import NAN, SMALL, collected
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning import fitter as learning_fitter
from lbsfit_np.learning.collection import HELD_OUT, LEARNED_FROM, Collection, Member, most_failed
from lbsfit_np.learning.reading import odd_ones
from lbsfit_np.starts.turns import facing_of


@pytest.fixture(scope="module")
def clouds(people_scans):
    return [s.points for s in people_scans]


BAD_COLLECTIONS = [
    (lambda c: ([], None), ["scans: got none", "one or more"]),
    (lambda c: (c[0], None), ["scans: got one array of shape (", "in a list"]),
    (lambda c: ([c[0], "a.ply"], None), ["scans: got the path 'a.ply'", "load_scan"]),
    (lambda c: (c[:4], ["a", "b"]), ["subjects: got 2 ids", "4, one for each scan"]),
    (lambda c: (c[:4], "anna"), ["subjects: got 'anna'", "a sequence"]),
    (lambda c: (c[:4], 7), ["subjects: got 7", "a sequence"]),
    (lambda c: (c[:4], [1, 2, 3, 4.5]), ["subjects: got 4.5 for scan 3", "text or whole numbers"]),
    (lambda c: (c[:4], [1, True, 1, 1]), ["subjects: got True for scan 1", "text or whole numbers"]),
    (lambda c: (c[:4], np.array([True, False, True, True])), ["subjects: got True for scan 0", "text or whole numbers"]),
    (lambda c: (c[:4], ["a", "", "a", "a"]), ["subjects: got '' for scan 1", "not empty"]),
    (lambda c: (c[:4], ["a", "a", "a", "a "]), ["subjects: got 'a ' for scan 3", "without blanks at their ends"]),
    (lambda c: (c[:4], ["ü", "ü", "a", "u\u0308"]), ["subjects: got 'ü' for scan 0 and", "differ as text"]),
    (lambda c: (c[:4], [1, 2, 3, None]), ["subjects: got None", "text or whole numbers"]),
    (lambda c: (c[:4], ["b", 1, 2, "1"]), ["subjects: got 1 for scan 1 and '1' for scan 3", "differ as text", "in one way"]),
    (lambda c: (c[:4], [10**5000] * 4), ["subjects: got a number of several thousand digits for scan 0", "64 bits"]),
    (lambda c: (c[:4], [1, 1, -(2**63), 1]), ["subjects: got -9223372036854775808 for scan 2", "64 bits"]),
    (lambda c: ([*c[:4], 1000 * c[4]], None), ["scans: got different units: scan 4 has", "in one unit", "Convert them, learn"]),
    (lambda c: ([0.001 * c[0], *c[1:4], 100 * c[4]], None), ["scans 0, 4 have extents of 0.000658 to 76.9, the others"]),
    (lambda c: ([NAN, *c[:8], 1000 * c[8]], None), ["different units: scan 9 has"]),  # of nine that can be used
    (lambda c: ([*c[:3], *(10 * x for x in c[3:6])], None), ["different units: scans 3, 4, 5 have"]),
    (lambda c: ([NAN, np.zeros((0, 3))], None), ["scans: got 2, none of which can be used (the first: points: got 50"]),
    (lambda c: (c[:2], None), ["scans: got 2 that can be used", "at least 3", "held_out=0"]),
    (lambda c: ([*c[:2], NAN], None), ["scans: got 2 that can be used"]),
]


@pytest.mark.parametrize("given, words", BAD_COLLECTIONS)
def test_collections_that_cannot_be(tube_rig, clouds, given, words):
    with pytest.raises(InputError) as error:
        collected(tube_rig, *given(clouds))
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_one_scan_of_many_in_another_unit_is_left_out(factor, tube_rig, clouds):
    scans = [clouds[i % 4] for i in range(10)]
    scans[6] = factor * scans[6]
    made = collected(tube_rig, scans)
    assert [m.index for m in made.members] == [0, 1, 2, 3, 4, 5, 7, 8, 9] and {m.unit for m in made.members} == {1.0}
    assert made.roles[6] is None and len(made.with_role(LEARNED_FROM)) == 8
    told = r"points: got an extent of \S+, where the other scans have about \S+; "
    told += "expected scans .* in one unit. The scan is left out: convert"
    assert list(made.failures) == [6] and re.match(told, made.failures[6])
    with pytest.warns(UserWarning, match="^1 of 10 scans cannot be used; scan 6: points: got an extent of "):
        made.warn(1)
    with pytest.raises(InputError, match="different units: scan 5 has .* separately, or leave out the wrong scans"):
        collected(tube_rig, scans[1:])  # of nine, one is more than a tenth


def test_bad_collections_are_named_before_any_training(tube_rig, clouds, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    for given, words in BAD_COLLECTIONS:
        scans, ids = given(clouds)
        with pytest.raises(InputError, match=words[0].split("(")[0]):
            lbs.LBSFitter(tube_rig, **SMALL).fit(scans, ids)


@pytest.mark.parametrize("odd, n, warns", [(1, 3, False), (2, 3, True), (2, 20, False), (3, 20, True), (2, 30, False)])
def test_more_than_one_and_more_than_a_tenth_of_the_scans_are_somebody_elses(odd, n, warns):
    results = [SimpleNamespace(evidence={"proportions": 0.31 if k < odd else 0.29}, status="ok") for k in range(n)]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        Collection(n + 1, taught=_taught(n)).warn(1, [*results, None])
    words = f"{odd} of {n} scans do not match their subject's template; are they of several people? "
    words += "Name the subject of each scan: subjects (--subjects)"
    assert [str(w.message) for w in told] == [words] * warns


@pytest.mark.parametrize(
    "failed, unused, n, warns",
    [(0, 0, 4, False), (2, 0, 4, False), (1, 1, 4, False), (2, 1, 4, True), (0, 3, 4, False), (1, 3, 4, True)],
)
def test_most_fits_that_fail_are_warned_of(failed, unused, n, warns):
    """Of the scans that could be used."""
    results = [SimpleNamespace(evidence={}, status="failed" if k < failed else "suspect") for k in range(n - unused)]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        Collection(n, taught=_taught(n - unused)).warn(1, results + [None] * unused)
    assert [str(w.message)[:58] for w in told] == ["most fits have failed: do not trust what was learned; fit "] * warns


@pytest.mark.parametrize("without, warns", [(2, False), (3, True)])
def test_a_scan_that_had_its_part_in_learning_and_has_no_result_has_failed(without, warns):
    """Not so one that could not be used, which has no role."""
    results = [None] * without + [SimpleNamespace(evidence={}, status="ok")] * (4 - without) + [None] * 5
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        Collection(9, taught=_taught(4)).warn(1, results)
    assert [str(w.message)[:22] for w in told] == ["most fits have failed:"] * warns


def test_most_fits_that_fail_in_learning_are_warned_of(tube_rig, clouds, monkeypatch):
    """By the estimator, where it was called."""
    fit = learning_fitter.fit_free_form
    monkeypatch.setattr(learning_fitter, "fit_free_form", lambda *a, **k: [replace(r, status="failed") for r in fit(*a, **k)])
    words = "most fits have failed: do not trust what was learned; fit single scans .*to see why$"
    with pytest.warns(UserWarning, match=words) as told:
        lbs.LBSFitter(tube_rig, **SMALL | {"variant": "free-form"}).fit([x[:60] for x in clouds[:3]])
    assert [w.filename for w in told] == [__file__]


def test_the_command_line_says_once_that_most_fits_failed(made, own_cache, tmp_path, run, monkeypatch):
    fit = learning_fitter.fit_free_form
    monkeypatch.setattr(learning_fitter, "fit_free_form", lambda *a, **k: [replace(r, status="failed") for r in fit(*a, **k)])
    scans = [made / name for name in ("one.ply", "two.xyz", "three.npy")]
    code, out, err = run("learn", made / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 1 and (out + err).count("most fits have failed: do not trust what was learned") == 1
    assert out.splitlines()[-1] == most_failed(["failed"], ["learned from"]) and "lbsfit fit" in out.splitlines()[-1]


def test_ids_are_read_before_the_scans(tube_rig, clouds):
    with pytest.raises(InputError, match="subjects: got 1 for scan 0 and '1' for scan 1"):
        collected(tube_rig, [lambda: pytest.fail("read first")] * 4, [1, "1", 1, "1"])
    assert collected(tube_rig, clouds[:4], [1, np.int64(1), "2", np.str_("2")]).subjects == [1, "2"]


def test_the_odd_ones_are_far_from_the_largest_group():
    assert list(odd_ones(np.array([1.0, 1.2, 0.8, 1.1]), 1.6)) == []
    assert list(odd_ones(np.array([1.0, 2.6, 0.9, 1.1]), 1.6)) == [1]
    assert list(odd_ones(np.array([0.01, 1.0, 90.0, 0.9, 1.1]), 6)) == [0, 2]
    assert len(odd_ones(np.array([1.0, 1.1, 2.5, 2.6]), 1.6)) == 2
    assert list(odd_ones(np.array([3.0]), 1.6)) == []
    assert list(odd_ones(np.array([1.0] * 10 + [0.8, 1.3]), 1.6)) == []  # no two far apart are far from the others
    assert list(odd_ones(np.array([1.61] + [1.0] * 12 + [1.2, 1.4]), 1.6)) == [0]  # which makes none of the two odd
    for alike in ([1.0, 1.5, 1.9], np.arange(0.8, 1.31, 0.05), np.arange(0.8, 1.41, 0.1)):  # near the middle, all of them
        assert not len(odd_ones(np.array(alike), 1.6))
    assert list(odd_ones(np.array([1.0, 4.5, 100.0]), 1.6)) == [0, 2]  # never all
    for sizes in ([1.0, 1.0, 5.0, 5.0], [1.0, 2.0], [1.0, 1.1, 2.5, 2.6]):  # whatever their order
        assert list(odd_ones(np.array(sizes[::-1]), 1.6)) == [len(sizes) - 1 - k for k in odd_ones(np.array(sizes), 1.6)[::-1]]


@pytest.mark.parametrize(
    "held_out, apart, role",
    [
        (False, False, "learned from"),
        (True, False, "held out of learning"),
        (False, True, "not learned from"),
        (True, True, "not learned from"),  # nor asked when to stop
    ],
)
def test_what_a_scan_is_to_learning(held_out, apart, role):
    member = Member(0, np.zeros((0, 3)), None, None, "a", held_out=held_out, apart=apart)
    assert member.role == role and Collection(1, [member]).with_role(role, "a") == [member]


def test_another_scan_is_held_out_where_none_is_any_more(tube_rig, clouds):
    found = collected(tube_rig, [clouds[k % 3] for k in range(7)], list("aabbbba"), held_out=0)

    def held():
        return [m.index for m in found.with_role(HELD_OUT)]

    found.members[0].held_out = found.members[0].apart = True
    found.keep_one_held_out()
    assert held() == [5]  # of b, who has most to learn from
    found.keep_one_held_out()
    assert held() == [5]
    found.members[5].apart = True
    for k in (1, 2):
        found.members[k].apart = True
    found.keep_one_held_out()
    assert held() == [4]
    found.members[4].apart = True
    found.keep_one_held_out()  # two are needed to learn from
    assert held() == []


def test_bad_scans_are_set_aside_with_their_reasons(tube_rig, clouds):
    given = [clouds[0], NAN, clouds[1], np.zeros((0, 3)), functools.partial(lbs.load_scan, "nowhere.ply"), lambda: clouds[2]]
    found = collected(tube_rig, given, list("abcdef"))
    assert found.n == 6 and [m.index for m in found.members] == [0, 2, 5] and found.subjects == ["a", "c", "f"]
    assert set(found.failures) == {1, 3, 4}
    assert "NaN" in found.failures[1] and "empty" in found.failures[3] and "nowhere.ply" in found.failures[4]
    np.testing.assert_array_equal(found.members[2].points, clouds[2])
    assert [m.index for m in found.of("c")] == [2]


@pytest.mark.parametrize("ids", [[3, 3, 4, 4], np.array([3, 3, 4, 4]), np.array(["x", "x", "y", "y"]), ("x", "x", 3, 3)])
def test_ids_of_any_plain_kind(tube_rig, clouds, ids):
    found = collected(tube_rig, clouds[:4], ids)
    assert len(found.subjects) == 2 and all(type(s) in (int, str) for s in found.subjects)
    assert [m.subject for m in found.members] == list(ids)


def test_without_ids_there_is_one_subject(tube_rig, clouds):
    assert collected(tube_rig, clouds[:4]).subjects == [0]


@pytest.mark.parametrize("share, expected", [(0.0, 0), slow(0.01, 1), slow(0.25, 3), (0.33, 4)])
def test_each_subject_keeps_two_scans(tube_rig, clouds, share, expected):
    ids = [0] * 3 + [1] * 3 + [2] * 6
    for seed in range(20):
        members = collected(tube_rig, clouds[:12], ids, held_out=share, random_state=seed).members
        assert sum(m.held_out for m in members) == expected
        for s in range(3):
            assert sum(m.subject == s and not m.held_out for m in members) >= 2
    again = [m.held_out for m in collected(tube_rig, clouds[:12], ids, held_out=share, random_state=19).members]
    assert again == [m.held_out for m in members]


def test_the_only_scan_of_a_subject_is_left_out_last(tube_rig, clouds):
    ids = [0, 0, 1, 1, 2, 3, 4, 5, 6, 7]
    for seed in range(6):
        members = collected(tube_rig, clouds[:10], ids, held_out=0.2, random_state=seed).members
        assert sorted(m.subject for m in members if m.held_out) == [0, 1]


def test_subjects_of_one_scan_can_be_left_out_where_there_are_no_others(tube_rig, clouds):
    members = collected(tube_rig, clouds[:10], range(10), held_out=0.2).members
    assert sum(m.held_out for m in members) == 2


def test_large_scans_are_thinned_by_the_seed_and_their_number(tube_rig, clouds):
    a, b, c = (collected(tube_rig, [*clouds[:3], clouds[0]], max_points=100, random_state=seed).members for seed in (0, 0, 1))
    for m, n in zip(a, b):
        np.testing.assert_array_equal(m.part.rows, n.part.rows)
    assert len(a[0].part.rows) == 100 and len(np.unique(a[0].part.rows)) == 100 and len(a[0].points) == len(clouds[0])
    assert not np.array_equal(a[0].part.rows, c[0].part.rows) and not np.array_equal(a[0].part.rows, a[3].part.rows)
    np.testing.assert_allclose(a[0].frame.centre, clouds[0][a[0].part.rows].mean(axis=0))
    np.testing.assert_array_equal(a[0].frame.turn, np.eye(3))


def test_all_scans_get_the_unit_of_most(tube_rig, clouds):
    found = collected(tube_rig, [250 * c for c in clouds[:4]])
    assert {m.unit for m in found.members} == {250.0}  # millimetres, and the rig's unit is 0.25 m
    folded = [0.3 * clouds[0], *clouds[1:4]]  # its own extent would be another unit's
    assert {(m.unit, m.frame.unit) for m in collected(tube_rig, folded).members} == {(1.0, tube_rig.size / 2)}


@pytest.mark.parametrize("walls, kept", [(1, True), (2, False), (4, False)])
def test_a_floor_below_another_axis_is_one_where_half_of_the_scans_have_it(walls, kept, tube_rig):
    """Else it is taken for a side of the body; what the rig stands on is a floor of each by itself."""
    scans, rng = lbs.synthesize(tube_rig, 4, random_state=5, n_points=400, shape=0.0), np.random.default_rng(0)
    ups = facing_of(tube_rig, "upright").floors
    for axis, stays in ((2, kept), (1, False)):
        clouds = [s.points for s in scans]
        for i in range(walls):
            size = np.ptp(clouds[i], axis=0).max()
            wall = clouds[i].mean(axis=0) + 2 * size * (rng.random((500, 3)) - 0.5)
            wall[:, axis] = clouds[i][:, axis].min() - 0.02 * size
            clouds[i] = np.vstack([clouds[i], wall])
        members = collected(tube_rig, clouds, held_out=0.0, ups=ups).members
        for m, points in zip(members, clouds, strict=True):
            floor = len(points) > 400 and not stays
            assert ("of a floor" in m.part.note) == floor
            assert len(m.part.rows) == pytest.approx(400 if floor else len(points), abs=15)
            np.testing.assert_allclose(m.frame.centre, m.x.mean(axis=0))


def test_floors_are_counted_among_the_scans_that_can_be_used(tube_rig):
    """One of two has it, however many more are broken."""
    clouds = [s.points for s in lbs.synthesize(tube_rig, 2, random_state=5, n_points=400, shape=0.0)]
    wall = clouds[0].mean(axis=0) + 2 * np.ptp(clouds[0], axis=0).max() * (np.random.default_rng(0).random((500, 3)) - 0.5)
    wall[:, 2] = clouds[0][:, 2].min() - 0.02
    broken = [np.full((5, 3), np.nan)] * 3
    scans = [np.vstack([clouds[0], wall]), clouds[1], *broken]
    found = collected(tube_rig, scans, held_out=0.0, ups=facing_of(tube_rig, "upright").floors)
    assert len(found.failures) == 3 and "of a floor" in found.members[0].part.note


def test_floors_below_several_axes_are_counted_by_axis(tube_rig):
    """Two walls each below one of two axes, of four scans, are floors; one each is a side of the body."""
    scans, rng = lbs.synthesize(tube_rig, 4, random_state=5, n_points=400, shape=0.0), np.random.default_rng(0)
    for axes, left_out in (((0, 0, 2, 2), 4), ((0, 2, None, None), 0)):
        clouds = []
        for scan, axis in zip(scans, axes, strict=True):
            size = np.ptp(scan.points, axis=0).max()
            wall = scan.points.mean(axis=0) + 2 * size * (rng.random((500, 3)) - 0.5)
            if axis is not None:
                wall[:, axis] = scan.points[:, axis].min() - 0.02 * size
            clouds.append(np.vstack([scan.points, wall[: 0 if axis is None else None]]))
        members = collected(tube_rig, clouds, held_out=0.0, ups=facing_of(tube_rig, "upright").floors).members
        assert sum("of a floor" in m.part.note for m in members) == left_out


def test_a_wall_that_cannot_take_part_stays_a_floor(tube_rig):
    """A scan that is in the rig's unit but for a wide wall neither ends the learning nor is lost."""
    clouds = [s.points for s in lbs.synthesize(tube_rig, 4, random_state=5, n_points=400, shape=0.0)]
    wall = clouds[0].mean(axis=0) + 6 * np.ptp(clouds[0], axis=0).max() * (np.random.default_rng(0).random((500, 3)) - 0.5)
    wall[:, 2] = clouds[0][:, 2].min() - 0.02
    clouds[0] = np.vstack([clouds[0], wall])
    found = collected(tube_rig, clouds, held_out=0.0, scale="fixed", ups=facing_of(tube_rig, "upright").floors)
    assert not found.failures and len(found.members) == 4 and "of a floor" in found.members[0].part.note


def _taught(n):
    """n members that were learned from."""
    return {i: SimpleNamespace(index=i, role=LEARNED_FROM, subject=0) for i in range(n)}
