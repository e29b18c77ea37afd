"""Bones in doubt: those whose points lie much further from the mesh than other bones' do.

Noise, other proportions and sparse points move all bones' points; where those of one bone alone are off, some limb nearby is in
a wrong place, although it may leave next to nothing unexplained in all. Of 36 fits of hands and bodies the ratio was at most 4
where all joints were within 2.5 % of the size, but for one of 11; where one was not, it was 16 and 33, and of a fox 8 to 1,200.
"""

import numpy as np

from ..neighbors import PointIndex
from ..optimize.problem import merged
from ..rig.chains import vertex_bones
from .confidence import lonely_odd, without

__all__ = ["Doubt"]

# Bones with fewer points than this are not judged. Of scans without noise no bone is in doubt whose points are nearer than some
# times this, half sizes: there corners of the mesh are the largest of what is left.
_FEWEST, _NEAREST = 6, 0.002


class Doubt:
    """How much each bone of a model's poses is in doubt.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model):
        rig = model.rig
        self.model, self._bone, self._surface = model, vertex_bones(rig), model.surface

    def of(self, problem, state):
        """Of one pose.

        Parameters
        ----------
        problem : Problem
        state : State

        Returns
        -------
        (J,) array
            Mean squared distance from the surface of the points that are nearest to each bone's skin, as the points weigh, ÷ the
            median over the other bones, or ÷ 0.002² where that is less; 0 for bones of few points, which do not count for others
            either, and for joints that no vertex follows most. Clutter does not count.
        """
        w = problem.shares
        X, w, _ = merged(problem.X[w > 0] / state.scale, w[w > 0], None)
        V = self.model.deformed(state).vertices / state.scale
        nearest = PointIndex(V).nearest(X)
        away = ((X - self._surface.closest(X, nearest, V).points) ** 2).sum(axis=1)
        w, bone, J = without(w, lonely_odd(X, away)), self._bone[nearest], len(self.model.rig.parents)
        judged = np.bincount(bone[w > 0], minlength=J) >= _FEWEST
        mean = (np.bincount(bone, w * away, J) / np.maximum(np.bincount(bone, w, J), np.finfo(float).tiny))[judged]
        out = np.zeros(J)
        if len(mean) > 1:
            others = [np.median(np.delete(mean, k)) for k in range(len(mean))]
            out[judged] = mean / np.maximum(others, _NEAREST**2)
        return out
