"""Limbs in doubt: which bones are, and how a folded knee and exchanged feet come out of what no step leads out of."""

from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting import bends as bends_module
from lbsfit_np.fitting.bends import Bends, swept
from lbsfit_np.fitting.doubt import Doubt
from lbsfit_np.fitting.exchanges import Exchanges
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem

pytestmark = pytest.mark.usefixtures("one_thread")

FREE = ("pose", "translation", "scale")
STEPS = {"ridge": 3e-5, "tangential": 0.02}


@pytest.fixture(scope="module")
def rig():
    return lbs.load_rig("body-coarse")


@pytest.fixture(scope="module")
def model(rig):
    return Model(rig)


@pytest.fixture(scope="module")
def to_the_end(model):
    steps = GaussNewton(model, **STEPS)

    def go(problem, state):
        (state,), (value,) = steps.shared([problem], [state], free=FREE, iterations=12)
        return state, value + steps.ridge * float(state.coefficients @ state.coefficients)

    return go


@pytest.fixture(scope="module")
def bends(model, to_the_end):
    return Bends(model, FREE, to_the_end, **STEPS)


def _angles(rig, **bent):
    theta = np.zeros(rig.joints.shape)
    for name, angle in bent.items():
        theta[rig.joint_names.index(name), 0] = angle
    return theta


def _scan(rig, model, theta, noise=0.0, more=()):
    rng = np.random.default_rng(0)
    state = model.rest().replace(theta=theta)
    corners = model.deformed(state).vertices[rig.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = rng.choice(len(areas), 1500, p=areas / areas.sum())
    points = np.einsum("nk,nka->na", rng.dirichlet(np.ones(3), len(face)), corners[face])
    return Problem(np.vstack([points + noise * rng.standard_normal(points.shape), *more])), state


def _off(model, state, true):
    return np.linalg.norm(model.deformed(state).joints - model.deformed(true).joints, axis=1)


@pytest.fixture(scope="module")
def folded(rig, model, to_the_end):
    """(scan of a bent knee, truth, fit with the knee folded), which steps lead to the other leg's points."""
    problem, true = _scan(rig, model, _angles(rig, left_knee=0.6))
    stuck, value = to_the_end(problem, model.rest().replace(theta=_angles(rig, left_knee=2.2)))
    assert _off(model, stuck, true).max() > 0.5
    return problem, true, stuck, value


@pytest.mark.parametrize("noise", [0.0, 0.004, 0.02])
def test_a_right_pose_leaves_no_bone_in_doubt(rig, model, noise):
    problem, true = _scan(rig, model, _angles(rig, left_knee=0.6, right_elbow=1.0), noise)
    assert Doubt(model).of(problem, true).max() < 4


def test_points_that_a_wrong_limb_has_to_explain_are_told(rig, model, folded):
    problem, _, stuck, _ = folded
    doubt = Doubt(model).of(problem, stuck)
    legs = [j for j, name in enumerate(rig.joint_names) if any(part in name for part in ("hip", "knee", "ankle", "foot"))]
    assert doubt.argmax() in legs and doubt.max() > 100
    assert np.delete(doubt, legs).max() < 4


def test_clutter_leaves_no_bone_in_doubt(rig, model):
    clutter = np.random.default_rng(1).uniform(-1.2, 1.2, (150, 3))
    problem, true = _scan(rig, model, _angles(rig, left_knee=0.6), 0.004, [clutter])
    assert Doubt(model).of(problem, true).max() < 4


def test_bones_of_hardly_any_points_are_not_judged(rig, model):
    problem, true = _scan(rig, model, _angles(rig))
    hand = np.array(model.deformed(true).joints[rig.joint_names.index("left_hand")])
    away = np.linalg.norm(problem.X - hand, axis=1) > 0.25
    few = Problem(np.vstack([problem.X[away], hand + [[0.3, 0.0, 0.0], [0.3, 0.01, 0.0], [0.3, 0.0, 0.01]]]))
    assert Doubt(model).of(few, true)[rig.joint_names.index("left_hand")] == 0


@pytest.mark.parametrize("way", ["exchanges", "sweeps"])
def test_a_folded_knee_comes_out_of_the_fold(model, bends, to_the_end, folded, way, monkeypatch):
    problem, true, stuck, value = folded
    if way == "exchanges":
        monkeypatch.setattr(bends_module, "swept", lambda rig, theta: [])
    else:
        monkeypatch.setattr(Exchanges, "of", lambda self, problem, state, doubted: [])
    state, left = bends(problem, stuck, value)
    assert _off(model, state, true).max() < 0.02
    assert left < 1.1 * to_the_end(problem, true)[1]


def test_without_doubt_nothing_more_is_tried(bends, to_the_end, folded, monkeypatch):
    problem, true, *_ = folded

    def never(*args):
        raise AssertionError("no bone is in doubt")

    monkeypatch.setattr(bends_module, "swept", never)
    monkeypatch.setattr(Exchanges, "of", never)
    bends(problem, *to_the_end(problem, true))


def test_what_is_freed_is_freed_in_exchanges_as_well(bends, to_the_end):
    fixed = bends.freeing(("pose",), to_the_end)
    assert fixed._exchanges._free == ("pose",) and bends._exchanges._free == FREE


def test_ends_of_limbs_are_exchanged_where_one_is_in_doubt(rig, model, folded):
    problem, _, stuck, _ = folded
    exchanges = Exchanges(model, FREE)
    doubted = np.zeros(len(rig.parents), dtype=bool)
    assert exchanges.of(problem, stuck, doubted) == []
    doubted[rig.joint_names.index("left_foot")] = True
    moves = exchanges.of(problem, stuck, doubted)
    names = [{rig.joint_names[j] for j in joints} for joints, _ in moves]
    assert all("left_foot" in each for each in names)
    assert {"left_hip", "left_knee", "left_ankle", "left_foot", "right_hip", "right_knee", "right_ankle", "right_foot"} in names
    assert not any({"pelvis", "spine1", "spine3"} & each for each in names)  # other limbs hang on these
    for joints, angles in moves:
        assert (angles >= rig.lower[list(joints)] - 1e-12).all() and (angles <= rig.upper[list(joints)] + 1e-12).all()


def test_each_end_goes_towards_the_others_place(rig, model):
    problem, true = _scan(rig, model, _angles(rig, left_hip=0.35, right_hip=0.05, left_knee=0.3, right_knee=0.3))
    left, right = (rig.joint_names.index(name) for name in ("left_foot", "right_foot"))
    doubted = np.arange(len(rig.parents)) == left
    before = model.deformed(true).joints
    apart = np.linalg.norm(before[left] - before[right])
    nearest = np.inf
    for joints, angles in Exchanges(model, FREE).of(problem, true, doubted):
        theta = true.theta.copy()
        theta[list(joints)] = angles
        after = model.deformed(true.replace(theta=theta)).joints
        off = np.linalg.norm(after[[left, right]] - before[[right, left]], axis=1).max()
        nearest = min(nearest, off)
    assert nearest < 0.7 * apart  # a few steps, from much further than ends that touch


def test_joints_are_swept_through_their_range(rig):
    theta = _angles(rig, left_knee=0.6)
    knee, hip = (rig.joint_names.index(name) for name in ("left_knee", "left_hip"))
    moves = swept(rig, theta)
    alone = np.array([angles[0, 0] for joints, angles in moves if joints == (knee,)])
    assert alone.min() == rig.lower[knee, 0] and np.isclose(alone.max(), rig.upper[knee, 0])
    assert (np.abs(alone - 0.6) > 0.35).all() and np.diff(np.r_[np.sort(alone), 0.6]).max() < 1.5
    against = [angles for joints, angles in moves if joints == (knee, hip)]
    assert len(against) == 2 * len(alone)
    for own, other in against:
        a = (rig.upper[hip] - rig.lower[hip]).argmax()
        turn = own[0] - 0.6
        shares = np.clip([-0.5 * turn, -turn], rig.lower[hip, a], rig.upper[hip, a])
        assert np.isclose(other[a], shares).any() and not np.delete(other, a).any()
    assert all(rig.root not in joints for joints, _ in moves)
    for joints, angles in moves:
        assert (angles >= rig.lower[list(joints)] - 1e-12).all() and (angles <= rig.upper[list(joints)] + 1e-12).all()


def test_joints_that_do_not_move_are_not_swept(rig):
    lower, upper = rig.lower.copy(), rig.upper.copy()
    knee, ankle = (rig.joint_names.index(name) for name in ("left_knee", "left_ankle"))
    lower[knee] = upper[knee] = 0.0
    stiff = replace(rig, lower=lower, upper=upper)
    moves = [joints for joints, _ in swept(stiff, np.zeros(rig.joints.shape))]
    assert not any(knee in joints for joints in moves)
    assert (ankle, rig.joint_names.index("left_hip")) in moves  # the next one that moves
