"""The study's measures, the paper's: Recon, Pose, Corre., and labels."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ...correspondence import surface_places
from ...errors import InputError, as_floats, brief
from ...optimize.surface import closest_on_mesh, faces_around
from ...seeds import generator
from ..measure import joint_error, recon, vertex_error

__all__ = ["POINTS", "Registrations", "Truth", "measured", "true_places"]

# Points of a scan that are carried to another one in a pair.
POINTS = 400
_PERCENTILES = (50, 90, 95)


@dataclass(frozen=True)
class Registrations:
    """What a row of the study found for some scans.

    Attributes
    ----------
    vertices : sequence of (m, 3) arrays
        In the scans' frame; NaN for a scan that could not be fitted.
    joints : sequence of (J, 3) arrays
        NaN there, too.
    """

    vertices: list
    joints: list

    def __post_init__(self):
        """Have lists of arrays, whatever came: lists, tensors, one array for all."""
        for name in ("vertices", "joints"):
            what, value = f"registrations.{name}", getattr(self, name)
            try:
                rows = list(value)
            except TypeError:
                raise InputError(what, brief(value), "a sequence of arrays, one for each scan") from None
            object.__setattr__(self, name, [as_floats(what, row, "an array of numbers for each scan") for row in rows])

    @property
    def fitted(self):
        """(N,) bool."""
        return np.array([bool(np.isfinite(V).all() and np.isfinite(J).all()) for V, J in zip(self.vertices, self.joints)])

    def check(self, rig, n):
        """Raise InputError unless there is one of each for each of n scans, of the rig's shape."""
        for what, arrays, shape in (("vertices", self.vertices, rig.vertices.shape), ("joints", self.joints, rig.joints.shape)):
            remedy = "Give arrays of NaN for a scan that could not be fitted."
            if len(arrays) != n:
                got = f"those of {len(arrays)} scans"
                raise InputError(f"registrations.{what}", got, f"those of {n}, one for each scan, in their order", remedy)
            odd = next((i for i, a in enumerate(arrays) if np.shape(a) != shape), None)
            if odd is not None:
                got = f"an array of shape {np.shape(arrays[odd])} for scan {odd}"
                raise InputError(f"registrations.{what}", got, f"shape {shape}, as {rig.name!r} has", remedy)


class Truth:
    """What is known of scans, whatever found their registrations: made once.

    Parameters
    ----------
    rig : Rig
    scans : sequence of SyntheticScan
        Without clutter and floor. No more than one is held at a time.
    pairs : int
        For correspondences.
    seed : int

    Raises
    ------
    InputError
        Scans of another rig, or with points that are none of its mesh's.
    """

    def __init__(self, rig, scans, pairs, seed):
        self.rig, self.scans, self.half = rig, scans, rig.size / 2
        self.recon, self.pose = np.empty(len(scans)), np.empty(len(scans))
        self.pairs = _pairs(len(scans), pairs, generator(seed, "study", "pairs"))
        self.points, self.places, paired = {}, {}, set(self.pairs.ravel().tolist())
        rng = generator(seed, "study", "points")
        for i, s in enumerate(scans):
            if s.vertices.shape != rig.vertices.shape:
                got = f"scan {i} of a rig with {len(s.vertices)} vertices"
                raise InputError("scans", got, f"scans of the rig {rig.name!r}, which has {len(rig.vertices)}")
            if (s.triangle < 0).any():
                got = f"scan {i} with {np.count_nonzero(s.triangle < 0)} points of clutter or a floor"
                raise InputError("scans", got, "scans of the mesh alone", "Make them with clutter = 0 and floor = 0.")
            self.recon[i] = recon(s.points, s.vertices) / self.half
            self.pose[i] = _regressed(rig, s) / self.half
            chosen = rng.choice(len(s.points), min(POINTS, len(s.points)), replace=False)
            if i in paired:
                self.points[i] = s.points[chosen]
                self.places[i] = _matrix(*true_places(rig, s, chosen), len(s.vertices))


def true_places(rig, scan, rows=slice(None)):
    """Where points of a synthetic scan are on the true mesh: the closest place at the triangle that each was taken from.

    Where limbs touch, the closest of all may be on another limb; noise along the surface counts for nothing.

    Parameters
    ----------
    rig : Rig
    scan : SyntheticScan
        Without clutter and floor.
    rows : index of its points

    Returns
    -------
    corners : (n, 3) int array
    barycentric : (n, 3) array
    """
    around, corners = faces_around(rig.faces, len(scan.vertices)), rig.faces[scan.triangle[rows]]
    beside = np.hstack([around[corners[:, k]] for k in range(3)])
    found = closest_on_mesh(scan.points[rows], np.arange(len(corners)), scan.vertices, rig.faces, beside)
    return found.corners, found.barycentric


def measured(truth, registrations):
    """The figures of a row.

    Parameters
    ----------
    truth : Truth
    registrations : Registrations
        Of its scans.

    Returns
    -------
    dict
        Lengths in half sizes of the rig. "recon" √L_c beside "recon_truth", that of the true mesh on the same scans; "pose"
        beside "pose_truth", that of the true template and angles with the joint regressor's joints; "vertices"; "corre" and
        "corre_snapped", each with "mean", "p50", "p90" and "p95" over all points of all pairs; "unfitted", the scans that all
        these leave out, and the only figure where it is all of them. "of_scans" has "recon", "pose" and "vertices" of each,
        None of these.

    Raises
    ------
    InputError
        What is no Registrations; those of more or fewer scans, or of another mesh.
    """
    if not isinstance(registrations, Registrations):
        expected = "Registrations(vertices, joints), a sequence of arrays each"
        raise InputError("registrations", f"a {type(registrations).__name__}", expected)
    registrations.check(truth.rig, len(truth.scans))
    rig, half, fitted = truth.rig, truth.half, np.flatnonzero(registrations.fitted)
    out = {"unfitted": len(truth.scans) - len(fitted)}
    if not len(fitted):
        return out
    errors = {"recon": [], "pose": [], "vertices": []}
    for i in fitted:
        s, V = truth.scans[i], registrations.vertices[i]
        errors["recon"].append(recon(s.points, V) / half)
        errors["pose"].append(joint_error(registrations.joints[i], s.joints, rig.moving) / half)
        errors["vertices"].append(vertex_error(V, s.vertices) / half)
    out |= {name: float(np.mean(values)) for name, values in errors.items()}
    of_scans = {name: dict(zip(fitted.tolist(), values)) for name, values in errors.items()}
    out["of_scans"] = {name: [of.get(i) for i in range(len(truth.scans))] for name, of in of_scans.items()}
    out["pose_median"] = float(np.median(errors["pose"]))
    out["recon_truth"], out["pose_truth"] = float(truth.recon[fitted].mean()), float(truth.pose[fitted].mean())
    out["corre"], out["corre_snapped"] = _correspondences(truth, registrations, set(fitted.tolist()))
    return out


def _regressed(rig, scan):
    """Joint error of the exact template in the exact pose with the regressor's joints: people's own are elsewhere."""
    offsets = scan.template - rig.vertices
    found = rig.pose_joints(scan.pose, scan.translation, scan.scale, offsets, joints=rig.joints + rig.regressor @ offsets)
    return joint_error(found, scan.joints, rig.moving)


def _correspondences(truth, registrations, fitted):
    """Errors before and after the snap to the nearest point of the other scan."""
    from scipy.spatial import cKDTree

    rig, half = truth.rig, truth.half
    pairs = [(a, b) for a, b in truth.pairs.tolist() if a in fitted and b in fitted]
    found = {a: _places(truth.points[a], registrations.vertices[a], rig) for a in sorted({a for a, _ in pairs})}
    plain, snapped, scan = {}, {}, None
    for a, b in sorted(pairs, key=lambda pair: pair[::-1]):  # all that go to one scan together
        if scan is None or scan[0] != b:
            s = truth.scans[b]
            scan, tree = (b, s.vertices, s.points), cKDTree(s.points)
        there, true = found[a] @ registrations.vertices[b], truth.places[a] @ scan[1]
        plain[a, b] = np.linalg.norm(there - true, axis=1) / half
        snapped[a, b] = np.linalg.norm(scan[2][tree.query(there)[1]] - true, axis=1) / half
    return tuple(_spread([errors[pair] for pair in pairs]) for errors in (plain, snapped))


def _places(points, vertices, rig):
    """(n, m) sparse matrix that takes vertices to the points' places on the surface."""
    return _matrix(*surface_places(points, vertices, rig.faces), len(vertices))


def _matrix(corners, barycentric, m):
    start = np.arange(0, corners.size + 1, 3)
    return sparse.csr_array((barycentric.ravel(), corners.ravel(), start), shape=(len(corners), m))


def _pairs(n, most, rng):
    """Ordered pairs of different scans: all of them, or as many as wanted."""
    count = n * (n - 1)
    rows = np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))
    a, b = np.divmod(rows, max(n - 1, 1))
    return np.column_stack([a, b + (b >= a)])


def _spread(errors):
    if not errors:
        return None
    errors = np.concatenate(errors)
    return {"mean": float(errors.mean())} | {f"p{q}": float(np.percentile(errors, q)) for q in _PERCENTILES}
