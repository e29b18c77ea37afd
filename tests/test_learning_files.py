"""Models in files: what is saved and loaded fits the same, and every broken file gives one clear error."""

import copy
import json
import math
import re
import zipfile
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from learning_runs import SMALL
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.errors import FileError
from lbsfit_np.fitting.result import FORMAT
from lbsfit_np.learning.parameters import fit_settings
from lbsfit_np.rig.build import build_rig
from lbsfit_np.synthesis import Synthesis


def test_the_docs_know_the_format_of_results():
    text = (Path(__file__).resolve().parents[1] / "docs" / "fitting.md").read_text(encoding="utf-8")
    assert f"| `lbsfit_np_result` | () | in the file only: the format's version, {FORMAT} |" in text


@pytest.fixture(scope="module")
def saved(learned_people, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "m.npz"
    learned_people.save(path)
    return path


@pytest.mark.usefixtures("hurried")
def test_saved_and_loaded_fits_are_the_same(learned_people, saved, people_scans):
    learned_people = copy.copy(learned_people)  # without what was made ready, and for others
    again = lbs.LBSFitter.load(saved)
    assert again.rig.digest == learned_people.rig.digest and again.rig.parts == learned_people.rig.parts
    ours, theirs = again.get_params(), learned_people.get_params()
    assert {k: v for k, v in ours.items() if k != "rig"} == {k: v for k, v in theirs.items() if k != "rig"}
    assert again.history_ == learned_people.history_ and again.unit_ == learned_people.unit_
    np.testing.assert_array_equal(again.pose_prior_.mean, learned_people.pose_prior_.mean)
    np.testing.assert_array_equal(again.pose_prior_.precision, learned_people.pose_prior_.precision)
    for name, template in learned_people.template_.items():
        np.testing.assert_array_equal(again.template_[name].vertices, template.vertices)
        np.testing.assert_array_equal(again.template_[name].joints, template.joints)
    for options in ({}, {"subject": "bob"}):
        a, b = (f.fit_scan(people_scans[12].points, **options) for f in (learned_people, again))
        for name in ("pose", "vertices", "joints", "offsets", "rest_joints", "labels", "confidence"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert a.terms == b.terms and a.message == b.message
    again.save(saved.with_name("again.npz"))
    with np.load(saved) as x, np.load(saved.with_name("again.npz")) as y:
        assert set(x.files) == set(y.files) and all(np.array_equal(x[k], y[k]) for k in x.files)


def test_what_was_learned_is_a_line_each(learned_people):
    assert re.fullmatch(r"<Segmenter: 4 parts, \d+ numbers per point, 2 stages>", repr(learned_people.segmenter_))
    assert re.fullmatch(r"<PoseLibrary: 100 poses of 4 joints, f \d+ → .*\d → 12>", repr(learned_people.regressor_))
    turning = int((learned_people.rig.upper > learned_people.rig.lower)[1:].sum())  # all but the root's
    assert repr(learned_people.pose_prior_) == f"<PosePrior: 4 joints, {turning} angles>"


def test_the_file_holds_plain_arrays_and_is_a_rig(saved, learned_people):
    with np.load(saved, allow_pickle=False) as z:
        arrays = {k: z[k] for k in z.files}
    assert {a.dtype.kind for a in arrays.values()} <= set("biufU")
    assert "lbsfit_np_model" in arrays and any(k.startswith("model_library") for k in arrays)
    assert lbs.load_rig(saved, card="none").digest == learned_people.rig.digest


@pytest.mark.parametrize(
    "parameters",
    [
        {"weights": "paper"},
        {"weights": lbs.losses.LossWeights(lam=0.5)},
        {"training": Synthesis(turn=1.0)},
        {"training": {"noise": Fraction(1, 128)}},
    ],
)
def test_parameters_travel(learned_people, tmp_path, parameters):
    fitter = copy.copy(learned_people).set_params(random_state=np.random.default_rng(0), **parameters)
    fitter.save(tmp_path / "m.npz")
    again = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert fit_settings(again) == fit_settings(fitter) and again._synthesis() == fitter._synthesis()
    assert again.random_state is None


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_other_parts_of_the_rig_travel(tmp_path, people_scans):
    rig = build_rig(make_tube_data(), parts="arm and fingers")
    fitter = lbs.LBSFitter(rig, **SMALL | {"variant": "cd", "training_scans": 60}).fit([s.points for s in people_scans[:4]])
    fitter.save(tmp_path / "m.npz")
    again = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert again.rig.parts == ("arm", "fingers") and again.segmenter_ is None
    new = people_scans[6].points
    np.testing.assert_array_equal(again.fit_scan(new).vertices, fitter.fit_scan(new).vertices)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_model_is_one_clear_error(saved, tmp_path, share):
    path = tmp_path / "cut.npz"
    path.write_bytes(saved.read_bytes()[: int(share * saved.stat().st_size)])
    with pytest.raises(FileError, match=r"cut\.npz"):
        lbs.LBSFitter.load(path)


@pytest.mark.parametrize(
    "lost", ["model_vertices", "model_library_poses", "model_stage_0_mean", "weights_data", "lbsfit_np_model"]
)
def test_a_model_that_lacks_something_is_one_clear_error(saved, tmp_path, lost):
    path = tmp_path / "less.npz"
    with zipfile.ZipFile(saved) as z:
        members = {n: z.read(n) for n in z.namelist()}
    assert members.pop(f"{lost}.npy")
    with zipfile.ZipFile(path, "w") as z:
        for name, content in members.items():
            z.writestr(name, content)
    with pytest.raises(FileError, match=r"less\.npz"):
        lbs.LBSFitter.load(path)


@pytest.mark.parametrize(
    "key, change",
    [
        ("model_vertices", lambda a: a[:, :5]),
        ("model_joints", lambda a: a[:1]),
        ("model_library_poses", lambda a: a[:, :2]),
        ("model_prior_mean", lambda a: a[:2]),
        ("model_prior_precision", lambda a: a[:2, :2]),
        ("model_prior_precision", lambda a: np.full_like(a, np.nan)),
        ("model_library_looks", lambda a: a[:, :7]),
        ("model_library_bias_0", lambda a: a[:3]),
        ("lbsfit_np_model", lambda a: np.array(str(a).replace('"format": ', '"format": 9'))),
        *(
            ("lbsfit_np_model", lambda a, changes=changes: np.array(json.dumps(json.loads(str(a)) | changes)))
            for changes in (
                {"units": [0.0, 1.0]},
                {"units": [1.0, math.nan]},
                {"units": [1.0, -1.0]},
                {"units": [1.0]},
                {"subjects": ["ann", "ann"]},
                {"subjects": ["ann", 0.5]},
                {"subjects": "ab"},
                {"library": False},
            )
        ),
        ("lbsfit_np_model", lambda a: np.array(str(a).replace('"segmenter"', '"another"'))),
        ("lbsfit_np_model", lambda a: np.array("{")),
        ("lbsfit_np_model", lambda a: np.array(str(a).replace('"joint"', '"joyful"'))),
        ("lbsfit_np_model", lambda a: np.array("[1, 2]")),
    ],
)
def test_a_model_whose_content_does_not_fit_is_one_clear_error(saved, tmp_path, key, change):
    with np.load(saved) as z:
        arrays = {k: z[k] for k in z.files}
    arrays[key] = change(arrays[key])
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(FileError, match=r"odd\.npz"):
        lbs.LBSFitter.load(tmp_path / "odd.npz")


@pytest.mark.parametrize("key", ["vertices", "joints", "upper"])
def test_a_model_with_another_rig_is_one_clear_error(saved, tmp_path, key):
    with np.load(saved) as z:
        arrays = {k: z[k] for k in z.files}
    arrays[key] = 1.01 * arrays[key]
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(FileError, match=r"odd\.npz: got a model whose .* \(its rig is not the one that it was learned with"):
        lbs.LBSFitter.load(tmp_path / "odd.npz")


def test_other_files_are_no_models(learned_people, tube_rig, tmp_path):
    tube_rig.save(tmp_path / "rig.npz")
    learned_people.results_[0].save(tmp_path / "result.npz")
    (tmp_path / "text.npz").write_text("text")
    for name in ("rig.npz", "result.npz", "text.npz", "none.npz"):
        with pytest.raises(FileError, match=name):
            lbs.LBSFitter.load(tmp_path / name)
    with pytest.raises(FileError, match="got the result of a fit; expected a model .*FitResult.load reads results"):
        lbs.LBSFitter.load(tmp_path / "result.npz")
    with pytest.raises(FileError, match="got the result of a fit; expected a rig"):
        lbs.load_rig(tmp_path / "result.npz")
    (tmp_path / "rig.glb").write_bytes(b"glTF")
    with pytest.raises(FileError, match=r"got a file that ends in \.glb; expected a model .*load_rig reads rigs"):
        lbs.LBSFitter.load(tmp_path / "rig.glb")
    with pytest.raises(FileError, match=r"m\.zip.*ends in \.npz"):
        learned_people.save(tmp_path / "m.zip")
    with pytest.raises(FileError, match="does not exist"):
        learned_people.save(tmp_path / "nowhere" / "m.npz")
