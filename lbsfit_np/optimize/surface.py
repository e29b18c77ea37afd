"""Closest points of a triangle mesh: the residuals of the Gauss–Newton steps are measured to the surface, not to its vertices."""

from dataclasses import dataclass

import numpy as np

from ..neighbors import PointIndex

__all__ = [
    "Closest",
    "Surface",
    "clear_vertices",
    "closest_on_mesh",
    "divided",
    "faces_around",
    "faces_at",
    "summed_normals",
    "vertex_normals",
]

# Where some triangle has a longer edge than this, half sizes, triangles are looked for by points on them, too, so far apart at
# most; on each edge there are at most so many. On other meshes the triangles at the nearest vertex have the closest point but for
# one or two in a hundred, whose own is up to 0.04 half sizes nearer, and to look at others would take twice the time.
_LONG, _APART, _MOST = 0.22, 0.08, 20
# Triangles whose squared distances differ by no more than this share of these and of their edges are as close.
_TIE = 1e-10
# What is no higher above a triangle is on its plane. A shorter sum of normals tells none.
_ON, _CLEAR = 1e-9, 0.1
# Triangles at a vertex face one way where their normals together are longer than this share of all their lengths.
_FACING = 0.3


@dataclass(frozen=True)
class Closest:
    """For each of n queries the closest surface point found.

    Attributes
    ----------
    corners : (n, 3) int array
        Vertices of its triangle; (n, 1) the vertex where planes at vertices stand for triangles.
    barycentric : (n, 3) array
        Or (n, 1).
    points : (n, 3) array
    normals : (n, 3) array
        Unit normals of the triangles, on edges and vertices of all of them together; 0 for triangles without area.
    """

    corners: np.ndarray
    barycentric: np.ndarray
    points: np.ndarray
    normals: np.ndarray


class Surface:
    """The triangles of a mesh, however it is posed, and where to look for the closest one.

    That mostly touches the nearest vertex. Where triangles are long, as on meshes of few vertices, it may not: there points on
    them are looked for as well, and the triangles beside the one that the nearest is on.

    Parameters
    ----------
    vertices : (m, 3) array
        At rest, in half sizes of the rig.
    faces : (F, 3) int array
    labels : (m,) int array, optional
        Parts of the vertices.
    """

    def __init__(self, vertices, faces, labels=None):
        self.faces, self._around = faces, faces_around(faces, len(vertices))
        self._face, self._barycentric = _on_long_faces(vertices, faces)
        if len(self._face):
            self._beside = _faces_beside(faces)
            corner = self._barycentric.argmax(axis=1)
            self._labels = None if labels is None else labels[faces[self._face, corner]]

    def closest(self, X, nearest, V, labels=None):
        """The closest surface point of each query.

        Parameters
        ----------
        X : (n, 3) array
        nearest : (n,) int array
            The nearest vertex; with labels, the nearest of the query's part. It has to have a face.
        V : (m, 3) array
            The vertices as posed.
        labels : (n,) int array, optional
            Parts of the queries: triangles elsewhere are not looked for.

        Returns
        -------
        Closest
        """
        if not len(self._face) or not len(X):
            return closest_on_mesh(X, nearest, V, self.faces, self._around)
        points = np.einsum("pk,pka->pa", self._barycentric, V[self.faces[self._face]])
        index = PointIndex(points, moving=True) if labels is None else PointIndex(points, self._labels, moving=True)
        found = index.nearest(X) if labels is None else index.nearest(X, labels)
        table = self._around[nearest]
        beside = np.where(found[:, None] < 0, table[:, :1], self._beside[self._face[found]])  # −1: none of that part
        return closest_on_mesh(X, np.arange(len(X)), V, self.faces, np.hstack([beside, table]))


def _on_long_faces(vertices, faces):
    """(p,) faces and (p, 3) barycentric: the centres of the equal triangles that each long one is divided into."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    if longest.max(initial=0.0) <= _LONG:
        return np.empty(0, dtype=int), np.empty((0, 3))
    parts = np.minimum(np.ceil(longest / _APART), _MOST).astype(int)
    return divided(np.where(parts > 1, parts, 0))


def divided(parts):
    """(p,) faces and (p, 3) barycentric: centres of the n² equal triangles of each face with its edges divided by its n.

    Parameters
    ----------
    parts : (F,) int array
        n of each face; one with 0 is left out.
    """
    face, barycentric = [np.empty(0, dtype=int)], [np.empty((0, 3))]
    for n in np.unique(parts[parts > 0]):
        rows, own = np.flatnonzero(parts == n), _centres(n)
        face.append(np.repeat(rows, len(own)))
        barycentric.append(np.tile(own, (len(rows), 1)))
    return np.concatenate(face), np.concatenate(barycentric)


def _centres(n):
    """(n², 3) barycentric centres of the equal triangles that one with its edges divided by n consists of."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    standing = np.column_stack([i, j, n - 1 - i - j]) + 1 / 3
    hanging = np.column_stack([i, j, n - 2 - i - j]) + 2 / 3
    return np.concatenate([standing[i + j < n], hanging[i + j < n - 1]]) / n


def _faces_beside(faces):
    """(F, 4) int: each face, and those that share an edge with it, the face itself where there is none."""
    beside = np.tile(np.arange(len(faces))[:, None], (1, 4))
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    order = np.lexsort(edges.T)
    one, two = order[:-1], order[1:]
    same = (edges[one] == edges[two]).all(axis=1)
    one, two = one[same], two[same]
    beside[one // 3, 1 + one % 3], beside[two // 3, 1 + two % 3] = two // 3, one // 3
    return beside


def faces_around(faces, m):
    """(m, d) int: the faces at each vertex, the last one repeated where there are fewer than d; −1 where there are none."""
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
    table = around[nearest]  # (n, d)
    other = np.ones(table.shape, dtype=bool)  # each face once
    other[:, 1:] = table[:, 1:] != table[:, :-1]
    point = np.nonzero(other)[0]
    # From here one row of pairs of a query and a face for each coordinate: sums over short last axes are slow.
    corners, vertices = np.take(faces.T, table[other], axis=1), np.ascontiguousarray(vertices.T)
    a, b, c = (np.take(vertices, k, axis=1) for k in corners)
    e1, e2, d = b - a, c - a, np.take(queries.T, point, axis=1) - a
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
    s3 = 1 - t3
    # |d − u e1 − v e2|² without its constant |d|²: where (u, v) are inside, and on each edge.
    away = np.empty((4, len(point)))
    away[0] = np.where(inside, -(u * q1 + v * q2), np.inf)  # the foot of the perpendicular
    away[1], away[2] = t1 * (t1 * d11 - 2 * q1), t2 * (t2 * d22 - 2 * q2)
    away[3] = s3 * (s3 * d11 - 2 * q1) + t3 * (t3 * d22 - 2 * q2) + 2 * s3 * t3 * d12
    least, place = np.full(table.shape, np.inf), np.zeros(table.shape, dtype=int)
    least[other], place[other] = away.min(axis=0) + _dot(d, d), np.arange(len(point))
    slot = least.argmin(axis=1)
    best, least_of_all = place[np.arange(len(queries)), slot], least[np.arange(len(queries)), slot]
    kind, zero = away[:, best].argmin(axis=0), np.zeros(len(best))
    bu = np.choose(kind, [u[best], t1[best], zero, s3[best]])
    bv = np.choose(kind, [v[best], zero, t2[best], t3[best]])
    foot = a[:, best] + bu * e1[:, best] + bv * e2[:, best]
    normal = _unit(_cross(e1[:, best], e2[:, best]))
    # On edges and vertices several triangles are as close: which one is best hangs on rounding, and on their order.
    as_close = least <= (least_of_all + _TIE * (least_of_all + d11[best]))[:, None]
    several = np.flatnonzero(as_close.sum(axis=1) > 1)
    row, column = np.nonzero(as_close[several])
    once = np.unique(row * len(faces) + table[several[row], column], return_index=True)[1]  # by both ways to look for triangles
    row, pair = row[once], place[several[row[once]], column[once]]
    of_faces = _unit(_cross(e1[:, pair], e2[:, pair]))
    # Turned to the side of the query, as faces wound against each other would make nothing of each other, or a way along them.
    height = _dot(np.take(queries.T - foot, several[row], axis=1), of_faces)
    plain, turned = (
        np.stack([np.bincount(row, side * along, minlength=len(several)) for along in of_faces])
        for side in (1.0, np.where(height < -_ON, -1.0, 1.0))
    )
    back = np.where(_dot(turned, plain) < -_ON, -1.0, 1.0)  # to the side that most of them face
    clear = _dot(turned, turned) > _CLEAR**2
    normal[:, several[clear]] = (back * _unit(turned))[:, clear]
    barycentric = np.column_stack([1 - bu - bv, bu, bv])
    return Closest(corners[:, best].T, barycentric, foot.T, normal.T)


def vertex_normals(vertices, faces):
    """(m, 3) unit normals, faces weighted by area; 0 at vertices without faces."""
    return summed_normals(vertices, faces, faces_at(faces, np.arange(len(vertices))))


def clear_vertices(vertices, faces):
    """(m,) bool: vertices whose triangles face one way, by and large: their normals sum up to more than a share of the areas."""
    a, b, c = (vertices[corner] for corner in faces.T)
    crosses, at = np.cross(b - a, c - a), faces_at(faces, np.arange(len(vertices)))
    return np.linalg.norm(at @ crosses, axis=1) > _FACING * (at @ np.linalg.norm(crosses, axis=1))


def faces_at(faces, rows):
    """(r, F) sparse: how often each face has each of some vertices as a corner, for :func:`summed_normals`."""
    from scipy.sparse import csr_array

    row = np.full(max(faces.max(initial=-1), rows.max(initial=-1)) + 1, -1)
    row[rows] = np.arange(len(rows))
    at, face = row[faces.ravel()], np.repeat(np.arange(len(faces)), 3)
    some = at >= 0
    return csr_array((np.ones(some.sum()), (at[some], face[some])), shape=(len(rows), len(faces)))


def summed_normals(vertices, faces, at):
    """(r, 3) unit normals of the vertices that ``at`` is of: :func:`faces_at`; the faces may be those at these vertices alone."""
    a, b, c = (np.take(vertices.T, corner, axis=1) for corner in faces.T)
    normals = (at @ _cross(b - a, c - a).T).T
    return _unit(normals).T


def _unit(a):
    """(3, k) vectors as long as 1; 0 stays."""
    return a / np.maximum(np.sqrt(_dot(a, a)), np.finfo(float).tiny)


def _dot(a, b):
    """(k,) of (3, k) arrays."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    """(3, k) of (3, k) arrays."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
