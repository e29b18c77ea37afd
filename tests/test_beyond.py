"""Scans that go on beyond the end of the rig, such as hands with a forearm: what is left out, and that the fit comes out."""

from dataclasses import make_dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_matrix

import lbsfit_np as lbs
from lbsfit_np.bench.conditions import CONDITIONS, condition_scan
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.fitting.second_look import looked_at_again
from lbsfit_np.learning import new_scan
from lbsfit_np.learning.checkpoint import digest_of
from lbsfit_np.learning.collection import Member
from lbsfit_np.learning.first_fits import FirstFit
from lbsfit_np.optimize.frame import root_turn, turned_root
from lbsfit_np.optimize.model import Model
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.beyond import beyond, cuts, end_of, goes_on, scales_of
from lbsfit_np.starts.clean import TakingPart, taking_part
from lbsfit_np.starts.turns import Facing


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def scans(hand):
    """Hands with arms, facing the rig's way or turned."""
    return [condition_scan(hand, CONDITIONS["arm"], i, np.random.default_rng(i)) for i in range(6)]


def _true(rig, scan):
    """As a fit that has found the truth has it."""
    return SimpleNamespace(
        offsets=scan.template - rig.vertices,
        rest_joints=scan.template_joints,
        pose=scan.pose,
        joints=scan.joints,
        vertices=scan.vertices,
        scale=scan.scale,
    )


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
        arm, found = scan.labels < 0, _true(hand, scan)
        found.joints, found.vertices, found.scale = factor * found.joints, factor * found.vertices, factor
        past = beyond(factor * scan.points, hand, found)
        assert not past[~arm].any() and past[arm].mean() > 0.75
        away = np.linalg.norm(scan.points[arm & ~past, None] - scan.vertices, axis=2).min(axis=1)
        assert away.max() < 0.1 * hand.size  # what is left is at the wrist


def test_a_point_that_a_finger_does_not_explain_does_not_lie_beyond(hand, scans):
    scan = scans[0]
    tip = scan.joints[hand.joint_names.index("index3")]
    away = root_turn(hand, scan.pose) @ -end_of(hand).direction
    odd = tip + np.outer(np.linspace(0.2, 1.0, 20), away) * hand.size
    assert not beyond(odd, hand, _true(hand, scan)).any()
    nowhere = _true(hand, scan)
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


class _Fits:
    """Fits whose ends, where they are and how probable, hang on what of a scan they are of."""

    def __init__(self, rig, scan, **ends):
        self.hand, self.scan, self.arm = rig, scan, scan.labels < 0
        self.ends, self.of, self.once = ends, [], []

    def taking_part(self, ups, among):
        rows = np.arange(len(self.scan.points))
        return SimpleNamespace(rows=rows if among is None else rows[among], among=among, floor_elsewhere=False)

    def fit(self, part, once):
        self.of.append(self._of(part.among))
        self.once.append(once)
        where, probability, *guesses = self.ends[self.of[-1]]
        std = np.where(np.arange(len(self.hand.parents)) < sum(guesses), 0.1, 0.001) * self.hand.size
        status = "ok" if probability >= 0.5 else "suspect"
        known = {"status": status, "probability": probability, "seconds": float(len(self.of)), "evaluations": 10}
        known |= {"joint_std": std, "evidence": {"unexplained": 0.1}, "confidence": np.ones(len(self.arm))}
        fields = vars(self._found(where)) | known
        return make_dataclass("Result", list(fields), frozen=True, eq=False)(**fields)

    def _of(self, among):
        if among is None:
            return "all"
        hand, arm = among[~self.arm].mean(), among[self.arm].mean()
        return "hand" if hand == 1 and arm < 0.4 else "hand_end" if hand > arm else "arm_end"

    def _found(self, where):
        found, root = _true(self.hand, self.scan), self.hand.root
        found.vertices = found.vertices.copy()  # each fit has its own
        if where == "turned":  # by 180 degrees about the wrist, the fingers in the arm
            axis = np.cross(root_turn(self.hand, found.pose) @ end_of(self.hand).direction, [1.0, 2.0, 3.0])
            turn, wrist = matrix_from_rotvec(np.pi * axis / np.linalg.norm(axis)), found.joints[root]
            found.pose = turned_root(self.hand, found.pose, turn)
            found.joints = (found.joints - wrist) @ turn.T + wrist
            found.vertices = (found.vertices - wrist) @ turn.T + wrist
        return found

    def __call__(self, *, given=(), **settings):
        known = {"ups": None, "settings": FitSettings(**settings), "given": given}
        return looked_at_again(self.taking_part, self.fit, self.scan.points, self.hand, **known)


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
    fits = _Fits(hand, long_scan, all=of_all, **_sure_of("true"))
    result = fits()
    assert result.probability == 0.9 and sorted(set(fits.of[:-1])) == sorted(before) and fits.of[-1] == "hand" and all(fits.once)
    assert (result.seconds, result.evaluations) == (len(fits.of), 10 * len(fits.of))
    assert (result.confidence[~fits.arm] == 1).all() and (result.confidence[fits.arm] == 0).mean() > 0.75


@pytest.mark.parametrize("of_the_hand", [0.55, 0.3])
def test_a_long_scan_that_is_none_too_sure_is_looked_at_closely(hand, long_scan, of_the_hand):
    """It may be of a large hand; as with any other scan, a pose in doubt gets a second look."""
    fits = _Fits(hand, long_scan, all=("true", 0.6), **_sure_of("true") | {"hand": ("true", of_the_hand)})
    assert fits().probability == 0.6 and fits.of[-1] == "all" and not fits.once[-1] and all(fits.once[:-1])


@pytest.mark.parametrize("status, of", [("ok", {"all"}), ("failed", {"all", "hand_end", "arm_end", "hand"})])
def test_without_skinning_nothing_is_looked_for_but_where_a_fit_is_not_finite(hand, long_scan, status, of):
    fits = _Fits(hand, long_scan, all=("turned", 0.0), **_sure_of("true"))
    one = fits.fit

    def fit(part, once):
        found = one(part, once)
        return replace(found, evidence={}, status=status) if fits.of[-1] == "all" else found

    fits.fit = fit
    assert fits().status == "ok" and set(fits.of) == of


def test_a_given_pose_is_fitted_at_once(hand, long_scan):
    fits = _Fits(hand, long_scan, all=("true", 0.2), **_sure_of("true"))
    assert fits(given=("theta0",)).probability == 0.9 and fits.of == ["all", "hand"] and fits.once == [False, True]


def test_of_a_shorter_scan_all_is_done_for_the_whole_first(hand, short_scan):
    fits = _Fits(hand, short_scan, all=("true", 0.2), **_sure_of("true"))
    assert fits().probability == 0.9 and fits.of == ["all", "hand"] and fits.once == [False, True]
    fits = _Fits(hand, short_scan, all=("true", 0.6))
    assert fits().probability == 0.6 and fits.once == [False]


def test_a_long_scan_that_is_right_is_of_a_large_hand(hand, long_scan):
    fits = _Fits(hand, long_scan, all=("true", 0.85))
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
    fits = _Fits(hand, long_scan, all=("true", 0.4), **known)
    result = fits()
    assert result.probability == probability and result.status == "suspect"
    assert fits.of[-1] == "all" and fits.once == [True] * (len(fits.of) - 1) + [False]
    assert (result.seconds, result.evaluations) == (len(fits.of), 10 * len(fits.of))


def test_an_end_that_cannot_be_worked_with_takes_no_fit_away(hand, long_scan):
    fits = _Fits(hand, long_scan, all=("turned", 0.3), **_sure_of("true"))
    whole = fits.taking_part

    def taking_part(ups, among):
        if fits._of(among) == "arm_end":
            raise InputError("points", "some", "others")
        return whole(ups, among)

    fits.taking_part = taking_part
    assert fits().probability == 0.9 and "arm_end" not in fits.of


def test_a_fit_of_guesses_does_not_say_what_lies_beyond(hand, long_scan):
    """The ends are looked at first, which tell more."""
    fits = _Fits(hand, long_scan, all=("true", 0.2, 7), **_sure_of("true"))
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
    fits = _Fits(hand, long_scan, all=("true", 0.2))
    given = {"effort": "fast"} if known == "effort" else {"given": ("labels",)}
    assert fits(**given).probability == 0.2 and fits.once == [False]


def test_after_learning_the_hand_is_found_as_well(hand, long_scan, monkeypatch):
    """The scout of a learned template, too, looks once at each part."""
    fits, seen = _Fits(hand, long_scan, all=("turned", 0.1), **_sure_of("true")), []

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
    assert result.probability == 0.9 and all(fits.once) and "taken to go on beyond the rig" in seen[-1].left_out


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
    assert f"beyond the rig, {share:.0%}"[:-2] in part.left_out and "500 identical points" in part.left_out
    assert "of a floor" in part.left_out and len(part.rows) > 1200
    assert among[part.every].all() and (part.every < n).all()


# ---- collections ----


class _Scout:
    """What a scout says of what takes part, and how often it was asked."""

    def __init__(self, sure):
        self.sure, self.of = sure, []

    def __call__(self, points, *, once):
        self.of.append((len(points), once))
        problem = SimpleNamespace(evaluate=lambda *given: SimpleNamespace(value=0.5))
        return SimpleNamespace(frame=None, state=len(points), proba=None, problem=problem)

    def is_sure(self, found):
        return self.sure


def _first_fit(hand, fits, *, sure, **settings):
    """A first fit whose fits are made ones, and its scout."""
    work = FirstFit(Model(hand), FitSettings(**settings), None, None, Facing(), True, 0)
    scout = _Scout(sure)

    def fit(points, *, part, found):
        assert found.state == len(part.rows)
        return fits.fit(SimpleNamespace(among=part.among), scout.of[-1][1])

    def taking(points, point_weights, seed, *, ups, among):
        rows = np.arange(len(points)) if among is None else np.flatnonzero(among)
        return TakingPart(rows, rows[:0], "", 1.0, None, among)

    object.__setattr__(work, "_fit", SimpleNamespace(scout=scout, fit=fit, taking_part=taking))
    return work, scout


def _member(scan):
    rows = np.arange(len(scan.points))
    return Member(0, scan.points, TakingPart(rows, rows[:0], "", 1.0, None), None, "ann")


@pytest.mark.parametrize("settings, sure", [({}, True), ({"effort": "fast"}, False)])
def test_a_first_fit_that_is_sure_or_fast_is_not_looked_at_again(hand, short_scan, settings, sure):
    fits = _Fits(hand, short_scan)
    work, scout = _first_fit(hand, fits, sure=sure, **settings)
    assert work(_member(short_scan)) == (None, len(short_scan.points), 0.5, None, None)
    assert scout.of == [(len(short_scan.points), False)] and not fits.of


@pytest.mark.parametrize("which", ["long_scan", "short_scan"])
def test_a_first_fit_in_doubt_is_of_what_lies_within_the_rig(hand, which, request):
    scan = request.getfixturevalue(which)
    fits = _Fits(hand, scan, all=("true", 0.2), hand=("true", 0.9))
    work, scout = _first_fit(hand, fits, sure=False)
    *_, state, _, _, part = work(_member(scan))
    arm = scan.labels < 0
    assert part.among[~arm].all() and part.among[arm].mean() < 0.25 and state == len(part.rows) == part.among.sum()
    # The scout's word on the whole is taken for the fit of the whole.
    assert [n for n, _ in scout.of] == [len(scan.points), len(part.rows)] and scout.of[0][1] == (which == "long_scan")


def test_a_first_fit_that_nothing_makes_likelier_stays(hand, short_scan):
    fits = _Fits(hand, short_scan, all=("true", 0.4), hand=("true", 0.1), hand_end=("turned", 0.1), arm_end=("turned", 0.1))
    work, scout = _first_fit(hand, fits, sure=False)
    assert work(_member(short_scan)) == (None, len(short_scan.points), 0.5, None, None) and len(scout.of) > 1


def test_what_is_kept_of_a_first_fit_hangs_on_all_points_where_the_rig_may_end_within_them(hand, short_scan):
    member = _member(short_scan)
    (work, _), (fast, _) = (_first_fit(hand, None, sure=True, effort=effort) for effort in ("balanced", "fast"))
    assert digest_of(fast.made_of(member)) == digest_of(short_scan.points)
    more = replace(member, points=np.concatenate([member.points, [[0.0, 0.0, 0.0]]]))
    assert digest_of(fast.made_of(more)) == digest_of(fast.made_of(member))
    assert digest_of(work.made_of(more)) != digest_of(work.made_of(member))
