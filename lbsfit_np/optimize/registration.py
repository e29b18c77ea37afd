"""Registration: the posed skin brought onto the scan along normals, by a smooth displacement that moves no joint (non-rigid ICP).

With the pose held, displacements u of the template's vertices make small

    E(u) + κ (β ∫ |Δu|² dA + μ ∫ |∇u|² dA),

E as in ``gauss_newton``, of points to the surface and of places of the mesh to points, along normals alone: nothing slides. The
template's own features and its proportions cost nothing, as u comes on top.

How firmly u is held follows from the scan. κ = (σ²/n) (s²/s_u²) is what the maximum of the posterior has for n distances with
noise of standard deviation σ and for displacements of size s_u, s in usual people. σ is what the distances come down to, and
s_u² what they lose on the way, beyond what any displacement would take of noise: a scan of the rig's own shape, or a noisy one,
hardly displaces anything, and what clean, dense points of somebody else show is followed.

What the scan lacks would be drawn to what is next to it, and what lies beneath the skin through it. A place of the mesh
therefore pulls only where its nearest point lies on the mesh about there, on the same side and in the same piece of it;
pieces that are close to the largest one go along with that.

Posed vertices are linear in u: each step is one sparse linear system, solved by conjugate gradients.
"""

import numpy as np
from scipy import sparse

from ..medians import weighted_median
from ..neighbors import PointIndex
from ..triangles import areas_around, pieces
from .measured import ToTriangles
from .problem import merged
from .pulling import between
from .smoothness import differences

__all__ = ["Registration"]

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
# A place pulls where its nearest point lies on the mesh no further from it than this, half sizes, or than points are apart.
_THERE = 0.03
# Vertices of a smaller piece of the mesh no further than this from the largest one, half sizes, are joined to it by an edge.
_JOINED = 0.05
# No vertex moves further, half sizes; a step that would, or that makes nothing smaller, is halved so many times.
_FARTHEST, _HALVINGS = 0.2, 3
# What holds vertices that nothing else does, in shares of the surface; of the preconditioner and of the equations.
_FIRM, _HOLD = 1e-3, 1e-9
# The preconditioner is made anew where κ has changed by this factor.
_OTHER = 2.0


class Registration:
    """For one model.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model):
        self.model = model
        self._mesh = ToTriangles(model, _PLACES)
        vertices, faces = model.rig.vertices, model.rig.faces
        area = areas_around(vertices, faces)
        self._area = np.maximum(area, max(_LEAST_AREA * area.mean(), np.finfo(float).tiny))
        self._piece = pieces(len(vertices), faces)
        K = sparse.csc_array(model.K)
        stretching = K + _joins(vertices, self._piece)
        self._smooth = sparse.csc_array(_BENDING * (K.T @ sparse.diags_array(1.0 / self._area) @ K) + _STRETCHING * stretching)

    def __call__(self, problem, state):
        """The state with a displacement in place of its residual, which only its joints follow from then on.

        Where no displacement brings the skin closer, the state is as it was.

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
        best, trial = state, state.replace(displacement=np.zeros_like(self.model.rig.vertices))
        made, solved = self._measured(problem, trial), None
        of_mean = float(np.square(merged(problem.X, problem.shares, None)[1]).sum())  # Σ a², which is 1/n where all have the same
        before, kappa = made.variance, made.variance * of_mean
        for _ in range(_STEPS):
            if solved is None or not 1 / _OTHER < kappa / solved.kappa < _OTHER:
                solved = _Preconditioner(self._smooth, self._area, made, kappa)
            step, further = self._step(made, kappa, solved), None
            for _ in range(_HALVINGS + 1):
                u = made.u + step
                if np.isfinite(u).all() and np.linalg.norm(u, axis=1).max(initial=0.0) < _FARTHEST:
                    trial = state.replace(displacement=u)
                    further = self._measured(problem, trial, made.partners)
                    if further.value + kappa * self._roughness(u) < made.value + kappa * self._roughness(made.u):
                        break
                step, further = 0.5 * step, None
            if further is None:
                break
            best, made = trial, further
            explained = max(before - _FREE * made.variance, np.finfo(float).tiny)
            kappa = made.variance * of_mean * min(max(_USUAL / explained, _SOFTEST), _STIFFEST)
            if np.abs(step).max(initial=0.0) < _STILL:
                break
        return best

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

    def _measured(self, problem, state, partners=None):
        """As it is at a state; ``partners`` are those of the first, by default those that are found here."""
        posed, X = self.model.deformed(state), problem.X
        V = posed.vertices
        on = self._mesh.closest(X, PointIndex(V).nearest(X), posed)
        places, facing = self._mesh.places(posed)
        to_X = problem.x_index.nearest(places)
        piece = self._piece[on.corners[:, 0]]
        if partners is None:
            partners = piece, self._have_points(problem, on, piece, places, facing, to_X)
        shares, pull = problem.shares * (piece == partners[0]), self._mesh.weights * partners[1]
        r = np.vstack([X - on.points, X[to_X] - places])
        n = np.vstack([on.normals, between(facing, on.normals[to_X])])
        hangs = (on.corners, on.barycentric), (self._mesh.corners, self._mesh.barycentric)
        made = _Measured(r, n, shares, pull, partners, hangs, state.scale * posed.turns(), state.displacement)
        made.value += _REACH**2 * float(problem.shares.sum() - shares.sum())  # the most that ρ is: no step wins by losing points
        return made

    def _have_points(self, problem, on, piece, places, facing, to_X):
        """(v,) bool: the places whose nearest point lies on the mesh about there, and not on its other side or another piece."""
        there = np.linalg.norm(on.points[to_X] - places, axis=1) < max(_THERE, problem.spacing)
        same = piece[to_X] == self._piece[self._mesh.corners[:, 0]]
        return there & same & (np.einsum("va,va->v", facing, on.normals[to_X]) > 0)


class _Measured:
    """Distances along normals at one state, and how they change with the vertices of the template.

    Attributes
    ----------
    value : float
        E.
    variance : float
        σ² of the points.
    partners : (n,) int array, (v,) bool array
        The pieces of the mesh that points lay on at first, on which alone they count, and the places of it that may pull.
    away : (k,) array
        n · r.
    weights : (k,) array
        Of these, with what ρ leaves of them.
    u : (m, 3) array
    """

    def __init__(self, r, normals, shares, pull, partners, hangs, turns, u):
        self.away = np.einsum("ka,ka->k", r, normals)
        e2 = self.away**2 + _ACROSS * np.einsum("ka,ka->k", r, r)
        near, w = 1.0 / (1.0 + e2 / _REACH**2), np.concatenate([shares, pull])
        self.value, self.weights, self.partners, self.u = float(w @ (e2 * near)), w * near**2, partners, u
        self.variance = max(_OF_SIGMA * weighted_median(np.abs(self.away[: len(shares)]), shares), _EXACT) ** 2
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


def _joins(vertices, piece):
    """(m, m) sparse: what edges from smaller pieces to near vertices of the largest one add to a cotangent matrix."""
    from scipy.spatial import cKDTree

    largest = piece == np.bincount(piece).argmax()
    rows, others = np.flatnonzero(largest), np.flatnonzero(~largest)
    away, near = cKDTree(vertices[rows]).query(vertices[others], distance_upper_bound=_JOINED)
    joined = np.isfinite(away)
    return differences(others[joined], rows[near[joined]], len(vertices))


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
