"""Other bends: a limb straight where the fit has a joint bent, or bent at the joint before or after it.

As long as proportions are unknown, a finger of the template that is longer than the person's is fitted with its tip folded.
Proportions that are found afterwards fit the folded tip, and no step leads out of that: the way goes through poses that are
worse. Where the template is known, a hand or a head that looks the wrong way is as hard to turn, and moves the joints too little
to count as another pose of its limb. So each bent joint is straightened, or its bend given to a neighbour; a few steps are gone
from there, and what leaves less unexplained is kept.

Where some bone is in doubt then, more is tried: the ends of two limbs exchanged, and each joint swept through its range, by
itself or against the joint before it, such as a knee that bends the other way.
"""

import copy

import numpy as np

from ..optimize.gauss_newton import GaussNewton
from ..rig.chains import bones, subtrees, vertex_bones
from .doubt import Doubt
from .exchanges import Exchanges

__all__ = ["Bends", "other_bends", "swept"]

# A joint is bent from this angle on, radians.
_BENT = 0.6
# Other bends are compared on so many points and vertices: all after the first steps, which hold the template and go by planes
# where the mesh is fine, the best few of them after the others.
_POINTS, _VERTICES, _FIRST_STEPS, _FEW, _OTHER_STEPS = 900, 300, 2, 8, 4
# A joint that moves fewer of these points than this, by its share of the surface, is left, as they cannot tell its bend; of very
# many bends, and swept joints, those of joints that move most are tried. Bodies and hands have no more, but for those of a face
# and of a body's fingers.
_TOLD_BY, _BENDS, _SWEPT = 1, 120, 1200
# So many of those that come this near to the pose as it was go to the end.
_NEAR, _FINALS = 1.02, 3
# What is kept leaves less than this share unexplained.
_BETTER = 0.98
# A bone is in doubt from this ratio of ``Doubt`` on; then more is tried so many times at most, as long as it helps. Of swept
# joints steps go from so many that leave least unexplained at once, and so many of these are compared further: of those that
# helped on tuning seeds none was further back than 28th of some 200, and than 14th after the first steps. Limbs that come from
# far are further from their ends then than bends are.
_DOUBTED, _ROUNDS, _LIKELY, _MANY, _NEAR_IN_DOUBT = 4.0, 3, 32, 12, 1.15
# Joints are swept in steps of at most this, radians; what is nearer than the second to where they are is left out. The joint
# before turns back by these shares. Ranges that differ by less than the last number are as wide.
_SWEEP, _NEARBY, _BACK, _SAME_ROOM = 0.7, 0.35, (0.5, 1.0), 0.01


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
    other_limbs : bool, default True
        Whether limbs are looked at where a bone is in doubt. It takes points for those of a limb, as Chamfer alone does not.
    **options
        Of the ``GaussNewton`` that compares.
    """

    def __init__(self, model, free, to_the_end, *, proportions=True, other_limbs=True, **options):
        self.model, self._free, self._to_the_end, self._proportions = model, free, to_the_end, proportions
        self._steps = self._first = GaussNewton(model, vertices=_VERTICES, **options)
        if model.is_fine:
            self._first = GaussNewton(model.coarse, vertices=_VERTICES, planes=True, **options)
        self._rounds = _ROUNDS if other_limbs else 0
        self._doubt, self._exchanges = Doubt(model), Exchanges(model, free)
        own = np.bincount(vertex_bones(model.rig), model.areas, len(model.rig.parents))
        self._moves = _POINTS * ((subtrees(model.rig.parents) > 0) @ own)  # so many of these points move with each joint

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

        def best(moves, *limits):
            return self._best(problem, few, state, value, moves, *limits)

        state, value = best(self._told(other_bends(self.model.rig, state.theta), _BENDS))
        for _ in range(self._rounds):
            doubted = self._doubt.of(problem, state) > _DOUBTED
            if not doubted.any():
                break
            before = value
            state, value = best(self._exchanges.of(few, state, doubted), _NEAR_IN_DOUBT)
            state, value = best(self._told(swept(self.model.rig, state.theta), _SWEPT), _NEAR_IN_DOUBT, _MANY, _LIKELY)
            if value == before:
                break
        return state, value

    def _told(self, changes, most):
        """Changes of joints whose bends points can tell; of very many those of the joints that move most."""
        told = [change for change in changes if self._moves[change[0][0]] >= _TOLD_BY]
        return told if len(told) <= most else sorted(told, key=lambda change: -self._moves[change[0][0]])[:most]

    def _best(self, problem, few, state, value, moves, near=_NEAR, most=_FEW, likely=None):
        """The state, or what came of moves if that leaves less unexplained; of the ``likely`` ones ``most`` go on."""
        while moves:
            _, own = self._moved(few, state, _FIRST_STEPS + _OTHER_STEPS)
            if likely:
                moves = sorted(moves, key=lambda move: self._begun(few, _changed(state, move), 0)[1])[:likely]
            tried = [(*self._begun(few, _changed(state, move), _FIRST_STEPS), move) for move in moves]
            tried = sorted(tried, key=lambda t: t[1])[:most]
            tried = [(*self._moved(few, s, _OTHER_STEPS), move) for s, _, move in tried]
            tried = sorted((t for t in tried if t[1] < near * own), key=lambda t: t[1])
            moves = []
            for k, (start, _, _) in enumerate(tried[:_FINALS]):
                end, left = self._to_the_end(problem, start)
                if left < _BETTER * value:
                    state, value = end, left
                    moves = [move for _, _, move in tried[k + 1 :]]  # only what was near may be of use now
                    break
        return state, value

    def _begun(self, problem, state, steps):
        return self._first.pose(problem, state, free=self._free, iterations=steps)

    def _moved(self, problem, state, steps):
        steps_of = self._steps.with_proportions if self._proportions else self._steps.pose
        return steps_of(problem, state, free=self._free, iterations=steps)

    def freeing(self, free, to_the_end):
        """The same, for other unknowns; what is prepared of the model is shared."""
        other = copy.copy(self)
        other._free, other._to_the_end, other._exchanges = free, to_the_end, self._exchanges.freeing(free)
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
    axes = rig.turning.sum(axis=1)
    for j in np.flatnonzero(rig.moving):
        straight, middle = np.clip(0.0, rig.lower[j], rig.upper[j]), (rig.lower[j] + rig.upper[j]) / 2
        if j == rig.root:
            continue
        if np.linalg.norm(theta[j] - straight) > _BENT:
            out.append(((j,), straight[None]))
            below = np.flatnonzero(above == j)
            for k in (above[j], *(below if len(below) == 1 else ())):
                if k >= 0 and k != rig.root:
                    bend = rig.frames[k].T @ rig.frames[j] @ (theta[j] - straight)  # about the same axis, in the other's frame
                    taken = np.clip(theta[k] + bend, rig.lower[k], rig.upper[k])
                    out.append(((j, k), np.array([straight, taken])))
        elif axes[j] == 1 and np.linalg.norm(theta[j] - middle) > _BENT:
            out.append(((j,), middle[None]))
    return out


def swept(rig, theta):
    """Poses that differ from one in a joint's angle about the axis that it turns most about, anywhere in its range.

    Parameters
    ----------
    rig : Rig
    theta : (J, 3) array
        Θ, radians.

    Returns
    -------
    list of (tuple of int, (k, 3) array)
        A joint below the root and its other angles, of joints that turn as far about several axes about each of these; alone, or
        with those of the joint that it hangs on, turned back about the same axis as far as its limits allow, so that what hangs
        on both hardly turns.
    """
    bone, out = bones(rig), []
    room = rig.upper - rig.lower
    for j in np.flatnonzero(rig.moving & (np.arange(len(bone)) != rig.root)):
        p = bone[rig.parents[j]]
        for a in np.flatnonzero(room[j] > room[j].max() - _SAME_ROOM):
            back = rig.frames[p].T @ rig.frames[j][:, a]
            angles = np.linspace(rig.lower[j, a], rig.upper[j, a], int(np.ceil(room[j, a] / _SWEEP)) + 1)
            for angle in angles[np.abs(angles - theta[j, a]) > _NEARBY]:
                own = theta[j].copy()
                own[a] = angle
                out.append(((j,), own[None]))
                if p == rig.root or not rig.moving[p]:
                    continue
                for share in _BACK:
                    other = np.clip(theta[p] - share * (angle - theta[j, a]) * back, rig.lower[p], rig.upper[p])
                    out.append(((j, p), np.array([own, other])))
    return out
