"""Pictures of meshes and points by a small software renderer: NumPy only, no window, no graphics card.

Orthographic and deferred. A first pass finds, for each pixel, which triangle or point is in front (a z-buffer); a second
shades those pixels alone. Pictures are drawn at twice their size and averaged down.
"""

import struct
import zlib
from dataclasses import dataclass

import numpy as np

from ..errors import InputError, as_floats, brief
from ..io.write import atomic_path
from ..raster import Buffer, splat_points, splat_triangles
from ..rig.frames import AXES

__all__ = ["VIEWS", "Mesh", "Points", "is_signed", "montage", "render", "render_mesh", "render_points", "write_png"]

_SIGNED = b"Software\0lbsfit_np"

# Azimuth and elevation in degrees; sides are the subject's own.
VIEWS = {
    "front": (0.0, 0.0),
    "back": (180.0, 0.0),
    "left": (90.0, 0.0),
    "right": (-90.0, 0.0),
    "top": (0.0, 90.0),
    "bottom": (0.0, -90.0),
    "oblique": (35.0, 20.0),
}
# Where a subject looks when nothing else is known: glTF's forward for y up, Blender's for z up.
_FORWARD = {"y": "+z", "z": "-y", "x": "+z"}

_SUPERSAMPLING = 2
_AMBIENT, _DIFFUSE, _FILL = 0.43, 0.6, 0.2
_KEY_LIGHT = np.array([-0.45, 0.6, 0.66])  # in the camera's frame: from the upper left, behind the viewer
_FILL_LIGHT = np.array([0.8, -0.1, 0.6])
_GREY, _BLUE = (205, 205, 210), (0, 114, 178)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh to draw.

    Parameters
    ----------
    vertices : (m, 3) array
    faces : (F, 3) int array
    colors : (3,), (m, 3) or (F, 3) array, optional
        RGB 0–255: one colour, one per vertex (blended across triangles), or one per face. Default light grey. Where m = F,
        they are per vertex.
    smooth : bool, default True
        Shade by normals averaged at the vertices; else each triangle by its own.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: object = None
    smooth: bool = True


@dataclass(frozen=True, eq=False)
class Points:
    """Points to draw, as little balls.

    Parameters
    ----------
    points : (n, 3) array
    colors : (3,) or (n, 3) array, optional
        RGB 0–255. Default blue.
    radius : float, optional
        In pixels of the finished picture; default by their number.
    """

    points: np.ndarray
    colors: object = None
    radius: float | None = None


def render(*items, size=(600, 600), view="front", up="+y", forward=None, frame=None, margin=0.05, background=(255, 255, 255)):
    """Draw meshes and points together; what is nearer hides what is behind.

    Parameters
    ----------
    *items : Mesh or Points
    size : (int, int), default (600, 600)
        Width and height in pixels.
    view : str or (azimuth, elevation), default "front"
        One of ``VIEWS``, or degrees: the camera goes round the up axis, from the front to the subject's left side at 90, and
        rises by the elevation.
    up, forward : str
        Axes such as "+y" or "-z". Forward is where the subject looks; by default +z for y up, −y for z up.
    frame : (k, 3) array, optional
        What the camera shows from edge to edge, for pictures that are to be compared; default: the items.
    margin : float, default 0.05
        Share of the picture left empty on each side.
    background : RGB, default white

    Returns
    -------
    (height, width, 3) uint8 array
    """
    width, height = (int(s) * _SUPERSAMPLING for s in size)
    axes = _camera_axes(view, up, forward)
    arrays = [np.asarray(i.vertices if isinstance(i, Mesh) else i.points, dtype=float) for i in items]
    shown = [np.asarray(frame, dtype=float)] if frame is not None else [a for a in arrays if len(a)]
    center, scale = _fit(np.concatenate([a @ axes.T for a in shown]) if shown else np.zeros((1, 3)), width, height, margin)
    buffer = Buffer(width, height)
    layers = []
    for k, (item, array) in enumerate(zip(items, arrays)):
        pixels = (array @ axes.T - center) * scale * [1.0, -1.0, 1.0] + [width / 2, height / 2, 0.0]
        if isinstance(item, Mesh):
            faces = np.asarray(item.faces)
            splat_triangles(buffer, k, pixels, faces)
            layers.append((item, pixels, faces))
        else:
            radius = item.radius or np.clip(0.3 * np.sqrt(np.prod(size) / max(len(array), 1)), 0.7, 0.004 * max(size))
            splat_points(buffer, k, pixels, radius * _SUPERSAMPLING)
            layers.append((item, pixels, radius * _SUPERSAMPLING))
    image = np.empty((height * width, 3))
    image[:] = background
    for k, (item, pixels, more) in enumerate(layers):
        where = np.flatnonzero(buffer.item == k)
        shade = _shaded_mesh if isinstance(item, Mesh) else _shaded_points
        image[where] = shade(item, pixels, more, buffer.primitive[where], where % width + 0.5, where // width + 0.5)
    s = _SUPERSAMPLING
    image = image.reshape(height // s, s, width // s, s, 3).mean(axis=(1, 3))
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def render_mesh(vertices, faces, *, colors=None, smooth=True, **options):
    """Draw one mesh: :class:`Mesh` and :func:`render` in one call."""
    return render(Mesh(vertices, faces, colors, smooth), **options)


def render_points(points, *, colors=None, radius=None, **options):
    """Draw one point cloud: :class:`Points` and :func:`render` in one call."""
    return render(Points(points, colors, radius), **options)


def montage(rows, *, gap=8, background=(255, 255, 255)):
    """Put pictures together: a list of rows, each a list of (h, w, 3) uint8 arrays. Smaller ones are centred in their cells."""
    columns = max(len(row) for row in rows)
    heights = [max(image.shape[0] for image in row) for row in rows]
    widths = [max(row[c].shape[1] for row in rows if c < len(row)) for c in range(columns)]
    out = np.empty((sum(heights) + gap * (len(rows) - 1), sum(widths) + gap * (columns - 1), 3), dtype=np.uint8)
    out[:] = background
    y = 0
    for row, height in zip(rows, heights):
        x = 0
        for image, width in zip(row, widths):
            h, w = image.shape[:2]
            top, left = y + (height - h) // 2, x + (width - w) // 2
            out[top : top + h, left : left + w] = image
            x += width + gap
        y += height + gap
    return out


def is_signed(path):
    """Whether a file begins as those that :func:`write_png` writes."""
    with open(path, "rb") as file:
        return _SIGNED in file.read(100)


def write_png(path, image):
    """Write an (h, w, 3) or (h, w, 4) uint8 array as PNG, signed as this package's."""
    image = np.ascontiguousarray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8:
        raise InputError("image", f"{image.dtype} values of shape {image.shape}", "uint8 of shape (h, w, 3) or (h, w, 4)")
    height, width, channels = image.shape
    rows = np.zeros((height, 1 + width * channels), dtype=np.uint8)  # each row begins with its filter, 0: none
    rows[:, 1:] = image.reshape(height, -1)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2 if channels == 3 else 6, 0, 0, 0)
    pixels = zlib.compress(rows.tobytes(), 9)
    data = chunk(b"IHDR", header) + chunk(b"tEXt", _SIGNED) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"\x89PNG\r\n\x1a\n" + data)


def _camera_axes(view, up, forward):
    """Rows: the camera's right, up, and towards the viewer."""
    expected = f"one of {', '.join(VIEWS)}, or (azimuth, elevation) in degrees"
    angles = as_floats("view", VIEWS.get(view, ()) if isinstance(view, str) else view, expected)
    if angles.shape != (2,) or not np.isfinite(angles).all():
        raise InputError("view", brief(view), expected)
    azimuth, elevation = np.radians(angles)
    u = _axis(up, "up")
    f = _axis(forward or _FORWARD[up[-1]], "forward")
    if abs(u @ f) > 0:
        raise InputError("forward", repr(forward), f"an axis that is not {up} or its opposite")
    left = np.cross(u, f)  # of the subject
    around = np.cos(azimuth) * f + np.sin(azimuth) * left
    towards = np.cos(elevation) * around + np.sin(elevation) * u
    over = np.cos(elevation) * u - np.sin(elevation) * around
    return np.stack([np.cross(over, towards), over, towards])


def _axis(name, argument):
    if not isinstance(name, str) or name not in AXES:
        raise InputError(argument, repr(name), f"one of {' '.join(AXES)}")
    return np.array(AXES[name])


def _fit(seen, width, height, margin):
    """Centre of the content in the camera's frame, and pixels per unit."""
    low, high = seen.min(axis=0), seen.max(axis=0)
    extent = np.maximum(high - low, 1e-12 * max(1.0, np.abs(seen).max()))
    return (low + high) / 2, (1 - 2 * margin) * min(width / extent[0], height / extent[1])


def _shaded_mesh(mesh, pixels, faces, triangle, x, y):
    """(k, 3) colours of pixels that show these triangles."""
    corner = pixels[faces]
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = np.cross(edge1, edge2) * [1.0, -1.0, 1.0]  # y grows downwards in pixels, upwards for the lights
    area = edge1[triangle, 0] * edge2[triangle, 1] - edge1[triangle, 1] * edge2[triangle, 0]
    dx, dy = x - corner[triangle, 0, 0], y - corner[triangle, 0, 1]
    b = (dx * edge2[triangle, 1] - dy * edge2[triangle, 0]) / area
    c = (dy * edge1[triangle, 0] - dx * edge1[triangle, 1]) / area
    weights = np.clip(np.stack([1 - b - c, b, c], axis=1), 0.0, 1.0)
    if mesh.smooth:
        at_vertex = np.zeros_like(pixels)
        for k in range(3):
            np.add.at(at_vertex, faces[:, k], normal)
        shown = np.einsum("pk,pka->pa", weights, _unit(at_vertex)[faces[triangle]])
    else:
        shown = normal[triangle]
    shown = (
        _unit(shown) * np.where(normal[triangle, 2] < 0, -1.0, 1.0)[:, None]
    )  # both sides are lit: a scan's winding may be any
    colors = np.asarray(_GREY if mesh.colors is None else mesh.colors, dtype=float)
    if colors.ndim == 1:
        return _lit(colors, shown)
    if len(colors) == len(pixels):
        return _lit(np.einsum("pk,pka->pa", weights, colors[faces[triangle]]), shown)
    if len(colors) != len(faces):
        raise InputError(
            "colors", f"shape {colors.shape}", f"(3,), one row for each of {len(pixels)} vertices or {len(faces)} faces"
        )
    return _lit(colors[triangle], shown)


def _shaded_points(points, pixels, radius, row, x, y):
    offset = np.stack([x - pixels[row, 0], pixels[row, 1] - y], axis=1) / radius
    depth = np.sqrt(np.maximum(1.0 - (offset**2).sum(axis=1), 0.04))
    colors = np.asarray(_BLUE if points.colors is None else points.colors, dtype=float)
    if colors.ndim > 1 and len(colors) != len(pixels):
        raise InputError("colors", f"shape {colors.shape}", f"(3,) or one row for each of {len(pixels)} points")
    return _lit(colors if colors.ndim == 1 else colors[row], _unit(np.column_stack([offset, depth])))


def _lit(colors, normals):
    """Lambert shading by a key and a fill light, over ambient light that is a little stronger from above."""
    key = np.maximum(normals @ (_KEY_LIGHT / np.linalg.norm(_KEY_LIGHT)), 0.0)
    fill = np.maximum(normals @ (_FILL_LIGHT / np.linalg.norm(_FILL_LIGHT)), 0.0)
    light = _AMBIENT * (1.0 + 0.2 * normals[:, 1]) + _DIFFUSE * key + _FILL * fill
    return np.clip(colors * light[:, None], 0.0, 255.0)


def _unit(v):
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return v / np.where(length > 0, length, 1.0)
