"""Where a scan goes on beyond the end of a rig, as a forearm does beyond the wrist of a hand."""

from dataclasses import dataclass

import numpy as np

from ..neighbors import PointIndex
from ..optimize.frame import root_turn
from ..optimize.surface import Surface
from ..rig.chains import bones
from ..rig.units import METRES, USUAL
from ..triangles import face_areas
from .scale import unit_scale

__all__ = ["End", "beyond", "cuts", "end_of", "goes_on", "scales_of"]

# A mesh ends at its root where no more than this share of its length lies on the root's other side, its length is about its size,
# and half of its end moves with the root: a body does not end at a root on the ground between its feet.
_ON_THE_OTHER_SIDE, _OF_ITS_SIZE, _WITH_THE_ROOT = 0.25, 0.75, 0.5
# These shares of the mesh's length, from one of a scan's ends, are tried for the body: short, as bent fingers make a hand, before
# long. A scan has to be longer than that by the first factor, and by less than the second, else it is in another unit.
_SHARES, _LONGER, _LONGEST = (0.7, 1.0), 1.1, 6.0
# A scan goes on for sure that is longer than the mesh by the first factor, unless there is a unit in which it is between the
# second one and that.
_LONG, _SHORTEST = 1.25, 0.35
# Which points that no surface explains go on from the end: so far from the mesh, in half sizes of the rig, and nearest to what
# lies within this share of the mesh's length from its end; and all points that are as far beyond its end in its direction.
_AWAY, _AT_THE_END = 0.1, 0.15
# Points further from the mesh than this, half sizes, are as far away as that.
_FAR = 1e3
# Points whose closest places are looked for at a time: each takes some 2 KB then.
_AT_ONCE = 50_000


@dataclass(frozen=True)
class End:
    """The end of a mesh at its root joint, in the rest pose.

    Attributes
    ----------
    direction : (3,) array
        From the mesh's middle to the root, where what the rig is of goes on.
    reach : float
        How far beyond the root the mesh goes, in rig units.
    length : float
        Of the mesh in that direction.
    """

    direction: np.ndarray
    reach: float
    length: float


def end_of(rig, vertices=None, joints=None):
    """The end of a rig's mesh at its root; None where it has none, as a body whose root is its pelvis.

    Parameters
    ----------
    rig : Rig
    vertices, joints : arrays like the rig's, optional
        Of another template; by default the rig's own.

    Returns
    -------
    End or None
    """
    vertices = (rig.vertices if vertices is None else vertices)[rig.welded_from]
    root, rig = (rig.joints if joints is None else joints)[rig.root], rig.welded
    area = face_areas(vertices, rig.faces)
    away = root - area @ vertices[rig.faces].mean(axis=1) / area.sum()
    if not np.linalg.norm(away) > 0:
        return None
    direction = away / np.linalg.norm(away)
    along = (vertices - root) @ direction
    end = End(direction, float(along.max()), float(np.ptp(along)))
    if end.reach > _ON_THE_OTHER_SIDE * end.length or end.length < _OF_ITS_SIZE * np.ptp(vertices, axis=0).max():
        return None
    with_root = np.asarray(rig.weights[:, bones(rig) == rig.root].sum(axis=1)).ravel()[_at(end, along)].mean()
    return end if with_root > _WITH_THE_ROOT else None


def _at(end, along):
    """(m,) bool: which vertices lie at the end, by how far they are from the root in its direction."""
    return along > end.reach - _AT_THE_END * end.length


def scales_of(rig, mode, unit=None):
    """Scan units in a rig unit that a scan may have whose extent says nothing; arguments as of ``reference_scale``."""
    if unit is not None:
        return (unit_scale(rig, unit),)
    if mode == "fixed" or rig.metres_per_unit is None:
        return (1.0,)
    return tuple(dict.fromkeys([1.0, *(rig.metres_per_unit / METRES[name] for name in USUAL)]))


def goes_on(points, end, scales):
    """Whether a scan is longer than the rig in each unit that it may be in.

    Parameters
    ----------
    points : (k, 3) array
        Of the scan, without floors and wild points.
    end : End
    scales : sequence of float
        Scan units in a rig unit that the scan may have.
    """
    _, _, length = _longest(points)
    sizes = [length / (scale * end.length) for scale in scales]
    return any(_LONG < size < _LONGEST for size in sizes) and not any(_SHORTEST < size <= _LONG for size in sizes)


def cuts(points, end, scales):
    """What of a long scan may be the body alone: all from one of its ends to some part of the rig's length.

    Parameters
    ----------
    points, end, scales
        As for :func:`goes_on`.

    Yields
    ------
    pair of callables (points) → (n,) bool array
        For the scan's one end and the other, which points these are; pairs from short to long. None where under each scale the
        scan is shorter or much longer.
    """
    axis, low, length = _longest(points)
    for share in _SHARES:
        for most in (share * scale * end.length for scale in scales):
            if not _LONGER < length / most < _LONGEST:
                continue
            yield (
                lambda x, highest=low + most: x @ axis < highest,
                lambda x, lowest=low + length - most: x @ axis > lowest,
            )


def _longest(points):
    """The direction in which a scan is longest, where it begins there, and its length."""
    axis = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    low, high = np.percentile(points @ axis, [0.5, 99.5])
    return axis, low, high - low


def beyond(points, rig, result):
    """Which points of a scan lie beyond the end of the rig, as a fit has it.

    Parameters
    ----------
    points : (n, 3) array
    rig : Rig
    result : FitResult
        Of this scan or of a part of it.

    Returns
    -------
    (n,) bool array
        Points further in the end's direction than the mesh, and points that it does not explain which are nearest to its end;
        none where the fitted template has no end, or the fit is not finite.
    """
    template = rig.vertices + result.offsets
    end = end_of(rig, template, result.rest_joints)
    if end is None or not np.isfinite(result.vertices).all():
        return np.zeros(len(points), dtype=bool)
    half = rig.size / 2 * result.scale
    direction, shown = root_turn(rig, result.pose) @ end.direction, rig.welded_from
    past = (points - result.joints[rig.root]) @ direction > end.reach * result.scale + _AWAY * half
    V = result.vertices[shown] / half
    low, high = V.min(axis=0) - _FAR, V.max(axis=0) + _FAR  # squared distances of wild points have to be finite
    surface, index = Surface(rig.welded.vertices / (rig.size / 2), rig.welded.faces), PointIndex(V)
    at_the_end = _at(end, (template[shown] - result.rest_joints[rig.root]) @ end.direction)
    others = np.flatnonzero(~past)
    for start in range(0, len(others), _AT_ONCE):
        some = others[start : start + _AT_ONCE]
        X = np.clip(points[some] / half, low, high)
        nearest = index.nearest(X)
        odd = np.flatnonzero(at_the_end[nearest] & (np.linalg.norm(X - V[nearest], axis=1) > _AWAY))
        on = surface.closest(X[odd], nearest[odd], V).points
        past[some[odd]] = np.linalg.norm(X[odd] - on, axis=1) > _AWAY
    return past
