"""Ends of two limbs that have taken each other's place: crossed feet, fingertips that touch.

Each covers the other's points, so that next to nothing is left unexplained, and no step leads out of it; a library of poses has
none in which just these ends are elsewhere. So the points of each are given to the other, and a few steps go by that.
"""

import copy
from itertools import combinations

import numpy as np

from ..neighbors import PointIndex
from ..optimize.gauss_newton import GaussNewton
from ..rig.chains import chains, vertex_bones

__all__ = ["Exchanges"]

# So many of the last bones of two limbs are exchanged, at most.
_DEEP = 2
# Steps by the other labels. Points hold along the surface as much as across, and count however far they are, half sizes: the
# steps are to bring a bone to its points, not to fit it.
_STEPS, _TANGENTIAL, _REACH = 8, 1.0, 1.0


class Exchanges:
    """Poses in which the last bones of two limbs are exchanged.

    Parameters
    ----------
    model : Model
    free : collection of {"pose", "translation", "scale"}
    """

    def __init__(self, model, free):
        self.model, self._free = model, free
        rig = model.rig
        self._bone = vertex_bones(rig)
        self._steps = GaussNewton(model, tangential=_TANGENTIAL, reach=_REACH, parts=self._bone)
        chain, skinned = chains(rig), np.isin(np.arange(len(rig.parents)), self._bone)
        below = np.flatnonzero(rig.parents >= 0)
        above = rig.parents[below]
        hung_on = set(chain[above[chain[above] != chain[below]]])
        limbs = [np.flatnonzero((chain == c) & rig.moving & skinned) for c in range(1, chain.max() + 1) if c not in hung_on]
        self._pairs = [(a, b, deep) for a, b in combinations(limbs, 2) for deep in range(1, min(len(a), len(b), _DEEP) + 1)]

    def of(self, problem, state, doubted):
        """Moves of one pose, as of ``bends.other_bends``.

        Parameters
        ----------
        problem : Problem
            Few points are enough.
        state : State
        doubted : (J,) bool array
            Bones; two limbs none of which has one of these are left alone.

        Returns
        -------
        list of (tuple of int, (k, 3) array)
            The joints of two limbs, and their other angles.
        """
        bone = self._bone[PointIndex(self.model.deformed(state).vertices).nearest(problem.X)]
        out = []
        for a, b, deep in self._pairs:
            joints = np.concatenate([a, b])
            if not doubted[joints].any():
                continue
            labels = bone.copy()
            for i, j in zip(a[-deep:], b[-deep:], strict=True):
                labels[bone == i], labels[bone == j] = j, i
            moved, _ = self._steps.pose(problem, state, free=self._free, labels=labels, iterations=_STEPS)
            out.append((tuple(joints), moved.theta[joints]))
        return out

    def freeing(self, free):
        """The same, for other unknowns."""
        other = copy.copy(self)
        other._free = free
        return other
