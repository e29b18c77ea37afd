"""Failures that may not be the scans', such as for want of memory: the same command tries them again."""

import pickle
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lbsfit_np.bench import baseline, roundtrip
from lbsfit_np.bench.resume import is_done, unforeseen
from lbsfit_np.bench.run import BENCHES, run_bench
from lbsfit_np.bench.starts import starts_bench
from lbsfit_np.bench.study import local_optimum
from lbsfit_np.bench.study import run as study_run
from lbsfit_np.bench.study.data import SIZES
from lbsfit_np.bench.study.measures import Registrations
from lbsfit_np.bench.study.rows import ROWS, Found
from lbsfit_np.errors import InputError, Unforeseen, in_words
from lbsfit_np.learning.batch import each_scan

pytestmark = pytest.mark.usefixtures("own_cache")

OWN, MEMORY = InputError("points", "some", "others"), MemoryError("none left")


class Failing:
    """Fits that fail in the ways that are left, one after the other; then they are what is given."""

    def __init__(self, ways, fit=None):
        self.ways, self.fit, self.asked = list(ways), fit, 0

    def __call__(self, *given, **options):
        self.asked += 1
        if self.ways and (error := self.ways.pop(0)) is not None:
            raise error
        return self.fit(*given, **options)


def test_words_know_what_nobody_foresaw():
    assert not isinstance(in_words(OWN), Unforeseen)
    words = pickle.loads(pickle.dumps(in_words(MEMORY)))
    assert words == "MemoryError: none left" and isinstance(words, Unforeseen)
    assert unforeseen({"0": in_words(OWN), "2": words, 3: None}) == {"unforeseen": [2]} and unforeseen({1: in_words(OWN)}) == {}
    assert unforeseen({"0": in_words(OWN)}, {0: in_words(OWN), 1: words}) == {"unforeseen_before": [1]}
    entries = None, {}, {"unforeseen": [2]}, {"unforeseen_before": [2]}
    assert [is_done(entry) for entry in entries] == [False, True, False, False]


@pytest.mark.slow
def test_a_process_that_ended_is_nobodys_fault(tmp_path):
    from worker_tasks import EndsItsProcess

    outcomes = each_scan(EndsItsProcess(), [np.zeros((3, 3)), np.ones((3, 3))], n_jobs=2)
    assert all(isinstance(outcome.error, Unforeseen) for outcome in outcomes)


def test_rows_of_hand_and_body_are_made_again(shared_rigs, monkeypatch):
    fit = Failing([MEMORY, OWN])
    monkeypatch.setattr(baseline.PlainChamfer, "fit_scan", lambda self, scan: fit(scan))
    quick = {"seeds": [7], "n_scans": 2, "rows": ["plain"]}
    before, _ = run_bench(BENCHES["hand"], shared_rigs, **quick)
    assert before["rows"]["plain"]["seeds"]["7"]["unforeseen"] == [0]
    fit.ways = [OWN, OWN]
    now, _ = run_bench(BENCHES["hand"], shared_rigs, before=before, **quick)
    assert "unforeseen" not in now["rows"]["plain"]["seeds"]["7"] and fit.asked == 4
    run_bench(BENCHES["hand"], shared_rigs, before=now, **quick)
    assert fit.asked == 4  # a scan's own failure stays


class Fitter:
    """In place of ``LBSFitter``."""

    def __init__(self, rig, **parameters):
        self.rig = rig

    def pretrain(self, **options):
        return self


def test_seeds_of_a_round_trip_are_made_again(monkeypatch):
    fit = Failing([MEMORY, OWN])
    monkeypatch.setattr(Fitter, "fit_scan", lambda self, points: fit(points), raising=False)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter", Fitter)
    before = roundtrip.roundtrip(["hand-coarse"], n_scans=2)
    assert before["rigs"]["hand-coarse"]["seeds"]["100"]["unforeseen"] == [0]
    fit.ways = [OWN, OWN]
    for _ in range(2):
        before = roundtrip.roundtrip(["hand-coarse"], n_scans=2, before=before)
        assert "unforeseen" not in before["rigs"]["hand-coarse"]["seeds"]["100"] and fit.asked == 4


STARTS = {"n_scans": 2, "seed": 3, "training_scans": 60, "rows": ["0.3"]}


def _figures(report):
    return report["rigs"]["hand-coarse"]["rows"]["0.3"]["fits"]["own"]


def test_rows_of_starts_are_made_again(monkeypatch):
    fit = Failing([MEMORY, OWN])
    monkeypatch.setattr(Fitter, "fit_scan", lambda self, points: fit(points), raising=False)
    monkeypatch.setattr("lbsfit_np.learning.fitter.LBSFitter", Fitter)
    before = starts_bench(["hand-coarse"], **STARTS)
    assert _figures(before)["unforeseen"] == [0] and before["confidence"]["failures"] == 2
    fit.ways = [OWN, OWN]
    for _ in range(2):
        before = starts_bench(["hand-coarse"], before=before, **STARTS)
        assert "unforeseen" not in _figures(before) and fit.asked == 4


@pytest.mark.slow
def test_variants_of_learning_and_scans_one_by_one_are_made_again(shared_rigs, monkeypatch):
    from lbsfit_np.bench.learn import learn_bench

    trained = {"segmenter_": None, "_pretrained": (None, None), "_pretrained_of": None, "_given": None}
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda self, **o: vars(self).update(trained))
    failures, alone, asked = {0: in_words(MEMORY)}, [in_words(MEMORY)], []

    def fit(self, *args, **options):
        asked.append("joint")
        vars(self).update(history_=[], results_=[], template_={}, segmenter_=None, failures_=dict(failures))

    def fit_scans(*args, **options):
        asked.append("alone")
        return [SimpleNamespace(result=None, error=alone[0])]

    monkeypatch.setattr("lbsfit_np.LBSFitter.fit", fit)
    monkeypatch.setattr("lbsfit_np.learning.batch.fit_scans", fit_scans)
    monkeypatch.setattr("lbsfit_np.bench.learn._measured", lambda *a: {"joint_error": 0.1})
    monkeypatch.setattr("lbsfit_np.bench.learn._wrong", lambda *a: 0.2)
    quick, report = {"n_scans": 3, "seeds": (3,), "variants": ("joint",)}, None
    for expected, scan, together in (  # what is made, and how the next fails
        (["alone", "joint"], MEMORY, OWN),
        (["alone", "joint"], OWN, OWN),
        (["alone"], OWN, OWN),
        ([], OWN, OWN),
    ):
        asked.clear()
        report = learn_bench("hand", shared_rigs, before=report, **quick)
        assert asked == expected
        alone[0], failures[0] = in_words(scan), in_words(together)


def test_rows_of_the_study_are_made_again_from_their_steps(coarse_hand, tmp_path, monkeypatch):
    """What the row has done is kept until nothing unforeseen is left."""
    from study_sizes import TINY, few_steps_along_path

    words, before, asked = [in_words(MEMORY)], {}, []

    def find(c):
        asked.append(len(list(tmp_path.glob("h-1-oracle-fit/*"))))
        c.steps.mkdir(exist_ok=True)
        (c.steps / "some.npz").write_bytes(b"")
        vertices, joints = (np.array([getattr(s, name) for s in c.given.test]) for name in ("vertices", "joints"))
        vertices[-1] = np.nan
        return Found(Registrations(vertices, joints), failures={len(vertices) - 1: words[0]}, before=dict(before))

    rows = {name: replace(row, find=find, pretrained=False) for name, row in ROWS.items()}
    monkeypatch.setattr("lbsfit_np.bench.study.making.ROWS", rows)
    monkeypatch.setitem(SIZES, "small", TINY)
    removed = []
    monkeypatch.setattr(study_run, "_remove_steps", removed.append)
    for module in (local_optimum, study_run):
        monkeypatch.setattr(module, "along_path", few_steps_along_path)
    options, folder = {"rows": ("oracle-fit",), "seeds": [1], "steps": lambda cell: tmp_path / cell}, tmp_path / "h-1-oracle-fit"
    report = study_run.study({"h": coarse_hand}, **options)
    cell = report["rigs"]["h"]["seeds"]["1"]["oracle-fit"]
    assert cell["unforeseen"] == [2] and cell["failures"] == {"2": "MemoryError: none left"} and folder not in removed
    words[0], before[1] = str(OWN), in_words(MEMORY)
    report = study_run.study({"h": coarse_hand}, before=report, **options)
    cell = report["rigs"]["h"]["seeds"]["1"]["oracle-fit"]
    assert "unforeseen" not in cell and cell["unforeseen_before"] == [1] and folder not in removed
    before[1] = in_words(OWN)
    report = study_run.study({"h": coarse_hand}, before=report, **options)
    assert "unforeseen_before" not in report["rigs"]["h"]["seeds"]["1"]["oracle-fit"] and folder in removed
    study_run.study({"h": coarse_hand}, before=report, **options)
    assert asked == [0, 1, 1]


@pytest.mark.parametrize("row", ["free-form-augmented", "free-form-supervised", "free-form-supervised-3x"])
def test_rows_of_the_study_say_what_failed_that_they_build_on(row, monkeypatch):
    scans, failures = [SimpleNamespace(points=np.zeros((3, 3)))] * 2, {1: in_words(MEMORY)}
    given = SimpleNamespace(rig=None, test=scans, train=scans)
    context = SimpleNamespace(given=given, from_template=[[None, None], failures], source=None, size=None, seed=0)
    context.fitter = SimpleNamespace(regressor_=None, random_state=0)
    study_rows = sys.modules["lbsfit_np.bench.study.rows"]
    monkeypatch.setattr(study_rows, "Augmented", lambda *a: None)
    monkeypatch.setattr(study_rows, "taught", lambda *a: None)
    monkeypatch.setattr(study_rows, "study_set", lambda *a, **k: given)
    of_training = {0.5: failures}
    monkeypatch.setattr(study_rows, "_free_form", lambda *a, start=0.0, **k: Found("test", failures=of_training.get(start, {})))
    assert ROWS[row].find(context).before == ({} if row.endswith("3x") else failures)
