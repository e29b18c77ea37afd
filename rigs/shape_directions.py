"""Shape directions of a rig by carrying its mesh onto other people's implicit surfaces. Build time only.

Two surfaces of the same anatomy with a parameter a little up and a little down are each reached by the same mesh: first the
bones take their skin along and stretch it between their ends, then Newton steps put every vertex onto the surface, and
smoothing the field of displacements along the surface keeps the triangles' proportions. Half the difference is the direction.
"""

import numpy as np
from scipy import sparse

from .implicit import gradient, project

__all__ = ["carried", "shape_direction", "stretched"]


def shape_direction(vertices, faces, weights, bones, owner, change, *, step, rounds=6, fixed_plane=False):
    """Change of vertices and joints for one unit of a parameter: a central difference.

    Parameters
    ----------
    vertices, faces : (m, 3), (F, 3)
        The mesh at the parameter's default; its vertices lie on the surface.
    weights : (m, J) sparse or dense array
        Skinning weights.
    bones : (B, 2) array of int
        Rows of the joints at the two ends of the bones that stretch their skin.
    owner : (B,) array of int
        The joint whose skin each bone stretches, at most one bone a joint.
    change : callable
        Change of the parameter → (shape, joints (J, 3)), the surface and joints of that person.
    step : float
        How far the parameter is changed to both sides, in its unit.
    rounds, fixed_plane
        As for :func:`carried`.

    Returns
    -------
    directions : (m, 3) array
    joints : (J, 3) array
    """
    base = change(0.0)[1]
    ends = []
    for amount in (step, -step):
        shape, joints = change(amount)
        start = stretched(vertices, weights, base, joints, bones, owner)
        moved = carried(vertices, faces, shape, start, rounds=rounds, fixed_plane=fixed_plane)
        ends.append((moved, joints))
    (up, joints_up), (down, joints_down) = ends
    return (up - down) / (2 * step), (joints_up - joints_down) / (2 * step)


def stretched(vertices, weights, joints, moved, bones, owner):
    """Vertices that follow joints to new places without turning, stretched along each bone between its ends.

    Parameters
    ----------
    vertices : (m, 3) array
    weights : (m, J) sparse or dense array
    joints, moved : (J, 3) arrays
    bones, owner
        As for :func:`shape_direction`.

    Returns
    -------
    (m, 3) array
    """
    W = weights.toarray() if sparse.issparse(weights) else np.asarray(weights)
    shift = moved - joints
    along = np.broadcast_to(shift, (len(vertices), *shift.shape)).copy()  # of every vertex, were it led by one joint alone
    for (a, b), j in zip(bones, owner):
        axis = joints[b] - joints[a]
        t = np.clip((vertices - joints[a]) @ axis / (axis @ axis), 0, 1)
        along[:, j] = shift[a] + t[:, None] * (shift[b] - shift[a])
    return vertices + np.einsum("mj,mjk->mk", W, along)


def carried(vertices, faces, shape, start, *, rounds=6, fixed_plane=False, longest=0.01):
    """The mesh on another surface, with its triangles' proportions kept.

    Parameters
    ----------
    vertices, faces : (m, 3), (F, 3)
    shape : callable
        Signed distance of the other surface, see :mod:`rigs.implicit`.
    start : (m, 3) array
        First guess of where the vertices are on it.
    rounds : int, default 6
        Of smoothing and projecting.
    fixed_plane : bool, default False
        Vertices with x = 0 stay in that plane, in which the shape is symmetric.
    longest : float, default 0.01
        Of a Newton step, metres.

    Returns
    -------
    (m, 3) array
        On the zero level of ``shape``.
    """
    middle = np.flatnonzero(vertices[:, 0] == 0) if fixed_plane else np.empty(0, dtype=int)
    mean = _neighbour_mean(faces, len(vertices))

    def put(points, newton):
        points = project(shape, points, rounds=newton, longest=longest)
        points[middle, 0] = 0.0
        return points

    points = put(start, 4)
    for k in range(rounds):
        field = points - vertices
        change = mean @ field - field
        normal = gradient(shape, points)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        change -= (change * normal).sum(axis=1, keepdims=True) * normal
        points = put(points + 0.7 * change, 1 if k < rounds - 1 else 3)
    return points


def _neighbour_mean(faces, n):
    """(n, n) csr_array: the mean over a vertex's neighbours."""
    i, j = faces[:, [0, 1, 2, 1, 2, 0]].ravel(), faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    A = sparse.csr_array((np.ones(len(i)), (i, j)), shape=(n, n))
    A.data[:] = 1.0
    return sparse.csr_array(sparse.diags_array(1 / np.asarray(A.sum(axis=1)).ravel()) @ A)
