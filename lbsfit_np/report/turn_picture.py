"""What the angles of a joint do to a rig, as a picture: the rest pose between the two limits of each axis."""

import numpy as np

from ..errors import InputError, brief, did_you_mean
from ..rig.chains import subtrees
from .fit_picture import axes_of
from .render import Mesh, montage, render

__all__ = ["turn_picture"]

# Of what moves with the joint, and of all else; in between by the weights.
_MOVES, _STAYS = np.array([213, 94, 0]), np.array([205, 205, 210])


def turn_picture(rig, joint, *, view="oblique", size=(320, 360)):
    """Draw a rig with one joint at its limits.

    Parameters
    ----------
    rig : Rig
    joint : str
        Its name.
    view : str or (azimuth, elevation), default "oblique"
        As for ``render``.
    size : (int, int)
        Of each of the pictures, pixels.

    Returns
    -------
    (h, w, 3) uint8 array
        A row of pictures for each axis of the joint, x, y and z: at its lower limit, at rest, at its upper limit; about its other
        axes it is at rest, or at the limit that is nearest to that. What moves with the joint is orange, as far as its weights
        say. An axis about which the joint does not turn has the rest pose alone.

    Raises
    ------
    InputError
        A name that no joint has; a joint that does not turn; a view that is none.
    """
    names = list(rig.joint_names)
    if not isinstance(joint, str) or joint not in names:
        remedy = did_you_mean(joint, names) or f"They are {', '.join(names)}."
        raise InputError("joint", brief(joint), f"one of the {len(names)} joints of {rig.name!r}", remedy)
    j = names.index(joint)
    lower, upper = rig.lower[j], rig.upper[j]
    if not rig.moving[j]:
        why = "merged" if rig.merged[j] else "locked" if rig.locked[j] else "without room between its limits"
        turning = [name for name, moves in zip(names, rig.moving) if moves]
        got, remedy = f"{joint!r}, which is {why} and never turns", "To have it turn, give it limits by name in a card"
        remedy += ", and take it out of [merge] and [lock] there." if rig.merged[j] or rig.locked[j] else "."
        if not (subtrees(rig.parents)[j] @ np.asarray(rig.weights.sum(axis=0)).ravel()):
            remedy = "It moves no vertex."
        raise InputError("joint", got, f"one that turns, such as {turning[-1]!r}", remedy)
    poses, rest = {}, np.zeros_like(rig.lower)
    for axis in np.flatnonzero(upper > lower):
        for side, limit in enumerate((lower, upper)):
            theta = rest.copy()
            theta[j] = np.clip(0.0, lower, upper)
            theta[j, axis] = limit[axis]
            poses[axis, side] = rig.without_loose(rig.pose(theta))
    home = rig.without_loose(rig.vertices)
    along = (rig.weights @ subtrees(rig.parents)[j])[:, None]
    colors = (_STAYS + along * (_MOVES - _STAYS)).astype(np.uint8)
    known = axes_of(rig) | {"frame": np.vstack([home, *poses.values()]), "view": view, "size": size}

    def drawn(vertices):
        return render(Mesh(vertices, rig.faces, colors), **known)

    at_rest = drawn(home)
    nothing = np.full_like(at_rest, 255)
    rows = [
        [drawn(poses[a, 0]) if (a, 0) in poses else nothing, at_rest, drawn(poses[a, 1]) if (a, 1) in poses else nothing]
        for a in range(3)
    ]
    return montage(rows)
