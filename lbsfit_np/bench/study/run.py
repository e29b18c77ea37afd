"""One run of the study: every row for every rig and seed, each kept as soon as it is there."""

from copy import deepcopy
from dataclasses import asdict
from itertools import product

from ...errors import InputError, did_you_mean
from ...learning.checkpoint import remove_checkpoint, state_of_the_code
from ...processes import kept_processes
from ...workers import startable
from ..resume import REMEDY, begun, check_same, checked_seeds, described, is_done
from ..run import TRAINING_SEED
from ..subjects import people_digest, scans_digest
from .at_once import batches, is_faster, made_at_once
from .data import SCAN, kind_of, sized, study_set
from .first_segmenter import first_scans
from .local_optimum import along_path
from .making import cell_name, first_fits_name, has_steps, made
from .rows import LIBRARY, PRETRAINING, ROWS

__all__ = ["FIRST_SEED", "joined", "study", "to_go_on_with", "with_rows"]

# Of the scans, and those after it; nothing was tuned on them.
FIRST_SEED = 300
# What a rig's entry of a report has that was found.
_FOUND = ("kind", "seeds", "local_optimum")


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
        Processes; figures do not depend on it. Where that is faster, as many rows are made at once, by one process each.
    before : dict, optional
        A report of the same settings: what it has is not done again, unless scans failed as nobody foresaw.
    kept : callable (cell name, digest) → bool, optional
        Whether the arrays of a cell of ``before`` are still there, those with this ``checkpoint.digest_of``.
    steps : callable (cell name) → Path or None, optional
        A folder for what a row that takes long has done so far; taken up by the next run, and removed when the row is done.
    progress : callable (name, seed, row, share, of_all), optional
        Called as a row is done to a share, or "pretraining" is, and all rows of this run together, roughly.
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
    seeds = [FIRST_SEED + k for k in range(count)] if seeds is None else checked_seeds(seeds)
    report = to_go_on_with(before, size, rigs) | {"complete": False}
    for name, rig in rigs.items():
        entry, n = report["rigs"].setdefault(name, _described(rig, sizes[name])), first_scans(rig, sizes[name])
        if entry.get("first_scans", sizes[name].training_scans) != n:  # older results do not say it
            got = f"results of {name!r} whose segmenters began with other scans"
            raise InputError("before", got, f"a segmenter of {n:,} synthetic scans", REMEDY)
    todo = {}
    for name, seed in product(rigs, seeds):
        done = report["rigs"][name]["seeds"].get(str(seed), {})
        there = [row for row, cell in done.items() if is_done(cell) and kept(cell_name(name, seed, row), cell["arrays"])]
        todo[name, seed] = [row for row in ROWS if row in rows and row not in there]
        for row in there:  # which a run may have been killed before it removed
            _remove_steps(steps(cell_name(name, seed, row)))
    if on_begun is not None:
        cells = []
        for of, left in todo.items():
            cells += [first_fits_name(*of)] if any(ROWS[row].in_common for row in left) else []
            cells += [cell_name(*of, row) for row in left]
        on_begun(report, cells, _of_other_code(report, {of: [row for row in rows if row not in todo[of]] for of in todo}))
    for name in dict.fromkeys(name for (name, _), left in todo.items() if left):
        report["rigs"][name]["local_optimum"] = along_path(rigs[name])

    def on_row(name, seed, row, cell, arrays):
        known = report["rigs"][name]["seeds"]
        rows = known.get(str(seed), {}) | {row: cell}
        known[str(seed)] = {key: rows[key] for key in (*ROWS, *rows) if key in rows}  # whichever was made first
        report["rigs"][name]["seeds"] = {key: known[key] for key in sorted(known, key=int)}
        if on_cell is not None:
            on_cell(report, name, seed, row, arrays)
        if is_done(cell):  # else the next run takes them up, to try again what failed
            _remove_steps(steps(cell_name(name, seed, row)))
        todo[name, seed].remove(row)
        if ROWS[row].in_common:
            no_more_in_common(name, seed)

    def no_more_in_common(name, seed):
        """Remove fits that rows have in common where none of these is begun, by whichever run, or left to this one."""
        rows = [row for row in ROWS if ROWS[row].in_common]
        folders = [steps(cell_name(name, seed, row)) for row in rows]
        if not set(rows) & set(todo[name, seed]) and not any(folder is not None and folder.exists() for folder in folders):
            _remove_steps(steps(first_fits_name(name, seed)))

    trained = {name for name, size in sizes.items() if first_scans(rigs[name], size) == size.training_scans}
    how = {"steps": steps, "progress": _of_all(todo, trained, progress)}
    plan = batches(todo, in_common=lambda *of: steps(first_fits_name(*of)) is not None)
    jobs = startable(jobs)
    if jobs > 1 and is_faster(plan, jobs):
        made_at_once(plan, rigs, sizes, jobs=jobs, on_row=on_row, **how)
    else:
        for (name, seed), rows in [(of, tuple(left)) for of, left in todo.items() if left]:
            gone_on = has_steps(steps(first_fits_name(name, seed)))
            for there in made(name, rigs[name], sizes[name], seed, rows, jobs=jobs, at_once=1, gone_on=gone_on, **how):
                on_row(name, seed, *there)
    for of in todo:  # of a run that was killed before it did
        no_more_in_common(*of)
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
        if all(theirs.get(key) == ours[key] for key in ours if key not in _FOUND):
            for seed, rows in theirs["seeds"].items():
                ours["seeds"][seed] = rows | ours["seeds"].get(seed, {})
            ours["seeds"] = {seed: ours["seeds"][seed] for seed in sorted(ours["seeds"], key=int)}
    out["complete"] = out["complete"] and _complete(out)
    return out


def _complete(report):
    """Whether the seeds of each rig have the same rows."""
    return all(len({frozenset(done) for done in entry["seeds"].values()}) == 1 for entry in report["rigs"].values())


def _of_all(todo, trained, progress):
    """The ``progress`` of rows that tells :func:`study`'s how far all of them are, too; ``trained`` are rigs whose first s is."""
    weights = {(*of, row): ROWS[row].weight for of, rows in todo.items() for row in rows}
    pretrained = {name for name, _, row in weights if ROWS[row].pretrained}
    weights |= {(name, "pretraining"): PRETRAINING if name in trained else LIBRARY for name in pretrained}
    shares = dict.fromkeys(weights, 0.0)

    def told(name, seed, row, share):
        of = (name, row) if row == "pretraining" else (name, seed, row)
        shares[of] = max(shares[of], share)  # those who come later find it done
        progress(name, seed, row, share, sum(shares[of] * weights[of] for of in shares) / sum(weights.values()))

    return told if progress is not None else lambda *share: None


def _remove_steps(folder):
    if folder is not None:
        remove_checkpoint(folder)


def to_go_on_with(before, size, rigs):
    """The report to go on with; ``before`` as of :func:`study`, which says what is raised."""
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
            known = {key for key in described(rigs[name]) if key in entry} | {"digest", "poses"}  # not all were always written
            check_same(entry, {key: now[key] for key in now if key in known}, name)
            for key, what in (("people", "test people"), ("scans", "scans")):
                if entry[key] != now[key]:
                    got = f"results of other {what} than {name!r} now has"
                    raise InputError("before", got, f"results of the same {what}", REMEDY)
    return report


def _described(rig, size):
    """A rig's entry of the report, without results."""
    given = study_set(rig, size, FIRST_SEED)
    scans = scans_digest(rig, [given.train[0], given.test[0]])
    library = {"train": len(given.train.rig.poses), "test": len(given.test.rig.poses)}
    known = described(rig) | {"people": people_digest(rig), "scans": scans, "library": library}
    return {"kind": kind_of(rig), **known, "size": asdict(size), "first_scans": first_scans(rig, size), "seeds": {}}


def _of_other_code(report, there):
    """The names of cells that another state of the code, or of its libraries, has made; ``there`` by rig and seed, rows."""
    now = state_of_the_code()
    entries = {of: report["rigs"][of[0]]["seeds"].get(str(of[1]), {}) for of in there}
    return [cell_name(*of, row) for of, rows in there.items() for row in rows if entries[of][row]["code"] != now]
