"""Context: what a first labelling says about a point's surroundings and about the whole scan, for a second classifier.

Beside a point's own probabilities: their means over its nearest neighbours, near and wider; its position relative to each
part's centroid; and the parts' centroids, sizes and spreads, the same for all points of a scan. The second classifier can
so notice that two fingertips claim one finger, which no point can see by itself (auto-context).
"""

import numpy as np

__all__ = ["CONTEXT_POINTS", "NEAR", "WIDE", "context", "context_size"]

# Points of a scan that the context is taken from, always about as many, as neighbourhoods are counted in points.
CONTEXT_POINTS = 800
# Neighbours in the nearer and the wider mean.
NEAR = 8
WIDE = 30


def context_size(n_parts):
    """Number of values that :func:`context` gives a point."""
    return 11 * n_parts


def context(x, proba, around, around_proba):
    """Describe points by a first labelling.

    Parameters
    ----------
    x : (k, 3) array
        The points to describe, in half sizes of the rig.
    proba : (k, n_parts) array
        Their probabilities by the first classifier.
    around : (c, 3) array
        A sample of the scan, in the same frame.
    around_proba : (c, n_parts) array

    Returns
    -------
    (k, 11 n_parts) float32 array
    """
    from scipy.spatial import cKDTree

    k, c = len(x), len(around)
    centre = around.mean(axis=0)
    x, around = x - centre, around - centre
    mass = around_proba.sum(axis=0)
    weight = around_proba / np.maximum(mass, 1e-3)
    centroids = weight.T @ around
    spreads = np.sqrt(np.maximum(weight.T @ around**2 - centroids**2, 0.0)).sum(axis=1)
    nearest = cKDTree(around).query(x, k=min(WIDE, c))[1].reshape(k, min(WIDE, c))
    near = around_proba[nearest[:, :NEAR]].mean(axis=1)
    wide = around_proba[nearest].mean(axis=1)
    relative = (x[:, None, :] - centroids).reshape(k, centroids.size)
    whole = np.concatenate([centroids.ravel(), mass / c, spreads])
    return np.hstack([proba, near, wide, relative, np.broadcast_to(whole, (k, len(whole)))]).astype(np.float32)
