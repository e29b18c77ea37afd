"""Ids of subjects: those of a collection, and those that callers give for what was learned."""

from collections.abc import Mapping, Set
from unicodedata import normalize

from ..errors import InputError, brief, counted, did_you_mean, listed
from .plain import plain

__all__ = ["as_subjects", "check_ids", "known_subject", "known_subjects"]


def as_subjects(subjects, n):
    """Ids of ``n`` scans as a list, or InputError."""
    if isinstance(subjects, (Mapping, Set)):
        remedy = "Make a list, in the order of the scans."
        raise InputError("subjects", f"a {type(subjects).__name__}", "a sequence with one id for each scan", remedy)
    some = hasattr(subjects, "__len__") and hasattr(subjects, "__iter__") and getattr(subjects, "ndim", 1)
    if isinstance(subjects, (str, bytes)) or not some:
        raise InputError("subjects", brief(subjects), "a sequence with one id for each scan")
    subjects = list(map(plain, subjects))
    if len(subjects) != n:
        raise InputError("subjects", counted(len(subjects), "id"), f"{n}, one for each scan")
    return subjects


def check_ids(subjects):
    """InputError unless ids are text or whole numbers that differ as text, too: results and files have them so.

    True is 1 to a dict, and another text; "" is what a fit on no learned template has; blanks at the ends cannot be seen.
    """
    first = {}
    for i, s in enumerate(subjects):
        if isinstance(s, bool) or not isinstance(s, (str, int)):
            raise InputError("subjects", f"{brief(s)} for scan {i}", "ids that are text or whole numbers")
        if not isinstance(s, str) and abs(s) >= 2**63:  # Python refuses to write longer ones still as text
            raise InputError("subjects", f"{brief(s, 30)} for scan {i}", "whole numbers of at most 64 bits, or text")
        if isinstance(s, str) and (not s or s != s.strip()):
            raise InputError("subjects", f"{brief(s)} for scan {i}", "ids that are not empty, without blanks at their ends")
        j, other = first.setdefault(_text(s), (i, s))
        if other != s:
            got = f"{brief(other)} for scan {j} and {brief(s)} for scan {i}"
            remedy = "Write the id of one person in one way, and give different people different ids."
            raise InputError("subjects", got, "ids that differ as text, too: results and files store them as text", remedy)


def known_subjects(learned, subjects, n):
    """Ids of ``n`` scans as they stand in ``learned``, None where an id is None; InputError as :func:`known_subject`."""
    return [s if s is None else known_subject(learned, s, "subjects", i) for i, s in enumerate(as_subjects(subjects, n))]


def known_subject(learned, given, argument="subject", scan=None):
    """The id of a learned subject, by itself or by its text, as results and files have ids as text.

    Parameters
    ----------
    learned : dict of id, or None
        ``LBSFitter.template_``; None where nothing was learned.
    given : str or int
    argument : str, default "subject"
        What errors name.
    scan : int, optional
        Of several ids, the number of the scan that this one is for.

    Returns
    -------
    str or int
        As it stands in ``learned``.

    Raises
    ------
    InputError
        Nobody of that id.
    """
    given = plain(given)
    got = brief(given) if scan is None else f"{brief(given)} for scan {scan}"
    if learned is None:
        raise InputError(argument, got, "no subject, as nothing has been learned yet")
    if isinstance(given, (str, int)) and not isinstance(given, bool):
        known = {_text(s): s for s in learned} | {s: s for s in learned}
        found = known.get(given, known.get(_text(given)))
        if found is not None:
            return found
    others = "Fit scans of other people without it." if scan is None else "Pass None for scans of other people."
    remedy = (did_you_mean(given, learned) if isinstance(given, (str, int)) else None) or others
    raise InputError(argument, got, f"a learned subject: {listed(list(map(repr, learned)))}", remedy)


def _text(subject):
    """An id as results and files have it, accents in one way of writing them."""
    return normalize("NFC", subject if isinstance(subject, str) else brief(subject))
