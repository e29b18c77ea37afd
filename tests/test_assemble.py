"""From the normalised frame back to the scan's: what a result says, posed by the rig, is its mesh."""

import time
from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.fitting.assemble import assemble
from lbsfit_np.fitting.confidence import evidence_of
from lbsfit_np.fitting.labels import labels_from_mesh
from lbsfit_np.losses.chamfer import chamfer
from lbsfit_np.losses.objective import PRESETS, objective
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.lbfgs import Outcome
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import Coverage
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rotations import matrix_from_rotvec, rotvec_from_matrix
from lbsfit_np.starts.clean import TakingPart

pytestmark = pytest.mark.usefixtures("one_thread")

_HARDLY = "the scan hardly tells where these joints are (see joint_std): "
TURNS = {
    "none": np.eye(3),
    "about the up axis": matrix_from_rotvec(np.array([0.0, 2.4, 0.0])),
    "upside down": matrix_from_rotvec(np.array([np.pi, 0.0, 0.0])),
    "any": matrix_from_rotvec(np.array([1.1, -2.0, 0.6])),
}


@pytest.fixture(scope="module")
def rigs(tube_rig):
    """The tube; the same with each vertex of every third face a second time, as at seams; a hand."""
    data = make_tube_data()
    faces = data.faces.copy()
    split = np.unique(faces[::3])
    m = len(data.vertices)
    faces[::3] = m + np.searchsorted(split, faces[::3])
    twice = np.r_[np.arange(m), split]
    seams = replace(data, vertices=data.vertices[twice], faces=faces, weights=data.weights[twice])
    return {"tube": tube_rig, "tube with seams": build_rig(seams), "hand": lbs.load_rig("hand-coarse")}


def _assembled(rig, model, turn, *, changed, seed=0, sigma=0.025, **options):
    """(result, state, frame) of points on the mesh of a random state."""
    rng = np.random.default_rng(seed)
    theta = rig.lower + rng.random(rig.lower.shape) * (rig.upper - rig.lower)
    state = model.rest().replace(theta=theta, translation=rng.uniform(-1, 1, 3), scale=1.2)
    if changed:
        c = rng.uniform(-0.2, 0.2, model.n_coefficients)
        state = state.replace(coefficients=c, residual=0.02 * rng.standard_normal(model.rig.vertices.shape))
    frame = Frame(rng.uniform(-50, 50, 3), 13.0, turn)
    X = model.pose(state)[0].vertices
    problem = Problem(X)
    result = assemble(
        rig,
        model,
        problem,
        Outcome(state, 0.0, True, "", 1),
        points=frame.outside(X),
        part=_all_of(X),
        frame=frame,
        sigma=sigma,
        evaluations=1,
        notes=["a note", ""],
        started=time.perf_counter(),
        **({"weights": PRESETS["default"]} | options),
    )
    return result, state, frame


@pytest.mark.parametrize("changed", [False, True])
@pytest.mark.parametrize("joints", ["follow", "fixed"])
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("name", ["tube", "tube with seams", "hand"])
def test_the_rig_posed_as_the_result_says_is_the_mesh(rigs, name, turn, joints, changed):
    rig, turn = rigs[name], TURNS[turn]
    model = Model(rig, joints)
    r, state, frame = _assembled(rig, model, turn, changed=changed)
    posed = model.pose(state)[0]
    tolerance = 1e-9 * rig.size * r.scale
    np.testing.assert_allclose(r.vertices, frame.outside(posed.vertices)[rig.weld], atol=tolerance)
    np.testing.assert_allclose(r.joints, frame.outside(posed.joints), atol=tolerance)
    place = r.pose, r.translation, r.scale, r.offsets
    np.testing.assert_array_equal(rig.pose(*place, joints=r.rest_joints), r.vertices)
    np.testing.assert_array_equal(rig.pose_joints(*place, joints=r.rest_joints), r.joints)
    assert r.scale == pytest.approx(1.2 * 13.0 / (rig.size / 2))
    others = np.arange(len(rig.parents)) != rig.root
    np.testing.assert_array_equal(r.pose[others], state.theta[others])  # a turn is the root's alone
    assert r.message.endswith("a note")


def test_a_changed_template_is_what_labels_and_distances_are_measured_from(rigs):
    """The points are its vertices, so that none is away from it, and each has its own label."""
    r, _, _ = _assembled(rigs["tube"], Model(rigs["tube"]), TURNS["any"], changed=True)
    assert r.terms["recon"] < 1e-9 and r.evidence["distance"] < 1e-6
    assert (r.labels == rigs["tube"].vertex_labels).mean() > 0.97


def test_a_fit_is_judged_by_another_state_than_comes_out(rigs):
    """Brought onto the scan, the skin of a wrong pose comes near the points, too."""
    rig = rigs["tube"]
    model = Model(rig)
    state, X = model.rest(), 0.9 * model.deformed(model.rest()).vertices
    skin = 0.1 * np.random.default_rng(0).standard_normal(X.shape)
    frame, weights = Frame(np.zeros(3), rig.size / 2, np.eye(3)), PRESETS["default"]
    judged, theta = state.replace(residual=0.01 * skin), state.theta.copy()
    theta[1] = rig.upper[1]  # of other angles at limits
    moved = judged.replace(displacement=skin, theta=theta)
    results = [
        assemble(
            rig,
            model,
            Problem(X),
            Outcome(s, 0.0, True, "", 1),
            points=frame.outside(X),
            part=_all_of(X),
            frame=frame,
            sigma=0.025,
            weights=weights,
            evaluations=1,
            started=time.perf_counter(),
            judged_by=by,
        )
        for s, by in ((judged, None), (moved, judged), (judged.replace(displacement=skin), judged))
    ]
    bare, otherwise, brought = results
    assert bare.evidence == otherwise.evidence and bare.probability == otherwise.probability
    np.testing.assert_array_equal(otherwise.pose, theta)
    assert bare.evidence == brought.evidence and bare.probability == brought.probability
    assert bare.terms["recon"] != brought.terms["recon"]
    np.testing.assert_array_equal(bare.rest_joints, brought.rest_joints)  # which no displacement moves
    np.testing.assert_allclose(brought.vertices, frame.outside(model.rig.vertices + skin)[rig.weld], atol=1e-9 * rig.size)
    place = brought.pose, brought.translation, brought.scale, brought.offsets
    np.testing.assert_array_equal(rig.pose(*place, joints=brought.rest_joints), brought.vertices)


@pytest.mark.parametrize("turn", TURNS)
def test_templates_of_subjects_turn_about_their_own_root(rigs, turn):
    rig = rigs["hand"]
    subject = rig.subject(3, amount=1.5)
    model = Model(subject, half=rig.size / 2)
    r, state, frame = _assembled(rig, model, TURNS[turn], changed=False)
    np.testing.assert_allclose(r.vertices, frame.outside(model.pose(state)[0].vertices), atol=1e-9 * rig.size * r.scale)
    np.testing.assert_allclose(r.offsets, subject.vertices - rig.vertices, atol=1e-12)
    np.testing.assert_allclose(r.rest_joints, subject.joints, atol=1e-12)


def test_known_labels_are_returned_and_others_are_the_meshs(rigs):
    rig = rigs["tube"]
    model = Model(rig)
    known = np.arange(len(rig.vertices)) % 4
    r, _, _ = _assembled(rig, model, TURNS["any"], changed=False, labels=known)
    np.testing.assert_array_equal(r.labels, known)
    assert (r.confidence == 1).all() and r.labels is not known
    found, _, _ = _assembled(rig, model, TURNS["any"], changed=False)
    assert (found.labels == rig.vertex_labels).mean() > 0.97  # the points are the vertices


def test_labels_reach_as_far_in_every_unit(rigs):
    """σ is in the normalised frame: so are the distances of the vertices that vote."""
    rig = rigs["tube"]
    model = Model(rig)
    r, state, _ = _assembled(rig, model, TURNS["any"], changed=False, sigma=0.1)
    V = model.pose(state)[0].vertices
    labels, confidence = labels_from_mesh(V, V, model.labels, len(rig.parts), 0.1)
    np.testing.assert_allclose(r.confidence, confidence, atol=1e-9)
    assert confidence.min() < 0.9 and (r.labels == labels).mean() > 0.99  # but for ties


def test_the_segmenters_word_counts_for_labels_and_as_evidence(rigs):
    rig = rigs["tube"]
    model = Model(rig)
    proba = np.eye(4)[(rig.vertex_labels + 1) % 4]  # sure, and wrong everywhere
    told, _, _ = _assembled(rig, model, TURNS["any"], changed=False, sigma=0.1, proba=proba)
    alone, _, _ = _assembled(rig, model, TURNS["any"], changed=False, sigma=0.1)
    assert told.evidence["disagreement"] == 1.0 and alone.evidence["disagreement"] == 0.0
    at_borders = (told.labels != alone.labels).mean()
    assert 0.02 < at_borders < 0.5  # elsewhere no vertex has what it says


@pytest.mark.parametrize("partial", [False, True])
def test_of_one_side_it_is_said_how_to_tell_the_fit(rigs, partial):
    """Half of the points, from one side, and a pose that is wrong, or right."""
    rig = rigs["hand"]
    model = Model(rig)
    state = model.rest()
    V = model.pose(state)[0].vertices
    X = V[V[:, 2] > np.median(V[:, 2])] + [0.0, 0.15, 0.0]
    problem, frame = Problem(X), Frame(np.zeros(3), 1.0, np.eye(3))
    more = {"sigma": 0.025, "evaluations": 1, "notes": (), "started": 0.0, "part": _all_of(X), "points": X}
    weights, outcome = PRESETS["default"], Outcome(state, 0.0, True, "", 1)
    r = assemble(rig, model, problem, outcome, frame=frame, weights=weights, coverage=Coverage(partial), **more)
    assert r.status != "ok" and ("one side only" in r.message) != partial
    assert ("if it ends before the body does, cropped (--cropped)" in r.message) != partial
    outcome = Outcome(state.replace(translation=np.array([0.0, 0.15, 0.0])), 0.0, True, "", 1)
    r = assemble(rig, model, problem, outcome, frame=frame, weights=weights, coverage=Coverage(partial), **more)
    assert r.status == "ok" and r.message.startswith("much of the surface has no points near it: if the scan") != partial
    if not partial:
        more |= {"points": V, "part": _all_of(V)}
        assert assemble(rig, model, Problem(V), replace(outcome, state=state), frame=frame, weights=weights, **more).message == ""


def _all_of(points):
    return TakingPart.only(np.arange(len(points)), len(points))


def _at_rest(model, X, *, state=None, x_weights=None, proba=None, **options):
    """The result of points in the normalised frame, which is the scan's."""
    state, problem = state or model.rest(), Problem(X, x_weights)
    given = {"sigma": 0.025, "evaluations": 1, "notes": (), "started": 0.0, "part": _all_of(X), "points": X}
    given |= {"frame": Frame(np.zeros(3), 1.0), "weights": PRESETS["default"]}
    return assemble(model.source, model, problem, Outcome(state, 0.0, True, "", 1), proba=proba, **(given | options))


@pytest.mark.parametrize("labels", [False, True])
def test_labels_of_what_lies_beyond_the_rig_have_no_confidence(rigs, labels):
    model = Model(rigs["tube"])
    X = model.rig.vertices
    among = np.arange(len(X)) % 3 > 0
    known = {"labels": np.zeros(len(X), dtype=int)} if labels else {}
    whole, r = _at_rest(model, X, **known), _at_rest(model, X, part=replace(_all_of(X), among=among), **known)
    assert (whole.confidence > 0).all() and not r.confidence[~among].any()
    np.testing.assert_array_equal(r.confidence[among], whole.confidence[among])
    np.testing.assert_array_equal(r.labels, whole.labels)


@pytest.mark.parametrize("without", ["proba", "rivals", "value", "theta", "coverage", "x_weights"])
def test_the_evidence_is_of_all_that_is_known(rigs, without):
    """Points of one side, half of which weigh little, on a hand with its angles at their limits."""
    model = Model(rigs["hand"])
    state = model.rest().replace(theta=model.rig.upper.copy())
    V = model.pose(state)[0].vertices
    side = V[:, 2] > np.median(V[:, 2])
    X = V[side] + [0.05, 0.05, 0.0]
    weights = np.where(X[:, 1] > np.median(X[:, 1]), 1.0, 0.1)
    known = {"proba": np.eye(len(model.source.parts))[(model.labels[side] + (X[:, 1] > 0)) % 2], "rivals": (2.0,), "value": 1.0}
    given = {**known, "coverage": Coverage(one_sided=True), "x_weights": weights / weights.sum()}
    r = _at_rest(model, X, state=state, **given)
    given["theta"] = state.theta
    assert r.evidence == evidence_of(model, V, X, **given)[0]
    del given[without]
    assert r.evidence != evidence_of(model, V, X, **given)[0]  # so that each of them is told


def test_a_wrong_pose_of_a_whole_scan_is_not_taken_for_one_side(rigs):
    model = Model(rigs["hand"])
    (scan,) = lbs.synthesize(model.source, 1, poses="natural", random_state=4, shape=0.0)
    theta = scan.pose.copy()
    theta[model.source.joint_names.index("index1"), 0] -= 0.9
    r = _at_rest(model, scan.points / model.half, state=model.rest().replace(theta=theta))
    assert r.status != "ok" and "part index3 has no points" in r.message and "partial" not in r.message
    assert "cropped" not in r.message


@pytest.mark.parametrize("coverage", [Coverage(), Coverage(one_sided=True), Coverage(cropped=True)], ids=str)
@pytest.mark.parametrize("status", ["ok", "suspect", "failed"])
def test_a_part_without_points_may_be_cut_off(rigs, status, coverage, monkeypatch):
    """Where some joints are guesses, and little of the surface is far from all points."""
    measured = {"distance": 0.1, "unreached": 0.05, "part_unexplained": 0.1, "part_unreached": 0.6, "at_limits": 0.0}
    monkeypatch.setattr("lbsfit_np.fitting.assemble.evidence_of", lambda *a, **k: (measured, {}))
    monkeypatch.setattr("lbsfit_np.fitting.assemble.probability_of", lambda *a: 0.3)
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *a: (status, "" if status == "ok" else "odd"))
    model = Model(rigs["tube"])
    V = model.pose(model.rest())[0].vertices
    said = {}
    for unsure in (False, True):
        std = np.full(len(model.rig.parents), 0.2 if unsure else 0.001)
        said[unsure] = "--cropped" in _at_rest(model, V, coverage=coverage, joint_std=std).message
    assert said == {False: False, True: status != "ok" and not coverage.cropped}


@pytest.mark.parametrize("status", ["ok", "suspect", "failed"])
def test_another_rig_or_up_axis_is_a_matter_of_failed_fits(rigs, status, monkeypatch):
    model, reason = Model(rigs["tube"]), {"ok": ""}.get(status, "a reason")
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: (status, reason))
    r = _at_rest(model, model.pose(model.rest())[0].vertices)
    assert r.status == status and r.message.startswith(reason)
    assert ("right rig" in r.message) == ("--up" in r.message) == (status == "failed")
    if status != "failed":
        assert r.message == reason


@pytest.mark.parametrize(
    ("given", "asks"),
    [
        ((), ", and does the scan stand as orientation and up say (--orientation, --up)?"),
        (("theta0",), ", and is theta0 right?"),
        (("labels",), ", are labels right, and does the scan stand as orientation and up say (--orientation, --up)?"),
        (("theta0", "labels"), ", and are theta0 and labels right?"),
    ],
)
def test_a_fit_that_has_failed_asks_about_what_was_given(given, asks, rigs, monkeypatch):
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("failed", "a reason"))
    model = Model(rigs["tube"])
    r = _at_rest(model, model.pose(model.rest())[0].vertices, given=given)
    assert r.message.startswith(f"a reason; is it the right rig{asks}")


@pytest.mark.parametrize("limit", [True, False])
def test_a_fit_that_has_failed_at_its_limits_asks_about_these(limit, rigs, monkeypatch):
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("failed", "a reason"))
    model = Model(rigs["hand"])
    state = model.rest().replace(theta=model.rig.upper.copy() if limit else (model.rig.lower + model.rig.upper) / 2)
    r = _at_rest(model, model.pose(state)[0].vertices, state=state)
    assert ("is it the right rig, do its limits let joints turn as they do in the scan" in r.message) == limit


@pytest.mark.parametrize("std, said", [(0.2, False), (0.01, True)])
def test_nothing_looks_further_where_a_scan_lacks_most_of_the_body(std, said, rigs, monkeypatch):
    """Of the palm alone: no more starts would find the fingers. Joints without skin are none that it could tell."""
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("suspect", "odd"))
    rig = rigs["hand"]
    model, J = Model(rig), len(rig.parents)
    palm = model.pose(model.rest())[0].vertices[model.labels == 0]
    joint_std = np.where(np.arange(J) < J // 2, std, 0.0)
    r = _at_rest(model, palm, joint_std=joint_std, further=("effort looks further",))
    assert r.evidence["part_unreached"] > 0.9 and ("effort looks further" in r.message) == said


@pytest.mark.parametrize("std, guess", [(0.019, False), (0.021, True)])
def test_guesses_are_in_shares_of_the_size_that_comes_out(rigs, std, guess, monkeypatch):
    """Not of the one that the fit is judged by."""
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("ok", ""))
    model = Model(rigs["hand"])
    state = model.rest().replace(scale=1.25)
    V = model.pose(state)[0].vertices
    joint_std = np.where(np.arange(16) == 7, 2.5 * std, 0.0)  # in half sizes of the rig
    r = _at_rest(model, V, state=state, joint_std=joint_std, judged_by=state.replace(scale=1.0))
    assert (_HARDLY.strip() in r.message) == guess == (r.joint_std[7] > 0.02 * rigs["hand"].size * r.scale)


def test_joints_that_are_guesses_are_named_the_worst_first(rigs, monkeypatch):
    """In the scan's unit; those that do not turn are none; at most six."""
    rig = rigs["hand"]
    model, J = Model(rig), len(rig.parents)
    V, std = model.pose(model.rest())[0].vertices, np.full(J, 0.039)
    frame = Frame(np.zeros(3), 5.0)
    r = _at_rest(model, V, joint_std=std, frame=frame, points=5 * V)
    np.testing.assert_allclose(r.joint_std, 5 * std)
    assert "joint_std" not in r.message  # 2 % of the size are 0.04 half sizes
    std[[3, 5]] = 0.041, 0.2
    named = f"{_HARDLY}{rig.joint_names[5]}, {rig.joint_names[3]}"
    r = _at_rest(model, V, joint_std=std, frame=frame, points=5 * V)
    assert r.message == named
    r = _at_rest(model, V, joint_std=np.linspace(0.1, 0.2, J))
    assert r.message.endswith(f"{', '.join(rig.joint_names[: J - 7 : -1])} and {J - 6} more")
    r = _at_rest(model, V, joint_std=np.where(np.arange(J) < J - 6, 0.0, 0.1))
    assert r.message.endswith(f": {', '.join(rig.joint_names[J - 6 :])}")
    assert np.isnan(_at_rest(model, V).joint_std).all()
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("failed", "a reason"))
    assert "joint_std" not in _at_rest(model, V, joint_std=std).message  # of a pose that is wrong all are


def test_a_fit_that_has_failed_asks_about_other_things(rigs, monkeypatch):
    """Where many points beside a part are not explained."""
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *evidence: ("failed", "a reason"))
    model = Model(rigs["tube"])
    V = model.pose(model.rest())[0].vertices
    beside = V[:60] + [1.0, 0.0, 0.0]
    for points, asks in ((V, False), (np.vstack([V, beside]), True)):
        assert ("does the scan show only the body" in _at_rest(model, points).message) == asks


@pytest.mark.parametrize("status", ["ok", "suspect", "failed"])
@pytest.mark.parametrize("further", [("effort looks further",), ()])
def test_what_a_failed_fit_found_is_said_with_reserve_and_what_would_look_further(rigs, status, further, monkeypatch):
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *known: (status, "" if status == "ok" else "odd"))
    model, found = Model(rigs["tube"]), ("in inches", "", "along +z")
    r, *_ = _assembled(rigs["tube"], model, TURNS["none"], changed=False, found=found, further=further)
    reserve = "if the fit is right nevertheless: " if status == "failed" else ""
    both = "in inches, and along +z" if reserve else "in inches; along +z"  # reasons are parted at "; "
    assert r.message.endswith(f"a note; {reserve}{both}")
    assert ("; effort looks further" in r.message) == (status != "ok" and bool(further))
    r, *_ = _assembled(rigs["tube"], model, TURNS["none"], changed=False, found=("", ""))
    assert "if the fit is right" not in r.message


@pytest.mark.parametrize("weights", ["paper", "default"])
@pytest.mark.parametrize("name", ["tube", "tube with seams", "hand"])
def test_terms_are_those_of_what_comes_out(name, weights, rigs):
    """Whoever has the points and the result finds them again, in half sizes of the posed rig, whatever the frame was."""
    rig, weights = rigs[name], PRESETS[weights]
    model = Model(rig)
    x_labels = np.arange(len(model.labels)) % len(rig.parts)
    r, _, _ = _assembled(rig, model, TURNS["any"], changed=True, seed=3, weights=weights, x_labels=x_labels)
    unit, first = r.scale * rig.size / 2, np.unique(rig.weld, return_index=True)[1]
    points = r.vertices[first] / unit  # those of the scan lie on the mesh
    V = rig.pose(r.pose, r.translation, r.scale)[first] / unit
    U_d, K = (rig.vertices + r.offsets)[first] / (rig.size / 2), model.K
    offsets = U_d - model.rig.vertices
    own = objective(points, points, V, weights=weights, x_labels=x_labels, v_labels=model.labels, offsets=offsets, K=K)
    assert r.terms == pytest.approx(own.terms | {"total": own.value, "recon": np.sqrt(chamfer(points, points)[0])}, rel=1e-9)
    assert own.terms["chamfer"] > 1e-4 and own.terms["structured"] > 1e-4


@pytest.mark.parametrize("judged, wild", [(True, np.nan), (False, np.nan), (True, 1e200)])
def test_a_fit_that_is_not_finite_has_failed_and_found_nothing(rigs, judged, wild):
    model, further = Model(rigs["tube"]), ("effort looks further",)
    X = model.pose(model.rest())[0].vertices
    wild = model.rest().replace(translation=np.array([0.0, wild, 0.0]))
    r = _at_rest(model, X, state=wild, notes=["a note", ""], found=("in inches", ""), further=further, judged=judged)
    assert (r.status, r.probability, r.evidence) == ("failed", 0.0, {})
    assert r.message == "the fit is not finite; check the scan for extreme outliers; a note"
    assert not np.isfinite(r.vertices).any() and not np.isfinite(r.terms["total"])
    assert not r.confidence.any() and not r.labels.any()
    known = np.arange(len(X)) % 3 - 1  # some are not
    r = _at_rest(model, X, state=wild, labels=known, judged=judged)
    np.testing.assert_array_equal(r.labels, np.maximum(known, 0))
    np.testing.assert_array_equal(r.confidence, known >= 0)


def test_a_turn_that_was_found_is_in_the_root_alone(rigs):
    """Of the rest pose: the pose's root is the turn, and all else is nothing."""
    rig, turn = rigs["hand"], TURNS["any"]
    model = Model(rig)
    state = model.rest()
    X = model.pose(state)[0].vertices
    problem, frame = Problem(X), Frame(np.zeros(3), 1.0, turn)
    more = {"sigma": 0.025, "evaluations": 1, "notes": (), "started": 0.0, "part": _all_of(X), "points": frame.outside(X)}
    weights = PRESETS["default"]
    r = assemble(rig, model, problem, Outcome(state, 0.0, True, "", 1), frame=frame, weights=weights, **more)
    F = rig.frames[rig.root]
    np.testing.assert_allclose(r.pose[rig.root], rotvec_from_matrix(F.T @ turn @ F), atol=1e-12)
    np.testing.assert_array_equal(np.delete(r.pose, rig.root, axis=0), np.delete(state.theta, rig.root, axis=0))
