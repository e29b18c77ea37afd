"""The rows of the study: each a way of registering scans, from the free-form baselines to the whole loop and the oracle."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ...errors import LbsfitError, in_words
from ...learning.archive import model_digest
from ...learning.checkpoint import NO_CHECKPOINT, Checkpoint, each_kept
from ...learning.variants import as_variant
from ...workers import ProcessEnded, each
from ..templates import learned_templates, template_gap, templates_of
from .data import study_set
from .free_form import Augmented, FromTemplate, taught
from .measures import Registrations
from .oracle import OracleFit

__all__ = ["FIRST_FITS", "LIBRARY", "PRETRAINING", "ROWS", "Context", "Found", "Row", "said"]

# How long these take, as the weights of rows: the training scans' fits by themselves, of which the first row that learns from
# labels is taken to be as long as the others, and pretraining, which is no part of a row; without s it is the library alone.
FIRST_FITS = 6.0
PRETRAINING = 12.0
LIBRARY = 1.0

# Test scans that the figure of the steps of skinning chooses from.
_STAGES = 60


@dataclass(frozen=True)
class Row:
    """One row of the study's table.

    Attributes
    ----------
    what : str
        In words.
    paper : str or None
        The name of the paper's row that it plays the part of.
    find : callable (Context) → Found
    pretrained : bool, default True
        Whether it needs what the fitter is pretrained with.
    in_common : bool, default False
        Whether its training scans' fits by themselves are those of other rows, too.
    goes_on_from : str or None, default None
        Another row, whose fits it takes up where both are made by one process.
    weight : float, default 1.0
        How long it takes, roughly, beside others.
    """

    what: str
    paper: str | None
    find: Callable
    pretrained: bool = True
    in_common: bool = False
    goes_on_from: str | None = None
    weight: float = 1.0


@dataclass(frozen=True)
class Found:
    """What a row found.

    Attributes
    ----------
    test : Registrations
        Of the scans held out.
    train : Registrations or None
        Of the training scans, where the paper has that figure, too.
    labels : list of (n,) int arrays or None
        What the row's segmenter alone says of the test scans' points.
    fitted_labels : list of (n,) int arrays or None
        What its fits say of them; None each where there is no fit.
    accuracy : list of float
        Of the segmenter on the test scans, before learning and after each round.
    kept_accuracy : float or None
        Of the one that was kept in the end.
    gap : dict
        Of the subjects' templates, and of the test scans', ``templates.template_gap``.
    history : list of dict
        Of the loop.
    stages : dict of str to (k, m, 3) arrays
        Of the first fits of joint, for a figure: "template" U^d, "posed" V = M(Θ, U).
    failures : dict of int to str
        Why, by the number of the test scan that could not be fitted.
    before : dict of int to str
        The same of the fits that the row builds on, of scans to learn from or of other starts.
    """

    test: Registrations
    train: Registrations | None = None
    labels: list | None = None
    fitted_labels: list | None = None
    accuracy: list = field(default_factory=list)
    kept_accuracy: float | None = None
    gap: dict = field(default_factory=dict)
    history: list = field(default_factory=list)
    stages: dict = field(default_factory=dict)
    failures: dict = field(default_factory=dict)
    before: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Context:
    """What rows work with.

    Attributes
    ----------
    source : Rig
        With all its poses, of which ``given.rig`` has those of training.
    given : StudySet
    size : Size
    seed : int
        Of the scans.
    fitter : LBSFitter
        Pretrained, where one of the rows asked for needs that.
    labels_before : callable () → list of (n,) int arrays
        What the segmenter says of the test scans' points before learning.
    right : callable (labels) → float
        Share of these points that such labels put into the right group of parts.
    jobs : int
    progress : callable (share)
    steps : Path or None, default None
        A folder that what takes long is kept in step by step, as by ``LBSFitter.fit(checkpoint=)``.
    first_fits : Path or None, default None
        Another one, for the training scans' fits by themselves, which rows that learn from labels have in common.
    first_fitted : callable (), optional
        Called when these are there.
    took : dict of int to float
        Seconds that test scans took in the last row that learned here, by their numbers: the longest go first, lest all wait.
    from_template : list
        Empty until fits without skinning that start from the template are made of the test scans, which two rows need.
    """

    source: object
    given: object
    size: object
    seed: int
    fitter: object
    labels_before: Callable
    right: Callable
    jobs: int
    progress: Callable
    steps: object = None
    first_fits: object = None
    first_fitted: Callable = lambda: None
    took: dict = field(default_factory=dict)
    from_template: list = field(default_factory=list)


# ---- baselines without skinning ----


def _from_template(c):
    results, failures = _on_template(c)
    return Found(_registrations(c.given.rig, results), failures=failures)


def _augmented(c):
    starts, failures = _on_template(c, 0.25)
    tasks = list(zip(_points(c.given.test), starts, strict=True))
    return replace(_free_form(c, Augmented(c.given.rig, c.fitter.regressor_), tasks, start=0.25), before=failures)


def _on_template(c, end=1.0):
    """What ``_tried`` says of fits that start from the template, made once for the rows that need them."""
    if not c.from_template:
        work, points = FromTemplate(c.given.rig), _points(c.given.test)
        c.from_template.extend(_tried(c, work, points, lambda p: c.progress(end * p)))
    return c.from_template


def _supervised(c, times=1):
    scans = c.given.train if times == 1 else study_set(c.source, c.size, c.seed, times=times).train
    fit = taught(c.given.rig, scans, c.fitter.random_state)
    found = _free_form(c, fit, _points(c.given.test), end=0.5 if times == 1 else 1.0)
    if times > 1:
        return found
    train = _free_form(c, fit, _points(c.given.train), start=0.5)
    return replace(found, train=train.test, before=train.failures)


def _free_form(c, fit, tasks, start=0.0, end=1.0):
    results, failures = _tried(c, fit, tasks, lambda p: c.progress((1 - p) * start + p * end))
    return Found(_registrations(c.given.rig, results), failures=failures)


def _points(scans):
    return [s.points for s in scans]


# ---- the loop and its ablations ----

# Where stages of learning begin and end, roughly, as shares of a round's time with labels; first fits, and the results at the
# end, count as a round each.
_OF_A_ROUND = {
    "first fits": (0.0, 1.0),
    "results": (0.0, 1.0),
    "templates": (0.0, 0.04),
    "segmenter": (0.04, 0.44),
    "library of starts": (0.44, 0.48),
    "labels": (0.48, 0.52),
    "poses of scans": (0.52, 0.8),
    "templates and poses in turn": (0.8, 1.0),
}


def _learned(c, variant):
    from sklearn.base import clone

    from ...learning.pretraining import share_pretraining

    given, heard = c.given, []  # what the segmenter says of the test scans, before learning and after each round
    fitter = clone(c.fitter).set_params(variant=variant)
    share_pretraining(c.fitter, fitter)
    labels = as_variant(variant).labels

    def watch(k, segmenter):
        if labels:
            heard.append(said(segmenter, given.test, c.jobs))

    done, last = 0, fitter.rounds + 1  # rounds, the first fits as one

    def progress(stage, share, figures=None):
        nonlocal done
        if figures is not None:
            done, share = figures["round"] + 1, 0.0
            if labels and done == 1:
                c.first_fitted()
        if stage == "results":
            done = last  # with fewer rounds, too
        begin, end = _OF_A_ROUND.get(stage, (0.0, 0.0))
        c.progress(0.8 * ((done + (1 - share) * begin + share * end) / (last + 1)))  # exact at both ends: the next goes on there

    if labels:
        heard.append(c.labels_before())
    checkpoint = None if c.steps is None else Checkpoint(c.steps, first_fits=c.first_fits if labels else None)
    if labels and c.steps is not None:
        c.steps.mkdir(parents=True, exist_ok=True)  # says that the row is begun, as long as only first fits are there
    fitter.fit(_points(given.train), given.train_subjects, checkpoint=checkpoint, progress=progress, on_round=watch)
    points, kept = _points(given.test), NO_CHECKPOINT if c.steps is None else Checkpoint(c.steps, model_digest(fitter))
    results, failures = _tried(c, fitter.fit_scan, points, lambda p: c.progress(0.8 + 0.2 * p), kept, c.took)
    rig = given.rig
    learned = learned_templates(fitter)
    gap = {"subjects": template_gap(rig, list(learned.values()), [given.train.templates[k][0] for k in learned])}
    own = [(r, k) for r, k in zip(results, given.test_subjects) if r is not None]
    if own:
        true = [given.test.templates[k][0] for _, k in own]
        gap["test scans"] = template_gap(rig, templates_of(rig, [r for r, _ in own]), true)
    train = _registrations(rig, fitter.results_) if variant == "joint" else None
    accuracy = [c.right(s) for s in heard]
    as_kept, kept_accuracy = None, None
    if labels:  # of the round whose segmenter the fitter has
        kept = next(entry["round"] for entry in fitter.history_ if entry["kept"])
        as_kept, kept_accuracy = heard[kept], accuracy[kept]
    stages = _stages(rig, results[:_STAGES]) if variant == "joint" else {}
    told = as_kept, _labels(results), accuracy, kept_accuracy
    return Found(_registrations(rig, results), train, *told, gap, fitter.history_, stages, failures, fitter.failures_)


def said(segmenter, scans, jobs):
    """The labels of scans by the segmenter alone."""
    return each(segmenter.predict, _points(scans), jobs=jobs)


def _stages(rig, results):
    nothing = np.full(rig.vertices.shape, np.nan)
    template = [nothing if r is None else rig.vertices + r.offsets for r in results]
    posed = [nothing if r is None else rig.pose(r.pose, r.translation, r.scale) for r in results]
    return {"template": np.array(template), "posed": np.array(posed)}


# ---- oracles ----


def _oracle_labels(c):
    results, failures = _tried(c, _Labelled(c.fitter), [(s.points, s.labels) for s in c.given.test], c.progress)
    return Found(_registrations(c.given.rig, results), failures=failures)


@dataclass(frozen=True)
class _Labelled:
    fitter: object

    def __call__(self, task):
        points, labels = task
        return self.fitter.fit_scan(points, labels=labels)


def _oracle_fit(c):
    results, failures = _tried(c, OracleFit(c.given.rig), c.given.test, c.progress)
    return Found(_registrations(c.given.rig, results), failures=failures)


# ---- registrations ----


def _tried(c, work, tasks, done, kept=NO_CHECKPOINT, took=None):
    """What work makes of each task, None where it cannot; and why, by number. The checkpoint depends on the work."""
    took = {} if took is None else took
    order = sorted(range(len(tasks)), key=lambda i: -took.get(i, 0.0))
    slots = [kept.slot("result", tasks[i]) for i in order] if kept is not NO_CHECKPOINT else []
    how = {
        "keep": lambda tried: tried[-1] is None,  # what nobody foresaw may be mended
        "failed": lambda error: (None, _lost(error), 0.0, error),
    }
    answers = each_kept(_Tried(work), [tasks[i] for i in order], slots, jobs=c.jobs, done=done, **how)
    found = dict(sorted(zip(order, answers, strict=True), key=lambda pair: pair[0]))
    took.update({i: seconds for i, (_, _, seconds, _) in found.items()})
    unforeseen = [error for *_, error in found.values() if error is not None]
    if unforeseen and len(unforeseen) == len(found):
        raise unforeseen[0]  # it is not the scans
    return [answer for answer, *_ in found.values()], {i: why for i, (_, why, *_) in found.items() if why is not None}


@dataclass(frozen=True)
class _Tried:
    """task → (what the work makes of it, None, seconds, None), or (None, why it cannot, seconds, the error if it is not ours)."""

    work: object

    def __call__(self, task):
        started, answer, why, unforeseen = time.perf_counter(), None, None, None
        try:
            answer = self.work(task)
        except LbsfitError as error:
            why = str(error)
        except Exception as error:  # noqa: BLE001 (whatever is wrong with one scan is that scan's failure)
            why, unforeseen = in_words(error), error
        return answer, why, time.perf_counter() - started, unforeseen


def _lost(error):
    """Why a task has no answer at all, as ``_Tried`` lets no error pass."""
    return error.of_its_scan if isinstance(error, ProcessEnded) else in_words(error)


def _labels(results):
    return [None if r is None else r.labels for r in results]


def _registrations(rig, results):
    """Of what has vertices and joints, or is None."""
    nothing = np.full(rig.vertices.shape, np.nan), np.full(rig.joints.shape, np.nan)
    both = [nothing if r is None else (r.vertices, r.joints) for r in results]
    return Registrations([V for V, _ in both], [joints for _, joints in both])


ROWS = {
    "free-form": Row("no skinning, from the template", "free-form, unsupervised", _from_template, False),
    "free-form-augmented": Row(
        "no skinning, from the best of the template and of synthetic scans that look alike",
        "free-form, augmented",
        _augmented,
        goes_on_from="free-form",
        weight=2.0,
    ),
    "free-form-supervised": Row("no skinning, true correspondences in training", "free-form, supervised", _supervised, False),
    "free-form-supervised-3x": Row(
        "the same with three times the training scans",
        "free-form, supervised, three times the data",
        lambda c: _supervised(c, 3),
        False,
    ),
    "cd": Row("Chamfer alone: no labels, no library of poses", "LBS-AE_CD", lambda c: _learned(c, "cd"), weight=8.0),
    "rand": Row("segmenter from uniform poses only", "LBS-AE_RAND", lambda c: _learned(c, "rand"), in_common=True, weight=30.0),
    "pose-only": Row(
        "the whole loop, except that the segmenter does not learn from templates",
        None,
        lambda c: _learned(c, "pose-only"),
        in_common=True,
        weight=30.0,
    ),
    "joint": Row("the whole loop", "LBS-AE", lambda c: _learned(c, "joint"), in_common=True, weight=30.0),
    "oracle-labels": Row("true labels given, starts from these alone, scans one by one", None, _oracle_labels, False),
    "oracle-fit": Row("true correspondences given, scans one by one", None, _oracle_fit, False),
}
