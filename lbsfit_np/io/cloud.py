"""CloudData: what a file says about a scan, before anything is checked; and how columns are told apart by their names."""

import re
from dataclasses import dataclass, field

import numpy as np

__all__ = ["CloudData", "cloud_from_columns", "column_role", "fans", "whole_numbers"]


@dataclass
class CloudData:
    """Raw content of a scan file, in the file's own order and unit: the scan readers' common output."""

    points: np.ndarray  # (n, 3), or whatever shape the file has: load_scan checks it
    faces: np.ndarray | None = None  # (F, 3) int, rows of points; None or empty for a point cloud
    normals: np.ndarray | None = None  # (n, 3)
    labels: np.ndarray | None = None  # (n,)
    notes: list[str] = field(default_factory=list)


_AXIS = {"x": 0, "y": 1, "z": 2, "0": 0, "1": 1, "2": 2}
_POSITION = re.compile(r"(?:(?:p|pos|position|point|points|coord|vertex)[ _.:-]?)?([xyz012])")
_NORMAL = re.compile(r"(?:n|normal|normals)[ _.:-]?([xyz012])")
_LABEL = re.compile(r"(?:vertex|point|part|scalar)?[ _]?(?:labels?|parts?|part[ _]id|segment(?:ation)?|class(?:ification)?)")


def column_role(name):
    """What a column or property holds, by its name: 0–2 for x y z, 3–5 for the normal, 6 for the label, else None.

    Case, quotes and units in brackets do not matter: ``X [m]``, ``"x"``, ``Points:0``, ``normal_x``, ``scalar_Label``.
    """
    name = re.sub(r"[\[(].*?[\])]", "", name).strip("\"' \t#/").lower()
    if found := _POSITION.fullmatch(name):
        return _AXIS[found[1]]
    if found := _NORMAL.fullmatch(name):
        return 3 + _AXIS[found[1]]
    return 6 if _LABEL.fullmatch(name) else None


def cloud_from_columns(names, column):
    """Put a cloud together from named columns.

    Parameters
    ----------
    names : sequence of str
    column : callable
        ``column(k)`` gives the (n,) values of the k-th name.

    Returns
    -------
    CloudData or None
        None where x, y or z is missing. Labels that are not whole numbers are left out, and a note says so.
    """
    where = {}
    for k, name in enumerate(names):
        role = column_role(name)
        if role is not None:
            where.setdefault(role, k)
    if not {0, 1, 2} <= where.keys():
        return None
    cloud = CloudData(_stacked(column, [where[r] for r in (0, 1, 2)]))
    if {3, 4, 5} <= where.keys():
        cloud.normals = _stacked(column, [where[r] for r in (3, 4, 5)])
    if 6 in where:
        cloud.labels = whole_numbers(column(where[6]))
        if cloud.labels is None:
            cloud.notes.append(f"The values of {names[where[6]]!r} are not whole numbers: labels left out.")
    return cloud


def whole_numbers(values):
    """The values as integers, or None where that would change them."""
    values = np.asarray(values)
    if values.dtype.kind == "f" and np.isfinite(values).all() and (values == np.rint(values)).all():
        values = values.astype(np.int64)
    return values if values.dtype.kind in "iu" else None


def fans(corners_of_faces, corners):
    """Polygons as triangles: each a fan about its first corner; fewer than three corners are no face.

    Parameters
    ----------
    corners_of_faces : (P,) int array
        How many corners each polygon has.
    corners : (sum,) int array
        Their corners, one polygon after the other.

    Returns
    -------
    (F, 3) int array
    """
    start = np.cumsum(corners_of_faces) - corners_of_faces
    triangles = np.maximum(corners_of_faces - 2, 0)
    first = np.repeat(start, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1)


def _stacked(column, rows):
    first = np.asarray(column(rows[0]))
    out = np.empty((len(first), 3))
    for k, row in enumerate(rows):
        out[:, k] = column(row)
    return out
