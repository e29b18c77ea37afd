"""Test subjects: changed templates that no training scan shares, made by another rule than the fit's own proportions.

The fit knows one factor a bone, and stretches with the skinning weights. Here a subject has one length for each chain of
joints (a finger, an arm), one for what they hang on, a breadth, and a thickness that moves the skin along its normals by a
smooth random field: a fit can come near such a template, and never has it in its family.
"""

import numpy as np

from ..rig.chains import chains

__all__ = ["subject"]


def subject(rig, rng, *, amount=0.12, thickness=0.12):
    """A changed template and its joints.

    Parameters
    ----------
    rig : Rig
    rng : numpy.random.Generator
    amount : float
        Largest relative change of each length, uniform.
    thickness : float
        Largest relative change of each chain's thickness, uniform; the skin moves along its normals by that share of its
        distance to the bone.

    Returns
    -------
    vertices : (m, 3) array
    joints : (J, 3) array
    """
    chain = chains(rig)
    lengths = 1 + amount * rng.uniform(-1, 1, chain.max() + 1)
    thick = thickness * rng.uniform(-1, 1, chain.max() + 1)
    J = rig.joints.copy()
    for level, up in rig.levels:
        for c, p in zip(level, up):
            J[c] = J[p] + lengths[chain[c]] * (rig.joints[c] - rig.joints[p])
    # Each vertex goes with its joints, and what lies beyond a chain's last joint stretches along the last bone.
    w = rig.weights.toarray()
    U = np.zeros_like(rig.vertices)
    radius = np.zeros(len(U))
    for j in range(len(rig.parents)):
        rows = np.flatnonzero(w[:, j])
        if not len(rows):
            continue
        p = rig.parents[j]
        within = p >= 0 and chain[p] == chain[j]
        along = (rig.joints[j] if within else rig.vertices[rows].mean(axis=0)) - rig.joints[p if within else j]
        along = along / max(np.linalg.norm(along), 1e-12 * rig.size)
        arm = rig.vertices[rows] - rig.joints[j]
        reach = arm @ along
        U[rows] += w[rows, j, None] * (J[j] + arm + (lengths[chain[j]] - 1) * reach[:, None] * along)
        across = np.linalg.norm(arm - reach[:, None] * along, axis=1)
        radius[rows] += w[rows, j] * thick[chain[j]] * np.minimum(across, 0.3 * rig.size)
    return U + radius[:, None] * _normals(U, rig.faces), J


def _normals(vertices, faces):
    p = vertices[faces]
    face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    n = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(n, faces[:, k], face)
    return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
