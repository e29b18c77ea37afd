"""Scans in order of time, as their names tell it."""

import os
import re
from decimal import Decimal
from pathlib import Path

__all__ = ["order_note", "takes_note"]

# A minus is no dash between words: nothing that is a letter or a digit is before it. Exponents are short, so that no hash is one.
_NUMBER = re.compile(r"(?:(?<![^\W_])-)?\d+(?:\.\d+)?(?:[eE][+-]?\d{1,2}(?!\d))?")
_DIGITS = re.compile(r"\d+")


def takes_note(paths, subjects=None):
    """In words, that scans of one subject stand in several folders, as several recordings do; else empty."""
    last = {}
    for path, subject in zip(paths, subjects or [None] * len(paths), strict=True):
        before = last.setdefault(subject, path)
        if os.path.dirname(os.path.abspath(before)) != os.path.dirname(os.path.abspath(path)):
            return f"each subject's scans are one sequence: {before} and {path} are neighbours in it"
        last[subject] = path
    return ""


def order_note(paths, subjects=None):
    """In words, that numbered files are not in order of their numbers, as shells sort names by their text; else empty.

    Compared is each file with the last of the same subject, folder and name but for its numbers, where one number differs. 1.10
    may be a time before 1.9, or the tenth of something after the ninth: only what is no order by either is told.
    """
    last = {}
    for path, subject in zip(map(Path, paths), subjects or [None] * len(paths), strict=True):
        numbers = [Decimal(number) for number in _NUMBER.findall(path.stem)]
        digits = [int(number) for number in _DIGITS.findall(path.stem)]
        like = subject, path.parent, _NUMBER.sub("0", path.stem)
        before, digits_before, name = last.get(like, (numbers, digits, ""))
        changed = [(old, new) for old, new in zip(before, numbers, strict=True) if old != new]
        if len(changed) == 1 and changed[0][1] < changed[0][0] and digits < digits_before:
            advice = "Shells sort file names as text; on Linux, $(ls -v ...) sorts them by number"
            return f"{path.name} is given after {name}: these files are not in order of their numbers. {advice}."
        last[like] = numbers, digits, path.name
    return ""
