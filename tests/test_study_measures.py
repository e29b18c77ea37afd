"""The study's measures, on scans made by hand, and what a run takes them of."""

from dataclasses import replace

import numpy as np
import pytest

from lbsfit_np.bench.measure import joint_error, label_accuracy, vertex_error
from lbsfit_np.bench.study import data
from lbsfit_np.bench.study.data import SCAN, Size, part_groups
from lbsfit_np.bench.study.measures import POINTS, Registrations, Truth, measured, true_places
from lbsfit_np.bench.study.rows import ROWS, Found
from lbsfit_np.bench.study.run import study
from lbsfit_np.bench.templates import template_gap
from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.synthesis import SyntheticScan, synthesize

# ---- measures ----


class Tensor:
    """An array of another library, which NumPy can read."""

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.array, dtype=dtype)


def _scan(rig, theta, template=None, points=None):
    """The scan whose points are the vertices of a posed template, (vertices, joints)."""
    U, J = (rig.vertices, rig.joints) if template is None else template
    posed = {"offsets": U - rig.vertices, "joints": J}
    vertices, joints = (of(theta, **posed) for of in (rig.pose, rig.pose_joints))
    points = vertices.copy() if points is None else points
    none = np.zeros(len(points), int)
    corner = np.argsort(rig.faces.ravel(), kind="stable")[np.searchsorted(np.sort(rig.faces.ravel()), np.arange(len(points)))]
    triangle, barycentric = corner // 3, np.eye(3)[corner % 3]  # of each vertex, a face of its own
    return SyntheticScan(points, none, theta, np.zeros(3), 1.0, U, J, vertices, joints, triangle, barycentric)


@pytest.fixture(scope="module")
def posed(tube_rig):
    """The tube in three poses."""
    rng = np.random.default_rng(0)
    return [_scan(tube_rig, 0.5 * t * (tube_rig.upper + tube_rig.lower) * rng.random(tube_rig.lower.shape)) for t in (0, 1, 2)]


def test_the_snap_is_to_the_point_nearest_to_where_the_registration_leads(tube_rig, posed):
    """Vertices registered at each other's places, and a little beside them: the snap undoes the little, not the rest."""
    truth, V = Truth(tube_rig, posed[:2], 2, 0), posed[1].vertices
    truth.pairs = np.array([[0, 1]])
    order = np.random.default_rng(1).permutation(len(V))
    beside = np.array([0.0, 0.0, 1e-3])  # far less than vertices are apart
    found = measured(truth, Registrations(np.array([posed[0].vertices, V[order] + beside]), np.zeros((2, 4, 3))))
    rows = [np.flatnonzero((posed[0].points == p).all(axis=1))[0] for p in truth.points[0]]
    plain, snapped = (np.linalg.norm(V[order] + b - V, axis=1)[rows] / truth.half for b in (beside, 0.0))
    assert snapped.mean() > 0.4 and abs(plain.mean() - snapped.mean()) > 1e-6
    assert found["corre"]["mean"] == pytest.approx(plain.mean(), abs=1e-9)
    assert found["corre_snapped"]["mean"] == pytest.approx(snapped.mean(), abs=1e-9)
    assert found["corre_snapped"]["p90"] == pytest.approx(np.percentile(snapped, 90), abs=1e-9)


def test_the_true_place_is_where_the_point_was_taken_from(tube_rig, posed):
    """Also where another limb is nearer; noise along the surface counts for nothing."""
    scan, V = posed[1], posed[1].vertices
    far = np.linalg.norm(V - V[0], axis=1).argmax()
    points = scan.points.copy()
    points[0] = V[far]  # as if the far end touched it
    corners, barycentric = true_places(tube_rig, replace(scan, points=points))
    found = np.einsum("nk,nka->na", barycentric, V[corners])
    np.testing.assert_allclose(found[1:], V[1:], atol=1e-12)
    edges = np.linalg.norm(V[tube_rig.faces] - V[np.roll(tube_rig.faces, 1, axis=1)], axis=2)
    assert np.linalg.norm(found[0] - V[0]) <= edges.max() < 0.3 * np.linalg.norm(V[far] - V[0])
    middle = V[corners[5]].mean(axis=0)
    corners, barycentric = true_places(tube_rig, replace(scan, points=np.where(np.arange(len(V))[:, None] == 5, middle, V)), [5])
    np.testing.assert_allclose(np.einsum("nk,nka->na", barycentric, V[corners]), [middle], atol=1e-12)


def test_percentiles_are_over_the_points_of_all_pairs(tube_rig, posed):
    """8 % of the vertices of one scan a half size off, and no others: 4 % of the points of two pairs."""
    truth = Truth(tube_rig, posed, 6, 0)
    truth.pairs = np.array([[0, 1], [0, 2]])
    V = np.array([s.vertices for s in posed])
    off = np.arange(V.shape[1]) % 12 == 0
    V[1, off] += [0.0, 0.0, truth.half]
    corre = measured(truth, Registrations(V, np.array([s.joints for s in posed])))["corre"]
    n = V.shape[1]
    assert len(truth.points[0]) == n and 0.08 < off.mean() < 0.1
    assert corre["mean"] == pytest.approx(off.mean() / 2, abs=1e-9)
    assert corre["p50"] == corre["p90"] == pytest.approx(0, abs=1e-9)  # means of the pairs: off.mean() / 2 and more
    assert corre["p95"] == pytest.approx(0, abs=1e-9)  # of the first pair alone: 1
    V[2, off] += [0.0, truth.half, 0.0]
    corre = measured(truth, Registrations(V, np.array([s.joints for s in posed])))["corre"]
    assert corre["p90"] == pytest.approx(0, abs=1e-9) and corre["p95"] == pytest.approx(1, abs=1e-9)


class _Made(list):
    """Scans as the study has them, each made anew when it is asked for; counts how often."""

    asked = 0

    def __getitem__(self, i):
        self.asked += 1
        return super().__getitem__(i)


def test_each_scan_is_made_once_for_its_errors_and_once_for_its_pairs(tube_rig, posed):
    """However many pairs lead to it. And a median is no mean."""
    truth = Truth(tube_rig, _Made(posed), 6, 0)
    joints = np.array([s.joints + [0.0, 0.0, k**2 * truth.half] for k, s in enumerate(posed)])
    found = measured(truth, Registrations(np.array([s.vertices for s in posed]), joints))
    assert len(truth.pairs) == 6 and truth.scans.asked == 2 * len(posed)
    assert found["pose_median"] == pytest.approx(1.0) and found["pose"] == pytest.approx(5 / 3)


def test_a_scan_that_was_not_fitted_counts_in_no_truth(tube_rig, posed):
    truth = Truth(tube_rig, posed, 6, 0)
    truth.recon, truth.pose = np.array([1.0, 2.0, 4.0]), np.array([3.0, 5.0, 9.0])
    V = np.array([s.vertices for s in posed])
    V[1] = np.nan
    found = measured(truth, Registrations(V, np.array([s.joints for s in posed])))
    assert (found["recon_truth"], found["pose_truth"], found["unfitted"]) == (2.5, 6.0, 1)


def test_registrations_are_of_all_scans_in_their_order(tube_rig, posed):
    """One left out would have all after it compared with other scans; NaN says which could not be fitted."""
    truth = Truth(tube_rig, posed, 6, 0)
    V, joints = [s.vertices for s in posed], [s.joints for s in posed]
    for given, words in (
        (Registrations(V[1:], joints[1:]), r"registrations.vertices: got those of 2 scans; expected those of 3, one for each"),
        (Registrations(V, joints[1:]), "registrations.joints: got those of 2 scans"),
        (Registrations([V[0], V[1][1:], V[2]], joints), r"registrations.vertices: got an array of shape \(241, 3\) for scan 1"),
        (Registrations(V, [*joints[:2], None]), r"registrations.joints: got an array of shape \(\) for scan 2.* arrays of NaN"),
        ((V, joints), "registrations: got a tuple; expected Registrations"),
    ):
        with pytest.raises(InputError, match=words):
            measured(truth, given)
    for lost in ((V[:2] + [np.full_like(V[2], np.nan)], joints), (V, joints[:2] + [np.full_like(joints[2], np.nan)])):
        assert measured(truth, Registrations(*lost))["unfitted"] == 1


def test_registrations_may_be_what_numpy_makes_arrays_of(tube_rig, posed):
    """Lists, tensors, or what gives one after the other."""
    truth = Truth(tube_rig, posed, 6, 0)
    V, joints = [s.vertices + 0.01 for s in posed], [s.joints for s in posed]
    known = measured(truth, Registrations(V, joints))
    for way in (lambda a: a.tolist(), Tensor):
        assert measured(truth, Registrations(map(way, V), tuple(map(way, joints)))) == known
    gap = template_gap(tube_rig, [V[0]], [posed[0].template])
    assert template_gap(tube_rig, [V[0].tolist()], [posed[0].template.tolist()]) == gap
    assert joint_error(joints[0].tolist(), Tensor(joints[1]), tube_rig.moving) == joint_error(*joints[:2], tube_rig.moving)
    with pytest.raises(InputError, match="registrations.joints: got None; expected a sequence of arrays"):
        Registrations(V, None)


def test_measures_stretch_nothing(tube_rig, posed):
    """One row would be compared with each of the true ones, scores with labels."""
    s = posed[0]
    with pytest.raises(InputError, match=r"vertices: got shape \(1, 3\); expected shape \(242, 3\)"):
        vertex_error(s.vertices[:1], s.vertices)
    with pytest.raises(InputError, match=r"true_vertices: got shape \(3,\); expected shape \(k, 3\)"):
        vertex_error(s.vertices[0], s.vertices[0])
    with pytest.raises(InputError, match=r"true_labels: got shape \(0,\); expected shape \(n,\)"):
        label_accuracy([], [])
    with pytest.raises(InputError, match="vertices: got str; expected numbers of shape"):
        vertex_error("mesh.ply", s.vertices)
    with pytest.raises(InputError, match=r"joints: got shape \(3, 3\); expected shape \(4, 3\)"):
        joint_error(s.joints[:3], s.joints, tube_rig.moving)
    for moving in ([1, 1, 0, 1], [True] * 3, [False] * 4, slice(None), [[True], [True, False]]):
        with pytest.raises(InputError, match="moving: got .*; expected True or False for each of 4 joints, one of them True"):
            joint_error(s.joints, s.joints, moving)
    for labels, words in ((s.labels[:1], r"labels: got shape \(1,\)"), (np.eye(4)[s.labels], r"scores.argmax\(axis=1\)")):
        with pytest.raises(InputError, match=words):
            label_accuracy(labels, s.labels)
    assert label_accuracy(s.labels.tolist(), s.labels) == 1.0


def test_scans_are_of_the_truths_rig(coarse_hand, posed):
    with pytest.raises(InputError, match="scans: got scan 0 of a rig with 242 vertices; expected scans of the rig 'hand-coarse'"):
        Truth(coarse_hand, posed, 6, 0)


@pytest.mark.parametrize("dirt", ["clutter", "floor"])
def test_scans_are_of_the_mesh_alone(dirt, tube_rig):
    scans = synthesize(tube_rig, 2, n_points=100, random_state=0, **{dirt: 0.2})
    with pytest.raises(InputError, match="scans: got scan 0 with [0-9]+ points of clutter or a floor; expected scans of the"):
        Truth(tube_rig, scans, 2, 0)


def test_the_poses_truth_has_the_regressors_joints(tube_rig):
    """At rest the distance between a person's own joints and those that the regressor says; in a pose the same, posed."""
    templates = [(s.vertices, s.joints) for s in (tube_rig.subject(3, amount=1.5), tube_rig.subject(4, amount=1.5))]
    templates = [(U, J + [0.0, 0.02 * k, 0.01]) for k, (U, J) in enumerate(templates, start=1)]
    theta = 0.6 * tube_rig.upper
    scans = [_scan(tube_rig, np.zeros_like(theta), templates[0]), _scan(tube_rig, theta, templates[1])]
    truth, rig, moving = Truth(tube_rig, scans, 2, 0), tube_rig, tube_rig.moving
    (U, J), regressed = templates[0], tube_rig.with_template(templates[1][0]).pose_joints(theta)
    at_rest = np.linalg.norm(rig.joints + rig.regressor @ (U - rig.vertices) - J, axis=1)[moving].mean() / truth.half
    bent = np.linalg.norm(regressed - scans[1].joints, axis=1)[moving].mean() / truth.half
    assert min(at_rest, bent) > 0.01 and abs(at_rest - bent) > 0.01
    V, joints = (np.array([getattr(s, what) for s in scans]) for what in ("vertices", "joints"))
    assert measured(truth, Registrations(V, joints))["pose_truth"] == pytest.approx((at_rest + bent) / 2)
    V[0] = np.nan  # a scan that was not fitted counts in neither
    found = measured(truth, Registrations(V, joints))
    assert found["pose_truth"] == pytest.approx(bent) and found["pose"] == 0 and found["unfitted"] == 1


def test_points_and_pairs_are_drawn_anew_for_each_seed(tube_rig):
    scans = synthesize(tube_rig, 5, random_state=2, n_points=POINTS + 200, holes=0)
    one, again, other = (Truth(tube_rig, scans, 7, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(one.points[i], again.points[i]) for i in one.points) and np.array_equal(one.pairs, again.pairs)
    assert not np.array_equal(one.pairs, other.pairs)
    every = np.array([(a, b) for a in range(5) for b in range(5) if a != b])
    for truth in (one, other):
        assert len(set(map(tuple, truth.pairs))) == 7 and set(map(tuple, truth.pairs)) < set(map(tuple, every))
        assert not np.array_equal(truth.pairs, every[:7])
        assert set(truth.points) == set(truth.places) == set(truth.pairs.ravel().tolist())  # of others nothing is kept
        for i, points in truth.points.items():
            assert points.shape == (POINTS, 3) and not np.array_equal(points, scans[i].points[:POINTS])
    both = one.points.keys() & other.points.keys()
    assert both and not any(np.array_equal(np.sort(one.points[i], axis=0), np.sort(other.points[i], axis=0)) for i in both)


def test_the_truth_has_no_errors(coarse_hand, tiny_study):
    truth = Truth(tiny_study.rig, tiny_study.test, 6, 0)
    found = measured(truth, Registrations(*(np.array([getattr(s, n) for s in tiny_study.test]) for n in ("vertices", "joints"))))
    assert found["pose"] == found["vertices"] == found["unfitted"] == 0
    assert found["recon"] == pytest.approx(found["recon_truth"]) and found["recon"] > 0
    assert found["corre"]["p50"] < 1e-12 and found["corre"]["mean"] < 2e-3  # where limbs touch, the nearest is another's
    assert 0 < found["corre_snapped"]["mean"] < 0.05
    assert found["corre_snapped"]["p50"] <= found["corre_snapped"]["p90"] <= found["corre_snapped"]["p95"]


def test_errors_are_in_half_sizes_and_of_the_right_pairs(coarse_hand, tiny_study):
    truth = Truth(tiny_study.rig, tiny_study.test, 6, 0)
    assert sorted(map(tuple, truth.pairs)) == [(0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1)]
    shift = np.array([0.0, 0.0, 0.1 * (tiny_study.rig.size / 2)])
    vertices = np.array([s.vertices + (i == 2) * shift for i, s in enumerate(tiny_study.test)])
    joints = np.array([s.joints + (i == 2) * shift for i, s in enumerate(tiny_study.test)])
    found = measured(truth, Registrations(vertices, joints))
    assert found["pose"] == pytest.approx(0.1 / 3) and found["vertices"] == pytest.approx(0.1 / 3)
    # Carried to the shifted one: off by the shift. From it, to the others: its points find other places of the surface.
    assert 0.1 / 3 < found["corre"]["mean"] < 0.1
    lost = measured(truth, Registrations(np.where(np.arange(3)[:, None, None] == 2, np.nan, vertices), joints))
    assert lost["of_scans"] == {name: [*of[:2], None] for name, of in found["of_scans"].items()}
    assert all(found[name] == pytest.approx(np.mean(of)) for name, of in found["of_scans"].items())
    assert lost["unfitted"] == 1 and lost["corre"]["p50"] < 1e-12 and lost["corre"]["mean"] < 2e-3
    assert measured(truth, Registrations(np.full_like(vertices, np.nan), joints)) == {"unfitted": 3}


def test_template_gaps(coarse_hand):
    half, U = coarse_hand.size / 2, coarse_hand.vertices
    found = template_gap(coarse_hand, [U + [0, 0, 0.2 * half]], [U + [0, 0, 0.3 * half]])
    assert found["before"] == pytest.approx(0.3) and found["after"] == pytest.approx(0.1)
    assert found["before, up to a shift"] == pytest.approx(0, abs=1e-12) == found["after, up to a shift"]


# ---- what a run measures ----


def test_labels_are_judged_by_groups_and_training_by_its_own_truth(tube_rig, monkeypatch):
    """The wrong part of the right group is right; and the truth of the training scans has no errors on them."""
    shares = {}

    def find(c):
        rig, groups = c.given.rig, part_groups(c.given.rig)
        rest = [[q for q in range(len(groups)) if q != p] for p in range(len(groups))]
        same = np.array([next((q for q in others if groups[q] == groups[p]), p) for p, others in enumerate(rest)])
        other = np.array([next(q for q in others if groups[q] != groups[p]) for p, others in enumerate(rest)])
        assert (same != np.arange(len(groups))).mean() > 0.5 and len(rig.parts) == len(groups)
        for name, said in {"same": same, "other": other}.items():
            shares[name] = c.right([said[s.labels] for s in c.given.test])
        shares["half of them"] = c.right([(same if k else other)[s.labels] for k, s in enumerate(c.given.test)])
        shares["one not fitted"] = c.right([None, same[c.given.test[1].labels]])
        true = [
            Registrations(*(np.array([getattr(s, what) for s in scans]) for what in ("vertices", "joints")))
            for scans in (c.given.test, c.given.train)
        ]
        return Found(*true)

    monkeypatch.setattr("lbsfit_np.bench.study.making.ROWS", {"joint": replace(ROWS["joint"], find=find, pretrained=False)})
    monkeypatch.setattr("lbsfit_np.bench.study.run.along_path", lambda rig: None)
    monkeypatch.setitem(data.SIZES, "small", Size(2, 2, 1, 1, 2, 50, 1, 1))
    monkeypatch.setattr(data, "SCAN", replace(SCAN, n_points=100))
    cell = study({"h": load_rig("hand-coarse")}, rows=("joint",), seeds=[1])["rigs"]["h"]["seeds"]["1"]["joint"]
    assert shares == {"same": 1.0, "other": 0.0, "half of them": 0.5, "one not fitted": 1.0}
    for found in (cell, cell["on_training"]):
        assert found["pose"] == found["vertices"] == found["unfitted"] == 0
        assert found["recon"] == pytest.approx(found["recon_truth"])
        assert found["corre"]["p50"] < 1e-12 and found["corre"]["mean"] < 3e-3
    assert cell["on_training"]["recon"] != cell["recon"]
