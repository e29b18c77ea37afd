"""Rigs in NPZ files: the package's own format, which keeps a Rig to the last bit, and the bodies' simple one.

Own format, version 1; all arrays plain (no pickle), J joints, m vertices, F faces; what follows notes may be absent:

=====================  ==========  =====================================================================================
key                    shape       content
=====================  ==========  =====================================================================================
lbsfit_np_rig          ()          int, version of the format: 1
name                   ()          text
vertices               (m, 3)      float, rest pose U
faces                  (F, 3)      int
weights_data           (nnz,)      float, skinning weights as compressed sparse rows, (m, J), rows sum to 1
weights_indices        (nnz,)      int, joints
weights_indptr         (m + 1,)    int
parents                (J,)        int, −1 for the root
joint_names            (J,)        text
joints                 (J, 3)      float, rest positions
frames                 (J, 3, 3)   float, columns are the joint's axes
lower, upper           (J, 3)      float, limits in radians about those axes
regressor_data         (nnz,)      float, joint regressor as compressed sparse rows, (J, m)
regressor_indices      (nnz,)      int, vertices
regressor_indptr       (J + 1,)    int
merged, locked         (J,)        bool
partitions             ()          text, JSON: {partition: {part: [joint names]}}, in order
granularity            ()          text, the partition in use
metres_per_unit        ()          float, NaN where unknown
up, forward            ()          text such as "+y", empty where unknown
notes                  ()          text, JSON: [notes]
poses_names            (k,)        text, names of the natural poses; k may be 0
poses_theta            (k, J, 3)   float, rotation vectors in radians
shapes_names           (K,)        text, shape parameters; K may be 0
shapes_units           (K,)        text
shapes_lower           (K,)        float, range
shapes_upper           (K,)        float
shapes_default         (K,)        float, values of the template
shapes_spread          (K,)        float, standard deviations
shapes_vertices        (K, m, 3)   int16 or float, times its step the change of the template for a unit of the parameter
shapes_step            (K,)        float
shapes_joints          (K, J, 3)   float, change of the joints
smpl_rest              (J, 3, 3)   float, from the rest pose to SMPL's or MANO's; (0, 3, 3) where unknown
=====================  ==========  =====================================================================================

A changed template on which vertices have come together, or apart, that are not so on the rig's own has weld, (m,) int, too: the
distinct vertex that each is on that; of one of no face −1 − the nearest.

The bodies' format: verts (shapes, m, 3), shape_names, faces (F, 3), weights (m, J) dense, joints (shapes, J, 3) heads, tails
(shapes, J, 3) optional, joint_names, parents (J,) with −1 for the root; metres, y up, facing +z.
"""

import json
import math
import operator
from pathlib import Path

import numpy as np
from scipy import sparse

from ..errors import FileError, InputError, brief, from_digits, likeliest, listed
from ..rig.chains import loose_joints
from ..rig.data import RigData
from ..rig.frames import frames_along
from ..rig.shapes import ShapeSpace, from_counts, to_counts
from ..rig.weld import Weld, weld_of
from .npz import read_npz
from .write import check_npz_name, write_npz

__all__ = ["BODY_KEYS", "OWN_KEY", "read_body_npz", "read_rig_npz", "rig_arrays", "save_rig"]

OWN_KEY = "lbsfit_np_rig"
BODY_KEYS = ("verts", "faces", "weights", "joints", "joint_names", "parents")
_VERSION = 1

_OWN_KEYS = (
    *("name", "vertices", "faces", "weights_data", "weights_indices", "weights_indptr"),
    *("parents", "joint_names", "joints", "frames", "lower", "upper"),
    *("regressor_data", "regressor_indices", "regressor_indptr", "merged", "locked", "partitions", "granularity"),
    *("metres_per_unit", "up", "forward", "notes"),
)
_POSE_KEYS = ("poses_names", "poses_theta")
_SHAPE_NUMBERS = ("lower", "upper", "default", "spread")
_SHAPE_KEYS = tuple(f"shapes_{key}" for key in ("names", "units", *_SHAPE_NUMBERS, "vertices", "step", "joints"))


def save_rig(rig, path):
    """Write a Rig in the package's own format; the file is replaced in one step.

    Parameters
    ----------
    rig : Rig
    path : path-like
        Ends in ``.npz``, by which ``load_rig`` knows it.

    Raises
    ------
    FileError
        Another ending, or a place that cannot be written to.
    """
    check_npz_name(path)
    write_npz(path, **rig_arrays(rig))


def rig_arrays(rig):
    """A Rig as the named arrays of the package's own format; a file may hold further ones beside them."""
    arrays = {OWN_KEY: np.array(_VERSION), "name": np.array(rig.name)}
    for key in ("vertices", "faces", "parents", "joints", "frames", "lower", "upper", "merged", "locked"):
        arrays[key] = getattr(rig, key)
    for key in ("weights", "regressor"):
        matrix = getattr(rig, key)
        arrays |= {f"{key}_data": matrix.data, f"{key}_indices": matrix.indices, f"{key}_indptr": matrix.indptr}
    arrays["joint_names"] = np.array(rig.joint_names, dtype=str)
    arrays["partitions"] = np.array(
        json.dumps({name: {p: list(js) for p, js in parts.items()} for name, parts in rig.partitions.items()})
    )
    arrays["granularity"] = np.array(rig.granularity)
    arrays["metres_per_unit"] = np.array(np.nan if rig.metres_per_unit is None else rig.metres_per_unit)
    arrays["up"], arrays["forward"] = np.array(rig.up or ""), np.array(rig.forward or "")
    arrays["notes"] = np.array(json.dumps(list(rig.notes)))
    arrays["poses_names"] = np.array(list(rig.poses), dtype=str)
    arrays["poses_theta"] = np.array([*rig.poses.values()], dtype=float).reshape(-1, len(rig.parents), 3)
    arrays |= _shape_arrays(rig)
    arrays["smpl_rest"] = np.empty((0, 3, 3)) if rig.smpl_rest is None else rig.smpl_rest
    numbers = rig._weld.numbers
    if not np.array_equal(numbers, weld_of(rig.vertices, rig.weights, rig.faces).numbers):
        arrays["weld"] = numbers
    return arrays


def _shape_arrays(rig):
    s = rig.shapes
    m, J = rig.weights.shape
    if s is None:
        none = np.empty(0)
        s = ShapeSpace(
            **dict.fromkeys(_SHAPE_NUMBERS, none), names=(), units=(), vertices=np.empty((0, m, 3)), joints=np.empty((0, J, 3))
        )
    counts, steps = to_counts(s.vertices)
    arrays = {"names": np.array(s.names, dtype=str), "units": np.array(s.units, dtype=str)}
    arrays |= {key: getattr(s, key) for key in _SHAPE_NUMBERS} | {"vertices": counts, "step": steps, "joints": s.joints}
    return {f"shapes_{key}": value for key, value in arrays.items()}


def read_rig_npz(path):
    """Read the package's own format; ``build_rig`` makes of it a rig that equals the saved one in every bit.

    Returns
    -------
    RigData

    Raises
    ------
    FileError
        Missing, broken, of a newer version, or with keys missing or of the wrong kind.
    """
    file = _Arrays(path, (OWN_KEY, *_OWN_KEYS, *_POSE_KEYS, *_SHAPE_KEYS, "smpl_rest", "weld"))
    version = file.number(OWN_KEY)
    if version != _VERSION:
        raise FileError(
            file.path, f"version {version:g} of the rig format", f"version {_VERSION}", "Update lbsfit_np, or save the rig again."
        )
    file.require(_OWN_KEYS)
    names = file.names("joint_names")
    m, J = len(file.numbers("vertices", 2)), len(names)
    partitions = file.json("partitions", dict)
    if not all(isinstance(p, dict) and all(_is_texts(js) for js in p.values()) for p in partitions.values()):
        raise FileError(file.path, "'partitions' in another form", "JSON of the form {partition: {part: [joint names]}}")
    notes = file.json("notes", list)
    unit = file.number("metres_per_unit")
    return RigData(
        name=file.text("name"),
        vertices=file["vertices"],
        faces=file["faces"],
        weights=file.rows("weights", (m, J)),
        joint_names=names,
        parents=file["parents"],
        joints=file["joints"],
        frames=file["frames"],
        regressor=file.rows("regressor", (J, m)),
        lower=file["lower"],
        upper=file["upper"],
        metres_per_unit=None if math.isnan(unit) else unit,
        up=file.text("up") or None,
        forward=file.text("forward") or None,
        merged=file["merged"],
        locked=file["locked"],
        partitions={name: {p: tuple(js) for p, js in parts.items()} for name, parts in partitions.items()},
        parts=file.text("granularity"),
        poses=_poses(file),
        shapes=_shapes(file),
        smpl_rest=file["smpl_rest"] if "smpl_rest" in file and len(file.numbers("smpl_rest", 3)) else None,
        welding=_welding(file, m),
        notes=[str(note) for note in notes],
        path=Path(path),
    )


def _welding(file, m):
    if "weld" not in file:
        return None
    numbers = file.numbers("weld", 1)
    try:
        if len(numbers) != m or numbers.dtype.kind != "i":
            raise ValueError
        return Weld.from_numbers(numbers)
    except ValueError:
        raise FileError(file.path, "'weld' that does not number distinct vertices", "a file that save_rig wrote") from None


def _poses(file):
    if not any(key in file for key in _POSE_KEYS):
        return {}
    file.require(_POSE_KEYS)
    names, theta = file.names("poses_names"), file.numbers("poses_theta", 3)
    if len(theta) != len(names) or len(set(names)) < len(names):
        got = f"{len(set(names))} different names in 'poses_names' and {len(theta)} poses in 'poses_theta'"
        raise FileError(file.path, got, "a name for each pose")
    return dict(zip(names, theta))


def _shapes(file):
    if not any(key in file for key in _SHAPE_KEYS):
        return None
    file.require(_SHAPE_KEYS)
    names, units = file.names("shapes_names"), file.names("shapes_units")
    counts, steps = file.numbers("shapes_vertices", 3), file.numbers("shapes_step", 1)
    if len(counts) != len(steps):
        raise FileError(file.path, f"{len(steps)} steps in 'shapes_step' for {len(counts)} directions", "one for each")
    numbers = {key: file.numbers(f"shapes_{key}", 1) for key in _SHAPE_NUMBERS}
    return ShapeSpace(
        names=tuple(names),
        units=tuple(units),
        vertices=from_counts(counts, steps),
        joints=file.numbers("shapes_joints", 3),
        **numbers,
    )


def read_body_npz(path, *, shape=None):
    """Read one shape of a file with the keys verts, faces, weights, joints, joint_names, parents (and tails, shape_names).

    Parameters
    ----------
    path : path-like
    shape : str or int, optional
        Name or number of the shape; the first by default.

    Returns
    -------
    RigData
        Rest frames follow the bones (heads to tails, or to the children where there are no tails): y along the bone,
        x across it (bending), z towards the front; see :func:`lbsfit_np.rig.frames.bone_frames`. The root's are the rig's axes.
    """
    file = _Arrays(path, (*BODY_KEYS, "tails", "shape_names"))
    file.require(BODY_KEYS)
    verts, names = file.numbers("verts", 3), file.names("joint_names")
    J = len(names)
    if verts.shape[2] != 3 or not len(verts):
        raise FileError(file.path, f"'verts' of shape {verts.shape}", "shape (shapes, m, 3)")
    row = _shape_row(file, shape, len(verts))
    for key in ("joints", *(["tails"] if "tails" in file else [])):
        if file.numbers(key, 3).shape != (len(verts), J, 3):
            raise FileError(
                file.path,
                f"{key!r} of shape {file[key].shape}",
                f"shape {(len(verts), J, 3)}, for {len(verts)} shapes and {J} joints",
            )
    weights = file.numbers("weights", 2)
    if weights.shape != (verts.shape[1], J):
        raise FileError(
            file.path,
            f"'weights' of shape {weights.shape}",
            f"shape {(verts.shape[1], J)}, for {verts.shape[1]} vertices and {J} joints",
        )
    parents, joints = file["parents"], file["joints"][row].astype(float)
    bones = _body_bones(file, joints, row)
    notes = [] if shape is not None or len(verts) == 1 else [_first_of(file, len(verts))]
    return RigData(
        name=Path(path).stem,
        vertices=verts[row],
        faces=file["faces"],
        weights=sparse.csr_array(weights.astype(float)),
        joint_names=names,
        parents=parents,
        joints=joints,
        frames=_body_frames(bones, joints, parents),
        bones=bones,
        metres_per_unit=1.0,
        up="+y",
        forward="+z",
        notes=notes,
        path=Path(path),
    )


def _first_of(file, n):
    names = _shape_names(file, n)
    which = f", {listed(list(map(repr, names)))}" if names else ""
    return f"the file has {n} shapes{which}; the first is taken (shape=... and --shape take another)"


def _shape_names(file, n):
    """Names of the n shapes; none where the file does not say."""
    names = file.names("shape_names") if "shape_names" in file else []
    if names and len(names) != n:
        got = f"{len(names)} shape_names for {n} shapes of verts"
        raise FileError(str(file.path), got, "one name for each, or no shape_names")
    return names


def _shape_row(file, shape, n):
    names = _shape_names(file, n)
    if shape is None:
        return 0
    if isinstance(shape, str):
        if shape in names:
            return names.index(shape)
        number = from_digits(shape)  # from a command line everything is text
        shape_as_number = -1 if number is None else number
    else:
        try:
            shape_as_number = -1 if isinstance(shape, bool) else operator.index(shape)
        except TypeError:
            shape_as_number = -1
    if not 0 <= shape_as_number < n:
        known = ", ".join(map(repr, names)) if names else "none by name"
        remedy = likeliest(shape, names) if isinstance(shape, str) else None
        raise InputError(
            "shape", brief(shape), f"one of the shapes of {file.path}: {known}, or a number from 0 to {n - 1}", remedy
        )
    return shape_as_number


def _body_bones(file, joints, row):
    """(J, 3) from each joint to where its bone ends, 0 where the file does not say."""
    if "tails" not in file or not np.isfinite(joints).all():
        return np.zeros(joints.shape)
    if not np.isfinite(file["tails"][row]).all():
        raise FileError(file.path, "'tails' with values that are NaN or infinite", "finite numbers")
    return file["tails"][row].astype(float) - joints


def _body_frames(bones, joints, parents):
    ok = np.isfinite(joints).all() and parents.shape == (len(joints),) and parents.dtype.kind in "iu"
    if not ok or (parents >= len(joints)).any() or (parents < -1).any() or (parents[loose_joints(parents)] >= 0).any():
        return np.tile(np.eye(3), (len(joints), 1, 1))  # build_rig says what is wrong with them
    return frames_along(bones, joints, parents, "+y", "+z")


class _Arrays:
    """The arrays of one file, with an error of ours for each that is missing or of another kind."""

    def __init__(self, path, keys):
        self.path = str(path)
        self._arrays = read_npz(path, keys)

    def __contains__(self, key):
        return key in self._arrays

    def __getitem__(self, key):
        return self._arrays[key]

    def require(self, keys):
        missing = [key for key in keys if key not in self._arrays]
        if missing:
            raise FileError(self.path, f"no {', '.join(map(repr, missing))}", f"an NPZ with the keys {', '.join(keys)}")

    def text(self, key):
        value = self._arrays[key]
        if value.ndim or value.dtype.kind != "U":
            raise FileError(self.path, f"{key!r} of type {value.dtype} and shape {value.shape}", "one text")
        return str(value)

    def number(self, key):
        if key not in self._arrays:
            self.require([key])
        value = self._arrays[key]
        if value.ndim or value.dtype.kind not in "fiu":
            raise FileError(self.path, f"{key!r} of type {value.dtype} and shape {value.shape}", "one number")
        return float(value)

    def numbers(self, key, ndim):
        value = self._arrays[key]
        if value.ndim != ndim or value.dtype.kind not in "fiu":
            raise FileError(self.path, f"{key!r} of type {value.dtype} and shape {value.shape}", f"numbers in {ndim} dimensions")
        return value

    def names(self, key):
        value = self._arrays[key]
        if value.ndim != 1 or value.dtype.kind not in "US":
            raise FileError(self.path, f"{key!r} of type {value.dtype} and shape {value.shape}", "a list of texts")
        if value.dtype.kind == "S":
            return [v.decode("utf-8", "replace") for v in value.tolist()]
        return [str(v) for v in value.tolist()]

    def json(self, key, kind):
        try:
            value = json.loads(self.text(key))
        except (ValueError, RecursionError):  # ValueError: of JSON, of numbers of thousands of digits
            value = None
        if not isinstance(value, kind):
            raise FileError(self.path, f"{key!r} without the JSON that belongs there", "a file that save_rig wrote")
        return value

    def rows(self, key, shape):
        parts = [self._arrays[f"{key}_{part}"] for part in ("data", "indices", "indptr")]
        data, _, indptr = parts
        ok = all(p.ndim == 1 for p in parts) and data.dtype.kind == "f" and all(p.dtype.kind in "iu" for p in parts[1:])
        try:
            if (
                not ok
                or len(indptr) != shape[0] + 1
                or indptr[0] != 0
                or indptr[-1] != len(data)
                or (indptr[1:] < indptr[:-1]).any()
            ):
                raise ValueError
            matrix = sparse.csr_array(tuple(parts), shape=shape)
            matrix.check_format(full_check=True)
        except (ValueError, IndexError, TypeError):
            raise FileError(
                self.path, f"{key!r} that is not a sparse matrix of shape {shape}", "a file that save_rig wrote"
            ) from None
        return matrix


def _is_texts(value):
    return isinstance(value, list) and all(isinstance(v, str) for v in value)
