"""The help of the commands, and the progress of ``lbsfit fit``."""

import argparse

import pytest
from cli_runs import help_alone

from lbsfit_np.cli import _parser, fit, models
from lbsfit_np.cli.progress import SILENCE, Progress
from lbsfit_np.cli.summary import say_doubtful

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.mark.parametrize(
    "command", [(), ("fit",), ("animate",), ("demo",), ("rig",), ("rig", "show"), ("rig", "card"), ("rig", "list")]
)
def test_help_has_an_example(command, run):
    code, text, err = run(*command, "--help")
    assert (code, err) == (0, "")
    assert "usage: lbsfit" in text and (command == ("rig",) or "example" in text)


def test_help_shows_defaults(run):
    text = run("fit", "--help")[1]
    text = " ".join(text.split())  # help is wrapped
    for option in fit.OPTIONS:
        if option.default not in (None, {}):
            shown = {True: "yes", False: "no"}.get(option.default, option.default) if option.kind is bool else option.default
            assert f"{option.help} (default: {shown})" in text, option.name


def test_help_names_all_that_a_model_supplies(run):
    text = " ".join(run("fit", "--help")[1].split())
    told = text[text.index("are refused with it.") : text.index("are the model's unless")]
    for key in models._FREE:
        assert f"--{key.replace('_', '-')}" in told, key


def test_names_in_help_are_not_broken(run):
    text = run("bench", "study", "--help")[1]
    for row in ("free-form-augmented", "free-form-supervised-3x", "oracle-labels", "pose-only"):
        assert row in text, row
    assert "oracle-labels,oracle-fit" in "".join(text.split())
    texts = list(_helps(_parser()))
    assert len(texts) > 12 and not any("\0" in text for text in texts)


def _helps(parser):
    """The help of a parser and of all its commands."""
    yield parser.format_help()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _helps(command)


def test_help_is_quick():
    done = help_alone("fit")
    assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr


def test_training_says_a_line_a_minute(capsys):
    """As learning does."""
    now = [0.0]
    progress = Progress(1, terminal=False, clock=lambda: now[0])
    for share in (0.0, 0.2, 0.25, 0.6, 1.0):
        progress.training(share)
        now[0] += 0.6 * SILENCE
    progress.close()
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == "training on synthetic scans of the rig (once per rig and settings)"
    assert lines == [f"{first}: 25%, about 4 min left in this step"]  # 72 s for a quarter


@pytest.mark.parametrize("status", ["suspect", "failed"])
def test_a_line_of_a_fit_in_doubt_has_the_first_reason(status, capsys):
    """All of them are in the table at the end."""
    progress, fit = Progress(3, terminal=False), {"name": "one", "status": status, "probability": 0.125}
    progress.scan(fit | {"files": {}, "message": "points near part head are not explained; the wrong rig?; in one unit"})
    progress.scan(fit | {"files": {}, "message": "several small things together"})
    progress.scan({"name": "two", "status": "failed", "message": "no points; nothing to fit"})
    lines = "".join(capsys.readouterr()).splitlines()
    assert sorted(lines) == [
        f"[1/3] one: {status}: points near part head are not explained; … (right with probability 0.12)",
        f"[2/3] one: {status}: several small things together (right with probability 0.12)",
        "[3/3] two: failed: no points; nothing to fit",
    ]


def test_fits_that_are_ok_but_not_surely_right_are_named(capsys):
    """The least probable first; free-form fits have no evidence, and a probability of 0."""
    sure = {"status": "ok", "probability": 0.8, "evidence": {"rival": 0.1}, "message": ""}
    say_doubtful([sure | {"name": "one"}, sure | {"name": "free", "probability": 0.0, "evidence": {}}])
    assert capsys.readouterr().out == ""
    several = [sure | {"name": f"n{k}", "probability": p} for k, p in enumerate((0.7, 0.504, 0.95, 0.799))]
    say_doubtful([{"name": "s", "status": "suspect", "probability": 0.3, "evidence": {"rival": 0.9}, "message": "odd"}])
    assert " ok, but" not in capsys.readouterr().out
    say_doubtful([sure | {"name": "one"}, several[0], several[3]])
    say_doubtful(several + [sure | {"name": f"m{k}", "probability": 0.75} for k in range(4)])
    assert capsys.readouterr().out.splitlines() == [
        "note: 2 fits are ok, but each right with a probability below 0.8 only: n0 (0.70), n3 (0.799)",
        "note: 7 fits are ok, but each right with a probability below 0.8 only: n1 (0.50), n0 (0.70), m0 (0.75), m1 (0.75), "
        "m2 (0.75) and 2 more",
    ]


@pytest.mark.parametrize("terminal", [False, True])
def test_what_is_to_be_fitted_is_said_before_the_first_fit_is_there(terminal, capsys):
    progress = Progress(3, terminal=terminal)
    progress.scan({"name": "one", "status": "failed", "message": "no points"})  # before the training
    progress.training(0.5)
    progress.fitting()
    out, err = capsys.readouterr()
    assert ("| 1/3 [" in err) == terminal and out.endswith("fitting 2 scans\n") != terminal
    progress.close()


def test_a_bar_on_a_terminal(capsys):
    progress = Progress(2, terminal=True)
    for share in (0.3, 1.0):
        progress.training(share)
    progress.scan({"name": "one", "status": "ok", "seconds": 1.0, "terms": {"recon": 0.01}, "message": "converged"})
    progress.scan({"name": "two", "status": "failed", "message": "no points"})
    progress.close()
    out, err = capsys.readouterr()
    assert out == "" and "training on synthetic scans" in err
    assert "2/2" in err and "two: failed: no points" in err and "one: fitted" not in err


def test_a_bar_counts_a_broken_scan_at_once(capsys):
    progress = Progress(3, terminal=True)
    progress.fitting()
    progress.scan({"name": "one", "status": "failed", "message": "no points"})
    told = capsys.readouterr().err
    progress.close()
    assert "one: failed: no points" in told and "1/3" in told.rsplit("no points", 1)[1]
