"""The first look at a scan of which nothing is known: which way it faces, in which unit it is, and its pose.

Hypotheses come from the library of synthesised poses, under all turns that the scan may have, and from f. Under the turn of
the best one, under the half turns that take front for back or left for right, and under others that did well, the segmenter
says which part each point belongs to, which gives more. All go a few steps on the rig's own template, the best go on, limbs
are tried in other places, the last ones find the rig's proportions; what they leave unexplained chooses. Of what is chosen
other bends are tried. Where that leaves the pose in doubt, all is done once more with more effort.
"""

from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from ..optimize.frame import Frame
from ..optimize.problem import Problem
from ..optimize.state import IN_UNIT, SIZED
from ..rig.frames import up_axis
from ..rotations import angle_between, matrix_from_rotvec
from ..scan import some_rows
from ..starts.limbs import LimbPoses
from ..starts.scale import sizes_in, unit_scale
from ..starts.turns import any_side_up
from .bends import Bends
from .confidence import evidence_of, probability_of
from .effort import EFFORTS
from .labels import LEANS, said_of
from .proportioned import Proportioned, step_options
from .refit import LimbSearch, Refit, Runner, distinct

__all__ = ["ALIKE", "Found", "Scout"]


# Labels are read of so many points, and lead so many of them, under turns that are further apart than this, radians.
_LABELLED, _LED, _ELSEWHERE = 900, 500, LEANS
# Poses whose joints are nearer than this on average, in half sizes, are one.
ALIKE = 0.03
# Of views of one side that are cropped, so many times as many poses go the first steps: how alike they look tells less there.
_MORE_STARTS = 3
# Without proportions, the right pose may leave this many times as much unexplained as a wrong one.
_RIVAL = 2.0
# A pose that is right with less than this probability is worth a second look; of views of one side that are cropped, less speaks
# against a wrong one.
_SURE, _SURE_OF_LITTLE = 0.8, 0.95


@dataclass(frozen=True)
class Found:
    """What a scout has found.

    Attributes
    ----------
    frame : Frame
    problem : Problem
        In that frame.
    state : State
        Pose, place and proportions.
    proba : (n, n_parts) array or None
        What the segmenter says of the points, seen in that frame, turned along where the state's root is turned far.
    value : float
        What the state leaves unexplained: E of ``optimize.gauss_newton`` where a scout has found it, L_c where a refit has.
    rivals : tuple of float
        The same of other poses that were found.
    free : tuple of {"pose", "translation", "scale"}
        What was looked for.
    """

    frame: Frame
    problem: Problem
    state: object
    proba: np.ndarray
    value: float
    rivals: tuple
    free: tuple = SIZED


class Scout:
    """Hypotheses for scans of one template.

    Parameters
    ----------
    model : Model
    library : PoseLibrary
    facing : Facing
        How scans may be turned.
    segmenter : Segmenter or None
        Without one there is no hypothesis from labels.
    settings : FitSettings
    unit : float, optional
        Scan units in a rig unit, where they are known; else they are found.
    proportions : bool, default True
        Whether the template's proportions are found as well, or are known.
    nearest : bool, default True
        False leaves out the library's poses, of limbs as well, but not what they tell of turn and unit.
    size : float, default 1
        Of the template, in sizes of those that the segmenter and the library have learned from.
    """

    def __init__(self, model, library, facing, segmenter, settings, *, unit=None, proportions=True, nearest=True, size=1.0):
        self.model, self.library, self.facing, self.segmenter = model, library, facing, segmenter
        self.size = size
        self.settings, self.nearest, self.effort = settings, nearest, EFFORTS[settings.effort]
        self.unit = (unit_scale(model.source, settings.unit) or 1.0) if settings.scale == "fixed" else unit
        self._sizes = {"unit": size * self.unit} if self.unit else sizes_in(model.source, settings.unit)  # as it sees them
        self._free = IN_UNIT if self.unit else SIZED
        self._refit = Refit(model, self._free, coverage=settings.coverage)
        up = up_axis(model.source)
        # About the up axis; where any rotation may be, about the other two axes as well.
        self._flips = [up] if facing.up is not None else [up, *np.eye(3)[up == 0]]
        self._limbs = LimbPoses(model, library.poses)
        self._to_the_end, self._bends = self._refit.to_the_end, None
        self._judged = None, None  # what was judged last is asked for again
        if settings.polish:
            last = Proportioned(model, settings, self._free) if proportions else self._refit
            self._to_the_end = last.to_the_end
            known = {"proportions": proportions, "other_limbs": nearest}
            self._bends = Bends(model, self._free, last.to_the_end, **known, **step_options(settings))

    def __call__(self, points, x_weights=None, *, once=False):
        """Look at one scan.

        Parameters
        ----------
        points : (n, 3) array
            Those that take part.
        x_weights : (n,) array, optional
        once : bool, default False
            Whether there is no second look where the first leaves the pose in doubt.

        Returns
        -------
        Found
        """
        looked = self._look(points, x_weights)
        found = self._found(*looked)
        again = None if once else EFFORTS.get(self.effort.again)
        if again and (again != self.effort or self.facing.open_up) and not self.is_sure(found):
            closer = copy(self)
            closer.effort = again
            if self.facing.open_up:  # not every scan has the rig's up axis
                closer.facing = replace(self.facing, turns=any_side_up(self.facing.turns, self.facing.up))
            (first, *others), worse = sorted((looked, closer._look(points, x_weights)), key=lambda look: _unexplained(look[0]))
            first, *others = self._distinct([first, *sorted([*others, *worse], key=_unexplained)])
            found = replace(found, rivals=_rivals(first, others)) if first is looked[0] else self._found(first, *others)
        return found

    def _found(self, best, *others):
        seen = None if self.segmenter is None else self._seen(best)
        return Found(best.name, best.problem, best.state, seen, best.value, _rivals(best, others), self._free)

    def _look(self, points, x_weights):
        """Runners of different poses, the best first."""
        effort, refit = self.effort, self._refit
        runners = refit.first_steps(self._runners(points, x_weights))
        runners = self._resized(runners, runners[0])
        if self.segmenter is not None:
            labelled = [self._labelled(points, x_weights, frame) for frame in self._facings(runners)]
            runners = sorted([*runners, *refit.first_steps(labelled)], key=lambda r: r.value)
        ends = refit.last_steps(runners[: effort.survivors])
        near = self._distinct(refit.with_other_limbs(ends, LimbSearch(self._limbs, effort)) if self.nearest else ends)
        close = [r for r in near[: effort.finals] if r.value <= _RIVAL * near[0].value]
        finals = list(map(self._ended, close))
        # What the others would leave unexplained if proportions helped them as much as the best.
        helped = min((e.value, e.value / max(r.value, 1e-300)) for e, r in zip(finals, close, strict=True))[1]
        finals.sort(key=lambda r: r.value)
        if self._bends and effort.bends:
            state, value = self._bends(finals[0].problem, finals[0].state, finals[0].value)
            finals[0] = replace(finals[0], state=state, value=value)
        others = [replace(r, value=r.value * helped) for r in near[len(close) :]]
        # With proportions, or other bends, two may have come to one pose, which is no rival of itself.
        return self._resized(self._distinct([*finals, *others]), finals[0])

    def is_sure(self, found):
        """Whether what was found is likely to be right."""
        shows = self.settings.coverage
        return self.probability(found) >= (_SURE_OF_LITTLE if shows.one_sided and shows.cropped else _SURE)

    def probability(self, found):
        """How likely the pose is right, by what is known of it before the full objective."""
        judged, probability = self._judged  # at once, as threads may share a fitter
        if judged is not found:
            state = found.state
            known = {"proba": found.proba, "rivals": found.rivals, "value": found.value, "theta": state.theta}
            known |= {"coverage": self.settings.coverage, "x_weights": found.problem.x_weights}
            # Without what the scan tells of single joints: a second look finds no points that it lacks.
            evidence, _ = evidence_of(self.model, self.model.deformed(state).vertices, found.problem.X, **known)
            probability = probability_of(evidence)
            self._judged = found, probability
        return probability

    def _runners(self, points, x_weights):
        centre = points.mean(axis=0) if x_weights is None else x_weights @ points
        shows = self.settings.coverage
        most = self.effort.starts * (_MORE_STARTS if shows.one_sided and shows.cropped else 1)
        starts = self.library.starts(points, self.facing.turns, most, **self._sizes)
        starts = [replace(s, scale=s.scale / self.size) for s in starts]

        def regressed(start):
            """As f has it, which answers for a scan that faces the rig's way."""
            return replace(start, theta=self.library.regress(points @ self.facing.turns[start.turn]))

        if self.nearest:
            starts.append(regressed(starts[0]))
        else:
            turns = {s.turn: s for s in reversed(starts)}.values()
            starts = [other for s in turns for other in (replace(s, theta=np.zeros_like(s.theta)), regressed(s))]
        # One unit for all, as what is left unexplained is compared.
        unit = self.unit or float(np.median([s.scale for s in starts]))
        frames = {s.turn: Frame(centre, unit * self.model.half, self.facing.turns[s.turn]) for s in starts}
        problems = {turn: Problem(frame.inside(points), x_weights) for turn, frame in frames.items()}
        placed = self._refit.placed
        return [
            Runner(problems[s.turn], placed(problems[s.turn], s.theta, 1.0 if self.unit else s.scale / unit), frames[s.turn])
            for s in starts
        ]

    def _resized(self, runners, one):
        """All, in frames of the unit in which the scale of one of them is 1."""
        q, problems, out = one.state.scale, {}, []
        if q == 1.0:
            return runners
        for r in runners:
            if id(r.problem) not in problems:
                problems[id(r.problem)] = r.problem.in_unit(q)
            frame = replace(r.name, unit=r.name.unit * q)
            out.append(Runner(problems[id(r.problem)], r.state.in_unit(q), frame, r.value / q**2))
        return out

    def _distinct(self, runners):
        return distinct(runners, self._joints, lambda r: ALIKE * r.name.unit)

    def _facings(self, runners):
        """Frames under which labels are read: the best runner's, its half turns, and those of others that face elsewhere."""
        frames = []
        if len(self.facing.turns) > 1:
            flips = [matrix_from_rotvec(np.pi * axis) for axis in self._flips]
            frames = [replace(runners[0].name, turn=runners[0].name.turn @ flip) for flip in flips]
        out = [runners[0].name]
        for frame in [*frames, *(r.name for r in runners)]:
            apart = [angle_between(frame.turn, f.turn) for f in out]
            if len(out) < self.effort.facings and min(apart) > _ELSEWHERE:
                out.append(frame)
        return out

    def _labelled(self, points, x_weights, frame):
        """A start from what the segmenter says in one frame."""
        problem = Problem(frame.inside(points), x_weights)
        few = problem.thinned(_LABELLED)
        proba = self.segmenter.predict_proba(few.X * self.model.half, scale=self.size, views=1)
        led = some_rows(few.X, _LED)
        return Runner(problem, self._refit.from_parts(few.at(led), proba[led], model=self.model.coarsest), frame)

    def _seen(self, runner):
        """What the segmenter says of the points where a runner has come to."""
        return said_of(self.segmenter, self.model.rig, runner.problem.X, runner.state.theta, self.size)

    def _ended(self, runner):
        state, value = self._to_the_end(runner.problem, runner.state)
        return replace(runner, state=state, value=value)

    def _joints(self, runner):
        return runner.name.outside(self.model.deformed(runner.state).joints)


def _unexplained(runner):
    """What a runner leaves, whatever the unit of its frame, by whose square E goes."""
    return runner.value * runner.name.unit**2


def _rivals(best, others):
    """What others leave unexplained, as the frame of the best has it."""
    return tuple(r.value * (r.name.unit / best.name.unit) ** 2 for r in others)
