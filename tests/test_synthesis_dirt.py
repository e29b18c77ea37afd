"""What a sensor makes of a body: one-sided views, clutter and floors, which no segmenter learns as parts."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.segmentation.segmenter import train_segmenter
from lbsfit_np.segmentation.stage import Training
from lbsfit_np.sensor import View, sample_seen_surface, sample_surface, within_crop
from lbsfit_np.synthesis import Synthesis, make_settings

CLEAN = {"noise": 0.0, "holes": 0, "density": 0.0}
X, Y, Z = np.eye(3)


@pytest.mark.parametrize("seed", range(12))
def test_of_a_flat_mesh_a_side_is_taken_that_shows_something(seed):
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    points, _, _ = sample_seen_surface(*square, 30, np.random.default_rng(seed), up=Y)
    assert len(points) == 30


def test_a_mesh_that_no_camera_sees_is_an_error(tube_rig):
    thread = replace(tube_rig, vertices=tube_rig.vertices * [0, 1, 0])
    for seed in range(8):  # normals of rounding look anywhere
        with pytest.raises(InputError, match="one_sided: got True for a rig without a visible surface"):
            lbs.synthesize(thread, random_state=seed, n_points=20, one_sided=True, poses=np.zeros((1, 4, 3)), shape=0.0)


def _box(points):
    return points.min(axis=0), points.max(axis=0)


# ---- while they are off, nothing changes ----


def test_scans_of_older_settings_are_what_they_were(tube_rig):
    """Numbers from before there were these settings: cached segmenters and published figures rest on the same scans."""
    settings = {"n_points": 400, "least_holes": 1, "turn": 0.5, "scale": 0.1}
    one, two = lbs.synthesize(tube_rig, 2, random_state=5, **settings)
    first_and_last = [
        [-0.027452292978705554, -0.41341267300137563, -0.09222521866118433],
        [-0.005101859615708705, -0.49583903597561385, 0.03939951139745006],
    ]
    np.testing.assert_allclose(one.points[[0, -1]], first_and_last, rtol=1e-12)
    assert one.labels[:12].tolist() == [0, 1, 0, 0, 2, 0, 1, 0, 1, 0, 0, 3] and one.labels.sum() == 275
    assert two.points.sum() == pytest.approx(-45.708597671031065, rel=1e-12) and two.labels.sum() == 581
    assert two.scale == pytest.approx(0.9527724877179691, rel=1e-15)
    again = lbs.synthesize(tube_rig, 1, random_state=5, clutter=0.0, floor=0.0, one_sided=False, cropped=0.0, **settings)[0]
    assert np.array_equal(again.points, one.points)


def test_flags_may_be_of_any_kind_of_truth():
    """The key of what is cached is made of their text."""
    made = make_settings({"one_sided": 1})
    assert made == make_settings({"one_sided": np.True_}) == Synthesis(one_sided=True)
    assert "one_sided=True," in repr(made)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"one_sided": 2}, ["one_sided: got 2", "True or False"]),
        ({"one_sided": 1.0}, ["one_sided: got 1.0", "True or False"]),
        ({"one_sided": "left"}, ["one_sided: got 'left'", "True or False"]),
        ({"clutter": -0.1}, ["clutter: got -0.1", "at least 0"]),
        ({"floor": np.inf}, ["floor: got inf", "at least 0"]),
        ({"floor": True}, ["floor: got True", "a number"]),
    ],
)
def test_bad_settings_are_named(tube_rig, settings, words):
    with pytest.raises(InputError) as error:
        lbs.synthesize(tube_rig, **settings)
    assert all(word in str(error.value) for word in words), error.value


# ---- clutter and floor ----


def test_clutter_fills_a_box_around_the_scan(tube_rig):
    plain, among = (lbs.synthesize(tube_rig, 1, random_state=3, scale=0.2, clutter=share)[0] for share in (0.0, 0.4))
    n = len(plain.points)
    assert np.array_equal(among.points[:n], plain.points) and np.array_equal(among.labels[:n], plain.labels)
    others = among.points[n:]
    assert len(others) == round(0.4 * n) and (among.labels[n:] == -1).all()
    (low, high), (least, most) = _box(plain.points), _box(others)
    middle, half = (low + high) / 2, 0.65 * (high - low)
    assert (least >= middle - half).all() and (most <= middle + half).all()
    np.testing.assert_allclose(most - least, 2 * half, rtol=0.02)
    np.testing.assert_allclose(others.std(axis=0), 2 * half / np.sqrt(12), rtol=0.05)


@pytest.mark.parametrize("axis", ["+y", "-y", "+z", None])
def test_a_floor_is_under_the_lowest_vertex(tube_rig, axis):
    from dataclasses import replace

    rig = replace(tube_rig, up=axis, forward=None)
    up = {"+z": Z, "-y": -Y}.get(axis, Y)
    plain, standing = (lbs.synthesize(rig, 1, random_state=3, floor=share, **CLEAN)[0] for share in (0.0, 0.5))
    n = len(plain.points)
    floor = standing.points[n:]
    assert len(floor) == n // 2 and (standing.labels[n:] == -1).all() and np.array_equal(standing.points[:n], plain.points)
    np.testing.assert_allclose(floor @ up, (standing.vertices @ up).min(), atol=1e-12)
    (low, high), (least, most) = _box(plain.points), _box(floor)
    across = up == 0
    np.testing.assert_allclose((most - least)[across], 1.5 * (high - low)[across], rtol=0.02)
    np.testing.assert_allclose(((most + least) / 2)[across], ((high + low) / 2)[across], atol=0.02)
    noisy = lbs.synthesize(rig, 1, random_state=3, floor=0.5, **CLEAN | {"noise": 0.02})[0]
    away = noisy.points[n:] @ up - (noisy.vertices @ up).min()
    assert np.std(away) == pytest.approx(0.02 * rig.size / 2, rel=0.1)


def test_both_and_one_side(tube_rig):
    scan = lbs.synthesize(tube_rig, 1, random_state=1, n_points=200, holes=0, clutter=0.1, floor=0.2, one_sided=True)[0]
    assert len(scan.points) == len(scan.labels) == 260 and (scan.labels == -1).sum() == 60
    assert scan.labels.dtype.kind == "i" and set(scan.labels[:200].tolist()) <= set(range(4))


# ---- one side ----


def _hidden(points, vertices, faces, towards):
    """Whether a ray from each point to a camera far away meets a triangle: every triangle tried (Möller and Trumbore)."""
    a = vertices[faces[:, 0]]
    e1, e2 = vertices[faces[:, 1]] - a, vertices[faces[:, 2]] - a
    h = np.cross(towards, e2)
    det = np.einsum("fa,fa->f", e1, h)
    safe = np.where(np.abs(det) < 1e-15, np.inf, det)
    hidden = np.zeros(len(points), bool)
    for k, p in enumerate(points):
        s = p - a
        q = np.cross(s, e1)
        u, v, t = np.einsum("fa,fa->f", s, h) / safe, q @ towards / safe, np.einsum("fa,fa->f", q, e2) / safe
        hidden[k] = np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-4))
    return hidden


def test_a_view_sees_what_nothing_hides():
    rig = lbs.load_rig("hand-coarse")
    V = rig.pose(rig.poses["thumb and index"]) / rig.size
    rng = np.random.default_rng(0)
    for towards in (Z, -X, np.array([0.6, 0.48, 0.64])):
        points, triangle, _ = sample_surface(V, rig.faces, 1500, rng)
        sees, hidden = View(V, rig.faces, towards).sees(points, triangle), _hidden(points, V, rig.faces, towards)
        assert 0.2 < sees.mean() < 0.5
        assert (sees & hidden).mean() < 0.01  # within a pixel of what hides them
        assert (~sees & ~hidden).mean() < 0.015  # seen along the surface, at its outline


@pytest.mark.parametrize("inside_out", [False, True])
def test_of_two_balls_the_near_half_of_the_near_one_is_seen(inside_out):
    ball = trimesh.creation.icosphere(subdivisions=3)
    V = np.concatenate([ball.vertices, 0.5 * ball.vertices - [0, 0, 3.0]])
    F = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    F = F[:, ::-1] if inside_out else F
    view = View(V, F, Z)
    corner = V[F].mean(axis=1)
    sees = view.sees(corner, np.arange(len(F)))
    assert not sees[len(ball.faces) :].any() and not sees[corner[:, 2] < -0.05].any()
    assert sees[: len(ball.faces)][corner[: len(ball.faces), 2] > 0.1].all()
    np.testing.assert_allclose(view.facing[: len(ball.faces)], np.maximum(corner[: len(ball.faces), 2], 0), atol=0.03)


def test_points_are_even_in_the_image():
    """A flat roof and a steep one: as many points on each as they take of the picture, not of the surface."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    points, _, _ = sample_seen_surface(ball.vertices, ball.faces, 20_000, np.random.default_rng(0), up=Y)
    assert len(points) == 20_000
    towards = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
    r = np.linalg.norm(points - np.outer(points @ towards, towards), axis=1)
    for part in (0.3, 0.5, 0.8):
        assert np.mean(r < part) == pytest.approx(part**2, abs=0.02)


def test_cameras_stand_anywhere_but_high_and_low():
    ball = trimesh.creation.icosphere(subdivisions=2)
    elevations, sides = [], []
    for seed in range(60):
        points, _, _ = sample_seen_surface(ball.vertices, ball.faces, 400, np.random.default_rng(seed), up=Z)
        towards = points.mean(axis=0) / np.linalg.norm(points.mean(axis=0))
        elevations.append(np.degrees(np.arcsin(towards[2])))
        sides.append(int(np.arctan2(towards[1], towards[0]) // (np.pi / 2)))
    assert -35 < min(elevations) < -20 and 20 < max(elevations) < 35
    assert set(sides) == {-2, -1, 0, 1}


def test_one_sided_scans_are_one_sided_and_as_full_as_others(tube_rig):
    whole, half = (lbs.synthesize(tube_rig, 6, random_state=2, n_points=600, one_sided=s, **CLEAN) for s in (False, True))
    for a, b in zip(whole, half):
        assert len(a.points) == len(b.points) == 600
        assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.pose, b.pose)
        assert _unseen(b) > 4 * _unseen(a) + 0.1
    again = lbs.synthesize(tube_rig, 2, random_state=2, n_points=600, one_sided=True, **CLEAN)[1]
    assert np.array_equal(again.points, half[1].points) and np.array_equal(again.labels, half[1].labels)


@pytest.mark.parametrize("one_sided", [False, True])
def test_cropped_scans_end_at_a_plane_and_are_as_full_as_others(one_sided, tube_rig):
    """So much is left out as the setting says at most, along any direction."""
    settings = {"random_state": 2, "n_points": 600, "noise": 0.0, "density": 0.0, "shape": 0.0, "one_sided": one_sided}
    left = []
    for scan in lbs.synthesize(tube_rig, 30, cropped=0.5, poses=np.zeros((1, 4, 3)), **settings):
        assert len(scan.points) == len(scan.labels) == len(scan.triangle) == 600
        on = np.einsum("nk,nka->na", scan.barycentric, scan.vertices[tube_rig.faces[scan.triangle]])
        np.testing.assert_allclose(on, scan.points, atol=1e-12)
        left.append(_unseen(scan))
    whole = [_unseen(scan) for scan in lbs.synthesize(tube_rig, 30, poses=np.zeros((1, 4, 3)), **settings)]
    more = np.array(left) - np.median(whole)
    assert 0.1 < np.mean(more) < 0.35 and np.max(more) < 0.55 and np.min(more) < 0.1


def test_what_is_beyond_a_crop_is_a_share_along_one_direction():
    points, rng, same = np.random.default_rng(0).standard_normal((4000, 3)), np.random.default_rng(1), np.random.default_rng(1)
    for beyond in (0.1, 0.5):
        kept, direction = within_crop(points, beyond, rng), same.standard_normal(3)
        assert kept.mean() == pytest.approx(1.0 - beyond, abs=1e-3)
        assert (points[kept] @ direction).max() < (points[~kept] @ direction).min()
    assert within_crop(points, 0.0, rng).all()


def _unseen(scan):
    """Share of the vertices with no point near."""
    from scipy.spatial import cKDTree

    return (cKDTree(scan.points).query(scan.vertices)[0] > 0.08).mean()


# ---- nobody learns them ----


def test_points_of_no_part_are_seen_and_not_learned(tube_rig, monkeypatch):
    from lbsfit_np.segmentation import segmenter as module

    taken = {}

    def train_stage(X, y, *arguments, **options):
        taken[arguments[3]] = X, y
        return stage(X, y, *arguments, **options)

    def scans(clutter):
        made = lbs.synthesize(tube_rig, 40, random_state=0, n_points=150, clutter=clutter)
        return lambda i: (made[i].points, made[i].labels, 1.0)

    stage = module.train_stage
    monkeypatch.setattr(module, "train_stage", train_stage)
    training = Training(points_per_scan=60)
    train_segmenter(tube_rig, scans(3.0), 40, training=training, random_state=0)
    assert set(taken) == {"first", "second"}
    for X, y in taken.values():
        assert set(y.tolist()) == {0, 1, 2, 3} and len(X) == len(y) and len(y) % 60 == 0
    among = taken["first"][0]
    taken.clear()
    train_segmenter(tube_rig, scans(0.0), 40, training=training, random_state=0)
    assert taken["first"][0].shape == among.shape and not np.allclose(taken["first"][0], among)  # what is around is described
