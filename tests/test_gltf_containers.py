"""glTF files and what they store: containers, buffers and accessors."""

import json
import struct

import numpy as np
import pytest
from gltf_files import (
    ARM,
    GltfWriter,
    check_arm,
    save,
    write_arm,
)

from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.io.gltf_buffers import open_gltf
from lbsfit_np.io.scans import load_scan


@pytest.mark.parametrize(
    "name, options",
    [
        ("arm.glb", {}),
        ("arm.gltf", {}),
        ("arm.gltf", {"uri": "data:"}),
        ("arm.gltf", {"uri": "buffers/my%20arm%C3%A9.bin", "stored_as": "buffers/my armé.bin"}),
        ("arm.gltf", {"uri": "my arm.bin"}),
        ("arm.gltf", {"uri": "100%25.bin", "stored_as": "100%.bin"}),
    ],
)
def test_containers(tmp_path, name, options):
    data = read_gltf(save(write_arm(ARM), tmp_path, name, **options))
    check_arm(data, np.eye(4))
    assert np.array_equal(data.faces, ARM.faces)
    assert data.name == "arm" and data.path == tmp_path / name
    assert data.joint_names == list(ARM.names) and np.array_equal(data.parents, ARM.parents)
    assert (data.up, data.forward, data.metres_per_unit) == ("+y", "+z", 1.0)
    assert data.notes == [] and data.animated is None


def test_data_uri_without_base64_and_extra_chunks(tmp_path):
    writer = write_arm(ARM)
    path = save(writer, tmp_path, "a.gltf", uri="data:")
    root = json.loads(path.read_text())
    root["buffers"][0]["uri"] = "data:application/gltf-buffer," + "".join(f"%{b:02x}" for b in writer.binary)
    path.write_text(json.dumps(root))
    check_arm(read_gltf(str(path)), np.eye(4))
    glb = tmp_path / "x.glb"
    glb.write_bytes(writer.glb(extra_chunk=True) + b"trailing")
    check_arm(read_gltf(glb), np.eye(4))
    end = 20 + struct.unpack("<I", writer.glb()[12:16])[0]
    content = writer.glb()
    spaces = len(content[20:end]) - len(content[20:end].rstrip(b" "))
    assert spaces  # some writers pad the JSON with zeros
    glb.write_bytes(content[: end - spaces] + bytes(spaces) + content[end:])
    check_arm(read_gltf(glb), np.eye(4))


def test_images_in_missing_files_do_not_matter(tmp_path):
    writer = write_arm(ARM)
    path = save(writer, tmp_path, "a.gltf", uri="data:")
    root = json.loads(path.read_text())
    root["buffers"].append({"byteLength": 10, "uri": "gone.bin"})
    root["images"] = [{"uri": "gone.png"}]
    path.write_text(json.dumps(root))
    check_arm(read_gltf(path), np.eye(4))


def accessor_of(writer, tmp_path, index, kinds):
    return open_gltf(save(writer, tmp_path)).accessor(index, "the test", kinds)


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "u4", "f4"])
@pytest.mark.parametrize("gap", [0, 4])
def test_component_types_and_strides(tmp_path, dtype, gap):
    values = np.array([[1, 2, 3], [100, 0, 7], [5, 127, 9]])
    writer = GltfWriter()
    writer.accessor(np.zeros(3), "u1")  # so that the view does not start at 0
    got = accessor_of(writer, tmp_path, writer.accessor(values, dtype, gap=gap), ("VEC3",))
    assert np.array_equal(got, values)
    assert got.dtype == (float if dtype == "f4" else np.int64)


@pytest.mark.parametrize(
    "dtype, stored, expected",
    [
        ("i1", [-128, -127, 0, 127], [-1.0, -1.0, 0.0, 1.0]),
        ("u1", [0, 51, 255, 1], [0.0, 0.2, 1.0, 1 / 255]),
        ("i2", [-32768, -32767, 0, 32767], [-1.0, -1.0, 0.0, 1.0]),
        ("u2", [0, 13107, 65535, 1], [0.0, 0.2, 1.0, 1 / 65535]),
    ],
)
def test_normalized_integers(tmp_path, dtype, stored, expected):
    writer = GltfWriter()
    got = accessor_of(writer, tmp_path, writer.accessor(np.array([stored]), dtype, normalized=True), ("VEC4",))
    assert np.allclose(got, [expected], rtol=0, atol=1e-15)


@pytest.mark.parametrize("dtype, n", [("u1", 2), ("u1", 3), ("u2", 3), ("f4", 4), ("f4", 3)])
def test_matrices_and_column_padding(tmp_path, dtype, n):
    values = np.arange(3 * n * n).reshape(3, n, n) + 1
    writer = GltfWriter()
    index = writer.accessor(values, dtype)
    pad = -(n * np.dtype(dtype).itemsize) % 4
    view = writer.json["bufferViews"][index]
    view["byteLength"] -= pad  # the last padding may be missing
    assert np.array_equal(accessor_of(writer, tmp_path, index, (f"MAT{n}",)), values)


@pytest.mark.parametrize("with_base", [True, False])
def test_sparse_accessors(tmp_path, with_base):
    base = np.arange(15.0).reshape(5, 3) if with_base else np.zeros((5, 3))
    writer = GltfWriter()
    index = writer.accessor(base)
    if not with_base:
        writer.json["accessors"][index].pop("bufferView")
    rows, values = np.array([1, 4], dtype="<u2"), np.array([[9.0, 8, 7], [6, 5, 4]], dtype="<f4")
    sparse_part = {
        "count": 2,
        "indices": {"bufferView": writer.view(rows.tobytes()), "componentType": 5123},
        "values": {"bufferView": writer.view(b"skip" + values.tobytes()), "byteOffset": 4},
    }
    writer.json["accessors"][index]["sparse"] = sparse_part
    base[rows] = values
    assert np.array_equal(accessor_of(writer, tmp_path, index, ("VEC3",)), base)


def test_an_accessor_without_data_is_zeros_and_whole_floats_are_integers(tmp_path):
    writer = GltfWriter()
    writer.add("accessors", componentType=5126.0, count=4.0, type="VEC3")
    assert np.array_equal(accessor_of(writer, tmp_path, 0, ("VEC3",)), np.zeros((4, 3)))


@pytest.mark.parametrize(
    ("required", "named"),
    [
        (["KHR_mesh_quantization", "KHR_materials_unlit", "EXT_texture_webp", "KHR_lights_punctual", "KHR_xmp_json_ld"], None),
        (["KHR_texture_basisu", "EXT_mesh_gpu_instancing"], "1 extension(s) that are not known here ('EXT_mesh_gpu_instancing')"),
        (["ONE", 7, "half\ud83d"], "3 extension(s) that are not known here ('ONE', 7, 'half\\ud83d')"),
    ],
)
def test_required_extensions_that_may_change_the_shape_are_noted(tmp_path, required, named):
    writer = write_arm(ARM)
    writer.json["extensionsRequired"] = required
    path = save(writer, tmp_path)
    expected = [] if named is None else [f"the file requires {named}: what it shows may differ from what was read"]
    assert read_gltf(path).notes == expected
    assert load_scan(path).notes == tuple(note + "." for note in expected)
