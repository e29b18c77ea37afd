"""Triangles of a mesh: how large they are and which way they look."""

import numpy as np

__all__ = ["area_vectors", "areas_around", "face_areas", "inside_out"]


def area_vectors(vertices, faces):
    """(F, 3): each face's normal, as long as its area; outwards where corners go round counter-clockwise seen from outside."""
    a, b, c = (vertices[corner] for corner in faces.T)
    return 0.5 * np.cross(b - a, c - a)


def face_areas(vertices, faces):
    """(F,): the area of each face."""
    return np.linalg.norm(area_vectors(vertices, faces), axis=1)


def areas_around(vertices, faces):
    """(m,): the area of all faces that a vertex is a corner of, three times what it stands for; 0 without a face."""
    area = face_areas(vertices, faces)
    return sum(np.bincount(corner, area, minlength=len(vertices)) for corner in faces.T)


def inside_out(vertices, faces):
    """Whether faces look inwards, by the sign of the volume; of open meshes by that seen from their middle."""
    centred = vertices - vertices.mean(axis=0)
    return bool(np.vdot(centred[faces[:, 0]], area_vectors(centred, faces)) < 0)
