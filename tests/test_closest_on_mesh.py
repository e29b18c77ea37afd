"""Closest points on a mesh against all of its triangles, and what they rest on."""

import numpy as np
import pytest
from posed_samples import state_within

from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.surface import Surface, closest_on_mesh, faces_around, vertex_normals
from lbsfit_np.synthesis import sample_surface

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def tube(tube_rig):
    return Model(tube_rig)


def _brute(x, triangles):
    """The distance from x to the nearest of some triangles, each cut into its plane, its edges and its corners."""
    p = np.asarray(triangles)
    edge = np.roll(p, -1, axis=1) - p
    length = (edge**2).sum(axis=2)
    t = np.where(length > 0, np.clip(((x - p) * edge).sum(axis=2) / np.where(length > 0, length, 1), 0, 1), 0)
    best = np.linalg.norm(x - p - t[:, :, None] * edge, axis=2).min()
    n = np.cross(edge[:, 0], -edge[:, 2])
    wide = (n**2).sum(axis=1) > 1e-20
    p, edge, n = p[wide], edge[wide], n[wide]
    foot = x - (((x - p[:, 0]) * n).sum(axis=1) / (n**2).sum(axis=1))[:, None] * n
    over = ((np.cross(edge, foot[:, None] - p) * n[:, None]).sum(axis=2) >= 0).all(axis=1)
    return min(best, np.linalg.norm(x - foot[over], axis=1).min(initial=np.inf))


@pytest.mark.parametrize("lift", [0.0, 0.3])
def test_closest_points_of_one_triangle_everywhere_around_it(lift):
    V = np.array([[0.0, 0, 0], [2, 0, 0], [0.3, 1, 0]])
    x, y = np.meshgrid(np.linspace(-1, 3, 23), np.linspace(-1, 2, 17))
    X = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, lift)])
    faces = np.array([[0, 1, 2]])
    around = faces_around(faces, 3)
    for start in range(3):
        on = closest_on_mesh(X, np.full(len(X), start), V, faces, around)
        np.testing.assert_allclose(np.linalg.norm(X - on.points, axis=1), [_brute(p, [V]) for p in X], atol=1e-12)
        np.testing.assert_allclose(np.einsum("nk,nka->na", on.barycentric, V[on.corners]), on.points, atol=1e-15)
        assert (on.barycentric > -1e-12).all()
        np.testing.assert_allclose(on.barycentric.sum(axis=1), 1.0, atol=1e-14)
        np.testing.assert_array_equal(on.normals, np.tile([0.0, 0, 1], (len(X), 1)))


def test_closest_points_of_a_mesh_are_those_among_all_triangles(tube):
    """Inside, outside, and on the skin of a posed mesh."""
    V, faces = tube.pose(state_within(tube, 4))[0].vertices, tube.rig.faces
    rng = np.random.default_rng(0)
    on_skin = sample_surface(V, faces, 60, rng)[0]
    X = np.vstack([on_skin, on_skin + 0.02 * rng.standard_normal((60, 3))])
    nearest = np.array([((V - x) ** 2).sum(axis=1).argmin() for x in X])
    on = closest_on_mesh(X, nearest, V, faces, faces_around(faces, len(V)))
    found = np.linalg.norm(X - on.points, axis=1)
    expected = np.array([_brute(x, V[faces]) for x in X])
    assert (found >= expected - 1e-12).all()
    assert np.isclose(found, expected, rtol=0, atol=1e-9).mean() > 0.98  # the closest triangle all but always touches the vertex
    assert found[:60].max() < 0.02 and np.isclose(found[:60], 0, atol=1e-9).mean() > 0.95
    among = [_brute(x, V[faces[(faces == v).any(axis=1)]]) for x, v in zip(X, nearest)]
    np.testing.assert_allclose(found, among, atol=1e-9)  # and is always the closest of those that do


def test_normals_on_edges_and_vertices_are_of_all_faces_there():
    """A roof, whose ridge is the edge of both sides: far from the eaves and long, so that faces are found by both ways."""
    V = np.array([[0.0, -1, 0], [0, 1, 0], [1, 0, -1], [-1, 0, -0.5]])
    X = np.array([[0.01, 0.3, 0.5], [0.0, 1.5, 0.0], [0.5, 0.0, -0.4]])
    left, right = (np.cross(b - a, c - a) for a, b, c in (V[[0, 1, 3]], V[[1, 0, 2]]))
    left, right = left / np.linalg.norm(left), right / np.linalg.norm(right)
    both = (left + right) / np.linalg.norm(left + right)
    nearest = np.array([((V - x) ** 2).sum(axis=1).argmin() for x in X])
    for faces in np.array([[[0, 1, 3], [1, 0, 2]], [[0, 2, 1], [3, 0, 1]]]):
        on = Surface(V, faces).closest(X, nearest, V)
        np.testing.assert_allclose(on.normals, [both, both, right], atol=1e-14)
    for faces in ([[0, 1, 3], [0, 1, 2]], [[0, 1, 3], [1, 0, 2], [0, 3, 1], [0, 1, 2]]):  # wound against each other, both sides
        on = Surface(V, np.array(faces)).closest(X[:1], nearest[:1], V)
        np.testing.assert_allclose(np.abs(on.normals @ both), 1.0, atol=1e-14)
    inside = Surface(V, np.array([[0, 3, 1], [1, 2, 0]])).closest(X[:1], nearest[:1], V)  # sides that face down
    np.testing.assert_allclose(inside.normals, [-both], atol=1e-14)


def test_normals_of_a_sheet_with_two_sides_are_on_the_querys():
    """Whichever of both comes first; in the sheet's plane there is none, and one of the two is as good."""
    V, sides = np.array([[0.0, -1, 0], [0, 1, 0], [1, 0, 0]]), np.array([[0, 1, 2], [1, 0, 2]])
    X = np.array([[0.3, 0.1, 0.2], [0.3, 0.1, -0.2], [0.0, 0.3, 0.1], [0.0, 0.3, 0.0]])
    for faces in (sides, sides[::-1]):
        n = closest_on_mesh(X, np.ones(4, int), V, faces, faces_around(faces, 3)).normals
        np.testing.assert_allclose(n[:3], [[0, 0, 1], [0, 0, -1], [0, 0, 1]], atol=1e-14)
        np.testing.assert_allclose(np.abs(n[3]), [0, 0, 1], atol=1e-14)


def test_normals_do_not_depend_on_the_order_of_the_faces(tube):
    """Nor on rounding: on edges and vertices, which of the faces there is closest is nothing that anything may hang on."""
    V, faces, rng = tube.pose(state_within(tube, 4))[0].vertices, tube.rig.faces, np.random.default_rng(2)
    X = sample_surface(V, faces, 400, rng)[0] + 0.08 * rng.standard_normal((400, 3))
    nearest = np.array([((V - x) ** 2).sum(axis=1).argmin() for x in X])
    on = closest_on_mesh(X, nearest, V, faces, faces_around(faces, len(V)))
    assert (on.barycentric.min(axis=1) < 1e-12).mean() > 0.15
    for change in (lambda a: a, lambda a: a + 1e-13, lambda a: 3 * a):
        for order in (np.arange(len(faces)), rng.permutation(len(faces))):
            again = closest_on_mesh(change(X), nearest, change(V), faces[order], faces_around(faces[order], len(V)))
            np.testing.assert_allclose(again.normals, on.normals, atol=1e-9)
    of_vertices = [
        closest_on_mesh(V, np.arange(len(V)), V, some, faces_around(some, len(V))).normals for some in (faces, faces[::-1])
    ]
    np.testing.assert_allclose(*of_vertices, atol=1e-9)


@pytest.mark.parametrize(
    "corners",
    [
        [[0.0, 0, 0], [1, 0, 0], [2, 0, 0]],  # on a line
        [[0.0, 0, 0], [1, 0, 0], [1, 0, 0]],  # two corners at one place
        [[0.5, 0, 0], [0.5, 0, 0], [0.5, 0, 0]],  # all three
        [[0.0, 0, 0], [1, 0, 0], [0.4, 1e-9, 0]],  # all but on a line
    ],
)
def test_triangles_without_area(corners):
    V, faces = np.array(corners), np.array([[0, 1, 2]])
    X = np.random.default_rng(0).uniform(-1, 3, (50, 3))
    with np.errstate(all="raise"):
        on = closest_on_mesh(X, np.zeros(50, int), V, faces, faces_around(faces, 3))
    np.testing.assert_allclose(np.linalg.norm(X - on.points, axis=1), [_brute(x, [V]) for x in X], atol=1e-8)
    assert np.isfinite(on.barycentric).all() and np.isfinite(on.normals).all()


def test_no_points_have_no_closest_points(tube):
    faces = tube.rig.faces
    on = closest_on_mesh(np.empty((0, 3)), np.empty(0, int), tube.rig.vertices, faces, faces_around(faces, 242))
    assert on.points.shape == on.normals.shape == on.barycentric.shape == (0, 3)


def test_faces_around_vertices():
    faces = np.array([[0, 1, 2], [2, 1, 4], [4, 5, 2]])
    around = faces_around(faces, 7)
    assert around.shape == (7, 3)
    for v in range(7):
        has = set(np.flatnonzero((faces == v).any(axis=1)).tolist())
        assert set(around[v].tolist()) == (has or {-1})
    np.testing.assert_array_equal(faces_around(np.empty((0, 3), int), 2), [[-1], [-1]])


def test_normals_of_vertices():
    V = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    n = vertex_normals(V, faces)
    np.testing.assert_allclose(n[[0, 1, 3]], [[2**-0.5, 0, 2**-0.5], [0, 0, 1], [1, 0, 0]], atol=1e-15)
    np.testing.assert_array_equal(n[4], 0.0)


@pytest.mark.parametrize("labelled", [False, True])
def test_on_long_triangles_the_closest_point_is_found_as_well(labelled):
    """A posed prism of six long sides: most points' nearest vertex is at no triangle that they are on."""
    corner = np.array([[np.cos(t), np.sin(t)] for t in np.arange(6) * np.pi / 3]) * 0.15
    rings = [np.column_stack([corner, np.full(6, z)]) for z in (-1.0, -0.2, 1.0)]
    rest = np.vstack(rings)
    sides = [(k + i, k + (i + 1) % 6) for k in (0, 6) for i in range(6)]
    faces = np.array([f for i, j in sides for f in ((i, j, i + 6), (j, j + 6, i + 6))])
    labels = np.repeat([0, 0, 1], 6)
    surface, rng = Surface(rest, faces, labels), np.random.default_rng(0)
    V = 1.1 * rest @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + 0.02 * rng.standard_normal(rest.shape)
    on_skin, triangle, _ = sample_surface(V, faces, 200, rng)
    X = on_skin + 0.01 * rng.standard_normal((200, 3))
    x_labels = labels[faces[triangle]].max(axis=1)  # triangles between the parts are of the second
    allowed = [np.flatnonzero(labels == p) if labelled else np.arange(len(rest)) for p in x_labels]
    nearest = np.array([rows[((V[rows] - x) ** 2).sum(axis=1).argmin()] for x, rows in zip(X, allowed)])
    found = np.linalg.norm(X - surface.closest(X, nearest, V, x_labels if labelled else None).points, axis=1)
    expected = np.array([_brute(x, V[faces]) for x in X])
    assert np.isclose(found, expected, atol=1e-9).mean() > (0.9 if labelled else 0.99)
    alone = np.linalg.norm(X - closest_on_mesh(X, nearest, V, faces, faces_around(faces, len(V))).points, axis=1)
    assert (found <= alone + 1e-12).all() and np.isclose(alone, expected, atol=1e-9).mean() < 0.9


def test_meshes_of_short_triangles_are_looked_at_as_before(tube):
    """No point on them is needed."""
    V, faces = tube.pose(state_within(tube, 4))[0].vertices, tube.rig.faces
    X = sample_surface(V, faces, 100, np.random.default_rng(1))[0]
    nearest = np.array([((V - x) ** 2).sum(axis=1).argmin() for x in X])
    short = Surface(tube.rig.vertices, faces).closest(X, nearest, V)
    expected = closest_on_mesh(X, nearest, V, faces, faces_around(faces, len(V)))
    np.testing.assert_array_equal(short.points, expected.points)
