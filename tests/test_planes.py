"""Planes at vertices in place of the surface, for steps that look far: they lead where the surface does."""

from dataclasses import replace

import numpy as np
import pytest
from posed_samples import joint_error, near, sampled, state_within
from scipy import sparse

import lbsfit_np as lbs
from lbsfit_np.fitting import refit as refitting
from lbsfit_np.fitting.bends import Bends
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.scout import Scout
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.measured import ToPlanes, ToTriangles
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import Layout
from lbsfit_np.optimize.surface import vertex_normals
from lbsfit_np.optimize.visibility import Coverage
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.scan import some_rows
from lbsfit_np.starts.turns import Facing

pytestmark = pytest.mark.usefixtures("one_thread")
FAR = {"reach": 0.2, "vertices": 300}


@pytest.fixture(scope="module")
def hand():
    return Model(lbs.load_rig("hand"))


@pytest.fixture(scope="module")
def body():
    return Model(lbs.load_rig("body"))


@pytest.fixture(scope="module", params=["hand", "body", "body-coarse"])
def model(request):
    known = request.param in ("hand", "body")
    return request.getfixturevalue(request.param) if known else Model(lbs.load_rig(request.param))


# ---- what they are ----


def test_normals_turn_with_the_whole(hand):
    theta = hand.rest().theta
    theta[hand.rig.root] = [0.4, -0.3, 0.8]
    planes, R = ToPlanes(hand, 300), hand.rig.frames[hand.rig.root] @ theta[hand.rig.root]
    _, normals = planes.places(hand.deformed(hand.rest().replace(theta=theta, scale=1.7)))
    rows = hand.spread(300)
    np.testing.assert_array_equal(planes.corners[:, 0], rows)
    np.testing.assert_allclose(normals, hand.normals[rows] @ matrix_from_rotvec(R).T, atol=1e-12)


def test_normals_follow_the_skin_on_the_thinned_model_too(model):
    """All but those at the inside of bends are nearly what the posed triangles say."""
    state, coarse = state_within(model, 2, 0.6), model.coarse
    whole = model.deformed(state)
    posed, rows = coarse.deformed(state), model.spread(2500)
    planes = ToPlanes(coarse, 300)
    places, normals = planes.places(posed)
    chosen = planes.corners[:, 0]
    np.testing.assert_allclose(places, whole.vertices[rows[chosen]], atol=1e-12)
    cosines = np.einsum("va,va->v", normals, vertex_normals(whole.vertices, model.rig.faces)[rows[chosen]])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.median(cosines) > 0.999 and (cosines > 0.8).mean() > 0.9
    on = planes.closest(places + 0.01 * normals, chosen, posed)
    np.testing.assert_array_equal(on.points, places)
    np.testing.assert_array_equal(on.normals, normals)
    np.testing.assert_array_equal(on.corners[:, 0], chosen)


def test_vertices_pull_as_much_as_on_the_whole_mesh(body):
    """Dense ones by little each: shares of the thinned model's own would have all pull alike."""
    rows = body.spread(2500)[ToPlanes(body.coarse, 300).corners[:, 0]]
    np.testing.assert_allclose(ToPlanes(body.coarse, 300).weights, body.areas[rows] / body.areas[rows].sum())


def test_a_model_of_few_vertices_pulls_by_all(hand):
    few = Model(lbs.load_rig("hand-coarse"))
    planes, posed = ToPlanes(few, 1000), few.deformed(few.rest())
    np.testing.assert_array_equal(planes.places(posed)[0], posed.vertices)


# ---- where they are taken ----


def test_thinned_models_have_the_normals_of_the_whole(model):
    rows = model._with_all_parts(model.spread(1000))
    np.testing.assert_array_equal(model.coarsest.normals, model.normals[rows])
    np.testing.assert_array_equal(model.coarsest.rig.vertices, model.rig.vertices[rows])
    assert 1000 <= len(rows) < 1010 and not len(model.coarsest.rig.faces)
    assert len(model.coarse.rig.vertices) == min(2500, len(model.rig.vertices))


@pytest.mark.parametrize("partial", [False, True])
@pytest.mark.parametrize("rig, fine", [("hand", True), ("body", True), ("body-coarse", True), ("hand-coarse", False)])
def test_only_fine_meshes_go_by_planes(rig, fine, partial):
    model = Model(lbs.load_rig(rig))
    refit = Refit(model, coverage=Coverage(partial))
    assert model.is_fine == fine
    assert refit._far.model is (model.coarse if fine else model)
    assert isinstance(refit._far._mesh, ToPlanes if fine else ToTriangles)
    assert refit._far.coverage == Coverage(partial)
    bends = Bends(model, ("pose",), None, coverage=Coverage(partial))
    assert bends._first.model is refit._far.model and type(bends._first._mesh) is type(refit._far._mesh)
    assert bends._first.coverage == Coverage(partial)
    for steps in (refit._near, refit._last, bends._steps):
        assert steps.model is model and isinstance(steps._mesh, ToTriangles)


@pytest.mark.parametrize("half, fine", [(0.9, False), (0.06, False), (0.03, True)])
def test_meshes_with_long_triangles_are_not_fine(half, fine, hand):
    """However many vertices they have: a hand on a plate of two triangles."""
    rig = hand.rig
    plate = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) - [0, 0, 0.5]
    m, on_root = len(rig.vertices), np.eye(len(rig.parents))[[rig.root] * 4]
    plated = replace(
        rig,
        vertices=np.vstack([rig.vertices, plate]),
        faces=np.vstack([rig.faces, [[m, m + 1, m + 2], [m, m + 2, m + 3]]]),
        weights=sparse.csr_array(sparse.vstack([rig.weights, sparse.csr_array(on_root)])),
        regressor=sparse.csr_array(sparse.hstack([rig.regressor, np.zeros((len(on_root.T), 4))])),
    )
    assert Model(plated).is_fine == fine


def _two_sided(faces):
    return np.vstack([faces, faces[:, ::-1]])


def _half_turned(faces):
    return np.where((np.arange(len(faces)) % 2)[:, None], faces, faces[:, ::-1])


@pytest.mark.parametrize("wound", [_two_sided, _half_turned])
def test_meshes_whose_triangles_face_both_ways_are_not_fine(hand, wound):
    """Normals of their vertices say nothing: they are what rounding left of a sum that is 0, or any."""
    assert not Model(replace(hand.rig, faces=wound(hand.rig.faces))).is_fine
    assert Model(replace(hand.rig, faces=hand.rig.faces[:, ::-1])).is_fine
    assert not hand.coarsest.is_fine  # there are none


def test_no_part_is_lost_where_vertices_are_few(body):
    """Such as fingers of a body: a part of three vertices, and one of sixty in a corner."""
    labels = np.zeros(len(body.rig.vertices), dtype=int)
    labels[body.rig.vertices[:, 1].argsort()[:60]], labels[body.rig.vertices[:, 1].argsort()[-3:]] = 1, 2
    parted = Model(lbs.load_rig("body"))
    parted.labels = labels
    count = np.bincount(parted.coarsest.labels)
    assert len(count) == 3 and count[1] >= 4 and count[2] == 3
    assert len(parted.coarsest.rig.vertices) <= 1000 + 7
    assert set(body.coarsest.labels) == set(body.labels)


def test_weights_are_the_same_where_dense_ones_would_be_large(model, monkeypatch):
    rows = np.array([5, 0, 700])
    dense = model.weights_of(rows)
    np.testing.assert_array_equal(dense, model.rig.weights.toarray()[rows])
    monkeypatch.setattr("lbsfit_np.optimize.model._DENSE", 10)
    again = Model(model.source)
    np.testing.assert_array_equal(again.weights_of(rows), dense)
    assert again._dense_weights is None


# ---- where they lead ----


@pytest.mark.parametrize("labelled", [False, True])
def test_they_lead_where_the_surface_does(model, labelled):
    """To within the spacing of points, from far: the last steps, by the surface, do the rest."""
    by_planes, last = GaussNewton(model.coarse, planes=True, **FAR), GaussNewton(model)
    for seed in range(3):
        truth = state_within(model, seed, 0.8)
        start = near(model, truth, seed, 0.25, 0.05)
        problem, labels = sampled(model, truth)
        few, given = problem.thinned(400), labels[some_rows(problem.X, 400)] if labelled else None
        (_, before), (found, value) = (by_planes.pose(few, start, labels=given, iterations=n) for n in (0, 12))
        assert joint_error(model, found, truth) < 0.4 * joint_error(model, start, truth)
        assert value < 0.2 * before
        assert joint_error(model, last.pose(problem, found, iterations=20)[0], truth) < 0.008


@pytest.mark.parametrize("partial", [False, True])
def test_normal_equations_have_the_slope_of_the_value(model, partial):
    """g = −½ ∂E/∂t of a translation t, which leaves normals, and mostly the nearest, as they are."""
    truth, model = state_within(model, 3), model.coarse
    problem = sampled_on(model, truth)
    steps = GaussNewton(model, planes=True, coverage=Coverage(partial), **FAR)
    layout = Layout(model.rig, ("translation",), model.n_coefficients)

    def made(t):
        return steps._normal_equations(problem, truth.replace(translation=truth.translation + t), None, layout, False)

    h, g = 1e-7, made(np.zeros(3)).g
    slope = [(made(h * e).value - made(-h * e).value) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(g, -0.5 * np.array(slope), atol=1e-3 * np.abs(g).max())
    assert np.abs(g).max() > 1e-5


def sampled_on(model, state):
    """Points beside every third vertex of a model that has no faces."""
    V = model.deformed(state).vertices[::3]
    return Problem(V + 0.02 * np.random.default_rng(0).standard_normal(V.shape))


# ---- starts from labels ----


@pytest.mark.parametrize("known", [False, True])
def test_starts_from_labels_look_at_the_model_that_is_given(body, known, monkeypatch):
    asked, problem = [], sampled(body, state_within(body, 1, 0.5))[0]
    monkeypatch.setattr(refitting, "start_from_parts", lambda model, *given, **options: asked.append(model) or _Start(model))
    proba = np.full((len(problem.X), len(body.rig.parts)), 1 / len(body.rig.parts))
    refit = Refit(body)
    refit.from_parts(problem, proba, known)
    refit.from_parts(problem, proba, known, model=body.coarsest)
    assert asked[0] is body.coarse and asked[1] is body.coarsest


class _Start:
    def __init__(self, model):
        self.state = model.rest()


def test_a_scout_leads_points_by_their_own_labels(hand, monkeypatch):
    """Those of 500 points, each with what was said of it, not of another; and by the thinnest model."""
    asked = []

    class Says:
        def predict_proba(self, points, **options):
            return np.column_stack([points, np.zeros((len(points), len(hand.rig.parts) - 3))])

    library = type("Library", (), {"poses": np.zeros((1, *hand.rig.lower.shape))})()
    scout = Scout(hand, library, Facing(), Says(), FitSettings(polish=0))
    monkeypatch.setattr(scout._refit, "from_parts", lambda *given, **options: asked.append((given, options)))
    points = np.random.default_rng(3).standard_normal((2000, 3)) * hand.half
    scout._labelled(points, None, Frame(points.mean(axis=0), hand.half, np.eye(3)))
    ((problem, proba), options), *_ = asked
    assert len(problem.X) == 500 and options == {"model": hand.coarsest}
    np.testing.assert_allclose(proba[:, :3], problem.X * hand.half)
