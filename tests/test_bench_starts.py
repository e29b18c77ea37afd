"""The benchmark of starts: its rows, what it counts, what it keeps, the table, and the command."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import learning_is_hurried

import lbsfit_np as lbs
from lbsfit_np.bench import baseline
from lbsfit_np.bench import starts as module
from lbsfit_np.bench.conditions import CONDITIONS, SEEN
from lbsfit_np.bench.starts import AIM_AUC, AIM_CAUGHT, FITS, RIGS, starts_bench, starts_scan, starts_table
from lbsfit_np.cli.bench import CONDITION_NAMES, FIT_NAMES
from lbsfit_np.errors import InputError
from lbsfit_np.optimize.lbfgs import minimise

pytestmark = pytest.mark.usefixtures("own_cache")


def test_rows_and_goals_are_those_set_for_them():
    goals = {row: (c.goal, c.close) for row, c in CONDITIONS.items()}
    assert goals == {
        "0.3": (0.99, 0.015),
        "0.6": (0.98, 0.015),
        "1.0": (0.95, 0.015),
        "turned": (0.97, 0.015),
        "rotated": (0.90, 0.015),
        "unit": (0.97, 0.03),
        "touching": (0.95, 0.015),
        "partial": (0.85, 0.03),
        "cropped": (0.90, 0.03),
        "edge": (0.85, 0.03),
        "dirty": (0.95, 0.03),
        "subjects": (0.95, 0.03),
        "arm": (0.90, 0.015),
    }
    assert (AIM_AUC, AIM_CAUGHT, RIGS) == (0.97, 0.80, ("hand", "body"))
    assert CONDITION_NAMES == tuple(CONDITIONS) and FIT_NAMES == tuple(FITS)


# ---- what is counted ----


class Known:
    """A fitter that is told the truth, and misses it by a share of the size that the number of the scan decides."""

    misses = (0.001, 0.02, 0.2, None)
    probable = (0.9, 0.8, 0.1)

    def __init__(self, rig, **parameters):
        self.rig, self.parameters, self.fitted, self.trained = rig, parameters, 0, False
        self.made.append(self)

    def pretrain(self, *, cache, progress):
        assert cache
        self.trained = True

    def fit_scan(self, scan, labels=None):
        truth = type(self).truth
        assert labels is None or labels is truth.labels
        assert getattr(scan, "points", scan) is truth.points
        miss = self.misses[self.fitted % 4]
        self.fitted += 1
        if miss is None:
            raise InputError("points", "nothing", "something")
        joints = truth.joints + np.array([miss * self.rig.size * truth.scale, 0, 0])
        told = {"status": "ok", "message": "", "seconds": 0.5, "probability": self.probable[(self.fitted - 1) % 4]}
        std = np.full(len(joints), 0.01 * truth.scale)
        return SimpleNamespace(joints=joints, joint_std=std, scale=truth.scale, evidence={}, **told)


@pytest.fixture
def known(monkeypatch):
    """Fits without fitting."""

    def scan(*arguments):
        Known.truth = starts_scan(*arguments)
        return Known.truth

    monkeypatch.setattr(Known, "made", [], raising=False)
    monkeypatch.setattr(module, "starts_scan", scan)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter", Known)
    monkeypatch.setattr(module, "PlainChamfer", Known)
    return Known


QUICK = {"n_scans": 4, "seed": 3, "training_scans": 60}


def test_figures_are_shares_of_the_size_times_the_scale(known):
    report = starts_bench(["hand-coarse"], rows=["0.3", "unit"], fits=("own",), **QUICK)
    strict, starred = (report["rigs"]["hand-coarse"]["rows"][row]["fits"]["own"] for row in ("0.3", "unit"))
    for figures in (strict, starred):
        assert [e.get("joint_error") for e in figures["scans"]] == pytest.approx([0.001, 0.02, 0.2, None])
        assert figures["median"] == pytest.approx(0.02) and figures["failed"] == 1
        assert figures["scans"][3]["failed"] == "points: got nothing; expected something."
        assert all(e["scale_error"] == 0 and e["joints"] == 16 for e in figures["scans"][:3])
    assert strict["success"] == 0.25 and starred["success"] == 0.5
    assert report["complete"] and report["settings"]["seed"] == 3 and report["benchmark"] == "starts"
    assert report["rigs"]["hand-coarse"]["rows"]["unit"]["condition"]["fitter"] == {"orientation": "upright", "scale": "estimate"}
    assert json.loads(json.dumps(report)) == report


def test_fitters_are_told_what_the_row_is_about(known):
    starts_bench(["hand-coarse"], effort="fast", jobs=1, **QUICK | {"n_scans": 1})
    told = {row: fitter.parameters for row, fitter in zip(CONDITIONS, known.made, strict=True)}
    always = {"training_scans": 60, "effort": "fast", "n_jobs": 1, "random_state": 0}
    assert all(parameters.items() >= always.items() for parameters in told.values()) and all(f.trained for f in known.made)
    orientation = {row: parameters.get("orientation") for row, parameters in told.items()}
    assert orientation == {
        **dict.fromkeys(("0.3", "0.6", "1.0", "subjects"), "aligned"),
        **dict.fromkeys(("turned", "unit", "partial", "cropped", "edge", "dirty", "arm"), "upright"),
        "rotated": "any",
        "touching": None,
    }
    for name, rows in (("partial", ["partial", "edge"]), ("cropped", ["cropped", "edge"])):
        assert [row for row, parameters in told.items() if parameters.get(name)] == rows


@pytest.mark.parametrize("row", ["partial", "cropped", "edge"])
def test_of_scans_that_do_not_show_all_seen_joints_count(row, known):
    report = starts_bench(["body-coarse"], rows=[row], **QUICK | {"n_scans": 3})
    rig = lbs.load_rig("body-coarse")
    for e in report["rigs"]["body-coarse"]["rows"][row]["fits"]["own"]["scans"]:
        labels = starts_scan(rig, row, e["scan"], 3).labels
        seen = np.bincount(labels, minlength=len(rig.parts)) >= SEEN
        assert e["joints"] == seen.sum() <= 24
        known.truth = starts_scan(rig, row, e["scan"], 3)


def test_hidden_joints_do_not_count(known, monkeypatch):
    """A joint whose part is out of sight may be anywhere."""
    rig = lbs.load_rig("body-coarse")
    scan = starts_scan(rig, "partial", 0, 3)
    hidden = rig.parts.index("left_hand")
    scan = replace(scan, labels=np.where(scan.labels == hidden, rig.parts.index("left_wrist"), scan.labels))
    monkeypatch.setattr(module, "starts_scan", lambda *arguments: scan)
    joints = scan.joints.copy()
    joints[rig.part_of_joint == hidden] += 10.0
    told = {"status": "ok", "message": "", "seconds": 1.0, "probability": 0.5, "evidence": {}}
    found = SimpleNamespace(joints=joints, joint_std=np.full(len(joints), np.nan), scale=1.0, **told)
    fitter = SimpleNamespace(fit_scan=lambda points: found)
    assert module._OneScan(rig, "partial", 3, "own", fitter)(0)["joint_error"] == 0.0
    assert module._OneScan(rig, "turned", 3, "own", fitter)(0)["joint_error"] > 0.1


def test_a_view_in_which_no_joint_counts_is_a_failure_that_stops_no_other(known, monkeypatch):
    """As of a rig with so many parts that none has many points."""
    scan = starts_scan(lbs.load_rig("body-coarse"), "partial", 0, 3)
    empty = replace(scan, labels=np.full_like(scan.labels, -1))
    monkeypatch.setattr(module, "starts_scan", lambda rig, row, i, seed: scan if i else empty)
    known.truth = scan
    figures = starts_bench(["body-coarse"], rows=["partial"], **QUICK)["rigs"]["body-coarse"]["rows"]["partial"]["fits"]["own"]
    assert figures["failed"] == 1 and figures["scans"][0]["failed"] == "no joint counts: no part that moves has 20 points"
    assert "joint_error" in figures["scans"][1]


def test_true_labels_are_given_where_there_are_some(known):
    report = starts_bench(["hand-coarse"], rows=["0.3", "dirty"], fits=("oracle", "own", "plain"), **QUICK)
    rows = report["rigs"]["hand-coarse"]["rows"]
    assert list(rows["0.3"]["fits"]) == ["own", "plain", "oracle"] and list(rows["dirty"]["fits"]) == ["own", "plain"]
    assert sum(f.trained for f in known.made) == 2
    cells = {line.split(" | ")[0]: line.split(" | ")[-2:] for line in starts_table(report, markdown=True).splitlines()}
    assert cells["| " + CONDITIONS["dirty"].what + "*"] == ["50.0 %", "– |"]
    assert cells["| " + CONDITIONS["0.3"].what] == ["25.0 %", "25.0 % |"]


# ---- do fits know? ----


def _report(rows):
    """A report with (error, probability) of fits, by row; a failure where the error is None."""
    entries = {}
    for row, fits in rows.items():
        scans = [{"failed": "x"} if e is None else {"joint_error": e, "probability": p} for e, p in fits]
        entries[row] = {"condition": {"close": CONDITIONS[row].close}, "fits": {"own": {"scans": scans}}}
    return {"rigs": {"hand": {"rows": entries}}}


def test_confidence_is_pooled_over_rows():
    sure = [(0.001, 0.9)] * 100
    known = module._confidence(_report({"0.3": [*sure, (0.02, 0.2)], "unit": [(0.02, 0.95), (0.2, 0.95), (None, None)]}))
    # Failures: 0.02 of row 0.3, 0.2 and the one that raised; 0.02 is within 3 % in row "unit".
    assert (known["scans"], known["failures"]) == (104, 3)
    assert known["caught"] == pytest.approx(2 / 3)
    assert known["auc"] == pytest.approx((2 * 101 + 0.5) / (3 * 101))
    assert sum(b["scans"] for b in known["calibration"]) == 104
    first, last = known["calibration"][0], known["calibration"][-1]
    assert (first["scans"], first["probability"], first["right"]) == (1, 0.0, 0.0)
    assert last["scans"] == 102 and last["right"] == pytest.approx(100 / 102)


def test_one_percent_of_false_alarms():
    fits = [(0.001, 0.5 if i < 2 else 0.9) for i in range(100)] + [(0.2, 0.4), (0.2, 0.6)]
    assert module._confidence(_report({"0.3": fits}))["caught"] == 0.5  # a threshold above 0.6 would alarm at 2 of 100
    fits[0] = (0.001, 0.9)
    assert module._confidence(_report({"0.3": fits}))["caught"] == 1.0


def test_without_failures_there_is_nothing_to_tell():
    known = module._confidence(_report({"0.3": [(0.001, 0.9)]}))
    assert known["auc"] is None and known["caught"] is None


# ---- going on ----


def test_what_is_there_is_not_done_again(known):
    seen = []
    first = starts_bench(["hand-coarse"], rows=["0.3"], on_row=lambda report, *at: seen.append(at), **QUICK)
    before = json.loads(json.dumps(first))
    made = len(known.made)
    both = starts_bench(["hand-coarse"], rows=["0.3", "0.6"], before=before, on_row=lambda report, *at: seen.append(at), **QUICK)
    assert seen == [("hand-coarse", "0.3", "own"), ("hand-coarse", "0.6", "own")] and len(known.made) == made + 1
    rows = both["rigs"]["hand-coarse"]["rows"]
    assert rows["0.3"] == first["rigs"]["hand-coarse"]["rows"]["0.3"] and list(before["rigs"]["hand-coarse"]["rows"]) == ["0.3"]
    assert both["confidence"]["scans"] == 8
    assert "several states" not in starts_table(both)
    # Another condition: anew.
    before["rigs"]["hand-coarse"]["rows"]["0.3"]["condition"]["close"] = 0.5
    starts_bench(["hand-coarse"], rows=["0.3"], before=before, **QUICK)
    assert len(known.made) == made + 2
    both["rigs"]["hand-coarse"]["digest"] = "other"  # of another rig of that name nothing is lost
    with pytest.raises(InputError, match="results of 'hand-coarse' with other rig than this run's.*--existing replace"):
        starts_bench(["hand-coarse"], rows=["0.3"], before=both, **QUICK)
    assert len(known.made) == made + 2


def test_each_row_says_what_made_it(known, monkeypatch):
    """Also where a later run has made others."""
    made = {"0.3": {"commit": "0123456789abcdef", "numpy": "1"}, "0.6": {"commit": "fedcba9876543210+changes", "numpy": "2"}}
    monkeypatch.setattr("lbsfit_np.workers.each", lambda work, tasks, *, jobs, done: [work(task) for task in tasks])
    report = None
    for jobs, (row, there) in enumerate(made.items(), 1):
        monkeypatch.setattr(module, "environment", lambda there=there: there)
        report = starts_bench(["hand-coarse"], rows=[row], before=report, jobs=jobs, **QUICK)
    rows = report["rigs"]["hand-coarse"]["rows"]
    assert {row: rows[row]["fits"]["own"]["environment"] for row in made} == made
    assert [rows[row]["fits"]["own"]["jobs"] for row in made] == [1, 2]
    states = "0123456789ab: hand-coarse 0.3 own; fedcba987654+changes: hand-coarse 0.6 own."
    assert starts_table(report).endswith(f"\nRows are of several states of the code, by commit: {states}")
    del rows["0.6"]
    assert "several states" not in starts_table(report)


def test_an_environment_of_a_whole_report_is_left_out(known):
    """Earlier versions wrote it; rows that are made since are of others."""
    whole = starts_bench(["hand-coarse"], rows=["0.3"], **QUICK)
    old = json.loads(json.dumps(whole)) | {"environment": {"numpy": "1"}}
    again = starts_bench(["hand-coarse"], rows=["0.3"], before=old, **QUICK)
    assert again == json.loads(json.dumps(whole)) and again["confidence"]["scans"]


def test_results_of_other_settings_are_left_alone(known):
    before = starts_bench(["hand-coarse"], rows=["0.3"], **QUICK)
    with pytest.raises(InputError, match="results with seed 3; expected seed 4.*--existing replace"):
        starts_bench(["hand-coarse"], rows=["0.3"], before=before, **QUICK | {"seed": 4})
    with pytest.raises(InputError, match="results of roundtrip"):
        starts_bench(["hand-coarse"], rows=["0.3"], before={"benchmark": "roundtrip"}, **QUICK)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"rows": ["0.4"]}, "rows.*some of 0.3"),
        ({"rows": []}, "rows"),
        ({"fits": ("owl",)}, "fits.*some of own, plain, oracle"),
        ({"fits": ()}, "fits"),
        ({"names": ["body-coarse"], "rows": ["touching"]}, "touching.*body-coarse"),
        ({"rows": ["dirty"], "fits": ("oracle",)}, "dirty with fits oracle"),
        ({"names": ["hnad"]}, "hand"),
    ],
)
def test_bad_arguments_are_named_before_any_work(known, bad, words):
    with pytest.raises(lbs.errors.LbsfitError, match=words):
        starts_bench(**{"names": ["hand-coarse"]} | bad)
    assert not known.made


# ---- the table and the command ----


def test_the_table_in_both_forms(known):
    report = starts_bench(["hand-coarse", "body-coarse"], rows=["0.3", "unit", "touching"], fits=("own", "plain"), **QUICK)
    plain, markdown = starts_table(report), starts_table(report, markdown=True)
    lines = markdown.splitlines()
    assert lines[0] == "| condition | rig | goal | reached | median | 95th | s a scan | plain Chamfer |"
    assert len({line.count("|") for line in lines[:7]}) == 1 and len([line for line in lines if line.startswith("|")]) == 7
    assert lines[2].startswith("| 0.3 rad a joint, facing known | hand-coarse | 99 % | 25.0 % | 2.00 |")
    assert lines[4].startswith("| natural poses, any turn, unknown unit, scale 0.5 to 2* | hand-coarse | 97 % | 50.0 % |")
    assert sum("touching" in line for line in lines) == 1
    for text in (plain, markdown):
        assert "4 scans a row, seed 3, effort balanced" in text and "60 synthetic scans" in text
        assert "goal 0.97" in text and "goal 80 %" in text and "area under the ROC curve" in text
    failed = sum(f["failed"] for e in report["rigs"].values() for r in e["rows"].values() for f in r["fits"].values())
    assert failed and f"Without scans that could not be fitted: {failed} in all rows" in plain
    report["confidence"] = None
    assert "ROC" not in starts_table(report)


def test_a_segmenter_is_told_of_where_one_was_trained(known):
    report = starts_bench(["hand-coarse"], rows=["0.3"], fits=("plain", "oracle"), **QUICK)
    assert not any(f.trained for f in known.made) and "effort balanced.\n" in starts_table(report)
    report = starts_bench(["hand-coarse"], rows=["0.3"], before=report, **QUICK)
    assert "effort balanced; segmenter trained on 60 synthetic scans.\n" in starts_table(report)


@pytest.fixture
def run(run):
    """Run ``lbsfit bench starts``."""
    return partial(run, "bench", "starts")


class Hurried(module._OneScan):
    """A fit, in whichever process, of which nothing hangs on how near it is."""

    def __call__(self, i):
        with pytest.MonkeyPatch.context() as patch:
            learning_is_hurried(patch)
            patch.setattr(baseline, "minimise", lambda *given, **more: minimise(*given, **more | {"max_iterations": 5}))
            return super().__call__(i)


@pytest.mark.slow
def test_command(run, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_OneScan", Hurried)
    out = tmp_path / "out"
    arguments = ("hand-coarse", "--rows", "0.3,turned", "--scans", "2", "--training-scans", "60", "--effort", "fast", "-o", out)
    code, text, err = run(*arguments, "--fits", "own,plain,oracle")
    assert (code, err) == (0, ""), text
    report = json.loads((out / "results.json").read_text(encoding="utf-8"))
    assert report["complete"] and report["settings"]["effort"] == "fast"
    rows = report["rigs"]["hand-coarse"]["rows"]
    assert set(rows) == {"0.3", "turned"} and set(rows["0.3"]["fits"]) == set(FITS)
    own = rows["0.3"]["fits"]["own"]["scans"]
    assert all(0 < e["joint_error"] < 0.5 and (e["probability"] is None or 0 <= e["probability"] <= 1) for e in own)
    assert rows["0.3"]["fits"]["oracle"]["median"] < 0.03
    assert text.rstrip().endswith(starts_table(report)) and "hand-coarse, turned, plain:" in text
    # Once more: nothing is done again, and other settings are refused.
    code, text, _ = run(*arguments, "--markdown")
    assert code == 0 and text.strip() == starts_table(report, markdown=True)
    code, _, err = run(*arguments, "--seed", "5")
    assert code == 2 and "seed 200" in err and "--existing replace" in err and err.count("\n") == 1
    # Two processes find the same, scan by scan.
    again = starts_bench(["hand-coarse"], rows=["0.3"], n_scans=2, training_scans=60, effort="fast", jobs=2)
    for a, b in zip(again["rigs"]["hand-coarse"]["rows"]["0.3"]["fits"]["own"]["scans"], own, strict=True):
        assert {k: v for k, v in a.items() if k != "seconds"} == {k: v for k, v in b.items() if k != "seconds"}


def test_stopped_it_is_said_that_the_same_command_goes_on(run, known, tmp_path, monkeypatch):
    out, fit_row, stops = tmp_path / "out", module._fit_row, {0}

    def stopping(one, *more):
        if len(done) in stops:
            raise KeyboardInterrupt
        done.append(one.row)
        return fit_row(one, *more)

    done = []
    monkeypatch.setattr(module, "_fit_row", stopping)
    command = ("hand-coarse", "--rows", "0.3,0.6", "--scans", "3", "--seed", "3")
    code, text, _ = run(*command, "-o", out)
    assert code == 130 and "kept" not in text and not out.exists()
    stops = {1}
    for _ in range(2):
        code, text, _ = run(*command, "-o", out)
        assert code == 130 and f"stopped: finished work is kept in {out}; run the same command to continue\n" in text
    code, text, _ = run(*command, "-o", out, "--existing", "replace")
    assert code == 130 and "kept" not in text  # what is there is to be replaced
    stops = {2}
    code, text, _ = run(*command, "-o", out, "--existing", "replace")
    assert code == 130 and "; run the same command without --existing replace to continue\n" in text
    assert run(*command, "-o", out)[0] == 130
    code, text, _ = run(*command)
    assert code == 130 and "kept" not in text  # nor is there a folder
    stops = ()
    assert run(*command, "-o", out)[0] == 0 and done == ["0.3", "0.3", "0.6"]


def test_failures_are_named_and_do_not_end_the_run(run, known, tmp_path):
    code, text, err = run("hand-coarse", "--rows", "0.3", "--scans", "4", "--seed", "3")
    assert (code, err) == (1, "")
    assert "failed: hand-coarse, 0.3, own, scan 3: points: got nothing" in text
    code, _, err = run("hand-coarse", "--rows", "0.3", "--scans", "4", "-o", tmp_path)
    (tmp_path / "results.json").write_text("{")
    code, _, err = run("hand-coarse", "--rows", "0.3", "--scans", "4", "-o", tmp_path)
    assert code == 2 and "cannot be read as results" in err and (tmp_path / "results.json").read_text() == "{"
    code, _, _ = run("hand-coarse", "--rows", "0.3", "--scans", "4", "-o", tmp_path, "--existing", "replace")
    assert code == 1 and json.loads((tmp_path / "results.json").read_text())["complete"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--rows", "0.4"), "some of 0.3, 0.6"),
        (("--fits", "own,own"), "some of own, plain, oracle"),
        (("--effort", "much"), "'fast', 'balanced', 'thorough'"),
        (("--scans", "0"), "at least 1"),
        (("hnad",), "hand-coarse"),
        (("body", "--rows", "touching"), "touching"),
    ],
)
def test_usage(run, arguments, words):
    code, _, err = run(*arguments)
    assert code == 2 and err.count("\n") == 1 and words in err


def test_rows_of_a_rig_with_other_poses_are_not_gone_on_with(tube_rig):
    """Of a report that knows less of the rig, what it does not know is noted from then on."""
    report = {"rigs": {}}
    condition = CONDITIONS["0.3"]
    module._row_entry(report, "tube", tube_rig, "0.3", condition)["fits"]["own"] = "kept"
    del report["rigs"]["tube"]["poses"]
    module._check_rig(report, "tube", tube_rig)
    assert module._row_entry(report, "tube", tube_rig, "0.3", condition)["fits"] == {"own": "kept"}
    other = replace(tube_rig, poses={"bent": np.full(tube_rig.lower.shape, 0.1)})
    with pytest.raises(InputError, match="results of 'tube' with other poses than this run's.*--existing replace"):
        module._check_rig(report, "tube", other)


OTHER_CARDS = [{"up": "+x"}, {"forward": "-x"}, {"metres_per_unit": 0.01}, {"locked": np.ones(4, dtype=bool)}]


@pytest.mark.parametrize("change", OTHER_CARDS)
def test_rows_of_a_rig_with_another_card_are_not_gone_on_with(tube_rig, change):
    """Of what its digest leaves out, too, which a fit hangs on as well."""
    report, condition = {"rigs": {}}, CONDITIONS["0.3"]
    module._row_entry(report, "tube", tube_rig, "0.3", condition)["fits"]["own"] = "kept"
    report = json.loads(json.dumps(report))
    module._check_rig(report, "tube", tube_rig)
    assert module._row_entry(report, "tube", tube_rig, "0.3", condition)["fits"] == {"own": "kept"}
    with pytest.raises(InputError, match="results of 'tube' with other .* than this run's.*--existing replace"):
        module._check_rig(report, "tube", replace(tube_rig, **change))
