"""A scan may show several things that stand apart, such as two people, or a person and a chair: each is fitted by itself."""

from dataclasses import replace

from ..errors import InputError
from ..starts.apart import things_apart

__all__ = ["APART", "looked_at_apart"]

# Why the points of the others take no part.
APART = "the scan seems to show several things that stand apart"
# Where the second of them has this share of the points it is no limb that a view shows by itself. Then things are fitted before a
# pose of all is looked for at length, and one that is right with the probability _SURE is looked at no further.
_NO_LIMB, _SURE = 0.2, 0.8


def looked_at_apart(part, whole, taking_part, fit, points, *, settings, given=()):
    """The fit of a scan, or where that is in doubt, the likeliest of single things that stand apart in it, if that is right.

    Parameters
    ----------
    part : TakingPart
        Of the scan.
    whole : callable () → FitResult
        With all looks that are taken at a scan in doubt.
    taking_part : callable ((n,) bool array) → TakingPart
        Of these points alone.
    fit : callable (TakingPart) → FitResult
        Without a second look. Seconds go on from where the first fit began, as those of ``whole`` do.
    points : (n, 3) array
    settings : FitSettings
        With ``effort`` "fast" nothing is looked for.
    given : sequence of {"theta0", "labels"}
        What the caller knows. Labels say what is of the body: then nothing is looked for either.

    Returns
    -------
    FitResult
        With the seconds and the evaluations of all.
    """
    things = [] if settings.effort == "fast" or "labels" in given else things_apart(points, part.rows)
    if not things:
        return whole()
    fits, best = [], None
    if things[1][part.rows].mean() >= _NO_LIMB:
        fits.append(fit(part))
        if fits[0].probability >= _SURE or not fits[0].evidence:  # without skinning nothing speaks for a fit or against it
            return fits[0]
        best = _likeliest(things, taking_part, fit, fits)
        if best is not None and best.probability >= _SURE:
            return _with_costs(best, fits)
    fits.append(whole())
    result = fits[-1]
    if result.status != "ok" and result.evidence and best is None:
        best = _likeliest(things, taking_part, fit, fits)
    if best is not None and result.status != "ok":
        result = best
    return _with_costs(result, fits)


def _likeliest(things, taking_part, fit, fits):
    """The likeliest fit of one thing that is "ok", or None; all are added to ``fits``."""
    found = []
    for among in things:
        try:
            part = taking_part(among)
        except InputError:  # such as of too few points, or of another unit
            continue
        found.append(fit(part))
    fits += found
    return max((one for one in found if one.status == "ok"), key=lambda one: one.probability, default=None)


def _with_costs(result, fits):
    return replace(result, seconds=fits[-1].seconds, evaluations=sum(one.evaluations for one in fits))
