"""Fits as an animated glTF file: the rig's skeleton, its mesh skinned to it, and a key frame for each fit.

A joint's node is, relative to its parent's,

    translation F_pᵀ ((J_j − J_p) + R_j δ_j − δ_p),   rotation F_pᵀ F_j exp(θ_j),

with the rest frames F, the rest joints J of the key frame's template, R_j = F_j exp(θ_j) F_jᵀ, and δ = J̄ − J, where J̄ are the
joints of the file's bind matrices [F_j | J̄_j]. The root's node carries translation and scale as well. Then the skinning matrices
(glTF 2.0, 3.7.3.3) are those of ``skinning.skin``: v ↦ scale · (A_j (v − J_j) + P_j) + translation.
"""

from numbers import Real

import numpy as np

from ..errors import InputError, brief
from ..fitting.result import FitResult
from ..rig.frames import AXES
from ..rig.rig import Rig
from ..rotations import matrix_from_rotvec

__all__ = ["OFFSETS", "check_fit", "save_animation"]

OFFSETS = ("mean", "each")
_SETS = 4  # influences in one set of attributes (3.7.3.3)


def save_animation(path, rig, results, *, offsets="mean", frames_per_second=30.0, up=None, metres_per_unit=1.0):
    """Write fits as an animation that other programs open: binary glTF with the rig's mesh, skeleton and skinning weights.

    Parameters
    ----------
    path : str or Path
        To write; the name must end in ``.glb``.
    rig : Rig
        That the fits are of.
    results : FitResult or sequence of FitResult
        A key frame each, in this order. One alone is a rig that stands in its pose.
    offsets : {"mean", "each"}, default "mean"
        Whose template U + offsets the frames have: their mean, with its joints, so that bones keep their lengths; or each its own
        (by morph targets and moved joints), so that each frame is the registered mesh. The same of one fit alone.
    frames_per_second : float, default 30
    up : str, optional
        Axis of the scans that is up, such as "+z": what is written is turned so that it becomes glTF's, which is +y. By default
        the rig's own, +y where that is not known.
    metres_per_unit : float, default 1
        Of the scans' unit. Lengths in glTF are metres.

    Returns
    -------
    (N,) array
        Mean distance of each frame's vertices from those of its fit, in the scans' unit. Not more than single precision
        leaves with ``offsets="each"``.

    Raises
    ------
    InputError
        No results, results of another rig or with what is not finite, parameters out of their ranges.
    FileError
        A path that cannot be written to.

    Notes
    -----
    Vertices, faces and joints are the rig's, in its order and with its names; normals are of the mean template. Materials and
    texture coordinates are not, as a ``Rig`` has none. A vertex may hang on more than four joints: further ones are in further
    sets of attributes, which some viewers leave out.
    """
    rig, results = _checked(path, rig, results, offsets, frames_per_second, up, metres_per_unit)
    turn = _up_to_y(up or rig.up or "+y")
    theta = np.stack([r.pose for r in results])
    own = np.stack([r.offsets for r in results])
    mean, mean_joints = own.mean(axis=0), np.mean([r.rest_joints for r in results], axis=0)
    exact = offsets == "each" or len(results) == 1
    joints = np.stack([r.rest_joints for r in results]) if exact else np.broadcast_to(mean_joints, theta.shape)
    translation, scale = np.stack([r.translation for r in results]), np.array([r.scale for r in results])

    from .. import __version__
    from ..io.glb import GlbWriter

    writer = GlbWriter(f"lbsfit_np {__version__}")
    values = _skeleton(writer, rig, theta, joints, mean_joints, translation, scale)
    morphs = own - mean if exact and np.abs(own - mean).max() > 0 else None
    mesh = _mesh(writer, rig, rig.vertices + mean, morphs)
    binds = _inverse_binds(writer, rig, mean_joints)
    skin = writer.add("skins", name=rig.name, joints=list(range(len(rig.parents))), inverseBindMatrices=binds)
    body = writer.add("nodes", name=rig.name, mesh=mesh, skin=skin)
    top = rig.root
    if not (np.array_equal(turn, np.eye(3)) and metres_per_unit == 1):
        placed = {"rotation": _quaternions(turn[None])[0].tolist(), "scale": [float(metres_per_unit)] * 3}
        top = writer.add("nodes", name="scan", children=[rig.root], **placed)
    writer.add("scenes", nodes=[top, body])
    writer.root["scene"] = 0
    _animate(writer, rig, values, np.arange(len(results)) / frames_per_second, body, morphs)
    writer.save(path)
    each = zip(results, joints, strict=True)
    return np.array([_distance(rig, r, r.offsets if exact else mean, rest) for r, rest in each])


def check_fit(rig, result, name):
    """Raise InputError, about ``name``, unless a result is of this rig and finite."""
    if not isinstance(result, FitResult):
        raise InputError(name, brief(result), "a FitResult")
    if result.rig_digest != rig.digest:
        remedy = "Load the rig as for the fit, with the same card, shape and parts."
        raise InputError(name, "a fit of another rig", f"a fit of {rig.name!r}", remedy)
    numbers = (result.pose, result.translation, result.scale, result.offsets, result.rest_joints)
    if not all(np.isfinite(a).all() for a in numbers):
        raise InputError(name, "a fit with values that are not finite", "finite values", "Leave it out, or fit again.")


def _checked(path, rig, results, offsets, frames_per_second, up, metres_per_unit):
    if not str(path).lower().endswith(".glb"):
        raise InputError("path", brief(str(path)), "a name that ends in .glb")
    if not isinstance(rig, Rig):
        raise InputError("rig", brief(rig), "a Rig", "load_rig reads one.")
    one = isinstance(results, FitResult)
    try:
        results = [results] if one else list(results)
    except TypeError:
        raise InputError("results", brief(results), "a FitResult, or a sequence of them") from None
    if not results:
        raise InputError("results", "none", "one or more")
    for k, result in enumerate(results):
        check_fit(rig, result, "results" if one else f"results[{k}]")
    if offsets not in OFFSETS:
        raise InputError("offsets", brief(offsets), " or ".join(map(repr, OFFSETS)))
    if up is not None and up not in AXES:
        raise InputError("up", brief(up), f"one of {', '.join(AXES)}, or None")
    for name, value in (("frames_per_second", frames_per_second), ("metres_per_unit", metres_per_unit)):
        if not isinstance(value, Real) or isinstance(value, bool) or not 1e-12 <= value <= 1e12:
            raise InputError(name, brief(value), "a positive number")
    return rig, results


def _up_to_y(up):
    """The rotation that brings an axis to +y, by a quarter turn, or half of one about x."""
    a, y = np.array(AXES[up], dtype=float), np.array([0.0, 1.0, 0.0])
    if up[1] == "y":
        return np.eye(3) if up == "+y" else np.diag([1.0, -1.0, -1.0])
    return np.round(matrix_from_rotvec(np.pi / 2 * np.cross(a, y)))


def _skeleton(writer, rig, theta, joints, bind_joints, translation, scale):
    """Add the joints' nodes, rows as in the rig, in the first frame's pose; their values in all frames by (row, path)."""
    F, root, below = rig.frames, rig.root, np.flatnonzero(rig.parents >= 0)
    up = rig.parents[below]
    turns = matrix_from_rotvec(theta)
    delta = bind_joints - joints
    turned = np.einsum("jab,kjbc,jdc,kjd->kja", F, turns, F, delta)  # R_j δ_j
    T = np.empty(theta.shape)
    T[:, root] = translation + scale[:, None] * (joints[:, root] + turned[:, root])
    bones = joints[:, below] - joints[:, up] + turned[:, below] - delta[:, up]
    T[:, below] = np.einsum("jba,kjb->kja", F[up], bones)
    local = F.copy()
    local[below] = np.einsum("jba,jbc->jac", F[up], F[below])
    values = {}
    for j, name in enumerate(rig.joint_names):
        values[j, "translation"] = T[:, j].astype("<f4")
        values[j, "rotation"] = _quaternions(local[j] @ turns[:, j])
        node = {path: values[j, path][0].tolist() for path in ("translation", "rotation")}
        if j == root:
            values[j, "scale"] = np.repeat(scale[:, None], 3, axis=1).astype("<f4")
            node["scale"] = values[j, "scale"][0].tolist()
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


def _mesh(writer, rig, rest, morphs):
    """Add the mesh in the rest pose; ``morphs``, (N, m, 3), what each frame's template differs by."""
    from ..optimize.surface import vertex_normals

    welded = np.empty((len(rig.welded.vertices), 3))
    welded[rig.weld] = rest
    normals = vertex_normals(welded, rig.welded.faces)[rig.weld]
    normals[np.linalg.norm(normals, axis=1) < 0.5] = 0.0, 0.0, 1.0  # without a face, where any will do
    attributes = {"POSITION": writer.accessor(rest, use="vertices", bounds=True)}
    attributes["NORMAL"] = writer.accessor(normals, use="vertices")
    for k, (rows, weights) in enumerate(_influences(rig.weights)):
        attributes[f"JOINTS_{k}"] = writer.accessor(rows, use="vertices")
        attributes[f"WEIGHTS_{k}"] = writer.accessor(weights, use="vertices")
    primitive = {"attributes": attributes, "indices": writer.accessor(rig.faces.astype("<u4").ravel(), use="indices")}
    fields = {}
    if morphs is not None:
        primitive["targets"] = [{"POSITION": writer.accessor(morph, use="vertices", bounds=True)} for morph in morphs]
        fields["weights"] = [1.0] + [0.0] * (len(morphs) - 1)
    return writer.add("meshes", name=rig.name, primitives=[primitive], **fields)


def _influences(weights):
    """Pairs of joints (m, 4) and weights (m, 4), a vertex's largest first; as many as the vertex on the most joints needs."""
    w = weights.tocoo()
    row, column, value = (a[w.data > 0] for a in (w.row, w.col, w.data))
    order = np.lexsort((column, -value, row))
    row, column, value = row[order], column[order], value[order]
    counts = np.bincount(row, minlength=len(weights.indptr) - 1)
    place = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
    sets = -(-counts.max() // _SETS)
    shape = len(counts), _SETS * sets
    joints, values = np.zeros(shape, "<u2"), np.zeros(shape, "<f4")
    joints[row, place], values[row, place] = column, value
    values[:, 0] += 1.0 - values.sum(axis=1, dtype=float)  # what rounding has taken
    return list(zip(np.split(joints, sets, axis=1), np.split(values, sets, axis=1), strict=True))


def _inverse_binds(writer, rig, joints):
    bind = np.tile(np.eye(4), (len(joints), 1, 1))
    bind[:, :3, :3], bind[:, :3, 3] = rig.frames, joints
    return writer.accessor(np.linalg.inv(bind))


def _animate(writer, rig, values, times, body, morphs):
    """Add the animation: a channel for all that changes, and for the root's rotation in any case, as there has to be one."""
    at, samplers, channels = writer.accessor(times, bounds=True), [], []

    def channel(node, path, output):
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": at, "output": writer.accessor(output), "interpolation": "LINEAR"})

    for (j, path), output in values.items():
        if (j, path) == (rig.root, "rotation") or (output != output[0]).any():
            channel(j, path, output)
    if morphs is not None:
        channel(body, "weights", np.eye(len(morphs)).ravel())
    writer.add("animations", name="fits", samplers=samplers, channels=channels)


def _distance(rig, result, offsets, joints):
    vertices = rig.pose(result.pose, result.translation, result.scale, offsets, joints=joints)
    return np.linalg.norm(vertices - result.vertices, axis=1).mean()
