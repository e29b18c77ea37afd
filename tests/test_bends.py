"""Other bends: a tip that was folded because the template's finger is too long comes out of the fold; what is right stays."""

from dataclasses import replace

import numpy as np
import pytest
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.fitting import bends as bends_module
from lbsfit_np.fitting.bends import Bends, other_bends, swept
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rig.proportions import proportions

pytestmark = pytest.mark.usefixtures("one_thread")

FREE = ("pose", "translation", "scale")
STEPS = {"ridge": 3e-5, "tangential": 0.02}


@pytest.fixture(scope="module")
def rig():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module", params=["girths", "none"])
def model(rig, request):
    made = Model(rig)
    if request.param == "none":
        made.basis = made.basis.copy()
        made.basis[:, made.n_proportions :] = 0.0
    return made


@pytest.fixture(scope="module")
def bends(model):
    steps = GaussNewton(model, **STEPS)

    def to_the_end(problem, state):
        (state,), (value,) = steps.shared([problem], [state], free=FREE, iterations=12)
        return state, value + steps.ridge * float(state.coefficients @ state.coefficients)

    return Bends(model, FREE, to_the_end, **STEPS)


def _joint(rig, name):
    return list(rig.joint_names).index(name)


def _scan(rig, model, theta, coefficients):
    """Points of somebody with other proportions in a pose, and the state that made them."""
    own = model.rest().coefficients
    own[: model.n_proportions] = coefficients
    state = model.rest().replace(theta=theta, coefficients=own)
    rng = np.random.default_rng(0)
    V = model.pose(state)[0].vertices
    p = V[rig.faces[rng.choice(len(rig.faces), 1200, p=_areas(V, rig.faces))]]
    b = rng.dirichlet(np.ones(3), len(p))
    return Problem(np.einsum("nk,nka->na", b, p)), state


def _areas(V, faces):
    p = V[faces]
    areas = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    return areas / areas.sum()


@pytest.fixture(scope="module")
def short_fingers(rig, model):
    """A scan whose index and ring fingers are shorter than the template's, all but straight."""
    theta = np.zeros(rig.joints.shape)
    theta[_joint(rig, "index2"), 0] = 0.1
    family = proportions(rig)
    short = [_joint(rig, f"{finger}{k}") for finger in ("index", "ring") for k in (1, 2, 3)]
    return _scan(rig, model, theta, np.where(np.isin(family.owner, short) & family.length, -0.2, 0.0))


@pytest.mark.parametrize("fingers", [slow(["index"]), slow(["ring"]), ["index", "ring"]])
def test_folded_tips_come_out_of_the_fold(rig, model, bends, short_fingers, fingers):
    problem, true = short_fingers
    tips = [_joint(rig, f"{finger}3") for finger in fingers]
    theta = true.theta.copy()
    theta[tips, 0] = 1.5
    stuck, value = bends._to_the_end(problem, model.rest().replace(theta=theta))
    assert np.abs(stuck.theta[tips, 0] - true.theta[tips, 0]).min() > 0.7  # steps alone do not lead out
    state, left = bends(problem, stuck, value)
    least = bends._to_the_end(problem, true)[1]
    assert left < value and np.abs(state.theta - true.theta).max() < 0.1
    assert left - least < 0.5 * (value - least)
    if not model.basis[:, model.n_proportions :].any():  # girths make up for some of a folded finger, so that it costs less
        assert left - least < 0.2 * (value - least)
    off = model.pose(state)[0].joints - model.pose(true)[0].joints
    assert np.linalg.norm(off, axis=1).mean() < 0.01


def test_what_is_right_stays(bends, short_fingers):
    problem, true = short_fingers
    state, value = bends._to_the_end(problem, true)
    same, left = bends(problem, state, value)
    assert same is state and left == value


def test_which_bends_are_tried(rig):
    theta = np.zeros(rig.joints.shape)
    j, up, straight = (_joint(rig, name) for name in ("index2", "index1", "index3"))
    theta[rig.root] = 1.0
    theta[j, 0] = 1.0
    tried = other_bends(rig, theta)
    of = {joints: angles for joints, angles in tried if j in joints}
    assert set(of) == {(j,), (j, up), (j, straight)}
    assert not of[(j,)].any()
    assert np.allclose(of[(j, up)], [[0, 0, 0], [1, 0, 0]]) and np.allclose(of[(j, straight)], [[0, 0, 0], [1, 0, 0]])
    middles = {joints[0]: angles[0] for joints, angles in tried if len(joints) == 1 and joints != (j,)}
    assert straight in middles and np.allclose(middles[straight], (rig.lower[straight] + rig.upper[straight]) / 2)
    assert up not in middles  # two axes: no hinge
    assert all(rig.root not in joints for joints, _ in tried)


def test_angles_that_are_given_to_a_neighbour_stay_within_its_limits(rig):
    theta = np.zeros(rig.joints.shape)
    theta[_joint(rig, "index1"), 0] = theta[_joint(rig, "index2"), 0] = 1.4
    for joints, angles in other_bends(rig, theta):
        assert (angles >= rig.lower[list(joints)]).all() and (angles <= rig.upper[list(joints)]).all()


def test_joints_that_do_not_move_are_passed_over(rig):
    locked = rig.lower.copy(), rig.upper.copy()
    j = _joint(rig, "index2")
    for limits in locked:
        limits[j] = 0.0
    stiff = replace(rig, lower=locked[0], upper=locked[1])
    assert not stiff.moving[j]
    theta = np.zeros(rig.joints.shape)
    theta[_joint(rig, "index3"), 0] = 1.2
    tried = {joints for joints, _ in other_bends(stiff, theta)}
    assert (_joint(rig, "index3"), _joint(rig, "index1")) in tried and not any(j in joints for joints in tried)


def test_bends_go_neither_to_the_root_nor_over_a_branch(tube_rig):
    theta = np.zeros((4, 3))
    theta[1, 0], theta[2, 0] = 1.2, 0.9  # the elbow, on which two fingers hang, and one of them
    tried = other_bends(tube_rig, theta)
    assert {joints for joints, _ in tried} == {(1,), (2,), (2, 1)}


def _limited(rig, joint, lower, upper):
    limits = rig.lower.copy(), rig.upper.copy()
    limits[0][joint], limits[1][joint] = lower, upper
    return replace(rig, lower=limits[0], upper=limits[1])


@pytest.mark.parametrize(
    "lower, upper, angle, tried",
    [
        (0.5, 2.6, 0.7, [1.55]),  # as straight as it gets
        (0.5, 2.6, 1.2, [0.5]),
        (-2.6, -0.5, -0.7, [-1.55]),
        (-2.6, -0.5, -1.2, [-0.5]),
        (0.0, 1.0, 0.1, []),  # its middle is near
        (-1.5, 1.5, 1.0, [0.0]),
        (-1.5, 1.5, 0.1, []),
    ],
)
def test_hinges_are_straight_where_their_limits_allow_and_bent_to_the_middle(tube_rig, lower, upper, angle, tried):
    hinge = _limited(tube_rig, 1, [lower, 0.0, 0.0], [upper, 0.0, 0.0])
    theta = np.zeros((4, 3))
    theta[1, 0] = angle
    found = [angles for joints, angles in other_bends(hinge, theta) if joints == (1,)]
    np.testing.assert_allclose(np.reshape(found, (-1, 3)), np.outer(tried, [1.0, 0.0, 0.0]), atol=1e-12)


def test_joints_that_turn_about_more_axes_are_not_bent(tube_rig):
    theta = np.zeros((4, 3))
    theta[1, 2] = 0.4  # the middle of the elbow's range is at 0.6 about x
    assert other_bends(tube_rig, theta) == []


def test_a_neighbour_is_given_what_a_joint_is_bent_beyond_its_straightest(tube_rig):
    stiff = _limited(tube_rig, 2, [0.4, -0.2, -0.5], [1.6, 0.2, 0.4])
    theta = np.zeros((4, 3))
    theta[1, 0], theta[2, 0] = 0.1, 1.3
    given = dict(other_bends(stiff, theta))
    np.testing.assert_allclose(given[2, 1], [[0.4, 0.0, 0.0], [0.1 + 1.3 - 0.4, 0.0, 0.0]], atol=1e-12)


def test_a_neighbour_turns_about_the_axis_that_the_joint_was_bent_about():
    """Joints have frames of their own: on the body those of hip and knee are half a turn apart."""
    body = lbs.load_rig("body-coarse")
    moving = body.moving[:, None]
    body = replace(body, lower=np.where(moving, -3.0, body.lower), upper=np.where(moving, 3.0, body.upper))
    theta, apart = np.random.default_rng(0).uniform(-0.2, 0.2, body.joints.shape) * moving, 0
    for name in ("left_knee", "right_elbow", "left_wrist", "left_collar"):
        bent, j = theta.copy(), _joint(body, name)
        bent[j] = [0.9, 0.3, -0.2]
        for joints, angles in other_bends(body, bent):
            if joints[0] == j and len(joints) == 2:
                k = joints[1]
                np.testing.assert_allclose(body.frames[k] @ (angles[1] - bent[k]), body.frames[j] @ bent[j], atol=1e-12)
                apart += np.abs(body.frames[k] - body.frames[j]).max() > 0.5
    assert apart >= 3


# ---- which of them are followed, on known values ----


@pytest.fixture
def followed(tube_rig, monkeypatch):
    """(what few points and all leave unexplained, by the pose) → (what is kept, value; what went how many steps; to the end).

    The pose: the elbow's, the long and the short finger's bend. Few points' values may differ after all the first steps.
    """

    def follow(start, few, ends, value=1.0):
        steps, ended = [], []

        def bend(state):
            return tuple(np.round(state.theta[1:, 0], 3).tolist())

        def to_the_end(problem, state):
            ended.append(bend(state))
            return state, ends.get(bend(state), 9.0)

        model = Model(tube_rig)
        bends = Bends(model, FREE, to_the_end)
        theta = np.zeros((4, 3))
        theta[1:, 0] = start

        def moved(problem, state, n):
            steps.append((bend(state), n))
            return state, few.get(bend(state), 9.0)

        monkeypatch.setattr(bends, "_begun", moved)
        monkeypatch.setattr(bends, "_moved", moved)
        state, left = bends(Problem(np.zeros((9, 3))), model.rest().replace(theta=theta), value)
        return bend(state), left, steps, ended

    return follow


# Two bent joints: the elbow straight; the finger straight; that, with its bend given to the elbow.
START, ELBOW, FINGER, GIVEN = (0.9, 0.8, 0.0), (0.0, 0.8, 0.0), (0.9, 0.0, 0.0), (1.4, 0.0, 0.0)
ALL = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "few, ends, kept, ended",
    [
        # The near ones go to the end, the nearest first, until one is better.
        ({GIVEN: 0.9, ELBOW: 1.01, FINGER: 1.03}, {ELBOW: 0.5, FINGER: 0.1}, (ELBOW, 0.5), [GIVEN, ELBOW]),
        ({GIVEN: 1.021, ELBOW: 1.021}, {GIVEN: 0.1}, (START, 1.0), []),
        # By much.
        ({GIVEN: 0.9}, {GIVEN: 0.981}, (START, 1.0), [GIVEN]),
        ({GIVEN: 0.9}, {GIVEN: 0.979}, (GIVEN, 0.979), [GIVEN]),
        # What was near besides is tried on what is kept; what failed, or was far, is not.
        ({FINGER: 0.9, ELBOW: 0.95, ALL: 0.9}, {FINGER: 0.8, ELBOW: 0.1, ALL: 0.5}, (ALL, 0.5), [FINGER, ALL]),
        ({FINGER: 0.9, ELBOW: 0.95, ALL: 0.9}, {FINGER: 0.8, ALL: 0.799}, (FINGER, 0.8), [FINGER, ALL]),
        ({ELBOW: 0.8, FINGER: 0.9, ALL: 0.7}, {FINGER: 0.9, ALL: 0.1}, (FINGER, 0.9), [ELBOW, FINGER]),
    ],
)
def test_bends_that_leave_less_unexplained_are_kept(followed, few, ends, kept, ended):
    state, left, steps, went = followed(START, {START: 1.0} | few, ends)
    assert (state, left) == kept and went == ended
    assert steps[:4] == [(START, 6), *((move, 2) for move in (ELBOW, FINGER, GIVEN))]  # as many steps, before they are compared
    assert [n for _, n in steps[4:7]] == [4, 4, 4]


def test_three_go_to_the_end(followed):
    bent = (0.9, 0.8, 0.7)
    few = dict.fromkeys([(0.0, 0.8, 0.7), (0.9, 0.0, 0.7), (1.4, 0.0, 0.7), (0.9, 0.8, 0.0), (1.4, 0.8, 0.0)], 0.9)
    _, _, steps, ended = followed(bent, {bent: 1.0} | few, {})
    assert [n for _, n in steps] == [6, *[2] * 5, *[4] * 5] and len(ended) == 3


def test_eight_go_the_second_steps(rig, model, monkeypatch):
    bends, steps = Bends(model, FREE, lambda problem, state: (state, 9.0)), []
    for moved in ("_begun", "_moved"):
        monkeypatch.setattr(bends, moved, lambda problem, state, n: steps.append(n) or (state, 0.9))
    theta = np.zeros(rig.joints.shape)
    theta[[_joint(rig, f"{finger}2") for finger in ("index", "middle", "ring", "pinky")], 0] = 1.2
    bends(Problem(np.zeros((9, 3))), model.rest().replace(theta=theta), 1.0)
    moves = len(other_bends(rig, theta))
    assert moves > 9 and steps == [6, *[2] * moves, *[4] * 8]


def test_first_steps_hold_the_template(model, short_fingers):
    """Which takes less time; those that compare find its proportions, too."""
    problem, true = short_fingers
    bends, start = Bends(model, FREE, None), true.replace(coefficients=0.9 * true.coefficients, theta=0.95 * true.theta)
    begun, gone_on = (how(problem, start, 2)[0] for how in (bends._begun, bends._moved))
    assert np.array_equal(begun.coefficients, start.coefficients) and not np.array_equal(begun.theta, start.theta)
    assert not np.array_equal(gone_on.coefficients, start.coefficients)


def test_proportions_that_are_far_from_the_templates_cost(model, short_fingers):
    """As they do in what chose the pose."""
    problem, true = short_fingers
    plain, dear = (Bends(model, FREE, None, tangential=0.02, ridge=ridge)._moved(problem, true, 0)[1] for ridge in (0.0, 1.0))
    assert dear - plain == pytest.approx(float(true.coefficients @ true.coefficients)) and dear > plain


def test_of_very_many_joints_those_are_tried_that_points_can_tell(rig, model, monkeypatch):
    """Of a body with the bones of a face; a hand's and a body's joints are all told."""
    for known in (model, Model(lbs.load_rig("body-coarse"))):
        bends, theta = Bends(known, FREE, None), np.where(known.rig.turning, known.rig.upper, 0.0)
        for moves, most in ((other_bends(known.rig, theta), bends_module._BENDS), (swept(known.rig, theta), bends_module._SWEPT)):
            assert len(moves) > 20 and bends._told(moves, most) == moves
    bends, moves = Bends(model, FREE, None), swept(rig, np.zeros(rig.joints.shape))
    first = {rig.joint_names[joints[0]][:-1] for joints, _ in moves}
    some = {rig.joint_names[joints[0]] for joints, _ in bends._told(moves, len(moves) // 4)}
    assert len(first) == 5 and "index1" in some and not any(name.endswith("3") for name in some)  # tips move least
    monkeypatch.setattr(bends_module, "_TOLD_BY", 1.01 * bends._moves[_joint(rig, "pinky3")])
    left = {rig.joint_names[joints[0]] for joints, _ in bends._told(moves, len(moves))}
    assert "pinky3" not in left and "index1" in left
