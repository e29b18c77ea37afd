"""A fitter that has learned, and scans that are new to it: whose they are, their starts, labels, unit and turn."""

import copy
import warnings
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import NAN, SMALL, found_at_the_truth, mean_gap
from sklearn.exceptions import NotFittedError
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.template_fit import TemplateFit
from lbsfit_np.learning import batch, new_scan, sizes
from lbsfit_np.learning.parameters import fit_settings
from lbsfit_np.rotations import matrix_from_rotvec


@pytest.mark.slow
def test_new_scans_find_their_subject(tube_rig, learned_people, unlearned, people_scans):
    found = []
    for k in (10, 11):
        own, other = ("ann", "bob") if k % 2 == 0 else ("bob", "ann")
        r = learned_people.fit_scan(people_scans[k].points)
        assert f"on the template of subject {own!r}" in r.message and r.subject == own
        found.append(r)
        named = learned_people.fit_scan(people_scans[k].points, subject=own)
        assert mean_gap(tube_rig, [r], [named], "vertices") < 0.005  # the same fit, but for where it began
        wrong = learned_people.fit_scan(people_scans[k].points, subject=other)
        assert repr(other) in wrong.message and wrong.subject == other and wrong.probability < r.probability
    by_objective = copy.copy(unlearned).set_params(registration=False)
    single = [by_objective.fit_scan(s.points) for s in people_scans[10:12]]
    assert mean_gap(tube_rig, found, people_scans[10:12]) < min(0.006, 0.6 * mean_gap(tube_rig, single, people_scans[10:12]))


@dataclass(frozen=True)
class _Alone:
    """What a fit of a scan by itself is told."""

    message: str
    found: object
    seconds: float = 0.0
    status: str = "ok"
    subject: str = ""
    evidence: dict = field(default_factory=dict)


ASKS = "; if you know who it is, name the subject (--subject, --subjects)"


@pytest.mark.parametrize("whose, somebody_else", [("ann", False), ("bob", False), ("bob", True)])
def test_a_scan_is_looked_at_once_however_many_subjects_there_are(tube_rig, people, whose, somebody_else, monkeypatch):
    template = people[whose].vertices, people[whose].joints
    (scan,) = lbs.synthesize(tube_rig, 1, templates=[template], random_state=3, n_points=300)
    fitter = lbs.LBSFitter(tube_rig, random_state=0, effort="fast")  # which looks for nothing beyond the rig
    fitter.template_, fitter.unit_ = people, dict.fromkeys(people, 1.0)
    fitter.segmenter_, fitter.regressor_, fitter.pose_prior_ = None, object(), None
    seen, looks, alone, given = found_at_the_truth(tube_rig, scan), [], {"status": "ok"}, {}

    def look(points, x_weights, *, once):
        looks.append(points)
        return seen

    def fit(points, found, **more):
        given.update(more)
        return _Alone("by itself", found, **alone)

    by_itself = SimpleNamespace(scout=look, fit=fit)
    monkeypatch.setattr(new_scan, "scan_fit", lambda *made_of: by_itself)
    monkeypatch.setattr(new_scan, "_scouted", lambda fitter, subject, x, a, settings, *, once: look(x, a, once=once))
    monkeypatch.setattr(TemplateFit, "proportions", lambda *known: 0.31 if somebody_else else 0.29)
    wild = np.vstack([scan.points, [[99.0, 0.0, 0.0]]])  # which takes no part
    r = new_scan.fit_new(fitter, wild, list(people), None, None, None)
    assert len(looks) == 1 and len(looks[0]) == 300
    if not somebody_else:
        assert f"on the template of subject {whose!r}" in r.message
        return
    words = "by itself; proportions of its own explain it much better than {}: is it a scan of somebody else?"
    several = words.format(f"the template of {whose!r}, the nearest one")
    assert r.found is seen and r.message == several  # what was seen is not looked for again
    np.testing.assert_array_equal(given["part"].rows, np.arange(300))
    for alone["status"] in ("suspect", "failed"):
        assert new_scan.fit_new(fitter, scan.points, list(people), None, None, None).message == several + ASKS
    fitter.template_ = {"ann": people["ann"]}
    assert new_scan.fit_new(fitter, scan.points, ["ann"], None, None, None).message == words.format("the learned template")


@pytest.mark.parametrize(
    "ann, bob, better",
    [
        ((4e-3, 1.0), (1e-3, 1000.0), "ann"),  # metres and millimetres
        ((4e-3, 1.0), (3e-3, 1.2), "ann"),
        ((4e-3, 1.0), (3e-3, 1.1), "bob"),
    ],
)
def test_templates_are_compared_in_the_scans_unit(tube_rig, people, ann, bob, better, monkeypatch):
    """(E in the normalised frame, scan units in a rig unit) of each: it goes by the square of the frame's unit."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=100)
    fitter = lbs.LBSFitter(tube_rig, random_state=0, effort="fast")
    fitter.template_, fitter.unit_ = people, {"ann": ann[1], "bob": bob[1]}
    fitter.segmenter_, fitter.regressor_, fitter.pose_prior_ = None, object(), None
    seen, told, alone = found_at_the_truth(tube_rig, scan), {}, {"status": "ok"}

    def gone_on(fitter, begun, seen, settings):
        left, unit = {"ann": ann, "bob": bob}[begun.subject]
        state = seen.state.replace(scale=left)
        return replace(seen, value=2 * left, state=state, frame=replace(seen.frame, unit=unit * tube_rig.size / 2))

    def finish_fit(problem, state, **place):
        told.update(place)
        return _Alone("seen", seen, **alone)

    monkeypatch.setattr(new_scan, "scan_fit", lambda *made_of: SimpleNamespace(scout=lambda x, a, *, once: seen))
    monkeypatch.setattr(new_scan, "_begun_in_its_size", lambda f, s, *_: SimpleNamespace(subject=s, left=1.0))
    monkeypatch.setattr(new_scan, "_gone_on", gone_on)
    refit = SimpleNamespace(left=lambda problem, state: state.scale)
    fit = SimpleNamespace(proportions=lambda *of: 0.0, finish=finish_fit, refit=refit)
    monkeypatch.setattr(new_scan, "_template_fit", lambda *made_of: fit)
    assert new_scan.fit_new(fitter, scan.points, ["ann", "bob"], None, None, None, anyone=False).message == "seen"
    assert f"on the template of subject {better!r}" in told["notes"]
    assert told["value"] == 2 * {"ann": ann, "bob": bob}[better][0]
    for alone["status"] in ("suspect", "failed"):  # who knows the subject may help
        assert new_scan.fit_new(fitter, scan.points, ["ann", "bob"], None, None, None, anyone=False).message == f"seen{ASKS}"
    monkeypatch.setattr(new_scan, "_scouted", lambda *known, once: seen)
    assert new_scan.fit_new(fitter, scan.points, ["ann"], None, None, None, anyone=False).message == "seen"


@pytest.mark.parametrize("effort, status", [("balanced", "ok"), ("balanced", "suspect"), ("fast", "suspect")])
@pytest.mark.parametrize("own", [None, "ann", "in another bend"])
def test_bends_are_tried_on_templates_unless_all_are_of_other_people_and_the_fit_by_itself_is_sure(
    own, effort, status, tube_rig, people, monkeypatch
):
    """A wrong pose may look like another person's, until bends put it right."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=100)
    fitter = lbs.LBSFitter(tube_rig, random_state=0, effort=effort)
    fitter.template_, fitter.unit_ = people, dict.fromkeys(people, 1.0)
    fitter.segmenter_, fitter.regressor_, fitter.pose_prior_ = None, object(), None
    seen, bent = found_at_the_truth(tube_rig, scan), []

    class Fit:
        def __init__(self, fitter, subject, settings):
            self.subject = subject
            self.refit = SimpleNamespace(free=seen.free, left=lambda *of: 1.0 if subject == "bob" else 2.0, bent=self.bent)

        def bent(self, problem, state):
            bent.append(self.subject)
            return state, 1.0

        def proportions(self, *of):
            return 0.1 if self.subject == own or (own == "in another bend" and bent) else 0.5

        def finish(self, *known, **place):
            return _Alone("on a template", seen)

    by_itself = SimpleNamespace(scout=lambda x, a, *, once: seen, fit=lambda *a, **k: _Alone("by itself", seen, status=status))
    monkeypatch.setattr(new_scan, "scan_fit", lambda *made_of: by_itself)
    monkeypatch.setattr(new_scan, "_begun_in_its_size", lambda fitter, s, *known: SimpleNamespace(subject=s, left=1.0))
    monkeypatch.setattr(new_scan, "_gone_on", lambda fitter, begun, seen, settings: seen)
    monkeypatch.setattr(new_scan, "looked_at_again", lambda part, taking_part, fit, *a, **k: fit(part, False))
    monkeypatch.setattr(new_scan, "_template_fit", Fit)
    found = new_scan.fit_new(fitter, scan.points, ["ann", "bob"], None, None, None).message
    assert bent == ["ann", "bob"] * (effort != "fast" and (status != "ok" or own == "ann"))  # on both, or on none
    mended = own == "in another bend" and bent
    assert found == "on a template" if mended else found.startswith("by itself; proportions of its own explain")


@pytest.mark.parametrize(
    "left, gone_on_with",
    [
        ({"ann": 2.0, "bob": 1.0, "cat": 1.29, "dan": 1.31}, ["bob", "cat"]),
        ({"ann": 1.2, "bob": 1.3, "cat": 1.1, "dan": 1.0}, ["dan", "cat", "ann"]),  # three at most
        ({"ann": 0.0, "bob": 0.0, "cat": 1.0, "dan": 1.0}, ["ann", "bob"]),
    ],
)
def test_templates_that_suit_a_scan_badly_after_a_few_steps_are_not_gone_on_with(left, gone_on_with, monkeypatch):
    monkeypatch.setattr(new_scan, "_begun_in_its_size", lambda f, s, *_: SimpleNamespace(subject=s, left=left[s]))
    monkeypatch.setattr(new_scan, "_gone_on", lambda fitter, begun, seen, settings: begun.left)
    assert new_scan._on_templates(None, list(left), None, None) == [(s, left[s]) for s in gone_on_with]


def test_a_few_steps_tell_whose_template_suits_a_scan_in_any_unit(tube_rig):
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    thin = tube_rig.with_template(tube_rig.vertices * [0.8, 1.0, 0.8], tube_rig.joints)
    fitter.template_, fitter.unit_ = {"thin": thin, "own": tube_rig, "millimetres": tube_rig}, {}
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=800, shape=0.0)
    seen, left = found_at_the_truth(tube_rig, scan), {}
    for unit in (1.0, 1000.0):  # of the scan
        fitter.unit_ = dict.fromkeys(fitter.template_, unit) | {"millimetres": 1000.0}
        found = replace(seen, frame=replace(seen.frame, unit=unit * seen.frame.unit))
        left[unit] = {s: new_scan._begun(fitter, s, found, fit_settings(fitter)).left for s in fitter.template_}
        assert left[unit]["own"] < 0.7 * left[unit]["thin"]
    assert left[1000.0]["own"] == pytest.approx(1e6 * left[1.0]["own"])
    grown = found_at_the_truth(tube_rig, replace(scan, points=1.1 * scan.points))
    fitter.unit_ = {"own": 1.0, "millimetres": 1000.0}
    held, free = (new_scan._begun(fitter, s, grown, fit_settings(fitter)).left for s in ("own", "millimetres"))
    assert free < 0.5 * held  # scale is free where units are apart, and held where they are not
    assert free == pytest.approx(1.21 * left[1.0]["own"], rel=0.05)


def test_views_of_one_side_are_compared_by_what_they_show(tube_rig):
    """What a view does not show is less of a slim person: by both ways of the Chamfer distance she would have been nearer."""
    own = tube_rig.vertices, tube_rig.joints
    slim = tube_rig.vertices * [0.8, 1.0, 0.8], tube_rig.joints
    fitter = lbs.LBSFitter(tube_rig, random_state=0, partial=True)
    fitter.template_, fitter.unit_ = {"own": tube_rig, "slim": tube_rig.with_template(*slim)}, {"own": 1.0, "slim": 1.0}
    settings, found = fit_settings(fitter), {}
    (scan,) = lbs.synthesize(tube_rig, 1, templates=[own], random_state=3, n_points=800, one_sided=True, holes=0, shape=0.0)
    seen = found_at_the_truth(tube_rig, scan)
    for subject in fitter.template_:
        refit = new_scan._template_fit(fitter, subject, settings).refit
        state, value, _ = refit(seen.problem, [refit._mine(seen.state)])
        found[subject] = replace(seen, state=state, value=value)
    assert found["slim"].value < found["own"].value
    left = {subject: new_scan._left(fitter, subject, f, settings) for subject, f in found.items()}
    assert left["own"] < 0.7 * left["slim"]


LEFT = SimpleNamespace(left=lambda problem, state: 0.0)
FASTER = (
    "effort 'balanced' (--effort balanced) looks further, also along other up axes and for what goes on beyond the rig",
)


@pytest.mark.parametrize("status, asks", [("ok", False), ("suspect", True), ("failed", True)])
def test_a_scan_of_somebody_else_than_named_is_told_to_leave_the_name_out(status, asks, tube_rig, people, monkeypatch):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=100)
    fitter = lbs.LBSFitter(tube_rig, random_state=0, effort="fast")
    fitter.template_, fitter.unit_ = people, dict.fromkeys(people, 1.0)
    fitter.segmenter_, fitter.regressor_, fitter.pose_prior_ = None, object(), None
    monkeypatch.setattr(new_scan, "_scouted", lambda *known, once: found_at_the_truth(tube_rig, scan))
    given = []

    def finished(problem, state, **place):
        given.append(place.get("further", ()))
        return _Alone("odd", found_at_the_truth(tube_rig, scan), status=status)

    for proportions in (0.9, 0.0):
        fit = SimpleNamespace(proportions=lambda *of, p=proportions: p, finish=finished, refit=LEFT)
        monkeypatch.setattr(new_scan, "_template_fit", lambda *made_of, fit=fit: fit)
        message = new_scan.fit_new(fitter, scan.points, ["ann"], None, None, None, anyone=False).message
        words = "; without subject (--subject, or its line of --subjects, which may be wrong), the template that fits best is "
        words += "used"
        assert (words in message) == (asks and proportions > 0.5)
    assert given == [(), FASTER]


@pytest.mark.parametrize("given", [False, True])
def test_what_a_scan_stands_along_is_only_said_where_no_start_told_it(tube_rig, people, given, monkeypatch):
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=100)
    fitter = lbs.LBSFitter(tube_rig, random_state=0, effort="fast")
    fitter.template_, fitter.unit_ = people, dict.fromkeys(people, 1.0)
    fitter.segmenter_, fitter.regressor_, fitter.pose_prior_ = None, object(), None
    for look in ("_scouted", "_given"):
        monkeypatch.setattr(new_scan, look, lambda *known, **once: found_at_the_truth(tube_rig, scan))
    monkeypatch.setattr(new_scan, "stands_words", lambda *known: "the scan stands along +z")
    fit = SimpleNamespace(proportions=lambda *of: 0.0, refit=LEFT, finish=lambda problem, state, **place: _Alone("", place))
    monkeypatch.setattr(new_scan, "_template_fit", lambda *made_of: fit)
    made = new_scan.fit_new(fitter, scan.points, ["ann"], scan.pose if given else None, None, None, anyone=False)
    told = made.found
    assert made.subject == "ann"
    assert "on the template of subject 'ann'" in told["notes"] and told.get("further", ()) == (() if given else FASTER)
    assert told["found"] == ("scan and rig are in one unit", "" if given else "the scan stands along +z")


@pytest.mark.parametrize("given", [(), ("theta0",)])
@pytest.mark.parametrize("subject", ["ann", None])
@pytest.mark.parametrize("factor", [1.0, 250.0])
def test_joints_are_told_as_precisely_as_what_was_looked_for_allows(learned_people, people_scans, factor, subject, given):
    """A scale that was found leaves joints less certain than the subject's own."""
    scan, looked_for = people_scans[10], []
    known = dict.fromkeys(given, scan.pose)

    class Spied(Refit):
        def joint_std(self, *told):
            looked_for.append(self.free)
            return super().joint_std(*told)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lbsfit_np.fitting.template_fit.Refit", Spied)
        fitter = copy.copy(learned_people)
        fitter.__dict__.pop("_prepared", None)
        r = fitter.fit_scan(factor * scan.points, subject=subject, **known)
    assert looked_for == [("pose", "translation", *(("scale",) if factor > 1 else ()))]
    assert np.isfinite(r.joint_std).all() and r.subject == "ann"


def test_of_views_from_several_sides_the_one_that_leaves_least_is_taken(tube_rig, people, monkeypatch):
    """By what a view shows, which the value of a refit does not tell."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=3, n_points=100)
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    fitter.template_, fitter.unit_, fitter.segmenter_ = people, dict.fromkeys(people, 1.0), None
    seen = found_at_the_truth(tube_rig, scan)
    first, second, third = (seen.state.replace(scale=scale) for scale in (1.0, 2.0, 0.5))
    ends = iter([(first, 0.1), (second, 0.3), (third, 0.2)])

    class Fake:
        free = ("pose", "translation")

        def __call__(self, problem, states, **known):
            return (*next(ends), 0)

        def left(self, problem, state):
            return {1.0: 0.5, 2.0: 0.1, 0.5: 0.4}[state.scale]

    monkeypatch.setattr(new_scan, "_template_fit", lambda *known: SimpleNamespace(refit=Fake()))
    views = [(seen.frame, seen.problem, None, None)] * 3
    monkeypatch.setattr(new_scan, "given_views", lambda *known, size: views)
    best = new_scan._given(fitter, "ann", scan.points, None, FitSettings(), 1.0, None, scan.labels)
    assert best.value == pytest.approx(0.3 / 4) and best.free == Fake.free
    # In the unit in which the scale is 1, as all that is known of fits is of half sizes.
    assert best.state.scale == 1.0 and best.frame.unit == 2 * seen.frame.unit
    np.testing.assert_allclose(best.state.translation, second.translation / 2)
    np.testing.assert_allclose(best.problem.X, seen.problem.X / 2)


@pytest.mark.parametrize("factor, known", [(1.3, True), (1 / 1.3, True), (1.4, False), (1 / 1.4, False), (50.0, False)])
def test_the_subjects_unit_is_a_scans_where_its_size_allows_that(factor, known):
    learned = 1000.0
    fitter = SimpleNamespace(rig=None, unit_={"anna": learned}, learned_unit_=None)
    assert sizes.allowed_unit(fitter, "anna", factor * learned, FitSettings()) == (learned if known else None)
    assert sizes.allowed_unit(fitter, "anna", factor * learned, FitSettings(scale="fixed")) == 1.0


@pytest.mark.slow
def test_what_fit_scan_takes_counts_after_learning_too(tube_rig, learned_people, people_scans):
    s = people_scans[12]
    known = learned_people.fit_scan(s.points, labels=s.labels, subject="ann")
    np.testing.assert_array_equal(known.labels, s.labels)
    assert (known.confidence == 1).all() and mean_gap(tube_rig, [known], [s]) < 0.03
    started = learned_people.fit_scan(s.points, theta0=s.pose, subject="ann")
    assert mean_gap(tube_rig, [started], [s]) < 0.03
    behind = s.pose.copy()
    behind[0] += [0.0, np.pi, 0.0]
    away = learned_people.fit_scan(s.points, theta0=behind, subject="ann")  # the start is taken, and not another in its place
    assert mean_gap(tube_rig, [away], [s]) > 0.1
    clutter = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    weights = np.r_[np.ones(len(s.points)), np.zeros(200)]
    both = learned_people.fit_scan(np.vstack([s.points, clutter]), point_weights=weights, subject="ann")
    plain = learned_people.fit_scan(s.points, point_weights=weights[: len(s.points)], subject="ann")
    np.testing.assert_array_equal(both.vertices, plain.vertices)
    assert both.labels.shape == (len(s.points) + 200,)


def test_a_new_scan_in_another_unit(tube_rig, learned_people, people_scans):
    s = people_scans[12]
    r = learned_people.fit_scan(1000.0 * s.points + [5.0, 0, 0])
    assert r.scale == pytest.approx(1000.0, rel=0.03)
    assert f"; the scan is in another unit or of another size: one rig unit is {r.scale:.4g} scan units" in r.message
    assert "; scan and rig are in one unit" in learned_people.fit_scan(s.points, theta0=s.pose, subject="ann").message
    assert np.linalg.norm(r.joints - [5.0, 0, 0] - 1000 * s.joints, axis=1).mean() < 1000 * 0.03 * tube_rig.size / 2


@pytest.mark.parametrize("unit", [slow(1.0), 1000.0])
def test_a_new_scan_that_is_turned(tube_rig, learned_people, people_scans, unit):
    """Found under its turn, and again from the pose that was found."""
    s, turn = people_scans[12], matrix_from_rotvec(np.array([0.0, 2.0, 0.0]))
    points = unit * s.points @ turn.T + 3 * unit
    found = learned_people.fit_scan(points)
    for given in ({}, {"theta0": found.pose, "subject": "ann"}, {"labels": s.labels}):
        r = learned_people.fit_scan(points, **given) if given else found
        back = (r.joints - 3 * unit) @ turn / unit
        assert np.linalg.norm(back - s.joints, axis=1).mean() < 0.03 * tube_rig.size / 2, list(given)
        posed = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
        np.testing.assert_array_equal(posed, r.vertices)
        np.testing.assert_array_equal(r.rest_joints, learned_people.template_["ann"].joints)  # one skeleton for all scans


@pytest.mark.parametrize("subject", ["carl", 0, ["ann"]])
def test_a_subject_that_nobody_knows(learned_people, tube_rig, people_scans, subject):
    with pytest.raises(InputError, match="subject: got .*expected a learned subject: 'ann', 'bob'"):
        learned_people.fit_scan(people_scans[0].points, subject=subject)
    with pytest.raises(InputError, match="subjects: got .* for scan 1; expected a learned subject: 'ann', 'bob'"):
        learned_people.transform([people_scans[0].points] * 2, ["bob", subject])
    with pytest.raises(InputError, match="no subject, as nothing has been learned yet"):
        lbs.LBSFitter(tube_rig, **SMALL).fit_scan(people_scans[0].points, subject=subject)


@pytest.mark.usefixtures("hurried")
def test_transform_and_score(tube_rig, learned_people, people_scans):
    learned_people = copy.copy(learned_people)  # without what was made ready, and for others
    given = [people_scans[10].points, NAN, lambda: people_scans[11].points]
    with pytest.warns(UserWarning, match="scan 1 cannot be fitted: points: got 50 of 50"):
        V = learned_people.transform(given)
    assert V.shape == (3, *tube_rig.vertices.shape) and np.isnan(V[1]).all()
    results = [learned_people.fit_scan(s.points) for s in people_scans[10:12]]
    np.testing.assert_array_equal(V[[0, 2]], [r.vertices for r in results])
    assert learned_people.transform([]).shape == (0, *tube_rig.vertices.shape)
    score = learned_people.score([s.points for s in people_scans[10:12]], ["ann", "bob"])
    named = [learned_people.fit_scan(s.points, subject=who) for s, who in zip(people_scans[10:12], ["ann", "bob"])]
    assert score == pytest.approx(-np.mean([r.terms["recon"] for r in named]))
    assert learned_people.score([s.points for s in people_scans[10:12]], ["bob", "ann"]) < score < 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.warns(UserWarning, match="^the score is NaN: no scan could be fitted$"):
            assert np.isnan(learned_people.score([NAN]))
    with pytest.raises(InputError, match="subjects: got 1 id; expected 2"):
        learned_people.transform(given[:2], ["ann"])


@pytest.mark.slow
def test_several_processes_transform_alike(learned_people, people_scans, monkeypatch):
    """Scans that cannot be sent to them, and fits without a seed, too."""
    given, fitter, asked = [s.points[::2] for s in people_scans[12:14]], copy.copy(learned_people), []

    def fit_scans(*given, n_jobs, **more):
        asked.append(n_jobs)
        return batch.fit_scans(*given, n_jobs=n_jobs, **more) if fitter.random_state == 0 else []

    monkeypatch.setattr("lbsfit_np.learning.fitter.fit_scans", fit_scans)
    sources = [lambda: given[0], given[1]]
    one, two = (fitter.set_params(n_jobs=n).transform(sources, ["ann", None]) for n in (1, 2))
    np.testing.assert_array_equal(one, two)
    assert np.isfinite(two).all()
    fitter.set_params(random_state=None).transform(given)
    fitter.set_params(random_state=np.random.default_rng(0)).transform(given[:1])  # whose state goes from scan to scan
    assert asked == [1, 2, 2, 1]


def test_what_wants_learning_says_so(unlearned, tmp_path):
    for call in (lambda: unlearned.transform([]), lambda: unlearned.score([]), lambda: unlearned.save(tmp_path / "m.npz")):
        with pytest.raises(InputError, match=r"fitter: got one that has not learned.*fit\(scans\)") as error:
            call()
        assert isinstance(error.value, NotFittedError)


def test_estimator_conventions(learned_people, make_learner):
    from sklearn.base import clone

    fresh = clone(learned_people)
    assert fresh.get_params() == learned_people.get_params() and fresh.rig is learned_people.rig
    assert not [name for name in vars(fresh) if name.endswith("_")]
    for name in ("results_", "segmenter_", "regressor_", "template_", "unit_", "history_", "failures_"):
        assert hasattr(learned_people, name)
    assert make_learner(variant="cd", rounds=2).get_params()["variant"] == "cd"


def test_another_rig_is_refused_after_learning(learned_people, tube_rig, people_scans):
    for rig in (tube_rig.scaled(2.0), tube_rig.with_parts("arm and fingers"), lbs.load_rig("hand-coarse")):
        other = copy.copy(learned_people).set_params(rig=rig)
        with pytest.raises(InputError, match="rig: got .*the rig that the fitter learned with"):
            other.fit_scan(people_scans[0].points)
    other = copy.copy(learned_people).set_params(variant="free-form")
    for use in (lambda: other.fit_scan(people_scans[0].points), lambda: other.save("model.npz")):
        with pytest.raises(InputError, match="variant: got 'free-form'; expected one with skinning, as the fitter learned with"):
            use()
