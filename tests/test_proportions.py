"""Proportions: a linear family of templates whose bones stretch as the module's text says, for any rig."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_rigs import make_tube_data, seamed

import lbsfit_np
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.state import MOST_PROPORTION
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.chains import bones
from lbsfit_np.synthesis import with_random_proportions

CARDS = Path(lbsfit_np.__file__).parent / "bench" / "cards"


@pytest.fixture(params=["tube", "hand", "fox"])
def rig(request):
    if request.param == "tube":
        return request.getfixturevalue("tube_rig")
    file, card = {"hand": ("webxr_hand/left.glb", "webxr_left"), "fox": ("fox/Fox.glb", "fox")}[request.param]
    return load_rig(request.getfixturevalue("shared_rigs") / file, card=CARDS / f"{card}.toml").welded


def test_two_factors_a_bone_and_three_where_it_branches(tube_rig):
    family = tube_rig.proportions
    assert family.basis.shape == (len(tube_rig.vertices), 3, 9)  # root 2, elbow (two fingers) 3, fingers 2 each
    assert family.joints.shape == (4, 3, 9)
    np.testing.assert_array_equal(family.length, [1, 0, 1, 0, 0, 1, 0, 1, 0])


def test_nothing_changes_at_0(rig):
    zero = np.zeros(len(rig.proportions.length))
    assert (rig.proportions.offsets(zero) == 0).all() and (rig.proportions.moved_joints(zero) == 0).all()


def test_all_factors_alike_scale_the_whole(rig):
    """B_j = (1 + c) I for every bone is the template scaled about the root: the directions of each bone are orthonormal."""
    family = rig.proportions
    c = np.full(len(family.length), 0.07)
    root = rig.joints[rig.root]
    np.testing.assert_allclose(family.offsets(c), 0.07 * (rig.vertices - root), atol=1e-13 * rig.size)
    np.testing.assert_allclose(family.moved_joints(c), 0.07 * (rig.joints - root), atol=1e-13 * rig.size)


def test_what_a_rig_keeps_is_read_only(tube_rig):
    family = tube_rig.proportions
    for array in (family.basis, family.joints, family.length, family.owner, family.girths):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0


def test_it_is_linear(rig):
    family = rig.proportions
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, len(family.length)))
    np.testing.assert_allclose(family.offsets(2 * a - b), 2 * family.offsets(a) - family.offsets(b), atol=1e-12 * rig.size)
    np.testing.assert_allclose(family.moved_joints(a + b), family.moved_joints(a) + family.moved_joints(b), atol=1e-12 * rig.size)


def test_a_longer_finger_is_longer_and_nothing_else_moves(tube_rig):
    rig, family = tube_rig, tube_rig.proportions
    long = rig.joint_names.index("long")
    c = np.zeros(9)
    c[5] = 0.2
    moved = family.offsets(c)
    w = rig.weights.toarray()
    along = np.average(rig.vertices, axis=0, weights=w[:, long]) - rig.joints[long]
    along /= np.linalg.norm(along)
    expected = 0.2 * w[:, [long]] * ((rig.vertices - rig.joints[long]) @ along)[:, None] * along
    np.testing.assert_allclose(moved, expected, atol=1e-14)
    assert (family.moved_joints(c) == 0).all()


def test_a_longer_forearm_carries_its_fingers_along(tube_rig):
    rig, family = tube_rig, tube_rig.proportions
    c = np.zeros(9)
    c[2] = 0.1  # the elbow's length
    bone = rig.joints[2:].mean(axis=0) - rig.joints[1]
    moved = family.moved_joints(c)
    np.testing.assert_allclose(moved[2:].mean(axis=0), 0.1 * bone, atol=1e-14)
    assert (moved[:2] == 0).all()
    tips = rig.weights.toarray()[:, 2] == 1
    np.testing.assert_allclose(family.offsets(c)[tips], np.broadcast_to(moved[2], (tips.sum(), 3)), atol=1e-14)


def test_girths_widen_the_skin_of_bones_that_branch_alone(rig, tube_rig):
    """Half as much as breadth and depth do; of bones that do not branch they would be what thickness is."""
    family, tube_family = rig.proportions, tube_rig.proportions
    columns = np.bincount(family.owner)[family.owner]
    wide = np.flatnonzero(~family.length & (columns == 3))
    assert family.girths.shape == (len(rig.vertices), 3, len(wide)) and len(wide) > 0
    bone, w = bones(rig), rig.weights.toarray()
    for g, q in enumerate(wide):
        own = w[:, bone == family.owner[q]].sum(axis=1)
        assert not family.girths[own == 0, :, g].any()
        fully = own > 1 - 1e-9
        if family is tube_family:
            assert fully.any()
        # Where the bone has all of the skin, only what the joint itself moves tells the two apart.
        both = family.basis[fully, :, q] - family.joints[family.owner[q], :, q]
        np.testing.assert_allclose(family.girths[fully, :, g], 0.5 * both, atol=1e-12 * rig.size)
    np.testing.assert_allclose(rig.scaled(10.0).proportions.girths, 10 * family.girths, atol=1e-11 * rig.size)


def test_no_coefficients_within_their_bounds_take_all_of_a_width(rig):
    """The skin that a bone has for itself keeps a quarter of its distance from the bone at least."""
    family = rig.proportions
    q = int(np.flatnonzero(~family.length & (np.bincount(family.owner)[family.owner] == 3))[0])
    j, g = family.owner[q], 0
    own = rig.weights.toarray()[:, bones(rig) == j].sum(axis=1) > 1 - 1e-9
    across = family.girths[own, :, g] / 0.5
    moved = -MOST_PROPORTION * (family.basis[own, :, q] - family.joints[j, :, q] + family.girths[own, :, g])
    np.testing.assert_allclose(across + moved, 0.25 * across, atol=1e-12 * rig.size)


def test_the_joints_of_a_model_stay_where_girths_widen_it(rig):
    for joints in ("follow", "fixed"):
        model = Model(rig, joints, shifts=0.1)
        n, g = model.n_proportions, rig.proportions.girths.shape[2]
        assert model.n_coefficients == n + g + model._shifts.shape[1]
        c = model.rest().coefficients
        c[n : n + g] = 0.2
        state = model.rest().replace(coefficients=c)
        assert not model.joint_offsets(state).any()
        expected = rig.scaled(1 / model.half).proportions.girths.sum(axis=2) * 0.2
        np.testing.assert_allclose(model.offsets(state), expected, atol=1e-12)


def test_a_thicker_finger_keeps_its_length(tube_rig):
    rig, family = tube_rig, tube_rig.proportions
    c = np.zeros(9)
    c[6] = 0.2
    along = np.average(rig.vertices, axis=0, weights=rig.weights.toarray()[:, 2]) - rig.joints[2]
    along /= np.linalg.norm(along)
    assert np.abs(family.offsets(c) @ along).max() < 1e-15
    assert np.abs(family.offsets(c)).max() > 1e-3


def test_each_bone_as_written(rig):
    """The formula of the module's text, joint by joint, for bones whose factors are all different."""
    family = rig.proportions
    c = 0.1 * np.random.default_rng(3).standard_normal(len(family.length))
    bone = np.arange(len(rig.parents))
    for level, up in rig.levels:
        for j, p in zip(level, up):
            bone[j] = j if rig.moving[j] else bone[p]
    U, J = rig.vertices + family.offsets(c), rig.joints + family.moved_joints(c)
    B, weights = {}, rig.weights.toarray()
    for b in np.unique(bone):
        inside = weights[:, bone == b].sum(axis=1) == 1  # vertices that this bone alone leads
        if inside.sum() < 4:
            continue
        arm = rig.vertices[inside] - rig.joints[b]
        B[b], *_ = np.linalg.lstsq(arm, U[inside] - J[b], rcond=None)
        np.testing.assert_allclose(arm @ B[b], U[inside] - J[b], atol=1e-12 * rig.size)
    assert len(B) > 2
    for j in np.flatnonzero(rig.parents >= 0):
        if bone[rig.parents[j]] in B:
            b = B[bone[rig.parents[j]]]
            np.testing.assert_allclose(
                J[j] - J[rig.parents[j]], (rig.joints[j] - rig.joints[rig.parents[j]]) @ b, atol=1e-9 * rig.size
            )


def test_the_regressor_nearly_finds_the_familys_joints(rig):
    family = rig.proportions
    rng = np.random.default_rng(1)
    c = 0.08 * rng.standard_normal((len(family.length), 20))
    carry = np.unique(rig.weights.tocoo().col)
    true = family.joints @ c
    found = np.einsum("jm,mks->jks", rig.regressor.toarray(), family.basis @ c)
    error = np.sqrt(np.mean((found - true)[carry] ** 2))
    assert error < 0.3 * np.sqrt(np.mean(true[carry] ** 2))


def test_a_flat_template_still_has_bones_with_three_directions():
    data = make_tube_data()
    plane = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0] * [1, 1, 0]  # not along the axes
    flat = build_rig(replace(data, vertices=data.vertices @ plane.T, joints=data.joints @ plane.T))
    c = np.full(len(flat.proportions.length), 0.1)
    np.testing.assert_allclose(flat.proportions.offsets(c), 0.1 * (flat.vertices - flat.joints[flat.root]), atol=1e-14)


def test_the_family_does_not_depend_on_the_unit(tube_rig):
    np.testing.assert_allclose(tube_rig.scaled(1000.0).proportions.basis, 1000 * tube_rig.proportions.basis, atol=1e-9)


def test_other_proportions_open_no_seams():
    rig = build_rig(seamed(make_tube_data(), [60, 100], weight_change=0.004))
    assert len(rig.welded.vertices) == 242
    for person in (rig.subject(3, amount=2.0), rig.with_template(*with_random_proportions(rig, 0.2, np.random.default_rng(0)))):
        assert len(person.welded.vertices) == 242 and np.abs(person.vertices - rig.vertices).max() > 0.01
