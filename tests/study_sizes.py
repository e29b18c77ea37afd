"""Sizes of the study that are done in seconds."""

from dataclasses import replace

from lbsfit_np.bench.study.data import SCAN, SIZES, Size
from lbsfit_np.fitting.effort import EFFORTS, Effort
from lbsfit_np.learning.loop import LoopSettings

_HURRIED = Effort(2, 1, 1, 1, generations=0, parents=1, proposals=1, closer=False, bends=False)  # fits need not be right
TINY = Size(4, 3, 2, 1, 6, 50, 2, 1)
_FEW = Size(train=4, test=3, train_subjects=2, test_subjects=2, pairs=4, training_scans=60, rounds=1, seeds=1)


def small_is_few_and_fast(patch):
    """Have the size "small" be few small scans, fitted in a hurry."""
    patch.setitem(SIZES, "small", _FEW)
    patch.setattr("lbsfit_np.bench.study.data.SCAN", replace(SCAN, n_points=300))
    patch.setitem(EFFORTS, "balanced", _HURRIED)
    quick = {"round_scans": 25, "library_scans": 100, "turns": 0}
    patch.setattr(LoopSettings, "for_training", lambda n, **others: LoopSettings(**quick, **others))
