"""Natural poses for rigs whose files have animations alone."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.clips import poses_of_clips


@pytest.fixture
def swing():
    """A joint that bends by 1 rad and back in 41 frames, its child by half as much, while the root walks in a circle."""
    t = np.linspace(0, 1, 41)
    animated = np.zeros((41, 4, 3))
    animated[:, 0, 1] = 2 * np.pi * t
    animated[:, 1, 0] = 1.0 - np.abs(2 * t - 1)
    animated[:, 2, 2] = 0.5 * animated[:, 1, 0]
    return animated


def test_poses_are_spread_over_the_frames(swing):
    poses = poses_of_clips(swing, 0, np.zeros(4, dtype=bool))
    bends = sorted(pose[1, 0] for pose in poses.values())
    assert bends[-1] == 1.0 and bends[0] > 0.2 and np.diff(bends).min() > 0.2 and 3 <= len(poses) <= 4
    assert list(poses) == [f"animation {n + 1}" for n in range(len(poses))]
    for pose in poses.values():
        assert not pose[0].any() and not pose[3].any() and pose[2, 2] == 0.5 * pose[1, 0]


def test_joints_that_do_not_turn_are_at_rest(swing):
    still = np.array([False, True, False, False])
    poses = poses_of_clips(swing, 0, still)
    assert 1 <= len(poses) <= 2 and not any(pose[1].any() for pose in poses.values())
    assert poses_of_clips(swing, 0, np.array([False, True, True, False])) == {}
    assert poses_of_clips(swing[:0], 0, still) == poses_of_clips(np.zeros((5, 4, 3)), 0, still) == {}


def test_half_a_turn_either_way_is_one_pose():
    frames = np.zeros((2, 4, 3))
    frames[:, 1, 0] = 3.1, -3.1
    assert len(poses_of_clips(frames, 0, np.zeros(4, dtype=bool))) == 1


def test_there_are_not_too_many():
    frames = np.random.default_rng(0).uniform(-1, 1, (200, 4, 3))
    assert len(poses_of_clips(frames, 0, np.zeros(4, dtype=bool))) == 24


def test_a_rig_with_animations_has_them(swing):
    data = replace(make_tube_data(), animated=swing)
    rig = build_rig(data)
    assert len(rig.poses) in (3, 4) and any("taken from its animations" in note for note in rig.notes)
    own = {"own": np.zeros((4, 3))}
    assert set(build_rig(replace(data, poses=own)).poses) == {"own"}  # the file's own are better


def test_they_follow_the_axes_and_not_another_hierarchy(swing):
    """With other frames the same turns about the new axes; on other parents they mean nothing."""
    data = replace(make_tube_data(), animated=swing)
    rig, turned = build_rig(data), build_rig(data, Card(frames=(("*", "bone"),)))
    assert rig.poses and list(rig.poses) == list(turned.poses) and not np.allclose(rig.frames, turned.frames)
    for name, pose in rig.poses.items():
        np.testing.assert_allclose(turned.pose(turned.poses[name]), rig.pose(pose), atol=1e-12)
    names = rig.joint_names
    other = build_rig(data, Card(parents=((names[3], names[0]),)))
    assert other.poses == {} and not any("animations" in note and "natural" in note for note in other.notes)
