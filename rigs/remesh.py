"""Isotropic remeshing on an implicit surface: split, collapse, flip, relax, project (after Botsch and Kobbelt, 2004).

The mesh stays a manifold throughout: an operation that would break that, or turn a triangle over, is not done. It is closed, or
it is one half of a symmetric one, whose rim lies in the mirror plane x = 0 and stays there; no edge but the rim's own joins two
vertices of the rim, so that the mesh and its mirror image together are a closed manifold. Everything is visited in a fixed
order, so the result is a function of the input alone. Build time only.
"""

from math import dist, hypot

import numpy as np

from .implicit import gradient, project

__all__ = ["remesh"]


def remesh(shape, vertices, faces, edge_length, *, rounds=8):
    """Triangles of near-uniform size on the zero level of ``shape``.

    Parameters
    ----------
    shape : callable
        Signed distance, see :mod:`rigs.implicit`.
    vertices, faces : (n, 3), (F, 3)
        A closed manifold mesh of the surface, or its half with x ≥ 0.
    edge_length : callable
        (n, 3) → (n,) wanted edge lengths, metres.
    rounds : int, default 8

    Returns
    -------
    vertices, faces
        Renumbered; every vertex is on the zero level.
    """
    mesh = _Mesh(vertices, faces)
    for _ in range(rounds):
        _split(mesh, edge_length, 4 / 3)
        _collapse(mesh, edge_length, 4 / 5)
        _flip(mesh)
        _relax(mesh, shape)
    for _ in range(4):
        _flip(mesh)
        _relax(mesh, shape)
    return mesh.arrays()


class _Mesh:
    """Triangles by number and the triangles around each vertex; rows are never reused, dead ones are None.

    Points are tuples of floats: most work is on single ones, where arrays would take ten times as long.
    """

    def __init__(self, vertices, faces):
        self.points = [tuple(p) for p in np.asarray(vertices, dtype=float).tolist()]
        self.faces = []
        self.around = [set() for _ in self.points]
        for f in np.asarray(faces).tolist():
            self.add(f)
        edges, uses = np.unique(_sides_of(np.asarray(faces)), axis=0, return_counts=True)
        self.rim = set(edges[uses == 1].ravel().tolist())  # vertices in the mirror plane

    def add(self, face):
        self.faces.append(tuple(face))
        for v in face:
            self.around[v].add(len(self.faces) - 1)

    def remove(self, number):
        for v in self.faces[number]:
            self.around[v].discard(number)
        self.faces[number] = None

    def edges(self):
        """All edges, each once, (E, 2), in ascending order."""
        a, b = _sides_of(np.array([f for f in self.faces if f is not None])).T
        n = len(self.points)
        return np.stack(np.divmod(np.unique(a * n + b), n), axis=1)  # many times as fast as by rows

    def sides(self, a, b):
        """Numbers of the triangles on the edge a–b."""
        return sorted(self.around[a] & self.around[b])

    def chord(self, a, b):
        """Whether the edge a–b joins two vertices of the rim without being part of it."""
        return a in self.rim and b in self.rim and len(self.sides(a, b)) == 2

    def neighbours(self, v):
        return {w for t in self.around[v] for w in self.faces[t]} - {v}

    def middle(self, a, b):
        return tuple((p + q) / 2 for p, q in zip(self.points[a], self.points[b]))

    def normal(self, face, moved=None, to=None):
        (px, py, pz), (qx, qy, qz), (rx, ry, rz) = [to if v == moved else self.points[v] for v in face]
        ax, ay, az = qx - px, qy - py, qz - pz
        bx, by, bz = rx - px, ry - py, rz - pz
        return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx

    def arrays(self):
        used = sorted({v for f in self.faces if f is not None for v in f})
        row = {v: i for i, v in enumerate(used)}
        faces = np.array([[row[v] for v in f] for f in self.faces if f is not None])
        return np.array([self.points[v] for v in used]), faces


def _sides_of(faces):
    """The edges of all triangles, (3 F, 2), the lower vertex first."""
    return np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)


def _measured(mesh, edge_length):
    """Edges, their lengths relative to what is wanted at their midpoints, and that."""
    edges = mesh.edges()
    points = np.array(mesh.points)
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    wanted = edge_length((a + b) / 2)
    return edges, np.linalg.norm(a - b, axis=1) / wanted, wanted


def _split(mesh, edge_length, limit):
    edges, ratio, _ = _measured(mesh, edge_length)
    ratio[[mesh.chord(a, b) for a, b in edges.tolist()]] += 1000  # have to go in any case
    for e in np.argsort(-ratio, kind="stable"):
        if ratio[e] <= limit:
            return
        a, b = edges[e].tolist()
        sides = mesh.sides(a, b)
        if len(sides) != 2 and not (len(sides) == 1 and mesh.rim):
            continue
        mesh.points.append(mesh.middle(a, b))
        mesh.around.append(set())
        m = len(mesh.points) - 1
        if len(sides) == 1:
            mesh.rim.add(m)
        for t in sides:
            face = mesh.faces[t]
            mesh.remove(t)
            mesh.add([m if v == a else v for v in face])
            mesh.add([m if v == b else v for v in face])


def _collapse(mesh, edge_length, limit):
    edges, ratio, wanted = _measured(mesh, edge_length)
    moved = set()
    for e in np.argsort(ratio, kind="stable").tolist():
        if ratio[e] >= limit:
            return
        a, b = edges[e].tolist()
        if not mesh.around[a] or not mesh.around[b]:
            continue
        sides = mesh.sides(a, b)
        around = {v: mesh.neighbours(v) for v in (a, b)}
        common = around[a] & around[b]
        if len(sides) != (1 if a in mesh.rim and b in mesh.rim else 2) or len(common) != len(sides):
            continue
        middle, longest = mesh.middle(a, b), wanted[e]
        if len(sides) == 2 and (a in mesh.rim or b in mesh.rim):
            a, b = (a, b) if a in mesh.rim else (b, a)
            if (around[b] & mesh.rim) - common - {a}:
                continue
            middle = mesh.points[a]
        if a in moved or b in moved or middle == mesh.points[a]:
            longest = edge_length(np.array([middle]))[0]
        if max(dist(mesh.points[v], middle) for v in around[a] | around[b]) > 4 / 3 * longest:
            continue
        kept = [(t, v) for v in (a, b) for t in sorted(mesh.around[v]) if t not in sides]
        if any(not _same_way(mesh.normal(mesh.faces[t]), mesh.normal(mesh.faces[t], v, middle)) for t, v in kept):
            continue
        for t in sides:
            mesh.remove(t)
        for t in sorted(mesh.around[b]):
            face = mesh.faces[t]
            mesh.remove(t)
            mesh.add([a if v == b else v for v in face])
        mesh.points[a] = middle
        moved.add(a)


def _flip(mesh):
    """Flip edges where that brings valences closer to 6 and does not fold the surface."""
    for a, b in mesh.edges().tolist():
        sides = mesh.sides(a, b)
        if len(sides) != 2:
            continue
        first, second = (mesh.faces[t] for t in sides)
        if first[(first.index(a) + 1) % 3] != b:
            first, second = second, first
        c = next(v for v in first if v not in (a, b))
        d = next(v for v in second if v not in (a, b))
        if mesh.around[c] & mesh.around[d] or c == d or (c in mesh.rim and d in mesh.rim):
            continue
        # A vertex of the rim has as many triangles again on the other side of the mirror.
        both = [1 + (v in mesh.rim) for v in (a, b, c, d)]
        valence = [k * len(mesh.around[v]) for k, v in zip(both, (a, b, c, d))]
        less = [n + k * by for n, k, by in zip(valence, both, (-1, -1, 1, 1))]
        if sum((n - 6) ** 2 for n in less) >= sum((n - 6) ** 2 for n in valence) or min(less[:2]) < 3:
            continue
        old = tuple(map(sum, zip(mesh.normal(first), mesh.normal(second))))
        new = [mesh.normal((c, a, d)), mesh.normal((d, b, c))]
        if not all(_same_way(old, n, 0.7) for n in new):
            continue
        for t in sides:
            mesh.remove(t)
        mesh.add((c, a, d))
        mesh.add((d, b, c))


def _same_way(old, new, least=0.5):
    size = hypot(*old) * hypot(*new)
    return size > 0 and old[0] * new[0] + old[1] * new[1] + old[2] * new[2] > least * size


def _relax(mesh, shape):
    """Move each vertex along the surface towards the area-weighted middle of its triangles, then back onto it."""
    alive = np.array([f for f in mesh.faces if f is not None])
    points = np.array(mesh.points)
    p = points[alive]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    total, middle = np.zeros(len(points)), np.zeros((len(points), 3))
    for corner in range(3):
        np.add.at(total, alive[:, corner], area)
        np.add.at(middle, alive[:, corner], area[:, None] * p.mean(axis=1))
    used = np.unique(alive)
    rim = np.isin(used, sorted(mesh.rim))
    move = middle[used] / total[used, None] - points[used]
    move[rim, 0] = 0.0
    normal = gradient(shape, points[used])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    move -= (move * normal).sum(axis=1, keepdims=True) * normal
    moved = project(shape, points[used] + 0.8 * move)
    moved[rim, 0] = 0.0
    for v, q in zip(used.tolist(), moved.tolist()):
        mesh.points[v] = tuple(q)
