"""Limbs that a scan lacks are taken off: neither the rest makes up for them, nor they for the rest."""

from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting.confidence import evidence_of
from lbsfit_np.fitting.missing import MissingLimbs
from lbsfit_np.fitting.proportioned import Proportioned
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.fitting.template_fit import TemplateFit
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.state import SIZED, State
from lbsfit_np.rig.chains import subtrees, vertex_bones

_SETTINGS = FitSettings(effort="fast")


@pytest.fixture(scope="module")
def hand():
    """The hand, its model, and a scan of it in a natural pose with each point's bone."""
    rig = lbs.load_rig("hand")
    scan = lbs.synthesize(rig, 1, poses="natural", random_state=6, n_points=3000, noise=0.002, shape=0.0, holes=0, density=0)[0]
    of_point = rig.faces[scan.triangle, scan.barycentric.argmax(axis=1)]
    bone, below = vertex_bones(rig)[of_point], subtrees(rig.parents) > 0
    return SimpleNamespace(rig=rig, model=Model(rig), scan=scan, bone=bone, below=below)


def _limb(hand, *names):
    """(J,) bool: the joints that hang on some."""
    return hand.below[[hand.rig.joint_names.index(name) for name in names]].any(axis=0)


def _without(hand, *names):
    """The scan's points but for some limbs."""
    return hand.scan.points[~_limb(hand, *names)[hand.bone]]


def _problem(hand, points):
    return Problem((points - hand.scan.translation) / (hand.scan.scale * hand.model.half))


def _state(hand, pose):
    return State(pose, np.zeros(3), 1.0, np.zeros(hand.model.n_coefficients), None)


def _shown(hand, points, pose, **options):
    def steps(model):
        return Proportioned(model, _SETTINGS, SIZED)

    return MissingLimbs(hand.model).of(_problem(hand, points), _state(hand, pose), steps, **options)


def _hidden(hand, name, other):
    """The scan's pose, a finger of it turned into the next one as a fit that lacks its points would have it."""
    rows = [[hand.rig.joint_names.index(f"{finger}{k}") for k in (1, 2, 3)] for finger in (name, other)]
    pose = hand.scan.pose.copy()
    pose[rows[0]] = pose[rows[1]]
    return pose


def _names(hand, shown):
    return {hand.rig.joint_names[j] for j in shown.limbs}


@pytest.mark.parametrize(("name", "other"), [("index", "middle"), ("ring", "middle"), ("pinky", "ring")])
def test_a_finger_without_points_is_found_wherever_it_lies(hand, name, other):
    points = _without(hand, f"{name}1")
    for pose in (hand.scan.pose, _hidden(hand, name, other)):
        shown = _shown(hand, points, pose)
        assert _names(hand, shown) == {f"{name}1"}
        own = _limb(hand, f"{name}1")
        np.testing.assert_array_equal(shown.missing, own[vertex_bones(hand.rig)])
        np.testing.assert_array_equal(shown.joints, own)
        # The knuckle, which is shown, goes along with the finger, and tells how that is turned.
        first, *further = np.flatnonzero(own)
        np.testing.assert_allclose(shown.state.theta[first], hand.scan.pose[first], atol=0.15)
        np.testing.assert_allclose(shown.state.theta[further], hand.model.rest().theta[further], atol=0.05)
        assert f"nothing of what hangs on {name}1" in shown.note


def test_two_fingers_and_a_part_of_one_are_found(hand):
    shown = _shown(hand, _without(hand, "index1", "thumb2"), hand.scan.pose)
    assert _names(hand, shown) == {"index1", "thumb2"}
    assert "index1, thumb2" in shown.note


def test_of_a_whole_scan_nothing_is_missing(hand):
    assert _shown(hand, hand.scan.points, hand.scan.pose) is None


@pytest.mark.parametrize("n_points", [40, 80])
def test_where_points_are_few_their_want_tells_nothing(hand, n_points):
    for first in range(4):
        assert _shown(hand, hand.scan.points[first :: len(hand.scan.points) // n_points], hand.scan.pose) is None


def test_a_limb_that_lies_beside_its_points_is_not_missing(hand):
    # Its points are unexplained: the pose is wrong, and not the scan.
    shown = _shown(hand, hand.scan.points, _hidden(hand, "index", "middle"))
    assert shown is None or "index1" not in _names(hand, shown)


def test_no_limb_is_missing_without_which_points_are_explained_worse(hand, monkeypatch):
    points = _without(hand, "ring1")
    assert _shown(hand, points, hand.scan.pose) is not None
    monkeypatch.setattr("lbsfit_np.fitting.missing._RISE", -1.0)  # any way of explaining them is worse than asked for
    assert _shown(hand, points, hand.scan.pose) is None


def test_where_points_stay_unexplained_nothing_is_missing(hand):
    points, size = _without(hand, "ring1"), hand.rig.size * hand.scan.scale
    beside = points.mean(axis=0) + size * (np.random.default_rng(0).normal(0.0, 0.02, (200, 3)) + [0.0, 0.0, 0.5])
    assert _shown(hand, np.concatenate([points, beside]), hand.scan.pose) is None


def test_taken_to_the_whole_model_the_mesh_stays_where_it_was_fitted(hand):
    shown = _shown(hand, _without(hand, "index1", "pinky1"), hand.scan.pose)
    state = shown.state.replace(residual=0.05 * np.random.default_rng(2).normal(size=(np.count_nonzero(~shown.missing), 3)))
    fitted, whole = shown.model.deformed(state), hand.model.deformed(shown.whole(state, hand.model))
    np.testing.assert_allclose(whole.joints, fitted.joints, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(whole.vertices[~shown.missing], fitted.vertices, rtol=0.0, atol=1e-12)


def test_offsets_of_what_is_missing_are_those_of_what_is_next_to_it(hand):
    shown = _shown(hand, _without(hand, "ring1"), hand.scan.pose)
    vertices, there = hand.model.rig.vertices, ~shown.missing
    own = np.random.default_rng(1).normal(size=(there.sum(), 3))
    whole = shown.whole(shown.state.replace(residual=own, displacement=2 * own), hand.model)
    np.testing.assert_array_equal(whole.residual[there], own)
    np.testing.assert_array_equal(whole.displacement, 2 * whole.residual)
    row = int(np.flatnonzero(shown.missing)[0])
    # Of the palm, not of the fingers beside it, which are nearer.
    palm = hand.rig.parents[hand.rig.joint_names.index("ring1")]
    of = [int(np.flatnonzero((own == offset).all(axis=1))[0]) for offset in whole.residual[shown.missing]]
    assert set(vertex_bones(hand.model.rig)[there][of]) == {palm}
    rim = np.unique(of)
    nearest = np.linalg.norm(vertices[there][rim] - vertices[row], axis=1).argmin()
    np.testing.assert_array_equal(whole.residual[row], own[rim[nearest]])
    bare = shown.whole(shown.state, hand.model)
    assert bare.residual is None and bare.displacement is None


def test_the_segmenter_says_nothing_of_parts_that_are_missing(hand):
    shown = _shown(hand, _without(hand, "ring1"), hand.scan.pose)
    n_parts = len(hand.rig.parts)
    lost = np.setdiff1d(np.arange(n_parts), hand.model.labels[~shown.missing])
    said = shown.said(np.vstack([np.full(n_parts, 1 / n_parts), np.eye(n_parts)[lost[0]]]))
    assert len(lost) == 3 and not said[:, lost].any()
    np.testing.assert_allclose(said.sum(axis=1), [1.0, 0.0])  # of the second nothing is known
    assert shown.said(None) is None


def test_what_is_missing_stays_where_a_start_has_it(hand):
    own = _limb(hand, "ring1")
    shown = _shown(hand, _without(hand, "ring1"), _hidden(hand, "ring", "middle"), theta0=hand.scan.pose)
    np.testing.assert_allclose(shown.state.theta[own], hand.scan.pose[own], atol=0.05)


def test_the_rest_and_what_is_known_of_it(hand):
    """A fit from a given start, without a segmenter."""
    rig, scan, own = hand.rig, hand.scan, _limb(hand, "ring1")
    start = scan.pose.copy()
    start[own] = hand.model.rest().theta[own]
    result = ScanFit(hand.model, _SETTINGS).fit(_without(hand, "ring1"), theta0=start)
    away = np.linalg.norm(result.joints - scan.joints, axis=1) / (rig.size * scan.scale)
    assert away[~own].mean() < 0.005
    assert (result.joint_std[own][1:] > 0.02 * rig.size * scan.scale).all()
    assert (result.joint_std[~own] < 0.02 * rig.size * scan.scale).all()
    assert "nothing of what hangs on ring1" in result.message
    assert "hardly tells" not in result.message
    missing = own[vertex_bones(rig)]
    assert not np.isin(result.labels, np.unique(rig.vertex_labels[missing])).any()
    assert result.evidence["part_unreached"] > 0.8 and result.evidence["unreached"] < 0.02
    assert np.isclose(result.evidence["hidden"], hand.model.areas[missing].sum(), atol=0.01)
    # What is missing hangs on the rest without a tear.
    edges = np.linalg.norm(np.diff(result.vertices[rig.faces[:, :2]], axis=1), axis=2) / scan.scale
    assert edges.max() < 2 * np.linalg.norm(np.diff(rig.vertices[rig.faces[:, :2]], axis=1), axis=2).max()


def test_what_is_missing_is_at_no_limit(hand):
    """At rest, where nothing has put them, many angles of a hand are at a limit."""
    points, rig = _without(hand, "index1", "pinky1"), hand.model.rig
    shown = _shown(hand, points, hand.scan.pose)
    V, X, theta = hand.model.deformed(shown.state).vertices, _problem(hand, points).X, shown.state.theta
    every, rest = (evidence_of(hand.model, V, X, theta=theta, shown=s)[0]["at_limits"] for s in (None, shown))
    free = rig.turning & (rig.upper - rig.lower > 0.1) & ~_limb(hand, "index1", "pinky1")[:, None]
    free[rig.root] = False
    at = np.minimum(theta - rig.lower, rig.upper - theta)[free] < 0.01
    assert rest == pytest.approx(at.mean()) and rest < every


def test_on_a_known_template(hand):
    points, own, model = _without(hand, "index1"), _limb(hand, "index1"), hand.model
    frame = Frame(hand.scan.translation, hand.scan.scale * model.half, np.eye(3))
    part = ScanFit(model, _SETTINGS).taking_part(points)
    place = {"points": points, "part": part, "frame": frame}
    found = Problem(frame.inside(points[part.rows])), _state(hand, _hidden(hand, "index", "middle"))
    result = TemplateFit(hand.rig, model, _SETTINGS).finish(*found, theta0=hand.scan.pose, **place)
    away = np.linalg.norm(result.joints - hand.scan.joints, axis=1) / (hand.rig.size * hand.scan.scale)
    assert away.max() < 0.02 and away[~own].mean() < 0.005
    assert "nothing of what hangs on index1" in result.message
    assert (result.joint_std[own][1:] > 0.02 * hand.rig.size * hand.scan.scale).all()


def test_known_labels_and_one_sided_views_are_left_alone(hand, monkeypatch):
    def asked(*arguments, **options):
        raise AssertionError("looked for missing limbs")

    monkeypatch.setattr(MissingLimbs, "of", asked)
    points = _without(hand, "ring1")
    labels = hand.rig.vertex_labels[hand.rig.faces[hand.scan.triangle, 0]][~_limb(hand, "ring1")[hand.bone]]
    ScanFit(hand.model, _SETTINGS).fit(points, labels=labels)
    ScanFit(hand.model, FitSettings(effort="fast", partial=True)).fit(points, theta0=hand.scan.pose)
    with pytest.raises(AssertionError, match="missing limbs"):
        ScanFit(hand.model, _SETTINGS).fit(points, theta0=hand.scan.pose)


def test_skin_is_left_out_with_the_triangles_that_it_has_and_what_has_no_others(hand):
    model, faces = hand.model, hand.model.rig.faces
    alone = int(faces[0, 0])
    gone = np.zeros(len(model.labels), dtype=bool)
    gone[np.setdiff1d(faces[(faces == alone).any(axis=1)], alone)] = True  # all around a vertex
    less, left_out = model.without(gone)
    assert left_out[alone] and (left_out == gone).sum() == len(gone) - 1
    assert set(np.unique(less.rig.faces)) == set(range((~left_out).sum()))
    np.testing.assert_array_equal(less.rig.vertices, model.rig.vertices[~left_out])
    some = State(hand.scan.pose, np.ones(3), 0.9, np.full(model.n_coefficients, 0.05), None)
    one, other = model.deformed(some), less.deformed(some)
    np.testing.assert_allclose(other.vertices, one.vertices[~left_out], atol=1e-12)
    np.testing.assert_allclose(other.joints, one.joints, atol=1e-12)
    assert model.without(np.ones_like(gone))[0] is None
