"""Step 1 of Algorithm 1, before any scan is seen: s, and f with the library of starts, trained on synthetic scans of a rig."""

import warnings
from dataclasses import replace

from ..bundled import bundled_files
from ..errors import FileError
from ..segmentation.cache import cached, shipped_name
from ..segmentation.descriptors import Descriptor
from ..segmentation.segmenter import Segmenter, jobs_of, train_segmenter
from ..segmentation.stage import Training
from ..starts.library import PoseLibrary, build_library
from .training import StartScans, TrainingScans

__all__ = [
    "is_stale",
    "pretrain_library",
    "pretrain_segmenter",
    "pretrained",
    "pretrained_from",
    "share_pretraining",
    "shipped_name_of",
    "shipped_path",
    "still_given",
]

# Share of the time of pretraining that the library takes, for the progress bar.
_LIBRARY_TIME = 0.1

# Enough for a look.
_LIBRARY_POINTS = 1000
# Views of one side that end somewhere look more different, by where the camera is and where they end, than poses do.
_VIEWS = 4


def pretrained(rig, synthesis, n_scans, *, segmenter, labels, random_state, n_jobs, cache, progress):
    """The segmenter s, and f with the library of starts.

    s is not trained where one is given or comes with the package.

    Parameters
    ----------
    rig, synthesis, n_scans, random_state, n_jobs, cache, progress
        As in :func:`pretrain_segmenter`.
    segmenter : Segmenter or None
        The one that is given.
    labels : bool
        Whether there is to be an s at all.

    Returns
    -------
    segmenter : Segmenter or None
    library : PoseLibrary
    """
    made_of, options = (rig, synthesis, n_scans), {"random_state": random_state, "cache": cache}
    if labels and segmenter is None:
        segmenter = _shipped_segmenter(*made_of, random_state=random_state)
    train = labels and segmenter is None
    share = _LIBRARY_TIME * _views(synthesis) if train else 1.0
    library = pretrain_library(*made_of, jobs=jobs_of(n_jobs, None), progress=lambda p: progress(share * p), **options)
    if train:
        options |= {"n_jobs": n_jobs, "progress": lambda p: progress(share + (1 - share) * p)}
        segmenter = pretrain_segmenter(*made_of, **options)
    return segmenter if labels else None, library


def pretrain_segmenter(rig, synthesis, n_scans, *, random_state, n_jobs, cache, progress):
    """The segmenter s of a rig.

    Parameters
    ----------
    rig : Rig
    synthesis : Synthesis
        How scans are made.
    n_scans : int
    random_state : int
    n_jobs : int or None
    cache : bool
        Whether to look in, and add to, the cache of what was trained.
    progress : callable
        Called with the share done, in [0, 1].

    Returns
    -------
    Segmenter
    """
    rig, seed, n_scans = rig.welded, random_state, int(n_scans)

    def train():
        scans = TrainingScans(rig, synthesis, seed)
        return train_segmenter(rig, scans, n_scans, random_state=seed, n_jobs=n_jobs, progress=progress)

    return cached("segmenter", _segmenter_key(rig, synthesis, n_scans, seed), train, Segmenter.load) if cache else train()


def _shipped_segmenter(rig, synthesis, n_scans, *, random_state):
    """What :func:`pretrain_segmenter` would train, where that comes with the package; else None."""
    path = shipped_path(rig, synthesis, n_scans, random_state=random_state)
    try:
        return None if path is None else Segmenter.load(path)
    except FileError as error:
        warnings.warn(f"{path}: {error.got}; install the package again. Until then a segmenter is trained.", stacklevel=4)
        return None


def shipped_path(rig, synthesis, n_scans, *, random_state):
    """The file of what :func:`pretrain_segmenter` would train, where that comes with the package; else None."""
    return bundled_files("trained/*.npz").get(shipped_name_of(rig, synthesis, n_scans, random_state=random_state))


def shipped_name_of(rig, synthesis, n_scans, *, random_state):
    """As a segmenter's file in rigs/trained/ is called, without its ending; ``python -m rigs.train`` writes these files."""
    return shipped_name("segmenter", _segmenter_key(rig.welded, synthesis, int(n_scans), random_state))


def _segmenter_key(rig, synthesis, n_scans, seed):
    return rig.digest, synthesis, n_scans, Descriptor(), Training(), int(seed), *_seen_from(rig, synthesis)


def pretrain_library(rig, synthesis, n_scans, *, random_state, jobs, cache, progress):
    """The library of starts with f: scans of fewer points, half of them in natural poses where there are any.

    There are half as many as for s, or of views of one side that are cropped twice as many.

    Parameters
    ----------
    rig, synthesis, random_state, cache, progress
        As in :func:`pretrain_segmenter`.
    n_scans : int
        Those of the segmenter.
    jobs : int

    Returns
    -------
    PoseLibrary
    """
    rig, seed = rig.welded, random_state
    synthesis, n = replace(synthesis, n_points=_LIBRARY_POINTS), max(1, int(n_scans) // 2) * _views(synthesis)

    def train():
        return build_library(StartScans(rig, synthesis, seed), n, random_state=seed, jobs=jobs, progress=progress)

    key = rig.digest, rig.poses_digest, synthesis, n, int(seed), *_seen_from(rig, synthesis)
    return cached("library", key, train, PoseLibrary.load) if cache else train()


def _views(synthesis):
    """How many times as many scans the library has as for scans that show all, or one side of all, or all of a part."""
    return _VIEWS if synthesis.one_sided and synthesis.cropped else 1


def pretrained_from(fitter):
    """What pretraining goes by, of a fitter as it now is; seeds that no run has again say nothing."""
    rig, seed = fitter.rig, fitter.random_state if fitter._repeatable() else None
    synthesis = fitter._synthesis()
    return rig.digest, rig.poses_digest, synthesis, fitter.training_scans, seed, *_seen_from(rig, synthesis)


def _seen_from(rig, synthesis):
    """The up axis where training scans depend on it, which the rig's digest does not know."""
    return (rig.up or "+y",) if synthesis.one_sided or synthesis.floor else ()


def share_pretraining(fitter, other):
    """Give another fitter what one was pretrained to, as if that had been pretrained itself.

    Parameters
    ----------
    fitter : LBSFitter
        Pretrained.
    other : LBSFitter
        Of the same rig, training and seed, such as a clone with another variant or other weights.
    """
    other.segmenter_, other.regressor_ = other._pretrained = fitter._pretrained
    other._pretrained_of, other._given = fitter._pretrained_of, fitter._given


def is_stale(fitter):
    """Whether a fitter was pretrained with other parameters, or another rig, than it now has."""
    of = getattr(fitter, "_pretrained_of", None)
    return of is not None and of != pretrained_from(fitter)


def still_given(fitter):
    """The segmenter that a fitter's pretraining was given, where it is of the rig as it now is; else None."""
    given = getattr(fitter, "_given", None)
    return given if given is not None and given.rig_digest == fitter.rig.welded.digest else None
