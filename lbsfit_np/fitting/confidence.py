"""How far a fit can be trusted: what it leaves unexplained, and what that says of the pose.

The final loss tells right fits from wrong ones, but only against what the scan could have given at best. So the evidence is a
handful of shares, each near 0 for a right fit, whatever the rig, the unit and the number of points; a logistic regression on
their logarithms, calibrated on scans with known truth (``bench.calibrate``), makes one probability of them.
"""

import numpy as np

from ..medians import weighted_median
from ..neighbors import PointIndex, neighbour_distances, spacing
from ..optimize.problem import Problem, merged
from ..optimize.visibility import WHOLE, seen_vertices

__all__ = [
    "AT_LIMITS",
    "EVIDENCE",
    "FAILED",
    "MISFIT",
    "NO_POINTS",
    "REGRESSED",
    "SOMEBODY_ELSE",
    "SUSPECT",
    "beyond_noise",
    "evidence_of",
    "lacks_most",
    "logarithms",
    "lonely_odd",
    "merged",
    "misfit",
    "probability_of",
    "shown_problem",
    "verdict_of",
    "without",
]

# What a fit is judged by; docs/fitting.md has the same list. The regression is on those that all fits have: proportions are for
# learned templates, and something is hidden where a scan is said to show but a part.
REGRESSED = (
    *("distance", "unexplained", "unreached", "part_unexplained", "part_unreached"),
    *("disagreement", "rival", "at_limits", "sparse"),
)
EVIDENCE = (*REGRESSED, "proportions", "hidden")
# Where other proportions than a template's leave less unexplained by more than this share, the scan is of somebody else. Of 80
# hands on their subject's template the share was 0.23 at most, 0.05 in the median, of 30 of others 0.38 at least; of 60 bodies
# 0.15 at most, of 24 of others 0.57 at least.
SOMEBODY_ELSE = 0.3
# From where on a part does not fit, of "part_unexplained".
MISFIT = 0.15
# From where on a part has no points, of "part_unreached".
NO_POINTS = 0.4
# s of ρ(d²) = d² / (d² + s²): distances of about this count half, in half sizes of the rig.
_SCALE = 0.05
# Of noise, distances up to so many medians are no fault of the pose; of sparse points, surface that is nearer than their spacing
# is none. But beyond these, in half sizes, noise and gaps are large enough to hide a wrong pose.
_NOISE, _NOISIEST, _SPARSEST = 2.5, 0.015, 0.08
# Points whose neighbours are so many times as far away as is usual are clutter, which no pose explains (density that varies
# tenfold makes 3.2); unless less than this share of the weight would be left.
_LONELY, _LEAST_KEPT = 4.0, 0.7
# Clutter near the body has neighbours on it, but hardly any that are unexplained, too, whereas a limb that the pose misses
# leaves many. So among points with a ρ above _ODD the k-th neighbour counts: clutter is where that is more than _LONELY_ODD
# times as far away as is usual among all points. k is one for each _POINTS_PER_K points of the scan, at most _MOST_K.
_ODD, _LONELY_ODD, _POINTS_PER_K, _MOST_K = 0.05, 2.8, 400, 6
# Points and surface with no partner nearer than this, in half sizes, have none.
_PARTNER = 0.08
# Parts with less than this share of the surface are too small to be judged by themselves.
_PART = 0.01
# Evidence below this is as good as none.
_FLOOR = 1e-3


def evidence_of(
    model,
    vertices,
    X,
    *,
    proba=None,
    rivals=(),
    value=None,
    theta=None,
    coverage=WHOLE,
    x_weights=None,
    proportions=0.0,
    shown=None,
):
    """Measure a fit.

    Parameters
    ----------
    model : Model
    vertices : (m, 3) array
        V^d in the normalised frame.
    X : (n, 3) array
        The scan in that frame.
    proba : (n, n_parts) array, optional
        What the segmenter says of the points.
    rivals : sequence of float
        What the next best, different poses leave unexplained, E of ``optimize.gauss_newton``.
    value : float, optional
        The same of this pose.
    theta : (J, 3) array, optional
    coverage : Coverage, optional
        What the scan shows.
    x_weights : (n,) array, optional
        How much each point counts.
    proportions : float, default 0
        Share by which other proportions leave less unexplained than the template's.
    shown : Shown, optional
        Where the scan lacks limbs: their skin and joints.

    Returns
    -------
    evidence : dict of str to float
        "distance": the points' median distance from the surface ÷ s; "unexplained": mean of ρ over what these distances are
        beyond 2.5 times their median, which is taken for noise up to 0.015; "unreached": the same over the surface's from the
        points, but for limbs that are missing; "part_unexplained" and "part_unreached": the largest of each over single parts,
        missing ones too; "disagreement": 1 − mean probability that the segmenter gives the part that the mesh has at a point;
        "rival": value ÷ the least of the rivals'; "at_limits": share of the angles that are at a limit; "sparse": angles, three
        at least, ÷ points; "proportions" as given; "hidden": share of the surface that the scan cannot show, as the pose has it
        and ``coverage`` says, or that is missing.
        All in [0, 1]; what is not known is 0. Points at one place are one. Points far from all others, and unexplained ones far
        from all others of these, count for nothing.
    worst : dict of str to int
        The parts of "part_unexplained" and "part_unreached"; −1 where nothing is.
    """
    rig, labels, a = model.rig, model.labels, model.areas
    w = np.full(len(X), 1.0 / len(X)) if x_weights is None else x_weights / x_weights.sum()
    X, w, proba = merged(X, w, proba)
    on = PointIndex(vertices).nearest(X)
    there = model.surface.closest(X, on, vertices)
    away = np.minimum(((X - vertices[on]) ** 2).sum(axis=1), ((X - there.points) ** 2).sum(axis=1))
    index = PointIndex(X)
    to_X = index.nearest(vertices)
    # Between points there is nothing to reach.
    third = neighbour_distances(X, 3)
    w = without(w, third > _LONELY * np.median(third))
    back = np.maximum(np.linalg.norm(vertices - X[to_X], axis=1) - min(spacing(third), _SPARSEST), 0.0) ** 2
    seen = seen_vertices(coverage, vertices, rig.faces, Problem(X), on, to_X)
    typical, away = beyond_noise(away, w)
    rho_x, rho_v = misfit(away), misfit(back)
    w = without(w, lonely_odd(X, away))
    parts, of_all = labels[on], a.sum()
    of_points, of_surface = _worst(parts, w, rho_x), _worst(labels, np.where(seen, a, 0.0), rho_v)
    if shown is not None:
        seen &= ~shown.missing
    a = np.where(seen, a, 0.0)
    out = {
        "distance": min(1.0, typical / _SCALE),
        "unexplained": float(w @ rho_x),
        "unreached": float(a @ rho_v / max(a.sum(), 1e-12)),
        "part_unexplained": of_points[0],
        "part_unreached": of_surface[0],
        "disagreement": 0.0 if proba is None else _disagreement(w, proba, parts),
        "rival": float(min(1.0, value / min(rivals))) if len(rivals) and value is not None and min(rivals) > 0 else 0.0,
        "at_limits": 0.0 if theta is None else _at_limits(rig, theta, None if shown is None else shown.joints),
        # 1 ÷ Σw² points that weigh the same are as good. The root's three angles are to be found by all means.
        "sparse": float(min(1.0, max(_bending(rig).sum(), 3) * (w**2).sum())),
        "proportions": float(np.clip(proportions, 0.0, 1.0)),
        "hidden": 0.0 if seen.all() else float(max(0.0, 1.0 - a.sum() / max(of_all, 1e-12))),  # rounding is no evidence
    }
    return out, {"part_unexplained": of_points[1], "part_unreached": of_surface[1]}


def beyond_noise(away, w):
    """The points' median distance from the surface, and what is beyond noise of theirs.

    Parameters
    ----------
    away : (n,) array
        Squared distances, half sizes.
    w : (n,) array
        Weights of the points.

    Returns
    -------
    typical : float
    away : (n,) array
        Squared.
    """
    typical = float(np.sqrt(weighted_median(away, w)))
    return typical, np.maximum(np.sqrt(away) - _NOISE * min(typical, _NOISIEST), 0.0) ** 2


def misfit(away):
    """ρ of squared distances, half sizes."""
    return away / (away + _SCALE**2)


def shown_problem(model, problem, state, coverage):
    """The problem without what has no partner: points far from the mesh, surface far from the points or not shown.

    Parameters
    ----------
    model : Model
    problem : Problem
    state : State
        A pose that is about right.
    coverage : Coverage

    Returns
    -------
    Problem
        With weights of 0 for these; the same one where there are none, or where hardly any surface would be left.
    """
    V = model.deformed(state).vertices
    on, to_X = PointIndex(V).nearest(problem.X), problem.x_index.nearest(V)
    away, back = np.linalg.norm(problem.X - V[on], axis=1), np.linalg.norm(V - problem.X[to_X], axis=1)
    near = max(_PARTNER, 4 * np.median(away))
    # Not by the median of these: of a scan that shows less than half of the body that is where there are no points.
    x_kept, v_kept = away < near, back < max(near, problem.spacing)
    v_kept &= seen_vertices(coverage, V, model.rig.faces, problem, on, to_X)
    if (x_kept.all() and v_kept.all()) or model.areas[v_kept].sum() < coverage.least:
        return problem
    a = problem.shares * x_kept
    return Problem(problem.X, a / a.sum(), v_kept.astype(float))


def lonely_odd(X, away):
    """Unexplained points with hardly another unexplained one near them: clutter near the body.

    Parameters
    ----------
    X : (n, 3) array
        In half sizes.
    away : (n,) array
        Squared distances from the surface.

    Returns
    -------
    (n,) bool array
    """
    k = int(np.clip(len(X) // _POINTS_PER_K, 1, _MOST_K))
    odd = np.flatnonzero(misfit(away) > _ODD)
    lonely = np.zeros(len(X), dtype=bool)
    if len(odd):
        lonely[odd] = neighbour_distances(X[odd], k) > _LONELY_ODD * np.median(neighbour_distances(X, k))
    return lonely


def without(w, clutter):
    """Weights of the points, those of clutter 0."""
    kept = np.where(clutter, 0.0, w)
    return kept / kept.sum() if kept.sum() > _LEAST_KEPT else w


def _worst(parts, weights, rho):
    """The largest weighted mean of ρ over a part that is large enough to be judged, and that part; 0 and −1 without one."""
    share, sums = np.bincount(parts, weights), np.bincount(parts, weights * rho)
    of = np.where(share > _PART, sums / np.maximum(share, 1e-300), 0.0)
    return (float(of.max()), int(of.argmax())) if of.max() > 0 else (0.0, -1)


def _disagreement(w, proba, parts):
    """1 − mean probability of the mesh's parts, over the points of which anything is said."""
    w = w * proba.any(axis=1)
    return float(max(0.0, 1.0 - w @ proba[np.arange(len(parts)), parts] / w.sum())) if w.sum() > 0 else 0.0


def _bending(rig):
    """(J, 3) bool: the angles that are to be found, without the root's."""
    free = rig.turning.copy()
    free[rig.root] = False
    return free


def _at_limits(rig, theta, missing=None):
    """Share of the angles that are at a limit, those of missing limbs left out, which are where nothing has put them."""
    free = _bending(rig) & (rig.upper - rig.lower > _NARROW)
    if missing is not None:
        free &= ~missing[:, None]
    if not free.any():
        return 0.0
    room = np.minimum(theta - rig.lower, rig.upper - theta)[free]
    return float((room < 0.01).mean())


# ---- from evidence to a probability ----

# Logistic regression on log10(evidence + floor): intercept, then one weight for each of REGRESSED. Found by ``bench.calibrate``
# on the tuning seed: both bundled rigs, all conditions and worse, careful fits and careless ones.
_INTERCEPT = -16.46
_WEIGHTS = (0.0, -2.63, -1.31, -1.77, -0.56, -1.04, -0.41, -0.62, -1.89)
# Noise of 2 % of the size gives a "distance" of 0.54. What lies further off is not the rig, and no scan of the calibration was
# like it: such a fit is not believed more than this. Nor is one on somebody else's template: at an earlier state, which called
# scans so from a share of 0.2 on, 4 of 27 were right.
_NOT_THE_RIG, _MOST_THEN = 0.6, 0.25
# Nor one of fewer points than two for each angle, of "sparse": these can all lie on the mesh of a wrong pose.
_TOO_FEW = 0.5
# Nor one of a scan that lacks so much of the body that these are guesses, where it is not noise that makes them so: known labels
# leave nothing else that speaks against it.
_MOST_GUESSES, _MISSING = 0.4, 0.9
# Nor one by which the scan shows hardly anything of the body, of "hidden": one that lies nearly all behind or beyond the points
# leaves nothing to be compared with them. Of 120 fits of one-sided, cropped scans six were beyond this: four wrong ones, and two
# right ones that were in doubt anyway. Right ones that were not had 0.89 at most.
_MOST_HIDDEN = 0.9
# Below the first a fit has failed, below the second it is suspect.
FAILED = 0.05
SUSPECT = 0.5


def probability_of(evidence, guesses=0.0):
    """The probability that the mean joint error is below 1.5 % of the rig's size.

    Calibrated over all joints that turn, in views of one side over those that the view shows. ``guesses`` is the share of the
    joints whose places a scan hardly tells.
    """
    p = float(1.0 / (1.0 + np.exp(-(_INTERCEPT + np.dot(_WEIGHTS, logarithms(evidence))))))
    most = {"distance": _NOT_THE_RIG, "proportions": SOMEBODY_ELSE, "sparse": _TOO_FEW, "hidden": _MOST_HIDDEN}
    doubted = any(evidence[name] > value for name, value in most.items())
    return min(p, _MOST_THEN) if doubted or lacks_most(evidence, guesses) else p


def lacks_most(evidence, guesses):
    """Whether a scan lacks so much of the body that nothing can be said of it; ``guesses`` as in :func:`probability_of`."""
    return guesses > _MOST_GUESSES and evidence["part_unreached"] > _MISSING


def logarithms(evidence):
    """(9,) decimal logarithms of the pieces of evidence, what the probability is linear in before the logistic function."""
    return np.log10(np.array([evidence[name] for name in REGRESSED]) + _FLOOR)


def verdict_of(evidence, probability, worst=None):
    """Status and reason.

    Parameters
    ----------
    evidence : dict
        Of :func:`evidence_of`.
    probability : float
    worst : dict of str to str, optional
        Names of the parts of "part_unexplained" and "part_unreached".

    Returns
    -------
    status : {"ok", "suspect", "failed"}
    reason : str
        What speaks against the fit, in words; empty for "ok".
    """
    if probability >= SUSPECT:
        return "ok", ""
    told = [
        words.format(value=evidence[name], part=(worst or {}).get(name, ""))
        for name, (least, words) in _WORDS.items()
        if evidence[name] > least
    ]
    reason = "; ".join(told) or _together(evidence, worst or {})
    return "failed" if probability < FAILED else "suspect", reason


def _together(evidence, worst):
    """Where nothing alone is worth a word: the two pieces of evidence that have cost the most probability."""
    cost = dict(zip(REGRESSED, np.array(_WEIGHTS) * (np.log10(_FLOOR) - logarithms(evidence)), strict=True))
    seen = (name for name, c in cost.items() if c > 0 and f"{evidence[name]:.0%}" != "0%")
    most = sorted(seen, key=cost.get, reverse=True)[:2]
    named = [_ALSO[name].format(value=evidence[name], part=worst.get(name, "")) for name in most]
    return "several small things together" + (f", above all {' and '.join(named)}" if named else "")


# What a piece of evidence is called that is not worth a word by itself.
_ALSO = {
    "unexplained": "points that are not explained (mean misfit {value:.0%})",
    "unreached": "surface that is not reached by points (mean misfit {value:.0%})",
    "part_unexplained": "points near part {part} that are not explained (mean misfit {value:.0%})",
    "part_unreached": "surface of part {part} that is not reached by points (mean misfit {value:.0%})",
    "disagreement": "labels and mesh that disagree ({value:.0%} on average)",
    "rival": "another pose that explains the scan nearly as well ({value:.0%})",
    "at_limits": "angles at their limits ({value:.0%})",
    "sparse": "few points",
}
# From this share of the angles on limits may be too narrow, or of the wrong sign.
AT_LIMITS = 0.25
# Axes with less room than this, radians, are always near a limit, which tells nothing.
_NARROW = 0.1
# From where on a piece of evidence is worth a word, and the word.
_WORDS = {
    "distance": (_NOT_THE_RIG, "points lie far from the mesh"),
    "unexplained": (0.03, "points are not explained (mean misfit {value:.0%})"),
    "unreached": (0.12, "surface is not reached by points (mean misfit {value:.0%})"),
    "part_unexplained": (MISFIT, "part {part} does not fit"),
    "part_unreached": (NO_POINTS, "part {part} has no points"),
    "disagreement": (0.35, "labels and mesh disagree ({value:.0%} on average)"),
    "rival": (0.6, "another pose explains the scan nearly as well"),
    "at_limits": (AT_LIMITS, "{value:.0%} of the angles are at their limits"),
    "sparse": (0.1, "few points take part (of a mesh, --samples takes more), or few have all the weight"),
    "proportions": (SOMEBODY_ELSE, "other proportions explain it much better: is it a scan of somebody else?"),
    "hidden": (_MOST_HIDDEN, "of this pose the scan would show next to nothing ({value:.0%} of the surface hidden or cut off)"),
}
