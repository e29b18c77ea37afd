"""What a collection's poses tell of a pose of which its own scan tells little: an empirical Bayes prior of the angles.

How far a forearm is twisted, hardly any point tells: what is found varies more than people move. Of many scans it is known how
much: where scan i tells its angles with the covariance C_i, and angles vary among poses by N(μ, T), found ones vary by T + C_i.
μ and T are those that make what was found most likely, by EM. ``fitting.drawn`` says what poses are drawn to by them.
"""

import numpy as np

from ..fitting.drawn import PosePrior

__all__ = ["LEAST", "looked_at", "pose_prior"]

# Scans that are looked at, at most, evenly taken; steps of EM.
_MOST, _STEPS = 400, 40
# As if the angles of so many scans more varied by this, radians: few poses look more alike than poses are.
_BEFORE, _SPREAD = 1.0, 0.3
# As if so many more had angles that vary as they do, but do not go together.
_APART = 60.0
# Fewer poses tell nothing of how poses vary.
LEAST = 3


def looked_at(n):
    """Which of n scans the prior is made from, (k,) int, at most 400."""
    return np.unique(np.linspace(0, n - 1, min(n, _MOST)).astype(int))


def pose_prior(poses, told, turning, root):
    """The prior that makes what scans tell of their poses most likely.

    Parameters
    ----------
    poses : sequence of (J, 3) arrays
        As found, each by its own scan alone.
    told : sequence of (t, t) arrays
        C_i: covariances of their angles that turn, by ``optimize.precision.told_angles``.
    turning : (J, 3) bool array
    root : int

    Returns
    -------
    PosePrior or None
        None of hardly any poses.
    """
    if len(poses) < LEAST:
        return None
    held = np.nonzero(turning)[0] != root
    found = np.array([theta[turning][held] for theta in poses])
    known = np.linalg.inv(np.array([C[np.ix_(held, held)] for C in told]))
    n, t = found.shape
    pulled = np.einsum("nab,nb->na", known, found)
    # EM is slow where most of what varies is not the poses: it begins from what is left without that.
    varies, unsure = found.var(axis=0), np.mean([np.diag(C)[held] for C in told], axis=0)
    mean, spread = np.median(found, axis=0), np.diag(np.maximum(varies - unsure, 0.1 * varies) + _SPREAD**2 / n)
    for _ in range(_STEPS):
        T_inv = np.linalg.inv(spread)
        C = np.linalg.inv(known + T_inv)
        own = np.einsum("nab,nb->na", C, pulled + T_inv @ mean)
        mean = own.mean(axis=0)
        S = ((own - mean).T @ (own - mean) + C.sum(axis=0) + _BEFORE * _SPREAD**2 * np.eye(t)) / (n + _BEFORE)
        spread = (n * S + _APART * np.diag(np.diag(S))) / (n + _APART)
    centre, precision = np.zeros(turning.shape), np.zeros((len(held), len(held)))
    centre[tuple(np.argwhere(turning)[held].T)] = mean
    precision[np.ix_(held, held)] = np.linalg.inv(spread)
    return PosePrior(centre, precision)
