"""What a file's animations tell of a rig: natural poses, and turns about other parents than the file's."""

import numpy as np

from ..rotations import matrix_from_rotvec, nearest_rotvec, rotvec_from_matrix

__all__ = ["about_their_mean", "poses_of_clips", "under_other_parents"]

# Frames of which no joint is turned against the other's by more than this, radians, are one pose; the rest pose is one, too. So
# many are taken at most.
_ALIKE, _MOST = 0.2, 24
# A joint that is turned from its mean by more than this, radians, turns round.
_ROUND = np.radians(170)


def poses_of_clips(animated, root, still):
    """Poses that are spread over those of a file's animations.

    The first is the one that is furthest from the rest pose, each next one the furthest from all before it and from that.

    Parameters
    ----------
    animated : (k, J, 3) array
        Rotation vectors in the rest frames, sampled from the animations.
    root : int
        Its row is 0 in all: where an animal walks says nothing of its pose.
    still : (J,) bool array
        Joints that do not turn, whose rows are 0 as well.

    Returns
    -------
    dict of str to (J, 3) array
        "animation 1" and so on, in the order of the frames; none where no joint turns.
    """
    from scipy.spatial.transform import Rotation

    frames = about_their_mean(animated)  # as limits are derived from them: poses shall lie inside
    frames[:, root] = 0.0
    frames[:, still] = 0.0
    turns = Rotation.from_rotvec(frames.reshape(-1, 3))
    away = turns.magnitude().reshape(frames.shape[:2]).max(axis=1, initial=0.0)
    chosen = []
    while len(chosen) < _MOST and away.size and away.max() > _ALIKE:
        chosen.append(int(away.argmax()))
        between = Rotation.from_rotvec(np.tile(frames[chosen[-1]], (len(frames), 1))).inv() * turns
        away = np.minimum(away, between.magnitude().reshape(frames.shape[:2]).max(axis=1))
    return {f"animation {n + 1}": frames[k] for n, k in enumerate(sorted(chosen))}


def about_their_mean(animated):
    """The same rotations by the vectors that lie nearest to their mean: those of matrices change sides at half a turn.

    Parameters
    ----------
    animated : (k, J, 3) array
        Rotation vectors with angles up to π.

    Returns
    -------
    (k, J, 3) array
        With angles up to 2π. A joint that turns round, so that it is opposite to its mean at times, has the vectors given.
    """
    from scipy.spatial.transform import Rotation

    out = np.array(animated, dtype=float)
    for j in np.flatnonzero(np.linalg.norm(out, axis=2).max(axis=0, initial=0.0) > np.pi / 2):  # others change no sides
        turns = Rotation.from_rotvec(out[:, j])
        middle = turns.mean()
        if (middle.inv() * turns).magnitude().max() < _ROUND:
            out[:, j] = nearest_rotvec(out[:, j], middle.as_rotvec())
    return out


def under_other_parents(animated, frames, before, after):
    """The same motion by turns relative to other parents.

    Parameters
    ----------
    animated : (k, J, 3) array
        Rotation vectors in the rest frames, relative to the parents ``before``.
    frames : (J, 3, 3) array
        Rest frames.
    before, after : (J,) int arrays
        Parents, −1 where there is none.

    Returns
    -------
    (k, J, 3) array or None
        None where ``before`` goes round in a circle.
    """
    local = frames @ matrix_from_rotvec(animated) @ np.swapaxes(frames, 1, 2)
    turned, known = local.copy(), before < 0  # by how much in all
    while not known.all():
        now = np.flatnonzero(~known & known[before])
        if not len(now):
            return None
        turned[:, now] = turned[:, before[now]] @ local[:, now]
        known[now] = True
    rows = np.flatnonzero(after != before)
    above = np.where(after[rows, None, None] >= 0, turned[:, after[rows]], np.eye(3))
    own = np.swapaxes(above, 2, 3) @ turned[:, rows]
    animated = np.array(animated, dtype=float)
    animated[:, rows] = rotvec_from_matrix(np.swapaxes(frames[rows], 1, 2) @ own @ frames[rows])
    return animated
