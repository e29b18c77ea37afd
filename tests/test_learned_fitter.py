"""A learned fitter between fits: what it makes ready once, what its copies and files hold, the digest that results carry."""

import copy
import pickle
import re
import types
from dataclasses import replace
from enum import Enum

import numpy as np
import pytest
from sklearn.base import clone
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.refit import Refit
from lbsfit_np.learning import new_scan
from lbsfit_np.learning.archive import learned_digests, model_digest
from lbsfit_np.learning.batch import fit_scans
from lbsfit_np.learning.parameters import learned_with
from lbsfit_np.losses.objective import LossWeights

QUICK = {"effort": "fast", "training_scans": 40, "training": {"n_points": 200}, "rounds": 1, "random_state": 0, "variant": "cd"}
PREPARED = ("_ready", "_prepared")

pytestmark = pytest.mark.usefixtures("hurried_learning")


@pytest.fixture(scope="module")
def clouds(tube_rig):
    templates = [(s.vertices, s.joints) for s in (tube_rig.subject(3), tube_rig.subject(4))]
    return [s.points for s in lbs.synthesize(tube_rig, 4, templates=templates, random_state=1, n_points=400)]


@pytest.fixture(scope="module")
def learned(tube_rig, clouds, hurried_learning):
    """Of two subjects; nobody changes it."""
    return lbs.LBSFitter(tube_rig, **QUICK).fit(clouds, list("abab"))


@pytest.fixture(scope="module")
def by_itself(tube_rig, clouds):
    """A fitter that has not learned, and its fit of the first scan."""
    fitter = lbs.LBSFitter(tube_rig, **QUICK)
    return fitter, fitter.fit_scan(clouds[0])


@pytest.fixture(scope="module")
def plain(learned, clouds):
    """The fit of the first scan."""
    return learned.fit_scan(clouds[0], subject="a")


@pytest.fixture
def own(learned):
    """A copy that a test may change."""
    fitter = copy.copy(learned)
    fitter.template_, fitter.unit_ = dict(learned.template_), dict(learned.unit_)
    return fitter


@pytest.fixture
def prepared(monkeypatch):
    """The rigs that fits were made ready for, as they are."""
    made, init = [], Refit.__init__

    def counting(self, model, *a, **k):
        made.append(model.source)
        init(self, model, *a, **k)

    monkeypatch.setattr(Refit, "__init__", counting)
    return made


# ---- made ready once ----


def test_templates_are_made_ready_once(own, clouds, prepared):
    first = own.fit_scan(clouds[0])
    own.fit_scan(clouds[1], subject="b")
    assert {id(rig) for rig in prepared} == {id(rig) for rig in (*own.template_.values(), own.rig)}
    count = len(prepared)
    again = own.fit_scan(clouds[0])
    own.fit_scan(clouds[1], subject="b")
    own.fit_scan(clouds[1], theta0=first.pose)
    assert len(prepared) == count
    np.testing.assert_array_equal(first.vertices, again.vertices)


def test_a_scan_of_a_unit_of_its_own_leaves_no_trace(own, clouds):
    plain = own.fit_scan(clouds[0], subject="a")
    for options in ({"subject": "a"}, {"subject": "a", "theta0": plain.pose}):
        before = own.fit_scan(clouds[0], **options)
        assert own.fit_scan(250.0 * clouds[0], **options).scale == pytest.approx(250.0, rel=0.1)
        after = own.fit_scan(clouds[0], **options)
        assert before.scale == after.scale == 1.0
        np.testing.assert_array_equal(before.vertices, after.vertices)


@pytest.mark.parametrize(
    "change",
    [
        {"weights": "paper", "registration": False},
        {"weights": LossWeights(lam_lap=10.0), "registration": False},
        {"max_points": 100},
    ],
)
def test_other_parameters_count_at_once(change, own, learned, clouds, plain):
    own.fit_scan(clouds[0], subject="a")
    found = own.set_params(**change).fit_scan(clouds[0], subject="a")
    fresh = copy.copy(learned).set_params(**change).fit_scan(clouds[0], subject="a")
    np.testing.assert_array_equal(found.vertices, fresh.vertices)
    assert not np.array_equal(found.vertices, plain.vertices)


def test_joints_of_learned_templates_stay_whatever_joints_says(own, clouds, plain):
    """A residual moves none; of somebody else's scan, with proportions of its own, it counts."""
    found = own.set_params(joints="fixed").fit_scan(clouds[0], subject="a")
    np.testing.assert_array_equal(found.vertices, plain.vertices)
    np.testing.assert_array_equal(found.rest_joints, own.template_["a"].joints)


def test_another_template_counts_at_once(own, clouds):
    before = own.fit_scan(clouds[0], subject="a")
    own.template_["a"] = own.template_["b"]
    after, other = own.fit_scan(clouds[0], subject="a"), own.fit_scan(clouds[0], subject="b")
    np.testing.assert_array_equal(after.vertices, other.vertices)
    assert not np.array_equal(after.vertices, before.vertices)


def test_subjects_that_are_gone_are_forgotten(own, clouds, prepared):
    own.fit_scan(clouds[0])
    del own.template_["a"], own.unit_["a"]
    own.template_["b"] = replace(own.template_["b"])
    own.fit_scan(clouds[0])
    assert {key[0] for key in own._prepared} - {None} == {"b"} and any(rig is own.template_["b"] for rig in prepared)


def _as_many(fitter, n):
    """The fitter with the templates of its two subjects as those of n."""
    ids = [f"s{k}" for k in range(n)]
    fitter.template_ = {s: replace(fitter.template_["ab"[k % 2]]) for k, s in enumerate(ids)}
    fitter.unit_ = dict.fromkeys(ids, 1.0)
    return ids


def test_templates_of_few_subjects_at_a_time_are_kept_ready(own):
    settings = new_scan.fit_settings(own)
    ids = _as_many(own, new_scan._READY + 3)
    for s in [*ids[:-1], ids[3], ids[-1]]:
        kept = new_scan._template_fit(own, s, settings)
        assert new_scan._template_fit(own, s, settings) is kept
    assert {key[0] for key in own._prepared} == {*ids[4:], ids[3]}  # those asked for last


def test_templates_that_are_ready_are_looked_at_first(own, clouds, prepared, monkeypatch):
    """So that of many subjects no more than need be are made ready anew for a scan of nobody named."""
    monkeypatch.setattr(new_scan, "_READY", 12)
    _as_many(own, new_scan._READY + 2)
    found = own.fit_scan(clouds[0])
    count = len(prepared)
    again = own.fit_scan(clouds[0])
    assert len(prepared) - count <= 3 * 2 + new_scan._SEVERAL
    np.testing.assert_array_equal(found.vertices, again.vertices)


def test_of_many_subjects_few_are_fitted_in_full_where_the_pose_is_known(own, clouds, plain, monkeypatch):
    asked, given = [], new_scan._given
    monkeypatch.setattr(new_scan, "_given", lambda fitter, s, *place: asked.append(s) or given(fitter, s, *place))
    ids = _as_many(own, 7)
    found = own.fit_scan(clouds[0], theta0=plain.pose)
    first, *others = asked
    assert first == ids[0] and 1 <= len(others) <= new_scan._SEVERAL
    alone = {s: given(own, s, *_place(own, clouds[0], plain.pose)) for s in ids[:2]}
    best = min(alone, key=lambda s: alone[s].value * alone[s].frame.unit ** 2)
    assert found.subject == "" or ids.index(found.subject) % 2 == ids.index(best)


def _place(fitter, points, theta0):
    """What a scan with a known pose is fitted by, without its subject."""
    settings = new_scan.fit_settings(fitter)
    return points, None, settings, 1.0, theta0, None


@pytest.mark.parametrize("variant, nearest", [("cd", False), ("joint", True)])
def test_new_scans_start_from_what_the_variant_allows(variant, nearest, own, clouds, monkeypatch):
    seen, scout = [], new_scan.Scout

    def seeing(*arguments, **options):
        seen.append(options["nearest"])
        return scout(*arguments, **options)

    monkeypatch.setattr(new_scan, "Scout", seeing)
    own.set_params(variant=variant)
    own._learned_with = learned_with(own)
    own.fit_scan(clouds[0], subject="a")
    assert set(seen) == {nearest}  # of a fit in doubt twice


@pytest.mark.parametrize("variant, learned_with_labels", [("joint", False), ("rand", False), ("cd", True)])
def test_what_was_learned_with_labels_is_not_used_without(variant, learned_with_labels, own, clouds, tmp_path):
    """Nor the other way round."""
    own._learned_with = (*own._learned_with[:2], learned_with_labels)
    own.set_params(variant=variant)
    how = "with" if learned_with_labels else "without"
    expected = f"variant: got '{variant}'; expected one {how} labels, as the fitter learned with. Learn again with this one."
    for use in (lambda: own.fit_scan(clouds[0]), lambda: own.transform(clouds[:1]), lambda: own.save(tmp_path / "x.npz")):
        with pytest.raises(InputError, match=re.escape(expected)):
            use()


def test_chamfer_alone_takes_no_labels(tube_rig, people_scans):
    scan = people_scans[0]
    with pytest.raises(InputError, match="labels: got known labels; expected None: the variant 'cd' does not use labels"):
        lbs.LBSFitter(tube_rig, variant="cd", random_state=0).fit_scan(scan.points, labels=scan.labels)


# ---- copies and files ----


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda fitter: pickle.loads(pickle.dumps(fitter))])
def test_copies_fit_the_same_without_what_was_made_ready(copied, own, clouds, plain):
    own._model()
    own.fit_scan(clouds[0], subject="a")
    assert all(name in vars(own) for name in PREPARED)
    other = copied(own)
    assert not any(name in vars(other) for name in PREPARED) and all(name in vars(own) for name in PREPARED)
    np.testing.assert_array_equal(other.fit_scan(clouds[0], subject="a").vertices, plain.vertices)
    assert other.get_params()["training_scans"] == 40 and model_digest(other) == model_digest(own)
    other.set_params(joints="fixed").fit_scan(clouds[0], subject="a")
    np.testing.assert_array_equal(own.fit_scan(clouds[0], subject="a").vertices, plain.vertices)


def test_clones_have_learned_nothing(own, clouds):
    own.fit_scan(clouds[0])
    assert set(vars(clone(own))) == set(own.get_params(deep=False))


@pytest.mark.parametrize("loaded", [False, True])
def test_a_fit_that_is_stopped_early_leaves_what_was_learned(loaded, own, clouds, tmp_path):
    """All of it: labels and starts of before learning do not go with learned templates."""
    if loaded:
        own.save(tmp_path / "m.npz")
        own = lbs.LBSFitter.load(tmp_path / "m.npz")
    else:
        own.set_params(training_scans=41)  # so that it pretrains anew
    own.set_params(held_out=0)
    before = own.regressor_, own.template_["a"], own.history_

    def stop(stage, share, figures=None):
        if stage == "first fits" and share > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        own.fit(clouds[:2], list("ab"), progress=stop)
    assert own._pretrained[1] is not before[0]
    assert own.regressor_ is before[0] and own.template_["a"] is before[1] and own.history_ is before[2]
    own.fit(clouds[:2], list("ab"))
    assert own.regressor_ is not before[0] and own.template_["a"] is not before[1]


@pytest.mark.parametrize("told", ["progress", "on_round"])
def test_a_round_is_there_for_those_who_are_told_of_it(told, own, clouds):
    """Who stops the run then does not lose it."""
    fitter = clone(own).set_params(held_out=0)

    def stop(*about):
        if about[0] == 1 or (about[0] == "round" and about[2]["round"] == 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitter.fit(clouds[:2], list("ab"), **{told: stop})
    assert [entry["round"] for entry in fitter.history_] == [0, 1] and list(fitter.template_) == ["a", "b"]
    assert fitter.results_ == [None] * 2


def test_a_free_form_fit_that_is_stopped_leaves_nothing_or_all(own, clouds, monkeypatch):
    fitter = clone(own).set_params(variant="free-form")

    def stop(stage, share):
        if share > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitter.fit(clouds, progress=stop)
    assert not any(name in vars(fitter) for name in ("template_", "history_", "results_", "segmenter_"))
    monkeypatch.setattr("lbsfit_np.learning.fitter.as_learned", None)  # an error once all is fitted
    with pytest.raises(TypeError):
        own.set_params(variant="free-form").fit(clouds[:3])
    assert own.results_ == [None] * 3 and own.roles_ == ["learned from"] * 3 and list(own.template_) == [0]


def test_mappings_of_training_travel(own, tmp_path):
    own.set_params(training=types.MappingProxyType({"n_points": 200})).save(tmp_path / "m.npz")
    assert lbs.LBSFitter.load(tmp_path / "m.npz").training == {"n_points": 200}


# ---- the digest ----


@pytest.mark.slow
def test_results_say_whose_template_they_are_on(learned, by_itself, clouds, tmp_path):
    assert [r.subject for r in learned.results_] == list("abab") and by_itself[1].subject == ""
    outcomes = fit_scans(learned, clouds[:3], subjects=["b", "a", None], n_jobs=2)
    assert [o.result.subject for o in outcomes][:2] == ["b", "a"]
    digests = [model_digest(learned, subject) for subject in ("b", "a", None)]
    assert [o.result.model_digest for o in outcomes] == digests
    outcomes[0].result.save(tmp_path / "r.npz")
    assert lbs.FitResult.load(tmp_path / "r.npz").subject == "b"
    numbers = lbs.LBSFitter(learned.rig, **QUICK).fit(clouds[:3])
    assert {r.subject for r in numbers.results_} == {"0"}
    with pytest.raises(InputError, match="subjects: got 'c' for scan 1; expected a learned subject: 'a', 'b'"):
        fit_scans(learned, clouds[:2], subjects=["a", "c"])
    with pytest.raises(InputError, match="subjects: got 1 id; expected 2, one for each scan"):
        fit_scans(learned, clouds[:2], subjects=["a"])


@pytest.mark.parametrize(
    "ids, others", [((1, 2), ("1", "2")), slow(("1", "2"), (1, 2)), slow(("1", "2"), (np.int64(1), np.str_("2")))]
)
def test_subjects_are_known_by_the_text_of_their_ids(ids, others, own, clouds):
    """The ids of results are text, and so are those that the command line learns with."""
    own.template_ = dict(zip(ids, own.template_.values()))
    own.unit_ = dict(zip(ids, own.unit_.values()))
    plain = [own.fit_scan(x, subject=s) for x, s in zip(clouds, ids)]
    assert [r.subject for r in plain] == ["1", "2"]
    found = [own.fit_scan(x, subject=s) for x, s in zip(clouds, others)]
    found += [o.result for o in fit_scans(own, clouds[:2], subjects=others)]
    for theirs, ours in zip(plain * 2, found, strict=True):
        np.testing.assert_array_equal(theirs.vertices, ours.vertices)
        assert (theirs.subject, theirs.model_digest) == (ours.subject, ours.model_digest)
    np.testing.assert_array_equal(own.transform(clouds[:2], others), [r.vertices for r in plain])
    listed = ", ".join(map(repr, ids))
    for given in ("3", 3, 1.0, 10**5000, ["1"], (["1"],)):
        words = f"subject: got .*; expected a learned subject: {listed}. Fit scans of other people without"
        with pytest.raises(InputError, match=words):
            own.fit_scan(clouds[0], subject=given)
    with pytest.raises(InputError, match=f"subjects: got '3' for scan 1; .*: {listed}. Pass None for scans of other people."):
        own.transform(clouds[:2], [*others[:1], "3"])


def test_results_say_which_model_they_were_made_with(learned, by_itself, clouds, tmp_path):
    (unlearned, alone), digest = by_itself, model_digest(learned)
    assert len(digest) == 64 and model_digest(unlearned) == alone.model_digest == ""
    found = learned.fit_scan(clouds[0])
    assert found.model_digest == digest
    of_learning = learned_digests(learned)  # its results stand for fits as their subject's as well as for fits as anybody's
    assert [r.model_digest for r in learned.results_] == [of_learning[s] for s in "abab"]
    assert found.settings["effort"] == learned.effort
    assert all(r.settings == found.settings | r.settings and r.settings["rounds"] == learned.rounds for r in learned.results_)
    assert len({digest, *of_learning.values(), *(model_digest(learned, s) for s in "ab")}) == 5
    assert learned_digests(unlearned) == {}
    assert learned.fit_scan(clouds[0], subject="a").model_digest == model_digest(learned, "a") != digest
    assert model_digest(learned, "a") != model_digest(learned, "b")
    found.save(tmp_path / "r.npz")
    assert lbs.FitResult.load(tmp_path / "r.npz").model_digest == digest
    alone.save(tmp_path / "r.npz")
    assert lbs.FitResult.load(tmp_path / "r.npz").model_digest == ""


def test_the_digest_survives_saving(learned, tmp_path):
    learned.save(tmp_path / "m.npz")
    loaded = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert model_digest(loaded) == model_digest(learned) and learned_digests(loaded) == learned_digests(learned)
    for typed in (np.str_, Enum("Text", {"CD": "cd", "FOLLOW": "follow"}, type=str)):
        own = copy.copy(learned).set_params(variant=typed(learned.variant), joints=typed("follow"))
        assert model_digest(own) == model_digest(learned)


def _moved(fitter):
    a = fitter.template_["a"]
    fitter.template_["a"] = a.with_template(a.vertices + 1e-9, a.joints)


def _other_joints(fitter):
    a = fitter.template_["a"]
    fitter.template_["a"] = a.with_template(a.vertices, a.joints + 1e-9)


def _less(fitter):
    del fitter.template_["b"]


def _renamed(fitter):
    fitter.template_ = {"c" if s == "b" else s: t for s, t in fitter.template_.items()}
    fitter.unit_["c"] = fitter.unit_["b"]


def _f(fitter):
    library = fitter.regressor_
    (weights, bias), *others = library.layers
    fitter.regressor_ = replace(library, layers=((weights, bias + np.float32(1e-3)), *others))


def _segmenter(rig):
    return lbs.LBSFitter(rig, **QUICK | {"variant": "joint"}).pretrain().segmenter_


CHANGES = {
    "a vertex": _moved,
    "a joint": _other_joints,
    "a subject less": _less,
    "a name": _renamed,
    "a unit": lambda fitter: fitter.unit_.update(a=2.0),
    "f": _f,
    "a segmenter": lambda fitter: setattr(fitter, "segmenter_", _segmenter(fitter.rig)),
    "the joints' way": lambda fitter: fitter.set_params(joints="fixed"),
    "another rig": lambda fitter: fitter.set_params(rig=fitter.rig.with_parts("arm and fingers")),
}


@pytest.mark.parametrize("change", CHANGES)
def test_whatever_was_learned_counts_for_the_digest(change, own, learned):
    assert model_digest(own) == model_digest(learned)
    CHANGES[change](own)
    assert model_digest(own) != model_digest(learned)


def test_settings_of_a_fit_do_not_count_for_the_digest(own, learned):
    own.set_params(max_points=100, weights="paper", random_state=7, n_jobs=2, scale="fixed")
    assert model_digest(own) == model_digest(learned)


def test_a_fitter_of_another_variant_is_refused_before_any_scan(learned, clouds):
    fitter = copy.copy(learned)
    fitter.variant = "joint"
    with pytest.raises(InputError, match="variant: got 'joint'; expected one without labels, as the fitter learned with"):
        fit_scans(fitter, clouds[:2])


def test_what_was_learned_is_taken_whole_or_not_at_all(tube_rig, clouds, monkeypatch):
    """Ctrl-C comes while templates are made."""
    fitter = lbs.LBSFitter(tube_rig, **QUICK, held_out=0).pretrain()
    library, make = fitter.regressor_, type(tube_rig).with_template

    def stopped(*given):
        monkeypatch.setattr(type(tube_rig), "with_template", make)
        raise KeyboardInterrupt

    def take(self, *given):
        monkeypatch.setattr(type(tube_rig), "with_template", stopped)
        return take_all(self, *given)

    take_all = lbs.LBSFitter._take
    monkeypatch.setattr(lbs.LBSFitter, "_take", take)
    with pytest.raises(KeyboardInterrupt):
        fitter.fit(clouds[:2], list("ab"))
    assert fitter.regressor_ is library and getattr(fitter, "template_", None) is None
