"""Anomalies of a rig that can be worked with, in words: what ``lbsfit rig show`` lists besides the joints."""

import numpy as np

from ..errors import counted, listed
from ..triangles import inside_out, pieces

__all__ = ["mesh_notes", "size_notes", "skin_notes", "unanswerable", "unknown_notes"]

# Joints of a skin are within it, or a little outside where it is hollow; beyond this share of the rig's size something is wrong.
_FAR = 0.25

# What the notes say that a card may answer; numbers and names are around it.
_OUTSIDE = "with weight outside the mesh, by up to"
_LONG = "m long if its unit is"
_UNKNOWN = "(can be set in a card's [rig])"
_IDLE = "without weight:"
_BLIND = "without a part, as no vertex belongs mostly to any:"
_EMPTY = ": no vertex belongs mostly to"


def unanswerable(notes):
    """Those of a rig's notes that no card answers: the others are to be made anew."""
    return [note for note in notes if not any(what in note for what in (_OUTSIDE, _LONG, _UNKNOWN, _IDLE, _BLIND, _EMPTY))]


def mesh_notes(rig):
    """Seam duplicates, open or non-manifold edges, several components, unused vertices, degenerate or turned faces."""
    notes = []
    m, n = len(rig.vertices), len(rig.welded.vertices)
    shown = m - np.count_nonzero(rig.loose)
    if n < shown:
        notes.append(f"{shown} vertices lie at {n} distinct points: duplicates at seams are welded for the geometry")
    faces = rig.welded.faces
    lost = len(rig.faces) - len(faces)
    if lost:
        notes.append(f"{lost} faces are degenerate (two corners at one point)")
    if not len(faces):
        return notes
    unused = m - len(np.unique(rig.faces))
    if unused:
        notes.append(f"{unused} vertices belong to no face")
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)[1]
    if (counts == 1).any():
        notes.append(f"the mesh is open: {np.count_nonzero(counts == 1)} boundary edges")
    if (counts > 2).any():
        notes.append(f"the mesh is not manifold: {np.count_nonzero(counts > 2)} edges with more than two faces")
    same_way = np.unique(directed, axis=0, return_counts=True)[1]
    if (same_way > 1).any():
        notes.append(f"neighbouring faces have opposite orientations at {np.count_nonzero(same_way > 1)} edges")
    elif (counts == 2).all():
        if inside_out(rig.welded.vertices, faces):
            notes.append("the mesh is inside out: its faces point inwards")
    separate = len(np.unique(pieces(n, faces)[np.unique(faces)]))
    if separate > 1:
        notes.append(f"the mesh consists of {separate} separate pieces")
    return notes


def size_notes(rig):
    """Joints far from the mesh, and a size in metres that no scanned thing has: most likely a unit is another one."""
    return _far_joints(rig) + _odd_size(rig)


def _far_joints(rig):
    shown = rig.vertices[~rig.loose]
    away = np.maximum(shown.min(axis=0) - rig.joints, rig.joints - shown.max(axis=0)).max(axis=1)
    carried = np.asarray(rig.weights[~rig.loose].sum(axis=0)).ravel()
    far = np.flatnonzero((away > _FAR * rig.size) & (carried > 0))
    if not len(far):
        return []
    what = f"{counted(len(far), 'joint')} {_OUTSIDE} {away[far].max() / rig.size:.2g} times its size"
    names = listed([rig.joint_names[j] for j in far])
    return [f"{what}: {names}; are joints in another unit than vertices, or is another of their axes up?"]


def _odd_size(rig):
    if rig.metres_per_unit is None:
        return []
    metres = rig.size * rig.metres_per_unit
    if 0.01 <= metres <= 20.0:
        return []
    unit = f"{rig.metres_per_unit:g} m"
    return [f"the rig is {metres:.3g} {_LONG} {unit}; if the unit is wrong, set it in a card ([rig] unit)"]


def unknown_notes(rig):
    """Unit and axes that neither file nor card has."""
    of_rig = (("unit", rig.metres_per_unit), ("up axis", rig.up), ("forward axis", rig.forward))
    unknown = [word for word, value in of_rig if value is None]
    return [f"unknown: {', '.join(unknown)} {_UNKNOWN}"] if unknown else []


def skin_notes(rig):
    """Joints without weight, joints and parts that lead no vertex."""
    notes = []
    carried = np.asarray(rig.weights[~rig.loose].sum(axis=0)).ravel()
    idle = [name for name, w, merged in zip(rig.joint_names, carried, rig.merged) if w == 0 and not merged]
    if idle:
        notes.append(f"{counted(len(idle), 'joint')} {_IDLE} {listed(idle)}")
    leads = np.unique(rig.leading_joint[~rig.loose])
    blind = [rig.joint_names[j] for j in np.flatnonzero(rig.moving) if j not in leads and carried[j] > 0]
    if blind:
        notes.append(f"{counted(len(blind), 'moving joint')} {_BLIND} {listed(blind)}")
    for name, groups in rig.partitions.items():
        there = rig.with_parts(name).parts
        missing = [part for part in groups if part not in there]
        if missing:
            notes.append(f"partition {name!r}{_EMPTY} {listed(missing)}; such parts are left out")
    return notes
