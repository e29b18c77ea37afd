"""``lbsfit bench hand`` and ``body``: what a run writes, how it goes on, its pictures, and bad usage."""

import json
from functools import partial

import numpy as np
import pytest
from cli_runs import content_with_few_starts, scans_of_hands_are_small
from learning_runs import learning_is_hurried

from lbsfit_np.bench import baseline as baseline_module
from lbsfit_np.bench import run as run_module
from lbsfit_np.bench.baseline import PlainChamfer
from lbsfit_np.bench.environment import commits, libraries, several
from lbsfit_np.bench.hand import hand_rig
from lbsfit_np.bench.pictures import shown
from lbsfit_np.bench.run import BENCHES, MEASURES, ROWS, run_bench
from lbsfit_np.bench.table import table
from lbsfit_np.cli import main
from lbsfit_np.cli.bench import ROW_NAMES
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.optimize.lbfgs import minimise

pytestmark = pytest.mark.usefixtures("own_cache", "hurried_fits")

QUICK = ("--scans", "2", "--seeds", "7", "--training-scans", "60")


class Own(run_module._Own):
    """Of whose fits, in whichever process, nothing hangs on how near they are."""

    def fit_scan(self, scan):
        with pytest.MonkeyPatch.context() as patch:
            learning_is_hurried(patch)
            return super().fit_scan(scan)


def _fits_are_hurried(patch):
    """Those of all rows."""
    learning_is_hurried(patch)
    content_with_few_starts(patch)
    patch.setattr(run_module, "_Own", Own)
    patch.setattr(baseline_module, "minimise", lambda *given, **more: minimise(*given, **more | {"max_iterations": 5}))


@pytest.fixture
def hurried_fits(monkeypatch):
    _fits_are_hurried(monkeypatch)


@pytest.fixture
def run(run):
    """Run ``lbsfit bench``."""
    return partial(run, "bench")


@pytest.fixture(scope="module")
def hand(shared_rigs):
    return hand_rig(shared_rigs)


@pytest.fixture(scope="module")
def ran(shared_rigs, cli_cache, tmp_path_factory):
    """A folder with the results of a tiny run of the hand, its exit code and the report."""
    out = tmp_path_factory.mktemp("ran") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LBSFIT_CACHE", str(cli_cache))
        _fits_are_hurried(patch)
        rows = ("--rows", ",".join(ROWS))
        code = main(["bench", "hand", "--data", str(shared_rigs), "-o", str(out), "--pictures", "2", *rows, *QUICK])
    return out, code, json.loads((out / "results.json").read_text(encoding="utf-8"))


# ---- the command ----


def test_a_run_writes_every_figure(ran):
    out, code, report = ran
    assert code == 0
    assert sorted(p.name for p in out.iterdir()) == ["results.json", "seed-7.png"]
    assert report["complete"] and report["benchmark"] == "hand" and report["seeds"] == [7] and report["scans_a_seed"] == 2
    assert set(report["rows"]) == set(ROWS)
    assert report["settings"]["fitter"]["training_scans"] == 60 and report["settings"]["fitter"]["random_state"] == 0
    assert report["settings"]["test_scans"]["n_points"] == 2500
    for row, content in report["rows"].items():
        seed = content["seeds"]["7"]
        assert {"numpy", "scipy", "scikit-learn", "lbsfit_np", "python", "cpus", "commit"} <= set(seed["environment"])
        assert [s["scan"] for s in seed["scans"]] == [0, 1] and seed["failed"] == 0 and seed["jobs"] == 1
        lacks = {"own": set(), "paper": set(), "plain": {"segmenter_labels"}, "oracle": {"segmenter_labels", "labels"}}[row]
        for scan in seed["scans"]:
            assert {"scan", "kind", "converged", "message", *set(MEASURES) - lacks} == set(scan)
        for measure in set(MEASURES) - lacks:
            values = [s[measure] for s in seed["scans"]]
            assert seed["mean"][measure] == pytest.approx(np.mean(values))
            assert content["over_seeds"]["median"][measure] == pytest.approx(np.median(values))
        assert set(seed["mean_by_kind"]) == {"uniform pose", "natural pose"}
    assert report["pictures"] == {"seed-7.png": [0, 1]} or report["pictures"] == {"seed-7.png": [1, 0]}


def test_lengths_are_in_half_sizes_and_true_labels_help(ran, hand):
    report = ran[2]
    assert report["rig_units_in_a_unit"] == pytest.approx(hand.size / 2)
    scan = {row: content["seeds"]["7"]["mean"] for row, content in report["rows"].items()}
    for measure, most in (("joint_error", 0.045), ("vertex_error", 0.06), ("recon", 0.06)):
        assert 0.005 < scan["oracle"][measure] < most
    assert 0.03 < scan["own"]["recon_truth"] < 0.06
    assert scan["oracle"]["joint_error"] < scan["own"]["joint_error"]
    assert scan["paper"]["segmenter_labels"] == scan["own"]["segmenter_labels"]
    assert scan["paper"]["vertex_error"] != scan["own"]["vertex_error"]
    assert 0.3 < scan["own"]["segmenter_labels"] < 1


def test_another_run_gives_the_same_figures_whatever_the_jobs(ran, shared_rigs):
    report = ran[2]
    again, fits = run_bench(BENCHES["hand"], shared_rigs, seeds=[7], n_scans=2, training_scans=60, jobs=2, rows=("own",))
    for a, b in zip(again["rows"]["own"]["seeds"]["7"]["scans"], report["rows"]["own"]["seeds"]["7"]["scans"], strict=True):
        assert {k: v for k, v in a.items() if k != "seconds"} == {k: v for k, v in b.items() if k != "seconds"}
    assert len(fits[7]) == 2 and fits[7][0][1].vertices.shape == fits[7][0][0].vertices.shape


def test_the_table_in_both_forms(ran):
    report = ran[2]
    plain, markdown = table(report), table(report, markdown=True)
    for text in (plain, markdown):
        for row in ROWS.values():
            assert row in text
        assert f"{report['rows']['own']['seeds']['7']['mean']['joint_error']:.4f}" in text
        assert "half sizes" in text and "joint_error ≤ 0.045" in text
    lines = markdown.splitlines()
    assert len({line.count("|") for line in lines[: 2 + len(ROWS)]}) == 1
    assert "| all |" not in markdown  # one seed only
    rows = report["rows"]
    two = {row: content | {"seeds": {**content["seeds"], "8": content["seeds"]["7"]}} for row, content in rows.items()}
    assert table(report | {"rows": two}, markdown=True).count("| all |") == len(ROWS)


def test_a_segmenter_is_told_of_where_one_was_trained(ran):
    report = ran[2]
    for rows in (("own", "plain"), ("paper",), ("plain", "oracle")):
        text = table(report | {"rows": {row: report["rows"][row] for row in rows}})
        assert ("Segmenter trained on 60 synthetic scans; lbsfit_np" in text) == (rows != ("plain", "oracle")), rows
        assert "lbsfit_np" in text


def test_shown_are_worst_median_and_best():
    fits = [(None, None if e is None else e, {"joint_error": e}) for e in (0.3, 0.1, None, 0.5, 0.2, 0.4)]
    assert shown(fits, 3) == [3, 0, 1]
    assert shown(fits, 1) == [3] and shown(fits, 0) == []
    assert sorted(shown(fits, 9)) == [0, 1, 3, 4, 5]


def test_results_are_not_overwritten_unless_asked(ran, run, shared_rigs):
    out = ran[0]
    before = (out / "results.json").read_bytes()
    code, _, err = run("hand", "--data", shared_rigs, "-o", out, *QUICK, "--scans", "3")
    assert (code, err.count("\n")) == (2, 1)
    assert "-o: got results with scans_a_seed 2; expected scans_a_seed 3." in err and "--existing replace" in err
    assert (out / "results.json").read_bytes() == before


# ---- going on ----


def _found(report):
    """A report without what hangs on when its rows were made."""
    if isinstance(report, list):
        return [_found(part) for part in report]
    if isinstance(report, dict):
        return {k: _found(v) for k, v in report.items() if k not in ("seconds", "wall_seconds", "training_seconds")}
    return report


@pytest.fixture
def run_stopped(monkeypatch):
    """(main's arguments, n) → the exit code of a run that Ctrl-C stops when it has made n rows."""
    fit_row = run_module._fit_row

    def stopped(arguments, n):
        made = []

        def stopping(*given):
            if len(made) == n:
                raise KeyboardInterrupt
            made.append(None)
            return fit_row(*given)

        with monkeypatch.context() as patch:
            patch.setattr(run_module, "_fit_row", stopping)
            return main([str(a) for a in arguments])

    return stopped


@pytest.mark.slow
def test_a_run_that_is_stopped_goes_on_to_the_same_figures(ran, run_stopped, shared_rigs, tmp_path, monkeypatch, capsys):
    out, fitted, fit_row = tmp_path / "out", [], run_module._fit_row
    rows = ("--pictures", "2", "--rows", ",".join(ROWS))
    command = ["bench", "hand", "--data", shared_rigs, "-o", out, *rows, *QUICK]
    assert run_stopped(command, 0) == 130 and not out.exists() and "kept" not in capsys.readouterr().out
    assert run_stopped(command, 2) == 130
    assert f"stopped: finished work is kept in {out}; run the same command to continue\n" in capsys.readouterr().out
    kept = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert set(kept["rows"]) == {"own", "plain"} and not kept["complete"] and (out / "seed-7.png").exists()
    assert run_stopped(command, 0) == 130 and "run the same command to continue" in capsys.readouterr().out
    monkeypatch.setattr(run_module, "_fit_row", lambda method, *more: fitted.append(type(method)) or fit_row(method, *more))
    assert main([str(a) for a in command]) == 0 and len(fitted) == 2
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert _found(report) == _found(ran[2])
    assert (out / "seed-7.png").read_bytes() == (ran[0] / "seed-7.png").read_bytes()
    for row in kept["rows"]:
        assert report["rows"][row] == kept["rows"][row]
    # Nothing is left to do, whatever the order; nor is anything trained.
    capsys.readouterr()
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained"))
    assert main([str(a) for a in command]) == 0 and len(fitted) == 2
    assert table(report | {"aims": BENCHES["hand"].aims}) in capsys.readouterr().out


def test_seeds_and_rows_are_added_to_those_that_are_there(run, run_stopped, shared_rigs, tmp_path, capsys, monkeypatch):
    scans_of_hands_are_small(monkeypatch)
    out = tmp_path / "out"
    command = ["hand", "--data", shared_rigs, "-o", out, "--scans", "1", "--rows"]

    def there():
        report = json.loads((out / "results.json").read_text(encoding="utf-8"))
        return {row: set(content["seeds"]) for row, content in report["rows"].items()}, report["complete"], report["seeds"]

    assert run(*command, "plain", "--seeds", "10")[0] == 0 and there() == ({"plain": {"10"}}, True, [10])
    assert run(*command, "oracle,plain", "--seeds", "9")[0] == 0
    assert there() == ({"plain": {"9", "10"}, "oracle": {"9"}}, False, [9, 10])
    code, text, _ = run(*command, "oracle,plain", "--seeds", "10,9", "--markdown")
    assert code == 0 and there() == ({"plain": {"9", "10"}, "oracle": {"9", "10"}}, True, [9, 10])
    rows = [[cell.strip() for cell in line.split("|")[1:3]] for line in text.splitlines() if line.startswith("| ")][1:]
    assert rows == [[ROWS[row], seed] for row in ("plain", "oracle") for seed in ("9", "10", "all")]
    # Those that are replaced are gone once one is made anew.
    replaced = ["bench", *command, "plain,oracle", "--seeds", "9", "--existing", "replace"]
    assert run_stopped(replaced, 1) == 130 and there() == ({"plain": {"9"}}, False, [9])
    assert "; run the same command without --existing replace to continue" in capsys.readouterr().out


def test_goals_and_measures_are_those_of_this_version(ran, shared_rigs):
    """Not of the one whose rows are kept; and in order, which files lack."""
    old = ran[2] | {"aims": {"joint_error": 9.0}, "measures": {"joint_error": "of old"}, "rig_units_in_a_unit": 7.0}
    report, _ = run_bench(BENCHES["hand"], shared_rigs, seeds=[7], n_scans=2, training_scans=60, before=old, rows=tuple(ROWS))
    assert json.loads(json.dumps(report)) == ran[2] and list(report["aims"]) == list(BENCHES["hand"].aims)
    assert list(report["measures"]) == list(MEASURES) and list(report)[:2] == ["benchmark", "unit"]
    assert "labels ≥ 0.85, joint_error ≤ 0.045" in table(report)


@pytest.mark.parametrize(
    ("kept", "given", "words"),
    [
        ({}, {"training_scans": 61}, "results with fitter training_scans 60; expected fitter training_scans 61"),
        ({}, {"n_scans": 3}, "results with scans_a_seed 2; expected scans_a_seed 3"),
        ({"benchmark": "body"}, {}, "results of body; expected results of hand"),
        ({"data": "other"}, {}, "results with other data than this run's"),
        ({"scans": "other"}, {}, "results with other scans than this run's"),
        ({"rig": {"metres_per_unit": 7.0}}, {}, "results with other metres per unit than this run's"),
        ({"rig": {"digest": "other"}}, {}, "results with other rig than this run's"),
        ({"settings": {"test_scans": {"noise": 0.1}}}, {}, "results with test_scans noise 0.1; expected test_scans noise 0.004"),
        ({"data": None}, {}, "results of hand without 'data'"),
    ],
)
def test_results_of_something_else_are_not_gone_on_with(ran, shared_rigs, monkeypatch, kept, given, words):
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained first"))
    options = {"seeds": [7, 8], "n_scans": 2, "training_scans": 60, "before": _changed(ran[2], kept)}
    with pytest.raises(InputError, match=f"before: got {words}.*--existing replace"):
        run_bench(BENCHES["hand"], shared_rigs, **options | given)


def _changed(report, changes):
    """A report with changes of the dicts within it; what is None is gone."""
    out = dict(report)
    for key, value in changes.items():
        out[key] = _changed(out[key], value) if isinstance(value, dict) else value
    return {key: value for key, value in out.items() if key not in changes or value is not None}


def test_pictures_of_others_are_not_drawn_over_and_those_that_are_gone_are_named(ran, run, shared_rigs, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "seed-7.png").write_bytes(b"mine")
    command = ("hand", "--data", shared_rigs, "-o", out, "--rows", "own", *QUICK)
    code, _, err = run(*command)
    assert code == 2 and "seed-7.png exists already" in err and (out / "seed-7.png").read_bytes() == b"mine"
    (out / "results.json").write_bytes((ran[0] / "results.json").read_bytes())
    (out / "seed-7.png").unlink()
    code, text, _ = run(*command)
    assert code == 0 and "note: no picture of seed 7, whose fits an earlier run has made; --existing replace" in text
    assert "no picture" not in run(*command, "--pictures", "0")[1]


@pytest.mark.slow
def test_pictures_of_a_run_that_was_replaced_are_drawn_over(run, run_stopped, shared_rigs, tmp_path, monkeypatch):
    scans_of_hands_are_small(monkeypatch)
    out = tmp_path / "out"
    size = ("--scans", "1", "--seeds", "7,8", "--training-scans", "60")
    command = ("hand", "--data", shared_rigs, "-o", out, "--rows", "own", *size)
    assert run(*command)[0] == 0 and (out / "seed-8.png").exists()
    drawn = (out / "seed-8.png").read_bytes()
    assert run_stopped(("bench", *command, "--existing", "replace"), 1) == 130
    assert run(*command)[0] == 0 and (out / "seed-8.png").read_bytes() == drawn
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert report["complete"] and report["pictures"] == {"seed-7.png": [0], "seed-8.png": [0]}


@pytest.mark.parametrize("where", ["lbsfit_np.report.render.write_png", "lbsfit_np.bench.pictures.picture"])
def test_no_figure_is_lost_for_a_picture(run, shared_rigs, tmp_path, monkeypatch, where):
    scans_of_hands_are_small(monkeypatch)
    out = tmp_path / "out"
    command = ("hand", "--data", shared_rigs, "-o", out, "--rows", "own,oracle", "--scans", "1", *QUICK[2:])

    def failing(*given, **more):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(where, failing)
        code, text, _ = run(*command)
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert code == 0 and report["complete"] and set(report["rows"]) == {"own", "oracle"} and "pictures" not in report
    assert "seed 7: no picture: " in text and "No space left on device" in text and "note:" not in text
    assert [path.name for path in out.iterdir()] == ["results.json"]
    assert "note: no picture of seed 7, whose fits an earlier run has made" in run(*command)[1]


def test_places_of_pictures_are_checked_before_anything_is_fitted(run, shared_rigs, tmp_path, monkeypatch):
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained first"))
    (tmp_path / "out" / "seed-7.png").mkdir(parents=True)
    for existing in ("replace", "resume"):
        command = ("hand", "--data", shared_rigs, "-o", tmp_path / "out", "--existing", existing)
        code, _, err = run(*command, "--rows", "own", *QUICK)
        assert code == 2 and "seed-7.png: got a folder" in err and err.count("\n") == 1


def test_pictures_of_another_number_of_fits_are_told(ran, run, shared_rigs, tmp_path):
    for name in ("results.json", "seed-7.png"):
        (tmp_path / name).write_bytes((ran[0] / name).read_bytes())
    command = ("hand", "--data", shared_rigs, "-o", tmp_path, *QUICK, "--pictures")
    for k in ("0", "1"):
        words = f"as many fits as an earlier run has drawn, not --pictures {k}: 2 of seed 7; --existing replace makes them again"
        assert words in run(*command, k)[1]
    for k in ("2", "3"):  # there are no more than two
        assert "note:" not in run(*command, k)[1]
    assert json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["pictures"] == ran[2]["pictures"]


def test_rows_of_several_commits_and_machines_are_told(ran):
    report = json.loads(json.dumps(ran[2]))
    assert "several states" not in table(report) and table(report).count(" CPUs, jobs 1") == 1
    report["rows"]["plain"]["seeds"]["7"]["jobs"] = 2
    report["rows"]["plain"]["seeds"]["7"]["environment"] |= {"commit": "0123456789abcdef"}
    text = table(report)
    assert " CPUs, jobs 1; and lbsfit_np" in text and " CPUs, jobs 2.\nRows are of several states of the code, by commit:" in text
    assert "; 0123456789ab: plain 7" in text


def test_states_of_the_code_in_words():
    made = [("a", {"commit": "0123456789abcdef+changes"}), ("b", {}), ("c", {"commit": None}), ("d", {"commit": "0123456789ab"})]
    states = commits(made)
    assert states == {"0123456789ab+changes": ["a"], "": ["b", "c"], "0123456789ab": ["d"]}
    assert several(states).endswith(", by commit: 0123456789ab+changes: a; unknown: b, c; 0123456789ab: d.")
    assert libraries({"scipy": "2", "numpy": "1", "scikit-learn": "3"}) == "numpy 1, scipy 2, scikit-learn 3"


def test_rows_of_changed_or_installed_code_are_told_by_the_code_itself(ran):
    made = [(row, {"commit": "a+changes", "code": code}) for row, code in zip("abc", ("1" * 64, "2" * 64, "1" * 64), strict=True)]
    assert commits(made) == {"a+changes (code 11111111)": ["a", "c"], "a+changes (code 22222222)": ["b"]}
    installed = [(row, env | {"commit": None}) for row, env in made] + [("d", {})]
    assert list(commits(installed)) == ["unknown (code 11111111)", "unknown (code 22222222)", "unknown (code not known)"]
    assert commits([(row, env | {"commit": "a"}) for row, env in made]) == {"a": ["a", "b", "c"]}  # with other libraries
    report = json.loads(json.dumps(ran[2]))
    for row, content in report["rows"].items():  # as of an installed package
        content["seeds"]["7"]["environment"] |= {"commit": None, "code": f"{row:x<8}"}
    text = table(report)
    assert "Rows are of several states of the code, by commit: unknown (code " in text and "(code plainxxx): plain 7" in text


def test_scans_that_fail_are_named(run, shared_rigs, tmp_path, monkeypatch):
    fit = PlainChamfer.fit_scan
    count = iter(range(10))

    def sometimes(self, scan):
        if next(count) == 0:
            raise InputError("points", "something odd", "something else")
        return fit(self, scan)

    monkeypatch.setattr(baseline_module.PlainChamfer, "fit_scan", sometimes)
    code, out, _ = run("hand", "--data", shared_rigs, "-o", tmp_path / "out", "--rows", "plain", "--markdown", *QUICK)
    assert code == 1 and "failed: plain, seed 7, scan 0: points: got something odd" in out
    assert "| plain Chamfer from rest | 7 |" in out
    entry = json.loads((tmp_path / "out" / "results.json").read_text(encoding="utf-8"))["rows"]["plain"]["seeds"]["7"]
    assert entry["failed"] == 1 and "failed" in entry["scans"][0]
    assert entry["mean"]["joint_error"] == entry["scans"][1]["joint_error"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["results.json"]


@pytest.mark.parametrize("name", BENCHES)
def test_data_that_are_not_there(run, tmp_path, name):
    code, _, err = run(name, "--data", tmp_path / "nowhere", "-o", tmp_path / "out")
    assert code == 2 and err.count("\n") == 1 and "nowhere" in err and "no such folder" in err
    code, _, err = run(name, "--data", tmp_path, "-o", tmp_path / "out")
    assert code == 2 and err.count("\n") == 1 and all(f in err for f in BENCHES[name].files)
    (tmp_path / "file").write_text("")
    code, _, err = run(name, "--data", tmp_path / "file", "-o", tmp_path / "out")
    assert code == 2 and "a file" in err and not (tmp_path / "out").exists()


def test_data_that_lack_one_thing(tmp_path):
    (tmp_path / "webxr_hand").mkdir()
    (tmp_path / "webxr_hand" / "left.glb").write_bytes(b"")
    with pytest.raises(FileError, match=r"without hand_poses/\*\.handpose; expected a folder that holds hand_poses, webxr_hand"):
        BENCHES["hand"].check_data(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "--data: got nothing"),
        (("--data", "DATA"), "-o/--output: got nothing"),
        (("--data", "DATA", "-o", "OUT", "--seeds", "1,x"), "different whole numbers"),
        (("--data", "DATA", "-o", "OUT", "--seeds", "1,1"), "different whole numbers"),
        (("--data", "DATA", "-o", "OUT", "--seeds", "-1"), "seeds"),
        (("--data", "DATA", "-o", "OUT", "--rows", "own,owl"), "own, plain, oracle"),
        (("--data", "DATA", "-o", "OUT", "--scans", "0"), "at least 1"),
        (("--data", "DATA", "-o", "OUT", "--jobs", "0"), "at least 1"),
    ],
)
def test_usage(run, shared_rigs, tmp_path, arguments, words):
    places = {"DATA": shared_rigs, "OUT": tmp_path / "out"}
    code, _, err = run("body", *(places.get(a, a) for a in arguments))
    assert code == 2 and err.count("\n") == 1 and words in err and not (tmp_path / "out").exists()


def test_help_shows_defaults_and_an_example(run):
    for name, scans in (("hand", 40), ("body", 20)):
        code, out, _ = run(name, "--help")
        out = " ".join(out.split())
        assert code == 0 and f"(default: {scans})" in out and "(default: 100,101,102)" in out and f"lbsfit bench {name}" in out
    code, out, _ = run("--help")
    assert code == 0 and "hand" in out and "body" in out
    assert main(["bench"]) == 2


def test_seeds_and_rows_of_a_run(shared_rigs):
    assert tuple(ROWS) == ROW_NAMES
    for seeds in ([], [1, 1], [-1]):
        with pytest.raises(InputError, match="seeds"):
            run_bench(BENCHES["hand"], shared_rigs, seeds=seeds)
    with pytest.raises(InputError, match="some of own, plain, oracle"):
        run_bench(BENCHES["hand"], shared_rigs, rows=("owl",))
