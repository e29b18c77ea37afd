"""Scans, models and meshes that the losses are tested on, and the paper's formulas written out over all pairs."""

import numpy as np
from scipy.spatial.distance import cdist

from lbsfit_np.losses import cotangent_matrix


class Setting:
    """A small scan, a deformed and an undeformed model on a mesh, parts, weights: ``S`` is what most tests take."""

    def __init__(self, seed=0, n=37, parts=4):
        rng = np.random.default_rng(seed)
        self.mesh = bumpy_grid(5, 6, rng)
        self.V = self.mesh[0]
        m = len(self.V)
        self.offsets = 0.1 * rng.standard_normal((m, 3))
        self.Vd = self.V + self.offsets
        self.X = rng.standard_normal((n, 3))
        self.x_labels, self.v_labels = rng.integers(0, parts, n), rng.integers(0, parts, m)
        self.a = rng.random(n) * (rng.random(n) > 0.2)
        self.K = cotangent_matrix(*self.mesh)
        self.theta, self.found = rng.standard_normal((2, 3, 5, 3))


def bumpy_grid(rows, columns, rng, bump=0.3):
    """A mesh (vertices, faces) of rows · columns vertices over the plane."""
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    V = np.column_stack([x.ravel(), y.ravel(), bump * rng.standard_normal(x.size)]) / columns
    return V, _grid_faces(rows, columns)


def _grid_faces(rows, columns):
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


S = Setting()
PARTS = S.x_labels, S.v_labels


def chamfer_formula(X, V, a=None):
    """Means of squared distances to the nearest, both ways; points of the scan are weighted by ``a``."""
    d2 = cdist(X, V) ** 2
    a = np.ones(len(X)) if a is None else a
    return a @ d2.min(axis=1) / a.sum() + d2.min(axis=0).sum() / len(V)


def structured_formula(X, V, x_labels, v_labels, a=None):
    """The same between points and vertices of one part; those of an absent part add nothing."""
    d2 = cdist(X, V) ** 2
    d2[x_labels[:, None] != v_labels[None, :]] = np.inf
    to_V, to_X = d2.min(axis=1), d2.min(axis=0)
    to_V[np.isinf(to_V)], to_X[np.isinf(to_X)] = 0.0, 0.0
    a = np.ones(len(X)) if a is None else a
    return a @ to_V / a.sum() + to_X.sum() / len(V)
