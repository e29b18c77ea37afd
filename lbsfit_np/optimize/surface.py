"""Closest points of a triangle mesh: the residuals of the Gauss–Newton steps are measured to the surface, not to its vertices."""

from dataclasses import dataclass

import numpy as np

__all__ = ["Closest", "closest_on_mesh", "faces_around", "vertex_normals"]


@dataclass(frozen=True)
class Closest:
    """For each of n queries the closest surface point found.

    Attributes
    ----------
    corners : (n, 3) int array
        Vertices of its triangle.
    barycentric : (n, 3) array
    points : (n, 3) array
    normals : (n, 3) array
        Unit normals of the triangles; 0 for triangles without area.
    """

    corners: np.ndarray
    barycentric: np.ndarray
    points: np.ndarray
    normals: np.ndarray


def faces_around(faces, m):
    """(m, d) int: the faces at each vertex, the first one repeated where there are fewer than d; −1 where there are none."""
    vertex = faces.ravel()
    face = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=m)
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    d = max(int(count.max(initial=0)), 1)
    slot = np.minimum(np.arange(d), np.maximum(count[:, None] - 1, 0))  # the last one repeated
    table = np.full((m, d), -1)
    some = count > 0
    table[some] = face[order][start[some, None] + slot[some]]
    return table


def closest_on_mesh(queries, nearest, vertices, faces, around):
    """The closest point of the triangles at each query's nearest vertex.

    Exact wherever the closest triangle touches the nearest vertex, which near a mesh of even triangles is all but always so.

    Parameters
    ----------
    queries : (n, 3) array
    nearest : (n,) int array
        A vertex with at least one face.
    vertices : (m, 3) array
    faces : (F, 3) int array
    around : (m, d) int array
        :func:`faces_around`.

    Returns
    -------
    Closest
    """
    corners = faces[around[nearest]]  # (n, d, 3)
    p = vertices[corners]
    a, e1, e2 = p[:, :, 0], p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0]
    d = queries[:, None] - a
    d11, d12, d22 = _dot(e1, e1), _dot(e1, e2), _dot(e2, e2)
    q1, q2 = _dot(d, e1), _dot(d, e2)
    tiny = np.finfo(float).tiny
    determinant = d11 * d22 - d12 * d12
    flat = determinant <= 1e-14 * np.maximum(d11, d22) ** 2
    determinant = np.where(flat, 1.0, determinant)
    u, v = (d22 * q1 - d12 * q2) / determinant, (d11 * q2 - d12 * q1) / determinant
    inside = ~flat & (u >= 0) & (v >= 0) & (u + v <= 1)
    # Outside, the closest point lies on an edge: along e1, along e2, or between their ends.
    t1, t2 = np.clip(q1 / np.maximum(d11, tiny), 0, 1), np.clip(q2 / np.maximum(d22, tiny), 0, 1)
    d33 = d11 - 2 * d12 + d22
    t3 = np.clip((q2 - q1 + d11 - d12) / np.maximum(d33, tiny), 0, 1)
    zero = np.zeros_like(u)
    U, V = np.stack([u, t1, zero, 1 - t3]), np.stack([v, zero, t2, t3])
    # |d − u e1 − v e2|² without its constant |d|².
    away = U * U * d11 + V * V * d22 + 2 * (U * V * d12 - U * q1 - V * q2) + _dot(d, d)
    away[0, ~inside] = np.inf
    n, k = len(queries), around.shape[1]
    best = away.transpose(1, 0, 2).reshape(n, 4 * k).argmin(axis=1)
    kind, which = best // k, best % k
    row = np.arange(n)
    bu, bv = U[kind, row, which], V[kind, row, which]
    corners, p = corners[row, which], p[row, which]
    barycentric = np.column_stack([1 - bu - bv, bu, bv])
    normals = _unit(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    return Closest(corners, barycentric, np.einsum("nk,nka->na", barycentric, p), normals)


def vertex_normals(vertices, faces):
    """(m, 3) unit normals, faces weighted by area; 0 at vertices without faces."""
    p = vertices[faces]
    face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    out = np.zeros_like(vertices)
    for axis in range(3):
        for k in range(3):
            out[:, axis] += np.bincount(faces[:, k], face[:, axis], minlength=len(vertices))
    return _unit(out)


def _dot(a, b):
    return np.einsum("...a,...a->...", a, b)


def _unit(v):
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), np.finfo(float).tiny)
