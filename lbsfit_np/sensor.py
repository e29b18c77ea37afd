"""What a sensor makes of a posed mesh: points on its surface, or on the side that it sees, among clutter and on a floor."""

from functools import cached_property

import numpy as np

from .raster import Buffer, splat_triangles
from .triangles import area_vectors, binary_extent, inside_out

__all__ = ["View", "clutter", "floor", "sample_seen_surface", "sample_surface", "within_crop"]

# The camera is up to this far above or below the horizon.
_ELEVATION = np.radians(30.0)
# Pixels of the z-buffer along the longer side of what the camera sees.
_PIXELS = 256
# A point is seen if it is less than a pixel behind what its pixel shows, and what its triangle's slope, cut here, adds on the way
# from the pixel's centre.
_STEEPEST = 8.0
# Triangles of less than this, square pixels, have no area: which way they look is rounding.
_LEAST_AREA = 1e-6
# Batches of surface points, drawn until enough of them are seen.
_BATCHES = 20
# Sides that are tried until one shows anything.
_SIDES = 20
_CLUTTER_BOX, _FLOOR_BOX = 1.3, 1.5


def sample_surface(vertices, faces, n, rng, *, density=0.0):
    """Points on a surface, uniform by area, or unevenly dense.

    Parameters
    ----------
    vertices : (m, 3) array
    faces : (F, 3) int array
    n : int
    rng : numpy.random.Generator
    density : float, default 0
        Logarithm of the density along two random smooth directions (one of position, one of the normal).

    Returns
    -------
    points : (n, 3) array
    triangle : (n,) int array
        Row of ``faces``.
    barycentric : (n, 3) array
    """
    return _drawn(vertices, faces, _densities(vertices, faces, density, rng), n, rng)


def sample_seen_surface(vertices, faces, n, rng, *, up, density=0.0):
    """Points on what a depth camera far away sees of a surface, even in its image but for ``density``.

    Parameters
    ----------
    vertices, faces, n, rng, density
        As in :func:`sample_surface`.
    up : (3,) array
        Unit vector along a coordinate axis. The camera looks from a random side, at most 30 degrees above or below the horizon.

    Returns
    -------
    points, triangle, barycentric
        As there; fewer than n only where next to nothing is seen, none where nothing is from any of some sides.
    """
    for _ in range(_SIDES):  # a flat mesh has a back
        view = View(vertices, faces, _random_side(up, rng))
        if view.facing.any():
            break
    weight = _densities(vertices, faces, density, rng) * view.facing
    batches, found = [], 0
    for _ in range(_BATCHES):
        batch = _drawn(vertices, faces, weight, 2 * n, rng)
        seen = view.sees(batch[0], batch[1])
        batches.append([a[seen] for a in batch])
        found += seen.sum()
        if found >= n:
            break
    return tuple(np.concatenate(a)[:n] for a in zip(*batches, strict=True))


class View:
    """A mesh as a camera far away sees it (orthographic).

    Parameters
    ----------
    vertices : (m, 3) array
    faces : (F, 3) int array
    towards : (3,) array
        Unit vector to the camera.
    """

    def __init__(self, vertices, faces, towards):
        across = np.cross(towards, np.eye(3)[np.abs(towards).argmin()])
        across /= np.linalg.norm(across)
        self._axes = np.stack([across, np.cross(towards, across), towards])
        seen = vertices @ self._axes.T
        self._least = seen.min(axis=0)
        self._scale = (_PIXELS - 2) / max(np.ptp(seen[:, :2], axis=0).max(), 1e-300)
        self._vertices, self._faces = self._pixels(vertices), faces
        self._buffer = Buffer(_PIXELS, _PIXELS)
        splat_triangles(self._buffer, 0, self._vertices, faces)

    @cached_property
    def facing(self):
        """(F,): cosine between each triangle's outer normal and the camera's direction, 0 where it looks away or has no area."""
        n = self._normals
        area = np.linalg.norm(n, axis=1)
        return np.where(area > _LEAST_AREA, np.maximum(n[:, 2], 0.0) / np.maximum(area, 1e-300), 0.0)

    def sees(self, points, triangle):
        """Which points of the mesh's surface nothing hides.

        Parameters
        ----------
        points : (n, 3) array
        triangle : (n,) int array
            Rows of ``faces`` that they are on.

        Returns
        -------
        (n,) bool array
        """
        at = self._pixels(points)
        column, row = np.clip(at[:, :2].astype(int), 0, _PIXELS - 1).T
        n = self._normals[triangle]
        slope = np.abs(n[:, :2]).sum(axis=1) / np.maximum(np.abs(n[:, 2]), 1e-300)
        nearest = self._buffer.depth[row * _PIXELS + column]
        return (self.facing[triangle] > 0) & (at[:, 2] >= nearest - 1.0 - 0.5 * np.minimum(slope, _STEEPEST))

    def _pixels(self, points):
        return (points @ self._axes.T - self._least) * self._scale + 1.0

    @cached_property
    def _normals(self):
        """Outer normals in pixels, (F, 3); which side is out follows from the sign of the mesh's volume."""
        V = self._vertices - self._vertices.mean(axis=0)
        n = area_vectors(V, self._faces)
        return -n if inside_out(V, self._faces) else n


def within_crop(points, beyond, rng):
    """(n,) bool: the points on this side of a plane across a random direction, which a share of them is beyond."""
    direction = rng.standard_normal(3)
    along = points @ (direction / np.linalg.norm(direction))
    return along <= np.quantile(along, 1.0 - beyond)


def clutter(points, share, rng):
    """Further points, ``share`` of the number of ``points``, uniform in their bounding box enlarged by 30 %; (k, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    away = rng.uniform(-0.5, 0.5, (round(share * len(points)), 3))
    return (low + high) / 2 + _CLUTTER_BOX * (high - low) * away


def floor(points, share, height, up, noise, rng):
    """Further points, ``share`` of the number of ``points``, on a floor.

    Parameters
    ----------
    points : (n, 3) array
    share : float
    height : float
        Of the floor along ``up``.
    up : (3,) array
        Unit vector along a coordinate axis. The floor is 1.5 times as wide as the bounding box of ``points`` across it.
    noise : float
        Standard deviation on each coordinate.
    rng : numpy.random.Generator

    Returns
    -------
    (k, 3) array
    """
    low, high = points.min(axis=0), points.max(axis=0)
    away = rng.uniform(-0.5, 0.5, (round(share * len(points)), 3))
    on = (low + high) / 2 + _FLOOR_BOX * (high - low) * away
    on += (height - on @ up)[:, None] * up
    return on + noise * rng.standard_normal(on.shape)


# ---- within ----


def _random_side(up, rng):
    """Unit vector towards a camera: any azimuth, any elevation that it may have."""
    side = np.roll(up, 1)
    azimuth, elevation = rng.uniform(-np.pi, np.pi), rng.uniform(-_ELEVATION, _ELEVATION)
    around = np.cos(azimuth) * side + np.sin(azimuth) * np.cross(up, side)
    return np.cos(elevation) * around + np.sin(elevation) * up


def _densities(vertices, faces, density, rng):
    """Of each triangle, how many of the points it is to get, in shares of any sum."""
    vertices = vertices / binary_extent(vertices)
    p, normal = vertices[faces], area_vectors(vertices, faces)
    weight = np.linalg.norm(normal, axis=1)
    if density:
        centre = (p[:, 0] + p[:, 1] + p[:, 2]) / 3
        centre = (centre - centre.mean(axis=0)) / np.ptp(vertices, axis=0).max()
        facing = normal / np.maximum(weight, 1e-300)[:, None]
        directions = rng.standard_normal((2, 3))
        weight = weight * np.exp(density * (2 * centre @ directions[0] + facing @ directions[1]))
    return weight


def _drawn(vertices, faces, weight, n, rng):
    """Points, triangles, barycentric coordinates: triangles by weight, evenly within each."""
    cumulative = np.cumsum(weight)
    triangle = np.searchsorted(cumulative, rng.random(n) * cumulative[-1], side="right")
    triangle = np.minimum(triangle, len(faces) - 1)
    a, b = np.sqrt(rng.random(n)), rng.random(n)
    bary = np.column_stack([1 - a, a * (1 - b), a * b])
    return np.einsum("nk,nka->na", bary, vertices[faces[triangle]]), triangle, bary
