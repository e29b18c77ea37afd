"""Builds the bundled body: rigs/body.npz, rigs/body-coarse.npz and the contact sheet docs/rigs/body.png.

Run from the checkout, with the extra "build" installed: python -m rigs.build_body. The same library versions give the same
files to the last bit. One half is meshed and mirrored, so that left and right are equal to the last bit as well.
"""

from pathlib import Path

import numpy as np
from scipy import sparse

from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.shapes import ShapeSpace

from .body_poses import pose_library
from .body_shape import BOX, surface
from .body_skeleton import HEIGHT, JOINT_NAMES, PARENTS, Figure, limits, skeleton, smpl_rest
from .checks import bending_volume, volume
from .heat import diffused
from .implicit import polygonise
from .remesh import remesh
from .rig_file import mesh_lines, write_rig
from .shape_directions import shape_direction
from .sheet import contact_sheet

__all__ = ["LEVELS", "body_data", "build", "draw", "mirror_of", "mirrored", "mirrored_joints", "report"]

FOLDER = Path(__file__).parent
SHEET = FOLDER.parent / "docs" / "rigs" / "body.png"

# Whom and what the contact sheet shows after the rest pose: people, and poses with the view.
PEOPLE = (
    {"figure": 1.0, "height": 1.63},
    {"figure": -1.0, "height": 1.80, "muscle": 1.0},
    {"height": 1.74, "weight": 92.0, "figure": -0.5},
    {"height": 1.90, "weight": 56.0, "legs": 0.04},
)
SHOWN = (
    ("standing", (-90, 0)), ("walking", (50, 10)), ("running", (60, 10)), ("contrapposto", "front"),
    ("arms overhead", "front"), ("hands on the hips", "front"), ("arms folded", (25, 5)), ("throwing", "front"),
    ("deep squat", (40, 10)), ("lunge", (60, 10)), ("sitting, leaning forward", (60, 15)),
    ("kneeling, sitting on the heels", (50, 10)),
    ("hands behind the head", "back"), ("yoga tree", "front"), ("bowing", "left"), ("kicking", (50, 10)),
)  # fmt: skip

_GRID, _BLOCKS = 0.004, 6  # of the marching cubes, metres
_ROUND = 1e-7  # vertices are stored to a tenth of a micrometre
_INFLUENCES, _LEAST, _STEPS = 8, 0.004, 1 << 14
_CROSSING = 0.04  # metres from the middle where the other side's limbs lead no skin any more

# Wanted edge lengths of the two levels, metres.
LEVELS = {
    "body": {
        "trunk": 0.0245, "limbs": 0.0210, "head": 0.0180, "face": 0.0068, "nose": 0.0054, "palm": 0.0105, "fingers": 0.0072,
        "tips": 0.0056, "ankle": 0.0155, "toes": 0.0096,
    },
    "body-coarse": {
        "trunk": 0.052, "limbs": 0.042, "head": 0.033, "face": 0.018, "nose": 0.0135, "palm": 0.0215, "fingers": 0.0096,
        "tips": 0.0078, "ankle": 0.030, "toes": 0.022,
    },
}  # fmt: skip

LIMB_PARTS = {
    "torso": ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
    "head": ("neck", "head"),
    **{f"{s} upper arm": (f"{s}_shoulder",) for s in ("left", "right")},
    **{f"{s} forearm": tuple(f"{s}_{j}" for j in ("elbow", "wrist", "hand")) for s in ("left", "right")},
    **{f"{s} thigh": (f"{s}_hip",) for s in ("left", "right")},
    **{f"{s} lower leg": tuple(f"{s}_{j}" for j in ("knee", "ankle", "foot")) for s in ("left", "right")},
}


def body_data(name="body"):
    """The body as a RigData, computed from nothing but this package's own numbers; ``name`` is "body" or "body-coarse"."""
    bones, skin = skeleton(), surface()
    half, faces = polygonise(skin, *BOX, _GRID, blocks=_BLOCKS)
    half, faces = remesh(skin, half, faces, _edge_length(bones, **LEVELS[name]), rounds=8)
    vertices, faces = mirrored(np.round(half / _ROUND) * _ROUND, faces)
    lower, upper = limits()
    weights = _weights(vertices, faces, bones)
    return RigData(
        name=name,
        vertices=vertices,
        faces=faces,
        weights=weights,
        joint_names=list(JOINT_NAMES),
        parents=PARENTS,
        joints=bones.joints,
        frames=bones.frames,
        lower=lower,
        upper=upper,
        metres_per_unit=1.0,
        up="+y",
        forward="+z",
        partitions={"limbs": LIMB_PARTS},
        parts="joints",
        poses=_poses(),
        smpl_rest=smpl_rest(),
        shapes=_shapes(vertices, faces, weights, bones.joints),
    )


def _poses():
    return dict(zip(*pose_library(list(JOINT_NAMES))))


def _edge_length(bones, *, trunk, limbs, head, face, nose, palm, fingers, tips, ankle, toes):
    """Finer where the skin curves more: fingers, face and toes."""
    shoulder, wrist = bones.left("shoulder"), bones.left("wrist")
    along = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    reach = (wrist - shoulder) @ along

    # Coordinate, and where a ramp starts and ends along it. All at once, as the remesher asks for many single points.
    ramps = {
        "arm": ("a", 0.0, 0.10), "leg": ("y", 0.80, 0.65), "wrist": ("a", reach - 0.20, reach + 0.02),
        "knuckles": ("a", reach + 0.04, reach + 0.08), "fingertips": ("a", reach + 0.11, reach + 0.15),
        "ankle": ("y", 0.14, 0.08), "toes": ("z", 0.04, 0.09), "head": ("y", 1.44, 1.52),
        "face forward": ("z", 0.035, 0.075), "chin": ("y", 1.495, 1.515), "forehead": ("y", 1.66, 1.635),
        "ear outward": ("x", 0.066, 0.074), "ear lobe": ("y", 1.54, 1.56), "ear top": ("y", 1.65, 1.63),
        "nose forward": ("z", 0.078, 0.090), "nose inward": ("x", 0.040, 0.025), "lip": ("y", 1.515, 1.525),
        "brow": ("y", 1.625, 1.61),
    }  # fmt: skip
    along_which = np.array(["xyza".index(c) for c, _, _ in ramps.values()])
    start, end = (np.array([r[k] for r in ramps.values()])[:, None] for k in (1, 2))

    def wanted(points):
        x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
        arm = ((np.stack([x, y, z], axis=1) - shoulder) @ along) * ((x > 0.15) & (y > 0.8))
        at = np.stack([x, y, z, arm])[along_which]
        on = dict(zip(ramps, _ramp(at, start, end)))
        out = np.full(len(points), trunk)
        out += (limbs - trunk) * np.maximum(on["arm"], on["leg"])
        out += (palm - limbs) * on["wrist"]
        out += (fingers - palm) * on["knuckles"]
        out += (tips - fingers) * on["fingertips"]
        out += (ankle - limbs) * on["ankle"]
        out += (toes - ankle) * on["toes"] * (y < 0.12)
        out += (head - trunk) * on["head"]
        facial = on["face forward"] * on["chin"] * on["forehead"]
        ear = on["ear outward"] * on["ear lobe"] * on["ear top"] * (x < 0.12)
        out += (face - head) * np.maximum(facial, ear)
        return out + (nose - face) * (on["nose forward"] * on["nose inward"] * on["lip"] * on["brow"])

    return wanted


def _ramp(x, start, end):
    """From 0 at ``start`` to 1 at ``end``."""
    return np.minimum(np.maximum((x - start) / (end - start), 0), 1)  # np.clip is slow for single points


# ---- symmetry ----


def mirrored(half, faces):
    """A whole from its half with x ≥ 0, in an order that does not depend on the remesher's history.

    Vertices from the soles up, each with its mirror image next to it; triangles by their lowest vertex.
    """
    rim = half[:, 0] == 0
    other = np.arange(len(half))
    other[~rim] = len(half) + np.arange(np.count_nonzero(~rim))
    vertices = np.concatenate([half, half[~rim] * [-1, 1, 1]])
    faces = np.concatenate([faces, other[faces][:, ::-1]])
    order = np.lexsort((vertices[:, 0], vertices[:, 2], np.abs(vertices[:, 0]), vertices[:, 1]))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    faces = rank[faces]
    first = faces.argmin(axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return vertices[order], faces[np.lexsort(faces.T[::-1])]


def mirror_of(vertices):
    """For each vertex the row of its mirror image, (m,)."""
    here = np.lexsort(vertices.T[::-1])
    there = np.lexsort((vertices * [-1, 1, 1]).T[::-1])
    out = np.empty(len(vertices), dtype=np.int64)
    out[there] = here
    return out


def mirrored_joints():
    """For each joint the row of the one on the other side, (J,)."""
    swap = {"left": "right", "right": "left"}
    return np.array([JOINT_NAMES.index("_".join(swap.get(w, w) for w in n.split("_"))) for n in JOINT_NAMES])


# ---- weights ----


def _weights(vertices, faces, bones):
    """Heat diffusion from the bones, made equal on both sides, in whole steps of 1/16384."""
    segments, owner, heat = _bones(bones)
    dense = diffused(vertices, faces, segments, owner, len(JOINT_NAMES), heat=heat)
    twin, sides = mirror_of(vertices), mirrored_joints()
    dense = np.maximum((dense + dense[twin][:, sides]) / 2, 0)
    left = vertices[:, 0] >= 0
    right_limbs = [k for k, name in enumerate(JOINT_NAMES) if name.startswith("right")]
    dense[:, right_limbs] *= _ramp(vertices[:, :1], _CROSSING, 0.0)  # only near the middle do limbs reach the other side
    rows = _whole_rows(dense[left], vertices[left, 0] == 0, sides)
    whole = np.empty(dense.shape, dtype=np.int64)
    whole[left] = rows
    right = np.flatnonzero(~left)
    whole[right] = whole[twin[right]][:, sides]
    return sparse.csr_array(whole / _STEPS)


def _whole_rows(w, middle, sides):
    """Whole steps that sum to 1 in each row; rows of the middle stay equal on both sides."""
    order = np.argsort(-w, axis=1, kind="stable")
    w = w.copy()
    np.put_along_axis(w, order[:, _INFLUENCES:], 0.0, axis=1)
    w[middle] = np.minimum(w[middle], w[middle][:, sides])
    w /= w.sum(axis=1, keepdims=True)
    w[w < _LEAST] = 0
    whole = np.rint(w / w.sum(axis=1, keepdims=True) * _STEPS).astype(np.int64)
    centre = sides == np.arange(len(sides))
    takes = np.where(middle, np.where(centre, whole, -1).argmax(axis=1), order[:, 0])
    whole[np.arange(len(w)), takes] += _STEPS - whole.sum(axis=1)
    return whole


# Heat of the bones: firmer ones bend more sharply and keep more volume, up to where the skin inside the bend cuts itself.
_FIRM = {
    "pelvis": 4.0, "spine1": 1.5, "spine2": 2.0, "spine3": 4.0, "neck": 1.5, "head": 2.0, "collar": 2.0, "hip": 6.0, "knee": 12.0,
    "ankle": 4.0, "foot": 4.0, "shoulder": 1.6, "elbow": 5.0, "wrist": 4.0, "hand": 4.0,
}  # fmt: skip

# Segments that lead the skin of the trunk: joint, start, end, of the left half. The trunk's skin is far from its spine, so ribs
# and hip bone lead it too, or arms and thighs would.
_SEGMENTS = (
    ("pelvis", (0, 0.915, -0.010), (0, 1.035, -0.026)),
    ("pelvis", (0.05, 0.965, 0.010), (0.112, 0.985, -0.005)),
    ("pelvis", (0.02, 0.90, 0.035), (0.05, 0.97, 0.055)),
    ("pelvis", (0.02, 0.96, -0.045), (0.07, 0.985, -0.040)),
    ("spine1", (0, 1.055, -0.028), (0, 1.155, -0.030)),
    ("spine1", (0.055, 1.060, 0.010), (0.075, 1.145, 0.010)),
    ("spine2", (0, 1.175, -0.031), (0, 1.270, -0.043)),
    ("spine2", (0.075, 1.175, 0.005), (0.085, 1.255, 0.000)),
    ("spine3", (0, 1.290, -0.045), (0, 1.445, -0.042)),
    ("spine3", (0.080, 1.275, 0.000), (0.085, 1.345, -0.015)),
    ("spine3", (0.03, 1.29, 0.045), (0.03, 1.370, 0.010)),
    ("spine3", (0.07, 1.29, -0.07), (0.06, 1.380, -0.06)),
    ("neck", (0, 1.470, -0.038), (0, 1.545, -0.014)),
    ("head", (0, 1.575, -0.004), (0, 1.650, 0.004)),
    ("head", (0, 1.560, 0.045), (0, 1.600, 0.055)),
    ("collar", (0.060, 1.398, -0.004), (0.140, 1.394, -0.018)),
)


def _bones(bones):
    """Segments, the joint that each follows, and how firmly."""
    segments, owner, heat = [], [], []

    def add(joint, start, end):
        for side in ("",) if joint in JOINT_NAMES else ("left", "right"):
            name = f"{side}_{joint}" if side else joint
            flips = ([-1, 1, 1],) if side == "right" else ([1, 1, 1],) if side else ([1, 1, 1], [-1, 1, 1])
            for flip in flips:
                segments.append((np.array(start) * flip, np.array(end) * flip))
                owner.append(JOINT_NAMES.index(name))
                heat.append(_FIRM[joint])

    for joint, start, end in _SEGMENTS:
        add(joint, start, end)
    at = bones.left
    hip, knee, ankle, ball = (at(n) for n in ("hip", "knee", "ankle", "foot"))
    shoulder, elbow, wrist, knuckles = (at(n) for n in ("shoulder", "elbow", "wrist", "hand"))
    toes = ball + (ball - ankle) * [0.5, 0, 0.5]
    add("hip", hip + 0.10 * (knee - hip), knee)
    add("knee", knee, ankle)
    add("ankle", ankle, ball)
    add("ankle", ankle, ankle + [0, -0.03, -0.035])
    add("foot", ball, toes)
    add("shoulder", shoulder + 0.06 * (elbow - shoulder), elbow)
    add("elbow", elbow, wrist)
    add("wrist", wrist, knuckles)
    w = (knuckles - wrist) / np.linalg.norm(knuckles - wrist)
    u = -bones.frames[bones.row("left_wrist")][:, 0]
    v = -bones.frames[bones.row("left_wrist")][:, 1]
    add("wrist", wrist, wrist + 0.055 * u - 0.030 * v + 0.085 * w)
    for across, far in ((0.026, 0.165), (0.0, 0.175), (-0.024, 0.165), (-0.045, 0.14)):
        add("hand", wrist + 0.8 * across * u + 0.088 * w, wrist + across * u - 0.03 * v + far * w)
    return np.array(segments), np.array(owner), np.array(heat)


# ---- shape parameters ----


# Name: unit, lower, upper, spread, and how far to both sides the surface is changed to find the direction. The template has the
# default of its own stature and weight, and 0 of the others. Sources in README.md.
PARAMETERS = {
    "height": ("m", 1.50, 1.95, 0.090, None),
    "weight": ("kg at 1.72 m", 50.0, 95.0, 11.0, 1.0),
    "figure": ("", -1.0, 1.0, 0.5, 0.5),
    "muscle": ("", -1.0, 1.0, 0.4, 0.5),
    "legs": ("", -0.07, 0.07, 0.025, 0.03),
    "shoulders": ("m", -0.04, 0.04, 0.015, 0.02),
}
_DENSITY = 985.0  # of a body with air in its lungs, kg/m³
_ERROR = 1e-5  # of a coordinate of a shape direction over four standard deviations, metres

# Bones that stretch their skin, and the joint whose skin each takes along.
_STRETCH = (
    ("pelvis", "spine1", "pelvis"), ("spine1", "spine2", "spine1"), ("spine2", "spine3", "spine2"), ("spine3", "neck", "spine3"),
    ("neck", "head", "neck"),
    *((f"left_{a}", f"left_{b}", f"left_{a}") for a, b in (
        ("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("collar", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist"),
        ("wrist", "hand"),
    )),
)  # fmt: skip


def _shapes(vertices, faces, weights, joints):
    """The shape parameters; one half is carried onto the changed surfaces and mirrored."""
    twin, sides = mirror_of(vertices), mirrored_joints()
    left = np.flatnonzero(vertices[:, 0] >= 0)
    row = np.full(len(vertices), -1)
    row[left] = np.arange(len(left))
    half = row[faces]
    half = half[(half >= 0).all(axis=1)]
    names = np.vectorize(JOINT_NAMES.index)(np.array(_STRETCH))
    directions, moved = [], []
    for name, (_, _, _, _, step) in PARAMETERS.items():
        if name == "height":
            directions.append(vertices / HEIGHT)
            moved.append(joints / HEIGHT)
            continue
        D, E = shape_direction(
            vertices[left], half, weights[left], names[:, :2], names[:, 2], _person(name), step=step, fixed_plane=True
        )
        whole = np.empty(vertices.shape)
        whole[left] = D
        right = np.setdiff1d(np.arange(len(vertices)), left)
        whole[right] = whole[twin[right]] * [-1, 1, 1]
        E = (E + E[sides] * [-1, 1, 1]) / 2
        if name == "weight":
            kilograms = _DENSITY * (volume(vertices + 0.1 * whole, faces) - volume(vertices - 0.1 * whole, faces)) / 0.2
            whole, E = whole / kilograms, E / kilograms
        directions.append(whole)
        moved.append(E)
    unit, lower, upper, spread, _ = zip(*PARAMETERS.values())
    default = {"height": HEIGHT, "weight": round(_DENSITY * volume(vertices, faces), 1)}
    space = ShapeSpace(
        names=tuple(PARAMETERS),
        units=unit,
        lower=np.array(lower),
        upper=np.array(upper),
        default=np.array([default.get(name, 0.0) for name in PARAMETERS]),
        spread=np.array(spread),
        vertices=np.array(directions),
        joints=np.array(moved),
    )
    return space.rounded(_ERROR)


def _person(name):
    field = {"weight": "fat"}.get(name, name)

    def change(amount):
        figure = Figure(**{field: amount})
        return surface(figure), skeleton(figure).joints

    return change


# ---- files ----


def build(name="body", folder=FOLDER):
    """Write one of the ``LEVELS`` to folder/name.npz; returns the rig."""
    return write_rig(body_data(name), folder / f"{name}.npz")


def report(rig):
    """What the build measured, in lines of text."""
    size = f"{1e3 * volume(rig.vertices, rig.faces):.1f} litres, {rig.vertices[:, 1].max() - rig.vertices[:, 1].min():.3f} m tall"
    lines = [
        *mesh_lines(rig, size),
        "volume kept at a joint, bent to 30, 60, 90, 120 degrees or its limit:",
    ]
    for row, name in enumerate(rig.joint_names):
        if row == 0 or name.startswith("right"):
            continue
        for axis, letter in enumerate("xyz"):
            for sign, end in ((1, rig.upper[row, axis]), (-1, rig.lower[row, axis])):
                if end == 0:
                    continue
                angles = sign * np.unique(np.minimum(np.radians([30, 60, 90, 120]), abs(end)))
                kept = bending_volume(rig, row, angles, axis)
                figures = (f"{k:7.2f} at {np.degrees(a):4.0f}" for a, k in zip(angles, kept))
                lines.append(f"  {name:14s} {letter}" + "".join(figures))
    return lines


def draw(rig, path=SHEET):
    """The contact sheet: rest with joints and limbs as parts, other people, and poses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    contact_sheet(
        path,
        rig,
        [(rig.poses[name], view) for name, view in SHOWN],
        subjects=[rig.subject(amount=0, **person) for person in PEOPLE],
        size=(310, 385),
    )


if __name__ == "__main__":
    for level in LEVELS:
        rig = build(level)
        print("\n".join([f"{level}.npz: {(FOLDER / f'{level}.npz').stat().st_size / 1e3:.0f} kB", *report(rig)]))
        if level == "body":
            draw(rig)
