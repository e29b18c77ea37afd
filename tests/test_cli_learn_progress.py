"""The progress of ``lbsfit learn`` with the time left, and its help."""

import os
import re
import struct
import warnings
from types import SimpleNamespace

import pytest
from cli_runs import help_alone

from lbsfit_np.cli import learn, progress
from lbsfit_np.cli.progress import LearningProgress, Progress, in_digits, of_all, span
from lbsfit_np.errors import counted
from lbsfit_np.io.columns import ODD_X

pytestmark = pytest.mark.usefixtures("own_cache")
_TERMINALS = ("fcntl", "pty", "termios")


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
    alone = "each scan by itself, with its own proportions"
    assert f"{alone}: recon 0.0200 on the scans learned from, 0.0300 on those held out; took 60 s\n" in shown
    assert "beyond the rig" not in shown
    better, left = "got a better pose from a new start", "left for the rounds\n"
    assert f"; 1 scan {better}; took 60 s; at most about 3 min {left}" in shown  # three rounds like the first
    assert f"; 2 scans {better}; took 3 min; at most about 4 min {left}" in shown  # two of 120 s
    if terminal:
        assert out == "" and "round 2 of at most 4: poses of scans" in err and ", at most about 3 min left for the rounds" in err
        assert "results" in err and "left" not in err[err.rindex("results") :]
    else:
        assert out.count("round 2 of at most 4: poses of scans\n") == 1 and "\ncomputing the results\n" in out


def test_a_round_that_went_on_with_an_earlier_runs_steps_does_not_tell_the_time_left(capsys):
    clock = _Clock()
    progress = LearningProgress(4, terminal=False, clock=clock)
    progress("first fits", 1.0)
    progress("round", 1.0, _figures(0))
    for k, first, passed, seconds in ((1, 1.0, 2, 60.0), (2, 1.0, 20, 20.0), (3, 0.0, 180, 180.0)):
        progress("templates", first)
        progress("poses of scans", 0.0)
        clock.now += passed
        progress("round", 1.0, _figures(k, seconds=seconds))
    lines = [line for line in capsys.readouterr().out.splitlines() if "recon" in line]
    assert lines[1].endswith("took 60 s; at most about 3 min left for the rounds")  # all of it was there, with its seconds
    assert lines[2].endswith("took 20 s; at most about 2 min left for the rounds")  # two rounds like the first
    assert lines[3].endswith("took 3 min; at most about 2 min left for the rounds")


@pytest.mark.parametrize("n, words", [(1, "1 scan"), (3, "3 scans")])
def test_scans_that_go_on_beyond_the_rig_are_told_of(n, words, capsys):
    LearningProgress(4, terminal=False)("round", 1.0, _figures(0, beyond=n))
    told = f"held out; points beyond the rig left out in {words}; took 60 s\n"
    assert told in capsys.readouterr().out


@pytest.fixture
def drawn_at_once(monkeypatch):
    """Bars that are drawn at every step, however fast these are."""
    bar = progress.bar
    monkeypatch.setattr(progress, "bar", lambda **options: bar(mininterval=0, miniters=0, **options))


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("stage", ["pretraining", "first fits", "poses of scans", "results"])
def test_the_time_left_of_a_step_where_rounds_do_not_tell(stage, terminal, capsys, drawn_at_once):
    clock = _Clock()
    shown = LearningProgress(1, terminal=terminal, clock=clock)
    if stage == "poses of scans":
        shown("round", 1.0, _figures(0))
    clock.now += 1000  # what was before does not count
    shown(stage, 0.0)
    clock.now += 70
    shown(stage, 0.25)
    clock.now += 10
    shown(stage, 0.5)
    shown(stage, 1.0)
    shown.close()
    out, err = capsys.readouterr()
    if terminal:
        assert "about 4 min left in this step" in err and "about 80 s left in this step" in err and out == ""
    else:
        assert ": 25%, about 4 min left in this step\n" in out and "80 s" not in out  # a line a minute, no more
        assert len([line for line in out.splitlines() if "recon" not in line]) == 2


def test_a_stage_that_is_done_again_starts_anew(capsys, drawn_at_once):
    clock = _Clock()
    shown = LearningProgress(1, terminal=True, clock=clock)
    shown("smoothing", 0.5)
    clock.now += 500
    shown("smoothing", 1.0)
    shown("smoothing", 0.0)
    clock.now += 20
    shown("smoothing", 0.5)
    shown.close()
    assert "about 20 s left in this step" in capsys.readouterr().err


def test_what_an_earlier_run_has_done_takes_no_time(capsys, drawn_at_once):
    clock = _Clock()
    shown = LearningProgress(4, terminal=True, clock=clock)
    shown("first fits", 0.5)
    clock.now += 20
    shown("first fits", 0.75)
    assert "about 20 s left in this step" in capsys.readouterr().err
    shown("round", 1.0, _figures(0))
    shown("round", 1.0, _figures(1))  # at once, but it had taken a minute
    shown.close()
    assert "took 60 s; at most about 3 min left for the rounds" in capsys.readouterr().err


def test_a_scan_that_cannot_be_used_has_no_line_said_again(capsys):
    shown = LearningProgress(1, terminal=False)
    shown("reading scans", 0.2)
    shown.failed("two", "no points")
    shown("reading scans", 0.6)
    told = capsys.readouterr()
    assert (told.out, told.err) == ("reading scans\n", "two: failed: no points\n")


@pytest.mark.parametrize("made", [Progress, LearningProgress])
def test_notes_of_one_kind_are_said_of_the_first_scan_with_it(made, capsys):
    shown = made(2, terminal=False)
    shown.notes("a", ["3 of 10 points left out."])
    shown.notes("b", ["4 of 120 points left out.", "Labels left out."])
    assert capsys.readouterr() == ("note: a: 3 of 10 points left out.\nnote: b: Labels left out.\n", "")
    columns = [f"Column {name} does not hold numbers: left out." for name in ("'n1'", "'n2'", "'3'", "'4'")]
    counts = ["2 columns left out.", "3 columns left out."]  # two of one kind in one scan
    shown.notes("c", [*columns, *counts])
    shown.notes("d", [*columns, *counts])
    assert capsys.readouterr().out == "".join(f"note: c: {note}\n" for note in (*columns, *counts))


@pytest.mark.parametrize("made", [Progress, LearningProgress])
def test_other_names_in_a_later_scan_are_said_as_well(made, capsys):
    shown = made(2, terminal=False)
    for scan, columns in {"a": ("'n1'", "'3'"), "b": ("'n2'", "'4'")}.items():
        notes = [f"Column {name} does not hold numbers: left out." for name in columns]
        shown.notes(scan, notes)
        assert capsys.readouterr().out == "".join(f"note: {scan}: {note}\n" for note in notes)


@pytest.mark.parametrize("made", [Progress, LearningProgress])
def test_a_note_that_spoils_each_fit_is_said_of_each_scan(made, capsys):
    shown, note = made(2, terminal=False), f"{ODD_X} (0, 1, 3, …) looks like row numbers."
    for name in ("a", "b"):
        shown.notes(name, [note, "Labels left out."])
    assert capsys.readouterr().out == f"note: a: {note}\nnote: a: Labels left out.\nnote: b: {note}\n"


def test_a_note_closes_the_bar_and_is_said_once(capsys, monkeypatch):
    shown, closed = LearningProgress(1, terminal=True), []
    shown("reading scans", 0.2)
    capsys.readouterr()
    monkeypatch.setattr(shown, "close", lambda: closed.append(capsys.readouterr().err))
    for name in ("one", "two"):
        shown.notes(name, ["3 points left out."])
    monkeypatch.undo()
    told = capsys.readouterr()
    shown.close()
    assert (told.out, told.err, len(closed)) == ("", "note: one: 3 points left out.\n", 1) and "note" not in closed[0]


def test_a_warning_closes_the_bar(capsys, monkeypatch):
    shown, told = LearningProgress(1, terminal=True), []

    def fit(*given, progress, **options):
        progress("first fits", 0.5)
        assert shown._bar is not None
        warnings.warn("odd", stacklevel=1)

    monkeypatch.setattr(warnings, "showwarning", lambda message, *more: told.append((str(message), shown._bar is None)))
    learn._learn(SimpleNamespace(fit=fit), SimpleNamespace(sources=[]), None, shown, None)
    assert told == [("odd", True)]


def test_narrow_terminals_show_the_time_left(monkeypatch, drawn_at_once):
    """They cut the end of a line, which says what is done."""
    fcntl, pty, termios = (pytest.importorskip(name, reason="terminals of this system are others") for name in _TERMINALS)
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    with os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        clock = _Clock()
        shown = progress.LearningProgress(2, terminal=True, clock=clock)
        shown("pretraining", 0.0)
        clock.now += 600
        shown("pretraining", 0.25)
        shown._bar.refresh()
        monkeypatch.undo()
        text = os.read(ours, 10_000).decode()
    os.close(ours)
    assert re.search(r" 25%\|.*about 30 min left in this step: training", text)
    assert "-0 s" not in text and max(map(len, text.split("\r"))) <= 80


@pytest.mark.parametrize("columns, rows", [(0, 0), (60, 24), (60, 0)])
def test_a_terminal_that_does_not_tell_its_size_has_a_bar_too(columns, rows, monkeypatch):
    fcntl, pty, termios = (pytest.importorskip(name, reason="terminals of this system are others") for name in _TERMINALS)
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    with os.fdopen(ours, "rb", 0) as seen, os.fdopen(theirs, "w") as terminal:
        monkeypatch.setattr("sys.stderr", terminal)
        progress.bar(total=4, desc="doing", initial=2).close()
        monkeypatch.undo()
        shown = b""
        while not shown.endswith(b"\n"):
            shown += seen.read(1000)
    longest = max(shown.decode().split("\r"), key=len).rstrip()
    assert longest.startswith("doing:  50%|") and (columns or 80) - 1 <= len(longest) <= (columns or 80)


def test_rounds_that_hold_nothing_out(capsys):
    progress = LearningProgress(1, terminal=False)
    progress("round", 1.0, _figures(0) | {"recon_held_out": None})
    assert "recon 0.0200 on the scans learned from; took" in capsys.readouterr().out
    progress("round", 1.0, _figures(1) | {"recon": None})
    assert "recon 0.0300 on those held out; took" in capsys.readouterr().out


@pytest.mark.parametrize("seconds, words", [(0.2, "0 s"), (99, "99 s"), (150, "2 min"), (5990, "100 min"), (9000, "2.5 h")])
def test_lengths_of_time(seconds, words):
    assert span(seconds) == words


@pytest.mark.parametrize("n, words", [(0, "0 pairs"), (1, "1 pair"), (2, "2 pairs")])
def test_one_of_a_kind_is_told_as_one(n, words):
    assert counted(n, "pair") == words and of_all(1, n, "pair") == f"1 of {words}"


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
    done = help_alone("learn")
    assert done.stdout.splitlines()[-1] == "[]", done.stdout + done.stderr


@pytest.mark.parametrize(
    "probability, text", [(0.93, "0.93"), (0.05, "0.05"), (0.0469, "0.047"), (0.4999, "0.4999"), (0.0, "0.00"), (0.5, "0.50")]
)
def test_a_probability_is_on_its_side_of_the_bounds(probability, text):
    """A fit that has failed, below 0.05, is not said to be right with a probability of 0.05."""
    assert in_digits(probability) == text
