"""Scans as tables: CSV, XYZ and TXT files, with or without a header."""

import codecs
import csv
import re
import warnings
from itertools import islice

import numpy as np

from ..errors import FileError
from .cloud import CloudData, cloud_from_columns, column_role, in_plain_numbers

__all__ = ["ODD_X", "read_table", "unnamed"]

# How the note begins that x is hardly what was meant: of each scan that has it, the fit is all but certainly wrong.
ODD_X = "Columns 1 to 3 were read as x, y, z, but the first"

_AT_A_TIME = 1 << 20  # bytes
_MARK = codecs.BOM_UTF8
_COUNT = re.compile(r"[1-9][0-9]{0,11}")
_HEAD_LINES = 200  # comment lines before the first row; more than that is no table
# What stands for a missing value, in small letters; R writes NA, other programs null or None.
_MISSING = ("", "na", "nan", "null", "none")
# How far from 1 the length of a row may be for three unnamed columns to pass for a normal (0 is allowed as well).
_UNIT = 0.02


def read_table(path):
    """Read rows of numbers, separated by commas, semicolons, tabs or blanks.

    Columns are found by the names in a header line; without one, the first three are x, y, z, and the next three are the
    normal if they have unit length; a column before them that counts the rows is left out. An empty cell is NaN, and so are NA,
    null and None; what all rows end with is no column. Lines that start with # are comments, but for a last one that names the
    columns. Tabs side by side are blanks where a first row has no header, or as many numbers as its header has names. The first
    line may be the number of rows alone.

    Parameters
    ----------
    path : Path

    Returns
    -------
    CloudData

    Raises
    ------
    FileError
        Binary content, no rows, a header without x, y, z or of fewer columns than the rows have, but for one, rows that are not
        numbers or of different lengths.
    """
    skip, names, cells, delimiter, counted, notes = _read_head(path)
    if cells is None:
        below = "" if names is None else f" below the first line, {_row(names)!r}, which was read as a header"
        raise FileError(str(path), f"no line of numbers{below}", "one point per line")
    said = _first_said(path, skip, delimiter, cells)
    decimal_comma = delimiter in (";", "\t") and any("," in cell for cell in said)
    numeric = _numeric(said, decimal_comma)  # of x, y, z, words in a later row are an error that names it
    if names is not None and len(cells) == len(names) + 1 and said[-1]:
        if not numeric[0] or (all(numeric[:3]) and _numbers_the_rows(_load(path, skip, delimiter, [0, 1, 2], decimal_comma))):
            names = ["", *names]
            notes.append("The first column, for which the header has no name, numbers or names the rows: left out.")
    if names is None:
        # No column follows what all lines end with.
        used = [k for k in range(len(said)) if any(said[k:]) and (numeric[k] or k < 3)]
        usecols = None if len(used) == len(said) else used
        if len(cells) < 3 or not all(_numeric(cells[:3], decimal_comma)):
            raise FileError(str(path), f"the first row {_row(cells)!r}", "numbers x, y, z in the first three columns")
    else:
        roles = [column_role(name) for name in names]
        got = f"a first line {_row(names)!r} above the row {_row(said)!r}"
        if not {0, 1, 2} <= set(roles) or len(cells) < len(names):
            raise FileError(str(path), got, "columns named x, y and z, or rows of numbers without a header")
        if any(said[len(names) + 1 :]):
            remedy = "Name all columns; with decimal commas, separate them by semicolons or tabs."
            raise FileError(str(path), got, f"rows of {len(names)} columns, as many as have names", remedy)
        if (digits := [name for name in names if name.isdigit()]) and {"0", "1", "2"} <= set(digits):
            notes.append(f"The first line, {_row(names)}, was read as names of columns.")
        missing = [role in (0, 1, 2) and _is_missing(cell) for role, cell in zip(roles, cells)]
        usecols = [k for k, role in enumerate(roles) if role is not None and (numeric[k] or missing[k])]
        notes += [
            f"Column {names[k].strip()!r} does not hold numbers: left out."
            for k, role in enumerate(roles)
            if role is not None and k not in usecols
        ]
        if not {0, 1, 2} <= {roles[k] for k in usecols}:
            raise FileError(str(path), f"text in the columns x, y, z: {_row(cells)!r}", "numbers")
    table = _load(path, skip, delimiter, usecols, decimal_comma)
    if usecols is not None:
        _check_lengths(path, skip, delimiter, max(len(cells), len(names or ())))
    if counted is not None and counted != len(table):
        got = f"{len(table)} rows below a first line that is {counted}"
        remedy = "The file may be truncated. If that is no number of rows, delete the line."
        raise FileError(str(path), got, "as many rows as that", remedy)
    if names is None:
        cloud = unnamed(table, *_IN_TABLES)
    else:
        cloud = cloud_from_columns(path, "columns", [names[k] for k in usecols], lambda k: table[:, k])
    cloud.notes[:0] = notes
    return cloud


def _read_head(path):
    """Lines to skip, column names or None, the cells of the first row (None: there is none), the delimiter, the number of rows
    where the first line says it alone, else None, and notes.
    """
    names, seen_comment, counted, notes = None, None, None, []
    with open(path, "rb") as file:
        start = file.read(4096)
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise FileError(str(path), "text in UTF-16", "text in UTF-8 with one point per line", "Save it as CSV in UTF-8.")
    if b"\0" in start:
        raise FileError(str(path), "binary content", "a text file with one point per line", "Check the extension.")
    with open(path, encoding="utf-8-sig", errors="replace") as file:  # as text: lines may end in a carriage return alone
        for skip in range(_HEAD_LINES):
            raw = file.readline(100_000)
            line = in_plain_numbers(raw.strip("\n"))
            if not raw:
                return skip, names, None, None, None, notes
            if not line.strip():
                continue
            if line.lstrip().startswith(("#", "//")):
                seen_comment = line.lstrip().lstrip("#/")
                continue
            delimiter = _delimiter(line, names)
            cells = _cells(line, delimiter)
            if counted is None and names is None and len(cells) == 1 and _COUNT.fullmatch(cells[0]):
                counted, only = int(cells[0]), (skip, cells)
                continue
            if names is None and _is_header(cells, delimiter):
                names, header, of_header = _without_empty_ends(cells), line, delimiter
                continue
            cells = _cells(line.split("#", 1)[0], delimiter)
            if names is None and seen_comment is not None:
                names = _named_in(seen_comment, len(cells), notes)
            elif names is not None and of_header == "\t" and delimiter is None:  # "x y z<tab>label"
                names = _cells(header, None)
            if counted is not None and names is None and len(cells) < 3:  # one column, of which that is the first row
                skip, cells = only
                counted = None
            return skip, names, cells, delimiter, counted, notes
    raise FileError(str(path), f"no row of numbers in the first {_HEAD_LINES} lines", "one point per line")


def _first_said(path, skip, delimiter, cells):
    """Of each column the first cell that is not missing: the first row's, or a later one's; "" where all rows have nothing there.

    Where all that rows have is a word for what is missing, that word.
    """
    said, ends = list(cells), "\r\n \t" + (delimiter or "")
    missing = [k for k, cell in enumerate(said) if _is_missing(cell)]
    if not missing:
        return said
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in islice(file, skip, None):
            if delimiter is not None and line.rstrip(ends).count(delimiter) < missing[0]:
                continue  # what most rows are where all end with a delimiter
            found = _cells(in_plain_numbers(line).split("#", 1)[0], delimiter)
            for k in missing:
                said[k] = found[k] if k < len(found) and found[k] else said[k]
            missing = [k for k in missing if _is_missing(said[k])]
            if not missing:
                break
    return said


def _delimiter(line, names):
    """What separates the cells of a line, None for blanks; ``names``: those above it, if there are any."""
    if ";" in line:
        return ";"
    cells = _cells(line, "\t")
    if "," in line and (len(cells) < 3 or any(cell.endswith(",") for cell in cells)):
        return ","
    if "\t" not in line.rstrip():
        return None
    if any(len(cell.split()) > 1 and all(map(_is_number, cell.split())) for cell in cells):
        return None
    if names is None:
        aligned = "" in _cells(line.strip(), "\t") or (line.startswith("\t") and not _is_header(cells, "\t"))
    else:
        aligned = len(cells) != len(names) == sum(map(bool, cells))
    return None if aligned else "\t"


def _without_empty_ends(cells):
    while cells and not cells[-1]:
        cells = cells[:-1]
    return cells


def _named_in(comment, n, notes):
    """Names of n columns, in a comment above the first row; None where it does not name x, y, z of these.

    A note is added where they are named, but which of the columns they are is not clear.
    """
    names = _cells(comment, next((d for d in (";", "\t", ",") if d in comment), None))
    while names and names[0].endswith(":"):  # "columns: x y z"
        names = names[1:]
    roles = [None if name.isdigit() else column_role(name) for name in names]
    if not {0, 1, 2} <= set(roles):
        return None
    if len(names) > n or (len(names) < n - 1 and roles[:3] != [0, 1, 2]):
        got = f"{_row(names)!r} are not names of the {n} columns"
        notes.append(f"The words of the comment above the first row, {got}: columns 1 to 3 were read as x, y, z.")
        return None
    return names if len(names) >= n - 1 else names + [""] * (n - len(names))


def _cells(line, delimiter):
    if delimiter is None:
        found = re.findall(r'"[^"]*"|\S+', line)
    else:
        try:
            found = next(csv.reader([line], delimiter=delimiter, skipinitialspace=delimiter != "\t"), [])
        except csv.Error:  # a cell of a hundred thousand characters
            found = line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in found]


def _is_header(cells, delimiter):
    """Whether a line names the columns. "0,1,2", which a data frame without names writes above its rows, does.

    A point may lack a coordinate, or all: then only the names of all three make a header of the words after them.
    """
    filled = [cell for cell in cells if cell]
    if delimiter is not None and len(filled) > 2 and filled == [str(k) for k in range(len(filled))]:
        return True
    if delimiter in (";", "\t"):
        cells = [cell.replace(",", ".") for cell in cells]
    if all(_is_number(cell) or not cell for cell in cells):
        return False
    first = [cell for cell in cells[:3] if cell]
    return not all(map(_is_number, first)) if first else {0, 1, 2} <= {column_role(cell) for cell in cells}


def _begins_with_a_mark(path):
    """Whether a file has the mark that some programs write before UTF-8."""
    with open(path, "rb") as file:
        return file.read(len(_MARK)) == _MARK


def _has_odd_cells(path, delimiter):
    """Whether a file may have cells that :func:`_lines` puts more plainly."""
    odd = (b"1.#", b"nan(", b"NaN(", b"NAN(", *([b' "'] if delimiter in (",", ";") else []))
    with open(path, "rb") as file:
        end = b""
        while block := file.read(_AT_A_TIME):
            block = end + block
            if any(word in block for word in odd):
                return True
            end = block[-3:]
    return False


def _lines(path, delimiter, decimal_comma):
    """The lines of a file without that mark, numbers with decimal points and spelt plainly, no blank before a cell's quotes."""
    quotes = re.compile(rf'(^|{delimiter}) +"') if delimiter in (",", ";") else None
    with open(path, encoding="latin-1") as file:
        for k, line in enumerate(file):
            line = in_plain_numbers(line if k else line.removeprefix(_MARK.decode("latin-1")))
            if quotes is not None and ' "' in line:
                line = quotes.sub(r'\1"', line)
            yield line.replace(",", ".") if decimal_comma else line


def _load(path, skip, delimiter, usecols, decimal_comma):
    """The wanted columns as an (n, c) array."""
    options = {"delimiter": delimiter, "usecols": usecols, "ndmin": 2, "skiprows": skip, "encoding": "latin-1", "quotechar": '"'}
    plain = not decimal_comma and not _begins_with_a_mark(path) and not _has_odd_cells(path, delimiter)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return np.loadtxt(path if plain else _lines(path, delimiter, decimal_comma), **options)
            except ValueError:  # Slower: with missing values, and decimal commas after a first row without.
                point = "," if delimiter in (";", "\t") else "."
                options |= {"converters": lambda cell: _value(cell, point)}
                return np.loadtxt(path if plain else _lines(path, delimiter, decimal_comma), **options)
    except (ValueError, IndexError) as error:
        what, first = str(error).split("; use ")[0].rstrip("."), str(error).startswith("could not convert")  # this counts from 0
        what = re.sub(r"at row (\d+)", lambda m: f"in row {int(m[1]) + first}", what)
        expected = "one point per line, the same number of columns in each"
        raise FileError(
            str(path), f"rows that cannot be read ({what}, counting rows from 1 below any header)", expected
        ) from None


def _check_lengths(path, skip, delimiter, n):
    """Raise where a row has more than the n cells of the first: NumPy does not count those that it does not load."""
    with open(path, encoding="utf-8", errors="replace") as file:
        for _ in range(skip):
            next(file, None)
        row = 0
        for line in file:
            line = line.split("#", 1)[0].rstrip("\r\n \t" + (delimiter or ""))
            row += bool(line.strip())
            at_most = len(line.split()) if delimiter is None else line.count(delimiter) + 1
            if at_most > n and (found := len(_cells(line, delimiter))) > n:
                got = f"rows that cannot be read ({found} cells in row {row}, counting rows from 1 below any header)"
                raise FileError(str(path), got, f"one point per line, the same number of columns in each, here {n}")


# How far steps from time to time may differ, as a share of them: times are rounded, and clocks jitter.
_EVENLY = 0.1
# What notes on columns without names advise: on row numbers, and on further columns.
_IN_TABLES = (
    "leave it out, or name the columns in a header line (row x y z)",
    "a header line (x y z nx ny nz label)",
)


def unnamed(table, without_rows, with_names):
    """A cloud from columns without names: x, y, z, and the normal where the next three columns have unit length.

    Before them may stand the numbers of the rows, as data frames write them. The last two arguments are for notes.
    """
    if table.shape[1] > 3 and _counts_the_rows(table):
        cloud = unnamed(table[:, 1:], without_rows, with_names)
        cloud.notes.insert(0, "The first column, which counts the rows, was left out.")
        return cloud
    cloud = CloudData(table[:, :3])
    if table.shape[1] > 3 and (kind := _no_coordinate(table)):
        first = ", ".join(str(number) if kind == "times" else f"{number:.0f}" for number in table[:3, 0])
        cloud.notes.append(f"{ODD_X} ({first}, …) looks like {kind}: {without_rows}.")
    used = 3
    if table.shape[1] >= 6:
        length = np.linalg.norm(table[:, 3:6].astype(float), axis=1)
        if np.all((abs(length - 1) < _UNIT) | (length == 0)) and length.any():
            cloud.normals, used = table[:, 3:6], 6
    if table.shape[1] > used:
        columns = f"{table.shape[1] - used} further columns" if table.shape[1] - used > 1 else "One further column"
        taken = "1 to 3 are x, y, z" if used == 3 else "1 to 6 are x, y, z and the normal"
        cloud.notes.append(f"{columns} without a name left out (columns {taken}): to name the columns, use {with_names}.")
    return cloud


def _numbers_the_rows(table):
    return _counts_the_rows(table) or _looks_like_row_numbers(table)


def _counts_the_rows(table):
    """Whether the first column goes from 0 or 1 in steps of 1."""
    return len(table) > 3 and table[0, 0] in (0, 1) and np.array_equal(np.diff(table[:, 0]), np.ones(len(table) - 1))


def _no_coordinate(table):
    """What the first column looks like, where that is no coordinate; None where it may be one."""
    if _looks_like_row_numbers(table):
        return "row numbers"
    steps = np.diff(table[:, 0].astype(float))
    # Points may be in the order of one of their coordinates, but are not evenly spaced along it then.
    evenly = len(steps) > 2 and steps.min() > 0 and np.ptp(steps) < _EVENLY * steps.mean()
    return "times" if evenly else None


def _looks_like_row_numbers(table):
    """Whether the first column is of whole numbers that rise from row to row, as in a data frame of which rows were left out.

    Or of such in another order, as in one that was shuffled: all distinct, and beside columns 2 and 3 that are not whole.
    """
    first, *others = table[:, :3].T
    if len(first) < 4 or not (first == np.floor(first)).all():
        return False
    shuffled = len(np.unique(first)) == len(first) and all((other > np.floor(other)).any() for other in others)
    return bool((first[1:] > first[:-1]).all()) or shuffled


def _numeric(cells, decimal_comma):
    """Of each cell, whether it is a number or missing."""
    return [not cell or _is_number(cell.replace(",", ".") if decimal_comma else cell) for cell in cells]


def _is_number(cell):
    """Whether a cell is a number, or a word for a missing one."""
    try:
        float(cell)
    except ValueError:
        return cell != "" and _is_missing(cell)
    return True


def _is_missing(cell):
    return cell.lower() in _MISSING


def _value(cell, point):
    cell = cell.strip().strip('"').strip()
    return np.nan if _is_missing(cell) else float(cell.replace(point, "."))


def _row(cells):
    return ", ".join(cells)[:80]
