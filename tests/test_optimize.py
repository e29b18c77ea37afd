"""What every fit stands on: the layout of the unknowns, the objective's gradient to all of them, the minimiser, the scale."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.losses import PRESETS, LossWeights, objective
from lbsfit_np.optimize.lbfgs import minimise
from lbsfit_np.optimize.model import Model, farthest_points
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout, State
from lbsfit_np.starts.parts import start_from_parts
from lbsfit_np.starts.scale import near_rows, reference_scale, unit_note

ALL = ("pose", "translation", "scale", "proportions", "residual")


def _state(model, seed=0, residual=True):
    rng = np.random.default_rng(seed)
    rig = model.rig
    theta = rig.lower + rng.random(rig.lower.shape) * (rig.upper - rig.lower)
    theta[rig.root] = rng.uniform(-2, 2, 3)
    noise = 0.03 * rng.standard_normal(rig.vertices.shape) if residual else None
    return State(theta, rng.uniform(-0.3, 0.3, 3), 1.15, 0.1 * rng.standard_normal(model.n_coefficients), noise)


@pytest.fixture(scope="module")
def body(shared_rigs):
    card = Path(lbs.__file__).parent / "bench" / "cards" / "mpfb2_cmu_mb.toml"
    return Model(lbs.load_rig(shared_rigs / "mpfb2_body" / "mpfb2_cmu_mb.npz", card=card))


# ---- the layout ----


@pytest.mark.parametrize(
    "free", [ALL, ("pose",), ("translation", "scale"), ("pose", "translation", "proportions"), ("residual",)]
)
def test_there_and_back(tube_rig, free):
    model = Model(tube_rig)
    state, base = _state(model), _state(model, 1)
    layout = Layout(model.rig, free, model.n_coefficients)
    x = layout.pack(state)
    assert x.shape == (layout.size,)
    again = layout.unpack(x, base)
    fields = dict(zip(ALL, ("theta", "translation", "scale", "coefficients", "residual")))
    for block, field in fields.items():
        np.testing.assert_allclose(
            getattr(again, field), getattr(state if block in free else base, field), rtol=1e-14, err_msg=field
        )


def test_only_what_can_turn_is_free(shared_rigs):
    card = Path(lbs.__file__).parent / "bench" / "cards" / "webxr_left.toml"
    rig = lbs.load_rig(shared_rigs / "webxr_hand" / "left.glb", card=card)
    layout = Layout(rig, ("pose",), 0)
    assert layout.size == 3 + 3 + 2 * 1 + 4 * (2 + 1 + 1)  # wrist, thumb's three, four fingers
    lower, upper = layout.bounds()
    assert np.isinf(lower).sum() == np.isinf(upper).sum() == 3  # the root's
    assert (lower < upper).all()


def test_inside_respects_limits_and_locks(tube_rig, shared_rigs):
    card = Path(lbs.__file__).parent / "bench" / "cards" / "webxr_left.toml"
    for rig in (tube_rig, lbs.load_rig(shared_rigs / "webxr_hand" / "left.glb", card=card)):
        wild = State(np.full(rig.lower.shape, 2.0), np.zeros(3), 50.0, np.array([0.9, -0.9]), None)
        state = Layout(rig, ("pose", "scale", "proportions"), 2).inside(wild)
        others = np.arange(len(rig.parents)) != rig.root
        assert (state.theta[others] >= rig.lower[others]).all() and (state.theta[others] <= rig.upper[others]).all()
        np.testing.assert_array_equal(state.theta[rig.root], 2.0)
        assert (state.theta[rig.merged | rig.locked] == 0).all()
        assert state.scale == pytest.approx(3.0)
        np.testing.assert_array_equal(state.coefficients, [0.5, -0.5])


# ---- the objective's gradient to all unknowns ----


@pytest.mark.parametrize("joints", ["follow", "fixed", "follow the template alone"])
@pytest.mark.parametrize("weights", ["paper", "default", LossWeights(chamfer=0.0, lam=0.0, lam_lap=0.0)])
@pytest.mark.parametrize("residual", [True, False])
def test_gradient_to_the_optimisers_vector(tube_rig, joints, weights, residual):
    model = Model(tube_rig, joints.split()[0], shared=joints.endswith("alone"))
    weights = PRESETS.get(weights, weights) if isinstance(weights, str) else weights
    rng = np.random.default_rng(0)
    state = _state(model, residual=residual)
    target = model.pose(_state(model, 2))[0].vertices
    problem = Problem(target[rng.integers(0, len(target), 90)] + 0.05 * rng.standard_normal((90, 3)), rng.random(90))
    labels = rng.integers(0, 4, 90)
    layout = Layout(model.rig, ALL, model.n_coefficients)

    def value(x):
        return problem.evaluate(model, layout.unpack(x, state), weights, labels, ridge=0.01).value

    e = problem.evaluate(model, state, weights, labels, ridge=0.01)
    gradient = layout.gradient(state, e.theta, e.translation, e.scale, e.coefficients, e.residual)
    x = layout.pack(state)
    h = 1e-6
    for span in (slice(0, 12), slice(12, 15), slice(15, 16), slice(16, 25), slice(25, None, 7)):
        rows = np.arange(layout.size)[span]
        found = np.array([(value(x + h * e_k) - value(x - h * e_k)) / (2 * h) for e_k in np.eye(layout.size)[rows]])
        np.testing.assert_allclose(found, gradient[rows], rtol=0, atol=2e-6 * np.abs(gradient[rows]).max())


def test_the_undeformed_template_counts_without_the_laplacian_as_well(tube_rig):
    model, weights = Model(tube_rig), LossWeights(lam=0.5, lam_s=0.0, lam_lap=0.0)
    state = _state(model, residual=False)
    problem = Problem(model.pose(_state(model, 2))[0].vertices[::3])
    Vd, V = model.pose(state)
    expected = objective(problem.X, Vd.vertices, V.vertices, weights=weights).value
    assert problem.evaluate(model, state, weights).value == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_farthest_points_are_far_along_each_axis(axis):
    points = np.arange(9.0)[:, None] * np.eye(3)[axis]
    np.testing.assert_array_equal(farthest_points(points, 3), [0, 8, 4])  # both ends, then the middle


def test_no_vertex_is_taken_twice_where_several_are_at_one_place():
    """As of two sheets that touch: each copy of a row would pull once more."""
    points = np.tile(np.random.default_rng(5).standard_normal((30, 3)), (2, 1))
    rows = farthest_points(points, 50)
    assert len(np.unique(rows)) == 50 and len(np.unique(rows[:30] % 30)) == 30  # each place before any second time


def test_a_large_rig_is_thinned_for_its_poses(body):
    coarse = body.coarse
    assert len(coarse.rig.vertices) == 2500 and len(body.rig.vertices) == 13380
    state = _state(body, residual=False)
    rows = [int(np.flatnonzero((body.rig.vertices == v).all(axis=1))[0]) for v in coarse.rig.vertices[::100]]
    for full, thin in zip(body.pose(state), coarse.pose(state)):
        np.testing.assert_allclose(thin.vertices[::100], full.vertices[rows], atol=1e-12)
        np.testing.assert_allclose(thin.joints, full.joints, atol=1e-12)
    np.testing.assert_array_equal(coarse.labels[::100], body.labels[rows])
    assert coarse.areas.sum() == pytest.approx(1.0) and body.areas.sum() == pytest.approx(1.0)
    assert set(coarse.labels) == set(body.labels)


def test_gradient_of_the_thinned_rig(body):
    model, rng = body.coarse, np.random.default_rng(1)
    state = _state(body, residual=False)
    problem = Problem(model.pose(_state(body, 3, residual=False))[0].vertices[::9] + 0.02)
    weights = LossWeights(lam=0.5, lam_lap=0.0)
    free = ("pose", "translation", "scale", "proportions")
    layout = Layout(model.rig, free, model.n_coefficients)

    def value(x):
        return problem.evaluate(model, layout.unpack(x, state), weights, model.labels[::9]).value

    e = problem.evaluate(model, state, weights, model.labels[::9])
    gradient = layout.gradient(state, e.theta, e.translation, e.scale, e.coefficients, e.residual)
    x, h = layout.pack(state), 1e-8  # a longer way crosses ties between nearest vertices
    for _ in range(10):
        d = rng.standard_normal(layout.size)
        slope = (value(x + h * d) - value(x - h * d)) / (2 * h)
        assert abs(slope - gradient @ d) < 1e-6 * np.linalg.norm(gradient)


def test_a_model_is_the_rig_with_a_longest_half_extent_of_1(tube_rig):
    for factor in (1.0, 1000.0):
        model = Model(tube_rig.scaled(factor))
        assert np.ptp(model.rig.vertices, axis=0).max() == pytest.approx(2.0, rel=1e-14)
        assert model.half == pytest.approx(factor * tube_rig.size / 2)


# ---- the minimiser ----


def _quadratic(target):
    def evaluate(s):
        away = s.theta - target
        zero = np.zeros(3)
        return SimpleNamespace(
            value=float(np.vdot(away, away)), theta=2 * away, translation=zero, scale=0.0, coefficients=np.zeros(0), residual=None
        )

    return evaluate


def test_it_stops_at_the_limits_and_leaves_the_root_free(tube_rig):
    target = np.full((4, 3), 3.0)
    start = State(np.zeros((4, 3)), np.zeros(3), 1.0, np.zeros(0), None)
    outcome = minimise(_quadratic(target), start, tube_rig, ("pose",), max_iterations=50)
    np.testing.assert_allclose(outcome.state.theta[0], 3.0, atol=1e-6)
    np.testing.assert_allclose(outcome.state.theta[1:], tube_rig.upper[1:], atol=1e-12)
    assert outcome.converged and outcome.evaluations >= 2
    assert outcome.value == pytest.approx(np.sum((outcome.state.theta - target) ** 2))
    np.testing.assert_array_equal(start.theta, 0.0)


@pytest.mark.parametrize("factor", [1e-9, 1.0, 1e9])
def test_what_has_converged_does_not_hang_on_the_objectives_unit(factor, tube_rig):
    """Nor what is counted: each evaluation once."""
    model = Model(tube_rig)
    problem = Problem(model.pose(_state(model, 2))[0].vertices)

    def count(unit):
        calls = []

        def evaluate(s):
            calls.append(s)
            e = problem.evaluate(model, s, LossWeights(lam=0.0, lam_lap=0.0))
            gradients = {name: unit * getattr(e, name) for name in ("value", "theta", "translation", "scale")}
            return SimpleNamespace(**gradients, coefficients=e.coefficients, residual=e.residual)

        outcome = minimise(evaluate, model.rest(), model.rig, ALL[:3], max_iterations=200, tolerance=1e-3)
        assert outcome.converged and outcome.evaluations == len(calls)
        return len(calls)

    plain, other = count(1.0), count(factor)
    assert 3 < plain < 60 and abs(other - plain) < 3, (plain, other)


def test_running_out_of_iterations_is_not_convergence(tube_rig):
    model = Model(tube_rig)
    problem = Problem(model.pose(_state(model, 2))[0].vertices)
    outcome = minimise(
        lambda s: problem.evaluate(model, s, LossWeights(lam=0.0, lam_lap=0.0)),
        model.rest(),
        model.rig,
        ALL[:3],
        max_iterations=2,
    )
    assert not outcome.converged and "ITERATIONS" in outcome.message.upper()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("good", [0, 3])
def test_an_objective_that_is_not_finite_is_said(tube_rig, good, bad):
    inner, calls = _quadratic(np.full((4, 3), 0.1)), []

    def evaluate(s):
        e = inner(s)
        calls.append(e.value)
        if len(calls) > good:
            e.value = bad
        return e

    start = State(np.zeros((4, 3)), np.zeros(3), 1.0, np.zeros(0), None)
    outcome = minimise(evaluate, start, tube_rig, ("pose",), max_iterations=50)
    assert not outcome.converged
    if good == 0:
        assert "not finite" in outcome.message
    assert np.isfinite(outcome.state.theta).all()


# ---- starts ----


def test_parts_in_place_give_the_pose(tube_rig):
    model, errors = Model(tube_rig), []
    for seed in range(4):
        truth = _state(model, seed, residual=False).replace(coefficients=np.zeros(model.n_coefficients), scale=1.0)
        truth.theta[0] *= 0.4  # the root: what the limits of a sampled pose allow
        posed = model.pose(truth)[0]
        known = np.eye(4)[model.labels]
        free = start_from_parts(model, posed.vertices, known, x_weights=model.areas, pull=1e-9, max_iterations=300)
        assert free.value < 1e-3  # squared distance of the centroids: within 0.03
        held = model.pose(start_from_parts(model, posed.vertices, known, x_weights=model.areas).state)[0]
        before = model.pose(model.rest())[0].joints + (posed.vertices.mean(axis=0) - model.rig.vertices.mean(axis=0))
        errors.append([np.linalg.norm(joints - posed.joints, axis=1).mean() for joints in (held.joints, before)])
    found, unmoved = np.mean(errors, axis=0)
    assert found < 0.2 and found < 0.5 * unmoved


def test_a_part_without_points_leaves_its_joints_alone(tube_rig):
    model = Model(tube_rig)
    V = model.rig.vertices + [0.5, 0.0, 0.2]
    seen = model.labels != 3
    outcome = start_from_parts(model, V[seen], np.eye(4)[model.labels[seen]])
    assert np.isfinite(outcome.state.theta).all()
    np.testing.assert_allclose(outcome.state.theta[3], np.clip(0.0, tube_rig.lower[3], tube_rig.upper[3]), atol=0.02)


# ---- the reference scale ----


@pytest.mark.parametrize("metres", [1.0, 0.01, 0.25])
@pytest.mark.parametrize(("name", "unit"), [("metres", 1.0), ("centimetres", 0.01), ("millimetres", 0.001), ("inches", 0.0254)])
def test_units_of_scans_are_told_where_the_rigs_is_known(tube_rig, metres, name, unit):
    rig = replace(tube_rig, metres_per_unit=metres)
    for s in lbs.synthesize(rig, 5, random_state=0):
        found = reference_scale(metres / unit * s.points, rig, "estimate")
        if 0.4 <= metres / unit <= 1.8:
            assert (found.scale, found.note) == (1.0, "scan and rig are in one unit")
        else:
            assert found.scale == metres / unit and f"seems to be in {name}" in found.note


@pytest.mark.parametrize("unit", [1000.0, 10.0, 25.4, 0.01, 39.3701])
def test_without_the_rigs_unit_the_extents_decide(tube_rig, unit):
    """No factor is likelier than another then: 2.54 or 10 would be found in anything."""
    rig = replace(tube_rig, metres_per_unit=None)
    for s in lbs.synthesize(rig, 5, random_state=0):
        found = reference_scale(unit * s.points, rig, "estimate")
        assert 0.55 < found.scale / unit < 1.8 and found.scale != unit
        assert "a guess from the extents" in found.note
        assert reference_scale(s.points, rig, "estimate").scale == 1.0


@pytest.mark.parametrize("unit", [1e5, 3.0, 1 / 39.3701])
def test_an_odd_size_is_taken_as_it_is(tube_rig, unit):
    rig = replace(tube_rig, metres_per_unit=1.0)
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    found = reference_scale(unit * s.points, rig, "estimate")
    assert 0.5 * unit < found.scale < 2 * unit and "a guess from the extents" in found.note


def test_outliers_do_not_change_the_unit(tube_rig):
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    far = np.vstack([s.points, np.random.default_rng(0).uniform(-50, 50, (len(s.points) // 30, 3))])
    assert reference_scale(far, tube_rig, "estimate").scale == 1.0


def test_a_fixed_scale_wants_the_rigs_unit(tube_rig):
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    assert reference_scale(s.points, tube_rig, "fixed").scale == 1.0
    for factor in (1000.0, 0.01):
        with pytest.raises(InputError, match="scale: got 'fixed' for a scan whose extent.*scale='estimate'"):
            reference_scale(factor * s.points, tube_rig, "fixed")


def test_extents_without_a_number_are_errors(tube_rig):
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    with pytest.raises(InputError, match="points: got an extent of .*that double precision can square"):
        reference_scale(1e300 * s.points, tube_rig, "estimate")
    for place in (np.zeros((1, 3)), np.full((100, 3), 7.0), 1e-200 * s.points):
        with pytest.raises(InputError, match="points: got an extent of 0: all points are at one place; .*spread"):
            reference_scale(place, tube_rig, "estimate")
    piled = np.zeros((100, 3))
    piled[0] = tube_rig.size
    assert np.isfinite(reference_scale(piled, tube_rig, "estimate").scale)


@pytest.mark.parametrize(
    "scale, metres, words",
    [
        (1.0, None, "scan and rig are in one unit"),
        (1.5, None, "scan and rig are in one unit"),  # people differ
        (1 / 1.5, 1.0, "scan and rig are in one unit"),
        (1.05, 0.01, "scan and rig are in one unit"),  # both in centimetres
        (1040.0, 1.0, "the scan seems to be in millimetres: one rig unit is 1040 scan units"),
        (96.0, 1.0, "the scan seems to be in centimetres: one rig unit is 96 scan units"),
        (41.3, 1.0, "the scan seems to be in inches: one rig unit is 41.3 scan units"),
        (0.0011, 0.001, "the scan seems to be in metres: one rig unit is 0.0011 scan units"),
        (250.0, 0.25, "the scan seems to be in millimetres"),
        (5.0, 1.0, "the scan is in another unit or of another size: one rig unit is 5 scan units"),
        (1000.0, None, "the scan is in another unit or of another size: one rig unit is 1000 scan units"),
    ],
)
def test_the_unit_in_words(tube_rig, scale, metres, words):
    assert unit_note(scale, replace(tube_rig, metres_per_unit=metres), "estimate").startswith(words)


def test_a_fixed_scale_in_words(tube_rig):
    assert unit_note(1.0, tube_rig, "fixed") == "scale fixed at 1"


# ---- wild points ----


@pytest.mark.parametrize("unit, place", [(1.0, 0.0), (1000.0, [1e4, 0.0, -3e3])])
def test_wild_points_are_left_out_and_no_others(tube_rig, unit, place):
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    n, rng = len(s.points), np.random.default_rng(0)
    directions = rng.standard_normal((25, 3))
    wild = 30 * directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(0.2, 100, (25, 1))
    points = unit * np.vstack([s.points, wild]) + place
    rows, dropped = near_rows(points, np.arange(len(points)))
    np.testing.assert_array_equal(rows, np.arange(n))
    assert dropped == 25
    some = np.arange(0, n, 3)
    rows, dropped = near_rows(points, some)
    np.testing.assert_array_equal(rows, some)
    assert dropped == 0


def test_a_clump_beyond_reach_is_wild_however_dense_it_is(tube_rig):
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    clump = np.array([4.0, 0.0, 1.0]) + 0.02 * np.random.default_rng(0).random((40, 3))
    rows, dropped = near_rows(np.vstack([s.points, clump]), np.arange(len(s.points) + 40))
    np.testing.assert_array_equal(rows, np.arange(len(s.points)))
    assert dropped == 40


def test_points_beside_the_body_are_told_by_their_loneliness(tube_rig):
    s = lbs.synthesize(tube_rig, 1, random_state=0)[0]
    low, high = s.points.min(axis=0), s.points.max(axis=0)
    beside = [[low[0], low[1], low[2] - 0.3], [high[0], high[1] + 0.3, high[2]], [high[0] + 0.3, low[1], high[2]]]
    rows, dropped = near_rows(np.vstack([s.points, beside]), np.arange(len(s.points) + 3))
    assert dropped == 3 and rows.max() < len(s.points)


@pytest.mark.parametrize("settings", [{"n_points": 5000}, {"n_points": 300}, {"noise": 0.02}, {"density": 0.0}, {"holes": 5}])
def test_the_bodys_own_points_are_kept(tube_rig, settings):
    """Few or many, noisy, unevenly dense, with holes."""
    for s in lbs.synthesize(tube_rig, 4, random_state=1, **settings):
        assert near_rows(s.points, np.arange(len(s.points)))[1] <= 0.005 * len(s.points)


def test_tenfold_density_is_no_clutter(tube_rig):
    s = lbs.synthesize(tube_rig, 1, random_state=2, n_points=6000, holes=0, density=0.0)[0]
    dense = s.points[:, 1] > np.median(s.points[:, 1])
    thin = np.flatnonzero(~dense)[::10]
    rows = np.sort(np.r_[np.flatnonzero(dense), thin])
    assert near_rows(s.points, rows)[1] <= 0.01 * len(thin)


@pytest.mark.parametrize("height, dropped", [(6.7, 0), (7.3, 1)])
def test_how_lonely_a_wild_point_is(height, dropped):
    """On a grid the fifth neighbour is √2 away, so that five times as far is 7.07."""
    x, y = np.mgrid[:21.0, :21.0]
    grid = np.column_stack([x.ravel(), y.ravel(), np.zeros(441)])
    rows, n = near_rows(np.vstack([grid, [[10.0, 10.0, height]]]), np.arange(442))
    assert n == dropped and (rows[:441] == np.arange(441)).all()


@pytest.mark.parametrize("away, dropped", [(2.8, 0), (3.2, 10)])
def test_how_far_a_wild_clump_is(away, dropped):
    """A ball of radius 1 has an extent of 2, of which one and a half is 3."""
    ball = np.random.default_rng(0).standard_normal((1000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    clump = [away, 0.0, 0.0] + 0.02 * np.random.default_rng(1).standard_normal((10, 3))
    rows, n = near_rows(np.vstack([ball, clump]), np.arange(1010))
    assert n == dropped and (rows[:1000] == np.arange(1000)).all()


def test_few_points_are_all_kept():
    points = np.random.default_rng(0).random((5, 3))
    rows, dropped = near_rows(points, np.arange(5))
    np.testing.assert_array_equal(rows, np.arange(5))
    assert dropped == 0


def test_labels_of_parts_without_skin_draw_no_start(tube_rig, monkeypatch):
    """They would hold it back by their share."""
    model, away = Model(tube_rig), np.array([3.0, -2.0, 1.0])
    X = np.vstack([model.rig.vertices, model.rig.vertices]) + away
    labels = np.append(model.labels, np.full(len(model.labels), 4))  # no vertex has the last
    monkeypatch.setattr("lbsfit_np.starts.parts.minimise", lambda evaluate, state, *how, **limits: state)
    start = start_from_parts(model, X, np.eye(5)[labels], x_weights=np.tile(model.areas, 2))
    np.testing.assert_allclose(start.translation, away, atol=1e-12)
