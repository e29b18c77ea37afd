"""Files of scans that are broken, cut or no scans: one clear error each."""

import zipfile

import numpy as np
import pytest
from npy_files import DAMAGED_HEADERS, damaged, npy
from scan_files import (
    ALL,
    LABELS,
    NORMALS,
    POINTS,
    ascii_pcd,
    ascii_ply,
    ascii_stl,
    binary_pcd,
    binary_ply,
    binary_stl,
    compressed_pcd,
    gltf,
    obj,
    off,
    ply_header,
    rows,
    write,
)

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io import scans
from lbsfit_np.io.scans import SCAN_EXTENSIONS, load_scan


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
    "odd.ply": (lambda: ascii_ply().replace(b"float z", b"quad z"), "header line 'property quad z'; .*with types of char"),
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
    "tiny34.stl": (lambda: b"solid".ljust(34), "a file of 34 bytes"),
    "asciishort.stl": (lambda: ascii_stl()[:-150], "without 'endsolid'"),
    "asciiword.stl": (lambda: ascii_stl().replace(b"1.5", b"one"), "'one'"),
    "lie.stl": (ascii_ply, "announces"),
    "lie.off": (ascii_ply, "does not start with 'OFF'"),
    "short.off": (lambda: off()[:-8], "ends after 3 of 4 faces.*truncated"),
    "cut.off": (lambda: off()[:-4], "face 3: '3 1'"),
    "short2.off": (lambda: off()[:40], "ends after 2 of 4 vertices|cannot be read"),
    "binary.off": (lambda: b"OFF BINARY\n" + bytes(40), "binary"),
    "binary4.off": (lambda: b"# ours\nNOFF BINARY\n" + bytes(40), "binary"),
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
    "broken.pcd": (lambda: compressed_pcd().replace(bytes([7 << 5, 14, 0]), bytes([7 << 5, 14, 200])), "cannot be unpacked"),
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
    "headeronly.csv": (lambda: "x,y,z\n", "no line of numbers below the first line, 'x, y, z', which was read as a header"),
    "remarks.xyz": (lambda: "# nothing yet\n", "got no line of numbers; expected one point per line"),
    "comments.txt": (lambda: "# nothing\n" * 300, "no row of numbers"),
    "lie.npy": (ascii_ply, "not an NPY array.*extension"),
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


@pytest.mark.parametrize("shape, kind", [((120, 160), "uint16"), ((480, 130), float), ((48, 64), "int32")])
def test_a_depth_image_is_no_table_of_points(tmp_path, shape, kind):
    np.save(tmp_path / "d.npy", np.ones(shape).astype(kind))
    with pytest.raises(FileError, match=r"looks like a depth image; expected points of shape \(n, 3\)"):
        load_scan(tmp_path / "d.npy")
    rng = np.random.default_rng(0)
    for shape in ((400, 70), (47, 47)):  # points with many features
        np.save(tmp_path / "d.npy", rng.random(shape))
        assert len(load_scan(tmp_path / "d.npy").points) == shape[0]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["a.npy", "a.pcd"])
def test_nan_whose_bits_signal_is_told_by_the_error_alone(tmp_path, name):
    points = np.arange(30, dtype="<f4").reshape(10, 3)
    points.view("<u4")[3, 1] = 0x7F800001
    head = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 10\nPOINTS 10\nDATA binary\n"
    np.save(tmp_path / "a.npy", points)
    (tmp_path / "a.pcd").write_bytes(head + points.tobytes())
    with pytest.raises(FileError, match="1 of 10 points with a coordinate that is NaN or infinite, the first at index 3"):
        load_scan(tmp_path / name)
    assert len(load_scan(tmp_path / name, drop_invalid=True)) == 9
