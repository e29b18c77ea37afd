"""Other poses for limbs: where a fit is right but for an arm, a leg or two fingers, the rest of it says where to look.

A limb is a chain of joints with all that hangs on it. With the rest of the body held, every pose that a library has for the
limb is put in the place of its own, all at once, and is judged by what it would leave unexplained:

    cost = mean_x min(d(x, rest)², d(x, limb)², s²) + Σ_v a_v min(d(v, X)², s²),   v of the limb, a_v its share of the surface,

each distance d less the spacing of what stands for the surface, so that a fit without fault costs next to nothing.
Steps towards the surface cannot find such a pose, as it lies behind poses that are worse. Two limbs are tried together as well:
where each has taken the other's place, neither can go home alone.

A library of some thousand poses has none that is near for every arm. Looked at closer, a limb is tried in poses made of the best
ones as well: the upper joints of one, the lower ones of another, with random changes, over some generations.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..optimize.model import farthest_points
from ..rig.chains import chains, subtrees, vertex_bones
from ..rotations import matrix_from_rotvec
from ..scan import some_rows
from ..segmentation.descriptors import VoxelGrid

__all__ = ["LimbPoses"]

# Vertices and points that are looked at; s and the edge of a voxel in half sizes of the rig.
_LIMB_VERTICES, _ALL_VERTICES, _POINTS, _REACH, _VOXEL = 32, 900, 250, 0.2, 0.04
# Points that count for less than this share of the mean are not looked at.
_HARDLY = 0.01
# Poses that are tried for each limb, in blocks, to bound memory, a few of which fit a cache; of two limbs each with each of the
# best few.
_POSES, _BLOCK, _AT_ONCE, _BEST = 800, 200, 8, 40
# A pose is worth a try where it costs less than this much of the limb's own, and is unlike that and those tried already: mean
# distance of the limb's vertices. Two limbs that are exchanged have pulled what they hang on with them, so that even the right
# poses may seem worse; but two that cost less than the last number are where they should be. Each in the other's pose, they are
# worth a try where that costs no more.
_BETTER, _BETTER_PAIR, _UNLIKE, _FINE = 0.85, 3.0, 0.08, 1e-4
# Of a rig with very many limbs, such as a body with the bones of a face, the pairs that are nearest for their lengths, and the
# most promising proposals. Bodies and hands have no more.
_PAIRS, _PROPOSALS = 66, 64
# Closer: from so many poses, no two nearer than this, come so many others with changes of these sizes, radians.
_PARENTS, _SAME, _CHILDREN, _SIGMAS = 24, 0.03, 400, (0.4, 0.2, 0.1, 0.05)


@dataclass(frozen=True)
class _Limb:
    hangs: np.ndarray  # (J,) bool, the joints
    joints: np.ndarray  # (j,) int, their rows, those nearer to the root first
    skin: np.ndarray  # (m,) bool, the vertices
    rows: np.ndarray  # (v,) int, some of them
    area: float  # share of the surface that one of these stands for
    spacing: float  # no vertex is further from all of these
    angles: np.ndarray  # (N, j, 3) the poses to try
    ends: bool  # no other limb hangs on it


@dataclass(frozen=True)
class _Tried:
    """The poses of one limb, the first one its own, in one fit."""

    place: np.ndarray  # (1 + N, v, 3)
    away: np.ndarray  # (1 + N,) the vertices' part of the cost
    reach: np.ndarray  # (1 + N, x) d(x, limb)²
    angles: np.ndarray  # (1 + N, j, 3)


class LimbPoses:
    """Poses to try for the limbs of a model.

    Parameters
    ----------
    model : Model
    poses : (N, J, 3) array
        Radians; a limb is tried as it was in each of them, or, of very many, in evenly taken ones.
    """

    def __init__(self, model, poses):
        self.model = model
        rig = model.rig
        below = subtrees(rig.parents) > 0
        if len(poses) > _POSES:  # one of each so many, not every so-manieth: natural ones and others take turns
            within = np.random.default_rng(0).random(_POSES)
            poses = poses[((np.arange(_POSES) + within) * len(poses) / _POSES).astype(int)]
        chain = chains(rig)
        bone = vertex_bones(rig)
        self._limbs = []
        for c in range(1, chain.max() + 1):
            own = np.flatnonzero((chain == c) & rig.moving)
            hangs = below[own[below[np.ix_(own, own)].sum(axis=1).argmax()]]
            skin = hangs[bone]
            rows = np.flatnonzero(skin)
            if len(rows) > _LIMB_VERTICES:
                rows = rows[np.sort(farthest_points(rig.vertices[rows], _LIMB_VERTICES))]
            if len(rows):
                area = model.areas[skin].sum() / len(rows)
                spacing = _spacing(rig.vertices[skin], rig.vertices[rows])
                joints = np.flatnonzero(hangs)
                joints = joints[np.argsort(below[:, joints].sum(axis=0), kind="stable")]  # a file may have tips first
                angles, ends = np.ascontiguousarray(poses[:, joints]), bool((chain[hangs & rig.moving] == c).all())
                self._limbs.append(_Limb(hangs, joints, skin, rows, area, spacing, angles, ends))
        self._all = model.spread(_ALL_VERTICES)
        self._spacing = _spacing(rig.vertices, rig.vertices[self._all])

    def proposals(self, problem, state, n, *, closer=False):
        """Poses in which one or two limbs are others.

        Parameters
        ----------
        problem : Problem
        state : State
        n : int
            How many a limb, or a pair of limbs, at most.
        closer : bool, default False
            Whether single limbs are tried in poses between and near the best ones of the library as well.

        Returns
        -------
        list of (J, 3) array
            The most promising first, 64 at most; empty where no limb would be better off.
        """
        posed = self.model.deformed(state)
        X, weights = problem.X, problem.x_weights
        if weights is not None:  # points that hardly count shall not draw limbs to them
            heavy = weights >= _HARDLY * weights.mean()
            X, weights = X[heavy], weights[heavy]
        rows = some_rows(X, _POINTS)
        few = X[rows].astype(np.float32)

        def mean(of):
            return np.average(of, axis=-1, weights=None if weights is None else weights[rows])

        grid = VoxelGrid(X, _VOXEL)
        away = _squared(posed.vertices[self._all].astype(np.float32)[None], few)[0]  # (all, x)

        def try_out(limb, angles):
            return _tried(limb, angles, grid, few, posed, state)

        tried = [try_out(limb, limb.angles) for limb in self._limbs]
        found = []
        for limb, t in zip(self._limbs, tried):
            rest = self._rest(away, ~limb.skin)
            if closer and limb.ends:
                t = self._nearer(limb, t, rest, mean, try_out)
            cost = t.away + mean(np.minimum(t.reach, rest))
            order = np.argsort(cost, kind="stable")
            changes = [(cost[k] - cost[0], cost[k], ((limb, t, k),)) for k in order[:_BEST]]
            found += self._unlike(state, changes, cost[0], n, _BETTER)
        for row, other in self._pairs(tried):
            (a, s), (b, t) = (self._limbs[row], tried[row]), (self._limbs[other], tried[other])
            rest = self._rest(away, ~(a.skin | b.skin))
            best_s, best_t = (np.argsort(x.away + mean(np.minimum(x.reach, rest)))[:_BEST] for x in (s, t))
            best_s, best_t = np.union1d(best_s, 0), np.union1d(best_t, 0)
            both = mean(np.minimum(np.minimum(s.reach[best_s][:, None], t.reach[best_t][None]), rest))
            cost = both + s.away[best_s][:, None] + t.away[best_t][None]
            now = cost[0, 0]
            if now < _FINE:
                continue
            order = np.argsort(cost, axis=None, kind="stable")[:_BEST]
            pairs = [np.unravel_index(o, cost.shape) for o in order]
            changes = [
                (cost[i, j] - now, cost[i, j], ((a, s, best_s[i]), (b, t, best_t[j])))
                for i, j in pairs
                if best_s[i] and best_t[j]
            ]
            if a.hangs.sum() == b.hangs.sum():  # first each in the other's pose, which the library need not have
                i, j = try_out(a, self._within(a, state.theta[b.joints])), try_out(b, self._within(b, state.theta[a.joints]))
                swapped = mean(np.minimum(np.minimum(i.reach[1], j.reach[1]), rest)) + i.away[1] + j.away[1]
                if swapped <= now:
                    changes.insert(0, (swapped - now, swapped, ((a, i, 1), (b, j, 1))))
            found += self._unlike(state, changes, now, n, _BETTER_PAIR)
        return [theta for _, theta in sorted(found, key=lambda f: f[0])[:_PROPOSALS]]

    def _pairs(self, tried):
        """Rows (i, k) of limbs of which neither hangs on the other; of very many pairs the nearest for their lengths."""
        hangs = [limb.hangs for limb in self._limbs]
        pairs = [(i, k) for i, k in combinations(range(len(hangs)), 2) if not (hangs[i] & hangs[k]).any()]
        if len(pairs) <= _PAIRS:
            return pairs
        middle = [t.place[0].mean(axis=0) for t in tried]
        length = [max(np.ptp(t.place[0], axis=0).max(), np.finfo(np.float32).tiny) for t in tried]
        apart = {(i, k): np.linalg.norm(middle[i] - middle[k]) / min(length[i], length[k]) for i, k in pairs}
        return sorted(pairs, key=apart.get)[:_PAIRS]

    def _within(self, limb, angles):
        """(1, j, 3): angles (j, 3) within a limb's limits."""
        return np.clip(angles, self.model.rig.lower[limb.joints], self.model.rig.upper[limb.joints])[None]

    def _nearer(self, limb, tried, rest, mean, try_out):
        """Poses of a limb that come of the best ones tried: parts of two of them, and small random changes, ever smaller."""
        rig, rng = self.model.rig, np.random.default_rng(0)  # the same for each scan: fits hang on the scan alone
        lower, upper = rig.lower[limb.joints], rig.upper[limb.joints]
        for sigma in _SIGMAS:
            best = self._apart(tried, tried.away + mean(np.minimum(tried.reach, rest)))
            parents = tried.angles[best]
            one, other = parents[rng.integers(len(best), size=(2, _CHILDREN))]
            cut = rng.integers(1, lower.shape[0] + 1, size=_CHILDREN)[:, None, None]
            mixed = np.where(np.arange(lower.shape[0])[:, None] < cut, one, other)
            angles = np.clip(mixed + sigma * rng.standard_normal(mixed.shape), lower, upper)
            tried = try_out(limb, np.concatenate([parents, angles]))
        return tried

    def _apart(self, tried, cost):
        """Rows of the best poses that are not all but the same, the own one left out."""
        out = []
        for k in np.argsort(cost[1:], kind="stable") + 1:
            if len(out) == _PARENTS:
                break
            if np.all(np.linalg.norm(tried.place[k] - tried.place[out], axis=2).mean(axis=1) > _SAME):
                out.append(k)
        return np.array(out)

    def _rest(self, away, skin):
        """(x,): squared distance from the points to what is held, at most s²."""
        nearest = away[skin[self._all]].min(axis=0, initial=np.inf)
        return np.minimum(_less(nearest, self._spacing), _REACH**2)

    def _unlike(self, state, changes, now, n, better):
        """Of changes (gain, cost, ((limb, tried, row), ...)), best first, the n first that are worth a try: (gain, Θ)."""
        out, seen = [], []
        for gain, cost, parts in changes:
            if len(out) == n or cost > better * now:
                break
            place = [t.place[k] for _, t, k in parts]
            others = [*seen, [t.place[0] for _, t, _ in parts]]
            if all(max(np.linalg.norm(p - o, axis=1).mean() for p, o in zip(place, other)) > _UNLIKE for other in others):
                theta = state.theta.copy()
                for limb, t, k in parts:
                    theta[limb.joints] = t.angles[k]
                seen.append(place)
                out.append((gain, theta))
        return out


def _tried(limb, angles, grid, few, posed, state):
    """The limb's own pose and others, (N, j, 3), in place of it."""
    angles = np.concatenate([state.theta[limb.joints][None], angles])
    n = len(angles)
    place = np.empty((n, len(limb.rows), 3), dtype=np.float32)
    away, reach = np.empty(n), np.empty((n, len(few)), dtype=np.float32)
    for start in range(0, n, _BLOCK):
        part = slice(start, start + _BLOCK)
        place[part] = _posed_limb(posed, state, limb, angles[part])
        V = place[part]
        at = grid.distance(*np.moveaxis(V - grid.centre.astype(np.float32), -1, 0))
        away[part] = np.minimum(np.maximum(at - _VOXEL / 2, 0.0) ** 2, _REACH**2).sum(axis=1) * limb.area
        nearest = [_squared(V[k : k + _AT_ONCE], few).min(axis=1) for k in range(0, len(V), _AT_ONCE)]
        reach[part] = _less(np.concatenate(nearest), limb.spacing)
    return _Tried(place, away, reach, angles)


def _spacing(vertices, some):
    """The largest distance of a vertex from the nearest of some."""
    away, (x, y, z) = np.full(len(vertices), np.inf), np.ascontiguousarray(vertices.T)
    for a, b, c in some:  # coordinate by coordinate, which takes a tenth of the time of rows
        np.minimum(away, (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2, out=away)
    return float(np.sqrt(away.max()))


def _squared(V, x):
    """(k, v, x): squared distances from (k, v, 3) to (x, 3), in one product: |v|² · 1 − 2 v · x + 1 · |x|²."""
    left = np.concatenate([(V**2).sum(axis=2, keepdims=True), -2 * V, np.ones_like(V[:, :, :1])], axis=2)
    return left @ np.stack([np.ones_like(x[:, 0]), *x.T, (x**2).sum(axis=1)])


def _less(d2, spacing):
    """Squared distances, each distance less some spacing."""
    return np.maximum(np.sqrt(np.maximum(d2, 0.0)) - np.float32(spacing), 0.0) ** 2


def _posed_limb(posed, state, limb, angles):
    """(N, v, 3): the limb's vertices under N sets of angles, all other joints as they are."""
    rig, n, hangs = posed.rig, len(angles), limb.hangs
    R = matrix_from_rotvec(np.einsum("jab,njb->nja", rig.frames[limb.joints], angles))
    w = rig.weights[limb.rows].toarray()
    used = w.any(axis=0)
    A, P, rest = {}, {}, posed.rest_joints
    of = {j: k for k, j in enumerate(limb.joints)}  # row of a joint among those of the limb
    for level, up in rig.levels:
        for j, p in zip(level, up):
            if hangs[j]:
                Ap, Pp = (A[p], P[p]) if p in A else (posed.A[p], posed.unscaled_joints[p])
                P[j] = Pp + Ap @ (rest[j] - rest[p])
                A[j] = Ap @ R[:, of[j]]
    out = np.zeros((n, len(limb.rows), 3))
    u = posed.rest[limb.rows]
    for j in np.flatnonzero(used):
        Aj, Pj = (A[j], P[j]) if j in A else (posed.A[j][None], posed.unscaled_joints[j])
        at = (u - rest[j]) @ Aj.transpose(0, 2, 1)
        out += w[:, j, None] * (at + (Pj[:, None] if Pj.ndim == 2 else Pj))
    return state.scale * out + state.translation
