"""Bad scans and bad parameters of a fit are named before any training."""

import re
from dataclasses import replace
from inspect import signature
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.scan_fit import FitSettings, ScanFit
from lbsfit_np.learning.batch import fit_scans
from lbsfit_np.losses import LossWeights
from lbsfit_np.optimize.model import Model
from lbsfit_np.starts.scale import near_rows


def _with(points, row, value):
    points = points.copy()
    points[row] = value
    return points


BAD_FITS = [
    ({"points": None}, ["points: got None"]),
    ({"points": lambda p: p.T}, ["points", "(3, 1000)", "points.T"]),
    ({"points": np.ones((424, 512))}, ["points", "(424, 512)", "Turn a depth image into points by its camera's intrinsics"]),
    ({"points": lambda p: p[:0]}, ["points", "empty", "at least 4"]),
    ({"points": lambda p: p[:3]}, ["points: got 3 points", "at least 4"]),
    ({"points": lambda p: np.repeat(p[:3], 100, axis=0)}, ["points: got 300 points, of which 3 are distinct", "least 4"]),
    ({"points": lambda p: list(np.ma.masked_greater(p, np.sort(p, axis=None)[-2]))}, ["got a list with 1 of 1000 points"]),
    ({"points": lambda p: np.ones_like(p)}, ["points", "all equal", "surface"]),
    ({"points": lambda p: _with(p, [7, 9], np.nan)}, ["points: got 2 of 1000", "first at index 7"]),
    ({"points": lambda p: _with(p, 3, np.inf)}, ["points: got 1 of 1000", "index 3"]),
    ({"points": lambda p: 1e200 * p}, ["points", "extent"]),
    ({"labels": np.zeros(5, int)}, ["labels: got shape (5,)", "(1000,)"]),
    ({"labels": [[1], [1, 2]]}, ["labels: got rows of different lengths", "(1000,), one for each point"]),
    ({"labels": np.zeros(1000)}, ["labels", "float64", "integers that index rig.parts"]),
    ({"labels": np.full(1000, 4)}, ["labels: got 4 at index 0", "0 to 3"]),
    ({"labels": np.r_[0, 0, -2, np.zeros(997, int)]}, ["labels: got -2 at index 2", "-1 where the part is not known"]),
    ({"labels": np.full(1000, -1)}, ["labels: got -1 for all points", "Leave labels out"]),
    ({"labels": np.ones((1000, 4))}, ["labels: got shape (1000, 4)", "proba.argmax(axis=1)"]),
    ({"labels": np.ma.masked_less(np.r_[0, 0, np.ones(998, int)], 1)}, ["labels: got a masked array with 2 of 1000 rows masked"]),
    ({"theta0": np.ma.masked_equal(np.eye(4, 3), 1.0)}, ["theta0: got a masked array with 3 of 4 rows masked"]),
    ({"theta0": np.zeros((3, 3))}, ["theta0: got shape (3, 3)", "(4, 3), a row for each joint"]),
    ({"theta0": np.diag([7.0, -7.0, 0.0, 0.0])[:, :3]}, ["theta0: got an angle of -7 for joint", "at most 6.28", "degrees"]),
    ({"theta0": np.full((4, 3), np.nan)}, ["theta0", "12 values", "NaN"]),
    ({"theta0": np.full((4, 3), 90.0)}, ["theta0: got an angle of 90", "radians", "degrees"]),
    ({"point_weights": np.ones(7)}, ["point_weights: got shape (7,)", "(1000,)"]),
    ({"point_weights": np.r_[-1.0, -2.0, np.ones(998)]}, ["point_weights: got 2 negative", "at least 0"]),
    ({"point_weights": np.r_[-1.0, np.ones(999)]}, ["point_weights: got 1 negative value;"]),
    ({"point_weights": np.r_[np.nan, np.ones(999)]}, ["point_weights: got 1 value that is NaN"]),
    ({"point_weights": np.ma.masked_less(np.arange(1000.0), 7)}, ["point_weights: got a masked array with 7 of 1000 rows"]),
    (
        {"points": lambda p: np.vstack([p, p[:1], p[:1], p[:1]]), "point_weights": np.r_[1.0, np.zeros(999), np.ones(3)]},
        ["point_weights: got 4 positive values, of 1 distinct point; expected at least 4, as many as the rig has parts"],
    ),
    ({"point_weights": np.full(1000, np.nan)}, ["point_weights", "1000 values", "NaN"]),
    ({"point_weights": np.zeros(1000)}, ["point_weights: got 0 positive", "at least 4"]),
    ({"point_weights": "heavy"}, ["point_weights: got str"]),
]


@pytest.mark.parametrize("changes, words", BAD_FITS)
def test_bad_scans_are_named_before_any_training(tube_rig, tube_scan, monkeypatch, changes, words):
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    if words[-1] != "extent":
        monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    else:
        changes = {**changes, "labels": tube_scan.labels}
    changes = dict(changes)
    points = changes.pop("points", tube_scan.points)
    points = points(tube_scan.points) if callable(points) else points
    with pytest.raises(InputError) as error:
        fitter.fit_scan(points, **changes)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "parameters, words",
    [
        ({"weights": "best"}, ["weights: got 'best'", "'paper'"]),
        ({"weights": {"lam": 1.0}}, ["weights", "LossWeights"]),
        ({"weights": LossWeights(chamfer=0, lam_s=0)}, ["weights: got chamfer=0 and lam_s=0;", "a larger chamfer or lam_s."]),
        ({"weights": LossWeights(chamfer=0), "variant": "cd"}, ["weights: got chamfer=0 without labels", "a larger chamfer."]),
        ({"joints": "loose"}, ["joints: got 'loose'", "'follow' or 'fixed'"]),
        ({"scale": 2.0}, ["scale: got 2.0", "'estimate' or 'fixed'"]),
        ({"max_points": 0}, ["max_points: got 0", "positive integer"]),
        ({"max_points": 3}, ["max_points: got 3", "at least 4"]),
        ({"joints": np.zeros(3)}, ["joints: got array", "'follow' or 'fixed'"]),
        ({"orientation": np.eye(3)}, ["orientation: got array", "'any'"]),
        ({"smooth": np.inf, "sequence": True}, ["smooth: got inf", "at most 1e+06"]),
        ({"max_points": True}, ["max_points: got True"]),
        ({"training_scans": 1.5}, ["training_scans: got 1.5", "positive integer"]),
        ({"training": [1]}, ["training: got list", "dict"]),
        ({"training": {"wobble": 1.0}}, ["wobble", "an unknown setting", "noise"]),
        ({"training": {"noise": -1.0}}, ["training: got noise: -1.0"]),
        ({"random_state": -1}, ["random_state: got -1", "non-negative"]),
        ({"random_state": 1.5}, ["random_state: got 1.5"]),
        ({"rig": None}, ["rig: got NoneType", "load_rig"]),
        ({"variant": "best"}, ["variant: got 'best'", "'joint'", "'free-form'"]),
        ({"variant": ["joint"]}, ["variant: got ['joint']", "'joint'"]),
        ({"random_state": np.random.RandomState(0)}, ["random_state: got RandomState", "numpy.random.Generator or None"]),
        ({"rounds": 0}, ["rounds: got 0", "positive integer"]),
        ({"held_out": 1.0}, ["held_out: got 1.0", "at most 0.9"]),
        ({"held_out": "some"}, ["held_out: got 'some'", "a number"]),
        ({"smooth": -1.0}, ["smooth: got -1.0", "at least 0"]),
        ({"smooth": 1e-5}, ["smooth: got 1e-05 without sequence", "sequence=True"]),
        ({"sequence": 1}, ["sequence: got 1", "True or False"]),
        ({"orientation": "sideways"}, ["orientation: got 'sideways'", "'aligned', 'upright' or 'any'"]),
        ({"orientation": None}, ["orientation: got None", "'upright'"]),
        ({"orientation": ["any"]}, ["orientation: got ['any']"]),
        ({"up": "z"}, ["up: got 'z'", "'+z'", "or None", "Did you mean '+z'?"]),
        ({"effort": "fst"}, ["effort: got 'fst'", "Did you mean 'fast'?"]),
        ({"variant": "pose_only"}, ["variant: got 'pose_only'", "Did you mean 'pose-only'?"]),
        ({"up": np.array([0, 0, 1.0])}, ["up: got array", "'+z'"]),
        ({"up": "+z", "orientation": "any"}, ["up: got '+z' with orientation 'any'", "Leave it out"]),
        ({"effort": "most"}, ["effort: got 'most'", "'fast', 'balanced' or 'thorough'"]),
        ({"effort": 3}, ["effort: got 3", "'balanced'"]),
        ({"partial": "yes"}, ["partial: got 'yes'", "True or False"]),
        ({"partial": 1}, ["partial: got 1", "True or False"]),
        ({"registration": "off"}, ["registration: got 'off'", "True or False"]),
        ({"scale": ["fixed"]}, ["scale: got ['fixed']", "'estimate' or 'fixed'"]),
    ],
)
def test_bad_parameters_are_named(tube_rig, tube_scan, parameters, words):
    with pytest.raises(InputError) as error:
        lbs.LBSFitter(**{"rig": tube_rig, "random_state": 0, "training_scans": 1, **parameters}).fit_scan(tube_scan.points)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"weights": {"lam": 1.0}}, "weights: got {'lam': 1.0}; expected a LossWeights or one of 'paper'"),
        ({"scale": "fxed"}, "scale: got 'fxed'; expected 'estimate' or 'fixed'. Did you mean 'fixed'?"),
        ({"unit": "x"}, "unit: got 'x'; expected 'm', 'cm', 'mm', 'in', 'ft' or None."),
        ({"effort": "x"}, "effort: got 'x'; expected 'fast', 'balanced' or 'thorough'."),
        ({"cropped": 1}, "cropped: got 1; expected True or False"),
        ({"max_points": 0}, "max_points: got 0; expected a positive integer"),
        ({"polish": -1}, "polish: got -1; expected an integer of at least 0"),
        ({"pose_iterations": 2.5}, "pose_iterations: got 2.5; expected an integer"),
        ({"plain_iterations": True}, "plain_iterations: got True; expected an integer"),
        ({"full_iterations": None}, "full_iterations: got None; expected an integer"),
        ({"full_tolerance": np.nan}, "full_tolerance: got nan; expected a finite number of at least 0"),
        ({"polish_ridge": -1e-5}, "polish_ridge: got -1e-05; expected a finite number"),
        ({"ridge": "1"}, "ridge: got '1'; expected a finite number"),
        ({"doubt": 1.5}, "doubt: got 1.5; expected a probability, at most 1"),
        ({"refinements": ()}, "refinements: got (); expected one or more positive numbers, from 1e-100 to 1e+100. Pass a tuple"),
        ({"refinements": (0.1, 0.0)}, "refinements: got (0.1, 0.0); expected one or more positive numbers"),
        ({"refinements": [np.inf]}, "refinements: got [inf]; expected one or more positive numbers"),
        ({"refinements": 0.1}, "refinements: got 0.1; expected one or more positive numbers"),
    ],
)
def test_bad_settings_are_named_where_they_are_made(settings, words):
    with pytest.raises(InputError) as error:
        FitSettings(**settings)
    assert str(error.value).startswith(words)


def test_settings_are_plain():
    made = FitSettings(weights="paper", refinements=[np.float32(0.5), 1], partial=np.True_, ridge=np.float32(0.25))
    assert made == FitSettings(weights=LossWeights(), refinements=(0.5, 1.0), partial=True, ridge=0.25)
    assert [type(value) for value in (*made.refinements, made.partial, made.ridge)] == [float, float, bool, float]


@pytest.mark.parametrize(
    "settings, words",
    [({"max_points": 3}, "max_points: got 3; expected at least 4, as many"), ({"unit": "cm"}, "unit: got 'cm' with the rig")],
)
def test_settings_that_do_not_suit_the_rig_are_named_as_it_is_fitted(settings, words, tube_rig, tube_scan):
    rig = replace(tube_rig, metres_per_unit=None)
    with pytest.raises(InputError, match=words):
        ScanFit(Model(rig), FitSettings(**settings)).fit(tube_scan.points, labels=tube_scan.labels)


@pytest.mark.usefixtures("hurried")
def test_a_fit_without_parts_needs_the_plain_term(tube_rig, fitter, tube_scan):
    """Nothing else would compare the mesh with the scan; free-form fits have weights of their own for that."""
    weights, points, labels = LossWeights(chamfer=0.0), tube_scan.points, tube_scan.labels
    fit = ScanFit(Model(tube_rig), FitSettings(weights=weights, effort="fast", full_iterations=1))
    with pytest.raises(InputError, match="weights: got chamfer=0 without labels.*at least one term that compares the mesh"):
        fit.fit(points, theta0=tube_scan.pose)
    assert fit.fit(points, labels=labels).terms.keys() == {"structured", "laplacian", "total", "recon"}
    fit.settings = FitSettings(weights=weights.replace(lam_s=0), effort="fast")
    with pytest.raises(InputError, match="weights: got chamfer=0 and lam_s=0"):
        fit.fit(points, labels=labels)
    with pytest.raises(InputError, match="weights: got chamfer=0 without labels"):  # before any training
        fitter.set_params(variant="cd", weights=weights).pretrain()
    loose = fitter.set_params(variant="free-form", weights=weights.replace(lam_s=0)).fit_scan(points)
    assert loose.status == "ok" and loose.terms.keys() == {"chamfer", "laplacian", "total", "recon"}


@pytest.mark.parametrize("n_jobs", [0, -3, True, 1.5, "2"])
def test_numbers_of_processes_that_cannot_be_are_named_where_none_are_started(tube_rig, tube_scan, n_jobs):
    fitter = lbs.LBSFitter(tube_rig, random_state=0, n_jobs=n_jobs)
    with pytest.raises(InputError, match="n_jobs: got .*expected a positive whole number of processes"):
        fitter.fit_scan(tube_scan.points, labels=tube_scan.labels)


def test_scale_fixed_with_another_unit_is_named(tube_rig, tube_scan):
    with pytest.raises(InputError, match=r"scale: got 'fixed' for a scan whose extent is \d+ times.*scale='estimate'"):
        lbs.LBSFitter(tube_rig, scale="fixed", random_state=0).fit_scan(1000 * tube_scan.points, labels=tube_scan.labels)


@pytest.mark.parametrize("seed", [0, None, np.random.default_rng(3)])
def test_scans_that_no_fit_takes_are_refused_before_training(seed, tube_rig, tube_scan, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    before = seed.bit_generator.state if isinstance(seed, np.random.Generator) else None
    fitter = lbs.LBSFitter(tube_rig, scale="fixed", random_state=seed, max_points=100)
    for points, words in (
        (1000 * tube_scan.points, "scale: got 'fixed' for a scan whose extent is "),
        (1e200 * tube_scan.points, r"points: got an extent of \S+e\+(200|199); expected .* Give them in another unit"),
        (1e308 / np.abs(tube_scan.points).max() * tube_scan.points, r"points: got an extent of \S+e\+308; expected "),
    ):
        with pytest.raises(InputError, match=words):
            fitter.fit_scan(points)
        (outcome,) = fit_scans(fitter, [points], pretrain=lambda fitter: pytest.fail("trained first"))
        assert re.search(words, outcome.error)
    assert before is None or seed.bit_generator.state == before


def test_one_call_has_the_names_of_all_parameters_and_tells_of_training(tube_rig, tube_scan, tmp_path, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path))
    names = list(signature(lbs.fit_scan).parameters)
    assert names[:2] == ["rig", "points"] and {"effort", "partial", "cropped", "n_jobs", "theta0", "progress"} < set(names)
    assert len(names) == len(set(names)) and not {"self", "parameters"} & set(names)
    shares, few = [], {"training_scans": 2, "training": {"n_points": 100}, "effort": "fast"}
    lbs.fit_scan(tube_rig, tube_scan.points, progress=shares.append, **few)
    assert shares == sorted(shares) and shares[-1] == 1.0
    with pytest.raises(InputError, match="progress"):
        lbs.fit_scan(tube_rig, tube_scan.points, progress="bar", **few)


def test_one_call_names_its_errors_before_training(tube_rig, tube_scan, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", lambda *a, **k: pytest.fail("trained first"))
    with pytest.raises(InputError, match="points: got 3 points"):
        lbs.fit_scan(tube_rig, tube_scan.points[:3])
    with pytest.raises(InputError, match="theta0"):
        lbs.fit_scan(tube_rig, tube_scan.points, theta0=np.zeros(3))
    with pytest.raises(InputError, match="point_weights"):
        lbs.fit_scan(tube_rig, tube_scan.points, point_weights=np.zeros(1000))
    with pytest.raises(InputError, match="rig: got str"):
        lbs.fit_scan("left.glb", tube_scan.points)
    with pytest.raises(InputError, match="efort: got an unknown argument; expected one of .*Did you mean 'effort'"):
        lbs.fit_scan(tube_rig, tube_scan.points, efort="fast")
    with pytest.raises(InputError, match="point_weight: got .* of theta0, labels, point_weights, .*Did you mean 'point_weights'"):
        lbs.fit_scan(tube_rig, tube_scan.points, point_weight=np.ones(1000))
    words = r"one_sided: got .* pass partial=True. Pass training={'one_sided': \.\.\.}: it is a setting"
    with pytest.raises(InputError, match=words):
        lbs.fit_scan(tube_rig, tube_scan.points, one_sided=True)
    with pytest.raises(InputError, match=r"noise: got an unknown argument; .* Pass training={'noise': \.\.\.}"):
        lbs.fit_scan(tube_rig, tube_scan.points, noise=0.1)
    with pytest.raises(InputError, match="points: got a SimpleNamespace; expected numbers"):
        lbs.fit_scan(tube_rig, SimpleNamespace(vertices=tube_scan.points))
    with pytest.raises(InputError, match=r"subject: got an argument for fits with a model; .*LBSFitter.load\(model\)"):
        lbs.fit_scan(tube_rig, tube_scan.points, subject="ann")


def test_weights_of_any_size_are_weights(tube_rig, tube_scan):
    weights = np.linspace(0.5, 1.0, len(tube_scan.points))
    fitter = lbs.LBSFitter(tube_rig, random_state=0)
    found = [fitter.fit_scan(tube_scan.points, labels=tube_scan.labels, point_weights=w) for w in (weights, 2.0**1023 * weights)]
    np.testing.assert_array_equal(found[0].pose, found[1].pose)


def test_points_given_many_times_do_not_make_the_others_clutter(tube_scan):
    points = np.vstack([tube_scan.points, np.repeat(tube_scan.points[:1], 20 * len(tube_scan.points), axis=0)])
    rows, dropped = near_rows(points, np.arange(len(points)))
    assert dropped == 0 and len(rows) == len(points)


def test_a_path_where_points_belong_is_told_how_to_be_read(quick_fitter):
    for path in ("a.ply", b"a.ply", Path("a.ply")):
        with pytest.raises(InputError, match=r"points: got the path 'a.ply'.*Read a file with load_scan"):
            quick_fitter.fit_scan(path)
