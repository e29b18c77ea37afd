"""Scans in order of time: the poses before and after each, which it starts from, and what a smooth sequence draws it to."""

import numpy as np

from ..optimize.frame import nearest_root, turned_root

__all__ = ["drawn_to_neighbours", "poses_beside"]


def poses_beside(rig, members):
    """Of each member the poses of the scans of its subject before and after it, in its frame.

    Those set apart are passed over.

    Parameters
    ----------
    rig : Rig
    members : sequence of Member
        In order of time.

    Returns
    -------
    list of list of (J, 3) arrays
        Two, one or none of each.
    """
    before, after = _last_of_each_subject(members), _last_of_each_subject(members[::-1])[::-1]
    return [
        [turned_root(rig, b.state.theta, m.frame.turn.T @ b.frame.turn) for b in beside if b is not None]
        for m, *beside in zip(members, before, after, strict=True)
    ]


def drawn_to_neighbours(rig, members, weight):
    """Index of a member → (the mean of its neighbours' angles and its own, the weight of it), for those that have neighbours."""
    wanted = {}
    for m, beside in zip(members, poses_beside(rig, members), strict=True):
        if beside and not m.apart:
            others = [nearest_root(theta, m.state.theta, rig.root) for theta in beside]
            mean = np.mean([m.state.theta, *others], axis=0)  # without its own, neighbours would swap places
            wanted[m.index] = mean, weight
    return wanted


def _last_of_each_subject(members):
    """Of each member the nearest of its subject that stands before it and is not set apart; None where there is none."""
    last, out = {}, []
    for m in members:
        out.append(last.get(m.subject))
        if not m.apart:
            last[m.subject] = m
    return out
