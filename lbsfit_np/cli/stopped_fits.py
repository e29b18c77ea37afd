"""Fits that a run had written when it, or a process of its, was stopped, but had not noted yet."""

import os
from contextlib import suppress

from ..errors import FileError
from . import scan_results

__all__ = ["named", "settled"]


def named(files):
    """The files of fits that are there before a run: path → what is another where another file takes its place."""
    there = {}
    for path in (path for f in files for path in _of(f)):
        with suppress(OSError):
            there[path] = _identity(path)
    return there


def settled(files, before, notes=()):
    """Entries, by name, of the scans that a run has written fits of.

    Parameters
    ----------
    files : list of ScanFiles
        Of the scans that have no entry.
    before : dict
        What :func:`named` said when the run began.
    notes : list of str
        What is to be said of them.
    """
    from ..fitting.result import FitResult

    entries, now = {}, named(files)
    for f in files:
        if all(path in now and now[path] != before.get(path) for path in _of(f)):
            with suppress(FileError):
                entries[f.name] = scan_results.fitted_entry(f, FitResult.load(f.fit), notes=notes)
    return entries


def _of(files):
    return files.fit, files.mesh, files.labels


def _identity(path):
    found = os.stat(path)
    return found.st_ino, found.st_mtime_ns, found.st_size
