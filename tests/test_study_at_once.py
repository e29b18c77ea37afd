"""Rows of the study beside each other: what waits for what, and that figures are those of rows one after the other."""

import json
import multiprocessing
import os
import re
import signal
import time
import warnings
from dataclasses import replace

import pytest
from study_sizes import rows_are_hurried

from lbsfit_np.bench.study import at_once
from lbsfit_np.bench.study import run as run_module
from lbsfit_np.bench.study.at_once import Batch, batches, is_faster
from lbsfit_np.bench.study.data import SIZES, Size
from lbsfit_np.bench.study.rows import ROWS
from lbsfit_np.bench.study.run import study
from lbsfit_np.cli import main as run
from lbsfit_np.errors import InputError, in_words
from lbsfit_np.learning.checkpoint import state_of_the_code
from lbsfit_np.processes import tell

_SIZE = Size(train=3, test=2, train_subjects=1, test_subjects=2, pairs=2, training_scans=60, rounds=1, seeds=1)
_QUICK = ("free-form", "free-form-supervised", "oracle-labels", "oracle-fit")


class _Hurried(at_once._Made):
    """Rows are made in a hurry in other processes, too."""

    def __call__(self, task):
        with pytest.MonkeyPatch.context() as patch:
            rows_are_hurried(patch)
            return super().__call__(task)


@pytest.fixture
def rigs(tube_rig, monkeypatch):
    rows_are_hurried(monkeypatch)
    monkeypatch.setitem(SIZES, "small", _SIZE)
    monkeypatch.setattr(at_once, "_Made", _Hurried)
    return {"tube": tube_rig}


@pytest.fixture
def command(rigs, tmp_path):
    """A study of a few scans of the tube with two processes, without rows."""
    rigs["tube"].save(tmp_path / "tube.npz")
    out = ["-o", str(tmp_path / "out")]
    return ["bench", "study", "--rig", str(tmp_path / "tube.npz"), "--seeds", "5", "--no-figures", *out, "--jobs", "2", "--rows"]


def _without_times(report):
    """Its figures, of rows without what hangs on when and how they were made."""
    made = ("seconds", "jobs", "at_once", "history")
    found = json.loads(json.dumps(report))
    for rows in found["rigs"]["tube"]["seeds"].values():
        for cell in rows.values():
            for key in made:
                del cell[key]
    return found


def test_what_takes_long_comes_first_and_waits_for_what_others_bring():
    rows = [row for row in ROWS if row not in ("pose-only", "free-form-supervised-3x")]
    todo = {("a", 1): rows, ("b", 2): ["rand", "oracle-fit"], ("b", 3): ["joint", "free-form-augmented"], ("a", 2): []}
    found = batches(todo, in_common=lambda name, seed: True)
    assert [(b.name, b.seed, b.rows) for b in found] == [
        ("a", 1, ("rand",)),
        ("a", 1, ("joint",)),
        ("b", 2, ("rand",)),
        ("b", 3, ("joint",)),
        ("a", 1, ("cd",)),
        ("a", 1, ("free-form", "free-form-augmented")),
        ("b", 3, ("free-form-augmented",)),
        ("a", 1, ("free-form-supervised",)),
        ("a", 1, ("oracle-labels",)),
        ("a", 1, ("oracle-fit",)),
        ("b", 2, ("oracle-fit",)),
    ]
    brings = {(b.name, b.seed, b.rows): b.brings for b in found if b.brings}
    assert brings == {
        ("a", 1, ("rand",)): {("pretrained", "a"), ("first fits", "a", 1)},
        ("b", 2, ("rand",)): {("pretrained", "b"), ("first fits", "b", 2)},
        ("b", 3, ("joint",)): {("first fits", "b", 3)},
    }
    waits = {(b.name, b.seed, b.rows): b.waits for b in found if b.waits}
    assert waits == {
        ("a", 1, ("joint",)): {("pretrained", "a"), ("first fits", "a", 1)},
        ("b", 3, ("joint",)): {("pretrained", "b")},
        ("a", 1, ("cd",)): {("pretrained", "a")},
        ("a", 1, ("free-form", "free-form-augmented")): {("pretrained", "a")},
        ("b", 3, ("free-form-augmented",)): {("pretrained", "b")},
    }
    apart = batches({("a", 1): ["rand", "joint"]}, in_common=lambda name, seed: False)  # where they are not kept
    assert [set(b.waits) for b in apart] == [set(), {("pretrained", "a")}] and set(apart[0].brings) == {("pretrained", "a")}


@pytest.mark.parametrize(
    "rows, jobs, expected",
    [
        (tuple(ROWS), 2, True),
        (tuple(ROWS), 8, False),
        (("rand", "pose-only", "joint"), 2, True),
        (("rand", "pose-only", "joint"), 3, False),  # two would wait for what one does first
        (("joint", "oracle-fit"), 2, False),  # one would have nothing to do
        (("rand", "joint"), 2, False),
        (("oracle-labels", "oracle-fit"), 2, True),
        ((), 2, True),
    ],
)
def test_rows_are_made_at_once_where_that_is_faster(rows, jobs, expected):
    assert is_faster(batches({("a", 1): rows}, in_common=lambda *of: True), jobs) == expected


def test_a_batch_waits_for_what_others_bring_and_not_for_their_rows(rigs, tmp_path, monkeypatch):
    begun, there = [], []

    def as_they_may(work, take, *, heard, **how):
        for note in (None, ("pretrained", "tube"), ("first fits", "tube", 5)):
            if note is not None:
                heard(("reached", note))
            while (given := take()) is not None:
                begun.append((note and note[0], given[0].rows))
        there.extend(sorted(path.name for path in tmp_path.iterdir()))

    monkeypatch.setattr(at_once, "as_they_may", as_they_may)
    plan = batches({("tube", 5): ("free-form-augmented", "rand", "joint", "oracle-fit")}, in_common=lambda *of: True)
    how = {"steps": lambda cell: tmp_path / cell, "progress": None, "on_row": None}
    at_once.made_at_once(plan, rigs, {"tube": _SIZE}, jobs=2, **how)
    assert begun == [
        (None, ("rand",)),
        (None, ("oracle-fit",)),
        ("pretrained", ("free-form-augmented",)),
        ("first fits", ("joint",)),
    ]
    assert there == ["tube-5-joint", "tube-5-rand"]  # which says that they are begun


@pytest.mark.parametrize("kept", [False, True])
def test_folders_of_rows_that_had_no_time_to_begin_do_not_stay(kept, rigs, tmp_path, monkeypatch):
    """They would keep first fits for ever; where there are such, they say that rows are begun. Those of other runs stay."""

    def as_they_may(work, take, *, heard, **how):
        take()
        heard(("reached", ("first fits", "tube", 5)))
        if kept:
            (tmp_path / "tube-5-first-fits").mkdir()
            (tmp_path / "tube-5-first-fits" / f"first-fit-{32 * '0'}.npz").write_bytes(b"")
        take()
        assert (tmp_path / "tube-5-rand").exists() and (tmp_path / "tube-5-joint").exists()
        raise KeyboardInterrupt

    (tmp_path / "tube-5-joint").mkdir()
    monkeypatch.setattr(at_once, "as_they_may", as_they_may)
    plan = batches({("tube", 5): ("rand", "joint")}, in_common=lambda *of: True)
    with pytest.raises(KeyboardInterrupt):
        at_once.made_at_once(plan, rigs, {}, jobs=2, steps=lambda cell: tmp_path / cell, progress=None, on_row=None)
    assert (tmp_path / "tube-5-rand").exists() == kept and (tmp_path / "tube-5-joint").exists()


@pytest.mark.slow
def test_figures_are_those_of_rows_one_after_the_other(rigs, monkeypatch):
    one_by_one, shares, there = study(rigs, rows=_QUICK, seeds=[5]), [], []
    monkeypatch.setattr(run_module, "made", None)
    how = {"progress": lambda *share: shares.append(share), "on_cell": lambda report, name, seed, row, arrays: there.append(row)}
    at_once = study(rigs, rows=_QUICK, seeds=[5], jobs=2, **how)
    assert _without_times(at_once) == _without_times(one_by_one)
    cells = at_once["rigs"]["tube"]["seeds"]["5"]
    assert list(cells) == list(_QUICK) and sorted(there) == sorted(_QUICK)
    assert {(cell["jobs"], cell["at_once"]) for cell in cells.values()} == {(1, 2)}
    assert {(cell["jobs"], cell["at_once"]) for cell in one_by_one["rigs"]["tube"]["seeds"]["5"].values()} == {(1, 1)}
    of_all = [share[-1] for share in shares]
    assert {share[2] for share in shares} == set(_QUICK)
    assert of_all == sorted(of_all) and of_all[-1] == pytest.approx(1)


@pytest.mark.slow
def test_with_fewer_rows_than_processes_each_has_them_all(rigs):
    report = study(rigs, rows=("oracle-fit", "free-form-supervised"), seeds=[5], jobs=3)
    assert {(cell["jobs"], cell["at_once"]) for cell in report["rigs"]["tube"]["seeds"]["5"].values()} == {(3, 1)}


@pytest.mark.slow
def test_rows_that_learn_from_labels_have_first_fits_in_common(rigs, tmp_path, monkeypatch):
    """The second begins when they are there, and makes none; they are gone in the end."""
    events = []

    def fits():
        return {path.name: path.stat().st_mtime_ns for path in (tmp_path / "tube-5-first-fits").glob("first-fit-*.npz")}

    def on_cell(report, name, seed, row, arrays):
        events.append((row, "done", fits()))

    monkeypatch.setattr(run_module, "is_faster", lambda batches, jobs: True)
    how = {"steps": lambda cell: tmp_path / cell, "on_cell": on_cell}
    how["progress"] = lambda name, seed, row, share, of_all: events.append((row, "told", fits()))
    rows = study(rigs, rows=("rand", "joint"), seeds=[5], jobs=2, **how)["rigs"]["tube"]["seeds"]["5"]
    assert rows["rand"]["seconds"] > 0 < rows["joint"]["seconds"] and rows["rand"]["accuracy"][0] == rows["joint"]["accuracy"][0]
    of = {event[:2]: event[2] for event in reversed(events)}  # the first of each
    assert list(dict.fromkeys(row for row, _, _ in events)) == ["pretraining", "rand", "joint"]
    assert of["joint", "told"] == of["rand", "done"] == of["joint", "done"] and len(of["joint", "told"]) == _SIZE.train
    assert not any(tmp_path.iterdir())


def test_rows_are_not_made_at_once_where_no_process_can_be_started(rigs, monkeypatch):
    asked = []
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # as of a Pool
    monkeypatch.setattr(run_module, "made", lambda *of, jobs, **how: asked.append(jobs) or [])
    study(rigs, rows=_QUICK, seeds=[5], jobs=2)
    assert asked == [1]


@pytest.mark.usefixtures("own_processes")
@pytest.mark.slow
def test_a_run_that_is_stopped_goes_on(command, tmp_path, monkeypatch, capsys):
    """As by Ctrl-C while the first row is written: no process is left, the others' rows are made by the same command."""
    out = tmp_path / "out"

    def stop(path, **arrays):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("lbsfit_np.io.write.write_npz", stop)
        assert run([*command, ",".join(_QUICK)]) == 130
    assert not multiprocessing.active_children() and "run the same command to continue" in capsys.readouterr().out
    assert run([*command, ",".join(_QUICK)]) == 0
    assert list(json.loads((out / "results.json").read_text())["rigs"]["tube"]["seeds"]["5"]) == sorted(_QUICK)
    assert {path.name for path in (out / "cells").iterdir()} == {f"tube-5-{row}.npz" for row in _QUICK}
    assert "with 1 process each, 2 rows at once." in (out / "README.md").read_text()


@pytest.mark.slow
def test_first_fits_of_a_run_that_was_stopped_are_not_in_the_time_of_the_first_row(rigs, tmp_path, monkeypatch):
    """But in nobody else's: what others wait for has not been timed as a whole."""
    folder = tmp_path / "tube-5-first-fits"
    folder.mkdir()
    (folder / f"first-fit-{32 * '0'}.npz").write_bytes(b"")
    monkeypatch.setattr(at_once, "_Made", _Told)
    monkeypatch.setattr(run_module, "is_faster", lambda batches, jobs: True)
    report = study(rigs, rows=("rand", "joint", "cd"), seeds=[5], jobs=2, steps=lambda cell: tmp_path / cell)
    told = {row: cell["gone_on"] for row, cell in report["rigs"]["tube"]["seeds"]["5"].items()}
    assert told == {"cd": False, "rand": True, "joint": False} and not any(tmp_path.iterdir())


@pytest.mark.usefixtures("own_processes")
@pytest.mark.parametrize(
    "how, words", [("error", "points: got nothing"), ("killed", "n_jobs: got a worker process that ended .killed")]
)
def test_what_goes_wrong_in_a_process_is_said_and_what_is_made_beside_it_is_kept(how, words, rigs, tmp_path, monkeypatch):
    """Nothing is begun after it, as it may go wrong with all."""
    if how == "killed" and not hasattr(signal, "SIGKILL"):
        pytest.skip("no POSIX signals here")
    monkeypatch.setattr(at_once, "_Made", _Error if how == "error" else _Killed)
    monkeypatch.setattr(at_once, "in_words", lambda error: (tmp_path / "told").touch() or in_words(error))
    there = []

    def on_cell(report, name, seed, row, arrays):
        there.append(row)

    what = {"rows": _QUICK, "seeds": [5], "jobs": 2, "steps": lambda cell: tmp_path / cell, "on_cell": on_cell}
    with pytest.warns(UserWarning) as said, pytest.raises(InputError, match=words):
        study(rigs, **what)
    (text,) = [str(warning.message) for warning in said]
    assert re.match(f"tube, seed 5, free-form-supervised failed: {words}", text)
    assert text.endswith("; no further rows are started; rows that other processes have begun are finished first")
    assert not multiprocessing.active_children() and there == ["free-form"]  # the two that weigh most came first


@pytest.mark.usefixtures("patient", "own_processes")
@pytest.mark.slow
def test_rows_that_were_made_as_a_run_is_stopped_are_kept(rigs, tmp_path, monkeypatch):
    """Ctrl-C comes as another row is taken up."""
    monkeypatch.setattr(at_once, "_Made", _Waiting)
    there = []

    def on_cell(report, name, seed, row, arrays):
        there.append(row)
        if len(there) == 1:
            (tmp_path / "first is there").touch()
            while not (tmp_path / "second is made").exists():
                time.sleep(0.01)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study(rigs, rows=_QUICK, seeds=[5], jobs=2, steps=lambda cell: tmp_path / cell, on_cell=on_cell)
    assert there == ["free-form", "free-form-supervised"] and not multiprocessing.active_children()


@pytest.mark.parametrize("at_once_too, before", [(False, False), (False, True), (True, False)])
def test_errors_say_of_which_row_they_are(at_once_too, before, command, monkeypatch, capsys):
    """And that other rows are kept, where there are some."""
    if before:
        assert run([*command, "free-form-supervised", "--jobs", "1"]) == 0
        capsys.readouterr()

    def find(context):
        raise InputError("points", "nothing", "some")

    if at_once_too:
        monkeypatch.setattr(at_once, "as_they_may", _in_this_process)
        monkeypatch.setattr(at_once, "tell", lambda note: None)
    for row in ("oracle-labels", "oracle-fit"):
        monkeypatch.setitem(ROWS, row, replace(ROWS[row], find=find))
    rows = "oracle-labels,oracle-fit" if at_once_too else "oracle-fit"
    assert run([*command, rows]) == 2
    told, said = capsys.readouterr()
    said = said.splitlines()
    assert said[-1].startswith(f"lbsfit: error: tube, seed 5, {rows.split(',')[0]}: points: got nothing")
    kept = f"finished work is kept in {command[command.index('-o') + 1]}; run the same command to continue"
    assert (kept in told.splitlines()) == before
    warned = ["lbsfit: warning: tube, seed 5, oracle-labels failed: points: got nothing"] if at_once_too else []
    assert [line.split(";")[0] for line in said[:-1]] == warned


@pytest.mark.parametrize("error, words", [(MemoryError(), "out of memory"), (OSError(28, "No space left on device"), "No space")])
def test_errors_that_no_row_foresaw_say_where_they_were(error, words, command, monkeypatch, capsys):
    def study_set(*given):
        raise error

    monkeypatch.setattr("lbsfit_np.bench.study.making.study_set", study_set)
    assert run([*command, "oracle-fit"]) == 2
    assert capsys.readouterr().err.startswith(f"lbsfit: error: tube, seed 5: {words}")


def test_warnings_of_rows_are_given_here(rigs, monkeypatch):
    """In words and with their row, those of classes that cannot be sent, too."""
    notes = []

    class Odd(UserWarning):
        pass

    def made(name, rig, size, seed, rows, *, progress, **how):
        for row in rows:
            if row != rows[0]:
                progress(name, seed, row, 0.0)
            warnings.warn(f"odd {row}", Odd, stacklevel=1)
        return iter(())

    monkeypatch.setattr(at_once, "tell", notes.append)
    monkeypatch.setattr(at_once, "made", made)
    batch = Batch("tube", 5, ("cd", "joint"), frozenset(), frozenset())
    at_once._Made(rigs, {"tube": _SIZE}, {}, 2, state_of_the_code())((batch, False))
    told = [note for kind, note, *_ in notes if kind == "warning"]
    assert told == ["tube, seed 5, cd: odd cd", "tube, seed 5, joint: odd joint"]
    monkeypatch.setattr(at_once, "as_they_may", lambda *a, heard, **k: heard(("warning", told[0])))
    with pytest.warns(UserWarning, match="^tube, seed 5, cd: odd cd$"):
        at_once.made_at_once([batch], rigs, {}, jobs=2, steps=lambda cell: None, progress=None, on_row=None)


def test_a_process_that_has_read_other_code_is_refused(rigs):
    batch = Batch("tube", 5, ("cd",), frozenset(), frozenset())
    with pytest.raises(InputError, match="lbsfit_np: got files or libraries that have changed.*same command .*to continue"):
        at_once._Made(rigs, {"tube": _SIZE}, {}, 2, "of before")((batch, False))


class _Told(at_once._Made):
    """In place of what makes rows."""

    def __call__(self, task):
        batch, gone_on = task
        for what in batch.brings:
            tell(("reached", what))
        for row in batch.rows:
            self.before(row)
            cell = {"arrays": "", "code": "", "gone_on": gone_on}
            tell(("row", batch.name, batch.seed, row, cell, {"long": bytes(10**6)}))  # more than a pipe takes

    def before(self, row):
        """Nothing."""


class _Error(_Told):
    """That fails while the row beside it is at work."""

    def before(self, row):
        folder = self.folders["tube-5-free-form"].parent
        mine, other = ("one", "other") if row == "free-form" else ("other", "one")
        if row in ("free-form", "free-form-supervised"):
            (folder / mine).touch()
            while not (folder / other).exists():
                time.sleep(0.01)
        if row == "free-form":
            while not (folder / "told").exists():  # that the other one has failed
                time.sleep(0.01)
        elif row == "free-form-supervised":
            self.fail()

    def fail(self):
        raise InputError("points", "nothing", "some")


class _Killed(_Error):
    def fail(self):
        os.kill(os.getpid(), signal.SIGKILL)


class _Waiting(_Told):
    """The second row is made while the first is taken up."""

    def before(self, row):
        folder = self.folders["tube-5-free-form"].parent
        if row == "free-form-supervised":
            while not (folder / "first is there").exists():
                time.sleep(0.01)
            (folder / "second is made").touch()


def _in_this_process(work, take, *, jobs, answered, heard, failed):
    while (given := take()) is not None:
        try:
            answered(given[0], work(given[1]))
        except InputError as error:
            failed(given[0], error)
