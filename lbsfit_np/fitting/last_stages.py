"""The last stages of a fit, from a pose that was found: the full objective, what the fit is judged by, and the registration."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..optimize.registration import Registration
from .confidence import shown_problem
from .scout import ALIKE
from .search import Search

__all__ = ["Ended", "LastStages"]


@dataclass(frozen=True, eq=False)
class Ended:
    """Where the last stages ended.

    Attributes
    ----------
    last : Outcome
        Of the full objective; its state is what comes out.
    judged : State
        What the fit is judged by: polished with the residual of the full objective, or without one where that has led to another
        pose than comes out. Brought onto the scan, the skin of a wrong pose explains it, too.
    labels : (k,) int array or None
        Parts of the problem's points that the structured term goes by.
    joint_std : (J,) array
        Of what comes out, as it was before its skin was registered.
    evaluations : int
    """

    last: object
    judged: object
    labels: np.ndarray | None
    joint_std: np.ndarray
    evaluations: int

    def whole(self, shown, model):
        """The same of the whole model, where a scan lacks limbs; as it is for None."""
        if shown is None:
            return self
        state, judged = (shown.whole(s, model) for s in (self.last.state, self.judged))
        return replace(self, last=replace(self.last, state=state), judged=judged)


class LastStages:
    """For one model.

    The full objective compares points with vertices. Where these lie far apart it moves joints and bends the skin that a polish
    goes by. So where the skin is registered, that is from pose and proportions as they were found.

    Parameters
    ----------
    model : Model
        Of what the scan shows.
    settings : FitSettings
    refit : Refit
        For the polish.
    polish : bool, default True
        Without it the pose is that of the full objective in either case.
    """

    def __init__(self, model, settings, refit, *, polish=True):
        self.model, self.settings, self.refit, self._polish = model, settings, refit, polish

    @cached_property
    def _registration(self):
        return Registration(self.model)

    def __call__(self, problem, dense, state, proba, *, labels_known=False, free=None, looked_for=None, **known):
        """Where a pose comes to.

        Parameters
        ----------
        problem, dense : Problem
            What takes part in the search, and all that the last steps look at, in the same frame.
        state : State
            Without a residual.
        proba : (k, n_parts) array or None
        labels_known : bool
            As for ``Search``.
        free : collection of str, optional
            As for ``Search.full``.
        looked_for : tuple of {"pose", "translation", "scale"}, optional
            What the scan has to tell, besides proportions, of which it is said how precisely it does; the polish's by default.
        **known
            Options of ``GaussNewton.pose``, for the polish.

        Returns
        -------
        Ended
        """
        with_partner = shown_problem(self.model, problem, state, self.settings.coverage)
        search = Search(self.model, with_partner, proba, labels_known, self.settings).full(state, free)
        out = judged = search.outcome.state
        if self._polish:
            # The residual takes what the template lacks; the pose is better known by distances to the surface, of many points.
            out = judged = self.refit.polish(dense, judged, **known)
        if self.settings.registration and self._polish:
            out = self.refit.polish(dense, state, **known)
            judged = out if self._apart(out, judged) > ALIKE else judged  # what is said is about the pose that comes out
        told = self.refit if looked_for is None else self.refit.freeing(looked_for)
        std = told.joint_std(with_partner, out, proba)
        if self.settings.registration:
            out = self._registration(dense, out)
        return Ended(replace(search.outcome, state=out), judged, search.labels, std, search.evaluations)

    def _apart(self, state, other):
        """How far the angles of two states put joints apart, on the mean, whatever their proportions, place and residual."""
        one, other = (self.model.deformed(s).joints for s in (state, state.replace(theta=other.theta)))
        return np.linalg.norm(one - other, axis=1).mean()
