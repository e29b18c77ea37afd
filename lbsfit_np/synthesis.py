"""Synthetic scans of a rig: poses Θ', changed shapes, surface samples with the flaws of real scans, and the whole truth."""

from dataclasses import dataclass
from numbers import Integral, Real

import numpy as np

from .errors import InputError, as_array, brief, check_angles, check_array, did_you_mean, is_whole
from .rig.chains import chains
from .rig.frames import up_axis
from .rig.locked import locked
from .rotations import matrix_from_rotvec, nearest_rotvec, rotvec_from_matrix
from .seeds import generator
from .sensor import clutter, floor, sample_seen_surface, sample_surface, within_crop
from .skinning import skin

__all__ = [
    "Synthesis",
    "SyntheticScan",
    "make_settings",
    "natural_poses",
    "sample_surface",
    "synthesize",
    "synthesize_nth",
    "synthesize_one",
    "training_poses",
    "uniform_poses",
    "with_random_proportions",
]


@dataclass(frozen=True)
class Synthesis:
    """How scans are synthesised. Lengths are shares of the rig's half size (half the longest side of its rest box).

    Attributes
    ----------
    n_points : int
        Points per scan; fewer where holes took many.
    shape : float
        Standard deviation of the relative change of each bone's length and thickness (cut at two deviations).
    noise : float
        Standard deviation of the Gaussian noise on each coordinate.
    holes, least_holes : int
        Most and fewest missing regions, which are balls around surface points.
    hole_radius : float
        Largest radius of a hole.
    least_hole : float
        Smallest radius of a hole, as a share of the largest.
    density : float
        Unevenness: the natural logarithm of the ratio of the densities at one deviation. 0 is even.
    turn : float
        Largest angle, in radians, of a further random rotation of the whole about the root: about any axis, uniform in angle,
        and on top of what the root's limits allow.
    scale : float
        Largest relative change of scale, uniform: 0.1 is 0.9 to 1.1.
    clutter : float
        Further points that are not of the body, as a share of the scan's: uniform in the scan's bounding box enlarged by 30 %.
    floor : float
        Further points, as a share of the scan's, on a floor under the lowest vertex along the rig's up axis (y where the rig
        does not say). It is 1.5 times as wide as the scan's bounding box, and its points have the scan's noise.
    one_sided : bool
        Keep only what a distant depth camera sees from a random side of the body, up to 30 degrees from above or below.
    cropped : float
        Scans end at a plane across a random direction, as where a picture or a box ends. This is the largest share of the points
        that lie beyond it and are left out; the share is uniform.
    """

    n_points: int = 2500
    shape: float = 0.08
    noise: float = 0.004
    holes: int = 2
    least_holes: int = 0
    hole_radius: float = 0.2
    least_hole: float = 0.4
    density: float = 0.5
    turn: float = 0.0
    scale: float = 0.0
    clutter: float = 0.0
    floor: float = 0.0
    one_sided: bool = False
    cropped: float = 0.0


# What settings may be: kind, least, most. Where nothing else says most, it is far beyond all that makes sense, and well within
# what can be computed.
_MOST = 1000
# Settings in half sizes of the rig, which users may take to be in the rig's unit.
_LENGTHS = ("noise", "hole_radius")
_RANGES = {
    "n_points": (Integral, 1, 10**7),
    "holes": (Integral, 0, _MOST),
    "least_holes": (Integral, 0, _MOST),
    "least_hole": (Real, 0, 1),
    "noise": (Real, 0, 1),
    "shape": (Real, 0, 0.4),
    "density": (Real, 0, 10),
    "hole_radius": (Real, 0, 10),
    "scale": (Real, 0, 0.9),
    "cropped": (Real, 0, 0.9),
    "one_sided": (bool, False, True),
}


_POSES = ("uniform", "natural", "mixed")
_POSE_NOISE = 0.05  # rad


@dataclass(frozen=True, eq=False, repr=False)
class SyntheticScan:
    """A synthetic scan with its truth, in the rig's frame and unit (times ``scale``).

    Attributes
    ----------
    points : (n, 3) array
    labels : (n,) int array
        True part of each point, as an index into rig.parts; −1 for clutter and floor, which are not of the body.
    pose : (J, 3) array
        Θ'.
    translation : (3,) array
    scale : float
    template : (m, 3) array
        U^gt, the changed template in the rest pose.
    template_joints : (J, 3) array
        Rest joint positions of that template.
    vertices : (m, 3) array
        The posed changed template: the true positions of the rig's vertices.
    joints : (J, 3) array
        True posed joint positions.
    triangle : (n,) int array
        Row of rig.faces on which each point was drawn; −1 for clutter and floor.
    barycentric : (n, 3) array
        Place on that triangle, which noise does not change: ``vertices[rig.faces[triangle]]`` with these weights is the point
        without noise. On any other mesh with these faces they give the same place. 0 for clutter and floor.
    """

    points: np.ndarray
    labels: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    scale: float
    template: np.ndarray
    template_joints: np.ndarray
    vertices: np.ndarray
    joints: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray

    def __repr__(self):
        return f"<SyntheticScan: {len(self.points)} points, {len(self.joints)} joints, {len(self.vertices)} vertices>"


def synthesize(rig, n_scans=1, *, poses="uniform", templates=None, random_state=None, **settings):
    """Synthesise scans of a rig, each with its truth.

    Parameters
    ----------
    rig : Rig
    n_scans : int, default 1
    poses : {"uniform", "natural", "mixed"} or (k, J, 3) array, default "uniform"
        "uniform": within the limits (R_l, R_u). "natural": near the rig's library of natural poses (:func:`natural_poses`).
        "mixed": uniform and natural in turn. An array: poses to take in turn.
    templates : sequence of (vertices (m, 3), joints (J, 3)), optional
        Changed templates to take in turn; by default, random proportions (``shape``).
    random_state : int, Generator or None
        With an int, scan i is the same whatever ``n_scans`` is. Half of the training scans of a fitter with the same seed are
        in the poses of "uniform": judge a segmenter on scans of another seed.
    **settings
        Fields of :class:`Synthesis`.

    Returns
    -------
    list of SyntheticScan

    Raises
    ------
    InputError
        A setting that is not known or out of range; poses or templates that do not fit the rig; natural poses of a rig
        without a library.
    """
    _check_rig(rig)
    settings = make_settings(settings, ("n_scans", "poses", "templates", "random_state"))
    _check_count("n_scans", n_scans)
    if isinstance(poses, str):
        if poses not in _POSES:
            words = f"{', '.join(map(repr, _POSES))}, or an array (k, J, 3)"
            raise InputError("poses", repr(poses), words, did_you_mean(poses, _POSES))
        if poses != "uniform":
            _check_library(rig, poses)
    elif poses is not None:
        shape = as_array("poses", poses, f"shape (k, {len(rig.parents)}, 3) with k ≥ 1").shape
        if len(shape) != 3 or shape[1:] != rig.lower.shape or not shape[0]:
            raise InputError("poses", f"shape {shape}", f"shape (k, {len(rig.parents)}, 3) with k ≥ 1")
        poses = check_angles("poses", poses, shape)
    if templates is not None:
        if not isinstance(templates, (list, tuple)):
            remedy = "For a rig's subject, pass [(subject.vertices, subject.joints)]."
            raise InputError("templates", f"a {type(templates).__name__}", "a list of pairs (vertices, joints), or None", remedy)
        templates = [_checked_template(rig, k, template) for k, template in enumerate(templates)]
        if not templates:
            raise InputError("templates", "none", "one or more pairs (vertices, joints), or None for random proportions")
    return [synthesize_nth(rig, i, settings, poses=poses, templates=templates, random_state=random_state) for i in range(n_scans)]


def synthesize_nth(rig, i, settings, *, poses=None, templates=None, random_state=None):
    """Make scan ``i`` of :func:`synthesize`, to have one at a time; ``poses`` may be a function (rig, n, rng) → poses."""
    rng = generator(random_state, "synthesize", i)
    if poses is None or isinstance(poses, str):
        poses = natural_poses if poses == "natural" or (poses == "mixed" and i % 2) else uniform_poses
    if callable(poses):
        pose = poses(rig, 1, rng)[0]
    else:
        pose = poses[i % len(poses)]
    template = with_random_proportions(rig, settings.shape, rng) if templates is None else templates[i % len(templates)]
    return synthesize_one(rig, pose, template, settings, rng)


def make_settings(settings, others=()):
    """A Synthesis from keyword settings, with an error that lists the known ones, and what else there is to give."""
    if isinstance(settings, Synthesis):
        return settings
    known = Synthesis.__dataclass_fields__
    for name, value in settings.items():
        if name not in known:
            names = (*others, *known)
            raise InputError(name, "an unknown setting", f"one of {', '.join(names)}", did_you_mean(name, names))
        kind, least, most = _RANGES.get(name, (Real, 0, _MOST))
        if kind is bool:
            if not isinstance(value, (np.bool_, Integral)) or value not in (0, 1):
                raise InputError(name, repr(value), "True or False, or 1 or 0")
            settings = settings | {name: bool(value)}
        elif isinstance(value, bool) or not isinstance(value, kind) or not least <= value <= most:
            what = "an integer" if kind is Integral else "a number"
            remedy = "It is in half sizes of the rig." if name in _LENGTHS else None
            raise InputError(name, brief(value), f"{what} of at least {least} and at most {most}", remedy)
        else:  # equal settings have one text: keys of caches are made of it
            settings = settings | {name: int(value) if kind is Integral else float(value)}
    made = Synthesis(**settings)
    if made.least_holes > made.holes:
        raise InputError("least_holes", str(made.least_holes), f"at most {made.holes}, the value of holes", "Set holes, too.")
    return made


def uniform_poses(rig, n, rng):
    """Θ' ~ Unif(R_l, R_u); (n, J, 3)."""
    return rig.lower + rng.random((n, *rig.lower.shape)) * (rig.upper - rig.lower)


def natural_poses(rig, n, random_state=None):
    """Draw poses near those of the rig's library.

    Each is a pose of the library, in half of the cases blended with a second one: (1 − t) θ + t θ' with t ~ Unif(0, 1); of the
    root's θ', which whole turns do not change, the row nearest to θ. Gaussian noise of 0.05 rad is added about every axis that
    moves, and the angles are cut to the limits. The root is turned further by angles that are uniform within its limits.

    Parameters
    ----------
    rig : Rig
        With ``poses``.
    n : int
    random_state : int, Generator or None

    Returns
    -------
    (n, J, 3) array
        Radians.

    Raises
    ------
    InputError
        The rig has no library.
    """
    _check_rig(rig)
    if not rig.poses:
        got = f"the rig {rig.name!r}, which has no library of natural poses"
        raise InputError("rig", got, "a rig with one", "The bundled rigs have a library.")
    _check_count("n", n)
    rng = generator(random_state, "natural_poses")
    library = np.stack(list(rig.poses.values()))
    k, root = len(library), rig.root
    first = rng.integers(k, size=n)
    second = (first + rng.integers(1, k, size=n)) % k if k > 1 else first
    t = (rng.random(n) * (rng.random(n) < 0.5))[:, None, None]
    others = library[second]
    others[:, root] = nearest_rotvec(others[:, root], library[first, root])  # rows of one turn may be whole turns apart
    poses = (1 - t) * library[first] + t * others
    blended_root = poses[:, root].copy()
    poses += _POSE_NOISE * rng.standard_normal(poses.shape)
    poses = np.clip(poses, rig.lower, rig.upper)  # axes that do not move have no room for the noise
    turn = rig.lower[root] + rng.random((n, 3)) * (rig.upper[root] - rig.lower[root])
    # In the root's own frame: the library's turn first, then the further one.
    poses[:, root] = rotvec_from_matrix(matrix_from_rotvec(turn) @ matrix_from_rotvec(blended_root))
    return poses


def _check_rig(rig):
    from .rig.rig import Rig

    if not isinstance(rig, Rig):
        raise InputError("rig", brief(rig), "a Rig", "load_rig(name or path) gives one.")


def _check_count(argument, n):
    if not is_whole(n, 0):
        raise InputError(argument, repr(n), "an integer of at least 0")


def _check_library(rig, poses):
    if not rig.poses:
        raise InputError(
            "poses",
            f"{poses!r} for the rig {rig.name!r}, which has no library of natural poses",
            "'uniform', or an array (k, J, 3) of poses",
            "The bundled rigs have a library.",
        )


def training_poses(rig, n, rng, *, correlated=0.5):
    """Draw poses for training s: uniform in each angle, independent in some scans and correlated in others.

    Independent angles almost never make a fist or a flat hand. So in a share ``correlated`` of the poses, the angles of a
    chain, and chains among themselves, rise and fall together (a Gaussian copula with random strengths). Every angle keeps
    its own distribution Unif(R_l, R_u). The root's angles are always independent.

    Parameters
    ----------
    rig : Rig
    n : int
    rng : numpy.random.Generator
    correlated : float, default 0.5
        Probability that a pose is correlated.

    Returns
    -------
    (n, J, 3) array
        Radians.
    """
    from scipy.special import ndtr

    chain = chains(rig)
    poses = uniform_poses(rig, n, rng)
    for i in np.flatnonzero(rng.random(n) < correlated):
        within, among = rng.uniform(0.3, 0.95), rng.uniform(0.0, 0.95)
        shared = np.sqrt(among) * rng.standard_normal(3) + np.sqrt(1 - among) * rng.standard_normal((chain.max() + 1, 3))
        u = ndtr(np.sqrt(within) * shared[chain] + np.sqrt(1 - within) * rng.standard_normal(rig.lower.shape))
        root = poses[i, rig.root].copy()
        poses[i] = rig.lower + u * (rig.upper - rig.lower)
        poses[i, rig.root] = root  # the root turns the whole; it has no reason to go with the rest
    return poses


def synthesize_one(rig, pose, template, settings, rng):
    """One scan of a given pose and template (vertices, joints)."""
    U, J = template
    half = rig.size / 2
    pose = np.array(pose, dtype=float)
    if settings.turn:
        pose[rig.root] = _turned(rig, pose[rig.root], settings.turn, rng)
    scale = 1.0 + settings.scale * rng.uniform(-1, 1)
    changed = _with_rest(rig, U, J)
    posed = skin(changed, pose, scale=scale)
    vertices, joints = posed.vertices, posed.joints
    beyond = settings.cropped * rng.random() if settings.cropped else 0.0
    up, n, surface = up_axis(rig), _n_drawn(settings, beyond), rig.without_loose(vertices)
    if settings.one_sided:
        points, triangle, bary = sample_seen_surface(surface, rig.faces, n, rng, up=up, density=settings.density)
        if not len(points):
            raise InputError("one_sided", "True for a rig without a visible surface", "triangles that have an area")
    else:
        points, triangle, bary = sample_surface(surface, rig.faces, n, rng, density=settings.density)
    if settings.cropped:
        within = within_crop(points, beyond, rng)
        points, triangle, bary = points[within], triangle[within], bary[within]
    labels = rig.vertex_labels[rig.faces[triangle, bary.argmax(axis=1)]]
    keep = _outside_holes(points, half * scale, settings, rng)
    keep = keep[: settings.n_points]
    points, labels, triangle, bary = points[keep], labels[keep], triangle[keep], bary[keep]
    noise = settings.noise * half * scale
    points = points + noise * rng.standard_normal(points.shape)
    others = np.empty((0, 3))
    if settings.clutter:
        others = clutter(points, settings.clutter, rng)
    if settings.floor:
        others = np.concatenate([others, floor(points, settings.floor, (surface @ up).min(), up, noise, rng)])
    nowhere = np.full(len(others), -1)
    points, labels, triangle = (np.concatenate(a) for a in ([points, others], [labels, nowhere], [triangle, nowhere]))
    bary = np.concatenate([bary, np.zeros((len(others), 3))])
    return SyntheticScan(points, labels, pose, np.zeros(3), scale, U, J, vertices, joints, triangle, bary)


def _with_rest(rig, U, J):
    """The rig on another rest template, without the bookkeeping of a new Rig: what ``skin`` looks at, no more."""
    return _Rest(U, J, rig.frames, rig.weights, rig.levels, rig.root, rig.parents)


@dataclass(frozen=True)
class _Rest:
    vertices: np.ndarray
    joints: np.ndarray
    frames: np.ndarray
    weights: object
    levels: tuple
    root: int
    parents: np.ndarray


def _checked_template(rig, k, template):
    if not isinstance(template, (tuple, list)) or len(template) != 2:
        raise InputError(f"templates[{k}]", type(template).__name__, "a pair (vertices (m, 3), joints (J, 3))")
    shapes = rig.vertices.shape, rig.joints.shape
    checked = (check_array(f"templates[{k}][{i}]", a, shape) for i, (a, shape) in enumerate(zip(template, shapes)))
    return tuple(map(locked, checked))  # scans share them as their truth


def with_random_proportions(rig, amount, rng, template=None):
    """A template (vertices, joints), the rig's by default, with random bone lengths and thicknesses of deviation ``amount``."""
    U, J = (rig.vertices, rig.joints) if template is None else template
    if not amount:
        return U, J
    family = rig.proportions
    c = amount * np.clip(rng.standard_normal(family.basis.shape[2]), -2, 2)
    return U + family.offsets(c), J + family.moved_joints(c)


def _turned(rig, theta_root, most, rng):
    axis = rng.standard_normal(3)
    turn = matrix_from_rotvec(axis / np.linalg.norm(axis) * most * rng.random())
    frame = rig.frames[rig.root]
    return rotvec_from_matrix(frame.T @ turn @ frame @ matrix_from_rotvec(theta_root))


def _n_drawn(settings, beyond):
    """Points to draw, so that enough are left beside holes, and without the share beyond a crop."""
    n = settings.n_points if not settings.holes else int(1.4 * settings.n_points) + 16
    return n if not beyond else int(np.ceil(n / (1.0 - beyond)))


def _outside_holes(points, half, settings, rng):
    keep = np.ones(len(points), dtype=bool)
    for _ in range(rng.integers(settings.least_holes, settings.holes + 1) if settings.holes else 0):
        centre = points[rng.integers(len(points))]
        radius = settings.hole_radius * half * rng.uniform(settings.least_hole, 1.0)
        trial = keep & (np.sum((points - centre) ** 2, axis=1) > radius**2)
        if trial.sum() >= len(points) // 2:  # never so much that too little of the body is left
            keep = trial
    return np.flatnonzero(keep)
