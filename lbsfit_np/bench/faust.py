"""The MPI-FAUST data set in its published layout: scans, registrations, pairs of the challenge, and the files that it takes.

Names are those of the data's own README, first version of the archives (2014). In MPI-FAUST:

    training/scans/tr_scan_000.ply … 099                     ten poses of each of ten people: number // 10 is the subject
    training/registrations/tr_reg_000.ply …                  meshes of one topology
    training/ground_truth_vertices/tr_gt_000.txt …           a line for each vertex of the scan: 1 where it is reliably registered
    test/scans/test_scan_000.ply … 199                       twenty poses of each: number // 20 is the subject
    test/challenge_pairs/intra_challenge.txt, inter_challenge.txt      lines such as 012_023

Reference: Bogo, Romero, Loper, Black: FAUST: Dataset and evaluation for 3D mesh registration, CVPR 2014. Lengths are in metres.
"""

import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..correspondence import transfer
from ..errors import FileError, brief, counted, from_digits, listed
from .pairs import KINDS, pairs_bench
from .truth import PairScan, Registrations, read_registrations

__all__ = ["PAPER", "Faust", "challenge_files", "challenge_left", "faust_bench", "faust_table", "read_faust", "write_challenge"]

# The paper's table, "Correspondence results on FAUST testing set": (method, inter, intra), in cm; None where it has none.
PAPER = (
    ("FMNet", 4.826, 2.44),
    ("3D-CODED, unsupervised (230K)", 4.88, None),
    ("3D-CODED, supervised (10K)", 4.70, None),
    ("3D-CODED, supervised (230K)", 3.26, 1.985),
    ("LBS-AE (23K)", 4.08, 2.161),
)
# What the aims of this package on bodies registered from real scans are.
AIMS = {"intra": 1.6, "inter": 2.2}

_POSES = {"training": 10, "test": 20}
_NUMBER = re.compile(r"(\d+)$")
_PAIR = re.compile(r"\s*(\d+)_(\d+)\s*")
_CHALLENGES = {kind: (f"{kind}_challenge.txt", f"FAUST_challenge_{kind}.txt") for kind in KINDS}


@dataclass
class Faust:
    """What is there.

    Attributes
    ----------
    training, test : list of PairScan
    truth : Registrations or None
        Of the training scans.
    challenges : dict of str to list of (int, int)
        Kind → pairs of test scans, indices of ``test``.
    complete : dict of str to bool
        Kind → whether these are all of the challenge's pairs.
    files : list of Path
        What was read, beside scans.
    notes : list of str
        What is missing, and what follows from that.
    """

    training: list = field(default_factory=list)
    test: list = field(default_factory=list)
    truth: Registrations = None
    challenges: dict = field(default_factory=dict)
    complete: dict = field(default_factory=dict)
    files: list = field(default_factory=list)
    notes: list = field(default_factory=list)


def read_faust(folder, *, most=None, learn=True):
    """Find what there is of the data set.

    Parameters
    ----------
    folder : str or Path
        MPI-FAUST or the folder that it is in.
    most : int, optional
        Take the first so many scans of each subject only.
    learn : bool, default True
        Whether training scans are needed.

    Returns
    -------
    Faust

    Raises
    ------
    FileError
        No such folder, nothing of the data set in it, no training scans where they are needed, neither truth nor challenge, files
        that are broken.
    """
    root = _root(Path(folder))
    found = Faust()
    found.training = _scans(root / "training" / "scans", "tr_scan_*.ply", _POSES["training"], most)
    if not found.training:
        where = root / "training" / "scans"
        if learn:
            remedy = "Pass --no-learn to fit the test scans one by one. lbsfit bench pairs measures registrations as scans."
            raise FileError(str(where), _nothing(where), "the scans to learn from, tr_scan_000.ply and so on", remedy)
        found.notes.append(f"{where}: {_nothing(where)}; only the challenge's files are written")
    else:
        _name_absent(root / "training" / "scans", "tr_scan_", _told_by_truth(root / "training"), found)
        found.truth = _truth(root / "training", found)
    _read_test(root, found, most)
    if found.truth is None and not any(found.challenges.values()):
        got, remedy = "neither registrations of training scans nor pairs of test scans", None
        if most is not None:
            got, remedy = f"{got} among the first of each subject", "Leave out --scans, or take more."
        raise FileError(str(root), got, f"{root / 'training' / 'registrations'} or {root / 'test' / 'challenge_pairs'}", remedy)
    return found


def _root(folder):
    for root in (folder, folder / "MPI-FAUST"):
        if (root / "training").is_dir() or (root / "test").is_dir():
            return root
    got = "no such folder" if not folder.exists() else "a folder with neither training nor test, also not in MPI-FAUST"
    remedy = "Its licence does not allow us to ship it: see http://faust.is.tue.mpg.de."
    raise FileError(str(folder), got, "the folder MPI-FAUST of the data set, or the folder that contains it", remedy)


def _nothing(where):
    return "no such folder" if not where.is_dir() else "a folder without scans"


def _scans(where, pattern, poses, most):
    files = sorted(p for p in where.glob(pattern) if _NUMBER.search(p.stem)) if where.is_dir() else []
    scans, taken = [], {}
    for path in files:
        subject = str(_number(path) // poses)
        taken[subject] = taken.get(subject, 0) + 1
        if most is None or taken[subject] <= most:
            scans.append(PairScan(path.stem, path, subject))
    return scans


def _number(path):
    return int(_NUMBER.search(path.stem)[1])


def _name_absent(where, stem, numbers, found):
    """Note which of the scans of these numbers are not there."""
    there = {_number(path) for path in where.glob(f"{stem}*.ply") if _NUMBER.search(path.stem)}
    absent = [f"{stem}{k:03d}" for k in sorted(set(numbers) - there)]
    if absent:
        found.notes.append(f"{where}: no file for {listed(absent, 5)}")


def _told_by_truth(training):
    """Numbers of the scans that there are registrations or flags of."""
    files = [*(training / "registrations").glob("tr_reg_*.ply"), *(training / "ground_truth_vertices").glob("tr_gt_*.txt")]
    return [_number(path) for path in files if _NUMBER.search(path.stem)]


def _truth(training, found):
    where = training / "registrations"
    files = [where / f"tr_reg_{_number(s.path):03d}.ply" for s in found.training]
    there = [path if path.is_file() else None for path in files]
    if not any(there):
        what = "no registrations" if where.is_dir() else "no such folder"
        found.notes.append(f"{where}: {what}; errors cannot be measured")
        return None
    if sum(path is not None for path in there) < 2:
        found.notes.append(f"{where}: a registration of one scan alone; errors are of pairs, and cannot be measured")
        return None
    missing = [scan.name for scan, path in zip(found.training, there, strict=True) if path is None]
    if missing:
        found.notes.append(f"{where}: no registrations of {listed(missing, 5)}, whose errors are not measured")
    found.files += [path for path in there if path is not None]
    vertices, faces = read_registrations(there, what="registrations of FAUST")
    flags = training / "ground_truth_vertices"
    if not flags.is_dir():
        found.notes.append(f"{flags}: no such folder; all vertices of the scans count, reliably registered or not")
        return Registrations(vertices, faces)
    reliable = tuple(_flags(flags / f"tr_gt_{_number(s.path):03d}.txt") for s in found.training)
    given = zip(found.training, vertices, reliable, strict=True)
    unknown = [scan.name for scan, registration, known in given if known is None and registration is not None]
    if unknown:
        found.notes.append(f"{flags}: no file for {listed(unknown, 5)}; all vertices count there, reliably registered or not")
    return Registrations(vertices, faces, reliable)


def _flags(path):
    """(n,) bool; None where there is no file."""
    if not path.is_file():
        return None
    words = path.read_bytes().split()
    if not words or not set(words) <= {b"0", b"1"}:
        raise FileError(str(path), f"{len(words)} words, some of which are not 0 or 1", "a line for each vertex, 1 or 0")
    return np.array(words) == b"1"


def _read_test(root, found, most):
    """Test scans, and the pairs of them that the challenge asks for."""
    where, scans = _challenge_folder(root), root / "test" / "scans"
    lists = {kind: path for kind in KINDS if (path := _challenge_file(where, kind)) is not None}
    found.test = _scans(scans, "test_scan_*.ply", _POSES["test"], most)
    if not lists:
        found.notes.append(f"{root / 'test' / 'challenge_pairs'}: {_no_lists(where)}; no files for the challenge are written")
        return
    if not found.test:
        found.notes.append(f"{scans}: {_nothing(scans)}; no files for the challenge are written")
        return
    found.files += lists.values()
    row = {_number(s.path): k for k, s in enumerate(found.test)}
    asked = {kind: _pairs(path) for kind, path in lists.items()}
    _name_absent(scans, "test_scan_", [k for pairs in asked.values() for pair in pairs for k in pair], found)
    for kind, pairs in asked.items():
        found.challenges[kind] = [(row[a], row[b]) for a, b in pairs if a in row and b in row]
        found.complete[kind] = len(found.challenges[kind]) == len(pairs)
        if not found.complete[kind]:
            left = f"{len(pairs) - len(found.challenges[kind])} of {len(pairs)} {kind}-subject pairs of the challenge"
            found.notes.append(f"{left} are left out, as their scans are missing or not used; no archive is written")
    for kind in (k for k in KINDS if k not in lists):
        found.notes.append(f"{where}: no {_CHALLENGES[kind][0]}; no files for the {kind}-subject challenge are written")


def _challenge_folder(root):
    """The first that has a list, else the first that is there."""
    there = [p for p in (root / "test" / "challenge_pairs", root / "challenge_pairs") if p.is_dir()]
    return next((p for p in there if any(_challenge_file(p, kind) for kind in KINDS)), there[0] if there else None)


def _no_lists(where):
    return "no such folder" if where is None else f"a folder without {_CHALLENGES['intra'][0]} and {_CHALLENGES['inter'][0]}"


def _challenge_file(where, kind):
    names = () if where is None else _CHALLENGES[kind]
    return next((where / name for name in names if (where / name).is_file()), None)


def _pairs(path):
    pairs = []
    for k, line in enumerate(path.read_text(encoding="utf-8-sig", errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        match = _PAIR.fullmatch(line)
        pair = (None,) if match is None else tuple(map(from_digits, match.groups()))
        if None in pair:
            raise FileError(str(path), f"{brief(line)} in line {k}", "pairs of scan numbers, such as 012_023")
        pairs.append(pair)
    if not pairs:
        raise FileError(str(path), "no pairs", "pairs of scan numbers, such as 012_023", "Remove the file to do without it.")
    return list(dict.fromkeys(pairs))  # each once: it has one file


def faust_bench(fitter, found, folder, *, on_figures=None, reporter=None, **options):
    """Learn from the training scans, fit all, measure errors where the truth is known, and write the challenge's files.

    Parameters
    ----------
    fitter : LBSFitter
    found : Faust
    folder : Path
        There already.
    on_figures : callable (report), optional
        Called before the challenge's files are written.
    reporter, **options
        As for ``pairs.pairs_bench``; ``reporter.written(done, total)`` as well, of the challenge's files.

    Returns
    -------
    report : dict
        As of ``pairs_bench``, and "challenge".
    fits : Fits
    """
    options |= {"also": found.test, "unit": "m", "reporter": reporter}
    report, fits = pairs_bench(fitter, found.training, found.truth, folder, **options)
    report |= {"benchmark": "faust", "paper": PAPER, "notes": found.notes + report["notes"], "challenge": {}}
    if on_figures is not None:
        on_figures(report)
    on_pair = getattr(reporter, "written", None)
    report["challenge"] = write_challenge(folder, found, fits, fitter.rig.faces, on_pair=on_pair)
    for kind, n in _archives_kept(folder, report["challenge"]).items():
        note = f"challenge-{kind}.zip is of an earlier run, with {counted(n, 'pair')}, and is kept; --existing replace removes it"
        report["notes"].append(note)
        getattr(reporter, "noted", lambda words: None)(note)
    return report, fits


# ---- the challenge ----


def challenge_files(folder, found):
    """The files that :func:`write_challenge` writes: kind → (archive, list of files)."""
    files = {}
    for kind, pairs in found.challenges.items():
        names = [f"{_number(found.test[a].path):03d}_{_number(found.test[b].path):03d}.txt" for a, b in pairs]
        files[kind] = folder / f"challenge-{kind}.zip", [folder / f"challenge-{kind}" / name for name in names]
    return files


def write_challenge(folder, found, fits, faces, *, on_pair=None):
    """Write the correspondences that the challenge asks for, and an archive of each kind whose pairs are all there.

    A file for each pair, named as in the challenge's list: for each vertex of the first scan a line with x, y, z (metres) of the
    point of the second scan that is nearest to what the registrations give. Once these are there, files of an earlier run's other
    pairs are removed, and its archives, but for those that have more pairs than are written.

    Parameters
    ----------
    folder : Path
    found : Faust
    fits : Fits
        Of the test scans.
    faces : (F, 3) int array
        Of the rig.
    on_pair : callable (done, total), optional
        Called before the first pair, too.

    Returns
    -------
    dict
        Kind → "written" and "missing" pairs, "archive": its name, or None where pairs are missing.
    """
    report, done, total = {}, 0, sum(map(len, found.challenges.values()))
    if on_pair is not None and total:
        on_pair(0, total)
    earlier, made = challenge_left(folder), set()
    for kind, (archive, files) in challenge_files(folder, found).items():
        (folder / f"challenge-{kind}").mkdir(exist_ok=True)
        written = []
        for (a, b), path in zip(found.challenges[kind], files, strict=True):
            if fits.has(found.test[a].name) and fits.has(found.test[b].name):
                _write_points(path, _correspondences(found.test[a], found.test[b], fits, faces))
                written.append(path)
            done += 1
            if on_pair is not None:
                on_pair(done, total)
        whole = found.complete[kind] and len(written) == len(files)
        if whole:
            _write_archive(archive, written)
        made |= {*written, *([archive] if whole else ())}
        report[kind] = {"written": len(written), "missing": len(files) - len(written), "archive": archive.name if whole else None}
    kept = {folder / f"challenge-{kind}.zip" for kind in _archives_kept(folder, report)}
    for path in earlier:
        if path not in made | kept:
            path.unlink(missing_ok=True)
    return report


def _archives_kept(folder, report):
    """Archives of an earlier run with more pairs than this one has written: kind → pairs."""
    written = {kind: report[kind]["written"] if kind in report else 0 for kind in KINDS}
    there = {kind: _pairs_in(folder / f"challenge-{kind}.zip") for kind in KINDS}
    return {kind: n for kind, n in there.items() if n > written[kind]}


def _pairs_in(archive):
    """How many pairs an archive has; 0 where it cannot be read."""
    try:
        with zipfile.ZipFile(archive) as file:
            return sum(_PAIR.fullmatch(Path(name).stem) is not None for name in file.namelist())
    except (OSError, zipfile.BadZipFile):
        return 0


def challenge_left(folder):
    """The files that an earlier :func:`write_challenge` has left in a folder, perhaps of other fits or other pairs."""
    archives = [folder / f"challenge-{kind}.zip" for kind in KINDS]
    files = [path for kind in KINDS for path in (folder / f"challenge-{kind}").glob("*.txt") if _PAIR.fullmatch(path.stem)]
    return [path for path in (*archives, *files) if path.is_file()]


def _correspondences(a, b, fits, faces):
    from ..io.scans import load_scan

    registrations = fits.load(a.name).vertices, fits.load(b.name).vertices
    return transfer(load_scan(a.path), *registrations, faces, snap_to=load_scan(b.path))


def _write_points(path, points):
    from ..io.write import atomic_path

    with atomic_path(path) as temporary:
        np.savetxt(temporary, points, fmt="%.6f")


def _write_archive(path, files):
    from ..io.write import atomic_path

    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)


# ---- the table ----


def faust_table(report, *, markdown=False):
    """The errors on the training scans beside the paper's table.

    Parameters
    ----------
    report : dict
        With "figures" of ``pairs.measure_pairs``, in metres, or None, and "settings".
    markdown : bool, default False

    Returns
    -------
    str
    """
    from .table import layout

    heads = ("median", "90 %", "95 %")
    lines = [("method", "scans", *(f"{kind}{' ' + h if h else ''}" for kind in ("inter", "intra") for h in ("", *heads)))]
    figures = report["figures"]
    for when, words in (("before", "before the snap"), ("after", "after the snap")) if figures else ():
        values = [figures[kind][when][key] for kind in ("inter", "intra") for key in ("mean", "median", "p90", "p95")]
        lines.append((f"lbsfit, {words}", "training", *("–" if v is None else f"{100 * v:.2f}" for v in values)))
    for name, inter, intra in PAPER:
        cells = [f"{inter:g}", *"–––", "–" if intra is None else f"{intra:g}", *"–––"]
        lines.append((name, "test", *cells))
    legend = [
        "Errors in cm: means, then percentiles. Figures of other methods are from the paper's table, on the test scans, whose",
        "truth is withheld: only the files for the challenge can be compared with them. The training scans are another set.",
    ]
    if figures:
        counts = ", ".join(f"{figures[kind]['pairs']} {kind} pairs ({figures[kind]['missing']} missing)" for kind in KINDS)
        what = "learned together" if report["settings"]["learn"] else "fitted one by one"
        legend.append(f"{counts} of the training scans, {what}; aims: intra {AIMS['intra']:g} cm, inter {AIMS['inter']:g} cm.")
    return f"{layout(lines, markdown=markdown)}\n\n" + "\n".join(legend)
