"""The rig card: a small TOML file beside a rig that says what the rig's format cannot.

Every table is optional; names may be globs (``*``, ``?``, ``[ab]``) wherever a table speaks of several joints.

    [rig]
    unit = "m"                    # m, cm, mm, in, ft, or the number of metres in one unit
    up = "+y"
    forward = "+z"
    use_parts = "fingers"         # the partition in use; "joints" (one part per moving joint) if not said

    [hierarchy]
    root = "wrist"
    chains = [["wrist", "thumb-base", "thumb-tip"], ["wrist", "index-base", "index-tip"]]   # each hangs on the one before
    parents = { "prop-*" = "wrist" }                                                         # child = parent

    [merge]
    into_parent = ["*-tip"]       # give their weights to the nearest joint above that is not merged

    [lock]
    joints = ["eye-*"]            # keep their weights, never turn

    [frames]
    "*" = "bone"                  # axes that angles turn about: "bone" (y along the bone) or "rig" (the rig's axes)

    [limits]                      # [lower x, y, z], [upper x, y, z]; later lines override earlier ones
    unit = "rad"                  # or "deg"
    "*" = [[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]]

    [parts.fingers]               # a partition: part = joints; joints not named belong to the part above them
    palm = ["wrist"]
    thumb = ["thumb-*"]
"""

import errno
import json
import math
import os
import secrets
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError, brief, did_you_mean, likeliest, listed
from .frames import AXES
from .units import METRES

__all__ = ["Card", "card_text", "matching", "read_card", "write_card"]

_TABLES = {
    "rig": ("unit", "up", "forward", "use_parts"),
    "hierarchy": ("root", "chains", "parents"),
    "merge": ("into_parent",),
    "lock": ("joints",),
    "frames": None,  # keys are joints
    "limits": None,
    "parts": None,
}
_FRAME_KINDS = ("bone", "rig")


@dataclass(frozen=True)
class Card:
    """What a rig card says. Names are as written: ``build_rig`` looks them up in the rig."""

    metres_per_unit: float | None = None
    up: str | None = None
    forward: str | None = None
    use_parts: str | None = None
    root: str | None = None
    chains: tuple[tuple[str, ...], ...] = ()
    parents: tuple[tuple[str, str], ...] = ()  # (child or glob, parent)
    merge: tuple[str, ...] = ()
    lock: tuple[str, ...] = ()
    frames: tuple[tuple[str, str], ...] = ()  # (joint or glob, "bone" or "rig")
    limits: tuple[tuple[str, tuple, tuple], ...] = ()  # (joint or glob, lower (3,), upper (3,)) in radians
    partitions: Mapping[str, Mapping[str, tuple[str, ...]]] = field(default_factory=dict)
    path: str | None = None  # where it was read, for messages

    @property
    def where(self):
        """What errors call it."""
        return "card" if self.path is None else f"card {self.path}"


def read_card(path):
    """Read a rig card.

    Parameters
    ----------
    path : path-like
        A TOML file; the module's docstring shows its tables.

    Returns
    -------
    Card

    Raises
    ------
    FileError
        The file is missing, not TOML (with the line), or has unknown tables, unknown keys or values of the wrong kind.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise FileError(str(path), "no such file", "a rig card", "Write one to edit with: lbsfit rig card RIG -o CARD") from None
    except OSError as e:
        raise FileError(str(path), f"a file that cannot be read ({e.strerror})", "a rig card") from None
    except UnicodeDecodeError:
        raise FileError(str(path), "bytes that are not UTF-8 text", "a rig card, which is a TOML text file") from None
    except ValueError:  # what open says of NUL in a name
        raise FileError(repr(str(path)), "a path that no file can have", "a rig card") from None
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise FileError(str(path), f"text that is not TOML: {e}", "a rig card in TOML", _toml_remedy(str(e))) from None
    except ValueError:  # what int says
        raise FileError(str(path), "a number of several thousand digits", "a rig card in TOML") from None
    except RecursionError:
        raise FileError(str(path), "brackets nested too deeply", "a rig card in TOML") from None
    return _Parser(str(path)).card(content)


def write_card(rig, path):
    """Write a card to edit for a rig (a Rig or a RigData), with comments that explain each table.

    The file is replaced in one step. Reading it back gives the rig's own settings.
    """
    path = Path(path)
    text = card_text(rig)
    if not path.name or os.path.isdir(path):
        raise FileError(str(path), "a folder", "the name of a card to write")
    try:
        content = text.encode("utf-8")
    except UnicodeEncodeError as e:
        got = f"{brief(text[max(e.start - 20, 0) : e.end + 20])} to write, in which a name has what UTF-8 cannot hold"
        raise FileError(str(path), got, "names of Unicode characters", "Rename the joint or part in the rig's file.") from None
    if os.path.exists(path) and not os.path.isfile(path):
        raise FileError(str(path), "a device", "the name of a card to write")
    scratch = None
    try:
        final = Path(os.path.realpath(path))  # a link stays, and what it leads to is written
        scratch = final.with_name(f".{secrets.token_hex(6)}.tmp")
        _write_to_disk(scratch, content)  # before it has the name, so that a power cut leaves the old card or the new one
        os.replace(scratch, final)
    except BaseException as e:  # Ctrl-C, too
        if scratch is not None:
            with suppress(OSError, ValueError):  # which would hide what has happened
                scratch.unlink(missing_ok=True)
        if not isinstance(e, (OSError, ValueError)):
            raise
        why = getattr(e, "strerror", None) or e
        raise FileError(str(path), f"a path that cannot be written to ({why})", "a path in an existing folder") from None


def _write_to_disk(path, content):
    with open(path, "xb") as file:
        file.write(content)
        file.flush()
        try:
            os.fsync(file.fileno())
        except OSError as e:
            if e.errno not in (errno.EINVAL, errno.ENOTSUP):  # what file systems say that cannot tell
                raise


def card_text(rig):
    """The text that :func:`write_card` writes."""
    from .card_text import card_text as text

    return text(rig)


def matching(pattern, names, where):
    """Rows of the joints that a name or glob means; one error with the nearest names where it means none.

    A pattern that is a joint's name to the letter means that joint, whatever ``*``, ``?`` or ``[`` it contains.
    """
    if pattern in names:
        return [names.index(pattern)]
    rows = [j for j, name in enumerate(names) if fnmatchcase(name, pattern)]
    if not rows:
        is_glob = any(c in pattern for c in "*?[")
        raise InputError(
            where,
            f"{pattern!r}, which {'matches no joint' if is_glob else 'is no joint'} of the rig",
            "names or globs of its joints",
            likeliest(pattern.strip("*"), names) or f"There are: {listed(names, 12)}.",
        )
    return rows


class _Parser:
    """Checks the kinds of all values, so that a Card holds nothing else; each error names the table and key."""

    def __init__(self, path):
        self.path = path

    def card(self, content):
        self.known(content, tuple(_TABLES), "at the top", "table")
        for table, keys in _TABLES.items():
            if table in content:
                if not isinstance(content[table], dict):
                    self.fail(f"{table} = {brief(content[table])}", f"a table, written [{table}]")
                if keys is not None:
                    self.known(content[table], keys, f"in [{table}]", "key")
        rig, hierarchy = content.get("rig", {}), content.get("hierarchy", {})
        return Card(
            metres_per_unit=self.unit(rig.get("unit")),
            up=self.axis(rig, "up"),
            forward=self.axis(rig, "forward"),
            use_parts=self.text(rig, "use_parts", "[rig]"),
            root=self.text(hierarchy, "root", "[hierarchy]"),
            chains=self.chains(hierarchy.get("chains", [])),
            parents=self.pairs(hierarchy.get("parents", {}), "[hierarchy] parents"),
            merge=self.names(content.get("merge", {}).get("into_parent", []), "[merge] into_parent"),
            lock=self.names(content.get("lock", {}).get("joints", []), "[lock] joints"),
            frames=self.frames(content.get("frames", {})),
            limits=self.limits(content.get("limits", {})),
            partitions=self.partitions(content.get("parts", {})),
            path=self.path,
        )

    def fail(self, got, expected, remedy=None):
        raise FileError(self.path, got, expected, remedy)

    def known(self, table, keys, where, kind):
        for key in table:
            if key not in keys:
                self.fail(f"an unknown {kind} {key!r} {where}", f"one of {', '.join(keys)}", did_you_mean(key, keys))

    def text(self, table, key, where):
        value = table.get(key)
        if value is not None and not isinstance(value, str):
            self.fail(f"{where} {key} = {brief(value)}", "text in quotes")
        return value

    def unit(self, value):
        if value is None:
            return None
        if isinstance(value, str) and value in METRES:
            return METRES[value]
        if _is_finite(value) and value > 0:
            return float(value)
        names = ", ".join(map(repr, METRES))
        self.fail(f"[rig] unit = {brief(value)}", f"one of {names}, or the number of metres in one unit, above 0")

    def axis(self, rig, key):
        value = rig.get(key)
        if value is not None and (not isinstance(value, str) or value not in AXES):
            self.fail(f"[rig] {key} = {brief(value)}", f"one of {', '.join(map(repr, AXES))}")
        return value

    def names(self, value, where):
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            self.fail(f"{where} = {brief(value)}", 'a list of joint names or globs, such as ["*-tip"]')
        return tuple(value)

    def chains(self, value):
        if not isinstance(value, list) or not all(isinstance(chain, list) and len(chain) > 1 for chain in value):
            self.fail(
                f"[hierarchy] chains = {brief(value)}",
                'a list of chains of at least two joints, such as [["wrist", "thumb-base"]]',
            )
        return tuple(self.names(chain, "a chain in [hierarchy]") for chain in value)

    def pairs(self, value, where):
        if not isinstance(value, dict) or not all(isinstance(v, str) for v in value.values()):
            remedy = next(filter(None, map(_unquoted, value, value.values())), None) if isinstance(value, dict) else None
            self.fail(f"{where} = {brief(value)}", 'a table of child = parent, such as { "thumb-base" = "wrist" }', remedy)
        return tuple(value.items())

    def frames(self, value):
        for name, kind in value.items():
            if not isinstance(kind, str) or kind not in _FRAME_KINDS:
                self.fail(f"[frames] {name!r} = {brief(kind)}", " or ".join(map(repr, _FRAME_KINDS)), _unquoted(name, kind))
        return tuple(value.items())

    def limits(self, value):
        unit = value.get("unit", "rad")
        if unit not in ("rad", "deg"):
            self.fail(f"[limits] unit = {brief(unit)}", "'rad' or 'deg'")
        factor = 1.0 if unit == "rad" else math.pi / 180.0
        out = []
        for name, pair in value.items():
            if name == "unit":
                continue
            where = f"[limits] {name!r} = {brief(pair)}"
            ok = isinstance(pair, list) and len(pair) == 2 and all(isinstance(t, list) and len(t) == 3 for t in pair)
            if not ok or not all(_is_finite(a) for t in pair for a in t):
                self.fail(where, "[[lower x, y, z], [upper x, y, z]], six finite numbers", _unquoted(name, pair))
            lower, upper = np.array(pair, dtype=float)
            for axis, low, high in zip("xyz", lower, upper):
                if low > high:
                    self.fail(
                        f"{where}, reversed about {axis}", "lower limits that are not above the upper ones", "Swap the two."
                    )
            lower, upper = lower * factor, upper * factor
            if max(np.abs(lower).max(), np.abs(upper).max()) > 2 * math.pi:
                degrees = 'Write unit = "deg" in [limits] if these are degrees.' if unit == "rad" else None
                self.fail(where, f"angles of at most one turn{'' if degrees else ', 360'}", degrees)
            out.append((name, tuple(lower.tolist()), tuple(upper.tolist())))
        return tuple(out)

    def partitions(self, value):
        out = {}
        for name, parts in value.items():
            if name == "joints":
                self.fail("[parts.joints]", 'another name: "joints" always means one part per moving joint')
            if not isinstance(parts, dict) or not parts:
                self.fail(f"[parts] {name} = {brief(parts)}", f'a table [parts.{name}] with lines such as thumb = ["thumb-*"]')
            for part, members in parts.items():
                if remedy := _unquoted(part, members):
                    self.fail(f"[parts.{name}] {part} = {brief(members)}", "a list of joint names or globs", remedy)
            out[name] = {part: self.names(members, f"[parts.{name}] {part}") for part, members in parts.items()}
        return out


def _toml_remedy(words):
    """What to do about text that is not TOML, of which tomllib says ``words``; None where these say it."""
    if any(word in words for word in ("overwrite", "twice", "mutate", "Duplicate")):
        return "Keep one of the lines or tables of that name."
    return "Put joint names in quotes." if "key" in words or "Invalid" in words else None


def _unquoted(name, value):
    """What to do where a name was taken for a table because it holds a dot; None where it was not."""
    if not isinstance(value, dict) or not value:
        return None
    while isinstance(value, dict) and value:
        key, value = next(iter(value.items()))
        name += f".{key}"
    return f"A dot splits a name without quotes: write {json.dumps(name, ensure_ascii=False)}."


def _is_finite(value):
    """Whether a value is a number that double precision can hold; TOML's whole numbers may be larger."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False
