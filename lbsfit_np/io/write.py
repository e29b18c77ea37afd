"""Files written whole or not at all: each appears under its name only once it is complete."""

import errno
import json
import os
import secrets
import stat
import zipfile
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError, as_array, check_real, check_unmasked

__all__ = [
    *("atomic_path", "atomic_paths", "check_folder", "check_npz_name", "make_folder", "remove_empty"),
    *("without_empty", "write_json", "write_mesh_ply", "write_npz", "write_points_ply"),
]


# Temporary file → the name asked for, which errors tell, also of another file that is written in its place.
_ASKED_FOR = {}


@contextmanager
def atomic_path(path):
    """A temporary file beside ``path`` to write to, which takes its place when the block ends without an error.

    Parameters
    ----------
    path : str or Path
        Where the file shall appear; an older file there stays untouched until then.

    Yields
    ------
    Path
        An empty file in the same folder, with the same extension and the permissions that the user's umask gives.
        It is removed when the block raises anything, Ctrl-C included.

    Raises
    ------
    FileError
        The folder does not exist or cannot be written to, the disk is full, ``path`` is a folder or a name that cannot be.
    InputError
        ``path`` is no path.
    """
    with _unnamed(path) as (temporary, final):
        yield temporary
        _to_disk(temporary)  # before it has the name: else a power cut could leave the name with nothing behind it
        os.replace(temporary, final)


@contextmanager
def atomic_paths(*paths):
    """:func:`atomic_path` of files that belong together, as a list: all take their places, in this order, or none does.

    No older file lies beside a newer one in between, even where the process is killed.
    """
    with ExitStack() as stack:
        files = [stack.enter_context(_unnamed(path)) for path in paths]
        yield [temporary for temporary, _ in files]
        step = None
        try:
            for step, _ in files:
                _to_disk(step)
        except OSError as error:
            raise _cannot_write(step, error) from error
        _name_together(files)


def _name_together(files):
    """Give complete files their names, pairs (temporary, final); where one cannot have it, all is as it was before."""
    older, named = [], []
    try:
        for temporary, final in files:
            if os.path.lexists(final):
                older.append((temporary.with_suffix(".older"), final))
                os.replace(final, older[-1][0])
        for temporary, final in files:
            named.append((temporary, final))  # first: a stop may come as soon as it has the name
            os.replace(temporary, final)
    except BaseException as error:
        for here, there in named:
            with suppress(OSError):
                os.replace(there, here)
        for aside, there in older:
            with suppress(OSError):
                os.replace(aside, there)
        if isinstance(error, OSError):
            raise _cannot_write(temporary, error) from error
        raise
    for aside, _ in older:
        with suppress(OSError):  # another program holds it: the files are written all the same
            aside.unlink()


@contextmanager
def _unnamed(path):
    """A temporary file to write to, and the file whose place it is to take; removed at the end where it is still there."""
    try:
        given = final = Path(path)
    except TypeError:
        raise InputError("path", type(path).__name__, "the name of a file to write") from None
    if not final.name or os.path.isdir(final):
        raise FileError(str(path), "a folder", "the name of a file to write")
    if not os.path.isdir(final.parent):
        raise FileError(str(path), f"a folder that does not exist ({final.parent})", "an existing folder", "Create it first.")
    try:
        final = Path(os.path.realpath(final))  # a link stays, and what it leads to is written
        device = not stat.S_ISREG(os.lstat(final).st_mode)
    except FileNotFoundError:
        device = False
    except (OSError, ValueError) as error:  # a name that is too long, or with NUL in it: known before anything is computed
        raise _cannot_write(path, error) from error
    if device:  # which the last step would put a file in the place of
        raise FileError(str(path), "a device, or a link in a circle", "the name of a file to write")
    temporary = final.with_name(f".{_start(given.stem)}.{secrets.token_hex(6)}.tmp{_start(given.suffix)}")  # the ending asked for
    try:
        # Created in here, as a process may be told to end as soon as the file is there. mkstemp would make it private (0600);
        # this way the umask decides, as for any file that a user writes.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        _ASKED_FOR[str(temporary)] = path
        yield temporary, final
    except BaseException as error:
        with suppress(OSError):  # which would hide what has happened
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise
    finally:
        _ASKED_FOR.pop(str(temporary), None)


def _to_disk(path):
    """Have a file's content on the disk and not only on its way there, where the file system does that."""
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


def make_folder(out):
    """Create the folder to write to, and see that it can be written to; the folders that were not there, the innermost first.

    Raises
    ------
    FileError
        It cannot be made, or nothing can be written there; what was made up to then is removed.
    """
    out = Path(out)
    made = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    for path in (out, *out.parents):
        if os.path.exists(path) and not os.path.isdir(path):
            raise FileError(str(path), "a file", "a folder to write to, or a name for a new one")
    try:
        out.mkdir(parents=True, exist_ok=True)
        _check_writable(out)
    except (OSError, ValueError) as error:  # ValueError: NUL in the name
        remove_empty(made)
        if isinstance(error, FileError):
            raise
        raise _cannot_make(out, error) from None
    return made


def check_folder(path):
    """See that a folder can be made and written to, without making it: others may be making the same.

    Raises
    ------
    FileError
        As :func:`make_folder`.
    """
    path = Path(path)
    there = next((folder for folder in (path, *path.parents) if os.path.lexists(folder)), Path())
    if not os.path.exists(there):  # a link to nothing
        raise _cannot_make(there, FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST)))
    if not os.path.isdir(there):
        raise FileError(str(there), "a file", "a folder to write to, or a name for a new one")
    try:
        # Each name to be made, as the system looks no further than the first that is not there; and the path as a whole.
        for folder in (*(there / name for name in path.parts[len(there.parts) :]), path):
            with suppress(FileNotFoundError):  # and nothing else, such as a name too long or with NUL in it
                os.lstat(folder)
    except (OSError, ValueError) as error:
        raise _cannot_make(path, error) from None
    _check_writable(there)


def remove_empty(folders):
    """Remove folders that are empty."""
    for folder in folders:
        with suppress(OSError, ValueError):  # there is something in it, or it was never there
            folder.rmdir()


@contextmanager
def without_empty(folder):
    """A block at whose end ``folder``, and what it is in, are removed where they were not there before and are empty."""
    new = [path for path in (Path(folder), *Path(folder).parents) if not os.path.lexists(path)]
    try:
        yield
    finally:
        remove_empty(new)


def _cannot_make(folder, error):
    why = getattr(error, "strerror", None) or error
    return FileError(str(folder), f"a folder that cannot be made ({why})", "a folder to write to")


def _check_writable(folder):
    """Raise FileError unless files can be made in a folder: permissions do not tell of read-only disks, nor root of anything."""
    from tempfile import TemporaryFile

    try:
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        why = error.strerror or type(error).__name__
        raise FileError(str(folder), f"a folder that cannot be written to ({why})", "a folder to write to") from None


def write_mesh_ply(path, vertices, faces, *, vertex_labels=None, colors=None, normals=None, part_names=None):
    """Write a triangle mesh as binary little-endian PLY.

    Parameters
    ----------
    path : str or Path
    vertices : (m, 3) array
        Written as doubles: reading them back gives the same numbers.
    faces : (F, 3) int array
    vertex_labels : (m,) int array, optional
        Property ``label``; comes back as ``labels`` from ``load_scan``.
    colors : (m, 3) uint8 array, optional
        Properties ``red``, ``green``, ``blue``.
    normals : (m, 3) array, optional
        Properties ``nx``, ``ny``, ``nz``.
    part_names : sequence of str, optional
        Header comments ``part 0 NAME``, ``part 1 NAME``, … that say what the labels mean.

    Raises
    ------
    InputError, FileError
        Arrays whose lengths differ; a path that cannot be written.
    """
    table = _vertex_table(vertices, normals=normals, colors=colors, labels=vertex_labels)
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InputError("faces", f"{faces.dtype} values of shape {faces.shape}", "whole numbers of shape (F, 3)")
    _check_range("faces", faces, 0, len(table) - 1)
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("rows", "<i4", 3)])
    rows["count"], rows["rows"] = 3, faces
    _write_ply(path, table, rows, part_names)


def write_points_ply(path, points, *, labels=None, confidence=None, colors=None, normals=None, part_names=None):
    """Write a point cloud as binary little-endian PLY.

    Parameters
    ----------
    path : str or Path
    points : (n, 3) array
        Written as doubles.
    labels : (n,) int array, optional
        Property ``label``.
    confidence : (n,) array, optional
        Property ``confidence``, a float.
    colors, normals, part_names
        As for :func:`write_mesh_ply`.
    """
    _write_ply(
        path, _vertex_table(points, normals=normals, colors=colors, labels=labels, confidence=confidence), None, part_names
    )


def write_json(path, obj):
    """Write JSON for people to read: sorted keys, two spaces of indent, NaN and infinity as null.

    Takes what ``json`` takes, and NumPy scalars and arrays, tuples and paths besides.
    """
    text = json.dumps(_plain(obj), indent=2, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # file names need not be Unicode: as JSON escapes


def check_npz_name(path):
    """FileError unless a name ends in ``.npz``, by which such files are known again."""
    suffix = Path(path).suffix if isinstance(path, (str, os.PathLike)) else ".npz"  # what is no path is for others to refuse
    if suffix.lower() != ".npz":
        if os.path.isdir(path):
            raise FileError(str(path), "a folder", "the name of a file to write, which ends in .npz")
        raise FileError(str(path), f"the ending {suffix!r}" if suffix else "a name without an ending", "a name that ends in .npz")


def write_npz(path, /, **arrays):
    """Write arrays as an NPZ that ``np.load(path, allow_pickle=False)`` reads; the same arrays give the same bytes.

    Raises
    ------
    InputError
        An array of Python objects: only a pickle could hold it.
    """
    arrays = {key: np.asanyarray(value) for key, value in arrays.items()}
    for key, array in arrays.items():
        if array.dtype.hasobject:
            raise InputError(key, "an array of Python objects", "numbers, booleans or text, which need no pickle")
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        # np.savez_compressed would do, but for arrays that are called "file" or "allow_pickle", and its slower level.
        for key, array in arrays.items():
            with archive.open(key + ".npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


_PLY_NAMES = {"f8": "double", "f4": "float", "i4": "int", "u1": "uchar"}
_WHOLE = {"|u1": (0, 255), "<i4": (-(2**31), 2**31 - 1)}


def _vertex_table(points, *, normals=None, colors=None, labels=None, confidence=None):
    """The vertex element as a structured array, one field per property."""
    check_unmasked("points", points)
    points = as_array("points", points, "shape (n, 3)")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError("points", f"an array of shape {points.shape}", "shape (n, 3)")
    check_real("points", points, "numbers of shape (n, 3)")
    if points.dtype.kind not in "iuf":
        raise InputError("points", f"values of type {points.dtype}", "numbers of shape (n, 3)")
    n = len(points)
    columns = [(("x", "y", "z"), "<f8", points)]
    for names, kind, argument, values, allowed in (
        (("nx", "ny", "nz"), "<f4", "normals", normals, "iuf"),
        (("red", "green", "blue"), "|u1", "colors", colors, "u"),  # a float 0 … 1 would silently become black
        (("label",), "<i4", "labels", labels, "iu"),
        (("confidence",), "<f4", "confidence", confidence, "iuf"),
    ):
        if values is None:
            continue
        values = np.asarray(values)
        wanted = (n, 3) if len(names) == 3 else (n,)
        if values.shape != wanted or values.dtype.kind not in allowed:
            what = {"u": "unsigned bytes (0–255)", "iu": "whole numbers"}.get(allowed, "numbers")
            raise InputError(argument, f"{values.dtype} values of shape {values.shape}", f"{what} of shape {wanted}")
        if kind in _WHOLE:
            _check_range(argument, values, *_WHOLE[kind])
        columns.append((names, kind, values))
    table = np.empty(n, dtype=[(name, kind) for names, kind, _ in columns for name in names])
    for names, _, values in columns:
        for k, name in enumerate(names):
            table[name] = values if values.ndim == 1 else values[:, k]
    return table


def _check_range(argument, values, least, most):
    """Raise where whole numbers would become others in the file."""
    if values.size and not least <= int(values.min()) <= int(values.max()) <= most:
        raise InputError(argument, f"{values.min()} to {values.max()}", f"whole numbers from {least} to {most}")


def _write_ply(path, table, faces, part_names):
    header = ["ply", "format binary_little_endian 1.0"]
    for p, name in enumerate(part_names or ()):
        header.append(f"comment part {p} " + " ".join(str(name).split()))
    header.append(f"element vertex {len(table)}")
    header += [f"property {_PLY_NAMES[table.dtype[name].str[1:]]} {name}" for name in table.dtype.names]
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header.append("end_header\n")
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode("ascii", "backslashreplace"))
        file.write(table)  # tofile would not say that the disk is full
        if faces is not None:
            file.write(faces)


def _plain(obj):
    """The same content in the types that ``json`` knows."""
    if isinstance(obj, dict):
        return {str(key): _plain(value) for key, value in obj.items()}
    if isinstance(obj, (list, tuple)):
        return [_plain(value) for value in obj]
    if isinstance(obj, np.ndarray):
        return _plain(obj.tolist())
    if isinstance(obj, np.generic):
        return _plain(obj.item())
    if isinstance(obj, float):
        return obj if np.isfinite(obj) else None
    if isinstance(obj, Path):
        return str(obj)
    return obj


def _start(name, most=80):
    """The start of a name, of at most so many bytes: file systems count these, not letters."""
    return name.encode("utf-8", "ignore")[:most].decode("utf-8", "ignore")


def _cannot_write(path, error):
    why = getattr(error, "strerror", None) or error
    return FileError(str(_ASKED_FOR.get(str(path), path)), f"an error while writing ({why})", "a place that can be written to")
