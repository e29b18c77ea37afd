"""Sizes of the study that are done in seconds."""

from copy import deepcopy
from dataclasses import replace
from functools import cache
from zlib import crc32

import numpy as np
from learning_runs import learning_is_hurried
from registered_sets import result_of

from lbsfit_np.bench.study import oracle
from lbsfit_np.bench.study.data import SCAN, SIZES, Size
from lbsfit_np.bench.study.local_optimum import along_path
from lbsfit_np.learning import free_form
from lbsfit_np.learning.archive import model_digest
from lbsfit_np.learning.fitter import LBSFitter
from lbsfit_np.optimize.lbfgs import minimise

TINY = Size(4, 3, 2, 1, 6, 50, 2, 1)
_FEW = Size(train=3, test=3, train_subjects=2, test_subjects=2, pairs=4, training_scans=60, rounds=1, seeds=1)

_along_path = cache(along_path)  # of rigs that are the same object


def few_steps_along_path(rig):
    """The way out of a rig's local optimum, found once."""
    return deepcopy(_along_path(rig, steps=5))


def small_is_few_and_fast(patch):
    """Have the size "small" be few small scans, fitted in a hurry."""
    patch.setitem(SIZES, "small", _FEW)
    patch.setattr("lbsfit_np.bench.study.data.SCAN", replace(SCAN, n_points=200))
    learning_is_hurried(patch, "balanced", turns=0)


def rows_are_hurried(patch):
    """Have rows of that size take little, for tests that ask what becomes of figures, good or not.

    Baselines and oracles end early. Of a scan without labels the fit after learning is made up, another one with each model.
    """
    small_is_few_and_fast(patch)
    for module in (oracle, free_form):
        patch.setattr(module, "minimise", lambda *given, **more: minimise(*given, **more | {"max_iterations": 5}))
    fit_scan = LBSFitter.fit_scan

    def made_up(self, points, **options):
        if options:
            return fit_scan(self, points, **options)
        rng = np.random.default_rng(crc32(model_digest(self).encode() + points.tobytes()))
        return result_of(self.rig, self.rig.vertices + 0.1 * rng.standard_normal(3), len(points))

    patch.setattr(LBSFitter, "fit_scan", made_up)
    patch.setitem(LBSFitter.__init__.__kwdefaults__, "training", {"n_points": 200})
