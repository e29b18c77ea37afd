"""The segmenter's two stages, and the context that the second one sees."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from segmenter_training import describe, scans_of
from sklearn.neural_network import MLPClassifier

import lbsfit_np as lbs
from lbsfit_np.segmentation.context import CONTEXT_POINTS, context, context_size
from lbsfit_np.segmentation.descriptors import Descriptor
from lbsfit_np.segmentation.segmenter import Segmenter, train_segmenter
from lbsfit_np.segmentation.stage import Stage, Training, in_half_precision, train_stage

# ---- the two stages ----


def test_the_first_stage_sees_descriptors_and_the_second_their_context(tube_rig, small_segmenter, tube_scan):
    first, second = small_segmenter.stages
    assert len(first.mean) == Descriptor().size
    assert len(second.mean) == Descriptor().size + context_size(4)
    X = tube_scan.points / (tube_rig.size / 2)
    around = np.linspace(0, len(X) - 1, CONTEXT_POINTS).astype(int)
    own = small_segmenter.descriptor(X)
    proba = first.predict_proba(own.copy())
    expected = second.predict_proba(np.hstack([own, context(X, proba, X[around], proba[around])]))
    np.testing.assert_allclose(small_segmenter.predict_proba(tube_scan.points, views=1), expected, atol=1e-5)
    assert np.abs(expected - proba).max() > 0.01


@pytest.mark.slow
def test_the_second_stage_is_worth_its_while(tube_fitter, tube_rig):
    second = tube_fitter.segmenter_
    first = replace(second, stages=second.stages[:1])
    scans = lbs.synthesize(tube_rig, 8, random_state=78)
    right = [np.mean([(s.predict(scan.points) == scan.labels).mean() for scan in scans]) for s in (first, second)]
    assert right[1] > right[0] > 0.8


def test_the_second_stage_learns_from_scans_that_the_first_has_not_seen(tube_rig):
    def train(n, second):
        scans = scans_of(tube_rig, 8)
        s = train_segmenter(tube_rig, scans, n, training=Training(points_per_scan=30, second=second), random_state=0)
        assert scans.asked == list(range(n))
        return s.stages

    both, alone = train(8, 0.25), train(6, 0.0)
    assert len(both) == 2 and len(alone) == 1
    for name, array in alone[0].arrays("s").items():
        np.testing.assert_array_equal(array, both[0].arrays("s")[name])


def test_without_a_second_stage_the_first_decides(tube_rig, tube_scan, tmp_path):
    scans = scans_of(tube_rig, 4)
    s = train_segmenter(tube_rig, scans, 4, training=Training(points_per_scan=60, second=0.0), random_state=0)
    assert len(s.stages) == 1 and scans.asked == [0, 1, 2, 3]
    expected = s.stages[0].predict_proba(describe(tube_scan.points, tube_rig))
    found = s.predict_proba(tube_scan.points, views=1)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-7)  # by fewer rows at a time, which rounds otherwise
    s.save(tmp_path / "s.npz")
    again = Segmenter.load(tmp_path / "s.npz")
    assert len(again.stages) == 1
    np.testing.assert_array_equal(again.predict_proba(tube_scan.points, views=1), found)


def test_stages_have_to_fit_the_descriptor_and_each_other(small_segmenter):
    first, second = small_segmenter.stages
    for stages in ((), (second,), (first, first), (second, first), (first, second, second)):
        with pytest.raises(ValueError, match="stages that do not fit"):
            replace(small_segmenter, stages=stages)


def test_a_stage_of_one_part_is_sure():
    X = np.random.default_rng(0).standard_normal((20, 3)).astype(np.float32)
    seen = []
    stage = train_stage(X, np.full(20, 2), 4, Training(), 0, "test", seen.append)
    assert stage.layers == () and seen == [1.0]
    np.testing.assert_array_equal(stage.predict_proba(X[:5]), np.tile([0.0, 0, 1, 0], (5, 1)))
    again = Stage.from_arrays(stage.arrays("s"), "s", 4)
    np.testing.assert_array_equal(again.predict_proba(X[:5]), np.tile([0.0, 0, 1, 0], (5, 1)))


@pytest.mark.parametrize("parts", [[1, 3], [0, 1, 3]])
def test_a_stage_answers_as_scikit_learns_classifier(parts):
    rng = np.random.default_rng(0)
    X = in_half_precision(rng.standard_normal((600, 5)))
    y = np.array(parts)[rng.integers(0, len(parts), 600)]
    stage = train_stage(X, y, 4, Training(hidden=(16, 8)), 0, "test", lambda share: None)
    assert stage.hidden == (16, 8) and stage.classes.tolist() == parts
    theirs = MLPClassifier(stage.hidden, max_iter=1, batch_size=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one step is no convergence
        theirs.fit(X[:3].astype(np.float32), parts if len(parts) == 3 else [*parts, parts[0]])
    for (w, b), own_w, own_b in zip(stage.layers, theirs.coefs_, theirs.intercepts_, strict=True):
        own_w[...], own_b[...] = w, b
    found = stage.predict_proba(X.astype(np.float32))
    np.testing.assert_array_equal(found[:, parts], theirs.predict_proba((X.astype(np.float32) - stage.mean) / stage.deviation))
    assert not np.delete(found, parts, axis=1).any()


# ---- context ----


def _context_parts(values, n_parts):
    """The blocks of a row of context by name."""
    names = ("own", 1), ("near", 1), ("wide", 1), ("relative", 3), ("centroids", 3), ("shares", 1), ("spreads", 1)
    ends = np.cumsum([k * n_parts for _, k in names])[:-1]
    return {name: block for (name, _), block in zip(names, np.split(values, ends, axis=1), strict=True)}


def test_context_of_a_labelling_made_by_hand():
    """Parts 0 and 1 of two points each, part 2 nowhere; all relative to the mean of the points, (5.5, 0, 0)."""
    around = np.array([[0.0, 0, 0], [2, 0, 0], [10, 1, 0], [10, -1, 0]])
    labels = np.eye(3)[[0, 0, 1, 1]]
    found = context(np.array([[0.0, 0, 0], [5.5, 0, 7]]), np.array([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]]), around, labels)
    assert found.shape == (2, context_size(3)) == (2, 33) and found.dtype == np.float32
    block = _context_parts(found, 3)
    np.testing.assert_allclose(block["own"], [[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]], atol=1e-6)
    np.testing.assert_allclose(block["near"], [[0.5, 0.5, 0.0]] * 2)
    np.testing.assert_allclose(block["wide"], [[0.5, 0.5, 0.0]] * 2)
    relative = [[-1, 0, 0, -10, 0, 0, -5.5, 0, 0], [4.5, 0, 7, -4.5, 0, 7, 0, 0, 7]]
    np.testing.assert_allclose(block["relative"], relative, atol=1e-6)
    np.testing.assert_allclose(block["centroids"], [[-4.5, 0, 0, 4.5, 0, 0, 0, 0, 0]] * 2, atol=1e-6)
    np.testing.assert_allclose(block["shares"], [[0.5, 0.5, 0.0]] * 2)
    np.testing.assert_allclose(block["spreads"], [[1.0, 1.0, 0.0]] * 2, atol=1e-6)


def test_context_is_near_and_wide():
    """On a line of points, 20 of part 0 and then 20 of part 1: the 8 and the 30 nearest of 18.2."""
    around = np.column_stack([np.arange(40.0), np.zeros(40), np.zeros(40)])
    block = _context_parts(context(np.array([[18.2, 0, 0]]), np.array([[1.0, 0]]), around, np.eye(2)[np.arange(40) // 20]), 2)
    np.testing.assert_allclose(block["near"], [[5 / 8, 3 / 8]])
    np.testing.assert_allclose(block["wide"], [[16 / 30, 14 / 30]], atol=1e-6)


def test_context_weighs_by_probability():
    rng = np.random.default_rng(0)
    around, p = rng.standard_normal((50, 3)), rng.dirichlet(np.ones(3), 50)
    block = _context_parts(context(around[:1], p[:1], around, p), 3)
    centred = around - around.mean(axis=0)
    for k in range(3):
        mean = np.average(centred, axis=0, weights=p[:, k])
        spread = np.sqrt(np.average((centred - mean) ** 2, axis=0, weights=p[:, k])).sum()
        np.testing.assert_allclose(block["centroids"][0, 3 * k : 3 * k + 3], mean, atol=1e-6)
        assert block["spreads"][0, k] == pytest.approx(spread, abs=1e-6)
        assert block["shares"][0, k] == pytest.approx(p[:, k].mean(), abs=1e-6)


def test_context_does_not_depend_on_the_place_and_takes_few_points():
    rng = np.random.default_rng(1)
    x, around = rng.standard_normal((6, 3)), rng.standard_normal((60, 3))
    p, q = rng.dirichlet(np.ones(4), 6), rng.dirichlet(np.ones(4), 60)
    before = context(x, p, around, q)
    np.testing.assert_allclose(context(x + [3.0, -2, 9], p, around + [3.0, -2, 9], q), before, atol=1e-5)
    for n in (1, 2, 9):
        assert np.isfinite(context(x, p, around[:n], q[:n])).all()
