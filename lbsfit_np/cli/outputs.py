"""What a run is to write, and where: names settled and checked before any work starts."""

import os
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import FileError, InputError, listed
from ..io.write import make_folder
from .earlier_results import ENDINGS, drawn_by_others
from .same_files import Inputs, folded, same_file
from .summary import SUMMARY, is_of_others

__all__ = [
    *("ScanFiles", "check_file", "check_outputs", "check_sources", "named_by", "out_folder", "plan"),
    "without_pictures_of_others",
]

_FREE = "a folder without results of these names"
_REPLACE = "--existing replace"

_LONGEST_NAME = 255  # in all common file systems: bytes on POSIX, letters on Windows


@dataclass(frozen=True)
class ScanFiles:
    """A scan and the files of its fit.

    Attributes
    ----------
    source : str
        Path of the scan as given.
    name : str
        Its file name without the extension.
    fit, mesh, labels : Path
    picture : Path or None
        None where none is wanted.
    """

    source: str
    name: str
    fit: Path
    mesh: Path
    labels: Path
    picture: Path | None = None

    @property
    def paths(self):
        """What each file is → its path."""
        paths = {"fit": self.fit, "mesh": self.mesh, "labels": self.labels, "picture": self.picture}
        return {what: path for what, path in paths.items() if path is not None}

    def earlier_pictures(self):
        """The picture, in a list, that an earlier run drew of its fit, also where none is wanted now; none that others drew."""
        picture = self.fit.with_name(self.name + ENDINGS["picture"])
        ours = (self.picture is not None or self.fit.is_file()) and not drawn_by_others(picture)
        return [Path(os.path.realpath(picture))] if ours else []  # of a link what it leads to: links stay


def plan(sources, out, *, inputs, existing, argument="-o", pictures=False, may_skip=False):
    """The files of every scan, after all that can go wrong with their names has been ruled out.

    Parameters
    ----------
    sources : list of str
        Paths of the scans.
    out : str or Path
        The folder to write to; need not exist yet.
    inputs : list of str
        Other files that are read, and so never written.
    existing : {"error", "skip", "replace"}
    argument : str, default "-o"
        The option that gave ``out``.
    pictures : bool, default False
        Whether each scan gets a picture, too.
    may_skip : bool, default False
        Whether the command can keep fits that are there, which a message then offers.

    Returns
    -------
    list of ScanFiles

    Raises
    ------
    InputError, FileError
        Scans that do not exist, names that clash, outputs that are inputs or folders, outputs that exist already; with
        ``existing="skip"`` those that belong to no fit.
    """
    check_sources(sources)
    out = Path(out)
    files = []
    for source in sources:
        name = Path(source).stem
        paths = {what: out / f"{name}{ending}" for what, ending in ENDINGS.items() if pictures or what != "picture"}
        files.append(ScanFiles(source, name, **paths))
    _check_clashes(files, out, argument)
    # A summary of ours is of each run alone: one that is there is no fit that could be lost.
    paths = [path for f in files for path in f.paths.values()] + [out / SUMMARY]
    check_outputs(paths, out, inputs=[*sources, *inputs], existing="replace", argument=argument)
    if existing != "replace" and is_of_others(out / SUMMARY):
        got, remedy = f"{out}, with a {SUMMARY} that lbsfit did not write", f"Move it away, choose another folder, or {_REPLACE}."
        raise InputError(argument, got, "a folder without such a file", remedy)
    if existing == "skip":
        _check_strays(files, out)
    elif existing == "error":
        _check_there(files, out, argument, may_skip)
    return files


def without_pictures_of_others(files):
    """The same files, none with a picture whose place is taken by a file that this package has not drawn; and notes on these."""
    kept, notes = [], []
    for f in files:
        if f.picture is not None and drawn_by_others(f.picture):
            notes.append(f"{f.name}: no picture: {f.picture} was not drawn by lbsfit and is kept")
            f = replace(f, picture=None)
        kept.append(f)
    return kept, notes


@contextmanager
def named_by(argument):
    """What is said of a folder or file names the option that gave it."""
    try:
        yield
    except FileError as error:
        got, remedy = f"{error.argument}, {error.got}", error.remedy or "Choose another."
        raise InputError(argument, got, error.expected, remedy) from None


def out_folder(out, argument="-o/--output"):
    """``io.write.make_folder``, whose errors name the option that gave the folder."""
    with named_by(argument):
        return make_folder(out)


def check_outputs(paths, out, *, inputs, existing, argument="-o"):
    """Raise where files to write have names that are too long, are inputs, folders, or, with ``existing="error"``, there."""
    if os.path.exists(out) and not os.path.isdir(out):
        raise InputError(argument, f"{out}, a file", "a folder to write to, or a name for a new one", "Choose another.")
    read = Inputs(inputs)
    for path in paths:
        _check_length(path, "Rename the scan.")
        if (source := read.same(path)) is not None:
            remedy = "An input is never overwritten: choose another folder, or leave it out if it is a result of an earlier run."
            raise InputError(argument, f"{out}, where {path.name} is an input ({source})", "a folder for the results", remedy)
        if os.path.isdir(path):
            raise FileError(str(path), "a folder", "the name of a file to write")
    there = [path for path in paths if os.path.lexists(path)]
    if there and existing == "error":
        raise InputError(argument, _there_in_words(out, there), _FREE, f"Choose another folder, or {_REPLACE}.")


def check_file(path, *, inputs, existing):
    """Raise where one file to write is a folder, there with ``existing="error"``, or an input: pairs (path, what it is)."""
    for source, what in inputs:
        if same_file(path, source):
            raise InputError("-o/--output", f"{path}, which is {what}", "another name", "An input is never overwritten.")
    if os.path.isdir(path):
        raise FileError(str(path), "a folder", "the name of a file to write")
    _check_length(Path(path), "Choose a shorter one.")
    if os.path.lexists(path) and existing == "error":
        raise FileError(str(path), "a file that exists already", "a new name", "Choose another, or --existing replace.")


def check_sources(sources):
    """Raise where scans do not exist or are folders."""
    missing = [s for s in sources if not os.path.exists(s)]
    if missing:
        what = "a file that does not exist" if len(missing) == 1 else f"{len(missing)} files that do not exist"
        raise InputError(
            "SCAN", f"{what}: {listed(missing, 5)}", "scan files that exist", "Check the paths; give the rig before the scans."
        )
    folders = [s for s in sources if os.path.isdir(s)]
    if folders:
        from ..io.scans import SCAN_EXTENSIONS

        endings = [path.suffix for path in sorted(Path(folders[0]).iterdir()) if path.suffix.lower() in SCAN_EXTENSIONS]
        inside = os.path.join(folders[0], "*" + max(endings, key=endings.count, default=".ply"))
        raise InputError("SCAN", f"a folder: {listed(folders, 5)}", "scan files", f"Name the files in it, such as {inside}")


def _check_there(files, out, argument, may_skip):
    """Raise where results are there; what others have drawn is told from them."""
    there = [path for f in files for path in f.paths.values() if os.path.lexists(path)]
    if not there:
        return
    others = [f.picture for f in files if f.picture is not None and drawn_by_others(f.picture)]
    words = _there_in_words(out, there)
    if others:
        which = "which" if others == there else f"of which {listed([path.name for path in others], 5)}"
        words += f", {which} lbsfit did not draw"
    ways = f"--existing skip, which keeps finished fits, or {_REPLACE}" if may_skip else _REPLACE
    if others == there and may_skip:
        ways = f"--existing skip, which keeps pictures that lbsfit did not draw, or {_REPLACE}"
    elif not any(os.path.lexists(f.fit) for f in files):  # nothing that could be kept
        words, ways = f"{words}, but no fit (NAME.fit.npz) with {'it' if len(there) == 1 else 'them'}", _REPLACE
    raise InputError(argument, words, _FREE, f"Choose another folder, or {ways}.")


def _check_strays(files, out):
    """Raise where a mesh or labels are there without the fit that they would belong to: nobody knows whose they are."""
    strays = [path for f in files if not os.path.lexists(f.fit) for path in (f.mesh, f.labels) if os.path.lexists(path)]
    if strays:
        raise InputError(
            "--existing skip",
            f"{_there_in_words(out, strays)}, but no fit (NAME.fit.npz) with {'it' if len(strays) == 1 else 'them'}",
            "finished fits with all their files, or no results",
            f"Choose another folder, move {'it' if len(strays) == 1 else 'them'} away, or {_REPLACE}.",
        )


def _there_in_words(out, there):
    names = listed([os.path.relpath(path, out) for path in there], 5)
    return f"{out}, where {names} exist{'s' if len(there) == 1 else ''} already"


def _check_length(path, remedy):
    if len(os.fsencode(path.name) if os.name == "posix" else path.name) > _LONGEST_NAME:
        raise FileError(str(path), "a name that is too long for a file", f"at most {_LONGEST_NAME} bytes", remedy)


def _check_clashes(files, out, argument):
    other_way = "fit them into different folders"
    if argument == "--results":
        other_way = "learn without --results, and fit the model to each folder"
    seen = {}
    for f in files:
        other = seen.setdefault(folded(f.name), f)
        if other is not f:
            if same_file(f.source, other.source):
                raise InputError("SCAN", f"{other.source} twice", "each scan once", "Leave one out.")
            raise InputError(
                "SCAN",
                f"{other.source} and {f.source}, whose results would both be called {out / f.name}.*",
                "scans whose names differ by more than their extension and upper or lower case",
                f"Rename one, or {other_way}.",
            )
