"""Checks of a rig file's content: arrays of the right kinds, indices in range, weights that are weights, a proper tree."""

import re
import shlex
from collections.abc import Mapping
from numbers import Real

import numpy as np
from scipy import sparse

from ..errors import FileError, InputError, brief, counted, listed, not_finite
from .chains import loose_joints
from .frames import AXES
from .partition import check_partition

__all__ = [
    "Reporter",
    "check_directions",
    "check_joints",
    "check_limits",
    "check_mask",
    "check_mesh",
    "check_names",
    "check_poses",
    "check_rig",
    "check_rotations",
    "check_tree",
    "check_weights",
    "following_root",
]

# Weight sums this near to 1 are rounding (of single-precision files) and not worth a word.
_ROUNDING = 1e-5
# Weight sums within 1 % of 1 are put right; others are not what the artist meant.
_TOLERATED = 0.01
# Beyond, squares of lengths leave double precision.
_LARGEST = 1e100
# Radians, of poses.
_MOST_ANGLE = 4 * np.pi


class Reporter:
    """Raises the errors of one rig file: they name the file where there is one."""

    def __init__(self, path):
        self.path = path

    def fail(self, field, got, expected, remedy=None):
        """Raise a FileError that names the file and the field, or an InputError where there is no file."""
        if self.path is None:
            raise InputError(field, got, expected, remedy)
        raise FileError(str(self.path), f"{field}: {got}", expected, remedy)

    def array(self, field, value, shape, kind="numbers"):
        """A new float (kind "numbers") or int ("indices") array of a shape, where None is any length."""
        words = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        try:
            a = np.asarray(value)
        except (TypeError, ValueError):
            self.fail(field, type(value).__name__, f"an array of {kind} of shape {words}")
        if np.ma.is_masked(value):
            self.fail(field, "a masked array", f"an array of {kind} of shape {words}", "Fill it with numpy.ma.filled.")
        if a.dtype.kind not in "fiu" or (kind == "indices" and a.dtype.kind == "f"):
            self.fail(
                field, f"an array of type {a.dtype}", f"an array of {kind if kind == 'numbers' else 'integers'} of shape {words}"
            )
        if a.ndim != len(shape) or any(n is not None and n != k for n, k in zip(shape, a.shape)):
            self.fail(field, f"shape {a.shape}", f"shape {words}")
        if kind == "indices":
            return a.astype(np.intp)
        a = a.astype(float)
        bad = ~np.isfinite(a)
        if bad.any():
            first = np.argwhere(bad)[0].tolist()
            self.fail(field, f"{not_finite(np.count_nonzero(bad))}, the first at {first}", "finite numbers")
        return a

    def matrix(self, field, value, shape):
        """A new sparse float matrix in canonical form."""
        if not sparse.issparse(value):
            value = self.array(field, value, (None, None))
        if value.shape != shape:
            self.fail(field, f"shape {value.shape}", f"shape {shape}")
        a = sparse.csr_array(value, dtype=float, copy=True)
        bad = int(np.count_nonzero(~np.isfinite(a.data)))
        if bad:
            row = int(np.searchsorted(a.indptr, np.flatnonzero(~np.isfinite(a.data))[0], side="right")) - 1
            self.fail(field, f"{not_finite(bad)}, the first in row {row}", "finite numbers")
        a.sum_duplicates()
        a.eliminate_zeros()
        a.sort_indices()
        return a


def check_mesh(report, vertices, faces):
    """Template and faces: (m, 3) float and (F, 3) int, faces in range, a mesh with some size."""
    vertices = report.array("vertices", vertices, (None, 3))
    faces = report.array("faces", faces, (None, 3), "indices")
    m = len(vertices)
    if m < 3:
        report.fail("vertices", f"{m} vertices", "at least 3")
    _check_small(report, "vertices", vertices)
    if np.ptp(vertices, axis=0).max() == 0:
        report.fail("vertices", f"{m} vertices that are all at one point", "a mesh with some size")
    if len(faces) == 0:
        report.fail(
            "faces", "no faces", "at least one triangle", "A point cloud cannot be a rig: export the mesh with its faces."
        )
    out = ((faces < 0) | (faces >= m)).any(axis=1)
    if out.any():
        first = int(np.flatnonzero(out)[0])
        got = f"{np.count_nonzero(out)} faces out of range; the first is face {first}, {faces[first].tolist()}"
        report.fail("faces", got, f"rows of the {m} vertices, 0 to {m - 1}")
    return vertices, faces


def _check_small(report, field, positions):
    if (most := np.abs(positions).max()) > _LARGEST:
        report.fail(field, f"coordinates of up to {most:.3g}", f"coordinates of at most {_LARGEST:.0e}")


def check_weights(report, weights, m, faces, joint_names, normalize, notes):
    """Skinning weights as an (m, J) csr_array whose rows sum to 1; those of vertices of no face may be empty."""
    J = len(joint_names)
    w = report.matrix("weights", weights, (m, J))
    if (w.data < 0).any():
        k = int(np.argmin(w.data))
        row = int(np.searchsorted(w.indptr, k, side="right")) - 1
        worst = f"{w.data[k]:.3g} (vertex {row}, joint {joint_names[w.indices[k]]!r})"
        got = f"{counted(np.count_nonzero(w.data < 0), 'negative weight')}, the worst {worst}"
        report.fail("weights", got, "weights of 0 and more", "Clean the weights in the program that made the rig.")
    sums = np.asarray(w.sum(axis=1)).ravel()
    sums[np.setdiff1d(np.flatnonzero(sums <= 0), faces)] = 1.0
    if (sums <= 0).any():
        first = int(np.flatnonzero(sums <= 0)[0])
        got = f"{np.count_nonzero(sums <= 0)} of {m} vertices without any weight, the first is vertex {first}"
        report.fail(
            "weights",
            got,
            "at least one joint for every vertex",
            "Give these vertices to a joint in the program that made the rig.",
        )
    off = np.abs(sums - 1.0)
    worst = int(np.argmax(off))
    if off[worst] > _TOLERATED and not normalize:
        count = np.count_nonzero(off > _TOLERATED)
        got = f"{count} of {m} weight rows that do not sum to 1: they sum to {_range(sums, '.4g')}, "
        got += f"the worst is vertex {worst} with {sums[worst]:.4g}"
        remedy = "To divide each row by its sum, use --normalize-weights or normalize_weights=True."
        report.fail("weights", got, "rows that sum to 1 within 1 %", remedy)
    if off[worst] > 1e-12:  # rows that are right to the last bits stay as they are
        w.data /= np.repeat(sums, np.diff(w.indptr))
    if off[worst] > _ROUNDING:
        count = counted(np.count_nonzero(off > _ROUNDING), "weight row")
        notes.append(f"{count} summed to {_range(sums, '.6g')}; they were divided by their sums")
    return w


def following_root(root, weights, names, notes):
    """Weights with the root's for vertices that have none, which are those of no face."""
    idle = np.flatnonzero(np.diff(weights.indptr) == 0)
    if not len(idle):
        return weights
    which = "vertex of no face has no weight, and follows" if len(idle) == 1 else "vertices of no face have no weight, and follow"
    notes.append(f"{len(idle)} {which} {names[root]!r}")
    own = sparse.coo_array((np.ones(len(idle)), (idle, np.full(len(idle), root))), shape=weights.shape)
    return sparse.csr_array(weights + own)


def _range(values, digits):
    """The least and the greatest of some values in words, one number where they are written alike."""
    return " to ".join(dict.fromkeys(format(value, digits) for value in (values.min(), values.max())))


def check_names(report, field, names):
    """Raise where one of the names has half of a character, or NUL, which saved rigs could not hold."""
    for odd, what, wanted in (
        (r"[\ud800-\udfff]", "what UTF-8 cannot hold", "names of Unicode characters"),
        (r"\0", "a NUL", "names without one"),
    ):
        if named := [name for name in names if re.search(odd, name)]:
            report.fail(field, f"{named[0]!r}, which has {what}", wanted, "Rename the joint or part in the rig's file.")


def check_joints(report, data):
    """Joint names, parents (in range), positions and rest frames."""
    names = list(data.joint_names)
    if not names or not all(isinstance(n, str) and n for n in names):
        report.fail(
            "joint_names",
            "no joints" if not names else "names that are empty or not text",
            "a name for each of one or more joints",
        )
    check_names(report, "joint_names", names)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        report.fail(
            "joint_names", f"names that come more than once: {', '.join(map(repr, twice[:5]))}", "a different name for each joint"
        )
    J = len(names)
    parents = report.array("parents", data.parents, (J,), "indices")
    out = (parents < -1) | (parents >= J)
    if out.any():
        j = int(np.flatnonzero(out)[0])
        got = f"parent {parents[j]} of joint {names[j]!r}, out of range ({np.count_nonzero(out)} such)"
        report.fail("parents", got, f"rows of the {J} joints, 0 to {J - 1}, or -1 for a root")
    joints = report.array("joints", data.joints, (J, 3))
    _check_small(report, "joints", joints)
    return names, parents, joints, check_rotations(report, "frames", data.frames, names)


def check_rotations(report, field, value, names):
    """A rotation for each joint as a new (J, 3, 3) array; columns are axes."""
    frames = report.array(field, value, (len(names), 3, 3))
    off = np.abs(np.swapaxes(frames, 1, 2) @ frames - np.eye(3)).max(axis=(1, 2))
    if off.max() > 1e-3:
        j = int(np.argmax(off))
        report.fail(
            field, f"axes of joint {names[j]!r} that are not orthonormal (off by {off[j]:.2g})", "unit axes at right angles"
        )
    left = np.linalg.det(frames) < 0
    if left.any():
        report.fail(field, f"a left-handed frame of joint {names[int(np.argmax(left))]!r}", "right-handed axes, z = x × y")
    rough = off > 1e-12
    if rough.any():  # rounding of single-precision files: the nearest rotation
        u, _, vt = np.linalg.svd(frames[rough])
        frames[rough] = u @ vt
    return frames


def check_poses(report, poses, names):
    """Name → (J, 3) array of its own, in the order given."""
    if not isinstance(poses, Mapping):
        report.fail("poses", type(poses).__name__, "a mapping of names to poses (J, 3)")
    if not all(isinstance(name, str) and name for name in poses):
        report.fail("poses", "names that are empty or not text", "a name for each pose")
    poses = {name: report.array(f"pose {name!r}", theta, (len(names), 3)) for name, theta in poses.items()}
    for name, theta in poses.items():
        if np.abs(theta).max() > _MOST_ANGLE:
            got = f"an angle of {np.abs(theta).max():.3g}"
            report.fail(f"pose {name!r}", got, "radians, of two turns at most", "Multiply degrees by pi / 180.")
    return poses


def check_rig(rig):
    """Raise InputError, about the field, where a rig that was put together by hand has something that no rig can have.

    Only what costs next to nothing to see is looked at: ``build.build_rig`` checks all else, and says more.
    """
    report = Reporter(None)
    if not isinstance(rig.joint_names, tuple) or not all(isinstance(name, str) for name in rig.joint_names):
        report.fail("joint_names", brief(rig.joint_names), "a tuple of names")
    check_names(report, "joint_names", rig.joint_names)
    J = len(rig.joint_names)
    for name in ("vertices", "faces", "parents", "joints", "frames", "lower", "upper", "merged", "locked"):
        if not isinstance(value := getattr(rig, name), np.ndarray):
            report.fail(name, type(value).__name__, "a NumPy array")
    if not isinstance(rig.partitions, Mapping) or not all(isinstance(parts, Mapping) for parts in rig.partitions.values()):
        report.fail("partitions", brief(rig.partitions), "a mapping of names to mappings of parts to joint names")
    shapes = {"vertices": (None, 3), "faces": (None, 3), "parents": (J,), "joints": (J, 3), "frames": (J, 3, 3)}
    for name, shape in shapes.items():
        report.array(name, getattr(rig, name), shape, "indices" if name in ("faces", "parents") else "numbers")
    m = len(rig.vertices)
    if rig.faces.size and not 0 <= rig.faces.min() <= rig.faces.max() < m:
        report.fail("faces", f"rows {rig.faces.min()} to {rig.faces.max()}", f"rows of the {m} vertices, 0 to {m - 1}")
    for name, shape in (("weights", (m, J)), ("regressor", (J, m))):
        if getattr(matrix := getattr(rig, name), "format", None) != "csr" or matrix.shape != shape:
            got = f"a {type(matrix).__name__} of shape {np.shape(matrix)}"
            report.fail(name, got, f"a sparse csr_array of shape {shape}, as the rig has {m} vertices and {J} joints")
        if not np.isfinite(matrix.data).all():
            report.fail(name, "numbers that are NaN or infinite", "finite numbers")
    if not -1 <= rig.parents.min(initial=-1) <= rig.parents.max(initial=-1) < J or len(loose_joints(rig.parents)) != 1:
        report.fail("parents", brief(rig.parents.tolist()), "one tree: -1 for the root, for each other joint the row of another")
    check_limits(report, rig.lower, rig.upper, rig.joint_names)
    for name in ("merged", "locked"):
        check_mask(report, name, getattr(rig, name), J)
    check_directions(report, rig.metres_per_unit, rig.up, rig.forward)
    for name, parts in rig.partitions.items():
        check_names(report, "partitions", [str(name), *map(str, parts)])
        for part, members in parts.items():
            listed_names = members if isinstance(members, (tuple, list)) else [members]
            unknown = [joint for joint in listed_names if joint not in rig.joint_names]
            if unknown or listed_names is not members:
                got = f"{brief(unknown[0] if unknown else members)} in part {part!r}"
                report.fail(f"partition {name!r}", got, "for each part a sequence of names of the rig's joints")
    check_partition("granularity", rig.granularity, rig.partitions)


def check_mask(report, field, value, J):
    """A new (J,) bool array."""
    a = np.array(value)
    if a.dtype != bool or a.shape != (J,):
        report.fail(field, f"an array of type {a.dtype} and shape {a.shape}", f"true or false for each of the {J} joints")
    return a


def check_tree(report, parents, names, explained):
    """One root and no cycle; returns the row of the root.

    ``explained``: whether a card's [hierarchy] has been applied, which changes what the user can do about it.
    """
    rig = "RIG" if report.path is None else shlex.quote(str(report.path))
    with_card = f"Write a card with: lbsfit rig card {rig} -o CARD, check its [hierarchy], which is a guess, "
    with_card += "and pass it with --card (card=...)."
    for start in range(len(parents)):
        path, j = [], start
        while j >= 0 and j not in path:
            path.append(j)
            j = int(parents[j])
        if j >= 0:
            loop = [names[k] for k in path[path.index(j) :]] + [names[j]]
            got = f"a cycle in the hierarchy: {' → '.join(loop)} (each is a child of the next)"
            report.fail("parents", got, "a tree of joints", "Mend the card's [hierarchy]." if explained else with_card)
    roots = [names[j] for j in np.flatnonzero(parents < 0)]
    if len(roots) > 1:
        remedy = "Give their parents in the card's [hierarchy], in chains or parents." if explained else with_card
        report.fail("parents", f"{len(roots)} root joints: {listed(roots)}", "one root, with all other joints below it", remedy)
    return int(np.flatnonzero(parents < 0)[0])


def check_limits(report, lower, upper, names):
    """Limits as two (J, 3) arrays, none reversed, none of more than a turn."""
    if lower is None or upper is None:
        report.fail("limits", "only one of lower and upper", "both, or none")
    lower, upper = report.array("lower", lower, (len(names), 3)), report.array("upper", upper, (len(names), 3))
    if (lower > upper).any():
        j, axis = np.argwhere(lower > upper)[0]
        got = f"limits of joint {names[j]!r} reversed about {'xyz'[axis]}: lower {lower[j, axis]:.4g}, upper {upper[j, axis]:.4g}"
        report.fail("limits", got, "lower limits that are not above the upper ones", "Swap the two.")
    most = np.maximum(np.abs(lower), np.abs(upper)).max(axis=1)
    if most.max() > 2 * np.pi:
        got = f"limits of joint {names[int(most.argmax())]!r} of up to {most.max():.4g}"
        report.fail("limits", got, "radians, at most one turn", "Multiply degrees by pi / 180.")
    return lower, upper


def check_directions(report, unit, up, forward, card=""):
    """Unit and axes, where known; some of them by a card, which is named."""
    if unit is not None and not (isinstance(unit, Real) and not isinstance(unit, bool) and 0 < unit < np.inf):
        report.fail("metres_per_unit", repr(unit), "a positive number, or None where unknown")
    for field, value in (("up", up), ("forward", forward)):
        if value is not None and not (isinstance(value, str) and value in AXES):
            report.fail(field, repr(value), f"one of {', '.join(AXES)}, or None where unknown")
    if up is not None and forward is not None and up[1] == forward[1]:
        remedy = f"See {card}." if card else "Give both, or None for one that is not known."
        report.fail("forward", f"{forward}, along the up axis {up}", "another axis than up", remedy)
