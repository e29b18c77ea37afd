"""The reference scale: how many of the scan's units make one of the rig's, guessed from the two extents."""

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..rig.units import METRES, USUAL, WORDS, unit_name

__all__ = [
    "SUBJECTS",
    "ReferenceScale",
    "checked_extent",
    "extent",
    "extent_doubt",
    "likely_unit",
    "near_rows",
    "reference_scale",
    "same_size",
    "same_unit",
    "sizes_in",
    "unit_note",
    "unit_question",
    "unit_scale",
]

# Extents from a scan's median point beyond which nothing of a body lies.
_REACH = 1.5
# A point whose fifth neighbour is further away than this times the median's is clutter; tenfold density makes three.
_NEIGHBOURS, _LONELY = 6, 5.0

# A pose can fold a body to a fraction of its rest extent but hardly stretch it: a ratio in this range is one unit for both.
_SAME_UNIT = 0.4, 1.8
# Of a cropped scan there may be as little as this.
_CROPPED = 0.1
# What else helps where scales are fixed and a scan is smaller than that.
_PART = " If it shows a part of the body alone, give fit_scan its labels, or pass cropped=True (--cropped)."
# People of one unit differ by less than this factor.
_PEOPLE = 1.6
# Scans of one person, as fits find it, by less than this.
_ONE_PERSON = 1.35
# Subjects of one rig, such as young and old animals, by less than this one.
SUBJECTS = 4.0
# A size that is found further from the rig's than this makes one ask whether the unit is as was said.
_DOUBTED = 5.0
# Where none was said, units in which the size would be nearer than this are named.
_MAYBE = 3.0


@dataclass(frozen=True)
class ReferenceScale:
    """The guess, and what it rests on in words."""

    scale: float
    note: str


def unit_scale(rig, unit):
    """Scan units in a rig unit, of a scan in a unit that is known, by its name; None where ``unit`` is."""
    return None if unit is None else rig.metres_per_unit / METRES[unit]


def sizes_in(rig, unit):
    """What restricts ``PoseLibrary.starts`` to sizes that subjects may have in a known unit; nothing where ``unit`` is None."""
    return {} if unit is None else {"unit": unit_scale(rig, unit), "within": SUBJECTS}


def reference_scale(points, rig, mode, unit=None, *, whole=True, shown=None, cropped=False):
    """Scan units in a rig unit.

    Parameters
    ----------
    points : (n, 3) array
        Of the body: floors and wild points make an extent of their own.
    rig : Rig
    mode : {"estimate", "fixed"}
        ``fixed``: scan and rig are in one unit, 1; a scan whose extent cannot be the rig's is an error.
    unit : {"m", "cm", "mm", "in", "ft"}, optional
        The scan's, where it is known; the rig's is then known, too.
    whole : bool, default True
        False where the scan may be known to show a part of the body: in a fixed scale it may then be as small as it is.
    shown : (m,) bool array, optional
        The vertices on what the scan shows, where that is known: then it may be as small as these are in the rest pose. It may
        still be as large as the whole, as parts move apart.
    cropped : bool, default False
        Whether the scan may end before the body does, so that it may be smaller.

    Returns
    -------
    ReferenceScale
        ``estimate``: 1 where the extents allow it; else from metres, centimetres, millimetres or inches to the rig's unit, where
        that is known and the extents allow one of these; else the ratio of the extents. In a known unit: that one where the
        extents allow it or the scale is fixed; else, of a subject of another size, the ratio of the extents.

    Raises
    ------
    InputError
        As :func:`checked_extent`; a scan that is not in the rig's unit and shall be; one that is in another unit than said, as no
        subject is of such a size.
    """
    ratios = checked_extent(points) / np.array([_extent_of(rig, shown), _extent_of(rig, None)])
    ratio, least = ratios[1], _CROPPED if cropped else _SAME_UNIT[0]
    if unit is not None:
        return _in_known_unit(ratios, rig, mode, unit, whole, least)
    if mode == "fixed":
        if not least * whole <= ratio <= _SAME_UNIT[1]:
            got = f"'fixed' for a scan whose extent is {ratio:.3g} times the rig's"
            remedy = "Convert the scan, or pass scale='estimate' (--scale estimate), which finds the unit."
            raise InputError("scale", got, "a scan in the rig's unit", remedy + (_PART if ratio < 1 and not cropped else ""))
        return ReferenceScale(1.0, "scale fixed at 1")
    if _may_be(ratios, least):
        return ReferenceScale(1.0, "scan and rig are in one unit")
    fitting = {}
    if rig.metres_per_unit is not None:
        fitting = {name: rig.metres_per_unit / METRES[name] for name in USUAL}
        fitting = {name: unit for name, unit in fitting.items() if _may_be(ratios / unit, least)}
    if fitting:
        name, unit = min(fitting.items(), key=lambda item: abs(np.log(ratios[0] / item[1] / 0.9)))
        return ReferenceScale(unit, f"the scan seems to be in {WORDS[name]}: one rig unit is {unit:.6g} scan units")
    guess = float(ratios[_telling(ratios, least)])
    return ReferenceScale(guess, _guess(guess))


def _may_be(sizes, least, factor=1.0):
    """Whether a scan may be of the rig's size, up to a factor: by its extent in those of what it shows, and of the whole rig."""
    return bool(least / factor <= sizes[0] and sizes[1] <= _SAME_UNIT[1] * factor)


def _telling(sizes, least):
    """Of a scan that is not of the rig's size, which of the two says by how much."""
    return 0 if sizes[0] < least else 1


def _in_known_unit(ratios, rig, mode, unit, whole, least):
    scale, most = unit_scale(rig, unit), _SAME_UNIT[1]
    sizes = ratios / scale
    size = sizes[1]
    if mode == "fixed":
        if not least * whole <= size <= most:
            got = f"'fixed' for a scan in {unit!r} whose extent is {size:.3g} times the rig's"
            remedy = "Check unit (--unit), or pass scale='estimate' (--scale estimate), which finds the size."
            raise InputError("scale", got, "a scan of the rig's size", remedy + (_PART if size < 1 and least != _CROPPED else ""))
    elif not _may_be(sizes, least, SUBJECTS):
        k = _telling(sizes, least)
        whose = "the rig's" if k or ratios[0] == ratios[1] else "that of the rig's parts that it shows"
        raise InputError(
            "unit",
            f"{unit!r}, in which the scan's extent is {sizes[k]:.3g} times {whose}",
            f"the scan's unit, in which it is {least / SUBJECTS:g} to {most * SUBJECTS:g} times the rig's",
            "Pass the scan's unit, or None (--unit auto) to have it found; or correct the rig's unit in a card.",
        )
    same = mode == "fixed" or _may_be(sizes, least)
    return ReferenceScale(scale if same else float(ratios[_telling(sizes, least)]), f"the scan is in {WORDS[unit]}")


def _guess(ratio):
    return f"the scale is a guess from the extents: one rig unit taken as {ratio:.4g} scan units"


def unit_note(scale, rig, mode, *, guessed=False, unit=None, size=1.0):
    """In words, what a scale that was found, or guessed from extents, says of the scan's unit, or in a known one of its size.

    Parameters
    ----------
    scale : float
        Scan units in a rig unit.
    rig : Rig
    mode : {"estimate", "fixed"}
    guessed : bool, default False
    unit : {"m", "cm", "mm", "in", "ft"}, optional
        The scan's, where it is known.
    size : float, default 1
        Of the template that was fitted, in sizes of the rig: learned ones take up part of how large a subject is.
    """
    if unit is not None:
        return _size_note(scale / unit_scale(rig, unit) * size, mode, guessed, unit)
    if mode == "fixed":
        return "scale fixed at 1"
    if same_unit(scale):
        return "scan and rig are in one unit"
    name = likely_unit(scale, rig)
    if name is None and guessed:
        return _guess(scale)
    words = "is in another unit or of another size" if name is None else f"seems to be in {WORDS[name]}"
    also = _otherwise(scale * size, rig, name) if name in (None, "in") else ""
    return f"the scan {words}: one rig unit is {scale:.4g} scan units{also}"


def _size_note(size, mode, guessed, unit):
    words = WORDS[unit]
    if mode == "fixed":
        return f"the scan is in {words}, and its size is fixed at the rig's"
    if guessed:  # by extents, which a pose changes as much
        return f"the scan is in {words}"
    doubt = "" if 1 / _DOUBTED <= size <= _DOUBTED else unit_question(unit)
    return f"the scan is in {words}, and the subject is {size:.2f} times as large as the rig{doubt}"


def unit_question(unit):
    """What is asked of a scan whose size does not go with the unit that was said."""
    return f" (is the scan in {WORDS[unit]}?)"


def _otherwise(scale, rig, name):
    """How large the subject is in units that a scale may well be of, too: small animals in centimetres look like inches.

    ``scale`` is scan units in a rig unit, of a subject that is as large as the rig.
    """
    if rig.metres_per_unit is None:
        return ""
    metres = {word: METRES[unit] for unit, word in WORDS.items() if unit != name}
    if unit_name(rig.metres_per_unit) is None:
        metres["the rig's unit"] = rig.metres_per_unit
    sizes = {word: scale * unit / rig.metres_per_unit for word, unit in metres.items()}
    told = [f"in {word} {size:.2f}" for word, size in sizes.items() if 1 / _MAYBE <= size <= _MAYBE]
    if not told:
        return ""
    return f" ({' or '.join(told)} times as large as the rig: if the unit is known, pass unit or --unit)"


def extent_doubt(points, rig, unit):
    """In words, that a scan's extent cannot be the rig's in the unit of the scans around it; else empty.

    Parameters
    ----------
    points : (n, 3) array
    rig : Rig
    unit : float
        Scan units in a rig unit.
    """
    ratio = extent(points) / (extent(rig.vertices[~rig.loose]) * unit)
    if _SAME_UNIT[0] <= ratio <= _SAME_UNIT[1]:
        return ""
    return f"its extent is {ratio:.3g} times the rig's in the scans' unit: is it in another unit? Convert it and learn again"


def same_unit(scale):
    """Whether scan and rig are in one unit, as people of one unit may differ in size."""
    return abs(np.log(scale)) < np.log(_PEOPLE)


def same_size(scale, other):
    """Whether two scans of one person, with these scales, are in one unit."""
    return abs(np.log(scale / other)) < np.log(_ONE_PERSON)


def likely_unit(scale, rig):
    """The unit of ``USUAL`` that scans seem to be in; None where it is none of these, or the rig's unit is not known."""
    if rig.metres_per_unit is None:
        return None
    ratios = {name: scale * METRES[name] / rig.metres_per_unit for name in USUAL}
    name, ratio = min(ratios.items(), key=lambda item: abs(np.log(item[1])))
    return name if abs(np.log(ratio)) < np.log(_PEOPLE) else None


def near_rows(points, rows):
    """Rows of a scan without those of wild points, which would pull means and squared distances with them.

    Parameters
    ----------
    points : (n, 3) array
    rows : (k,) int array

    Returns
    -------
    rows : int array
        Those within reach of the median point whose neighbours are not much further away than others' are.
    dropped : int
    """
    from scipy.spatial import cKDTree

    x = points[rows]
    with np.errstate(all="ignore"):
        away = np.linalg.norm(x - np.median(x, axis=0), axis=1)
        kept = away <= _REACH * extent(x)
    if len(x) > _NEIGHBOURS:
        x = (x[kept] - np.median(x, axis=0)) / checked_extent(x[kept])
        apart = cKDTree(x).query(x, k=min(_NEIGHBOURS, len(x)))[0][:, -1]
        apart_at_all = apart[apart > 1e-9]  # some scans have many points several times
        kept[kept] = apart <= _LONELY * (np.median(apart_at_all) if len(apart_at_all) else 1.0)
    return rows[kept], int(len(rows) - kept.sum())


def checked_extent(points):
    """:func:`extent`, where it can be worked with.

    Raises
    ------
    InputError
        An extent of 0, as of a single point, or one too large or too small to compute with.
    """
    own = extent(points)
    if own == 0:
        got, expected = "an extent of 0: all points are at one place", "points that are spread over a surface"
        raise InputError("points", got, expected, "Check that the scan has coordinates.")
    if not 0 < own**2 < np.inf:
        largest = float(np.abs(points).max())  # as a unit in which the extent can be measured
        got = f"an extent of {largest * extent(points / largest):.3g}"
        raise InputError("points", got, "coordinates that double precision can square", "Give them in another unit.")
    return own


def _extent_of(rig, shown):
    """Of some of a rig's vertices in the rest pose; of all where these have none."""
    skin = rig.vertices[~rig.loose & (True if shown is None else shown)]
    return extent(skin) if (skin != skin[:1]).any() else extent(rig.vertices[~rig.loose])


def extent(points):
    """Twice the 95th percentile of the distance from the median point: a size that a few outliers do not change."""
    with np.errstate(all="ignore"):  # what is too large to square comes out as infinite, which the caller refuses
        away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        return 2 * float(np.percentile(away, 95) or away.max())  # 0 where nearly all points are at one place
