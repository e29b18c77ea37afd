"""Θ' of the loop: half as in pretraining, half the poses found so far with a little noise; on the templates found so far.

Scans synthesised from it close both gaps that pretraining leaves: the poses are those that people take, and the shapes are
those that were scanned.
"""

from dataclasses import dataclass

import numpy as np

from ..seeds import generator
from ..synthesis import synthesize_one, training_poses, with_random_proportions

__all__ = ["Mixture"]

# Half width of the uniform noise on inferred angles, radians.
_NOISE = 0.15
# Templates that were found are a little wrong, too: a share of the shape variation of pretraining stays.
_SHARE_OF_SHAPE = 0.3


@dataclass(frozen=True)
class Mixture:
    """i → the i-th synthetic scan of a round; the same in any process.

    Attributes
    ----------
    rig : Rig
        Welded.
    settings : Synthesis
    poses : (k, J, 3) array
        Θ inferred from scans, k ≥ 0; without any, all poses are as in pretraining.
    templates : tuple of (vertices (m, 3), joints (J, 3))
        U^d of the subjects; without any, the rig's own with random proportions.
    random_state : int
    round : int
        Each round has scans of its own.
    """

    rig: object
    settings: object
    poses: np.ndarray
    templates: tuple
    random_state: int
    round: int

    def pose(self, i):
        """The i-th scan's Θ', (J, 3), before the settings turn it."""
        return self._begun(i)[0]

    def scan(self, i):
        """The i-th SyntheticScan."""
        rig, (pose, rng) = self.rig, self._begun(i)
        if self.templates:
            template = self.templates[rng.integers(len(self.templates))]
            template = with_random_proportions(rig, _SHARE_OF_SHAPE * self.settings.shape, rng, template)
        else:
            template = with_random_proportions(rig, self.settings.shape, rng)
        return synthesize_one(rig, pose, template, self.settings, rng)

    def _begun(self, i):
        """A scan's pose, and what the rest of it is drawn with."""
        rng = generator(self.random_state, "mixture", self.round, i)
        rig = self.rig
        pose = training_poses(rig, 1, rng)[0]
        if len(self.poses) and rng.random() < 0.5:
            pose = self.poses[rng.integers(len(self.poses))].copy()
            pose[rig.root] = self.poses[rng.integers(len(self.poses)), rig.root]  # how one faces has nothing to do with the pose
            pose += _NOISE * rng.uniform(-1, 1, pose.shape) * rig.turning
            root = pose[rig.root].copy()
            pose = np.clip(pose, rig.lower, rig.upper)
            pose[rig.root] = root
        return pose, rng

    def __call__(self, i):
        """(points, labels, units of the scan in a rig unit), as training s wants it."""
        scan = self.scan(i)
        return scan.points, scan.labels, 1.0
