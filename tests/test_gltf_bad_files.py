"""Bad glTF files: one clear error for each, and never anything else."""

import base64
import json
import struct

import numpy as np
import pytest
from gltf_files import (
    ARM,
    animated_arm,
    check_arm,
    save,
    write_arm,
)

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io.gltf import read_gltf


def edited(edit, **options):
    def make(folder):
        writer = write_arm(ARM, **options)
        edit(writer.json)
        return save(writer, folder)

    return make


def raw(content, name="x.glb"):
    def make(folder):
        (folder / name).write_bytes(content)
        return folder / name

    return make


def put(path, value):
    """An edit of the JSON: ``path`` such as "skins.0.joints"; None removes."""

    def edit(root):
        *way, last = [int(p) if p.isdecimal() else p for p in path.split(".")]
        for p in way:
            root = root[p]
        if value is None:
            root.pop(last)
        else:
            root[last] = value

    return edit


def gltf_with_buffer(uri, length=None, keep=True):
    def make(folder):
        path = save(write_arm(ARM), folder, "x.gltf")
        root = json.loads(path.read_text())
        root["buffers"][0]["uri"] = uri
        if length:
            root["buffers"][0]["byteLength"] = length
        path.write_text(json.dumps(root))
        return path

    return make


def animation_edit(path, value):
    def make(folder):
        writer = animated_arm()
        put(path, value)(writer.json)
        return save(writer, folder)

    return make


GLB = write_arm(ARM).glb()
JSON_END = 20 + struct.unpack("<I", GLB[12:16])[0]
PRIMITIVE = "meshes.0.primitives.0"
BAD = {
    "missing file": (lambda folder: folder / "none.glb", "no such file"),
    "folder": (lambda folder: folder, "cannot be read"),
    "empty": (raw(b""), "starts with b''"),
    "wrong magic": (raw(b"PK\x03\x04" + GLB[4:]), "starts with b'PK"),
    "only a header": (raw(GLB[:10]), "truncated"),
    "truncated header": (raw(b"glTF"), "truncated"),
    "truncated": (raw(GLB[:-50]), "truncated"),
    "truncated chunk": (raw(GLB[:8] + struct.pack("<I", len(GLB) - 50) + GLB[12:-50]), "truncated"),
    "no chunk": (raw(b"glTF" + struct.pack("<II", 2, 12)), "no JSON chunk"),
    "binary first": (raw(GLB[:16] + b"BIN\0" + GLB[20:]), "a JSON chunk first"),
    "version 1 container": (raw(b"glTF" + struct.pack("<I", 1) + GLB[8:]), "version 1"),
    "no chunk for the buffer": (raw(GLB[:8] + struct.pack("<I", JSON_END) + GLB[12:]), "without a uri"),
    "broken json": (raw(b'{"asset": {"version": "2.0"', "x.gltf"), "broken JSON"),
    "not text": (raw(b"\xff\xfe\x00", "x.gltf"), "not UTF-8"),
    "deep json": (raw(b'{"a":' + b"[" * 200000, "x.gltf"), "JSON"),
    "not an object": (raw(b"[1, 2]", "x.gltf"), "expected a glTF object"),
    "no version": (raw(b"{}", "x.gltf"), "glTF version None"),
    "glTF 1": (edited(put("asset.version", "1.0")), "glTF version '1.0'"),
    "glTF 2.1 needed": (edited(put("asset.minVersion", "2.1")), "minVersion '2.1'"),
    "draco": (edited(put("extensionsRequired", ["KHR_draco_mesh_compression"])), "without mesh compression"),
    "meshopt": (edited(put("extensionsRequired", ["EXT_meshopt_compression"])), "compressed with EXT_meshopt_compression"),
    "missing buffer": (gltf_with_buffer("away.bin"), "'away.bin'"),
    "web buffer": (gltf_with_buffer("https://example.org/x.bin"), "relative to the file"),
    "absolute buffer": (gltf_with_buffer("/etc/hostname"), "relative to the file"),
    "absolute buffer in disguise": (gltf_with_buffer("%2Fetc/hostname"), "relative to the file"),
    "null in a name": (gltf_with_buffer("a%00b"), "cannot be read"),
    "short buffer": (gltf_with_buffer("x.bin", length=10**6), "it is truncated"),
    "bad base64": (gltf_with_buffer("data:application/octet-stream;base64,A$"), "not base64"),
    "bad data uri": (gltf_with_buffer("data:"), "without a comma"),
    "view out of buffer": (edited(put("bufferViews.0.byteLength", 10**7)), "bufferView 0 ends at byte"),
    "accessor out of view": (edited(put("accessors.0.count", 10**5)), "accessor 0 (POSITION"),
    "huge accessor": (edited(put("accessors.0", {"componentType": 5126, "count": 10**12, "type": "VEC3"})), "without data"),
    "no view": (edited(put("accessors.0.bufferView", 99)), "bufferViews[99]"),
    "negative offset": (edited(put("accessors.0.byteOffset", -4)), "byteOffset of accessor 0"),
    "small stride": (edited(put("bufferViews.0.byteStride", 4)), "byteStride 4"),
    "component type": (edited(put("accessors.0.componentType", 5124)), "componentType 5124"),
    "position type": (edited(put("accessors.0.type", "VEC2")), "has type 'VEC2'"),
    "count missing": (edited(put("accessors.0.count", None)), "count of accessor 0 (POSITION of primitive 0 of mesh 0) is m"),
    "no such accessor": (edited(put(f"{PRIMITIVE}.attributes.POSITION", 77)), "accessors[77]"),
    "no skin": (edited(lambda r: (r.pop("skins"), r["nodes"][5].pop("skin"))), "got no skin"),
    "unused skin": (edited(lambda r: r["nodes"][5].pop("skin")), "1 skins that no mesh uses"),
    "node of no skin": (edited(put("nodes.5.skin", 3)), "skins[3], of 1"),
    "joints out of range": (edited(put("skins.0.joints", [0, 1, 2, 3, 40])), "joints of skin 0 refers to nodes[40]"),
    "joint twice": (edited(put("skins.0.joints", [0, 1, 2, 3, 3])), "each once"),
    "no joints": (edited(put("skins.0.joints", [])), "with 0 joints"),
    "weights to no joint": (edited(put("skins.0.joints", [0, 1])), "where the skin has 2"),
    "too few matrices": (edited(put("accessors.4.count", 2)), "2 inverse bind matrices for the 5 joints"),
    "weights without joints": (edited(put(f"{PRIMITIVE}.attributes.WEIGHTS_0", None)), "without WEIGHTS_0"),
    "joints only": (edited(put(f"{PRIMITIVE}.attributes.JOINTS_0", None)), "no triangles with joints"),
    "float joints": (edited(put(f"{PRIMITIVE}.attributes.JOINTS_0", 2)), "not integers"),
    "attribute counts": (edited(put("accessors.1.count", 3)), "3 elements of JOINTS_0 for 64 vertices"),
    "index out of range": (edited(put("accessors.0.count", 20)), "20"),
    "float indices": (edited(put("accessors.3", {"componentType": 5126, "count": 3, "type": "SCALAR"})), "unsigned integers"),
    "only lines": (edited(put(f"{PRIMITIVE}.mode", 1)), "no triangles"),
    "cycle of nodes": (edited(put("nodes.3.children", [0])), "two parents"),
    "cycle without a root": (edited(lambda r: (r["nodes"][6].pop("children"), r["nodes"][3].update(children=[0]))), "cycle"),
    "two parents": (edited(put("nodes.3.children", [4])), "two parents"),
    "child out of range": (edited(put("nodes.3.children", [400])), "nodes[400]"),
    "bad transform": (edited(put("nodes.3.translation", [0, 1])), "translation of node 3"),
    "infinite transform": (edited(put("nodes.3.translation", [0, 1, float("inf")])), "finite"),
    "overflow": (edited(lambda r: [n.update(scale=[1e299] * 3) for n in r["nodes"][:2]]), "node 0, which is scaled or moved bey"),
    "zero rotation": (edited(put("nodes.3.rotation", [0, 0, 0, 0])), "rotation of length 0"),
    "nodes are no list": (edited(put("nodes", {"a": 1})), "nodes of the file"),
    "scene out of range": (edited(put("scene", 9)), "scenes[9]"),
    "mesh out of range": (edited(put("nodes.5.mesh", 9)), "meshes[9]"),
    "sampler out of range": (animation_edit("animations.0.channels.0.sampler", 9), "sampler 9 of 5"),
    "interpolation": (animation_edit("animations.0.samplers.0.interpolation", "BEZIER"), "'BEZIER'"),
    "values of an animation": (animation_edit("animations.0.samplers.0.output", 0), "output of sampler 0 of animation 0"),
    "values per key": (animation_edit("animations.0.samplers.0.interpolation", "CUBICSPLINE"), "3 values for each"),
    "target out of range": (animation_edit("animations.0.channels.0.target.node", 70), "nodes[70]"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_files_give_one_clear_error(tmp_path, case):
    make, words = BAD[case]
    path = make(tmp_path)
    with pytest.raises(FileError) as error:
        read_gltf(path)
    assert error.value.argument == str(path)
    assert words in str(error.value)


def test_bad_numbers(tmp_path):
    for values, words in (
        (
            np.where(np.arange(len(ARM.vertices))[:, None] == 7, np.nan, ARM.vertices),
            "NaN or infinite values, first in element 7",
        ),
        (np.where(np.arange(len(ARM.vertices))[:, None] == 3, np.inf, ARM.vertices), "first in element 3"),
    ):
        writer = write_arm(ARM)
        writer.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = writer.accessor(values)
        with pytest.raises(FileError, match=words):
            read_gltf(save(writer, tmp_path))
    for matrices, words in (
        (np.zeros((5, 4, 4)) + np.diag([1, 1, 0, 1]), "inverse bind matrix of 'root' that flattens space"),
        (np.swapaxes(np.linalg.inv(ARM.matrices), 1, 2), "with the last row"),
    ):
        writer = write_arm(ARM)
        writer.json["skins"][0]["inverseBindMatrices"] = writer.accessor(matrices)
        with pytest.raises(FileError, match=words):
            read_gltf(save(writer, tmp_path))
    writer = animated_arm()
    writer.json["animations"][0]["samplers"][0]["input"] = writer.accessor([0.0, 2.0, 1.0, 3.0])
    with pytest.raises(FileError, match="run backwards"):
        read_gltf(save(writer, tmp_path))
    writer = write_arm(ARM)
    writer.json["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": writer.view(struct.pack("<H", 64)), "componentType": 5123},
        "values": {"bufferView": writer.view(bytes(12))},
    }
    with pytest.raises(FileError, match="sparse index 64"):
        read_gltf(save(writer, tmp_path))


def test_compressed_primitives_without_fallback(tmp_path):
    writer = write_arm(ARM)
    writer.json["meshes"][0]["primitives"][0]["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    check_arm(read_gltf(save(writer, tmp_path)), np.eye(4))  # data of its own: the extension is not needed
    writer.json["accessors"][0].pop("bufferView")
    with pytest.raises(FileError, match="compressed with KHR_draco"):
        read_gltf(save(writer, tmp_path))


def test_a_path_that_is_none():
    with pytest.raises(InputError, match="path: got int"):
        read_gltf(3)


def test_damaged_files_never_raise_anything_else(tmp_path):
    """JSON values swapped for others at random: either a rig comes out, or one of our errors."""
    rng = np.random.default_rng(11)
    writer = animated_arm()
    strange = [
        None,
        -1,
        0,
        1,
        7,
        2.5,
        1e300,
        "x",
        "",
        [],
        {},
        [0],
        ["a"],
        [{}],
        {"a": 1},
        True,
        10**400,
        5126,
        "VEC3",
        float("nan"),
    ]
    refused = 0
    for _ in range(400):
        root = json.loads(json.dumps(writer.json))
        root["buffers"] = [{"byteLength": len(writer.binary), "uri": "data:;base64," + base64.b64encode(writer.binary).decode()}]
        for _ in range(int(rng.integers(1, 3))):
            owner = root
            while True:
                keys = list(owner) if isinstance(owner, dict) else range(len(owner))
                key = keys[int(rng.integers(len(keys)))]
                if not (isinstance(owner[key], (dict, list)) and len(owner[key])) or rng.random() < 0.1:
                    break
                owner = owner[key]
            owner[key] = strange[int(rng.integers(len(strange)))]
        path = tmp_path / "fuzz.gltf"
        path.write_text(json.dumps(root))
        try:
            data = read_gltf(path)
            assert np.isfinite(data.vertices).all() and np.isfinite(data.frames).all()
        except InputError:
            refused += 1
    assert 100 < refused < 400
