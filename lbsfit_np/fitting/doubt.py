"""Bones in doubt: those whose points lie much further from the mesh than other bones' do.

Noise, other proportions and sparse points move all bones' points; where those of one bone alone are off, some limb nearby is in
a wrong place, although it may leave next to nothing unexplained in all. Of 36 fits of hands and bodies the ratio was at most 4
where all joints were within 2.5 % of the size, but for one of 11; where an arm, a leg or a foot was not, it was 16 to 1,200.
"""

import numpy as np

from ..neighbors import PointIndex
from ..optimize.surface import Surface
from ..rig.chains import vertex_bones
from .confidence import lonely_odd

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
        self.model, self._bone, self._surface = model, vertex_bones(rig), Surface(rig.vertices, rig.faces)

    def of(self, problem, state):
        """Of one pose.

        Parameters
        ----------
        problem : Problem
        state : State

        Returns
        -------
        (J,) array
            Mean squared distance from the surface of the points that are nearest to each bone's skin, ÷ the median over the
            bones, or ÷ 0.002² where that is less; 0 for bones of few points, and for joints that no vertex follows most. Clutter
            does not count.
        """
        V, X, rows = self.model.deformed(state).vertices, problem.X, self._surface.rows
        nearest = rows[PointIndex(V[rows]).nearest(X)]
        away = ((X - self._surface.closest(X, nearest, V).points) ** 2).sum(axis=1)
        some, J = ~lonely_odd(X, away), len(self.model.rig.parents)
        away, bone = away[some], self._bone[nearest[some]]
        count = np.bincount(bone, minlength=J)
        judged = count >= _FEWEST
        mean = np.bincount(bone, away, minlength=J) / np.maximum(count, 1)
        typical = np.median(mean[judged]) if judged.any() else 0.0
        return np.where(judged, mean, 0.0) / max(typical, _NEAREST**2)
