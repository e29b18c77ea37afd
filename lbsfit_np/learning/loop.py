"""Algorithm 1: the fits teach the segmenter, the segmenter improves the fits, and the templates adapt to what was scanned.

After pretraining and a first fit of each scan by itself, a round does this:

1. each subject's template from the poses of its scans (``fitting.template``), scans that are explained badly left out;
2. training scans from the mixture Θ' on these templates (``mixture``); s is trained on, f and the library of starts anew;
3. the labels of all scans; every pose again, from its last one, from labels, from f and from the library, then with other
   poses for limbs that are better off so (``fitting.refit``), with more points, drawn to what all poses tell (``pose_prior``);
4. templates and poses in turn a few times more, each from the other, which takes little time without new labels and starts;
5. the loss on the scans held out: rounds end when it no longer falls.

At the end the registration gives each scan what its skin lacks on its subject's template.
"""

import time
import warnings
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ..fitting.template import SHIFTS
from ..optimize.model import Model
from ..optimize.state import free_angles
from ..processes import kept_processes
from ..scan import some_rows
from ..segmentation.segmenter import Segmenter, train_segmenter
from ..segmentation.stage import Training
from ..starts.beyond import end_of
from ..starts.library import PoseLibrary, build_library
from ..threads import one_thread
from ..workers import beside
from .checkpoint import FIRST_FIT, NO_CHECKPOINT, kept_by_its_process
from .collection import HELD_OUT, LEARNED_FROM
from .first_fits import FirstFit, most_have_failed
from .mixture import Mixture
from .pose_prior import LEAST, looked_at, pose_prior
from .scales import check_scales, scale_of, scale_warnings, size_and_unit, units_apart, use_unit
from .sequence import drawn_to_neighbours, poses_beside
from .tasks import Drawn, Held, Labels, Models, Pose, Template, Told, with_right_poses

__all__ = ["Learned", "Loop", "LoopSettings"]

# Share of the time that poses take, before they are drawn to each other; of a turn's, that its templates do.
_SEARCH, _OF_A_TURN = 0.8, 0.4
# Of the smoothing of a sequence.
_SWEEPS = 3
# Points of a subject's scans that its template is found from, at most, where a scan has more than take part in its fit.
_OF_A_TEMPLATE = 100_000


@dataclass(frozen=True)
class LoopSettings:
    """How the loop goes.

    Attributes
    ----------
    rounds : int
        At most.
    round_scans : int
        Synthetic scans that s is trained on in a round.
    library_scans : int
        Synthetic scans of the library, which f is trained on, too.
    neighbours : int
        Poses of the library that a scan starts from.
    turns : int
        Times that templates and poses are found once more, each from the other, before a round ends.
    improvement : float
        Relative fall of the loss on scans held out below which rounds end; by less than that two rounds are level.
    training : Training
        Of s in a round.
    """

    rounds: int = 4
    round_scans: int = 4000
    library_scans: int = 1500
    neighbours: int = 6
    turns: int = 2
    improvement: float = 0.005
    training: Training = field(default_factory=lambda: Training(epochs=4, learning_rate=1e-3))

    @classmethod
    def for_training(cls, training_scans, **others):
        """In proportion to the scans of pretraining, of which there are 4,000 by default."""
        return cls(round_scans=max(100, training_scans), library_scans=max(100, 3 * training_scans // 8), **others)


@dataclass(frozen=True)
class Learned:
    """What a loop has learned.

    Attributes
    ----------
    templates : dict of id to (vertices (m, 3), joints (J, 3)), or to None
        In rig units, the rig's own vertices; None where it is the rig's own template, without skinning.
    units : dict of id to float
        Scan units in a rig unit.
    segmenter : Segmenter or None
    library : PoseLibrary
    pose_prior : PosePrior or None
    history : list of dict
    """

    templates: dict
    units: dict
    segmenter: object
    library: object
    pose_prior: object
    history: list


class Loop:
    """One run of Algorithm 1.

    Parameters
    ----------
    rig : Rig
    collection : Collection
    variant : Variant
    segmenter : Segmenter or None
        Pretrained.
    library : PoseLibrary
        Pretrained.
    facing : Facing
        How scans may be turned.
    fit_settings : FitSettings
    settings : LoopSettings
    synthesis : Synthesis
        Of the training scans.
    joints : {"follow", "fixed"}
    sequence : bool
    smooth : float; weight of the angles' distance from their neighbours', in a sequence
    jobs : int
    random_state : int
    progress : callable (stage, share, figures) or None; ``figures`` is a round's entry of the history when it ends, else None
    on_round, on_kept : callable (k, segmenter), (Learned), or None, after a round; the latter if it is kept unless a later one is
    checkpoint : Checkpoint
        Of all of the above but the collection, the variant, ``sequence``, ``smooth``, ``jobs`` and the number of rounds.
    """

    def __init__(
        self,
        rig,
        collection,
        variant,
        segmenter,
        library,
        *,
        facing,
        fit_settings,
        settings,
        synthesis,
        joints,
        sequence,
        smooth,
        jobs,
        random_state,
        progress,
        on_round=None,
        on_kept=None,
        checkpoint=NO_CHECKPOINT,
    ):
        self.rig, self.collection, self.variant, self.segmenter = rig, collection, variant, segmenter
        self.fit_settings, self.settings, self.synthesis, self.joints = fit_settings, settings, synthesis, joints
        self.sequence, self.smooth, self.jobs, self.seed = sequence, smooth, jobs, random_state
        self.progress = progress or (lambda stage, share, figures=None: None)
        self.on_round, self.on_kept = on_round or (lambda k, segmenter: None), on_kept or (lambda learned: None)
        self.model = Model(rig, joints)
        self.shifting = Model(rig, joints, shifts=SHIFTS if joints == "follow" else 0.0)
        self.library, self.facing = library, facing
        self.coefficients, self.pose_prior, self.history = {}, None, []
        self._first_kept = checkpoint.narrowed((variant.labels, variant.library))  # which is all that these hang on of a variant
        scans = [(m.index, m.points, m.part, m.subject, m.held_out) for m in collection.members]
        self._kept = checkpoint.narrowed((variant, sequence, scans))

    @one_thread()
    @kept_processes()
    def run(self):
        """All rounds; returns Learned, and leaves in each member its state, points in the frame and loss."""
        started = time.perf_counter()
        failed = self._first_fits()
        self._note(0, started, {"beyond": sum(m.part.among is not None for m in self.collection.members), "failed": failed})
        self.progress("round", 1.0, self.history[-1])
        best, bring_back, learned = np.inf, None, None
        for k in range(1, self.settings.rounds + 1):
            began = time.perf_counter()
            templates = self._templates(k)
            self._learn(k, templates)
            won = self._refit(k, templates)
            self._last_steps(k, templates)
            templates = self._in_turn(k, templates)
            value = self._note(k, began, {"new_starts_won": won})
            fallen = value is None or value < best * (1 - self.settings.improvement)
            # Of rounds that are level the later, whose s has learned more.
            if fallen or value < best * (1 + self.settings.improvement) or learned is None:
                best, learned = value, self._learned(k, templates)  # one that has not fallen is the last
                self.on_kept(learned)  # before others are told of the round, who may stop the run
                bring_back = self.collection.as_it_is()
            self.progress("round", 1.0, self.history[-1])
            self.on_round(k, self.segmenter)
            if not fallen:
                break
        bring_back()
        if self.sequence and self.smooth:
            self._smooth(learned.templates, learned.pose_prior)
        return replace(learned, history=self._history(learned.history[-1]["round"]))

    # ---- the steps ----

    def _first_fits(self):
        """Each scan by itself, on the rig's own template with proportions; how many of these fits have failed."""
        half, hold_out = self.model.half, bool(self.collection.with_role(HELD_OUT))
        unit, estimate = self.fit_settings.unit, self.fit_settings.scale == "estimate"
        guess = self.collection.members[0].unit  # one for all
        segmenter = self.segmenter if self.variant.labels else None
        work = FirstFit(self.model, self.fit_settings, segmenter, self.library, self.facing, self.variant.library, self.seed)
        tasks = [work.task(m) for m in self.collection.members]
        answers = self._work(work, tasks, "first fits", [self._first_kept.slot(FIRST_FIT, task) for task in tasks])
        scales, failed = {}, [wrong for *_, wrong in answers]
        if words := most_have_failed(work, self.collection.members, failed, self._first_kept.slot):
            warnings.warn(words, stacklevel=2)
        for m, (frame, state, loss, proba, rivals, part, _) in zip(self.collection.members, answers, strict=True):
            if part is not None:
                m.take(part)
            m.use_frame(frame.unit / half, half, frame.turn)
            m.proba, m.loss, m.first = proba, loss, (state.theta, rivals)
            scales.setdefault(m.subject, []).append(state.scale * m.unit)
            m.state = state
        if unit is None:
            guess = self.collection.unit_by_extents  # anew: what is beyond the rig made extents of its own
        for subject, found in scales.items() if estimate else ():
            check_scales(self.collection.of(subject), found, ends=end_of(self.rig) is not None)
        if hold_out:  # those that were may be in another unit, or have failed
            self.collection.keep_one_held_out()
        if estimate and unit is None and (apart := units_apart(scales)):
            warnings.warn(apart, stacklevel=2)
        for subject in self.collection.subjects:
            members = self.collection.of(subject)
            scale = scale_of(members, scales[subject]) if estimate else guess
            size, unit = size_and_unit(scale, guess, grows=self.joints == "follow")
            c = np.zeros(self.shifting.n_coefficients)
            c[: self.model.n_proportions] = size - 1.0
            self.coefficients[subject] = c
            for words in scale_warnings(members):
                warnings.warn(words, stacklevel=2)
            for m in members:
                use_unit(m, size, unit, half, self.model.rig.joints[self.rig.root])
        self._follow()
        return sum(failed)

    def _templates(self, k, stage="templates", span=(0.0, 1.0)):
        """Each subject's template from the poses of its scans that are learned from, or that it has at all."""
        tasks, subjects = [], self.collection.subjects
        for subject in subjects:
            learning = self.collection.with_role(LEARNED_FROM, subject) or self.collection.of(subject)
            c = self.coefficients[subject]
            tasks.append(
                (
                    [m.X for m in learning],
                    [m.dense_X[some_rows(m.dense_X, max(len(m.X), _OF_A_TEMPLATE // len(learning)))] for m in learning],
                    [m.state.replace(coefficients=c, residual=None) for m in learning],
                    np.array([m.loss for m in learning]),
                    [m.proba for m in learning] if self.variant.labels else None,
                )
            )
        work = Template(self.shifting, self.fit_settings.coverage, self.pose_prior)
        kept = [self._kept.slot(f"round-{k}-template", (s, self.pose_prior)) for s in subjects]
        found = self.collection.work_of_subjects(work, tasks, jobs=self.jobs, done=self._done(stage, span), kept=kept)
        self.coefficients = {s: c for s, (_, _, c) in found.items()}
        self._follow()
        return {s: (np.ascontiguousarray(self.rig.unwelded(U)), J) for s, (U, J, _) in found.items()}

    def _mixture(self, k, templates):
        v, rig = self.variant, self.rig.welded
        learning = self.collection.with_role(LEARNED_FROM)
        known = with_right_poses(learning)
        poses = np.array([m.state.theta for m in known]) if v.inferred_poses else np.empty((0, *rig.lower.shape))
        rows = self.rig.welded_from
        taught_by = {m.subject for m in learning}  # of others all scans are held out, and their templates with them
        made = tuple((U[rows], J) for s, (U, J) in templates.items() if s in taught_by) if v.deformed else ()
        return Mixture(rig, self.synthesis, poses, made, self.seed, k)

    def _learn(self, k, templates):
        """Train s on the round's mixture, and f and the library anew."""
        mixture = self._mixture(k, templates)
        of_s, of_library = (self._kept.slot(f"round-{k}-{what}") for what in ("segmenter", "library"))
        s, library = of_s.known(Segmenter) if self.variant.labels else None, of_library.known(PoseLibrary)
        train = s is None and self.variant.labels
        told = self._done("library of starts", (0.0, 1.0))
        build = partial(build_library, mixture.scan, self.settings.library_scans, random_state=self.seed)
        if train and library is None and self.jobs > 1:
            # s keeps but one core busy while its networks learn.
            with beside(partial(kept_by_its_process, of_library, build)) as made:
                s = of_s.keep(self._trained(mixture))
                told(0.0)
                library = of_library.keep(made())  # which says, unlike the other process, where it cannot be kept
                told(1.0)
        else:
            s = of_s.keep(self._trained(mixture)) if train else s
            if library is None:
                told(0.0)
                library = of_library.keep(build(jobs=self.jobs, progress=told))
        self.segmenter, self.library = s, library
        if self.variant.labels:
            self._label(templates)

    def _trained(self, mixture):
        self.progress("segmenter", 0.0)
        return train_segmenter(
            self.rig.welded,
            mixture,
            self.settings.round_scans,
            training=self.settings.training.going_on(self.segmenter),
            random_state=self.seed,
            n_jobs=self.jobs,
            progress=lambda p: self.progress("segmenter", p),
            start=self.segmenter,
        )

    def _label(self, templates):
        rig, taught = self.rig, self.variant.deformed  # what no templates have taught knows the rig's size alone
        sizes = {s: rig.with_template(*t).size / rig.size for s, t in templates.items() if not taught}
        tasks = [(m.X, m.state.theta, sizes.get(m.subject, 1.0)) for m in self.collection.members]
        found = self._work(Labels(self.segmenter, rig), tasks, "labels")
        for m, proba in zip(self.collection.members, found, strict=True):
            m.proba = proba
        self._follow()

    def _refit(self, k, templates):
        """Every pose again on its subject's template; returns how many new starts won."""
        members = self.collection.members
        neighbours = self.settings.neighbours if self.variant.library else 0
        work = Pose(self._models(templates), self.fit_settings, self.library, neighbours, self.variant.library)
        beside = poses_beside(self.rig, members) if self.sequence else [[] for _ in members]
        proba = [m.proba if self.variant.labels else None for m in members]
        tasks = [(m.subject, m.X, m.state, *known) for m, *known in zip(members, beside, proba, strict=True)]
        kept = [self._kept.slot(f"round-{k}-pose", m.index) for m in members]
        answers = self._work(work, tasks, "poses of scans", kept, (0.0, _SEARCH))
        won = 0
        for m, (state, loss, which) in zip(self.collection.members, answers, strict=True):
            won += which > 0
            m.state, m.loss = state, loss
        self._follow()
        return won

    def _last_steps(self, k, templates, stage="poses of scans", span=(_SEARCH, 1.0)):
        """Every pose as its scan tells it by all its points, and where that leaves it open, as the others' poses do."""
        (start, end), middle = span, np.mean(span)
        models, coverage = self._models(templates), self.fit_settings.coverage
        learning = with_right_poses(self.collection.with_role(LEARNED_FROM), LEAST)
        asked = {learning[i].index for i in looked_at(len(learning))} if self.variant.prior else ()

        def slots(step, *made_of):
            return [self._kept.slot(f"round-{k}-{step}", (m.index, *made_of)) for m in self.collection.members]

        tasks = [(m.subject, m.dense_X, m.state, m.index in asked) for m in self.collection.members]
        told, tasks = self._work(Told(models, coverage), tasks, stage, slots("told"), (start, middle)), None  # all points of all
        known = [(state.theta, C) for state, _, C in told if C is not None]
        self.pose_prior = pose_prior(*zip(*known), free_angles(self.rig), self.rig.root) if known else None
        tasks = [(m.subject, m.X, m.dense_X, *found[:2]) for m, found in zip(self.collection.members, told, strict=True)]
        work = Drawn(models, coverage, self.pose_prior)
        answers = self._work(work, tasks, stage, slots("drawn", self.pose_prior), (middle, end))
        for m, (state, loss, noise) in zip(self.collection.members, answers, strict=True):
            m.state, m.loss, m.noise = state, loss, noise
        self._follow()

    def _in_turn(self, k, templates):
        """Templates from the poses, and poses on these without a search; the last ones. A turn that loses a scan is not taken."""
        stage = "templates and poses in turn"

        def turn(i, templates):
            start, end = i / n, (i + 1) / n
            middle = start + _OF_A_TURN * (end - start)
            found = self._templates(k, stage, (start, middle))
            self._last_steps(k, found, stage, (middle, end))
            return found

        n = self.settings.turns
        return self._unless_lost(turn, n, templates, f"round {k}: the step '{stage}' stopped after {{}} of {n} turns")

    def _unless_lost(self, step, n, found, stopped):
        """What ``step(i, found)`` finds, n times over; the last that loses no scan, with a warning where one does."""
        for i in range(n):
            known = self.coefficients, self.pose_prior
            new, lost = self.collection.unless_lost(partial(step, i, found))
            if lost:
                self.coefficients, self.pose_prior = known
                warnings.warn(f"{stopped.format(i)}: {lost}", stacklevel=2)
                break
            found = new
        return found

    def _follow(self):
        """What is kept from here on depends on what fits have found, and for whom."""
        self._kept = self._kept.narrowed([(m.index, m.state, m.loss, m.held_out) for m in self.collection.members])

    def _smooth(self, templates, pose_prior):
        """A few sweeps that draw each pose towards the mean of its neighbours' and its own, as the sweep before left them."""
        work = Held(self._models(templates), self.fit_settings.coverage, pose_prior)

        def sweep(i, _):
            wanted = drawn_to_neighbours(self.rig, self.collection.members, self.smooth)
            tasks = [(m.subject, m.dense_X, m.state, wanted.get(m.index), m.noise) for m in self.collection.members]
            states = self._work(work, tasks, "smoothing")
            for m, state in zip(self.collection.members, states, strict=True):
                m.state, m.prior = state, wanted.get(m.index, m.prior)

        self._unless_lost(sweep, _SWEEPS, None, f"smoothing stopped after {{}} of {_SWEEPS} sweeps")

    def _work(self, work, tasks, stage, kept=(), span=(0.0, 1.0)):
        """The members' answers; those who fail are members no more. The work takes this span of the stage's time."""
        return self.collection.work(work, tasks, jobs=self.jobs, done=self._done(stage, span), kept=kept)

    def _done(self, stage, span):
        """What says of a share of some work how far its stage is, which it takes this span of."""
        start, end = span
        return lambda share: self.progress(stage, (1 - share) * start + share * end)  # exact at both ends, as others go on there

    def _models(self, templates):
        return Models({s: self.rig.with_template(*t) for s, t in templates.items()}, self.joints, self.model.half)

    def _learned(self, k, templates):
        """What is learned if round k is kept; without the subjects whose scans have all failed."""
        units = {s: self.collection.of(s)[0].unit for s in self.collection.subjects}
        templates = {s: templates[s] for s in units}
        return Learned(templates, units, self.segmenter, self.library, self.pose_prior, self._history(k))

    def _history(self, kept):
        return [entry | {"kept": entry["round"] == kept} for entry in self.history]

    def _note(self, k, began, more):
        """One more entry of the history; the value that decides when to stop, None where no scan is held out to tell."""
        losses = ([np.sqrt(m.loss) for m in self.collection.with_role(r)] for r in (LEARNED_FROM, HELD_OUT))
        recon, held_out = (float(np.mean(of)) if of else None for of in losses)
        if recon is None and not any(entry["recon"] is None for entry in self.history):
            words = f"none of the scans learned from could be fitted in round {k}: do not trust what was learned"
            warnings.warn(f"{words}; failures_ will say why", stacklevel=2)
        kept = self._kept.slot(f"round-{k}-seconds")
        seconds = kept.known() or round(time.perf_counter() - began, 2)  # of a round that was gone on with, those since then
        entry = {
            "round": k,
            "recon": recon,
            "recon_held_out": held_out,
            "seconds": kept.keep(seconds),
            **more,
        }
        self.history.append(entry)
        return held_out
