"""Where the template in a given pose goes that a scan shows: all of it, or one side."""

import numpy as np

from ..neighbors import PointIndex
from ..optimize.surface import vertex_normals
from ..scan import some_rows

__all__ = ["placed"]

# Sides that a scan may show: from so many directions, those of a cube's faces, edges and corners. So many points tell
# the right one, each at most this far from the surface, half sizes.
_SIDES = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=float)
_SIDES /= np.linalg.norm(_SIDES, axis=1, keepdims=True)
_POINTS, _REACH = 250, 0.2


def placed(model, problem, theta, scale=1.0, *, partial=False):
    """The State of a pose that is put where a scan is, its centroid on that of the points.

    A view of one side has the centroid of that side, which may be a quarter of a hand's size from the whole's. Which side it is
    the points tell: the one under which they lie closest to the surface.

    Parameters
    ----------
    model : Model
        With faces.
    problem : Problem
    theta : (J, 3) array
        Radians, in the problem's frame.
    scale : float, default 1
    partial : bool, default False
        Whether the scan shows one side only.

    Returns
    -------
    State
    """
    state, X, a = model.rest().replace(theta=np.array(theta, dtype=float), scale=scale), problem.X, problem.x_weights
    V = model.deformed(state).vertices
    centre, seen = X.mean(axis=0) if a is None else a @ X, model.areas @ V
    if partial:
        # As in a depth image, surface counts by what of it can be seen from there.
        shares = model.areas[:, None] * np.maximum(vertex_normals(V, model.rig.faces) @ _SIDES.T, 0.0)
        shares /= np.maximum(shares.sum(axis=0), np.finfo(float).tiny)
        sides = np.vstack([seen, shares.T @ V])
        rows = some_rows(X, _POINTS)
        on_side = (X[rows] - centre + sides[:, None]).reshape(-1, 3)
        away = np.linalg.norm(on_side - V[PointIndex(V).nearest(on_side)], axis=1).reshape(len(sides), -1)
        weights = None if a is None else a[rows] + np.finfo(float).tiny
        seen = sides[np.average(np.minimum(away, _REACH) ** 2, axis=1, weights=weights).argmin()]
    return state.replace(translation=centre - seen)
