"""``lbsfit animate`` as a user runs it."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from animated_files import Viewer
from cli_runs import one_line, program

import lbsfit_np as lbs
from lbsfit_np.fitting.several import stands_along

pytestmark = pytest.mark.usefixtures("own_cache")


def test_fits_become_an_animation(fitted, made, cli_cache, tmp_path):
    fits = [fitted[0] / f"{name}.fit.npz" for name in ("one", "two")]
    done = program("animate", made / "tube.npz", *fits, "-o", tmp_path / "a.glb", "--fps", "10", cache=cli_cache)
    assert (done.returncode, done.stderr) == (0, "")
    words = r"a.glb written: 2 frames, whose vertices are (\S+) % of the rig's size .* at most (\S+) % \((one|two)\.fit\.npz\)"
    mean, most = map(float, re.search(words, done.stdout).groups()[:2])
    rig, results = lbs.load_rig(made / "tube.npz"), [lbs.FitResult.load(fit) for fit in fits]
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.times, [0, 0.1], rtol=1e-6)
    away = []
    for time, r in zip(viewer.times, results, strict=True):
        drawn = viewer.draw(time) / rig.metres_per_unit  # the tube is 0.25 m long, and so are the scans
        away.append(100 * np.linalg.norm(drawn - r.vertices, axis=1).mean() / (rig.size * r.scale))
    assert "the scans seem to be in the rig's unit (use --unit to change this)" in done.stdout
    assert mean == pytest.approx(np.mean(away), rel=0.06) and most == pytest.approx(max(away), rel=0.06) and most < 5


def test_each_its_own_offsets_in_the_unit_of_gltf(fitted, made, tmp_path, run):
    fits = [fitted[0] / f"{name}.fit.npz" for name in ("one", "two")]
    options = ("--offsets", "each", "--unit", "mm", "--up=+z")
    code, out, err = run("animate", made / "tube.npz", *fits, "-o", tmp_path / "a.glb", *options)
    assert (code, err) == (0, "") and out.endswith("a.glb written: 2 frames\n")
    viewer = Viewer(tmp_path / "a.glb")
    for time, fit in zip(viewer.times, fits, strict=True):
        x, y, z = lbs.FitResult.load(fit).vertices.T
        np.testing.assert_allclose(1000 * viewer.draw(time), np.column_stack([x, z, -y]), atol=1e-5)


def test_a_models_fits_of_one_subject_differ_by_residuals_alone(tube_model, tmp_path, run):
    model, folder = tube_model
    code, out, err = run("animate", model, *sorted(folder.glob("*.fit.npz")), "-o", tmp_path / "a.glb")
    assert (code, err) == (0, "") and "is a learned model" in out and "4 frames" in out and "several subjects" not in out
    assert float(re.search(r"are (\S+) %", out)[1]) < 1.0


def test_scans_in_other_units_are_named(fitted, made, tmp_path, run):
    fit = lbs.FitResult.load(fitted[0] / "one.fit.npz")
    for name, scale in (("a", 1.0), ("b", 1.2), ("c", 100.0)):
        vertices = scale * (fit.vertices - fit.translation) + fit.translation
        replace(fit, scale=scale * fit.scale, vertices=vertices).save(tmp_path / f"{name}.fit.npz")
    fits = [tmp_path / f"{name}.fit.npz" for name in "abc"]
    code, out, err = run("animate", made / "tube.npz", *fits, "-o", tmp_path / "a.glb")
    assert (code, err) == (0, "")
    assert "note: the scale of c.fit.npz differs from the others' by more than people do; are all scans in one unit?" in out
    assert "one unit?" not in run("animate", made / "tube.npz", *fits[:2], "-o", tmp_path / "b.glb")[1]
    words = r"of results\[2\] differs from the others' by more than people do; are all scans in one unit"
    with pytest.warns(UserWarning, match=words):
        lbs.save_animation(tmp_path / "c.glb", lbs.load_rig(made / "tube.npz"), [lbs.FitResult.load(f) for f in fits])


def test_a_unit_that_some_fits_alone_say_is_said_to_be_taken_for_all(fitted, made, tmp_path, run):
    fit = lbs.FitResult.load(fitted[0] / "one.fit.npz")
    for name, unit in (("a", "mm"), ("b", ""), ("c", "mm")):
        replace(fit, unit=unit).save(tmp_path / f"{name}.fit.npz")
    for names, said in (("ac", "are in millimetres, as specified when they were fitted"),
                        ("ab", "are taken to be in millimetres, as specified when 1 of the 2 was fitted"),
                        ("abc", "are taken to be in millimetres, as specified when 2 of the 3 were fitted")):  # fmt: skip
        fits = [tmp_path / f"{name}.fit.npz" for name in names]
        assert f"the scans {said}" in run("animate", made / "tube.npz", *fits, "-o", tmp_path / f"{names}.glb")[1]


def test_fits_that_would_lie_are_told_how_to_stand(fitted, made, tmp_path, run):
    """As those of scans along z are with a rig along y: by the turn of the whole, of all of them."""
    fit = lbs.FitResult.load(fitted[0] / "one.fit.npz")
    pose = fit.pose.copy()
    pose[0] = [np.pi / 2 - 0.2, 0.0, 0.0]
    replace(fit, pose=pose).save(tmp_path / "z.fit.npz")
    lying = ["animate", made / "tube.npz", tmp_path / "z.fit.npz", "--existing", "replace", "-o", tmp_path / "a.glb"]
    code, out, err = run(*lying)
    assert (code, err) == (0, "")
    assert "note: the fits stand along +z: use --up=+z for an upright animation, unless they lie down\n" in out
    assert "stand along" not in run(*lying, "--up=+z")[1]
    for angle, axis in ((0.9, None), (1.2, "+z"), (-1.2, "-z")):  # what leans by half stands along none
        leans = replace(fit, pose=np.vstack([[angle, 0.0, 0.0], pose[1:]]))
        assert stands_along(lbs.load_rig(made / "tube.npz"), [leans]) == axis
    assert "fits stand along +z" in run(*lying, "--up=+y")[1]
    assert "stand along" not in run(*lying, fitted[0] / "one.fit.npz")[1]  # one that stands and one that leans
    with pytest.warns(UserWarning, match=r"stand along \+z: pass up='\+z'"):
        lbs.save_animation(tmp_path / "c.glb", lbs.load_rig(made / "tube.npz"), replace(fit, pose=pose))
    rig = replace(lbs.load_rig(made / "tube.npz"), up=None, forward=None)
    assert stands_along(rig, [replace(fit, pose=pose)]) is None  # nobody knows how it stands


def test_fewer_influences_are_not_made_up_for_by_offsets(fitted, made, tmp_path, run):
    fits = [fitted[0] / f"{name}.fit.npz" for name in ("one", "two")]
    for options, hint in (((), True), (("--influences", "1"), False), (("--influences", "1", "--offsets", "each"), False)):
        out = run("animate", made / "tube.npz", *fits, "-o", tmp_path / "a.glb", "--existing", "replace", *options)[1]
        assert "registered meshes" in out and ("with --offsets each" in out) == hint, options


def test_fits_that_may_be_wrong_are_named(fitted, made, tmp_path, run):
    for name, status, subject in (("a10", "ok", "tom"), ("a9", "suspect", "tom"), ("a11", "failed", "")):
        replace(lbs.FitResult.load(fitted[0] / "one.fit.npz"), status=status, subject=subject).save(tmp_path / f"{name}.fit.npz")
    fits = [tmp_path / f"{name}.fit.npz" for name in ("a10", "a9", "a11")]
    code, out, _ = run("animate", made / "tube.npz", *fits, "-o", tmp_path / "a.glb")
    assert code == 0 and (tmp_path / "a.glb").is_file() and "registered meshes" not in out  # which are the same one
    assert "note: 1 fit has status suspect: a9.fit.npz" in out and "note: 1 fit has status failed: a11.fit.npz" in out
    assert "note: a9.fit.npz is given after a10.fit.npz: these files are not in order of their numbers" in out
    assert "several subjects (no learned subject, 'tom'): all frames use the mean of their templates, which has one size" in out
    large = lbs.FitResult.load(fits[0])
    replace(large, scale=2 * large.scale).save(tmp_path / "a12.fit.npz")
    out = run("animate", made / "tube.npz", fits[2], fits[0], tmp_path / "a12.fit.npz", "-o", tmp_path / "c.glb")[1]
    assert "Frames keep these scales." in out and "several subjects" in out and "which has one size" not in out
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "a9.fit.npz").write_bytes(fits[1].read_bytes())
    out = run("animate", made / "tube.npz", fits[1], tmp_path / "again" / "a9.fit.npz", "-o", tmp_path / "b.glb")[1]
    assert f"note: 2 fits have status suspect: {fits[1]}, {tmp_path / 'again' / 'a9.fit.npz'}" in out  # of one name


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("FIT", "-o", "a.gltf"), ("-o/--output", "ends in .glb")),
        (("FIT",), ("-o/--output", "Add -o OUT.glb")),
        (("FIT", "-o", "there.glb"), ("exists already", "--existing replace")),
        (("SCAN", "-o", "a.glb"), ("FIT", "one.ply", "NAME.fit.npz")),
        (("RIG", "-o", "a.glb"), ("tube.npz", "without the key lbsfit_np_result")),
        (("none.fit.npz", "-o", "a.glb"), ("none.fit.npz", "no such file")),
        (("OTHER", "-o", "a.glb"), ("other.fit.npz", "a fit of another rig", "'tube'")),
        (("NAN", "-o", "a.glb"), ("nan.fit.npz", "not finite")),
        (("CM", "MM", "-o", "a.glb"), ("FIT: got fits of scans in cm (cm.fit.npz), mm (mm.fit.npz)",)),
        (("FIT", "-o", "a.glb", "--fps", "0"), ("--fps", "a positive number")),
        (("FIT", "-o", "a.glb", "--influences", "0"), ("--influences", "at least 1")),
        (("FIT", "-o", "no/a.glb"), ("no/a.glb", "Create it first")),
    ],
)
def test_what_cannot_be_written_is_one_line(arguments, words, fitted, made, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.glb").write_bytes(b"mine")
    fit = lbs.FitResult.load(fitted[0] / "one.fit.npz")
    replace(fit, rig_digest="other").save("other.fit.npz")
    replace(fit, offsets=fit.offsets * np.nan).save("nan.fit.npz")
    for unit in ("cm", "mm"):
        replace(fit, unit=unit).save(f"{unit}.fit.npz")
    shutil.copy(fitted[0] / "one.fit.npz", "one.fit.npz")
    files = {"FIT": "one.fit.npz", "OTHER": "other.fit.npz", "NAN": "nan.fit.npz", "CM": "cm.fit.npz", "MM": "mm.fit.npz"}
    files |= {"SCAN": made / "one.ply", "RIG": made / "tube.npz"}
    code, _, err = run("animate", made / "tube.npz", *(files.get(a, a) for a in arguments))
    line = one_line(err)
    assert code == 2 and all(word in line for word in words), line
    assert not (tmp_path / "a.glb").exists() and (tmp_path / "there.glb").read_bytes() == b"mine"
    if "there.glb" in arguments:
        assert run("animate", made / "tube.npz", "one.fit.npz", *arguments[1:], "--existing", "replace")[0] == 0
        assert Viewer(tmp_path / "there.glb").mesh
