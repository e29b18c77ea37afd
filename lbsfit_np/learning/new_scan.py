"""A new scan with what was learned: on the learned template that suits it, or on the rig's own where it is somebody else's."""

import threading
import time
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..fitting.confidence import SOMEBODY_ELSE
from ..fitting.drawn import drawn_by_itself
from ..fitting.effort import EFFORTS
from ..fitting.mirror_image import looked_at_in_the_mirror
from ..fitting.one_thing import APART, looked_at_apart
from ..fitting.refit import Runner
from ..fitting.scan_fit import (
    FitSettings,
    ScanFit,
    all_points,
    further_words,
    given_names,
    given_views,
    shares,
    stands_words,
)
from ..fitting.scout import Found, Scout
from ..fitting.second_look import looked_at_again
from ..fitting.template_fit import TemplateFit
from ..optimize.frame import Frame
from ..optimize.model import Model
from ..optimize.problem import Problem
from ..optimize.state import SIZED
from ..rig.weld import welded_as_before
from ..seeds import generator
from ..starts.clean import taking_part
from ..starts.scale import sizes_in, unit_note, unit_question
from ..starts.turns import facing_of
from ..threads import one_thread
from .free_form import free_form
from .parameters import fit_settings
from .sizes import allowed_unit, doubted, held_to, of_a_size_allowed, other_size, size_beside_taught, template_size
from .variants import as_variant

__all__ = ["fit_new", "scan_fit"]

# Of several learned templates those are gone on with that leave at most so many times as much unexplained as the best after a few
# steps, and so many at most: of people who are alike it matters little whose is taken.
_CLOSE, _SEVERAL = 1.3, 3
# A size of the scan's own is taken that leaves less of it unexplained than this share of what the learned one leaves.
_SIZED = 0.7
# Subjects whose templates a fitter keeps ready, of a body some 30 MB each.
_READY = 32
# A fitter may be asked by several threads.
_lock = threading.RLock()


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
        A start or labels where there is no skinning that could use them; a fixed scale that suits no subject's learned size.
    """
    if subjects is None or fitter.regressor_ is None:
        for name, value in (("theta0", theta0), ("labels", labels)):
            if value is not None:
                expected = "None: in the variant 'free-form' vertices move freely, without pose or parts"
                raise InputError(name, f"a {type(value).__name__}", expected, "Leave it out, or choose another variant.")

    started = time.perf_counter()
    with one_thread():
        seed, settings = fitter._seed(), fit_settings(fitter)
        subjects = of_a_size_allowed(fitter, subjects, settings)
        facing, given = _facing(fitter), given_names(theta0, labels)
        limits = {"most": settings.max_points, "scale": settings.scale, "unit": settings.unit}
        limits |= {"cropped": settings.cropped, "ups": facing.floors}

        def part_of(x, a, **more):
            return taking_part(x, fitter.rig, rng=generator(seed, "thin"), point_weights=a, **limits, **more)

        def some_of_it(among, **how):
            return part_of(points, point_weights, labels=labels, among=among, **how)

        def fitted(x, a, part, once):
            return _fit_new(fitter, x, part, subjects, theta0, labels, a, anyone, settings, started, once=once)

        def fit(part, once=True):
            return fitted(points, point_weights, part, once)

        known = {"settings": settings, "given": given}
        part = some_of_it(None)

        def whole():
            return looked_at_again(part, lambda among, sure: some_of_it(among, sure=sure), fit, points, fitter.rig, **known)

        result = looked_at_apart(part, whole, lambda among: some_of_it(among, why=APART), fit, points, **known)

        def reflected(S):
            every = part_of(points, point_weights).every  # the rest takes time to label
            x, a = points[every] @ S, None if point_weights is None else point_weights[every]
            return fitted(x, a, part_of(x, a), True)

        return looked_at_in_the_mirror(result, reflected, rig=fitter.rig, facing=facing, given=given, learned=True)


def _fit_new(fitter, points, part, subjects, theta0, labels, point_weights, anyone, settings, started, *, once):
    x, guess = points[part.rows], part.scale
    a = shares(point_weights, part.rows)
    if subjects is None or fitter.regressor_ is None:  # free-form: nothing but the unit is learned
        unit = guess if subjects is None else allowed_unit(fitter, subjects[0], guess, settings) or guess
        frame = Frame(x.mean(axis=0), unit * fitter.rig.size / 2)
        return free_form(fitter._model(), settings, Problem(frame.inside(x), a), points, part, frame, started)
    seen, known, given = None, None if labels is None else labels[part.rows], given_names(theta0, labels)
    if given:
        place = x, a, settings, guess, theta0, known

        def find(s, **sized):
            return _given(fitter, s, *place, **sized)
    elif len(subjects) == 1:

        def find(s, **sized):
            return _scouted(fitter, s, x, a, settings, once=once, **sized)
    else:  # one look for all, on the rig's own template with proportions
        seen = scan_fit(fitter, fitter.segmenter_, fitter.regressor_).scout(x, a, once=once)

        def find(s, **sized):
            return _gone_on(fitter, _begun(fitter, s, seen, settings, **sized), seen, settings)

    def in_its_size(s, there=None):
        return s, _of_its_size(fitter, s, there or find(s), settings, find)

    if seen is None:
        few = subjects
        if len(subjects) > _SEVERAL:  # one shows where the scan is, and that the templates that suit it
            _, first = in_its_size(subjects[0])
            few = [b.subject for b in _suiting(fitter, subjects, first, settings, template_size(fitter, subjects[0]))]
        found = [in_its_size(s) for s in few]
    else:
        found = [in_its_size(*f) for f in _on_templates(fitter, subjects, seen, settings)]
        bends = EFFORTS[settings.effort].bends
        # On templates of other people they, which take most of the time, are for nothing.
        unbent = bends and anyone and all(_proportions(fitter, *f, settings) > SOMEBODY_ELSE for f in found)
        if bends and not unbent:
            found = _bent(fitter, found, seen, settings)
    subject, best, proportions = _nearest(fitter, found, settings)
    alone = None
    if anyone and proportions > SOMEBODY_ELSE:
        # No template of another person is a good beginning: the rig's own, and what was learned of labels and poses.
        known = {"theta0": theta0, "labels": labels, "point_weights": point_weights}
        alone = scan_fit(fitter, fitter.segmenter_, fitter.regressor_).fit(points, **known, part=part, found=seen, once=once)
        if seen is not None and unbent and alone.status != "ok":  # a wrong pose, too, may look like another person's
            subject, best, proportions = _nearest(fitter, _bent(fitter, found, seen, settings), settings)
    if alone is not None and proportions > SOMEBODY_ELSE:
        nearest = f"the template of {subject!r}, the nearest one" if len(fitter.template_) > 1 else "the learned template"
        message = f"{alone.message}; proportions of its own explain it much better than {nearest}: is it a scan of somebody else?"
        message += held_to(fitter, subject, alone)
        return _asking(replace(alone, message=message, seconds=time.perf_counter() - started), subjects)

    def finished(best, proportions):
        return _finished(
            fitter, subject, best, proportions, points, part, theta0, labels, point_weights, anyone, settings, started
        )

    result = finished(best, proportions)
    if result.status != "ok" and settings.scale != "fixed" and "scale" not in best.free:
        # A size that is not the scan's may have hidden its pose.
        other = find(subject, sized=True)
        if seen is not None and bends:
            ((_, other),) = _bent(fitter, [(subject, other)], seen, settings)
        proportions = _proportions(fitter, subject, other, settings)
        better = _left(fitter, subject, other, settings) <= _SIZED * _left(fitter, subject, best, settings)
        if better and not (anyone and proportions > SOMEBODY_ELSE):
            result = finished(other, proportions)
    return _asking(result, subjects)


def _finished(fitter, subject, best, proportions, points, part, theta0, labels, point_weights, anyone, settings, started):
    """The result of what was found on a subject's template."""
    rig, given = fitter.rig, given_names(theta0, labels)
    whose = f"on the template of subject {subject!r}" if len(fitter.template_) > 1 else "on the learned template"
    fit = _template_fit(fitter, subject, settings)
    scale = best.state.scale * best.frame.unit / (rig.size / 2)
    unit = unit_note(scale, rig, settings.scale, unit=settings.unit, size=template_size(fitter, subject))
    if doubt := doubted(fitter, subject, scale, settings):  # which asks what the size alone may have asked
        unit = unit.removesuffix(unit_question(settings.unit)) + doubt
    elif "scale" in best.free:
        unit += other_size(fitter, subject, scale, settings)
    stands = stands_words(_facing(fitter), rig, best.frame, best.state.theta) if theta0 is None else ""
    place = {"points": points, "part": part, "frame": best.frame, "value": best.value, "rivals": best.rivals}
    place |= {"proportions": proportions, "notes": [whose], "found": (unit, stands), "given": given}
    place |= {"free": best.free, "theta0": theta0}
    another = not anyone and proportions > SOMEBODY_ELSE  # it is not more effort that would help
    if not given and not another:
        place["further"] = further_words(rig, settings, _facing(fitter))
    place["dense"] = all_points(points, part, point_weights, best.frame, best.problem)
    state = best.state
    if (prior := getattr(fitter, "pose_prior_", None)) is not None and labels is None:  # with known labels the pose goes by these
        _, dense = place["dense"]
        state, held = drawn_by_itself(fit.refit, dense, state, prior)
        place |= held
    result = fit.finish(best.problem, state, proba=best.proba, labels_known=labels, started=started, **place)
    result = replace(result, subject=str(subject))
    result = replace(result, message=result.message + held_to(fitter, subject, result))
    if another and result.status != "ok":
        without = "without subject (--subject, or its line of --subjects, which may be wrong)"
        return replace(result, message=f"{result.message}; {without}, the template that fits best is used")
    return result


def _nearest(fitter, found, settings):
    """The subject whose template leaves least of a scan unexplained, its Found, and what proportions of its own would explain."""
    subject, best = min(found, key=lambda f: _left(fitter, *f, settings))
    return subject, best, _proportions(fitter, subject, best, settings)


def _proportions(fitter, subject, found, settings):
    return _template_fit(fitter, subject, settings).proportions(found.problem, found.state)


def _left(fitter, subject, found, settings):
    """What a fit on a subject's template leaves unexplained, in the scan's unit squared."""
    return _template_fit(fitter, subject, settings).refit.left(found.problem, found.state) * found.frame.unit**2


def _asking(result, subjects):
    """A result in doubt asks for the subject where there are several."""
    if len(subjects) == 1 or result.status == "ok":
        return result
    return replace(result, message=f"{result.message}; if you know who it is, name the subject (--subject, --subjects)")


def _of_its_size(fitter, subject, found, settings, find):
    """A Found in the subject's learned unit, or of a size of its own where that leaves much less of the scan unexplained.

    The unit tells a scan of another size only where that is very different. ``find`` (subject, sized=True) looks for the pose
    anew with its scale free.
    """
    if settings.scale == "fixed" or "scale" in found.free:
        return found
    refit = _template_fit(fitter, subject, settings).refit
    free, problem = refit.freeing(SIZED), found.problem
    _, held = refit.to_the_end(problem, found.state)
    state, left = free.to_the_end(problem, found.state)
    if left > _SIZED * held:
        return found
    sized = replace(found, state=state, value=free.chamfer(problem, state), free=SIZED)
    sized = _in_found_unit(replace(sized, rivals=_rivals(sized.value, found)))
    return min((sized, find(subject, sized=True)), key=lambda there: _left(fitter, subject, there, settings))


def _scouted(fitter, subject, x, a, settings, *, once, sized=False):
    """A scan of which nothing is known; in the subject's unit where its size allows that and it is not to be ``sized``."""
    facing, library, segmenter = _facing(fitter), fitter.regressor_, fitter.segmenter_
    size = size_beside_taught(fitter, subject)
    seen = library.starts(x, facing.turns, 1, **sizes_in(fitter.rig, settings.unit))[0].scale / size
    unit = None if sized else allowed_unit(fitter, subject, seen, settings)
    model, nearest = _template_fit(fitter, subject, settings).model, as_variant(fitter.variant).library

    def make():
        known = {"unit": unit, "proportions": False, "nearest": nearest, "size": size}
        return Scout(model, library, facing, segmenter, settings, **known)

    made_of = model, library, segmenter, settings, *_faces(fitter), nearest, unit, size
    return _kept(fitter, (subject, "scout", unit is None), made_of, make)(x, a, once=once)


@dataclass(frozen=True)
class _Begun:
    """A scan on a subject's template after a few steps on few points.

    Attributes
    ----------
    subject : hashable
    frame, problem
        In the subject's unit, if its size allows that.
    in_unit : bool
        Whether it does.
    state : State
        Where the steps began, which is where the search on the template begins, too: it looks far first.
    left : float
        What they leave unexplained, in the scan's unit squared.
    """

    subject: object
    frame: object
    problem: object
    in_unit: bool
    state: object
    left: float


def _on_templates(fitter, subjects, seen, settings):
    """What a look at a scan has found, gone on from on the templates that suit it: (subject, Found) of each, without bends."""
    return [(b.subject, _gone_on(fitter, b, seen, settings)) for b in _suiting(fitter, subjects, seen, settings)]


def _suiting(fitter, subjects, seen, settings, size=1.0):
    """Of the templates those that suit a scan, as _Begun, by a few steps from where it was seen: the best, and few near to it.

    ``size`` is that of the template that it was seen on, in sizes of the rig's own.
    """
    ready = getattr(fitter, "_prepared", ())
    first = sorted(subjects, key=lambda s: (s, "fit") not in ready)  # before others take their places
    begun = {s: _begun_in_its_size(fitter, s, seen, settings, size) for s in first}
    begun = sorted((begun[s] for s in subjects), key=lambda b: b.left)
    return [b for b in begun[:_SEVERAL] if b.left <= _CLOSE * begun[0].left]


def _begun_in_its_size(fitter, subject, seen, settings, size=1.0):
    """As _Begun in the learned unit, or of a size of its own where that leaves much less: who it is may show at that alone."""
    held = _begun(fitter, subject, seen, settings, size)
    if settings.scale == "fixed" or not held.in_unit:
        return held
    sized = _begun(fitter, subject, seen, settings, size, sized=True)
    return sized if sized.left <= _SIZED * held.left else held


def _begun(fitter, subject, seen, settings, size=1.0, *, sized=False):
    unit = seen.state.scale * seen.frame.unit / (fitter.rig.size / 2) * size / template_size(fitter, subject)
    learned = None if sized else allowed_unit(fitter, subject, unit, settings)
    ratio = (learned or unit) / (seen.frame.unit / (fitter.rig.size / 2))
    frame = replace(seen.frame, unit=seen.frame.unit * ratio)
    problem = Problem(seen.problem.X / ratio, seen.problem.x_weights)
    refit = _template_fit(fitter, subject, settings).refit
    if learned is None:
        refit = refit.freeing(SIZED)
    state = refit.in_place(problem, seen.state.theta)
    (runner,) = refit.last_steps([Runner(problem, state)])
    return _Begun(subject, frame, problem, learned is not None, state, runner.value * frame.unit**2)


def _gone_on(fitter, begun, seen, settings):
    refit = _template_fit(fitter, begun.subject, settings).refit
    refit = refit if begun.in_unit else refit.freeing(SIZED)
    state, value, _ = refit(begun.problem, [begun.state], proba=seen.proba, bend=False)
    found = _in_found_unit(Found(begun.frame, begun.problem, state, seen.proba, value, (), refit.free))
    return replace(found, rivals=_rivals(found.value, seen))


def _bent(fitter, found, seen, settings):
    """(subject, Found) of each as it is once other bends were tried."""
    out = []
    for subject, there in found:
        refit = _template_fit(fitter, subject, settings).refit
        state, value = (refit if there.free == refit.free else refit.freeing(there.free)).bent(there.problem, there.state)
        bent = _in_found_unit(replace(there, state=state, value=value))
        out.append((subject, replace(bent, rivals=_rivals(bent.value, seen))))
    return out


def _in_found_unit(found):
    """The same in half sizes of what was found, as evidence is: where the unit was not known, in those of a guess until then."""
    q = found.state.scale
    if q == 1.0:
        return found
    frame, value = replace(found.frame, unit=found.frame.unit * q), found.value / q**2
    found = replace(found, frame=frame, problem=found.problem.in_unit(q), state=found.state.in_unit(q), value=value)
    return replace(found, rivals=tuple(r / q**2 for r in found.rivals))


def _rivals(value, seen):
    """What the others would leave unexplained if a template helped them as much as the one that has left ``value``."""
    return tuple(value * r / max(seen.value, np.finfo(float).tiny) for r in seen.rivals)


def _given(fitter, subject, x, a, settings, guess, theta0, labels, *, sized=False):
    """A scan with a start, which says how it is turned, or with known labels, which tell it."""
    # The learned one was once such a guess, too: neither tells the subject's size.
    unit = None if sized else allowed_unit(fitter, subject, guess, settings)
    refit = _template_fit(fitter, subject, settings).refit
    if unit is None:
        refit = refit.freeing(SIZED)
    best, least, place = None, np.inf, (fitter.rig, _facing(fitter), x, a, unit or guess)
    known = {"size": size_beside_taught(fitter, subject)}
    for frame, problem, proba, theta in given_views(*place, fitter.segmenter_, theta0, labels, **known):
        # Steps from the start itself compete with those that look far, which may lead away from one that is right.
        states = [] if theta is None else [refit.in_place(problem, theta)]
        state, value, _ = refit(problem, states, proba=None if labels is None else proba, labels_known=labels is not None)
        left = refit.left(problem, state)
        if best is None or left < least:
            best, least = Found(frame, problem, state, proba, value, (), refit.free), left
    return _in_found_unit(best)


def _template_fit(fitter, subject, settings):
    template, half = fitter.template_[subject], fitter.rig.size / 2
    other_limbs = as_variant(fitter.variant).library

    def make():
        model = Model(_as_the_rig_says(fitter.rig, template), fitter.joints, half=half, shared=True)
        return TemplateFit(fitter.rig, model, settings, other_limbs=other_limbs)

    return _kept(fitter, (subject, "fit"), (fitter.rig, template, fitter.joints, settings, other_limbs), make)


def _as_the_rig_says(rig, template):
    """A learned template with what the rig's digest leaves out, and may have been said since."""
    said = {name: getattr(rig, name) for name in ("metres_per_unit", "up", "forward")}
    as_now = all(getattr(template, name) == value for name, value in said.items())
    return template if as_now else welded_as_before(template, **said)


def scan_fit(fitter, segmenter=None, library=None):
    """Fits of scans by themselves, with what was pretrained."""
    model, settings, prior = fitter._model(), fit_settings(fitter), getattr(fitter, "pose_prior_", None)
    nearest = as_variant(fitter.variant).library
    made_of = model, settings, *_faces(fitter), segmenter, library, nearest, prior

    def make():
        known = {"segmenter": segmenter, "library": library, "prior": prior}
        return ScanFit(model, settings, facing=_facing(fitter), nearest=nearest, **known)

    return _kept(fitter, (None, "scan fit"), made_of, make)


def _facing(fitter):
    return facing_of(fitter.rig, fitter.orientation, fitter.up)


def _faces(fitter):
    """What a :func:`_facing` is made of; the rig's up axis is no part of its digest."""
    return fitter.rig, f"{fitter.orientation} {fitter.up}"


def _kept(fitter, key, made_of, make):
    """``make()``, kept on the fitter while all that it is made of stays the same; ``key`` begins with the subject, or None."""
    with _lock:
        kept = fitter.__dict__.setdefault("_prepared", {})
        found = kept.pop(key, None)
        if found is None or not all(map(_alike, found[0], made_of)):
            found = made_of, make()
        kept[key] = found  # what was asked for last stands last
        subjects = list(dict.fromkeys(s for s, *_ in reversed(kept) if s is not None))
        gone = {s for s in subjects if s not in getattr(fitter, "template_", ())} | set(subjects[_READY:])
        for other in [k for k in kept if k[0] in gone and k != key]:
            del kept[other]
        return found[1]


def _alike(a, b):
    return a is b or (isinstance(a, (str, float, FitSettings)) and a == b)
