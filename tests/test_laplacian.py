"""The Laplacian: the terms that it makes, and its cotangents on meshes where they are known."""

from itertools import pairwise

import numpy as np
import pytest
from loss_formulas import S, bumpy_grid
from scipy.spatial import Delaunay

from lbsfit_np.losses import cotangent_matrix, laplacian_offsets, laplacian_posed
from lbsfit_np.optimize.smoothness import smoothness_matrix


def test_laplacian_is_a_frobenius_norm():
    KV, KO = S.K.toarray() @ S.Vd, S.K.toarray() @ S.offsets
    assert laplacian_posed(S.Vd, S.K)[0] == pytest.approx(np.linalg.norm(KV), rel=1e-12)
    assert laplacian_posed(S.Vd, S.K, squared=True)[0] == pytest.approx(np.sum(KV**2), rel=1e-12)
    assert laplacian_offsets(S.offsets, S.K)[0] == pytest.approx(np.linalg.norm(KO), rel=1e-12)
    assert laplacian_offsets(S.offsets, S.K, squared=True)[0] == pytest.approx(np.sum(KO**2), rel=1e-12)


@pytest.mark.parametrize("squared", [False, True])
def test_no_offsets_cost_nothing_and_pull_nowhere(squared):
    value, grad = laplacian_offsets(np.zeros_like(S.V), S.K, squared=squared)
    assert value == 0 and (grad == 0).all()
    value, grad = laplacian_offsets(np.tile([1.0, 2.0, -3.0], (len(S.V), 1)), S.K, squared=squared)  # a shift is smooth
    assert value < 1e-12


def test_cotangents_of_an_equilateral_triangle():
    K = cotangent_matrix(np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, np.sqrt(3) / 2, 0]]), np.array([[0, 1, 2]])).toarray()
    c = 1 / np.sqrt(3)
    np.testing.assert_allclose(K, c * (np.eye(3) * 1.5 - 0.5), atol=1e-15)


def test_cotangents_of_a_regular_grid_are_the_five_point_stencil():
    V, F = bumpy_grid(5, 5, np.random.default_rng(0), bump=0.0)
    row = cotangent_matrix(V, F).toarray()[12].reshape(5, 5)
    expected = np.zeros((5, 5))
    expected[2, 2], expected[[1, 3, 2, 2], [2, 2, 1, 3]] = 4.0, -1.0
    np.testing.assert_allclose(row, expected, atol=1e-14)


def test_cotangents_of_two_equilateral_triangles_add_up_over_the_edge():
    h = np.sqrt(3) / 2
    V = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, h, 0], [0.5, -h, 0]])
    K = cotangent_matrix(V, np.array([[0, 1, 2], [1, 0, 3]])).toarray()
    assert K[0, 1] == pytest.approx(-1 / np.sqrt(3), rel=1e-14)
    assert K[2, 3] == 0


def test_linear_functions_are_harmonic_inside_a_flat_mesh():
    rng = np.random.default_rng(4)
    xy = rng.random((200, 2))
    triangles = Delaunay(xy)
    V = np.column_stack([xy, 0.3 * xy[:, 0] - 0.7 * xy[:, 1] + 2.0])  # flat, not axis-aligned
    K = cotangent_matrix(V, triangles.simplices)
    inner = np.setdiff1d(np.arange(200), triangles.convex_hull)
    linear = V @ [1.5, -2.0, 0.3] + 4.0
    scale = abs(K)[inner] @ np.abs(linear)
    assert (np.abs((K @ linear)[inner]) < 1e-11 * scale).all()
    assert np.abs((K @ (xy[:, 0] ** 2))[inner]).max() > 1e-3


@pytest.mark.parametrize("mesh", ["grid", "tube"])
def test_cotangent_matrix_is_a_laplacian(mesh, tube_rig):
    V, F = S.mesh if mesh == "grid" else (tube_rig.vertices, tube_rig.faces)
    K = cotangent_matrix(V, F)
    assert abs(K - K.T).max() < 1e-14
    assert np.abs(K.sum(axis=1)).max() < 1e-12 * abs(K).max()
    assert np.linalg.eigvalsh(K.toarray()).min() > -1e-12 * abs(K).max()
    p = V[F]
    area = 0.5 * np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1).sum()
    assert np.vdot(V, K @ V) == pytest.approx(2 * area, rel=1e-12)  # Dirichlet energy of the embedding
    np.testing.assert_allclose(cotangent_matrix(1000 * V, F).toarray(), K.toarray(), rtol=1e-9, atol=1e-9)


def test_converges_to_laplace_beltrami_on_a_sphere():
    """On a sphere of radius r the coordinates are eigenfunctions: −Δx = 2 x / r²."""
    from trimesh.creation import icosphere

    r, errors = 3.0, []
    for subdivisions in (1, 2, 3, 4):
        mesh = icosphere(subdivisions=subdivisions, radius=r)
        V, F = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        mass = np.zeros(len(V))
        np.add.at(mass, F, np.asarray(mesh.area_faces)[:, None] / 3)
        found = (cotangent_matrix(V, F) @ V) / mass[:, None]
        errors.append(np.sqrt(mass @ np.sum((found - 2 * V / r**2) ** 2, axis=1) / (mass @ np.sum((2 * V / r**2) ** 2, axis=1))))
    assert errors[-1] < 0.01
    assert all(fine < 0.65 * coarse for coarse, fine in pairwise(errors)), errors  # first order, as lumped masses give


def test_faces_without_area_contribute_nothing():
    V = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [2.0, 0, 0]])
    F = np.array([[0, 1, 2]])
    with_slivers = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [2, 2, 2]])
    np.testing.assert_array_equal(cotangent_matrix(V, with_slivers).toarray(), cotangent_matrix(V, F).toarray())
    assert cotangent_matrix(V, F[:0]).nnz == 0
    assert cotangent_matrix(V, F[:0]).shape == (4, 4)


def test_slivers_hold_their_corners_together_and_no_more():
    """Of a fit's own matrix; the square's halves are as always."""
    V = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1, 0], [0.0, 1, 0], [0.5, -1e-6, 0]])
    square, sliver = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 4, 1]])
    np.testing.assert_array_equal(smoothness_matrix(V, square).toarray(), cotangent_matrix(V, square).toarray())
    K = smoothness_matrix(V, np.vstack([square, sliver])).toarray()
    at = np.ix_([0, 1, 4], [0, 1, 4])
    others = K.copy()
    others[at] -= 0.5 * np.array([[2, -1, -1], [-1, 2, -1], [-1, -1, 2]])
    np.testing.assert_allclose(others, cotangent_matrix(V, square).toarray(), atol=1e-15)
