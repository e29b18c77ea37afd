"""Turned scans in other units on the command line: the truth comes back, and the options say what is open."""

import json

import numpy as np
import pytest
from cli_runs import TRAINING, one_line
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.io.write import write_points_ply
from lbsfit_np.rotations import matrix_from_rotvec

pytestmark = pytest.mark.usefixtures("own_cache")

MILLIMETRES = 250.0  # of the tube, whose unit is 25 cm
SHIFT = np.array([400.0, 0.0, -90.0])
TURNS = {"upright": matrix_from_rotvec(np.array([0.0, 2.3, 0.0])), "any": matrix_from_rotvec(np.array([1.0, -1.8, 0.9]))}


@pytest.fixture(scope="module")
def turned(tube_rig, tmp_path_factory):
    """A folder with tube.npz and turned scans in millimetres, upright.ply and any.ply; the scans as they were."""
    folder = tmp_path_factory.mktemp("turned")
    tube_rig.save(folder / "tube.npz")
    truth = dict(zip(TURNS, lbs.synthesize(tube_rig, 2, random_state=11, n_points=900)))
    for name, s in truth.items():
        write_points_ply(folder / f"{name}.ply", _moved(s.points, name))
    return folder, truth


def _moved(x, name):
    return MILLIMETRES * x @ TURNS[name].T + SHIFT


def _error(rig, result, truth, name):
    """Mean distance of the joints in half sizes of the rig."""
    return np.linalg.norm(result.joints - _moved(truth.joints, name), axis=1).mean() / (MILLIMETRES * rig.size / 2)


@pytest.mark.parametrize("name", [slow("upright"), "any"])
def test_turned_scans_in_millimetres(name, turned, tube_rig, tmp_path, run):
    folder, truth = turned
    options = () if name == "upright" else ("--orientation", name)
    code = run("fit", folder / "tube.npz", folder / f"{name}.ply", "-o", tmp_path, *TRAINING, *options)[0]
    assert code == 0
    r = lbs.FitResult.load(tmp_path / f"{name}.fit.npz")
    assert _error(tube_rig, r, truth[name], name) < 0.06
    assert r.scale == pytest.approx(MILLIMETRES, rel=0.1)
    assert "the scan seems to be in millimetres" in r.message
    posed = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
    np.testing.assert_allclose(posed, r.vertices, atol=1e-6)
    np.testing.assert_array_equal(lbs.load_scan(tmp_path / f"{name}.mesh.ply").points, r.vertices)
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["orientation"], settings["effort"], settings["partial"]) == (name, "balanced", False)


def test_a_known_up_axis_leaves_a_floor_out(tube_rig, tmp_path, run):
    """Of a scan that stands along z, on a floor: with its axis known the first look tells the floor from the body."""
    tube_rig.save(tmp_path / "tube.npz")
    side = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # y to z
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=11, n_points=900, floor=0.5)
    write_points_ply(tmp_path / "z.ply", scan.points @ TURNS["upright"].T @ side.T)
    options = ("-o", tmp_path, *TRAINING, "--effort", "fast", "--up=+z")
    assert run("fit", tmp_path / "tube.npz", tmp_path / "z.ply", *options)[0] == 0
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    r = lbs.FitResult.load(tmp_path / "z.fit.npz")
    truth = scan.joints @ TURNS["upright"].T @ side.T
    assert settings["up"] == "+z" and "points of a floor left out" in r.message and "stands along" not in r.message
    assert np.linalg.norm(r.joints - truth, axis=1).mean() / (tube_rig.size / 2) < 0.06


def test_what_is_said_of_the_orientation_holds(turned, tube_rig, tmp_path, run):
    """Said to face the rig's way, a scan that lies on its side is fitted, but wrongly."""
    folder, truth = turned
    options = ("--orientation", "aligned", "--effort", "fast")
    run("fit", folder / "tube.npz", folder / "any.ply", "-o", tmp_path, *TRAINING, *options)
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["orientation"], settings["effort"]) == ("aligned", "fast")
    if (tmp_path / "any.fit.npz").exists():
        assert _error(tube_rig, lbs.FitResult.load(tmp_path / "any.fit.npz"), truth["any"], "any") > 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("hurried")
def test_a_models_orientation_holds_unless_another_is_given(turned, tube_rig, tube_model, tmp_path, run):
    folder, truth = turned
    arguments = ("fit", tube_model[0], folder / "any.ply", "-o", tmp_path, "--existing", "replace")
    run(*arguments)
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["orientation"], settings["effort"], settings["partial"]) == ("upright", "fast", False)
    fitter = lbs.LBSFitter.load(tube_model[0])
    fitter.up = "+z"
    fitter.save(tmp_path / "z.npz")
    known = ("fit", tmp_path / "z.npz", folder / "any.ply", "-o", tmp_path / "z", "--existing", "replace", "--effort", "fast")
    for options, up in (((), "+z"), (("--orientation", "any"), None), (("--up=-x",), "-x")):
        assert run(*known, *options)[0] in (0, 1)
        assert json.loads((tmp_path / "z" / "summary.json").read_text())["settings"]["up"] == up
    assert run(*arguments, "--orientation", "any", "--effort", "balanced")[0] == 0
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["orientation"], settings["effort"]) == ("any", "balanced")
    r = lbs.FitResult.load(tmp_path / "any.fit.npz")
    assert _error(tube_rig, r, truth["any"], "any") < 0.1 and r.scale == pytest.approx(MILLIMETRES, rel=0.15)


def test_an_up_axis_is_refused_with_any_orientation_of_a_model_too(turned, tube_model, tmp_path, run):
    options = ("--orientation", "any", "--up=-x")
    code, _, err = run("fit", tube_model[0], turned[0] / "any.ply", "-o", tmp_path / "out", *options)
    assert code == 2 and one_line(err).startswith("lbsfit: error: --up: got") and not (tmp_path / "out").exists()


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_options_that_a_model_was_learned_with_are_its_own(turned, tubes, tmp_path, run):
    scans = sorted(tubes.glob("*.ply"))
    options = ("--orientation", "aligned", "--effort", "fast", "--partial", "--cropped", "--variant", "cd", "--rounds", 1)
    options += ("--held-out", 0)
    assert run("learn", tubes / "tube.npz", scans[0], "-o", tmp_path / "m.npz", *options, *TRAINING)[0] == 0
    fitter = lbs.LBSFitter.load(tmp_path / "m.npz")
    assert (fitter.orientation, fitter.effort, fitter.partial, fitter.cropped) == ("aligned", "fast", True, True)
    run("fit", tmp_path / "m.npz", scans[0], "-o", tmp_path / "fits", "--no-partial")
    settings = json.loads((tmp_path / "fits" / "summary.json").read_text())["settings"]
    assert [settings[name] for name in ("orientation", "effort", "partial", "cropped")] == ["aligned", "fast", False, True]


@pytest.mark.usefixtures("hurried")
@pytest.mark.slow
def test_learning_from_turned_scans_in_millimetres(tube_rig, tmp_path, run):
    """Each scan of a person is turned in its own way."""
    person = tube_rig.subject(4, amount=1.0)
    clean = {"noise": 0.0, "holes": 0, "density": 0.0, "n_points": 700}  # few starts find the poses of these
    scans = lbs.synthesize(tube_rig, 4, templates=[(person.vertices, person.joints)], random_state=3, **clean)
    tube_rig.save(tmp_path / "tube.npz")
    turns = [matrix_from_rotvec(np.array([0.0, a, 0.0])) for a in (0.4, 2.0, -2.5, -1.0)]
    for i, (s, turn) in enumerate(zip(scans, turns)):
        write_points_ply(tmp_path / f"s{i}.ply", MILLIMETRES * s.points @ turn.T + SHIFT)
    files = sorted(tmp_path.glob("s*.ply"))
    out = ("-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    assert run("learn", tmp_path / "tube.npz", *files, *out, *TRAINING, "--effort", "fast", "--rounds", 1)[0] == 0
    for i, (s, turn) in enumerate(zip(scans, turns)):
        r = lbs.FitResult.load(tmp_path / "fits" / f"s{i}.fit.npz")
        true = MILLIMETRES * s.joints @ turn.T + SHIFT
        assert np.linalg.norm(r.joints - true, axis=1).mean() / (MILLIMETRES * tube_rig.size / 2) < 0.06
        posed = tube_rig.pose(r.pose, r.translation, r.scale, r.offsets, joints=r.rest_joints)
        np.testing.assert_allclose(posed, r.vertices, atol=1e-6)
    assert lbs.LBSFitter.load(tmp_path / "m.npz").unit_[0] == pytest.approx(MILLIMETRES, rel=0.15)
