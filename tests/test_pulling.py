"""Places of a mesh that pull on the scan: where they are, what they stand for, and that they pull nowhere where a scan fits."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from posed_samples import joint_error, sampled, state_within
from scipy.spatial import cKDTree

import lbsfit_np as lbs
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model, farthest_points
from lbsfit_np.optimize.pulling import Pulling, between
from lbsfit_np.optimize.surface import Surface, vertex_normals
from lbsfit_np.synthesis import sample_surface

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def hand():
    return Model(lbs.load_rig("hand-coarse"))


def _places(model, most):
    return Pulling(model, most)


def test_vertices_have_the_normals_of_the_whole_mesh(hand):
    """Of all triangles at them, be the other corners of these among the few or not."""
    pulling, V = _places(hand, 100), hand.deformed(state_within(hand, 0)).vertices
    rows = pulling.corners[:, 0]
    np.testing.assert_array_equal(rows, np.sort(farthest_points(hand.rig.vertices, 100)))  # spread evenly
    places, normals = pulling.of(V)
    np.testing.assert_array_equal(places, V[rows])
    np.testing.assert_allclose(normals, vertex_normals(V, hand.rig.faces)[rows], atol=1e-12)
    np.testing.assert_allclose(pulling.weights, hand.areas[rows] / hand.areas[rows].sum())


@pytest.mark.parametrize("most", [556, 1000, 4000, 5000])
def test_a_mesh_of_fewer_vertices_pulls_by_its_faces(hand, most):
    """By as many places as can be, each on a face, that stand for the surface about them."""
    pulling, V = _places(hand, most), hand.deformed(state_within(hand, 1)).vertices
    k = len(pulling.corners)
    assert 0.8 * most <= k <= most
    places, normals = pulling.of(V)
    assert (pulling.barycentric > 0).all() and np.allclose(pulling.barycentric.sum(axis=1), 1.0)
    on = Surface(hand.rig.vertices, hand.rig.faces).closest(places, pulling.corners[:, 0], V)
    assert np.linalg.norm(on.points - places, axis=1).max() < 1e-12
    a, b, c = (V[pulling.corners[:, j]] for j in range(3))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert max(np.abs(np.einsum("va,va->v", normals, side)).max() for side in (b - a, c - a)) < 1e-12
    assert (np.einsum("va,va->v", normals, np.cross(b - a, c - a)) > 0).all()
    assert pulling.weights.sum() == pytest.approx(1.0)
    # Against a hundred times as many points, each counted for the nearest place.
    X, *_ = sample_surface(hand.rig.vertices, hand.rig.faces, 100 * k, np.random.default_rng(0))
    rest, _ = pulling.of(hand.rig.vertices)
    near = np.bincount(cKDTree(rest).query(X)[1], minlength=k) / len(X)
    assert k * np.abs(near - pulling.weights).mean() < 0.2
    if most == 4000:  # no place is left out: exactly the faces' own shares
        face, counted = np.unique(pulling.corners, axis=0, return_inverse=True)
        p = hand.rig.vertices[face]
        area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
        np.testing.assert_allclose(np.bincount(counted.ravel(), pulling.weights), area / area.sum())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("most", [100, 4000])
def test_faces_without_area_stand_for_nothing(hand, most):
    """Those of a finger that is but a point; or all, and then no place does."""
    tip = np.linalg.norm(hand.rig.vertices - hand.rig.vertices[hand.rig.vertices[:, 0].argmax()], axis=1) < 0.2
    point = np.where(tip[:, None], hand.rig.vertices[tip][0], hand.rig.vertices)
    for vertices, all_flat in ((point, False), (np.zeros_like(point), True)):
        model = copy.copy(hand)
        model.rig = replace(hand.rig, vertices=vertices)
        model.__dict__.pop("areas", None)
        pulling = _places(model, most)
        places, normals = pulling.of(vertices)
        assert np.isfinite(places).all() and np.isfinite(normals).all()
        flat = tip[pulling.corners].all(axis=1) & (pulling.corners.shape[1] == 3)
        assert (pulling.weights[flat] == 0).all() and (all_flat or most < len(point) or flat.any())
        assert pulling.weights.sum() == pytest.approx(0.0 if all_flat else 1.0)


def test_the_normal_between_is_at_right_angles_to_what_lies_on_one_sphere():
    rng = np.random.default_rng(0)
    x, y = (p / np.linalg.norm(p, axis=1, keepdims=True) for p in rng.standard_normal((2, 200, 3)))
    n, same = between(x, y), np.einsum("va,va->v", x, y) > 0
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0)
    assert np.abs(np.einsum("va,va->v", n, x - y))[same].max() < 1e-9
    np.testing.assert_allclose(n[~same], x[~same])  # another limb's surface says nothing of this one's
    np.testing.assert_allclose(between(x, np.zeros_like(x)), x)  # that of a triangle without area


@pytest.mark.parametrize("name", ["hand-coarse", "body-coarse"])
def test_a_scan_of_the_mesh_itself_leaves_its_size_as_it_is(name):
    """Its points lie beside the places that pull, and so below: along the places' own normals they would pull inwards."""
    model = Model(lbs.load_rig(name))
    steps, scales = GaussNewton(model), []
    for seed in range(4):
        truth = state_within(model, seed, 0.8)
        problem, _ = sampled(model, truth, seed=seed)
        found, _ = steps.pose(problem, truth, free=("pose", "translation", "scale"), iterations=30)
        scales.append(found.scale)
        assert joint_error(model, found, truth) < 0.004
    assert np.mean(scales) == pytest.approx(1.0, abs=0.006)
