"""LBSFitter: the estimator. Fits single scans, learns from collections of scans, and fits new scans with what it has learned."""

import warnings

import numpy as np

from ..errors import InputError, brief, check_callables, is_whole
from ..interrupts import held
from ..optimize.model import Model
from ..seeds import integer_seed
from ..segmentation.segmenter import jobs_of
from ..starts.turns import facing_of
from .archive import learned_arrays, read_fitter, write_fitter
from .batch import fit_scans
from .checkpoint import as_checkpoint
from .estimator import Estimator
from .finish import results_of
from .free_form import fit_free_form
from .loop import Learned, Loop, LoopSettings
from .made_with import as_fitted, as_learned
from .new_scan import fit_new, scan_fit
from .parameters import check_learned, check_parameters, check_scan, check_segmenter, fit_settings, learned_with
from .pretraining import is_stale, pretrained, pretrained_from, still_given
from .reading import as_scans, read_collection
from .subjects import known_subject
from .training import training_settings
from .variants import as_variant

__all__ = ["LBSFitter"]


class LBSFitter(Estimator):
    """Fit a rig to point clouds, following scikit-learn's estimator conventions.

    Parameters
    ----------
    rig : Rig
    weights : {"default", "paper"} or LossWeights, default "default"
        Of the objective, which fits are judged by and, with ``registration=False``, are found by; docs/losses.md has more.
    joints : {"follow", "fixed"}, default "follow"
        Whether joints follow the changed template or, as in the paper, stay where the rig has them.
    scale : {"estimate", "fixed"}, default "estimate"
        Whether isotropic scale is found with the pose or is 1: scan and rig are then in one unit or, with ``unit``, of one size.
    unit : {"m", "cm", "mm", "in", "ft"}, optional
        The unit of the scans, where it is known; their size stays free. The rig's unit must be known, too.
    orientation : {"upright", "aligned", "any"}, default "upright"
        How a scan may be turned: about the up axis, not at all (it faces the rig's way, within the root joint's limits), or in
        any way. The turn is found by trying hypotheses; the less is left open, the surer and faster this is.
    up : {"+x", "-x", "+y", "-y", "+z", "-z"}, optional
        The scans' up axis, where it is known; by default the rig's, or another axis where the rig's does not suit a scan.
    partial, cropped : bool, default False
        Whether scans show one side only, as single depth views do, and whether they end before the body does, as where a picture
        ends. Training then uses such scans, and what of the model they cannot show does not pull.
    effort : {"balanced", "fast", "thorough"}, default "balanced"
        How many starts are followed, and how far.
    max_points : int, default 2500
        Number of a scan's points that take part in the optimisation; all points are labelled.
    registration : bool, default True
        Whether the skin is brought onto the scan once the pose is found; else pose and skin are the full objective's.
    training_scans : int, default 4000
        Number of synthetic scans to train the segmenter on. The library of starts has half as many others (``pretrain_library``).
    variant : {"joint", "pose-only", "rand", "cd", "free-form"}, default "joint"
        What :meth:`fit` learns from, as in the paper's ablations. "joint": everything. "pose-only": the segmenter learns from the
        fits' poses but not their templates. "rand": the segmenter learns from uniform poses only. "cd": no labels at all.
        "free-form": no skinning at all; vertices move freely.
    rounds : int, default 4
        Maximum number of rounds of :meth:`fit`.
    held_out : float, default 0.1
        Share of the scans that :meth:`fit` holds out of learning to tell when to stop. With 0, it uses all and does every round.
    sequence : bool, default False
        Whether the scans of each subject are in order of time; each scan then also starts from its neighbours.
    smooth : float, default 0
        With ``sequence``: weight of ‖Θ − Θ⁰‖², where Θ⁰ is the mean of a scan's own and its neighbours' angles, against the
        mean squared distance to the surface in squared half sizes of the rig; 1e-5 is a little, 1e-3 much.
    training : dict, optional
        ``synthesis.Synthesis`` fields for training scans, e.g. ``{"noise": 0.01}``; ``scale`` is 0.05 unless given.
    n_jobs : int, optional
        Number of processes for training and for all methods that take several scans; results do not depend on it.
    random_state : int, Generator or None

    Attributes
    ----------
    segmenter_ : Segmenter or None
        s, set by :meth:`pretrain` or :meth:`fit_scan` and, as learned, by :meth:`fit`; None in variants without labels.
    regressor_ : PoseLibrary or None
        f and the poses it was trained on, in which starts are looked up; set by the same methods, and made anew by :meth:`fit`.
    template_, unit_ : dict of id to Rig, and to float
        Set by :meth:`fit`, like all below: the rig on each subject's own template, and scan units per rig unit. Ids are those
        given to it; 0 if none were.
    learned_unit_ : str or None
        ``unit`` of the scans learned from; new scans may be in another.
    pose_prior_ : PosePrior or None
        How angles vary among the poses learned from; it constrains the angles that a scan leaves open.
    results_ : list of FitResult or None
        The result of each scan; None where the scan could not be used.
    failures_ : dict of int to str
        Why a scan could not be used, by the number of the scan.
    roles_ : list of str or None
        For each scan: "learned from", "held out of learning" or "not learned from"; None where it could not be used.
    history_ : list of dict
        One entry per round, see docs/learning-method.md; L_c of its ``recon`` is of some 2,500 of the vertices at most.
    """

    def __init__(
        self,
        rig,
        *,
        weights="default",
        joints="follow",
        scale="estimate",
        unit=None,
        orientation="upright",
        up=None,
        partial=False,
        cropped=False,
        effort="balanced",
        max_points=2500,
        registration=True,
        training_scans=4000,
        training=None,
        variant="joint",
        rounds=4,
        held_out=0.1,
        sequence=False,
        smooth=0.0,
        n_jobs=None,
        random_state=None,
    ):
        self.rig = rig
        self.weights = weights
        self.joints = joints
        self.scale = scale
        self.unit = unit
        self.orientation = orientation
        self.up = up
        self.partial = partial
        self.cropped = cropped
        self.effort = effort
        self.max_points = max_points
        self.registration = registration
        self.training_scans = training_scans
        self.training = training
        self.variant = variant
        self.rounds = rounds
        self.held_out = held_out
        self.sequence = sequence
        self.smooth = smooth
        self.n_jobs = n_jobs
        self.random_state = random_state

    def pretrain(self, *, segmenter=None, cache=False, progress=None):
        """Train on synthetic scans of the rig (step 1 of Algorithm 1): the segmenter s, and f with the library of starts.

        Poses are uniform within the limits; in half of the scans they are correlated between joints
        (``synthesis.training_poses``). Shapes and scans vary as ``training`` says. Half of the library's poses are natural, if
        the rig has any. A fitter that has learned keeps what it learned; the next :meth:`fit` begins with what is trained here.

        Parameters
        ----------
        segmenter : Segmenter, optional
            Used as s: only f and the library are then trained. Variants without labels have no s; they neither train nor use one.
            With "hand", "hand-left", "body" and "body-coarse" comes an s of the default settings and seed 0, which is not trained
            again.
        cache : bool, default False
            Whether to look in the cache for what was trained, and to add to it.
        progress : callable, optional
            Called with the share done, in [0, 1].

        Returns
        -------
        self
        """
        self._check()
        check_callables(progress=(progress, (("share",),)))
        progress = progress or (lambda share: None)
        labels = as_variant(self.variant).labels
        check_segmenter(segmenter, self.rig)
        made_of = self.rig, self._synthesis(), self.training_scans
        options = {"random_state": self._seed(), "n_jobs": self.n_jobs, "cache": cache and self._repeatable()}
        self._pretrained = pretrained(*made_of, segmenter=segmenter, labels=labels, progress=progress, **options)
        if getattr(self, "template_", None) is None:  # else what was learned stays together until more is
            self.segmenter_, self.regressor_ = self._pretrained
        self._pretrained_of, self._given = pretrained_from(self), segmenter
        return self

    def fit(self, scans, subjects=None, *, cache=False, checkpoint=None, progress=None, on_round=None):
        """Learn from a collection of scans by Algorithm 1 of the paper; see ``learning.loop``.

        Parameters
        ----------
        scans : sequence
            For each scan the (n, 3) points, a Scan, or a callable without arguments that returns one of these. All are in one
            unit and, with ``sequence``, in order of time.
        subjects : sequence of str or int, optional
            Who was scanned: one id for each scan. By default there is one subject. The scans of a subject share a template.
        cache : bool, default False
            As in :meth:`pretrain`.
        checkpoint : path-like or Checkpoint, optional
            Folder in which each step is kept as it is done. After a stop or a crash, the same call goes on from there, to the
            same result. Variants that learn from labels find each other's first fits. A seed is needed; the folder stays.
        progress : callable (stage, share, figures=None), optional
            Called with the name of a step and the share of it done, in [0, 1]; also as each step but pretraining begins. After
            a round it is also given the round's entry of ``history_``.
        on_round : callable (k, segmenter), optional
            Called after round k with s as it then is, for example to find its errors on scans of which more is known.

        Returns
        -------
        self

        Raises
        ------
        InputError
            Before any work: unusable parameters, the wrong number of ids, extents of different units, no usable scan, or too few
            to hold any out. After the first fits: scales of different units within a subject. A single unusable scan is left
            out, with a warning and the reason in ``failures_``.
        KeyboardInterrupt
            On Ctrl-C. What a finished round has learned is then available; ``results_`` holds None for each scan.
        """
        self._check()
        ways = (("stage", "share"), *([("stage", "share", "figures")] if as_variant(self.variant).skinning else []))
        check_callables(progress=(progress, ways), on_round=(on_round, (("k", "s"),)))
        if checkpoint is not None and not self._repeatable():
            got = f"random_state {brief(self.random_state)}, with which a run cannot be repeated"
            raise InputError("checkpoint", got, "a seed", "Pass a seed, such as random_state=0.")
        checkpoint = as_checkpoint(checkpoint)
        variant, seed, facing = as_variant(self.variant), self._seed(), facing_of(self.rig, self.orientation, self.up)
        known = {"scale": self.scale, "unit": self.unit, "ups": facing.floors, "max_points": self.max_points}
        settings, jobs = fit_settings(self), jobs_of(self.n_jobs, None)
        known |= {"held_out": self.held_out if variant.skinning else 0.0, "cropped": settings.cropped, "random_state": seed}
        collection = read_collection(self.rig, scans, subjects, **known)
        collection.warn(stacklevel=2)
        progress = progress or (lambda stage, share, figures=None: None)
        if not variant.skinning:
            units = {s: collection.of(s)[0].unit for s in collection.subjects}
            kept = checkpoint.narrowed(self._made_of(seed))
            results = fit_free_form(self._model(), collection, settings, jobs=jobs, progress=progress, checkpoint=kept)
            units = {s: units[s] for s in collection.subjects}  # of others no scan could be fitted
            nothing = {"segmenter": None, "library": None, "pose_prior": None, "history": []}
            self._take(Learned(dict.fromkeys(units), units, **nothing), collection)
            return self._finished(collection, results)
        segmenter, library = getattr(self, "_pretrained", None) or (None, None)
        if library is None or (variant.labels and segmenter is None) or is_stale(self):
            again = {"segmenter": still_given(self), "progress": lambda p: progress("pretraining", p)}
            segmenter, library = self.pretrain(cache=cache, **again)._pretrained
        segmenter = segmenter if variant.labels else None
        check_segmenter(segmenter, self.rig)
        checkpoint = checkpoint.narrowed(self._made_of(seed, segmenter, library))
        loop = Loop(
            *(self.rig, collection, variant, segmenter, library),
            facing=facing,
            fit_settings=settings,
            settings=LoopSettings.for_training(self.training_scans, rounds=int(self.rounds)),
            synthesis=self._synthesis(),
            joints=self.joints,
            sequence=self.sequence,
            smooth=self.smooth,
            jobs=jobs,
            random_state=seed,
            progress=progress,
            on_round=on_round,
            on_kept=lambda learned: self._take(learned, collection),
            checkpoint=checkpoint,
        )
        self._take(loop.run(), collection)
        made_of = self.rig, self.template_, self.joints, collection, settings, facing, self.pose_prior_
        how = {"other_limbs": variant.library, "jobs": jobs, "progress": progress, "checkpoint": checkpoint}
        return self._finished(collection, results_of(*made_of, **how))

    def _made_of(self, seed, segmenter=None, library=None):
        """What all steps of learning depend on; what only some do, the scans among it, comes with these."""
        some = ("rig", "n_jobs", "variant", "rounds", "held_out", "sequence", "smooth", "random_state", "training")
        parameters = {name: value for name, value in self._all_params().items() if name not in some}
        pretrained = learned_arrays(segmenter, library)
        return self.rig.digest, self.rig, parameters, self._synthesis(), seed, pretrained  # the first knows the parts' order

    def _take(self, learned, collection):
        """Have what was learned, as yet without results: what a round has learned stays where a later one is stopped."""
        templates = {s: self.rig if t is None else self.rig.with_template(*t) for s, t in learned.templates.items()}
        with held():  # all of it, or nothing
            self.segmenter_, self.regressor_, self.pose_prior_ = learned.segmenter, learned.library, learned.pose_prior
            self.template_, self.unit_, self.history_ = templates, learned.units, learned.history
            self._learned_with, self.learned_unit_ = learned_with(self), fit_settings(self).unit
            self.results_, self.failures_, self.roles_ = [None] * collection.n, dict(collection.failures), collection.roles

    def _finished(self, collection, results):
        self.results_ = as_learned(self, collection, results)
        self.failures_, self.roles_ = dict(collection.failures), collection.roles
        collection.warn(stacklevel=3, results=results)
        return self

    def transform(self, scans, subjects=None):
        """Fit scans with what was learned, and return their registered vertices.

        Parameters
        ----------
        scans
            As in :meth:`fit`.
        subjects : sequence of str, int or None, optional
            Whose template to use for each scan, by id or its text; with None, the default for all, the one that explains it best.

        Returns
        -------
        (N, m, 3) array
            In each scan's frame and unit; NaN where a scan could not be fitted, with a warning.
        """
        results = self._fit_all(scans, subjects)
        shape = self.rig.vertices.shape
        return np.array([np.full(shape, np.nan) if r is None else r.vertices for r in results]).reshape(-1, *shape)

    def score(self, scans, subjects=None):
        """Minus the mean of √L_c over scans fitted with what was learned, in half sizes of the rig; NaN if none can be fitted."""
        self._check_learned()
        if not (scans := as_scans(scans)):
            raise InputError("scans", "none", "one or more scans")
        results = [r for r in self._fit_all(scans, subjects) if r is not None]
        if not results:
            warnings.warn("the score is NaN: no scan could be fitted", stacklevel=2)
        return -float(np.mean([r.terms["recon"] for r in results])) if results else float("nan")

    def save(self, path):
        """Write what was learned and the rig as one NPZ without pickle; :meth:`load` and ``lbsfit fit`` read it."""
        self._check_learned()
        write_fitter(self, path)

    @classmethod
    def load(cls, path):
        """Read what :meth:`save` wrote; ``results_`` is not part of it.

        Returns
        -------
        LBSFitter
        """

        def make(rig, parameters, fields):
            settled = {name: parameters.pop(name) for name in cls._settled() & {*parameters}}
            fitter = cls(rig, **parameters)
            vars(fitter).update(settled | fields)
            fitter._learned_with = learned_with(fitter)
            fitter._check()
            return fitter

        return read_fitter(path, make)

    def fit_scan(self, points, *, subject=None, theta0=None, labels=None, point_weights=None):
        """Fit one scan: with the learned templates after :meth:`fit`, else by itself.

        A fit by itself pretrains first, unless that has been done or labels are given.

        Parameters
        ----------
        points : (n, 3) array or Scan
            In any unit that ``scale`` allows.
        subject : str or int, optional
            After :meth:`fit`: whose template to use, by id or its text. By default it is the one that explains the scan best.
        theta0 : (J, 3) array, optional
            A known start, radians.
        labels : (n,) int array, optional
            Known parts of the points, as indices into ``rig.parts``; −1 where the part is not known.
        point_weights : (n,) array, optional
            Non-negative; 0 leaves a point out of the fit.

        Returns
        -------
        FitResult
        """
        return self._fit_scan(points, theta0, labels, point_weights, subject=subject)

    def _fit_scan(self, points, theta0, labels, point_weights, *, subject=None, cache=False, progress=None):
        """:meth:`fit_scan`, with the cache of segmenters where asked; all is checked before anything is trained."""
        self._check()
        check_callables(progress=(progress, (("share",),)))
        rig = self.rig
        points, theta0, labels, point_weights = check_scan(rig, self.variant, points, theta0, labels, point_weights)
        learned = getattr(self, "template_", None)
        if subject is not None:
            subject = known_subject(learned, subject)
        if learned is not None:
            self._check_learned()
        if learned is not None or not as_variant(self.variant).skinning:
            subjects = None if learned is None else list(learned) if subject is None else [subject]
            found = fit_new(self, points, subjects, theta0, labels, point_weights, anyone=subject is None)
            return as_fitted(self, found, subject=subject)
        trained = {}
        if labels is None:
            if not self._is_pretrained():
                self._check_alone(points, point_weights)
                self._pretrain_alone(cache=cache, progress=progress)
            segmenter = self.segmenter_ if as_variant(self.variant).labels else None
            check_segmenter(segmenter, rig)
            trained = {"segmenter": segmenter, "library": self.regressor_}
        fit = scan_fit(self, **trained).fit
        found = fit(points, theta0=theta0, labels=labels, point_weights=point_weights, random_state=self.random_state)
        return as_fitted(self, found)

    def _check_alone(self, points, point_weights=None):
        """Raise InputError, before anything is trained, where the fit of a scan by itself would."""
        seed = 0 if isinstance(self.random_state, np.random.Generator) else self.random_state  # which drawing would advance
        fit = scan_fit(self)
        fit.taking_part(points, point_weights, seed, ups=fit.facing.floors)

    def _pretrain_alone(self, **options):
        """Pretrain with the segmenter that is there, unless it was trained with other parameters, or was given once."""
        there = None if is_stale(self) else getattr(self, "segmenter_", None)
        self.pretrain(segmenter=still_given(self) if there is None else there, **options)

    def _is_pretrained(self):
        """Whether there is all that fits of scans by themselves need."""
        wanted = ("regressor_", "segmenter_") if as_variant(self.variant).labels else ("regressor_",)
        return all(getattr(self, name, None) is not None for name in wanted) and not is_stale(self)

    def _fit_all(self, scans, subjects):
        self._check_learned()
        outcomes = fit_scans(self, scans, subjects=subjects, n_jobs=jobs_of(self.n_jobs, self.random_state))
        for outcome in outcomes:
            if outcome.error is not None:
                warnings.warn(f"scan {outcome.index} cannot be fitted: {outcome.error}", stacklevel=3)
        return [outcome.result for outcome in outcomes]

    def _check_learned(self):
        self._check()
        check_learned(self)

    def _synthesis(self):
        return training_settings(self.training, partial=self.partial, cropped=self.cropped)

    def _repeatable(self):
        """Whether the same seed comes again: nothing that another one decides is kept in the cache."""
        return is_whole(self.random_state)

    def _seed(self):
        """One whole number for all that is random; a Generator or None gives another one each time."""
        return self.random_state if self._repeatable() else integer_seed(self.random_state, "fitter")

    def _model(self):
        """The rig made ready, kept until ``rig`` or ``joints`` change."""
        kept = self.__dict__.get("_ready")
        if kept is None or kept[0] is not self.rig or kept[1] != self.joints:
            self._ready = kept = self.rig, self.joints, Model(self.rig, self.joints)
        return kept[2]

    def __sklearn_is_fitted__(self):  # not by the first training alone, which leaves attributes, too
        return getattr(self, "template_", None) is not None

    def _check(self):
        check_parameters(self)
        self._synthesis()

    def __getstate__(self):  # pickles and copies are without what was made ready for fits, which is large and soon made again
        return {k: v for k, v in vars(self).items() if k not in ("_ready", "_prepared")}
