"""Planes at vertices in place of the surface, for steps that look far: they lead where the surface does."""

from dataclasses import replace

import numpy as np
import pytest
from posed_samples import joint_error, near, sampled, state_within
from scipy import sparse

import lbsfit_np as lbs
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.pulling import turned_normals
from lbsfit_np.optimize.state import Layout
from lbsfit_np.optimize.surface import vertex_normals
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.scan import some_rows

pytestmark = pytest.mark.usefixtures("one_thread")
FAR = {"reach": 0.2, "vertices": 300}


@pytest.fixture(scope="module", params=["hand", "body"])
def model(request):
    return Model(lbs.load_rig(request.param))


@pytest.fixture(scope="module")
def hand():
    return Model(lbs.load_rig("hand"))


def test_normals_turn_with_the_whole(hand):
    theta = hand.rest().theta
    theta[hand.rig.root] = [0.4, -0.3, 0.8]
    turned = turned_normals(hand.deformed(hand.rest().replace(theta=theta, scale=1.7)), hand.normals)
    R = hand.rig.frames[hand.rig.root] @ theta[hand.rig.root]
    np.testing.assert_allclose(turned, hand.normals @ matrix_from_rotvec(R).T, atol=1e-12)


def test_normals_follow_the_skin(model):
    """All but those at the inside of bends are nearly what the posed triangles say."""
    posed = model.deformed(state_within(model, 2, 0.6))
    turned, of_faces = turned_normals(posed, model.normals), vertex_normals(posed.vertices, model.rig.faces)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1.0)
    cosines = np.einsum("va,va->v", turned, of_faces)
    assert np.median(cosines) > 0.999 and (cosines > 0.8).mean() > 0.9


def test_thinned_models_have_the_normals_of_the_whole(model):
    rows = model.spread(1000)
    np.testing.assert_array_equal(model.coarsest.normals, model.normals[rows])
    assert len(model.coarsest.rig.vertices) == 1000 and not len(model.coarsest.rig.faces)
    assert len(model.coarse.rig.vertices) == min(2500, len(model.rig.vertices))


@pytest.mark.parametrize("rig, fine", [("hand", True), ("body", True), ("hand-coarse", False)])
def test_only_fine_meshes_go_by_planes(rig, fine):
    model = Model(lbs.load_rig(rig))
    assert model.is_fine == fine
    if fine:
        assert Refit(model)._far.model is model.coarse
    else:
        assert Refit(model)._far.model is model


def test_meshes_with_long_triangles_are_not_fine(hand):
    """However many vertices they have: a hand on a plate of two triangles."""
    rig = hand.rig
    plate = 0.9 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) - [0, 0, 0.5]
    m, on_root = len(rig.vertices), np.eye(len(rig.parents))[[rig.root] * 4]
    plated = replace(
        rig,
        vertices=np.vstack([rig.vertices, plate]),
        faces=np.vstack([rig.faces, [[m, m + 1, m + 2], [m, m + 2, m + 3]]]),
        weights=sparse.csr_array(sparse.vstack([rig.weights, sparse.csr_array(on_root)])),
        regressor=sparse.csr_array(sparse.hstack([rig.regressor, np.zeros((len(on_root.T), 4))])),
    )
    assert not Model(plated).is_fine


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
def test_normal_equations_have_the_slope_of_the_value(hand, partial):
    """g = −½ ∂E/∂t of a translation t, which leaves normals, and mostly the nearest, as they are."""
    truth = state_within(hand, 3)
    problem, _ = sampled(hand, truth)
    steps = GaussNewton(hand, planes=True, partial=partial, **FAR)
    layout = Layout(hand.rig, ("translation",), hand.n_coefficients)

    def made(t):
        return steps._normal_equations(problem, truth.replace(translation=truth.translation + t), None, layout, False)

    h, g = 1e-7, made(np.zeros(3)).g
    slope = [(made(h * e).value - made(-h * e).value) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(g, -0.5 * np.array(slope), atol=1e-3 * np.abs(g).max())
    assert np.abs(g).max() > 1e-5
