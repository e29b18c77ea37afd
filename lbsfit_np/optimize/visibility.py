"""What a scan can show of a mesh: of one side what its camera has seen, of a cropped one what lies within the points' hull."""

from dataclasses import dataclass

import numpy as np

from .surface import vertex_normals

__all__ = ["WHOLE", "Coverage", "camera_direction", "hull_planes", "pulling_weights", "seen_vertices", "shown", "within_hull"]

# A vertex whose normal is at more than about 70 degrees to the camera's direction, or to the surface at its nearest point, is
# on a side that the scan does not show, or on the rim, where points are few and not its own.
_FACING = 0.35
# Surface that is seen faces the camera: a normal that does so by less than this cosine draws the camera towards it.
_LEAST_FACING, _STEPS = 0.3, 15
# The camera has seen something else in a vertex's place where a point is so much nearer to it, and so near beside, half sizes.
_BEFORE, _BESIDE = 0.08, 0.05
# Shares of the surface, below which ``Coverage.least`` lies.
_LEAST, _LEAST_CROPPED = 0.2, 0.05
# What lies no further outside a hull than this, half sizes, is within it: points lie beside what they are of.
_OUTSIDE = 0.01
# Distances of vertices from the planes of a hull that are made at a time.
_AT_ONCE = 2**21


@dataclass(frozen=True)
class Coverage:
    """What scans show of a body.

    Attributes
    ----------
    one_sided : bool
        Only the side that a camera sees.
    cropped : bool
        Only a part, up to where a picture or a box ends. Of what lies outside the convex hull of the points nothing is known: the
        scan may end there, or the body may.
    """

    one_sided: bool = False
    cropped: bool = False

    @property
    def whole(self):
        """Whether all of the body is shown."""
        return not (self.one_sided or self.cropped)

    @property
    def least(self):
        """A view that would show less of the surface than this share is no view of a pose."""
        return _LEAST_CROPPED if self.cropped else _LEAST


WHOLE = Coverage()


def seen_vertices(coverage, V, faces, problem, on, to_X):
    """(m,) bool: vertices of a posed mesh that a scan can show.

    Parameters
    ----------
    coverage : Coverage
    V : (m, 3) array
        Half sizes.
    faces : (F, 3) int array
    problem : Problem
        The scan, in the same frame.
    on : (n,) int array
        Each point's nearest vertex.
    to_X : (m,) int array
        Each vertex's nearest point.
    """
    seen = np.ones(len(V), dtype=bool)
    if coverage.one_sided:
        normals = vertex_normals(V, faces)
        seen &= shown(V, normals, problem.X, normals[on], to_X)
    if coverage.cropped:
        seen &= within_hull(V, problem.hull)
    return seen


def pulling_weights(coverage, weights, places, normals, problem, at_points, to_X):
    """(v,) weights of the places of a mesh that pull on a scan, with 0 for those that it cannot show; of the others shares.

    Parameters
    ----------
    coverage : Coverage
    weights : (v,) array
        Of the places, which sum to 1.
    places, normals : (v, 3) arrays
        Half sizes.
    problem : Problem
        The scan, in the same frame.
    at_points : (n, 3) array
        Normals of the mesh where the scan's points lie on it.
    to_X : (v,) int array
        Each place's nearest point.
    """
    if coverage.one_sided:
        weights = np.where(shown(places, normals, problem.X, at_points, to_X), weights, 0.0)
    if coverage.cropped:
        weights = np.where(within_hull(places, problem.hull), weights, 0.0)
    return weights if coverage.whole else weights / max(weights.sum(), np.finfo(float).tiny)


def hull_planes(X):
    """(f, 4) rows (n, d): the convex hull of points is where all n · x + d ≤ 0; no rows where they lie in a plane."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.unique(ConvexHull(X).equations, axis=0)  # a flat side has a row for each of its triangles
    except (QhullError, ValueError):  # ValueError: fewer points than a triangle has
        return np.empty((0, 4))


def within_hull(V, planes):
    """(v,) bool: which of V (v, 3) are within the hull of :func:`hull_planes`, or hardly outside; all where there are none."""
    within = np.ones(len(V), dtype=bool)
    rows = max(1, _AT_ONCE // max(len(planes), 1))
    for start in range(0, len(V) if len(planes) else 0, rows):
        piece = slice(start, start + rows)
        within[piece] = (V[piece] @ planes[:, :3].T + planes[:, 3]).max(axis=1) <= _OUTSIDE
    return within


def camera_direction(normals):
    """The unit vector (3,) to the camera, by surface that it has seen.

    Surface is seen that faces the camera, whose direction c so has n · c > 0 for all normals n. Their mean is no such direction:
    it leans to where there is more surface. This one makes Σ max(0, m − n · c)² small.

    Parameters
    ----------
    normals : (n, 3) array
        Of length 1.
    """
    camera = _unit(normals.mean(axis=0))
    for _ in range(_STEPS):
        lacking = np.maximum(_LEAST_FACING - normals @ camera, 0.0)
        camera = _unit(camera + 2.0 * (lacking @ normals) / max(np.count_nonzero(lacking), 1))
    return camera


def shown(V, normals, X, at_points, to_X):
    """(v,) bool: vertices that a one-sided scan can show.

    Parameters
    ----------
    V, normals : (v, 3) arrays
        Vertices, half sizes, and their normals.
    X : (n, 3) array
        The scan's points.
    at_points : (n, 3) array
        Normals of the mesh where the points lie on it.
    to_X : (v,) int array
        Each vertex's nearest point.
    """
    camera = camera_direction(at_points)
    facing = (normals @ camera > _FACING) & (np.einsum("va,va->v", normals, at_points[to_X]) > _FACING)
    return facing & ~_behind(V, X, camera)


def _behind(V, X, camera):
    """(v,) bool: vertices behind a point that the camera has seen beside the line to them."""
    from scipy.spatial import cKDTree

    across = np.cross(camera, np.eye(3)[np.abs(camera).argmin()])
    axes = np.stack([across, np.cross(camera, across)], axis=1)
    axes /= np.maximum(np.linalg.norm(axes, axis=0), np.finfo(float).tiny)
    _, nearest = cKDTree(X @ axes).query(V @ axes, distance_upper_bound=_BESIDE)
    return np.append(X @ camera, -np.inf)[nearest] > V @ camera + _BEFORE  # the last for those with none so near


def _unit(x):
    return x / max(np.linalg.norm(x), np.finfo(float).tiny)
