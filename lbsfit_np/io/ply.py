"""PLY scans: ASCII, binary little and big endian; points, polygons, normals and labels.

Our own reader, because the labels have to come back, vertices must keep their order, and a broken file wants a clear error.
"""

import io
import os
import warnings
from array import array

import numpy as np

from ..errors import FileError
from .cloud import cloud_from_columns, columns_by_role, fans, in_plain_numbers, strips

__all__ = ["read_ply"]

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
    "int64": "i8", "uint64": "u8", "float16": "f2",  # which the format has not, but trimesh and meshio write
}  # fmt: skip
_FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
_SURFACES = {"face": fans, "tristrips": strips}  # the elements that list corners
_HEADER_LINES, _LINE = 10_000, 10_000  # a header that goes on for longer is none, and so is one with longer lines


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
        cloud, faces, notes, missing = None, [], [], {"vertex", *_SURFACES} & set(elements)
        for name, (count, properties) in elements.items():
            wanted = _vertex_columns(properties) if name == "vertex" else _face_columns(properties) if name in _SURFACES else []
            if order is None:
                columns = _read_ascii(file, path, name, count, properties, wanted)
            else:
                columns = _read_binary(file, order, path, name, count, properties, wanted)
            if name == "vertex":
                cloud = cloud_from_columns(path, "vertex properties", _scalar_names(properties), columns.__getitem__)
            elif wanted:
                faces.append(_SURFACES[name](*columns[wanted[0]]))
            elif name in _SURFACES and count:
                named = ", ".join(p[0] for p in properties) or "nothing"
                notes.append(f"The element {name!r} has {named}, not a list called vertex_indices: left out.")
            missing.discard(name)
            if not missing:
                break  # edges, materials and the like, if they stand last: nothing here looks at them
    if faces:
        cloud.faces = np.concatenate(faces)
    cloud.notes += notes
    return cloud


def _read_header(file, path):
    """The byte order (None for ASCII) and element name → (count, properties), a property being (name, type, count type)."""
    first = file.readline(8)
    returns = first.startswith(b"ply\r") and b"\n" not in first
    if returns:
        file.seek(len(b"ply\r"))
    elif first.rstrip() != b"ply":
        raise FileError(str(path), "content that does not start with 'ply'", "a PLY file", "Check the extension.")
    order, elements, properties = "", {}, None
    for _ in range(_HEADER_LINES):
        line = _until_return(file) if returns else file.readline(_LINE)
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
                if _TYPES[words[2]][0] == "f":
                    raise ValueError
                properties.append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                properties.append((words[2], _TYPES[words[1]], None))
            else:
                raise ValueError
        except (LookupError, ValueError, AttributeError):
            got = f"the header line {line[:80].decode('latin-1').strip()!r}"
            expected = "a PLY header line (format, element, property, comment, end_header)"
            if words[0] == "property":
                expected = f"property TYPE NAME, or property list TYPE TYPE NAME, with types of {' '.join(_TYPES)}"
            raise FileError(str(path), got, expected) from None
    raise FileError(str(path), "a PLY header without 'end_header'", "a complete PLY file", "The file is truncated or damaged.")


def _until_return(file):
    """The next line of a header whose lines end in a carriage return alone, as the format was first described."""
    line = b""
    while len(line) < _LINE and not line.endswith(b"\r") and (byte := file.read(1)):
        line += byte
    return line


def _count(word):
    if int(word) < 0:
        raise ValueError
    return int(word)


def _scalar_names(properties):
    """The properties' names, "" for lists."""
    return [name if length is None else "" for name, _, length in properties]


def _vertex_columns(properties):
    """Which properties of a vertex are looked at."""
    return sorted(columns_by_role(_scalar_names(properties)).values())


def _face_columns(properties):
    """The property that lists the corners of a face or strip, if there is one."""
    return [k for k, (name, _, length) in enumerate(properties) if length and name in ("vertex_indices", "vertex_index")][:1]


def _read_ascii(file, path, element, count, properties, wanted):
    """An element's wanted properties: number of the property → values, or for a list → (lengths, flat values).

    Scalars come as floats, whatever their type, so that no value is cut or wraps around.
    """
    if count == 0:
        return _empty(properties, wanted)
    if all(length is None for _, _, length in properties):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # numpy warns of blank lines and of no lines at all
                rows = min(count, os.fstat(file.fileno()).st_size)  # no file has more rows than bytes
                table = np.loadtxt(map(in_plain_numbers, file), comments=None, max_rows=rows, usecols=wanted or (0,), ndmin=2)
        except (ValueError, IndexError) as error:
            raise FileError(str(path), f"{element} rows that cannot be read ({error})", _numbers(properties)) from None
        if len(table) < count:
            raise _truncated(path, element, len(table), count)
        return dict(zip(wanted, table.T))
    lists = {k: (array("q"), array("q")) for k in wanted if properties[k][2]}
    scalars = {k: array("d") for k in wanted if k not in lists}
    for row in range(count):
        while not (words := in_plain_numbers(line := file.readline()).split()):  # blank lines are nothing, as among scalars
            if not line:
                raise _truncated(path, element, row, count)
        at = 0
        try:
            for k, (_, _, length) in enumerate(properties):
                if length is None:
                    if k in scalars:
                        scalars[k].append(float(words[at]))
                    at += 1
                    continue
                n = int(words[at])
                if n < 0 or at + 1 + n > len(words):
                    raise IndexError
                if k in lists:
                    lists[k][0].append(n)
                    lists[k][1].extend(map(int, words[at + 1 : at + 1 + n]))
                at += 1 + n
            if at > len(words):
                raise IndexError
        except (ValueError, IndexError, OverflowError):
            got = f"the {element} row {row}: {' '.join(words)[:60]!r}"
            raise FileError(str(path), got, _numbers(properties), "The file is truncated or damaged.") from None
    return {k: np.array(v) for k, v in scalars.items()} | {k: (np.array(n), np.array(v)) for k, (n, v) in lists.items()}


def _read_binary(file, order, path, element, count, properties, wanted):
    """As :func:`_read_ascii`, from binary rows; values have the file's types."""
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
        return {k: table[f"{k}"] for k in wanted}
    start = file.tell()
    data = file.read()
    columns, used = _equal_lists(data, order, count, properties, wanted) or _walked_lists(
        data, order, path, element, count, properties, wanted
    )
    file.seek(start + used)
    return columns


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
    if any((table[f"n{k}"] != table[f"n{k}"][0]).any() for k, p in enumerate(properties) if p[2]):
        return None
    columns = {k: (table[f"n{k}"].astype(int), table[f"{k}"].reshape(-1)) if properties[k][2] else table[f"{k}"] for k in wanted}
    return columns, dtype.itemsize * count


def _walked_lists(data, order, path, element, count, properties, wanted):
    """Rows with lists of different lengths, one after the other."""
    kinds = [(np.dtype(order + kind), length and np.dtype(order + length)) for _, kind, length in properties]
    found = {k: ([], []) for k in wanted}  # lengths, values
    at = 0
    for row in range(count):
        for k, (kind, length) in enumerate(kinds):
            n = 1
            if length is not None:
                if at + length.itemsize > len(data):
                    raise _truncated(path, element, row, count)
                n = int(np.frombuffer(data, length, 1, at)[0])
                at += length.itemsize
            if n < 0 or at + n * kind.itemsize > len(data):
                raise _truncated(path, element, row, count)
            if k in found:
                found[k][0].append(n)
                found[k][1].append(np.frombuffer(data, kind, n, at))
            at += n * kind.itemsize
    columns = {k: (np.array(n, dtype=int), np.concatenate(v)) for k, (n, v) in found.items()}
    return {k: c if properties[k][2] else c[1] for k, c in columns.items()}, at


def _empty(properties, wanted):
    none = np.empty(0, dtype=int)
    return {k: (none, none) if properties[k][2] else np.empty(0) for k in wanted}


def _numbers(properties):
    return f"one row per element with {', '.join(p[0] for p in properties)}"


def _truncated(path, element, got, expected):
    return FileError(
        str(path),
        f"a file that ends after {got} of {expected} {element} rows",
        "a complete PLY file",
        "The file is truncated or damaged.",
    )
