"""Learned models in the other commands, and files of models that are broken."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from cli_runs import ARRAYS, HAND, QUICK, QUICK_LEARNING, one_line
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.cli import fit
from lbsfit_np.io.npz import MODEL_KEY
from lbsfit_np.learning.batch import fit_scans

pytestmark = pytest.mark.usefixtures("own_cache")
HURRIED = pytest.mark.usefixtures("hurried")


@HURRIED
def test_fit_with_a_model(learned_two, scans_of_two, tmp_path, run):
    model, folder = learned_two[0], scans_of_two[0]
    names = ("anna1", "ben1")
    scans = [folder / f"{name}.ply" for name in names]
    code, text, err = run("fit", model, *scans, "-o", tmp_path)
    assert (code, err) == (0, "")
    assert "is a learned model: 2 subjects (anna, ben), 1 round, variant 'joint'" in text and "2 of 2 scans fitted" in text
    summary = json.loads((tmp_path / "summary.json").read_text())
    about = {"path": str(model), "rounds": 1, "subjects": ["anna", "ben"], "variant": "joint", "subject": None}
    assert summary["model"] == about
    assert summary["settings"]["training_scans"] == 100 and summary["seed"] == 0
    fitter = lbs.LBSFitter.load(model)
    for name, scan in zip(names, scans):
        ours, theirs = lbs.FitResult.load(tmp_path / f"{name}.fit.npz"), fitter.fit_scan(lbs.load_scan(scan))
        assert "on the template of subject" in ours.message
        for field in ARRAYS:
            np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)


@HURRIED
@pytest.mark.parametrize("subject", ["anna", "ben"])
def test_fit_with_one_subjects_template(subject, learned_two, scans_of_two, tmp_path, run):
    model, scan = learned_two[0], scans_of_two[0] / "ben1.ply"
    code, out, err = run("fit", model, scan, "-o", tmp_path, "--subject", subject)
    assert (code, err) == (0, "") and "fitting 1 scan\n" in out
    ours = lbs.FitResult.load(tmp_path / "ben1.fit.npz")
    theirs = lbs.LBSFitter.load(model).fit_scan(lbs.load_scan(scan), subject=subject)
    for field in ARRAYS:
        np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
    assert ours.message == theirs.message and f"on the template of subject {subject!r}" in ours.message
    assert json.loads((tmp_path / "summary.json").read_text())["model"]["subject"] == subject


@HURRIED
def test_fit_with_a_table_of_subjects(learned_two, scans_of_two, tmp_path, run):
    """The table of all that was learned from, of which some are fitted; then with one of another subject."""
    model, names = learned_two[0], ("anna1", "ben1")
    scans = [scans_of_two[0] / f"{name}.ply" for name in names]
    arguments = ("fit", model, *scans, "-o", tmp_path / "out", "--subjects")
    code, _, err = run(*arguments, scans_of_two[0] / "who.csv")
    assert (code, err) == (0, "")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [s["subject"] for s in summary["scans"]] == ["anna", "ben"]
    fitter = lbs.LBSFitter.load(model)
    for name, scan in zip(names, scans):
        ours = lbs.FitResult.load(tmp_path / "out" / f"{name}.fit.npz")
        theirs = fitter.fit_scan(lbs.load_scan(scan), subject=name[:-1])
        for field in ARRAYS:
            np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
        assert ours.subject == name[:-1] and ours.model_digest == theirs.model_digest
    (tmp_path / "other.csv").write_text("anna1,anna\nben1,anna\n")
    code, text, _ = run(*arguments, scans_of_two[0] / "who.csv", "--existing", "skip")
    assert code == 0 and "kept existing fits of 2 of 2 scans\n" in text
    code, _, err = run(*arguments, tmp_path / "other.csv", "--existing", "skip")
    assert code == 2 and "ben1.fit.npz, a fit with this model as 'ben'; expected fits with" in one_line(err)


@pytest.mark.parametrize(
    "command, given, remedy",
    [
        ("learn", False, "Give it as --subjects {}."),
        ("learn", True, "Leave it out of the scans: --subjects is given."),
        ("fit", False, "Leave it out of the scans."),  # a rig has no subjects
        ("fit a model", False, "Give it as --subjects {}."),
        ("fit a model", True, "Leave it out of the scans."),
    ],
)
def test_a_table_of_subjects_among_the_scans(command, given, remedy, tube_model, tubes, tmp_path, run):
    who = tmp_path / "who.csv"
    who.write_text("t0.ply,anna\nt1.ply,ben\n")
    rig = tube_model[0] if "model" in command else tubes / "tube.npz"
    options = ("-o", tmp_path / "new.npz", *(("--subjects", who) if given else ()))
    code, _, err = run(command.split()[0], rig, *sorted(tubes.glob("t*.ply")), who, *options)
    assert code == 2 and "SCAN: got " in one_line(err) and one_line(err).endswith(remedy.format(who))
    assert not (tmp_path / "new.npz").exists()


def test_tables_of_subjects_that_cannot_be_used(learned_two, scans_of_two, tubes, tmp_path, run):
    def said(table, *options, model=learned_two[0]):
        (tmp_path / "who.csv").write_text(table)
        scan = scans_of_two[0] / "ben1.ply"
        code, _, err = run("fit", model, scan, "-o", tmp_path / "out", "--subjects", tmp_path / "who.csv", *options)
        assert code == 2 and not (tmp_path / "out").exists()
        return one_line(err)

    unknown = "got 'carl', the id of 'ben1' in line 2; expected a learned subject: 'anna', 'ben'. Leave the id empty for "
    assert said("scan,subject\nben1,carl").endswith(f"who.csv: {unknown}scans of other subjects.")
    assert said("ben1.ply,bne").endswith("got 'bne', the id of 'ben1.ply' in line 1; expected a learned subject: "
                                         "'anna', 'ben'. Did you mean 'ben'?")  # fmt: skip
    assert f"got a file that names none of these scans: '{scans_of_two[0] / 'ben1.ply'}'; expected" in said("ben2,ben")
    assert "who.csv together with --subject ben; expected one of the two" in said("ben1,ben", "--subject", "ben")
    assert "--subjects: got" in (line := said("ben1,ben", model=HAND)) and "which is a rig" in line


@HURRIED
def test_a_table_with_scans_of_whom_nobody_knows(learned_two, scans_of_two, tmp_path, run):
    """An empty id is none: what ``fit_scans`` makes of None."""
    scans = [scans_of_two[0] / f"{name}.ply" for name in ("ben1", "anna1")]
    (tmp_path / "who.csv").write_text("scan,subject\nben1,ben\nanna1,\n")
    code, _, err = run("fit", learned_two[0], *scans, "-o", tmp_path, "--subjects", tmp_path / "who.csv")
    assert (code, err) == (0, "")
    outcomes = fit_scans(lbs.LBSFitter.load(learned_two[0]), [lbs.load_scan(s) for s in scans], subjects=["ben", None])
    for scan, outcome in zip(scans, outcomes):
        ours = lbs.FitResult.load(tmp_path / f"{scan.stem}.fit.npz")
        np.testing.assert_array_equal(ours.vertices, outcome.result.vertices)
        assert ours.model_digest == outcome.result.model_digest


@HURRIED
def test_a_number_as_the_subject(tube_model, tubes, tmp_path, run):
    assert run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", "--subject", "0")[0] == 0  # the id of one subject
    (tmp_path / "who.csv").write_text("t0,1\n")
    options = ("-o", tmp_path / "new", "--subjects", tmp_path / "who.csv")
    code, _, err = run("fit", tube_model[0], tubes / "t0.ply", *options)
    words = "got '1' for a model that was learned without --subjects, the id of 't0' in line 1; expected no subject: it has one"
    assert code == 2 and one_line(err).endswith(f"{words} template. Leave --subjects out, or learn with --subjects.")


@HURRIED
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


def test_wrong_options_are_said_before_results_that_are_in_the_way(tube_model, tubes, tmp_path, run):
    for out in (tube_model[1], tmp_path / "new"):
        code, _, err = run("fit", tube_model[0], tubes / "t0.ply", "-o", out, "--max-points", "3")
        assert code == 2 and one_line(err).startswith("lbsfit: error: --max-points: got 3; expected at least 4")
    assert not (tmp_path / "new").exists()


def test_settled_options_in_a_configuration_file(tube_model, tubes, tmp_path, run):
    (tmp_path / "fit.toml").write_text("training-scans = 40\ntraining = { turn = 1 }\n")
    code, _, err = run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", "--config", tmp_path / "fit.toml")
    assert code == 2 and "--training-scans, --training with" in one_line(err)


def test_unknown_subjects(learned_two, scans_of_two, tube_model, tubes, tmp_path, run):
    code, _, err = run("fit", learned_two[0], scans_of_two[0] / "ben1.ply", "-o", tmp_path / "out", "--subject", "carl")
    assert code == 2 and "--subject: got 'carl'; expected a learned subject: 'anna', 'ben'" in one_line(err)
    code, _, err = run("fit", tubes / "tube.npz", tubes / "t0.ply", "-o", tmp_path / "out", "--subject", "carl")
    assert code == 2 and "--subject: got 'carl' with" in one_line(err) and "which is a rig" in err and "Leave it out" in err
    code, _, err = run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", "--subject", "carl")
    assert code == 2 and "--subject: got 'carl' for a model that was learned without --subjects" in one_line(err)
    assert not (tmp_path / "out").exists()


def test_an_unknown_subject_of_a_model_of_one_that_has_a_name(tube_model, tubes, tmp_path, run):
    fitter = lbs.LBSFitter.load(tube_model[0])
    fitter.template_, fitter.unit_ = {"anna": fitter.template_[0]}, {"anna": fitter.unit_[0]}
    fitter.save(tmp_path / "anna.npz")
    for got, more in (("carl", ". Fit scans of other people without it."), ("ana", ". Did you mean 'anna'?")):
        code, _, err = run("fit", tmp_path / "anna.npz", tubes / "t0.ply", "-o", tmp_path / "out", "--subject", got)
        assert code == 2 and one_line(err).endswith(f"--subject: got {got!r}; expected a learned subject: 'anna'{more}")


def test_skip_does_not_take_fits_of_another_rig(tube_model, tubes, tmp_path, run):
    _copied(tube_model[1], "t0.*", tmp_path)
    replace(lbs.FitResult.load(tmp_path / "t0.fit.npz"), rig_digest="of another").save(tmp_path / "t0.fit.npz")
    code, _, err = run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path, "--existing", "skip")
    assert code == 2 and "a fit of another rig" in one_line(err)


def _copied(folder, pattern, out):
    for path in folder.glob(pattern):
        (out / path.name).write_bytes(path.read_bytes())


@HURRIED
def test_skip_keeps_fits_of_the_same_model(tube_model, tubes, tmp_path, run):
    model, results = tube_model
    _copied(results, "t0.*", tmp_path)  # written by lbsfit learn
    arguments = ("fit", model, tubes / "t0.ply", tubes / "t1.ply", "-o", tmp_path, "--existing", "skip")
    for kept in (1, 2):
        code, text, _ = run(*arguments)
        assert code == 0 and f"kept existing fits of {kept} of 2 scans\n" in text
    assert (tmp_path / "t0.fit.npz").read_bytes() == (results / "t0.fit.npz").read_bytes()
    assert run(*arguments, "--max-points", 99)[0] == 0  # settings do not count
    code, _, err = run(*arguments, "--subject", "0")  # its only one; but without, a scan may be somebody else's
    assert code == 2 and "t1.fit.npz, a fit with this model and no subject named (template of '0')" in err


@HURRIED
@pytest.mark.parametrize("change", ["another model", "a rig", "a model"])
def test_skip_does_not_take_fits_made_with_something_else(change, tube_model, tubes, tmp_path, run):
    model, results = tube_model
    options = ("-o", tmp_path, "--existing", "skip")
    if change == "another model":
        fitter = lbs.LBSFitter.load(model)
        template = fitter.template_[0]
        fitter.template_[0] = template.with_template(1.01 * template.vertices, template.joints)
        fitter.save(tmp_path / "other.npz")
        model = tmp_path / "other.npz"
        words = "with another model; expected fits with this model and subject. Choose another folder"
        _copied(results, "t0.*", tmp_path)
    elif change == "a rig":
        model, words = tubes / "tube.npz", "with a learned model; expected fits with rig 'tube' alone"
        _copied(results, "t0.*", tmp_path)
    else:
        assert run("fit", tubes / "tube.npz", tubes / "t0.ply", *options, *QUICK)[0] == 0
        words = "without a model; expected fits with this model"
    before = (tmp_path / "t0.fit.npz").read_bytes()
    code, _, err = run("fit", model, tubes / "t0.ply", *options)
    line = one_line(err)
    assert code == 2 and f"--existing skip: got {tmp_path / 't0.fit.npz'}, a fit {words}" in line and "another folder" in line
    assert (tmp_path / "t0.fit.npz").read_bytes() == before


@HURRIED
def test_skip_goes_by_the_subjects_in_use(learned_two, scans_of_two, tmp_path, run):
    """A fit of one subject stays one where only another's template changes, and is none of the other."""
    arguments = (scans_of_two[0] / "ben1.ply", "-o", tmp_path, "--existing", "skip", "--subject")
    assert run("fit", learned_two[0], *arguments, "ben")[0] == 0
    fitter = lbs.LBSFitter.load(learned_two[0])
    anna = fitter.template_["anna"]
    fitter.template_["anna"] = anna.with_template(1.01 * anna.vertices, anna.joints)
    fitter.save(tmp_path / "other.npz")
    for model in (learned_two[0], tmp_path / "other.npz"):
        code, text, _ = run("fit", model, *arguments, "ben")
        assert code == 0 and "kept existing fits of 1 of 1 scan\n" in text
    code, _, err = run("fit", learned_two[0], *arguments, "anna")
    assert code == 2 and "with this model as 'ben'" in one_line(err)


@HURRIED
def test_skip_keeps_what_learning_left_with_and_without_the_subjects(learned_two, scans_of_two, tmp_path, run):
    for path in learned_two[1].glob("*[01].*"):
        _copied(path.parent, path.name, tmp_path)
    names = ("anna0", "anna1", "ben0", "ben1")
    scans = [scans_of_two[0] / f"{name}.ply" for name in names]
    arguments = ("-o", tmp_path, "--existing", "skip")
    for options in ((), ("--subjects", scans_of_two[0] / "who.csv")):
        code, text, _ = run("fit", learned_two[0], *scans, *arguments, *options)
        assert code == 0 and "kept existing fits of 4 of 4 scans\n" in text
    code, _, err = run("fit", learned_two[0], *scans, *arguments, "--subject", "ben")
    assert code == 2 and "anna0.fit.npz, a fit with this model as 'anna'; expected" in one_line(err)
    for name in (f"{name}.fit.npz" for name in names):
        assert (tmp_path / name).read_bytes() == (learned_two[1] / name).read_bytes()


@HURRIED
def test_skip_does_not_take_fits_that_another_subject_could_get(learned_two, scans_of_two, tmp_path, run):
    arguments = ("fit", learned_two[0], scans_of_two[0] / "ben1.ply", "-o", tmp_path, "--existing", "skip")
    assert run(*arguments)[0] == 0
    code, _, err = run(*arguments, "--subject", "ben")
    line = one_line(err)
    assert code == 2 and "with this model and no subject named (template of " in line
    remedy = "Give --subject or --subjects as in that run, or leave them out as there; or delete ben1.fit.npz, .mesh.ply and "
    assert remedy in line
    for path in tmp_path.glob("ben1.*"):
        path.unlink()
    code, text, _ = run(*arguments, "--subject", "ben")
    assert code == 0 and "1 of 1 scan fitted" in text


def test_skip_says_why_a_fit_cannot_be_read(tube_model, tubes, tmp_path, run, monkeypatch):
    _copied(tube_model[1], "t0.*", tmp_path)
    with np.load(tmp_path / "t0.fit.npz") as z:
        arrays = {key: z[key] for key in z.files}
    np.savez(tmp_path / "t0.fit.npz", **{key: array for key, array in arrays.items() if key != "pose"})
    monkeypatch.setattr(fit, "_fit", lambda *_: None)
    _, text, _ = run("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path, "--existing", "skip")
    why = "(an incomplete or broken result ('pose'); expected a result that was saved with FitResult.save)"
    assert f"t0: {tmp_path / 't0.fit.npz'} cannot be read {why}, so the scan is fitted again" in text


@pytest.mark.parametrize(
    "in_file, table, given", [("subjects = 'no.csv'", "", "--subject=0"), ("subject = '1'", "t0,0", "--subjects=")]
)
def test_subjects_on_the_command_line_win(in_file, table, given, tube_model, tubes, tmp_path, run, monkeypatch):
    """Of the two options, one of which is in the configuration file."""
    told = []
    monkeypatch.setattr(fit, "_fit", lambda fitter, todo, subjects, *_: told.append(subjects))
    (tmp_path / "fit.toml").write_text(in_file)
    (tmp_path / "who.csv").write_text(table)
    given += str(tmp_path / "who.csv") if table else ""
    arguments = ("fit", tube_model[0], tubes / "t0.ply", "-o", tmp_path / "out", "--config", tmp_path / "fit.toml")
    run(*arguments, given)
    assert told == [{"t0": 0}]
    (tmp_path / "fit.toml").write_text("subject = '0'\nsubjects = 'who.csv'")
    code, _, err = run(*arguments)
    assert code == 2 and "together with --subject 0; expected one of the two" in one_line(err)


@pytest.mark.parametrize("variant", [slow("cd"), "free-form"])
def test_models_without_labels_want_no_segmenter(variant, tubes, tmp_path, run, monkeypatch):
    monkeypatch.setattr("lbsfit_np.learning.pretraining.pretrain_segmenter", None)
    scans = sorted(tubes.glob("*.ply"))[:2]
    options = ("--variant", variant, "--max-points", 300, "--seed", 6, "--held-out", 0)
    code, text, err = run("learn", tubes / "tube.npz", *scans, "-o", tmp_path / "m.npz", *options, *QUICK_LEARNING)
    assert (code, err) == (0, "") and ("in 1 round" in text) == (variant == "cd")
    code, text, err = run("fit", tmp_path / "m.npz", scans[0], "-o", tmp_path)
    assert (code, err) == (0, "") and f"variant '{variant}'" in text
    settings = json.loads((tmp_path / "summary.json").read_text())["settings"]
    assert (settings["max_points"], settings["seed"]) == (300, 6)  # the model's, not the defaults of lbsfit fit
    assert lbs.LBSFitter.load(tmp_path / "m.npz").segmenter_ is None
    outcome = fit_scans(lbs.LBSFitter.load(tmp_path / "m.npz"), [lbs.load_scan(scans[0])])[0]
    np.testing.assert_array_equal(outcome.result.vertices, lbs.FitResult.load(tmp_path / "t0.fit.npz").vertices)


def test_rig_show_of_a_model(learned_two, run):
    code, text, err = run("rig", "show", learned_two[0])
    assert (code, err) == (0, "") and text.startswith("Rig tube\n")
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
    "format": (_with_header(format=99), ["model format 99", "expected format", "Learn it again"]),
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
    assert code == 130 and "; only its rig is used, not what it has learned" in text


@HURRIED
def test_skip_leaves_each_scan_its_own_subject(learned_two, scans_of_two, tmp_path, run):
    """Where the first alone is kept, the second is still nobody else's."""
    scans = [scans_of_two[0] / f"{name}.ply" for name in ("anna1", "ben1")]
    arguments = ("-o", tmp_path, "--subjects", scans_of_two[0] / "who.csv")
    assert run("fit", learned_two[0], scans[0], *arguments)[0] == 0
    code, text, _ = run("fit", learned_two[0], *scans, *arguments, "--existing", "skip")
    assert code == 0 and "kept existing fits of 1 of 2 scans\n" in text
    entries = json.loads((tmp_path / "summary.json").read_text())["scans"]
    assert [(e["subject"], e["kept"]) for e in entries] == [("anna", True), ("ben", False)]
    assert lbs.FitResult.load(tmp_path / "ben1.fit.npz").subject == "ben"


def test_a_card_beside_a_model_changes_nothing(learned_two, tmp_path, run):
    """A model keeps its rig as it was when it was learned, in all commands; an edited card would make it another."""
    model = tmp_path / "m.npz"
    model.write_bytes(learned_two[0].read_bytes())
    card = tmp_path / "m.card.toml"
    code, text, _ = run("rig", "card", model, "-o", card)
    said = "the rig as the model keeps it; to change it, edit a card of the rig's own file, and learn again"
    assert (code, text) == (0, f"{card} written: {said}\n")
    before = lbs.load_rig(learned_two[0]).digest
    card.write_text(re.sub(r'"elbow" = \[\[.*', '"elbow" = [[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]', card.read_text()))
    rig = lbs.load_rig(model)
    assert rig.digest == before != lbs.load_rig(model, card=card).digest
    note = "the card m.card.toml beside m.npz was not used: a learned model keeps its rig as it was"
    assert note in rig.notes and note in run("rig", "show", model)[1]
    loaded = lbs.LBSFitter.load(model).rig  # which "lbsfit fit" shows the notes of
    assert loaded.digest == before and note in loaded.notes
