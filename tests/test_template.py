"""The template that scans share: a subject's shape and joints come back from many poses; wrong poses do not bend it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import make_tube_data, with_slivers

import lbsfit_np as lbs
from lbsfit_np.bench.subjects import subject as bench_subject
from lbsfit_np.fitting.template import SHIFTS, TemplateSettings, shared_template
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.precision import told_angles
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.surface import vertex_normals
from lbsfit_np.rig.build import build_rig

CLEAN = {"noise": 0.002, "holes": 0, "density": 0.0, "n_points": 800}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1):
        yield


@pytest.mark.parametrize("faces", [[], [[242, 243, 244]]])
def test_vertices_that_no_surface_hangs_on_are_left_where_they_are(tube_rig, faces):
    """Those without a face, which are left out, or of triangles without area, of which nothing says how they move."""
    data = make_tube_data()
    along = data.vertices[:1] + np.outer([0.1, 0.2, 0.3], [0.0, 1.0, 0.0])
    more = replace(
        data,
        vertices=np.vstack([data.vertices, along]),
        weights=sparse.vstack([data.weights, data.weights[[5, 5, 5]]]).tocsr(),
        faces=np.vstack([data.faces, np.array(faces, dtype=int).reshape(-1, 3)]),
    )
    case = Case(build_rig(more), (np.vstack([tube_rig.vertices, along]), tube_rig.joints), n=3)
    U, _, c = case.found()
    own = case.model.rig.vertices + (case.model.basis @ c).reshape(-1, 3)
    assert np.isfinite(U).all() and len(U) == 242 + 3 * len(faces)
    np.testing.assert_allclose(U[242:] / case.half, own[242:], atol=1e-9)
    assert np.abs(U[:242] / case.half - own[:242]).max() > 1e-6


def test_slivers_do_not_rule_the_skins_smoothness():
    rig = build_rig(with_slivers(make_tube_data()))
    bulge = 0.02 * rig.size / 2 * np.cos(3 * rig.vertices[:, 1:2]) * vertex_normals(rig.vertices, rig.faces)
    case = Case(rig, (rig.vertices + bulge, rig.joints), n=3)
    U, _, _ = case.found()
    normals = vertex_normals(rig.vertices, rig.faces)
    off = np.abs(np.einsum("ma,ma->m", U - case.U, normals)) / case.half
    assert off.mean() < 0.008 and off.max() < 0.05


class Case:
    """A rig, a subject of it, and scans of the subject with poses near the truth."""

    def __init__(self, rig, template, n=8, poses="uniform", **scans):
        self.rig, (self.U, self.J), self.half = rig, template, rig.size / 2
        self.model = Model(rig, shifts=SHIFTS)
        self.scans = lbs.synthesize(rig, n, templates=[template], random_state=1, poses=poses, **CLEAN | scans)
        self.problems = [Problem((s.points - s.points.mean(axis=0)) / self.half) for s in self.scans]
        rng = np.random.default_rng(0)
        turning = (rig.upper > rig.lower) & rig.moving[:, None]
        self.states = []
        for s in self.scans:
            theta = np.clip(s.pose + 0.08 * rng.uniform(-1, 1, s.pose.shape) * turning, rig.lower, rig.upper)
            place = -s.points.mean(axis=0) / self.half
            self.states.append(self.model.rest().replace(theta=theta, translation=place))
        self.proba = [np.eye(len(rig.parts))[s.labels] for s in self.scans]
        self.losses = np.ones(n)

    def found(self, model=None, rows=slice(None), **options):
        model = model or self.model
        return shared_template(model, self.problems[rows], self.states[rows], self.losses[rows], **options)

    def gap(self, found, true):
        """Mean distance in half sizes, the centroids laid on each other."""
        away = found - true
        return np.linalg.norm(away - away.mean(axis=0), axis=1).mean() / self.half


@pytest.fixture(scope="module")
def hand_case():
    rig = lbs.load_rig("hand-coarse")
    subject = rig.subject(5, amount=1.5)
    return Case(rig, (subject.vertices, subject.joints))


@pytest.fixture(scope="module")
def tube_case(tube_rig):
    subject = tube_rig.subject(5, amount=1.5)
    return Case(tube_rig, (subject.vertices, subject.joints))


@pytest.mark.slow
def test_joints_that_hardly_bend_stay_where_the_skin_says():
    """No scan shows then where they are, and noise would shift them."""
    rig, away = lbs.load_rig("hand-coarse"), {SHIFTS: [], 0.3: []}
    poses = 0.05 * lbs.natural_poses(rig, 6, random_state=2)
    for person in (5, 6, 7):
        subject = rig.subject(person, amount=1.5)
        case = Case(rig, (subject.vertices, subject.joints), 6, poses, noise=0.004)
        for shifts, gaps in away.items():
            gaps.append(case.gap(case.found(Model(rig, shifts=shifts))[1], case.J))
    assert np.mean(away[SHIFTS]) < 0.85 * np.mean(away[0.3])


@pytest.mark.parametrize("labelled", [False, True])
@pytest.mark.parametrize("which", ["tube", "hand"])
def test_a_subjects_template_comes_back(tube_case, hand_case, which, labelled):
    case = tube_case if which == "tube" else hand_case
    U, J, c = case.found(proba=case.proba if labelled else None)
    rig = case.rig
    assert U.shape == rig.vertices.shape and J.shape == rig.joints.shape and c.shape == (case.model.n_coefficients,)
    assert case.gap(U, case.U) < 0.4 * case.gap(rig.vertices, case.U)
    assert case.gap(J, case.J) < 0.65 * case.gap(rig.joints, case.J)
    assert np.linalg.norm(U - case.U, axis=1).mean() < 0.03 * case.half
    if labelled:
        assert case.gap(J, case.J) < 0.4 * case.gap(rig.joints, case.J)


def test_labels_are_refined_by_the_subjects_own_mesh(tube_case, monkeypatch):
    """By the template so far, in each scan's pose."""
    case, seen = tube_case, []
    c = np.random.default_rng(0).uniform(-0.3, 0.3, case.model.n_coefficients)
    states = [s.replace(coefficients=c) for s in case.states[:2]]

    def refined(X, proba, V, *more, **options):
        seen.append(V)
        return proba.argmax(axis=1)

    monkeypatch.setattr("lbsfit_np.fitting.template.refined_labels", refined)
    settings = TemplateSettings(sigmas=(0.05,), labelled_steps=0, steps=0, rounds=0)
    shared_template(case.model, case.problems[:2], states, np.ones(2), proba=case.proba, settings=settings)
    np.testing.assert_allclose(seen, [case.model.deformed(s).vertices for s in states], atol=1e-12)


def test_each_scans_pose_is_held_in_what_it_leaves_open_in_the_steps_without_labels(tube_case, monkeypatch):
    """By what its own points tell, on the template and in the pose that labels have led to; scans left out take theirs along."""
    case, seen, shared = tube_case, [], GaussNewton.shared

    def steps(self, problems, states, **options):
        seen.append(options | {"from": states})
        return shared(self, problems, states, **options)

    class Prior:
        def where_open(self, told, noise):
            return case.states[0].theta, noise * told

    monkeypatch.setattr(GaussNewton, "shared", steps)
    settings = TemplateSettings(sigmas=(0.05,), labelled_steps=1, steps=1, rounds=0)
    known = {"proba": case.proba, "settings": settings, "prior": Prior()}
    shared_template(case.model, case.problems, case.states, [9.0] + [1.0] * 7, **known)
    labelled, last = seen
    assert labelled.get("priors") is None and last.get("labels") is None and len(last["priors"]) == 7
    assert (last["from"][0].theta != case.states[1].theta).any()
    for (theta, weights), problem, state in zip(last["priors"], case.problems[1:], last["from"], strict=True):
        told, noise = told_angles(GaussNewton(case.model, reach=settings.reach, tangential=0.02), problem, state)
        assert theta is case.states[0].theta
        np.testing.assert_allclose(weights, noise * told, rtol=1e-9)


@pytest.mark.slow
def test_a_subject_that_the_family_does_not_hold(hand_case):
    """Lengths and thicknesses by another rule than the fit's own."""
    rig = hand_case.rig
    case = Case(rig, bench_subject(rig, np.random.default_rng(3)))
    U, J, _ = case.found(proba=case.proba)
    assert case.gap(U, case.U) < 0.5 * case.gap(rig.vertices, case.U)
    assert case.gap(J, case.J) < 0.5 * case.gap(rig.joints, case.J)
    without_heights, _, _ = case.found(proba=case.proba, settings=TemplateSettings(rounds=0))
    assert case.gap(U, case.U) < case.gap(without_heights, case.U)


@pytest.mark.slow
def test_a_fat_palm_leaves_the_knuckles_where_they_are():
    """People are wide of flesh as well as of bone; were their joints to move along, knuckles would lie beside the fingers."""
    rig = lbs.load_rig("hand-coarse")
    family = rig.proportions
    palm = int(np.argmax(np.bincount(family.owner)))  # three coefficients
    fat = 0.5 * family.girths.sum(axis=2)  # the palm alone branches
    assert family.girths.shape[2] == 2
    case = Case(rig, (rig.vertices + fat, rig.joints), 8, noise=0.004)
    knuckles = np.flatnonzero((rig.parents == palm) & rig.moving)
    _, J, _ = case.found(proba=case.proba)
    without = Model(rig, shifts=SHIFTS)
    without.basis = without.basis.copy()
    without.basis[:, without.n_proportions :] = 0.0
    _, other, _ = case.found(without, proba=case.proba)
    away = [np.linalg.norm((found - rig.joints)[knuckles], axis=1).mean() / case.half for found in (J, other)]
    assert away[0] < 0.5 * away[1]


def test_more_scans_tell_more(tube_case):
    few, many = (tube_case.found(rows=slice(n))[0] for n in (1, 8))
    assert tube_case.gap(many, tube_case.U) < 0.7 * tube_case.gap(few, tube_case.U)


def test_a_scan_with_a_wrong_pose_does_not_bend_it(tube_case):
    """Its loss tells; were it to count, it would."""
    case = tube_case
    wrong = case.states[7].replace(theta=case.rig.upper * 0.9)
    states = [*case.states[:7], wrong]
    without = case.found(rows=slice(7))
    left_out = shared_template(case.model, case.problems, states, [1.0] * 7 + [3.0])
    for a, b in zip(left_out, without):
        np.testing.assert_array_equal(a, b)
    counted, _, _ = shared_template(case.model, case.problems, states, np.ones(8))
    assert not np.array_equal(counted, without[0])


def test_probabilities_stay_with_their_scans(tube_case):
    """The first scan is left out: what the segmenter said of the others must not shift by one."""
    case = tube_case
    left_out = shared_template(case.model, case.problems, case.states, [9.0] + [1.0] * 7, proba=case.proba)
    without = case.found(rows=slice(1, 8), proba=case.proba[1:])
    for a, b in zip(left_out, without):
        np.testing.assert_array_equal(a, b)


def test_heights_stay_on_the_normals_and_leave_joints_alone(hand_case):
    case, m = hand_case, hand_case.model
    U, J, c = case.found(settings=TemplateSettings(sigmas=(), steps=0))
    assert not c.any()
    np.testing.assert_allclose(J, case.rig.joints, atol=1e-14)
    moved = (U - case.rig.vertices) / case.half
    normals = vertex_normals(m.rig.vertices, m.rig.faces)
    height = np.einsum("ia,ia->i", moved, normals)
    np.testing.assert_allclose(moved, height[:, None] * normals, atol=1e-13)
    assert 0.003 < np.abs(height).mean() < 0.05


def test_a_thicker_skin_is_found_as_high_as_it_is(tube_rig):
    """Known poses, 2 % of a half size more skin everywhere."""
    half = tube_rig.size / 2
    normals = vertex_normals(tube_rig.vertices, tube_rig.faces)
    case = Case(tube_rig, (tube_rig.vertices + 0.02 * half * normals, tube_rig.joints))
    exact = [s.replace(theta=scan.pose) for s, scan in zip(case.states, case.scans)]
    settings = TemplateSettings(sigmas=(), steps=0)
    U = shared_template(case.model, case.problems, exact, case.losses, settings=settings)[0]
    height = np.einsum("ia,ia->i", U - tube_rig.vertices, normals) / half
    assert height.mean() == pytest.approx(0.02, rel=0.1) and height.std() < 0.005


def test_more_rounds_end_at_the_same_heights(tube_case):
    few, many = (
        tube_case.found(settings=TemplateSettings(sigmas=(), steps=0, small=0.3, rounds=rounds))[0] - tube_case.rig.vertices
        for rounds in (3, 12)
    )
    assert np.linalg.norm(many - few) < 0.2 * np.linalg.norm(few)


def test_smoothness_and_smallness_hold_the_heights(tube_case):
    def heights(**settings):
        U = tube_case.found(settings=TemplateSettings(sigmas=(), steps=0, **settings))[0]
        return (U - tube_case.rig.vertices) / tube_case.half

    free, small = heights(smooth=1e-6, small=1e-5), heights(small=100.0)
    assert np.abs(small).max() < 0.05 * np.abs(free).max()
    K = tube_case.model.K
    smooth = heights(smooth=1.0, small=1e-5)
    assert np.linalg.norm(K @ smooth) < 0.3 * np.linalg.norm(K @ free)


def test_joints_that_do_not_follow_stay(tube_case):
    model = Model(tube_case.rig, "fixed")
    states = [model.rest().replace(theta=s.theta, translation=s.translation) for s in tube_case.states]
    U, J, _ = shared_template(model, tube_case.problems, states, tube_case.losses)
    np.testing.assert_array_equal(J, model.rig.joints * model.half)
    assert tube_case.gap(U, tube_case.U) < 0.8 * tube_case.gap(tube_case.rig.vertices, tube_case.U)


def test_it_goes_on_from_its_own_coefficients(tube_case):
    case = tube_case
    U, _, c = case.found()
    again = [s.replace(coefficients=c) for s in case.states]
    V, _, _ = shared_template(case.model, case.problems, again, case.losses)
    assert case.gap(V, case.U) < 1.3 * case.gap(U, case.U)


def test_the_same_again_and_nothing_given_is_changed(tube_case):
    case = tube_case
    kept = [replace(s, theta=s.theta.copy(), translation=s.translation.copy()) for s in case.states]
    X = [p.X.copy() for p in case.problems]
    first, second = case.found(proba=case.proba), case.found(proba=case.proba)
    for a, b in zip(first, second):
        np.testing.assert_array_equal(a, b)
    for s, k, p, x in zip(case.states, kept, case.problems, X):
        np.testing.assert_array_equal(s.theta, k.theta)
        np.testing.assert_array_equal(s.translation, k.translation)
        np.testing.assert_array_equal(p.X, x)


@pytest.mark.slow
def test_weights_of_points_count(tube_rig):
    """Points without weight, beside the surface, do not lift it."""
    lifted = []
    for person in (5, 6, 7, 8):
        subject = tube_rig.subject(person, amount=1.5)
        case = Case(tube_rig, (subject.vertices, subject.joints), n=5)
        U = case.found()[0]
        light, heavy = [], []
        for p in case.problems:
            X, w = np.vstack([p.X, p.X + [0.0, 0.0, 0.05]]), np.r_[np.ones(len(p.X)), np.full(len(p.X), 1e-9)]
            light.append(Problem(X, w / w.sum()))
            heavy.append(Problem(X))
        lifted.append([case.gap(shared_template(case.model, ps, case.states, case.losses)[0], U) for ps in (light, heavy)])
    assert all(light < heavy for light, heavy in lifted)  # that of one person may be lifted by what rounding makes
    light, heavy = np.mean(lifted, axis=0)
    assert light < 0.5 * heavy
