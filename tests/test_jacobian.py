"""∂V/∂x: derivatives of posed vertices against differences."""

import numpy as np
import pytest
from posed_samples import state_within

import lbsfit_np as lbs
from lbsfit_np.optimize.jacobian import vertex_jacobian
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.state import Layout

pytestmark = pytest.mark.usefixtures("one_thread")

BLOCKS = ("pose", "translation", "scale", "proportions")
FIELDS = {"translation": "translation", "scale": "scale", "proportions": "coefficients"}


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def shifting(tube_rig):
    return Model(tube_rig, shifts=0.3)


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("options", [{}, {"joints": "fixed"}, {"shifts": 0.3}])
@pytest.mark.parametrize("rig", ["tube_rig", "hand"])
def test_the_jacobian_is_that_of_differences(request, rig, options, block, residual):
    model = Model(request.getfixturevalue(rig), **options)
    rng = np.random.default_rng(3)
    m, k = len(model.rig.vertices), model.n_coefficients
    noise = 0.03 * rng.standard_normal((m, 3)) if residual else None
    state = state_within(model, 1).replace(scale=1.2, coefficients=0.1 * rng.standard_normal(k), residual=noise)
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
    state = state_within(shifting, 0)
    posed, rows = shifting.pose(state)[0], np.arange(5)
    turning = Layout(shifting.rig, ("pose",), 0).turning
    turning[2] = False
    alone = [vertex_jacobian(shifting, state, posed, rows, [b], turning) for b in ("scale", "pose", "translation")]
    together = vertex_jacobian(shifting, state, posed, rows, ("scale", "pose", "translation"), turning)
    np.testing.assert_array_equal(together, np.concatenate(alone, axis=2))
    assert together.shape == (5, 3, 1 + turning.sum() + 3)
