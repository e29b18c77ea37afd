"""The gradients of the losses: every public term passes one checker."""

import numpy as np
import pytest
from loss_formulas import PARTS, S

from lbsfit_np import losses
from lbsfit_np.losses import (
    PRESETS,
    LossWeights,
    chamfer,
    composite_chamfer,
    composite_structured_chamfer,
    laplacian_offsets,
    laplacian_posed,
    loopback,
    objective,
    structured_chamfer,
)


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
_b = np.random.default_rng(5).uniform(0, 1, len(S.V)) * (np.arange(len(S.V)) % 3 > 0)

# What each public name differentiates to: name → (function of one array → (value, gradient), where).
TERMS = {
    "chamfer": [
        (lambda V: chamfer(S.X, V), S.V),
        (lambda V: chamfer(S.X, V, x_weights=S.a), S.V),
        (lambda V: chamfer(S.X, V, x_weights=S.a, v_weights=_b), S.V),
    ],
    "structured_chamfer": [
        (lambda V: structured_chamfer(S.X, V, *PARTS), S.V),
        (lambda V: structured_chamfer(S.X, V, *PARTS, x_weights=S.a), S.V),
        (lambda V: structured_chamfer(S.X, V, *PARTS, v_weights=_b), S.V),
        (
            lambda V: structured_chamfer(S.X, V, np.maximum(PARTS[0], 1), np.minimum(PARTS[1], 2)),
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
        (_of_two(lambda d, v: composite_structured_chamfer(S.X, d, v, *PARTS)), _pair),
        (_of_two(lambda d, v: composite_structured_chamfer(S.X, d, v, *PARTS, lam=2.0, x_weights=S.a)), _pair),
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
