"""Limbs in doubt: which bones are, and how a folded knee and exchanged feet come out of what no step leads out of."""

from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting import bends as bends_module
from lbsfit_np.fitting.bends import Bends, swept
from lbsfit_np.fitting.doubt import Doubt
from lbsfit_np.fitting.exchanges import Exchanges
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.template_fit import TemplateFit
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


def test_points_that_do_not_count_are_no_evidence(rig, model):
    beside = np.array([0.6, -0.9, 0.3]) + 0.02 * np.random.default_rng(2).standard_normal((120, 3))
    problem, true = _scan(rig, model, _angles(rig), 0.004, [beside])
    weights = np.ones(len(problem.X))
    assert Doubt(model).of(problem, true).max() > 100
    weights[-120:] = 0.0
    left_out = Doubt(model).of(Problem(problem.X, weights / weights.sum()), true)
    assert left_out.max() < 4
    weights[-120:] = 1e-4
    counted = Doubt(model).of(Problem(problem.X, weights / weights.sum()), true)
    assert counted.max() < 0.1 * Doubt(model).of(problem, true).max()


def test_doubt_is_of_points_each_once_and_of_no_unit(rig, model, folded):
    problem, _, stuck, _ = folded
    doubt = Doubt(model).of(problem, stuck)
    again = Problem(np.vstack([problem.X, np.tile(problem.X[:1], (1600, 1))]))
    np.testing.assert_array_equal(Doubt(model).of(again, stuck) > 4, doubt > 4)
    larger = stuck.replace(scale=3 * stuck.scale, translation=3 * stuck.translation)
    np.testing.assert_allclose(Doubt(model).of(Problem(3 * problem.X), larger), doubt, rtol=1e-6)


@pytest.mark.parametrize("way", ["exchanges", "sweeps"])
@pytest.mark.slow
def test_a_folded_knee_comes_out_of_the_fold(model, bends, to_the_end, folded, way, monkeypatch):
    problem, true, stuck, value = folded
    monkeypatch.setattr(bends_module, "other_bends", lambda rig, theta: [])  # which would straighten it, too
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


@pytest.mark.parametrize(("helps", "rounds"), [(True, 3), (False, 1)])
def test_rounds_go_on_from_what_helped_while_it_helps(rig, model, bends, folded, monkeypatch, helps, rounds):
    """Each round looks at where the last one has come to; none that helped nothing is followed by another."""
    problem, _, stuck, value = folded
    seen = []

    def of_exchanges(self, few, state, doubted):
        seen.append(("exchanges", state.scale))
        return ["exchanged"]

    def of_sweeps(rig, theta):
        seen.append(("sweeps", theta[0, 0]))
        return ["swept"]

    def best(problem, few, state, value, moves, *limits):
        if not helps or moves not in (["exchanged"], ["swept"]):
            return state, value
        theta = state.theta.copy()
        theta[0, 0] += 1.0
        return state.replace(theta=theta, scale=state.scale + 1.0), 0.9 * value

    monkeypatch.setattr(Exchanges, "of", of_exchanges)
    monkeypatch.setattr(bends_module, "swept", of_sweeps)
    monkeypatch.setattr(bends, "_best", best)
    monkeypatch.setattr(bends, "_told", lambda changes, most: changes)
    monkeypatch.setattr(bends._doubt, "of", lambda problem, state: np.full(len(rig.parents), 9.0))
    _, left = bends(problem, stuck, value)
    assert [name for name, _ in seen] == ["exchanges", "sweeps"] * rounds
    gone = np.arange(2 * rounds) if helps else np.zeros(2)
    np.testing.assert_allclose([at for name, at in seen if name == "exchanges"], stuck.scale + gone[::2])
    np.testing.assert_allclose([at for name, at in seen if name == "sweeps"], stuck.theta[0, 0] + gone[1::2])
    assert np.isclose(left, value * 0.9 ** (2 * rounds if helps else 0))


def test_of_many_sweeps_the_likely_ones_go_on(rig, model, bends, folded, monkeypatch):
    problem, true, stuck, value = folded
    names = ("left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle")
    legs = [rig.joint_names.index(name) for name in names]
    right, rng = (tuple(legs), true.theta[legs]), np.random.default_rng(3)
    wrong = [(tuple(legs), rng.uniform(rig.lower[legs], rig.upper[legs])) for _ in range(60)]
    monkeypatch.setattr(Exchanges, "of", lambda self, problem, state, doubted: [])
    monkeypatch.setattr(bends_module, "other_bends", lambda rig, theta: [])
    monkeypatch.setattr(bends_module, "swept", lambda rig, theta: [*wrong, right])
    steps = []
    for name in ("_begun", "_moved"):
        how = getattr(bends, name)
        monkeypatch.setattr(bends, name, lambda few, state, n, how=how: steps.append(n) or how(few, state, n))
    state, _ = bends(problem, stuck, value)
    assert _off(model, state, true).max() < 0.02
    once = steps[: steps.index(6, 1)] if 6 in steps[1:] else steps
    assert once.count(0) == 61 and once.count(2) == 32 and once.count(4) == 12


def test_who_takes_no_point_for_any_limbs_looks_at_none(model, to_the_end, folded, monkeypatch):
    problem, true, stuck, value = folded
    monkeypatch.setattr(bends_module, "other_bends", lambda rig, theta: [])
    state, _ = Bends(model, FREE, to_the_end, other_limbs=False, **STEPS)(problem, stuck, value)
    assert _off(model, state, true).max() > 0.5


@pytest.mark.parametrize("other_limbs", [True, False])
def test_fits_on_templates_look_at_limbs_as_their_variant_does(rig, model, other_limbs, monkeypatch):
    asked = []
    monkeypatch.setattr(Doubt, "of", lambda self, problem, state: asked.append(1) or np.zeros(len(rig.parents)))
    problem, true = _scan(rig, model, _angles(rig))
    TemplateFit(rig, model, FitSettings(), other_limbs=other_limbs).refit(problem, [true])
    assert bool(asked) == other_limbs


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


def test_the_nearest_pairs_are_exchanged(rig, model, monkeypatch):
    problem, true = _scan(rig, model, _angles(rig))
    monkeypatch.setattr("lbsfit_np.fitting.exchanges._PAIRS", 1)
    doubted = np.arange(len(rig.parents)) == rig.joint_names.index("left_foot")
    names = {rig.joint_names[j] for joints, _ in Exchanges(model, FREE).of(problem, true, doubted) for j in joints}
    assert names == {f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot")}


def test_the_last_bones_are_the_deepest_in_whatever_order_a_file_has_them(rig, model):
    order = np.arange(len(rig.parents))[::-1]
    place = np.argsort(order)
    turned_round = replace(
        rig,
        joint_names=tuple(rig.joint_names[j] for j in order),
        parents=np.array([place[rig.parents[j]] if rig.parents[j] >= 0 else -1 for j in order]),
        **{name: getattr(rig, name)[order] for name in ("joints", "frames", "lower", "upper", "locked")},
        weights=rig.weights[:, order],
        regressor=rig.regressor[order],
        poses={},
        shapes=None,
        smpl_rest=None,
    )

    def ends(made):
        limbs = Exchanges(Model(made), FREE)._limbs
        return {tuple(made.joint_names[j] for j in joints) for joints, _ in limbs}

    assert ends(turned_round) == ends(rig) and ("left_hip", "left_knee", "left_ankle", "left_foot") in ends(rig)


def test_joints_that_no_vertex_follows_most_move_with_the_others(rig):
    """Each ankle outweighs its knee wherever that has skin: the knee has no bone to exchange, but turns all the same."""
    weights = rig.weights.toarray()
    for side in ("left", "right"):
        knee, ankle = (rig.joint_names.index(f"{side}_{name}") for name in ("knee", "ankle"))
        both = weights[:, knee] + weights[:, ankle]
        weights[:, knee], weights[:, ankle] = 0.49 * both, 0.51 * both
    mixed = replace(rig, weights=type(rig.weights)(weights))
    knee = mixed.joint_names.index("left_knee")
    limb = next(limb for limb in Exchanges(Model(mixed), FREE)._limbs if knee in limb[0])
    assert knee not in limb[1]


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
    assert sum(joints == (knee, hip) for joints, _ in moves) == 2 * len(alone)
    assert all(rig.root not in joints for joints, _ in moves)
    for joints, angles in moves:
        assert (angles >= rig.lower[list(joints)] - 1e-12).all() and (angles <= rig.upper[list(joints)] + 1e-12).all()


@pytest.mark.parametrize("name", ["left_knee", "right_elbow", "left_wrist"])
def test_what_hangs_on_both_turns_less_where_the_joint_before_turns_back(rig, name):
    wide = replace(rig, lower=np.full_like(rig.lower, -3.0), upper=np.full_like(rig.upper, 3.0))
    j = rig.joint_names.index(name)
    rest = np.zeros(rig.joints.shape)
    R = {len(joints): [] for joints, _ in swept(wide, rest) if joints[0] == j}
    for joints, angles in swept(wide, rest):
        if joints[0] == j and 0.3 < np.linalg.norm(angles[0]) < 1.2:
            theta = rest.copy()
            theta[list(joints)] = angles
            turned = lbs.skinning.skin(wide, theta).A[j]
            R[len(joints)].append(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    assert R[1] and len(R[2]) == 2 * len(R[1])
    back = np.reshape(R[2], (-1, 2))  # by half, and by all
    np.testing.assert_allclose(back[:, 0], np.array(R[1]) / 2, atol=1e-6)
    np.testing.assert_allclose(back[:, 1], 0, atol=1e-6)


def test_the_joint_before_turns_back_as_far_as_its_limits_allow(rig):
    wide = replace(rig, lower=np.full_like(rig.lower, -3.0), upper=np.full_like(rig.upper, 3.0))
    j, p = (rig.joint_names.index(name) for name in ("left_knee", "left_hip"))
    lower, upper = wide.lower.copy(), wide.upper.copy()
    lower[p], upper[p] = -0.2, 0.3
    rest = np.zeros(rig.joints.shape)
    rigs = wide, replace(wide, lower=lower, upper=upper)
    free, narrow = ([angles for joints, angles in swept(one, rest) if joints == (j, p)] for one in rigs)
    assert len(free) == len(narrow) > 0 and max(np.abs(angles[1]).max() for angles in free) > 1.0
    for there, here in zip(free, narrow, strict=True):
        np.testing.assert_allclose(here, [there[0], np.clip(there[1], -0.2, 0.3)], atol=1e-12)


def test_of_axes_that_are_as_wide_none_is_left_out(rig):
    wide = replace(rig, lower=np.full_like(rig.lower, -0.8), upper=np.full_like(rig.upper, 0.8))
    j = rig.joint_names.index("left_shoulder")
    axes = {int(np.flatnonzero(angles[0])[0]) for joints, angles in swept(wide, np.zeros(rig.joints.shape)) if joints == (j,)}
    assert axes == {0, 1, 2}


def test_joints_that_do_not_move_are_not_swept(rig):
    lower, upper = rig.lower.copy(), rig.upper.copy()
    knee, ankle = (rig.joint_names.index(name) for name in ("left_knee", "left_ankle"))
    lower[knee] = upper[knee] = 0.0
    stiff = replace(rig, lower=lower, upper=upper)
    moves = [joints for joints, _ in swept(stiff, np.zeros(rig.joints.shape))]
    assert not any(knee in joints for joints in moves)
    assert (ankle, rig.joint_names.index("left_hip")) in moves  # the next one that moves


def test_much_clutter_is_doubted_alike_with_equal_weights_and_with_none(tube_rig):
    """Where most of the points would have to be left out, none are."""
    model, rng = Model(tube_rig), np.random.default_rng(0)
    X = np.vstack([model.rig.vertices, rng.uniform(-8, 8, (160, 3))])
    state = model.rest()
    alone, weighted = (Doubt(model).of(Problem(X, w), state) for w in (None, np.full(len(X), 1 / len(X))))
    np.testing.assert_allclose(alone, weighted)
    assert alone.any()
