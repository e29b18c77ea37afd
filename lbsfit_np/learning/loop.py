"""Algorithm 1: the fits teach the segmenter, the segmenter improves the fits, and the templates adapt to what was scanned.

After pretraining and a first fit of each scan by itself, a round does this:

1. each subject's template from the poses of its scans (``fitting.template``), scans that are explained badly left out;
2. training scans from the mixture Θ' on these templates (``mixture``); s is trained on, f and the library of starts anew;
3. the labels of all scans; every pose again, from its last one, from labels, from f and from the library (``fitting.refit``);
4. the loss on the scans left out: rounds end when it no longer falls.

At the end the full objective gives each scan its residual on its subject's template.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from ..fitting.refit import Refit
from ..fitting.scan_fit import prepare_pose
from ..fitting.template import TemplateSettings, shared_template
from ..optimize.model import Model
from ..segmentation.descriptors import describe_scan
from ..segmentation.segmenter import train_segmenter
from ..segmentation.stage import Training
from ..starts.library import build_library
from ..workers import each
from .mixture import Mixture

__all__ = ["Learned", "Loop", "LoopSettings"]

# Scales nearer to 1 than this factor are a matter of people's size, others of units.
_SIZE = 1.3
# Of the smoothing of a sequence.
_SWEEPS = 3


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
    improvement : float
        Relative fall of the loss on scans left out below which rounds end.
    training : Training
        Of s in a round.
    """

    rounds: int = 4
    round_scans: int = 2500
    library_scans: int = 1500
    neighbours: int = 6
    improvement: float = 0.005
    training: Training = field(default_factory=lambda: Training(epochs=3, learning_rate=1e-3))

    @classmethod
    def for_training(cls, training_scans, **others):
        """In proportion to the scans of pretraining, of which there are 4,000 by default."""
        return cls(round_scans=max(100, 5 * training_scans // 8), library_scans=max(100, 3 * training_scans // 8), **others)


@dataclass(frozen=True)
class Learned:
    """What a loop has learned.

    Attributes
    ----------
    templates : dict of id to (vertices (m, 3), joints (J, 3))
        In rig units, the rig's own vertices.
    units : dict of id to float
        Scan units in a rig unit.
    segmenter : Segmenter or None
    library : PoseLibrary
    history : list of dict
    """

    templates: dict
    units: dict
    segmenter: object
    library: object
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
    fit_settings : FitSettings
    settings : LoopSettings
    synthesis : Synthesis
        Of the training scans.
    joints : {"follow", "fixed"}
    sequence : bool
    smooth : float
        Weight of the angles' distance from their neighbours', in a sequence.
    jobs : int
    random_state : int
    progress : callable (stage, share, figures) or None
        ``figures`` is a round's entry of the history when it ends, else None.
    """

    def __init__(
        self,
        rig,
        collection,
        variant,
        segmenter,
        *,
        fit_settings,
        settings,
        synthesis,
        joints,
        sequence,
        smooth,
        jobs,
        random_state,
        progress,
    ):
        self.rig, self.collection, self.variant, self.segmenter = rig, collection, variant, segmenter
        self.fit_settings, self.settings, self.synthesis, self.joints = fit_settings, settings, synthesis, joints
        self.sequence, self.smooth, self.jobs, self.seed = sequence, smooth, jobs, random_state
        self.progress = progress or (lambda stage, share, figures=None: None)
        self.model = Model(rig, joints)
        self.shifting = Model(rig, joints, shifts=TemplateSettings().shifts if joints == "follow" else 0.0)
        self.library = None
        self.coefficients = {}
        self.history = []

    def run(self):
        """All rounds; returns Learned, and leaves in each member its state, problem and loss."""
        started = time.perf_counter()
        if not self.variant.labels:
            self.library = self._library(0)
        self._first_fits()
        self._note(0, started, {})
        best, best_members, learned = np.inf, None, None
        for k in range(1, self.settings.rounds + 1):
            began = time.perf_counter()
            templates = self._templates()
            self._learn(k, templates)
            won = self._refit(templates)
            value = self._note(k, began, {"new_starts_won": won})
            learned_now = Learned(templates, self._units(), self.segmenter, self.library, self.history)
            fallen = value < best * (1 - self.settings.improvement)
            if value < best or learned is None:
                best, learned = value, learned_now
                best_members = [(m.state, m.loss, m.proba) for m in self.collection.members]
            if not fallen:
                break
        for member, (state, loss, proba) in zip(self.collection.members, best_members):
            member.state, member.loss, member.proba = state, loss, proba
        if self.sequence and self.smooth:
            self._smooth(learned.templates)
        return replace(learned, history=self.history)

    # ---- the steps ----

    def _first_fits(self):
        """Each scan by itself, on the rig's own template with proportions."""
        members, half = self.collection.members, self.model.half
        for m in members:
            m.use_unit(m.unit, half)
        self._label()
        work = _FirstFit(self.model, self.fit_settings, self.variant.labels, self.library)
        answers = each(
            work, [(m.problem, m.proba) for m in members], jobs=self.jobs, done=lambda p: self.progress("first fits", p)
        )
        scales = {}
        for m, (state, loss) in zip(members, answers):
            m.loss = loss
            scales.setdefault(m.subject, []).append(state.scale)
            m.state = state
        # The scans of a subject have one scale. Where it is near 1, people differ in size: the template takes it up, all bones
        # longer and thicker by that share. Otherwise it is the unit.
        for subject in self.collection.subjects:
            scale = float(np.median(scales[subject])) if self.fit_settings.scale == "estimate" else 1.0
            size, unit = (scale, 1.0) if 1 / _SIZE < scale < _SIZE else (1.0, scale)
            c = np.zeros(self.shifting.n_coefficients)
            c[: self.model.n_coefficients] = size - 1.0
            self.coefficients[subject] = c
            for m in self.collection.of(subject):
                m.use_unit(m.unit * unit, half)
                # Templates grow about the root joint, scales about the origin: the root joint stays where it was found.
                moved = (m.state.scale / unit - 1.0) * self.model.rig.joints[self.rig.root]
                m.state = m.state.replace(scale=1.0, translation=m.state.translation / unit + moved, residual=None)

    def _templates(self):
        """Each subject's template from its scans' poses, those left out not counted."""
        tasks, subjects = [], self.collection.subjects
        for subject in subjects:
            learning = [m for m in self.collection.of(subject) if not m.held_out] or self.collection.of(subject)
            c = self.coefficients[subject]
            tasks.append(
                (
                    [m.problem for m in learning],
                    [m.state.replace(coefficients=c, residual=None) for m in learning],
                    np.array([m.loss for m in learning]),
                    [m.proba for m in learning] if self.variant.labels else None,
                )
            )
        found = each(_Template(self.shifting), tasks, jobs=self.jobs, done=lambda p: self.progress("templates", p))
        weld = self.rig.weld
        templates = {s: (np.ascontiguousarray(U[weld]), J) for s, (U, J, _) in zip(subjects, found)}
        self.coefficients = {s: c for s, (_, _, c) in zip(subjects, found)}
        return templates

    def _mixture(self, k, templates):
        v, rig = self.variant, self.rig.welded
        learning = [m for m in self.collection.members if not m.held_out]
        poses = np.array([m.state.theta for m in learning]) if v.inferred_poses and k else np.empty((0, *rig.lower.shape))
        rows = np.unique(self.rig.weld, return_index=True)[1]
        made = tuple((U[rows], J) for U, J in templates.values()) if v.deformed and k else ()
        return Mixture(rig, self.synthesis, poses, made, self.seed, k)

    def _library(self, k, templates=None):
        mixture = self._mixture(k, templates or {})
        work, n = _Look(mixture, self.model.half), self.settings.library_scans
        found = each(work, range(n), jobs=self.jobs, done=lambda p: self.progress("library of starts", p))
        looks, poses = zip(*found, strict=True)
        return build_library(np.array(looks), np.array(poses), random_state=self.seed)

    def _learn(self, k, templates):
        """Train s on the round's mixture, and f and the library anew."""
        if self.variant.labels:
            self.segmenter = train_segmenter(
                self.rig.welded,
                self._mixture(k, templates),
                self.settings.round_scans,
                training=self.settings.training,
                random_state=self.seed,
                n_jobs=self.jobs,
                progress=lambda p: self.progress("segmenter", p),
                start=self.segmenter,
            )
            self._label()
        self.library = self._library(k, templates)

    def _label(self):
        if self.variant.labels:
            work = _Label(self.segmenter)
            members = self.collection.members
            tasks = [(m.points[m.rows], m.unit) for m in members]
            found = each(work, tasks, jobs=self.jobs, done=lambda p: self.progress("labels", p))
            for m, proba in zip(members, found):
                m.proba = proba

    def _refit(self, templates):
        """Every pose again on its subject's template; returns how many new starts won."""
        members = self.collection.members
        work = _Refit(self._models(templates), self.library, self.settings.neighbours if self.variant.library else 0)
        tasks = [(m.subject, m.problem, m.state, self._beside(m), m.proba if self.variant.labels else None) for m in members]
        answers = each(work, tasks, jobs=self.jobs, done=lambda p: self.progress("poses of scans", p))
        won = 0
        for m, (state, loss, which) in zip(members, answers):
            won += which > 0
            m.loss = loss
            m.state = state
        return won

    def _smooth(self, templates):
        """A few sweeps that draw each pose towards the mean of its neighbours' and its own, as the sweep before left them."""
        models = self._models(templates)
        for _ in range(_SWEEPS):
            members = [m for m in self.collection.members if self._beside(m)]
            for m in members:
                beside = [_alike(theta, m.state.theta, self.rig.root) for theta in self._beside(m)]
                m.prior = np.mean([m.state.theta, *beside], axis=0), self.smooth  # without its own, neighbours would swap places
            tasks = [(m.subject, m.problem, m.state, m.prior) for m in members]
            states = each(_Drawn(models), tasks, jobs=self.jobs, done=lambda p: self.progress("smoothing", p))
            for m, state in zip(members, states):
                m.state = state

    def _models(self, templates):
        return {s: Model(self.rig.with_template(*t), self.joints, half=self.model.half) for s, t in templates.items()}

    def _beside(self, member):
        """Poses of the scans before and after, in a sequence."""
        if not self.sequence:
            return []
        row = self.collection.of(member.subject)
        at = row.index(member)
        return [row[k].state.theta for k in (at - 1, at + 1) if 0 <= k < len(row)]

    def _units(self):
        return {s: self.collection.of(s)[0].unit for s in self.collection.subjects}

    def _note(self, k, began, more):
        """One more entry of the history; the value that decides when to stop."""
        held = [m.loss for m in self.collection.members if m.held_out]
        learning = [m.loss for m in self.collection.members if not m.held_out]
        entry = {
            "round": k,
            "recon": float(np.sqrt(np.mean(learning))),
            "recon_held_out": float(np.sqrt(np.mean(held))) if held else None,
            "seconds": round(time.perf_counter() - began, 2),
            **more,
        }
        self.history.append(entry)
        self.progress("round", 1.0, entry)
        return float(np.mean(np.sqrt(held))) if held else -float(k)


# ---- what is done for one task, here or in another process ----


@dataclass(frozen=True)
class _FirstFit:
    model: Model
    settings: object
    labels: bool
    library: object

    def __call__(self, task):
        problem, proba = task
        if self.labels:
            state = prepare_pose(self.model, problem, proba, self.settings)
            return state, problem.evaluate(self.model.coarse, state, _plain()).value
        free = ("pose", "translation") if self.settings.scale == "fixed" else ("pose", "translation", "scale")
        poses = [self.model.rest().theta, self.library.regress(problem.X)]
        state, loss, _ = Refit(self.model, free)(problem, poses=poses)
        return state, loss


@dataclass(frozen=True)
class _Template:
    model: Model

    def __call__(self, task):
        problems, states, losses, proba = task
        return shared_template(self.model, problems, states, losses, proba=proba)


@dataclass(frozen=True)
class _Look:
    mixture: Mixture
    half: float

    def __call__(self, i):
        scan = self.mixture.scan(i)
        return describe_scan(scan.points / self.half), scan.pose


@dataclass(frozen=True)
class _Label:
    segmenter: object

    def __call__(self, task):
        points, unit = task
        return self.segmenter.predict_proba(points, scale=unit)


@dataclass(frozen=True)
class _Refit:
    models: dict
    library: object
    neighbours: int

    def __post_init__(self):
        object.__setattr__(self, "_ready", {})

    def __call__(self, task):
        subject, problem, state, beside, proba = task
        if subject not in self._ready:
            self._ready[subject] = Refit(self.models[subject])
        poses = [*beside, self.library.regress(problem.X)]
        if self.neighbours:
            poses += list(self.library.nearest(problem.X, self.neighbours))
        return self._ready[subject](problem, [state], poses=poses, proba=proba)


@dataclass(frozen=True)
class _Drawn:
    models: dict

    def __call__(self, task):
        subject, problem, state, prior = task
        return Refit(self.models[subject]).polish(problem, state, prior=prior)


def _alike(theta, other, root):
    """The same pose, the root's turn written (it may have whole turns more or fewer) as near as can be to another pose's."""
    angle = np.linalg.norm(theta[root])
    if not angle:
        return theta
    ways = [theta[root] * (1.0 + 2 * np.pi * k / angle) for k in (0, -1, 1, -2, 2)]
    theta = theta.copy()
    theta[root] = min(ways, key=lambda way: np.linalg.norm(way - other[root]))
    return theta


def _plain():
    from ..losses.objective import LossWeights

    return LossWeights(chamfer=1.0, lam=0.0, lam_s=0.0, lam_lap=0.0)
