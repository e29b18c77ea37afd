"""Binary glTF 2.0 files: JSON objects and arrays collected, then written whole. Sections named are those of the specification."""

import json
import struct

import numpy as np

from ..errors import InputError
from .write import atomic_path

__all__ = ["GlbWriter"]

_COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("<u2"): 5123}  # 3.6.2.2
_KINDS = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_TARGETS = {"vertices": 34962, "indices": 34963}  # 5.11.5
_MOST_BYTES = 2**32 - 1  # lengths in the header are of 32 bits (4.4)


class GlbWriter:
    """One asset. ``add`` and ``accessor`` return the index of what they have added.

    Parameters
    ----------
    generator : str
        What writes the file.
    """

    def __init__(self, generator):
        self.root = {"asset": {"version": "2.0", "generator": generator}}
        self._blocks, self._length = [], 0

    def add(self, key, **fields):
        """Append an object to a top-level array, such as "nodes"."""
        self.root.setdefault(key, []).append(fields)
        return len(self.root[key]) - 1

    def accessor(self, array, *, use=None, bounds=False):
        """Store an array.

        Parameters
        ----------
        array : (n,), (n, 3), (n, 4) or (n, 4, 4) array
            float32, uint32 or uint16, others become float32; matrices as they act on column vectors.
        use : {"vertices", "indices"}, optional
            What a mesh does with it.
        bounds : bool, default False
            Whether to add the least and the most, which positions and key times must have (3.7.2.1, 5.1).
        """
        array = np.asarray(array)
        array = np.ascontiguousarray(array if array.dtype in _COMPONENTS else array.astype("<f4"))
        fields = {"componentType": _COMPONENTS[array.dtype], "count": len(array), "type": _KINDS[array.shape[1:]]}
        if bounds:
            fields |= {name: np.atleast_1d(of(array, axis=0)).tolist() for name, of in (("min", np.min), ("max", np.max))}
        data = (np.swapaxes(array, 1, 2) if array.ndim == 3 else array).tobytes()  # matrices by columns (3.6.2.4)
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)} | ({"target": _TARGETS[use]} if use else {})
        padded = data + b"\0" * (-len(data) % 4)
        self._blocks.append(padded)
        self._length += len(padded)
        return self.add("accessors", bufferView=self.add("bufferViews", **view), **fields)

    def save(self, path):
        """Write the file, atomically.

        Raises
        ------
        InputError
            More than fits into a file of this format.
        FileError
            A path that cannot be written to.
        """
        root = self.root | {"buffers": [{"byteLength": self._length}]}
        text = json.dumps(root, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + self._length
        if total > _MOST_BYTES:
            raise InputError("path", f"{total / 1e9:.1f} GB for {path}", "at most 4.2 GB in a .glb", "Write fewer frames.")
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", self._length, b"BIN\0"))
            file.writelines(self._blocks)
