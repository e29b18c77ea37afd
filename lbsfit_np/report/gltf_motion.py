"""The parts of an animated glTF file, as ``animation`` says: the skeleton, the skinned mesh, its binds, the key frames."""

import numpy as np

from ..optimize.surface import vertex_normals
from ..rotations import matrix_from_rotvec

__all__ = ["animate", "influences_of", "inverse_binds", "mesh", "skeleton"]

_SET = 4  # influences in one set of attributes (3.7.3.3)


def skeleton(writer, motion):
    """Add the joints' nodes, rows as in the rig, in the first frame's pose; their values in all frames by (row, path)."""
    rig, joints = motion.rig, motion.joints
    F, root, below = rig.frames, rig.root, np.flatnonzero(rig.parents >= 0)
    up = rig.parents[below]
    turns = matrix_from_rotvec(motion.theta)
    delta = rig.joints - joints
    turned = np.einsum("jab,kjbc,jdc,kjd->kja", F, turns, F, delta)  # R_j δ_j
    T = np.empty(joints.shape)
    T[:, root] = motion.translation + motion.scale[:, None] * (joints[:, root] + turned[:, root])
    bones = joints[:, below] - joints[:, up] + turned[:, below] - delta[:, up]
    T[:, below] = np.einsum("jba,kjb->kja", F[up], bones)
    local = F.copy()
    local[below] = np.einsum("jba,jbc->jac", F[up], F[below])
    values = {}
    for j, name in enumerate(rig.joint_names):
        values[j, "translation"] = T[:, j].astype("<f4")
        values[j, "rotation"] = _quaternions(local[j] @ turns[:, j])
        if j == root:
            values[j, "scale"] = np.repeat(motion.scale[:, None], 3, axis=1).astype("<f4")
        node = {path: values[j, path][0].tolist() for path in ("translation", "rotation", "scale") if (j, path) in values}
        children = np.flatnonzero(rig.parents == j).tolist()
        writer.add("nodes", name=name, **node, **({"children": children} if children else {}))
    return values


def _quaternions(R):
    """(k, 4) xyzw of rotations (k, 3, 3), each on the same side as the one before, as what lies between is interpolated."""
    from scipy.spatial.transform import Rotation

    q = Rotation.from_matrix(R).as_quat()
    flips = np.einsum("ka,ka->k", q[1:], q[:-1]) < 0
    q[1:][np.cumsum(flips) % 2 == 1] *= -1
    return q.astype("<f4")


def mesh(writer, motion):
    """Add the mesh in the rest pose, with a morph target for each frame where these differ."""
    rig, morphs = motion.rig, motion.morphs
    normals = vertex_normals(rig.welded.vertices, rig.welded.faces)[rig.weld]
    normals[np.linalg.norm(normals, axis=1) < 0.5] = 0.0, 0.0, 1.0  # without a face, where any will do
    attributes = {"POSITION": writer.accessor(rig.vertices, use="vertices", bounds=True)}
    attributes["NORMAL"] = writer.accessor(normals, use="vertices")
    for k, (joints, weights) in enumerate(influences_of(rig.weights)):
        attributes[f"JOINTS_{k}"] = writer.accessor(joints, use="vertices")
        attributes[f"WEIGHTS_{k}"] = writer.accessor(weights, use="vertices")
    # Without one, glTF's default is metal, which is all but black where nothing is mirrored in it.
    plain = {"baseColorFactor": [0.8, 0.8, 0.8, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    material = writer.add("materials", name="plain", pbrMetallicRoughness=plain, doubleSided=True)
    indices = writer.accessor(rig.faces.astype("<u4").ravel(), use="indices")
    primitive = {"attributes": attributes, "indices": indices, "material": material}
    fields = {}
    if morphs is not None:
        primitive["targets"] = [{"POSITION": writer.accessor(morph, use="vertices", bounds=True)} for morph in morphs]
        fields["weights"] = [1.0] + [0.0] * (len(morphs) - 1)
        fields["extras"] = {"targetNames": [f"fit {k + 1}" for k in range(len(morphs))]}
    return writer.add("meshes", name=rig.name, primitives=[primitive], **fields)


def influences_of(weights):
    """Pairs of joints (m, 4) and weights (m, 4), a vertex's largest first; as many as the vertex on the most joints needs."""
    w = weights.tocoo()
    row, column, value = (a[w.data > 0] for a in (w.row, w.col, w.data))
    order = np.lexsort((column, -value, row))
    row, column, value = row[order], column[order], value[order]
    counts = np.bincount(row, minlength=len(weights.indptr) - 1)
    place = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    sets = -(-counts.max() // _SET)
    shape = len(counts), _SET * sets
    joints, values = np.zeros(shape, "<u2"), np.zeros(shape)
    joints[row, place], values[row, place] = column, value
    return list(zip(np.split(joints, sets, axis=1), np.split(values, sets, axis=1), strict=True))


def inverse_binds(writer, rig):
    """Add the inverses of the bind matrices [F_j | J̄_j]; the accessor's number."""
    bind = np.tile(np.eye(4), (len(rig.joints), 1, 1))
    bind[:, :3, :3], bind[:, :3, 3] = rig.frames, rig.joints
    return writer.accessor(np.linalg.inv(bind))


def animate(writer, motion, values, times, body):
    """Add the animation: a channel for all that changes, and for the root's rotation in any case, as there has to be one."""
    at, samplers, channels = writer.accessor(times, bounds=True), [], []

    def channel(node, path, output):
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": at, "output": writer.accessor(output), "interpolation": "LINEAR"})

    for (j, path), output in values.items():
        if (j, path) == (motion.rig.root, "rotation") or (output != output[0]).any():
            channel(j, path, output)
    if motion.morphs is not None:
        channel(body, "weights", np.eye(len(times)).ravel())
    writer.add("animations", name="fits", samplers=samplers, channels=channels)
