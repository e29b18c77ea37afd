"""The result of a fit: its fields, the rig's own vertices, and the file that it is kept in."""

import copy
import json
import re
import zipfile
from dataclasses import fields, replace
from fractions import Fraction

import numpy as np
import pytest
from fit_checks import assert_same
from small_rigs import make_tube_data, with_loose_vertices

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting.result import FitResult
from lbsfit_np.learning.made_with import settings_of
from lbsfit_np.losses import PRESETS, chamfer, cotangent_matrix, structured_chamfer
from lbsfit_np.optimize.registration import Registration
from lbsfit_np.rig.build import build_rig
from lbsfit_np.synthesis import Synthesis


def test_fields_and_shapes(tube_rig, tube_result, tube_scan):
    J, m, n = 4, len(tube_rig.vertices), len(tube_scan.points)
    shapes = {
        "pose": (J, 3),
        "translation": (3,),
        "offsets": (m, 3),
        "rest_joints": (J, 3),
        "vertices": (m, 3),
        "joints": (J, 3),
        "joint_std": (J,),
        "labels": (n,),
        "confidence": (n,),
        "left_out": (n,),
        "took_part": (n,),
        "term_labels": (n,),
    }
    for name, shape in shapes.items():
        array = getattr(tube_result, name)
        assert array.shape == shape, name
        assert np.isfinite(array).all() and array.flags.writeable  # which SciPy asks for
    assert tube_result.labels.dtype.kind == "i" and set(tube_result.labels) <= set(range(4))
    assert (tube_result.confidence > 0).all() and (tube_result.confidence <= 1 + 1e-12).all()
    assert tube_result.status == "ok" and isinstance(tube_result.converged, bool) and tube_result.message
    assert isinstance(tube_result.evaluations, int) and tube_result.evaluations > 10 and tube_result.seconds > 0
    assert tube_result.parts == tube_rig.parts and tube_result.rig_digest == tube_rig.digest
    assert set(tube_result.terms) == {"chamfer", "structured", "laplacian", "total", "recon"}
    assert all(isinstance(v, float) for v in tube_result.terms.values())


@pytest.mark.usefixtures("hurried")
def test_a_result_knows_what_it_was_made_with(tube_rig, tube_scan, tmp_path):
    """By whichever way, as plain data; all parameters that a fit hangs on, and no others."""
    weights, rng = replace(PRESETS["paper"], lam=0.5), np.random.default_rng(0)
    given = {"weights": weights, "max_points": np.int64(300), "training": Synthesis(noise=0.01), "effort": "fast"}
    made = lbs.LBSFitter(tube_rig, random_state=rng, n_jobs=1, **given).fit_scan(tube_scan.points, labels=tube_scan.labels)
    plain = {"max_points": 300, "effort": "fast", "random_state": None, "version": lbs.__version__}
    assert made.settings.items() >= plain.items() and made.settings["weights"]["lam"] == 0.5
    assert made.settings["training"]["noise"] == 0.01
    left_out = {"rig", "n_jobs", "unit", "rounds", "held_out", "sequence", "smooth"}
    assert set(made.settings) == set(lbs.LBSFitter(tube_rig).get_params()) - left_out | {"version"}
    assert json.loads(json.dumps(made.settings)) == made.settings
    odd = {"training": {"noise": Fraction(1, 100)}, "weights": replace(PRESETS["default"], lam=Fraction(1, 2))}
    odd = settings_of(lbs.LBSFitter(tube_rig, partial=np.bool_(False), **odd))  # which all that fits can use
    assert odd["training"] == {"noise": 0.01} and odd["weights"]["lam"] == 0.5 and odd["partial"] is False
    with pytest.raises(InputError, match="settings: got what JSON cannot store .*set"):
        replace(made, settings={"a": {1}}).save(tmp_path / "a.npz")
    with pytest.raises(InputError, match="settings: got a list; expected a dict"):
        replace(made, settings=[1]).save(tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())
    one_call = lbs.fit_scan(tube_rig, tube_scan.points, labels=tube_scan.labels, effort="fast", random_state=5)
    assert one_call.settings["random_state"] == 5 and one_call.settings["weights"] == "default"


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("joints", ["follow", "fixed"])
@pytest.mark.parametrize("weights", ["default", "paper"])
def test_vertices_are_the_pose_of_the_results_own_fields(tube_rig, tube_scan, joints, weights, monkeypatch):
    fitter = lbs.LBSFitter(tube_rig, joints=joints, weights=weights, effort="fast", random_state=0)
    points = 100 * tube_scan.points + [5.0, 0.0, 1.0]
    r = fitter.fit_scan(points, labels=tube_scan.labels)
    arguments = r.pose, r.translation, r.scale, r.offsets
    np.testing.assert_array_equal(tube_rig.pose(*arguments, joints=r.rest_joints), r.vertices)
    np.testing.assert_array_equal(tube_rig.pose_joints(*arguments, joints=r.rest_joints), r.joints)
    if joints == "fixed":
        np.testing.assert_array_equal(r.rest_joints, tube_rig.joints)
    else:  # they follow the offsets before registration, but for what girths, two of them, move of the skin alone
        monkeypatch.setattr(Registration, "__call__", lambda self, problem, state: state)
        before = fitter.fit_scan(points, labels=tube_scan.labels)
        np.testing.assert_array_equal(r.rest_joints, before.rest_joints)
        assert np.abs(r.offsets - before.offsets).max() > 1e-4
        girths = (tube_rig.regressor @ tube_rig.proportions.girths.reshape(len(tube_rig.vertices), -1)).reshape(-1, 2)
        away = (tube_rig.joints + tube_rig.regressor @ before.offsets - r.rest_joints).ravel()
        c = np.linalg.lstsq(girths, away, rcond=None)[0]
        np.testing.assert_allclose(girths @ c, away, rtol=0, atol=1e-11)
        assert np.abs(c).max() < 0.5
    bounded = slice(1, None)
    assert (r.pose[bounded] >= tube_rig.lower[bounded]).all() and (r.pose[bounded] <= tube_rig.upper[bounded]).all()
    assert np.abs(r.offsets).max() > 1e-4


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("orientation", ["aligned", "upright"])
@pytest.mark.parametrize("weights", ["default", "paper"])
def test_terms_are_the_losses_of_the_result(tube_rig, tube_scan, weights, orientation):
    """In half sizes of the posed rig, recomputed from what the result says, in whatever unit the scan is."""
    fitter = lbs.LBSFitter(tube_rig, weights=weights, orientation=orientation, effort="fast", random_state=0)
    points = 1400.0 * tube_scan.points
    r, w = fitter.fit_scan(points, labels=tube_scan.labels), PRESETS[weights]
    unit = r.scale * tube_rig.size / 2
    X, Vd, V = points / unit, r.vertices / unit, tube_rig.pose(r.pose, r.translation, r.scale) / unit
    labels = tube_scan.labels, tube_rig.vertex_labels
    expected = {
        "chamfer": chamfer(X, Vd)[0] + w.lam * chamfer(X, V)[0],
        "structured": structured_chamfer(X, Vd, *labels)[0] + w.lam * structured_chamfer(X, V, *labels)[0],
        "recon": np.sqrt(chamfer(X, Vd)[0]),
    }
    K = cotangent_matrix(tube_rig.vertices, tube_rig.faces)
    moved = r.offsets / (tube_rig.size / 2) if w.laplacian == "offsets" else Vd
    expected["laplacian"] = np.linalg.norm(K @ moved) ** (2 if w.squared else 1)
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


def test_a_result_says_which_points_it_is_of(tube_rig, tube_fitter, tube_scan):
    """Of a floor, of weight 0, and more than take part: terms are those of what took part alone."""
    rng = np.random.default_rng(0)
    low = tube_scan.points.min(axis=0)[1]
    floor = np.column_stack([rng.uniform(-2, 2, 800), low + 0.005 * rng.standard_normal(800), rng.uniform(-2, 2, 800)])
    points, n = np.vstack([tube_scan.points, floor]), len(tube_scan.points)
    weights = np.ones(len(points))
    weights[:50] = 0.0
    r = copy.copy(tube_fitter).set_params(max_points=300).fit_scan(points, point_weights=weights)
    assert "of a floor" in r.message and r.took_part.sum() <= 300 < (~r.left_out).sum()
    assert r.left_out[:50].all() and r.left_out[50:n].mean() < 0.1 and r.left_out[n:].mean() > 0.9
    assert not (r.left_out & r.took_part).any()
    # Labels of what is none of the rig's say nothing, and the message counts all that was left out but points without weight.
    off = r.left_out & (weights > 0)
    assert not r.confidence[off].any() and r.confidence[:50].mean() > 0.5 < r.confidence[50:n].mean()
    assert re.search(r"of a floor left out \(of \d+ examined\), (\d+) of all 1800", r.message)[1] == str(off.sum())
    known = copy.copy(tube_fitter).fit_scan(points, labels=np.where(r.left_out, -1, r.labels))
    assert "examined" not in known.message and not known.confidence[known.left_out].any()
    assert (known.confidence[50:n] == 1).mean() > 0.9
    unit = r.scale * tube_rig.size / 2
    X, V = points[r.took_part] / unit, r.vertices / unit
    assert r.terms["recon"] == pytest.approx(np.sqrt(chamfer(X, V)[0]), rel=1e-9)


@pytest.mark.usefixtures("hurried")
def test_results_are_for_the_rigs_original_vertices(tube_scan):
    rig = build_rig(_split(make_tube_data()))
    assert len(rig.vertices) == 1440 and len(rig.welded.vertices) == 242
    split = lbs.LBSFitter(rig, effort="fast", random_state=0).fit_scan(tube_scan.points, labels=tube_scan.labels)
    whole = lbs.LBSFitter(rig.welded, effort="fast", random_state=0).fit_scan(tube_scan.points, labels=tube_scan.labels)
    assert split.vertices.shape == split.offsets.shape == (1440, 3)
    np.testing.assert_array_equal(split.pose, whole.pose)
    np.testing.assert_array_equal(split.offsets, whole.offsets[rig.weld])
    np.testing.assert_allclose(split.vertices, whole.vertices[rig.weld], atol=1e-12)
    np.testing.assert_allclose(split.joints, whole.joints, atol=1e-12)
    place = split.pose, split.translation, split.scale, split.offsets
    np.testing.assert_array_equal(rig.pose(*place, joints=split.rest_joints), split.vertices)


@pytest.mark.usefixtures("hurried")
def test_vertices_of_no_face_change_no_fit(tube_scan):
    """They are nothing that a scan shows, wherever they lie: known labels lead through all terms of the objective."""
    places = np.array([[0.0, 9, 0], [0.05, 0.1, 0], [-3, 0, 0]])
    rig = build_rig(with_loose_vertices(make_tube_data(), places))
    assert len(rig.vertices) == 245 and len(rig.welded.vertices) == 242
    fitters = (lbs.LBSFitter(r, effort="fast", random_state=0) for r in (rig, rig.welded))
    found, whole = (f.fit_scan(tube_scan.points, labels=tube_scan.labels) for f in fitters)
    np.testing.assert_array_equal(found.pose, whole.pose)
    np.testing.assert_array_equal(found.vertices[3:], whole.vertices)
    np.testing.assert_array_equal(found.offsets[:3], whole.offsets[rig.weld[:3]])  # of the nearest vertices
    assert found.terms == whole.terms and (found.status, found.probability) == (whole.status, whole.probability)


@pytest.mark.usefixtures("hurried")
def test_results_keep_joints_that_do_not_move(tube_rig, tube_scan):
    data = make_tube_data()
    held = build_rig(replace(data, locked=np.array([False, False, False, True])))
    labels = np.minimum(tube_scan.labels, len(held.parts) - 1)
    r = lbs.LBSFitter(held, effort="fast", random_state=0).fit_scan(tube_scan.points, labels=labels)
    assert r.pose.shape == (4, 3) and (r.pose[3] == 0).all() and r.joints.shape == (4, 3)


def test_repr_is_a_line(tube_result):
    m = len(tube_result.vertices)
    short = replace(tube_result, probability=0.98765, message="all is well")
    assert repr(short) == f"<FitResult: ok, probability 0.99, {m} vertices, 4 joints: all is well>"
    assert repr(replace(short, message="a" * 80)).endswith(f": {'a' * 80}>")
    assert repr(replace(short, message="no " * 100)).endswith(f"{('no ' * 100)[:80]}…>")


# ---- saving ----


def test_saved_and_loaded(tube_result, tmp_path):
    tube_result.save(tmp_path / "a.fit.npz")
    again = FitResult.load(tmp_path / "a.fit.npz")
    assert_same(again, tube_result, leave_out=())
    for f in fields(FitResult):
        assert type(getattr(again, f.name)) is type(getattr(tube_result, f.name)), f.name
    assert again.vertices.flags.writeable


@pytest.mark.parametrize("name, words", [("noext", "a name without an ending"), ("a.fit", "the ending '.fit'")])
def test_a_name_without_the_ending_is_refused(name, words, tube_result, tmp_path):
    """As by rigs and fitters."""
    with pytest.raises(FileError, match=f"{words}; expected a name that ends in .npz"):
        tube_result.save(str(tmp_path / name))
    assert not list(tmp_path.iterdir())


def test_a_folder_is_no_name_of_a_result(tube_result, tmp_path):
    with pytest.raises(FileError, match="got a folder; expected the name of a file to write, which ends in .npz"):
        tube_result.save(tmp_path)


def test_a_result_is_no_scan(tube_result, tmp_path):
    tube_result.save(tmp_path / "a.fit.npz")
    with pytest.raises(FileError, match=r"got the result of a fit; expected a scan.*FitResult\.load"):
        lbs.load_scan(tmp_path / "a.fit.npz")


def test_the_file_is_plain_arrays_under_documented_keys(tube_result, tmp_path):
    tube_result.save(tmp_path / "a.fit.npz")
    with np.load(tmp_path / "a.fit.npz", allow_pickle=False) as z:
        keys, arrays = set(z.files), {k: z[k] for k in z.files}
    assert keys == {f.name for f in fields(FitResult)} | {"lbsfit_np_result"}
    assert all(key in FitResult.save.__doc__ for key in keys)
    assert {a.dtype.kind for a in arrays.values()} <= set("biufU")
    assert json.loads(str(arrays["terms"])) == tube_result.terms
    assert json.loads(str(arrays["settings"])) == tube_result.settings
    np.testing.assert_array_equal(arrays["vertices"], tube_result.vertices)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.6, 0.99])
def test_a_truncated_result_is_one_clear_error(tube_result, tmp_path, share):
    path = tmp_path / "a.fit.npz"
    tube_result.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileError, match=r"a\.fit\.npz"):
        FitResult.load(path)


@pytest.mark.parametrize("lost", ["pose", "terms", "scale", "lbsfit_np_result"])
def test_a_result_that_lacks_something_is_one_clear_error(tube_result, tmp_path, lost):
    path = tmp_path / "a.fit.npz"
    tube_result.save(path)
    with zipfile.ZipFile(path) as z:
        members = {n: z.read(n) for n in z.namelist() if n != f"{lost}.npy"}
    with zipfile.ZipFile(path, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError, match=lost):
        FitResult.load(path)


def test_other_files_are_no_results(tube_rig, tube_result, tmp_path):
    tube_rig.save(tmp_path / "rig.npz")
    (tmp_path / "b.npz").write_text("text")
    np.savez(tmp_path / "future.npz", lbsfit_np_result=99)
    for name, words in (("none.npz", "no such file"), ("rig.npz", "lbsfit_np_result"), ("b.npz", "broken"), ("future.npz", "99")):
        with pytest.raises(FileError, match=words):
            FitResult.load(tmp_path / name)
    with pytest.raises(FileError, match="does not exist"):
        tube_result.save(tmp_path / "nowhere" / "a.npz")


def test_scipy_takes_what_a_result_holds(tube_result):
    """It asks for arrays that can be written to."""
    from scipy.spatial.transform import Rotation

    assert np.isfinite(Rotation.from_rotvec(tube_result.pose).as_quat()).all()
