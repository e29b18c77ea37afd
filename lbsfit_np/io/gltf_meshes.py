"""The meshes of a glTF skin: primitives of triangles, with the joints and weights of their vertices.

Sections named below are those of the glTF 2.0 specification.
"""

import re

import numpy as np
from scipy import sparse

__all__ = ["skinned_geometry"]

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_MODES = {0: "points", 1: "lines", 2: "a line loop", 3: "a line strip"}


def skinned_geometry(document, mesh_nodes, n_joints, graph, notes):
    """Vertices, faces and weights of all the triangle primitives on a skin, one after the other.

    Parameters
    ----------
    document : Document
    mesh_nodes : list of int
        The nodes that hold a mesh on the skin. A mesh that several of them hold counts once.
    n_joints : int
    graph : NodeGraph
        For the nodes' names.
    notes : list of str
        Gets what was left out or mended.

    Returns
    -------
    vertices : (m, 3) array
        In bind space; vertices that primitives share are there once.
    faces : (F, 3) int array
    weights : (m, J) sparse csr_array
        As the file has them, a joint that a vertex names twice summed.
    """
    blocks, at, faces, morphs, done = {}, 0, [], 0, set()
    for i in mesh_nodes:
        mesh = document.integer(document.items("nodes")[i], "mesh", f"node {i}")
        if mesh in done:
            notes.append(f"node {graph.label(i)} shows a mesh of the skin again: left out")
            continue
        done.add(mesh)
        for p, primitive in enumerate(document.objects(document.items("meshes")[mesh], "primitives", f"mesh {mesh}")):
            where = f"primitive {p} of mesh {mesh}"
            mode = document.integer(primitive, "mode", where, _TRIANGLES)
            attributes = document.object(primitive, "attributes", where)
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                notes.append(f"{where} left out: it holds {_MODES.get(mode, f'mode {mode}')}, not triangles")
                continue
            if "POSITION" not in attributes or "JOINTS_0" not in attributes:
                notes.append(f"{where} left out: it has no {'POSITION' if 'POSITION' not in attributes else 'JOINTS_0'}")
                continue
            morphs += bool(primitive.get("targets"))
            key = tuple(sorted((k, str(v)) for k, v in attributes.items() if re.fullmatch(r"POSITION|(JOINTS|WEIGHTS)_\d+", k)))
            if key not in blocks:  # primitives may share their vertices and differ in the faces only
                blocks[key] = at, *_vertices(document, primitive, attributes, n_joints, where)
                at += len(blocks[key][1])
            first, vertices = blocks[key][:2]
            faces.append(first + _faces(document, primitive, mode, len(vertices), where, notes))
    if morphs:
        notes.append(f"morph targets of {morphs} primitive(s) left out: the rig has the shape without them")
    if not sum(map(len, faces)):
        raise document.error(
            "no triangles with joints and weights on the skin",
            "a skinned triangle mesh",
            "Export the skinned mesh with the armature.",
        )
    vertices = np.concatenate([b[1] for b in blocks.values()])
    weights = sparse.csr_array(sparse.vstack([b[2] for b in blocks.values()]))
    faces = np.concatenate(faces)
    idle = len(vertices) - len(np.unique(faces))
    if idle:
        notes.append(f"{idle} vertices belong to no face")
    return vertices, faces, weights


def _vertices(document, primitive, attributes, n_joints, where):
    document.refuse_compressed(primitive, where)
    positions = document.accessor(document.integer(attributes, "POSITION", where), f"POSITION of {where}", ("VEC3",)).astype(
        float
    )
    m = len(positions)
    rows, columns, values = [], [], []
    sets = sorted({int(k.split("_")[1]) for k in attributes if re.fullmatch(r"(JOINTS|WEIGHTS)_(0|[1-9]\d{0,3})", k)})
    for n in sets:
        pair = []
        for key in (f"JOINTS_{n}", f"WEIGHTS_{n}"):
            if key not in attributes:
                raise document.error(f"{where} without {key}", f"JOINTS_{n} and WEIGHTS_{n} together")
            index = document.integer(attributes, key, where)
            data = document.accessor(index, f"{key} of {where}", ("VEC4",))
            if len(data) != m:
                raise document.error(f"{len(data)} elements of {key} for {m} vertices in {where}", "as many as vertices")
            integer, most = document.is_integer(index, key)
            if key.startswith("JOINTS") and not integer:
                raise document.error(f"{key} of {where} that are not integers", "unsigned bytes or shorts")
            if key.startswith("WEIGHTS") and integer:
                data = data / float(most)
                document.notes.append(f"{key} of {where} are integers that are not marked as normalized: read as if they were")
            pair.append(data)
        used = pair[1] != 0.0
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
    weights = sparse.csr_array(sparse.coo_array(entries, shape=(m, n_joints)))  # a joint named twice at a vertex: summed
    weights.sum_duplicates()
    return positions, weights


def _faces(document, primitive, mode, m, where, notes):
    """(F, 3) triangles of a primitive (3.7.2.1)."""
    if "indices" in primitive:
        index = document.integer(primitive, "indices", where)
        order = document.accessor(index, f"indices of {where}", ("SCALAR",))
        if not document.is_integer(index, where)[0] or (len(order) and order.min() < 0):
            raise document.error(f"indices of {where} that are not unsigned integers", "unsigned bytes, shorts or ints")
        if len(order) and order.max() >= m:
            raise document.error(f"index {order.max()} in {where}, which has {m} vertices", f"indices below {m}")
    else:
        order = np.arange(m)
    if mode == _TRIANGLES:
        if len(order) % 3:
            notes.append(f"{where} has {len(order)} indices, not a multiple of 3: the last {len(order) % 3} left out")
        faces = order[: len(order) // 3 * 3].reshape(-1, 3)
    elif len(order) < 3:
        faces = np.zeros((0, 3), dtype=np.int64)
    elif mode == _FAN:
        faces = np.column_stack([order[1:-1], order[2:], np.full(len(order) - 2, order[0])])
    else:
        i = np.arange(len(order) - 2)
        faces = order[np.column_stack([i, i + 1 + i % 2, i + 2 - i % 2])]
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    if flat.any() and mode == _TRIANGLES:  # strips have them on purpose
        notes.append(f"{int(flat.sum())} faces of {where} that use a vertex twice left out")
    return faces[~flat].astype(np.int64)
