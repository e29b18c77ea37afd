"""The normalised frame of a scan: where it is, how large one of its units is, and which way it faces."""

from dataclasses import dataclass, field

import numpy as np

from ..rotations import matrix_from_rotvec, nearest_rotvec, rotvec_from_matrix

__all__ = ["Frame", "nearest_root", "root_turn", "turned_root"]


@dataclass(frozen=True)
class Frame:
    """x = turn · X · unit + centre, x in the scan's frame, X in the normalised one, where a fit takes place.

    Attributes
    ----------
    centre : (3,) array
    unit : float
        Scan units in one of the frame.
    turn : (3, 3) array
        A rotation; scans that face the rig's way have the identity.
    """

    centre: np.ndarray
    unit: float
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))

    def inside(self, points):
        """(n, 3) points of the scan → the normalised frame."""
        return ((points - self.centre) @ self.turn) / self.unit

    def outside(self, X):
        """(n, 3) points of the normalised frame → the scan's."""
        return (X @ self.turn.T) * self.unit + self.centre


def root_turn(rig, theta):
    """(3, 3): the rotation of the rig's frame by which a pose Θ turns the whole about the root joint."""
    F = rig.frames[rig.root]
    return F @ matrix_from_rotvec(theta[rig.root]) @ F.T


def turned_root(rig, theta, turn):
    """(J, 3) Θ of the same pose with the whole turned about the root joint by a rotation (3, 3) of the rig's frame."""
    F = rig.frames[rig.root]
    theta = np.array(theta, dtype=float)
    theta[rig.root] = rotvec_from_matrix(F.T @ turn @ F @ matrix_from_rotvec(theta[rig.root]))
    return theta


def nearest_root(theta, other, root):
    """(J, 3) Θ of the same pose, the root's turn (it may have whole turns more or fewer) as near as can be to another pose's."""
    theta = np.array(theta, dtype=float)
    theta[root] = nearest_rotvec(theta[root], other[root])
    return theta
