"""Registration: known changes of the skin come back, joints stay, noise is not followed, and a fit is not judged by it."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from posed_samples import state_within
from scipy import sparse
from small_rigs import make_tube_data, with_slivers

import lbsfit_np as lbs
from lbsfit_np.fitting.confidence import evidence_of
from lbsfit_np.fitting.search import Search
from lbsfit_np.losses import cotangent_matrix
from lbsfit_np.neighbors import PointIndex
from lbsfit_np.optimize import registration
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.registration import Registration
from lbsfit_np.optimize.surface import vertex_normals
from lbsfit_np.rig.build import build_rig
from lbsfit_np.sensor import sample_seen_surface, sample_surface

pytestmark = pytest.mark.usefixtures("one_thread")

_NOISE = 0.003


@pytest.fixture(scope="module")
def models(tube_rig):
    return {"tube": Model(tube_rig), "hand": Model(lbs.load_rig("hand-coarse"))}


def _swollen(model, size=0.02):
    """A smooth change of the template along its normals, (m, 3)."""
    V = model.rig.vertices
    return size * np.sin(3 * V[:, :1] + 1) * np.cos(2 * V[:, 1:2]) * vertex_normals(V, model.rig.faces)


def _scan(model, state, n=3000, noise=_NOISE, seed=0):
    rng = np.random.default_rng(seed)
    points, _, _ = sample_surface(model.deformed(state).vertices, model.rig.faces, n, rng)
    return points + noise * rng.standard_normal(points.shape)


def _off(model, state, truth):
    """Mean distance of the vertices from the truth's surface, along its normals: what slides no scan tells."""
    V = model.deformed(truth).vertices
    away = np.einsum("ia,ia->i", model.deformed(state).vertices - V, vertex_normals(V, model.rig.faces))
    return np.abs(away).mean()


@pytest.mark.parametrize("which", ["tube", "hand"])
def test_a_known_change_of_the_skin_comes_back(models, which):
    model = models[which]
    for seed in range(2):
        posed = state_within(model, seed, 0.5)
        truth = posed.replace(displacement=_swollen(model))
        found = Registration(model)(Problem(_scan(model, truth, seed=seed)), posed)
        assert _off(model, found, truth) < 0.4 * _off(model, posed, truth)


def test_joints_and_pose_stay(models):
    model = models["tube"]
    residual = 0.01 * np.random.default_rng(3).standard_normal(model.rig.vertices.shape)
    posed = state_within(model, 3, 0.5).replace(residual=residual)
    truth = posed.replace(displacement=_swollen(model))
    found = Registration(model)(Problem(_scan(model, truth)), posed)
    np.testing.assert_array_equal(model.deformed(found).joints, model.deformed(posed).joints)
    assert np.abs(model.deformed(found).vertices - model.deformed(posed).vertices).max() > 0.01
    for name in ("theta", "translation", "coefficients", "residual"):
        np.testing.assert_array_equal(getattr(found, name), getattr(posed, name))
    assert found.scale == posed.scale and posed.displacement is None


def test_the_residual_is_not_where_it_begins(models):
    """What slid along the surface would stay there: distances along normals do not see it."""
    model = models["tube"]
    posed = state_within(model, 4, 0.5)
    truth = posed.replace(displacement=_swollen(model))
    slid = posed.replace(residual=0.05 * np.cross(vertex_normals(model.rig.vertices, model.rig.faces), [0.0, 0.0, 1.0]))
    problem = Problem(_scan(model, truth))
    found, other = Registration(model)(problem, posed), Registration(model)(problem, slid)
    # The joints are where the residual has them, the template is not.
    np.testing.assert_allclose(model.offsets(other), model.offsets(found), atol=0.01)


@pytest.mark.parametrize("noise", [0.003, 0.02])
def test_a_scan_of_the_template_itself_hardly_moves_it(models, noise):
    model = models["hand"]
    truth = state_within(model, 5, 0.5)
    found = Registration(model)(Problem(_scan(model, truth, noise=noise)), truth)
    assert _off(model, found, truth) < 0.25 * noise


def test_holes_are_filled_smoothly(models):
    model = models["tube"]
    posed = state_within(model, 6, 0.3)
    truth = posed.replace(displacement=_swollen(model))
    X = _scan(model, truth)
    centre = model.deformed(truth).vertices[np.argmax(model.rig.vertices[:, 1])]
    seen = np.linalg.norm(X - centre, axis=1) > 0.2
    assert 0.02 < 1 - seen.mean() < 0.5
    found = Registration(model)(Problem(X[seen]), posed)
    assert _off(model, found, truth) < 0.7 * _off(model, posed, truth)
    there = np.linalg.norm(model.deformed(truth).vertices - centre, axis=1) < 0.2
    away = np.linalg.norm(model.deformed(found).vertices - model.deformed(truth).vertices, axis=1)
    assert away[there].max() < 0.1


@pytest.mark.parametrize("which, limb", [("tube", "long"), ("hand", "index"), ("hand", "thumb")])
def test_skin_that_the_scan_lacks_is_not_drawn_to_what_is_beside_it(models, which, limb):
    model = models[which]
    posed = state_within(model, 14, 0.3)
    gone = np.flatnonzero([limb in name for name in model.rig.joint_names])
    V, weights = model.deformed(posed).vertices, model.rig.weights.toarray()
    lacks = np.isin(weights.argmax(axis=1), gone)
    X, face, barycentric = sample_surface(V, model.rig.faces, 6000, np.random.default_rng(14))
    X = X[~lacks[model.rig.faces[face, barycentric.argmax(axis=1)]]] + 0.001
    assert 0.02 < lacks.mean() < 0.5
    found = Registration(model)(Problem(X), posed)
    moved = np.linalg.norm(model.deformed(found).vertices - V, axis=1)
    assert moved[lacks].max() < 0.01 and moved[~lacks].max() < 0.01


def _hand_with(hand, vertices, faces, like):
    """The model of a hand with further vertices, in half sizes, and these faces; skinned as its vertices ``like`` are."""
    rig, k = hand.source.welded, len(vertices)
    weights = sparse.csr_array(rig.weights)
    weights = sparse.csr_array(sparse.vstack([weights, weights[like]]))
    regressor = sparse.csr_array(sparse.hstack([rig.regressor, sparse.csr_array((rig.regressor.shape[0], k))]))
    vertices = np.vstack([rig.vertices, vertices * rig.size / 2])
    return Model(replace(rig, vertices=vertices, faces=faces, weights=weights, regressor=regressor, shapes=None))


def test_slivers_do_not_rule_the_smoothness():
    model = Model(build_rig(with_slivers(make_tube_data())))
    assert np.abs(cotangent_matrix(model.rig.vertices, model.rig.faces)).max() > 1e8
    posed = state_within(model, 15, 0.5)
    truth = posed.replace(displacement=_swollen(model))
    found = Registration(model)(Problem(_scan(model, truth)), posed)
    assert _off(model, found, truth) < 0.4 * _off(model, posed, truth)
    assert np.linalg.norm(found.displacement, axis=1).max() < 0.06


@pytest.fixture(scope="module", params=[0.03, 0.08])
def with_a_ball(models, request):
    """The hand with a ball so far below its skin, where it is thick: (model, depth, a vertex above, the skin's normals)."""
    hand = models["hand"].rig
    normals = vertex_normals(hand.vertices, hand.faces)
    inside = hand.vertices - 0.1 * normals
    at = int(np.argmax(np.linalg.norm(inside - hand.vertices[PointIndex(hand.vertices).nearest(inside)], axis=1)))
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.01)
    vertices = ball.vertices + hand.vertices[at] - request.param * normals[at]
    faces = np.vstack([hand.faces, ball.faces + len(hand.vertices)])
    return _hand_with(models["hand"], vertices, faces, np.full(len(vertices), at)), request.param, at, normals


@pytest.mark.parametrize("swollen", [0.0, 0.02])
def test_what_is_beneath_the_skin_goes_along_with_it_or_stays(with_a_ball, swollen):
    """Nothing of it is seen, and its places look for points above: for the deep one few enough, so that those count as near."""
    model, depth, at, normals = with_a_ball
    m = len(normals)
    posed = state_within(model, 16, 0.3)
    truth = posed.replace(displacement=np.vstack([swollen * normals, np.zeros((len(model.rig.vertices) - m, 3))]))
    skin = model.rig.faces[model.rig.faces.max(axis=1) < m]
    X, _, _ = sample_surface(model.deformed(truth).vertices[:m], skin, 4000 if depth < 0.05 else 600, np.random.default_rng(16))
    u = Registration(model)(Problem(X), posed).displacement
    u = np.zeros_like(model.rig.vertices) if u is None else u
    assert np.linalg.norm(u[m:] - (u[at] if depth < 0.05 else 0.0), axis=1).max() < 0.005
    assert (u[:m] * normals).sum(axis=1).mean() == pytest.approx(swollen, abs=0.004 if depth < 0.05 else 0.01)


def test_points_at_one_place_tell_no_more_than_one(models):
    model = models["tube"]
    posed = state_within(model, 17, 0.4)
    X = _scan(model, posed, n=400, noise=0.02)
    once, often = (Registration(model)(Problem(x), posed).displacement for x in (X, np.repeat(X, 20, axis=0)))
    np.testing.assert_allclose(often, once, atol=1e-3)


def test_where_no_step_helps_the_state_is_as_it_was(models, monkeypatch):
    model = models["tube"]
    posed = state_within(model, 18, 0.4)
    posed = posed.replace(residual=0.01 * np.random.default_rng(18).standard_normal(model.rig.vertices.shape))
    problem = Problem(_scan(model, posed))
    for step in (1e3, np.nan, 0.1):  # beyond all bounds, none, and a wrong one
        monkeypatch.setattr(Registration, "_step", lambda self, made, *a, step=step: np.full_like(made.u, step))
        assert Registration(model)(problem, posed) is posed


def test_steps_that_are_too_long_are_halved(models, monkeypatch):
    model, step = models["tube"], Registration._step
    posed = state_within(model, 19, 0.4)
    truth = posed.replace(displacement=_swollen(model))
    problem = Problem(_scan(model, truth))
    monkeypatch.setattr(Registration, "_step", lambda self, *a: 4 * step(self, *a))
    assert _off(model, Registration(model)(problem, posed), truth) < 0.7 * _off(model, posed, truth)
    monkeypatch.undo()
    monkeypatch.setattr(registration, "_FARTHEST", 0.01)
    assert 0.002 < np.linalg.norm(Registration(model)(problem, posed).displacement, axis=1).max() < 0.01


def test_clutter_hardly_counts(models):
    model = models["hand"]
    posed = state_within(model, 7, 0.4)
    truth = posed.replace(displacement=_swollen(model))
    X, rng = _scan(model, truth), np.random.default_rng(7)
    low, high = X.min(axis=0), X.max(axis=0)
    clutter = rng.uniform(low, high, (200, 3))
    clutter = clutter[np.sqrt(((clutter - X[PointIndex(X).nearest(clutter)]) ** 2).sum(axis=1)) > 0.15]
    clean, dirty = (Registration(model)(Problem(x), posed) for x in (X, np.vstack([X, clutter])))
    assert len(clutter) > 20
    assert _off(model, dirty, truth) < 1.2 * _off(model, clean, truth)


def test_points_that_weigh_nothing_are_not_met(models):
    model = models["tube"]
    posed = state_within(model, 8, 0.4)
    truth = posed.replace(displacement=_swollen(model))
    X = np.vstack([_scan(model, posed, noise=0.0), _scan(model, truth, noise=0.0)])
    weights = np.r_[np.zeros(3000), np.full(3000, 1 / 3000)]
    # Places look for the nearest point, whatever it weighs: so these are far away.
    X[:3000] += 5.0
    found = Registration(model)(Problem(X, weights), posed)
    alone = Registration(model)(Problem(X[3000:]), posed)
    np.testing.assert_allclose(found.displacement, alone.displacement, atol=1e-3)


@pytest.mark.parametrize("which", ["tube", "hand"])
@pytest.mark.parametrize("shown", ["one side", 0.6, 0.3])
def test_what_a_scan_does_not_show_does_not_pull(models, which, shown):
    """Whatever it shows: a small part or one side, which nobody says."""
    model = models[which]
    posed = state_within(model, 9, 0.3)
    V = model.deformed(posed).vertices
    if shown == "one side":
        X, _, _ = sample_seen_surface(V, model.rig.faces, 3000, np.random.default_rng(9), up=np.array([0.0, 1.0, 0.0]))
    else:
        X = _scan(model, posed, n=6000)
        X = X[X[:, 1] < np.quantile(X[:, 1], shown)]
    problem = Problem(X)
    found = Registration(model)(problem, posed)
    hidden = np.linalg.norm(V - X[PointIndex(X).nearest(V)], axis=1) > 0.1
    assert np.linalg.norm(model.deformed(found).vertices - V, axis=1)[hidden].max() < 0.005


@pytest.mark.parametrize("which", ["tube", "hand"])
def test_sparse_parts_of_a_scan_are_met_too(models, which):
    """Five sixths of the points are on the lower part of the surface."""
    model = models[which]
    posed = state_within(model, 20, 0.3)
    truth = posed.replace(displacement=_swollen(model))
    X = _scan(model, truth, n=20000, noise=0.0)
    low = X[:, 1] < np.quantile(X[:, 1], 0.3)
    problem = Problem(np.vstack([X[low][:2500], X[~low][:500]]))
    found = Registration(model)(problem, posed)
    assert _off(model, found, truth) < 0.5 * _off(model, posed, truth)


def test_same_scan_same_displacement(models):
    model = models["tube"]
    posed = state_within(model, 10, 0.4)
    problem = Problem(_scan(model, posed.replace(displacement=_swollen(model))))
    first, second = (Registration(model)(problem, posed).displacement for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("which", ["tube", "hand"])
def test_distances_change_with_vertices_as_finite_differences_say(models, which):
    """J of n · p for fixed triangles and normals, which is what a step takes to be linear, and is."""
    model, rng = models[which], np.random.default_rng(11)
    state = state_within(model, 11, 0.5).replace(displacement=0.01 * rng.standard_normal(model.rig.vertices.shape))
    made = Registration(model)._measured(Problem(_scan(model, state)), state)
    direction = rng.standard_normal(model.rig.vertices.shape)

    def heights(state):
        V, out, start = model.deformed(state).vertices, [], 0
        for corners, barycentric in made._hangs:
            n = made._normals[start : start + len(corners)]
            out.append(np.einsum("kq,kqa,ka->k", barycentric, V[corners], n))
            start += len(corners)
        return np.concatenate(out)

    h = 1e-6
    ahead, behind = (heights(state.replace(displacement=state.displacement + s * direction)) for s in (h, -h))
    np.testing.assert_allclose(made.J @ direction.ravel(), (ahead - behind) / (2 * h), atol=1e-7)


def test_the_skin_of_a_wrong_pose_comes_near_the_points_too(models):
    """So fits are judged by what they were before, see ``test_assemble.py``."""
    model = models["tube"]
    truth = state_within(model, 12, 0.8)
    X = _scan(model, truth, noise=0.0)
    wrong = truth.replace(theta=np.where(model.rig.turning, truth.theta + 0.12, truth.theta))
    found = Registration(model)(Problem(X), wrong)
    before, after = (evidence_of(model, model.deformed(s).vertices, X)[0]["unexplained"] for s in (wrong, found))
    assert after < 0.6 * before


def test_a_fit_comes_closer_to_somebody_elses_surface(tube_fitter, tube_rig):
    rng = np.random.default_rng(13)
    model = Model(tube_rig)
    truth = state_within(model, 13, 0.5)
    truth = truth.replace(translation=np.zeros(3), scale=1.0, displacement=_swollen(model, 0.03))
    X = _scan(model, truth, seed=13) * tube_rig.size / 2
    result = tube_fitter.fit_scan(X)
    surface, _, _ = sample_surface(model.deformed(truth).vertices * tube_rig.size / 2, tube_rig.faces, 2000, rng)
    on, _, _ = sample_surface(result.vertices, tube_rig.faces, 20000, rng)
    away = np.linalg.norm(surface - on[PointIndex(on).nearest(surface)], axis=1).mean()
    assert result.status == "ok"
    assert away < 0.012 * tube_rig.size / 2


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("subject", [None, "ann"])
def test_without_it_the_fit_is_as_the_full_objective_has_it(subject, quick_fitter, learned_people, people_scans, monkeypatch):
    """Of fits alone, and of those on a learned template; what they are judged by is the same."""
    fitter, scan = copy.copy(quick_fitter if subject is None else learned_people), people_scans[10].points
    known = {} if subject is None else {"subject": subject}
    moved = fitter.fit_scan(scan, **known)
    left, full = [], Search.full
    monkeypatch.setattr(Search, "full", lambda self, *a, **k: left.append((self, full(self, *a, **k))) or left[-1][1])
    monkeypatch.setattr(Registration, "__call__", None)
    as_it_was = fitter.set_params(registration=False).fit_scan(scan, **known)
    for name in ("probability", "evidence"):
        np.testing.assert_equal(getattr(as_it_was, name), getattr(moved, name))
    assert (moved.settings["registration"], as_it_was.settings["registration"]) == (True, False)
    model, rig = left[-1][0].model, fitter.rig
    of_objective = (model.offsets(left[-1][0].outcome.state) * model.half)[rig.weld] + model.source.vertices - rig.vertices
    np.testing.assert_allclose(as_it_was.offsets, of_objective, atol=1e-12)
    assert np.abs(moved.offsets - of_objective).max() > 1e-3
    assert as_it_was.terms["laplacian"] != moved.terms["laplacian"]
    place = as_it_was.pose, as_it_was.translation, as_it_was.scale, as_it_was.offsets
    np.testing.assert_array_equal(rig.pose(*place, joints=as_it_was.rest_joints), as_it_was.vertices)
