"""Runs of the program in a process of its own, and what the tests of the command line have in common."""

import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import lbsfit_np as lbs
from lbsfit_np.bench import hand

TRAINING = ("--training-scans", "40")  # enough for the four parts of the tube
QUICK = (*TRAINING, "--effort", "fast")
QUICK_LEARNING = (*QUICK, "--rounds", "1")
HAND = "hand-coarse"
ARRAYS = ("pose", "translation", "scale", "offsets", "rest_joints", "vertices", "joints", "joint_std", "labels", "confidence")
ARRAYS += ("terms",)

_PACKAGE_PARENT = str(Path(lbs.__file__).resolve().parents[1])
_HEAVY = ("scipy", "sklearn", "trimesh", "tqdm", "matplotlib", "multiprocessing")


def program(*arguments, cache, start=subprocess.run, hurried=False, before=(), **options):
    """``hurried``: as ``learning_is_hurried`` has it, for what becomes of fits, right or not.

    ``before``: folders in which modules are looked for first.
    """
    path = os.pathsep.join([*map(str, before), _PACKAGE_PARENT])
    environment = os.environ | {"LBSFIT_CACHE": str(cache), "PYTHONPATH": path}
    which = (str(Path(__file__).with_name("hurried_program.py")),) if hurried else ("-m", "lbsfit_np")
    command = [sys.executable, *which, *map(str, arguments)]
    if start is subprocess.run:
        options |= {"capture_output": True, "timeout": 300}
    return start(command, env=environment, text=True, **options)


def started(*arguments, cache, hurried=False):
    """The program as a process group of its own, as a terminal starts it."""
    return program(
        *arguments,
        cache=cache,
        hurried=hurried,
        start=subprocess.Popen,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def stopped(process, sent):
    """(output, errors) after a signal: Ctrl-C goes to the whole group, as a terminal sends it."""
    os.killpg(process.pid, sent) if sent == signal.SIGINT else process.send_signal(sent)
    return process.communicate(timeout=120)


def content_with_few_starts(patch):
    """Have all fitters that are made in this process be so, those of benchmarks too, which take no effort."""
    patch.setitem(lbs.LBSFitter.__init__.__kwdefaults__, "effort", "fast")


def scans_of_hands_are_small(patch):
    """Have the benchmark of the hand, in this process, look at a quarter of the points; for what becomes of its fits."""
    patch.setattr(hand, "SCAN", replace(hand.SCAN, n_points=hand.SCAN.n_points // 4))


def as_said(line, scans):
    """The command that a line ends with, for these scans."""
    words = shlex.split(line[line.index("lbsfit fit ") :])
    k = words.index("SCAN...")
    return [*words[1:k], *scans, *words[k + 1 :]]


def one_line(err):
    lines = err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("lbsfit: error: "), err
    return lines[0]


def help_alone(command):
    """The help of a command in a process of its own, which ends with a line of the heavy modules that it has imported."""
    code = f"import sys; from lbsfit_np.cli import main; main([{command!r}, '--help']); "
    code += f"print([m for m in sys.modules if m in {_HEAVY!r}])"
    environment = os.environ | {"PYTHONPATH": _PACKAGE_PARENT}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=120)
