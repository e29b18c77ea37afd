"""A collection read and checked: its scans in one unit, bad ones set aside, some held out to tell when to stop."""

import itertools
import os
from collections import Counter
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..errors import InputError, brief, in_words
from ..interrupts import passing_interrupts
from ..optimize.frame import Frame
from ..scan import Scan, check_points
from ..seeds import generator
from ..starts.clean import taking_part
from ..starts.scale import extent, unit_scale
from .collection import Collection, Member
from .subjects import as_subjects, check_ids

__all__ = ["as_scans", "mixed_units", "odd_ones", "read_collection"]

# A pose folds or stretches a body by less than this; scans whose extents differ by more are in different units.
_ONE_UNIT = 6.0
# And crops make of it, as ``starts.scale`` has it.
_OF_PARTS = 18.0
# At most this share of the scans is left out where they differ by more; where it is more, nobody knows which are right.
_FEW = 0.1


def as_scans(scans):
    """A sequence of scans as a list, or InputError."""
    if isinstance(scans, (Mapping, Set)):
        remedy = "Pass list(scans.values())." if isinstance(scans, Mapping) else "Make a list: a set has no order."
        raise InputError("scans", f"a {type(scans).__name__}", "a sequence of scans", remedy)
    if isinstance(scans, (str, bytes, Scan)) or not hasattr(scans, "__iter__") or getattr(scans, "ndim", 1) == 0:
        remedy = "Put a single scan in a list." if isinstance(scans, Scan) else "Pass a list with load_scan(path) for each file."
        raise InputError("scans", f"a {type(scans).__name__}", "a sequence of scans", remedy)
    of_objects = getattr(getattr(scans, "dtype", None), "kind", "") == "O"
    if getattr(scans, "ndim", 1) == 2 and not of_objects:  # a data frame is one, too
        got = f"one array of shape {scans.shape}"
        raise InputError("scans", got, "a sequence of scans, (n, 3) each", "Put a single scan in a list.")
    scans = list(scans)
    path = next((s for s in scans if isinstance(s, (str, bytes, os.PathLike))), None)
    if path is not None:
        remedy = "Pass load_scan(path), or functools.partial(load_scan, path) to read it only when it is needed."
        raise InputError("scans", f"the path {brief(path)}", "points, Scans, or callables that return one", remedy)
    return scans


def read_collection(rig, scans, subjects, *, max_points, held_out, scale, random_state, unit=None, ups=None, cropped=False):
    """Read and check the scans of a collection.

    Parameters
    ----------
    rig : Rig
    scans : sequence
        Of points, Scans, or callables that return one.
    subjects : sequence or None
    max_points : int
    held_out : float
        Share of the scans to hold out, at least one where positive.
    scale : {"estimate", "fixed"}
    unit : str, optional
        The scans', where it is known: their extents may then differ as subjects' sizes do.
    ups : sequence of (3,) arrays, optional
    cropped : bool, default False
        As for ``starts.clean.taking_part``.
    random_state : int

    Returns
    -------
    Collection

    Raises
    ------
    InputError
        Subjects of the wrong number, ids that cannot be used, no scan that can be used, different units, too few scans to hold
        any out.
    """
    scans = as_scans(scans)
    if not scans:
        raise InputError("scans", "none", "one or more scans")
    subjects = [0] * len(scans) if subjects is None else as_subjects(subjects, len(scans))
    check_ids(subjects)
    collection, found = Collection(len(scans), asked=list(dict.fromkeys(subjects))), {}

    def looked_at(i, points, sure):
        known = {"scale": scale, "unit": unit, "ups": ups, "sure": sure, "cropped": cropped}
        return taking_part(points, rig, most=max_points, rng=generator(random_state, "thin", i), **known)

    for i, (source, subject) in enumerate(zip(scans, subjects)):
        try:
            with passing_interrupts():  # also where a reader takes them for an error of its own
                scan = source() if callable(source) else source
                points = check_points(scan, minimum=len(rig.parts))
                if callable(source):  # all are read before any is worked with, and a reader may use one array again
                    points = points.copy()
                part = looked_at(i, points, False)
        except Exception as error:  # noqa: BLE001 (whatever is wrong with one scan is that scan's failure)
            collection.failures[i] = in_words(error)
            continue
        path = getattr(scan, "path", None)
        found[i] = points, subject, f"{i}" if path is None else f"{path}", part
    doubtful = Counter(part.doubtful for *_, part in found.values())
    for i, (points, subject, name, part) in found.items():
        sure = False
        if part.doubtful is not None and 2 * doubtful[part.doubtful] < len(found):  # too few: flat sides of bodies, such as palms
            with suppress(InputError):  # a wide wall, with which the scan is none that can be worked with
                part, sure = looked_at(i, points, True), True
        frame = Frame(points[part.rows].mean(axis=0), part.scale * rig.size / 2)
        collection.members.append(Member(i, points, part, frame, subject, part.scale, name=name, sure=sure))
    if not collection.members:
        first = next(iter(collection.failures.values()))
        raise InputError("scans", f"{len(scans)}, none of which can be used (the first: {first})", "scans that can be used")
    apart = _OF_PARTS if cropped else _ONE_UNIT
    _set_units(collection, rig.size / 2, _common_unit(collection, apart) if unit is None else unit_scale(rig, unit))
    _hold_out(collection, held_out, random_state)
    return collection


def odd_ones(sizes, most):
    """Rows of positive sizes unlike the others: where they span too much, those far from the largest group between gaps.

    Parameters
    ----------
    sizes : (n,) array
    most : float
        Ratio of the largest to the smallest up to which all are alike, and to the group's middle beyond which one is not.

    Returns
    -------
    int array
    """
    order = np.argsort(sizes)
    gaps = np.diff(np.log(sizes[order]))
    if gaps.sum() <= np.log(most):
        return np.empty(0, dtype=int)
    groups = np.split(order, np.flatnonzero(gaps >= gaps.max() / 2) + 1)
    middle = np.median(np.log(sizes))
    typical = [sizes[group[len(group) // 2]] for group in groups]
    # Of groups as large the one nearest to the middle, of two as near the smaller.
    apart = [round(abs(np.log(size) - middle), 9) for size in typical]
    *_, typical = max((len(group), -away, -size, size) for group, away, size in zip(groups, apart, typical))
    return np.flatnonzero(np.abs(np.log(sizes / typical)) > np.log(most))


def mixed_units(got, others="", *, of_one=False):
    """The InputError of a collection whose scans are in different units, as ``got`` says, with ``others`` as a first remedy.

    ``of_one``: the scans are taken to be of one subject, which may be wrong.
    """
    subjects = "name their subjects (--subjects), " if of_one else ""
    remedy = f"{others}Convert them, {subjects}learn from each unit separately, or leave out the wrong scans."
    return InputError("scans", f"different units: {got}", "scans of one collection in one unit", remedy)


def _common_unit(collection, apart):
    """The unit that most members are in; a few that are in another are left out, and a mixture is refused."""
    extents = np.array([extent(m.x) for m in collection.members])
    odd = odd_ones(extents, apart)
    others = np.median(np.delete(extents, odd))
    if len(odd) > _FEW * len(extents):
        at = ", ".join(collection.members[i].name for i in odd[:5]) + ", …" * (len(odd) > 5)
        least, most = (f"{size:.3g}" for size in (extents[odd].min(), extents[odd].max()))
        have = f"scan {at} has an extent" if len(odd) == 1 else f"scans {at} have extents"
        raise mixed_units(f"{have} of {least if least == most else f'{least} to {most}'}, the others about {others:.3g}")
    for m, size in ((collection.members[i], extents[i]) for i in odd):
        got = f"an extent of {size:.3g}, where the other scans have about {others:.3g}"
        remedy = "The scan is left out: convert it and learn again."
        what = "points" if m.name == f"{m.index}" else m.name  # its number is said with every failure, its file is not
        collection.failures[m.index] = str(InputError(what, got, "scans of one collection in one unit", remedy))
    collection.members = [m for i, m in enumerate(collection.members) if i not in odd]
    return collection.unit_by_extents


def _set_units(collection, half, unit):
    """All members get one unit; their first fits find it better."""
    for m in collection.members:
        m.unit, m.frame = unit, replace(m.frame, unit=unit * half)


def _count(share, n):
    """How many of n scans are held out."""
    return max(1, round(share * n))


def _hold_out(collection, share, random_state):
    members = collection.members
    if not share:
        return
    count = _count(share, len(members))
    if len(members) - count < 2:
        enough = next(n for n in itertools.count(3) if n - _count(share, n) >= 2)
        raise InputError(
            "scans",
            f"{len(members)} that can be used",
            f"at least {enough}, so that {_count(share, enough)} can be held out to tell when to stop",
            "Give more scans, or hold fewer out; held_out=0 (--held-out 0) learns from all for a fixed number of rounds.",
        )
    order = generator(random_state, "held out").permutation(len(members))
    # Each subject keeps two scans, or one at least, as long as that is possible: its template needs them.
    left = {s: len(collection.of(s)) for s in collection.subjects}
    taken = 0
    for needed in (3, 2, 1):
        for i in order:
            if taken < count and not members[i].held_out and left[members[i].subject] >= needed:
                members[i].held_out = True
                left[members[i].subject] -= 1
                taken += 1
