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

# So many of the last bones of two limbs are exchanged, at most, and those of so many pairs, the nearest.
_DEEP, _PAIRS = 2, 5
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
        chain = chains(rig)
        below = np.flatnonzero(rig.parents >= 0)
        above = rig.parents[below]
        hung_on = set(chain[above[chain[above] != chain[below]]])
        downwards = np.concatenate([[rig.root], *(level for level, _ in rig.levels)])  # a file may have joints in any order
        downwards = downwards[rig.moving[downwards]]
        limbs = [downwards[chain[downwards] == c] for c in range(1, chain.max() + 1) if c not in hung_on]
        self._limbs = [(joints, skinned) for joints in limbs if len(skinned := joints[np.isin(joints, self._bone)])]

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
        V = self.model.deformed(state).vertices
        bone = self._bone[PointIndex(V).nearest(problem.X)]
        ends = [V[self._bone == skinned[-1]].mean(axis=0) for _, skinned in self._limbs]
        pairs = [
            (np.linalg.norm(ends[i] - ends[k]), i, k)
            for i, k in combinations(range(len(ends)), 2)
            if doubted[self._limbs[i][0]].any() or doubted[self._limbs[k][0]].any()
        ]
        out = []
        for _, i, k in sorted(pairs)[:_PAIRS]:
            (own, a), (others, b) = self._limbs[i], self._limbs[k]
            joints = np.concatenate([own, others])
            for deep in range(1, min(len(a), len(b), _DEEP) + 1):
                labels = bone.copy()
                for one, other in zip(a[-deep:], b[-deep:], strict=True):
                    labels[bone == one], labels[bone == other] = other, one
                moved, _ = self._steps.pose(problem, state, free=self._free, labels=labels, iterations=_STEPS)
                out.append((tuple(joints), moved.theta[joints]))
        return out

    def freeing(self, free):
        """The same, for other unknowns."""
        other = copy.copy(self)
        other._free = free
        return other
