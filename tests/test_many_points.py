"""Scans of more points than take part in the search: which of the others the last steps look at, and what that brings."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import collected, learning_is_hurried, mean_gap

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting import scan_fit
from lbsfit_np.fitting.drawn import PosePrior
from lbsfit_np.fitting.template import shared_template
from lbsfit_np.fitting.template_fit import TemplateFit
from lbsfit_np.learning.tasks import Drawn, Pose, Template, Told
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout
from lbsfit_np.starts import clean
from lbsfit_np.starts.clean import TakingPart, taking_part

MOST = 400


def _part(points, rig, seed=0, **options):
    return taking_part(points, rig, most=MOST, rng=np.random.default_rng(seed), scale="estimate", **options)


@pytest.mark.parametrize("n, more", [(MOST, 0), (1000, 600), (4000, 3 * MOST)])
def test_the_last_steps_look_at_up_to_four_times_as_many_points(n, more, tube_rig):
    (scan,) = lbs.synthesize(tube_rig, random_state=1, n_points=n, density=0.0)
    part = _part(scan.points, tube_rig)
    assert len(part.rows) == MOST and 0.98 * more <= len(part.more) <= more
    assert not np.intersect1d(part.rows, part.more).size
    np.testing.assert_array_equal(part.every, np.sort([*part.rows, *part.more]))
    np.testing.assert_array_equal(part.more, _part(scan.points, tube_rig).more)
    if n == 4000:
        assert not np.array_equal(part.more, _part(scan.points, tube_rig, seed=1).more)


def test_no_more_points_come_of_a_floor_or_from_elsewhere(tube_rig):
    """Nor those that weigh nothing."""
    rng = np.random.default_rng(2)
    (scan,) = lbs.synthesize(tube_rig, random_state=1, n_points=3000)
    low = scan.points[:, 1].min()
    floor = np.column_stack([rng.uniform(-2, 2, 3000), low + 0.005 * rng.standard_normal(3000), rng.uniform(-2, 2, 3000)])
    wild = np.array([[50.0, 0.0, 0.0], [0.0, 1e200, 0.0]] * 20) * rng.uniform(0.5, 1.5, (40, 1))
    points, weights = np.vstack([scan.points, floor, wild]), np.ones(6040)
    weights[:1000] = 0.0
    part = _part(points, tube_rig, ups=np.array([[0.0, 1.0, 0.0]]), point_weights=weights)
    assert "of a floor" in part.note and len(part.more) > MOST
    assert np.mean(part.more >= 3000) < 0.02 and part.more.max() < 6000 and part.every.min() >= 1000
    left_out = part.left_out(points)
    assert left_out[:1000].all() and left_out[6000:].all() and not left_out[part.every].any()
    assert left_out[1000:3000].mean() < 0.1 and left_out[3000:6000].mean() > 0.98


@pytest.mark.parametrize("usual", [1.0, 1e-300, 1e306])
def test_points_of_next_to_no_weight_take_no_part(usual, tube_rig):
    """In the search, and in what is found to be clean, they would count as others do."""
    (scan,) = lbs.synthesize(tube_rig, random_state=1, n_points=500)
    weights = np.full(500, usual)
    weights[:100], weights[100:200], weights[200:203] = 0.009 * usual, 0.011 * usual, 50.0 * usual
    part = _part(scan.points, tube_rig, point_weights=weights)
    assert part.every.min() == 100 and len(part.every) == 400 and part.left_out(scan.points)[:100].all()
    assert part.note == "100 points of next to no weight left out" and not part.is_clutter(part.left_out(scan.points)).any()
    weights[:] = usual
    weights[:5] = 1e300 if usual == 1.0 else 300 * usual  # a few that weigh very much leave the others
    assert len(_part(scan.points, tube_rig, point_weights=weights).every) == 500
    weights[3:], weights[:3] = 1e-6 * usual, usual
    assert len(_part(scan.points, tube_rig, point_weights=weights).every) == 500
    weights[:] = 0.0
    with pytest.raises(InputError, match="point_weights: got all zeros"):
        _part(scan.points, tube_rig, point_weights=weights)


def test_all_that_is_left_out_is_counted_where_not_all_was_looked_at(tube_rig):
    (scan,) = lbs.synthesize(tube_rig, random_state=1, n_points=2000, holes=0, density=0.0)
    points, weights = np.vstack([scan.points, np.zeros((300, 3))]), np.ones(2300)
    weights[:50] = 0.0
    for among in (None, np.arange(2300) % 2 == 0):
        part = _part(points, tube_rig, point_weights=weights, among=among)
        out = part.left_out(points)
        assert part.is_clutter(out)[2000:].all() and not part.is_clutter(out)[:50].any()
        assert part.told(out) == f"{part.note}, {out.sum() - 50} of all 2300" and out[2000:].all()
    assert _part(points[50:400], tube_rig).told(np.zeros(350, bool)) == ""  # all was looked at
    part = _part(scan.points, tube_rig, point_weights=np.where(np.arange(2000) < 50, 1e-6, 1.0))
    assert (part.known == -1).any() and part.told(part.left_out(scan.points)) == "50 points of next to no weight left out"


def test_of_points_that_were_not_looked_at_some_may_be_of_the_body():
    """Unless some that were are none of it; what lies beyond the rig is left out by where it is, and tells nothing of others."""
    left_out, known = np.array([False, True, True, True]), np.array([1, -1, -3, -2], np.int8)
    part = TakingPart(np.array([0]), np.empty(0, int), "", 1.0, None, known)
    assert part.is_clutter(left_out).tolist() == [False, False, False, True]
    known = np.append(known, 0).astype(np.int8)
    left_out = np.append(left_out, True)
    assert replace(part, known=known).is_clutter(left_out).tolist() == [False, True, False, True, True]
    beyond = replace(part, known=known, among=np.array([True, True, True, True, False]))
    assert beyond.is_clutter(left_out).tolist() == [False, False, False, True, True]


def test_points_that_were_not_looked_at_are_judged_by_those_that_were(tube_rig, monkeypatch):
    """In pieces, so that millions of them fill no memory; no further than points that are kept are from each other."""
    rng = np.random.default_rng(4)
    (scan,) = lbs.synthesize(tube_rig, random_state=1, n_points=3000)
    points = np.vstack([scan.points, scan.points[:500] + 0.2 * rng.standard_normal((500, 3))])
    part = _part(points, tube_rig)
    kept, dropped, asked = part.rows, np.flatnonzero(part.known == 0), np.flatnonzero(part.known == -1)
    apart = np.sort(np.linalg.norm(points[kept][:, None] - points[kept], axis=2), axis=1)[:, 1].max()
    away, beside = (np.linalg.norm(points[asked][:, None] - points[rows], axis=2).min(axis=1) for rows in (kept, dropped))
    expected = part.known != 1
    expected[asked] = (away > apart) | (away >= beside)
    assert len(dropped) > 10 and 0.02 < expected[asked].mean() < 0.5
    for at_once in (200_000, 100):
        monkeypatch.setattr(clean, "_AT_ONCE", at_once)
        np.testing.assert_array_equal(part.left_out(points), expected)


@pytest.mark.slow
def test_more_points_tell_the_pose_better(tube_rig, fitter, monkeypatch):
    """Scans of 4,000 noisy points, of which 400 take part in the search; it begins at the truth, as only its end is asked for."""
    scans = lbs.synthesize(tube_rig, 4, random_state=5, n_points=4000, noise=0.02, shape=0.0)
    fitter.set_params(max_points=MOST)

    def fitted():
        return [fitter.fit_scan(s.points, labels=s.labels, theta0=s.pose) for s in scans]

    with_all = fitted()
    monkeypatch.setattr(scan_fit, "all_points", lambda points, part, weights, frame, problem: (part.rows, problem))
    without = fitted()
    assert mean_gap(tube_rig, with_all, scans) < 0.85 * mean_gap(tube_rig, without, scans)


@pytest.mark.study
def test_more_points_tell_the_proportions_better(monkeypatch):
    """Of single scans of other people, labels known: with the last steps of proportions, and without."""
    rig = lbs.load_rig("body-coarse")
    scans = lbs.synthesize(rig, 4, random_state=6, n_points=4000, noise=0.01, shape=0.1)

    def fitted():
        fitter = lbs.LBSFitter(rig, max_points=MOST, random_state=0)
        return [fitter.fit_scan(s.points, labels=s.labels) for s in scans]

    with_all = fitted()
    as_it_is = SimpleNamespace(to_the_end=lambda problem, state, **known: (state, 0.0))
    monkeypatch.setattr(scan_fit.ScanFit, "_with_proportions", as_it_is)
    without = fitted()
    for what in ("joints", "vertices"):
        assert mean_gap(rig, with_all, scans, what) < 0.93 * mean_gap(rig, without, scans, what)


@pytest.mark.parametrize("known", ["nothing", "labels", "some labels", "no polish"])
def test_last_steps_of_proportions_go_by_what_is_known(known, tube_rig, tube_fitter, monkeypatch):
    """By all points; labels where all are known, what is known of poses where none are."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=5, n_points=2000)
    steps, drawings = [], []

    def to_the_end(problem, state, *, labels=None):
        steps.append((len(problem.X), labels))
        return state, 0.0

    def drawn(refit, problem, state, prior, with_proportions):
        drawings.append(len(problem.X))
        assert with_proportions.to_the_end is to_the_end
        return state, {"prior": None}

    monkeypatch.setattr(scan_fit.ScanFit, "_with_proportions", SimpleNamespace(to_the_end=to_the_end))
    monkeypatch.setattr(scan_fit, "drawn_by_itself", drawn)
    some = np.where(np.arange(2000) % 2, scan.labels, -1)
    labels = {"labels": scan.labels, "some labels": some}.get(known)
    settings = scan_fit.FitSettings(max_points=MOST, effort="fast", polish=0 if known == "no polish" else 12)
    turning = Layout(tube_rig, ("pose",), 0).turning
    prior = PosePrior(np.zeros(turning.shape), np.zeros((int(turning.sum()),) * 2))
    given = {"segmenter": tube_fitter.segmenter_, "library": tube_fitter.regressor_}
    fit = scan_fit.ScanFit(Model(tube_rig), settings, prior=prior, **given)
    fit.fit(scan.points, labels=labels, random_state=0)
    if known == "nothing":
        assert len(drawings) == 1 and drawings[0] > 3 * MOST and not steps
    elif known == "no polish":
        assert not drawings and not steps
    else:
        ((n, parts),) = steps
        every = fit.taking_part(scan.points, random_state=0, labels=labels).every
        assert n == len(every) > 3 * MOST and not drawings
        np.testing.assert_array_equal(parts, scan.labels[every] if known == "labels" else None)


def test_known_labels_and_weights_of_more_points_count(tube_rig, monkeypatch):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=5, n_points=2000)
    told = {}

    def polish(self, problem, state, *, labels=None, **more):
        told.update(n=len(problem.X), labels=labels, weights=problem.x_weights)
        return state

    monkeypatch.setattr("lbsfit_np.fitting.refit.Refit.polish", polish)
    looked_at = []

    def looking(*given, **more):
        looked_at.append(taking_part(*given, **more))
        return looked_at[-1]

    monkeypatch.setattr(scan_fit, "taking_part", looking)
    weights = np.linspace(1.0, 3.0, 2000)
    fitter = lbs.LBSFitter(tube_rig, max_points=MOST, random_state=0)
    fitter.fit_scan(scan.points, labels=scan.labels, point_weights=weights)
    every = looked_at[-1].every
    assert told["n"] == len(every) > 3 * MOST
    np.testing.assert_array_equal(told["labels"], scan.labels[every])
    np.testing.assert_allclose(told["weights"], weights[every] / weights[every].sum())


def test_where_all_labels_are_known_of_what_takes_part_those_of_more_points_are_known(tube_rig):
    """A point of which it is not known would have all steps go without labels."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=5, n_points=2000)
    rows = _part(scan.points, tube_rig).rows
    labels = scan.labels.copy()
    labels[np.setdiff1d(np.arange(2000), rows)[::2]] = -1
    part = _part(scan.points, tube_rig, labels=labels)
    np.testing.assert_array_equal(part.rows, rows)
    assert len(part.more) > MOST and labels[part.every].min() >= 0
    labels[rows[0]] = -1  # then they go without anyway
    assert (labels[_part(scan.points, tube_rig, labels=labels).more] < 0).any()


def test_scans_of_a_collection_have_more_points_in_their_frame(tube_rig):
    scans = lbs.synthesize(tube_rig, 3, random_state=5, n_points=2000)
    collection = collected(tube_rig, [s.points for s in scans], max_points=MOST, held_out=0)
    m = collection.members[0]
    m.use_frame(1.0, tube_rig.size / 2)
    assert len(m.X) == MOST and len(m.dense_X) == len(m.part.every) > 3 * MOST
    np.testing.assert_allclose(m.dense_X[np.searchsorted(m.part.every, m.part.rows)], m.X)


@pytest.mark.slow
def test_templates_and_last_poses_of_learning_and_after_it_see_more_points(make_learner, few_scans, monkeypatch):
    learning_is_hurried(monkeypatch)
    seen = {}

    def watch(owner, name, what):
        call = getattr(owner, name)

        def watching(self, *given, **more):
            seen.setdefault(name if name != "__call__" else owner.__name__, []).append(what(*given, **more))
            return call(self, *given, **more)

        monkeypatch.setattr(owner, name, watching)

    watch(Template, "__call__", lambda task: [len(X) for X in task[1]])
    watch(Told, "__call__", lambda task: len(task[1]))
    watch(Drawn, "__call__", lambda task: (len(task[1]), len(task[2])))
    watch(Pose, "__call__", lambda task: len(task[1]))
    watch(TemplateFit, "finish", lambda problem, state, *, dense, **more: (len(problem.X), len(dense[0]), len(dense[1].X)))
    n = [len(s.points) for s in few_scans]
    fitter = make_learner(max_points=150).fit([s.points for s in few_scans[:4]])
    first, *in_turn = seen["Template"]
    assert len(first) == 3 and min(first) > 300 and in_turn == [first, first] and set(seen["Pose"]) == {150}  # one is held out
    assert min(seen["Told"]) > 300 and all(few == 150 and many > 300 for few, many in seen["Drawn"])
    assert all(few == 150 and 300 < rows == many <= max(n) for few, rows, many in seen["finish"]) and len(seen["finish"]) == 4
    fitter.fit_scan(few_scans[4].points)
    few, rows, many = seen["finish"][-1]
    assert len(seen["finish"]) == 5 and few == 150 and 300 < rows == many


def test_a_template_of_more_points_is_nearer_to_the_true_one(tube_rig):
    model = Model(tube_rig, shifts=0.1)
    person = tube_rig.subject(3, amount=1.0)
    scans = lbs.synthesize(
        tube_rig, 6, templates=[(person.vertices, person.joints)], random_state=4, n_points=4000, noise=0.03, shape=0.0
    )
    half = tube_rig.size / 2
    states = [model.rest().replace(theta=s.pose, translation=s.translation / half) for s in scans]
    dense = [Problem(s.points / half) for s in scans]
    few = [p.thinned(300) for p in dense]
    gaps = []
    for known in ({}, {"dense": dense}):
        U, _, _ = shared_template(model, few, states, np.ones(6), **known)
        away = U[tube_rig.weld] - person.vertices
        gaps.append(np.linalg.norm(away - away.mean(axis=0), axis=1).mean())
    assert gaps[1] < 0.8 * gaps[0]


@pytest.mark.parametrize("most", [150, 2500])
def test_variants_without_a_prior_go_on_with_all_points_too(most, make_learner, few_scans, monkeypatch):
    """Else what they lack beside others would be points, not what all poses tell."""
    learning_is_hurried(monkeypatch)
    drawn = []
    monkeypatch.setattr("lbsfit_np.learning.tasks.drawn", lambda *given: drawn.append(given))
    polished, polish = [], Told.__call__
    monkeypatch.setattr(Told, "__call__", lambda self, task: polished.append(len(task[1])) or polish(self, task))
    fitter = make_learner(variant="cd", max_points=most).fit([s.points for s in few_scans[:3]])
    assert len(polished) == 9 and min(polished) > 300  # on three templates each
    assert not drawn and fitter.pose_prior_ is None
