"""One run of the study: every row for every rig and seed, each kept as soon as it is there."""

import time
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cache
from itertools import product

import numpy as np

from ...errors import InputError, did_you_mean
from ...learning.checkpoint import digest_of, remove_checkpoint, state_of_the_code, steps_in
from ...workers import kept_processes
from ..environment import environment
from ..resume import REMEDY, begun
from ..run import TRAINING_SEED
from ..subjects import people_digest, scans_digest
from .data import SCAN, kind_of, part_groups, sized, study_set
from .local_optimum import along_path
from .measures import Truth, measured
from .rows import ROWS, Context, said

__all__ = ["FIRST_SEED", "cell_name", "joined", "study", "with_rows"]

# Of the scans, and those after it; nothing was tuned on them.
FIRST_SEED = 300
# Stands in the place of a row where steps are kept that several rows have in common: the training scans' fits by themselves.
FIRST_FITS = "first-fits"


@kept_processes()
def study(
    rigs,
    *,
    size="small",
    seeds=None,
    rows=tuple(ROWS),
    jobs=1,
    before=None,
    kept=lambda cell, digest: True,
    steps=lambda cell: None,
    progress=None,
    on_begun=None,
    on_cell=None,
):
    """Register the study's scans by each row, and measure.

    Parameters
    ----------
    rigs : dict of str to Rig
        By what they are called in the report.
    size : {"small", "medium", "paper"}
    seeds : sequence of int, optional
        Of the scans; by default as many as the size has, from 300 on.
    rows : sequence of str
        Of ``ROWS``.
    jobs : int, default 1
        Processes; figures do not depend on it.
    before : dict, optional
        A report of the same settings: what it has is not done again.
    kept : callable (cell name, digest) → bool, optional
        Whether the arrays of a cell of ``before`` are still there, those with this ``checkpoint.digest_of``.
    steps : callable (cell name) → Path or None, optional
        A folder for what a row that takes long has done so far; taken up by the next run, and removed when the row is done.
    progress : callable (name, seed, row, share), optional
    on_begun : callable (report, cells, others), optional
        Once all has been checked and before any work, with the report to go on with, the names of the cells to be done, and
        those of cells that are there and were made by another state of the code.
    on_cell : callable (report, name, seed, row, arrays), optional
        After each row of each rig and seed, with the report so far and what is to be kept as :func:`cell_name`.

    Returns
    -------
    dict
        Plain data for JSON. "complete": all seeds of each rig have the same rows.

    Raises
    ------
    InputError
        Names that are not known; a report of other settings.
    """
    odd = [row for row in rows if row not in ROWS]
    if odd or not rows:
        raise InputError("rows", repr(rows), f"some of {', '.join(ROWS)}", did_you_mean(odd[0], ROWS) if odd else None)
    sizes = {name: sized(rig, size) for name, rig in rigs.items()}
    count = max(s.seeds for s in sizes.values())
    seeds = [FIRST_SEED + k for k in range(count)] if seeds is None else [int(s) for s in seeds]
    progress = progress or (lambda name, seed, row, share: None)
    report = _begun(before, size, rigs) | {"complete": False}
    for name, rig in rigs.items():
        report["rigs"].setdefault(name, _described(rig, sizes[name]))
    todo = {}
    for name, seed in product(rigs, seeds):
        done = report["rigs"][name]["seeds"].get(str(seed), {})
        there = [row for row, cell in done.items() if kept(cell_name(name, seed, row), cell["arrays"])]
        todo[name, seed] = [row for row in ROWS if row in rows and row not in there]
        for row in there:  # which a run may have been killed before it removed
            _remove_steps(steps(cell_name(name, seed, row)))
    if on_begun is not None:
        cells = [cell_name(*of, row) for of, left in todo.items() for row in (*_in_common(left), *left)]
        on_begun(report, cells, _of_other_code(report, {of: [row for row in rows if row not in todo[of]] for of in todo}))
    for (name, seed), left in todo.items():
        rig, entry = rigs[name], report["rigs"][name]
        if "local_optimum" not in entry:
            entry["local_optimum"] = along_path(rig)
        for row, cell, arrays in _cells(name, rig, sizes[name], seed, left, jobs, progress, steps) if left else ():
            entry["seeds"].setdefault(str(seed), {})[row] = cell
            if on_cell is not None:
                on_cell(report, name, seed, row, arrays)
            _remove_steps(steps(cell_name(name, seed, row)))
        folders = [steps(cell_name(name, seed, row)) for row in ROWS if ROWS[row].in_common]
        if not any(folder is not None and folder.exists() for folder in folders):  # of rows that others do, or left
            _remove_steps(steps(cell_name(name, seed, FIRST_FITS)))
    report["complete"] = _complete(report)
    return report


def with_rows(report, rows):
    """A report with these of its rows alone, each a (rig's name, seed, row)."""
    out = deepcopy(report)
    for name, entry in out["rigs"].items():
        for seed, done in list(entry["seeds"].items()):
            entry["seeds"][seed] = {row: cell for row, cell in done.items() if (name, int(seed), row) in rows}
            if not entry["seeds"][seed]:
                del entry["seeds"][seed]
    return out


def joined(report, other):
    """A report with the rigs, seeds and rows of another one of the same settings that it has not: of a run beside this one.

    ``other`` counts for nothing where it is of another size, or of rigs, poses, people or scans that are not the same.
    """
    out = deepcopy(report)
    if any(other.get(key) != out[key] for key in ("benchmark", "size", "scan", "training_seed")):
        return out
    for name, theirs in other["rigs"].items():
        ours = out["rigs"].setdefault(name, theirs)
        if all(theirs.get(key) == ours[key] for key in ("digest", "poses", "people", "scans", "size")):
            for seed, rows in theirs["seeds"].items():
                ours["seeds"][seed] = rows | ours["seeds"].get(seed, {})
            ours["seeds"] = {seed: ours["seeds"][seed] for seed in sorted(ours["seeds"], key=int)}
    out["complete"] = out["complete"] and _complete(out)
    return out


def _complete(report):
    """Whether the seeds of each rig have the same rows."""
    return all(len({frozenset(done) for done in entry["seeds"].values()}) == 1 for entry in report["rigs"].values())


def _in_common(rows):
    """What takes the place of a row beside such rows."""
    return [FIRST_FITS] if any(ROWS[row].in_common for row in rows) else []


def _has_steps(folder):
    return folder is not None and steps_in(folder) > 0


def _remove_steps(folder):
    if folder is not None:
        remove_checkpoint(folder)


def cell_name(name, seed, row):
    """What the arrays of a row are kept under: "hand-300-joint"."""
    return f"{name}-{seed}-{row}"


def _begun(before, size, rigs):
    """The report to go on with."""
    same = {"size": size, "scan": asdict(SCAN), "training_seed": TRAINING_SEED}
    report = begun(before, {"benchmark": "study", **same, "rigs": {}}, same=tuple(same))
    for name, entry in report["rigs"].items():
        whole = all("arrays" in cell for rows in entry["seeds"].values() for cell in rows.values())
        if not ({"people", "scans"} <= set(entry) and whole):
            raise InputError("before", f"results of {name!r} by an earlier version", "results of this version", REMEDY)
        if name in rigs:
            now = _described(rigs[name], sized(rigs[name], size))
            if entry.get("size") != now["size"]:
                raise InputError("before", f"results of {name!r} with other numbers of scans", "results of the same size", REMEDY)
            if any(entry.get(key) != now[key] for key in ("digest", "poses")):
                raise InputError("before", f"results of another rig than {name!r} now is", "results of the same rigs", REMEDY)
            for key, what in (("people", "test people"), ("scans", "scans")):
                if entry[key] != now[key]:
                    raise InputError("before", f"results of other {what} than {name!r} now has", "results of the same", REMEDY)
    return report


def _described(rig, size):
    """A rig's entry of the report, without results."""
    given = study_set(rig, size, FIRST_SEED)
    scans = scans_digest(rig, [given.train[0], given.test[0]])
    known = {"digest": rig.digest, "poses": rig.poses_digest, "people": people_digest(rig), "scans": scans}
    return {"kind": kind_of(rig), **known, "size": asdict(size), "seeds": {}}


def _cells(name, rig, size, seed, rows, jobs, progress, steps):
    """(row, its entry of the report, its arrays), one after the other."""
    from ...learning.fitter import LBSFitter

    given = study_set(rig, size, seed)
    groups = part_groups(given.rig)

    def right_of_each(labels):
        """Share of each test scan's points in the right group of parts, None where there are no labels."""
        pairs = zip(labels, given.test, strict=True)
        return [None if found is None else float(np.mean(groups[found] == groups[s.labels])) for found, s in pairs]

    def right(labels):
        """The mean of these; None without scans."""
        shares = [share for share in right_of_each(labels) if share is not None]
        return float(np.mean(shares)) if shares else None

    parameters = {"training_scans": size.training_scans, "rounds": size.rounds, "n_jobs": jobs, "random_state": TRAINING_SEED}
    fitter = LBSFitter(given.rig, orientation="aligned", **parameters)
    if any(ROWS[row].pretrained for row in rows):
        fitter.pretrain(cache=True, progress=lambda p: progress(name, seed, "pretraining", p))
    before = cache(lambda: said(fitter.segmenter_, given.test, jobs))
    truth = Truth(given.rig, given.test, size.pairs, seed)
    train_truth, first_fits = None, steps(cell_name(name, seed, FIRST_FITS))
    found_some = _has_steps(first_fits)  # of a run that was stopped
    context = Context(rig, given, size, seed, fitter, before, right, jobs, lambda share: None, first_fits=first_fits)
    for row in rows:
        say = lambda share, row=row: progress(name, seed, row, share)  # noqa: E731
        folder = steps(cell_name(name, seed, row))
        gone_on, started = _has_steps(folder), time.perf_counter()
        found = ROWS[row].find(replace(context, progress=say, steps=folder))
        if ROWS[row].in_common:  # these count in the first row alone
            gone_on, found_some = gone_on or found_some, False
        seconds = None if gone_on else round(time.perf_counter() - started, 1)  # what went before was not timed
        entry = measured(truth, found.test) | {"seconds": seconds, "jobs": jobs, "accuracy": found.accuracy, "gap": found.gap}
        entry |= {"kept_accuracy": found.kept_accuracy, "history": found.history}
        entry["kept_accuracy_scans"] = [] if found.labels is None else right_of_each(found.labels)
        if found.fitted_labels is not None:
            entry["fitted_labels"] = right(found.fitted_labels)
        if found.train is not None:
            train_truth = train_truth or Truth(given.rig, given.train, size.pairs, seed)
            entry["on_training"] = measured(train_truth, found.train)
        lost = np.flatnonzero(~found.test.fitted)
        entry["failures"] = {str(i): found.failures.get(int(i), "its fit is not finite") for i in lost}
        arrays = _arrays(found)
        entry |= {"arrays": digest_of(arrays), "code": state_of_the_code(), "environment": environment()}
        say(1.0)
        yield row, entry, arrays


def _of_other_code(report, there):
    """The names of cells that another state of the code, or of its libraries, has made; ``there`` by rig and seed, rows."""
    now = state_of_the_code()
    made = {of: report["rigs"][of[0]]["seeds"].get(str(of[1]), {}) for of in there}
    return [cell_name(*of, row) for of, rows in there.items() for row in rows if made[of][row]["code"] != now]


def _arrays(found):
    """What pictures need, small."""
    out = {"vertices": np.array(found.test.vertices, np.float32), "joints": np.array(found.test.joints, np.float32)}
    out |= {name: array.astype(np.float32) for name, array in found.stages.items()}
    if found.labels is not None:
        out["labels"] = np.concatenate(found.labels).astype(np.int16)
    return out
