"""A small synthetic rig for tests: a bent forearm that ends in two fingers of different length, watertight, smoothly weighted."""

from dataclasses import replace

import numpy as np
from scipy import sparse

from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.regressor import regressor_from_weights

NAMES = ("root", "elbow", "long", "short")

# Each block of cells: x, y, z ranges. The arm runs along y; two fingers with a gap between them stand on its end.
_BLOCKS = (((0, 5), (0, 10), (0, 2)), ((0, 2), (10, 16), (0, 2)), ((3, 5), (10, 14), (0, 2)))
_CELL = 1.0 / 16.0  # the rig is about one unit long
_ELBOW, _KNUCKLES = 5.0, 10.0


def make_tube_data():
    """The raw content of the rig, valid as it is: tests break copies of it."""
    lattice, faces = _surface()
    x, y = lattice[:, 0], lattice[:, 1]
    beyond_elbow = _ramp(y, _ELBOW, 2.0)
    finger = _ramp(y, _KNUCKLES, 1.5)
    left = x < 2.5
    w = np.stack([1 - beyond_elbow, beyond_elbow - finger, finger * left, finger * ~left], axis=1)
    joints = np.array([[2.5, 0.5, 1.0], [2.5, _ELBOW, 1.0], [1.0, _KNUCKLES, 1.0], [4.0, _KNUCKLES, 1.0]])
    lower = np.array([[-0.6, -0.6, -0.6], [-0.2, -0.5, -0.8], [-0.3, -0.2, -0.5], [-0.3, -0.2, -0.5]])
    upper = np.array([[0.6, 0.6, 0.6], [1.4, 0.5, 0.8], [1.2, 0.2, 0.4], [1.2, 0.2, 0.5]])
    return RigData(
        name="tube",
        vertices=_bend(_smooth(lattice, faces)),
        faces=faces,
        weights=sparse.csr_array(w),
        joint_names=list(NAMES),
        parents=np.array([-1, 0, 1, 1]),
        joints=_bend(joints),
        frames=np.tile(np.eye(3), (4, 1, 1)),
        lower=lower,
        upper=upper,
        metres_per_unit=0.25,
        up="+y",
        forward="+z",
        partitions={"arm and fingers": {"arm": ("root", "elbow"), "fingers": ("long", "short")}},
    )


def make_tube_rig():
    """A Rig of four joints (root, elbow, long and short finger), 242 vertices, one unit long, 4 parts."""
    return build_rig(make_tube_data())


def with_slivers(data, every=10):
    """The data with some faces divided at an edge's middle, rounded, and slivers in the gaps: T-junctions that were filled."""
    faces = data.faces.copy()
    m, divided = len(data.vertices), np.arange(0, len(faces), every)
    a, b, c = faces[divided].T
    rounding = 1e-10 * np.random.default_rng(0).standard_normal((len(divided), 3))
    middle = m + np.arange(len(divided))
    faces[divided] = np.column_stack([a, middle, c])
    filling = [np.column_stack([middle, b, c]), np.column_stack([a, b, middle])]
    weights = sparse.csr_array(data.weights)
    return replace(
        data,
        vertices=np.vstack([data.vertices, (data.vertices[a] + data.vertices[b]) / 2 + rounding]),
        faces=np.vstack([faces, *filling]),
        weights=sparse.csr_array(sparse.vstack([weights, (weights[a] + weights[b]) / 2])),
    )


def with_joint(data, name="tip", parent=2, **changes):
    """The data with one more joint, which carries no weight."""
    m = len(data.vertices)
    return replace(
        data,
        joint_names=[*data.joint_names, name],
        parents=np.append(data.parents, parent),
        joints=np.vstack([data.joints, data.joints[parent] + [0.0, 0.1, 0.0]]),
        frames=np.concatenate([data.frames, np.eye(3)[None]]),
        weights=sparse.csr_array(sparse.hstack([data.weights, sparse.csr_array((m, 1))])),
        lower=np.vstack([data.lower, np.full((1, 3), -1.0)]),
        upper=np.vstack([data.upper, np.full((1, 3), 1.0)]),
        **changes,
    )


def with_loose_vertices(data, places):
    """The data with more vertices, before the others, that belong to no face and move with the last joint."""
    n, J = len(places), len(data.joints)
    last = sparse.csr_array((np.ones(n), (np.arange(n), np.full(n, J - 1))), shape=(n, J))
    regressor = data.regressor
    if regressor is None:
        regressor = regressor_from_weights(data.vertices, sparse.csr_array(data.weights), data.parents, data.joints)
    return replace(
        data,
        vertices=np.vstack([places, data.vertices]),
        faces=data.faces + n,
        weights=sparse.csr_array(sparse.vstack([last, data.weights])),
        regressor=sparse.csr_array(sparse.hstack([sparse.csr_array((J, n)), regressor])),
    )


def _surface():
    """The outer triangles of the union of the blocks: lattice points (m, 3) and faces (F, 3), turned outwards."""
    cells = {(i, j, k) for xs, ys, zs in _BLOCKS for i in range(*xs) for j in range(*ys) for k in range(*zs)}
    rows, points, faces = {}, [], []
    for cell in sorted(cells):
        for axis in range(3):
            for side in (0, 1):
                beside = list(cell)
                beside[axis] += 2 * side - 1
                if tuple(beside) in cells:
                    continue
                u, v = (axis + 1) % 3, (axis + 2) % 3
                square = []
                for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = list(cell)
                    corner[axis] += side
                    corner[u] += du
                    corner[v] += dv
                    corner = tuple(corner)
                    if corner not in rows:
                        rows[corner] = len(points)
                        points.append(corner)
                    square.append(rows[corner])
                a, b, c, d = square if side else square[::-1]
                faces += [(a, b, c), (a, c, d)]
    return np.array(points, dtype=float), np.array(faces)


def _smooth(points, faces, steps=3):
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    m = len(points)
    graph = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(m, m))
    graph = sparse.csr_array(graph + graph.T)
    for _ in range(steps):
        points = 0.6 * points + 0.4 * (graph @ points) / graph.sum(axis=1)[:, None]
    return points


def _bend(points):
    """From lattice cells to rig units, the far end bent forward so that no turn about the arm's axis maps it onto itself."""
    p = np.array(points) * _CELL
    p[:, 2] += 0.25 * np.maximum(p[:, 1] - 0.3, 0.0) ** 2
    return p - np.array([2.5 * _CELL, 0.5, _CELL])


def _ramp(t, middle, half_width):
    s = np.clip((t - middle) / (2 * half_width) + 0.5, 0.0, 1.0)
    return s * s * (3 - 2 * s)


def seamed(data, copies, weight_change=0.0):
    """The data with some vertices split: later faces use the copies."""
    m = len(data.vertices)
    faces = data.faces.copy()
    for k, v in enumerate(copies):
        f, c = np.argwhere(faces == v)[-1]
        faces[f, c] = m + k
    w = data.weights.toarray()
    w_copies = w[copies]
    w_copies[:, :2] += [weight_change, -weight_change]
    return replace(
        data, vertices=np.vstack([data.vertices, data.vertices[copies]]), faces=faces, weights=np.vstack([w, w_copies])
    )
