"""The glTF importer: containers and accessors, rest pose and frame, animations, and what it says about bad files."""

import base64
import json
import struct
from itertools import pairwise

import numpy as np
import pytest
from gltf_files import GltfWriter, affine, make_arm, trs, write_arm
from scipy import sparse
from scipy.spatial.transform import Rotation

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.io.gltf_buffers import open_gltf
from lbsfit_np.io.gltf_nodes import NodeGraph
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.regressor import regressor_from_weights
from lbsfit_np.rig.rig import Rig
from lbsfit_np.skinning import skin as pose_rig

ARM = make_arm()
TILTED = affine((-np.pi / 2, 0, 0), 0.01, (0.2, 0.1, -0.3))  # a z-up skeleton in centimetres
# Root and all, turned this way and that: the last joints by more than 100°.
POSED = np.array([[0.3, -0.5, 0.4], [1.2, 0.4, -0.8], [0.9, -1.9, 0.5], [0.2, 0.1, 2.1], [-0.7, 0.3, 0.2]])


def truth(world_T_arm):
    """Vertices, joints and frames of the arm in the scene."""
    matrices = world_T_arm @ ARM.matrices
    linear = matrices[:, :3, :3]
    frames = linear / np.cbrt(np.linalg.det(linear))[:, None, None]
    return ARM.vertices @ world_T_arm[:3, :3].T + world_T_arm[:3, 3], matrices[:, :3, 3], frames


def check_arm(data, world_T_arm, rows=None, atol=2e-6):
    vertices, joints, frames = truth(world_T_arm)
    size = np.ptp(vertices, axis=0).max()
    rows = np.arange(5) if rows is None else rows
    assert np.allclose(data.vertices, vertices, atol=atol * size)
    assert np.allclose(data.joints[rows], joints, atol=atol * size)
    assert np.allclose(data.frames[rows], frames, atol=1e-5)
    assert np.allclose(np.linalg.det(data.frames), 1.0)
    assert np.allclose(data.weights.toarray()[:, rows], ARM.weights, atol=1e-6)


def volume(data):
    a, b, c = np.moveaxis(data.vertices[data.faces], 1, 0)
    return np.einsum("ia,ia->", a, np.cross(b, c)) / 6


def save(writer, tmp_path, name="arm.glb", **options):
    return writer.save(tmp_path / name, **options)


# ---- containers ----


@pytest.mark.parametrize(
    "name, options",
    [
        ("arm.glb", {}),
        ("arm.gltf", {}),
        ("arm.gltf", {"uri": "data:"}),
        ("arm.gltf", {"uri": "buffers/my%20arm%C3%A9.bin", "stored_as": "buffers/my armé.bin"}),
        ("arm.gltf", {"uri": "my arm.bin"}),
        ("arm.gltf", {"uri": "100%25.bin", "stored_as": "100%.bin"}),
    ],
)
def test_containers(tmp_path, name, options):
    data = read_gltf(save(write_arm(ARM), tmp_path, name, **options))
    check_arm(data, np.eye(4))
    assert np.array_equal(data.faces, ARM.faces)
    assert data.name == "arm" and data.path == tmp_path / name
    assert data.joint_names == list(ARM.names) and np.array_equal(data.parents, ARM.parents)
    assert (data.up, data.forward, data.metres_per_unit) == ("+y", "+z", 1.0)
    assert data.notes == [] and data.animated is None


def test_data_uri_without_base64_and_extra_chunks(tmp_path):
    writer = write_arm(ARM)
    path = save(writer, tmp_path, "a.gltf", uri="data:")
    root = json.loads(path.read_text())
    root["buffers"][0]["uri"] = "data:application/gltf-buffer," + "".join(f"%{b:02x}" for b in writer.binary)
    path.write_text(json.dumps(root))
    check_arm(read_gltf(str(path)), np.eye(4))
    glb = tmp_path / "x.glb"
    glb.write_bytes(writer.glb(extra_chunk=True) + b"trailing")
    check_arm(read_gltf(glb), np.eye(4))
    end = 20 + struct.unpack("<I", writer.glb()[12:16])[0]
    content = writer.glb()
    spaces = len(content[20:end]) - len(content[20:end].rstrip(b" "))
    assert spaces  # some writers pad the JSON with zeros
    glb.write_bytes(content[: end - spaces] + bytes(spaces) + content[end:])
    check_arm(read_gltf(glb), np.eye(4))


def test_images_in_missing_files_do_not_matter(tmp_path):
    writer = write_arm(ARM)
    path = save(writer, tmp_path, "a.gltf", uri="data:")
    root = json.loads(path.read_text())
    root["buffers"].append({"byteLength": 10, "uri": "gone.bin"})
    root["images"] = [{"uri": "gone.png"}]
    path.write_text(json.dumps(root))
    check_arm(read_gltf(path), np.eye(4))


# ---- accessors ----


def accessor_of(writer, tmp_path, index, kinds):
    return open_gltf(save(writer, tmp_path)).accessor(index, "the test", kinds)


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "u4", "f4"])
@pytest.mark.parametrize("gap", [0, 4])
def test_component_types_and_strides(tmp_path, dtype, gap):
    values = np.array([[1, 2, 3], [100, 0, 7], [5, 127, 9]])
    writer = GltfWriter()
    writer.accessor(np.zeros(3), "u1")  # so that the view does not start at 0
    got = accessor_of(writer, tmp_path, writer.accessor(values, dtype, gap=gap), ("VEC3",))
    assert np.array_equal(got, values)
    assert got.dtype == (float if dtype == "f4" else np.int64)


@pytest.mark.parametrize(
    "dtype, stored, expected",
    [
        ("i1", [-128, -127, 0, 127], [-1.0, -1.0, 0.0, 1.0]),
        ("u1", [0, 51, 255, 1], [0.0, 0.2, 1.0, 1 / 255]),
        ("i2", [-32768, -32767, 0, 32767], [-1.0, -1.0, 0.0, 1.0]),
        ("u2", [0, 13107, 65535, 1], [0.0, 0.2, 1.0, 1 / 65535]),
    ],
)
def test_normalized_integers(tmp_path, dtype, stored, expected):
    writer = GltfWriter()
    got = accessor_of(writer, tmp_path, writer.accessor(np.array([stored]), dtype, normalized=True), ("VEC4",))
    assert np.allclose(got, [expected], rtol=0, atol=1e-15)


@pytest.mark.parametrize("dtype, n", [("u1", 2), ("u1", 3), ("u2", 3), ("f4", 4), ("f4", 3)])
def test_matrices_and_column_padding(tmp_path, dtype, n):
    values = np.arange(3 * n * n).reshape(3, n, n) + 1
    writer = GltfWriter()
    index = writer.accessor(values, dtype)
    pad = -(n * np.dtype(dtype).itemsize) % 4
    view = writer.json["bufferViews"][index]
    view["byteLength"] -= pad  # the last padding may be missing
    assert np.array_equal(accessor_of(writer, tmp_path, index, (f"MAT{n}",)), values)


@pytest.mark.parametrize("with_base", [True, False])
def test_sparse_accessors(tmp_path, with_base):
    base = np.arange(15.0).reshape(5, 3) if with_base else np.zeros((5, 3))
    writer = GltfWriter()
    index = writer.accessor(base)
    if not with_base:
        writer.json["accessors"][index].pop("bufferView")
    rows, values = np.array([1, 4], dtype="<u2"), np.array([[9.0, 8, 7], [6, 5, 4]], dtype="<f4")
    sparse_part = {
        "count": 2,
        "indices": {"bufferView": writer.view(rows.tobytes()), "componentType": 5123},
        "values": {"bufferView": writer.view(b"skip" + values.tobytes()), "byteOffset": 4},
    }
    writer.json["accessors"][index]["sparse"] = sparse_part
    base[rows] = values
    assert np.array_equal(accessor_of(writer, tmp_path, index, ("VEC3",)), base)


def test_an_accessor_without_data_is_zeros_and_whole_floats_are_integers(tmp_path):
    writer = GltfWriter()
    writer.add("accessors", componentType=5126.0, count=4.0, type="VEC3")
    assert np.array_equal(accessor_of(writer, tmp_path, 0, ("VEC3",)), np.zeros((4, 3)))


# ---- meshes ----


def flat_skin(primitives, vertices, tmp_path, weights=None):
    """A rig of two joints at rest at the origin, with the given primitives over shared vertices."""
    writer = GltfWriter()
    m = len(vertices)
    attributes = {
        "POSITION": writer.accessor(vertices),
        "JOINTS_0": writer.accessor(np.zeros((m, 4)), "u1"),
        "WEIGHTS_0": writer.accessor(np.tile([1.0, 0, 0, 0], (m, 1))),
    }
    for p in primitives:
        p["attributes"] = {**attributes, **p.pop("more", {})}
        if "indices" in p:
            p["indices"] = writer.accessor(np.array(p["indices"]), p.pop("dtype", "u2"))
    writer.add("meshes", primitives=primitives)
    writer.add("nodes", name="a", children=[1])
    writer.add("nodes", name="b")
    writer.add("nodes", name="shown", mesh=0, skin=0)
    writer.add("skins", joints=[0, 1])
    return writer


POINTS = np.random.default_rng(0).normal(size=(7, 3)).astype("f4").astype(float)


@pytest.mark.parametrize(
    "primitive, faces",
    [
        ({"mode": 4, "indices": [0, 1, 2, 4, 3, 2], "dtype": "u1"}, [[0, 1, 2], [4, 3, 2]]),
        ({"indices": [0, 1, 2, 4, 3, 2], "dtype": "u4"}, [[0, 1, 2], [4, 3, 2]]),
        ({}, [[0, 1, 2], [3, 4, 5]]),
        ({"mode": 5, "indices": [6, 5, 4, 3, 2]}, [[6, 5, 4], [5, 3, 4], [4, 3, 2]]),
        ({"mode": 5, "indices": [0, 1, 2, 2, 3, 3, 4, 5]}, [[0, 1, 2], [3, 5, 4]]),
        ({"mode": 5}, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6]]),
        ({"mode": 6, "indices": [3, 0, 1, 2]}, [[0, 1, 3], [1, 2, 3]]),
        ({"mode": 6}, [[1, 2, 0], [2, 3, 0], [3, 4, 0], [4, 5, 0], [5, 6, 0]]),
    ],
)
def test_modes(tmp_path, primitive, faces):
    data = read_gltf(save(flat_skin([primitive], POINTS, tmp_path), tmp_path))
    assert len(data.faces) == len(faces)
    assert {tuple(np.roll(f, -np.argmin(f))) for f in data.faces} == {tuple(np.roll(f, -np.argmin(f))) for f in faces}
    assert np.array_equal(data.vertices, POINTS)


def test_strips_keep_the_winding(tmp_path):
    """Every triangle of a flat strip faces the same way."""
    zigzag = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]])
    data = read_gltf(save(flat_skin([{"mode": 5}], zigzag, tmp_path), tmp_path))
    a, b, c = np.moveaxis(data.vertices[data.faces], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_lines_morphs_odd_and_degenerate_triangles_are_noted(tmp_path):
    primitives = [
        {"mode": 1, "indices": [0, 1]},
        {"indices": [0, 1, 2, 3, 3, 4, 5], "targets": [{"POSITION": 0}]},
    ]
    data = read_gltf(save(flat_skin(primitives, POINTS, tmp_path), tmp_path))
    assert np.array_equal(data.faces, [[0, 1, 2]])
    notes = "; ".join(data.notes)
    for words in ("holds lines", "morph targets", "not a multiple of 3", "use a vertex twice", "4 vertices belong to no face"):
        assert words in notes


def test_primitives_that_share_vertices_keep_one_copy(tmp_path):
    data = read_gltf(save(flat_skin([{"indices": [0, 1, 2]}, {"indices": [3, 4, 5, 4, 5, 6]}], POINTS, tmp_path), tmp_path))
    assert len(data.vertices) == 7
    assert np.array_equal(data.faces, [[0, 1, 2], [3, 4, 5], [4, 5, 6]])


def test_several_primitives_and_meshes_on_one_skin_and_props(tmp_path):
    writer = write_arm(ARM, armature=TILTED)
    first = writer.json["meshes"][0]["primitives"][0]
    lifted = writer.accessor(ARM.vertices + [0, 0, 0.5])
    second = {"attributes": {**first["attributes"], "POSITION": lifted}, "indices": first["indices"]}
    writer.json["meshes"][0]["primitives"].append(second)
    third = {
        "attributes": {**first["attributes"], "POSITION": writer.accessor(ARM.vertices - [0, 0, 0.5])},
        "indices": first["indices"],
    }
    writer.add("meshes", primitives=[third])
    shifted = affine((1, 2, 3), 7.0, (5, 5, 5))  # a skinned mesh's own node has no say
    other = writer.add("nodes", name="Other", mesh=1, skin=0, **trs(shifted))
    again = writer.add("nodes", name="Twice", mesh=1, skin=0)
    sword = writer.add("nodes", name="Sword", mesh=1)
    writer.json["nodes"][2]["children"] = [*writer.json["nodes"][2].get("children", []), sword]
    writer.json["scenes"][0]["nodes"] += [other, again]
    data = read_gltf(save(writer, tmp_path))
    m = len(ARM.vertices)
    stacked = np.concatenate([ARM.vertices, ARM.vertices + [0, 0, 0.5], ARM.vertices - [0, 0, 0.5]])
    assert np.allclose(data.vertices, stacked @ TILTED[:3, :3].T + TILTED[:3, 3], atol=1e-7)
    assert np.array_equal(data.faces, np.concatenate([ARM.faces, ARM.faces + m, ARM.faces + 2 * m]))
    assert np.allclose(data.weights.toarray(), np.tile(ARM.weights, (3, 1)), atol=1e-6)
    notes = "; ".join(data.notes)
    assert "'Sword'" in notes and "'Twice'" in notes


def test_meshes_outside_the_scene_are_left_out(tmp_path):
    writer = write_arm(ARM)
    writer.add("meshes", primitives=[dict(writer.json["meshes"][0]["primitives"][0])])
    writer.add("nodes", name="Hidden", mesh=1, skin=0)
    data = read_gltf(save(writer, tmp_path))
    assert len(data.vertices) == len(ARM.vertices)
    assert "'Hidden'" in "; ".join(data.notes)


@pytest.mark.parametrize("dtype, tolerance", [("f4", 1e-7), ("u1", 0.5 / 255), ("u2", 0.5 / 65535)])
@pytest.mark.parametrize("joints_dtype", ["u1", "u2"])
@pytest.mark.parametrize("marked", [True, False])
def test_weight_types(tmp_path, dtype, tolerance, joints_dtype, marked):
    writer = write_arm(ARM, joints_dtype=joints_dtype)
    attributes = writer.json["meshes"][0]["primitives"][0]["attributes"]
    values, columns = np.sort(ARM.weights, axis=1)[:, :-5:-1], np.argsort(ARM.weights, axis=1)[:, :-5:-1]
    stored = values if dtype == "f4" else np.round(values * np.iinfo(dtype).max)
    attributes["JOINTS_0"] = writer.accessor(columns, joints_dtype)
    attributes["WEIGHTS_0"] = writer.accessor(stored, dtype, **({"normalized": True} if marked and dtype != "f4" else {}))
    attributes.pop("JOINTS_1", None), attributes.pop("WEIGHTS_1", None)
    data = read_gltf(save(writer, tmp_path))
    assert np.allclose(data.weights.toarray(), ARM.weights, rtol=0, atol=1.01 * tolerance)
    assert any("not marked as normalized" in n for n in data.notes) == (not marked and dtype != "f4")


def test_many_influences_and_repeated_joints(tmp_path):
    rng = np.random.default_rng(1)
    weights = rng.dirichlet(np.ones(5), size=7)
    writer = flat_skin([{}], POINTS, tmp_path)
    for _ in range(3):
        writer.json["skins"][0]["joints"].append(writer.add("nodes"))
    attributes = writer.json["meshes"][0]["primitives"][0]["attributes"]
    columns = np.array([[0, 1, 1, 2], [3, 4, 2, 250]])  # joint 1 and 2 twice; 250 at weight 0 is nobody's fault
    halves = weights[:, [0, 1, 1, 2, 3, 4, 2]] * [1, 0.25, 0.75, 0.5, 1, 1, 0.5]
    for n in range(2):
        attributes[f"JOINTS_{n}"] = writer.accessor(np.tile(columns[n], (7, 1)), "u1")
        attributes[f"WEIGHTS_{n}"] = writer.accessor(np.column_stack([halves, np.zeros(7)])[:, 4 * n : 4 * n + 4])
    data = read_gltf(save(writer, tmp_path))
    assert isinstance(data.weights, sparse.csr_array) and data.weights.has_canonical_format
    assert np.allclose(data.weights.toarray(), weights, atol=1e-7)


# ---- joints ----


def test_children_before_parents(tmp_path):
    data = read_gltf(save(write_arm(ARM, order=[3, 4, 2, 0, 1]), tmp_path))
    assert data.joint_names == list(ARM.names) and np.array_equal(data.parents, ARM.parents)
    assert data.notes == []  # the nodes stand in the bind pose
    check_arm(data, np.eye(4))


def test_the_skins_own_order_is_kept(tmp_path):
    writer = write_arm(ARM)
    order = np.array([3, 1, 4, 0, 2])
    writer.json["skins"][0]["joints"] = order.tolist()
    writer.json["skins"][0]["inverseBindMatrices"] = writer.accessor(np.linalg.inv(ARM.matrices[order]))
    data = read_gltf(save(writer, tmp_path))
    assert data.joint_names == [ARM.names[j] for j in order]
    assert np.array_equal(data.parents, [4, 3, 1, -1, 1])
    assert np.allclose(data.joints, ARM.matrices[order, :3, 3], atol=1e-6)


def test_nodes_between_joints_and_several_roots(tmp_path):
    writer = write_arm(ARM)
    nodes = writer.json["nodes"]
    inserted = writer.add("nodes", name="helper", children=[2])  # between upper and lower
    nodes[1]["children"] = [inserted, 4]
    nodes[0].pop("children")
    top = next(n for n in nodes if n.get("name") == "Armature")
    top["children"].append(1)  # upper hangs on the armature: a second root
    nodes[1].update(trs(ARM.matrices[1]))
    data = read_gltf(save(writer, tmp_path))
    assert np.array_equal(data.parents, [-1, -1, 1, 2, 1])
    check_arm(data, np.eye(4))


def test_joint_names_are_made_unique(tmp_path):
    writer = write_arm(ARM)
    nodes = writer.json["nodes"]
    nodes[1]["name"] = nodes[2]["name"] = "bone"
    nodes[3]["name"] = "bone#2"
    nodes[4].pop("name")
    nodes[0]["name"] = "node4"
    data = read_gltf(save(writer, tmp_path))
    assert data.joint_names == ["node4", "bone", "bone#3", "bone#2", "node4#2"]
    assert "without a name" in data.notes[0] and "bone#3" in data.notes[1]


# ---- several skins ----


def two_skins(tmp_path, both_used=True, names=("arm", "other")):
    writer = write_arm(ARM)
    skin = dict(writer.json["skins"][0])
    writer.json["skins"] = [{**skin, "name": names[0]}, {**skin, "joints": skin["joints"][::-1], "name": names[1]}]
    matrices = np.linalg.inv(ARM.matrices)[::-1]
    writer.json["skins"][1]["inverseBindMatrices"] = writer.accessor(matrices)
    if both_used:
        extra = writer.add("nodes", name="Second", mesh=0, skin=1)
        writer.json["scenes"][0]["nodes"].append(extra)
    return save(writer, tmp_path)


def test_skin_by_name_or_index(tmp_path):
    path = two_skins(tmp_path)
    for choice, first in (("arm", "root"), (0, "root"), ("0", "root"), ("other", "side"), (1, "side"), (np.int64(1), "side")):
        assert read_gltf(path, skin=choice).joint_names[0] == first
    assert "several skins" in read_gltf(path, skin=0).notes[0]


def test_the_one_skin_in_use_needs_no_choice(tmp_path):
    assert read_gltf(two_skins(tmp_path, both_used=False)).joint_names[0] == "root"


@pytest.mark.parametrize(
    "choice, names, words",
    [
        (None, ("arm", "other"), ["skin", "no choice", "0 ('arm'), 1 ('other')"]),
        ("leg", ("arm", "other"), ["skin", "'leg'", "'arm'", "'other'"]),
        (2, ("arm", "other"), ["skin", "2", "'arm'"]),
        (True, ("arm", "other"), ["skin", "True"]),
        ("arm", ("arm", "arm"), ["the name of 2 skins", "index"]),
    ],
)
def test_bad_choice_of_skin(tmp_path, choice, names, words):
    with pytest.raises(InputError) as error:
        read_gltf(two_skins(tmp_path, names=names), skin=choice)
    assert error.value.argument == "skin"
    assert all(w in str(error.value) for w in words)


def test_a_skin_that_no_mesh_uses_cannot_be_chosen(tmp_path):
    with pytest.raises(InputError, match="No mesh uses 'other'"):
        read_gltf(two_skins(tmp_path, both_used=False), skin="other")


# ---- rest pose and the rig's frame ----

Z_UP = affine((np.pi / 2, 0.0, 0.0), 0.02, (0.1, 0.2, 0.3))


@pytest.mark.parametrize("armature", [np.eye(4), TILTED, affine((0.1, 2.0, -0.3), 3.0, (4, 5, 6))])
@pytest.mark.parametrize("armature_T_bind", [np.eye(4), Z_UP])
def test_bind_pose_under_any_armature_and_bind_space(tmp_path, armature, armature_T_bind):
    """A z-up mesh under a rotated armature, bind scales of 0.01: the rig comes as the scene shows it."""
    data = read_gltf(save(write_arm(ARM, armature=armature, armature_T_bind=armature_T_bind), tmp_path))
    check_arm(data, armature, atol=1e-5)
    assert (data.up, data.metres_per_unit) == ("+y", 1.0)
    assert volume(data) > 0
    moved = not np.allclose(armature @ armature_T_bind, np.eye(4))
    assert any("scene's frame" in n for n in data.notes) == moved


def test_node_pose_is_not_the_rest_pose(tmp_path):
    """Joints posed by more than 100° leave the rest pose alone; the root, which is not posed, tells bind space's place."""
    posed = POSED.copy()
    posed[0] = 0.0
    data = read_gltf(save(write_arm(ARM, armature=TILTED, posed=posed), tmp_path))
    check_arm(data, TILTED, atol=1e-5)
    assert (data.up, data.metres_per_unit) == ("+y", 1.0)
    assert "node 'Armature'" in data.notes[0] and "do not stand in the bind pose" in data.notes[0]
    assert "confirm" in data.notes[0]
    turned = [Rotation.from_rotvec(POSED[j]).magnitude() for j in (1, 2, 3)]
    assert max(turned) > np.radians(100)


def test_a_root_without_weight_is_a_witness(tmp_path):
    arm = make_arm()
    arm.weights[:, 1] += arm.weights[:, 0]
    arm.weights[:, 0] = 0.0
    posed = POSED.copy()
    posed[0], posed[1] = 0.0, [2.0, 1.0, 0.5]
    data = read_gltf(save(write_arm(arm, armature=TILTED, posed=posed), tmp_path))
    assert np.allclose(data.vertices, truth(TILTED)[0], atol=1e-7)
    assert "node 'Armature'" in data.notes[0] and "confirm" in data.notes[0]


def test_unposed_joints_with_a_tenth_of_the_weight_are_witnesses_too(tmp_path):
    """The root turned about, its children turned back: they stand where the armature put them."""
    posed = POSED.copy()
    posed[[1, 2, 3]] = 0.0
    writer = write_arm(ARM, armature=TILTED, posed=posed)
    writer.json["nodes"][1].update(trs(np.linalg.inv(node_world(writer, 0)) @ TILTED @ ARM.matrices[1]))
    data = read_gltf(save(writer, tmp_path))
    check_arm(data, TILTED, atol=1e-5)
    assert "'Armature'" in data.notes[0]


def node_world(writer, i):
    nodes = writer.json["nodes"]
    node = nodes[i]
    if "matrix" in node:
        local = np.reshape(node["matrix"], (4, 4)).T
    else:
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() * node.get("scale", [1, 1, 1])
        local[:3, 3] = node.get("translation", [0, 0, 0])
    above = [k for k, n in enumerate(nodes) if i in n.get("children", [])]
    return node_world(writer, above[0]) @ local if above else local


@pytest.mark.parametrize("armature", [TILTED, TILTED @ np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, -1, 1])])
def test_without_a_witness_the_node_that_the_pose_is_least_turned_against(tmp_path, armature):
    """The root leans by 0.3 rad and moves: no joint stands as bound, but the scale and the lean leave one node only."""
    posed = np.array([[0.2, 0.1, -0.2], [0.4, -0.2, 0.3], [-0.5, 0.3, 0.1], [0.2, 0.1, 1.9], [0.3, 0.3, 0.2]])
    data = read_gltf(save(write_arm(ARM, armature=armature, posed=posed), tmp_path))
    check_arm(data, armature, atol=1e-5)
    assert "taken to be placed as node 'Armature'" in data.notes[0]


def test_a_majority_of_the_skin_decides_where_no_node_fits(tmp_path):
    """Bind space is no node's space (0.02 of the armature's), and only the tip is posed."""
    posed = np.zeros((5, 3))
    posed[3] = POSED[3]
    posed[0] = POSED[0]  # the root carries little weight
    writer = write_arm(ARM, armature=TILTED, armature_T_bind=Z_UP, posed=posed)
    data = read_gltf(save(writer, tmp_path))
    turned = node_world(writer, 0) @ np.linalg.inv(ARM.matrices[0])
    check_arm(data, turned, atol=1e-5)
    assert "% of the skin" in data.notes[0]


def test_bind_space_is_kept_where_nothing_tells_its_place(tmp_path):
    data = read_gltf(save(write_arm(ARM, armature=TILTED, armature_T_bind=Z_UP, posed=POSED), tmp_path))
    check_arm(data, np.linalg.inv(Z_UP), atol=1e-5)
    assert data.up is None and data.forward is None
    assert data.metres_per_unit == pytest.approx(0.01 * 0.02, rel=1e-5)
    assert "name them in a card" in data.notes[0]


def test_a_mesh_that_the_scene_mirrors(tmp_path):
    mirror = TILTED @ np.diag([-1.0, 1, 1, 1])
    data = read_gltf(save(write_arm(ARM, armature=mirror), tmp_path))
    check_arm(data, mirror, atol=1e-5)
    assert volume(data) > 0 and volume(read_gltf(save(write_arm(ARM), tmp_path))) > 0
    assert "mirror" in "; ".join(data.notes)


def test_uneven_scale_is_noted(tmp_path):
    data = read_gltf(save(write_arm(ARM, armature=np.diag([1.0, 1.0, 2.0, 1.0])), tmp_path))
    assert np.allclose(data.vertices, ARM.vertices * [1, 1, 2], atol=1e-6)
    assert np.allclose(np.swapaxes(data.frames, 1, 2) @ data.frames, np.eye(3), atol=1e-9)
    assert "unevenly (2 to 1)" in "; ".join(data.notes)


def test_quantised_positions(tmp_path):
    """KHR_mesh_quantization: positions are integers, and the inverse bind matrices undo it."""
    low, step = ARM.vertices.min(axis=0), 1.6 / 65535
    armature_T_bind = affine(scale=step, translation=low)
    writer = write_arm(ARM, armature=TILTED, armature_T_bind=armature_T_bind)
    stored = np.round((ARM.vertices - low) / step)
    attributes = writer.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["POSITION"] = writer.accessor(stored, "u2", gap=2)
    writer.json["extensionsRequired"] = ["KHR_mesh_quantization", "KHR_materials_unlit"]
    data = read_gltf(save(writer, tmp_path))
    check_arm(data, TILTED, atol=2e-5)


def test_missing_inverse_bind_matrices_are_identities(tmp_path):
    """Vertices are then stored per joint; the nodes put them together."""
    rigid = make_arm()
    rigid.weights[:] = np.eye(5)[np.argmax(rigid.weights, axis=1)]
    writer = write_arm(rigid, armature=TILTED, inverse_bind=False)
    own = np.linalg.inv(rigid.matrices)[np.argmax(rigid.weights, axis=1)]
    stored = np.einsum("iab,ib->ia", own[:, :3, :3], rigid.vertices) + own[:, :3, 3]
    writer.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = writer.accessor(stored)
    data = read_gltf(save(writer, tmp_path))
    vertices, joints, frames = truth(TILTED)
    assert np.allclose(data.vertices, vertices, atol=1e-7) and np.allclose(data.joints, joints, atol=1e-7)
    assert np.allclose(data.frames, frames, atol=1e-5)
    assert "no inverse bind matrices" in data.notes[0]


def test_missing_inverse_bind_matrices_with_joints_at_one_point(tmp_path):
    data = read_gltf(save(flat_skin([{}], POINTS, tmp_path), tmp_path))
    assert np.array_equal(data.vertices, POINTS) and np.array_equal(data.joints, np.zeros((2, 3)))
    assert np.array_equal(data.frames, np.tile(np.eye(3), (2, 1, 1)))


# ---- animations ----


def free_rig(data):
    """A Rig of the data, all joints free."""
    J, m = data.weights.shape[1], len(data.vertices)
    free = np.full((J, 3), np.pi)
    sums = np.asarray(data.weights.sum(axis=1)).ravel()
    weights = sparse.csr_array(sparse.diags_array(1 / sums) @ data.weights)
    no = np.zeros(J, dtype=bool)
    regressor = regressor_from_weights(data.vertices, weights, data.parents, data.joints)
    assert weights.shape == (m, J)
    return Rig(
        name=data.name, vertices=data.vertices, faces=data.faces, weights=weights, parents=data.parents,
        joint_names=tuple(data.joint_names), joints=data.joints, frames=data.frames, lower=-free, upper=free,
        regressor=regressor, merged=no, locked=no.copy(),
    )  # fmt: skip


def quaternions(rotvecs, j):
    """Local rotations of joint j's node for angles about its rest frame's axes, (k, 4)."""
    return (Rotation.from_matrix(ARM.local[j, :3, :3]) * Rotation.from_rotvec(rotvecs)).as_quat()


ANGLES = np.random.default_rng(3).normal(size=(4, 5, 3)) * 0.7
TIMES = np.array([0.0, 0.5, 0.75, 2.0])


def animated_arm(interpolation="LINEAR", armature=TILTED, signs=(1, 1, 1, 1), **options):
    writer = write_arm(ARM, armature=armature, **options)
    channels = []
    for j in range(5):
        values = quaternions(ANGLES[:, j], j) * np.array(signs)[:, None]
        if interpolation == "CUBICSPLINE":
            slopes = np.zeros((4, 2, 4))
            values = np.concatenate([slopes[:, :1], values[:, None], slopes[:, 1:]], axis=1).reshape(-1, 4)
        channels.append((j, "rotation", TIMES, values, interpolation))
    writer.animation(channels)
    return writer


@pytest.mark.parametrize("interpolation", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("armature", [TILTED, TILTED @ np.diag([-1.0, 1, 1, 1])])
def test_angles_of_animations(tmp_path, interpolation, armature):
    """Angles written about the joints' own axes come back; halfway between keys by each interpolation's rule."""
    data = read_gltf(save(animated_arm(interpolation, armature), tmp_path))
    got = data.animated
    assert got.shape == (7, 5, 3)
    # The armature is the root's parent: where it is rotated, the root's angles are still those about its own axes.
    assert np.allclose(got[::2], ANGLES, atol=1e-5)
    for j in range(5):
        before, after = quaternions(ANGLES[:-1, j], j), quaternions(ANGLES[1:, j], j)
        if interpolation == "STEP":
            middle = before
        elif interpolation == "CUBICSPLINE":
            middle = before + after  # flat tangents: ½, ½, normalised
        else:
            middle = before + np.sign(np.einsum("ia,ia->i", before, after))[:, None] * after  # the middle of the arc
        rest = Rotation.from_matrix(ARM.local[j, :3, :3])
        expected = (rest.inv() * Rotation.from_quat(middle)).as_matrix()
        assert np.allclose(Rotation.from_rotvec(got[1::2, j]).as_matrix(), expected, atol=1e-5)
    assert not any("animations" in n for n in data.notes)


def test_linear_takes_the_short_way_and_signs_do_not_matter(tmp_path):
    plain = read_gltf(save(animated_arm(), tmp_path)).animated
    flipped = read_gltf(save(animated_arm(signs=(1, -1, -1, 1)), tmp_path)).animated
    assert np.allclose(plain, flipped, atol=1e-5)


def test_interpolation_away_from_the_middle(tmp_path):
    """A cubic spline gives x = t³ − t + 1 exactly from its slopes; a slerp turns evenly, whatever the quaternions' signs."""
    writer = write_arm(ARM)
    junk = [99.0, 99, 99]  # the first in-tangent and the last out-tangent are never used
    cubic = np.array([junk, [1, 0, 0], [-1, 0, 0], [2, 0, 0], [1, 0, 0], [2, 0, 0], [11, 0, 0], [7, 0, 0], junk])
    turning = quaternions([[0, 0, 0], [0, 0, 2.5]], 1) * [[1], [-1]]
    still = quaternions(np.zeros((3, 3)), 2)
    writer.animation(
        [
            (0, "translation", [0.0, 1.0, 2.0], cubic, "CUBICSPLINE"),
            (1, "rotation", [0.0, 2.0], turning, "LINEAR"),
            (2, "rotation", [0.0, 0.3, 1.5], still, "STEP"),
        ]
    )
    path = save(writer, tmp_path)
    times = np.array([0.0, 0.15, 0.3, 0.65, 1.0, 1.25, 1.5, 1.75, 2.0])
    worlds = NodeGraph(open_gltf(path)).animated_worlds([0, 1, 2], 100)
    assert np.allclose(worlds[:, 0, 0, 3], times**3 - times + 1, atol=1e-6)
    assert np.allclose(read_gltf(path).animated[:, 1], times[:, None] * [0, 0, 1.25], atol=1e-5)


@pytest.mark.parametrize("options", [{"posed": POSED}, {"posed": POSED, "armature_T_bind": Z_UP}])
def test_angles_do_not_depend_on_the_node_pose(tmp_path, options):
    """Angles are relative to the bind pose, whatever pose the nodes stand in; the root's only where bind space is placed."""
    data = read_gltf(save(animated_arm(**options), tmp_path))
    assert np.allclose(data.animated[::2, 1:], ANGLES[:, 1:], atol=1e-5)


@pytest.mark.parametrize("armature", [TILTED, TILTED @ np.diag([1.0, -1, 1, 1])])
def test_angles_where_bind_space_is_kept(tmp_path, armature):
    """The root's angles are then told from the pose that the nodes stand in: played back, that pose is not turned as a whole."""
    writer = write_arm(ARM, armature=armature, armature_T_bind=Z_UP, posed=POSED)
    writer.animation([(3, "rotation", [0.0], quaternions(POSED[3:4], 3), "LINEAR")])
    data = read_gltf(save(writer, tmp_path))
    assert data.up is None and data.animated.shape == (1, 5, 3)
    posed = free_rig(data).pose(data.animated[0])
    turned, _ = Rotation.align_vectors(posed - posed.mean(axis=0), data.vertices - data.vertices.mean(axis=0))
    assert turned.magnitude() < 1e-4
    assert np.allclose(data.animated[0, 1:], POSED[1:], atol=1e-5)


def test_animations_are_thinned_evenly(tmp_path):
    writer = write_arm(ARM)
    times = np.arange(400) / 30
    for j in (1, 2):
        values = quaternions(np.outer(times / times[-1], [1.0, 0, 0]), j)
        writer.animation([(j, "rotation", times, values, "LINEAR")])
    animated = read_gltf(save(writer, tmp_path)).animated
    assert animated.shape == (500, 5, 3)
    turning = animated[:, 1, 0] + animated[:, 2, 0]
    half = turning[: len(turning) // 2]
    assert turning[0] == pytest.approx(0, abs=1e-5) and turning[-1] == pytest.approx(1, abs=1e-5)
    assert np.allclose(np.diff(half), 1 / 250, atol=2e-3)


def test_animations_that_move_or_scale_joints_are_noted(tmp_path):
    writer = write_arm(ARM)
    away = ARM.local[2, :3, 3] + [[0, 0, 0], [0.3, 0, 0]]
    writer.animation([(2, "translation", [0.0, 1.0], away, "LINEAR"), (3, "scale", [0.0, 1.0], [[1, 1, 1], [1, 1.5, 1]], "STEP")])
    writer.animation([(len(ARM.names), "rotation", [0.0, 1.0], [[0, 0, 0, 1]] * 2, "LINEAR")])  # the mesh's node: nothing to us
    data = read_gltf(save(writer, tmp_path))
    assert data.animated.shape == (3, 5, 3) and np.allclose(data.animated, 0, atol=1e-5)
    notes = "; ".join(data.notes)
    assert "'lower' the furthest (by 20 %" in notes and "scale 1 joint(s), 'tip'" in notes


def test_quantised_rotations_and_ignored_channels(tmp_path):
    writer = write_arm(ARM)
    angle = 1.0
    stored = np.round(quaternions([[0, 0, 0], [angle, 0, 0]], 1) * 32767)
    sampler = {"input": writer.accessor([0.0, 1.0]), "output": writer.accessor(stored, "i2", normalized=True)}
    channels = [
        {"sampler": 0, "target": {"node": 1, "path": "rotation"}},
        {"sampler": 0, "target": {"path": "rotation"}},
        {"sampler": 0, "target": {"node": 1, "path": "weights"}},
    ]
    writer.add("animations", samplers=[sampler], channels=channels)
    got = read_gltf(save(writer, tmp_path)).animated
    assert np.allclose(got[:, 1], [[0, 0, 0], [angle / 2, 0, 0], [angle, 0, 0]], atol=2e-4)


# ---- bad files ----


def edited(edit, **options):
    def make(folder):
        writer = write_arm(ARM, **options)
        edit(writer.json)
        return save(writer, folder)

    return make


def raw(content, name="x.glb"):
    def make(folder):
        (folder / name).write_bytes(content)
        return folder / name

    return make


def put(path, value):
    """An edit of the JSON: ``path`` such as "skins.0.joints"; None removes."""

    def edit(root):
        *way, last = [int(p) if p.isdecimal() else p for p in path.split(".")]
        for p in way:
            root = root[p]
        if value is None:
            root.pop(last)
        else:
            root[last] = value

    return edit


def gltf_with_buffer(uri, length=None, keep=True):
    def make(folder):
        path = save(write_arm(ARM), folder, "x.gltf")
        root = json.loads(path.read_text())
        root["buffers"][0]["uri"] = uri
        if length:
            root["buffers"][0]["byteLength"] = length
        path.write_text(json.dumps(root))
        return path

    return make


def animation_edit(path, value):
    def make(folder):
        writer = animated_arm()
        put(path, value)(writer.json)
        return save(writer, folder)

    return make


GLB = write_arm(ARM).glb()
JSON_END = 20 + struct.unpack("<I", GLB[12:16])[0]
PRIMITIVE = "meshes.0.primitives.0"
BAD = {
    "missing file": (lambda folder: folder / "none.glb", "no such file"),
    "folder": (lambda folder: folder, "cannot be read"),
    "empty": (raw(b""), "starts with b''"),
    "wrong magic": (raw(b"PK\x03\x04" + GLB[4:]), "starts with b'PK"),
    "only a header": (raw(GLB[:10]), "truncated"),
    "truncated header": (raw(b"glTF"), "truncated"),
    "truncated": (raw(GLB[:-50]), "truncated"),
    "truncated chunk": (raw(GLB[:8] + struct.pack("<I", len(GLB) - 50) + GLB[12:-50]), "truncated"),
    "no chunk": (raw(b"glTF" + struct.pack("<II", 2, 12)), "no JSON chunk"),
    "binary first": (raw(GLB[:16] + b"BIN\0" + GLB[20:]), "a JSON chunk first"),
    "version 1 container": (raw(b"glTF" + struct.pack("<I", 1) + GLB[8:]), "version 1"),
    "no chunk for the buffer": (raw(GLB[:8] + struct.pack("<I", JSON_END) + GLB[12:]), "without a uri"),
    "broken json": (raw(b'{"asset": {"version": "2.0"', "x.gltf"), "broken JSON"),
    "not text": (raw(b"\xff\xfe\x00", "x.gltf"), "not UTF-8"),
    "deep json": (raw(b'{"a":' + b"[" * 200000, "x.gltf"), "JSON"),
    "not an object": (raw(b"[1, 2]", "x.gltf"), "expected a glTF object"),
    "no version": (raw(b"{}", "x.gltf"), "glTF version None"),
    "glTF 1": (edited(put("asset.version", "1.0")), "glTF version '1.0'"),
    "glTF 2.1 needed": (edited(put("asset.minVersion", "2.1")), "minVersion '2.1'"),
    "draco": (edited(put("extensionsRequired", ["KHR_draco_mesh_compression"])), "without mesh compression"),
    "meshopt": (edited(put("extensionsRequired", ["EXT_meshopt_compression"])), "compressed with EXT_meshopt_compression"),
    "missing buffer": (gltf_with_buffer("away.bin"), "'away.bin'"),
    "web buffer": (gltf_with_buffer("https://example.org/x.bin"), "relative to the file"),
    "absolute buffer": (gltf_with_buffer("/etc/hostname"), "relative to the file"),
    "absolute buffer in disguise": (gltf_with_buffer("%2Fetc/hostname"), "relative to the file"),
    "null in a name": (gltf_with_buffer("a%00b"), "cannot be read"),
    "short buffer": (gltf_with_buffer("x.bin", length=10**6), "it is truncated"),
    "bad base64": (gltf_with_buffer("data:application/octet-stream;base64,A$"), "not base64"),
    "bad data uri": (gltf_with_buffer("data:"), "without a comma"),
    "view out of buffer": (edited(put("bufferViews.0.byteLength", 10**7)), "bufferView 0 ends at byte"),
    "accessor out of view": (edited(put("accessors.0.count", 10**5)), "accessor 0 (POSITION"),
    "huge accessor": (edited(put("accessors.0", {"componentType": 5126, "count": 10**12, "type": "VEC3"})), "without data"),
    "no view": (edited(put("accessors.0.bufferView", 99)), "bufferViews[99]"),
    "negative offset": (edited(put("accessors.0.byteOffset", -4)), "byteOffset of accessor 0"),
    "small stride": (edited(put("bufferViews.0.byteStride", 4)), "byteStride 4"),
    "component type": (edited(put("accessors.0.componentType", 5124)), "componentType 5124"),
    "position type": (edited(put("accessors.0.type", "VEC2")), "has type 'VEC2'"),
    "count missing": (edited(put("accessors.0.count", None)), "count of accessor 0 (POSITION of primitive 0 of mesh 0) is m"),
    "no such accessor": (edited(put(f"{PRIMITIVE}.attributes.POSITION", 77)), "accessors[77]"),
    "no skin": (edited(lambda r: (r.pop("skins"), r["nodes"][5].pop("skin"))), "got no skin"),
    "unused skin": (edited(lambda r: r["nodes"][5].pop("skin")), "1 skins that no mesh uses"),
    "node of no skin": (edited(put("nodes.5.skin", 3)), "skins[3], of 1"),
    "joints out of range": (edited(put("skins.0.joints", [0, 1, 2, 3, 40])), "joints of skin 0 refers to nodes[40]"),
    "joint twice": (edited(put("skins.0.joints", [0, 1, 2, 3, 3])), "each once"),
    "no joints": (edited(put("skins.0.joints", [])), "with 0 joints"),
    "weights to no joint": (edited(put("skins.0.joints", [0, 1])), "where the skin has 2"),
    "too few matrices": (edited(put("accessors.4.count", 2)), "2 inverse bind matrices for the 5 joints"),
    "weights without joints": (edited(put(f"{PRIMITIVE}.attributes.WEIGHTS_0", None)), "without WEIGHTS_0"),
    "joints only": (edited(put(f"{PRIMITIVE}.attributes.JOINTS_0", None)), "no triangles with joints"),
    "float joints": (edited(put(f"{PRIMITIVE}.attributes.JOINTS_0", 2)), "not integers"),
    "attribute counts": (edited(put("accessors.1.count", 3)), "3 elements of JOINTS_0 for 64 vertices"),
    "index out of range": (edited(put("accessors.0.count", 20)), "20"),
    "float indices": (edited(put("accessors.3", {"componentType": 5126, "count": 3, "type": "SCALAR"})), "unsigned integers"),
    "only lines": (edited(put(f"{PRIMITIVE}.mode", 1)), "no triangles"),
    "cycle of nodes": (edited(put("nodes.3.children", [0])), "two parents"),
    "cycle without a root": (edited(lambda r: (r["nodes"][6].pop("children"), r["nodes"][3].update(children=[0]))), "cycle"),
    "two parents": (edited(put("nodes.3.children", [4])), "two parents"),
    "child out of range": (edited(put("nodes.3.children", [400])), "nodes[400]"),
    "bad transform": (edited(put("nodes.3.translation", [0, 1])), "translation of node 3"),
    "infinite transform": (edited(put("nodes.3.translation", [0, 1, float("inf")])), "finite"),
    "zero rotation": (edited(put("nodes.3.rotation", [0, 0, 0, 0])), "rotation of length 0"),
    "nodes are no list": (edited(put("nodes", {"a": 1})), "nodes of the file"),
    "scene out of range": (edited(put("scene", 9)), "scenes[9]"),
    "mesh out of range": (edited(put("nodes.5.mesh", 9)), "meshes[9]"),
    "sampler out of range": (animation_edit("animations.0.channels.0.sampler", 9), "sampler 9 of 5"),
    "interpolation": (animation_edit("animations.0.samplers.0.interpolation", "BEZIER"), "'BEZIER'"),
    "values of an animation": (animation_edit("animations.0.samplers.0.output", 0), "output of sampler 0 of animation 0"),
    "values per key": (animation_edit("animations.0.samplers.0.interpolation", "CUBICSPLINE"), "3 values for each"),
    "target out of range": (animation_edit("animations.0.channels.0.target.node", 70), "nodes[70]"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files_give_one_clear_error(tmp_path, case):
    make, words = BAD[case]
    path = make(tmp_path)
    with pytest.raises(FileError) as error:
        read_gltf(path)
    assert error.value.argument == str(path)
    assert words in str(error.value)


def test_bad_numbers(tmp_path):
    for values, words in (
        (
            np.where(np.arange(len(ARM.vertices))[:, None] == 7, np.nan, ARM.vertices),
            "NaN or infinite values, first in element 7",
        ),
        (np.where(np.arange(len(ARM.vertices))[:, None] == 3, np.inf, ARM.vertices), "first in element 3"),
    ):
        writer = write_arm(ARM)
        writer.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = writer.accessor(values)
        with pytest.raises(FileError, match=words):
            read_gltf(save(writer, tmp_path))
    for matrices, words in (
        (np.zeros((5, 4, 4)) + np.diag([1, 1, 0, 1]), "inverse bind matrix of 'root' that flattens space"),
        (np.swapaxes(np.linalg.inv(ARM.matrices), 1, 2), "with the last row"),
    ):
        writer = write_arm(ARM)
        writer.json["skins"][0]["inverseBindMatrices"] = writer.accessor(matrices)
        with pytest.raises(FileError, match=words):
            read_gltf(save(writer, tmp_path))
    writer = animated_arm()
    writer.json["animations"][0]["samplers"][0]["input"] = writer.accessor([0.0, 2.0, 1.0, 3.0])
    with pytest.raises(FileError, match="run backwards"):
        read_gltf(save(writer, tmp_path))
    writer = write_arm(ARM)
    writer.json["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": writer.view(struct.pack("<H", 64)), "componentType": 5123},
        "values": {"bufferView": writer.view(bytes(12))},
    }
    with pytest.raises(FileError, match="sparse index 64"):
        read_gltf(save(writer, tmp_path))


def test_compressed_primitives_without_fallback(tmp_path):
    writer = write_arm(ARM)
    writer.json["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    check_arm(read_gltf(save(writer, tmp_path)), np.eye(4))  # data of its own: the extension is not needed
    writer.json["accessors"][0].pop("bufferView")
    with pytest.raises(FileError, match="compressed with KHR_draco"):
        read_gltf(save(writer, tmp_path))


def test_a_path_that_is_none():
    with pytest.raises(InputError, match="path: got int"):
        read_gltf(3)


def test_damaged_files_never_raise_anything_else(tmp_path):
    """JSON values swapped for others at random: either a rig comes out, or one of our errors."""
    rng = np.random.default_rng(11)
    writer = animated_arm()
    strange = [
        None,
        -1,
        0,
        1,
        7,
        2.5,
        1e300,
        "x",
        "",
        [],
        {},
        [0],
        ["a"],
        [{}],
        {"a": 1},
        True,
        10**400,
        5126,
        "VEC3",
        float("nan"),
    ]
    refused = 0
    for _ in range(400):
        root = json.loads(json.dumps(writer.json))
        root["buffers"] = [{"byteLength": len(writer.binary), "uri": "data:;base64," + base64.b64encode(writer.binary).decode()}]
        for _ in range(int(rng.integers(1, 3))):
            owner = root
            while True:
                keys = list(owner) if isinstance(owner, dict) else range(len(owner))
                key = keys[int(rng.integers(len(keys)))]
                if not (isinstance(owner[key], (dict, list)) and len(owner[key])) or rng.random() < 0.1:
                    break
                owner = owner[key]
            owner[key] = strange[int(rng.integers(len(strange)))]
        path = tmp_path / "fuzz.gltf"
        path.write_text(json.dumps(root))
        try:
            data = read_gltf(path)
            assert np.isfinite(data.vertices).all() and np.isfinite(data.frames).all()
        except InputError:
            refused += 1
    assert 100 < refused < 400


# ---- real files ----


def test_hand(shared_rigs):
    data = read_gltf(shared_rigs / "webxr_hand" / "left.glb")
    assert data.vertices.shape == (1360, 3) and data.faces.shape == (2314, 3) and data.weights.shape == (1360, 25)
    assert (data.parents == -1).all()
    assert np.count_nonzero(np.asarray(data.weights.sum(axis=0))) == 20
    assert np.allclose(data.weights.sum(axis=1), 1, atol=1e-6)
    assert (data.up, data.metres_per_unit, data.notes, data.animated) == ("+y", 1.0, [], None)
    row = {n: i for i, n in enumerate(data.joint_names)}
    chain = ["phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip"]
    for finger in ("index", "middle", "ring", "pinky"):
        for here, there in pairwise(chain):
            a, b = row[f"{finger}-finger-{here}"], row[f"{finger}-finger-{there}"]
            bone = data.joints[b] - data.joints[a]
            along = -data.frames[a, :, 2] @ bone / np.linalg.norm(bone)
            assert along > 0.95  # −z points to the tip
    # x is flexion: the neighbours' x axes agree along a finger, and lie across it.
    x = data.frames[[row[f"middle-finger-{c}"] for c in chain], :, 0]
    assert (x @ x.T).min() > 0.9


class FoxByTheBook:
    """The Fox, read and skinned in the plainest way: node matrices one by one, keys of one animation as they stand."""

    def __init__(self, path):
        content = path.read_bytes()
        length = struct.unpack("<I", content[12:16])[0]
        self.json, self.binary = json.loads(content[20 : 20 + length]), content[28 + length :]
        self.nodes = self.json["nodes"]
        skin = self.json["skins"][0]
        primitive = self.json["meshes"][0]["primitives"][0]["attributes"]
        self.joints = skin["joints"]
        self.inverse_bind = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        self.positions, self.influences, self.weights = (self.array(primitive[k]) for k in ("POSITION", "JOINTS_0", "WEIGHTS_0"))

    def array(self, index):
        item = self.json["accessors"][index]
        view = self.json["bufferViews"][item["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[item["type"]]
        dtype = {5126: "<f4", 5123: "<u2"}[item["componentType"]]
        start = view.get("byteOffset", 0) + item.get("byteOffset", 0)
        data = np.frombuffer(self.binary, dtype, item["count"] * width, start).reshape(item["count"], width)
        return data.astype(float if dtype == "<f4" else int)

    def frame(self, animation, k, with_translations):
        nodes = [dict(n) for n in self.nodes]
        for channel in animation["channels"]:
            path = channel["target"]["path"]
            if path == "rotation" or with_translations:
                nodes[channel["target"]["node"]][path] = self.array(animation["samplers"][channel["sampler"]]["output"])[k]
        worlds = {}

        def walk(i, above):
            local = np.eye(4)
            local[:3, :3] = Rotation.from_quat(nodes[i].get("rotation", [0, 0, 0, 1])).as_matrix() * nodes[i].get(
                "scale", [1, 1, 1]
            )
            local[:3, 3] = nodes[i].get("translation", [0, 0, 0])
            worlds[i] = above @ local
            for child in nodes[i].get("children", []):
                walk(child, worlds[i])

        for top in self.json["scenes"][0]["nodes"]:
            walk(top, np.eye(4))
        S = np.array([worlds[j] for j in self.joints]) @ self.inverse_bind
        points = np.column_stack([self.positions, np.ones(len(self.positions))])
        return np.einsum("ik,ikab,ib->ia", self.weights, S[self.influences], points)[:, :3]


def test_fox(shared_rigs):
    """Θ of every animation's keys, posed by our skinning, is what glTF's own rule draws, but for the hip's translation."""
    path = shared_rigs / "fox" / "Fox.glb"
    data, book = read_gltf(path), FoxByTheBook(path)
    assert data.vertices.shape == (1728, 3) and len(data.faces) == 576 and data.up == "+y" and data.metres_per_unit == 1.0
    assert np.ptp(data.vertices, axis=0).max() == pytest.approx(154.72, abs=0.01)
    assert np.array_equal(data.vertices, book.positions)
    assert data.joint_names[:3] == ["_rootJoint", "b_Root_00", "b_Hip_01"] and data.joint_names[8] == "b_RightForeArm_07"
    assert data.parents[data.joint_names.index("b_Head_05")] == data.joint_names.index("b_Neck_04")
    assert any("b_Hip_01" in n and "only rotations" in n for n in data.notes)

    assert np.array_equal(build_rig(data).pose(np.zeros((24, 3))), book.positions)
    rig, start = free_rig(data), 0
    keys = [book.array(a["samplers"][0]["input"]).ravel() for a in book.json["animations"]]
    moments = sum(2 * len(k) - 1 for k in keys)
    assert len(data.animated) == moments <= 500
    for animation, times in zip(book.json["animations"], keys):
        for k in range(0, len(times), 7):
            posed = pose_rig(rig, data.animated[start + 2 * k])
            assert np.allclose(posed.vertices, book.frame(animation, k, with_translations=False), atol=2e-3)  # of 155
            moved = book.frame(animation, k, with_translations=True) - posed.vertices
            assert np.ptp(moved, axis=0).max() < 2e-3  # the hip carries all of the fox: one shift for all
        start += 2 * len(times) - 1
