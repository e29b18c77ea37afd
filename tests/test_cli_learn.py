"""``lbsfit learn``, and the other commands with its models: what is written, and one clear line for everything wrong."""

import inspect
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.cli import learn, main
from lbsfit_np.cli.progress import LearningProgress, span
from lbsfit_np.cli.subjects import read_subjects
from lbsfit_np.errors import FileError
from lbsfit_np.io.write import write_points_ply
from lbsfit_np.learning.archive import MODEL_KEY
from lbsfit_np.learning.batch import fit_scans
from lbsfit_np.synthesis import with_random_proportions

PACKAGE_PARENT = str(Path(lbs.__file__).resolve().parents[1])
HAND = "hand-coarse"
QUICK = ("--training-scans", "40", "--rounds", "1")  # enough for the four parts of the tube
ARRAYS = ("pose", "translation", "scale", "offsets", "rest_joints", "vertices", "joints", "labels", "confidence", "terms")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def _own_cache(cache, monkeypatch):
    monkeypatch.setenv("LBSFIT_CACHE", str(cache))


@pytest.fixture
def run(capsys):
    """Run the program in this process; returns its exit code, output and errors."""

    def run(*arguments):
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return run


def program(*arguments, cache, start=subprocess.run, **options):
    environment = os.environ | {"LBSFIT_CACHE": str(cache), "PYTHONPATH": PACKAGE_PARENT}
    command = [sys.executable, "-m", "lbsfit_np", *map(str, arguments)]
    if start is subprocess.run:
        options |= {"capture_output": True, "timeout": 300}
    return start(command, env=environment, text=True, **options)


def one_line(err):
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("lbsfit: error: "), err
    return lines[0]


@pytest.fixture(scope="module")
def hands(tmp_path_factory):
    """A folder of scans of two hands and their truth: anna0 … anna3, ben0 … ben2 (.ply), and who.csv."""
    folder = tmp_path_factory.mktemp("hands")
    rig, truth = lbs.load_rig(HAND), {}
    for k, (name, n) in enumerate((("anna", 4), ("ben", 3))):
        template = with_random_proportions(rig, 0.08, np.random.default_rng(k))
        for i, s in enumerate(lbs.synthesize(rig, n, poses="natural", templates=[template], random_state=k, n_points=600)):
            truth[f"{name}{i}"] = s
            write_points_ply(folder / f"{name}{i}.ply", s.points)
    lines = [f"{name}.ply,{name[:-1]}" for name in truth]
    (folder / "who.csv").write_text("\n".join(["scan,subject", *lines, "broken.ply,ben"]) + "\n")
    return folder, truth


@pytest.fixture(scope="module")
def learned(hands, cache, tmp_path_factory):
    """A model of the hands, made by a program of its own: path, folder of results, output, errors, truth."""
    folder, truth = hands
    out = tmp_path_factory.mktemp("learned")
    (folder / "broken.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\n")
    scans = [*sorted(folder.glob("anna*.ply")), folder / "broken.ply", *sorted(folder.glob("ben*.ply"))]
    options = ("--subjects", folder / "who.csv", "--training-scans", 200, "--rounds", 1, "--results", out / "fits")
    done = program("learn", HAND, *scans, "-o", out / "new" / "model.npz", *options, cache=cache)
    assert done.returncode == 1, done.stderr
    return out / "new" / "model.npz", out / "fits", done.stdout, done.stderr, truth


@pytest.fixture(scope="module")
def tubes(tube_rig, tmp_path_factory):
    """A folder with tube.npz and the scans t0.ply … t3.ply."""
    folder = tmp_path_factory.mktemp("tubes")
    tube_rig.save(folder / "tube.npz")
    for i, s in enumerate(lbs.synthesize(tube_rig, 4, random_state=5, n_points=400)):
        write_points_ply(folder / f"t{i}.ply", s.points)
    return folder


@pytest.fixture(scope="module")
def tube_model(tubes, cache, tmp_path_factory):
    """A model of the tubes, and the folder of results."""
    out = tmp_path_factory.mktemp("tube model")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LBSFIT_CACHE", str(cache))
        scans = sorted(map(str, tubes.glob("*.ply")))
        arguments = ["learn", tubes / "tube.npz", *scans, "-o", out / "m.npz", "--results", out / "fits", *QUICK]
        assert main([str(a) for a in arguments]) == 0
    return out / "m.npz", out / "fits"


# ---- what learning writes ----


def test_a_model_and_the_results_are_written(learned):
    model, results, _, _, truth = learned
    fitter = lbs.LBSFitter.load(model)
    assert set(fitter.template_) == {"anna", "ben"} and len(fitter.history_) == 2
    kinds = ("fit.npz", "labels.ply", "mesh.ply")
    assert sorted(p.name for p in results.iterdir()) == sorted([*(f"{n}.{k}" for n in truth for k in kinds), "summary.json"])
    assert [p.name for p in model.parent.iterdir()] == ["model.npz"]
    rig = lbs.load_rig(HAND)
    for name, s in truth.items():
        result = lbs.FitResult.load(results / f"{name}.fit.npz")
        assert result.rig_digest == rig.digest and len(result.labels) == 600
        assert np.linalg.norm(result.joints - s.joints, axis=1).mean() < 0.15 * rig.size  # it is this scan's fit, not another's
        np.testing.assert_array_equal(lbs.load_scan(results / f"{name}.labels.ply").points, s.points)
        np.testing.assert_array_equal(lbs.load_scan(results / f"{name}.mesh.ply").points, result.vertices)


def test_templates_are_the_subjects_own(learned):
    model, results, _, _, truth = learned
    fitter, rig = lbs.LBSFitter.load(model), lbs.load_rig(HAND)
    for name in truth:
        result = lbs.FitResult.load(results / f"{name}.fit.npz")
        own, other = name[:-1], {"anna": "ben", "ben": "anna"}[name[:-1]]
        off = {s: np.abs(rig.vertices + result.offsets - fitter.template_[s].vertices).mean() for s in (own, other)}
        assert off[own] < 0.5 * off[other]


def test_what_it_says_meanwhile(learned):
    _, _, text, err, _ = learned
    assert len(err.splitlines()) == 1 and err.startswith("broken: failed: ") and "expected" in err
    assert re.search(r"each scan by itself: recon 0\.\d+ on the scans learned from, 0\.\d+ on those held out; took \d+ s", text)
    line = r"round 1 of at most 1: recon 0\.\d+ on the scans .* held out; a new start won for \d scans?; took \d+ s\n"
    assert re.search(line, text)
    for stage in ("training the segmenter", "fitting each scan by itself", "round 1 of at most 1: poses of scans", "results"):
        assert stage in text
    assert "learned from 7 of 8 scans of 2 subjects in 1 round; " in text and "7 of 8 results in" in text
    assert "warning" not in text + err and "\r" not in text


def test_the_summary_of_learning(learned):
    model, results, _, _, truth = learned
    summary = json.loads((results / "summary.json").read_text())
    assert summary["counts"] == {"ok": 7, "skipped": 0, "failed": 1} and summary["not_done"] == [] and not summary["stopped"]
    assert summary["model"] == {"path": str(model), "rounds": 1, "subjects": ["anna", "ben"], "variant": "joint"}
    assert [entry["round"] for entry in summary["history"]] == [0, 1]
    assert summary["settings"]["training_scans"] == 200 and summary["settings"]["held_out"] == 0.1
    scans = {s["name"]: s for s in summary["scans"]}
    assert set(scans) == {*truth, "broken"}
    assert scans["broken"]["status"] == "failed" and "broken.ply" in scans["broken"]["message"]
    assert sum("left out of learning" in s["message"] for s in scans.values()) == 1


def test_results_are_the_librarys_whatever_the_number_of_jobs(tubes, tube_model, tube_rig, tmp_path, run):
    scans = sorted(tubes.glob("*.ply"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--results", tmp_path, "--jobs", 2, *QUICK)
    code, _, err = run(*arguments)
    assert (code, err) == (0, "")
    fitter = lbs.LBSFitter(tube_rig, training_scans=40, rounds=1, random_state=0)
    fitter.fit([lbs.load_scan(p) for p in scans], cache=True)
    for scan, library in zip(scans, fitter.results_):
        ours, theirs = (lbs.FitResult.load(folder / f"{scan.stem}.fit.npz") for folder in (tmp_path, tube_model[1]))
        for name in ARRAYS:
            np.testing.assert_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
            np.testing.assert_equal(getattr(ours, name), getattr(library, name), err_msg=name)
    with np.load(tmp_path / "m.npz") as ours, np.load(tube_model[0]) as theirs:
        assert set(ours.files) == set(theirs.files)
        for key in set(ours.files) - {MODEL_KEY}:  # which tells how long rounds took
            np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)


def test_options_reach_the_fitter(tubes, tmp_path, run, monkeypatch):
    seen = {}

    def fit(self, scans, subjects=None, *, cache=False, progress=None):
        seen.update(self.get_params(deep=False), subjects=subjects, cache=cache, points=[len(s()) for s in scans])
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit)
    (tmp_path / "who.toml").write_text("t0 = 'a'\nt1 = 'b'\nt2 = 'a'\nt3 = 7\n")
    config = tmp_path / "learn.toml"
    config.write_text('output = "m.npz"\nsubjects = "who.toml"\nheld-out = 0.25\nsequence = true\nsmooth = 1e-5\nrounds = 9\n')
    code, text, _ = run(
        *("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "--config", config, "--rounds", 3, "--variant", "rand"),
        *("--weights", "paper", "--joints", "fixed", "--scale", "fixed", "--max-points", 300, "--samples", 350, "--seed", 4),
        *("--training-scans", 50, "--training", "turn=3.14", "--jobs", 2, "--parts", "arm and fingers"),
    )
    assert code == 130 and "stopped before the model was learned" in text and not (tmp_path / "m.npz").exists()
    assert seen.pop("rig").granularity == "arm and fingers"
    assert seen == {
        "subjects": ["a", "b", "a", "7"], "cache": True, "points": [350] * 4, "held_out": 0.25, "sequence": True,
        "smooth": 1e-5, "rounds": 3, "variant": "rand", "weights": "paper", "joints": "fixed", "scale": "fixed",
        "max_points": 300, "random_state": 4, "training_scans": 50, "training": {"turn": 3.14}, "n_jobs": 2,
    }  # fmt: skip


def test_defaults_are_the_librarys():
    parameters = inspect.signature(lbs.LBSFitter).parameters
    checked = 0
    for option in learn.OPTIONS:
        if option.key in parameters and option.key != "training":
            assert option.default == parameters[option.key].default, option.name
            checked += 1
    assert checked == 10


# ---- models in other commands ----


def test_fit_with_a_model(learned, hands, tmp_path, run):
    model, folder = learned[0], hands[0]
    names = ("anna1", "ben1")
    scans = [folder / f"{name}.ply" for name in names]
    code, text, err = run("fit", model, *scans, "-o", tmp_path, "--jobs", 2)
    assert (code, err) == (0, "")
    assert "is a learned model: 2 subjects (anna, ben), 1 round, variant 'joint'" in text and "2 of 2 scans fitted" in text
    summary = json.loads((tmp_path / "summary.json").read_text())
    about = {"path": str(model), "rounds": 1, "subjects": ["anna", "ben"], "variant": "joint", "subject": None}
    assert summary["model"] == about
    assert summary["settings"]["training_scans"] == 200 and summary["seed"] == 0
    fitter = lbs.LBSFitter.load(model)
    for name, scan in zip(names, scans):
        ours, theirs = lbs.FitResult.load(tmp_path / f"{name}.fit.npz"), fitter.fit_scan(lbs.load_scan(scan))
        assert "on the template of subject" in ours.message
        for field in ARRAYS:
            np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)


@pytest.mark.parametrize("subject", ["anna", "ben"])
def test_fit_with_one_subjects_template(subject, learned, hands, tmp_path, run):
    model, scan = learned[0], hands[0] / "ben1.ply"
    code, _, err = run("fit", model, scan, "-o", tmp_path, "--subject", subject)
    assert (code, err) == (0, "")
    ours = lbs.FitResult.load(tmp_path / "ben1.fit.npz")
    theirs = lbs.LBSFitter.load(model).fit_scan(lbs.load_scan(scan), subject=subject)
    for field in ARRAYS:
        np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
    assert json.loads((tmp_path / "summary.json").read_text())["model"]["subject"] == subject


def test_a_number_as_the_subject(tube_model, tubes, tmp_path, run):
    assert run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", "--subject", "0")[0] == 0  # the id of one subject


def test_a_models_settings_hold_unless_others_are_given(tube_model, tubes, tmp_path, run):
    arguments = ("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path, "--existing", "replace")
    assert run(*arguments)[0] == 0
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["training_scans"], settings["weights"], settings["max_points"]) == (40, "default", 2500)
    before = (tmp_path / "t0.mesh.ply").read_bytes()
    assert run(*arguments, "--max-points", 200, "--weights", "paper", "--card", "none")[0] == 0
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["training_scans"], settings["weights"], settings["max_points"]) == (40, "paper", 200)
    assert (tmp_path / "t0.mesh.ply").read_bytes() != before


@pytest.mark.parametrize(
    "options",
    [
        ("--card", "c.toml"),
        ("--shape", "tall"),
        ("--skin", "s"),
        ("--normalize-weights",),
        ("--parts", "joints"),
        ("--joints", "follow"),
        ("--segmenter", "s.npz"),
        ("--training-scans", "4000"),
        ("--training", "turn=1"),
    ],
)
def test_what_a_model_has_settled_cannot_be_changed(options, tube_model, tubes, tmp_path, run):
    code, _, err = run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", *options)
    line = one_line(err)
    assert code == 2 and line.startswith(f"lbsfit: error: {options[0]}: got ") and "which is a learned model" in line
    assert "lbsfit learn has these options" in line and not (tmp_path / "out").exists()


def test_settled_options_in_a_configuration_file(tube_model, tubes, tmp_path, run):
    (tmp_path / "fit.toml").write_text("training-scans = 40\ntraining = { turn = 1 }\n")
    code, _, err = run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", "--config", tmp_path / "fit.toml")
    assert code == 2 and "--training-scans, --training with" in one_line(err)


def test_unknown_subjects(learned, hands, tubes, tmp_path, run):
    code, _, err = run("fit", learned[0], hands[0] / "ben1.ply", "-o", tmp_path / "out", "--subject", "carl")
    assert code == 2 and "--subject: got 'carl'; expected a subject of the model: 'anna', 'ben'" in one_line(err)
    code, _, err = run("fit", tubes / "tube.npz", tubes / "t0.ply", "-o", tmp_path / "out", "--subject", "carl")
    assert code == 2 and "--subject: got 'carl' with" in one_line(err) and "which is a rig" in err and "Leave it out" in err
    assert not (tmp_path / "out").exists()


def test_skip_does_not_take_fits_of_another_rig(learned, hands, tube_model, tubes, tmp_path, run):
    (tmp_path / "anna0.ply").write_bytes((tubes / "t0.ply").read_bytes())
    for path in learned[1].glob("anna0.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    code, _, err = run("fit", tube_model[0], tmp_path / "anna0.ply", "-o", tmp_path, "--existing", "skip")
    assert code == 2 and "a fit of another rig" in one_line(err)


@pytest.mark.parametrize("variant", ["cd", "free-form"])
def test_models_without_labels_want_no_segmenter(variant, tubes, tmp_path, run, monkeypatch):
    monkeypatch.setattr(lbs.LBSFitter, "pretrain", None)
    scans = sorted(tubes.glob("*.ply"))
    options = ("--variant", variant, "--max-points", 300, "--seed", 5)
    code, text, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *options, *QUICK)
    assert (code, err) == (0, "") and f"in {int(variant == 'cd')} round" in text
    code, text, err = run("fit", tmp_path / "m.npz", scans[0], "-o", tmp_path)
    assert (code, err) == (0, "") and f"variant '{variant}'" in text
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["max_points"], settings["seed"]) == (300, 5)  # the model's, not the defaults of lbsfit fit
    assert lbs.LBSFitter.load(tmp_path / "m.npz").segmenter_ is None
    outcome = fit_scans(lbs.LBSFitter.load(tmp_path / "m.npz"), [lbs.load_scan(scans[0])])[0]
    np.testing.assert_array_equal(outcome.result.vertices, lbs.FitResult.load(tmp_path / "t0.fit.npz").vertices)


def test_rig_show_of_a_model(learned, run):
    code, text, err = run("rig", "show", learned[0])
    assert (code, err) == (0, "") and text.startswith(f"Rig {HAND}\n")
    assert text.splitlines()[-1] == "The file is a learned model: 2 subjects (anna, ben), 1 round, variant 'joint'."
    assert "learned model" not in run("rig", "show", HAND)[1]


def _with_header(**changes):
    def change(arrays):
        arrays[MODEL_KEY] = np.array(json.dumps(json.loads(str(arrays[MODEL_KEY])) | changes))

    return change


def _other_template(arrays):
    arrays["model_vertices"] = arrays["model_vertices"][:, :-1]


BROKEN_MODELS = {
    "text": (lambda arrays: arrays.update({MODEL_KEY: np.array("{")}), ["content does not fit"]),
    "format": (_with_header(format=99), ["model format 99", "format 1", "Learn it again"]),
    "template": (_other_template, ["templates that do not fit the rig"]),
    "history": (_with_header(history=3), ["content does not fit"]),
    "parameters": (_with_header(parameters={"weights": "default", "rings": 3}), ["content does not fit", "rings"]),
}


@pytest.mark.parametrize("name", BROKEN_MODELS)
def test_broken_models(name, tube_model, tubes, tmp_path, run):
    change, words = BROKEN_MODELS[name]
    with np.load(tube_model[0]) as z:
        arrays = {key: z[key] for key in z.files}
    change(arrays)
    np.savez(tmp_path / "m.npz", **arrays)
    code, _, err = run("fit", tmp_path / "m.npz", tubes / "t0.ply", "-o", tmp_path / "out")
    assert code == 2 and "m.npz: got" in one_line(err) and all(word in err for word in words), err


def test_a_model_cut_short(tube_model, tubes, tmp_path, run):
    (tmp_path / "m.npz").write_bytes(tube_model[0].read_bytes()[:5000])
    for command in (("fit", tmp_path / "m.npz", tubes / "t0.ply", "-o", tmp_path / "out"), ("rig", "show", tmp_path / "m.npz")):
        code, _, err = run(*command)
        assert code == 2 and "m.npz: got a file that is broken" in one_line(err)


def test_learning_with_a_models_rig(tube_model, tubes, tmp_path, run, monkeypatch):
    def fit(self, *_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit)
    code, text, _ = run("learn", tube_model[0], *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz")
    assert code == 130 and "its rig is used, what it has learned is not" in text


# ---- what cannot be learned from ----


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((), ["RIG", "SCAN"]),
        (("tube.npz",), ["SCAN"]),
        (("tube.npz", "t0.ply"), ["-o/--output", "Add -o MODEL.npz"]),
        (("tube.npz", "t0.ply", "-o", ""), ["-o/--output", "an empty text"]),
        (("tube.npz", "t0.ply", "-o", "model"), ["model, which has no ending", ".npz", "Call it model.npz"]),
        (("tube.npz", "t0.ply", "-o", "model.pkl"), ["ends in '.pkl'", ".npz"]),
        (("tube.npz", "t0.ply", "-o", "tube.npz", "--existing", "replace"), ["which is an input", "never overwritten"]),
        (("tube.npz", "t0.ply", "-o", "there.npz", "--card", "there.npz"), ["which is an input", "never overwritten"]),
        (("tube.npz", "t0.ply", "-o", "there.npz", "--subjects", "there.npz"), ["which is an input", "never overwritten"]),
        (("tube.npz", "t0.ply", "cloud.npz", "-o", "cloud.npz", "--existing", "replace"), ["an input (cloud.npz)"]),
        (("tube.npz", "t0.ply", "-o", "there.npz"), ["there.npz", "exists already", "--existing replace"]),
        (("tube.npz", "t0.ply", "-o", "folder.npz"), ["folder.npz", "a folder"]),
        (("tube.npz", "t0.ply", "-o", "m" * 300 + ".npz"), ["mmm", "too long"]),
        (("tube.npz", "t0.ply", "-o", "t0.ply/m.npz"), ["t0.ply", "cannot be made"]),
        (("tube.npz", "t0.ply", "t0.ply", "-o", "m.npz"), ["SCAN: got t0.ply twice"]),
        (("tube.npz", "t0.ply", "./t0.ply", "-o", "m.npz"), ["SCAN", "twice"]),
        (("tube.npz", "t0.ply", "none.ply", "-o", "m.npz"), ["SCAN", "none.ply", "does not exist"]),
        (("tube.npz", ".", "-o", "m.npz"), ["SCAN", "a folder"]),
        (("none.npz", "t0.ply", "-o", "m.npz"), ["none.npz", "no such file"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--results", "t1.ply"), ["t1.ply", "a folder to write to"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--results", "old"), ["--results: got old", "exists already"]),
        (("tube.npz", "t0.ply", "-o", "new/t0.fit.npz", "--results", "new"), ["t0.fit.npz", "a file of --results"]),
        (("tube.npz", "t0.ply", "sub/t0.ply", "-o", "m.npz", "--results", "new"), ["SCAN", "both be called"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--rounds", "0"), ["--rounds", "at least 1"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--held-out", "1"), ["--held-out", "'1'", "from 0 to 0.9"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--held-out", "nan"), ["--held-out", "from 0 to 0.9"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--smooth", "-1"), ["--smooth", "at least 0"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--smooth", "inf", "--sequence"), ["--smooth", "at least 0"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--smooth", "1e-5"), ["--smooth", "without --sequence"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--variant", "best"), ["--variant", "'best'", "pose-only"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--existing", "skip"), ["--existing", "'skip'"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--jobs", "0"), ["--jobs", "at least 1"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--training", "trun=1"), ["trun", "turn"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--parts", "toes"), ["'toes'", "arm and fingers"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--subjects", "none.csv"), ["none.csv", "no such file"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--subjects", "one.csv"), ["one.csv", "'t1' in line 2", "none of the scans"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "bad.toml"), ["bad.toml", "'round'", "Did you mean 'rounds'"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "share.toml"), ["held-out", "from 0 to 0.9"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "word.toml"), ["smooth = 'much'", "a number"]),
        (("tube.npz", "t0.ply", "-o", "m.npz", "--config", "half.toml"), ["rounds = 1.5", "a whole number"]),
    ],
)
def test_bad_usage_is_found_before_any_work(arguments, words, tubes, tmp_path, run, monkeypatch):
    for name in ("tube.npz", "t0.ply", "t1.ply"):
        (tmp_path / name).write_bytes((tubes / name).read_bytes())
    for folder in ("folder.npz", "old", "sub"):
        (tmp_path / folder).mkdir()
    np.savez(tmp_path / "cloud.npz", points=np.eye(3))
    contents = {"there.npz": "x", "old/summary.json": "{}", "one.csv": "t0,a\nt1,b\n", "sub/t0.ply": "x"}
    contents |= {"bad.toml": "round = 3", "share.toml": "held-out = 2"}
    contents |= {"word.toml": 'smooth = "much"', "half.toml": "rounds = 1.5"}
    for name, text in contents.items():
        (tmp_path / name).write_text(text)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(lbs.LBSFitter, "fit", None)
    code, _, err = run("learn", *arguments)
    line = one_line(err)
    assert code == 2 and all(word in line for word in words), line
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before


def test_existing_files_are_replaced_where_that_is_asked_for(tubes, tmp_path, run):
    (tmp_path / "m.npz").write_text("old")
    arguments = ("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert run(*arguments)[0] == 2 and (tmp_path / "m.npz").read_text() == "old"
    assert run(*arguments, "--existing", "replace")[0] == 0
    assert list(lbs.LBSFitter.load(tmp_path / "m.npz").template_) == [0]


def test_too_few_scans_to_hold_any_out(tubes, tmp_path, run):
    code, _, err = run("learn", tubes / "tube.npz", tubes / "t0.ply", tubes / "t1.ply", "-o", tmp_path / "m.npz", *QUICK)
    line = one_line(err)
    assert code == 2 and "2 that can be used" in line and "at least 3" in line and "--held-out 0" in line
    assert not (tmp_path / "m.npz").exists()


def test_scans_in_different_units_are_named(tubes, tmp_path, run):
    write_points_ply(tmp_path / "millimetres.ply", 1000 * lbs.load_scan(tubes / "t3.ply").points)
    scans = [tubes / "t0.ply", tubes / "t1.ply", tmp_path / "millimetres.ply", tubes / "t2.ply"]
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *QUICK)
    assert code == 2 and "different units: scan 2 (" in one_line(err) and "millimetres.ply) has an extent" in err


def test_no_scan_that_can_be_used(tubes, tmp_path, run):
    (tmp_path / "empty.ply").write_bytes(b"")
    np.savetxt(tmp_path / "few.xyz", np.eye(3))
    scans = (tmp_path / "empty.ply", tmp_path / "few.xyz")
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *QUICK)
    lines = err.splitlines()
    assert code == 2 and len(lines) == 3
    assert lines[0].startswith("empty: failed: ") and lines[1].startswith("few: failed: ") and "at least 4 points" in lines[1]
    assert lines[2].startswith("lbsfit: error: scans: got 2, none of which can be used")


def test_whatever_is_wrong_with_one_scan_is_its_failure_alone(tubes, tmp_path, run, monkeypatch):
    import lbsfit_np.io.scans

    load = lbsfit_np.io.scans.load_scan

    def careless(path, **options):
        if Path(path).stem == "t1":
            raise ZeroDivisionError("nobody foresaw this")
        return load(path, **options)

    monkeypatch.setattr(lbsfit_np.io.scans, "load_scan", careless)
    scans = sorted(tubes.glob("*.ply"))
    code, text, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 1 and "learned from 3 of 4 scans" in text and (tmp_path / "m.npz").exists()
    assert len(err.splitlines()) == 1 and err.startswith("t1: failed: ") and "ZeroDivisionError: nobody foresaw this" in err


def test_scans_of_one_name_are_called_by_their_paths(tubes, tmp_path, run):
    for k in range(3):
        (tmp_path / f"d{k}").mkdir()
        (tmp_path / f"d{k}" / "scan.ply").write_bytes((tubes / f"t{k}.ply").read_bytes())
    (tmp_path / "d1" / "scan.ply").write_bytes(b"")
    scans = sorted(tmp_path.glob("*/scan.ply"))
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 1 and err.startswith(f"{scans[1]}: failed: ")


# ---- subjects ----

SCANS = ["in/a1.ply", "in/a2.ply", "in/b 1.xyz"]


@pytest.mark.parametrize(
    "name, text",
    [
        ("who.csv", "a1.ply,anna\na2.ply,anna\nb 1.xyz,ben\n"),
        ("who.csv", "\ufeffscan, subject\r\na1, anna\r\n\r\n# b\r\na2, anna\r\n'b 1',ben".replace("'", '"')),
        ("who.csv", "File;Who\nb 1;ben\na1;anna;\na2;anna;;\n"),
        ("who.tsv", "a1\tanna\na2\tanna\nb 1.xyz\tben\n"),
        ("who.txt", "a1.ply  anna\nin/a2.ply\tanna\nb 1.xyz ben\n".replace("\t", " ")),
        ("who", "in/a1.ply,anna\n./in/a2.ply,anna\nb 1,ben\n"),
        ("who.toml", '"a1.ply" = "anna"\na2 = "anna"\n"b 1" = "ben"\n'),
        ("who.toml", '[subjects]\n"in/a1.ply" = "anna"\na2 = " anna "\n\'b 1\' = "ben"\n'),
    ],
)
def test_tables_of_subjects(name, text, tmp_path):
    (tmp_path / name).write_text(text, encoding="utf-8", newline="")
    assert read_subjects(tmp_path / name, SCANS) == ["anna", "anna", "ben"]


def test_ids_that_are_numbers_are_text(tmp_path):
    (tmp_path / "who.toml").write_text("a1 = 1\na2 = 2\n'b 1' = \"1\"\n")
    assert read_subjects(tmp_path / "who.toml", SCANS) == ["1", "2", "1"]


def test_a_scan_may_be_called_as_headings_are(tmp_path):
    (tmp_path / "who.csv").write_text("scan,anna\nfile,ben\n")
    assert read_subjects(tmp_path / "who.csv", ["scan.ply", "file.ply"]) == ["anna", "ben"]


def test_scans_of_one_name_are_told_apart_by_path(tmp_path):
    scans = ["a/1.ply", "b/1.ply"]
    (tmp_path / "who.csv").write_text("b/1.ply,ben\na/1.ply,anna\n")
    assert read_subjects(tmp_path / "who.csv", scans) == ["anna", "ben"]
    (tmp_path / "who.csv").write_text("1.ply,ben\na/1.ply,anna\n")
    with pytest.raises(FileError, match=r"'1.ply' in line 1, which 2 scans are called.*Write its path, such as a/1.ply"):
        read_subjects(tmp_path / "who.csv", scans)


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("who.csv", "a1,anna\na3.ply,anna\nb 1,ben\n", ["'a3.ply' in line 2", "none of the scans", "Did you mean 'a"]),
        ("who.csv", "a1,anna\nzzzz,anna\n", ["'zzzz' in line 2", "Leave out scans"]),
        ("who.csv", "a1,anna\n", ["no id for 2 of 3 scans: in/a2.ply, in/b 1.xyz", "Add them"]),
        ("who.csv", "", ["no id for 3 of 3 scans"]),
        ("who.csv", "a1,anna\na2,anna\n\na1.ply,ben\n", ["'a1.ply' twice, in lines 1 and 4"]),
        ("who.csv", "a1,anna\na2,\n", ["no id for 'a2' in line 2"]),
        ("who.csv", "a1,anna\na2\n", ["'a2' in line 2", "has 1 column;"]),
        ("who.csv", "a1,anna\na2,anna,left\n", ["line 2", "has 3 columns"]),
        ("who.csv", 'a1,anna\n"a2,anna\n', ["line 2", "cannot be read"]),
        ("who.csv", b"a1,anna\n\xff\xfe\n", ["not UTF-8", "Save it as CSV in UTF-8"]),
        ("who.txt", "a1 anna\na2\n", ["'a2' in line 2", "1 column"]),
        ("who.toml", "a1 = 'anna'\na3 = 'anna'\n", ["'a3' in line 2"]),
        ("who.toml", "a1.ply = 'anna'\n", ["line 1", "names with dots in quotes"]),
        ("who.toml", "a1 = 'anna'\n\na2 = ['anna']\n", ["a2 = ['anna'] in line 3"]),
        ("who.toml", "a1 = 'anna'\na1 = 'ben'\n", ["not TOML", "line 2"]),
        ("who.toml", "a1 = 'anna'\n'a1.ply' = 'ben'\n", ["'a1.ply' twice, in lines 1 and 2"]),
        ("who.toml", "a1 = ", ["not TOML"]),
    ],
)
def test_bad_tables_of_subjects(name, content, words, tmp_path):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FileError) as error:
        read_subjects(tmp_path / name, SCANS)
    message = str(error.value)
    assert message.startswith(f"{tmp_path / name}: got ") and all(word in message for word in words), message


# ---- stopping ----


@pytest.mark.skipif(os.name != "posix", reason="Ctrl-C is sent as a POSIX signal")
@pytest.mark.parametrize("jobs, sent, code", [(1, signal.SIGINT, 130), (2, signal.SIGINT, 130), (1, signal.SIGTERM, 143)])
def test_ctrl_c_leaves_no_model(jobs, sent, code, tubes, tube_model, cache, tmp_path):
    process = program(
        *("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz", "--results", tmp_path / "fits"),
        *("--training-scans", 40, "--rounds", 1000, "--held-out", 0, "--jobs", jobs),
        cache=cache,
        start=subprocess.Popen,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # background jobs of a shell ignore it
    )
    for line in process.stdout:
        if line.startswith("round 1"):
            break
    time.sleep(0.5)
    os.killpg(process.pid, sent) if sent == signal.SIGINT else process.send_signal(sent)  # a terminal sends it to the group
    text, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (code, ""), err
    assert text.endswith("stopped before the model was learned\n")
    assert [p.name for p in tmp_path.rglob("*")] == ["fits"]


def test_ctrl_c_among_the_results_keeps_the_model(tubes, tmp_path, run, monkeypatch):
    from lbsfit_np.cli import outputs

    write = outputs.Writer.__call__

    def interrupted(self, index, scan, result):
        if index == 2:
            raise KeyboardInterrupt
        return write(self, index, scan, result)

    monkeypatch.setattr(outputs.Writer, "__call__", interrupted)
    scans = sorted(tubes.glob("*.ply"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    code, text, err = run(*arguments, "--variant", "free-form")
    assert (code, err) == (130, "") and "m.npz is complete, 2 of 4 results are in" in text
    assert len(lbs.LBSFitter.load(tmp_path / "m.npz").template_) == 1
    summary = json.loads((tmp_path / "fits" / "summary.json").read_text())
    assert summary["stopped"] and summary["not_done"] == ["t2", "t3"] and summary["counts"]["ok"] == 2


def test_a_full_disk_leaves_no_half_model(tubes, tmp_path, run, monkeypatch):
    def full(entry, array, **_):
        entry.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    scans = sorted(tubes.glob("*.ply"))
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--variant", "free-form")
    assert code == 2 and "No space left" in one_line(err) and not list(tmp_path.iterdir())


def test_a_result_that_cannot_be_written_does_not_stop_the_others(tubes, tmp_path, run, monkeypatch):
    import lbsfit_np.io.write

    write = lbsfit_np.io.write.write_points_ply

    def full(path, points, **options):
        if len(points) == 400 and "t1" in Path(path).name:
            raise OSError(28, "No space left on device")
        write(path, points, **options)

    monkeypatch.setattr(lbsfit_np.io.write, "write_points_ply", full)
    scans = sorted(tubes.glob("*.ply"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    code, text, err = run(*arguments, "--variant", "free-form")
    assert code == 1 and "t1: failed: " in err and "3 of 4 results" in text
    assert not list((tmp_path / "fits").glob("*t1*")) and len(list((tmp_path / "fits").iterdir())) == 10


# ---- progress and help ----


class _Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def _figures(k, **more):
    return {"round": k, "recon": 0.02, "recon_held_out": 0.03, "seconds": 60.0, **more}


@pytest.mark.parametrize("terminal", [False, True])
def test_rounds_with_the_time_left(terminal, capsys):
    clock = _Clock()
    progress = LearningProgress(4, terminal=terminal, clock=clock)
    progress("first fits", 0.5)
    progress("round", 1.0, _figures(0))
    for k, seconds in ((1, 60), (2, 180)):
        progress("poses of scans", 0.1)
        progress("poses of scans", 0.9)
        clock.now += seconds
        progress("round", 1.0, _figures(k, new_starts_won=k, seconds=float(seconds)))
    progress.failed("one", "no points")
    progress("results", 0.5)
    progress.close()
    out, err = capsys.readouterr()
    shown = err if terminal else out
    assert ("no points" in out, "one: failed: no points" in err) == (False, True)
    assert "each scan by itself: recon 0.0200 on the scans learned from, 0.0300 on those held out; took 60 s\n" in shown
    assert "; a new start won for 1 scan; took 60 s; at most about 3 min left\n" in shown  # three rounds like the first
    assert "; a new start won for 2 scans; took 3 min; at most about 4 min left\n" in shown  # two of 120 s
    if terminal:
        assert out == "" and "round 2 of at most 4: poses of scans" in err and ", at most about 3 min left" in err
        assert "results" in err and "left" not in err[err.rindex("results") :]
    else:
        assert out.count("round 2 of at most 4: poses of scans\n") == 1 and "\nresults\n" in out


def test_rounds_that_hold_nothing_out(capsys):
    progress = LearningProgress(1, terminal=False)
    progress("round", 1.0, _figures(0) | {"recon_held_out": None})
    assert "recon 0.0200 on the scans learned from; took" in capsys.readouterr().out


@pytest.mark.parametrize("seconds, words", [(0.2, "0 s"), (99, "99 s"), (150, "2 min"), (5990, "100 min"), (9000, "2.5 h")])
def test_lengths_of_time(seconds, words):
    assert span(seconds) == words


def test_help(run):
    code, text, err = run("learn", "--help")
    assert (code, err) == (0, "") and "usage: lbsfit learn" in text and "examples:" in text and "anna_01.ply, anna" in text
    text = " ".join(text.split())
    for option in learn.OPTIONS:
        if option.default not in (None, {}):
            shown = {True: "yes", False: "no"}.get(option.default, option.default) if option.kind is bool else option.default
            assert f"{option.help} (default: {shown})" in text, option.name
    assert "learn" in run("--help")[1]


def test_help_is_quick():
    code = "import sys; from lbsfit_np.cli import main; main(['learn', '--help']); print([m for m in sys.modules if m in HEAVY])"
    heavy = "HEAVY = ('scipy', 'sklearn', 'trimesh', 'tqdm', 'matplotlib', 'multiprocessing'); "
    environment = os.environ | {"PYTHONPATH": PACKAGE_PARENT}
    done = subprocess.run([sys.executable, "-c", heavy + code], capture_output=True, text=True, env=environment, timeout=120)
    assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr
