"""Scans from files: one door for all formats, which picks the reader, checks what it read, and samples meshes."""

import sys
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError, LbsfitError, brief, counted, is_whole
from ..scan import Scan, check_points
from ..seeds import generator
from ..triangles import area_vectors, areas_around

__all__ = ["SCAN_EXTENSIONS", "load_mesh", "load_scan"]


def _lazily(module, function):
    """A reader that is imported when it is first used."""

    def read(path):
        from importlib import import_module

        return getattr(import_module(module, __package__), function)(path)

    return read


_READERS = {
    ".ply": _lazily(".ply", "read_ply"),
    ".obj": _lazily(".scan_meshes", "read_obj"),
    ".stl": _lazily(".scan_meshes", "read_stl"),
    ".off": _lazily(".scan_meshes", "read_off"),
    ".xyz": _lazily(".columns", "read_table"),
    ".pts": _lazily(".columns", "read_table"),
    ".asc": _lazily(".columns", "read_table"),
    ".txt": _lazily(".columns", "read_table"),
    ".csv": _lazily(".columns", "read_table"),
    ".pcd": _lazily(".pcd", "read_pcd"),
    ".npy": _lazily(".scan_arrays", "read_npy"),
    ".npz": _lazily(".scan_arrays", "read_npz"),
    ".glb": _lazily(".gltf_scan", "read_gltf_scan"),
    ".gltf": _lazily(".gltf_scan", "read_gltf_scan"),
}

SCAN_EXTENSIONS = tuple(_READERS)

# Vertices that do the work of less than this share of as many evenly spread points are uneven. Of the bundled meshes it is 0.54
# or more, of an artist's body, with its face and hands, 0.30: the middle of its back has no points near it.
_UNEVEN = 0.45
# A surface to sample from has at least this share of a file's points; of its vertices this share may be a floor's.
_SURFACE, _FLOOR = 0.95, 0.01
# With fewer triangles a point, and most points in none, a file is a point cloud beside some triangles. A mesh that was cropped
# may have kept all points, too, but it has more triangles.
_FEW = 0.1


def load_scan(path, *, n_samples=None, random_state=0, drop_invalid=False):
    """Load a scan: a point cloud, or a mesh by its vertices or by points sampled from its surface.

    Parameters
    ----------
    path : str or Path
        .ply .obj .stl .off .xyz .pts .asc .txt .csv .pcd .npy .npz .glb .gltf; the extension picks the reader, and content that
        does not fit it is an error. The points keep the file's order, frame and unit (glTF: the scene's frame, y up, metres).
    n_samples : int, optional
        Number of points to sample from a mesh's surface, uniformly by area; of a point cloud, take a random subset of at most
        this many. By default, all vertices of a mesh and all points of a cloud are taken. A file with most of its points in no
        triangle, and few triangles beside them, is a cloud.
    random_state : int or numpy.random.Generator, default 0
        Seed of the samples.
    drop_invalid : bool, default False
        Leave out points (and faces at vertices) with NaN or infinite coordinates instead of refusing them.

    Returns
    -------
    Scan
        With ``labels`` and ``normals`` if the file has them. Sampled points take the label of the nearest corner of their
        triangle, and interpolated normals.

    Raises
    ------
    FileError
        Missing, truncated or damaged file, unknown extension, no points, NaN or infinite points, all points equal, faces
        that refer to missing vertices.
    InputError
        ``n_samples`` is not a positive whole number, or ``drop_invalid`` neither True nor False.
    """
    if not isinstance(drop_invalid, (bool, np.bool_)):
        raise InputError("drop_invalid", brief(drop_invalid), "True or False")
    if n_samples is not None and not is_whole(n_samples, 1):
        raise InputError("n_samples", brief(n_samples), "a positive whole number, or None for the points as they are")
    if n_samples is not None and n_samples > sys.maxsize:
        raise InputError("n_samples", brief(n_samples), "no more points than memory can hold")
    shown = str(path)
    cloud = _read(path, shown)
    if n_samples is not None and cloud.mesh is not None:
        cloud = cloud.mesh
    notes = list(cloud.notes)
    points, valid = _checked(cloud.points, shown, drop_invalid)
    normals = _per_point(cloud.normals, "normals", (len(valid), 3), shown)
    labels = _per_point(cloud.labels, "labels", (len(valid),), shown)
    faces = _checked_faces(cloud.faces, len(valid), shown)
    if not valid.all():
        notes.append(f"{int((~valid).sum())} of {len(valid)} points have a coordinate that is NaN or infinite: left out.")
        normals = None if normals is None else normals[valid]
        labels = None if labels is None else labels[valid]
        faces = (np.cumsum(valid) - 1)[faces[valid[faces].all(axis=1)]]
    loose = 0 if n_samples is None or not len(faces) else _in_no_triangle(len(points), faces)
    cloud = loose > len(points) / 2 and len(faces) < _FEW * len(points)
    if cloud:
        notes.append(f"{loose} of its {len(points)} points are in no triangle: it is taken for a point cloud.")
    if n_samples is not None and len(faces) and not cloud:
        if loose:
            notes.append(f"{loose} of its {len(points)} points are in no triangle: left out.")
        points, normals, labels = _sampled(points, faces, normals, labels, n_samples, random_state, shown)
        notes.append(f"{n_samples} points sampled from the surface of {len(faces)} triangles.")
    elif n_samples is not None and n_samples < len(points):
        keep = Scan(points).thinned(n_samples, generator(random_state, "load_scan"))
        notes.append(f"A random subset of {n_samples} of its {len(points)} points.")
        points, normals, labels = (
            points[keep],
            None if normals is None else normals[keep],
            None if labels is None else labels[keep],
        )
    elif n_samples is not None:
        if n_samples > len(points):
            notes.append(f"It has {counted(len(points), 'point')}, fewer than the {n_samples} asked for: all are taken.")
    elif len(faces) and _evenness(points, faces) < _UNEVEN:
        notes.append("Its vertices are unevenly spaced: set n_samples (--samples), such as 20000, to sample its surface instead.")
    for array in (points, normals, labels):  # these are ours alone: Scan need not copy what nobody else can write to
        if array is not None:
            array.flags.writeable = False
    try:
        return Scan(points, normals, labels, name=Path(path).stem, path=Path(path), notes=tuple(notes))
    except InputError as error:
        raise FileError(shown, error.got, error.expected, error.remedy) from None


def _in_no_triangle(n, faces):
    free = np.ones(n, dtype=bool)
    free[faces] = False
    return int(np.count_nonzero(free))


def _evenness(points, faces):
    """Of how many evenly spread points vertices do the work, ÷ their number; 1 where hardly all points are vertices of a surface.

    The vertices that stand for the most of it are left out: they are a floor's.
    """
    with np.errstate(all="ignore"):  # of lengths whose squares are beyond all numbers, which tell nothing
        own = np.sort(areas_around(points, faces))
        on_surface = np.count_nonzero(own)
        if on_surface < _SURFACE * len(points):
            return 1.0
        own = own[len(own) - on_surface : len(own) - int(np.ceil(_FLOOR * on_surface))]
        own = own / own.max(initial=0.0)
        evenness = own.sum() ** 2 / (own @ own) / len(own)
    return evenness if np.isfinite(evenness) else 1.0


def load_mesh(path):
    """Vertices and triangles of a mesh file, in the file's order, frame and unit.

    Parameters
    ----------
    path : str or Path
        A file in a format that :func:`load_scan` reads and that has faces.

    Returns
    -------
    (m, 3) array, (F, 3) int array

    Raises
    ------
    FileError
        As for :func:`load_scan`; also a file without faces.
    """
    shown = str(path)
    cloud = _read(path, shown)
    cloud = cloud.mesh or cloud
    points, _ = _checked(cloud.points, shown, False)
    faces = _checked_faces(cloud.faces, len(points), shown)
    if not len(faces):
        raise FileError(shown, "points without faces", "a mesh")
    return np.array(points, dtype=float), faces


def _read(path, shown):
    try:
        path = Path(path)
    except TypeError:
        raise InputError("path", type(path).__name__, "the path of a file") from None
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        got = f"the extension {suffix!r}" if suffix else "a name without an extension"
        raise FileError(shown, got, f"one of {' '.join(_READERS)}", "Convert the scan to one of these formats, for instance PLY.")
    if "\0" in shown:
        raise FileError(repr(shown), "a name with a NUL character, which no file can have", "the path of a file")
    try:
        if path.is_dir():
            raise FileError(shown, "a folder", "a file")
        if path.stat().st_size == 0:
            raise FileError(shown, "an empty file (0 bytes)", "a file with points")
        with np.errstate(invalid="ignore"):  # of NaN whose bits signal, which is told later
            return _READERS[suffix](path)
    except LbsfitError:
        raise
    except FileNotFoundError:
        raise FileError(shown, "no such file", "a file that exists", "Check the path for typing errors.") from None
    except OSError as error:
        raise FileError(shown, f"a file that cannot be read ({error.strerror or error})", "a readable file") from None
    except MemoryError:
        raise FileError(shown, "more than memory can hold", "a smaller scan", "The file may be damaged.") from None
    except (ValueError, OverflowError, TypeError, LookupError) as error:  # damage that its reader has not foreseen
        got = f"content that cannot be read ({error})"
        raise FileError(shown, got, f"a complete {suffix[1:].upper()} file", "The file is truncated or damaged.") from error


def _checked(points, shown, drop_invalid):
    """Finite points (n', 3) and which of the file's points they are (n,) bool."""
    points = np.asarray(points)
    try:
        kept = check_points(points, drop_invalid=drop_invalid)
    except InputError as error:
        raise FileError(shown, error.got, error.expected, error.remedy) from None
    return kept, np.ones(len(points), bool) if len(kept) == len(points) else np.isfinite(points).all(axis=1)


def _per_point(values, what, shape, shown):
    if values is None:
        return None
    values = np.asarray(values)
    if what == "labels" and values.shape == (*shape, 1):
        values = values[:, 0]
    if values.shape != shape or values.dtype.kind not in ("iu" if what == "labels" else "iuf"):
        kind = "whole numbers" if what == "labels" else "numbers"
        raise FileError(
            shown, f"{what} of shape {values.shape} and type {values.dtype}", f"{kind} of shape {shape}, one row per point"
        )
    return values.astype(np.int64 if what == "labels" else np.float64)


def _checked_faces(faces, n, shown):
    if faces is None or not np.size(faces):
        return np.empty((0, 3), dtype=int)
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise FileError(shown, f"faces of shape {faces.shape} and type {faces.dtype}", "whole numbers of shape (F, 3)")
    if faces.min() < 0 or faces.max() >= n:
        bad = int(np.argmax(((faces < 0) | (faces >= n)).any(axis=1)))
        expected = f"numbers of the file's {n} vertices"
        raise FileError(shown, f"face {bad} with vertices out of range", expected, "The file is truncated or damaged.")
    return faces.astype(int)


def _sampled(points, faces, normals, labels, n, random_state, shown):
    """Points on the surface, with what their triangles' corners know."""
    from ..synthesis import sample_surface

    if not area_vectors(points, faces).any():
        raise FileError(
            shown, "a mesh whose triangles have no area", "a surface to sample from", "Leave n_samples out to use its vertices."
        )
    sampled, triangle, weight = sample_surface(points, faces, n, generator(random_state, "load_scan"))
    corners = faces[triangle]
    if labels is not None:
        labels = labels[corners[np.arange(n), weight.argmax(axis=1)]]
    if normals is not None:
        normals = np.einsum("nk,nka->na", weight, normals[corners])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.where(length > 0, length, 1.0)
    return sampled, normals, labels
