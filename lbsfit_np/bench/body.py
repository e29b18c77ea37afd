"""The body's benchmark set: mpfb2_cmu_mb, its other two shapes in poses from real motion."""

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.bvh import read_bvh
from ..io.rigs import load_rig
from ..seeds import generator
from ..synthesis import Synthesis, synthesize_one
from .retarget import bvh_thetas

__all__ = ["SHAPES", "body_rig", "body_scans"]

# Lengths in half sizes of the rig: noise of 2.5 mm and a hole of up to 15 cm on a body of 1.6 m.
SCAN = Synthesis(n_points=5000, noise=0.003, holes=1, hole_radius=0.18, density=0.5)
SHAPES = ("male_avg", "male_heavy")


def body_rig(data, shape="female_avg"):
    """One shape of the body with the benchmark's card."""
    card = Path(__file__).with_name("cards") / "mpfb2_cmu_mb.toml"
    return load_rig(Path(data) / "mpfb2_body" / "mpfb2_cmu_mb.npz", card=card, shape=shape)


def check_frames(motion, n, more=lambda n: 0):
    """Raise InputError unless a motion has frames, beside the first, for n scans and ``more`` (n) others."""
    frames = len(motion.rotations) - 1
    if n + more(n) > frames:
        most = max(k for k in range(frames + 1) if k + more(k) <= frames)
        raise InputError("n_scans", f"{n}, more than the motion has frames for", f"at most {most}")


def body_scans(rig, data, n=20, *, seed):
    """``n`` scans of the two other shapes with their truth, in poses drawn from the motion, facing the rig's way.

    Scan i is of shape ``SHAPES[i % 2]``; its pose is given in the frames of ``rig``, to go with its template. The clip starts
    with a calibration pose in frame 0, which is left out; the root's turn about the up axis is removed.
    """
    motion = read_bvh(Path(data) / "motion" / "01_01.bvh")
    subjects = [body_rig(data, shape) for shape in SHAPES]
    rng = generator(seed, "body frames")
    check_frames(motion, n)
    frames = np.sort(rng.choice(np.arange(1, len(motion.rotations)), n, replace=False))
    scans = []
    for i, frame in enumerate(frames):
        other = subjects[i % len(subjects)]
        pose = bvh_thetas(other, motion, [int(frame)], face_forward=True)[0]
        pose = np.einsum("jba,jbc,jc->ja", rig.frames, other.frames, pose)  # the same turns, about the rig's own axes
        scans.append(synthesize_one(rig, pose, (other.vertices, other.joints), SCAN, generator(seed, "body", i)))
    return scans
