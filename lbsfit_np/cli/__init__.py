"""The command line ``lbsfit``: one module a command, each with ``add_parser`` and a function that runs it."""

import importlib
import os
import sys
import warnings

from .. import __version__
from ..errors import FileError, LbsfitError
from .parsing import Parser, formatter
from .stopping import exit_code

__all__ = ["main"]

# Modules of this package; each has add_parser(commands), which sets ``run``. Heavy imports wait until a command runs.
_COMMANDS = ("fit", "learn", "animate", "demo", "rig", "bench")

_EPILOG = """\
examples:
  lbsfit demo -o demo                        see it work on a rig and a scan that the package makes itself
  lbsfit fit hand.glb scans/*.ply -o fits    fit scans
  lbsfit learn hand scans/*.ply -o m.npz     learn from a collection of scans, for better fits
  lbsfit animate hand.glb fits/*.fit.npz -o hand-moves.glb
                                             write the fits as an animated rig, for other programs
  lbsfit rig show hand.glb                   show what is in a rig

exit codes: 0 all done, 1 some scans failed, 2 usage or unreadable rig, 130 stopped by Ctrl-C, 143 by SIGTERM
"""


def main(argv=None):
    """Run a command.

    Parameters
    ----------
    argv : list of str, optional
        Default ``sys.argv[1:]``.

    Returns
    -------
    int
        The exit code: 0 all done, 1 some scans failed, 2 usage or unreadable input, 130 stopped by Ctrl-C, 143 by SIGTERM,
        141 as nobody reads its output any more.
    """
    if argv is None:
        for stream in filter(None, (sys.stdout, sys.stderr)):  # a closed one is None
            stream.reconfigure(errors="replace")  # a terminal that lacks a letter shows "?" rather than an error
    try:
        arguments = _parser().parse_args(argv)
    except SystemExit as stop:  # after --help, --version, or a usage error that has been printed
        return stop.code or 0
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return arguments.run(arguments)
    except LbsfitError as error:
        print(f"lbsfit: error: {_as_written(error, getattr(arguments, 'flags', {}))}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141  # as a shell has it of a program that SIGPIPE ended
    except KeyboardInterrupt as stop:
        print("lbsfit: stopped", file=sys.stderr)
        return exit_code(stop)
    except OSError as error:  # one that no reader or writer has foreseen
        where = "" if error.filename is None else f"{error.filename}: "
        print(f"lbsfit: error: {_notes(error)}{where}{error.strerror or error}", file=sys.stderr)
        return 2
    except MemoryError as error:
        options = "--training-scans, --jobs, --samples, where the command has them"
        words = f"{_notes(error)}out of memory; use fewer training scans, worker processes or points ({options})"
        print(f"lbsfit: error: {words}", file=sys.stderr)
        return 2


def _parser():
    parser = Parser(
        prog="lbsfit",
        description="Fit rigged meshes to point clouds: joint angles, a registered mesh, and the part of every point.",
        epilog=_EPILOG,
        formatter_class=formatter,
    )
    parser.add_argument("--version", action="version", version=f"lbsfit {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, title="commands")
    for name in _COMMANDS:
        importlib.import_module(f".{name}", __name__).add_parser(commands)
    return parser


def _as_written(error, flags):
    """The message, after its notes; where it names a parameter that an option gives, the option."""
    name, message = getattr(error, "argument", None), str(error)
    flags = {"path_or_name": "RIG"} | flags
    # A file's name, and scans themselves, are no options, whatever they are called.
    if name in flags and not isinstance(error, FileError) and name != "scans":
        message = message.replace(f"{name}:", f"{flags[name]}:", 1)
    return _notes(error) + message


def _notes(error):
    """What is said before the message: where it was."""
    return "".join(f"{note}: " for note in getattr(error, "__notes__", ()))


def _show_warning(message, category, filename, lineno, file=None, line=None):
    print(f"lbsfit: warning: {message}", file=sys.stderr)
