"""Segmenters kept between runs: in memory and in the user's cache folder, under a key of all that they depend on."""

import hashlib
import os
from pathlib import Path

from .. import __version__
from ..errors import FileError
from . import context
from .segmenter import Segmenter

__all__ = ["RECIPE", "cache_folder", "cached_segmenter"]

# To be raised by one with every change of segmentation/, synthesis.py or rig/proportions.py after which the same settings and
# seed train another segmenter: what an earlier state of the code has cached is then never taken for this one's.
RECIPE = 1

_MEMORY = {}


def cache_folder():
    """The folder of cached segmenters: $LBSFIT_CACHE, else lbsfit_np in the user's cache folder."""
    if os.environ.get("LBSFIT_CACHE"):
        return Path(os.environ["LBSFIT_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lbsfit_np"


def cached_segmenter(key, train):
    """The segmenter of ``key``, trained by ``train()`` when neither memory nor the folder has it.

    Parameters
    ----------
    key : object
        Its ``repr`` stands for rig, settings and seed. Versions, :data:`RECIPE` and the constants of the context are added here.
    train : callable
        () → Segmenter. What it raises passes on, and nothing is kept.

    Notes
    -----
    A folder that cannot be written to is no error: the segmenter then lasts as long as the process.
    """
    name = hashlib.sha256(repr((key, *_recipe())).encode()).hexdigest()[:32]
    if name in _MEMORY:
        return _MEMORY[name]
    path = cache_folder() / f"segmenter-{name}.npz"
    try:
        segmenter = Segmenter.load(path)
    except FileError:
        segmenter = train()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            segmenter.save(path)
        except (OSError, FileError):
            pass
    _MEMORY[name] = segmenter
    return segmenter


def _recipe():
    """What a segmenter depends on besides the key."""
    import sklearn

    return RECIPE, __version__, sklearn.__version__, context.CONTEXT_POINTS, context.NEAR, context.WIDE
