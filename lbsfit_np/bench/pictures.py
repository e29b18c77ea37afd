"""Pictures of a seed's fits from the worst to the best: the true mesh, the scan by its labels, the registered mesh, two sides."""

import numpy as np

from ..report.colors import part_colors
from ..report.fit_picture import axes_of
from ..report.render import Mesh, Points, montage, render

__all__ = ["evenly", "picture", "shown"]

_VIEWS = ("front", (70.0, 15.0))


def shown(fits, k):
    """Which of a seed's fits to show: ``k`` of them evenly by joint error, from the worst to the best.

    With 3 these are the worst, the median and the best. Fits that failed are left out.
    """
    ranked = sorted((i for i, (_, result, _) in enumerate(fits) if result is not None), key=lambda i: -fits[i][2]["joint_error"])
    return evenly(ranked, k)


def evenly(ranked, k):
    """``k`` of what is ranked, at even distances from the first to the last; all where there are fewer."""
    if not ranked or not k:
        return []
    return [ranked[r] for r in np.unique(np.linspace(0, len(ranked) - 1, k).round().astype(int))]


def picture(rig, fits, rows, *, size=(300, 340)):
    """One row a fit: true mesh, scan coloured by the labels found, registered mesh; from the front, then from aside.

    Parameters
    ----------
    rig : Rig
    fits : list of (SyntheticScan, FitResult, dict)
        Of one seed, as ``run_bench`` gives them.
    rows : sequence of int
        Which of them, see :func:`shown`.
    size : (int, int)
        Of each little picture, pixels.

    Returns
    -------
    (h, w, 3) uint8 array
    """
    colors = part_colors(len(rig.parts))
    lines = []
    for scan, result, _ in (fits[i] for i in rows):
        items = (
            Mesh(scan.vertices, rig.faces),
            Points(scan.points, colors[result.labels]),
            Mesh(result.vertices, rig.faces, colors[rig.vertex_labels]),
        )
        frame = np.concatenate([scan.vertices, result.vertices])
        axes = axes_of(rig) | {"frame": frame}
        lines.append([render(item, view=view, size=size, **axes) for view in _VIEWS for item in items])
    return montage(lines)
