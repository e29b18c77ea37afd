"""What hangs on what in a hierarchy: chains, the unbranched runs of moving joints, such as fingers, arms, a tail; bones."""

import numpy as np

__all__ = ["bones", "chains", "loose_joints", "subtrees", "vertex_bones"]


def bones(rig):
    """(J,) int: the moving joint that each joint follows rigidly; itself where it moves."""
    bone = np.arange(len(rig.parents))
    for level, up in rig.levels:
        bone[level] = np.where(rig.moving[level], level, bone[up])
    return bone


def vertex_bones(rig):
    """(m,) int: of :func:`bones`, the one that each vertex follows most."""
    return bones(rig)[rig.leading_joint]


def chains(rig):
    """(J,) int: the chain of each joint, numbered from the root's, 0; locked joints are with what they follow."""
    bone = bones(rig)
    branches = np.zeros(len(bone), dtype=int)
    for j in np.flatnonzero(rig.moving):
        if j != rig.root:
            branches[bone[rig.parents[j]]] += 1
    chain = np.zeros(len(bone), dtype=int)
    for level, up in rig.levels:
        for c, p in zip(level, up, strict=True):
            above = bone[p]
            chain[c] = chain.max() + 1 if rig.moving[c] and (branches[above] > 1 or above == rig.root) else chain[p]
    return chain


def loose_joints(parents):
    """Rows of the joints without a parent, and of those that go round in circles or hang on these: one, of a tree."""
    at = np.arange(len(parents))
    for _ in range(len(parents)):
        at = np.where(at >= 0, parents[at], -1)
    return np.flatnonzero((parents < 0) | (at >= 0))


def subtrees(parents):
    """(J, J) of a tree: 1 at [j, k] where joint k is joint j or hangs below it, else 0."""
    below = np.eye(len(parents))
    for k in range(len(parents)):
        j = parents[k]
        while j >= 0:
            below[j, k] = 1.0
            j = parents[j]
    return below
