"""The renderer: exact silhouettes, right occlusion, the same picture every time; colours that differ."""

import struct
import zlib

import numpy as np
import pytest
from small_rigs import make_tube_data, with_loose_vertices

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.report.colors import label_colors, part_colors
from lbsfit_np.report.fit_picture import fit_picture
from lbsfit_np.report.render import (
    Mesh,
    Points,
    is_signed,
    montage,
    render,
    render_mesh,
    render_points,
    write_png,
)
from lbsfit_np.rig.build import build_rig

RED, GREEN, BLUE = (230, 20, 20), (20, 200, 20), (20, 20, 230)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]])


def sphere(n=60, radius=1.0):
    u, v = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    points = radius * np.stack([np.sin(u) * np.cos(v), np.cos(u), np.sin(u) * np.sin(v)], axis=-1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * 2 * n + np.arange(2 * n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 2 * n], 1), np.stack([a + 1, a + 2 * n + 1, a + 2 * n], 1)])
    return points, faces


def drawn(image):
    """Share of the pixels that something covers, antialiased edges counted by their share (for dark things on white)."""
    return np.mean(np.any(image < 250, axis=2))


def main_colour(pixel):
    return ("red", "green", "blue")[int(np.argmax(pixel))]


@pytest.mark.parametrize("view", ["front", "left", (40, 35), "top"])
def test_a_spheres_silhouette_has_the_area_of_a_disc(view):
    points, faces = sphere()
    image = render_mesh(points, faces, size=(400, 400), view=view, margin=0.1, colors=(60, 60, 60))
    assert abs(drawn(image) / (np.pi / 4 * 0.8**2) - 1) < 0.015
    rows, columns = np.nonzero(np.any(image < 250, axis=2))
    assert abs(rows.mean() - 199.5) < 0.5 and abs(columns.mean() - 199.5) < 0.5


def test_a_triangle_covers_half_of_its_square_exactly():
    image = render_mesh(SQUARE, TWO[:1], size=(200, 200), margin=0.0, colors=(0, 0, 0), frame=SQUARE)
    assert abs(np.mean(255.0 - image) / 255 - 0.5) < 0.003


def test_neighbouring_triangles_leave_no_crack():
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0), indexing="ij"), axis=-1).reshape(-1, 2)
    inner = np.all((grid > 0) & (grid < 29), axis=1)
    grid[inner] += rng.uniform(-0.4, 0.4, (inner.sum(), 2))
    points = np.column_stack([grid, np.zeros(900)])
    a = (np.arange(29)[:, None] * 30 + np.arange(29)).ravel()
    faces = np.concatenate([np.stack([a, a + 30, a + 1], 1), np.stack([a + 1, a + 30, a + 31], 1)])
    image = render_mesh(points, faces, size=(300, 300), margin=0.0, smooth=False)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) == 1


@pytest.mark.parametrize("order", [1, -1])
def test_what_is_nearer_hides_what_is_behind(order):
    near, far = Mesh(SQUARE * 0.5 + [0, 0, 1], TWO, RED), Mesh(SQUARE, TWO, GREEN)
    items = [near, far][::order]
    front = render(*items, size=(100, 100), margin=0)
    assert main_colour(front[50, 50]) == "red" and main_colour(front[50, 10]) == "green"
    assert main_colour(render(*items, size=(100, 100), view="back", margin=0)[50, 50]) == "green"


def test_of_two_at_the_same_depth_the_first_stays():
    image = render(Mesh(SQUARE, TWO, RED), Mesh(SQUARE, TWO, GREEN), size=(50, 50), margin=0)
    assert main_colour(image[25, 25]) == "red"


def test_crossing_triangles_share_the_picture_by_depth():
    tilted = SQUARE.copy()
    tilted[:, 2] = tilted[:, 0]  # in front on the right, behind on the left
    image = render(Mesh(SQUARE, TWO, GREEN), Mesh(tilted, TWO, RED), size=(100, 100), margin=0)
    assert main_colour(image[50, 80]) == "red" and main_colour(image[50, 20]) == "green"


def test_points_and_meshes_hide_each_other():
    points = np.array([[-0.5, 0, 1.0], [0.5, 0, -1.0]])
    image = render(Mesh(SQUARE, TWO, GREEN), Points(points, BLUE, 5), size=(100, 100), margin=0)
    assert main_colour(image[50, 25]) == "blue" and main_colour(image[50, 75]) == "green"


def test_points_are_balls_of_their_radius():
    image = render_points([[0.0, 0, 0]], colors=(0, 0, 0), radius=20, size=(100, 100))
    assert abs(np.mean(255.0 - image) / 255 * 1e4 / (np.pi * 400) - 1) < 0.02
    many = render_points(np.random.default_rng(0).normal(size=(500, 3)), size=(200, 200))
    assert 0.005 < drawn(many) < 0.5


@pytest.mark.parametrize(
    "view, up, forward, expected",
    [
        ("front", "+y", None, ("+x", "+y")),
        ("back", "+y", None, ("-x", "+y")),
        ("left", "+y", None, ("-z", "+y")),
        ("right", "+y", None, ("+z", "+y")),
        ("top", "+y", None, ("+x", "-z")),
        ("front", "+z", None, ("+x", "+z")),
        ("front", "+z", "+x", ("+y", "+z")),
        ((180, 0), "+z", None, ("-x", "+z")),
        ("front", "+x", None, ("-y", "+x")),
    ],
)
def test_views_show_the_axes_where_they_should_be(view, up, forward, expected):
    axes = {"+x": 0, "+y": 1, "+z": 2}
    for name, place in zip(expected, [(50, 90), (10, 50)]):
        point = np.zeros((1, 3))
        point[0, axes["+" + name[1]]] = 0.8 if name[0] == "+" else -0.8
        corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1.0)])
        image = render(Points(point, (0, 0, 0), 4), view=view, up=up, forward=forward, frame=corners, size=(100, 100), margin=0)
        row, column = np.argwhere(np.any(image < 250, axis=2)).mean(axis=0)
        assert abs(row - place[0]) < 3 and abs(column - place[1]) < 3


def test_elevation_looks_from_above():
    points = np.array([[0, 0, 1.0], [0, 0, -1.0]])  # nearer and farther on the ground
    image = render(Points(points, np.array([RED, BLUE]), 5), view=(0, 30), size=(100, 100))
    red, blue = (np.argwhere(image[:, :, c].astype(int) - image[:, :, 2 - c] > 60)[:, 0].mean() for c in (0, 2))
    assert red > blue  # what is nearer stands lower in the picture


@pytest.mark.parametrize("smooth", [True, False])
def test_colours_by_vertex_and_by_face_and_light_from_above_left(smooth):
    points, faces = sphere(30)
    by_vertex = render_mesh(points, faces, colors=np.where(points[:, :1] > 0, RED, BLUE), size=(100, 100), smooth=smooth)
    by_face = render_mesh(
        points, faces, colors=np.where(points[faces].mean(1)[:, :1] > 0, RED, BLUE), size=(100, 100), smooth=smooth
    )
    for image in (by_vertex, by_face):
        assert main_colour(image[50, 75]) == "red" and main_colour(image[50, 25]) == "blue"
    grey = render_mesh(points, faces, size=(100, 100), smooth=smooth).sum(axis=2, dtype=int)
    assert grey[30, 30] > grey[70, 70] + 60


def test_winding_does_not_matter_to_the_light():
    points, faces = sphere(30)
    one, other = (render_mesh(points, f, size=(100, 100)).astype(int) for f in (faces, faces[:, ::-1]))
    assert np.abs(one - other).max() <= 1


def test_the_same_picture_every_time_and_in_any_batch(monkeypatch):
    points, faces = sphere(25)
    items = Mesh(points, faces), Points(points * 1.01)
    first = render(*items, size=(150, 100))
    assert first.shape == (100, 150, 3) and first.dtype == np.uint8
    np.testing.assert_array_equal(first, render(*items, size=(150, 100)))
    monkeypatch.setattr("lbsfit_np.raster._MOST_FRAGMENTS", 1000)
    np.testing.assert_array_equal(first, render(*items, size=(150, 100)))


def test_content_that_leaves_the_picture_or_is_degenerate():
    points, faces = sphere(20)
    image = render_mesh(points, faces, frame=points * 0.2, size=(80, 80), colors=(0, 0, 0))
    assert drawn(image) == 1.0
    assert drawn(render_mesh(points + [9, 0, 0], faces, frame=points, size=(80, 80))) == 0.0
    line = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]])
    assert drawn(render_mesh(line, [[0, 1, 2]], size=(80, 80))) == 0.0
    assert drawn(render(size=(20, 20))) == 0.0


@pytest.mark.filterwarnings("error")
def test_points_however_far_off_leave_the_picture_without_a_word():
    near = sphere(20)[0]
    alone = render_points(near, frame=near, radius=3, size=(80, 80))
    for far in (1e3, 1e18, 1e160, np.finfo(np.float32).max):
        wild = np.vstack([near, [[far, 0, 0], [-far, far, 0]]])
        np.testing.assert_array_equal(render_points(wild, frame=near, radius=3, size=(80, 80)), alone)


def test_a_common_frame_keeps_the_scale():
    points, faces = sphere(30)
    full, half = (drawn(render_mesh(k * points, faces, frame=points, size=(200, 200), colors=(0, 0, 0))) for k in (1.0, 0.5))
    assert abs(full / half - 4) < 0.15


@pytest.mark.parametrize(
    "options, words",
    [
        ({"view": "behind"}, "view: got 'behind'; expected one of front"),
        *(({"view": view}, "view: got .*; expected one of front, .* or .azi") for view in (None, [], [[0], [1, 2]], (1, 2, 3))),
        ({"view": (0, np.nan)}, "view: got .0, nan.; expected one of front"),
        ({"up": "y"}, "up"),
        ({"up": "+y", "forward": "-y"}, "forward"),
        ({"colors": np.zeros((5, 3))}, r"colors: got shape \(5, 3\)"),
    ],
)
def test_odd_options(options, words):
    with pytest.raises(InputError, match=words):
        render_mesh(SQUARE, TWO, **options)


def test_montage_centres_and_pads():
    a, b = np.zeros((10, 20, 3), np.uint8), np.full((4, 6, 3), 9, np.uint8)
    out = montage([[a, b], [b]], gap=2)
    assert out.shape == (16, 28, 3)
    assert (out[:10, :20] == 0).all() and (out[3:7, 22:28] == 9).all() and (out[12:16, 7:13] == 9).all()
    assert (out[10:12] == 255).all() and (out[12:16, :7] == 255).all()


@pytest.mark.parametrize("channels", [3, 4])
def test_png_holds_the_pixels(tmp_path, channels):
    image = np.random.default_rng(0).integers(256, size=(7, 5, channels), dtype=np.uint8)
    write_png(tmp_path / "a.png", image)
    data = (tmp_path / "a.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        chunks[kind] = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + chunks[kind])
        at += 12 + length
    assert struct.unpack(">IIBBBBB", chunks[b"IHDR"]) == (5, 7, 8, 2 if channels == 3 else 6, 0, 0, 0)
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(7, -1)
    np.testing.assert_array_equal(rows[:, 1:].reshape(image.shape), image)
    assert is_signed(tmp_path / "a.png") and chunks[b"tEXt"] == b"Software\0lbsfit_np"
    (tmp_path / "other.png").write_bytes(data.replace(b"lbsfit_np", b"paintings"))
    assert not is_signed(tmp_path / "other.png")
    with pytest.raises(InputError, match="image"):
        write_png(tmp_path / "b.png", image / 255)


def test_part_colours_differ_and_stay():
    colors = part_colors(60)
    assert colors.shape == (60, 3) and colors.dtype == np.uint8
    np.testing.assert_array_equal(colors[:10], part_colors(10))
    assert len(np.unique(part_colors(100), axis=0)) == 100
    assert part_colors(0).shape == (0, 3) and part_colors(1000).shape == (1000, 3)
    for gap in (1, 2, 3):  # numbers that stand near each other
        distance = np.linalg.norm(colors[gap:].astype(float) - colors[:-gap], axis=1)
        assert distance[:20].min() > 65 and distance.min() > 45
    apart = np.linalg.norm(colors[:20, None].astype(float) - colors[None, :20], axis=2) + 999 * np.eye(20)
    assert apart.min() > 40


def test_fits_are_drawn_as_the_rig_stands(tube_rig, tube_scan, tube_result):
    """However the scan lies, the picture is the same."""
    from dataclasses import replace

    from lbsfit_np.optimize.frame import turned_root
    from lbsfit_np.rotations import matrix_from_rotvec

    shown = fit_picture(tube_rig, tube_scan.points, tube_result, size=(60, 80))
    R = matrix_from_rotvec(np.array([0.4, 1.9, -0.3]))
    turned = {"vertices": tube_result.vertices @ R.T, "pose": turned_root(tube_rig, tube_result.pose, R)}
    again = fit_picture(tube_rig, tube_scan.points @ R.T, replace(tube_result, **turned), size=(60, 80))
    assert shown.shape[2] == 3 and (np.abs(shown.astype(int) - again).max(axis=2) > 8).mean() < 0.01
    wide = fit_picture(tube_rig, tube_scan.points, tube_result, truth=tube_scan.vertices, size=(60, 80))
    assert wide.shape[1] > 1.4 * shown.shape[1]
    rig = build_rig(with_loose_vertices(make_tube_data(), [[0.0, 20, 0]]))  # of no face, and so nothing to be seen
    loose = replace(tube_result, vertices=np.vstack([[[0.0, 20, 0]], tube_result.vertices]))
    np.testing.assert_array_equal(fit_picture(rig, tube_scan.points, loose, size=(60, 80)), shown)


def test_points_off_the_mesh_are_in_the_picture(tube_rig, tube_scan, tube_result):
    """Where a fit is wrong they are what is to be seen; a single wild one is not."""
    def drawn(points):
        shown = fit_picture(tube_rig, points, tube_result, size=(60, 80))
        mesh = shown[:, shown.shape[1] // 2 :]
        return (np.abs(mesh.astype(int) - mesh[0, -1]).max(axis=2) > 8).sum()

    far = tube_scan.points.copy()
    far[::4] += [2 * tube_rig.size, 0, 0]
    wild = tube_scan.points.copy()
    wild[7] += 100 * tube_rig.size
    assert drawn(far) < 0.5 * drawn(tube_scan.points) and drawn(wild) > 0.9 * drawn(tube_scan.points)


@pytest.fixture
def drawn_items(monkeypatch):
    """What a picture of a fit draws: (rig, points, result, options) → items and options of each call of the renderer."""
    from lbsfit_np.report import fit_picture

    def of(*fit, **options):
        calls = []
        monkeypatch.setattr(fit_picture, "render", lambda item, **how: calls.append((item, how)) or np.zeros((4, 4, 3), np.uint8))
        fit_picture.fit_picture(*fit, **options)
        return calls

    return of


def test_points_and_mesh_have_the_colours_of_their_parts(tube_rig, tube_scan, tube_result, drawn_items):
    colors = part_colors(4)
    calls = drawn_items(tube_rig, tube_scan.points, tube_result)
    assert [how["view"] for _, how in calls] == ["front", "front", "oblique", "oblique"]
    for points, mesh in ((calls[0][0], calls[1][0]), (calls[2][0], calls[3][0])):
        assert isinstance(points, Points) and isinstance(mesh, Mesh) and len(points.points) == len(tube_scan.points)
        np.testing.assert_array_equal(points.colors, colors[tube_result.labels])
        np.testing.assert_array_equal(mesh.colors, colors[tube_rig.vertex_labels])


def test_of_a_large_scan_each_point_keeps_its_colour(tube_rig, tube_scan, tube_result, drawn_items):
    """Of 70,000 points in no order, the x coordinate of which tells their row, some are drawn, from the first to the last."""
    from dataclasses import replace

    row = np.random.default_rng(0).permutation(70_000)  # by the x coordinate
    x = np.argsort(row)
    labels = np.arange(len(x)) * 4 // len(x)
    result = replace(tube_result, labels=labels, confidence=np.ones(len(x)), pose=np.zeros((4, 3)))
    points = drawn_items(tube_rig, np.column_stack([x, 0 * x, 0 * x]), result)[0][0]
    shown = row[points.points[:, 0].round().astype(int)]
    assert len(shown) == 30_000 and shown[0] == 0 and shown[-1] == 69_999
    np.testing.assert_array_equal(points.colors, part_colors(4)[labels[shown]])


def test_of_cameras_whose_points_stand_in_turn_all_are_drawn(tube_rig, tube_result, drawn_items):
    from dataclasses import replace

    n = 60_000
    camera = np.arange(n) % 2
    x = np.arange(n) / n + 5 * camera
    result = replace(tube_result, labels=np.zeros(n, int), confidence=np.ones(n), pose=np.zeros((4, 3)))
    points = drawn_items(tube_rig, np.column_stack([x, 0 * x, 0 * x]), result)[0][0].points
    assert len(points) == 30_000 and 0.45 < (points[:, 0] > 3).mean() < 0.55


def test_the_truth_is_turned_along_and_seen_from_the_rigs_front(tube_rig, tube_scan, tube_result, drawn_items):
    from dataclasses import replace

    from lbsfit_np.optimize.frame import root_turn, turned_root
    from lbsfit_np.rotations import matrix_from_rotvec

    R = matrix_from_rotvec(np.array([0.4, 1.9, -0.3]))
    turned = replace(tube_result, vertices=tube_result.vertices @ R.T, pose=turned_root(tube_rig, tube_result.pose, R))
    rig, own = replace(tube_rig, forward="-x"), root_turn(tube_rig, tube_result.pose)
    calls = drawn_items(rig, tube_scan.points @ R.T, turned, truth=tube_scan.vertices @ R.T)
    for k, (item, how) in enumerate(calls):
        whole = (tube_scan.points, tube_scan.vertices, tube_result.vertices)[k % 3]
        np.testing.assert_allclose(item.points if k % 3 == 0 else item.vertices, whole @ own, atol=1e-9)
        assert (how["up"], how["forward"]) == ("+y", "-x")
    assert calls[1][0].colors is None  # grey
    far = drawn_items(rig, tube_scan.points @ R.T, turned, truth=(tube_scan.vertices + 9.0) @ R.T)
    reach = ((tube_scan.vertices + 9.0) @ own).max(axis=0)
    assert all((how["frame"].max(axis=0) >= reach - 1e-9).all() for _, how in far)


@pytest.mark.parametrize(
    "up, forward, seen", [(None, "+z", ("+y", "+z")), (None, "-y", ("+y", None)), ("+z", "-y", ("+z", "-y"))]
)
def test_a_rig_that_says_less_is_drawn_as_well(tube_rig, tube_scan, tube_result, drawn_items, up, forward, seen):
    """Where +y is taken for up, nothing faces along it."""
    from dataclasses import replace

    calls = drawn_items(replace(tube_rig, up=up, forward=forward), tube_scan.points, tube_result)
    assert {(how["up"], how["forward"]) for _, how in calls} == {seen}


def test_scans_are_drawn_as_their_points(tube_rig, tube_scan, tube_result):
    drawn = [fit_picture(tube_rig, points, tube_result) for points in (tube_scan.points, lbs.Scan(tube_scan.points))]
    np.testing.assert_array_equal(*drawn)
    with pytest.raises(InputError, match=r"points: got \d+; expected \d+, as many as the fit has labels"):
        fit_picture(tube_rig, tube_scan.points[1:], tube_result)


def test_points_of_a_floor_have_the_colour_of_no_part(tube_rig, tube_scan, tube_result, drawn_items):
    """Nor does a floor as wide as a hall make the body tiny."""
    from dataclasses import replace

    n, rng = len(tube_scan.points), np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-50, 50, n), np.full(n, tube_scan.points[:, 1].min()), rng.uniform(-50, 50, n)])
    points, off = np.vstack([tube_scan.points, floor]), np.zeros(n)
    both = replace(tube_result, labels=np.tile(tube_result.labels, 2), confidence=np.r_[tube_result.confidence, off])
    ((drawn, how), *_) = drawn_items(tube_rig, points, both)
    np.testing.assert_array_equal(drawn.colors[:n], part_colors(4)[tube_result.labels])
    assert (np.ptp(drawn.colors[n:], axis=1) == 0).all() and (drawn.colors[n:] > 150).all()
    assert np.ptp(how["frame"], axis=0).max() < 2.5 * np.ptp(tube_result.vertices, axis=0).max()


def test_points_without_confidence_have_a_colour_of_no_part():
    colors = label_colors(np.array([0, 1, 1, 0]), np.array([1.0, 0.0, 0.06, 0.04]), 2)
    np.testing.assert_array_equal(colors[[0, 2]], part_colors(2))
    np.testing.assert_array_equal(colors[[1, 3]], 205)
