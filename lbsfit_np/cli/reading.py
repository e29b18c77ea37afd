"""The scans of ``lbsfit learn``, read when it is their turn; each that cannot be used is told at once."""

import functools
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import FileError, LbsfitError, in_words
from ..interrupts import passing_interrupts
from . import scan_results
from .fit import read_scan

__all__ = ["Reading"]


@dataclass
class Reading:
    """The scans as callables for ``LBSFitter.fit``, each of which reports at once when it cannot be used."""

    paths: list
    options: dict
    least: int
    progress: object
    keep: bool
    scans: dict = field(default_factory=dict)
    failures: dict = field(default_factory=dict)
    notes: dict = field(default_factory=dict)

    @property
    def sources(self):
        """The scans as callables."""
        return [functools.partial(self.read, i) for i in range(len(self.paths))]

    def name(self, i):
        """The file name without its extension, or the path where others are called the same."""
        stem = Path(self.paths[i]).stem
        return stem if self._stems[stem] == 1 else self.paths[i]

    @functools.cached_property
    def _stems(self):
        return Counter(Path(p).stem for p in self.paths)

    def read(self, i):
        """Scan i; what is wrong with it is said, and raised."""
        try:
            with passing_interrupts():  # which are not the scan's fault
                scan = read_scan(self.paths[i], self.least, self.options)
        except LbsfitError as error:
            self.fail(i, str(error))
            raise
        except Exception as error:  # whatever is wrong with one scan is that scan's failure
            got = f"content that cannot be read ({in_words(error)})"
            foreseen = FileError(self.paths[i], got, "a scan")
            self.fail(i, str(foreseen))
            raise foreseen from error
        if self.keep:
            self.scans[i] = scan
        self.notes[i] = scan.notes
        self.progress("reading scans", (i + 1) / len(self.paths))
        self.progress.notes(self.name(i), scan.notes)
        return scan

    def unused(self):
        """Entries of the scans that have no fit."""
        return [
            {"name": self.name(i), "input": self.paths[i], "status": "failed", "message": self.why(i)}
            for i in sorted(self.failures)
        ]

    def why(self, i, message=None):
        """What became of scan i, by default of one without a fit, after what its file explains of that."""
        return scan_results.with_reasons(self.failures[i] if message is None else message, self.notes.get(i, ()))

    def fail(self, i, message):
        """Scan i cannot be used: said once."""
        if i not in self.failures:
            self.failures[i] = message
            self.progress.failed(self.name(i), message)
