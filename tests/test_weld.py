"""Welding: what is one point of a rig's surface is one on its changed templates, too, wherever these put it."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import make_tube_data, with_loose_vertices

import lbsfit_np as lbs
from lbsfit_np.errors import FileError
from lbsfit_np.io.npz import npz_keys, read_npz
from lbsfit_np.io.write import write_npz
from lbsfit_np.learning.new_scan import _as_the_rig_says
from lbsfit_np.learning.parameters import learned_with
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.weld import weld_of


def split_rig(gap):
    """The tube with one vertex of the arm twice, for some of its faces, so many millionths of the size apart; and a loose one."""
    data = make_tube_data()
    vertices, faces, m = data.vertices, data.faces.copy(), len(data.vertices)
    v = np.argmin(np.linalg.norm(vertices - vertices.mean(axis=0) - [0.1, -0.25, 0.06], axis=1))
    some = np.flatnonzero((faces == v).any(axis=1))[:2]
    faces[some] = np.where(faces[some] == v, m, faces[some])
    away = [gap * 1e-6 * np.ptp(vertices, axis=0).max(), 0, 0]
    weights = sparse.csr_array(data.weights)
    weights = sparse.csr_array(sparse.vstack([weights, weights[[v]]]))
    data = replace(data, vertices=np.vstack([vertices, vertices[v] + away]), faces=faces, weights=weights)
    return build_rig(with_loose_vertices(data, np.array([[0.0, 1.0, 0.0]])))


def thinner(rig, share=0.8):
    return rig.with_template(rig.vertices * [share, 1, share], rig.joints * [share, 1, share])


def drawn_apart(rig):
    """A template on which the copy has moved."""
    vertices = rig.vertices.copy()
    vertices[-1] += 0.01
    return rig.with_template(vertices)


def assert_welded_alike(a, b):
    for name in ("weld", "loose", "welded_from"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    np.testing.assert_array_equal(a.welded.faces, b.welded.faces)


@pytest.mark.parametrize("gap, change", [(1.1, thinner), (0.5, drawn_apart)])
def test_templates_are_welded_as_their_rig(gap, change, tmp_path):
    rig = split_rig(gap)
    changed = change(rig)
    own = weld_of(changed.vertices, changed.weights, changed.faces)
    assert len(own.first) != len(rig.welded_from)  # which is what would come of it welded anew
    assert_welded_alike(changed, rig)
    for other in (changed.scaled(3.0), changed.mirrored(), changed.with_parts("arm and fingers"), changed.subject(1)):
        np.testing.assert_array_equal(other.weld, rig.weld)
    assert len(changed.welded.welded.vertices) == len(rig.welded_from)
    assert_welded_alike(pickle.loads(pickle.dumps(changed)), rig)
    assert_welded_alike(_as_the_rig_says(replace(rig, up="-y"), changed), rig)  # as before fits with a model
    changed.save(tmp_path / "changed.npz")
    assert_welded_alike(lbs.load_rig(tmp_path / "changed.npz"), rig)
    rig.save(tmp_path / "rig.npz")
    assert "weld" in npz_keys(tmp_path / "changed.npz") and "weld" not in npz_keys(tmp_path / "rig.npz")


def test_a_broken_weld_is_told(tmp_path):
    thinner(split_rig(1.1)).save(tmp_path / "rig.npz")
    arrays = read_npz(tmp_path / "rig.npz")
    numbers = arrays["weld"]
    assert numbers[0] < 0 <= numbers[1:].min()
    far = np.where(numbers < 0, -9999, numbers)
    for broken in (numbers[1:], numbers + 0.5, numbers[::-1], numbers + 1, far, 0 * numbers - 1):
        write_npz(tmp_path / "broken.npz", **arrays | {"weld": broken})
        with pytest.raises(FileError, match="'weld'"):
            lbs.load_rig(tmp_path / "broken.npz")


@pytest.mark.usefixtures("hurried")
def test_scans_are_fitted_on_templates_whose_vertices_come_together():
    rig = split_rig(1.1)
    cloud = lbs.synthesize(rig, 1, random_state=1, n_points=300)[0].points
    fitter = lbs.LBSFitter(rig, effort="fast", training_scans=40, training={"n_points": 200}, random_state=0, variant="cd")
    fitter.pretrain()
    fitter.template_, fitter.unit_, fitter.learned_unit_ = {0: thinner(rig)}, {0: 1.0}, None
    fitter._learned_with = learned_with(fitter)
    result = fitter.fit_scan(cloud, subject=0, theta0=np.zeros((4, 3)))
    assert np.isfinite(result.vertices).all() and result.vertices.shape == rig.vertices.shape
