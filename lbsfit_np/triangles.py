"""Triangles of a mesh: how large they are and which way they look."""

import numpy as np

__all__ = ["area_vectors", "areas_around", "binary_extent", "face_areas", "inside_out", "no_slivers", "pieces"]

# Share of the longest side squared below which an area is a sliver's.
_SLIVER = 1e-4


def binary_extent(vertices):
    """A power of 2 near the extent of vertices: divided by it, none of their products is beyond double precision, and no digit
    changes.
    """
    extent = float(np.ptp(vertices, axis=0).max(initial=0.0)) if len(vertices) else 0.0
    return 2.0 ** np.round(np.log2(extent)) if extent > 0 else 1.0


def area_vectors(vertices, faces):
    """(F, 3): each face's normal, as long as its area; outwards where corners go round counter-clockwise seen from outside."""
    a, b, c = (vertices[corner] for corner in faces.T)
    return 0.5 * np.cross(b - a, c - a)


def face_areas(vertices, faces):
    """(F,): the area of each face."""
    unit = binary_extent(vertices)
    return np.linalg.norm(area_vectors(vertices / unit, faces), axis=1) * unit**2


def no_slivers(vertices, faces):
    """(F,) bool: faces whose area is more than a ten thousandth of their longest side squared.

    Cotangents of others are rounding's as much as the mesh's, and so large that they would rule whatever they are part of.
    """
    corners = vertices[faces] / binary_extent(vertices)
    longest = np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=2).max(axis=1, initial=0.0)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 2 * _SLIVER * longest


def areas_around(vertices, faces):
    """(m,): the area of all faces that a vertex is a corner of, three times what it stands for; 0 without a face."""
    area = face_areas(vertices, faces)
    return sum(np.bincount(corner, area, minlength=len(vertices)) for corner in faces.T)


def inside_out(vertices, faces):
    """Whether faces look inwards, by the sign of the volume; of open meshes by that seen from their middle."""
    centred = vertices - vertices.mean(axis=0)
    return bool(np.vdot(centred[faces[:, 0]], area_vectors(centred, faces)) < 0)


def pieces(m, faces):
    """(m,) int: which connected piece of the mesh each vertex is of; one without a face is a piece of its own."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    return connected_components(coo_array((np.ones(faces.size), ends), shape=(m, m)), directed=False)[1]
