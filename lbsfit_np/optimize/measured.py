"""What residuals of the steps are measured to: triangles of the posed mesh, or planes at its vertices.

Planes at the vertices of a fine mesh are near enough for steps that look far, and take two thirds of the time: normals turn with
the skin, no triangle is looked for, and what a place hangs on is one vertex.
"""

import numpy as np

from .pulling import Pulling
from .surface import Closest, Surface

__all__ = ["ToPlanes", "ToTriangles"]


class ToTriangles:
    """The posed surface.

    Parameters
    ----------
    model : Model
    most : int
        Places that pull, at most.
    parts : (m,) int array, optional
        Of the vertices, for labelled points; the model's by default.

    Attributes
    ----------
    corners, barycentric, weights : arrays
        Of the places that pull, as of ``Pulling``.
    """

    def __init__(self, model, most, parts=None):
        self._surface = model.surface if parts is None else Surface(model.rig.vertices, model.rig.faces, parts)
        self._pulling = pulling = Pulling(model, most)
        self.corners, self.barycentric, self.weights = pulling.corners, pulling.barycentric, pulling.weights

    def closest(self, X, nearest, posed, labels=None):
        """Where points (n, 3) lie on it, as Closest; their nearest vertices, and perhaps their parts, are known."""
        return self._surface.closest(X, nearest, posed.vertices, labels)

    def places(self, posed):
        """The places that pull, and the unit normals there: two (v, 3) arrays."""
        return self._pulling.of(posed.vertices)


class ToPlanes:
    """Planes at the nearest vertices of a model that need not have faces, and evenly spread vertices that pull.

    Parameters
    ----------
    model : Model
    most : int
        Vertices that pull, at most.

    Attributes
    ----------
    corners, barycentric, weights : arrays
        As of ``ToTriangles``. Shares of the surface are those of the whole mesh's vertices, as there: with those of the vertices
        that are left, dense ones pull as much as others, and fewer bodies came home.
    """

    def __init__(self, model, most):
        rows = model.spread(most)
        self._normals = model.normals
        self.corners, self.barycentric = rows[:, None], np.ones((len(rows), 1))
        areas = model.own_areas[rows]
        self.weights = areas / max(areas.sum(), np.finfo(float).tiny)

    def closest(self, X, nearest, posed, labels=None):
        """The nearest vertices as Closest, their normals as the blended rotations turn the template's."""
        return Closest(nearest[:, None], np.ones((len(X), 1)), posed.vertices[nearest], self._turned(posed, nearest))

    def places(self, posed):
        """The vertices that pull, and the unit normals there: two (v, 3) arrays."""
        rows = self.corners[:, 0]
        return posed.vertices[rows], self._turned(posed, rows)

    def _turned(self, posed, rows):
        """(k, 3) unit normals of posed vertices."""
        turned = np.einsum("iab,ib->ia", posed.turns(rows), self._normals[rows])
        return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), np.finfo(float).tiny)
