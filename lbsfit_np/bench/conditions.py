"""The conditions of ``lbsfit bench starts``: for each row of its table how scans are made, and what is to be reached."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import InputError
from ..rig.frames import up_axis
from ..rig.units import METRES, USUAL
from ..rotations import matrix_from_rotvec, rotvec_from_matrix
from ..seeds import generator
from ..starts.beyond import end_of
from ..synthesis import Synthesis, natural_poses, synthesize_one
from .arm import with_an_arm
from .learn import touching_pose

__all__ = ["CONDITIONS", "SEEN", "Condition", "condition_scan", "conditions_of", "starts_scan"]

# Of the row "unit", the scale besides the unit, uniform in its logarithm.
_SCALES = 0.5, 2.0
# Poses of a library with this in their name are fists.
_FIST = "fist"
_POSE_NOISE = 0.05  # rad, as that of natural poses
# Points of a part that a one-sided view has to show for the part's joint to count.
SEEN = 20

# Noise, holes and uneven density as in training, the rig's own shape.
_SCAN = Synthesis(shape=0.0)


@dataclass(frozen=True)
class Condition:
    """One row of the table.

    Attributes
    ----------
    what : str
        In words.
    goal : float
        Share of the scans to be fitted within ``close``.
    pose : callable (rig, i, rng) → (J, 3) array
        The pose of scan i, turned as the condition wants it.
    close : float
        A fit succeeds whose mean joint error is at most this share of the rig's size times the scan's true scale.
    fitter : dict
        Parameters of ``LBSFitter`` that tell it what a user would know.
    scan : Synthesis
        How scans are made.
    unit : bool
        Whether a scan comes in a random unit and scale.
    subjects : bool
        Whether each scan is of another person.
    arm : bool
        Whether scans go on beyond the end of the rig; only rigs that have one are in such a row.
    only : tuple of str
        Joint names that a rig needs for this row; any rig by default.
    poses : str
        What the name of one of the rig's natural poses must have in it; any by default.
    """

    what: str
    goal: float
    pose: Callable
    close: float = 0.015
    fitter: dict = field(default_factory=dict)
    scan: Synthesis = _SCAN
    unit: bool = False
    subjects: bool = False
    arm: bool = False
    only: tuple = ()
    poses: str = ""

    @property
    def labelled(self):
        """Whether all points of the scans are of some part."""
        return not (self.scan.clutter or self.scan.floor or self.arm)


def conditions_of(rig):
    """The rows that a rig can be in, in their order; raises InputError where it has no library of natural poses."""
    if not rig.poses:
        raise InputError("rig", f"{rig.name}, which has no library of natural poses", "a rig with one", "See: lbsfit rig list")
    ends, names = end_of(rig) is not None, "\n".join(rig.poses)
    suited = {row: c for row, c in CONDITIONS.items() if set(c.only) <= set(rig.joint_names) and c.poses in names}
    return [row for row, c in suited.items() if ends or not c.arm]


def starts_scan(rig, row, i, seed):
    """Scan ``i`` of a row, with its truth; a function of the rig, the row, ``i`` and the seed, whatever else is made.

    Parameters
    ----------
    rig : Rig
        With a library of natural poses, where the row takes poses from it.
    row : str
        Of :data:`CONDITIONS`.
    i : int
    seed : int

    Returns
    -------
    SyntheticScan
        In the scan's frame and unit: the turn of the whole is part of ``pose``, the unit is ``scale``, and
        ``rig.pose(pose, translation, scale, template − U, joints=template_joints)`` is ``vertices``.
    """
    return condition_scan(rig, CONDITIONS[row], i, generator(seed, "starts", rig.name, row, i))


def condition_scan(rig, condition, i, rng):
    """Scan ``i`` under a condition, with its truth, as :func:`starts_scan`; random by ``rng``."""
    person = rig.subject(rng) if condition.subjects else rig
    pose = condition.pose(rig, i, rng)
    scan = synthesize_one(rig, pose, (person.vertices, person.joints), condition.scan, rng)
    if condition.arm:
        scan = with_an_arm(rig, scan, condition.scan.noise, rng)
    return _in_a_unit(rig, scan, rng) if condition.unit else scan


def _in_a_unit(rig, scan, rng):
    """The scan in a random unit, at a random scale besides."""
    low, high = np.log(_SCALES)
    factor = (rig.metres_per_unit or 1.0) / METRES[USUAL[rng.integers(len(USUAL))]] * np.exp(rng.uniform(low, high))
    return replace(
        scan,
        points=factor * scan.points,
        translation=factor * scan.translation,
        scale=factor * scan.scale,
        vertices=factor * scan.vertices,
        joints=factor * scan.joints,
    )


# ---- poses ----


@dataclass(frozen=True)
class _Bent:
    """Every moving joint but the root turned by one angle (radians) about a random axis, within its limits.

    Where limits leave less than the angle in the drawn direction, the other axes take up what they can of it. On which side of 0
    an axis turns is drawn by how much room there is.
    """

    angle: float

    def __call__(self, rig, i, rng):
        lower, upper = np.minimum(rig.lower, 0.0), np.maximum(rig.upper, 0.0)
        side = np.where(rng.random(lower.shape) * (upper - lower) < upper, 1.0, -1.0)
        direction = side * np.abs(rng.standard_normal(lower.shape))
        least, most = np.zeros((len(lower), 1)), np.full((len(lower), 1), 1e4)
        for _ in range(60):  # the length along the direction, cut to the limits, that makes the angle
            middle = (least + most) / 2
            short = np.linalg.norm(np.clip(middle * direction, lower, upper), axis=1, keepdims=True) < self.angle
            least, most = np.where(short, middle, least), np.where(short, most, middle)
        theta = np.clip(most * direction, rig.lower, rig.upper)
        theta[~rig.moving] = 0.0
        theta[rig.root] = 0.0
        return theta


def _upright(rig, i, rng):
    """A natural pose, turned by any angle about the up axis."""
    turn = matrix_from_rotvec(rng.uniform(-np.pi, np.pi) * up_axis(rig))
    return _turned(rig, natural_poses(rig, 1, rng)[0], turn)


def _rotated(rig, i, rng):
    """A natural pose under a rotation that is uniform among all."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.random(random_state=rng).as_matrix()
    return _turned(rig, natural_poses(rig, 1, rng)[0], turn)


def _touching(rig, i, rng):
    """A third fists and what is near them, the others poses between natural ones with ends of limbs that touch; root at rest."""
    library = np.stack(list(rig.poses.values()))
    if i % 3:
        return touching_pose(rig, library, rng)
    fists = np.flatnonzero([_FIST in name for name in rig.poses])
    if not len(fists):
        raise InputError("rig", f"{rig.name}, which has no fist among its natural poses", "a hand with one, such as: hand")
    theta = library[rng.choice(fists)]
    if rng.random() < 0.5:
        t = 0.5 * rng.random()
        theta = (1 - t) * theta + t * library[rng.integers(len(library))]
    theta = np.clip(theta + _POSE_NOISE * rng.standard_normal(theta.shape), rig.lower, rig.upper)
    theta[rig.root] = 0.0
    return theta


def _turned(rig, theta, turn):
    """The pose with the whole turned by a rotation of the rig's frame, about the root."""
    theta = theta.copy()
    frame = rig.frames[rig.root]
    theta[rig.root] = rotvec_from_matrix(frame.T @ turn @ frame @ matrix_from_rotvec(theta[rig.root]))
    return theta


# ---- the table ----

_ALIGNED, _UPRIGHT = {"orientation": "aligned"}, {"orientation": "upright"}

CONDITIONS = {
    "0.3": Condition("0.3 rad a joint, facing known", 0.99, _Bent(0.3), fitter=_ALIGNED),
    "0.6": Condition("0.6 rad a joint, facing known", 0.98, _Bent(0.6), fitter=_ALIGNED),
    "1.0": Condition("1.0 rad a joint, facing known", 0.95, _Bent(1.0), fitter=_ALIGNED),
    "turned": Condition("natural poses, any turn about the up axis", 0.97, _upright, fitter=_UPRIGHT),
    "rotated": Condition("natural poses, any rotation", 0.90, _rotated, fitter={"orientation": "any"}),
    "unit": Condition(
        "natural poses, any turn, unknown unit, scale 0.5 to 2",
        0.97,
        _upright,
        close=0.03,
        fitter=_UPRIGHT | {"scale": "estimate"},
        unit=True,
    ),
    "touching": Condition("touching fingers and fists", 0.95, _touching, only=("index1", "thumb1"), poses=_FIST),
    "partial": Condition(
        "one-sided view, any turn; joints whose part is seen",
        0.85,
        _upright,
        close=0.03,
        fitter=_UPRIGHT | {"partial": True},
        scan=replace(_SCAN, one_sided=True),
    ),
    "cropped": Condition(
        "up to half cut off, any turn; joints whose part is seen",
        0.90,
        _upright,
        close=0.03,
        fitter=_UPRIGHT | {"cropped": True},
        scan=replace(_SCAN, cropped=0.5),
    ),
    "edge": Condition(
        "one-sided view of which up to half is cut off, any turn; joints whose part is seen",
        0.85,
        _upright,
        close=0.03,
        fitter=_UPRIGHT | {"partial": True, "cropped": True},
        scan=replace(_SCAN, one_sided=True, cropped=0.5),
    ),
    "dirty": Condition(
        "10 % clutter, 1 % noise, holes; any turn",
        0.95,
        _upright,
        close=0.03,
        fitter=_UPRIGHT,
        scan=replace(_SCAN, clutter=0.1, noise=0.02, holes=2, least_holes=1),
    ),
    "subjects": Condition(
        "other people, 0.6 rad a joint, facing known", 0.95, _Bent(0.6), close=0.03, fitter=_ALIGNED, subjects=True
    ),
    "arm": Condition("natural poses, any turn, the arm beyond the wrist", 0.90, _upright, fitter=_UPRIGHT, arm=True),
}
