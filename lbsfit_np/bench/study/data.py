"""The study's scans by the paper's recipe: people of various shapes in natural and uniform poses, training and test disjoint.

Where the paper takes poses of captured hands and of SURREAL, natural poses here are near the rig's own library, whose poses are
divided between training and test; where it takes bent bodies, poses here are uniform within the limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...errors import InputError, brief
from ...rig.chains import chains
from ...seeds import generator
from ...synthesis import Synthesis, natural_poses, synthesize_one, uniform_poses
from ..subjects import subject

__all__ = ["NATURAL", "RIGS", "SCAN", "SIZES", "Scans", "Size", "StudySet", "kind_of", "part_groups", "sized", "study_set"]

# Missing areas in every scan, uneven density, a little noise; the subject's own shape.
SCAN = Synthesis(shape=0.0, holes=2, least_holes=1)
# Every so-manieth pose of the library is for the test.
_TEST_EVERY = 4
# Poses whose angles are nowhere further apart than this, radians, are one by two names, and not for training.
_ALIKE = 0.3
# What the names of mirror images end with; they go with their originals.
_MIRROR = " (mirrored)"
# What joints are called that no hand has: bodies have thumbs, too.
_OF_LEGS = ("hip", "thigh", "leg", "knee", "foot", "pelvis")


@dataclass(frozen=True)
class Size:
    """How much of everything.

    Attributes
    ----------
    train, test : int
        Scans to learn from, and held out.
    train_subjects, test_subjects : int
        People in each.
    pairs : int
        Of test scans, for correspondences.
    training_scans : int
        Synthetic scans of pretraining, but see ``first_segmenter``, and of each round.
    rounds : int
        Of the loop, at most.
    seeds : int
        How many times all is done.
    """

    train: int
    test: int
    train_subjects: int
    test_subjects: int
    pairs: int
    training_scans: int
    rounds: int
    seeds: int


# Of hands; :func:`sized` knows those of bodies.
SIZES = {
    "small": Size(6, 6, 2, 2, 30, 200, 1, 1),
    "medium": Size(60, 30, 3, 5, 400, 16000, 4, 3),
    "paper": Size(1500, 300, 30, 10, 4000, 16000, 4, 3),
}
# Rigs of each size by default. Fits of the full body would take a third of the small size's time.
RIGS = {"small": ("hand", "body-coarse"), "medium": ("hand", "body"), "paper": ("hand", "body")}
# Of poses, the share that is near the library's; the paper has 20,000 from motion and 3,000 bent ones.
NATURAL = {"hand": 0.5, "body": 20 / 23, "other": 0.5}
# Bodies have more vertices and joints, and the paper has more of them.
_OF_BODIES = {"small": {"test": 4, "pairs": 12}, "medium": {}, "paper": {"train": 23000, "test": 2300}}


@dataclass(frozen=True, repr=False)
class StudySet:
    """What a study learns from and is tested on.

    Attributes
    ----------
    rig : Rig
        Its library of natural poses is that of training alone.
    train, test : Scans
    train_subjects, test_subjects : list of int
        Whose scan each is.
    """

    rig: object
    train: Sequence
    test: Sequence
    train_subjects: list
    test_subjects: list

    def __repr__(self):
        return f"<StudySet of {self.rig.name!r}: {len(self.train)} scans to learn from, {len(self.test)} to be tested on>"


@dataclass(frozen=True, repr=False)
class Scans(Sequence):
    """Scans as a sequence of SyntheticScan, each made anew when it is asked for: 23,000 bodies with their truth fill no memory.

    Attributes
    ----------
    rig : Rig
        Its library is what natural poses are near.
    templates : list of (vertices, joints)
        Of the people.
    subjects : list of int
        Whose scan each is.
    seed : int
    purpose : {"train", "test"}
    """

    rig: object
    templates: list
    subjects: list
    seed: int
    purpose: str

    def __len__(self):
        return len(self.subjects)

    def __repr__(self):
        return f"<Scans: {len(self)} of {len(self.templates)} people, {self.purpose}, seed {self.seed}>"

    def __getitem__(self, i):
        """Scan i, the same each time; a list of them for a slice."""
        if isinstance(i, slice):
            return [self[k] for k in range(len(self))[i]]
        i = range(len(self))[i]
        rng = generator(self.seed, "study", self.rig.name, self.purpose, i)
        natural = self.rig.poses and rng.random() < NATURAL[kind_of(self.rig)]
        pose = (natural_poses if natural else uniform_poses)(self.rig, 1, rng)[0]
        return synthesize_one(self.rig, pose, self.templates[self.subjects[i]], SCAN, rng)


def study_set(rig, size, seed, *, times=1):
    """Scans to learn from and to be tested on, with their truth.

    Parameters
    ----------
    rig : Rig
    size : Size or str
        The latter a name that :func:`sized` knows.
    seed : int
    times : int, default 1
        Multiplies the number of training scans, and of the people in them; the first ones stay the same.

    Returns
    -------
    StudySet

    Raises
    ------
    InputError
        A name that is not known.
    """
    size = size if isinstance(size, Size) else sized(rig, size)
    library = {purpose: replace(rig, poses=poses) for purpose, poses in _divided(rig).items()}
    out = {}
    for purpose, n, people in (
        ("train", size.train * times, size.train_subjects * times),
        ("test", size.test, size.test_subjects),
    ):
        templates = [subject(rig, generator(seed, "study", rig.name, purpose, "subject", k)) for k in range(people)]
        whose = [i % size.test_subjects for i in range(n)]
        if purpose == "train":  # the first scans are of the first people, whatever ``times``
            whose = [i % size.train_subjects + i // size.train * size.train_subjects for i in range(n)]
        out[purpose] = Scans(library[purpose], templates, whose, seed, purpose)
        out[f"{purpose}_subjects"] = whose
    return StudySet(rig=library["train"], **out)


def sized(rig, size):
    """The Size of a name for a rig.

    Raises
    ------
    InputError
        A name that is not known.
    """
    if not isinstance(size, str) or size not in SIZES:
        raise InputError("size", brief(size), f"one of {', '.join(SIZES)}")
    return replace(SIZES[size], **_OF_BODIES[size]) if kind_of(rig) == "body" else SIZES[size]


def part_groups(rig):
    """(n_parts,) int: the chain that each part belongs to (a finger, an arm), as the paper's parts are."""
    chain = chains(rig)
    groups = np.zeros(len(rig.parts), dtype=int)
    for j in np.flatnonzero(rig.moving)[::-1]:
        groups[rig.part_of_joint[j]] = chain[j]
    return groups


def _divided(rig):
    """The library's poses for training and for the test; a rig with fewer than two has none in either."""
    names = list(dict.fromkeys(name.removesuffix(_MIRROR) for name in rig.poses))
    test = set(names[_TEST_EVERY - 1 :: _TEST_EVERY]) if len(names) > 1 else set()
    test = test or set(names[-1:])
    if len(names) < 2:
        return {"train": {}, "test": {}}
    held_out = {n: pose for n, pose in rig.poses.items() if n.removesuffix(_MIRROR) in test}
    like = {n for n, pose in rig.poses.items() if any(np.abs(pose - other).max() < _ALIKE for other in held_out.values())}
    # A pose stays with its mirror image.
    like = {n.removesuffix(_MIRROR) for n in like}
    return {"train": {n: pose for n, pose in rig.poses.items() if n.removesuffix(_MIRROR) not in like}, "test": held_out}


def kind_of(rig):
    """What a rig is of, by its joints' names: "body", "hand" or "other"; the last is treated as hands are."""
    if {"pelvis", "left_knee"} <= set(rig.joint_names):
        return "body"
    names = [name.lower() for name in rig.joint_names]
    legs = any(part in name for name in names for part in _OF_LEGS)
    return "hand" if any("thumb" in name for name in names) and not legs else "other"
