"""Scans, templates and turns that fail while learning goes on: what is left out, what is lost, and what stays."""

import shutil
import signal
import types
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from learning_runs import FEWER, collected, learning_is_hurried
from slow_tests import slow
from worker_tasks import ends_at_1, inverse, kills_itself, two_words_at_1

import lbsfit_np as lbs
from lbsfit_np.errors import InputError, Unforeseen
from lbsfit_np.learning import finish, first_fits, free_form, tasks
from lbsfit_np.learning.collection import Collection, Member
from lbsfit_np.learning.loop import LoopSettings
from lbsfit_np.learning.variants import VARIANTS

pytestmark = pytest.mark.usefixtures("hurried_learning")

# Without a segmenter, learning takes a second or two.
QUICK = {"effort": "fast", "training_scans": 40, "training": {"n_points": 200}, "rounds": 1, "random_state": 0, "variant": "cd"}


@pytest.fixture(scope="module")
def clouds(tube_rig):
    return [s.points for s in lbs.synthesize(tube_rig, 4, random_state=1, n_points=400)]


@pytest.fixture
def no_turns(monkeypatch):
    """For tests of what comes before templates and poses are found in turn, or after it."""
    learning_is_hurried(monkeypatch, turns=0)


def _failing(monkeypatch, module, name, bad):
    """Have a step of the loop fail for the scan ``bad``, of a number of points of its own."""
    step = getattr(module, name)
    call = step.__call__

    def careless(self, task):
        given = task if isinstance(task, tuple) else (task,)
        sizes = [len(getattr(x, "points", getattr(x, "X", x))) for x in given if hasattr(x, "points") or hasattr(x, "X")]
        sizes += [len(x) for x in given if isinstance(x, np.ndarray) and x.ndim == 2]
        if bad in sizes:
            raise ZeroDivisionError("nobody foresaw this")
        return call(self, task)

    monkeypatch.setattr(step, "__call__", careless)


@pytest.mark.usefixtures("no_turns")
@pytest.mark.parametrize("module, name", [(first_fits, "FirstFit"), (tasks, "Pose"), (finish, "_Finish")])
def test_a_scan_that_fails_on_the_way_is_left_out_of_the_rest(module, name, tube_rig, clouds, monkeypatch):
    _failing(monkeypatch, module, name, 399)
    given = [clouds[0], clouds[1][:399], *clouds[2:]]
    words = "ZeroDivisionError: nobody foresaw this"
    if module is finish:  # by then the scan has had its part in learning
        words = f"held out of learning, but it has no result: {words}"
    with pytest.warns(UserWarning, match=f"1 of 4 scans cannot be used; scan 1: {words}"):
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit(given)
    assert fitter.failures_ == {1: words}
    assert [r is None for r in fitter.results_] == [False, True, False, False]
    assert fitter.roles_[1] == ("held out of learning" if module is finish else None)
    others = [fitter.roles_[k] for k in (0, 2, 3)]  # another is held out where the one that was fails before the rounds
    assert others.count("held out of learning") == (name == "FirstFit") and None not in others
    assert fitter.fit_scan(clouds[0]).status != "failed"


@pytest.mark.usefixtures("no_turns")
def test_where_only_what_was_held_out_is_left_it_is_learned_from(tube_rig, clouds, monkeypatch):
    held = [m.role for m in collected(tube_rig, clouds[:3]).members].index("held out of learning")
    given = [cloud if k == held else cloud[:399] for k, cloud in enumerate(clouds[:3])]
    assert [m.role for m in collected(tube_rig, given).members].index("held out of learning") == held
    _failing(monkeypatch, first_fits, "FirstFit", 399)
    with pytest.warns(UserWarning, match="2 of 3 scans cannot be used"):
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit(given)
    assert [fitter.roles_[k] for k in range(3)] == ["learned from" if k == held else None for k in range(3)]
    assert all(np.isfinite(entry["recon"]) and entry["recon_held_out"] is None for entry in fitter.history_)


@pytest.mark.usefixtures("no_turns")
def test_a_round_that_loses_all_that_it_learned_from_says_so(tube_rig, clouds, monkeypatch, tmp_path):
    held = [m.role for m in collected(tube_rig, clouds[:3]).members].index("held out of learning")
    _failing(monkeypatch, tasks, "Pose", 399)
    given = [cloud if k == held else cloud[:399] for k, cloud in enumerate(clouds[:3])]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitter = lbs.LBSFitter(tube_rig, **QUICK | {"rounds": 2}).fit(given)
    words = "none of the scans learned from could be fitted in round 1: do not trust what was learned; failures_ will say why"
    assert [str(w.message) for w in told].count(words) == 1 and not any(w.category is RuntimeWarning for w in told)
    first, *rounds = fitter.history_
    assert first["recon"] > 0 and all(entry["recon"] is None and entry["recon_held_out"] > 0 for entry in rounds)
    fitter.save(tmp_path / "m.npz")
    assert lbs.LBSFitter.load(tmp_path / "m.npz").history_ == fitter.history_


def test_free_form_fits_that_fail_are_left_out(tube_rig, clouds, monkeypatch):
    _failing(monkeypatch, free_form, "_FreeForm", 399)
    with pytest.warns(UserWarning, match="scan 0: ZeroDivisionError"):
        fitter = lbs.LBSFitter(tube_rig, **QUICK | {"variant": "free-form"}).fit([clouds[0][:399], *clouds[1:]])
    assert list(fitter.failures_) == [0] and fitter.results_[0] is None and fitter.results_[3].status != "failed"
    with pytest.warns(UserWarning, match="nothing is learned for subject 'b'"):
        fitter.fit([clouds[0][:399], *clouds[1:]], list("baaa"))
    assert list(fitter.template_) == list(fitter.unit_) == ["a"]


def test_free_form_fits_that_are_stopped_leave_the_fitter_as_it_was(tube_rig, clouds, monkeypatch):
    fitter = lbs.LBSFitter(tube_rig, **QUICK | {"variant": "free-form"}).fit(clouds[:2])
    before = fitter.results_

    def interrupted(*given, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.learning.fitter.fit_free_form", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fitter.fit([*clouds[:3], clouds[0][:2]], ["a", "a", "b", "b"])
    assert fitter.results_ is before and fitter.roles_ == ["learned from"] * 2 and list(fitter.template_) == [0]


@pytest.mark.slow
@pytest.mark.usefixtures("no_turns")
def test_a_subject_whose_scans_all_fail_is_no_part_of_the_model(tube_rig, clouds, monkeypatch, tmp_path):
    _failing(monkeypatch, tasks, "Pose", 399)
    with pytest.warns(UserWarning, match="scan 1: ZeroDivisionError"):
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit([clouds[0], clouds[1][:399], *clouds[2:]], list("abaa"))
    assert list(fitter.template_) == list(fitter.unit_) == ["a"]
    with pytest.warns(UserWarning, match="^nothing is learned for subject 'b': none of their scans can be used$"):
        lbs.LBSFitter(tube_rig, **QUICK).fit([clouds[0], np.zeros((0, 3)), *clouds[2:]], list("abaa"))
    fitter.save(tmp_path / "m.npz")
    assert list(lbs.LBSFitter.load(tmp_path / "m.npz").template_) == ["a"]


@pytest.mark.usefixtures("no_turns")
def test_a_subject_without_a_template_is_left_out(tube_rig, clouds, monkeypatch):
    call = tasks.Template.__call__

    def careless(self, task):
        if len(task[0]) == 1:
            raise ZeroDivisionError("nobody foresaw this")
        return call(self, task)

    monkeypatch.setattr(tasks.Template, "__call__", careless)
    words = "scan 1: no template could be found for its subject: ZeroDivisionError: nobody foresaw this"
    with pytest.warns(UserWarning, match=words):
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, list("abaa"))
    assert list(fitter.template_) == ["a"] and list(fitter.failures_) == [1]
    assert [r is None for r in fitter.results_] == [False, True, False, False]


def _failing_from(k, name, monkeypatch, is_meant=lambda task: True, until=np.inf):
    """Have a kind of work fail from its k-th task on, of those that are meant."""
    call, calls = getattr(tasks, name).__call__, []

    def careless(self, task):
        if is_meant(task):
            calls.append(task)
            if k <= len(calls) <= until:
                raise ZeroDivisionError("nobody foresaw this")
        return call(self, task)

    monkeypatch.setattr(getattr(tasks, name), "__call__", careless)


def _without_templates_from(k, monkeypatch):
    """Have templates from one scan fail from the k-th on."""
    _failing_from(k, "Template", monkeypatch, lambda task: len(task[0]) == 1)


@pytest.mark.parametrize("k", [slow(2), 3])
def test_a_template_that_fails_in_a_turn_costs_nothing_that_the_round_has_found(tube_rig, clouds, monkeypatch, k):
    _without_templates_from(k, monkeypatch)
    words = f"in turn' stopped after {k - 2} of 2 turns: .*: ZeroDivisionError: nobody foresaw this"
    with pytest.warns(UserWarning, match=words):
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, list("abaa"))
    assert list(fitter.template_) == ["a", "b"] and not fitter.failures_ and None not in fitter.roles_
    assert None not in fitter.results_


@pytest.fixture(scope="module")
def after_turns(tube_rig, clouds, tmp_path_factory):
    """Turns → a fitter that has learned with so many of them, and its checkpoint.

    Without labels, which take time, but with a prior of poses.
    """
    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(VARIANTS, "cd", replace(VARIANTS["cd"], prior=True))
        for turns in (0, 1):
            settings = partial(LoopSettings, turns=turns, **FEWER)
            patch.setattr(LoopSettings, "for_training", lambda n, made=settings, **others: made(**others))
            kept = tmp_path_factory.mktemp(f"after {turns} turns")
            found[turns] = lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, checkpoint=kept), kept
    return found


@pytest.mark.parametrize("turns", [0, 1])
@pytest.mark.parametrize("name, k", [("Template", 1), ("Told", 4), ("Drawn", 1), ("Drawn", 3)])
def test_a_turn_that_fails_leaves_what_was_found_before_it(
    tube_rig, clouds, after_turns, tmp_path, monkeypatch, turns, name, k
):
    """Also where it loses all scans, as where the one subject has no template; from the k-th task of the turn on.

    The turn is the first thing that is not known. Results are made anew.
    """
    expected, kept = after_turns[turns]
    shutil.copytree(kept, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("result*"))
    monkeypatch.setitem(VARIANTS, "cd", replace(VARIANTS["cd"], prior=True))
    _failing_from(k, name, monkeypatch)
    with pytest.warns(UserWarning, match=f"in turn' stopped after {turns} of 2 turns: .*nobody foresaw this"):
        found = lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, checkpoint=tmp_path)
    assert not found.failures_ and None not in found.results_
    np.testing.assert_array_equal(found.pose_prior_.mean, expected.pose_prior_.mean)
    np.testing.assert_array_equal(found.template_[0].vertices, expected.template_[0].vertices)
    for a, b in zip(found.results_, expected.results_, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)


def test_what_a_caller_raises_in_a_turn_ends_learning(tube_rig, clouds):
    def progress(stage, share, figures=None):
        if stage == "templates and poses in turn" and share > 0.5:
            raise ZeroDivisionError("of progress")

    with pytest.raises(ZeroDivisionError, match="of progress"):
        lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, progress=progress)


@pytest.mark.slow
def test_the_round_after_a_turn_that_lost_a_subject_has_that_again(tube_rig, clouds, monkeypatch):
    _failing_from(2, "Template", monkeypatch, lambda task: len(task[0]) == 1, until=2)
    with pytest.warns(UserWarning, match="round 1: the step 'templates and poses in turn' stopped after 0 of 2 turns"):
        fitter = lbs.LBSFitter(tube_rig, **QUICK | {"rounds": 2}).fit(clouds, list("abaa"))
    assert list(fitter.template_) == ["a", "b"] and not fitter.failures_ and len(fitter.history_) == 3


@pytest.mark.slow
def test_a_template_that_fails_later_costs_nothing_of_the_round_that_is_kept(tube_rig, clouds, monkeypatch):
    learning_is_hurried(monkeypatch, turns=0)
    values = iter([1.0, 0.5, 0.6])  # of the first fits and two rounds

    def note(loop, k, began, more):
        loop.history.append({"round": k})
        return next(values)

    monkeypatch.setattr("lbsfit_np.learning.loop.Loop._note", note)
    _without_templates_from(2, monkeypatch)  # that of the second round
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitter = lbs.LBSFitter(tube_rig, **QUICK | {"rounds": 2}).fit(clouds, list("abaa"))
    assert not [w for w in told if "cannot be used" in str(w.message) or "nothing is learned" in str(w.message)]
    assert [entry["round"] for entry in fitter.history_ if entry["kept"]] == [1]
    assert list(fitter.template_) == ["a", "b"] and not fitter.failures_ and None not in fitter.roles_
    monkeypatch.undo()
    learning_is_hurried(monkeypatch, turns=0)
    once = lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, list("abaa"))
    for found, expected in zip(fitter.results_, once.results_, strict=True):
        np.testing.assert_array_equal(found.vertices, expected.vertices)


def test_of_people_without_results_something_was_learned(tube_rig, clouds, monkeypatch):
    _failing(monkeypatch, finish, "_Finish", 399)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit([clouds[0], clouds[1][:399], *clouds[2:]], list("abaa"))
    assert list(fitter.template_) == ["a", "b"] and fitter.results_[1] is None and fitter.roles_[1] is not None
    said = [str(w.message) for w in told if "do not match" not in str(w.message)]
    assert [words[:28] for words in said] == ["1 of 4 scans cannot be used;"]


@pytest.mark.usefixtures("no_turns")
@pytest.mark.parametrize("module", [first_fits, tasks])
def test_a_loss_that_is_not_finite_does_not_spoil_those_of_others(module, tube_rig, clouds, monkeypatch):
    answer, seen = module.finite, []

    def sometimes(loss):
        seen.append(loss)
        return answer(np.nan if len(seen) == 2 else loss)

    monkeypatch.setattr(module, "finite", sometimes)
    with pytest.warns(UserWarning, match="scan 1: points: got a fit that is not finite"):
        fitter = lbs.LBSFitter(tube_rig, **QUICK).fit(clouds)
    assert list(fitter.failures_) == [1] and np.isfinite([h["recon"] for h in fitter.history_]).all()


def test_where_all_scans_fail_the_first_ones_error_passes_on(tube_rig, clouds, monkeypatch):
    _failing(monkeypatch, first_fits, "FirstFit", 400)
    with pytest.raises(ZeroDivisionError, match="nobody foresaw this"):
        lbs.LBSFitter(tube_rig, **QUICK).fit(clouds)


def test_failures_are_warned_of_once():
    collection = Collection(3, [], {2: "empty"})
    with pytest.warns(UserWarning, match="1 of 3 scans cannot be used; scan 2: empty"):
        collection.warn(1)
    collection.failures[0] = "odd"
    with pytest.warns(UserWarning, match="1 of 3 scans cannot be used; scan 0: odd"):
        collection.warn(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        collection.warn(1)


def test_members_answers_stand_in_the_order_of_the_members():
    asked = []

    def inverse(x):
        asked.append(x)
        return 1 / x

    members = [types.SimpleNamespace(index=i, subject=s) for i, s in ((3, "b"), (5, "a"), (6, "b"))]
    collection = Collection(7, list(members))
    assert collection.work(inverse, [1, 0, 4], jobs=1, done=None) == [1, 0.25]
    assert asked == [1, 4, 0]  # subject by subject
    assert collection.members == [members[0], members[2]]
    assert collection.failures == {5: "ZeroDivisionError: division by zero"}


def _of_three():
    return Collection(3, [types.SimpleNamespace(index=i, subject="a") for i in range(3)])


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no POSIX signals here")
def test_a_process_that_dies_costs_its_scan_alone():
    collection = _of_three()
    assert collection.work(ends_at_1, range(3), jobs=2, done=None) == [0, 2]
    assert list(collection.failures) == [1] and [m.index for m in collection.members] == [0, 2]
    why = collection.failures[1]
    assert why.startswith("the process that fitted it ended: killed by SIGKILL") and isinstance(why, Unforeseen)
    with pytest.raises(InputError, match="n_jobs: got a worker process that ended .*SIGKILL.* Use fewer processes"):
        _of_three().work(kills_itself, range(3), jobs=2, done=None)


@pytest.mark.parametrize("jobs", [1, 2])
def test_any_error_is_its_scans_alone_in_any_number_of_processes(jobs):
    """This one cannot be sent between processes."""
    collection = _of_three()
    assert collection.work(two_words_at_1, range(3), jobs=jobs, done=None) == [0, 2]
    assert collection.failures == {1: "TwoWords: this and that"} and isinstance(collection.failures[1], Unforeseen)


def test_an_error_of_all_scans_says_where_in_another_process_it_came_from():
    with pytest.raises(ZeroDivisionError) as error:
        _of_three().work(inverse, [0, 0, 0], jobs=2, done=None)
    assert "in inverse" in str(error.value.__cause__)


@pytest.mark.parametrize("taught", [False, True])
def test_failures_after_learning_say_what_the_scan_was_to_it(taught):
    members = [Member(i, np.zeros((0, 3)), None, None, "a", held_out=i == 1, apart=i == 2) for i in range(4)]
    collection = Collection(4, members)
    assert collection.work(lambda x: 1 / x, [0, 0, 0, 1], jobs=1, done=None, taught=taught) == [1]
    error, after = "ZeroDivisionError: division by zero", "{}, but it has no result: ".format
    said = [after(role) + error if taught else error for role in ("learned from", "held out of learning", "not learned from")]
    assert collection.failures == dict(enumerate(said))
    assert all(isinstance(why, Unforeseen) for why in collection.failures.values())
