"""A gallery of fits from the worst to the best: the scan by its labels, the registered mesh, both together; two sides."""

from dataclasses import replace

from ..report.fit_picture import drawn_fit
from ..report.render import montage, render
from .pictures import evenly

__all__ = ["gallery", "gallery_of"]

_VIEWS = ("front", (70.0, 15.0))
_GREY = (205, 205, 210)


def gallery_of(fits, k):
    """Names of ``k`` fits, evenly from the worst to the best by recon; those of scans without a fit are left out."""
    ranked = sorted((name for name in fits.entries if fits.has(name)), key=lambda name: (-fits.entries[name]["recon"], name))
    return evenly(ranked, k)


def gallery(rig, shown, *, size=(260, 340)):
    """One row a fit: scan coloured by the labels found, registered mesh, the scan over the mesh; from the front, then from aside.

    All as in ``report.fit_picture``: turned back as the rig stands, and grey where points are off the mesh.

    Parameters
    ----------
    rig : Rig
    shown : sequence of ((n, 3) array, FitResult)
        The points that were fitted, and the fit.
    size : (int, int)
        Of each little picture, pixels.

    Returns
    -------
    (h, w, 3) uint8 array
    """
    lines = []
    for points, result in shown:
        cloud, mesh, axes = drawn_fit(rig, points, result)
        pictures = ((cloud,), (mesh,), (cloud, replace(mesh, colors=_GREY)))
        lines.append([render(*items, view=view, size=size, **axes) for view in _VIEWS for items in pictures])
    return montage(lines)
