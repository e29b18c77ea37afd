"""Welding: which vertices are one point of the surface, split only for texture coordinates or normals."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from .locked import locked
from .regressor import exact_regressor

__all__ = ["Weld", "proper", "weld_of", "weld_rig", "welded_as_before"]

# Seam copies are written from one float32 position; anything further apart than this share of the size is another point.
_POSITION = 1e-6
# Copies of one vertex carry the same skin; two sheets that touch (lips, a sleeve on an arm) do not, and stay apart.
_WEIGHT = 0.02


@dataclass(frozen=True)
class Weld:
    """The distinct vertices of a surface, and which of them each vertex is.

    Attributes
    ----------
    rows : (m,) int array
        The distinct vertex that each vertex is, or lies nearest to if it is loose; numbered in order of first appearance.
    first : (n,) int array
        The first of the vertices that each distinct one is.
    loose : (m,) bool array
        Vertices of no face, or only of faces with two corners at one point: nothing of the surface, which no scan shows.
    """

    rows: np.ndarray
    first: np.ndarray
    loose: np.ndarray

    def __setstate__(self, state):  # NumPy's pickles forget that arrays were locked
        self.__dict__.update({name: locked(value, copy=False) for name, value in state.items()})

    @property
    def numbers(self):
        """(m,) int: all of it in one array, ``rows`` and, of loose vertices, −1 − ``rows``."""
        return np.where(self.loose, -1 - self.rows, self.rows)

    @classmethod
    def from_numbers(cls, numbers):
        """The Weld of such an array; ValueError where it is none."""
        loose = numbers < 0
        rows, kept = np.where(loose, -1 - numbers, numbers).astype(int), np.flatnonzero(~loose)
        known, first = np.unique(rows[kept], return_index=True)
        if not np.array_equal(known, np.arange(len(known))) or (np.diff(first) < 0).any() or rows.max(initial=-1) >= len(known):
            raise ValueError("no numbers of distinct vertices in order of first appearance")
        return cls(*(locked(a, copy=False) for a in (rows, kept[first], loose)))


def welded_as_before(rig, **changes):
    """A rig with other values of fields, whose vertices and faces are the same ones in the same order: welded as ``rig`` is.

    Welded anew, a template on which two vertices have come together, or apart, would have other rows than what is known by the
    rig's own.
    """
    changed = replace(rig, **changes)
    changed.__dict__["_weld"] = rig._weld
    return changed


def weld_of(vertices, weights, faces):
    """The Weld of a mesh.

    Parameters
    ----------
    vertices : (m, 3) array
    weights : (m, J) sparse array
    faces : (F, 3) int array
        Where none of them is proper, no vertex is loose.
    """
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    # Of others there may be very many at one place, each a pair with each, or one that is far away.
    sound = faces[_with_corners_apart(vertices, faces)]
    used, faces = (np.unique(sound), sound) if len(sound) else (np.arange(len(vertices)), faces)
    size = max(float(np.ptp(vertices[used], axis=0).max()), np.finfo(float).tiny)
    pairs = used[cKDTree(vertices[used]).query_pairs(_POSITION * size, output_type="ndarray")]
    if len(pairs):
        apart = abs(weights[pairs[:, 0]] - weights[pairs[:, 1]]).sum(axis=1)
        pairs = pairs[np.asarray(apart).ravel() <= _WEIGHT]
    m = len(vertices)
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(m, m))
    _, group = connected_components(graph, directed=False)
    corners = group[faces]
    corners = corners[proper(corners)]
    loose = ~np.isin(group, corners) if len(corners) else np.zeros(m, dtype=bool)
    kept = np.flatnonzero(~loose)
    _, first, inverse = np.unique(group[kept], return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=int)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    rows, first = np.empty(m, dtype=int), kept[np.sort(first)]
    rows[kept] = rank[inverse]
    if len(kept) < m:  # they move with what is nearest
        rows[loose] = cKDTree(vertices[first]).query(vertices[loose])[1]
    return Weld(*(locked(a, copy=False) for a in (rows, first, loose)))


def weld_rig(rig):
    """A rig on the distinct vertices of the surface of ``rig``: faces renumbered, degenerate ones dropped.

    Of copies it has the first one's weights: with others, such as their mean, another joint might lead, and a part be lost.
    """
    weld, m, n = rig._weld, len(rig.vertices), len(rig.welded_from)
    faces = weld.rows[rig.faces]
    sound = proper(faces)
    if n == m:
        return rig if sound.all() else _distinct(replace(rig, faces=faces[sound]))
    member = sparse.csr_array((np.ones(m), (weld.rows, np.arange(m))), shape=(n, m))
    regressor = sparse.csr_array(rig.regressor @ sparse.csr_array(member.T))
    welded = replace(
        rig,
        vertices=rig.vertices[weld.first],
        faces=faces[sound],
        weights=rig.weights[weld.first],
        regressor=exact_regressor(regressor, rig.vertices[weld.first], rig.joints) if weld.loose.any() else regressor,
        shapes=None if rig.shapes is None else replace(rig.shapes, vertices=rig.shapes.vertices[:, weld.first]),
    )
    return _distinct(welded)


def _distinct(welded):
    """A welded rig that knows that its vertices are distinct, also where those of a changed template have come together."""
    m = len(welded.vertices)
    rows = locked(np.arange(m), copy=False)
    welded.__dict__["_weld"] = Weld(rows, rows, locked(np.zeros(m, dtype=bool), copy=False))
    return welded


def _with_corners_apart(vertices, faces):
    """(F,) bool: the faces with three corners that differ, at three places."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return proper(faces) & ~((a == b).all(axis=1) | (b == c).all(axis=1) | (c == a).all(axis=1))


def proper(faces):
    """(F,) bool: the faces with three corners that differ."""
    return (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
