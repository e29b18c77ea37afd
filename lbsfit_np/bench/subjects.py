"""Test subjects: changed templates that no training scan shares, made by another rule than the fit's own proportions.

The fit knows a length and a width for each bone (where it branches, widths with and without what hangs on it), and stretches with
the skinning weights. Here a subject has one length for each chain of joints (a finger, an arm) and one for what they hang on (a
palm, a trunk), and a thickness for each, by which the skin moves along its normals: a fit can come near such a template, and
never has it in its family.
"""

import hashlib

import numpy as np

from ..rig.chains import bones, chains
from ..triangles import area_vectors

__all__ = ["files_digest", "people_digest", "scans_digest", "subject"]

# Normals are means over balls of this many times the way that the skin goes along them.
_SMOOTH = 4.0
# Vertices whose neighbours are looked up at once.
_BLOCK = 1000


def subject(rig, rng, *, amount=0.12, thickness=0.12):
    """A changed template and its joints.

    The skin of each bone stretches along it by its chain's length, and the joints on it go with the skin: those of a chain by
    its own length, a chain's first one, such as a knuckle, by that of what it hangs on.

    Parameters
    ----------
    rig : Rig
    rng : numpy.random.Generator
    amount : float
        Largest relative change of each length, uniform.
    thickness : float
        Largest relative change of each chain's thickness, uniform; the skin moves along its normals by that share of its
        distance to the bone, at most 0.3 of the rig's size, and less where normals around it point elsewhere.

    Returns
    -------
    vertices : (m, 3) array
    joints : (J, 3) array
    """
    chain = chains(rig)
    lengths = 1 + amount * rng.uniform(-1, 1, chain.max() + 1)
    thick = thickness * rng.uniform(-1, 1, chain.max() + 1)
    w = rig.weights.toarray()
    along = _directions(rig, chain, w)
    J = rig.joints.copy()
    for level, up in rig.levels:
        for c, p in zip(level, up):
            bone = rig.joints[c] - rig.joints[p]
            J[c] = J[p] + bone + (lengths[chain[p]] - 1) * (bone @ along[p]) * along[p]
    U = np.zeros_like(rig.vertices)
    radius = np.zeros(len(U))
    for j in range(len(rig.parents)):
        rows = np.flatnonzero(w[:, j])
        arm = rig.vertices[rows] - rig.joints[j]
        reach = arm @ along[j]
        U[rows] += w[rows, j, None] * (J[j] + arm + (lengths[chain[j]] - 1) * reach[:, None] * along[j])
        across = np.linalg.norm(arm - reach[:, None] * along[j], axis=1)
        radius[rows] += w[rows, j] * thick[chain[j]] * np.minimum(across, 0.3 * rig.size)
    return U + radius[:, None] * _outwards(U, rig.faces, radius), J


def people_digest(rig):
    """Hex digest of the people that a rig has: results of others are not to be put with theirs."""
    return _digest(np.concatenate(subject(rig, np.random.default_rng(0))), rig)


def scans_digest(rig, scans):
    """Hex digest of some scans of a rig, by which it shows that scans are made as they were."""
    return _digest(np.concatenate([scan.points for scan in scans]), rig)


def files_digest(files):
    """Hex digest of what files hold, one after the other."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _digest(points, rig):
    return hashlib.sha256(((points / rig.size).round(6) + 0.0).tobytes()).hexdigest()


def _directions(rig, chain, weights):
    """(J, 3): unit vectors that the skin of each joint stretches along; 0 where nothing tells.

    Towards the chain's next joint; of its last one on from the joint before. Of what chains hang on, towards its skin's middle.
    """
    bone, along = bones(rig), np.zeros_like(rig.joints)
    inside = [c for c in np.flatnonzero(rig.moving) if c != rig.root and chain[c] == chain[rig.parents[c]]]
    following = {bone[rig.parents[c]]: c for c in inside}
    for j in np.concatenate([[rig.root], *(level for level, _ in rig.levels)]):
        p, rows, ways, after = rig.parents[j], np.flatnonzero(weights[:, j]), [], j
        while after in following:  # joints in one place have no bone between them
            after = following[after]
            ways.append(rig.joints[after] - rig.joints[j])
        if p >= 0 and chain[p] == chain[j]:
            ways += [rig.joints[j] - rig.joints[p], along[p]]
        elif len(rows):
            ways.append(rig.vertices[rows].mean(axis=0) - rig.joints[j])
        if p >= 0:
            ways.append(along[p])
        long = [way for way in ways if np.linalg.norm(way) > 1e-6 * rig.size]
        if long:
            along[j] = long[0] / np.linalg.norm(long[0])
    return along


def _outwards(vertices, faces, radius):
    """(m, 3): the skin's normals, each the mean over several times the way that the skin goes, so that lips do not cross."""
    from scipy.spatial import cKDTree

    tree, normals, reach = cKDTree(vertices), _normals(vertices, faces), _SMOOTH * np.abs(radius)
    out = np.empty_like(vertices)
    for begin in range(0, len(vertices), _BLOCK):  # neighbours of all vertices of a large mesh fill the memory
        block = slice(begin, begin + _BLOCK)
        near = tree.query_ball_point(vertices[block], reach[block], return_sorted=True)
        total = np.array([normals[rows].sum(axis=0) for rows in near])
        out[block] = total / np.array([np.linalg.norm(normals[rows], axis=1).sum() for rows in near])[:, None].clip(1e-300)
    return out


def _normals(vertices, faces):
    """(m, 3): each vertex's normal, as long as its faces are large."""
    face = area_vectors(vertices, faces)
    n = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(n, faces[:, k], face)
    return n
