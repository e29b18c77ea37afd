"""What learning has done so far, kept in a folder step by step, so that a run that was stopped goes on to the same end.

Each step is a file that is named after a digest of all that its answer depends on: other scans, other settings or another state
of the code find nothing, and what still suits them, such as the first fits of the same scans in a larger collection, is found.
"""

import hashlib
import json
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError, in_words
from ..fitting.result import FitResult
from ..optimize.frame import Frame
from ..optimize.state import State
from ..starts.clean import TakingPart
from ..workers import each

__all__ = [
    "Checkpoint",
    "FIRST_FIT",
    "NO_CHECKPOINT",
    "as_checkpoint",
    "checkpoint_of",
    "digest_of",
    "each_kept",
    "kept_by_its_process",
    "remove_checkpoint",
    "state_of_the_code",
    "steps_in",
]

# The step of one scan's fit by itself.
FIRST_FIT = "first-fit"
# Records that answers are made of.
_RECORDS = {kind.__name__: kind for kind in (Frame, State, FitResult, TakingPart)}
# Files that a checkpoint writes, and those that it was writing when a process was killed.
_OURS = re.compile(rf"({FIRST_FIT}|round-\d+-\w+|result|free-form)-[0-9a-f]{{32}}\.npz|\..*\.tmp\.npz")


class Checkpoint:
    """The steps of one run.

    Parameters
    ----------
    folder : path-like or None
        Created with the first step that is kept; with None, no step is kept.
    made_of : object, optional
        Whatever all steps depend on, besides the package and the libraries that it computes with: numbers, text and arrays, and
        sparse matrices, tuples, lists, mappings and dataclasses of these.
    first_fits : path-like or None, optional
        Another folder for the fits of scans by themselves, which runs of several variants may share.

    Raises
    ------
    InputError
        ``folder`` is a file, is not a path, or lies where nothing can be written.
    """

    def __init__(self, folder, made_of=(), *, first_fits=None):
        self._folder = None if folder is None else _checked(folder)
        self._first_fits = self._folder if first_fits is None else _checked(first_fits)
        self._key = "" if folder is None else digest_of(state_of_the_code(), made_of)
        self._trouble = []  # shared by all that are narrowed from this one, to be told once

    def narrowed(self, made_of):
        """A checkpoint whose steps depend on more."""
        out = Checkpoint.__new__(Checkpoint)
        out._folder, out._first_fits, out._trouble = self._folder, self._first_fits, self._trouble
        out._key = "" if self._folder is None else digest_of(self._key, made_of)
        return out

    def slot(self, step, made_of=()):
        """Where the answer of a step is kept that depends on this, too."""
        if self._folder is None:
            return _Slot(None, self._trouble)
        folder = self._first_fits if step == FIRST_FIT else self._folder
        return _Slot(folder / f"{step}-{digest_of(self._key, step, made_of)[:32]}.npz", self._trouble)


def _checked(folder):
    """The folder of a checkpoint as a Path, once it is known that files can be made there."""
    from ..io.write import check_folder

    try:
        path = Path(folder)
    except TypeError:
        raise InputError("checkpoint", f"a {type(folder).__name__}", "the path of a folder, or None") from None
    if not str(folder):
        raise InputError("checkpoint", "an empty path", "the path of a folder, or None")
    try:
        check_folder(path)  # it is made with the first step
    except FileError as error:
        raise InputError("checkpoint", f"{error.argument}, {error.got}", error.expected, "Choose another folder.") from None
    return path


NO_CHECKPOINT = Checkpoint(None)


def as_checkpoint(given):
    """A Checkpoint as it is; of a folder's path, or None, the one that keeps steps there, or none."""
    return given if isinstance(given, Checkpoint) else Checkpoint(given)


class _Slot:
    """The place of one answer."""

    def __init__(self, path, trouble):
        self._path, self._trouble = path, trouble

    def known(self, kind=None):
        """The answer that is kept here, or None; of a ``kind`` that loads itself, where it is one of that."""
        if self._path is None:
            return None
        try:
            return _read(self._path) if kind is None else kind.load(self._path)
        except FileError:  # not there, or cut short by another program
            return None

    def keep(self, answer):
        """Keep an answer, in a file of its own kind where it can save itself so; returns it."""
        if self._path is None or self._trouble:
            return answer
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            answer.save(self._path) if hasattr(answer, "save") else _write(self._path, answer)
        except (OSError, FileError) as error:
            why = error.got if isinstance(error, FileError) else error.strerror or in_words(error)
            self._trouble.append(why)
            with suppress(OSError):  # where other steps are in it
                self._path.parent.rmdir()
            words = f"finished steps cannot be kept in {self._path.parent} ({why}): an interrupted run will repeat them"
            warnings.warn(words, stacklevel=2)
        return answer


def each_kept(work, tasks, slots, *, jobs, done, keep=lambda answer: True, failed=None):
    """``workers.each``, but for tasks whose answers are kept already; of the others those are kept that ``keep`` says.

    ``done`` is called before the first as well.
    """
    n, known = len(tasks), {k: answer for k, slot in enumerate(slots) if (answer := slot.known()) is not None}
    left, at, done = [k for k in range(n) if k not in known], len(known), done or (lambda share: None)
    if n:  # the first answer may take a while
        done(at / n)

    def answered(i, answer):
        if slots and keep(answer):
            slots[left[i]].keep(answer)

    share = (lambda p: done((at + p * len(left)) / n)) if known else done
    found = each(work, [tasks[k] for k in left], jobs=jobs, done=share, answered=answered, failed=failed)
    known.update(zip(left, found, strict=True))
    return [known[k] for k in range(n)]


def checkpoint_of(model):
    """The folder beside a model's file where commands keep what is done until the model is complete."""
    model = Path(model)
    return model.with_name(f"{model.name}.unfinished")


def steps_in(folder):
    """How many steps are kept in a folder."""
    try:
        names = [path.name for path in Path(folder).iterdir()]
    except OSError:
        return 0
    return sum(bool(_OURS.fullmatch(name)) and name[0] != "." for name in names)


def remove_checkpoint(folder):
    """Remove what a checkpoint has written, and the folder where nothing else is in it; what cannot be removed stays."""
    folder = Path(folder)
    with suppress(OSError):  # another run may be removing the same
        for path in folder.iterdir():
            if _OURS.fullmatch(path.name):
                with suppress(OSError):
                    path.unlink()
        folder.rmdir()


@cache
def state_of_the_code():
    """Digest of the package and of the libraries whose numbers hang on their versions."""
    from importlib.metadata import version

    h = hashlib.sha256(repr([version(name) for name in ("numpy", "scipy", "scikit-learn")]).encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        h.update(path.read_bytes())
    return h.hexdigest()


def digest_of(*parts):
    """Hex digest of values: arrays, text, numbers, dataclasses, and lists and dicts of these."""
    h = hashlib.sha256()
    _add(h, parts)
    return h.hexdigest()


def _add(h, value):
    value = value.item() if isinstance(value, np.generic) else value  # the same number, the same digest
    if isinstance(value, np.ndarray):
        h.update(f"array {value.dtype.str} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
        _add(h, sorted(value.items()))
    elif hasattr(value, "tocoo"):  # a sparse matrix
        rows = value.tocoo()
        _add(h, (value.shape, rows.row, rows.col, rows.data))
    elif isinstance(value, (tuple, list)):
        h.update(f"{len(value)} of".encode())
        for v in value:
            _add(h, v)
    elif is_dataclass(value):
        _add(h, [type(value).__name__, *((f.name, getattr(value, f.name)) for f in fields(value))])
    else:
        h.update(f"{type(value).__name__} {value!r}\0".encode())


def _write(path, value):
    from ..io.write import write_npz

    arrays = {}
    text = json.dumps(_plain(value, arrays))
    write_npz(path, value=np.array(text), **arrays)


def _read(path):
    from ..io.npz import read_npz

    arrays = read_npz(path)
    try:
        return _value(json.loads(str(arrays["value"])), arrays)
    except (KeyError, ValueError, TypeError) as error:
        raise FileError(str(path), f"content that does not fit ({error})", "a step of learning") from None


def _plain(value, arrays):
    """A value in JSON's terms; its arrays go into ``arrays``, by names. Whole and exact: floats are written as Python's repr."""
    if isinstance(value, (np.ndarray, np.generic)):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {"array": name, "scalar": isinstance(value, np.generic)}
    if isinstance(value, (tuple, list, dict)):
        items = list(value.items()) if isinstance(value, dict) else value
        return {type(value).__name__: [_plain(v, arrays) for v in items]}
    if is_dataclass(value):
        return {"record": type(value).__name__, "fields": {f.name: _plain(getattr(value, f.name), arrays) for f in fields(value)}}
    return value


def _value(plain, arrays):
    if not isinstance(plain, dict):
        return plain
    if "array" in plain:
        found = arrays[plain["array"]]
        return found[()] if plain["scalar"] else found
    if "record" in plain:
        return _RECORDS[plain["record"]](**{name: _value(v, arrays) for name, v in plain["fields"].items()})
    ((kind, items),) = plain.items()
    return {"tuple": tuple, "list": list, "dict": dict}[kind](_value(v, arrays) for v in items)


def kept_by_its_process(slot, make):
    """What is made, kept as soon as it is there, by the process that makes it, which cannot warn where it is not."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return slot.keep(make())
