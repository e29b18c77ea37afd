"""The measures of the benchmarks: each compares a fit with the truth of its scan in one number."""

import numpy as np

from ..losses.chamfer import chamfer
from ..threads import one_thread

__all__ = ["joint_error", "label_accuracy", "recon", "vertex_error"]


def joint_error(joints, true_joints, moving):
    """Mean distance between posed joints and the true ones over the unlocked joints, root included (the paper's Pose).

    Parameters
    ----------
    joints, true_joints : (J, 3) arrays
        In one frame and unit, which the error has, too.
    moving : (J,) bool array
        ``Rig.moving``.

    Returns
    -------
    float
    """
    return float(np.linalg.norm(joints - true_joints, axis=1)[moving].mean())


def vertex_error(vertices, true_vertices):
    """Mean distance between registered vertices and the true ones, (m, 3) each."""
    return float(np.linalg.norm(vertices - true_vertices, axis=1).mean())


def label_accuracy(labels, true_labels):
    """Share of the points, in [0, 1], whose label is the true one; (n,) each."""
    return float((np.asarray(labels) == true_labels).mean())


@one_thread()  # sums of many terms by several threads are others in the last bit
def recon(points, vertices):
    """√L_c between all points of a scan, (n, 3), and a mesh's vertices, (m, 3); in their unit (the paper's Recon).

    It is not 0 at the exact true mesh, as points and vertices are different samples of one surface: judge it beside that value.
    """
    return float(np.sqrt(chamfer(points, vertices)[0]))
