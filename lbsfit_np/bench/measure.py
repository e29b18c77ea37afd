"""The measures of the benchmarks: each compares a fit with the truth of its scan in one number."""

import numpy as np

from ..errors import InputError, as_array, as_floats
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

    Raises
    ------
    InputError
        Joints of another shape than the true ones, or none; a mask that is not one of bools, or of no joint.
    """
    joints, true_joints = _alike("joints", joints, true_joints)
    expected = f"True or False for each of {len(joints)} joints, one of them True"
    moving = as_array("moving", moving, expected)
    if moving.dtype != bool or moving.shape != joints.shape[:1] or not moving.any():  # whole numbers would be rows
        got = f"{moving.dtype} values of shape {moving.shape}" if moving.dtype != bool or moving.any() else "no joint"
        raise InputError("moving", got, expected, "Pass rig.moving.")
    return float(np.linalg.norm(joints - true_joints, axis=1)[moving].mean())


def vertex_error(vertices, true_vertices):
    """Mean distance between registered vertices and the true ones, (m, 3) each; other shapes are an InputError."""
    vertices, true_vertices = _alike("vertices", vertices, true_vertices)
    return float(np.linalg.norm(vertices - true_vertices, axis=1).mean())


def label_accuracy(labels, true_labels):
    """Share of the points, in [0, 1], whose label is the true one; (n,) each, n ≥ 1; other shapes are an InputError."""
    labels, true_labels = as_array("labels", labels, "integers"), as_array("true_labels", true_labels, "integers")
    if true_labels.ndim != 1 or not true_labels.size:
        raise InputError("true_labels", f"shape {true_labels.shape}", "shape (n,), one for each of one point or more")
    if labels.shape != true_labels.shape:
        remedy = "Take the largest of each row of scores: scores.argmax(axis=1)." if labels.ndim == 2 else None
        raise InputError("labels", f"shape {labels.shape}", f"shape {true_labels.shape}, one for each point", remedy)
    return float((labels == true_labels).mean())


def _alike(argument, found, true):
    """Both as arrays of one shape (k, 3): another would be stretched to it without a word."""
    expected = "numbers of shape (k, 3)"
    found, true = as_floats(argument, found, expected), as_floats(f"true_{argument}", true, expected)
    if true.ndim != 2 or true.shape[1] != 3 or not true.size:
        raise InputError(f"true_{argument}", f"shape {true.shape}", "shape (k, 3) with k ≥ 1")
    if found.shape != true.shape:
        raise InputError(argument, f"shape {found.shape}", f"shape {true.shape}, as the true ones have")
    return found, true


@one_thread()  # sums of many terms by several threads are others in the last bit
def recon(points, vertices):
    """√L_c between all points of a scan, (n, 3), and a mesh's vertices, (m, 3); in their unit (the paper's Recon).

    It is not 0 at the exact true mesh, as points and vertices are different samples of one surface: judge it beside that value.
    """
    return float(np.sqrt(chamfer(points, vertices)[0]))
