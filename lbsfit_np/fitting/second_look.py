"""A fit in doubt is looked at again, with what was taken for a floor, or without what goes on beyond the rig."""

from dataclasses import replace

from ..errors import InputError
from ..starts.beyond import beyond, cuts, end_of, goes_on, scales_of
from .assemble import guesses

__all__ = ["is_long", "looked_at_again", "may_go_on"]

# Of what was taken for a floor or walls at first, and may be a flat side of the body.
_FLOOR = "with the points of that floor or wall, the fit is no more probable"
_NO_FLOOR = "a flat side that might be a floor or wall is kept, as the fit is more probable with it"
# From this share of a scan's points on it is worth a fit to leave out what is beyond the rig, and up to this one.
_LEAST, _MOST = 0.03, 0.85
# A long scan whose first fit is right with this probability is looked at no further.
_SURE = 0.8
# A fit without what lay beyond another one's end has to find this share of it beyond its own, and no more than this share of its
# joints may be guesses: of boxes and capsules, whose ends look like fists, half of the joints are, of hands an eighth at most.
_STILL, _GUESSES = 0.9, 0.4


def looked_at_again(part, taking_part, fit, points, rig, *, settings, given=()):
    """The fit of a scan; where it is in doubt, the likeliest of those with and without what may be no part of the body.

    Parameters
    ----------
    part : TakingPart
        Of the scan, without either argument of:
    taking_part : callable (among, sure) → TakingPart
        Arguments as for ``starts.clean.taking_part``.
    fit : callable (TakingPart, bool) → FitResult
        Where the second argument is true without a second look for the pose. Seconds go on from where the first fit began.
    points : (n, 3) array
    rig : Rig
    settings : FitSettings
        With ``effort`` "fast" nothing is looked for beyond the rig.
    given : sequence of {"theta0", "labels"}
        What the caller knows. Labels say what is of the body: then nothing is looked for beyond it either.

    Returns
    -------
    FitResult
        With the seconds and the evaluations of all.
    """
    look = None
    if "labels" not in given and may_go_on(rig, settings):
        look = _Look(lambda among: taking_part(among, False), fit, part, points, rig, settings)
        if not given and is_long(points, part, rig, settings):  # what is given is fitted at once
            first = look.at_all(once=True)
            # Without skinning nothing speaks for a fit or against it.
            if first.probability >= _SURE or (first.status == "ok" and not first.evidence):
                return first
            within = look.within_the_rig(first)
            if within is not None and within.status == "ok" and within.probability >= first.probability:
                return within
            whole = _with_floor_or_without(part, taking_part, fit)
            return look.with_costs(whole if within is None else max(whole, within, key=_probability), whole)
    result = _with_floor_or_without(part, taking_part, fit)
    if look is None or result.status == "ok":
        return result
    look.count(result)
    within = look.within_the_rig(result)
    return look.with_costs(result if within is None else max(result, within, key=_probability))


def _with_floor_or_without(part, taking_part, fit):
    """The fit of a part; where it is in doubt, with what may be no floor taking part, too, and the likelier of the two.

    What lies below another axis than the likeliest, and walls, may be flat sides of the body, such as a palm facing the camera.
    """
    result = fit(part, False)
    if result.status == "ok" or part.doubtful is None:
        return result
    try:
        whole = taking_part(None, True)
    except InputError:  # of a wide wall: with it the scan is none that can be worked with
        return result
    other = fit(whole, False)
    both = {"seconds": other.seconds, "evaluations": result.evaluations + other.evaluations}
    best, words = (result, _FLOOR) if result.probability >= other.probability else (other, _NO_FLOOR)
    return replace(best, message=f"{best.message}; {words}", **both)


def may_go_on(rig, settings):
    """Whether scans of a rig are looked at for what goes on beyond it."""
    return settings.effort != "fast" and end_of(rig) is not None


def is_long(points, part, rig, settings):
    """Whether a scan, of which this takes part, is sure to go on beyond the rig."""
    return goes_on(points[part.rows], end_of(rig), _scales(rig, settings))


def _scales(rig, settings):
    return scales_of(rig, settings.scale, settings.unit)


def _probability(result):
    return -1.0 if result is None else result.probability


class _Look:
    """Fits of parts of one scan that may go on beyond the rig, and what all of them have cost."""

    def __init__(self, taking_part, fit, part, points, rig, settings):
        self._taking_part, self._fit, self._part = taking_part, fit, part
        self._points, self._rig, self._settings = points, rig, settings
        self._body = points[part.rows]  # floors, and what else takes no part, go on from no end
        self._seconds, self._evaluations = 0.0, 0

    def count(self, result):
        """Add what a fit has cost; it comes back."""
        self._seconds, self._evaluations = result.seconds, self._evaluations + result.evaluations
        return result

    def with_costs(self, result, last=None):
        """A result with what all have cost, and a last one that was not counted."""
        if last is not None:
            self.count(last)
        return replace(result, seconds=self._seconds, evaluations=self._evaluations)

    def at_all(self, *, once):
        """The fit of the whole."""
        return self.count(self._fit(self._part, once))

    def within_the_rig(self, result):
        """What is likelier than a fit in doubt without what goes on beyond the rig's end, such as the forearm of a hand.

        What lies beyond is told by a fit: by the one in doubt, which may be right but for what it cannot explain; then, of a scan
        longer than the rig, by the likelier of the fits of its two ends. One that is "ok" ends the search.

        Returns
        -------
        FitResult or None
            With the seconds and the evaluations of all so far; None where there is none, or it has failed.
        """
        best = self._without_what_is_beyond(result)
        if best is None or best.status != "ok":
            for ends in cuts(self._body, end_of(self._rig), _scales(self._rig, self._settings)):
                there = max((self._at(one(self._points)) for one in ends), key=_probability)
                best = max((best, self._without_what_is_beyond(there)), key=_probability)
                if best is not None and best.status == "ok":
                    break
        return None if best is None or best.status == "failed" else self.with_costs(best)

    def _at(self, among):
        """The fit of these points; None where they are none that can be worked with."""
        try:
            part = self._taking_part(among)
        except InputError:
            return None
        return self.count(self._fit(part, True))

    def _without_what_is_beyond(self, found):
        """The fit without the points beyond the end that another fit has found.

        None where there is none or where its joints are guesses, where these points are too few or too many, or where the fit
        without them does not find them beyond its own end.
        """
        if found is None or not self._tells(found):
            return None
        past = beyond(self._points, self._rig, found)
        of_the_body = past[self._part.rows]
        if not _LEAST <= of_the_body.mean() <= _MOST:
            return None
        other = self._at(~past)
        if other is None or not self._tells(other) or beyond(self._body[of_the_body], self._rig, other).mean() < _STILL:
            return None
        return other

    def _tells(self, found):
        """Whether the scan tells where most of the joints are."""
        return guesses(self._rig, found.joint_std, found.scale)[1] <= _GUESSES
