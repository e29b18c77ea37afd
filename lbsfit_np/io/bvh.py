"""BVH motion: a skeleton and its joint rotations over time, as rotation matrices."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import FileError, brief, from_digits

__all__ = ["Motion", "read_bvh"]

_CHANNELS = {f"{axis}{what}": (what, "xyz".index(axis)) for axis in "xyz" for what in ("position", "rotation")}


@dataclass(frozen=True, eq=False)
class Motion:
    """A skeleton in motion, in the file's own frame and unit (by custom: y up, facing +z).

    In the rest pose every joint has the identity rotation and stands at its parent's position plus its offset.

    Attributes
    ----------
    joint_names : tuple of str
        J names, in the order of the file: every parent before its children.
    parents : (J,) int array
        −1 for the root, which is row 0.
    offsets : (J, 3) array
        Each joint's rest position relative to its parent; the root's, relative to the origin.
    end_offsets : (J, 3) array
        Offset of the End Site relative to its joint; NaN for joints without one.
    channels : tuple of tuple of str
        Each joint's channels, such as ("Zrotation", "Yrotation", "Xrotation"), in their order.
    rotations : (T, J, 3, 3) array
        Rotations relative to the parent: local coordinates of a joint to those of its parent.
    translation : (T, 3) array
        Root position: its offset plus its position channels.
    frame_time : float
        Seconds from frame to frame.
    notes : tuple of str
        What was left out.
    """

    joint_names: tuple
    parents: np.ndarray
    offsets: np.ndarray
    end_offsets: np.ndarray
    channels: tuple
    rotations: np.ndarray
    translation: np.ndarray
    frame_time: float
    notes: tuple = ()


def read_bvh(path):
    """Read a BVH file.

    Rotations follow each joint's own order of channels: "Zrotation Yrotation Xrotation" means R = Rz Ry Rx, with x turned
    first. Position channels of joints other than the root are read past, and noted.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    Motion

    Raises
    ------
    FileError
        Missing or truncated file, unknown channel, second root, a number of frames or of values that differs from what the
        file announces; the message names the line.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig", errors="replace")
    except OSError as e:
        raise FileError(str(path), e.strerror or str(e), "a readable BVH file") from None
    lines = text.splitlines()
    words = _Words(path, lines)
    skeleton = _read_hierarchy(words)
    values, frame_time = _read_motion(words, lines, sum(map(len, skeleton.channels)))
    return _motion(skeleton, values, frame_time)


# ---- HIERARCHY ----


@dataclass
class _Skeleton:
    names: list = field(default_factory=list)
    parents: list = field(default_factory=list)
    offsets: list = field(default_factory=list)
    ends: list = field(default_factory=list)
    channels: list = field(default_factory=list)


def _read_hierarchy(words):
    words.expect("HIERARCHY")
    words.expect("ROOT")
    skeleton = _Skeleton()
    open_blocks = [_begin_joint(skeleton, words, -1)]
    while open_blocks:
        joint, word = open_blocks[-1], words.next("a joint's content or }").lower()
        if word == "offset":
            skeleton.offsets[joint] = words.numbers(3, "OFFSET")
        elif word == "channels":
            skeleton.channels[joint] = _read_channels(words)
        elif word == "joint":
            open_blocks.append(_begin_joint(skeleton, words, joint))
        elif word == "end":
            words.name()
            words.expect("OFFSET")
            skeleton.ends[joint] = words.numbers(3, "OFFSET")
            words.expect("}")
        elif word == "}":
            if skeleton.offsets[joint] is None:
                raise words.wrong(f"joint {skeleton.names[joint]} without an OFFSET", "OFFSET x y z")
            open_blocks.pop()
        else:
            raise words.wrong(repr(words.word), "OFFSET, CHANNELS, JOINT, End Site or }")
    return skeleton


def _begin_joint(skeleton, words, parent):
    name = words.name()
    if name in skeleton.names:
        raise words.wrong(f"a second joint {name!r}", "names that differ")
    skeleton.names.append(name)
    skeleton.parents.append(parent)
    skeleton.offsets.append(None)
    skeleton.ends.append([np.nan] * 3)
    skeleton.channels.append(())
    return len(skeleton.names) - 1


def _read_channels(words):
    said = words.next("the number of channels")
    count = from_digits(said)
    if count is None or count > 6:
        raise words.wrong(f"{brief(said)} channels", "a number from 0 to 6")
    channels = []
    for _ in range(count):
        channel = words.next("a channel")
        if channel.lower() not in _CHANNELS or channel.lower() in map(str.lower, channels):
            known = "Xposition Yposition Zposition Xrotation Yrotation Zrotation, each once"
            raise words.wrong(f"channel {channel!r}", known)
        channels.append(channel)
    return tuple(channels)


class _Words:
    """The words of the file one by one, with the line each stands on."""

    def __init__(self, path, lines):
        self.path, self.line, self.word = path, 0, ""
        self.words = ((number, word) for number, line in enumerate(lines, 1) for word in line.split())

    def wrong(self, got, expected, remedy=None):
        return FileError(str(self.path), f"{got} on line {self.line}", expected, remedy)

    def next(self, expected):
        try:
            self.line, self.word = next(self.words)
        except StopIteration:
            raise self.wrong("the end of the file", expected, "The file may be truncated.") from None
        return self.word

    def expect(self, word):
        if self.next(word).lower() != word.lower():
            remedy = "Is this a BVH file?" if word == "HIERARCHY" else None
            raise self.wrong(repr(self.word[:40]), word, remedy)

    def name(self):
        """All that stands before the opening brace: names may contain spaces."""
        parts = []
        while self.next("a name and {") != "{":
            if self.word.lower() in ("offset", "channels", "}"):
                raise self.wrong(repr(self.word), "{ after a joint's name")
            parts.append(self.word)
        return " ".join(parts)

    def numbers(self, count, what):
        return [self.number(what) for _ in range(count)]

    def number(self, what):
        try:
            value = float(self.next(f"a number after {what}"))
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise self.wrong(f"{self.word!r} after {what}", "a finite number")
        return value


# ---- MOTION ----


def _read_motion(words, lines, n_channels):
    """(T, n_channels) values and the frame time."""
    if words.next("MOTION").lower() == "root":
        raise words.wrong("a second ROOT", "one skeleton in a file", "Save each skeleton to its own file.")
    if words.word.lower() != "motion":
        raise words.wrong(repr(words.word), "MOTION")
    words.expect("Frames:")
    said = words.next("the number of frames")
    n_frames = from_digits(said)
    if n_frames is None:
        raise words.wrong(f"{brief(said)} frames", "a whole number")
    words.expect("Frame")
    words.expect("Time:")
    line, frame_time = words.line, words.number("Frame Time:")
    if words.line != line:  # or else the first frame would lose a number, and be blamed for it
        words.line = line
        raise words.wrong("nothing after Frame Time:", "seconds from frame to frame")
    if frame_time <= 0:
        raise words.wrong(f"a frame time of {frame_time:g}", "seconds from frame to frame, above 0")

    rows = [(number, line.split()) for number, line in enumerate(lines[words.line :], words.line + 1) if line.strip()]
    for words.line, row in rows:
        if len(row) != n_channels:
            remedy = "The file may be truncated." if words.line == rows[-1][0] else None
            raise words.wrong(f"{len(row)} values", f"{n_channels}, one for each channel of the hierarchy", remedy)
    if len(rows) != n_frames or not n_frames:
        expected = f"the {n_frames} that the line Frames: announces" if n_frames else "at least one frame"
        raise words.wrong(f"{len(rows)} frames, the last", expected, "The file may be truncated.")
    values = np.empty((n_frames, n_channels))
    for t, (words.line, row) in enumerate(rows):
        try:
            values[t] = row
        except ValueError:
            values[t] = np.nan
        if not np.isfinite(values[t]).all():
            raise words.wrong("values that are not finite numbers", "numbers")
    return values, frame_time


def _motion(skeleton, values, frame_time):
    T, J = len(values), len(skeleton.names)
    rotations = np.broadcast_to(np.eye(3), (T, J, 3, 3)).copy()
    offsets = np.array(skeleton.offsets, dtype=float)
    translation = np.tile(offsets[0], (T, 1))
    passed, column = [], 0
    for j, channels in enumerate(skeleton.channels):
        for channel in channels:
            what, axis = _CHANNELS[channel.lower()]
            if what == "rotation":
                rotations[:, j] = rotations[:, j] @ _axis_rotation(axis, np.radians(values[:, column]))
            elif j == 0:
                translation[:, axis] += values[:, column]
            elif skeleton.names[j] not in passed:
                passed.append(skeleton.names[j])
            column += 1
    notes = (f"position channels of joints other than the root are left out: {', '.join(passed)}",) if passed else ()
    return Motion(
        joint_names=tuple(skeleton.names),
        parents=np.array(skeleton.parents),
        offsets=offsets,
        end_offsets=np.array(skeleton.ends, dtype=float),
        channels=tuple(skeleton.channels),
        rotations=rotations,
        translation=translation,
        frame_time=frame_time,
        notes=notes,
    )


def _axis_rotation(axis, angles):
    """(T, 3, 3) rotations about x, y or z."""
    R = np.zeros((len(angles), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[:, axis, axis] = 1.0
    R[:, i, i] = R[:, j, j] = np.cos(angles)
    R[:, j, i] = np.sin(angles)
    R[:, i, j] = -R[:, j, i]
    return R
