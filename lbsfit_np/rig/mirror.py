"""Mirror images: a left hand from a right one, with the same angles and limits.

With S the reflection, a joint's frame becomes F' = −S F, which is right-handed again. As −S ω is the axis of the mirrored turn
S exp([ω]×) S, the same angles θ then give the mirrored pose: M'(θ, S U) = S M(θ, U).
"""

import re
from dataclasses import replace

import numpy as np

from ..errors import InputError, brief
from .data import RigData
from .frames import AXES
from .weld import welded_as_before

__all__ = ["mirrored", "other_side"]

_SIDES = re.compile(
    r"left|right"  # anywhere in a name
    r"|(?<![^\W_])[lr](?![^\W_])",  # a letter by itself: hand_l, l_hand, hand.R
    re.IGNORECASE,
)
_OTHER = {"left": "right", "right": "left", "l": "r", "r": "l"}


def mirrored(rig, name=None, *, axis="x"):
    """The mirror image of a rig; of a Rig or of a RigData, and of the same kind.

    Parameters
    ----------
    rig : Rig or RigData
    name : str, optional
        Of the new rig; by default the old one with left and right exchanged, or with "-mirrored" where it says neither.
    axis : {"x", "y", "z"}, default "x"
        Across which the rig is mirrored: "x" changes the sign of all x.

    Returns
    -------
    Rig or RigData
        Joints keep their rows, limits, weights and angles; names of joints, parts and poses have left and right exchanged.
        Where that renames a joint, ``smpl_rest`` is left out: SMPL has its left joints before the right ones. Notes name
        joints as they are then.
    """
    if not isinstance(axis, str) or axis not in ("x", "y", "z"):
        raise InputError("axis", brief(axis), "'x', 'y' or 'z'")
    if name is not None and not (isinstance(name, str) and name):
        raise InputError("name", brief(name), "text, or None")
    if name is None:
        name = other_side(rig.name)
        if name == rig.name:
            name += "-mirrored"
    sign = np.ones(3)
    sign["xyz".index(axis)] = -1.0

    def flip(points):
        return np.asarray(points) * sign + 0.0  # not −0

    names = [other_side(joint) for joint in rig.joint_names]
    changed = replace if isinstance(rig, RigData) else welded_as_before
    return changed(
        rig,
        name=name,
        vertices=flip(rig.vertices),
        faces=np.asarray(rig.faces)[:, [0, 2, 1]],
        joint_names=type(rig.joint_names)(names),
        joints=flip(rig.joints),
        frames=0.0 - np.asarray(rig.frames) * sign[:, None],
        up=_direction(rig.up, axis),
        forward=_direction(rig.forward, axis),
        partitions={
            other_side(partition): {other_side(part): tuple(map(other_side, joints)) for part, joints in parts.items()}
            for partition, parts in rig.partitions.items()
        },
        poses={other_side(pose): theta for pose, theta in rig.poses.items()},
        shapes=None if rig.shapes is None else rig.shapes.mapped(flip),
        smpl_rest=None if rig.smpl_rest is None or names != list(rig.joint_names) else _smpl_rest(rig.smpl_rest, sign),
        notes=type(rig.notes)(_renamed(note, dict(zip(rig.joint_names, names, strict=True))) for note in rig.notes),
        **_granularity(rig),
        **({} if getattr(rig, "bones", None) is None else {"bones": flip(rig.bones)}),
    )


def other_side(name):
    """A name with left and right exchanged: left_hip ↔ right_hip, Hand.L ↔ Hand.R; others as they are."""

    def exchange(match):
        word = match[0]
        other = _OTHER[word.lower()]
        return other.upper() if word.isupper() else other.capitalize() if word[0].isupper() else other

    return _SIDES.sub(exchange, name)


def _renamed(note, names):
    """A note with joints of other names; the longest first, as one may be part of another."""
    old = "|".join(re.escape(name) for name in sorted(names, key=len, reverse=True))
    return re.sub(rf"(?<!\w)(?:{old})(?!\w)", lambda match: names[match[0]], note)


def _smpl_rest(rest, sign):
    """The left model's rest pose is the right one's, mirrored across x, wherever this rig was mirrored."""
    across_x = np.array([-1.0, 1.0, 1.0])
    return np.asarray(rest) * across_x[:, None] * sign + 0.0


def _direction(word, axis):
    if word is None or word not in AXES or word[1] != axis:
        return word
    return ("-" if word[0] == "+" else "+") + axis


def _granularity(rig):
    """The partition in use, which Rig and RigData call differently."""
    key = "granularity" if hasattr(rig, "granularity") else "parts"
    value = getattr(rig, key)
    return {key: value if value is None else other_side(value)}
