"""Where a template in a known pose is put that a scan shows."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.learning.parameters import fit_settings
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import Coverage
from lbsfit_np.starts import place
from lbsfit_np.starts.place import placed

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def model():
    return Model(lbs.load_rig("hand-coarse"))


@pytest.fixture(scope="module")
def views(model):
    """(problem, pose, where the origin of the rig is) of a view of one side of a hand in its own shape."""
    out = []
    for s in lbs.synthesize(model.source, 8, poses="natural", random_state=2, n_points=600, shape=0.0, one_sided=True):
        centre = s.points.mean(axis=0) + [0.3, 0.0, -0.1]  # a frame may have any origin
        out.append((Problem((s.points - centre) / model.half), s.pose, (s.translation - centre) / model.half))
    return out


def _away(model, views, **options):
    put = [placed(model, problem, theta, **options).translation - where for problem, theta, where in views]
    return np.linalg.norm(put, axis=1)


def test_a_view_of_one_side_is_put_where_that_side_is(model, views):
    whole, side = _away(model, views), _away(model, views, coverage=Coverage(one_sided=True))
    assert np.median(whole) > 0.15
    assert np.median(side) < 0.4 * np.median(whole) and side.max() < 0.6 * whole.max()


@pytest.mark.parametrize("weighted", [False, True])
def test_weights_and_order_of_points_are_minded(weighted, model, views):
    problem, theta, _ = views[0]
    n, near = len(problem.X), np.repeat(problem.X, 3, axis=0) + [0.0, 0.0, 0.3]
    weights = np.r_[np.full(n, 1.0 / n), np.zeros(3 * n)] if weighted else None
    given = Problem(np.vstack([problem.X, near]) if weighted else problem.X[::-1], weights)
    alone, found = (placed(model, p, theta, coverage=Coverage(one_sided=True)).translation for p in (problem, given))
    np.testing.assert_allclose(found, alone, atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1.2])
def test_a_whole_scan_has_the_centroid_of_the_surface(scale, model):
    (s,) = lbs.synthesize(model.source, 1, random_state=0, n_points=300)
    problem = Problem(s.points / model.half)
    state = placed(model, problem, s.pose, scale)
    assert state.scale == scale and (state.theta == s.pose).all() and state.theta is not s.pose
    np.testing.assert_allclose(model.areas @ model.deformed(state).vertices, problem.X.mean(axis=0), atol=1e-12)


def test_a_known_pose_finds_its_place_in_a_view_of_one_side(model, views):
    refit = Refit(model, coverage=Coverage(one_sided=True))
    for problem, theta, where in views:
        state, _, which = refit(problem, poses=[theta])
        truth = model.rest().replace(theta=theta, translation=where)
        off = np.linalg.norm(model.deformed(state).joints - model.deformed(truth).joints, axis=1)
        assert which == 0 and np.median(off) < 0.03  # a finger that the view hides may be anywhere


def test_a_known_pose_is_moved_to_where_it_is_before_joints_bend(model):
    """Of hands whose scans are dense here and thin there; with the true place they are where they belong."""
    refit, off, near = Refit(model), [], []
    for s in lbs.synthesize(model.source, 6, poses="natural", random_state=3, n_points=600, shape=0.0, density=1.5):
        centre = s.points.mean(axis=0)
        problem, true = Problem((s.points - centre) / model.half), (s.joints - centre) / model.half
        for state, out in ((refit.placed(problem, s.pose), off), (refit.in_place(problem, s.pose), near)):
            np.testing.assert_array_equal(state.theta, s.pose)
            out.append(np.linalg.norm(model.deformed(state).joints - true, axis=1).mean())
    assert np.median(off) > 0.15
    assert max(near) < 0.01 and (np.array(near) < 0.3 * np.array(off)).all()


@pytest.mark.slow
def test_a_start_that_is_right_is_not_lost_on_a_learned_template(model):
    """Nor on the way there: steps that look far bend fingers into their neighbours."""
    from lbsfit_np.learning.new_scan import _given

    scans = lbs.synthesize(model.source, 6, poses="natural", random_state=3, n_points=600, shape=0.0, density=1.5)[:3]
    fitter = lbs.LBSFitter(model.source, orientation="aligned", random_state=0)
    fitter.template_, fitter.unit_, fitter.segmenter_ = {0: model.source}, {0: 1.0}, None
    for s in scans:
        found = _given(fitter, 0, s.points, None, fit_settings(fitter), 1.0, s.pose, None)
        joints = found.frame.outside(model.deformed(found.state).joints)
        assert np.linalg.norm(joints - s.joints, axis=1).mean() / model.half < 0.01


@pytest.mark.parametrize("one_sided", [False, True])
def test_a_cropped_scan_is_put_where_its_part_is(one_sided, model):
    """The centroid of half a hand is a third of its size from the whole's."""
    settings = {"poses": "natural", "random_state": 4, "n_points": 600, "shape": 0.0, "holes": 0, "cropped": 0.6}
    scans = lbs.synthesize(model.source, 12, one_sided=one_sided, **settings)
    views = [(Problem(s.points / model.half), s.pose, s.translation / model.half) for s in scans]
    unsaid, said = (_away(model, views, coverage=Coverage(one_sided, cropped)) for cropped in (False, True))
    assert np.median(said) < 0.6 * np.median(unsaid) and said.max() < 0.7 * unsaid.max()


def test_centroids_of_what_crops_leave():
    """Of a rod along x: with 40 % beyond, either end is left."""
    V = np.column_stack([np.linspace(-1.0, 1.0, 201), np.zeros(201), np.zeros(201)])
    found = place._centroids(V, np.full(201, 1 / 201), None, True)
    assert len(found) == 1 + 26 * len(place._CROPS)
    assert np.abs(found[:, 1:]).max() == 0 and found[0, 0] == pytest.approx(0.0, abs=1e-12)
    for share in place._CROPS:
        for side in (-share, share):
            assert np.abs(found[:, 0] - side).min() < 0.01
    assert np.abs(found[:, 0]).max() < max(place._CROPS) + 0.01
