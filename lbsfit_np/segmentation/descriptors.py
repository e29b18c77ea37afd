"""Point descriptors: what the scan looks like from each of its points.

For a point x, the distances from x + o_k to the scan for fixed offsets o_k (probes, near to far), the distances from
fixed points around the centroid to the scan (the same for all points of a scan: its overall pose), the position of x
relative to the centroid, and the scan's covariance. Distances are looked up in a voxel grid of nearest occupied voxels:
exact to a fraction of a voxel, and far faster than one tree query a probe. Centroid and covariance are taken over occupied
voxels, not points, so that uneven density does not move them.
"""

from dataclasses import dataclass
from numbers import Real

import numpy as np

from ..errors import InputError, brief, is_whole

__all__ = ["Descriptor", "VoxelGrid", "directions", "within_reach"]

# Empty margin around the scan's box, in voxels; probes beyond it are looked up at its border.
_MARGIN = 6
# Points whose probes are looked up at a time: (points × probes) arrays of so many stay in a core's cache.
_BLOCK = 128
# Points further than this from the median (in half sizes of the rig) are clutter: they must not blow the grid up.
_REACH = 3.0
# Lengths that a descriptor may have, half sizes: grids of smaller voxels fill the memory.
_LEAST, _MOST = 0.01, 10.0


@dataclass(frozen=True)
class Descriptor:
    """A fixed description of points of a scan. Lengths are in half sizes of the rig (longest half-extent 1).

    Attributes
    ----------
    n_probes : int
        Probes around each point, at distances from ``nearest`` to ``farthest``, evenly spaced in the logarithm.
    n_basis : int
        Fixed points around the centroid.
    nearest, farthest : float
    voxel : float
        Edge of a voxel.
    """

    n_probes: int = 200
    n_basis: int = 96
    nearest: float = 0.05
    farthest: float = 1.2
    voxel: float = 0.05

    def __post_init__(self):
        """Raise InputError where a value is out of its range."""
        for name in ("n_probes", "n_basis"):
            if not is_whole(value := getattr(self, name), 1):
                raise InputError(name, brief(value), "a whole number of at least 1")
        for name, least in (("nearest", _LEAST), ("farthest", self.nearest), ("voxel", _LEAST)):
            value = getattr(self, name)
            if not isinstance(value, Real) or isinstance(value, bool) or not least <= value <= _MOST:
                raise InputError(name, brief(value), f"a number from {least:g} to {_MOST:g}")

    @property
    def size(self):
        """Number of values that describe a point."""
        return self.n_probes + self.n_basis + 9

    def grid(self, points):
        """The VoxelGrid of a scan that its points are described by."""
        return VoxelGrid(points, self.voxel)

    def __call__(self, points, rows=None, grid=None):
        """Describe points of a scan.

        Parameters
        ----------
        points : (n, 3) array
            The scan, in half sizes of the rig, any origin.
        rows : (k,) int array, optional
            Which points to describe; all by default.
        grid : VoxelGrid, optional
            Of all points, where it is there already.

        Returns
        -------
        (k, size) float32 array
        """
        grid = self.grid(points) if grid is None else grid
        x = ((points if rows is None else points[rows]) - grid.centre).astype(np.float32)
        out = np.empty((len(x), self.size), dtype=np.float32)
        probes = directions(self.n_probes, 1) * np.geomspace(self.nearest, self.farthest, self.n_probes)[:, None]
        probes = probes.T.astype(np.float32)[:, None, :]
        for start in range(0, len(x), _BLOCK):
            block = slice(start, start + _BLOCK)
            out[block, : self.n_probes] = grid.distance(*(x[block].T[:, :, None] + probes))
        basis = directions(self.n_basis, 2) * np.geomspace(0.2, 1.1, self.n_basis)[:, None]
        out[:, self.n_probes : self.n_probes + self.n_basis] = grid.distance(*basis.T.astype(np.float32))
        out[:, -9:-6] = x
        out[:, -6:] = 4.0 * grid.covariance[np.triu_indices(3)]
        return out


def directions(n, seed):
    """(n, 3) unit vectors, the same for ever."""
    d = np.random.default_rng(seed).standard_normal((n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def within_reach(points):
    """(n,) bool: which points lie no more than 3 from the median point along any axis; where none does, from the nearest one."""
    away = np.abs(points - np.median(points, axis=0)).max(axis=1)
    if away.min() > _REACH:
        away = np.abs(points - points[away.argmin()]).max(axis=1)
    return away <= _REACH


class VoxelGrid:
    """Nearest occupied voxel of every voxel around a scan, each standing for the mean of its points.

    Parameters
    ----------
    points : (n, 3) array
        What lies more than 3 from the median point is left out.
    voxel : float
        Edge of a voxel, in the unit of the points.

    Attributes
    ----------
    centre : (3,) array
        Mean of the occupied voxels.
    covariance : (3, 3) array
        Of the occupied voxels.
    """

    def __init__(self, points, voxel):
        from scipy.ndimage import distance_transform_edt

        points = points[within_reach(points)]
        self._voxel = voxel
        self._low = points.min(axis=0) - (_MARGIN + 0.5) * voxel  # half a voxel: on a border, rounding would choose the side
        self._shape = tuple((np.ceil(np.ptp(points, axis=0) / voxel).astype(int) + 2 * _MARGIN + 2).tolist())
        cells = np.ravel_multi_index(((points - self._low) / voxel).astype(int).T, self._shape)
        occupied, cells, count = np.unique(cells, return_inverse=True, return_counts=True)
        mean = np.stack([np.bincount(cells, points[:, k]) for k in range(3)], axis=1) / count[:, None]
        self.centre = mean.mean(axis=0)
        self.covariance = np.cov(mean.T) if len(mean) > 1 else np.zeros((3, 3))
        which = np.full(self._shape, -1, dtype=np.int32)
        which.reshape(-1)[occupied] = np.arange(len(occupied))
        nearest = distance_transform_edt(which < 0, return_distances=False, return_indices=True)
        which = which[tuple(nearest)].reshape(-1)
        self._mean = [m.take(which) for m in (mean - self.centre).astype(np.float32).T]
        self._low = (self._low - self.centre).astype(np.float32)

    def distance(self, x, y, z):
        """Distances of queries to the scan; their coordinates relative to the centre, float32 arrays of one shape."""
        # Coordinate by coordinate, which takes a fourth of the time of (..., 3) arrays.
        flat = 0
        for q, low, n in zip((x, y, z), self._low, self._shape):
            flat = flat * n + np.clip(((q - low) / self._voxel).astype(np.int32), 0, n - 1)
        squares = 0
        for q, mean in zip((x, y, z), self._mean):
            away = mean.take(flat) - q
            squares = squares + away * away
        return np.sqrt(squares)
