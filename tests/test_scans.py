"""Scans in files: every format gives back what was written."""

import json
import re
import struct

import numpy as np
import pytest
import trimesh
from scan_files import (
    ALL,
    FACES,
    LABELS,
    NORMALS,
    POINTS,
    ascii_ply,
    ascii_stl,
    binary_ply,
    binary_stl,
    gltf,
    obj,
    off,
    on_tetrahedron,
    rows,
    write,
)

from lbsfit_np.errors import FileError
from lbsfit_np.io.scans import load_mesh, load_scan


@pytest.mark.parametrize("name", ALL)
def test_points_normals_and_labels_come_back(tmp_path, name):
    scan = load_scan(write(tmp_path, name, ALL[name]()))
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-7)
    np.testing.assert_array_equal(scan.labels, LABELS)
    assert scan.points.dtype == np.float64 and not scan.points.flags.writeable and not scan.labels.flags.writeable
    assert scan.name == name.rsplit(".", 1)[0] and scan.path == tmp_path / name


def not_binary():
    """An OFF file that only mentions the word."""
    return b"OFF\n# not BINARY" + off()[3:]


@pytest.mark.parametrize(
    "name, content",
    [("m.obj", obj), ("m.off", off), ("no.off", not_binary), ("b.stl", binary_stl), ("a.stl", ascii_stl)],
)
def test_meshes_give_their_vertices_in_order(tmp_path, name, content):
    scan = load_scan(write(tmp_path, name, content()))
    np.testing.assert_array_equal(scan.points, POINTS)
    if name == "m.obj":
        np.testing.assert_array_equal(scan.normals, NORMALS)
    if name.endswith("stl"):
        assert "12 corners share 4 different points" in scan.notes[0]


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
    few = load_scan(tmp_path / "c.npy", n_samples=80)
    assert len(few) == 50 and few.notes == ("It has 50 points, fewer than the 80 asked for: all are taken.",)
    assert not load_scan(tmp_path / "c.npy", n_samples=50).notes


def test_npz_keys_and_mesh(tmp_path):
    np.savez(tmp_path / "a.npz", Vertices=POINTS.astype("f4"), faces=FACES, labels=LABELS.astype(float), vertex_normals=NORMALS)
    scan = load_scan(tmp_path / "a.npz")
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.labels, LABELS)
    np.testing.assert_array_equal(scan.normals, NORMALS)
    assert on_tetrahedron(load_scan(tmp_path / "a.npz", n_samples=50).points) < 1e-6
    np.savez(tmp_path / "c.npz", points=POINTS, label=3)  # of the whole object, as sets for classification have it
    scan = load_scan(tmp_path / "c.npz")
    assert scan.labels is None and scan.notes == ("'label' is one value for all points: labels left out.",)
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


@pytest.mark.parametrize("fine, uneven", [(0.0, False), (1.0, False), (0.2, True)])
def test_vertices_that_lie_unevenly_are_told(tmp_path, fine, uneven):
    """As those of a face on an artist's body: a square whose left ``fine`` has 9 of 10 columns of vertices."""
    x = np.linspace(0, 1, 20) if fine in (0.0, 1.0) else np.r_[np.linspace(0, fine, 18), np.linspace(fine, 1, 3)[1:]]
    u, v = (axis.ravel() for axis in np.meshgrid(x, x, indexing="ij"))
    corner = (20 * np.arange(19)[:, None] + np.arange(19)).ravel()
    faces = np.vstack([corner[:, None] + [0, 1, 20], corner[:, None] + [1, 21, 20]])
    lines = [f"v {a} {b} 0" for a, b in zip(u, v)] + ["f {} {} {}".format(*face) for face in 1 + faces]
    path = write(tmp_path, "square.obj", "\n".join(lines))
    told = [note for note in load_scan(path).notes if "unevenly" in note]
    assert bool(told) == uneven and all("--samples" in note for note in told)
    assert not any("unevenly" in note for note in load_scan(path, n_samples=100).notes)
    # Not of a cloud with some faces, whose other points no sample would have.
    loose = [f"v {a} 0 1" for a in np.linspace(0, 1, 30)]
    path = write(tmp_path, "loose.obj", "\n".join([*lines, *loose]))
    assert not any("unevenly" in note for note in load_scan(path).notes)


def test_a_floor_does_not_make_vertices_uneven(tmp_path):
    """Two large triangles, which nearly all samples would be of."""
    solid = trimesh.creation.icosphere(3)
    m = len(solid.vertices)
    floor = np.array([[-9.0, -1, -9], [9, -1, -9], [9, -1, 9], [-9, -1, 9]])
    vertices = np.vstack([solid.vertices, floor])
    faces = np.vstack([solid.faces, [[m, m + 1, m + 2], [m, m + 2, m + 3]]])
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "floor.ply")
    scan = load_scan(tmp_path / "floor.ply")
    assert len(scan.points) == m + 4 and not any("unevenly" in note for note in scan.notes)


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


@pytest.mark.parametrize(
    ("word", "columns", "known"),
    [
        ("CSTOFF", "pc", False),
        ("off", "p", False),
        ("NCOFF", "pcn", True),  # as MeshLab writes it
        ("CNOFF", "pnc", True),
        ("STCNOFF", "pncs", True),
        ("NCOFF", "pc", False),
    ],
)
def test_off_with_colours_and_normals(tmp_path, word, columns, known):
    of = {"p": POINTS, "n": NORMALS, "c": np.full((4, 4), 200), "s": np.full((4, 2), 0.5)}
    text = f"{word}\n4 1 0\n" + rows(*[of[c] for c in columns]) + "3 0 1 2\n"
    scan = load_scan(write(tmp_path, "m.off", text))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert (scan.normals is not None) == known
    if known:
        np.testing.assert_array_equal(scan.normals, NORMALS)


MARK = b"\xef\xbb\xbf"


@pytest.mark.parametrize(
    "name, text",
    [
        ("m.obj", obj()),
        ("m.off", off()),
        ("p.xyz", rows(POINTS)),
        ("p.csv", rows(POINTS, sep=";").replace(".", ",")),
        ("p.txt", "x y z\n" + rows(POINTS)),
        ("p.xyz", "# gemessen in Å\n" + rows(POINTS)),
        ("s.stl", ascii_stl()),
    ],
)
def test_a_mark_of_utf_8_is_no_part_of_the_text(tmp_path, name, text):
    """Some editors write it; a vertex in the first line of an OBJ was lost for it, and all faces moved by one."""
    text = text if isinstance(text, bytes) else text.encode()
    if name == "m.obj":
        text = text[text.index(b"v ") :]
    plain, marked = load_scan(write(tmp_path, name, text)), load_scan(write(tmp_path, "marked-" + name, MARK + text))
    np.testing.assert_array_equal(marked.points, plain.points)
    if name != "p.csv":
        np.testing.assert_array_equal(marked.points[:4], POINTS[:4])


@pytest.mark.parametrize(
    "change",
    [
        bytes.upper,
        lambda t: b" \n " + t,
        *(lambda t, n=n: re.sub(rb"solid\b[^\n]*", b"solid " + n, t) for n in (b"vertex group", b"Solid1", b"solid")),
        *(lambda t, n=n: MARK + re.sub(rb"solid\b[^\n]*", b"solid " + n, t) for n in (b"vertex", b"facet vertex", b"")),
        lambda t: t.replace(b"\n", b" "),
        lambda t: t.replace(b"\n", b"\r"),
        lambda t: (t + t).replace(b"solid", b"solid my facet normal vertex").replace(b"\n", b" "),
    ],
)
def test_ascii_stl_in_its_many_spellings(tmp_path, change):
    text = ascii_stl()
    text = text if isinstance(text, bytes) else text.encode()
    plain, other = load_scan(write(tmp_path, "a.stl", text)), load_scan(write(tmp_path, "b.stl", change(text)))
    np.testing.assert_array_equal(other.points, plain.points)


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


@pytest.mark.parametrize("order", ["<", ">", None])
@pytest.mark.parametrize(
    "strips",
    [
        [[0, 1, 2, 3, 0, 1]],
        [[0, 1, 2, -1, 1, 3, 2, -1, 0, 2, 3, -1, 0, 3, 1, -1]],
        [[], [0, 1, 2, 3, 0], [0], [3, 3, 0, 1, -1, 2]],  # corners twice in a row, and strips of no triangle
    ],
)
def test_ply_with_triangle_strips(tmp_path, order, strips):
    form = {"<": "binary_little_endian", ">": "binary_big_endian", None: "ascii"}[order]
    head = f"ply\nformat {form} 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    head += f"element tristrips {len(strips)}\nproperty list int int vertex_indices\nend_header\n"
    if order:
        body = POINTS.astype(f"{order}f8").tobytes() + b"".join(struct.pack(f"{order}{len(s) + 1}i", len(s), *s) for s in strips)
    else:
        body = (rows(POINTS) + "".join(" ".join(map(str, [len(s), *s])) + "\n" for s in strips)).encode()
    faces = load_mesh(write(tmp_path, "strips.ply", head.encode() + body))[1]
    from_least = [sorted(tuple(np.roll(f, -np.argmin(f)).tolist()) for f in some) for some in (faces, FACES)]
    assert from_least[0] == from_least[1]


@pytest.mark.parametrize("order", ["<", ">", None])
@pytest.mark.parametrize("kind", ["material", "edge"])
def test_ply_with_other_elements_before_its_faces(tmp_path, order, kind):
    form = {"<": "binary_little_endian", ">": "binary_big_endian", None: "ascii"}[order]
    head = f"ply\nformat {form} 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    head += f"element {kind} 2\nproperty int a\n" + ("property list uchar int b\n" if kind == "edge" else "")
    head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    others = [[3, 2, 1, 2], [0, 1, 2]] if kind == "edge" else [[0], [3]]
    if order:
        body = POINTS.astype(f"{order}f8").tobytes()
        body += b"".join(struct.pack(f"{order}i" + (f"B{o[1]}i" if o[1:] else ""), *o) for o in others)
        body += b"".join(struct.pack(f"{order}B3i", 3, *f) for f in FACES)
    else:
        body = (rows(POINTS) + "".join(" ".join(map(str, o)) + "\n" for o in others) + rows(np.full(4, 3), FACES)).encode()
    vertices, faces = load_mesh(write(tmp_path, "m.ply", head.encode() + body))
    np.testing.assert_array_equal(vertices, POINTS)
    np.testing.assert_array_equal(faces, FACES)


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


def test_faces_of_a_ply_that_are_called_otherwise_are_told_of(tmp_path):
    known = ascii_ply()
    assert not load_scan(write(tmp_path, "a.ply", known)).notes
    (note,) = load_scan(write(tmp_path, "b.ply", known.replace(b"vertex_indices", b"corners"))).notes
    assert note == "The element 'face' has corners, material, not a list called vertex_indices: left out."


def test_a_cloud_with_a_triangle_is_no_mesh_to_sample(tmp_path):
    """Such as one beside a marker; of a mesh that was cropped, what is left out is said."""
    cloud = np.random.default_rng(0).normal(size=(300, 3)).round(3)
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in cloud)
    path = write(tmp_path, "c.obj", (text + "f 1 2 3\n").encode())
    scan = load_scan(path, n_samples=200)
    assert len(scan.points) == 200 and {tuple(p) for p in scan.points} <= {tuple(p) for p in cloud}
    assert "297 of its 300 points are in no triangle: it is taken for a point cloud." in scan.notes
    taken = scan.notes[0]
    assert load_scan(path, n_samples=300).notes == (taken,)
    assert load_scan(path, n_samples=400).notes == (taken, "It has 300 points, fewer than the 400 asked for: all are taken.")
    faces = "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, 190))
    scan = load_scan(write(tmp_path, "m.obj", (text + faces).encode()), n_samples=200)
    assert "109 of its 300 points are in no triangle: left out." in scan.notes
    assert "200 points sampled from the surface of 189 triangles." in scan.notes


def test_lines_that_go_on_and_bytes_behind_the_last_triangle(tmp_path):
    before, face, after = obj().partition(b"\nf ")
    text = before + face + after.replace(b" ", b" \\\n", 1)
    np.testing.assert_array_equal(load_mesh(write(tmp_path, "a.obj", text))[1], FACES)
    np.testing.assert_array_equal(load_scan(write(tmp_path, "a.stl", binary_stl() + b"\0\0")).points, POINTS)
    with pytest.raises(FileError, match="announces 4 triangles"):
        load_scan(write(tmp_path, "a.stl", binary_stl() + bytes(50)))
    ascii_one = ascii_stl()  # four bytes of which, read as a number, could be that of triangles that nearly fill it
    n = (len(ascii_one) - 84) // 50
    count = struct.pack("<I", n)
    head = ascii_one.index(b"\n") + 1
    odd = ascii_one[: head - 1] + b" " * (80 - head + 1) + count + b"\n" + ascii_one[head:]
    odd = odd[:80] + struct.pack("<I", (len(odd) - 85) // 50) + odd[84:]
    np.testing.assert_array_equal(load_scan(write(tmp_path, "b.stl", odd)).points, POINTS)


@pytest.mark.parametrize("line", ["# exported from C:\\Users\\me\\", "o a\\", "mtllib C:\\x\\", ""])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_names_that_end_in_a_backslash_are_names(line, end, tmp_path):
    text = obj().decode().replace("\n", end)
    mesh = load_mesh(write(tmp_path, "a.obj", (line + end + text).encode()))
    np.testing.assert_array_equal(mesh[0], POINTS)
    np.testing.assert_array_equal(mesh[1], FACES)
    cropped = obj().decode() + "".join(f"v {k} 0 9\n" for k in range(12))
    notes = load_scan(write(tmp_path, "b.obj", cropped.encode()), n_samples=30).notes
    assert "12 of its 16 points are in no triangle: left out." in notes
