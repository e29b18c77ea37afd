"""What a made scan shows beyond the end of its rig: the arm on which a hand hangs."""

from dataclasses import replace

import numpy as np

from ..optimize.frame import root_turn
from ..rotations import matrix_from_rotvec
from ..starts.beyond import end_of
from ..triangles import face_areas

__all__ = ["with_an_arm"]

# Its length in sizes of the rig (a forearm is about 1.4 times as long as a hand), how far it is bent, and how much wider it gets.
_LENGTH, _BENT, _WIDER = (0.2, 1.3), np.radians(45.0), 0.4
# It begins at the middle of what lies within this share of the mesh's length from its end.
_RIM = 0.05


def with_an_arm(rig, scan, noise, rng):
    """A scan of a rig that ends at its root, with an arm beyond: a tube that is as dense as the scan.

    Parameters
    ----------
    rig : Rig
    scan : SyntheticScan
        Of scale 1.
    noise : float
        Of its points, in half sizes.
    rng : numpy.random.Generator

    Returns
    -------
    SyntheticScan
        Points of the arm are of no part and no face, as clutter; all are in random order.
    """
    end, root = end_of(rig, scan.template, scan.template_joints), scan.template_joints[rig.root]
    length, bent = rng.uniform(*_LENGTH) * rig.size, rng.uniform(0.0, _BENT)
    along = (scan.template - root) @ end.direction
    rim = scan.template[along > end.reach - _RIM * end.length]
    middle = rim.mean(axis=0)
    across = np.linalg.svd(end.direction[None])[2][1:]  # two directions
    across = np.linalg.svd((rim - middle) @ across.T, full_matrices=False)[2] @ across
    wide = np.percentile(np.abs((rim - middle) @ across.T), 95, axis=0)
    area = np.pi * wide.sum() * (1 + _WIDER / 2) * length
    n = round(len(scan.points) * area / face_areas(scan.template, rig.faces).sum())
    t, around = rng.random(n), rng.uniform(0.0, 2 * np.pi, n)
    axis = np.cross(end.direction, np.cross(rng.standard_normal(3), end.direction))
    ring = (1 + _WIDER * t)[:, None] * wide * np.stack([np.cos(around), np.sin(around)], axis=1)
    tube = (length * t)[:, None] * end.direction + ring @ across
    tube = tube @ matrix_from_rotvec(bent * axis / np.linalg.norm(axis)).T + middle - root
    tube = tube @ root_turn(rig, scan.pose).T + scan.joints[rig.root]
    tube += noise * rig.size / 2 * rng.standard_normal(tube.shape)
    order = rng.permutation(len(scan.points) + n)
    return replace(
        scan,
        points=np.concatenate([scan.points, tube])[order],
        labels=np.concatenate([scan.labels, np.full(n, -1)])[order],
        triangle=np.concatenate([scan.triangle, np.full(n, -1)])[order],
        barycentric=np.concatenate([scan.barycentric, np.zeros((n, 3))])[order],
    )
