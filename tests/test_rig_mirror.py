"""Mirror images: geometry reflected, angles and limits the same, sides renamed."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np import load_rig
from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.mirror import mirrored, other_side
from lbsfit_np.rig.shapes import ShapeSpace

S = {axis: np.where(np.arange(3) == k, -1.0, 1.0) for k, axis in enumerate("xyz")}


def turned_tube():
    """The small rig with frames that are nobody's axes."""
    data = make_tube_data()
    rng = np.random.default_rng(3)
    frames = np.linalg.qr(rng.standard_normal((4, 3, 3)))[0]
    frames *= np.linalg.det(frames)[:, None, None]
    shapes = ShapeSpace(
        names=("girth",),
        units=("",),
        lower=np.array([-1.0]),
        upper=np.array([1.0]),
        default=np.zeros(1),
        spread=np.array([0.5]),
        vertices=0.02 * rng.standard_normal((1, 242, 3)),
        joints=0.02 * rng.standard_normal((1, 4, 3)),
    )
    rest = np.linalg.qr(rng.standard_normal((4, 3, 3)))[0]
    rest *= np.linalg.det(rest)[:, None, None]
    return replace(data, frames=frames, shapes=shapes, smpl_rest=rest, poses={"wave left": rng.standard_normal((4, 3))})


@pytest.mark.parametrize("axis", "xyz")
def test_same_angles_give_the_mirrored_pose(axis):
    rig = build_rig(turned_tube())
    other = rig.mirrored(axis=axis)
    rng = np.random.default_rng(0)
    for _ in range(5):
        theta = rng.uniform(-2, 2, (4, 3))
        offsets = 0.01 * rng.standard_normal(rig.vertices.shape)
        np.testing.assert_allclose(other.pose(theta), rig.pose(theta) * S[axis], atol=1e-12)
        np.testing.assert_allclose(other.pose_joints(theta), rig.pose_joints(theta) * S[axis], atol=1e-12)
        changed = other.pose(theta, offsets=offsets * S[axis])  # joints follow: the regressor is mirrored, too
        np.testing.assert_allclose(changed, rig.pose(theta, offsets=offsets) * S[axis], atol=1e-12)


def test_hand_left_is_the_mirrored_hand():
    hand, left = load_rig("hand"), load_rig("hand-left")
    theta = np.random.default_rng(1).uniform(hand.lower, hand.upper)
    np.testing.assert_allclose(left.pose(theta), hand.pose(theta) * S["x"], atol=1e-14)
    assert left.name == "hand-left" and left.joint_names == hand.joint_names and left.parts == hand.parts
    assert np.array_equal(left.lower, hand.lower) and np.array_equal(left.upper, hand.upper)
    assert left.digest == hand.mirrored(name="hand-left").digest != hand.digest
    assert list(left.poses) == list(hand.poses) and np.array_equal(left.poses["ok"], hand.poses["ok"])
    assert np.array_equal(left.vertex_labels, hand.vertex_labels)
    assert left.notes == hand.notes


def test_skin_stays_outward_and_frames_right_handed():
    rig = build_rig(turned_tube()).mirrored()
    a, b, c = (rig.vertices[rig.faces[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0
    np.testing.assert_allclose(np.linalg.det(rig.frames), 1)
    np.testing.assert_allclose(rig.regressor @ rig.vertices, rig.joints, atol=1e-12)
    left = load_rig("hand").mirrored()
    for array in (left.vertices, left.joints, left.frames, left.smpl_rest):
        assert (array == 0).any() or array is left.vertices
        assert not np.signbit(array[array == 0]).any()


@pytest.mark.parametrize("axis", "xyz")
def test_twice_is_the_rig_itself(axis):
    rig = build_rig(turned_tube())
    again = rig.mirrored(axis=axis).mirrored(name=rig.name, axis=axis)
    assert again.digest == rig.digest and again.name == rig.name
    for field in ("vertices", "frames", "joints", "faces", "smpl_rest"):
        assert np.array_equal(getattr(again, field), getattr(rig, field)), field
    assert np.array_equal(again.shapes.vertices, rig.shapes.vertices) and list(again.poses) == ["wave left"]


def test_shape_directions_are_mirrored():
    rig = build_rig(turned_tube())
    a, b = rig.subject(0, amount=0, girth=1), rig.mirrored().subject(0, amount=0, girth=1)
    assert np.abs(a.vertices - rig.vertices).max() > 0.01
    np.testing.assert_allclose(b.vertices, a.vertices * S["x"], atol=1e-14)
    np.testing.assert_allclose(b.joints, a.joints * S["x"], atol=1e-14)


@pytest.mark.parametrize("axis", "xyz")
def test_mirrored_smpl_poses_belong_to_the_left_model(axis):
    """SMPL's left and right differ by a reflection across x: rotation vectors (x, −y, −z)."""
    rig = build_rig(turned_tube())
    theta = np.random.default_rng(4).uniform(-1, 1, (4, 3))
    ours, theirs = rig.to_smpl_pose(theta), rig.mirrored(axis=axis).to_smpl_pose(theta)
    np.testing.assert_allclose(theirs[1:], ours[1:] * [1, -1, -1], atol=1e-12)
    if axis == "x":
        np.testing.assert_allclose(theirs, ours * [1, -1, -1], atol=1e-12)


def test_directions_of_the_rig():
    rig = build_rig(turned_tube())
    assert (rig.mirrored().up, rig.mirrored().forward) == ("+y", "+z")
    assert (rig.mirrored(axis="y").up, rig.mirrored(axis="z").forward) == ("-y", "-z")
    assert build_rig(replace(turned_tube(), up=None, forward="-x")).mirrored().forward == "+x"


# ---- names ----


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("left_hip", "right_hip"),
        ("LeftUpLeg", "RightUpLeg"),
        ("mixamorig:RIGHT_hand", "mixamorig:LEFT_hand"),
        ("hand_l", "hand_r"),
        ("l_hand", "r_hand"),
        ("Hand.L", "Hand.R"),
        ("R", "L"),
        ("thumb1", "thumb1"),
        ("roll", "roll"),
        ("shoulder_lr", "shoulder_lr"),
        ("wave left, look right", "wave right, look left"),
    ],
)
def test_other_side(name, other):
    assert other_side(name) == other and other_side(other) == name


def test_sides_change_places_in_names():
    data = replace(turned_tube(), joint_names=["root", "elbow", "left_long", "right_short"], parts="sides_l")
    data.partitions = {"sides_l": {"left": ("root", "left_long"), "rest": ("elbow", "right_short")}}
    rig = build_rig(data).mirrored()
    assert rig.joint_names == ("root", "elbow", "right_long", "left_short")
    assert rig.partitions == {"sides_r": {"right": ("root", "right_long"), "rest": ("elbow", "left_short")}}
    assert rig.granularity == "sides_r" and rig.parts == ("right", "rest")
    assert list(rig.poses) == ["wave right"]
    assert rig.smpl_rest is None  # its rows are not in SMPL's order any more
    assert mirrored(data).parts == "sides_r" and mirrored(data).joint_names == list(rig.joint_names)


def test_notes_name_joints_as_they_are_then():
    notes = ["1 joint locked: left_long", "left_longer and left_long_1 are left out, 'right_short' is right"]
    data = replace(turned_tube(), joint_names=["root", "elbow", "left_long", "right_short"], partitions={}, notes=notes)
    other = ["1 joint locked: right_long", "left_longer and left_long_1 are left out, 'left_short' is right"]
    assert mirrored(data).notes == other and set(other) <= set(build_rig(data).mirrored().notes)


@pytest.mark.parametrize(("name", "new"), [("tube", "tube-mirrored"), ("Left hand", "Right hand")])
def test_default_name(name, new):
    assert build_rig(replace(make_tube_data(), name=name)).mirrored().name == new


def test_mirrored_rigs_take_cards():
    card = Card(merge=("pinky3",), partitions={"two": {"all": ("wrist",), "thumb": ("thumb1",)}}, use_parts="two")
    assert load_rig("hand-left", card=card).parts == ("all", "thumb")


@pytest.mark.parametrize("axis", ["w", 0, None, np.array(["x", "y"])])
def test_axis_is_one_of_three(tube_rig, axis):
    with pytest.raises(InputError, match="axis.*'x', 'y' or 'z'"):
        tube_rig.mirrored(axis=axis)
