"""Which way a scan may face: the turns that a start is tried under."""

from dataclasses import dataclass, field

import numpy as np

from ..rig.frames import AXES, up_axis
from ..rotations import matrix_from_quaternion, matrix_from_rotvec

__all__ = [
    "ALONG",
    "ORIENTATIONS",
    "Facing",
    "any_side_up",
    "axis_name",
    "contradicts_note",
    "facing_of",
    "some_turns",
    "stands_note",
]

ORIENTATIONS = ("aligned", "upright", "any")
# Steps of 15° about the up axis; all rotations some 30° apart. Steps towards the surface turn the rest of the way.
_UPRIGHT = 24
_ANY = 600
# What is less than 30° from a coordinate axis stands along it.
ALONG = np.cos(np.radians(30.0))


@dataclass(frozen=True)
class Facing:
    """How scans may be turned against a rig.

    Attributes
    ----------
    turns : (R, 3, 3) array
        Rotations from the rig's frame to the scans' that cover it; by default the identity alone.
    up : (3,) array or None
        The direction that is up in a scan; None where any may be.
    open_up : bool
        Whether that is but what is likely, and scans may stand along another coordinate axis after all.
    told : bool
        Whether the user has said which one it is.
    """

    turns: np.ndarray = field(default_factory=lambda: np.eye(3)[None])
    up: np.ndarray | None = None
    open_up: bool = False
    told: bool = False

    @property
    def floors(self):
        """Directions that may be up where there is a floor, the likeliest first; None where any may."""
        if self.up is None:
            return None
        return _sides(self.up) if self.open_up else self.up[None]


def facing_of(rig, orientation, up=None):
    """The turns that a fitter's parameters leave open.

    Parameters
    ----------
    rig : Rig
        Its up axis matters; +y where it has none.
    orientation : {"aligned", "upright", "any"}
        The scan faces the rig's way, is turned about the up axis, or is turned in any way.
    up : str, optional
        The scans' up axis where it is known, such as "+z"; by default the rig's, but for scans that it does not suit. Scans of
        another up axis than the rig's are taken to be turned by the shortest way from one to the other, and then as said.

    Returns
    -------
    Facing
    """
    if orientation == "any":
        return Facing(np.concatenate([np.eye(3)[None], _spread_rotations(_ANY - 1)]))
    own = up_axis(rig)
    turns = np.eye(3)[None]
    if orientation == "upright":
        angles = np.linspace(0.0, 2 * np.pi, _UPRIGHT, endpoint=False)
        turns = matrix_from_rotvec(angles[:, None] * own)
    if up is None:
        return Facing(turns, own, open_up=orientation == "upright")
    return Facing(_turn_from(own, np.array(AXES[up])) @ turns, np.array(AXES[up]), told=True)


def any_side_up(turns, up):
    """(6 R, 3, 3) the turns as they are, then with each other coordinate axis of the scan, either way, for the up axis."""
    return np.concatenate([_turn_from(up, side) @ turns for side in _sides(up)])


def _sides(up):
    """(6, 3) the coordinate axes, either way, one of which comes first."""
    return np.concatenate([up[None], -up[None], *(np.stack([e, -e]) for e in np.eye(3)[up == 0])])


def stands_note(turn, up):
    """In words, which way a scan stands that was turned so, where its up axis is not the rig's; else empty."""
    along = turn @ up
    axis = int(np.abs(along).argmax())
    if along[axis] * up[axis] > 0:
        return ""
    name = axis_name(along)
    say_so = f"if this is right, say so: up={name!r}, --up={name}"
    return f"the scan stands along its {name} axis, which is not the rig's up axis ({say_so})"


def contradicts_note(along, up):
    """In words, that a scan stands otherwise than said; ``along`` is the direction that the rig's up axis took; else empty."""
    if np.abs(along).max() < ALONG or along @ up >= ALONG:
        return ""
    return f"the scan stands along its {axis_name(along)} axis, though up says {axis_name(up)!r}"


def axis_name(along):
    """The axis, such as "+z", that a direction is nearest to."""
    return max(AXES, key=lambda name: along @ AXES[name])


def _turn_from(a, b):
    """The rotation that takes one coordinate axis, either way, to another by the shortest way.

    To the opposite one it is the half turn that cameras and graphics programs differ by, about x, with the front turned, too: who
    faces a camera whose y points down and z away from it faces −z. About y where x is the axis.
    """
    if a @ b < -0.5:
        return matrix_from_rotvec(np.pi * np.eye(3)[1 if a[0] else 0])
    return matrix_from_rotvec(np.arccos(np.clip(a @ b, -1, 1)) * np.cross(a, b))


def some_turns(turns):
    """Some six of all turns, evenly taken: enough where labelled parts tell the rest."""
    return turns[:: max(1, len(turns) // 6)]


def _spread_rotations(n):
    """(n, 3, 3) rotations spread evenly over all: a super-Fibonacci spiral on the unit quaternions (Alexa, CVPR 2022)."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(n) + 0.5
    inner, outer = np.sqrt(s / n), np.sqrt(1.0 - s / n)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    x, y, z, w = inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    return matrix_from_quaternion(x, y, z, w)
