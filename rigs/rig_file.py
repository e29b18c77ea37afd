"""What every build does at its end: write the rig's file, and say in words what the mesh is like. Build time only."""

from importlib import metadata

import numpy as np

from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.write import write_npz
from lbsfit_np.rig.build import build_rig

from .checks import components, edge_uses, euler_characteristic, self_intersections

__all__ = ["library_versions", "mesh_lines", "write_rig"]


def write_rig(data, path):
    """Write a rig that was built to an NPZ; returns the Rig.

    Beyond the rig format's keys the file has ``built_with``, the versions of the libraries: with the same ones a rebuild gives
    the same file.

    Parameters
    ----------
    data : RigData
    path : Path
    """
    rig = build_rig(data)
    rig.save(path)
    write_npz(path, **read_npz(path), built_with=np.array(library_versions()))
    return rig


def library_versions():
    """The libraries that decide the last bits of a build, as text."""
    return ", ".join(f"{name} {metadata.version(name)}" for name in ("numpy", "scipy", "scikit-image"))


def mesh_lines(rig, size):
    """Counts, edges, closedness, pieces, self-intersections and influences, in lines of text; ``size`` is one line more."""
    edges = np.linalg.norm(rig.vertices[rig.faces] - rig.vertices[np.roll(rig.faces, 1, axis=1)], axis=2)
    return [
        f"{len(rig.vertices)} vertices, {len(rig.faces)} triangles, edges {1e3 * edges.min():.1f} to {1e3 * edges.max():.1f} mm",
        f"triangles on one side of an edge: {edge_uses(rig.faces)[0]}; closed: {edge_uses(rig.faces)[1]}",
        f"pieces: {components(rig.faces, len(rig.vertices))}; Euler characteristic: {euler_characteristic(rig.faces)}",
        size,
        f"self-intersections at rest: {len(self_intersections(rig.vertices, rig.faces))}",
        f"at most {np.diff(rig.weights.indptr).max()} influences a vertex, {rig.weights.nnz / len(rig.vertices):.1f} on average",
    ]
