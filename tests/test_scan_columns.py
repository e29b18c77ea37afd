"""Columns of scans: which of them are points, normals and labels, values that are missing, and labels that are none."""

import numpy as np
import pytest
from scan_files import FACES, LABELS, NORMALS, POINTS, ascii_ply, binary_ply, csv, on_tetrahedron, ply_header, rows, write

from lbsfit_np.errors import FileError
from lbsfit_np.io.scans import load_mesh, load_scan


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


@pytest.mark.parametrize("times", [[0, 0.01, 0.02, 0.03], [12.5, 12.51, 12.5203, 12.53], [12345.0, 12345.1, 12345.2, 12345.3]])
def test_a_column_of_times_is_told_of(tmp_path, times):
    scan = load_scan(write(tmp_path, "p.csv", rows(times, POINTS, sep=",")))
    np.testing.assert_array_equal(scan.points[:, 0], times)
    first = ", ".join(str(float(t)) for t in times[:3])
    words = f"({first}, …) looks like times: leave it out, or name the columns in a header line (row x y z)."
    assert scan.notes[0].endswith(words)
    for x in ([0, 0.01, 0.03, 0.04], [0, 0.01, 0.02, 0.01], [0.5, 0.5, 0.5, 0.5]):
        notes = load_scan(write(tmp_path, "p.csv", rows(x, POINTS, sep=","))).notes
        assert len(notes) == 1 and notes[0].startswith("One further column")


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
    np.save(tmp_path / "t.npy", np.column_stack([[0.01, 0.02, 0.03, 0.04], POINTS]).astype(np.float32))
    (odd, _) = load_scan(tmp_path / "t.npy").notes
    assert odd.endswith("but the first (0.01, 0.02, 0.03, …) looks like times: leave it out (array[:, 1:]).")
    np.save(tmp_path / "n.npy", np.array([[3, 1, 2, 0], [2, 1, 1, 0], [1, 4, 2, 0], [0, 2, 2, 0]], dtype=np.uint8))
    assert len(load_scan(tmp_path / "n.npy").notes) == 1
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


@pytest.mark.parametrize("name, head, sep", [("a.csv", "x,y,z,label\n", ","), ("a.xyz", "# x y z label\n", " ")])
def test_labels_in_text_that_a_float_would_change_are_left_out_with_a_note(tmp_path, name, head, sep):
    def scan(*labels):
        body = "".join(sep.join([*map(str, p), str(label)]) + "\n" for p, label in zip(POINTS, labels))
        return load_scan(write(tmp_path, name, head + body))

    assert scan(1, 2**53 - 1, 3, -(2**53) + 1).labels.tolist() == [1, 2**53 - 1, 3, -(2**53) + 1]
    for label in (2**53 + 1, -(2**53) - 1):  # which are read as their neighbours
        assert scan(1, 2, 3, label).labels is None and "53 in text" in scan(1, 2, 3, label).notes[0]


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


@pytest.mark.parametrize(
    ("text", "points"),
    [
        ("x\ty\tz\tintensity\n1\t2\t3\t9\n\t2\t3\t9\n4\t5\t6\t7\n", [[1, 2, 3], [np.nan, 2, 3], [4, 5, 6]]),
        ("x y z label conf\n1\t2\t3\t4\t\n1\t2\t4\t6\t5\n", [[1, 2, 3], [1, 2, 4]]),
        ("1,5\t2,5\t3,5\n1\t2\t3\n", [[1.5, 2.5, 3.5], [1, 2, 3]]),
        ("\tx\ty\tz\n0\t1.5\t2\t3\n1\t4\t5\t6\n", [[1.5, 2, 3], [4, 5, 6]]),
        ("\t0\t1\t2\n0\t1.5\t2\t3\n1\t4\t5\t6\n", [[1.5, 2, 3], [4, 5, 6]]),
        ("0\t1\t2\n1.5\t2\t3\n4\t5\t6\n", [[1.5, 2, 3], [4, 5, 6]]),
        ("0;1;2\n1.5;2;3\n4;5;6\n", [[1.5, 2, 3], [4, 5, 6]]),
        ("1\t\t2\t3\n4\t5\t\t6\n", [[1, 2, 3], [4, 5, 6]]),  # put in line by hand
        ("\t1\t2\t3\n\t4\t5\t6\n", [[1, 2, 3], [4, 5, 6]]),
        ("1 2\t3\n4 5\t6\n", [[1, 2, 3], [4, 5, 6]]),
        ("1\t2\t3\t\n4\t5\t6\t\n", [[1, 2, 3], [4, 5, 6]]),
        ("1.0,\t2.0,\t3.0\n4.0,\t5.0,\t6.0\n", [[1, 2, 3], [4, 5, 6]]),
        ("x,\ty,\tz\n1.0,\t2.0,\t3.0\n4.0,\t5.0,\t6.0\n", [[1, 2, 3], [4, 5, 6]]),
        ("x,y,z,\tlabel\n1.0,2.0,3.0,\t1\n4.0,5.0,6.0,\t1\n", [[1, 2, 3], [4, 5, 6]]),
        ("1.0,2.0,3.0\t\n4.0,5.0,6.0\t\n", [[1, 2, 3], [4, 5, 6]]),
        ("x y z\tlabel\n1 2 3\t4\n4 5 6\t4\n", [[1, 2, 3], [4, 5, 6]]),
        ("x\t\ty\t\tz\n1\t\t2\t\t3\n4\t\t5\t\t6\n", [[1, 2, 3], [4, 5, 6]]),
        ("x y z\n1\t\t2\t3\n4\t\t5\t6\n", [[1, 2, 3], [4, 5, 6]]),
        ("x\ty\tz\t\n1\t2\t3\n4\t5\t6\n", [[1, 2, 3], [4, 5, 6]]),
    ],
)
def test_tabs(tmp_path, text, points):
    points = np.array(points)
    kept = points[np.isfinite(points).all(axis=1)]
    for name in ("p.csv", "p.txt"):
        np.testing.assert_array_equal(load_scan(write(tmp_path, name, text), drop_invalid=True).points, kept)


def test_a_missing_cell_between_tabs_does_not_move_the_labels(tmp_path):
    scan = load_scan(write(tmp_path, "p.txt", "x\ty\tz\tlabel\tconf\n1\t2\t3\t4\t5\n1\t2\t4\t\t5\n"))
    assert scan.labels is None and "'label' are not whole numbers" in scan.notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y,z\n1,5,2,5,3,5\n2,5,2,5,3,5\n", "expected rows of 3 columns, as many as have names. .* with decimal commas"),
        ("x,y,z,r\n1,2,3,4\n2,5,2,5,3,5\n", "6 cells in row 2, counting rows from 1.* here 4"),
        ("x,y,z,name\n1,2,3,a\n1,2,3,a,b\n", "5 cells in row 2"),
        ("x y z r\n1 2 3 4\n# 1\n\n1 2 3 4 5 # here\n", "5 cells in row 2"),
        ("1,2,3\n1,2,4\n1,2\n1,2,7\n", "changed from 3 to 2 in row 3, counting"),
        ("x,y,z,r\n1,2,3,4\n1,2\n", "in row 2 with 2 columns, counting"),
        ("x,y,z\n1,2,3\n1;2;4\n", "string '1;2;4' to float64 in row 2, column 1, counting"),
        ("x y z\n1 2 3\n1;2 3 4\n", "'1;2' to float64 in row 2, column 1, counting"),
    ],
)
def test_rows_of_other_lengths_are_named(tmp_path, text, words):
    with pytest.raises(FileError, match=words):
        load_scan(write(tmp_path, "p.csv", text))


@pytest.mark.parametrize("cells", ["1,2,3,", "1,2,3,,", '"1","2","3"', '1,2,3,"a, b"', "1,2,3,# 4, 5, 6"])
def test_what_a_row_may_end_with(tmp_path, cells):
    for text in (f"x,y,z,name\n4,5,6,a\n{cells}\n", *([] if "a" in cells else [f"x,y,z\n4,5,6\n{cells}\n"])):
        np.testing.assert_array_equal(load_scan(write(tmp_path, "p.csv", text)).points, [[4, 5, 6], [1, 2, 3]])


@pytest.mark.parametrize("row", ["4 5 6 Рука", "4 5 6 à", "4 5 6 b # one two"])
def test_words_of_any_script_and_comments_are_no_further_cells(tmp_path, row):
    for lines in (["1 2 3 a", row], [row, "1 2 3 a"]):
        scan = load_scan(write(tmp_path, "p.txt", "\n".join(["x y z name", *lines])))
        assert sorted(scan.points[:, 0]) == [1, 4]


@pytest.mark.parametrize(
    ("comment", "columns", "x"),
    [
        ("format: x y z", 6, 0),
        ("fields: x y z", 4, 0),
        ("fields: id x y z", 4, 1),
        ("frame 0 1 2", 6, 0),
        ("x y z", 6, 0),
        ("id x y z", 4, 1),
        ("id x y z", 6, 0),
        ("x y z nx ny nz", 9, 0),
    ],
)
def test_a_comment_names_the_columns_where_its_words_can_be_these(tmp_path, comment, columns, x):
    table = np.random.default_rng(0).integers(1, 999, (5, columns)) / 8
    scan = load_scan(write(tmp_path, "p.txt", f"# {comment}\n" + rows(table)))
    np.testing.assert_array_equal(scan.points, table[:, x : x + 3])
    assert (scan.normals is not None) == ("nx" in comment)
    unclear = comment == "id x y z" and columns == 6
    assert any("'id, x, y, z' are not names of the 6 columns" in note for note in scan.notes) == unclear


@pytest.mark.parametrize(
    "text",
    [
        'name,x,y,z,q\n"Smith, J",1,2,3,9\n"Doe, K",4,5,6,8\n',
        'x,name,y,z\n1,"Smith, J",2,3\n4,"Doe",5,6\n',
        'name x y z\n"a b" 1 2 3\nc 4 5 6',
    ],
)
def test_cells_in_quotes_are_one(tmp_path, text):
    np.testing.assert_array_equal(load_scan(write(tmp_path, "p.csv", text)).points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("names", "x"), [("px py x y z", 2), ("id 0 1 x y z", 3), ("px py pz x y z", 3), ("px py pz y", 0), ("x y z px py pz", 0)]
)
def test_axes_are_of_one_style(tmp_path, names, x):
    table = np.arange(12.0).reshape(2, 6)[:, : len(names.split())] ** 2
    scan = load_scan(write(tmp_path, "p.csv", names.replace(" ", ",") + "\n" + rows(table, sep=",")))
    np.testing.assert_array_equal(scan.points, table[:, x : x + 3])
    head = "".join(f"property float {a}\n" for a in names.split())
    ply = f"ply\nformat ascii 1.0\nelement vertex 2\n{head}end_header\n" + rows(table)
    np.testing.assert_array_equal(load_scan(write(tmp_path, "p.ply", ply)).points, table[:, x : x + 3])


def test_digits_that_were_taken_for_names_are_told_of(tmp_path):
    scan = load_scan(write(tmp_path, "p.csv", "0,1,2\n3,4,5\n6,7,8\n"))
    assert scan.notes == ("The first line, 0, 1, 2, was read as names of columns.",)


def test_labels_in_an_npz_are_those_that_fit(tmp_path):
    objects = np.array([{}] * 4, dtype=object)
    for other in (np.array([3]), np.array(["a", "b", "c", "d"]), np.full(4, 0.5), objects):
        np.savez(tmp_path / "a.npz", points=POINTS, **{"class": other}, labels=LABELS)
        np.testing.assert_array_equal(load_scan(tmp_path / "a.npz").labels, LABELS)
    np.savez(tmp_path / "a.npz", points=POINTS, labels=objects)
    with pytest.raises(FileError, match="Python objects in 'labels'"):
        load_scan(tmp_path / "a.npz")
    for one in (np.array(3), np.array([3])):
        np.savez(tmp_path / "b.npz", points=POINTS, **{"class": one})
        scan = load_scan(tmp_path / "b.npz")
        assert scan.labels is None and scan.notes == ("'class' is one value for all points: labels left out.",)


@pytest.mark.parametrize("spelt", ["-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND", "1.#INF"])
@pytest.mark.parametrize("row", [0, 2])
def test_what_some_programs_write_for_nan(tmp_path, spelt, row):
    """Also in a first row, which is no header, and in a last column, where # would begin a comment."""
    lines = [f"{x} {y} {z}" for x, y, z in POINTS]
    lines[row] = f"1 2 {spelt}"
    body = "\n".join(lines) + "\n"
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {a}\n" for a in "xyz")
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    pcd = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA ascii\n"
    files = {"a.ply": header + faces + body + "3 0 1 3\n", "a.pcd": pcd + body, "a.xyz": body, "a.csv": body.replace(" ", ",")}
    for name, text in files.items():
        path = write(tmp_path, name, text)
        with pytest.raises(FileError, match="NaN or infinite"):
            load_scan(path)
        np.testing.assert_allclose(load_scan(path, drop_invalid=True).points, np.delete(POINTS, row, axis=0))


def test_blank_lines_in_a_ply_are_nothing(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 4\n" + "".join(f"property float {a}\n" for a in "xyz")
    header += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    faces = "\n \n".join(f"3 {a} {b} {c}" for a, b, c in FACES)
    scan = load_scan(write(tmp_path, "a.ply", header + rows(POINTS) + "\n" + faces + "\n"), n_samples=50)
    assert "50 points sampled from the surface of 4 triangles." in scan.notes
    with pytest.raises(FileError, match="ends after 3 of 4 face rows"):
        load_scan(write(tmp_path, "b.ply", header + rows(POINTS) + "\n" + faces.rpartition("3 1 3")[0] + "\n\n"))


@pytest.mark.parametrize("name, sep", [("a.xyz", " "), ("a.pts", " "), ("a.asc", " "), ("a.txt", "\t"), ("a.csv", ",")])
def test_a_first_line_may_be_the_number_of_rows(name, sep, tmp_path):
    body = rows(POINTS, sep=sep)
    for first in ("4\n", "# made here\n4\n", "4\nx y z\n".replace(" ", sep)):
        scan = load_scan(write(tmp_path, name, first + body))
        np.testing.assert_array_equal(scan.points, POINTS)
    with pytest.raises(FileError, match="4 rows below a first line that is 5; expected as many rows as that"):
        load_scan(write(tmp_path, name, "5\n" + body))
    with pytest.raises(FileError, match="the first row '4'; expected numbers x, y, z"):
        load_scan(write(tmp_path, name, "4\n5\n6\n7\n8\n"))


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_labels_in_whole_numbers_of_numpys_own_size_come_back_from_trimesh(tmp_path, encoding):
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.Trimesh(POINTS, FACES, process=False)
    mesh.vertex_attributes |= {"label": LABELS.astype(np.int64), "heat": np.zeros(4, np.float16)}
    mesh.export(tmp_path / "a.ply", encoding=encoding)
    assert b"property int64 label" in (tmp_path / "a.ply").read_bytes()
    scan = load_scan(tmp_path / "a.ply")
    np.testing.assert_array_equal(scan.points, POINTS)
    assert scan.labels.tolist() == LABELS.tolist()


@pytest.mark.parametrize(
    "name, text",
    [
        ("a.csv", csv()),
        ("b.csv", csv(sep=";")),
        ("a.xyz", "# x y z nx ny nz label\n" + rows(POINTS, NORMALS, LABELS)),
        ("a.pts", "4\n" + rows(POINTS, NORMALS)),
        ("a.txt", "x y z nx ny nz label\n" + rows(POINTS, NORMALS, LABELS)),
        ("a.ply", ascii_ply()),
        ("b.ply", ply_header("binary_big_endian").replace(b"\n", b"\r") + binary_ply(">").partition(b"end_header\n")[2]),
    ],
)
def test_lines_may_end_in_a_carriage_return_alone(name, text, tmp_path):
    """As spreadsheets of old Macintoshes have them, and the first description of PLY."""
    content = text if isinstance(text, bytes) else text.encode()
    scan = load_scan(write(tmp_path, name, content if name == "b.ply" else content.replace(b"\n", b"\r")))
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_allclose(scan.normals, NORMALS, atol=1e-6)
    assert name == "a.pts" or scan.labels.tolist() == LABELS.tolist()
    if name.endswith(".ply"):
        np.testing.assert_array_equal(load_mesh(tmp_path / name)[1], FACES)


def test_pts_files_go_on_with_intensity_and_colour(tmp_path):
    body = "".join(f"{x} {y} {z} -{1000 + k} {k} 128 255\n" for k, (x, y, z) in enumerate(POINTS))
    scan = load_scan(write(tmp_path, "a.pts", f"{len(POINTS)}\n{body}"))
    np.testing.assert_array_equal(scan.points, POINTS)
    assert scan.normals is None and scan.labels is None
