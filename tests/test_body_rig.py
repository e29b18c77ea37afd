"""The bundled body: a well-made symmetric skin, anatomical axes, measured proportions, weights, people that hold together."""

import numpy as np
import pytest
from rebuilt_rigs import rig_module

from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.rigs import load_rig, read_rig_data

checks, implicit = map(rig_module, ("checks", "implicit"))
body_shape, body_skeleton, body_poses, build_body = map(rig_module, ("body_shape", "body_skeleton", "body_poses", "build_body"))

LEVELS = ("body", "body-coarse")
S = np.diag([-1.0, 1.0, 1.0])
SMPL_JOINTS = """pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot
neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_hand
right_hand""".split()
SMPL_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]


@pytest.fixture(scope="module", params=LEVELS)
def rig(request):
    return load_rig(request.param)


@pytest.fixture(scope="module")
def body():
    return load_rig("body")


def _row(name):
    return SMPL_JOINTS.index(name)


def _turned(name, axis, degrees):
    theta = np.zeros((24, 3))
    theta[_row(name), axis] = np.radians(degrees)
    return theta


def _normals(vertices, faces):
    p = vertices[faces]
    return np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def _turned_over(vertices, rig):
    """How many triangles look the other way than those of the template."""
    return int((np.einsum("ij,ij->i", _normals(vertices, rig.faces), _normals(rig.vertices, rig.faces)) <= 0).sum())


def _girth(vertices, faces, height):
    """Circumference of the convex hull, breadth and depth of a horizontal cut, metres."""
    from scipy.spatial import ConvexHull

    a, b = vertices[faces], vertices[np.roll(faces, 1, axis=1)]
    over, under = a[..., 1] - height, b[..., 1] - height
    cut = over * under < 0
    t = (over[cut] / (over[cut] - under[cut]))[:, None]
    points = (a[cut] + t * (b[cut] - a[cut]))[:, [0, 2]]
    return ConvexHull(points).area, *np.ptp(points, axis=0)


# ---- the skin ----


def test_skin_is_one_closed_outward_manifold(rig):
    assert checks.edge_uses(rig.faces) == (1, True)
    assert checks.euler_characteristic(rig.faces) == 2
    assert checks.components(rig.faces, len(rig.vertices)) == 1
    assert checks.volume(rig.vertices, rig.faces) > 0
    low, high = {"body": (6500, 7500), "body-coarse": (1600, 2000)}[rig.name]
    assert low < len(rig.vertices) < high


def test_skin_does_not_cut_itself_at_rest(rig):
    assert len(checks.self_intersections(rig.vertices, rig.faces)) == 0


def test_vertices_lie_on_the_surface_they_were_built_from(rig):
    assert np.abs(body_shape.surface()(rig.vertices)).max() < 1e-4


def test_no_triangle_looks_inward(rig):
    normal = _normals(rig.vertices, rig.faces)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    outward = implicit.gradient(body_shape.surface(), rig.vertices)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    cosine = np.einsum("ij,ikj->ik", normal, outward[rig.faces])
    # Where a triangle spans a crease (between fingers, behind the ears) a corner may look elsewhere.
    assert cosine.max(axis=1).min() > 0 and np.quantile(cosine.mean(axis=1), 0.01) > 0.35


def test_triangles_are_near_uniform(rig):
    p = rig.vertices[rig.faces]
    edges = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2)
    area = np.linalg.norm(_normals(rig.vertices, rig.faces), axis=1) / 2
    shape = 4 * np.sqrt(3) * area / (edges**2).sum(axis=1)  # 1 for an equilateral triangle
    assert shape.min() > 0.4 and np.quantile(shape, 0.05) > 0.8


def test_front_and_back_differ(body):
    head = body.vertices[body.vertices[:, 1] > 1.52]
    nose = head[head[:, 2].argmax()]
    assert nose[0] == 0 and 1.55 < nose[1] < 1.60
    foot = body.vertices[body.vertices[:, 1] < 0.05]
    ankle = body.joints[_row("left_ankle"), 2]
    assert foot[:, 2].max() - ankle > 3 * (ankle - foot[:, 2].min())


# ---- symmetry ----


def test_skin_weights_and_people_are_symmetric(rig):
    twin, sides = build_body.mirror_of(rig.vertices), build_body.mirrored_joints()
    assert np.array_equal(rig.vertices[twin], rig.vertices * [-1, 1, 1])
    flipped = {frozenset(f) for f in twin[rig.faces].tolist()}
    assert flipped == {frozenset(f) for f in rig.faces.tolist()}
    w = rig.weights.toarray()
    assert np.array_equal(w[twin][:, sides], w)
    assert np.array_equal(rig.shapes.vertices[:, twin], rig.shapes.vertices * [-1, 1, 1])
    assert rig.shapes.joints[:, sides] == pytest.approx(rig.shapes.joints * [-1, 1, 1], abs=1e-12)


def test_skeleton_is_symmetric_and_the_same_angles_mirror(rig):
    sides = build_body.mirrored_joints()
    assert np.array_equal(rig.joints[sides], rig.joints * [-1, 1, 1])
    limbs = np.array(["_" in name for name in rig.joint_names])
    assert rig.frames[sides][limbs] == pytest.approx(-S @ rig.frames[limbs], abs=1e-15)
    assert np.array_equal(rig.frames[~limbs], np.tile(np.eye(3), (6, 1, 1)))
    assert np.array_equal(rig.lower[sides], rig.lower) and np.array_equal(rig.upper[sides], rig.upper)
    assert rig.smpl_rest[sides] == pytest.approx(S @ rig.smpl_rest @ S, abs=1e-15)
    theta = np.random.default_rng(0).uniform(rig.lower, rig.upper)
    mirrored = np.where(limbs[:, None], theta[sides], theta * [1, -1, -1])
    assert rig.pose(mirrored) == pytest.approx((rig.pose(theta) @ S)[build_body.mirror_of(rig.vertices)], abs=1e-9)


# ---- skeleton and axes ----


def test_joints_are_smpls(rig):
    assert list(rig.joint_names) == SMPL_JOINTS and rig.parents.tolist() == SMPL_PARENTS
    assert len(rig.parts) == 24
    limbs = rig.with_parts("limbs").parts
    assert len(limbs) == 10 and {"torso", "head", "left thigh", "right forearm"} <= set(limbs)


def test_joints_lie_inside(rig):
    assert (body_shape.surface()(rig.joints) < -0.008).all()


def test_frames_are_right_handed_and_follow_the_bones(rig):
    assert np.linalg.det(rig.frames) == pytest.approx(np.ones(24))
    for parent, child in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand")):
        bone = rig.joints[_row(f"right_{child}")] - rig.joints[_row(f"right_{parent}")]
        assert rig.frames[_row(f"right_{parent}")][:, 2] == pytest.approx(bone / np.linalg.norm(bone), abs=1e-9)


OUT, UP, FORWARD = np.eye(3)  # the left side is +x, so out of the body is +x for left limbs


@pytest.mark.parametrize(
    ("joint", "axis", "moved", "where"),
    [
        ("hip", 0, "ankle", FORWARD), ("hip", 1, "ankle", OUT), ("hip", 2, "foot", OUT),
        ("knee", 0, "ankle", -FORWARD), ("ankle", 0, "foot", UP),
        ("collar", 0, "shoulder", FORWARD), ("collar", 1, "shoulder", UP),
        ("shoulder", 0, "wrist", FORWARD), ("shoulder", 1, "wrist", UP), ("elbow", 0, "wrist", FORWARD),
        ("wrist", 0, "hand", -OUT), ("wrist", 1, "hand", FORWARD),
    ],
)  # fmt: skip
@pytest.mark.parametrize("side", ["left", "right"])
def test_positive_angles_are_anatomical(body, side, joint, axis, moved, where):
    at = body.pose_joints(_turned(f"{side}_{joint}", axis, 10))[_row(f"{side}_{moved}")] - body.joints[_row(f"{side}_{moved}")]
    step = at @ (where * ([-1, 1, 1] if side == "right" else [1, 1, 1]))
    assert step > 0.6 * np.linalg.norm(at) and step > 0.005


@pytest.mark.parametrize("joint", ["spine1", "spine2", "spine3", "neck", "head"])
def test_the_trunk_turns_about_the_rigs_axes(body, joint):
    crown = body.vertices[:, 1].argmax()
    nose = np.argmax(body.vertices[:, 2] * (body.vertices[:, 1] > 1.52))
    assert body.pose(_turned(joint, 0, 10))[crown, 2] > body.vertices[crown, 2] + 0.01  # forward
    assert body.pose(_turned(joint, 1, 10))[nose, 0] > 0.01  # to the figure's left
    assert body.pose(_turned(joint, 2, 10))[crown, 0] < -0.01  # to its right


def test_supination_turns_the_thumb_outwards(body):
    posed = body.pose(_turned("left_elbow", 2, 40))
    wrist = body.joints[_row("left_wrist")]
    hand = body.weights[:, [_row("left_wrist")]].toarray().ravel() > 0.8
    thumb = np.flatnonzero(hand)[np.argmax((body.vertices - wrist)[hand] @ FORWARD)]
    assert (posed - body.vertices)[thumb] @ np.array([0.7, 0.7, 0]) > 0.01


def test_smpls_rest_is_the_t_pose(body):
    joints = body.pose_joints(body.from_smpl_pose(np.zeros((24, 3))))
    at = dict(zip(SMPL_JOINTS, joints))
    reach = at["left_wrist"] - at["left_shoulder"]
    assert reach[0] > 0.99 * np.linalg.norm(reach)
    assert abs(at["left_ankle"][0] - at["left_hip"][0]) < 0.05
    posed = body.pose(body.from_smpl_pose(np.zeros((24, 3))))
    hand = body.weights[:, [_row("left_hand")]].toarray().ravel() > 0.5
    # The fingers are a little bent: their tips are on the palm's side, which looks down.
    tips = np.flatnonzero(hand)[np.argsort(-posed[hand, 0])[:10]]
    assert posed[tips, 1].mean() < at["left_hand"][1] - 0.01


# ---- limits ----


def test_limits_hold_the_rest_pose(rig):
    assert np.isfinite(rig.lower).all() and np.isfinite(rig.upper).all()
    assert (rig.lower <= 0).all() and (rig.upper >= 0).all() and np.abs([rig.lower, rig.upper]).max() < np.pi
    assert rig.moving.all()


def test_what_does_not_exist_is_locked(rig):
    axes = {"knee": "x", "hand": "x", "foot": "x", "elbow": "xz", "ankle": "xz", "wrist": "xy", "collar": "xy"}
    for row, name in enumerate(rig.joint_names):
        free = "".join(letter for k, letter in enumerate("xyz") if rig.upper[row, k] > rig.lower[row, k])
        assert free == axes.get(name.rpartition("_")[2], "xyz"), name


# ---- weights ----


def test_weights(rig):
    sums = read_rig_data(rig.name).weights.sum(axis=1)  # as shipped: load_rig would put small errors right
    assert np.array_equal(sums, np.ones(len(rig.vertices)))
    assert np.diff(rig.weights.indptr).max() <= 8
    assert rig.weights.data.min() > 0
    assert np.array_equal(rig.pose(np.zeros((24, 3))), rig.vertices)


def test_limbs_lead_no_skin_of_other_limbs(rig):
    w = rig.weights.toarray()
    x, y = rig.vertices[:, 0], rig.vertices[:, 1]
    right = [k for k, name in enumerate(SMPL_JOINTS) if name.startswith("right")]
    assert w[x > 0.045][:, right].max() == 0
    legs = [_row(f"left_{n}") for n in ("knee", "ankle", "foot")]
    arms = [_row(f"left_{n}") for n in ("elbow", "wrist", "hand")]
    assert w[y > 0.80][:, legs].max() == 0 and w[x < 0.22][:, arms].max() == 0
    assert w[y > 1.10][:, _row("left_hip")].max() < 0.01
    assert w[(np.abs(x) < 0.16) & (y < 1.2)][:, _row("left_shoulder")].max() < 0.08


def test_weights_are_smooth(body):
    w = body.weights.toarray()
    assert np.abs(w[body.faces] - w[np.roll(body.faces, 1, axis=1)]).max() < 0.75


@pytest.mark.parametrize(("joint", "least"), [("elbow", 0.8), ("knee", 0.75), ("hip", 0.75), ("wrist", 0.75)])
def test_bends_keep_volume(body, joint, least):
    row = _row(f"left_{joint}")
    kept = checks.bending_volume(body, row, np.minimum(np.radians([30, 60, 90]), body.upper[row, 0]))
    assert (np.diff(kept) < 0).all() and kept[0] > 0.9 and kept[-1] > least


# ---- proportions ----


def test_size_and_frame(rig):
    assert rig.vertices[:, 1].min() == pytest.approx(0, abs=0.002)
    assert rig.vertices[:, 1].max() == pytest.approx(1.72, abs=0.003)
    assert rig.joints[rig.root, 0] == 0


@pytest.mark.parametrize(
    ("start", "end", "share"),
    [("hip", "knee", 0.245), ("knee", "ankle", 0.246), ("shoulder", "elbow", 0.172), ("elbow", "wrist", 0.148)],
)
def test_segments_have_their_published_lengths(body, start, end, share):
    length = np.linalg.norm(body.joints[_row(f"left_{end}")] - body.joints[_row(f"left_{start}")])
    assert length == pytest.approx(share * 1.72, abs=1e-6)


@pytest.mark.parametrize(
    ("height", "girth", "breadth", "depth"), [(0.87, 0.99, 0.35, 0.23), (1.036, 0.79, 0.295, 0.197), (1.247, 0.92, 0.31, 0.225)]
)
def test_trunk_has_the_girths_that_the_readme_says(body, height, girth, breadth, depth):
    arm = [k for k, name in enumerate(SMPL_JOINTS) if name.rpartition("_")[2] in ("shoulder", "elbow", "wrist", "hand")]
    trunk = body.faces[~np.isin(body.vertex_labels[body.faces], arm).any(axis=1)]
    assert _girth(body.vertices, trunk, height) == pytest.approx((girth, breadth, depth), abs=0.01)


# ---- people ----

FIELDS = {"weight": "fat"}


@pytest.mark.parametrize("parameter", list(build_body.PARAMETERS))
@pytest.mark.parametrize("end", ["lower", "upper"])
def test_shape_parameters_keep_triangles_upright(rig, parameter, end):
    s = rig.shapes
    assert s.names == tuple(build_body.PARAMETERS)
    value = getattr(s, end)[s.names.index(parameter)]
    V = rig.vertices + s.offsets(s.values({parameter: value}))
    assert _turned_over(V, rig) == 0
    assert len(checks.self_intersections(V, rig.faces)) == 0
    assert np.abs(V - rig.vertices).max() > 0.005


@pytest.mark.parametrize("parameter", ["figure", "muscle", "legs", "shoulders"])
def test_shape_parameters_lead_to_the_skin_of_that_person(rig, parameter):
    """Directions are differences: two deviations away the mesh still lies near what the anatomy says."""
    s = rig.shapes
    value = 2 * s.spread[s.names.index(parameter)]
    figure = body_skeleton.Figure(**{parameter: value})
    values = s.values({parameter: value})
    off = np.abs(body_shape.surface(figure)(rig.vertices + s.offsets(values)))
    assert off.max() < 0.011 and off.mean() < 0.0005
    assert rig.joints + s.moved_joints(values) == pytest.approx(body_skeleton.skeleton(figure).joints, abs=1e-6)


def test_height_and_weight_are_what_they_say(body):
    s = body.shapes

    def person(**values):
        return body.vertices + s.offsets(s.values(values))

    tall = person(height=1.90)
    assert np.ptp(tall[:, 1]) / np.ptp(body.vertices[:, 1]) == pytest.approx(1.90 / 1.72, abs=1e-5)
    kilograms = [985 * checks.volume(person(weight=w), body.faces) for w in (58.0, 72.0)]
    assert kilograms == pytest.approx([58.0, 72.0], abs=0.6)
    assert s.default[s.names.index("weight")] == pytest.approx(985 * checks.volume(body.vertices, body.faces), abs=0.06)


def test_people_drawn_at_random_hold_together(body):
    s, rng = body.shapes, np.random.default_rng(3)
    for _ in range(60):
        values = np.clip(s.default + s.spread * rng.standard_normal(len(s)), s.lower, s.upper)
        assert _turned_over(body.vertices + s.offsets(values), body) == 0


# ---- the levels and the files ----


def test_coarse_level_has_all_but_the_vertices(body):
    coarse = load_rig("body-coarse")
    for field in ("joints", "frames", "lower", "upper", "parents", "smpl_rest", "merged", "locked"):
        assert np.array_equal(getattr(coarse, field), getattr(body, field)), field
    assert coarse.joint_names == body.joint_names and coarse.partitions == body.partitions and coarse.parts == body.parts
    assert list(coarse.poses) == list(body.poses)
    volumes = [checks.volume(r.vertices, r.faces) for r in (coarse, body)]
    assert volumes[0] == pytest.approx(volumes[1], rel=0.06)  # inscribed


def test_coarse_hands_keep_five_digits():
    """A plane across the fingers cuts four separate rings, and the thumb is apart from them."""
    coarse = load_rig("body-coarse")
    wrist, frame = coarse.joints[_row("right_wrist")], coarse.frames[_row("right_wrist")]
    local = (coarse.vertices - wrist) @ frame
    near = np.linalg.norm(coarse.vertices - wrist, axis=1) < 0.25
    crossed = near[coarse.faces].all(axis=1) & ((local[coarse.faces][..., 2] > 0.125).sum(axis=1) % 3 > 0)
    rings = coarse.faces[crossed]
    used, compact = np.unique(rings, return_inverse=True)
    assert checks.components(compact.reshape(rings.shape), len(used)) == 4
    thumb = near & (local[:, 2] > 0.07) & (local[:, 0] > 0.048)
    assert thumb.any()


def test_files_are_small_and_plain():
    for name in LEVELS:
        path = read_rig_data(name).path
        assert path.stat().st_size < 1_000_000
        assert not any(a.dtype.hasobject for a in read_npz(path).values())


def test_the_file_is_what_its_sources_say(rig):
    bones = body_skeleton.skeleton()
    assert bones.joints == pytest.approx(rig.joints, abs=1e-12)
    assert bones.frames == pytest.approx(rig.frames, abs=1e-12)
    assert body_skeleton.smpl_rest() == pytest.approx(rig.smpl_rest, abs=1e-12)
    assert np.array(body_skeleton.limits()) == pytest.approx(np.array([rig.lower, rig.upper]), abs=1e-12)
    names, theta = body_poses.pose_library(rig.joint_names)
    assert names == tuple(rig.poses)
    assert np.stack(list(rig.poses.values())) == pytest.approx(theta, abs=1e-12)
