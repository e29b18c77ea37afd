"""``--unit`` as a user says it: of fits, of learning, of models, and what animations make of it."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from animated_files import Viewer
from cli_runs import QUICK, QUICK_LEARNING, one_line, program
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.cli.learn import _units
from lbsfit_np.rig.build import build_rig

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")

# One unit of the tube rig is 0.25 m; the kit is 0.4 times as large, which in centimetres looks like a tube in inches.
CM, KIT = 25.0, 0.4


@pytest.fixture(scope="module")
def kits(tubes, tmp_path_factory):
    """Scans of small tubes, in centimetres."""
    folder = tmp_path_factory.mktemp("kits")
    for path in sorted(tubes.glob("*.ply")):
        np.save(folder / f"{path.stem}.npy", KIT * CM * lbs.load_scan(path).points)
    return sorted(folder.glob("*.npy"))


@pytest.fixture(scope="module")
def kit_model(tubes, kits, cli_cache, tmp_path_factory):
    """A model of these scans that was told their unit, the folder of its results, and what was printed."""
    out = tmp_path_factory.mktemp("kit model")
    options = ("-o", out / "m.npz", "--results", out / "fits", "--unit", "cm", *QUICK_LEARNING)
    done = program("learn", tubes / "tube.npz", *kits, *options, cache=cli_cache, hurried=True)
    assert done.returncode == 0, done.stderr
    return out / "m.npz", out / "fits", done.stdout


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def length(vertices):
    return np.linalg.norm(np.ptp(vertices, axis=0))


def animated(run, rig, fit, path, *options):
    """What is printed, and how long the posed mesh is, in metres."""
    code, out, err = run("animate", rig, fit, "-o", path, *options)
    assert (code, err) == (0, "")
    return out, length(Viewer(path).draw())


def test_a_small_animal_in_centimetres(tubes, kits, tmp_path, run):
    rig = tubes / "tube.npz"
    code, _, err = run("fit", rig, kits[0], "-o", tmp_path / "fits", *QUICK, "--unit", "cm")
    assert (code, err) == (0, "")
    r = lbs.FitResult.load(tmp_path / "fits" / "t0.fit.npz")
    assert r.unit == "cm" and r.scale == pytest.approx(KIT * CM, rel=0.1)
    size = float(re.search(r"in centimetres, and the subject is ([\d.]+) times as large as the rig", r.message)[1])
    assert size == pytest.approx(r.scale / CM, abs=0.006) and "inches" not in r.message
    told = summary(tmp_path / "fits")
    assert told["settings"]["unit"] == "cm" and told["scans"][0]["unit"] == "cm"
    fit = tmp_path / "fits" / "t0.fit.npz"
    out, metres = animated(run, rig, fit, tmp_path / "a.glb")
    assert "the scans are in centimetres, as specified when they were fitted (use --unit to change this)" in out
    assert metres == pytest.approx(0.01 * length(r.vertices), rel=0.05)
    assert animated(run, rig, fit, tmp_path / "b.glb", "--unit", "m")[1] == pytest.approx(100 * metres)


def test_fits_in_another_unit_are_not_kept(tubes, kits, tmp_path, run):
    fit = ["fit", tubes / "tube.npz", kits[0], "-o", tmp_path, *QUICK]
    assert run(*fit, "--unit", "cm")[0] == 0
    assert run(*fit, "--unit", "cm", "--existing", "skip")[0] == 0
    for unit, said in (("in", "in 'in'"), ("auto", "in an unspecified unit")):
        code, _, err = run(*fit, "--unit", unit, "--existing", "skip")
        assert code == 2 and f"of a scan in 'cm'; expected fits of scans {said}. Give --unit as in that run" in one_line(err)


def test_without_a_unit_the_message_says_that_it_may_be_another(tubes, kits, tmp_path, run):
    assert run("fit", tubes / "tube.npz", kits[0], "-o", tmp_path / "fits", *QUICK)[0] == 0
    r, told = lbs.FitResult.load(tmp_path / "fits" / "t0.fit.npz"), summary(tmp_path / "fits")
    assert r.unit == "" and told["settings"]["unit"] is None and told["scans"][0]["unit"] is None
    assert re.search(r"seems to be in inches: .* \(in centimetres 0\.\d\d times as large as the rig: .* or --unit\)", r.message)


def test_a_configuration_file_says_the_unit(tubes, kits, tmp_path, run):
    (tmp_path / "fit.toml").write_text(f'output = "{tmp_path}/fits"\nunit = "mm"\n')
    code, out, err = run("fit", tubes / "tube.npz", kits[0], *QUICK, "--config", tmp_path / "fit.toml")
    assert code == 1 and "unit: got 'mm', in which the scan's extent is 0.0" in out + err and "(--unit auto)" in out + err
    (tmp_path / "fit.toml").write_text(f'output = "{tmp_path}/fits"\nunit = "inch"\n')
    code, _, err = run("fit", tubes / "tube.npz", kits[0], *QUICK, "--config", tmp_path / "fit.toml")
    assert code == 2 and "unit = 'inch'; expected 'auto' or 'm' or 'cm'" in one_line(err)


@pytest.mark.parametrize("command", ["fit", "learn"])
def test_a_rig_without_a_unit_is_an_error_before_any_work(command, kits, tmp_path, run):
    build_rig(replace(make_tube_data(), metres_per_unit=None)).save(tmp_path / "tube.npz")
    out = tmp_path / ("m.npz" if command == "learn" else "fits")
    code, _, err = run(command, tmp_path / "tube.npz", *kits, "-o", out, "--unit", "cm")
    assert code == 2 and "--unit: got 'cm' with the rig 'tube', whose own unit is not known; expected a rig" in one_line(err)
    assert "card ([rig] unit)" in err and not out.exists()


# ---- models ----


def test_learning_tells_the_sizes_of_subjects(tubes, kits, kit_model):
    model, folder, printed = kit_model
    fitter = lbs.LBSFitter.load(model)
    assert (fitter.unit, fitter.learned_unit_) == ("cm", "cm") and _units(fitter) in printed
    said = r"scans are in centimetres, as specified; subjects are ([\d.]+) times as large as the rig"
    size = float(re.search(said, printed)[1])
    assert size == pytest.approx(KIT, rel=0.15)
    for fit in folder.glob("*.fit.npz"):
        r = lbs.FitResult.load(fit)
        assert r.unit == "cm" and "the scan is in centimetres, and the subject is 0." in r.message


def test_a_models_unit_holds_unless_another_is_given(kits, kit_model, tmp_path, run):
    model = kit_model[0]
    assert run("fit", model, kits[0], "-o", tmp_path / "a")[0] == 0
    assert summary(tmp_path / "a")["settings"]["unit"] == "cm"
    r = lbs.FitResult.load(tmp_path / "a" / "t0.fit.npz")
    assert r.unit == "cm" and "in centimetres, and the subject is 0." in r.message
    np.save(tmp_path / "mm.npy", 10 * np.load(kits[0]))
    assert run("fit", model, tmp_path / "mm.npy", "-o", tmp_path / "b", "--unit", "mm")[0] == 0
    other = lbs.FitResult.load(tmp_path / "b" / "mm.fit.npz")
    assert other.unit == "mm" and other.scale == pytest.approx(10 * r.scale, rel=1e-9)  # as the subject is known to be
    assert run("fit", model, tmp_path / "mm.npy", "-o", tmp_path / "c", "--unit", "auto")[0] == 0
    assert summary(tmp_path / "c")["settings"]["unit"] is None
    unknown = lbs.FitResult.load(tmp_path / "c" / "mm.fit.npz")
    assert unknown.unit == "" and unknown.scale == pytest.approx(other.scale, rel=0.1)
