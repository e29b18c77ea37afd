"""∂V/∂x: derivatives of posed vertices against differences."""

import numpy as np
import pytest
from posed_samples import state_within
from scipy import sparse

import lbsfit_np as lbs
from lbsfit_np.optimize.jacobian import joint_motion, vertex_motion
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
    motion = vertex_motion(model, state, model.pose(state)[0], rows, [block], turning)
    columns = _columns(model, state, rows, block, turning)
    np.testing.assert_allclose(_dense(motion), columns, rtol=0, atol=1e-6 * np.abs(columns).max())
    assert np.abs(columns).max() > 0.01


@pytest.mark.parametrize("blocks", [("pose",), ("pose", "translation", "scale"), ("translation",)])
def test_joints_move_as_differences_say(hand, blocks):
    model = Model(hand)
    rng = np.random.default_rng(3)
    state = state_within(model, 1).replace(scale=1.2, coefficients=0.1 * rng.standard_normal(model.n_coefficients))
    state.theta[model.rig.root] = [1.9, -1.0, 0.7]
    turning = Layout(model.rig, ("pose",), 0).turning
    motion = joint_motion(state, model.deformed(state), blocks, turning)
    columns = np.concatenate([_columns(model, state, slice(None), block, turning, of="joints") for block in blocks], axis=2)
    np.testing.assert_allclose(motion.dense(), columns, rtol=0, atol=1e-6 * np.abs(columns).max())
    np.testing.assert_allclose(motion.dense(), _dense(motion), rtol=0, atol=1e-12)


def _dense(motion):
    """(n, 3, p): a pull on a single place gives its row of J as g."""
    n = len(motion.arms)
    pulls = np.eye(3 * n).reshape(3 * n, n, 3)
    rows = [motion.normal_equations(r, np.zeros((n, 3)), np.ones(n), 1.0)[1] for r in pulls]
    return np.array(rows).reshape(n, 3, -1)


def _columns(model, state, rows, block, turning, h=1e-5, of="vertices"):
    def moved(change):
        return getattr(model.pose(change)[0], of)[rows]

    columns = []
    if block == "pose":
        for j, a in np.argwhere(turning):
            d = np.zeros_like(state.theta)
            d[j, a] = h
            columns.append(moved(state.replace(theta=state.theta + d)) - moved(state.replace(theta=state.theta - d)))
    elif block == "scale":  # about the root joint
        root = model.rig.joints[model.rig.root]
        up, down = (state.replace(scale=state.scale + s * h, translation=state.translation - s * h * root) for s in (1, -1))
        columns.append(moved(up) - moved(down))
    else:
        value = getattr(state, FIELDS[block])
        for d in h * np.eye(np.size(value)):
            up, down = (state.replace(**{FIELDS[block]: value + s * d}) for s in (1, -1))
            columns.append(moved(up) - moved(down))
    return np.stack(columns, axis=2) / (2 * h)


def test_blocks_stand_in_the_given_order_after_the_angles(shifting):
    state = state_within(shifting, 0)
    posed, rows = shifting.pose(state)[0], np.arange(5)
    turning = Layout(shifting.rig, ("pose",), 0).turning
    turning[2] = False
    alone = [_dense(vertex_motion(shifting, state, posed, rows, [b], turning)) for b in ("pose", "scale", "translation")]
    together = _dense(vertex_motion(shifting, state, posed, rows, ("scale", "pose", "translation"), turning))
    np.testing.assert_array_equal(together, np.concatenate(alone, axis=2))
    assert together.shape == (5, 3, turning.sum() + 1 + 3)


def _sums(J, r, normals, weights, tangential):
    """Σ w Jᵀ M J and Σ w Jᵀ M r, place by place."""
    H, g = 0.0, 0.0
    for J_i, r_i, n, w in zip(J, r, normals, weights):
        M = np.outer(n, n) + tangential * np.eye(3)
        H, g = H + w * J_i.T @ M @ J_i, g + w * J_i.T @ M @ r_i
    return H, g


@pytest.mark.parametrize("blocks", [("pose",), ("translation", "scale"), ("pose", "translation", "scale", "proportions")])
def test_normal_equations_are_the_sums_over_all_places(shifting, blocks):
    """Of places between the vertices, with the Jacobian by differences."""
    rng = np.random.default_rng(6)
    k, rows = shifting.n_coefficients, np.arange(0, 200, 5)
    state = state_within(shifting, 2).replace(scale=0.8, coefficients=0.1 * rng.standard_normal(k))
    turning = Layout(shifting.rig, ("pose",), 0).turning
    places = sparse.csr_array(rng.random((30, len(rows))) * (rng.random((30, len(rows))) < 0.1))
    r, normals, weights = rng.standard_normal((30, 3)), rng.standard_normal((30, 3)), rng.random(30)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[3] = 0.0  # a triangle without area
    motion = vertex_motion(shifting, state, shifting.pose(state)[0], rows, blocks, turning).at(places)
    vertices = np.concatenate([_columns(shifting, state, rows, block, turning) for block in blocks], axis=2)
    J = np.einsum("kn,nap->kap", places.toarray(), vertices)
    for found, expected in zip(motion.normal_equations(r, normals, weights, 0.02), _sums(J, r, normals, weights, 0.02)):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
