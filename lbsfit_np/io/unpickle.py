"""A pickle reader that runs nothing: arrays are rebuilt by our own code from what the file says about them.

Unpickling is calling: a pickle names functions and classes and calls them with arguments of its choice. Here every name that
a file may use leads to a small stand-in that only notes its arguments; no function or class of numpy, scipy or chumpy is ever
handed to the file. (numpy's own ``dtype.__setstate__`` believes any state it is given, which is a way into memory.) Once the
file is read, the notes are checked and turned into plain arrays. Any other name ends the reading.
"""

import codecs
import pickle
import re
import reprlib
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..errors import FileError

__all__ = ["ChumpyObject", "safe_load"]

_ADMITTED = "a pickle of numpy arrays, scipy.sparse csc/csr/coo matrices, chumpy objects and plain Python values"
_REMEDY = "If you trust where the file comes from, load it there and save its arrays with numpy.savez."


@dataclass(frozen=True, eq=False)
class ChumpyObject:
    """A chumpy object whose value could not be dug out of its state; it computes nothing.

    Attributes
    ----------
    kind : str
        Its class in chumpy, such as "chumpy.ch.MatVecMult".
    state : dict
        What the file says about it, with arrays resolved.
    """

    kind: str
    state: dict


def safe_load(path):
    """Read a pickle of arrays (SMPL, MANO) without executing anything from it.

    Parameters
    ----------
    path : path-like
        A pickle of any protocol, written by Python 2 (strings are decoded as latin1) or 3.

    Returns
    -------
    object
        Dicts, lists, tuples and plain values as stored; arrays as ``numpy.ndarray``, matrices of scipy.sparse as ``csc_array``,
        ``csr_array`` or ``coo_array`` with their indices checked, chumpy objects as the ``numpy.ndarray`` they stand for, or
        as :class:`ChumpyObject` where that would take computing.

    Raises
    ------
    FileError
        Missing, broken or truncated file, or one that asks for any other name than those of array containers.
    """
    name = str(path)
    try:
        with open(path, "rb") as file:
            return _Resolver().resolve(_Reader(file, encoding="latin1").load())
    except _Forbidden as e:
        raise FileError(
            name, f"a pickle that asks for {e}", _ADMITTED, f"Nothing from the file was executed. {_REMEDY}"
        ) from None
    except OSError as e:
        raise FileError(name, e.strerror or str(e), "a readable file") from None
    except MemoryError:
        raise FileError(name, "a pickle that needs more memory than is available", _ADMITTED) from None
    except RecursionError:
        raise FileError(name, "a pickle whose content is nested too deeply", _ADMITTED) from None
    except Exception as e:  # noqa: BLE001  a broken or hostile stream can make the reader fail in any way; the user sees one
        raise FileError(
            name,
            f"a file that cannot be read as a pickle ({type(e).__name__}: {_short(e)})",
            _ADMITTED,
            "The file may be truncated or of another kind.",
        ) from None


class _Forbidden(Exception):
    """A global that is not on the list."""


class _Reader(pickle.Unpickler):
    def __init__(self, file, **kwargs):
        super().__init__(file, **kwargs)
        self._records = {}

    def find_class(self, module, name):
        admitted = _CALLS.get((module, name))
        if admitted is not None:
            return admitted
        kind = f"{module}.{name}"
        chumpy = module == "chumpy" or module.startswith("chumpy.")
        # A module's attributes could be reached through a dotted name; a class of ours is named by it and nothing more.
        if (chumpy or _SPARSE.fullmatch(kind)) and "." not in name:
            if kind not in self._records:
                self._records[kind] = type("_Record", (_Record,), {"__slots__": (), "kind": kind})
            return self._records[kind]
        raise _Forbidden(_short(kind))

    def persistent_load(self, pid):
        raise _Forbidden(f"an object outside the file ({_short(pid)})")


_SPARSE = re.compile(r"scipy\.sparse(\._?(csc|csr|coo))?\.(csc|csr|coo)_(matrix|array)")


# ---- stand-ins: what the names in a pickle lead to ----


class _Call:
    """A function that a file may call; the file cannot set attributes on it (the BUILD opcode would)."""

    __slots__ = ("_function",)

    def __init__(self, function):
        object.__setattr__(self, "_function", function)

    def __call__(self, *args):
        return self._function(*args)

    def __setattr__(self, name, value):
        raise TypeError("stand-ins cannot be changed")


class _Record:
    """An instance of a chumpy or scipy.sparse class: its state, noted. ``kind`` is set on the subclasses.

    ``__setstate__`` is also what keeps a file from setting attributes on the class itself: BUILD finds it there and fails.
    """

    __slots__ = ("state",)

    def __new__(cls, *args, **kwargs):
        self = object.__new__(cls)
        self.state = {}
        return self

    def __init__(self, *args, **kwargs):
        pass

    def __setstate__(self, state):
        if not isinstance(state, dict):
            raise TypeError(f"the state of a {self.kind} is a {type(state).__name__}, not a dict")
        self.state = state


class _Dtype:
    """A numpy dtype by its code, "f8"; the state adds the byte order."""

    __slots__ = ("code", "order")

    def __init__(self, code, align=False, copy=False):
        code = code.decode("ascii") if isinstance(code, bytes) else code
        match = _CODE.fullmatch(code) if isinstance(code, str) else None
        if match is None:
            raise ValueError(f"an array of data type {_short(code)}; numbers, strings and objects can be read")
        self.order, self.code = match[1] or "=", match[2]

    def __setstate__(self, state):
        order = state[1].decode("ascii") if isinstance(state[1], bytes) else state[1]
        if order not in ("<", ">", "|", "=") or any(s is not None for s in state[2:5]):
            raise ValueError("a structured data type")
        self.order = order

    def numpy(self):
        return np.dtype(self.code if self.order in "|=" or self.code[0] == "O" else self.order + self.code)


_CODE = re.compile(r"([<>|=])?(b1|[iu][1248]|f(?:2|4|8|16)|c(?:8|16|32)|[SU]\d{1,6}|O8?|O4)")


class _Array:
    """A numpy array: what the file says of it, noted by ``__setstate__``."""

    __slots__ = ("axes", "data", "dtype", "fortran", "shape")

    def __init__(self):
        self.dtype = self.axes = None

    def __setstate__(self, state):
        shape, dtype, fortran, data = state[-4:]  # before it stands a version number; very old files have none
        if not isinstance(dtype, _Dtype):
            raise TypeError(f"an array whose data type is a {type(dtype).__name__}")
        self.shape, self.dtype, self.fortran, self.data = _shape(shape), dtype, bool(fortran), data


def _shape(shape):
    shape = (shape,) if type(shape) is int else tuple(shape)
    if any(type(n) is not int or n < 0 for n in shape):
        raise ValueError(f"an array of shape {_short(shape)}")
    return shape


def _reconstruct(subtype, shape, code):
    if subtype is not _NDARRAY:
        raise ValueError("an array of a class that is not numpy.ndarray")
    return _Array()


def _from_buffer(buffer, dtype, shape, order, axes=None):
    array = _Array()
    array.__setstate__((shape, dtype, order == "F", buffer))
    if order == "K" and axes is not None:  # stored in C order, then transposed
        array.axes = _shape(axes)
    return array


def _scalar(dtype, data):
    if not isinstance(dtype, _Dtype) or dtype.code[0] == "O":
        raise ValueError("a numpy scalar that is not a number or string")
    return np.frombuffer(_bytes(data), dtype.numpy(), count=1)[0]


def _encode(text, encoding="latin1"):
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1", "iso-8859-1"):
        raise ValueError("bytes written in an unknown way")
    return codecs.latin_1_encode(text)[0]


def _bytes(data):
    """Python 2's strings arrive decoded as latin1."""
    if isinstance(data, str):
        data = codecs.latin_1_encode(data)[0]
    if not isinstance(data, (bytes, bytearray)):
        raise TypeError(f"array data that are a {type(data).__name__}")
    return data


def _empty_bytes():
    return b""


def _record_of(cls, base, state):
    """copyreg._reconstructor, for the stand-ins' classes only: how protocols 0 and 1 make an instance."""
    if not (isinstance(cls, type) and issubclass(cls, _Record)):
        raise _Forbidden("copyreg._reconstructor of a class that is not an array's")
    return cls()


def _no_call(*args):
    raise ValueError("a call of a class that array files may only name")


_NDARRAY = _Call(_no_call)

_CALLS = {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Call(_Dtype),
    ("_codecs", "encode"): _Call(_encode),  # how Python 3 writes bytes in protocols 0 to 2
}
for _core in ("numpy.core", "numpy._core"):
    _CALLS[f"{_core}.multiarray", "_reconstruct"] = _Call(_reconstruct)
    _CALLS[f"{_core}.multiarray", "scalar"] = _Call(_scalar)
    _CALLS[f"{_core}.numeric", "_frombuffer"] = _Call(_from_buffer)
for _builtins in ("builtins", "__builtin__"):
    _CALLS[_builtins, "object"] = _Call(_no_call)
    _CALLS[_builtins, "set"] = _Call(set)  # chumpy's objects hold sets of names
    _CALLS[_builtins, "bytes"] = _Call(_empty_bytes)
for _copyreg in ("copyreg", "copy_reg"):
    _CALLS[_copyreg, "_reconstructor"] = _Call(_record_of)


# ---- from what was noted to arrays ----


class _Resolver:
    """Replaces the stand-ins in what was read; each object once, so that shared and circular content stays so."""

    def __init__(self):
        self.done = {}

    def resolve(self, value):
        if not isinstance(value, (dict, list, tuple, _Array, _Record)):
            return value.numpy() if isinstance(value, _Dtype) else value
        if id(value) not in self.done:
            # The original is kept beside its replacement: were it freed, its id could come back as another object's.
            self.done[id(value)] = value, None
            self.done[id(value)] = value, self._replacement(value)
        return self.done[id(value)][1]

    def _replacement(self, value):
        if isinstance(value, dict):
            new = {}
            self.done[id(value)] = value, new
            for k, v in value.items():
                new[k] = self.resolve(v)
            return new
        if isinstance(value, list):
            new = []
            self.done[id(value)] = value, new
            new.extend(self.resolve(v) for v in value)
            return new
        if isinstance(value, tuple):
            return tuple(self.resolve(v) for v in value)
        if isinstance(value, _Array):
            return self._array(value)
        state = {k: self.resolve(v) for k, v in value.state.items()}
        return _sparse(value.kind, state) if value.kind.startswith("scipy.") else _chumpy(value.kind, state)

    def _array(self, noted):
        if noted.dtype is None:
            raise ValueError("an array without content")
        order = "F" if noted.fortran else "C"
        n = int(np.prod(noted.shape, dtype=object))
        if noted.dtype.code[0] == "O":
            if not isinstance(noted.data, list) or len(noted.data) != n:
                raise ValueError("an array of objects whose shape and content differ")
            flat = np.empty(n, dtype=object)
            for i, v in enumerate(noted.data):
                flat[i] = self.resolve(v)
            return flat.reshape(noted.shape, order=order)
        data, dtype = _bytes(noted.data), noted.dtype.numpy()
        if len(data) != n * dtype.itemsize:
            raise ValueError(f"an array of shape {_short(noted.shape)} with {len(data)} bytes of {dtype} data")
        if not n:
            return np.empty(noted.shape, dtype)
        array = np.frombuffer(data, dtype).reshape(noted.shape, order=order).astype(dtype.newbyteorder("="))
        return array if noted.axes is None else array.transpose(noted.axes)


def _sparse(kind, state):
    form = kind[-10:-7] if kind.endswith("_matrix") else kind[-9:-6]
    shape = _shape(state.get("_shape", state.get("shape", ())))
    if len(shape) != 2:
        raise ValueError(f"a sparse matrix of shape {_short(shape)}")
    if form == "coo":
        row, col = state["coords"] if "coords" in state else (state["row"], state["col"])
        return sparse.coo_array((state["data"], (row, col)), shape=shape)
    make = sparse.csc_array if form == "csc" else sparse.csr_array
    array = make((state["data"], state["indices"], state["indptr"]), shape=shape)
    array.check_format(full_check=True)  # scipy's compiled code trusts the indices
    return array


def _chumpy(kind, state):
    """The array that a chumpy object stands for, where that is stored or only reordered; else the object, inert."""
    name = kind.rpartition(".")[2]
    inner = state.get("x" if name == "Ch" else "a")
    if isinstance(inner, np.ndarray) and inner.dtype.kind in "biuf":
        if name == "Ch":
            return inner
        if name == "Select":
            picked = inner.ravel()[np.asarray(state["idxs"])]
            shape = state.get("preferred_shape")
            return picked if shape is None else picked.reshape(_shape(shape))
        if name == "Reshape":
            return inner.reshape(state["newshape"])
        if name == "transpose":
            return np.transpose(inner, state.get("axes"))
    elif name == "Ch" and isinstance(inner, (int, float)):
        return np.asarray(inner, dtype=float)
    return ChumpyObject(kind, state)


def _short(value):
    text = str(value) if isinstance(value, (str, Exception)) else reprlib.repr(value)
    return text if len(text) <= 80 else text[:77] + "…"
