"""The animations of glTF files as angles about the joints' own axes."""

import numpy as np
import pytest
from gltf_files import (
    ANGLES,
    ARM,
    POSED,
    TILTED,
    Z_UP,
    animated_arm,
    free_rig,
    quaternions,
    save,
    write_arm,
)
from scipy.spatial.transform import Rotation

from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.io.gltf_buffers import open_gltf
from lbsfit_np.io.gltf_nodes import NodeGraph


@pytest.mark.parametrize("interpolation", ["LINEAR", "STEP", "CUBICSPLINE"])
@pytest.mark.parametrize("armature", [TILTED, TILTED @ np.diag([-1.0, 1, 1, 1])])
def test_angles_of_animations(tmp_path, interpolation, armature):
    """Angles written about the joints' own axes come back; halfway between keys by each interpolation's rule."""
    data = read_gltf(save(animated_arm(interpolation, armature), tmp_path))
    got = data.animated
    assert got.shape == (7, 5, 3)
    # The armature is the root's parent: where it is rotated, the root's angles are still those about its own axes.
    assert np.allclose(got[::2], ANGLES, atol=1e-5)
    for j in range(5):
        before, after = quaternions(ANGLES[:-1, j], j), quaternions(ANGLES[1:, j], j)
        if interpolation == "STEP":
            middle = before
        elif interpolation == "CUBICSPLINE":
            middle = before + after  # flat tangents: ½, ½, normalised
        else:
            middle = before + np.sign(np.einsum("ia,ia->i", before, after))[:, None] * after  # the middle of the arc
        rest = Rotation.from_matrix(ARM.local[j, :3, :3])
        expected = (rest.inv() * Rotation.from_quat(middle)).as_matrix()
        assert np.allclose(Rotation.from_rotvec(got[1::2, j]).as_matrix(), expected, atol=1e-5)
    assert not any("animations" in n for n in data.notes)


def test_linear_takes_the_short_way_and_signs_do_not_matter(tmp_path):
    plain = read_gltf(save(animated_arm(), tmp_path)).animated
    flipped = read_gltf(save(animated_arm(signs=(1, -1, -1, 1)), tmp_path)).animated
    assert np.allclose(plain, flipped, atol=1e-5)


def test_interpolation_away_from_the_middle(tmp_path):
    """A cubic spline gives x = t³ − t + 1 exactly from its slopes; a slerp turns evenly, whatever the quaternions' signs."""
    writer = write_arm(ARM)
    junk = [99.0, 99, 99]  # the first in-tangent and the last out-tangent are never used
    cubic = np.array([junk, [1, 0, 0], [-1, 0, 0], [2, 0, 0], [1, 0, 0], [2, 0, 0], [11, 0, 0], [7, 0, 0], junk])
    turning = quaternions([[0, 0, 0], [0, 0, 2.5]], 1) * [[1], [-1]]
    still = quaternions(np.zeros((3, 3)), 2)
    writer.animation(
        [
            (0, "translation", [0.0, 1.0, 2.0], cubic, "CUBICSPLINE"),
            (1, "rotation", [0.0, 2.0], turning, "LINEAR"),
            (2, "rotation", [0.0, 0.3, 1.5], still, "STEP"),
        ]
    )
    path = save(writer, tmp_path)
    times = np.array([0.0, 0.15, 0.3, 0.65, 1.0, 1.25, 1.5, 1.75, 2.0])
    worlds = NodeGraph(open_gltf(path)).animated_worlds([0, 1, 2], 100)
    assert np.allclose(worlds[:, 0, 0, 3], times**3 - times + 1, atol=1e-6)
    assert np.allclose(read_gltf(path).animated[:, 1], times[:, None] * [0, 0, 1.25], atol=1e-5)


@pytest.mark.parametrize("options", [{"posed": POSED}, {"posed": POSED, "armature_T_bind": Z_UP}])
def test_angles_do_not_depend_on_the_node_pose(tmp_path, options):
    """Angles are relative to the bind pose, whatever pose the nodes stand in; the root's only where bind space is placed."""
    data = read_gltf(save(animated_arm(**options), tmp_path))
    assert np.allclose(data.animated[::2, 1:], ANGLES[:, 1:], atol=1e-5)


@pytest.mark.parametrize("armature", [TILTED, TILTED @ np.diag([1.0, -1, 1, 1])])
def test_angles_where_bind_space_is_kept(tmp_path, armature):
    """The root's angles are then told from the pose that the nodes stand in: played back, that pose is not turned as a whole."""
    writer = write_arm(ARM, armature=armature, armature_T_bind=Z_UP, posed=POSED)
    writer.animation([(3, "rotation", [0.0], quaternions(POSED[3:4], 3), "LINEAR")])
    data = read_gltf(save(writer, tmp_path))
    assert data.up is None and data.animated.shape == (1, 5, 3)
    posed = free_rig(data).pose(data.animated[0])
    turned, _ = Rotation.align_vectors(posed - posed.mean(axis=0), data.vertices - data.vertices.mean(axis=0))
    assert turned.magnitude() < 1e-4
    assert np.allclose(data.animated[0, 1:], POSED[1:], atol=1e-5)


def test_animations_are_thinned_evenly(tmp_path):
    writer = write_arm(ARM)
    times = np.arange(400) / 30
    for j in (1, 2):
        values = quaternions(np.outer(times / times[-1], [1.0, 0, 0]), j)
        writer.animation([(j, "rotation", times, values, "LINEAR")])
    animated = read_gltf(save(writer, tmp_path)).animated
    assert animated.shape == (500, 5, 3)
    turning = animated[:, 1, 0] + animated[:, 2, 0]
    half = turning[: len(turning) // 2]
    assert turning[0] == pytest.approx(0, abs=1e-5) and turning[-1] == pytest.approx(1, abs=1e-5)
    assert np.allclose(np.diff(half), 1 / 250, atol=2e-3)


def test_animations_that_move_or_scale_joints_are_noted(tmp_path):
    writer = write_arm(ARM)
    away = ARM.local[2, :3, 3] + [[0, 0, 0], [0.3, 0, 0]]
    writer.animation([(2, "translation", [0.0, 1.0], away, "LINEAR"), (3, "scale", [0.0, 1.0], [[1, 1, 1], [1, 1.5, 1]], "STEP")])
    writer.animation([(len(ARM.names), "rotation", [0.0, 1.0], [[0, 0, 0, 1]] * 2, "LINEAR")])  # the mesh's node: nothing to us
    data = read_gltf(save(writer, tmp_path))
    assert data.animated.shape == (3, 5, 3) and np.allclose(data.animated, 0, atol=1e-5)
    notes = "; ".join(data.notes)
    assert "'lower' the furthest (by 20 %" in notes and "scale 1 joint(s), 'tip'" in notes


def test_quantised_rotations_and_ignored_channels(tmp_path):
    writer = write_arm(ARM)
    angle = 1.0
    stored = np.round(quaternions([[0, 0, 0], [angle, 0, 0]], 1) * 32767)
    sampler = {"input": writer.accessor([0.0, 1.0]), "output": writer.accessor(stored, "i2", normalized=True)}
    channels = [
        {"sampler": 0, "target": {"node": 1, "path": "rotation"}},
        {"sampler": 0, "target": {"path": "rotation"}},
        {"sampler": 0, "target": {"node": 1, "path": "weights"}},
    ]
    writer.add("animations", samplers=[sampler], channels=channels)
    got = read_gltf(save(writer, tmp_path)).animated
    assert np.allclose(got[:, 1], [[0, 0, 0], [angle / 2, 0, 0], [angle, 0, 0]], atol=2e-4)
