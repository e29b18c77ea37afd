"""What a scan of one side can show of a mesh: where its camera was, and what is behind what it has seen."""

import numpy as np

__all__ = ["camera_direction", "shown"]

# A vertex whose normal is at more than about 70 degrees to the camera's direction, or to the surface at its nearest point, is
# on a side that the scan does not show, or on the rim, where points are few and not its own.
_FACING = 0.35
# Surface that is seen faces the camera: a normal that does so by less than this cosine draws the camera towards it.
_LEAST_FACING, _STEPS = 0.3, 15
# The camera has seen something else in a vertex's place where a point is so much nearer to it, and so near beside, half sizes.
_BEFORE, _BESIDE = 0.08, 0.05


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
