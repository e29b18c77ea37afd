"""SMPL-family models (SMPL, SMPL-H, SMPL-X, MANO): the mean shape as a rig, from .npz or .pkl, without chumpy."""

import math
from pathlib import Path

import numpy as np
from scipy import sparse

from ..bundled import bundled_files
from ..errors import FileError
from ..rig.build import build_rig
from ..rig.data import RigData
from ..rig.mirror import mirrored
from ..rig.smpl_anatomy import anatomy_of
from .npz import npz_keys, read_npz
from .npz_rig import read_rig_npz
from .unpickle import ChumpyObject, safe_load

__all__ = ["read_smpl"]

_FINGERS = tuple(f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3))
_BODY = [
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle"),
    *("spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder"),
    *("right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
]
_HANDS = [f"{side}_{finger}" for side in ("left", "right") for finger in _FINGERS]

# By the number of joints, which is what tells the family's models apart: the files themselves hold no names.
_NAMES = {
    16: ("MANO", ["wrist", *_FINGERS]),
    24: ("SMPL", [*_BODY, "left_hand", "right_hand"]),
    52: ("SMPL-H", [*_BODY, *_HANDS]),
    55: ("SMPL-X", [*_BODY, "jaw", "left_eye", "right_eye", *_HANDS]),
}
# Entries of an array that a model may have.
_MOST = 2**31
_ROOT = 2**32 - 1  # −1 as the unsigned integers that the files use
_WANTED = "v_template (m, 3), f (F, 3), weights (m, J), kintree_table (2, J), J_regressor (J, m) or J (J, 3)"
_USED = {"v_template", "f", "faces", "weights", "kintree_table", "J_regressor", "J"}


def read_smpl(path):
    """Read a model of the SMPL family as a rig.

    The template is the mean shape: ``v_template``, with ``J_regressor`` applied to it for the joints (or ``J``, where the
    file has no regressor). Shape and pose blend shapes are left out, and of a hand's pose space the mean, so that Θ = 0 is
    the flat hand; the notes say so.

    Parameters
    ----------
    path : path-like
        ``.npz`` (read without pickle) or ``.pkl`` (read by :func:`lbsfit_np.io.unpickle.safe_load`).

    Returns
    -------
    RigData
        Lengths in metres; up "+y" and forward "+z" for the bodies, by the joints for MANO, unknown for other numbers of joints.
        Rest frames are the identity: the family's joint angles turn about the model's own axes. Joints have the family's usual
        names for 24, 52, 55 and 16 joints, else joint_00, joint_01, … Limits and natural poses are those of the bundled rigs
        where the joints lie as people's do (``rig.smpl_anatomy``), else there are none.

    Raises
    ------
    FileError
        Missing or broken file, missing keys, arrays of wrong shapes, a hierarchy that names joints that are not there, or a
        pickle that asks for more than arrays.
    """
    path = Path(path)
    model = _Model(path, _read_npz(path) if path.suffix.lower() == ".npz" else _read_pickle(path))

    vertices = model.floats("v_template", (None, 3))
    m = len(vertices)
    parents = _parents(model)
    J = len(parents)
    faces = model.integers("f" if "f" in model or "faces" not in model else "faces", (None, 3))
    weights = model.matrix("weights", (m, J))
    if "J_regressor" in model:
        regressor = model.matrix("J_regressor", (J, m))
        joints = regressor @ vertices
    elif "J" in model:
        regressor, joints = None, model.floats("J", (J, 3))
    else:
        raise model.wrong("no J_regressor and no J", "one of them, for the positions of the joints")

    family, names = _NAMES.get(J, (None, [f"joint_{j:0{max(2, len(str(J - 1)))}d}" for j in range(J)]))
    body = family is not None and family != "MANO"
    known = anatomy_of(names, parents, joints, _bundled) if family is not None else None
    return RigData(
        name=path.stem,
        vertices=vertices,
        faces=faces,
        weights=weights,
        joint_names=list(names),
        parents=parents,
        joints=joints,
        frames=np.broadcast_to(np.eye(3), (J, 3, 3)).copy(),
        regressor=regressor,
        lower=None if known is None else known.lower,
        upper=None if known is None else known.upper,
        metres_per_unit=1.0,
        up="+y" if body else known and known.up,
        forward="+z" if body else known and known.forward,
        poses={} if known is None else known.poses,
        smpl_rest=np.broadcast_to(np.eye(3), (J, 3, 3)).copy(),
        notes=_notes(model, family, J, known),
        path=path,
    )


def _bundled(name):
    """A bundled rig: by its file, as another in the working folder may have its name, and without a card."""
    if name == "hand-left-coarse":
        return mirrored(_bundled("hand-coarse"))
    return build_rig(read_rig_npz(bundled_files("*.npz")[name]))


def _notes(model, family, J, known):
    notes = []
    if known is not None:
        whose = f"those of {known.source}, about the model's axes"
        notes.append(f"the file has no limits and no natural poses: it gets {whose} (a card's [limits] can replace them)")
    if family is None:
        notes.append(f"{J} joints match no known model of the SMPL family: joints are numbered, and the up axis is unknown")
    left_out = [key for key in ("shapedirs", "posedirs") if key in model]
    if left_out:
        what = " and ".join(left_out)
        notes.append(f"{what} left out: the template is the mean shape, posed by linear blend skinning alone")
    if any(key in model for key in ("hands_mean", "hands_meanl", "hands_meanr")):
        notes.append("the mean hand pose (hands_mean) is left out: Θ = 0 is the flat hand")
    return notes


def _parents(model):
    """(J,) parents from kintree_table: ids of the joints in row 1, of their parents in row 0."""
    table = model.integers("kintree_table", (2, None))
    ids = table[1].tolist()
    row = {joint: j for j, joint in enumerate(ids)}
    if len(row) < len(ids):
        raise model.wrong("joint ids that repeat in row 1 of kintree_table", "one id for each joint")
    parents = np.full(len(ids), -1)
    for j, parent in enumerate(table[0].tolist()):
        if parent in (-1, _ROOT):
            continue
        if parent not in row:
            got = f"parent {parent} of joint {ids[j]} in kintree_table"
            raise model.wrong(got, "a joint's id from its row 1, or -1 for the root")
        parents[j] = row[parent]
    return parents


class _Model:
    """The file's content, with every access checked: whatever is wrong becomes one FileError that names the key."""

    def __init__(self, path, content):
        self.path, self.content = path, content

    def __contains__(self, key):
        return key in self.content

    def wrong(self, got, expected):
        return FileError(str(self.path), got, expected, "Check that this is a model of the SMPL family, complete and unchanged.")

    def floats(self, key, shape):
        return self._numbers(key, shape, "biuf").astype(float)

    def integers(self, key, shape):
        a = self._numbers(key, shape, "biuf")
        whole = a.astype(np.int64) if np.isfinite(a).all() else None
        if whole is None or not np.array_equal(whole.astype(a.dtype), a):  # by its own type, in which -1 may be 2**64 - 1
            raise self.wrong(f"{key} with values that are not whole numbers", "integers")
        return whole

    def matrix(self, key, shape):
        """A csr_array, from a dense or a sparse one."""
        value = self._value(key)
        if sparse.issparse(value):
            self._fits(key, value.shape, shape)
            return sparse.csr_array(value, dtype=float)
        return sparse.csr_array(self.floats(key, shape))

    def _numbers(self, key, shape, kinds):
        value = self._value(key)
        if sparse.issparse(value):
            self._fits(key, value.shape, shape)  # before it is written out
            value = value.toarray()
        a = np.asarray(value) if isinstance(value, (np.ndarray, list, tuple, int, float)) else None
        if a is None or a.dtype.kind not in kinds:
            if isinstance(value, ChumpyObject):
                what = f"as a {value.kind}, which would have to be computed"
            else:
                what = f"of type {type(value).__name__}" if a is None else f"of {a.dtype} values"
            raise self.wrong(f"{key} {what}", "an array of numbers")
        self._fits(key, a.shape, shape)
        return a

    def _value(self, key):
        if key not in self.content:
            found = ", ".join(sorted(map(str, self.content))[:12]) or "nothing"
            raise self.wrong(f"no {key} (keys: {found})", _WANTED)
        return self.content[key]

    def _fits(self, key, got, shape):
        if len(got) != len(shape) or any(n is not None and n != g for n, g in zip(shape, got)):
            wanted = ", ".join("any" if n is None else str(n) for n in shape)
            raise self.wrong(f"{key} of shape {tuple(got)}", f"shape ({wanted})")
        if math.prod(got) > _MOST:
            raise self.wrong(f"{key} of shape {tuple(got)}", "a model that fits into memory")
        if 0 in got:
            raise self.wrong(f"{key} of shape {tuple(got)}", "at least one row and column")


def _read_pickle(path):
    content = safe_load(path)
    if not isinstance(content, dict):
        raise FileError(str(path), f"a pickled {type(content).__name__}", f"a pickled dict with {_WANTED}")
    return content


def _read_npz(path):
    """The arrays that this module uses; the large ones that it leaves out appear as None."""
    return dict.fromkeys(npz_keys(path)) | read_npz(path, _USED)
