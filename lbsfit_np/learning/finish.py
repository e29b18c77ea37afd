"""From what was learned to results: the scans of the collection, and new ones."""

import time
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from ..errors import InputError
from ..fitting.confidence import SOMEBODY_ELSE
from ..fitting.drawn import drawn_by_itself, prior_of
from ..fitting.scan_fit import (
    FitSettings,
    ScanFit,
    all_points,
    further_words,
    given_names,
    given_views,
    shares,
    stands_words,
    with_floor_or_without,
)
from ..fitting.scout import Found, Scout
from ..fitting.template_fit import TemplateFit
from ..optimize.frame import Frame
from ..optimize.model import Model
from ..optimize.problem import Problem
from ..seeds import generator
from ..starts.clean import taking_part
from ..starts.scale import same_size, unit_note
from ..starts.turns import facing_of
from ..threads import one_thread
from .checkpoint import NO_CHECKPOINT
from .collection import with_doubt
from .free_form import free_form
from .parameters import fit_settings
from .tasks import in_full
from .variants import as_variant

__all__ = ["fit_new", "results_of", "scan_fit"]

# What is looked for where the unit is known, and where it is not.
_IN_UNIT, _SIZED = ("pose", "translation"), ("pose", "translation", "scale")
# Share of the time that is taken by the scales of scans whose subject has one in doubt.
_SIZES = 0.2


def results_of(rig, templates, joints, collection, settings, facing, prior, *, jobs, progress, checkpoint=NO_CHECKPOINT):
    """The results of the scans that the loop has left poses of; those that the checkpoint has are not made again.

    Returns
    -------
    list of FitResult or None
        One for each scan given.
    """
    half = rig.size / 2
    models = {s: Model(t, joints, half=half, shared=True) for s, t in templates.items()}
    doubted, share = {m.subject for m in collection.members if m.own is not None}, 0.0
    sizes = [None] * len(collection.members)
    if doubted:
        share = _SIZES
        work = _Sizes(rig, models, settings, doubted)
        done = {"jobs": jobs, "done": lambda p: progress("results", share * p)}
        sizes = collection.work(work, collection.members, **done, taught=True)
    tasks = list(zip(collection.members, sizes, _others(collection.members, sizes), strict=True))
    further = further_words(settings, facing)
    kept = []
    for m, size, others in tasks:
        on = templates[m.subject]
        kept.append(checkpoint.slot("result", (m, size, others, on.vertices, on.joints, further, prior)))
    work = _Finish(rig, models, settings, further, prior)
    done = {"jobs": jobs, "done": lambda p: progress("results", share + (1 - share) * p)}
    return collection.in_order(collection.work(work, tasks, **done, kept=kept, taught=True))


def _others(members, sizes):
    """For each, the median of the scales that its subject's others have; as the template has them, where there is no other.

    Scans that are set apart are nobody's others: of three, one would shift the median of the two that are right.
    """
    scales = {}
    for m, size in zip(members, sizes):
        scales.setdefault(m.subject, {}).update({} if size is None or m.apart else {m.index: size.scale})
    others = [[scale for i, scale in scales[m.subject].items() if i != m.index] for m in members]
    return [float(np.median(found)) if found else m.unit for m, found in zip(members, others)]


@dataclass(frozen=True)
class _Size:
    """A scan on its subject's template.

    Attributes
    ----------
    scale : float
        Scan units in a rig unit, scale free.
    state : State
        In its subject's unit.
    own : State or None
        From its first fit, in the unit found by that and with scale free, if this explains the scan better.
    """

    scale: float
    state: object
    own: object = None


@dataclass(frozen=True)
class _OnTemplates:
    rig: object
    models: dict
    settings: object

    @cached_property
    def _fit(self):
        return cache(lambda subject: TemplateFit(self.rig, self.models[subject], self.settings))  # once in each process


@dataclass(frozen=True)
class _Sizes(_OnTemplates):
    """Scan → its _Size, or None where nobody's scale of its subject is in doubt."""

    doubted: set

    def __call__(self, m):
        return _size(m, self._fit(m.subject)) if m.subject in self.doubted else None


@dataclass(frozen=True)
class _Finish(_OnTemplates):
    """(Scan, its _Size or None, its others' scale) → its result."""

    further: tuple
    prior: object

    def __call__(self, task):
        m, size, others = task
        fit = self._fit(m.subject)
        if m.own is not None:
            m = _in_its_unit(m, fit, size, others)
        free = _SIZED if size is not None and m.state is size.own else _IN_UNIT
        unit = unit_note(m.state.scale * m.unit, self.rig, self.settings.scale)
        place = {"points": m.points, "rows": m.rows, "frame": m.frame, "free": free}
        problem = m.problem
        proportions = fit.proportions(problem, m.state)
        further = () if proportions > SOMEBODY_ELSE else self.further  # it is not more effort that would help
        place |= {"proportions": proportions, "further": further}
        place |= {"notes": [m.role, m.left_out], "found": (unit,)}
        place["dense"] = m.every, Problem(m.dense_X) if len(m.more) else problem
        place["prior"] = prior_of(self.prior, m.noise, fit.refit.turning, m.prior)
        result = fit.finish(problem, m.state, proba=in_full(m.proba), **place)
        if m.own is None and result.status == "ok":  # then only first fits were wrong
            m = replace(m, doubt="")
        return with_doubt(m, replace(result, subject=str(m.subject)))


def _size(m, fit):
    """The _Size of a scan: from its first fit, too, where that had another."""
    anew, problem, state = fit.refit.freeing(_SIZED), m.problem, m.state
    if m.own is not None:
        own = _as_first_fitted(m, fit)
        state, value, _ = fit.refit(problem, [m.state], proba=in_full(m.proba))
        free, free_value, _ = anew(own.problem, poses=[m.own[1]], proba=in_full(own.proba))
        if free_value * own.frame.unit**2 < value * m.frame.unit**2:  # values go by the square of the frame's unit
            return _Size(free.scale * own.unit, state, free)
    return _Size(anew.polish(problem, state).scale * m.unit, state)


def _as_first_fitted(m, fit):
    """The scan in the unit, and with the parts, that its first fit found."""
    unit, _, proba = m.own
    own = replace(m, proba=proba)
    own.use_frame(unit, fit.model.half)
    return own


def _in_its_unit(m, fit, size, others):
    """A scan in its subject's unit, or in its own where that explains it better, which makes doubts of it.

    A first fit that was wrong says nothing of a scan's size, nor does the template, in which the scan has taken part: its
    subject's others have a scale on that, too. Where they have the same, ``own`` is None in what comes back.
    """
    if same_size(size.scale, others) and not m.apart:  # scale is free in its own fit alone, which may win by that
        return replace(m, state=size.state, own=None)
    if size.own is None:
        return replace(m, state=size.state)
    words = f"it has {size.scale / others:.3g} times the scale of its subject's others: in another unit"
    doubt = m.doubt or f"{words}, or somebody else's?"
    if m.apart and not same_size(size.scale, others):  # nearer to the truth than the first fit's, which its doubt has so far
        doubt = f"{words}? Convert it and learn again"
    # Neighbours' poses were found in the subject's unit, and what its points tell.
    return replace(_as_first_fitted(m, fit), state=size.own, doubt=doubt, prior=None, noise=0.0)


def fit_new(fitter, points, subjects, theta0, labels, point_weights, *, anyone=True):
    """A new scan on the learned templates of ``subjects``, the best of which it gets; arguments checked already.

    Where ``subjects`` is None nothing was learned, which the variant without skinning does not need. Where ``anyone`` is true the
    scan may be of somebody else: then proportions may change.

    Returns
    -------
    FitResult

    Raises
    ------
    InputError
        A start or labels where there is no skinning that could use them.
    """
    if subjects is None or fitter.regressor_ is None:
        for name, value in (("theta0", theta0), ("labels", labels)):
            if value is not None:
                expected = "None: in the variant 'free-form' vertices move freely, without pose or parts"
                raise InputError(name, f"a {type(value).__name__}", expected, "Leave it out, or choose another variant.")

    started = time.perf_counter()
    with one_thread():
        seed, settings = fitter._seed(), fit_settings(fitter)
        limits = {"most": settings.max_points, "scale": settings.scale, "point_weights": point_weights, "labels": labels}
        return with_floor_or_without(
            lambda ups: taking_part(points, fitter.rig, rng=generator(seed, "thin"), ups=ups, **limits),
            lambda part: _fit_new(fitter, points, part, subjects, theta0, labels, point_weights, anyone, settings, started),
            _facing(fitter).floors,
        )


def _fit_new(fitter, points, part, subjects, theta0, labels, point_weights, anyone, settings, started):
    rig, half = fitter.rig, fitter.rig.size / 2
    rows, left_out, guess = part.rows, part.left_out, part.scale
    x = points[rows]
    a = shares(point_weights, rows)
    if subjects is None or fitter.regressor_ is None:  # free-form: nothing but the unit is learned
        unit = guess if subjects is None else _unit(guess, fitter.unit_[subjects[0]], settings) or guess
        frame = Frame(x.mean(axis=0), unit * half)
        return free_form(fitter._model(), settings, Problem(frame.inside(x), a), points, rows, frame, started, left_out)
    seen, known, given = None, None if labels is None else labels[rows], given_names(theta0, labels)
    if given:
        found = [(s, _given(fitter, s, x, a, settings, guess, theta0, known)) for s in subjects]
    elif len(subjects) == 1:
        found = [(s, _scouted(fitter, s, x, a, settings)) for s in subjects]
    else:  # one look for all, on the rig's own template with proportions
        seen = scan_fit(fitter, fitter.segmenter_, fitter.regressor_).scout(x, a)
        found = [(s, _on_template(fitter, s, seen, settings)) for s in subjects]
    subject, best = min(found, key=lambda f: _left(fitter, *f, settings))
    whose = f"on the template of subject {subject!r}" if len(fitter.template_) > 1 else "on the learned template"
    fit = _template_fit(fitter, subject, settings)
    proportions = fit.proportions(best.problem, best.state)
    if anyone and proportions > SOMEBODY_ELSE:
        # No template of another person is a good beginning: the rig's own, and what was learned of labels and poses.
        known = {"theta0": theta0, "labels": labels, "point_weights": point_weights}
        alone = scan_fit(fitter, fitter.segmenter_, fitter.regressor_).fit(points, **known, part=part, found=seen)
        nearest = f"that of {subject!r}, the nearest one" if len(fitter.template_) > 1 else "the learned one"
        message = f"{alone.message}; proportions of its own explain it much better than {nearest}: somebody else?"
        return _asking(replace(alone, message=message, seconds=time.perf_counter() - started), subjects)
    unit = unit_note(best.state.scale * best.frame.unit / half, rig, settings.scale)
    stands = stands_words(_facing(fitter), rig, best.frame, best.state.theta) if theta0 is None else ""
    place = {"points": points, "rows": rows, "frame": best.frame, "value": best.value, "rivals": best.rivals}
    place |= {"proportions": proportions, "notes": [whose, left_out], "found": (unit, stands), "given": given, "free": best.free}
    another = not anyone and proportions > SOMEBODY_ELSE  # it is not more effort that would help
    if not given and not another:
        place["further"] = further_words(settings, _facing(fitter))
    place["dense"] = all_points(points, part, point_weights, best.frame, best.problem)
    state = best.state
    if (prior := getattr(fitter, "pose_prior_", None)) is not None and labels is None:  # with known labels the pose goes by these
        _, dense = place["dense"]
        state, held = drawn_by_itself(fit.refit, dense, state, prior)
        place |= held
    result = fit.finish(best.problem, state, proba=best.proba, labels_known=labels, started=started, **place)
    result = replace(result, subject=str(subject))
    if another and result.status != "ok":
        without = "without subject (--subject, or its line of --subjects, which may be wrong)"
        return replace(result, message=f"{result.message}; {without} the template that suits it best is taken")
    return _asking(result, subjects)


def _left(fitter, subject, found, settings):
    """What a fit on a subject's template leaves unexplained, in the scan's unit squared."""
    return _template_fit(fitter, subject, settings).refit.left(found.problem, found.state) * found.frame.unit**2


def _asking(result, subjects):
    """A result in doubt asks for the subject where there are several."""
    if len(subjects) == 1 or result.status == "ok":
        return result
    return replace(result, message=f"{result.message}; if you know who it is, name the subject (--subject, --subjects)")


def _scouted(fitter, subject, x, a, settings):
    """A scan of which nothing is known; in the subject's unit where its size allows that."""
    facing, library, segmenter = _facing(fitter), fitter.regressor_, fitter.segmenter_
    unit = _unit(library.starts(x, facing.turns, 1)[0].scale, fitter.unit_[subject], settings)
    model, nearest = _template_fit(fitter, subject, settings).model, as_variant(fitter.variant).library

    def make():
        return Scout(model, library, facing, segmenter, settings, unit=unit, proportions=False, nearest=nearest)

    made_of = model, library, segmenter, settings, _facing_words(fitter), nearest, unit
    return _kept(fitter, (subject, "scout", unit is None), made_of, make)(x, a)


def _on_template(fitter, subject, seen, settings):
    """What a look at a scan has found, gone on from on a subject's template."""
    unit = seen.state.scale * seen.frame.unit / (fitter.rig.size / 2)
    learned = _unit(unit, fitter.unit_[subject], settings)
    ratio = (learned or unit) / (seen.frame.unit / (fitter.rig.size / 2))
    problem = Problem(seen.problem.X / ratio, seen.problem.x_weights)
    refit = _template_fit(fitter, subject, settings).refit
    if learned is None:
        refit = refit.freeing(_SIZED)
    state, value, _ = refit(problem, [refit.in_place(problem, seen.state.theta)], proba=seen.proba)
    # What the others would leave unexplained if this template helped them as much.
    rivals = tuple(value * r / max(seen.value, np.finfo(float).tiny) for r in seen.rivals)
    return Found(replace(seen.frame, unit=seen.frame.unit * ratio), problem, state, seen.proba, value, rivals, refit.free)


def _given(fitter, subject, x, a, settings, guess, theta0, labels):
    """A scan with a start, which says how it is turned, or with known labels, which tell it."""
    unit = _unit(guess, fitter.unit_[subject], settings)
    refit = _template_fit(fitter, subject, settings).refit
    if unit is None:
        refit = refit.freeing(_SIZED)
    best, least, place = None, np.inf, (fitter.rig, _facing(fitter), x, a, unit or guess)
    for frame, problem, proba, theta in given_views(*place, fitter.segmenter_, theta0, labels):
        # Steps from the start itself compete with those that look far, which may lead away from one that is right.
        states = [] if theta is None else [refit.in_place(problem, theta)]
        state, value, _ = refit(problem, states, proba=None if labels is None else proba, labels_known=labels is not None)
        left = refit.left(problem, state)
        if best is None or left < least:
            best, least = Found(frame, problem, state, proba, value, (), refit.free), left
    return best


def _unit(seen, learned, settings):
    """Scan units in a rig unit where they are known: as learned, if what is seen of the scan allows that; else None."""
    if settings.scale == "fixed":
        return 1.0
    return learned if same_size(seen, learned) else None


def _template_fit(fitter, subject, settings):
    template, half = fitter.template_[subject], fitter.rig.size / 2

    def make():
        return TemplateFit(fitter.rig, Model(template, fitter.joints, half=half, shared=True), settings)

    return _kept(fitter, (subject, "fit"), (template, fitter.joints, settings), make)


def scan_fit(fitter, segmenter=None, library=None):
    """Fits of scans by themselves, with what was pretrained."""
    model, settings, prior = fitter._model(), fit_settings(fitter), getattr(fitter, "pose_prior_", None)
    nearest = as_variant(fitter.variant).library
    made_of = model, settings, _facing_words(fitter), segmenter, library, nearest, prior

    def make():
        known = {"segmenter": segmenter, "library": library, "prior": prior}
        return ScanFit(model, settings, facing=_facing(fitter), nearest=nearest, **known)

    return _kept(fitter, (None, "scan fit"), made_of, make)


def _facing(fitter):
    return facing_of(fitter.rig, fitter.orientation, fitter.up)


def _facing_words(fitter):
    return f"{fitter.orientation} {fitter.up}"


def _kept(fitter, key, made_of, make):
    """``make()``, kept on the fitter while all that it is made of stays the same; ``key`` begins with the subject, or None."""
    kept = fitter.__dict__.setdefault("_prepared", {})
    found = kept.get(key)
    if found is None or not all(map(_alike, found[0], made_of)):
        for other in [k for k in kept if k[0] is not None and k[0] not in getattr(fitter, "template_", ())]:
            del kept[other]
        kept[key] = found = made_of, make()
    return found[1]


def _alike(a, b):
    return a is b or (isinstance(a, (str, float, FitSettings)) and a == b)
