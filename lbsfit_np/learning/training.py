"""How the synthetic scans for training are made: the parameter ``training`` of a fitter as settings, within what memory holds."""

from dataclasses import asdict

from ..errors import InputError
from ..synthesis import Synthesis, make_settings

__all__ = ["training_settings"]

# Beside Synthesis' own defaults: the reference scale is a guess, and people are not of the rig's size.
_DEFAULTS = {"scale": 0.05}


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
    try:
        return make_settings(given)
    except InputError as error:
        raise InputError("training", f"{error.argument}: {error.got}", error.expected, error.remedy) from None
