"""How large a learned subject is, in which unit it was learned, and what that leaves a new scan of it to be."""

from ..errors import InputError
from ..rig.units import METRES
from ..starts.scale import same_size, same_unit, unit_question, unit_scale
from .variants import as_variant

__all__ = [
    "allowed_unit",
    "doubted",
    "held_to",
    "learned_unit",
    "of_a_size_allowed",
    "other_size",
    "size_beside_taught",
    "template_size",
]

# A size nearer to the learned one than this factor is no news.
_NEWS = 1.02


def allowed_unit(fitter, subject, seen, settings):
    """Scan units in a rig unit where they are known: as learned, if what is seen of the scan allows that; else None."""
    if settings.scale == "fixed":
        return unit_scale(fitter.rig, settings.unit) or 1.0
    learned = learned_unit(fitter, subject, settings)
    return learned if same_size(seen, learned) else None


def of_a_size_allowed(fitter, subjects, settings):
    """The subjects whose learned sizes, where these are known, a fixed scale allows."""
    if subjects is None or settings.scale != "fixed" or not (settings.unit and fitter.learned_unit_):
        return subjects
    fixed = unit_scale(fitter.rig, settings.unit)
    ratios = {s: learned_unit(fitter, s, settings) / fixed for s in subjects}
    if not (allowed := [s for s, ratio in ratios.items() if same_size(ratio, 1.0)]):
        sizes = sorted(ratio * template_size(fitter, s) for s, ratio in ratios.items())
        low, high = f"{sizes[0]:.2f}", f"{sizes[-1]:.2f}"
        who = f"subject {subjects[0]!r}, who is" if len(subjects) == 1 else f"the {len(subjects)} subjects, who are"
        got = f"'fixed', the rig's size, for {who} {low if low == high else f'{low} to {high}'} times as large"
        raise InputError("scale", got, "'estimate'", "Leave it out (--scale estimate): the size was learned.")
    return allowed


def learned_unit(fitter, subject, settings):
    """Scan units in a rig unit, as learned."""
    learned = fitter.unit_[subject]
    if settings.unit and fitter.learned_unit_:  # the subject's size is known then, in whatever unit it was scanned
        learned *= METRES[fitter.learned_unit_] / METRES[settings.unit]
    return learned


def template_size(fitter, subject):
    """Of a subject's template, in sizes of the rig's own."""
    return fitter.template_[subject].size / fitter.rig.size


def size_beside_taught(fitter, subject):
    """Of a subject's template, in sizes of what s and the library have learned from: such templates, or the rig's own."""
    return 1.0 if as_variant(fitter.variant).deformed else template_size(fitter, subject)


def doubted(fitter, subject, scale, settings):
    """A question, where a subject whose size was learned is of another one in the unit that was said; else empty."""
    learned = learned_unit(fitter, subject, settings)
    if not (settings.unit and fitter.learned_unit_) or settings.scale == "fixed" or same_size(scale, learned):
        return ""
    return f", and {scale / learned:.3g} times as large as learned{unit_question(settings.unit)}"


def other_size(fitter, subject, scale, settings):
    """What a scale that was found says of the subject's size, where that is not quite as learned; else empty."""
    ratio = scale / learned_unit(fitter, subject, settings)
    if not same_unit(ratio) or 1 / _NEWS < ratio < _NEWS:
        return ""  # of another unit, or as learned
    return f", and it is {ratio:.3g} times as large as learned"


def held_to(fitter, subject, result):
    """What a fit that has not gone well may owe to a fixed scale, where no unit is known; else empty."""
    learned = fitter.unit_[subject]
    known = fitter.scale != "fixed" or fitter.unit or fitter.learned_unit_
    if result.status == "ok" or known or same_size(learned, 1.0):
        return ""
    at = f"{learned:.3g} scan units in a rig unit, which scale 'fixed' does not allow"
    return f"; the template was learned at {at}: leave that out (--scale estimate) if the scans are as they were"
