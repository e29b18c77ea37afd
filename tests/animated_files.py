"""Animations as files: made-up fits to write, and a viewer that goes by the specification alone."""

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

import lbsfit_np as lbs
from lbsfit_np.fitting.result import FitResult

_TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": (), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}


def a_fit(rig, seed, *, amount=0.02, rest_joints=None, subject=""):
    """A fit with random numbers of a rig, as fitting would put it together."""
    rng = np.random.default_rng(seed)
    J, m = rig.joints.shape[0], len(rig.vertices)
    pose = rng.uniform(rig.lower, rig.upper)
    pose[rig.root] = rng.normal(size=3)
    translation, scale = rng.normal(size=3), float(rng.uniform(0.8, 1.2))
    offsets = amount * rig.size * rng.normal(size=(m, 3))
    joints = rig.joints + amount * rig.size * rng.normal(size=(J, 3)) if rest_joints is None else rest_joints
    posed = pose, translation, scale, offsets
    return FitResult(
        pose=pose, translation=translation, scale=scale, offsets=offsets, rest_joints=joints,
        vertices=rig.pose(*posed, joints=joints), joints=rig.pose_joints(*posed, joints=joints), joint_std=np.zeros(J),
        labels=np.zeros(5, int), confidence=np.ones(5), left_out=np.zeros(5, bool), took_part=np.ones(5, bool),
        term_labels=np.zeros(5, int), terms={}, converged=True, status="ok", message="", probability=1.0, evidence={},
        evaluations=1, seconds=0.0, parts=rig.parts, rig_digest=rig.digest, subject=subject,
    )  # fmt: skip


def save(path, rig, results, **options):
    """In the scans' own unit, unless told otherwise."""
    return lbs.save_animation(path, rig, results, **{"metres_per_unit": 1.0} | options)


class Viewer:
    """Draws a file by the rules of the specification, with nothing of the package."""

    def __init__(self, path):
        data = path.read_bytes()
        magic, version, length = struct.unpack_from("<4sII", data)
        assert (magic, version, length) == (b"glTF", 2, len(data))
        n, kind = struct.unpack_from("<I4s", data, 12)
        self.root = json.loads(data[20 : 20 + n])
        size, second = struct.unpack_from("<I4s", data, 20 + n)
        assert kind == b"JSON" and second == b"BIN\0" and n % 4 == size % 4 == 0 and 28 + n + size == length
        self.binary = data[28 + n :]
        assert self.root["buffers"] == [{"byteLength": size}]
        self.parents = {c: p for p, node in enumerate(self.root["nodes"]) for c in node.get("children", ())}
        (self.animation,) = self.root.get("animations", [None])
        (self.skin,) = self.root["skins"]
        (self.mesh,) = self.root["meshes"]
        (self.primitive,) = self.mesh["primitives"]
        self.times = self.array(self.animation["samplers"][0]["input"]) if self.animation else None

    def array(self, index):
        a = self.root["accessors"][index]
        view = self.root["bufferViews"][a["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        width = _WIDTHS[a["type"]]
        count = a["count"] * int(np.prod(width, dtype=int))
        out = np.frombuffer(self.binary, _TYPES[a["componentType"]], count, view["byteOffset"]).reshape(a["count"], *width)
        assert out.nbytes == view["byteLength"]
        for name, of in (("min", np.min), ("max", np.max)):
            if name in a:
                np.testing.assert_array_equal(np.float32(a[name]), of(out, axis=0))
        return np.swapaxes(out, 1, 2) if a["type"] == "MAT4" else out

    def attribute(self, name):
        return self.array(self.primitive["attributes"][name]).astype(float)

    def properties(self, time=None):
        """{(node, path): value}, at rest, or at a time of the animation."""
        out = {}
        for k, node in enumerate(self.root["nodes"]):
            for path, default in (("translation", [0] * 3), ("rotation", [0, 0, 0, 1]), ("scale", [1] * 3)):
                out[k, path] = np.array(node.get(path, default), dtype=float)
        out["weights"] = np.array(self.mesh.get("weights", []), dtype=float)
        if time is None:
            return out
        for channel in self.animation["channels"]:
            sampler = self.animation["samplers"][channel["sampler"]]
            times, values = (self.array(sampler[name]).astype(float) for name in ("input", "output"))
            values = values.reshape(len(times), -1)
            value = np.array([np.interp(time, times, column) for column in values.T])
            node, path = channel["target"]["node"], channel["target"]["path"]
            out["weights" if path == "weights" else (node, path)] = value
        return out

    def world(self, node, values):
        local = np.eye(4)
        rotation = Rotation.from_quat(values[node, "rotation"]).as_matrix()
        local[:3, :3] = rotation * values[node, "scale"]
        local[:3, 3] = values[node, "translation"]
        return self.world(self.parents[node], values) @ local if node in self.parents else local

    def draw(self, time=None):
        values = self.properties(time)
        skinning = [self.world(j, values) @ b for j, b in zip(self.skin["joints"], self.binds(), strict=True)]
        v = self.attribute("POSITION")
        for weight, target in zip(values["weights"], self.primitive.get("targets", []), strict=True):
            v = v + weight * self.array(target["POSITION"])
        out = np.zeros_like(v)
        for k in range(sum(name.startswith("JOINTS") for name in self.primitive["attributes"])):
            for j, w in zip(self.attribute(f"JOINTS_{k}").astype(int).T, self.attribute(f"WEIGHTS_{k}").T, strict=True):
                S = np.array(skinning)[j]
                out += w[:, None] * (np.einsum("iab,ib->ia", S[:, :3, :3], v) + S[:, :3, 3])
        return out

    def binds(self):
        return self.array(self.skin["inverseBindMatrices"]).astype(float)


def closeness(rig):
    return 5e-6 * 2 * rig.size  # single precision of what is up to twice as large, and moved as far again
