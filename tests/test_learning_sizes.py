"""New scans on templates of another size than the rig's: units are compared, and s and the library asked, at the right size."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import found_at_the_truth
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.fitting.scan_fit import given_views
from lbsfit_np.learning import new_scan
from lbsfit_np.learning.parameters import fit_settings
from lbsfit_np.starts.turns import Facing

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("size", [1.25, 0.8])
@pytest.mark.parametrize("factor, known", [(1.0, True), (1.1, True), (0.9, True), (1.5, False), (0.6, False)])
def test_a_scans_unit_is_compared_with_the_learned_one_by_the_size_of_the_subjects_template(tube_rig, size, factor, known):
    """What was seen on the rig's own template is ``size`` times as large on one of that size."""
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    grown = tube_rig.with_template(size * tube_rig.vertices, size * tube_rig.joints)
    fitter.template_, fitter.unit_ = {"ann": grown}, {"ann": 1.0}
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=400, shape=0.0)
    seen = found_at_the_truth(tube_rig, scan)
    seen = replace(seen, frame=replace(seen.frame, unit=factor * size * seen.frame.unit), rivals=())
    begun = new_scan._begun(fitter, "ann", seen, fit_settings(fitter))
    assert begun.in_unit == known
    assert begun.frame.unit == pytest.approx((1.0 if known else factor) * tube_rig.size / 2)
    # Where the unit is found, what is known of the fit is of the scan's own half sizes.
    found = new_scan._gone_on(fitter, begun, seen, fit_settings(fitter))
    assert found.state.scale == 1.0
    np.testing.assert_allclose(found.frame.outside(found.problem.X), seen.frame.outside(seen.problem.X), atol=1e-9)
    if not known:
        assert found.frame.unit == pytest.approx(factor * tube_rig.size / 2, rel=0.05)
    refit = new_scan._template_fit(fitter, "ann", fit_settings(fitter)).refit
    assert found.value == pytest.approx(refit.chamfer(found.problem, refit._mine(found.state)))


def test_a_scan_whose_bends_have_changed_its_unit_is_put_into_that(tube_rig, monkeypatch):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=100)
    seen = replace(found_at_the_truth(tube_rig, scan), value=0.5, rivals=(1.0,))
    bent = SimpleNamespace(free=seen.free, bent=lambda problem, state: (state.replace(scale=2.0), 0.4))
    monkeypatch.setattr(new_scan, "_template_fit", lambda *known: SimpleNamespace(refit=bent))
    ((subject, found),) = new_scan._bent(None, [("ann", seen)], seen, None)
    assert subject == "ann" and found.state.scale == 1.0 and found.frame.unit == 2 * seen.frame.unit
    assert found.value == pytest.approx(0.1) and found.rivals == pytest.approx([0.2])
    np.testing.assert_allclose(found.problem.X, seen.problem.X / 2)


@pytest.mark.parametrize("variant, size", [("joint", 1.0), ("pose-only", 1.25), ("rand", 1.25)])
def test_what_has_learned_from_the_rigs_size_is_asked_at_that(variant, size, tube_rig, monkeypatch):
    """By a scan on the one template, and by one with a start."""
    fitter = lbs.LBSFitter(tube_rig, random_state=0, variant=variant)
    grown = tube_rig.with_template(1.25 * tube_rig.vertices, 1.25 * tube_rig.joints)
    fitter.template_, fitter.unit_, made = {"ann": grown}, {"ann": 1.0}, []
    library = SimpleNamespace(starts=lambda *given, **sizes: [SimpleNamespace(scale=1.4 * size)])
    fitter.segmenter_, fitter.regressor_ = None, library
    monkeypatch.setattr(new_scan, "Scout", lambda *given, **known: lambda x, a, *, once: made.append(known))
    x = np.random.default_rng(0).standard_normal((50, 3))
    new_scan._scouted(fitter, "ann", x, None, fit_settings(fitter), once=True)
    library.starts = lambda *given, **sizes: [SimpleNamespace(scale=1.2 * size)]
    new_scan._scouted(fitter, "ann", x, None, fit_settings(fitter), once=True)
    assert [known["size"] for known in made] == pytest.approx([size, size])
    assert [known["unit"] for known in made] == [None, 1.0]  # by what the subject is, whatever the library has learned from
    asked = []
    monkeypatch.setattr(new_scan, "given_views", lambda *known, size: asked.append((known[4], size)) or iter(()))
    for guess in (1.0, 1.36, 100.0):  # in the learned unit, if the extents say so, or as they do
        with pytest.raises(AttributeError):  # of no views none is the best
            new_scan._given(fitter, "ann", x, None, fit_settings(fitter), guess, np.zeros((4, 3)), None)
    assert np.ravel(asked) == pytest.approx([1.0, size, 1.36, size, 100.0, size])


def test_where_a_start_has_shown_one_template_the_others_are_tried_from_there(tube_rig, monkeypatch):
    """Sizes are then to be compared with that template's, not with the rig's."""
    sizes, tried = {"big": 1.25, "own": 1.0, "mid": 0.9, "small": 0.75}, []
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    fitter.template_ = {s: tube_rig.with_template(k * tube_rig.vertices, k * tube_rig.joints) for s, k in sizes.items()}
    fitter.unit_, fitter.segmenter_, fitter.regressor_ = dict.fromkeys(sizes, 1.0), None, object()
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=400, shape=0.0)
    seen, begun = found_at_the_truth(tube_rig, scan), new_scan._begun  # in unit 1, on the big one's template

    def watched(fitter, subject, seen, settings, size, **sized):
        b = begun(fitter, subject, seen, settings, size, **sized)
        if sized:
            return replace(b, left=np.inf)
        tried.append((subject, b.frame.unit / (tube_rig.size / 2) if not b.in_unit else 1.0))
        return b

    monkeypatch.setattr(new_scan, "_given", lambda *known: seen)
    monkeypatch.setattr(new_scan, "_begun", watched)

    def nearest(*found):
        raise StopIteration  # that is all that is asked for here

    monkeypatch.setattr(new_scan, "_nearest", nearest)
    with pytest.raises(StopIteration):
        new_scan.fit_new(fitter, scan.points, list(sizes), np.zeros((4, 3)), None, None)
    # 1.25 / 0.9 is another size, 1.25 / 1.0 is not.
    assert dict(tried) == pytest.approx({"big": 1.0, "own": 1.0, "mid": 1.25 / 0.9, "small": 1.25 / 0.75})


def test_the_views_of_a_start_are_labelled_at_the_size_that_the_segmenter_has_learned(tube_rig):
    asked = []

    def said(points, *, scale, views):
        asked.append(scale)
        return np.full((len(points), 4), 0.25)

    x, known = np.random.default_rng(0).standard_normal((50, 3)), (SimpleNamespace(predict_proba=said), np.zeros((4, 3)), None)
    for size in (1.0, 1.25):
        ((_, _, proba, _),) = given_views(tube_rig, Facing(), x, None, 1.0, *known, size=size)
        assert proba.shape == (50, 4)
    assert asked == [1.0, 1.25]


def _miss(rig, result, scan, factor):
    """Mean distance of the joints from the truth, in half sizes."""
    return np.linalg.norm(result.joints / factor - scan.joints, axis=1).mean() / (rig.size / 2)


@pytest.mark.parametrize("given", [(), slow(("theta0",)), slow(("labels",))])
@pytest.mark.parametrize("factor", [slow(0.6), slow(0.85), 1.1, slow(1.2), slow(1.5)])
def test_a_learned_subject_of_another_size_is_fitted_at_that(factor, given, tube_rig, learned_people, people_scans):
    """Of a size within what people differ by, which the learned unit allows, too, and with a start or labels of any."""
    s = people_scans[12]
    known = {"theta0": s.pose, "labels": s.labels}
    r = learned_people.fit_scan(factor * s.points, subject="ann", **{name: known[name] for name in given})
    assert r.status == "ok" and _miss(tube_rig, r, s, factor) < 0.03
    ratio = r.scale / learned_people.unit_["ann"]
    assert ratio == pytest.approx(factor, rel=0.02)
    assert (f", and it is {ratio:.3g} times as large as learned" in r.message) == (factor > 0.65)  # else in another unit


def test_a_subject_of_the_learned_size_keeps_it(learned_people, people_scans):
    fitter = copy.copy(learned_people)
    for name in ("ann", None):
        r = fitter.fit_scan(people_scans[12].points, **({} if name is None else {"subject": name}))
        assert r.scale == pytest.approx(fitter.unit_["ann"], rel=1e-9) and "as large as learned" not in r.message
    r = fitter.set_params(scale="fixed").fit_scan(1.1 * people_scans[12].points, subject="ann")
    assert r.scale == pytest.approx(1.0, rel=1e-9) and "as large as learned" not in r.message


@pytest.mark.parametrize("better", [True, False])
def test_a_size_that_has_hidden_the_pose_is_found_if_the_fit_is_in_doubt(
    better, tube_rig, learned_people, people_scans, monkeypatch
):
    """In the learned unit the search ends in a wrong pose, from which no other size looks much better."""
    s, fitter, asked = people_scans[12], copy.copy(learned_people), []
    monkeypatch.setattr(new_scan, "_of_its_size", lambda fitter, subject, found, settings, find: found)
    scouted = new_scan._scouted

    def wrong_at_first(*known, sized=False, **more):
        asked.append(sized)
        found = scouted(*known, sized=sized, **more)
        behind = found.state.theta.copy()
        behind[0] += [0.0, np.pi, 0.0]
        wrong = found.state.replace(theta=behind)
        return found if sized and better else replace(found, state=wrong)

    monkeypatch.setattr(new_scan, "_scouted", wrong_at_first)
    r = fitter.fit_scan(1.1 * s.points, subject="ann")
    assert asked[:2] == [False, True]
    assert (_miss(tube_rig, r, s, 1.1) < 0.03) == better


def test_what_a_rig_says_beyond_its_shape_may_be_said_after_learning(tube_rig, learned_people, people_scans):
    """Its unit and its up axis are no part of what tells one rig from another."""
    fitter = copy.copy(learned_people)
    settings = fit_settings(fitter)
    before = new_scan._template_fit(fitter, "ann", settings)
    other = replace(tube_rig, metres_per_unit=0.25, up="+x", forward="+z")
    assert other.digest == tube_rig.digest
    fitter.set_params(rig=other)
    after = new_scan._template_fit(fitter, "ann", settings)
    assert after is not before and after.model.source.metres_per_unit == 0.25 and after.model.source.up == "+x"
    np.testing.assert_array_equal(after.model.rig.vertices, before.model.rig.vertices)
    r = fitter.set_params(unit="m").fit_scan(0.25 * people_scans[12].points, subject="ann")
    assert r.status == "ok" and "the scan is in metres" in r.message


def test_who_it_is_may_show_at_a_size_of_its_own_alone(tube_rig):
    """At the learned size somebody else, who is longer, comes nearer to ann, grown by a fifth, than ann does."""
    bob = tube_rig.with_template(tube_rig.vertices * [1.2, 1.12, 1.2], tube_rig.joints * [1.2, 1.12, 1.2])
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    fitter.template_, fitter.unit_ = {"ann": tube_rig, "bob": bob}, dict.fromkeys(("ann", "bob"), 1.0)
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=800, shape=0.0)
    seen = found_at_the_truth(tube_rig, replace(scan, points=1.2 * scan.points))
    settings = fit_settings(fitter)
    begun = [new_scan._begun(fitter, s, seen, settings) for s in ("ann", "bob")]
    assert all(b.in_unit for b in begun) and begun[0].left > 1.3 * begun[1].left
    assert new_scan._suiting(fitter, ["ann", "bob"], seen, settings)[0].subject == "ann"
    fixed = replace(settings, scale="fixed")
    assert new_scan._suiting(fitter, ["ann", "bob"], seen, fixed)[0].subject == "bob"


def test_rivals_are_as_near_after_a_size_of_its_own(tube_rig):
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    fitter.template_, fitter.unit_ = {"ann": tube_rig}, {"ann": 1.0}
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=800, shape=0.0)
    seen, settings = found_at_the_truth(tube_rig, replace(scan, points=1.2 * scan.points)), fit_settings(fitter)
    refit = new_scan._template_fit(fitter, "ann", settings).refit
    state, _ = refit.to_the_end(seen.problem, seen.state)
    held = replace(seen, state=state, value=refit.chamfer(seen.problem, state), free=refit.free)
    held = replace(held, rivals=(1.5 * held.value, 4.0 * held.value))
    found = new_scan._of_its_size(fitter, "ann", held, settings, lambda *_, **sized: replace(held, value=np.inf))
    assert "scale" in found.free and found.value < 0.5 * held.value
    assert found.rivals == pytest.approx([1.5 * found.value, 4.0 * found.value])
