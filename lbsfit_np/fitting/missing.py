"""Limbs that a scan lacks, such as a finger that is missing or was never seen: taken off, so that nothing else makes up for them.

What has no points is drawn to what is next to it. A finger that the scan lacks is fitted into the next one, bones shortened as it
takes, and there it leaves next to nothing unexplained. But points tell: of a limb that is shown there are some that nothing else
explains. So of a limb whose points all lie on the rest as well the skin is taken off, and pose and proportions of the rest are
found without it. Where that explains all points as well as before, the scan does not show the limb, whose pose is a guess then:
at rest, or as what is known of poses has it.
"""

import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from ..errors import listed
from ..neighbors import PointIndex
from ..optimize.problem import merged
from ..optimize.pulling import Pulling
from ..rig.chains import bones, subtrees, vertex_bones
from .confidence import beyond_noise, lonely_odd, misfit, without

__all__ = ["MissingLimbs", "Shown"]

# Places of the mesh by which limbs are looked at.
_PLACES = 4000
# A limb has this share of the surface at least, and at rest it stands out from the rest by this mean misfit: eyes in a head, or
# fingers of a body, are not told from what is next to them.
_LEAST, _APART = 0.01, 0.6
# A limb is taken off to try whose points the rest leaves less misfit than the first share of what it leaves of the limb's skin at
# rest, and in all no more than the second share of its surface. Of limbs that are shown, of six hands and bodies, the first was
# 0.55 at least; of those that are not, both were 0.49 and 0.1 at most.
_EXPLAINED, _LITTLE = 0.5, 0.15
# Of a limb of which a whole scan would have fewer points, next to none may have fallen on it by chance.
_EXPECTED = 10
# With the limb taken off, neither its own points nor all are misfit by more than before and this share of its surface. Of limbs
# that are not shown it was 0.02 at most; of one that is shown, it is about half of the limb's share of the points.
_RISE = 0.05
# With all limbs taken off that the scan does not show, no more is left unexplained than this: else these points may be of one.
_LEFT = 0.02
# So many limbs are taken off to try, at most, until one of them is found to be missing; and so many are found.
_TRIED, _FOUND = 8, 8


@dataclass(frozen=True)
class Shown:
    """What a scan shows of a model.

    Attributes
    ----------
    model : Model
        Without the skin of limbs that are missing.
    state : State
        The pose of that.
    missing : (m,) bool array
        The vertices of the whole model that are missing.
    limbs : tuple of int
        The joints that the limbs hang on.
    """

    model: object
    state: object
    missing: np.ndarray
    limbs: tuple = ()

    @property
    def joints(self):
        """(J,) bool: the joints of missing limbs."""
        return subtrees(self.model.rig.parents)[list(self.limbs)].any(axis=0)

    @property
    def note(self):
        """In words, what is missing; of limbs that hang on each other the highest alone."""
        below = subtrees(self.model.rig.parents)
        highest = [j for j in sorted(self.limbs) if below[list(self.limbs), j].sum() == 1]
        names = listed([self.model.rig.joint_names[j] for j in highest], 6)
        return f"the scan shows nothing of what hangs on {names}, whose pose is a guess"

    def whole(self, state, model):
        """A State of what is shown as one of the whole model: missing skin is offset like the shown skin that it hangs on."""
        rows = self._stands_for(model)
        offsets = {name: getattr(state, name) for name in ("residual", "displacement")}
        return state.replace(**{name: None if value is None else value[rows] for name, value in offsets.items()})

    def with_joints_of(self, model):
        """The same, whose joints follow a residual as they do in the whole model that :meth:`whole` gives it to."""
        rows, own = self._stands_for(model), copy.copy(self.model)
        taken = csr_array((np.ones(len(rows)), (np.arange(len(rows)), rows)), shape=(len(rows), len(own.labels)))
        own.rig = replace(own.rig, regressor=csr_array(model.rig.regressor @ taken))
        return replace(self, model=own)

    def _stands_for(self, model):
        """(m,) rows of the shown vertices whose offsets the whole model's have."""
        vertices, faces, there = model.rig.vertices, model.rig.faces, np.flatnonzero(~self.missing)
        rows = PointIndex(vertices[there]).nearest(vertices)  # where none hangs on the rest by triangles, the vertex next to it
        bone, below = vertex_bones(model.rig), subtrees(model.rig.parents) > 0
        for j in sorted(self.limbs, key=lambda j: -below[:, j].sum()):  # the highest last, as limbs may hang on each other
            own = below[j][bone] & self.missing
            rim = np.setdiff1d(faces[own[faces].any(axis=1)], np.flatnonzero(self.missing))
            of_root = rim[bone[rim] == bones(model.rig)[model.rig.parents[j]]]  # others are of limbs beside it
            if len(rim := of_root if len(of_root) else rim):
                near = rim[PointIndex(vertices[rim]).nearest(vertices[own])]
                rows[own] = np.searchsorted(there, near)
        return rows

    def said(self, proba):
        """(n, n_parts) probabilities of the parts as if those that are missing could not be; None for None."""
        if proba is None:
            return None
        there = np.bincount(self.model.labels, minlength=proba.shape[1]) > 0
        proba = proba * there
        return proba / np.maximum(proba.sum(axis=1, keepdims=True), np.finfo(float).tiny)


@dataclass(frozen=True)
class _Trial:
    """Where steps on what may be shown have come to."""

    shown: Shown
    value: float  # what they leave, which they make small
    nearest: np.ndarray  # (n,) rows of the shown vertices
    misfit: np.ndarray  # (n,) of the points
    left: float  # their mean misfit beyond noise


class MissingLimbs:
    """Looks for limbs of a model that scans lack.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model):
        self.model = model
        self._below = subtrees(model.rig.parents) > 0
        self._bone = vertex_bones(model.rig)

    def of(self, problem, state, steps, *, theta0=None, **known):
        """What a scan shows.

        Parameters
        ----------
        problem : Problem
        state : State
            A pose of the whole model, without a residual.
        steps : callable (Model) → object
            Its ``to_the_end`` (problem, state, **known) gives where steps for that model come to, and what these leave.
        theta0 : (J, 3) array, optional
            What missing limbs start from, and stay in but for a prior among ``known``; at rest by default.
        **known
            Passed to the steps.

        Returns
        -------
        Shown or None
            None where it may be all.
        """
        X, w, _ = merged(problem.X, problem.shares, None)
        start = self.model.rest().theta if theta0 is None else theta0

        def after_steps(shown):
            state, value = steps(shown.model).to_the_end(problem, shown.state, **known)
            return _Trial(replace(shown, state=state), value, *_misfit(shown.model, X, w, state))

        best, shown = None, Shown(self.model, state, np.zeros(len(self._bone), dtype=bool))
        while len(shown.limbs) < _FOUND and (explained := self._explained_by_the_rest(X, w, shown)):
            best = best or after_steps(shown)
            bone = self._bone[~best.shown.missing][best.nearest]
            found, trials = [], self._highest(explained)
            for tried in range(_TRIED):
                if tried == len(trials):
                    break
                j = trials[tried]
                if (less := self._without(best.shown, j, start)).model is None:
                    continue
                other, most = after_steps(less), _RISE * self._share_of(j)
                own = w * self._below[j][bone]
                if max(own @ (other.misfit - best.misfit), other.left - best.left) <= most:
                    found.append(other)
                else:  # a part of it may be missing
                    trials += self._highest([k for k in explained if k != j and self._below[j, k]])
            better = min(found, key=lambda trial: trial.value, default=best)
            if better.value >= best.value:
                break
            best, shown = better, better.shown
        return shown.with_joints_of(self.model) if shown.limbs and best.left <= _LEFT else None

    @cached_property
    def _places(self):
        return Pulling(self.model, _PLACES)

    @cached_property
    def _bone_of_place(self):
        corners, barycentric = self._places.corners, self._places.barycentric
        return self._bone[corners[np.arange(len(corners)), barycentric.argmax(axis=1)]]

    @cached_property
    def _limbs(self):
        """{joint: ((v,) bool, float)} of the limbs that can be told: their places, and the mean misfit at rest without them."""
        rig, weights, out = self.model.rig, self._places.weights, {}
        P, _ = self._places.of(rig.vertices)
        for j in np.flatnonzero(rig.moving):
            own = self._below[j][self._bone_of_place]
            if weights[own].sum() < _LEAST or own.all():
                continue
            apart = float(np.average(misfit(_squared(P[own], P[~own])), weights=weights[own]))
            if apart >= _APART:
                out[j] = own, apart
        return out

    def _explained_by_the_rest(self, X, w, shown):
        """Joints of the limbs, of those that are not found to be missing, whose points the rest explains."""
        P, _ = self._places.of(self.model.deformed(shown.state).vertices)
        there = ~shown.missing[self._places.corners].any(axis=1)
        rows, out = np.flatnonzero(there), []
        on, n_points = rows[PointIndex(P[there]).nearest(X)], 1 / (w @ w)
        for j, (own, apart) in self._limbs.items():
            rest = there & ~own
            if not (there & own).any() or not rest.any() or self._share_of(j) * n_points < _EXPECTED:
                continue
            near = own[on]
            left = w[near] @ misfit(_squared(X[near], P[rest])) if near.any() else 0.0
            if left <= min(_EXPLAINED * apart * w[near].sum(), _LITTLE * self._share_of(j)):
                out.append(j)
        return out

    def _share_of(self, j):
        """Of the surface, that of a limb."""
        own, _ = self._limbs[j]
        return float(self._places.weights[own].sum())

    def _highest(self, joints):
        """Those of joints that do not hang on another one of them."""
        return [j for j in joints if self._below[joints, j].sum() == 1]

    def _without(self, shown, j, start):
        """The same without the limb of joint j as well, before any step; its angles are those of a start."""
        model, missing = self.model.without(shown.missing | self._below[j][self._bone])
        state = shown.state.replace(theta=np.where(self._below[j][:, None], start, shown.state.theta))
        return Shown(model, state, missing, (*shown.limbs, j))


def _squared(X, P):
    """(n,) squared distances of X (n, 3) from the nearest of P."""
    return np.square(X - P[PointIndex(P).nearest(X)]).sum(axis=1)


def _misfit(model, X, w, state):
    """(nearest vertices, misfit of the points, mean misfit beyond noise with clutter left out)."""
    V = model.deformed(state).vertices
    on = PointIndex(V).nearest(X)
    away = np.square(X - model.surface.closest(X, on, V).points).sum(axis=1)
    _, beyond = beyond_noise(away, w)
    return on, misfit(away), float(without(w, lonely_odd(X, beyond)) @ misfit(beyond))
