"""Fits of turned scans by way of the fitter: those of the scan as it was, turned."""

import copy

import numpy as np
import pytest
from slow_tests import slow
from turned_scans import any_turn, upright

import lbsfit_np as lbs

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("orientation", ["upright", "any"])
@pytest.mark.parametrize("unit", [slow(1.0), 25.4])
def test_a_fit_of_a_turned_scan_is_the_turned_fit(tube_rig, tube_fitter, clean_scans, orientation, unit):
    fitter = lbs.LBSFitter(tube_rig, orientation=orientation, random_state=0)
    fitter.segmenter_, fitter.regressor_ = tube_fitter._pretrained
    turn = upright(2.2) if orientation == "upright" else any_turn(8)
    s = clean_scans[0]
    r = fitter.fit_scan(unit * s.points @ turn.T + [9.0, 0.0, -3.0])
    back = (r.joints - [9.0, 0.0, -3.0]) @ turn / unit
    assert np.linalg.norm(back - s.joints, axis=1).mean() / (tube_rig.size / 2) < 0.03
    vertices = (r.vertices - [9.0, 0.0, -3.0]) @ turn / unit
    assert np.linalg.norm(vertices - s.vertices, axis=1).mean() / (tube_rig.size / 2) < 0.04
    assert (r.labels == s.labels).mean() > 0.9
    posed = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
    np.testing.assert_allclose(posed, r.vertices, atol=1e-9 * unit)


@pytest.fixture(scope="module")
def lying(quick_fitter, clean_scans):
    """Points of scans that lie in any way, and their fits."""
    fitter = copy.copy(quick_fitter).set_params(orientation="any")
    turned = [s.points @ any_turn(30 + k).T for k, s in enumerate(clean_scans[:2])]
    return [(points, fitter.fit_scan(points)) for points in turned]


@pytest.mark.parametrize("orientation", ["aligned", "upright", "any"])
def test_a_known_start_says_how_the_scan_is_turned(tube_rig, quick_fitter, lying, orientation):
    """Whatever the orientation is: a pose that was found is a start for the same scan again."""
    fitter = copy.copy(quick_fitter).set_params(orientation=orientation)
    for points, first in lying:
        again = fitter.fit_scan(points, theta0=first.pose)
        assert np.linalg.norm(again.joints - first.joints, axis=1).mean() / (tube_rig.size / 2) < 0.03


@pytest.mark.parametrize("angle", [1.5, *map(slow, (0.0, np.pi, -2.0))])
def test_known_labels_tell_the_turn(tube_rig, clean_scans, angle):
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    turn = upright(angle)
    for s in clean_scans[:2]:
        r = fitter.fit_scan(s.points @ turn.T, labels=s.labels)
        assert np.linalg.norm(r.joints @ turn - s.joints, axis=1).mean() / (tube_rig.size / 2) < 0.04
