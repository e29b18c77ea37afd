"""What the scales of first fits say: scans, or subjects, that are in another unit than others, which extents may hide."""

import numpy as np

from ..starts.scale import same_size
from .collection import LEARNED_FROM
from .reading import mixed_units, odd_ones

__all__ = ["check_scales", "scale_of", "scale_warnings", "size_and_unit", "units_apart", "use_unit"]

# First fits' scales of one subject differ by less than this factor, unless scans are in two units.
_ONE_SCALE = 1.6
# Scales nearer to 1 than this factor are a matter of people's size, others of units; where joints stay, those nearer are no news.
_SIZE, _TOLD = 1.3, 1.02


def check_scales(members, scales, *, ends=False):
    """Compare first fits' scales; set scans apart that have another than their subject's others: extents hide a small factor.

    Parameters
    ----------
    members : list of Member
        Of one subject; they get their ``ratio``, those apart their ``doubt``, too. Of two either may be the odd one: both are in
        doubt, in the same words, and learned from.
    scales : (n,) array
        Scan units in a rig unit that the first fits found.
    ends : bool, default False
        Whether scans may go on beyond the end of the rig, which then counts for part of it where it was not found.

    Raises
    ------
    InputError
        Too many for single wrong fits: the scans are in two units.
    """
    scales = np.asarray(scales)
    odd = odd_ones(scales, _ONE_SCALE) if len(members) > 2 else np.empty(0, dtype=int)
    if len(odd) > max(1, 0.2 * len(scales)):  # a few may just be wrong
        ratio = scales[odd[0]] / np.median(np.delete(scales, odd))
        at = ", ".join(members[i].name for i in odd[:5]) + (", …" if len(odd) > 5 else "")
        got = f"scans {at} of subject {members[0].subject!r} have {ratio:.3g} times the scale of the others"
        raise mixed_units(got, "If they show more than the rig has, such as an arm, crop them. " if ends else "", of_one=True)
    for i, m in enumerate(members if len(members) > 1 else ()):
        m.ratio = float(scales[i] / np.median(np.delete(scales, [*odd, i])))  # the odd one of three would shift the others'
    if len(members) == 2:
        if not same_size(*scales):
            doubt = "the first fits of scans {} and {} have the scales {:.3g} and {:.3g}: "
            doubt += "are they in two units, or of two people? Convert one, or name two subjects (--subjects), and learn again"
            members[0].doubt = members[1].doubt = doubt.format(*(m.name for m in members), *scales)
        return
    others = any(m.role == LEARNED_FROM for i, m in enumerate(members) if i not in odd)
    for i in odd:
        members[i].doubt = f"{_other_scale(members[i])}: is it in another unit? Convert it and learn again"
        members[i].apart = others


def scale_of(members, scales):
    """A subject's scan units in a rig unit, as its first fits have found them.

    Scans that are set apart, or held out, have no say as long as there are others.

    Parameters
    ----------
    members, scales
        As for :func:`check_scales`.
    """
    taught = [scale for m, scale in zip(members, scales, strict=True) if m.role == LEARNED_FROM]
    return float(np.median(taught or scales))


def scale_warnings(members):
    """What to warn of before the rounds: scans of one subject whose first fits :func:`check_scales` found of another size.

    Parameters
    ----------
    members : list of Member
        Of one subject.

    Returns
    -------
    list of str
    """
    if len(members) == 2 and members[0].doubt:  # in the same words
        return [f"{members[0].doubt}; {' and '.join(dict.fromkeys(m.role for m in members))}"]
    told = []
    for m in members:
        if m.doubt:
            told.append(f"scan {m.name}: {m.doubt}; {m.role}")
        elif not same_size(m.ratio, 1.0):
            doubt = f"{_other_scale(m)}: is it in another unit, or is the fit wrong? Its result will tell"
            told.append(f"scan {m.name}: {doubt}; {m.role}")
    return told


def _other_scale(member):
    return f"its first fit has {member.ratio:.3g} times the scale of its subject's other scans"


def units_apart(scales):
    """What to say where subjects' scales differ by more than people do; "" where they do not.

    Parameters
    ----------
    scales : dict of subject to (n,) array
        Scan units in a rig unit that the first fits of its scans found.

    Returns
    -------
    str
    """
    units = {subject: float(np.median(found)) for subject, found in scales.items()}
    least, most = min(units, key=units.get), max(units, key=units.get)
    if units[most] < _ONE_SCALE * units[least]:
        return ""
    ratio = units[most] / units[least]
    words = f"scans of subject {most!r} have {ratio:.3g} times the scale of those of {least!r}: are they in another unit? "
    return words + "Each subject's template is learned in its own unit; if all scans are in one known unit, pass unit (--unit)"


def size_and_unit(scale, guess, *, grows):
    """What the scale of a subject's scans says of its size, and of their unit.

    Where it is near the guess, people differ in size: the template takes it up, all bones longer and thicker by that share.
    Otherwise it is the unit.

    Parameters
    ----------
    scale : float
        Scan units in a rig unit that first fits found.
    guess : float
        The same by the extents of all scans.
    grows : bool
        Whether templates take up the size.

    Returns
    -------
    size : float
        Of the template, in sizes of the rig.
    unit : float
        Scan units in a rig unit.
    """
    near, grown = (_SIZE, scale / guess) if grows else (_TOLD, 1.0)
    return (grown, guess) if 1 / near < scale / guess < near else (1.0, scale)


def use_unit(member, size, unit, half, root):
    """Put a scan into its subject's unit after its first fit, which is kept as its own where its scale is in doubt.

    Parameters
    ----------
    member : Member
    size, unit
        As from :func:`size_and_unit`.
    half : float
        Rig units in one of the frame.
    root : (3,) array
        The rig's root joint, in half sizes.
    """
    if member.doubt or not same_size(member.ratio, 1.0):
        member.own = member.state.scale * member.unit / size, member.state.theta, member.proba
    ratio = unit / member.unit
    member.use_frame(unit, half)
    # Templates grow about the root joint, scales about the origin: the root joint stays where it was found.
    moved = (member.state.scale / ratio - 1.0) * root
    member.state = member.state.replace(scale=1.0, translation=member.state.translation / ratio + moved, residual=None)
