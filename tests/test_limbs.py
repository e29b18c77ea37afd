"""Other poses for limbs: where all but an arm or two fingers is right, their right poses are proposed first."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse
from slow_tests import slow
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.fitting.refit import Refit, Runner
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rotations import rotvec_from_matrix
from lbsfit_np.skinning import skin
from lbsfit_np.starts import limbs as limbs_module
from lbsfit_np.starts.limbs import LimbPoses, _posed_limb, _Tried
from lbsfit_np.synthesis import natural_poses, sample_surface, uniform_poses

pytestmark = pytest.mark.usefixtures("one_thread")


class Case:
    """A rig's model and the poses that its limbs are tried in; points on known poses."""

    def __init__(self, rig, poses):
        self.rig, self.model, self.poses = rig, Model(rig), poses
        self.limbs = LimbPoses(self.model, poses)
        self.row = {name: j for j, name in enumerate(rig.joint_names)}

    def seen(self, theta, seed=0, n=1000, **changes):
        """(state, problem) of points on the surface."""
        state = self.model.rest().replace(theta=theta, **changes)
        V = self.model.pose(state)[0].vertices
        return state, Problem(sample_surface(V, self.model.rig.faces, n, np.random.default_rng([seed, 1]))[0])

    def error(self, theta, truth):
        """Mean distance of the joints in half sizes."""
        there = (self.model.pose(truth.replace(theta=t))[0].joints for t in (theta, truth.theta))
        return np.linalg.norm(np.subtract(*there), axis=1).mean()

    def limb(self, name):
        """(J,) bool: the joints of the limb that a joint belongs to."""
        (hangs,) = [limb.hangs for limb in self.limbs._limbs if limb.hangs[self.row[name]]]
        return hangs


@pytest.fixture(scope="module")
def hand():
    rig = lbs.load_rig("hand-coarse")
    return Case(rig, natural_poses(rig, 800, 0))


@pytest.fixture(scope="module")
def body():
    rig = lbs.load_rig("body-coarse")
    return Case(rig, natural_poses(rig, 800, 0))


@pytest.fixture(scope="module")
def tube(tube_rig):
    return Case(tube_rig, uniform_poses(tube_rig, 200, np.random.default_rng(0)))


@pytest.fixture(params=["hand", "body", "tube"])
def case(request):
    return request.getfixturevalue(request.param)


# ---- what a limb is ----


def test_limbs_are_chains_with_all_that_hangs_on_them(hand, body, tube):
    fingers = {frozenset(n for n in hand.row if limb.hangs[hand.row[n]]) for limb in hand.limbs._limbs}
    named = ("index", "middle", "ring", "pinky", "thumb")
    assert fingers == {frozenset(f"{name}{k}" for k in (1, 2, 3)) for name in named}
    for case in (hand, body, tube):
        for limb in case.limbs._limbs:
            joints = np.flatnonzero(limb.hangs)
            assert not limb.hangs[case.rig.root]
            assert all(limb.hangs[j] for j in range(len(case.row)) if case.rig.parents[j] in joints)
            assert set(limb.rows) <= set(np.flatnonzero(limb.skin)) and 0 < len(limb.rows) <= limbs_module._LIMB_VERTICES
            assert limb.angles.shape[1:] == (limb.hangs.sum(), 3)
    spine = next(limb.hangs for limb in body.limbs._limbs if limb.hangs[body.row["spine1"]])
    assert spine[body.row["left_hand"]] and spine[body.row["head"]] and not spine[body.row["left_knee"]]
    arm = min((limb.hangs for limb in body.limbs._limbs if limb.hangs[body.row["left_elbow"]]), key=np.sum)
    assert arm[body.row["left_hand"]] and not arm[body.row["head"]] and not arm[body.row["right_elbow"]]


def test_of_very_many_poses_evenly_taken_ones_are_tried(tube_rig):
    poses = np.zeros((2600, *tube_rig.lower.shape))
    poses[:] = np.arange(2600)[:, None, None]
    for limb in LimbPoses(Model(tube_rig), poses)._limbs:
        rows = limb.angles[:, 0, 0]
        assert len(rows) == limbs_module._POSES
        begin = 3.25 * np.arange(len(rows))  # one of each 3.25
        assert (rows >= np.floor(begin)).all() and (rows < begin + 3.25).all()


@pytest.mark.parametrize("changed", [False, True])
def test_posed_limbs_are_what_skinning_gives(case, changed):
    """Of the rig's own template and of changed ones, at any place and size."""
    rng = np.random.default_rng(3)
    model, rig = case.model, case.model.rig
    state = model.rest().replace(theta=case.poses[5], translation=rng.uniform(-1, 1, 3), scale=1.3)
    if changed:
        state = state.replace(
            coefficients=rng.uniform(-0.2, 0.2, model.n_coefficients), residual=0.02 * rng.standard_normal(rig.vertices.shape)
        )
    posed = model.pose(state)[0]
    place = {"translation": state.translation, "scale": state.scale}
    if changed:
        place |= {"offsets": model.offsets(state), "joint_offsets": model.joint_offsets(state)}
    for limb in case.limbs._limbs:
        angles = limb.angles[[0, 7, 30]]
        found = _posed_limb(posed, state, limb, angles)
        for V, a in zip(found, angles, strict=True):
            theta = state.theta.copy()
            theta[limb.hangs] = a
            np.testing.assert_allclose(V, skin(rig, theta, **place).vertices[limb.rows], atol=1e-12)


# ---- proposals ----


@pytest.mark.parametrize("name", ["flat", "spread", "fist", "point", "peace", "standing", "walking", "arms overhead", "running"])
def test_a_right_fit_gets_no_proposals(hand, body, name):
    case = hand if name in hand.rig.poses else body
    state, problem = case.seen(case.rig.poses[name])
    assert case.limbs.proposals(problem, state, 2) == []


@pytest.mark.parametrize("weight", [0.0, 1e-6])
def test_points_that_hardly_count_ask_for_no_limb(hand, weight):
    """As of another hand beside it."""
    state, problem = hand.seen(hand.rig.poses["point"])
    other = hand.seen(hand.rig.poses["fist"])[1].X + [0.6, 0.0, 0.0]
    weights = np.repeat([1.0, weight], [len(problem.X), len(other)])
    both = Problem(np.vstack([problem.X, other]), weights / weights.sum())
    assert hand.limbs.proposals(both, state, 2) == []
    heavy = Problem(both.X, np.full(len(both.X), 1.0 / len(both.X)))
    assert hand.limbs.proposals(heavy, state, 2)


@pytest.mark.parametrize("name", ["flat", "fist", "peace"])
def test_a_right_fit_of_other_proportions_gets_no_proposals(hand, name):
    state, problem = hand.seen(hand.rig.poses[name], coefficients=np.full(hand.model.n_coefficients, -0.2))
    assert hand.limbs.proposals(problem, state, 2) == []


@pytest.mark.parametrize("finger", ["index", "middle", "ring", "pinky"])
@pytest.mark.parametrize("bent", [False, True])
def test_a_finger_that_is_away_from_its_place_is_put_there_first(hand, finger, bent):
    """Straight and seen as bent, or bent and seen as straight; Gauss–Newton steps go neither way."""
    theta = np.zeros_like(hand.rig.lower)
    wrong = theta.copy()
    for k in (1, 2, 3):
        j = hand.row[f"{finger}{k}"]
        (theta if bent else wrong)[j, 0] = 0.9 * hand.rig.upper[j, 0]
    truth, problem = hand.seen(theta)
    state = truth.replace(theta=wrong)
    proposals = hand.limbs.proposals(problem, state, 2)
    before, after = hand.error(wrong, truth), hand.error(proposals[0], truth)
    assert before > 0.05 and after < 0.25 * before
    changed = (proposals[0] != wrong).any(axis=1)
    assert changed[hand.limb(f"{finger}1")].any() and not changed[hand.rig.root]


@pytest.mark.parametrize("joint, axis, angle", [("left_shoulder", 0, 1.0), ("right_hip", 0, 1.2), ("right_elbow", 0, 1.5)])
def test_a_limb_of_the_body(body, joint, axis, angle):
    theta = np.zeros_like(body.rig.lower)
    truth, problem = body.seen(theta)
    wrong = theta.copy()
    j = body.row[joint]
    wrong[j, axis] = angle
    proposals = body.limbs.proposals(problem, truth.replace(theta=wrong), 2)
    assert body.error(proposals[0], truth) < 0.4 * body.error(wrong, truth)


def test_what_is_proposed_is_a_pose_of_the_library(hand):
    truth, problem = hand.seen(hand.poses[200])
    wrong = _with_another(hand, truth.theta, "index1")
    finger, first = hand.limb("index1"), hand.limbs.proposals(problem, truth.replace(theta=wrong), 1)[0]
    assert hand.error(first, truth) < 0.015
    assert np.abs(hand.poses[:, finger] - first[finger]).max(axis=(1, 2)).min() == 0


@pytest.mark.parametrize("seed", [0, slow(1), slow(2)])
def test_looked_at_closer_a_limb_finds_a_pose_that_no_library_has(body, seed):
    poses = uniform_poses(body.rig, 2, np.random.default_rng(seed))
    (arm,) = [limb.hangs for limb in body.limbs._limbs if limb.hangs[body.row["left_elbow"]] and limb.ends]
    theta, wrong = (np.where(arm[:, None], pose, 0.0) for pose in poses)
    truth, problem = body.seen(theta)
    state = truth.replace(theta=wrong)
    first = body.limbs.proposals(problem, state, 1, closer=True)[0]
    known = [*body.limbs.proposals(problem, state, 1), wrong][0]
    assert body.error(first, truth) < min(0.02, 0.7 * body.error(known, truth))
    assert (first[arm] >= body.rig.lower[arm]).all() and (first[arm] <= body.rig.upper[arm]).all()
    assert np.array_equal(first[~arm], wrong[~arm])
    assert np.array_equal(body.limbs.proposals(problem, state, 1, closer=True)[0], first)


def test_only_limbs_that_end_somewhere_are_looked_at_closer(body, monkeypatch):
    seen = []
    monkeypatch.setattr(body.limbs, "_nearer", lambda limb, tried, *given: seen.append(limb) or tried)
    state, problem = body.seen(np.zeros_like(body.rig.lower))
    body.limbs.proposals(problem, state, 1)
    assert not seen
    body.limbs.proposals(problem, state, 1, closer=True)
    assert seen == [limb for limb in body.limbs._limbs if limb.ends] and len(seen) < len(body.limbs._limbs)


def test_parents_are_the_best_poses_that_are_not_all_but_the_same(body):
    """Of the own pose, in the first row, none come; of two that place the limb alike, the better one."""
    place = np.zeros((6, 4, 3))
    place[:, :, 0] = np.array([0.0, 0.2, 0.22, 0.5, 0.21, 0.9])[:, None]
    tried = _Tried(place, np.zeros(6), np.zeros((6, 5)), np.zeros((6, 2, 3)))
    assert list(body.limbs._apart(tried, np.array([0.0, 0.3, 0.2, 0.4, 0.5, 0.1]))) == [5, 2, 3]


def _exchanged(hand, one, two, seed=0):
    """(truth, problem, Θ): a finger is bent and another is not, and in Θ the other way round."""
    theta = np.zeros_like(hand.rig.lower)
    one, two = ([hand.row[f"{name}{k}"] for k in (1, 2, 3)] for name in (one, two))
    theta[one, 0] = 0.9 * hand.rig.upper[one, 0]
    wrong = theta.copy()
    wrong[one], wrong[two] = theta[two], theta[one]
    return *hand.seen(theta, seed), wrong


@pytest.mark.parametrize("seed", range(2))
def test_two_exchanged_fingers_are_proposed_together(hand, seed):
    truth, problem, wrong = _exchanged(hand, "index", "middle", seed)
    first = hand.limbs.proposals(problem, truth.replace(theta=wrong), 2)[0]
    changed = (first != wrong).any(axis=1)
    assert changed[hand.limb("index1")].any() and changed[hand.limb("middle1")].any()
    assert hand.error(first, truth) < 0.25 * hand.error(wrong, truth)


def test_two_limbs_are_tried_in_each_others_pose_which_no_library_need_have(hand):
    """Within each one's own limits; only where the two take each other's place, and not of limbs of other numbers of joints."""
    bare = LimbPoses(hand.model, np.zeros((1, *hand.rig.lower.shape)))
    truth, problem, wrong = _exchanged(hand, "index", "middle")
    index, middle = hand.limb("index1"), hand.limb("middle1")
    first = bare.proposals(problem, truth.replace(theta=wrong), 2)[0]
    assert np.array_equal(first[index], np.clip(wrong[middle], hand.rig.lower[index], hand.rig.upper[index]))
    assert np.array_equal(first[middle], np.clip(wrong[index], hand.rig.lower[middle], hand.rig.upper[middle]))
    others = ~(index | middle)
    assert np.array_equal(first[others], wrong[others]) and hand.error(first, truth) < 0.1 * hand.error(wrong, truth)
    assert bare.proposals(problem, truth, 2) == []


@pytest.mark.parametrize("n", [1, 2])
def test_proposals_for_a_pair_are_few_and_unlike_each_other(hand, n):
    """The exchange, of which the library has next to the same, among them."""
    truth, problem, wrong = _exchanged(hand, "index", "middle")
    state, (index, middle) = truth.replace(theta=wrong), (hand.limb("index1"), hand.limb("middle1"))
    changed = [((t != wrong).any(axis=1), t) for t in hand.limbs.proposals(problem, state, n)]
    both = [t for c, t in changed if c[index].any() and c[middle].any() and not c[~(index | middle)].any()]
    assert 1 <= len(both) <= n
    rows = [limb.rows for limb in hand.limbs._limbs if limb.hangs[hand.row["index1"]] or limb.hangs[hand.row["middle1"]]]
    places = [hand.model.pose(state.replace(theta=t))[0].vertices for t in (wrong, *both)]
    for i, a in enumerate(places):
        assert all(max(np.linalg.norm(a[r] - b[r], axis=1).mean() for r in rows) > 0.079 for b in places[:i])


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_of_changes_that_are_unlike_each_other_no_more_are_taken_than_asked_for(n, hand):
    """Of one limb and of pairs alike; those that are like one before, or the pose as it is, do not count."""
    state, (a, b) = hand.model.rest(), hand.limbs._limbs[:2]
    rows = np.array([0, 0.01, 0.2, 0.4, 0.41, 0.6, 0.8])
    angles = [np.full((len(rows), int(limb.hangs.sum()), 3), rows[:, None, None]) for limb in (a, b)]
    tried = [_Tried(np.broadcast_to(rows[:, None, None], (len(rows), 4, 3)), None, None, x) for x in angles]
    for limbs in ([(a, tried[0])], [(a, tried[0]), (b, tried[1])]):
        changes = [(-1.0 / k, 0.5, tuple((limb, t, k) for limb, t in limbs)) for k in range(1, len(rows))]
        found = hand.limbs._unlike(state, changes, 1.0, n, 0.9)
        assert [theta[limbs[-1][0].hangs][0, 0] for _, theta in found] == [0.2, 0.4, 0.6, 0.8][:n]


def test_a_limb_in_anothers_pose_is_within_its_own_limits(hand):
    for limb in hand.limbs._limbs:
        far = np.where(np.arange(9).reshape(3, 3) % 2, 5.0, -5.0)
        lower, upper = hand.rig.lower[limb.hangs], hand.rig.upper[limb.hangs]
        np.testing.assert_array_equal(hand.limbs._within(limb, far), np.where(far > 0, upper, lower)[None])


def test_a_rig_may_list_the_joints_of_a_limb_in_any_order(hand):
    """Tips first in one finger: it is tried in the others' poses joint by joint, and they in its own."""
    order = np.arange(len(hand.rig.parents))
    rows = [hand.row[f"middle{k}"] for k in (1, 2, 3)]
    order[rows] = rows[::-1]
    other = _in_order(hand.rig, order)
    rest = np.zeros((1, *hand.rig.lower.shape))
    theta = hand.rig.lower + np.random.default_rng(0).random(rest.shape[1:]) * (hand.rig.upper - hand.rig.lower)
    theta[hand.rig.root] = 0.0
    wrong, index, middle = theta.copy(), hand.limb("index1"), hand.limb("middle1")
    wrong[index], wrong[middle] = theta[middle], theta[index]
    truth, problem = hand.seen(theta)
    expected = LimbPoses(hand.model, rest).proposals(problem, truth.replace(theta=wrong), 2)
    found = LimbPoses(Model(other), rest).proposals(problem, truth.replace(theta=wrong[order]), 2)
    assert len(expected) > 1
    np.testing.assert_allclose(found, np.array(expected)[:, order], atol=1e-12)


def _in_order(rig, order):
    """The rig with its joints listed in another order: rows of the one that it has."""
    parents = np.where(rig.parents >= 0, np.argsort(order)[rig.parents], -1)[order]
    by_joint = {name: getattr(rig, name)[order] for name in ("joints", "frames", "lower", "upper", "merged", "locked")}
    names = tuple(rig.joint_names[j] for j in order)
    weights, regressor = (sparse.csr_array(of) for of in (rig.weights.tocsc()[:, order], rig.regressor[order]))
    return replace(rig, joint_names=names, parents=parents, weights=weights, regressor=regressor, poses={}, **by_joint)


def test_limbs_of_other_numbers_of_joints_have_no_pose_to_exchange(body):
    bare = LimbPoses(body.model, np.zeros((1, *body.rig.lower.shape)))
    assert len({int(limb.hangs.sum()) for limb in bare._limbs}) > 1
    truth, problem = body.seen(body.poses[0])
    bare.proposals(problem, truth.replace(theta=body.poses[1]), 2)  # none fails


@pytest.mark.study
def test_steps_from_what_is_proposed_bring_two_exchanged_fingers_home(hand):
    """At once or, as the hand that they have pulled along moves back, the next time: most. Without, they stay: all."""
    refit, home = Refit(hand.model), {}
    for pair in (("index", "middle"), ("ring", "pinky"), ("pinky", "ring")):
        for seed in range(5):
            truth, problem, wrong = _exchanged(hand, *pair, seed)
            best = refit.last_steps([Runner(problem, truth.replace(theta=wrong))])[0]
            assert hand.error(best.state.theta, truth) > 0.15
            for _ in range(2):
                proposals = hand.limbs.proposals(problem, best.state, 2)
                best = refit.race([best, *(Runner(problem, best.state.replace(theta=theta)) for theta in proposals)], 4)[0]
            home[pair, seed] = hand.error(best.state.theta, truth) < 0.01
    assert all(home[pair, 0] for pair, _ in home) and all(home[("index", "middle"), seed] for seed in range(5))
    assert np.mean(list(home.values())) > 0.85


@pytest.mark.parametrize("cost, pairs", [(0.9e-4, 0), (1.1e-4, 1)])
def test_two_limbs_that_cost_next_to_nothing_are_where_they_should_be(tube, cost, pairs, monkeypatch):
    """Other poses that cost twice as much are as good as none, where there is no fault to mend."""
    state, problem = tube.seen(tube.poses[0])
    fingers = [limb for limb in tube.limbs._limbs if limb.hangs.sum() == 1]
    monkeypatch.setattr(tube.limbs, "_limbs", fingers)

    def tried(limb, angles, grid, few, posed, state):
        place = np.stack([np.zeros((len(limb.rows), 3)), np.ones((len(limb.rows), 3))])
        return _Tried(place, np.array([0.5, 1.0]) * cost, np.zeros((2, len(few))), np.zeros((2, 1, 3)))

    monkeypatch.setattr(limbs_module, "_tried", tried)
    assert len(fingers) == 2 and len(tube.limbs.proposals(problem, state, 2)) == pairs


@pytest.mark.parametrize("n", [1, 2, 3])
def test_proposals_for_a_limb_are_few_and_unlike_each_other(hand, n):
    truth, problem = hand.seen(natural_poses(hand.rig, 1, np.random.default_rng(5))[0])
    state = truth.replace(theta=_with_another(hand, truth.theta, "index1"))
    proposals = hand.limbs.proposals(problem, state, n)
    changed = np.array([(theta != state.theta).any(axis=1) for theta in proposals])
    own = next(limb for limb in hand.limbs._limbs if limb.hangs[hand.row["index1"]])
    alone = [theta for theta, which in zip(proposals, changed) if not (which & ~own.hangs).any()]
    assert 1 <= len(alone) <= n and len(proposals) <= n * (5 + 10)
    places = [hand.model.pose(state.replace(theta=t))[0].vertices[own.rows] for t in (state.theta, *alone)]
    for i, a in enumerate(places):
        assert all(np.linalg.norm(a - b, axis=1).mean() > 0.079 for b in places[:i])


def _with_another(case, theta, name):
    """The pose with one limb in the library's pose that is most unlike its own."""
    limb = case.limb(name)
    other = case.poses[np.abs(case.poses[:, limb] - theta[limb]).sum(axis=(1, 2)).argmax()]
    return np.where(limb[:, None], other, theta)


def test_the_place_does_not_matter(hand):
    theta, moved = hand.poses[300], np.array([3.0, -2.0, 7.0])
    truth, problem = hand.seen(theta)
    wrong = _with_another(hand, theta, "middle1")
    here = hand.limbs.proposals(problem, truth.replace(theta=wrong), 2)
    state = truth.replace(theta=wrong, translation=truth.translation + moved)
    there = hand.limbs.proposals(Problem(problem.X + moved), state, 2)
    np.testing.assert_array_equal(here[0], there[0])


def test_a_turned_root_goes_with_the_limbs(hand):
    """Angles of a limb are relative to what it hangs on, which may be turned in any way."""
    from scipy.spatial.transform import Rotation

    theta = np.zeros_like(hand.rig.lower)
    theta[hand.rig.root] = rotvec_from_matrix(Rotation.random(random_state=1).as_matrix())
    truth, problem = hand.seen(theta)
    wrong = theta.copy()
    for k in (1, 2, 3):
        wrong[hand.row[f"ring{k}"], 0] = 0.9 * hand.rig.upper[hand.row[f"ring{k}"], 0]
    proposals = hand.limbs.proposals(problem, truth.replace(theta=wrong), 2)
    assert hand.error(proposals[0], truth) < 0.25 * hand.error(wrong, truth)
    np.testing.assert_array_equal(proposals[0][hand.rig.root], theta[hand.rig.root])


def test_few_points_and_a_rig_without_limbs_are_no_error(tube):
    state, problem = tube.seen(tube.poses[0], n=4)
    assert isinstance(tube.limbs.proposals(problem, state, 2), list)
    data = replace(make_tube_data(), lower=np.zeros((4, 3)), upper=np.zeros((4, 3)))
    stiff = Model(build_rig(data))
    assert LimbPoses(stiff, np.zeros((3, 4, 3))).proposals(Problem(stiff.rig.vertices), stiff.rest(), 2) == []


@pytest.mark.parametrize("n", [801, 1599, 1600, 3197])
def test_of_very_many_poses_limbs_are_tried_in_some_of_each_kind(tube, n):
    """Natural poses and others take turns in a library."""
    poses = np.zeros((n, *tube.rig.lower.shape))
    poses[1::2, 1, 0] = 1.0
    for limb in LimbPoses(tube.model, poses)._limbs:
        assert len(limb.angles) == 800
        if limb.hangs[1]:
            assert 0.4 < (limb.angles.max(axis=(1, 2)) == 1.0).mean() < 0.6


def test_of_very_many_limbs_the_nearest_pairs_and_the_most_promising_proposals_are_tried(hand, monkeypatch):
    """Bodies with the bones of a face have more than a thousand pairs of limbs: hands and bodies lose none."""
    _, problem = hand.seen(hand.poses[3])
    wrong = hand.model.rest().replace(theta=hand.poses[60])
    every = hand.limbs.proposals(problem, wrong, 3)
    tried = [SimpleNamespace(place=hand.rig.vertices[limb.skin][None]) for limb in hand.limbs._limbs]
    pairs = hand.limbs._pairs(tried)
    assert len(pairs) == 10 and 6 < len(every) < limbs_module._PROPOSALS
    monkeypatch.setattr(limbs_module, "_PROPOSALS", 6)
    np.testing.assert_array_equal(hand.limbs.proposals(problem, wrong, 3), every[:6])
    monkeypatch.setattr(limbs_module, "_PAIRS", 3)
    near = {frozenset(k) for k in hand.limbs._pairs(tried)}
    names = [next(n for n, j in hand.row.items() if limb.hangs[j])[:-1] for limb in hand.limbs._limbs]
    assert {frozenset(names[k] for k in pair) for pair in near} == {
        frozenset(pair) for pair in (("index", "middle"), ("middle", "ring"), ("ring", "pinky"))
    }
