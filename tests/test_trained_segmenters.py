"""The segmenters that come with the bundled rigs: there is one for each default, it is used, and it knows the rig."""

import numpy as np
import pytest
from rebuilt_rigs import rig_module

import lbsfit_np as lbs
from lbsfit_np.bundled import bundled_files
from lbsfit_np.cli import fit
from lbsfit_np.learning import pretraining
from lbsfit_np.learning.training import TrainingScans
from lbsfit_np.rig.card import Card

train = rig_module("train")
ASKED_FOR = train.asked_for()
WHO = [f"{rig.name}, {'one side' if synthesis.one_sided else 'whole'}" for rig, synthesis, _ in ASKED_FOR.values()]


@pytest.fixture
def nothing_is_trained(empty_cache, monkeypatch):
    """Training is recorded; no library is made."""
    told = []
    monkeypatch.setattr(pretraining, "train_segmenter", lambda *given, **options: told.append(given))
    monkeypatch.setattr(pretraining, "cached", lambda kind, key, train, load: train())
    monkeypatch.setattr(pretraining, "build_library", lambda *given, **options: None)
    return told


def test_those_that_are_there_are_those_that_are_asked_for():
    """Where this fails: python -m rigs.train, and commit what it writes."""
    assert sorted(bundled_files("trained/*.npz")) == sorted(ASKED_FOR)


def test_the_help_names_their_rigs():
    *others, last = train.RIGS
    assert f"{', '.join(others)} and {last} bring a segmenter" in " ".join(fit._EPILOG.split())


@pytest.mark.parametrize("cache", [False, True])
@pytest.mark.parametrize("partial", [False, True])
@pytest.mark.parametrize("name", train.RIGS)
def test_defaults_train_no_segmenter(name, partial, cache, nothing_is_trained, empty_cache):
    told = []
    fitter = lbs.LBSFitter(lbs.load_rig(name), partial=partial, random_state=0, effort="fast", orientation="any")
    fitter.pretrain(cache=cache, progress=told.append)
    fitter.segmenter_.check_rig(fitter.rig)
    assert nothing_is_trained == [] and not empty_cache.exists()


@pytest.mark.parametrize(
    "other", [{"random_state": 1}, {"random_state": None}, {"training_scans": 3999}, {"training": {"noise": 0.01}}]
)
def test_other_settings_train_one(other, nothing_is_trained):
    lbs.LBSFitter(lbs.load_rig("hand"), **{"random_state": 0} | other).pretrain()
    assert len(nothing_is_trained) == 1


@pytest.mark.parametrize("name, card", [("hand-coarse", None), ("hand", Card(limits=(("wrist", (-0.1,) * 3, (0.1,) * 3),)))])
def test_other_rigs_train_one(name, card, nothing_is_trained):
    lbs.LBSFitter(lbs.load_rig(name, card=card), random_state=0).pretrain()
    assert len(nothing_is_trained) == 1


@pytest.mark.parametrize("variant", ["cd", "free-form"])
def test_variants_without_labels_have_none(variant, nothing_is_trained):
    fitter = lbs.LBSFitter(lbs.load_rig("hand"), variant=variant, random_state=0).pretrain()
    assert fitter.segmenter_ is None and nothing_is_trained == []


def test_one_that_is_given_comes_first(nothing_is_trained):
    hand = lbs.load_rig("hand")
    own = lbs.LBSFitter(hand, partial=True, random_state=0).pretrain().segmenter_
    assert lbs.LBSFitter(hand, random_state=0).pretrain(segmenter=own).segmenter_ is own


@pytest.mark.parametrize("broken", [b"", b"version https://git-lfs.github.com/spec/v1\n"])
def test_one_that_is_broken_is_trained_again_with_a_warning(broken, nothing_is_trained, tmp_path, monkeypatch):
    def broken_files(pattern):
        paths = {stem: tmp_path / path.name for stem, path in bundled_files(pattern).items()}
        for path in paths.values():
            path.write_bytes(broken)
        return paths

    fitter = lbs.LBSFitter(lbs.load_rig("hand"), random_state=0)
    monkeypatch.setattr(pretraining, "bundled_files", broken_files)
    with pytest.warns(UserWarning, match="segmenter-.*npz: .*; install the package again"):
        fitter.pretrain()
    assert len(nothing_is_trained) == 1


@pytest.mark.parametrize("training", [{"turn": 0}, {"noise": np.float64(0.004)}, {"holes": np.int64(2)}, {"one_sided": 0}])
def test_equal_settings_are_the_default_ones(training, nothing_is_trained):
    lbs.LBSFitter(lbs.load_rig("hand"), training=training, random_state=np.int64(0)).pretrain()
    assert nothing_is_trained == []


@pytest.mark.parametrize("made_of", ASKED_FOR.values(), ids=WHO)
def test_it_knows_the_rig(made_of, nothing_is_trained):
    rig, synthesis, _ = made_of
    s = lbs.LBSFitter(rig, partial=synthesis.one_sided, random_state=0).pretrain().segmenter_
    scans, right = TrainingScans(rig.welded, synthesis, 12345), []  # of another seed than it was trained on
    for points, labels, scale in map(scans, range(8)):
        right.append((s.predict(points, scale=scale, views=1) == labels)[labels >= 0].mean())
    assert np.mean(right) > 0.7  # 0.77 to 0.90 in uniform poses; there are 16 and 24 parts
