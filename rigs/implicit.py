"""Implicit surfaces for building rigs: lofted limbs and ellipsoids, blended smoothly, cut into triangles, projected onto.

A shape is a function of points (n, 3) that returns an approximate signed distance (n,), negative inside, in metres. It has to
be right near the surface only: blending radii are far smaller than a primitive's reach. Build time only.
"""

import numpy as np

__all__ = ["Loft", "capsule", "ellipsoid", "frame_along", "gradient", "polygonise", "project", "smooth_cut", "smooth_union"]

# Primitives are evaluated inside a box only; outside it they count as far away. The box reaches beyond every blending radius, as
# a shape that vanished within one would leave a step in the surface. What is larger than a hand is given a longer reach.
_REACH, _FAR = 0.022, 0.05


def frame_along(distal, dorsal):
    """Right-handed axes of a limb segment: columns x = y × z (sideways), y (dorsal, made perpendicular), z (distal).

    Parameters
    ----------
    distal, dorsal : (3,) arrays

    Returns
    -------
    (3, 3) array
    """
    z = np.asarray(distal, dtype=float) / np.linalg.norm(distal)
    y = np.asarray(dorsal, dtype=float) - np.dot(dorsal, z) * z
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


class Loft:
    """A straight limb segment with a cross-section that changes along it: rounded superellipses through given stations.

    Parameters
    ----------
    origin : (3,) array
    frame : (3, 3) array
        Columns: sideways (x), dorsal (y), along (z).
    stations : (k, 5) array
        Rows (s, right, left, dorsal, palmar): position along z and the four half-axes towards +x, −x, +y, −y, in metres.
    caps : (2,) floats
        How far the rounded ends reach beyond the first and last station, metres.
    exponent : float, default 2.3
        Of the superellipse; 2 is an ellipse, larger is boxier.
    reach : float, default 0.022
        How far outside it is still evaluated, metres; longer than every blending radius.
    """

    def __init__(self, origin, frame, stations, *, caps, exponent=2.3, reach=_REACH):
        from scipy.interpolate import PchipInterpolator

        self.origin, self.frame = np.asarray(origin, dtype=float), np.asarray(frame, dtype=float)
        stations = np.asarray(stations, dtype=float)
        self.start, self.end = stations[0, 0], stations[-1, 0]
        self.profile = PchipInterpolator(stations[:, 0], stations[:, 1:], axis=0)
        self.caps, self.exponent, self.far = caps, exponent, max(_FAR, 2 * reach)
        most = stations[:, 1:].max(axis=0) + reach
        low = np.array([-most[1], -most[3], self.start - caps[0] - reach])
        high = np.array([most[0], most[2], self.end + caps[1] + reach])
        self.box = _Box(self.origin, self.frame, low, high)

    def __call__(self, points):
        out = np.full(len(points), self.far)
        near, (u, v, s) = self.box.inside(points)
        inside = np.clip(s, self.start, self.end)
        right, left, dorsal, palmar = self.profile(inside).T
        a = np.where(u > 0, right, left)
        b = np.where(v > 0, dorsal, palmar)
        over = s - inside
        c = np.where(over < 0, self.caps[0], self.caps[1])
        e = self.exponent
        section = (np.abs(u / a) ** e + np.abs(v / b) ** e) ** (1 / e)
        r = np.sqrt(section**2 + (over / c) ** 2)
        size = np.where(r > 1e-9, _length(u, v, over) / np.maximum(r, 1e-9), np.minimum(a, b))
        out[near] = (r - 1) * size
        return out


def ellipsoid(centre, frame, radii, *, reach=_REACH):
    """An ellipsoid whose half-axes lie along the columns of ``frame``; distances are radial. ``reach`` as for a Loft."""
    centre, radii = np.asarray(centre, dtype=float), np.asarray(radii, dtype=float)
    box = _Box(centre, frame, -radii - reach, radii + reach)

    def shape(points):
        out = np.full(len(points), max(_FAR, 2 * reach))
        near, p = box.inside(points)
        r = _length(*(q / radius for q, radius in zip(p, radii)))
        out[near] = (r - 1) * np.where(r > 1e-9, _length(*p) / np.maximum(r, 1e-9), radii.min())
        return out

    return shape


class _Box:
    """Which points are inside an oriented box, and where. Most of a shape's points are far from most of its primitives."""

    def __init__(self, origin, frame, low, high):
        self.origin, self.frame, self.low, self.high = origin, frame, low, high
        middle, half = origin + frame @ ((low + high) / 2), np.abs(frame) @ ((high - low) / 2) + 1e-9
        self.least, self.most = middle - half, middle + half  # along the world's axes, with reserve for rounding

    def inside(self, points):
        """Rows of ``points`` (n, 3), and the coordinates (3, k) of those in the box's frame."""
        near = np.flatnonzero(_between(points.T, self.least, self.most))
        local = ((points[near] - self.origin) @ self.frame).T
        kept = _between(local, self.low, self.high)
        return near[kept], local[:, kept]


def _between(columns, low, high):
    """One coordinate after the other: reductions over an axis of three take several times as long."""
    return np.logical_and.reduce([(c > lo) & (c < hi) for c, lo, hi in zip(columns, low, high)])


def _length(x, y, z):
    return np.sqrt(x * x + y * y + z * z)


def capsule(start, end, radii):
    """A round segment from ``start`` to ``end`` whose radius goes from radii[0] to radii[1]."""
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    axis = end - start

    def shape(points):
        t = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
        return np.linalg.norm(points - start - t[:, None] * axis, axis=1) - (radii[0] + t * (radii[1] - radii[0]))

    return shape


def smooth_union(shapes, radius):
    """Union with fillets: the polynomial smooth minimum, one shape after the other.

    min(a, b) − h² k / 4 with h = max(k − |a − b|, 0) / k and k the blending radius, at most 0.02 m.
    """

    def shape(points):
        total = shapes[0](points)
        for other in shapes[1:]:
            b = other(points)
            h = np.maximum(radius - np.abs(total - b), 0) / radius
            total = np.minimum(total, b) - h * h * (radius / 4)
        return total

    return shape


def smooth_cut(body, cutter, radius):
    """``body`` without ``cutter``, with a rounded rim: −smooth_union(−body, cutter)."""

    def shape(points):
        a, b = -body(points), cutter(points)
        h = np.maximum(radius - np.abs(a - b), 0) / radius
        return -(np.minimum(a, b) - h * h * (radius / 4))

    return shape


def polygonise(shape, low, high, step, *, blocks=1):
    """Zero level of a shape as a triangle mesh, by marching cubes (scikit-image, extra "build").

    Parameters
    ----------
    shape : callable
    low, high : (3,) arrays
        A box that holds the shape, metres.
    step : float
        Grid spacing, metres.
    blocks : int, default 1
        With more than 1 the shape is first evaluated at every ``blocks``-th grid point, and at the others only where the surface
        can be near; elsewhere the value of the nearest of those is taken.

    Returns
    -------
    vertices : (n, 3) array
    faces : (F, 3) int array, outward
    """
    from skimage.measure import marching_cubes

    axes = [np.arange(lo, hi + step, step) for lo, hi in zip(low, high)]
    if blocks > 1:
        values = _near_surface(shape, axes, step, blocks)
    else:
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        values = np.concatenate([shape(slab.reshape(-1, 3)) for slab in grid]).reshape(grid.shape[:3])
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(step,) * 3, gradient_direction="descent")
    return vertices.astype(float) + [a[0] for a in axes], faces.astype(np.int64)


def _near_surface(shape, axes, step, blocks):
    """Values on a grid: exact within about one block of the surface, else those of the block's middle."""
    middle = [(a[::blocks] + np.minimum(a[::blocks] + (blocks - 1) * step, a[-1])) / 2 for a in axes]
    coarse = np.stack(np.meshgrid(*middle, indexing="ij"), axis=-1)
    rough = np.concatenate([shape(slab.reshape(-1, 3)) for slab in coarse]).reshape(coarse.shape[:3])
    index = np.ix_(*(np.arange(len(a)) // blocks for a in axes))
    values = rough[index]
    # A block's corner is 0.87 edges from its middle; the rest is for distances that are not exact.
    near = np.argwhere(np.abs(values) < 1.6 * blocks * step)
    points = np.stack([a[i] for a, i in zip(axes, near.T)], axis=1)
    for chunk in np.array_split(np.arange(len(near)), max(1, len(near) // 100_000)):
        values[tuple(near[chunk].T)] = shape(points[chunk])
    return values


def gradient(shape, points, step=1e-5):
    """Central differences of a shape, (n, 3)."""
    shifts = step * np.eye(3)[:, None]
    ahead, behind = shape(np.concatenate([points + shifts, points - shifts]).reshape(-1, 3)).reshape(2, 3, -1)
    return ((ahead - behind) / (2 * step)).T


def project(shape, points, *, rounds=4, longest=0.003):
    """Move points onto the zero level by Newton steps along the gradient, no step longer than ``longest`` metres."""
    points = np.array(points, dtype=float)
    for _ in range(rounds):
        g = gradient(shape, points)
        move = -(shape(points) / np.maximum((g * g).sum(axis=1), 1e-6))[:, None] * g
        size = np.linalg.norm(move, axis=1, keepdims=True)
        points += move * np.minimum(1, longest / np.maximum(size, 1e-12))
    return points
