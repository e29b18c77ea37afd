"""PLY scans: ASCII, binary little and big endian; points, polygons, normals and labels.

Our own reader, because the labels have to come back, vertices must keep their order, and a broken file wants a clear error.
"""

import io
import os
import warnings

import numpy as np

from ..errors import FileError
from .cloud import cloud_from_columns, column_role, fans

__all__ = ["read_ply"]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_LINES = 10_000  # a header that goes on for longer is none


def read_ply(path):
    """Read the vertices of a PLY file, and its faces where it has some.

    Parameters
    ----------
    path : Path

    Returns
    -------
    CloudData

    Raises
    ------
    FileError
        Not a PLY file, an unusual header, or a file that ends too early.
    """
    with open(path, "rb") as file:
        order, elements = _read_header(file, path)
        if "vertex" not in elements:
            raise FileError(str(path), "a PLY file without an element 'vertex'", "a PLY file with vertices")
        if order is None:
            file = io.TextIOWrapper(file, "latin-1")
        cloud, faces = None, None
        for name, (count, properties) in elements.items():
            if cloud is not None and (name != "face" or faces is not None):
                continue  # edges, materials and the like stand last: nothing here looks at them
            wanted = {"vertex": _vertex_properties(properties), "face": _face_properties(properties)}.get(name, [])
            read = _read_ascii if order is None else _read_binary
            table = read(file, order, path, name, count, properties, wanted)
            if name == "vertex":
                cloud = cloud_from_columns(list(table), list(table.values()).__getitem__)
                if cloud is None:
                    got = ", ".join(p[0] for p in properties) or "none"
                    raise FileError(str(path), f"vertices with the properties {got}", "vertices with the properties x, y and z")
            elif name == "face" and wanted:
                faces = fans(*table[wanted[0]])
            if "face" not in elements and cloud is not None:
                break
    if faces is not None:
        cloud.faces = faces
    return cloud


def _read_header(file, path):
    """The byte order (None for ASCII) and element name → (count, properties), a property being (name, type, count type)."""
    if file.readline(8).rstrip() != b"ply":
        raise FileError(str(path), "content that does not start with 'ply'", "a PLY file", "Check the extension.")
    order, elements, properties = "", {}, None
    for _ in range(_HEADER_LINES):
        line = file.readline(10_000)
        words = line.decode("latin-1").split()
        if not line:
            break
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "end_header":
            if order == "":
                raise FileError(str(path), "a PLY header without a format line", "'format ascii 1.0' or a binary format")
            return order, elements
        try:
            if words[0] == "format":
                order = _FORMATS[words[1]]
            elif words[0] == "element":
                properties = []
                elements[words[1]] = (_count(words[2]), properties)
            elif words[:2] == ["property", "list"]:
                properties.append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                properties.append((words[2], _TYPES[words[1]], None))
            else:
                raise ValueError
        except (LookupError, ValueError, AttributeError):
            got = f"the header line {line[:80].decode('latin-1').strip()!r}"
            raise FileError(str(path), got, "a PLY header line (format, element, property, comment, end_header)") from None
    raise FileError(str(path), "a PLY header without 'end_header'", "a complete PLY file", "The file is truncated or damaged.")


def _count(word):
    if int(word) < 0:
        raise ValueError
    return int(word)


def _vertex_properties(properties):
    return [name for name, _, length in properties if length is None and column_role(name) is not None]


def _face_properties(properties):
    return [name for name, _, length in properties if length is not None and name in ("vertex_indices", "vertex_index")][:1]


def _read_ascii(file, order, path, element, count, properties, wanted):
    """One element's wanted columns: name → values, or for a list name → (lengths, flat values)."""
    if count == 0:
        return _empty(properties, wanted)
    if all(length is None for _, _, length in properties):
        rows = [k for k, p in enumerate(properties) if p[0] in wanted]
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # numpy warns of blank lines and of no lines at all
                table = np.loadtxt(file, comments=None, max_rows=count, usecols=rows or (0,), ndmin=2)
        except (ValueError, IndexError) as error:
            raise FileError(str(path), f"{element} rows that cannot be read ({error})", _numbers(properties)) from None
        if len(table) < count:
            raise _truncated(path, element, len(table), count)
        return {properties[row][0]: _typed(table[:, k], properties[row][1]) for k, row in enumerate(rows)}
    lists = {name: ([], []) for name in wanted}
    scalars = {}
    for k in range(count):
        words = file.readline().split()
        if not words:
            raise _truncated(path, element, k, count)
        at = 0
        try:
            for name, _, length in properties:
                if length is None:
                    at += 1
                    continue
                n = int(words[at])
                if n < 0 or at + 1 + n > len(words):
                    raise IndexError
                if name in lists:
                    lists[name][0].append(n)
                    lists[name][1].extend(map(int, words[at + 1 : at + 1 + n]))
                at += 1 + n
        except (ValueError, IndexError):
            got = f"the {element} row {k}: {' '.join(words)[:60]!r}"
            raise FileError(str(path), got, _numbers(properties), "The file is truncated or damaged.") from None
    return scalars | {name: (np.array(n, dtype=int), np.array(v, dtype=int)) for name, (n, v) in lists.items()}


def _read_binary(file, order, path, element, count, properties, wanted):
    if count == 0:
        return _empty(properties, wanted)
    if all(length is None for _, _, length in properties):
        if not properties:
            return {}
        dtype = np.dtype([(f"{k}", order + kind) for k, (_, kind, _) in enumerate(properties)])
        there = (os.fstat(file.fileno()).st_size - file.tell()) // dtype.itemsize
        if there < count:
            raise _truncated(path, element, there, count)
        table = np.fromfile(file, dtype=dtype, count=count)
        return {name: table[f"{k}"] for k, (name, _, _) in enumerate(properties) if name in wanted}
    start = file.tell()
    data = file.read()
    table, used = _equal_lists(data, order, count, properties, wanted) or _walked_lists(
        data, order, path, element, count, properties, wanted
    )
    file.seek(start + used)
    return table


def _equal_lists(data, order, count, properties, wanted):
    """Rows whose lists are all as long as the first row's (a mesh of triangles) at once, or None."""
    fields, at = [], 0
    for k, (_, kind, length) in enumerate(properties):
        if length is None:
            fields.append((f"{k}", order + kind))
            at += np.dtype(kind).itemsize
            continue
        if at + np.dtype(length).itemsize > len(data):
            return None
        n = int(np.frombuffer(data, order + length, 1, at)[0])
        at += np.dtype(length).itemsize + n * np.dtype(kind).itemsize
        if n < 0 or at > len(data):
            return None
        fields += [(f"n{k}", order + length), (f"{k}", order + kind, (n,))]
    dtype = np.dtype(fields)
    if dtype.itemsize * count > len(data):
        return None
    table = np.frombuffer(data, dtype, count)
    lists = [k for k, p in enumerate(properties) if p[2] is not None]
    if any((table[f"n{k}"] != table[f"n{k}"][0]).any() for k in lists):
        return None
    out = {}
    for k in lists:
        if properties[k][0] in wanted:
            out[properties[k][0]] = table[f"n{k}"].astype(int), table[f"{k}"].reshape(-1).astype(int)
    return out, dtype.itemsize * count


def _walked_lists(data, order, path, element, count, properties, wanted):
    """Rows with lists of different lengths, one after the other."""
    sizes = [(name, np.dtype(order + kind), length and np.dtype(order + length)) for name, kind, length in properties]
    lists = {name: ([], []) for name in wanted}
    at = 0
    for row in range(count):
        for name, kind, length in sizes:
            if length is None:
                at += kind.itemsize
                continue
            if at + length.itemsize > len(data):
                raise _truncated(path, element, row, count)
            n = int(np.frombuffer(data, length, 1, at)[0])
            at += length.itemsize
            if n < 0 or at + n * kind.itemsize > len(data):
                raise _truncated(path, element, row, count)
            if name in lists:
                lists[name][0].append(n)
                lists[name][1].append(np.frombuffer(data, kind, n, at))
            at += n * kind.itemsize
    if at > len(data):
        raise _truncated(path, element, count - 1, count)
    return {name: (np.array(n, dtype=int), np.concatenate(v).astype(int)) for name, (n, v) in lists.items()}, at


def _typed(values, kind):
    return values.astype(int) if kind[0] in "iu" else values


def _empty(properties, wanted):
    kinds = {name: (kind, length) for name, kind, length in properties}
    none = np.empty(0, dtype=int)
    return {name: (none, none) if kinds[name][1] else np.empty(0, dtype=kinds[name][0]) for name in wanted}


def _numbers(properties):
    return f"one row per element with {', '.join(p[0] for p in properties)}"


def _truncated(path, element, got, expected):
    return FileError(
        str(path),
        f"a file that ends after {got} of {expected} {element} rows",
        "a complete PLY file",
        "The file is truncated or damaged.",
    )
