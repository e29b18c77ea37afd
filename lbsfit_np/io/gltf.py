"""glTF 2.0 rigs: the scene's skin, its meshes and joints as RigData.

The rest pose is the bind pose, which the inverse bind matrices define: the pose that the nodes happen to stand in may be
any other. Vertices, joints and frames come in the scene's frame (y up, z forward, metres) where the node graph says how bind
space lies in it, else in bind space with up and forward unknown; ``gltf_frame`` explains how that is told. The vertex
positions themselves are never scaled to a plausible size: a fox of 155 metres stays one until a card says otherwise.

A joint's rest frame is the rotation of its bind matrix (the inverse of the inverse bind matrix, placed like the mesh), scale
taken away. Where that matrix mirrors, all three axes are reversed: the axes are then right-handed again, and a rotation of
the joint's node has the same rotation vector in them as in the file.

A skin without inverse bind matrices has identities instead (3.7.3.1), by which every joint would rest at one point. Such meshes
are stored per joint and put together by the nodes only: unless the nodes do stand at one point, their pose is the rest pose.

Θ of an animation's frame follows from the joints' skinning matrices in the rig's frame, D_j = W_j B_j: A_j is the rotation
nearest to D_j, and exp([F_j θ_j]×) = A_parent(j)ᵀ A_j, so nodes between joints and above the root are accounted for. Angles are
in [0, π]. Translations and scales of joints cannot be kept and are noted.

Left alone, with a note: meshes without a skin (props), morph targets, points and lines. Sections named in comments are those
of the glTF 2.0 specification.
"""

from pathlib import Path

import numpy as np

from ..errors import InputError, brief, from_digits, is_whole, listed
from ..rig.data import RigData
from ..rotations import rotvec_from_matrix
from .gltf_buffers import open_gltf
from .gltf_frame import SCENE, blend, flattening, nearest_rotations, place
from .gltf_meshes import skinned_geometry
from .gltf_nodes import NodeGraph
from .gltf_primitives import inverse_binds

__all__ = ["read_gltf"]

_MOST_FRAMES = 500  # of animation, per file: plenty for limits and for a prior of poses


def read_gltf(path, *, skin=None):
    """Read a rig from a glTF 2.0 file.

    Parameters
    ----------
    path : str or path-like
        A ``.glb`` or ``.gltf`` file; buffers inside, in data URIs, or in files beside it.
    skin : str or int, optional
        Name or index of the skin, where meshes use several. Default: the one that is used.

    Returns
    -------
    RigData
        Vertices of all the meshes on the skin, one after the other in the order of their nodes and primitives; joints in the
        skin's order; no limits; ``animated`` where animations move joints.

    Raises
    ------
    FileError
        A file that is missing, damaged, compressed, or without a skinned triangle mesh.
    InputError
        ``skin`` names no skin that a mesh uses, or is missing where several are used.
    """
    document = open_gltf(path)
    graph = NodeGraph(document)
    notes = document.notes
    index, mesh_nodes = _choose_skin(document, graph, skin, notes)
    item, where = document.items("skins")[index], f"skin {index}"
    joints = _joint_nodes(document, item, where)
    names = _joint_names(graph, joints, notes)
    parents = _joint_parents(graph, joints)

    vertices, faces, weights = skinned_geometry(document, mesh_nodes, len(joints), graph, notes)
    inverse_bind = inverse_binds(document, item, [repr(name) for name in names], where)
    worlds = graph.worlds[joints]
    if inverse_bind is None:
        inverse_bind = np.tile(np.eye(4), (len(joints), 1, 1))
        if not np.allclose(worlds, worlds[0], atol=1e-6 * max(np.abs(worlds).max(), 1.0)):
            vertices, inverse_bind = blend(vertices, weights, worlds), _inverted(document, worlds, names, "world matrix")
            notes.append("the skin has no inverse bind matrices: the pose of the nodes is taken as the rest pose")

    roots = np.flatnonzero(parents < 0)
    candidates = _bind_space_candidates(graph, [joints[r] for r in roots], set(joints), mesh_nodes)
    placement = place(vertices, weights, worlds @ inverse_bind, names, roots, candidates)
    notes.extend(placement.notes)
    if np.linalg.det(placement.rig_T_bind[:3, :3]) < 0:
        faces = faces[:, ::-1]
    bind = placement.rig_T_bind @ _inverted(document, inverse_bind, names, "inverse bind matrix")
    mirrored = np.where(np.linalg.det(bind[:, :3, :3]) < 0, -1.0, 1.0)
    frames = nearest_rotations(mirrored[:, None, None] * bind[:, :3, :3])
    rest = bind[:, :3, 3]
    placed = vertices @ placement.rig_T_bind[:3, :3].T + placement.rig_T_bind[:3, 3]
    animated = None
    posed = graph.animated_worlds(joints, _MOST_FRAMES)
    if posed is not None:
        to_bind = inverse_bind @ np.linalg.inv(placement.rig_T_bind)
        moved = placement.rig_T_scene @ posed @ to_bind
        animated = _angles(moved, parents, frames)
        notes.extend(_unkept(moved, parents, rest, names, float(np.ptp(placed, axis=0).max())))
    return RigData(
        name=Path(path).stem,
        vertices=placed,
        faces=np.ascontiguousarray(faces),
        weights=weights,
        joint_names=names,
        parents=parents,
        joints=rest.copy(),
        frames=frames,
        animated=animated,
        metres_per_unit=placement.metres_per_unit,
        up="+y" if placement.known else None,
        forward="+z" if placement.known else None,
        notes=list(notes),
        path=Path(path),
    )


# ---- the skin and its joints ----


def _choose_skin(document, graph, wanted, notes):
    """Index of the skin, and the nodes that hold a mesh on it."""
    skins, nodes = document.items("skins"), document.items("nodes")
    users, props = {}, []
    for i, node in enumerate(nodes):
        if "mesh" not in node:
            continue
        document.item("meshes", document.integer(node, "mesh", f"node {i}"), f"mesh of node {i}")
        if "skin" in node:
            s = document.integer(node, "skin", f"node {i}")
            document.item("skins", s, f"skin of node {i}")
            users.setdefault(s, []).append(i)
        else:
            props.append(graph.label(i))
    if not users:
        found = f"{len(skins)} skins that no mesh uses" if skins else "no skin"
        raise document.error(
            found, "a mesh with a skin", "Export the rig with its armature and skinning; a plain mesh is a scan, not a rig."
        )
    shown = set(graph.shown())
    in_scene = {s: kept for s, on_it in users.items() if (kept := [i for i in on_it if i in shown])}
    # One outside the scene has to be asked for, unless there is nothing else.
    offered = users if wanted is not None else in_scene or users
    named = {s: document.name(skins[s], f"skin {s}") for s in offered}
    choices = ", ".join(f"{s} ({name!r})" for s, name in sorted(named.items()))
    index = _skin_index(document, wanted, named, choices, skins)
    mesh_nodes = in_scene.get(index, users[index])
    if len(offered) > 1:
        notes.append(f"meshes of the file use several skins: {choices}; this rig uses skin {index}")
    if props:
        notes.append(f"{len(props)} mesh(es) without a skin left out: {listed(props, 5)}")
    others = users[index] if wanted is not None else [i for on_it in users.values() for i in on_it]
    hidden = [graph.label(i) for i in sorted(set(others) - set(mesh_nodes))]
    if hidden:
        notes.append(f"{len(hidden)} skinned mesh(es) outside the file's scene left out: {listed(hidden, 5)}")
    return index, mesh_nodes


def _skin_index(document, wanted, named, choices, skins):
    if wanted is None:
        if len(named) > 1:
            got = f"no choice, but meshes of {document.path} use several"
            raise InputError("skin", got, f"one of {choices}", "Choose one with skin (--skin).")
        return next(iter(named))
    if isinstance(wanted, str):
        matching = [s for s, name in named.items() if name == wanted]
        if len(matching) > 1:
            raise InputError("skin", f"{wanted!r}, the name of {len(matching)} skins", f"one of {choices}", "Give its index.")
        if matching:
            return matching[0]
        if (number := from_digits(wanted)) in named:
            return number
    elif is_whole(wanted) and int(wanted) in named:
        return int(wanted)
    unused = [document.name(s, f"skin {i}") for i, s in enumerate(skins) if i not in named]
    also = f" No mesh uses {listed([repr(u) for u in unused], 5)}." if unused else ""
    raise InputError(
        "skin", brief(wanted), f"a skin that meshes of {document.path} use: {choices}", "Give its name or index." + also
    )


def _joint_nodes(document, item, where):
    joints = document.integers(item, "joints", where)
    for j in joints:
        document.item("nodes", j, f"joints of {where}")
    if not joints or len(set(joints)) < len(joints):
        raise document.error(
            f"{where} with {len(joints)} joints, {len(set(joints))} of them different", "one or more joints, each once"
        )
    return joints


def _joint_names(graph, joints, notes):
    """Node names; a missing or repeated one is made unique."""
    names, unnamed, repeated = [], [], []
    reserved = {graph.names[j] for j in joints}
    for j in joints:
        name = graph.names[j]
        if name is None:
            name = f"node{j}"
            unnamed.append(name)
        if name in names or (graph.names[j] is None and name in reserved):
            base, k = name, 2
            while f"{base}#{k}" in names or f"{base}#{k}" in reserved:
                k += 1
            name = f"{base}#{k}"
            repeated.append(name)
        names.append(name)
    broken = [name for name in names if "\ufffd" in name]
    if broken:
        notes.append(f"{len(broken)} joint(s) with \ufffd in the name, for what is no character: {listed(broken, 5)}")
    if unnamed:
        notes.append(f"{len(unnamed)} joint(s) without a name, named after their nodes: {listed(unnamed, 5)}")
    if repeated:
        notes.append(f"{len(repeated)} joint(s) with the name of another joint, made unique by a number: {listed(repeated, 5)}")
    return names


def _joint_parents(graph, joints):
    """(J,) rows: the nearest node above that is a joint too (3.7.3.2); nodes between them that are none are passed over."""
    row = {j: r for r, j in enumerate(joints)}
    return np.array([next((row[a] for a in graph.ancestors(j) if a in row), -1) for j in joints])


def _inverted(document, matrices, names, what):
    flat = flattening(matrices)
    if flat.any():
        raise document.error(f"the {what} of {names[int(flat.argmax())]!r} that flattens space", "invertible matrices")
    return np.linalg.inv(matrices)


def _bind_space_candidates(graph, root_joints, joints, mesh_nodes):
    """Nodes as whose space exporters write bind space: those above the skeleton and above the mesh, and the scene itself."""
    nodes = [a for r in root_joints for a in graph.ancestors(r) if a not in joints]
    nodes += [n for m in mesh_nodes for n in (m, *graph.ancestors(m))]
    return [(SCENE, np.eye(4))] + [(f"node {graph.label(n)}", graph.worlds[n]) for n in dict.fromkeys(nodes)]


# ---- the animations ----


def _angles(moved, parents, frames):
    """Θ of each frame, (k, J, 3), from the skinning matrices in the rig's frame, (k, J, 4, 4)."""
    linear = moved[:, :, :3, :3]
    stretch = np.linalg.svd(linear, compute_uv=False)
    A = nearest_rotations(linear)
    above = np.where((parents >= 0)[:, None, None], A[:, np.maximum(parents, 0)], np.eye(3))
    local = np.swapaxes(above, -1, -2) @ A
    local[stretch[..., 2] <= 1e-6 * np.maximum(stretch[..., 0], 1e-30)] = np.eye(3)  # scaled to nothing: no direction is left
    return np.einsum("jba,kjb->kja", frames, rotvec_from_matrix(local))


def _unkept(moved, parents, rest, names, size):
    """Notes on joints that animations move or scale, which Θ cannot say."""
    notes = []
    below = np.flatnonzero(parents >= 0)
    if len(below):
        up = parents[below]
        at = np.einsum("kjab,jb->kja", moved[..., :3, :3], rest) + moved[..., :3, 3]
        A = nearest_rotations(moved[..., :3, :3])
        offset = np.einsum("kjba,kjb->kja", A[:, up], at[:, below] - at[:, up]) - (rest[below] - rest[up])
        far = np.linalg.norm(offset, axis=2).max(axis=0)
        if far.max() > 1e-3 * size:
            worst = names[below[int(far.argmax())]]
            notes.append(
                f"animations move {int((far > 1e-3 * size).sum())} joint(s) relative to their parents, {worst!r} the furthest "
                f"(by {100 * far.max() / size:.2g} % of the rig's size): only rotations are kept"
            )
    stretch = np.linalg.svd(moved[..., :3, :3], compute_uv=False)
    scaled = np.abs(stretch - 1.0).max(axis=(0, 2))
    if scaled.max() > 0.01:
        notes.append(
            f"animations scale {int((scaled > 0.01).sum())} joint(s), {names[int(scaled.argmax())]!r} the most: "
            "only rotations are kept"
        )
    return notes
