"""The paper's local optimum: the Chamfer distance along the path of a finger from a wrong neighbour's place to its own.

The target has the finger beside one neighbour, the estimate has it in the place of the other. On the way the finger's vertices
leave points that they took for theirs, and the target's points still find the neighbour nearer: L_c rises before it falls. L_s
compares part with part and only falls.
"""

from dataclasses import dataclass

import numpy as np

from ...losses import chamfer, structured_chamfer
from ...rig.chains import chains
from ...seeds import generator
from ...sensor import sample_surface

__all__ = ["Limb", "Swing", "along_path", "limbs", "swings", "target_scan"]

# Poses along the path, the points sampled from the target, and how many angles of a neighbour are tried.
_STEPS, _N_POINTS, _ANGLES = 41, 2500, 61
# A rise of less than this is what sampling alone may make.
_LEAST_RISE = 1.02


@dataclass(frozen=True)
class Swing:
    """A chain that swings between two neighbours.

    Attributes
    ----------
    joint, away, toward : int
        First joints of the chain, of the neighbour in whose place it begins, and of the one beside which it belongs.
    start, target : (J, 3) arrays
        Poses; they differ in one angle.
    """

    joint: int
    away: int
    toward: int
    start: np.ndarray
    target: np.ndarray

    def poses(self, steps):
        """(steps, J, 3): evenly from start to target."""
        t = np.linspace(0.0, 1.0, steps)[:, None, None]
        return (1 - t) * self.start + t * self.target

    def degrees(self):
        """The angle that changes, at the start and at the target."""
        axis = np.flatnonzero((self.start != self.target)[self.joint])[0]
        return tuple(float(np.degrees(pose[self.joint, axis])) for pose in (self.start, self.target))


def along_path(rig, *, steps=_STEPS):
    """L_c and L_s between a target scan and the template along the path to the target.

    Of a rig's swings (:func:`swings`) the one whose Chamfer distance rises most.

    Parameters
    ----------
    rig : Rig
    steps : int, default 41

    Returns
    -------
    dict or None
        Plain data. "chain", "from", "to": names of first joints; "angle": in degrees at the start and the target; "t" from 0
        to 1, "chamfer" and "structured" (by true labels), in squares of half the rig's size; "rise": the largest L_c over the
        first one, "structured_rise": the same of L_s. None for a rig without such a path, such as a body, on which no limb
        lies between two others that it could be mistaken for.
    """
    found = [(swing, *_curves(rig, swing, steps)) for swing in swings(rig)]
    found = [f for f in found if _rise(f[1]) >= _LEAST_RISE]
    if not found:
        return None
    swing, plain, structured = max(found, key=lambda f: _rise(f[1]))
    return {
        "chain": rig.joint_names[swing.joint],
        "from": rig.joint_names[swing.away],
        "to": rig.joint_names[swing.toward],
        "angle": [round(a, 3) for a in swing.degrees()],
        "t": np.linspace(0.0, 1.0, steps).tolist(),
        "chamfer": plain,
        "structured": structured,
        "rise": _rise(plain),
        "structured_rise": _rise(structured),
    }


def swings(rig):
    """Both ways to swing the longest chain that lies between two others; none where no chain does.

    The chain swings about the axis of its first joint that moves its tip most from one neighbour to the other, between the
    limits. The neighbour beside which it belongs makes room, so that the tips lie side by side and not in each other. All other
    angles are 0.

    Parameters
    ----------
    rig : Rig

    Returns
    -------
    list of Swing
        None or two.
    """
    all_limbs = limbs(rig).values()
    between = []
    for limb in all_limbs:
        others = [o for o in all_limbs if o.parent == limb.parent and o is not limb]
        sides = [(o.base - limb.base, o) for o in others]
        for k, (to_a, a) in enumerate(sides):
            for to_b, b in sides[k + 1 :]:
                if to_a @ to_b < -0.5 * np.linalg.norm(to_a) * np.linalg.norm(to_b):
                    between.append((limb.length, -np.linalg.norm(to_a) - np.linalg.norm(to_b), limb, a, b))
    if not between:
        return []
    _, _, limb, a, b = max(between, key=lambda found: found[:2])
    made = [_swing(rig, limb, away=x, toward=y) for x, y in ((a, b), (b, a))]
    return [swing for swing in made if swing is not None]


def target_scan(rig, swing):
    """Points on the surface of the target and their true parts, as along_path takes them: (n, 3) and (n,) int."""
    V = rig.pose(swing.target)
    points, triangle, bary = sample_surface(V, rig.faces, _N_POINTS, generator(0, "study", "local optimum"))
    return points, rig.vertex_labels[rig.faces[triangle, bary.argmax(axis=1)]]


@dataclass(frozen=True, eq=False)
class Limb:
    """A chain of joints (``rig.chains``) with its vertices.

    Attributes
    ----------
    joint, parent : int
        Its first joint, and the one that this hangs on.
    base : (3,) array
        Where it begins.
    tip : int
        The vertex farthest from there.
    length, breadth : float
        How far that is; twice the mean distance of its vertices from the line to it. Rig units.
    """

    joint: int
    parent: int
    base: np.ndarray
    tip: int
    length: float
    breadth: float


def limbs(rig):
    """The chains that lead vertices, by number; not the root's. Dict of int to Limb."""
    chain, lead = chains(rig), rig.leading_joint
    out = {}
    for c in range(1, chain.max() + 1):
        joint = next((j for j in np.flatnonzero((chain == c) & rig.moving) if chain[rig.parents[j]] != c), None)
        rows = np.flatnonzero(chain[lead] == c)
        if joint is None or not len(rows):
            continue
        base = rig.joints[joint]
        away = np.linalg.norm(rig.vertices[rows] - base, axis=1)
        tip = rows[away.argmax()]
        along = (rig.vertices[tip] - base) / away.max()
        across = rig.vertices[rows] - base
        across = across - np.outer(across @ along, along)
        breadth = 2 * np.linalg.norm(across, axis=1).mean()
        out[c] = Limb(joint, int(rig.parents[joint]), base, int(tip), float(away.max()), float(breadth))
    return out


def _swing(rig, limb, *, away, toward):
    """From ``away``'s place to beside ``toward``; None where limits leave no room."""
    sideways = toward.base - away.base
    axis, sign = _axis(rig, limb, sideways)
    limits = (rig.lower[limb.joint, axis], rig.upper[limb.joint, axis])[:: int(sign)]
    other, other_sign = _axis(rig, toward, sideways)
    theirs = (rig.lower[toward.joint, other], rig.upper[toward.joint, other])[:: int(other_sign)]
    if limits[0] == limits[1]:
        return None
    target = np.zeros(rig.lower.shape)
    target[limb.joint, axis] = limits[1]
    # The least turn of the neighbour, from its rest pose on, that makes room.
    for angle in np.linspace(0.0, theirs[1], _ANGLES):
        target[toward.joint, other] = angle
        V = rig.pose(target)
        if np.linalg.norm(V[limb.tip] - V[toward.tip]) >= limb.breadth:
            break
    start = target.copy()
    start[limb.joint, axis] = limits[0]
    return Swing(limb.joint, away.joint, toward.joint, start, target)


def _axis(rig, limb, sideways):
    """The axis of a limb's first joint that moves its tip most to the side, and the sign of the angle that does."""
    lever = rig.vertices[limb.tip] - limb.base
    moved = np.cross(rig.frames[limb.joint].T, lever) @ sideways
    moved = np.where(rig.upper[limb.joint] > rig.lower[limb.joint], moved, 0.0)
    axis = int(np.abs(moved).argmax())
    return axis, 1.0 if moved[axis] >= 0 else -1.0


def _curves(rig, swing, steps):
    """L_c and L_s along the path, in squares of half the size."""
    X, labels = target_scan(rig, swing)
    unit = (rig.size / 2) ** 2
    posed = [rig.pose(pose) for pose in swing.poses(steps)]
    plain = [chamfer(X, V)[0] / unit for V in posed]
    return plain, [structured_chamfer(X, V, labels, rig.vertex_labels)[0] / unit for V in posed]


def _rise(values):
    return float(max(values) / values[0])
