"""Correspondence through registrations: the place of a point on one registered mesh, and the same place on another."""

import numpy as np

from .errors import InputError, as_array, check_array, check_unmasked, its_array
from .neighbors import PointIndex
from .optimize.surface import closest_on_mesh, faces_around

__all__ = ["at_places", "surface_places", "transfer"]

# Points at a time, and pairs of a point and a triangle: arrays stay below 200 MB.
_CHUNK, _PAIRS = 20_000, 200_000
# Triangles of one kind that a point is compared with at first; four times as many where these may not be all that matter.
_FIRST = 4
# Points are taken to be no farther from a mesh than so many times its size, and from the origin than so far: squares of more
# leave double precision, or are of no use.
_FARTHEST, _WILD = 1e6, 1e150


def transfer(points, registration_a, registration_b, faces, *, snap_to=None):
    """Find where points of scan A are on scan B, by the registrations of both.

    A point of A → its closest surface point on A's registration (barycentric) → the same place on B's registration → with
    ``snap_to``, the nearest of these points.

    Parameters
    ----------
    points : (n, 3) array or Scan
        Points of scan A, in its frame and unit.
    registration_a, registration_b : (m, 3) arrays
        Vertices of one mesh, registered to A and to B, such as ``FitResult.vertices``; each in its scan's frame and unit.
    faces : (F, 3) int array
        Faces of that mesh, such as ``Rig.faces``.
    snap_to : (k, 3) array or Scan, optional
        Points of scan B. By default, places on B's registration are returned as they are.

    Returns
    -------
    (n, 3) array
        The places, in B's frame and unit.

    Raises
    ------
    InputError
        Points that are not finite numbers of shape (n, 3), registrations of different lengths, faces that do not index them, or
        no faces.
    """
    from .losses.checks import check_set  # with all losses come libraries that commands shall not wait for

    points = _checked_points("points", points)
    a = check_set("registration_a", registration_a)
    b = check_array("registration_b", check_set("registration_b", registration_b), a.shape)
    faces = _checked_faces(faces, len(a))
    snap_to = None if snap_to is None else _checked_points("snap_to", snap_to)
    if snap_to is not None and not len(snap_to):
        raise InputError("snap_to", "an empty array", "points of scan B, shape (k, 3)", "Leave it out to skip snapping.")
    low, high = a.min(axis=0), a.max(axis=0)
    extent, number = (high - low).max(), np.finfo(float)
    far = _FARTHEST * max(extent, number.tiny)
    # Triangles' areas, squared, are to be within double precision; a power of 2 changes no digit.
    unit = np.exp2(np.floor(np.log2(max(extent, number.eps * np.abs(a).max(), number.tiny))))
    corners, barycentric = surface_places(np.clip(points, low - far, high + far) / unit, a / unit, faces)
    found = at_places(corners, barycentric, b)
    if snap_to is None:
        return found
    return snap_to[PointIndex(np.clip(snap_to, -_WILD, _WILD)).nearest(found)]


def surface_places(points, vertices, faces):
    """Find the closest place on a triangle mesh to each point, among all of its triangles.

    Parameters
    ----------
    points : (n, 3) array
    vertices : (m, 3) array
    faces : (F, 3) int array
        F ≥ 1. Arguments are trusted.

    Returns
    -------
    corners : (n, 3) int array
        Vertices of the closest triangle.
    barycentric : (n, 3) array
        At least 0, sum 1: the place is ``at_places(corners, barycentric, vertices)``.
    """
    from scipy.spatial import cKDTree

    used = np.unique(faces)
    nearest_vertex, around = cKDTree(vertices[used]), faces_around(faces, len(vertices))
    kinds = _kinds(vertices, faces)
    corners, barycentric = np.empty((len(points), 3), dtype=int), np.empty((len(points), 3))
    for start in range(0, len(points), _CHUNK):
        rows = slice(start, start + _CHUNK)
        x = points[rows]
        first = closest_on_mesh(x, used[nearest_vertex.query(x)[1]], vertices, faces, around)
        best = _Best(first.corners, first.barycentric, np.linalg.norm(x - first.points, axis=1))
        for kind in kinds:
            _improve(best, x, vertices, faces, *kind)
        corners[rows], barycentric[rows] = best.corners, np.maximum(best.barycentric, 0.0)
    return corners, barycentric


def at_places(corners, barycentric, vertices):
    """(n, 3): positions of places of :func:`surface_places` on a mesh with the same triangles and (m, 3) ``vertices``."""
    return np.einsum("nk,nka->na", barycentric, vertices[corners])


class _Best:
    """The closest places found so far, and how far they are."""

    def __init__(self, corners, barycentric, away):
        self.corners, self.barycentric, self.away = corners, barycentric, away


def _kinds(vertices, faces):
    """Triangles by size, so that a few long ones do not widen the search among all others.

    A triangle lies within its radius of its centroid. Triples (tree of centroids, their faces, the largest radius), each of the
    radii between one power of 2 and the next.
    """
    from scipy.spatial import cKDTree

    p = vertices[faces]
    centroid = p.mean(axis=1)
    radius = np.linalg.norm(p - centroid[:, None], axis=2).max(axis=1)
    octave = np.floor(np.log2(np.maximum(radius, 1e-9 * max(radius.max(), np.finfo(float).tiny))))
    groups = [np.flatnonzero(octave == k) for k in np.unique(octave)]
    return [(cKDTree(centroid[rows]), rows, radius[rows].max()) for rows in groups]


def _improve(best, x, vertices, faces, tree, which, radius):
    """Compare with all triangles of one kind that may be closer: those whose centroids are within ``away + radius``."""
    rows, k = np.arange(len(x)), min(_FIRST, len(which))
    while len(rows):
        at_once = max(1, _PAIRS // k)
        blocks = [rows[i : i + at_once] for i in range(0, len(rows), at_once)]
        rows = np.concatenate([_compared(best, x, block, vertices, faces, tree, which, radius, k) for block in blocks])
        if k == len(which):
            return
        k = min(4 * k, len(which))


def _compared(best, x, rows, vertices, faces, tree, which, radius, k):
    """Compare some points with the k triangles of a kind whose centroids are nearest; those that further ones may matter to."""
    distance, index = (q.reshape(len(rows), k) for q in tree.query(x[rows], k=k))
    near = distance[:, 0] <= best.away[rows] + radius
    rows, distance, index = rows[near], distance[near], index[near]
    if not len(rows):
        return rows
    found = closest_on_mesh(x[rows], np.arange(len(rows)), vertices, faces, which[index])
    away = np.linalg.norm(x[rows] - found.points, axis=1)
    closer = away < best.away[rows]
    at = rows[closer]
    best.corners[at], best.barycentric[at], best.away[at] = found.corners[closer], found.barycentric[closer], away[closer]
    return rows[distance[:, -1] <= best.away[rows] + radius]


def _checked_points(argument, value):
    try:
        array = np.asarray(getattr(value, "points", value))
    except ValueError:
        array = None
    if array is None or array.ndim != 2 or array.shape[1] != 3:
        got = "rows of different lengths" if array is None else f"an array of shape {array.shape}"
        raise InputError(argument, got, "shape (n, 3), one point per row", its_array(value))
    check_unmasked(argument, getattr(value, "points", value))
    return check_array(argument, array, array.shape)


def _checked_faces(faces, m):
    check_unmasked("faces", faces)
    faces = as_array("faces", faces, "whole numbers of shape (F, 3), at least one triangle")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        got = f"{faces.dtype} values of shape {faces.shape}"
        raise InputError("faces", got, "whole numbers of shape (F, 3), at least one triangle", "Pass rig.faces.")
    if faces.min() < 0 or faces.max() >= m:
        got = f"vertices {faces.min()} to {faces.max()}"
        raise InputError("faces", got, f"rows of the registrations, 0 to {m - 1}", "Pass the faces of the rig that was fitted.")
    return faces.astype(np.intp, copy=False)
