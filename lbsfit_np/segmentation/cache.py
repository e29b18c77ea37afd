"""What is trained for a rig, kept between runs: in memory and in the user's cache folder, under a key of all it depends on."""

import errno
import hashlib
import os
import tempfile
import warnings
from contextlib import contextmanager, suppress
from pathlib import Path

from .. import __version__
from ..errors import FileError, in_words
from . import context

__all__ = ["RECIPES", "cache_folder", "cached", "could_not_keep", "shipped_name"]

# To be raised by one, of a kind, with every change of the code after which the same settings and seed train another segmenter or
# another library: what an earlier state of the code has cached, or what comes with the package, is then never taken for this
# one's. That is code of segmentation/, starts/, synthesis.py, sensor.py, learning/training.py, rig/proportions.py, rig/chains.py,
# Rig.size, and skinning.py, raster.py and triangles.py below them; tests/test_recipes.py has numbers that tell.
RECIPES = {"segmenter": 4, "library": 4}

_MEMORY, _WARNED_OF = {}, set()


def cache_folder():
    """The folder of the cache: $LBSFIT_CACHE, else lbsfit_np in the user's cache folder, or where there is none in that for
    temporary files.
    """
    if os.environ.get("LBSFIT_CACHE"):
        return _expanded(os.environ["LBSFIT_CACHE"])
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lbsfit_np"
    except RuntimeError:  # a user without a home folder
        return Path(tempfile.gettempdir()) / "lbsfit_np"


def _expanded(folder):
    """The path, ~ at its start being the user's folder: a shell replaces it, files of settings and services do not."""
    try:
        return Path(folder).expanduser()
    except RuntimeError:  # a user that there is not, or no such folder
        return Path(folder)


def could_not_keep():
    """Whether something that this process has trained could not be written to the folder, which was warned of."""
    return cache_folder() in _WARNED_OF


def shipped_name(kind, key):
    """As the file is called, without its ending, that holds what ``key`` stands for, where that comes with the package.

    Versions are no part of it: it has been trained with those of the day, and is the same for everybody.
    """
    return _name(kind, key, *_recipe(kind))


def cached(kind, key, train, load):
    """What ``key`` stands for, trained by ``train()`` when neither memory nor the folder has it.

    Parameters
    ----------
    kind : {"segmenter", "library"}
        Names the files.
    key : object
        Its ``repr`` stands for rig, settings and seed. Versions, :data:`RECIPES` and the constants of the context are added here.
    train : callable
        () → something with ``save(path)``. What it raises passes on, and nothing is kept.
    load : callable
        path → what was saved there; FileError where that cannot be.

    Notes
    -----
    A folder that cannot be written to is no error, but warned of: what was trained then lasts as long as the process.
    """
    name = _name(kind, key, *_versions(), *_recipe(kind))
    if name in _MEMORY:
        return _MEMORY[name]
    path = cache_folder() / f"{name}.npz"
    with suppress(FileError):  # none, or a broken one
        trained = _MEMORY[name] = load(path)
        return trained
    with _warning_of(path.parent):  # before the training, as far as it can be known: who is told can stop it
        there = next((folder for folder in (path.parent, *path.parent.parents) if os.path.lexists(folder)), Path())
        why = None if os.access(there, os.W_OK) else errno.EACCES
        if why := why if os.path.isdir(there) else errno.EEXIST:
            raise OSError(why, os.strerror(why)) from None
    trained = train()
    with _warning_of(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        trained.save(path)
    _MEMORY[name] = trained
    return trained


@contextmanager
def _warning_of(folder):
    """Warn, once, that nothing can be kept in a folder, where what is done in here says so."""
    try:
        yield
    except (OSError, FileError) as error:
        why = error.got if isinstance(error, FileError) else error.strerror or in_words(error)
        if folder not in _WARNED_OF:
            words = f"training results cannot be kept in {folder} ({why}), so the next run trains again"
            warnings.warn(f"{words}; set LBSFIT_CACHE to another folder", stacklevel=4)
        _WARNED_OF.add(folder)


def _name(kind, *of):
    return f"{kind}-{hashlib.sha256(repr(of).encode()).hexdigest()[:32]}"


def _versions():
    from importlib.metadata import version

    return __version__, version("scikit-learn")  # which is imported where something is trained alone


def _recipe(kind):
    """What it depends on besides the key and the versions."""
    return RECIPES[kind], context.CONTEXT_POINTS, context.NEAR, context.WIDE
