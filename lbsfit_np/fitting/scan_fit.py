"""The fit of one scan by itself: the scout's pose, or one from known labels or a given start; then the last stages."""

import time
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ..errors import InputError, listed
from ..losses.objective import PRESETS, LossWeights, check_compare
from ..optimize.frame import Frame, root_turn, turned_root
from ..optimize.problem import Problem
from ..optimize.state import IN_UNIT, SIZED
from ..optimize.visibility import Coverage
from ..rig.frames import up_axis
from ..seeds import generator, integer_seed
from ..starts.beyond import end_of
from ..starts.clean import taking_part
from ..starts.scale import unit_note
from ..starts.turns import Facing, contradicts_note, some_turns, stands_note
from ..threads import one_thread
from .assemble import assemble
from .checks import check_settings, check_suits
from .drawn import drawn_by_itself
from .labels import DOUBT, one_hot
from .last_stages import LastStages
from .mirror_image import looked_at_in_the_mirror
from .missing import MissingLimbs
from .one_thing import APART, looked_at_apart
from .proportioned import Proportioned
from .refit import Refit, Runner
from .scout import Scout
from .search import Search
from .second_look import looked_at_again

__all__ = [
    "FitSettings",
    "ScanFit",
    "all_points",
    "further_words",
    "given_names",
    "given_views",
    "shares",
    "stands_words",
]


@dataclass(frozen=True)
class FitSettings:
    """How a scan is fitted. Lengths in half sizes of the rig. InputError for what cannot be used.

    Attributes
    ----------
    weights : LossWeights or one of ``PRESETS``
        Of the full objective.
    scale : {"estimate", "fixed"}
    unit : {"m", "cm", "mm", "in", "ft"} or None
        The scans', where it is known; the rig's is then known, too.
    effort : {"fast", "balanced", "thorough"}
        How many starts go how far.
    partial, cropped : bool
        Whether scans show one side only, and whether only a part of the body.
    max_points : int
        Points that take part in the optimisation; a larger scan is thinned by the seed. The last steps of a pose and of
        proportions look at up to four times as many.
    registration : bool
        Whether the skin is brought onto the scan in the end; else pose and offsets are as the full objective has them.
    pose_iterations, plain_iterations, full_iterations : int
        L-BFGS iterations, at most, of each pose stage, of the last pose stage, which has the plain term only, and of the
        full stage.
    full_tolerance : float
        Decrease of the objective in one iteration, as a share of its value at the stage's start, below which the last pose
        stage and the full stage have converged.
    refinements : tuple of float
        σ of each refinement of the labels, each followed by a pose stage; labels that come out go by the last.
    polish : int
        Levenberg–Marquardt steps on pose and proportions before the full stage, and as many on all points; 0 leaves them out,
        and with them, for single scans, other bends, the search for missing limbs, the last steps of the pose, and what a given
        start leads to by itself. On a learned template only other proportions are then not looked for.
    polish_ridge : float
        Weight of ‖c‖² in them.
    ridge : float
        Weight of ‖c‖² on the bones' proportions in the L-BFGS stages.
    doubt : float
        Points whose label is less probable than this take no part in the structured term while ``Search`` refines labels: in
        the stages of a given start and in the full objective. Starts from labels and templates go by ``labels.DOUBT``.
    """

    weights: LossWeights = field(default_factory=lambda: PRESETS["default"])
    scale: str = "estimate"
    unit: str | None = None
    effort: str = "balanced"
    partial: bool = False
    cropped: bool = False
    max_points: int = 2500
    registration: bool = True
    pose_iterations: int = 40
    plain_iterations: int = 100
    full_iterations: int = 40
    full_tolerance: float = 4e-4
    refinements: tuple = (0.15, 0.1, 0.07, 0.05, 0.035, 0.025)
    polish: int = 12
    polish_ridge: float = 3e-5
    ridge: float = 1e-3
    doubt: float = DOUBT

    def __post_init__(self):
        for name, value in check_settings(self).items():
            object.__setattr__(self, name, value)

    @property
    def coverage(self):
        """What scans show."""
        return Coverage(self.partial, self.cropped)


class ScanFit:
    """Fits of single scans with one rig.

    Parameters
    ----------
    model : Model
    settings : FitSettings, optional
    segmenter : Segmenter, optional
        Without one, and without known labels, there is no structured term.
    library : PoseLibrary, optional
        Needed but with known labels or a given start.
    facing : Facing, optional
        How scans may be turned; by default they face the rig's way.
    nearest : bool, default True
        Whether the library's poses are starts, as for ``Scout``.
    prior : PosePrior, optional
        What is known of poses, which they are drawn to unless labels are given; only where ``settings.polish`` is not 0.
    """

    def __init__(self, model, settings=None, *, segmenter=None, library=None, facing=None, nearest=True, prior=None):
        self.model, self.settings = model, settings or FitSettings()
        self.segmenter, self.library, self.nearest, self.prior = segmenter, library, nearest, prior
        self.facing = facing or Facing()

    @cached_property
    def scout(self):
        """The Scout of these settings."""
        return Scout(self.model, self.library, self.facing, self.segmenter, self.settings, nearest=self.nearest)

    def fit(
        self, points, *, theta0=None, labels=None, point_weights=None, random_state=None, part=None, found=None, once=False
    ):
        """Fit one scan.

        Parameters
        ----------
        points : (n, 3) array
            Checked already.
        theta0 : (J, 3) array, optional
            A pose to start from instead of the searched ones.
        labels : (n,) int array, optional
            Known parts, which are kept as they are; −1 where one is not known.
        point_weights : (n,) array, optional
        random_state : int or None
        part : TakingPart, optional
            What of the scan takes part, where that is known already: then this is fitted, no more and no less.
        found : Found, optional
            What the scout said of that ``part``, where it was asked already; only with a ``part``.
        once : bool, default False
            As for ``Scout``; only with a ``part``.

        Returns
        -------
        FitResult

        Raises
        ------
        InputError
            No term of the weights would compare the mesh with the scan.
        """
        started = time.perf_counter()
        if part is None and (found is not None or once):
            raise TypeError(f"{'once' if found is None else 'found'} is of a part: give that, too")
        if not isinstance(random_state, (int, np.integer)):
            random_state = integer_seed(random_state)  # a second look draws the same points
        with one_thread():  # threads on arrays this small cost more than they give
            if part is not None:
                return self._fit(points, theta0, labels, point_weights, part, started, found, once=once)
            rig, given, ups = self.model.source, given_names(theta0, labels), self.facing.floors
            known = {"settings": self.settings, "given": given}

            def some_of_it(among, **how):
                return self.taking_part(points, point_weights, random_state, ups=ups, labels=labels, among=among, **how)

            def fit(part, once=True):
                return self._fit(points, theta0, labels, point_weights, part, started, None, once=once)

            part = some_of_it(None)

            def whole():
                return looked_at_again(part, lambda among, sure: some_of_it(among, sure=sure), fit, points, rig, **known)

            result = looked_at_apart(part, whole, lambda among: some_of_it(among, why=APART), fit, points, **known)

            def reflected(S):
                every = self.taking_part(points, point_weights, random_state, ups=ups).every  # the rest takes time to label
                x, a = points[every] @ S, None if point_weights is None else point_weights[every]
                part = self.taking_part(x, a, random_state, ups=ups)
                return self._fit(x, None, None, a, part, started, None, once=True)

            return looked_at_in_the_mirror(result, reflected, rig=rig, facing=self.facing, given=given)

    def taking_part(self, points, point_weights=None, random_state=None, **known):
        """What of a scan its fit looks at, see ``starts.clean.taking_part``, whose other arguments may be given."""
        check_suits(self.model.source, max_points=self.settings.max_points, unit=self.settings.unit)
        limits = {"most": self.settings.max_points, "scale": self.settings.scale, "unit": self.settings.unit}
        limits |= {"cropped": self.settings.cropped, "point_weights": point_weights}
        return taking_part(points, self.model.source, rng=generator(random_state, "thin"), **limits, **known)

    def _fit(self, points, theta0, labels, point_weights, part, started, found, *, once):
        model, settings = self.model, self.settings
        check_compare(settings.weights, labels is not None or self.segmenter is not None)
        rows, guess = part.rows, part.scale
        a = shares(point_weights, rows)
        given = given_names(theta0, labels)
        if not given:
            found = found or self.scout(points[rows], a, once=once)
            frame, problem, proba, state, before = found.frame, found.problem, found.proba, found.state, 0
            rivals = {"value": found.value, "rivals": found.rivals}
        else:
            frame, problem, proba, state, before = self._given(points, rows, a, guess, theta0, labels)
            rivals = {}
        every, dense = all_points(points, part, point_weights, frame, problem)
        known, shown = {}, None
        if settings.polish:
            state, known = self._last_steps(problem, dense, state, None if labels is None else labels[every])
            if labels is None and not settings.partial:
                shown = self._missing.of(dense, state, self._proportioned, theta0=theta0, **known)
        stages = self._last_stages
        if shown is not None:
            stages, state, proba = self._last_stages_of(shown.model), shown.state, shown.said(proba)
        end = stages(problem, dense, state, proba, labels_known=labels is not None, **known).whole(shown, model)
        last = end.last
        searched = not given or (theta0 is None and self.facing.told)  # of labels only what contradicts is to be said
        stands = stands_words(self.facing, model.source, frame, last.state.theta) if searched else ""
        unit = unit_note(last.state.scale * frame.unit / model.half, model.source, settings.scale, unit=settings.unit)
        return assemble(
            model.source,
            model,
            problem,
            last,
            points=points,
            part=part,
            frame=frame,
            sigma=settings.refinements[-1],
            weights=settings.weights,
            x_labels=end.labels,
            proba=proba,
            labels=labels,
            joint_std=end.joint_std,
            judged_by=end.judged,
            shown=shown,
            evaluations=before + end.evaluations,
            notes=[_parts_without_labels(model.source, labels, rows) if theta0 is None else ""],
            found=(unit, stands),
            further=() if given else further_words(model.source, settings, self.facing),
            given=given,
            started=started,
            coverage=settings.coverage,
            unit=settings.unit,
            **rivals,
        )

    def _last_steps(self, problem, dense, state, labels):
        """The state with pose and proportions by all points, and what else its pose goes by, now and later.

        Labels, where all are known, or what is known of poses, where none are.
        """
        if labels is None and self.prior is not None:
            return drawn_by_itself(self._refit, dense, state, self.prior, self._with_proportions)
        known = {"labels": None if labels is None or labels.min() < 0 else labels}
        return state if dense is problem else self._with_proportions.to_the_end(dense, state, **known)[0], known

    @property
    def _refit(self):
        return self._last_stages.refit

    def _refit_of(self, model):
        free = IN_UNIT if self.settings.scale == "fixed" else SIZED
        return Refit(model, free, coverage=self.settings.coverage)

    @cached_property
    def _missing(self):
        return MissingLimbs(self.model)

    @cached_property
    def _last_stages(self):
        return self._last_stages_of(self.model)

    def _last_stages_of(self, model):
        return LastStages(model, self.settings, self._refit_of(model), polish=self.settings.polish > 0)

    @cached_property
    def _with_proportions(self):
        return self._proportioned(self.model)

    def _proportioned(self, model):
        return Proportioned(model, self.settings, self._refit.free)

    def _given(self, points, rows, a, scale, theta0, labels):
        """Where a given start, which says how the scan is turned, or known labels, which tell it, lead before the full objective.

        Frame, problem, probabilities of the parts, state, and how many evaluations that took.
        """
        model, best = self.model, None
        known = None if labels is None else labels[rows]
        place = model.source, self.facing, points[rows], a, scale
        for frame, problem, proba, theta in given_views(*place, self.segmenter, theta0, known):
            search = Search(model, problem, proba, labels is not None, self.settings).start(theta)
            if best is None or search.outcome.value < best[-1].outcome.value:
                best = frame, problem, proba, theta, search
        frame, problem, proba, theta, search = best
        others = []
        # Labels, also right ones of one side, may lead away from a start that is right; the polish tells the best.
        if theta0 is not None and self.settings.polish:
            known = Runner(problem, self._refit.in_place(problem, theta))
            others = [end.state for end in [known, *(self._refit.race([known]) if labels is None else ())]]
        # What is known of fits, and the weights of losses, are of half sizes: in the scan's own unit, not in that of a guess.
        state = search.pose(others)
        q = state.scale
        return replace(frame, unit=frame.unit * q), problem.in_unit(q), proba, state.in_unit(q), search.evaluations


def all_points(points, part, point_weights, frame, problem):
    """What the last steps look at: rows (d,) of all points of the body, as far as they are looked at, and their Problem.

    Parameters
    ----------
    points : (n, 3) array
    part : TakingPart
    point_weights : (n,) array or None
    frame : Frame
    problem : Problem
        Of ``part.rows`` in that frame, which is taken where there are no more.
    """
    if not len(part.more):
        return part.rows, problem
    return part.every, Problem(frame.inside(points[part.every]), shares(point_weights, part.every))


def shares(point_weights, rows):
    """Weights of some points as shares of 1; None without any."""
    return None if point_weights is None else point_weights[rows] / point_weights[rows].sum()


def given_names(theta0, labels):
    """Which of these a caller has given, by their names."""
    return [name for name, value in (("theta0", theta0), ("labels", labels)) if value is not None]


def given_views(rig, facing, x, x_weights, unit, segmenter, theta0, labels, *, size=1.0):
    """A scan turned back as a given start says, or by some turns, among which known labels tell the right one.

    Parameters
    ----------
    rig : Rig
    facing : Facing
    x : (k, 3) array
        Points that take part.
    x_weights : (k,) array or None
    unit : float
        Scan units in a rig unit.
    segmenter : Segmenter or None
    theta0 : (J, 3) array or None
        The start's angles in the scan's frame.
    labels : (k,) int array or None
        Known ones, −1 where one is not known.
    size : float, default 1
        Of the scan's template, in sizes of those that the segmenter has learned from.

    Raises
    ------
    InputError
        No label of these points is known.

    Yields
    ------
    frame : Frame
    problem : Problem
    proba : (k, n_parts) array or None
        Zeros and ones of known labels, else what the segmenter says of the points in that frame.
    theta0 : (J, 3) array or None
        The start's angles in that frame.
    """
    half, turns = rig.size / 2, some_turns(facing.turns)
    if labels is not None and labels.max() < 0:
        got = f"-1 for all of the {len(labels)} points that take part in the fit"
        raise InputError("labels", got, "the parts of some of them", "Label more points, or pass a larger max_points.")
    known = None if labels is None else one_hot(labels, len(rig.parts))
    if theta0 is not None:  # in a frame that is turned along, the segmenter sees the scan as it has learned it
        turns = root_turn(rig, theta0)[None]
        theta0 = turned_root(rig, theta0, turns[0].T)
    for turn in turns:
        frame = Frame(x.mean(axis=0), unit * half, turn)
        problem = Problem(frame.inside(x), x_weights)
        asked = known is None and segmenter is not None
        yield frame, problem, segmenter.predict_proba(problem.X * half, scale=size, views=1) if asked else known, theta0


def stands_words(facing, rig, frame, theta):
    """In words, which way a scan stands that was found to be fitted so, where that is another than said, or than the rig's."""
    if facing.told:
        return contradicts_note(frame.turn @ root_turn(rig, theta) @ up_axis(rig), facing.up)
    if not facing.open_up:
        return ""
    turn = frame.turn @ root_turn(rig, theta)  # what was found under another axis may but lean, and the other way round
    if not stands_note(frame.turn, facing.up) and not contradicts_note(turn @ facing.up, facing.up):
        return ""
    return stands_note(turn, facing.up)


def _parts_without_labels(rig, labels, rows):
    """In words, which parts no point is labelled as where some points have no label: their pose is told by the surface alone."""
    if labels is None or labels[rows].min() >= 0:
        return ""
    without = [rig.parts[p] for p in np.flatnonzero(np.bincount(labels[rows][labels[rows] >= 0], minlength=len(rig.parts)) == 0)]
    if not without:
        return ""
    words = "what the scan shows of these may be fitted wrongly; without labels it is searched for"
    return f"no point that takes part is labelled as {listed(without, 6)}: {words}"


def further_words(rig, settings, facing):
    """What would look further at a scan in doubt than a search with these settings, a tuple of strings for users."""
    fast = settings.effort == "fast"
    also = ["along other up axes"] * facing.open_up + ["for what goes on beyond the rig"] * (end_of(rig) is not None)
    also = f", also {' and '.join(also)}" if also else ""
    more = (f"effort 'balanced' (--effort balanced) looks further{also}",) if fast else ()
    if facing.told and len(facing.turns) > 1:  # by a second look, which "fast" has none of
        more += (f"{'with that and ' if fast else ''}without up (--up), other axes are tried, too",)
    return more
