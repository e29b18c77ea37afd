"""Scans: every format gives back what was written, and every broken file gives one clear error."""

import copy
import json
import pickle
import struct
import zipfile

import numpy as np
import pytest
from npy_files import DAMAGED_HEADERS, damaged, npy

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io import scans
from lbsfit_np.io.scans import SCAN_EXTENSIONS, load_scan
from lbsfit_np.scan import Scan, check_points

# A tetrahedron: float32-exact, no two points alike, the origin among them.
POINTS = np.array([[0, 0, 0], [2, 0, 0.5], [0, 1.5, 0], [0.25, 0, -3]])
FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
NORMALS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, -1], [0.6, 0.8, 0]])
LABELS = np.array([3, 0, 7, 0])


def ply_header(form, *, labels=True, faces=True):
    lines = ["ply", f"format {form} 1.0", "comment made here", f"element vertex {len(POINTS)}"]
    lines += [f"property float {a}" for a in ("x", "y", "z", "nx", "ny", "nz")] + ["property uchar red"]
    lines += ["property int label"] * labels
    lines += [f"element face {len(FACES)}", "property list uchar int vertex_indices", "property uchar material"] * faces
    return "\n".join([*lines, "end_header\n"]).encode()


def binary_ply(order):
    body = b"".join(
        struct.pack(f"{order}6fBi", *p, *n, 9, label) for p, n, label in zip(POINTS, NORMALS, LABELS)
    ) + b"".join(struct.pack(f"{order}B3iB", 3, *f, 1) for f in FACES)  # fmt: skip
    return ply_header("binary_little_endian" if order == "<" else "binary_big_endian") + body


def rows(*columns, sep=" "):
    return "\n".join(sep.join(f"{v:.9g}" for v in row) for row in np.column_stack(columns)) + "\n"


def ascii_ply():
    faces = "".join(f"3 {a} {b} {c} 1\n" for a, b, c in FACES)
    return ply_header("ascii") + (rows(POINTS, NORMALS, np.full(4, 9), LABELS) + faces).encode()


def obj():
    text = "# a comment\nmtllib none.mtl\no thing\n"
    text += "".join(f"v {x} {y} {z}\n" for x, y, z in POINTS) + "vt 0 0\nvt 1 1\n"
    text += "".join(f"vn {x} {y} {z}\n" for x, y, z in NORMALS)
    return (text + "".join("f " + " ".join(f"{v + 1}/{v % 2 + 1}/{v + 1}" for v in f) + "\n" for f in FACES)).encode()


def binary_stl():
    # The last facet writes its zeros as −0: still the same points.
    corners = [POINTS[f].ravel() * 1.0 for f in FACES]
    corners[-1][corners[-1] == 0] = -0.0
    facets = b"".join(np.r_[np.zeros(3), c].astype("<f4").tobytes() + b"\0\0" for c in corners)
    return b"solid but binary".ljust(80) + struct.pack("<I", len(FACES)) + facets


def ascii_stl():
    text = "solid thing\n"
    for f in FACES:
        text += (
            "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in POINTS[f]) + "endloop\nendfacet\n"
        )
    return (text + "endsolid thing\n").encode()


def off():
    return (f"OFF\n# comment\n{len(POINTS)} {len(FACES)} 0\n" + rows(POINTS) + rows(np.full(4, 3), FACES)).encode()


def pcd_header(data):
    lines = ["# .PCD v0.7", "VERSION 0.7", "FIELDS x y z normal_x normal_y normal_z junk label", "SIZE 4 4 4 4 4 4 2 4"]
    lines += [
        "TYPE F F F F F F U U",
        "COUNT 1 1 1 1 1 1 3 1",
        "WIDTH 4",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        "POINTS 4",
        f"DATA {data}",
    ]
    return ("\n".join(lines) + "\n").encode()


def binary_pcd():
    packed = (struct.pack("<6f3HI", *p, *n, 1, 2, 3, label) for p, n, label in zip(POINTS, NORMALS, LABELS))
    return pcd_header("binary") + b"".join(packed)


def ascii_pcd():
    return pcd_header("ascii") + rows(POINTS, NORMALS, np.ones((4, 3)), LABELS).encode()


def lzf_literals(data):
    """Valid LZF that copies nothing: runs of at most 32 bytes behind their length."""
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def compressed_pcd():
    columns = [POINTS[:, k] for k in range(3)] + [NORMALS[:, k] for k in range(3)]
    data = b"".join(c.astype("<f4").tobytes() for c in columns) + bytes(24) + LABELS.astype("<u4").tobytes()
    # The 24 zero bytes of the junk field: one literal zero, then a copy of 23 bytes from one byte back, over itself.
    packed = lzf_literals(data[:96]) + bytes([0, 0]) + bytes([7 << 5, 23 - 9, 0]) + lzf_literals(data[120:])
    return pcd_header("binary_compressed") + struct.pack("<II", len(packed), len(data)) + packed


def csv(sep=",", header='x,"Y [m]",z,nx,ny,nz,name,label', end="\n"):
    lines = [header.replace(",", sep)] if header else []
    for p, n, label in zip(POINTS, NORMALS, LABELS):
        lines.append(sep.join([*(f"{v:.9g}" for v in (*p, *n)), "tom", str(label)]))
    return end.join([*lines, ""]).encode()


def gltf(*, inline=True):
    """Two nodes: the tetrahedron moved by (10, 0, 0) through its parent, and its points alone, doubled in size."""
    blob = (
        POINTS.astype("<f4").tobytes()
        + NORMALS.astype("<f4").tobytes()
        + FACES.astype("<u2").tobytes()
        + LABELS.astype("<u2").tobytes()
    )
    views = [(0, 48), (48, 48), (96, 24), (120, 8)]
    attributes = {"POSITION": 0, "NORMAL": 1, "_LABEL": 3}
    root = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [{"children": [1], "translation": [10, 0, 0]}, {"mesh": 0}, {"mesh": 1, "scale": [2, 2, 2]}, {"mesh": 1}],
        "meshes": [
            {"primitives": [{"attributes": attributes, "indices": 2}, {"attributes": attributes, "indices": 2}]},
            {"primitives": [{"attributes": attributes, "mode": 0}]},
        ],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": [{"buffer": 0, "byteOffset": o, "byteLength": n} for o, n in views],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 2, "componentType": 5123, "count": 12, "type": "SCALAR"},
            {"bufferView": 3, "componentType": 5123, "count": 4, "type": "SCALAR"},
        ],
    }
    if not inline:
        root["buffers"][0]["uri"] = "part.bin"
        return json.dumps(root).encode(), blob
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def write(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


ALL = {
    "ascii.ply": ascii_ply, "little.ply": lambda: binary_ply("<"), "big.ply": lambda: binary_ply(">"),
    "a.pcd": ascii_pcd, "b.pcd": binary_pcd, "c.pcd": compressed_pcd,
    "comma.csv": csv, "semicolon.csv": lambda: csv(";"), "blank.txt": lambda: csv(" ", "x,y,z,nx,ny,nz,name,label"),
    "tabs.xyz": lambda: csv("\t", "X,Y,Z,normal_x,normal_y,normal_z,who,scalar_Label"), "windows.CSV": lambda: csv(end="\r\n"),
    "bom.csv": lambda: b"\xef\xbb\xbf" + csv(),
    "comment.xyz": lambda: b"# made here\n" + csv(" ", "//X,Y,Z,Nx,Ny,Nz,name,Classification"),
}  # fmt: skip


@pytest.mark.parametrize("name", ALL)
def test_points_normals_and_labels_come_back(tmp_path, name):
    scan = load_scan(write(tmp_path, name, ALL[name]()))
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-7)
    np.testing.assert_array_equal(scan.labels, LABELS)
    assert scan.points.dtype == np.float64 and not scan.points.flags.writeable and not scan.labels.flags.writeable
    assert scan.name == name.rsplit(".", 1)[0] and scan.path == tmp_path / name


@pytest.mark.parametrize("name, content", [("m.obj", obj), ("m.off", off), ("b.stl", binary_stl), ("a.stl", ascii_stl)])
def test_meshes_give_their_vertices_in_order(tmp_path, name, content):
    scan = load_scan(write(tmp_path, name, content()))
    np.testing.assert_array_equal(scan.points, POINTS)
    if name == "m.obj":
        np.testing.assert_array_equal(scan.normals, NORMALS)
    if name.endswith("stl"):
        assert "12 corners are 4 different points" in scan.notes[0]


def on_tetrahedron(points):
    """Largest distance of points from the planes of their nearest faces, and whether they lie in the bounding box."""
    distance = np.inf
    for a, b, c in POINTS[FACES]:
        normal = np.cross(b - a, c - a)
        distance = np.minimum(distance, abs((points - a) @ normal) / np.linalg.norm(normal))
    inside = np.all((points >= POINTS.min(0) - 1e-6) & (points <= POINTS.max(0) + 1e-6))
    return distance.max() if inside else np.inf


@pytest.mark.parametrize(
    "name, content", [("m.obj", obj), ("m.off", off), ("b.stl", binary_stl), ("m.ply", lambda: binary_ply("<"))]
)
def test_surface_samples_lie_on_the_surface_and_follow_the_seed(tmp_path, name, content):
    path = write(tmp_path, name, content())
    scan, same, other = (load_scan(path, n_samples=500, random_state=s) for s in (1, 1, 2))
    assert scan.points.shape == (500, 3) and on_tetrahedron(scan.points) < 1e-6
    np.testing.assert_array_equal(scan.points, same.points)
    assert np.abs(scan.points - other.points).max() > 0.1
    if name == "m.ply":
        corner = np.linalg.norm(scan.points[:, None] - POINTS, axis=2).argmin(axis=1)
        assert np.mean(LABELS[corner] == scan.labels) > 0.75  # barycentric and Euclidean nearest differ a little
        np.testing.assert_allclose(np.linalg.norm(scan.normals, axis=1), 1.0)


def test_samples_are_uniform_by_area(tmp_path):
    text = "v 0 0 0\nv 3 0 0\nv 3 1 0\nv 0 1 0\nv 9 0 0\nv 10 0 0\nv 10 1 0\nv 9 1 0\nf 1 2 3 4\nf -4 -3 -2 -1\n"
    scan = load_scan(write(tmp_path, "two.obj", text), n_samples=8000)
    assert abs(np.mean(scan.points[:, 0] < 5) - 0.75) < 0.02
    assert abs(scan.points[scan.points[:, 0] < 5, 0].mean() - 1.5) < 0.05


def test_a_point_cloud_is_thinned_to_n_samples(tmp_path):
    points = np.random.default_rng(0).normal(size=(50, 3))
    np.save(tmp_path / "c.npy", points)
    scan = load_scan(tmp_path / "c.npy", n_samples=20, random_state=3)
    assert len(scan) == 20 and {tuple(p) for p in scan.points} <= {tuple(p) for p in points}
    assert len(load_scan(tmp_path / "c.npy", n_samples=80)) == 50


def test_npz_keys_and_mesh(tmp_path):
    np.savez(tmp_path / "a.npz", Vertices=POINTS.astype("f4"), faces=FACES, labels=LABELS.astype(float), vertex_normals=NORMALS)
    scan = load_scan(tmp_path / "a.npz")
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    np.testing.assert_array_equal(scan.normals, NORMALS)
    assert on_tetrahedron(load_scan(tmp_path / "a.npz", n_samples=50).points) < 1e-6
    np.savez(tmp_path / "b.npz", x=POINTS[:, 0], y=POINTS[:, 1], z=POINTS[:, 2])
    np.testing.assert_array_equal(load_scan(tmp_path / "b.npz").points, POINTS)


def test_npy_with_columns_and_with_fields(tmp_path):
    np.save(tmp_path / "six.npy", np.hstack([POINTS, NORMALS]))
    np.testing.assert_array_equal(load_scan(tmp_path / "six.npy").normals, NORMALS)
    fields = np.zeros(4, dtype=[("x", "f8"), ("y", "f8"), ("z", "f8"), ("label", "u1")])
    fields["x"], fields["y"], fields["z"], fields["label"] = *POINTS.T, LABELS
    np.save(tmp_path / "fields.npy", fields)
    scan = load_scan(tmp_path / "fields.npy")
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)


@pytest.mark.parametrize("extension", ["glb", "gltf"])
def test_gltf_applies_world_transforms(tmp_path, extension):
    if extension == "gltf":
        content, blob = gltf(inline=False)
        write(tmp_path, "part.bin", blob)
    else:
        content = gltf()
    scan = load_scan(write(tmp_path, f"scene.{extension}", content))
    # Two primitives that share their positions are there once; the node outside the scene is not there.
    np.testing.assert_allclose(scan.points, np.vstack([POINTS + [10, 0, 0], 2 * POINTS]))
    np.testing.assert_allclose(scan.normals, np.vstack([NORMALS, NORMALS]), atol=1e-7)
    np.testing.assert_array_equal(scan.labels, np.r_[LABELS, LABELS])
    sampled = load_scan(tmp_path / f"scene.{extension}", n_samples=50)
    assert on_tetrahedron(sampled.points - [10, 0, 0]) < 1e-5 and "8 triangles" in sampled.notes[-1]


def test_gltf_skins_stand_in_the_pose_of_the_file(tmp_path):
    root, blob = (json.loads(part) if k == 0 else part for k, part in enumerate(gltf(inline=False)))
    # Joint 4 has moved by (0, 5, 0) since the bind pose, joint 5 has turned by 180° about y; the mesh's own node does not count.
    bind = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
    joints = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype="u1")
    weights = np.array([[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [0, 0, 0, 0]], dtype="<f4")
    root["nodes"] += [{"translation": [0, 5, 0]}, {"rotation": [0, 1, 0, 0]}]
    root["nodes"][1]["skin"] = 0
    root["scenes"] = [{"nodes": [0, 4, 5]}]
    root["skins"] = [{"joints": [4, 5], "inverseBindMatrices": 4}]
    for data, component, kind in ((bind, 5126, "MAT4"), (joints, 5121, "VEC4"), (weights, 5126, "VEC4")):
        root["accessors"].append(
            {"bufferView": len(root["bufferViews"]), "componentType": component, "count": len(data), "type": kind}
        )
        root["bufferViews"].append({"buffer": 0, "byteOffset": len(blob), "byteLength": data.nbytes})
        blob += data.tobytes()
    root["buffers"][0]["byteLength"] = len(blob)
    for primitive in root["meshes"][0]["primitives"]:
        primitive["attributes"] |= {"JOINTS_0": 5, "WEIGHTS_0": 6}
    write(tmp_path, "part.bin", blob)
    scan = load_scan(write(tmp_path, "skin.gltf", json.dumps(root)))
    a, b, c, d = POINTS
    turned = [-1, 1, -1]
    np.testing.assert_allclose(
        scan.points, [a + [0, 5, 0], b * turned, (c + [0, 5, 0] + c * turned) / 2, d + [10, 0, 0]], atol=1e-6
    )
    np.testing.assert_allclose(scan.normals[1], NORMALS[1] * turned, atol=1e-6)


def test_gltf_strips_and_fans(tmp_path):
    root, blob = (json.loads(part) if k == 0 else part for k, part in enumerate(gltf(inline=False)))
    write(tmp_path, "part.bin", blob)
    for mode, triangles in ((5, 2), (6, 2), (4, 1)):
        root["meshes"][0]["primitives"] = [
            {"attributes": {"POSITION": 0}, "mode": mode},
            {"attributes": {"POSITION": 1}, "mode": 3},
        ]
        root["scenes"] = [{"nodes": [0]}]
        scan = load_scan(write(tmp_path, "s.gltf", json.dumps(root)), n_samples=10)
        assert f"surface of {triangles} triangle" in scan.notes[-1] and "lines" in scan.notes[0]
        assert on_tetrahedron(scan.points - [10, 0, 0]) < 1e-5


def test_real_glbs_show_the_meshes_where_the_scene_does(shared_rigs):
    hand = load_scan(shared_rigs / "webxr_hand" / "left.glb")
    assert hand.points.shape == (1360, 3) and 0.15 < np.ptp(hand.points, axis=0).max() < 0.25
    fox = load_scan(shared_rigs / "fox" / "Fox.glb")
    assert fox.points.shape == (1728, 3) and 150 < np.ptp(fox.points, axis=0).max() < 160


@pytest.mark.parametrize(
    "head", ["OFF4 1 0\n", "OFF 4 1 0\n", "# made here\n\nOFF\n# counts\n4 1 0\n", "COFF\n4 1\n", "NOFF\n4 1 0\n"]
)
def test_off_in_its_many_spellings(tmp_path, head):
    text = head + rows(POINTS, NORMALS, 255 * np.ones(4)) + "4 0 1 2 3 255 0 0 # red\n"
    scan = load_scan(write(tmp_path, "m.off", text))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert (scan.normals is not None) == head.startswith("NOFF")
    assert "2 triangles" in load_scan(tmp_path / "m.off", n_samples=9).notes[-1]


@pytest.mark.parametrize("order", ["<", ">", None])
def test_ply_with_mixed_polygons(tmp_path, order):
    polygons = [[0, 1, 2, 3], [0, 1, 2], [1, 2]]
    form = {"<": "binary_little_endian", ">": "binary_big_endian", None: "ascii"}[order]
    head = f"ply\nformat {form} 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    head += "element face 3\nproperty list uchar uint vertex_index\nelement edge 5\nproperty int odd\nend_header\n"
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    if order:
        body = square.astype(f"{order}f8").tobytes() + b"".join(struct.pack(f"{order}B{len(p)}I", len(p), *p) for p in polygons)
    else:
        body = (rows(square) + "".join(f"{len(p)} {' '.join(map(str, p))}\n" for p in polygons)).encode()
    path = write(tmp_path, "poly.ply", head.encode() + body)
    np.testing.assert_array_equal(load_scan(path).points, square)
    assert "2 triangles" not in load_scan(path, n_samples=9).notes[-1] and "3 triangles" in load_scan(path, n_samples=9).notes[-1]


def test_columns_without_names(tmp_path):
    unit = load_scan(write(tmp_path, "n.txt", rows(POINTS, NORMALS, LABELS)))
    np.testing.assert_array_equal(unit.normals, NORMALS)
    assert unit.labels is None and "One further column" in unit.notes[0]
    colours = load_scan(write(tmp_path, "c.txt", rows(POINTS, 100 * NORMALS)))
    np.testing.assert_array_equal(colours.points, POINTS)
    assert colours.normals is None and "3 further columns" in colours.notes[0]


@pytest.mark.parametrize("text", [",0,1,2\n0,1.5,2,3\n1,4,5,6.5\n", "0,1,2\n1.5,2,3\n4,5,6.5\n", "x;y;z\n1,5;2;3\n4;5;6,5\n"])
def test_data_frame_headers_and_decimal_commas(tmp_path, text):
    np.testing.assert_array_equal(load_scan(write(tmp_path, "p.csv", text)).points, [[1.5, 2, 3], [4, 5, 6.5]])


def test_text_labels_are_left_out_with_a_note(tmp_path):
    scan = load_scan(write(tmp_path, "p.csv", "x,y,z,label\n1,2,3,arm\n4,5,6,leg\n"))
    assert scan.labels is None and "'label'" in scan.notes[0]


def test_an_empty_cell_is_a_missing_value(tmp_path):
    path = write(tmp_path, "p.csv", "x,y,z\n1,2,3\n4,,6\n7,8,9\n")
    with pytest.raises(FileError, match="1 of 3 points .* first at index 1"):
        load_scan(path)
    np.testing.assert_array_equal(load_scan(path, drop_invalid=True).points, [[1, 2, 3], [7, 8, 9]])


def test_drop_invalid_takes_normals_labels_and_faces_along(tmp_path):
    broken = np.vstack([POINTS, [[np.nan, 0, 0], [np.inf, 1, 1]]])[[4, 0, 1, 5, 2, 3]]
    keep = np.array([1, 2, 4, 5])
    labels, normals = np.zeros(6, int), np.zeros((6, 3))
    labels[keep], normals[keep] = LABELS, NORMALS
    np.savez(tmp_path / "s.npz", points=broken, labels=labels, normals=normals, faces=np.vstack([keep[FACES], [[0, 1, 2]]]))
    with pytest.raises(
        FileError, match="2 of 6 points with a coordinate that is NaN or infinite, the first at index 0.*--drop-invalid"
    ):
        load_scan(tmp_path / "s.npz")
    scan = load_scan(tmp_path / "s.npz", drop_invalid=True)
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    np.testing.assert_array_equal(scan.normals, NORMALS)
    assert "2 of 6 points" in scan.notes[-1]
    assert on_tetrahedron(load_scan(tmp_path / "s.npz", drop_invalid=True, n_samples=99).points) < 1e-9


LIST_HEAD = "ply\nformat {form} 1.0\nelement vertex 4\nproperty list uchar short seen\nproperty float x\nproperty double y\n"
LIST_HEAD += "property float z\nproperty list uchar float shades\nproperty uchar label\n"


@pytest.mark.parametrize("lengths", [(2, 2, 2, 2), (0, 3, 1, 0)])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", [True, False])
def test_ply_vertices_with_lists(tmp_path, form, lengths, faces):
    order = ">" if "big" in form else "<"
    head = LIST_HEAD.format(form=form) + "element face 4\nproperty list uchar int vertex_indices\n" * faces + "end_header\n"
    text, data = "", b""
    for (x, y, z), label, n in zip(POINTS, LABELS, lengths):
        text += " ".join(map(str, [n, *range(n), x, y, z, n, *range(n), label])) + "\n"
        data += struct.pack(f"{order}B{n}hfdfB{n}fB", n, *range(n), x, y, z, n, *range(n), label)
    text += "".join(f"3 {a} {b} {c}\n" for a, b, c in FACES) * faces
    data += b"".join(struct.pack(f"{order}B3i", 3, *f) for f in FACES) * faces
    path = write(tmp_path, "lists.ply", head.encode() + (text.encode() if form == "ascii" else data))
    scan = load_scan(path)
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    if faces:
        assert on_tetrahedron(load_scan(path, n_samples=50).points) < 1e-6
    with pytest.raises(FileError, match="ends after 3 of 4 (vertex|face) rows|the (vertex|face) row 3"):
        load_scan(write(tmp_path, "cut.ply", path.read_bytes()[:-2]))


def test_the_first_of_two_columns_of_one_name_counts(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {a}\n" for a in "xxyz") + "end_header\n"
    np.testing.assert_array_equal(load_scan(write(tmp_path, "p.ply", head + "1 9 2 3\n4 9 5 6\n")).points, [[1, 2, 3], [4, 5, 6]])


def label_files(kind, first, second):
    """A scan of two points in three text formats whose labels are declared to be of one type and written as two words."""
    ply_kind = {"I": "int", "U": "uint", "F": "float"}[kind]
    head = "".join(f"property float {a}\n" for a in "xyz") + f"property {ply_kind} label\nend_header\n"
    rows = f"0 0 0 {first}\n1 0 0 {second}\n"
    return {
        "a.ply": "ply\nformat ascii 1.0\nelement vertex 2\n" + head + rows,
        "a.pcd": f"VERSION .7\nFIELDS x y z label\nSIZE 4 4 4 4\nTYPE F F F {kind}\nCOUNT 1 1 1 1\nPOINTS 2\nDATA ascii\n{rows}",
        "a.csv": "x y z label\n" + rows,
    }


@pytest.mark.parametrize("kind", ["I", "U", "F"])
@pytest.mark.parametrize(("first", "second"), [("1e30", "2"), ("nan", "2"), ("1.5", "2"), ("-inf", "3")])
def test_labels_that_are_no_whole_numbers_are_left_out_with_a_note(tmp_path, kind, first, second):
    for name, text in label_files(kind, first, second).items():
        scan = load_scan(write(tmp_path, name, text))
        assert scan.labels is None and "'label' are not whole numbers of at most 64 bits" in scan.notes[0], name


@pytest.mark.parametrize("kind", ["I", "U", "F"])
def test_labels_are_what_is_written_whatever_their_type(tmp_path, kind):
    for name, text in label_files(kind, "-5", "3e2").items():
        np.testing.assert_array_equal(load_scan(write(tmp_path, name, text)).labels, [-5, 300], err_msg=name)


def test_labels_beyond_64_bits_are_left_out_with_a_note(tmp_path):
    np.savez(tmp_path / "a.npz", points=POINTS, labels=np.array([1, 2, 3, 2**63], dtype=np.uint64))
    scan = load_scan(tmp_path / "a.npz")
    assert scan.labels is None and "at most 64 bits" in scan.notes[0]
    np.savez(tmp_path / "b.npz", points=POINTS, labels=np.array([1, 2, 3, 4], dtype=np.uint64))
    np.testing.assert_array_equal(load_scan(tmp_path / "b.npz").labels, [1, 2, 3, 4])


# ---- bad files ----


def huge_ascii_ply(count):
    head = "".join(f"property float {a}\n" for a in "xyz")
    return f"ply\nformat ascii 1.0\nelement vertex {count}\n{head}end_header\n{rows(POINTS)}"


NAN_PLY = ply_header("ascii", labels=False, faces=False) + rows(POINTS * [[1, np.nan, 1]], NORMALS, LABELS).encode()
EMPTY_PLY = b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"

BAD = {
    "short.ply": (lambda: ascii_ply()[:-30], "ends after 1 of 4 face rows.*truncated"),
    "cut.ply": (lambda: ascii_ply()[:-25], "the face row 1: '3 0 2'.*truncated"),
    "short2.ply": (lambda: ascii_ply()[: len(ply_header("ascii")) + 60], "truncated|cannot be read"),
    "short3.ply": (lambda: binary_ply("<")[:-40], "ends after 1 of 4 face rows.*truncated"),
    "short4.ply": (lambda: binary_ply(">")[: len(ply_header("binary_big_endian")) + 40], "ends after 1 of 4 vertex rows"),
    "short5.ply": (lambda: binary_ply("<")[:60], "end_header|header line"),
    "huge.ply": (lambda: binary_ply("<").replace(b"vertex 4", b"vertex 99999999999999"), "of 99999999999999 vertex rows"),
    "nan.ply": (lambda: NAN_PLY, "4 of 4 points.*first at index 0.*drop_invalid"),
    "empty.ply": (lambda: EMPTY_PLY, "empty cloud"),
    "novertex.ply": (lambda: b"ply\nformat ascii 1.0\nend_header\n", "without an element 'vertex'"),
    "noz.ply": (lambda: ascii_ply().replace(b"float z", b"float w"), "vertex properties x, y, w.*vertex properties x, y and z"),
    "odd.ply": (lambda: ascii_ply().replace(b"float z", b"quad z"), "header line 'property quad z'"),
    "form.ply": (lambda: ascii_ply().replace(b"ascii", b"morse"), "header line 'format morse"),
    "text.ply": (lambda: rows(POINTS), "does not start with 'ply'.*extension"),
    "words.ply": (lambda: ascii_ply().replace(b"1.5", b"one"), "'one'"),
    "range.ply": (lambda: ascii_ply().replace(b"3 0 1 2", b"3 0 1 4"), "face 0 with vertices out of range"),
    "huge3.ply": (lambda: huge_ascii_ply("99999999999999999999999"), "ends after 4 of 99999999999999999999999 vertex rows"),
    "digits.ply": (lambda: huge_ascii_ply("9" * 5000), "header line 'element vertex 999"),
    "index.ply": (lambda: ascii_ply().replace(b"3 0 1 2", b"3 0 1 " + b"9" * 30), "the face row 0"),
    "floats.ply": (lambda: binary_ply("<").replace(b"uchar int vert", b"uchar float vert"), "faces of .*float32"),
    "count.ply": (lambda: binary_ply("<").replace(b"list uchar", b"list float"), "header line 'property list float"),
    "lie.obj": (ascii_ply, "no vertices"),
    "bad.obj": (lambda: obj() + b"f 1 two 3\n", "line 18.*'f 1 two 3'"),
    "zero.obj": (lambda: obj() + b"f 0 1 2\n", "face 4 with vertices out of range"),
    "far.obj": (lambda: obj() + b"f 1 2 5\n", "face 4 with vertices out of range"),
    "short.obj": (lambda: b"v 1 2 3\nv 4 5", "line that cannot be read"),
    "short.stl": (lambda: binary_stl()[:-7], "announces 4 triangles.*truncated"),
    "tiny.stl": (lambda: b"abc", "a file of 3 bytes"),
    "asciishort.stl": (lambda: ascii_stl()[:-150], "without 'endsolid'"),
    "asciiword.stl": (lambda: ascii_stl().replace(b"1.5", b"one"), "'one'"),
    "lie.stl": (ascii_ply, "announces"),
    "lie.off": (ascii_ply, "does not start with 'OFF'"),
    "short.off": (lambda: off()[:-8], "ends after 3 of 4 faces.*truncated"),
    "cut.off": (lambda: off()[:-4], "face 3: '3 1'"),
    "short2.off": (lambda: off()[:40], "ends after 2 of 4 vertices|cannot be read"),
    "binary.off": (lambda: b"OFF BINARY\n" + bytes(40), "binary"),
    "counts.off": (lambda: b"OFF\nfour 4 0\n", "'four 4 0'.*numbers of vertices"),
    "range.off": (lambda: off().replace(b"3 0 1 2", b"3 0 1 4"), "face 0 with vertices out of range"),
    "index.off": (lambda: off().replace(b"3 0 1 2", b"3 0 1 " + b"9" * 30), "face 0: '3 0 1 999"),
    "vertices.off": (lambda: off().replace(b"4 4 0", b"9" * 30 + b" 4 0"), "ends after 8 of 9+ vertices"),
    "faces.off": (lambda: off().replace(b"4 4 0", b"4 " + b"9" * 30 + b" 0"), "ends after 4 of 9+ faces"),
    "points.pcd": (lambda: ascii_pcd().replace(b"POINTS 4", b"POINTS " + b"9" * 30), "ends after 4 of 9+ points"),
    "points2.pcd": (lambda: binary_pcd().replace(b"POINTS 4", b"POINTS " + b"9" * 30), "ends after 4 of 9+ points"),
    "points3.pcd": (lambda: compressed_pcd().replace(b"POINTS 4", b"POINTS " + b"9" * 30), "too short for its points"),
    "counts.pcd": (lambda: binary_pcd().replace(b"1 3 1", b"1 99999999999 1"), "the header"),
    "short.pcd": (lambda: ascii_pcd()[:-70], "ends after 2 of 4|cannot be read"),
    "short2.pcd": (lambda: binary_pcd()[:-40], "ends after 2 of 4 points"),
    "short3.pcd": (lambda: compressed_pcd()[:-5], "compressed block that is too short"),
    "broken.pcd": (lambda: compressed_pcd().replace(bytes([7 << 5, 14, 0]), bytes([7 << 5, 14, 200])), "does not unpack"),
    "noxyz.pcd": (lambda: ascii_pcd().replace(b"x y z", b"u v w"), "fields u, v, w.*x, y and z"),
    "odd.pcd": (lambda: ascii_pcd().replace(b"TYPE F", b"TYPE Q"), "the header"),
    "lie.pcd": (ascii_ply, "header line 'ply'.*extension"),
    "lie.xyz": (lambda: binary_ply("<"), "binary content"),
    "lie2.xyz": (ascii_ply, "x, y and z|first three columns"),
    "words.csv": (lambda: "x,y,z\n1,2,3\n4,five,6\n", "'five'.*row 2"),
    "ragged.xyz": (lambda: "1 2 3\n4 5\n", "cannot be read.*same number"),
    "two.txt": (lambda: "1 2\n3 4\n", "the first row '1, 2'"),
    "names.csv": (lambda: "a,b,c\n1,2,3\n", "a first line 'a, b, c'.*columns named x, y and z"),
    "text.csv": (lambda: "x,y,z\none,two,three\n", "numbers"),
    "headeronly.csv": (lambda: "x,y,z\n", "empty cloud"),
    "comments.txt": (lambda: "# nothing\n" * 300, "no row of numbers"),
    "lie.npy": (ascii_ply, "no NPY array.*extension"),
    "lie.npz": (ascii_ply, "NPZ"),
    "lie.glb": (ascii_ply, "starts with"),
    "lie.gltf": (ascii_ply, "broken JSON"),
    "short.glb": (lambda: gltf()[:-20], "truncated"),
    "zero.xyz": (lambda: "", "empty file"),
    "equal.xyz": (lambda: "1 2 3\n" * 5, r"5 points that are all equal, at \(1, 2, 3\)"),
    "scan.las": (lambda: "x", "extension '.las'.*.ply .obj.*PLY"),
    "scan": (lambda: "x", "without an extension"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_give_one_clear_error(tmp_path, name):
    content, words = BAD[name]
    path = write(tmp_path, name, content())
    with pytest.raises(FileError, match=words) as caught:
        load_scan(str(path))
    assert caught.value.argument == str(path)


def test_bad_arrays_in_files(tmp_path):
    np.save(tmp_path / "o.npy", np.array([{}, {}], dtype=object), allow_pickle=True)
    with pytest.raises(FileError, match="Python objects"):
        load_scan(tmp_path / "o.npy")
    np.savez(tmp_path / "o.npz", points=np.array([{}, {}], dtype=object))
    with pytest.raises(FileError, match="Python objects"):
        load_scan(tmp_path / "o.npz")
    np.savez(tmp_path / "k.npz", colour=POINTS, size=3)
    with pytest.raises(FileError, match="arrays called colour, size.*points, xyz"):
        load_scan(tmp_path / "k.npz")
    np.savez(tmp_path / "l.npz", points=POINTS, labels=LABELS[:3])
    with pytest.raises(FileError, match=r"labels of shape \(3,\).*\(4,\)"):
        load_scan(tmp_path / "l.npz")
    np.save(tmp_path / "t.npy", POINTS.T[:, :4].copy())
    with pytest.raises(FileError, match=r"shape \(3, 4\).*[Tt]ranspose"):
        load_scan(tmp_path / "t.npy")
    data = (tmp_path / "t.npy").read_bytes()
    with pytest.raises(FileError, match="truncated"):
        load_scan(write(tmp_path, "cut.npy", data[:-9]))
    data = (tmp_path / "l.npz").read_bytes()
    with pytest.raises(FileError, match="broken"):
        load_scan(write(tmp_path, "cut.npz", data[:-90]))


ROW = np.arange(4.0)
ODD_COLUMNS = {
    "lengths": ({"x": ROW, "y": ROW[:3], "z": ROW}, "arrays of different lengths .*x 4, y 3, z 4"),
    "text": ({"x": ROW.astype(str), "y": ROW, "z": ROW}, "arrays with <U32 values of shape .* in 'x'.*one number per point"),
    "complex": ({"x": ROW, "y": ROW + 1j, "z": ROW}, "complex128 values .* in 'y'"),
}


@pytest.mark.parametrize("case", ODD_COLUMNS)
def test_columns_that_are_no_columns(tmp_path, case):
    columns, words = ODD_COLUMNS[case]
    np.savez(tmp_path / "a.npz", **columns)
    with pytest.raises(FileError, match=words):
        load_scan(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("kind", "words"),
    [("U3", "fields with <U3"), ("2f4", r"shape \(3, 2\)"), ("c16", "complex128"), ("M8[s]", "datetime64"), ("?", "bool")],
)
def test_fields_that_are_no_numbers(tmp_path, kind, words):
    np.save(tmp_path / "a.npy", np.zeros(3, dtype=[("x", kind), ("y", "f4"), ("z", "f4")]))
    with pytest.raises(FileError, match=f"{words}.* in 'x'"):
        load_scan(tmp_path / "a.npy")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("odd"), r"content that cannot be read \(odd\).*complete PLY file"),
        (OverflowError("odd"), r"content that cannot be read \(odd\)"),
        (TypeError("odd"), r"content that cannot be read \(odd\)"),
        (IndexError("odd"), r"content that cannot be read \(odd\)"),
        (MemoryError(), "more than memory can hold"),
        (PermissionError(13, "Permission denied"), r"cannot be read \(Permission denied\)"),
    ],
)
def test_what_a_reader_does_not_foresee_is_one_clear_error(tmp_path, monkeypatch, error, words):
    def read(path):
        raise error

    monkeypatch.setitem(scans._READERS, ".ply", read)
    with pytest.raises(FileError, match=words):
        load_scan(write(tmp_path, "a.ply", ascii_ply()))


@pytest.mark.parametrize(("name", "words"), [("a" * 300 + ".ply", "too long"), ("a\0b.ply", "NUL"), ("a\0b.npy", "NUL")])
def test_names_that_no_file_has(name, words):
    with pytest.raises(FileError, match=words):
        load_scan(name)


@pytest.mark.parametrize("header", DAMAGED_HEADERS)
def test_damaged_npy_headers_are_one_clear_error(tmp_path, header):
    with pytest.raises(FileError, match=r"bad\.npy: got content that cannot be read.*truncated or damaged"):
        load_scan(write(tmp_path, "bad.npy", npy(header)))
    path = tmp_path / "bad.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("points.npy", npy(header))
    with pytest.raises(FileError, match=r"bad\.npz.*'points' cannot be unpacked"):
        load_scan(path)


@pytest.mark.filterwarnings("ignore")  # NumPy's, of headers that Python 2 may have written
def test_no_damage_to_an_npy_file_lets_a_library_error_out(tmp_path):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "good.npy", POINTS)
    good = (tmp_path / "good.npy").read_bytes()
    for _ in range(1500):
        path = write(tmp_path, "bad.npy", damaged(good, rng))
        try:
            load_scan(path)
        except FileError:
            pass


def test_missing_files_folders_and_odd_arguments(tmp_path):
    with pytest.raises(FileError, match="no such file"):
        load_scan(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(FileError, match="a folder"):
        load_scan(tmp_path / "folder.ply")
    with pytest.raises(InputError, match="path: got int"):
        load_scan(3)
    for odd in (0, -1, 2.5, True, 10**30):
        with pytest.raises(InputError, match="n_samples"):
            load_scan(write(tmp_path, "p.ply", ascii_ply()), n_samples=odd)
    with pytest.raises(FileError, match="no area"):
        load_scan(write(tmp_path, "flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), n_samples=10)


@pytest.mark.parametrize("extension", SCAN_EXTENSIONS)
def test_no_format_lets_a_library_error_out(tmp_path, extension):
    """Noise under every extension, and valid files cut at many places: only our own errors, or a Scan."""
    whole = {name.rsplit(".", 1)[1].lower(): make() for name, make in ALL.items()} | {
        "obj": obj(),
        "off": off(),
        "stl": ascii_stl(),
        "glb": gltf(),
    }
    data = whole.get(extension[1:], b"")
    rng = np.random.default_rng(0)
    contents = [rng.integers(256, size=300, dtype=np.uint8).tobytes(), bytes(500), b"\n" * 9, b"7", "é".encode() * 50]
    contents += [data[:k] for k in np.linspace(1, max(len(data) - 1, 1), 40).astype(int)]
    for content in contents:
        try:
            load_scan(write(tmp_path, f"noise{extension}", content))
        except FileError:
            pass


# ---- Scan and check_points ----


def test_check_points_takes_scans_lists_and_integers():
    scan = Scan(POINTS)
    assert check_points(scan) is scan.points
    np.testing.assert_array_equal(check_points([[0, 0, 1], [2, 3, 4]]), [[0, 0, 1], [2, 3, 4]])
    assert check_points(np.array([[1, 2, 3]])).shape == (1, 3)
    large = np.array([[1e308, 1e308, 1e308], [0, 0, 0]])
    np.testing.assert_array_equal(check_points(large), large)


@pytest.mark.parametrize(
    "points, words",
    [
        ([], "cloud: got an empty cloud"),
        (np.zeros((0, 3)), "empty cloud"),
        ([1.0, 2.0, 3.0], r"shape \(3,\)"),
        (np.zeros((5, 2)), r"shape \(5, 2\)"),
        (np.zeros((5, 6)), r"points\[:, :3\]"),
        (np.zeros((3, 50)), "Transpose"),
        (np.zeros((4, 5, 3)), "organised"),
        ([["a", "b", "c"]], "numbers"),
        ([[1, 2, 3], [4, 5]], "different lengths"),
        (np.zeros((4, 3), complex), "complex"),
        ([[0, 0, 0], [1, 2, np.nan], [np.inf, 0, 0]], "2 of 3 points .*first at index 1.*drop_invalid.*--drop-invalid"),
        (np.ones((9, 3)), r"9 points that are all equal, at \(1, 1, 1\)"),
        (None, "numbers"),
        ([[10**400, 0, 0], [1, 2, 3]], "whole numbers beyond double precision"),
    ],
)
def test_check_points_refuses(points, words):
    with pytest.raises(InputError, match=words) as caught:
        check_points(points, argument="cloud")
    assert caught.value.argument == "cloud"


def test_check_points_counts_after_dropping():
    points = np.vstack([POINTS, [[np.nan, 0, 0]]])
    np.testing.assert_array_equal(check_points(points, minimum=4, drop_invalid=True), POINTS)
    with pytest.raises(InputError, match="got 4 points after 1 with.*at least 5"):
        check_points(points, minimum=5, drop_invalid=True)
    with pytest.raises(InputError, match="got 4 points; expected at least 9"):
        check_points(POINTS, minimum=9)
    with pytest.raises(InputError, match="0 points after 2"):
        check_points(np.full((2, 3), np.nan), drop_invalid=True)


def test_scan_is_its_own_and_read_only():
    points, labels = POINTS.copy(), LABELS.copy()
    scan = Scan(points, labels=labels, name="s")
    points[:], labels[:] = 9, 9
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    with pytest.raises(ValueError):
        scan.points[0] = 1
    with pytest.raises(InputError, match="labels"):
        Scan(POINTS, labels=[0.5, 1, 2, 3])
    with pytest.raises(InputError, match="normals"):
        Scan(POINTS, normals=NORMALS[:2])


def test_a_read_only_view_of_what_others_write_to_is_copied():
    points, labels = POINTS.copy(), LABELS.copy()
    views = points.view(), labels.view()
    for view in views:
        view.flags.writeable = False
    scan = Scan(views[0], views[0], views[1])
    points[:], labels[:] = 9, 9
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.normals, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)


def test_a_read_only_array_of_its_own_is_not_copied():
    points = POINTS.copy()
    points.flags.writeable = False
    assert Scan(points).points is points


@pytest.mark.parametrize("again", [lambda scan: pickle.loads(pickle.dumps(scan)), copy.copy, copy.deepcopy])
def test_a_scan_stays_read_only_when_it_travels(again):
    scan = again(Scan(POINTS, NORMALS, LABELS, name="s", notes=("n",)))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert (scan.name, scan.notes, again(Scan(POINTS)).labels) == ("s", ("n",), None)
    for array in (scan.points, scan.normals, scan.labels):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("n", [0, -1, 2.5, True, "3", None])
def test_thinned_wants_a_count(n):
    with pytest.raises(InputError, match="n: got .*a positive whole number of points"):
        Scan(POINTS).thinned(n)


def test_thinned_is_a_sorted_subset_by_seed():
    scan = Scan(np.random.default_rng(0).normal(size=(1000, 3)))
    rows = scan.thinned(100, 5)
    assert len(rows) == 100 and np.all(np.diff(rows) > 0) and rows[-1] < 1000
    np.testing.assert_array_equal(rows, scan.thinned(100, 5))
    assert not np.array_equal(rows, scan.thinned(100, 6))
    np.testing.assert_array_equal(scan.thinned(2000), np.arange(1000))
    often = np.bincount(np.concatenate([scan.thinned(100, s) for s in range(200)]), minlength=1000)
    assert often.min() > 2 and often.max() < 45  # 20 ± 4.2 each
