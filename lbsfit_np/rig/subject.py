"""Subjects: the rig on another person's template, with that person's joints, from shape parameters and bone proportions."""

from numbers import Real

import numpy as np

from ..errors import InputError
from ..seeds import generator
from .mirror import other_side
from .weld import welded_as_before

__all__ = ["MOST", "subject"]

MOST = 2.0  # largest amount

# Relative change of each bone's length and thickness, standard deviation at amount 1, cut at two deviations.
_BONES = 0.03  # beside shape parameters, which tell most about a person
_BONES_ALONE = 0.08  # for rigs without; as Synthesis.shape


def subject(rig, random_state, amount, parameters):
    """``Rig.subject``."""
    if isinstance(amount, bool) or not isinstance(amount, Real) or not 0 <= amount <= MOST:
        raise InputError("amount", repr(amount), f"a number from 0 to {MOST:g}")
    shapes = rig.shapes
    if shapes is None and parameters:
        raise InputError(
            next(iter(parameters)),
            "a shape parameter",
            f"none, as the rig {rig.name!r} has no shape parameters",
            "Leave it out: amount= says how far bone lengths and thicknesses vary.",
        )
    rng = generator(random_state, "subject")
    offsets, moved = np.zeros_like(rig.vertices), np.zeros_like(rig.joints)
    values = None
    if shapes is not None:
        given = shapes.values(parameters)
        values = np.where(np.isin(shapes.names, list(parameters)), given, _drawn(shapes, amount, rng))
        offsets, moved = shapes.offsets(values), shapes.moved_joints(values)
    if amount:
        family = rig.proportions
        c = (_BONES_ALONE if shapes is None else _BONES) * amount * _alike(rig, rng)
        offsets, moved = offsets + family.offsets(c), moved + family.moved_joints(c)
    elif not parameters:
        return rig
    changed = rig.with_template(rig.vertices + offsets, rig.joints + moved)
    return changed if shapes is None else welded_as_before(changed, shapes=shapes.at(values))


def _alike(rig, rng):
    """Standard deviates, cut at 2, for the coefficients of the proportions; those of left and right limbs are the same."""
    owner = rig.proportions.owner
    c = np.clip(rng.standard_normal(len(owner)), -2, 2)
    for j in np.unique(owner):
        other = other_side(rig.joint_names[j])
        k = rig.joint_names.index(other) if other in rig.joint_names else j
        if k < j and (owner == k).sum() == (owner == j).sum():
            c[owner == j] = c[owner == k]
    return c


def _drawn(shapes, amount, rng):
    """Values around the defaults: Gaussian, cut where the range ends by drawing anew."""
    values = np.array(shapes.default)
    for k, deviation in enumerate(amount * shapes.spread):
        values[k] = _truncated(shapes.default[k], deviation, shapes.lower[k], shapes.upper[k], rng)
    return values


def _truncated(middle, deviation, lower, upper, rng):
    """A Gaussian number within bounds, from one uniform number, so that a stream does not depend on the bounds."""
    from scipy.special import ndtr, ndtri

    u = rng.random()
    if deviation == 0:
        return middle
    low, high = ndtr((lower - middle) / deviation), ndtr((upper - middle) / deviation)
    return float(np.clip(middle + deviation * ndtri(low + u * (high - low)), lower, upper))
