"""What ``lbsfit bench study`` runs: the paper's study, its page and its pictures."""

import re
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

from ..errors import FileError, InputError, MissingExtraError, counted
from ..io.write import remove_empty
from ..processes import kept_processes
from .bench_runs import RESULTS, failures_code, made_results, numbers, read_results
from .models import say_model_as_rig
from .outputs import out_folder
from .progress import SILENCE, Progress, percentage_bar, say, span
from .stopping import say_steps, terminable

__all__ = ["run_study"]

_PAGE, _CELLS = "README.md", "cells"


@kept_processes()
def run_study(values):
    """The study; the exit code."""
    from ..bench.study.data import kind_of
    from ..bench.study.making import cell_name
    from ..bench.study.page import console_table
    from ..bench.study.run import joined, study, with_rows
    from ..io.rigs import load_rig
    from ..io.write import write_json, write_npz
    from ..learning.checkpoint import checkpoint_of, steps_in

    if values["output"] is None:
        raise InputError("-o/--output", "nothing", "a folder", "Add -o OUT, such as docs/study.")
    names = _names(values)
    for name in names:
        say_model_as_rig(name)
    rigs = {Path(name).stem: load_rig(name) for name in names}
    if len(rigs) < len(names):
        raise InputError("--rig", values["rig"], "rigs whose files have different names", "Leave one out, or rename it.")
    folder = Path(values["output"])
    if (folder / _PAGE).exists() and not (folder / RESULTS).exists() and values["existing"] != "replace":
        remedy = "Choose another one, or --existing replace."
        raise InputError("-o/--output", f"{folder}, which has another {_PAGE}", "a folder of the study's own", remedy)
    for name in (name for name, rig in rigs.items() if kind_of(rig) == "other" and not values["page"]):
        say(f"note: {name} is neither a hand nor a body by its joints' names: it has sizes of hands, and no figures of the paper")
    if values["page"]:
        return _page_alone(folder, rigs, values)
    results = made_results(values)
    out, cells = results.parent, results.parent / _CELLS
    replace, begun = values["existing"] == "replace", False
    resumed = results.exists() and not replace
    if values["figures"] and find_spec("matplotlib") is None:
        say(f"note: {MissingExtraError('matplotlib', 'viz', 'drawing the figures')}; everything else is done without it")
    progress = _StudyProgress()
    made = out_folder(cells)  # before any work, as it may be impossible

    def steps(cell):
        return checkpoint_of(cells / f"{cell}.npz")

    mine = []  # the rows that this run has made, (rig's name, seed, row) each

    def keep(report):
        """Write these to what is there, as a study beside this one may have left it."""
        def stands(name, seed, row):  # unless a run beside this one has replaced it
            made = report["rigs"].get(name, {"seeds": {}})["seeds"].get(str(seed), {}).get(row)
            return made is not None and _arrays_of(cells, cell_name(name, seed, row), made["arrays"]) is not None

        with suppress(FileError):  # nothing there yet, or nothing that is a report
            report = joined(with_rows(report, [row for row in mine if stands(*row)]), read_results(results))
        write_json(results, report)

    def on_begun(report, todo, others):
        nonlocal begun
        begun = True
        if replace:
            _remove_earlier(out, cells, results)
            write_json(results, report)  # with it the same command goes on, stopped as soon as may be
        if others:
            were = "was" if len(others) == 1 else "were"
            made = f"note: kept {counted(len(others), 'row')} in {out} that {were} made by other code or libraries"
            say(f"{made}: {', '.join(others)}; --existing replace makes all rows again")
        for cell in todo:
            say_steps(steps(cell))

    def on_cell(report, name, seed, row, arrays):
        write_npz(cells / f"{cell_name(name, seed, row)}.npz", **arrays)
        mine.append((name, seed, row))
        keep(report)
        progress.cell(name, seed, row, report["rigs"][name]["seeds"][str(seed)][row])

    try:
        with terminable():
            report = study(
                rigs,
                size=values["size"],
                seeds=numbers(values["seeds"]) if values["seeds"] else None,
                rows=tuple(values["rows"].split(",")),
                jobs=values["jobs"],
                before=read_results(results) if resumed else None,
                kept=lambda cell, digest: _arrays_of(cells, cell, digest) is not None,
                steps=steps,
                progress=progress,
                on_begun=on_begun,
                on_cell=on_cell,
            )
    except BaseException as why:
        progress.close()
        stopped = isinstance(why, KeyboardInterrupt)
        kept = results.exists() or any(steps_in(folder) for folder in cells.glob(checkpoint_of("*.npz").name))
        if begun and (kept or stopped):
            how, again = "stopped: " * stopped, "run the same command" + " without --existing replace" * replace
            words = f"finished work is kept in {out}" if kept else "nothing was finished yet"
            with suppress(OSError):  # which is not what went wrong
                say(f"{how}{words}; {again} to continue")
        raise
    finally:
        progress.close()
        remove_empty(made)
    keep(report)
    report = read_results(results)  # the page is of what is written, in its order
    with terminable():
        written = _write_page(report, rigs, out, pictures=values["figures"], jobs=values["jobs"])
    keep(report)
    say("")
    say(console_table(report, markdown=values["markdown"]))
    say(f"\n{written}")
    return failures_code(_failures(report))


def _names(values):
    """The rigs that are given, or those that the size has; a page of results that are there may be of any size."""
    from ..bench.study.data import RIGS

    if values["rig"] is not None:
        return values["rig"].split(",")
    return list(dict.fromkeys(chain.from_iterable(RIGS.values()))) if values["page"] else RIGS[values["size"]]


def _page_alone(folder, rigs, values):
    """The page of results that are there, and the pictures for which all is there; the exit code."""
    from ..bench.study.run import joined, to_go_on_with
    from ..io.write import write_json

    path = folder / RESULTS
    if not path.exists():
        raise InputError("-o/--output", f"{folder}, with no {RESULTS}", "a folder of the study", "Leave out --page to make one.")
    before = read_results(path)
    there = before.get("rigs") if isinstance(before.get("rigs"), dict) else {}
    rigs = {name: rig for name, rig in rigs.items() if name in there}
    report = to_go_on_with(before, before.get("size"), rigs)
    whole = {name: rig for name, rig in rigs.items() if _has_all(report["rigs"][name], name, folder / _CELLS)}
    with terminable():
        written = _write_page(report, whole, folder, pictures=values["figures"], jobs=values["jobs"])
    write_json(path, joined(report, read_results(path)))  # a run beside this one may have added to it
    say(written)
    return 0


def _has_all(entry, name, cells):
    """Whether what the rows of a rig's entry have registered is all there."""
    from ..bench.study.making import cell_name

    rows = [(seed, row, c) for seed, done in entry["seeds"].items() for row, c in done.items()]
    return bool(rows) and all(_arrays_of(cells, cell_name(name, seed, row), c["arrays"]) is not None for seed, row, c in rows)


def _remove_earlier(out, cells, results):
    """Remove what an earlier study has written, and say how much; what cannot be removed stays."""
    from ..bench.study.rows import ROWS
    from ..learning.checkpoint import checkpoint_of, remove_checkpoint

    for folder in cells.glob(checkpoint_of("*.npz").name):
        remove_checkpoint(folder)
    if not results.exists():
        return
    drawn = []
    with suppress(FileError):
        drawn = [out / Path(file).name for file in read_results(results).get("captions", ()) if Path(file).suffix == ".png"]
    rows = [file for file in cells.glob("*-*-*.npz") if re.fullmatch(rf".+-\d+-({'|'.join(ROWS)})", file.stem)]
    for file in (results, out / _PAGE, *drawn, *rows):
        with suppress(OSError):
            file.unlink()
    if rows:
        say(f"note: removed {counted(len(rows), 'row')} of earlier runs from {out}")


def _arrays_of(cells, cell, digest):
    """The arrays of a cell, None where they are not there or are another run's."""
    from ..io.npz import read_npz
    from ..learning.checkpoint import digest_of

    try:
        arrays = read_npz(cells / f"{cell}.npz")
    except FileError:
        return None
    return arrays if digest_of(arrays) == digest else None


def _failures(report):
    """(where, why) of all test scans that a row could not fit."""
    for name, entry in report["rigs"].items():
        for seed, rows in entry["seeds"].items():
            for row, cell in rows.items():
                for scan, why in cell.get("failures", {}).items():
                    yield f"{name}, seed {seed}, {row}, scan {scan}", why


@dataclass(frozen=True)
class _Kept:
    """The arrays of a cell by its name, as a report has them."""

    cells: Path
    digests: dict

    def __call__(self, cell):
        return _arrays_of(self.cells, cell, self.digests[cell])


def _write_page(report, rigs, out, *, pictures, jobs):
    """The page, and its pictures where they can be drawn; what was written, in words."""
    from ..bench.study.making import cell_name
    from ..bench.study.page import page, rows_digest
    from ..io.write import atomic_path

    # Pictures of what this run did not draw again stay.
    captions, why = {file: text for file, text in report.get("captions", {}).items() if (out / file).exists()}, ""
    if pictures:
        from ..bench.environment import installed
        from ..bench.study.figures import draw
        from ..bench.study.local_optimum import along_path

        digests = {
            cell_name(name, seed, row): cell["arrays"]
            for name, entry in report["rigs"].items()
            for seed, done in entry["seeds"].items()
            for row, cell in done.items()
        }
        for name in rigs:  # pictures show it as it now is
            report["rigs"][name]["local_optimum"] = along_path(rigs[name])
        try:
            drawn = draw(report, _Kept(out / _CELLS, digests), out, rigs=rigs, jobs=jobs)
            captions = drawn | {file: text for file, text in captions.items() if file not in drawn}
            of = {name: rows_digest(report["rigs"][name]) for name in rigs if _has_all(report["rigs"][name], name, out / _CELLS)}
            of = (report.get("drawn_by") or {}).get("of", {}) | of  # of others some pictures may be of earlier rows
            report["drawn_by"] = {"matplotlib": installed("matplotlib"), "of": of}
        except MissingExtraError as error:
            why = f", without pictures: {error}"
    report["captions"] = captions
    with atomic_path(out / _PAGE) as temporary:
        Path(temporary).write_text(page(report, captions), encoding="utf-8")
    return f"results in {out / RESULTS}, tables in {out / _PAGE}{why}"


class _StudyProgress(Progress):
    """A bar for all rows on a terminal, and a line when one is done; lines elsewhere."""

    def __init__(self):
        super().__init__(0)
        self._begun, self._began = {}, time.monotonic()
        self._told = self._began

    def __call__(self, name, seed, row, share, of_all):
        """``row`` is done to ``share`` for a rig and seed, all of them to ``of_all``."""
        self._begun[name, seed, row] = share
        if row == "pretraining" and share >= 1:
            del self._begun[name, seed, row]
        if not self.terminal and time.monotonic() - self._told > SILENCE:
            self._told = time.monotonic()
            self.line("; ".join(words for words in (f"{of_all:.0%} of all rows", self._rows()) if words))
        if self.terminal:
            self._bar = self._bar or percentage_bar(self._rows())
            self._bar.set_description_str(self._rows(), refresh=False)
            self._bar.update(max(0.0, 100 * of_all - self._bar.n))

    def _rows(self):
        return ", ".join(f"{name} {seed} {row} {share:.0%}" for (name, seed, row), share in self._begun.items())

    def cell(self, name, seed, row, entry):
        """A row is done and written."""
        self._begun.pop((name, seed, row), None)
        if self._bar is not None:
            self._bar.set_description_str(self._rows(), refresh=False)
        found = f"pose {entry['pose']:.4f}" if "pose" in entry else "nothing could be fitted"
        found += f", corre. {entry['corre']['mean']:.4f}" if entry.get("corre") else ""
        took = "" if entry["seconds"] is None else f"{span(entry['seconds'])}, "
        self.line(f"{name}, seed {seed}, {row}: {found}; {took}{span(time.monotonic() - self._began)} in this run")
