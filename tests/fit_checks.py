"""How far a fit is from the truth, and whether two results are the same."""

from dataclasses import fields

import numpy as np

from lbsfit_np.fitting.result import FitResult


def mean_error(rig, found, true):
    """Mean distance in half sizes of the rig."""
    return np.linalg.norm(found - true, axis=1).mean() / (rig.size / 2)


def assert_same(a, b, leave_out=("seconds",)):
    """Two results, equal to the last bit."""
    for f in fields(FitResult):
        if f.name not in leave_out:
            x, y = getattr(a, f.name), getattr(b, f.name)
            assert np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y, f.name
