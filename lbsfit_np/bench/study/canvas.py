"""Sheets of paper for the study's figures: Matplotlib with settings of its own, the same bytes for the same figure."""

from contextlib import contextmanager

import numpy as np

from ...errors import MissingExtraError
from ...io.write import atomic_path

__all__ = ["GREY", "INK", "ROW_COLORS", "axes_at", "put", "sheet", "tiles"]

_DPI = 100
INK = "#222222"
GREY = "#8a8a8a"
# One colour for a row of the study in every figure, of the palette of Okabe and Ito.
ROW_COLORS = {"joint": "#0072b2", "rand": "#e69f00", "cd": "#d55e00", "pose-only": "#cc79a7", "free-form": "#56b4e9"}
# Nothing of the user's own settings; fonts that come with Matplotlib.
_STYLE = {
    "font.family": "DejaVu Sans",
    "mathtext.fontset": "dejavusans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlepad": 7.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
}
# Pixels: between tiles, around them, a line of text.
_GAP, _EDGE, _LINE = 8, 10, 19


@contextmanager
def sheet(path, width, height):
    """An empty figure of so many pixels, which is written as PNG when the block ends without an error.

    Parameters
    ----------
    path : path-like
    width, height : int

    Yields
    ------
    matplotlib.figure.Figure

    Raises
    ------
    MissingExtraError
        Matplotlib is not installed.
    """
    try:
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtraError("matplotlib", "viz", "a figure of the study") from None
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        FigureCanvasAgg(figure)
        yield figure
        with atomic_path(path) as temporary:
            # The library writes its version into the file unless told not to.
            figure.savefig(temporary, format="png", dpi=_DPI, metadata={"Software": None})


def axes_at(figure, left, top, width, height, **options):
    """Axes at a place in pixels from the upper left corner of the figure; options as for ``Figure.add_axes``."""
    W, H = (figure.get_size_inches() * _DPI).round()
    return figure.add_axes((left / W, 1 - (top + height) / H, width / W, height / H), **options)


def tiles(path, rows, *, titles, groups=(), notes=None):
    """Little pictures in rows and columns, pixel for pixel.

    Parameters
    ----------
    path : path-like
    rows : list of lists of (h, w, 3) uint8 arrays
        All of one size; None where there is nothing to show.
    titles : list of str
        One a column.
    groups : sequence of (str, int, int)
        Titles over columns from … to, both included.
    notes : mapping of (int, int) to str, optional
        Lines of text under tiles, by row and column.
    """
    height, width = next(tile for row in rows for tile in row if tile is not None).shape[:2]
    notes = notes or {}
    head = _EDGE + _LINE * (1 + bool(groups)) + 4 * bool(groups)
    step = height + _GAP + _LINE * bool(notes)
    columns = len(titles)
    # Groups stand a little apart.
    left = _EDGE + np.arange(columns) * (width + _GAP)
    for _, first, _ in groups:
        left[first:] += 2 * _GAP if first else 0
    W, H = left[-1] + width + _EDGE, head + step * len(rows) + _EDGE - _GAP
    with sheet(path, W, H) as figure:
        over = axes_at(figure, 0, 0, W, H, xlim=(0, W), ylim=(H, 0))
        over.axis("off")
        for title, first, last in groups:
            a, b = left[first], left[last] + width
            over.text((a + b) / 2, _EDGE + 0.4 * _LINE, title, ha="center", va="center", weight="bold")
            over.plot([a + 4, b - 4], [_EDGE + _LINE + 1] * 2, color=GREY, lw=0.8)
        for title, x in zip(titles, left, strict=True):
            over.text(x + width / 2, head - 0.55 * _LINE, title, ha="center", va="center")
        under = {"ha": "center", "va": "center", "fontsize": 8, "color": GREY}
        for r, row in enumerate(rows):
            top = head + r * step
            for c, (tile, x) in enumerate(zip(row, left, strict=True)):
                if tile is not None:
                    put(figure, tile, x, top)
                if (r, c) in notes:
                    over.text(x + width / 2, top + height + 0.4 * _LINE, notes[r, c], **under)


def put(figure, tile, left, top, title=None):
    """An (h, w, 3) uint8 picture at its own size, its upper left corner at a place in pixels; its title above."""
    W, H = (figure.get_size_inches() * _DPI).round()
    # Shades in steps of four, which nobody sees: the file is a quarter smaller.
    figure.figimage(tile | 3, left, H - top - tile.shape[0])
    if title:
        figure.text((left + tile.shape[1] / 2) / W, 1 - (top - 0.6 * _LINE) / H, title, ha="center", va="center", fontsize=9.5)
