"""Scans in order of time: the poses before and after each, which it starts from, and what a smooth sequence draws it to."""

import numpy as np

from ..optimize.frame import nearest_root, turned_root

__all__ = ["drawn_to_neighbours", "poses_beside"]


def poses_beside(rig, collection, member):
    """Poses of the scans of its subject before and after a member's, in its frame; those set apart are passed over."""
    row = [m for m in collection.of(member.subject) if m is member or not m.apart]
    at = row.index(member)
    beside = row[max(at - 1, 0) : at] + row[at + 1 : at + 2]
    return [turned_root(rig, m.state.theta, member.frame.turn.T @ m.frame.turn) for m in beside]


def drawn_to_neighbours(rig, collection, weight):
    """Index of a member → (the mean of its neighbours' angles and its own, the weight of it), for those that have neighbours."""
    wanted = {}
    for m in collection.members:
        beside = [] if m.apart else poses_beside(rig, collection, m)
        if others := [nearest_root(theta, m.state.theta, rig.root) for theta in beside]:
            mean = np.mean([m.state.theta, *others], axis=0)  # without its own, neighbours would swap places
            wanted[m.index] = mean, weight
    return wanted
