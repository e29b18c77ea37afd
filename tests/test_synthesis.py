"""Synthetic scans carry their whole truth, and have the flaws that they were asked to have."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning.training import TrainingScans
from lbsfit_np.rotations import matrix_from_rotvec
from lbsfit_np.skinning import skin
from lbsfit_np.synthesis import (
    Synthesis,
    make_settings,
    sample_surface,
    synthesize_nth,
    training_poses,
    uniform_poses,
)

CLEAN = {"noise": 0.0, "holes": 0, "density": 0.0}


def _equal(a, b):
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__)


def _on_triangles(points, vertices, faces):
    """Distance of each point to its nearest triangle's inside, that triangle, and the barycentric coordinates there."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    best = np.full(len(points), np.inf)
    where, bary = np.zeros(len(points), int), np.zeros((len(points), 3))
    for f in range(len(faces)):
        edges = np.column_stack([b[f] - a[f], c[f] - a[f]])
        uv, *_ = np.linalg.lstsq(edges, (points - a[f]).T, rcond=None)
        inside = (uv >= -1e-9).all(axis=0) & (uv.sum(axis=0) <= 1 + 1e-9)
        d = np.where(inside, np.linalg.norm(points - a[f] - (edges @ uv).T, axis=1), np.inf)
        closer = d < best
        best[closer], where[closer] = d[closer], f
        bary[closer] = np.column_stack([1 - uv.sum(axis=0), *uv])[closer]
    return best, where, bary


# ---- the truth ----


def test_points_lie_on_the_true_mesh_and_have_its_labels(tube_rig):
    for s in lbs.synthesize(tube_rig, 3, random_state=1, n_points=300, **CLEAN, scale=0.2, turn=1.0):
        assert s.points.shape == (300, 3) and s.labels.shape == (300,)
        distance, face, bary = _on_triangles(s.points, s.vertices, tube_rig.faces)
        assert distance.max() < 1e-12
        clear = np.sort(bary, axis=1)[:, 2] - np.sort(bary, axis=1)[:, 1] > 1e-6
        nearest_corner = tube_rig.faces[face, bary.argmax(axis=1)]
        np.testing.assert_array_equal(s.labels[clear], tube_rig.vertex_labels[nearest_corner][clear])


def test_repr_is_a_line(tube_rig):
    (scan,) = lbs.synthesize(tube_rig, random_state=0, n_points=50)
    assert repr(scan) == f"<SyntheticScan: 50 points, 4 joints, {len(tube_rig.vertices)} vertices>"


@pytest.mark.parametrize("settings", [{}, {"scale": 0.3, "turn": 3.0, "shape": 0.12}, {"shape": 0.0}])
def test_vertices_and_joints_are_the_posed_template(tube_rig, settings):
    for s in lbs.synthesize(tube_rig, 4, random_state=2, **settings):
        subject = tube_rig.with_template(s.template, s.template_joints)
        np.testing.assert_allclose(subject.pose(s.pose, s.translation, s.scale), s.vertices, atol=1e-14)
        np.testing.assert_allclose(subject.pose_joints(s.pose, s.translation, s.scale), s.joints, atol=1e-14)
        # the same in the rig's own words: offsets, and joints that are known rather than regressed
        posed = skin(
            tube_rig,
            s.pose,
            translation=s.translation,
            scale=s.scale,
            offsets=s.template - tube_rig.vertices,
            joint_offsets=s.template_joints - tube_rig.joints,
        )
        np.testing.assert_allclose(posed.vertices, s.vertices, atol=1e-14)


def test_templates_change_by_as_much_as_asked(tube_rig):
    for s in lbs.synthesize(tube_rig, 3, random_state=0, shape=0.0):
        assert (s.template == tube_rig.vertices).all() and (s.template_joints == tube_rig.joints).all()
    small, large = (
        np.mean([np.abs(s.template - tube_rig.vertices).mean() for s in lbs.synthesize(tube_rig, 20, random_state=0, shape=a)])
        for a in (0.02, 0.08)
    )
    assert large == pytest.approx(4 * small, rel=1e-6)
    assert 0.005 < large < 0.1
    every = [s.template for s in lbs.synthesize(tube_rig, 3, random_state=0)]
    assert np.abs(every[0] - every[1]).max() > 1e-3


def test_noise_is_as_strong_as_asked(tube_rig):
    half = tube_rig.size / 2
    clean = lbs.synthesize(tube_rig, 4, random_state=5, noise=0.0, scale=0.3)
    noisy = lbs.synthesize(tube_rig, 4, random_state=5, noise=0.01, scale=0.3)
    for a, b in zip(clean, noisy):
        away = (b.points - a.points) / (half * a.scale)
        assert np.std(away) == pytest.approx(0.01, rel=0.05)
        assert np.abs(away.mean(axis=0)).max() < 1e-3
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_all_labels_are_parts_of_the_rig(tube_rig):
    grouped = tube_rig.with_parts("arm and fingers")
    for rig in (tube_rig, grouped):
        labels = np.concatenate([s.labels for s in lbs.synthesize(rig, 3, random_state=0)])
        assert set(labels.tolist()) == set(range(len(rig.parts)))


# ---- seeds ----


def test_a_seed_gives_the_same_scans_however_many_are_asked_for(tube_rig):
    three, five = (lbs.synthesize(tube_rig, n, random_state=7, n_points=200, turn=1.0, scale=0.1) for n in (3, 5))
    assert len(three) == 3 and len(five) == 5
    assert all(_equal(a, b) for a, b in zip(three, five))
    assert _equal(
        synthesize_nth(tube_rig, 4, make_settings({"n_points": 200, "turn": 1.0, "scale": 0.1}), random_state=7), five[4]
    )


def test_other_seeds_and_other_scans_differ(tube_rig):
    a, b = lbs.synthesize(tube_rig, 2, random_state=7)
    c = lbs.synthesize(tube_rig, 1, random_state=8)[0]
    assert not np.allclose(a.pose, b.pose) and not np.allclose(a.pose, c.pose)
    d, e = lbs.synthesize(tube_rig, 1)[0], lbs.synthesize(tube_rig, 1)[0]
    assert not np.allclose(d.pose, e.pose)


def test_a_generator_goes_on(tube_rig):
    rng = np.random.default_rng(0)
    a, b = lbs.synthesize(tube_rig, 1, random_state=rng)[0], lbs.synthesize(tube_rig, 1, random_state=rng)[0]
    assert not np.allclose(a.pose, b.pose)


def test_seeds_do_not_leak_into_the_global_state(tube_rig):
    np.random.seed(0)
    before = np.random.get_state()[1].copy()
    lbs.synthesize(tube_rig, 1, random_state=3)
    np.testing.assert_array_equal(np.random.get_state()[1], before)


# ---- poses ----


def test_uniform_poses_fill_the_limits(tube_rig):
    poses = uniform_poses(tube_rig, 4000, np.random.default_rng(0))
    low, high = tube_rig.lower, tube_rig.upper
    assert (poses >= low).all() and (poses <= high).all()
    np.testing.assert_allclose(poses.mean(axis=0), (low + high) / 2, atol=0.05)
    np.testing.assert_allclose(poses.std(axis=0), (high - low) / np.sqrt(12), rtol=0.05)
    u = ((poses - low) / (high - low)).reshape(4000, -1)
    assert np.abs(np.corrcoef(u.T) - np.eye(12)).max() < 0.08


def _shares(rig, poses):
    """Where angles stand between their limits, 0 to 1."""
    return (poses - rig.lower) / (rig.upper - rig.lower)


def _training_poses_one_by_one(rig, n, **options):
    """As training draws them: each from a stream of its own."""
    return np.concatenate([training_poses(rig, 1, np.random.default_rng(i), **options) for i in range(n)])


@pytest.mark.parametrize("correlated", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("one_by_one", [False, True])
def test_training_poses_keep_each_angles_own_distribution(tube_rig, correlated, one_by_one):
    from scipy.stats import kstest

    if one_by_one:
        poses = _training_poses_one_by_one(tube_rig, 3000, correlated=correlated)
    else:
        poses = training_poses(tube_rig, 3000, np.random.default_rng(0), correlated=correlated)
    assert poses.shape == (3000, 4, 3)
    assert (poses >= tube_rig.lower).all() and (poses <= tube_rig.upper).all()
    u = _shares(tube_rig, poses).reshape(3000, -1)
    assert max(kstest(angle, "uniform").statistic for angle in u.T) < 0.035


def test_training_poses_move_together(tube_rig):
    def together(**options):
        return np.corrcoef(_shares(tube_rig, training_poses(tube_rig, 3000, np.random.default_rng(0), **options))[:, :, 0].T)

    long, short = 2, 3
    assert together(correlated=1.0)[long, short] > 0.15
    assert 0.08 < together()[long, short] < together(correlated=1.0)[long, short]
    assert abs(together(correlated=0.0)[long, short]) < 0.08


def test_training_poses_have_fists_and_flat_hands():
    """All fingers bent, or all straight: next to never by independent angles, now and then by correlated ones."""
    rig = lbs.load_rig("hand")
    fingers = [j for j, name in enumerate(rig.joint_names) if rig.moving[j] and not name.startswith("thumb") and j != rig.root]
    bends = [(j, int(np.argmax(rig.upper[j] - rig.lower[j]))) for j in fingers]
    rows, axes = np.array(bends).T

    def share(of, **options):
        poses = training_poses(rig, 2000, np.random.default_rng(1), **options)[:, rows, axes]
        u = (poses - rig.lower[rows, axes]) / (rig.upper - rig.lower)[rows, axes]
        return of(u).mean()

    for of in (lambda u: (u > 0.5).all(axis=1), lambda u: (u < 0.5).all(axis=1)):
        assert share(of, correlated=0.0) < 0.005
        assert share(of, correlated=1.0) > 0.03
        assert share(of) > 0.015


@pytest.mark.parametrize("one_by_one", [False, True])
def test_the_roots_angles_are_independent_of_all(tube_rig, one_by_one):
    if one_by_one:
        poses = _training_poses_one_by_one(tube_rig, 3000, correlated=1.0)
    else:
        poses = training_poses(tube_rig, 3000, np.random.default_rng(0), correlated=1.0)
    together = np.corrcoef(_shares(tube_rig, poses).reshape(3000, -1).T) - np.eye(12)
    root = slice(3 * tube_rig.root, 3 * tube_rig.root + 3)
    assert np.abs(together[root]).max() < 0.08
    assert np.abs(together[3:, 3:]).max() > 0.15


def test_axes_of_a_joint_do_not_move_together(tube_rig):
    """Bending says nothing about spreading: strengths are shared, directions are not."""
    u = _shares(tube_rig, training_poses(tube_rig, 3000, np.random.default_rng(0), correlated=1.0))
    for j in range(4):
        assert np.abs(np.corrcoef(u[:, j].T) - np.eye(3)).max() < 0.08


def test_training_scans_are_the_same_in_any_process(tube_rig):
    import pickle

    scans = TrainingScans(tube_rig, Synthesis(n_points=150), 7)
    again = pickle.loads(pickle.dumps(scans))
    for i in (5, 0):
        points, labels, scale = scans(i)
        assert points.shape == (150, 3) and labels.shape == (150,) and scale == 1.0
        np.testing.assert_array_equal(again(i)[0], points)
        np.testing.assert_array_equal(again(i)[1], labels)
    assert not np.array_equal(scans(0)[0], scans(1)[0])
    assert not np.array_equal(TrainingScans(tube_rig, Synthesis(n_points=150), 8)(0)[0], scans(0)[0])


def test_locked_axes_stay_where_they_are(shared_rigs):
    from pathlib import Path

    rig = lbs.load_rig(
        shared_rigs / "webxr_hand" / "left.glb", card=Path(lbs.__file__).parent / "bench" / "cards" / "webxr_left.toml"
    )
    held = rig.lower == rig.upper
    for poses in (uniform_poses, training_poses):
        assert (poses(rig, 20, np.random.default_rng(0))[:, held] == 0).all()


def test_given_poses_and_templates_are_taken_in_turn(tube_rig):
    poses = uniform_poses(tube_rig, 2, np.random.default_rng(1))
    templates = [(f * tube_rig.vertices, f * tube_rig.joints) for f in (1.0, 1.1, 0.9)]
    scans = lbs.synthesize(tube_rig, 4, poses=poses, templates=templates, random_state=0)
    for i, s in enumerate(scans):
        np.testing.assert_array_equal(s.pose, poses[i % 2])
        np.testing.assert_array_equal(s.template, templates[i % 3][0])
        np.testing.assert_array_equal(s.template_joints, templates[i % 3][1])
    templates[0][0][:] = 0.0  # the truth of scans is no array that callers go on with
    assert np.ptp(scans[0].template) > 0 and not scans[0].template.flags.writeable


def test_turn_is_a_rotation_about_the_root_up_to_an_angle(tube_rig):
    rest = np.zeros((1, 4, 3))
    rest[0, tube_rig.root] = [0.3, -0.2, 0.5]
    angles = []
    for s in lbs.synthesize(tube_rig, 40, poses=rest, random_state=0, turn=1.2, shape=0.0, n_points=10):
        assert (s.pose[1:] == 0).all()
        frame = tube_rig.frames[tube_rig.root]
        turn = frame @ matrix_from_rotvec(s.pose[0]) @ matrix_from_rotvec(rest[0, 0]).T @ frame.T
        angles.append(np.arccos((np.trace(turn) - 1) / 2))
        before, centre = tube_rig.pose(rest[0]), tube_rig.joints[tube_rig.root]
        np.testing.assert_allclose(s.vertices, (before - centre) @ turn.T + centre, atol=1e-13)
    assert 0.9 < max(angles) <= 1.2 + 1e-9
    assert 0.4 < np.mean(angles) < 0.8
    for s in lbs.synthesize(tube_rig, 2, poses=rest, random_state=0, n_points=10):
        np.testing.assert_array_equal(s.pose, rest[0])


def test_scale_is_jittered_around_1(tube_rig):
    scales = np.array([s.scale for s in lbs.synthesize(tube_rig, 60, random_state=0, scale=0.2, n_points=10)])
    assert (scales >= 0.8).all() and (scales <= 1.2).all() and np.ptp(scales) > 0.3
    assert {s.scale for s in lbs.synthesize(tube_rig, 5, random_state=0, n_points=10)} == {1.0}
    s = lbs.synthesize(tube_rig, 1, random_state=0, scale=0.5, shape=0.0, **CLEAN)[0]
    np.testing.assert_allclose(s.vertices, s.scale * tube_rig.pose(s.pose), atol=1e-14)


# ---- flaws ----


def _largest_gap(points, vertices):
    from scipy.spatial import cKDTree

    return cKDTree(points).query(vertices)[0].max()


def test_holes_are_really_missing(tube_rig):
    half = tube_rig.size / 2
    hole = {"holes": 1, "least_holes": 1, "hole_radius": 0.3, "least_hole": 1.0}
    for seed in range(5):
        whole = lbs.synthesize(tube_rig, 1, random_state=seed, n_points=4000, **CLEAN)[0]
        torn = lbs.synthesize(tube_rig, 1, random_state=seed, n_points=4000, **{**CLEAN, **hole})[0]
        assert _largest_gap(whole.points, whole.vertices) < 0.08 * half
        assert _largest_gap(torn.points, torn.vertices) > 0.2 * half
        assert 2000 <= len(torn.points) <= 4000 and len(torn.labels) == len(torn.points)


def test_holes_never_leave_too_little(tube_rig):
    for s in lbs.synthesize(tube_rig, 5, random_state=0, holes=8, least_holes=8, hole_radius=1.5, n_points=500):
        assert len(s.points) >= 250


def test_a_scan_has_as_many_points_as_asked_for(tube_rig):
    for s in lbs.synthesize(tube_rig, 8, random_state=0, n_points=777, holes=1, hole_radius=0.1):
        assert len(s.points) == 777


def test_density_is_as_uneven_as_asked(tube_rig):
    """Points per area, part by part and side by side: even without ``density``, far from it with."""
    p = tube_rig.vertices[tube_rig.faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    group = tube_rig.vertex_labels[tube_rig.faces[:, 0]] * 2 + (p.mean(axis=1)[:, 2] > np.median(p[..., 2]))
    expected = np.bincount(group, area) / area.sum()
    spread = {}
    for density in (0.0, 0.5, 1.5):
        ratios = []
        for seed in range(8):
            _, face, _ = sample_surface(tube_rig.vertices, tube_rig.faces, 8000, np.random.default_rng(seed), density=density)
            ratios.append(np.bincount(group[face], minlength=len(expected)) / 8000 / expected)
        spread[density] = np.mean(np.std(np.log(np.maximum(ratios, 1e-3)), axis=1))
    assert spread[0.0] < 0.06
    assert spread[0.5] > 0.15
    assert spread[1.5] > 2 * spread[0.5]


def test_samples_are_uniform_by_area_and_on_their_triangles(tube_rig):
    V = np.array([[0.0, 0, 0], [2.0, 0, 0], [0.0, 1, 0], [0.0, 0, 3.0]])
    F = np.array([[0, 1, 2], [0, 2, 3], [0, 0, 1]])  # areas 1, 1.5 and 0
    points, face, bary = sample_surface(V, F, 30000, np.random.default_rng(0))
    np.testing.assert_allclose(np.bincount(face, minlength=3) / 30000, [0.4, 0.6, 0.0], atol=0.01)
    np.testing.assert_allclose(np.einsum("nk,nka->na", bary, V[F[face]]), points, atol=1e-15)
    assert (bary >= 0).all()
    np.testing.assert_allclose(bary.sum(axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(bary.mean(axis=0), 1 / 3, atol=0.01)
    np.testing.assert_allclose(bary.std(axis=0), np.sqrt(1 / 18), atol=0.01)


# ---- bad settings ----


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"n_point": 100}, ["n_point", "an unknown setting", "n_points", "hole_radius"]),
        ({"pose": "natural"}, ["pose", "n_scans, poses, templates, random_state, n_points", "Did you mean 'poses'"]),
        ({"n_points": 0}, ["n_points: got 0", "integer of at least 1"]),
        ({"n_points": 10.5}, ["n_points: got 10.5", "integer"]),
        ({"noise": -0.1}, ["noise: got -0.1", "at least 0"]),
        ({"noise": "much"}, ["noise: got 'much'", "number"]),
        ({"noise": None}, ["noise: got None"]),
        ({"noise": np.nan}, ["noise: got nan"]),
        ({"density": np.inf}, ["density: got inf"]),
        ({"density": 300}, ["density: got 300", "at most 10"]),
        ({"shape": 0.6}, ["shape: got 0.6", "at most 0.4"]),
        ({"poses": [[[0.0]], [[0.0, 0.0]]]}, ["poses: got rows of different lengths", "(k, 4, 3)"]),
        ({"hole_radius": 50}, ["hole_radius: got 50", "at most 10. It is in half sizes of the rig."]),
        ({"holes": 1.5}, ["holes: got 1.5", "integer"]),
        ({"holes": True}, ["holes: got True", "integer"]),
        ({"holes": 1, "least_holes": 2}, ["least_holes: got 2", "at most 1, the value of holes"]),
        ({"least_hole": 1.5}, ["least_hole: got 1.5", "at most 1"]),
        ({"scale": 1.0}, ["scale: got 1.0", "at most 0.9"]),
        ({"n_scans": -1}, ["n_scans: got -1", "at least 0"]),
        ({"n_scans": 2.0}, ["n_scans: got 2.0", "integer"]),
        ({"random_state": -3}, ["random_state: got -3", "non-negative integer"]),
        ({"random_state": "seed"}, ["random_state: got 'seed'"]),
        ({"poses": "natrual"}, ["poses: got 'natrual'", "'mixed', or an array (k, J, 3). Did you mean 'natural'?"]),
        ({"poses": np.zeros((4, 3))}, ["poses: got shape (4, 3)", "(k, 4, 3)"]),
        ({"poses": np.zeros((0, 4, 3))}, ["poses: got shape (0, 4, 3)", "k ≥ 1"]),
        ({"poses": np.full((1, 4, 3), np.nan)}, ["poses", "12 values", "NaN"]),
        ({"poses": np.full((1, 4, 3), 1e200)}, ["poses: got an angle of 1e+200", "radians"]),
        ({"templates": np.zeros((1, 2, 242, 3))}, ["templates: got a ndarray", "a list of pairs"]),
        ({"templates": []}, ["templates: got none", "one or more pairs"]),
        ({"templates": [np.zeros((242, 3))]}, ["templates[0]: got ndarray", "pair"]),
        ({"templates": [(np.zeros((242, 3)), np.zeros((5, 3)))]}, ["templates[0][1]: got shape (5, 3)", "(4, 3)"]),
    ],
)
def test_bad_settings_are_named(tube_rig, settings, words):
    with pytest.raises(InputError) as error:
        lbs.synthesize(tube_rig, **settings)
    for word in words:
        assert word in str(error.value)


def test_settings_pass_through():
    made = make_settings({"n_points": 10, "turn": 1})
    assert made == Synthesis(n_points=10, turn=1)
    assert make_settings(made) is made
    assert make_settings({"n_points": np.int64(5), "noise": np.float32(0.5)}).n_points == 5


def test_numpy_numbers_name_scans_as_well(tube_rig):
    made = [synthesize_nth(tube_rig, i, Synthesis(n_points=20), random_state=4) for i in (3, np.int64(3))]
    np.testing.assert_array_equal(made[0].points, made[1].points)


def test_no_scans_is_an_empty_list(tube_rig):
    assert lbs.synthesize(tube_rig, 0) == []


def test_the_name_of_a_rig_is_no_rig():
    with pytest.raises(InputError, match="rig: got 'hand'; expected a Rig. load_rig"):
        lbs.synthesize("hand", 1)


@pytest.mark.parametrize("one_sided", [False, True])
def test_each_point_knows_its_place_on_the_mesh(one_sided, tube_rig):
    """Without noise the place is the point; clutter and floor have none."""
    settings = {"random_state": 4, "holes": 1, "clutter": 0.1, "floor": 0.1, "one_sided": one_sided}
    clean, noisy = (lbs.synthesize(tube_rig, 1, noise=noise, **settings)[0] for noise in (0.0, 0.01))
    body = clean.labels >= 0
    corners = clean.vertices[tube_rig.faces[clean.triangle[body]]]
    np.testing.assert_allclose(np.einsum("nk,nka->na", clean.barycentric[body], corners), clean.points[body], atol=1e-12)
    np.testing.assert_array_equal(noisy.triangle[noisy.labels >= 0], clean.triangle[body])
    assert (clean.triangle[~body] == -1).all() and not clean.barycentric[~body].any() and 0 < (~body).sum() < body.sum()
    corner = tube_rig.faces[clean.triangle[body], clean.barycentric[body].argmax(axis=1)]
    np.testing.assert_array_equal(clean.labels[body], tube_rig.vertex_labels[corner])
