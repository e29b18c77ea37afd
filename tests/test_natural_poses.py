"""Natural poses: near the library, within the limits, and chosen by name in synthesis."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np import load_rig, natural_poses, synthesize
from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rotations import matrix_from_rotvec, rotvec_from_matrix


@pytest.fixture(scope="module")
def hand():
    return load_rig("hand")


def test_within_limits_and_locked_axes_at_rest(hand):
    poses = natural_poses(hand, 500, random_state=0)
    assert poses.shape == (500, 16, 3)
    assert (poses[:, 1:] >= hand.lower[1:]).all() and (poses[:, 1:] <= hand.upper[1:]).all()
    assert not poses[:, 1:][:, hand.lower[1:] == hand.upper[1:]].any()


def test_half_are_near_a_pose_and_the_rest_between_two(hand):
    poses = natural_poses(hand, 400, random_state=1)[:, 1:]
    library = np.stack(list(hand.poses.values()))[:, 1:]
    free = hand.upper[1:] > hand.lower[1:]
    rms = np.sqrt(((poses[:, None] - library[None])[..., free] ** 2).mean(axis=2)).min(axis=1)
    assert 0.45 < (rms < 0.06).mean() < 0.8  # noise of 0.05, less where limits cut it; some blends are near a pose
    uniform = np.random.default_rng(0).uniform(hand.lower, hand.upper, (400, 16, 3))[:, 1:]
    far = np.sqrt(((uniform[:, None] - library[None])[..., free] ** 2).mean(axis=2)).min(axis=1)
    assert np.median(far) > 3 * np.median(rms)


def two_poses(**changes):
    poses = {"a": np.zeros((4, 3)), "b": np.zeros((4, 3))}
    poses["b"][1] = [1.0, 0.3, 0.0]
    poses["b"][0] = [0.0, 1.2, 0.0]
    return build_rig(replace(make_tube_data(), poses=poses, **changes))


def test_noise_is_as_documented_and_blends_fill_the_way():
    rig = two_poses()
    poses = natural_poses(rig, 6000, random_state=2)
    wide = poses[:, 1, 1]  # library at 0 or 0.3 of limits ±0.5
    assert 0.04 < (wide - 0.3)[wide > 0.3].std() / np.sqrt(1 - 2 / np.pi) < 0.06
    share = poses[:, 1, 0]
    assert 0.15 < ((share > 0.25) & (share < 0.75)).mean() < 0.35  # a half of all, uniform: a quarter
    assert abs((share > 0.5).mean() - 0.5) < 0.03


def test_root_turns_on_from_the_librarys():
    rig = two_poses(lower=np.array([[-0.2] * 3] * 4), upper=np.array([[0.2] * 3] * 4))
    alone = replace(rig, poses={"b": rig.poses["b"]})
    roots = natural_poses(alone, 2000, random_state=3)[:, 0]
    library = matrix_from_rotvec(rig.poses["b"][0])
    further = rotvec_from_matrix(matrix_from_rotvec(roots) @ library.T)
    assert np.abs(further).max() <= 0.2 + 1e-9  # the limits are about the rest, not about the library's pose
    np.testing.assert_allclose(further.std(axis=0), 0.2 / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(further.mean(axis=0), 0, atol=0.01)


def test_library_poses_beyond_the_limits_are_cut():
    rig = two_poses(lower=np.array([[-0.2] * 3] * 4), upper=np.array([[0.2] * 3] * 4))
    assert natural_poses(rig, 300, random_state=4)[:, 1:].max() == 0.2


def test_streams(hand):
    a = natural_poses(hand, 5, random_state=0)
    assert np.array_equal(a, natural_poses(hand, 5, random_state=0))
    assert not np.array_equal(a, natural_poses(hand, 5, random_state=1))
    state = np.random.get_state()[1].copy()
    natural_poses(hand, 5)
    assert np.array_equal(np.random.get_state()[1], state)


# ---- synthesis ----


def quick(rig, n, **options):
    return synthesize(rig, n, n_points=200, random_state=0, **options)


def test_uniform_is_the_default(hand):
    a, b = quick(hand, 3), quick(hand, 3, poses="uniform")
    none = quick(hand, 3, poses=None)
    for x, y, z in zip(a, b, none):
        assert np.array_equal(x.points, y.points) and np.array_equal(x.points, z.points)


def test_natural_scans_have_natural_poses(hand):
    scans = quick(hand, 6, poses="natural")
    library = np.stack(list(hand.poses.values()))[:, 1:]
    for scan in scans:
        assert ((scan.pose >= hand.lower) & (scan.pose <= hand.upper))[1:].all()
        np.testing.assert_allclose(scan.joints, hand.with_template(scan.template, scan.template_joints).pose_joints(scan.pose))
    near = [np.sqrt(((s.pose[1:] - library) ** 2).mean(axis=(1, 2))).min() for s in scans]
    assert max(near) < 0.25
    first = quick(hand, 2, poses="natural")
    assert np.array_equal(first[1].points, scans[1].points)  # whatever n_scans


def test_mixed_takes_them_in_turn(hand):
    mixed, uniform, natural = (quick(hand, 4, poses=p) for p in ("mixed", "uniform", "natural"))
    for i in range(4):
        assert np.array_equal(mixed[i].points, (natural if i % 2 else uniform)[i].points)


@pytest.mark.parametrize("poses", ["natural", "mixed"])
def test_rigs_without_a_library_say_what_to_do(tube_rig, poses):
    with pytest.raises(InputError, match=f"poses: got '{poses}' for the rig 'tube'.*no library.*'uniform'.*bundled rigs"):
        synthesize(tube_rig, 1, poses=poses)
    with pytest.raises(InputError, match="rig: got the rig 'tube', which has no library of natural poses"):
        natural_poses(tube_rig, 1)
    with pytest.raises(InputError, match=r"rig: got 'hand'; expected a Rig. load_rig\(name or path\) gives one"):
        natural_poses("hand", 1)


def test_other_words_are_refused(hand):
    with pytest.raises(InputError, match=r"poses: got 'naturl'; expected 'uniform', 'natural', 'mixed', or an array \(k, J, 3\)"):
        synthesize(hand, 1, poses="naturl")


@pytest.mark.parametrize("n", [-1, 2.0, True])
def test_how_many_is_a_whole_number(hand, n):
    with pytest.raises(InputError, match="n: got .*an integer of at least 0"):
        natural_poses(hand, n)


def test_the_digest_of_poses_knows_their_order():
    """By which they are drawn: a library that is kept for one order is not another's."""
    rig = load_rig("hand-coarse")
    names = list(rig.poses)
    turned = replace(rig, poses={name: rig.poses[name] for name in names[::-1]})
    assert turned.digest == rig.digest and turned.poses_digest != rig.poses_digest
    assert replace(rig, poses=dict(rig.poses)).poses_digest == rig.poses_digest


def test_blends_of_roots_that_are_a_whole_turn_apart_stay_between_them():
    """As those of scans whose y points down: r and r − 2π r/|r| are one rotation."""
    poses = {"a": np.zeros((4, 3)), "b": np.zeros((4, 3))}
    poses["a"][0, 1], poses["b"][0, 1] = 3.1, -3.1
    data = make_tube_data()
    rig = build_rig(replace(data, poses=poses))
    rig = replace(rig, lower=np.where(np.arange(4)[:, None] == rig.root, 0.0, rig.lower))
    rig = replace(rig, upper=np.where(np.arange(4)[:, None] == rig.root, 0.0, rig.upper))
    turned = natural_poses(rig, 300, random_state=0)[:, rig.root]
    assert (np.linalg.norm(turned, axis=1) > 3.09).all()
