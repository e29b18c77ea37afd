"""Levenberg–Marquardt with residuals measured to the surface: the last step of a pose, and of the template that scans share.

Each scan point x pulls on the closest point p of the posed mesh, and places v of the mesh (``pulling``) pull on their nearest
scan points:

    E = Σ_i a_i ρ(e_i²) + Σ_v b_v ρ(e_v²) + ridge ‖c‖²,   e² = (n · r)² + τ ‖r‖²,   ρ(e²) = e² / (1 + e²/s²),

r the residual vector, n the surface normal, of v halfway between its own and that at its scan point, τ small: points slide along
the surface almost freely, as their true partners are unknown, and what lies further away than some s hardly counts. Near the
optimum this takes some ten steps where L-BFGS on the Chamfer distance takes hundreds, and is more exact, as points are compared
with triangles. Far from it L-BFGS is the better guide. Steps that only look for a pose may take planes at the nearest vertices
for the surface (``measured``).

Closest points move with the mesh, which no derivative here knows of, so that steps fall short where points slide along the
surface: there they go further than the equations say, each a little more than the last, until one of them does not help
(over-relaxation).
"""

from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from .jacobian import vertex_motion
from .measured import ToPlanes, ToTriangles
from .pulling import between
from .state import IN_UNIT, MOST_PROPORTION, Layout
from .visibility import WHOLE, pulling_weights

__all__ = ["GaussNewton", "weight_matrix"]

# The damping at the start; it falls by _EASE after a step that helped and grows by _STIFFEN after one that did not. Below
# _SOFTEST it would change hardly any step, and would have to grow in vain, an evaluation each time, before it does again.
_DAMPING, _EASE, _STIFFEN, _SOFTEST, _STIFFEST = 1e-3, 4.0, 10.0, 1e-9, 1e4
# After a step that lowered E by less than the share _SLOW, the next goes further than the equations say: by _FURTHER times the
# factor of the last, up to _FURTHEST.
# Labelled points slide less: steps as they are found the same poses, and no fewer of them.
_SLOW, _FURTHER, _FURTHEST = 0.3, 1.5, 3.0
# No angle turns further in one step, radians: residuals know nothing of what lies behind the next turn. No translation is further
# either, in half sizes, and no scale changes by a larger power of e.
_LONGEST_TURN = 0.3
# Of more scans at once, equations are made as soon as residuals are, though a step may not be taken: what they are made of, of a
# body 1.4 MB and five times as much as they are, would fill memory.
_MANY = 64


class GaussNewton:
    """The steps for one model.

    Parameters
    ----------
    model : Model
    tangential : float, default 0.05
        τ.
    reach : float, default 0.05
        s, in half sizes of the rig.
    ridge : float, default 1e-5
        On the family's coefficients.
    vertices : int, default 1000
        How many vertices, evenly spread, pull on the scan; on a mesh that has fewer, points on its faces, or with ``planes``
        all of them.
    tolerance : float, default 1e-4
        Steps end where one lowers E by less than this share.
    coverage : Coverage, optional
        What scans show, by default the whole body: what they cannot show does not pull.
    parts : (m,) int array, optional
        Of the vertices, for labelled points; the model's by default.
    planes : bool, default False
        Residuals are measured to planes at the nearest vertices in place of the surface; ``parts`` are not for these.
    """

    def __init__(
        self,
        model,
        *,
        tangential=0.05,
        reach=0.05,
        ridge=1e-5,
        vertices=1000,
        tolerance=1e-4,
        coverage=WHOLE,
        parts=None,
        planes=False,
    ):
        self.model, self.tangential, self.reach, self.ridge, self.tolerance = model, tangential, reach, ridge, tolerance
        self.coverage, self._parts = coverage, model.labels if parts is None else parts
        self._mesh = ToPlanes(model, vertices) if planes else ToTriangles(model, vertices, parts)

    def pose(self, problem, state, *, free=IN_UNIT, labels=None, iterations=12, prior=None):
        """The pose of one scan, its template as it is.

        Parameters
        ----------
        problem : Problem
        state : State
        free : collection of {"pose", "translation", "scale"}
        labels : (n,) int array, optional
            Where given, points look only at surface of their own part, and vertices do not pull; points with a label that no
            vertex has are left out.
        iterations : int
        prior : ((J, 3) array, float or (t, t) array), optional
            Angles Θ⁰ and weights Ω of the t angles that turn, in the order of ``np.argwhere(Layout.turning)``, or one for all:
            adds (Θ − Θ⁰)ᵀ Ω (Θ − Θ⁰), such as for what is known of poses, or for one between its neighbours' in a sequence.

        Returns
        -------
        state : State
        value : float
            E without the ridge, with the prior.
        """
        states, values = self._minimise([problem], [state], [labels], free, False, iterations, [prior])
        return states[0], float(values[0])

    def shared(self, problems, states, *, free=IN_UNIT, labels=None, iterations=12, priors=None):
        """The poses of several scans of one subject together with the coefficients of their one template.

        Parameters
        ----------
        problems : list of Problem
        states : list of State
            All with the same coefficients and residual.
        free, iterations
            As in :meth:`pose`.
        labels : list of (n,) int arrays, optional
        priors : list, optional
            For each scan what holds its pose, as ``prior`` of :meth:`pose`, or None.

        Returns
        -------
        states : list of State
        values : (k,) array
            E of each scan without the ridge, with its prior.
        """
        labels, priors = (each or [None] * len(problems) for each in (labels, priors))
        return self._minimise(problems, states, labels, free, True, iterations, priors)

    def told_by_points(self, problem, state, *, free=IN_UNIT, proba=None):
        """What the scan's points alone tell of a pose, by the curvature of E: where few of them hang on an unknown, little.

        Parameters
        ----------
        problem : Problem
        state : State
        free : collection of {"pose", "translation", "scale"}
        proba : (n, n_parts) array, optional
            Of the parts; a point counts as much as it is likely to be of the part that is nearest to it, and fully where its
            row is 0.

        Returns
        -------
        H : (p, p) array
            Jᵀ W J of the unknowns, W with the points' weights, which sum to 1 without ``proba``, and what ρ leaves of them.
        left : float
            What E leaves of the points, ÷ their weights: about the mean square of their distances from the surface.
        layout : Layout
            Of the unknowns.
        """
        layout = Layout(self.model.rig, free, self.model.n_coefficients)
        made = self._normal_equations(problem, state, None, layout, False, of_vertices=False, proba=proba)
        return made.H, made.value / max(made.weight, np.finfo(float).tiny), layout

    def with_proportions(self, problem, state, *, free=IN_UNIT, labels=None, iterations=12, prior=None):
        """One scan's pose with coefficients of its own: (state, E with the ridge and the prior); options of :meth:`pose`."""
        (state,), (value,) = self._minimise([problem], [state], [labels], free, True, iterations, [prior])
        return state, float(value) + self.ridge * float(state.coefficients @ state.coefficients)

    # ---- the steps ----

    def _minimise(self, problems, states, labels, free, shared, iterations, priors):
        layout = Layout(self.model.rig, free, self.model.n_coefficients)
        states = [layout.inside(s) for s in states]
        each = np.full(len(problems), 1.0 / len(problems))

        def measure(states):
            made = []
            for problem, state, known, prior in zip(problems, states, labels, priors):
                m = self._normal_equations(problem, state, known, layout, shared)
                if prior is not None:
                    theta, held_by = prior
                    m.hold((state.theta - theta)[layout.turning], weight_matrix(held_by, layout.turning))
                if len(problems) > _MANY:
                    m.settle()
                made.append(m)
            c = states[0].coefficients
            total = float(each @ [m.value for m in made]) + (self.ridge * float(c @ c) if shared else 0.0)
            return made, total

        made, total = measure(states)
        damping, stretch = _DAMPING, 1.0
        unlabelled = all(known is None for known in labels)
        for _ in range(iterations):
            trial = self._step(states, made, layout, shared, damping, stretch)
            trial_made, trial_total = measure(trial)
            if trial_total < total:
                gain, states, made, total = 1.0 - trial_total / total, trial, trial_made, trial_total
                damping = max(damping / _EASE, _SOFTEST)
                stretch = min(_FURTHER * stretch, _FURTHEST) if gain < _SLOW and unlabelled else 1.0
                if gain < self.tolerance:
                    break
            elif stretch > 1.0:
                stretch = 1.0
            else:
                damping *= _STIFFEN
                if damping > _STIFFEST:
                    break
        return states, np.array([m.value for m in made])

    def _normal_equations(self, problem, state, labels, layout, shared, *, of_vertices=True, proba=None):
        model = self.model
        posed = model.deformed(state)
        V, X = posed.vertices, problem.X
        a = problem.shares
        nearest, known = self._nearest(X, V, labels)
        X, a = X[known], a[known]
        if proba is not None:
            a = a * np.where(proba.any(axis=1), proba[np.arange(len(X)), model.labels[nearest]], 1.0)
        on = self._mesh.closest(X, nearest, posed, None if labels is None else labels[known])
        r, normals, weights, hangs = X - on.points, on.normals, a, [(on.corners, on.barycentric)]
        if labels is None and of_vertices:
            places, facing = self._mesh.places(posed)
            to_X, pull = problem.x_index.nearest(places), self._mesh.weights
            pull = pulling_weights(self.coverage, pull, places, facing, problem, on.normals, to_X)
            r, weights = np.vstack([r, X[to_X] - places]), np.concatenate([weights, pull])
            normals = np.vstack([normals, between(facing, on.normals[to_X])])
            hangs.append((self._mesh.corners, self._mesh.barycentric))

        def motion():
            blocks = layout.blocks + (("proportions",) if shared else ())
            rows, places = _places(hangs, len(V))
            return vertex_motion(model, state, posed, rows, blocks, layout.turning).at(places)

        return _Normal(r, normals, weights, self.tangential, self.reach, motion)

    def _nearest(self, X, V, labels):
        """(nearest vertex of the points that have one, which points these are)."""
        from ..neighbors import PointIndex

        if labels is None:
            return PointIndex(V, moving=True).nearest(X), slice(None)
        nearest = PointIndex(V, self._parts, moving=True).nearest(X, labels)
        known = np.flatnonzero(nearest >= 0)
        return nearest[known], known

    def _step(self, states, made, layout, shared, damping, stretch):
        """All states after one step, ``stretch`` times as long as the damped equations say.

        The scans' own unknowns are eliminated, the shared ones solved for, then put back.
        """
        n = layout.size
        k = self.model.n_coefficients if shared else 0
        Hc, gc, own, share = np.zeros((k, k)), np.zeros(k), [], 1.0 / len(states)
        for state, m in zip(states, made):
            x = layout.pack(state)
            lower, upper = layout.bounds()
            # An unknown at its bound that would leave it stays out of this step.
            free = ~(((x <= lower) & (m.g[:n] < 0)) | ((x >= upper) & (m.g[:n] > 0)))
            chain = layout.units(state)[free]
            H = m.H[:n, :n][np.ix_(free, free)] * np.outer(chain, chain)
            H[np.diag_indices_from(H)] += damping * H.diagonal() + 1e-5
            right = np.column_stack([m.H[:n, n:][free] * chain[:, None], m.g[:n][free] * chain])
            solved = np.linalg.solve(H, right)
            own.append((x, free, solved))
            if shared:
                Hc += share * (m.H[n:, n:] - right[:, :-1].T @ solved[:, :-1])
                gc += share * (m.g[n:] - right[:, :-1].T @ solved[:, -1])
        dc, c = np.zeros(k), states[0].coefficients
        if shared:
            Hc[np.diag_indices_from(Hc)] += damping * Hc.diagonal() + self.ridge
            dc = stretch * np.linalg.solve(Hc, gc - self.ridge * c)
            new = np.clip(c + dc, -MOST_PROPORTION, MOST_PROPORTION)
            dc = new - c  # before the poses go along with it
            states = [s.replace(coefficients=new) for s in states]
        out = []
        for state, (x, free, solved) in zip(states, own):
            step = np.zeros(n)
            step[free] = stretch * solved[:, -1] - solved[:, :-1] @ dc
            x = np.clip(x + np.clip(step, -_LONGEST_TURN, _LONGEST_TURN), *layout.bounds())
            out.append(layout.unpack(x, state))
        return out


def weight_matrix(weights, turning):
    """(t, t) weights of the angles that turn, where one number may stand for all."""
    return weights if np.ndim(weights) == 2 else weights * np.eye(int(turning.sum()))


def _places(hangs, m):
    """Vertices that places of the mesh hang on, and how: (r,) rows, and (k, r) sparse weights.

    Parameters
    ----------
    hangs : list of ((n, c) int array, (n, c) array)
        Of some places each: vertices, and their shares.
    m : int
        Vertices of the mesh.
    """
    vertex = np.concatenate([corners.ravel() for corners, _ in hangs])
    used = np.zeros(m, dtype=bool)
    used[vertex] = True
    place = np.cumsum(used) - 1
    each = np.concatenate([np.full(len(corners), corners.shape[1]) for corners, _ in hangs])
    start = np.concatenate([[0], np.cumsum(each)])
    share = np.concatenate([shares.ravel() for _, shares in hangs])
    return np.flatnonzero(used), csr_array((share, place[vertex], start), shape=(len(each), int(used.sum())))


class _Normal:
    """Residuals at one state: their value at once, their normal equations H = Jᵀ W J, g = Jᵀ W r when a step is to be taken.

    Parameters
    ----------
    r, normals : (n, 3) arrays
        Residual vectors.
    weights : (n,) array
    tangential, reach : float
    motion : callable () → VertexMotion
        Of what the residuals are measured from.
    """

    def __init__(self, r, normals, weights, tangential, reach, motion):
        along = np.einsum("na,na->n", r, normals)
        e2 = along**2 + tangential * np.einsum("na,na->n", r, r)
        near = 1.0 / (1.0 + e2 / reach**2)
        self.value, self.weight = float(weights @ (e2 * near)), float(weights.sum())
        self._made_of = motion, (r, normals, weights * near**2, tangential)  # dρ/de² = near²
        self._held = []

    def hold(self, away, weights):
        """Angles that are ``away`` (t,) from where they are wanted, by weights (t, t); the pose's columns come first."""
        self._held.append((weights, weights @ away))
        self.value += float(away @ weights @ away)

    def settle(self):
        """Make the equations now, and let go of what they are made of."""
        return self._equations

    @property
    def H(self):
        """(p, p)."""
        return self._equations[0]

    @property
    def g(self):
        """(p,)."""
        return self._equations[1]

    @cached_property
    def _equations(self):
        (motion, residuals), self._made_of = self._made_of, None
        H, g = motion().normal_equations(*residuals)
        for weights, pull in self._held:
            n = len(pull)
            H[:n, :n] += weights
            g[:n] -= pull
        return H, g
