"""The z-buffer: which triangle or point is in front at each pixel.

Pixels are (x to the right, y down, z towards the viewer); pixel (i, j) is sampled at its centre (i + ½, j + ½). Triangles are
filled row by row: a row meets a triangle in one interval, whose ends follow from its three edges, so that the work is that of
the pixels covered and no triangle is looped over.
"""

import numpy as np

__all__ = ["Buffer", "splat_points", "splat_triangles"]

_MOST_FRAGMENTS = 2_000_000  # at a time, so that memory stays small whatever is drawn
_SEAM = 1e-6  # pixels: neighbouring triangles overlap by so much rather than leave a crack


class Buffer:
    """What is in front at each of the width × height pixels, row by row.

    Attributes
    ----------
    depth : (h·w,) array
        z of what is in front; −inf where nothing is.
    item, primitive : (h·w,) int arrays
        Which item, and which of its triangles or points; item −1 where nothing is.
    """

    def __init__(self, width, height):
        self.width, self.height = width, height
        self.depth = np.full(width * height, -np.inf)
        self.item = np.full(width * height, -1, dtype=np.int32)
        self.primitive = np.zeros(width * height, dtype=np.int64)

    def draw(self, item, pixel, depth, primitive):
        """Fragments that may share pixels: the nearest wins, and what is there already wins a tie."""
        before = self.depth[pixel]
        np.maximum.at(self.depth, pixel, depth)
        won = (depth == self.depth[pixel]) & (depth > before)
        self.item[pixel[won]] = item
        self.primitive[pixel[won]] = primitive[won]


def splat_triangles(buffer, item, pixels, faces):
    """Draw the triangles of a mesh; (m, 3) vertices in pixels, (F, 3) faces."""
    corner = pixels[faces]
    x, y, z = corner[:, :, 0], corner[:, :, 1], corner[:, :, 2]
    low, high = (_of_three(extreme, corner) for extreme in (np.minimum, np.maximum))
    top = np.clip(np.ceil(low[:, 1] - 0.5), 0, buffer.height).astype(int)
    bottom = np.clip(np.floor(high[:, 1] - 0.5) + 1, 0, buffer.height).astype(int)
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    rows = np.where((area != 0) & np.isfinite(area), np.maximum(bottom - top, 0), 0)
    # Plane z = z0 + gx (x − x0) + gy (y − y0), and inside of each edge: sign · ((x − x_k) e_y − (y − y_k) e_x) ≤ 0.
    safe = np.where(area == 0, 1.0, area)
    z1, z2 = z[:, 1] - z[:, 0], z[:, 2] - z[:, 0]
    gx = (z1 * (y[:, 2] - y[:, 0]) - z2 * (y[:, 1] - y[:, 0])) / safe
    gy = (z2 * (x[:, 1] - x[:, 0]) - z1 * (x[:, 2] - x[:, 0])) / safe
    ex, ey = np.roll(x, -1, axis=1) - x, np.roll(y, -1, axis=1) - y
    ex, ey = ex * np.sign(area)[:, None], ey * np.sign(area)[:, None]

    for some in _batches(rows, rows * np.minimum(high[:, 0] - low[:, 0] + 1, buffer.width)):
        span, within = _repeated(rows[some])
        triangle = some[span]
        line = top[triangle] + within
        v = line + 0.5
        left, right = np.full(len(v), -np.inf), np.full(len(v), np.inf)
        for k in range(3):
            dx, dy = ex[triangle, k], ey[triangle, k]
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = x[triangle, k] + (v - y[triangle, k]) * dx / dy
            right = np.where(dy > 0, np.minimum(right, crossing), right)
            left = np.where(dy < 0, np.maximum(left, crossing), left)
        # Outside the triangle's height the interval is empty by itself, but for rounding: the seam stays within it.
        first = np.clip(np.ceil(left - 0.5 - _SEAM), 0, buffer.width).astype(int)
        last = np.clip(np.floor(right - 0.5 + _SEAM), -1, buffer.width - 1).astype(int)
        span, within = _repeated(np.maximum(last - first + 1, 0))
        column, line, triangle = first[span] + within, line[span], triangle[span]
        depth = z[triangle, 0] + gx[triangle] * (column + 0.5 - x[triangle, 0]) + gy[triangle] * (line + 0.5 - y[triangle, 0])
        depth = np.clip(depth, low[triangle, 2], high[triangle, 2])  # slivers on edge have steep planes
        buffer.draw(item, line * buffer.width + column, depth, triangle)


def _of_three(extreme, corner):
    """Minimum or maximum over the three corners, (F, 3, 3) → (F, 3); much faster than a reduction over so short an axis."""
    return extreme(extreme(corner[:, 0], corner[:, 1]), corner[:, 2])


def splat_points(buffer, item, pixels, radius):
    """Draw points as balls of a radius in pixels."""
    n = int(np.ceil(radius)) + 1
    step = np.arange(-n, n + 1)
    dy, dx = (d.ravel() for d in np.meshgrid(step, step, indexing="ij"))
    size = max(_MOST_FRAGMENTS // len(dx), 1)
    within = (pixels[:, :2] > -n) & (pixels[:, :2] < np.array([buffer.width, buffer.height]) + n)  # NaN is not
    drawn = np.flatnonzero(within.all(axis=1) & np.isfinite(pixels[:, 2]))
    for start in range(0, len(drawn), size):
        rows = drawn[start : start + size]
        p = pixels[rows]
        column = np.floor(p[:, 0]).astype(int)[:, None] + dx
        line = np.floor(p[:, 1]).astype(int)[:, None] + dy
        rise = radius**2 - (column + 0.5 - p[:, :1]) ** 2 - (line + 0.5 - p[:, 1:2]) ** 2
        inside = (rise >= 0) & (column >= 0) & (column < buffer.width) & (line >= 0) & (line < buffer.height)
        which = np.broadcast_to(np.arange(len(rows))[:, None], inside.shape)[inside]
        depth = p[which, 2] + np.sqrt(rise[inside])
        buffer.draw(item, line[inside] * buffer.width + column[inside], depth, rows[which])


def _repeated(counts):
    """Row k repeated counts[k] times, and the running number within each."""
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)


def _batches(rows, work):
    """Triangles to draw, in batches of bounded work."""
    drawn = np.flatnonzero(rows)
    if not len(drawn):
        return []
    number = (np.cumsum(work[drawn]) // _MOST_FRAGMENTS).astype(int)
    return np.split(drawn, np.flatnonzero(np.diff(number)) + 1)
