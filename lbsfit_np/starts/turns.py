"""Which way a scan may face: the turns that a start is tried under."""

import numpy as np

from ..rig.frames import up_axis
from ..rotations import matrix_from_rotvec

__all__ = ["ORIENTATIONS", "any_side_up", "some_turns", "stands_note", "turns_of", "up_of"]

ORIENTATIONS = ("aligned", "upright", "any")
# Steps of 15° about the up axis; all rotations some 30° apart. Steps towards the surface turn the rest of the way.
_UPRIGHT = 24
_ANY = 600


def turns_of(rig, orientation):
    """Rotations that cover how a scan may be turned.

    Parameters
    ----------
    rig : Rig
        Its up axis matters; +y where it has none.
    orientation : {"aligned", "upright", "any"}
        The scan faces the rig's way, is turned about the up axis, or is turned in any way.

    Returns
    -------
    (R, 3, 3) array
        The first one is the identity.
    """
    if orientation == "aligned":
        return np.eye(3)[None]
    if orientation == "upright":
        angles = np.linspace(0.0, 2 * np.pi, _UPRIGHT, endpoint=False)
        return matrix_from_rotvec(angles[:, None] * up_axis(rig))
    spread = _spread_rotations(_ANY - 1)
    return np.concatenate([np.eye(3)[None], spread])


def up_of(rig, orientation):
    """(3,) the direction that is up in a scan, which may be turned about it alone; None where any rotation may be."""
    return None if orientation == "any" else up_axis(rig)


def any_side_up(turns, up):
    """(6 R, 3, 3) the turns as they are, then with each other coordinate axis of the scan, either way, for the up axis."""
    sides = np.concatenate([up[None], -up[None], *(np.stack([e, -e]) for e in np.eye(3)[up == 0])])
    return np.concatenate([_turn_from(up, side) @ turns for side in sides])


def stands_note(turn, up):
    """In words, which way a scan stands that was turned so, where its up axis is not the rig's; else empty."""
    along = turn @ up
    axis = int(np.abs(along).argmax())
    if along @ up > 0.7:
        return ""
    return f"the scan stands along its {'-' if along[axis] < 0 else '+'}{'xyz'[axis]} axis, which is not the rig's up axis"


def _turn_from(a, b):
    """The rotation that takes one coordinate axis, either way, to another by the shortest way."""
    if a @ b < -0.5:
        return matrix_from_rotvec(np.pi * np.roll(np.abs(a), 1))
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
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=-1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=-1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=-2,
    )
