"""Other bends: a tip that was folded because the template's finger is too long comes out of the fold; what is right stays."""

from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting.bends import Bends, other_bends
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


@pytest.fixture(scope="module")
def model(rig):
    return Model(rig)


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
    state = model.rest().replace(theta=theta, coefficients=coefficients)
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


@pytest.mark.parametrize("fingers", [["index"], ["index", "ring"]])
def test_folded_tips_come_out_of_the_fold(rig, model, bends, short_fingers, fingers):
    problem, true = short_fingers
    tips = [_joint(rig, f"{finger}3") for finger in fingers]
    theta = true.theta.copy()
    theta[tips, 0] = 1.4
    stuck, value = bends._to_the_end(problem, model.rest().replace(theta=theta))
    assert np.abs(stuck.theta[tips, 0] - true.theta[tips, 0]).min() > 0.7  # steps alone do not lead out
    state, left = bends(problem, stuck, value)
    least = bends._to_the_end(problem, true)[1]
    assert left - least < 0.2 * (value - least) and np.abs(state.theta - true.theta).max() < 0.2
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
