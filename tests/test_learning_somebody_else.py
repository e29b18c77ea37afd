"""Scans of somebody else than the people learned from: told by proportions, and fitted with proportions of their own."""

import copy
import re

import numpy as np
import pytest
from learning_runs import HURRIED, found_at_the_truth, mean_gap, rounds_are_short

import lbsfit_np as lbs
from lbsfit_np.fitting import drawn
from lbsfit_np.fitting.confidence import SOMEBODY_ELSE
from lbsfit_np.fitting.effort import EFFORTS
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.fitting.template_fit import TemplateFit
from lbsfit_np.learning.pose_prior import pose_prior
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.state import Layout


@pytest.mark.slow
def test_a_scan_of_somebody_else_gets_proportions_of_its_own(tube_rig, learned_people):
    """One that is thicker than the rig and both people, and longer in its upper half."""
    changed = tube_rig.vertices * [1.45, 1.0, 1.45], tube_rig.joints
    upper = changed[0][:, 1] > 0.5 * tube_rig.vertices[:, 1].max()
    changed[0][upper, 1] += 0.3 * (changed[0][upper, 1] - 0.5 * tube_rig.vertices[:, 1].max())
    scans = lbs.synthesize(tube_rig, 3, templates=[changed], poses="uniform", random_state=8, n_points=400)[:2]
    found = [learned_people.fit_scan(s.points) for s in scans]
    told = r"much better than the template of '(ann|bob)', the nearest one: is it a scan of somebody else\?"
    assert all(re.search(told, r.message) for r in found)
    assert [r.subject for r in found] == [""] * 2
    named = [learned_people.fit_scan(s.points, subject="ann") for s in scans]
    assert all("explain it much better: is it a scan of somebody else?" in r.message and r.status != "ok" for r in named)
    assert mean_gap(tube_rig, found, scans, "vertices") < 0.8 * mean_gap(tube_rig, named, scans, "vertices")


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_scans_of_somebody_else_are_drawn_to_what_was_learned_of_poses_unless_labels_are_known(
    tube_rig, learned_people, people_scans, monkeypatch
):
    """Pose and proportions together, and the pose again in the end."""
    told, held, draw, polish = [], [], drawn.drawn, Refit.polish

    def drawing(steps, problem, state, prior, noise):
        found = draw(steps, problem, state, prior, noise)
        told.append((prior, noise, state, found))
        return found

    def polishing(self, problem, state, *, prior=None, **known):
        held.append(prior)
        return polish(self, problem, state, prior=prior, **known)

    monkeypatch.setattr(TemplateFit, "proportions", lambda *known: 1.0)  # all are somebody else's
    monkeypatch.setattr(drawn, "drawn", drawing)
    monkeypatch.setattr(Refit, "polish", polishing)
    scan, fitter = people_scans[12], copy.copy(learned_people)  # without what was made ready, and for others
    fitter.fit_scan(scan.points, labels=scan.labels)
    assert not told and held[-1] is None
    for known in ({"theta0": scan.pose}, {}):
        fitter.fit_scan(scan.points, **known)
        prior, noise, before, after = told.pop()
        assert prior is fitter.pose_prior_ and noise > 0 and not told
        np.testing.assert_array_equal(held[-1][1], prior.of(noise)[1])
    assert np.abs(after.coefficients - before.coefficients).max() > 0 < np.abs(after.theta - before.theta).max()
    fitter.pose_prior_ = None
    fitter.fit_scan(scan.points)
    assert not told and held[-1] is None


@pytest.mark.study
def test_scans_of_somebody_else_are_nearer_to_the_truth_for_what_was_learned_of_poses(tube_rig, tube_fitter, monkeypatch):
    """Poses that vary little in all joints but one, for which few starts do; 150 noisy points each."""
    monkeypatch.setitem(EFFORTS, "fast", HURRIED)
    rng, turning = np.random.default_rng(2), Layout(tube_rig, ("pose",), 0).turning
    spread = np.where(np.arange(len(turning)) == 1, 0.3, 0.05)[:, None]
    poses = np.clip(spread * rng.standard_normal((68, *turning.shape)) * turning, tube_rig.lower, tube_rig.upper)
    prior = pose_prior(poses[:60], [np.eye(int(turning.sum())) * 1e-4] * 60, turning, tube_rig.root)
    scans = lbs.synthesize(tube_rig, 8, poses=list(poses[60:]), random_state=5, n_points=150, noise=0.02, shape=0.05)
    known, gaps = {"segmenter": tube_fitter.segmenter_, "library": tube_fitter.regressor_}, []
    for given in (None, prior):
        fit = ScanFit(Model(tube_rig), FitSettings(effort="fast"), prior=given, **known)
        gaps.append(mean_gap(tube_rig, [fit.fit(s.points, random_state=0) for s in scans], scans, "vertices"))
    assert gaps[1] < 0.95 * gaps[0]


@pytest.mark.slow
def test_several_people_that_pass_for_one_are_noticed(make_learner, learned_people, people_scans, monkeypatch):
    """Their joints are worse than with subjects; the results say that they are doubtful, and a warning says what to do."""
    rounds_are_short(monkeypatch)
    scans = [s.points for s in people_scans[:6]]
    with pytest.warns(UserWarning, match=r"of 6 scans do not match their subject's template; are they of several people\? Name "):
        mixed = make_learner(variant="cd").fit(scans)
    odd = [r.evidence["proportions"] > SOMEBODY_ELSE for r in mixed.results_]
    assert sum(odd) > 1
    assert all(r.probability <= 0.25 and "of somebody else" in r.message for r, is_odd in zip(mixed.results_, odd) if is_odd)
    assert not any(r.evidence["proportions"] > SOMEBODY_ELSE for r in learned_people.results_ if r is not None)


@pytest.mark.parametrize("whose, somebody_else", [("own", False), ("slimmer", True)])
def test_somebody_else_is_told_by_proportions(tube_rig, whose, somebody_else):
    slimmer = tube_rig.vertices * [0.7, 1.0, 0.7], tube_rig.joints
    templates = [(tube_rig.vertices, tube_rig.joints) if whose == "own" else slimmer]
    for scan in lbs.synthesize(tube_rig, 2, templates=templates, random_state=3, n_points=400):
        fit, found = TemplateFit(tube_rig, Model(tube_rig), FitSettings()), found_at_the_truth(tube_rig, scan)
        assert (fit.proportions(found.problem, found.state) > SOMEBODY_ELSE) == somebody_else


@pytest.mark.parametrize("scale, free", [("estimate", {"pose", "translation", "scale"}), ("fixed", {"pose", "translation"})])
def test_proportions_cost_what_they_deviate(tube_rig, scale, free, monkeypatch):
    """The share is of what is left unexplained and of ridge ‖c‖² together; where the scale may change, it does in both."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=400)
    fit, found = TemplateFit(tube_rig, Model(tube_rig), FitSettings(scale=scale)), found_at_the_truth(tube_rig, scan)
    told = {}

    def minimise(problems, states, labels, free, shared, iterations, priors):
        told["shared"] = set(free)
        c = np.zeros(found.state.coefficients.shape)
        c.flat[:2] = 3.0, 4.0
        assert shared and len(problems) == 1
        return [found.state.replace(coefficients=c)], [1.0]

    def pose(problem, state, **options):
        told["pose"] = set(options["free"])
        return state, 100.0

    steps = fit._proportioned._steps
    monkeypatch.setattr(steps, "_minimise", minimise)
    monkeypatch.setattr(steps, "pose", pose)
    monkeypatch.setattr(steps, "ridge", 2.0)
    assert fit.proportions(found.problem, found.state) == pytest.approx(1 - (1.0 + 2.0 * 25.0) / 100.0)
    assert told == {"shared": free, "pose": free}
