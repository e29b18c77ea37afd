"""Files that this package has written before, told from scans and from what others have drawn."""

import os
from pathlib import Path

from ..errors import FileError, listed
from .progress import say
from .summary import SUMMARY

__all__ = ["ENDINGS", "drawn_by_others", "is_fit", "results_beside", "without_results"]

# What follows the name of a scan in its files.
ENDINGS = {"fit": ".fit.npz", "mesh": ".mesh.ply", "labels": ".labels.ply", "picture": ".png"}


def without_results(sources):
    """The scans but for results of others of them that this package has written beside these, which a line tells.

    Patterns such as ``*.ply`` name both where results go into the folder of the scans, and the same command has to mean the same
    once there are some. A result that is given without its scan is one itself.
    """
    if left := _results_among(sources):
        which, names = ("which is a result", "its scan") if len(left) == 1 else ("which are results", "their scans")
        words = f"skipped {len(left)} of {len(sources)} files, {which} that lbsfit has written beside {names}: "
        words += listed([os.path.basename(s) for s in sources if s in left], 3)
        say(f"{words}; to fit such a file as a scan, give it without its scan")
    return [s for s in sources if s not in left]


def results_beside(scans):
    """Results of these scans that :func:`without_results` leaves out where a pattern names them as well."""
    beside = {os.path.join(os.path.dirname(s), f"{Path(s).stem}{ending}") for s in scans for ending in ENDINGS.values()}
    beside |= {os.path.join(os.path.dirname(s), SUMMARY) for s in scans}
    there = {path for path in beside if os.path.isfile(path)}
    return sorted(_results_among([*scans, *there]) & there)


def _results_among(sources):
    """Those of some files that are results of others of them."""
    scans = {_place(s, Path(s).stem) for s in sources if not s.endswith(ENDINGS["picture"])}
    left = {s for s in sources if any(s.endswith(ending) and _is_result(s, ending, scans) for ending in ENDINGS.values())}
    folders = {_place(s, SUMMARY) for s in left}
    return left | {s for s in sources if os.path.basename(s) == SUMMARY and _place(s, SUMMARY) in folders}


def _is_result(source, ending, scans):
    """Whether a file with that ending is of a fit beside it, whose scan is one of these: places and names."""
    name = os.path.basename(source).removesuffix(ending)
    if _place(source, name) not in scans:
        return False
    ours = is_fit(os.path.join(os.path.dirname(source), name + ENDINGS["fit"]))
    return ours and (ending != ENDINGS["picture"] or not drawn_by_others(source))


def is_fit(path):
    """Whether there is a fit that this package has written, by whichever of its versions."""
    from ..io.npz import RESULT_KEY, npz_keys

    try:
        return RESULT_KEY in npz_keys(path)
    except FileError:
        return False


def _place(source, name):
    return os.path.abspath(os.path.dirname(source)), name


def drawn_by_others(picture):
    """Whether there is a file at a picture's place that this package has not drawn."""
    from ..report.render import is_signed

    try:
        return os.path.exists(picture) and not is_signed(picture)  # a link to nothing is in nobody's way
    except OSError:  # one that cannot be read is not for drawing over
        return True
