"""Joint frames and limits of a rig: from the file, the card, bones and animations, or by default."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.frames import bone_frames
from lbsfit_np.rig.limits import derived_limits
from lbsfit_np.rotations import matrix_from_rotvec

# ---- frames ----


def test_rounded_frames_become_rotations():
    turn = matrix_from_rotvec(np.array([0.3, -0.2, 0.9])).astype(np.float32).astype(float)
    rig = build_rig(replace(make_tube_data(), frames=np.tile(turn, (4, 1, 1))))
    np.testing.assert_allclose(rig.frames[0].T @ rig.frames[0], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rig.frames[0], turn, atol=1e-6)


def test_card_frames_follow_bones():
    rig = build_rig(make_tube_data(), Card(frames=(("*", "bone"), ("root", "rig"))))
    np.testing.assert_array_equal(rig.frames[0], np.eye(3))
    to_knuckles = rig.joints[[2, 3]].mean(axis=0) - rig.joints[1]
    np.testing.assert_allclose(rig.frames[1, :, 1], to_knuckles / np.linalg.norm(to_knuckles), atol=1e-12)
    assert rig.frames[1, 2, 2] > 0.9  # z towards the front
    np.testing.assert_allclose(np.linalg.det(rig.frames), 1.0)
    with pytest.raises(InputError, match="'bone'.*no up and forward"):
        build_rig(replace(make_tube_data(), forward=None), Card(frames=(("*", "bone"),)))


def test_bone_frames_point_up_for_feet_and_mirror_left_and_right():
    foot, left, right = bone_frames([[0.1, -0.3, 1.2], [0.7, -0.7, 0.2], [-0.7, -0.7, 0.2]], "+y", "+z")
    assert foot[1, 2] > 0.9  # z up
    mirror = np.diag([-1.0, 1.0, 1.0])
    for angles in np.eye(3):
        there = matrix_from_rotvec(left @ angles)
        here = matrix_from_rotvec(right @ (angles * [1, -1, -1]))
        np.testing.assert_allclose(mirror @ there @ mirror, here, atol=1e-12)
    turned = bone_frames([[0.1, 1.2, 0.3]], "+z", "+y")[0]  # z up, facing y: a bone that points forward
    assert turned[2, 2] > 0.9


def test_changed_frames_carry_animations_over_and_drop_the_files_limits():
    data = make_tube_data()
    wide = np.zeros((3, 4, 3))
    wide[1, 1] = [0.5, 0.0, 0.0]
    turn = matrix_from_rotvec(np.array([0.0, 0.0, np.pi / 2]))
    turned = replace(data, lower=None, upper=None, animated=wide, frames=np.tile(turn, (4, 1, 1)))
    rig = build_rig(turned, Card(frames=(("*", "rig"),)))
    # about the file's x axis, which is the rig's y
    np.testing.assert_allclose(rig.upper[1], [0.1, 0.625, 0.1], atol=1e-12)
    limited = build_rig(replace(data, frames=np.tile(turn, (4, 1, 1))), Card(frames=(("long", "rig"),)))
    np.testing.assert_array_equal(limited.upper[2], [0.8, 0.8, 0.8])
    np.testing.assert_array_equal(limited.upper[3], data.upper[3])
    told = "neither file nor card has limits for 1 of 4 moving joints with the parent or axes that the card gives; they were"
    assert any(note.startswith(told) for note in limited.notes)
    assert not any("that the card gives" in note for note in rig.notes)  # the file has none
    assert any("1 of 4 moving joints" in note for note in limited.notes)


def test_another_parent_makes_other_limits():
    """Those of the file are relative to the file's parent; where it names none, they are for whichever the card gives."""
    data = make_tube_data()
    j = data.joint_names.index("short")
    assert data.parents[j] > 0
    rig = build_rig(data, Card(parents=(("short", "root"),)))
    np.testing.assert_array_equal(rig.upper[j], 0.8)
    np.testing.assert_array_equal(np.delete(rig.upper, j, axis=0), np.delete(data.upper, j, axis=0))
    assert any("limits for 1 of 4 moving joints" in note and "short" in note for note in rig.notes)
    names = data.joint_names
    card = Card(parents=tuple((names[k], names[p]) for k, p in enumerate(data.parents) if p >= 0))
    rig = build_rig(replace(data, parents=np.full(4, -1)), card)
    np.testing.assert_array_equal(rig.upper, data.upper)


# ---- limits that are missing ----


def test_missing_limits_get_defaults_and_a_note():
    rig = build_rig(replace(make_tube_data(), lower=None, upper=None))
    np.testing.assert_array_equal(rig.upper[1:], 0.8)
    np.testing.assert_array_equal(rig.lower[0], -0.6)
    assert any("4 of 4 moving joints" in note and "±0.8" in note and "±0.6" in note for note in rig.notes)


def test_limits_from_animations():
    animated = np.zeros((5, 3, 3))
    animated[:, 1, 0] = [0.2, 0.4, 1.0, 0.6, 0.2]
    animated[:, 2, 2] = [-3.0, 0, 0, 0, 0]
    animated[:, 0, 1] = [0, 1, 2, 3, 3]  # the root walks in a circle: no matter
    lower, upper, seen = derived_limits(0, 3, animated)
    np.testing.assert_array_equal(seen, [False, True, True])
    np.testing.assert_allclose(upper[1], [1.0 + 0.25 * 0.8, 0.1, 0.1])
    np.testing.assert_allclose(lower[1], [0.0, -0.1, -0.1])  # 0.2 - 0.2 would be 0 as well: the rest pose is inside
    np.testing.assert_allclose(lower[2], [-0.1, -0.1, -np.pi])
    np.testing.assert_array_equal(upper[0], 0.6)
    animated[:, 1] = [0.4, 0.0, 0.0]  # turned, but the same in all frames
    assert not derived_limits(0, 3, animated)[2][1]
    np.testing.assert_array_equal(derived_limits(0, 3, animated)[1][1], 0.8)
    animated[:, 1] = [1.4, -2.0, 0.0]  # held so, as a grip: the file's own poses are possible
    lower, upper, seen = derived_limits(0, 3, animated)
    assert not seen[1]
    np.testing.assert_allclose([lower[1], upper[1]], [[-0.8, -2.1, -0.8], [1.5, 0.8, 0.8]])


def test_rest_pose_stays_inside_limits_from_animations():
    animated = np.zeros((2, 2, 3))
    animated[:, 1, 0] = [1.0, 1.2]
    lower, upper, _ = derived_limits(0, 2, animated)
    assert lower[1, 0] == 0.0 and upper[1, 0] == pytest.approx(1.3)


def test_limits_of_joints_that_turn_beyond_half_a_turn():
    """Rotation vectors of matrices end at half a turn and go on from the other side."""
    angles = np.radians([0.0, 60, 120, 170, 190, 150])
    animated = np.zeros((6, 3, 3))
    animated[:, 1, 0] = (angles + np.pi) % (2 * np.pi) - np.pi
    wobble = np.radians([175.0, 178, 182, 185, 179, 176])
    animated[:, 2] = ((wobble + np.pi) % (2 * np.pi) - np.pi)[:, None] * np.array([1.0, 1, 0]) / np.sqrt(2)
    lower, upper, seen = derived_limits(0, 3, animated)
    np.testing.assert_array_equal(seen, [False, True, True])
    np.testing.assert_allclose([lower[1, 0], upper[1, 0]], [-0.25 * np.radians(190), np.radians(190)])
    assert lower[2, 0] == lower[2, 1] == 0.0 and upper[2, 0] == pytest.approx(np.radians(185) / np.sqrt(2) + 0.1)
    for shuffled in (animated[::-1], animated[[3, 0, 4, 1, 5, 2]]):  # as of several clips
        np.testing.assert_allclose(derived_limits(0, 3, shuffled)[:2], [lower, upper], atol=1e-12)


@pytest.mark.parametrize("start", [0.0, 1, 20, 90, -170])
@pytest.mark.parametrize("turns", [[0, 45, 90, 135, 180, 225, 270, 315, 360], [0, 190, 90, 150], [0, 200, -5, -20], [0, 330]])
def test_rigs_of_clips_with_any_turns_can_be_used(start, turns):
    """Wheels, several clips, joints beyond half a turn: poses lie within limits, and show what the clips do."""
    data = make_tube_data()
    angles = np.radians(start + np.array(turns))
    animated = np.zeros((len(turns), 4, 3))
    animated[:, 2, 0] = (angles + np.pi) % (2 * np.pi) - np.pi
    rig = build_rig(replace(data, lower=None, upper=None, animated=animated))
    assert (np.abs([rig.lower, rig.upper]) <= 2 * np.pi).all() and rig.poses
    for theta in rig.poses.values():
        assert (theta >= rig.lower - 1e-9).all() and (theta <= rig.upper + 1e-9).all()
        away = matrix_from_rotvec(theta[2]) - matrix_from_rotvec(animated[:, 2])
        assert np.abs(away).max(axis=(1, 2)).min() < 1e-9


def test_a_files_own_poses_are_kept_as_they_are():
    """Whatever limits a card gives."""
    theta = np.zeros((4, 3))
    theta[2, 0] = np.radians(190)
    limits = (("long", np.radians([-180.0, -5, -5]), np.radians([180.0, 5, 5])),)
    rig = build_rig(replace(make_tube_data(), poses={"mine": theta}), Card(limits=limits))
    np.testing.assert_array_equal(rig.poses["mine"], theta)


@pytest.mark.parametrize("low, high, told", [(0.1, 0.5, True), (-0.5, -0.1, True), (0.3, 0.3, True), (0.0, 0.5, False)])
def test_limits_that_leave_out_the_rest_pose_are_told(low, high, told, tmp_path):
    """Of other joints than the root, which fits turn freely."""
    limits = (("long", (low, 0.0, 0.0), (high, 0.0, 0.0)), ("root", (0.1, 0.0, 0.0), (0.2, 0.0, 0.0)))
    rig = build_rig(make_tube_data(), Card(limits=limits))
    assert ("the rest pose is outside the limits of 1 joint (long)" in rig.notes) == told
    assert not any("outside the limits of" in note for note in rig.notes if "(long)" not in note)
    rig.save(tmp_path / "saved.npz")
    (tmp_path / "card.toml").write_text('[limits]\nunit = "rad"\nlong = [[-0.5, 0, 0], [0.5, 0, 0]]\n')
    mended = load_rig(tmp_path / "saved.npz", card=tmp_path / "card.toml")
    assert not any("outside the limits of" in note for note in mended.notes)


@pytest.mark.parametrize("low, high", [(-180, 180), (-10, 350), (-350, 10)])
def test_poses_of_clips_lie_within_a_cards_limits(low, high):
    """Whichever of the vectors of one rotation that takes."""
    data, animated = make_tube_data(), np.zeros((4, 4, 3))
    angles = np.radians([0, 190, 90, 150])
    animated[:, 2, 0] = (angles + np.pi) % (2 * np.pi) - np.pi
    low, high = np.radians([[low, -5, -5], [high, 5, 5]])
    rig = build_rig(replace(data, lower=None, upper=None, animated=animated), Card(limits=(("long", low, high),)))
    assert len(rig.poses) == 3
    for theta in rig.poses.values():
        assert (theta >= rig.lower - 1e-9).all() and (theta <= rig.upper + 1e-9).all()
        away = matrix_from_rotvec(theta[2]) - matrix_from_rotvec(animated[:, 2])
        assert np.abs(away).max(axis=(1, 2)).min() < 1e-9
