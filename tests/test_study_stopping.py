"""Runs of the study that are stopped in the middle of a row, that begin anew, and that fill one folder together."""

import json
from dataclasses import replace

import numpy as np
import pytest
from study_sizes import rows_are_hurried

from lbsfit_np.bench.study import rows as rows_module
from lbsfit_np.bench.study import run as run_module
from lbsfit_np.bench.study.data import SIZES
from lbsfit_np.bench.study.run import joined, study
from lbsfit_np.cli import bench_study as cli_module
from lbsfit_np.cli import main as run
from lbsfit_np.errors import FileError
from lbsfit_np.io.write import write_npz
from lbsfit_np.learning import loop as loop_module
from lbsfit_np.learning.checkpoint import steps_in
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.segmentation.segmenter import Segmenter

FIT_SCAN = LBSFitter.fit_scan


@pytest.fixture
def command(tube_rig, tmp_path, monkeypatch):
    """A study of a few small scans of the tube, one of them held out, without rows."""
    rows_are_hurried(monkeypatch)
    monkeypatch.setitem(SIZES, "small", replace(SIZES["small"], test=1, test_subjects=1, training_scans=20))
    tube_rig.save(tmp_path / "tube.npz")
    out = ["-o", str(tmp_path / "out")]
    return ["bench", "study", "--rig", str(tmp_path / "tube.npz"), "--seeds", "5", "--no-figures", *out, "--rows"]


@pytest.fixture
def run_stopped(monkeypatch):
    """The command, stopped as by Ctrl-C when more than half of the test scans of a row are fitted; its exit code."""
    tried = rows_module.each_kept

    def stopping(work, tasks, slots, *, done, **others):
        def some(share):
            done(share)
            if share > 0.5:
                raise KeyboardInterrupt

        return tried(work, tasks, slots, done=some, **others)

    def stopped(arguments):
        with monkeypatch.context() as patch:
            patch.setattr(rows_module, "each_kept", stopping)
            return run(arguments)

    return stopped


def _rows(out):
    """Seed → row → its figures, as written."""
    return json.loads((out / "results.json").read_text())["rigs"]["tube"]["seeds"]


def _found(cell):
    """Figures without what hangs on when and how they were made."""
    return {k: v for k, v in cell.items() if k not in ("seconds", "jobs", "history", "environment")}


def test_a_row_that_is_stopped_goes_on(command, run_stopped, tube_rig, tmp_path, monkeypatch, capsys):
    """Nothing of it is done twice, its figures are those of a run at one go, and its steps are gone in the end."""
    out, fitted, fit_scan = tmp_path / "out", [], LBSFitter.fit_scan
    monkeypatch.setitem(SIZES, "small", replace(SIZES["small"], test=3, test_subjects=2))
    whole = study({"tube": tube_rig}, rows=("joint",), seeds=[5])["rigs"]["tube"]["seeds"]["5"]
    assert run_stopped([*command, "joint"]) == 130
    assert f"stopped: finished work is kept in {out}; run the same command to continue" in capsys.readouterr().out
    assert not (out / "results.json").exists() and steps_in(out / "cells" / "tube-5-joint.npz.unfinished") > 6
    monkeypatch.setattr(LBSFitter, "fit_scan", lambda self, *a: fitted.append(self.variant) or fit_scan(self, *a))
    monkeypatch.setattr("lbsfit_np.learning.loop.FirstFit.__call__", lambda self, task: fitted.append("first") or 1 / 0)
    steps = steps_in(out / "cells" / "tube-5-joint.npz.unfinished")
    assert run([*command, "joint"]) == 0
    found = f"found {steps} saved steps of an interrupted run in {out / 'cells' / 'tube-5-joint.npz.unfinished'}; those"
    assert found in capsys.readouterr().out
    found = _rows(out)["5"]["joint"]
    assert _found(found) == json.loads(json.dumps(_found(whole["joint"])))
    text = (out / "README.md").read_text()
    assert found["seconds"] is None and "; not timed, with 1 process." in text
    assert fitted == ["joint"]  # the last of three
    assert [path.name for path in (out / "cells").iterdir()] == ["tube-5-joint.npz"]


@pytest.mark.slow
def test_rows_that_learn_from_labels_have_first_fits_and_first_labels_in_common(command, tmp_path, monkeypatch):
    done, out = {"fits": 0, "labels": 0}, tmp_path / "out"

    def counted(owner, name, key):
        call = getattr(owner, name)

        def counting(*given, **more):
            done[key] += 1
            return call(*given, **more)

        monkeypatch.setattr(owner, name, counting)

    counted(loop_module.FirstFit, "__call__", "fits")
    counted(Segmenter, "predict", "labels")
    assert run([*command, "rand,joint"]) == 0
    found, size = _rows(out)["5"], SIZES["small"]
    rounds = sum(len(cell["accuracy"]) - 1 for cell in found.values())
    assert done == {"fits": size.train, "labels": (1 + rounds) * size.test}
    assert found["rand"]["seconds"] > 0 and found["joint"]["seconds"] > 0
    assert {path.name for path in (out / "cells").iterdir()} == {"tube-5-rand.npz", "tube-5-joint.npz"}


@pytest.mark.slow
def test_first_fits_stay_while_a_row_that_is_begun_has_nothing_else(command, run_stopped, tmp_path, monkeypatch):
    """Whatever is run meanwhile. A row that takes them has no time of its own; what learns without labels has no part in them."""
    cells, fitted, call = tmp_path / "out" / "cells", [], loop_module.FirstFit.__call__
    kept = cells / "tube-5-first-fits.npz.unfinished"

    def stop(self, task):
        if steps_in(kept):
            raise KeyboardInterrupt
        return call(self, task)

    assert run_stopped([*command, "cd"]) == 130 and not kept.exists()
    with monkeypatch.context() as patch:
        patch.setattr(loop_module.FirstFit, "__call__", stop)
        assert run([*command, "joint"]) == 130
    monkeypatch.setattr(loop_module.FirstFit, "__call__", lambda self, task: fitted.append(task) or call(self, task))
    assert run([*command, "rand,pose-only,oracle-labels"]) == 0 and steps_in(kept) == SIZES["small"].train
    found = _rows(tmp_path / "out")["5"]
    assert found["rand"]["seconds"] is None and found["pose-only"]["seconds"] > 0 and found["oracle-labels"]["seconds"] > 0
    assert run([*command, "joint"]) == 0 and len(fitted) == SIZES["small"].train - 1
    names = {f"tube-5-{row}.npz" for row in ("joint", "rand", "pose-only", "oracle-labels")}
    assert {path.name for path in cells.iterdir()} == names | {"tube-5-cd.npz.unfinished"}


def test_what_was_replaced_beside_a_run_does_not_come_back(command, tmp_path, monkeypatch):
    """It has the arrays of these rows no more."""
    out, made = tmp_path / "out", run_module.made
    assert run([*command, "free-form"]) == 0

    def with_another(name, rig, size, seed, rows, **how):
        if rows == ("oracle-fit",):
            assert run([*command, "oracle-labels", "--existing", "replace"]) == 0
        yield from made(name, rig, size, seed, rows, **how)

    monkeypatch.setattr(run_module, "made", with_another)
    assert run([*command, "oracle-fit"]) == 0
    assert set(_rows(out)["5"]) == {"oracle-fit", "oracle-labels"}
    assert {path.name for path in (out / "cells").iterdir()} == {f"tube-5-{row}.npz" for row in ("oracle-fit", "oracle-labels")}


@pytest.mark.parametrize("replaced", [False, True])
def test_a_row_that_another_run_has_written_over_is_there_again_unless_replaced(replaced, command, tmp_path, monkeypatch):
    """Two that write at once: the one that read before the other wrote has lost its row."""
    out, made = tmp_path / "out", run_module.made

    def with_another(name, rig, size, seed, rows, **how):
        for k, (row, *what) in enumerate(made(name, rig, size, seed, rows, **how)):
            if k == 1:
                results = json.loads((out / "results.json").read_text())
                del results["rigs"]["tube"]["seeds"]["5"]["free-form"]
                (out / "results.json").write_text(json.dumps(results))
                if replaced:
                    (out / "cells" / "tube-5-free-form.npz").unlink()
            yield row, *what

    monkeypatch.setattr(run_module, "made", with_another)
    assert run([*command, "free-form,oracle-fit"]) == 0
    assert set(_rows(out)["5"]) == ({"oracle-fit"} if replaced else {"free-form", "oracle-fit"})


def test_a_row_made_at_one_go_has_its_time(command, tmp_path):
    assert run([*command, "cd"]) == 0
    assert _rows(tmp_path / "out")["5"]["cd"]["seconds"] > 0
    assert " min for all rows, " in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.slow
def test_steps_of_another_model_are_not_taken(command, run_stopped, tmp_path, monkeypatch):
    """With other training scans, what was fitted before is fitted again, as in a fresh folder."""
    monkeypatch.setattr(LBSFitter, "fit_scan", FIT_SCAN)
    monkeypatch.setitem(SIZES, "small", replace(SIZES["small"], training_scans=10))
    assert run_stopped([*command, "cd"]) == 130
    monkeypatch.setitem(SIZES, "small", replace(SIZES["small"], training_scans=20))
    for out in ("out", "fresh"):
        assert run([*command, "cd", "-o", str(tmp_path / out)]) == 0
    gone_on, fresh = (np.load(tmp_path / out / "cells" / "tube-5-cd.npz")["vertices"] for out in ("out", "fresh"))
    np.testing.assert_array_equal(gone_on, fresh)


def test_steps_stay_until_the_row_is_written(command, tmp_path, monkeypatch):
    written = []

    def full(path, /, **arrays):
        written.append(path.name)
        if path.name == "tube-5-cd.npz":
            raise FileError(str(path), "an error while writing (No space left on device)", "a place that can be written to")
        return write_npz(path, **arrays)

    monkeypatch.setattr("lbsfit_np.io.write.write_npz", full)
    assert run([*command, "cd"]) == 2 and "tube-5-cd.npz" in written
    assert steps_in(tmp_path / "out" / "cells" / "tube-5-cd.npz.unfinished") >= 3


def test_steps_are_announced_for_rows_that_are_to_be_done(command, run_stopped, tmp_path, monkeypatch, capsys):
    """Not those of a row that is done, which are removed, nor of one that nobody asked for, which stay."""
    cells = tmp_path / "out" / "cells"
    assert run([*command, "oracle-fit"]) == 0 and run_stopped([*command, "cd"]) == 130
    steps = steps_in(cells / "tube-5-cd.npz.unfinished")
    (cells / "tube-5-oracle-fit.npz.unfinished").mkdir()
    (cells / "tube-5-oracle-fit.npz.unfinished" / f"result-{32 * '0'}.npz").write_bytes(b"")
    capsys.readouterr()
    assert run([*command, "oracle-fit"]) == 0 and "of an interrupted run" not in capsys.readouterr().out
    assert {path.name for path in cells.iterdir()} == {"tube-5-oracle-fit.npz", "tube-5-cd.npz.unfinished"}
    assert steps_in(cells / "tube-5-cd.npz.unfinished") == steps
    assert run([*command, "cd,oracle-fit"]) == 0 and f"found {steps} saved steps of an interrupted run" in capsys.readouterr().out


@pytest.mark.slow
def test_steps_of_a_row_that_has_to_be_made_again_stay(command, run_stopped, tmp_path):
    """One that the report has, but whose registrations are not there any more."""
    cells = tmp_path / "out" / "cells"
    assert run([*command, "cd,oracle-fit"]) == 0
    (cells / "tube-5-cd.npz").unlink()
    assert run_stopped([*command, "cd"]) == 130
    steps = steps_in(cells / "tube-5-cd.npz.unfinished")
    assert steps and run([*command, "oracle-fit"]) == 0 and steps_in(cells / "tube-5-cd.npz.unfinished") == steps


@pytest.mark.slow
def test_what_is_replaced_is_gone_before_anything_is_stopped(command, run_stopped, tmp_path, monkeypatch, capsys):
    """So that the command that goes on does the new, not what was to be replaced; also of another size."""
    out = tmp_path / "out"
    assert run([*command, "cd,oracle-fit"]) == 0
    (out / "mine.png").write_bytes(b"")
    (out / "drawn.png").write_bytes(b"")
    report = json.loads((out / "results.json").read_text())
    (out / "results.json").write_text(json.dumps(report | {"captions": {"drawn.png": "A picture."}}))
    (out / "cells" / "mine-5.npz").write_bytes(b"")
    monkeypatch.setitem(SIZES, "small", replace(SIZES["small"], pairs=2))
    assert run([*command, "cd"]) == 2 and "other numbers of scans" in capsys.readouterr().err
    assert run([*command, "nothing", "--existing", "replace"]) == 2 and len(_rows(out)["5"]) == 2 and (out / "README.md").exists()
    assert run_stopped([*command, "cd", "--existing", "replace"]) == 130
    said = capsys.readouterr().out
    assert f"note: removed 2 rows of earlier runs from {out}" in said
    assert said.endswith("; run the same command without --existing replace to continue\n")
    assert _rows(out) == {} and not (out / "README.md").exists()
    assert (out / "mine.png").exists() and not (out / "drawn.png").exists()
    steps = steps_in(out / "cells" / "tube-5-cd.npz.unfinished")
    assert {path.name for path in (out / "cells").iterdir()} == {"tube-5-cd.npz.unfinished", "mine-5.npz"} and steps >= 2
    assert run([*command, "cd"]) == 0 and f"found {steps} saved steps of an interrupted run" in capsys.readouterr().out
    assert list(_rows(out)["5"]) == ["cd"] and _rows(out)["5"]["cd"]["seconds"] is None


def test_steps_are_gone_where_all_is_to_be_done_anew(command, tmp_path, monkeypatch, capsys):
    steps = tmp_path / "out" / "cells" / "tube-5-joint.npz.unfinished"
    steps.mkdir(parents=True)
    (steps / f"result-{32 * '0'}.npz").write_bytes(b"")
    monkeypatch.setattr(run_module, "made", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
    assert run([*command, "joint"]) == 130 and steps_in(steps) == 1
    capsys.readouterr()
    assert run([*command, "joint", "--existing", "replace"]) == 130 and not steps.exists()
    said = capsys.readouterr().out
    assert "of an interrupted run" not in said
    assert said.endswith("; run the same command without --existing replace to continue\n")


def test_stopped_before_anything_was_done_nothing_is_said_to_be_kept(command, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "made", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
        assert run([*command, "joint"]) == 130
    assert "kept" not in capsys.readouterr().out and not (tmp_path / "out").exists()


def test_two_studies_fill_one_folder(command, tmp_path, monkeypatch):
    """What another run has written meanwhile, of another seed or row, stays."""
    out, made = tmp_path / "out", run_module.made

    def with_another(name, rig, size, seed, rows, **how):
        if seed == 5 and rows == ("cd",):
            assert run([*command, "oracle-fit", "--seeds", "5,6"]) == 0
        yield from made(name, rig, size, seed, rows, **how)

    monkeypatch.setattr(run_module, "made", with_another)
    assert run([*command, "cd"]) == 0
    assert {seed: set(rows) for seed, rows in _rows(out).items()} == {"5": {"cd", "oracle-fit"}, "6": {"oracle-fit"}}
    assert not json.loads((out / "results.json").read_text())["complete"]
    write_page = cli_module._write_page

    def drawing(*a, **k):  # takes long enough for another run to come to its end
        with monkeypatch.context() as patch:
            patch.setattr(cli_module, "_write_page", write_page)
            assert run([*command, "oracle-fit", "--seeds", "7"]) == 0
        return write_page(*a, **k)

    with monkeypatch.context() as patch:
        patch.setattr(cli_module, "_write_page", drawing)
        assert run([*command, "cd"]) == 0
    assert {seed: set(rows) for seed, rows in _rows(out).items()}["7"] == {"oracle-fit"}
    assert run([*command, "cd"]) == 0
    assert "Fewer seeds: tube, cd: 5 alone." in (out / "README.md").read_text()


def test_reports_are_joined_where_they_are_of_the_same():
    entry = {"digest": "a", "poses": "b", "people": "c", "scans": "d", "size": {}}
    ours = {"benchmark": "study", "size": "small", "scan": {}, "training_seed": 0, "complete": True}
    x, y = {"seeds": {"9": {"cd": 2}, "10": {"cd": 3}}}, {"seeds": {"9": {"cd": 4}}}
    theirs = ours | {"rigs": {"x": entry | x, "y": entry | y}}
    ours["rigs"] = {"x": entry | {"seeds": {"10": {"cd": 1}}}}
    found = joined(ours, theirs)
    assert list(found["rigs"]["x"]["seeds"].items()) == [("9", {"cd": 2}), ("10", {"cd": 1})] and found["complete"]
    assert found["rigs"]["y"]["seeds"] == {"9": {"cd": 4}} and len(ours["rigs"]) == 1
    for key, value in {"size": "medium", "training_seed": 1}.items():
        assert joined(ours, theirs | {key: value}) == ours
    for key in ("digest", "poses", "people", "scans", "size"):
        other = {"x": entry | {key: "other", "seeds": {"9": {"cd": 2}}}}
        assert joined(ours, theirs | {"rigs": other}) == ours
