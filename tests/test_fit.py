"""The fit of one scan: known poses come back, whatever the unit, the place and the order; bad input is named."""

import json
import zipfile
from dataclasses import fields, replace

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.losses import PRESETS, chamfer, cotangent_matrix, structured_chamfer
from lbsfit_np.rig.build import build_rig
from lbsfit_np.segmentation import cache
from lbsfit_np.synthesis import Synthesis, uniform_poses

CLEAN = {"noise": 0.0, "holes": 0, "density": 0.0}


def _error(rig, found, true):
    """Mean distance in half sizes of the rig."""
    return np.linalg.norm(found - true, axis=1).mean() / (rig.size / 2)


def _same(a, b, leave_out=("seconds",)):
    """Two results, equal to the last bit."""
    for f in fields(FitResult):
        if f.name not in leave_out:
            x, y = getattr(a, f.name), getattr(b, f.name)
            assert np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y, f.name


@pytest.fixture(scope="module")
def scan(tube_rig):
    return lbs.synthesize(tube_rig, 1, random_state=31)[0]


@pytest.fixture(scope="module")
def result(tube_fitter, scan):
    return tube_fitter.fit_scan(scan.points)


@pytest.fixture
def fitter(tube_rig):
    """A fitter without a segmenter, for scans whose labels are known; training would take no time worth a word."""
    return lbs.LBSFitter(tube_rig, training_scans=2, training={"n_points": 100}, random_state=0)


# ---- pose → points → pose ----


@pytest.mark.parametrize("scale", ["estimate", "fixed"])
@pytest.mark.parametrize("joints", ["follow", "fixed"])
def test_the_rigs_own_vertices_give_their_pose_back(tube_rig, scale, joints):
    """Every point has its vertex: the truth costs nothing, and nothing else is as good."""
    fitter = lbs.LBSFitter(tube_rig, scale=scale, joints=joints, random_state=0)
    for theta in uniform_poses(tube_rig, 3, np.random.default_rng(5)):
        V = tube_rig.pose(theta) + [0.3, 0.0, -0.1]
        r = fitter.fit_scan(V, labels=tube_rig.vertex_labels)
        assert _error(tube_rig, r.joints, tube_rig.pose_joints(theta) + [0.3, 0.0, -0.1]) < 0.006
        assert _error(tube_rig, r.vertices, V) < 0.004
        assert r.scale == 1.0 if scale == "fixed" else abs(r.scale - 1) < 0.01
        assert r.status == "ok"


def test_surface_points_with_known_labels_give_the_pose_back(tube_rig, fitter):
    for s in lbs.synthesize(tube_rig, 4, random_state=3, shape=0.0, **CLEAN):
        r = fitter.fit_scan(s.points, labels=s.labels)
        assert _error(tube_rig, r.joints, s.joints) < 0.04
        assert _error(tube_rig, r.vertices, s.vertices) < 0.045
        assert abs(r.scale - 1) < 0.06


def test_scans_of_other_shapes_with_all_their_flaws(tube_rig, tube_fitter):
    joints, vertices, labels = [], [], []
    for s in lbs.synthesize(tube_rig, 6, random_state=8):
        r = tube_fitter.fit_scan(s.points)
        joints.append(_error(tube_rig, r.joints, s.joints))
        vertices.append(_error(tube_rig, r.vertices, s.vertices))
        labels.append((r.labels == s.labels).mean())
    assert np.mean(joints) < 0.08 and np.mean(vertices) < 0.08 and np.mean(labels) > 0.85
    rest = np.mean([_error(tube_rig, s.joints, tube_rig.joints) for s in lbs.synthesize(tube_rig, 6, random_state=8)])
    assert np.mean(joints) < 0.5 * rest


def test_a_scan_of_few_points(tube_rig, fitter, scan):
    rows = np.random.default_rng(0).choice(len(scan.points), 60, replace=False)
    r = fitter.fit_scan(scan.points[rows], labels=scan.labels[rows])
    assert _error(tube_rig, r.joints, scan.joints) < 0.15


def test_a_large_scan_is_thinned_and_labelled_in_full(tube_rig, tube_fitter):
    s = lbs.synthesize(tube_rig, 1, random_state=9, n_points=20000, **CLEAN)[0]
    r = tube_fitter.fit_scan(s.points)
    assert r.labels.shape == r.confidence.shape == (20000,)
    assert (r.labels == s.labels).mean() > 0.8


@pytest.mark.parametrize("parts", [{"all": ("root",)}, {"arm": ("root",), "fingers": ("long", "short")}])
def test_rigs_of_one_and_two_parts(parts, scan):
    rig = build_rig(replace(make_tube_data(), partitions={"few": parts}), parts="few")
    r = lbs.LBSFitter(rig, training_scans=10, training={"n_points": 500}, random_state=0).fit_scan(scan.points)
    assert r.parts == tuple(parts) and set(r.labels) <= set(range(len(parts)))
    assert np.isfinite(r.vertices).all()


# ---- equivariance ----


@pytest.mark.parametrize(
    "factor, shift", [(1.0, [10.0, -20.0, 5.0]), (1000.0, [0.0, 0.0, 0.0]), (1000.0, [1e4, -2e3, 3e3]), (0.01, [1.0, 0, 0])]
)
@pytest.mark.parametrize("known", [False, True])
def test_unit_and_place_of_the_scan_carry_over(tube_rig, tube_fitter, scan, result, factor, shift, known):
    """The same up to what rounding does to a minimiser's path."""
    labels = scan.labels if known else None
    before = tube_fitter.fit_scan(scan.points, labels=labels) if known else result
    after = tube_fitter.fit_scan(factor * scan.points + shift, labels=labels)
    assert _error(tube_rig, (after.vertices - shift) / factor, before.vertices) < 0.03
    assert _error(tube_rig, (after.joints - shift) / factor, before.joints) < 0.03
    assert after.scale / factor == pytest.approx(before.scale, rel=0.03)
    np.testing.assert_allclose(after.offsets, before.offsets, atol=0.1 * tube_rig.size)
    assert (after.labels == before.labels).mean() > 0.97


def test_rig_and_scan_in_another_unit_give_the_same_to_the_last_bit(fitter, scan):
    a = fitter.fit_scan(scan.points, labels=scan.labels)
    c = lbs.LBSFitter(fitter.rig.scaled(4.0), random_state=0).fit_scan(4.0 * scan.points, labels=scan.labels)
    np.testing.assert_array_equal(c.pose, a.pose)
    np.testing.assert_array_equal(c.vertices, 4.0 * a.vertices)
    np.testing.assert_array_equal(c.offsets, 4.0 * a.offsets)
    assert c.scale == a.scale


def test_a_fixed_scale_is_1(tube_rig, scan):
    r = lbs.LBSFitter(tube_rig, scale="fixed", random_state=0).fit_scan(scan.points, labels=scan.labels)
    assert r.scale == 1.0


# ---- what can be given ----


def test_a_known_start_is_used(tube_rig, tube_fitter, scan):
    r = tube_fitter.fit_scan(scan.points, theta0=scan.pose)
    assert _error(tube_rig, r.joints, scan.joints) < 0.1
    again = tube_fitter.fit_scan(scan.points, theta0=r.pose)
    assert _error(tube_rig, again.joints, r.joints) < 0.05


def test_a_start_outside_the_limits_is_moved_inside(shared_rigs, tube_rig, fitter, scan):
    r = fitter.fit_scan(scan.points, labels=scan.labels, theta0=np.full((4, 3), 3.0))
    assert (r.pose[1:] >= tube_rig.lower[1:]).all() and (r.pose[1:] <= tube_rig.upper[1:]).all()
    from pathlib import Path

    rig = lbs.load_rig(
        shared_rigs / "webxr_hand" / "left.glb", card=Path(lbs.__file__).parent / "bench" / "cards" / "webxr_left.toml"
    )
    r = lbs.LBSFitter(rig, random_state=0).fit_scan(rig.vertices, labels=rig.vertex_labels, theta0=np.full(rig.lower.shape, 0.2))
    held = ~rig.moving
    assert held.any() and (r.pose[held] == 0).all()
    bounded = np.arange(len(rig.parents)) != rig.root
    assert (r.pose[bounded] >= rig.lower[bounded]).all() and (r.pose[bounded] <= rig.upper[bounded]).all()


def test_given_labels_are_kept(fitter, scan):
    labels = np.random.default_rng(0).permutation(scan.labels)
    given = labels.copy()
    r = fitter.fit_scan(scan.points, labels=labels)
    np.testing.assert_array_equal(r.labels, labels)
    assert (r.confidence == 1).all()
    assert not hasattr(fitter, "segmenter_")  # nobody asked s
    assert not np.shares_memory(r.labels, labels) and (labels == given).all() and labels.flags.writeable


def test_weights_of_0_leave_clutter_out(tube_rig, tube_fitter, scan):
    rng = np.random.default_rng(0)
    clutter = rng.uniform(-3, 3, (1500, 3)) + [2.0, 0.0, 0.0]
    points = np.vstack([scan.points[:1000], clutter])
    weights = np.r_[np.ones(1000), np.zeros(1500)]
    alone = tube_fitter.fit_scan(scan.points[:1000], point_weights=np.ones(1000))
    with_clutter = tube_fitter.fit_scan(points, point_weights=weights)
    np.testing.assert_array_equal(with_clutter.pose, alone.pose)
    np.testing.assert_array_equal(with_clutter.vertices, alone.vertices)
    assert with_clutter.labels.shape == (2500,)
    np.testing.assert_array_equal(with_clutter.labels[:1000], alone.labels)


def test_weights_count_by_their_ratio(fitter, scan):
    w = np.random.default_rng(0).random(len(scan.points)) + 0.1
    a, b = (fitter.fit_scan(scan.points, labels=scan.labels, point_weights=f * w) for f in (1.0, 4.0))
    np.testing.assert_array_equal(a.vertices, b.vertices)
    c = fitter.fit_scan(scan.points, labels=scan.labels)
    assert not np.array_equal(a.vertices, c.vertices)


def test_nothing_that_is_given_is_changed(fitter, scan):
    given = [scan.points.copy(), scan.labels.copy(), scan.pose.copy(), np.ones(len(scan.points))]
    kept = [a.copy() for a in given]
    fitter.fit_scan(given[0], labels=given[1], theta0=given[2], point_weights=given[3])
    for a, b in zip(given, kept):
        np.testing.assert_array_equal(a, b)
        assert a.flags.writeable


def test_a_scan_object_is_as_good_as_its_points(fitter, scan):
    from lbsfit_np.scan import Scan

    _same(fitter.fit_scan(Scan(scan.points), labels=scan.labels), fitter.fit_scan(scan.points, labels=scan.labels))


# ---- the result ----


def test_fields_and_shapes(tube_rig, result, scan):
    J, m, n = 4, len(tube_rig.vertices), len(scan.points)
    shapes = {
        "pose": (J, 3),
        "translation": (3,),
        "offsets": (m, 3),
        "rest_joints": (J, 3),
        "vertices": (m, 3),
        "joints": (J, 3),
        "labels": (n,),
        "confidence": (n,),
    }
    for name, shape in shapes.items():
        array = getattr(result, name)
        assert array.shape == shape, name
        assert np.isfinite(array).all() and not array.flags.writeable
    assert result.labels.dtype.kind == "i" and set(result.labels) <= set(range(4))
    assert (result.confidence > 0).all() and (result.confidence <= 1 + 1e-12).all()
    assert result.status == "ok" and isinstance(result.converged, bool) and result.message
    assert isinstance(result.evaluations, int) and result.evaluations > 10 and result.seconds > 0
    assert result.parts == tube_rig.parts and result.rig_digest == tube_rig.digest
    assert set(result.terms) == {"chamfer", "structured", "laplacian", "total", "recon"}
    assert all(isinstance(v, float) for v in result.terms.values())


@pytest.mark.parametrize("joints", ["follow", "fixed"])
@pytest.mark.parametrize("weights", ["default", "paper"])
def test_vertices_are_the_pose_of_the_results_own_fields(tube_rig, scan, joints, weights):
    fitter = lbs.LBSFitter(tube_rig, joints=joints, weights=weights, random_state=0)
    r = fitter.fit_scan(100 * scan.points + [5.0, 0.0, 1.0], labels=scan.labels)
    arguments = r.pose, r.translation, r.scale, r.offsets
    np.testing.assert_array_equal(tube_rig.pose(*arguments, joints=r.rest_joints), r.vertices)
    np.testing.assert_array_equal(tube_rig.pose_joints(*arguments, joints=r.rest_joints), r.joints)
    np.testing.assert_allclose(tube_rig.pose(*arguments, joints=joints), r.vertices, rtol=0, atol=1e-11)
    if joints == "fixed":
        np.testing.assert_array_equal(r.rest_joints, tube_rig.joints)
    bounded = slice(1, None)
    assert (r.pose[bounded] >= tube_rig.lower[bounded]).all() and (r.pose[bounded] <= tube_rig.upper[bounded]).all()
    assert np.abs(r.offsets).max() > 1e-4


@pytest.mark.parametrize("weights", ["default", "paper"])
def test_terms_are_the_losses_of_the_result(tube_rig, scan, weights):
    """In units in which the template's longest half-extent is 1, recomputed from what the result says."""
    fitter = lbs.LBSFitter(tube_rig, weights=weights, random_state=0)
    r, w, half = fitter.fit_scan(scan.points, labels=scan.labels), PRESETS[weights], tube_rig.size / 2
    X, Vd, V = scan.points / half, r.vertices / half, tube_rig.pose(r.pose, r.translation, r.scale) / half
    labels = scan.labels, tube_rig.vertex_labels
    expected = {
        "chamfer": chamfer(X, Vd)[0] + w.lam * chamfer(X, V)[0],
        "structured": structured_chamfer(X, Vd, *labels)[0] + w.lam * structured_chamfer(X, V, *labels)[0],
        "recon": np.sqrt(chamfer(X, Vd)[0]),
    }
    K = cotangent_matrix(tube_rig.vertices, tube_rig.faces)
    if weights == "default" and w.laplacian == "offsets":
        expected["laplacian"] = np.linalg.norm(K @ (r.offsets / half)) ** (2 if w.squared else 1)
    for name, value in expected.items():
        assert r.terms[name] == pytest.approx(value, rel=1e-6), name
    total = w.chamfer * r.terms["chamfer"] + w.lam_s * r.terms["structured"] + w.lam_lap * r.terms["laplacian"]
    assert r.terms["total"] == pytest.approx(total, rel=1e-9)


def _split(data):
    """The same mesh with a vertex of its own for every corner of every face, as texture seams make them."""
    rows = data.faces.ravel()
    return replace(
        data, vertices=data.vertices[rows], weights=data.weights[rows], faces=np.arange(len(rows)).reshape(-1, 3), regressor=None
    )


def test_results_are_for_the_rigs_original_vertices(scan):
    rig = build_rig(_split(make_tube_data()))
    assert len(rig.vertices) == 1440 and len(rig.welded.vertices) == 242
    split = lbs.LBSFitter(rig, random_state=0).fit_scan(scan.points, labels=scan.labels)
    whole = lbs.LBSFitter(rig.welded, random_state=0).fit_scan(scan.points, labels=scan.labels)
    assert split.vertices.shape == split.offsets.shape == (1440, 3)
    np.testing.assert_array_equal(split.pose, whole.pose)
    np.testing.assert_array_equal(split.offsets, whole.offsets[rig.weld])
    np.testing.assert_allclose(split.vertices, whole.vertices[rig.weld], atol=1e-12)
    np.testing.assert_allclose(split.joints, whole.joints, atol=1e-12)
    place = split.pose, split.translation, split.scale, split.offsets
    np.testing.assert_array_equal(rig.pose(*place, joints=split.rest_joints), split.vertices)


def test_results_keep_joints_that_do_not_move(tube_rig, scan):
    data = make_tube_data()
    held = build_rig(replace(data, locked=np.array([False, False, False, True])))
    r = lbs.LBSFitter(held, random_state=0).fit_scan(scan.points, labels=np.minimum(scan.labels, len(held.parts) - 1))
    assert r.pose.shape == (4, 3) and (r.pose[3] == 0).all() and r.joints.shape == (4, 3)


# ---- saving ----


def test_saved_and_loaded(result, tmp_path):
    result.save(tmp_path / "a.fit.npz")
    again = FitResult.load(tmp_path / "a.fit.npz")
    _same(again, result, leave_out=())
    for f in fields(FitResult):
        assert type(getattr(again, f.name)) is type(getattr(result, f.name)), f.name
    assert not again.vertices.flags.writeable


def test_the_file_is_plain_arrays_under_documented_keys(result, tmp_path):
    result.save(tmp_path / "a.fit.npz")
    with np.load(tmp_path / "a.fit.npz", allow_pickle=False) as z:
        keys, arrays = set(z.files), {k: z[k] for k in z.files}
    assert keys == {f.name for f in fields(FitResult)} | {"lbsfit_np_result"}
    assert all(key in FitResult.save.__doc__ for key in keys)
    assert {a.dtype.kind for a in arrays.values()} <= set("biufU")
    assert json.loads(str(arrays["terms"])) == result.terms
    np.testing.assert_array_equal(arrays["vertices"], result.vertices)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.6, 0.99])
def test_a_truncated_result_is_one_clear_error(result, tmp_path, share):
    path = tmp_path / "a.fit.npz"
    result.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileError, match=r"a\.fit\.npz"):
        FitResult.load(path)


@pytest.mark.parametrize("lost", ["pose", "terms", "scale", "lbsfit_np_result"])
def test_a_result_that_lacks_something_is_one_clear_error(result, tmp_path, lost):
    path = tmp_path / "a.fit.npz"
    result.save(path)
    with zipfile.ZipFile(path) as z:
        members = {n: z.read(n) for n in z.namelist() if n != f"{lost}.npy"}
    with zipfile.ZipFile(path, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError, match=lost):
        FitResult.load(path)


def test_other_files_are_no_results(tube_rig, result, tmp_path):
    tube_rig.save(tmp_path / "rig.npz")
    (tmp_path / "b.npz").write_text("text")
    np.savez(tmp_path / "future.npz", lbsfit_np_result=99)
    for name, words in (("none.npz", "no such file"), ("rig.npz", "lbsfit_np_result"), ("b.npz", "broken"), ("future.npz", "99")):
        with pytest.raises(FileError, match=words):
            FitResult.load(tmp_path / name)
    with pytest.raises(FileError, match="does not exist"):
        result.save(tmp_path / "nowhere" / "a.npz")


# ---- determinism ----


def test_the_same_again(tube_fitter, scan, result):
    _same(tube_fitter.fit_scan(scan.points), result)


def test_a_seed_decides_all(tube_rig, scan):
    def fit(seed):
        fitter = lbs.LBSFitter(tube_rig, training_scans=4, training={"n_points": 300}, max_points=400, random_state=seed)
        return fitter.fit_scan(scan.points)

    a, b, c = fit(3), fit(3), fit(4)
    _same(a, b)
    assert not np.array_equal(a.vertices, c.vertices)


def test_threads_change_nothing(tube_rig, scan):
    from threadpoolctl import threadpool_limits

    results = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            fitter = lbs.LBSFitter(tube_rig, training_scans=20, training={"n_points": 400}, random_state=0).pretrain()
            results.append(fitter.fit_scan(scan.points[:600]))
    _same(*results)


def test_one_scan_does_not_change_the_next(tube_rig, tube_fitter, scan, result):
    tube_fitter.fit_scan(lbs.synthesize(tube_rig, 1, random_state=1)[0].points)
    _same(tube_fitter.fit_scan(scan.points), result)


@pytest.mark.parametrize("seed", [None, "generator"])
def test_other_kinds_of_seeds_work(tube_rig, scan, seed):
    seed = np.random.default_rng(0) if seed == "generator" else seed
    fitter = lbs.LBSFitter(tube_rig, training_scans=2, training={"n_points": 100}, max_points=300, random_state=seed)
    assert fitter.fit_scan(scan.points).status == "ok"


# ---- the estimator ----


def test_sklearns_conventions(tube_rig, tube_fitter):
    from sklearn.base import clone

    fitter = lbs.LBSFitter(tube_rig, training_scans=7, training={"turn": 0.5}, weights=PRESETS["paper"], random_state=3)
    parameters = fitter.get_params()
    assert parameters["rig"] is tube_rig and parameters["training_scans"] == 7
    names = {"rig", "weights", "joints", "scale", "max_points", "training_scans", "training", "n_jobs", "random_state"}
    assert set(parameters) == names | {"variant", "rounds", "held_out", "sequence", "smooth"}
    copy = clone(fitter)
    assert copy is not fitter and copy.get_params() == parameters
    fresh = clone(tube_fitter)
    assert not hasattr(fresh, "segmenter_") and fresh.rig is tube_rig
    assert fitter.set_params(scale="fixed").scale == "fixed"
    assert "training_scans=7" in repr(fitter)
    with pytest.raises(ValueError, match="speed"):
        fitter.set_params(speed=2)


def test_the_constructor_only_stores(scan):
    fitter = lbs.LBSFitter("no rig", weights="none", training_scans=-1)
    assert fitter.rig == "no rig" and fitter.training_scans == -1
    with pytest.raises(InputError, match="rig: got str"):
        fitter.fit_scan(scan.points)


def test_pretrain_returns_itself_and_shows_progress(fitter):
    seen = []
    assert fitter.pretrain(progress=seen.append) is fitter
    assert len(seen) > 2 and (np.diff(seen) >= -1e-12).all()
    assert 0 < seen[0] < 0.5 and seen[-1] == pytest.approx(1.0)
    assert hasattr(fitter, "segmenter_")


def test_a_segmenter_of_another_rig_is_refused(tube_rig, scan, fitter):
    fitter.pretrain().set_params(rig=tube_rig.with_parts("arm and fingers"))
    with pytest.raises(InputError, match="segmenter.*another rig.*pretrain"):
        fitter.fit_scan(scan.points)
    fitter.pretrain()
    assert fitter.fit_scan(scan.points).parts == ("arm", "fingers")


def test_changed_parameters_are_looked_at_again(tube_rig, scan, fitter):
    follow = fitter.fit_scan(scan.points, labels=scan.labels)
    fixed = fitter.set_params(joints="fixed").fit_scan(scan.points, labels=scan.labels)
    assert not np.array_equal(follow.vertices, fixed.vertices)
    _same(fixed, lbs.LBSFitter(tube_rig, joints="fixed", random_state=0).fit_scan(scan.points, labels=scan.labels))


def test_one_call_with_a_kept_segmenter(tube_rig, scan, tmp_path, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_MEMORY", {})
    small = {"training_scans": 3, "training": {"n_points": 300}}
    a = lbs.fit_scan(tube_rig, scan.points, **small)
    assert len(list(tmp_path.iterdir())) == 1
    _same(lbs.fit_scan(tube_rig, scan.points, random_state=0, **small), a)
    _same(lbs.LBSFitter(tube_rig, random_state=0, **small).fit_scan(scan.points), a)
    assert len(list(tmp_path.iterdir())) == 1
    lbs.fit_scan(tube_rig, scan.points, labels=scan.labels, random_state=1)
    assert len(list(tmp_path.iterdir())) == 1  # labels given: nothing to train


# ---- bad input ----


def _with(points, row, value):
    points = points.copy()
    points[row] = value
    return points


BAD_FITS = [
    ({"points": None}, ["points: got None"]),
    ({"points": lambda p: p.T}, ["points", "(3, 2500)", "points.T"]),
    ({"points": lambda p: p[:0]}, ["points", "empty", "at least 4"]),
    ({"points": lambda p: p[:3]}, ["points: got 3 points", "at least 4"]),
    ({"points": lambda p: np.ones_like(p)}, ["points", "all equal", "surface"]),
    ({"points": lambda p: _with(p, [7, 9], np.nan)}, ["points: got 2 of 2500", "first at index 7"]),
    ({"points": lambda p: _with(p, 3, np.inf)}, ["points: got 1 of 2500", "index 3"]),
    ({"points": lambda p: 1e200 * p}, ["points", "extent"]),
    ({"labels": np.zeros(5, int)}, ["labels: got shape (5,)", "(2500,)"]),
    ({"labels": np.zeros(2500)}, ["labels", "float64", "integers that index rig.parts"]),
    ({"labels": np.full(2500, 4)}, ["labels: got 4 at index 0", "0 to 3"]),
    ({"labels": np.r_[0, 0, -1, np.zeros(2497, int)]}, ["labels: got -1 at index 2"]),
    ({"theta0": np.zeros((3, 3))}, ["theta0: got shape (3, 3)", "(4, 3)"]),
    ({"theta0": np.full((4, 3), np.nan)}, ["theta0", "12 values", "NaN"]),
    ({"point_weights": np.ones(7)}, ["point_weights: got shape (7,)", "(2500,)"]),
    ({"point_weights": np.r_[-1.0, -2.0, np.ones(2498)]}, ["point_weights: got 2 negative", "at least 0"]),
    ({"point_weights": np.full(2500, np.nan)}, ["point_weights", "2500 values", "NaN"]),
    ({"point_weights": np.zeros(2500)}, ["point_weights: got 0 positive", "at least 4"]),
    ({"point_weights": "heavy"}, ["point_weights: got str"]),
]


@pytest.mark.parametrize("changes, words", BAD_FITS)
def test_bad_scans_are_named_before_any_training(tube_rig, scan, monkeypatch, changes, words):
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    if words[-1] != "extent":
        monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    else:
        changes = {**changes, "labels": scan.labels}
    changes = dict(changes)
    points = changes.pop("points", scan.points)
    points = points(scan.points) if callable(points) else points
    with pytest.raises(InputError) as error:
        fitter.fit_scan(points, **changes)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "parameters, words",
    [
        ({"weights": "best"}, ["weights: got 'best'", "'paper'"]),
        ({"weights": {"lam": 1.0}}, ["weights", "LossWeights"]),
        ({"joints": "loose"}, ["joints: got 'loose'", "'follow' or 'fixed'"]),
        ({"scale": 2.0}, ["scale: got 2.0", "'estimate' or 'fixed'"]),
        ({"max_points": 0}, ["max_points: got 0", "positive integer"]),
        ({"max_points": True}, ["max_points: got True"]),
        ({"training_scans": 1.5}, ["training_scans: got 1.5", "positive integer"]),
        ({"training": [1]}, ["training: got list", "dict"]),
        ({"training": {"wobble": 1.0}}, ["wobble", "not known", "noise"]),
        ({"training": {"noise": -1.0}}, ["noise: got -1.0"]),
        ({"random_state": -1}, ["random_state: got -1", "non-negative"]),
        ({"random_state": 1.5}, ["random_state: got 1.5"]),
        ({"rig": None}, ["rig: got NoneType", "load_rig"]),
        ({"variant": "best"}, ["variant: got 'best'", "'joint'", "'free-form'"]),
        ({"rounds": 0}, ["rounds: got 0", "positive integer"]),
        ({"held_out": 1.0}, ["held_out: got 1.0", "at most 0.9"]),
        ({"held_out": "some"}, ["held_out: got 'some'", "a number"]),
        ({"smooth": -1.0}, ["smooth: got -1.0", "at least 0"]),
        ({"sequence": 1}, ["sequence: got 1", "True or False"]),
    ],
)
def test_bad_parameters_are_named(tube_rig, scan, parameters, words):
    with pytest.raises(InputError) as error:
        lbs.LBSFitter(**{"rig": tube_rig, "random_state": 0, "training_scans": 1, **parameters}).fit_scan(scan.points)
    for word in words:
        assert word in str(error.value)


def test_scale_fixed_with_another_unit_is_named(tube_rig, scan):
    with pytest.raises(InputError, match=r"scale: got 'fixed' for a scan whose extent is \d+ times.*scale='estimate'"):
        lbs.LBSFitter(tube_rig, scale="fixed", random_state=0).fit_scan(1000 * scan.points, labels=scan.labels)


def test_one_call_names_its_errors_before_training(tube_rig, scan, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    with pytest.raises(InputError, match="points: got 3 points"):
        lbs.fit_scan(tube_rig, scan.points[:3])
    with pytest.raises(InputError, match="theta0"):
        lbs.fit_scan(tube_rig, scan.points, theta0=np.zeros(3))
    with pytest.raises(InputError, match="point_weights"):
        lbs.fit_scan(tube_rig, scan.points, point_weights=np.zeros(2500))
    with pytest.raises(InputError, match="rig: got str"):
        lbs.fit_scan("left.glb", scan.points)


def test_training_scans_vary_in_scale_unless_told_otherwise(tube_rig, monkeypatch):
    seen = []

    def settings_only(rig, scans, *args, **kwargs):
        seen.append(scans.settings)

    monkeypatch.setattr("lbsfit_np.learning.fitter.train_segmenter", settings_only)
    for training in (None, {"noise": 0.01}, {"scale": 0.2}, Synthesis(turn=1.0)):
        lbs.LBSFitter(tube_rig, training=training, random_state=0).pretrain()
    assert [s.scale for s in seen] == [0.05, 0.05, 0.2, 0.0]
    assert (seen[1].noise, seen[3].turn) == (0.01, 1.0)
