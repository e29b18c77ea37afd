"""Scans of people whom no rig of ours is of: the three shapes of mpfb2_cmu_mb and mixtures of them, in large poses.

A stand-in for registered scans of real people, with a truth that is exact: a rig with another mesh, other joints and other
proportions than the people's is fitted, and judged by where it carries places of one scan on another (``bench.pairs``).
"""

import csv
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.bvh import read_bvh
from ..io.write import make_folder, write_mesh_ply, write_points_ply
from ..seeds import generator
from ..synthesis import Synthesis, synthesize_one
from .body import SHAPES, body_rig
from .retarget import bvh_thetas

__all__ = ["SCANS", "people_files", "people_scans", "write_people"]

SCANS = "scans"
_REGISTRATIONS, _TRUTH = "registrations", "truth.csv"
# Lengths in half sizes of the rig: noise of 1.2 mm and two holes of up to 10 cm on a body of 1.6 m.
_SCAN = Synthesis(n_points=12_000, noise=0.0015, holes=2, hole_radius=0.12, density=0.5)
# People beyond the three are mixtures with weights that add up to 1, each from minus a seventh on.
_BEYOND = 1 / 7
# Of each person's scans every second one is bent further, each angle by so much of its range at most.
_FURTHER = 0.3


def people_scans(data, *, n_people=6, n_scans=5, seed):
    """Scans and what they are of.

    Parameters
    ----------
    data : str or Path
        Where the folders mpfb2_body and motion are.
    n_people : int, default 6
        The first three are the rig's own shapes.
    n_scans : int, default 5
        Of each person, each in a frame of the motion of its own; every second one bent further, at random.
    seed : int

    Returns
    -------
    scans : list of (str, str, SyntheticScan)
        Name, subject, and the scan with its truth. Metres, y up, facing z. Person k and their scan i are the same however many
        there are of both.
    faces : (F, 3) array
        Of the true meshes.

    Raises
    ------
    InputError
        Fewer than two people: nothing would be measured between them.
    """
    if n_people < 2:
        raise InputError("people", str(n_people), "two people at least")
    rig = body_rig(data)
    shapes = [rig, *(body_rig(data, shape) for shape in SHAPES)]
    motion = read_bvh(Path(data) / "motion" / "01_01.bvh")
    scans = []
    for k in range(n_people):
        mixture = _mixture(k, len(shapes), generator(seed, "people", k))
        template = tuple(sum(w * getattr(s, of) for w, s in zip(mixture, shapes)) for of in ("vertices", "joints"))
        for i in range(n_scans):
            rng = generator(seed, "people", k, i)
            frame = int(rng.integers(1, len(motion.rotations)))  # frame 0 is a calibration pose
            pose = bvh_thetas(rig, motion, [frame], face_forward=True)[0]
            if i % 2:
                further = pose + _FURTHER * rng.uniform(rig.lower, rig.upper)
                further = np.clip(further, np.minimum(rig.lower, pose), np.maximum(rig.upper, pose))
                pose = np.where(np.arange(len(pose))[:, None] == rig.root, pose, further)
            scans.append((f"person{k}-{i}", f"person{k}", synthesize_one(rig, pose, template, _SCAN, rng)))
    return scans, rig.faces


def _mixture(k, n, rng):
    """(n,) weights of the shapes, of person k."""
    if k < n:
        return np.eye(n)[k]
    return (1 + n * _BEYOND) * rng.dirichlet(np.ones(n)) - _BEYOND


def people_files(folder, scans):
    """The files that :func:`write_people` writes."""
    ply = [folder / kind / f"{name}.ply" for name, _, _ in scans for kind in (SCANS, _REGISTRATIONS)]
    return [*ply, folder / _TRUTH]


def write_people(folder, scans, faces):
    """Write scans, true meshes and the table that ``lbsfit bench pairs`` reads.

    Parameters
    ----------
    folder : Path
    scans, faces : of :func:`people_scans`

    Returns
    -------
    Path
        The table.
    """
    for kind in (SCANS, _REGISTRATIONS):
        make_folder(folder / kind)
    for name, _, scan in scans:
        write_points_ply(folder / SCANS / f"{name}.ply", scan.points)
        write_mesh_ply(folder / _REGISTRATIONS / f"{name}.ply", scan.vertices, faces)
    with (folder / _TRUTH).open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(("scan", "subject", "registration"))
        table.writerows((name, subject, f"{_REGISTRATIONS}/{name}.ply") for name, subject, _ in scans)
    return folder / _TRUTH
