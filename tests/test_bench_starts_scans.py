"""The scans of ``lbsfit bench starts``: turned, bent and scaled as their rows say."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.bench.conditions import CONDITIONS, conditions_of
from lbsfit_np.bench.starts import starts_scan
from lbsfit_np.errors import InputError
from lbsfit_np.rotations import matrix_from_rotvec

pytestmark = pytest.mark.usefixtures("own_cache")

BENT = {"0.3": 0.3, "0.6": 0.6, "1.0": 1.0, "subjects": 0.6}


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def body():
    return lbs.load_rig("body-coarse")


# ---- scans ----


@pytest.mark.parametrize("row", CONDITIONS)
def test_the_truth_is_of_the_scan(hand, body, row):
    for rig in (hand, body):
        if row not in conditions_of(rig):
            continue
        for i in range(2):
            s = starts_scan(rig, row, i, 7)
            posed = partial(rig.pose, s.pose, s.translation, s.scale, s.template - rig.vertices)
            np.testing.assert_allclose(posed(joints=s.template_joints), s.vertices, atol=1e-12 * s.scale)
            joints = rig.pose_joints(s.pose, s.translation, s.scale, s.template - rig.vertices, joints=s.template_joints)
            np.testing.assert_allclose(joints, s.joints, atol=1e-12 * s.scale)
            of_the_body = s.labels >= 0
            away = np.linalg.norm(s.points[of_the_body, None] - s.vertices[None, ::3], axis=2).min(axis=1)
            assert away.max() < 0.15 * rig.size * s.scale
            assert of_the_body.sum() == 2500 or CONDITIONS[row].scan.holes
            assert (s.template is rig.vertices) == (row != "subjects")
            if row == "arm":  # of a hand, 0.2 to 1.3 times as long
                assert 0.1 < (~of_the_body).sum() / of_the_body.sum() < 1.5
                assert (s.triangle[~of_the_body] == -1).all() and (s.barycentric[~of_the_body] == 0).all()
            else:
                assert (~of_the_body).sum() == (0.1 * of_the_body.sum() if row == "dirty" else 0)


def test_a_scan_depends_on_seed_rig_row_and_number_only(hand, body):
    one = starts_scan(hand, "turned", 3, 200)
    starts_scan(hand, "turned", 2, 200), starts_scan(body, "partial", 3, 200)
    assert np.array_equal(starts_scan(hand, "turned", 3, 200).points, one.points)
    others = [(hand, "turned", 4, 200), (hand, "turned", 3, 201), (hand, "rotated", 3, 200), (hand, "unit", 3, 200)]
    for other in others:
        assert not np.array_equal(starts_scan(*other).points[:50], one.points[:50])
    assert not np.allclose(starts_scan(hand, "dirty", 3, 200).pose, one.pose)  # rows of the same kind of pose have their own
    renamed = replace(hand, name="other")
    assert not np.array_equal(starts_scan(renamed, "turned", 3, 200).points[:50], one.points[:50])


@pytest.mark.parametrize("row", BENT)
def test_joints_are_bent_by_one_angle_within_their_limits(hand, body, row):
    for rig in (hand, body):
        poses = np.array([CONDITIONS[row].pose(rig, i, np.random.default_rng(i)) for i in range(40)])
        assert (poses >= rig.lower).all() and (poses <= rig.upper).all() and not poses[:, rig.root].any()
        angle = np.linalg.norm(poses, axis=2)
        assert angle.max() <= BENT[row] + 1e-12 and not angle[:, ~rig.moving].any()
        inside = ((poses > rig.lower) & (poses < rig.upper)).all(axis=2) & rig.moving
        inside[:, rig.root] = False
        assert inside.any() or BENT[row] > 0.5  # a joint of one axis is always cut
        np.testing.assert_allclose(angle[inside], BENT[row], rtol=1e-12)


def _root_turns(rig, row, n=150):
    poses = np.array([CONDITIONS[row].pose(rig, i, np.random.default_rng(i)) for i in range(n)])
    frame = rig.frames[rig.root]
    return poses, frame @ matrix_from_rotvec(poses[:, rig.root]) @ frame.T


@pytest.mark.parametrize("row", ["turned", "unit", "partial", "cropped", "edge", "dirty"])
def test_upright_rows_face_any_way_and_stand(hand, row):
    poses, turns = _root_turns(hand, row)
    assert (poses[:, 1:] >= hand.lower[1:]).all() and (poses[:, 1:] <= hand.upper[1:]).all()
    facing = np.arctan2(turns[:, 0, 2], turns[:, 2, 2])
    assert set((facing // (np.pi / 4)).astype(int)) >= set(range(-4, 4))
    assert turns[:, 1, 1].min() > 0.3  # y stays up, but for the root's own limits


def test_rotated_is_any_rotation(hand):
    _, turns = _root_turns(hand, "rotated", 400)
    for axis in range(3):
        u = turns[:, axis, axis]
        assert abs(u.mean()) < 0.1 and u.std() == pytest.approx(1 / np.sqrt(3), abs=0.05)


def test_units_and_scales_are_mixed(hand):
    scales = np.array([starts_scan(hand, "unit", i, 1).scale for i in range(60)])
    share = scales[:, None] / np.array([1.0, 100.0, 1000.0, 1 / 0.0254])
    fits = (share > 0.5) & (share < 2)
    assert fits.any(axis=1).all() and (fits.sum(axis=0) > 5).all()
    assert {starts_scan(hand, row, 0, 1).scale for row in CONDITIONS if row != "unit"} == {1.0}


def test_touching_hands_are_fists_and_fingers_that_touch(hand):
    poses = np.array([CONDITIONS["touching"].pose(hand, i, np.random.default_rng(i)) for i in range(12)])
    assert (poses >= hand.lower).all() and (poses <= hand.upper).all() and not poses[:, hand.root].any()
    fists = np.stack([theta for name, theta in hand.poses.items() if "fist" in name])
    bends = (hand.upper - hand.lower).argmax(axis=1)
    middle = [j for j, name in enumerate(hand.joint_names) if name in ("index2", "middle2", "ring2", "pinky2")]
    least = 0.5 * np.abs(fists[:, middle, bends[middle]]).min()
    bent = np.abs(poses[:, middle, bends[middle]]).mean(axis=1)
    assert (bent[::3] > least).all()
    tips = [hand.weights[:, [j]].toarray().ravel() > 0.5 for j, n in enumerate(hand.joint_names) if n.endswith("3")]
    for theta in np.delete(poses, np.s_[::3], axis=0):
        V = hand.pose(theta)
        at = np.array([V[rows].mean(axis=0) for rows in tips])
        apart = np.linalg.norm(at[:, None] - at, axis=2)[np.triu_indices(5, 1)].min()
        assert apart < 0.12 * hand.size


def test_rigs_take_part_in_the_rows_that_are_for_them(hand, body):
    assert conditions_of(hand) == list(CONDITIONS)
    assert conditions_of(body) == [row for row in CONDITIONS if row not in ("touching", "arm")]
    with pytest.raises(InputError, match="no library of natural poses"):
        conditions_of(replace(hand, poses={}))
    fistless = replace(hand, poses={"flat": hand.poses["flat"], "ok": hand.poses["ok"]})
    with pytest.raises(InputError, match="no fist"):
        starts_scan(fistless, "touching", 0, 0)
    assert set(conditions_of(hand)) - set(conditions_of(fistless)) == {"touching"}  # before any row is fitted
