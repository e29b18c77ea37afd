"""A fit in doubt is looked at again, with what was taken for a floor, or without what goes on beyond the rig."""

from dataclasses import replace

from ..errors import InputError
from ..starts.beyond import beyond, cuts, end_of, goes_on, scales_of
from .assemble import GUESS

__all__ = ["looked_at_again", "with_floor_or_without", "within_the_rig"]

# Of a plane below another axis than the likeliest that was taken for a floor at first.
_FLOOR = "with the points of that floor it is no likelier"
_NO_FLOOR = "a flat side that might be a floor takes part, as the fit is likelier with it"
# From this share of a scan's points on it is worth a fit to leave out what is beyond the rig, and up to this one.
_LEAST, _MOST = 0.03, 0.85
# A long scan whose first fit is right with this probability is looked at no further.
_SURE = 0.8
# A fit without what lay beyond another one's end has to find this share of it beyond its own, and no more than this share of its
# joints may be guesses: of boxes and capsules, whose ends look like fists, half of the joints are, of hands an eighth at most.
_STILL, _GUESSES = 0.9, 0.4


def looked_at_again(taking_part, fit, points, rig, *, ups, settings, labels=None):
    """The fit of a scan; where it is in doubt, the likeliest of those with and without what may be no part of the body.

    Parameters
    ----------
    taking_part : callable (ups, among) → TakingPart
        ``among`` as for ``starts.clean.taking_part``.
    fit : callable (TakingPart, bool) → FitResult
        Where the second argument is true without a second look for the pose. Seconds go on from where the first fit began.
    points : (n, 3) array
    rig : Rig
    ups : (k, 3) array or None
        Directions that may be up where there is a floor, the likeliest first; None where any may.
    settings : FitSettings
        With ``effort`` "fast" nothing is looked for beyond the rig.
    labels : (n,) int array, optional
        Known parts, which say what is of the body: then nothing is looked for beyond it either.

    Returns
    -------
    FitResult
        With the seconds and the evaluations of all.
    """
    end, first = end_of(rig), None
    ends = labels is None and settings.effort != "fast" and end is not None
    within, known = lambda among: taking_part(ups, among), (points, rig, scales_of(rig, settings.scale, settings.unit))
    if ends and goes_on(points[within(None).rows], end, known[-1]):
        first = fit(within(None), True)
        if first.probability >= _SURE or not first.evidence:  # without skinning nothing speaks for a fit or against it
            return first
        first = within_the_rig(within, fit, first, *known)
        if first.status == "ok":
            return first
    result = with_floor_or_without(lambda ups: taking_part(ups, None), lambda part: fit(part, False), ups)
    if first is not None:
        result = _with_costs(max((result, first), key=_probability), result, first)
    elif ends and result.status != "ok":
        result = within_the_rig(within, fit, result, *known)
    return result


def _with_costs(result, last, before):
    """A result with the seconds of the last fit, and the evaluations of all."""
    return replace(result, seconds=last.seconds, evaluations=last.evaluations + before.evaluations)


def with_floor_or_without(taking_part, fit, ups):
    """The fit of a scan; where it is in doubt, with what may be no floor taking part, too, and the likelier of the two.

    A floor below another axis than the likeliest may be a flat side of the body, such as a palm that faces the camera.

    Parameters
    ----------
    taking_part : callable (ups) → TakingPart
    fit : callable (TakingPart) → FitResult
    ups
        As for :func:`looked_at_again`.

    Returns
    -------
    FitResult
        With the seconds and the evaluations of both.
    """
    part = taking_part(ups)
    result = fit(part)
    if result.status == "ok" or not part.floor_elsewhere:
        return result
    try:
        whole = taking_part(ups[:1])
    except InputError:  # of a wide wall: with it the scan is none that can be worked with
        return result
    other = fit(whole)
    best, words = (result, _FLOOR) if result.probability >= other.probability else (other, _NO_FLOOR)
    return _with_costs(replace(best, message=f"{best.message}; {words}"), other, result)


def within_the_rig(taking_part, fit, result, points, rig, scales):
    """A fit in doubt, or a likelier one without what goes on beyond the rig's end, such as the forearm of a hand.

    What lies beyond is told by a fit: by the one in doubt, which may be right but for what it cannot explain; then, of a scan
    longer than the rig, by the likelier of the fits of its two ends. One that leaves nothing of this in doubt ends the search.

    Parameters
    ----------
    taking_part : callable (among) → TakingPart
    result : FitResult
        The one in doubt.
    fit, points, rig
        As for :func:`looked_at_again`.
    scales : sequence of float
        Scan units in a rig unit that the scan may have.

    Returns
    -------
    FitResult
        With the seconds and the evaluations of all.
    """
    look = _Look(taking_part, fit, result, points, rig)
    best = max((result, look.without_what_is_beyond(result)), key=_probability)
    if best.status != "ok":
        for ends in cuts(points[look.rows], end_of(rig), scales):
            there = max((look.at(one(points)) for one in ends), key=_probability)
            best = max((best, look.without_what_is_beyond(there)), key=_probability)
            if best.status == "ok":
                break
    return replace(best, seconds=look.seconds, evaluations=look.evaluations)


def _probability(result):
    return -1.0 if result is None else result.probability


class _Look:
    """Fits of parts of one scan, and what all of them have cost."""

    def __init__(self, taking_part, fit, first, points, rig):
        self._taking_part, self._fit, self._points, self._rig = taking_part, fit, points, rig
        self.seconds, self.evaluations = first.seconds, first.evaluations
        self.rows = taking_part(None).rows  # floors and what else takes no part goes on from no end

    def at(self, among):
        """The fit of these points; None where they are none that can be worked with."""
        try:
            part = self._taking_part(among)
        except InputError:
            return None
        other = self._fit(part, True)
        self.seconds, self.evaluations = other.seconds, self.evaluations + other.evaluations
        return other

    def without_what_is_beyond(self, found):
        """The fit without the points beyond the end that another fit has found.

        None where there is none or where its joints are guesses, where these points are too few or too many, or where the fit
        without them does not find them beyond its own end.
        """
        if found is None or not self._tells(found):
            return None
        past = beyond(self._points, self._rig, found)
        if not _LEAST <= past[self.rows].mean() <= _MOST:
            return None
        other = self.at(~past)
        if other is None or not self._tells(other) or beyond(self._points[past], self._rig, other).mean() < _STILL:
            return None
        return other

    def _tells(self, found):
        """Whether the scan tells where most of the joints are."""
        guesses = found.joint_std > GUESS * self._rig.size * found.scale
        return guesses[self._rig.moving].mean() <= _GUESSES
