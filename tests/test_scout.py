"""The first look at a scan: however it is turned, in whatever unit, its pose is found; what is known of it holds."""

from dataclasses import replace

import numpy as np
import pytest
from slow_tests import slow
from turned_scans import any_turn, error_of, upright

import lbsfit_np as lbs
from lbsfit_np.fitting.refit import Runner
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.optimize.frame import Frame, turned_root
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.turns import ORIENTATIONS

pytestmark = pytest.mark.usefixtures("one_thread")


def _scale(found, rig):
    return found.state.scale * found.frame.unit / (rig.size / 2)


# ---- turns, units, places ----


@pytest.mark.parametrize("angle", [0.13, np.pi, *map(slow, (0.0, np.pi / 2, 2.0, -1.2))])
def test_a_scan_turned_about_the_up_axis_is_found(tube_rig, make_scout, clean_scans, angle):
    turn = upright(angle)
    for s in clean_scans[:2]:
        found = make_scout()(s.points @ turn.T + [3.0, 0.0, -1.0])
        assert error_of(tube_rig, found, s, turn, shift=[3.0, 0.0, -1.0]) < 0.03
        np.testing.assert_allclose(found.frame.turn[:, 1], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_scan_turned_in_any_way_is_found(tube_rig, make_scout, clean_scans, seed):
    turn, s = any_turn(seed), clean_scans[seed % 4]
    assert error_of(tube_rig, make_scout("any")(s.points @ turn.T), s, turn) < 0.03


@pytest.mark.parametrize("unit", [1000.0, 39.37, 0.5, 2.0, 0.01, 3.7e5])
def test_the_unit_is_found_with_the_turn(tube_rig, make_scout, clean_scans, unit):
    turn, s = upright(2.0), clean_scans[1]
    found = make_scout()(unit * s.points @ turn.T + 5 * unit)
    assert error_of(tube_rig, found, s, turn, unit, 5 * unit) < 0.03
    assert _scale(found, tube_rig) == pytest.approx(unit, rel=0.05)
    assert 1 / 3 < found.state.scale < 3


@pytest.mark.slow
def test_a_hand_that_lies_anyhow_in_millimetres():
    rig = lbs.load_rig("hand-coarse")
    quick = {"effort": "fast", "training_scans": 60, "training": {"n_points": 500}}
    fitter = lbs.LBSFitter(rig, orientation="any", random_state=0, **quick).pretrain()
    for k, s in enumerate(lbs.synthesize(rig, 2, poses="natural", random_state=1, n_points=700, shape=0.03)):
        turn = any_turn(20 + k)
        r = fitter.fit_scan(1000 * s.points @ turn.T + [100.0, 0.0, -500.0])
        joints = (r.joints - [100.0, 0.0, -500.0]) @ turn / 1000
        assert np.linalg.norm(joints - s.joints, axis=1).mean() / (rig.size / 2) < 0.04
        assert r.scale == pytest.approx(1000, rel=0.08)
        place = r.pose, r.translation, r.scale, r.offsets
        np.testing.assert_allclose(rig.pose(*place, joints=r.rest_joints), r.vertices, atol=1e-6)


# ---- what is known holds ----


def test_an_aligned_scan_is_never_turned(tube_rig, make_scout, clean_scans):
    for turn in (np.eye(3), upright(np.pi)):
        found = make_scout("aligned")(clean_scans[0].points @ turn.T)
        np.testing.assert_array_equal(found.frame.turn, np.eye(3))
    assert error_of(tube_rig, make_scout("aligned")(clean_scans[0].points), clean_scans[0]) < 0.03


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_scan_that_faces_the_rigs_way_is_found_whatever_is_open(tube_rig, make_scout, clean_scans, orientation):
    assert error_of(tube_rig, make_scout(orientation)(clean_scans[2].points), clean_scans[2]) < 0.03


def test_a_fixed_scale_is_1(tube_rig, make_scout, clean_scans):
    turn = upright(1.0)
    scout = make_scout(settings=FitSettings(scale="fixed", effort="fast"))
    found = scout(clean_scans[0].points @ turn.T)
    assert _scale(found, tube_rig) == pytest.approx(1.0, rel=1e-12) and found.state.scale == 1.0
    assert error_of(tube_rig, found, clean_scans[0], turn) < 0.03
    larger = scout(1.1 * clean_scans[0].points)  # and stays 1 where another would explain more
    assert larger.state.scale == 1.0


@pytest.mark.parametrize("factor", [0.3, 2.9])
def test_a_fixed_scale_of_a_scan_that_no_pose_is_as_large_as_is_no_error(make_scout, clean_scans, factor):
    found = make_scout(settings=FitSettings(scale="fixed", effort="fast"))(factor * clean_scans[0].points)
    assert found.state.scale == 1.0 and np.isfinite(found.state.theta).all()


def test_a_unit_that_is_given_is_kept(tube_rig, make_scout, clean_scans):
    turn = upright(-2.0)
    found = make_scout(unit=1000.0)(1000 * clean_scans[3].points @ turn.T)
    assert _scale(found, tube_rig) == pytest.approx(1000, rel=1e-12)
    assert error_of(tube_rig, found, clean_scans[3], turn, 1000.0) < 0.03


def test_known_proportions_are_kept(make_scout, clean_scans):
    assert not make_scout(proportions=False)(clean_scans[0].points).state.coefficients.any()
    assert make_scout()(clean_scans[0].points).state.coefficients.any()
    off = FitSettings(effort="fast", polish=0)
    assert not make_scout(settings=off)(clean_scans[0].points).state.coefficients.any()


# ---- what is seen, and what counts ----


def test_labels_are_seen_in_the_frame_that_was_found(make_scout, clean_scans, tube_rig):
    """However the scan lies, the segmenter sees it as if it faced the rig's way and had the rig's size."""
    turn, s = any_turn(3), clean_scans[1]
    found = make_scout("any")(1000 * s.points @ turn.T)
    assert found.proba.shape == (600, 4)
    np.testing.assert_allclose(found.proba.sum(axis=1), 1.0, atol=1e-5)
    assert (found.proba.argmax(axis=1) == s.labels).mean() > 0.75
    assert make_scout("any", segmenter=False)(s.points @ turn.T).proba is None


@pytest.mark.parametrize("angle, along", [(0.5, False), (2.0, True), (3.1, True)])
def test_labels_are_seen_from_where_steps_have_turned_the_root_to(make_scout, clean_scans, angle, along):
    """A scan that leans further than those of training does so in the pose, too: it is turned back before it is seen."""
    scout, x = make_scout("any"), clean_scans[1].points
    lean = matrix_from_rotvec(angle * np.array([0.6, 0.0, 0.8]))
    frame, rest = Frame(x.mean(axis=0), scout.model.half), scout.model.rest()
    upright, leaning = (Problem(frame.inside(x) @ turn.T) for turn in (np.eye(3), lean))
    leans = rest.replace(theta=turned_root(scout.model.rig, rest.theta, lean))
    seen = scout._seen(Runner(leaning, leans, frame))
    expected = scout._seen(Runner(upright, rest, frame)) if along else scout._seen(Runner(leaning, rest, frame))
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    assert (seen.argmax(axis=1) == clean_scans[1].labels).mean() > (0.75 if along else 0.5)


def test_labels_of_the_pose_that_is_found_are_those(make_scout, clean_scans, monkeypatch):
    scout = make_scout()
    monkeypatch.setattr(scout, "_seen", lambda runner: runner.state)
    found = scout(clean_scans[1].points)
    assert found.proba is found.state


def test_without_a_segmenter_scans_are_found_as_well(tube_rig, make_scout, clean_scans):
    for k, s in enumerate(clean_scans):
        turn = upright(1.0 + k)
        assert error_of(tube_rig, make_scout(segmenter=False)(s.points @ turn.T), s, turn) < 0.03


@pytest.mark.slow
def test_weights_of_points_count(tube_rig, make_scout, clean_scans):
    """Half of the points are beside the body, and count for nothing."""
    s, rng = clean_scans[0], np.random.default_rng(0)
    X = np.vstack([s.points, s.points + [0.2, 0.0, 0.15]])
    order = rng.permutation(len(X))
    light = np.r_[np.ones(600), np.full(600, 1e-9)]
    found = make_scout()(X[order], (light / light.sum())[order])
    np.testing.assert_allclose(found.frame.centre, s.points.mean(axis=0), atol=1e-6)
    assert error_of(tube_rig, found, s) < 0.03 < error_of(tube_rig, make_scout()(X[order]), s)
    uneven = rng.random(600)
    assert error_of(tube_rig, make_scout()(s.points, uneven / uneven.sum()), s) < 0.03


def test_the_same_again(make_scout, clean_scans):
    a, b = (make_scout()(clean_scans[0].points) for _ in range(2))
    np.testing.assert_array_equal(a.state.theta, b.state.theta)
    assert a.value == b.value
    scout = make_scout()
    scout(clean_scans[1].points)
    np.testing.assert_array_equal(scout(clean_scans[0].points).state.theta, a.state.theta)  # one scan does not change the next


def test_a_pose_is_no_rival_of_itself(make_scout, clean_scans, monkeypatch):
    """As where two starts come to one pose in the last steps."""
    monkeypatch.setattr("lbsfit_np.fitting.scout._RIVAL", np.inf)
    scout, ends = make_scout("aligned", FitSettings()), []

    def two_poses(runners, limbs):
        best = runners[0]
        return [best, replace(best, state=best.state.replace(theta=best.state.theta + 0.5 * scout._refit.turning))]

    def to_one_pose(problem, state):
        ends.append(state)
        return ends[0], 1.0

    scout._refit.with_other_limbs, scout._to_the_end, scout._bends = two_poses, to_one_pose, None
    found = scout(clean_scans[0].points, once=True)
    assert len(ends) == 2 and found.rivals == ()
