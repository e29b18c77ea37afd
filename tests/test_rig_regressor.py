"""The joint regressor: exact at rest, and joints that follow a changed template as bones would."""

import numpy as np
import pytest
from scipy import sparse
from small_rigs import make_tube_data

from lbsfit_np.io.rigs import load_rig
from lbsfit_np.rig.regressor import exact_regressor, regressor_from_weights


def test_exact_at_rest_with_rows_that_sum_to_one(tube_rig):
    R = tube_rig.regressor
    assert np.abs(R @ tube_rig.vertices - tube_rig.joints).max() < 1e-12
    assert np.abs(R.sum(axis=1) - 1).max() < 1e-12
    assert R.nnz < 0.3 * R.shape[0] * R.shape[1]


def test_joints_scale_turn_and_shift_with_the_template(tube_rig):
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for change in (lambda p: 1.1 * p, lambda p: p @ turn.T + [3.0, -2.0, 5.0], lambda p: p * [1.0, 1.2, 0.9]):
        changed = tube_rig.with_template(change(tube_rig.vertices))
        np.testing.assert_allclose(changed.joints, change(tube_rig.joints), atol=1e-12)
        assert np.abs(changed.regressor @ changed.vertices - changed.joints).max() < 1e-12


def test_a_thicker_finger_leaves_the_joints_where_they_are(tube_rig):
    U = tube_rig.vertices.copy()
    in_finger = tube_rig.weights[:, [2]].toarray()[:, 0]
    axis = tube_rig.joints[2]
    thicker = U + (0.1 * in_finger)[:, None] * (U - axis) * [1.0, 0.0, 1.0]
    moved = np.linalg.norm(tube_rig.with_template(thicker).joints - tube_rig.joints, axis=1)
    thickness = np.linalg.norm(thicker - U, axis=1).max()
    assert moved.max() < 0.15 * thickness


def test_joints_beyond_a_lengthened_bone_move_along(tube_rig):
    U, J = tube_rig.vertices, tube_rig.joints
    beyond_elbow = tube_rig.weights.toarray()[:, 1:].sum(axis=1)
    longer = U.copy()
    # the forearm stretches by 10 % between the elbow and the knuckles, fingers ride on it
    reach = np.clip(U[:, 1] - J[1, 1], 0.0, J[2, 1] - J[1, 1])
    longer[:, 1] += 0.1 * reach * (beyond_elbow > 0)
    moved = tube_rig.with_template(longer).joints - J
    expected = 0.1 * (J[2, 1] - J[1, 1])
    np.testing.assert_allclose(moved[2:, 1], expected, rtol=0.25)
    assert np.abs(moved[:2]).max() < 0.15 * expected
    assert np.abs(moved[:, [0, 2]]).max() < 0.1 * expected


def test_joint_outside_its_skin_takes_a_wide_support():
    """A joint far from its ring would swing wildly with small changes if its own vertices had to reach it."""
    data = make_tube_data()
    joints = data.joints.copy()
    joints[1] += [0.0, 0.0, 0.5]
    R = regressor_from_weights(data.vertices, data.weights, data.parents, joints)
    assert np.abs(R @ data.vertices - joints).max() < 1e-10


def test_flat_template_still_gives_finite_rows():
    rng = np.random.default_rng(1)
    U = rng.random((60, 3)) * [1.0, 1.0, 0.0]
    w = sparse.csr_array(np.eye(2)[(U[:, 0] > 0.5).astype(int)])
    joints = np.array([[0.2, 0.5, 0.1], [0.5, 0.5, 0.0]])
    R = regressor_from_weights(U, w, np.array([-1, 0]), joints)
    assert np.isfinite(R.data).all()
    found = R @ U
    np.testing.assert_allclose(found[1], joints[1], atol=1e-10)
    np.testing.assert_allclose(found[0, :2], joints[0, :2], atol=1e-10)  # z cannot be reached
    assert np.abs(R.sum(axis=1) - 1).max() < 1e-10


def test_exact_regressor_changes_as_little_as_it_must(tube_rig):
    same = exact_regressor(tube_rig.regressor, tube_rig.vertices, tube_rig.joints)
    np.testing.assert_allclose(same.data, tube_rig.regressor.data, atol=1e-13)
    off = tube_rig.regressor.copy()
    off.data = off.data * 1.001
    np.testing.assert_allclose(exact_regressor(off, tube_rig.vertices, tube_rig.joints).data, tube_rig.regressor.data, atol=2e-3)


@pytest.mark.parametrize("other", ["male_avg", "male_heavy"])
def test_one_shapes_regressor_finds_the_joints_of_others(shared_rigs, other):
    file = shared_rigs / "mpfb2_body" / "mpfb2_cmu_mb.npz"
    rig, truth = load_rig(file), load_rig(file, shape=other)
    found = rig.with_template(truth.vertices).joints
    error = np.linalg.norm(found - truth.joints, axis=1)
    left_alone = np.linalg.norm(rig.joints - truth.joints, axis=1)
    assert error.mean() < 0.016
    assert left_alone.mean() > 0.1
    assert np.abs(rig.regressor).sum(axis=1).max() < 2.0
