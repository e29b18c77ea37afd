"""Which hypotheses of a scan there are, which of them go on, and when a second look is taken."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from posed_samples import sampled
from slow_tests import slow
from turned_scans import CLEAN, any_turn, error_of, upright

import lbsfit_np as lbs
from lbsfit_np.fitting.effort import EFFORTS
from lbsfit_np.fitting.refit import Runner
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.scout import Found, Scout
from lbsfit_np.optimize.frame import Frame
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import Coverage
from lbsfit_np.segmentation.segmenter import Segmenter
from lbsfit_np.starts.library import PoseLibrary, Start
from lbsfit_np.starts.turns import facing_of

pytestmark = pytest.mark.usefixtures("one_thread")


def _untrained(rig, poses=None, *, orientation="aligned", facing=None, effort="balanced", segmenter=None, **more):
    """A Scout whose library answers with the first of its poses, whatever it sees."""
    poses = np.zeros((2, *rig.lower.shape)) if poses is None else poses

    def starts(points, turns, k, unit=None):
        return [Start(poses[0], 0, 1.0, 0.0)]

    library = SimpleNamespace(poses=poses, starts=starts, regress=lambda points: poses[0])
    facing = facing or facing_of(rig, orientation)
    return Scout(Model(rig), library, facing, segmenter, FitSettings(effort=effort), **more)


# ---- starts, efforts, looks ----


@pytest.mark.parametrize("effort", ["fast", "balanced", slow("thorough")])
def test_effort_is_the_number_of_starts(tube_rig, make_scout, clean_scans, effort, monkeypatch):
    scout, turn = make_scout(settings=FitSettings(effort=effort)), upright(2.5)
    first, counts = scout._refit.first_steps, []
    monkeypatch.setattr(scout._refit, "first_steps", lambda runners: counts.append(len(runners)) or first(runners))
    found = scout(clean_scans[0].points @ turn.T)
    assert counts[0] == EFFORTS[effort].starts + 1  # of the library and f
    assert 1 <= counts[1] <= EFFORTS[effort].facings  # from labels
    assert error_of(tube_rig, found, clean_scans[0], turn) < 0.03


@pytest.mark.parametrize("partial", [False, True])
@pytest.mark.parametrize("cropped", [False, True])
def test_views_that_are_cropped_have_more_starts(tube_rig, partial, cropped, clean_scans, monkeypatch):
    scout, asked = _untrained(tube_rig), []
    scout.settings, answer = FitSettings(partial=partial, cropped=cropped), scout.library.starts
    monkeypatch.setattr(scout.library, "starts", lambda points, turns, k, **unit: asked.append(k) or answer(points, turns, k))
    scout._runners(clean_scans[0].points, None)
    assert asked == [EFFORTS["balanced"].starts * (3 if partial and cropped else 1)]


@pytest.mark.parametrize("effort", ["fast", slow("balanced"), "thorough"])
def test_only_a_thorough_look_looks_at_limbs_closer(make_scout, clean_scans, effort, monkeypatch):
    scout, told = make_scout(settings=FitSettings(effort=effort)), []
    monkeypatch.setattr(scout._limbs, "proposals", lambda problem, state, n, *, closer: told.append((n, closer)) or [])
    scout._look(clean_scans[0].points, None)
    assert set(told) == {(EFFORTS[effort].proposals, effort == "thorough")}


def test_more_effort_is_more_of_everything():
    assert list(EFFORTS) == ["fast", "balanced", "thorough"]
    fields = [[getattr(e, name) for name in e.__dataclass_fields__ if name != "again"] for e in EFFORTS.values()]
    assert (np.diff(fields, axis=0) >= 0).all() and (np.diff(fields, axis=0)[:, :2] > 0).all()


@pytest.mark.parametrize(
    "effort, p, looks",
    [
        ("balanced", 0.9, ["balanced"]),
        ("balanced", 0.7, ["balanced", "thorough"]),
        ("fast", 0.0, ["fast"]),
        ("thorough", 0.9, ["thorough"]),
        ("thorough", 0.0, ["thorough", "thorough"]),  # the second under other up axes
    ],
)
def test_doubt_is_worth_a_second_look(make_scout, clean_scans, effort, p, looks, monkeypatch):
    known = {EFFORTS[name]: name for name in EFFORTS}
    seen, values = [], iter([2.0, 1.0])

    def look(self, points, x_weights):
        seen.append(known[self.effort])
        return [Runner(self.effort, self.model.rest(), Frame(np.zeros(3), 1.0), next(values))]

    monkeypatch.setattr(Scout, "_look", look)
    monkeypatch.setattr(Scout, "_seen", lambda self, runner: None)
    monkeypatch.setattr(Scout, "probability", lambda self, found: p)
    scout = make_scout(settings=FitSettings(effort=effort))
    assert known[scout(clean_scans[0].points).problem] == looks[-1] and seen == looks
    seen.clear()
    values = iter([2.0, 1.0])
    make_scout("aligned", FitSettings(effort=effort))(clean_scans[0].points)
    assert seen == (looks if effort == "balanced" else looks[:1])  # nothing is open that a second look could find
    values = iter([1.0, 2.0])  # a second look that finds nothing better changes nothing
    assert known[scout(clean_scans[0].points).problem] == looks[0] and known[scout.effort] == effort


@pytest.mark.parametrize("partial", [False, True])
@pytest.mark.parametrize("cropped", [False, True])
def test_views_that_are_cropped_are_looked_at_again_in_less_doubt(tube_rig, partial, cropped, monkeypatch):
    scout = _untrained(tube_rig)
    scout.settings, looks = FitSettings(partial=partial, cropped=cropped), []
    look = [Runner(None, scout.model.rest(), Frame(np.zeros(3), 1.0), 1.0)]
    monkeypatch.setattr(Scout, "_look", lambda self, *scan: looks.append(self.effort) or look)
    for p, least in ((0.79, 2), (0.8, 1), (0.94, 1), (0.95, 1)):
        monkeypatch.setattr(Scout, "probability", lambda self, found, p=p: p)
        looks.clear()
        scout(np.zeros((9, 3)))
        assert len(looks) == (2 if partial and cropped and p < 0.95 else least)


@pytest.mark.parametrize("unit, kept", [(0.9, "thorough"), (1.2, "balanced")])
def test_looks_are_compared_in_the_scans_unit(tube_rig, unit, kept, monkeypatch):
    """The second leaves 0.8 of the first's unexplained, in units of its own."""
    assert _of_two_looks(tube_rig, [(1.0, 0.0)], [(0.8, 1.0)], unit, monkeypatch).problem is EFFORTS[kept]


def test_what_both_looks_have_found_are_rivals(tube_rig, monkeypatch):
    """Each of them once, as it leaves least, in the unit of the frame that is kept."""
    first = [(4.0, 0.0), (16.0, 1.0), (17.0, 5.0)]
    found = _of_two_looks(tube_rig, first, [(0.9, 2.0), (20.0, 3.0), (30.0, 1.0), (1.2, 0.0)], 2.0, monkeypatch)
    assert (found.problem, found.value) == (EFFORTS["thorough"], 0.9)
    assert found.rivals == pytest.approx((1.0, 4.0, 4.25, 20.0))
    found = _of_two_looks(tube_rig, first, [(1.2, 2.0), (1.1, 1.0), (1.5, 0.0)], 2.0, monkeypatch)
    assert (found.problem, found.value) == (EFFORTS["balanced"], 4.0)
    assert found.rivals == pytest.approx((4.4, 4.8, 17.0))


def _of_two_looks(rig, first, second, unit, monkeypatch):
    """What a scout makes of two looks at poses so far apart that leave so much unexplained; the problem says which look."""

    def look(self, *scan):
        seen, own = (second, unit) if self.effort is EFFORTS["thorough"] else (first, 1.0)
        rest, frame = self.model.rest(), Frame(np.zeros(3), own)
        states = [rest.in_unit(own).replace(translation=np.array([apart / own, 0.0, 0.0])) for _, apart in seen]
        return [Runner(self.effort, state, frame, value) for state, (value, _) in zip(states, seen, strict=True)]

    monkeypatch.setattr(Scout, "_look", look)
    monkeypatch.setattr(Scout, "probability", lambda self, found: 0.0)
    return _untrained(rig)(np.zeros((9, 3)))


@pytest.mark.parametrize(
    "orientation, up", [("upright", None), ("upright", "+z"), ("upright", "+y"), ("aligned", None), ("any", None)]
)
@pytest.mark.parametrize("effort", ["fast", "balanced", "thorough"])
def test_a_second_look_tries_any_side_where_no_axis_was_told(tube_rig, effort, orientation, up, monkeypatch):
    seen, facing = [], facing_of(tube_rig, orientation, up)

    def look(self, *scan):
        seen.append(self.facing)
        return [Runner(None, self.model.rest(), Frame(np.zeros(3), 1.0), 1.0)]

    monkeypatch.setattr(Scout, "_look", look)
    monkeypatch.setattr(Scout, "probability", lambda self, found: 0.0)
    scout = _untrained(tube_rig, facing=facing, effort=effort)
    scout(np.zeros((9, 3)))
    assert seen[0] is facing and scout.facing is facing
    if effort == "fast" or (orientation, up) != ("upright", None):
        assert all(f is facing for f in seen) and len(seen) == (2 if effort == "balanced" else 1)
        return
    assert len(seen) == 2
    np.testing.assert_array_equal(seen[1].turns[: len(facing.turns)], facing.turns)
    sides = {tuple(np.round(turn @ [0.0, 1.0, 0.0]) + 0.0) for turn in seen[1].turns}
    assert sides == {tuple(s) for s in np.vstack([np.eye(3), -np.eye(3)]) + 0.0}


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
@pytest.mark.parametrize("apart, poses", [(0.02, 1), (0.04, 2)])
def test_poses_are_told_apart_in_half_sizes_whatever_the_unit(tube_rig, apart, poses, unit):
    scout, frame = _untrained(tube_rig), Frame(np.zeros(3), unit)
    rest = scout.model.rest()
    states = rest, rest.replace(translation=rest.translation + [apart, 0.0, 0.0])
    runners = [Runner(None, state, frame) for state in states]
    assert scout._distinct(runners) == runners[:poses]


def test_a_wrong_pose_is_in_doubt(make_scout, clean_scans):
    scout = make_scout()
    found = scout(clean_scans[0].points)
    assert scout.probability(found) > 0.8
    wrong = found.state.replace(theta=found.state.theta * 0.0, translation=found.state.translation + 0.2)
    assert scout.probability(replace(found, state=wrong)) < 0.05


def _of_other_proportions(model):
    c = np.random.default_rng(0).uniform(-0.3, 0.3, model.n_coefficients)
    return model.rest().replace(theta=0.5 * model.rig.upper, coefficients=c)


def test_the_mesh_that_was_found_is_judged_with_its_proportions(tube_rig, monkeypatch):
    scout, seen = _untrained(tube_rig), []
    state = _of_other_proportions(scout.model)
    V = scout.model.deformed(state).vertices

    def evidence_of(model, vertices, *scan, **known):
        seen.append(vertices)
        return None, {}

    monkeypatch.setattr("lbsfit_np.fitting.scout.evidence_of", evidence_of)
    monkeypatch.setattr("lbsfit_np.fitting.scout.probability_of", lambda evidence: 0.5)
    found = Found(Frame(np.zeros(3), 1.0), Problem(V), state, None, 0.0, ())
    assert scout.probability(found) == scout.probability(found) == 0.5
    np.testing.assert_allclose(seen, [V], atol=1e-12)  # once


def test_poses_are_told_apart_by_where_their_own_joints_are(tube_rig):
    """In the scan's frame, under the proportions that were found."""
    scout, frame = _untrained(tube_rig), Frame(np.array([1.0, 2.0, 3.0]), 5.0, any_turn(7))
    state = _of_other_proportions(scout.model)
    joints = scout._joints(Runner(None, state, frame))
    np.testing.assert_allclose(joints, frame.outside(scout.model.deformed(state).joints), atol=1e-12)


def test_without_the_librarys_poses_starts_are_rest_and_f_under_its_turns(make_scout, clean_scans):
    scout = make_scout(nearest=False, segmenter=False)
    points = clean_scans[0].points @ upright(2.0).T
    runners = scout._runners(points, None)
    library, turns = scout.library, [s.turn for s in scout.library.starts(points, scout.facing.turns, scout.effort.starts)]
    assert len(runners) == 2 * len(set(turns))
    f = library.regress(points @ scout.facing.turns[turns[0]])
    for k, r in enumerate(runners):
        as_f = library.regress(points @ r.name.turn)  # as it sees the scan under this turn
        np.testing.assert_array_equal(r.state.theta, as_f if k % 2 else np.zeros_like(f))
    assert {r.name.turn.tobytes() for r in runners} == {scout.facing.turns[k].tobytes() for k in turns}
    everything = make_scout(segmenter=False)._runners(points, None)
    np.testing.assert_array_equal(everything[-1].state.theta, f)
    assert sum((r.state.theta == library.poses).all(axis=(1, 2)).any() for r in everything) == len(everything) - 1


@pytest.mark.parametrize("unit", [None, 1.0])
def test_library_and_segmenter_are_asked_at_the_size_that_they_have_learned_from(make_scout, clean_scans, unit, monkeypatch):
    points, size, asked, scales = clean_scans[0].points, 1.25, [], []
    starts, predict_proba = PoseLibrary.starts, Segmenter.predict_proba

    def starting(self, *given, **sizes):
        asked.append(sizes)
        return starts(self, *given, **sizes)

    def saying(self, points, *, scale=1.0, **options):
        scales.append(scale)
        return predict_proba(self, points, scale=scale, **options)

    monkeypatch.setattr(PoseLibrary, "starts", starting)
    monkeypatch.setattr(Segmenter, "predict_proba", saying)
    plain, scout = make_scout(unit=unit), make_scout(unit=unit, size=size)
    as_large, as_small = plain._runners(points, None), scout._runners(points, None)
    assert asked == ([{}, {}] if unit is None else [{"unit": 1.0}, {"unit": size}])
    if unit is None:  # what the library takes for a scan of its own size is one of 1 / 1.25 of the template's
        of = [np.median([r.state.scale * r.name.unit for r in runners]) for runners in (as_large, as_small)]
        assert of[0] / of[1] == pytest.approx(size)
    scout._labelled(points, None, as_small[0].name)
    scout._seen(as_small[0])
    assert scales == [size, size]


def test_starts_stand_where_the_scan_is(make_scout, clean_scans):
    points = 1000 * clean_scans[0].points + [1e4, 0.0, 3.0]
    for r in make_scout()._runners(points, None):
        V = make_scout().model.pose(r.state)[0].vertices
        assert np.linalg.norm(make_scout().model.areas @ V - r.problem.X.mean(axis=0)) < 1e-9
        np.testing.assert_allclose(r.name.outside(r.problem.X), points, atol=1e-6)


def test_hypotheses_are_compared_in_one_unit(make_scout, clean_scans):
    """What is left unexplained goes by the square of the unit: in units of their own, the largest would win."""
    scout = make_scout()
    runners = scout._runners(1000 * clean_scans[0].points, None)
    assert len({r.name.unit for r in runners}) == 1 and len({r.state.scale for r in runners}) > 1
    moved = [replace(r, value=float(k + 1)) for k, r in enumerate(runners)]
    one = replace(moved[2], state=moved[2].state.replace(scale=1.25))
    for before, after in zip(moved, scout._resized(moved, one)):
        assert after.name.unit == before.name.unit * 1.25 and after.value == pytest.approx(before.value / 1.25**2)
        for r in (before, after):
            np.testing.assert_allclose(r.name.outside(r.problem.X), 1000 * clean_scans[0].points, atol=1e-9)
        V = [r.name.outside(scout.model.pose(r.state)[0].vertices) for r in (before, after)]
        np.testing.assert_allclose(V[0], V[1], atol=1e-9)
    assert scout(1000 * clean_scans[0].points).state.scale == pytest.approx(1.0, abs=0.1)


# ---- which of them are followed, on known ones ----


def test_a_finger_that_every_start_has_wrong_is_put_in_its_place():
    rig = lbs.load_rig("hand-coarse")
    bent = np.zeros_like(rig.lower)
    finger = [rig.joint_names.index(f"index{k}") for k in (1, 2, 3)]
    bent[finger, 0] = 0.9 * rig.upper[finger, 0]
    (scan,) = lbs.synthesize(rig, 1, poses=bent[None], random_state=0, **CLEAN)
    scout = _untrained(rig, np.stack([np.zeros_like(bent), bent]), effort="fast", proportions=False)
    assert error_of(rig, scout(scan.points), scan) < 0.02  # without other poses for limbs 0.05


@pytest.mark.parametrize("right", ["labels", "library"])
def test_the_better_one_of_labels_and_library_goes_on(tube_rig, right, monkeypatch):
    """The others start from behind, and stay there."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=41, poses=np.zeros((1, 4, 3)), **CLEAN)
    behind = np.zeros((2, 4, 3))
    behind[:, 0, 1] = np.pi
    half = tube_rig.size / 2
    uniform = SimpleNamespace(predict_proba=lambda points, scale, views: np.full((len(points), 4), 0.25), half=half)
    poses = np.zeros((2, 4, 3)) if right == "library" else behind
    scout = _untrained(tube_rig, poses, effort="fast", segmenter=uniform, proportions=False)

    def labelled(points, x_weights, frame):
        problem = Problem(frame.inside(points))
        return Runner(problem, scout._refit.placed(problem, behind[0] if right == "library" else np.zeros((4, 3))), frame)

    monkeypatch.setattr(scout, "_labelled", labelled)
    assert error_of(tube_rig, scout(scan.points), scan) < 0.03


@pytest.mark.parametrize(
    "before, after, best, rivals",
    [
        # What proportions leave of the best one's E, 0.3 of 1.2, is taken for what they would leave of the others', too.
        ((1.0, 1.2, 1.6, 3.0), (0.8, 0.3), 1, (0.8, 0.4, 0.75)),
        ((1.0, 1.2, 1.6, 3.0), (0.5, 0.9), 0, (0.9, 0.8, 1.5)),
        ((1.0, 2.5, 4.0), (0.4,), 0, (1.0, 1.6)),  # too much worse for proportions to be worth a try
    ],
)
def test_what_the_finals_leave_unexplained_chooses(tube_rig, before, after, best, rivals, monkeypatch):
    scout, frame, problem = _untrained(tube_rig), Frame(np.zeros(3), 1.0), Problem(np.zeros((9, 3)))
    runners = [Runner(problem, scout.model.rest().replace(translation=np.full(3, k)), frame, v) for k, v in enumerate(before)]
    left = iter(after)
    _only_finals(scout, runners, left, monkeypatch)
    found = scout(problem.X, once=True)
    assert found.value == min(after) and found.state.translation[0] == best and next(left, None) is None
    assert found.rivals == pytest.approx(rivals)


def _only_finals(scout, runners, left, monkeypatch):
    """All steps of a look do nothing, but for the finals, who are left with these values."""
    steps = {"first_steps": lambda r: r, "last_steps": lambda r: r, "with_other_limbs": lambda r, limbs: r}
    monkeypatch.setattr(scout, "_refit", SimpleNamespace(**steps))
    for step, answer in (("_runners", runners), ("_facings", [])):
        monkeypatch.setattr(scout, step, lambda *given, answer=answer: answer)
    monkeypatch.setattr(scout, "_distinct", lambda given: given)
    monkeypatch.setattr(scout, "_ended", lambda r: replace(r, value=next(left)))


@pytest.mark.parametrize("effort, finals, tried", [("fast", 1, False), ("balanced", 2, True), ("thorough", 2, True)])
def test_other_bends_are_tried_of_the_best_one(tube_rig, effort, finals, tried, monkeypatch):
    """What they make of it is found; the rivals are judged by what proportions have made of it."""
    scout, frame, problem = _untrained(tube_rig, effort=effort), Frame(np.zeros(3), 1.0), Problem(np.zeros((9, 3)))
    runners = [Runner(problem, scout.model.rest().replace(translation=np.full(3, k)), frame, v) for k, v in enumerate((1.0, 1.2))]
    left, asked = iter([0.8, 0.3][:finals]), []
    _only_finals(scout, runners, left, monkeypatch)

    def bends(problem, state, value):
        asked.append((problem, state.translation[0], value))
        return state.replace(theta=np.full((4, 3), 0.1)), 0.2

    monkeypatch.setattr(scout, "_bends", bends)
    found = scout(problem.X, once=True)
    best = 0.3 if finals == 2 else 0.8
    assert asked == ([(problem, finals - 1, best)] if tried else [])
    assert found.value == (0.2 if tried else best) and (found.state.theta == 0.1).all() == tried
    assert found.state.translation[0] == finals - 1 and found.rivals == pytest.approx((0.8,) if finals == 2 else (1.2 * 0.8,))


def test_bends_are_tried_under_what_is_known(tube_rig):
    """Of scans of one side, of a scale that is known, of a template that is known; not where vertices alone are to tell."""
    known = {"scale": "fixed", "partial": True, "polish_ridge": 7e-5}
    scout = _untrained(tube_rig)
    scout = Scout(scout.model, scout.library, scout.facing, None, FitSettings(**known))
    assert scout._bends._free == scout._free == ("pose", "translation")
    last, side = scout._to_the_end.__self__._steps, Coverage(one_sided=True)
    assert scout._bends._steps.coverage == last.coverage == side and scout._bends._steps.ridge == last.ridge == 7e-5
    scout = Scout(scout.model, scout.library, scout.facing, None, FitSettings(**known), proportions=False)
    assert scout._to_the_end == scout._refit.to_the_end
    assert scout._bends._steps.coverage == side and not scout._bends._proportions
    problem, start = sampled(scout.model, scout.model.rest(), 3000)[0], scout.model.rest().replace(translation=np.full(3, 0.02))
    (state, value), (end, left) = scout._to_the_end(problem, start), scout._refit.to_the_end(problem, start)
    np.testing.assert_array_equal(state.theta, end.theta)
    assert value == left < 1e-4
    assert Scout(scout.model, scout.library, scout.facing, None, FitSettings(polish=0))._bends is None


@pytest.mark.parametrize("orientation, halves", [("aligned", ""), ("upright", "y"), ("any", "yxz")])
def test_labels_are_read_under_half_turns_as_well(tube_rig, orientation, halves):
    """Front for back; where any side may be up, upside down, too."""
    scout, own = _untrained(tube_rig, orientation=orientation), Frame(np.array([1.0, 2.0, 3.0]), 5.0, any_turn(7))
    frames = scout._facings([Runner(None, None, own)])
    assert frames[0] is own and len(frames) == 1 + len(halves)
    for frame, axis in zip(frames[1:], halves):
        half = np.where(np.array(list("xyz")) == axis, 1.0, -1.0)
        np.testing.assert_allclose(own.turn.T @ frame.turn, np.diag(half), atol=1e-12)
        assert frame.unit == own.unit and frame.centre is own.centre


def test_labels_are_read_under_turns_that_are_apart(tube_rig):
    runners = [Runner(None, None, Frame(np.zeros(3), 1.0, upright(a))) for a in (0.3, 0.8, 1.5, 3.4, 2.0, -1.0)]
    for effort, own in (("balanced", [0, 2, 5]), ("fast", [0])):  # the second of all is the half turn
        frames = _untrained(tube_rig, orientation="upright", effort=effort)._facings(runners)
        assert [f for f in frames if f is not frames[1]] == [runners[k].name for k in own]
