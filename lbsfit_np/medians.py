"""The median of values that count differently."""

import numpy as np

__all__ = ["weighted_median"]


def weighted_median(values, weights):
    """The least value up to which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    up_to = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(up_to, 0.5 * up_to[-1])]])
