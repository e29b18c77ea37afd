"""A tetrahedron in every format of scans, written here byte by byte."""

import json
import struct

import numpy as np

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


# Those that carry normals and labels: file name → its content.
ALL = {
    "ascii.ply": ascii_ply, "little.ply": lambda: binary_ply("<"), "big.ply": lambda: binary_ply(">"),
    "a.pcd": ascii_pcd, "b.pcd": binary_pcd, "c.pcd": compressed_pcd,
    "comma.csv": csv, "semicolon.csv": lambda: csv(";"), "blank.txt": lambda: csv(" ", "x,y,z,nx,ny,nz,name,label"),
    "tabs.xyz": lambda: csv("\t", "X,Y,Z,normal_x,normal_y,normal_z,who,scalar_Label"), "windows.CSV": lambda: csv(end="\r\n"),
    "bom.csv": lambda: b"\xef\xbb\xbf" + csv(),
    "comment.xyz": lambda: b"# made here\n" + csv(" ", "//X,Y,Z,Nx,Ny,Nz,name,Classification"),
}  # fmt: skip


def on_tetrahedron(points):
    """Largest distance of points from the planes of their nearest faces, and whether they lie in the bounding box."""
    distance = np.inf
    for a, b, c in POINTS[FACES]:
        normal = np.cross(b - a, c - a)
        distance = np.minimum(distance, abs((points - a) @ normal) / np.linalg.norm(normal))
    inside = np.all((points >= POINTS.min(0) - 1e-6) & (points <= POINTS.max(0) + 1e-6))
    return distance.max() if inside else np.inf
