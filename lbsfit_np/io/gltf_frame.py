"""Where a skin stands in its scene: the transform from bind space to the rig's frame.

A glTF skin draws a vertex p of the mesh at Σ_j w_j S_j p, with the skinning matrices S_j = W_j B_j: the joint node's world
matrix times its inverse bind matrix. The scene is y up, z forward, in metres (3.4); bind space is the mesh's own and may be
anything (z up, centimetres, quantised integers). The transform of the node that holds the mesh is no part of the rule.

If the nodes stand in the bind pose, all S_j are one matrix: that is the transform from bind space to the scene, and the rig
is brought there. If the nodes stand in some other pose the S_j differ, and the transform has to be told from the pose.
What a pose cannot change is how lengths scale, |det S_j|^(1/3), so the unit is known all the same. For the rest these are
asked in turn:

1. all joints that carry weight agree (within 0.2 % of the mesh's size): their S;
2. a node under which the skeleton or the mesh hangs, or the scene itself, if its world matrix is the S of a root joint of
   the skin or of joints with a tenth of the skin's weight: exporters write bind space as the space of such a node, and
   joints that are not posed give it away;
3. a matrix that the joints with half of the skin's weight share;
4. such a node without a witness, if it has the right scale and the posed mesh as a whole is turned against it by less than
   45° (and against other such nodes by 20° more): people are seldom stored lying down;
5. none: the rig stays in bind space, and up and forward stay unknown. Its unit is still known where the scale is.

Where a node's world matrix is the S that was found, it is taken instead, being free of rounding. A joint that is scaled to
nothing, be it along one axis only, has no place that the mesh could be brought to: its S is never the transform.
"""

from dataclasses import dataclass

import numpy as np

from ..medians import weighted_median
from .gltf_primitives import blended

__all__ = ["SCENE", "Placement", "blend", "flattening", "nearest_rotations", "place"]

# Of what may be bind space, what is no node.
SCENE = "the scene"

_AGREE = 2e-3  # of the mesh's size: above exporters' rounding (1e-6 to 1e-4), below any pose
_WITNESSES = 0.1  # share of the skin's weight
_MAJORITY = 0.5
_SCALE = 0.02
_TURN, _CLEARLY, _OTHER = np.radians([45.0, 20.0, 10.0])


@dataclass(frozen=True)
class Placement:
    """The rig's frame.

    Attributes
    ----------
    rig_T_bind : (4, 4) array
        From bind space to the rig's frame; the identity where the rig stays in bind space.
    rig_T_scene : (4, 4) array
        From the scene to the rig's frame: the identity where the rig is in the scene's frame, else the similarity that
        best undoes the placement of the posed mesh, so that animations can be read in the rig's frame.
    known : bool
        Whether the rig is in the scene's frame, with y up, z forward and metres.
    metres_per_unit : float or None
    notes : tuple of str
    """

    rig_T_bind: np.ndarray
    rig_T_scene: np.ndarray
    known: bool
    metres_per_unit: float | None
    notes: tuple


def place(vertices, weights, skinning, joint_labels, roots, candidates):
    """Choose the rig's frame; the module's docstring says how.

    Parameters
    ----------
    vertices : (m, 3) array
        In bind space.
    weights : (m, J) sparse array
    skinning : (J, 4, 4) array
        S_j with the nodes at rest.
    joint_labels : list of str
    roots : (r,) int array
        Rows of the skin's root joints.
    candidates : list of (str, (4, 4) array)
        Nodes whose space the bind space may be: their names, and their world matrices.

    Returns
    -------
    Placement
    """
    mass = np.asarray(weights.sum(axis=0), dtype=float).ravel()
    mass = mass / mass.sum() if mass.sum() > 0 else np.full(len(mass), 1.0 / len(mass))
    corners = _corners(vertices)
    determinants = np.linalg.det(skinning[:, :3, :3])
    flat = flattening(skinning)
    upright = np.where(flat, 0.0, mass)  # what is flat has no scale: its determinant is a rounding error
    scales = np.cbrt(np.abs(determinants))
    scale = weighted_median(scales[~flat], mass[~flat]) if upright.any() else 0.0
    mirrored = upright[determinants < 0].sum() > 0.5 * upright.sum()
    one_scale = scale > 0 and upright[np.abs(scales - scale) <= _SCALE * scale].sum() >= 0.9

    def agree(matrix):
        size = max(_spread(corners, matrix), np.finfo(float).tiny)
        return np.abs((skinning - matrix)[:, None] @ corners[None, :, :, None]).max(axis=(1, 2, 3)) <= _AGREE * size

    fitting = []
    for label, matrix in candidates:
        determinant = np.linalg.det(matrix[:3, :3])
        alike = abs(np.cbrt(abs(determinant)) - scale) <= _SCALE * scale and (determinant < 0) == mirrored
        if alike and scale > 0 and not flattening(matrix):
            fitting.append((label, matrix, agree(matrix)))
    shares = np.array([agree(S) @ upright for S in skinning])
    best = int(np.argmax(np.where(flat, -1.0, shares + 1e-9 * mass)))
    bearing = mass > 0
    all_agree = scale > 0 and bool(agree(skinning[best])[bearing].all())

    chosen, how, notes = None, None, []
    witnessed = [c for c in fitting if c[2][roots].any() or c[2] @ mass >= _WITNESSES]
    if all_agree:
        chosen = _mean(skinning, upright * agree(skinning[best]), skinning[best])
        same = [c for c in fitting if _agree(chosen, c[1], corners)]
        if same:
            chosen = min(same, key=lambda c: np.abs((c[1] - chosen) @ corners.T).max())[1]
    elif witnessed:
        label, chosen, _ = max(witnessed, key=lambda c: (c[2] @ mass, c[2].sum()))
        how = f"{_placed_like(label)}, as joints that are not posed confirm"
    elif scale > 0 and shares[best] >= _MAJORITY:
        chosen = _mean(skinning, upright * agree(skinning[best]), skinning[best])
        share = f"the {100 * shares[best]:.0f} % of the skin that moves with it"
        how = f"placed in the scene like {joint_labels[best]} and {share}"
    else:
        posed = blend(vertices, weights, skinning)
        turned = nearest_rotations((_covariance(vertices, posed) * (-1.0 if mirrored else 1.0))[None])[0]
        label, chosen = _least_turned(fitting if upright.sum() >= _MAJORITY else [], turned, mirrored)
        if chosen is not None:
            how = f"assumed to be {_placed_like(label)}, from which the posed mesh is turned the least"
    if chosen is not None:
        if not all_agree:
            unlike = _largest_turn(skinning, chosen, bearing, flat, joint_labels)
            notes.append(f"the nodes are not in the bind pose ({unlike}); the rest pose is the bind pose, {how}")
        notes += _placed(chosen)
        return Placement(chosen, np.eye(4), True, 1.0, tuple(notes))

    unit = float(scale) if one_scale else None
    notes.append(
        "the nodes are not in the bind pose, and nothing shows how bind space lies in the scene: the rig stays in bind space, "
        f"its up and forward axes are unknown and its unit is {f'{unit:.6g} m' if unit else 'unknown'}; set them in a card"
    )
    scene_T_rig = np.eye(4)
    scene_T_rig[:3, :3] = turned * (unit or 1.0) * (-1.0 if mirrored else 1.0)
    scene_T_rig[:3, 3] = posed.mean(axis=0) - scene_T_rig[:3, :3] @ vertices.mean(axis=0)
    return Placement(np.eye(4), np.linalg.inv(scene_T_rig), False, unit, tuple(notes))


def _agree(a, b, corners):
    """Whether two placements of a box differ by less than the tolerance."""
    return np.abs((a - b) @ corners.T).max() <= _AGREE * max(_spread(corners, b), np.finfo(float).tiny)


def blend(vertices, weights, skinning):
    """Σ_j w_j S_j p, by the vertices' own weight sums; (m, 3)."""
    matrices = blended(weights, skinning, np.eye(4))
    return np.einsum("iab,ib->ia", matrices[:, :, :3], vertices) + matrices[:, :, 3]


def flattening(matrices):
    """Whether affine maps, (..., 4, 4), take space to a plane, a line or a point; their inverses would be rounding errors."""
    stretch = np.linalg.svd(matrices[..., :3, :3], compute_uv=False)
    return stretch[..., 2] <= 1e-7 * stretch[..., 0]


def nearest_rotations(linear):
    """The rotations nearest to linear maps, (..., 3, 3); the polar factor, made proper."""
    u, _, vt = np.linalg.svd(linear)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u = u.copy()
    u[..., :, 2] *= sign[..., None]
    return u @ vt


def _placed_like(label):
    return "in the scene's own frame" if label == SCENE else f"placed in the scene like {label}"


def _least_turned(fitting, turned, mirrored):
    """The candidate that the mesh is turned least against, if it is near and no other is about as near; else (None, None)."""
    judged = []
    for label, matrix, _ in fitting:
        rotation = nearest_rotations(matrix[None, :3, :3] * (-1.0 if mirrored else 1.0))[0]
        judged.append((_angle(rotation.T @ turned), label, matrix, rotation))
    judged.sort(key=lambda c: c[0])
    if not judged or judged[0][0] > _TURN:
        return None, None
    turn, label, matrix, rotation = judged[0]
    others = [c[0] for c in judged[1:] if _angle(rotation.T @ c[3]) > _OTHER]
    if others and min(others) < turn + _CLEARLY:
        return None, None
    return label, matrix


def _placed(matrix):
    """What to tell about bringing the rig into the scene's frame, if that is more than a shift."""
    linear = matrix[:3, :3]
    stretch = np.linalg.svd(linear, compute_uv=False)
    determinant = np.linalg.det(linear)
    scale = np.cbrt(abs(determinant))
    angle = np.degrees(_angle(nearest_rotations(linear[None] * (1.0 if determinant > 0 else -1.0))[0]))
    notes = []
    if angle > 0.5 or abs(scale - 1) > 1e-3:
        notes.append(
            f"brought from bind space into the scene's frame (y up, metres): turned by {angle:.0f}°, scaled by {scale:.6g}"
        )
    if determinant < 0:
        notes.append("the scene mirrors the mesh: the rig is the mirror image, its faces reversed so that they point outwards")
    if stretch[0] > 1.01 * stretch[2]:
        notes.append(
            f"the scene stretches the mesh unevenly ({stretch[0] / stretch[2]:.3g} to 1): the file's rotations are approximate"
        )
    return notes


def _largest_turn(skinning, chosen, bearing, flat, labels):
    """What tells most that joints stand elsewhere than as bound, in words."""
    rotations = nearest_rotations(skinning[:, :3, :3] @ np.linalg.inv(chosen[:3, :3]))
    angles = np.where(bearing & ~flat, [_angle(R) for R in rotations], 0.0)
    j = int(np.argmax(angles))
    if angles[j] < np.radians(0.5) and (bearing & flat).any():
        return f"{labels[int(np.argmax(bearing & flat))]} is flattened"
    return f"{labels[j]} is turned by {np.degrees(angles[j]):.0f}°"


def _covariance(before, after):
    return (after - after.mean(axis=0)).T @ (before - before.mean(axis=0))


def _corners(vertices):
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    box = np.array([[(low, high)[b >> a & 1][a] for a in range(3)] for b in range(8)])
    return np.column_stack([box, np.ones(8)])


def _spread(corners, matrix):
    return np.ptp((corners @ matrix.T)[:, :3], axis=0).max()


def _mean(matrices, weights, typical):
    """The weighted mean; ``typical`` where it flattens space, as of a flat mesh's two sides."""
    mean = np.einsum("j,jab->ab", weights / weights.sum(), matrices)
    return typical if flattening(mean) else mean


def _angle(R):
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.arctan2(sine, np.trace(R) - 1.0))
