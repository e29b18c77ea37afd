"""Evidence is near 0 for right fits and speaks up for wrong ones; the probability follows it; reasons are named."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.bench.calibrate import regression
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.confidence import EVIDENCE, REGRESSED, evidence_of, logarithms, probability_of, shown_problem, verdict_of
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import WHOLE, Coverage, hull_planes, within_hull
from lbsfit_np.rig.build import build_rig
from lbsfit_np.sensor import sample_surface

PARTS = {"part_unexplained": "left_arm", "part_unreached": "right_arm"}
NOTHING = dict.fromkeys(EVIDENCE, 0.0)


@pytest.fixture(scope="module")
def model():
    return Model(lbs.load_rig("hand-coarse"))


@pytest.fixture(scope="module")
def right(model):
    """A state, and a scan of it in the normalised frame with its labels."""
    (scan,) = lbs.synthesize(model.source, 1, poses="natural", random_state=4, shape=0.0)
    return model.rest().replace(theta=scan.pose), scan.points / model.half, scan.labels


def _evidence(model, state, X, **more):
    V = model.pose(state)[0].vertices
    return evidence_of(model, V, X, theta=state.theta, **more)


def test_a_right_fit_leaves_next_to_nothing(model, right):
    state, X, labels = right
    evidence, _ = _evidence(model, state, X, proba=np.eye(len(model.source.parts))[labels])
    assert set(evidence) == set(EVIDENCE) and all(0 <= v <= 1 for v in evidence.values())
    assert evidence["distance"] < 0.15 and evidence["unexplained"] < 0.01 and evidence["unreached"] < 0.05
    assert evidence["disagreement"] < 0.15 and evidence["rival"] == 0


@pytest.mark.parametrize("finger", ["index", "pinky"])
def test_a_finger_in_a_wrong_place_is_told_and_named(model, right, finger):
    state, X, _ = right
    good, _ = _evidence(model, state, X)
    theta = state.theta.copy()
    row = model.source.joint_names.index(f"{finger}1")
    theta[row, 0] += 0.9 if theta[row, 0] < 0.6 else -0.9
    bad, worst = _evidence(model, state.replace(theta=theta), X)
    assert bad["unexplained"] > 3 * good["unexplained"] and bad["part_unexplained"] > 2 * good["part_unexplained"]
    assert bad["part_unreached"] > 2 * good["part_unreached"]
    assert finger in model.source.parts[worst["part_unreached"]]
    assert probability_of(bad) < probability_of(good)


def test_noise_alone_is_no_fault(model, right):
    state, X, _ = right
    noisy = X + 0.02 * np.random.default_rng(0).standard_normal(X.shape)
    evidence, _ = _evidence(model, state, noisy)
    assert evidence["unexplained"] < 0.02 and evidence["distance"] > 0.1


def test_points_that_are_not_on_the_rig_are_not_explained(model, right):
    """However evenly they lie beside it: a shift of all, or a cloud that fills the box around it."""
    state, X, _ = right
    for away in (X + 0.25, np.random.default_rng(0).uniform(X.min(axis=0), X.max(axis=0), X.shape)):
        evidence, _ = _evidence(model, state, away)
        assert evidence["distance"] > 0.6 and evidence["unexplained"] > 0.1
        assert verdict_of(evidence, probability_of(evidence))[0] != "ok"
    assert probability_of(NOTHING | {"distance": 0.55}) > 0.9 and probability_of(NOTHING | {"distance": 0.65}) == 0.25


def test_of_a_part_alone_the_whole_is_not_known():
    """Noise, too, makes guesses of many joints, and an arm less is no doubt of the others."""
    perfect = dict.fromkeys(NOTHING, 0.0)
    for guesses, missing, believed in ((0.5, 0.95, False), (0.5, 0.1, True), (0.3, 0.95, True), (0.0, 0.0, True)):
        p = probability_of(perfect | {"part_unreached": missing}, guesses)
        assert (p > 0.5) == believed and (p == 0.25) == (not believed)


def test_points_count_as_much_as_they_weigh(model, right):
    state, X, labels = right
    proba = np.eye(len(model.source.parts))[labels]
    clutter = np.random.default_rng(0).uniform(X.min(axis=0), X.max(axis=0), (600, 3))
    both, told = np.vstack([X, clutter]), np.vstack([proba, np.full((600, proba.shape[1]), 1 / proba.shape[1])])
    plain, _ = _evidence(model, state, X, proba=proba)
    light, _ = _evidence(model, state, both, proba=told, x_weights=np.r_[np.ones(len(X)), np.full(600, 1e-9)])
    heavy, _ = _evidence(model, state, both, proba=told)
    for name in ("distance", "unexplained", "disagreement"):
        assert light[name] == pytest.approx(plain[name], rel=1e-2) and heavy[name] > plain[name]


def test_clutter_is_no_fault_but_a_lump_beside_the_mesh_is(model, right):
    state, X, _ = right
    rng = np.random.default_rng(0)
    plain, _ = _evidence(model, state, X)
    clutter = rng.uniform(X.min(axis=0) - 0.2, X.max(axis=0) + 0.2, (250, 3))
    strewn, _ = _evidence(model, state, np.vstack([X, clutter]))
    assert strewn["unexplained"] < plain["unexplained"] + 0.015
    lump = X.mean(axis=0) + [0.0, 0.0, 0.6] + 0.05 * rng.standard_normal((250, 3))
    lumped, _ = _evidence(model, state, np.vstack([X, lump]))
    assert lumped["unexplained"] > 0.06


@pytest.mark.parametrize("n", [300, 2500])
def test_clutter_close_to_the_body_is_no_fault_but_a_finger_of_points_is(model, n):
    """Whose third neighbours are on the body, so that these do not tell it."""
    rng = np.random.default_rng(1)
    (scan,) = lbs.synthesize(model.source, 1, poses="natural", random_state=4, shape=0.0, n_points=n)
    state, X = model.rest().replace(theta=scan.pose), scan.points / model.half
    strewn = X[rng.choice(n, n // 10)] + rng.uniform(-0.12, 0.12, (n // 10, 3))
    plain, _ = _evidence(model, state, X)
    cluttered, _ = _evidence(model, state, np.vstack([X, strewn]))
    assert cluttered["unexplained"] < plain["unexplained"] + 0.02
    assert cluttered["part_unexplained"] < 0.12
    finger = rng.uniform(-1, 1, (n // 15, 3)) * [0.05, 0.25, 0.05] + X.mean(axis=0) + [0.0, 0.0, 0.4]
    sixth, _ = _evidence(model, state, np.vstack([X, finger]))
    assert sixth["unexplained"] > 0.04 and sixth["part_unexplained"] > 0.15


@pytest.mark.parametrize(
    "n, together, a_fault",
    [(300, 5, True), (1250, 3, False), (1250, 5, True), (2450, 5, False), (2450, 8, True), (6000, 5, False), (6000, 8, True)],
)
def test_how_many_points_make_a_lump_depends_on_how_many_there_are(model, n, together, a_fault):
    """Five of 300 points close to each other are more than chance, five of 2,450 are not; and eight always are."""
    (scan,) = lbs.synthesize(model.source, 1, poses="natural", random_state=4, shape=0.0, n_points=n)
    state, X = model.rest().replace(theta=scan.pose), scan.points / model.half
    lump = X.mean(axis=0) + [0.0, 0.0, 0.8] + np.random.default_rng(1).uniform(-0.01, 0.01, (together, 3))
    plain, lumped = (_evidence(model, state, points)[0]["unexplained"] for points in (X, np.vstack([X, lump])))
    assert lumped - plain == pytest.approx(together / (n + together) if a_fault else 0.0, rel=0.1, abs=1e-4)


def test_far_points_are_a_fault_only_where_they_are_too_many(model, right):
    """Up to three in ten may be clutter; where there are more, the pose may be wrong instead."""
    state, X, _ = right
    for share, a_fault in ((0.2, False), (0.4, True)):
        n = int(share / (1 - share) * len(X))
        far = np.random.default_rng(0).uniform(X.min(axis=0) - 1.5, X.max(axis=0) + 1.5, (n, 3))
        evidence, _ = _evidence(model, state, np.vstack([X, far]))
        assert evidence["unexplained"] > 0.9 * share if a_fault else evidence["unexplained"] < 0.002, share


def test_a_part_that_no_point_is_near_is_wholly_unreached(model, right):
    """However small it is."""
    state, X, labels = right
    finger = [i for i, part in enumerate(model.source.parts) if part.startswith("index")]
    evidence, worst = _evidence(model, state, X[~np.isin(labels, finger)])
    assert evidence["part_unreached"] > 0.9 and evidence["unreached"] < 0.2
    assert model.source.parts[worst["part_unreached"]] == "index3"


def test_few_points_do_not_hide_a_wrong_limb(model):
    """However far apart they are, surface further from them than 0.08 is not reached."""
    (scan,) = lbs.synthesize(model.source, 1, poses="natural", random_state=4, shape=0.0, n_points=60)
    state, X = model.rest().replace(theta=scan.pose), scan.points / model.half
    theta = scan.pose.copy()
    theta[model.source.joint_names.index("index1"), 0] -= 0.9
    bad, worst = _evidence(model, state.replace(theta=theta), X)
    assert bad["unreached"] > 0.25 and bad["part_unreached"] > 0.96
    assert model.source.parts[worst["part_unreached"]].startswith("index")
    assert probability_of(bad) < probability_of(_evidence(model, state, X)[0])


def test_one_side_of_a_right_fit_is_enough_where_that_is_known(model, right):
    state, _, _ = right
    theta = state.theta
    (scan,) = lbs.synthesize(model.source, 1, poses=theta[None], random_state=3, shape=0.0, one_sided=True)
    X = scan.points / model.half
    whole, _ = _evidence(model, state, X)
    partial, _ = _evidence(model, state, X, coverage=Coverage(one_sided=True))
    assert partial["unreached"] < 0.6 * whole["unreached"]
    assert partial["part_unreached"] < 0.5 * whole["part_unreached"]
    problem = shown_problem(model, Problem(X), state, Coverage(one_sided=True))
    hidden = problem.v_weights == 0
    assert 0.3 < hidden.mean() < 0.9 and problem.v_weights.shape == (len(model.rig.vertices),)


def test_clutter_has_no_partner_and_takes_no_part(model, right):
    state, X, _ = right
    away = X.mean(axis=0) + np.array([[0.0, 0.9, 0.3], [0.4, 0.8, 0.6]])
    problem = shown_problem(model, Problem(np.vstack([X, away])), state, WHOLE)
    assert (problem.x_weights[-2:] == 0).all() and problem.x_weights.sum() == pytest.approx(1)
    assert (problem.x_weights[:-2] > 0).mean() > 0.99
    far = state.replace(translation=state.translation + 3.0)
    same = Problem(X)
    assert shown_problem(model, same, far, WHOLE) is same  # nothing fits: that is no reason to look away


def test_partners_are_looked_for_on_the_template_as_it_has_become(tube_rig):
    """Of a scan with a bump that the template has as well nothing is left out."""
    tube = Model(tube_rig)
    bump = np.zeros_like(tube.rig.vertices)
    bump[:20] = [0.0, 0.0, 0.5]
    state = tube.rest().replace(residual=bump)
    same = Problem(tube.deformed(state).vertices)
    assert shown_problem(tube, same, state, WHOLE) is same


@pytest.mark.parametrize("of", ["points", "surface"])
def test_what_is_usual_in_a_scan_has_a_partner_however_far_that_is(model, of):
    """Nearly all is 0.05 away, so that 0.15 is little and 0.25 is not."""
    state = model.rest()
    V = model.pose(state)[0].vertices
    tip, out = V[:, 1].argmax(), np.array([0.0, 1.0, 0.0])  # beyond the highest vertex, distances are from that one
    usual = V + 0.05 * np.array([0.0, 0.0, 1.0])
    if of == "points":
        X = np.vstack([usual, V[tip] + 0.15 * out, V[tip] + 0.25 * out])
        kept = shown_problem(model, Problem(X), state, WHOLE).x_weights[-2:] > 0
    else:  # the scan lacks what is around the tip
        away = np.linalg.norm(V - V[tip], axis=1)
        back = [shown_problem(model, Problem(V[away > gap] + 0.05 * out), state, WHOLE) for gap in (0.12, 0.3)]
        kept = np.array([p.v_weights is None or p.v_weights[tip] > 0 for p in back])
    assert list(kept) == [True, False]


def test_surface_beyond_the_end_of_a_scan_has_no_partner(model):
    """However much that is, and though nobody says that the scan ends."""
    state = model.rest()
    V = model.pose(state)[0].vertices
    X, _, _ = sample_surface(V, model.rig.faces, 4000, np.random.default_rng(0))
    for kept in (0.8, 0.4):
        end = np.quantile(X[:, 1], kept)
        above = V[:, 1] - end
        weights = shown_problem(model, Problem(X[X[:, 1] < end]), state, WHOLE).v_weights
        assert (weights[above < 0.07] == 1).all() and (weights[above > 0.2] == 0).all()


def test_a_view_that_shows_next_to_nothing_hides_nothing(tube_rig):
    """From below, along the arm: of surface as little as its end there is too much without a partner."""
    tube = Model(tube_rig)
    V = tube.pose(tube.rest())[0].vertices
    end = Problem(V[V[:, 1] < V[:, 1].min() + 0.02])
    assert shown_problem(tube, end, tube.rest(), Coverage(one_sided=True)) is end
    above = Problem(V[V[:, 2] > np.median(V[:, 2])])
    shown = shown_problem(tube, above, tube.rest(), Coverage(one_sided=True)).v_weights
    assert 0.2 < shown.mean() < 0.5
    # It is surface that counts, however many vertices it has.
    tube.__dict__["areas"] = np.where(shown > 0, 0.1 / np.sum(shown > 0), 0.9 / np.sum(shown == 0))
    assert shown_problem(tube, above, tube.rest(), Coverage(one_sided=True)) is above
    few = V[:, 1] < V[:, 1].min() + 0.02
    tube.__dict__["areas"] = np.where(few, 0.9 / few.sum(), 0.1 / (~few).sum())
    assert shown_problem(tube, end, tube.rest(), Coverage(one_sided=True)).v_weights.mean() < 0.2


def test_a_rival_and_limits_count(model, right):
    state, X, _ = right
    evidence, _ = _evidence(model, state, X, rivals=(4.0, 2.0), value=1.0)
    assert evidence["rival"] == 0.5
    assert _evidence(model, state, X, rivals=(0.5,), value=1.0)[0]["rival"] == 1.0
    at_limits = state.replace(theta=model.rig.upper.copy())
    assert _evidence(model, at_limits, X)[0]["at_limits"] == 1.0
    # The root's turn is no bend of a joint: it may be at its limits, or beyond.
    inside = 0.5 * (model.rig.lower + model.rig.upper)
    inside[model.rig.root] = model.rig.upper[model.rig.root]
    assert (model.rig.upper > model.rig.lower)[model.rig.root].all()
    assert _evidence(model, state.replace(theta=inside), X)[0]["at_limits"] == 0.0


def test_few_points_for_the_angles_count(model, right):
    state, X, _ = right
    angles = int(((model.rig.upper > model.rig.lower) & model.rig.moving[:, None]).sum()) - 3  # without the root's
    assert angles == 21
    assert _evidence(model, state, X[:100])[0]["sparse"] == pytest.approx(angles / 100)
    half = np.r_[np.ones(50), np.zeros(50)]
    assert _evidence(model, state, X[:100], x_weights=half)[0]["sparse"] == pytest.approx(angles / 50)
    assert _evidence(model, state, X[:10])[0]["sparse"] == 1.0


def test_points_at_one_place_are_one(model, right):
    state, X, _ = right
    rng = np.random.default_rng(0)
    rows, proba = rng.choice(len(X), 60, replace=False), rng.dirichlet(np.ones(len(model.source.parts)), 60)
    once, _ = _evidence(model, state, X[rows], proba=proba)
    often, _ = _evidence(model, state, np.repeat(X[rows], 40, axis=0), proba=np.repeat(proba, 40, axis=0))
    assert often == pytest.approx(once)
    twice = np.concatenate([rows, rows[:30]])  # which these count for
    weights = np.where(np.isin(rows, rows[:30]), 2.0, 1.0)
    weighted, _ = _evidence(model, state, X[rows], proba=proba, x_weights=weights)
    assert _evidence(model, state, X[twice], proba=np.vstack([proba, proba[:30]]))[0] == pytest.approx(weighted)


def test_a_handful_of_points_is_never_enough(model, right):
    """They lie on the mesh of many a pose."""
    state, X, _ = right
    evidence, _ = _evidence(model, state, X[:20])
    assert evidence["sparse"] == 1.0
    perfect = dict.fromkeys(evidence, 0.0)
    assert probability_of(perfect) > 0.9 and probability_of(perfect | {"sparse": 0.51}) == 0.25
    assert probability_of(perfect | {"sparse": 0.49}) > 0.5


def test_clutter_is_not_among_the_points_there_are(model, right):
    """What stands for nothing does not tell the angles."""
    state, X, _ = right
    far = 9.0 * np.random.default_rng(0).standard_normal((20, 3))
    assert _evidence(model, state, np.vstack([X[:100], far]))[0]["sparse"] == pytest.approx(21 / 100)
    # Nor is clutter close to the mesh, which other points are near.
    near = X[:2000:40] + [0.0, 0.0, 0.3]
    assert _evidence(model, state, np.vstack([X[:2000], near]))[0]["sparse"] == pytest.approx(21 / 2000, rel=0.005)


@pytest.mark.parametrize("room, at_limits", [(0.0, 1.0), (0.008, 1.0), (0.012, 0.0), (0.05, 0.0)])
@pytest.mark.parametrize("limit", ["lower", "upper"])
def test_an_angle_is_at_a_limit_within_half_a_degree(model, right, limit, room, at_limits):
    state, X, _ = right
    theta = model.rig.lower + room if limit == "lower" else model.rig.upper - room
    assert _evidence(model, state.replace(theta=theta), X)[0]["at_limits"] == at_limits


def test_angles_of_locked_joints_are_not_to_be_found():
    """They are at their limits, which are 0, all the time."""
    locked = np.array([False, False, True, False])
    rig = replace(build_rig(make_tube_data()), locked=locked)
    tube = Model(rig)
    assert not tube.rig.upper[2].any() and not tube.rig.lower[2].any() and not tube.rig.moving[2]
    X = tube.pose(tube.rest())[0].vertices[:60]
    theta = 0.5 * (tube.rig.lower + tube.rig.upper)
    theta[2] = tube.rig.upper[2]
    evidence, _ = _evidence(tube, tube.rest().replace(theta=theta), X)
    assert evidence["at_limits"] == 0.0 and evidence["sparse"] == pytest.approx(6 / 60)
    theta[3] = tube.rig.upper[3]
    assert _evidence(tube, tube.rest().replace(theta=theta), X)[0]["at_limits"] == 0.5


@pytest.mark.parametrize("beyond, without", [("long", "short"), ("short", "long")])
def test_the_part_that_is_not_explained_is_not_the_one_that_is_not_reached(tube_rig, beyond, without):
    """One finger's points are above its end, the other has none."""
    tube = Model(tube_rig)
    V = tube.pose(tube.rest())[0].vertices
    part = {name: k for k, name in enumerate(tube_rig.parts)}
    X = V[~np.isin(tube.labels, [part["long"], part["short"]])]
    own = V[tube.labels == part[beyond]]
    top = own[own[:, 1] > own[:, 1].max() - 0.1]
    evidence, worst = _evidence(tube, tube.rest(), np.vstack([X, own, top + [0.0, 0.15, 0.0], top + [0.0, 0.2, 0.0]]))
    assert worst == {"part_unexplained": part[beyond], "part_unreached": part[without]}
    assert evidence["part_unexplained"] > 0.15 and evidence["part_unreached"] > 0.4


def test_no_evidence_raises_the_probability():
    worst = probability_of(dict.fromkeys(EVIDENCE, 1.0))
    best = probability_of(NOTHING)
    assert worst < 0.05 and best > 0.9
    for name in EVIDENCE:
        values = [probability_of(NOTHING | {name: v}) for v in (0.0, 0.01, 0.1, 0.5, 1.0)]
        assert values == sorted(values, reverse=True)


@pytest.mark.parametrize(
    "evidence, low, high",
    [
        # As of right fits of the calibration …
        ((0.001, 0.01, 0.03, 0.1, 0.3, 0.1, 0.01), 0.85, 1.0),
        ((0.005, 0.02, 0.1, 0.3, 0.25, 0.2, 0.01), 0.2, 0.6),
        # … of wrong ones, a limb elsewhere, facing the wrong way …
        ((0.01, 0.03, 0.15, 0.3, 0.25, 0.2, 0.01), 0.05, 0.3),
        ((0.03, 0.05, 0.3, 0.3, 0.3, 0.2, 0.02), 0.0, 0.05),
        # … and of scans with two or three points for each angle, or hardly more points than angles.
        ((0.001, 0.05, 0.02, 0.3, 0.2, 0.0, 0.45), 0.4, 0.7),
        ((0.001, 0.05, 0.02, 0.3, 0.2, 0.0, 0.9), 0.2, 0.3),
    ],
)
def test_each_piece_of_evidence_has_its_own_weight(evidence, low, high):
    names = ("unexplained", "unreached", "part_unexplained", "part_unreached", "disagreement", "at_limits", "sparse")
    assert low < probability_of(NOTHING | dict(zip(names, evidence, strict=True))) < high


@pytest.mark.parametrize("p, status", [(0.51, "ok"), (0.49, "suspect"), (0.06, "suspect"), (0.04, "failed")])
def test_where_doubt_begins(p, status):
    assert verdict_of(NOTHING, p)[0] == status


def test_the_verdict_names_reasons():
    assert verdict_of(NOTHING, 0.95) == ("ok", "")
    much = {"unexplained": 0.21, "rival": 0.9, "part_unexplained": 0.6, "part_unreached": 0.7}
    status, reason = verdict_of(NOTHING | much, 0.3, PARTS)
    assert status == "suspect"
    assert "points are not explained (mean misfit 21%)" in reason and "another pose" in reason
    assert "part left_arm does not fit" in reason and "part right_arm has no points" in reason
    assert verdict_of(NOTHING | {"unexplained": 0.9}, 0.01)[0] == "failed"
    assert verdict_of(NOTHING, 0.3)[1] == "several small things together"
    reason = verdict_of(NOTHING | {"unreached": 0.5, "disagreement": 0.4}, 0.3)[1]
    assert reason == "surface is not reached by points (mean misfit 50%); labels and mesh disagree (40% on average)"
    some = {"unexplained": 0.02, "part_unexplained": 0.14, "disagreement": 0.3, "distance": 0.5}
    words = "several small things together, above all points near part left_arm that are not explained (mean misfit 14%) "
    words += "and points that are not explained (mean misfit 2%)"
    assert verdict_of(NOTHING | some, 0.3, PARTS)[1] == words
    tiny = {"unexplained": 0.004, "at_limits": 0.004}
    assert verdict_of(NOTHING | tiny, 0.3)[1] == "several small things together"
    assert "misfit 1%)" in verdict_of(NOTHING | {"unexplained": 0.0051}, 0.3)[1]
    for none in (0.005, 0.0049):  # percent of which none is left
        assert " 0%)" not in verdict_of(NOTHING | {"unexplained": none}, 0.3)[1]
    for name in REGRESSED[1:]:  # distances alone are noise
        assert "above all " in verdict_of(NOTHING | {name: 0.02}, 0.3, PARTS)[1]


def test_a_pose_by_which_the_scan_shows_next_to_nothing_is_not_believed(model, right):
    """Whatever lies on the few points that there would be: all else is hidden or cut off, and not compared with anything."""
    state, X, _ = right
    V, areas = model.pose(state)[0].vertices, model.areas
    for few in (0.5, 0.03):
        shown = X[X[:, 1] <= np.quantile(X[:, 1], few)]
        assert _evidence(model, state, shown)[0]["hidden"] == 0  # the scan is said to be of the whole
        evidence = _evidence(model, state, shown, coverage=Coverage(cropped=True))[0]
        assert evidence["hidden"] == pytest.approx(1 - areas[within_hull(V, hull_planes(shown))].sum() / areas.sum())
        assert (evidence["hidden"] > 0.9) == (few < 0.1)
    assert probability_of(NOTHING | {"hidden": 0.89}) == probability_of(NOTHING) > 0.9
    p = probability_of(NOTHING | {"hidden": 0.91})
    assert p == 0.25 and verdict_of(NOTHING | {"hidden": 0.912}, p) == (
        "suspect",
        "of this pose the scan would show next to nothing (91% of the surface hidden or cut off)",
    )


def test_regression_finds_what_tells_and_gives_nothing_a_good_word():
    rng = np.random.default_rng(0)
    evidence, right = [], []
    for _ in range(400):
        e = {name: float(10 ** rng.uniform(-3, 0)) for name in EVIDENCE}
        evidence.append(e)
        right.append(bool(np.log10(e["unexplained"]) + 0.3 * rng.standard_normal() < -1.2))
    intercept, weights = regression(evidence, right)
    found = dict(zip(EVIDENCE, weights))
    assert all(w <= 0 for w in weights) and found["unexplained"] < 5 * min(w for n, w in found.items() if n != "unexplained")
    p = 1 / (1 + np.exp(-(intercept + np.array([logarithms(e) for e in evidence]) @ weights)))
    assert p[np.array(right)].mean() > 0.85 and p.mean() == pytest.approx(np.mean(right), abs=0.02)
    with pytest.raises(InputError, match="right and wrong"):
        regression(evidence, [True] * 400)


def test_an_axis_without_room_is_at_no_limit():
    """Half a degree to either side is near both limits wherever the angle is."""
    data = make_tube_data()
    lower, upper = data.lower.copy(), data.upper.copy()
    lower[1:, 1:], upper[1:, 1:] = -0.008, 0.008
    narrow = Model(build_rig(replace(data, lower=lower, upper=upper)))
    state = narrow.rest().replace(theta=np.where(np.arange(4)[:, None] == 2, upper, np.zeros((4, 3))))
    (scan,) = lbs.synthesize(narrow.source, 1, random_state=1, n_points=200)
    assert _evidence(narrow, state, scan.points / narrow.half)[0]["at_limits"] == pytest.approx(1 / 3)
