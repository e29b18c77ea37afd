"""What a collection's poses tell of a pose of which its own scan tells little: an empirical Bayes prior of the angles.

How far a forearm is twisted, hardly any point tells: what is found varies more than people move. Of many scans it is known how
much: where scan i tells its angles with the covariance C_i, and angles vary among poses by N(μ, T), found ones vary by T + C_i.
μ and T are those that make what was found most likely (by EM), and each pose is drawn towards μ as far as its own scan leaves it
open: E + σ²/n (Θ − μ)ᵀ T⁻¹ (Θ − μ) in place of E. Angles that points tell stay where these put them. A joint that is turned as
hardly any other pose has it is tried as the rest of its pose would have it: a hand that looks the wrong way is a minimum of E.
"""

from dataclasses import dataclass

import numpy as np

from ..optimize.gauss_newton import as_weights

__all__ = ["PosePrior", "drawn", "looked_at", "pose_prior", "prior_of"]

# Scans that are looked at, at most, evenly taken; steps of EM.
_MOST, _STEPS = 400, 40
# As if the angles of so many scans more varied by this, radians: few poses look more alike than poses are.
_BEFORE, _SPREAD = 1.0, 0.3
# As if so many more had angles that vary as they do, but do not go together.
_APART = 60.0
# Fewer poses tell nothing of how poses vary.
_LEAST = 3
# A joint is unusual that is further from where the rest of its pose would have it than 95 % of joints with one, two or three
# axes are: squared, in standard deviations. What is kept is better by so much of what an angle counts that is off by one; so many
# times, at most, others are looked for.
_UNUSUAL, _BETTER, _TIMES = (3.84, 5.99, 7.81), 3.0, 4


@dataclass(frozen=True)
class PosePrior:
    """Θ ~ N(μ, T); the root's turn is as likely as any other.

    Attributes
    ----------
    mean : (J, 3) array
        μ, radians.
    precision : (t, t) array
        T⁻¹ of the angles that turn, in the order of ``np.argwhere(Layout.turning)``; zeros for the root's.
    """

    mean: np.ndarray
    precision: np.ndarray

    def of(self, noise):
        """The prior of one scan, as ``GaussNewton.pose`` takes it; σ²/n says how much E counts.

        σ² is of the points. E has vertices as well, so that poses are drawn less than the points alone would let them.
        """
        return self.mean, noise * self.precision

    def usual(self, theta, turning):
        """Poses in which one unusual joint is as the rest would have it, E[Θ_j | other joints]; the most unusual first.

        Parameters
        ----------
        theta : (J, 3) array
        turning : (J, 3) bool array

        Returns
        -------
        list of (J, 3) array
        """
        joint, away, out = np.nonzero(turning)[0], (theta - self.mean)[turning], []
        pull = self.precision @ away
        for j in np.unique(joint):
            own = joint == j
            P = self.precision[np.ix_(own, own)]
            if not P.any():
                continue  # the root
            off = np.linalg.solve(P, pull[own])  # of the joint, from where the others would have it
            if (far := float(off @ P @ off) / _UNUSUAL[len(off) - 1]) > 1.0:
                other = theta.copy()
                other[j, turning[j]] -= off
                out.append((far, other))
        return [other for _, other in sorted(out, key=lambda found: -found[0])]


def drawn(refit, problem, state, prior, noise):
    """A pose drawn to what others tell of it, unusual joints tried as the rest would have them.

    Parameters
    ----------
    refit : Refit
        Of the pose's template.
    problem : Problem
    state : State
    prior : PosePrior
    noise : float
        σ²/n of ``told_angles``.

    Returns
    -------
    State
    """
    turning, known = refit.turning, {"prior": prior.of(noise)}
    state, value = refit.to_the_end(problem, state, **known)
    for _ in range(_TIMES):
        for theta in prior.usual(state.theta, turning):
            other, left = refit.to_the_end(problem, state.replace(theta=theta), **known)
            if left < value - _BETTER * noise:
                state, value = other, left
                break
        else:
            break
    return state


def looked_at(n):
    """Which of n scans the prior is made from, (k,) int, at most 400."""
    return np.unique(np.linspace(0, n - 1, min(n, _MOST)).astype(int))


def prior_of(prior, noise, turning, wanted=None):
    """What holds one pose, as ``GaussNewton.pose`` takes it, or None.

    Parameters
    ----------
    prior : PosePrior or None
    noise : float
        σ²/n of the pose's scan; 0 where the prior does not count.
    turning : (J, 3) bool array
    wanted : ((J, 3) array, float), optional
        Angles to be drawn to besides, and their weight: what comes out is the sum of both but for a constant.
    """
    if prior is None or not noise:
        return wanted
    if wanted is None:
        return prior.of(noise)
    pairs = [(theta[turning], as_weights(weights, turning)) for theta, weights in (prior.of(noise), wanted)]
    weights, theta = sum(W for _, W in pairs), prior.mean.copy()
    theta[turning] = np.linalg.solve(weights, sum(W @ angles for angles, W in pairs))
    return theta, weights


def pose_prior(poses, told, turning, root):
    """The prior that makes what scans tell of their poses most likely.

    Parameters
    ----------
    poses : sequence of (J, 3) arrays
        As found, each by its own scan alone.
    told : sequence of (t, t) arrays
        C_i: covariances of their angles that turn, by ``optimize.precision.told_angles``.
    turning : (J, 3) bool array
    root : int

    Returns
    -------
    PosePrior or None
        None of hardly any poses.
    """
    if len(poses) < _LEAST:
        return None
    held = np.nonzero(turning)[0] != root
    found = np.array([theta[turning][held] for theta in poses])
    known = np.linalg.inv(np.array([C[np.ix_(held, held)] for C in told]))
    n, t = found.shape
    pulled = np.einsum("nab,nb->na", known, found)
    # EM is slow where most of what varies is not the poses: it begins from what is left without that.
    varies, unsure = found.var(axis=0), np.mean([np.diag(C)[held] for C in told], axis=0)
    mean, spread = np.median(found, axis=0), np.diag(np.maximum(varies - unsure, 0.1 * varies) + _SPREAD**2 / n)
    for _ in range(_STEPS):
        T_inv = np.linalg.inv(spread)
        C = np.linalg.inv(known + T_inv)
        own = np.einsum("nab,nb->na", C, pulled + T_inv @ mean)
        mean = own.mean(axis=0)
        S = ((own - mean).T @ (own - mean) + C.sum(axis=0) + _BEFORE * _SPREAD**2 * np.eye(t)) / (n + _BEFORE)
        spread = (n * S + _APART * np.diag(np.diag(S))) / (n + _APART)
    centre, precision = np.zeros(turning.shape), np.zeros((len(held), len(held)))
    centre[tuple(np.argwhere(turning)[held].T)] = mean
    precision[np.ix_(held, held)] = np.linalg.inv(spread)
    return PosePrior(centre, precision)
