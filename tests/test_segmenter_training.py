"""The training of a segmenter: what it learns, by seed, in one process or in several."""

import os
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from segmenter_training import ONE, Scans, in_parts, scans_of, train_small
from small_rigs import make_tube_data, seamed

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning.training import TrainingScans
from lbsfit_np.rig.build import build_rig
from lbsfit_np.segmentation.context import context
from lbsfit_np.segmentation.descriptors import Descriptor
from lbsfit_np.segmentation.segmenter import train_segmenter
from lbsfit_np.segmentation.stage import Training, in_half_precision, train_stage
from lbsfit_np.synthesis import Synthesis


def test_it_learns_the_parts(tube_fitter, tube_rig):
    for s in lbs.synthesize(tube_rig, 3, random_state=77):
        proba = tube_fitter.segmenter_.predict_proba(s.points)
        assert proba.shape == (len(s.points), 4)
        np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-5)
        assert (proba >= 0).all()
        found = tube_fitter.segmenter_.predict(s.points)
        np.testing.assert_array_equal(found, proba.argmax(axis=1))
        assert (found == s.labels).mean() > 0.75


def test_a_seed_trains_the_same_segmenter(tube_rig, small_segmenter, tube_scan):
    np.testing.assert_array_equal(
        train_small(tube_rig).predict_proba(tube_scan.points), small_segmenter.predict_proba(tube_scan.points)
    )
    assert not np.array_equal(
        train_small(tube_rig, seed=1).predict_proba(tube_scan.points), small_segmenter.predict_proba(tube_scan.points)
    )


def test_training_leaves_its_scans_alone(tube_rig):
    scan = scans_of(tube_rig, 2)
    kept = [(p.copy(), y.copy()) for p, y, _ in scan.scans]
    train_segmenter(tube_rig, scan, 2, training=Training(points_per_scan=20), random_state=0)
    for (p, y, _), (q, z) in zip(scan.scans, kept, strict=True):
        np.testing.assert_array_equal(p, q)
        np.testing.assert_array_equal(y, z)


def test_progress_goes_from_nothing_to_all(tube_rig):
    for rig, second in ((tube_rig, 0.5), (tube_rig, 0.0), (in_parts(ONE), 0.5)):
        seen = []
        train_small(rig, second=second, progress=seen.append)
        assert len(seen) > 1 and seen[0] > 0 and seen[-1] == pytest.approx(1.0)
        assert (np.diff(seen) >= -1e-12).all()


def test_processes_change_nothing(tube_rig, tube_scan):
    """Enough scans that each of the two stages has a batch for each process."""
    scans = TrainingScans(tube_rig, Synthesis(n_points=120), 3)
    training = Training(points_per_scan=20, hidden=(16,))
    one, two = (train_segmenter(tube_rig, scans, 200, training=training, random_state=3, n_jobs=n) for n in (1, 2))
    for a, b in zip(one.stages, two.stages, strict=True):
        for name, array in a.arrays("s").items():
            np.testing.assert_array_equal(array, b.arrays("s")[name])
    np.testing.assert_array_equal(one.predict_proba(tube_scan.points), two.predict_proba(tube_scan.points))


@pytest.mark.parametrize("n_jobs", [0, True, 1.5, "2"])
def test_a_number_of_processes_that_cannot_be(tube_rig, n_jobs):
    with pytest.raises(InputError, match="n_jobs: got .*expected a positive whole number of processes"):
        train_small(tube_rig, n_jobs=n_jobs)


def test_what_cannot_be_sent_to_processes(tube_rig):
    with pytest.raises(InputError, match="n_jobs: .*cannot be sent.*top level of a module, or n_jobs=1"):
        train_segmenter(tube_rig, lambda i: None, 200, random_state=0, n_jobs=2)


def _fails(i):
    raise InputError("scan", "one that cannot be made", "another")


def _dies(i):
    os._exit(7)


def test_errors_in_processes_arrive(tube_rig):
    with pytest.raises(InputError, match="scan: got one that cannot be made"):
        train_segmenter(tube_rig, _fails, 200, random_state=0, n_jobs=2)
    with pytest.raises(InputError, match=r"n_jobs: got a worker process that ended \(exit code 7\)"):
        train_segmenter(tube_rig, _dies, 200, random_state=0, n_jobs=2)


class Drawn:
    """Scans that a shared Generator draws, so that copies of it would draw the same ones twice."""

    def __init__(self, rig, rng):
        self.rig, self.rng = rig, rng

    def __call__(self, i):
        s = lbs.synthesize(self.rig, 1, random_state=self.rng, n_points=120)[0]
        return s.points, s.labels, 1.0


@pytest.mark.slow
def test_a_generator_is_never_copied_into_processes(tube_rig, tube_scan):
    training = Training(points_per_scan=20, hidden=(16,))

    def trained(n_jobs):
        rng = np.random.default_rng(3)
        return train_segmenter(tube_rig, Drawn(tube_rig, rng), 200, training=training, random_state=rng, n_jobs=n_jobs)

    np.testing.assert_array_equal(trained(1).predict_proba(tube_scan.points), trained(2).predict_proba(tube_scan.points))


def test_a_part_that_no_scan_shows_is_never_found(tube_rig, tube_scan):
    scans = Scans([(p[y != 1], y[y != 1], 1.0) for p, y, _ in scans_of(tube_rig, 8).scans])
    proba = train_segmenter(tube_rig, scans, 8, training=Training(points_per_scan=20), random_state=0).predict_proba(
        tube_scan.points
    )
    assert proba.shape == (len(tube_scan.points), 4)
    assert (proba[:, 1] == 0).all() and (proba[:, [0, 2, 3]].max(axis=0) > 0).all()


@pytest.mark.parametrize("average_from", [0, 1, 5])
def test_weights_are_averaged_over_the_later_epochs(tube_rig, average_from):
    """A start of the average after the last epoch means the last epoch, not nothing."""
    rng = np.random.default_rng(0)
    X = rng.standard_normal((400, 5)).astype(np.float32)
    y = (X[:, 0] > 0).astype(int)

    def train(**options):
        training = Training(hidden=(8,), learning_rate=0.02, **options)
        return train_stage(X.copy(), y, 2, training, 0, "test", lambda share: None)

    stage = train(epochs=2, average_from=average_from)
    same = np.array_equal(stage.layers[0][0], train(epochs=2, average_from=1).layers[0][0])
    assert same == (average_from >= 1)
    long = train(epochs=30, average_from=average_from)
    assert (long.predict_proba(X.copy()).argmax(axis=1) == y).mean() > 0.95


@pytest.mark.parametrize("start", [0, 3])
def test_descriptions_are_standardised_by_all_rows(tube_rig, start):
    """More rows than are looked at at a time, means far from 0, and a column that hardly varies."""
    rng = np.random.default_rng(1)
    X = in_half_precision(rng.standard_normal((20000, 4)) * [1.0, 0.1, 3.0, 1e-5] + [0.0, 2.0, -5.0, 1.0])
    X[:9000] += np.float16(0.5)
    y = (X[:, 0] > 0.25).astype(int)
    training = Training(hidden=(4,), epochs=1)
    stage = train_stage(X[start:], y[start:], 2, training, 0, "test", lambda share: None)
    rows = X[start:].astype(float)
    np.testing.assert_allclose(stage.mean, rows.mean(axis=0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(stage.deviation, rows.std(axis=0), rtol=1e-3)
    near = X[:100].astype(np.float32) * (1 + 1e-5)  # what is the same in half precision is the same
    np.testing.assert_array_equal(stage.predict_proba(near), stage.predict_proba(X[:100].astype(np.float32)))
    still = train_stage(X[9000:], y[9000:], 2, training, 0, "test", lambda share: None)
    assert still.deviation[3] == 2.0**-10  # what varies by less than half precision tells is not made large


def test_what_the_network_sees_is_standardised(tube_rig, monkeypatch):
    seen = []
    monkeypatch.setattr("lbsfit_np.segmentation.stage._fit_chunk", lambda classifier, X, y, classes: seen.append(X))
    X = in_half_precision(np.random.default_rng(1).standard_normal((4000, 3)) * [0.01, 1.0, 30.0] + [2.0, 0.0, -50.0])
    y = (X[:, 0] > 2).astype(int)
    with pytest.raises(AttributeError):  # a network that has seen nothing has no weights
        train_stage(X, y, 2, Training(hidden=(4,), epochs=1), 0, "test", lambda share: None)
    assert abs(seen[0].mean(axis=0)).max() < 0.1 and abs(seen[0].std(axis=0) - 1).max() < 0.1


def test_one_scan_alone_is_learned(tube_rig, tube_scan):
    """What is the same for all its points, such as its covariance, does not vary, and is no less the same when it is labelled."""
    scans = Scans([(tube_scan.points, tube_scan.labels, 1.0)] * 6)
    s = train_segmenter(tube_rig, scans, 6, training=Training(second=0.0), random_state=0)
    assert (s.predict(tube_scan.points, views=1) == tube_scan.labels).mean() > 0.95  # no scan of the training was turned


def test_scans_in_a_wrong_unit_are_no_errors_of_arithmetic(tube_rig, tube_scan):
    scans = Scans([(p, y, 1e-5) for p, y, _ in scans_of(tube_rig, 4).scans])
    s = train_segmenter(tube_rig, scans, 4, training=Training(points_per_scan=20, epochs=1), random_state=0)
    assert np.isfinite(s.predict_proba(tube_scan.points)).all() and np.isfinite(s.predict_proba(1e6 * tube_scan.points)).all()


@pytest.mark.parametrize(
    "values",
    [
        {"points_per_scan": 0},
        {"points_per_scan": 1.5},
        {"epochs": 0},
        {"average_from": -1},
        {"hidden": ()},
        {"hidden": (64, 0)},
        {"hidden": 64},
        {"learning_rate": 0.0},
        {"second": 1.0},
        {"second": float("nan")},
    ],
)
def test_training_that_cannot_be(values):
    with pytest.raises(InputError) as error:
        Training(**values)
    assert error.value.argument == next(iter(values))


def test_fewer_points_than_chunks_are_learned(tube_rig, tube_scan):
    one = train_segmenter(tube_rig, scans_of(tube_rig, 1), 1, training=Training(points_per_scan=3, second=0.0), random_state=0)
    assert np.isfinite(one.predict_proba(tube_scan.points)).all()


def test_labels_may_be_bytes(tube_rig):
    few = scans_of(tube_rig, 2)
    short = Scans([(p, y.astype(np.uint8), k) for p, y, k in few.scans])
    one, two = (train_segmenter(tube_rig, s, 2, training=Training(points_per_scan=20), random_state=0) for s in (few, short))
    np.testing.assert_array_equal(one.stages[0].layers[0][0], two.stages[0].layers[0][0])


def test_scans_without_a_label_are_refused(tube_rig):
    scan = Scans([(p, np.full_like(y, -1), k) for p, y, k in scans_of(tube_rig, 2).scans])
    with pytest.raises(InputError, match="^scan: got scans without a point that has a label"):
        train_segmenter(tube_rig, scan, 2, training=Training(points_per_scan=20), random_state=0)


def test_what_training_cannot_begin_with(tube_rig, small_segmenter):
    for n in (0, -1, 2.0, True):
        with pytest.raises(InputError, match="n_scans: got .*; expected a whole number of at least 1"):
            train_segmenter(tube_rig, pytest.fail, n)
    for rig, options, words in (
        (in_parts(ONE), {}, "a segmenter of 4 parts; expected one of the rig's 1"),
        (replace(tube_rig, upper=1.1 * tube_rig.upper), {}, "a segmenter of another rig .*; expected one of rig 'tube'"),
        (tube_rig, {"training": Training(hidden=(7,))}, r"a segmenter with layers of \(.*; expected the training's \(7,\)"),
        (tube_rig, {"descriptor": Descriptor(voxel=0.1)}, "voxel=0.05.*; expected one with .*voxel=0.1"),
    ):
        with pytest.raises(InputError, match=f"start: got .*{words}"):
            train_segmenter(rig, pytest.fail, 4, start=small_segmenter, **options)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"rig": "hand"}, "rig: got 'hand'; expected a Rig. Read one with load_rig."),
        ({"scan": None}, "scan: got None; expected a function i → (points, labels, scale)."),
        ({"scan": [1, 2]}, "scan: got [1, 2]; expected a function"),
        ({"scan": lambda: None}, "scan: got one that takes other arguments (too many positional arguments); expected a function"),
        ({"training": {"epochs": 2}}, "training: got {'epochs': 2}; expected a Training, or None. Make one with Training(...)."),
        ({"training": {}}, "training: got {}; expected a Training"),
        ({"descriptor": {"voxel": 0.1}}, "descriptor: got {'voxel': 0.1}; expected a Descriptor, or None. Make one with Desc"),
        ({"start": "a"}, "start: got 'a'; expected a Segmenter, or None. Read one with Segmenter.load."),
        ({"progress": 3}, "progress: got 3; expected a function, or None."),
        ({"progress": lambda: None}, "progress: got one that takes other arguments"),
        ({"random_state": "a"}, "random_state: got 'a'; expected a non-negative integer"),
    ],
)
def test_what_no_training_can_be_made_of(tube_rig, given, words):
    with pytest.raises(InputError) as error:
        train_segmenter(**{"rig": tube_rig, "scan": pytest.fail, "n_scans": 4} | given)
    assert str(error.value).startswith(words)


def test_both_stages_are_trained_further(tube_rig, small_segmenter):
    """However few scans the second one's share is; unless it is to be left out."""
    few = {"points_per_scan": 20, "epochs": 1}
    for n, second, stages in ((2, 0.5, 2), (3, 0.1, 2), (1, 0.0, 1), (2, 0.0, 1)):
        scans = scans_of(tube_rig, n)
        training = Training(**few, second=second)
        s = train_segmenter(tube_rig, scans, n, training=training, random_state=0, start=small_segmenter)
        assert len(s.stages) == stages and scans.asked == list(range(n))
        for stage, before in zip(s.stages, small_segmenter.stages):
            np.testing.assert_array_equal(stage.mean, before.mean)
    with pytest.raises(InputError, match="n_scans: got 1 with a start of two stages; expected at least 2"):
        train_segmenter(tube_rig, pytest.fail, 1, random_state=0, start=small_segmenter)
    one = replace(small_segmenter, stages=small_segmenter.stages[:1])
    s = train_segmenter(tube_rig, scans_of(tube_rig, 1), 1, training=Training(**few), random_state=0, start=one)
    assert len(s.stages) == 1  # as many as from nothing


def test_a_segmenter_of_a_rig_with_seams_belongs_to_it(small_segmenter):
    """Trained on the rig as it is, from nothing or further."""
    rig = build_rig(seamed(make_tube_data(), [10, 100, 200]))
    assert rig.welded is not rig
    few = {"training": Training(points_per_scan=20, epochs=1), "random_state": 0}
    s = train_segmenter(rig, scans_of(rig, 2), 2, **few)
    s.check_rig(rig)
    train_segmenter(rig, scans_of(rig, 2), 2, start=s, **few).check_rig(rig)


def test_the_context_of_no_points_is_none():
    """As of a scan in which no point has a part."""
    around = np.random.default_rng(0).normal(size=(40, 3))
    none = context(np.zeros((0, 3)), np.zeros((0, 4)), around, np.full((40, 4), 0.25))
    one = context(around[:1], np.full((1, 4), 0.25), around, np.full((40, 4), 0.25))
    assert none.shape == (0, one.shape[1])


def _with_scale(scale, points, labels):
    return points, labels, scale


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda p, y: (p, y + 4), "labels from 4 to .* of scan 1; expected labels from 0 to 3, or −1"),
        (lambda p, y: (p, y - 2), "labels from -2 to "),
        (lambda p, y: (p, y.astype(float)), "float64 labels of shape .* of scan 1; .* n whole numbers"),
        (lambda p, y: (p[:-1], y), "points of shape .* of scan 1"),
        (lambda p, y: (p[:, :2], y), "points of shape .* of scan 1"),
        (lambda p, y: (np.where(p > 0, np.nan, p), y), "points that are NaN or infinite, of scan 1"),
        (lambda p, y: (p[:0], y[:0]), "no points of scan 1; expected one or more"),
        (lambda p, y: (p.tolist(), (y + 4).tolist()), "labels from 4 to .* of scan 1"),
        *((partial(_with_scale, s), f"the scale {s} of scan 1; .* positive number") for s in (0.0, -1, np.nan, None)),
    ],
)
def test_scans_that_cannot_be_learned_from_are_told_before_any_training(change, words, tube_rig, monkeypatch):
    monkeypatch.setattr("lbsfit_np.segmentation.segmenter.train_stage", None)
    scans = scans_of(tube_rig, 2).scans
    points, labels, scale = scans[1]
    scan = Scans([scans[0], (*change(points, labels), scale)[:3]])
    with pytest.raises(InputError, match=f"^scan: got .*{words}"):
        train_segmenter(tube_rig, scan, 2, training=Training(points_per_scan=20, second=0.0), random_state=0)
