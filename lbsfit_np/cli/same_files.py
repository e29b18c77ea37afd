"""Paths that are one file, whatever they are called: inputs are never overwritten, and no scan is fitted twice."""

import os
import unicodedata

__all__ = ["Inputs", "folded", "identity", "same_file"]


class Inputs:
    """Files that are read, found again by their names and by what they are: as :func:`same_file`, of many at once."""

    def __init__(self, sources):
        self._files, self._names, self._missing = {}, {}, {}
        for source in sources:
            name = folded(os.path.abspath(source))
            self._names.setdefault(name, source)
            try:
                self._files.setdefault(identity(source), source)
            except (OSError, ValueError):
                self._missing.setdefault(name, source)

    def same(self, path):
        """The input that a path is, or would be where upper and lower case are the same; None where it is none."""
        name = folded(os.path.abspath(path))
        try:
            return self._files.get(identity(path), self._missing.get(name))
        except (OSError, ValueError):
            return self._names.get(name)


def identity(path):
    """What two paths have in common that are one file."""
    found = os.stat(path)
    return found.st_dev, found.st_ino


def same_file(a, b):
    """Whether two paths are one file, or would be where upper and lower case are the same."""
    try:
        return os.path.samefile(a, b)
    except (OSError, ValueError):
        return folded(os.path.abspath(a)) == folded(os.path.abspath(b))


def folded(text):
    """A name or path as file systems have it where upper and lower case are the same."""
    return unicodedata.normalize("NFC", str(text)).casefold()
