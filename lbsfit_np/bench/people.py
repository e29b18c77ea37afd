"""Scans of people whom no rig of ours is of: an artist's hand or body, its shapes and others, in large poses.

A stand-in for registered scans of real people, with a truth that is exact: a rig with another mesh, other joints and other
proportions than the people's is fitted, and judged by where it carries places of one scan on another (``bench.pairs``).
"""

import csv
import json
from pathlib import Path

import numpy as np

from ..errors import InputError, brief, is_whole
from ..io.bvh import read_bvh
from ..io.write import atomic_path, make_folder, write_json, write_mesh_ply, write_points_ply
from ..rotations import matrix_from_rotvec, rotvec_from_matrix
from ..seeds import generator
from ..synthesis import Synthesis, synthesize_one
from .body import SHAPES, body_rig
from .hand import hand_rig, natural_poses
from .resume import checked_count
from .retarget import bvh_thetas

__all__ = ["OTHER_RIGS", "SCANS", "people_before", "people_files", "people_names", "people_scans", "write_people"]

# The bundled rig that is fitted to each kind of people.
OTHER_RIGS = {"hand": "hand-left", "body": "body"}
SCANS = "scans"
_REGISTRATIONS, _TRUTH, _RECORD = "registrations", "truth.csv", "people.json"
_WHOSE = {"kind": str, "people": int, "scans": int, "scan_seed": int}
_MOST = 10_000  # people, or scans of one: a record with more is none of ours
# Lengths in half sizes of the people's rig: noise of 0.4 mm on a hand of 21 cm, of 1.2 mm on a body of 1.6 m.
_SCANS = {
    "hand": Synthesis(n_points=4_000, noise=0.004, holes=1, hole_radius=0.12, density=0.5),
    "body": Synthesis(n_points=12_000, noise=0.0015, holes=2, hole_radius=0.12, density=0.5),
}
# Bodies beyond the three are mixtures with weights that add up to 1, each from minus a seventh on.
_BEYOND = 1 / 7
# Of each person's scans every second one has each joint turned at random besides, by so much of its limits at most.
_FURTHER = 0.3
# Hands differ from natural poses by so much at most, and stand so far from upright, radians.
_NATURAL, _TILT = 0.1, 0.3


def people_scans(kind, data, *, n_people=6, n_scans=5, seed):
    """Scans and what they are of.

    Parameters
    ----------
    kind : {"hand", "body"}
    data : str or Path
        Where the folders of real rigs, poses and motion are.
    n_people : int, default 6
        The first hand is the rig's own, others differ in lengths and thickness; the first three bodies are the rig's shapes,
        others mixtures of these.
    n_scans : int, default 5
        Of each person. Hands are near natural poses, bodies in frames of the motion; of every second one each joint
        is turned at random besides.
    seed : int

    Returns
    -------
    scans : list of (str, str, SyntheticScan)
        Name, subject, and the scan with its truth. Metres, y up; bodies face z, hands point up. Person k and their scan i are the
        same however many there are of both.
    faces : (F, 3) array
        Of the true meshes.

    Raises
    ------
    InputError
        Fewer than two people: nothing would be measured between them; no number of scans.
    """
    if not is_whole(n_people, 2):
        raise InputError("people", brief(n_people), "a whole number of at least two people")
    n_scans = checked_count("n_scans", n_scans)
    rig = hand_rig(data) if kind == "hand" else body_rig(data)
    person, pose = (_hands if kind == "hand" else _bodies)(rig, data)
    names, scans = iter(people_names(n_people, n_scans)), []
    for k in range(n_people):
        template = person(k, generator(seed, "people", kind, k))
        for i in range(n_scans):
            rng = generator(seed, "people", kind, k, i)
            theta = pose(rng)
            if i % 2:
                theta = _turned_further(rig, theta, rng)
            scans.append((next(names), f"person{k}", synthesize_one(rig, theta, template, _SCANS[kind], rng)))
    return scans, rig.faces


def _hands(rig, data):
    """Who and in which pose: functions of (k, rng) → vertices and joints, and of rng → Θ."""
    natural = natural_poses(rig, data)
    frame = rig.frames[rig.root]
    upwards = frame.T @ np.diag([-1.0, -1.0, 1.0]) @ frame  # the file's hand points down

    def person(k, rng):
        who = rig.subject(rng) if k else rig
        return who.vertices, who.joints

    def pose(rng):
        theta = natural[rng.integers(len(natural))] + _NATURAL * rng.uniform(-1, 1, rig.lower.shape) * rig.turning
        theta[rig.root] = rotvec_from_matrix(upwards @ matrix_from_rotvec(rng.uniform(-_TILT, _TILT, 3)))
        return theta

    return person, pose


def _bodies(rig, data):
    """The same for bodies."""
    shapes = [rig, *(body_rig(data, shape) for shape in SHAPES)]
    motion = read_bvh(Path(data) / "motion" / "01_01.bvh")

    def person(k, rng):
        n = len(shapes)
        mixture = np.eye(n)[k] if k < n else (1 + n * _BEYOND) * rng.dirichlet(np.ones(n)) - _BEYOND
        return tuple(sum(w * getattr(s, of) for w, s in zip(mixture, shapes)) for of in ("vertices", "joints"))

    def pose(rng):
        frame = int(rng.integers(1, len(motion.rotations)))  # frame 0 is a calibration pose
        return bvh_thetas(rig, motion, [frame], face_forward=True)[0]

    return person, pose


def _turned_further(rig, theta, rng):
    """A pose with each joint below the root turned at random, within its limits where it was within them."""
    further = theta + _FURTHER * rng.uniform(rig.lower, rig.upper)
    further = np.clip(further, np.minimum(rig.lower, theta), np.maximum(rig.upper, theta))
    further[rig.root] = theta[rig.root]
    return further


def people_before(folder):
    """What an earlier run has made scans of in a folder: "kind", "people", "scans" and "scan_seed"; None where there is none."""
    try:
        record = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
        whose = {key: record[key] for key in _WHOSE}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    ours = all(type(whose[key]) is kind for key, kind in _WHOSE.items()) and whose["kind"] in OTHER_RIGS
    return whose if ours and max(whose["people"], whose["scans"]) <= _MOST else None


def people_files(folder, whose):
    """The files that :func:`write_people` writes, of people as :func:`people_before` has them."""
    names = people_names(whose["people"], whose["scans"])
    ply = [folder / of / f"{name}.ply" for name in names for of in (SCANS, _REGISTRATIONS)]
    return [folder / _RECORD, *ply, folder / _TRUTH]


def people_names(n_people, n_scans):
    """Of scans, in their order."""
    return [f"person{k}-{i}" for k in range(n_people) for i in range(n_scans)]


def write_people(folder, whose, scans, faces):
    """Write scans, true meshes and the table that ``lbsfit bench pairs`` reads, and first of all whose they are.

    Parameters
    ----------
    folder : Path
    whose : dict
        As of :func:`people_before`.
    scans, faces : of :func:`people_scans`

    Returns
    -------
    Path
        The table.
    """
    write_json(folder / _RECORD, whose)
    for of in (SCANS, _REGISTRATIONS):
        make_folder(folder / of)
    for name, _, scan in scans:
        write_points_ply(folder / SCANS / f"{name}.ply", scan.points)
        write_mesh_ply(folder / _REGISTRATIONS / f"{name}.ply", scan.vertices, faces)
    with atomic_path(folder / _TRUTH) as path, open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(("scan", "subject", "registration"))
        table.writerows((name, subject, f"{_REGISTRATIONS}/{name}.ply") for name, subject, _ in scans)
    return folder / _TRUTH
