"""Digests: what tells one rig from another, whatever file it came from and however its arrays are laid out."""

import hashlib

import numpy as np

__all__ = ["poses_digest", "rig_digest"]

# Arrays of whole numbers.
_ROWS = ("faces", "parents")


def rig_digest(rig):
    """Hex digest of geometry, weights, regressor, hierarchy, limits and parts."""
    h = hashlib.sha256()
    for name in ("vertices", "faces", "parents", "joints", "frames", "lower", "upper"):
        a = getattr(rig, name)
        h.update(_bytes(a if name in _ROWS else a.astype(float)))  # as files have it, whatever a rig was put together from
    for matrix in (rig.weights.copy(), rig.regressor.copy()):
        matrix.sum_duplicates()  # which sorts them, too: products of SciPy's leave entries in orders of its own
        entries = matrix.tocoo()
        h.update(_bytes(np.stack([entries.row, entries.col])) + _bytes(entries.data.astype(float)))
    h.update("\0".join(rig.joint_names + rig.parts).encode())
    h.update(rig.part_of_joint.astype(np.int64).tobytes())
    return h.hexdigest()


def poses_digest(poses):
    """Hex digest of natural poses, a mapping from names to angles, and of their order."""
    return hashlib.sha256(repr([(name, pose.tolist()) for name, pose in poses.items()]).encode()).hexdigest()


def _bytes(a):
    """An array's content, the same whatever its layout, its integer type and the sign of its zeros."""
    return np.ascontiguousarray(np.round(a, 12) + 0.0 if a.dtype.kind == "f" else a.astype(np.int64)).tobytes()
