"""The segmenter: which points it labels, in which unit, and for whom."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from segmenter_training import ONE, TWO, in_parts, train_small
from small_rigs import make_tube_data, make_tube_rig

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning.tasks import Labels
from lbsfit_np.rig.build import build_rig
from lbsfit_np.segmentation import segmenter
from lbsfit_np.segmentation.context import CONTEXT_POINTS
from lbsfit_np.segmentation.segmenter import Segmenter
from lbsfit_np.segmentation.stage import Stage


@pytest.mark.parametrize(
    "points, options, words",
    [
        (np.full((5, 3), np.nan), {}, "points: got 5 points that are NaN"),
        (np.empty((0, 3)), {}, "points: got an empty set"),
        (np.zeros((5, 2)), {}, r"points: got shape \(5, 2\)"),
        ("abc", {}, "points: got str"),
        ([[10**400, 0, 0]], {}, "points: got .*double precision"),
        (np.eye(3), {"scale": 0.0}, "scale: got 0.0; expected a positive number, from 1e-100 to 1e100"),
        (np.eye(3), {"scale": -1}, "scale"),
        (np.eye(3), {"scale": np.nan}, "scale"),
        (np.eye(3), {"scale": np.float32(0)}, "scale"),
        (np.eye(3), {"scale": 10**400}, "scale"),
        (np.eye(3), {"rows": [[1], [1, 2]]}, "rows: got rows of different lengths"),
        (np.eye(3), {"scale": "2"}, "scale"),
        (np.eye(3), {"rows": [3]}, "rows: got numbers from 3 to 3; expected rows of the 3 points"),
        (np.eye(3), {"rows": [0.5]}, "rows: got float64"),
        (np.eye(3), {"views": 2}, "views: got 2; expected 4, or 1"),
        (np.eye(3), {"views": True}, "views: got True; expected 4, or 1"),
        (np.eye(3), {"views": np.array([1, 4])}, r"views: got array\(\[1, 4\]\); expected 4, or 1"),
        (np.eye(3), {"rows": []}, r"rows: got .*shape \(0,\)"),
    ],
)
def test_points_that_cannot_be_labelled(small_segmenter, points, options, words):
    for method in (small_segmenter.predict, small_segmenter.predict_proba):
        with pytest.raises(InputError, match=words):
            method(points, **options)


def test_a_scan_is_labelled_as_its_points_are(small_segmenter, tube_scan):
    np.testing.assert_array_equal(small_segmenter.predict(lbs.Scan(tube_scan.points)), small_segmenter.predict(tube_scan.points))


def test_predicting_leaves_the_points_alone(small_segmenter, tube_scan):
    kept = tube_scan.points.copy()
    small_segmenter.predict_proba(tube_scan.points)
    np.testing.assert_array_equal(tube_scan.points, kept)


@pytest.mark.filterwarnings("error")
def test_points_at_the_edge_of_what_numbers_can_say(small_segmenter, tube_scan):
    far = tube_scan.points * 1e303
    np.testing.assert_allclose(small_segmenter.predict_proba(far).sum(axis=1), 1.0, atol=1e-5)
    expected = small_segmenter.predict_proba(tube_scan.points)
    np.testing.assert_array_equal(small_segmenter.predict_proba(tube_scan.points, scale=np.float32(1)), expected)


def test_the_scans_scale_is_taken_out(small_segmenter, tube_scan):
    np.testing.assert_allclose(
        small_segmenter.predict_proba(1000 * tube_scan.points, scale=1000.0),
        small_segmenter.predict_proba(tube_scan.points),
        atol=2e-3,
    )


def test_rows_are_a_choice_of_points(small_segmenter, tube_scan):
    rows = np.arange(0, 1000, 7)
    one = replace(small_segmenter, stages=small_segmenter.stages[:1])
    for s, atol in ((one, 1e-6), (small_segmenter, 1e-5)):  # single precision; the second stage adds its rounding to the first's
        np.testing.assert_allclose(
            s.predict_proba(tube_scan.points, rows=rows), s.predict_proba(tube_scan.points)[rows], atol=atol
        )


@pytest.mark.parametrize("far", [50.0, 1e9, 1e30, 1e300])
@pytest.mark.parametrize("views", [4, 1])
@pytest.mark.filterwarnings("error")
def test_points_far_away_do_not_change_the_labels_of_the_others(small_segmenter, tube_scan, far, views):
    """Wherever they stand in the scan: the second stage's sample of it leaves them out, as the voxels do."""
    alone, n = small_segmenter.predict_proba(tube_scan.points, views=views), len(tube_scan.points)
    places = 7.0 + far * np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0]])
    for at in (0, n // 2, n):
        found = small_segmenter.predict_proba(np.insert(tube_scan.points, at, places, axis=0), views=views)
        np.testing.assert_allclose(np.delete(found, [at, at + 1], axis=0), alone, atol=1e-5)
        np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("views", [1, 4])
def test_many_points_are_labelled_in_pieces(small_segmenter, tube_scan, monkeypatch, views):
    """Of a scan of millions, what describes them all at once would fill memory; each piece has the context of the whole scan."""
    whole, seen, most = small_segmenter.predict_proba(tube_scan.points, views=views), [], 150
    predict = Stage.predict_proba

    def watched(self, x):
        seen.append(len(x))
        return predict(self, x)

    monkeypatch.setattr(Stage, "predict_proba", watched)
    monkeypatch.setattr(segmenter, "_BLOCK", most)
    pieces = small_segmenter.predict_proba(tube_scan.points, views=views)
    np.testing.assert_allclose(pieces, whole, atol=1e-5)
    assert max(seen) <= most + CONTEXT_POINTS and len(seen) == 2 * views * -(-len(tube_scan.points) // most)


def test_a_scan_far_from_the_origin_has_the_same_labels(small_segmenter, tube_scan):
    """Such as millimetres in a frame of the world: what is far from the origin is not far from the scan."""
    far = tube_scan.points + 3e6 * np.array([1.0, -1.0, 0.5])
    np.testing.assert_allclose(small_segmenter.predict_proba(far), small_segmenter.predict_proba(tube_scan.points), atol=1e-4)


def test_labels_are_the_mean_over_four_views(small_segmenter, tube_scan):
    """Turned by a quarter of a radian each, about axes that are as far from each other as can be."""
    axes = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    turned = [tube_scan.points @ Rotation.from_rotvec(0.25 * axis).as_matrix().T for axis in axes]
    expected = np.mean([small_segmenter.predict_proba(points, views=1) for points in turned], axis=0)
    found = small_segmenter.predict_proba(tube_scan.points)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(found - small_segmenter.predict_proba(tube_scan.points, views=1)).max() > 0.01
    np.testing.assert_array_equal(small_segmenter.predict(tube_scan.points), found.argmax(axis=1))


@pytest.mark.slow
def test_fits_and_rounds_take_one_view(tube_fitter, tube_rig, tube_scan, monkeypatch):
    """Four take a tenth more time for fits that are no better."""
    asked, predict_proba = [], Segmenter.predict_proba

    def asking(self, points, *, views=4, **options):
        asked.append(views)
        return predict_proba(self, points, views=views, **options)

    monkeypatch.setattr(Segmenter, "predict_proba", asking)
    for options in ({}, {"theta0": np.zeros((len(tube_rig.parents), 3))}):
        tube_fitter.fit_scan(tube_scan.points, **options)
    at_once = len(asked)
    Labels(tube_fitter.segmenter_, tube_rig)((tube_scan.points / tube_fitter.segmenter_.half, np.zeros_like(tube_rig.lower)))
    assert at_once >= 2 and set(asked) == {1} and len(asked) == at_once + 1


@pytest.mark.slow
def test_views_are_worth_their_while(tube_fitter, tube_rig):
    scans = lbs.synthesize(tube_rig, 32, random_state=79, n_points=400)
    said = [[tube_fitter.segmenter_.predict(scan.points, views=views) == scan.labels for scan in scans] for views in (1, 4)]
    assert np.mean(said[1]) > np.mean(said[0]) > 0.8


@pytest.mark.parametrize("half, turn", [(0.0, 0.0), (0.3, 0.125), (1.2, 0.25)])
def test_views_are_turned_as_scans_of_the_training_are(tube_rig, tube_scan, half, turn):
    """By what the root's least free angle allows."""
    lower, upper = tube_rig.lower.copy(), tube_rig.upper.copy()
    lower[tube_rig.root], upper[tube_rig.root] = (-half, -2.0, -half), (half, 2.0, half)
    s = train_small(replace(tube_rig, lower=lower, upper=upper))
    assert s.turn == pytest.approx(turn)
    alike = s.predict_proba(tube_scan.points) == s.predict_proba(tube_scan.points, views=1)
    assert alike.all() == (turn == 0)


@pytest.mark.parametrize("parts", [ONE, TWO])
def test_rigs_of_one_and_two_parts(tmp_path, parts, tube_scan):
    rig = in_parts(parts)
    assert rig.parts == tuple(parts)
    s = train_small(rig)
    assert len(s.stages) == len(parts)  # of a single part there is nothing to say in context
    proba = s.predict_proba(tube_scan.points)
    assert proba.shape == (len(tube_scan.points), len(parts))
    np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-5)
    s.save(tmp_path / "s.npz")
    np.testing.assert_array_equal(Segmenter.load(tmp_path / "s.npz").predict_proba(tube_scan.points), proba)


def test_it_belongs_to_one_rig(small_segmenter, tube_rig):
    small_segmenter.check_rig(tube_rig)
    small_segmenter.check_rig(make_tube_rig())
    data = make_tube_data()
    others = [
        tube_rig.with_parts("arm and fingers"),
        tube_rig.scaled(2.0),
        build_rig(replace(data, upper=data.upper + 0.1)),
        build_rig(replace(data, vertices=data.vertices * [1, 1, 1.1])),
    ]
    for other in others:
        with pytest.raises(InputError, match="segmenter: got one that was trained on another rig.*pretrain"):
            small_segmenter.check_rig(other)
