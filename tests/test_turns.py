"""Which way a scan may face: the turns that starts are tried under cover all that the orientation allows."""

from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.rig.frames import AXES
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.turns import ORIENTATIONS, any_side_up, facing_of, some_turns, stands_note


def _between(A, B):
    """Angles between rotations, radians."""
    trace = np.einsum("...ab,...ab->...", A, B)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _random_rotations(n, seed=0):
    from scipy.spatial.transform import Rotation

    return Rotation.random(n, random_state=seed).as_matrix()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_turns_are_rotations_that_begin_with_none(tube_rig, orientation):
    turns = facing_of(tube_rig, orientation).turns
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-12)
    np.testing.assert_allclose(turns[0], np.eye(3), atol=1e-15)
    assert len(np.unique(turns.round(9), axis=0)) == len(turns)
    np.testing.assert_array_equal(turns, facing_of(tube_rig, orientation).turns)


def test_aligned_is_no_turn(tube_rig):
    np.testing.assert_array_equal(facing_of(tube_rig, "aligned").turns, np.eye(3)[None])


@pytest.mark.parametrize("up, axis", [("+y", [0, 1, 0]), ("+z", [0, 0, 1]), ("-x", [-1, 0, 0]), (None, [0, 1, 0])])
def test_upright_turns_stand_on_the_rigs_up_axis(tube_rig, up, axis):
    turns = facing_of(replace(tube_rig, up=up), "upright").turns
    np.testing.assert_allclose(turns @ np.array(axis, dtype=float), np.tile(axis, (24, 1)), atol=1e-12)
    angles = np.linspace(0, 2 * np.pi, 500)
    every = matrix_from_rotvec(angles[:, None] * np.array(axis, dtype=float))
    assert _between(every[:, None], turns[None]).min(axis=1).max() <= np.radians(7.51)


@pytest.mark.parametrize("orientation", ["aligned", "upright"])
@pytest.mark.parametrize("up", AXES)
def test_turns_lead_to_the_scans_up_axis(tube_rig, orientation, up):
    rig, axis = replace(tube_rig, up="+z"), np.array(AXES[up])
    facing, own = facing_of(rig, orientation, up), facing_of(rig, orientation)
    np.testing.assert_array_equal(facing.up, axis)
    assert own.open_up == (orientation == "upright") and not facing.open_up
    np.testing.assert_allclose(facing.turns @ [0.0, 0.0, 1.0], np.tile(axis, (len(own.turns), 1)), atol=1e-12)
    shortest = 0.0 if up == "+z" else np.pi if up == "-z" else np.pi / 2
    assert _between(facing.turns[0], np.eye(3)) == pytest.approx(shortest, abs=1e-6)
    if orientation == "upright":
        between = _between(facing.turns[:, None], facing.turns[None])
        np.testing.assert_allclose(between, _between(own.turns[:, None], own.turns[None]), atol=1e-6)


def test_where_any_rotation_may_be_no_axis_is_up(tube_rig):
    facing = facing_of(tube_rig, "any")
    assert facing.up is None and not facing.open_up


def test_any_rotation_has_a_turn_near_it(tube_rig):
    turns = facing_of(tube_rig, "any").turns
    nearest = _between(_random_rotations(800)[:, None], turns[None]).min(axis=1)
    assert nearest.max() < np.radians(32) and nearest.mean() < np.radians(19)


def test_turns_are_spread_evenly(tube_rig):
    turns = facing_of(tube_rig, "any").turns[1:]
    apart = _between(turns[:, None], turns[None]) + 9 * np.eye(len(turns))
    assert apart.min() > np.radians(12)
    nearest = _between(_random_rotations(20_000)[:, None], turns[None]).argmin(axis=1)
    share = np.bincount(nearest, minlength=len(turns)) / 20_000 * len(turns)
    assert 0.3 < share.min() and share.max() < 2.0  # of rotations for which a turn is the nearest


@pytest.mark.parametrize("orientation, n", [("aligned", 1), ("upright", 6), ("any", 6)])
def test_some_turns_are_even_ones_of_all(tube_rig, orientation, n):
    turns = facing_of(tube_rig, orientation).turns
    some = some_turns(turns)
    assert len(some) == n
    np.testing.assert_array_equal(some[0], turns[0])
    if orientation == "upright":
        np.testing.assert_allclose(_between(some[:-1], some[1:]), np.radians(60), atol=1e-9)


def test_the_bundled_rigs_stand_on_y():
    for name in ("hand-coarse", "body-coarse"):
        turns = facing_of(lbs.load_rig(name), "upright").turns
        np.testing.assert_allclose(turns[:, 1], np.tile([0.0, 1.0, 0.0], (24, 1)), atol=1e-12)


def test_any_side_may_be_up():
    up = np.array([0.0, 1.0, 0.0])
    turns = facing_of(lbs.load_rig("hand-coarse"), "upright").turns
    wide = any_side_up(turns, up)
    assert len(wide) == 6 * len(turns)
    np.testing.assert_array_equal(wide[: len(turns)], turns)
    np.testing.assert_allclose(np.linalg.det(wide), 1.0)
    np.testing.assert_allclose(wide @ wide.transpose(0, 2, 1), np.broadcast_to(np.eye(3), wide.shape), atol=1e-12)
    sides = np.round(wide @ up, 6).reshape(6, len(turns), 3)
    assert (sides == sides[:, :1]).all() and len({tuple(s) for s in sides[:, 0] + 0.0}) == 6


@pytest.mark.parametrize(
    "side, words",
    [([0, 1, 0], ""), ([0, 0, 1], "along its +z axis"), ([0, -1, 0], "along its -y axis"), ([-1, 0, 0], "along its -x axis")],
)
def test_a_scan_that_stands_otherwise_is_told(side, words):
    up = np.array([0.0, 1.0, 0.0])
    turn = next(t for t in any_side_up(np.eye(3)[None], up) if np.allclose(t @ up, side))
    note = stands_note(turn, up)
    assert words in note and bool(words) == bool(note)
