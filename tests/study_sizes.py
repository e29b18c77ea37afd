"""Sizes of the study that are done in seconds."""

from dataclasses import replace

from learning_runs import learning_is_hurried

from lbsfit_np.bench.study.data import SCAN, SIZES, Size

TINY = Size(4, 3, 2, 1, 6, 50, 2, 1)
_FEW = Size(train=3, test=3, train_subjects=2, test_subjects=2, pairs=4, training_scans=60, rounds=1, seeds=1)


def small_is_few_and_fast(patch):
    """Have the size "small" be few small scans, fitted in a hurry."""
    patch.setitem(SIZES, "small", _FEW)
    patch.setattr("lbsfit_np.bench.study.data.SCAN", replace(SCAN, n_points=200))
    learning_is_hurried(patch, "balanced", turns=0)
