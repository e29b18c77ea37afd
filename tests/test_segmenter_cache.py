"""The cache of what was trained: once a recipe, and never in the way."""

import importlib.metadata
import os
from pathlib import Path

import numpy as np
import pytest
from segmenter_training import cached

import lbsfit_np as lbs
from lbsfit_np.segmentation import cache
from lbsfit_np.segmentation import context as context_module
from lbsfit_np.segmentation.segmenter import Segmenter


class Trainer:
    """Trains nothing, and counts how often it was asked to."""

    def __init__(self, segmenter):
        self.segmenter, self.calls = segmenter, 0

    def __call__(self):
        self.calls += 1
        return self.segmenter


def test_the_cache_trains_once(empty_cache, small_segmenter, tube_scan):
    train = Trainer(small_segmenter)
    first = cached(("a", 1), train)
    assert cached(("a", 1), train) is first and train.calls == 1
    assert len(list(empty_cache.iterdir())) == 1
    cache._MEMORY.clear()  # another process
    again = cached(("a", 1), train)
    assert train.calls == 1
    np.testing.assert_array_equal(again.predict_proba(tube_scan.points), small_segmenter.predict_proba(tube_scan.points))
    cached(("a", 2), train)
    assert train.calls == 2
    assert len(list(empty_cache.iterdir())) == 2


def test_kinds_are_kept_apart(empty_cache, small_segmenter):
    train = Trainer(small_segmenter)
    cached("key", train)
    assert cache.cached("library", "key", train, Segmenter.load) is small_segmenter and train.calls == 2
    assert sorted(p.name.partition("-")[0] for p in empty_cache.iterdir()) == ["library", "segmenter"]


@pytest.mark.parametrize(
    "place, name, value",
    [
        (cache, "RECIPES", {"segmenter": cache.RECIPES["segmenter"] + 1}),
        (cache, "__version__", "another"),
        (importlib.metadata, "version", lambda name: f"another {name}"),
        (context_module, "CONTEXT_POINTS", 700),
        (context_module, "NEAR", 7),
        (context_module, "WIDE", 31),
    ],
)
def test_another_recipe_is_another_segmenter(empty_cache, small_segmenter, monkeypatch, place, name, value):
    train = Trainer(small_segmenter)
    cached("key", train)
    monkeypatch.setattr(place, name, value)
    cached("key", train)
    assert train.calls == 2 and len(list(empty_cache.iterdir())) == 2


def test_the_folder_is_the_users_to_choose(monkeypatch, tmp_path):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "mine"))
    assert cache.cache_folder() == tmp_path / "mine"
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    for given, folder in (("~/mine", tmp_path / "home" / "mine"), ("~", tmp_path / "home"), ("a/~", Path("a/~"))):
        monkeypatch.setenv("LBSFIT_CACHE", given)  # as a file of settings has it, which no shell reads
        assert cache.cache_folder() == folder
    monkeypatch.setenv("LBSFIT_CACHE", "~nobody-of-this-name/mine")
    assert cache.cache_folder() == Path("~nobody-of-this-name/mine")
    monkeypatch.delenv("LBSFIT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_folder() == tmp_path / "xdg" / "lbsfit_np"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / ".cache" / "lbsfit_np"


@pytest.mark.parametrize("broken", [b"", b"not a zip"])
def test_a_broken_file_in_the_cache_is_trained_again(empty_cache, small_segmenter, broken):
    train = Trainer(small_segmenter)
    cached("key", train)
    (file,) = empty_cache.iterdir()
    whole = file.read_bytes()
    file.write_bytes(broken)
    cache._MEMORY.clear()
    cached("key", train)
    assert train.calls == 2
    assert file.read_bytes() == whole


def test_a_cache_that_cannot_be_made_is_no_error(empty_cache, small_segmenter):
    empty_cache.write_text("a file where the folder should be")
    train = Trainer(small_segmenter)
    words = "training results cannot be kept in .* .File exists.*set LBSFIT_CACHE to another folder"
    with pytest.warns(UserWarning, match=words):
        assert cached("key", train) is small_segmenter
    assert cached("key", train) is small_segmenter and train.calls == 1


def test_a_cache_that_cannot_be_made_is_warned_of_once(empty_cache, small_segmenter, monkeypatch, tmp_path):
    empty_cache.write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match="cannot be kept") as told:
        for key in "ab":
            cached(key, Trainer(small_segmenter))
    assert len(told) == 1 and cache.could_not_keep()
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "another"))
    cached("c", Trainer(small_segmenter))
    assert not cache.could_not_keep()


def test_a_cache_that_cannot_be_written_to_is_no_error(empty_cache, small_segmenter, monkeypatch):

    empty_cache.mkdir()

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)
    with pytest.warns(UserWarning, match="cannot be kept in .* .Permission denied"):
        assert cached("key", Trainer(small_segmenter)) is small_segmenter


def test_a_folder_that_cannot_be_is_told_before_the_training(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(cache, "_WARNED_OF", set())
    with pytest.warns(UserWarning, match="cannot be kept in .*file"), pytest.raises(KeyboardInterrupt):
        cache.cached("segmenter", "of no use", _stopped, Segmenter.load)


def _stopped():
    """A training that one stops, who has been told by now."""
    assert cache.could_not_keep()
    raise KeyboardInterrupt


def test_pretraining_uses_the_cache_when_asked(empty_cache, tube_rig, tube_scan):
    def fitter(**changes):
        return lbs.LBSFitter(tube_rig, **{"training_scans": 2, "training": {"n_points": 200}, "random_state": 0, **changes})

    a = fitter().pretrain(cache=True)
    assert len(list(empty_cache.glob("segmenter-*.npz"))) == len(list(empty_cache.glob("library-*.npz"))) == 1
    cache._MEMORY.clear()

    def no_progress(share):
        raise AssertionError("trained again")

    b = fitter().pretrain(cache=True, progress=no_progress)
    np.testing.assert_array_equal(a.segmenter_.predict_proba(tube_scan.points), b.segmenter_.predict_proba(tube_scan.points))
    for changes in ({"random_state": 1}, {"training_scans": 3}, {"training": {"n_points": 300}}):
        with pytest.raises(AssertionError, match="trained again"):
            fitter(**changes).pretrain(cache=True, progress=no_progress)
    with pytest.raises(AssertionError, match="trained again"):
        lbs.LBSFitter(
            tube_rig.with_parts("arm and fingers"), training_scans=2, training={"n_points": 200}, random_state=0
        ).pretrain(cache=True, progress=no_progress)
    with pytest.raises(AssertionError, match="trained again"):
        fitter().pretrain(progress=no_progress)
