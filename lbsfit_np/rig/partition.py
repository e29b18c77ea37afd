"""Partitions: which part of the body each joint and each vertex belongs to, at a chosen granularity."""

import numpy as np

from ..errors import InputError, brief, did_you_mean

__all__ = ["check_partition", "leading_joint", "partition_names", "parts_of_joints", "vertex_parts"]


def partition_names(partitions):
    """All granularities of a rig: "joints", and the names of its partitions."""
    return ["joints", *(name for name in partitions if name != "joints")]


def check_partition(argument, granularity, partitions):
    """Raise InputError about ``argument`` where a rig with these partitions has no such granularity."""
    known = partition_names(partitions)
    if not isinstance(granularity, str) or granularity not in known:
        remedy = did_you_mean(granularity, known) or "Name further partitions in the rig's card, in [parts.NAME]."
        raise InputError(argument, brief(granularity), f"one of {', '.join(known)}", remedy)


def parts_of_joints(rig):
    """Part names and the part of every joint, at the rig's granularity.

    A joint that the partition does not name belongs to the part of its nearest named ancestor; "joints" names every
    moving joint. Parts that lead no vertex (argmax_j w_ij never falls on their joints) do not exist.

    Returns
    -------
    names : tuple of str
    part_of_joint : (J,) int array
    """
    if rig.granularity == "joints" and "joints" not in rig.partitions:
        groups = {rig.joint_names[j]: (rig.joint_names[j],) for j in np.flatnonzero(rig.moving)}
    else:
        groups = rig.partitions[rig.granularity]
    row = {name: j for j, name in enumerate(rig.joint_names)}
    part = np.full(len(rig.parents), -1)
    for p, members in enumerate(groups.values()):
        part[[row[n] for n in members]] = p
    for level, up in rig.levels:
        part[level] = np.where(part[level] < 0, part[up], part[level])
    leads = np.unique(rig.leading_joint[rig.welded_from])  # of the surface, as no scan shows more; ``welded`` has the same
    homeless = [rig.joint_names[j] for j in leads if part[j] < 0]
    if homeless:
        raise InputError(
            f"partition {rig.granularity!r}",
            f"no part for the vertices of {', '.join(homeless[:5])}",
            "a part for every joint that leads vertices, its own or that of an ancestor",
            "Add the root joint to one of the parts.",
        )
    used = np.unique(part[leads])
    renumber = np.full(len(groups), -1)
    renumber[used] = np.arange(len(used))
    names = list(groups)
    part = np.where(part >= 0, renumber[np.maximum(part, 0)], -1)
    root_part = part[leads[0]]
    for level, up in rig.levels:  # joints of parts without vertices: hand them to the nearest ancestor's part
        part[level] = np.where(part[level] < 0, part[up], part[level])
    part = np.where(part < 0, root_part, part)
    part.flags.writeable = False
    return tuple(names[p] for p in used), part


def vertex_parts(rig):
    """(m,) int: the part of each vertex, from the joint with its largest weight."""
    labels = rig.part_of_joint[rig.leading_joint]
    labels.flags.writeable = False
    return labels


def leading_joint(w):
    """(m,) int: argmax_j w_ij of sparse weights (m, J), the lowest row on ties."""
    lead = np.empty(w.shape[0], dtype=int)
    order = np.lexsort((w.indices, -w.data, np.repeat(np.arange(w.shape[0]), np.diff(w.indptr))))
    lead[:] = w.indices[order[w.indptr[:-1]]]
    lead.flags.writeable = False
    return lead
