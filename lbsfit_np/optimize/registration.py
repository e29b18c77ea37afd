"""Registration: the posed skin brought onto the scan along normals, by a smooth displacement that moves no joint (non-rigid ICP).

With the pose held, displacements u of the template's vertices make small

    E(u) + κ (β ∫ |Δu|² dA + μ ∫ |∇u|² dA),

E as in ``gauss_newton``, of points to the surface and of places of the mesh to points, along normals alone: nothing slides. The
template's own features and its proportions cost nothing, as u comes on top.

How firmly u is held follows from the scan. κ = (σ²/n) (s²/s_u²) is what the maximum of the posterior has for n distances with
noise of standard deviation σ and for displacements of size s_u, s in usual people. σ is what the distances come down to, and
s_u² what they lose on the way, beyond what any displacement would take of noise: a scan of the rig's own shape, or a noisy one,
hardly displaces anything, and what clean, dense points of somebody else show is followed.

Posed vertices are linear in u: each step is one sparse linear system, solved by conjugate gradients.
"""

import numpy as np
from scipy import sparse

from ..neighbors import PointIndex
from ..triangles import areas_around
from .measured import ToTriangles
from .pulling import between
from .visibility import WHOLE, pulling_weights

__all__ = ["Registration", "weighted_median"]

# β and μ of the text. Three times as much of both leaves bodies of other rigs half as far again from their scans, a third of both
# leaves vertices of hands a few percent further from the truth.
_BENDING, _STRETCHING = 500.0, 5e4
# s of E, in half sizes, and what of a residual across the normal counts in ρ alone.
_REACH, _ACROSS = 0.05, 0.02
# s² of the text, squared half sizes, the bounds of s²/s_u², and 1 + what a displacement takes of noise.
_USUAL, _SOFTEST, _STIFFEST, _FREE = 2e-5, 0.5, 30.0, 1.05
# σ is at least this, half sizes: closest points are no truer partners than that, however exact the scan. With a fourth of it,
# meshes of bodies come closer to clean scans, 0.8 mm in place of 1.3, but chins and noses that lie elsewhere are creased.
_EXACT = 2e-3
# A median absolute deviation of normal noise is this much of its σ.
_OF_SIGMA = 1.4826
# Places of the mesh that pull. With 1,000 surfaces are a fifth further off, with all vertices of a body of 13,380 its vertices.
_PLACES = 4000
# Steps at most; they end where none moves a vertex further than this, half sizes. Of conjugate gradients tolerance and number.
_STEPS, _STILL, _TOLERANCE, _INNER = 6, 3e-4, 1e-2, 200
# Vertices with less of the surface than this share of the mean count as if they had so much: Δ divides by it.
_LEAST_AREA = 0.01
# What holds vertices that nothing else does, in shares of the surface; of the preconditioner and of the equations.
_FIRM, _HOLD = 1e-3, 1e-9
# The preconditioner is made anew where κ has changed by this factor.
_OTHER = 2.0


class Registration:
    """For one model.

    Parameters
    ----------
    model : Model
    coverage : Coverage, optional
        What scans show, by default the whole body: what they cannot show follows what they do, smoothly.
    """

    def __init__(self, model, coverage=WHOLE):
        self.model, self.coverage = model, coverage
        self._mesh = ToTriangles(model, _PLACES)
        area = areas_around(model.rig.vertices, model.rig.faces)
        self._area = np.maximum(area, max(_LEAST_AREA * area.mean(), np.finfo(float).tiny))
        K = sparse.csc_array(model.K)
        self._smooth = sparse.csc_array(_BENDING * (K.T @ sparse.diags_array(1.0 / self._area) @ K) + _STRETCHING * K)

    def __call__(self, problem, state):
        """The state with a displacement in place of its residual, which only its joints follow from then on.

        Parameters
        ----------
        problem : Problem
            All points that are to be met.
        state : State
            With the pose, which stays.

        Returns
        -------
        State
        """
        # Not from the residual: what that has slid along the surface, no distance along normals would bring back.
        state = state.replace(displacement=np.zeros_like(self.model.rig.vertices))
        made, solved = self._measured(problem, state), None
        before, kappa = made.variance, made.of_mean
        for _ in range(_STEPS):
            if solved is None or not 1 / _OTHER < kappa / solved.kappa < _OTHER:
                solved = _Preconditioner(self._smooth, self._area, made, kappa)
            step = self._step(made, kappa, solved)
            if not np.isfinite(step).all():
                break
            u = made.u + step
            trial = state.replace(displacement=u)
            further = self._measured(problem, trial)
            if further.value + kappa * self._roughness(u) >= made.value + kappa * self._roughness(made.u):
                break
            state, made = trial, further
            explained = max(before - _FREE * made.variance, np.finfo(float).tiny)
            kappa = made.of_mean * min(max(_USUAL / explained, _SOFTEST), _STIFFEST)
            if np.abs(step).max(initial=0.0) < _STILL:
                break
        return state

    def _roughness(self, u):
        return float(np.vdot(u, self._smooth @ u))

    def _step(self, made, kappa, solved):
        from scipy.sparse.linalg import LinearOperator, cg

        m, J, W = len(made.u), made.J, made.weights
        across = J.T.tocsr()

        def of(x):
            return across @ (W * (J @ x)) + self._held(x.reshape(m, 3), kappa).ravel()

        right = across @ (W * made.away) - kappa * (self._smooth @ made.u).ravel()
        A, M = (LinearOperator((3 * m, 3 * m), matvec=f, dtype=float) for f in (of, solved))
        return cg(A, right, M=M, rtol=_TOLERANCE, maxiter=_INNER)[0].reshape(m, 3)

    def _held(self, x, kappa):
        return kappa * (self._smooth @ x) + _HOLD * self._area[:, None] * x

    def _measured(self, problem, state):
        posed, X = self.model.deformed(state), problem.X
        V = posed.vertices
        on = self._mesh.closest(X, PointIndex(V).nearest(X), posed)
        places, facing = self._mesh.places(posed)
        to_X, pull = problem.x_index.nearest(places), self._mesh.weights
        pull = pulling_weights(self.coverage, pull, places, facing, problem, on.normals, to_X)
        r = np.vstack([X - on.points, X[to_X] - places])
        n = np.vstack([on.normals, between(facing, on.normals[to_X])])
        hangs = (on.corners, on.barycentric), (self._mesh.corners, self._mesh.barycentric)
        return _Measured(r, n, problem.shares, pull, hangs, state.scale * posed.turns(), state.displacement)


class _Measured:
    """Distances along normals at one state, and how they change with the vertices of the template.

    Attributes
    ----------
    value : float
        E.
    variance, of_mean : float
        σ² of the points, and σ²/n.
    away : (k,) array
        n · r.
    weights : (k,) array
        Of these, with what ρ leaves of them.
    u : (m, 3) array
    """

    def __init__(self, r, normals, shares, pull, hangs, turns, u):
        self.away = np.einsum("ka,ka->k", r, normals)
        e2 = self.away**2 + _ACROSS * np.einsum("ka,ka->k", r, r)
        near, w = 1.0 / (1.0 + e2 / _REACH**2), np.concatenate([shares, pull])
        self.value, self.weights, self.u = float(w @ (e2 * near)), w * near**2, u
        self.variance = max(_OF_SIGMA * weighted_median(np.abs(self.away[: len(shares)]), shares), _EXACT) ** 2
        self.of_mean = self.variance * float(shares @ shares)
        self._hangs, self._normals, self._turns = hangs, normals, turns

    @property
    def J(self):
        """(k, 3m) sparse: n · ∂p/∂u of the places p that the distances are measured from."""
        rows, columns, values, start = [], [], [], 0
        for corners, barycentric in self._hangs:
            k, q = corners.shape
            own = np.einsum("kqab,ka->kqb", self._turns[corners], self._normals[start : start + k])
            rows.append(np.repeat(np.arange(start, start + k), 3 * q))
            columns.append((3 * corners[:, :, None] + np.arange(3)).ravel())
            values.append((barycentric[:, :, None] * own).ravel())
            start += k
        places = np.concatenate(rows), np.concatenate(columns)
        return sparse.csr_array((np.concatenate(values), places), shape=(start, self.u.size))

    @property
    def on_vertices(self):
        """(m,): the weights' shares of the vertices."""
        out, start = np.zeros(len(self.u)), 0
        for corners, barycentric in self._hangs:
            w = self.weights[start : start + len(corners), None] * barycentric
            out += np.bincount(corners.ravel(), w.ravel(), minlength=len(out))
            start += len(corners)
        return out


def weighted_median(values, weights):
    """The least value up to which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())]])


class _Preconditioner:
    """The equations as if the distances did not go by directions: one system for each coordinate."""

    def __init__(self, smooth, area, made, kappa):
        from scipy.sparse.linalg import splu

        self.kappa = kappa
        held = made.on_vertices / 3 + _FIRM * area / area.sum()
        A = sparse.csc_array(self.kappa * smooth + sparse.diags_array(held))
        options = {"SymmetricMode": True}
        self._solve = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve

    def __call__(self, x):
        return self._solve(np.ascontiguousarray(x.reshape(-1, 3))).ravel()
