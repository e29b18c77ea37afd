"""The scans that a round trains on: poses that were inferred among uniform ones, on the templates that were found."""

import numpy as np
import pytest

from lbsfit_np.learning.mixture import Mixture
from lbsfit_np.synthesis import Synthesis


@pytest.fixture(scope="module")
def mixture(tube_rig, people):
    poses = np.random.default_rng(0).uniform(tube_rig.lower, tube_rig.upper, (5, 4, 3))
    poses[:, 0] = np.random.default_rng(1).uniform(-2.5, 2.5, (5, 3))  # the root turns freely
    settings = Synthesis(n_points=60, shape=0.0)
    return Mixture(tube_rig, settings, poses, tuple((s.vertices, s.joints) for s in people.values()), 0, 1)


def test_half_the_training_poses_are_inferred_ones_with_noise(tube_rig, mixture):
    poses = np.array([mixture.scan(i).pose for i in range(200)])
    away = np.abs(poses[:, None, 1:] - mixture.poses[None, :, 1:]).max(axis=(2, 3))
    near = away.min(axis=1) <= 0.15 + 1e-12
    assert 0.4 < near.mean() < 0.6
    others = slice(1, None)
    assert (poses[:, others] >= tube_rig.lower[others]).all() and (poses[:, others] <= tube_rig.upper[others]).all()
    outside = (np.abs(poses[:, 0]) > 0.6).any(axis=1)  # the root's limits are ±0.6: only an inferred root goes beyond
    assert outside[near].mean() > 0.8 and not outside[~near].any()
    whose = away.argmin(axis=1)[near]
    root = np.abs(poses[near, None, 0] - mixture.poses[None, :, 0]).max(axis=2)
    assert (root.min(axis=1) <= 0.15 + 1e-12).all()
    assert (root.argmin(axis=1) != whose).any() and set(whose) == set(range(5))  # any pose with any facing
    noise = (poses[near] - mixture.poses[whose])[:, 1:]
    assert np.abs(noise).max() > 0.1


def test_poses_are_those_of_the_scans(mixture):
    for i in range(6):
        np.testing.assert_array_equal(mixture.pose(i), mixture.scan(i).pose)
    assert len({mixture.pose(i).tobytes() for i in range(6)}) == 6


def test_training_scans_are_made_of_the_templates(tube_rig, people, mixture):
    made = [mixture.scan(i) for i in range(40)]
    which = [[np.array_equal(s.template, t.vertices) for t in people.values()] for s in made]
    assert np.sum(which, axis=1).tolist() == [1] * 40 and 8 < np.sum(which, axis=0)[0] < 32
    plain = Mixture(tube_rig, mixture.settings, mixture.poses, (), 0, 1).scan(0)
    np.testing.assert_array_equal(plain.template, tube_rig.vertices)


def test_some_variation_of_shape_stays(tube_rig, people, mixture):
    def spread(templates):
        made = Mixture(tube_rig, Synthesis(n_points=60, shape=0.1), mixture.poses, templates, 0, 1)
        base = templates[0][0] if templates else tube_rig.vertices
        return np.mean([np.linalg.norm(made.scan(i).template - base, axis=1).mean() for i in range(20)])

    on_templates, on_the_rig = spread(mixture.templates[:1]), spread(())
    assert 0.15 * on_the_rig < on_templates < 0.5 * on_the_rig


def test_without_inferred_poses_all_are_uniform(tube_rig, mixture):
    made = Mixture(tube_rig, mixture.settings, np.empty((0, 4, 3)), (), 0, 1)
    poses = np.array([made.scan(i).pose for i in range(50)])
    assert (poses >= tube_rig.lower).all() and (poses <= tube_rig.upper).all()


def test_the_same_number_is_the_same_scan(tube_rig, mixture):
    for i in (0, 7):
        (x, labels, unit), again = mixture(i), mixture(i)
        np.testing.assert_array_equal(x, again[0])
        np.testing.assert_array_equal(labels, again[1])
        assert unit == 1.0
    others = [mixture, Mixture(tube_rig, mixture.settings, mixture.poses, mixture.templates, 0, 2)]
    others.append(Mixture(tube_rig, mixture.settings, mixture.poses, mixture.templates, 1, 1))
    first = [m.scan(0).points for m in others]
    assert not np.array_equal(first[0], first[1]) and not np.array_equal(first[0], first[2])
