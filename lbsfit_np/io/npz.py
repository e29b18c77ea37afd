"""Reading NPZ and NPY files from anywhere: every way in which one can be broken becomes one clear error."""

import os
import struct
import tokenize
import zipfile
import zlib
from contextlib import ExitStack, contextmanager

import numpy as np

from ..errors import FileError, InputError

__all__ = ["MODEL_KEY", "RESULT_KEY", "npz_keys", "read_npy", "read_npz"]

# What the file of a fit has, or of a learned fitter, and no other.
RESULT_KEY = "lbsfit_np_result"
MODEL_KEY = "lbsfit_np_model"

# What zipfile, zlib and numpy raise for files that are cut short, damaged, or something else entirely; RuntimeError is zipfile's
# word for encrypted members and for compressions that it does not know.
_BROKEN = (
    zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, SyntaxError, ValueError, TypeError, KeyError, IndexError,
    EOFError, RuntimeError, OverflowError, MemoryError,
)  # fmt: skip


def npz_keys(path):
    """Names of the arrays in an NPZ file, a set of str; nothing is unpacked."""
    with _opened(path) as archive:
        return set(archive.files)


def read_npz(path, keys=None):
    """Arrays of an NPZ file by name.

    Parameters
    ----------
    path : path-like
    keys : iterable of str, optional
        Only these, where they are there; default all.

    Returns
    -------
    dict of str to array

    Raises
    ------
    FileError
        Missing, no NPZ, cut short, or with Python objects inside, which are never loaded.
    """
    out = {}
    with _opened(path) as archive:
        for key in archive.files if keys is None else (k for k in keys if k in archive.files):
            try:
                value = archive[key]
            except ValueError as e:
                if "pickle" in str(e).lower():
                    got, expected = (
                        f"Python objects in {key!r}, which are not loaded because loading them can run code",
                        "plain arrays",
                    )
                    raise FileError(str(path), got, expected, "Save the array with a plain dtype.") from None
                raise _broken(path, f"{key!r} cannot be unpacked") from None
            except (*_BROKEN, OSError):
                raise _broken(path, f"{key!r} cannot be unpacked") from None
            if not isinstance(value, np.ndarray):  # a member that is not an NPY file comes as bytes
                raise _broken(path, f"{key!r} is not an array")
            out[key] = value
    return out


def read_npy(path):
    """The array of an NPY file.

    Raises
    ------
    FileError
        Missing, no NPY, cut short, damaged, or an array of Python objects, which are never loaded.
    """
    try:
        with open(path, "rb") as file:
            magic = file.read(6)
    except FileNotFoundError:
        raise FileError(str(path), "no such file", "an NPY file") from None
    except OSError as error:
        raise FileError(str(path), f"a file that cannot be read ({error.strerror or error})", "an NPY file") from None
    if magic != b"\x93NUMPY":
        raise FileError(str(path), "content that is not an NPY array", "an NPY file", "Check the extension.")
    try:
        return np.load(path, allow_pickle=False)
    except (*_BROKEN, OSError) as error:
        if isinstance(error, ValueError) and "pickle" in str(error):
            got, remedy = "an array of Python objects", "Such arrays are pickles and are not read."
            raise FileError(str(path), got, "numbers", remedy) from None
        got, remedy = f"content that cannot be read ({error})", "The file is truncated or damaged."
        raise FileError(str(path), got, "a complete NPY file", remedy) from None


@contextmanager
def _opened(path):
    """The archive, closed at the end, as is a file that turns out to be none."""
    if not isinstance(path, (str, os.PathLike)):
        raise InputError("path", f"a {type(path).__name__}", "the path of an NPZ file")
    with ExitStack() as stack:
        try:
            archive = np.load(stack.enter_context(open(path, "rb")), allow_pickle=False)
        except FileNotFoundError:
            raise FileError(str(path), "no such file", "an NPZ file") from None
        except IsADirectoryError:
            raise FileError(str(path), "a folder", "an NPZ file") from None
        except _BROKEN:
            raise _broken(path, "it does not open as an NPZ archive") from None
        except OSError as e:
            raise FileError(str(path), f"a file that cannot be read ({e.strerror or e})", "an NPZ file") from None
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise FileError(str(path), "a single array (NPY)", "an NPZ file, which holds several arrays by name")
        yield stack.enter_context(archive)


def _broken(path, what):
    return FileError(str(path), f"a file that is broken or not NPZ ({what})", "a complete NPZ file", "Copy or download it again.")
