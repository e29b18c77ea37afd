"""The last steps of a pose whose template's proportions are found along with it."""

from ..optimize.gauss_newton import GaussNewton
from ..optimize.state import free_angles

__all__ = ["TANGENTIAL", "Proportioned", "step_options"]

# Of steps that look near, on single scans and for templates: how much distances along the surface count beside those across it.
TANGENTIAL = 0.02


def step_options(settings):
    """How steps with proportions weigh, options of ``GaussNewton``."""
    return {"ridge": settings.polish_ridge, "tangential": TANGENTIAL, "coverage": settings.coverage}


class Proportioned:
    """Levenberg–Marquardt on pose and proportions: exact where L-BFGS on the Chamfer distance creeps.

    Parameters
    ----------
    model : Model
    settings : FitSettings
        ``polish`` steps at most, with ``polish_ridge`` on ‖c‖².
    free : collection of {"pose", "translation", "scale"}
    """

    def __init__(self, model, settings, free):
        self._free, self._iterations = free, settings.polish
        self._steps = GaussNewton(model, **step_options(settings))
        self.turning = free_angles(model.rig)

    def to_the_end(self, problem, state, *, labels=None, prior=None):
        """The state, and E with the ridge's and the prior's part; options of ``GaussNewton.pose``."""
        known = {"labels": labels, "prior": prior}
        return self._steps.with_proportions(problem, state, free=self._free, iterations=self._iterations, **known)

    def as_they_are(self, problem, state):
        """The same steps with proportions held: what they leave unexplained, to compare."""
        return self._steps.pose(problem, state, free=self._free, iterations=self._iterations)
