"""Cells of tables that hold no number: which columns there are, whatever row they are in, what stands for them, and quotes."""

import numpy as np
import pytest
from scan_files import POINTS, rows, write

from lbsfit_np.errors import FileError
from lbsfit_np.io.scans import load_scan

COUNTED = "The first column, which counts the rows, was left out."
LOST = "1 of 4 points have a coordinate that is NaN or infinite: left out."


def table(row, cells, *, sep=",", head="", counted=False, end=""):
    """The four points as text, of which one has other cells."""
    lines = [sep.join(map(str, point)) for point in POINTS]
    lines[row] = cells
    return head + "".join(f"{f'{k}{sep}' if counted else ''}{line}{end}\n" for k, line in enumerate(lines))


def check(path, row, notes=(LOST,)):
    with pytest.raises(FileError, match=f"1 of 4 points .* first at index {row}"):
        load_scan(path)
    scan = load_scan(path, drop_invalid=True)
    np.testing.assert_array_equal(scan.points, np.delete(POINTS, row, axis=0))
    assert scan.notes == notes


EMPTY = [",,", ",2,0.5", "2,,0.5", "2,0,"]


@pytest.mark.parametrize("cells", EMPTY)
@pytest.mark.parametrize("row", [0, 2])
def test_an_empty_cell_is_nan_in_any_row(tmp_path, cells, row):
    check(write(tmp_path, "p.csv", table(row, cells)), row)
    check(write(tmp_path, "p.csv", table(row, cells, counted=True)), row, (COUNTED, LOST))
    check(write(tmp_path, "p.csv", table(row, cells, end=",")), row)
    check(write(tmp_path, "p.csv", table(row, cells.replace(",", ";"), sep=";")), row)


@pytest.mark.parametrize("cells", EMPTY)
@pytest.mark.parametrize("row", [0, 2])
def test_a_first_row_with_an_empty_cell_beside_words_is_no_header(tmp_path, cells, row):
    check(write(tmp_path, "p.csv", table(row, cells, end=",arm")), row)


def test_words_below_an_empty_cell_of_the_first_row_are_no_numbers(tmp_path):
    for head, notes in (("", ()), ("x,y,z,label\n", ("Column 'label' does not hold numbers: left out.",))):
        for first in ("", "None"):
            scan = load_scan(write(tmp_path, "p.csv", f"{head}1,2,3,{first}\n4,5,6,arm\n"))
            np.testing.assert_array_equal(scan.points, [[1, 2, 3], [4, 5, 6]])
            assert scan.notes == notes
    for head in ("", "x,y,z\n"):
        with pytest.raises(FileError, match="'five' to float64 in row 2, column 2"):
            load_scan(write(tmp_path, "p.csv", f"{head}1,,3\n4,five,6\n"))


@pytest.mark.parametrize("row", [0, 2])
def test_a_header_without_a_name_for_the_rows_is_known_where_a_last_cell_is_empty(tmp_path, row):
    said = "The first column, for which the header has no name, numbers or names the rows: left out."
    check(write(tmp_path, "p.csv", table(row, "2,0,", head="x,y,z\n", counted=True)), row, (said, LOST))


def test_a_column_that_is_empty_in_all_rows_is_none_if_it_is_the_last(tmp_path):
    with pytest.raises(FileError, match=r"shape \(4, 2\)"):
        load_scan(write(tmp_path, "p.csv", rows(POINTS[:, :2], sep=",").replace("\n", ",\n")))
    with pytest.raises(FileError, match="4 of 4 points"):
        load_scan(write(tmp_path, "p.csv", rows(POINTS, sep=",,")))


def test_names_of_points_may_have_more_than_two_columns_before_x(tmp_path):
    scan = load_scan(write(tmp_path, "p.csv", ",,,x,y,z\n" + rows(np.ones((4, 3)), POINTS, sep=",")))
    np.testing.assert_array_equal(scan.points, POINTS)


@pytest.mark.parametrize("word", ["NA", "na", "null", "NULL", "None", "none", "NaN", "NAN", '"NA"'])
@pytest.mark.parametrize("row", [0, 2])
@pytest.mark.parametrize("sep", [",", ";", " ", "\t"])
def test_words_for_a_missing_value(tmp_path, word, row, sep):
    for cells in ([word] * 3, ["2", word, "0.5"]):
        check(write(tmp_path, "p.csv", table(row, sep.join(cells), sep=sep)), row)
        check(write(tmp_path, "p.csv", table(row, sep.join(cells), sep=sep, head=sep.join("xyz") + "\n")), row)


def test_other_words_are_still_an_error(tmp_path):
    with pytest.raises(FileError, match="'missing' to float64 in row 2, column 3"):
        load_scan(write(tmp_path, "p.csv", "1 2 3\n4 5 missing\n"))
    with pytest.raises(FileError, match="'4,5' to float64 in row 2, column 1"):
        load_scan(write(tmp_path, "p.csv", "1 2 3\n4,5 5 6\n"))


@pytest.mark.parametrize(
    "text",
    [
        '"1.5", "2.5", "3.5"\n"4", "5", "6"\n',
        'x, y, z\n"1.5", "2.5", "3.5"\n"4", "5", "6"\n',
        '"1,5"; "2,5"; "3,5"\n"4"; "5"; "6"\n',
        '1.5,2.5,3.5, "Smith, J"\n4,5,6, "Doe"\n',
        'x,name,y,z\n1.5, "Smith, 7, 8, J", 2.5, 3.5\n4, "Doe", 5, 6\n',
        ' "1.5" ,  "2.5" ,"3.5"\n4,5, "6"\n',
    ],
)
def test_blanks_before_quotes_belong_to_no_cell(tmp_path, text):
    np.testing.assert_array_equal(load_scan(write(tmp_path, "p.csv", text)).points, [[1.5, 2.5, 3.5], [4, 5, 6]])
