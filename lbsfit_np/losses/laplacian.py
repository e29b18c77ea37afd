"""Laplacian losses L_lap: smoothness of the registration (the paper's form) or of the offsets."""

import numpy as np
from scipy import sparse

from ..errors import InputError, as_array, check_real, check_unmasked
from ..triangles import binary_extent, face_areas
from .checks import check_flag, check_set

__all__ = ["cotangent_matrix", "laplacian_offsets", "laplacian_posed"]


def cotangent_matrix(vertices, faces):
    """The cotangent matrix K of a mesh, without mass weighting.

    K_ij = −½ (cot α_ij + cot β_ij) over the two angles opposite edge ij, K_ii = −Σ_j K_ij: symmetric, positive
    semidefinite, rows sum to 0. Faces without area contribute nothing.

    Parameters
    ----------
    vertices : (m, 3) array
    faces : (F, 3) int array

    Returns
    -------
    (m, m) sparse csr_array
        It has no unit, as cotangents do not change with scale.

    Raises
    ------
    InputError
        Wrong shapes, numbers that are not finite, faces out of range.
    """
    vertices, faces = check_set("vertices", vertices), _faces(faces, len(vertices))
    m, vertices = len(vertices), vertices / binary_extent(vertices)
    rows, cols, vals = [], [], []
    p = vertices[faces]
    area = face_areas(vertices, faces)
    longest = np.max([np.sum((p[:, (k + 1) % 3] - p[:, k]) ** 2, axis=1) for k in range(3)], axis=0)
    fine = area > 5e-13 * longest
    for k in range(3):
        i, j = faces[fine, (k + 1) % 3], faces[fine, (k + 2) % 3]
        a, b = p[fine, (k + 1) % 3] - p[fine, k], p[fine, (k + 2) % 3] - p[fine, k]
        half_cot = 0.25 * np.einsum("ij,ij->i", a, b) / area[fine]
        rows += [i, j, i, j]
        cols += [j, i, i, j]
        vals += [-half_cot, -half_cot, half_cot, half_cot]
    K = sparse.coo_array((np.concatenate(vals), (np.concatenate(rows), np.concatenate(cols))), shape=(m, m))
    return sparse.csr_array(K)


def laplacian_posed(Vd, K, *, squared=False):
    """L_lap = ‖K V^d‖_F, the paper's form.

    Parameters
    ----------
    Vd : (m, 3) array
        M(Θ, U^d).
    K : (m, m) sparse array
        :func:`cotangent_matrix` of the template U.
    squared : bool, default False
        ‖K V^d‖_F² instead.

    Returns
    -------
    value : float
        In units of V^d (squared units when ``squared``).
    grad : (m, 3) array
        ∂L_lap/∂V^d; 0 where the norm is 0.
    """
    return _norm("Vd", Vd, K, squared)


def laplacian_offsets(offsets, K, *, squared=False):
    """L_lap = ‖K (U^d − U)‖_F: the roughness of the offsets alone, which leaves the template's own features as they are.

    Parameters
    ----------
    offsets : (m, 3) array
        U^d − U.
    K, squared
        As in :func:`laplacian_posed`.

    Returns
    -------
    value : float
    grad : (m, 3) array
        ∂L_lap/∂offsets; 0 where the norm is 0.
    """
    return _norm("offsets", offsets, K, squared)


def _faces(faces, m):
    check_unmasked("faces", faces)
    faces = as_array("faces", faces, "integers of shape (F, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3 or (faces.dtype.kind not in "iu" and faces.size):
        raise InputError("faces", f"{faces.dtype} values of shape {faces.shape}", "integers of shape (F, 3)")
    if faces.size and (faces.min() < 0 or faces.max() >= m):
        raise InputError("faces", f"rows from {faces.min()} to {faces.max()}", f"rows of the {m} vertices, 0 to {m - 1}")
    return faces.astype(np.intp, copy=False)


def _norm(argument, Y, K, squared):
    Y, squared = check_set(argument, Y), check_flag("squared", squared)
    if getattr(K, "shape", None) != (len(Y), len(Y)):
        got = type(K).__name__ if not hasattr(K, "shape") else f"shape {K.shape}"
        raise InputError("K", got, f"shape ({len(Y)}, {len(Y)}), one row for each of the {len(Y)} vertices in {argument}")
    check_real("K", K, f"numbers of shape ({len(Y)}, {len(Y)})")
    KY = np.asarray(K @ Y)
    square = float(np.vdot(KY, KY))
    if not np.isfinite(square):
        raise InputError("K", f"a matrix whose product with {argument} is not finite", "finite numbers")
    if squared:
        return square, 2.0 * np.asarray(K.T @ KY)
    norm = float(np.sqrt(square))
    return norm, np.asarray(K.T @ KY) / norm if norm > 0 else np.zeros_like(Y)
