"""Scans in the plain mesh formats: OBJ, STL, OFF.

By our own hand rather than trimesh's: that splits and reorders the vertices of an OBJ with texture coordinates, refuses relative
indices, takes a broken OBJ or STL for an empty scene, and an OFF that ends among its faces for a complete one. Of a scan, the
vertices have to come as the file lists them, and a broken file has to be an error.
"""

import re
import sys
import warnings
from array import array
from itertools import islice

import numpy as np

from ..errors import FileError
from .cloud import CloudData, fans, in_plain_numbers

__all__ = ["read_obj", "read_off", "read_stl"]

_UNIT = 0.02  # how far from 1 the length of a row may be that is a normal
_TRUNCATED = "The file is truncated or damaged, or its extension is wrong."
# The mark that some programs write before UTF-8, as Latin-1 has it.
_BOM = "\xef\xbb\xbf"


def read_obj(path):
    """Read vertices, polygons (as fans of triangles) and vertex normals of a Wavefront OBJ file; materials are not looked at.

    Normals are kept where every vertex has one and only one.
    """
    corners, corner_normals, lengths = array("q"), array("q"), array("q")
    counts = {"v": 0, "vn": 0}
    normal_lines = []
    with open(path, encoding="latin-1") as file:

        def vertex_lines():  # one pass over the file: loadtxt pulls the vertices, the rest is put aside on the way
            for number, line in _whole_lines(file):
                words = (line.removeprefix(_BOM) if number == 1 else line).split(None, 1)
                if not words or len(words) < 2:
                    continue
                if words[0] == "v":
                    counts["v"] += 1
                    yield line.removeprefix(_BOM)
                elif words[0] == "vn":
                    counts["vn"] += 1
                    normal_lines.append(line.removeprefix(_BOM))
                elif words[0] == "f":
                    _face(words[1], number)

        def _face(text, number):
            try:
                tokens = [token.split("/") for token in text.split("#")[0].split()]
                for token in tokens:
                    corners.append(_absolute(token[0], counts["v"]))
                    corner_normals.append(_absolute(token[2], counts["vn"]) if len(token) > 2 and token[2] else -1)
            except (ValueError, OverflowError):
                got = f"line {number}: {('f ' + text).strip()[:60]!r}"
                raise FileError(
                    str(path), got, "a face of vertex numbers, such as f 1 2 3 or f 1/1/1 2/2/2 3/3/3", _TRUNCATED
                ) from None
            lengths.append(len(tokens))

        points = _loaded(path, vertex_lines(), "v x y z")
    if not len(points):
        raise FileError(str(path), "no vertices (lines 'v x y z')", "an OBJ file", "Check the extension and the content.")
    faces = fans(np.array(lengths, dtype=int), np.array(corners, dtype=int))
    cloud = CloudData(points, faces)
    if normal_lines:
        normals = _loaded(path, iter(normal_lines), "vn x y z")
        cloud.normals = _normals_of_vertices(
            normals, len(points), np.array(corners, dtype=int), np.array(corner_normals, dtype=int)
        )
        if cloud.normals is None:
            cloud.notes.append("The normals belong to the corners of faces, not to vertices: left out.")
    return cloud


def _whole_lines(file):
    """Numbers of lines and lines; a vertex, normal or face whose line ends in a backslash with those that it goes on in."""
    begun, first = "", 0
    for number, line in enumerate(file, 1):
        first = first if begun else number
        if line.endswith("\\\n") and (begun or line.split(None, 1)[0] in ("v", "vn", "f")):
            begun += line[:-2] + " "
            continue
        yield first, begun + line
        begun = ""
    if begun:
        yield first, begun


def read_stl(path):
    """Read an STL file, binary or ASCII. Its loose triangles' equal corners become one point, in order of first appearance."""
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else -1
    text = (start := data[:4096].removeprefix(_BOM.encode("latin-1")).lstrip().lower()).startswith(b"solid") and b"facet" in start
    more = len(data) - 84 - 50 * count
    if more == 0 <= count or (count > 0 and 0 < more < 50 and not text):  # some programs write a few bytes behind the last one
        corners = np.frombuffer(data, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")]), count, 84)
        corners = corners["corners"].reshape(-1, 3)
    elif text:
        corners = _ascii_corners(path, data)
    elif count >= 0:
        got = f"{len(data)} bytes where its header announces {count} triangles"
        raise FileError(
            str(path), got, f"a binary STL of {84 + 50 * count} bytes, or an ASCII one that starts with 'solid'", _TRUNCATED
        )
    else:
        raise FileError(str(path), f"a file of {len(data)} bytes", "an STL file", _TRUNCATED)
    if not len(corners):
        return CloudData(np.empty((0, 3)))
    corners = corners + 0.0  # makes −0 and 0 the same bits
    _, first, inverse = np.unique(corners.view(f"V{corners.itemsize * 3}").ravel(), return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=int)
    rank[np.argsort(first)] = np.arange(len(first))
    note = f"STL stores loose triangles: their {len(corners)} corners share {len(first)} different points."
    return CloudData(corners[np.sort(first)], rank[inverse].reshape(-1, 3), notes=[note])


def read_off(path):
    """Read an ASCII OFF file (also COFF, NOFF and the like), its polygons as fans of triangles; colours are not looked at."""
    with open(path, "rb") as file:
        head = file.read(512)
    magic = re.match(rb"(?:\xef\xbb\xbf)?(?:\s|#[^\n]*\n)*((?:ST|C|N)*)(4)?(n)?(?:OFF|off)(?![a-zA-Z])(\s+BINARY)?", head)
    if magic is None or magic[2] or magic[3] or magic[4] or b"\0" in head:
        got = "content that does not start with 'OFF'" if magic is None else "a binary or higher-dimensional OFF file"
        raise FileError(
            str(path), got, "an ASCII OFF file of three dimensions", "Check the extension, or convert the file to PLY."
        )
    with open(path, encoding="latin-1") as file:
        file.seek(magic.end())
        lines = (line for line in (raw.split("#")[0].strip() for raw in file) if line)
        counts = next(lines, "")
        try:
            n, f = (int(word) for word in counts.split()[:2])
            if min(n, f) < 0:
                raise ValueError
        except ValueError:
            raise FileError(
                str(path), f"the line {counts[:60]!r}", "the numbers of vertices, faces and edges", _TRUNCATED
            ) from None
        columns = None if magic[1].count(b"N") and magic[1].count(b"C") else range(6 if b"N" in magic[1] else 3)
        table = _loaded(path, islice(lines, min(n, sys.maxsize)), "x y z", columns) if n else np.empty((0, 3))
        faces = list(islice(lines, min(f, sys.maxsize)))
    if len(table) < n or len(faces) < f:
        got = (
            f"a file that ends after {len(table)} of {n} vertices"
            if len(table) < n
            else f"a file that ends after {len(faces)} of {f} faces"
        )
        raise FileError(str(path), got, "a complete OFF file", _TRUNCATED)
    corners, lengths = array("q"), array("q")
    for row, line in enumerate(faces):
        try:
            words = line.split()
            size = int(words[0])
            corners.extend(map(int, words[1 : size + 1]))
            if not 0 <= size < len(words):
                raise ValueError
        except (ValueError, OverflowError):
            raise FileError(str(path), f"face {row}: {line[:60]!r}", "a count and as many vertex numbers", _TRUNCATED) from None
        lengths.append(size)
    cloud = CloudData(table[:, :3], fans(np.array(lengths, dtype=int), np.array(corners, dtype=int)))
    if b"N" in magic[1]:
        cloud.normals = table[:, 3:] if b"C" not in magic[1] else _normals_beside_colors(table)
    return cloud


def _normals_beside_colors(table):
    """The columns of unit length: normals stand before the colours by the format's definition, after them as MeshLab writes."""
    for first in (3, 6, 7):
        normals = table[:, first : first + 3]
        if normals.shape[1] == 3 and len(normals) and (abs(np.linalg.norm(normals, axis=1) - 1) < _UNIT).all():
            return normals
    return None


def _loaded(path, lines, form, columns=(1, 2, 3)):
    """(n, columns) float: those words of each line, by default the three after a keyword; None for all."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns where there is no line at all
            return np.loadtxt(map(in_plain_numbers, lines), usecols=columns, ndmin=2)
    except FileError:
        raise
    except (ValueError, IndexError) as error:
        raise FileError(str(path), f"a line that cannot be read ({error})", f"lines such as '{form}'", _TRUNCATED) from None


def _absolute(token, count):
    """Zero-based index: OBJ counts from 1, or backwards from the latest with negative numbers. 0 becomes −1, which is refused."""
    number = int(token)
    return number - 1 if number >= 0 else max(count + number, -1)


def _normals_of_vertices(normals, n, corners, corner_normals):
    if not len(corners):
        return normals if len(normals) == n else None
    if corner_normals.min() < 0 or corner_normals.max() >= len(normals) or corners.min() < 0 or corners.max() >= n:
        return None
    of_vertex = np.full(n, -1)
    of_vertex[corners] = corner_normals
    if of_vertex.min() < 0 or (normals[of_vertex[corners]] != normals[corner_normals]).any():
        return None
    return normals[of_vertex]


def _ascii_corners(path, data):
    words = data.lower().split()
    corners, inside = [], False  # of a loop: names of solids may hold any word
    for k, word in enumerate(words):
        if word in (b"loop", b"endloop"):
            inside = word == b"loop" and words[k - 1] == b"outer"
        elif inside and word == b"vertex":
            corners.append(k)
    facets = words.count(b"endfacet")
    if b"endsolid" not in words or len(corners) != 3 * facets:
        got = f"{len(corners)} corners in {facets} complete facets" + ("" if b"endsolid" in words else ", without 'endsolid'")
        raise FileError(str(path), got, "three corners per facet, and 'endsolid' at the end", _TRUNCATED)
    try:
        return np.array([words[k + 1 : k + 4] for k in corners], dtype=float).reshape(-1, 3)
    except ValueError as error:
        raise FileError(
            str(path), f"a corner that cannot be read ({error})", "lines such as 'vertex x y z'", _TRUNCATED
        ) from None
