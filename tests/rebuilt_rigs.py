"""What builds the bundled rigs, and whether one that was built again is the shipped one."""

import importlib

import numpy as np

from lbsfit_np.correspondence import at_places, surface_places
from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.rigs import load_rig

# What is of the remeshed surface; all else comes from tables, and processors differ by rounding alone.
OF_THE_SURFACE = {"vertices", "faces", "shapes_vertices"}
OF_THE_SURFACE |= {f"{matrix}_{part}" for matrix in ("weights", "regressor") for part in ("data", "indices", "indptr")}


def rig_module(name):
    """A module of rigs/, which is lbsfit_np.rigs once installed and rigs in a checkout."""
    try:
        return importlib.import_module(f"lbsfit_np.rigs.{name}")
    except ModuleNotFoundError as error:
        if error.name not in ("lbsfit_np.rigs", f"lbsfit_np.rigs.{name}"):
            raise
        return importlib.import_module(f"rigs.{name}")


def assert_rebuilt(made, shipped):
    """The same bytes; or, as other processors round otherwise and remeshing goes other ways from there, the same rig."""
    if made.read_bytes() == shipped.read_bytes():
        return
    ours, theirs = read_npz(made), read_npz(shipped)
    assert set(ours) == set(theirs) and set(ours) >= OF_THE_SURFACE
    for key in set(ours) - OF_THE_SURFACE:
        assert ours[key].dtype == theirs[key].dtype and ours[key].shape == theirs[key].shape, key
        if ours[key].dtype.kind == "f":
            np.testing.assert_allclose(ours[key], theirs[key], rtol=1e-12, atol=1e-14, equal_nan=False, err_msg=key)
        else:
            np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)
    assert_alike(load_rig(made), load_rig(shipped))


def assert_alike(made, shipped):
    """The same skin: other vertices on it, of the same weights and shapes, faces that look the same way, the same joints."""
    assert abs(len(made.vertices) - len(shipped.vertices)) < 0.01 * len(shipped.vertices)
    edge = np.linalg.norm(shipped.vertices[shipped.faces[:, 0]] - shipped.vertices[shipped.faces[:, 1]], axis=1).mean()
    for a, b in ((made, shipped), (shipped, made)):
        assert len(a.faces) == 2 * len(a.vertices) - 4  # closed, without handles
        corners, barycentric = surface_places(a.vertices, b.vertices, b.faces)
        off = np.linalg.norm(at_places(corners, barycentric, b.vertices) - a.vertices, axis=1)
        assert off.mean() < 0.01 * edge and np.quantile(off, 0.99) < 0.2 * edge
        weights = np.einsum("vk,vkj->vj", barycentric, b.weights.toarray()[corners])
        assert np.abs(weights - a.weights.toarray()).sum(axis=1).mean() < 0.01
        for ours, theirs in zip(a.shapes.vertices, b.shapes.vertices, strict=True):
            assert np.linalg.norm(at_places(corners, barycentric, theirs) - ours, axis=1).mean() < 0.1 * edge
        middles, normals = a.vertices[a.faces].mean(axis=1), _normals(a.vertices, a.faces)
        across = _normals(b.vertices, surface_places(middles, b.vertices, b.faces)[0])
        assert np.mean((normals * across).sum(axis=1) > 0.7) > 0.99
        assert np.abs(a.regressor @ a.vertices - a.joints).max() < 1e-9 * edge


def _normals(vertices, corners):
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    return n / np.linalg.norm(n, axis=1, keepdims=True)
