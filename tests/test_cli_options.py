"""Options on the command line and in configuration files: bad ones are named on one line."""

import argparse
import inspect
import json

import pytest
from cli_runs import one_line

import lbsfit_np as lbs
from lbsfit_np import cli
from lbsfit_np.cli import fit
from lbsfit_np.cli.parsing import settings
from lbsfit_np.fitting.effort import EFFORTS
from lbsfit_np.learning.training import training_settings
from lbsfit_np.rig.frames import AXES
from lbsfit_np.starts.turns import ORIENTATIONS

pytestmark = pytest.mark.usefixtures("own_cache")


def test_configuration_files(made, tmp_path, run):
    config = tmp_path / "fit.toml"
    config.write_text(
        'output = "here"\nseed = 4\ntraining-scans = 40\nmax_points = 300\njoints = "fixed"\ntraining = { noise = 0.01 }\n'
        'orientation = "any"\neffort = "fast"\npartial = true\n'
    )
    options = ("--config", config, "--joints", "follow", "--orientation", "upright")
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", *options)
    assert (code, err) == (0, "")
    settings = json.loads((tmp_path / "here" / "summary.json").read_text())["settings"]  # relative to the file
    assert (settings["seed"], settings["max_points"], settings["joints"]) == (4, 300, "follow")
    assert settings["training"] == {"noise": 0.01} and settings["scale"] == "estimate"
    assert (settings["orientation"], settings["effort"], settings["partial"]) == ("upright", "fast", True)


@pytest.mark.parametrize(
    "text, words",
    [
        ("sede = 3", ["'sede'", "one of output, card", "Did you mean 'seed'"]),
        ('seed = "3"', ["seed", "a whole number"]),
        ("jobs = 0", ["got jobs = 0; expected a whole number of at least 1."]),
        ("seed = -1", ["got seed = -1; expected a whole number of at least 0."]),
        ("drop-invalid = 1", ["drop-invalid", "true or false"]),
        ('weights = "papre"', ["weights", "'default' or 'paper'"]),
        ("card = 3", ["card", "text in quotes"]),
        ('orientation = "up"', ["orientation", "'upright' or 'aligned' or 'any'"]),
        ('up = "z"', ["up = 'z'", "Did you mean '+z'?"]),
        ('effort = "most"', ["effort", "'fast' or 'balanced' or 'thorough'"]),
        ('partial = "yes"', ["partial", "true or false"]),
        ("training = 3", ["training", "a table of numbers"]),
        ("training = { trun = 1 }", ["got training: trun: an unknown setting", "Did you mean 'turn'?"]),
        ("training = { n_points = 0 }", ["got training: n_points: 0", "at least"]),
        ("max-points = 9\nmax_points = 9", ["'max-points' twice"]),
        ("seed = ", ["no", "TOML"]),
        ("seed = " + "1" * 5000, ["that is not TOML", "digits"]),
        ("seed = 0x" + "f" * 5000, ["seed", "thousand digits", "a whole number"]),
        ("seed = 1" + "0" * 400, ["seed = 1000", "…", "a whole number"]),
        ("jobs = 100000000000000000000", ["jobs", "at most 9223372036854775807"]),
        ("training = { turn = 1" + "0" * 400 + " }", ["training", "a table of numbers"]),
        ('output = ""', ["got output = ''; expected text in quotes that is not empty."]),
        ("training = { turn = true }", ["got training: turn: true; expected a number of at least 0 and"]),
        ("training = { one_sided = 2 }", ["got training: one_sided: 2; expected true or false, or 1 or 0."]),
        ("one_sided = true", ["'one_sided'", "set partial = true. It belongs in training: training = { one_sided = true }."]),
        ("hole-radius = 0.1", ["'hole-radius'", "It belongs in training: training = { hole_radius = 0.1 }."]),
        ("n_points = 0", ["'n_points'", "Did you mean 'max_points'?"]),
    ],
)
def test_bad_configuration_files(text, words, made, tmp_path, run):
    config = tmp_path / "fit.toml"
    config.write_text(text)
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--config", config)
    assert code == 2 and "fit.toml: got" in one_line(err) and all(word in err for word in words), err


def test_shares_out_of_range_in_a_file_are_named_as_there(made, tmp_path, run):
    config = tmp_path / "learn.toml"
    for text, expected in (("held-out = 1.5", "a number from 0 to 0.9"), ("smooth = -1", "a number of at least 0")):
        config.write_text(text)
        code, _, err = run("learn", made / "tube.npz", made / "one.ply", "-o", tmp_path / "m.npz", "--config", config)
        assert code == 2 and one_line(err).endswith(f"learn.toml: got {text}; expected {expected}.")


@pytest.mark.parametrize("word, value", [("true", True), ("False", False), ("1", 1)])
def test_what_is_on_or_off_in_training_may_be_said_so(word, value, tmp_path):
    (tmp_path / "fit.toml").write_text(f"training = {{ one-sided = {word.lower()} }}")
    for options in (("--training", f"one_sided={word}"), ("--config", str(tmp_path / "fit.toml"))):
        arguments = cli._parser().parse_args(["fit", "r", "s", "-o", "o", *options])
        training = settings(arguments, fit.OPTIONS, arguments.config)["training"]
        assert training == {"one_sided": value} and training_settings(training).one_sided is bool(value)
        fit.check_training(training)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ((), ["COMMAND"]),
        (("fitt",), ["'fitt'", "(choose from 'fit', 'learn', 'animate', 'demo', 'rig', 'bench'). Did you mean 'fit'?"]),
        (("fti",), ["'fti'", "Did you mean 'fit'?"]),
        (("rig", "shw", "tube.npz"), ["'shw'", "Did you mean 'show'?"]),
        (("fit", "tube.npz"), ["SCAN"]),
        (("fit", "tube.npz", "one.ply"), ["-o/--output", "Add -o OUT"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--jobs", "0"), ["--jobs", "'0'", "at least 1"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--seed", "-1"), ["--seed", "at least 0"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--samples", "many"), ["--samples", "'many'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--scale", "free"), ["--scale", "'estimate', 'fixed'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--orientation", "up"), ["--orientation", "'upright', 'aligned', 'any'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--effort", "most"), ["--effort", "'fast', 'balanced', 'thorough'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "turn"), ["--training", "NAME=VALUE"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "trun=1"), ["trun", "Did you mean 'turn'?"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--config", "none.toml"), ["none.toml", "no such file"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--segmenter", "none.npz"), ["none.npz", "no such file"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--parts", "toes"), ["'toes'", "arm and fingers"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--shape", "tall"), ["shape", "'tall'"]),
        (("fit", "tube.npz", "one.ply", "-o", "one.ply"), ["-o: got one.ply, a file; expected a folder to write to"]),
        (("fit", "tube.npz", ".", "-o", "out"), ["a folder", "Name the files in it"]),
        (("fit", "tube.npz", "one.ply", "-o", ""), ["-o/--output", "an empty text", "OUT (folder to write to"]),
        (("fit", "", "one.ply", "-o", "out"), ["RIG: got an empty text"]),
        (("demo", "-o", ""), ["-o/--output", "an empty text"]),
        (("rig", "card", "tube.npz", "-o", ""), ["-o/--output", "an empty text"]),
        (("bench", "roundtrip", "-o", ""), ["-o/--output", "an empty text"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--card", ""), ["--card", "an empty text"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--samples", "9" * 30), ["--samples", "at most 9223372036854775807"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "turn=1" + "0" * 400), ["--training", "NAME=VALUE"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "one_sided=maybe"), ["=maybe'", "VALUE a number"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--training", "n_points=true"), ["--training: got n_points: true; exp"]),
        (("fit", "tube.npz", "one.ply", "-o", "o" * 300), ["ooo", "cannot be made", "too long"]),
        (("fit", "tube.npz", "s" * 300 + ".ply", "-o", "out"), ["SCAN", "does not exist"]),
        (("fit", "r" * 300 + ".npz", "one.ply", "-o", "out"), ["rrr", "no such file"]),
        (("rig", "show", "r" * 300 + ".npz"), ["rrr", "no such file"]),
        (("rig", "card", "tube.npz", "-o", "c" * 300), ["ccc", "too long"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--see", "3"), ["--see"]),
        (("rig", "card", "tube.npz"), ["-o/--output"]),
        (("demo",), ["-o/--output"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--max-points", "3"), ["error: --max-points: got 3", "at least 4"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--up=+z", "--orientation", "any"), ["error: --up: got", "Leave it out"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--up", "up"), ["--up", "'+z'"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--up", "z"), ["'z'", "'-z'). Did you mean '+z'?"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--up=-Z"), ["'-Z'", "Did you mean '-z'?"]),
        (("fit", "tube.npz", "one.ply", "-o", "out", "--effort", "thoruogh"), ["Did you mean 'thorough'?"]),
        (("bench", "starts", "--rows", "0.3", "--fits", "own", "--scans", "1", "--effort", "none"), ["--effort"]),
    ],
)
def test_usage_errors(arguments, words, made, run, monkeypatch):
    monkeypatch.chdir(made)
    code, _, err = run(*arguments)
    line = one_line(err)
    assert code == 2 and all(word in line for word in words), line
    assert not (made / "out").exists()


def test_what_a_command_does_not_know_is_the_commands(run):
    code, _, err = run("fit", "r", "s", "--nonsense")
    assert code == 2 and one_line(err) == "lbsfit: error: unrecognized arguments: --nonsense (see: lbsfit fit --help)"


@pytest.mark.parametrize(
    "command, word, meant",
    [
        ("fit", "--picture", "--pictures"),
        ("learn", "--subject", "--subjects"),
        ("learn", "--result=a/long/path/of/fits", "--results"),  # what follows is no part of its name
    ],
)
def test_a_misspelt_option_is_told_its_like(command, word, meant, run):
    code, _, err = run(command, "r", "s", "-o", "o", word)
    told = f"lbsfit: error: unrecognized arguments: {word}. Did you mean {meant!r}? (see: lbsfit {command} --help)"
    assert code == 2 and one_line(err) == told


@pytest.mark.parametrize(
    "command, words, meant",
    [
        ("learn", "--result results", "--results"),
        ("fit", "--pictrues o", "--pictures"),
        ("fit", "--picture seeds", "--pictures"),
        ("fit", "-O o", "-o"),
    ],
)
def test_what_a_misspelt_option_is_given_has_no_like(command, words, meant, run):
    code, _, err = run(command, "r", "s", *words.split())
    told = f"lbsfit: error: unrecognized arguments: {words}. Did you mean {meant!r}? (see: lbsfit {command} --help)"
    assert code == 2 and one_line(err) == told
    given = words.split()[1]
    code, _, err = run("demo", "--seed", "3", given)  # alone, where there are no scans
    assert code == 2 and one_line(err) == f"lbsfit: error: unrecognized arguments: {given} (see: lbsfit demo --help)"


def test_each_of_several_misspelt_options_is_told_its_like(run):
    code, _, err = run("learn", "r", "s", "-o", "o", "--training-scan", "5", "--pictrues", "--pictrues")
    told = "For --training-scan: did you mean '--training-scans'? For --pictrues: did you mean '--pictures'?"
    given = "--training-scan 5 --pictrues --pictrues"
    assert code == 2 and one_line(err).startswith(f"lbsfit: error: unrecognized arguments: {given}. {told} (see: ")
    code, _, err = run("learn", "r", "s", "-o", "o", "--pictrues", "--zzz")
    assert code == 2 and "--pictrues --zzz. For --pictrues: did you mean '--pictures'? (see: " in one_line(err)


@pytest.mark.parametrize("command", ["fit", "learn"])
@pytest.mark.parametrize("words", ["r a b -o o --jobs 3 c d", "r -o o a b --jobs 3 c d", "-o o r a --seed 3 b c --seed 1 d"])
def test_scans_may_stand_among_options(command, words):
    found = cli._parser().parse_args([command, *words.split()])
    assert (found.rig, found.scans) == ("r", ["a", "b", "c", "d"])


@pytest.mark.parametrize("command", ["roundtrip", "starts"])
@pytest.mark.parametrize("words", ["a --jobs 3 b c", "--jobs 3 a b c", "a b --scans 2 c --jobs 1"])
def test_rigs_of_a_benchmark_may_stand_among_options(command, words):
    assert cli._parser().parse_args(["bench", command, *words.split()]).rigs == ["a", "b", "c"]
    assert cli._parser().parse_args(["bench", command, "--jobs", "3"]).rigs == []


@pytest.mark.parametrize("given", [("--up", "-z"), ("--up=-z",)])
def test_an_axis_may_begin_with_a_hyphen(given):
    arguments = ["fit", "r", "--jobs", "2", *given, "-o", "o", "--", "s", "--up", "-x"]  # what follows -- are names
    found = cli._parser().parse_args(arguments)
    assert (found.up, found.jobs, found.scans) == ("-z", 2, ["s", "--up", "-x"])


def test_choices_that_begin_otherwise_are_left_as_they_are(monkeypatch):
    given, parse = [], argparse.ArgumentParser.parse_known_args
    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", lambda self, a, n: given.append(a) or parse(self, a, n))
    arguments = ["r", "--effort", "fast", "--up", "+z", "--up", "-z", "-o", "o", "s"]
    assert cli._parser().parse_args(["fit", *arguments]).effort == "fast"
    assert given[-1] == ["r", "--effort", "fast", "--up", "+z", "--up=-z", "-o", "o", "s"]  # the command's own


def test_a_configured_path_may_begin_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "fit.toml").write_text('output = "~/fits"\ncard = "a ~/ü.toml"\n')
    arguments = cli._parser().parse_args(["fit", "r", "s", "--config", str(tmp_path / "fit.toml")])
    found = settings(arguments, fit.OPTIONS, arguments.config)
    assert (found["output"], found["card"]) == (str(tmp_path / "home" / "fits"), str(tmp_path / "a ~/ü.toml"))


def test_a_nul_in_a_configured_path_is_one_clear_error(made, tmp_path, run):
    (tmp_path / "fit.toml").write_text('output = "a\\u0000b"\n')
    code, _, err = run("fit", made / "tube.npz", made / "one.ply", "--config", tmp_path / "fit.toml")
    assert code == 2 and "cannot be made" in one_line(err)


def test_an_error_of_the_system_that_nobody_foresaw_is_one_line(run, monkeypatch):
    def full(rig, **_):
        raise OSError(28, "No space left on device", "somewhere")

    monkeypatch.setattr("lbsfit_np.rig.describe.describe", full)
    code, _, err = run("rig", "show", "hand")
    assert code == 2 and one_line(err) == "lbsfit: error: somewhere: No space left on device"


def test_defaults_are_the_librarys():
    parameters = inspect.signature(lbs.LBSFitter).parameters
    options = {option.key: option for option in fit.OPTIONS}
    of_fits = ("weights", "joints", "scale", "orientation", "up", "partial", "effort", "max_points", "registration")
    for key in (*of_fits, "training_scans"):
        assert options[key].default == parameters[key].default, key
    assert set(options["weights"].choices) == set(lbs.losses.PRESETS)
    assert set(options["orientation"].choices) == set(ORIENTATIONS)
    assert set(options["up"].choices) == set(AXES)
    assert set(options["effort"].choices) == set(EFFORTS)


@pytest.mark.parametrize("name, option", [("n_jobs", "--jobs"), ("random_state", "--seed"), ("max_points", "--max-points")])
@pytest.mark.parametrize("command", ["fit", "learn"])
def test_errors_name_the_option(command, name, option, tubes, tmp_path, run, monkeypatch):
    def refuse(fitter):
        raise lbs.InputError(name, "one", "another", "Take it.")

    monkeypatch.setattr("lbsfit_np.learning.parameters.check_parameters", refuse)
    monkeypatch.setattr("lbsfit_np.learning.fitter.check_parameters", refuse)
    out = tmp_path / ("m.npz" if command == "learn" else "fits")
    code, _, err = run(command, tubes / "tube.npz", *sorted(tubes.glob("*.ply")), "-o", out)
    assert (code, err) == (2, f"lbsfit: error: {option}: got one; expected another. Take it.\n")
