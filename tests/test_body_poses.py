"""The body's pose library: natural poses within the limits, mirrored where that is another pose, hands that rest on the skin."""

import numpy as np
import pytest
from rebuilt_rigs import rig_module
from scipy.spatial import cKDTree

from lbsfit_np.io.rigs import load_rig

body_poses, body_skeleton = map(rig_module, ("body_poses", "body_skeleton"))
JOINTS = body_skeleton.JOINT_NAMES
SIDES = (("left", "right"), ("right", "left"))
TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
STANDING = ("standing", "standing, feet apart", "contrapposto", "t-pose", "arms folded", "bowing", "crouching", "side lunge")


@pytest.fixture(scope="module")
def body():
    return load_rig("body")


@pytest.fixture(scope="module")
def library():
    names, theta = body_poses.pose_library(JOINTS)
    return dict(zip(names, theta))


def _angles(name):
    return body_poses.pose_angles(body_poses.POSES[name], JOINTS)


def _led(rig, *joints):
    """Vertices whose largest weight is on one of these joints."""
    return np.isin(rig.weights.toarray().argmax(axis=1), [rig.joint_names.index(j) for j in joints])


def _limb(side, *limbs):
    return [f"{side}_{limb}" for limb in limbs]


def _depth(rig, vertices, inner, outer):
    """How far the vertices ``inner`` are below the skin made by ``outer``, metres.

    Vertices that are far from ``outer`` say nothing about it: their nearest vertex lies on the rim where it was cut.
    """
    faces = rig.faces
    across = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    distance, nearest = cKDTree(vertices[outer]).query(vertices[inner])
    below = np.einsum("ij,ij->i", vertices[inner] - vertices[outer][nearest], normals[outer][nearest]) < 0
    return np.where(below & (distance < 0.06), distance, 0).max()


def test_library_is_large_and_its_names_are_unique(library):
    names, theta = body_poses.pose_library(list(JOINTS))
    assert len(body_poses.POSES) >= 50 and len(names) == len(set(names)) == len(theta) == len(library)
    assert theta.shape[1:] == (24, 3)
    wanted = {"standing", "walking", "arms overhead", "one leg up", "lunge", "hands on the hips", "arms folded", "turned torso"}
    assert wanted <= set(names)


def test_poses_are_within_the_limits(library):
    lower, upper = body_skeleton.limits()
    for name, theta in library.items():
        outside = np.argwhere((theta < lower - 1e-9) | (theta > upper + 1e-9))
        assert not len(outside), f"{name}: {[(JOINTS[j], 'xyz'[a], round(np.degrees(theta[j, a]))) for j, a in outside]}"


def test_poses_are_within_the_limits_of_the_rig_and_in_its_order(body, library):
    assert tuple(body.joint_names) == JOINTS
    for theta in library.values():
        assert np.all(theta >= body.lower - 1e-6) and np.all(theta <= body.upper + 1e-6)


def test_poses_differ_from_each_other_and_from_rest(library):
    theta = np.degrees([np.zeros((24, 3)), *library.values()])
    apart = np.abs(theta[:, None] - theta[None]).max(axis=(2, 3)) + 1e3 * np.eye(len(theta))
    assert apart.min() >= 12


def test_every_name_in_the_poses_is_a_joint():
    with pytest.raises(ValueError, match="left_wing"):
        body_poses.pose_angles({"left_wing": (1, 2, 3)}, list(JOINTS))
    theta = body_poses.pose_angles({"knee": 30, "left_hip": (1, 2, 3), "head": (0, 9, 0)}, JOINTS)
    rows = {name: np.degrees(theta[JOINTS.index(name)]) for name in ("left_knee", "right_knee", "left_hip", "right_hip", "head")}
    assert [rows[k].round(9).tolist() for k in rows] == [[30, 0, 0], [30, 0, 0], [1, 2, 3], [0, 0, 0], [0, 9, 0]]


def test_mirrored_pose_is_the_mirror_image(body, library):
    other = [JOINTS.index(n.replace("left", "L").replace("right", "left").replace("L", "right")) for n in JOINTS]
    for theta in library.values():
        twin = body_poses.mirrored_pose(theta, JOINTS)
        assert np.array_equal(body_poses.mirrored_pose(twin, JOINTS), theta)
        assert body.pose_joints(twin)[other] == pytest.approx(body.pose_joints(theta) * [-1, 1, 1], abs=1e-6)


def test_asymmetric_poses_have_a_twin(library):
    twins = [name for name in library if name.endswith(" (mirrored)")]
    assert len(twins) >= 20 and "t-pose (mirrored)" not in library and "looking left (mirrored)" not in library
    for name in twins:
        assert np.array_equal(library[name], body_poses.mirrored_pose(library[name.removesuffix(" (mirrored)")], JOINTS))


@pytest.mark.parametrize("pose", body_poses.POSES)
def test_hands_do_not_sink_into_the_body(body, pose):
    """No deeper than skin gives: 2 cm into trunk and legs, 3 cm into the other arm."""
    vertices = body.pose(_angles(pose))
    legs = _limb("left", "hip", "knee") + _limb("right", "hip", "knee")
    for side, other in SIDES:
        hand = _led(body, *_limb(side, "wrist", "hand"))
        assert _depth(body, vertices, hand, _led(body, *TRUNK, *legs)) < 0.020
        assert _depth(body, vertices, hand, _led(body, *_limb(other, "shoulder", "elbow", "wrist", "hand"))) < 0.030


@pytest.mark.parametrize("pose", body_poses.POSES)
def test_legs_do_not_pass_through_each_other(body, pose):
    vertices = body.pose(_angles(pose))
    for side, other in SIDES:
        lower_leg = _led(body, *_limb(side, "knee", "ankle", "foot"))
        assert _depth(body, vertices, lower_leg, _led(body, *_limb(other, "hip", "knee", "ankle", "foot"))) < 0.020


@pytest.mark.parametrize("pose", STANDING)
def test_planted_feet_share_a_floor_and_point_forward(body, pose):
    theta = _angles(pose)
    vertices, joints = body.pose(theta), body.pose_joints(theta)
    soles = [vertices[_led(body, *_limb(side, "ankle", "foot"))][:, 1].min() for side, _ in SIDES]
    assert abs(soles[0] - soles[1]) < 0.015
    for side, _ in SIDES:
        foot, ankle = (joints[JOINTS.index(f"{side}_{limb}")] for limb in ("foot", "ankle"))
        assert foot[2] - ankle[2] > 0.08


@pytest.mark.parametrize(
    ("pose", "hand", "at"),
    [
        ("sitting, hands on the thighs", "left", "left_hip"),
        ("kneeling, sitting on the heels", "right", "right_hip"),
        ("kneeling on one knee", "left", "left_hip"),
        ("hands on the hips", "right", "pelvis"),
        ("arms folded", "right", "left_shoulder"),
        ("hands behind the head", "left", "head"),
        ("hands clasped in front", "left", "right_hand"),
        ("praying hands", "left", "right_hand"),
        ("phone to the ear", "right", "head"),
        ("hand on the chin", "right", "head"),
        ("drinking", "right", "head"),
        ("yoga tree", "left", "right_hand"),
    ],
)
def test_hands_that_touch_do(body, pose, hand, at):
    vertices = body.pose(_angles(pose))
    touching, touched = vertices[_led(body, *_limb(hand, "wrist", "hand"))], vertices[_led(body, at)]
    assert cKDTree(touched).query(touching)[0].min() < (0.06 if pose == "drinking" else 0.025)  # room for a cup
