"""What scans show of a mesh: where a camera was, what is behind what it has seen, and what lies within a cropped scan's hull."""

from dataclasses import replace

import numpy as np
import pytest
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.fitting.refit import plain_chamfer
from lbsfit_np.losses.objective import PLAIN
from lbsfit_np.optimize import visibility
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.surface import vertex_normals
from lbsfit_np.optimize.visibility import (
    WHOLE,
    Coverage,
    camera_direction,
    hull_planes,
    seen_vertices,
    shown,
    within_hull,
)
from lbsfit_np.sensor import View, sample_surface


def _views(rig, n):
    """Posed meshes in half sizes, each seen by a known camera: (V, camera, points that it sees, normals there)."""
    rng = np.random.default_rng(11)
    for scan in lbs.synthesize(rig, n, poses="natural", random_state=12, shape=0.0, scale=0.0, turn=0.0):
        V = scan.vertices / (rig.size / 2)
        camera = rng.standard_normal(3)
        camera /= np.linalg.norm(camera)
        points, triangle, _ = sample_surface(V, rig.faces, 6000, rng)
        seen = View(V, rig.faces, camera).sees(points, triangle)
        a, b, c = (V[rig.faces[triangle[seen], k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        yield V, camera, points[seen], normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _angle(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1.0, 1.0)))


def test_faces_that_are_turned_inwards_are_turned_out(tube_rig):
    inside_out = replace(tube_rig, faces=tube_rig.faces[:, ::-1], vertices=tube_rig.vertices + 9.0, joints=tube_rig.joints + 9.0)
    np.testing.assert_array_equal(Model(inside_out).rig.faces, Model(tube_rig).rig.faces)
    np.testing.assert_array_equal(Model(tube_rig).rig.faces, tube_rig.welded.faces)


def test_of_one_side_the_chamfer_distance_is_over_what_that_shows():
    """Else it is mostly how far the hidden side is from the points: of right poses much in one view and little in another."""
    rig = lbs.load_rig("hand-coarse")
    model, half, middle = Model(rig), rig.size / 2, rig.joint_names.index("middle1")
    found = []
    for s in lbs.synthesize(rig, 12, poses="natural", random_state=5, one_sided=True, templates=[(rig.vertices, rig.joints)]):
        frame = Frame(s.points.mean(axis=0), half * s.scale)
        problem, place = Problem(frame.inside(s.points)), (s.translation - frame.centre) / frame.unit
        wrong = s.pose.copy()
        wrong[middle, 0] = rig.lower[middle, 0] if s.pose[middle, 0] > 0.7 else rig.upper[middle, 0]
        right, wrong = (model.rest().replace(theta=theta, translation=place) for theta in (s.pose, wrong))
        both = (right, True), (wrong, True), (right, False)
        found.append([plain_chamfer(model, problem, state, coverage=Coverage(partial)) for state, partial in both])
        assert found[-1][2] == problem.evaluate(model.coarse, right, PLAIN).value
    right, wrong, of_all = np.array(found).T
    assert right.max() < 1.6 * np.median(right) and np.median(wrong) > 3.0 * np.median(right)
    assert of_all.max() > 3.0 * np.median(of_all)


@pytest.mark.parametrize("which", ["hand-coarse", "body-coarse"])
def test_the_camera_is_where_all_that_is_seen_faces(which):
    """The mean normal leans to where there is more surface: on a body seen from the side, to its breast."""
    of_mean, of_all = [], []
    for _, camera, _, normals in _views(lbs.load_rig(which), 12):
        of_mean.append(_angle(normals.mean(axis=0), camera))
        of_all.append(_angle(camera_direction(normals), camera))
    assert np.median(of_all) < 7 and max(of_all) < 20
    assert np.median(of_all) < 0.6 * np.median(of_mean)


def test_surface_with_normals_of_one_kind_is_faced():
    normal = np.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(camera_direction(np.tile(normal, (5, 1))), normal, atol=1e-12)
    assert np.isfinite(camera_direction(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))).all()


def _plate(z, half):
    side = np.linspace(-half, half, round(half / 0.02) + 1)
    x, y = np.meshgrid(side, side)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


@pytest.mark.parametrize("turned", [np.eye(3), np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]])
@pytest.mark.parametrize("gap,hides", [(0.3, True), (0.04, False)])
def test_what_is_behind_a_point_of_the_scan_is_not_shown(turned, gap, hides):
    """A trunk behind an arm: what is right behind it cannot be seen, but the cloth or the skin that lies close to it may be."""
    back, arm = _plate(0.0, 0.5), _plate(gap, 0.16)
    covered = (np.abs(back[:, :2]) < 0.16 - 1e-9).all(axis=1)
    beside = (np.abs(back[:, :2]) > 0.16 + 0.05).any(axis=1)
    X, V = np.concatenate([back[beside], arm]) @ turned.T, back @ turned.T
    up = turned @ [0.0, 0.0, 1.0]
    to_X = np.linalg.norm(V[:, None] - X, axis=2).argmin(axis=1)
    found = shown(V, np.tile(up, (len(V), 1)), X, np.tile(up, (len(X), 1)), to_X)
    assert found[beside].all()
    assert found[covered].all() != hides and found[covered].any() != hides
    # Where the scan has nothing beside the arm, nothing says that what is there is behind it.
    found = shown(V, np.tile(up, (len(V), 1)), arm @ turned.T, np.tile(up, (len(arm), 1)), np.zeros(len(V), dtype=int))
    assert found[beside].all()


def test_sides_that_look_away_are_not_shown():
    plate = _plate(0.0, 0.3)
    up = np.tile([0.0, 0.0, 1.0], (len(plate), 1))
    own = np.arange(len(plate))
    assert shown(plate, up, plate, up, own).all()
    assert not shown(plate, -up, plate, up, own).any()
    steep = np.tile([np.sin(np.radians(75)), 0.0, np.cos(np.radians(75))], (len(plate), 1))
    assert not shown(plate, steep, plate, up, own).any()
    # The nearest point is on a fold's other side, whose surface looks another way.
    fold = up.copy()
    fold[0] = [1.0, 0.0, 0.0]
    assert not shown(plate, up, plate, fold, np.zeros(len(plate), dtype=int)).any()


@pytest.mark.parametrize("which", ["hand-coarse", slow("body-coarse")])
def test_little_is_taken_for_shown_that_the_camera_does_not_see(which):
    rig = lbs.load_rig(which)
    wrong, missed = [], []
    for V, camera, X, at_points in _views(rig, 12):
        normals = vertex_normals(V, rig.faces)
        to_X = np.linalg.norm(V[:, None] - X, axis=2).argmin(axis=1)
        found = shown(V, normals, X, at_points, to_X)
        # A vertex is seen where the camera sees the middle of a triangle at it.
        seen = np.zeros(len(V), dtype=bool)
        middles = V[rig.faces].mean(axis=1)
        seen[rig.faces[View(V, rig.faces, camera).sees(middles, np.arange(len(middles)))]] = True
        faced = seen & (normals @ camera > 0.5)
        wrong.append((found & ~seen).sum() / found.sum())
        missed.append((faced & ~found).sum() / faced.sum())
    assert np.mean(wrong) < 0.04
    assert np.mean(missed) < 0.15


def test_what_is_outside_the_hull_of_a_cropped_scan_is_not_shown(monkeypatch):
    box = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    planes = hull_planes(np.vstack([box, 0.2 * box]))
    assert len(planes) == 6  # each side once
    V = np.array([[0.0, 0.0, 0.0], [1.005, 0.0, 0.0], [1.02, 0.0, 0.0], [0.9, 0.9, -0.9], [0.0, -3.0, 0.0]])
    expected = [True, True, False, True, False]
    assert within_hull(V, planes).tolist() == expected
    monkeypatch.setattr(visibility, "_AT_ONCE", 2)
    assert within_hull(V, planes).tolist() == expected


@pytest.mark.parametrize("X", [np.zeros((1, 3)), np.eye(3), np.random.default_rng(0).random((40, 3)) * [1.0, 1.0, 0.0]])
def test_points_without_a_hull_hide_nothing(X):
    assert hull_planes(X).shape == (0, 4) and within_hull(np.full((3, 3), 9.0), hull_planes(X)).all()


@pytest.mark.parametrize("coverage", [WHOLE, Coverage(cropped=True), Coverage(one_sided=True), Coverage(True, True)])
def test_vertices_are_seen_that_neither_side_nor_hull_hides(coverage, tube_rig):
    model = Model(tube_rig)
    V = model.rig.vertices
    problem = Problem(V[(V[:, 1] < 0.2) & (V[:, 2] > 0.0)])
    near = np.linalg.norm(V[:, None] - problem.X, axis=2)
    seen = seen_vertices(coverage, V, model.rig.faces, problem, near.argmin(axis=0), near.argmin(axis=1))
    assert seen[V[:, 1] > 0.25].any() != coverage.cropped
    assert seen[(V[:, 2] < -0.01) & (V[:, 1] < 0.0)].any() != (coverage.one_sided or coverage.cropped)
    assert seen[near.min(axis=1) == 0.0].mean() > 0.5
    assert coverage.whole == seen.all()


@pytest.mark.parametrize("q", [1.0, 2.0])
def test_a_hull_goes_with_its_frame(q):
    problem = Problem(np.random.default_rng(0).standard_normal((50, 3)))
    other = problem.in_unit(q)
    out, same = ((2.0 * p.X @ p.hull[:, :3].T + p.hull[:, 3]).max(axis=1) for p in (problem, other))
    np.testing.assert_allclose(same, out / q, atol=1e-12)
    assert within_hull(other.X, other.hull).all()


@pytest.mark.parametrize("cropped, least", [(False, 0.2), (True, 0.05)])
def test_a_cropped_scan_may_show_little(cropped, least):
    assert [Coverage(side, cropped).least for side in (False, True)] == [least] * 2


def test_round_scans_of_many_points_fill_no_memory(monkeypatch):
    """A clean sphere has two planes for each point."""
    X = np.random.default_rng(0).standard_normal((1000, 3))
    planes = hull_planes(X / np.linalg.norm(X, axis=1, keepdims=True))
    assert len(planes) == 1996
    V = np.random.default_rng(1).standard_normal((3000, 3))
    all_at_once = within_hull(V, planes)
    monkeypatch.setattr(visibility, "_AT_ONCE", 7 * len(planes))
    assert np.array_equal(within_hull(V, planes), all_at_once)
