"""Scans that go on beyond the end of the rig, such as hands with a forearm: what is left out, and that the fit comes out."""

import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_fits import MadeFits, hands_with_arms, true_fit
from scipy.sparse import csr_matrix

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.scan_fit import ScanFit
from lbsfit_np.learning import new_scan
from lbsfit_np.optimize.frame import root_turn
from lbsfit_np.optimize.model import Model
from lbsfit_np.starts.beyond import beyond, cuts, end_of, goes_on, scales_of
from lbsfit_np.starts.clean import taking_part


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def scans(hand):
    return hands_with_arms(hand)


# ---- where a rig ends ----


def _hanging_on(rig, joint):
    """The rig with all skin of the root on another joint."""
    weights, j = rig.weights.toarray(), rig.joint_names.index(joint)
    weights[:, j] += weights[:, rig.root]
    weights[:, rig.root] = 0
    return replace(rig, weights=csr_matrix(weights))


def test_a_hand_ends_at_its_wrist_and_a_body_nowhere(hand):
    end, wrist = end_of(hand), hand.joints[hand.root]
    tips = hand.joints[[hand.joint_names.index(name) for name in ("index3", "middle3", "ring3", "pinky3")]]
    assert ((wrist - tips) @ end.direction > 0.5 * hand.size).all()
    assert 0 < end.reach < 0.25 * end.length and end.length == pytest.approx(hand.size, rel=0.02)
    body = lbs.load_rig("body-coarse")
    assert end_of(body) is None
    feet = body.vertices.min(axis=0) * [0, 1, 0]  # a root on the ground, which moves nothing by itself
    on_the_ground = body.joints.copy()
    on_the_ground[body.root] = feet
    assert end_of(_hanging_on(body, "spine1"), joints=on_the_ground) is None


def test_an_end_may_be_of_a_joint_that_never_moves(hand):
    """As where all skin about the wrist hangs on bones of the palm."""
    hanging = _hanging_on(hand, "middle1")
    assert end_of(hanging) is None
    locked = hanging.locked.copy()
    locked[hanging.joint_names.index("middle1")] = True
    assert end_of(replace(hanging, locked=locked)).reach == pytest.approx(end_of(hand).reach)


# ---- what lies beyond ----


@pytest.mark.parametrize("factor", [1.0, 250.0])
def test_the_arm_lies_beyond_a_fit_that_is_right_and_the_hand_does_not(hand, scans, factor):
    for scan in scans:
        arm, found = scan.labels < 0, true_fit(hand, scan)
        found.joints, found.vertices, found.scale = factor * found.joints, factor * found.vertices, factor
        past = beyond(factor * scan.points, hand, found)
        assert not past[~arm].any() and past[arm].mean() > 0.75
        away = np.linalg.norm(scan.points[arm & ~past, None] - scan.vertices, axis=2).min(axis=1)
        assert away.max() < 0.1 * hand.size  # what is left is at the wrist


def test_wild_points_do_not_upset_what_lies_beyond(hand, scans):
    scan, found = scans[0], true_fit(hand, scans[0])
    past = beyond(scan.points, hand, found)
    with np.errstate(over="ignore"):
        again = beyond(np.vstack([scan.points, [[1e200, 0, 0], [-1e200, 1e180, 0]]]), hand, found)
    np.testing.assert_array_equal(again[:-2], past)


def test_what_lies_beside_the_end_of_a_large_scan_fills_no_memory(hand, scans, monkeypatch):
    """As of a hand and an arm of millions of points, where the fit in doubt has the wrist bent the wrong way."""
    scan, found = scans[0], true_fit(hand, scans[0])
    end, wrist = end_of(hand), scan.joints[hand.root]
    direction = root_turn(hand, scan.pose) @ end.direction
    aside = wrist - scan.joints[hand.joint_names.index("thumb3")]
    aside -= aside @ direction * direction
    arm = wrist + end.reach * direction + np.linspace(2.0, 9.0, 40_000)[:, None] * aside
    points = np.concatenate([scan.points, arm])
    tracemalloc.start()
    past = beyond(points, hand, found)
    tracemalloc.reset_peak()
    monkeypatch.setattr("lbsfit_np.starts.beyond._AT_ONCE", 5000)
    np.testing.assert_array_equal(beyond(points, hand, found), past)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert past[len(scan.points) :].mean() > 0.9 and peak < 30e6


def test_a_point_that_a_finger_does_not_explain_does_not_lie_beyond(hand, scans):
    scan = scans[0]
    tip = scan.joints[hand.joint_names.index("index3")]
    away = root_turn(hand, scan.pose) @ -end_of(hand).direction
    odd = tip + np.outer(np.linspace(0.2, 1.0, 20), away) * hand.size
    assert not beyond(odd, hand, true_fit(hand, scan)).any()
    nowhere = true_fit(hand, scan)
    nowhere.vertices = np.full_like(scan.vertices, np.nan)
    assert not beyond(scan.points, hand, nowhere).any()


def test_cuts_are_a_part_of_the_rigs_length_from_either_end():
    rng = np.random.default_rng(0)
    end = SimpleNamespace(length=1.0)
    line = rng.uniform(0, 2, (2000, 1)) * [0.6, 0.8, 0] + 0.05 * rng.standard_normal((2000, 3))
    along = line @ [0.6, 0.8, 0]
    for (low, high), share in zip(cuts(line, end, (1.0,)), (0.7, 1.0), strict=True):
        ends = sorted([along[low(line)], along[high(line)]], key=np.mean)  # which way the axis points does not matter
        assert abs(ends[0].max() - share) < 0.1 and ends[0].min() == along.min()
        assert abs(ends[1].min() - (2 - share)) < 0.1 and ends[1].max() == along.max()
    assert len(list(cuts(line, end, (1.0, 1000.0, 0.001)))) == 2  # in other units it is too short, or too long
    assert len(list(cuts(0.45 * line, end, (1.0,)))) == 1 and not list(cuts(0.35 * line, end, (1.0,)))


def test_a_scan_goes_on_that_is_longer_in_each_unit_that_it_may_be_in():
    line, end = np.linspace(0, 1, 500)[:, None] * [1.0, 0, 0], SimpleNamespace(length=1.0)
    assert [goes_on(size * line, end, (1.0,)) for size in (0.5, 1.2, 1.4, 5.0, 7.0)] == [False, False, True, True, False]
    assert goes_on(2.0 * line, end, (1.0, 100.0)) and not goes_on(2.0 * line, end, (1.0, 2.5))


def test_units_that_a_scan_may_have(hand):
    assert set(scales_of(hand, "estimate")) >= {1.0, 100.0, 1000.0} and len(set(scales_of(hand, "estimate"))) == 4
    assert scales_of(hand, "estimate", "mm") == (1000.0,) and scales_of(hand, "fixed") == (1.0,)
    assert scales_of(replace(hand, metres_per_unit=None), "estimate") == (1.0,)


# ---- the second look ----


@pytest.fixture(scope="module")
def long_scan(scans):
    return max(scans, key=lambda s: len(s.points))


@pytest.fixture(scope="module")
def short_scan(scans):
    return min(scans, key=lambda s: len(s.points))


def _sure_of(where):
    return {"hand_end": (where, 0.3), "arm_end": ("turned", 0.1), "hand": ("true", 0.9)}


@pytest.mark.parametrize("of_all, before", [(("true", 0.2), ["all"]), (("turned", 0.3), ["all", "hand_end", "arm_end"])])
def test_of_a_long_scan_the_hand_is_found_and_nothing_is_looked_at_twice(hand, long_scan, of_all, before):
    """By a fit of all, which is right but for what it cannot explain, or by those of the two ends."""
    fits = MadeFits(hand, long_scan, all=of_all, **_sure_of("true"))
    result = fits()
    assert result.probability == 0.9 and sorted(set(fits.of[:-1])) == sorted(before) and fits.of[-1] == "hand" and all(fits.once)
    assert (result.seconds, result.evaluations) == (len(fits.of), 10 * len(fits.of))


@pytest.mark.parametrize("of_the_hand", [0.55, 0.3])
def test_a_long_scan_that_is_none_too_sure_is_looked_at_closely(hand, long_scan, of_the_hand):
    """It may be of a large hand; as with any other scan, a pose in doubt gets a second look."""
    fits = MadeFits(hand, long_scan, all=("true", 0.6), **_sure_of("true") | {"hand": ("true", of_the_hand)})
    assert fits().probability == 0.6 and fits.of[-1] == "all" and not fits.once[-1] and all(fits.once[:-1])


@pytest.mark.parametrize("status, of", [("ok", {"all"}), ("failed", {"all", "hand_end", "arm_end", "hand"})])
def test_without_skinning_nothing_is_looked_for_but_where_a_fit_is_not_finite(hand, long_scan, status, of):
    fits = MadeFits(hand, long_scan, all=("turned", 0.0), **_sure_of("true"))
    one = fits.fit

    def fit(part, once):
        found = one(part, once)
        return replace(found, evidence={}, status=status) if fits.of[-1] == "all" else found

    fits.fit = fit
    assert fits().status == "ok" and set(fits.of) == of


def test_a_given_pose_is_fitted_at_once(hand, long_scan):
    fits = MadeFits(hand, long_scan, all=("true", 0.2), **_sure_of("true"))
    assert fits(given=("theta0",)).probability == 0.9 and fits.of == ["all", "hand"] and fits.once == [False, True]


def test_of_a_shorter_scan_all_is_done_for_the_whole_first(hand, short_scan):
    fits = MadeFits(hand, short_scan, all=("true", 0.2), **_sure_of("true"))
    assert fits().probability == 0.9 and fits.of == ["all", "hand"] and fits.once == [False, True]
    fits = MadeFits(hand, short_scan, all=("true", 0.6))
    assert fits().probability == 0.6 and fits.once == [False]


def test_a_long_scan_that_is_right_is_of_a_large_hand(hand, long_scan):
    fits = MadeFits(hand, long_scan, all=("true", 0.85))
    assert fits().probability == 0.85 and fits.of == ["all"]


@pytest.mark.parametrize(
    "of_the_hand, probability",
    [(("turned", 0.9), 0.4), (("true", 0.9, 7), 0.4), (("true", 0.3), 0.4), (("true", 0.45, 6), 0.45)],
)
def test_what_does_not_help_is_not_taken(hand, long_scan, of_the_hand, probability):
    """What lay beyond one fit's end has to lie beyond the other's, too, and most joints have to be told, which no solid does.

    With nothing sure the whole is looked at closely.
    """
    known = {"hand_end": ("true", 0.3), "arm_end": ("turned", 0.1), "hand": of_the_hand}
    fits = MadeFits(hand, long_scan, all=("true", 0.4), **known)
    result = fits()
    assert result.probability == probability and result.status == "suspect"
    assert fits.of[-1] == "all" and fits.once == [True] * (len(fits.of) - 1) + [False]
    assert (result.seconds, result.evaluations) == (len(fits.of), 10 * len(fits.of))


def test_an_end_that_cannot_be_worked_with_takes_no_fit_away(hand, long_scan):
    fits = MadeFits(hand, long_scan, all=("turned", 0.3), **_sure_of("true"))
    whole = fits.taking_part

    def taking_part(among, sure):
        if fits._of(among) == "arm_end":
            raise InputError("points", "some", "others")
        return whole(among, sure)

    fits.taking_part = taking_part
    assert fits().probability == 0.9 and "arm_end" not in fits.of


def test_a_fit_of_guesses_does_not_say_what_lies_beyond(hand, long_scan):
    """The ends are looked at first, which tell more."""
    fits = MadeFits(hand, long_scan, all=("true", 0.2, 7), **_sure_of("true"))
    assert fits().probability == 0.9 and set(fits.of[1:3]) == {"hand_end", "arm_end"}


@pytest.mark.parametrize("once", [False, True])
def test_the_scout_is_told_to_look_once(hand, long_scan, once):
    told, fit = [], ScanFit(Model(hand))

    def scout(points, x_weights, *, once):
        told.append(once)
        raise KeyboardInterrupt  # that is all there is to know

    fit.scout = scout
    part = fit.taking_part(long_scan.points, random_state=0)
    with pytest.raises(KeyboardInterrupt):
        fit.fit(long_scan.points, part=part, once=once)
    assert told == [once]


@pytest.mark.parametrize("known", ["effort", "labels"])
def test_where_it_is_said_what_is_of_the_hand_nothing_is_looked_for(hand, long_scan, known):
    fits = MadeFits(hand, long_scan, all=("true", 0.2))
    given = {"effort": "fast"} if known == "effort" else {"given": ("labels",)}
    assert fits(**given).probability == 0.2 and fits.once == [False]


def test_after_learning_the_hand_is_found_as_well(hand, long_scan, monkeypatch):
    """The scout of a learned template, too, looks once at each part."""
    fits, seen = MadeFits(hand, long_scan, all=("turned", 0.1), **_sure_of("true")), []

    def fit(fitter, points, part, *more, once):
        seen.append(part)
        past = np.ones(len(points), dtype=bool)
        past[part.every] = False
        among = None if len(part.every) == len(points) else ~past
        return fits.fit(SimpleNamespace(among=among), once)

    monkeypatch.setattr(new_scan, "_fit_new", fit)
    fitter = lbs.LBSFitter(hand, random_state=0, max_points=10_000)
    fitter.regressor_ = "a library"
    result = new_scan.fit_new(fitter, long_scan.points, ("ann",), None, None, None)
    assert result.probability == 0.9 and all(fits.once) and "the scan seems to go on beyond the rig" in seen[-1].note


# ---- what takes part ----


def test_what_takes_part_is_told_of_the_body_alone(hand, long_scan):
    """Points without depth and floors are told of by themselves, and what is thinned is filled up."""
    rng, n = np.random.default_rng(0), len(long_scan.points)
    low = long_scan.points[:, 1].min() - 0.02 * hand.size
    floor = rng.uniform(-3, 3, (n, 3)) * [hand.size, 0, hand.size] + [0, low, 0]
    points = np.concatenate([long_scan.points, floor, np.zeros((500, 3))])
    among = np.ones(len(points), dtype=bool)
    among[:n] = long_scan.labels >= 0
    among[n : n + n // 2] = False  # of the floor, as much as lies beyond
    part = taking_part(points, hand, most=1500, rng=rng, scale="estimate", ups=[np.array([0.0, 1.0, 0.0])], among=among)
    share = (long_scan.labels < 0).mean()
    assert f"beyond the rig: {share:.0%}"[:-2] in part.note and "500 identical points" in part.note
    assert "of a floor" in part.note and len(part.rows) > 1200
    assert among[part.every].all() and (part.every < n).all()
