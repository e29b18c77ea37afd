"""CloudData: what a file says about a scan, before anything is checked; and how columns are told apart by their names."""

import re
from dataclasses import dataclass, field

import numpy as np

from ..errors import FileError, listed

__all__ = [
    *("CloudData", "cloud_from_columns", "column_role", "columns_by_role", "fans"),
    *("in_plain_numbers", "set_labels", "strips", "whole_numbers"),
]


# NaN and infinity as some C libraries write them: nan(ind), 1.#QNAN, 1.#INF.
_ODD = re.compile(r"nan\([^)]*\)|1\.#[a-z0-9]+", re.IGNORECASE)


def in_plain_numbers(line):
    """A line of text with "nan" for what is no finite number in the spelling of some C libraries, which Python does not read."""
    return _ODD.sub("nan", line) if "(" in line or "1.#" in line else line


@dataclass
class CloudData:
    """Raw content of a scan file, in the file's own order and unit: the scan readers' common output."""

    points: np.ndarray  # (n, 3), or whatever shape the file has: load_scan checks it
    faces: np.ndarray | None = None  # (F, 3) int, rows of points; None or empty for a point cloud
    normals: np.ndarray | None = None  # (n, 3)
    labels: np.ndarray | None = None  # (n,)
    notes: list[str] = field(default_factory=list)
    mesh: "CloudData | None" = None  # what to sample instead, where the file has a mesh beside the points


_AXIS = {"x": 0, "y": 1, "z": 2, "0": 0, "1": 1, "2": 2}
_POSITION = re.compile(r"((?:(?:p|pos|position|point|points|coord|vertex)[ _.:-]?)?)([xyz012])")
_NORMAL = re.compile(r"((?:n|normal|normals)[ _.:-]?)([xyz012])")
_LABEL = re.compile(r"(?:vertex|point|part|scalar)?[ _]?(?:labels?|parts?|part[ _]id|segment(?:ation)?|class(?:ification)?)")


def column_role(name):
    """What a column or property holds, by its name: 0–2 for x y z, 3–5 for the normal, 6 for the label, else None.

    Case, quotes and units in brackets do not matter: ``X [m]``, ``"x"``, ``Points:0``, ``normal_x``, ``scalar_Label``.
    """
    return _role_and_style(name)[0]


def _role_and_style(name):
    """The role of a column, and how its axis is called: x, y and z in one style belong together."""
    name = re.sub(r"[\[(].*?[\])]", "", name).strip("\"' \t#/").lower()
    for kind, first in ((_POSITION, 0), (_NORMAL, 3)):
        if found := kind.fullmatch(name):
            return first + _AXIS[found[2]], (found[1], found[2].isdigit())
    return (6 if _LABEL.fullmatch(name) else None), None


def columns_by_role(names):
    """Role, as :func:`column_role` gives it, → index of its column.

    Of several columns with a role the first; but three axes in one style go before others: of px, py, x, y, z (pixels and a
    point) the last three, and plain x, y, z before all.
    """
    found, styles = {}, {}
    for k, name in enumerate(names):
        role, style = _role_and_style(name)
        if role is not None:
            found.setdefault(role, k)
            styles.setdefault((role // 3, style), {}).setdefault(role, k)
    for kind in (0, 1):
        whole = [(style, axes) for (of, style), axes in styles.items() if of == kind and len(axes) == 3]
        if whole:
            found |= min(whole, key=lambda of: of[0] != ("", False))[1]
    return found


def cloud_from_columns(path, what, names, column):
    """Put a cloud together from named columns.

    Parameters
    ----------
    path : Path
    what : str
        What the format calls columns, such as "fields".
    names : sequence of str
        "" for a column that cannot be used.
    column : callable
        ``column(k)`` gives the (n,) values of the k-th name; called for those of :func:`columns_by_role` only.

    Returns
    -------
    CloudData
        Labels that are not whole numbers are left out, and a note says so.

    Raises
    ------
    FileError
        x, y or z is missing; columns that are not numbers, or of different lengths.
    """
    where = columns_by_role(names)
    if not {0, 1, 2} <= where.keys():
        raise FileError(str(path), f"the {what} {listed([n for n in names if n], 40) or '(none)'}", f"the {what} x, y and z")
    columns = {role: _numbers(path, what, names[k], column(k)) for role, k in where.items() if role < 6}
    if len({len(values) for values in columns.values()}) > 1:
        lengths = ", ".join(f"{names[where[role]]} {len(values)}" for role, values in sorted(columns.items()))
        raise FileError(str(path), f"{what} of different lengths ({lengths})", "one value per point in each")
    cloud = CloudData(_stacked([columns[r] for r in (0, 1, 2)]))
    if {3, 4, 5} <= where.keys():
        cloud.normals = _stacked([columns[r] for r in (3, 4, 5)])
    if 6 in where:
        set_labels(cloud, names[where[6]], column(where[6]))
    return cloud


def set_labels(cloud, name, values):
    """Give a cloud its labels, or a note that says why not."""
    cloud.labels = whole_numbers(values)
    if cloud.labels is None:
        what = "whole numbers of at most 64 bits (53 in text and floats)"
        cloud.notes.append(f"The values of {name!r} are not {what}: labels left out.")


def whole_numbers(values):
    """The values as integers, or None where that would change them."""
    values = np.asarray(values)
    if values.dtype.kind == "f":
        # Not: a comparison with NaN is false. From 2**53 on, a float may be another number than the one that was written.
        if not ((values == np.rint(values)) & (np.abs(values) < 2.0**53)).all():
            return None
        return values.astype(np.int64)
    if values.dtype.kind == "u" and values.size and values.max() > np.iinfo(np.int64).max:
        return None
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


def strips(corners_of_strips, corners):
    """Strips as triangles, every second one turned round so that all face one way; those with a corner twice only join others.

    Parameters
    ----------
    corners_of_strips : (P,) int array
        How many corners each strip has.
    corners : (sum,) int array
        Their corners, one strip after the other; −1 ends a strip within a row, and the next begins.

    Returns
    -------
    (F, 3) int array
    """
    at, ends = np.arange(len(corners)), corners == -1
    first = np.append(True, ends[:-1])[: len(at)]
    first[(np.cumsum(corners_of_strips) - corners_of_strips)[corners_of_strips > 0]] = True
    odd = (at - np.maximum.accumulate(np.where(first, at, 0))) % 2
    whole = ~(ends[:-2] | ends[1:-1] | ends[2:] | first[1:-1] | first[2:])
    a, odd = at[:-2][whole], odd[:-2][whole]
    faces = np.stack([corners[a], corners[a + 1 + odd], corners[a + 2 - odd]], axis=1)
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _numbers(path, what, name, values):
    values = np.asarray(values)
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        got = f"{what} with {values.dtype} values of shape {values.shape} in {name!r}"
        raise FileError(str(path), got, "one number per point in each")
    return values


def _stacked(columns):
    """(n, 3) float64."""
    out = np.empty((len(columns[0]), 3))
    for k, values in enumerate(columns):
        out[:, k] = values
    return out
