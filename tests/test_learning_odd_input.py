"""Learning with what people hand in by mistake: wild points, too few scans, lists that are none, absurd settings."""

import copy
import signal
import types
import warnings
from enum import Enum, IntEnum
from functools import partial, wraps
from unittest import mock

import numpy as np
import pytest
from segmenter_training import scans_of
from sklearn.exceptions import NotFittedError
from sklearn.utils.validation import check_is_fitted

import lbsfit_np as lbs
from lbsfit_np.errors import InputError, check_callables
from lbsfit_np.fitting.labels import labels_from_mesh
from lbsfit_np.learning.batch import _without_results, fit_scans
from lbsfit_np.learning.parameters import learned_with
from lbsfit_np.learning.reading import read_collection
from lbsfit_np.learning.subjects import as_subjects, check_ids, known_subject
from lbsfit_np.learning.training import training_settings
from lbsfit_np.segmentation.segmenter import train_segmenter
from lbsfit_np.segmentation.stage import Training
from lbsfit_np.synthesis import Synthesis

# Without a segmenter, learning takes a second or two.
QUICK = {"effort": "fast", "training_scans": 40, "training": {"n_points": 200}, "rounds": 1, "random_state": 0, "variant": "cd"}

pytestmark = pytest.mark.usefixtures("hurried_learning")


@pytest.fixture(scope="module")
def scans(tube_rig):
    return lbs.synthesize(tube_rig, 4, random_state=1, n_points=400)


@pytest.fixture(scope="module")
def clouds(scans):
    return [s.points for s in scans]


# ---- subjects in different units ----


@pytest.mark.parametrize("unit, scale", [(1.0, "estimate"), (2.54, "estimate"), (1.7, "fixed")])
def test_subjects_in_different_units_are_warned_of(unit, scale, tube_rig, clouds):
    given = [clouds[0], unit * clouds[1]]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitter = lbs.LBSFitter(tube_rig, scale=scale, held_out=0, **QUICK).fit(given, subjects=["a", "b"])
    apart = [str(w.message) for w in told if "times the scale of those of 'a': are they in another unit?" in str(w.message)]
    assert len(apart) == (unit != 1.0 and scale == "estimate")
    assert (fitter.unit_["b"] / fitter.unit_["a"] > 2) == (len(apart) == 1)


# ---- wild points ----


@pytest.mark.parametrize(
    "wild, variant", [([[1e200, 0, 0], [1e308, -1e308, 0], [-1e30, 1e30, 1e30]], "cd"), ([[9.0, 0, 0]], "free-form")]
)
def test_one_wild_point_does_not_end_learning(wild, variant, tube_rig, clouds):
    """It is left out, and the result says so; that of a new scan, too."""
    spoiled = [np.vstack([cloud, [point]]) for cloud, point in zip(clouds[1:], wild)]
    fitter = lbs.LBSFitter(tube_rig, **QUICK | {"variant": variant}, held_out=0).fit([clouds[0], *spoiled])
    assert not fitter.failures_ and all(len(r.labels) == len(clouds[1]) + 1 for r in fitter.results_[1:])
    told = [r.message for r in (*fitter.results_, *map(fitter.fit_scan, spoiled))]
    assert ["far from all others" in message for message in told] == [False, *[True] * 2 * len(wild)], told


def test_labels_of_points_near_and_far():
    V = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    near = np.random.default_rng(0).uniform(-5, 5, (50, 3))
    far = np.array([[1e200, 0, 0], [-1e300, -1e300, 0], [0, 1e8, 0]])
    proba = np.full((3, 2), 0.5)
    for known in ({}, {"proba": proba, "proba_points": V}):
        labels, confidence = labels_from_mesh(np.vstack([near, far]), V, np.array([0, 1, 1]), 2, 0.1, **known)
        alone = labels_from_mesh(near, V, np.array([0, 1, 1]), 2, 0.1, **known)
        np.testing.assert_array_equal(labels[:50], alone[0])
        np.testing.assert_array_equal(confidence[:50], alone[1])
        assert labels[[50, 52]].tolist() == [1, 1] and ((confidence > 0) & (confidence <= 1)).all()


# ---- too few to leave any out ----


@pytest.mark.parametrize("share, enough, left_out", [(0.01, 3, 1), (0.1, 3, 1), (0.5, 4, 2), (0.75, 6, 4), (0.9, 16, 14)])
def test_how_many_scans_are_enough_is_said(share, enough, left_out, tube_rig, clouds):
    options = {"max_points": 100, "held_out": share, "scale": "estimate", "random_state": 0}
    with pytest.raises(InputError, match=f"at least {enough}, so that {left_out} can be held out"):
        read_collection(tube_rig, clouds[:2], None, **options)
    given = [clouds[0]] * enough
    assert sum(m.held_out for m in read_collection(tube_rig, given, None, **options).members) == left_out
    with pytest.raises(InputError, match=f"at least {enough}"):
        read_collection(tube_rig, given[1:], None, **options)


# ---- no lists of scans, no lists of ids ----


@pytest.mark.parametrize(
    "given, words", [(5, "a int"), (None, "a NoneType"), ("scans", "a str"), (b"x", "a bytes"), (np.array(None), "a ndarray")]
)
def test_scans_that_are_no_sequence(given, words, tube_rig, learned):
    for call in (lbs.LBSFitter(tube_rig, **QUICK).fit, learned.transform, learned.score):
        with pytest.raises(InputError, match=f"scans: got {words}; expected a sequence of scans"):
            call(given)


def test_a_first_training_alone_is_no_learning(learned, tube_fitter):
    check_is_fitted(learned)
    for fitter in (tube_fitter, lbs.LBSFitter(tube_fitter.rig)):
        with pytest.raises(NotFittedError):
            check_is_fitted(fitter)


def test_processes_are_sent_no_results(learned, clouds):
    sent = _without_results(learned)
    assert not hasattr(sent, "results_") and len(learned.results_) == len(clouds)
    assert set(vars(learned)) - set(vars(sent)) - {"_ready", "_prepared"} == {"results_"}


def test_a_single_scan_wants_a_list(learned, clouds):
    for call in (learned.fit, learned.transform):
        with pytest.raises(InputError, match="scans: got a Scan; .* Put a single scan in a list[.]"):
            call(lbs.Scan(clouds[0]))


class Frame:
    """What a data frame is to us: two-dimensional, and its names where one goes through it."""

    def __init__(self, points):
        self._points, self.ndim, self.shape = points, 2, points.shape

    def __array__(self, dtype=None, copy=None):
        return self._points

    def __len__(self):
        return len(self._points)

    def __iter__(self):
        return iter("xyz")


def test_a_data_frame_is_one_scan(learned, clouds):
    for call in (learned.fit, learned.transform):
        with pytest.raises(InputError, match=r"scans: got one array of shape \(.*, 3\); .* Put a single scan in a list[.]"):
            call(Frame(clouds[0]))


@pytest.mark.parametrize("ids", ["abcd", 5, iter("abcd"), np.array("a")])
def test_ids_that_are_no_sequence(ids, learned, clouds):
    for call in (learned.transform, learned.score):
        with pytest.raises(InputError, match="subjects: got .*; expected a sequence with one id for each scan"):
            call(clouds, ids)


@pytest.mark.parametrize("ids", [{0: 1, 1: 1, 2: 2, 3: 2}, {"a", "b", "c", "d"}])
def test_ids_without_the_order_of_the_scans(ids, learned, clouds):
    """A dict's keys would be taken for ids, a set has them in any order."""
    with pytest.raises(InputError, match="subjects: got a (dict|set); .* Make a list, in the order of the scans"):
        learned.transform(clouds, ids)
    with pytest.raises(InputError, match=r"scans: got a dict; expected a sequence of scans. Pass list\(scans.values"):
        learned.transform(dict(enumerate(clouds)))
    with pytest.raises(InputError, match="scans: got a set; .* a set has no order"):
        learned.transform({lambda: clouds[0], lambda: clouds[1]})


def test_a_callable_that_raises_costs_its_scan_alone(learned, clouds):
    def broken():
        raise ZeroDivisionError("of the user")

    with pytest.warns(UserWarning, match="scan 1 cannot be fitted: ZeroDivisionError: of the user"):
        vertices = learned.transform([clouds[0], broken, lambda: clouds[1]])
    assert np.isnan(vertices[1]).all() and np.isfinite(vertices[[0, 2]]).all()
    with pytest.raises(InputError, match="scans: got none"):
        learned.score([])


def test_an_interrupt_that_a_reader_makes_an_error_of_ends_learning(tube_rig, clouds):
    def interrupted():
        try:
            signal.raise_signal(signal.SIGINT)
        except BaseException:  # noqa: BLE001 (as a careless reader does)
            raise TypeError("of a library") from None

    options = {"max_points": 200, "held_out": 0.0, "scale": "fixed", "random_state": 0}
    with pytest.raises(KeyboardInterrupt):
        read_collection(tube_rig, [clouds[0], interrupted, *clouds[1:]], None, **options)


def test_learning_goes_on_with_the_layers_of_a_given_segmenter(tube_rig, clouds):
    training = Training(points_per_scan=60, hidden=(16,))
    given = train_segmenter(tube_rig, scans_of(tube_rig, 4), 4, training=training, random_state=0)
    fitter = lbs.LBSFitter(tube_rig, **QUICK | {"variant": "joint", "held_out": 0.0}).pretrain(segmenter=given).fit(clouds[:2])
    assert fitter.segmenter_ is not given and [stage.hidden for stage in fitter.segmenter_.stages] == [(16,), (16,)]


class Who(str, Enum):  # noqa: UP042 (whose text is "Who.ANNA")
    ANNA = "anna"


class Number(IntEnum):
    TWO = 2


def test_ids_that_are_members_of_an_enum_are_what_these_stand_for():
    found = as_subjects([Who.ANNA, Number.TWO, np.str_("x"), np.int8(3)], 4)
    assert found == ["anna", 2, "x", 3] and [type(s) for s in found] == [str, int, str, int]
    assert known_subject({"anna": None, 2: None}, Who.ANNA) == "anna" and type(known_subject({2: None}, Number.TWO)) is int
    with pytest.raises(InputError, match="got 'anna' for scan 0 and 'anna '|ids that"):
        check_ids(as_subjects([Who.ANNA, "anna "], 2))


def test_what_is_called_late_is_looked_at_before_any_work(learned, clouds):
    for name in ("progress", "on_round"):
        with pytest.raises(InputError, match=f"{name}: got 'x'; expected a function, or None"):
            learned.fit(clouds, **{name: "x"})
    with pytest.raises(InputError, match="progress: got 3; expected a function, or None"):
        learned.pretrain(progress=3)
    with pytest.raises(InputError, match="segmenter: got a str; expected a Segmenter. Read one with Segmenter.load"):
        learned.pretrain(segmenter="s.npz")
    for function in (lambda stage, share: None, lambda: None, lambda stage, share, figures, more: None):
        with pytest.raises(InputError, match=r"progress: got one that takes other .* as progress\(stage, share(, figures)?\)"):
            learned.fit(clouds, progress=function)
    with pytest.raises(InputError, match=r"on_round: got .*called as on_round\(k, s\)"):
        learned.fit(clouds, on_round=lambda k: None)
    with pytest.raises(InputError, match=r"finish: got .*called as finish\(index, scan, result\)"):
        fit_scans(learned, clouds, finish=lambda result: None)
    check_callables(progress=(print, (("share",),)), finish=(max, (("index", "scan"),)))  # which may say nothing of themselves
    wrapped = wraps(lambda context, k, s: None)(lambda k, s: None)  # as decorators leave them that add an argument
    check_callables(on_round=(wrapped, (("k", "s"),)), progress=(mock.call, (("share",),)))


def test_a_reader_may_use_one_array_for_all_scans(tube_rig, clouds, monkeypatch):
    room = np.empty((400, 3))

    def read(cloud):
        room[:] = cloud
        return room

    options = {"held_out": 0.0, "scale": "estimate", "max_points": 400, "random_state": 0}
    found = read_collection(tube_rig, [partial(read, c) for c in clouds], None, **options)
    for member, cloud in zip(found.members, clouds, strict=True):
        np.testing.assert_array_equal(member.points, cloud)


@pytest.mark.parametrize("ids", [[None, float("nan"), None, None], [["a"], None, None, None], [b"0", None, None, None]])
def test_what_is_no_id_is_not_taken_for_one_that_is_misspelt(ids, learned, clouds):
    with pytest.raises(InputError, match="for scan [01]; expected a learned subject: 0. Pass None for scans of other people.$"):
        learned.transform(clouds, ids)


def test_an_unknown_subject_is_said_once_before_any_work(tube_rig, learned, clouds):
    for fitter in (learned, lbs.LBSFitter(tube_rig)):
        with pytest.raises(InputError, match="subjects: got 'nobody' for scan 0; expected (a learned subject: 0|no subject, as)"):
            fit_scans(fitter, clouds, subjects=["nobody"] * len(clouds))


def test_ids_of_numpy_are_those_of_python(learned, clouds):
    ours = learned.transform(clouds[:2], np.array([0, 0]))
    np.testing.assert_array_equal(ours, learned.transform(clouds[:2], [0, 0]))


def test_none_among_subjects_is_nobody_known(learned, clouds):
    ours = learned.transform(clouds[:2], [0, None])
    for theirs, subject in zip(ours, (0, None)):
        np.testing.assert_array_equal(theirs, learned.fit_scan(clouds[1 if subject is None else 0], subject=subject).vertices)


@pytest.mark.parametrize("given", [True, np.True_, False])
def test_a_bool_is_no_subject(given, learned, clouds):
    with pytest.raises(InputError, match=f"subject: got {bool(given)}; expected a learned subject: 0"):
        learned.fit_scan(clouds[0], subject=given)


# ---- absurd settings ----


@pytest.mark.parametrize(
    "training, words",
    [
        ({"n_points": 10**30}, "training: got n_points: 1000.*at most 10000000"),
        ({"n_points": 10**5000}, "training: got n_points: a number of several thousand digits"),
        ({"holes": 10**30}, "training: got holes: 1000.*at most 1000"),
        ({"noise": 1e300}, "training: got noise: 1e\\+300.*at most 1. It is in half sizes of the rig"),
        ({"noise": 5}, "training: got noise: 5; expected a number of at least 0 and at most 1. It is in half sizes of the rig."),
        ({"hole_radius": 50}, "training: got hole_radius: 50"),
        ({"nose": 0.1}, "training: got nose: an unknown setting.*Did you mean 'noise'?"),
        ({"shape": 1e300}, "shape: "),
        ({"turn": 1e300}, "turn: "),
        ({"density": 1e300}, "density: "),
        (Synthesis(n_points=10**30), "training: got n_points: 1000"),
        (Synthesis(noise=-1.0), "training: got noise: -1.0"),
        ({"trun": 1.0}, "training: got trun: an unknown setting"),
        ({"holes": 0, "least_holes": 1}, "training: got least_holes: 1; expected at most 0, the value of holes. Set holes, too."),
    ],
)
def test_training_that_cannot_be_computed_is_named_before_any_work(training, words, tube_rig, clouds, monkeypatch):
    def never(*a, **k):
        pytest.fail("worked first")

    for name in ("fitter.read_collection", "pretraining.pretrain_library", "pretraining.pretrain_segmenter"):
        monkeypatch.setattr(f"lbsfit_np.learning.{name}", never)
    fitter = lbs.LBSFitter(tube_rig, **QUICK | {"training": training})
    calls = (fitter.pretrain, lambda: fitter.fit(clouds), lambda: fitter.fit_scan(clouds[0]), lambda: fit_scans(fitter, clouds))
    for call in calls:
        with pytest.raises(InputError, match=words):
            call()


def test_training_within_bounds():
    assert training_settings(None) == Synthesis(scale=0.05)
    assert training_settings({"scale": 0.2, "n_points": 10**7}) == Synthesis(scale=0.2, n_points=10**7)
    assert training_settings(types.MappingProxyType({"turn": 3.0})) == Synthesis(scale=0.05, turn=3.0)
    assert training_settings(Synthesis(turn=1.0)) == Synthesis(turn=1.0)


# ---- free-form: nothing to start from, no parts ----


@pytest.fixture(scope="module")
def learned(tube_rig, clouds, hurried_learning):
    return lbs.LBSFitter(tube_rig, **QUICK).fit(clouds)


@pytest.mark.parametrize("when", ["before fit", "after fit"])
def test_starts_and_labels_where_vertices_move_freely(when, tube_rig, scans, clouds, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained"))
    fitter = lbs.LBSFitter(tube_rig, **QUICK | {"variant": "free-form"})
    if when == "after fit":
        fitter.fit(clouds)
    s = scans[0]
    with pytest.raises(InputError, match="theta0: got a ndarray; expected None: .*'free-form'"):
        fitter.fit_scan(s.points, theta0=s.pose)
    with pytest.raises(InputError, match="labels: got a ndarray; expected None: .*'free-form'"):
        fitter.fit_scan(s.points, labels=s.labels)
    found = fitter.fit_scan(s.points)
    assert "free-form" in found.message and not found.pose[1:].any()
    np.testing.assert_array_equal(fit_scans(fitter, clouds[:1])[0].result.vertices, found.vertices)


# ---- scale ----


@pytest.mark.slow
def test_a_fixed_scale_is_1_whatever_was_learned(tube_rig, learned, scans, clouds):
    other = lbs.LBSFitter(tube_rig, **QUICK)
    vars(other).update({k: v for k, v in vars(learned).items() if k.endswith("_") or k == "_learned_with"})
    for unit in (1.5, 250.0):
        other.unit_ = {0: unit}
        for options in ({}, {"theta0": scans[0].pose}):
            assert other.set_params(scale="fixed").fit_scan(clouds[0], **options).scale == 1.0
        labelled = copy.copy(other).set_params(variant="rand")  # as cd takes no labels
        labelled._learned_with = learned_with(labelled)
        assert labelled.fit_scan(clouds[0], labels=scans[0].labels).scale == 1.0
    other.unit_ = {0: 1.5}
    assert other.set_params(scale="estimate").fit_scan(clouds[0]).scale != 1.0


@pytest.mark.parametrize("factor", [1.0, 1.6])
def test_a_fixed_scale_is_named_where_the_fit_is_wrong_and_another_was_learned(factor, learned, clouds):
    other = copy.copy(learned).set_params(scale="fixed")
    other.unit_ = {0: factor}
    r = other.fit_scan(1.6 * clouds[0])
    words = "; the template was learned at 1.6 scan units in a rig unit, which scale 'fixed' does not allow: leave that out"
    assert r.status != "ok" and (words in r.message) == (factor > 1)
