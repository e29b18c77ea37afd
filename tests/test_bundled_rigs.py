"""The rigs that ship: well-made skins, anatomical axes, honest weights, poses within limits, and builds that repeat."""

import numpy as np
import pytest
from rebuilt_rigs import assert_rebuilt, rig_module
from slow_tests import slow

from lbsfit_np.errors import FileError
from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.rigs import about_bundled, bundled_rigs, load_rig, read_rig_data

checks, heat, implicit, remesh = map(rig_module, ("checks", "heat", "implicit", "remesh"))
hand_shape, hand_poses = rig_module("hand_shape"), rig_module("hand_poses")

LONG = ("index", "middle", "ring", "pinky")


@pytest.fixture(scope="module")
def hand():
    return load_rig("hand")


@pytest.fixture(scope="module")
def hand_file():
    path = read_rig_data("hand").path
    return path, read_npz(path)


def _row(rig, name):
    return rig.joint_names.index(name)


def _turned(rig, name, axis, degrees):
    theta = np.zeros(rig.lower.shape)
    theta[_row(rig, name), axis] = np.radians(degrees)
    return theta


def _tip(rig, vertices, finger):
    """Mean of the ten vertices that are outermost along the finger's last bone at rest."""
    row = _row(rig, finger + "3")
    own = np.flatnonzero(rig.weights[:, [row]].toarray().ravel() > 0.5)
    along = (rig.vertices[own] - rig.joints[row]) @ rig.frames[row][:, 2]
    return vertices[own[np.argsort(-along)[:10]]].mean(axis=0)


# ---- the skin ----


def test_skin_is_one_closed_outward_manifold(hand):
    assert checks.edge_uses(hand.faces) == (1, True)
    assert checks.euler_characteristic(hand.faces) == 2
    assert checks.components(hand.faces, len(hand.vertices)) == 1
    assert checks.volume(hand.vertices, hand.faces) > 0
    assert 1300 < len(hand.vertices) < 1700


def test_no_triangle_looks_inward(hand):
    skin = hand_shape.surface()
    p = hand.vertices[hand.faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    outward = implicit.gradient(skin, p.mean(axis=1))
    cosine = np.einsum("ij,ij->i", normal, outward) / np.linalg.norm(normal, axis=1) / np.linalg.norm(outward, axis=1)
    assert cosine.min() > 0.6  # the sharpest bends are between the fingers


def test_skin_does_not_cut_itself_at_rest(hand):
    assert len(checks.self_intersections(hand.vertices, hand.faces)) == 0


def test_triangles_are_near_uniform(hand):
    p = hand.vertices[hand.faces]
    edges = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2)
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) / 2
    assert edges.max() < 3 * edges.min()
    assert (4 * np.sqrt(3) * area / (edges**2).sum(axis=1)).min() > 0.7  # 1 for an equilateral triangle


def test_vertices_lie_on_the_surface_they_were_built_from(hand):
    assert np.abs(hand_shape.surface()(hand.vertices)).max() < 2e-5


# ---- size, frame, skeleton ----


def test_frame_unit_and_size(hand):
    assert (hand.metres_per_unit, hand.up, hand.forward) == (1.0, "+y", "+z")
    assert np.array_equal(hand.joints[hand.root], np.zeros(3))
    assert hand.vertices[:, 1].max() == pytest.approx(0.187, abs=0.001)  # hand length
    across = hand.joints[_row(hand, "index1")] - hand.joints[_row(hand, "pinky1")]
    across /= np.linalg.norm(across)
    along = (hand.vertices - hand.joints[_row(hand, "ring1")]) @ np.cross([0, 0, 1], across)
    thumb = np.array([name.startswith("thumb") for name in hand.parts])[hand.vertex_labels]
    assert np.ptp(hand.vertices[(np.abs(along) < 0.008) & ~thumb] @ across) == pytest.approx(0.085, abs=0.004)


def test_joints_are_manos(hand):
    fingers = ("index", "middle", "pinky", "ring", "thumb")
    assert hand.joint_names == ("wrist", *(f"{f}{k}" for f in fingers for k in (1, 2, 3)))
    assert hand.parents.tolist() == [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
    assert len(hand.parts) == 16
    assert hand.with_parts("fingers").parts == ("palm", *fingers)


def test_joints_lie_inside(hand):
    assert (hand_shape.surface()(hand.joints) < -0.004).all()


def test_it_is_a_right_hand(hand):
    fingers = _tip(hand, hand.vertices, "middle") - hand.joints[hand.root]
    thumb = _tip(hand, hand.vertices, "thumb") - _tip(hand, hand.vertices, "pinky")
    # The palm is the side that the fingertips go to when the fingers bend.
    bent = hand.pose(sum(_turned(hand, f"{f}1", 0, 60) for f in LONG))
    palm = _tip(hand, bent, "middle") - _tip(hand, hand.vertices, "middle")
    assert np.cross(fingers, palm) @ thumb > 0
    assert palm[2] > 0 and fingers[1] > 0 and thumb[0] > 0


def test_frames_are_right_handed_and_follow_the_bones(hand):
    assert np.abs(np.swapaxes(hand.frames, 1, 2) @ hand.frames - np.eye(3)).max() < 1e-12
    assert np.linalg.det(hand.frames) == pytest.approx(np.ones(16))
    for finger in (*LONG, "thumb"):
        for k in (1, 2):
            bone = hand.joints[_row(hand, f"{finger}{k + 1}")] - hand.joints[_row(hand, f"{finger}{k}")]
            assert hand.frames[_row(hand, f"{finger}{k}")][:, 2] == pytest.approx(bone / np.linalg.norm(bone), abs=1e-9)


@pytest.mark.parametrize("finger", LONG)
def test_positive_y_turns_towards_the_thumb(hand, finger):
    moved = _tip(hand, hand.pose(_turned(hand, f"{finger}1", 1, 10)), finger) - _tip(hand, hand.vertices, finger)
    assert moved[0] > 0.01 and abs(moved[2]) < 0.005


@pytest.mark.parametrize("name", [f"{f}{k}" for f in LONG for k in (1, 2, 3)])
def test_positive_x_bends_towards_the_palm(hand, name):
    moved = _tip(hand, hand.pose(_turned(hand, name, 0, 20)), name[:-1]) - _tip(hand, hand.vertices, name[:-1])
    assert moved[2] > 0.003


# ---- limits ----


def test_limits_hold_the_rest_pose(hand):
    assert (hand.lower <= 0).all() and (hand.upper >= 0).all()
    assert hand.moving.all()


def test_what_does_not_exist_is_locked(hand):
    for row, name in enumerate(hand.joint_names[1:], start=1):
        free = hand.upper[row] > hand.lower[row]
        expected = [True, name[-1] == "1", name == "thumb1"]
        assert free.tolist() == expected, name


# ---- weights ----


def test_weights(hand):
    sums = read_rig_data("hand").weights.sum(axis=1)  # as shipped: load_rig would put small errors right
    assert np.array_equal(sums, np.ones(len(hand.vertices)))
    assert np.diff(hand.weights.indptr).max() <= 8
    assert hand.weights.data.min() > 0
    assert np.array_equal(hand.pose(np.zeros((16, 3))), hand.vertices)


def test_weights_are_smooth(hand):
    w = hand.weights.toarray()
    jump = np.abs(w[hand.faces] - w[np.roll(hand.faces, 1, axis=1)]).max()
    assert jump < 0.75


@pytest.mark.parametrize(("joint", "least"), [("1", 0.5), ("2", 0.75), ("3", 0.7)])
def test_bends_keep_volume(hand, joint, least):
    for finger in LONG:
        kept = checks.bending_volume(hand, _row(hand, finger + joint), np.radians([30, 60, 90]))
        assert (np.diff(kept) < 0).all() and kept[0] > 0.85 and kept[-1] > least, finger


# ---- poses ----


def test_pose_library(hand, hand_file):
    names, theta = hand_file[1]["poses_names"], hand_file[1]["poses_theta"]
    assert len(names) >= 30 and len(set(names.tolist())) == len(names)
    wanted = {"flat", "fist", "point", "pinch", "ok", "thumbs-up", "peace", "one", "two", "three", "four", "five"}
    wanted |= {"grasp cylinder", "grasp ball", "crossed fingers", "relaxed", "tip of little", "horns", "shaka"}
    assert wanted <= set(names.tolist())
    assert (theta >= hand.lower - 1e-9).all() and (theta <= hand.upper + 1e-9).all()
    flat = theta.reshape(len(theta), -1)
    apart = np.abs(flat[:, None] - flat[None]).max(axis=2) + 10 * np.eye(len(flat))
    assert apart.min() > np.radians(2)  # no pose twice


@pytest.mark.parametrize(
    ("pose", "finger"),
    [
        ("pinch", "index"),
        ("ok", "index"),
        ("tip of middle", "middle"),
        ("tip of ring", "ring"),
        ("tip of little", "pinky"),
        ("tripod", "middle"),
    ],
)
def test_fingers_that_touch_do(hand, pose, finger):
    V = hand.pose(hand_poses.pose_angles(hand_poses.POSES[pose], list(hand.joint_names)))
    thumb, other = (V[hand.vertex_labels == hand.parts.index(name)] for name in ("thumb3", finger + "3"))
    assert np.linalg.norm(thumb[:, None] - other[None], axis=2).min() < 0.004


# ---- people ----


@pytest.mark.parametrize("name", ["hand", "hand-coarse"])
@pytest.mark.parametrize("parameter", list(hand_shape.PARAMETERS))
def test_shape_parameters_lead_to_the_skin_of_that_person(name, parameter):
    """The directions are differences; two deviations away the mesh still lies on what the anatomy says."""
    rig = load_rig(name)
    s, k = rig.shapes, list(hand_shape.PARAMETERS).index(parameter)
    assert s.names == tuple(hand_shape.PARAMETERS)
    for value in (s.default[k] - 2 * s.spread[k], s.default[k] + 2 * s.spread[k]):
        bones = hand_shape.skeleton(hand_shape.Person(**{parameter: value}))
        person = rig.subject(amount=0, **{parameter: value})
        assert np.abs(hand_shape.surface(bones)(person.vertices)).max() < 1e-3
        assert person.joints == pytest.approx(bones.joints, abs=2e-5)
        assert len(checks.self_intersections(person.vertices, person.faces)) == 0
        moved = np.linalg.norm(person.vertices - rig.vertices, axis=1)
        assert moved.max() > 0.0015


def test_default_person_is_the_bundled_hand():
    default = hand_shape.Person()
    for key, (lower, upper, value, spread, _) in hand_shape.PARAMETERS.items():
        assert getattr(default, key) == value and lower < value < upper and spread > 0


# ---- the coarse level ----


def test_coarse_level_has_all_but_the_vertices(hand):
    coarse = load_rig("hand-coarse")
    assert 450 < len(coarse.vertices) < 600
    for field in ("joints", "frames", "lower", "upper", "parents", "smpl_rest", "merged", "locked"):
        assert np.array_equal(getattr(coarse, field), getattr(hand, field)), field
    assert coarse.joint_names == hand.joint_names and coarse.partitions == hand.partitions
    assert list(coarse.poses) == list(hand.poses)
    assert all(np.array_equal(coarse.poses[name], hand.poses[name]) for name in hand.poses)
    assert coarse.parts == hand.parts and coarse.name == "hand-coarse"


def test_coarse_skin_is_well_made(hand):
    coarse = load_rig("hand-coarse")
    assert checks.edge_uses(coarse.faces) == (1, True)
    assert checks.euler_characteristic(coarse.faces) == 2
    assert checks.components(coarse.faces, len(coarse.vertices)) == 1
    assert len(checks.self_intersections(coarse.vertices, coarse.faces)) == 0
    assert np.abs(hand_shape.surface()(coarse.vertices)).max() < 2e-5
    p = coarse.vertices[coarse.faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    outward = implicit.gradient(hand_shape.surface(), p.mean(axis=1))
    assert (np.einsum("ij,ij->i", normal, outward) > 0).all()
    assert np.array_equal(read_rig_data("hand-coarse").weights.sum(axis=1), np.ones(len(coarse.vertices)))
    volumes = [checks.volume(r.vertices, r.faces) for r in (coarse, hand)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.06)  # inscribed


def test_coarse_skin_follows_the_fine_one(hand):
    """In every natural pose the coarse skin lies near the fine one."""
    from scipy.spatial import cKDTree

    coarse = load_rig("hand-coarse")
    for theta in list(hand.poses.values())[::6]:
        near = cKDTree(hand.pose(theta)).query(coarse.pose(theta))[0]
        assert near.mean() < 0.004 and near.max() < 0.012


# ---- names ----


def test_left_levels_are_images_of_the_right_ones():
    for left, right in (("hand-left", "hand"), ("hand-left-coarse", "hand-coarse")):
        assert np.array_equal(load_rig(left).vertices, load_rig(right).vertices * [-1, 1, 1])


def test_bundled_names():
    names = bundled_rigs()
    assert names == sorted(names) and {"hand", "hand-coarse", "hand-left", "hand-left-coarse"} <= set(names)
    assert all(about_bundled(name) for name in names)


@pytest.mark.parametrize("name", bundled_rigs())
def test_every_bundled_rig(name):
    rig = load_rig(name)
    assert rig.name == name and (rig.metres_per_unit, rig.up, rig.forward) == (1.0, "+y", "+z")
    assert len(rig.poses) >= 30 and rig.smpl_rest is not None and len(rig.shapes) >= 3
    for theta in rig.poses.values():
        assert (theta >= rig.lower - 1e-9).all() and (theta <= rig.upper + 1e-9).all()
    assert read_rig_data(name).path.stat().st_size < 1_000_000
    with np.load(read_rig_data(name).path, allow_pickle=False) as file:
        assert file["shapes_vertices"].dtype == np.int16


@pytest.mark.parametrize("wrong", ["hnad", "hand-right", "hand-left-fine"])
def test_unknown_names_list_the_known(wrong):
    with pytest.raises(FileError, match="bundled rig: .*hand, hand-coarse, hand-left, hand-left-coarse"):
        load_rig(wrong)


def test_a_file_of_the_name_wins(tmp_path, tube_rig, monkeypatch):
    tube_rig.save(tmp_path / "rig.npz")
    (tmp_path / "rig.npz").rename(tmp_path / "hand-left")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileError, match="hand-left: got a file without an ending"):
        load_rig("hand-left")


# ---- the file and its making ----


def test_file_is_small_and_plain(hand_file):
    path, arrays = hand_file
    assert path.stat().st_size < 1_000_000
    assert not any(a.dtype.hasobject for a in arrays.values())


def test_the_file_is_what_its_sources_say(hand, hand_file):
    bones = hand_shape.skeleton()
    assert bones.joints == pytest.approx(hand.joints, abs=1e-12)
    assert bones.frames == pytest.approx(hand.frames, abs=1e-12)
    names, theta = hand_poses.pose_library(hand.joint_names)
    assert names == tuple(hand_file[1]["poses_names"].tolist()) == tuple(hand.poses)
    assert theta == pytest.approx(hand_file[1]["poses_theta"], abs=1e-12)
    assert np.array_equal(hand.poses["fist"], hand_file[1]["poses_theta"][names.index("fist")])


@pytest.mark.parametrize("name", [pytest.param("hand", marks=pytest.mark.study), slow("hand-coarse")])
def test_rebuilding_gives_the_shipped_file(name, tmp_path):
    pytest.importorskip("skimage", reason="building rigs needs the extra 'build'")
    build_hand = rig_module("build_hand")
    path = read_rig_data(name).path
    built_with = str(read_npz(path)["built_with"])
    if built_with != rig_module("rig_file").library_versions():
        pytest.skip(f"the shipped file was built with {built_with}")
    made = tmp_path / f"{name}.npz"
    build_hand.build(name, tmp_path)
    assert_rebuilt(made, path)
    if name == "hand-coarse":  # and of one machine the same bytes each time, whatever it rounds
        before = made.read_bytes()
        made.unlink()
        build_hand.build(name, tmp_path)
        assert made.read_bytes() == before


# ---- the tools ----


def test_capsule_and_ellipsoid_distances():
    capsule = implicit.capsule([0, 0, 0], [1, 0, 0], (0.2, 0.2))
    assert capsule(np.array([[0.5, 0.5, 0], [-1, 0, 0], [0.3, 0, 0]])) == pytest.approx([0.3, 0.8, -0.2])
    ball = implicit.ellipsoid([0, 0, 0], np.eye(3), [0.01, 0.01, 0.01])
    assert ball(np.array([[0.012, 0, 0], [0, 0, 0], [0, 0.01, 0]])) == pytest.approx([0.002, -0.01, 0], abs=1e-12)


def test_loft_passes_through_its_stations():
    stations = [(0, 0.01, 0.012, 0.008, 0.009), (0.05, 0.006, 0.007, 0.005, 0.004)]
    loft = implicit.Loft([0, 0, 0], np.eye(3), stations, caps=(0.003, 0.004))
    on = [[0.01, 0, 0], [-0.012, 0, 0], [0, 0.008, 0], [0, -0.009, 0], [0.006, 0, 0.05], [0, -0.004, 0.05], [0, 0, -0.003]]
    assert loft(np.array(on)) == pytest.approx(np.zeros(7), abs=1e-12)
    assert (loft(0.9 * np.array(on)) < 0).all()


def test_smooth_union_fills_and_smooth_cut_removes():
    a, b = implicit.capsule([0, 0, 0], [1, 0, 0], (0.2, 0.2)), implicit.capsule([0, 0, 0], [0, 1, 0], (0.2, 0.2))
    points = np.random.default_rng(0).uniform(-0.5, 1.5, (500, 3))
    both = implicit.smooth_union([a, b], 0.1)(points)
    least = np.minimum(a(points), b(points))
    assert (both <= least).all() and (both >= least - 0.1 / 4 - 1e-12).all()
    assert np.array_equal(both[np.abs(a(points) - b(points)) > 0.1], least[np.abs(a(points) - b(points)) > 0.1])
    cut = implicit.smooth_cut(a, b, 0.1)(points)
    assert (cut >= np.maximum(a(points), -b(points)) - 1e-12).all()


def _octahedron(radius):
    corners = radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
    faces = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
    return corners, np.array(faces)


def test_remeshing_a_ball_is_uniform_closed_and_repeats():
    ball = implicit.capsule([0, 0, 0], [0, 0, 1e-9], (0.02, 0.02))

    def length(points):
        return np.full(len(points), 0.006)

    first = remesh.remesh(ball, *_octahedron(0.02), length)
    vertices, faces = first
    second = remesh.remesh(ball, *_octahedron(0.02), length)
    assert np.array_equal(vertices, second[0]) and np.array_equal(faces, second[1])
    assert checks.edge_uses(faces) == (1, True) and checks.euler_characteristic(faces) == 2
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(0.02, abs=1e-6)
    edges = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2)
    assert edges.min() > 0.004 and edges.max() < 0.0085
    assert checks.volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.05)


def test_heat_weights_of_two_bones_meet_half_way():
    ball = implicit.capsule([-0.03, 0, 0], [0.03, 0, 0], (0.01, 0.01))
    corners, faces = _octahedron(0.01)
    vertices, faces = remesh.remesh(ball, corners * [4, 1, 1], faces, lambda p: np.full(len(p), 0.004))
    bones = np.array([[[-0.03, 0, 0], [0, 0, 0]], [[0, 0, 0], [0.03, 0, 0]]], dtype=float)
    w = heat.heat_weights(vertices, faces, bones, np.array([0, 1]), 2).toarray()
    assert np.array_equal(w.sum(axis=1), np.ones(len(w)))
    middle = np.abs(vertices[:, 0]) < 0.001
    assert w[middle] == pytest.approx(0.5, abs=0.12)
    assert w[vertices[:, 0] < -0.03, 0].min() > 0.9 and w[vertices[:, 0] > 0.03, 1].min() > 0.9
    order = np.argsort(vertices[:, 0])
    assert np.corrcoef(np.arange(len(order)), w[order, 1])[0, 1] > 0.9


def test_exact_rows_keep_the_largest_and_sum_to_one():
    w = heat.exact_rows(np.random.default_rng(0).random((50, 12)), influences=8)
    assert np.array_equal(w.sum(axis=1), np.ones(50)) and np.diff(w.indptr).max() <= 8


def test_checks_find_faults():
    vertices, faces = _octahedron(1.0)
    assert checks.edge_uses(faces) == (1, True) and checks.edge_uses(faces[1:]) == (1, False)
    assert checks.edge_uses(np.concatenate([faces, faces[:1]]))[0] == 2
    assert checks.volume(vertices, faces) == pytest.approx(4 / 3)
    assert checks.volume(vertices, faces[:, ::-1]) == pytest.approx(-4 / 3)
    two = np.concatenate([vertices, vertices + [0.9, 0.05, 0.1]]), np.concatenate([faces, faces + 6])
    assert checks.components(two[1], 12) == 2 and checks.euler_characteristic(two[1]) == 4
    assert len(checks.self_intersections(vertices, faces)) == 0 and len(checks.self_intersections(*two)) > 0
    apart = np.concatenate([vertices, vertices + [3.0, 0, 0]])
    assert len(checks.self_intersections(apart, two[1])) == 0
