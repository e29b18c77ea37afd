"""The pose of a scan whose template is known: many starts, short steps from each, and the best by what stays unexplained.

With free offsets a wrong pose can look as good as the right one. With the template held it cannot: a finger in another's
place leaves points unexplained. So here starts may be many and careless, and the distances to the surface choose.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np

from ..losses.objective import BOTH, PLAIN, STRUCTURED
from ..neighbors import PointIndex
from ..optimize.gauss_newton import GaussNewton
from ..optimize.lbfgs import minimise
from ..optimize.precision import joint_std, told_angles
from ..optimize.problem import Problem
from ..optimize.state import IN_UNIT, State, free_angles
from ..optimize.visibility import WHOLE, seen_vertices
from ..starts.limbs import LimbPoses
from ..starts.parts import start_from_parts
from ..starts.place import placed
from .bends import Bends
from .effort import Effort
from .labels import DOUBT, parts_of, refined_labels
from .proportioned import TANGENTIAL

__all__ = ["LimbSearch", "Refit", "Runner", "distinct", "plain_chamfer"]

# σ of the refined labels that lead a start from part centroids, in half sizes.
_SIGMAS = (0.15, 0.07)
# The first steps look at so many points and vertices from so far; the best few starts go on with more points and a shorter
# reach, the very best with all points. Those that look far go by planes at vertices where the mesh is fine.
_FEW, _FAR, _FAR_VERTICES, _FAR_STEPS = 400, 0.2, 300, 6
_MORE, _NEAR, _NEAR_VERTICES, _NEAR_STEPS, _NEAR_ENOUGH = 900, 0.05, 600, 10, 1e-3
_SURVIVORS = 3
# Those go on with all points that leave at most so many times as much unexplained as the best, and whose joints are on the mean
# further from it than this, half sizes.
_CLOSE, _ALIKE = 1.3, 0.005
# Limbs are tried again where that has left less than this share unexplained.
_HELPED = 0.99


@dataclass(frozen=True)
class Runner:
    """A start, or where it has come to.

    Attributes
    ----------
    problem : Problem
        In the start's own frame.
    state : State
    name : object
        The caller's, to tell starts apart.
    value : float
        E of ``optimize.gauss_newton`` at the state; inf before the first step.
    """

    problem: Problem
    state: State
    name: object = None
    value: float = np.inf


@dataclass(frozen=True)
class LimbSearch:
    """Other poses for limbs, and how far they are looked through.

    Attributes
    ----------
    poses : LimbPoses
        Of the model.
    effort : Effort
        How often, of how many runners, and of how many poses.
    """

    poses: LimbPoses
    effort: Effort


class Refit:
    """Poses of scans for one known template.

    Parameters
    ----------
    model : Model
        Of the template.
    free : collection of {"pose", "translation", "scale"}, default pose and translation
    coverage : Coverage, optional
        What scans show, by default all.
    bends : bool, default False
        Whether other bends of joints are tried in the end.
    other_limbs : bool, default True
        As for ``Bends``.
    """

    def __init__(self, model, free=IN_UNIT, *, coverage=WHOLE, bends=False, other_limbs=True):
        self.model, self.free, self.coverage = model, free, coverage
        near = {"reach": _NEAR, "tangential": TANGENTIAL, "coverage": coverage}
        fine, looks_far = model.is_fine, {"reach": _FAR, "vertices": _FAR_VERTICES, "coverage": coverage}
        self._far = GaussNewton(model.coarse if fine else model, **looks_far, planes=fine)
        self._near = GaussNewton(model, vertices=_NEAR_VERTICES, tolerance=_NEAR_ENOUGH, **near)
        self._last = GaussNewton(model, **near)
        self._bends = None
        if bends:
            self._bends = Bends(model, free, self.to_the_end, proportions=False, other_limbs=other_limbs, **near)

    @property
    def turning(self):
        """(J, 3) bool: the angles that turn."""
        return free_angles(self.model.rig)

    def __call__(self, problem, states=(), *, poses=(), proba=None, labels_known=False, limbs=None, bend=True):
        """The best pose found.

        Parameters
        ----------
        problem : Problem
        states : sequence of State
            Starts with their place, such as an earlier fit.
        poses : sequence of (J, 3) arrays
            Starts that are put where the scan is.
        proba : (n, n_parts) array, optional
            Probabilities of the parts; they give one more start.
        labels_known : bool, default False
            The probabilities are known labels, zeros and ones, all 0 where one is not known. The steps go by them: from the
            first start alone, or from the one that the labels give where there is no other.
        limbs : LimbSearch, optional
            Tried where labels are not known.
        bend : bool, default True
            Whether other bends are tried of what has won, by a Refit that tries any.

        Returns
        -------
        state : State
        value : float
            L_c(X, V), squared half sizes, see :func:`plain_chamfer`.
        which : int
            Row of the start that won, or led to what won: states, then poses, then the one from parts.
        """
        starts = [self._mine(s) for s in states] + [self.placed(problem, theta) for theta in poses]
        if labels_known:
            start = starts[0] if starts else self.from_parts(problem, proba, True)
            labels = parts_of(proba)
            state, _ = self._far.pose(problem, start, free=self.free, labels=labels, iterations=_FAR_STEPS)
            state, _ = self._last.pose(problem, state, free=self.free, labels=labels, iterations=_NEAR_STEPS)
            if (labels == proba.shape[1]).any():  # points of which it is not known have their say now
                state = self.polish(problem, state)
            return state, self.chamfer(problem, state), 0
        if proba is not None:
            starts.append(self.from_parts(problem, proba, False))
        runners = [Runner(problem, s, k) for k, s in enumerate(starts)]
        ends = self.race(runners)
        ends = self._close(ends if limbs is None else self.with_other_limbs(ends, limbs))
        # On few points a wrong pose may look as good; a pose that was known is not lost to one that looks better there.
        # Of poses that are as good the known one wins.
        best = min((self._moved(self._last, problem, r) for r in [*runners[: len(states)], *ends]), key=lambda r: r.value)
        state, value = self.bent(problem, best.state) if bend else (best.state, self.chamfer(problem, best.state))
        return state, value, best.name

    def bent(self, problem, state):
        """A pose that steps have come to the end of, or one with other bends that leaves less unexplained; and its L_c(X, V)."""
        if self._bends:
            _, left = self.to_the_end(problem, state, iterations=0)
            state, _ = self._bends(problem, state, left)
        return state, self.chamfer(problem, state)

    def race(self, runners, survivors=_SURVIVORS):
        """All starts a few steps, the best of them to the end.

        Parameters
        ----------
        runners : sequence of Runner
        survivors : int

        Returns
        -------
        list of Runner
            The survivors, the best first.
        """
        return self.last_steps(self.first_steps(runners)[:survivors])

    def first_steps(self, runners):
        """All starts after a few steps that look far on few points; the best first."""
        return self._all_moved(runners, self._far, _FEW, _FAR_STEPS)

    def last_steps(self, runners):
        """Starts after steps that look near; the best first."""
        return self._all_moved(runners, self._near, _MORE, _NEAR_STEPS)

    def with_other_limbs(self, runners, limbs):
        """The same with, where some limb is better off in another pose, what came of that; again while it helps.

        Parameters
        ----------
        runners : list of Runner
            After their last steps, the best first; at most as many come back.
        limbs : LimbSearch

        Returns
        -------
        list of Runner
            The best first, each pose once.
        """
        size, effort = len(runners), limbs.effort
        runners = self._once(runners)  # copies would take the places of others
        for _ in range(effort.generations):
            best = runners[0].value
            tried = []
            for r in runners[: effort.parents]:
                proposals = limbs.poses.proposals(r.problem, r.state, effort.proposals, closer=effort.closer)
                tried += [replace(r, state=r.state.replace(theta=theta)) for theta in proposals]
            if not tried:
                break
            runners = self._once(sorted([*runners, *self.race(tried, effort.survivors)], key=lambda r: r.value))[:size]
            if runners[0].value > _HELPED * best:
                break
        return runners

    def freeing(self, free):
        """The same, for other unknowns; what is prepared of the model is shared."""
        other = copy.copy(self)
        other.free = free
        other._bends = self._bends and self._bends.freeing(free, other.to_the_end)
        return other

    def polish(self, problem, state, **options):
        """The last steps alone, on all points; options of :meth:`GaussNewton.pose`."""
        return self.to_the_end(problem, state, **options)[0]

    def to_the_end(self, problem, state, **options):
        """The same with the value E that they have made smaller."""
        return self._last.pose(problem, state, free=self.free, **options)

    def left(self, problem, state):
        """What a pose leaves unexplained, E of ``optimize.gauss_newton``; of what the scan can show."""
        return self.to_the_end(problem, state, iterations=0)[1]

    def joint_std(self, problem, state, proba=None):
        """How precisely the scan tells each posed joint's place, see :func:`~lbsfit_np.optimize.precision.joint_std`."""
        return joint_std(self._last, problem, state, free=self.free, proba=proba)

    def told_angles(self, problem, state):
        """How precisely the scan tells the angles, and σ²/n, see :func:`~lbsfit_np.optimize.precision.told_angles`."""
        return told_angles(self._last, problem, state, free=self.free)

    def placed(self, problem, theta, scale=1.0):
        """The State of a pose Θ of some scale put where the scan is."""
        return placed(self.model, problem, theta, scale, coverage=self.coverage)

    def in_place(self, problem, theta):
        """The State of a pose Θ that is known, put where the scan is and then moved there as it is.

        Holes and uneven density shift a scan's centroid by a tenth of its size and more: from there steps that also bend joints
        may lead away from a pose that is right.
        """
        place, state = tuple(block for block in self.free if block != "pose"), self.placed(problem, theta)
        # Steps that look far are drawn aside by what a hole leaves without points; those that look near are not.
        for steps, iterations in ((self._far, 2 * _FAR_STEPS), (self._near, _NEAR_STEPS)):
            state, _ = steps.pose(problem, state, free=place, iterations=iterations)
        return state

    def from_parts(self, problem, proba, labels_known=False, *, model=None):
        """The State from inverse kinematics on the parts' centroids, then by the labels, ever closer; by the coarse model."""
        model, X = model or self.model.coarse, problem.X
        state = start_from_parts(model, X, proba, x_weights=problem.x_weights).state
        labels = parts_of(proba)
        free = self.free

        def go(state, weights, labels, steps):
            def evaluate(s):
                return problem.evaluate(model, s, weights, labels)

            return minimise(evaluate, state, model.rig, free, max_iterations=steps, tolerance=2e-3).state

        state = go(state, STRUCTURED, labels, 30)
        for sigma in () if labels_known else _SIGMAS:
            V = model.deformed(state).vertices
            state = go(state, BOTH, refined_labels(X, proba, V, model.labels, sigma, doubt=DOUBT), 30)
        return state

    def _close(self, runners):
        """Those, the best first, that leave not much more unexplained than the best, each pose once."""
        return self._once([r for r in runners if r.value <= _CLOSE * runners[0].value])

    def _once(self, runners):
        """Each pose once, in each frame."""
        by_frame = {}
        for r in runners:
            by_frame.setdefault(r.problem.X.tobytes(), []).append(r)  # starts may have problems of their own in one frame
        own = [distinct(g, lambda r: self.model.deformed(r.state).joints, lambda r: _ALIKE) for g in by_frame.values()]
        kept = {id(r) for group in own for r in group}
        return [r for r in runners if id(r) in kept]

    def _all_moved(self, runners, steps, points, iterations):
        problems = {id(r.problem): r.problem for r in runners}
        problems = {key: problem.thinned(points) for key, problem in problems.items()}
        moved = [self._moved(steps, problems[id(r.problem)], r, iterations=iterations) for r in runners]
        return sorted(moved, key=lambda r: r.value)

    def _moved(self, steps, problem, runner, **options):
        state, value = steps.pose(problem, runner.state, free=self.free, **options)
        return Runner(runner.problem, state, runner.name, value)

    def chamfer(self, problem, state):
        """L_c(X, V), squared half sizes, see :func:`plain_chamfer`."""
        return plain_chamfer(self.model, problem, state, coverage=self.coverage)

    def _mine(self, state):
        """A state of another model as one of this: its template is this model's."""
        return state.replace(coefficients=np.zeros(self.model.n_coefficients), residual=None, displacement=None)


def plain_chamfer(model, problem, state, *, coverage):
    """L_c(X, V), squared half sizes, of evenly spread vertices (``Model.coarse``) of a scan that shows all.

    Of one that does not it is of all vertices, with the mean over those that it can show: how far those on the hidden side are
    from its points, which is most of L_c, says nothing of the pose.
    """
    if coverage.whole:
        return problem.evaluate(model.coarse, state, PLAIN).value
    V = model.deformed(state).vertices
    on = PointIndex(V).nearest(problem.X)
    seen = seen_vertices(coverage, V, model.rig.faces, problem, on, problem.x_index.nearest(V))
    if model.areas[seen].sum() < coverage.least:  # no view of this pose: then the points alone say how far off it is
        seen[on] = True
    return Problem(problem.X, problem.x_weights, seen.astype(float)).evaluate(model, state, PLAIN).value


def distinct(runners, joints, alike):
    """Those of runners that have come to another pose than all before them.

    Parameters
    ----------
    runners : list of Runner
        The best first.
    joints : callable (Runner) → (J, 3) array
        Where its pose has the joints, the same frame for all.
    alike : callable (Runner) → float
        How far joints are apart, on the mean, in poses that are one.
    """
    out, known = [], []
    for r in runners:
        own = joints(r)
        if all(np.linalg.norm(own - other, axis=1).mean() > alike(r) for other in known):
            out.append(r)
            known.append(own)
    return out
