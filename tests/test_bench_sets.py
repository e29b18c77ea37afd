"""The sets of the benchmarks: subjects and scans with consistent truth, measures, and the plain baseline."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.bench.baseline import PlainChamfer
from lbsfit_np.bench.body import SHAPES, body_rig, body_scans
from lbsfit_np.bench.hand import hand_rig, hand_scans, natural_poses
from lbsfit_np.bench.measure import joint_error, label_accuracy, recon, vertex_error
from lbsfit_np.bench.retarget import bvh_thetas
from lbsfit_np.bench.subjects import _directions, people_digest, subject
from lbsfit_np.io.bvh import read_bvh
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.chains import chains
from lbsfit_np.synthesis import Synthesis, synthesize_nth, training_poses

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def hand(shared_rigs):
    return hand_rig(shared_rigs)


@pytest.fixture(scope="module")
def body(shared_rigs):
    return body_rig(shared_rigs)


# ---- subjects ----


def bone_ratios(rig, joints):
    child = np.flatnonzero(rig.parents >= 0)
    before = np.linalg.norm(rig.joints[child] - rig.joints[rig.parents[child]], axis=1)
    after = np.linalg.norm(joints[child] - joints[rig.parents[child]], axis=1)
    return child[before > 0], (after / np.maximum(before, 1e-300))[before > 0]


@pytest.mark.parametrize("which", ["tube_rig", "hand"])
def test_subjects_are_changed_shapes_with_the_joints_that_go_with_them(which, request):
    rig = request.getfixturevalue(which)
    for seed in range(3):
        U, J = subject(rig, np.random.default_rng(seed))
        moved = np.linalg.norm(U - rig.vertices, axis=1) / rig.size
        assert 0.005 < moved.mean() and moved.max() < 0.2
        child, ratio = bone_ratios(rig, J)
        assert np.abs(ratio - 1).max() <= 0.12 + 1e-9 and np.ptp(ratio) > 0.01
        chain = chains(rig)
        within = (chain[child] == chain[rig.parents[child]]) & rig.moving[child]
        for c in np.unique(chain[child[within]]):  # one length a chain
            lengths = ratio[within & (chain[child] == c)]
            np.testing.assert_allclose(lengths, lengths[0], atol=1e-9)
        # the joints stay where they were in the skin: where the regressor puts them
        followed = rig.joints + rig.regressor @ (U - rig.vertices)
        assert np.linalg.norm(followed - J, axis=1)[rig.moving].max() < 0.01 * rig.size


@pytest.mark.parametrize("name", ["hand", "body"])
def test_the_skin_of_subjects_is_neither_torn_nor_folded(name):
    rig = lbs.load_rig(name)
    a, b = np.vstack([rig.faces[:, [0, 1]], rig.faces[:, [1, 2]], rig.faces[:, [2, 0]]]).T
    before, rest = normals(rig.vertices, rig.faces), np.linalg.norm(rig.vertices[a] - rig.vertices[b], axis=1)
    for seed in range(5):
        U, _ = subject(rig, np.random.default_rng(seed))
        stretch = np.linalg.norm(U[a] - U[b], axis=1) / rest
        assert 0.5 < stretch.min() and stretch.max() < 1.7  # 12 % by lengths, 12 % by thickness, and bends where chains meet
        assert np.einsum("fa,fa->f", before, normals(U, rig.faces)).min() > 0.5


def test_thickness_moves_the_skin_out_or_in_with_its_sign(tube_rig):
    """The same lengths with and without: what differs goes out or in on each chain, and no further than asked."""
    with_it, without = (subject(tube_rig, np.random.default_rng(4), thickness=t)[0] for t in (0.12, 0.0))
    rng = np.random.default_rng(4)
    n = chains(tube_rig).max() + 1
    rng.uniform(-1, 1, n)
    thick = 0.12 * rng.uniform(-1, 1, n)
    own = np.asarray(tube_rig.weights.toarray())
    middle = own[:, 1] > 0.999  # all of one bone, away from the caps
    along = tube_rig.joints[2] - tube_rig.joints[1]
    out = without - (tube_rig.joints[1] + np.outer((without - tube_rig.joints[1]) @ along / (along @ along), along))
    moved = np.einsum("va,va->v", with_it - without, out)[middle]
    assert middle.sum() > 10 and (np.sign(moved) == np.sign(thick[chains(tube_rig)[1]])).all()
    assert (np.abs(moved) <= 0.12 * np.einsum("va,va->v", out, out)[middle] + 1e-12).all()


def test_joints_in_one_place_do_not_tear_the_skin():
    """A joint that stands where the one before it does goes with the bone that leads on."""
    data = make_tube_data()
    rig = build_rig(data)
    along = _directions(rig, chains(rig), rig.weights.toarray())
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0)
    doubled = rig.joints.copy()
    doubled[np.flatnonzero(rig.parents == 1)[0]] = doubled[1]
    along = _directions(replace(rig, joints=doubled), chains(rig), rig.weights.toarray())
    np.testing.assert_allclose(np.linalg.norm(along, axis=1), 1.0)


def test_other_people_are_not_put_with_those_there_are(monkeypatch):
    rig = lbs.load_rig("hand-coarse")
    assert people_digest(rig) == people_digest(rig)
    before = people_digest(rig)
    monkeypatch.setattr("lbsfit_np.bench.subjects._outwards", lambda vertices, faces, radius: np.zeros_like(vertices))
    assert people_digest(rig) != before


def normals(vertices, faces):
    p = vertices[faces]
    n = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def test_a_subject_without_changes_is_the_rig(tube_rig):
    U, J = subject(tube_rig, np.random.default_rng(0), amount=0.0, thickness=0.0)
    np.testing.assert_allclose(U, tube_rig.vertices, atol=1e-12)
    np.testing.assert_allclose(J, tube_rig.joints, atol=1e-12)


def test_thickness_alone_leaves_the_joints(tube_rig):
    U, J = subject(tube_rig, np.random.default_rng(0), amount=0.0)
    np.testing.assert_allclose(J, tube_rig.joints, atol=1e-12)
    assert np.abs(U - tube_rig.vertices).max() > 0.001


# ---- the sets ----


def test_hand_scans_are_as_defined_and_the_same_each_time(hand, shared_rigs):
    scans, again = hand_scans(hand, shared_rigs, 4, seed=7), hand_scans(hand, shared_rigs, 2, seed=7)
    for a, b in zip(scans, again):
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.pose, b.pose)
    assert np.abs(hand_scans(hand, shared_rigs, 1, seed=8)[0].pose - scans[0].pose).max() > 0.01
    natural = natural_poses(hand, shared_rigs)
    for i, s in enumerate(scans):
        assert s.points.shape == (2500, 3) and set(np.unique(s.labels)) <= set(range(16))
        assert np.abs(s.pose[hand.root]).max() <= 0.6
        joints = np.arange(len(hand.parents)) != hand.root
        away = np.abs(s.pose[joints] - natural[:, joints]).max(axis=(1, 2)).min()
        assert away <= 0.1 if i % 2 else away > 0.1
        posed = hand.with_template(s.template, s.template_joints)
        np.testing.assert_allclose(posed.pose(s.pose), s.vertices, atol=1e-12)
        np.testing.assert_allclose(posed.pose_joints(s.pose), s.joints, atol=1e-12)


def test_training_never_sees_the_tests_poses_or_shapes(hand, shared_rigs):
    """Not even where both have one seed: the streams have keys of their own, and the shapes are of different families."""
    test = hand_scans(hand, shared_rigs, 6, seed=0)
    trained = [synthesize_nth(hand, i, Synthesis(), poses=training_poses, random_state=0) for i in range(6)]
    for a in test:
        for b in trained:
            assert np.abs(a.pose - b.pose).max() > 0.05
            assert np.linalg.norm(a.template - b.template, axis=1).mean() > 0.002 * hand.size


@pytest.mark.slow
def test_body_scans_are_other_people_in_poses_of_the_motion(body, shared_rigs):
    scans, again = body_scans(body, shared_rigs, 4, seed=7), body_scans(body, shared_rigs, 4, seed=7)
    people = [body_rig(shared_rigs, shape) for shape in SHAPES]
    clip = read_bvh(shared_rigs / "motion" / "01_01.bvh")
    motion = [bvh_thetas(person, clip, np.arange(1, len(clip.rotations)), face_forward=True) for person in people]
    for i, s in enumerate(scans):
        np.testing.assert_array_equal(s.points, again[i].points)
        person = people[i % 2]
        np.testing.assert_array_equal(s.template, person.vertices)
        # the truth is the rig's, on the person's template ...
        np.testing.assert_allclose(body.with_template(s.template, s.template_joints).pose(s.pose), s.vertices, atol=1e-12)
        # ... and the person's own, whose frames differ from the rig's
        own = np.einsum("jba,jbc,jc->ja", person.frames, body.frames, s.pose)
        assert np.abs(motion[i % 2] - own).max(axis=(1, 2)).min() < 1e-9
        np.testing.assert_allclose(person.pose(own), s.vertices, atol=1e-12)
        np.testing.assert_allclose(person.pose_joints(own), s.joints, atol=1e-12)
        turning = np.arange(len(body.parents)) != body.root
        assert (s.pose <= body.upper + 1e-9)[turning].all() and (s.pose >= body.lower - 1e-9)[turning].all()
        assert s.points.shape == (5000, 3)


# ---- measures ----


def test_measures_are_what_they_say():
    a = np.array([[0.0, 0, 0], [1, 0, 0], [5, 5, 5]])
    b = a + [[0.3, 0.4, 0], [0, 0, 1], [9, 9, 9]]
    assert joint_error(a, b, np.array([True, True, False])) == pytest.approx(0.75)
    assert vertex_error(a[:2], b[:2]) == pytest.approx(0.75)
    assert label_accuracy(np.array([0, 1, 2, 2]), np.array([0, 1, 2, 0])) == 0.75
    assert recon(a[:1], np.array([[0.0, 0, 2]])) == pytest.approx(np.sqrt(8))


def test_what_is_measured_does_not_hang_on_threads():
    from threadpoolctl import threadpool_limits

    rng = np.random.default_rng(0)
    for _ in range(10):
        X, V, found = rng.standard_normal((6000, 3)), rng.standard_normal((7000, 3)), set()
        for threads in (1, 2):
            with threadpool_limits(threads):
                found.add(recon(X, V))
        assert len(found) == 1


# ---- the plain baseline ----


def test_the_baseline_recovers_a_pose_near_rest(tube_rig):
    pose = np.clip(0.15, tube_rig.lower, tube_rig.upper) * (tube_rig.upper > tube_rig.lower)
    scan = lbs.synthesize(tube_rig, 1, poses=pose[None], shape=0.0, noise=0.0, holes=0, random_state=1)[0]
    moved = replace(scan, points=scan.points * 1000 + [5.0, 6.0, 7.0])  # in another unit, elsewhere
    fit = PlainChamfer(tube_rig).fit_scan(moved)
    unit = tube_rig.size / 2
    assert joint_error(fit.joints, scan.joints * 1000 + [5, 6, 7], tube_rig.moving) / 1000 < 0.03 * unit
    assert vertex_error(fit.vertices, scan.vertices * 1000 + [5, 6, 7]) / 1000 < 0.03 * unit
    again = tube_rig.pose(fit.pose, fit.translation, fit.scale, fit.offsets, joints=fit.rest_joints)
    np.testing.assert_allclose(again, fit.vertices, rtol=1e-9)
    assert fit.status == "ok" and fit.evaluations > 5 and label_accuracy(fit.labels, scan.labels) > 0.85
    at_rest = tube_rig.joints + scan.points.mean(axis=0) - tube_rig.vertices.mean(axis=0)
    assert joint_error(at_rest, scan.joints, tube_rig.moving) > 0.05 * unit
