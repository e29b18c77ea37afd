"""All figures of the study, drawn from its report and from what it kept of each cell."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ...errors import InputError
from ...workers import each
from ..measure import joint_error
from . import charts, gallery
from .data import Size, part_groups, study_set
from .diagram import diagram
from .making import cell_name
from .page import FIGURES

__all__ = ["Shown", "draw"]

# Of each rig: function (Shown, path) → caption or None, and the rows whose arrays it needs.
_OF_RIGS = {
    "triplet": (gallery.triplet, ()),
    "partitions": (gallery.partitions, ()),
    "mixture": (charts.mixture, ()),
    "local-optimum": (charts.local_optimum, ()),
    "ablation": (gallery.ablation, ("cd", "rand", "pose-only", "joint")),
    "gallery": (gallery.gallery, ("free-form-augmented", "cd", "joint")),
    "correspondence": (gallery.correspondence, ("joint",)),
}
# Training scans are made again only for their poses.
_MOST_TRAINING = 300


def draw(report, arrays, out, *, rigs, jobs=1):
    """Draw the study's figures as PNG files; the same inputs give the same bytes.

    Parameters
    ----------
    report : dict
        Of ``run.study``.
    arrays : callable (cell name) → mapping or None
        What ``on_cell`` was given for the cell (``making.cell_name``): "vertices" (N, m, 3), "joints" (N, J, 3), of
        rows with a segmenter "labels", one after the other over the test scans' points, of joint "template" U^d and "posed"
        M(Θ, U) of the first scans. None where it is not there. Picklable where ``jobs`` is more than 1.
    out : path-like
        A folder; made if need be.
    rigs : mapping of str to Rig
        The report's rigs by name; those that are not there are left out.
    jobs : int, default 1
        Processes.

    Returns
    -------
    dict of str to str
        File name → caption, in reading order. Figures whose rows are missing are left out.

    Raises
    ------
    MissingExtraError
        Matplotlib is not installed.
    InputError
        Arrays that are not of the report's scans.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    there = {name: entry for name, entry in report["rigs"].items() if name in rigs and entry["seeds"]}
    figure = _Figure(report, {name: Shown(name, rigs[name], entry, arrays) for name, entry in there.items()}, folder)
    tasks = [(kind, name) for kind in FIGURES for name in (there if kind in _OF_RIGS else [None])]
    drawn = each(figure, tasks, jobs=jobs)
    return {file: caption for file, caption in drawn if caption is not None}


@dataclass(frozen=True, eq=False)
class _Figure:
    """(kind, name of its rig or None) → the figure's file, and its caption, None where it cannot be drawn."""

    report: dict
    shown: dict
    folder: Path

    def __call__(self, task):
        kind, name = task
        file = f"{kind}.png" if name is None else f"{kind}-{name}.png"
        path = self.folder / file
        if kind == "diagram":
            return file, diagram(path)
        if kind == "accuracy":
            return file, charts.accuracy(self.report, path)
        figure, rows = _OF_RIGS[kind]
        shown = self.shown[name]
        return file, figure(shown, path) if all(row in shown.cells for row in rows) else None


@dataclass(frozen=True, eq=False)
class Shown:
    """What the figures of a rig look at: the scans of one seed and what each row found for those held out.

    Attributes
    ----------
    name : str
    source : Rig
    entry : dict
        Of the report.
    arrays : callable
        As for :func:`draw`.
    """

    name: str
    source: object
    entry: dict
    arrays: object

    @property
    def called(self):
        """The rig in a sentence: "hand left"."""
        return self.name.replace("-", " ")

    @cached_property
    def seed(self):
        """Of the scans: the first of those that have the most rows, as runs of some rows may have seeds of their own."""
        return int(max(self.entry["seeds"], key=lambda seed: len(self.entry["seeds"][seed])))

    @cached_property
    def given(self):
        """The StudySet, with the first training scans only."""
        size = Size(**self.entry["size"])
        return study_set(self.source, replace(size, train=min(size.train, _MOST_TRAINING)), self.seed)

    @property
    def rig(self):
        """The Rig."""
        return self.given.rig

    @property
    def train(self):
        """List of SyntheticScan."""
        return self.given.train

    @property
    def test(self):
        """List of SyntheticScan."""
        return self.given.test

    @property
    def test_subjects(self):
        """Whose scans ``test`` are."""
        return self.given.test_subjects

    @cached_property
    def cells(self):
        """Row → its arrays, where they are there."""
        found = {row: self.arrays(cell_name(self.name, self.seed, row)) for row in self.entry["seeds"][str(self.seed)]}
        for row, cell in found.items():
            expected = (len(self.test), *self.rig.vertices.shape)
            if cell is not None and cell["vertices"].shape != expected:
                raise InputError(f"arrays of {row!r}", f"vertices of shape {cell['vertices'].shape}", f"shape {expected}")
        return {row: cell for row, cell in found.items() if cell is not None}

    def labels(self, row):
        """List over the test scans of (n,) int: what the row's segmenter says."""
        ends = np.cumsum([len(s.points) for s in self.test])
        labels = self.cells[row].get("labels")
        if labels is None or len(labels) != ends[-1]:
            got = "none" if labels is None else f"{len(labels)} labels"
            raise InputError(f"arrays of {row!r}", got, f"{ends[-1]} labels, one for each point of the test scans")
        return np.split(np.asarray(labels, dtype=int), ends[:-1])

    def errors(self, row):
        """(N,) array: joint errors in half sizes of the rig; NaN where a scan could not be fitted."""
        half, moving = self.rig.size / 2, self.rig.moving
        return np.array([joint_error(J, s.joints, moving) for J, s in zip(self.cells[row]["joints"], self.test)]) / half

    def right(self, row):
        """(N,) array: share of each test scan's points that the row's segmenter puts into the right group of parts."""
        groups = part_groups(self.rig)
        return np.array([np.mean(groups[said] == groups[s.labels]) for said, s in zip(self.labels(row), self.test)])

    def from_worst_to_best(self, row, n, by=None):
        """Rows of ``n`` test scans, evenly by joint error or other errors; those that could not be fitted are left out."""
        errors = self.errors(row)
        ranked = np.argsort(-(errors if by is None else by), kind="stable")
        ranked = [int(i) for i in ranked if np.isfinite(errors[i])]
        return [ranked[r] for r in np.unique(np.linspace(0, len(ranked) - 1, n).round().astype(int))] if ranked else []
