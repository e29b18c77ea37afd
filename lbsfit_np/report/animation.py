"""Fits as an animated glTF file: the rig's skeleton, its mesh skinned to it, and a key frame for each fit.

Template and joints are brought into glTF's frame first: y up, metres, and the size that the fits have in the mean, so that rest
pose, bones and posed mesh are of one size. Then a joint's node is, relative to its parent's,

    translation F_pᵀ ((J_j − J_p) + R_j δ_j − δ_p),   rotation F_pᵀ F_j exp(θ_j),

with the rest frames F, the rest joints J of the key frame's template, R_j = F_j exp(θ_j) F_jᵀ, and δ = J̄ − J, where J̄ are the
joints of the file's bind matrices [F_j | J̄_j]. The root's node carries translation and scale as well. The skinning matrices
(glTF 2.0, 3.7.3.3) are then those of ``skinning.skin``: v ↦ scale · (A_j (v − J_j) + P_j) + translation.
"""

import warnings
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np
from scipy import sparse

from ..errors import InputError, brief, is_whole, listed
from ..fitting.result import FitResult
from ..fitting.several import odd_scales, stands_along, unit_of
from ..rig.frames import AXES
from ..rig.rig import Rig
from ..rig.units import METRES
from ..rotations import matrix_from_rotvec
from ..starts.scale import same_size
from .gltf_motion import animate, influences_of, inverse_binds, mesh, skeleton

__all__ = ["check_fit", "save_animation", "write_animation"]

_OFFSETS = ("mean", "each")
_MOST = 1e15  # of any number, so that products stay within single precision
_STEP = 1e-5  # of single precision's numbers, as a share of the rig's size, that frames may be off by


def save_animation(
    path, rig, results, *, offsets="mean", frames_per_second=30.0, up=None, metres_per_unit=None, influences=None
):
    """Write fits as an animation that other programs open: binary glTF with the rig's mesh, skeleton and skinning weights.

    Parameters
    ----------
    path : str or Path
        The file to write; the name must end in ``.glb``.
    rig : Rig
        The rig that the fits are of.
    results : FitResult or sequence of FitResult
        One key frame for each, in this order; the scans are in one unit. A single fit gives a rig in its pose, and no animation.
    offsets : {"mean", "each"}, default "mean"
        Which template U + offsets the frames have. "mean": the fits' mean, with its joints, in one size where the fits may be of
        one person, so that bones keep their lengths. "each": each fit's own (by morph targets and moved joints), so that each
        frame is the registered mesh. For a single fit the two are the same.
    frames_per_second : float, default 30
    up : str, optional
        The scans' up axis, such as "+z": everything is turned so that it becomes glTF's, which is +y. By default it is the rig's
        own, and the rig's front, if known, becomes glTF's, which is +z; where the rig's up axis is not known, it is +y.
    metres_per_unit : float, optional
        Length of the scans' unit in metres, as lengths in glTF are metres. By default that of the fits' ``unit``, if they say
        one, else told from the rig's unit and the fits' scales (``unit_of``); 1 where these do not tell it.
    influences : int, optional
        The largest number of joints that a vertex may depend on: its largest weights are kept, scaled to a sum of 1. By default
        all are kept; many programs show four.

    Returns
    -------
    (N,) array
        Mean distance of each frame's vertices from those of its fit, in the scans' unit, apart from rounding to single precision.
        It is 0 with ``offsets="each"`` and all influences.

    Raises
    ------
    InputError
        No results; results of another rig, with values that are not finite, or that say several units; parameters out of their
        ranges. Nothing is written.
    FileError
        A path that cannot be written to.

    Warns
    -----
    UserWarning
        Some fits' scales differ from the others' by more than people do, as for scans in another unit; not where they say theirs.
        The fits stand along another axis than ``up``, and lie in the animation.

    Notes
    -----
    Where scans are so far from the origin that single precision loses their motion, the skeleton hangs on a node "place of the
    scans", whose translation says where they are; most programs show it better without. Vertices, faces and joints are the rig's,
    in its order and with its names; normals are those of the mean template. The
    material is plain grey. There are no texture coordinates, as a ``Rig`` has none.
    """
    results = _checked(path, rig, results)
    _check_options(offsets, frames_per_second, up, metres_per_unit, influences)  # before anything is said
    if axis := stands_along(rig, results, up):
        words = f"the fits stand along {axis}: pass up={axis!r} for an upright animation, unless they lie down"
        warnings.warn(words, stacklevel=2)
    if odd := [f"results[{k}]" for k in odd_scales(results)]:
        words = f"the scale of {listed(odd)} differs from the others' by more than people do; are all scans in one unit?"
        warnings.warn(words, stacklevel=2)
    options = {"offsets": offsets, "frames_per_second": frames_per_second, "up": up}
    return write_animation(path, rig, results, **options, metres_per_unit=metres_per_unit, influences=influences)


def write_animation(path, rig, results, *, offsets, frames_per_second, up, metres_per_unit, influences):
    """``save_animation`` without a word: ``results`` are a list of fits that :func:`check_fit` has seen."""
    _check_options(offsets, frames_per_second, up, metres_per_unit, influences)
    if influences is not None:
        rig = replace(rig, weights=_strongest(rig.weights, influences))
    metres = unit_of(rig, results)[1] if metres_per_unit is None else float(metres_per_unit)
    exact = offsets == "each" or len(results) == 1
    mean, joints = _mean([r.offsets for r in results]), _mean([r.rest_joints for r in results])
    shown = [(r.offsets, r.rest_joints) if exact else (mean, joints) for r in results]
    moving = results if exact else _of_one_size(rig, results, mean, joints)
    away = np.array([_distance(rig, *frame) for frame in zip(moving, *zip(*shown, strict=True), results, strict=True)])
    place, motion = _near_the_origin(_in_gltf(rig, moving, shown, mean, joints, _turn(rig, up), metres))

    from .. import __version__
    from ..io.glb import GlbWriter

    writer = GlbWriter(f"lbsfit_np {__version__}")
    values = skeleton(writer, motion)
    shape = mesh(writer, motion)
    binds = inverse_binds(writer, motion.rig)
    skin = writer.add("skins", name=rig.name, joints=list(range(len(rig.parents))), inverseBindMatrices=binds)
    body = writer.add("nodes", name=f"{rig.name} mesh", mesh=shape, skin=skin)
    top = rig.root
    if place.any():
        top = writer.add("nodes", name="place of the scans", translation=place.tolist(), children=[rig.root])
    writer.add("scenes", nodes=[top, body])
    writer.root["scene"] = 0
    if len(results) > 1:
        animate(writer, motion, values, np.arange(len(results)) / frames_per_second, body)
    writer.save(path)
    return away


def check_fit(rig, result, name):
    """Raise an InputError about ``name`` unless a result is of this rig and its numbers can be written."""
    if not isinstance(result, FitResult):
        raise InputError(name, brief(result), "a FitResult")
    if result.rig_digest != rig.digest:
        remedy = "Load the rig as for the fit, with the same card, shape and parts."
        raise InputError(name, "a fit of another rig", f"a fit of {rig.name!r}", remedy)
    J, m = rig.joints.shape, rig.vertices.shape
    shapes = {"pose": J, "rest_joints": J, "offsets": m, "vertices": m, "translation": (3,), "scale": ()}
    for field, shape in shapes.items():
        array = np.asarray(getattr(result, field))
        if array.shape != shape:
            raise InputError(name, f"a fit with {field} of shape {array.shape}", f"shape {shape}")
        if not (np.abs(array) < _MOST).all():  # nor of NaN
            got = f"a fit whose {field} are not finite, or beyond {_MOST:g}"
            raise InputError(name, got, "finite values", "Leave it out, or fit again.")
    if result.unit and result.unit not in METRES:
        raise InputError(name, f"a fit with the unit {brief(result.unit)}", f"one of {', '.join(METRES)}, or an empty one")
    if result.scale < 1 / _MOST:
        raise InputError(name, f"a fit with the scale {result.scale}", f"a positive scale, of at least {1 / _MOST:g}")


def _checked(path, rig, results):
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
    return results


def _check_options(offsets, frames_per_second, up, metres_per_unit, influences):
    if not isinstance(offsets, str) or offsets not in _OFFSETS:
        raise InputError("offsets", brief(offsets), " or ".join(map(repr, _OFFSETS)))
    if up is not None and not (isinstance(up, str) and up in AXES):
        raise InputError("up", brief(up), f"one of {', '.join(AXES)}, or None")
    numbers = {"frames_per_second": frames_per_second, "metres_per_unit": 1.0 if metres_per_unit is None else metres_per_unit}
    for name, value in numbers.items():
        if not isinstance(value, Real) or isinstance(value, bool) or not 1e-6 <= value <= 1e6:
            raise InputError(name, brief(value), "a positive number, from 1e-6 to 1e6")
    if influences is not None and not is_whole(influences, 1):
        raise InputError("influences", brief(influences), "a whole number of at least 1, or None")


# ---- from the scans' frame to glTF's ----


@dataclass(frozen=True)
class _Motion:
    """What is written, in metres, y up. ``rig`` is the mean template's, its ``joints`` those of the bind matrices."""

    rig: Rig
    theta: np.ndarray  # (N, J, 3)
    joints: np.ndarray  # (N, J, 3) rest joints of each frame
    translation: np.ndarray  # (N, 3)
    scale: np.ndarray  # (N,), 1 in the (geometric) mean
    morphs: np.ndarray | None  # (N, m, 3), what each frame's template differs by; None where all have the mean


def _of_one_size(rig, results, mean, joints):
    """The fits with one scale, each where its vertices are on the mean; as they are where they are of people of several sizes.

    A fit's scale and its template make up for each other: beside a template of all fits, its own scale would only let the whole
    grow and shrink.
    """
    scales = [r.scale for r in results]
    if len({r.subject for r in results}) > 1 or not same_size(max(scales), min(scales)):
        return results
    scale, moved = _mean_scale(results), []

    def exact(r):  # to the last bit where it is
        return r.scale == scale and np.array_equal(r.offsets, mean) and np.array_equal(r.rest_joints, joints)

    for r in results:
        centre = rig.pose(r.pose, np.zeros(3), scale, mean, joints=joints).mean(axis=0)
        moved.append(r if exact(r) else replace(r, scale=scale, translation=r.vertices.mean(axis=0) - centre))
    return moved


def _mean_scale(results):
    scales = np.array([r.scale for r in results])
    return scales[0] if (scales == scales[0]).all() else np.exp(np.log(scales).mean())


def _in_gltf(rig, results, shown, mean, joints, turn, metres):
    scale = _mean_scale(results)
    unit = metres * scale  # metres in a rig unit
    placed = replace(
        rig,
        vertices=unit * (rig.vertices + mean) @ turn.T,
        joints=unit * joints @ turn.T,
        frames=turn @ rig.frames,
        shapes=None,
    )
    morphs = np.stack([unit * (offsets - mean) @ turn.T for offsets, _ in shown])
    return _Motion(
        placed,
        np.stack([r.pose for r in results]),
        np.stack([unit * rest @ turn.T for _, rest in shown]),
        np.stack([metres * r.translation @ turn.T for r in results]),
        np.array([r.scale for r in results]) / scale,
        morphs if morphs.any() else None,
    )


def _near_the_origin(motion):
    """Where fits are that are so far away that single precision would lose how they move, (3,), and the motion from there.

    It is 0 where they are near enough. As a node's translation it is exact in itself.
    """
    step = np.finfo("<f4").eps * np.abs(motion.translation).max()
    if step <= _STEP * motion.rig.size:
        return np.zeros(3), motion
    place = motion.translation.mean(axis=0).astype("<f4").astype(float)
    return place, replace(motion, translation=motion.translation - place)


def _mean(arrays):
    """The mean of arrays, to the last bit one of them where all are the same."""
    return arrays[0] if all(np.array_equal(a, arrays[0]) for a in arrays) else np.mean(arrays, axis=0)


def _turn(rig, up):
    """The rotation from the scans' axes to glTF's, whose y is up and whose z is the front."""
    stands = up is None or up == rig.up
    up, y = np.array(AXES[up or rig.up or "+y"]), np.array([0.0, 1.0, 0.0])
    front = np.array(AXES[rig.forward]) if stands and rig.up and rig.forward else None
    if front is not None:
        return np.stack([np.cross(up, front), up, front])
    if np.abs(up) @ y:
        return np.diag([1.0, up[1], up[1]])
    return np.round(matrix_from_rotvec(np.pi / 2 * np.cross(up, y)))


def _strongest(weights, n):
    """The n largest weights of each row, scaled to a sum of 1."""
    joints, values = (np.hstack(a) for a in zip(*influences_of(weights), strict=True))
    joints, values = joints[:, :n], values[:, :n]
    rows = np.repeat(np.arange(len(joints)), joints.shape[1])
    values /= values.sum(axis=1, keepdims=True)
    kept = sparse.csr_array((values.ravel(), (rows, joints.ravel())), shape=weights.shape)
    kept.eliminate_zeros()
    return kept


def _distance(rig, frame, offsets, joints, result):
    vertices = rig.pose(frame.pose, frame.translation, frame.scale, offsets, joints=joints)
    return np.linalg.norm(vertices - result.vertices, axis=1).mean()
