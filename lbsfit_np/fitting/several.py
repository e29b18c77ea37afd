"""What several fits say together: the unit of their scans, the axis along which these stand, whose scale is not the others'."""

import numpy as np

from ..errors import InputError, listed
from ..optimize.frame import root_turn
from ..rig.frames import AXES, up_axis
from ..rig.units import METRES, WORDS
from ..starts.scale import likely_unit, same_unit
from ..starts.turns import ALONG, axis_name

__all__ = ["odd_scales", "said_unit", "stands_along", "unit_of"]


def unit_of(rig, results):
    """Return the unit that the fits say, else the one that the scans seem to be in: in words, and its length in metres.

    It is None and 1 where the fits say nothing, and the rig and the scales do not tell it.
    """
    if said := said_unit(results):
        return WORDS[said], METRES[said]
    scale = float(np.median([r.scale for r in results]))
    if rig.metres_per_unit is not None:
        if same_unit(scale):
            return WORDS.get(likely_unit(1.0, rig), "the rig's unit"), rig.metres_per_unit
        if unit := likely_unit(scale, rig):
            return WORDS[unit], METRES[unit]
    return None, 1.0


def stands_along(rig, results, up=None):
    """Return the axis, such as "+z", along which the rig's up axis lies in the mean of the fits, if it is not ``up``; else None.

    It is also None where the rig's up axis is not known, as it then cannot be said which way the rig stands.
    """
    if rig.up is None:
        return None
    along = np.mean([root_turn(rig, r.pose) @ up_axis(rig) for r in results], axis=0)
    axis = axis_name(along)
    return axis if along @ AXES[axis] > ALONG and axis != (up or rig.up) else None


def said_unit(results, names=None):
    """Return the unit that fits say their scans are in; it holds for all if some say it, and is empty if none does.

    ``names``, in the error, are those of the fits; ``results[k]`` by default.

    Raises
    ------
    InputError
        The fits say several units.
    """
    names = [f"results[{k}]" for k in range(len(results))] if names is None else names
    said = {r.unit: name for r, name in zip(reversed(results), reversed(names), strict=True) if r.unit}  # the first of each
    if len(said) > 1:
        remedy = "Write one animation for each unit, or convert the scans and fit again."
        of_each = listed([f"{unit} ({said[unit]})" for unit in sorted(said)])
        raise InputError("results", f"fits of scans in {of_each}", "scans in one unit", remedy)
    return next(iter(said), "")


def odd_scales(results):
    """Return the rows of fits whose scales are further from the median than people differ in size; none if all say their unit."""
    if results[0].unit and len({r.unit for r in results}) == 1:
        return []
    scales = np.array([r.scale for r in results])
    middle = np.sort(scales)[(len(scales) - 1) // 2]
    return [k for k, scale in enumerate(scales) if not same_unit(scale / middle)]
