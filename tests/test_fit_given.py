"""What a fit can be given besides points: a start, labels, weights of points."""

import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fit_checks import assert_same, mean_error
from slow_tests import slow
from small_rigs import make_tube_rig

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.fitting.search import Search
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rig.regressor import exact_regressor


def test_a_known_start_is_used(tube_rig, tube_fitter, tube_scan):
    r = tube_fitter.fit_scan(tube_scan.points, theta0=tube_scan.pose)
    assert mean_error(tube_rig, r.joints, tube_scan.joints) < 0.1
    again = tube_fitter.fit_scan(tube_scan.points, theta0=r.pose)
    assert mean_error(tube_rig, again.joints, r.joints) < 0.05


@pytest.mark.parametrize("weighted", [False, True])
def test_without_labels_a_known_start_is_put_where_the_scan_is(tube_rig, tube_scan, weighted, monkeypatch):
    model, theta, X = Model(tube_rig), tube_scan.pose, tube_scan.points + [3.0, -2.0, 7.0]
    weights = np.arange(len(X)) / np.arange(len(X)).sum() if weighted else None
    monkeypatch.setattr(Search, "_minimise", lambda self, state, *stage: state)
    start = Search(model, Problem(X, weights), None, False, FitSettings()).start(theta).outcome
    np.testing.assert_array_equal(start.theta, theta)
    centre = np.average(X, axis=0, weights=weights)
    np.testing.assert_allclose(model.areas @ model.deformed(start).vertices, centre, atol=1e-12)


def test_with_labels_a_part_of_the_body_is_no_fit_of_all_of_it():
    """Labels leave nothing that speaks against a pose but what the scan lacks: of a palm alone, all fingers are guesses."""
    rig = lbs.load_rig("hand-coarse")
    (scan,) = lbs.synthesize(rig, 1, poses="natural", random_state=7)
    fitter = lbs.LBSFitter(rig, effort="fast", orientation="aligned", random_state=0)
    of = scan.labels == 0
    assert fitter.fit_scan(scan.points, labels=scan.labels).status == "ok"
    palm = fitter.fit_scan(scan.points[of], labels=scan.labels[of])
    assert palm.status != "ok" and "has no points" in palm.message


@pytest.mark.parametrize("unit", [None, "m"])
def test_in_a_fixed_scale_labels_may_be_of_a_part(tube_rig, tube_scan, unit):
    """Whose extent says nothing of the unit; without labels it is refused, with words for this case."""
    fitter = lbs.LBSFitter(tube_rig, scale="fixed", unit=unit, orientation="aligned", random_state=0)
    of, scale = tube_scan.labels == 3, 1.0 if unit is None else tube_rig.metres_per_unit
    points, labels = scale * tube_scan.points[of], tube_scan.labels[of]
    r = fitter.fit_scan(points, labels=labels)
    assert r.scale == scale and r.left_out.mean() < 0.1
    away = np.linalg.norm(points[:, None] - r.vertices[tube_rig.vertex_labels == 3], axis=2).min(axis=1)
    assert away.mean() < 0.1 * scale * tube_rig.size
    with pytest.raises(InputError, match="If it shows a part of the body alone, give fit_scan its labels"):
        fitter.fit_scan(points)


def test_a_start_outside_the_limits_is_moved_inside(shared_rigs, tube_rig, fitter, tube_scan):
    r = fitter.fit_scan(tube_scan.points, labels=tube_scan.labels, theta0=np.full((4, 3), 3.0))
    assert (r.pose[1:] >= tube_rig.lower[1:]).all() and (r.pose[1:] <= tube_rig.upper[1:]).all()
    rig = lbs.load_rig(
        shared_rigs / "webxr_hand" / "left.glb", card=Path(lbs.__file__).parent / "bench" / "cards" / "webxr_left.toml"
    )
    r = lbs.LBSFitter(rig, random_state=0).fit_scan(rig.vertices, labels=rig.vertex_labels, theta0=np.full(rig.lower.shape, 0.2))
    held = ~rig.moving
    assert held.any() and (r.pose[held] == 0).all()
    bounded = np.arange(len(rig.parents)) != rig.root
    assert (r.pose[bounded] >= rig.lower[bounded]).all() and (r.pose[bounded] <= rig.upper[bounded]).all()


@pytest.mark.parametrize("given", [slow("theta0"), "labels"])
def test_a_rig_may_lie_anywhere(tube_rig, tube_scan, given):
    """Far from its own origin as a character may in its scene: scale and precision are what they are at the origin."""
    known = {"theta0": tube_scan.pose, "labels": tube_scan.labels}[given]
    found, training = [], {"training_scans": 40, "training": {"n_points": 200}}
    for away in (0.0, 40.0):
        moved = {"vertices": tube_rig.vertices + away, "joints": tube_rig.joints + away}
        rig = replace(tube_rig, **moved, regressor=exact_regressor(tube_rig.regressor, moved["vertices"], moved["joints"]))
        fitter = lbs.LBSFitter(rig, random_state=0, orientation="aligned", effort="fast", **training)
        found.append(fitter.fit_scan(1.4 * tube_scan.points, **{given: known}))
    here, there = found
    assert there.scale == pytest.approx(here.scale, rel=0.01) and here.scale == pytest.approx(1.4, rel=0.03)
    np.testing.assert_allclose(there.joints, here.joints, atol=0.003 * tube_rig.size)
    np.testing.assert_allclose(there.joint_std, here.joint_std, rtol=0.15)
    assert mean_error(tube_rig, there.joints, 1.4 * tube_scan.joints) < 0.1


@pytest.mark.parametrize("given", [slow(("labels",)), ("labels", "theta0")])
def test_what_speaks_for_a_fit_is_the_same_in_any_unit(fitter, tube_scan, given):
    """Also where the scan's extent passes for that of the rig's unit, though it is not in it."""
    rng = np.random.default_rng(0)
    known = {"labels": tube_scan.labels, "theta0": tube_scan.pose}
    points = tube_scan.points + 0.006 * rng.standard_normal(tube_scan.points.shape)
    one, *others = (fitter.fit_scan(factor * points, **{name: known[name] for name in given}) for factor in (1.0, 0.45, 1.7))
    for factor, r in zip((0.45, 1.7), others):
        assert r.scale == pytest.approx(factor * one.scale, rel=0.01) and r.status == one.status == "ok"
        for name in ("distance", "unexplained", "unreached"):
            assert r.evidence[name] == pytest.approx(one.evidence[name], rel=0.1, abs=0.003), name
        np.testing.assert_allclose(r.confidence, one.confidence, atol=0.2)
        np.testing.assert_allclose(r.joint_std, factor * one.joint_std, rtol=0.1)


def test_a_fit_on_next_to_nothing_is_not_believed():
    """A rig that only turns as a whole has three angles to be found, too."""
    rig = replace(make_tube_rig(), locked=np.arange(4) > 0)
    points = rig.vertices[[0, 100, 200]] + [0.1, 0.2, 0.3]
    r = lbs.LBSFitter(rig, random_state=0, max_points=100).fit_scan(points, labels=rig.vertex_labels[[0, 100, 200]])
    assert r.status != "ok" and r.evidence["sparse"] == 1.0


@pytest.mark.usefixtures("hurried")
def test_given_labels_are_kept(fitter, tube_scan):
    labels = np.random.default_rng(0).permutation(tube_scan.labels)
    given = labels.copy()
    r = fitter.fit_scan(tube_scan.points, labels=labels)
    np.testing.assert_array_equal(r.labels, labels)
    assert (r.confidence == 1).all()
    assert not hasattr(fitter, "segmenter_")  # nobody asked s
    assert not np.shares_memory(r.labels, labels) and (labels == given).all() and labels.flags.writeable


def test_a_start_that_is_right_is_not_lost_to_labels_that_are_wrong(tube_rig, tube_fitter, tube_scan, monkeypatch):
    wrong = np.eye(4)[(tube_scan.labels + 1) % 4]
    monkeypatch.setattr(type(tube_fitter.segmenter_), "predict_proba", lambda self, points, **options: wrong)
    r = tube_fitter.fit_scan(tube_scan.points, theta0=tube_scan.pose)
    assert mean_error(tube_rig, r.joints, tube_scan.joints) < 0.05


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("polish", [0, 1])
@pytest.mark.parametrize("labels", [False, True])
def test_a_start_goes_its_own_way_where_a_polish_tells_the_best(labels, polish, tube_rig, tube_scan, monkeypatch):
    made, in_place = [], Refit.in_place
    monkeypatch.setattr(Refit, "in_place", lambda *given: made.append(given) or in_place(*given))
    fit = ScanFit(Model(tube_rig), FitSettings(polish=polish, full_iterations=1))
    r = fit.fit(tube_scan.points, theta0=tube_scan.pose, labels=tube_scan.labels if labels else None)
    assert len(made) == polish and np.isfinite(r.vertices).all()


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("theta0", [False, True])
@pytest.mark.parametrize("labels", [False, True])
def test_a_fit_that_has_failed_names_what_was_given(theta0, labels, fitter, learned_people, tube_scan, monkeypatch):
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("failed", "a reason"))
    given = ({"theta0": tube_scan.pose} if theta0 else {}) | ({"labels": tube_scan.labels} if labels else {})
    learned_people = copy.copy(learned_people)  # what a hurry makes ready is no other test's
    for fit in (fitter.fit_scan, partial(learned_people.fit_scan, subject="ann")):
        message = fit(tube_scan.points, **given).message
        assert [name in message for name in ("theta0", "labels", "--orientation")] == [theta0, labels, not theta0]


@pytest.mark.parametrize("start", [False, True])
def test_known_labels_are_nobody_elses(start, tube_rig, tube_fitter, learned_people, people_scans, monkeypatch):
    """A segmenter that is there is not asked for what is known, which the last steps go by, too."""
    monkeypatch.setattr("lbsfit_np.segmentation.segmenter.Segmenter.predict_proba", None)
    last, polish = [], Refit.polish
    monkeypatch.setattr(Refit, "polish", lambda self, *a, **known: last.append(known["labels"]) or polish(self, *a, **known))
    s = people_scans[12]
    given = {"labels": s.labels} | ({"theta0": s.pose} if start else {})
    for fitter, more in ((tube_fitter, {}), (learned_people, {"subject": "ann"})):
        r = fitter.fit_scan(s.points, **given, **more)
        assert mean_error(tube_rig, r.joints, s.joints) < 0.05 and (r.labels == s.labels).all()
        assert len(last) == 2 and all((known == s.labels).all() for known in last)
        last.clear()


@pytest.mark.usefixtures("hurried")
def test_weights_of_0_leave_clutter_out(tube_rig, quick_fitter, tube_scan):
    rng = np.random.default_rng(0)
    clutter = rng.uniform(-3, 3, (1500, 3)) + [2.0, 0.0, 0.0]
    points = np.vstack([tube_scan.points[:1000], clutter])
    weights = np.r_[np.ones(1000), np.zeros(1500)]
    quick_fitter = copy.copy(quick_fitter)  # what a hurry makes ready is no other test's
    alone = quick_fitter.fit_scan(tube_scan.points[:1000], point_weights=np.ones(1000))
    with_clutter = quick_fitter.fit_scan(points, point_weights=weights)
    np.testing.assert_array_equal(with_clutter.pose, alone.pose)
    np.testing.assert_array_equal(with_clutter.vertices, alone.vertices)
    assert with_clutter.labels.shape == (2500,)
    np.testing.assert_array_equal(with_clutter.labels[:1000], alone.labels)


@pytest.mark.usefixtures("hurried")
def test_weights_count_by_their_ratio(fitter, tube_scan):
    w = np.random.default_rng(0).random(len(tube_scan.points)) + 0.1
    a, b = (fitter.fit_scan(tube_scan.points, labels=tube_scan.labels, point_weights=f * w) for f in (1.0, 4.0))
    np.testing.assert_array_equal(a.vertices, b.vertices)
    c = fitter.fit_scan(tube_scan.points, labels=tube_scan.labels)
    assert not np.array_equal(a.vertices, c.vertices)


@pytest.mark.usefixtures("hurried")
def test_nothing_that_is_given_is_changed(fitter, tube_scan):
    given = [tube_scan.points.copy(), tube_scan.labels.copy(), tube_scan.pose.copy(), np.ones(len(tube_scan.points))]
    kept = [a.copy() for a in given]
    fitter.fit_scan(given[0], labels=given[1], theta0=given[2], point_weights=given[3])
    for a, b in zip(given, kept):
        np.testing.assert_array_equal(a, b)
        assert a.flags.writeable


@pytest.mark.usefixtures("hurried")
def test_a_scan_object_is_as_good_as_its_points(fitter, tube_scan):
    from lbsfit_np.scan import Scan

    assert_same(
        fitter.fit_scan(Scan(tube_scan.points), labels=tube_scan.labels),
        fitter.fit_scan(tube_scan.points, labels=tube_scan.labels),
    )


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("given", [("labels",), ("theta0",), ()])
def test_surface_that_one_sided_scans_hide_takes_no_part_in_the_full_objective(given, tube_rig, tube_fitter, fitter, monkeypatch):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=40, n_points=600, one_sided=True)
    known = {"labels": scan.labels, "theta0": scan.pose}
    if not given:  # what is hidden is told by a pose that is about right
        fitter.segmenter_, fitter.regressor_ = tube_fitter.segmenter_, tube_fitter.regressor_
    problems, full = [], Search.full
    monkeypatch.setattr(Search, "full", lambda self, *given, **more: problems.append(self.problem) or full(self, *given, **more))
    for one_side in (True, False):
        fitter.set_params(partial=one_side).fit_scan(scan.points, **{name: known[name] for name in given})
    hidden = [0.0 if p.v_weights is None else np.mean(p.v_weights == 0) for p in problems]
    assert hidden[0] > 0.3 > hidden[1] and len(hidden) == 2


@pytest.mark.parametrize("start", [False, True])
def test_labels_may_be_known_of_some_points_alone(start, tube_rig, tube_fitter, learned_people, people_scans):
    """Those that are known are kept, and the mesh says the others."""
    s = people_scans[12]
    labels = np.where(np.arange(len(s.labels)) % 3 > 0, s.labels, -1)
    given = {"labels": labels} | ({"theta0": s.pose} if start else {})
    for fitter, more in ((tube_fitter, {}), (learned_people, {"subject": "ann"})):
        r = fitter.fit_scan(s.points, **given, **more)
        known = labels >= 0
        assert mean_error(tube_rig, r.joints, s.joints) < 0.05 and (r.labels[known] == s.labels[known]).all()
        assert (r.confidence[known] == 1).all() and (r.labels[~known] == s.labels[~known]).mean() > 0.9
        assert r.evidence["disagreement"] < 0.1 and r.confidence[~known].min() < 1


def test_few_known_labels_are_enough_to_tell_the_pose(tube_rig, tube_fitter, tube_scan):
    """Ten points of each part lead to the pose; all points then have their say."""
    labels = np.full(len(tube_scan.labels), -1)
    for p in range(4):
        labels[np.flatnonzero(tube_scan.labels == p)[:10]] = p
    r = tube_fitter.fit_scan(tube_scan.points, labels=labels)
    assert mean_error(tube_rig, r.joints, tube_scan.joints) < 0.05 and r.status == "ok" and "labelled" not in r.message


@pytest.mark.usefixtures("hurried")
def test_parts_that_no_label_names_are_named(tube_rig, fitter, tube_scan):
    """Nothing has looked for their pose; where all points are labelled, what is not named is not there."""
    some = np.where(tube_scan.labels < 2, tube_scan.labels, -1)
    words = "no point that takes part is labelled as long, short: what the scan shows of these may be fitted wrongly; without "
    assert words in fitter.fit_scan(tube_scan.points, labels=some).message
    assert "labelled as" not in fitter.fit_scan(tube_scan.points, labels=some, theta0=tube_scan.pose).message
    of = tube_scan.labels < 2
    assert "labelled as" not in fitter.fit_scan(tube_scan.points[of], labels=tube_scan.labels[of]).message


@pytest.mark.parametrize("start, mean, most", [(True, 0.002, 0.004), (False, 0.004, 0.01)])
@pytest.mark.slow
def test_labels_of_one_side_lead_nothing_to_the_hidden_side(start, mean, most):
    """Neither a start that is right nor, without one, the scale."""
    rig = lbs.load_rig("hand-coarse")
    fitter = lbs.LBSFitter(rig, partial=True, effort="fast", orientation="aligned", random_state=0)
    errors = []
    for s in lbs.synthesize(rig, 3, random_state=11, one_sided=True, holes=0, noise=0.0, shape=0.0):
        r = fitter.fit_scan(s.points, labels=s.labels, theta0=s.pose if start else None)
        away = np.linalg.norm(r.joints - s.joints, axis=1) / rig.size
        errors.append(away[r.joint_std < 0.02 * rig.size].mean())
    assert np.mean(errors) < mean and max(errors) < most


def test_which_way_a_scan_stands_is_said_where_it_was_looked_for(quick_fitter, tube_scan):
    """With labels no axes were tried that an option would save."""
    lying = tube_scan.points[:, [2, 0, 1]]
    assert "stands along" in quick_fitter.fit_scan(lying).message
    assert "stands along" not in quick_fitter.fit_scan(lying, labels=tube_scan.labels).message
    told = copy.copy(quick_fitter).set_params(up="+y").fit_scan(lying, labels=tube_scan.labels)
    assert "stands along its +z axis, though up says '+y'" in told.message


def test_labels_of_no_point_that_takes_part_are_named(tube_rig, tube_scan):
    """Thinning has left them out."""
    labels = np.full(len(tube_scan.labels), -1)
    labels[7] = 0
    thin = lbs.LBSFitter(tube_rig, max_points=20, random_state=0)
    with pytest.raises(lbs.InputError, match="labels: got -1 for all of the 20 points that take part .* a larger max_points"):
        thin.fit_scan(tube_scan.points, labels=labels)
