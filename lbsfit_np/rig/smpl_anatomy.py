"""How far people's joints turn, and how they stand naturally, for models of the SMPL family: their files do not say.

The bundled rigs, which have the joints of SMPL and of MANO, know both about axes of their own and from another rest pose. With
A_j the rotation from a bundled rig's rest pose to SMPL's (``smpl_rest``), p the parent of j, F_j its rest frame and θ_j its
angles, SMPL's own local rotation is A_p exp(F_j θ_j) A_jᵀ = (A_p A_jᵀ) exp(A_j F_j θ_j). Where A_p = A_j, as for nearly all
joints, the box of limits is turned with the axes; a box about SMPL's axes then holds all of it.
"""

import re
from dataclasses import dataclass

import numpy as np

from ..rotations import matrix_from_rotvec, rotvec_from_matrix
from .frames import AXES
from .smpl_pose import to_smpl_pose

__all__ = ["Anatomy", "anatomy_of"]

# Degrees between the bones of a model and of a bundled rig, at most: of those that a T-pose and a flat hand hold straight, and of
# others, whose joints models put elsewhere. SMPL's own are 3 and 37 degrees off.
_STRAIGHT = re.compile("knee|ankle|elbow|wrist|hand|index|middle|ring|pinky")
_ALIKE, _OTHERS_ALIKE = 25.0, 50.0
# Angles about each axis by which a box is looked at.
_STEPS = 7
# Each limit is further out by this, in rad: a model's own axes and rest pose are not to the degree those of the bundled rigs.
_MARGIN = 0.1
# Shoulders stand otherwise in T-pose by more than this, in rad. What their box becomes is none, and one that held all of it would
# hold much that no arm does: it holds what is natural, and of the rest all but the outer tenth on each side.
_OTHERWISE, _OUTER = 0.5, 0.1
# What the bundled rigs do not have, in rad.
_FACE = {
    "jaw": ([-0.05, -0.1, -0.05], [0.5, 0.1, 0.05]),
    "left_eye": ([-0.4, -0.4, 0.0], [0.4, 0.4, 0.0]),
    "right_eye": ([-0.4, -0.4, 0.0], [0.4, 0.4, 0.0]),
}


@dataclass(frozen=True)
class Anatomy:
    """Of joints in SMPL's or MANO's order, about the model's axes, from T-pose or flat hand.

    Attributes
    ----------
    lower, upper : (J, 3) arrays
        Limits of the joint angles, radians. Θ = 0 is within them.
    poses : dict of str to (J, 3) array
        Natural poses.
    up, forward : str
        The model's axes.
    source : str
        Whose limits and poses these are, in words.
    """

    lower: np.ndarray
    upper: np.ndarray
    poses: dict
    up: str
    forward: str
    source: str


def anatomy_of(names, parents, joints, bundled):
    """What is known of a model's joints by their names, where they also hang and lie as people's do.

    Parameters
    ----------
    names : list of str
        As ``io.smpl`` gives them.
    parents : (J,) int array
    joints : (J, 3) array
    bundled : callable (str) → Rig
        Loads a bundled rig.

    Returns
    -------
    Anatomy or None
        None for models of other things, in other rest poses, or about other axes.
    """
    if not np.isfinite(joints).all():
        return None  # what checks rigs says so
    if names[0] == "wrist":
        sides = (("hand-coarse", "the bundled hand"), ("hand-left-coarse", "the bundled left hand"))
        known = [(_Known(bundled(name)), source) for name, source in sides]
        return next((k.of(names, source) for k, source in known if k.is_like(names, parents, joints)), None)
    body = _Known(bundled("body-coarse"))
    if not body.is_like(names, parents, joints):
        return None
    others = {name: (np.array(low), np.array(high)) for name, (low, high) in _FACE.items()}
    if fingers := [name for name in names if name not in body.row and name not in others]:
        hands = {side: _Known(bundled(name)) for side, name in (("left", "hand-left-coarse"), ("right", "hand-coarse"))}
        if not all(hand.is_like(names, parents, joints, f"{side}_") for side, hand in hands.items()):
            return None
        others |= {name: hands[name.split("_")[0]].box(name.split("_")[1]) for name in fingers}
    return body.of(names, "the bundled body" + (" and hands" if fingers else ""), others)


class _Known:
    """A bundled rig as SMPL or MANO has it."""

    def __init__(self, rig):
        self._rig, self.row = rig, {name: j for j, name in enumerate(rig.joint_names)}
        self._lower, self._upper = self._boxes()

    def is_like(self, names, parents, joints, prefix=""):
        """Whether bones of the same names, but for a prefix of the model's, hang on the same joints and point the same way."""
        rig = self._rig
        place = rig.pose_joints(rig.from_smpl_pose(np.zeros(rig.lower.shape)))
        ours = {prefix + name: k for name, k in self.row.items()}
        for j, name in enumerate(names):
            k = ours.get(name)
            if k is None or rig.parents[k] < 0:
                continue
            if parents[j] < 0 or ours.get(names[parents[j]]) != rig.parents[k]:
                return False
            most = _ALIKE if _STRAIGHT.search(name) else _OTHERS_ALIKE
            if not _angle(joints[j] - joints[parents[j]], place[k] - place[rig.parents[k]]) <= np.radians(most):
                return False
        across = [(names.index(prefix + name), self.row[name]) for name in ("index1", "pinky1") if name in self.row]
        if across:  # straight fingers point the same way however the hand is turned about them
            (i, k), (j, m) = across
            return bool(_angle(joints[i] - joints[j], place[k] - place[m]) <= np.radians(_ALIKE))
        return True

    def box(self, name):
        """Limits of a joint, two (3,) arrays."""
        return self._lower[self.row[name]], self._upper[self.row[name]]

    def of(self, names, source, others=None):
        """The Anatomy of a model that has these joints, and others whose limits are given."""
        boxes = [self.box(name) if name in self.row else others[name] for name in names]
        rows, there = [self.row.get(name, 0) for name in names], np.array([[name in self.row] for name in names])
        poses = {pose: np.where(there, theta[rows], 0.0) for pose, theta in self._poses.items()}
        up, forward = (self._axis(AXES[axis]) for axis in (self._rig.up, self._rig.forward))
        return Anatomy(*map(np.array, zip(*boxes, strict=True)), poses, up, forward, source)

    @property
    def _poses(self):
        rig, out = self._rig, {}
        for name, theta in rig.poses.items():
            out[name] = to_smpl_pose(rig, theta)
            out[name][rig.root] = rig.smpl_rest[rig.root] @ rig.frames[rig.root] @ theta[rig.root]  # from the model's own rest
        return out

    def _boxes(self):
        rig, A = self._rig, self._rig.smpl_rest
        lower, upper = np.zeros_like(rig.lower), np.zeros_like(rig.upper)
        for j, p in enumerate(rig.parents):
            axes = np.meshgrid(*np.linspace(rig.lower[j], rig.upper[j], _STEPS).T, indexing="ij")
            turned = matrix_from_rotvec(np.stack(axes, axis=-1).reshape(-1, 3) @ (A[j] @ rig.frames[j]).T)
            rest = np.eye(3) if p < 0 else A[p] @ A[j].T
            angles = rotvec_from_matrix(rest @ turned)
            outer = _OUTER if np.linalg.norm(rotvec_from_matrix(rest)) > _OTHERWISE else 0.0
            lower[j], upper[j] = np.quantile(angles, [outer, 1 - outer], axis=0)
        natural = np.array([*self._poses.values(), np.zeros(rig.lower.shape)])
        lower, upper = np.minimum(lower, natural.min(axis=0)), np.maximum(upper, natural.max(axis=0))
        return np.round(lower - _MARGIN, 2), np.round(upper + _MARGIN, 2)

    def _axis(self, direction):
        """The model's name of a direction of the rig's rest pose."""
        turned = self._rig.smpl_rest[self._rig.root] @ direction
        return max(AXES, key=lambda axis: np.dot(AXES[axis], turned))


def _angle(a, b):
    """Between two vectors, radians."""
    return np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)) if a.any() else np.pi
