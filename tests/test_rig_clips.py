"""Natural poses for rigs whose files have animations alone."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.card_text import card_text
from lbsfit_np.rig.clips import poses_of_clips, under_other_parents
from lbsfit_np.rotations import matrix_from_rotvec


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


def test_they_follow_the_axes_and_the_hierarchy(swing):
    """With other frames the same turns about the new axes; on other parents they are relative to these."""
    data = replace(make_tube_data(), animated=swing)
    rig, turned = build_rig(data), build_rig(data, Card(frames=(("*", "bone"),)))
    assert rig.poses and list(rig.poses) == list(turned.poses) and not np.allclose(rig.frames, turned.frames)
    for name, pose in rig.poses.items():
        np.testing.assert_allclose(turned.pose(turned.poses[name]), rig.pose(pose), atol=1e-12)
    names = rig.joint_names
    other = build_rig(data, Card(parents=((names[3], names[0]),)))
    assert list(other.poses) == list(rig.poses)
    for name, pose in rig.poses.items():  # all turn as far as before, in all
        np.testing.assert_allclose(_turns(other, other.poses[name]), _turns(rig, pose), atol=1e-12)
    assert other.poses[max(other.poses)][3].any() and not rig.poses[max(rig.poses)][3].any()


def _turns(rig, theta):
    """(J, 3, 3): by how much each joint is turned in all."""
    local = rig.frames @ matrix_from_rotvec(theta) @ np.swapaxes(rig.frames, 1, 2)
    turned = local.copy()
    for rows, parents in rig.levels:
        turned[rows] = turned[parents] @ local[rows]
    return turned


def test_limits_are_about_the_parents_that_a_card_gives(swing):
    """A joint that only goes along in the animation gets no share of its new parent's turns."""
    data = replace(make_tube_data(), animated=swing, parents=np.array([-1, -1, -1, -1]), lower=None, upper=None)
    names = data.joint_names
    chain = ((names[0], names[1], names[2]), (names[1], names[3]))
    data.animated[:, 0] = 0.0
    data.animated[:, 2] = data.animated[:, 3] = data.animated[:, 1]  # siblings that turn alike, as of a stiff arm
    rig = build_rig(data, Card(root=names[0], chains=chain))
    assert rig.upper[1, 0] > 1.0 and np.abs(rig.upper[2:]).max() == np.abs(rig.lower[2:]).max() == 0.8
    assert any("from the animations with a margin for 1;" in note for note in rig.notes)
    round_about = np.array([1, 0, 1, 1])
    assert under_other_parents(swing, data.frames, round_about, rig.parents) is None
    # The card that is offered where there is no hierarchy yet has what its own guess would give.
    lines = card_text(replace(data, joint_names=["root", "arm1", "arm2", "arm3"], partitions={})).splitlines()
    limits = {name: next(line for line in lines if line.startswith(f'# "{name}" = ')) for name in ("arm1", "arm2", "arm3")}
    assert [name for name, line in limits.items() if line.endswith("[[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]]")] == ["arm2", "arm3"]


def test_where_poses_are_the_files_own_another_hierarchy_leaves_none(swing):
    data = replace(make_tube_data(), animated=swing, poses={"own": np.full((4, 3), 0.1)})
    names = build_rig(data).joint_names
    other = build_rig(data, Card(parents=((names[3], names[0]),)))
    assert other.poses == {} and any("natural poses" in note and "left out" in note for note in other.notes)
