"""Areas, normals and which way a mesh looks."""

import numpy as np
import pytest

from lbsfit_np.losses import cotangent_matrix
from lbsfit_np.sensor import View
from lbsfit_np.synthesis import synthesize
from lbsfit_np.triangles import area_vectors, areas_around, face_areas, inside_out

# A tetrahedron of a corner of the unit cube, and a point that no face has.
VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]], dtype=float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_areas_and_normals_of_a_tetrahedron():
    vectors = area_vectors(VERTICES, FACES)
    np.testing.assert_allclose(vectors, [[0, 0, -0.5], [0, -0.5, 0], [-0.5, 0, 0], [0.5, 0.5, 0.5]])
    np.testing.assert_allclose(vectors.sum(axis=0), 0, atol=1e-15)  # a closed surface
    slant = np.sqrt(3) / 2
    np.testing.assert_allclose(face_areas(VERTICES, FACES), [0.5, 0.5, 0.5, slant])
    np.testing.assert_allclose(areas_around(VERTICES, FACES), [1.5, 1 + slant, 1 + slant, 1 + slant, 0])


def test_inside_out_wherever_the_mesh_stands():
    for shift in (0.0, 1000.0, -1000.0):
        assert not inside_out(VERTICES[:4] + shift, FACES)
        assert inside_out(VERTICES[:4] + shift, FACES[:, ::-1])


def test_an_open_mesh_is_seen_from_its_middle():
    for shift in ([9.0, 9.0, 9.0], [-9.0, -9.0, -9.0]):  # the open side towards the origin, or away from it
        assert not inside_out(VERTICES[:4] + shift, FACES[:3])
        assert inside_out(VERTICES[:4] + shift, FACES[:3, ::-1])


def test_nothing_of_no_faces():
    none = np.empty((0, 3), dtype=int)
    assert face_areas(VERTICES, none).shape == (0,) and not inside_out(VERTICES, none)
    np.testing.assert_array_equal(areas_around(VERTICES, none), np.zeros(5))


def test_small_triangles_face_the_camera_and_those_without_area_nobody():
    n = 500  # most triangles are slivers of a thousandth of a square pixel
    x, y = np.meshgrid(np.linspace(0, 1, n), np.r_[np.linspace(0, 0.01, n - 1), 1.0], indexing="ij")
    rows = np.arange(n * n).reshape(n, n)
    corners = [rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:]]
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    faces = np.stack([c.ravel() for c in corners], axis=1)
    bottom = vertices + [0, 0, -1.0]  # so that outside is where the normals look
    both = np.concatenate([faces, faces[:, ::-1] + n * n])
    view = View(np.concatenate([vertices, bottom]), np.concatenate([both, [[0, 1, 0]]]), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(view.facing[: len(faces)], 1.0)
    assert not view.facing[len(faces) :].any()


@pytest.mark.parametrize("size", [1e-140, 1e-79, 1e79, 1e140])
def test_areas_and_cotangents_of_meshes_of_any_size(tube_rig, size):
    V, F = tube_rig.vertices, tube_rig.faces
    np.testing.assert_allclose(face_areas(V * size, F) / size / size, face_areas(V, F), rtol=1e-12)
    np.testing.assert_allclose(cotangent_matrix(V * size, F).toarray(), cotangent_matrix(V, F).toarray(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [1e-79, 1e79])
def test_points_are_sampled_on_meshes_of_any_size(tube_rig, size):
    (scan,) = synthesize(tube_rig, 1, random_state=0, noise=0.0)
    (of_another,) = synthesize(tube_rig.scaled(size), 1, random_state=0, noise=0.0)
    np.testing.assert_array_equal(of_another.triangle, scan.triangle)
    np.testing.assert_allclose(of_another.points / size, scan.points, rtol=1e-9, atol=1e-12)
