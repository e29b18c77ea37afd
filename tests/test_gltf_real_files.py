"""Real glTF files, against the format's own rule."""

import json
import struct
from itertools import pairwise

import numpy as np
import pytest
from gltf_files import (
    free_rig,
)
from scipy.spatial.transform import Rotation

from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.rig.build import build_rig
from lbsfit_np.skinning import skin as pose_rig


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
