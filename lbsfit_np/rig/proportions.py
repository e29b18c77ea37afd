"""Proportions: how long, broad and thick each bone is, and the flesh about it, as a linear family of templates of any rig.

Each moving joint j stretches what it carries about its own rest position: along its bone by 1 + ℓ_j, across it by 1 + τ_j
(a joint with several children, such as a palm, has two factors across), and its descendants move along:

    J'_c = J'_p + B_p (J_c − J_p),   U'_i = Σ_j w_ij (J'_j + B_j (u_i − J_j)),   B_j = I + Σ_k c_jk e_jk e_jkᵀ.

Both are linear in the coefficients c, so U' = U + Σ_k c_k b_k with a fixed basis b. People are wide of bone or of flesh: a broad
palm has its knuckles further apart, a fat one has not. So joints with several children have girths besides, which widen their
skin and leave all joints, and what hangs on them, where they are. Of other bones the factor across does just that.
"""

from dataclasses import dataclass

import numpy as np

from .chains import bones

__all__ = ["Proportions", "proportions"]

# What a unit of a girth adds to the width: with both, which are half a unit at most, a quarter of the width is left.
_GIRTH = 0.5


@dataclass(frozen=True)
class Proportions:
    """The linear family of a rig.

    Attributes
    ----------
    basis : (m, 3, k) array
        Displacement of the vertices for a unit of each coefficient, in rig units.
    joints : (J, 3, k) array
        Displacement of the joints.
    length : (k,) bool array
        Which coefficients stretch along a bone; the others widen across it.
    owner : (k,) int array
        The joint that each coefficient stretches about.
    girths : (m, 3, g) array
        Displacement of the vertices for a unit of each girth, which is half the width. Each joint that branches has two girths.
        Their coefficients are their own, and are not among the k.
    """

    basis: np.ndarray
    joints: np.ndarray
    length: np.ndarray
    owner: np.ndarray
    girths: np.ndarray

    def offsets(self, coefficients):
        """(m, 3): U' − U, without girths."""
        return self.basis @ coefficients

    def moved_joints(self, coefficients):
        """(J, 3): J' − J."""
        return self.joints @ coefficients


def proportions(rig):
    """The proportions of a rig; see the module's text.

    Returns
    -------
    Proportions
        With two coefficients for each moving joint that carries weight; three, and two girths, where it branches.
    """
    J, m = len(rig.parents), len(rig.vertices)
    # What follows a moving joint rigidly (locked and merged joints below it) belongs to its bone.
    bone = bones(rig)
    weight = np.zeros((m, J))
    for j in range(J):
        column = rig.weights[:, [j]].toarray().ravel()
        weight[:, bone[j]] += column
    axes = []  # (joint, direction, kind)
    for j in np.flatnonzero(rig.moving):
        shown = np.where(rig.loose, 0.0, weight[:, j])
        if shown.max() < 1e-3:
            continue
        axes += [(j, e, kind) for e, kind in _axes(rig, j, bone, shown)]
    k = len(axes)
    stretch = np.zeros((J, 3, 3, k))
    for q, (j, directions, _) in enumerate(axes):
        stretch[j, :, :, q] = sum(np.outer(e, e) for e in directions)
    joints = np.zeros((J, 3, k))
    for level, up in rig.levels:
        for c, p in zip(level, up):
            joints[c] = joints[p] + np.einsum("abk,b->ak", stretch[bone[p]], rig.joints[c] - rig.joints[p])
    basis = np.zeros((m, 3, k))
    for j in np.unique(bone):
        rows = np.flatnonzero(weight[:, j])
        w = weight[rows, j]
        arm = rig.vertices[rows] - rig.joints[j]
        basis[rows] += w[:, None, None] * (joints[j] + np.einsum("abk,ib->iak", stretch[j], arm))
    length = np.array([kind == "length" for _, _, kind in axes], dtype=bool)
    owner = np.array([j for j, _, _ in axes], dtype=int)
    branching = [q for q, (_, _, kind) in enumerate(axes) if kind in ("breadth", "depth")]
    girths = np.zeros((m, 3, len(branching)))
    for g, q in enumerate(branching):
        j = owner[q]
        girths[:, :, g] = _GIRTH * weight[:, j, None] * ((rig.vertices - rig.joints[j]) @ stretch[j, :, :, q])
    copies = np.where(rig.loose, np.arange(m), rig.welded_from[rig.weld])  # weights that differ a little would open seams
    basis, girths = basis[copies], girths[copies]
    for array in (basis, joints, length, owner, girths):
        array.setflags(write=False)  # the rig keeps them
    return Proportions(basis, joints, length, owner, girths)


def _axes(rig, j, bone, weight):
    """Directions to stretch joint j along, each a list of unit vectors with its kind."""
    below = [c for c in range(len(rig.parents)) if rig.parents[c] >= 0 and bone[rig.parents[c]] == j and bone[c] != j]
    centre = np.average(rig.vertices, axis=0, weights=weight)
    arm = rig.vertices - rig.joints[j]
    target = rig.joints[below].mean(axis=0) if below else centre
    along = target - rig.joints[j]
    if np.linalg.norm(along) < 1e-9 * rig.size:
        along = centre - rig.joints[j]
    spread = np.einsum("i,ia,ib->ab", weight, arm, arm)
    if np.linalg.norm(along) < 1e-9 * rig.size:
        along = np.linalg.eigh(spread)[1][:, -1]
    along = along / np.linalg.norm(along)
    flat = np.eye(3) - np.outer(along, along)
    # The negative eigenvalue keeps ``along`` first also where the mesh is flat and has no extent in a second direction.
    _, vectors = np.linalg.eigh(flat @ spread @ flat - np.trace(spread) * np.outer(along, along))
    thin, broad = vectors[:, 1], vectors[:, 2]
    if len(below) > 1:
        return [([along], "length"), ([broad], "breadth"), ([thin], "depth")]
    return [([along], "length"), ([broad, thin], "thickness")]
