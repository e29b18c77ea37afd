"""What a run writes, and where: names settled and checked before any work starts, files of one scan written together."""

import os
import unicodedata
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import FileError, InputError, in_words, listed
from ..interrupts import held
from ..io.columns import ODD_X
from .progress import say
from .summary import SUMMARY, is_of_others

__all__ = [
    "ScanFiles",
    "Writer",
    "check_file",
    "check_outputs",
    "check_sources",
    "draw",
    "drawn_by_others",
    "entry",
    "fitted_entry",
    "folded",
    "identity",
    "plan",
    "remove",
    "results_beside",
    "same_file",
    "unfitted_entry",
    "with_reasons",
    "without_pictures_of_others",
    "without_results",
]

# What follows the name of a scan in its files.
_ENDINGS = {"fit": ".fit.npz", "mesh": ".mesh.ply", "labels": ".labels.ply", "picture": ".png"}

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

    def beside(self):
        """What an earlier run has written beside its fit, a picture that is not wanted now, too; none that others have drawn."""
        picture = self.fit.with_name(self.name + _ENDINGS["picture"])
        ours = (self.picture is not None or self.fit.is_file()) and not drawn_by_others(picture)
        return [self.mesh, self.labels, *([picture] if ours else [])]


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
        paths = {what: out / f"{name}{ending}" for what, ending in _ENDINGS.items() if pictures or what != "picture"}
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


def check_outputs(paths, out, *, inputs, existing, argument="-o"):
    """Raise where files to write have names that are too long, are inputs, folders, or, with ``existing="error"``, there."""
    if os.path.exists(out) and not os.path.isdir(out):
        raise FileError(str(out), "a file", "a folder to write to, or a name for a new one")
    read = _Inputs(inputs)
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


class _Inputs:
    """Files that are read, found again by their names and by what they are: as :func:`same_file`, of many at once."""

    def __init__(self, sources):
        self._files, self._names, self._missing = {}, {}, {}
        for source in sources:
            name = folded(os.path.abspath(source))
            self._names.setdefault(name, source)
            try:
                self._files.setdefault(identity(source), source)
            except (OSError, ValueError):
                self._missing.setdefault(name, source)

    def same(self, path):
        """The input that a path is, or would be where upper and lower case are the same; None where it is none."""
        name = folded(os.path.abspath(path))
        try:
            return self._files.get(identity(path), self._missing.get(name))
        except (OSError, ValueError):
            return self._names.get(name)


def identity(path):
    """What two paths have in common that are one file."""
    found = os.stat(path)
    return found.st_dev, found.st_ino


def same_file(a, b):
    """Whether two paths are one file, or would be where upper and lower case are the same."""
    try:
        return os.path.samefile(a, b)
    except (OSError, ValueError):
        return folded(os.path.abspath(a)) == folded(os.path.abspath(b))


def entry(scan, status, **facts):
    """What the summary says about one scan; file names are relative to its folder."""
    return {"name": scan.name, "input": scan.source, "status": status, **facts}


@dataclass(frozen=True)
class Writer:
    """``finish`` of ``fit_scans``: writes the files of a scan and returns its entry in the summary.

    Attributes
    ----------
    rig : Rig
    files : tuple of ScanFiles
    """

    rig: object
    files: tuple

    def __call__(self, index, scan, result):
        from ..io.write import atomic_path, write_mesh_ply, write_points_ply
        from ..report.colors import part_colors

        files, rig = self.files[index], self.rig
        if result.status != "ok":  # in the fit's own file, too, for runs that keep it
            result = replace(result, message=with_reasons(result.message, scan.notes))
        colors = part_colors(len(rig.parts))
        # All three get their names only once all three are complete. The fit first (the last that is opened): of what is left
        # where the process is killed in between, --existing skip then knows whose it is, and makes it anew.
        with held(), atomic_path(files.labels) as labels, atomic_path(files.mesh) as mesh, atomic_path(files.fit) as fit:
            result.save(fit)
            write_mesh_ply(
                mesh,
                result.vertices,
                rig.faces,
                vertex_labels=rig.vertex_labels,
                colors=colors[rig.vertex_labels],
                part_names=rig.parts,
            )
            write_points_ply(
                labels,
                scan.points,
                labels=result.labels,
                confidence=result.confidence,
                colors=colors[result.labels],
                normals=scan.normals,
                part_names=rig.parts,
            )
            for path in files.beside():  # of an earlier fit, which would then pass for this one's; links stay
                Path(os.path.realpath(path)).unlink(missing_ok=True)
        undrawn = [] if files.picture is None else draw(files, rig, scan.points, result)
        return fitted_entry(files, result, notes=[*scan.notes, *undrawn])


def with_reasons(message, notes):
    """The message of a fit in doubt, after what was noted about its scan that spoils any fit."""
    return "; ".join([*(note.rstrip(".") for note in notes if note.startswith(ODD_X)), message])


def unfitted_entry(files, message, **facts):
    """The entry of a scan that could not be fitted now; removes what an earlier run has written of it, as if it were its fit."""
    return entry(files, "failed", message="; ".join([message, *remove([files.fit, *files.beside()])]), **facts)


def remove(paths):
    """Remove what an earlier run has written, where it is there; notes on files that another program holds, say."""
    notes = []
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            notes.append(f"{path.name} of an earlier run cannot be removed ({error.strerror or error})")
    return notes


def draw(files, rig, points, result):
    """Write the picture of a fit that is written already; notes, one where it cannot be drawn: no fit is lost for a picture."""
    from ..report.fit_picture import fit_picture
    from ..report.render import write_png

    try:
        write_png(files.picture, fit_picture(rig, points, result))
    except Exception as error:  # noqa: BLE001 (whatever is wrong with a picture, the fit is right)
        return [f"no picture: {in_words(error)}", *remove([files.picture])]
    return []


def fitted_entry(files, result, *, kept=False, notes=()):
    """The entry of a scan whose fit is there, with the fit's own status; ``kept``: an earlier run has made it."""
    return entry(
        files,
        result.status,
        kept=kept,
        message=result.message,
        probability=round(result.probability, 4),
        evidence={name: round(value, 5) for name, value in result.evidence.items()},
        converged=result.converged,
        terms=result.terms,
        evaluations=result.evaluations,
        seconds=round(result.seconds, 3),
        scale=result.scale,
        unit=result.unit or None,
        subject=result.subject or None,
        points=len(result.labels),
        files={kind: path.name for kind, path in files.paths.items() if path.is_file()},
        notes=list(notes),
    )


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


def without_results(sources):
    """The scans but for results of others of them that this package has written beside these, which a line tells.

    Patterns such as ``*.ply`` name both where results go into the folder of the scans, and the same command has to mean the same
    once there are some. A result that is given without its scan is one itself.
    """
    if left := _results_among(sources):
        which, names = ("which is a result", "its scan") if len(left) == 1 else ("which are results", "their scans")
        words = f"skipped {len(left)} of {len(sources)} files, {which} that lbsfit has written beside {names}: "
        words += listed([os.path.basename(s) for s in sources if s in left], 3)
        say(f"{words}; to fit such a file as a scan, give it without its scan")
    return [s for s in sources if s not in left]


def results_beside(scans):
    """Results of these scans that :func:`without_results` leaves out where a pattern names them as well."""
    beside = {os.path.join(os.path.dirname(s), f"{Path(s).stem}{ending}") for s in scans for ending in _ENDINGS.values()}
    beside |= {os.path.join(os.path.dirname(s), SUMMARY) for s in scans}
    there = {path for path in beside if os.path.isfile(path)}
    return sorted(_results_among([*scans, *there]) & there)


def _results_among(sources):
    """Those of some files that are results of others of them."""
    scans = {_place(s, Path(s).stem) for s in sources if not s.endswith(_ENDINGS["picture"])}
    left = {s for s in sources if any(s.endswith(ending) and _is_result(s, ending, scans) for ending in _ENDINGS.values())}
    folders = {_place(s, SUMMARY) for s in left}
    return left | {s for s in sources if os.path.basename(s) == SUMMARY and _place(s, SUMMARY) in folders}


def _is_result(source, ending, scans):
    """Whether a file with that ending is of a fit beside it, whose scan is one of these: places and names."""
    from ..io.npz import RESULT_KEY, npz_keys

    name = os.path.basename(source).removesuffix(ending)
    if _place(source, name) not in scans:
        return False
    fit = os.path.join(os.path.dirname(source), name + _ENDINGS["fit"])
    try:
        ours = RESULT_KEY in npz_keys(fit)
    except FileError:
        return False
    return ours and (ending != _ENDINGS["picture"] or not drawn_by_others(source))


def _place(source, name):
    return os.path.abspath(os.path.dirname(source)), name


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


def drawn_by_others(picture):
    """Whether there is a file at a picture's place that this package has not drawn."""
    from ..report.render import is_signed

    try:
        return os.path.exists(picture) and not is_signed(picture)  # a link to nothing is in nobody's way
    except OSError:  # one that cannot be read is not for drawing over
        return True


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


def folded(text):
    """A name or path as file systems have it where upper and lower case are the same."""
    return unicodedata.normalize("NFC", str(text)).casefold()
