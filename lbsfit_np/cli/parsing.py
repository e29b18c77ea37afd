"""argparse as this command line uses it: errors in one line, and options that a configuration file can give as well."""

import argparse
import math
import os
import sys
import textwrap
import tomllib
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import FileError, InputError, brief, did_you_mean

__all__ = [
    "Option",
    "Parser",
    "add_options",
    "amount",
    "chosen",
    "formatter",
    "natural",
    "positive",
    "settings",
    "share",
]

_LARGEST = 2**63 - 1  # what arrays can count
_LARGEST_SHARE = 0.9


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors look like all others of the program, and that knows no abbreviations."""

    def __init__(self, **keywords):
        super().__init__(**{"allow_abbrev": False, **keywords})
        self.set_defaults(parser=self)  # of a command, its own

    def parse_args(self, args=None, namespace=None):
        """As argparse does it, but what a command does not know is said to be its own, and files and rigs may follow options."""
        found, unknown = self.parse_known_args(args, namespace)
        several = [action.dest for action in found.parser._get_positional_actions() if action.nargs in ("+", "*")]
        if several and not any(word.startswith("-") for word in unknown):
            getattr(found, several[-1]).extend(unknown)
            return found
        if unknown:
            known = found.parser._option_string_actions
            # Others are what options that are not known would have been given.
            options = dict.fromkeys(word.partition("=")[0] for word in unknown if word.startswith("-"))
            hints = {word: hint for word in options if (hint := did_you_mean(word, known))}
            if len(options) > 1:  # of which one is it said?
                hints = {word: f"For {word}: {hint[0].lower()}{hint[1:]}" for word, hint in hints.items()}
            hint = f". {' '.join(hints.values())}" if hints else ""
            found.parser.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return found

    def parse_known_args(self, args=None, namespace=None):
        """As argparse does it, but choices that begin with a hyphen are values as well, as in ``--up -z``."""
        args = list(sys.argv[1:] if args is None else args)
        end = args.index("--") if "--" in args else len(args)
        for k in range(end - 1, 0, -1):
            action = self._option_string_actions.get(args[k - 1])
            if args[k].startswith("-") and action is not None and args[k] in (action.choices or ()):
                args[k - 1 : k + 1] = [f"{args[k - 1]}={args[k]}"]
        return super().parse_known_args(args, namespace)

    def _check_value(self, action, value):
        """As argparse does it, with a hint."""
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            if hint := getattr(action, "refusals", {}).get(value) or did_you_mean(value, action.choices):
                error.message += f". {hint.rstrip('.')}"
            raise

    def error(self, message):
        """Print one line, and exit with code 2."""
        self.exit(2, f"lbsfit: error: {message} (see: {self.prog} --help)\n")


class _Help(argparse.RawDescriptionHelpFormatter):
    def _split_lines(self, text, width):
        """Lines that end at blanks, not at the hyphens of names; lists that are longer than a line, after their commas."""
        words = [word if len(word) <= width else word.replace(",", ",\0 ") for word in text.split()]
        lines = textwrap.wrap(" ".join(words), width, break_on_hyphens=False)
        return [line.replace("\0 ", "").replace("\0", "") for line in lines]


def formatter(prog):
    """Help with line breaks of descriptions and examples kept."""
    return _Help(prog, max_help_position=32, width=110)


def positive(text):
    """A whole number of at least 1, from text."""
    return _whole(text, 1)


def natural(text):
    """A whole number of at least 0, from text."""
    return _whole(text, 0)


def amount(text):
    """A finite number of at least 0, from text."""
    return _number(text, math.inf)


def share(text):
    """A number from 0 to 0.9, from text."""
    return _number(text, _LARGEST_SHARE)


def _number(text, most):
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (0 <= value <= most and math.isfinite(value)):
        bounds = "of at least 0" if most == math.inf else f"from 0 to {most:g}"
        raise _OutOfRange(text, f"a number {bounds}")
    return value


def _whole(text, least):
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if value < least:
        raise _OutOfRange(text, f"a whole number of at least {least}")
    if value > _LARGEST:
        raise _OutOfRange(text, f"a whole number of at most {_LARGEST}")
    return value


class _OutOfRange(argparse.ArgumentTypeError):
    """A number that cannot be; ``expected`` says what could, for those who call what came by another name."""

    def __init__(self, text, expected):
        self.expected = expected
        super().__init__(f"got {brief(text)}; expected {expected}")


@dataclass(frozen=True)
class Option:
    """An option of the command line and of the configuration file.

    Attributes
    ----------
    name : str
        Without dashes, such as "drop-invalid".
    help : str
    kind : callable (str) → value, or bool
        bool makes a switch with a ``--no-`` form.
    default : object
    metavar : str
    choices : tuple of str
    flag : str or None
        A short form, such as "-o".
    is_path : bool
        In a configuration file it is relative to the file's folder.
    table : bool
        NAME=VALUE, as often as wanted, a number, or true or false; in a configuration file a table.
    check : callable (value), optional
        Raises InputError where a configuration file's value cannot be used, which is then said to be the file's.
    refusals : dict
        What to say of values that are no choices here, though somebody may well expect them; of a table, of its names that
        are no options by themselves.
    parameter : str or None
        What it is called in Python, where that is another name: errors then name the option.
    """

    name: str
    help: str
    kind: object = str
    default: object = None
    metavar: str | None = None
    choices: tuple = ()
    flag: str | None = None
    is_path: bool = False
    table: bool = False
    check: object = None
    refusals: dict = field(default_factory=dict)
    parameter: str | None = None

    @property
    def key(self):
        """The name with underscores, as in the settings."""
        return self.name.replace("-", "_")


def add_options(parser, options):
    """Add options to a parser; those that are not given leave no trace in the namespace, see :func:`settings`.

    The namespace gets ``flags``, what the user writes for each option, by its key and by its parameter.
    """
    flags = {name: o.flag or f"--{o.name}" for o in options for name in (o.key, o.parameter) if name}
    parser.set_defaults(flags=(parser.get_default("flags") or {}) | flags)
    for option in options:
        names = [*([option.flag] if option.flag else []), f"--{option.name}"]
        keywords = {"default": argparse.SUPPRESS, "dest": option.key, "help": _help(option)}
        if option.kind is bool:
            keywords["action"] = argparse.BooleanOptionalAction
        elif option.choices:
            keywords |= {"choices": option.choices}
        else:
            keywords |= {"type": option.kind, "metavar": option.metavar}
        if option.table:
            keywords |= {"type": _pair, "action": "append"}
        parser.add_argument(*names, **keywords).refusals = option.refusals


def settings(arguments, options, config=None):
    """The value of every option: the command line's, else the configuration file's, else the default.

    Parameters
    ----------
    arguments : argparse.Namespace
    options : sequence of Option
    config : str, optional
        Path of a TOML file.

    Returns
    -------
    dict of str to value
        By option name with underscores.

    Raises
    ------
    FileError
        The file is missing or no TOML, has unknown keys, or values of the wrong kind.
    InputError
        A text is empty.
    """
    return {o.key: o.default for o in options} | chosen(arguments, options, config)


def chosen(arguments, options, config=None):
    """As :func:`settings`, but only the options that the command line or the configuration file gives."""
    given = {o.key: getattr(arguments, o.key) for o in options if hasattr(arguments, o.key)}
    for option in options:
        if option.table and option.key in given:
            given[option.key] = dict(given[option.key])
        if option.kind is str and not option.table and given.get(option.key) == "":
            flags = "/".join([*([option.flag] if option.flag else []), f"--{option.name}"])
            raise InputError(flags, "an empty text", f"{option.metavar} ({option.help})")
    from_file = {} if config is None else _read_config(config, options)
    return from_file | given


def _help(option):
    if option.kind is bool:
        return option.help + f" (default: {'yes' if option.default else 'no'})"
    if option.default is None or option.table:
        return option.help
    return option.help + f" (default: {option.default})"


def _pair(text):
    name, equals, value = text.partition("=")
    if (word := value.strip().lower()) in ("true", "false"):
        return name.strip().replace("-", "_"), word == "true"
    for kind in (int, float):
        try:
            number = kind(value)
            if _is_finite(number):
                return name.strip().replace("-", "_"), number
        except ValueError:
            continue
    kind = ", VALUE a number, true or false" if equals else ""
    raise argparse.ArgumentTypeError(f"got {brief(text)}; expected NAME=VALUE{kind}, such as turn=3.14 or one_sided=true")


def _is_finite(number):
    try:
        return math.isfinite(number)
    except OverflowError:  # a whole number beyond double precision
        return False


def _read_config(path, options):
    expected = "a configuration file: TOML with the options of this command"
    try:
        content = tomllib.loads(Path(path).read_bytes().decode("utf-8-sig"))
    except FileNotFoundError:
        raise FileError(str(path), "no such file", expected) from None
    except OSError as error:
        raise FileError(str(path), f"a file that cannot be read ({error.strerror})", expected) from None
    except (ValueError, RecursionError) as error:  # ValueError: of TOML, of UTF-8, of numbers of thousands of digits, of NUL
        raise FileError(str(path), f"text that is not TOML ({error})", expected) from None
    known = {o.name: o for o in options} | {o.key: o for o in options}
    out = {}
    for key, value in content.items():
        if key not in known:
            names = ", ".join(o.name for o in options)
            remedy = _in_a_table(key, value, options) or did_you_mean(key, known)
            raise FileError(str(path), f"the unknown option {key!r}", f"one of {names}", remedy)
        option = known[key]
        if option.key in out:
            raise FileError(str(path), f"the option {option.name!r} twice", "each option once")
        out[option.key] = _checked(value, option, path)
    return out


def _in_a_table(key, value, options):
    """What to say of what is no option, but could stand in a table that is one; None of all else."""
    name = key.replace("-", "_")
    for option in options:
        if option.table and option.check is not None:
            with suppress(InputError):
                option.check({name: value})
                words = str(value).lower() if isinstance(value, bool) else f"{value}"
                hint = f"It belongs in {option.name}: {option.name} = {{ {name} = {words} }}."
                return " ".join(filter(None, [option.refusals.get(name), hint]))
    return None


def _checked(value, option, path):
    """A configuration file's value, held to what the command line would take."""
    if option.kind is bool:
        if isinstance(value, bool):
            return value
        raise FileError(str(path), f"{option.name} = {brief(value)}", "true or false")
    if option.table:
        if isinstance(value, dict) and all(type(v) in (bool, int, float) and _is_finite(v) for v in value.values()):
            table = {name.replace("-", "_"): v for name, v in value.items()}
            if option.check is not None:
                try:
                    option.check(table)
                except InputError as error:
                    raise FileError(str(path), f"{option.name}: {error.got}", error.expected, error.remedy) from None
            return table
        expected = "a table of numbers, true or false, such as { turn = 3.14 }"
        raise FileError(str(path), f"{option.name} = {brief(value)}", expected)
    if option.choices:
        if value in option.choices:
            return value
        expected = " or ".join(map(repr, option.choices))
        refusal = option.refusals.get(value) if isinstance(value, str) else None
        remedy = refusal or did_you_mean(value, option.choices)
        raise FileError(str(path), f"{option.name} = {brief(value)}", expected, remedy)
    if option.kind is str:
        if not isinstance(value, str) or not value:
            raise FileError(str(path), f"{option.name} = {brief(value)}", "text in quotes" + " that is not empty" * (value == ""))
        if not option.is_path or value == "none":
            return value
        return str(Path(path).parent / (os.path.expanduser(value) if value.startswith("~/") else value))  # no shell does it here
    whole = option.kind in (natural, positive)
    if type(value) not in ((int,) if whole else (int, float)) or not _is_finite(value):
        raise FileError(str(path), f"{option.name} = {brief(value)}", "a whole number" if whole else "a number")
    try:
        return option.kind(str(value))
    except _OutOfRange as error:
        raise FileError(str(path), f"{option.name} = {brief(value)}", error.expected) from None
