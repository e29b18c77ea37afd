"""How the synthetic scans for training are made: the parameter ``training`` of a fitter as settings, within what memory holds."""

from dataclasses import asdict

from ..errors import InputError, brief
from ..synthesis import Synthesis, make_settings

__all__ = ["training_settings"]

# Beside Synthesis' own defaults: the reference scale is a guess, and people are not of the rig's size.
_DEFAULTS = {"scale": 0.05}
# Far beyond all that makes sense, and well within what can be computed.
_MOST = {"n_points": 10**7, "holes": 1000, "least_holes": 1000}
_MOST_OF_OTHERS = 1000.0


def training_settings(training, **defaults):
    """The settings of training scans.

    Parameters
    ----------
    training : None, mapping of fields of Synthesis, or Synthesis
    **defaults
        Fields for what a mapping does not say.

    Returns
    -------
    Synthesis

    Raises
    ------
    InputError
        A field that is not known, or out of its range.
    """
    given = asdict(training) if isinstance(training, Synthesis) else _DEFAULTS | defaults | dict(training or {})
    made = make_settings(given)
    for name, value in asdict(made).items():
        most = _MOST.get(name, _MOST_OF_OTHERS)
        if value > most:
            raise InputError(name, brief(value), f"a number of at most {most:g}")
    return made
