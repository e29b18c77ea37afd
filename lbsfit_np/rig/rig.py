"""Rig: the template mesh, skinning weights, joint hierarchy and joint limits, validated and immutable."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real

import numpy as np
from scipy import sparse

from ..errors import InputError, brief, check_angles, check_array
from .checks import Reporter, check_poses, check_rig
from .digest import poses_digest, rig_digest
from .locked import ReadOnly, locked
from .partition import check_partition, leading_joint, parts_of_joints, vertex_parts
from .proportions import proportions
from .regressor import exact_regressor
from .shapes import ShapeSpace
from .weld import weld_of, weld_rig, welded_as_before

__all__ = ["Rig"]

# Beyond this, and its inverse, lengths squared leave double precision.
_LEAST_FACTOR = 1e-100


@dataclass(frozen=True, eq=False, kw_only=True)
class Rig:
    """An artist's rig, checked and immutable. Get one from ``load_rig`` or ``rig.build.build_rig``.

    All lengths are in the rig's own unit and frame. Arrays over joints keep the source's rows and order.

    Attributes
    ----------
    name : str
    vertices : (m, 3) array
        U, the template in the rest pose.
    faces : (F, 3) int array
    weights : (m, J) sparse csr_array
        Skinning weights w; rows sum to 1. A merged joint's weights are in the column of the nearest unmerged joint above it.
    parents : (J,) int array
        K, the joint hierarchy; −1 for the root.
    joint_names : tuple of str
    joints : (J, 3) array
        Joint positions in the rest pose.
    frames : (J, 3, 3) array
        Rest frames: the columns are the axes that the joint's angles turn about, given in the rig's frame.
    lower, upper : (J, 3) arrays
        (R_l, R_u), joint-angle limits in radians about the rest frame's axes; 0, 0 for locked and merged joints, in any case.
        The root's limits serve only to sample poses: a fit leaves the root unbounded.
    regressor : (J, m) sparse csr_array
        Joint regressor R; rows sum to 1. R U = J wherever the vertices reach, so not for a joint off the plane of a flat mesh.
    merged, locked : (J,) bool arrays
        Merged joints have given their weights to their parents; locked joints keep their weights but never turn.
    partitions : mapping of str to mapping of str to tuple of str
        Named granularities: partition → part → joint names. Besides, every rig has the granularity "joints" (one part per moving
        joint), which need not be among these.
    granularity : str
        The one in use, "joints" or a partition; ``parts`` and labels refer to it.
    metres_per_unit : float or None
    up, forward : str or None
        Such as "+y"; None where unknown.
    notes : tuple of str
        Anomalies found while reading, and what was done about them.
    poses : mapping of str to (J, 3) array
        A library of natural poses, in radians in the rest frames, locked and merged joints unturned; empty where there is none.
    shapes : ShapeSpace or None
        Shape parameters and what they do (``rig.shapes.ShapeSpace``); :meth:`subject` sets them.
    smpl_rest : (J, 3, 3) array or None
        For a rig with the joints of SMPL or MANO: rotations from this rig's rest pose to theirs (``rig.smpl_pose``).
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    weights: sparse.csr_array
    parents: np.ndarray
    joint_names: tuple
    joints: np.ndarray
    frames: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    regressor: sparse.csr_array
    merged: np.ndarray
    locked: np.ndarray
    partitions: Mapping = field(default_factory=dict)
    granularity: str = "joints"
    metres_per_unit: float | None = None
    up: str | None = None
    forward: str | None = None
    notes: tuple = ()
    poses: Mapping = field(default_factory=dict)
    shapes: ShapeSpace | None = None
    smpl_rest: np.ndarray | None = None

    def __post_init__(self):
        check_rig(self)
        poses = check_poses(Reporter(None), self.poses, self.joint_names)
        given = {n: p for n, p in self.poses.items() if isinstance(p, np.ndarray) and p.dtype == float}  # need no copy if locked
        still = self.merged | self.locked
        poses = {name: locked(_unturned(pose, still)) for name, pose in (poses | given).items()}
        self.__dict__.update({name: _unturned(getattr(self, name), still) for name in ("lower", "upper")})
        self.__dict__.update({name: locked(value) for name, value in self.__dict__.items()})
        self.__dict__.update(poses=ReadOnly(poses), partitions=_read_only(self.partitions))

    def __repr__(self):
        m, J = self.weights.shape
        return f"<Rig {self.name!r}: {m} vertices, {J} joints ({int(self.moving.sum())} moving), {len(self.parts)} parts>"

    def __setstate__(self, state):
        """Restore a pickled rig; NumPy's pickles forget that arrays were locked."""
        self.__dict__.update({name: locked(value, copy=False) for name, value in state.items()})
        for pose in self.poses.values():
            locked(pose, copy=False)

    def __deepcopy__(self, memo):
        return self  # immutable: a copy would be the same rig

    # ---- derived, computed once ----

    @cached_property
    def root(self):
        """Row of the root joint."""
        return int(np.flatnonzero(self.parents < 0)[0])

    @cached_property
    def levels(self):
        """The joints below the root by depth: a tuple of (rows, rows of their parents), top down."""
        depth = np.zeros(len(self.parents), dtype=int)
        for j in range(len(self.parents)):
            k = j
            while self.parents[k] >= 0:
                depth[j] += 1
                k = self.parents[k]
        rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
        return tuple((r, self.parents[r]) for r in rows)

    @cached_property
    def moving(self):
        """(J,) bool: the unlocked joints, which are the root and every joint with room between its limits."""
        moving = np.any(self.upper > self.lower, axis=1) & ~self.merged & ~self.locked
        moving[self.root] = True
        return moving

    @cached_property
    def turning(self):
        """(J, 3) bool: the angles with room between their limits, of joints that are not locked."""
        return (self.upper > self.lower) & self.moving[:, None]

    @cached_property
    def size(self):
        """Longest side of the bounding box of the rest pose's surface, in rig units."""
        return float(self.sides.max())

    @property
    def sides(self):
        """(3,): sides of the box of :attr:`size`. Vertices that are loose or only in degenerate faces do not count."""
        return np.ptp(self.vertices[~self.loose], axis=0)

    @cached_property
    def weights_transposed(self):
        """(J, m) sparse csr_array, for the adjoint."""
        return sparse.csr_array(self.weights.T)

    @cached_property
    def regressor_transposed(self):
        """(m, J) sparse csr_array, for the adjoint."""
        return sparse.csr_array(self.regressor.T)

    @cached_property
    def leading_joint(self):
        """(m,) int: argmax_j w_ij, the joint that each vertex follows most; the lowest row on ties."""
        return leading_joint(self.weights)

    @cached_property
    def _parts(self):
        return parts_of_joints(self)

    @property
    def parts(self):
        """Names of the parts; labels index this tuple."""
        return self._parts[0]

    @property
    def part_of_joint(self):
        """(J,) int: the part that a vertex led by joint j belongs to."""
        return self._parts[1]

    @cached_property
    def vertex_labels(self):
        """(m,) int: each vertex's part, argmax_j w_ij mapped to the granularity in use."""
        return vertex_parts(self)

    @cached_property
    def _weld(self):
        return weld_of(self.vertices, self.weights, self.faces)

    @property
    def weld(self):
        """(m,) int: the row of ``welded`` that each vertex is, duplicates at seams being joined; of a loose one, the nearest."""
        return self._weld.rows

    @property
    def loose(self):
        """(m,) bool: vertices of no face, or only of faces with two corners at one point; no scan shows them."""
        return self._weld.loose

    @property
    def welded_from(self):
        """(n,) int: the first of this rig's vertices that each of ``welded`` is."""
        return self._weld.first

    @cached_property
    def welded(self):
        """The rig's surface, on which the fit works: duplicate vertices joined, loose ones left out; itself if there are none."""
        return weld_rig(self)

    def unwelded(self, U):
        """(m, 3): vertices of ``welded`` on another template as this rig's own; loose ones move as the nearest ones do."""
        loose, own = self.loose, U[self.weld]
        own[loose] += self.vertices[loose] - self.welded.vertices[self.weld[loose]]
        return own

    def without_loose(self, vertices):
        """(m, 3) vertices of a pose with loose ones moved to the nearest others: no box is wider for what no scan shows."""
        loose = self.loose
        if not loose.any():
            return vertices
        vertices = vertices.copy()
        vertices[loose] = vertices[self.welded_from[self.weld[loose]]]
        return vertices

    @cached_property
    def proportions(self):
        """The linear family of templates with other bone lengths and thicknesses (``rig.proportions.Proportions``)."""
        return proportions(self)

    @cached_property
    def digest(self):
        """Hex digest of what segmenters and fits belong to: geometry, weights, regressor, hierarchy, limits, parts.

        It leaves out the unit and the axes, which only tell how a scan may lie and be measured.
        """
        return rig_digest(self)

    @property
    def poses_digest(self):
        """Hex digest of the natural poses, which ``digest`` leaves out; it depends on their order, by which they are drawn."""
        return poses_digest(self.poses)

    # ---- what people do with a rig ----

    def pose(self, theta, translation=None, scale=1.0, offsets=None, *, joints="follow"):
        """Pose the template: scale · M(Θ, U + offsets) + translation.

        Parameters
        ----------
        theta : (J, 3) array
            Rotation vectors in the joints' rest frames, radians; Θ = 0 is the rest pose.
        translation : (3,) array, optional
        scale : float, default 1
        offsets : (m, 3) array, optional
            In rig units.
        joints : {"follow", "fixed"} or (J, 3) array, default "follow"
            Whether the rest joints follow the offsets through the regressor or stay; an array says where they are.

        Returns
        -------
        (m, 3) array
        """
        return self._posed(theta, translation, scale, offsets, joints).vertices

    def pose_joints(self, theta, translation=None, scale=1.0, offsets=None, *, joints="follow"):
        """Posed joint positions, (J, 3); arguments as in :meth:`pose`."""
        return self._posed(theta, translation, scale, offsets, joints).joints

    def _posed(self, theta, translation, scale, offsets, joints):
        from ..skinning import JOINT_MODES, skin

        theta = check_angles("theta", theta, self.lower.shape)
        if translation is not None:
            translation = check_array("translation", translation, (3,))
        if offsets is not None:
            offsets = check_array("offsets", offsets, self.vertices.shape)
        if isinstance(scale, np.ndarray) and scale.ndim == 0:
            scale = scale[()]  # as NumPy's files have it
        factor = _as_float(scale)
        if not 0 < factor < np.inf:
            raise InputError("scale", brief(scale), "a positive number")
        moved = None
        if not isinstance(joints, str):
            moved, joints = check_array("joints", joints, self.joints.shape) - self.joints, "follow"
        elif joints not in JOINT_MODES:
            expected = f"{' or '.join(map(repr, JOINT_MODES))}, or rest positions of shape {self.joints.shape}"
            raise InputError("joints", brief(joints), expected)
        return skin(self, theta, translation=translation, scale=factor, offsets=offsets, joint_offsets=moved, joints=joints)

    def with_parts(self, granularity):
        """Return the same rig with another of its partitions in use."""
        check_partition("parts", granularity, self.partitions)
        return welded_as_before(self, granularity=granularity)

    def with_template(self, vertices, joints=None):
        """Return the same rig on a changed template U^d.

        Parameters
        ----------
        vertices : (m, 3) array
            U^d: the same vertices in the same order, of which the same ones are one point of the surface.
        joints : (J, 3) array, optional
            Joint positions of U^d; by default the regressor's, J + R (U^d − U).
        """
        vertices = check_array("vertices", vertices, self.vertices.shape)
        moved = self.joints + self.regressor @ (vertices - self.vertices)
        joints = moved if joints is None else check_array("joints", joints, self.joints.shape)
        regressor = exact_regressor(self.regressor, vertices, joints)
        return welded_as_before(self, vertices=vertices, joints=joints, regressor=regressor)

    def scaled(self, factor):
        """Return the same rig in another unit: all lengths times ``factor``, a positive number; others raise InputError."""
        factor = _checked_factor(factor)
        unit = None if self.metres_per_unit is None else self.metres_per_unit / factor
        shapes = None if self.shapes is None else self.shapes.mapped(lambda directions: directions * factor)
        lengths = {"vertices": self.vertices * factor, "joints": self.joints * factor}
        return welded_as_before(self, **lengths, metres_per_unit=unit, shapes=shapes)

    def mirrored(self, *, name=None, axis="x"):
        """Return the mirror image, such as a left hand from a right one. The same angles give the mirrored pose.

        Parameters
        ----------
        name : str, optional
            By default this rig's name with left and right exchanged, or with "-mirrored" appended.
        axis : {"x", "y", "z"}, default "x"
            The coordinate that changes sign.

        Returns
        -------
        Rig
            ``mirrored.pose(theta)`` is ``pose(theta)`` with that coordinate negated. Joints keep their rows. Left and right
            change places in the names of joints, parts and poses; where that renames joints, ``smpl_rest`` is left out.
        """
        from .mirror import mirrored

        return mirrored(self, name, axis=axis)

    def subject(self, random_state=None, *, amount=1.0, **parameters):
        """Return the same rig on another person's template, with that person's joints.

        Parameters
        ----------
        random_state : int, Generator or None
            An int always gives the same person.
        amount : float, default 1
            How far people differ, from 0 to 2: 1 is as in reality, and 0 changes only the given parameters of this rig.
        **parameters
            Values of shape parameters; ``rig.shapes`` names them, with range and unit. Parameters not given are drawn around
            their defaults, with the spread of people times ``amount``, within their ranges.

        Returns
        -------
        Rig
            Its template is U + Σ (v − default) D (``rig.shapes.ShapeSpace``), and its ``shapes.default`` are the values v.
            In addition, each bone's length and thickness vary (``rig.proportions``), left and right limbs alike. The standard
            deviation is 0.03 ``amount``, or 0.08 ``amount`` for rigs without shape parameters, cut at two deviations. With
            amount=0, only the given parameters change.

        Raises
        ------
        InputError
            A parameter that is unknown or out of its range; ``amount`` out of its range.
        """
        from .subject import subject

        return subject(self, random_state, amount, parameters)

    def to_smpl_pose(self, theta):
        """Return a pose in SMPL's or MANO's convention.

        Parameters
        ----------
        theta : (J, 3) array
            Radians, in this rig's rest frames.

        Returns
        -------
        (J, 3) array
            Rotation vectors relative to the parents, in frames parallel to the world's, from the rest pose of SMPL (T-pose, y
            up, facing +z) or MANO (flat hand; the pose parameters with the mean pose added). The first row turns the whole.

        Raises
        ------
        InputError
            The rig has no ``smpl_rest``.
        """
        from .smpl_pose import to_smpl_pose

        return to_smpl_pose(self, theta)

    def from_smpl_pose(self, pose):
        """Return the angles, (J, 3), of a pose in SMPL's or MANO's convention, given as (J, 3) or flat (3 J,).

        This is the inverse of :meth:`to_smpl_pose`, with the same errors. Nothing is clipped to this rig's limits.
        """
        from .smpl_pose import from_smpl_pose

        return from_smpl_pose(self, pose)

    def save(self, path):
        """Write the rig as the package's own NPZ (no pickle); ``load_rig`` reads it back."""
        from ..io.npz_rig import save_rig

        save_rig(self, path)


def _unturned(angles, still):
    """(J, 3) angles, 0 for joints that are still; the array itself where they are."""
    return np.where(still[:, None], 0.0, angles) if angles[still].any() else angles


def _read_only(partitions):
    """Name → part → joints as mappings that nobody can write to."""
    return ReadOnly({name: ReadOnly({part: tuple(on) for part, on in of.items()}) for name, of in partitions.items()})


def _as_float(number):
    """A number in double precision: infinite where it is beyond that, NaN where it is none."""
    try:
        return float(number) if isinstance(number, Real) and not isinstance(number, bool) else np.nan
    except OverflowError:
        return np.inf


def _checked_factor(factor):
    size = _as_float(factor)
    if not _LEAST_FACTOR <= size <= 1 / _LEAST_FACTOR:
        bounds = f"a positive number, from {_LEAST_FACTOR:g} to {1 / _LEAST_FACTOR:g}"
        raise InputError("factor", brief(factor), bounds, "For example, 100 converts metres to centimetres.")
    return size
