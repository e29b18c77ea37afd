"""Helpers for the body's anatomy: lofts between two points, and tables whose rows change with the figure."""

import numpy as np

from .implicit import Loft, frame_along

__all__ = ["REACH", "along", "table"]

REACH = 0.08  # metres: beyond every blending radius of the body


def along(start, end, front, stations, *, scale=1.0, caps=(0.02, 0.02), exponent=2.2, reach=REACH):
    """A loft from ``start`` to ``end`` whose stations are given as shares of that distance.

    Parameters
    ----------
    start, end, front : (3,) arrays
        ``front`` is the direction of the section's front half.
    stations : rows (share, outer, inner, front, back)
        Half-axes in millimetres; outer is the side of front × (end − start).
    scale : float
        Factor on all half-axes.
    """
    axis = np.asarray(end, dtype=float) - start
    rows = np.array(stations, dtype=float)
    rows[:, 0] *= np.linalg.norm(axis)
    rows[:, 1:] *= 0.001 * scale
    return Loft(start, frame_along(axis, front), rows, caps=caps, exponent=exponent, reach=reach)


def table(rows, figure, columns=(0, 1, 2, 3)):
    """Stations (k, 1 + len(columns)) in metres of one figure.

    Each row is a position, then tuples of half-axes for the neutral figure and per unit of fat, figure and muscle, in
    millimetres; ``columns`` says which of them become the station's right, left, dorsal and palmar half-axis.
    """
    out = np.empty((len(rows), 1 + len(columns)))
    for k, (at, *parts) in enumerate(rows):
        amounts = (1.0, figure.fat, figure.figure, figure.muscle)
        value = sum(a * np.array(p, dtype=float) for a, p in zip(amounts, parts))
        out[k] = at, *value[list(columns)]
    return 0.001 * out
