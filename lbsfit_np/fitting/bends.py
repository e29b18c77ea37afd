"""Other bends: a limb straight where the fit has a joint bent, or bent at the joint before or after it.

As long as proportions are unknown, a finger of the template that is longer than the person's is fitted with its tip folded.
Proportions that are found afterwards fit the folded tip, and no step leads out of that: the way goes through poses that are
worse. Where the template is known, a hand or a head that looks the wrong way is as hard to turn, and moves the joints too little
to count as another pose of its limb. So each bent joint is straightened, or its bend given to a neighbour; a few steps are gone
from there, and what leaves less unexplained is kept.
"""

import copy

import numpy as np

from ..optimize.gauss_newton import GaussNewton
from ..rig.chains import bones

__all__ = ["Bends", "other_bends"]

# A joint is bent from this angle on, radians.
_BENT = 0.6
# Other bends are compared on so many points and vertices: all after the first steps, the best few of them after the others.
_POINTS, _VERTICES, _FIRST_STEPS, _FEW, _OTHER_STEPS = 900, 300, 2, 8, 4
# So many of those that come this near to the pose as it was go to the end.
_NEAR, _FINALS = 1.02, 3
# What is kept leaves less than this share unexplained.
_BETTER = 0.98


class Bends:
    """Tries other bends of the poses of a model.

    Parameters
    ----------
    model : Model
    free : collection of {"pose", "translation", "scale"}
    to_the_end : callable (problem, state) → (State, float)
        Steps on all points; the value is what is to be small.
    proportions : bool, default True
        Whether the template's proportions are found as well, or are known.
    **options
        Of the ``GaussNewton`` that compares.
    """

    def __init__(self, model, free, to_the_end, *, proportions=True, **options):
        self.model, self._free, self._to_the_end, self._proportions = model, free, to_the_end, proportions
        self._steps = GaussNewton(model, vertices=_VERTICES, **options)

    def __call__(self, problem, state, value):
        """The state, or one with other bends that leaves less unexplained.

        Parameters
        ----------
        problem : Problem
        state : State
            Where ``to_the_end`` has come to.
        value : float
            What it said of that.

        Returns
        -------
        state : State
        value : float
        """
        few = problem.thinned(_POINTS)
        moves = other_bends(self.model.rig, state.theta)
        while moves:
            _, own = self._moved(few, state, _FIRST_STEPS + _OTHER_STEPS)
            tried = [(*self._moved(few, _changed(state, move), _FIRST_STEPS), move) for move in moves]
            tried = sorted(tried, key=lambda t: t[1])[:_FEW]
            tried = [(*self._moved(few, s, _OTHER_STEPS), move) for s, _, move in tried]
            tried = sorted((t for t in tried if t[1] < _NEAR * own), key=lambda t: t[1])
            moves = []
            for k, (start, _, _) in enumerate(tried[:_FINALS]):
                end, left = self._to_the_end(problem, start)
                if left < _BETTER * value:
                    state, value = end, left
                    moves = [move for _, _, move in tried[k + 1 :]]  # only what was near may be of use now
                    break
        return state, value

    def _moved(self, problem, state, steps):
        steps_of = self._steps.with_proportions if self._proportions else self._steps.pose
        return steps_of(problem, state, free=self._free, iterations=steps)

    def freeing(self, free, to_the_end):
        """The same, for other unknowns; what is prepared of the model is shared."""
        other = copy.copy(self)
        other._free, other._to_the_end = free, to_the_end
        return other


def _changed(state, move):
    joints, angles = move
    theta = state.theta.copy()
    theta[list(joints)] = angles
    return state.replace(theta=theta)


def other_bends(rig, theta):
    """Poses that differ from one in the bend of a joint.

    Parameters
    ----------
    rig : Rig
    theta : (J, 3) array
        Θ, radians.

    Returns
    -------
    list of (tuple of int, (k, 3) array)
        Joints and their other angles. A bent joint below the root straight, as far as its limits allow, alone or with its angles
        given to the joint that it hangs on, or to the one that hangs on it where there is just one; and a straight hinge bent to
        the middle of its range.
    """
    bone, out = bones(rig), []
    above = np.where(rig.moving & (np.arange(len(bone)) != rig.root), bone[rig.parents], -1)
    axes = (rig.upper > rig.lower).sum(axis=1)
    for j in np.flatnonzero(rig.moving):
        straight, middle = np.clip(0.0, rig.lower[j], rig.upper[j]), (rig.lower[j] + rig.upper[j]) / 2
        if j == rig.root:
            continue
        if np.linalg.norm(theta[j] - straight) > _BENT:
            out.append(((j,), straight[None]))
            below = np.flatnonzero(above == j)
            for k in (above[j], *(below if len(below) == 1 else ())):
                if k >= 0 and k != rig.root:
                    taken = np.clip(theta[k] + theta[j] - straight, rig.lower[k], rig.upper[k])
                    out.append(((j, k), np.array([straight, taken])))
        elif axes[j] == 1 and np.linalg.norm(theta[j] - middle) > _BENT:
            out.append(((j,), middle[None]))
    return out
