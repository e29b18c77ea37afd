"""Learning that was stopped goes on from what its checkpoint has, does nothing twice, and comes to the same end."""

import time
import warnings
from contextlib import nullcontext, suppress
from dataclasses import replace

import numpy as np
import pytest
from learning_runs import learning_is_hurried

from lbsfit_np.errors import InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.learning import finish, free_form, loop
from lbsfit_np.learning.checkpoint import Checkpoint

WORK = {"FirstFit": loop, "Template": loop, "Pose": loop, "Told": loop, "Drawn": loop, "_Finish": finish, "_FreeForm": free_form}


pytestmark = pytest.mark.usefixtures("hurried_learning")


@pytest.fixture
def done(monkeypatch):
    """How often each kind of work was done, in this process."""
    counts = dict.fromkeys((*WORK, "train_segmenter", "build_library"), 0)

    def counted(owner, name, key):
        call = getattr(owner, name)

        def counting(*given, **more):
            found = call(*given, **more)
            counts[key] += 1
            return found

        monkeypatch.setattr(owner, name, counting)

    for name, module in WORK.items():
        counted(getattr(module, name), "__call__", name)
    for name in ("train_segmenter", "build_library"):
        counted(loop, name, name)
    return counts


@pytest.fixture(scope="module")
def points(few_scans):
    return [s.points[::2] for s in few_scans[:4]]


@pytest.fixture(scope="module")
def uninterrupted(make_learner, points):
    return make_learner().fit(points)


def _assert_same(found, expected):
    for a, b in zip(found.results_, expected.results_, strict=True):
        for name in ("pose", "vertices", "joints", "offsets", "labels", "confidence"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert (a.terms, a.message, a.model_digest) == (b.terms, b.message, b.model_digest)
    assert found.roles_ == expected.roles_ and found.unit_ == expected.unit_
    assert _figures(found) == _figures(expected)


def _figures(fitter):
    return [{k: v for k, v in entry.items() if k != "seconds"} for entry in fitter.history_]


def _stop_at(stage, share):
    def progress(now, done, figures=None):
        if now == stage and done >= share:
            raise KeyboardInterrupt

    return progress


_POSED = _stop_at("poses of scans", 0.8)  # they have all been looked for


def test_a_run_that_is_stopped_again_and_again_does_nothing_twice(make_learner, points, uninterrupted, done, tmp_path):
    n = len(points)
    for stage, share, so_far in (
        ("first fits", 0.3, {"FirstFit": 2}),
        ("first fits", 1.0, {"FirstFit": n}),
        ("templates", 1.0, {"Template": 1}),
        ("library of starts", 1.0, {"train_segmenter": 1}),
        ("poses of scans", 0.6, {"build_library": 1, "Pose": 3}),
        ("poses of scans", 0.85, {"Pose": n, "Told": 2}),
        ("poses of scans", 0.95, {"Told": n, "Drawn": 2}),
        ("templates and poses in turn", 0.2, {"Drawn": n, "Template": 2}),
        ("templates and poses in turn", 0.75, {"Drawn": 2 * n, "Template": 3, "Told": 2 * n + 2}),
        ("results", 0.5, {"Pose": n, "_Finish": 2}),
    ):
        with pytest.raises(KeyboardInterrupt):
            make_learner().fit(points, checkpoint=tmp_path / "kept", progress=_stop_at(stage, share))
        assert {key: done[key] for key in so_far} == so_far, stage
    found = make_learner().fit(points, checkpoint=tmp_path / "kept")
    once, turns = {"train_segmenter": 1, "build_library": 1}, {"Template": 3, "Told": 3 * n, "Drawn": 3 * n}
    assert done == {"FirstFit": n, "Pose": n, "_Finish": n, "_FreeForm": 0} | once | turns
    _assert_same(found, uninterrupted)
    before = dict(done)
    again = make_learner().fit(points, checkpoint=tmp_path / "kept")  # a second time nothing is left to do
    assert done == before and again.history_ == found.history_
    _assert_same(again, uninterrupted)


@pytest.mark.slow
def test_what_was_made_without_a_subject_is_not_taken_with_it(make_learner, points, tmp_path, monkeypatch):
    """One whose template could not be found once, for want of memory."""
    call, whose = loop.Template.__call__, [0, 1, 0, 0]

    def careless(self, task):
        if len(task[0]) == 1:
            raise MemoryError("no room")
        return call(self, task)

    learner = make_learner(variant="cd")
    monkeypatch.setattr(loop.Template, "__call__", careless)
    with pytest.raises(KeyboardInterrupt):
        learner.fit(points, whose, checkpoint=tmp_path, progress=_stop_at("poses of scans", 0.1))
    monkeypatch.undo()
    found = make_learner(variant="cd").fit(points, whose, checkpoint=tmp_path)
    _assert_same(found, make_learner(variant="cd").fit(points, whose))


@pytest.mark.slow
def test_a_library_made_beside_the_segmenter_is_kept_as_soon_as_it_is_there(make_learner, points, tmp_path, monkeypatch):
    def stopped(*given, **more):
        until = time.monotonic() + 120
        while not (there := list(tmp_path.glob("round-1-library-*.npz"))) and time.monotonic() < until:
            time.sleep(0.05)
        raise KeyboardInterrupt(len(there))

    with pytest.raises(KeyboardInterrupt):  # in this process, as others know nothing of a hurry
        make_learner().fit(points, checkpoint=tmp_path, progress=_stop_at("templates", 1.0))
    monkeypatch.setattr("lbsfit_np.learning.loop.train_segmenter", stopped)
    with pytest.raises(KeyboardInterrupt, match="1"):
        make_learner(n_jobs=2).fit(points, checkpoint=tmp_path)
    monkeypatch.undo()
    monkeypatch.setattr("lbsfit_np.learning.loop.build_library", lambda *given, **more: 1 / 0)  # not made again
    with pytest.raises(KeyboardInterrupt):
        make_learner().fit(points, checkpoint=tmp_path, progress=_stop_at("labels", 0.0))


@pytest.mark.slow
def test_what_suits_other_scans_and_settings_is_taken_and_nothing_else(
    make_learner, few_scans, points, done, tmp_path, monkeypatch
):
    learning_is_hurried(monkeypatch, turns=0)
    points, other = points[:3], few_scans[4].points[::2]
    make_learner(variant="cd").fit(points, checkpoint=tmp_path)

    def anew(scans=points, subjects=None, stop=_POSED, **parameters):
        """(First fits, poses) that are made; what comes after these is not waited for."""
        done.update(dict.fromkeys(done, 0))
        with warnings.catch_warnings(), suppress(KeyboardInterrupt):
            warnings.simplefilter("ignore")
            make_learner(**({"variant": "cd"} | parameters)).fit(scans, subjects, checkpoint=tmp_path, progress=stop)
        return done["FirstFit"], done["Pose"]

    def first_fits(scans=points, **parameters):
        return anew(scans, stop=_stop_at("first fits", 1.0), **parameters)[0]

    n = len(points)
    assert anew(stop=None) == (0, 0)
    assert anew(stop=None, n_jobs=1, rounds=2, held_out=0.1) == (0, n * (done["Template"] > 0))  # another round, if it is made
    assert anew([*points, other]) == (1, n + 1)  # of a larger collection the first fits are known
    assert anew(held_out=0) == (0, n) and anew(subjects=list("aab")) == (0, n)
    assert first_fits(points[::-1]) == 0 and anew(sequence=True) == (0, n)
    assert first_fits(random_state=1) == first_fits(max_points=150) == first_fits(joints="fixed") == n
    assert first_fits([p + 1e-9 for p in points]) == n
    assert first_fits([*points, other], max_points=150) == 1
    assert first_fits([other, *points], max_points=150) == n + 1  # points are drawn by the scans' numbers


@pytest.mark.slow
def test_variants_have_first_fits_in_common_and_nothing_else(make_learner, points, uninterrupted, done, tmp_path):
    """Where all of them begin with labels; results are as without the others."""
    n = len(points)
    for variant, first, poses in (("rand", n, n), ("joint", 0, n), ("cd", n, n)):
        done.update(dict.fromkeys(done, 0))
        checkpoint = Checkpoint(tmp_path / "own", first_fits=tmp_path / "common") if variant != "cd" else tmp_path / "common"
        stop = None if variant == "joint" else _POSED  # the others' results are not asked for
        with pytest.raises(KeyboardInterrupt) if stop else nullcontext():
            found = make_learner(variant=variant).fit(points, checkpoint=checkpoint, progress=stop)
        assert (done["FirstFit"], done["Pose"]) == (first, poses), variant
        if variant == "joint":
            _assert_same(found, uninterrupted)
    assert {path.name[:6] for path in (tmp_path / "own").iterdir()} == {"result", "round-"}


@pytest.mark.parametrize(
    "changes",
    [
        {"up": "+x"},
        {"forward": "+x"},
        {"metres_per_unit": 0.5},
        {"locked": [0, 0, 1, 0]},
        {"poses": {}},
        {"partitions": {"two": {"fingers": ("long", "short"), "arm": ("root", "elbow")}}},  # in another order
    ],
)
def test_what_a_card_changes_of_a_rig_counts(changes, tube_rig, make_learner, tmp_path):
    two = {"two": {"arm": ("root", "elbow"), "fingers": ("long", "short")}}
    rig = replace(tube_rig, poses={"rest": np.zeros((4, 3))}, partitions=two, granularity="two")
    if "locked" in changes:
        changes = {"locked": np.array(changes["locked"], dtype=bool)}

    def slot(rig):
        return Checkpoint(tmp_path).narrowed(make_learner().set_params(rig=rig)._made_of(0)).slot("first-fit")

    slot(rig).keep(1)
    assert slot(replace(rig)).known() == 1 and slot(replace(rig, **changes)).known() is None


def test_another_state_of_the_code_finds_nothing(make_learner, points, done, tmp_path, monkeypatch):
    make_learner(variant="free-form").fit(points, checkpoint=tmp_path)
    assert done["_FreeForm"] == len(points)
    make_learner(variant="free-form").fit(points, checkpoint=tmp_path)
    assert done["_FreeForm"] == len(points)
    monkeypatch.setattr("lbsfit_np.learning.checkpoint.state_of_the_code", lambda: "another")
    make_learner(variant="free-form").fit(points, checkpoint=tmp_path)
    assert done["_FreeForm"] == 2 * len(points)


def test_free_form_fits_are_kept_whole(make_learner, points, tmp_path):
    expected = make_learner(variant="free-form").fit(points)
    with pytest.raises(KeyboardInterrupt):
        stop = _stop_at("free-form fits", 0.5)
        make_learner(variant="free-form").fit(points, checkpoint=tmp_path, progress=stop)
    found = make_learner(variant="free-form").fit(points, checkpoint=tmp_path)
    assert [type(r) for r in found.results_] == [FitResult] * len(points)
    _assert_same(found, expected)


@pytest.mark.slow
def test_a_fit_that_fails_is_tried_again(make_learner, points, done, tmp_path, monkeypatch):
    call = loop.FirstFit.__call__

    def failing(self, given):
        if np.array_equal(given[0], points[1]):
            raise InputError("points", "bad luck", "good")
        return call(self, given)

    with monkeypatch.context() as patch, pytest.warns(UserWarning, match="bad luck"):
        patch.setattr(loop.FirstFit, "__call__", failing)
        make_learner(variant="cd").fit(points, checkpoint=tmp_path)
    assert done["FirstFit"] == len(points) - 1
    assert make_learner(variant="cd").fit(points, checkpoint=tmp_path).failures_ == {}
    assert done["FirstFit"] == len(points)


@pytest.mark.slow
def test_what_followed_from_a_fit_that_failed_is_not_taken(make_learner, points, tmp_path, monkeypatch):
    """Templates and poses of the second round of a run that had lost a scan in the first."""
    learning_is_hurried(monkeypatch, turns=0)
    points = points[:3]
    parameters = {"variant": "cd", "rounds": 2, "held_out": 0}
    expected, call, failed = make_learner(**parameters).fit(points), loop.Pose.__call__, []

    def failing_once(self, task):
        if not failed:
            failed.append(task)
            raise InputError("points", "bad luck", "good")
        return call(self, task)

    with monkeypatch.context() as patch, pytest.warns(UserWarning, match="bad luck"):
        patch.setattr(loop.Pose, "__call__", failing_once)
        assert make_learner(**parameters).fit(points, checkpoint=tmp_path).results_[0] is None
    _assert_same(make_learner(**parameters).fit(points, checkpoint=tmp_path), expected)


@pytest.mark.slow
def test_what_followed_from_labels_that_failed_is_not_taken(make_learner, points, uninterrupted, tmp_path, monkeypatch):
    """A library and poses of a round that had lost a scan among its labels."""
    call, failed = loop.Labels.__call__, []

    def failing_once(self, task):
        if not failed:
            failed.append(task)
            raise MemoryError("for once")
        return call(self, task)

    with monkeypatch.context() as patch, pytest.warns(UserWarning, match="for once"):
        patch.setattr(loop.Labels, "__call__", failing_once)
        assert make_learner().fit(points, checkpoint=tmp_path).results_[0] is None
    _assert_same(make_learner().fit(points, checkpoint=tmp_path), uninterrupted)


@pytest.mark.slow
def test_stopped_in_the_second_round_labels_are_those_of_the_segmenter_that_is_kept(
    make_learner, points, done, tmp_path, monkeypatch
):
    learning_is_hurried(monkeypatch, turns=0)
    points, parameters, rounds = points[:2], {"rounds": 2, "held_out": 0}, []
    expected = make_learner(**parameters).fit(points)

    def stop(now, share, figures=None):
        rounds.extend([now] * (now == "library of starts" and share == 1))
        if len(rounds) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_learner(**parameters).fit(points, checkpoint=tmp_path, progress=stop)
    done.update(dict.fromkeys(done, 0))
    _assert_same(make_learner(**parameters).fit(points, checkpoint=tmp_path), expected)
    assert (done["FirstFit"], done["train_segmenter"], done["build_library"], done["Pose"]) == (0, 0, 1, len(points))


@pytest.mark.slow
def test_poses_drawn_to_what_fewer_scans_told_are_not_taken(make_learner, points, uninterrupted, tmp_path, monkeypatch):
    """Those of a round that had lost a scan once its poses were found, before what all tell was known."""
    call, failed = loop.Told.__call__, []

    def failing_once(self, task):
        if task[-1] and not failed:
            failed.append(task)
            raise MemoryError("for once")
        return call(self, task)

    with monkeypatch.context() as patch, pytest.warns(UserWarning, match="for once"):
        patch.setattr(loop.Told, "__call__", failing_once)
        assert None in make_learner().fit(points, checkpoint=tmp_path).results_
    _assert_same(make_learner().fit(points, checkpoint=tmp_path), uninterrupted)
