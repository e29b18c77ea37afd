"""The losses: values against the paper's formulas written out, gradients of every term by one checker."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial import Delaunay
from scipy.spatial.distance import cdist

from lbsfit_np import losses
from lbsfit_np.errors import InputError
from lbsfit_np.losses import (
    PRESETS,
    LossWeights,
    chamfer,
    composite_chamfer,
    composite_structured_chamfer,
    cotangent_matrix,
    laplacian_offsets,
    laplacian_posed,
    loopback,
    objective,
    structured_chamfer,
)
from lbsfit_np.neighbors import PointIndex


class Setting:
    """A small scan, a deformed and an undeformed model on a mesh, parts, weights: one for all tests of this file."""

    def __init__(self, seed=0, n=37, parts=4):
        rng = np.random.default_rng(seed)
        self.mesh = _bumpy_grid(5, 6, rng)
        self.V = self.mesh[0]
        m = len(self.V)
        self.offsets = 0.1 * rng.standard_normal((m, 3))
        self.Vd = self.V + self.offsets
        self.X = rng.standard_normal((n, 3))
        self.x_labels, self.v_labels = rng.integers(0, parts, n), rng.integers(0, parts, m)
        self.a = rng.random(n) * (rng.random(n) > 0.2)
        self.K = cotangent_matrix(*self.mesh)
        self.theta, self.found = rng.standard_normal((2, 3, 5, 3))


def _bumpy_grid(rows, columns, rng, bump=0.3):
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    V = np.column_stack([x.ravel(), y.ravel(), bump * rng.standard_normal(x.size)]) / columns
    return V, _grid_faces(rows, columns)


def _grid_faces(rows, columns):
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


S = Setting()


# ---- gradients: every public term passes one checker ----


def _of_two(term):
    """A term with gradients to V^d and V, as a function of both in one array."""

    def f(Y):
        value, g_d, g = term(Y[0], Y[1])
        return value, np.stack([g_d, g])

    return f


def _of_objective(weights, with_labels=True):
    labels = {"x_labels": S.x_labels, "v_labels": S.v_labels} if with_labels else {}

    def f(Y):
        L = objective(S.X, Y[0], Y[1], weights=weights, offsets=Y[2], K=S.K, x_weights=S.a, **labels)
        return L.value, np.stack([L.grad_Vd, L.grad_V, L.grad_offsets])

    return f


_pair = np.stack([S.Vd, S.V])
_triple = np.stack([S.Vd, S.V, S.offsets])
_parts = S.x_labels, S.v_labels
_b = np.random.default_rng(5).uniform(0, 1, len(S.V)) * (np.arange(len(S.V)) % 3 > 0)

# What each public name differentiates to: name → (function of one array → (value, gradient), where).
TERMS = {
    "chamfer": [
        (lambda V: chamfer(S.X, V), S.V),
        (lambda V: chamfer(S.X, V, x_weights=S.a), S.V),
        (lambda V: chamfer(S.X, V, x_weights=S.a, v_weights=_b), S.V),
    ],
    "structured_chamfer": [
        (lambda V: structured_chamfer(S.X, V, *_parts), S.V),
        (lambda V: structured_chamfer(S.X, V, *_parts, x_weights=S.a), S.V),
        (lambda V: structured_chamfer(S.X, V, *_parts, v_weights=_b), S.V),
        (
            lambda V: structured_chamfer(S.X, V, np.maximum(_parts[0], 1), np.minimum(_parts[1], 2)),
            S.V,
        ),  # parts empty here and there
    ],
    "composite_chamfer": [
        (_of_two(lambda d, v: composite_chamfer(S.X, d, v)), _pair),
        (_of_two(lambda d, v: composite_chamfer(S.X, d, v, lam=0.3, x_weights=S.a)), _pair),
        (_of_two(lambda d, v: composite_chamfer(S.X, d, v, lam=0.0)), _pair),
        (_of_two(lambda d, v: composite_chamfer(S.X, d, v, lam=0.3, v_weights=_b)), _pair),
    ],
    "composite_structured_chamfer": [
        (_of_two(lambda d, v: composite_structured_chamfer(S.X, d, v, *_parts)), _pair),
        (_of_two(lambda d, v: composite_structured_chamfer(S.X, d, v, *_parts, lam=2.0, x_weights=S.a)), _pair),
    ],
    "laplacian_posed": [
        (lambda V: laplacian_posed(V, S.K), S.Vd),
        (lambda V: laplacian_posed(V, S.K, squared=True), S.Vd),
    ],
    "laplacian_offsets": [
        (lambda o: laplacian_offsets(o, S.K), S.offsets),
        (lambda o: laplacian_offsets(o, S.K, squared=True), S.offsets),
    ],
    "loopback": [
        (lambda p: loopback(p, S.theta[0]), S.found[0]),
        (lambda p: loopback(p, S.theta), S.found),
    ],
    "objective": [
        *((_of_objective(weights), _triple) for weights in PRESETS.values()),
        (_of_objective(PRESETS["default"], with_labels=False), _triple),
        (_of_objective(LossWeights(chamfer=0.4, lam=0.7, lam_s=1.5, lam_lap=0.3, laplacian="posed", squared=True)), _triple),
        (_of_objective(LossWeights(chamfer=0.0, lam=0.0, lam_lap=0.02, laplacian="offsets")), _triple),
    ],
}
NO_TERMS = {"PRESETS", "LossWeights", "cotangent_matrix"}
CASES = [pytest.param(f, x, id=f"{name}-{k}") for name in losses.__all__ if name in TERMS for k, (f, x) in enumerate(TERMS[name])]


def test_every_public_term_is_checked():
    assert set(losses.__all__) == set(TERMS) | NO_TERMS, "a new loss term wants an entry in TERMS"


@pytest.mark.parametrize("f, x", CASES)
def test_gradients_by_finite_differences(f, x):
    value, gradient = f(x)
    assert isinstance(value, float) and gradient.shape == x.shape
    h = 1e-6
    found = np.empty(x.size)
    for k in range(x.size):
        step = h * np.eye(1, x.size, k).reshape(x.shape)
        found[k] = (f(x + step)[0] - f(x - step)[0]) / (2 * h)
    np.testing.assert_allclose(found.reshape(x.shape), gradient, rtol=0, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("f, x", CASES)
def test_terms_leave_their_arguments_alone(f, x):
    given = x.copy()
    f(given)
    np.testing.assert_array_equal(given, x)


# ---- values: the formulas of the paper, written out over all pairs ----


def _chamfer(X, V, a=None):
    d2 = cdist(X, V) ** 2
    a = np.ones(len(X)) if a is None else a
    return a @ d2.min(axis=1) / a.sum() + d2.min(axis=0).sum() / len(V)


def _structured(X, V, x_labels, v_labels, a=None):
    d2 = cdist(X, V) ** 2
    d2[x_labels[:, None] != v_labels[None, :]] = np.inf
    to_V, to_X = d2.min(axis=1), d2.min(axis=0)
    to_V[np.isinf(to_V)], to_X[np.isinf(to_X)] = 0.0, 0.0
    a = np.ones(len(X)) if a is None else a
    return a @ to_V / a.sum() + to_X.sum() / len(V)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("weighted", [False, True])
def test_chamfer_is_the_formula(seed, weighted):
    s = Setting(seed)
    a = s.a if weighted else None
    assert chamfer(s.X, s.V, x_weights=a)[0] == pytest.approx(_chamfer(s.X, s.V, a), rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("empty", ["nowhere", "in the scan", "in the model", "in both", "all apart"])
def test_structured_chamfer_is_the_formula(seed, weighted, empty):
    s = Setting(seed)
    x_labels, v_labels = s.x_labels.copy(), s.v_labels.copy()
    if empty in ("in the scan", "in both"):
        x_labels[x_labels == 3] = 0
    if empty in ("in the model", "in both"):
        v_labels[v_labels == 1] = 2
    if empty == "all apart":
        x_labels[:], v_labels[:] = 5, 2
    a = s.a if weighted else None
    value, grad = structured_chamfer(s.X, s.V, x_labels, v_labels, x_weights=a)
    assert value == pytest.approx(_structured(s.X, s.V, x_labels, v_labels, a), rel=1e-12)
    if empty == "all apart":
        assert value == 0 and (grad == 0).all()


def test_points_of_an_absent_part_still_count_in_the_divisors():
    """Two points and two vertices, of which one each has a partner: 1/n and 1/m stay 1/2."""
    X, V = np.array([[0.0, 0, 0], [5.0, 0, 0]]), np.array([[1.0, 0, 0], [9.0, 0, 0]])
    value, grad = structured_chamfer(X, V, [0, 1], [0, 2])
    assert value == 1 / 2 + 1 / 2
    np.testing.assert_array_equal(grad, [[2.0, 0, 0], [0, 0, 0]])


def test_one_part_for_all_is_the_plain_chamfer():
    zeros = np.zeros(len(S.X), int), np.zeros(len(S.V), int)
    plain, structured = chamfer(S.X, S.V), structured_chamfer(S.X, S.V, *zeros)
    assert structured[0] == pytest.approx(plain[0], rel=1e-12)
    np.testing.assert_allclose(structured[1], plain[1], atol=1e-15)


def test_weights_of_0_leave_points_out_of_the_first_mean_only():
    a = np.ones(len(S.X))
    a[:10] = 0.0
    first = np.mean(cdist(S.X[10:], S.V).min(axis=1) ** 2)
    second = np.mean(cdist(S.V, S.X).min(axis=1) ** 2)
    assert chamfer(S.X, S.V, x_weights=a)[0] == pytest.approx(first + second, rel=1e-12)
    assert chamfer(S.X, S.V, x_weights=7 * np.ones(len(S.X)))[0] == pytest.approx(chamfer(S.X, S.V)[0], rel=1e-14)


def test_vertices_of_weight_0_do_not_look_for_points():
    b = np.ones(len(S.V))
    b[:8] = 0.0
    first = np.mean(cdist(S.X, S.V).min(axis=1) ** 2)
    second = np.mean(cdist(S.V[8:], S.X).min(axis=1) ** 2)
    value, grad = chamfer(S.X, S.V, v_weights=b)
    assert value == pytest.approx(first + second, rel=1e-12)
    found_by_none = np.setdiff1d(np.arange(8), cdist(S.X, S.V).argmin(axis=1))
    assert (grad[found_by_none] == 0).all()
    assert chamfer(S.X, S.V, v_weights=7 * np.ones(len(S.V)))[0] == pytest.approx(chamfer(S.X, S.V)[0], rel=1e-14)
    with pytest.raises(InputError, match="v_weights"):
        chamfer(S.X, S.V, v_weights=np.ones(3))


def test_ties_do_not_change_the_value():
    """Neighbours on a lattice tie everywhere: which of them is found is nobody's business, the distance is."""
    lattice = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3)
    X = lattice + 0.5
    labels = np.arange(27) % 2, np.arange(27)[::-1] % 2
    assert chamfer(X, lattice)[0] == pytest.approx(_chamfer(X, lattice), rel=1e-14)
    assert structured_chamfer(X, lattice, *labels)[0] == pytest.approx(_structured(X, lattice, *labels), rel=1e-14)


def test_a_perfect_fit_costs_nothing():
    value, grad = chamfer(S.V[::-1], S.V)
    assert value == 0 and (grad == 0).all()


def test_chamfer_scales_with_length_squared():
    assert chamfer(1000 * S.X, 1000 * S.V)[0] == pytest.approx(1e6 * chamfer(S.X, S.V)[0], rel=1e-12)


@pytest.mark.parametrize("lam", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("weighted", [False, True])
def test_composites_are_sums(lam, weighted):
    a = S.a if weighted else None
    for composite, plain, labels in (
        (composite_chamfer, _chamfer, ()),
        (composite_structured_chamfer, _structured, (S.x_labels, S.v_labels)),
    ):
        value, _, grad_V = composite(S.X, S.Vd, S.V, *labels, lam=lam, x_weights=a)
        assert value == pytest.approx(plain(S.X, S.Vd, *labels, a) + lam * plain(S.X, S.V, *labels, a), rel=1e-12)
        assert grad_V.any() == (lam > 0)
        # one array for both: the same numbers from one search
        once, twice = composite(S.X, S.V, S.V, *labels, lam=lam), composite(S.X, S.V, S.V.copy(), *labels, lam=lam)
        assert once[0] == pytest.approx(twice[0], rel=1e-14)
        for g, h in zip(once[1:], twice[1:]):
            np.testing.assert_allclose(g, h, atol=1e-15)


def test_a_kept_search_structure_gives_the_same():
    plain, parts = PointIndex(S.X), PointIndex(S.X, S.x_labels)
    assert chamfer(S.X, S.V, x_index=plain)[0] == chamfer(S.X, S.V)[0]
    assert structured_chamfer(S.X, S.V, *_parts, x_index=parts)[0] == structured_chamfer(S.X, S.V, *_parts)[0]
    arguments = {"weights": PRESETS["default"], "x_labels": _parts[0], "v_labels": _parts[1], "offsets": S.offsets, "K": S.K}
    kept = objective(S.X, S.Vd, S.V, **arguments, x_index=plain, x_part_index=parts)
    fresh = objective(S.X, S.Vd, S.V, **arguments)
    assert kept.value == fresh.value
    np.testing.assert_array_equal(kept.grad_Vd, fresh.grad_Vd)


def test_loopback_is_the_mean_over_a_batch():
    value, grad = loopback(S.found, S.theta)
    assert value == pytest.approx(np.mean([loopback(f, t)[0] for f, t in zip(S.found, S.theta)]), rel=1e-14)
    assert loopback(S.found[0], S.theta[0])[0] == pytest.approx(np.sum((S.found[0] - S.theta[0]) ** 2), rel=1e-14)
    np.testing.assert_allclose(grad[1], loopback(S.found[1], S.theta[1])[1] / 3, atol=1e-15)


# ---- the Laplacian ----


def test_laplacian_is_a_frobenius_norm():
    KV, KO = S.K.toarray() @ S.Vd, S.K.toarray() @ S.offsets
    assert laplacian_posed(S.Vd, S.K)[0] == pytest.approx(np.linalg.norm(KV), rel=1e-12)
    assert laplacian_posed(S.Vd, S.K, squared=True)[0] == pytest.approx(np.sum(KV**2), rel=1e-12)
    assert laplacian_offsets(S.offsets, S.K)[0] == pytest.approx(np.linalg.norm(KO), rel=1e-12)
    assert laplacian_offsets(S.offsets, S.K, squared=True)[0] == pytest.approx(np.sum(KO**2), rel=1e-12)


@pytest.mark.parametrize("squared", [False, True])
def test_no_offsets_cost_nothing_and_pull_nowhere(squared):
    value, grad = laplacian_offsets(np.zeros_like(S.V), S.K, squared=squared)
    assert value == 0 and (grad == 0).all()
    value, grad = laplacian_offsets(np.tile([1.0, 2.0, -3.0], (len(S.V), 1)), S.K, squared=squared)  # a shift is smooth
    assert value < 1e-12


def test_cotangents_of_an_equilateral_triangle():
    K = cotangent_matrix(np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, np.sqrt(3) / 2, 0]]), np.array([[0, 1, 2]])).toarray()
    c = 1 / np.sqrt(3)
    np.testing.assert_allclose(K, c * (np.eye(3) * 1.5 - 0.5), atol=1e-15)


def test_cotangents_of_a_regular_grid_are_the_five_point_stencil():
    V, F = _bumpy_grid(5, 5, np.random.default_rng(0), bump=0.0)
    row = cotangent_matrix(V, F).toarray()[12].reshape(5, 5)
    expected = np.zeros((5, 5))
    expected[2, 2], expected[[1, 3, 2, 2], [2, 2, 1, 3]] = 4.0, -1.0
    np.testing.assert_allclose(row, expected, atol=1e-14)


def test_cotangents_of_two_equilateral_triangles_add_up_over_the_edge():
    h = np.sqrt(3) / 2
    V = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, h, 0], [0.5, -h, 0]])
    K = cotangent_matrix(V, np.array([[0, 1, 2], [1, 0, 3]])).toarray()
    assert K[0, 1] == pytest.approx(-1 / np.sqrt(3), rel=1e-14)
    assert K[2, 3] == 0


def test_linear_functions_are_harmonic_inside_a_flat_mesh():
    rng = np.random.default_rng(4)
    xy = rng.random((200, 2))
    triangles = Delaunay(xy)
    V = np.column_stack([xy, 0.3 * xy[:, 0] - 0.7 * xy[:, 1] + 2.0])  # flat, not axis-aligned
    K = cotangent_matrix(V, triangles.simplices)
    inner = np.setdiff1d(np.arange(200), triangles.convex_hull)
    linear = V @ [1.5, -2.0, 0.3] + 4.0
    scale = abs(K)[inner] @ np.abs(linear)
    assert (np.abs((K @ linear)[inner]) < 1e-11 * scale).all()
    assert np.abs((K @ (xy[:, 0] ** 2))[inner]).max() > 1e-3


@pytest.mark.parametrize("mesh", ["grid", "tube"])
def test_cotangent_matrix_is_a_laplacian(mesh, tube_rig):
    V, F = S.mesh if mesh == "grid" else (tube_rig.vertices, tube_rig.faces)
    K = cotangent_matrix(V, F)
    assert abs(K - K.T).max() < 1e-14
    assert np.abs(K.sum(axis=1)).max() < 1e-12 * abs(K).max()
    assert np.linalg.eigvalsh(K.toarray()).min() > -1e-12 * abs(K).max()
    p = V[F]
    area = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum()
    assert np.vdot(V, K @ V) == pytest.approx(2 * area, rel=1e-12)  # Dirichlet energy of the embedding
    np.testing.assert_allclose(cotangent_matrix(1000 * V, F).toarray(), K.toarray(), rtol=1e-9, atol=1e-9)


def test_converges_to_laplace_beltrami_on_a_sphere():
    """On a sphere of radius r the coordinates are eigenfunctions: −Δx = 2 x / r²."""
    from trimesh.creation import icosphere

    r, errors = 3.0, []
    for subdivisions in (1, 2, 3, 4):
        mesh = icosphere(subdivisions=subdivisions, radius=r)
        V, F = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        mass = np.zeros(len(V))
        np.add.at(mass, F, np.asarray(mesh.area_faces)[:, None] / 3)
        found = (cotangent_matrix(V, F) @ V) / mass[:, None]
        errors.append(np.sqrt(mass @ np.sum((found - 2 * V / r**2) ** 2, axis=1) / (mass @ np.sum((2 * V / r**2) ** 2, axis=1))))
    assert errors[-1] < 0.01
    assert all(fine < 0.65 * coarse for coarse, fine in pairwise(errors)), errors  # first order, as lumped masses give


def test_faces_without_area_contribute_nothing():
    V = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [2.0, 0, 0]])
    F = np.array([[0, 1, 2]])
    with_slivers = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [2, 2, 2]])
    np.testing.assert_array_equal(cotangent_matrix(V, with_slivers).toarray(), cotangent_matrix(V, F).toarray())
    assert cotangent_matrix(V, F[:0]).nnz == 0
    assert cotangent_matrix(V, F[:0]).shape == (4, 4)


# ---- the objective and its weights ----


def test_the_papers_numbers():
    assert PRESETS["paper"] == LossWeights(
        chamfer=1.0, lam=0.5, lam_s=1.0, lam_lap=0.005, laplacian="posed", squared=False
    )


@pytest.mark.parametrize(
    "weights", [*PRESETS, LossWeights(chamfer=0.3, lam=0.2, lam_s=2.5, lam_lap=0.1), LossWeights(chamfer=0.0, lam_s=0.0)]
)
@pytest.mark.parametrize("leave_out", ["nothing", "labels", "K"])
def test_the_objective_is_the_sum_of_its_terms(weights, leave_out):
    w = PRESETS[weights] if isinstance(weights, str) else weights
    labels = {} if leave_out == "labels" else {"x_labels": S.x_labels, "v_labels": S.v_labels}
    K = None if leave_out == "K" else S.K
    L = objective(S.X, S.Vd, S.V, weights=weights, offsets=S.offsets, K=K, x_weights=S.a, **labels)
    expected = {}
    if w.chamfer:
        expected["chamfer"] = _chamfer(S.X, S.Vd, S.a) + w.lam * _chamfer(S.X, S.V, S.a)
    if w.lam_s and labels:
        expected["structured"] = _structured(S.X, S.Vd, *_parts, S.a) + w.lam * _structured(S.X, S.V, *_parts, S.a)
    if w.lam_lap and K is not None:
        KY = K @ (S.Vd if w.laplacian == "posed" else S.offsets)
        expected["laplacian"] = np.sum(KY**2) if w.squared else np.linalg.norm(KY)
    assert set(L.terms) == set(expected)
    for name, value in expected.items():
        assert L.terms[name] == pytest.approx(value, rel=1e-12), name
    factor = {"chamfer": w.chamfer, "structured": w.lam_s, "laplacian": w.lam_lap}
    assert L.value == pytest.approx(sum(factor[name] * value for name, value in expected.items()), rel=1e-12)


def test_weights_are_values():
    w = LossWeights().replace(lam_s=3.0)
    assert w.lam_s == 3.0 and LossWeights().lam_s == 1.0
    assert len({LossWeights(), PRESETS["paper"]}) == 1


# ---- bad input ----

_X, _V, _xl, _vl = S.X, S.V, S.x_labels, S.v_labels
_nan = np.where(np.arange(len(_X))[:, None] == 3, np.nan, _X)
BAD = [
    (lambda: chamfer(_X.T, _V), ["X: got shape (3, 37)", "(k, 3)"]),
    (lambda: chamfer(_X, _V[:, :2]), ["V: got shape (30, 2)", "(k, 3)"]),
    (lambda: chamfer(_X[:0], _V), ["X: got an empty set", "at least one point"]),
    (lambda: chamfer(_X, _V[:0]), ["V: got an empty set"]),
    (lambda: chamfer("scan.ply", _V), ["X: got str", "numbers"]),
    (lambda: chamfer(_nan, _V), ["X: got 1 points", "NaN", "row 3"]),
    (lambda: chamfer(_X, np.full_like(_V, np.inf)), ["V: got 30 points", "infinite", "row 0"]),
    (lambda: chamfer(_X, _V, x_weights=np.ones(5)), ["x_weights: got shape (5,)", "(37,)"]),
    (lambda: chamfer(_X, _V, x_weights=-np.ones(37)), ["x_weights", "negative"]),
    (lambda: chamfer(_X, _V, x_weights=np.zeros(37)), ["x_weights", "all 0"]),
    (lambda: chamfer(_X, _V, x_weights=np.full(37, np.nan)), ["x_weights", "not finite"]),
    (lambda: chamfer(_X, _V, x_index=PointIndex(_V)), ["x_index", "30 points", "37 points"]),
    (lambda: chamfer(_X, _V, x_index=PointIndex(_X, _xl)), ["x_index", "with labels", "without labels"]),
    (lambda: structured_chamfer(_X, _V, _xl, _vl, x_index=PointIndex(_X)), ["x_index", "without labels", "with labels"]),
    (lambda: structured_chamfer(_X, _V, _xl[:-1], _vl), ["x_labels: got shape (36,)", "(37,)"]),
    (lambda: structured_chamfer(_X, _V, _xl, _xl), ["v_labels: got shape (37,)", "(30,)"]),
    (lambda: structured_chamfer(_X, _V, _xl.astype(float), _vl), ["x_labels", "float64", "integers"]),
    (lambda: structured_chamfer(_X, _V, _xl - 1, _vl), ["x_labels: got -1 at index", "at least 0"]),
    (lambda: structured_chamfer(_X, _V, _xl + 4 * 10**12, _vl), ["x_labels: got 4000000000003 at index 3", "below 65536"]),
    (lambda: structured_chamfer(_X, _V, _xl, _vl.astype(np.uint64) + np.uint64(2**63)), ["v_labels: got 92233720368547758"]),
    (lambda: chamfer([[10**400, 0, 0]], _V), ["X: got whole numbers beyond double precision"]),
    (lambda: chamfer(_X, _V, x_weights=[10**400] * 37), ["x_weights: got whole numbers beyond double precision"]),
    (lambda: composite_chamfer(_X, _V, _V[:-1]), ["V: got 29 points", "30", "Vd"]),
    (lambda: composite_chamfer(_X, _V, _V[:-1], lam=0.0), ["V: got 29 points"]),
    (lambda: composite_chamfer(_X, _V, _V, lam=-0.5), ["lam: got -0.5", "at least 0"]),
    (lambda: composite_structured_chamfer(_X, _V, _V, _xl, _vl, lam="0.5"), ["lam: got '0.5'"]),
    (lambda: laplacian_posed(_V[:-1], S.K), ["K: got shape (30, 30)", "(29, 29)", "Vd"]),
    (lambda: laplacian_offsets(_V[:, 0], S.K), ["offsets: got shape (30,)"]),
    (lambda: laplacian_offsets(_V, None), ["K: got NoneType", "(30, 30)"]),
    (lambda: cotangent_matrix(_V, np.array([[0, 1, 30]])), ["faces: got rows from 0 to 30", "0 to 29"]),
    (lambda: cotangent_matrix(_V, np.array([[0, 1, -1]])), ["faces: got rows from -1 to 1"]),
    (lambda: cotangent_matrix(_V, np.array([[0.0, 1, 2]])), ["faces: got float64", "integers"]),
    (lambda: cotangent_matrix(_V, np.array([[0, 1, 2, 3]])), ["faces", "(1, 4)", "(F, 3)"]),
    (lambda: cotangent_matrix(_V[:, :2], np.array([[0, 1, 2]])), ["vertices: got shape (30, 2)"]),
    (lambda: loopback(np.zeros((4, 3)), np.zeros((5, 3))), ["theta: got shape (5, 3)", "(4, 3)"]),
    (lambda: loopback(np.zeros((2, 4, 3)), np.zeros((4, 3))), ["theta: got shape (4, 3)", "(2, 4, 3)"]),
    (lambda: loopback(np.zeros(12), np.zeros(12)), ["predicted: got shape (12,)", "(J, 3)"]),
    (lambda: loopback(np.zeros((0, 4, 3)), np.zeros((0, 4, 3))), ["predicted: got shape (0, 4, 3)"]),
    (lambda: objective(_X, _V, _V, weights="best"), ["weights: got 'best'", "'paper'", "'default'"]),
    (lambda: objective(_X, _V, _V, weights={"lam": 1}), ["weights: got {'lam': 1}", "LossWeights"]),
    (lambda: objective(_X, _V, _V, weights="paper", x_labels=_xl), ["v_labels: got None", "x_labels"]),
    (lambda: objective(_X, _V, _V, weights="default", K=S.K), ["offsets: got None"]),
    (lambda: objective(_X, _V, _V[:-2], weights="paper"), ["V: got 28 points"]),
    (lambda: LossWeights(lam=-1.0), ["lam: got -1.0", "at least 0"]),
    (lambda: LossWeights(lam_lap=np.nan), ["lam_lap: got nan"]),
    (lambda: LossWeights(lam_lap=10**400), ["lam_lap: got 1000", "a finite number"]),
    (lambda: LossWeights(lam_lap=10**5000), ["lam_lap: got a number of several thousand digits"]),
    (lambda: LossWeights(laplacian="both"), ["laplacian: got 'both'", "'posed' or 'offsets'"]),
    (lambda: PRESETS["paper"].replace(lam_s=np.inf), ["lam_s: got inf"]),
]


@pytest.mark.parametrize("call, words", BAD)
def test_bad_input_is_named(call, words):
    with pytest.raises(InputError) as error:
        call()
    for word in words:
        assert word in str(error.value)


def test_lists_and_integers_are_numbers():
    X, V = [[0, 0, 0], [2, 0, 0]], [[1, 0, 0]]
    value, grad = chamfer(X, V, x_weights=[1, 3])
    assert value == 2.0
    assert grad.tolist() in (
        [[1.0, 0, 0], [-3.0, 0, 0]][k : k + 1] for k in (0, 1)
    )  # −1 of the first mean, ±2 of the tied second
    assert structured_chamfer(X, V, [0, 1], [1])[0] == 0.5 + 1
    assert laplacian_posed([[1, 0, 0], [0, 0, 0]], sparse.csr_array([[1, -1], [-1, 1]]))[0] == pytest.approx(np.sqrt(2))
