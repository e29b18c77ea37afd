"""First fits of a collection's scans: what is looked at again, what takes part from then on, and what they depend on."""

import re
import warnings
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from learning_runs import collected, loop_over
from made_fits import MadeFits, hands_with_arms

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.learning import finish, first_fits
from lbsfit_np.learning.checkpoint import Checkpoint, digest_of, remove_checkpoint, steps_in
from lbsfit_np.learning.collection import Member
from lbsfit_np.learning.first_fits import FirstFit
from lbsfit_np.learning.scales import check_scales
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.model import Model
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.starts.clean import TakingPart
from lbsfit_np.starts.turns import Facing


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


@pytest.fixture(scope="module")
def long_scan(hand):
    return max(hands_with_arms(hand), key=lambda s: len(s.points))


@pytest.fixture(scope="module")
def short_scan(hand):
    return min(hands_with_arms(hand), key=lambda s: len(s.points))


class _Scout:
    """What a scout says of what takes part: how many points that are, and whether it looked once; and how often it was asked."""

    def __init__(self, sure):
        self.sure, self.of = sure, []

    def __call__(self, points, *, once=False):
        self.of.append((len(points), once))
        problem = SimpleNamespace(evaluate=lambda *given: SimpleNamespace(value=0.5))
        return SimpleNamespace(frame=None, state=self.of[-1], proba=None, problem=problem, value=0.5, rivals=(1.0, 1.5))

    def is_sure(self, found):
        return self.sure

    def probability(self, found):
        return 0.9 if self.sure else 0.01


def _first_fit(hand, fits, *, sure, **settings):
    """A first fit whose fits are made ones, and its scout."""
    work, scout = FirstFit(Model(hand), FitSettings(**settings), None, None, Facing(up=UPS[0]), True, 0), _Scout(sure)

    def fit(points, *, part, found):
        n, once = found.state
        assert n == len(part.rows)
        known = vars(fits.fit(SimpleNamespace(among=part.among), once))
        return FitResult(**dict.fromkeys((f.name for f in fields(FitResult)), None) | known)

    def taking(points, point_weights, seed, *, ups, sure, among):
        np.testing.assert_array_equal(ups, UPS)
        assert sure
        rows = np.flatnonzero(among)
        return TakingPart(rows, rows[:0], "", 1.0, None, np.where(among, 1, -2).astype(np.int8), among)

    object.__setattr__(work, "_fit", SimpleNamespace(scout=scout, fit=fit, taking_part=taking))
    return work, scout


# What its scans are asked for: floors below this axis, and no other flat sides.
UPS = np.array([[0.0, 1.0, 0.0]])


def _member(scan):
    rows = np.arange(len(scan.points))
    return Member(0, scan.points, replace(TakingPart.only(rows, len(rows)), doubtful=1), None, "ann", sure=True)


@pytest.mark.parametrize("turn, rival", [(0.0, 1 / 1.25), (0.02, 1 / 1.25), (1.0, 0.0)])
def test_results_know_the_rivals_of_first_fits(turn, rival, tube_rig, tube_scan):
    """As long as the pose is still the one that they were rivals of: rounds do not look for them again."""
    collection = collected(tube_rig, [tube_scan.points], held_out=0)
    (m,) = collection.members
    m.use_frame(1.0, tube_rig.size / 2)
    m.state = Model(tube_rig).rest().replace(theta=tube_scan.pose)
    first = tube_scan.pose.copy()
    first[1, 0] += turn
    m.first = first, (1.5, 1.25)
    given = tube_rig, {0: tube_rig}, "follow", collection, FitSettings(full_iterations=1), Facing(), None
    (r,) = finish.results_of(*given, other_limbs=True, jobs=1, progress=lambda *told: None)
    assert r.evidence["rival"] == pytest.approx(rival)


@pytest.mark.parametrize("settings, sure", [({}, True), ({"effort": "fast"}, False)])
def test_a_first_fit_that_is_sure_or_fast_is_not_looked_at_again(hand, short_scan, settings, sure):
    fits, n = MadeFits(hand, short_scan), len(short_scan.points)
    work, scout = _first_fit(hand, fits, sure=sure, **settings)
    assert work(work.task(_member(short_scan))) == (None, (n, False), 0.5, None, (2.0, 3.0), None, not sure)
    assert scout.of == [(n, False)] and not fits.of


@pytest.mark.parametrize("which", ["long_scan", "short_scan"])
def test_a_first_fit_in_doubt_is_of_what_lies_within_the_rig(hand, which, request):
    """Whether there is a floor, which the whole collection tells, is not asked again."""
    scan = request.getfixturevalue(which)
    n, arm, fits = len(scan.points), scan.labels < 0, MadeFits(hand, scan, all=("true", 0.2), hand=("true", 0.9))
    work, scout = _first_fit(hand, fits, sure=False)
    _, state, _, _, _, part, _ = work(work.task(_member(scan)))
    assert part.among[~arm].all() and part.among[arm].mean() < 0.25 and state == (len(part.rows), True)
    # The scout's word on the whole is taken for the fit of the whole.
    assert scout.of == [(n, which == "long_scan"), (part.among.sum(), True)]
    assert fits.of == ["all", "hand"]


def test_a_part_that_is_none_too_sure_is_not_learned_from(hand, short_scan):
    """What is left out of a result in doubt may be looked at again, what is not learned from is lost to all rounds."""
    n, fits = len(short_scan.points), MadeFits(hand, short_scan, all=("true", 0.2), hand=("true", 0.3))
    fits.ends |= {"hand_end": ("turned", 0.1), "arm_end": ("turned", 0.1)}
    work, scout = _first_fit(hand, fits, sure=False)
    assert work(work.task(_member(short_scan))) == (None, (n, False), 0.5, None, (2.0, 3.0), None, True)
    assert "hand" in fits.of and scout.of.count((n, False)) == 1


class _FitsOfALook(MadeFits):
    """Of a closer look at the whole, another probability."""

    closely = 0.9

    def fit(self, part, once):
        if not once:
            self.ends = self.ends | {"all": ("true", self.closely)}
        return super().fit(part, once)


@pytest.mark.parametrize("closely", [0.9, 0.25])
def test_of_a_long_scan_with_nothing_beyond_the_closer_look_is_taken(hand, long_scan, closely):
    n, ends = len(long_scan.points), {"hand_end": ("turned", 0.1), "arm_end": ("turned", 0.1)}
    fits = _FitsOfALook(hand, long_scan, all=("turned", 0.2), hand=("turned", 0.3), **ends)
    fits.closely = closely
    work, scout = _first_fit(hand, fits, sure=False)
    assert work(work.task(_member(long_scan))) == (None, (n, False), 0.5, None, (2.0, 3.0), None, True)
    assert [once for m, once in scout.of if m == n] == [True, False]


def test_a_first_fit_depends_on_what_takes_part_and_where_a_rig_ends_on_all(hand, short_scan):
    member = _member(short_scan)
    (work, _), (fast, _) = (_first_fit(hand, None, sure=True, effort=effort) for effort in ("balanced", "fast"))
    further = np.concatenate([member.points, [[0.0, 0.0, 0.0]]])
    others = [{"points": further}, {"sure": False}, {"part": replace(member.part, doubtful=None)}]
    for change in others:
        other = replace(member, **change)
        assert digest_of(fast.task(other)) == digest_of(fast.task(member))
        assert digest_of(work.task(other)) != digest_of(work.task(member))
    other = replace(member, part=replace(member.part, rows=member.part.rows[1:]))
    assert all(digest_of(w.task(other)) != digest_of(w.task(member)) for w in (work, fast))


def test_after_its_first_fit_a_member_is_what_lies_within_the_rig(tube_rig, few_scans, monkeypatch):
    """Its points, their middle, and their unit: with what is beyond, extents seemed to be of another."""
    scans = [s.points for s in few_scans[:3]]
    collection = collected(tube_rig, [3.0 * x for x in scans], held_out=0)
    loop = loop_over(tube_rig, collection, "cd", None)
    assert collection.members[0].unit > 2
    among = np.arange(len(scans[0])) % 2 == 0
    part = TakingPart(np.flatnonzero(among), np.arange(0), "", 1.0, None, np.where(among, 1, -2).astype(np.int8), among)
    frame, state = Frame(np.zeros(3), loop.model.half), loop.model.rest().replace(scale=1.1)
    monkeypatch.setattr(loop, "_work", lambda *given: [(frame, state, 0.01, None, (), part, False)] * 3)
    loop._first_fits()
    assert loop.collection.unit_by_extents == 1.0
    for m, x in zip(collection.members, scans, strict=True):
        assert m.part is part and m.unit == 1.0
        np.testing.assert_allclose(m.frame.centre, 3.0 * x[among].mean(axis=0))
        np.testing.assert_allclose(m.X, (3.0 * x[among] - m.frame.centre) / loop.model.half)
    np.testing.assert_allclose(loop.coefficients[0][: loop.model.n_proportions], 0.1)  # the subject's size, not its unit


@pytest.mark.parametrize("ends", [False, True])
def test_where_a_rig_ends_scales_that_are_apart_may_be_of_what_lies_beyond(ends):
    members = [Member(k, np.zeros((0, 3)), None, None, "ann", name=str(k)) for k in range(5)]
    with pytest.raises(InputError, match="different units") as error:
        check_scales(members, [1.0, 1.0, 1.0, 1.75, 1.8], ends=ends)
    assert ("such as an arm, crop them. Convert them" in str(error.value)) == ends


@pytest.mark.parametrize("wrong, told", [((), False), ((0, 1), False), ((0, 1, 2), True), ((0, 1, 2, 3), True)])
def test_learning_from_scans_that_are_fitted_wrongly_is_told_before_it_begins(wrong, told, tube_rig, few_scans, monkeypatch):
    """As of scans that stand otherwise than the fitter thinks: rounds would take long, and come to nothing."""
    collection = collected(tube_rig, [s.points for s in [*few_scans[:4], *few_scans[:2]]], held_out=0)
    for m in collection.members[4:]:
        m.held_out = True
    loop = loop_over(tube_rig, collection, "cd", None)
    frame, state = Frame(np.zeros(3), loop.model.half), loop.model.rest()
    # Scans held out, which say how good what is learned is, are as right or wrong as the majority of the others is not.
    answers = [(frame, state, 0.01, None, (), None, k in wrong if k < 4 else not told) for k in range(6)]
    monkeypatch.setattr(loop, "_work", lambda *given: answers)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        assert loop._first_fits() == len(wrong) + 2 * (not told)
    said = [str(w.message) for w in seen if "all but certainly fitted wrongly" in str(w.message)]
    assert len(said) == told and all(words.startswith(f"{len(wrong)} of 4 scans to learn from are") for words in said)


@pytest.mark.slow
def test_what_stands_on_its_head_is_fitted_wrongly(tube_rig, unlearned, few_scans):
    """And the same scans as they stand are not."""
    turn, known = matrix_from_rotvec(np.array([np.pi, 0.0, 0.0])), (unlearned.segmenter_, unlearned.regressor_)
    for R, most in ((turn, True), (np.eye(3), False)):
        collection = collected(tube_rig, [s.points @ R.T for s in few_scans[:4]])
        loop = loop_over(tube_rig, collection, "joint", *known, fit_settings=FitSettings(effort="fast"))
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            wrong = loop._first_fits()
        said = [str(w.message) for w in seen if "all but certainly fitted wrongly" in str(w.message)]
        assert len(said) == most and (2 * wrong > 4) == most
        alone = r"learned from right fits: scan \d alone is failed: .*points are not explained"
        assert all(re.search(alone, words) for words in said), said


@pytest.mark.parametrize(
    "alone, told",
    [
        ({"status": "failed", "message": "it is on its head; else"}, "scan 1 alone is failed: it is on its head; else"),
        ({"status": "suspect", "message": "it leans"}, "scan 1 alone is suspect: it leans"),
        ({"status": "ok", "message": "it has been cleaned"}, "do scans stand as orientation and up say, is it"),
        (ValueError("of whatever kind"), "do scans stand as orientation and up say, is it their rig? Fit one alone ("),
    ],
)
def test_one_of_those_that_are_fitted_wrongly_is_fitted_alone(alone, told, tube_rig, tube_result, few_scans, tmp_path):
    """Once, however often a run goes on; what it says is of the first that has failed and is learned from."""
    members = collected(tube_rig, [s.points for s in few_scans[:4]], held_out=0).members
    members[0].held_out, asked = True, []

    def fit(member):
        asked.append(member)
        if isinstance(alone, Exception):
            raise alone
        return replace(tube_result, **alone)

    work, kept = SimpleNamespace(alone=fit), Checkpoint(tmp_path / "steps").slot
    for _ in range(2):
        words = first_fits.most_have_failed(work, members, [True, True, False, True], kept)
        assert words.startswith("2 of 3 scans to learn from are all but certainly fitted wrongly, and templates are learned ")
        assert f" right fits: {told}" in words
    failed = isinstance(alone, Exception)
    assert asked == [members[1]] * (2 if failed else 1) and steps_in(tmp_path / "steps") == (0 if failed else 1)
    remove_checkpoint(tmp_path / "steps")
    assert not (tmp_path / "steps").exists()
