"""The fitter as an estimator: conventions, seeds, and the same result each time."""

from dataclasses import replace

import numpy as np
import pytest
import sklearn.utils
from fit_checks import assert_same
from sklearn.base import clone
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning import pretraining
from lbsfit_np.learning.batch import fit_scans
from lbsfit_np.learning.checkpoint import digest_of
from lbsfit_np.learning.pretraining import pretrained_from, share_pretraining, still_given
from lbsfit_np.losses import PRESETS
from lbsfit_np.segmentation import cache
from lbsfit_np.synthesis import Synthesis


@pytest.mark.usefixtures("hurried")
def test_a_seed_decides_all(tube_rig, tube_scan):
    def fit(seed):
        small = {"effort": "fast", "training_scans": 4, "training": {"n_points": 300}, "max_points": 400}
        fitter = lbs.LBSFitter(tube_rig, random_state=seed, **small)
        return fitter.fit_scan(tube_scan.points)

    a, b, c = fit(3), fit(3), fit(4)
    assert_same(a, b)
    assert not np.array_equal(a.vertices, c.vertices)


@pytest.mark.slow
def test_threads_change_nothing(tube_rig, tube_scan):
    from threadpoolctl import threadpool_limits

    results = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            small = {"effort": "fast", "training_scans": 8, "training": {"n_points": 400}}
            fitter = lbs.LBSFitter(tube_rig, random_state=0, **small).pretrain()
            results.append(fitter.fit_scan(tube_scan.points[:500]))
    assert_same(*results)


@pytest.mark.slow
def test_one_scan_does_not_change_the_next(tube_rig, tube_fitter, tube_scan, tube_result):
    """Fitted again, it has the same result."""
    tube_fitter.fit_scan(lbs.synthesize(tube_rig, 1, random_state=1, n_points=400)[0].points)
    assert_same(tube_fitter.fit_scan(tube_scan.points), tube_result)


@pytest.mark.parametrize("seed", [None, "generator"])
def test_other_kinds_of_seeds_work(tube_rig, tube_scan, seed):
    seed = np.random.default_rng(0) if seed == "generator" else seed
    small = {"effort": "fast", "training_scans": 2, "training": {"n_points": 100}, "max_points": 300}
    fitter = lbs.LBSFitter(tube_rig, random_state=seed, **small)
    result = fitter.fit_scan(tube_scan.points)
    assert np.isfinite(result.vertices).all() and 0 <= result.probability <= 1  # two training scans of any seed: no more is sure


# ---- the estimator ----


def test_sklearns_conventions(tube_rig, tube_fitter):
    fitter = lbs.LBSFitter(tube_rig, training_scans=7, training={"turn": 0.5}, weights=PRESETS["paper"], random_state=3)
    parameters = fitter.get_params()
    assert parameters["rig"] is tube_rig and parameters["training_scans"] == 7
    names = {"rig", "weights", "joints", "scale", "max_points", "training_scans", "training", "n_jobs", "random_state"}
    names |= {"orientation", "up", "partial", "cropped", "effort", "unit", "registration"}
    assert set(parameters) == names | {"variant", "rounds", "held_out", "sequence", "smooth"}
    another = clone(fitter)
    assert another is not fitter and another.get_params() == parameters
    fresh = clone(tube_fitter)
    assert not hasattr(fresh, "segmenter_") and fresh.rig is tube_rig
    assert fitter.set_params(scale="fixed").scale == "fixed"
    words = repr(fitter)
    assert words.startswith("LBSFitter(rig=<Rig ") and "training_scans=7" in words and "scale='fixed'" in words
    assert "effort" not in words  # which is the default
    with pytest.raises(ValueError, match="sped: got an unknown argument; expected one of rig, .*") as error:
        fitter.set_params(joints="fixed", sped=2)
    assert fitter.joints == "follow" and isinstance(error.value, InputError)

    class Own(lbs.LBSFitter):
        def __init__(self, rig, *, speed=1, **others):
            super().__init__(rig, **others)
            self.speed = speed

    assert Own(tube_rig, speed=2).get_params() == {"rig": tube_rig, "speed": 2}
    tags = getattr(sklearn.utils, "get_tags", lambda estimator: None)(fitter)  # which scikit-learn has since 1.6
    assert tags is None or tags.requires_fit


class Own(lbs.LBSFitter):
    """One that settles parameters itself, and has another."""

    def __init__(self, rig, *, speed=1, random_state=None):
        super().__init__(rig, random_state=random_state, variant="free-form", max_points=100)
        self.speed = speed


def test_a_subclass_may_settle_parameters(tube_rig, tube_scan, tmp_path):
    own = Own(tube_rig, speed=2, random_state=0).fit([tube_scan.points])
    settings = own.results_[0].settings
    assert (settings["speed"], settings["max_points"], settings["weights"]) == (2, 100, "default")
    own.max_points = 90
    assert digest_of(own._made_of(0)) != digest_of(Own(tube_rig, speed=2, random_state=0)._made_of(0))
    own.save(tmp_path / "own.npz")
    again = Own.load(tmp_path / "own.npz")
    assert (again.speed, again.max_points, again.variant, list(again.template_)) == (2, 90, "free-form", [0])


def test_numbers_of_numpy_are_those_of_python(tube_rig, monkeypatch):
    """What was trained, and steps that were kept, are found again."""
    keys = []
    monkeypatch.setattr(pretraining, "cached", lambda kind, key, train, load: keys.append((kind, digest_of(key), repr(key))))
    for n in (40, np.int64(40)):
        made_of = tube_rig, Synthesis(), n
        options = {"random_state": 0, "cache": True, "progress": None}
        pretraining.pretrain_segmenter(*made_of, n_jobs=1, **options)
        pretraining.pretrain_library(*made_of, jobs=1, **options)
    assert keys[:2] == keys[2:]
    assert digest_of([3, 0.5]) == digest_of((np.int64(3), np.float64(0.5))) != digest_of((3, 0.6))


@pytest.mark.parametrize("shows, n", [({}, 20), ({"one_sided": True}, 20), ({"one_sided": True, "cropped": 0.5}, 80)])
def test_the_library_has_more_scans_where_these_differ_by_more_than_poses(tube_rig, monkeypatch, shows, n):
    made = []
    monkeypatch.setattr(pretraining, "build_library", lambda scans, n_scans, **options: made.append(n_scans))
    options = {"random_state": 0, "jobs": 1, "cache": False, "progress": None}
    pretraining.pretrain_library(tube_rig, Synthesis(**shows), 40, **options)
    assert made == [n]


def test_the_constructor_only_stores(tube_scan):
    fitter = lbs.LBSFitter("no rig", weights="none", training_scans=-1)
    assert fitter.rig == "no rig" and fitter.training_scans == -1
    with pytest.raises(InputError, match="rig: got str"):
        fitter.fit_scan(tube_scan.points)


def test_pretrain_returns_itself_and_shows_progress(fitter):
    seen = []
    assert fitter.pretrain(progress=seen.append) is fitter
    assert len(seen) > 2 and (np.diff(seen) >= -1e-12).all()
    assert 0 < seen[0] < 0.5 and seen[-1] == pytest.approx(1.0)
    assert hasattr(fitter, "segmenter_")


@pytest.mark.usefixtures("hurried")
def test_a_segmenter_of_another_rig_is_refused(tube_rig, tube_scan, fitter):
    own = fitter.pretrain().segmenter_
    fitter.set_params(rig=tube_rig.with_parts("arm and fingers"))
    with pytest.raises(InputError, match="segmenter.*another rig.*pretrain"):
        fitter.pretrain(segmenter=own)
    assert fitter.fit_scan(tube_scan.points).parts == ("arm", "fingers")  # pretrained again
    fitter.segmenter_ = own
    with pytest.raises(InputError, match="segmenter.*another rig.*pretrain"):
        fitter.fit_scan(tube_scan.points)


CHANGES = [
    {"random_state": 5},
    {"training_scans": 30},
    {"partial": True},
    {"cropped": True},
    {"training": {"noise": 0.05}},
    {"rig": lambda rig: replace(rig, poses={"bent": np.clip(np.full(rig.lower.shape, 0.3), rig.lower, rig.upper)})},
]


@pytest.mark.parametrize("changed", CHANGES, ids=lambda changed: next(iter(changed)))
@pytest.mark.parametrize("given", [False, slow(True)])
@pytest.mark.usefixtures("hurried")
def test_what_was_pretrained_with_other_parameters_is_not_used(changed, given, tube_rig, tube_scan, fitter):
    """But for a segmenter that was given, which is used as it is."""
    small = {"training_scans": 2, "training": {"n_points": 100}, "random_state": 9}
    own = lbs.LBSFitter(tube_rig, **small).pretrain().segmenter_ if given else None
    before = fitter.set_params(max_points=200).pretrain(segmenter=own)._pretrained
    assert fitter.fit_scan(tube_scan.points) is not None and fitter._pretrained is before
    fitter.set_params(**{name: value(tube_rig) if callable(value) else value for name, value in changed.items()})
    found = fit_scans(fitter, [tube_scan.points])[0].result if "random_state" in changed else fitter.fit_scan(tube_scan.points)
    assert (fitter.segmenter_ is before[0]) == given and fitter.regressor_ is not before[1]
    other = lbs.LBSFitter(**fitter.get_params()).pretrain(segmenter=own)
    assert_same(found, other.fit_scan(tube_scan.points))


@pytest.mark.parametrize("training, anew", [({}, False), ({"one_sided": True}, True), ({"floor": 0.1}, True)])
def test_where_up_is_matters_to_training_that_depends_on_it(training, anew, tube_rig):
    """To that alone: the rig's digest does not know of it."""
    made = [pretrained_from(lbs.LBSFitter(replace(tube_rig, up=up), training=training, random_state=0)) for up in ("+y", "-x")]
    assert (made[0] != made[1]) == anew


def test_what_was_pretrained_is_shared_with_a_clone_until_it_no_longer_fits(tube_rig, tube_scan, fitter, small_segmenter):
    fitter.pretrain(segmenter=small_segmenter)
    other = clone(fitter).set_params(weights="paper")
    share_pretraining(fitter, other)
    assert other.segmenter_ is small_segmenter and other._is_pretrained() and still_given(other) is small_segmenter
    assert other.fit_scan(tube_scan.points) is not None and other._pretrained is fitter._pretrained
    other.set_params(training={"n_points": 120})
    assert not other._is_pretrained() and fitter._is_pretrained()


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_learning_does_not_use_what_was_pretrained_with_other_parameters_either(tube_rig, fitter):
    small = {"training_scans": 2, "training": {"n_points": 100}, "random_state": 9}
    own = lbs.LBSFitter(tube_rig, **small).pretrain().segmenter_
    clouds = [s.points for s in lbs.synthesize(tube_rig, 3, random_state=1, n_points=300)]
    fitter.pretrain(segmenter=own).set_params(random_state=3, rounds=1).fit(clouds)
    other = lbs.LBSFitter(**fitter.get_params()).pretrain(segmenter=own).fit(clouds)
    for found, expected in zip(fitter.results_, other.results_, strict=True):
        assert_same(found, expected)


@pytest.mark.usefixtures("hurried")
def test_a_given_segmenter_comes_back_after_a_variant_without_labels(tube_rig, tube_scan, fitter):
    own = lbs.LBSFitter(tube_rig, training_scans=2, training={"n_points": 100}, random_state=9).pretrain().segmenter_
    fitter.pretrain(segmenter=own).set_params(variant="cd", random_state=2).fit_scan(tube_scan.points)
    assert fitter.segmenter_ is None
    fitter.set_params(variant="joint").fit_scan(tube_scan.points)
    assert fitter.segmenter_ is own


@pytest.mark.usefixtures("hurried")
def test_changed_parameters_are_looked_at_again(tube_rig, tube_scan, fitter):
    follow = fitter.fit_scan(tube_scan.points, labels=tube_scan.labels)
    fixed = fitter.set_params(joints="fixed").fit_scan(tube_scan.points, labels=tube_scan.labels)
    assert not np.array_equal(follow.vertices, fixed.vertices)
    other = lbs.LBSFitter(**fitter.get_params(deep=False))
    assert_same(fixed, other.fit_scan(tube_scan.points, labels=tube_scan.labels))


@pytest.mark.usefixtures("hurried")
def test_one_call_with_a_kept_segmenter(tube_rig, tube_scan, tmp_path, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_MEMORY", {})
    small = {"effort": "fast", "training_scans": 3, "training": {"n_points": 300}}
    a = lbs.fit_scan(tube_rig, tube_scan.points, **small)
    kept = sorted(p.name for p in tmp_path.iterdir())
    assert [name.partition("-")[0] for name in kept] == ["library", "segmenter"]
    assert_same(lbs.fit_scan(tube_rig, tube_scan.points, random_state=0, **small), a)
    assert_same(lbs.LBSFitter(tube_rig, random_state=0, **small).fit_scan(tube_scan.points), a)
    assert sorted(p.name for p in tmp_path.iterdir()) == kept
    lbs.fit_scan(tube_rig, tube_scan.points, labels=tube_scan.labels, random_state=1)
    assert sorted(p.name for p in tmp_path.iterdir()) == kept  # labels given: nothing to train


def test_training_scans_vary_in_scale_unless_told_otherwise(tube_rig, monkeypatch):
    seen, of_starts = [], []

    def settings_only(rig, scans, *args, **kwargs):
        seen.append(scans.settings)

    monkeypatch.setattr("lbsfit_np.learning.pretraining.train_segmenter", settings_only)
    monkeypatch.setattr(
        "lbsfit_np.learning.pretraining.build_library", lambda scans, n, **options: of_starts.append((n, scans.settings))
    )
    for training in (None, {"noise": 0.01}, {"scale": 0.2}, Synthesis(turn=1.0)):
        lbs.LBSFitter(tube_rig, training=training, random_state=0).pretrain()
    assert [s.scale for s in seen] == [0.05, 0.05, 0.2, 0.0]
    assert (seen[1].noise, seen[3].turn) == (0.01, 1.0)
    assert of_starts == [(2000, replace(s, n_points=1000)) for s in seen]  # the library's are the same, of fewer points
    assert not any(s.one_sided for s in seen)
    lbs.LBSFitter(tube_rig, partial=True, random_state=0).pretrain()
    assert seen[-1].one_sided and of_starts[-1][1].one_sided
    lbs.LBSFitter(tube_rig, partial=True, training={"one_sided": False}, random_state=0).pretrain()
    assert not seen[-1].one_sided


@pytest.mark.usefixtures("hurried")
def test_a_segmenter_that_is_given_is_kept(tube_rig, tube_fitter, tube_scan, monkeypatch):
    """Only f and the library are trained beside it, by pretrain, and by fit_scan where nothing was pretrained."""
    monkeypatch.setattr("lbsfit_np.learning.pretraining.train_segmenter", lambda *a, **k: pytest.fail("trained another"))
    parameters = {"effort": "fast", "training_scans": 20, "training": {"n_points": 200}, "max_points": 500, "random_state": 0}
    shares = []
    one = lbs.LBSFitter(tube_rig, **parameters).pretrain(segmenter=tube_fitter.segmenter_, progress=shares.append)
    assert one.segmenter_ is tube_fitter.segmenter_ and shares[-1] == 1.0
    two = lbs.LBSFitter(tube_rig, **parameters)
    two.segmenter_ = tube_fitter.segmenter_
    assert_same(two.fit_scan(tube_scan.points), one.fit_scan(tube_scan.points))
    assert two.segmenter_ is tube_fitter.segmenter_
    other = lbs.LBSFitter(tube_rig.with_parts("arm and fingers"), **parameters)
    with pytest.raises(InputError, match="segmenter.*another rig"):
        other.pretrain(segmenter=tube_fitter.segmenter_)
