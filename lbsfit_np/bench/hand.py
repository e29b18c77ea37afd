"""The hand's benchmark set: webxr_hand with its natural poses and changed shapes, as docs/benchmarks.md defines it."""

from pathlib import Path

import numpy as np

from ..errors import FileError
from ..io.handpose import read_handpose
from ..io.rigs import load_rig
from ..seeds import generator
from ..synthesis import Synthesis, synthesize_one, uniform_poses
from .retarget import handpose_theta
from .subjects import subject

__all__ = ["hand_rig", "hand_scans", "natural_poses"]

# Lengths in half sizes; one hole, always of the same radius.
SCAN = Synthesis(n_points=2500, noise=0.004, holes=1, least_holes=1, hole_radius=0.18, least_hole=1.0, density=0.5)


def hand_rig(data):
    """The artist's hand with the benchmark's card: 16 joints as parts, welded."""
    return load_rig(Path(data) / "webxr_hand" / "left.glb", card=Path(__file__).with_name("cards") / "webxr_left.toml").welded


def natural_poses(rig, data):
    """(k, J, 3): the hand poses of the data folder, the root at rest."""
    files = sorted((Path(data) / "hand_poses").glob("*.handpose"))
    if not files:
        raise FileError(str(data), "a folder without hand_poses/*.handpose", "the folder that holds webxr_hand and hand_poses")
    poses = np.array([handpose_theta(rig, read_handpose(f)) for f in files])
    poses[:, rig.root] = 0.0
    return poses


def hand_scans(rig, data, n=40, *, seed):
    """``n`` scans with their truth: half uniform poses, half natural ones ± 0.1 rad, the root turned up to ±0.6 rad an axis.

    Changed shapes (lengths and thickness ±12 %), 2,500 points, noise 0.004, one hole of radius 0.18, uneven density; lengths
    in half sizes of the rig.
    """
    natural = natural_poses(rig, data)
    scans = []
    for i in range(n):
        rng = generator(seed, "hand", i)
        if i % 2:
            pose = natural[(i // 2) % len(natural)] + 0.1 * rng.uniform(-1, 1, rig.lower.shape) * rig.turning
        else:
            pose = uniform_poses(rig, 1, rng)[0]
        pose[rig.root] = rng.uniform(-0.6, 0.6, 3)
        scans.append(synthesize_one(rig, pose, subject(rig, rng), SCAN, rng))
    return scans
