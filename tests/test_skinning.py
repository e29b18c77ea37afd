"""M(Θ, U) and its adjoint, against a slow reference and against finite differences."""

import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lbsfit_np
from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.rotations import rotvec_from_matrix
from lbsfit_np.skinning import skin, skin_adjoint

CARDS = Path(lbsfit_np.__file__).parent / "bench" / "cards"
REAL = {
    "hand": ("webxr_hand/left.glb", "webxr_left", {}),
    "cmu": ("mpfb2_body/mpfb2_cmu_mb.npz", "mpfb2_cmu_mb", {}),
    "mixamo": ("mpfb2_body/mpfb2_mixamo.npz", "mpfb2_mixamo", {"normalize_weights": True}),
    "default": ("mpfb2_body/mpfb2_default.npz", "mpfb2_default", {}),
    "fox": ("fox/Fox.glb", "fox", {}),
}
_loaded = {}


@pytest.fixture
def get_rig(request):
    def get(name):
        if name == "tube":
            return request.getfixturevalue("tube_rig")
        if name not in _loaded:
            file, card, options = REAL[name]
            _loaded[name] = load_rig(request.getfixturevalue("shared_rigs") / file, card=CARDS / f"{card}.toml", **options)
        return _loaded[name]

    return get


def _pose(rig, seed, far=False):
    """A pose within the limits; with ``far`` every joint turns anyhow, about every axis."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-2.5, 2.5, rig.lower.shape) if far else rig.lower + rng.random(rig.lower.shape) * (rig.upper - rig.lower)
    theta[rig.root] = rng.uniform(-2, 2, 3)
    return theta


# ---- values ----


@pytest.mark.parametrize("name", ["tube", *REAL])
def test_rest_pose_is_the_template_bit_for_bit(get_rig, name):
    for rig in (get_rig(name), get_rig(name).welded):
        theta = np.zeros_like(rig.joints)
        for joints in ("follow", "fixed"):
            assert (rig.pose(theta, joints=joints) == rig.vertices).all()
            assert (rig.pose_joints(theta, joints=joints) == rig.joints).all()
            assert (rig.pose(-theta, joints=joints) == rig.vertices).all()
        assert (rig.pose(theta, np.zeros(3), 1.0, np.zeros_like(rig.vertices)) == rig.vertices).all()


def _slow(rig, theta, translation, scale, offsets, joints):
    """Explicit 4 × 4 matrices down each vertex's chains, dense weights, loops."""
    weights = rig.weights.toarray()
    U = rig.vertices + offsets
    J = rig.joints + (rig.regressor.toarray() @ offsets if joints == "follow" else 0.0)
    world, bind = {}, {}
    todo = [rig.root]
    while todo:
        j = todo.pop()
        p = int(rig.parents[j])
        local, rest = np.eye(4), np.eye(4)
        local[:3, :3] = rig.frames[j] @ Rotation.from_rotvec(theta[j]).as_matrix() @ rig.frames[j].T
        local[:3, 3] = rest[:3, 3] = J[j] - (J[p] if p >= 0 else 0.0)
        world[j] = local if p < 0 else world[p] @ local
        bind[j] = rest if p < 0 else bind[p] @ rest
        todo += [int(c) for c in np.flatnonzero(rig.parents == j)]
    V = np.zeros_like(U)
    for i in range(len(U)):
        M = np.zeros((4, 4))
        for j in np.flatnonzero(weights[i]):
            M += weights[i, j] * (world[j] @ np.linalg.inv(bind[j]))
        V[i] = (M @ np.append(U[i], 1.0))[:3]
    P = np.array([world[j][:3, 3] for j in range(len(J))])
    return scale * V + translation, scale * P + translation


@pytest.mark.parametrize("name, rows", [("tube", None), ("hand", None), ("fox", None)])
@pytest.mark.parametrize("joints", ["follow", "fixed"])
@pytest.mark.parametrize("far", [False, True])
def test_against_explicit_chains_of_matrices(get_rig, name, rows, joints, far):
    rig = get_rig(name).welded
    rng = np.random.default_rng(1)
    offsets = 0.02 * rig.size * rng.standard_normal(rig.vertices.shape)
    theta, t, s = _pose(rig, 5, far), rig.size * np.array([0.3, -0.2, 1.0]), 1.3
    V, P = _slow(rig, theta, t, s, offsets, joints)
    np.testing.assert_allclose(rig.pose(theta, t, s, offsets, joints=joints), V, atol=1e-12 * rig.size)
    np.testing.assert_allclose(rig.pose_joints(theta, t, s, offsets, joints=joints), P, atol=1e-12 * rig.size)


@pytest.mark.parametrize("name", ["tube", "hand"])
def test_scale_and_translation_apply_last(get_rig, name):
    rig = get_rig(name)
    theta, t, s = _pose(rig, 2), np.array([3.0, -1.0, 0.5]), 0.7
    assert (rig.pose(theta, t, s) == s * rig.pose(theta) + t).all()
    assert (rig.pose_joints(theta, t, s) == s * rig.pose_joints(theta) + t).all()


@pytest.mark.parametrize("name", ["tube", "hand"])
def test_another_unit_is_the_same_pose(get_rig, name):
    rig = get_rig(name)
    theta = _pose(rig, 3)
    offsets = 0.01 * rig.size * np.random.default_rng(0).standard_normal(rig.vertices.shape)
    in_mm = rig.scaled(1000.0)
    np.testing.assert_allclose(
        in_mm.pose(theta, offsets=1000 * offsets), 1000 * rig.pose(theta, offsets=offsets), rtol=0, atol=1e-11 * in_mm.size
    )


@pytest.mark.parametrize("name", ["tube", "hand", "cmu"])
def test_the_root_turns_everything_rigidly(get_rig, name):
    rig = get_rig(name)
    theta = _pose(rig, 4)
    theta[rig.root] = 0.0
    V, P = rig.pose(theta), rig.pose_joints(theta)
    omega = np.array([0.9, -2.0, 0.4])
    turned = theta.copy()
    turned[rig.root] = rig.frames[rig.root].T @ omega
    R, c = Rotation.from_rotvec(omega).as_matrix(), rig.joints[rig.root]
    np.testing.assert_allclose(rig.pose(turned), (V - c) @ R.T + c, atol=1e-13 * rig.size)
    np.testing.assert_allclose(rig.pose_joints(turned), (P - c) @ R.T + c, atol=1e-13 * rig.size)


def test_angles_turn_about_the_joints_own_axes(get_rig):
    """θ_j is a rotation vector in the rest frame: turning a joint with all its descendants at rest turns them about F θ."""
    rig = get_rig("hand")
    j = rig.joint_names.index("index-finger-phalanx-proximal")
    theta = np.zeros_like(rig.joints)
    theta[j] = [-0.7, 0.0, 0.0]
    R = Rotation.from_rotvec(-0.7 * rig.frames[j][:, 0]).as_matrix()
    below = [rig.joint_names.index(f"index-finger-{n}") for n in ("phalanx-intermediate", "phalanx-distal", "tip")]
    moved = rig.pose_joints(theta)
    np.testing.assert_allclose(moved[below], (rig.joints[below] - rig.joints[j]) @ R.T + rig.joints[j], atol=1e-14)
    others = [k for k in range(len(moved)) if k not in below]
    np.testing.assert_allclose(moved[others], rig.joints[others], atol=1e-15)


@pytest.mark.parametrize("name", ["tube", "hand", "fox"])
def test_joints_follow_a_scaled_template_exactly(get_rig, name):
    rig = get_rig(name)
    theta, f = _pose(rig, 6), 1.13
    offsets = (f - 1) * rig.vertices
    tolerance = 1e-11 * rig.size
    np.testing.assert_allclose(rig.pose(theta, offsets=offsets), f * rig.pose(theta), atol=tolerance)
    np.testing.assert_allclose(rig.pose_joints(theta, offsets=offsets), f * rig.pose_joints(theta), atol=tolerance)
    assert np.abs(rig.pose_joints(theta, offsets=offsets, joints="fixed") - rig.pose_joints(theta)).max() == 0
    assert np.abs(rig.pose(theta, offsets=offsets, joints="fixed") - f * rig.pose(theta)).max() > 1e-3 * rig.size


def test_locked_and_merged_joints_ride_along(get_rig):
    rig = get_rig("hand")
    assert rig.merged.any()
    theta = np.zeros_like(rig.joints)
    assert rig.weights[:, np.flatnonzero(rig.merged)].nnz == 0
    leaves = rig.merged & ~np.isin(np.arange(len(rig.parents)), rig.parents)
    theta[leaves] = 0.5  # turning them moves no vertex: their weights stand in their parents' columns
    np.testing.assert_allclose(rig.pose(theta), rig.vertices, atol=1e-15)


def test_a_template_of_its_own_is_offsets(tube_rig):
    offsets = 0.03 * np.random.default_rng(2).standard_normal(tube_rig.vertices.shape)
    theta = _pose(tube_rig, 8)
    changed = tube_rig.with_template(tube_rig.vertices + offsets)
    np.testing.assert_allclose(changed.pose(theta), tube_rig.pose(theta, offsets=offsets), atol=1e-14)


# ---- gradients ----


def _objective(rig, joints, known_joints, seed=0):
    """A linear function of posed vertices and joints, so that finite differences have no more to lose than skinning itself.

    Arguments and gradients are one flat vector: Θ, translation, scale, offsets and, where they are known, joint offsets.
    """
    rng = np.random.default_rng(seed)
    g, h = rng.standard_normal(rig.vertices.shape), rng.standard_normal(rig.joints.shape)
    J, m = len(rig.joints), len(rig.vertices)
    cuts = np.cumsum([3 * J, 3, 1, 3 * m])

    def arguments(x):
        theta, t, s, offsets, moved = np.split(x, cuts)
        given = {"joint_offsets": moved.reshape(J, 3)} if known_joints else {}
        return theta.reshape(J, 3), {"translation": t, "scale": s[0], "offsets": offsets.reshape(m, 3), "joints": joints, **given}

    def value(x):
        theta, given = arguments(x)
        posed = skin(rig, theta, **given)
        return np.vdot(g, posed.vertices) + np.vdot(h, posed.joints)

    def gradient(x):
        theta, given = arguments(x)
        d = skin_adjoint(skin(rig, theta, **given), g, h)
        parts = [d.theta.ravel(), d.translation, [d.scale], d.offsets.ravel()]
        if known_joints:
            parts.append(d.rest_joints.ravel())
        return np.concatenate(parts)

    return value, gradient


def _at(rig, seed, far, known_joints):
    rng = np.random.default_rng(seed)
    offsets = 0.03 * rig.size * rng.standard_normal(rig.vertices.shape)
    x = [_pose(rig, seed, far).ravel(), [0.2, -0.4, 0.1], [1.2], offsets.ravel()]
    if known_joints:
        x.append(0.02 * rig.size * rng.standard_normal(rig.joints.size))
    return np.concatenate(x)


def _difference(value, x, step):
    """Central difference of fourth order along ``step``."""
    return (8 * (value(x + step) - value(x - step)) - (value(x + 2 * step) - value(x - 2 * step))) / 12


@pytest.mark.parametrize("mode", ["follow", "fixed", "known"])
@pytest.mark.parametrize("far", [False, True])
def test_the_whole_gradient_on_the_tube(tube_rig, mode, far):
    known = mode == "known"
    value, gradient = _objective(tube_rig, "follow" if known else mode, known)
    x = _at(tube_rig, 11, far, known)
    h = 1e-4
    found = np.array([_difference(value, x, h * e) / h for e in np.eye(len(x))])
    expected = gradient(x)
    J, m = len(tube_rig.joints), len(tube_rig.vertices)
    for block in np.split(np.arange(len(x)), np.cumsum([3 * J, 3, 1, 3 * m])):
        if len(block):
            error = np.abs(found[block] - expected[block]).max()
            assert error <= 1e-6 * np.abs(expected[block]).max(), (block[0], error)


@pytest.mark.parametrize("name", ["hand", "fox"])
@pytest.mark.parametrize("mode", ["follow", "fixed", "known"])
def test_gradients_of_real_rigs(get_rig, name, mode):
    """All angles, translation and scale one by one; the thousands of offsets along random directions."""
    rig, known = get_rig(name), mode == "known"
    value, gradient = _objective(rig, "follow" if known else mode, known)
    x = _at(rig, 12, False, known)
    expected = gradient(x)
    few = 3 * len(rig.joints) + 4
    h = 1e-4
    found = np.array([_difference(value, x, h * np.eye(1, len(x), k).ravel()) / h for k in range(few)])
    for block in (slice(0, few - 4), slice(few - 4, few - 1), slice(few - 1, few)):
        assert np.abs(found[block] - expected[block]).max() <= 1e-6 * np.abs(expected[block]).max()
    rng = np.random.default_rng(5)
    for _ in range(40):
        d = np.zeros(len(x))
        d[few:] = rng.standard_normal(len(x) - few) * rig.size
        slope = _difference(value, x, h * d) / h
        assert abs(slope - expected @ d) <= 1e-6 * np.linalg.norm(expected[few:]) * rig.size


@pytest.mark.parametrize("angle", [0.0, 1e-7, np.pi - 1e-4, np.pi, 2 * np.pi - 0.3])
def test_gradient_at_the_angles_where_formulas_break(tube_rig, angle):
    value, gradient = _objective(tube_rig, "follow", False)
    x = _at(tube_rig, 13, False, False)
    axis = np.array([0.48, 0.6, -0.64])
    x[: 3 * len(tube_rig.joints)] = np.tile(angle * axis, len(tube_rig.joints))
    expected = gradient(x)[: 3 * len(tube_rig.joints)]
    h = 1e-4
    found = [_difference(value, x, h * np.eye(1, len(x), k).ravel()) / h for k in range(len(expected))]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_gradient_without_a_look_at_the_joints(tube_rig):
    x = _pose(tube_rig, 14)
    posed = skin(tube_rig, x)
    g = np.random.default_rng(1).standard_normal(tube_rig.vertices.shape)
    alone, with_zeros = skin_adjoint(posed, g), skin_adjoint(posed, g, np.zeros_like(tube_rig.joints))
    np.testing.assert_array_equal(skin_adjoint(posed, g.tolist()).theta, alone.theta)
    with pytest.raises(InputError, match=r"grad_vertices: got shape \(1, 242, 3\); expected shape \(242, 3\)"):
        skin_adjoint(posed, g[None])
    for name in ("theta", "translation", "scale", "vertices", "rest_joints", "offsets"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(with_zeros, name))


def test_skinning_leaves_its_arguments_alone(tube_rig):
    theta, offsets, g = _pose(tube_rig, 15), np.full(tube_rig.vertices.shape, 0.01), np.ones(tube_rig.vertices.shape)
    kept = theta.copy(), offsets.copy(), g.copy()
    skin_adjoint(skin(tube_rig, theta, offsets=offsets, scale=1.1), g, np.ones(tube_rig.joints.shape))
    for a, b in zip((theta, offsets, g), kept):
        np.testing.assert_array_equal(a, b)


# ---- the checked door ----


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"theta": np.zeros((3, 3))}, ["theta", "(3, 3)", "(4, 3)"]),
        ({"theta": np.full((4, 3), np.nan)}, ["theta", "12 values", "NaN"]),
        ({"theta": "rest"}, ["theta", "str", "numbers"]),
        ({"theta": np.full((4, 3), -1e160)}, ["theta: got an angle of 1e+160", "radians, of at most 1e+06"]),
        ({"translation": [0.0, 1.0]}, ["translation", "(2,)", "(3,)"]),
        ({"translation": [0.0, 1.0, np.inf]}, ["translation", "infinite"]),
        ({"offsets": np.zeros((5, 3))}, ["offsets", "(5, 3)", "(242, 3)"]),
        ({"scale": 0.0}, ["scale", "positive"]),
        ({"scale": -1.0}, ["scale", "-1.0", "positive"]),
        ({"scale": np.nan}, ["scale", "nan", "positive"]),
        ({"scale": "2"}, ["scale", "'2'", "positive"]),
        ({"scale": [1.0, 2.0]}, ["scale", "positive"]),
        pytest.param({"scale": 10**400}, ["scale: got 1000", "positive"], id="beyond double precision"),
        pytest.param({"scale": 10**5000}, ["scale: got a number of several thousand digits", "positive"], id="beyond words"),
        ({"joints": "loose"}, ["joints", "'loose'", "'follow'", "'fixed'"]),
    ],
)
@pytest.mark.parametrize("method", ["pose", "pose_joints"])
def test_bad_arguments_are_named(tube_rig, method, arguments, words):
    with pytest.raises(InputError) as error:
        getattr(tube_rig, method)(**{"theta": np.zeros((4, 3)), **arguments})
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("joints", ["Follow", None, "array"])
def test_what_are_no_modes_of_joints_do_not_pass_for_fixed_ones(joints, tube_rig):
    joints = tube_rig.joints if joints == "array" else joints
    with pytest.raises(InputError, match="joints: got .*; expected 'follow' or 'fixed'. Give rest positions of your own as j"):
        skin(tube_rig, np.zeros((4, 3)), joints=joints)


def test_vertices_are_floats_whatever_the_scale_is(tube_rig):
    half = tube_rig.pose(np.zeros((4, 3)), scale=Fraction(1, 2))
    assert half.dtype == float
    np.testing.assert_array_equal(half, tube_rig.vertices / 2)


def test_bad_templates_are_named(tube_rig):
    with pytest.raises(InputError, match=r"vertices: got shape \(3, 3\); expected shape \(242, 3\)"):
        tube_rig.with_template(np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"joints: got shape \(3, 3\)"):
        tube_rig.with_template(tube_rig.vertices, np.zeros((3, 3)))
    with pytest.raises(InputError, match="'hands'.*joints, arm and fingers"):
        tube_rig.with_parts("hands")


def test_a_pose_found_from_matrices_poses_the_same(tube_rig):
    theta = _pose(tube_rig, 20, far=True)
    again = rotvec_from_matrix(Rotation.from_rotvec(theta).as_matrix())
    np.testing.assert_allclose(tube_rig.pose(again), tube_rig.pose(theta), atol=1e-14)


def test_angles_of_more_turns_than_a_body_makes_are_asked_about(tube_rig):
    theta = np.zeros((4, 3))
    theta[1, 0] = 90.0
    for call in (tube_rig.pose, tube_rig.pose_joints, lambda t: lbsfit_np.synthesize(tube_rig, 1, poses=t[None], random_state=0)):
        with pytest.warns(UserWarning, match="got an angle of 90 rad, which is 14 turns. Are these degrees?"):
            call(theta)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tube_rig.pose(theta / 2)
