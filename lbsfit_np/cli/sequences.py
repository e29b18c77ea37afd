"""Scans in order of time, as their names tell it."""

import re
from pathlib import Path

__all__ = ["order_note"]


def order_note(paths):
    """In words, that numbered files are not in order of their numbers, as shells sort names by their text; else empty."""
    last = {}
    for path in map(Path, paths):
        found = re.fullmatch(r"(.*?)(\d+)(\D*)", path.stem)
        if not found:
            continue
        like, number = (path.parent, found[1], found[3]), int(found[2])
        before, name = last.get(like, (-1, ""))
        if number < before:
            advice = "Shells sort names by their text; $(ls -v ...) gives them by number"
            return f"{path.name} is given after {name}, which is no order of numbers. {advice}."
        last[like] = number, path.name
    return ""
