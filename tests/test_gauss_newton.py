"""The Gauss–Newton steps: derivatives against differences, closest points against all triangles, known poses come back."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.jacobian import vertex_jacobian
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout
from lbsfit_np.optimize.surface import closest_on_mesh, faces_around, vertex_normals
from lbsfit_np.synthesis import sample_surface, uniform_poses

BLOCKS = ("pose", "translation", "scale", "proportions")
FIELDS = {"translation": "translation", "scale": "scale", "proportions": "coefficients"}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """As all fits have it: more threads on arrays this small only take time."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def tube(tube_rig):
    return Model(tube_rig)


@pytest.fixture(scope="module")
def shifting(tube_rig):
    return Model(tube_rig, shifts=0.3)


def _state(model, seed, amount=1.0):
    """A pose within the limits, at a place, of the undeformed template."""
    rng = np.random.default_rng(seed)
    theta = amount * uniform_poses(model.rig, 1, rng)[0]
    return model.rest().replace(theta=np.clip(theta, model.rig.lower, model.rig.upper), translation=rng.uniform(-0.2, 0.2, 3))


def _near(model, state, seed, angle=0.15, place=0.03):
    """A start beside a state, inside the limits."""
    rng = np.random.default_rng([seed, 1])
    free = Layout(model.rig, ("pose",), 0).turning
    theta = state.theta + angle * rng.uniform(-1, 1, state.theta.shape) * free
    others = np.arange(len(theta)) != model.rig.root
    theta[others] = np.clip(theta, model.rig.lower, model.rig.upper)[others]
    return state.replace(theta=theta, translation=state.translation + place * rng.uniform(-1, 1, 3))


def _sampled(model, state, n=800, seed=0):
    """A problem of points on the posed surface, and their parts."""
    V = model.pose(state)[0].vertices
    X, triangle, bary = sample_surface(V, model.rig.faces, n, np.random.default_rng([seed, 2]))
    return Problem(X), model.labels[model.rig.faces[triangle, bary.argmax(axis=1)]]


def _joint_error(model, found, true):
    return np.linalg.norm(model.pose(found)[0].joints - model.pose(true)[0].joints, axis=1).mean()


# ---- ∂V/∂x ----


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("options", [{}, {"joints": "fixed"}, {"shifts": 0.3}])
@pytest.mark.parametrize("rig", ["tube_rig", "hand"])
def test_the_jacobian_is_that_of_differences(request, rig, options, block, residual):
    model = Model(request.getfixturevalue(rig), **options)
    rng = np.random.default_rng(3)
    m, k = len(model.rig.vertices), model.n_coefficients
    noise = 0.03 * rng.standard_normal((m, 3)) if residual else None
    state = _state(model, 1).replace(scale=1.2, coefficients=0.1 * rng.standard_normal(k), residual=noise)
    state.theta[model.rig.root] = [1.9, -1.0, 0.7]
    rows = np.sort(rng.choice(m, 40, replace=False))
    turning = Layout(model.rig, ("pose",), 0).turning
    found = vertex_jacobian(model, state, model.pose(state)[0], rows, [block], turning)
    columns = _columns(model, state, rows, block, turning)
    assert found.shape == columns.shape == (40, 3, columns.shape[2])
    np.testing.assert_allclose(found, columns, rtol=0, atol=1e-6 * np.abs(columns).max())
    assert np.abs(columns).max() > 0.01


def _columns(model, state, rows, block, turning, h=1e-5):
    def moved(change):
        return model.pose(change)[0].vertices[rows]

    columns = []
    if block == "pose":
        for j, a in np.argwhere(turning):
            d = np.zeros_like(state.theta)
            d[j, a] = h
            columns.append(moved(state.replace(theta=state.theta + d)) - moved(state.replace(theta=state.theta - d)))
    else:
        value = getattr(state, FIELDS[block])
        for d in h * np.eye(np.size(value)):
            d = d[0] if np.ndim(value) == 0 else d
            up, down = (state.replace(**{FIELDS[block]: value + s * d}) for s in (1, -1))
            columns.append(moved(up) - moved(down))
    return np.stack(columns, axis=2) / (2 * h)


def test_blocks_stand_in_the_given_order(shifting):
    state = _state(shifting, 0)
    posed, rows = shifting.pose(state)[0], np.arange(5)
    turning = Layout(shifting.rig, ("pose",), 0).turning
    turning[2] = False
    alone = [vertex_jacobian(shifting, state, posed, rows, [b], turning) for b in ("scale", "pose", "translation")]
    together = vertex_jacobian(shifting, state, posed, rows, ("scale", "pose", "translation"), turning)
    np.testing.assert_array_equal(together, np.concatenate(alone, axis=2))
    assert together.shape == (5, 3, 1 + turning.sum() + 3)


# ---- closest points ----


def _brute(x, triangles):
    """The distance from x to the nearest of some triangles, each cut into its plane, its edges and its corners."""
    best = np.inf
    for a, b, c in triangles:
        for p, q in ((a, b), (b, c), (c, a)):
            length = (q - p) @ (q - p)
            t = np.clip((x - p) @ (q - p) / length, 0, 1) if length > 0 else 0.0
            best = min(best, np.linalg.norm(x - p - t * (q - p)))
        n = np.cross(b - a, c - a)
        if n @ n > 1e-20:
            foot = x - ((x - a) @ n) / (n @ n) * n
            if all(np.cross(q - p, foot - p) @ n >= 0 for p, q in ((a, b), (b, c), (c, a))):
                best = min(best, np.linalg.norm(x - foot))
    return best


@pytest.mark.parametrize("lift", [0.0, 0.3])
def test_closest_points_of_one_triangle_everywhere_around_it(lift):
    V = np.array([[0.0, 0, 0], [2, 0, 0], [0.3, 1, 0]])
    x, y = np.meshgrid(np.linspace(-1, 3, 23), np.linspace(-1, 2, 17))
    X = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, lift)])
    faces = np.array([[0, 1, 2]])
    around = faces_around(faces, 3)
    for start in range(3):
        on = closest_on_mesh(X, np.full(len(X), start), V, faces, around)
        np.testing.assert_allclose(np.linalg.norm(X - on.points, axis=1), [_brute(p, [V]) for p in X], atol=1e-12)
        np.testing.assert_allclose(np.einsum("nk,nka->na", on.barycentric, V[on.corners]), on.points, atol=1e-15)
        assert (on.barycentric > -1e-12).all()
        np.testing.assert_allclose(on.barycentric.sum(axis=1), 1.0, atol=1e-14)
        np.testing.assert_array_equal(on.normals, np.tile([0.0, 0, 1], (len(X), 1)))


def test_closest_points_of_a_mesh_are_those_among_all_triangles(tube):
    """Inside, outside, and on the skin of a posed mesh."""
    V, faces = tube.pose(_state(tube, 4))[0].vertices, tube.rig.faces
    rng = np.random.default_rng(0)
    on_skin = sample_surface(V, faces, 60, rng)[0]
    X = np.vstack([on_skin, on_skin + 0.02 * rng.standard_normal((60, 3))])
    nearest = np.array([((V - x) ** 2).sum(axis=1).argmin() for x in X])
    on = closest_on_mesh(X, nearest, V, faces, faces_around(faces, len(V)))
    found = np.linalg.norm(X - on.points, axis=1)
    expected = np.array([_brute(x, V[faces]) for x in X])
    assert (found >= expected - 1e-12).all()
    assert np.isclose(found, expected, rtol=0, atol=1e-9).mean() > 0.98  # the closest triangle all but always touches the vertex
    assert found[:60].max() < 0.02 and np.isclose(found[:60], 0, atol=1e-9).mean() > 0.95
    among = [_brute(x, V[faces[(faces == v).any(axis=1)]]) for x, v in zip(X, nearest)]
    np.testing.assert_allclose(found, among, atol=1e-9)  # and is always the closest of those that do


@pytest.mark.parametrize(
    "corners",
    [
        [[0.0, 0, 0], [1, 0, 0], [2, 0, 0]],  # on a line
        [[0.0, 0, 0], [1, 0, 0], [1, 0, 0]],  # two corners at one place
        [[0.5, 0, 0], [0.5, 0, 0], [0.5, 0, 0]],  # all three
        [[0.0, 0, 0], [1, 0, 0], [0.4, 1e-9, 0]],  # all but on a line
    ],
)
def test_triangles_without_area(corners):
    V, faces = np.array(corners), np.array([[0, 1, 2]])
    X = np.random.default_rng(0).uniform(-1, 3, (50, 3))
    with np.errstate(all="raise"):
        on = closest_on_mesh(X, np.zeros(50, int), V, faces, faces_around(faces, 3))
    np.testing.assert_allclose(np.linalg.norm(X - on.points, axis=1), [_brute(x, [V]) for x in X], atol=1e-8)
    assert np.isfinite(on.barycentric).all() and np.isfinite(on.normals).all()


def test_no_points_have_no_closest_points(tube):
    faces = tube.rig.faces
    on = closest_on_mesh(np.empty((0, 3)), np.empty(0, int), tube.rig.vertices, faces, faces_around(faces, 242))
    assert on.points.shape == on.normals.shape == on.barycentric.shape == (0, 3)


def test_faces_around_vertices():
    faces = np.array([[0, 1, 2], [2, 1, 4], [4, 5, 2]])
    around = faces_around(faces, 7)
    assert around.shape == (7, 3)
    for v in range(7):
        has = set(np.flatnonzero((faces == v).any(axis=1)).tolist())
        assert set(around[v].tolist()) == (has or {-1})
    np.testing.assert_array_equal(faces_around(np.empty((0, 3), int), 2), [[-1], [-1]])


def test_normals_of_vertices():
    V = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    n = vertex_normals(V, faces)
    np.testing.assert_allclose(n[[0, 1, 3]], [[2**-0.5, 0, 2**-0.5], [0, 0, 1], [1, 0, 0]], atol=1e-15)
    np.testing.assert_array_equal(n[4], 0.0)


# ---- poses ----


@pytest.mark.parametrize("labelled", [False, True])
@pytest.mark.parametrize("which", ["tube", "hand"])
def test_known_poses_come_back_from_near(tube, hand, which, labelled):
    model = tube if which == "tube" else Model(hand)
    steps = GaussNewton(model)
    for seed in range(4):
        truth = _state(model, seed, 0.8)
        start = _near(model, truth, seed)
        problem, labels = _sampled(model, truth)
        found, value = steps.pose(problem, start, labels=labels if labelled else None, iterations=30)
        assert _joint_error(model, start, truth) > 0.02
        # Without labels vertices pull on their nearest samples, too, which are never quite where they are.
        assert _joint_error(model, found, truth) < (0.001 if labelled else 0.006)
        assert 0 <= value < (1e-5 if labelled else 3e-4)


def test_the_value_falls_and_the_start_is_left_alone(tube):
    truth = _state(tube, 1)
    start = _near(tube, truth, 1)
    kept = start.theta.copy(), start.translation.copy()
    problem, _ = _sampled(tube, truth)
    steps = GaussNewton(tube)
    values = [steps.pose(problem, start, iterations=n)[1] for n in (0, 1, 3, 10)]
    assert (np.diff(values) < 0).all()
    np.testing.assert_array_equal(start.theta, kept[0])
    np.testing.assert_array_equal(start.translation, kept[1])


def test_what_is_not_free_stays(tube):
    truth = _state(tube, 2)
    start = _near(tube, truth, 2).replace(scale=1.1)
    problem, _ = _sampled(tube, truth)
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
    problem, _ = _sampled(tube, beyond)
    start = beyond.replace(theta=np.clip(beyond.theta, rig.lower, rig.upper) * 0.8)
    found = GaussNewton(tube).pose(problem, start, iterations=40)[0]
    assert (found.theta[1:] >= rig.lower[1:]).all() and (found.theta[1:] <= rig.upper[1:]).all()
    assert found.theta[2, 0] == pytest.approx(rig.upper[2, 0], abs=1e-6)
    assert found.theta[0, 1] == pytest.approx(beyond.theta[0, 1], abs=0.05)


def test_a_prior_draws_angles_to_where_they_are_wanted(tube):
    truth = _state(tube, 5, 0.5)
    problem, _ = _sampled(tube, truth)
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


def test_labels_that_no_vertex_has_are_left_out(tube):
    truth = _state(tube, 6, 0.7)
    start = _near(tube, truth, 6)
    problem, labels = _sampled(tube, truth, 600)
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
    problem, labels = _sampled(tube, truth)
    swapped = np.where(labels == 2, 3, np.where(labels == 3, 2, labels))
    right, wrong = (GaussNewton(tube).pose(problem, truth, labels=given)[1] for given in (labels, swapped))
    assert right < 1e-4 and wrong > 10 * right


def test_weights_of_points_count(tube):
    truth = _state(tube, 7, 0.7)
    start = _near(tube, truth, 7)
    problem, _ = _sampled(tube, truth, 600)
    rng = np.random.default_rng(0)
    off = problem.X[:300] + 0.04  # a third of the points lies beside the surface
    X = np.vstack([off, problem.X])
    weights = np.r_[np.full(300, 1e-9), np.ones(600)]
    steps = GaussNewton(tube)
    light = steps.pose(Problem(X, weights / weights.sum()), start, iterations=30)[0]
    heavy = steps.pose(Problem(X), start, iterations=30)[0]
    assert _joint_error(tube, light, truth) < 0.5 * _joint_error(tube, heavy, truth)
    order = rng.permutation(900)
    again = steps.pose(Problem(X[order], (weights / weights.sum())[order]), start, iterations=30)[0]
    np.testing.assert_allclose(again.theta, light.theta, atol=2e-3)


def test_vertices_without_faces_do_not_pull(tube_rig):
    """Such as a rig's helper points: no scan point has to be there."""
    from dataclasses import replace

    from scipy import sparse
    from small_rigs import make_tube_data

    from lbsfit_np.rig.build import build_rig

    data = make_tube_data()
    more = replace(
        data,
        vertices=np.vstack([data.vertices, [[0.1, 0.2, 0.4], [0.3, 0.3, 0.4]]]),
        weights=sparse.csr_array(sparse.vstack([data.weights, sparse.csr_array(np.eye(4)[[1, 3]])])),
    )
    model, plain = Model(build_rig(more)), Model(tube_rig)
    truth = _state(plain, 3, 0.7)
    problem, _ = _sampled(plain, truth)
    start = _near(plain, truth, 3)
    assert len(model.rig.vertices) == 244 and model.half == pytest.approx(plain.half)
    found = [GaussNewton(m).pose(problem, start, iterations=20)[0].theta for m in (model, plain)]
    np.testing.assert_allclose(*found, atol=1e-6)


# ---- poses and their template ----


@pytest.fixture(scope="module")
def subject(shifting):
    """Coefficients of a changed template, five poses of it, and their problems with parts."""
    c = np.zeros(shifting.n_coefficients)
    k = shifting.n_coefficients - shifting._shifts.shape[1]
    rng = np.random.default_rng(1)
    c[:k] = 0.12 * rng.uniform(-1, 1, k)
    truths = [_state(shifting, seed).replace(coefficients=c) for seed in range(5)]
    problems, labels = zip(*(_sampled(shifting, t, 700, seed) for seed, t in enumerate(truths)))
    return c, truths, list(problems), list(labels)


def _template_error(model, c, true):
    """Mean distance of the template's vertices, the templates laid on each other."""
    away = (model.basis @ (c - true)).reshape(-1, 3)
    return np.linalg.norm(away - away.mean(axis=0), axis=1).mean()


def test_many_poses_find_their_template_where_one_cannot(shifting, subject):
    c, truths, problems, labels = subject
    steps = GaussNewton(shifting, reach=0.05, tangential=0.02)
    zero = np.zeros_like(c)
    starts = [_near(shifting, t, seed, angle=0.1).replace(coefficients=zero) for seed, t in enumerate(truths)]
    together, values = steps.shared(problems, starts, iterations=40)
    assert all(np.array_equal(s.coefficients, together[0].coefficients) for s in together)
    assert values.shape == (5,) and (values < 2e-4).all()
    alone = [steps.shared([p], [s], iterations=40)[0][0] for p, s in zip(problems, starts)]
    before, shared = (_template_error(shifting, x, c) for x in (zero, together[0].coefficients))
    single = np.mean([_template_error(shifting, s.coefficients, c) for s in alone])
    assert shared < 0.3 * before and shared < 0.6 * single
    joints = [np.mean([_joint_error(shifting, s, t) for s, t in zip(found, truths)]) for found in (together, alone)]
    assert joints[0] < 0.02 and joints[0] < 0.6 * joints[1]
    labelled, _ = steps.shared(problems, starts, labels=labels, iterations=40)
    assert _template_error(shifting, labelled[0].coefficients, c) < 0.5 * before


def test_eliminated_unknowns_are_those_of_the_whole_system(shifting, subject):
    """One step against the solution of all unknowns at once: poses of three scans, and their one template."""
    c, truths, problems, _ = subject
    steps = GaussNewton(shifting, ridge=1e-4)
    layout = Layout(shifting.rig, ("pose", "translation"), len(c))
    states = [t.replace(coefficients=0.5 * c) for t in truths[:3]]
    weights, damping, n = np.array([0.5, 0.3, 0.2]), 1e-2, layout.size
    made = [steps._normal_equations(p, s, None, layout, True) for p, s in zip(problems, states)]
    H, g = np.zeros((3 * n + len(c),) * 2), np.zeros(3 * n + len(c))
    for k, (m, w) in enumerate(zip(made, weights)):
        own, shared = slice(k * n, (k + 1) * n), slice(3 * n, None)
        H[own, own] = w * (m.H[:n, :n] + np.diag(damping * np.diag(m.H)[:n] + 1e-5))
        H[own, shared], H[shared, own] = w * m.H[:n, n:], w * m.H[n:, :n]
        H[shared, shared] += w * m.H[n:, n:]
        g[own], g[shared] = w * m.g[:n], g[shared] + w * m.g[n:]
    reduced = H[3 * n :, 3 * n :] - H[3 * n :, : 3 * n] @ np.linalg.solve(H[: 3 * n, : 3 * n], H[: 3 * n, 3 * n :])
    H[3 * n :, 3 * n :] += np.diag(damping * np.diag(reduced)) + 1e-4 * np.eye(len(c))
    g[3 * n :] -= 1e-4 * states[0].coefficients
    x = np.linalg.solve(H, g)
    found = steps._step(states, made, np.arange(3), weights, layout, True, damping)
    np.testing.assert_allclose(found[0].coefficients - states[0].coefficients, x[3 * n :], atol=1e-9)
    for k, (before, after) in enumerate(zip(states, found)):
        np.testing.assert_allclose(layout.pack(after) - layout.pack(before), x[k * n : (k + 1) * n], atol=1e-8)


def test_a_scan_of_weight_0_stays_and_does_not_count(shifting, subject):
    c, truths, problems, _ = subject
    starts = [t.replace(coefficients=np.zeros_like(c)) for t in truths]
    steps = GaussNewton(shifting)
    without, _ = steps.shared(problems[:3], starts[:3], iterations=6)
    found, values = steps.shared(problems[:4], starts[:4], scan_weights=[1, 1, 1, 0], iterations=6)
    np.testing.assert_array_equal(found[3].theta, starts[3].theta)
    np.testing.assert_array_equal(found[0].theta, without[0].theta)
    np.testing.assert_array_equal(found[0].coefficients, without[0].coefficients)
    assert np.isnan(values[3]) and np.isfinite(values[:3]).all()


def test_the_ridge_holds_the_coefficients(shifting, subject):
    c, truths, problems, _ = subject
    starts = [t.replace(coefficients=np.zeros_like(c)) for t in truths[:3]]
    sizes = [
        np.linalg.norm(GaussNewton(shifting, ridge=ridge).shared(problems[:3], starts, iterations=10)[0][0].coefficients)
        for ridge in (1e-6, 1e-3, 10.0)
    ]
    assert sizes[0] > sizes[1] > sizes[2] and sizes[2] < 1e-3


def test_coefficients_stay_within_their_bounds(shifting):
    """A scan twice the size would want factors of 2."""
    big = shifting.rest().replace(scale=2.0)
    problem, labels = _sampled(shifting, big)
    found, _ = GaussNewton(shifting, reach=1.0).shared([problem], [shifting.rest()], labels=[labels], iterations=30)
    assert np.abs(found[0].coefficients).max() == pytest.approx(0.5)


def test_of_one_start_comes_one_answer(tube):
    truth = _state(tube, 8)
    problem, _ = _sampled(tube, truth)
    a, b = (GaussNewton(tube).pose(problem, _near(tube, truth, 8))[0] for _ in range(2))
    np.testing.assert_array_equal(a.theta, b.theta)
