"""What makes the differences of a displacement between neighbouring vertices small: cotangents, and edges where these fail."""

import numpy as np
from scipy import sparse

from ..losses.laplacian import cotangent_matrix
from ..triangles import no_slivers

__all__ = ["differences", "smoothness_matrix"]

# Of the edges of a sliver; an edge between two equilateral triangles has 0.58.
_SLIVERS_EDGE = 0.5


def smoothness_matrix(vertices, faces):
    """K of L_lap: the cotangent matrix, in which slivers hold their corners together by edges.

    Their cotangents are rounding's as much as the mesh's, and so large that they would rule whatever they are part of.

    Parameters
    ----------
    vertices : (m, 3) array
    faces : (F, 3) int array

    Returns
    -------
    (m, m) sparse csr_array
        :func:`~lbsfit_np.losses.cotangent_matrix` of a mesh without slivers (``triangles.no_slivers``).
    """
    fine = no_slivers(vertices, faces)
    K = cotangent_matrix(vertices, faces[fine])
    if fine.all():
        return K
    others = faces[~fine]
    return sparse.csr_array(K + _SLIVERS_EDGE * differences(others.ravel(), np.roll(others, -1, axis=1).ravel(), len(vertices)))


def differences(i, j, m):
    """(m, m) sparse: the matrix of Σ (u_i − u_j)² over pairs of vertices i, j (k,)."""
    of, ones = np.arange(len(i)), np.ones(len(i))
    E = sparse.csr_array((np.r_[ones, -ones], (np.r_[of, of], np.r_[i, j])), shape=(len(i), m))
    return sparse.csc_array(E.T @ E)
