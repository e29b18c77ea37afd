"""Fits of a folder of scans for the benchmark of pairs: learned together or one by one, each kept in a file, and taken up again.

The folder has ``fits/NAME.npz`` for each scan, ``model.npz`` where something was learned, and ``fits.json``: the settings, and
the digests of the files that were read. What was made with other settings, or another rig, is an error; a scan whose file has
changed is fitted again.
"""

import functools
import hashlib
import json
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError, LbsfitError
from ..fitting.result import FitResult
from ..learning.checkpoint import checkpoint_of, remove_checkpoint, state_of_the_code
from .resume import described

__all__ = ["Fits", "checkpoint_in", "fit_files", "fit_scans_of", "has_record", "made_files"]

_RECORD, _MODEL, _FITS = "fits.json", "model.npz", "fits"
_REMEDY = "Choose another folder, or --existing replace."


@dataclass
class Fits:
    """The fits of scans.

    Attributes
    ----------
    folder : Path
    entries : dict of str to dict
        By the scan's name: "status", "probability", "recon", "scale", "unit", "seconds", "points", "message", "kept" (an
        earlier run has made it); where there is no fit, "failed", the reason.
    history : list of dict
        Of ``LBSFitter.history_``; empty where nothing was learned.
    not_learned : dict of str to str
        Why scans that were to be learned from could not be used for that, by their names.
    """

    folder: Path
    entries: dict = field(default_factory=dict)
    history: list = field(default_factory=list)
    not_learned: dict = field(default_factory=dict)

    def has(self, name):
        """Whether there is a fit of the scan."""
        return name in self.entries and "failed" not in self.entries[name]

    def load(self, name):
        """The FitResult of a scan."""
        return FitResult.load(_file(self.folder, name))

    def failures(self):
        """Pairs (name, why) of scans without a fit, and of those whose fit is all but certainly wrong."""
        for name, entry in self.entries.items():
            if "failed" in entry:
                yield name, entry["failed"]
            elif entry["status"] == "failed":
                yield name, entry["message"]


def fit_files(folder, names):
    """The files that :func:`fit_scans_of` writes, of scans of such names."""
    return [folder / _RECORD, folder / _MODEL, *(_file(folder, name) for name in names)]


def has_record(folder):
    """Whether an earlier run of :func:`fit_scans_of` has begun in a folder."""
    return (folder / _RECORD).is_file()


def made_files(folder):
    """The files with points or meshes that an earlier run of :func:`fit_scans_of` has written."""
    if not has_record(folder):
        return []
    made = (folder / _MODEL, *sorted((folder / _FITS).glob("*.npz")), *sorted(checkpoint_in(folder).glob("*.npz")))
    return [path for path in made if path.is_file()]


def fit_scans_of(
    fitter,
    scans,
    folder,
    *,
    learn_from=(),
    settings=None,
    existing="resume",
    made_of_fits=(),
    n_samples=None,
    jobs=1,
    reporter=None,
):
    """Fit scans, or take what is there.

    Parameters
    ----------
    fitter : LBSFitter
        That has learned nothing.
    scans : sequence of PairScan
    folder : Path
        There already.
    learn_from : sequence of PairScan
        Scans that the fitter learns from first, some of ``scans``; those of a subject share a template. What learning leaves
        of them is fitted as their subject's, all others as anybody's. Where there are none, all are fitted one by one.
    settings : dict, optional
        Plain data that fits depend on, beside the rig and the scans.
    existing : {"resume", "replace"}
    made_of_fits : sequence of Path
        Files that are removed with the fits where these are replaced, such as figures.
    n_samples : int, optional
        Of ``load_scan``.
    jobs : int, default 1
    reporter : optional
        With methods ``learning(stage, share, figures)``, ``training(share)``, ``fitted(name, entry, total)`` and ``kept(n)``.

    Returns
    -------
    Fits

    Raises
    ------
    InputError, FileError
        Fits that are there and were made otherwise; scans that nothing can be learned from.
    """
    folder, reporter = Path(folder), reporter or _Silent()
    read = {s.name: functools.partial(_load, s.path, n_samples, fitter.random_state) for s in scans}
    record = _Record.of(fitter.rig, scans, learn_from, settings or {})
    before = _Record.read(folder / _RECORD) if existing == "resume" and _any_made(folder) else None
    if before is not None:
        before.check(record, folder)
    fits = Fits(folder)
    if existing == "replace":
        for path in (*made_files(folder), *fit_files(folder, [s.name for s in scans]), *made_of_fits):  # of other scans, too
            path.unlink(missing_ok=True)
        remove_checkpoint(checkpoint_in(folder))
    (folder / _FITS).mkdir(exist_ok=True)
    learned = _learned_before(folder, fitter) if learn_from and before is not None else None
    same = set() if before is None else {s.name for s in scans if before.scans.get(s.name) == record.scans[s.name]}
    if learn_from and learned is None:
        same = set()
    kept = _kept(folder, sorted(same), learned or fitter, learn_from)
    fits.entries |= kept
    if kept:
        reporter.kept(len(kept))
    for scan in scans:
        if scan.name not in kept:  # before the record says that what is there is of this file and these settings
            _file(folder, scan.name).unlink(missing_ok=True)
    if learn_from and learned is None:  # a model that is there is somebody else's, and the record would vouch for it
        (folder / _MODEL).unlink(missing_ok=True)
    elif learn_from:
        record = replace(record, not_learned=before.not_learned)
    record.write(folder / _RECORD)
    if learn_from and learned is None:
        learned = _learn(fitter, learn_from, read, fits, reporter)
        why = getattr(learned, "failures_", {})  # models do not say it
        record = replace(record, not_learned={learn_from[i].name: why[i] for i in sorted(why)})
        record.write(folder / _RECORD)
    fits.not_learned = record.not_learned
    fits.history = [] if learned is None else learned.history_
    todo = [s for s in scans if s.name not in fits.entries]
    _fit_others(learned or fitter, todo, learn_from, read, fits, jobs, reporter)
    fits.entries = {s.name: fits.entries[s.name] for s in scans}
    return fits


def checkpoint_in(folder):
    """Where a folder keeps what an interrupted loop has done."""
    return checkpoint_of(Path(folder) / _MODEL)


def _load(path, n_samples, seed):
    from ..io.scans import load_scan

    return load_scan(path, n_samples=n_samples, random_state=seed)


def _learn(fitter, learn_from, read, fits, reporter):
    """Learn, and write fits and model; scans that cannot be used are left for later, and ``failures_`` says why."""
    kept = checkpoint_in(fits.folder)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* scans cannot be used; ")
        sources = [read[s.name] for s in learn_from]
        subjects = [s.subject for s in learn_from]
        checkpoint = kept if fitter._repeatable() else None
        fitter.fit(sources, subjects, cache=True, checkpoint=checkpoint, progress=reporter.learning)
    for scan, result in zip(learn_from, fitter.results_, strict=True):
        if result is not None and np.isfinite(result.vertices).all():
            fits.entries[scan.name] = _Save(fits.folder, [scan.name])(0, scan, result)
    fitter.save(fits.folder / _MODEL)  # last: it says that the fits are complete
    remove_checkpoint(kept)
    return fitter


def _fit_others(fitter, todo, learn_from, read, fits, jobs, reporter):
    """Fit scans one by one, those of a subject that was learned as this subject's."""
    from ..learning.batch import fit_scans

    known, names = _known_subjects(fitter, learn_from), [scan.name for scan in todo]

    def on_result(outcome):
        name = names[outcome.index]
        fits.entries[name] = outcome.result if outcome.error is None else {"failed": outcome.error}
        reporter.fitted(name, fits.entries[name] | {"seconds": round(outcome.seconds, 3)}, len(todo))

    fit_scans(
        fitter,
        [read[name] for name in names],
        subjects=[known.get(name) for name in names],
        n_jobs=jobs,
        finish=_Save(fits.folder, names),
        on_result=on_result,
        pretrain=lambda fitter: fitter.pretrain(cache=True, progress=reporter.training),
    )


def _known_subjects(fitter, learn_from):
    """Scan name → subject of the scans that a fitter has learned from, where it has a template of the subject.

    Others may have a subject of the same name who is another person, as the test scans of FAUST may.
    """
    templates = getattr(fitter, "template_", None) or {}
    return {s.name: s.subject for s in learn_from if s.subject in templates}


@dataclass(frozen=True)
class _Save:
    """``finish`` of ``fit_scans``: writes a fit and returns what is said of it; may be sent to another process."""

    folder: Path
    names: list

    def __call__(self, index, scan, result):
        result.save(_file(self.folder, self.names[index]))
        return _entry(result)


def _entry(result, kept=False):
    return {
        "status": result.status,
        "probability": round(result.probability, 4),
        "recon": result.terms["recon"],
        "scale": result.scale,
        "unit": result.unit,
        "seconds": round(result.seconds, 3),
        "points": len(result.labels),
        "message": result.message,
        "kept": kept,
    }


def _kept(folder, names, fitter, learn_from):
    """Scan name → what is said of its fit, for those whose fits are there and were made with this fitter."""
    from ..learning.archive import learned_digests, model_digest

    known, kept = _known_subjects(fitter, learn_from), {}
    anybody, learned = model_digest(fitter), learned_digests(fitter)
    refitted = {s: model_digest(fitter, s) for s in set(known.values())}
    for name in names:
        try:
            result = FitResult.load(_file(folder, name))
        except FileError:
            continue
        # Of a scan that was learned from, the fit that learning left, or a later one as its subject's.
        digests = (learned[known[name]], refitted[known[name]]) if name in known else (anybody,)
        if result.rig_digest == fitter.rig.digest and result.model_digest in digests:
            kept[name] = _entry(result, kept=True)
    return kept


def _learned_before(folder, fitter):
    """The fitter that has learned in an earlier run; None where it had not come so far."""
    path = folder / _MODEL
    if not path.is_file():
        return None
    try:
        learned = type(fitter).load(path)
    except LbsfitError:
        return None
    learned.n_jobs = fitter.n_jobs
    return learned if learned.rig.digest == fitter.rig.digest else None


def _any_made(folder):
    """Whether an earlier run has left fits or a model; steps know themselves what they are made of."""
    return any((folder / _FITS).glob("*.npz")) or (folder / _MODEL).is_file()


def _file(folder, name):
    return folder / _FITS / f"{name}.npz"


@dataclass(frozen=True)
class _Record:
    """What fits were made of."""

    settings: dict
    learned_from: dict
    scans: dict
    not_learned: dict = field(default_factory=dict)

    @classmethod
    def of(cls, rig, scans, learn_from, settings):
        digests = {s.name: _digest(s.path) for s in scans}
        learned_from = {s.name: [s.subject, digests[s.name]] for s in learn_from}
        return cls(json.loads(json.dumps(_described(rig) | settings)), learned_from, digests)

    @classmethod
    def read(cls, path):
        """None where there is none."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            return cls(content["settings"], content["learned_from"], content["scans"], content.get("not_learned", {}))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError):
            raise FileError(str(path), "a file that cannot be read", "a file that an earlier run has written", _REMEDY) from None

    def write(self, path):
        from ..io.write import write_json

        scans = (_Record.read(path).scans if path.is_file() else {}) | self.scans  # of a run with more scans, too
        known = {"settings": self.settings, "learned_from": self.learned_from, "scans": scans}
        write_json(path, known | ({"not_learned": self.not_learned} if self.not_learned else {}))

    def check(self, now, folder):
        """Raise where what is there was made with other settings."""
        other = [key for key in now.settings if self.settings.get(key) != now.settings[key]]
        if other:
            theirs, ours = (", ".join(f"{key} {_brief(of.get(key))}" for key in other) for of in (self.settings, now.settings))
            raise InputError("-o/--output", f"{folder}, with fits made with {theirs}", ours, _REMEDY)
        if self.learned_from != now.learned_from:
            theirs, ours = (f"{len(of.learned_from)} scans" if of.learned_from else "nothing" for of in (self, now))
            got = f"{folder}, with fits that learned from {theirs}"
            same = ", the same and unchanged" if now.learned_from else ""
            raise InputError("-o/--output", got, f"fits that learned from {ours}{same}", _REMEDY)


def _described(rig):
    """The code, and of a rig all that fits depend on, as errors call it."""
    facts = described(rig)
    of_rig = {"rig": facts.pop("digest")} | {f"rig's {key.replace('_', ' ')}": value for key, value in facts.items()}
    return {"code": state_of_the_code()} | of_rig


def _brief(value):
    return f"{value[:12]}…" if isinstance(value, str) and len(value) > 20 else value


def _digest(path):
    """Of the file's bytes; empty where it cannot be read, which the fit reports."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


class _Silent:
    """Tells nobody."""

    def learning(self, stage, share, figures=None): ...

    def training(self, share): ...

    def fitted(self, name, entry, total): ...

    def kept(self, n): ...
