"""Scans as arrays: NPY and NPZ files."""

import numpy as np

from ..errors import FileError
from . import npz
from .cloud import CloudData, cloud_from_columns, column_role, set_labels, whole_numbers
from .columns import unnamed

__all__ = ["read_npy", "read_npz"]

_NPZ_KEYS = {
    "points": ("points", "xyz", "vertices", "verts", "v", "positions", "position", "pos", "point", "x", "pc", "cloud"),
    "faces": ("faces", "f", "triangles"),
    "normals": ("normals", "normal", "vertex_normals", "point_normals"),
}
# What faces belong to where the points are another array. A "v" with a row for each point is velocities.
_VERTICES = ("vertices", "verts", "v")
# A picture has at least so many rows and columns, and at most so many times as many of one as of the other.
_PICTURE, _LONG = 48, 4
# What notes on columns without names advise: on row numbers, and on further columns.
_IN_ARRAYS = ("leave it out (array[:, 1:])", "a structured array with fields (x, y, z, nx, ny, nz, label)")


def read_npy(path):
    """Read an (n, 3 or more) array, whose columns are as in :func:`.columns.read_table`, or a structured one with x, y, z."""
    array = npz.read_npy(path)
    if array.dtype.names:
        return cloud_from_columns(path, "fields", array.dtype.names, lambda k: array.reshape(-1)[array.dtype.names[k]])
    if array.ndim == 2 and _PICTURE <= min(array.shape) and max(array.shape) <= _LONG * min(array.shape):
        got = f"an array of shape {array.shape}, which looks like a depth image"
        raise FileError(str(path), got, "points of shape (n, 3)", "Convert each pixel to x, y, z with the camera's intrinsics.")
    if array.ndim == 2 and array.shape[1] > 3 and array.shape[0] != 3 and array.dtype.kind in "iuf":
        return unnamed(array, *_IN_ARRAYS)
    return CloudData(array)


def read_npz(path):
    """Read an NPZ file: points (or xyz, vertices, …), and faces, normals and labels where it has them.

    Faces are of the vertices, where there are vertices beside the points: the two are then the cloud's mesh.
    """
    by_name = {key.lower(): key for key in sorted(npz.npz_keys(path))}
    if npz.RESULT_KEY in by_name:
        remedy = "Give the scan that was fitted; FitResult.load reads this file."
        raise FileError(str(path), "the result of a fit", "a scan", remedy)
    of_rig = {"parents", "joints"} <= set(by_name) and any(key.startswith("weights") for key in by_name)
    if of_rig and not {"points", "xyz"} & set(by_name):
        raise FileError(str(path), "a rig, or a learned model", "a scan", "Give the rig before the scans.")
    found = {what: next((by_name[k] for k in keys if k in by_name), None) for what, keys in _NPZ_KEYS.items()}
    labels = [key for name, key in by_name.items() if column_role(name) == 6]
    axes = [by_name.get(axis) for axis in "xyz"]
    arrays = npz.read_npz(path, {key for key in [*found.values(), *axes] if key is not None})
    if all(axes):
        named, cloud = "x, y, z", cloud_from_columns(path, "arrays", axes, lambda k: arrays[axes[k]].reshape(-1))
    elif found["points"] is not None:
        named, cloud = found["points"], CloudData(arrays[found["points"]])
    else:
        expected = f"one called {', '.join(_NPZ_KEYS['points'][:3])} (or verts, v, positions, pos)"
        raise FileError(str(path), f"arrays called {', '.join(by_name.values()) or '(none)'}", expected)
    faces, normals, labels = arrays.get(found["faces"]), arrays.get(found["normals"]), _arrays_called(path, labels)
    vertices = None if named.lower() in _VERTICES else _vertices_of(path, faces, by_name, len(np.atleast_1d(cloud.points)))
    if vertices is None:
        cloud.faces, cloud.normals = faces, normals
        _take_labels(cloud, labels)
        return cloud
    vertices, array = vertices
    mesh = cloud.mesh = CloudData(array, faces)
    cloud.notes.append(f"The faces are of {vertices!r}, the points {named!r}: n_samples (--samples) samples that mesh instead.")
    mesh.notes.append(f"The faces are of {vertices!r}: that mesh was taken, and the points {named!r} were left out.")

    def of_mesh(array):
        return np.shape(array)[:1] == np.shape(mesh.points)[:1]

    def of_points(array):  # also what fits neither, which is told then
        return np.shape(array)[:1] == np.shape(cloud.points)[:1] or not of_mesh(array)

    for part, fits in ((cloud, of_points), (mesh, of_mesh)):
        part.normals = normals if normals is not None and fits(normals) else None
        _take_labels(part, {key: values for key, values in labels.items() if fits(values)})
    return cloud


def _vertices_of(path, faces, by_name, n):
    """The name and the array (m, 3) that faces are rows of, beside n points; None where that is these, or not known."""
    if faces is None or not faces.size or faces.dtype.kind not in "iu":
        return None
    for key in (by_name[k] for k in _VERTICES if k in by_name):
        try:
            array = npz.read_npz(path, [key])[key]
        except FileError:  # of Python objects, say
            continue
        fits = array.ndim == 2 and array.shape[1] == 3 and array.dtype.kind in "iuf"
        if fits and faces.max() < len(array) and (key.lower() != "v" or len(array) != n):
            return key, array
    return None


def _arrays_called(path, keys):
    """Arrays by name, without those of Python objects, say, where another may do."""
    found = {}
    for key in keys:
        try:
            found |= npz.read_npz(path, [key])
        except FileError:
            if keys == [key]:
                raise
    return found


def _take_labels(cloud, found):
    """Of the arrays that are called like labels the first that has a whole number for each point, else the first."""
    if not found:
        return
    n = np.shape(cloud.points)[:1] or (0,)
    fits = {key: np.shape(a) in (n, (*n, 1)) and whole_numbers(a) is not None for key, a in found.items()}
    key = max(found, key=lambda key: (fits[key], np.shape(found[key]) in (n, (*n, 1))))
    if np.size(found[key]) == 1 != n[0]:  # as classified objects have
        cloud.notes.append(f"{key!r} is one value for all points: labels left out.")
    else:
        set_labels(cloud, key, found[key])
