"""What a file says about a rig, before anything is checked or derived: the importers' common output."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import sparse

from .shapes import ShapeSpace
from .weld import Weld

__all__ = ["RigData"]


@dataclass
class RigData:
    """Raw content of a rig file, in the file's own order and units.

    Importers (``lbsfit_np.io``) fill it from one format each and check only what their format defines (indices that
    point outside a buffer, missing keys); ``rig.build.build_rig`` applies the card, checks the rest and makes the Rig.
    """

    name: str
    vertices: np.ndarray  # (m, 3) rest pose U, in the rig's frame and unit
    faces: np.ndarray  # (F, 3) int, rows of vertices
    weights: sparse.csr_array  # (m, J) skinning weights as the file has them; sums are not touched by importers
    joint_names: list[str]  # J, unique
    parents: np.ndarray  # (J,) int, -1 for a root; several roots are possible here
    joints: np.ndarray  # (J, 3) joint positions in the rest pose
    frames: np.ndarray  # (J, 3, 3) rest frames: columns are the joint's own axes in the rig's frame, orthonormal
    bones: np.ndarray | None = None  # (J, 3) along the bones, 0 to go by children, where frames follow them
    regressor: sparse.csr_array | None = None  # (J, m) joint regressor, where the file has one
    lower: np.ndarray | None = None  # (J, 3) joint-angle limits, radians, where the file has them
    upper: np.ndarray | None = None
    animated: np.ndarray | None = None  # (k, J, 3) rotation vectors in the rest frames, sampled from the file's animations
    metres_per_unit: float | None = None  # None: unknown
    up: str | None = None  # one of "+x" "-x" "+y" "-y" "+z" "-z"; None: unknown
    forward: str | None = None
    merged: np.ndarray | None = None  # (J,) bool: merged into their parents; only our own NPZ has this
    locked: np.ndarray | None = None  # (J,) bool: locked; only our own NPZ has this
    partitions: Mapping[str, Mapping[str, tuple[str, ...]]] = field(default_factory=dict)  # name -> part -> joint names
    parts: str | None = None  # the partition in use, where the file says
    poses: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (J, 3) rotation vectors: natural poses
    shapes: ShapeSpace | None = None  # shape parameters
    smpl_rest: np.ndarray | None = None  # (J, 3, 3) A_j: from this rig's rest pose to SMPL's or MANO's, see rig.smpl_pose
    welding: Weld | None = None  # which vertices are one point, where the file says; None: by what they are
    notes: list[str] = field(default_factory=list)  # anomalies met while reading, in words
    path: Path | None = None  # the file, where there is one
