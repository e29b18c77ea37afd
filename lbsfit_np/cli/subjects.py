"""``--subjects FILE``: who was scanned in which file, from a table that people write by hand or export."""

import csv
import os
import re
import shlex
import tomllib
from collections import Counter
from contextlib import suppress
from difflib import SequenceMatcher, get_close_matches
from functools import cached_property
from pathlib import Path
from unicodedata import normalize

from ..errors import FileError, InputError, brief, counted, did_you_mean, listed
from .earlier_results import results_beside
from .same_files import folded, identity

__all__ = ["SUBJECT_FILES", "check_no_table", "read_subjects", "who_words"]

SUBJECT_FILES = """\
The file given to --subjects has one line per scan: its file name, with or without the extension, and an id:
      anna_01.ply, anna          separated by commas, semicolons, tabs, or blanks before the id (then no blanks in ids)
      ben_01, ben                blank lines, lines that start with # and a heading such as "scan, subject" are skipped
Or it is TOML (NAME.toml): "anna_01.ply" = "anna", at the top or in a table [subjects]. Scans with the same name are told
apart by their paths as given on the command line. Each scan has one id. A name that is not a given scan is an error, but
results of lbsfit beside their scans may be named, and are skipped."""

_HEADINGS = {"scan", "scans", "file", "filename", "file name", "name", "path"}
_SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", None: "blanks"}
_ONE = {"\t": "a tab", ";": "a semicolon", ",": "a comma", None: "a comma in all lines, or a blank,"}
_EXPECTED = "one line for each scan: its file name, a comma, the subject's id"
_EXPECTED_TOML = 'one line for each scan, such as "anna_01.ply" = "anna"'
# What is looked at of a scan that may be a table, and of scans that a table lacks.
_FIRST_BYTES, _FIRST_MISSING = 4096, 20
_LISTED = 12  # subjects, at most
# Ids as like as this, by difflib's ratio, may be typing errors; of more ids than so many, none are compared.
_ALIKE, _COMPARED = 0.7, 300
_NO_HEADING = 'If it is a heading, write "scan" in its place; if it is a scan that is not given to this command, leave it out.'
_FILE_FIRST = "The columns seem to be swapped: put the file name first, then the id."


def read_subjects(path, scans, *, others=False, known=None):
    """The subject's id of every scan.

    Parameters
    ----------
    path : str
        See ``SUBJECT_FILES``.
    scans : list of str
        Paths of the scans as given.
    others : bool, default False
        Whether the file may name scans besides, which are passed over, and leave ids empty: whose those scans are is not known.
    known : callable (id as text) → id, optional
        Raises InputError for one that cannot be used, which is then said to be the file's.

    Returns
    -------
    list of str or what ``known`` returns; None where the id is empty

    Raises
    ------
    FileError
        Unreadable, a line that is no pair, a name that is no scan or several, a scan with two ids or none; with the line.
    """
    text = _text(path)
    is_toml = Path(path).suffix.lower() == ".toml"
    rows, expected = (_toml_rows(path, text), _EXPECTED_TOML) if is_toml else (_table_rows(path, text), _EXPECTED)
    names, results = _Names(scans), None
    if rows and rows[0][1].casefold() in _HEADINGS and not names.of(rows[0][1]):
        del rows[0]
    ids, lines, passed = {}, {}, []
    for line, name, subject in rows:
        found = names.of(name)
        if not found:
            results = results or _Names(results_beside(scans))
            if results.of(name):  # exported with the scans, and left out with a line already
                continue
        if not found and others:
            passed.append((line, name, subject))
            continue
        if not found:
            named = {i for _, other, _ in rows for i in names.of(other)}
            first = line == rows[0][0] and all(names.of(other) for _, other, _ in rows[1:]) and len(rows) > 1
            remedy = _NO_HEADING if first else "Leave out scans that are not given to this command."
            remedy = did_you_mean(name, names.without(named)) or remedy
            headed = not named and any(names.of(other) for _, _, other in rows)  # this is a heading then
            remedy = _FILE_FIRST if headed or names.of(subject) else remedy
            raise FileError(str(path), f"{brief(name)} in line {line}, which is none of the scans given", expected, remedy)
        if len(found) > 1:
            got = f"{brief(name)} in line {line}, which is the name of {len(found)} scans"
            raise FileError(str(path), got, "a name that only one scan has", f"Write its path, such as {scans[found[0]]}")
        i = found[0]
        if i in ids:
            raise FileError(str(path), f"the scan {brief(name)} twice, in lines {lines[i]} and {line}", expected)
        if not subject and not others:
            raise FileError(str(path), f"no id for {brief(name)} in line {line}", expected)
        if subject and known is not None:
            try:
                subject = known(subject)
            except InputError as error:
                got = f"{error.got}, the id of {brief(name)} in line {line}"
                raise FileError(str(path), got, error.expected, error.remedy) from None
        ids[i], lines[i] = None if subject == "" else subject, line
    missing = [s for i, s in enumerate(scans) if i not in ids]
    if missing:
        got = f"no id for {len(missing)} of {len(scans)} scans: {listed(missing, 5)}"
        if passed and not ids:
            got = f"a file that names none of these scans: {listed([brief(s) for s in missing], 5)}"
        unknown = ", with an empty id where the subject is unknown" if others else ""
        remedy = " ".join([*_likeness(missing, passed), f"Add them{unknown}, or leave these scans out."])
        if any(names.of(subject) for _, _, subject in passed):
            remedy = _FILE_FIRST
        raise FileError(str(path), got, expected, remedy)
    return [ids[i] for i in range(len(scans))]


def check_no_table(scans, remedy):
    """Raise where one of the scans is a table that says whose the others are: the others would be worked at for long.

    ``remedy`` : what to do with it, with "{}" for the file. Clouds have three columns, and names of scans in none of them.
    """
    names = _Names(scans)
    for i, scan in enumerate(scans):
        try:
            with open(scan, "rb") as f:
                start = f.read(_FIRST_BYTES)
        except OSError:
            continue
        lines = start.decode("utf-8-sig", errors="replace").splitlines()[: -1 if len(start) == _FIRST_BYTES else None]
        lines = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
        pairs = [pair for pair in map(_pair, lines) if any(set(names.of(cell)) - {i} for cell in pair)]
        if 2 * len(pairs) >= len(lines) > 0:
            raise InputError("SCAN", f"{scan}, a table that names other scans", "scans", remedy.format(shlex.quote(scan)))


def _pair(line):
    """The two columns of a line of a table, or of TOML; none where it has another number."""
    cells = re.split("[\t;,=]", line) if re.search("[\t;,=]", line) else line.split()
    while len(cells) > 2 and not cells[-1]:
        cells.pop()
    return [cell.strip(" \"'") for cell in cells] if len(cells) == 2 else []


def _likeness(missing, passed):
    """What a name that is no scan may mean, of those that are missing: the first such one, in a list; else none."""
    by_numbers = {}  # scans of a series differ in their numbers alone, and none of them stands for another
    for line, name, _ in passed:
        by_numbers.setdefault(_numbers(name), {}).setdefault(Path(name).stem.casefold(), []).append((name, line))
    for scan in missing[:_FIRST_MISSING]:
        alike = by_numbers.get(_numbers(scan), {})
        if close := get_close_matches(Path(scan).stem.casefold(), alike, n=1):  # endings are alike in any case
            named = [(_folders_likeness(scan, name), name, line) for name, line in alike[close[0]]]
            likeness, name, line = max(named, key=lambda row: row[0])
            if likeness < _ALIKE:  # as where each person has a folder: this row is of another one's scan
                continue
            words = f"If {brief(name)} in line {line} means {brief(scan)}, write it that way"
            return [f"{words}: name scans by their file names, or as on the command line."]
    return []


def _folders_likeness(scan, name):
    """How alike the folders of two paths are, from the last on, as far as both have any; 0 where these differ in numbers.

    Where one is absolute or deeper, it may have another root: then of folders above the last those count that are alike but for
    numbers.
    """
    a, b = ([f.casefold() for f in reversed(Path(path).parent.parts) if f.strip("./\\")] for path in (scan, name))
    pairs = list(zip(a, b))
    if len(a) != len(b) or Path(scan).is_absolute() != Path(name).is_absolute():
        pairs = pairs[:1] + [(x, y) for x, y in pairs[1:] if re.sub("[0-9]+", "0", x) == re.sub("[0-9]+", "0", y)]
    return min((SequenceMatcher(None, x, y).ratio() * (_numbers(x) == _numbers(y)) for x, y in pairs), default=1.0)


def _numbers(name):
    return tuple(map(int, re.findall("[0-9]+", Path(name).stem)))


class _Names:
    """Which scans a name means: a path as given or the same file, else a file name, else one without the extension."""

    def __init__(self, scans):
        self.scans = scans
        self.tables = [{}, {}, {}]
        for i, scan in enumerate(scans):
            for table, key in zip(self.tables, (scan, Path(scan).name, Path(scan).stem), strict=True):
                table.setdefault(normalize("NFC", key), []).append(i)

    def of(self, name):
        name = normalize("NFC", name)  # some systems write accents into file names as letters of their own
        for table in self.tables:
            if name in table:
                return table[name]
        return self._by_file(name) if Path(name).name != name else []  # another way to write a path

    def _by_file(self, name):
        """As ``same_file`` finds them: one by one that takes too long where each of thousands of scans has such names."""
        known, places = self.files
        try:
            return known.get(identity(name), [])
        except (OSError, ValueError):
            return places.get(folded(os.path.abspath(name)), [])

    @cached_property
    def files(self):
        """Scans by their files, where they are there, and all by their places."""
        known, places = {}, {}
        for i, scan in enumerate(self.scans):
            places.setdefault(folded(os.path.abspath(scan)), []).append(i)
            with suppress(OSError, ValueError):
                known.setdefault(identity(scan), []).append(i)
        return known, places

    def without(self, scans):
        """Names that mean other scans, too."""
        return [name for table in self.tables for name, found in table.items() if set(found) - scans]


def _text(path):
    expected = "a table of scans and subjects: CSV, TSV, text or TOML"
    try:
        return Path(path).read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise FileError(str(path), "no such file", expected) from None
    except OSError as error:
        raise FileError(str(path), f"a file that cannot be read ({error.strerror or error})", expected) from None
    except ValueError:  # UTF-8, or NUL in the name
        raise FileError(str(path), "content that is not UTF-8 text", expected, "Save it as CSV in UTF-8.") from None


def _table_rows(path, text):
    """Triples (line, name, id)."""
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.lstrip().startswith("#")]
    first = lines[0][1] if lines else ""
    seen = first.rstrip() if len(first.split()) > 1 else first  # what stands behind the id separates nothing
    delimiter = next((d for d in _SEPARATORS if d is not None and d in seen), None)
    rows = []
    for k, line in lines:
        cells = line.rsplit(None, 1) if delimiter is None else _cells(path, k, line, delimiter)
        cells = [cell.strip() for cell in cells]
        while len(cells) > 2 and not cells[-1]:  # spreadsheets export empty columns
            cells.pop()
        if len(cells) != 2:
            first = lines[0][0]
            separated = f" (separated by {_SEPARATORS[delimiter]}, as in line {first})" if k != first else ""
            remedy = "Leave out the other columns, and put names that contain a separator in quotes."
            if len(cells) == 1:
                remedy = f"Put {_ONE[delimiter]} between name and id."
            got = f"{brief(line)} in line {k}, which has {counted(len(cells), 'column')}{separated}"
            raise FileError(str(path), got, _EXPECTED, remedy)
        rows.append((k, cells[0], normalize("NFC", cells[1])))
    return rows


def _cells(path, k, line, delimiter):
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True))
    except (csv.Error, StopIteration) as error:
        raise FileError(str(path), f"{brief(line)} in line {k}, which cannot be read ({error})", _EXPECTED) from None


def _toml_rows(path, text):
    """The same of a TOML file; its parser keeps no lines, so that they are looked up."""
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise FileError(str(path), f"text that is not TOML ({error})", _EXPECTED_TOML) from None
    if set(content) == {"subjects"} and isinstance(content["subjects"], dict):
        content = content["subjects"]
    rows = []
    for name, subject in content.items():
        match = re.search(rf"""^\s*(\[\s*)*["']?{re.escape(name)}(?=["'\s=.\]])""", text, flags=re.MULTILINE)
        line = text.count("\n", 0, match.end()) + 1 if match else "?"
        if type(subject) not in (str, int):
            remedy = "Ids are text, in quotes, or whole numbers."
            if match is not None and match[1] is not None:  # the head of a table
                remedy = "Put all names at the top, or all in [subjects]."
            elif isinstance(subject, dict):
                remedy = "Put names with dots in quotes."
            got = str(subject).lower() if isinstance(subject, bool) else brief(subject)  # as TOML has it
            raise FileError(str(path), f"{name} = {got} in line {line}", _EXPECTED_TOML, remedy)
        rows.append((line, name, normalize("NFC", str(subject).strip())))
    return rows


def who_words(subjects):
    """Whose the scans are, in lines: how many of each, and ids that may be one person's; nothing of one subject.

    Parameters
    ----------
    subjects : list of str or None
        Ids, one for each scan.
    """
    counts = Counter(subjects or ())
    if len(counts) > 1:
        fewest = sorted(counts, key=counts.get)[:_LISTED]  # ids that are typing errors have few
        listed = ", ".join(f"{subject} {counts[subject]}" for subject in fewest) + ", …" * (len(counts) > _LISTED)
        yield f"{len(counts)} subjects, with these numbers of scans: {listed}"
    alike = {}
    for subject in counts:
        alike.setdefault(subject.casefold(), []).append(subject)
    for ids in alike.values():
        if len(ids) > 1:
            yield f"note: {' and '.join(map(repr, ids))} differ only in upper and lower case: are they one person?"
    for subject in counts if len(counts) <= _COMPARED else ():
        others = [s for s in counts if counts[s] > 1 and _numbers(s) == _numbers(subject) and s.casefold() != subject.casefold()]
        if counts[subject] == 1 and (close := get_close_matches(subject, others, n=1, cutoff=_ALIKE)):
            yield f"note: {subject!r} has one scan, and is like {close[0]!r}: are they one person?"
