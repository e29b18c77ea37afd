"""What rigs and scans both read of glTF meshes: which primitives are of use, their triangles, and how vertices follow a skin.

Sections named below are those of the glTF 2.0 specification.
"""

import re

import numpy as np
from scipy import sparse

__all__ = ["POINTS", "SURFACES", "TRIANGLES", "blended", "corners", "influences", "inverse_binds", "primitives", "triangles"]

# Modes of primitives; the last are those that have triangles.
POINTS = 0
TRIANGLES = 4
_STRIP, _FAN = 5, 6
SURFACES = (TRIANGLES, _STRIP, _FAN)
_OTHERS = {POINTS: "points", 1: "lines", 2: "lines in a loop", 3: "lines in a strip"}


def primitives(document, number, modes, needed, notes):
    """The primitives of a mesh that are of use.

    Parameters
    ----------
    document : Document
    number : int
        The mesh.
    modes : tuple of int
        Those that are of use: ``SURFACES``, with or without ``POINTS``.
    needed : tuple of str
        Attributes without which a primitive is of no use; POSITION among them.
    notes : list of str
        Gets what was left out.

    Returns
    -------
    list of (str, dict, int, dict)
        What errors call a primitive, the primitive, its mode, its attributes.
    """
    kept = []
    mesh = document.item("meshes", number, f"mesh {number}")
    for k, primitive in enumerate(document.objects(mesh, "primitives", f"mesh {number}")):
        where = f"primitive {k} of mesh {number}"
        mode = document.integer(primitive, "mode", where, TRIANGLES)
        attributes = document.object(primitive, "attributes", where)
        missing = [name for name in needed if name not in attributes]
        if mode not in modes:
            wanted = "triangles or points" if POINTS in modes else "triangles"
            notes.append(f"{where} left out: it holds {_OTHERS.get(mode, f'mode {mode}')}, not {wanted}")
        elif missing:
            notes.append(f"{where} left out: it has no {missing[0]}")
        else:
            document.refuse_compressed(primitive, where)
            kept.append((where, primitive, mode, attributes))
    return kept


def corners(document, primitive, m, where):
    """(k,) int: the vertices that a primitive of m vertices goes through, in order (3.7.2.1)."""
    if "indices" not in primitive:
        return np.arange(m)
    order = document.data_of(primitive, "indices", where, ("SCALAR",))
    if not document.is_integer(document.integer(primitive, "indices", where), where)[0] or (len(order) and order.min() < 0):
        raise document.error(f"indices of {where} that are not unsigned integers", "unsigned bytes, shorts or ints")
    if len(order) and order.max() >= m:
        raise document.error(f"index {order.max()} in {where}, which has {m} vertices", f"indices below {m}")
    return order


def triangles(order, mode, where, notes):
    """(F, 3) int: the triangles that corners are of, in one of the modes ``SURFACES`` (3.7.2.1)."""
    if mode == TRIANGLES:
        if len(order) % 3:
            notes.append(f"{where} has {len(order)} indices, not a multiple of 3: the last {len(order) % 3} left out")
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if mode == _FAN:
        return np.column_stack([order[1:-1], order[2:], np.full(len(order) - 2, order[0])])
    i = np.arange(len(order) - 2)
    return order[np.column_stack([i, i + 1 + i % 2, i + 2 - i % 2])]


def influences(document, attributes, m, n_joints, where):
    """(m, J) sparse csr_array: a primitive's weights as the file has them, a joint that a vertex names twice summed (3.7.3.1)."""
    rows, columns, values = [], [], []
    sets = sorted({int(k.split("_")[1]) for k in attributes if re.fullmatch(r"(JOINTS|WEIGHTS)_(0|[1-9]\d{0,3})", k)})
    for n in sets:
        pair = []
        for key in (f"JOINTS_{n}", f"WEIGHTS_{n}"):
            if key not in attributes:
                raise document.error(f"{where} without {key}", f"JOINTS_{n} and WEIGHTS_{n} together")
            data = document.data_of(attributes, key, where, ("VEC4",))
            if len(data) != m:
                raise document.error(f"{len(data)} elements of {key} for {m} vertices in {where}", "as many as vertices")
            integer, most = document.is_integer(document.integer(attributes, key, where), key)
            if key.startswith("JOINTS") and not integer:
                raise document.error(f"{key} of {where} that are not integers", "unsigned bytes or shorts")
            if key.startswith("WEIGHTS") and integer:
                data = data / float(most)
                document.notes.append(f"{key} of {where} are integers that are not marked as normalized: read as if they were")
            pair.append(data)
        used = pair[1] != 0.0  # a joint without weight may be any number
        bad = used & ((pair[0] < 0) | (pair[0] >= n_joints))
        if bad.any():
            v = int(np.flatnonzero(bad.any(axis=1))[0])
            raise document.error(
                f"JOINTS_{n} of {where} with joint {pair[0][bad][0]} at vertex {v}, where the skin has {n_joints}",
                f"joints below {n_joints}",
            )
        rows.append(np.nonzero(used)[0])
        columns.append(pair[0][used])
        values.append(pair[1][used])
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    weights = sparse.csr_array(sparse.coo_array(entries, shape=(m, n_joints)))
    weights.sum_duplicates()
    return weights


def inverse_binds(document, skin, labels, where):
    """(J, 4, 4): the inverse bind matrices of a skin whose joints are called ``labels``; None where it has none."""
    if "inverseBindMatrices" not in skin:
        return None
    index = document.integer(skin, "inverseBindMatrices", where)
    matrices = document.accessor(index, f"inverse bind matrices of {where}", ("MAT4",)).astype(float)
    if len(matrices) < len(labels):
        raise document.error(
            f"{len(matrices)} inverse bind matrices for the {len(labels)} joints of {where}", "one for each joint"
        )
    matrices = matrices[: len(labels)]
    off = np.abs(matrices[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1, initial=0.0)
    if (off > 1e-3).any():
        j = int(off.argmax())
        raise document.error(f"the inverse bind matrix of {labels[j]} with the last row {matrices[j, 3]}", "0 0 0 1")
    matrices[:, 3] = 0.0, 0.0, 0.0, 1.0
    return matrices


def blended(weights, skinning, otherwise):
    """Σ_j w_j S_j by the vertices' own weight sums, (m, 3, 4); ``otherwise``, a (4, 4) matrix, at vertices without weight."""
    sums = np.asarray(weights.sum(axis=1), dtype=float).ravel()
    matrices = (weights @ skinning[:, :3].reshape(len(skinning), 12)).reshape(-1, 3, 4)
    bare = ~(sums > 0)
    matrices /= np.where(bare, 1.0, sums)[:, None, None]
    matrices[bare] = otherwise[:3]
    return matrices
