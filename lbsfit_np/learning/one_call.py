"""One scan fitted by one call."""

from .fitter import LBSFitter
from .parameters import check_names

__all__ = ["fit_scan"]


def fit_scan(rig, points, *, theta0=None, labels=None, point_weights=None, random_state=0, **parameters):
    """Fit one scan in one call; what is trained for the rig is trained once, and kept in the user's cache folder.

    Parameters
    ----------
    rig : Rig
    points, theta0, labels, point_weights
        As in :meth:`LBSFitter.fit_scan`.
    random_state : int, default 0
    **parameters
        Parameters of :class:`LBSFitter`.

    Returns
    -------
    FitResult
    """
    own = ("theta0", "labels", "point_weights")
    check_names(parameters, [*own, *(name for name in LBSFitter._get_param_names() if name != "rig")])
    return LBSFitter(rig, random_state=random_state, **parameters)._fit_scan(points, theta0, labels, point_weights, cache=True)
