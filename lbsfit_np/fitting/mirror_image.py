"""A scan that is not explained is looked at in the mirror: of a left hand, the rig of a right one explains the mirror image."""

from dataclasses import replace

import numpy as np

from ..neighbors import PointIndex
from ..rig.frames import AXES, up_axis
from ..rig.mirror import other_side

__all__ = ["looked_at_in_the_mirror", "one_sided"]

# Of a rig that is its own mirror image, vertices are nearer to its reflection than this share of its size, in the mean. The
# bundled bodies are to 0.1 %, the hands to 3.8 %.
_SAME = 0.01
_WORDS = (
    "the mirror image of the scan fits, with probability {probability:.2g}: is it of the other side, such as a left hand? Fit it "
    "with the mirror image of the rig (lbsfit rig mirror, Rig.mirrored; of hand that is hand-left)"
)


def looked_at_in_the_mirror(result, points, fit, *, rig, facing, given=()):
    """A fit; where it is in doubt, it says so if the mirror image of its scan fits.

    Parameters
    ----------
    result : FitResult
    points : (n, 3) array
        The scan.
    fit : callable ((n, 3) array) → FitResult
        Of the reflected scan, without a second look. Seconds go on from where the first fit began.
    rig : Rig
    facing : Facing
        How scans may be turned: the reflection leaves up and front as they are.
    given : sequence of {"theta0", "labels"}
        What the caller knows of the scan, which a reflected one is no scan of: then nothing is asked.

    Returns
    -------
    FitResult
        The same fit, with the seconds and the evaluations of both.
    """
    if result.status == "ok" or given or not result.evidence or not one_sided(rig):
        return result
    seen = fit(points @ _reflection(rig, facing))
    words = ""
    if seen.status == "ok" and seen.probability > result.probability:
        words = "; " + _WORDS.format(probability=seen.probability)
    evaluations = result.evaluations + seen.evaluations
    return replace(result, message=result.message + words, seconds=seen.seconds, evaluations=evaluations)


def one_sided(rig):
    """Whether a rig is of one side, such as a right hand: neither has joints of both nor is its own mirror image."""
    names = set(rig.joint_names)
    if any(other_side(name) != name and other_side(name) in names for name in names):
        return False
    V = rig.vertices - rig.vertices.mean(axis=0)
    index = PointIndex(V)
    for k in range(3):
        reflected = V * np.where(np.arange(3) == k, -1.0, 1.0)
        if np.linalg.norm(reflected - V[index.nearest(reflected)], axis=1).mean() < _SAME * rig.size:
            return False
    return True


def _reflection(rig, facing):
    """(3, 3) symmetric: of scans, from side to side."""
    up = up_axis(rig)
    forward = np.array(AXES[rig.forward]) if rig.forward else np.roll(up, 1)
    side = facing.turns[0] @ np.cross(up, forward)
    return np.eye(3) - 2 * np.outer(side, side)
