"""Sizes of the study that are done in seconds."""

from dataclasses import replace

from lbsfit_np.bench.study.data import SCAN, SIZES, Size
from lbsfit_np.fitting.effort import EFFORTS
from lbsfit_np.learning.loop import LoopSettings

TINY = Size(4, 3, 2, 1, 6, 50, 2, 1)
_FEW = Size(train=4, test=3, train_subjects=2, test_subjects=2, pairs=4, training_scans=60, rounds=1, seeds=1)


def small_is_few_and_fast(patch):
    """Have the size "small" be few small scans, fitted fast."""
    patch.setitem(SIZES, "small", _FEW)
    patch.setattr("lbsfit_np.bench.study.data.SCAN", replace(SCAN, n_points=300))
    patch.setitem(EFFORTS, "balanced", EFFORTS["fast"])
    patch.setattr(LoopSettings, "for_training", lambda n, **others: LoopSettings(round_scans=25, library_scans=100, **others))
