"""Poses in SMPL's convention: round trips, and joint positions by a forward kinematics that knows nothing of this package."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_rigs import make_tube_data

from lbsfit_np import bundled_rigs, load_rig
from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig


def tube_with_rest():
    rng = np.random.default_rng(5)
    rest, frames = (Rotation.from_rotvec(rng.normal(size=(4, 3))).as_matrix() for _ in range(2))
    return build_rig(replace(make_tube_data(), smpl_rest=rest, frames=frames))


RIGS = {"tube": tube_with_rest} | {name: lambda name=name: load_rig(name) for name in bundled_rigs()}


@pytest.fixture(scope="module", params=RIGS)
def rig(request):
    return RIGS[request.param]()


def poses(rig):
    rng = np.random.default_rng(0)
    drawn = [rng.uniform(rig.lower, rig.upper) for _ in range(5)]
    return [np.zeros(rig.lower.shape), *drawn, *list(rig.poses.values())[:5]]


def test_round_trip(rig):
    for theta in poses(rig):
        pose = rig.to_smpl_pose(theta)
        assert pose.shape == theta.shape
        np.testing.assert_allclose(rig.from_smpl_pose(pose), theta, atol=1e-9)
        assert np.array_equal(rig.from_smpl_pose(pose.ravel()), rig.from_smpl_pose(pose))


def smpl_joints(rest_joints, parents, pose):
    """Joint positions as SMPL has them: frames parallel to the world's in the rest pose, each turned about its parent's."""
    J = len(parents)
    world, at = [None] * J, [None] * J
    for j in np.argsort([_depth(parents, j) for j in range(J)], kind="stable"):
        p = parents[j]
        local = Rotation.from_rotvec(pose[j]).as_matrix()
        if p < 0:
            world[j], at[j] = local, rest_joints[j]
        else:
            world[j] = world[p] @ local
            at[j] = at[p] + world[p] @ (rest_joints[j] - rest_joints[p])
    return np.array(at)


def _depth(parents, j):
    return 0 if parents[j] < 0 else 1 + _depth(parents, parents[j])


def smpl_rest_joints(rig):
    """The rig's skeleton put into SMPL's rest pose: each bone turned as the segment that it belongs to."""
    at = np.array(rig.joints)
    for level, up in rig.levels:
        for c, p in zip(level, up):
            at[c] = at[p] + rig.smpl_rest[p] @ (rig.joints[c] - rig.joints[p])
    return at


def test_joints_are_where_smpl_would_have_them(rig):
    rest = smpl_rest_joints(rig)
    for theta in poses(rig):
        expected = smpl_joints(rest, rig.parents, rig.to_smpl_pose(theta))
        np.testing.assert_allclose(rig.pose_joints(theta), expected, atol=1e-12 * rig.size)


def test_zero_pose_is_their_rest_pose(rig):
    joints = rig.pose_joints(rig.from_smpl_pose(np.zeros(rig.lower.shape)))
    np.testing.assert_allclose(joints, smpl_rest_joints(rig), atol=1e-12 * rig.size)


@pytest.mark.parametrize(("name", "side"), [("hand", 1), ("hand-left", -1)])
def test_hand_rests_as_mano_does(name, side):
    """Right: fingers along −x, palm down, thumb towards +z. The left hand is its mirror image across x."""
    hand = load_rig(name)
    theta = hand.from_smpl_pose(np.zeros(48))
    joints = dict(zip(hand.joint_names, hand.pose_joints(theta)))
    fingers = joints["middle3"] - joints["wrist"]
    assert fingers[0] * side / np.linalg.norm(fingers) < -0.99
    across = joints["thumb3"] - joints["pinky3"]
    assert across[2] > 0.05
    bend = np.array(theta)  # on from there, fingers bend towards the palm
    for finger in ("index1", "middle1", "ring1", "pinky1"):
        bend[hand.joint_names.index(finger), 0] += 0.5
    assert hand.pose_joints(bend)[hand.joint_names.index("middle3"), 1] - joints["middle3"][1] < -0.02


def test_a_turn_of_the_whole_is_the_first_row():
    hand = load_rig("hand")
    theta = np.zeros((16, 3))
    theta[0] = hand.frames[0].T @ [0, 0.4, 0]  # about the world's up axis
    rest, turned = hand.to_smpl_pose(np.zeros((16, 3))), hand.to_smpl_pose(theta)
    np.testing.assert_allclose(turned[1:], rest[1:], atol=1e-12)
    step = Rotation.from_rotvec(turned[0]) * Rotation.from_rotvec(rest[0]).inv()
    np.testing.assert_allclose(step.as_rotvec(), [0, 0.4, 0], atol=1e-12)


def test_poses_beyond_the_limits_are_not_clipped():
    hand = load_rig("hand")
    theta = np.zeros((16, 3))
    theta[2, 0] = 2.5
    np.testing.assert_allclose(hand.from_smpl_pose(hand.to_smpl_pose(theta)), theta, atol=1e-9)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.zeros((15, 3)), r"pose: got shape \(15, 3\); expected shape \(16, 3\) or \(48,\)"),
        (np.zeros(72), r"pose: got shape \(72,\)"),
        (np.full(48, np.nan), "pose: got 48 values that are NaN"),
        (np.full(48, 1e160), "pose: got an angle of 1e\\+160"),
        ("flat", r"pose: got shape \(\)"),
    ],
)
def test_bad_poses(pose, words):
    with pytest.raises(InputError, match=words):
        load_rig("hand").from_smpl_pose(pose)
    with pytest.raises(InputError, match=r"theta"):
        load_rig("hand").to_smpl_pose(np.zeros(48))
    with pytest.raises(InputError, match=r"theta: got an angle of 1e\+160"):
        load_rig("hand").to_smpl_pose(np.full((16, 3), 1e160))


def test_rigs_without_the_relation_say_which_have_it(tube_rig):
    for convert in (tube_rig.to_smpl_pose, tube_rig.from_smpl_pose):
        with pytest.raises(InputError, match="'tube'.*smpl_rest.*bundled rigs body, hand and hand-left"):
            convert(np.zeros((4, 3)))
