"""How the bundled body's files are made: built again they are the shipped ones; the tools that make the surface."""

import numpy as np
import pytest
from rebuilt_rigs import assert_rebuilt, rig_module

from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.rigs import read_rig_data

build_body, checks, implicit, remesh, rig_file = map(rig_module, ("build_body", "checks", "implicit", "remesh", "rig_file"))


def _built_here(name):
    """The path of a shipped rig that the libraries installed here have built."""
    pytest.importorskip("skimage", reason="building rigs needs the extra 'build'")
    path = read_rig_data(name).path
    built_with = str(read_npz(path)["built_with"])
    if built_with != rig_file.library_versions():
        pytest.skip(f"the shipped file was built with {built_with}")
    return path


@pytest.fixture(scope="module")
def polygonised():
    """``polygonise``, which both levels begin with, done once for all that ask for the same."""
    known = {}

    def once(distance, *box_and_cell, blocks):
        key = repr((box_and_cell, blocks))  # the skin is the same in both
        if key not in known:
            known[key] = implicit.polygonise(distance, *box_and_cell, blocks=blocks)
        return tuple(array.copy() for array in known[key])

    return once


@pytest.mark.study
@pytest.mark.parametrize("name", ["body", "body-coarse"])
def test_rebuilding_gives_the_shipped_file(name, polygonised, tmp_path, monkeypatch):
    path = _built_here(name)
    monkeypatch.setattr(build_body, "polygonise", polygonised)
    build_body.build(name, tmp_path)
    assert_rebuilt(tmp_path / f"{name}.npz", path)


@pytest.mark.slow
def test_the_shipped_file_is_what_its_surface_gives(tmp_path, monkeypatch):
    """Weights, regressor and shapes of the shipped surface, whose edges are as long as asked for.

    Other processors remesh otherwise, and what is rebuilt there is only alike; of the same surface all else is the same anywhere.
    """
    name = "body"
    path = _built_here(name)
    shipped = read_npz(path)
    right = shipped["vertices"][:, 0] >= 0
    half = shipped["vertices"][right], (np.cumsum(right) - 1)[shipped["faces"][right[shipped["faces"]].all(axis=1)]]
    asked = []
    monkeypatch.setattr(build_body, "polygonise", lambda *a, **k: (None, None))
    monkeypatch.setattr(build_body, "remesh", lambda skin, points, faces, edge_length, rounds: asked.append(edge_length) or half)
    build_body.build(name, tmp_path)
    made = read_npz(tmp_path / f"{name}.npz")
    assert list(made) == list(shipped)
    for key, array in shipped.items():
        assert made[key].dtype == array.dtype and made[key].shape == array.shape, key
        if array.dtype.kind == "f":  # other processors round otherwise
            assert made[key] == pytest.approx(array, abs=1e-9), key
        else:
            assert np.array_equal(made[key], array), key
    p = half[0][half[1]]
    q = np.roll(p, 1, axis=1)
    ratio = np.linalg.norm(p - q, axis=2) / asked[0](((p + q) / 2).reshape(-1, 3)).reshape(-1, 3)
    assert 0.9 < np.median(ratio) < 1.1 and np.quantile(ratio, 0.99) < 4 / 3


# ---- the tools ----


def _ball(points):
    return np.linalg.norm(points - [0, 0.01, 0.02], axis=1) - 0.05


def test_polygonising_by_blocks_gives_the_same_surface():
    pytest.importorskip("skimage", reason="building rigs needs the extra 'build'")
    box = np.array([-0.06, -0.05, -0.04]), np.array([0.06, 0.07, 0.08])
    plain, blocks = (implicit.polygonise(_ball, *box, 0.004, blocks=b) for b in (1, 4))
    assert plain[0] == pytest.approx(blocks[0], abs=1e-12) and np.array_equal(plain[1], blocks[1])


def test_half_a_ball_is_remeshed_up_to_its_mirror():
    pytest.importorskip("skimage", reason="building rigs needs the extra 'build'")
    half = implicit.polygonise(_ball, np.array([0.0, -0.05, -0.04]), np.array([0.06, 0.07, 0.08]), 0.004)
    vertices, faces = remesh.remesh(_ball, *half, lambda p: np.full(len(p), 0.012))
    assert (vertices[:, 0] >= 0).all() and np.count_nonzero(vertices[:, 0] == 0) > 15
    whole, triangles = build_body.mirrored(vertices, faces)
    assert checks.edge_uses(triangles) == (1, True) and checks.euler_characteristic(triangles) == 2
    assert np.abs(_ball(whole)).max() < 1e-9
    p = whole[triangles]
    edges = np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2)
    assert edges.max() < 2.2 * edges.min()
