"""The fit of one scan: known poses come back, whatever the unit, the place and the order."""

from dataclasses import replace

import numpy as np
import pytest
from fit_checks import mean_error
from slow_tests import slow
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.fitting.scout import Found
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rig.build import build_rig
from lbsfit_np.synthesis import uniform_poses

CLEAN = {"noise": 0.0, "holes": 0, "density": 0.0}


@pytest.mark.parametrize(
    "scale, joints", [("estimate", "follow"), ("fixed", "fixed"), slow("estimate", "fixed"), slow("fixed", "follow")]
)
def test_the_rigs_own_vertices_give_their_pose_back(tube_rig, scale, joints):
    """Every point has its vertex: the truth costs nothing, and nothing else is as good."""
    fitter = lbs.LBSFitter(tube_rig, scale=scale, joints=joints, random_state=0)
    for theta in uniform_poses(tube_rig, 2, np.random.default_rng(5)):
        V = tube_rig.pose(theta) + [0.3, 0.0, -0.1]
        r = fitter.fit_scan(V, labels=tube_rig.vertex_labels)
        assert mean_error(tube_rig, r.joints, tube_rig.pose_joints(theta) + [0.3, 0.0, -0.1]) < 0.006
        assert mean_error(tube_rig, r.vertices, V) < 0.004
        assert r.scale == 1.0 if scale == "fixed" else abs(r.scale - 1) < 0.01
        assert r.status == "ok"


def test_surface_points_with_known_labels_give_the_pose_back(tube_rig, fitter):
    for s in lbs.synthesize(tube_rig, 4, random_state=3, shape=0.0, n_points=1000, **CLEAN):
        r = fitter.fit_scan(s.points, labels=s.labels)
        assert mean_error(tube_rig, r.joints, s.joints) < 0.04
        assert mean_error(tube_rig, r.vertices, s.vertices) < 0.045
        assert abs(r.scale - 1) < 0.06


def test_scans_of_other_shapes_with_all_their_flaws(tube_rig, quick_fitter):
    joints, vertices, labels = [], [], []
    scans = lbs.synthesize(tube_rig, 6, random_state=8, n_points=1000)
    for s in scans:
        r = quick_fitter.fit_scan(s.points)
        joints.append(mean_error(tube_rig, r.joints, s.joints))
        vertices.append(mean_error(tube_rig, r.vertices, s.vertices))
        labels.append((r.labels == s.labels).mean())
    assert np.mean(joints) < 0.08 and np.mean(vertices) < 0.08 and np.mean(labels) > 0.85
    rest = np.mean([mean_error(tube_rig, s.joints, tube_rig.joints) for s in scans])
    assert np.mean(joints) < 0.5 * rest


def test_a_scan_of_few_points(tube_rig, fitter, tube_scan):
    rows = np.random.default_rng(0).choice(len(tube_scan.points), 60, replace=False)
    r = fitter.fit_scan(tube_scan.points[rows], labels=tube_scan.labels[rows])
    assert mean_error(tube_rig, r.joints, tube_scan.joints) < 0.15


def test_a_large_scan_is_thinned_and_labelled_in_full(tube_rig, tube_fitter):
    s = lbs.synthesize(tube_rig, 1, random_state=9, n_points=20000, **CLEAN)[0]
    r = tube_fitter.fit_scan(s.points)
    assert r.labels.shape == r.confidence.shape == (20000,)
    assert (r.labels == s.labels).mean() > 0.8


@pytest.mark.parametrize("parts", [{"all": ("root",)}, {"arm": ("root",), "fingers": ("long", "short")}])
def test_rigs_of_one_and_two_parts(parts, tube_scan):
    rig = build_rig(replace(make_tube_data(), partitions={"few": parts}), parts="few")
    fitter = lbs.LBSFitter(rig, effort="fast", training_scans=10, training={"n_points": 500}, random_state=0)
    r = fitter.fit_scan(tube_scan.points)
    assert r.parts == tuple(parts) and set(r.labels) <= set(range(len(parts)))
    assert np.isfinite(r.vertices).all()


# ---- from what a scout has found ----


def _from_truth(rig, points, truth, settings, **known):
    """The fit of a scan whose true pose was found."""
    model = Model(rig)
    frame = Frame(np.zeros(3), model.half)
    state = model.rest().replace(theta=truth.pose)
    found = {"proba": None, "value": 1.0, "rivals": ()} | known
    fit = ScanFit(model, settings)
    return fit.fit(points, part=fit.taking_part(points), found=Found(frame, Problem(frame.inside(points)), state, **found))


def test_what_the_scout_has_seen_is_evidence(tube_rig):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=6, shape=0.0, n_points=400, **CLEAN)
    settings = FitSettings(full_iterations=1, polish=0, registration=False)
    proba = np.full((400, 4), 0.25)
    r = _from_truth(tube_rig, scan.points, scan, settings, proba=proba, value=1.0, rivals=(4.0, 2.0))
    assert r.evidence["rival"] == 0.5 and r.evidence["disagreement"] == pytest.approx(0.75)
    alone = _from_truth(tube_rig, scan.points, scan, settings)
    assert alone.evidence["rival"] == alone.evidence["disagreement"] == 0.0


def test_a_lump_beside_the_body_does_not_pull_the_mesh(tube_rig):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=6, shape=0.0, n_points=400, **CLEAN)
    lump = scan.points[scan.points[:, 2].argmax()] + [0.0, 0.0, 0.1] + 0.01 * np.random.default_rng(0).random((40, 3))
    settings = FitSettings(full_iterations=10, polish=0, registration=False)
    plain, beside = (_from_truth(tube_rig, p, scan, settings).vertices for p in (scan.points, np.vstack([scan.points, lump])))
    assert np.linalg.norm(beside - plain, axis=1).max() < 0.02 * tube_rig.size


# ---- equivariance ----


@pytest.fixture(scope="module")
def results(tube_fitter, tube_scan, tube_result):
    """Whether labels are known → the fit of the scan as it is."""
    return {False: tube_result, True: tube_fitter.fit_scan(tube_scan.points, labels=tube_scan.labels)}


@pytest.mark.parametrize(
    "factor, shift", [slow(1.0, [10.0, -20.0, 5.0]), slow(1000.0, [0.0] * 3), (1000.0, [1e4, -2e3, 3e3]), (0.01, [1.0, 0, 0])]
)
@pytest.mark.parametrize("known", [False, True])
def test_unit_and_place_of_the_scan_carry_over(tube_rig, tube_fitter, tube_scan, results, factor, shift, known):
    """The same up to what rounding does to a minimiser's path."""
    before, labels = results[known], tube_scan.labels if known else None
    after = tube_fitter.fit_scan(factor * tube_scan.points + shift, labels=labels)
    assert mean_error(tube_rig, (after.vertices - shift) / factor, before.vertices) < 0.03
    assert mean_error(tube_rig, (after.joints - shift) / factor, before.joints) < 0.03
    assert after.scale / factor == pytest.approx(before.scale, rel=0.03)
    np.testing.assert_allclose(after.offsets, before.offsets, atol=0.1 * tube_rig.size)
    assert (after.labels == before.labels).mean() > 0.97


def test_rig_and_scan_in_another_unit_give_the_same_to_the_last_bit(fitter, tube_scan):
    a = fitter.fit_scan(tube_scan.points, labels=tube_scan.labels)
    larger = lbs.LBSFitter(fitter.rig.scaled(4.0), effort="fast", random_state=0)
    c = larger.fit_scan(4.0 * tube_scan.points, labels=tube_scan.labels)
    np.testing.assert_array_equal(c.pose, a.pose)
    np.testing.assert_array_equal(c.vertices, 4.0 * a.vertices)
    np.testing.assert_array_equal(c.offsets, 4.0 * a.offsets)
    assert c.scale == a.scale


def test_a_fixed_scale_is_1(tube_rig, tube_scan):
    r = lbs.LBSFitter(tube_rig, scale="fixed", random_state=0).fit_scan(tube_scan.points, labels=tube_scan.labels)
    assert r.scale == 1.0
