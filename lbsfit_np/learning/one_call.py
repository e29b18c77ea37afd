"""One scan fitted by one call."""

from inspect import Parameter, signature

from .fitter import LBSFitter
from .parameters import check_names

__all__ = ["fit_scan"]


def fit_scan(rig, points, *, theta0=None, labels=None, point_weights=None, progress=None, random_state=0, **parameters):
    """Fit one scan in one call; what is trained for the rig is trained once, and kept in the user's cache folder.

    Parameters
    ----------
    rig : Rig
    points, theta0, labels, point_weights
        As in :meth:`LBSFitter.fit_scan`.
    progress : callable, optional
        Called with the share done, in [0, 1], while something is trained for the rig.
    random_state : int, default 0
    **parameters
        Parameters of :class:`LBSFitter`.

    Returns
    -------
    FitResult
    """
    own = ("theta0", "labels", "point_weights", "progress")
    check_names(parameters, [*own, *(name for name in LBSFitter._defaults() if name != "rig")])
    fitter = LBSFitter(rig, random_state=random_state, **parameters)
    return fitter._fit_scan(points, theta0, labels, point_weights, cache=True, progress=progress)


def _with_all_names(function):
    """The function's signature with the parameters of LBSFitter by name, for help() and editors."""
    own = [p for p in signature(function).parameters.values() if p.kind is not Parameter.VAR_KEYWORD]
    known = {"self", *(p.name for p in own)}
    more = [p for p in signature(LBSFitter.__init__).parameters.values() if p.name not in known]
    return signature(function).replace(parameters=[*own, *(p.replace(kind=Parameter.KEYWORD_ONLY) for p in more)])


fit_scan.__signature__ = _with_all_names(fit_scan)
