"""The rows of the study: baselines, oracles and those that learn, each by rules of its own."""

import signal
from dataclasses import replace
from functools import partial
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from study_sizes import rows_are_hurried, small_is_few_and_fast
from worker_tasks import ends_at_1, kills_itself

from lbsfit_np.bench.measure import recon
from lbsfit_np.bench.resume import unforeseen
from lbsfit_np.bench.study import data, free_form, making, oracle
from lbsfit_np.bench.study import rows as rows_module
from lbsfit_np.bench.study import run as run_module
from lbsfit_np.bench.study.data import SCAN, Size, sized, study_set
from lbsfit_np.bench.study.free_form import Augmented, FreeForm, FromTemplate, best_free_form, taught
from lbsfit_np.bench.study.measures import Registrations
from lbsfit_np.bench.study.oracle import OracleFit
from lbsfit_np.bench.study.paper import PAPER
from lbsfit_np.bench.study.rows import ROWS, Context, Found
from lbsfit_np.bench.study.run import study
from lbsfit_np.bench.templates import learned_templates, template_gap
from lbsfit_np.correspondence import surface_places
from lbsfit_np.errors import InputError
from lbsfit_np.learning.checkpoint import NO_CHECKPOINT, Checkpoint
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.optimize.model import Model
from lbsfit_np.synthesis import synthesize

# Of a fitter that was pretrained, to nothing.
PRETRAINED = {"_pretrained": (None, None), "_pretrained_of": None, "_given": None}

# ---- the oracle ----


def test_the_oracles_objective_is_nothing_where_the_template_explains_all(tube_rig):
    """Smooth are the offsets, not the shape: at the exact template without offsets nothing is left."""
    model = Model(tube_rig)
    V = model.pose(model.rest())[0].vertices
    places = surface_places(V, V, model.rig.faces)
    known = oracle._Known(model, V, *places, OracleFit(tube_rig).settings.weights)
    e = known.evaluate(model.rest())
    assert e.value == pytest.approx(0, abs=1e-15) and np.abs(e.residual).max() < 1e-12
    assert known.weights.lam_lap > 0
    rough = np.random.default_rng(0).standard_normal(V.shape) * 0.01
    assert known.evaluate(model.rest().replace(residual=rough)).value > (rough**2).sum(axis=1).mean()


def test_the_oracle_comes_nearer_than_proportions_can(tube_rig):
    """A person with a lump on one side, which only offsets can have; without them the mean is above 0.04."""
    U = tube_rig.vertices
    lump = 0.2 * np.exp(-((U - U[np.abs(U[:, 1]).argmin()]) ** 2).sum(axis=1) / 0.15**2)
    changed = U + lump[:, None] * [0.0, 0.0, 1.0]
    (scan,) = synthesize(tube_rig, 1, templates=[(changed, tube_rig.joints)], random_state=4, n_points=800, shape=0.0, holes=0)
    off = np.linalg.norm(OracleFit(tube_rig)(scan).vertices - scan.vertices, axis=1) / (tube_rig.size / 2)
    assert off.mean() < 0.025


# ---- baselines without skinning ----


@pytest.fixture
def fitted(monkeypatch):
    """Fits that leave their starts as they are, and what they leave unexplained, by the start's first coordinate."""
    starts = []

    def fit(rig, points, start):
        starts.append(start)
        return FreeForm(start, rig.regressor @ start, float(start[0, 0]))

    monkeypatch.setattr(free_form, "_fitted", fit)
    return starts


def test_the_best_start_is_the_one_that_explains_most(tube_rig, fitted):
    candidates = [np.full(tube_rig.vertices.shape, x) for x in (3.0, 1.0, 2.0)]
    found = best_free_form(tube_rig, np.zeros((5, 3)), candidates)
    assert len(fitted) == 3 and found.vertices is candidates[1]
    assert found.joints == pytest.approx(np.ones(tube_rig.joints.shape))  # the regressor's, of vertices that are all in one place
    before = [FreeForm(None, None, recon) for recon in (0.9, 0.8, 1.1)]
    assert best_free_form(tube_rig, np.zeros((5, 3)), candidates, before) is before[1]
    assert best_free_form(tube_rig, np.zeros((5, 3)), candidates, before[2:]).vertices is candidates[1]


def test_free_form_starts_from_the_template_and_the_augmented_one_from_poses_that_look_alike_too(tube_rig, fitted):
    points, poses, asked = np.zeros((5, 3)), np.stack([0.2 * k * tube_rig.upper for k in (1, 2, 3)]), []

    def nearest(x, n):
        asked.append((x, n))
        return poses[:n]

    on_template = FromTemplate(tube_rig)(points)
    assert [np.array_equal(start, tube_rig.vertices) for start in fitted] == [True]
    worst, best = replace(on_template, recon=9.0), replace(on_template, recon=-9.0)
    for before in (worst, best, None):  # not made a second time
        fitted.clear()
        asked.clear()
        found = Augmented(tube_rig, SimpleNamespace(nearest=nearest))((points, before))
        ((x, n),) = asked
        assert x is points and n == 3
        for start, theta in zip(fitted, poses, strict=True):
            np.testing.assert_allclose(start, tube_rig.pose(theta), atol=1e-12)
        assert found is best if before is best else found.vertices is min(fitted, key=lambda V: V[0, 0])


@pytest.mark.parametrize("rows", [("free-form", "free-form-augmented"), ("free-form-augmented", "free-form")])
def test_fits_from_the_template_are_made_once_for_both_rows(tube_rig, fitted, rows):
    scans, shares = [SimpleNamespace(points=np.full((5, 3), x)) for x in (1.0, 2.0)], []
    library = SimpleNamespace(nearest=lambda x, n: tube_rig.lower[None])
    c = SimpleNamespace(given=SimpleNamespace(rig=tube_rig, test=scans), fitter=SimpleNamespace(regressor_=library))
    c.jobs, c.progress, c.from_template = 1, shares.append, []
    found = {row: ROWS[row].find(c) for row in rows}
    of_template = [start for start in fitted if np.array_equal(start, tube_rig.vertices)]
    assert len(of_template) == 2 and len(fitted) == 4
    np.testing.assert_array_equal(found["free-form"].test.vertices, of_template)
    assert shares[-1] == max(shares) == 1.0


def test_components_are_of_some_scans_and_the_regressor_learns_from_all(tube_rig, monkeypatch):
    """Four of nine, evenly taken; on these, three components leave nothing out."""
    scans, given = synthesize(tube_rig, 9, random_state=6, n_points=60), []
    monkeypatch.setattr(free_form, "_OF_COMPONENTS", 4)
    monkeypatch.setattr("sklearn.neural_network.MLPRegressor.fit", lambda network, X, y: given.append((X, y)))
    found = free_form.taught(tube_rig, scans, 0)
    ((X, y),) = given
    shapes = np.array([(s.vertices - s.points.mean(axis=0)).ravel() for s in scans])
    some = [0, 2, 5, 8]
    assert len(X) == len(y) == 9 and found.components.shape == (3, shapes.shape[1])
    np.testing.assert_allclose(found.centre, shapes[some].mean(axis=0), atol=1e-6)
    off = np.abs(found.centre + y @ found.components - shapes).max(axis=1) / (tube_rig.size / 2)
    assert off[some].max() < 1e-5 and np.delete(off, some).min() > 1e-3
    looks = np.concatenate([free_form.look(s.points).vectors for s in scans])
    np.testing.assert_allclose(X, (looks - found.mean) / found.deviation)


# ---- rows that learn ----


def _learned(rig, size, monkeypatch, *, units, scales):
    """What the row "cd" finds where learning and fits find the truth: (given, Found)."""
    given = data.study_set(rig, size, 5)
    true = {"train": given.train.templates, "test": given.test.templates}
    results, root = [], rig.joints[rig.root]

    def in_rig_units(places, unit):
        return root + (places - root) / unit

    for k, scale in zip(given.test_subjects, scales, strict=True):
        U, joints = true["test"][k]
        results.append(None)
        if scale is not None:
            rest = {"offsets": in_rig_units(U, scale) - rig.vertices, "rest_joints": in_rig_units(joints, scale)}
            results[-1] = SimpleNamespace(scale=scale, **rest, vertices=U, joints=joints, labels=None)
    fits = iter(results)

    def fit_scan(points):
        found = next(fits)
        if found is None:
            raise InputError("points", "some", "others")
        return found

    templates = {}
    for k, unit in units.items():
        U, joints = (in_rig_units(places, unit) for places in true["train"][k])
        templates[k] = SimpleNamespace(vertices=U, joints=joints)
    own = {"rig": rig, "template_": templates, "unit_": units, "history_": [], "segmenter_": None, **PRETRAINED, "rounds": 1}
    fitter = SimpleNamespace(**own, failures_={}, fit=lambda *given, **more: None, fit_scan=fit_scan)
    fitter.set_params = lambda **parameters: fitter
    monkeypatch.setattr("sklearn.base.clone", lambda fitter: fitter)
    return given, ROWS["cd"].find(Context(rig, given, size, 5, fitter, None, None, 1, lambda share: None))


def test_gaps_of_templates_are_in_the_rigs_unit_and_of_the_right_people(tube_rig, monkeypatch):
    """Units that learning has found, and scales of fits, are undone; the second subject was not learned."""
    size = Size(6, 4, 3, 2, 1, 1, 1, 1)
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=50))
    given, found = _learned(tube_rig, size, monkeypatch, units={2: 2.0, 0: 0.5}, scales=[2.0, None, 0.5, 4.0])
    people = {"subjects": (given.train.templates, (0, 2)), "test scans": (given.test.templates, (0, 0, 1))}
    assert found.failures == {1: "points: got some; expected others."} and list(found.test.fitted) == [True, False, True, True]
    for what, (templates, whose) in people.items():
        gap, true = found.gap[what], [templates[k][0] for k in whose]
        far = [np.linalg.norm(U - tube_rig.vertices, axis=1).mean() / (given.rig.size / 2) for U in true]
        assert gap["before"] == pytest.approx(np.mean(far)) and gap["before"] > 0.01
        assert gap["after"] == pytest.approx(0, abs=1e-12) == gap["after, up to a shift"]


def test_labels_are_those_of_the_round_that_is_kept(tube_rig, monkeypatch):
    """Which need not be the last; before learning they are the pretrained segmenter's."""
    size = Size(6, 4, 3, 2, 1, 1, 1, 1)
    given = data.study_set(tube_rig, size, 5)
    monkeypatch.setattr("sklearn.base.clone", lambda fitter: fitter)
    monkeypatch.setattr(rows_module, "said", lambda segmenter, scans, jobs: [segmenter])

    def fit(points, subjects, *, on_round, **more):
        on_round(1, 0.7)
        on_round(2, 0.6)

    def fit_scan(points):
        raise InputError("points", "some", "others")

    k = int(given.train_subjects[0])
    template = SimpleNamespace(vertices=tube_rig.vertices, joints=tube_rig.joints)
    history = [{"round": i, "kept": i == 1} for i in range(3)]
    own = {"rig": tube_rig, "template_": {k: template}, "unit_": {k: 1.0}, "history_": history, **PRETRAINED, "rounds": 2}
    fitter = SimpleNamespace(**own, failures_={0: "lost"}, fit=fit, fit_scan=fit_scan)
    fitter.set_params = lambda **parameters: fitter
    c = Context(tube_rig, given, size, 5, fitter, lambda: [0.5], lambda labels: labels[0], 1, lambda share: None)
    found = ROWS["rand"].find(c)
    assert (found.accuracy, found.kept_accuracy, found.labels) == ([0.5, 0.7, 0.6], 0.7, [0.7])
    assert found.before == {0: "lost"}


def test_three_times_the_data_is_more_people(tube_rig, monkeypatch):
    """The row without a number learns from the scans that are given, and is judged on these as well."""
    size, seen, fitted = Size(3, 2, 1, 1, 1, 1, 1, 1), [], []
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=50))
    given = data.study_set(tube_rig, size, 5)

    def taught(rig, scans, random_state):
        seen.append((rig, [s.points for s in scans], random_state))
        return lambda points: fitted.append(points) or FreeForm(tube_rig.vertices, tube_rig.joints, 0.0)

    monkeypatch.setattr("lbsfit_np.bench.study.rows.taught", taught)
    shares = []
    c = Context(tube_rig, given, size, 5, SimpleNamespace(random_state=7), None, None, 1, shares.append)
    one, three = (ROWS[row].find(c) for row in ("free-form-supervised", "free-form-supervised-3x"))
    assert [(rig is given.rig, len(points), seed) for rig, points, seed in seen] == [(True, 3, 7), (True, 9, 7)]
    assert all(np.array_equal(a, b) for a, b in zip(seen[0][1], seen[1][1]))
    asked = [*given.test, *given.train, *given.test]
    assert all(np.array_equal(a, s.points) for a, s in zip(fitted, asked, strict=True))
    assert len(one.train.vertices) == 3 and three.train is None and len(one.test.vertices) == len(three.test.vertices) == 2
    assert shares == pytest.approx([0.0, 0.25, 0.5, 0.5, 2 / 3, 5 / 6, 1.0, 0.0, 0.5, 1.0])


def test_a_template_of_another_unit_grows_about_its_root(coarse_hand):
    root = np.array([0.3, -0.2, 0.5]) * coarse_hand.size
    grown = root + 1.1 * (coarse_hand.vertices - root)  # a person who is larger, made as people are
    rig = SimpleNamespace(root=0)
    template = SimpleNamespace(vertices=coarse_hand.vertices, joints=root[None])
    found = learned_templates(SimpleNamespace(rig=rig, template_={"she": template}, unit_={"she": 1.1}))["she"]
    far, gap = (template_gap(coarse_hand, [U], [grown])["after"] for U in (coarse_hand.vertices, found))
    assert gap < 1e-12 < 0.01 < far


# ---- on scans of a hand ----


def test_the_oracle_fit_comes_nearest_to_the_truth(tiny_study):
    scan = tiny_study.test[0]
    result = OracleFit(tiny_study.rig)(scan)
    off = np.linalg.norm(result.joints - scan.joints, axis=1)[tiny_study.rig.moving].mean()
    assert off < 0.03 * (tiny_study.rig.size / 2)
    assert np.linalg.norm(result.vertices - scan.vertices, axis=1).mean() < 0.03 * (tiny_study.rig.size / 2)


def test_the_oracle_knows_where_each_point_was_taken_from(tiny_study, monkeypatch):
    """Not the nearest place: points that are moved to each other's still pull at their own."""
    scan = tiny_study.test[0]
    order = np.random.default_rng(0).permutation(len(scan.points))
    mixed = replace(scan, **{name: getattr(scan, name)[order] for name in ("points", "labels", "triangle", "barycentric")})
    lost = replace(scan, points=scan.points[order])
    minimise, pulls = oracle.minimise, []

    def noted(evaluate, state, *given, **steps):
        # What is minimised and where it begins: where it ends, rounding in another order moves flat directions.
        pulls.append(np.concatenate([evaluate(state).theta.ravel(), evaluate(state).residual.ravel()]))
        return minimise(evaluate, state, *given, **steps | {"max_iterations": 1})

    monkeypatch.setattr(oracle, "minimise", noted)
    for s in (scan, mixed, lost):
        OracleFit(tiny_study.rig)(s)
    known, again, wrong = pulls[::2]
    assert np.abs(known - again).max() < 1e-9 * np.abs(known).max() < 0.1 * np.abs(known).max() < np.abs(known - wrong).max()


def test_the_objective_of_the_oracle_has_the_gradient_that_it_says(tiny_study):
    from lbsfit_np.bench.study import oracle
    from lbsfit_np.correspondence import surface_places
    from lbsfit_np.optimize.model import Model

    model, scan, rng = Model(tiny_study.rig), tiny_study.test[1], np.random.default_rng(0)
    places = surface_places(scan.points, scan.vertices, tiny_study.rig.faces)
    half, weights = tiny_study.rig.size / 2, oracle.OracleFit(tiny_study.rig).settings.weights
    known = oracle._Known(model, scan.points / half, *places, weights)
    state = model.rest().replace(coefficients=0.05 * rng.standard_normal(model.n_coefficients))
    state = state.replace(residual=0.01 * rng.standard_normal(model.rig.vertices.shape))
    state = state.replace(theta=state.theta + 0.1 * rng.standard_normal(state.theta.shape), scale=1.1)
    e, h = known.evaluate(state), 1e-6
    for name in ("theta", "translation", "coefficients", "residual"):
        value, gradient = getattr(state, name), getattr(e, name)
        way = rng.standard_normal(value.shape)
        ends = [known.evaluate(state.replace(**{name: value + s * h * way})).value for s in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(float((gradient * way).sum()), rel=1e-5), name
    ends = [known.evaluate(state.replace(scale=1.1 + s * h)).value for s in (1, -1)]
    assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(e.scale, rel=1e-5)


@pytest.mark.slow
def test_free_form_explains_the_scan_and_the_taught_one_starts_near_the_truth(tiny_study):
    scan = tiny_study.train[1]
    found = FromTemplate(tiny_study.rig)(scan.points)
    assert recon(scan.points, found.vertices) < 1.5 * recon(scan.points, scan.vertices)
    assert found.vertices.shape == scan.vertices.shape and found.joints.shape == scan.joints.shape
    learned = taught(tiny_study.rig, tiny_study.train, 0)(scan.points)  # one that it was taught with
    off = [np.linalg.norm(f.vertices - scan.vertices, axis=1).mean() for f in (learned, found)]
    assert off[0] < 0.5 * off[1]


def test_the_scans_that_took_longest_go_first_and_answers_keep_their_places(tmp_path, monkeypatch):
    """In the row after, so that not all processes wait for one; what failed has its number and why."""
    asked, took, seconds, now = [], {}, {"a": 1, "b": 3, "c": 1, "d": 4}, [0]
    monkeypatch.setattr(rows_module, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def work(task):
        asked.append(task)
        now[0] += seconds[task]
        if task in "cd":
            raise InputError("points", task, "others")
        return task.upper()

    c = SimpleNamespace(jobs=1)
    for order, folder in (("abcd", None), ("dbac", None), ("dbac", tmp_path), ("", tmp_path)):
        asked.clear()
        kept = Checkpoint(folder) if folder else NO_CHECKPOINT
        if not order:
            took.clear()  # what is kept is found by the task, in whatever order
        results, failures = rows_module._tried(c, work, list("abcd"), lambda share: None, kept, took)
        assert results == ["A", "B", None, None] and "".join(asked) == order
        assert failures == {2: "points: got c; expected others.", 3: "points: got d; expected others."}
        assert list(failures) == [2, 3]


def test_what_nobody_foresaw_of_one_scan_is_its_failure_and_of_all_an_error(tmp_path):
    """Nor is it kept: the same command tries that again."""
    kept, asked = Checkpoint(tmp_path), []

    def careless(task):
        asked.append(task)
        if task in broken:
            raise ZeroDivisionError("nobody foresaw this")
        return task.upper()

    c, broken = SimpleNamespace(jobs=1), "b"
    expected = (["A", None], {1: "ZeroDivisionError: nobody foresaw this"})
    assert rows_module._tried(c, careless, list("ab"), lambda share: None, kept) == expected
    broken = ""
    assert rows_module._tried(c, careless, list("ab"), lambda share: None, kept) == (["A", "B"], {}) and asked == list("abb")
    broken = "cd"
    with pytest.raises(ZeroDivisionError, match="nobody foresaw this"):
        rows_module._tried(c, careless, list("cd"), lambda share: None, kept)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_is_killed_costs_its_scan_alone(tmp_path):
    """And the same command tries that again."""
    kept, c = Checkpoint(tmp_path), SimpleNamespace(jobs=2)
    results, failures = rows_module._tried(c, ends_at_1, [0, 1, 2], lambda share: None, kept)
    assert results == [0, None, 2] and failures[1].startswith("the process that fitted it ended: killed by SIGKILL")
    assert unforeseen(failures) == {"unforeseen": [1]}
    assert rows_module._tried(c, abs, [0, 1, 2], lambda share: None, kept) == ([0, 1, 2], {})
    with pytest.raises(InputError, match="n_jobs: got a worker process that ended .*SIGKILL"):
        rows_module._tried(c, kills_itself, [3, 4], lambda share: None, kept)


# ---- all of them ----


@pytest.mark.slow
def test_every_row_does_what_it_says(tube_rig, monkeypatch):
    """All of them, as the command runs them, on few scans, those without pretraining first."""
    rows_are_hurried(monkeypatch)
    learned, fit = [], LBSFitter.fit
    monkeypatch.setattr(LBSFitter, "fit", lambda self, *a, **k: learned.append(self) or fit(self, *a, **k))
    labels = {}

    def on_cell(report, name, seed, row, arrays):
        labels[row] = arrays.get("labels")

    alone = tuple(name for name, row in ROWS.items() if not row.pretrained)
    with monkeypatch.context() as patch:
        patch.setattr("lbsfit_np.learning.fitter.LBSFitter.pretrain", None)  # rows that need none do none
        first = study({"tube": tube_rig}, rows=alone, seeds=[5], on_cell=on_cell)
    given = study_set(tube_rig, sized(tube_rig, "small"), 5)
    assert {"free-form", "oracle-labels", "oracle-fit"} < set(first["rigs"]["tube"]["seeds"]["5"]) == set(alone)
    shares, of_all, reached = {}, [], []

    def told(name, seed, row, share, all_of_them):
        shares.setdefault(row, []).append(share)
        of_all.append(all_of_them)

    def noted(event):
        row, those = list(shares.items())[-1]
        reached.append((event, row, those[-1]))

    monkeypatch.setattr(run_module, "made", partial(run_module.made, reached=noted))
    report = study({"tube": tube_rig}, seeds=[5], before=first, on_cell=on_cell, progress=told)
    cells = report["rigs"]["tube"]["seeds"]["5"]
    assert list(cells) == list(ROWS) and of_all == sorted(of_all) and of_all[0] < 0.2 and of_all[-1] == pytest.approx(1)
    assert not any(cell["unfitted"] for cell in cells.values())
    told = {row: len(cell["accuracy"]) for row, cell in cells.items()}
    assert told == dict.fromkeys(ROWS, 0) | {"joint": 2, "pose-only": 2, "rand": 2}
    assert {row for row, cell in cells.items() if cell["gap"]} == {"joint", "pose-only", "rand", "cd"}
    assert len({cells[row]["accuracy"][0] for row in ("joint", "pose-only", "rand")}) == 1  # the same pretraining
    for row in ("joint", "pose-only", "rand", "cd"):  # first fits, a round, results, and fits of the test scans
        ends = np.array([0.0, 0.8 / 3, 1.6 / 3, 0.8, 1.0]) + 1e-9
        steps = np.histogram(shares[row], ends)[0]
        assert shares[row] == sorted(shares[row]) and np.all(steps >= [4, 5, 4, 3]), (row, steps)
    assert [f.variant for f in learned] == [row for row in ROWS if row in ("joint", "pose-only", "rand", "cd")]
    assert reached[0] == ("pretrained", "pretraining", 1.0)
    assert [what[:2] for what in reached[1:]] == [("first fits", row) for row in ("rand", "pose-only", "joint")]
    assert all(0 < share < 0.8 / 3 + 1e-9 for _, _, share in reached[1:])  # before rounds begin
    for f in learned:  # and different learning,
        said = [] if f.segmenter_ is None else [f.segmenter_.predict(s.points) for s in given.test]
        assert np.array_equal(np.concatenate(said), labels[f.variant]) if said else labels[f.variant] is None
    assert not any(np.array_equal(labels[a], labels[b]) for a, b in combinations(("joint", "pose-only", "rand"), 2))


@pytest.mark.study
def test_the_oracle_fit_is_the_best_of_all_rows_and_the_whole_loop_better_than_fits_without_skinning(tube_rig, monkeypatch):
    small_is_few_and_fast(monkeypatch)
    cells = study({"tube": tube_rig}, seeds=[5])["rigs"]["tube"]["seeds"]["5"]
    assert set(cells) == set(ROWS) and not any(cell["unfitted"] for cell in cells.values())
    assert min(cells, key=lambda row: cells[row]["pose"]) == "oracle-fit"
    assert cells["joint"]["pose"] < 0.5 * cells["free-form"]["pose"]


def test_the_steps_of_skinning_are_those_of_the_fits(tube_rig, tube_result):
    """U^d with the offsets, V = M(Θ, U) without; nothing where there is no fit."""
    r = tube_result
    stages = rows_module._stages(tube_rig, [None, r])
    assert np.isnan(stages["template"][0]).all() and np.isnan(stages["posed"][0]).all() and np.abs(r.offsets).max() > 1e-4
    np.testing.assert_array_equal(stages["template"][1], tube_rig.vertices + r.offsets)
    np.testing.assert_array_equal(stages["posed"][1], tube_rig.pose(r.pose, r.translation, r.scale))
    found = Found(Registrations(np.zeros((2, 3, 3)), np.zeros((2, 1, 3))), stages=stages)
    assert set(making._arrays(found)) == {"vertices", "joints", "template", "posed"}


def test_rows_know_the_papers():
    assert set(PAPER["hand"]) < set(ROWS) and set(PAPER["body"]) < set(ROWS)
    assert all(ROWS[row].paper for known in PAPER.values() for row in known)
    from lbsfit_np.cli.bench import STUDY_NAMES

    assert STUDY_NAMES == tuple(ROWS) and rows_module.ROWS is ROWS
