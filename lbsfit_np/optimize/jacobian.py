"""How the posed template moves with each unknown: ∂V^d/∂x for the blocks of a State, in closed form.

A turn of joint j moves every point that hangs on it about the joint's posed position P_j:

    ∂v_i/∂(θ_j)_a = scale · ω_ja × Σ_{k below j} w_ik (T_k u_i − P_j),   ω_ja = A_parent(j) J_l(F_j θ_j) F_j e_a,

T_k the rigid motion of joint k, J_l the left Jacobian of rotation vectors. Translation and scale are plain; vertices are
linear in the coefficients of the template's family, B_i b_ik through the blended rotation and the joints' own moves.
"""

import numpy as np

from ..rotations import left_jacobian

__all__ = ["vertex_jacobian"]

_I = np.eye(3)


def vertex_jacobian(model, state, posed, rows, blocks, turning):
    """∂V^d/∂x at some vertices.

    Parameters
    ----------
    model : Model
    state : State
    posed : Posed
        V^d of the state.
    rows : (r,) int array
        Vertices.
    blocks : sequence of {"pose", "translation", "scale", "proportions"}
    turning : (J, 3) bool array
        The angles that are free.

    Returns
    -------
    (r, 3, p) array
        The blocks' columns one after the other, in the given order; angles in the order of ``np.argwhere(turning)``.
    """
    made = {
        "pose": lambda: _pose(posed, rows, turning),
        "translation": lambda: np.broadcast_to(_I, (len(rows), 3, 3)),
        "scale": lambda: ((posed.vertices[rows] - state.translation) / state.scale)[:, :, None],
        "proportions": lambda: _family(model, posed, rows),
    }
    return np.concatenate([made[block]() for block in blocks], axis=2)


def _pose(posed, rows, turning):
    rig, A = posed.rig, posed.A
    w, u = rig.weights[rows].toarray(), posed.rest[rows]
    shift = posed.unscaled_joints - (A @ posed.rest_joints[:, :, None])[:, :, 0]
    below = _subtrees(rig.parents)
    hanging = w @ below.T
    # One (r, J) array for each coordinate: Σ_{k below j} w_ik (T_k u_i − P_j).
    arm = [((u @ A[:, a].T + shift[:, a]) * w) @ below.T - hanging * posed.unscaled_joints[:, a] for a in range(3)]
    up = np.where((rig.parents >= 0)[:, None, None], A[rig.parents], _I)
    omega = up @ left_jacobian(posed.omega) @ rig.frames  # (J, 3, axis)
    joint, axis = np.nonzero(turning)
    omega, arm = posed.scale * omega[joint, :, axis].T, [a[:, joint] for a in arm]
    out = np.empty((len(rows), 3, len(joint)))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(omega[b], arm[c], out=out[:, a])
        out[:, a] -= omega[c] * arm[b]
    return out


def _family(model, posed, rows):
    rig, A, k = posed.rig, posed.A, model.n_coefficients
    J = len(rig.parents)
    turn = posed.blended[rows, :9].reshape(-1, 3, 3) + _I
    basis = model.basis.reshape(-1, 3, k)[rows]
    joints = model.joint_basis.reshape(J, 3, k)
    place = np.empty((J, 3, k))
    place[rig.root] = joints[rig.root]
    for level, up in rig.levels:
        place[level] = place[up] + np.einsum("jab,jbk->jak", A[up], joints[level] - joints[up])
    carried = (place - np.einsum("jab,jbk->jak", A, joints)).reshape(J, -1)
    return posed.scale * (turn @ basis + (rig.weights[rows] @ carried).reshape(-1, 3, k))


def _subtrees(parents):
    """(J, J): 1 where joint k is joint j or hangs below it."""
    below = np.eye(len(parents))
    for k in range(len(parents)):
        j = parents[k]
        while j >= 0:
            below[j, k] = 1.0
            j = parents[j]
    return below
