"""The benchmark of learning: its scans, and its table."""

import json
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import learning_is_hurried

from lbsfit_np.bench.hand import SCAN, hand_rig, natural_poses
from lbsfit_np.bench.learn import VARIANT_ROWS, _measured, _poses_digest, collection, learn_bench, learn_table, touching_pose
from lbsfit_np.cli import main as run
from lbsfit_np.cli.bench import VARIANT_NAMES
from lbsfit_np.errors import InputError
from lbsfit_np.io.bvh import read_bvh
from lbsfit_np.learning import free_form
from lbsfit_np.learning.checkpoint import Checkpoint, steps_in
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.optimize.lbfgs import minimise


def test_the_scans_are_of_three_subjects_and_the_same_for_one_seed(shared_rigs):
    rig, scans, subjects, others = collection("hand", shared_rigs, 9, seed=3)
    again = collection("hand", shared_rigs, 9, seed=3)[1]
    assert subjects == [0, 1, 2] * 3 and len(others) == 3
    assert np.array_equal(scans[0].template, scans[3].template) and not np.array_equal(scans[0].template, scans[1].template)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(scans, again, strict=True))
    assert len(rig.parts) == 16


def test_touching_poses_bring_two_fingertips_together(shared_rigs):
    rig = hand_rig(shared_rigs)
    theta = touching_pose(rig, natural_poses(rig, shared_rigs), np.random.default_rng(0))
    assert np.all(theta >= rig.lower - 1e-12) and np.all(theta <= rig.upper + 1e-12)


def _nothing_learned(fitter, *a, **k):
    fitter.results_ = fitter.segmenter_ = None
    fitter.history_, fitter.failures_, fitter.template_ = [], {}, {}


@pytest.mark.slow
def test_a_run_measures_what_was_learned(shared_rigs, coarse_hand, monkeypatch, own_cache):
    """Of a hand of fewer vertices, and fits that are hurried, those without skinning as well."""
    learning_is_hurried(monkeypatch, "balanced")
    monkeypatch.setitem(LBSFitter.__init__.__kwdefaults__, "rounds", 1)
    monkeypatch.setattr(free_form, "minimise", lambda *given, **more: minimise(*given, **more | {"max_iterations": 10}))
    monkeypatch.setattr("lbsfit_np.bench.hand.hand_rig", lambda data: coarse_hand)
    monkeypatch.setattr("lbsfit_np.bench.hand.natural_poses", lambda rig, data: np.array(list(rig.poses.values())))
    monkeypatch.setattr("lbsfit_np.bench.hand.SCAN", replace(SCAN, n_points=800))
    rows = []
    options = {"n_scans": 3, "seeds": (3,), "variants": ("cd", "free-form"), "training_scans": 40}
    report = learn_bench("hand", shared_rigs, on_row=lambda report, variant, seed: rows.append((variant, seed)), **options)
    assert rows == [("one by one", 3), ("cd", 3), ("free-form", 3)] and report["complete"]
    entry = report["rows"]["cd"]["3"]
    assert entry["unfitted"] == 0 and entry["rounds"] >= 1 and len(entry["joints"]) == 3
    assert entry["joint_error"] == pytest.approx(np.mean(entry["joints"])) and 0 < entry["vertex_error"] < 0.5
    single = report["rows"]["one by one"]["3"]
    assert 0 < single["label_error"] < 1 and "label_error" not in entry and entry["label_error_of_rounds"] == []
    assert len(single["joints"]) == 3 and single["unfitted"] == 0 and single["template_gap"] > 0
    assert report["rows"]["free-form"]["3"]["rounds"] == 0
    # The same once more has nothing to do, and more does the rest.
    monkeypatch.setattr("lbsfit_np.bench.learn._measured", lambda *a: {"unfitted": 7})
    monkeypatch.setattr("lbsfit_np.bench.learn._one_by_one", lambda *a: [])
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter.fit", _nothing_learned)
    with monkeypatch.context() as patch:
        patch.setattr(LBSFitter, "pretrain", None)  # nor needs it training
        again = learn_bench("hand", shared_rigs, before=report | {"environment": {"numpy": "1"}}, **options)
    assert again == report  # without what earlier versions wrote, which rows have of their own
    assert again["rows"] == report["rows"] and len(rows) == 3
    more = learn_bench("hand", shared_rigs, before=report, **options | {"variants": ("free-form", "cd"), "seeds": (3, 4)})
    assert more["rows"]["cd"]["3"] == entry and [more["rows"][v]["4"]["unfitted"] for v in ("cd", "free-form")] == [7, 7]
    monkeypatch.setattr("lbsfit_np.bench.learn._one_by_one", None)  # that of seed 3 is there
    wider = learn_bench("hand", shared_rigs, before=report, **options | {"variants": ("rand",)})
    assert wider["rows"]["one by one"]["3"] == single and wider["rows"]["rand"]["3"]["unfitted"] == 7
    with pytest.raises(InputError, match="before: got results with n_scans 3; expected n_scans 9"):
        learn_bench("hand", shared_rigs, before=report, **options | {"n_scans": 9})


def test_scans_that_could_not_be_fitted_are_counted(shared_rigs):
    rig, scans, *_ = collection("hand", shared_rigs, 3, seed=3)
    right = SimpleNamespace(joints=scans[0].joints, vertices=scans[0].vertices)
    true = [(s.template, s.template) for s in scans]
    entry = _measured(rig, [right, None, None], scans, true, rig.size / 2)
    assert entry["unfitted"] == 2
    assert entry["joints"] == [0.0] and entry["vertex_error"] == 0.0 and entry["template_gap"] < 1e-12
    moved = [(V + [0.0, 0.3, 0.4], U) for V, U in true]
    entry = _measured(rig, [right, None, None], scans, moved, 2.0)
    assert entry["template_gap"] < 1e-12 and entry["template_gap_in_place"] == pytest.approx(0.25)
    centred = [V - V.mean(axis=0) for V in (rig.vertices, *(s.template for s in scans))]
    far = np.mean([np.linalg.norm(centred[0] - V, axis=1).mean() for V in centred[1:]])
    assert entry["template_gap_before"] == pytest.approx(far / 2) and far > 0.01 * rig.size


def test_templates_are_judged_as_the_scans_have_them(shared_rigs, monkeypatch, own_cache):
    """Fits by themselves have one each, learning one a subject; those of whom nothing was learned count in no gap."""
    rig, scans, *_ = collection("hand", shared_rigs, 3, seed=3)
    root = rig.joints[rig.root]

    def halved(s):
        return root + (s.template - root) / 2

    def single(s):
        own = {"scale": 2.0, "offsets": halved(s) - rig.vertices, "rest_joints": rig.joints}
        return SimpleNamespace(joints=s.joints, vertices=s.vertices, **own)

    outcomes = [SimpleNamespace(result=None, error="lost"), *(SimpleNamespace(result=single(s), error=None) for s in scans[1:])]

    def learned(fitter, points, *a, **k):
        _nothing_learned(fitter)
        fitter.results_ = [o.result for o in outcomes]
        fitter.template_ = {k: SimpleNamespace(vertices=halved(scans[k]) + 1.0, joints=rig.joints) for k in (1, 2)}
        fitter.unit_ = {1: 2.0, 2: 2.0}

    monkeypatch.setattr(LBSFitter, "pretrain", lambda self, **k: setattr(self, "segmenter_", None))
    monkeypatch.setattr("lbsfit_np.learning.pretraining.share_pretraining", lambda *a: None)
    monkeypatch.setattr("lbsfit_np.bench.learn._one_by_one", lambda *a: outcomes)
    monkeypatch.setattr("lbsfit_np.bench.learn._wrong", lambda *a: 0.5)
    monkeypatch.setattr(LBSFitter, "fit", learned)
    report = learn_bench("hand", shared_rigs, n_scans=3, seeds=(3,), variants=("cd",))
    one, many = report["rows"]["one by one"]["3"], report["rows"]["cd"]["3"]
    assert one["template_gap"] < 1e-12 and one["template_gap_in_place"] < 1e-12 < 0.01 < one["template_gap_before"]
    assert many["template_gap"] < 1e-12 and many["template_gap_in_place"] == pytest.approx(2 * 3**0.5 / (rig.size / 2))
    assert one["unfitted"] == many["unfitted"] == many["unlearned"] == 1
    lines = learn_table(report).splitlines()
    assert "cd: of 1 of 3 subjects nothing was learned; these count in no template gap." in lines
    assert not any(line.startswith("one by one: of") for line in lines)
    assert f"Template gaps are up to a shift; that of the rig's own template is {one['template_gap_before']:.4f}." in lines


def test_the_table_has_a_row_a_variant():
    entry = {"joint_error": 0.02, "vertex_error": 0.03, "template_gap": 0.01, "seconds": 5.0}
    report = {
        "unit": "half size",
        "settings": {"n_scans": 6, "subjects": 3},
        "rows": {"one by one": {"1": {"template_gap": 0.05, "label_error": 0.2}}, "cd": {"1": entry}},
    }
    text = learn_table(report)
    assert "one by one" in text and "0.0500" in text
    assert "cd" in text and "0.0200" in text and "–" in text
    swapped = report | {"rows": dict(reversed(report["rows"].items()))}  # as files have them: in the order of the alphabet
    assert learn_table(swapped) == text


def _rows(**rows):
    """A report whose rows have, by seed, their joint error, or None."""
    first = {str(seed): {"template_gap": 0.05} for seed in sorted({s for of in rows.values() for s in of})}
    rows = {v: {str(s): {"joint_error": e, "seconds": 10.0 * s} for s, e in of.items()} for v, of in rows.items()}
    return {"unit": "half size", "settings": {"n_scans": 6, "subjects": 3}, "rows": {"one by one": first} | rows}


def _cell(text, row, column):
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    return next(line for line in lines if line[0] == row)[lines[0].index(column)]


def test_variants_are_compared_over_the_seeds_that_all_have():
    text = learn_table(_rows(joint={100: 0.03, 101: 0.07}, cd={100: 0.04}), markdown=True)
    assert [_cell(text, row, "joints") for row in ("joint", "cd")] == ["0.0300", "0.0400"]
    assert "Mean over seeds (1)" in text and "Seed 101 is left out: it has no cd." in text
    text = learn_table(_rows(joint={100: 0.03}, cd={101: 0.04}), markdown=True)
    assert [_cell(text, row, "joints") for row in ("joint", "cd")] == ["–", "–"] and "Mean over seeds (0)" in text
    assert "left out" not in learn_table(_rows(joint={100: 0.03, 101: 0.07}, cd={100: 0.04, 101: 0.05}))


@pytest.mark.parametrize("nothing", [None, float("nan")])
def test_a_seed_in_which_nothing_was_fitted_counts_for_no_row_of_that_column(nothing):
    text = learn_table(_rows(joint={100: 0.03, 101: 0.07}, cd={100: 0.04, 101: nothing}), markdown=True)
    assert [_cell(text, row, "joints") for row in ("joint", "cd")] == ["0.0300", "0.0400"]
    assert _cell(text, "joint", "s in all") == "1005" and "Mean over seeds (2)" in text
    assert "joints: without seed 101, for which a row has no value." in text
    text = learn_table(_rows(joint={100: 0.03}, cd={100: nothing}), markdown=True)
    assert [_cell(text, row, "joints") for row in ("joint", "cd")] == ["0.0300", "–"] and "without" not in text


def test_label_errors_are_compared_after_as_many_rounds():
    report = _rows(joint={100: 0.03, 101: 0.03}, rand={100: 0.03, 101: 0.03}, cd={100: 0.03, 101: 0.03})
    for row, errors in {"joint": ([0.2, 0.1], [0.4, 0.3, 0.2]), "rand": ([0.3, 0.2], [0.5, 0.4]), "cd": ([], [])}.items():
        for seed, of in zip(("100", "101"), errors):
            history = [{"round": k, "kept": k == len(of) - 1} for k in range(len(of) + 1)]
            report["rows"][row][seed] |= {"label_error_of_rounds": of, "history": history}
    lines = learn_table(report).splitlines()
    assert lines[-4:] == [
        "Label errors after round 1 of all: joint 0.3000, rand 0.4000.",
        "Label errors after round 2 of all: joint 0.2000, rand 0.3000.",
        "Rounds kept by joint: 1, 2.",
        "Rounds kept by rand: 1, 1.",
    ]


def test_rows_without_all_scans_or_of_other_code_are_told():
    report = _rows(joint={100: 0.03, 101: 0.03}, cd={100: 0.03, 101: 0.03})
    assert "could not be fitted" not in learn_table(report) and "several states" not in learn_table(report)
    report["rows"]["cd"]["101"] |= {"unfitted": 4, "commit": "0123456789abcdef"}
    lines = learn_table(report).splitlines()
    assert "cd: 4 of 12 scans could not be fitted, and count in no measure of fits." in lines
    states = "unknown: one by one 100, one by one 101, joint 100, joint 101, cd 100; 0123456789ab: cd 101."
    assert lines[-1] == f"Rows are of several states of the code, by commit: {states}"
    report["rows"]["joint"]["100"]["commit"] = "0123456789abcdef+changes"
    assert "0123456789ab+changes: joint 100; 0123456789ab: cd 101." in learn_table(report)


def test_each_row_says_what_made_it(shared_rigs, quick, monkeypatch):
    """Also where a later run has made others."""
    report, made = None, {"joint": {"commit": "a", "numpy": "1"}, "cd": {"commit": "b", "numpy": "2"}}
    for jobs, (variant, there) in enumerate(made.items(), 1):
        monkeypatch.setattr("lbsfit_np.bench.learn.environment", lambda there=there: there)
        options = {"n_scans": 3, "seeds": (3,), "variants": (variant,), "jobs": jobs}
        report = learn_bench("hand", shared_rigs, before=report, **options)
    made["one by one"] = made["joint"]
    assert {row: of["3"]["environment"] for row, of in report["rows"].items()} == made
    assert {row: of["3"]["jobs"] for row, of in report["rows"].items()} == {"one by one": 1, "joint": 1, "cd": 2}


def test_where_nothing_could_be_fitted_there_is_no_error(shared_rigs):
    rig, scans, *_ = collection("hand", shared_rigs, 3, seed=3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        entry = _measured(rig, [None] * 3, scans, (), rig.size / 2)
    assert entry["unfitted"] == 3 and "template_gap" not in entry
    assert all(np.isnan(entry[key]) for key in ("joint_error", "joint_error_median", "vertex_error"))


@pytest.fixture
def quick(monkeypatch):
    """Learning that takes no time: a fitter that has fitted nothing."""
    trained = {"segmenter_": None, "_pretrained": (None, None), "_pretrained_of": None, "_given": None}
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda self, **o: vars(self).update(trained))
    learned = {"history_": [], "results_": [], "template_": {}, "segmenter_": None, "failures_": {}}
    monkeypatch.setattr("lbsfit_np.LBSFitter.fit", lambda self, *a, **o: vars(self).update(learned))
    monkeypatch.setattr("lbsfit_np.bench.learn._measured", lambda *a: {"joint_error": 0.1})
    monkeypatch.setattr("lbsfit_np.bench.learn._wrong", lambda *a: 0.2)
    monkeypatch.setattr("lbsfit_np.learning.batch.fit_scans", lambda *a, **o: [])


@pytest.mark.slow
def test_complete_is_a_report_whose_seeds_have_the_same_variants(shared_rigs, quick):
    def run(seeds, variants, before=None):
        return learn_bench("hand", shared_rigs, n_scans=3, seeds=seeds, variants=variants, before=before)

    report = run((3, 4), ("joint",))
    assert report["complete"]
    assert not run((3,), ("joint", "cd"), report)["complete"]
    assert run((3, 4), ("joint", "cd"), report)["complete"]


@pytest.mark.slow
def test_results_of_another_rig_or_other_poses_are_not_gone_on_with(shared_rigs, quick, monkeypatch):
    options = {"n_scans": 3, "seeds": (3,), "variants": ("joint",)}
    report = learn_bench("hand", shared_rigs, **options)
    for key in ("rig", "poses", "people", "scans"):
        with pytest.raises(InputError, match=f"results with other {key} than this run's.*--existing replace"):
            learn_bench("hand", shared_rigs, before=report | {key: "another"}, **options)
    for lacking in ("rig", "rows"):
        older = {key: value for key, value in report.items() if key != lacking}
        with pytest.raises(InputError, match=f"results of learn hand without '{lacking}'.*--existing replace"):
            learn_bench("hand", shared_rigs, before=older, **options)
    with pytest.raises(InputError, match="results by an earlier version.*--existing replace"):
        learn_bench("hand", shared_rigs, before=report | {"rows": {"before": {}}}, **options)
    with pytest.raises(InputError, match="without 'rows'"):
        learn_bench("hand", shared_rigs, before=report | {"rows": None}, **options)
    with pytest.raises(InputError, match="results of starts; expected results of learn hand"):
        learn_bench("hand", shared_rigs, before={"benchmark": "starts"}, **options)


def test_the_command_keeps_each_row_and_goes_on(shared_rigs, quick, monkeypatch, tmp_path, capsys):
    measured = {"joint_error": 0.1, "vertex_error": 0.2, "joint_error_median": 0.1, "template_gap": 0.05}
    monkeypatch.setattr("lbsfit_np.bench.learn._measured", lambda *a: measured)
    command = ["bench", "learn", "hand", "--data", str(shared_rigs), "-o", str(tmp_path), "--scans", "3", "--jobs", "2"]

    def rows():
        return json.loads((tmp_path / "results.json").read_text())["rows"]

    assert run([*command, "--seeds", "3", "--variants", "cd"]) == 0
    assert "seed 3, cd: joints 0.1000, vertices 0.2000 half size" in capsys.readouterr().out
    assert set(rows()) == {"one by one", "cd"} and rows()["cd"]["3"]["jobs"] == 2
    seen = []

    def stopped(self, *arguments, **options):
        seen.append(rows())  # what is done is there already
        raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.LBSFitter.fit", stopped)
    with suppress(KeyboardInterrupt):
        assert run([*command, "--seeds", "3,4", "--variants", "cd"]) == 130
    assert set(seen[0]["one by one"]) == {"3", "4"} and set(seen[0]["cd"]) == {"3"} == set(rows()["cd"])
    capsys.readouterr()
    with suppress(KeyboardInterrupt):  # where this run has made nothing, an earlier one has
        assert run([*command, "--seeds", "3,4", "--variants", "cd"]) == 130
    assert f"finished work is kept in {tmp_path}; run the same command to continue\n" in capsys.readouterr().out


def test_the_command_names_scans_that_could_not_be_fitted(shared_rigs, quick, monkeypatch, tmp_path, capsys):
    measured = {"joint_error": 0.1, "vertex_error": 0.2, "joint_error_median": 0.1, "template_gap": 0.05, "unfitted": 1}
    fitted = SimpleNamespace(scale=1.0, offsets=0.0, rest_joints=np.zeros((25, 3)))
    failed = [SimpleNamespace(result=None, error="no points"), SimpleNamespace(result=fitted, error=None)]
    monkeypatch.setattr("lbsfit_np.bench.learn._measured", lambda *a: measured)
    monkeypatch.setattr("lbsfit_np.learning.batch.fit_scans", lambda *a, **o: failed)
    learned = {"history_": [], "results_": [], "template_": {}, "segmenter_": None, "failures_": {2: "too few"}}
    monkeypatch.setattr("lbsfit_np.LBSFitter.fit", lambda self, *a, **o: vars(self).update(learned))
    command = ["bench", "learn", "hand", "--data", str(shared_rigs), "-o", str(tmp_path), "--scans", "3"]
    assert run([*command, "--seeds", "3", "--variants", "cd"]) == 1
    told = capsys.readouterr().out
    assert "failed: seed 3, one by one, scan 0: no points\n" in told and "failed: seed 3, cd, scan 2: too few\n" in told


def test_steps_of_a_seed_are_kept_until_it_is_done(shared_rigs, quick, monkeypatch, tmp_path, capsys):
    measured = {"joint_error": 0.1, "vertex_error": 0.2, "joint_error_median": 0.1, "template_gap": 0.05}
    monkeypatch.setattr("lbsfit_np.bench.learn._measured", lambda *a: measured)
    command = ["bench", "learn", "hand", "--data", str(shared_rigs), "-o", str(tmp_path), "--scans", "3", "--seeds", "3"]
    seen = []

    def fit(self, scans, subjects, checkpoint, **options):
        seen.append((Path(checkpoint), steps_in(checkpoint)))
        Checkpoint(checkpoint).slot("round-1-pose", self.variant).keep(1.0)
        if len(seen) == 2:
            raise KeyboardInterrupt
        _nothing_learned(self)

    monkeypatch.setattr("lbsfit_np.LBSFitter.fit", fit)
    with suppress(KeyboardInterrupt):
        assert run([*command, "--variants", "joint,cd"]) == 130
    kept = tmp_path / "results.json.unfinished" / "3"
    assert seen == [(kept, 0), (kept, 1)] and steps_in(kept) == 2
    assert "finished work is kept in" in capsys.readouterr().out
    assert run([*command, "--variants", "joint,cd"]) == 0
    assert seen[2:] == [(kept, 2)] and not kept.parent.exists()
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert rows["joint"]["3"]["seconds"] is not None and rows["cd"]["3"]["seconds"] is None
    assert "found 2 saved steps of an interrupted run in" in capsys.readouterr().out

    def stopped(self, *given, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", stopped)  # nothing of a replacing run is kept then
    assert run([*command, "--variants", "cd", "--existing", "replace"]) == 130
    assert "finished work is kept in" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_motion_of_few_frames_is_named_before_any_training(shared_rigs, monkeypatch):
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained first"))
    with pytest.raises(InputError, match=r"scans: got 5000, more than the motion has frames for; .*at most \d+") as error:
        learn_bench("body", shared_rigs, n_scans=5000, seeds=(3,))
    most = int(str(error.value).rstrip(".").split()[-1])
    frames = len(read_bvh(shared_rigs / "motion" / "01_01.bvh").rotations) - 1
    assert most + most // 3 <= frames < most + 1 + (most + 1) // 3


@pytest.mark.parametrize("command, most", [(("body",), 2751), (("learn", "body"), 2063)])
def test_a_motion_of_few_frames_is_said_of_the_option(command, most, shared_rigs, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained first"))
    options = ["--data", str(shared_rigs), "-o", str(tmp_path / "out"), "--scans", "5000"]
    plain = ["--rows", "plain"] if command == ("body",) else []
    assert run(["bench", *command, *options, *plain]) == 2 and not (tmp_path / "out").exists()
    words = f"--scans: got 5000, more than the motion has frames for; expected at most {most}."
    assert capsys.readouterr().err == f"lbsfit: error: {words}\n"


@pytest.mark.parametrize("name", ["hand", "body"])
def test_too_few_scans_are_named_before_any_work(name, shared_rigs, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained first"))
    out = tmp_path / "out"
    command = ["bench", "learn", name, "--data", str(shared_rigs), "-o", str(out), "--variants", "cd"]
    assert run([*command, "--scans", "2"]) == 2 and not out.exists()
    assert capsys.readouterr().err == "lbsfit: error: --scans: got 2; expected at least 3, one of each person.\n"


def test_label_errors_are_noted_after_each_round(shared_rigs, quick, monkeypatch):
    def fit(self, scans, subjects, on_round, **options):
        for k, segmenter in ((1, None if self.variant == "cd" else "s"), (2, None if self.variant == "cd" else "s")):
            on_round(k, segmenter)
        learned = {"history_": [{}, {}, {}], "results_": [], "template_": {}, "segmenter_": None, "failures_": {}}
        vars(self).update(learned)

    monkeypatch.setattr("lbsfit_np.LBSFitter.fit", fit)
    rows = learn_bench("hand", shared_rigs, n_scans=3, seeds=(3,), variants=("joint", "cd"))["rows"]
    assert rows["joint"]["3"]["label_error_of_rounds"] == [0.2, 0.2] and rows["joint"]["3"]["rounds"] == 2
    assert rows["cd"]["3"]["label_error_of_rounds"] == []


def test_poses_are_others_when_any_of_their_files_is(tmp_path):
    files = {"hand": [f"hand_poses/{name}.handpose" for name in ("a", "b", "c")], "body": ["motion/01_01.bvh"]}
    for path in [*files["hand"], *files["body"]]:
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text("before")
    for name, paths in files.items():
        seen = {_poses_digest(name, tmp_path)}
        for path in paths:
            (tmp_path / path).write_text("after")
            seen.add(_poses_digest(name, tmp_path))
        assert len(seen) == 1 + len(paths)
        (tmp_path / paths[0]).with_name("notes.txt").write_text("read by nobody")
        assert _poses_digest(name, tmp_path) in seen


def test_the_command_knows_the_variants():
    assert VARIANT_NAMES == VARIANT_ROWS


@pytest.mark.parametrize("bad", [{"variants": ("other",)}, {"seeds": (1, 1)}, {"seeds": ()}])
def test_bad_arguments_are_named_before_any_work(bad):
    with pytest.raises(InputError, match="variants|seeds"):
        learn_bench("hand", "nowhere", **bad)
