"""The study's measures on scans made by hand, and the baselines and oracles that play by rules of their own."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lbsfit_np.bench.study import data, free_form, oracle
from lbsfit_np.bench.study.data import SCAN, Size, part_groups
from lbsfit_np.bench.study.free_form import Augmented, FromTemplate, best_free_form
from lbsfit_np.bench.study.measures import POINTS, Registrations, Truth, measured
from lbsfit_np.bench.study.oracle import OracleFit
from lbsfit_np.bench.study.rows import ROWS, Context, Found
from lbsfit_np.bench.study.run import study
from lbsfit_np.correspondence import surface_places
from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.optimize.model import Model
from lbsfit_np.synthesis import SyntheticScan, synthesize

# ---- measures ----


def _scan(rig, theta, template=None, points=None):
    """The scan whose points are the vertices of a posed template, (vertices, joints)."""
    U, J = (rig.vertices, rig.joints) if template is None else template
    posed = {"offsets": U - rig.vertices, "joints": J}
    vertices, joints = (of(theta, **posed) for of in (rig.pose, rig.pose_joints))
    points = vertices.copy() if points is None else points
    return SyntheticScan(points, np.zeros(len(points), int), theta, np.zeros(3), 1.0, U, J, vertices, joints)


@pytest.fixture(scope="module")
def posed(tube_rig):
    """The tube in three poses."""
    rng = np.random.default_rng(0)
    return [_scan(tube_rig, 0.5 * t * (tube_rig.upper + tube_rig.lower) * rng.random(tube_rig.lower.shape)) for t in (0, 1, 2)]


def test_the_snap_is_to_the_point_nearest_to_where_the_registration_leads(tube_rig, posed):
    """Vertices registered at each other's places, and a little beside them: the snap undoes the little, not the rest."""
    truth, V = Truth(tube_rig, posed[:2], 2, 0), posed[1].vertices
    truth.pairs = np.array([[0, 1]])
    order = np.random.default_rng(1).permutation(len(V))
    beside = np.array([0.0, 0.0, 1e-3])  # far less than vertices are apart
    found = measured(truth, Registrations(np.array([posed[0].vertices, V[order] + beside]), np.zeros((2, 4, 3))))
    rows = [np.flatnonzero((posed[0].points == p).all(axis=1))[0] for p in truth.points[0]]
    plain, snapped = (np.linalg.norm(V[order] + b - V, axis=1)[rows] / truth.half for b in (beside, 0.0))
    assert snapped.mean() > 0.4 and abs(plain.mean() - snapped.mean()) > 1e-6
    assert found["corre"]["mean"] == pytest.approx(plain.mean(), abs=1e-9)
    assert found["corre_snapped"]["mean"] == pytest.approx(snapped.mean(), abs=1e-9)
    assert found["corre_snapped"]["p90"] == pytest.approx(np.percentile(snapped, 90), abs=1e-9)


def test_percentiles_are_over_the_points_of_all_pairs(tube_rig, posed):
    """8 % of the vertices of one scan a half size off, and no others: 4 % of the points of two pairs."""
    truth = Truth(tube_rig, posed, 6, 0)
    truth.pairs = np.array([[0, 1], [0, 2]])
    V = np.array([s.vertices for s in posed])
    off = np.arange(V.shape[1]) % 12 == 0
    V[1, off] += [0.0, 0.0, truth.half]
    corre = measured(truth, Registrations(V, np.array([s.joints for s in posed])))["corre"]
    n = V.shape[1]
    assert len(truth.points[0]) == n and 0.08 < off.mean() < 0.1
    assert corre["mean"] == pytest.approx(off.mean() / 2, abs=1e-9)
    assert corre["p50"] == corre["p90"] == pytest.approx(0, abs=1e-9)  # means of the pairs: off.mean() / 2 and more
    assert corre["p95"] == pytest.approx(0, abs=1e-9)  # of the first pair alone: 1
    V[2, off] += [0.0, truth.half, 0.0]
    corre = measured(truth, Registrations(V, np.array([s.joints for s in posed])))["corre"]
    assert corre["p90"] == pytest.approx(0, abs=1e-9) and corre["p95"] == pytest.approx(1, abs=1e-9)


class _Made(list):
    """Scans as the study has them, each made anew when it is asked for; counts how often."""

    asked = 0

    def __getitem__(self, i):
        self.asked += 1
        return super().__getitem__(i)


def test_each_scan_is_made_once_for_its_errors_and_once_for_its_pairs(tube_rig, posed):
    """However many pairs lead to it. And a median is no mean."""
    truth = Truth(tube_rig, _Made(posed), 6, 0)
    joints = np.array([s.joints + [0.0, 0.0, k**2 * truth.half] for k, s in enumerate(posed)])
    found = measured(truth, Registrations(np.array([s.vertices for s in posed]), joints))
    assert len(truth.pairs) == 6 and truth.scans.asked == 2 * len(posed)
    assert found["pose_median"] == pytest.approx(1.0) and found["pose"] == pytest.approx(5 / 3)


def test_a_scan_that_was_not_fitted_counts_in_no_truth(tube_rig, posed):
    truth = Truth(tube_rig, posed, 6, 0)
    truth.recon, truth.pose = np.array([1.0, 2.0, 4.0]), np.array([3.0, 5.0, 9.0])
    V = np.array([s.vertices for s in posed])
    V[1] = np.nan
    found = measured(truth, Registrations(V, np.array([s.joints for s in posed])))
    assert (found["recon_truth"], found["pose_truth"], found["unfitted"]) == (2.5, 6.0, 1)


def test_the_poses_truth_has_the_regressors_joints(tube_rig):
    """At rest the distance between a person's own joints and those that the regressor says; in a pose the same, posed."""
    templates = [(s.vertices, s.joints) for s in (tube_rig.subject(3, amount=1.5), tube_rig.subject(4, amount=1.5))]
    templates = [(U, J + [0.0, 0.02 * k, 0.01]) for k, (U, J) in enumerate(templates, start=1)]
    theta = 0.6 * tube_rig.upper
    scans = [_scan(tube_rig, np.zeros_like(theta), templates[0]), _scan(tube_rig, theta, templates[1])]
    truth, rig, moving = Truth(tube_rig, scans, 2, 0), tube_rig, tube_rig.moving
    (U, J), regressed = templates[0], tube_rig.with_template(templates[1][0]).pose_joints(theta)
    at_rest = np.linalg.norm(rig.joints + rig.regressor @ (U - rig.vertices) - J, axis=1)[moving].mean() / truth.half
    bent = np.linalg.norm(regressed - scans[1].joints, axis=1)[moving].mean() / truth.half
    assert min(at_rest, bent) > 0.01 and abs(at_rest - bent) > 0.01
    V, joints = (np.array([getattr(s, what) for s in scans]) for what in ("vertices", "joints"))
    assert measured(truth, Registrations(V, joints))["pose_truth"] == pytest.approx((at_rest + bent) / 2)
    V[0] = np.nan  # a scan that was not fitted counts in neither
    found = measured(truth, Registrations(V, joints))
    assert found["pose_truth"] == pytest.approx(bent) and found["pose"] == 0 and found["unfitted"] == 1


def test_points_and_pairs_are_drawn_anew_for_each_seed(tube_rig):
    scans = synthesize(tube_rig, 5, random_state=2, n_points=POINTS + 200, holes=0)
    one, again, other = (Truth(tube_rig, scans, 7, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(one.points, again.points)) and np.array_equal(one.pairs, again.pairs)
    assert not np.array_equal(one.pairs, other.pairs)
    every = np.array([(a, b) for a in range(5) for b in range(5) if a != b])
    for truth in (one, other):
        assert len(set(map(tuple, truth.pairs))) == 7 and set(map(tuple, truth.pairs)) < set(map(tuple, every))
        assert not np.array_equal(truth.pairs, every[:7])
        for points, scan in zip(truth.points, scans):
            assert points.shape == (POINTS, 3) and not np.array_equal(points, scan.points[:POINTS])
    assert not any(np.array_equal(np.sort(a, axis=0), np.sort(b, axis=0)) for a, b in zip(one.points, other.points))


# ---- what a run measures ----


def test_labels_are_judged_by_groups_and_training_by_its_own_truth(tube_rig, monkeypatch):
    """The wrong part of the right group is right; and the truth of the training scans has no errors on them."""
    shares = {}

    def find(c):
        rig, groups = c.given.rig, part_groups(c.given.rig)
        rest = [[q for q in range(len(groups)) if q != p] for p in range(len(groups))]
        same = np.array([next((q for q in others if groups[q] == groups[p]), p) for p, others in enumerate(rest)])
        other = np.array([next(q for q in others if groups[q] != groups[p]) for p, others in enumerate(rest)])
        assert (same != np.arange(len(groups))).mean() > 0.5 and len(rig.parts) == len(groups)
        for name, said in {"same": same, "other": other}.items():
            shares[name] = c.right([said[s.labels] for s in c.given.test])
        shares["half of them"] = c.right([(same if k else other)[s.labels] for k, s in enumerate(c.given.test)])
        shares["one not fitted"] = c.right([None, same[c.given.test[1].labels]])
        true = [
            Registrations(*(np.array([getattr(s, what) for s in scans]) for what in ("vertices", "joints")))
            for scans in (c.given.test, c.given.train)
        ]
        return Found(*true)

    monkeypatch.setattr("lbsfit_np.bench.study.run.ROWS", {"joint": replace(ROWS["joint"], find=find, pretrained=False)})
    monkeypatch.setattr("lbsfit_np.bench.study.run.along_path", lambda rig: None)
    monkeypatch.setitem(data.SIZES, "small", Size(2, 2, 1, 1, 2, 50, 1, 1))
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=100))
    cell = study({"h": load_rig("hand-coarse")}, rows=("joint",), seeds=[1])["rigs"]["h"]["seeds"]["1"]["joint"]
    assert shares == {"same": 1.0, "other": 0.0, "half of them": 0.5, "one not fitted": 1.0}
    for found in (cell, cell["on_training"]):
        assert found["pose"] == found["vertices"] == found["unfitted"] == 0
        assert found["recon"] == pytest.approx(found["recon_truth"]) and found["corre"]["mean"] < 1e-12
    assert cell["on_training"]["recon"] != cell["recon"]


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
        return SimpleNamespace(vertices=start, terms={"recon": float(start[0, 0])})

    monkeypatch.setattr(free_form, "_fitted", fit)
    return starts


def test_the_best_start_is_the_one_that_explains_most(tube_rig, fitted):
    candidates = [np.full(tube_rig.vertices.shape, x) for x in (3.0, 1.0, 2.0)]
    vertices, joints = best_free_form(tube_rig, np.zeros((5, 3)), candidates)
    assert len(fitted) == 3 and vertices is candidates[1]
    assert joints == pytest.approx(np.ones(tube_rig.joints.shape))  # the regressor's, of vertices that are all in one place


def test_free_form_starts_from_the_template_and_the_augmented_one_from_poses_that_look_alike_too(tube_rig, fitted):
    points, poses, asked = np.zeros((5, 3)), np.stack([0.2 * k * tube_rig.upper for k in (1, 2, 3)]), []

    def nearest(x, n):
        asked.append((x, n))
        return poses[:n]

    FromTemplate(tube_rig)(points)
    assert [np.array_equal(start, tube_rig.vertices) for start in fitted] == [True]
    fitted.clear()
    Augmented(tube_rig, SimpleNamespace(nearest=nearest))(points)
    ((x, n),) = asked
    assert x is points and n == 3
    for start, theta in zip(fitted, [np.zeros_like(poses[0]), *poses], strict=True):
        np.testing.assert_allclose(start, tube_rig.pose(theta), atol=1e-12)


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
    own = {"template_": templates, "unit_": units, "history_": [], "segmenter_": None, "_pretrained": None, "rounds": 1}
    fitter = SimpleNamespace(**own, fit=lambda *given, **more: None, fit_scan=fit_scan)
    fitter.set_params = lambda **parameters: fitter
    monkeypatch.setattr("sklearn.base.clone", lambda fitter: fitter)
    return given, ROWS["cd"].find(Context(rig, given, size, 5, fitter, None, 1, lambda share: None))


def test_gaps_of_templates_are_in_the_rigs_unit_and_of_the_right_people(tube_rig, monkeypatch):
    """Units that learning has found, and scales of fits, are undone; the second subject was not learned."""
    size = Size(6, 4, 3, 2, 1, 1, 1, 1)
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=50))
    given, found = _learned(tube_rig, size, monkeypatch, units={2: 2.0, 0: 0.5}, scales=[2.0, None, 0.5, 4.0])
    people = {"subjects": (given.train.templates, (0, 2)), "test scans": (given.test.templates, (0, 0, 1))}
    assert found.failures == {1: "points: got some; expected others."} and list(found.test.fitted) == [True, False, True, True]
    for what, (templates, whose) in people.items():
        gap, true = found.gap[what], [templates[k][0] for k in whose]
        far = [np.linalg.norm(U - tube_rig.vertices, axis=1).mean() / given.half for U in true]
        assert gap["before"] == pytest.approx(np.mean(far)) and gap["before"] > 0.01
        assert gap["after"] == pytest.approx(0, abs=1e-12) == gap["after, up to a shift"]


def test_three_times_the_data_is_more_people(tube_rig, monkeypatch):
    """The row without a number learns from the scans that are given, and is judged on these as well."""
    size, seen, fitted = Size(3, 2, 1, 1, 1, 1, 1, 1), [], []
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=50))
    given = data.study_set(tube_rig, size, 5)

    def taught(rig, scans, random_state):
        seen.append((rig, [s.points for s in scans], random_state))
        return lambda points: fitted.append(points) or (tube_rig.vertices, tube_rig.joints)

    monkeypatch.setattr("lbsfit_np.bench.study.rows.taught", taught)
    shares = []
    c = Context(tube_rig, given, size, 5, SimpleNamespace(random_state=7), None, 1, shares.append)
    one, three = (ROWS[row].find(c) for row in ("free-form-supervised", "free-form-supervised-3x"))
    assert [(rig is given.rig, len(points), seed) for rig, points, seed in seen] == [(True, 3, 7), (True, 9, 7)]
    assert all(np.array_equal(a, b) for a, b in zip(seen[0][1], seen[1][1]))
    asked = [*given.test, *given.train, *given.test]
    assert all(np.array_equal(a, s.points) for a, s in zip(fitted, asked, strict=True))
    assert len(one.train.vertices) == 3 and three.train is None and len(one.test.vertices) == len(three.test.vertices) == 2
    assert shares == pytest.approx([0.25, 0.5, 2 / 3, 5 / 6, 1.0, 0.5, 1.0])
