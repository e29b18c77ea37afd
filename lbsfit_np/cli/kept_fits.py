"""Fits of earlier runs that ``--existing skip`` leaves alone: those that it keeps, once it is sure what they were made with."""

import functools
from collections import Counter

import numpy as np

from ..errors import FileError, InputError, counted, listed
from ..io.npz import RESULT_KEY, npz_keys, read_npz
from . import scan_results
from .progress import say

__all__ = ["left_alone"]

# Of fits that were made with other settings, so many kinds are told one by one.
_KINDS = 3
# Points that are as near, as a share of the scan's extent, are the same, read by other libraries.
_SAME = 1e-6


def left_alone(files, fitter, subjects, read):
    """Entries, by name, of the scans whose fits are there and whole; InputError where one was made with something else.

    Those of another version's format are not kept, as nobody knows what they say; they are left to that version all the same,
    and their scans have no fit in this run.

    Other settings, such as another effort, are no error: of some scans one may want what is too slow for all. A line tells them,
    and fits of other points than ``read`` (path → Scan) finds now. To read a scan is nothing beside fitting it, and neither names
    nor times of files say whether it is the same one.
    """
    from ..fitting.result import FitResult
    from ..learning.made_with import settings_of

    entries, rig = {}, fitter.rig
    made, now, others, differ, unread = _MadeWith(fitter), settings_of(fitter), Counter(), [], []
    for f in files:
        if not f.fit.is_file():
            continue
        try:
            result = FitResult.load(f.fit)
        except FileError as error:
            _check_ours(f.fit, error)
            if _is_of_another_format(f.fit):
                words = f"{f.fit.name} is not kept: it has {error.got}, this version reads {error.expected}"
                entries[f.name] = scan_results.unfitted_entry(f, f"{words}; --existing replace fits the scan again")
                say(f"{f.name}: {entries[f.name]['message']}")
                continue
            say(f"{f.name}: {f.fit} cannot be read ({error.got}; expected {error.expected}), so the scan is fitted again")
            continue
        if result.rig_digest != rig.digest:
            raise InputError(
                "--existing skip",
                f"{f.fit}, a fit of another rig (or of this rig with other parts or limits)",
                f"fits of rig {rig.name!r}",
                "Choose another folder, or --existing replace.",
            )
        if result.model_digest not in made.wanted(subjects[f.name]):
            raise made.refusal(f, result)
        if result.unit != (fitter.unit or ""):
            said = [f"in {unit!r}" if unit else "in an unspecified unit" for unit in (result.unit, fitter.unit)]
            remedy = "Give --unit as in that run (auto: unspecified), choose another folder, or --existing replace."
            raise InputError("--existing skip", f"{f.fit}, a fit of a scan {said[0]}", f"fits of scans {said[1]}", remedy)
        if not all(path.is_file() and path.stat().st_size for path in (f.mesh, f.labels)):
            continue
        try:
            labelled = _labelled(f, result)
        except FileError as error:
            why = f"{error.argument} cannot be used ({error.got}; expected {error.expected})"
            say(f"{f.name}: {why}, so the scan is fitted again")
            continue
        if f.picture is not None and not scan_results.is_picture_of(f.fit, f.picture):
            for note in scan_results.draw(f, rig, labelled, result):
                say(f"{f.name}: {note}")
        entries[f.name] = scan_results.fitted_entry(f, result, kept=True)
        other = {name: result.settings.get(name) for name in now if result.settings.get(name) != now[name]}
        if other:
            entries[f.name]["other_settings"] = other if result.settings else None
            others[_in_words(other, now, result.settings)] += 1
        try:
            now_there = read(f.source).points
        except FileError as error:
            entries[f.name]["other_points"] = None
            unread.append((f.source, error))
        else:
            if not _are_same(labelled, now_there):
                entries[f.name]["other_points"] = True
                differ.append(f.source)
    _say_others(others)
    if differ:
        which = f"made of other points than those now in {listed(differ, 3)}, read with these options"
        which += "; delete their files to fit these again, or --existing replace fits all again"
        say(f"note: {counted(len(differ), 'kept fit')} {'was' if len(differ) == 1 else 'were'} {which}")
    if unread:
        first, error = unread[0]
        why = f"the first, {first}: " * (len(unread) > 1) + f"{error.got}; expected {error.expected}"
        which = f"not compared with {listed([source for source, _ in unread], 3)}, which cannot be read with these options: {why}"
        say(f"note: {counted(len(unread), 'kept fit')} {'was' if len(unread) == 1 else 'were'} {which}")
    return entries


def _check_ours(path, error):
    """Raise InputError about a file in a fit's place that is not to be replaced: one of others, or one that may not be read."""
    remedy = "Move it away, choose another folder, or --existing replace."
    try:
        with open(path, "rb") as file:
            file.read(1)
    except OSError:
        raise InputError("--existing skip", f"{path}, {error.got}", "fits that can be read", remedy) from None
    try:
        keys = npz_keys(path)
    except FileError:
        return  # damaged
    if RESULT_KEY not in keys:
        raise InputError("--existing skip", f"{path}, which is no fit", "fits that lbsfit has written", remedy)


def _is_of_another_format(path):
    """Whether a fit that cannot be read is whole, but as another version writes them."""
    from ..fitting.result import FORMAT

    try:
        return read_npz(path)[RESULT_KEY].tolist() != FORMAT
    except FileError:  # damaged
        return False


def _labelled(files, result):
    """The points that a fit has labelled, where its labels and its mesh are whole; the scan may be another by now."""
    from ..io.scans import load_scan

    sets = {}
    for path, n, of in ((files.mesh, len(result.vertices), "vertices"), (files.labels, len(result.labels), "points")):
        sets[of] = load_scan(path).points
        if len(sets[of]) != n:
            raise FileError(str(path), f"{len(sets[of])} {of}", f"the {n} of the fit")
    return sets["points"]


def _are_same(then, now):
    """Whether points are the same, but for rounding."""
    return len(now) == len(then) and np.allclose(now, then, rtol=0.0, atol=_SAME * np.ptp(then, axis=0).max())


def _say_others(others):
    """How many of the fits that are kept were made with what; of many kinds, the most frequent ones."""
    kinds = others.most_common(_KINDS)
    left = others.total() - sum(n for _, n in kinds)
    for words, n in [*kinds, *([("still other settings", left)] if left else [])]:
        say(f"note: {counted(n, 'kept fit')} {'was' if n == 1 else 'were'} made with {words}; --existing replace fits all again")


def _in_words(settings, now, known):
    """Settings that differ, as options; those that are not ``known`` came after the fit."""
    if settings.get("version", now) is None:  # which all have that have any
        return "unknown settings"
    then = {name: _option(name, value) if name in known else f"unknown {_flag(name)}" for name, value in settings.items()}
    return ", ".join(f"{words} (not {_option(name, now[name])})" for name, words in then.items())


def _flag(name):
    return "--seed" if name == "random_state" else f"--{name.replace('_', '-')}"


def _option(name, value):
    if name == "version":
        return f"lbsfit {value}"
    flag = _flag(name)
    if isinstance(value, dict):
        value = " ".join(f"{key}={part}" for key, part in value.items())
    if value is None or value is False or value == "":
        return f"no {flag}"
    return flag if value is True else f"{flag} {value}"


class _MadeWith:
    """What the fits of earlier runs may have been made with, by their digests."""

    def __init__(self, fitter):
        from ..learning.archive import learned_digests, model_digest

        self.rig, self.anybody, self.learned = fitter.rig, model_digest(fitter), learned_digests(fitter)
        self.named = functools.cache(lambda subject: model_digest(fitter, subject))

    def wanted(self, subject):
        """Of fits that are what is wanted of a scan of this subject, None where nobody says whose it is; learning's own, too."""
        if subject is None:
            return {self.anybody, *self.learned.values()}
        return {self.named(subject), self.learned[subject]}

    def refusal(self, files, result):
        """The InputError about a fit that was made with something else."""
        digest, remedy = result.model_digest, "Choose another folder, or --existing replace."
        if not self.anybody or not digest:
            words = "with a learned model" if digest else "without a model"
        else:
            words = "with another model"
            if digest == self.anybody:
                got = f"template of {result.subject!r}" if result.subject else "of none of its subjects"
                words = f"with this model and no subject named ({got})"
            for subject, learned in self.learned.items():
                if digest in (learned, self.named(subject)):
                    words = f"with this model as {str(subject)!r}"
            if words != "with another model":
                files_of = f"{files.name}.fit.npz, .mesh.ply and .labels.ply"
                remedy = f"Give --subject or --subjects as in that run, or leave them out as there; or delete {files_of} to fit "
                remedy += "the scan again; or choose another folder, or --existing replace."
        expected = "fits with this model and subject" if self.anybody else f"fits with rig {self.rig.name!r} alone"
        return InputError("--existing skip", f"{files.fit}, a fit {words}", expected, remedy)
