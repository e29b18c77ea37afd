"""glTF 2.0 containers and accessors: from bytes on disk to typed arrays, each index and bound checked on the way.

``open_gltf`` reads ``.glb`` and ``.gltf``; the :class:`Document` it returns hands out the JSON through getters that refuse
what the specification refuses, and decodes accessors on demand (a missing texture buffer is nobody's loss). Sections
named below are those of the glTF 2.0 specification.
"""

import base64
import binascii
import json
import math
import os
import re
import struct
from pathlib import Path
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from ..errors import FileError, InputError, listed

__all__ = ["Document", "open_gltf"]

# componentType (3.6.2.2); all data is little endian.
_COMPONENTS = {
    code: np.dtype(t) for code, t in zip((5120, 5121, 5122, 5123, 5125, 5126), ("i1", "u1", "<i2", "<u2", "<u4", "<f4"))
}
# The columns and rows of one element, by its type.
_SHAPES = {"SCALAR": (1, 1), "VEC2": (1, 2), "VEC3": (1, 3), "VEC4": (1, 4), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4)}
# These hide the geometry in a compressed stream that only a decoder can open.
_COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
# These leave the geometry alone, or store it in integers, which accessors are read in anyway.
_HARMLESS = re.compile(r"KHR_mesh_quantization|KHR_xmp.*|[A-Z]+_(materials|texture|lights)_.*")
# An accessor without data is all zeros, so nothing but its count says how much memory it wants.
_MOST_ZEROS = 50_000_000

_UNCOMPRESSED = "Export the file again without mesh compression."
_DAMAGED = "The file is damaged or was written wrongly: export or download it again."


def open_gltf(path):
    """Read a glTF 2.0 file's JSON and, for a ``.glb``, its binary chunk.

    Parameters
    ----------
    path : str or path-like
        A ``.glb`` or ``.gltf`` file; which of the two it is, its first bytes decide.

    Returns
    -------
    Document

    Raises
    ------
    FileError
        Missing or unreadable file, truncated or foreign container, broken JSON, another glTF version, or a required
        extension that compresses the geometry.
    """
    try:
        file = Path(path)
    except TypeError:
        raise InputError("path", type(path).__name__, "the path of a .glb or .gltf file") from None
    data = _read_bytes(file, str(path))
    if data[:4] == b"glTF":
        text, chunk = _split_glb(data, str(path))
    elif file.suffix.lower() == ".glb":
        raise FileError(str(path), f"a file that starts with {bytes(data[:4])!r}", "a binary glTF, which starts with b'glTF'")
    else:
        text, chunk = data, None
    return Document(path, _parse_json(text, str(path)), chunk)


class Document:
    """A glTF asset: its JSON behind checking getters, its binary data decoded on demand.

    Attributes
    ----------
    path : str
        As the user gave it: what errors name.
    root : dict
        The JSON.
    notes : list of str
        Anomalies met while decoding, in words.
    """

    def __init__(self, path, root, chunk):
        self.path, self.root, self.notes = str(path), root, []
        self._folder, self._chunk, self._buffers, self._items = Path(path).parent, chunk, {}, {}
        self._check_asset()

    def error(self, got, expected, remedy=_DAMAGED):
        """The FileError that says so about this file."""
        return FileError(self.path, got, expected, remedy)

    # ---- JSON ----

    def items(self, key):
        """A top-level array of objects, such as "nodes"; empty where the file has none."""
        if key not in self._items:
            self._items[key] = self.objects(self.root, key, "the file")
        return self._items[key]

    def item(self, key, index, where):
        """Element ``index`` of a top-level array; ``where`` says who refers to it."""
        items = self.items(key)
        if not (isinstance(index, int) and 0 <= index < len(items)):
            raise self.error(f"{where} refers to {key}[{index}], of {len(items)}", f"an index below {len(items)}")
        return items[index]

    def objects(self, owner, key, where):
        """An array of objects inside ``owner``; empty where absent."""
        value = owner.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            raise self.error(f"{key} of {where} is not a list of objects", "a list of JSON objects")
        return value

    def object(self, owner, key, where):
        """An object inside ``owner``; empty where absent."""
        value = owner.get(key, {})
        if not isinstance(value, dict):
            raise self.error(f"{key} of {where} is {_short(value)}", "a JSON object")
        return value

    def integer(self, owner, key, where, default=None):
        """A non-negative integer inside ``owner`` (100.0 and 1e2 count too); absent: ``default`` or an error."""
        if key not in owner and default is not None:
            return default
        return self._natural(owner.get(key), f"{key} of {where}")

    def integers(self, owner, key, where):
        """A list of non-negative integers inside ``owner``; empty where absent."""
        value = owner.get(key, [])
        if not isinstance(value, list):
            raise self.error(f"{key} of {where} is {_short(value)}", "a list of indices")
        return [self._natural(v, f"{key} of {where}") for v in value]

    def numbers(self, owner, key, count, default, where):
        """``count`` finite numbers inside ``owner``, as a float array; ``default`` where absent."""
        value = owner.get(key, default)
        good = isinstance(value, (list, tuple)) and len(value) == count and all(_is_finite(v) for v in value)
        if not good:
            raise self.error(f"{key} of {where} is {_short(value)}", f"{count} finite numbers")
        return np.array(value, dtype=float)

    def name(self, owner, default):
        """An object's name, with U+FFFD for halves of characters and NUL, which JSON allows; ``default`` where it has none."""
        name = owner.get("name")
        return re.sub(r"[\ud800-\udfff\0]", "\ufffd", name) if isinstance(name, str) and name else default

    def _natural(self, value, what):
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or value < 0:
            raise self.error(f"{what} is {'missing' if value is None else _short(value)}", "a whole number, 0 or more")
        return value

    # ---- binary data ----

    def accessor(self, index, where, kinds, *, finite=True):
        """The data of one accessor (3.6.2).

        Parameters
        ----------
        index : int
        where : str
            Who refers to it, for errors.
        kinds : tuple of str
            The element types that may come, such as ("VEC3",).
        finite : bool, default True
            Whether NaN and infinite values are an error.

        Returns
        -------
        array
            (count,) for SCALAR, (count, n) for vectors, (count, rows, columns) for matrices. Float64 where the components
            are floats or normalized integers (decoded by the formulas of 3.11), else int64.
        """
        item = self.item("accessors", index, where)
        where = f"accessor {index} ({where})"
        dtype = self._component(item, where)
        kind = item.get("type")
        if not isinstance(kind, str) or kind not in kinds:
            raise self.error(f"{where} has type {_short(kind)}", f"type {' or '.join(kinds)}")
        columns, rows = _SHAPES[kind]
        count = self.integer(item, "count", where)
        if "bufferView" in item:
            offset = self.integer(item, "byteOffset", where, 0)
            data = self._elements(self.integer(item, "bufferView", where), offset, dtype, (count, columns, rows), where)
        elif count > _MOST_ZEROS:
            raise self.error(f"{where} claims {count} elements without data", f"at most {_MOST_ZEROS}")
        else:
            data = np.zeros((count, columns, rows), dtype)
        if "sparse" in item:
            data = self._with_sparse(data, self.object(item, "sparse", where), dtype, where)
        data = self._decode(data, dtype, item.get("normalized") is True)
        if finite and not np.isfinite(data).all():
            bad = int(np.flatnonzero(~np.isfinite(data).all(axis=(1, 2)))[0])
            raise self.error(f"{where} holds NaN or infinite values, first in element {bad}", "finite numbers")
        if kind == "SCALAR":
            return data.reshape(count)
        return data.reshape(count, rows) if columns == 1 else np.swapaxes(data, 1, 2)  # stored column by column

    def data_of(self, owner, key, where, kinds, *, finite=True):
        """The data of the accessor that ``owner`` has under ``key``, such as a primitive's "POSITION"; see :meth:`accessor`."""
        return self.accessor(self.integer(owner, key, where), f"{key} of {where}", kinds, finite=finite)

    def is_integer(self, index, where):
        """Whether an accessor holds integers that are not normalized, and the largest value that they can take."""
        item = self.item("accessors", index, where)
        dtype = self._component(item, where)
        plain = dtype.kind != "f" and item.get("normalized") is not True
        return plain, (np.iinfo(dtype).max if dtype.kind != "f" else None)

    def has_data(self, index, where):
        """Whether an accessor has data of its own, rather than being all zeros."""
        item = self.item("accessors", index, where)
        return "bufferView" in item or "sparse" in item

    def _component(self, owner, where, allowed=tuple(_COMPONENTS)):
        code = owner.get("componentType")
        if not isinstance(code, (int, float)) or code not in allowed:
            raise self.error(f"componentType {_short(code)} of {where}", f"one of {', '.join(map(str, allowed))}")
        return _COMPONENTS[int(code)]

    def _elements(self, view, offset, dtype, shape, where):
        """(count, columns, rows) elements of a buffer view, by stride and with the columns' padding to 4 bytes (3.6.2.4)."""
        item = self.item("bufferViews", view, where)
        count, columns, rows = shape
        column = rows * dtype.itemsize
        if columns > 1:
            column = -(-column // 4) * 4
        element = (columns - 1) * column + rows * dtype.itemsize  # the last column's padding may be missing
        stride = self.integer(item, "byteStride", f"bufferView {view}", 0) or columns * column
        if stride < element:
            raise self.error(
                f"bufferView {view} has byteStride {stride}", f"at least the {element} bytes of an element of {where}"
            )
        data = self._view(view)
        need = offset + stride * (count - 1) + element if count else offset
        if need > len(data):
            raise self.error(
                f"{where} needs {need} bytes of bufferView {view}, which has {len(data)}", "accessors that fit their buffer views"
            )
        if not count:
            return np.zeros(shape, dtype)
        return np.ndarray(shape, dtype, data, offset, (stride, column, dtype.itemsize))

    def _with_sparse(self, data, sparse, dtype, where):
        count = self.integer(sparse, "count", f"sparse of {where}")
        parts = []
        for key, part_type, shape in (("indices", None, (count, 1, 1)), ("values", dtype, (count, *data.shape[1:]))):
            part, place = self.object(sparse, key, f"sparse of {where}"), f"sparse {key} of {where}"
            part_type = part_type or self._component(part, place, (5121, 5123, 5125))
            start = self.integer(part, "byteOffset", place, 0)
            parts.append(self._elements(self.integer(part, "bufferView", place), start, part_type, shape, place))
        rows = parts[0].reshape(-1).astype(np.int64)
        if len(rows) and rows.max() >= len(data):
            raise self.error(f"sparse index {rows.max()} of {where}", f"indices below its count, {len(data)}")
        data = data.copy()
        data[rows] = parts[1]
        return data

    def _decode(self, data, dtype, normalized):
        if dtype.kind == "f":
            return data.astype(float)
        if not normalized:
            return data.astype(np.int64)
        return np.maximum(data / float(np.iinfo(dtype).max), -1.0)

    def _view(self, index):
        where = f"bufferView {index}"
        item = self.items("bufferViews")[index]
        buffer = self._buffer(self.integer(item, "buffer", where), where)
        start, length = self.integer(item, "byteOffset", where, 0), self.integer(item, "byteLength", where)
        if start + length > len(buffer):
            raise self.error(
                f"{where} ends at byte {start + length} of a buffer of {len(buffer)}", "buffer views that fit their buffers"
            )
        return buffer[start : start + length]

    def _buffer(self, index, where):
        if index not in self._buffers:
            item = self.item("buffers", index, where)
            data = self._buffer_bytes(index, item.get("uri"))
            length = self.integer(item, "byteLength", f"buffer {index}")
            if len(data) < length:
                raise self.error(f"buffer {index} has {len(data)} bytes of {length}: it is truncated", "the whole buffer")
            self._buffers[index] = memoryview(data)[:length]
        return self._buffers[index]

    def _buffer_bytes(self, index, uri):
        if uri is None:
            if index == 0 and self._chunk is not None:
                return self._chunk
            raise self.error(
                f"buffer {index} without a uri or a binary chunk",
                "a buffer with data",
                "Export the file again with its geometry.",
            )
        if not isinstance(uri, str):
            raise self.error(f"buffer {index} has the uri {_short(uri)}", "text")
        if uri[:5].lower() == "data:":
            return self._data_uri(index, uri)
        path = unquote(uri)
        if ":" in uri.split("/")[0] or path.startswith(("/", "\\")):
            raise self.error(
                f"buffer {index} has the uri {_short(uri)}", "a path relative to the file", "Put the buffer beside the file."
            )
        file = self._folder / path
        if "\0" not in path and not file.exists() and (self._folder / uri).exists():
            file = self._folder / uri  # written without percent-encoding, against the specification
        return _read_bytes(file, self.path, f"buffer {index}, {uri!r},")

    def _data_uri(self, index, uri):
        head, comma, body = uri[5:].partition(",")
        if not comma:
            raise self.error(f"buffer {index} has a data URI without a comma", "data:[type][;base64],DATA")
        raw = unquote_to_bytes(body)
        if not head.lower().endswith(";base64"):
            return raw
        try:
            return base64.b64decode(raw, validate=True)
        except (binascii.Error, ValueError):
            raise self.error(f"buffer {index} has a data URI that is not base64", "base64 text") from None

    def _check_asset(self):
        asset = self.object(self.root, "asset", "the file")
        for key in ("minVersion", "version"):
            version = asset.get(key)
            missing = version is None and key == "minVersion"  # which is optional
            understood = str(version) == "2.0" if key == "minVersion" else str(version).split(".")[0] == "2"
            if not missing and not understood:
                raise self.error(f"glTF {key} {_short(version)}", "glTF 2.0", "Convert the file to glTF 2.0.")
        required = self.root.get("extensionsRequired", [])
        if not isinstance(required, list):
            raise self.error(f"extensionsRequired is {_short(required)}", "a list of names")
        for name in required:
            if name in _COMPRESSIONS:
                raise self.error(f"geometry compressed with {name}", "plain buffers", _UNCOMPRESSED)
        unknown = [_short(name) for name in required if not (isinstance(name, str) and _HARMLESS.fullmatch(name))]
        if unknown:
            what = f"{len(unknown)} extension(s) that are not known here ({listed(unknown, 5)})"
            self.notes.append(f"the file requires {what}: what it shows may differ from what was read")

    def refuse_compressed(self, primitive, where):
        """A FileError for a primitive whose data exist in compressed form only, though no extension is marked required."""
        position = self.integer(self.object(primitive, "attributes", where), "POSITION", where)
        for name in _COMPRESSIONS:
            if name in self.object(primitive, "extensions", where) and not self.has_data(position, where):
                raise self.error(f"{where} compressed with {name}", "plain buffers", _UNCOMPRESSED)


def _split_glb(data, path):
    """JSON and BIN chunks of a binary glTF (4.4); chunks of other types are for extensions and ignored."""
    if len(data) < 12:
        raise FileError(path, f"a file of {len(data)} bytes: it is truncated", "a binary glTF with its 12-byte header", _DAMAGED)
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise FileError(path, f"binary glTF of version {version}", "version 2", "Convert the file to glTF 2.0.")
    if len(data) < length:
        raise FileError(path, f"{len(data)} bytes of {length}: the file is truncated", "the whole file", _DAMAGED)
    text, chunk, at, view = None, None, 12, memoryview(data)  # of what may be large: not to be copied
    while at + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + size > length:
            raise FileError(
                path, f"a chunk of {size} bytes that ends after the file: it is truncated", "the whole file", _DAMAGED
            )
        body = view[at + 8 : at + 8 + size]
        if text is None:
            if kind != b"JSON":
                raise FileError(path, f"a first chunk of type {kind!r}", "a JSON chunk first", _DAMAGED)
            text = bytes(body)
        elif kind == b"BIN\0" and chunk is None:
            chunk = body
        at += 8 + size
    if text is None:
        raise FileError(path, "no JSON chunk: the file is truncated", "a binary glTF with a JSON chunk", _DAMAGED)
    return text, chunk


def _parse_json(text, path):
    try:
        root = json.loads(text.decode("utf-8-sig").rstrip("\0"))
    except UnicodeDecodeError:
        raise FileError(path, "bytes that are not UTF-8 text", "glTF JSON", _DAMAGED) from None
    except json.JSONDecodeError as e:
        raise FileError(path, f"broken JSON ({e.msg} at line {e.lineno}, column {e.colno})", "glTF JSON", _DAMAGED) from None
    except (RecursionError, ValueError):
        raise FileError(path, "JSON that cannot be read (nested too deep, or numbers too long)", "glTF JSON", _DAMAGED) from None
    if not isinstance(root, dict):
        raise FileError(path, f"JSON that is {_short(root)}", "a glTF object", _DAMAGED)
    return root


def _read_bytes(file, path, what=None):
    try:
        return file.read_bytes()
    except FileNotFoundError:
        if what is None:
            raise FileError(path, "no such file", "the path of a .glb or .gltf file", "Check the path.") from None
        raise FileError(
            path,
            f"{what} which does not exist",
            f"that file in {os.fspath(file.parent)!r}",
            "Keep a .gltf together with its buffers.",
        ) from None
    except (OSError, ValueError) as e:
        reason = getattr(e, "strerror", None) or str(e)
        raise FileError(path, f"{what or 'a file that'} cannot be read ({reason})", "a readable file") from None


def _is_finite(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300 and math.isfinite(value)


def _short(value):
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
