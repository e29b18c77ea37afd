"""A pose drawn to what is known of poses, as far as its own scan leaves it open.

E + 2σ²/n (Θ − μ)ᵀ T⁻¹ (Θ − μ) in place of E, where angles vary among poses by N(μ, T), which ``learning.pose_prior`` finds.
Angles that points tell stay where these put them. A joint that is turned as hardly any other pose has it is tried as the rest of
its pose would have it: a hand that looks the wrong way is a minimum of E.
"""

from dataclasses import dataclass

import numpy as np

from ..optimize.gauss_newton import weight_matrix

__all__ = ["PosePrior", "drawn", "drawn_by_itself", "prior_of"]

# A joint is unusual that is further from where the rest of its pose would have it than 95 % of joints with one, two or three
# axes are: squared, in standard deviations. What is kept is better by so many σ²/n, which is one and a half times what an angle
# counts that is off by one. Others are looked for so many times, at most.
_UNUSUAL, _BETTER, _TIMES = (3.84, 5.99, 7.81), 3.0, 4
# E has each distance twice, from the points and from vertices, but what it tells of a pose no more than once.
_BOTH_WAYS = 2.0
# An angle that is told this share of how much it varies, squared, is held half as much while its template is found.
_TOLD = 0.3


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self):
        return f"<PosePrior: {len(self.mean)} joints, {int(np.any(self.precision, axis=1).sum())} angles>"

    def of(self, noise):
        """The prior of one scan, as ``GaussNewton.pose`` takes it; σ²/n says how much E counts."""
        return self.mean, _BOTH_WAYS * noise * self.precision

    def where_open(self, told, noise):
        """The same in what the scan leaves open alone, for steps in which the template goes along.

        There angles that are told well would shrink towards μ a little, all alike, and joints move to make up for it. So T is
        T + κ T C⁻¹ T, κ = 0.3, which lets an angle go that C says is known.

        Parameters
        ----------
        told : (t, t) array
            C of ``told_angles``.
        noise : float
            σ²/n.
        """
        P = self.precision
        return self.mean, _BOTH_WAYS * noise * P @ np.linalg.solve(P + _TOLD * np.linalg.inv(told), P)

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


def drawn(steps, problem, state, prior, noise):
    """A pose drawn to what others tell of it, unusual joints tried as the rest would have them.

    Parameters
    ----------
    steps : Refit
        Of the pose's template, or what has ``turning`` and ``to_the_end`` as well, such as with proportions that change.
    problem : Problem
    state : State
    prior : PosePrior
    noise : float
        σ²/n of ``told_angles``.

    Returns
    -------
    State
    """
    turning, known = steps.turning, {"prior": prior.of(noise)}
    state, value = steps.to_the_end(problem, state, **known)
    for _ in range(_TIMES):
        for theta in prior.usual(state.theta, turning):
            other, left = steps.to_the_end(problem, state.replace(theta=theta), **known)
            if left < value - _BETTER * noise:
                state, value = other, left
                break
        else:
            break
    return state


def drawn_by_itself(refit, problem, state, prior, steps=None):
    """A pose of a scan by itself, drawn to what is known of poses, and what holds it so in later steps.

    Parameters
    ----------
    refit : Refit
        Of the pose's template. Where proportions go along, what the scan tells is rather less than on a known one.
    problem : Problem
    state : State
    prior : PosePrior
    steps : as for :func:`drawn`, default ``refit``

    Returns
    -------
    state : State
    held : dict
        ``prior`` of ``GaussNewton.pose``.
    """
    _, noise = refit.told_angles(problem, state)
    return drawn(refit if steps is None else steps, problem, state, prior, noise), {"prior": prior.of(noise)}


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
    pairs = [(theta[turning], weight_matrix(weights, turning)) for theta, weights in (prior.of(noise), wanted)]
    weights, theta = sum(W for _, W in pairs), prior.mean.copy()
    theta[turning] = np.linalg.solve(weights, sum(W @ angles for angles, W in pairs))
    return theta, weights
