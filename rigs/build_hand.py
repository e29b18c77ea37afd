"""Builds the bundled right hand: rigs/hand.npz, rigs/hand-coarse.npz and the contact sheet docs/rigs/hand.png.

Run from the checkout, with the extra "build" installed: python -m rigs.build_hand. The same library versions give the same
files to the last bit.
"""

from pathlib import Path

import numpy as np

from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.shapes import ShapeSpace

from .checks import bending_volume, volume
from .hand_poses import POSES, pose_angles, pose_library
from .hand_shape import BOX, FINGERS, JOINT_NAMES, PARAMETERS, PARENTS, Person, skeleton, surface
from .heat import heat_weights
from .implicit import polygonise
from .remesh import remesh
from .rig_file import mesh_lines, write_rig
from .shape_directions import shape_direction
from .sheet import contact_sheet

__all__ = ["LEVELS", "LIMITS", "build", "draw", "hand_data", "report"]

FOLDER = Path(__file__).parent
SHEET = Path(__file__).parents[1] / "docs" / "rigs" / "hand.png"

# What the contact sheet shows, row by row: pose and view.
SHOWN = (
    ("fist", "front"), ("thumbs-up", (-25, 10)), ("point", (30, 15)), ("ok", (-55, 10)),
    ("peace", "front"), ("pinch", (50, 15)), ("grasp cylinder", (-50, 15)), ("crossed fingers", "front"),
    ("relaxed", (40, 15)), ("four", "front"), ("shaka", (-20, 10)), ("fist", (205, 35)),
)  # fmt: skip

# Changes of the shape parameters that the contact sheet shows, in standard deviations.
PEOPLE = (
    {"length": -2.0, "breadth": -1.5},
    {"length": 2.0, "breadth": 1.5},
    {"breadth": 2.5, "thickness": 2.5, "fingers": -2.5, "thumb": -1.0},
    {"breadth": -2.5, "thickness": -2.0, "fingers": 2.5, "thumb": 1.5},
)

_GRID = 0.0030  # of the marching cubes, metres
# Wanted edge length at the fingertips and at the stump, metres, and rounds of remeshing. Fingers bear no coarser triangles.
LEVELS = {"hand": ((0.0051, 0.0074), 8), "hand-coarse": ((0.0072, 0.0180), 6)}
_ROUND = 1e-7  # vertices are stored to a tenth of a micrometre
_DEVIATIONS = 1.5  # shape directions are differences between people this many standard deviations to either side
_ROUNDED = 2e-5  # metres over four standard deviations

# Heat of the bones: firmer bones bend more sharply and keep more volume, up to where the skin inside the bend cuts itself.
_FIRM_PALM, _FIRM_PHALANX = 5.0, 3.0

# Degrees about the rest frames' axes: ((flexion, abduction, twist) lower, upper); see README.md for the sources.
LIMITS = {
    "wrist": ((-34.4, -34.4, -34.4), (34.4, 34.4, 34.4)),  # ±0.6 rad: how far sampled poses turn as a whole
    "index1": ((-30, -21, 0), (90, 15, 0)),
    "middle1": ((-30, -17, 0), (90, 14, 0)),
    "ring1": ((-30, -13, 0), (90, 17, 0)),
    "pinky1": ((-30, -16, 0), (90, 26, 0)),
    "*2": ((0, 0, 0), (100, 0, 0)),
    "*3": ((0, 0, 0), (90, 0, 0)),
    "thumb1": ((-15, -20, -40), (43, 40, 10)),
    "thumb2": ((-10, 0, 0), (55, 0, 0)),
    "thumb3": ((-15, 0, 0), (80, 0, 0)),
}

# MANO's right hand rests flat as this one does, with fingers along −x (here +y), the palm down, −y (here +z), and the thumb's
# side towards +z (here +x). The fingers' directions within the palm are taken to be the same.
MANO_REST = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def hand_data(name="hand"):
    """The hand as a RigData, computed from nothing but this package's own numbers; ``name`` is one of ``LEVELS``."""
    bones, skin = skeleton(), surface()
    edges, rounds = LEVELS[name]
    vertices, faces = polygonise(skin, *BOX, _GRID)
    vertices, faces = remesh(skin, vertices, faces, lambda points: _edge_length(points, *edges), rounds=rounds)
    vertices, faces = _ordered(np.round(vertices / _ROUND) * _ROUND, faces)
    segments, owner, heat = _bones(bones)
    lower, upper = _limits()
    return RigData(
        name=name,
        vertices=vertices,
        faces=faces,
        weights=heat_weights(vertices, faces, segments, owner, len(JOINT_NAMES), heat=heat),
        joint_names=list(JOINT_NAMES),
        parents=PARENTS,
        joints=bones.joints,
        frames=bones.frames,
        lower=lower,
        upper=upper,
        metres_per_unit=1.0,
        up="+y",
        forward="+z",
        partitions={"fingers": {"palm": ("wrist",), **{f: tuple(f"{f}{k}" for k in (1, 2, 3)) for f in FINGERS}}},
        parts="joints",
        poses=dict(zip(*pose_library(JOINT_NAMES))),
        shapes=_shapes(vertices, faces),
        smpl_rest=np.tile(MANO_REST, (len(JOINT_NAMES), 1, 1)),
    )


def _edge_length(points, tip, stump):
    """Finer towards the fingertips, where the skin curves more."""
    t = np.clip((np.linalg.norm(points - [0, 0.02, 0], axis=1) - 0.03) / 0.06, 0, 1)
    return stump + (tip - stump) * t


def _ordered(vertices, faces):
    """Vertices from the stump up, triangles by their lowest vertex: an order that does not depend on the remesher's history."""
    order = np.lexsort((vertices[:, 2], vertices[:, 0], vertices[:, 1]))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[faces]
    first = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return vertices[order], faces[np.lexsort(faces.T[::-1])]


def _bones(bones):
    """Segments that lead the skin, the joint that each follows, and how firmly."""
    segments, owner, heat = [], [], []

    def add(start, end, joint, firmness):
        segments.append((start, end))
        owner.append(joint)
        heat.append(firmness)

    add(np.array([0, -0.034, 0.0]), np.zeros(3), 0, _FIRM_PALM)
    for f, finger in enumerate(FINGERS):
        row = 3 * f + 1
        carpal = np.zeros(3) if finger == "thumb" else bones.carpal[finger]
        add(carpal, bones.joints[row], 0, _FIRM_PALM)
        ends = [*bones.joints[row : row + 3], bones.tips[finger]]
        for k in range(3):
            add(ends[k], ends[k + 1], row + k, _FIRM_PHALANX)
    return np.array(segments), np.array(owner), np.array(heat)


def _shapes(vertices, faces):
    """Shape parameters: the mesh carried onto the skins of people who differ in one number."""
    segments, _, heat = _bones(skeleton())
    B = len(segments)
    rows = np.arange(2 * B).reshape(B, 2)  # both ends of every segment, in the place of joints
    along = heat_weights(vertices, faces, segments, rows[:, 0], 2 * B, heat=heat)
    directions, joints = [], []
    for name, (_, _, default, spread, _) in PARAMETERS.items():

        def person(change, name=name, default=default):
            return skeleton(Person(**{name: default + change}))

        def change(amount, person=person):
            bones = person(amount)
            return surface(bones), _bones(bones)[0].reshape(-1, 3)

        step = _DEVIATIONS * spread
        directions.append(shape_direction(vertices, faces, along, rows, rows[:, 0], change, step=step)[0])
        joints.append((person(step).joints - person(-step).joints) / (2 * step))
    lower, upper, default, spread = np.array([row[:4] for row in PARAMETERS.values()]).T
    space = ShapeSpace(
        names=tuple(PARAMETERS),
        units=tuple(row[4] for row in PARAMETERS.values()),
        lower=lower,
        upper=upper,
        default=default,
        spread=spread,
        vertices=np.array(directions),
        joints=np.round(joints, 9) + 0.0,
    )
    return space.rounded(_ROUNDED)


def _limits():
    lower, upper = np.zeros((len(JOINT_NAMES), 3)), np.zeros((len(JOINT_NAMES), 3))
    for row, name in enumerate(JOINT_NAMES):
        low, high = LIMITS[name] if name in LIMITS else LIMITS["*" + name[-1]]
        lower[row], upper[row] = np.radians(low), np.radians(high)
    return lower, upper


def build(name="hand", folder=FOLDER):
    """Write one of the ``LEVELS`` to folder/name.npz; returns the rig."""
    return write_rig(hand_data(name), folder / f"{name}.npz")


def report(rig):
    """What the build measured, in lines of text."""
    size = f"{1e6 * volume(rig.vertices, rig.faces):.0f} cm³"
    lines = [
        *mesh_lines(rig, size),
        "volume kept at a joint, bent to 30, 60, 90 degrees or its limit:",
    ]
    for row, name in enumerate(rig.joint_names[1:], start=1):
        angles = np.minimum(np.radians([30, 60, 90]), rig.upper[row, 0])
        kept = bending_volume(rig, row, angles)
        lines.append(f"  {name:8s}" + "".join(f"{k:7.2f} at {np.degrees(a):2.0f}" for a, k in zip(angles, kept)))
    return lines


def draw(rig, path=SHEET):
    """The contact sheet: rest from front and back, joints and fingers as parts, four other people, and twelve poses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    s = rig.shapes
    people = [{n: s.default[s.names.index(n)] + k * s.spread[s.names.index(n)] for n, k in p.items()} for p in PEOPLE]
    poses = [(pose_angles(POSES[name], list(rig.joint_names)), view) for name, view in SHOWN]
    contact_sheet(path, rig, poses, subjects=[rig.subject(amount=0, **p) for p in people])


if __name__ == "__main__":
    for level in LEVELS:
        rig = build(level)
        print("\n".join([f"{level}.npz: {(FOLDER / f'{level}.npz').stat().st_size / 1e3:.0f} kB", *report(rig)]))
        if level == "hand":
            draw(rig)
