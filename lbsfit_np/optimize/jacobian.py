"""How the posed template moves with each unknown: ∂V^d/∂x for the blocks of a State, in closed form, and what steps need of it.

A turn of joint j moves every point that hangs on it about the joint's posed position P_j:

    ∂v_i/∂(θ_j)_a = ω_ja × arm_ij,  arm_ij = Σ_{k below j} w_ik (T_k u_i − P_j),  ω_ja = A_parent(j) J_l(F_j θ_j) F_j e_a · scale,

T_k the rigid motion of joint k, J_l the left Jacobian of rotation vectors. Translation is plain; the scale is one about the root
joint of the template, as in ``state.Layout``; vertices are linear in the coefficients of the template's family, B_i b_ik through
the blended rotation and the joints' own moves.

ω is the same for all points: what steps sum over points are products of arms, of which there are fewer than columns.
"""

from dataclasses import dataclass, replace

import numpy as np

from ..rig.chains import subtrees
from ..rotations import left_jacobian

__all__ = ["VertexMotion", "joint_motion", "vertex_motion"]

_I = np.eye(3)
# (a, b, c): coordinate a of a cross product x × y is x_b y_c − x_c y_b.
_CROSS = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


@dataclass(frozen=True)
class VertexMotion:
    """∂v_i/∂x at n places of the posed template.

    Attributes
    ----------
    arms : (n, 3, j) array
        Of the joints that turn.
    omega : (3, t) array
        Of the t angles.
    joint : (t,) int array
        Which of the j each angle is of.
    plain : (n, 3, q) array
        The columns of the other unknowns, which come after the angles.
    """

    arms: np.ndarray
    omega: np.ndarray
    joint: np.ndarray
    plain: np.ndarray

    def at(self, places):
        """The motion of k places between these: (k, n) sparse, a row of weights each, such as barycentric coordinates."""
        k, n = places.shape
        arms, plain = ((places @ x.reshape(n, 3 * x.shape[2])).reshape(k, 3, x.shape[2]) for x in (self.arms, self.plain))
        return replace(self, arms=arms, plain=plain)

    def dense(self):
        """(n, 3, t + q): the derivatives, the angles' columns first."""
        turned = np.cross(self.omega.T[None], self.arms[:, :, self.joint].transpose(0, 2, 1)).transpose(0, 2, 1)
        return np.concatenate([turned, self.plain], axis=2)

    def normal_equations(self, r, normals, weights, tangential):
        """H = Σ_i w_i J_iᵀ M_i J_i and g = Σ_i w_i J_iᵀ M_i r_i, with J_i = ∂v_i/∂x and M_i = n_i n_iᵀ + τ I.

        Parameters
        ----------
        r, normals : (n, 3) arrays
        weights : (n,) array
        tangential : float
            τ.

        Returns
        -------
        H : (t + q, t + q) array
        g : (t + q,) array
        """
        n, t, q = len(r), len(self.joint), self.plain.shape[2]
        root = np.sqrt(weights)[:, None, None]
        arms, plain, normals = self.arms * root, self.plain * root, normals[:, :, None]
        pull = root * (normals * np.einsum("nac,na->nc", normals, r)[:, None] + tangential * r[:, :, None])
        along = sum(normals[:, a] * plain[:, a] for a in range(3))  # (n, q)
        H, g = np.empty((t + q, t + q)), np.empty(t + q)
        H[:t, :t] = self._of_turns(arms, normals, tangential)
        H[:t, t:] = self._turned(arms, normals * along[:, None] + tangential * plain)
        H[t:, :t] = H[:t, t:].T
        flat = plain.reshape(3 * n, q)
        H[t:, t:] = along.T @ along + tangential * (flat.T @ flat)
        g[:t], g[t:] = self._turned(arms, pull)[:, 0], flat.T @ pull.ravel()
        return H, g

    def _of_turns(self, arms, normals, tangential):
        """(t, t): Σ_i (ω_c × arm_i)ᵀ M_i (ω_d × arm_i) of the angles c and d."""
        n, _, j = arms.shape
        lean, flat = _crossed(arms, normals).reshape(n, 3 * j), arms.reshape(n, 3 * j)
        K, G = (lean.T @ lean).reshape(3, j, 3, j), (flat.T @ flat).reshape(3, j, 3, j)
        # (ω_c × x) · (ω_d × y) = (ω_c · ω_d)(x · y) − (ω_c · y)(ω_d · x)
        K -= tangential * G.transpose(2, 1, 0, 3)
        dots = tangential * (G[0, :, 0] + G[1, :, 1] + G[2, :, 2])
        for a in range(3):
            K[a, :, a] += dots
        return np.einsum("ac,acbd,bd->cd", self.omega, K[:, self.joint][..., self.joint], self.omega)

    def _turned(self, arms, f):
        """(t, k): Σ_i (ω_c × arm_i) · f_i of the angles c, for k fields f (n, 3, k)."""
        n, _, j, k = *arms.shape, f.shape[2]
        L = (arms.reshape(n, 3 * j).T @ f.reshape(n, 3 * k)).reshape(3, j, 3, k)
        torque = np.stack([L[b, :, c] - L[c, :, b] for _, b, c in _CROSS])  # Σ_i arm_i × f_i
        return np.einsum("ac,ack->ck", self.omega, torque[:, self.joint])


def vertex_motion(model, state, posed, rows, blocks, turning):
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
        Their columns come one after the other in the given order, but for the angles, in the order of
        ``np.argwhere(turning)``, which come first.
    turning : (J, 3) bool array
        The angles that are free.

    Returns
    -------
    VertexMotion
    """
    weights = model.weights_of(rows)
    plain = {
        "translation": lambda: np.broadcast_to(_I, (len(rows), 3, 3)),
        "scale": lambda: _scaled(state, posed, posed.vertices[rows]),
        "proportions": lambda: _family(model, posed, rows, weights),
    }
    turning = turning if "pose" in blocks else np.zeros_like(turning)
    columns = [plain[block]() for block in blocks if block != "pose"]
    columns = np.concatenate(columns, axis=2) if columns else np.empty((len(rows), 3, 0))
    return VertexMotion(*_turns(posed, weights, posed.rest[rows], turning), columns)


def joint_motion(state, posed, blocks, turning):
    """∂P/∂x of the posed joints.

    Parameters
    ----------
    state, posed, turning
        As for :func:`vertex_motion`.
    blocks : sequence of {"pose", "translation", "scale"}

    Returns
    -------
    VertexMotion
        Of J places.
    """
    n = len(posed.joints)
    plain = {"translation": np.broadcast_to(_I, (n, 3, 3)), "scale": _scaled(state, posed, posed.joints)}
    turning = turning if "pose" in blocks else np.zeros_like(turning)
    columns = np.concatenate([np.empty((n, 3, 0)), *(plain[block] for block in blocks if block != "pose")], axis=2)
    return VertexMotion(*_turns(posed, np.eye(n), posed.rest_joints, turning), columns)  # a joint hangs on itself alone


def _scaled(state, posed, places):
    """(k, 3, 1): ∂/∂scale of places of the posed template, the root joint of the template held."""
    rig = posed.rig
    return ((places - state.translation) / state.scale - rig.joints[rig.root])[:, :, None]


def _turns(posed, w, u, turning):
    """Arms, ω, and whose each angle is, of points (n, 3) of the rest pose with weights (n, J)."""
    rig, A = posed.rig, posed.A
    joint, axis = np.nonzero(turning)
    turned, of = np.unique(joint, return_inverse=True)
    shift = posed.unscaled_joints - (A @ posed.rest_joints[:, :, None])[:, :, 0]
    below = subtrees(rig.parents)[turned]
    hanging, at = w @ below.T, posed.unscaled_joints[turned]
    arms = np.empty((len(u), 3, len(turned)))
    for a in range(3):
        np.matmul((u @ A[:, a].T + shift[:, a]) * w, below.T, out=arms[:, a])
        arms[:, a] -= hanging * at[:, a]
    up = np.where((rig.parents >= 0)[:, None, None], A[rig.parents], _I)
    omega = posed.scale * (up @ left_jacobian(posed.omega) @ rig.frames)  # (J, 3, axis)
    return arms, omega[joint, :, axis].T, of


def _crossed(x, y):
    """(n, 3, k): x × y, along the second axis."""
    return np.stack([x[:, b] * y[:, c] - x[:, c] * y[:, b] for _, b, c in _CROSS], axis=1)


def _family(model, posed, rows, weights):
    """(n, 3, k): ∂/∂c of vertices, as they go with the blended rotation and with the joints that the family moves."""
    rig, A, k = posed.rig, posed.A, model.n_coefficients
    J = len(rig.parents)
    turn = posed.turns(rows)
    basis = model.basis.reshape(-1, 3, k)[rows]
    joints = model.joint_basis.reshape(J, 3, k)
    place = np.empty((J, 3, k))
    place[rig.root] = joints[rig.root]
    for level, up in rig.levels:
        place[level] = place[up] + np.einsum("jab,jbk->jak", A[up], joints[level] - joints[up])
    carried = (place - np.einsum("jab,jbk->jak", A, joints)).reshape(J, -1)
    return posed.scale * (turn @ basis + (weights @ carried).reshape(-1, 3, k))
