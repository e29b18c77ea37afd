"""Calibration of the fits' own probability of being right: fits with known truth, many careless, and a regression on them.

What it finds are the constants in ``fitting.confidence``:

    python -c "from lbsfit_np.bench.calibrate import calibrate; print(calibrate())"
"""

from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..fitting.confidence import EVIDENCE, logarithms
from ..fitting.scout import EFFORTS, Effort
from ..io.rigs import load_rig
from .conditions import CONDITIONS, conditions_of, starts_scan
from .measure import joint_error
from .run import TRAINING_SEED
from .starts import PROBABLE, RIGS, counted_joints

__all__ = ["calibrate", "judged", "regression"]

# With as few starts as this many fits go wrong, which is what is to be learned from.
_CARELESS = Effort(starts=2, facings=1, survivors=1, finals=1, generations=0, parents=0, proposals=0)
_RIDGE = 1e-3


def calibrate(names=RIGS, *, n_scans=12, seed=7, training_scans=4000, on_row=None):
    """Fit scans of every row carefully and carelessly, and find how the evidence tells right from wrong.

    Parameters
    ----------
    names : sequence of str
        Rigs.
    n_scans : int, default 12
        A row.
    seed : int, default 7
        One that no table uses.
    training_scans : int, default 4000
    on_row : callable (rig, row, entries), optional

    Returns
    -------
    intercept : float
    weights : tuple of float
        One for each of ``fitting.confidence.EVIDENCE``.
    """
    entries = []
    for name in names:
        rig = load_rig(name)
        for row in conditions_of(rig):
            found = judged(rig, row, n_scans, seed, training_scans)
            entries += found
            if on_row is not None:
                on_row(name, row, found)
    return regression([e for e, _ in entries], [right for _, right in entries])


def judged(rig, row, n_scans, seed, training_scans):
    """[(evidence, whether the joints are right)] of careful and of careless fits."""
    from ..learning.finish import scan_fit
    from ..learning.fitter import LBSFitter

    fitter = LBSFitter(rig, training_scans=training_scans, random_state=TRAINING_SEED, **CONDITIONS[row].fitter)
    fitter.pretrain(cache=True)
    fit, out = scan_fit(fitter, fitter.segmenter_, fitter.regressor_), []
    for i in range(n_scans):
        scan = starts_scan(rig, row, i, seed)
        for effort in (_CARELESS, EFFORTS["balanced"]):
            fit.scout.effort = replace(effort)
            result = fit.fit(scan.points, random_state=TRAINING_SEED)
            error = joint_error(result.joints, scan.joints, counted_joints(rig, row, scan)) / (rig.size * scan.scale)
            out.append((result.evidence, bool(error <= PROBABLE)))
    return out


def regression(evidence, right):
    """Logistic regression in which no piece of evidence may speak for a fit.

    Parameters
    ----------
    evidence : sequence of dict
    right : sequence of bool

    Returns
    -------
    intercept : float
    weights : tuple of float

    Raises
    ------
    InputError
        Without right, or without wrong, fits.
    """
    from scipy.optimize import minimize

    X = np.array([logarithms(e) for e in evidence]).reshape(-1, len(EVIDENCE))
    y = np.array(right, dtype=float)
    if not 0 < y.sum() < len(y):
        raise InputError("right", f"{len(y)} fits, {int(y.sum())} of them right", "right and wrong fits")

    def loss(w):
        z = w[0] + X @ w[1:]
        value = np.logaddexp(0.0, -z)[y == 1].sum() + np.logaddexp(0.0, z)[y == 0].sum()
        slope = 1.0 / (1.0 + np.exp(-z)) - y
        gradient = np.r_[slope.mean(), X.T @ slope / len(y) + 2 * _RIDGE * w[1:]]
        return value / len(y) + _RIDGE * w[1:] @ w[1:], gradient

    bounds = [(None, None)] + [(None, 0.0)] * len(EVIDENCE)
    w = minimize(loss, np.zeros(len(EVIDENCE) + 1), jac=True, method="L-BFGS-B", bounds=bounds).x
    return float(w[0]), tuple(map(float, w[1:]))
