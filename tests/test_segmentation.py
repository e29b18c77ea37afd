"""The segmenter: what its descriptors do not see, training by seed, files that run nothing, and the cache."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import sklearn
from small_rigs import make_tube_data, make_tube_rig

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.segmentation import cache
from lbsfit_np.segmentation import context as context_module
from lbsfit_np.segmentation.context import CONTEXT_POINTS, context, context_size
from lbsfit_np.segmentation.descriptors import Descriptor
from lbsfit_np.segmentation.segmenter import Segmenter, train_segmenter
from lbsfit_np.segmentation.stage import Stage, Training, train_stage
from lbsfit_np.synthesis import Synthesis, TrainingScans


@dataclass
class Scans:
    """i → scan i of a list, and which were asked for."""

    scans: list
    asked: list = field(default_factory=list)

    def __call__(self, i):
        self.asked.append(i)
        return self.scans[i]


def _scans(rig, n, seed=0, **settings):
    return Scans([(s.points, s.labels, 1.0) for s in lbs.synthesize(rig, n, random_state=seed, n_points=400, **settings)])


def _train(rig, seed=0, n=4, second=0.5, **options):
    training = Training(points_per_scan=60, second=second)
    return train_segmenter(rig, _scans(rig, n), n, training=training, random_state=seed, **options)


@pytest.fixture(scope="module")
def small(tube_rig):
    """A segmenter that knows little and trains fast."""
    return _train(tube_rig)


@pytest.fixture(scope="module")
def scan(tube_rig):
    return lbs.synthesize(tube_rig, 1, random_state=50)[0]


# ---- descriptors ----


def _describe(points, rig, **options):
    return Descriptor()(points / (rig.size / 2), **options)


def test_a_row_a_point(tube_rig, scan):
    found = _describe(scan.points, tube_rig)
    assert found.shape == (len(scan.points), Descriptor().size)
    assert np.isfinite(found).all()
    rows = np.array([5, 3, 900])
    np.testing.assert_array_equal(_describe(scan.points, tube_rig, rows=rows), found[rows])


def test_the_order_of_the_points_does_not_matter(tube_rig, scan):
    order = np.random.default_rng(0).permutation(len(scan.points))
    found = _describe(scan.points, tube_rig)
    np.testing.assert_allclose(_describe(scan.points[order], tube_rig), found[order], atol=1e-5)


@pytest.mark.parametrize("shift", [[0.5, 1.0, -1.5], [0.013, 0.2, -0.4], [100.0, -30.0, 7.0], [1e5, -2e5, 3e5]])
def test_where_the_scan_stands_does_not_matter(tube_rig, scan, shift):
    away = np.abs(_describe(scan.points + shift, tube_rig) - _describe(scan.points, tube_rig))
    assert away.max() < 1e-4


def test_the_description_has_a_unit(tube_rig, scan):
    """Half sizes of the rig: a scan in millimetres of a rig in metres is described the same."""
    in_mm = tube_rig.scaled(1000.0)
    np.testing.assert_allclose(_describe(1000 * scan.points, in_mm), _describe(scan.points, tube_rig), atol=1e-4)
    far = np.abs(_describe(1.3 * scan.points, tube_rig) - _describe(scan.points, tube_rig))
    assert far.max() > 0.1


def test_uneven_density_hardly_moves_the_centroid(tube_rig):
    """Half of the body at a third of the density: the mean of the points moves by far more than what s sees of it."""
    rng = np.random.default_rng(0)
    for s in lbs.synthesize(tube_rig, 3, random_state=3, n_points=8000, density=0.0, holes=0):
        y = s.points[:, 1]
        keep = rng.random(len(y)) < np.where(y > np.median(y), 1.0, 0.3)
        X = s.points / (tube_rig.size / 2)
        mean = np.linalg.norm(X.mean(axis=0) - X[keep].mean(axis=0))
        position = slice(-9, -6)
        seen = _describe(s.points, tube_rig)[keep, position] - _describe(s.points[keep], tube_rig)[:, position]
        assert mean > 0.1
        assert np.linalg.norm(seen.mean(axis=0)) < 0.4 * mean


def test_clutter_far_away_is_described_without_harm(tube_rig, scan):
    far = np.vstack([scan.points, [[50.0, 0.0, 0.0]]])
    found = _describe(far, tube_rig)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[:-1], _describe(scan.points, tube_rig), atol=1e-4)


@pytest.mark.parametrize("points", [[[0.0, 0, 0]], [[0.0, 0, 0], [0.0, 0, 0.1]], [[-9.0, 0, 0], [9.0, 0, 0]]])
def test_few_points_are_described_too(points):
    assert np.isfinite(Descriptor()(np.array(points))).all()


# ---- training ----


def test_it_learns_the_parts(tube_fitter, tube_rig):
    for s in lbs.synthesize(tube_rig, 3, random_state=77):
        proba = tube_fitter.segmenter_.predict_proba(s.points)
        assert proba.shape == (len(s.points), 4)
        np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-5)
        assert (proba >= 0).all()
        found = tube_fitter.segmenter_.predict(s.points)
        np.testing.assert_array_equal(found, proba.argmax(axis=1))
        assert (found == s.labels).mean() > 0.75


def test_a_seed_trains_the_same_segmenter(tube_rig, small, scan):
    np.testing.assert_array_equal(_train(tube_rig).predict_proba(scan.points), small.predict_proba(scan.points))
    assert not np.array_equal(_train(tube_rig, seed=1).predict_proba(scan.points), small.predict_proba(scan.points))


def test_training_leaves_its_scans_alone(tube_rig):
    scan = _scans(tube_rig, 2)
    kept = [(p.copy(), y.copy()) for p, y, _ in scan.scans]
    train_segmenter(tube_rig, scan, 2, training=Training(points_per_scan=20), random_state=0)
    for (p, y, _), (q, z) in zip(scan.scans, kept, strict=True):
        np.testing.assert_array_equal(p, q)
        np.testing.assert_array_equal(y, z)


def test_progress_goes_from_nothing_to_all(tube_rig):
    for rig, second in ((tube_rig, 0.5), (tube_rig, 0.0), (_in_parts(ONE), 0.5)):
        seen = []
        _train(rig, second=second, progress=seen.append)
        assert len(seen) > 1 and seen[0] > 0 and seen[-1] == pytest.approx(1.0)
        assert (np.diff(seen) >= -1e-12).all()


def test_processes_change_nothing(tube_rig, scan):
    """Enough scans that each of the two stages has a batch for each process."""
    scans = TrainingScans(tube_rig, Synthesis(n_points=120), 3)
    training = Training(points_per_scan=20, hidden=(16,))
    one, two = (train_segmenter(tube_rig, scans, 200, training=training, random_state=3, n_jobs=n) for n in (1, 2))
    for a, b in zip(one.stages, two.stages, strict=True):
        for name, array in a.arrays("s").items():
            np.testing.assert_array_equal(array, b.arrays("s")[name])
    np.testing.assert_array_equal(one.predict_proba(scan.points), two.predict_proba(scan.points))


@pytest.mark.parametrize("n_jobs", [0, True, 1.5, "2"])
def test_a_number_of_processes_that_cannot_be(tube_rig, n_jobs):
    with pytest.raises(InputError, match="n_jobs: got .*expected a positive whole number of processes"):
        _train(tube_rig, n_jobs=n_jobs)


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
    with pytest.raises(InputError, match=r"n_jobs: got a process that ended \(exit code 7\)"):
        train_segmenter(tube_rig, _dies, 200, random_state=0, n_jobs=2)


class Drawn:
    """Scans that a shared Generator draws, so that copies of it would draw the same ones twice."""

    def __init__(self, rig, rng):
        self.rig, self.rng = rig, rng

    def __call__(self, i):
        s = lbs.synthesize(self.rig, 1, random_state=self.rng, n_points=120)[0]
        return s.points, s.labels, 1.0


def test_a_generator_is_never_copied_into_processes(tube_rig, scan):
    training = Training(points_per_scan=20, hidden=(16,))

    def trained(n_jobs):
        rng = np.random.default_rng(3)
        return train_segmenter(tube_rig, Drawn(tube_rig, rng), 200, training=training, random_state=rng, n_jobs=n_jobs)

    np.testing.assert_array_equal(trained(1).predict_proba(scan.points), trained(2).predict_proba(scan.points))


# ---- interrupts ----


class Terminated(KeyboardInterrupt):
    """What a program's own handler of SIGTERM may raise."""


def _raise_terminated(signum, frame):
    raise Terminated


def _interrupting(monkeypatch, interrupt, at=3):
    """Have ``interrupt`` called in the middle of scikit-learn's ``partial_fit``, which catches KeyboardInterrupt."""
    from sklearn.neural_network import _multilayer_perceptron as mlp

    batches, calls = mlp.gen_batches, []

    def gen_batches(*args):
        calls.append(1)
        if len(calls) == at:
            interrupt()
        return batches(*args)

    monkeypatch.setattr(mlp, "gen_batches", gen_batches)
    return calls


@pytest.mark.filterwarnings("ignore:Training interrupted")
@pytest.mark.parametrize("number, raised", [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_ctrl_c_in_the_middle_of_training_is_no_segmenter(empty_cache, tube_rig, monkeypatch, number, raised):
    calls = _interrupting(monkeypatch, lambda: signal.raise_signal(number))
    before = signal.getsignal(number)
    mine = signal.default_int_handler if number == signal.SIGINT else _raise_terminated
    signal.signal(number, mine)
    try:
        with pytest.raises(raised):
            _cached("key", lambda: _train(tube_rig))
        assert signal.getsignal(number) is mine
    finally:
        signal.signal(number, before)
    assert len(calls) == 3  # it did not go on
    assert not cache._MEMORY and not (empty_cache.exists() and list(empty_cache.iterdir()))


@pytest.mark.filterwarnings("ignore:Training interrupted")
def test_an_interrupt_that_is_no_signal_passes_too(tube_rig, monkeypatch):
    """As in another thread, where no signal arrives."""

    def interrupt():
        raise KeyboardInterrupt

    calls, raised = _interrupting(monkeypatch, interrupt), []

    def work():
        try:
            _train(tube_rig)
        except KeyboardInterrupt as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert len(raised) == 1 and len(calls) == 3


@pytest.mark.filterwarnings("ignore:Training interrupted")
@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_training_from_a_start_is_interrupted_too(tube_rig, small, monkeypatch, at):
    def interrupt():
        raise KeyboardInterrupt

    calls = _interrupting(monkeypatch, interrupt, at)
    with pytest.raises(KeyboardInterrupt):
        _train(tube_rig, start=small)
    assert len(calls) == at


_SCRIPT = """
import lbsfit_np as lbs
from lbsfit_np.segmentation.segmenter import train_segmenter
from lbsfit_np.synthesis import Synthesis, TrainingScans

if __name__ == "__main__":
    rig = lbs.load_rig("hand")
    scans = TrainingScans(rig, Synthesis(), 0)
    train_segmenter(rig.welded, scans, 100_000, random_state=0, n_jobs=2, progress=lambda share: print("going", flush=True))
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_ends_the_processes_without_their_tracebacks(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(_SCRIPT)
    environment = os.environ | {"PYTHONPATH": str(Path(lbs.__file__).resolve().parents[1])}
    process = subprocess.Popen(
        [sys.executable, str(script)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # background jobs of a shell ignore it
    )
    assert process.stdout.readline() == "going\n"
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all processes
    _, said = process.communicate(timeout=120)  # its end means that no process holds the pipes any more
    assert said.count("Traceback") == 1 and said.rstrip().endswith("KeyboardInterrupt")


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
    same = np.array_equal(stage.classifier.coefs_[0], train(epochs=2, average_from=1).classifier.coefs_[0])
    assert same == (average_from >= 1)
    long = train(epochs=30, average_from=average_from)
    assert (long.predict_proba(X.copy()).argmax(axis=1) == y).mean() > 0.95


# ---- the two stages ----


def test_the_first_stage_sees_descriptors_and_the_second_their_context(tube_rig, small, scan):
    first, second = small.stages
    assert len(first.mean) == Descriptor().size
    assert len(second.mean) == Descriptor().size + context_size(4)
    X = scan.points / (tube_rig.size / 2)
    around = np.linspace(0, len(X) - 1, CONTEXT_POINTS).astype(int)
    own = small.descriptor(X)
    proba = first.predict_proba(own.copy())
    expected = second.predict_proba(np.hstack([own, context(X, proba, X[around], proba[around])]))
    np.testing.assert_allclose(small.predict_proba(scan.points), expected, atol=1e-5)
    assert np.abs(expected - proba).max() > 0.01


def test_the_second_stage_is_worth_its_while(tube_fitter, tube_rig):
    second = tube_fitter.segmenter_
    first = replace(second, stages=second.stages[:1])
    scans = lbs.synthesize(tube_rig, 8, random_state=78)
    right = [np.mean([(s.predict(scan.points) == scan.labels).mean() for scan in scans]) for s in (first, second)]
    assert right[1] > right[0] > 0.8


def test_the_second_stage_learns_from_scans_that_the_first_has_not_seen(tube_rig):
    def train(n, second):
        scans = _scans(tube_rig, 8)
        s = train_segmenter(tube_rig, scans, n, training=Training(points_per_scan=30, second=second), random_state=0)
        assert scans.asked == list(range(n))
        return s.stages

    both, alone = train(8, 0.25), train(6, 0.0)
    assert len(both) == 2 and len(alone) == 1
    for name, array in alone[0].arrays("s").items():
        np.testing.assert_array_equal(array, both[0].arrays("s")[name])


def test_without_a_second_stage_the_first_decides(tube_rig, scan, tmp_path):
    scans = _scans(tube_rig, 4)
    s = train_segmenter(tube_rig, scans, 4, training=Training(points_per_scan=60, second=0.0), random_state=0)
    assert len(s.stages) == 1 and scans.asked == [0, 1, 2, 3]
    expected = s.stages[0].predict_proba(_describe(scan.points, tube_rig))
    np.testing.assert_array_equal(s.predict_proba(scan.points), expected)
    s.save(tmp_path / "s.npz")
    again = Segmenter.load(tmp_path / "s.npz")
    assert len(again.stages) == 1
    np.testing.assert_array_equal(again.predict_proba(scan.points), expected)


def test_stages_have_to_fit_the_descriptor_and_each_other(small):
    first, second = small.stages
    for stages in ((), (second,), (first, first), (second, first), (first, second, second)):
        with pytest.raises(ValueError, match="stages that do not fit"):
            replace(small, stages=stages)


def test_a_stage_of_one_part_is_sure():
    X = np.random.default_rng(0).standard_normal((20, 3)).astype(np.float32)
    seen = []
    stage = train_stage(X, np.full(20, 2), 4, Training(), 0, "test", seen.append)
    assert stage.classifier is None and seen == [1.0]
    np.testing.assert_array_equal(stage.predict_proba(X[:5]), np.tile([0.0, 0, 1, 0], (5, 1)))
    again = Stage.from_arrays(stage.arrays("s"), "s", 4)
    np.testing.assert_array_equal(again.predict_proba(X[:5]), np.tile([0.0, 0, 1, 0], (5, 1)))


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


# ---- what it learns from, and for whom ----


@pytest.mark.parametrize(
    "points, options, words",
    [
        (np.full((5, 3), np.nan), {}, "points: got 5 points that are NaN"),
        (np.empty((0, 3)), {}, "points: got an empty set"),
        (np.zeros((5, 2)), {}, r"points: got shape \(5, 2\)"),
        ("abc", {}, "points: got str"),
        ([[10**400, 0, 0]], {}, "points: got .*double precision"),
        (np.eye(3), {"scale": 0.0}, "scale: got 0.0; expected a positive finite number"),
        (np.eye(3), {"scale": -1}, "scale"),
        (np.eye(3), {"scale": np.nan}, "scale"),
        (np.eye(3), {"scale": "2"}, "scale"),
        (np.eye(3), {"rows": [3]}, "rows: got numbers from 3 to 3; expected rows of the 3 points"),
        (np.eye(3), {"rows": [0.5]}, "rows: got float64"),
        (np.eye(3), {"rows": []}, r"rows: got .*shape \(0,\)"),
    ],
)
def test_points_that_cannot_be_labelled(small, points, options, words):
    for method in (small.predict, small.predict_proba):
        with pytest.raises(InputError, match=words):
            method(points, **options)


def test_a_scan_is_labelled_as_its_points_are(small, scan):
    np.testing.assert_array_equal(small.predict(lbs.Scan(scan.points)), small.predict(scan.points))


def test_predicting_leaves_the_points_alone(small, scan):
    kept = scan.points.copy()
    small.predict_proba(scan.points)
    np.testing.assert_array_equal(scan.points, kept)


def test_the_scans_scale_is_taken_out(small, scan):
    np.testing.assert_allclose(small.predict_proba(1000 * scan.points, scale=1000.0), small.predict_proba(scan.points), atol=2e-3)


def test_rows_are_a_choice_of_points(small, scan):
    rows = np.arange(0, 1000, 7)
    one = replace(small, stages=small.stages[:1])
    for s, atol in ((one, 1e-6), (small, 1e-5)):  # single precision; the second stage adds its rounding to the first's
        np.testing.assert_allclose(s.predict_proba(scan.points, rows=rows), s.predict_proba(scan.points)[rows], atol=atol)


def _in_parts(parts):
    return build_rig(replace(make_tube_data(), partitions={"few": parts}), parts="few")


ONE = {"all": ("root",)}
TWO = {"arm": ("root",), "fingers": ("long", "short")}


@pytest.mark.parametrize("parts", [ONE, TWO])
def test_rigs_of_one_and_two_parts(tmp_path, parts, scan):
    rig = _in_parts(parts)
    assert rig.parts == tuple(parts)
    s = _train(rig)
    assert len(s.stages) == len(parts)  # of a single part there is nothing to say in context
    proba = s.predict_proba(scan.points)
    assert proba.shape == (len(scan.points), len(parts))
    np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-5)
    s.save(tmp_path / "s.npz")
    np.testing.assert_array_equal(Segmenter.load(tmp_path / "s.npz").predict_proba(scan.points), proba)


def test_a_part_that_no_scan_shows_is_never_found(tube_rig, scan):
    scans = Scans([(p[y != 1], y[y != 1], 1.0) for p, y, _ in _scans(tube_rig, 8).scans])
    proba = train_segmenter(tube_rig, scans, 8, training=Training(points_per_scan=20), random_state=0).predict_proba(scan.points)
    assert proba.shape == (len(scan.points), 4)
    assert (proba[:, 1] == 0).all() and (proba[:, [0, 2, 3]].max(axis=0) > 0).all()


def test_it_belongs_to_one_rig(small, tube_rig):
    small.check_rig(tube_rig)
    small.check_rig(make_tube_rig())
    data = make_tube_data()
    others = [
        tube_rig.with_parts("arm and fingers"),
        tube_rig.scaled(2.0),
        build_rig(replace(data, upper=data.upper + 0.1)),
        build_rig(replace(data, vertices=data.vertices * [1, 1, 1.1])),
    ]
    for other in others:
        with pytest.raises(InputError, match="segmenter: got one that was trained on another rig.*pretrain"):
            small.check_rig(other)


# ---- files ----


@pytest.fixture
def saved(small, tmp_path):
    small.save(tmp_path / "s.npz")
    return tmp_path / "s.npz"


def _arrays(path):
    with np.load(path, allow_pickle=False) as z:
        return {k: z[k] for k in z.files}


def test_loaded_is_bit_equal(small, saved, scan):
    again = Segmenter.load(saved)
    np.testing.assert_array_equal(again.predict_proba(scan.points), small.predict_proba(scan.points))
    assert (again.rig_digest, again.n_parts, again.half, again.descriptor) == (
        small.rig_digest,
        small.n_parts,
        small.half,
        small.descriptor,
    )


def test_the_file_holds_numbers_and_text_only(saved):
    arrays = _arrays(saved)  # allow_pickle=False: an object array would raise
    assert {a.dtype.kind for a in arrays.values()} <= set("fiuU")
    with zipfile.ZipFile(saved) as z:
        assert all(name.endswith(".npy") for name in z.namelist())
    json.loads(str(arrays["lbsfit_np_segmenter"]))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_one_clear_error(saved, share):
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileError) as error:
        Segmenter.load(saved)
    assert "s.npz" in str(error.value) and "expected" in str(error.value)


def _rewritten(path, **changes):
    arrays = {**_arrays(path), **changes}
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


@pytest.mark.parametrize(
    "changes",
    [
        {"stage_0_mean": None},
        {"stage_0_deviation": None},
        {"stage_0_classes": None},
        {"stage_0_only": None},
        {"stage_0_intercepts_0": None},
        {"stage_0_coefs_1": None},
        {"stage_1_mean": None},
        {"stage_1_classes": None},
        {"stage_1_intercepts_2": None},
        {"lbsfit_np_segmenter": None},
        {"lbsfit_np_segmenter": np.array("{")},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 1}))},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 999}))},
        {"lbsfit_np_segmenter": np.array(json.dumps({"format": 2}))},
        {"lbsfit_np_segmenter": np.array(json.dumps([2]))},
        {"lbsfit_np_segmenter": np.array("[" * 100_000)},
        {"lbsfit_np_segmenter": np.array("2")},
        {"lbsfit_np_segmenter": np.zeros(3)},
        {"stage_0_mean": np.array([{"an": "object"}], dtype=object)},
    ],
)
def test_a_file_that_lacks_something_is_one_clear_error(saved, changes):
    _rewritten(saved, **changes)
    with pytest.raises(FileError, match=r"s\.npz"):
        Segmenter.load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"stage_0_mean": np.zeros(3, np.float32)},
        {"stage_0_mean": np.float32(0)},
        {"stage_0_classes": np.array([0, 1, 2, 9])},
        {"stage_0_classes": np.array([0, 1])},
        {"stage_0_classes": np.array([0.0, 1, 2, 3])},
        {"stage_0_coefs_0": np.zeros((4, 4), np.float32)},
        {"stage_0_coefs_0": np.zeros(4, np.float32)},
        {"stage_1_mean": np.zeros(3, np.float32)},
        {"stage_1_classes": np.array([-1, 1, 2, 3])},
        {"stage_1_coefs_0": np.zeros((4, 4), np.float32)},
        {"stage_1_intercepts_1": np.zeros(3, np.float32)},
    ],
)
def test_arrays_that_do_not_fit_together_are_one_clear_error(saved, changes):
    _rewritten(saved, **changes)
    with pytest.raises(FileError, match=r"s\.npz"):
        Segmenter.load(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"stages": 0},
        {"stages": 3},
        {"stages": "many"},
        {"n_parts": 3},
        {"n_parts": 5},
        {"n_parts": None},
        {"half": "long"},
        {"descriptor": {"n_probes": 3}},
        {"descriptor": {"n_probes": "3"}},
        {"descriptor": {"wobble": 3}},
        {"descriptor": 5},
    ],
)
def test_a_header_that_does_not_fit_is_one_clear_error(saved, changes):
    header = json.loads(str(_arrays(saved)["lbsfit_np_segmenter"]))
    _rewritten(saved, lbsfit_np_segmenter=np.array(json.dumps(header | changes)))
    with pytest.raises(FileError, match=r"s\.npz.*saved with Segmenter.save.*Train it again"):
        Segmenter.load(saved)


def test_other_files_are_one_clear_error(tmp_path, tube_rig):
    with pytest.raises(FileError, match="no such file"):
        Segmenter.load(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("not a zip")
    np.save(tmp_path / "array.npy", np.zeros(3))
    tube_rig.save(tmp_path / "rig.npz")
    for name in ("text.npz", "array.npy", "rig.npz"):
        with pytest.raises(FileError, match=name.replace(".", r"\.")):
            Segmenter.load(tmp_path / name)


def test_nothing_in_a_file_is_run(saved, tmp_path):
    """A pickle in the place of an array must not be opened, let alone run."""
    import pickle

    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("sprung").touch, ())

    trap = io.BytesIO()
    np.lib.format.write_array(trap, np.array([Trap()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(saved) as z:
        members = {n: z.read(n) for n in z.namelist()}
    assert "stage_0_mean.npy" in members
    members["stage_0_mean.npy"] = trap.getvalue()
    with zipfile.ZipFile(saved, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError):
        Segmenter.load(saved)
    saved.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(FileError):
        Segmenter.load(saved)
    assert not (tmp_path / "sprung").exists()


# ---- the cache ----


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(cache, "_MEMORY", {})
    return tmp_path / "cache"


def _cached(key, train):
    return cache.cached("segmenter", key, train, Segmenter.load)


class Trainer:
    """Trains nothing, and counts how often it was asked to."""

    def __init__(self, segmenter):
        self.segmenter, self.calls = segmenter, 0

    def __call__(self):
        self.calls += 1
        return self.segmenter


def test_the_cache_trains_once(empty_cache, small, scan):
    train = Trainer(small)
    first = _cached(("a", 1), train)
    assert _cached(("a", 1), train) is first and train.calls == 1
    assert len(list(empty_cache.iterdir())) == 1
    cache._MEMORY.clear()  # another process
    again = _cached(("a", 1), train)
    assert train.calls == 1
    np.testing.assert_array_equal(again.predict_proba(scan.points), small.predict_proba(scan.points))
    _cached(("a", 2), train)
    assert train.calls == 2
    assert len(list(empty_cache.iterdir())) == 2


def test_kinds_are_kept_apart(empty_cache, small):
    train = Trainer(small)
    _cached("key", train)
    assert cache.cached("library", "key", train, Segmenter.load) is small and train.calls == 2
    assert sorted(p.name.partition("-")[0] for p in empty_cache.iterdir()) == ["library", "segmenter"]


@pytest.mark.parametrize(
    "place, name, value",
    [
        (cache, "RECIPE", cache.RECIPE + 1),
        (cache, "__version__", "another"),
        (sklearn, "__version__", "another"),
        (context_module, "CONTEXT_POINTS", 700),
        (context_module, "NEAR", 7),
        (context_module, "WIDE", 31),
    ],
)
def test_another_recipe_is_another_segmenter(empty_cache, small, monkeypatch, place, name, value):
    train = Trainer(small)
    _cached("key", train)
    monkeypatch.setattr(place, name, value)
    _cached("key", train)
    assert train.calls == 2 and len(list(empty_cache.iterdir())) == 2


def test_the_folder_is_the_users_to_choose(monkeypatch, tmp_path):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "mine"))
    assert cache.cache_folder() == tmp_path / "mine"
    monkeypatch.delenv("LBSFIT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "lbsfit_np"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / ".cache" / "lbsfit_np"


@pytest.mark.parametrize("broken", [b"", b"not a zip"])
def test_a_broken_file_in_the_cache_is_trained_again(empty_cache, small, broken):
    train = Trainer(small)
    _cached("key", train)
    (file,) = empty_cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(broken)
    cache._MEMORY.clear()
    _cached("key", train)
    assert train.calls == 2
    assert file.read_bytes() == whole


def test_a_cache_that_cannot_be_made_is_no_error(empty_cache, small):
    empty_cache.write_text("a file where the folder should be")
    train = Trainer(small)
    assert _cached("key", train) is small
    assert _cached("key", train) is small and train.calls == 1


def test_a_cache_that_cannot_be_written_to_is_no_error(empty_cache, small, monkeypatch):
    import os

    empty_cache.mkdir()

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    assert _cached("key", Trainer(small)) is small


def test_pretraining_uses_the_cache_when_asked(empty_cache, tube_rig, scan):
    def fitter(**changes):
        return lbs.LBSFitter(tube_rig, **{"training_scans": 2, "training": {"n_points": 200}, "random_state": 0, **changes})

    a = fitter().pretrain(cache=True)
    assert len(list(empty_cache.glob("segmenter-*.npz"))) == len(list(empty_cache.glob("library-*.npz"))) == 1
    cache._MEMORY.clear()

    def no_progress(share):
        raise AssertionError("trained again")

    b = fitter().pretrain(cache=True, progress=no_progress)
    np.testing.assert_array_equal(a.segmenter_.predict_proba(scan.points), b.segmenter_.predict_proba(scan.points))
    for changes in ({"random_state": 1}, {"training_scans": 3}, {"training": {"n_points": 300}}):
        with pytest.raises(AssertionError, match="trained again"):
            fitter(**changes).pretrain(cache=True, progress=no_progress)
    with pytest.raises(AssertionError, match="trained again"):
        lbs.LBSFitter(
            tube_rig.with_parts("arm and fingers"), training_scans=2, training={"n_points": 200}, random_state=0
        ).pretrain(cache=True, progress=no_progress)
    with pytest.raises(AssertionError, match="trained again"):
        fitter().pretrain(progress=no_progress)
