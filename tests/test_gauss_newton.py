"""Gauss–Newton steps on the pose of one scan: known poses come back."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from posed_samples import joint_error, near, sampled, state_within
from scipy import sparse
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.optimize import gauss_newton
from lbsfit_np.optimize.gauss_newton import GaussNewton, _Normal
from lbsfit_np.optimize.jacobian import VertexMotion
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout
from lbsfit_np.optimize.visibility import WHOLE, Coverage
from lbsfit_np.rig.build import build_rig

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def tube(tube_rig):
    return Model(tube_rig)


@pytest.mark.parametrize("labelled", [False, True])
@pytest.mark.parametrize("which", ["tube", "hand"])
def test_known_poses_come_back_from_near(tube, hand, which, labelled):
    model = tube if which == "tube" else Model(hand)
    steps = GaussNewton(model)
    for seed in range(4):
        truth = state_within(model, seed, 0.8)
        start = near(model, truth, seed)
        problem, labels = sampled(model, truth)
        found, value = steps.pose(problem, start, labels=labels if labelled else None, iterations=30)
        assert joint_error(model, start, truth) > 0.02
        # Without labels places of the mesh pull on their nearest samples, too, which are never quite where they are.
        assert joint_error(model, found, truth) < (0.001 if labelled else 0.006)
        assert 0 <= value < (1e-5 if labelled else 3e-4)


def test_the_value_falls_and_the_start_is_left_alone(tube):
    truth = state_within(tube, 1)
    start = near(tube, truth, 1)
    kept = start.theta.copy(), start.translation.copy()
    problem, _ = sampled(tube, truth)
    steps = GaussNewton(tube)
    values = [steps.pose(problem, start, iterations=n)[1] for n in (0, 1, 3, 10)]
    assert (np.diff(values) < 0).all()
    np.testing.assert_array_equal(start.theta, kept[0])
    np.testing.assert_array_equal(start.translation, kept[1])


@pytest.fixture
def steps_taken(monkeypatch):
    """(damping, stretch) of each step, as they are taken."""
    taken, step = [], GaussNewton._step

    def noted(self, *args):
        taken.append(args[-2:])
        return step(self, *args)

    monkeypatch.setattr(GaussNewton, "_step", noted)
    return taken


def test_slow_steps_become_longer_until_one_does_not_help(tube, steps_taken, monkeypatch):
    starts, values = [], {}
    for seed in range(8):
        truth = state_within(tube, seed, 0.8)
        starts.append((sampled(tube, truth), near(tube, truth, seed)))
    for furthest in (1.0, gauss_newton._FURTHEST):
        monkeypatch.setattr(gauss_newton, "_FURTHEST", furthest)
        steps_taken.clear()
        values[furthest] = np.mean([np.log(GaussNewton(tube).pose(p, s, iterations=20)[1]) for (p, _), s in starts])
    assert values[gauss_newton._FURTHEST] < values[1.0] - 0.1
    stretches = np.array([stretch for _, stretch in steps_taken])
    assert stretches.min() == 1.0 and stretches.max() == gauss_newton._FURTHEST
    assert (stretches[1:][np.diff(stretches) < 0] == 1.0).all()  # back to the plain step at once
    assert (np.diff(stretches)[np.diff(stretches) > 0] <= stretches[:-1][np.diff(stretches) > 0] * 0.5 + 1e-12).all()
    steps_taken.clear()
    for (problem, labels), start in starts:
        GaussNewton(tube).pose(problem, start, labels=labels)
    assert {stretch for _, stretch in steps_taken} == {1.0}


def test_damping_never_falls_where_it_would_have_to_grow_in_vain(tube, steps_taken):
    """A pose that is found ends the steps soon, however many went well before."""
    truth = state_within(tube, 2, 0.8)
    problem, _ = sampled(tube, truth)
    steps = GaussNewton(tube, tolerance=0.0)
    steps.pose(problem, near(tube, truth, 2), iterations=100)
    dampings = np.array([damping for damping, _ in steps_taken])
    assert dampings.min() == gauss_newton._SOFTEST
    failed = np.flatnonzero(np.diff(dampings) > 0)
    assert len(steps_taken) < 100 and len(failed) >= 10  # it has ended as no damping helped
    np.testing.assert_allclose(dampings[failed + 1] / dampings[failed], 10.0)


@pytest.fixture
def dictated(tube, monkeypatch):
    """(shares that steps lower E by, negative where they do not help; whether shared; labels) → (damping, stretch) of each."""

    def made(gains, shared=False, labels=None):
        values, E, taken = [1.0], 1.0, []
        for gain in gains:
            values.append(E * (1 - gain))
            E = min(E, values[-1])
        left, steps, rest = iter(values), GaussNewton(tube, tolerance=0.0), tube.rest()
        monkeypatch.setattr(steps, "_normal_equations", lambda *given: SimpleNamespace(value=next(left)))
        monkeypatch.setattr(steps, "_step", lambda states, *given: taken.append(given[-2:]) or states)
        if shared:
            steps.shared([None], [rest], labels=[labels], iterations=len(gains))
        else:
            steps.pose(None, rest, labels=labels, iterations=len(gains))
        return np.array(taken)

    return made


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize(
    "gains, stretches",
    [
        ([0.2] * 5, [1, 1.5, 2.25, 3, 3]),
        ([0.29, 0.31, 0.1, 0.1], [1, 1.5, 1, 1.5]),
        ([0.01, 0.2, 0.9, 0.9], [1, 1.5, 2.25, 1]),
        ([0.2, 0.2, -1.0, -1.0, 0.2, 0.2], [1, 1.5, 2.25, 1, 1, 1.5]),
    ],
)
def test_a_step_after_a_slow_one_goes_further(dictated, gains, stretches, shared):
    assert dictated(gains, shared)[:, 1].tolist() == stretches
    assert dictated(gains, shared, labels=np.zeros(3, dtype=int))[:, 1].tolist() == [1] * len(gains)


def test_a_step_that_went_too_far_does_not_stiffen_the_next(dictated):
    dampings = dictated([0.2, 0.2, -1.0, -1.0, 0.2])[:, 0]
    np.testing.assert_allclose(dampings, [1e-3, 2.5e-4, 6.25e-5, 6.25e-5, 6.25e-4])


def test_fourteen_steps_in_vain_end_the_softest_ones(dictated):
    dampings, stretches = dictated([0.9] * 20 + [-1.0] * 20).T
    assert dampings.min() == 1e-9 and stretches.max() == 1
    assert len(dampings) == 20 + 14  # 1e-9, 1e-8 … 1e4


def test_what_is_not_free_stays(tube):
    truth = state_within(tube, 2)
    start = near(tube, truth, 2).replace(scale=1.1)
    problem, _ = sampled(tube, truth)
    steps = GaussNewton(tube)
    found = steps.pose(problem, start, free=("pose", "translation"))[0]
    assert found.scale == 1.1 and not np.array_equal(found.theta, start.theta)
    found = steps.pose(problem, start, free=("translation",))[0]
    np.testing.assert_array_equal(found.theta, start.theta)
    found = steps.pose(problem, start, free=("pose", "translation", "scale"), iterations=40)[0]
    assert found.scale == pytest.approx(1.0, abs=0.01)


def test_limits_hold_and_the_root_has_none(tube):
    """A scan of a pose beyond the limits: the angles end at them."""
    rig = tube.rig
    beyond = tube.rest().replace(theta=np.zeros((4, 3)))
    beyond.theta[2, 0], beyond.theta[0, 1] = rig.upper[2, 0] + 0.3, rig.upper[0, 1] + 0.4
    problem, _ = sampled(tube, beyond)
    start = beyond.replace(theta=np.clip(beyond.theta, rig.lower, rig.upper) * 0.8)
    found = GaussNewton(tube).pose(problem, start, iterations=40)[0]
    assert (found.theta[1:] >= rig.lower[1:]).all() and (found.theta[1:] <= rig.upper[1:]).all()
    assert found.theta[2, 0] == pytest.approx(rig.upper[2, 0], abs=1e-6)
    assert found.theta[0, 1] == pytest.approx(beyond.theta[0, 1], abs=0.05)


def test_an_angle_at_its_limit_leaves_the_step_to_the_others(tube_rig, tube):
    """They go where they go when the angle cannot move at all, be it at its upper or its lower limit."""
    for limit in ("upper", "lower"):
        bound = getattr(tube_rig, limit)[2, 0]
        start = tube.rest().replace(theta=np.zeros((4, 3)))
        start.theta[2, 0], start.theta[0, 1] = bound, 0.2
        beyond = start.replace(theta=start.theta.copy())
        beyond.theta[2, 0], beyond.theta[0, 1] = bound + 0.3 * np.sign(bound), 0.3
        problem, _ = sampled(tube, beyond)
        held = {name: getattr(tube_rig, name).copy() for name in ("lower", "upper")}
        for limits in held.values():
            limits[2, 0] = bound
        free = GaussNewton(tube).pose(problem, start, iterations=1)[0]
        without = GaussNewton(Model(replace(tube_rig, **held))).pose(problem, start, iterations=1)[0]
        np.testing.assert_allclose(free.theta, without.theta, atol=1e-9)
        assert np.abs(free.theta - start.theta).max() > 0.01


def test_two_steps_of_the_scale_go_all_the_way_from_any_scale(tube):
    """Where only the scale is wrong, its distance falls to a fraction: steps know how points go with the scale's logarithm."""
    for scale in (0.6, 1.8):
        truth = state_within(tube, 3, 0.3).replace(scale=scale)
        problem, labels = sampled(tube, truth, n=3000)
        held = truth.translation - 0.02 * scale * tube.rig.joints[tube.rig.root]  # the root joint is where it was
        start = truth.replace(scale=1.02 * scale, translation=held)
        found = GaussNewton(tube).pose(problem, start, free=("scale",), labels=labels, iterations=2)[0]
        assert abs(found.scale - scale) < 0.15 * abs(start.scale - scale)


def test_a_prior_draws_angles_to_where_they_are_wanted(tube):
    truth = state_within(tube, 5, 0.5)
    problem, _ = sampled(tube, truth)
    wanted = truth.theta.copy()
    wanted[3, 0] += 0.3
    steps = GaussNewton(tube)
    away = [
        abs(steps.pose(problem, truth, prior=(wanted, w), iterations=30)[0].theta[3, 0] - wanted[3, 0])
        for w in (0.0, 1e-4, 1e-2, 10.0)
    ]
    assert away[0] == pytest.approx(0.3, abs=0.03) and (np.diff(away) < 0).all() and away[-1] < 1e-3
    plain, value = steps.pose(problem, truth, iterations=10)
    same, with_prior = steps.pose(problem, truth, prior=(wanted, 0.0), iterations=10)
    np.testing.assert_array_equal(plain.theta, same.theta)
    assert value == with_prior
    _, value = steps.pose(problem, truth, prior=(wanted, 2.0), iterations=0)
    np.testing.assert_allclose(value, steps.pose(problem, truth, iterations=0)[1] + 2.0 * 0.3**2, rtol=1e-12)


def test_a_prior_may_hold_some_angles_and_couple_others(tube):
    """One weight is that of all; with weights that go together, one angle off draws the other along."""
    truth = state_within(tube, 5, 0.5)
    problem, _ = sampled(tube, truth)
    steps, turning = GaussNewton(tube), Layout(tube.rig, ("pose",), 0).turning
    t = int(turning.sum())
    wanted = truth.theta.copy()
    wanted[3, 0] += 0.3
    one, same = (steps.pose(problem, truth, prior=(wanted, w))[0].theta for w in (1e-2, 1e-2 * np.eye(t)))
    np.testing.assert_array_equal(one, same)
    k, other = np.cumsum(turning.ravel()).reshape(turning.shape)[[3, 2], [0, 0]] - 1
    weights = np.zeros((t, t))
    weights[k, k] = weights[other, other] = 1e-2
    weights[k, other] = weights[other, k] = -0.9e-2
    _, value = steps.pose(problem, truth, prior=(wanted, weights), iterations=0)
    assert value == pytest.approx(steps.pose(problem, truth, iterations=0)[1] + 1e-2 * 0.3**2, rel=1e-12)
    apart = np.diag(np.diag(weights))
    plain, coupled = (steps.pose(problem, truth, prior=(wanted, w), iterations=30)[0].theta for w in (apart, weights))
    # −0.9 of the weight between them: what the first is off, the other is wanted to be off, too.
    assert plain[3, 0] - truth.theta[3, 0] > 0.1 and coupled[2, 0] - plain[2, 0] < -0.01
    held = steps.pose(problem, truth.replace(theta=wanted), prior=(wanted, 10.0 * np.eye(t)), iterations=30)[0]
    assert np.abs(held.theta - wanted)[turning].max() < 2e-3


def test_a_prior_holds_a_pose_whose_proportions_are_found_as_well(tube):
    truth = state_within(tube, 5, 0.5)
    problem, _ = sampled(tube, truth)
    steps = GaussNewton(tube)
    wanted = truth.theta.copy()
    wanted[3, 0] += 0.3
    _, plain = steps.with_proportions(problem, truth, iterations=0)
    _, value = steps.with_proportions(problem, truth, iterations=0, prior=(wanted, 2.0))
    assert value == pytest.approx(plain + 2.0 * 0.3**2, rel=1e-12)
    held, left = steps.with_proportions(problem, truth, iterations=30, prior=(wanted, 10.0))
    assert abs(held.theta[3, 0] - wanted[3, 0]) < 2e-3 and left < value
    assert np.abs(held.coefficients - truth.coefficients).max() > 1e-3  # what the pose may not explain, they do


def test_labels_that_no_vertex_has_are_left_out(tube):
    truth = state_within(tube, 6, 0.7)
    start = near(tube, truth, 6)
    problem, labels = sampled(tube, truth, 600)
    rng = np.random.default_rng(0)
    clutter, a = rng.uniform(-1, 1, (200, 3)), rng.random(600) / 300
    more = Problem(np.vstack([clutter, problem.X]), np.r_[np.full(200, 1 / 600), a])
    steps = GaussNewton(tube)
    alone = steps.pose(Problem(problem.X, a), start, labels=labels)
    beside = steps.pose(more, start, labels=np.r_[np.full(200, 4), labels])
    np.testing.assert_allclose(beside[0].theta, alone[0].theta, atol=1e-9)
    assert beside[1] == pytest.approx(alone[1], rel=1e-9)
    confused = steps.pose(more, start, labels=np.r_[np.zeros(200, int), labels])
    assert not np.allclose(confused[0].theta, alone[0].theta, atol=1e-4)
    nobody = steps.pose(problem, start, labels=np.full(600, 4))  # no point has a part: nothing moves
    np.testing.assert_allclose(nobody[0].theta, start.theta, atol=1e-12)
    assert nobody[1] == 0.0


def test_labels_keep_points_to_their_parts(tube):
    """The short finger's points beside the long finger: their labels know better."""
    truth = tube.rest()
    problem, labels = sampled(tube, truth)
    swapped = np.where(labels == 2, 3, np.where(labels == 3, 2, labels))
    right, wrong = (GaussNewton(tube).pose(problem, truth, labels=given)[1] for given in (labels, swapped))
    assert right < 1e-4 and wrong > 10 * right


@pytest.mark.parametrize("seed", [7, 8, 9])
def test_weights_of_points_count(tube, seed):
    truth = state_within(tube, seed, 0.7)
    start = near(tube, truth, seed)
    problem, _ = sampled(tube, truth, 600)
    rng = np.random.default_rng(0)
    off = problem.X[:300] + 0.04  # a third of the points lies beside the surface
    X = np.vstack([off, problem.X])
    weights = np.r_[np.full(300, 1e-9), np.ones(600)]
    steps = GaussNewton(tube)
    light = steps.pose(Problem(X, weights / weights.sum()), start, iterations=30)[0]
    heavy = steps.pose(Problem(X), start, iterations=30)[0]
    assert joint_error(tube, light, truth) < 0.5 * joint_error(tube, heavy, truth)
    order = rng.permutation(900)
    # One step: which of two faces is the closest at their edge is a matter of rounding, and more steps go different ways.
    same = steps.pose(Problem(X, weights / weights.sum()), start, iterations=1)[0]
    otherwise = Problem(X[order], (weights / weights.sum())[order])
    again = steps.pose(otherwise, start, iterations=1)[0]
    assert np.abs(same.theta - start.theta).max() > 0.01
    np.testing.assert_allclose(again.theta, same.theta, atol=1e-9)
    again = steps.pose(otherwise, start, iterations=30)[0]  # but they end near the same place
    assert max(joint_error(tube, found, truth) for found in (light, again)) < 0.01


def test_vertices_without_faces_do_not_pull(tube_rig):
    """Such as a rig's helper points: no scan point has to be there."""
    data = make_tube_data()
    more = replace(
        data,
        vertices=np.vstack([data.vertices, [[0.1, 0.2, 0.4], [0.3, 0.3, 0.4]]]),
        weights=sparse.csr_array(sparse.vstack([data.weights, sparse.csr_array(np.eye(4)[[1, 3]])])),
    )
    model, plain = Model(build_rig(more)), Model(tube_rig)
    truth = state_within(plain, 3, 0.7)
    problem, _ = sampled(plain, truth)
    start = near(plain, truth, 3)
    assert len(model.source.vertices) == 244 and model.half == pytest.approx(plain.half)
    assert len(model.rig.vertices) == len(model.areas) == 242  # the model is of the surface alone
    found = [GaussNewton(m).pose(problem, start, iterations=20)[0].theta for m in (model, plain)]
    np.testing.assert_allclose(*found, atol=1e-6)


def test_no_angle_turns_far_in_one_step(tube):
    """Nor does the whole move far: nothing is known of what lies behind."""
    truth = tube.rest().replace(theta=np.zeros((4, 3)))
    truth.theta[1:, 0] = [1.2, 0.0, 0.0]
    truth.theta[0, 1] = 0.8
    problem, _ = sampled(tube, truth)
    steps, start = GaussNewton(tube, reach=1.0), tube.rest()
    for n in (1, 2):
        found = steps.pose(problem, start, iterations=n)[0]
        turned = np.abs(found.theta - start.theta).max()
        assert 0.3 * (n - 1) < turned <= 0.3 * n + 1e-12
    assert turned > 0.31
    away = steps.pose(Problem(problem.X + [0.9, 0.0, 0.0]), truth, free=("translation",), iterations=1)[0]
    np.testing.assert_allclose(away.translation[0], 0.3, rtol=1e-12)


def test_of_a_one_sided_scan_the_shown_vertices_pull_as_all_do_of_a_whole_one(tube):
    """Far beyond its reach each residual counts s²: points as much as all vertices that pull."""
    state = tube.rest()
    V = tube.pose(state)[0].vertices
    front = Problem(V[V[:, 2] > np.median(V[:, 2])] + [0.0, 0.0, 50.0])
    for partial in (False, True):
        value = GaussNewton(tube, coverage=Coverage(partial), reach=0.05).pose(front, state, iterations=0)[1]
        assert value == pytest.approx(2 * 0.05**2, rel=1e-3)


@pytest.mark.parametrize("q", [1.0, 1.5])
def test_of_a_cropped_scan_nothing_is_known_beyond_its_hull(q, tube):
    """Neither where the body goes on there, nor how: what is within is fitted as if all were shown."""
    truth = state_within(tube, 3).replace(scale=q, coefficients=np.zeros(tube.n_coefficients))
    problem, labels = sampled(tube, truth)
    cropped = Problem(problem.X[labels < 3])
    start = near(tube, truth, 3)
    whole, part = (GaussNewton(tube, coverage=coverage, reach=0.5) for coverage in (WHOLE, Coverage(cropped=True)))
    assert part.pose(cropped, truth, iterations=0)[1] < 0.2 * whole.pose(cropped, truth, iterations=0)[1]
    off = []
    for steps in (whole, part):
        found = tube.deformed(steps.pose(cropped, start, iterations=30)[0]).joints
        off.append(np.linalg.norm(found - tube.deformed(truth).joints, axis=1)[:3].max())
    assert off[1] < 0.02 and off[1] < 0.5 * off[0]


def test_of_a_cropped_scan_what_is_within_pulls_as_all_does_of_a_whole_one(tube):
    """A scan that is a box about the lower half, far from all: beyond its reach each residual counts s²."""
    V = tube.rig.vertices
    low, high = V.min(axis=0) - 5.0, np.append(V.max(axis=0)[:2] + 5.0, 0.0)[[0, 2, 1]] + [0.0, V[:, 1].mean(), 5.0]
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    for coverage in (WHOLE, Coverage(cropped=True)):
        value = GaussNewton(tube, coverage=coverage, reach=0.05).pose(Problem(corners), tube.rest(), iterations=0)[1]
        assert value == pytest.approx(2 * 0.05**2, rel=1e-3)


def test_of_one_start_comes_one_answer(tube):
    truth = state_within(tube, 8)
    problem, _ = sampled(tube, truth)
    a, b = (GaussNewton(tube).pose(problem, near(tube, truth, 8))[0] for _ in range(2))
    np.testing.assert_array_equal(a.theta, b.theta)


def test_normal_equations_have_the_slope_of_the_value():
    """g = −½ ∂E/∂x of robust residuals r − J x at x = 0, normals held."""
    rng = np.random.default_rng(5)
    r, J, weight = 0.1 * rng.standard_normal((60, 3)), rng.standard_normal((60, 3, 4)), rng.random(60)
    normals = rng.standard_normal((60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def value(x):
        return _Normal(r - J @ x, normals, weight, 0.05, 0.1, None).value

    motion = VertexMotion(np.empty((60, 3, 0)), np.empty((3, 0)), np.empty(0, dtype=int), J)
    found = _Normal(r, normals, weight, 0.05, 0.1, lambda: motion)
    h = 1e-6
    slope = [(value(h * e) - value(-h * e)) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(found.g, -0.5 * np.array(slope), rtol=1e-6)
    assert found.H.shape == (4, 4) and np.linalg.eigvalsh(found.H).min() > 0


@pytest.mark.parametrize("partial", [False, True])
def test_vertices_pull_as_the_value_falls(tube, partial):
    """g = −½ ∂E/∂t of a translation t, which leaves normals as they are, where points lie on the surface and do not pull."""
    truth = state_within(tube, 3)
    problem, _ = sampled(tube, truth)
    steps, layout = GaussNewton(tube, coverage=Coverage(partial)), Layout(tube.rig, ("translation",), tube.n_coefficients)

    def made(t):
        state = truth.replace(translation=truth.translation + t)
        return steps._normal_equations(problem, state, None, layout, False)

    h, g = 1e-7, made(np.zeros(3)).g
    slope = [(made(h * e).value - made(-h * e).value) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(g, -0.5 * np.array(slope), atol=1e-3 * np.abs(g).max())
    assert np.abs(g).max() > 1e-5
