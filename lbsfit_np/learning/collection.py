"""The scans of a collection made ready for the loop: read, checked, in one unit, grouped by subject; bad ones set aside."""

import itertools
import os
import warnings
from collections import Counter
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import InputError, brief, in_words
from ..fitting.confidence import SOMEBODY_ELSE
from ..optimize.frame import Frame
from ..optimize.problem import Problem
from ..scan import Scan, check_points
from ..seeds import generator
from ..starts.clean import taking_part
from ..starts.scale import extent
from .checkpoint import each_kept
from .subjects import as_subjects, check_ids

__all__ = [
    "APART",
    "Collection",
    "HELD_OUT",
    "LEARNED_FROM",
    "Member",
    "as_scans",
    "mixed_units",
    "most_failed",
    "odd_ones",
    "read_collection",
    "with_doubt",
]

# A pose folds or stretches a body by less than this; scans whose extents differ by more are in different units.
_ONE_UNIT = 6.0
# At most this share of the scans is left out where they differ by more; where it is more, nobody knows which are right.
_FEW = 0.1
# Where more than this share of the scans, and more than one, are of somebody else than their subject, subjects are wrong.
_STRANGERS = 0.1
# What the message of a scan says that teaches, of one that only tells when to stop, and of one that does neither.
LEARNED_FROM = "learned from"
HELD_OUT = "held out of learning"
APART = "not learned from"


@dataclass
class Member:
    """One scan of the collection and what is known of it so far.

    Attributes
    ----------
    index : int
        Which of the scans given.
    points : (n, 3) array
    rows : (k,) int array
        Points that take part in the optimisation.
    more : (l,) int array
        Further ones, which the last steps of a pose and templates look at as well.
    frame : Frame
        The normalised frame; its turn is found by the first fit.
    subject : object
        Its subject's id.
    unit : float
        Scan units in a rig unit, as far as is known.
    left_out : str
        Which of its points take no part, in words.
    name : str
        What errors call it: the file where it came from one, else the index.
    held_out : bool
        Held out of learning, to tell when to stop.
    X : (k, 3) array or None
        The points that take part, in the frame.
    proba : (k, n_parts) array or None
        What s says of them, in half precision.
    state : State or None
        Where its last fit has put it.
    loss : float
        L_c there.
    prior : ((J, 3) array, float) or None
        In a smoothed sequence, the angles that the pose is drawn to, and how much.
    noise : float
        σ²/n of its points, by which what all poses tell of each counts; 0: not at all.
    doubt : str
        What its result says first. Both of a subject's only two scans have it, in the same words.
    apart : bool
        Neither learned from nor asked when to stop: it is in another unit than its subject's others, or its first fit is wrong.
    ratio : float
        The scale of its first fit to that of its subject's others, odd ones left out; 1 where it is alone, or scales are fixed.
    own : (float, (J, 3) array, (k, n_parts) array or None) or None
        Where its unit is in doubt, the unit, angles and probabilities of the parts that its first fit found.
    """

    index: int
    points: np.ndarray
    rows: np.ndarray
    frame: Frame
    subject: object
    unit: float = 1.0
    left_out: str = ""
    name: str = ""
    held_out: bool = False
    X: np.ndarray = None
    proba: np.ndarray = None
    state: object = None
    loss: float = np.inf
    prior: tuple = None
    noise: float = 0.0
    more: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    doubt: str = ""
    apart: bool = False
    ratio: float = 1.0
    own: tuple = None

    @property
    def problem(self):
        """The points in the frame, made ready anew: kept for thousands of scans, what is ready would fill memory."""
        return Problem(self.X)

    @property
    def every(self):
        """Rows of all points that the last steps look at."""
        return np.union1d(self.rows, self.more)

    @property
    def dense_X(self):
        """These points in the frame."""
        return self.frame.inside(self.points[self.every]) if len(self.more) else self.X

    @property
    def role(self):
        """What it is to learning, in words."""
        return APART if self.apart else HELD_OUT if self.held_out else LEARNED_FROM

    def use_frame(self, unit, half, turn=None):
        """Put the scan into a normalised frame.

        Parameters
        ----------
        unit : float
            Scan units in a rig unit.
        half : float
            Rig units in one of the frame.
        turn : (3, 3) array, optional
            By default the one that it has.
        """
        self.unit = unit
        self.frame = Frame(self.frame.centre, unit * half, self.frame.turn if turn is None else turn)
        self.X = self.frame.inside(self.points[self.rows])


@dataclass
class Collection:
    """The members that can be fitted, and why others cannot.

    Attributes
    ----------
    n : int
        Scans given.
    members : list of Member
    failures : dict of int to str
    taught : dict of int to str
        What those were to learning that only failed when it was over.
    """

    n: int
    members: list = field(default_factory=list)
    failures: dict = field(default_factory=dict)
    taught: dict = field(default_factory=dict)
    warned: set = field(default_factory=set)

    @property
    def subjects(self):
        """Ids in the order of their first scans."""
        return list(dict.fromkeys(m.subject for m in self.members))

    def in_order(self, answers):
        """One entry for each scan given: the answer of its member, None where it could not be used."""
        found = {member.index: answer for member, answer in zip(self.members, answers, strict=True)}
        return [found.get(i) for i in range(self.n)]

    @property
    def roles(self):
        """What each scan given is or was to learning; None where it could not be used."""
        known = self.taught | {m.index: m.role for m in self.members}
        return [known.get(i) for i in range(self.n)]

    def of(self, subject):
        """The members of one subject."""
        return [m for m in self.members if m.subject == subject]

    def with_role(self, role, subject=None):
        """The members of that role, of all subjects or one."""
        return [m for m in self.members if m.role == role and (subject is None or m.subject == subject)]

    def keep_one_held_out(self):
        """Hold another scan out where none is any more, of the subject whose template misses it least."""
        if self.with_role(HELD_OUT) or len(self.with_role(LEARNED_FROM)) < 3:
            return
        most = max(self.subjects, key=lambda s: len(self.with_role(LEARNED_FROM, s)))
        self.with_role(LEARNED_FROM, most)[-1].held_out = True

    def work(self, work, tasks, *, jobs, done, kept=(), taught=False):
        """Do a task for each member; one whose task fails is a member no more, with the reason in ``failures``.

        Parameters
        ----------
        work : callable (task) → answer
        tasks : sequence
            One for each member.
        jobs, done
            As in ``workers.each``.
        kept : sequence, optional
            Slots of a checkpoint, one for each member.
        taught : bool, default False
            Whether learning is over, which failures then say.

        Returns
        -------
        list
            The answers for those who are still members.

        Raises
        ------
        Exception
            The first one's own, where no task could be done.
        """
        found = each_kept(_Tried(work), tasks, kept, jobs=jobs, done=done, keep=lambda tried: tried[1] is None)
        errors = [error for _, error in found if error is not None]
        if errors and len(errors) == len(found):
            raise errors[0]
        for m, (_, error) in zip(self.members, found, strict=True):
            if error is not None:
                self.failures[m.index] = in_words(error)
                if taught:
                    self.taught[m.index] = m.role
                    self.failures[m.index] = f"{m.role}, but there is no result of it: {in_words(error)}"
        self.members = [m for m, (_, error) in zip(self.members, found, strict=True) if error is None]
        return [answer for answer, error in found if error is None]

    def warn(self, stacklevel, results=()):
        """Warn of failures that nobody was warned of yet; of results, where people are mixed up or most fits have failed."""
        new = sorted(set(self.failures) - self.warned)
        self.warned.update(new)
        if new:
            words = f"{len(new)} of {self.n} scans cannot be used; scan {new[0]}: {self.failures[new[0]]}"
            warnings.warn(words, stacklevel=stacklevel + 1)
        odd = [r.evidence.get("proportions", 0.0) > SOMEBODY_ELSE for r in results if r is not None]
        if sum(odd) > max(1, _STRANGERS * len(odd)):
            words = f"{sum(odd)} of {len(odd)} scans do not suit their subject's template; are they of several people? "
            words += "Say whose each scan is: subjects (--subjects)"
            warnings.warn(words, stacklevel=stacklevel + 1)
        if results and (words := most_failed(["failed" if r is None else r.status for r in results], self.roles)):
            warnings.warn(words, stacklevel=stacklevel + 1)


@dataclass(frozen=True)
class _Tried:
    """task → (answer, None), or (None, the error)."""

    work: object

    def __call__(self, task):
        try:
            return self.work(task), None
        except Exception as error:  # noqa: BLE001 (whatever is wrong with one scan is that scan's failure)
            return None, error


def as_scans(scans):
    """A sequence of scans as a list, or InputError."""
    if isinstance(scans, (Mapping, Set)):
        remedy = "Pass list(scans.values())." if isinstance(scans, Mapping) else "Make a list: a set has no order."
        raise InputError("scans", f"a {type(scans).__name__}", "a sequence of scans", remedy)
    if isinstance(scans, (str, bytes, Scan)) or not hasattr(scans, "__iter__"):
        remedy = "Put a single scan in a list, too." if isinstance(scans, Scan) else "Make a list of load_scan(path), one each."
        raise InputError("scans", f"a {type(scans).__name__}", "a sequence of scans", remedy)
    if isinstance(scans, np.ndarray) and scans.dtype != object and scans.ndim == 2:
        got = f"one array of shape {scans.shape}"
        raise InputError("scans", got, "a sequence of scans, (n, 3) each", "Put a single scan in a list, too.")
    scans = list(scans)
    path = next((s for s in scans if isinstance(s, (str, bytes, os.PathLike))), None)
    if path is not None:
        remedy = "Read it: load_scan(path), or functools.partial(load_scan, path) to have it read when it is its turn."
        raise InputError("scans", f"the path {brief(path)}", "points, Scans, or callables that return one", remedy)
    return scans


def read_collection(rig, scans, subjects, *, max_points, held_out, scale, random_state, ups=None):
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
    ups : sequence of (3,) arrays, optional
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
    collection, found = Collection(len(scans)), {}

    def looked_at(i, points, ups):
        return taking_part(points, rig, most=max_points, rng=generator(random_state, "thin", i), scale=scale, ups=ups)

    for i, (source, subject) in enumerate(zip(scans, subjects)):
        try:
            scan = source() if callable(source) else source
            points = check_points(scan, minimum=len(rig.parts))
            part = looked_at(i, points, ups)
        except Exception as error:  # noqa: BLE001 (whatever is wrong with one scan is that scan's failure)
            collection.failures[i] = in_words(error)
            continue
        path = getattr(scan, "path", None)
        found[i] = points, subject, f"{i}" if path is None else f"{path}", part
    below = Counter(part.below for *_, part in found.values())
    for i, (points, subject, name, part) in found.items():
        if part.floor_elsewhere and 2 * below[part.below] < len(found):  # too few: flat sides of bodies, such as palms
            with suppress(InputError):  # a wide wall, with which the scan is none that can be worked with
                part = looked_at(i, points, ups[:1])
        frame = Frame(points[part.rows].mean(axis=0), part.scale * rig.size / 2)
        known = {"unit": part.scale, "left_out": part.left_out, "name": name, "more": part.more}
        collection.members.append(Member(i, points, part.rows, frame, subject, **known))
    if not collection.members:
        first = next(iter(collection.failures.values()))
        raise InputError("scans", f"{len(scans)}, none of which can be used (the first: {first})", "scans that can be read")
    _check_units(collection, rig.size / 2)
    _hold_out(collection, held_out, random_state)
    return collection


def with_doubt(member, result):
    """A result that says first what is doubted of its scan."""
    return replace(result, message=f"{member.doubt}; {result.message}") if member.doubt else result


def most_failed(statuses, roles):
    """What to say where most fits have failed, of the scans that could be used, which have a role; "" where they have not."""
    used = [status for status, role in zip(statuses, roles, strict=True) if role is not None]
    if 2 * used.count("failed") <= len(used):
        return ""
    return "most fits have failed: do not trust what was learned; fit single scans first (lbs.fit_scan, lbsfit fit) and see why"


def odd_ones(sizes, most):
    """Rows of positive sizes that are not like the others: where they span too much, all but the largest group between gaps.

    Parameters
    ----------
    sizes : (n,) array
    most : float
        Ratio of the largest to the smallest up to which all are alike.

    Returns
    -------
    int array
    """
    order = np.argsort(sizes)
    gaps = np.diff(np.log(sizes[order]))
    if gaps.sum() <= np.log(most):
        return np.empty(0, dtype=int)
    groups = np.split(order, np.flatnonzero(gaps >= gaps.max() / 2) + 1)
    largest = max(range(len(groups)), key=lambda k: len(groups[k]))
    return np.sort(np.concatenate([g for k, g in enumerate(groups) if k != largest]))


def mixed_units(got):
    """The InputError of a collection whose scans are in different units, ``got`` in words."""
    remedy = "Convert them, learn from each kind by itself, or leave out those that are wrong."
    return InputError("scans", f"different units: {got}", "scans of one collection in one unit", remedy)


def _check_units(collection, half):
    """All members get the unit that most of them are in; leave a few out that are in another, and refuse a mixture."""
    extents = np.array([extent(m.points[m.rows]) for m in collection.members])
    odd = odd_ones(extents, _ONE_UNIT)
    others = np.median(np.delete(extents, odd))
    if len(odd) > _FEW * len(extents):
        at = ", ".join(collection.members[i].name for i in odd[:5]) + ", …" * (len(odd) > 5)
        raise mixed_units(
            f"scan {at} {'has' if len(odd) == 1 else 'have'} an extent of {extents[odd[0]]:.3g}, the others of about {others:.3g}"
        )
    for m, size in ((collection.members[i], extents[i]) for i in odd):
        got = f"an extent of {size:.3g}, the others of about {others:.3g}"
        remedy = "It is left out: convert it and learn again."
        what = "points" if m.name == f"{m.index}" else m.name  # its number is said with every failure, its file is not
        collection.failures[m.index] = str(InputError(what, got, "scans of one collection in one unit", remedy))
    collection.members = [m for i, m in enumerate(collection.members) if i not in odd]
    unit = float(np.median([m.unit for m in collection.members]))
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
            "Give more scans, or pass held_out=0 (--held-out 0) to learn from all for a fixed number of rounds.",
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
