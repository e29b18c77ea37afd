"""A scan that is not explained is looked at in the mirror: of a left hand, the rig of a right one explains the mirror image."""

from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..neighbors import PointIndex
from ..rig.frames import AXES, up_axis
from ..rig.mirror import other_side

__all__ = ["looked_at_in_the_mirror", "one_sided"]

# Of a rig that is its own mirror image, vertices are nearer to its reflection than this share of its size, in the mean: bodies to
# 0.1 %, hands to 3.8 % and more. A tube with 1.9 % explains most of its own mirror images.
_SAME = 0.02
_ASKS = "the mirror image of the scan fits, with probability {probability:.2g}: is it of the other side, such as a left hand? "
_FIT = "Fit it with the mirror image of the rig"
_LEARN = "Mirror the scan, or learn with the mirror image of the rig"
# Without a semicolon, as these part the reasons of a message.
_HOW = " (lbsfit rig mirror{flag}, Rig.mirrored{argument}, or of hand and hand-left the other one)"


def looked_at_in_the_mirror(result, fit, *, rig, facing, given=(), learned=False):
    """A fit; where it is in doubt, it says so if the mirror image of its scan fits.

    Parameters
    ----------
    result : FitResult
    fit : callable ((3, 3) array) → FitResult
        Of the scan with each point x at S x, without a second look. Seconds go on from where the first fit began.
    rig : Rig
    facing : Facing
        How scans may be turned: the reflection S leaves up and front as they are.
    given : sequence of {"theta0", "labels"}
        What the caller knows of the scan, which a reflected one is no scan of: then nothing is asked.
    learned : bool, default False
        Whether it was fitted with learned templates, which no other rig has.

    Returns
    -------
    FitResult
        The same fit, with the seconds and the evaluations of both.
    """
    if result.status == "ok" or given or not result.evidence or not one_sided(rig):
        return result
    side = _side(rig)
    across = facing.turns[0] @ side
    try:
        seen = fit(np.eye(3) - 2 * np.outer(across, across))
    except InputError:  # at the edge of what can be worked with, reflected points may be beyond it
        return result
    message = result.message
    if seen.status == "ok" and seen.probability > result.probability:
        # First, as all else may follow from it.
        message = f"{_words(seen.probability, 'xyz'[np.abs(side).argmax()], learned)}; {message}"
    return replace(result, message=message, seconds=seen.seconds, evaluations=result.evaluations + seen.evaluations)


def one_sided(rig):
    """Whether a rig is of one side, such as a right hand: neither has joints of both nor is its own mirror image."""
    names = set(rig.joint_names)
    if any(other_side(name) != name and other_side(name) in names for name in names):
        return False
    V = rig.vertices[np.unique(rig.faces)]
    V = V - (V.min(axis=0) + V.max(axis=0)) / 2  # which dense parts do not pull to them
    index = PointIndex(V)
    for axis in np.eye(3):
        reflected = V * (1 - 2 * axis)
        if np.linalg.norm(reflected - V[index.nearest(reflected)], axis=1).mean() < _SAME * rig.size:
            return False
    return True


def _side(rig):
    """(3,) the axis from side to side of a rig: across up and, where that is known, the front."""
    up = up_axis(rig)
    forward = np.array(AXES[rig.forward]) if rig.forward else up
    side = np.cross(up, forward)
    return side if side.any() else np.cross(up, np.roll(up, 1))


def _words(probability, axis, learned):
    how = _HOW.format(flag="", argument="")
    if axis != "x":  # which is the default
        how = _HOW.format(flag=f" --axis {axis}", argument=f"(axis={axis!r})")
    return _ASKS.format(probability=probability) + (_LEARN if learned else _FIT) + how
