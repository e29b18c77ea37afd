"""Hypotheses about the labels: what if the segmenter took one chain for another?

Where labels are wrong they are wrong by whole chains: one finger for its neighbour, a left limb for the right. Each
hypothesis is the probabilities with one chain left out, or with two chains of equal length exchanged; fits tell which holds.
"""

from itertools import combinations

import numpy as np

from ..rig.chains import chains

__all__ = ["label_hypotheses"]


def label_hypotheses(rig, proba, *, exchanges=4):
    """Alternatives to a labelling, itself first.

    Parameters
    ----------
    rig : Rig
    proba : (n, n_parts) array
    exchanges : int
        How many exchanges: the pairs of chains that the probabilities confuse most.

    Returns
    -------
    list of (n, n_parts) arrays
        A column of zeros says that a part is nowhere; the rest of its chain is then left to the other chains and the limits.
    """
    members = _parts_of_chains(rig, proba.shape[1])
    out = [proba]
    for parts in members:
        left_out = proba.copy()
        left_out[:, parts] = 0.0
        out.append(left_out)
    pairs = [(a, b) for a, b in combinations(range(len(members)), 2) if len(members[a]) == len(members[b])]
    mass = [proba[:, parts].sum(axis=1) for parts in members]
    confused = [-float(np.minimum(mass[a], mass[b]).sum()) for a, b in pairs]
    for k in np.argsort(confused, kind="stable")[:exchanges]:
        a, b = (members[c] for c in pairs[k])
        exchanged = proba.copy()
        exchanged[:, a], exchanged[:, b] = proba[:, b], proba[:, a]
        out.append(exchanged)
    return out


def _parts_of_chains(rig, n_parts):
    """The parts of each chain beside the root's, from its first joint to its last."""
    chain = chains(rig)
    order = [rig.root, *(j for level, _ in rig.levels for j in level)]
    members = []
    for c in range(1, chain.max() + 1):
        parts = []
        for j in order:
            p = int(rig.part_of_joint[j])
            if chain[j] == c and rig.moving[j] and p not in parts:
                parts.append(p)
        if parts and len(parts) < n_parts and rig.part_of_joint[rig.root] not in parts:
            members.append(parts)
    return members
