"""Checks that settings of fits and parameters of a fitter have in common: one clear error for each bad one."""

from numbers import Real

import numpy as np

from ..errors import InputError, brief, is_whole
from ..losses.checks import as_float, check_choice, check_flag, check_number
from ..losses.objective import as_weights
from ..rig.units import METRES
from .effort import EFFORTS

__all__ = ["SCALES", "check_settings", "check_suits", "check_whole"]

# What a fit may do about the scale.
SCALES = ("estimate", "fixed")
# σ of less has no square in double precision, and of more no inverse one.
_FINEST, _COARSEST = 1e-100, 1e100


def check_whole(name, value, least):
    """Raise InputError unless a value is a whole number of at least 0 or 1."""
    if not is_whole(value, least):
        raise InputError(name, brief(value), "a positive integer" if least else "an integer of at least 0")


def check_suits(rig, *, max_points, unit):
    """Raise InputError where a rig has more parts than fits look at points, or no unit known where the scans have one."""
    if max_points < len(rig.parts):
        raise InputError("max_points", str(max_points), f"at least {len(rig.parts)}, as many as the rig has parts")
    if unit is not None and rig.metres_per_unit is None:
        got = f"{unit!r} with the rig {rig.name!r}, whose own unit is not known"
        remedy = "Give the rig's unit in a card ([rig] unit), before learning if it is a model's, or leave this argument out."
        raise InputError("unit", got, "a rig whose unit is known", remedy)


def check_settings(settings):
    """The fields of ``FitSettings`` that a check makes plain, by name; InputError where one cannot be used."""
    check_choice("scale", settings.scale, SCALES)
    check_choice("unit", settings.unit, METRES, optional=True)
    check_choice("effort", settings.effort, EFFORTS)
    check_whole("max_points", settings.max_points, 1)
    for name in ("pose_iterations", "plain_iterations", "full_iterations", "polish"):
        check_whole(name, getattr(settings, name), 0)
    found = {name: check_number(name, getattr(settings, name)) for name in ("full_tolerance", "polish_ridge", "ridge", "doubt")}
    if found["doubt"] > 1:
        raise InputError("doubt", brief(settings.doubt), "a probability, at most 1")
    found |= {name: check_flag(name, getattr(settings, name)) for name in ("partial", "cropped", "registration")}
    return found | {"weights": as_weights(settings.weights), "refinements": _checked_refinements(settings.refinements)}


def _checked_refinements(value):
    sigmas = tuple(value) if isinstance(value, (tuple, list, np.ndarray)) else ()
    if not sigmas or not all(isinstance(s, Real) and _FINEST <= as_float(s) <= _COARSEST for s in sigmas):
        expected = f"one or more positive numbers, from {_FINEST:.0e} to {_COARSEST:.0e}"
        raise InputError("refinements", brief(value), expected, "Pass a tuple, such as (0.1, 0.05).")
    return tuple(map(as_float, sigmas))
