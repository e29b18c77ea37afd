"""The losses: values against the paper's formulas written out, and what the objective sums up."""

import numpy as np
import pytest
from loss_formulas import PARTS, S, Setting, chamfer_formula, structured_formula
from scipy import sparse
from scipy.spatial.distance import cdist

from lbsfit_np.errors import InputError
from lbsfit_np.losses import (
    PRESETS,
    LossWeights,
    chamfer,
    composite_chamfer,
    composite_structured_chamfer,
    laplacian_posed,
    loopback,
    objective,
    structured_chamfer,
)
from lbsfit_np.neighbors import PointIndex

# ---- terms ----


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("weighted", [False, True])
def test_chamfer_is_the_formula(seed, weighted):
    s = Setting(seed)
    a = s.a if weighted else None
    assert chamfer(s.X, s.V, x_weights=a)[0] == pytest.approx(chamfer_formula(s.X, s.V, a), rel=1e-12)


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
    assert value == pytest.approx(structured_formula(s.X, s.V, x_labels, v_labels, a), rel=1e-12)
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
    assert chamfer(X, lattice)[0] == pytest.approx(chamfer_formula(X, lattice), rel=1e-14)
    assert structured_chamfer(X, lattice, *labels)[0] == pytest.approx(structured_formula(X, lattice, *labels), rel=1e-14)


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
        (composite_chamfer, chamfer_formula, ()),
        (composite_structured_chamfer, structured_formula, (S.x_labels, S.v_labels)),
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
    assert structured_chamfer(S.X, S.V, *PARTS, x_index=parts)[0] == structured_chamfer(S.X, S.V, *PARTS)[0]
    arguments = {"weights": PRESETS["default"], "x_labels": PARTS[0], "v_labels": PARTS[1], "offsets": S.offsets, "K": S.K}
    kept = objective(S.X, S.Vd, S.V, **arguments, x_index=plain, x_part_index=parts)
    fresh = objective(S.X, S.Vd, S.V, **arguments)
    assert kept.value == fresh.value
    np.testing.assert_array_equal(kept.grad_Vd, fresh.grad_Vd)


def test_loopback_is_the_mean_over_a_batch():
    value, grad = loopback(S.found, S.theta)
    assert value == pytest.approx(np.mean([loopback(f, t)[0] for f, t in zip(S.found, S.theta)]), rel=1e-14)
    assert loopback(S.found[0], S.theta[0])[0] == pytest.approx(np.sum((S.found[0] - S.theta[0]) ** 2), rel=1e-14)
    np.testing.assert_allclose(grad[1], loopback(S.found[1], S.theta[1])[1] / 3, atol=1e-15)


def test_lists_and_integers_are_numbers():
    X, V = [[0, 0, 0], [2, 0, 0]], [[1, 0, 0]]
    value, grad = chamfer(X, V, x_weights=[1, 3])
    assert value == 2.0
    assert grad.tolist() in (
        [[1.0, 0, 0], [-3.0, 0, 0]][k : k + 1] for k in (0, 1)
    )  # −1 of the first mean, ±2 of the tied second
    assert structured_chamfer(X, V, [0, 1], [1])[0] == 0.5 + 1
    assert laplacian_posed([[1, 0, 0], [0, 0, 0]], sparse.csr_array([[1, -1], [-1, 1]]))[0] == pytest.approx(np.sqrt(2))


# ---- the objective and its weights ----


def test_the_papers_numbers():
    assert PRESETS["paper"] == LossWeights(chamfer=1.0, lam=0.5, lam_s=1.0, lam_lap=0.005, laplacian="posed", squared=False)


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
        expected["chamfer"] = chamfer_formula(S.X, S.Vd, S.a) + w.lam * chamfer_formula(S.X, S.V, S.a)
    if w.lam_s and labels:
        expected["structured"] = structured_formula(S.X, S.Vd, *PARTS, S.a) + w.lam * structured_formula(S.X, S.V, *PARTS, S.a)
    if w.lam_lap and K is not None:
        KY = K @ (S.Vd if w.laplacian == "posed" else S.offsets)
        expected["laplacian"] = np.sum(KY**2) if w.squared else np.linalg.norm(KY)
    assert set(L.terms) == set(expected)
    for name, value in expected.items():
        assert L.terms[name] == pytest.approx(value, rel=1e-12), name
    factor = {"chamfer": w.chamfer, "structured": w.lam_s, "laplacian": w.lam_lap}
    assert L.value == pytest.approx(sum(factor[name] * value for name, value in expected.items()), rel=1e-12)


@pytest.mark.parametrize("x_empty, v_empty", [(3, 1), (0, 0), (None, 2)])
def test_the_objective_knows_parts_that_one_side_lacks(x_empty, v_empty):
    """Both Chamfer terms are made of one search: where that finds another part, the structured one looks again or has nothing."""
    x_labels, v_labels = np.where(S.x_labels == x_empty, 2, S.x_labels), np.where(S.v_labels == v_empty, 3, S.v_labels)
    L = objective(S.X, S.Vd, S.V, weights=LossWeights(lam=0.2, lam_lap=0.0), x_labels=x_labels, v_labels=v_labels)
    value, grad_Vd, grad_V = composite_structured_chamfer(S.X, S.Vd, S.V, x_labels, v_labels, lam=0.2)
    plain = composite_chamfer(S.X, S.Vd, S.V, lam=0.2)
    assert L.terms["structured"] == pytest.approx(value, rel=1e-14) and L.terms["chamfer"] == pytest.approx(plain[0], rel=1e-14)
    np.testing.assert_allclose(L.grad_Vd, plain[1] + grad_Vd, atol=1e-15)
    np.testing.assert_allclose(L.grad_V, plain[2] + grad_V, atol=1e-15)


def test_weights_are_values():
    w = LossWeights().replace(lam_s=3.0)
    assert w.lam_s == 3.0 and LossWeights().lam_s == 1.0
    assert len({LossWeights(), PRESETS["paper"]}) == 1
