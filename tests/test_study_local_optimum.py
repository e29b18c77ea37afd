"""The path on which the Chamfer distance rises before it falls, and the structured one only falls."""

import json

import numpy as np
import pytest

from lbsfit_np import load_rig
from lbsfit_np.bench.study import local_optimum
from lbsfit_np.bench.study.local_optimum import along_path, limbs, swings, target_scan
from lbsfit_np.losses import chamfer


@pytest.fixture(scope="module")
def hand():
    return load_rig("hand-coarse")


@pytest.fixture(scope="module")
def found(hand):
    return along_path(hand, steps=15)


def test_the_middle_finger_meets_a_local_optimum(found):
    assert found["chain"] == "middle1" and {found["from"], found["to"]} == {"index1", "ring1"}
    plain, structured = np.array(found["chamfer"]), np.array(found["structured"])
    assert found["rise"] == pytest.approx(plain.max() / plain[0]) and found["rise"] > 1.15
    top = plain.argmax()
    assert np.all(np.diff(plain[: top + 1]) > 0) and np.all(np.diff(plain[top + 1 :]) < 0) and 0 < top < 14
    assert np.all(np.diff(structured) < 0) and found["structured_rise"] == 1.0
    assert plain[-1] < 0.7 * plain[0] and structured[-1] < 0.2 * structured[0]


def test_the_numbers_are_plain_and_the_losses(hand, found):
    assert json.loads(json.dumps(found)) == found
    assert found["t"] == pytest.approx(np.linspace(0, 1, 15)) and len(found["structured"]) == 15
    swing = next(s for s in swings(hand) if hand.joint_names[s.toward] == found["to"])
    points, labels = target_scan(hand, swing)
    assert len(points) == len(labels) and set(labels) == set(range(len(hand.parts)))
    half = hand.size / 2
    assert found["chamfer"][0] == pytest.approx(chamfer(points, hand.pose(swing.start))[0] / half**2)
    # The target's own vertices: what is left is sampling.
    assert found["chamfer"][-1] == pytest.approx(chamfer(points, hand.pose(swing.target))[0] / half**2)
    assert found["angle"] == pytest.approx(swing.degrees(), abs=1e-3)


def test_swings_begin_in_the_wrong_place_and_end_beside_the_right_one(hand):
    lead = hand.leading_joint
    tips = {limb.joint: limb for limb in limbs(hand).values()}
    assert sorted(hand.joint_names[j] for j in tips) == ["index1", "middle1", "pinky1", "ring1", "thumb1"]
    both = swings(hand)
    assert len(both) == 2
    for swing in both:
        for pose in (swing.start, swing.target):
            assert np.all(pose >= hand.lower - 1e-12) and np.all(pose <= hand.upper + 1e-12)
        assert np.count_nonzero(swing.start != swing.target) == 1
        scan, estimate = hand.pose(swing.target), hand.pose(swing.start)
        tip = tips[swing.joint].tip

        def away(vertices, joint, tip=tip, scan=scan):
            """From the tip to a finger of the scan."""
            finger = np.flatnonzero((lead >= joint) & (lead < joint + 3))
            return np.linalg.norm(scan[finger] - vertices[tip], axis=1).min()

        assert away(estimate, swing.away) < away(estimate, swing.toward)
        assert away(estimate, swing.away) < away(estimate, swing.joint)
        # Side by side: not in each other, and no wider apart than two fingers.
        apart = np.linalg.norm(scan[tip] - scan[tips[swing.toward].tip])
        assert tips[swing.joint].breadth <= apart < 2 * tips[swing.joint].breadth


def test_the_other_hand_meets_it_too(found):
    left = along_path(load_rig("hand-left-coarse"), steps=15)
    assert (left["chain"], left["from"], left["to"]) == (found["chain"], found["from"], found["to"])
    assert left["rise"] == pytest.approx(found["rise"], abs=0.05)  # points are drawn from it by themselves


def test_rigs_without_such_a_path_have_none(tube_rig):
    assert swings(tube_rig) == [] and along_path(tube_rig) is None
    assert along_path(load_rig("body-coarse"), steps=5) is None


@pytest.mark.parametrize("highest, is_one", [(1.0, False), (1.01, False), (1.03, True)])
def test_a_rise_that_sampling_may_make_is_no_local_optimum(hand, monkeypatch, highest, is_one):
    """The second path rises by so much, the first one falls."""
    tops = iter([0.9, highest])

    def curves(rig, swing, steps):
        return [2.0, 2.0 * next(tops), 1.0], [3.0, 2.0, 1.0]

    monkeypatch.setattr(local_optimum, "_curves", curves)
    found, second = along_path(hand, steps=3), swings(hand)[1]
    if not is_one:
        assert found is None
    else:
        assert found["rise"] == pytest.approx(highest) and found["from"] == hand.joint_names[second.away]
