"""Reports of runs that go on where an earlier one stopped."""

from collections.abc import Iterable
from copy import deepcopy
from itertools import count

from ..errors import InputError, Unforeseen, brief, is_whole
from ..learning.checkpoint import digest_of

__all__ = [
    *("REMEDY", "begun", "check_same", "checked_count", "checked_seeds", "counted_by", "described"),
    *("in_order", "is_done", "renewed", "unforeseen"),
]

REMEDY = "Choose another folder, or --existing replace."

# What runs have found, and of what; all else that a report without results has is constant.
_FOUND = ("rows", "seeds", "rigs")


def begun(before, empty, *, same=("settings",)):
    """The report to go on with.

    Parameters
    ----------
    before : dict or None
        What an earlier run has written.
    empty : dict
        The report of a run without results: "benchmark", what has to be the same, and what else every report has.
    same : sequence of str
        Keys of what has to be the same; of dicts, each key of theirs.

    Returns
    -------
    dict
        ``empty`` itself where there is no earlier report, else a copy of that.

    Raises
    ------
    InputError
        A report of another benchmark or of other settings, or one that lacks what every report has.
    """
    if before is None:
        return empty
    theirs, ours = before.get("benchmark", "an unknown benchmark"), empty["benchmark"]
    if theirs != ours:
        raise InputError("before", f"results of {theirs}", f"results of {ours}", REMEDY)
    lacking = [key for key, value in empty.items() if key not in before or not _alike(before[key], value)]
    if lacking:
        got = f"results of {theirs} without {', '.join(map(repr, lacking))}"
        raise InputError("before", got, f"all that a run of this version writes: {', '.join(empty)}", REMEDY)
    theirs, ours = ({k: v for name in same for k, v in _named(name, of[name])} for of in (before, empty))
    other = [words for key in ours for words in _differing(key, theirs.get(key), ours[key])]
    if other:
        got, expected = map(", ".join, zip(*other, strict=True))
        raise InputError("before", f"results with {got}", expected, REMEDY)
    return deepcopy(before)


def renewed(report, empty):
    """A report to go on with, all that is constant as this version has it, and in its order, once it is known to be the same.

    Goals and the words for measures are not among what has to be the same. An environment of the whole report, as earlier
    versions wrote, is left out: each row has its own.
    """
    constant = {key: report[key] if key in _FOUND else value for key, value in empty.items()}
    return constant | {key: value for key, value in report.items() if key not in empty and key != "environment"}


def checked_seeds(seeds):
    """Seeds of scans as a list of numbers; InputError about ``seeds`` where they are none, twice the same, or below 0."""
    given = list(seeds) if isinstance(seeds, Iterable) else []
    if not all(is_whole(s, 0) for s in given) or not 0 < len(set(given)) == len(given):
        raise InputError("seeds", repr(seeds), "one or more different numbers of at least 0")
    return [int(s) for s in given]


def checked_count(argument, value, least=1, of=""):
    """A number of scans or the like as an int; InputError about ``argument`` where it is none, or below ``least``.

    ``of``: what the error says after the least.
    """
    if not is_whole(value, least):
        number = "" if is_whole(value) else "a whole number of "
        raise InputError(argument, brief(value), f"{number}at least {least}{of}")
    return int(value)


def counted_by(on_scan):
    """A function of outcomes that tells ``on_scan``, if there is one, how many there have been."""
    done = count(1)
    return None if on_scan is None else lambda outcome: on_scan(next(done))


def check_same(kept, now, whose=""):
    """InputError where a report has other facts than this run, of things that are told by their names alone.

    Parameters
    ----------
    kept, now : dict
        Of the report, and of this run; keys of the former alone count for nothing.
    whose : str, optional
        What the results are of, such as a rig's name.
    """
    other = ["rig" if key == "digest" else key.replace("_", " ") for key in now if kept.get(key) != now[key]]
    if other:
        got = f"results{whose and f' of {whose!r}'} with other {' and other '.join(other)} than this run's"
        raise InputError("before", got, f"results of the same {' and '.join(other)}", REMEDY)


def unforeseen(failures, before=None):
    """What a row's entry has where failures of its scans, number → why, may not be theirs: as of memory, or of a process.

    ``before`` has those of what the row builds on, such as scans to learn from.
    """
    kinds = {"unforeseen": failures, "unforeseen_before": before or {}}
    found = {name: [int(i) for i, why in of.items() if isinstance(why, Unforeseen)] for name, of in kinds.items()}
    return {name: numbers for name, numbers in found.items() if numbers}


def is_done(entry):
    """Whether a row needs not be made, or made again: its entry, None where there is none, has no unforeseen failures."""
    return entry is not None and not (entry.get("unforeseen") or entry.get("unforeseen_before"))


def in_order(seeds):
    """What is known by seed in the order of the numbers, whichever was made first: files have that of the alphabet."""
    return {seed: seeds[seed] for seed in sorted(seeds, key=int)}


def described(rig):
    """Of a rig all that fits depend on: its digest, and what that does not cover, much of it a card's; plain data for JSON."""
    still = [sorted(name for name, on in zip(rig.joint_names, mask, strict=True) if on) for mask in (rig.locked, rig.merged)]
    return {
        "digest": rig.digest,
        "up": rig.up,
        "forward": rig.forward,
        "metres_per_unit": rig.metres_per_unit,
        "joints_that_are_still": digest_of(still),
        "poses": rig.poses_digest,
    }


def _alike(theirs, ours):
    """Whether a dict stands where one belongs."""
    return isinstance(theirs, dict) or not isinstance(ours, dict)


def _differing(name, theirs, ours):
    """Pairs of words, of what is kept and of what this run has; of dicts only those for what differs in them."""
    if isinstance(theirs, dict) and isinstance(ours, dict):
        for key in ours | theirs:
            yield from _differing(f"{name} {key}", theirs.get(key), ours.get(key))
    elif theirs != ours:
        yield f"{name} {theirs}", f"{name} {ours}"


def _named(name, value):
    return value.items() if isinstance(value, dict) else [(name, value)]
