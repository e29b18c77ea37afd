"""The scans of a collection as the loop has them: grouped by subject, each with its role and what is known of it so far."""

import warnings
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import in_words
from ..fitting.confidence import SOMEBODY_ELSE
from ..optimize.frame import Frame
from ..optimize.problem import Problem
from ..starts.clean import TakingPart
from ..workers import ProcessEnded
from .checkpoint import each_kept

__all__ = ["APART", "Collection", "HELD_OUT", "LEARNED_FROM", "Member", "most_failed", "with_doubt"]

# Where more than this share of the scans, and more than one, are of somebody else than their subject, subjects are wrong.
_STRANGERS = 0.1
# What the message of a scan says that teaches, of one that only tells when to stop, and of one that does neither.
LEARNED_FROM = "learned from"
HELD_OUT = "held out of learning"
APART = "not learned from"


@dataclass(eq=False)
class Member:
    """One scan of the collection and what is known of it so far.

    Attributes
    ----------
    index : int
        Which of the scans given.
    points : (n, 3) array
    part : TakingPart
        What of it takes part in the optimisation.
    frame : Frame
        The normalised frame; its turn is found by the first fit.
    subject : object
        Its subject's id.
    unit : float
        Scan units in a rig unit, as far as is known.
    name : str
        What errors call it: the file where it came from one, else the index.
    sure : bool
        As for ``starts.clean.taking_part``: its flat sides are the body's.
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
    first : ((J, 3) array or None, tuple of float)
        The angles that its first fit found, and what rivals of that left unexplained, in what it left itself.
    own : (float, (J, 3) array, (k, n_parts) array or None) or None
        Where its unit is in doubt, the unit, angles and probabilities of the parts that its first fit found.
    """

    index: int
    points: np.ndarray
    part: TakingPart
    frame: Frame
    subject: object
    unit: float = 1.0
    name: str = ""
    sure: bool = False
    held_out: bool = False
    X: np.ndarray = None
    proba: np.ndarray = None
    state: object = None
    loss: float = np.inf
    prior: tuple = None
    noise: float = 0.0
    doubt: str = ""
    apart: bool = False
    ratio: float = 1.0
    first: tuple = (None, ())
    own: tuple = None

    @property
    def problem(self):
        """The points in the frame, made ready anew: kept for thousands of scans, what is ready would fill memory."""
        return Problem(self.X)

    @property
    def x(self):
        """The points that take part, in the scan's own frame."""
        return self.points[self.part.rows]

    @property
    def dense_X(self):
        """All points that the last steps look at, in the frame."""
        return self.frame.inside(self.points[self.part.every]) if len(self.part.more) else self.X

    @property
    def role(self):
        """What it is to learning, in words."""
        return APART if self.apart else HELD_OUT if self.held_out else LEARNED_FROM

    def use_frame(self, unit, half, turn=None):
        """Put the scan into a normalised frame; its loss goes along.

        Parameters
        ----------
        unit : float
            Scan units in a rig unit.
        half : float
            Rig units in one of the frame.
        turn : (3, 3) array, optional
            By default the one that it has.
        """
        self.loss *= (self.unit / unit) ** 2
        self.unit = unit
        self.frame = Frame(self.frame.centre, unit * half, self.frame.turn if turn is None else turn)
        self.X = self.frame.inside(self.x)

    def take(self, part):
        """Have another part of the scan take part; what is known of the one before is as it was."""
        self.part, self.frame = part, replace(self.frame, centre=self.points[part.rows].mean(axis=0))


@dataclass
class Collection:
    """The members that can be fitted, and why others cannot.

    Attributes
    ----------
    n : int
        Scans given.
    members : list of Member
    failures : dict of int to str
    taught : dict of int to Member
        Those that only failed when learning was over.
    asked : list
        Ids of the subjects that were given.
    """

    n: int
    members: list = field(default_factory=list)
    failures: dict = field(default_factory=dict)
    taught: dict = field(default_factory=dict)
    asked: list = field(default_factory=list)
    warned: set = field(default_factory=set)
    told_lost: set = field(default_factory=set)
    _of_all = None  # the error that went on to the caller, as no task was done

    @property
    def subjects(self):
        """Ids in the order of their first scans."""
        return list(dict.fromkeys(m.subject for m in self.members))

    @property
    def unit_by_extents(self):
        """Scan units in a rig unit by what takes part of all members, as if they were in one unit."""
        return float(np.median([m.part.scale for m in self.members]))

    def in_order(self, answers):
        """One entry for each scan given: the answer of its member, None where it could not be used."""
        found = {member.index: answer for member, answer in zip(self.members, answers, strict=True)}
        return [found.get(i) for i in range(self.n)]

    @property
    def roles(self):
        """What each scan given is or was to learning; None where it could not be used."""
        known = {m.index: m.role for m in (*self.taught.values(), *self.members)}
        return [known.get(i) for i in range(self.n)]

    def of(self, subject):
        """The members of one subject."""
        return [m for m in self.members if m.subject == subject]

    def with_role(self, role, subject=None):
        """The members of that role, of all subjects or one."""
        return [m for m in self.members if m.role == role and (subject is None or m.subject == subject)]

    def keep_one_held_out(self):
        """Hold another scan out where none is any more, of the subject whose template misses it least; none where all are."""
        if not self.with_role(LEARNED_FROM):
            for m in self.members:
                m.held_out = False
        if self.with_role(HELD_OUT) or len(self.with_role(LEARNED_FROM)) < 3:
            return
        most = max(self.subjects, key=lambda s: len(self.with_role(LEARNED_FROM, s)))
        self.with_role(LEARNED_FROM, most)[-1].held_out = True

    def as_it_is(self):
        """A callable that brings back the members there are now, also those that have failed since, and what is known of them."""
        known = [(m, (m.state, m.loss, m.proba, m.noise, m.prior)) for m in self.members]

        def bring_back():
            self.members = [m for m, _ in known]
            for m, found in known:
                m.state, m.loss, m.proba, m.noise, m.prior = found
                self.failures.pop(m.index, None)

        return bring_back

    def unless_lost(self, work):
        """Do what may lose scans, or fail as it loses all; where it does, the scans are as they were before.

        Parameters
        ----------
        work : callable () → answer

        Returns
        -------
        answer : object
            None where it is not to be taken.
        lost : str
            Why a scan was lost; "" where none was.
        """
        back, before = self.as_it_is(), set(self.failures)
        try:
            answer = work()
            lost = next((why for i, why in self.failures.items() if i not in before), "")
        except Exception as error:
            if error is not self._of_all:  # of a caller's progress, say
                raise
            lost = _in_words(error)
        if not lost:
            return answer, ""
        back()
        return None, lost

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
        rank = {s: k for k, s in enumerate(self.subjects)}  # by subject: each process keeps few templates ready
        order = sorted(range(len(tasks)), key=lambda k: rank[self.members[k].subject])
        found = self._tried(work, tasks, kept, jobs, done, order)
        for m, (_, error) in zip(self.members, found, strict=True):
            if error is not None:
                self.failures[m.index] = why = _in_words(error)
                if taught:
                    self.taught[m.index] = m
                    self.failures[m.index] = type(why)(f"{m.role}, but it has no result: {why}")  # of the same kind
        self.members = [m for m, (_, error) in zip(self.members, found, strict=True) if error is None]
        return [answer for answer, error in found if error is None]

    def work_of_subjects(self, work, tasks, *, jobs, done, kept=()):
        """Do a task for each subject; of one whose task fails all scans are members no more. Arguments as for :meth:`work`.

        Returns
        -------
        dict
            Subject → answer, of those who are still there.
        """
        found = dict(zip(self.subjects, self._tried(work, tasks, kept, jobs, done), strict=True))
        for m in self.members:
            if (error := found[m.subject][1]) is not None:
                why = _in_words(error)  # of the same kind in these words
                self.failures[m.index] = type(why)(f"no template could be found for its subject: {why}")
        self.members = [m for m in self.members if found[m.subject][1] is None]
        return {s: answer for s, (answer, error) in found.items() if error is None}

    def _tried(self, work, tasks, kept, jobs, done, order=None):
        """(answer, None) or (None, error) of each task; the first error itself where no task could be done.

        ``order``: which task comes when; by default one after the other.
        """
        order = range(len(tasks)) if order is None else order
        tasks, kept = ([of[k] for k in order] if of else of for of in (tasks, kept))
        how = {"failed": lambda error: (None, error), "keep": lambda found: found[1] is None}
        made = each_kept(_Found(work), tasks, kept, jobs=jobs, done=done, **how)
        found = [answer for _, answer in sorted(zip(order, made, strict=True), key=lambda one: one[0])]
        errors = [error for _, error in found if error is not None]
        if errors and len(errors) == len(found):
            self._of_all = errors[0]
            raise errors[0]
        return found

    def warn(self, stacklevel, results=()):
        """Warn of failures, and of people without any scan, that nobody was warned of yet.

        Of results, where people are mixed up or most fits have failed.
        """
        new = sorted(set(self.failures) - self.warned)
        self.warned.update(new)
        if new:
            words = f"{len(new)} of {self.n} scans cannot be used; scan {new[0]}: {self.failures[new[0]]}"
            words += "; failures_ will name them all" if len(new) > 1 else ""
            warnings.warn(words, stacklevel=stacklevel + 1)
        known = {*self.subjects, *(m.subject for m in self.taught.values())}
        lost = [s for s in self.asked if s not in known and s not in self.told_lost]
        self.told_lost.update(lost)
        if lost:
            whose = f"subject{'s' * (len(lost) > 1)} {', '.join(repr(str(s)) for s in lost[:5])}" + ", …" * (len(lost) > 5)
            warnings.warn(f"nothing is learned for {whose}: none of their scans can be used", stacklevel=stacklevel + 1)
        odd = [r.evidence.get("proportions", 0.0) > SOMEBODY_ELSE for r in results if r is not None]
        if sum(odd) > max(1, _STRANGERS * len(odd)):
            words = f"{sum(odd)} of {len(odd)} scans do not match their subject's template; are they of several people? "
            words += "Name the subject of each scan: subjects (--subjects)"
            warnings.warn(words, stacklevel=stacklevel + 1)
        if results and (words := most_failed(["failed" if r is None else r.status for r in results], self.roles)):
            warnings.warn(words, stacklevel=stacklevel + 1)


@dataclass(frozen=True)
class _Found:
    """task → (answer, None): of one that fails (None, the error) is found."""

    work: object

    def __call__(self, task):
        return self.work(task), None


def _in_words(error):
    """Why a scan was lost: also one whose process was killed, as of memory, which another time may not be."""
    if isinstance(error, ProcessEnded):
        return error.of_its_scan
    return in_words(error)


def with_doubt(member, result):
    """A result that says first what is doubted of its scan; last, where that cannot be fitted in a unit of its own either."""
    if not member.doubt:
        return result
    words = [member.doubt, result.message]
    return replace(result, message="; ".join(words[::-1] if member.apart and result.status == "failed" else words))


def most_failed(statuses, roles):
    """What to say where most fits have failed, of the scans that could be used, which have a role; "" where they have not."""
    used = [status for status, role in zip(statuses, roles, strict=True) if role is not None]
    if 2 * used.count("failed") <= len(used):
        return ""
    return "most fits have failed: do not trust what was learned; fit single scans (lbs.fit_scan, lbsfit fit) to see why"
