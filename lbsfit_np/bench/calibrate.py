"""Calibration of the fits' own probability of being right: fits with known truth, many careless, and a regression on them.

What it finds are the constants in ``fitting.confidence``:

    python -c "from lbsfit_np.bench.calibrate import calibrate; print(calibrate())"
"""

from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..fitting.confidence import REGRESSED, logarithms
from ..fitting.effort import EFFORTS, Effort
from ..io.rigs import load_rig
from ..rig.rig import Rig
from ..seeds import generator
from .conditions import CONDITIONS, Condition, condition_scan, conditions_of
from .measure import joint_error
from .run import TRAINING_SEED
from .starts import PROBABLE, RIGS, counted_joints

__all__ = ["Case", "calibrate", "cases_of", "judged", "regression"]

# With as few starts as this many fits go wrong, which is what is to be learned from.
_CARELESS = Effort(starts=2, facings=1, survivors=1, finals=1, generations=0, parents=0, proposals=0, closer=False, bends=False)
_RIDGE = 1e-3


def calibrate(names=RIGS, *, n_scans=12, seed=7, training_scans=4000, on_case=None):
    """Fit scans of every case carefully and carelessly, and find how the evidence tells right from wrong.

    Parameters
    ----------
    names : sequence of str
        Rigs.
    n_scans : int, default 12
        A case.
    seed : int, default 7
        One that no table uses.
    training_scans : int, default 4000
    on_case : callable (case, entries), optional
        After each case, with what :func:`judged` has found.

    Returns
    -------
    intercept : float
    weights : tuple of float
        One for each of ``fitting.confidence.REGRESSED``.
    """
    rigs = [load_rig(name) for name in names]
    entries = []
    for case in (case for rig in rigs for case in cases_of(rig, rigs)):
        found = judged(case, n_scans, seed, training_scans)
        entries += found
        if on_case is not None:
            on_case(case, found)
    return regression([e for e, _ in entries], [right for _, right in entries])


# ---- what is fitted ----


@dataclass(frozen=True)
class Case:
    """A kind of scan for a rig.

    Attributes
    ----------
    rig : Rig
        That is fitted.
    name : str
    condition : Condition
        Of the scans, and what the fitter is told.
    shown : Rig or None
        The rig that the scans are of; None for solids that are no rig's.
    """

    rig: Rig
    name: str
    condition: Condition
    shown: Rig | None

    def scan(self, i, rng):
        """Points, and their truth; None where no fit can be right."""
        if self.shown is None:
            return _solid(i, rng) * self.rig.size / 2, None
        scan = condition_scan(self.shown, self.condition, i, rng)
        return scan.points, scan if self.shown is self.rig else None


def cases_of(rig, rigs):
    """All rows of the table, scans that are worse than these, and what is not the rig: other rigs and solids.

    Parameters
    ----------
    rig : Rig
    rigs : sequence of Rig
        The other ones are of these.

    Returns
    -------
    list of Case
    """
    turned = CONDITIONS["turned"]
    rows = {row: CONDITIONS[row] for row in conditions_of(rig) if not CONDITIONS[row].arm}
    worse = {name: replace(turned, what=name, scan=replace(turned.scan, **settings)) for name, settings in _WORSE.items()}
    cases = [Case(rig, name, condition, rig) for name, condition in (rows | worse).items()]
    cases += [Case(rig, f"in truth {other.name}", turned, other) for other in rigs if other is not rig]
    return [*cases, Case(rig, "in truth a solid", turned, None)]


# Fewer points, more noise, and floors than any row has, and one side alone where nobody says so. Noise of 0.04 half sizes is 2 %
# of the size.
_WORSE = {
    "1000 points, 2 % noise": {"n_points": 1000, "noise": 0.04},
    "300 points, 1 % noise": {"n_points": 300, "noise": 0.02},
    "300 points, 2 % noise": {"n_points": 300, "noise": 0.04},
    "60 points": {"n_points": 60},
    "one side, not said": {"one_sided": True},
    "floor, clutter, 1 % noise": {"floor": 0.7, "clutter": 0.1, "noise": 0.02},
}


def _solid(i, rng):
    """Points on a box, a ball or a can, stretched, in half sizes."""
    import trimesh

    makers = trimesh.creation.box, trimesh.creation.icosphere, trimesh.creation.cylinder
    mesh = makers[i % 3](**({"radius": 1.0, "height": 2.0} if i % 3 == 2 else {}))
    points, _ = trimesh.sample.sample_surface(mesh, 2500, seed=int(rng.integers(2**31)))
    points = np.asarray(points) * np.exp(rng.uniform(-1.5, 0.0, 3))
    return points / np.abs(points).max() + 0.004 * rng.standard_normal(points.shape)


# ---- how it is fitted ----


def judged(case, n_scans, seed, training_scans):
    """[(evidence, whether the joints are right)] of careful and of careless fits."""
    from ..learning.fitter import LBSFitter
    from ..learning.new_scan import scan_fit

    rig = case.rig
    fitter = LBSFitter(rig, training_scans=training_scans, random_state=TRAINING_SEED, **case.condition.fitter)
    fitter.pretrain(cache=True)
    fit, out = scan_fit(fitter, fitter.segmenter_, fitter.regressor_), []
    for i in range(n_scans):
        points, truth = case.scan(i, generator(seed, "calibrate", rig.name, case.name, i))
        for effort in (_CARELESS, EFFORTS["balanced"]):
            fit.scout.effort = replace(effort)
            # What takes part is given: a fit with more or less of the scan besides would be chosen by its evidence.
            part = fit.taking_part(points, random_state=TRAINING_SEED, ups=fit.facing.floors)
            result = fit.fit(points, part=part)
            error = np.inf
            if truth is not None:
                counted = counted_joints(rig, case.condition, truth)
                error = joint_error(result.joints, truth.joints, counted) / (rig.size * truth.scale)
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

    X = np.array([logarithms(e) for e in evidence]).reshape(-1, len(REGRESSED))
    y = np.array(right, dtype=float)
    if not 0 < y.sum() < len(y):
        raise InputError("right", f"{len(y)} fits, {int(y.sum())} of them right", "right and wrong fits")

    def loss(w):
        z = w[0] + X @ w[1:]
        value = np.logaddexp(0.0, -z)[y == 1].sum() + np.logaddexp(0.0, z)[y == 0].sum()
        slope = 1.0 / (1.0 + np.exp(-z)) - y
        gradient = np.r_[slope.mean(), X.T @ slope / len(y) + 2 * _RIDGE * w[1:]]
        return value / len(y) + _RIDGE * w[1:] @ w[1:], gradient

    bounds = [(None, None)] + [(None, 0.0)] * len(REGRESSED)
    w = minimize(loss, np.zeros(len(REGRESSED) + 1), jac=True, method="L-BFGS-B", bounds=bounds).x
    return float(w[0]), tuple(map(float, w[1:]))
