"""Labels of scan points: the segmenter's probabilities, refined by the distance to the parts of a fitted mesh."""

import numpy as np

from ..optimize.frame import root_turn
from ..rotations import angle_between

__all__ = ["DOUBT", "LEANS", "labels_from_mesh", "one_hot", "parts_of", "refined_labels", "said_of"]

# A root that a pose turns further than this leans as hardly any training scan does, radians.
LEANS = 0.8

# While labels are refined, points whose label is less probable than this take no part in the structured term.
DOUBT = 0.8

# A part that the segmenter excludes is not quite impossible: the fitted mesh may know better.
_FLOOR = 1e-3
# τ: the classifier is surer than it is right, so its word counts half.
_TEMPER = 0.5
# Points are taken to be no farther from a mesh than so many times its size: squares of more leave double precision.
_FARTHEST = 1e6
# Points further from all vertices than so many σ, and so many times the vertices' own distance from each other, are of no part.
_OFF, _SPACINGS = 4.0, 3.0


def one_hot(labels, n_parts):
    """(n, n_parts) probabilities of known labels, zeros and ones; all 0 where the label is −1, not known."""
    return np.vstack([np.eye(n_parts), np.zeros(n_parts)])[labels]


def parts_of(proba):
    """(n,) int: the most probable part of each point; n_parts, which no vertex has, where all are 0."""
    return np.where(proba.any(axis=1), proba.argmax(axis=1), proba.shape[1])


def said_of(segmenter, rig, X, theta, size=1.0):
    """What the segmenter says of a scan whose pose is about known: one that leans far is turned back, as training hardly leans.

    Parameters
    ----------
    segmenter : Segmenter
    rig : Rig
    X : (n, 3) array
        In half sizes.
    theta : (J, 3) array
        Θ, radians.
    size : float, default 1
        Of the scan's template, in sizes of those that the segmenter has learned from.

    Returns
    -------
    (n, n_parts) array
    """
    turn = root_turn(rig, theta)
    upright = X if angle_between(turn, np.eye(3)) <= LEANS else X @ turn
    return segmenter.predict_proba(upright * segmenter.half, scale=size, views=1)


def refined_labels(X, proba, V, v_labels, sigma, *, doubt=0.0):
    """argmax_p of q_p ∝ (p_seg(p | x) + floor)^τ · exp(−d_p(x)² / 2σ²), d_p the distance from x to the nearest vertex of part p.

    Parameters
    ----------
    X : (n, 3) array
    proba : (n, n_parts) array
    V : (m, 3) array
        Fitted vertices.
    v_labels : (m,) int array
    sigma : float
        In units of X.
    doubt : float, default 0
        Points whose largest q is smaller get the label n_parts, which no vertex has: they take no part in L_s.

    Returns
    -------
    (n,) int array
    """
    from scipy.spatial import cKDTree

    score = np.full(proba.shape, -np.inf)
    for p in range(proba.shape[1]):
        part = V[v_labels == p]
        if len(part):
            d = cKDTree(part).query(X)[0]
            score[:, p] = _TEMPER * np.log(proba[:, p] + _FLOOR) - d**2 / (2 * sigma**2)
    labels = score.argmax(axis=1)
    if doubt:
        best = score[np.arange(len(X)), labels]
        labels[1.0 / np.exp(score - best[:, None]).sum(axis=1) < doubt] = proba.shape[1]
    return labels


def labels_from_mesh(points, V, v_labels, n_parts, sigma, *, proba=None, proba_points=None, chunk=200_000):
    """Labels with confidence for any number of points, from a fitted mesh and, where there are any, probabilities.

    The eight nearest vertices vote with exp(−d² / 2σ²); the segmenter's probabilities at the nearest point that has
    some multiply the votes.

    Parameters
    ----------
    points : (n, 3) array
    V : (m, 3) array
    v_labels : (m,) int array
    n_parts : int
    sigma : float
        In units of ``points``.
    proba : (k, n_parts) array, optional
    proba_points : (k, 3) array, optional
    chunk : int
        Points at a time, to bound memory.

    Returns
    -------
    labels : (n,) int array
    confidence : (n,) array
        Share of the votes that the label has, in [0, 1]. Where the nearest vertex is further away than 4σ (and than three
        times the distance that vertices have from each other), most votes are for no part at all: clutter, a floor.
    """
    from scipy.spatial import cKDTree

    low, high = V.min(axis=0), V.max(axis=0)
    far = _FARTHEST * (high - low).max()
    tree = cKDTree(V)
    known = None if proba is None else cKDTree(proba_points)
    k = min(8, len(V))
    off_from = max(_OFF * sigma, _SPACINGS * float(np.median(tree.query(V, k=min(2, len(V)))[0][..., -1])))
    labels, confidence = np.empty(len(points), dtype=int), np.empty(len(points))
    for start in range(0, len(points), chunk):
        x = np.clip(points[start : start + chunk], low - far, high + far)
        d, near = tree.query(x, k=k)
        d, near = d.reshape(len(x), k), near.reshape(len(x), k)
        vote = np.exp(-(d**2 - d[:, :1] ** 2) / (2 * sigma**2))
        score = np.zeros((len(x), n_parts))
        np.add.at(score, (np.arange(len(x))[:, None], v_labels[near]), vote)
        if known is not None:
            score *= (proba[known.query(x)[1]] + _FLOOR) ** _TEMPER
        best = score.argmax(axis=1)
        labels[start : start + len(x)] = best
        off = np.exp(np.minimum((d[:, 0] ** 2 - off_from**2) / sigma**2, 1000.0) / 2)  # votes for none
        confidence[start : start + len(x)] = score[np.arange(len(x)), best] / score.sum(axis=1) / (1.0 + off)
    return labels, confidence
