"""What a glTF scene shows of its meshes as a scan: which vertices, which morph, and which way they look."""

import tracemalloc

import numpy as np
import pytest
from gltf_files import ARM, GltfWriter, save, write_arm
from scipy.spatial.transform import Rotation

from lbsfit_np.errors import FileError
from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.io.scans import load_mesh, load_scan

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5]])
UPWARDS = np.tile([0.0, 0.0, 1.0], (6, 1))
LABELS = np.arange(6)


def scene(nodes, *meshes):
    """A writer with the six corners, their normals and labels, and meshes: lists of (mode, rows or None, further fields)."""
    writer = GltfWriter()
    position, normal = writer.accessor(CORNERS), writer.accessor(UPWARDS)
    label = writer.accessor(LABELS, "u1")
    for primitives in meshes:
        written = []
        for mode, rows, fields in primitives:
            primitive = {"attributes": {"POSITION": position, "NORMAL": normal, "_LABEL": label}, "mode": mode} | fields
            if rows is not None:
                primitive["indices"] = writer.accessor(np.array(rows), "u2")
            written.append(primitive)
        writer.add("meshes", primitives=written)
    for node in nodes:
        writer.add("nodes", **node)
    writer.add("scenes", nodes=list(range(len(nodes))))
    return writer


def test_vertices_that_no_primitive_of_a_mesh_uses_are_not_shown(tmp_path):
    nodes = [{"mesh": 0}, {"mesh": 1, "translation": [100, 0, 0]}]
    path = save(scene(nodes, [(4, [0, 1, 2], {})], [(4, [3, 5, 4], {})]), tmp_path)
    scan = load_scan(path)
    np.testing.assert_allclose(scan.points, np.vstack([CORNERS[:3], CORNERS[3:] + [100, 0, 0]]))
    np.testing.assert_array_equal(scan.labels, LABELS)
    assert len(scan.normals) == 6
    vertices, faces = load_mesh(path)
    np.testing.assert_allclose(vertices[faces[1]], CORNERS[[3, 5, 4]] + [100, 0, 0])


@pytest.mark.parametrize(("rows", "shown"), [([4, 1], [1, 4]), (None, range(6))])
def test_points_are_those_that_are_listed(tmp_path, rows, shown):
    scan = load_scan(save(scene([{"mesh": 0}], [(0, rows, {})]), tmp_path))
    np.testing.assert_allclose(scan.points, CORNERS[list(shown)])
    np.testing.assert_array_equal(scan.labels, LABELS[list(shown)])


def test_primitives_of_one_set_of_positions_show_what_they_have_together(tmp_path):
    scan = load_scan(save(scene([{"mesh": 0}], [(4, [0, 1, 2], {}), (0, [5], {})]), tmp_path))
    np.testing.assert_allclose(scan.points, CORNERS[[0, 1, 2, 5]])


@pytest.mark.parametrize("owner", ["node", "mesh", "both"])
def test_a_mesh_is_morphed_as_its_weights_say(tmp_path, owner):
    writer = scene([{"mesh": 0}], [(4, range(6), {})])
    up, sideways = np.zeros((6, 3)), np.zeros((6, 3))
    up[0, 1], sideways[5, 0] = 2.0, 3.0
    targets = [{"POSITION": writer.accessor(up)}, {"POSITION": writer.accessor(sideways), "NORMAL": writer.accessor(up)}]
    writer.json["meshes"][0]["primitives"][0]["targets"] = targets
    assert np.array_equal(load_scan(save(writer, tmp_path)).points, CORNERS)  # without weights they count for nothing
    weights = [0.5, 1.0]
    if owner in ("mesh", "both"):
        writer.json["meshes"][0]["weights"] = weights if owner == "mesh" else [9.0, 9.0]
    if owner in ("node", "both"):
        writer.json["nodes"][0]["weights"] = weights
    scan = load_scan(save(writer, tmp_path))
    np.testing.assert_allclose(scan.points, CORNERS + 0.5 * up + sideways)
    np.testing.assert_allclose(scan.normals[0], np.array([0, 2, 1]) / np.sqrt(5))
    for none in ([], [0.0], [0, 0, 0]):
        writer.json["nodes"][0]["weights"] = none
        assert np.array_equal(load_scan(save(writer, tmp_path)).points, CORNERS)
    writer.json["nodes"][0]["weights"] = [1.0]
    with pytest.raises(FileError, match=r"weights of node 0 is \[1.0\]; expected 2 finite numbers"):
        load_scan(save(writer, tmp_path))


@pytest.mark.parametrize("scale", [[-1, 1, 1], [1, 1, -1], [-1, -2, -1], [2, 1, 1]])
def test_mirrored_meshes_look_outwards(tmp_path, scale):
    """Normals and the order of corners go along, as of a solid that a node mirrors."""
    solid = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = solid - solid.mean(axis=0)
    writer = GltfWriter()
    attributes = {"POSITION": writer.accessor(solid), "NORMAL": writer.accessor(normals)}
    writer.add("meshes", primitives=[{"attributes": attributes, "indices": writer.accessor(faces.ravel(), "u2")}])
    writer.add("nodes", mesh=0, scale=scale)
    path = save(writer, tmp_path)
    scan, (vertices, shown) = load_scan(path), load_mesh(path)
    away = scan.points - scan.points.mean(axis=0)
    assert (np.einsum("ia,ia->i", scan.normals, away) > 0).all()
    p = vertices[shown]
    out = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (np.einsum("ia,ia->i", out, p.mean(axis=1) - vertices.mean(axis=0)) > 0).all()


def test_primitives_of_one_set_of_positions_have_their_own_labels(tmp_path):
    writer = scene([{"mesh": 0}], [(4, [0, 1, 2], {}), (4, [3, 4, 5], {})])
    second = writer.json["meshes"][0]["primitives"][1]
    second["attributes"] = second["attributes"] | {"_LABEL": writer.accessor(LABELS + 10, "u1")}
    scan = load_scan(save(writer, tmp_path))
    np.testing.assert_allclose(scan.points, CORNERS)
    np.testing.assert_array_equal(scan.labels, [0, 1, 2, 13, 14, 15])
    np.testing.assert_array_equal(scan.normals, UPWARDS)
    del second["attributes"]["_LABEL"]
    assert load_scan(save(writer, tmp_path)).labels is None


@pytest.mark.parametrize("none", [False, True])
def test_normals_that_differ_at_the_same_vertices_are_left_out(tmp_path, none):
    """As of the two sides of a sheet, whose points come once all the same."""
    writer = scene([{"mesh": 0}], [(4, range(6), {}), (4, [2, 1, 0], {})])
    second = writer.json["meshes"][0]["primitives"][1]
    second["attributes"] = second["attributes"] | {"NORMAL": writer.accessor(-UPWARDS)}
    if none:
        del second["attributes"]["NORMAL"]
    scan = load_scan(save(writer, tmp_path))
    np.testing.assert_allclose(scan.points, CORNERS)
    assert scan.normals is None and len(scan.labels) == 6
    assert any("has no normals, or others, than those before it at the same vertices" in note for note in scan.notes)


@pytest.mark.parametrize("skinned", [False, True])
def test_primitives_of_one_set_of_positions_follow_their_own_joints(tmp_path, skinned):
    nodes = [{"mesh": 0}, {"translation": [10, 0, 0]}, {"translation": [0, 20, 0]}]
    writer = scene(nodes, [(4, [0, 1, 2], {}), (4, [3, 4, 5], {})])
    for k, primitive in enumerate(writer.json["meshes"][0]["primitives"]):
        joints = writer.accessor(np.tile([k, 0, 0, 0], (6, 1)), "u1")
        weights = writer.accessor(np.tile([1.0, 0, 0, 0], (6, 1)))
        primitive["attributes"] = primitive["attributes"] | {"JOINTS_0": joints, "WEIGHTS_0": weights}
    if skinned:
        writer.json["nodes"][0]["skin"] = writer.add("skins", joints=[1, 2])
    moved = np.repeat([[10.0, 0, 0], [0, 20, 0]], 3, axis=0) if skinned else 0.0
    np.testing.assert_allclose(load_scan(save(writer, tmp_path)).points, CORNERS + moved)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_none_are_treated_as_in_other_formats(tmp_path, bad):
    """Bad points may be left out, normals may be bad, and labels are then left out."""

    def read(name, values, **options):
        writer = scene([{"mesh": 0}], [(4, [0, 1, 2, 1, 2, 3, 3, 4, 5], {})])
        values = np.array(values, dtype=float)
        values[4] = bad
        writer.json["meshes"][0]["primitives"][0]["attributes"][name] = writer.accessor(values)
        return load_scan(save(writer, tmp_path), **options)

    assert len(read("NORMAL", UPWARDS).points) == 6
    unlabelled = read("_LABEL", LABELS)
    assert unlabelled.labels is None and any("'_LABEL'" in note for note in unlabelled.notes)
    with pytest.raises(FileError, match="1 of 6 points .* the first at index 4.*drop_invalid"):
        read("POSITION", CORNERS)
    left = read("POSITION", CORNERS, drop_invalid=True)
    np.testing.assert_array_equal(left.points, np.delete(CORNERS, 4, axis=0))
    np.testing.assert_array_equal(left.labels, [0, 1, 2, 3, 5])
    assert len(left.normals) == 5 and "1 of 6 points" in "".join(left.notes)


def test_weights_that_are_no_numbers_are_an_error_that_names_them(tmp_path):
    writer = scene([{"mesh": 0, "skin": 0}], [(4, range(6), {})])
    attributes = writer.json["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"JOINTS_0": writer.accessor(np.zeros((6, 4)), "u1"), "WEIGHTS_0": writer.accessor(np.full((6, 4), np.nan))}
    writer.add("skins", joints=[0])
    with pytest.raises(FileError, match=r"\(WEIGHTS_0 of primitive 0 of mesh 0\) holds NaN"):
        load_scan(save(writer, tmp_path))


@pytest.mark.parametrize("node", [{}, {"scale": [1, 2, -1], "rotation": [0, 0.6, 0, 0.8], "translation": [3, 2, 1]}])
def test_large_clouds_want_little_more_memory_than_their_points(tmp_path, node):
    """The file's bytes, the points, the moved points: no matrices for each."""
    points = np.random.default_rng(0).normal(size=(20_000, 3)).astype("f4")
    writer = GltfWriter()
    attributes = {"POSITION": writer.accessor(points), "NORMAL": writer.accessor(points)}
    writer.add("meshes", primitives=[{"attributes": attributes, "mode": 0}])
    writer.add("nodes", mesh=0, **node)
    path = save(writer, tmp_path)
    load_scan(path)  # whatever is imported on the way
    tracemalloc.start()
    try:
        scan = load_scan(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 240 * len(points)
    by_hand = points.astype(float)
    if node:
        by_hand = Rotation.from_quat(node["rotation"]).apply(by_hand * node["scale"]) + node["translation"]
    np.testing.assert_allclose(scan.points, by_hand, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1.0)


def unweighted_joints(writer, mesh):
    attributes = mesh["primitives"][0]["attributes"]
    order, weights = np.argsort(-ARM.weights, axis=1)[:, :4], np.sort(ARM.weights, axis=1)[:, :0:-1]
    for name in ("JOINTS_1", "WEIGHTS_1"):
        attributes.pop(name, None)
    attributes["JOINTS_0"] = writer.accessor(np.where(weights == 0, 99, order), "u1")
    attributes["WEIGHTS_0"] = writer.accessor(weights)


def no_position(writer, mesh):
    mesh["primitives"].append({"attributes": {"NORMAL": mesh["primitives"][0]["attributes"]["POSITION"]}})


def too_many_weights(writer, mesh):
    mesh["primitives"][0]["targets"] = [{"POSITION": writer.accessor(0 * ARM.vertices)}]
    mesh["weights"] = [0.5, 0.1]


@pytest.mark.parametrize(
    ("edit", "note"),
    [
        (unweighted_joints, None),
        (no_position, "primitive 1 of mesh 0 left out: it has no POSITION."),
        (too_many_weights, "mesh 0 has 2 weights for the 1 morph target(s) of primitive 0 of mesh 0: the last 1 left out."),
    ],
)
def test_rigs_and_scans_are_read_alike(tmp_path, edit, note):
    writer = write_arm(ARM)
    edit(writer, writer.json["meshes"][0])
    path = save(writer, tmp_path)
    scan, rig = load_scan(path), read_gltf(path)
    np.testing.assert_allclose(rig.vertices, ARM.vertices, atol=1e-6)
    np.testing.assert_allclose(scan.points, ARM.vertices, atol=1e-6)
    assert scan.notes == (() if note is None else (note,))


@pytest.mark.parametrize(
    ("owner", "values", "dtype", "words"),
    [
        ("JOINTS_0", np.full((64, 4), 7), "u1", "JOINTS_0 of primitive 0 of mesh 0 with joint 7 at vertex 0, where .* has 5"),
        ("WEIGHTS_0", np.zeros((3, 4)), "f4", "3 elements of WEIGHTS_0 for 64 vertices"),
        ("indices", np.array([0.0, 1, 2]), "f4", "indices of primitive 0 of mesh 0 that are not unsigned integers"),
        ("inverseBindMatrices", np.ones((5, 4, 4)), "f4", "the inverse bind matrix of 'root' with the last row"),
        ("inverseBindMatrices", np.zeros((2, 4, 4)), "f4", "2 inverse bind matrices for the 5 joints of skin 0"),
    ],
)
def test_damage_is_told_alike_of_rigs_and_scans(tmp_path, owner, values, dtype, words):
    writer = write_arm(ARM)
    primitive = writer.json["meshes"][0]["primitives"][0]
    of = {"indices": primitive, "inverseBindMatrices": writer.json["skins"][0]}.get(owner, primitive["attributes"])
    of[owner] = writer.accessor(values, dtype)
    path = save(writer, tmp_path)
    for read in (read_gltf, load_scan):
        with pytest.raises(FileError, match=words):
            read(path)
