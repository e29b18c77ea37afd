"""Learning from a collection: fits of many scans together beat fits of each by itself."""

import copy
import pickle
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import GIVEN, IDS, WHOLE, collected, learning_is_hurried, loop_over, mean_gap, rounds_are_short
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.fitting import drawn
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.learning import finish, free_form
from lbsfit_np.learning.checkpoint import NO_CHECKPOINT
from lbsfit_np.learning.collection import HELD_OUT, LEARNED_FROM, Collection
from lbsfit_np.learning.loop import Loop, LoopSettings
from lbsfit_np.learning.pose_prior import pose_prior
from lbsfit_np.learning.tasks import Drawn, Template
from lbsfit_np.losses import cotangent_matrix
from lbsfit_np.losses.objective import PLAIN
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.turns import Facing


def test_many_scans_together_beat_each_by_itself(tube_rig, learned_people, unlearned, people_scans):
    truth = [people_scans[GIVEN[k]] for k in WHOLE]
    together = [learned_people.results_[k] for k in WHOLE]
    few = 6
    by_objective = copy.copy(unlearned).set_params(registration=False)
    single, by_losses = ([fitter.fit_scan(s.points) for s in truth[:few]] for fitter in (unlearned, by_objective))
    for what, most, share in (("joints", 0.006, 0.6), ("vertices", 0.004, 0.5)):
        gaps = [mean_gap(tube_rig, found[:few], truth[:few], what) for found in (together, single, by_losses)]
        assert gaps[0] < min(gaps[1], share * gaps[2])
        assert mean_gap(tube_rig, together, truth, what) < most
    labels = np.mean([(r.labels == s.labels).mean() for r, s in zip(together, truth)])
    assert labels > 0.9


def test_results_stand_in_the_order_of_the_scans(tube_rig, learned_people, people_scans):
    assert len(learned_people.results_) == 11 and learned_people.results_[3] is None
    assert list(learned_people.failures_) == [3] and "NaN" in learned_people.failures_[3]
    for k in WHOLE:
        r, s = learned_people.results_[k], people_scans[GIVEN[k]]
        assert isinstance(r, FitResult) and r.status == "ok" and len(r.labels) == len(s.points)
        assert np.linalg.norm(r.vertices.mean(axis=0) - s.vertices.mean(axis=0)) < 0.05 * tube_rig.size
        assert r.rig_digest == tube_rig.digest and r.parts == tube_rig.parts
    notes = [learned_people.results_[k].message for k in WHOLE]
    assert sum("held out of learning" in n for n in notes) == 1 and sum("learned from" in n for n in notes) == 9


def test_templates_come_near_the_subjects_own(tube_rig, learned_people, people):
    assert list(learned_people.template_) == ["ann", "bob"] and set(learned_people.unit_) == {"ann", "bob"}
    for name, true in people.items():
        for what in ("vertices", "joints"):
            found, before = (getattr(r, what) - getattr(true, what) for r in (learned_people.template_[name], tube_rig))
            gaps = [np.linalg.norm(d - d.mean(axis=0), axis=1).mean() for d in (found, before)]
            assert gaps[0] < 0.5 * gaps[1]
        assert learned_people.unit_[name] == 1.0


def test_results_give_their_vertices_back(tube_rig, learned_people):
    for k in WHOLE[:3]:
        r = learned_people.results_[k]
        V = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
        np.testing.assert_array_equal(V, r.vertices)
        template = learned_people.template_[IDS[k]]
        own = np.linalg.norm(tube_rig.vertices + r.offsets - template.vertices, axis=1).mean() / (tube_rig.size / 2)
        assert 0 < own < 0.01  # the scan's own residual, on top of its subject's template, whose joints it leaves
        np.testing.assert_array_equal(r.rest_joints, template.joints)
        bounded = slice(1, None)
        assert (r.pose[bounded] >= tube_rig.lower[bounded]).all() and (r.pose[bounded] <= tube_rig.upper[bounded]).all()


def test_history_and_progress(learned_people):
    assert [h["round"] for h in learned_people.history_] == [0, 1]
    keys = {"round", "recon", "recon_held_out", "seconds", "kept"}
    assert [set(h) for h in learned_people.history_] == [keys | {"beyond", "failed"}, keys | {"new_starts_won"}]
    assert [h["kept"] for h in learned_people.history_] == [False, True]
    # Round 0 has proportions for each scan by itself, which explain a little more than one template for all.
    assert learned_people.history_[1]["recon"] < 1.2 * learned_people.history_[0]["recon"]
    assert 0 <= learned_people.history_[1]["new_starts_won"] <= 10
    stages = list(dict.fromkeys(stage for stage, *_ in learned_people.told))
    expected = ["first fits", "round", "templates", "segmenter", "library of starts", "labels", "poses of scans"]
    assert stages == [*expected, "templates and poses in turn", "results"]
    for stage in stages:  # no bar goes back
        shares = [share for s, share, *_ in learned_people.told if s == stage]
        assert shares == sorted(shares) and (shares[-1] == 1 or stage == "round"), stage
        assert shares[0] == 0 or stage == "round", stage  # said before the first scan, which may take long
    assert all(0 <= share <= 1 for _, share, *_ in learned_people.told)
    noted = [{key: value for key, value in h.items() if key != "kept"} for h in learned_people.history_]
    assert [a[2] for a in learned_people.told if a[0] == "round"] == noted


@pytest.mark.parametrize(("training_scans", "round_scans", "library_scans"), [(4000, 4000, 1500), (800, 800, 300), (2, 100, 100)])
def test_rounds_train_on_as_many_scans_as_pretraining(training_scans, round_scans, library_scans):
    settings = LoopSettings.for_training(training_scans, rounds=3)
    assert (settings.round_scans, settings.library_scans, settings.rounds) == (round_scans, library_scans, 3)


def test_the_segmenter_goes_on_from_the_pretrained_one(learned_people, unlearned):
    assert learned_people.segmenter_ is not unlearned.segmenter_
    own, before = (s.stages[0].layers[0][0] for s in (learned_people.segmenter_, unlearned.segmenter_))
    away = np.linalg.norm(own - before) / np.linalg.norm(before)
    assert 0 < away < 0.5
    for own, before in zip(learned_people.segmenter_.stages, unlearned.segmenter_.stages):
        np.testing.assert_array_equal(own.mean, before.mean)  # which would be that of the round's scans otherwise


@pytest.mark.slow
def test_turned_scans_are_learned_from(tube_rig, make_learner, few_scans, monkeypatch):
    """Each turned in its own way: what is learned is the same person's template."""
    rounds_are_short(monkeypatch)
    turns = [matrix_from_rotvec(np.array([0.0, a, 0.0])) for a in (0.0, 1.0, 2.5, -2.0)]
    fitter = make_learner(held_out=0).fit([s.points @ turn.T for s, turn in zip(few_scans, turns)])
    for r, s, turn in zip(fitter.results_, few_scans[:4], turns, strict=True):
        assert np.linalg.norm(r.joints @ turn - s.joints, axis=1).mean() < 0.05 * tube_rig.size / 2
    person = tube_rig.subject(3, amount=1.5)
    found, before = (r.vertices - person.vertices for r in (fitter.template_[0], tube_rig))
    gaps = [np.linalg.norm(d - d.mean(axis=0), axis=1).mean() for d in (found, before)]
    assert gaps[0] < 0.6 * gaps[1]


@pytest.fixture(scope="module")
def first_fits_of_a_large_one(tube_rig, unlearned):
    """Scans in the rig's own size, and the loop after first fits of them 1.2 times as large."""
    made = lbs.synthesize(tube_rig, 4, random_state=3, shape=0.0, holes=0, n_points=400)
    collection = collected(tube_rig, [1.2 * s.points for s in made])
    loop = loop_over(tube_rig, collection, "joint", unlearned.segmenter_, unlearned.regressor_)
    loop._first_fits()
    return made, loop


def test_people_of_another_size_stay_where_they_are(first_fits_of_a_large_one):
    """A scale near 1 goes into the template, which grows about the root joint, not about the origin."""
    size, (made, loop) = 1.2, first_fits_of_a_large_one
    assert np.linalg.norm(loop.model.rig.joints[0]) > 0.5
    for m, s in zip(loop.collection.members, made):
        assert m.unit == 1.0 and m.state.scale == 1.0
        posed = loop.shifting.pose(m.state.replace(coefficients=loop.coefficients[0]))[0]
        true = m.frame.inside(size * s.vertices)
        assert np.linalg.norm((posed.vertices - true).mean(axis=0)) < 0.1
    c = loop.coefficients[0]
    assert (c[: loop.model.n_proportions] > 0.05).all() and not c[loop.model.n_proportions :].any()


def test_losses_of_first_fits_are_in_the_unit_that_all_have(first_fits_of_a_large_one):
    """Each is found where its scan has the rig's size, and told where the next rounds tell theirs."""
    _, loop = first_fits_of_a_large_one
    for m in loop.collection.members:
        c = loop.coefficients[0]
        here = Problem(m.X).evaluate(loop.shifting.coarse, m.state.replace(coefficients=c), PLAIN).value
        assert m.loss == pytest.approx(here, rel=0.05)  # 1.44 times as much as in their own; the proportions are other ones


@pytest.mark.parametrize("size", [1.0, slow(1.2)])
def test_with_fixed_joints_another_size_is_another_unit(tube_rig, make_learner, size, monkeypatch):
    """Skin alone that grows about joints that stay would be nobody."""
    rounds_are_short(monkeypatch)
    made = lbs.synthesize(tube_rig, 4, random_state=3, shape=0.0, holes=0, n_points=400)[:2]
    fitter = make_learner(variant="cd", joints="fixed", held_out=0).fit([size * s.points for s in made])
    assert fitter.unit_[0] == (1.0 if size == 1.0 else pytest.approx(size, rel=0.02))
    for r, s in zip(fitter.results_, made, strict=True):
        assert np.linalg.norm(r.joints - size * s.joints, axis=1).mean() < 0.02 * size * tube_rig.size / 2


@pytest.mark.slow
def test_scans_in_another_unit_learn_the_same(tube_rig, make_learner, few_scans, monkeypatch):
    """Millimetres: the unit is found once, the template is in the rig's own."""
    rounds_are_short(monkeypatch)
    fitter = make_learner(variant="cd").fit([250 * s.points for s in few_scans[:3]])
    assert fitter.unit_[0] == 250.0
    note = "; the scan seems to be in millimetres: one rig unit is 250 scan units"
    assert all(note in r.message for r in fitter.results_)
    new = fitter.fit_scan(few_scans[3].points)  # which is not in the unit that was learned
    assert "; scan and rig are in one unit" in new.message
    assert np.mean([np.linalg.norm(r.joints - 250 * s.joints, axis=1).mean() for r, s in zip(fitter.results_, few_scans)]) < 8
    assert fitter.template_[0].size == pytest.approx(tube_rig.subject(3, amount=1.5).size, rel=0.05)
    free = make_learner(variant="free-form").fit([250 * s.points for s in few_scans[:3]])
    assert all(r.message.endswith(note) for r in free.results_)
    assert free.unit_[0] == 250.0
    for r, s in zip(free.results_, few_scans):
        assert r.scale == pytest.approx(250, rel=1e-9)
        K = cotangent_matrix(tube_rig.vertices, tube_rig.faces)
        assert r.terms["laplacian"] == pytest.approx(np.sum((K @ (r.offsets / (tube_rig.size / 2))) ** 2))
        assert np.ptp(r.vertices, axis=0).max() == pytest.approx(250 * np.ptp(s.points, axis=0).max(), rel=0.15)


def test_a_free_form_scan_whose_extent_is_not_the_others_says_so_and_has_its_own_unit(make_learner, few_scans):
    points = [s.points for s in few_scans[:4]]
    points[2] = 4.0 * points[2]  # in no usual unit
    free = make_learner(variant="free-form").fit(points)
    words = r"its extent is \d\.\d+ times the rig's in the scans' unit: "
    words += r"is it in another unit\? Convert it and learn again; free-form"
    assert [bool(re.match(words, r.message)) for r in free.results_] == [False, False, True, False]
    assert [r.scale == 1.0 for r in free.results_] == [True, True, False, True]
    assert free.results_[2].scale == pytest.approx(4.0, rel=0.5) and "one rig unit taken as" in free.results_[2].message
    assert free.results_[2].terms["recon"] < 1.5 * np.median([r.terms["recon"] for r in free.results_])


@pytest.mark.parametrize("scale, doubted", [("estimate", [False, True]), ("fixed", [False, False])])
def test_extents_raise_no_doubt_of_free_form_fits_whose_scale_is_fixed(scale, doubted, tube_rig, few_scans, monkeypatch):
    monkeypatch.setattr(free_form._FreeForm, "__call__", lambda self, m: bool(m.doubt))
    collection = collected(tube_rig, [few_scans[0].points, 3.0 * few_scans[1].points], held_out=0)
    for m in collection.members:
        m.unit = 1.0
    options = {"jobs": 1, "progress": lambda *told: None}
    assert free_form.fit_free_form(Model(tube_rig), collection, FitSettings(scale=scale), **options) == doubted


def test_another_scan_tells_when_to_stop_where_the_one_held_out_is_in_another_unit(tube_rig, few_scans, monkeypatch):
    collection = collected(tube_rig, [s.points for s in few_scans])
    loop = loop_over(tube_rig, collection, "cd", None)
    (held,) = collection.with_role(HELD_OUT)
    frames, rest = [replace(m.frame, unit=loop.model.half) for m in collection.members], loop.model.rest()
    scales = [2.54 if m is held else 1.0 for m in collection.members]
    found = [(f, rest.replace(scale=scale), 0.01, None, (), None, False) for f, scale in zip(frames, scales)]
    monkeypatch.setattr(loop, "_work", lambda *given: found)
    with pytest.warns(UserWarning, match=f"scan {held.index}: .*; not learned from"):
        loop._first_fits()
    (other,) = collection.with_role(HELD_OUT)
    assert other is not held and held.role == "not learned from" and len(collection.with_role(LEARNED_FROM)) == 3


@pytest.mark.parametrize("effort", ["fast", "balanced"])
def test_a_learned_fit_in_doubt_tells_what_would_look_further(effort, tube_rig, few_scans, monkeypatch):
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *known: ("suspect", "odd"))
    collection = collected(tube_rig, [few_scans[0].points], held_out=0)
    (m,) = collection.members
    m.use_frame(1.0, tube_rig.size / 2)
    m.state = Model(tube_rig).rest()
    settings = FitSettings(effort=effort, full_iterations=1)
    given = tube_rig, {0: tube_rig}, "follow", collection, settings, Facing(), None
    (r,) = finish.results_of(*given, other_limbs=True, jobs=1, progress=lambda *told: None)
    assert ("effort 'balanced' (--effort balanced) looks further" in r.message) == (effort == "fast")
    monkeypatch.setattr("lbsfit_np.fitting.template_fit.TemplateFit.proportions", lambda *given: 1.0)  # somebody else
    (r,) = finish.results_of(*given, other_limbs=True, jobs=1, progress=lambda *told: None)
    assert "looks further" not in r.message


def test_figures_of_a_round_are_means_of_roots():
    """Of √L_c, as the study's Recon is; not the root of a mean."""
    losses = ((0.01, False), (0.09, False), (0.04, True), (0.16, True))
    members = [SimpleNamespace(loss=loss, role=HELD_OUT if held else LEARNED_FROM) for loss, held in losses]
    loop = SimpleNamespace(collection=Collection(4, members), history=[], progress=lambda *a: None, _kept=NO_CHECKPOINT)
    assert Loop._note(loop, 1, 0.0, {}) == pytest.approx(0.3)
    assert (loop.history[0]["recon"], loop.history[0]["recon_held_out"]) == (pytest.approx(0.2), pytest.approx(0.3))


def test_rounds_end_when_the_loss_on_scans_held_out_ends_falling(make_learner, few_scans, tmp_path, monkeypatch):
    """The best round's state is what counts; of rounds that are level the later. All find the same, and once."""
    learning_is_hurried(monkeypatch)
    scans = [s.points for s in few_scans[:3]]
    values = iter([0.5, 0.4, 0.399, 0.3])
    noted, poses = Loop._note, {}

    def note(self, k, began, more):
        noted(self, k, began, more)
        poses[k] = self, [m.state.theta for m in self.collection.members]
        return 1.0 if k == 0 else next(values)

    monkeypatch.setattr(Loop, "_note", note)
    fitter = make_learner(variant="cd", rounds=6).fit(scans, checkpoint=tmp_path)
    assert [h["round"] for h in fitter.history_] == [0, 1, 2, 3]  # 0.399 is no improvement on 0.4 worth a round
    assert [h["round"] for h in fitter.history_ if h["kept"]] == [3]
    for second, kept in ((0.4019, 2), (0.4021, 1)):
        values = iter([0.4, second])
        fitter = make_learner(variant="cd", rounds=6).fit(scans, checkpoint=tmp_path)
        assert [h["round"] for h in fitter.history_ if h["kept"]] == [kept] and len(fitter.history_) == 3
    values = iter([0.4, 0.6])
    templates = []
    found = Loop._templates
    monkeypatch.setattr(Loop, "_templates", lambda *given: templates.append(found(*given)) or templates[-1])
    fitter = make_learner(variant="cd", rounds=6).fit(scans, checkpoint=tmp_path)
    assert len(templates) == 6 and [h["kept"] for h in fitter.history_] == [False, True, False]
    (loop, best), (_, last) = poses[1], poses[2]
    assert all(np.array_equal(m.state.theta, theta) for m, theta in zip(loop.collection.members, best, strict=True))
    assert not all(map(np.array_equal, best, last))
    np.testing.assert_array_equal(fitter.template_[0].vertices, templates[2][0][0])  # the last of the round


@pytest.mark.slow
def test_what_is_kept_of_a_scan_grows_by_little_more_than_its_points(tube_rig, unlearned, few_scans, monkeypatch):
    """Thousands of bodies fit into memory: probabilities are of half precision, search structures are made when needed."""
    learning_is_hurried(monkeypatch, FitSettings().effort)
    collection = collected(tube_rig, [s.points for s in few_scans])
    loop_over(tube_rig, collection, "joint", unlearned.segmenter_, unlearned.regressor_).run()
    for m in collection.members:
        n = len(m.part.rows)
        points, rows, proba = 2 * 3 * 8 * n, 8 * n, 2 * len(tube_rig.parts) * n
        assert len(pickle.dumps(m)) < points + rows + proba + 8000
        assert m.proba.dtype == np.float16 and m.problem is not m.problem


@pytest.mark.slow
def test_what_poses_tell_of_each_is_of_those_that_teach_and_of_the_round_that_is_kept(make_learner, few_scans, monkeypatch):
    """Poses of scans held out are drawn, too, but tell nothing; a round that is not kept leaves nothing behind."""
    learning_is_hurried(monkeypatch)
    values, made, drawn_to, states, noted, make = iter([0.4, 0.6]), [], [], [], Loop._note, pose_prior
    left = {}

    def note(self, k, began, more):
        noted(self, k, began, more)
        left[k] = [(m.state, m.loss) for m in self.collection.members]
        return 1.0 if k == 0 else next(values)

    def prior(poses, told, turning, root):
        made.append((len(poses), make(poses, told, turning, root)))
        return made[-1][1]

    def drawing(self, task):
        state, loss, noise = draw(self, task)
        drawn_to.append((self.prior, noise))
        states.append((state, loss))
        return state, loss, noise

    draw = Drawn.__call__
    monkeypatch.setattr(Drawn, "__call__", drawing)
    monkeypatch.setattr(Loop, "_note", note)
    monkeypatch.setattr("lbsfit_np.learning.loop.pose_prior", prior)
    of_templates, template = [], Template.__call__
    monkeypatch.setattr(Template, "__call__", lambda self, task: of_templates.append(self.prior) or template(self, task))
    finished, finish_one = [], finish.prior_of
    monkeypatch.setattr(finish, "prior_of", lambda p, noise, *more: finished.append((p, noise)) or finish_one(p, noise, *more))
    fitter = make_learner(rounds=3, held_out=0.2).fit([s.points for s in few_scans])
    assert [n for n, _ in made] == [4] * 6 and len(drawn_to) == 30  # three times in each of two rounds
    assert [h["kept"] for h in fitter.history_] == [False, True, False]
    assert fitter.pose_prior_ is made[2][1]
    assert finished == drawn_to[10:15] and all(noise > 0 for _, noise in finished)
    assert of_templates == [None, *(told for _, told in made[:5])]  # what poses told last
    for k, there in ((1, states[10:15]), (2, states[25:])):  # poses, and what they leave, are those that were drawn
        assert all(a[0] is b[0] and a[1] == b[1] for a, b in zip(left[k], there, strict=True))


def test_new_scans_are_drawn_to_what_was_learned_of_poses_unless_labels_are_known(learned_people, people_scans, monkeypatch):
    scan, told = people_scans[12], []
    monkeypatch.setattr(drawn, "drawn", lambda refit, problem, state, prior, noise: told.append((prior, noise)) or state)
    learned_people.fit_scan(scan.points, subject="ann", labels=scan.labels)
    assert told == []
    learned_people.fit_scan(scan.points, subject="ann")
    ((prior, noise),) = told
    assert prior is learned_people.pose_prior_ and noise > 0
