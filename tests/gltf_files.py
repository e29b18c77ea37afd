"""A small glTF 2.0 writer for tests, rigs with known truth to write with it, and the check of what is read."""

import base64
import json
import struct
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from lbsfit_np.rig.regressor import regressor_from_weights
from lbsfit_np.rig.rig import Rig

CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (2, 2): "MAT2", (3, 3): "MAT3", (4, 4): "MAT4"}


class GltfWriter:
    """Collects JSON objects and binary data; every ``add`` returns the index of what it added."""

    def __init__(self):
        self.json, self.binary = {"asset": {"version": "2.0"}}, bytearray()

    def add(self, key, **fields):
        self.json.setdefault(key, []).append(fields)
        return len(self.json[key]) - 1

    def view(self, data, **fields):
        self.binary.extend(b"\0" * (-len(self.binary) % 4))
        start = len(self.binary)
        self.binary.extend(data)
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data), **fields)

    def accessor(self, array, dtype="f4", *, gap=0, **fields):
        """Store an array as one element per row; ``gap`` bytes are left between elements (byteStride)."""
        array = np.asarray(array).astype("<" + dtype)
        kind = KINDS[array.shape[1:]]
        rows = np.swapaxes(array, 1, 2) if array.ndim == 3 else array.reshape(len(array), 1, -1)
        element = []
        for columns in rows:
            parts = [c.tobytes() for c in columns]
            if array.ndim == 3:
                parts = [p + b"\xee" * (-len(p) % 4) for p in parts]
            element.append(b"".join(parts))
        size = len(element[0]) if element else 0
        stride = {"byteStride": size + gap} if gap else {}
        view = self.view(b"".join(e + b"\xee" * gap for e in element), **stride)
        return self.add("accessors", bufferView=view, componentType=CODES[dtype], count=len(array), type=kind, **fields)

    def animation(self, channels, name="move"):
        """``channels``: list of (node, path, times, values, interpolation)."""
        samplers, targets = [], []
        for k, (node, path, times, values, interpolation) in enumerate(channels):
            samplers.append({"input": self.accessor(times), "output": self.accessor(values), "interpolation": interpolation})
            targets.append({"sampler": k, "target": {"node": node, "path": path}})
        return self.add("animations", name=name, samplers=samplers, channels=targets)

    def glb(self, *, extra_chunk=False):
        root = dict(self.json)
        if self.binary:
            root["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(root).encode()
        chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", bytes(self.binary) + b"\0" * (-len(self.binary) % 4))]
        if extra_chunk:
            chunks.append((b"XTRA", b"whatever"))
        body = b"".join(struct.pack("<I4s", len(data), kind) + data for kind, data in chunks)
        return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body

    def save(self, path, uri=None, stored_as=None):
        """Write .glb, or .gltf with its buffer at ``uri``; ``uri="data:"`` puts it inside."""
        if path.suffix == ".glb":
            path.write_bytes(self.glb())
            return path
        if uri == "data:":
            uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.binary)).decode()
        else:
            uri = uri or path.stem + ".bin"
            target = path.parent / (stored_as or uri)
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(bytes(self.binary))
        path.write_text(json.dumps({**self.json, "buffers": [{"byteLength": len(self.binary), "uri": uri}]}), encoding="utf-8")
        return path


@dataclass
class Arm:
    """A square arm along x with a root, three joints in a chain and a side branch; frames turned this way and that.

    All in the space of the armature: vertices (m, 3), faces, weights (m, J) dense, and rigid joint matrices (J, 4, 4).
    """

    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    parents: np.ndarray
    matrices: np.ndarray
    names: tuple = ("root", "upper", "lower", "tip", "side")

    @property
    def local(self):
        """Matrices relative to the parent."""
        up = [np.eye(4) if p < 0 else self.matrices[p] for p in self.parents]
        return np.linalg.inv(up) @ self.matrices


def make_arm():
    rng = np.random.default_rng(5)
    rings = np.linspace(0.0, 1.5, 16)
    square = np.array([[0.0, -1.0, -1.0], [0.0, 1.0, -1.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]]) * [0.0, 0.1, 0.07]
    vertices = np.concatenate([square * (1 + 0.3 * np.sin(3 * x)) + [x, 0.02 * x, 0.0] for x in rings])
    faces = []
    for r in range(len(rings) - 1):
        for k in range(4):
            a, b, c, d = 4 * r + k, 4 * r + (k + 1) % 4, 4 * r + 4 + k, 4 * r + 4 + (k + 1) % 4
            faces += [[a, b, c], [b, d, c]]
    faces += [[0, 2, 1], [0, 3, 2], [60, 61, 62], [60, 62, 63]]
    at = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.7, 0.02, 0], [1.2, 0.02, 0], [0.5, 0.08, 0.05]])
    ramps = np.clip((vertices[:, :1] - at[:4, 0]) / 0.1 + 0.5, 0, 1)
    ramps[:, 0] = 1.0
    weights = np.zeros((len(vertices), 5))
    weights[:, :4] = ramps - np.column_stack([ramps[:, 1:], np.zeros(len(vertices))])
    side = 0.3 * weights[:, 1] * (vertices[:, 1] > 0)
    weights[:, 4], weights[:, 1] = side, weights[:, 1] - side
    matrices = np.tile(np.eye(4), (5, 1, 1))
    matrices[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(5, 3))).as_matrix()
    matrices[:, :3, 3] = at
    return Arm(vertices, np.array(faces), weights, np.array([-1, 0, 1, 2, 1]), matrices)


def trs(matrix):
    """The node fields of a matrix: translation, rotation, scale (a reflection in x)."""
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    scale[0] *= np.sign(np.linalg.det(matrix[:3, :3]))
    rotation = Rotation.from_matrix(matrix[:3, :3] / scale).as_quat()
    return {"translation": matrix[:3, 3].tolist(), "rotation": rotation.tolist(), "scale": scale.tolist()}


def affine(rotvec=(0, 0, 0), scale=1.0, translation=(0, 0, 0)):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix() * scale
    out[:3, 3] = translation
    return out


def top_four(weights):
    """JOINTS_n and WEIGHTS_n arrays, [(m, 4), (m, 4)] a set, largest weights first."""
    order = np.argsort(-weights, axis=1, kind="stable")
    values = np.take_along_axis(weights, order, axis=1)
    wide = -(-weights.shape[1] // 4) * 4
    order = np.pad(order, ((0, 0), (0, wide - weights.shape[1])))
    values = np.pad(values, ((0, 0), (0, wide - weights.shape[1])))
    order[values == 0] = 0
    sets = [(order[:, k : k + 4], values[:, k : k + 4]) for k in range(0, wide, 4)]
    return [s for k, s in enumerate(sets) if k == 0 or s[1].any()]


def write_arm(arm, *, armature=None, armature_T_bind=None, posed=None, order=None, inverse_bind=True, joints_dtype="u1"):
    """A writer that holds the arm: an "Armature" node with the joints' nodes and a mesh node below it.

    ``armature``: the Armature node's matrix; ``armature_T_bind``: the mesh is stored in a bind space that this brings to the
    armature's; ``posed``: (J, 3) rotation vectors in the joints' frames that the nodes are posed by; ``order``: the order in
    which nodes are written (a permutation of the joints).
    """
    armature = np.eye(4) if armature is None else armature
    X = np.eye(4) if armature_T_bind is None else armature_T_bind
    g, J = GltfWriter(), len(arm.parents)
    order = list(range(J)) if order is None else list(order)
    node = {j: k for k, j in enumerate(order)}
    local = arm.local.copy()
    if posed is not None:
        local[:, :3, :3] = local[:, :3, :3] @ Rotation.from_rotvec(posed).as_matrix()
    for j in order:
        children = [node[c] for c in range(J) if arm.parents[c] == j]
        g.add("nodes", name=arm.names[j], **trs(local[j]), **({"children": children} if children else {}))
    inside = arm.vertices @ np.linalg.inv(X)[:3, :3].T + np.linalg.inv(X)[:3, 3]
    attributes = {"POSITION": g.accessor(inside)}
    for n, (joints, weights) in enumerate(top_four(arm.weights)):
        attributes[f"JOINTS_{n}"] = g.accessor(joints, joints_dtype)
        attributes[f"WEIGHTS_{n}"] = g.accessor(weights)
    indices = g.accessor(arm.faces.reshape(-1), "u2")
    mesh = g.add("meshes", primitives=[{"attributes": attributes, "indices": indices}])
    skin = {"joints": [node[j] for j in range(J)], "name": "arm"}
    if inverse_bind:
        skin["inverseBindMatrices"] = g.accessor(np.linalg.inv(arm.matrices) @ X)
    g.add("skins", **skin)
    shown = g.add("nodes", name="Mesh", mesh=mesh, skin=0)
    roots = [node[j] for j in range(J) if arm.parents[j] < 0]
    top = g.add("nodes", name="Armature", matrix=armature.T.reshape(-1).tolist(), children=[*roots, shown])
    g.add("scenes", nodes=[top])
    g.json["scene"] = 0
    return g


ARM = make_arm()
TILTED = affine((-np.pi / 2, 0, 0), 0.01, (0.2, 0.1, -0.3))  # a z-up skeleton in centimetres
# Root and all, turned this way and that: the last joints by more than 100°.
POSED = np.array([[0.3, -0.5, 0.4], [1.2, 0.4, -0.8], [0.9, -1.9, 0.5], [0.2, 0.1, 2.1], [-0.7, 0.3, 0.2]])
Z_UP = affine((np.pi / 2, 0.0, 0.0), 0.02, (0.1, 0.2, 0.3))
POINTS = np.random.default_rng(0).normal(size=(7, 3)).astype("f4").astype(float)
ANGLES = np.random.default_rng(3).normal(size=(4, 5, 3)) * 0.7
TIMES = np.array([0.0, 0.5, 0.75, 2.0])


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


def save(writer, tmp_path, name="arm.glb", **options):
    return writer.save(tmp_path / name, **options)


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
