"""Scans, or subjects, whose first fits have another scale than others: what is said of them, and how they end."""

import re
import warnings
from dataclasses import dataclass, fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import collected, loop_over, rounds_are_short
from slow_tests import slow

from lbsfit_np.errors import InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.learning import finish
from lbsfit_np.learning.checkpoint import Checkpoint
from lbsfit_np.learning.collection import Member, with_doubt
from lbsfit_np.learning.scales import check_scales, scale_of, scale_warnings, units_apart
from lbsfit_np.optimize.model import Model
from lbsfit_np.starts.turns import Facing

CONVERT = "is it in another unit? Convert it and learn again"
OTHERS = "its first fit has {} times the scale of its subject's other scans"
TWO = "the first fits of scans {} and {} have the scales {} and {}: are they in two units, or of two people? "
TWO += "Convert one, or name two subjects (--subjects), and learn again"
TOLD = "{}: is it in another unit, or is the fit wrong? Its result will tell; learned from"


def _members(n):
    return [Member(k, np.zeros((0, 3)), None, None, "a", name=str(k)) for k in range(n)]


# ---- what first fits say ----


@pytest.mark.parametrize(
    "scales, words",
    [
        ([1.0, 0.9, 2.54, 2.5], "scans 2, 3 of subject 'a' have"),
        ([100.0, 39.4, 101.0, 39.0, 100.0], "scans 1, 3 of subject 'a' have 0.394 times the scale of the others"),
        ([1.0, 1.1, 0.95, 2.0], None),  # one of them may be a wrong fit
        ([0.9, 1.0, 1.1, 1.2], None),
    ],
)
def test_units_that_extents_hide_are_told_by_first_fits(scales, words):
    members = _members(len(scales))
    if words is None:
        check_scales(members, scales)
        odd = {3: f"{OTHERS.format(2)}: {CONVERT}"} if max(scales) == 2 else {}
        assert {k: m.doubt for k, m in enumerate(members) if m.doubt} == odd
        assert [k for k, m in enumerate(members) if m.apart] == list(odd)
        return
    with pytest.raises(InputError, match=words):
        check_scales(members, scales)


@pytest.mark.parametrize(
    "scales, said",
    [((1.0, 1.34), ""), ((1.0, 1.36), "1 and 1.36"), ((1.42, 1.0), "1.42 and 1"), ((250.0, 98.4), "250 and 98.4")],
)
def test_of_two_scans_the_two_scales_are_said_in_one_line(scales, said):
    """Either may be the odd one: both are learned from, and neither is told to be converted."""
    members = _members(2)
    check_scales(members, scales)
    doubt = TWO.format(0, 1, *said.split(" and ")) if said else ""
    assert [m.doubt for m in members] == [doubt, doubt] and not any(m.apart for m in members)
    assert scale_warnings(members) == [f"{doubt}; learned from"] * bool(said)
    members[1].held_out = True
    assert scale_warnings(members) == [f"{doubt}; learned from and held out of learning"] * bool(said)


@pytest.mark.parametrize(
    "scales, told",
    [
        ([1.0, 1.0, 1.34], []),  # people of one unit
        ([1.0, 1.0, 1.0, 1.36], ["scan 3: " + TOLD.format(OTHERS.format(1.36))]),
        ([1.4, 1.0, 1.0], ["scan 0: " + TOLD.format(OTHERS.format(1.4))]),
        ([1.0, 0.5, 1.0, 1.0], [f"scan 1: {OTHERS.format(0.5)}: {CONVERT}; not learned from"]),
        # Of three, the two that are right are measured by each other.
        ([1.0, 1.0, 2.54], [f"scan 2: {OTHERS.format(2.54)}: {CONVERT}; not learned from"]),
        ([1.0, 1.8, 1.0], [f"scan 1: {OTHERS.format(1.8)}: {CONVERT}; not learned from"]),
        ([0.39, 1.0, 1.0], [f"scan 0: {OTHERS.format(0.39)}: {CONVERT}; not learned from"]),
        ([1.0, 1.0, 1.0, 2.54], [f"scan 3: {OTHERS.format(2.54)}: {CONVERT}; not learned from"]),
        ([1.0, 1.0, 10.0, 1.0, 1.0], [f"scan 2: {OTHERS.format(10)}: {CONVERT}; not learned from"]),
        ([3.0], []),
    ],
)
def test_scans_of_another_size_are_warned_of_before_the_rounds(scales, told):
    members = _members(len(scales))
    check_scales(members, scales)
    assert scale_warnings(members) == told


def test_the_one_scan_that_a_subject_is_learned_from_is_not_set_apart():
    members = _members(4)
    for m in members[:3]:
        m.held_out = True
    check_scales(members, [1.0, 1.1, 0.95, 2.0])
    assert "2.0" not in members[3].doubt and members[3].doubt and not members[3].apart
    assert [m.ratio for m in members] == pytest.approx([1.0 / 1.025, 1.1 / 0.975, 0.95 / 1.05, 2.0])  # it is no measure of them


def test_scans_that_are_not_learned_from_do_not_tell_their_subjects_size():
    members, scales = _members(3), [0.9, 1.1, 1.8]
    assert scale_of(members, scales) == 1.1
    check_scales(members, scales)
    assert members[2].apart and scale_of(members, scales) == pytest.approx(1.0)
    members[0].held_out = True
    assert scale_of(members, scales) == 1.1
    members[1].held_out = True  # nobody is left who is learned from
    assert scale_of(members, scales) == 1.1


@pytest.mark.parametrize(
    "scales, words",
    [
        ({"anna": [1.0, 0.95, 1.0], "ben": [0.39, 0.4]}, "scans of subject 'anna' have 2.53 times the scale of those of 'ben'"),
        ({"ben": [0.39, 0.4], "anna": [1.0, 0.95, 1.0], "carl": [0.7]}, "'anna' have 2.53 times the scale of those of 'ben'"),
        ({1: [1.0], 2: [1.62]}, "scans of subject 2 have 1.62 times the scale of those of 1: are they in another unit?"),
        ({"anna": [1.0, 1.1], "child": [0.7]}, None),  # people differ as much
        ({"anna": [1.0, 3.0, 1.0], "ben": [1.2]}, None),  # one wrong first fit
        ({"anna": [25.4]}, None),
    ],
)
def test_subjects_in_different_units_are_told(scales, words):
    told = units_apart(scales)
    assert words in told if words else told == ""


# ---- in learning ----


@pytest.mark.slow
def test_a_scan_in_another_unit_is_fitted_in_that_but_not_learned_from(tube_rig, make_learner, few_scans, monkeypatch):
    """Of three, the two that are right are measured by each other."""
    rounds_are_short(monkeypatch)
    points = [s.points for s in few_scans[:3]]
    points[1] = 2.54 * points[1]
    odd = r"2\.\d+ times the scale of its subject's other scans: is it in another unit\? "
    odd += "Convert it and learn again; not learned from"
    with pytest.warns(UserWarning, match=f"scan 1: its first fit has {odd}") as told:
        fitter = make_learner(held_out=0, rounds=1).fit(points)
    assert sum("first fit" in str(w.message) for w in told) == 1
    assert re.match(f"it has {odd}; the scan is in another unit", fitter.results_[1].message)
    assert [r.message.startswith("learned from; scan and rig are in one unit") for r in fitter.results_] == [1, 0, 1]
    assert ["times the scale" in r.message for r in fitter.results_] == [False, True, False]
    assert [r.scale for r in fitter.results_] == [1.0, pytest.approx(2.54, rel=0.05), 1.0]
    joints = np.linalg.norm(fitter.results_[1].joints - 2.54 * few_scans[1].joints, axis=1).mean()
    assert joints < 0.03 * 2.54 * tube_rig.size / 2
    assert all(entry["recon"] < 0.08 for entry in fitter.history_)  # of the others alone, which have 0.065


@pytest.mark.slow
def test_a_scan_of_another_size_than_its_subjects_others_is_told_so_and_fitted_in_that(
    tube_rig, make_learner, few_scans, monkeypatch
):
    """Too little for another unit: it is learned from like a first fit that is wrong, which would come home in the rounds."""
    rounds_are_short(monkeypatch)
    points = [s.points for s in few_scans[:4]]
    points[1] = 1.5 * points[1]
    first = OTHERS.format(r"1\.[45]\d*")
    with pytest.warns(UserWarning, match=rf"scan 1: {first}: is it in another unit, or is the fit wrong\?") as told:
        fitter = make_learner(variant="cd", held_out=0, rounds=1).fit(points)
    assert len(told) == 1
    odd = r"it has 1\.[45]\d* times the scale of its subject's other scans: "
    odd += r"is it in another unit, or somebody else's\?; learned from; "
    assert [bool(re.match(odd, r.message)) for r in fitter.results_] == [False, True, False, False]
    joints = np.linalg.norm(fitter.results_[1].joints - 1.5 * few_scans[1].joints, axis=1).mean()
    assert joints < 0.03 * 1.5 * tube_rig.size / 2 and fitter.results_[1].status == "ok"


def test_the_unit_of_a_scan_in_doubt_is_that_of_its_first_fit_not_the_subjects_size(tube_rig, few_scans, monkeypatch):
    """Of somebody 1.2 times the rig's size, and one scan in another unit."""
    scales = (1.2, 1.2, 1.2 * 2.54, 1.2)
    collection = collected(tube_rig, [k * s.points for k, s in zip(scales, few_scans)], held_out=0)
    loop = loop_over(tube_rig, collection, "cd", None)
    rest = loop.model.rest()
    frames = [replace(m.frame, unit=loop.model.half) for m in collection.members]
    found = [(frame, rest.replace(scale=k), 0.01, None, (), None, False) for frame, k in zip(frames, scales)]
    monkeypatch.setattr(loop, "_work", lambda *given: found)
    with pytest.warns(UserWarning, match="scan 2: .*; not learned from"):
        loop._first_fits()
    assert [m.own is None for m in collection.members] == [True, True, False, True]
    unit, theta, proba = collection.members[2].own
    assert unit == pytest.approx(2.54) and theta is rest.theta and proba is None
    assert collection.members[2].unit == 1.0  # its subject's, which it has for all that


# ---- in the end ----


def _in_doubt(rig, scan, unit=1.0):
    """A scan as rounds leave it, whose first fit had another unit."""
    (m,) = collected(rig, [unit * scan.points], held_out=0).members
    m.state, m.own = "as it is", (2.54 * unit, np.full((4, 3), 0.1), np.full((len(m.part.rows), 4), 0.25))
    m.proba, m.prior = np.zeros((len(m.part.rows), 4)), ("neighbours", 1e-5)
    m.use_frame(unit, rig.size / 2)
    return m


@pytest.mark.parametrize("unit", [1.0, 1000.0])  # metres, millimetres
@pytest.mark.parametrize("value, wins", [(0.002, True), (0.01, False)])
def test_a_scan_in_doubt_is_finished_from_the_better_of_two_fits(value, wins, unit, tube_rig, few_scans):
    """In its subject's unit from where it is, or in its own, scale free, from the angles and parts of its first fit."""
    m, half = _in_doubt(tube_rig, few_scans[0], unit), tube_rig.size / 2
    _, theta, proba = m.own
    anew, as_is = SimpleNamespace(name="anew", scale=1.1), SimpleNamespace(name="gone on", scale=1.0)
    as_it_is, asked = m.X, []

    class Fake:
        def __init__(self, free, *answer):
            self.free, self.answer = free, answer

        def __call__(self, problem, states=(), *, poses=(), proba=None):
            asked.append((self.free, problem, list(states), list(poses), proba))
            return (*self.answer, 0)

        def freeing(self, free):
            return Fake(free, anew, value)

        def polish(self, problem, state):
            assert problem.X is as_it_is and state is as_is and "scale" in self.free
            return SimpleNamespace(scale=1.3)

    fit = SimpleNamespace(model=SimpleNamespace(half=half), refit=Fake("own", as_is, 0.02))
    size = finish._size(m, fit)
    (free, problem, states, poses, given), (freed, own, no_states, angles, parts) = asked
    assert (free, states, poses) == ("own", ["as it is"], []) and problem.X is as_it_is and given is m.proba
    assert set(freed) == {"pose", "translation", "scale"} and no_states == [] and angles[0] is theta and parts is proba
    np.testing.assert_allclose(own.X, as_it_is / 2.54)
    # 0.01 squared half sizes of its own unit are 0.0645 of the subject's.
    assert (size.state, size.own) == (as_is, anew if wins else None)
    assert size.scale == pytest.approx((1.1 * 2.54 if wins else 1.3) * unit)
    best = finish._in_better_unit(m, fit, size, 0.9 * unit)
    expected = 2.54 * unit if wins else unit
    assert (best.state, best.unit, best.frame.unit) == (anew if wins else as_is, expected, expected * half)
    np.testing.assert_array_equal(best.X, own.X if wins else as_it_is)
    assert best.proba is (proba if wins else m.proba)
    assert m.state == "as it is" and m.unit == unit
    doubt = "it has 3.1 times the scale of its subject's other scans: is it in another unit, or somebody else's?"
    assert best.doubt == (doubt if wins else "")
    assert best.prior == (None if wins else m.prior) and best.own is m.own


@pytest.mark.parametrize("scale, apart, own", [(1.2, False, False), (0.8, False, False), (1.4, False, True), (1.2, True, True)])
def test_a_scan_of_its_subjects_size_after_all_is_fitted_in_that(scale, apart, own, tube_rig, few_scans):
    """Then only its first fit was wrong; one that is not learned from has the fit that is better."""
    m = _in_doubt(tube_rig, few_scans[0])
    m.apart, m.doubt = apart, "so it seemed"
    fit = SimpleNamespace(model=SimpleNamespace(half=tube_rig.size / 2))
    best = finish._in_better_unit(m, fit, finish._Size(1.5 * scale, "as it is", "own"), 1.5)  # on a template between two sizes
    assert (best.state, best.unit) == (("own", 2.54) if own else ("as it is", 1.0))
    assert best.own is (m.own if own else None) and best.prior == (None if own else m.prior) and best.doubt == "so it seemed"


@pytest.mark.parametrize("own, said", [("own", "it has 2.5 times the scale of its subject's other scans: {}"), (None, "so far")])
def test_a_scan_fitted_in_its_own_unit_says_by_how_much_as_the_template_has_it(own, said, tube_rig, few_scans):
    """That is nearer to the truth than its first fit; in its subject's unit no scale of its own was found."""
    m = _in_doubt(tube_rig, few_scans[0])
    m.apart, m.doubt = True, "so far"
    fit = SimpleNamespace(model=SimpleNamespace(half=tube_rig.size / 2))
    assert finish._in_better_unit(m, fit, finish._Size(2.5 * 1.2, "as it is", own), 1.2).doubt == said.format(CONVERT)


def test_the_size_of_others_is_their_own_on_the_template_not_the_templates():
    members = [SimpleNamespace(subject=s, index=3 * k, unit=7.0, apart=False) for k, s in enumerate("aabaabc")]
    sizes = [finish._Size(x, None) for x in (0.8, 1.2, 30.0, 0.9, 1.0, 20.0)] + [None]
    found = finish._others(members, sizes)
    assert found == pytest.approx([1.0, 0.9, 20.0, 1.0, 0.9, 30.0, 7.0])


def test_scans_that_are_set_apart_are_nobodys_others():
    """Of three, one would shift the median of the two that are right; where all others are apart, the template is the measure."""
    given = zip("aaabbcc", [False, False, True, False, True, True, True])
    members = [SimpleNamespace(subject=s, index=k, unit=7.0, apart=apart) for k, (s, apart) in enumerate(given)]
    sizes = [finish._Size(x, None) for x in (1.0, 1.2, 2.54, 1.0, 0.4, 2.5, 0.4)]
    assert finish._others(members, sizes) == pytest.approx([1.2, 1.0, 1.1, 7.0, 1.0, 7.0, 7.0])


@pytest.mark.parametrize("status, home, said", [("ok", True, False), ("ok", False, True), ("suspect", True, True)])
def test_a_doubt_that_has_come_to_nothing_is_not_said_of_a_fit_that_is_ok(status, home, said, tube_rig, few_scans, monkeypatch):
    (m,) = collected(tube_rig, [few_scans[0].points], held_out=0).members
    m.doubt, m.own = "odd", "own"
    m.state, own, looked_for = SimpleNamespace(scale=1.0), SimpleNamespace(scale=1.0), []
    kept = replace(m, own=None) if home else replace(m, state=own)
    monkeypatch.setattr(finish, "_in_better_unit", lambda *given: kept)

    @dataclass(frozen=True)
    class Result:
        message: str = "done"
        status: str = ""
        subject: str = ""

    def finished(*given, free, **more):
        looked_for.append(set(free))
        return Result(status=status)

    fit = SimpleNamespace(proportions=lambda *given: 0.0, finish=finished, refit=SimpleNamespace(turning=None))
    fit.model = SimpleNamespace(source=tube_rig)
    work = finish._Finish(tube_rig, {}, SimpleNamespace(scale="estimate", unit=None), True, (), None)
    work.__dict__["_fit"] = lambda subject: fit
    assert work((m, finish._Size(1.0, m.state, own), 1.0)).message == ("odd; done" if said else "done")
    # A scale of its own was looked for where it has one.
    assert looked_for == [{"pose", "translation"} if home else {"pose", "translation", "scale"}]


@pytest.mark.parametrize("jobs", [1, slow(2)])
def test_all_scans_of_a_subject_in_doubt_are_measured_on_its_template(jobs, tube_rig, few_scans, monkeypatch):
    """And they alone: where nobody is in doubt there is nothing to compare."""
    scans = [*(s.points for s in few_scans[:3]), few_scans[3].points]
    collection = collected(tube_rig, scans, ["a", "a", "a", "b"], held_out=0)
    model = Model(tube_rig)
    for m in collection.members:
        m.use_frame(1.0, tube_rig.size / 2)
        m.state = model.rest()
    collection.members[1].own = 1.4, np.zeros((4, 3)), None
    others, measured = finish._others, []
    monkeypatch.setattr(finish, "_others", lambda members, sizes: measured.extend(sizes) or others(members, sizes))
    told, settings = [], FitSettings(effort="fast", full_iterations=1)
    given = tube_rig, {"a": tube_rig, "b": tube_rig}, "follow", collection, settings, Facing(), None
    results = finish.results_of(*given, other_limbs=True, jobs=jobs, progress=lambda stage, share: told.append((stage, share)))
    assert [size is not None for size in measured] == [True, True, True, False]
    assert all(results) and {stage for stage, _ in told} == {"results"}
    shares = [share for _, share in told]
    assert len(shares) == 10 and shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0
    assert shares[4] == shares[5] == pytest.approx(0.2)


def test_a_result_hangs_on_the_scales_of_its_subjects_others(tube_rig, few_scans, tmp_path, monkeypatch):
    collection, model, made = collected(tube_rig, [s.points for s in few_scans[:3]], held_out=0), Model(tube_rig), []
    for m in collection.members:
        m.use_frame(1.0, tube_rig.size / 2)
        m.state = model.rest()
    call = finish._Finish.__call__
    monkeypatch.setattr(finish._Finish, "__call__", lambda self, task: made.append(task[0].index) or call(self, task))
    subject = collection.members[0].subject
    given = tube_rig, {subject: tube_rig}, "follow", collection, FitSettings(effort="fast", full_iterations=1), Facing(), None
    options = {"jobs": 1, "progress": lambda stage, share: None, "checkpoint": Checkpoint(tmp_path)}
    for others, anew in (([1.0, 1.0, 1.0], [0, 1, 2]), ([1.0, 1.0, 1.0], []), ([1.0, 1.4, 1.0], [1])):
        made.clear()
        monkeypatch.setattr(finish, "_others", lambda members, sizes, others=others: others)
        finish.results_of(*given, other_limbs=True, **options)
        assert made == anew


# ---- two scans ----


def test_what_cannot_be_fitted_in_any_unit_says_its_unit_last():
    """A blob has a scale, too, which is not what is wrong with it."""
    result = SimpleNamespace(message="points are far away", status="failed")
    said = {}
    for apart, status in ((True, "failed"), (True, "suspect"), (False, "failed")):
        member = replace(_members(1)[0], doubt="in another unit?", apart=apart)
        made = FitResult(**{f.name: getattr(result, f.name, None) for f in fields(FitResult)} | {"status": status})
        said[apart, status] = with_doubt(member, made).message
    first = "in another unit?; points are far away"
    assert said.pop((True, "failed")) == "points are far away; in another unit?" and set(said.values()) == {first}


@pytest.mark.parametrize("factor", [1.5, 2.54])
@pytest.mark.usefixtures("hurried")
def test_two_scans_of_different_sizes_say_so_once_and_in_both_results(factor, tube_rig, few_scans, make_learner):
    words = TWO.format(0, 1, r"\d\.\d+", r"\d\.\d+").replace("?", r"\?").replace("(", r"\(").replace(")", r"\)")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitter = make_learner(variant="cd", held_out=0).fit([few_scans[0].points, factor * few_scans[1].points])
    (line,) = [str(w.message) for w in told if "first fit" in str(w.message)]
    assert re.match(f"{words}; learned from$", line)
    assert all(re.match(f"{words}; (.*; )?learned from; ", r.message) for r in fitter.results_)
    assert not any("Convert it" in r.message or "others" in r.message for r in fitter.results_)
