"""The pose of a scan whose template is known: of many starts, most of them bad, the right one wins."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting.effort import EFFORTS
from lbsfit_np.fitting.refit import LimbSearch, Refit, Runner
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.template_fit import TemplateFit
from lbsfit_np.learning.tasks import Pose
from lbsfit_np.losses import chamfer
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import Coverage
from lbsfit_np.starts.limbs import LimbPoses
from lbsfit_np.synthesis import uniform_poses

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def rig():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def model(rig):
    return Model(rig)


@pytest.fixture(scope="module")
def refit(model):
    return Refit(model)


@pytest.fixture(scope="module", params=[0, 1])
def case(request, rig, model):
    return Case(rig, model, request.param)


class Case:
    """A hand that bends its middle finger and not its index finger; ``swap`` is the pose with the two exchanged."""

    def __init__(self, rig, model, seed):
        row = {name: j for j, name in enumerate(rig.joint_names)}
        rng = np.random.default_rng(seed)
        theta = np.zeros_like(rig.lower)
        for k in (1, 2, 3):
            theta[row[f"middle{k}"], 0] = 0.9 * rig.upper[row[f"middle{k}"], 0]
        theta[rig.root] = rng.uniform(-0.3, 0.3, 3)
        scan = lbs.synthesize(rig, 1, poses=theta[None], random_state=seed, shape=0.0, holes=0, density=0.0, n_points=900)[0]
        half, centre = rig.size / 2, scan.points.mean(axis=0)
        self.problem = Problem((scan.points - centre) / half)
        self.labels, self.theta = scan.labels, theta
        self.truth = model.rest().replace(theta=theta, translation=-centre / half)
        swapped = theta.copy()
        for k in (1, 2, 3):
            pair = [row[f"middle{k}"], row[f"index{k}"]]
            swapped[pair] = swapped[pair[::-1]]
        self.swap = self.truth.replace(theta=swapped)
        turning = (rig.upper > rig.lower) & rig.moving[:, None]
        self.near = theta + 0.2 * rng.uniform(-1, 1, theta.shape) * turning
        self.bad = [0.5 * rig.lower, 0.5 * rig.upper]
        self.proba = np.eye(len(rig.parts))[scan.labels]

    def error(self, model, state):
        return np.linalg.norm(model.pose(state)[0].joints - model.pose(self.truth)[0].joints, axis=1).mean()


def test_two_exchanged_fingers_stay_exchanged_without_other_starts(model, refit, case):
    """What the other tests mend."""
    state, _, which = refit(case.problem, [case.swap])
    assert case.error(model, state) > 0.15 and which == 0


@pytest.fixture(scope="module")
def poses(rig, case):
    """A library's, in some of which these fingers are right."""
    theta = uniform_poses(rig, 60, np.random.default_rng(5))
    theta[::3] = case.theta + 0.1 * np.random.default_rng(6).uniform(-1, 1, theta[::3].shape) * (rig.upper > rig.lower)
    return theta


def test_limbs_in_other_poses_bring_two_exchanged_fingers_home(model, refit, case, poses):
    limbs = LimbSearch(LimbPoses(model, poses), EFFORTS["balanced"])
    state, _, which = refit(case.problem, [case.swap], limbs=limbs)
    assert case.error(model, state) < 0.008 and which == 0  # where it has come from
    right, _, _ = refit(case.problem, [case.truth], limbs=limbs)
    np.testing.assert_array_equal(right.theta, refit(case.problem, [case.truth])[0].theta)  # nothing to mend
    never = replace(limbs, effort=replace(limbs.effort, generations=0))
    np.testing.assert_array_equal(
        refit(case.problem, [case.swap], limbs=never)[0].theta, refit(case.problem, [case.swap])[0].theta
    )


@pytest.mark.parametrize("library, home", [(True, True), (False, False)])
def test_poses_of_a_round_have_other_limbs_where_variants_have_a_library(library, home, model, case, poses):
    known = SimpleNamespace(poses=poses, regress=lambda X: case.bad[0])
    work = Pose({"ann": model}, FitSettings(), known, 0, library)
    state, _, _ = work(("ann", case.problem.X, case.swap, [], None))
    assert (case.error(model, state) < 0.008) == home


@pytest.mark.parametrize("effort, partial", [("fast", True), ("thorough", False)])
def test_poses_of_a_round_are_looked_for_as_settings_say(effort, partial, rig, model, monkeypatch):
    """On each subject's own template, with the settings' effort, of scans of one side where they are that."""
    models = {"ann": model, "bob": Model(rig.with_template(1.1 * rig.vertices))}
    known = SimpleNamespace(poses=np.zeros((2, *rig.lower.shape)), regress=lambda X: rig.lower)
    asked, state = [], model.rest()
    proba = np.full((len(rig.vertices), len(rig.parts)), 1 / len(rig.parts), dtype=np.float16)  # as they are kept
    monkeypatch.setattr(Refit, "__call__", lambda self, *_, limbs, **more: asked.append((self, limbs, more)) or (state, 0.1, 0))
    work = Pose(models, FitSettings(effort=effort, partial=partial), known, 0, True)
    for subject in ("bob", "ann", "bob"):
        work((subject, rig.vertices, state, [], proba))
        refit, limbs, more = asked[-1]
        assert more["proba"].dtype == np.float64
        assert refit.model is limbs.poses.model is models[subject]
        assert refit._last.coverage == Coverage(partial) and limbs.effort is EFFORTS[effort]
        assert (refit._bends is None) == (effort == "fast")
    assert asked[0][0] is asked[2][0] and asked[0][1] is asked[2][1]  # made ready once


@pytest.mark.parametrize("effort, partial", [("fast", True), ("balanced", False)])
def test_fits_after_learning_try_other_bends_as_effort_says(effort, partial, rig, model):
    fit = TemplateFit(rig, model, FitSettings(effort=effort, partial=partial))
    assert fit.refit.model is model and fit.refit._last.coverage == Coverage(partial)
    assert (fit.refit._bends is None) == (effort == "fast")


@pytest.mark.parametrize("left, generations", [(0.98, 3), (0.995, 1)])
def test_limbs_are_tried_as_effort_says_while_it_helps(left, generations, model, refit, monkeypatch):
    """Each time, of the best two, two poses each are tried, of which one leaves this share of what the best one has left."""
    effort = replace(EFFORTS["thorough"], generations=3, parents=2, proposals=7, survivors=5)
    asked, raced, problem = [], [], Problem(np.zeros((9, 3)))
    poses = iter(_poses(model, 16))  # none twice

    def proposals(problem, state, n, *, closer):
        asked.append((n, closer))
        return [next(poses), next(poses)]

    def race(tried, survivors):
        raced.append((len(tried), survivors))
        return [replace(tried[-1], value=left ** len(raced))]

    monkeypatch.setattr(refit, "race", race)
    starts = [model.rest().replace(theta=next(poses)) for _ in range(3)]
    runners = [Runner(problem, state, k, value) for k, (state, value) in enumerate(zip(starts, (1.0, 1.1, 1.2)))]
    found = refit.with_other_limbs(runners, LimbSearch(SimpleNamespace(proposals=proposals), effort))
    assert asked == 2 * generations * [(7, True)] and raced == generations * [(4, 5)]
    expected = sorted([1.0, 1.1, *(left**k for k in range(1, generations + 1))])
    assert [r.value for r in found] == expected[:3]  # as many as before


def test_copies_of_one_pose_take_the_place_of_no_other(model, refit, monkeypatch):
    """Neither among those whose limbs are tried nor among those that go on; in another frame the same angles are another pose."""
    a, b, c = (model.rest().replace(theta=theta) for theta in _poses(model, 3))
    here, again, there = Problem(np.zeros((9, 3))), Problem(np.zeros((9, 3))), Problem(np.ones((9, 3)))
    runners = [Runner(here, a, 0, 1.0), Runner(here, a, 1, 1.1), Runner(here, b, 2, 1.2), Runner(there, a, 3, 1.3)]
    runners.insert(1, Runner(again, a, 4, 1.05))  # made anew in the same frame
    asked = []
    limbs = SimpleNamespace(proposals=lambda problem, state, n, closer: asked.append(state) or [c.theta])
    monkeypatch.setattr(refit, "race", lambda tried, survivors: [replace(r, value=0.995) for r in tried])
    effort = replace(EFFORTS["thorough"], generations=1, parents=2)
    found = refit.with_other_limbs(runners, LimbSearch(limbs, effort))
    assert asked == [a, b]
    assert [r.name for r in found] == [0, 0, 2, 3] and found[0].state.theta is c.theta


def _poses(model, n):
    return uniform_poses(model.rig, n, np.random.default_rng(1))


def test_the_right_start_among_bad_ones_wins(model, refit, case):
    state, value, which = refit(case.problem, [case.swap], poses=[*case.bad, case.near])
    assert case.error(model, state) < 0.008 and which == 3
    swapped = refit(case.problem, [case.swap])[1]
    assert value < 0.7 * swapped
    first, _, which = refit(case.problem, [case.swap], poses=[case.near, *case.bad])
    np.testing.assert_array_equal(first.theta, state.theta)
    assert which == 1
    _, _, which = refit(case.problem, [case.truth, case.swap], poses=case.bad)
    assert which == 0


def test_of_poses_that_are_as_good_the_known_one_wins(model, case, monkeypatch):
    """So that new starts that have won can be counted."""
    refit = Refit(model)
    monkeypatch.setattr(refit, "race", lambda runners: [Runner(case.problem, case.truth, 1, 0.001)])
    assert refit(case.problem, [case.truth], poses=case.bad)[2] == 0


@pytest.mark.parametrize("known", [True, False])
def test_a_pose_that_was_known_is_not_lost_to_one_that_looks_better_on_few_points(known, model, case, monkeypatch):
    refit = Refit(model)
    monkeypatch.setattr(refit, "race", lambda runners: [Runner(case.problem, case.swap, "swap", 0.001)])
    states = [case.truth] if known else []
    state, value, which = refit(case.problem, states, poses=[case.swap.theta])
    assert (case.error(model, state) < 0.02) == known and which == (0 if known else "swap")
    assert value == pytest.approx(refit.chamfer(case.problem, state))


@pytest.mark.parametrize("more, looked_at", [(1.25, True), (1.35, False)])
def test_of_poses_that_are_close_on_few_points_all_decide(more, looked_at, model, case, monkeypatch):
    refit = Refit(model)
    ends = [Runner(case.problem, case.swap, "swap", 0.001), Runner(case.problem, case.truth, "truth", more * 0.001)]
    monkeypatch.setattr(refit, "race", lambda runners: ends)
    assert refit(case.problem, poses=[case.swap.theta])[2] == ("truth" if looked_at else "swap")


def test_ends_in_one_pose_go_on_once(model, case, monkeypatch):
    refit, went_on = Refit(model), []
    nearly = case.swap.replace(translation=case.swap.translation + 0.001)
    ends = [Runner(case.problem, s, k, 0.001 + 1e-5 * k) for k, s in enumerate((case.swap, nearly, case.truth))]
    monkeypatch.setattr(refit, "race", lambda runners: ends)
    monkeypatch.setattr(refit, "_moved", lambda steps, problem, r, iterations=None: went_on.append(r.name) or r)
    refit(case.problem, poses=[case.swap.theta])
    assert went_on == [0, 2]


def test_the_last_steps_have_the_last_word(model, case, monkeypatch):
    """The first steps' best start goes astray in the last ones: the other wins, and goes on with all points."""
    refit = Refit(model)
    starts = [case.bad[0], case.near]
    assert refit(case.problem, poses=starts)[2] == 1
    pose, ends = refit._near.pose, []

    def astray(problem, state, **options):
        state, value = pose(problem, state, **options)
        ends.append(state)
        return state, value + (len(ends) == 1)

    monkeypatch.setattr(refit._near, "pose", astray)
    state, value, which = refit(case.problem, poses=starts)
    assert which == 0 and len(ends) == 2 and case.error(model, ends[0]) < 0.01
    np.testing.assert_array_equal(state.theta, refit.polish(case.problem, ends[1]).theta)
    assert value == pytest.approx(chamfer(case.problem.X, model.pose(state)[0].vertices)[0], rel=1e-12)


def test_runners_come_back_best_first_with_their_names_and_frames(model, refit, case):
    """First steps keep all, in another order; a race keeps some, each with its own problem, name and value."""
    turned = Problem(case.problem.X @ np.diag([-1.0, 1.0, -1.0]))
    starts = [Runner(case.problem, refit.placed(case.problem, t), name) for t, name in zip([*case.bad, case.near], "abc")]
    starts.append(Runner(turned, refit.placed(turned, case.near), "d"))
    assert all(r.value == np.inf for r in starts)
    first = refit.first_steps(starts)
    assert sorted(r.name for r in first) == list("abcd") and (np.diff([r.value for r in first]) >= 0).all()
    assert first[0].name == "c" and first[0].problem is case.problem
    assert next(r for r in first if r.name == "d").problem is turned
    ends = refit.race(starts, 2)
    assert [r.name for r in ends] == [r.name for r in refit.last_steps(first[:2])] and len(ends) == 2
    assert ends[0].name == "c" and ends[0].value < first[0].value and case.error(model, ends[0].state) < 0.01


def test_other_unknowns_can_be_freed(model, refit, case):
    other = refit.freeing(("pose", "translation", "scale"))
    bigger = Problem(1.1 * case.problem.X)
    assert other(bigger, poses=[case.near])[0].scale == pytest.approx(1.1, abs=0.015)
    assert refit(bigger, poses=[case.near])[0].scale == 1.0
    bending = Refit(model, bends=True)
    other = bending.freeing(("pose", "scale"))
    for of in (bending, other):
        assert of._bends._free == of.free and of._bends._to_the_end.__self__ is of
    assert other._bends._steps is bending._bends._steps  # made ready once


def test_other_bends_are_tried_of_what_has_won(model, case, monkeypatch):
    refit, asked, other = Refit(model, bends=True), [], case.truth.replace(scale=0.9)
    monkeypatch.setattr(refit, "_bends", lambda *given: asked.append(given) or (other, 0.0))
    state, value, which = refit(case.problem, [case.swap], poses=[case.near])
    ((problem, best, left),) = asked
    assert state is other and which == 1 and value == pytest.approx(chamfer(case.problem.X, model.pose(other)[0].vertices)[0])
    assert problem is case.problem and case.error(model, best) < 0.01 and left == refit.to_the_end(problem, best, iterations=0)[1]
    asked.clear()
    refit(case.problem, [case.truth], proba=case.proba, labels_known=True)  # labels say where all points are
    assert not asked
    best, value, _ = refit(case.problem, [case.truth], bend=False)
    assert not asked and value == refit.chamfer(case.problem, best)
    assert refit.bent(case.problem, best) == (other, refit.chamfer(case.problem, other)) and len(asked) == 1
    assert Refit(model).bent(case.problem, best) == (best, value)  # one that tries none


def test_a_hand_that_points_the_wrong_way_is_turned():
    """Steps by themselves leave it there; other bends alone turn it, before any bone is in doubt."""
    rig = lbs.load_rig("body-coarse")
    model, wrist = Model(rig), rig.joint_names.index("left_wrist")
    (s,) = lbs.synthesize(rig, poses="natural", random_state=6, shape=0.0, n_points=900)
    centre, theta = s.points.mean(axis=0), s.pose.copy()
    theta[wrist, 0] = min(theta[wrist, 0] + 1.3, rig.upper[wrist, 0])
    refit, wrong = Refit(model, bends=True), model.rest().replace(theta=theta, translation=(s.translation - centre) / model.half)
    problem = Problem((s.points - centre) / model.half)
    stuck, value = refit.to_the_end(problem, wrong)
    assert np.linalg.norm(stuck.theta[wrist] - s.pose[wrist]) > 0.7
    refit._bends._rounds = 0
    state, least = refit._bends(problem, stuck, value)
    assert least < 0.95 * value and np.linalg.norm(state.theta[wrist] - s.pose[wrist]) < 0.2
    assert state.scale == 1.0 and not state.coefficients.any()


def test_the_value_is_the_plain_chamfer_distance(model, refit, case):
    state, value, _ = refit(case.problem, [case.swap], poses=[case.near])
    assert value == pytest.approx(chamfer(case.problem.X, model.pose(state)[0].vertices)[0], rel=1e-12)


def test_parts_give_one_more_start(model, refit, case):
    state, _, which = refit(case.problem, [case.swap], poses=case.bad, proba=case.proba)
    assert case.error(model, state) < 0.008 and which == 3
    unsure = 0.6 * case.proba + 0.4 / case.proba.shape[1]
    state, _, which = refit(case.problem, [case.swap], poses=case.bad, proba=unsure)
    assert case.error(model, state) < 0.008 and which == 3


def test_labels_that_err_are_mended_on_the_way(rig, model, refit):
    """A third of the points has a label drawn at random; those that are known to be right are kept to."""
    errors = []
    for seed in range(6):
        case, rng = Case(rig, model, seed), np.random.default_rng(seed)
        wrong = rng.random(len(case.proba)) < 0.33
        drawn = np.eye(case.proba.shape[1])[rng.integers(case.proba.shape[1], size=len(case.proba))]
        proba = np.where(wrong[:, None], drawn, case.proba)
        errors.append([case.error(model, refit.from_parts(case.problem, proba, known)) for known in (False, True)])
    assert all(mended < 0.5 * kept for mended, kept in errors)
    mended, kept = np.median(errors, axis=0)
    assert mended < 0.25 * kept


def test_known_labels_lead_alone(model, refit, case):
    state, value, which = refit(case.problem, proba=case.proba, labels_known=True)
    assert case.error(model, state) < 0.003 and which == 0
    assert value == pytest.approx(chamfer(case.problem.X, model.pose(state)[0].vertices)[0], rel=1e-12)


def test_a_start_that_is_given_beside_known_labels_is_the_one(model, refit, case):
    near = refit(case.problem, poses=[case.near], proba=case.proba, labels_known=True)[0]
    assert case.error(model, near) < 0.003
    turned = case.theta.copy()
    turned[model.rig.root] += [0.0, np.pi, 0.0]  # the wrong way round, labels or not: the start decides
    away = refit(case.problem, poses=[turned], proba=case.proba, labels_known=True)[0]
    assert not np.allclose(away.theta, near.theta, atol=0.05)


def test_starts_of_another_template_take_this_one(refit, model, case):
    """Coefficients and residuals belong to the model that the state was found with."""
    rng = np.random.default_rng(0)
    foreign = case.truth.replace(coefficients=rng.random(3), residual=rng.random(model.rig.vertices.shape))
    state, _, _ = refit(case.problem, [foreign])
    assert state.residual is None and not state.coefficients.any() and len(state.coefficients) == model.n_coefficients
    np.testing.assert_array_equal(state.theta, refit(case.problem, [case.truth])[0].theta)


def test_starts_outside_the_limits_are_moved_inside(model, refit, case):
    state, _, _ = refit(case.problem, poses=[case.theta * 1.5 + 0.5])
    others = np.arange(len(state.theta)) != model.rig.root
    assert (state.theta >= model.rig.lower)[others].all() and (state.theta <= model.rig.upper)[others].all()


def test_scale_is_found_where_it_is_free(rig, model, case):
    bigger = Problem(case.problem.X * 1.1)
    found = Refit(model, ("pose", "translation", "scale"))(bigger, poses=[case.near])[0]
    assert found.scale == pytest.approx(1.1, abs=0.015)
    assert Refit(model)(bigger, poses=[case.near])[0].scale == 1.0


def test_a_large_scan_gives_what_a_thinned_one_gives(rig, model, refit, case):
    """First steps look at some points; the last at all."""
    scan = lbs.synthesize(rig, 1, poses=case.theta[None], random_state=5, shape=0.0, holes=0, density=0.0, n_points=4000)[0]
    centre = scan.points.mean(axis=0)
    X = (scan.points - centre) / (rig.size / 2)
    weights = np.full(4000, 1 / 4000)
    truth = case.truth.replace(translation=-centre / (rig.size / 2))
    for problem in (Problem(X), Problem(X, weights)):
        state, _, which = refit(problem, [case.swap], poses=[*case.bad, case.near])
        away = model.pose(state)[0].joints - model.pose(truth)[0].joints
        assert np.linalg.norm(away, axis=1).mean() < 0.006 and which == 3


def test_fewer_points_keep_their_weights():
    rng = np.random.default_rng(0)
    X, w = rng.random((2000, 3)), rng.random(2000)
    few = Problem(X, w / w.sum()).thinned(700)
    rows = [int(np.flatnonzero((X == x).all(axis=1))[0]) for x in few.X]
    assert len(set(rows)) == 700 and few.x_weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(few.x_weights, w[rows] / w[rows].sum())
    small = Problem(X[:700])
    assert small.thinned(700) is small and Problem(X).thinned(700).x_weights is None


def test_poses_are_put_where_the_scan_is(rig, model, refit, case):
    away = Problem(case.problem.X + [4.0, -2.0, 1.0])
    found = refit(away, poses=[case.near])[0]
    there = found.replace(translation=found.translation - [4.0, -2.0, 1.0])
    assert case.error(model, there) < 0.008


def test_points_without_weight_do_not_count(model, case):
    X = np.vstack([case.problem.X, case.problem.X + [0.08, 0.0, 0.0]])
    order = np.random.default_rng(0).permutation(len(X))
    w = np.r_[np.ones(900), np.full(900, 1e-9)]
    light = Refit(model)(Problem(X[order], (w / w.sum())[order]), [case.swap], poses=[*case.bad, case.near])[0]
    heavy = Refit(model)(Problem(X[order]), [case.swap], poses=[*case.bad, case.near])[0]
    assert case.error(model, light) < 0.3 * case.error(model, heavy)


def test_polishing_goes_on_from_where_it_is(model, refit, case):
    near = case.truth.replace(theta=np.where(np.arange(len(case.theta))[:, None] == model.rig.root, case.theta, case.near))
    near = near.replace(theta=0.7 * case.truth.theta + 0.3 * near.theta)
    assert case.error(model, refit.polish(case.problem, near)) < 0.4 * case.error(model, near)
    held = refit.polish(case.problem, near, prior=(near.theta, 1e3))
    np.testing.assert_allclose(held.theta, np.clip(near.theta, model.rig.lower, model.rig.upper), atol=2e-3)
    assert refit.polish(case.problem, case.truth, labels=case.labels).theta.shape == case.theta.shape
