"""The meshes of a glTF skin: primitives of triangles, with the joints and weights of their vertices."""

import re

import numpy as np
from scipy import sparse

from .gltf_primitives import SURFACES, TRIANGLES, corners, influences, primitives, triangles

__all__ = ["skinned_geometry"]


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
        for where, primitive, mode, attributes in primitives(document, mesh, SURFACES, ("POSITION", "JOINTS_0"), notes):
            morphs += bool(primitive.get("targets"))
            key = tuple(sorted((k, str(v)) for k, v in attributes.items() if re.fullmatch(r"POSITION|(JOINTS|WEIGHTS)_\d+", k)))
            if key not in blocks:  # primitives may share their vertices and differ in the faces only
                positions = document.data_of(attributes, "POSITION", where, ("VEC3",)).astype(float, copy=False)
                blocks[key] = at, positions, influences(document, attributes, len(positions), n_joints, where)
                at += len(positions)
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


def _faces(document, primitive, mode, m, where, notes):
    """(F, 3) triangles of a primitive, without those that use a vertex twice."""
    faces = triangles(corners(document, primitive, m, where), mode, where, notes)
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    if flat.any() and mode == TRIANGLES:  # strips have them on purpose
        notes.append(f"{int(flat.sum())} faces of {where} that use a vertex twice left out")
    return faces[~flat].astype(np.int64)
