"""The first fit of each scan of a collection, by itself, which may find that the scan goes on beyond the rig."""

from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from ..errors import counted
from ..fitting.confidence import FAILED
from ..fitting.refit import plain_chamfer
from ..fitting.result import FitResult
from ..fitting.scan_fit import ScanFit
from ..fitting.second_look import is_long, looked_at_again, may_go_on
from ..optimize.model import Model
from .collection import LEARNED_FROM
from .tasks import finite, short

__all__ = ["FirstFit", "most_have_failed"]


@dataclass(frozen=True)
class FirstFit:
    """A task → (Frame, State, L_c, probabilities or None, rivals, TakingPart or None, bool), on the rig's proportioned template.

    ``rivals`` are what other poses leave unexplained, in what this one leaves. The last but one is None, or what takes part
    without the points that are found to go on beyond the rig, as in fits of single scans (``fitting.second_look``); the others
    are of that then. The last: whether the fit is all but certainly wrong.
    """

    model: Model
    settings: object
    segmenter: object
    library: object
    facing: object
    nearest: bool
    seed: int

    @cached_property
    def _fit(self):
        known = {"segmenter": self.segmenter, "library": self.library, "facing": self.facing, "nearest": self.nearest}
        return ScanFit(self.model, self.settings, **known)

    def task(self, member):
        """What the answer for a scan depends on: the points that take part; all where some may lie beyond the rig."""
        return (member.points, member.part, member.sure) if may_go_on(self.model.source, self.settings) else (member.x,)

    def alone(self, member):
        """The FitResult of a member's scan as a fit of single scans makes it, to the end."""
        return self._fit.fit(member.points, random_state=self.seed)

    def __call__(self, task):
        scout, (points, *more) = self._fit.scout, task
        if not more:
            return self._answer(scout(points))
        part, sure = more
        long = is_long(points, part, self.model.source, self.settings)
        found = scout(points[part.rows], once=long)
        return self._answer(found) if scout.is_sure(found) else self._looked_at_again(points, part, sure, found, long)

    def _answer(self, found, part=None):
        loss = plain_chamfer(self.model, found.problem, found.state, coverage=self.settings.coverage)
        rivals = tuple(value / max(found.value, np.finfo(float).tiny) for value in found.rivals)
        failed = bool(self._fit.scout.probability(found) < FAILED)
        return found.frame, found.state, finite(loss), short(found.proba), rivals, part, failed

    def _looked_at_again(self, points, part, sure, found, long):
        """The answer for what lies within the rig, where a likelier fit that is "ok" finds something beyond; else for all.

        ``found`` is what the scout said of all, where ``long`` at a first look.
        """
        whole = replace(part, doubtful=None)  # whether a floor is one is told by the whole collection, and has been
        looks = {long: found}  # at the whole, by whether once

        known = {"ups": self.facing.floors, "sure": sure}

        def taking_part(among, _):
            # Points are drawn by the seed alone: the answer hangs on nothing but the scan.
            return self._fit.taking_part(points, None, self.seed, **known, among=among)

        def scouted(part, once):
            if part is not whole:
                return self._fit.scout(points[part.rows], once=once)
            if once not in looks:
                looks[once] = self._fit.scout(points[part.rows], once=once)
            return looks[once]

        def fit(part, once):
            seen = scouted(part, once)
            result = self._fit.fit(points, part=part, found=seen)
            return _Fitted(**{f.name: getattr(result, f.name) for f in fields(result)}, part=part, seen=seen)

        best = looked_at_again(whole, taking_part, fit, points, self.model.source, settings=self.settings)
        if best.part is whole:
            return self._answer(best.seen)
        if best.status == "ok":  # what is left out here takes no part in learning, whatever comes later
            return self._answer(best.seen, best.part)
        return self._answer(scouted(whole, False))


def most_have_failed(work, members, failed, kept):
    """What to say where most first fits of the scans to learn from have failed; "" where they have not.

    One of them is then fitted alone, with all that such a fit does, as it may tell what is wrong with all: that scans stand
    otherwise, are of the other side, or show one side only.

    Parameters
    ----------
    work : FirstFit
    members : list of Member
    failed : list of bool
        Of each member, whether it has.
    kept : callable (step, made_of) → slot
        Where a checkpoint keeps that fit.

    Returns
    -------
    str
    """
    learning = [(m, wrong) for m, wrong in zip(members, failed, strict=True) if m.role == LEARNED_FROM]
    wrong, n = [m for m, wrong in learning if wrong], len(learning)
    if 2 * len(wrong) <= n:
        return ""
    are = "is" if len(wrong) == 1 else "are"
    words = f"{len(wrong)} of {counted(n, 'scan')} to learn from {are} all but certainly fitted wrongly, and templates are"
    words += " learned from right fits"
    tell = "do scans stand as orientation and up say, is it their rig? Fit one alone (lbs.fit_scan, lbsfit fit) to see"
    slot = kept("round-0-alone", (wrong[0].points, wrong[0].part))
    alone = slot.known(FitResult)
    if alone is None:
        with suppress(Exception):  # what only tells more must not end the run
            alone = work.alone(wrong[0])
        if alone is not None:
            slot.keep(alone)
    if alone is not None and alone.status != "ok":
        tell = f"scan {wrong[0].name} alone is {alone.status}: {alone.message}"
    return f"{words}: {tell}"


@dataclass(frozen=True, eq=False, repr=False)
class _Fitted(FitResult):
    """A result that knows what of the scan it is of, and what the scout said of that."""

    part: object = None
    seen: object = None
