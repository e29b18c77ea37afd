"""Joint limits for rigs whose files have none: from what their animations do, else a plain default."""

import re

import numpy as np

from ..errors import counted, listed
from .clips import about_their_mean

__all__ = ["DEFAULT_LIMIT", "DEFAULT_ROOT_LIMIT", "NO_LIMITS", "OUTSIDE", "all_derived", "derived_limits", "without_rest"]

# How the note begins that says so; numbers follow.
NO_LIMITS = "neither file nor card has limits for"

# How the note begins on joints whose limits leave out the rest pose.
OUTSIDE = "the rest pose is outside the limits of"

# ±0.8 rad (46°) about each axis of every moving joint. Elbows and knees bend further; but the limits are also what uniform
# poses are drawn from, and chains of joints that all turn by more than this leave few poses without the mesh cutting itself.
# A card says it better for each joint.
DEFAULT_LIMIT = 0.8
# ±0.6 rad (34°) for the root. A fit leaves the root unbounded: this is only how far sampled poses turn as a whole.
DEFAULT_ROOT_LIMIT = 0.6

_MARGIN = 0.25  # of the range seen, on each side
_LEAST_MARGIN = 0.1  # rad: an axis that an animation never uses may still give a little
_STILL = 1e-3  # rad: less than this over all frames is a joint that never turns


def all_derived(notes):
    """Whether a rig's notes say that the limits of all joints that move were derived."""
    return any(re.match(rf"{NO_LIMITS} (\d+) of \1 moving joints", note) for note in notes)


def without_rest(lower, upper, names, root):
    """A note, in a list, on joints whose limits leave out the rest pose; none of the root, whose limits fits do not keep to."""
    out = ((lower > 0) | (upper < 0)).any(axis=1)
    out[root] = False
    if not out.any():
        return []
    named = listed([names[j] for j in np.flatnonzero(out)], 4)
    return [f"{OUTSIDE} {counted(int(out.sum()), 'joint')} ({named})"]


def derived_limits(root, n_joints, animated=None):
    """Limits for every joint, from animations where they turn it, else the default.

    Parameters
    ----------
    root : int
        Row of the root; always gets ±0.6 rad, as animations that walk about say nothing about sampling.
    n_joints : int
        J.
    animated : (k, J, 3) array, optional
        Rotation vectors in the rest frames, sampled from the file's animations.

    Returns
    -------
    lower, upper : (J, 3) arrays
        Over the frames, smallest and largest angle about each axis, widened by 25 % of the range and at least 0.1 rad on
        each side, made to contain 0 (the rest pose). Frames are as ``clips.about_their_mean`` has them; only these, not what
        they are widened by, reach beyond ±π. Joints that do not move: ±0.8 rad, and as far beyond as all frames have them.
    from_animation : (J,) bool array
        The joints whose limits come from the animations.
    """
    lower = np.full((n_joints, 3), -DEFAULT_LIMIT)
    upper = np.full((n_joints, 3), DEFAULT_LIMIT)
    seen = np.zeros(n_joints, dtype=bool)
    if animated is not None and len(animated):
        animated = about_their_mean(animated)
        low, high = animated.min(axis=0), animated.max(axis=0)
        least, most = np.minimum(low, -np.pi), np.maximum(high, np.pi)
        seen = (high - low).max(axis=1) > _STILL
        margin = np.maximum(_MARGIN * (high - low), _LEAST_MARGIN)
        lower[seen] = np.clip(np.minimum(low - margin, 0.0), least, most)[seen]
        upper[seen] = np.clip(np.maximum(high + margin, 0.0), least, most)[seen]
        held = ~seen  # in one pose, which is possible as well, however far it is turned
        lower[held] = np.clip(np.minimum(lower, low - margin), least, most)[held]
        upper[held] = np.clip(np.maximum(upper, high + margin), least, most)[held]
    seen[root] = False
    lower[root], upper[root] = -DEFAULT_ROOT_LIMIT, DEFAULT_ROOT_LIMIT
    return lower, upper, seen
