"""Step 1 of Algorithm 1, before any scan is seen: s, and f with the library of starts, trained on synthetic scans of a rig."""

from dataclasses import replace

from ..segmentation.cache import cached
from ..segmentation.descriptors import Descriptor
from ..segmentation.segmenter import Segmenter, train_segmenter
from ..segmentation.stage import Training
from ..starts.library import PoseLibrary, build_library
from ..synthesis import StartScans, TrainingScans

__all__ = ["LIBRARY_TIME", "pretrain_library", "pretrain_segmenter"]

# Share of the time of pretraining that the library takes, for the progress bar.
LIBRARY_TIME = 0.1

# Enough for a look.
_LIBRARY_POINTS = 1000


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
    rig, seed = rig.welded, random_state

    def train():
        scans = TrainingScans(rig, synthesis, seed)
        return train_segmenter(rig, scans, n_scans, random_state=seed, n_jobs=n_jobs, progress=progress)

    key = rig.digest, synthesis, n_scans, Descriptor(), Training(), int(seed)
    return cached("segmenter", key, train, Segmenter.load) if cache else train()


def pretrain_library(rig, synthesis, n_scans, *, random_state, jobs, cache, progress):
    """The library of starts with f: half as many scans, of fewer points, and half of them in natural poses where there are any.

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
    synthesis, n = replace(synthesis, n_points=_LIBRARY_POINTS), max(1, n_scans // 2)

    def train():
        return build_library(StartScans(rig, synthesis, seed), n, random_state=seed, jobs=jobs, progress=progress)

    poses = [(name, rig.poses[name].tolist()) for name in sorted(rig.poses)]  # the digest knows nothing of them
    key = rig.digest, poses, synthesis, n, int(seed)
    return cached("library", key, train, PoseLibrary.load) if cache else train()
