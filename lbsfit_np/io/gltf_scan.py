"""Scans in glTF files: everything that the default scene shows, where the scene shows it."""

import numpy as np

from .cloud import CloudData, column_role, set_labels
from .gltf_buffers import open_gltf
from .gltf_nodes import NodeGraph

__all__ = ["read_gltf_scan"]

_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6


def read_gltf_scan(path):
    """Read the meshes and point primitives of a ``.glb`` or ``.gltf`` file, in the scene's frame: y up, metres.

    Nodes' transforms are applied, and skins in the pose that the nodes stand in. A mesh that the scene shows twice is there
    twice. Where primitives share their positions, the vertices come once. Lines are left out. Normals and labels (an
    attribute ``_LABEL``) are kept where all primitives have them.

    Parameters
    ----------
    path : Path

    Returns
    -------
    CloudData
    """
    document = open_gltf(path)
    nodes = NodeGraph(document)
    pieces, notes = [], list(document.notes)
    for i in _shown(document, nodes):
        node = document.items("nodes")[i]
        if "mesh" in node:
            mesh = document.integer(node, "mesh", f"node {i}")
            matrices = _skinning(document, nodes, document.integer(node, "skin", f"node {i}")) if "skin" in node else None
            pieces += _mesh(document, mesh, nodes.worlds[i], matrices, notes)
    if not pieces:
        return CloudData(np.empty((0, 3)), notes=notes)
    notes += [note for p in pieces for note in p.notes]
    start = np.cumsum([0] + [len(p.points) for p in pieces])
    return CloudData(
        np.concatenate([p.points for p in pieces]),
        np.concatenate([p.faces + s for p, s in zip(pieces, start)]),
        None if any(p.normals is None for p in pieces) else np.concatenate([p.normals for p in pieces]),
        None if any(p.labels is None for p in pieces) else np.concatenate([p.labels for p in pieces]),
        notes,
    )


def _shown(document, nodes):
    """The nodes of the default scene (the first, where none is the default; all nodes, where there are no scenes)."""
    scenes = document.items("scenes")
    if not scenes:
        return range(len(nodes.parents))
    scene = document.item("scenes", document.integer(document.root, "scene", "the file", 0), "the file")
    roots = set(document.integers(scene, "nodes", "the scene"))
    return [i for i in range(len(nodes.parents)) if i in roots or roots.intersection(nodes.ancestors(i))]


def _skinning(document, nodes, skin):
    """(J, 4, 4): world matrix times inverse bind matrix of each joint of a skin."""
    where = f"skin {skin}"
    item = document.item("skins", skin, where)
    joints = document.integers(item, "joints", where)
    for joint in joints:
        document.item("nodes", joint, where)
    worlds = nodes.worlds[joints]
    if "inverseBindMatrices" not in item:
        return worlds
    inverse = document.accessor(document.integer(item, "inverseBindMatrices", where), where, ("MAT4",))
    if len(inverse) < len(joints):
        raise document.error(f"{len(inverse)} inverse bind matrices for the {len(joints)} joints of {where}", "one per joint")
    return worlds @ inverse[: len(joints)]


def _mesh(document, mesh, world, matrices, notes):
    """One piece per set of positions of a mesh."""
    pieces = {}
    primitives = document.objects(document.item("meshes", mesh, "a node"), "primitives", f"mesh {mesh}")
    for k, primitive in enumerate(primitives):
        where = f"primitive {k} of mesh {mesh}"
        mode = document.integer(primitive, "mode", where, _TRIANGLES)
        if mode not in (_POINTS, _TRIANGLES, _STRIP, _FAN):
            notes.append(f"{where} is made of lines: left out.")
            continue
        document.refuse_compressed(primitive, where)
        attributes = document.object(primitive, "attributes", where)
        key = document.integer(attributes, "POSITION", where)
        if key not in pieces:
            pieces[key] = _vertices(document, attributes, key, world, matrices, where)
        piece = pieces[key]
        if mode == _POINTS:
            continue
        rows = np.arange(len(piece.points))
        if "indices" in primitive:
            rows = document.accessor(document.integer(primitive, "indices", where), where, ("SCALAR",))
            if len(rows) and rows.max() >= len(piece.points):
                raise document.error(f"index {rows.max()} in {where}", f"indices below its {len(piece.points)} vertices")
        piece.faces = np.concatenate([piece.faces, _triangles(rows, mode)])
    return list(pieces.values())


def _vertices(document, attributes, position, world, matrices, where):
    points = document.accessor(position, where, ("VEC3",)).astype(float)
    n = len(points)
    linear, shift = np.broadcast_to(world[:3, :3], (n, 3, 3)), world[:3, 3]
    if matrices is not None and "JOINTS_0" in attributes:  # a skinned mesh stands where its joints are, not where its node is
        blended, total = np.zeros((n, 3, 4)), np.zeros(n)
        level = 0
        while f"JOINTS_{level}" in attributes and f"WEIGHTS_{level}" in attributes:
            joints = document.accessor(document.integer(attributes, f"JOINTS_{level}", where), where, ("VEC4",)).astype(int)
            weights = document.accessor(document.integer(attributes, f"WEIGHTS_{level}", where), where, ("VEC4",))
            if joints.shape != (n, 4) or weights.shape != (n, 4) or (n and joints.max() >= len(matrices)):
                raise document.error(f"joints or weights of {where} that do not fit", f"{n} rows of joints below {len(matrices)}")
            for c in range(4):
                blended += weights[:, c, None, None] * matrices[joints[:, c], :3]
                total += weights[:, c]
            level += 1
        bare = total <= 0
        blended[~bare] /= total[~bare, None, None]
        blended[bare] = world[:3]
        linear, shift = blended[:, :, :3], blended[:, :, 3]
    piece = CloudData(np.einsum("iab,ib->ia", linear, points) + shift, np.empty((0, 3), dtype=int))
    if "NORMAL" in attributes:
        normals = document.accessor(document.integer(attributes, "NORMAL", where), where, ("VEC3",)).astype(float)
        if len(normals) == n:
            piece.normals = _turned(normals, linear)
    label = next((name for name in attributes if name.startswith("_") and column_role(name.strip("_")) == 6), None)
    if label is not None:
        labels = document.accessor(document.integer(attributes, label, where), where, ("SCALAR",))
        if len(labels) == n:
            set_labels(piece, label, labels)
    return piece


def _turned(normals, linear):
    """Normals go with the matrix of cofactors, which a mirroring or flattening transform does not upset."""
    cofactors = np.cross(linear[:, [1, 2, 0]], linear[:, [2, 0, 1]])
    normals = np.einsum("iab,ib->ia", cofactors, normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def _triangles(rows, mode):
    if mode == _TRIANGLES:
        return rows[: len(rows) // 3 * 3].reshape(-1, 3)
    k = np.arange(max(len(rows) - 2, 0))
    if mode == _FAN:
        return np.stack([rows[np.zeros_like(k)] if len(k) else rows[:0], rows[k + 1], rows[k + 2]], axis=1)
    return np.stack([rows[k], rows[k + 1 + k % 2], rows[k + 2 - k % 2]], axis=1)
