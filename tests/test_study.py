"""Runs of the paper's study, and the command: what is kept, what is refused, and that a run goes on where it stopped."""

import json
import re
import shutil
from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from study_sizes import TINY, few_steps_along_path

from lbsfit_np.bench.environment import installed
from lbsfit_np.bench.run import TRAINING_SEED
from lbsfit_np.bench.study import local_optimum
from lbsfit_np.bench.study import rows as rows_module
from lbsfit_np.bench.study import run as run_module
from lbsfit_np.bench.study.data import SIZES, study_set
from lbsfit_np.bench.study.making import cell_name
from lbsfit_np.bench.study.measures import Registrations
from lbsfit_np.bench.study.page import console_table, page
from lbsfit_np.bench.study.paper import GOALS
from lbsfit_np.bench.study.rows import LIBRARY, PRETRAINING, ROWS, Found
from lbsfit_np.bench.study.run import joined, study
from lbsfit_np.cli import bench_study
from lbsfit_np.cli import main as run
from lbsfit_np.errors import InputError
from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.io.write import write_npz
from lbsfit_np.learning.fitter import LBSFitter


def _true(c):
    """A row that finds the truth, and nothing for the last scan."""
    vertices, joints = (np.array([getattr(s, name) for s in c.given.test]) for name in ("vertices", "joints"))
    vertices[-1] = np.nan
    c.progress(0.5)
    said = [np.where(np.arange(len(s.labels)) % 4, s.labels, 0) for s in c.given.test]
    fitted = [s.labels for s in c.given.test[:-1]] + [None]
    own = {"labels": said, "fitted_labels": fitted, "kept_accuracy": 0.9}
    history = [{"round": 0, "kept": False}, {"round": 1, "kept": True}]
    return Found(Registrations(vertices, joints), accuracy=[0.5, c.right(said)], history=history, **own)


@pytest.fixture
def quick(monkeypatch):
    """Rows that are quick, and a size that is tiny."""
    made = []

    def counted(c):
        made.append(c.seed)
        return _true(c)

    quick_rows = {name: replace(row, find=counted) for name, row in ROWS.items()}
    monkeypatch.setattr("lbsfit_np.bench.study.making.ROWS", quick_rows)
    monkeypatch.setitem(SIZES, "small", TINY)
    monkeypatch.setitem(LBSFitter.__init__.__kwdefaults__, "training", {"n_points": 100})  # no row asks what was pretrained
    for module in (local_optimum, run_module):
        monkeypatch.setattr(module, "along_path", few_steps_along_path)
    return made


def test_a_run_measures_writes_and_goes_on(coarse_hand, quick):
    kept, shares = {}, []
    arguments = {"size": "small", "rows": ("joint", "cd"), "seeds": [1]}
    report = study(
        {"h": coarse_hand},
        **arguments,
        progress=lambda *a: shares.append(a),
        on_cell=lambda report, name, seed, row, arrays: kept.update({cell_name(name, seed, row): arrays}),
    )
    assert report["complete"] and set(kept) == {"h-1-cd", "h-1-joint"} and ("h", 1, "cd", 0.5) in [share[:4] for share in shares]
    cell = report["rigs"]["h"]["seeds"]["1"]["joint"]
    assert cell["unfitted"] == 1 and cell["pose"] == 0 and 0.75 <= cell["accuracy"][1] < 1 and cell["fitted_labels"] == 1
    assert kept["h-1-cd"]["vertices"].shape == (3, *coarse_hand.vertices.shape)
    quick.clear()
    again = study({"h": coarse_hand}, before=report, **arguments | {"seeds": [1, 2]})
    assert quick == [2, 2] and again["rigs"]["h"]["seeds"]["1"] == report["rigs"]["h"]["seeds"]["1"]
    quick.clear()
    study({"h": coarse_hand}, before=report, kept=lambda cell, digest: cell != "h-1-cd", **arguments)
    assert quick == [1]
    assert len(cell["kept_accuracy_scans"]) == 3 and np.mean(cell["kept_accuracy_scans"]) == pytest.approx(cell["accuracy"][1])


def test_reports_of_something_else_are_refused(coarse_hand, quick):
    report = study({"h": coarse_hand}, rows=("joint",), seeds=[1])
    with pytest.raises(InputError, match="size small.*size medium"):
        study({"h": coarse_hand}, size="medium", before=report)
    with pytest.raises(InputError, match="results of 'h' with other rig"):
        study({"h": load_rig("hand-left-coarse")}, before=report)
    with pytest.raises(InputError, match="results of 'h' with other poses"):
        study({"h": replace(coarse_hand, poses=dict(list(coarse_hand.poses.items())[:20]))}, before=report)
    still = np.arange(len(coarse_hand.parents)) == 1
    cards = ({"up": "+x"}, {"forward": "-z"}, {"metres_per_unit": 0.5}, {"locked": still})
    facts = ("up", "forward", "metres per unit", "rig and other joints that are still and other poses")
    for card, what in zip(cards, facts, strict=True):
        with pytest.raises(InputError, match=f"results of 'h' with .*{what} than this run's"):
            study({"h": replace(coarse_hand, **card)}, before=report)
    quick.clear()
    older = deepcopy(report)
    for key in ("up", "forward", "metres_per_unit", "joints_that_are_still", "library"):
        del older["rigs"]["h"][key]
    assert study({"h": coarse_hand}, rows=("joint",), seeds=[1], before=older)["rigs"]["h"] == older["rigs"]["h"] and not quick
    both = joined(older, study({"h": coarse_hand}, rows=("joint",), seeds=[2]))
    assert both["rigs"]["h"]["seeds"].keys() == {"1", "2"}
    assert joined(report, study({"h": replace(coarse_hand, up="+x")}, rows=("joint",), seeds=[2]))["rigs"] == report["rigs"]
    with pytest.raises(InputError, match="results of starts.*results of study"):
        study({"h": coarse_hand}, before={"benchmark": "starts"})
    meant = (("jiont",), "some of free-form.* Did you mean 'joint'")
    for rows, words in ((("joint", "nothing"), "some of free-form"), meant, ((), "some of free-form")):
        with pytest.raises(InputError, match=f"^rows: .*{words}"):
            study({"h": coarse_hand}, rows=rows)


def _without_times(page):
    """The tables of a page without their last columns, which the seconds are in."""
    return re.sub(r"\| \d+ \|$", "|", page.split("---\n\n")[0], flags=re.MULTILINE)


def test_the_command_writes_a_page_and_resumes(quick, tmp_path, capsys):
    out = tmp_path / "study"
    command = ["bench", "study", "--rig", "hand-coarse", "--rows", "joint,rand", "--no-figures", "-o", str(out)]
    assert run(command) == 1  # a scan could not be fitted
    said = capsys.readouterr().out
    assert "hand-coarse, seed 300, joint: pose 0.0000" in said and "Pose" in said
    text = (out / "README.md").read_text()
    assert "0.0000 [0.035]" in text and "## Where the protocols differ" in text and "![" not in text
    assert {path.name for path in (out / "cells").iterdir()} == {"hand-coarse-300-joint.npz", "hand-coarse-300-rand.npz"}
    quick.clear()
    assert run(command) == 1 and quick == []
    assert "made by other code" not in capsys.readouterr().out
    assert (out / "README.md").read_text() == text
    cell = out / "cells" / "hand-coarse-300-rand.npz"
    cell.write_bytes((out / "cells" / "hand-coarse-300-joint.npz").read_bytes())  # of another run than the results
    changed = read_npz(cell)
    write_npz(cell, **changed | {"joints": changed["joints"] + 1})
    assert run(command) == 1 and quick == [300]
    assert _without_times((out / "README.md").read_text()) == _without_times(text)
    results = json.loads((out / "results.json").read_text())
    results["rigs"]["hand-coarse"]["seeds"]["300"]["joint"]["code"] = "other"
    (out / "results.json").write_text(json.dumps(results))
    capsys.readouterr()
    assert run(command) == 1 and quick == [300]
    note = f"note: kept 1 row in {out} that was made by other code or libraries: hand-coarse-300-joint;"
    assert note in capsys.readouterr().out
    assert run([*command, "--size", "medium"]) == 2 and "--existing replace" in capsys.readouterr().err
    assert run(["bench", "study"]) == 2 and "-o OUT" in capsys.readouterr().err
    same = ["bench", "study", "--rig", "hand-coarse,mine/hand-coarse", "-o", str(tmp_path / "b")]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "README.md").write_text("mine")
    assert run([*command[:-1], str(tmp_path / "mine")]) == 2 and "another README.md" in capsys.readouterr().err
    load_rig("hand-coarse").save(tmp_path / "hand-coarse.npz")
    same[3] = f"hand-coarse,{tmp_path / 'hand-coarse.npz'}"
    assert run(same) == 2 and "different names" in capsys.readouterr().err


def test_the_size_has_to_be_the_same(coarse_hand, quick, monkeypatch):
    report = study({"h": coarse_hand}, rows=("joint",), seeds=[1])
    monkeypatch.setitem(SIZES, "small", replace(TINY, train=6))
    with pytest.raises(InputError, match="'h' with other numbers of scans"):
        study({"h": coarse_hand}, rows=("joint",), seeds=[1], before=report)


def test_the_seed_of_the_training_is_kept_and_has_to_be_the_same(coarse_hand, quick):
    report = study({"h": coarse_hand}, rows=("joint",), seeds=[1])
    assert report["training_seed"] == TRAINING_SEED
    with pytest.raises(InputError, match="results with training_seed 5; expected training_seed 0"):
        study({"h": coarse_hand}, rows=("joint",), seeds=[1], before=report | {"training_seed": 5})


@pytest.mark.parametrize("lacking", ["people", "scans", "arrays"])
def test_results_of_an_earlier_version_are_refused_whichever_rigs_are_run(coarse_hand, quick, lacking):
    report = study({"h": coarse_hand, "other": coarse_hand}, rows=("joint",), seeds=[1])
    entry = report["rigs"]["other"]
    del (entry if lacking != "arrays" else entry["seeds"]["1"]["joint"])[lacking]
    with pytest.raises(InputError, match="results of 'other' by an earlier version.*--existing replace"):
        study({"h": coarse_hand}, rows=("joint",), seeds=[1], before=report)


@pytest.mark.parametrize("key, words", [("people", "test people"), ("scans", "scans")])
def test_results_of_other_people_or_scans_are_not_gone_on_with(coarse_hand, quick, key, words):
    report = study({"h": coarse_hand}, rows=("joint",), seeds=[1])
    report["rigs"]["h"][key] = "others"
    with pytest.raises(InputError, match=f"results of other {words} than 'h' now has.*--existing replace"):
        study({"h": coarse_hand}, rows=("joint",), seeds=[1], before=report)


def test_the_page_says_what_is_missed(coarse_hand, quick):
    report = study({"hand": coarse_hand}, rows=("joint", "rand"), seeds=[1, 2])
    for seed, pose in (("1", 0.03), ("2", 0.05)):
        report["rigs"]["hand"]["seeds"][seed]["joint"] |= {"pose": pose, "pose_median": pose}
    text = page(report, {"a.png": "A picture."})
    assert f"| Pose | 0.0400 (0.0300–0.0500) | ≤ {GOALS['pose']:g} | no |" in text and "0.0400 (0.0300–0.0500) [0.035]" in text
    assert "rand 0.0000 < joint 0.0400. Joint before rand: missed, of 6 scans, which are few." in text
    assert "| labels of the segmenter alone | 0.900 (0.900–0.900) | ≥ 0.95 | no |" in text and "![a](a.png)\n\nA picture." in text
    assert "| Recon ÷ its value at the truth | 1.00 (1.00–1.00) | ≤ 1.05 | yes |" in text
    assert console_table(report).count("joint") >= 2


def test_rows_are_compared_over_the_seeds_that_all_of_them_have(coarse_hand, quick):
    report = study({"h": coarse_hand}, rows=("joint", "cd", "oracle-fit"), seeds=[1, 2])
    assert report["complete"]
    seeds = report["rigs"]["h"]["seeds"]
    for row, poses in {"joint": (0.05, 0.01), "cd": (0.03, 0.02), "oracle-fit": (0.001, 0.005)}.items():
        for seed, pose in zip("12", poses):
            seeds[seed][row]["pose"] = seeds[seed][row]["pose_median"] = pose
    assert "- Pose: cd 0.0250 < joint 0.0300. Joint before cd: missed" in page(report, {})
    assert "Joint ÷ oracle fit: Recon 1.00, Pose 10.00" in page(report, {})
    del seeds["1"]["cd"], seeds["1"]["oracle-fit"]
    text = page(report, {})
    assert "joint 0.0100 < cd 0.0200. Joint before cd: kept, of 3 scans, which are few." in text
    assert "Joint ÷ oracle fit: Recon 1.00, Pose 2.00" in text
    again = study({"h": coarse_hand}, rows=("joint",), seeds=[1], before=report)
    assert not again["complete"] and study({"h": coarse_hand}, rows=("cd", "oracle-fit"), seeds=[1], before=again)["complete"]


def test_what_cannot_be_fitted_has_a_reason(coarse_hand, quick, tmp_path, monkeypatch, capsys):
    arguments = ["bench", "study", "--rig", "hand-coarse", "--rows", "joint", "--no-figures", "-o", str(tmp_path)]
    assert run(arguments) == 1
    assert "failed: hand-coarse, seed 300, joint, scan 2: its fit is not finite" in capsys.readouterr().out
    fitted = rows_module.FromTemplate.__call__

    def sometimes(self, points):
        if np.array_equal(points, given_points[1]):
            raise InputError("points", "some", "others")
        return fitted(self, points)

    tiny_study = study_set(coarse_hand, TINY, 300)
    given_points = [s.points for s in tiny_study.test]
    monkeypatch.setattr(rows_module.FromTemplate, "__call__", sometimes)
    context = rows_module.Context(coarse_hand, tiny_study, TINY, 300, None, None, None, 1, lambda share: None)
    found = ROWS["free-form"].find(context)
    assert list(found.test.fitted) == [True, False, True] and found.failures == {1: "points: got some; expected others."}


@pytest.mark.parametrize(
    "given, rigs",
    [
        ([], ["hand", "body-coarse"]),
        (["--size", "medium"], ["hand", "body"]),
        (["--size", "paper"], ["hand", "body"]),
        (["--rig", "hand-left"], ["hand-left"]),
        (["--page"], ["hand", "body-coarse", "body"]),  # of whatever size the results are
    ],
)
def test_each_size_has_its_rigs(given, rigs, tmp_path, monkeypatch):
    """Fits of the full body would take too much of the small size's ten minutes."""
    asked = []

    def study(rigs, **options):
        asked.extend(rigs)
        raise InputError("here", "enough", "no more")

    def to_go_on_with(before, size, rigs):
        study(rigs)

    monkeypatch.setattr(run_module, "study", study)
    monkeypatch.setattr(run_module, "to_go_on_with", to_go_on_with)
    if "--page" in given:
        (tmp_path / "results.json").write_text('{"rigs": {"hand": {}, "body-coarse": {}, "body": {}}}')
    assert run(["bench", "study", "--no-figures", "-o", str(tmp_path), *given]) == 2
    assert asked == rigs


@pytest.mark.slow
def test_pictures_of_other_rigs_stay_on_the_page(coarse_hand, quick, tmp_path, monkeypatch, capsys):
    def draw(report, arrays, out, *, rigs, jobs):
        for name in rigs:
            (out / f"triplet-{name}.png").write_bytes(b"")
        return {f"triplet-{name}.png": f"of {name}, {len(rigs)}" for name in rigs}

    monkeypatch.setattr("lbsfit_np.bench.study.figures.draw", draw)
    arguments = ["bench", "study", "--rows", "joint", "-o", str(tmp_path), "--rig"]
    for rigs, more, words in (
        ("hand-coarse,hand-left-coarse", [], ["of hand-coarse, 2", "of hand-left-coarse, 2"]),
        ("hand-coarse", [], ["of hand-coarse, 1", "of hand-left-coarse, 2"]),
        ("hand-coarse", ["--no-figures"], ["of hand-coarse, 1", "of hand-left-coarse, 2"]),
    ):
        run([*arguments, rigs, *more])
        text = (tmp_path / "README.md").read_text()
        assert all(word in text for word in words), (rigs, more)
    drawn_by = json.loads((tmp_path / "results.json").read_text())["drawn_by"]
    assert drawn_by["matplotlib"] == installed("matplotlib") and drawn_by["of"].keys() == {"hand-coarse", "hand-left-coarse"}
    quick.clear()
    before = json.loads((tmp_path / "results.json").read_text())
    before["rigs"]["hand-coarse"]["seeds"]["300"]["joint"]["pose"] = 0.1234
    (tmp_path / "results.json").write_text(json.dumps(before))
    alone = json.dumps(before)

    def beside(*a, **k):  # another run, meanwhile
        now = json.loads(alone)
        now["rigs"]["hand-coarse"]["seeds"]["300"]["cd"] = now["rigs"]["hand-coarse"]["seeds"]["300"]["joint"]
        (tmp_path / "results.json").write_text(json.dumps(now))
        return draw(*a, **k)

    monkeypatch.setattr("lbsfit_np.bench.study.figures.draw", beside)
    run([*arguments, "hand-coarse", "--page"])
    assert "cd" in json.loads((tmp_path / "results.json").read_text())["rigs"]["hand-coarse"]["seeds"]["300"]
    (tmp_path / "results.json").write_text(alone)
    monkeypatch.setattr("lbsfit_np.bench.study.figures.draw", draw)
    run([*arguments, "hand-coarse", "--page"])
    text = (tmp_path / "README.md").read_text()
    assert not quick and "0.1234" in text and "of hand-coarse, 1" in text and "of hand-left-coarse, 2" in text
    before["rigs"]["hand-coarse"]["up"] = "+z"
    (tmp_path / "results.json").write_text(json.dumps(before))
    capsys.readouterr()
    assert run([*arguments, "hand-coarse", "--page"]) == 2 and "with other up than" in capsys.readouterr().err
    (tmp_path / "results.json").write_text(alone)
    shutil.rmtree(tmp_path / "cells")
    run([*arguments, "hand-coarse,hand-left-coarse", "--page"])  # without what pictures are made of, these stay as they are
    assert "of hand-coarse, 1" in (tmp_path / "README.md").read_text()
    capsys.readouterr()
    assert run(["bench", "study", "-o", str(tmp_path / "none"), "--page"]) == 2 and not (tmp_path / "none").exists()
    assert "with no results.json; expected a folder of the study. Leave out --page" in capsys.readouterr().err
    (tmp_path / "triplet-hand-left-coarse.png").unlink()
    run([*arguments, "hand-coarse", "--no-figures"])
    assert "of hand-left-coarse" not in (tmp_path / "README.md").read_text()


def test_the_page_and_its_pictures_are_of_one_state(coarse_hand, quick, tmp_path, monkeypatch):
    """The way out of the local optimum, which is drawn as it now is, and whether pictures are of the rows that there are."""
    monkeypatch.setattr("lbsfit_np.bench.study.figures.draw", lambda *a, **k: {})
    results, now = tmp_path / "results.json", {"rise": 1.25}
    for module in (run_module, local_optimum):
        monkeypatch.setattr(module, "along_path", lambda rig: now)
    arguments = ["bench", "study", "--rig", "hand-coarse", "-o", str(tmp_path), "--rows"]

    def entry_after(*more, **changed):
        report = json.loads(results.read_text())
        report["rigs"]["hand-coarse"] |= changed
        report["drawn_by"]["of"]["hand-coarse"] = "earlier"
        results.write_text(json.dumps(report))
        run([*arguments, *more])
        report = json.loads(results.read_text())
        return report["rigs"]["hand-coarse"]["local_optimum"], report["drawn_by"]["of"]["hand-coarse"] == "earlier"

    monkeypatch.setattr("lbsfit_np.bench.study.page.tables.more", lambda *a: "")
    run([*arguments, "joint"])
    assert entry_after("joint", "--page", local_optimum={"rise": 9.0}) == (now, False)
    assert entry_after("joint,rand", "--no-figures", local_optimum={"rise": 9.0}) == (now, True)
    (tmp_path / "cells" / f"{cell_name('hand-coarse', 300, 'rand')}.npz").unlink()
    assert entry_after("joint")[1]  # pictures that need rand stay as they were


def test_the_command_says_what_is_missing_and_what_goes_on(quick, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("lbsfit_np.cli.bench_study.find_spec", lambda name: None)
    monkeypatch.setattr("lbsfit_np.cli.bench_study.SILENCE", -1.0)

    def stopped(*a, **k):
        k["on_begun"]({}, [], ["h-300-cd", "h-300-rand"])
        k["progress"]("h", 300, "pretraining", 0.9, 0.1)
        k["progress"]("b", 300, "oracle-fit", 0.1, 0.1)
        k["progress"]("h", 300, "pretraining", 1.0, 0.2)
        k["progress"]("h", 300, "joint", 0.5, 0.25)
        k["progress"]("b", 300, "cd", 0.2, 0.35)
        raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.bench.study.run.study", stopped)
    assert run(["bench", "study", "--rig", "hand-coarse", "--rows", "joint", "-o", str(tmp_path)]) == 130
    text = capsys.readouterr().out
    assert "kept 2 rows in" in text and "that were made by other code or libraries: h-300-cd, h-300-rand; --existing" in text
    assert "10% of all rows; h 300 pretraining 90%, b 300 oracle-fit 10%\n20% of all rows; b 300 oracle-fit 10%\n" in text
    assert "35% of all rows; b 300 oracle-fit 10%, h 300 joint 50%, b 300 cd 20%\n" in text
    assert "'lbsfit_np[viz]'" in text and "run the same command to continue" in text


def test_a_bar_is_of_all_rows_and_names_those_that_are_being_made(monkeypatch):
    shown = []

    class Bar(SimpleNamespace):
        n = 0.0

        def update(self, by):
            self.n += by
            shown.append((round(self.n), self.words))

        def set_description_str(self, words, refresh):
            self.words = words

        def write(self, text, file):
            shown.append((text.split(":")[0], self.words))

    monkeypatch.setattr("lbsfit_np.cli.bench_study.percentage_bar", lambda words: Bar(words=words))
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    progress = bench_study._StudyProgress()
    for told in (("h", 300, "pretraining", 0.5, 0.1), ("h", 300, "pretraining", 1.0, 0.2), ("h", 300, "cd", 0.5, 0.4)):
        progress(*told)
    progress("b", 300, "rand", 0.25, 0.6)
    progress.cell("h", 300, "cd", {"seconds": 1.0})
    both = "h 300 cd 50%, b 300 rand 25%"
    assert shown == [(10, "h 300 pretraining 50%"), (20, ""), (40, "h 300 cd 50%"), (60, both), ("h, seed 300, cd", both[14:])]


def test_pretraining_without_a_segmenter_to_train_is_a_small_part_of_all():
    todo, told = {("h", 300): ["cd", "oracle-fit"], ("b", 300): ["cd"]}, []
    progress = run_module._of_all(todo, {"b"}, lambda name, seed, row, share, of_all: told.append(of_all))
    for name in ("h", "b"):
        progress(name, 300, "pretraining", 1.0)
    rows = 2 * ROWS["cd"].weight + ROWS["oracle-fit"].weight
    every = rows + PRETRAINING + LIBRARY
    assert told == pytest.approx([LIBRARY / every, (LIBRARY + PRETRAINING) / every]) and LIBRARY < PRETRAINING / 5


def test_the_command_keeps_each_row_as_soon_as_it_is_there(coarse_hand, quick, monkeypatch, tmp_path):
    """Seeds and processes are as asked; what is done when it stops is there, and is not done again."""
    asked = []
    made = run_module.made

    def stopping(name, rig, size, seed, rows, *, jobs, **how):
        asked.append((seed, rows, jobs))
        for row in made(name, rig, size, seed, rows, jobs=jobs, **how):
            yield row
            if len(asked) == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(run_module, "made", stopping)
    command = ["bench", "study", "--rig", "hand-coarse", "--rows", "cd,joint", "--seeds", "5,6", "--jobs", "5", "--no-figures"]
    assert run([*command, "-o", str(tmp_path)]) == 130
    kept = json.loads((tmp_path / "results.json").read_text())["rigs"]["hand-coarse"]["seeds"]
    assert {seed: set(rows) for seed, rows in kept.items()} == {"5": {"cd"}} and kept["5"]["cd"]["jobs"] == 5
    assert [path.name for path in (tmp_path / "cells").iterdir()] == ["hand-coarse-5-cd.npz"]
    assert run([*command, "-o", str(tmp_path)]) in (0, 1)
    assert asked == [(5, ("cd", "joint"), 5), (5, ("joint",), 5), (6, ("cd", "joint"), 5)]


def test_a_folder_that_cannot_be_made_is_told_before_any_work(quick, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("lbsfit_np.bench.study.run.study", None)
    (tmp_path / "cells").write_text("not a folder")
    assert run(["bench", "study", "--rig", "hand-coarse", "--rows", "joint", "-o", str(tmp_path)]) == 2
    assert "cells, a file; expected a folder to write to" in capsys.readouterr().err


def test_one_fit_has_no_correspondences(coarse_hand, quick, monkeypatch, tmp_path):
    monkeypatch.setitem(SIZES, "small", replace(TINY, test=2))
    assert run(["bench", "study", "--rig", "hand-coarse", "--rows", "joint,oracle-fit", "--no-figures", "-o", str(tmp_path)]) == 1
    text = (tmp_path / "README.md").read_text()
    assert "Joint ÷ oracle fit: Recon 1.00" in text and "Corre. before the snap" not in text.split("## Where")[0]


def test_other_rigs_have_no_goals(coarse_hand, quick):
    report = study({"h": coarse_hand}, rows=("joint", "rand"), seeds=[1])
    report["rigs"]["h"]["kind"] = "other"
    text = console_table(report)
    assert "goal" not in text and "[0.035]" not in text and "- Pose: " in text
