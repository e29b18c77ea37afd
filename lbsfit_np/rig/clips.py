"""Natural poses for rigs whose files have none: frames of their animations that differ."""

import numpy as np

__all__ = ["poses_of_clips"]

# Frames of which no joint is turned against the other's by more than this, radians, are one pose; the rest pose is one, too. So
# many are taken at most.
_ALIKE, _MOST = 0.2, 24


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

    frames = np.array(animated, dtype=float)
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
