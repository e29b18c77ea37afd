"""Where the template in a given pose goes that a scan shows: all of it, one side, or a part."""

import numpy as np

from ..neighbors import PointIndex
from ..optimize.surface import vertex_normals
from ..optimize.visibility import WHOLE
from ..scan import some_rows

__all__ = ["placed"]

# Sides that a scan may show: from so many directions, those of a cube's faces, edges and corners. A cropped one ends along one
# of them, these shares of the surface beyond; of one side, along one that is across to its own, as pictures do. So many points
# tell the right one, each at most this far from the surface, half sizes.
_SIDES = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=float)
_SIDES /= np.linalg.norm(_SIDES, axis=1, keepdims=True)
_CROPS, _ACROSS = (0.2, 0.4, 0.6), 0.5
_POINTS, _REACH = 250, 0.2
# Where there are more places than this to compare, such as sides and what crops leave of them, fewer points choose so many first.
_MANY, _FEW = 100, 40


def placed(model, problem, theta, scale=1.0, *, coverage=WHOLE):
    """The State of a pose that is put where a scan is, its centroid on that of the points.

    A view of one side has the centroid of that side, which may be a quarter of a hand's size from the whole's, and a cropped scan
    that of what is left. Which side or part it is the points tell: the one under which they lie closest to the surface.

    Parameters
    ----------
    model : Model
        With faces.
    problem : Problem
    theta : (J, 3) array
        Radians, in the problem's frame.
    scale : float, default 1
    coverage : Coverage, optional
        What the scan shows, by default all.

    Returns
    -------
    State
    """
    state, X, a = model.rest().replace(theta=np.array(theta, dtype=float), scale=scale), problem.X, problem.x_weights
    V = model.deformed(state).vertices
    centre, seen = X.mean(axis=0) if a is None else a @ X, model.areas @ V
    if not coverage.whole:
        sides = _centroids(V, model.areas, vertex_normals(V, model.rig.faces) if coverage.one_sided else None, coverage.cropped)
        index = PointIndex(V)

        def best(sides, points, n):
            """The n under which so many points lie closest to the surface, the best first."""
            rows = some_rows(X, points)
            on_side = (X[rows] - centre + sides[:, None]).reshape(-1, 3)
            away = np.linalg.norm(on_side - V[index.nearest(on_side)], axis=1).reshape(len(sides), -1)
            weights = None if a is None else a[rows] + np.finfo(float).tiny
            cost = np.average(np.minimum(away, _REACH) ** 2, axis=1, weights=weights)
            return sides[np.argsort(cost, kind="stable")[:n]]

        seen = best(sides if len(sides) <= _MANY else best(sides, _FEW, _MANY), _POINTS, 1)[0]
    return state.replace(translation=centre - seen)


def _centroids(V, areas, normals, cropped):
    """(k, 3): centroids of the whole, of sides where there are normals, and of what a crop may leave of each."""
    shares, sides = areas[:, None], np.zeros((1, 3))
    if normals is not None:
        # As in a depth image, surface counts by what of it can be seen from there.
        shares, sides = np.hstack([shares, areas[:, None] * np.maximum(normals @ _SIDES.T, 0.0)]), np.vstack([sides, _SIDES])
    shares = shares / np.maximum(shares.sum(axis=0), np.finfo(float).tiny)
    centroids = [shares.T @ V]
    for direction in _SIDES if cropped else ():
        across = np.flatnonzero(np.abs(sides @ direction) < _ACROSS)
        order = np.argsort(V @ direction, kind="stable")
        below = np.cumsum(shares[order][:, across], axis=0)
        moments = np.cumsum(shares[order][:, across, None] * V[order, None], axis=0)
        for crop in _CROPS:
            last = np.minimum((below < 1.0 - crop).sum(axis=0), len(V) - 1)
            k = np.arange(len(across))
            centroids.append(moments[last, k] / np.maximum(below[last, k], np.finfo(float).tiny)[:, None])
    return np.vstack(centroids)
