"""The look of a scan: one vector for the whole of it, whatever its number of points, its place and its unit.

Its distances from fixed points around its centroid, near to far (a basis point set), all lengths in units of its own radius,
the root mean square distance from the centroid. Seen in a turned frame the look is that of the scan turned back, at the price of
looking the turned points up; so a scan can be compared with known looks under many turns.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ..segmentation.descriptors import VoxelGrid, directions
from .scale import extent

__all__ = ["LOOK_SIZE", "Look", "look"]

LOOK_SIZE = 384
# Radii, in the scan's own, of the nearest and the farthest basis point.
_NEAR, _FAR = 0.25, 2.4
# Edge of a voxel as a share of the scan's extent.
_VOXEL = 0.04


@dataclass(frozen=True)
class Look:
    """What a scan looks like.

    Attributes
    ----------
    vectors : (R, 384) float32 array
        One row a turn.
    radius : float
        In the unit of the points.
    """

    vectors: np.ndarray
    radius: float


def look(points, turns=None):
    """The look of a scan, under one or more turns.

    Parameters
    ----------
    points : (n, 3) array
        Any origin, any unit; of positive extent.
    turns : (R, 3, 3) array, optional
        Rotations; row r of the answer is the look of ``points @ turns[r]``, which undoes the turn. By default the scan as it is.

    Returns
    -------
    Look
    """
    size = extent(points)
    middle = np.median(points, axis=0)  # far from the origin single precision would not tell points apart
    grid = VoxelGrid((points - middle) / size, _VOXEL)
    radius = max(float(np.sqrt(np.trace(grid.covariance))), _VOXEL)
    turns = np.eye(3)[None] if turns is None else np.asarray(turns)
    queries = np.einsum("rab,kb->rka", turns, _basis()) * radius
    vectors = grid.distance(*np.moveaxis(queries.astype(np.float32), -1, 0)) / np.float32(radius)
    return Look(vectors, radius * size)


@cache
def _basis():
    return directions(LOOK_SIZE, 3) * np.geomspace(_NEAR, _FAR, LOOK_SIZE)[:, None]
