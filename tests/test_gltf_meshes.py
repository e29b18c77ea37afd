"""The meshes of glTF files: triangles, primitives, and weights."""

import numpy as np
import pytest
from gltf_files import (
    ARM,
    POINTS,
    TILTED,
    affine,
    flat_skin,
    save,
    trs,
    write_arm,
)
from scipy import sparse

from lbsfit_np.io.gltf import read_gltf


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
