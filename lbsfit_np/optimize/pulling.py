"""Places of the mesh that pull on the scan: what has no points near it is noticed by these alone.

A place pulls on its nearest scan point x, which is never quite where it is: it lies beside it, by as much as points are apart,
and so below the plane that touches the mesh there, where that is convex. Along the place's own normal all would pull inwards,
and meshes would shrink. Along the sum of that and of the normal where x itself lies on the mesh they do not: on a surface that
bends evenly the way from place to x is at right angles to it (Rusinkiewicz, A symmetric objective function for ICP, 2019).
"""

import numpy as np
from scipy.sparse import eye_array

from ..triangles import face_areas
from .model import farthest_points
from .surface import divided, faces_at, summed_normals

__all__ = ["Pulling", "between"]


class Pulling:
    """Evenly spread vertices, or, on a mesh that has fewer, points on its faces: what happens between vertices counts, too.

    Parameters
    ----------
    model : Model
    most : int
        Places at most.

    Attributes
    ----------
    corners, barycentric : (v, 1) or (v, 3) arrays
        Vertices that a place hangs on, and how.
    weights : (v,) array
        They sum to 1. On a mesh of fewer vertices than places, shares of the surface that the places stand for. Of vertices
        that were chosen, their own shares among these alone: where vertices lie densely, as on fingers of a body, each pulls
        less than its place would, which measured fits are better for.
    """

    def __init__(self, model, most):
        vertices, faces = model.rig.vertices, model.rig.faces
        if len(vertices) < most:
            face, self.barycentric, areas = _on_faces(vertices, faces, most)
            self.corners = self._faces = faces[face]
            self._at = eye_array(len(face), format="csr")
        else:
            rows = model.spread(most)
            self.corners, self.barycentric, areas = rows[:, None], np.ones((len(rows), 1)), model.areas[rows]
            pulls = np.zeros(len(vertices), dtype=bool)
            pulls[rows] = True
            self._faces = faces[pulls[faces].any(axis=1)]
            self._at = faces_at(self._faces, rows)
        self.weights = areas / max(areas.sum(), np.finfo(float).tiny)

    def of(self, V):
        """Where they are on the posed vertices V (m, 3), and the unit normals there: two (v, 3) arrays."""
        return np.einsum("vk,vka->va", self.barycentric, V[self.corners]), summed_normals(V, self._faces, self._at)


def between(normals, others):
    """(v, 3) unit normals halfway between two; the first where the others face away, as those of another limb do."""
    some = np.einsum("va,va->v", normals, others) > 0
    both = normals + np.where(some[:, None], others, 0.0)
    return both / np.maximum(np.linalg.norm(both, axis=1, keepdims=True), np.finfo(float).tiny)


def _on_faces(vertices, faces, most):
    """(k,) faces, (k, 3) barycentric and (k,) areas of at most so many points, each the centre of a piece of a face."""
    from scipy.spatial import cKDTree

    area = face_areas(vertices, faces)
    pieces = np.sqrt(most * area / max(area.sum(), np.finfo(float).tiny))
    pieces = np.maximum(np.rint(pieces), 1).astype(int)
    face, barycentric = divided(pieces)
    areas = area[face] / pieces[face] ** 2
    if len(face) <= most:
        return face, barycentric, areas
    points = np.einsum("pk,pka->pa", barycentric, vertices[faces[face]])
    rows = np.sort(farthest_points(points, most))
    nearest = cKDTree(points[rows]).query(points)[1]
    return face[rows], barycentric[rows], np.bincount(nearest, areas, minlength=most)
