"""The table of ``lbsfit bench pairs --truth``: scans, subjects, and what corresponds; four forms, told apart by their columns."""

import csv
import math
from pathlib import Path
from unicodedata import normalize

from ..errors import FileError, brief, counted, did_you_mean, from_digits, listed
from .pair_fits import made_files
from .truth import Landmarks, PairScan, Registrations, VertexOrder, read_registrations

__all__ = ["TRUTH_FILES", "read_truth"]

TRUTH_FILES = """\
FILE is a table with a heading (CSV with commas, semicolons or tabs; blank lines and lines that start with # are skipped).
Its columns say what corresponds:
      scan, subject                          files of one mesh: vertex i of one is vertex i of every other
      scan, subject, name, vertex            named places, by vertex numbers of the file, counted from 0
      scan, subject, name, x, y, z           named places, by coordinates in the scan's frame and unit
      scan, subject, registration            a mesh registered to each scan (a path relative to FILE), all of one topology
Rows of different scans with the same name correspond. Scans are file names in DIR, with or without the extension; files that
FILE does not name are left out. Without the column subject, all scans are of one subject."""

_FORMS = "scan and subject, alone or with one of (name, vertex), (name, x, y, z), (registration)"


def read_truth(path, folder, *, subject_column="subject", output=None):
    """The scans of a folder and what is known of them.

    Parameters
    ----------
    path : str or Path
        See ``TRUTH_FILES``.
    folder : str or Path
        Where the scans are.
    subject_column : str, default "subject"
    output : str or Path, optional
        Where results are written, perhaps in ``folder``: what an earlier run has written there is not counted as left out.

    Returns
    -------
    scans : list of PairScan
    truth : VertexOrder, Landmarks or Registrations
        Knows scan i as ``scans[i]``. A VertexOrder has the number of vertices of the first scan that can be read.
    notes : list of str
        What was left out.

    Raises
    ------
    FileError
        No such file or folder, columns of none of the forms, rows that make no sense, with their line; scans that are not there.
    """
    path, folder, subject_column = Path(path), Path(folder), _in_one_form(subject_column.lower())
    files = _scan_files(folder, path)
    named = _Named(files, folder)
    columns, rows = _table(path)
    form = _form(path, columns, subject_column)
    with_subject = subject_column in columns
    scans, at, entries = [], {}, []
    for line, row in rows:
        file = named.file_of(path, line, row["scan"])
        subject = _in_one_form(row[subject_column]) if with_subject else "0"
        if not subject:
            raise FileError(str(path), f"no {subject_column} in line {line}", "an id for each scan")
        if file not in at:
            at[file] = len(scans)
            scans.append(PairScan(_name(file, folder), file, subject))
            entries.append([])
        i = at[file]
        if scans[i].subject != subject:
            got = f"{brief(subject)} in line {line} for {row['scan']}, whose {subject_column} is {brief(scans[i].subject)} above"
            raise FileError(str(path), got, f"one {subject_column} for each scan")
        if entries[i] and form in ("order", "registration"):
            raise FileError(str(path), f"the scan {brief(row['scan'])} again in line {line}", "one row for each scan")
        entries[i].append((line, row))
    _check_scans(path, scans)
    truth = _MAKERS[form](path, scans, entries)
    notes = _in_no_pair(scans, truth)
    if not with_subject:
        notes.append(f"{path.name} has no column {subject_column}: all scans are assumed to be of one subject")
    known = set() if output is None else {p.resolve() for p in made_files(Path(output))}
    known |= {_registration(path, row).resolve() for rows in entries for _, row in rows if row.get("registration")}
    others = sum(p not in at and p.resolve() not in known for p in files)
    if others:
        notes.append(f"{others} of {others + len(scans)} scan files in {folder} are not in {path.name} and are left out")
    return scans, truth, notes


# ---- the table ----


def _table(path):
    """Column names in lower case, and pairs (line, row as a dict)."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise FileError(str(path), "no such file", "a table of scans and what corresponds") from None
    except OSError as error:
        raise FileError(str(path), f"a file that cannot be read ({error.strerror or error})", "a table of scans") from None
    except ValueError:
        raise FileError(str(path), "content that is not UTF-8 text", "a table of scans", "Save it as CSV in UTF-8.") from None
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.lstrip().startswith("#")]
    if len(lines) < 2:
        raise FileError(str(path), counted(len(lines), "line"), f"a heading ({_FORMS}) and a row for each scan or place")
    delimiter = max("\t;,", key=lines[0][1].count)
    table = []
    for k, line in lines:
        try:
            cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True))
        except (csv.Error, StopIteration) as error:
            got = f"{brief(line)} in line {k}, which cannot be read ({error})"
            raise FileError(str(path), got, "a row of the table") from None
        table.append((k, [cell.strip() for cell in cells]))
    columns = [_in_one_form(name.lower()) for name in table[0][1]]
    while columns and not columns[-1]:  # spreadsheets export empty columns
        columns.pop()
    rows = []
    for k, cells in table[1:]:
        while len(cells) > len(columns) and not cells[-1]:
            cells.pop()
        if len(cells) != len(columns):
            raise FileError(str(path), f"{len(cells)} columns in line {k}", f"{len(columns)}, as in the heading")
        rows.append((k, dict(zip(columns, cells, strict=True))))
    return columns, rows


def _form(path, columns, subject_column):
    """"order", "vertex", "xyz" or "registration"."""
    if len(set(columns)) < len(columns) or "scan" not in columns:
        raise FileError(str(path), f"the columns {listed(columns)}", f"each column once, and scan among them: {_FORMS}")
    if subject_column not in columns and subject_column != "subject":
        raise FileError(str(path), f"the columns {listed(columns)}", f"a column {subject_column!r}", "See --subject-column.")
    found = set(columns)
    complete = [form for form, needed in _COLUMNS.items() if needed <= found]
    if len(complete) == 1:
        return complete[0]
    # Other columns are passed over only where the truth is there: else one that is misspelt would mean the vertex order.
    if not complete and found == {"scan", subject_column} & found:
        return "order"
    raise FileError(str(path), f"the columns {listed(columns)}", _FORMS)


_COLUMNS = {"vertex": {"name", "vertex"}, "xyz": {"name", "x", "y", "z"}, "registration": {"registration"}}


# ---- scans ----


def _scan_files(folder, truth):
    from ..io.scans import SCAN_EXTENSIONS

    if not folder.is_dir():
        raise FileError(str(folder), "a file" if folder.exists() else "no such folder", "a folder of scans")
    files = [p for p in sorted(folder.rglob("*")) if p.suffix.lower() in SCAN_EXTENSIONS and p.is_file()]
    return [p for p in files if not (truth.exists() and p.samefile(truth))]


def _in_one_form(text):
    """Text with each letter put together in one way: macOS and spreadsheets have their own."""
    return normalize("NFC", text)


class _Named:
    """The files of a folder by what a row may call them: a path there, else a file name, each with or without the extension."""

    def __init__(self, files, folder):
        self.files, self.folder = files, folder
        self._by = [{} for _ in range(8)]  # as they are, then as text in one form
        for p in files:
            there = p.relative_to(folder)
            keys = there.as_posix(), there.with_suffix("").as_posix(), p.name, p.stem
            for by, key in zip(self._by, (*keys, *map(_in_one_form, keys)), strict=True):
                by.setdefault(key, []).append(p)

    def file_of(self, path, line, name):
        """The file that a row of the table at ``path`` means."""
        wanted = name.replace("\\", "/")
        found = [by.get(wanted) for by in self._by[:4]] + [by.get(_in_one_form(wanted)) for by in self._by[4:]]
        found = next(filter(None, found), [])
        if len(found) > 1:
            names = listed([p.relative_to(self.folder).as_posix() for p in found], 4)
            raise FileError(str(path), f"{brief(name)} in line {line}, which matches {names}", "a name that matches one file")
        if found:
            return found[0]
        remedy = did_you_mean(wanted, [p.name for p in self.files] + [p.stem for p in self.files])
        got = f"{brief(name)} in line {line}, which is not a scan file in {self.folder}"
        raise FileError(str(path), got, "names of scan files", remedy)


def _name(file, folder):
    return "-".join(file.relative_to(folder).with_suffix("").parts)


def _check_scans(path, scans):
    if len(scans) < 2:
        raise FileError(str(path), f"{len(scans)} scan", "at least two scans")
    seen = {}
    for scan in scans:
        other = seen.setdefault(scan.name.casefold(), scan)
        if other is not scan:
            got = f"{scan.path.name} and {other.path.name}, whose fits would have the same name"
            raise FileError(str(path), got, "scans whose names differ by more than the extension", "Rename one.")


# ---- what is known ----


def _order(path, scans, entries):
    from ..errors import LbsfitError
    from ..io.scans import load_scan

    for scan in scans:
        try:
            return VertexOrder(len(load_scan(scan.path)))
        except LbsfitError:
            continue  # it is reported with the other scans that cannot be read
    raise FileError(str(path), f"{len(scans)} scans, none of which can be read", "scans that can be read")


# So many are named in a note.
_NAMED = 5


def _in_no_pair(scans, truth):
    """Notes on what is in the table for nothing, as by a slip of the pen."""
    alone, notes = truth.alone() if isinstance(truth, Landmarks) else {}, []
    if alone:
        names = {name for places in truth.places for name in places}
        first = list(alone.items())[:_NAMED]  # to look for likenesses of all takes long where there are thousands
        said = [f"{brief(name)} ({_and_like(scans[i].name, name, names - {name})})" for name, i in first]
        said += [""] * (len(alone) - len(said))
        have = "name is of one scan alone" if len(alone) == 1 else "names are of one scan each"
        notes.append(f"{len(alone)} {have}, which no pair has: {listed(said, _NAMED)}")
    lone = [a.name for i, a in enumerate(scans) if not any(truth.linked(i, k) for k in range(len(scans)) if k != i)]
    if 0 < len(lone) < len(scans):
        notes.append(f"{len(lone)} of {len(scans)} scans {'is' if len(lone) == 1 else 'are'} in no pair: {listed(lone, _NAMED)}")
    return notes


def _and_like(scan, name, others):
    like = did_you_mean(name, sorted(others))
    return f"{scan}; {like[0].lower()}{like[1:]}" if like else scan


def _landmarks(read):
    def make(path, scans, entries):
        places, lines = [], []
        for scan, rows in zip(scans, entries, strict=True):
            here, where = {}, {}
            for line, row in rows:
                name = _in_one_form(row["name"])
                if not name:
                    raise FileError(str(path), f"no name in line {line}", "a name for each place")
                if name in here:
                    got = f"{brief(name)} of {scan.path.name} twice, in lines {where[name]} and {line}"
                    raise FileError(str(path), got, "one place of each name on a scan")
                here[name], where[name] = read(path, line, row), line
            places.append(here)
            lines.append(where)
        return Landmarks(tuple(places), tuple(lines))

    return make


def _vertex(path, line, row):
    vertex = from_digits(row["vertex"])
    if vertex is None:
        raise FileError(str(path), f"the vertex {brief(row['vertex'])} in line {line}", "a whole number of at least 0")
    return vertex


def _xyz(path, line, row):
    try:
        place = tuple(float(row[axis]) for axis in "xyz")
    except ValueError:
        place = (math.nan,)
    if not all(map(math.isfinite, place)):
        got = f"the place {listed([row[axis] for axis in 'xyz'])} in line {line}"
        raise FileError(str(path), got, "three finite numbers")
    return place


def _registration(path, row):
    return path.parent / row["registration"]


def _registrations(path, scans, entries):
    files = []
    for ((line, row),) in entries:
        if not row["registration"]:
            raise FileError(str(path), f"no registration in line {line}", "a mesh for each scan")
        files.append(_registration(path, row))
    return Registrations(*read_registrations(files), files=tuple(files))


_MAKERS = {"order": _order, "vertex": _landmarks(_vertex), "xyz": _landmarks(_xyz), "registration": _registrations}
