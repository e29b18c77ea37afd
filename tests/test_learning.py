"""Learning from collections: what is read, what is trained on, and that fits of many scans beat fits of each by itself."""

import copy
import functools
import os
import signal
import warnings
import zipfile

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.learning.collection import read_collection
from lbsfit_np.learning.loop import Loop, LoopSettings, _alike
from lbsfit_np.learning.mixture import Mixture
from lbsfit_np.learning.variants import VARIANTS, as_variant
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.synthesis import Synthesis
from lbsfit_np.workers import each

SMALL = {"training_scans": 200, "training": {"n_points": 400}, "rounds": 1, "random_state": 0}
SCANS = {"n_points": 400, "holes": 1, "density": 0.3}
NAN = np.full((50, 3), np.nan)


def _error(rig, results, scans, what="joints"):
    """Mean distance in half sizes."""
    away = [np.linalg.norm(getattr(r, what) - getattr(s, what), axis=1).mean() for r, s in zip(results, scans, strict=True)]
    return np.mean(away) / (rig.size / 2)


@pytest.fixture(scope="module")
def subjects(tube_rig):
    """Two people."""
    return {"ann": tube_rig.subject(3, amount=1.5), "bob": tube_rig.subject(4, amount=1.5)}


@pytest.fixture(scope="module")
def scans(tube_rig, subjects):
    """Scans of the two in turn."""
    templates = [(s.vertices, s.joints) for s in subjects.values()]
    return lbs.synthesize(tube_rig, 16, templates=templates, random_state=1, **SCANS)


@pytest.fixture(scope="module")
def alone(tube_rig):
    """A pretrained fitter that has not learned."""
    return lbs.LBSFitter(tube_rig, **SMALL).pretrain()


@pytest.fixture(scope="module")
def make(tube_rig, alone):
    """(parameters) → a fitter whose pretraining is done."""

    def made(**parameters):
        fitter = lbs.LBSFitter(tube_rig, **(SMALL | parameters))
        fitter._pretrained = alone._pretrained
        return fitter

    return made


GIVEN = [0, 1, 2, "broken", 3, 4, 5, 6, 7, 8, 9]
IDS = ["ann", "bob", "ann", "ann", "bob", "ann", "bob", "ann", "bob", "ann", "bob"]
WHOLE = [k for k, i in enumerate(GIVEN) if i != "broken"]


@pytest.fixture(scope="module")
def learned(make, scans):
    """A fitter that has learned from ten scans of two subjects and met a broken one; and what progress said."""
    told = []
    fitter = make()
    with pytest.warns(UserWarning, match="1 of 11 scans cannot be used; scan 3: points: got 50 of 50"):
        found = fitter.fit([NAN if i == "broken" else scans[i].points for i in GIVEN], IDS, progress=lambda *a: told.append(a))
    assert found is fitter
    fitter.told = told
    return fitter


# ---- the collection ----


def _read(rig, scans, subjects=None, **options):
    given = {"max_points": 2500, "held_out": 0.1, "scale": "estimate", "random_state": 0, **options}
    return read_collection(rig, scans, subjects, **given)


@pytest.fixture(scope="module")
def clouds(scans):
    return [s.points for s in scans]


BAD_COLLECTIONS = [
    (lambda c: ([], None), ["scans: got none", "one or more"]),
    (lambda c: (c[:4], ["a", "b"]), ["subjects: got 2 ids", "4, one for each scan"]),
    (lambda c: (c[:4], "anna"), ["subjects: got 'anna'", "a sequence"]),
    (lambda c: (c[:4], 7), ["subjects: got 7", "a sequence"]),
    (lambda c: (c[:4], [1, 2, 3, 4.5]), ["subjects: got 4.5", "text or whole numbers"]),
    (lambda c: (c[:4], [1, 2, 3, None]), ["subjects: got None", "text or whole numbers"]),
    (lambda c: ([*c[:4], 1000 * c[4]], None), ["scans: got different units: scan 4 has", "in one unit", "Convert"]),
    (lambda c: ([0.001 * c[0], *c[1:4], 100 * c[4]], None), ["different units: scan 0, 4 have"]),
    (lambda c: ([NAN, np.zeros((0, 3))], None), ["scans: got 2, none of which can be used (the first: points: got 50"]),
    (lambda c: (c[:2], None), ["scans: got 2 that can be used", "at least 3", "held_out=0"]),
    (lambda c: ([*c[:2], NAN], None), ["scans: got 2 that can be used"]),
]


@pytest.mark.parametrize("given, words", BAD_COLLECTIONS)
def test_collections_that_cannot_be(tube_rig, clouds, given, words):
    with pytest.raises(InputError) as error:
        _read(tube_rig, *given(clouds))
    for word in words:
        assert word in str(error.value)


def test_bad_collections_are_named_before_any_training(tube_rig, clouds, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    for given, words in BAD_COLLECTIONS:
        scans, ids = given(clouds)
        with pytest.raises(InputError, match=words[0].split("(")[0]):
            lbs.LBSFitter(tube_rig, **SMALL).fit(scans, ids)


def test_bad_scans_are_set_aside_with_their_reasons(tube_rig, clouds):
    given = [clouds[0], NAN, clouds[1], np.zeros((0, 3)), functools.partial(lbs.load_scan, "nowhere.ply"), lambda: clouds[2]]
    found = _read(tube_rig, given, list("abcdef"))
    assert found.n == 6 and [m.index for m in found.members] == [0, 2, 5] and found.subjects == ["a", "c", "f"]
    assert set(found.failures) == {1, 3, 4}
    assert "NaN" in found.failures[1] and "empty" in found.failures[3] and "nowhere.ply" in found.failures[4]
    np.testing.assert_array_equal(found.members[2].points, clouds[2])
    assert [m.index for m in found.of("c")] == [2]


@pytest.mark.parametrize("ids", [[3, 3, 4, 4], np.array([3, 3, 4, 4]), np.array(["x", "x", "y", "y"]), ("x", "x", 3, 3)])
def test_ids_of_any_plain_kind(tube_rig, clouds, ids):
    found = _read(tube_rig, clouds[:4], ids)
    assert len(found.subjects) == 2 and all(type(s) in (int, str) for s in found.subjects)
    assert [m.subject for m in found.members] == list(ids)


def test_without_ids_there_is_one_subject(tube_rig, clouds):
    assert _read(tube_rig, clouds[:4]).subjects == [0]


@pytest.mark.parametrize("share, expected", [(0.0, 0), (0.01, 1), (0.25, 3), (0.33, 4)])
def test_each_subject_keeps_two_scans(tube_rig, clouds, share, expected):
    ids = [0] * 3 + [1] * 3 + [2] * 6
    for seed in range(20):
        members = _read(tube_rig, clouds[:12], ids, held_out=share, random_state=seed).members
        assert sum(m.held_out for m in members) == expected
        for s in range(3):
            assert sum(m.subject == s and not m.held_out for m in members) >= 2
    again = [m.held_out for m in _read(tube_rig, clouds[:12], ids, held_out=share, random_state=19).members]
    assert again == [m.held_out for m in members]


def test_subjects_of_one_scan_can_be_left_out_where_there_are_no_others(tube_rig, clouds):
    members = _read(tube_rig, clouds[:10], range(10), held_out=0.2).members
    assert sum(m.held_out for m in members) == 2


def test_large_scans_are_thinned_by_the_seed_and_their_number(tube_rig, clouds):
    a, b, c = (_read(tube_rig, [*clouds[:3], clouds[0]], max_points=100, random_state=seed).members for seed in (0, 0, 1))
    for m, n in zip(a, b):
        np.testing.assert_array_equal(m.rows, n.rows)
    assert len(a[0].rows) == 100 and len(np.unique(a[0].rows)) == 100 and len(a[0].points) == len(clouds[0])
    assert not np.array_equal(a[0].rows, c[0].rows) and not np.array_equal(a[0].rows, a[3].rows)
    np.testing.assert_allclose(a[0].frame.centre, clouds[0][a[0].rows].mean(axis=0))
    np.testing.assert_array_equal(a[0].frame.turn, np.eye(3))


def test_all_scans_get_the_unit_of_most(tube_rig, clouds):
    found = _read(tube_rig, [250 * c for c in clouds[:4]])
    assert {m.unit for m in found.members} == {250.0}  # millimetres, and the rig's unit is 0.25 m


# ---- training poses ----


@pytest.fixture(scope="module")
def mixture(tube_rig, subjects):
    poses = np.random.default_rng(0).uniform(tube_rig.lower, tube_rig.upper, (5, 4, 3))
    poses[:, 0] = np.random.default_rng(1).uniform(-2.5, 2.5, (5, 3))  # the root turns freely
    settings = Synthesis(n_points=60, shape=0.0)
    return Mixture(tube_rig, settings, poses, tuple((s.vertices, s.joints) for s in subjects.values()), 0, 1)


def test_half_the_training_poses_are_inferred_ones_with_noise(tube_rig, mixture):
    poses = np.array([mixture.scan(i).pose for i in range(200)])
    away = np.abs(poses[:, None, 1:] - mixture.poses[None, :, 1:]).max(axis=(2, 3))
    near = away.min(axis=1) <= 0.15 + 1e-12
    assert 0.4 < near.mean() < 0.6
    others = slice(1, None)
    assert (poses[:, others] >= tube_rig.lower[others]).all() and (poses[:, others] <= tube_rig.upper[others]).all()
    outside = (np.abs(poses[:, 0]) > 0.6).any(axis=1)  # the root's limits are ±0.6: only an inferred root goes beyond
    assert outside[near].mean() > 0.8 and not outside[~near].any()
    whose = away.argmin(axis=1)[near]
    root = np.abs(poses[near, None, 0] - mixture.poses[None, :, 0]).max(axis=2)
    assert (root.min(axis=1) <= 0.15 + 1e-12).all()
    assert (root.argmin(axis=1) != whose).any() and set(whose) == set(range(5))  # any pose with any facing
    noise = (poses[near] - mixture.poses[whose])[:, 1:]
    assert np.abs(noise).max() > 0.1


def test_training_scans_are_made_of_the_templates(tube_rig, subjects, mixture):
    made = [mixture.scan(i) for i in range(40)]
    which = [[np.array_equal(s.template, t.vertices) for t in subjects.values()] for s in made]
    assert np.sum(which, axis=1).tolist() == [1] * 40 and 8 < np.sum(which, axis=0)[0] < 32
    plain = Mixture(tube_rig, mixture.settings, mixture.poses, (), 0, 1).scan(0)
    np.testing.assert_array_equal(plain.template, tube_rig.vertices)


def test_some_variation_of_shape_stays(tube_rig, subjects, mixture):
    def spread(templates):
        made = Mixture(tube_rig, Synthesis(n_points=60, shape=0.1), mixture.poses, templates, 0, 1)
        base = templates[0][0] if templates else tube_rig.vertices
        return np.mean([np.linalg.norm(made.scan(i).template - base, axis=1).mean() for i in range(20)])

    on_templates, on_the_rig = spread(mixture.templates[:1]), spread(())
    assert 0.15 * on_the_rig < on_templates < 0.5 * on_the_rig


def test_without_inferred_poses_all_are_uniform(tube_rig, mixture):
    made = Mixture(tube_rig, mixture.settings, np.empty((0, 4, 3)), (), 0, 1)
    poses = np.array([made.scan(i).pose for i in range(50)])
    assert (poses >= tube_rig.lower).all() and (poses <= tube_rig.upper).all()


def test_the_same_number_is_the_same_scan(tube_rig, mixture):
    for i in (0, 7):
        (x, labels, unit), again = mixture(i), mixture(i)
        np.testing.assert_array_equal(x, again[0])
        np.testing.assert_array_equal(labels, again[1])
        assert unit == 1.0
    others = [mixture, Mixture(tube_rig, mixture.settings, mixture.poses, mixture.templates, 0, 2)]
    others.append(Mixture(tube_rig, mixture.settings, mixture.poses, mixture.templates, 1, 1))
    first = [m.scan(0).points for m in others]
    assert not np.array_equal(first[0], first[1]) and not np.array_equal(first[0], first[2])


# ---- variants ----


def test_variants_are_the_papers():
    assert list(VARIANTS) == ["joint", "pose-only", "rand", "cd", "free-form"]
    assert all(as_variant(name).name == name for name in VARIANTS)
    joint, pose_only, rand, cd, free = VARIANTS.values()
    assert joint.labels and joint.inferred_poses and joint.deformed and joint.skinning
    assert pose_only.labels and pose_only.inferred_poses and not pose_only.deformed
    assert rand.labels and not rand.inferred_poses and not rand.deformed
    assert not cd.labels and not cd.library and cd.skinning
    assert not free.skinning and not free.labels


@pytest.mark.parametrize("name", ["best", "", None])
def test_other_variants_are_refused(name):
    with pytest.raises(InputError, match="variant: got .*'joint' or 'pose-only' or 'rand' or 'cd' or 'free-form'"):
        as_variant(name)


# ---- the same work on many tasks ----


@pytest.mark.parametrize("jobs", [1, 2])
def test_answers_come_in_the_order_of_the_tasks(jobs):
    shares = []
    assert each(_squared, range(7), jobs=jobs, done=shares.append) == [0, 1, 4, 9, 16, 25, 36]
    np.testing.assert_allclose(shares, np.arange(1, 8) / 7)
    assert each(_squared, [], jobs=jobs) == [] and each(_squared, [3], jobs=jobs) == [9]


@pytest.mark.parametrize("jobs", [1, 2])
def test_errors_of_tasks_pass_on(jobs):
    with pytest.raises(InputError, match="n: got 3; expected not 3") as error:
        each(_not_3, range(6), jobs=jobs)
    assert error.value.argument == "n"
    with pytest.raises(ZeroDivisionError):
        each(_inverse, [1, 2, 0], jobs=jobs)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_dies_is_said():
    with pytest.raises(InputError, match="n_jobs: got a process that ended .*SIGKILL"):
        each(_killed, [1, 2, 3], jobs=2)


def _squared(x):
    return x * x


def _not_3(n):
    if n == 3:
        raise InputError("n", "3", "not 3")
    return n


def _inverse(x):
    return 1 / x


def _killed(x):
    os.kill(os.getpid(), signal.SIGKILL)


# ---- learning ----


def test_many_scans_together_beat_each_by_itself(tube_rig, learned, alone, scans):
    truth = [scans[GIVEN[k]] for k in WHOLE]
    together = [learned.results_[k] for k in WHOLE]
    single = [alone.fit_scan(s.points) for s in truth]
    assert _error(tube_rig, together, truth) < 0.6 * _error(tube_rig, single, truth)
    assert _error(tube_rig, together, truth, "vertices") < 0.5 * _error(tube_rig, single, truth, "vertices")
    assert _error(tube_rig, together, truth) < 0.025 and _error(tube_rig, together, truth, "vertices") < 0.02
    labels = np.mean([(r.labels == s.labels).mean() for r, s in zip(together, truth)])
    assert labels > 0.9


def test_results_stand_in_the_order_of_the_scans(tube_rig, learned, scans):
    assert len(learned.results_) == 11 and learned.results_[3] is None
    assert list(learned.failures_) == [3] and "NaN" in learned.failures_[3]
    for k in WHOLE:
        r, s = learned.results_[k], scans[GIVEN[k]]
        assert isinstance(r, FitResult) and r.status == "ok" and len(r.labels) == len(s.points)
        assert np.linalg.norm(r.vertices.mean(axis=0) - s.vertices.mean(axis=0)) < 0.05 * tube_rig.size
        assert r.rig_digest == tube_rig.digest and r.parts == tube_rig.parts
    notes = [learned.results_[k].message for k in WHOLE]
    assert sum("left out of learning" in n for n in notes) == 1 and sum("learned from" in n for n in notes) == 9


def test_templates_come_near_the_subjects_own(tube_rig, learned, subjects):
    assert list(learned.template_) == ["ann", "bob"] and set(learned.unit_) == {"ann", "bob"}
    for name, true in subjects.items():
        for what in ("vertices", "joints"):
            found, before = (getattr(r, what) - getattr(true, what) for r in (learned.template_[name], tube_rig))
            gaps = [np.linalg.norm(d - d.mean(axis=0), axis=1).mean() for d in (found, before)]
            assert gaps[0] < 0.5 * gaps[1]
        assert learned.unit_[name] == 1.0


def test_results_give_their_vertices_back(tube_rig, learned):
    for k in WHOLE[:3]:
        r = learned.results_[k]
        V = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
        np.testing.assert_array_equal(V, r.vertices)
        template = learned.template_[IDS[k]]
        own = np.linalg.norm(tube_rig.vertices + r.offsets - template.vertices, axis=1).mean() / (tube_rig.size / 2)
        assert 0 < own < 0.01  # the scan's own residual, on top of its subject's template
        bounded = slice(1, None)
        assert (r.pose[bounded] >= tube_rig.lower[bounded]).all() and (r.pose[bounded] <= tube_rig.upper[bounded]).all()


def test_history_and_progress(learned):
    assert [h["round"] for h in learned.history_] == [0, 1]
    assert set(learned.history_[0]) == {"round", "recon", "recon_held_out", "seconds"}
    assert set(learned.history_[1]) == {"round", "recon", "recon_held_out", "seconds", "new_starts_won"}
    # Round 0 has proportions for each scan by itself, which explain a little more than one template for all.
    assert learned.history_[1]["recon"] < 1.2 * learned.history_[0]["recon"]
    assert 0 <= learned.history_[1]["new_starts_won"] <= 10
    stages = list(dict.fromkeys(stage for stage, *_ in learned.told))
    expected = ["first fits", "round", "templates", "segmenter", "labels", "library of starts", "poses of scans", "results"]
    assert stages == expected
    assert all(0 < share <= 1 for _, share, *_ in learned.told)
    assert [a[2] for a in learned.told if a[0] == "round"] == learned.history_


def test_the_segmenter_goes_on_from_the_pretrained_one(learned, alone):
    assert learned.segmenter_ is not alone.segmenter_
    own, before = (s.stages[0].classifier.coefs_[0] for s in (learned.segmenter_, alone.segmenter_))
    away = np.linalg.norm(own - before) / np.linalg.norm(before)
    assert 0 < away < 0.5
    for own, before in zip(learned.segmenter_.stages, alone.segmenter_.stages):
        np.testing.assert_array_equal(own.mean, before.mean)  # which would be that of the round's scans otherwise


def test_new_scans_find_their_subject(tube_rig, learned, alone, scans):
    for k in (10, 11):
        own, other = ("ann", "bob") if k % 2 == 0 else ("bob", "ann")
        r = learned.fit_scan(scans[k].points)
        assert f"on the template of subject {own!r}" in r.message
        named = learned.fit_scan(scans[k].points, subject=own)
        np.testing.assert_array_equal(named.vertices, r.vertices)
        wrong = learned.fit_scan(scans[k].points, subject=other)
        assert repr(other) in wrong.message and wrong.terms["recon"] > r.terms["recon"]
    found = [learned.fit_scan(s.points) for s in scans[12:16]]
    single = [alone.fit_scan(s.points) for s in scans[12:16]]
    assert _error(tube_rig, found, scans[12:16]) < 0.6 * _error(tube_rig, single, scans[12:16])


def test_what_fit_scan_takes_counts_after_learning_too(tube_rig, learned, scans):
    s = scans[12]
    known = learned.fit_scan(s.points, labels=s.labels, subject="ann")
    np.testing.assert_array_equal(known.labels, s.labels)
    assert (known.confidence == 1).all() and _error(tube_rig, [known], [s]) < 0.03
    started = learned.fit_scan(s.points, theta0=s.pose, subject="ann")
    assert _error(tube_rig, [started], [s]) < 0.03
    behind = s.pose.copy()
    behind[0] += [0.0, np.pi, 0.0]
    away = learned.fit_scan(s.points, theta0=behind, subject="ann")  # the start is taken, and not another in its place
    assert _error(tube_rig, [away], [s]) > 0.1
    clutter = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    weights = np.r_[np.ones(len(s.points)), np.zeros(200)]
    both = learned.fit_scan(np.vstack([s.points, clutter]), point_weights=weights, subject="ann")
    plain = learned.fit_scan(s.points, point_weights=weights[: len(s.points)], subject="ann")
    np.testing.assert_array_equal(both.vertices, plain.vertices)
    assert both.labels.shape == (len(s.points) + 200,)


def test_a_new_scan_in_another_unit(tube_rig, learned, scans):
    s = scans[12]
    r = learned.fit_scan(1000.0 * s.points + [5.0, 0, 0])
    assert r.scale == pytest.approx(1000.0, rel=0.03)
    assert np.linalg.norm(r.joints - [5.0, 0, 0] - 1000 * s.joints, axis=1).mean() < 1000 * 0.03 * tube_rig.size / 2


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_new_scan_that_is_turned(tube_rig, learned, scans, unit):
    """Found under its turn, and again from the pose that was found."""
    s, turn = scans[12], matrix_from_rotvec(np.array([0.0, 2.0, 0.0]))
    points = unit * s.points @ turn.T + 3 * unit
    for given in ({}, {"theta0": learned.fit_scan(points).pose, "subject": "ann"}, {"labels": s.labels}):
        r = learned.fit_scan(points, **given)
        back = (r.joints - 3 * unit) @ turn / unit
        assert np.linalg.norm(back - s.joints, axis=1).mean() < 0.03 * tube_rig.size / 2, list(given)
        posed = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
        np.testing.assert_array_equal(posed, r.vertices)


def test_turned_scans_are_learned_from(tube_rig, make, few):
    """Each turned in its own way: what is learned is the same person's template."""
    turns = [matrix_from_rotvec(np.array([0.0, a, 0.0])) for a in (0.0, 1.0, 2.5, -2.0, -0.7)]
    fitter = make(held_out=0).fit([s.points @ turn.T for s, turn in zip(few, turns)])
    for r, s, turn in zip(fitter.results_, few, turns, strict=True):
        assert np.linalg.norm(r.joints @ turn - s.joints, axis=1).mean() < 0.05 * tube_rig.size / 2
    person = tube_rig.subject(3, amount=1.5)
    found, before = (r.vertices - person.vertices for r in (fitter.template_[0], tube_rig))
    gaps = [np.linalg.norm(d - d.mean(axis=0), axis=1).mean() for d in (found, before)]
    assert gaps[0] < 0.6 * gaps[1]


@pytest.mark.parametrize("subject", ["carl", 0, ["ann"]])
def test_a_subject_that_nobody_knows(learned, tube_rig, scans, subject):
    with pytest.raises(InputError, match="subject: got .*expected one of 'ann', 'bob'"):
        learned.fit_scan(scans[0].points, subject=subject)
    with pytest.raises(InputError, match="subject: got .*expected one of 'ann', 'bob'"):
        learned.transform([scans[0].points], [subject])
    with pytest.raises(InputError, match="no subject, as nothing was learned yet"):
        lbs.LBSFitter(tube_rig, **SMALL).fit_scan(scans[0].points, subject=subject)


def test_transform_and_score(tube_rig, learned, scans):
    given = [scans[10].points, NAN, lambda: scans[11].points]
    with pytest.warns(UserWarning, match="scan 1 cannot be fitted: points: got 50 of 50"):
        V = learned.transform(given)
    assert V.shape == (3, *tube_rig.vertices.shape) and np.isnan(V[1]).all()
    results = [learned.fit_scan(s.points) for s in scans[10:12]]
    np.testing.assert_array_equal(V[[0, 2]], [r.vertices for r in results])
    assert learned.transform([]).shape == (0, *tube_rig.vertices.shape)
    score = learned.score([s.points for s in scans[10:12]], ["ann", "bob"])
    assert score == pytest.approx(-np.mean([r.terms["recon"] for r in results]))
    assert learned.score([s.points for s in scans[10:12]], ["bob", "ann"]) < score < 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert np.isnan(learned.score([NAN]))
    with pytest.raises(InputError, match="subjects: got 1 ids; expected 2"):
        learned.transform(given[:2], ["ann"])


def test_what_wants_learning_says_so(alone, tmp_path):
    for call in (lambda: alone.transform([]), lambda: alone.score([]), lambda: alone.save(tmp_path / "m.npz")):
        with pytest.raises(InputError, match=r"fitter: got one that has learned nothing.*fit\(scans\)"):
            call()


def test_estimator_conventions(learned, make):
    from sklearn.base import clone

    fresh = clone(learned)
    assert fresh.get_params() == learned.get_params() and fresh.rig is learned.rig
    assert not [name for name in vars(fresh) if name.endswith("_")]
    for name in ("results_", "segmenter_", "regressor_", "template_", "unit_", "history_", "failures_"):
        assert hasattr(learned, name)
    assert make(variant="cd", rounds=2).get_params()["variant"] == "cd"


def test_another_rig_is_refused_after_learning(learned, tube_rig, scans):
    for rig in (tube_rig.scaled(2.0), tube_rig.with_parts("arm and fingers"), lbs.load_rig("hand-coarse")):
        other = copy.copy(learned).set_params(rig=rig)
        with pytest.raises(InputError, match="rig: got .*the rig that the fitter learned with"):
            other.fit_scan(scans[0].points)


# ---- files ----


@pytest.fixture(scope="module")
def saved(learned, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "m.npz"
    learned.save(path)
    return path


def test_saved_and_loaded_fits_are_the_same(learned, saved, scans):
    again = lbs.LBSFitter.load(saved)
    assert again.rig.digest == learned.rig.digest and again.rig.parts == learned.rig.parts
    ours, theirs = again.get_params(), learned.get_params()
    assert {k: v for k, v in ours.items() if k != "rig"} == {k: v for k, v in theirs.items() if k != "rig"}
    assert again.history_ == learned.history_ and again.unit_ == learned.unit_
    for name, template in learned.template_.items():
        np.testing.assert_array_equal(again.template_[name].vertices, template.vertices)
        np.testing.assert_array_equal(again.template_[name].joints, template.joints)
    for options in ({}, {"subject": "bob"}):
        a, b = (f.fit_scan(scans[12].points, **options) for f in (learned, again))
        for name in ("pose", "vertices", "joints", "offsets", "rest_joints", "labels", "confidence"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert a.terms == b.terms and a.message == b.message
    again.save(saved.with_name("again.npz"))
    with np.load(saved) as x, np.load(saved.with_name("again.npz")) as y:
        assert set(x.files) == set(y.files) and all(np.array_equal(x[k], y[k]) for k in x.files)


def test_the_file_holds_plain_arrays_and_is_a_rig(saved, learned):
    with np.load(saved, allow_pickle=False) as z:
        arrays = {k: z[k] for k in z.files}
    assert {a.dtype.kind for a in arrays.values()} <= set("biufU")
    assert "lbsfit_np_model" in arrays and any(k.startswith("model_library") for k in arrays)
    assert lbs.load_rig(saved, card="none").digest == learned.rig.digest


@pytest.mark.parametrize(
    "parameters", [{"weights": "paper"}, {"weights": lbs.losses.LossWeights(lam=0.5)}, {"training": Synthesis(turn=1.0)}]
)
def test_parameters_travel(learned, tmp_path, parameters):
    fitter = copy.copy(learned).set_params(random_state=np.random.default_rng(0), **parameters)
    fitter.save(tmp_path / "m.npz")
    again = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert again._fit_settings() == fitter._fit_settings() and again._synthesis() == fitter._synthesis()
    assert again.random_state is None


def test_other_parts_of_the_rig_travel(tmp_path, scans):
    rig = build_rig(make_tube_data(), parts="arm and fingers")
    fitter = lbs.LBSFitter(rig, variant="cd", **SMALL).fit([s.points for s in scans[:4]])
    fitter.save(tmp_path / "m.npz")
    again = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert again.rig.parts == ("arm", "fingers") and again.segmenter_ is None
    np.testing.assert_array_equal(again.fit_scan(scans[6].points).vertices, fitter.fit_scan(scans[6].points).vertices)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_model_is_one_clear_error(saved, tmp_path, share):
    path = tmp_path / "cut.npz"
    path.write_bytes(saved.read_bytes()[: int(share * saved.stat().st_size)])
    with pytest.raises(FileError, match=r"cut\.npz"):
        lbs.LBSFitter.load(path)


@pytest.mark.parametrize(
    "lost", ["model_vertices", "model_library_poses", "model_stage_0_mean", "weights_data", "lbsfit_np_model"]
)
def test_a_model_that_lacks_something_is_one_clear_error(saved, tmp_path, lost):
    path = tmp_path / "less.npz"
    with zipfile.ZipFile(saved) as z:
        members = {n: z.read(n) for n in z.namelist()}
    assert members.pop(f"{lost}.npy")
    with zipfile.ZipFile(path, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError, match=r"less\.npz"):
        lbs.LBSFitter.load(path)


@pytest.mark.parametrize(
    "key, change",
    [
        ("model_vertices", lambda a: a[:, :5]),
        ("model_joints", lambda a: a[:1]),
        ("model_library_poses", lambda a: a[:, :2]),
        ("model_library_looks", lambda a: a[:, :7]),
        ("model_library_bias_0", lambda a: a[:3]),
        ("lbsfit_np_model", lambda a: np.array(str(a).replace('"format": ', '"format": 9'))),
        ("lbsfit_np_model", lambda a: np.array("{")),
        ("lbsfit_np_model", lambda a: np.array(str(a).replace('"joint"', '"joyful"'))),
        ("lbsfit_np_model", lambda a: np.array("[1, 2]")),
    ],
)
def test_a_model_whose_content_does_not_fit_is_one_clear_error(saved, tmp_path, key, change):
    with np.load(saved) as z:
        arrays = {k: z[k] for k in z.files}
    arrays[key] = change(arrays[key])
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(FileError, match=r"odd\.npz"):
        lbs.LBSFitter.load(tmp_path / "odd.npz")


def test_other_files_are_no_models(learned, tube_rig, tmp_path):
    tube_rig.save(tmp_path / "rig.npz")
    learned.results_[0].save(tmp_path / "result.npz")
    (tmp_path / "text.npz").write_text("text")
    for name in ("rig.npz", "result.npz", "text.npz", "none.npz"):
        with pytest.raises(FileError, match=name):
            lbs.LBSFitter.load(tmp_path / name)
    with pytest.raises(FileError, match=r"m\.zip.*ends in \.npz"):
        learned.save(tmp_path / "m.zip")
    with pytest.raises(FileError, match="does not exist"):
        learned.save(tmp_path / "nowhere" / "m.npz")


# ---- variants, seeds and processes ----


@pytest.fixture(scope="module")
def few(scans):
    """Five scans of one subject."""
    return scans[:10:2]


@pytest.mark.parametrize("variant", ["pose-only", "rand", "cd", "free-form"])
def test_every_variant_learns(tube_rig, make, few, scans, variant, monkeypatch):
    if variant in ("cd", "free-form"):  # no labels anywhere: s is neither trained nor asked
        for name in ("learning.pretraining.train_segmenter", "learning.loop.train_segmenter"):
            monkeypatch.setattr(f"lbsfit_np.{name}", lambda *a, **k: pytest.fail("trained s"))
        monkeypatch.setattr("lbsfit_np.segmentation.segmenter.Segmenter.predict_proba", lambda *a, **k: pytest.fail("asked s"))
        monkeypatch.setattr("lbsfit_np.fitting.refit.start_from_parts", lambda *a, **k: pytest.fail("a start from parts"))
    fitter = make(variant=variant).fit([s.points for s in few])
    assert list(fitter.template_) == [0] and all(r.status == "ok" for r in fitter.results_)
    # Without skinning the joints stay where the rest pose has them, which the results say.
    assert all((r.probability > 0) == (variant != "free-form") for r in fitter.results_)
    error = _error(tube_rig, fitter.results_, few)
    new = fitter.fit_scan(scans[12].points)
    assert new.status == "ok" and len(new.labels) == len(scans[12].points)
    if variant == "free-form":
        assert fitter.history_ == [] and fitter.regressor_ is None and fitter.template_[0] is tube_rig
        assert fitter.unit_ == {0: 1.0}
        assert all((r.pose[1:] == np.clip(0.0, tube_rig.lower, tube_rig.upper)[1:]).all() for r in fitter.results_)
        assert 0.1 < error < 0.5  # the rest pose, put where the scan is
    else:
        assert error < 0.05 and _error(tube_rig, [new], [scans[12]]) < 0.06
        assert (fitter.segmenter_ is None) == (variant == "cd") and len(fitter.history_) == 2
    if variant in ("cd", "free-form"):
        assert "structured" not in fitter.results_[0].terms and "structured" not in new.terms


def test_variants_train_on_what_they_say(tube_rig, make, few):
    """Which poses and templates a round's training scans are made of."""
    collection = _read(tube_rig, [s.points for s in few])
    for m, s in zip(collection.members, few):
        m.state = make()._model().rest().replace(theta=s.pose)
    templates = {0: (tube_rig.vertices * 1.1, tube_rig.joints * 1.1)}
    for name, n_poses, n_templates in (("joint", 4, 1), ("pose-only", 4, 0), ("rand", 0, 0)):
        loop = _loop(tube_rig, collection, name, None)
        made = loop._mixture(1, templates)
        assert (len(made.poses), len(made.templates)) == (n_poses, n_templates)
        assert len(loop._mixture(0, {}).poses) == 0
    held = next(m for m in collection.members if m.held_out)
    poses = _loop(tube_rig, collection, "joint", None)._mixture(1, templates).poses
    assert not (poses == held.state.theta).all(axis=(1, 2)).any()


def _loop(rig, collection, variant, segmenter, library=None, **options):
    given = {
        "turns": np.eye(3)[None],
        "fit_settings": FitSettings(),
        "settings": LoopSettings.for_training(200, rounds=1),
        "synthesis": Synthesis(n_points=400),
        "joints": "follow",
        "sequence": False,
        "smooth": 0.0,
        "jobs": 1,
        "random_state": 0,
        "progress": None,
    }
    return Loop(rig, collection, as_variant(variant), segmenter, library, **(given | options))


def test_people_of_another_size_stay_where_they_are(tube_rig, alone):
    """A scale near 1 goes into the template, which grows about the root joint, not about the origin."""
    size = 1.2
    made = lbs.synthesize(tube_rig, 4, random_state=3, shape=0.0, holes=0, n_points=400)
    collection = _read(tube_rig, [size * s.points for s in made])
    loop = _loop(tube_rig, collection, "joint", alone.segmenter_, alone.regressor_)
    assert np.linalg.norm(loop.model.rig.joints[0]) > 0.5
    loop._first_fits()
    for m, s in zip(collection.members, made):
        assert m.unit == 1.0 and m.state.scale == 1.0
        posed = loop.shifting.pose(m.state.replace(coefficients=loop.coefficients[0]))[0]
        true = m.frame.inside(size * s.vertices)
        assert np.linalg.norm((posed.vertices - true).mean(axis=0)) < 0.1
    c = loop.coefficients[0]
    assert (c[: loop.model.n_coefficients] > 0.05).all() and not c[loop.model.n_coefficients :].any()


def test_scans_in_another_unit_learn_the_same(tube_rig, make, few):
    """Millimetres: the unit is found once, the template is in the rig's own."""
    fitter = make(variant="cd").fit([250 * s.points for s in few[:3]])
    assert fitter.unit_[0] == 250.0
    assert np.mean([np.linalg.norm(r.joints - 250 * s.joints, axis=1).mean() for r, s in zip(fitter.results_, few)]) < 8
    assert fitter.template_[0].size == pytest.approx(tube_rig.subject(3, amount=1.5).size, rel=0.05)
    free = make(variant="free-form").fit([250 * s.points for s in few[:3]])
    assert free.unit_[0] == 250.0 and free.results_[0].scale == pytest.approx(250, rel=0.5)


def test_results_do_not_depend_on_the_number_of_processes(make, few):
    found = [make(n_jobs=jobs).fit([s.points for s in few]) for jobs in (1, 2)]
    for a, b in zip(*(f.results_ for f in found)):
        for name in ("pose", "vertices", "joints", "offsets", "labels", "confidence"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert a.terms == b.terms
    h, g = ([{k: v for k, v in e.items() if k != "seconds"} for e in f.history_] for f in found)
    assert h == g
    np.testing.assert_array_equal(found[0].template_[0].vertices, found[1].template_[0].vertices)


def test_a_seed_decides_all_and_other_kinds_of_seeds_work(make, few):
    points = [s.points for s in few[:3]]
    first, again = (make(variant="cd", random_state=5).fit(points).results_[0].vertices for _ in range(2))
    np.testing.assert_array_equal(first, again)
    for seed in (None, np.random.default_rng(0), np.int64(5)):
        fitter = make(variant="cd", random_state=seed).fit(points)
        assert all(r.status == "ok" for r in fitter.results_)
    np.testing.assert_array_equal(fitter.results_[0].vertices, first)
    joint = make(random_state=np.random.default_rng(1), held_out=0).fit(points)
    assert len(joint.results_) == 3 and joint.history_[0]["recon_held_out"] is None
    assert joint.fit_scan(few[4].points).status == "ok"


def test_learning_again_starts_anew(make, few):
    fitter = make(variant="cd")
    first = fitter.fit([s.points for s in few[:3]]).results_[0].vertices
    fitter.set_params(variant="free-form").fit([s.points for s in few[:4]], list("abcd"))
    assert len(fitter.results_) == 4 and list(fitter.template_) == list("abcd")
    fitter.set_params(variant="cd").fit([s.points for s in few[:3]])
    assert len(fitter.results_) == 3 and list(fitter.template_) == [0]
    np.testing.assert_array_equal(fitter.results_[0].vertices, first)


def test_rounds_end_when_the_loss_on_scans_left_out_ends_falling(make, few, monkeypatch):
    """The best round's state is what counts."""
    values = iter([0.5, 0.4, 0.399, 0.3])
    noted = Loop._note

    def note(self, k, began, more):
        noted(self, k, began, more)
        return 1.0 if k == 0 else next(values)

    monkeypatch.setattr(Loop, "_note", note)
    fitter = make(variant="cd", rounds=6).fit([s.points for s in few[:4]])
    assert [h["round"] for h in fitter.history_] == [0, 1, 2, 3]  # 0.399 is no improvement on 0.4 worth a round
    values = iter([0.4, 0.6])
    templates = []
    found = Loop._templates
    monkeypatch.setattr(Loop, "_templates", lambda self: templates.append(found(self)) or templates[-1])
    fitter = make(variant="cd", rounds=6).fit([s.points for s in few[:4]])
    assert len(templates) == 2 and len(fitter.history_) == 3
    np.testing.assert_array_equal(fitter.template_[0].vertices, templates[0][0][0])


# ---- sequences ----


@pytest.fixture(scope="module")
def walk(tube_rig, subjects):
    """Seven scans of a slow bend, seen by few noisy points."""
    t = np.linspace(0, 1, 7)[:, None, None]
    start, stop = 0.5 * tube_rig.lower, 0.7 * tube_rig.upper
    template = subjects["ann"].vertices, subjects["ann"].joints
    poses = (1 - t) * start + t * stop
    return lbs.synthesize(tube_rig, 7, poses=poses, templates=[template], random_state=4, n_points=200, noise=0.02, holes=0)


def _roughness(results):
    poses = np.array([r.pose for r in results])
    return np.abs(np.diff(poses, n=2, axis=0)).mean()


def test_smooth_sequences_are_smoother_and_as_near(tube_rig, make, walk):
    points = [s.points for s in walk]
    rough, smooth = (make(variant="cd", sequence=True, smooth=w, held_out=0).fit(points).results_ for w in (0.0, 1e-3))
    assert _roughness(smooth) < 0.4 * _roughness(rough)
    assert _error(tube_rig, smooth, walk) < 1.1 * _error(tube_rig, rough, walk)
    away = [np.mean([np.abs(r.pose - s.pose).mean() for r, s in zip(found, walk)]) for found in (smooth, rough)]
    assert away[0] < 0.75 * away[1]


def test_sequences_start_from_neighbours(tube_rig, few):
    collection = _read(tube_rig, [s.points for s in few] * 2, [0, 1] * 5)
    for m in collection.members:
        m.state = type("State", (), {"theta": np.full((4, 3), float(m.index))})
    in_order, unordered = (_loop(tube_rig, collection, "cd", None, sequence=s) for s in (True, False))
    beside = [[theta[1, 0] for theta in in_order._beside(m)] for m in collection.members]
    assert beside[:4] == [[2], [3], [0, 4], [1, 5]] and beside[-1] == [7]  # of one's own subject only
    assert not any(unordered._beside(m) for m in collection.members)


def test_neighbours_that_are_turned_otherwise_are_seen_in_ones_own_frame(tube_rig, few):
    collection = _read(tube_rig, [s.points for s in few], held_out=0)
    for k, (m, s) in enumerate(zip(collection.members, few)):
        m.state = type("State", (), {"theta": s.pose})
        m.use_frame(1.0, 1.0, matrix_from_rotvec(np.array([0.2, 1.3 * k, -0.1 * k])))
    loop, pivot = _loop(tube_rig, collection, "cd", None, sequence=True), tube_rig.joints[tube_rig.root]
    for m, beside in zip(collection.members[1:], collection.members):
        before = loop._beside(m)[0]
        outside = [(tube_rig.pose(t) - pivot) @ n.frame.turn.T for t, n in ((before, m), (beside.state.theta, beside))]
        np.testing.assert_allclose(*outside, atol=1e-12)


def test_turns_that_are_written_otherwise_are_neighbours_all_the_same():
    """3 rad and −3.2 rad about one axis are nearly one turn; their mean must not be −0.1."""
    axis = np.array([0.6, 0.0, 0.8])
    own, beside = np.zeros((3, 3)), np.ones((3, 3))
    own[1], beside[1] = 3.0 * axis, -3.2 * axis
    alike = _alike(beside, own, 1)
    np.testing.assert_allclose(alike[1], (2 * np.pi - 3.2) * axis)
    np.testing.assert_allclose(matrix_from_rotvec(alike), matrix_from_rotvec(beside), atol=1e-12)
    np.testing.assert_array_equal(alike[[0, 2]], 1.0)
    np.testing.assert_array_equal(beside[1], -3.2 * axis)
    still = np.zeros((3, 3))
    np.testing.assert_array_equal(_alike(still, own, 1), still)
    own[1], beside[1] = -7.0 * axis, 2.0 * axis
    np.testing.assert_allclose(_alike(beside, own, 1)[1], (2.0 - 4 * np.pi + 2 * np.pi) * axis)


def test_smoothing_looks_at_turns_as_the_scan_itself_writes_them(tube_rig, few, monkeypatch):
    collection = _read(tube_rig, [s.points for s in few], held_out=0)
    axis = np.array([0.6, 0.0, 0.8])
    for k, m in enumerate(collection.members):
        m.state = lbs.LBSFitter(tube_rig)._model().rest()
        m.state.theta[0] = (3.0 if k % 2 else -3.2) * axis
    loop, asked = _loop(tube_rig, collection, "cd", None, sequence=True, smooth=1e-3), []
    monkeypatch.setattr("lbsfit_np.learning.loop.each", lambda work, tasks, **k: asked.extend(tasks) or [t[2] for t in tasks])
    loop._smooth({0: (tube_rig.vertices, tube_rig.joints)})
    assert asked
    for _, _, state, (wanted, weight) in asked:
        assert weight == 1e-3 and np.linalg.norm(wanted[0] - state.theta[0]) < 0.1
