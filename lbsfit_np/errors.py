"""The errors that users see: each says what was wrong, what came, what was expected, and what to do."""

import inspect
import warnings
from difflib import get_close_matches

import numpy as np

__all__ = [
    "FileError",
    "InputError",
    "LbsfitError",
    "MissingExtraError",
    "ONE_AT_A_TIME",
    "ToldError",
    "Unforeseen",
    "as_array",
    "as_floats",
    "brief",
    "check_angles",
    "check_array",
    "check_callables",
    "check_real",
    "check_unmasked",
    "counted",
    "did_you_mean",
    "from_digits",
    "in_words",
    "is_whole",
    "its_array",
    "likeliest",
    "listed",
    "not_finite",
    "own_words",
]


# What to do with a batch where one is asked for.
ONE_AT_A_TIME = "Pass one at a time: loop over the first axis."
# Radians. Of larger angles rounding is more than other errors are.
_MOST_ANGLE = 1e6
# Eight turns.
_ODD_ANGLE = 50.0


class LbsfitError(Exception):
    """Base class of every error that this package raises on purpose.

    Notes (``add_note``) travel with it from one process to another.
    """

    def _notes(self):
        """What is left to set where it is made again."""
        return {"__notes__": self.__notes__} if hasattr(self, "__notes__") else None


class InputError(LbsfitError, ValueError):
    """An argument that cannot be used.

    Parameters
    ----------
    argument : str
        Name of the argument, field or option.
    got : str
        What was given, in words.
    expected : str
        What would have been right.
    remedy : str, optional
        What to do about it.
    """

    def __init__(self, argument, got, expected, remedy=None):
        self.argument, self.got, self.expected, self.remedy = argument, got, expected, remedy
        super().__init__(f"{argument}: got {got}; expected {expected}." + (f" {remedy}" if remedy else ""))

    def __reduce__(self):
        return type(self), (self.argument, self.got, self.expected, self.remedy), self._notes()


class FileError(InputError):
    """A file that is missing, of an unknown kind, broken, or unsafe to read.

    ``argument`` is the path as the user gave it.
    """


class MissingExtraError(LbsfitError, ImportError):
    """An optional dependency that is not installed; names the extra that brings it.

    Parameters
    ----------
    module : str
        What is missing.
    extra : str
        The extra of setup.cfg that brings it.
    what : str
        What needs the module; the message starts with it.
    """

    def __init__(self, module, extra, what):
        self.module, self.extra, self.what = module, extra, what
        super().__init__(f"{what} needs {module}, which is not installed; run: python -m pip install 'lbsfit_np[{extra}]'")

    def __reduce__(self):
        return type(self), (self.module, self.extra, self.what), self._notes()


def check_array(argument, value, shape, what="", *, finite=True):
    """``value`` as a float array of a given shape, or an InputError that names ``argument``; ``what`` its rows are.

    ``finite``: whether all of its numbers have to be.
    """
    a = as_floats(argument, value, f"an array of numbers of shape {shape}")
    if a.shape != tuple(shape):
        remedy = ONE_AT_A_TIME if a.shape[1:] == tuple(shape) else None
        raise InputError(argument, f"shape {a.shape}", f"shape {tuple(shape)}{what and f', {what}'}", remedy)
    if finite and not np.isfinite(a).all():
        raise InputError(argument, not_finite(int((~np.isfinite(a)).sum())), "finite numbers")
    return a


def check_angles(argument, value, shape):
    """``check_array`` of rotation vectors in radians, none of so many turns that no digit tells where they end.

    Of more turns than a body makes, as degrees would be, it warns.
    """
    a = check_array(argument, value, shape)
    most = np.abs(a).max() if a.size else 0.0
    if most > _MOST_ANGLE:
        raise InputError(argument, f"an angle of {most:.3g}", f"radians, of at most {_MOST_ANGLE:.0e}")
    if most > _ODD_ANGLE:
        words = f"{argument}: got an angle of {most:.3g} rad, which is {most / (2 * np.pi):.0f} turns. Are these degrees?"
        warnings.warn(words, stacklevel=4)
    return a


def check_callables(**given):
    """Raise InputError unless each is None or can be called as it will be: late, when much would be lost.

    Parameters
    ----------
    **given : (callable or None, tuple of tuples of str)
        By its name, and the arguments that it is called with, in each way that it is.
    """
    for name, (value, ways) in given.items():
        if value is not None and not callable(value):
            raise InputError(name, brief(value), "a function, or None")
        for arguments in ways if value is not None else ():
            try:  # a decorator may add arguments to those of what it wraps
                known = inspect.signature(value, follow_wrapped=False)
            except (TypeError, ValueError):  # a function that does not tell, such as an extension's
                continue
            try:
                known.bind(*arguments)
            except TypeError as error:
                expected = f"a function that can be called as {name}({', '.join(arguments)})"
                raise InputError(name, f"one that takes other arguments ({error})", expected) from None


def as_floats(argument, value, expected, remedy=None):
    """``value`` as an array of double precision, the input itself where it is one, or an InputError where it holds no numbers."""
    check_unmasked(argument, value)
    check_real(argument, value, expected)
    try:
        return np.asarray(value, dtype=float)
    except OverflowError:
        raise InputError(argument, "whole numbers beyond double precision", expected) from None
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(argument, type(value).__name__, expected, own_words(value, error) or remedy) from None


def its_array(value, names=("points", "vertices")):
    """Where an object, such as a result, a scan or a mesh, has the points that it was taken for, in words; else None."""
    names = [name for name in names if getattr(getattr(value, name, None), "ndim", 0) == 2]
    return f"Pass its {names[0]}: .{names[0]}" if names else None


def own_words(value, error):
    """What an object that has an array to give, such as a tensor on a graphics card, says of how to come by it; else None."""
    return str(error) if hasattr(value, "__array__") and not isinstance(value, np.ndarray) else None


def as_array(argument, value, expected):
    """``value`` as an array of whatever it holds, or an InputError where its rows make none."""
    try:
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:
        words = own_words(value, error)
        raise InputError(argument, type(value).__name__ if words else "rows of different lengths", expected, words) from None


def check_real(argument, value, expected):
    """Raise InputError where an array holds complex numbers: half of each would be lost without a word."""
    if getattr(getattr(value, "dtype", None), "kind", "") == "c":
        raise InputError(argument, "complex numbers", expected)


def is_whole(value, least=None):
    """Whether a value is a whole number, Python's or NumPy's, and at least so large; True and False are none."""
    number = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return number and (least is None or value >= least)


def from_digits(text):
    """The whole number that a text of digits is; None where it is none, or has the thousands of digits that ``int`` refuses."""
    try:
        return int(text) if text.isdecimal() else None
    except ValueError:
        return None


def check_unmasked(argument, value, *, rows="rows", remedy="Leave masked entries out, or fill them with numpy.ma.filled."):
    """Raise InputError where a masked array, or a list with rows of one, has masked entries: plain arrays know of no mask.

    ``rows``, ``remedy``: what the error calls the rows of ``value``, and what it says to do.
    """
    if isinstance(value, np.ma.MaskedArray):
        what, mask = "a masked array", np.atleast_1d(np.ma.getmaskarray(value))
        masked = mask.any(axis=tuple(range(1, mask.ndim)))
    elif isinstance(value, (list, tuple)):
        what, masked = f"a {type(value).__name__}", [isinstance(row, np.ma.MaskedArray) and np.ma.is_masked(row) for row in value]
    else:
        return
    if count := int(np.sum(masked)):
        raise InputError(argument, f"{what} with {count} of {len(masked)} {rows} masked", f"{rows} without a mask", remedy)


def counted(n, what):
    """So many of something: "1 scan", "2 scans"."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def not_finite(n, what="value"):
    """In words, that so many of something are NaN or infinite."""
    return f"{counted(n, what)} that {'is' if n == 1 else 'are'} NaN or infinite"


def listed(names, most=8):
    """Names in one line for a message, cut after ``most``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class ToldError(RuntimeError):
    """In place of an error that cannot be sent to another process: what :func:`in_words` says of that, and of this one."""


class Unforeseen(str):
    """Words for a failure that nobody foresaw, as of memory or of a process: what failed may not fail again."""

    __slots__ = ()


def in_words(error):
    """What went wrong, without a traceback: our own errors say it, others by their kind, too, and as :class:`Unforeseen`."""
    if isinstance(error, LbsfitError):
        return str(error)
    if isinstance(error, ToldError):
        return Unforeseen(error)
    return Unforeseen(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)


def brief(value, most=100):
    """``repr`` of a value for a message, cut after ``most`` characters; whole numbers may have too many digits for ``repr``."""
    try:
        text = repr(value)
    except ValueError:
        return "a number of several thousand digits"
    return text if len(text) <= most else f"{text[:most]}…"


# A beginning of so many letters says which name was meant.
_BEGINNING = 3
# Names of so few letters are like others only but for case.
_SHORT = 2


def likeliest(name, names):
    """The question whether one of some names was meant, of up to four that are like it or have it in them; else None."""
    lowered = {n.lower(): n for n in reversed(names)}
    close = [lowered[n] for n in get_close_matches(name.lower(), list(lowered), n=4, cutoff=0.5)]
    if not close and name:
        close = [n for n in names if name.lower() in n.lower() or n.lower() in name.lower()][:4]
    return f"Did you mean {' or '.join(map(repr, close))}?" if close else None


def did_you_mean(given, names):
    """The question whether one of some names was meant that is like what was given, or the only one that begins so; else None.

    None, too, where what was given is written like one of them: then its spelling is not what was wrong.
    """
    given, names = given if isinstance(given, str) else brief(given), [str(name) for name in names]
    if given in names:
        return None
    bare = {name.lstrip("+-").casefold(): name for name in reversed(names)}  # signs and hyphens are no likeness
    alike = [name for name in names if name.casefold() == given.casefold()]
    bare_given = given.lstrip("+-").casefold()
    long = [name for name in bare if len(name) > _SHORT or name == bare_given]  # "km" is no misspelt "m"
    alike += [bare[name] for name in get_close_matches(bare_given, long, n=1)]
    begun = [bare[name] for name in bare if name.startswith(bare_given)]
    alike += begun if len(begun) == 1 and len(bare_given) >= _BEGINNING else []
    return f"Did you mean {alike[0]!r}?" if alike else None
