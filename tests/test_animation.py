"""Fits as an animated glTF: what a viewer would draw from the file alone is the registered mesh."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.io.gltf import read_gltf

_TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": (), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}


def a_fit(rig, seed, *, amount=0.02, rest_joints=None, subject=""):
    """A fit with random numbers of a rig, as fitting would put it together."""
    rng = np.random.default_rng(seed)
    J, m = rig.joints.shape[0], len(rig.vertices)
    pose = rng.uniform(rig.lower, rig.upper)
    pose[rig.root] = rng.normal(size=3)
    translation, scale = rng.normal(size=3), float(rng.uniform(0.5, 2.0))
    offsets = amount * rig.size * rng.normal(size=(m, 3))
    joints = rig.joints + amount * rig.size * rng.normal(size=(J, 3)) if rest_joints is None else rest_joints
    posed = pose, translation, scale, offsets
    return FitResult(
        pose=pose, translation=translation, scale=scale, offsets=offsets, rest_joints=joints,
        vertices=rig.pose(*posed, joints=joints), joints=rig.pose_joints(*posed, joints=joints), joint_std=np.zeros(J),
        labels=np.zeros(5, int), confidence=np.ones(5), terms={}, converged=True, status="ok", message="", probability=1.0,
        evidence={}, evaluations=1, seconds=0.0, parts=rig.parts, rig_digest=rig.digest, subject=subject,
    )  # fmt: skip


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
        (self.animation,) = self.root["animations"]
        (self.skin,) = self.root["skins"]
        (self.mesh,) = self.root["meshes"]
        (self.primitive,) = self.mesh["primitives"]
        self.times = self.array(self.animation["samplers"][0]["input"])

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


@pytest.fixture(scope="module", params=["tube", "hand-coarse", "body-coarse"])
def rig(request, tube_rig):
    return tube_rig if request.param == "tube" else lbs.load_rig(request.param)


def closeness(rig):
    return 5e-6 * 2 * rig.size  # single precision of what is up to twice as large, and moved as far again


def test_one_fit_stands_in_its_pose(rig, tmp_path):
    result = a_fit(rig, 0)
    errors = lbs.save_animation(tmp_path / "a.glb", rig, result)
    viewer = Viewer(tmp_path / "a.glb")
    for time in (None, 0.0):
        np.testing.assert_allclose(viewer.draw(time), result.vertices, rtol=0, atol=closeness(rig))
    np.testing.assert_allclose(errors, [0.0], atol=1e-12)
    assert "targets" not in viewer.primitive and len(viewer.times) == 1
    np.testing.assert_array_equal(viewer.array(viewer.primitive["indices"]).reshape(-1, 3), rig.faces)
    names = [viewer.root["nodes"][j]["name"] for j in viewer.skin["joints"]]
    assert tuple(names) == rig.joint_names
    assert [viewer.parents.get(j, -1) for j in viewer.skin["joints"]] == rig.parents.tolist()


def test_each_key_frame_is_its_registered_mesh(rig, tmp_path):
    results = [a_fit(rig, k) for k in range(4)]
    errors = lbs.save_animation(tmp_path / "a.glb", rig, results, offsets="each", frames_per_second=10)
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.times, [0, 0.1, 0.2, 0.3], rtol=1e-6)
    for time, result in zip(viewer.times, results, strict=True):
        np.testing.assert_allclose(viewer.draw(time), result.vertices, rtol=0, atol=closeness(rig))
    np.testing.assert_allclose(viewer.draw(), results[0].vertices, rtol=0, atol=closeness(rig))
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)


def test_the_mean_template_keeps_bones_as_long_as_they_are(rig, tmp_path):
    results = [a_fit(rig, k) for k in range(3)]
    errors = lbs.save_animation(tmp_path / "a.glb", rig, results)
    viewer = Viewer(tmp_path / "a.glb")
    mean = np.mean([r.offsets for r in results], axis=0)
    joints = np.mean([r.rest_joints for r in results], axis=0)
    for time, result, error in zip(viewer.times, results, errors, strict=True):
        expected = rig.pose(result.pose, result.translation, result.scale, mean, joints=joints)
        np.testing.assert_allclose(viewer.draw(time), expected, rtol=0, atol=closeness(rig))
        assert error == pytest.approx(np.linalg.norm(expected - result.vertices, axis=1).mean()) and error > 1e-3 * rig.size
    moved = {(c["target"]["node"], c["target"]["path"]) for c in viewer.animation["channels"]}
    assert {node for node, path in moved if path != "rotation"} == {rig.root}
    assert {node for node, path in moved if path == "rotation"} == set(np.flatnonzero(rig.moving))
    assert "targets" not in viewer.primitive


def test_what_all_fits_share_is_no_morph_target(tube_rig, tmp_path):
    """As of one subject of a learned model, without residuals."""
    first = a_fit(tube_rig, 0)
    posed = first.pose, first.translation + 1.0, first.scale, first.offsets
    second = replace(first, translation=posed[1], vertices=tube_rig.pose(*posed, joints=first.rest_joints))
    errors = lbs.save_animation(tmp_path / "a.glb", tube_rig, [first, second], offsets="each")
    viewer = Viewer(tmp_path / "a.glb")
    assert "targets" not in viewer.primitive and {c["target"]["path"] for c in viewer.animation["channels"]} == {
        "rotation",
        "translation",
    }
    np.testing.assert_allclose(viewer.draw(viewer.times[1]), second.vertices, atol=closeness(tube_rig))
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)


def test_what_lies_between_key_frames_takes_the_short_way(tube_rig, tmp_path):
    """A quaternion and its negative are one rotation, but not for what is interpolated."""
    fits = []
    for angle in (3.0, 4.4, 5.2, 6.0):
        fit = a_fit(tube_rig, 0)
        pose = fit.pose.copy()
        pose[tube_rig.root] = 0.0, angle, 0.0
        fits.append(replace(fit, pose=pose, vertices=tube_rig.pose(pose, fit.translation, fit.scale, fit.offsets)))
    lbs.save_animation(tmp_path / "a.glb", tube_rig, fits)
    viewer = Viewer(tmp_path / "a.glb")
    root = [viewer.properties(time)[tube_rig.root, "rotation"] for time in viewer.times]
    assert (np.einsum("ka,ka->k", root[1:], root[:-1]) > 0.7).all()


def test_the_package_reads_it_as_a_rig(rig, tmp_path):
    """Joints, weights, faces; and of an animation the angles."""
    results = [a_fit(rig, k, amount=0.0, rest_joints=rig.joints) for k in range(3)]
    lbs.save_animation(tmp_path / "a.glb", rig, results)
    data = read_gltf(tmp_path / "a.glb")
    assert tuple(data.joint_names) == rig.joint_names and data.parents.tolist() == rig.parents.tolist()
    np.testing.assert_array_equal(data.faces, rig.faces)
    np.testing.assert_allclose(data.weights.toarray(), rig.weights.toarray(), atol=1e-6)
    moving = np.ones(len(rig.parents), bool)
    moving[rig.root] = False
    for k, result in enumerate(results):
        found = Rotation.from_rotvec(data.animated[2 * k][moving])
        assert (found * Rotation.from_rotvec(result.pose[moving]).inv()).magnitude().max() < 1e-5


def test_rigs_with_many_influences_and_seams(tmp_path):
    """More than four joints a vertex go to further sets; a seam's normals are one."""
    rig = lbs.load_rig("hand-coarse")
    weights = rig.weights.toarray() + 0.02
    rig = replace(rig, weights=type(rig.weights)(weights / weights.sum(axis=1, keepdims=True)))
    result = a_fit(rig, 1)
    lbs.save_animation(tmp_path / "a.glb", rig, result)
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.draw(), result.vertices, rtol=0, atol=closeness(rig))
    sets = [viewer.attribute(f"WEIGHTS_{k}") for k in range(-(-len(rig.parents) // 4))]
    np.testing.assert_allclose(np.sum(sets, axis=(0, 2)), 1.0, atol=2e-7)
    assert sets[0].min() >= sets[1].max(axis=1).min() and (np.diff(np.hstack(sets), axis=1) <= 1e-6).all()


def test_normals_point_out_and_are_of_length_one(rig, tmp_path):
    lbs.save_animation(tmp_path / "a.glb", rig, a_fit(rig, 0, amount=0.0))
    viewer = Viewer(tmp_path / "a.glb")
    normals, v = viewer.attribute("NORMAL"), viewer.attribute("POSITION")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    a, b, c = v[rig.faces[:, 0]], v[rig.faces[:, 1]], v[rig.faces[:, 2]]
    assert (np.einsum("ia,ia->i", normals[rig.faces[:, 0]], np.cross(b - a, c - a)) > 0).mean() > 0.98


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_the_axis_that_is_up_becomes_y(tube_rig, tmp_path, up):
    result = a_fit(tube_rig, 0)
    lbs.save_animation(tmp_path / "a.glb", tube_rig, result, up=up, metres_per_unit=0.001)
    drawn = Viewer(tmp_path / "a.glb").draw()
    axis = "xyz".index(up[1])
    np.testing.assert_allclose(1000 * drawn[:, 1], float(up[0] + "1") * result.vertices[:, axis], atol=closeness(tube_rig))
    turn, _ = Rotation.align_vectors(drawn - drawn.mean(axis=0), result.vertices - result.vertices.mean(axis=0))
    np.testing.assert_allclose(turn.apply(result.vertices) * 0.001, drawn, atol=0.001 * closeness(tube_rig))  # no mirror image


def test_the_rigs_own_axis_is_taken_where_none_is_given(tube_rig, tmp_path):
    result = a_fit(tube_rig, 0)
    lbs.save_animation(tmp_path / "a.glb", replace(tube_rig, up="+z", forward=None), result)
    lbs.save_animation(tmp_path / "b.glb", tube_rig, result, up="+z")
    np.testing.assert_allclose(Viewer(tmp_path / "a.glb").draw(), Viewer(tmp_path / "b.glb").draw(), atol=1e-9)


def _wrong(rig):
    fit = a_fit(rig, 0)
    pose = fit.pose.copy()
    pose[1, 0] = np.nan
    return {
        "path": ("a.gltf", fit, {}),
        "results": ("a.glb", [], {}),
        "results ": ("a.glb", 3, {}),
        "results[1]": ("a.glb", [fit, "fit"], {}),
        "results[0]": ("a.glb", [replace(fit, rig_digest="other")], {}),
        "results[0] ": ("a.glb", [replace(fit, pose=pose)], {}),
        "offsets": ("a.glb", fit, {"offsets": "both"}),
        "up": ("a.glb", fit, {"up": "y"}),
        "frames_per_second": ("a.glb", fit, {"frames_per_second": 0}),
        "metres_per_unit": ("a.glb", fit, {"metres_per_unit": np.inf}),
    }


@pytest.mark.parametrize("argument", [*_wrong(lbs.load_rig("hand-coarse"))])
def test_bad_arguments_are_named_and_nothing_is_written(argument, tmp_path):
    rig = lbs.load_rig("hand-coarse")
    name, results, options = _wrong(rig)[argument]
    with pytest.raises(InputError) as error:
        lbs.save_animation(tmp_path / name, rig, results, **options)
    assert error.value.argument == argument.strip()
    assert not list(tmp_path.iterdir())


def test_a_rig_that_is_none(tmp_path, tube_rig):
    with pytest.raises(InputError, match="rig"):
        lbs.save_animation(tmp_path / "a.glb", "hand", a_fit(tube_rig, 0))


def test_a_folder_that_does_not_exist(tmp_path, tube_rig):
    with pytest.raises(FileError, match="does not exist"):
        lbs.save_animation(tmp_path / "no" / "a.glb", tube_rig, a_fit(tube_rig, 0))
