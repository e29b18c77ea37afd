"""From what the loop has left to results: the scans of the collection on their subjects' templates."""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from ..fitting.confidence import SOMEBODY_ELSE
from ..fitting.drawn import prior_of
from ..fitting.scan_fit import further_words
from ..fitting.scout import ALIKE
from ..fitting.template_fit import TemplateFit
from ..optimize.problem import Problem
from ..optimize.state import IN_UNIT, SIZED
from ..starts.scale import same_size, unit_note
from .checkpoint import NO_CHECKPOINT
from .collection import with_doubt
from .tasks import READY, Models, in_full

__all__ = ["results_of"]

# Share of the time that is taken by the scales of scans whose subject has one in doubt.
_SIZES = 0.2


def results_of(
    rig, templates, joints, collection, settings, facing, prior, *, other_limbs, jobs, progress, checkpoint=NO_CHECKPOINT
):
    """The results of the scans that the loop has left poses of; those that the checkpoint has are not made again.

    ``other_limbs`` as for ``Refit``.

    Returns
    -------
    list of FitResult or None
        One for each scan given.
    """
    models = Models(templates, joints, rig.size / 2, shared=True)
    doubted, share = {m.subject for m in collection.members if m.own is not None}, 0.0
    sizes = [None] * len(collection.members)
    if doubted:
        share = _SIZES
        work = _Sizes(rig, models, settings, other_limbs, doubted)
        done = {"jobs": jobs, "done": lambda p: progress("results", share * p)}
        sizes = collection.work(work, collection.members, **done, taught=True)
    tasks = list(zip(collection.members, sizes, _others(collection.members, sizes), strict=True))
    further = further_words(rig, settings, facing)
    kept = []
    for m, size, others in tasks:
        on = templates[m.subject]
        kept.append(checkpoint.slot("result", (m, size, others, on.vertices, on.joints, further, prior)))
    work = _Finish(rig, models, settings, other_limbs, further, prior)
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
    models: Models
    settings: object
    other_limbs: bool

    @cached_property
    def _fit(self):
        return lru_cache(READY)(self._made)

    def _made(self, subject):
        return TemplateFit(self.rig, self.models[subject], self.settings, other_limbs=self.other_limbs)


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
            m = _in_better_unit(m, fit, size, others)
        free = SIZED if size is not None and m.state is size.own else IN_UNIT
        grown = fit.model.source.size / self.rig.size
        unit = unit_note(m.state.scale * m.unit, self.rig, self.settings.scale, unit=self.settings.unit, size=grown)
        place = {"points": m.points, "part": m.part, "frame": m.frame, "free": free}
        problem = m.problem
        proportions = fit.proportions(problem, m.state)
        further = () if proportions > SOMEBODY_ELSE else self.further  # it is not more effort that would help
        place |= {"proportions": proportions, "further": further, "value": 1.0, "rivals": _rivals(m, fit.model)}
        place |= {"notes": [m.role], "found": (unit,)}
        place["dense"] = m.part.every, Problem(m.dense_X) if len(m.part.more) else problem
        place["prior"] = prior_of(self.prior, m.noise, fit.refit.turning, m.prior)
        result = fit.finish(problem, m.state, proba=in_full(m.proba), **place)
        if m.own is None and result.status == "ok":  # then only first fits were wrong
            m = replace(m, doubt="")
        return with_doubt(m, replace(result, subject=str(m.subject)))


def _rivals(m, model):
    """What rivals of its first fit leave of a scan, in what its pose leaves, as far as that is still the first fit's.

    Rounds do not look for such poses again, seen from behind for one. A template helps them as much as it helps the pose.
    """
    theta, rivals = m.first
    if not rivals:
        return ()
    now, then = (model.deformed(state).joints for state in (m.state, m.state.replace(theta=theta)))
    return rivals if np.linalg.norm(now - then, axis=1).mean() <= ALIKE * m.state.scale else ()


def _size(m, fit):
    """The _Size of a scan: from its first fit, too, where that had another."""
    anew, problem, state = fit.refit.freeing(SIZED), m.problem, m.state
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


def _in_better_unit(m, fit, size, others):
    """A scan in its subject's unit, or in its own where that explains it better, which makes doubts of it.

    A first fit that was wrong says nothing of a scan's size, nor does the template, in which the scan has taken part: its
    subject's others have a scale on that, too. Where they have the same, ``own`` is None in what comes back.
    """
    if same_size(size.scale, others) and not m.apart:  # scale is free in its own fit alone, which may win by that
        return replace(m, state=size.state, own=None)
    if size.own is None:
        return replace(m, state=size.state)
    words = f"it has {size.scale / others:.3g} times the scale of its subject's other scans: is it in another unit"
    doubt = m.doubt or f"{words}, or somebody else's?"
    if m.apart and not same_size(size.scale, others):  # nearer to the truth than the first fit's, which its doubt has so far
        doubt = f"{words}? Convert it and learn again"
    # Neighbours' poses were found in the subject's unit, and what its points tell.
    return replace(_as_first_fitted(m, fit), state=size.own, doubt=doubt, prior=None, noise=0.0)
