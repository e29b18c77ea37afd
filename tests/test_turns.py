"""Which way a scan may face: the turns that starts are tried under cover all that the orientation allows."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit, further_words
from lbsfit_np.fitting.scout import Found
from lbsfit_np.learning.new_scan import scan_fit
from lbsfit_np.learning.parameters import learned_with
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.rig.frames import AXES
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.turns import ORIENTATIONS, any_side_up, facing_of, some_turns, stands_note


def _between(A, B):
    """Angles between rotations, radians."""
    trace = np.einsum("...ab,...ab->...", A, B)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _random_rotations(n, seed=0):
    from scipy.spatial.transform import Rotation

    return Rotation.random(n, random_state=seed).as_matrix()


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_turns_are_rotations_that_begin_with_none(tube_rig, orientation):
    turns = facing_of(tube_rig, orientation).turns
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(turns), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0, atol=1e-12)
    np.testing.assert_allclose(turns[0], np.eye(3), atol=1e-15)
    assert len(np.unique(turns.round(9), axis=0)) == len(turns)
    np.testing.assert_array_equal(turns, facing_of(tube_rig, orientation).turns)


def test_aligned_is_no_turn(tube_rig):
    np.testing.assert_array_equal(facing_of(tube_rig, "aligned").turns, np.eye(3)[None])


@pytest.mark.parametrize("up, axis", [("+y", [0, 1, 0]), ("+z", [0, 0, 1]), ("-x", [-1, 0, 0]), (None, [0, 1, 0])])
def test_upright_turns_stand_on_the_rigs_up_axis(tube_rig, up, axis):
    turns = facing_of(replace(tube_rig, up=up, forward=None), "upright").turns
    np.testing.assert_allclose(turns @ np.array(axis, dtype=float), np.tile(axis, (24, 1)), atol=1e-12)
    angles = np.linspace(0, 2 * np.pi, 500)
    every = matrix_from_rotvec(angles[:, None] * np.array(axis, dtype=float))
    assert _between(every[:, None], turns[None]).min(axis=1).max() <= np.radians(7.51)


def test_who_faces_a_camera_is_aligned():
    """One whose y points down and z away from it: up is −y, and the front, +z of the rig, looks back along its z."""
    rig = lbs.load_rig("body-coarse")
    turn = facing_of(rig, "aligned", "-y").turns[0]
    np.testing.assert_allclose(turn, np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(facing_of(replace(rig, up="+x"), "aligned", "-x").turns[0], np.diag([-1.0, 1.0, -1.0]), atol=1e-12)


@pytest.mark.parametrize("orientation", ["aligned", "upright"])
@pytest.mark.parametrize("up", AXES)
def test_turns_lead_to_the_scans_up_axis(tube_rig, orientation, up):
    rig, axis = replace(tube_rig, up="+z", forward=None), np.array(AXES[up])
    facing, own = facing_of(rig, orientation, up), facing_of(rig, orientation)
    np.testing.assert_array_equal(facing.up, axis)
    assert own.open_up == (orientation == "upright") and not facing.open_up
    np.testing.assert_allclose(facing.turns @ [0.0, 0.0, 1.0], np.tile(axis, (len(own.turns), 1)), atol=1e-12)
    shortest = 0.0 if up == "+z" else np.pi if up == "-z" else np.pi / 2
    assert _between(facing.turns[0], np.eye(3)) == pytest.approx(shortest, abs=1e-6)
    if orientation == "upright":
        between = _between(facing.turns[:, None], facing.turns[None])
        np.testing.assert_allclose(between, _between(own.turns[:, None], own.turns[None]), atol=1e-6)


def test_where_any_rotation_may_be_no_axis_is_up(tube_rig):
    facing = facing_of(tube_rig, "any")
    assert facing.up is None and not facing.open_up


def test_any_rotation_has_a_turn_near_it(tube_rig):
    turns = facing_of(tube_rig, "any").turns
    nearest = _between(_random_rotations(800)[:, None], turns[None]).min(axis=1)
    assert nearest.max() < np.radians(32) and nearest.mean() < np.radians(19)


def test_turns_are_spread_evenly(tube_rig):
    turns = facing_of(tube_rig, "any").turns[1:]
    apart = _between(turns[:, None], turns[None]) + 9 * np.eye(len(turns))
    assert apart.min() > np.radians(12)
    nearest = _between(_random_rotations(20_000)[:, None], turns[None]).argmin(axis=1)
    share = np.bincount(nearest, minlength=len(turns)) / 20_000 * len(turns)
    assert 0.3 < share.min() and share.max() < 2.0  # of rotations for which a turn is the nearest


@pytest.mark.parametrize("orientation, n", [("aligned", 1), ("upright", 6), ("any", 6)])
def test_some_turns_are_even_ones_of_all(tube_rig, orientation, n):
    turns = facing_of(tube_rig, orientation).turns
    some = some_turns(turns)
    assert len(some) == n
    np.testing.assert_array_equal(some[0], turns[0])
    if orientation == "upright":
        np.testing.assert_allclose(_between(some[:-1], some[1:]), np.radians(60), atol=1e-9)


def test_the_bundled_rigs_stand_on_y():
    for name in ("hand-coarse", "body-coarse"):
        turns = facing_of(lbs.load_rig(name), "upright").turns
        np.testing.assert_allclose(turns[:, 1], np.tile([0.0, 1.0, 0.0], (24, 1)), atol=1e-12)


def test_any_side_may_be_up():
    up = np.array([0.0, 1.0, 0.0])
    turns = facing_of(lbs.load_rig("hand-coarse"), "upright").turns
    wide = any_side_up(turns, up)
    assert len(wide) == 6 * len(turns)
    np.testing.assert_array_equal(wide[: len(turns)], turns)
    np.testing.assert_allclose(np.linalg.det(wide), 1.0)
    np.testing.assert_allclose(wide @ wide.transpose(0, 2, 1), np.broadcast_to(np.eye(3), wide.shape), atol=1e-12)
    sides = np.round(wide @ up, 6).reshape(6, len(turns), 3)
    assert (sides == sides[:, :1]).all() and len({tuple(s) for s in sides[:, 0] + 0.0}) == 6


@pytest.mark.parametrize(
    "side, words",
    [([0, 1, 0], ""), ([0, 0, 1], "along its +z axis"), ([0, -1, 0], "along its -y axis"), ([-1, 0, 0], "along its -x axis")],
)
def test_a_scan_that_stands_otherwise_is_told(side, words):
    up = np.array([0.0, 1.0, 0.0])
    turn = next(t for t in any_side_up(np.eye(3)[None], up) if np.allclose(t @ up, side))
    note = stands_note(turn, up)
    assert words in note and bool(words) == bool(note)


def test_the_option_that_spares_the_search_is_the_one_that_was_found():
    note = stands_note(matrix_from_rotvec(np.array([-np.pi / 2, 0.0, 0.0])), np.array([0.0, 1.0, 0.0]))
    assert "along its -z axis" in note and "(if this is right, say so: up='-z', --up=-z)" in note


@pytest.mark.parametrize("axis", [[1, 0, 1], [1, 0, -1], [-1, 0, 1]])
@pytest.mark.parametrize("degrees, leans", [(0, True), (40, True), (50, True), (60, False), (130, False)])
def test_a_scan_that_leans_stands_as_the_rig_does(axis, degrees, leans):
    """Between two of the other axes, the rig's is the nearest up to 54.7°; towards one of them up to 45°."""
    about = np.radians(degrees) * np.array(axis) / np.sqrt(2)
    assert (stands_note(matrix_from_rotvec(about), np.array([0.0, 1.0, 0.0])) == "") == leans
    towards_z = stands_note(matrix_from_rotvec(np.radians([degrees, 0.0, 0.0])), np.array([0.0, 1.0, 0.0]))
    assert towards_z == "" if degrees < 45 else "axis, which is not the rig's up axis" in towards_z


@pytest.mark.parametrize(
    "found, root, up, told",
    [
        (90, 0, None, True),
        (90, -20, None, True),
        (60, -30, None, False),  # 30° in all: found under another axis, it but leans
        (30, 30, None, False),
        (0, 0, None, False),
        (90, 0, "+y", True),  # against what was said
        (90, -25, "+y", True),
        (90, -35, "+y", False),  # along no axis
        (90, -50, "+y", False),
        (90, 0, "+z", False),
        (0, 90, "+z", False),
    ],
)
def test_a_fit_tells_which_way_the_scan_stands(tube_rig, found, root, up, told):
    """Of a scan on its mesh: turned from y towards z by what was found, and by what the pose's root adds."""
    model, turn = Model(tube_rig), matrix_from_rotvec(np.radians([found, 0.0, 0.0]))
    theta = np.zeros((4, 3))
    theta[0, 0] = np.radians(root)
    state, frame = model.rest().replace(theta=theta), Frame(np.array([1.0, 2.0, 3.0]), model.half, turn)
    X = model.pose(state)[0].vertices
    seen = Found(frame, Problem(X), state, None, 0.0, ())
    fit = ScanFit(model, FitSettings(effort="fast", polish=0, full_iterations=3), facing=facing_of(tube_rig, "upright", up))
    points = frame.outside(X)
    r = fit.fit(points, part=fit.taking_part(points), found=seen)
    assert r.status == "ok"
    assert ("the scan stands along its +z axis" in r.message) == ("stands" in r.message) == told
    assert ("though up says '+y'" in r.message) == (told and up is not None) == ("say so: up=" not in r.message and told)


FASTER = "effort 'balanced' (--effort balanced) looks further, also for what goes on beyond the rig"
SIDES = FASTER.replace("also", "also along other up axes and")
AXES_TOO = "without up (--up), other axes are tried, too"


@pytest.mark.parametrize(
    "effort, orientation, up, words",
    [
        ("fast", "upright", None, (SIDES,)),
        ("fast", "aligned", None, (FASTER,)),
        ("fast", "upright", "+z", (FASTER, f"with that and {AXES_TOO}")),
        ("balanced", "upright", "+z", (AXES_TOO,)),
        ("thorough", "upright", "+y", (AXES_TOO,)),
        ("balanced", "upright", None, ()),  # they are tried already
        ("balanced", "any", None, ()),
        ("balanced", "aligned", "+z", ()),  # none are
        ("thorough", "aligned", None, ()),
    ],
)
def test_what_would_look_further(tube_rig, effort, orientation, up, words):
    assert further_words(tube_rig, FitSettings(effort=effort), facing_of(tube_rig, orientation, up)) == words


def test_only_where_a_rig_ends_something_may_go_on_beyond_it():
    body = lbs.load_rig("body-coarse")
    for orientation, beginning in (("upright", ", also along other up axes"), ("aligned", "")):
        (words,) = further_words(body, FitSettings(effort="fast"), facing_of(body, orientation))
        assert words == FASTER.partition(",")[0] + beginning


@pytest.mark.parametrize("effort, up, words", [("fast", None, SIDES), ("balanced", "+y", AXES_TOO), ("balanced", None, "")])
@pytest.mark.parametrize("status", ["ok", "suspect"])
def test_a_fit_in_doubt_tells_what_would_look_further(tube_rig, effort, up, words, status, monkeypatch):
    monkeypatch.setattr("lbsfit_np.fitting.assemble.verdict_of", lambda *known: (status, "" if status == "ok" else "odd"))
    model = Model(tube_rig)
    frame, state = Frame(np.zeros(3), model.half), model.rest()
    X = model.pose(state)[0].vertices
    settings = FitSettings(effort=effort, polish=0, full_iterations=3)
    fit = ScanFit(model, settings, facing=facing_of(tube_rig, "upright", up))
    points = frame.outside(X)
    r = fit.fit(points, part=fit.taking_part(points), found=Found(frame, Problem(X), state, None, 0.0, ()))
    assert r.message.startswith("odd; " + words) == (status != "ok")
    assert ("looks further" in r.message or "are tried" in r.message) == (status != "ok" and bool(words))
    started = fit.fit(frame.outside(X), theta0=np.zeros((4, 3)))  # which is not searched for
    assert "looks further" not in started.message and "are tried" not in started.message


def _as_learned(fitter, template, monkeypatch):
    """The fitter, as if it had learned one person's template."""
    learned = {"template_": {"ann": template}, "unit_": {"ann": 1.0}, "history_": []}
    learned["_learned_with"] = learned_with(fitter)
    for name, value in {**learned, "segmenter_": None, "regressor_": SimpleNamespace(digest="")}.items():
        setattr(fitter, name, value)
    monkeypatch.setattr("lbsfit_np.learning.made_with.model_digest", lambda *given, **named: "")
    return fitter


@pytest.mark.parametrize("found, root, up, told", [(90, 0, None, True), (60, -30, None, False), (90, 0, "+y", True)])
def test_a_fit_on_a_learned_template_tells_it_as_well(tube_rig, fitter, found, root, up, told, monkeypatch):
    model, turn = Model(tube_rig), matrix_from_rotvec(np.radians([found, 0.0, 0.0]))
    theta = np.zeros((4, 3))
    theta[0, 0] = np.radians(root)
    state, frame = model.rest().replace(theta=theta), Frame(np.zeros(3), model.half, turn)
    X = model.pose(state)[0].vertices
    monkeypatch.setattr("lbsfit_np.learning.new_scan._scouted", lambda *_, once: Found(frame, Problem(X), state, None, 1.0, ()))
    r = _as_learned(fitter, tube_rig, monkeypatch).set_params(up=up).fit_scan(frame.outside(X), subject="ann")
    assert r.status == "ok" and ("the scan stands along its +z axis" in r.message) == told


@pytest.mark.parametrize("learned", [False, True])
def test_a_known_start_is_no_finding(tube_rig, fitter, learned, monkeypatch):
    """Who says how the scan is turned need not be told."""
    theta = np.zeros((4, 3))
    theta[0, 0] = np.pi / 2
    points = tube_rig.pose(theta)
    if learned:
        r = _as_learned(fitter, tube_rig, monkeypatch).fit_scan(points, subject="ann", theta0=theta)
    else:
        settings = FitSettings(effort="fast", polish=0, full_iterations=3)
        r = ScanFit(Model(tube_rig), settings, facing=facing_of(tube_rig, "upright")).fit(points, theta0=theta)
    assert r.status == "ok" and "stands" not in r.message


def test_an_axis_that_is_told_later_holds(tube_rig, fitter):
    """Of what was made ready for fits, nothing is left that another axis or orientation was asked of."""
    first = scan_fit(fitter)
    assert scan_fit(fitter) is first and first.facing.open_up
    second = scan_fit(fitter.set_params(up="+z"))
    np.testing.assert_array_equal(second.facing.up, [0, 0, 1])
    third = scan_fit(fitter.set_params(orientation="aligned"))
    np.testing.assert_array_equal(third.facing.up, [0, 0, 1])
    assert len(second.facing.turns) == 24 and len(third.facing.turns) == 1
    np.testing.assert_array_equal(scan_fit(fitter.set_params(up=None)).facing.up, [0, 1, 0])
