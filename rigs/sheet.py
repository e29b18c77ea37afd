"""A contact sheet of a rig: rest from two sides, coloured by part, and poses from the library. Build time only."""

import numpy as np

from lbsfit_np.report.colors import part_colors
from lbsfit_np.report.render import Mesh, montage, render, render_mesh, write_png

__all__ = ["contact_sheet"]

_SKIN = (226, 176, 148)


def contact_sheet(path, rig, poses, *, subjects=(), size=(360, 390), columns=4):
    """Draw a rig to a PNG.

    Parameters
    ----------
    path : path-like
    rig : Rig
    poses : list of (theta (J, 3), view)
        Drawn after the first row, which shows the rest pose from the front and the back and its parts at two granularities.
    subjects : list of Rig
        Other people, after the first row, all at one scale.
    size : (int, int)
        Of one picture, pixels.
    columns : int
    """
    options = {"size": size, "up": rig.up, "forward": rig.forward}

    def draw(vertices, view, colors=_SKIN):
        return render_mesh(vertices, rig.faces, colors=np.asarray(colors), view=view, **options)

    coarse = rig.with_parts(next((p for p in rig.partitions if p != "joints"), "joints"))
    pictures = [draw(rig.vertices, "front"), draw(rig.vertices, "back")]
    for view, parted in (("front", rig), ("back", coarse)):
        pictures.append(draw(rig.vertices, view, part_colors(len(parted.parts))[parted.vertex_labels]))
    if subjects:
        largest = np.max([np.ptp(s.vertices, axis=0) for s in subjects], axis=0)

        def box(s):  # around each, as large as the largest
            middle = (s.vertices.min(axis=0) + s.vertices.max(axis=0)) / 2
            return middle + np.array([[-0.5], [0.5]]) * largest

        for s in subjects:
            item = Mesh(s.vertices, s.faces, np.asarray(_SKIN))
            pictures.append(render(item, view="front", frame=box(s), **options))
    pictures += [draw(rig.pose(theta), view) for theta, view in poses]
    write_png(path, montage([pictures[i : i + columns] for i in range(0, len(pictures), columns)]))
