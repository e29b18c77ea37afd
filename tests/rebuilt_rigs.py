"""Whether a rig that was built again is the shipped one."""

import numpy as np

from lbsfit_np.correspondence import at_places, surface_places
from lbsfit_np.io.rigs import load_rig


def assert_rebuilt(made, shipped):
    """The same bytes; or, as other processors round otherwise and remeshing goes other ways from there, the same rig."""
    if made.read_bytes() != shipped.read_bytes():
        assert_alike(load_rig(made), load_rig(shipped))


def assert_alike(made, shipped):
    """The same skeleton to the last digits, and the same skin: other vertices on it, of the same weights and shapes."""
    for name in ("joint_names", "parts", "joints", "frames", "lower", "upper", "parents"):
        np.testing.assert_array_equal(getattr(made, name), getattr(shipped, name))
    assert abs(len(made.vertices) - len(shipped.vertices)) < 0.01 * len(shipped.vertices)
    edge = np.linalg.norm(shipped.vertices[shipped.faces[:, 0]] - shipped.vertices[shipped.faces[:, 1]], axis=1).mean()
    for a, b in ((made, shipped), (shipped, made)):
        corners, barycentric = surface_places(a.vertices, b.vertices, b.faces)
        off = np.linalg.norm(at_places(corners, barycentric, b.vertices) - a.vertices, axis=1)
        assert off.mean() < 0.01 * edge and np.quantile(off, 0.99) < 0.2 * edge
        weights = np.einsum("vk,vkj->vj", barycentric, b.weights.toarray()[corners])
        assert np.abs(weights - a.weights.toarray()).sum(axis=1).mean() < 0.01
        for ours, theirs in zip(a.shapes.vertices, b.shapes.vertices, strict=True):
            assert np.linalg.norm(at_places(corners, barycentric, theirs) - ours, axis=1).mean() < 0.1 * edge
