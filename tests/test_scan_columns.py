"""Columns of scans: which of them are points, normals and labels, values that are missing, and labels that are none."""

import numpy as np
import pytest
from scan_files import FACES, LABELS, NORMALS, POINTS, on_tetrahedron, rows, write

from lbsfit_np.errors import FileError
from lbsfit_np.io.scans import load_scan


def test_columns_without_names(tmp_path):
    unit = load_scan(write(tmp_path, "n.txt", rows(POINTS, NORMALS, LABELS)))
    np.testing.assert_array_equal(unit.normals, NORMALS)
    assert unit.labels is None and "One further column" in unit.notes[0]
    colours = load_scan(write(tmp_path, "c.txt", rows(POINTS, 100 * NORMALS)))
    np.testing.assert_array_equal(colours.points, POINTS)
    assert colours.normals is None and "3 further columns" in colours.notes[0]


def test_a_column_that_counts_the_rows_is_no_x(tmp_path):
    for first in (0, 1):
        scan = load_scan(write(tmp_path, "p.csv", rows(np.arange(first, first + 4), POINTS, NORMALS, sep=",")))
        np.testing.assert_array_equal(scan.points, POINTS)
        np.testing.assert_array_equal(scan.normals, NORMALS)
        assert scan.notes[0] == "The first column, which counts the rows, was left out."
    for column in ([0, 1, 3, 4], [5, 6, 7, 8], [2, 0, 3, 1]):
        scan = load_scan(write(tmp_path, "p.csv", rows(column, POINTS, sep=",")))
        np.testing.assert_array_equal(scan.points[:, 0], column)
        first = ", ".join(map(str, column[:3]))
        assert scan.notes[0] == (
            f"Columns 1 to 3 were read as x, y, z, but the first ({first}, …) looks like row numbers: leave it out, "
            "or name the columns in a header line (row x y z)."
        )
        assert len(scan.notes) == 2 and scan.notes[1].startswith("One further column")
        path = write(tmp_path, "p.csv", "row,x,y,z\n" + rows(column, POINTS, sep=","))
        np.testing.assert_array_equal(load_scan(path).points, POINTS)


NUMBERS = [[1, 2, 3, 4], [0, 1, 2, 3], [1, 3, 4, 9]]


@pytest.mark.parametrize(
    ("head", "column"),
    [
        *[(head, column) for head in ('"x" "y" "z"', "x y z", "# x y z") for column in NUMBERS],
        ('"x" "y" "z"', ['"a"', '"7"', '"b c"', '"1"']),
    ],
)
def test_a_header_without_a_name_for_the_rows_names_the_columns_after_them(tmp_path, head, column):
    """As R writes data frames."""
    lines = [" ".join(map(str, (first, *point, 5))) for first, point in zip(column, POINTS)]
    scan = load_scan(write(tmp_path, "p.txt", "\n".join([f"{head} label", *lines])))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert scan.labels.tolist() == [5] * 4 and scan.notes[0].startswith("The first column, for which the header has no name")


def test_text_in_utf_16_is_named(tmp_path):
    (tmp_path / "p.csv").write_bytes("x,y,z\n0,1,2\n".encode("utf-16"))
    with pytest.raises(FileError, match="got text in UTF-16; expected text in UTF-8 .* Save it as CSV in UTF-8"):
        load_scan(tmp_path / "p.csv")


@pytest.mark.parametrize("end", ["7", ""])
def test_a_header_names_the_first_columns_where_these_do_not_number_the_rows(tmp_path, end):
    lines = [",".join([*map(str, point), end]) for point in POINTS]
    scan = load_scan(write(tmp_path, "p.csv", "\n".join(["x,y,z", *lines])))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert not scan.notes


def test_an_array_has_no_header_line_to_name_its_columns(tmp_path):
    np.save(tmp_path / "p.npy", np.column_stack([[0, 1, 3, 4], POINTS]))
    odd, further = load_scan(tmp_path / "p.npy").notes
    assert odd.endswith("but the first (0, 1, 3, …) looks like row numbers: leave it out (array[:, 1:]).")
    assert further.startswith("One further column") and "a structured array with fields (x, y, z, " in further


def test_whole_numbers_in_any_order_are_an_x_beside_others(tmp_path):
    points = np.round(4 * POINTS)  # in millimetres, say
    scan = load_scan(write(tmp_path, "p.csv", rows([5, 8, 7, 9], points, sep=",")))
    assert len(scan.notes) == 1 and scan.notes[0].startswith("One further column")


@pytest.mark.parametrize("whole", [1, 2])
def test_whole_numbers_in_any_order_are_an_x_beside_one_other_column_of_such(whole, tmp_path):
    points = POINTS + 0.5
    points[:, whole] = np.floor(points[:, whole])
    scan = load_scan(write(tmp_path, "p.csv", rows([5, 8, 7, 9], points[:, 1:], POINTS[:, :1], sep=",")))
    assert len(scan.notes) == 1 and scan.notes[0].startswith("One further column")


@pytest.mark.parametrize("x", [[5, 6, 8, 8], [5, 6, 7.5, 8], [5, 8, 7, 8], [9, 6.5, 7, 8], [5, 6, 7]])
def test_an_x_that_is_no_row_number_has_no_note(x, tmp_path):
    scan = load_scan(write(tmp_path, "p.csv", rows(x, POINTS[: len(x)], sep=",")))
    assert len(scan.notes) == 1 and scan.notes[0].startswith("One further column")


def test_three_columns_are_the_points_even_where_x_counts(tmp_path):
    points = np.column_stack([np.arange(4.0), POINTS[:, 1:]])
    scan = load_scan(write(tmp_path, "p.csv", rows(points, sep=",")))
    np.testing.assert_array_equal(scan.points, points)
    assert scan.notes == ()


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


def test_points_beside_what_a_rig_has_are_a_scan(tmp_path):
    """Of a rig, vertices alone would be read as one."""
    points = np.random.default_rng(0).random((9, 3))
    of_rig = {"parents": np.array([-1, 0]), "joints": np.zeros((2, 3)), "weights_data": np.ones(4)}
    for key in ("points", "xyz"):
        np.savez(tmp_path / "scan.npz", **of_rig, **{key: points})
        np.testing.assert_array_equal(load_scan(tmp_path / "scan.npz").points, points)
    np.savez(tmp_path / "rig.npz", **of_rig, vertices=points)
    with pytest.raises(FileError, match="a rig, or a learned model"):
        load_scan(tmp_path / "rig.npz")
