"""A scan may show several things that stand apart, such as two people, or a person and a chair: each is fitted by itself."""

from dataclasses import replace

from ..errors import InputError
from ..starts.apart import things_apart

__all__ = ["APART", "looked_at_apart"]

# Why the points of the others take no part.
APART = "the scan seems to show several things that stand apart"
# A fit that is right with this probability is looked at no further.
_SURE = 0.8


def looked_at_apart(part, whole, taking_part, fit, points, *, settings, given=()):
    """The fit of a scan, or where that is in doubt, the likeliest of single things that stand apart in it, if that is right.

    Things are fitted before a pose of all is looked for at length.

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
        With ``effort`` "fast" nothing is looked for, nor where scans are cropped: what is left of a body may be in pieces.
    given : sequence of {"theta0", "labels"}
        What the caller knows. Labels say what is of the body: then nothing is looked for either.

    Returns
    -------
    FitResult
        With the seconds and the evaluations of all.
    """
    no_need = settings.effort == "fast" or settings.cropped or "labels" in given
    things = [] if no_need else things_apart(points, part.rows)
    if not things:
        return whole()
    fits = [fit(part)]
    if fits[0].probability >= _SURE or not fits[0].evidence:  # without skinning nothing speaks for a fit or against it
        return fits[0]
    best = _likeliest(things, taking_part, fit, fits)
    if best is None or best.probability < _SURE:
        fits.append(whole())
        best = fits[-1] if best is None or fits[-1].status == "ok" else best
    return replace(best, seconds=fits[-1].seconds, evaluations=sum(one.evaluations for one in fits))


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
