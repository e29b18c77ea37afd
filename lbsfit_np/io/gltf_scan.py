"""Scans in glTF files: everything that the default scene shows, where the scene shows it."""

import numpy as np

from .cloud import CloudData, column_role, set_labels
from .gltf_buffers import open_gltf
from .gltf_nodes import NodeGraph
from .gltf_primitives import POINTS, SURFACES, blended, corners, influences, inverse_binds, primitives, triangles

__all__ = ["read_gltf_scan"]

# How attributes begin that say how a vertex follows a skin.
_OF_SKINS = ("JOINTS_", "WEIGHTS_")


def read_gltf_scan(path):
    """Read the meshes and point primitives of a ``.glb`` or ``.gltf`` file, in the scene's frame: y up, metres.

    Nodes' transforms are applied, morph targets as the nodes weigh them, and skins in the pose that the nodes stand in. A mesh
    that the scene shows twice is there twice. Where primitives share their vertices, these come once; those that
    nothing shows are left out, as are lines. Normals and labels (an attribute ``_LABEL``) are kept where all primitives have
    them.

    Parameters
    ----------
    path : Path

    Returns
    -------
    CloudData
    """
    document = open_gltf(path)
    nodes = NodeGraph(document)
    pieces, notes = [], document.notes
    for i in nodes.shown():
        node = document.items("nodes")[i]
        if "mesh" in node:
            matrices = _skinning(document, nodes, document.integer(node, "skin", f"node {i}")) if "skin" in node else None
            pieces += _mesh(document, i, nodes.worlds[i], matrices, notes)
    notes += [note for p in pieces for note in p.notes]
    notes = [note.rstrip(".") + "." for note in dict.fromkeys(notes)]  # a mesh may be shown often
    if not pieces:
        return CloudData(np.empty((0, 3)), notes=notes)
    if len(pieces) == 1:  # as of most scans, which may be large: nothing to copy
        pieces[0].notes = notes
        return pieces[0]
    start = np.cumsum([0] + [len(p.points) for p in pieces])
    return CloudData(
        np.concatenate([p.points for p in pieces]),
        np.concatenate([p.faces + s for p, s in zip(pieces, start)]),
        None if any(p.normals is None for p in pieces) else np.concatenate([p.normals for p in pieces]),
        None if any(p.labels is None for p in pieces) else np.concatenate([p.labels for p in pieces]),
        notes,
    )


def _skinning(document, nodes, skin):
    """(J, 4, 4): world matrix times inverse bind matrix of each joint of a skin."""
    where = f"skin {skin}"
    item = document.item("skins", skin, where)
    joints = document.integers(item, "joints", where)
    for joint in joints:
        document.item("nodes", joint, f"joints of {where}")
    inverse = inverse_binds(document, item, [nodes.label(joint) for joint in joints], where)
    return nodes.worlds[joints] if inverse is None else nodes.worlds[joints] @ inverse


def _mesh(document, i, world, matrices, notes):
    """The mesh of node i: one piece per set of vertices, of those that are shown."""
    node, where = document.items("nodes")[i], f"node {i}"
    number = document.integer(node, "mesh", where)
    mesh, pieces = document.item("meshes", number, where), {}
    for where, primitive, mode, attributes in primitives(document, number, (POINTS, *SURFACES), ("POSITION",), notes):
        targets = document.objects(primitive, "targets", where)
        moved = [document.integer(t, "POSITION", f"target {j} of {where}", -1) for j, t in enumerate(targets)]
        skins = _OF_SKINS if matrices is not None else ()
        own = [name for name in sorted(attributes) if name == _label_of(attributes) or name.startswith(skins)]
        named = [(name, document.integer(attributes, name, where)) for name in own]
        key = document.integer(attributes, "POSITION", where), *moved, *named
        if key not in pieces:
            owner, of = (node, f"node {i}") if "weights" in node else (mesh, f"mesh {number}")
            weighed = _weighed(document, owner, of, targets, where, notes)
            pieces[key] = _Piece(document, attributes, weighed, world, matrices, where)
        pieces[key].show(document, primitive, mode, where, notes)
        if pieces[key].normals_of != document.integer(attributes, "NORMAL", where, -1) and pieces[key].cloud.normals is not None:
            pieces[key].cloud.normals = None
            notes.append(f"{where} has no normals, or others, than those before it at the same vertices: left out.")
    return [piece.shown() for piece in pieces.values()]


def _weighed(document, owner, of, targets, where, notes):
    """Pairs of a primitive's morph target and its weight, which the mesh or the node has."""
    given = owner.get("weights", [])
    if not targets or (isinstance(given, list) and not any(given)):  # however many there are, they change nothing
        return []
    n = len(targets)
    count = max(len(given), n) if isinstance(given, list) else n
    weights = document.numbers(owner, "weights", count, None, of)
    if any(weights[n:]):
        notes.append(f"{of} has {count} weights for the {n} morph target(s) of {where}: the last {count - n} left out")
    return list(zip(targets, weights))


def _label_of(attributes):
    """The name of the attribute that has the labels; None where none has."""
    return next((name for name in attributes if name.startswith("_") and column_role(name.strip("_")) == 6), None)


class _Piece:
    """The vertices of one set of positions, labels and weights, and which of them are shown."""

    def __init__(self, document, attributes, targets, world, matrices, where):
        points = _morphed(document, attributes, targets, "POSITION", where)
        linear, shift = _transforms(document, attributes, len(points), world, matrices, where)
        self.cloud = CloudData(_moved(points, linear, shift))
        self.normals_of = document.integer(attributes, "NORMAL", where, -1)
        self._seen, self._faces = np.zeros(len(points), dtype=bool), [np.empty((0, 3), dtype=int)]
        self._cofactors = np.cross(linear[..., [1, 2, 0], :], linear[..., [2, 0, 1], :])
        self._side = np.sign(np.einsum("...b,...b->...", linear[..., 0, :], self._cofactors[..., 0, :]))  # -1 where one mirrors
        if "NORMAL" in attributes:
            normals = _morphed(document, attributes, targets, "NORMAL", where)
            if len(normals) == len(points):
                self.cloud.normals = self._turned(normals)
        if (label := _label_of(attributes)) is not None:
            labels = document.data_of(attributes, label, where, ("SCALAR",), finite=False)
            if len(labels) == len(points):
                set_labels(self.cloud, label, labels)

    def show(self, document, primitive, mode, where, notes):
        """Take in what a primitive shows."""
        if mode == POINTS and "indices" not in primitive:  # as large clouds are
            self._seen[:] = True
            return
        rows = corners(document, primitive, len(self._seen), where)
        self._seen[rows] = True
        if mode != POINTS:
            faces = triangles(rows, mode, where, notes)
            mirrored = (self._side[faces].sum() if self._side.ndim else self._side) < 0  # corners then go the other way (3.7.4)
            self._faces.append(faces[:, ::-1] if mirrored else faces)

    def shown(self):
        """The CloudData of the vertices that are shown, in their order."""
        seen, cloud = self._seen, self.cloud
        cloud.faces = np.concatenate(self._faces)
        if not seen.all():
            number = np.cumsum(seen) - 1
            cloud.points, cloud.faces = cloud.points[seen], number[cloud.faces]
            cloud.normals = None if cloud.normals is None else cloud.normals[seen]
            cloud.labels = None if cloud.labels is None else cloud.labels[seen]
        return cloud

    def _turned(self, normals):
        """Normals go with the matrix of cofactors, which flattening does not upset, and mirroring turns over."""
        normals = _moved(normals, self._cofactors, 0.0) * np.where(self._side < 0, -1.0, 1.0)[..., None]
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(length > 0, length, 1.0)


def _moved(vectors, linear, shift):
    """Vectors (n, 3) in the scene: by one matrix, or by one each."""
    if linear.ndim == 3:
        moved = np.einsum("iab,ib->ia", linear, vectors)
    elif (linear == np.eye(3)).all():  # the only transform of most clouds, which may be large
        moved = vectors
    else:
        moved = vectors @ linear.T
    return moved + shift if np.any(shift) else moved


def _morphed(document, attributes, targets, name, where):
    """An attribute with what its morph targets add: pairs of a target and its weight. May have NaN, as in other formats."""
    values = document.data_of(attributes, name, where, ("VEC3",), finite=False)
    for k, (target, weight) in enumerate(targets):
        if weight and name in target:
            added = document.data_of(target, name, f"target {k} of {where}", ("VEC3",), finite=False)
            if len(added) != len(values):
                raise document.error(f"{len(added)} vertices in target {k} of {where}", f"{len(values)}, as it has itself")
            values = values + weight * added
    return values.astype(float, copy=False)


def _transforms(document, attributes, n, world, matrices, where):
    """What turns, and shifts, the vertices into the scene: (3, 3) and (3,), or (n, 3, 3) and (n, 3) for each its own."""
    if matrices is None or "JOINTS_0" not in attributes:
        return world[:3, :3], world[:3, 3]
    # A skinned mesh stands where its joints are, not where its node is.
    matrices = blended(influences(document, attributes, n, len(matrices), where), matrices, world)
    return matrices[:, :, :3], matrices[:, :, 3]
