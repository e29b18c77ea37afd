"""The first fit of each scan of a collection, by itself, which may find that the scan goes on beyond the rig."""

from dataclasses import dataclass
from functools import cached_property

from ..fitting.scan_fit import ScanFit
from ..fitting.second_look import is_long, looked_at_again, may_go_on
from ..losses.objective import PLAIN
from ..optimize.model import Model
from .tasks import finite, short

__all__ = ["FirstFit"]


@dataclass(frozen=True)
class FirstFit:
    """Member → (Frame, State, L_c, probabilities or None, TakingPart or None), on the rig's own template with proportions.

    The last is None, or what takes part without the points that are found to go on beyond the rig, as in fits of single scans
    (``fitting.second_look``); the others are of that then.
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

    @cached_property
    def _may_go_on(self):
        return may_go_on(self.model.source, self.settings)

    def made_of(self, member):
        """What the answer depends on that scans do not share."""
        return (member.points, member.part, member.ups) if self._may_go_on else member.x

    def __call__(self, member):
        scout = self._fit.scout
        long = self._may_go_on and is_long(member.points, member.part, self.model.source, self.settings)
        found = scout(member.x, once=long)
        return self._answer(found) if not self._may_go_on or scout.is_sure(found) else self._looked_at_again(member, found, long)

    def _answer(self, found, part=None):
        loss = found.problem.evaluate(self.model.coarse, found.state, PLAIN).value
        return found.frame, found.state, finite(loss), short(found.proba), part

    def _looked_at_again(self, member, found, long):
        """The answer for what lies within the rig, where a likelier fit finds something beyond; else for all that takes part.

        ``found`` is what the scout said of that, where ``long`` at a first look.
        """
        points, fits = member.points, []

        def taking_part(ups, among):
            if among is None and ups is member.ups:
                return member.part
            return self._fit.taking_part(points, None, self.seed, ups=ups, among=among)

        def fit(part, once):
            seen = found if part is member.part and once == long else self._fit.scout(points[part.rows], once=once)
            fits.append((part, seen, self._fit.fit(points, part=part, found=seen)))
            return fits[-1][-1]

        best = looked_at_again(taking_part, fit, points, self.model.source, ups=member.ups, settings=self.settings)
        part, seen = next((part, seen) for part, seen, result in fits if result.vertices is best.vertices)
        if part.among is not None:
            return self._answer(seen, part)
        return self._answer(seen if part is member.part else found)  # what may be a floor is told by the whole collection
