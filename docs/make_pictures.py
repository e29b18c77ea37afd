"""Draws the documents' pictures: python docs/make_pictures.py, in the checkout, with the package installed.

Takes 20 seconds the first time, for a library of starting poses, and seconds after that.
docs/pictures/fit.png: the scan that ``lbsfit demo`` makes of the bundled hand, coloured by the parts found; the registered mesh;
the true mesh.
docs/pictures/turn.png: what the angles of a finger's first joint do.
"""

from pathlib import Path

import numpy as np

import lbsfit_np as lbs
from lbsfit_np.report.colors import part_colors
from lbsfit_np.report.render import Mesh, Points, montage, render, write_png
from lbsfit_np.report.turn_picture import turn_picture
from lbsfit_np.seeds import integer_seed

HERE = Path(__file__).resolve().parent


def main():
    rig = lbs.load_rig("hand")
    write_png(HERE / "pictures" / "turn.png", turn_picture(rig, "index1", size=(200, 225)))
    scan = scan_of_the_demo(rig)
    result = lbs.fit_scan(rig, scan.points, random_state=0)
    write_png(HERE / "pictures" / "fit.png", fit_picture(rig, scan, result))
    joints = np.linalg.norm(result.joints - scan.joints, axis=1).mean()
    vertices = np.linalg.norm(result.vertices - scan.vertices, axis=1).mean()
    right = np.mean(result.labels == scan.labels)
    print(f"fit.png: {result.status}; {len(scan.points)} points of a hand of {1000 * rig.size:.0f} mm")
    print(f"fit.png: joints off by {1000 * joints:.1f} mm, vertices by {1000 * vertices:.1f} mm, {right:.0%} of the labels right")


def scan_of_the_demo(rig):
    """A scan with noise, holes and uneven density, of a hand of other proportions, in a random pose within the limits."""
    return lbs.synthesize(rig, 1, random_state=integer_seed(0, "demo"), least_holes=1)[0]


def fit_picture(rig, scan, result):
    """Scan, registration and truth side by side, under one camera."""
    colors = part_colors(len(rig.parts))
    items = (
        Points(scan.points, colors[result.labels], radius=2.4),
        Mesh(result.vertices, rig.faces, colors[rig.vertex_labels]),
        Mesh(scan.vertices, rig.faces),
    )
    camera = {"view": (20.0, 8.0), "up": rig.up, "forward": rig.forward, "frame": scan.vertices, "size": (330, 460)}
    return montage([[render(item, **camera) for item in items]], gap=10)


if __name__ == "__main__":
    main()
