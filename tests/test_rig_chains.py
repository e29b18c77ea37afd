"""Chains of a hierarchy: where they begin, and whom locked joints go with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.chains import bones, chains


class Skeleton:
    """What chains look at in a rig, from parents (in any order) and the joints that move."""

    def __init__(self, parents, held=()):
        self.parents = np.array(parents)
        self.root = int(np.flatnonzero(self.parents < 0)[0])
        self.moving = ~np.isin(np.arange(len(parents)), held)
        depth = np.array([self._depth(j) for j in range(len(parents))])
        rows = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
        self.levels = tuple((r, self.parents[r]) for r in rows)

    def _depth(self, j):
        return 0 if self.parents[j] < 0 else 1 + self._depth(self.parents[j])


def _groups(rig):
    """The chains as sets of joints, the root's first."""
    chain = chains(rig)
    assert chain[rig.root] == 0
    assert set(chain.tolist()) == set(range(chain.max() + 1))
    return [set(np.flatnonzero(chain == c).tolist()) for c in range(chain.max() + 1)]


@pytest.mark.parametrize(
    "parents, held, expected",
    [
        ([-1], [], [{0}]),
        ([-1, 0, 1, 2], [], [{0}, {1, 2, 3}]),  # the root is a chain by itself
        ([-1, 0, 1, 0, 3], [], [{0}, {1, 2}, {3, 4}]),
        ([-1, 0, 1, 1, 2], [], [{0}, {1}, {2, 4}, {3}]),  # an arm that branches into two fingers
        ([-1, 0, 1, 2], [2], [{0}, {1, 2, 3}]),  # locked in the middle: the chain goes on
        ([-1, 0, 1, 1], [3], [{0}, {1, 2, 3}]),  # a locked branch is no branch
        ([-1, 0, 1, 0, 3], [1, 3], [{0, 1, 3}, {2}, {4}]),  # locked below the root: they are the root's
        ([-1, 0, 1, 1], [1], [{0, 1}, {2}, {3}]),
        ([-1, 0, 1, 2, 2], [2], [{0}, {1, 2}, {3}, {4}]),  # what branches at a locked joint branches
        ([-1, 0, 0], [1, 2], [{0, 1, 2}]),
        ([2, 0, -1, 1], [], [{2}, {0, 1, 3}]),  # children listed before their parents
    ],
)
def test_chains_begin_at_branches(parents, held, expected):
    first, *others = _groups(Skeleton(parents, held))
    assert first == expected[0]
    assert sorted(map(sorted, others)) == sorted(map(sorted, expected[1:]))


@pytest.mark.parametrize(
    "parents, held, expected",
    [
        ([-1, 0, 1, 2], [], [0, 1, 2, 3]),
        ([-1, 0, 1, 2], [2, 3], [0, 1, 1, 1]),
        ([-1, 0, 1, 2], [1, 2], [0, 0, 0, 3]),
        ([2, 0, -1, 1], [0, 1], [2, 2, 2, 3]),
    ],
)
def test_bones_are_what_joints_follow(parents, held, expected):
    assert bones(Skeleton(parents, held)).tolist() == expected


def test_chains_of_a_rig(tube_rig):
    assert chains(tube_rig).tolist() == [0, 1, 2, 3]
    held = build_rig(replace(make_tube_data(), locked=np.array([False, False, False, True])))
    assert chains(held).tolist() == [0, 1, 1, 1] and bones(held).tolist() == [0, 1, 2, 1]


def test_fingers_are_chains():
    rig = lbs.load_rig("hand")
    chain = chains(rig)
    row = {name: j for j, name in enumerate(rig.joint_names)}
    for finger in ("thumb", "index", "middle", "ring", "pinky"):
        assert len({int(chain[j]) for name, j in row.items() if name.startswith(finger) and rig.moving[j]}) == 1
    assert chain.max() == 5


def test_fingers_of_a_real_hand_are_chains(shared_rigs):
    card = Path(lbs.__file__).parent / "bench" / "cards" / "webxr_left.toml"
    rig = lbs.load_rig(shared_rigs / "webxr_hand" / "left.glb", card=card)
    chain = chains(rig)
    moving = [{rig.joint_names[j].split("-")[0] for j in np.flatnonzero((chain == c) & rig.moving)} for c in range(6)]
    assert chain.max() == 5 and moving[0] == {"wrist"}
    assert sorted(name for names in moving[1:] for name in names) == ["index", "middle", "pinky", "ring", "thumb"]
