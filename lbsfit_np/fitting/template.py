"""The template that the scans of one subject share: bone proportions, joints and skin, found from many poses at once.

One scan cannot say whether a finger is longer or the knuckle further up; twenty poses can. First Levenberg–Marquardt solves
for all poses together with the proportions, the girths and shifts of the joints; then the skin moves along its normals:

    min_h 1/N Σ_i a_i ρ'_i (n_i · (x_i − p_i − Σ_k β_ik B_k ν_k h_k))² + λ ‖K h‖² + μ Σ_k A_k h_k²,

N the number of scans, h the height of each vertex along the template's normal ν, p_i = Σ_k β_ik v_k the surface point nearest to
scan point x_i, B the blended rotation with the scale, A_k the vertex's share of the area. Heights cannot slide along the surface,
as free offsets do, which lowers the loss and makes the mesh worse.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ..optimize.gauss_newton import GaussNewton
from ..optimize.precision import told_angles
from ..optimize.smoothness import smoothness_matrix
from ..optimize.surface import vertex_normals
from ..optimize.visibility import WHOLE, Coverage
from .labels import DOUBT, refined_labels
from .proportioned import TANGENTIAL

__all__ = ["SHIFTS", "TemplateSettings", "likely_right", "shared_template"]

# Length of a unit shift of a joint; with ``TemplateSettings.ridge`` it says how far joints may leave the regressor's place.
SHIFTS = 0.1
# Share of the surface below which a vertex has none.
_NO_AREA = 1e-12


@dataclass(frozen=True)
class TemplateSettings:
    """How a shared template is found. Lengths in half sizes of the rig.

    Attributes
    ----------
    ridge : float
        On the coefficients of proportions and shifts.
    sigmas : tuple of float
        σ of the refined labels that the first steps go by.
    labelled_steps, steps : int
        Steps with each σ, and without labels.
    reach : float
        Residuals much larger than this hardly count.
    worst : float
        Scans whose loss is more than this many times the median do not count: their pose is wrong, and would bend the template.
    smooth, small : float
        λ and μ of the heights.
    rounds : int
        Solutions for the heights, each with new closest points.
    coverage : Coverage
        What scans show.
    """

    ridge: float = 1e-5
    sigmas: tuple = (0.05, 0.025)
    labelled_steps: int = 4
    steps: int = 12
    reach: float = 0.025
    worst: float = 1.6
    smooth: float = 2e-4
    small: float = 2e-3
    rounds: int = 3
    coverage: Coverage = WHOLE


def likely_right(losses, worst=TemplateSettings.worst):
    """(k,) bool: which of one subject's scans are explained about as well as the others, so that their poses are likely right.

    Parameters
    ----------
    losses : (k,) array
        How well each scan is explained; what is small is good.
    worst : float
        Of ``TemplateSettings``.
    """
    return np.asarray(losses) <= worst * np.median(losses)


def shared_template(model, problems, states, losses, *, proba=None, dense=None, prior=None, settings=None):
    """The template of one subject from the scans' poses as they are.

    Parameters
    ----------
    model : Model
        Of the rig, with shifts of ``SHIFTS`` unless joints are fixed.
    problems : list of Problem
        In one unit.
    states : list of State
        Poses found so far. All have the coefficients to start from, those of the subject's template so far.
    losses : (k,) array
        How well each scan is explained; those far from the median are left out.
    proba : list of (n, n_parts) arrays, optional
        The segmenter's probabilities, also in half precision; without them no labels are used.
    dense : list of Problem, optional
        The same scans with more of their points, for all steps without labels.
    prior : PosePrior, optional
        What is known of poses. In these steps it holds what scans leave open, which would else follow the template, and the
        template it.
    settings : TemplateSettings, optional

    Returns
    -------
    vertices : (m, 3) array
        U^d, in rig units, welded.
    joints : (J, 3) array
    coefficients : (k,) array
        To start from next time.
    """
    settings = settings or TemplateSettings()
    keep = np.flatnonzero(likely_right(losses, settings.worst))
    dense = [(problems if dense is None else dense)[i] for i in keep]
    problems, states = [problems[i] for i in keep], [states[i] for i in keep]
    steps = GaussNewton(model, reach=settings.reach, tangential=TANGENTIAL, ridge=settings.ridge, coverage=settings.coverage)
    if proba is not None:
        for sigma in settings.sigmas:
            labels = [
                refined_labels(p.X, np.asarray(proba[i], float), model.deformed(s).vertices, model.labels, sigma, doubt=DOUBT)
                for i, p, s in zip(keep, problems, states)
            ]
            states, _ = steps.shared(problems, states, labels=labels, iterations=settings.labelled_steps)
    priors = None
    if prior is not None:
        priors = [prior.where_open(*told_angles(steps, p, s)) for p, s in zip(dense, states)]
    states, _ = steps.shared(dense, states, iterations=settings.steps, priors=priors)
    state = states[0]
    U = model.rig.vertices + model.offsets(state) if state.coefficients.any() else model.rig.vertices
    J = model.rig.joints + model.joint_offsets(state)
    U = U + _heights(model, U, J, dense, states, settings)
    return U * model.half, J * model.half, state.coefficients


def _heights(model, U, J, problems, states, settings):
    """(m, 3): how the skin moves along its normals, the joints where they are."""
    rig = model.rig
    m = len(U)
    normals = vertex_normals(U, rig.faces)
    K = smoothness_matrix(U, rig.faces)
    prior = sparse.csc_array(settings.smooth * (K.T @ K) + settings.small * sparse.diags_array(model.areas))
    h = np.zeros(m)
    on = np.flatnonzero(model.areas > _NO_AREA)  # others, of faces without area, stay where they are
    for _ in range(settings.rounds):
        H, g = sparse.csr_array((m, m)), np.zeros(m)
        for problem, state in zip(problems, states):
            A, r, w = _rows(model, U, J, h, normals, problem, state, settings.reach)
            H = H + A.T @ (A * w[:, None])
            g += A.T @ (w * r)
        n = len(problems)
        h[on] += _solved((prior + sparse.csc_array(H / n))[on][:, on], (g / n - prior @ h)[on])
    return h[:, None] * normals


def _rows(model, U, J, h, normals, problem, state, reach):
    """One scan's equations for the heights: rows (n, m), residuals and weights."""
    from scipy.spatial import cKDTree

    from ..skinning import skin

    rig = model.rig
    posed = skin(
        rig,
        state.theta,
        translation=state.translation,
        scale=state.scale,
        offsets=U + h[:, None] * normals - rig.vertices,
        joint_offsets=J - rig.joints,
    )
    V, X = posed.vertices, problem.X
    on = model.surface.closest(X, cKDTree(V).query(X)[1], V)
    r = np.einsum("na,na->n", X - on.points, on.normals)
    e2 = np.einsum("na,na->n", X - on.points, X - on.points)
    turned = posed.scale * np.einsum("iab,ib->ia", posed.turns(), normals)
    slope = on.barycentric * np.einsum("nka,na->nk", turned[on.corners], on.normals)
    row = np.repeat(np.arange(len(X)), 3)
    A = sparse.csr_array((slope.ravel(), (row, on.corners.ravel())), shape=(len(X), len(U)))
    return A, r, problem.shares / (1.0 + e2 / reach**2) ** 2


def _solved(H, g):
    from scipy.sparse.linalg import spsolve

    return spsolve(sparse.csc_matrix(H), g)
