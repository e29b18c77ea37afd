"""Places on a surface against all of its triangles, and the transfer of points by registrations whose truth is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from posed_samples import state_within

import lbsfit_np as lbs
from lbsfit_np import correspondence
from lbsfit_np.correspondence import at_places, surface_places
from lbsfit_np.errors import InputError
from lbsfit_np.optimize.model import Model
from lbsfit_np.synthesis import sample_surface

pytestmark = pytest.mark.usefixtures("one_thread")

# A fan whose long triangles reach far beyond the vertices that are near a point: the closest one touches none of these.
LONG = np.array([[0.0, 0, 0], [10, 0, 0], [10, 0.1, 0], [5, 0.05, 0.3], [5, 0.05, 0.31], [5.01, 0.05, 0.3], [5, 0.06, 0.3]])
LONG_FACES = np.array([[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 4]])


def _distances(x, vertices, faces):
    """From each point to all triangles, by trimesh."""
    from trimesh.triangles import closest_point

    triangles = vertices[faces]
    return np.array([np.linalg.norm(closest_point(triangles, np.tile(p, (len(faces), 1))) - p, axis=1).min() for p in x])


@pytest.fixture(scope="module")
def poses(tube_rig):
    """The same rig in two poses."""
    model = Model(tube_rig)
    return [model.pose(state_within(model, seed))[0].vertices for seed in (4, 5)]


@pytest.mark.parametrize("mesh", ["tube", "long"])
def test_places_are_the_closest_of_all_triangles(tube_rig, poses, mesh):
    V, faces = (poses[0], tube_rig.faces) if mesh == "tube" else (LONG, LONG_FACES)
    rng = np.random.default_rng(0)
    on_skin = sample_surface(V, faces, 60, rng)[0]
    anywhere = rng.uniform(V.min(axis=0) - 0.5, V.max(axis=0) + 0.5, (60, 3))
    x = np.vstack([on_skin, on_skin + 0.02 * rng.standard_normal((60, 3)), anywhere, V, [[5.2, 0.05, 0.1]]])
    corners, barycentric = surface_places(x, V, faces)
    places = at_places(corners, barycentric, V)
    np.testing.assert_allclose(np.linalg.norm(x - places, axis=1), _distances(x, V, faces), atol=1e-9)
    assert (barycentric > -1e-12).all() and np.allclose(barycentric.sum(axis=1), 1)
    rows = {tuple(sorted(f)) for f in faces.tolist()}
    assert all(tuple(sorted(c)) in rows for c in corners.tolist())


def _flat(center, radius):
    """An equilateral triangle in a plane of z, one corner towards −x; its edge's middle is half a radius from the centre."""
    angle = np.pi * np.array([1, 5 / 3, 1 / 3])
    return center + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(3)], axis=1)


# The point is the origin: its nearest vertex is one of the other triangles', its closest place within an edge of the first one.
FAR_CENTRE = {
    "behind many centroids": [_flat([-1.9 / 2, 0, -0.1], 1.9)] + [_flat([0, 0, 0.5 + 0.001 * k], 1.0) for k in range(20)],
    "by its own radius alone": [
        np.array([[-0.2, -0.1, 0], [2.9, -0.1, 0], [1.35, -2.4, 0]]),
        np.array([[0, 0, 0.2], [0.1, 0, 0.3], [0, 0.1, 0.3]]),
        _flat([100, 0, 0], 1.0),
    ],
}


@pytest.mark.parametrize("triangles", FAR_CENTRE.values(), ids=FAR_CENTRE)
def test_the_closest_triangle_need_not_have_the_nearest_centroid(triangles):
    V, faces, x = np.concatenate(triangles), np.arange(3 * len(triangles)).reshape(-1, 3), np.zeros((1, 3))
    away = _distances(x, V, faces)
    assert np.linalg.norm(V, axis=1).argmin() > 2 and away == pytest.approx(0.1)
    corners, barycentric = surface_places(x, V, faces)
    np.testing.assert_array_equal(np.sort(corners), [[0, 1, 2]])
    np.testing.assert_allclose(np.linalg.norm(at_places(corners, barycentric, V)), 0.1)


def test_triangles_of_all_sizes_in_any_place():
    rng = np.random.default_rng(2)
    size = 2 ** rng.uniform(-3, 1, (150, 1, 1))
    V = (rng.uniform(-1, 1, (150, 1, 3)) + size * rng.standard_normal((150, 3, 3))).reshape(-1, 3)
    faces, x = np.arange(450).reshape(-1, 3), rng.uniform(-3, 3, (80, 3))
    places = at_places(*surface_places(x, V, faces), V)
    np.testing.assert_allclose(np.linalg.norm(x - places, axis=1), _distances(x, V, faces), atol=1e-9)


def test_many_points_are_done_in_pieces(tube_rig, poses, monkeypatch):
    x = sample_surface(poses[0], tube_rig.faces, 100, np.random.default_rng(0))[0]
    whole = surface_places(x, poses[0], tube_rig.faces)
    monkeypatch.setattr("lbsfit_np.correspondence._CHUNK", 7)
    for a, b in zip(whole, surface_places(x, poses[0], tube_rig.faces), strict=True):
        np.testing.assert_array_equal(a, b)


def test_pairs_of_points_and_triangles_are_done_in_pieces(monkeypatch):
    """From the middle of a sphere all its triangles are about equally far away."""
    ball = trimesh.creation.icosphere(2)
    points = 0.01 * np.random.default_rng(0).standard_normal((30, 3))
    whole = surface_places(points, np.array(ball.vertices), np.array(ball.faces))
    asked, closest = [], correspondence.closest_on_mesh

    def counted(points, rows, vertices, faces, triangles):
        asked.append(triangles.size)
        return closest(points, rows, vertices, faces, triangles)

    monkeypatch.setattr(correspondence, "closest_on_mesh", counted)
    monkeypatch.setattr(correspondence, "_PAIRS", 1000)
    for a, b in zip(surface_places(points, np.array(ball.vertices), np.array(ball.faces)), whole, strict=True):
        np.testing.assert_array_equal(a, b)
    assert max(asked) <= 1000 and sum(asked) > 5000


def test_a_point_goes_to_the_same_place_of_the_other_registration(tube_rig, poses):
    """Points on A's surface whose places on B's are known."""
    on_a, triangle, weight = sample_surface(poses[0], tube_rig.faces, 200, np.random.default_rng(1))
    expected = np.einsum("nk,nka->na", weight, poses[1][tube_rig.faces[triangle]])
    np.testing.assert_allclose(lbs.transfer(on_a, *poses, tube_rig.faces), expected, atol=1e-9)


def test_a_registration_that_is_shifted_gives_places_that_are(tube_rig, poses):
    at = lbs.transfer(poses[0], poses[0], poses[1] + [0.3, 0, 0], tube_rig.faces)
    np.testing.assert_allclose(at, poses[1] + [0.3, 0, 0], atol=1e-12)


def test_the_snap_takes_the_nearest_point(tube_rig, poses):
    targets = lbs.Scan(np.array([[0.0, 0, 0], [9, 9, 9], [0, 1, 0]]))
    found = lbs.transfer(poses[0], *poses, tube_rig.faces, snap_to=targets)
    nearest = np.linalg.norm(poses[1][:, None] - targets.points, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(found, targets.points[nearest])
    np.testing.assert_array_equal(found, lbs.transfer(poses[0], *poses, tube_rig.faces, snap_to=targets.points))


def test_one_point_and_none(tube_rig, poses):
    one = lbs.transfer(poses[0][:1], *poses, tube_rig.faces)
    np.testing.assert_allclose(one, poses[1][:1], atol=1e-12)
    assert lbs.transfer(np.empty((0, 3)), *poses, tube_rig.faces).shape == (0, 3)


@pytest.mark.parametrize("kind", ["uint8", "uint64", "int16"])
def test_faces_of_any_kind_of_whole_numbers(tube_rig, poses, kind):
    A, B = poses
    found = lbs.transfer(A[:20], A, B, tube_rig.faces.astype(kind))
    np.testing.assert_array_equal(found, lbs.transfer(A[:20], A, B, tube_rig.faces))


def test_wild_points_spoil_no_others(tube_rig, poses):
    """Such as programs write for no depth: fits leave them out, and whoever carries a whole scan has them among the others."""
    most = np.finfo(float).max
    for far in (1e7, 1e160, most):
        wild = np.array([[far, 0.0, 0.0], [-far, far, far]])
        found = lbs.transfer(np.vstack([poses[0], wild]), *poses, tube_rig.faces, snap_to=np.vstack([poses[1], wild]))
        np.testing.assert_allclose(found[:-2], poses[1], atol=1e-9)
        assert np.isfinite(found).all()
    assert lbs.transfer(poses[0], *poses, tube_rig.faces, snap_to=np.full((1, 3), most)).max() == most


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("power", [-1000, -300, 5, 400, 495])
def test_places_do_not_depend_on_the_unit(power, tube_rig, poses):
    x = sample_surface(poses[0], tube_rig.faces, 200, np.random.default_rng(0))[0] + 0.01
    unit = 2.0**power
    found = lbs.transfer(unit * x, *(unit * V for V in poses), tube_rig.faces)
    np.testing.assert_array_equal(found / unit, lbs.transfer(x, *poses, tube_rig.faces))


@pytest.mark.parametrize(
    "change, words",
    [
        ({"points": np.zeros((4, 2))}, ["points: got an array of shape (4, 2)", "shape (n, 3)"]),
        ({"points": np.full((1, 3), np.nan)}, ["points", "NaN"]),
        ({"points": [[0, 0, 0], [1]]}, ["points", "different lengths"]),
        ({"points": np.ma.masked_less(np.eye(3), 0.5)}, ["points: got a masked array with 3 of 3 rows masked"]),
        ({"registration_a": np.zeros(3)}, ["registration_a", "(3,)"]),
        ({"registration_a": np.full((242, 3), 1e200)}, ["registration_a: got coordinates of up to 1e+200"]),
        ({"points": SimpleNamespace(vertices=np.zeros((4, 3)))}, ["points: got", "Pass its vertices"]),
        ({"registration_a": SimpleNamespace(vertices=np.zeros((242, 3)))}, ["registration_a: got Simple", "its vertices"]),
        ({"registration_a": lbs.Scan(np.eye(3))}, ["registration_a: got Scan", "its points"]),
        ({"registration_b": np.zeros((5, 3))}, ["registration_b: got shape (5, 3)"]),
        ({"faces": np.zeros((0, 3), int)}, ["faces", "at least one triangle", "rig.faces"]),
        ({"faces": np.zeros((2, 3))}, ["faces", "float64", "whole numbers"]),
        ({"faces": [[0, 1, 242]]}, ["faces", "0 to 242", "0 to 241"]),
        ({"faces": [[0, -1, 2]]}, ["faces", "-1 to 2"]),
        ({"snap_to": np.zeros((0, 3))}, ["snap_to", "an empty array"]),
        ({"snap_to": np.zeros((5, 4))}, ["snap_to", "(5, 4)"]),
    ],
)
def test_bad_arguments_are_named(tube_rig, poses, change, words):
    given = {"points": poses[0], "registration_a": poses[0], "registration_b": poses[1], "faces": tube_rig.faces} | change
    with pytest.raises(InputError) as error:
        lbs.transfer(**given)
    for word in words:
        assert word in str(error.value)
