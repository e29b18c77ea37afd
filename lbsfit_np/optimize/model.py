"""Model: a rig made ready for fitting, in the normalised frame; made once, shared by all scans."""

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ..skinning import skin
from ..triangles import areas_around, inside_out
from .smoothness import smoothness_matrix
from .state import State
from .surface import Surface, clear_vertices, vertex_normals

__all__ = ["Model", "farthest_points"]

# The pose stages, and steps that look far, look at about so many vertices at most: a pose has some tens of unknowns, and time
# goes with vertices. The second number is for starts from labels. Each part keeps as many as the third says, or all that it has.
_COARSE, _COARSEST, _OF_A_PART = 2500, 1000, 4
# A mesh is fine that has so many vertices, no longer edge than this, half sizes (the longest of bundled rigs that are fine has
# 0.09), and no larger share of vertices with triangles that face several ways.
_FINE, _LONGEST_EDGE, _UNCLEAR = 1000, 0.1, 0.02
# Dense weights of more numbers than this are not kept.
_DENSE = 5_000_000


class Model:
    """A welded rig whose longest half-extent is 1, its proportions, and its vertices thinned for the pose stages.

    Parameters
    ----------
    rig : Rig
    joints : {"follow", "fixed"}, default "follow"
        Whether rest joints follow the skin, by the regressor; girths move none either way.
    shifts : float, default 0
        Where positive, the family has three more coefficients a joint below the root, which move its rest position alone by
        this many half sizes a unit. One scan cannot tell where in the flesh a joint lies; many poses of one subject can.
    half : float, optional
        What the normalised frame's unit is, in rig units; half the rig's size by default. Templates of several subjects of one
        rig are looked at in the rig's own unit, so that weights mean the same for all.
    shared : bool, default False
        Whether the rig is the template that a subject's scans share: joints follow that, and a residual, which is one scan's,
        moves none.
    """

    def __init__(self, rig, joints="follow", *, shifts=0.0, half=None, shared=False):
        self.source = rig
        self.half = rig.size / 2 if half is None else half
        self.rig = _outward(rig.welded.scaled(1.0 / self.half))
        self.follow = joints == "follow"
        self._residual_moves_joints = self.follow and not shared
        self.labels = self.rig.vertex_labels
        family = self.rig.proportions
        self._shifts = _shifts(self.rig, shifts) if shifts else np.empty((3 * len(rig.parents), 0))
        self.n_proportions = family.basis.shape[2]
        moves_skin = [b.reshape(3 * len(b), b.shape[2]) for b in (family.basis, family.girths)]
        self.basis = np.hstack([*moves_skin, np.zeros((len(moves_skin[0]), self._shifts.shape[1]))])
        self.n_coefficients = self.basis.shape[1]
        self._whole = True

    @cached_property
    def joint_basis(self):
        """(3J, k): how the rest joints move with the coefficients: R b_k of proportions, or a shift of their own."""
        k, moved = self.n_proportions, np.zeros((len(self._shifts), self.n_coefficients))
        if self.follow:
            moved[:, :k] = (self.rig.regressor @ self.basis[:, :k].reshape(len(self.rig.vertices), -1)).reshape(-1, k)
        moved[:, self.n_coefficients - self._shifts.shape[1] :] = self._shifts
        return moved

    @cached_property
    def K(self):
        """K of the template, see :func:`smoothness_matrix`."""
        return smoothness_matrix(self.rig.vertices, self.rig.faces)

    @cached_property
    def areas(self):
        """(m,) share of the surface that each vertex stands for."""
        share = areas_around(self.rig.vertices, self.rig.faces)
        return share / max(share.sum(), np.finfo(float).tiny)

    @cached_property
    def own_areas(self):
        """(m,) the same; of a thinned model what its vertices stand for among all of the whole one."""
        return self.areas

    @cached_property
    def surface(self):
        """The template's triangles, and where to look for the closest one."""
        return Surface(self.rig.vertices, self.rig.faces, self.labels)

    @cached_property
    def normals(self):
        """(m, 3) unit normals of the template's vertices."""
        return vertex_normals(self.rig.vertices, self.rig.faces)

    @cached_property
    def _dense_weights(self):
        return self.rig.weights.toarray() if np.prod(self.rig.weights.shape) <= _DENSE else None

    def weights_of(self, rows):
        """(r, J) skinning weights of some vertices, dense: steps ask again and again, which takes long of sparse ones."""
        return self.rig.weights[rows].toarray() if self._dense_weights is None else self._dense_weights[rows]

    @cached_property
    def is_fine(self):
        """Whether planes at the vertices of ``coarse`` tell as much as triangles to steps that look far.

        There are many vertices, no edge is long, and triangles at a vertex face one way: else its normal says nothing.
        """
        vertices, faces = self.rig.vertices, self.rig.faces
        edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
        if len(vertices) < _FINE or np.linalg.norm(edges, axis=2).max(initial=0.0) > _LONGEST_EDGE:
            return False
        return bool(clear_vertices(vertices, faces).mean() >= 1.0 - _UNCLEAR)

    @cached_property
    def _farthest(self):
        """Rows of vertices, as many as the pose stages look at: the first of them are those that fewer would be."""
        return farthest_points(self.rig.vertices, min(len(self.rig.vertices), _COARSE))

    def spread(self, n):
        """(n,) rows of vertices spread evenly, ascending; all of them where there are no more."""
        if n >= len(self.rig.vertices):
            return np.arange(len(self.rig.vertices))
        rows = self._farthest if n <= len(self._farthest) else farthest_points(self.rig.vertices, n)
        return np.sort(rows[:n])

    @cached_property
    def coarse(self):
        """The model on evenly spread vertices, for stages and steps without a residual; itself where the rig is small."""
        return self._thinned(_COARSE)

    @cached_property
    def coarsest(self):
        """The same on fewer vertices, for starts that steps go on from."""
        return self._thinned(_COARSEST)

    def _thinned(self, most):
        m = len(self.rig.vertices)
        if m <= most:
            return self
        rows = self._with_all_parts(self.spread(most))
        from scipy.spatial import cKDTree

        nearest = cKDTree(self.rig.vertices[rows]).query(self.rig.vertices)[1]
        no_regressor = sparse.csr_array((len(self.rig.parents), len(rows)))
        thin = self._at(rows, faces=np.empty((0, 3), dtype=int), regressor=no_regressor)
        thin._whole = False
        thin.__dict__["normals"] = self.normals[rows]
        thin.__dict__["own_areas"] = self.areas[rows]
        thin.__dict__["areas"] = np.bincount(nearest, self.areas, minlength=len(rows))
        return thin

    def without(self, gone):
        """The model without some of its skin, whose joints and proportions move as with all of it.

        Parameters
        ----------
        gone : (m,) bool array
            Vertices; triangles at these go along, and vertices that have no other triangles.

        Returns
        -------
        Model or None
            None where no triangle would be left.
        gone : (m,) bool array
            All vertices that it is without.
        """
        faces = self.rig.faces[~gone[self.rig.faces].any(axis=1)]
        if not len(faces):
            return None, gone
        before, after = np.zeros((2, len(gone)), dtype=bool)
        before[self.rig.faces], after[faces] = True, True
        gone = gone | (before & ~after)
        rows, new = np.flatnonzero(~gone), np.cumsum(~gone) - 1
        return self._at(rows, faces=new[faces], regressor=sparse.csr_array(self.rig.regressor.tocsc()[:, rows])), gone

    def _at(self, rows, **of_rig):
        """The model on some of its vertices; what is the same in all of them is shared."""
        some = object.__new__(Model)
        some.source, some.half, some.follow = self.source, self.half, self.follow
        some._residual_moves_joints, some._whole = self._residual_moves_joints, self._whole
        some.n_coefficients, some.n_proportions, some._shifts = self.n_coefficients, self.n_proportions, self._shifts
        some.rig = replace(
            self.rig, vertices=self.rig.vertices[rows], weights=sparse.csr_array(self.rig.weights[rows]), **of_rig
        )
        some.labels = self.labels[rows]
        some.basis = np.ascontiguousarray(self.basis.reshape(len(self.labels), 3, -1)[rows].reshape(3 * len(rows), -1))
        some.__dict__["joint_basis"] = self.joint_basis
        return some

    def _with_all_parts(self, rows):
        """Rows, with more of parts that have hardly any, such as fingers of a body: points with their labels would be lost."""
        count, more = np.bincount(self.labels[rows], minlength=len(self.rig.parts)), []
        for part in np.flatnonzero(count < _OF_A_PART):
            own = np.flatnonzero(self.labels == part)
            more.append(own[farthest_points(self.rig.vertices[own], min(len(own), _OF_A_PART))])
        return np.unique(np.concatenate([rows, *more])) if more else rows

    def rest(self):
        """The rest pose at the origin, moved inside the joint limits."""
        theta = np.clip(0.0, self.rig.lower, self.rig.upper)
        theta[self.rig.root] = 0.0
        return State(theta, np.zeros(3), 1.0, np.zeros(self.n_coefficients), None)

    def offsets(self, state):
        """(m, 3) U^d − U of a state; None where it is 0."""
        bones = (self.basis @ state.coefficients).reshape(-1, 3) if state.coefficients.any() else None
        rest = state.residual if state.displacement is None else state.displacement
        if rest is None:
            return bones
        return rest if bones is None else bones + rest

    def pose(self, state):
        """(V^d, V): the posed deformed and undeformed templates, as Posed; one object where there are no offsets."""
        V = skin(self.rig, state.theta, translation=state.translation, scale=state.scale)
        offsets = self.offsets(state)
        return V if offsets is None else self._deformed(state, offsets), V

    def deformed(self, state):
        """V^d alone: the posed deformed template, as Posed."""
        return self._deformed(state, self.offsets(state))

    def _deformed(self, state, offsets):
        place = {"translation": state.translation, "scale": state.scale}
        if offsets is None:
            return skin(self.rig, state.theta, **place)
        return skin(self.rig, state.theta, **place, offsets=offsets, joint_offsets=self.joint_offsets(state))

    def joint_offsets(self, state):
        """(J, 3): how far the rest joints of a state's template lie from the rig's."""
        moved = (self.joint_basis @ state.coefficients).reshape(-1, 3)
        if self._residual_moves_joints and state.residual is not None:
            moved = moved + self.rig.regressor @ state.residual
        return moved

    def offset_gradients(self, g, grad_offsets):
        """Gradients to the coefficients and to the residual.

        Parameters
        ----------
        g : SkinGradient
            Of V^d.
        grad_offsets : (m, 3) array
            Direct gradient to the offsets, on top.
        """
        to_vertices = g.vertices + grad_offsets
        coefficients = self.basis.T @ to_vertices.ravel() + self.joint_basis.T @ g.rest_joints.ravel()
        if not self._whole:
            return coefficients, None
        if self._residual_moves_joints:
            to_vertices = to_vertices + self.rig.regressor_transposed @ g.rest_joints
        return coefficients, to_vertices


def _outward(rig):
    """The rig with its faces turned outwards, by the sign of the volume: views of one side tell what is hidden by these."""
    return replace(rig, faces=rig.faces[:, ::-1]) if inside_out(rig.vertices, rig.faces) else rig


def _shifts(rig, size):
    """(3J, k): unit shifts, ``size`` long, of the joints whose place matters: moving ones below the root."""
    free = rig.moving.copy()
    free[rig.root] = False
    return size * np.eye(3 * len(rig.parents))[:, np.repeat(free, 3)]


def farthest_points(points, n):
    """(n,) rows of points spread evenly, none twice: row 0, and each next one the farthest from those before it."""
    rows = np.zeros(n, dtype=int)
    x, y, z = np.ascontiguousarray(points.T)
    d2 = np.full(len(points), np.inf)
    for k in range(1, n):
        at = rows[k - 1]
        np.minimum(d2, (x - x[at]) ** 2 + (y - y[at]) ** 2 + (z - z[at]) ** 2, out=d2)
        d2[at] = -1.0  # below that of others at the same place, such as on sheets that touch
        rows[k] = d2.argmax()
    return rows
