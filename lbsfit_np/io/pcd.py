"""PCD scans (Point Cloud Library): ascii, binary and binary_compressed, versions 0.6 and 0.7."""

import os
import struct
import warnings

import numpy as np

from ..errors import FileError
from .cloud import cloud_from_columns, columns_by_role, in_plain_numbers

__all__ = ["read_pcd"]

_KEYS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


def read_pcd(path):
    """Read a PCD file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    CloudData
        The viewpoint is not applied: points stay in the sensor's frame, as they are stored.

    Raises
    ------
    FileError
        Not a PCD file, an unusual header, or a file that ends too early.
    """
    with open(path, "rb") as file:
        header = _read_header(file, path)
        names, dtypes, n, mode = header
        if mode == "ascii":
            columns = _read_ascii(file, path, names, dtypes, n)
        elif mode == "binary":
            columns = _read_binary(file, path, dtypes, n)
        else:
            columns = _read_compressed(file, path, dtypes, n)
    return cloud_from_columns(path, "fields", names, columns.__getitem__)


def _read_header(file, path):
    """Field names, their dtypes, the number of points and the kind of data."""
    header = {}
    while "DATA" not in header:
        line = file.readline(10_000)
        words = line.decode("latin-1").split()
        if not line or (words and not words[0].startswith("#") and words[0].upper() not in _KEYS):
            got = f"the header line {line[:60].decode('latin-1').strip()!r}" if line else "a header without a DATA line"
            raise FileError(str(path), got, "the header of a PCD file", "Check the extension; the file may be damaged.")
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    try:
        names = header.get("FIELDS") or header["COLUMNS"]
        sizes = [int(s) for s in header["SIZE"]]
        kinds = [{"F": "f", "I": "i", "U": "u"}[t.upper()] for t in header["TYPE"]]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(names))]
        if not len(names) == len(sizes) == len(kinds) == len(counts) or min(counts, default=0) < 1:
            raise ValueError
        dtypes = [np.dtype((f"<{kind}{size}", (count,))) for kind, size, count in zip(kinds, sizes, counts)]
        n = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header.get("HEIGHT", ["1"])[0])
        mode = header["DATA"][0].lower()
        if n < 0 or mode not in ("ascii", "binary", "binary_compressed"):
            raise ValueError
    except (LookupError, ValueError, TypeError):
        said = "; ".join(f"{key} {' '.join(header[key])}" for key in ("FIELDS", "SIZE", "TYPE", "COUNT", "DATA") if key in header)
        expected = "FIELDS, SIZE, TYPE and COUNT of equal length, POINTS, and DATA ascii, binary or binary_compressed"
        raise FileError(str(path), f"the header {said!r}", expected) from None
    return names, dtypes, n, mode


def _read_ascii(file, path, names, dtypes, n):
    """Field number → values, of the fields that are looked at; as floats, so that no value wraps around in a field's type."""
    first = np.cumsum([0] + [d.shape[0] for d in dtypes])
    wanted = sorted(columns_by_role(names).values())
    if n == 0 or not wanted:
        return dict.fromkeys(wanted, np.empty(0))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of blank lines and of no lines at all
            rows = min(n, os.fstat(file.fileno()).st_size)  # no file has more rows than bytes
            lines = (in_plain_numbers(line.decode("latin-1")) for line in file)
            table = np.loadtxt(lines, comments=None, usecols=[first[k] for k in wanted], max_rows=rows, ndmin=2)
    except ValueError as error:
        raise FileError(str(path), f"rows that cannot be read ({error})", f"numbers for {', '.join(names)}") from None
    if len(table) < n:
        raise _truncated(path, len(table), n)
    return dict(zip(wanted, table.T))


def _read_binary(file, path, dtypes, n):
    row = np.dtype([(f"{k}", d.base, d.shape) for k, d in enumerate(dtypes)])
    there = (os.fstat(file.fileno()).st_size - file.tell()) // row.itemsize
    if there < n:
        raise _truncated(path, there, n)
    table = np.fromfile(file, dtype=row, count=n)
    return [table[f"{k}"][:, 0] for k in range(len(dtypes))]


def _read_compressed(file, path, dtypes, n):
    """One LZF block that holds the fields one after the other."""
    if n == 0:
        return [np.empty(0)] * len(dtypes)
    head = file.read(8)
    packed_size, size = struct.unpack("<II", head.ljust(8, b"\0"))
    whole = n * sum(d.itemsize for d in dtypes)
    packed = file.read(packed_size)
    if len(head) < 8 or len(packed) < packed_size or size != whole:
        raise FileError(
            str(path),
            "a compressed block that is too short for its points",
            "a complete PCD file",
            "The file is truncated or damaged.",
        )
    data = _lzf(packed, whole)
    if data is None:
        raise FileError(str(path), "a compressed block that cannot be unpacked", "LZF data", "The file is damaged.")
    columns, at = [], 0
    for dtype in dtypes:
        columns.append(np.frombuffer(data, dtype, n, at)[:, 0])
        at += n * dtype.itemsize
    return columns


def _lzf(packed, length):
    """Unpack LZF: runs of literal bytes, and copies of what came a little earlier. None where the data make no sense."""
    out = bytearray(length)
    at = to = 0
    try:
        while at < len(packed):
            code = packed[at]
            at += 1
            if code < 32:  # a run of code + 1 literal bytes
                run = code + 1
                piece = packed[at : at + run]
                at += run
            else:  # a copy of run bytes that stand `back` bytes earlier; they may overlap with what it writes
                run = code >> 5
                if run == 7:
                    run += packed[at]
                    at += 1
                run += 2
                back = ((code & 31) << 8) + packed[at] + 1
                at += 1
                if back > to:
                    return None
                piece = out[to - back : min(to, to - back + run)]
                piece = (piece * (run // len(piece) + 1))[:run]
            if len(piece) != run or to + run > length:
                return None
            out[to : to + run] = piece
            to += run
    except IndexError:
        return None
    return out if to == length else None


def _truncated(path, got, expected):
    return FileError(
        str(path),
        f"a file that ends after {got} of {expected} points",
        "a complete PCD file",
        "The file is truncated or damaged.",
    )
