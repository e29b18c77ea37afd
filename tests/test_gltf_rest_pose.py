"""The rest pose of glTF files in the scene's frame, whatever pose their nodes stand in."""

import numpy as np
import pytest
from gltf_files import (
    ARM,
    POINTS,
    POSED,
    TILTED,
    Z_UP,
    affine,
    check_arm,
    flat_skin,
    make_arm,
    save,
    trs,
    truth,
    write_arm,
)
from scipy.spatial.transform import Rotation

from lbsfit_np.io.gltf import read_gltf


def volume(data):
    a, b, c = np.moveaxis(data.vertices[data.faces], 1, 0)
    return np.einsum("ia,ia->", a, np.cross(b, c)) / 6


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
    assert "node 'Armature'" in data.notes[0] and "are not in the bind pose" in data.notes[0]
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
    assert "assumed to be placed in the scene like node 'Armature', from which the posed mesh is turned" in data.notes[0]


def test_without_a_witness_the_scene_itself_is_called_so(tmp_path):
    posed = np.array([[0.2, 0.1, -0.2], [0.4, -0.2, 0.3], [-0.5, 0.3, 0.1], [0.2, 0.1, 1.9], [0.3, 0.3, 0.2]])
    data = read_gltf(save(write_arm(ARM, armature=np.eye(4), posed=posed), tmp_path))
    check_arm(data, np.eye(4), atol=1e-5)
    assert "the rest pose is the bind pose, assumed to be in the scene's own frame, from which the posed mesh" in data.notes[0]


@pytest.mark.parametrize("scale", [[1, 1, 0], [1, 0, 1], [0, 1, 0], [0, 0, 0], [1e-9, 1, 1]])
@pytest.mark.parametrize("joint", [1, 2, 3, 4])
def test_joints_that_are_flattened_tell_no_place(tmp_path, scale, joint):
    """Determinants of singular matrices are rounding errors, whose cube roots look like scales."""
    writer = write_arm(ARM, armature=TILTED)
    writer.json["nodes"][joint]["scale"] = scale
    data = read_gltf(save(writer, tmp_path))
    check_arm(data, TILTED, atol=1e-5)
    assert f"({ARM.names[joint]} is flattened)" in data.notes[0] and "node 'Armature'" in data.notes[0]


def test_bind_space_is_kept_where_all_joints_are_flattened(tmp_path):
    writer = write_arm(ARM)
    writer.json["nodes"][0]["scale"] = [1, 1, 0]
    data = read_gltf(save(writer, tmp_path))
    check_arm(data, np.eye(4))
    assert data.up is None and "its unit is unknown" in data.notes[0]


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
    assert "set them in a card" in data.notes[0]


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
