"""The fit of one scan on a template that is known: its pose by :class:`Refit`, then the last stages."""

import time
from functools import cached_property, partial

import numpy as np

from ..optimize.state import IN_UNIT
from .assemble import assemble
from .effort import EFFORTS
from .last_stages import LastStages
from .missing import MissingLimbs
from .proportioned import Proportioned
from .refit import Refit

__all__ = ["TemplateFit"]


class TemplateFit:
    """Fits on one subject's template.

    Parameters
    ----------
    rig : Rig
        What offsets refer to.
    model : Model
        Of the template.
    settings : FitSettings
        Of ``polish``, the steps of :meth:`proportions`; the last steps of the pose are taken whatever it says.
    other_limbs : bool, default True
        As for ``Bends``.
    """

    def __init__(self, rig, model, settings, *, other_limbs=True):
        self.rig, self.model, self.settings = rig, model, settings
        bends = EFFORTS[settings.effort].bends
        self.refit = Refit(model, coverage=settings.coverage, bends=bends, other_limbs=other_limbs)

    @cached_property
    def _last_stages(self):
        return LastStages(self.model, self.settings, self.refit)

    @cached_property
    def _missing(self):
        return MissingLimbs(self.model)

    @cached_property
    def _proportioned(self):
        place = () if self.settings.scale == "fixed" else ("scale",)
        return Proportioned(self.model, self.settings, ("pose", "translation", *place))

    def proportions(self, problem, state):
        """Share by which proportions of its own leave less of a scan unexplained than those of the template.

        Parameters
        ----------
        problem : Problem
        state : State
            Of this template.

        Returns
        -------
        float
        """
        _, same = self._proportioned.as_they_are(problem, state)
        _, other = self._proportioned.to_the_end(problem, state)
        return 1.0 - other / max(same, np.finfo(float).tiny)

    def finish(
        self,
        problem,
        state,
        *,
        points,
        part,
        frame,
        free=IN_UNIT,
        proba=None,
        labels_known=None,
        theta0=None,
        prior=None,
        dense=None,
        value=None,
        rivals=(),
        proportions=0.0,
        notes=(),
        found=(),
        further=(),
        given=(),
        started=None,
    ):
        """The last stages from a pose that was found, and the result.

        Parameters
        ----------
        problem : Problem
        state : State
            Of this template.
        points : (n, 3) array
            All points.
        part : TakingPart
            What of the scan is looked at; its rows are those of the problem.
        frame : Frame
            Of the problem.
        free : tuple of {"pose", "translation", "scale"}
            What was looked for.
        proba : (k, n_parts) array, optional
            Without it the structured term is left out.
        labels_known : (n,) int array, optional
        theta0 : (J, 3) array, optional
            A pose that is known: of limbs that the scan lacks it is kept.
        prior : ((J, 3) array, float or (t, t) array), optional
            As in ``GaussNewton.pose``.
        dense : (every (d,) int array, Problem), optional
            All points that the last steps look at, in the same frame; those of ``part.rows`` by default.
        value, rivals, proportions, notes, found, further, given
            As for :func:`~lbsfit_np.fitting.assemble.assemble`.
        started : float, optional

        Returns
        -------
        FitResult
        """
        started = time.perf_counter() if started is None else started
        settings = self.settings
        every, last = (part.rows, problem) if dense is None else dense
        shown = None
        if labels_known is None and not settings.partial:
            steps = partial(Refit, free=free, coverage=settings.coverage)
            shown = self._missing.of(last, state, steps, theta0=theta0, prior=prior)
        stages, free_in_full = self._last_stages, ("pose", "translation", "residual")
        if shown is not None:
            stages = LastStages(shown.model, settings, Refit(shown.model, coverage=settings.coverage))
            state, proba = shown.state, shown.said(proba)
        labels = None if labels_known is None or labels_known[every].min() < 0 else labels_known[every]
        known = {"labels_known": labels_known is not None, "labels": labels, "prior": prior}
        end = stages(problem, last, state, proba, free=free_in_full, looked_for=free, **known).whole(shown, self.model)
        return assemble(
            self.rig,
            self.model,
            problem,
            end.last,
            points=points,
            part=part,
            frame=frame,
            sigma=settings.refinements[-1],
            weights=settings.weights,
            x_labels=end.labels,
            proba=proba,
            labels=labels_known,
            joint_std=end.joint_std,
            judged_by=end.judged,
            shown=shown,
            evaluations=end.evaluations,
            notes=notes,
            found=found,
            further=further,
            given=given,
            started=started,
            value=value,
            rivals=rivals,
            proportions=proportions,
            coverage=settings.coverage,
            unit=settings.unit,
        )
