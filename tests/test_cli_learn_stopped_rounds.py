"""``lbsfit learn`` that is stopped once a round is over: the model of that round, and how to go on with it."""

import os
import shlex
import signal

import numpy as np
import pytest
from cli_runs import QUICK_LEARNING, as_said

import lbsfit_np as lbs
from lbsfit_np.cli import stopped_learning
from lbsfit_np.cli.progress import LearningProgress

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")


@pytest.fixture
def stop_after_a_round(tube_model, monkeypatch):
    """(ids) → learning stops once a round has learned these subjects' templates, and a scan has failed."""

    def made(*subjects):
        def fit(self, *given, **options):
            learned = lbs.LBSFitter.load(tube_model[0])
            self.template_, self.unit_ = (dict.fromkeys(subjects, getattr(learned, name)[0]) for name in ("template_", "unit_"))
            self.learned_unit_ = None
            self.segmenter_, self.regressor_, self.history_ = learned.segmenter_, learned.regressor_, learned.history_
            self.failures_, self._learned_with = {1: "nobody foresaw this"}, learned._learned_with
            raise KeyboardInterrupt

        monkeypatch.setattr(lbs.LBSFitter, "fit", fit)

    return made


@pytest.mark.parametrize(
    "subjects, results, options, words",
    [
        ((0,), None, (), "with it: lbsfit fit '{}/m n.npz' SCAN... -o OUT\n"),
        ((0,), "of all", (), "with it: lbsfit fit '{}/m n.npz' SCAN... -o '{}/of all'\n"),
        ((0,), "fits", ("--existing", "replace"), "with it: lbsfit fit '{}/m n.npz' SCAN... -o {}/fits --existing replace\n"),
        ((0,), "fits", ("--pictures",), "with it: lbsfit fit '{}/m n.npz' SCAN... -o {}/fits --pictures\n"),
        (("a", "b"), None, (), "with it: lbsfit fit '{}/m n.npz' SCAN... -o OUT\n"),
        (
            ("a", "b"),
            None,
            ("--subjects", "{}/who is who.csv"),
            "with it (fit others without --subjects, or with an empty id in its file): "
            "lbsfit fit '{}/m n.npz' SCAN... -o OUT --subjects '{}/who is who.csv'\n",
        ),
    ],
)
def test_how_to_go_on_after_a_round(subjects, results, options, words, tubes, tmp_path, run, stop_after_a_round, monkeypatch):
    stop_after_a_round(*subjects)
    monkeypatch.setattr(stopped_learning, "_SHORT", 0)  # for names that are short see below
    (tmp_path / "who is who.csv").write_text("t0,a\nt1,b\nt2,a\nt3,b\n")
    options = [word.replace("{}", str(tmp_path)) for word in options]
    outputs = ("-o", tmp_path / "m n.npz", *(() if results is None else ("--results", tmp_path / results)))
    code, text, err = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *outputs, *options)
    assert (code, err) == (130, "t1: failed: nobody foresaw this\n")
    with_it = "" if options[:1] == ["--existing"] else "with --existing replace "
    anew = f"results; run the same command {with_it}to start again; to fit {'these ' if '--subjects' in options else ''}scans "
    *_, heading, failed, last = text.splitlines()
    assert heading.split() == ["scan", "status", "probability", "why"]  # of a scan that was named long before
    assert failed.split(maxsplit=3) == ["t1", "failed", "–", "nobody foresaw this"]
    assert anew + words.replace("{}", str(tmp_path)) in last + "\n"
    assert list(lbs.LBSFitter.load(tmp_path / "m n.npz").template_) == list(subjects)


def test_the_command_after_a_round_can_be_pasted_where_names_are_short(tubes, tmp_path, run, stop_after_a_round, monkeypatch):
    stop_after_a_round("a", "b")
    (tmp_path / "who is.csv").write_text("t0,a\nt1,b\nt2,carl\nt3,b\n")  # t1 has failed, of carl nothing was learned
    monkeypatch.chdir(tubes)
    scans, fits = ("t0.ply", "t1.ply", "t2.ply", "t3.ply"), ("-o", tmp_path / "m.npz", "--results", tmp_path / "fits")
    text = run("learn", "tube.npz", *scans, *fits)[1]
    assert f" to fit scans with it: lbsfit fit {tmp_path}/m.npz t0.ply t2.ply t3.ply -o {tmp_path}/fits\n" in text
    text = run("learn", "tube.npz", *scans, *fits, "--existing", "replace", "--subjects", tmp_path / "who is.csv")[1]
    assert " -o OUT --subjects " in text and "--existing" not in text  # a model that was there keeps its results, too
    command = shlex.split(text[text.index("lbsfit fit ") :].replace(" OUT ", f" {tmp_path}/out "))
    assert command[2:5] == [f"{tmp_path}/m.stopped.npz", "t0.ply", "t3.ply"]
    code, text, err = run(*command[1:])
    assert (code, err) == (0, "") and "2 of 2 scans fitted" in text


def test_subjects_of_whom_nothing_was_learned_are_named_after_a_stop(tubes, tmp_path, run, stop_after_a_round, monkeypatch):
    """With the table their scans are refused: the command is for the others."""
    stop_after_a_round("a", "b")
    monkeypatch.setattr(stopped_learning, "_SHORT", 0)
    (tmp_path / "who.csv").write_text("t0,a\nt1,carl\nt2,b\nt3,carl\n")
    arguments = ("-o", tmp_path / "m.npz", "--subjects", tmp_path / "who.csv")
    text = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), *arguments)[1]
    line = text.splitlines()[-1]
    which = "to fit these scans with it, except scans of 'carl', of whom nothing was learned (fit others without --subjects, "
    assert f"{which}or with an empty id in its file): lbsfit fit " in line
    command = as_said(line.replace("OUT", str(tmp_path / "out")), [str(tubes / "t0.ply"), str(tubes / "t2.ply")])
    code, text, _ = run(*command)
    assert code == 0 and "2 of 2 scans fitted" in text
    assert run(*as_said(line.replace("OUT", str(tmp_path / "out")), [str(tubes / "t1.ply")]))[0] == 2


def test_a_model_that_was_there_is_left_alone(tubes, tube_model, tmp_path, run, stop_after_a_round):
    """Neither a finished one nor what an earlier stop has left is lost for a round."""
    stop_after_a_round(0)
    scans, model = sorted(tubes.glob("*.ply")), tmp_path / "m.npz"
    model.write_bytes(tube_model[0].read_bytes() + b"finished")
    there = {"m.npz": model.read_bytes()}
    for name in ("m.stopped.npz", "m.stopped-2.npz"):
        code, text, _ = run("learn", tubes / "tube.npz", *scans, "-o", model, "--existing", "replace")
        has = f"stopped: {tmp_path / name} has what round {_round(tube_model[0])} learned, without results; {model} is left as "
        how = f"it was; run the same command to start again; to fit scans with it: lbsfit fit {tmp_path / name} "
        assert code == 130 and text.splitlines()[-1].startswith(has + how)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != name} == there
        assert list(lbs.LBSFitter.load(tmp_path / name).template_) == [0]
        there[name] = (tmp_path / name).read_bytes()


def _round(model):
    """The round that a model has kept."""
    return next(entry["round"] for entry in lbs.LBSFitter.load(model).history_ if entry["kept"])


@pytest.mark.slow
def test_learning_goes_on_to_the_model_that_was_left_alone(tubes, tube_model, tmp_path, run, monkeypatch):
    scans, model = sorted(tubes.glob("*.ply")), tmp_path / "m.npz"
    arguments = ("learn", tubes / "tube.npz", *scans, "-o", model, "--existing", "replace", *QUICK_LEARNING)
    model.write_bytes(tube_model[0].read_bytes() + b"finished")
    before, went_on = model.read_bytes(), LearningProgress.__call__

    def stopped(self, stage, share, figures=None):
        if stage == "results":
            raise KeyboardInterrupt
        went_on(self, stage, share, figures)

    with monkeypatch.context() as patch:
        patch.setattr(LearningProgress, "__call__", stopped)
        code, text, _ = run(*arguments)
    kept = tmp_path / "m.npz.unfinished"
    told = f"; {model} is left as it was; run the same command to continue from the steps kept in {kept}; "
    assert code == 130 and told in text
    assert model.read_bytes() == before and (tmp_path / "m.stopped.npz").is_file()
    code, text, _ = run(*arguments)
    assert text.startswith("note: found ") and f"saved steps of an interrupted run in {kept}; " in text and "; wrote " in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m.npz", "m.stopped.npz"]
    assert model.read_bytes() != before and _round(model) == _round(tube_model[0])


def test_ctrl_c_while_the_finished_model_is_written_finds_it_complete(tubes, tmp_path, run, monkeypatch):
    """Not a model that was there."""
    save = lbs.LBSFitter.save

    def signalled(self, path):
        save(self, path)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(lbs.LBSFitter, "save", signalled)
    arguments = ("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz")
    code, text, _ = run(*arguments, "--variant", "free-form")
    assert code == 130 and text.endswith(f"stopped: {tmp_path / 'm.npz'} is complete\n")
    assert (tmp_path / "m.npz").is_file() and not (tmp_path / "m.stopped.npz").exists()


@pytest.mark.skipif(os.name != "posix", reason="SIGTERM is a POSIX signal")
def test_sigterm_while_the_model_of_a_stopped_run_is_written(tubes, tmp_path, run, stop_after_a_round, monkeypatch):
    def slow(entry, array, **_):
        entry.write(b"half")
        os.kill(os.getpid(), signal.SIGTERM)

    stop_after_a_round(0)
    monkeypatch.setattr(np.lib.format, "write_array", slow)
    before = signal.signal(signal.SIGTERM, lambda *_: pytest.fail("it would have ended the process"))
    try:
        code = run("learn", tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", tmp_path / "m.npz")[0]
    finally:
        signal.signal(signal.SIGTERM, before)
    assert code == 143 and not list(tmp_path.iterdir())
