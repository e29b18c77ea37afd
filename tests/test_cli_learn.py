"""``lbsfit learn``: the model and the results that it writes, and what it says meanwhile."""

import inspect
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from cli_runs import ARRAYS, QUICK_LEARNING, one_line
from docs_tables import needs_documents, summary_keys
from registered_sets import result_of

import lbsfit_np as lbs
from lbsfit_np.cli import fit, learn
from lbsfit_np.io.npz import MODEL_KEY
from lbsfit_np.optimize.lbfgs import minimise

pytestmark = pytest.mark.usefixtures("own_cache")


def test_a_model_and_the_results_are_written(learned_two, tube_rig):
    model, results, _, _, truth = learned_two
    fitter = lbs.LBSFitter.load(model)
    assert set(fitter.template_) == {"anna", "ben"} and len(fitter.history_) == 2
    kinds = ("fit.npz", "labels.ply", "mesh.ply")
    assert sorted(p.name for p in results.iterdir()) == sorted([*(f"{n}.{k}" for n in truth for k in kinds), "summary.json"])
    assert [p.name for p in model.parent.iterdir()] == ["model.npz"]
    for name, s in truth.items():
        result = lbs.FitResult.load(results / f"{name}.fit.npz")
        assert result.rig_digest == tube_rig.digest and len(result.labels) == 400
        assert np.linalg.norm(result.joints - s.joints, axis=1).mean() < 0.15 * tube_rig.size  # this scan's fit
        np.testing.assert_array_equal(lbs.load_scan(results / f"{name}.labels.ply").points, s.points)
        np.testing.assert_array_equal(lbs.load_scan(results / f"{name}.mesh.ply").points, result.vertices)


def test_templates_are_the_subjects_own(learned_two, tube_rig):
    model, results, _, _, truth = learned_two
    fitter = lbs.LBSFitter.load(model)
    for name in truth:
        result = lbs.FitResult.load(results / f"{name}.fit.npz")
        own, other = name[:-1], {"anna": "ben", "ben": "anna"}[name[:-1]]
        off = {s: np.abs(tube_rig.vertices + result.offsets - fitter.template_[s].vertices).mean() for s in (own, other)}
        assert off[own] < 0.5 * off[other]


def test_what_it_says_meanwhile(learned_two):
    _, _, text, err, _ = learned_two
    assert len(err.splitlines()) == 1 and err.startswith("broken: failed: ") and "expected" in err
    said = r"each scan by itself, with its own proportions: recon 0\.\d+ on the scans learned from, 0\.\d+ on those held out; "
    assert re.search(said + r"took \d+ s", text)
    line = r"round 1 of at most 1: recon 0\.\d+ on the scans .* held out; \d scans? got a better pose from a new start; "
    assert re.search(line + r"took \d+ s\n", text)
    stages = "training on synthetic scans", "fitting each scan by itself", "training the segmenter on scans like these"
    for stage in (*stages, "round 1 of at most 1: poses of scans", "results"):
        assert stage in text
    assert "learned from 6 of 8 scans of 2 subjects (1 held out; 1 could not be used) in 1 round; wrote " in text
    assert "7 of 8 results in" in text
    assert "warning" not in text + err and "\r" not in text


def test_the_last_line_counts_scans_by_what_they_were_to_learning(learned_two):
    roles = ["learned from", "not learned from", "held out of learning", "not learned from", "learned from", None]
    history = [{"round": 0, "kept": False}, {"round": 1, "kept": True}]
    fitter = SimpleNamespace(roles_=roles, history_=history, template_={0: 0}, variant="joint", rounds=1)
    reading = SimpleNamespace(paths=list("abcdef"), failures={}, name=lambda i: "abcdef"[i])
    said = learn._learned(fitter, reading, "m.npz", 3.0)
    roles = "(1 held out; 2 not learned from, as their first fits had another scale: b, d; 1 could not be used)"
    assert said.startswith(f"learned from 2 of 6 scans of 1 subject {roles} in 1 round; wrote m.npz ")


@pytest.mark.parametrize("failed, unused, warns", [(0, 0, False), (2, 0, False), (3, 0, True), (4, 0, True), (3, 2, False)])
def test_a_model_of_which_most_fits_have_failed_is_not_to_be_trusted(failed, unused, warns, capsys):
    """Scans that could not be used say nothing of what was learned."""
    entries = {k: {"name": f"s{k}", "status": "failed" if k < failed else "ok", "message": "odd"} for k in range(4)}
    learn._say_statuses(entries, [None] * unused + ["learned from"] * (4 - unused), None)
    assert ("most fits have failed: do not trust what was learned" in capsys.readouterr().out) == warns


def test_fits_that_are_ok_but_not_surely_right_are_named_without_results_as_well(tube_rig, capsys):
    sure, unsure = (replace(result_of(tube_rig, tube_rig.vertices, 9), probability=p, evidence={"rival": 0}) for p in (0.9, 0.6))
    free = replace(sure, probability=0.0, evidence={})
    fitter = SimpleNamespace(results_=[sure, unsure, free])
    reading = SimpleNamespace(paths=list("abc"), name=lambda i: "abc"[i], why=None)
    learn._say_statuses(learn._unwritten(fitter, reading), [None] * 3, None)
    assert "note: 1 fit is ok, but right with a probability below 0.8 only: b (0.60)\n" in capsys.readouterr().out


def test_the_summary_of_learning(learned_two):
    model, results, _, _, truth = learned_two
    summary = json.loads((results / "summary.json").read_text())
    counts = summary["counts"]
    assert (counts["failed"], counts["kept"], counts["ok"] + counts["suspect"]) == (1, 0, 7)
    assert counts["ok"] >= 5  # of 400 points and 100 training scans not every right fit is sure of itself
    assert summary["not_done"] == [] and not summary["stopped"]
    assert summary["model"] == {"path": str(model), "rounds": 1, "subjects": ["anna", "ben"], "variant": "joint"}
    assert [entry["round"] for entry in summary["history"]] == [0, 1]
    assert summary["settings"]["training_scans"] == 100 and summary["settings"]["held_out"] == 0.1
    scans = {s["name"]: s for s in summary["scans"]}
    assert set(scans) == {*truth, "broken"}
    assert scans["broken"]["status"] == "failed" and "broken.ply" in scans["broken"]["message"]
    assert sum("held out of learning" in s["message"] for s in scans.values()) == 1


@needs_documents
def test_the_keys_of_the_summary_are_those_that_the_documents_list(learned_two):
    summary = json.loads((learned_two[1] / "summary.json").read_text())
    scans = {s["name"]: set(s) for s in summary["scans"]}
    assert (set(summary), scans["anna1"], scans["broken"]) == summary_keys("learn")


@pytest.mark.usefixtures("hurried")
def test_results_are_the_librarys_whatever_the_number_of_jobs(tubes, tube_model, tube_rig, tmp_path, run, monkeypatch):
    """Those of the joint variant from one process, and those of vertices that move freely, which take little, from two."""
    monkeypatch.setattr("lbsfit_np.learning.free_form.minimise", minimise)  # other processes know nothing of a hurry
    scans = sorted(tubes.glob("*.ply"))
    out = tmp_path / "free"
    options = ("--results", out, "--jobs", 2, "--variant", "free-form", "--max-points", 100, *QUICK_LEARNING)
    code, _, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *options)
    assert (code, err) == (0, "")
    given = {"effort": "fast", "training_scans": 40, "rounds": 1, "random_state": 0}
    for variant, more, model, folder in (("joint", {}, *tube_model), ("free-form", {"max_points": 100}, tmp_path / "m.npz", out)):
        fitter = lbs.LBSFitter(tube_rig, variant=variant, **given, **more)
        fitter.fit([lbs.load_scan(p) for p in scans], cache=True)
        for scan, theirs in zip(scans, fitter.results_):
            ours = lbs.FitResult.load(folder / f"{scan.stem}.fit.npz")
            for name in ARRAYS:
                np.testing.assert_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
        fitter.save(tmp_path / "library.npz")
        with np.load(model) as ours, np.load(tmp_path / "library.npz") as theirs:
            assert set(ours.files) == set(theirs.files)
            for key in set(ours.files) - {MODEL_KEY}:  # which tells how long rounds took
                np.testing.assert_array_equal(ours[key], theirs[key], err_msg=key)


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("written", [False, True])
@pytest.mark.parametrize("status, code", [("ok", 0), ("suspect", 0), ("failed", 1)])
def test_the_statuses_of_all_fits_are_told_and_failed_ones_count(status, code, written, tubes, tmp_path, run, monkeypatch):
    fit_all = lbs.LBSFitter.fit

    def fit(self, scans, subjects=None, **options):
        fit_all(self, scans, subjects, **options)
        self.results_[2] = replace(self.results_[2], status=status, probability=0.02, message="part elbow does not fit")
        return self

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit)
    outputs = ("-o", tmp_path / "m.npz", *(("--results", tmp_path / "fits") if written else ()))
    found, text, _ = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *outputs, "--variant", "free-form")
    assert found == code and (tmp_path / "m.npz").is_file()
    counts = ", ".join(f"{(3 if s == 'ok' else 0) + (s == status)} {s}" for s in ("ok", "suspect", "failed"))
    assert f"fits of 4 scans: {counts}" in text and ("4 of 4 results in" in text) == written
    assert (re.search(rf"t2 +{status} +0\.02 +part elbow does not fit\n", text) is not None) == (status != "ok")


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize(
    "unit, options, words",
    [
        (1.0, (), "scans are in the rig's unit\n"),
        (250.0, (), r"scans seem to be in millimetres \(2\d\d(\.\d)? per rig unit\)\n"),  # one unit of this rig is 250 mm
        (60.0, (), r"scans are in another unit, or of another size \([56]\d(\.\d+)? per rig unit\)\n"),
        (1.0, ("--scale", "fixed"), r"scans are assumed to be in the rig's unit \(scale fixed at 1\)\n"),
    ],
)
def test_the_unit_of_the_scans_is_told(unit, options, words, tubes, tmp_path, run):
    for path in sorted(tubes.glob("*.ply")):
        np.save(tmp_path / f"{path.stem}.npy", unit * lbs.load_scan(path).points)
    scans = sorted(tmp_path.glob("*.npy"))
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    _, text, _ = run(*arguments, "--variant", "free-form", *options)
    assert re.search(words, text)
    guessed = ["a guess from the extents" in lbs.FitResult.load(f).message for f in (tmp_path / "fits").glob("*.fit.npz")]
    assert guessed == [unit == 60.0] * len(scans)


@pytest.mark.parametrize(
    "units, words",
    [
        ({"anna": 1.0, "ben": 1.1}, "scans are in the rig's unit"),
        ({"anna": 250.0, "ben": 240.0}, "scans seem to be in millimetres (240 to 250 per rig unit)"),
        (
            {"anna": 1.0, "ben": 250.0, "carl": 0.9},
            "scans of anna, carl are in the rig's unit; scans of ben seem to be in millimetres (250 per rig unit)",
        ),
        (
            {1: 60.0, 2: 1.0},
            "scans of 1 are in another unit, or of another size (60 per rig unit); scans of 2 are in the rig's unit",
        ),
    ],
)
def test_units_are_told_by_subject_where_they_differ(units, words, tubes):
    rig = lbs.load_rig(tubes / "tube.npz")
    assert learn._units(SimpleNamespace(scale="estimate", unit=None, unit_=units, rig=rig)) == words


FREE_FORM = "note: in the variant free-form, scans must face the same way as the rig"
# Options that mean nothing without skinning, in the order of the help, and their defaults.
UNUSED = {
    ("--rounds", 3): 4, ("--held-out", 0): 0.1, ("--sequence",): False, ("--smooth", 1e-5): 0, ("--partial",): False,
    ("--effort", "fast"): "balanced", ("--training-scans", 9): 4000, ("--training", "turn=1"): {},
}  # fmt: skip


@pytest.mark.usefixtures("hurried")
def test_options_that_mean_nothing_without_skinning_are_named(tubes, tmp_path, run):
    def learn(*options):
        out = ("-o", tmp_path / "m.npz", "--results", tmp_path / "fits", "--existing", "replace", "--variant", "free-form")
        code, text, err = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *out, *options)
        assert (code, err) == (0, "") and "fitted 4 of 4 scans, each by itself; wrote " in text
        return text, json.loads((tmp_path / "fits" / "summary.json").read_text())["settings"]

    text, settings = learn(*(word for option in UNUSED for word in option), "--joints", "fixed", "--seed", 5)
    assert f"{FREE_FORM}; {', '.join(flag for flag, *_ in UNUSED)} have no effect\n" in text
    assert "round" not in text.split("have no effect")[1]
    assert {flag: settings[flag[2:].replace("-", "_")] for flag, *_ in UNUSED} == {f: v for (f, *_), v in UNUSED.items()}
    assert (settings["joints"], settings["seed"]) == ("fixed", 5) and lbs.LBSFitter.load(tmp_path / "m.npz").joints == "fixed"
    assert f"{FREE_FORM}; --smooth has no effect\n" in learn("--smooth", 1e-5)[0]  # without --sequence: no error
    assert f"{FREE_FORM}; --registration has no effect\n" in learn("--no-registration")[0]
    assert f"{FREE_FORM}\n" in learn()[0]
    assert f"{FREE_FORM}; --orientation, --up only say where a floor may be\n" in learn("--orientation", "aligned", "--up=+y")[0]

    options = ("--orientation", "any", "--partial", "--effort", "fast", "--max-points", 300)
    code, text, _ = run("fit", tmp_path / "m.npz", tubes / "t0.ply", "-o", tmp_path / "new", *options)
    assert code == 0 and "m.npz is a learned model: 1 subject, variant 'free-form'" in text
    assert f"{FREE_FORM}; --orientation only says where a floor may be; --partial, --effort have no effect\n" in text
    settings = json.loads((tmp_path / "new" / "summary.json").read_text())["settings"]
    found = [settings[key] for key in ("orientation", "up", "partial", "effort", "max_points")]
    assert found == ["any", None, False, "balanced", 300]


@pytest.mark.slow
def test_a_wall_is_left_out_without_skinning(tube_rig, tubes, tmp_path, run):
    """Where scans may lie in any way, or may have another up axis; aligned ones stand on floors."""
    (scan,) = lbs.synthesize(tube_rig, 1, random_state=5, n_points=400, shape=0.0)
    wall = scan.points.mean(axis=0) + 2 * np.ptp(scan.points, axis=0).max() * (np.random.default_rng(0).random((500, 3)) - 0.5)
    wall[:, 2] = scan.points[:, 2].min() - 0.02
    np.save(tmp_path / "s.npy", np.vstack([scan.points, wall]))
    options = ("--existing", "replace", "--orientation")

    def off(folder):
        return np.linalg.norm(lbs.FitResult.load(folder / "s.fit.npz").vertices - scan.vertices, axis=1).mean()

    learned, fitted = [], []
    for orientation in ("aligned", "upright", "any"):
        outputs = ("-o", tmp_path / f"{orientation}.npz", "--results", tmp_path / "fits", "--variant", "free-form")
        assert run("learn", tubes / "tube.npz", tmp_path / "s.npy", *outputs, *options, orientation)[0] == 0
        learned.append(off(tmp_path / "fits"))
        assert lbs.LBSFitter.load(tmp_path / f"{orientation}.npz").orientation == orientation
    for orientation in ("aligned", "upright", "any"):
        assert run("fit", tmp_path / "aligned.npz", tmp_path / "s.npy", "-o", tmp_path / "new", *options, orientation)[0] == 0
        fitted.append(off(tmp_path / "new"))
    assert max(learned[1:] + fitted[1:]) < 0.5 * min(learned[0], fitted[0]), (learned, fitted)


@pytest.mark.usefixtures("hurried")
def test_what_was_noted_about_a_scan_is_said_once(tubes, tmp_path, run):
    points = lbs.load_scan(tubes / "t0.ply").points
    np.savetxt(tmp_path / "rows.csv", np.column_stack([np.arange(len(points)), points]), delimiter=",")
    note = "note: rows: The first column, which counts the rows, was left out.\n"
    np.savetxt(tmp_path / "too.csv", np.column_stack([np.arange(len(points)), points]), delimiter=",")
    scans = tmp_path / "rows.csv", tmp_path / "too.csv", tubes / "t1.ply"
    outputs = ("-o", tmp_path / "m.npz", "--results", tmp_path / "fits", "--variant", "free-form")
    _, learned, _ = run("learn", tubes / "tube.npz", *scans, *outputs)
    _, fitted, _ = run("fit", tmp_path / "m.npz", *scans, "-o", tmp_path / "new")
    for text, folder in ((learned, "fits"), (fitted, "new")):
        assert text.count(note) == text.count("which counts the rows") == 1 and "note: t1" not in text
        noted = json.loads((tmp_path / folder / "summary.json").read_text())["scans"]
        assert [bool(entry["notes"]) for entry in noted] == [True, True, False]


@pytest.mark.usefixtures("hurried")
@pytest.mark.parametrize("written", [False, True])
@pytest.mark.parametrize("status", ["ok", "suspect", "failed", "not finite", "none"])
def test_row_numbers_taken_for_x_are_why_a_fit_is_in_doubt(status, written, tubes, tmp_path, run, monkeypatch):
    fit_all = lbs.LBSFitter.fit

    def fit(self, scans, subjects=None, **options):
        fit_all(self, scans, subjects, **options)
        r = replace(self.results_[1], status="failed" if status == "not finite" else status, message="said by the fit")
        if status == "not finite":
            r = replace(r, vertices=np.full_like(r.vertices, np.nan))
        self.results_[1] = None if status == "none" else r
        self.failures_ = {1: "said by the fit"} if status == "none" else {}
        return self

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit)
    well, rows = (400 * lbs.load_scan(tubes / f"t{i}.ply").points for i in (0, 1))
    np.savetxt(tmp_path / "well.csv", well, delimiter=",")
    np.savetxt(tmp_path / "rows.csv", np.column_stack([2 * np.arange(len(rows)), rows]), delimiter=",")
    outputs = ("-o", tmp_path / "m.npz", *(("--results", tmp_path / "fits") if written else ()))
    scans = tmp_path / "well.csv", tmp_path / "rows.csv"
    code, text, _ = run("learn", tubes / "tube.npz", *scans, *outputs, "--variant", "free-form")
    assert code == (0 if status in ("ok", "suspect") else 1)
    why = "Columns 1 to 3 were read as x, y, z, but the first (0, 2, 4, …) looks like row numbers: leave it out, "
    assert text.count(f"note: rows: {why}") == 1
    if status == "ok":
        assert text.count(why) == 1
    else:
        fitted = status in ("suspect", "failed") or (status, written) == ("not finite", False)
        between = r"\n +" if fitted else "; "  # what is no fit is an error, in one line
        told = rf"^rows +{'suspect' if status == 'suspect' else 'failed'} .*{re.escape(why)}.*{between}said by the fit$"
        assert re.search(told, text, flags=re.MULTILINE)
    if written:
        (entry,) = (e for e in json.loads((tmp_path / "fits" / "summary.json").read_text())["scans"] if e["name"] == "rows")
        assert entry["message"].startswith(why) == (status != "ok") and entry["message"].endswith("said by the fit")


@pytest.mark.usefixtures("hurried")
def test_pictures_of_results(tubes, tmp_path, run, monkeypatch):
    from lbsfit_np.report import fit_picture

    draw, folder = fit_picture.fit_picture, tmp_path / "fits"

    def careless(rig, points, result):
        if len(points) == 350:
            raise ZeroDivisionError("nobody foresaw this")
        return draw(rig, points, result)

    monkeypatch.setattr(fit_picture, "fit_picture", careless)
    points = lbs.load_scan(tubes / "t0.ply").points[:350]
    np.savetxt(tmp_path / "odd.csv", np.column_stack([np.arange(350), points]), delimiter=",")
    scans = (tubes / "t1.ply", tmp_path / "odd.csv")
    options = ("-o", tmp_path / "m.npz", "--results", folder, "--variant", "free-form", "--pictures")
    code, text, err = run("learn", tubes / "tube.npz", *scans, *options)
    assert (code, err) == (0, "") and (folder / "t1.png").read_bytes().startswith(b"\x89PNG")
    assert text.count("note: odd: no picture: ") == text.count("note: odd: The first column") == 1
    files = {entry["name"]: entry["files"] for entry in json.loads((folder / "summary.json").read_text())["scans"]}
    assert files["t1"]["picture"] == "t1.png" and "picture" not in files["odd"] and not (folder / "odd.png").exists()


def test_a_picture_of_others_is_in_the_way_of_results(tubes, tmp_path, run):
    (tmp_path / "t0.png").write_bytes(b"drawn by others")
    arguments = ("learn", tubes / "tube.npz", tubes / "t0.ply", "-o", tmp_path / "m.npz", "--results", tmp_path, "--pictures")
    code, _, err = run(*arguments)
    line = one_line(err)
    assert code == 2 and "--results: got" in line and "t0.png exists already, which lbsfit did not draw" in line
    assert line.endswith("Choose another folder, or --existing replace.")  # learn cannot skip


def test_options_reach_the_fitter(tubes, tmp_path, run, monkeypatch):
    seen = {}

    def fit(self, scans, subjects=None, *, cache=False, checkpoint=None, progress=None):
        seen.update(self.get_params(deep=False), subjects=subjects, cache=cache, points=[len(s()) for s in scans])
        assert checkpoint == tmp_path / "m.npz.unfinished"
        raise KeyboardInterrupt

    monkeypatch.setattr(lbs.LBSFitter, "fit", fit)
    (tmp_path / "who.toml").write_text("t0 = 'a'\nt1 = 'b'\nt2 = 'a'\nt3 = 7\n")
    config = tmp_path / "learn.toml"
    config.write_text('output = "m.npz"\nsubjects = "who.toml"\nheld-out = 0.25\nsequence = true\nsmooth = 1e-5\nrounds = 9\n')
    code, text, _ = run(
        *("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "--config", config, "--rounds", 3, "--variant", "rand"),
        *("--weights", "paper", "--joints", "fixed", "--scale", "fixed", "--max-points", 300, "--samples", 350, "--seed", 4),
        *("--training-scans", 50, "--training", "turn=3.14", "--jobs", 2, "--parts", "arm and fingers"),
        *("--orientation", "any", "--effort", "fast", "--partial", "--cropped", "--no-registration"),
    )
    assert code == 130 and "stopped before the model was learned" in text and not (tmp_path / "m.npz").exists()
    assert seen.pop("rig").granularity == "arm and fingers"
    assert seen == {
        "subjects": ["a", "b", "a", "7"], "cache": True, "points": [350] * 4, "held_out": 0.25, "sequence": True,
        "smooth": 1e-5, "rounds": 3, "variant": "rand", "weights": "paper", "joints": "fixed", "scale": "fixed",
        "max_points": 300, "random_state": 4, "training_scans": 50, "training": {"turn": 3.14}, "n_jobs": 2,
        "orientation": "any", "up": None, "effort": "fast", "partial": True, "cropped": True, "unit": None,
        "registration": False,
    }  # fmt: skip


def test_defaults_are_the_librarys():
    parameters = inspect.signature(lbs.LBSFitter).parameters
    checked = 0
    for option in learn.OPTIONS:
        if option.key in parameters and option.key != "training":
            assert option.default == parameters[option.key].default, option.name
            checked += 1
    assert checked == 17
    same = {option.key: option for option in fit.OPTIONS}
    for key in ("orientation", "up", "partial", "cropped", "effort", "registration"):
        assert next(option for option in learn.OPTIONS if option.key == key) is same[key]
