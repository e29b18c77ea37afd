"""Starts: the share of scans that are fitted rightly under many conditions, and whether the fits know when they are not.

Each row of the table is one of ``conditions.CONDITIONS``, fitted as users fit it: with the segmenter that pretraining gives,
and no hints but the orientation and the kind of scan that the condition is about.
"""

import time
from dataclasses import asdict, dataclass

import numpy as np

from ..errors import InputError, in_words
from ..fitting.assemble import GUESS
from ..io.rigs import load_rig
from .baseline import PlainChamfer
from .conditions import CONDITIONS, SEEN, conditions_of, starts_scan
from .environment import environment
from .measure import joint_error
from .resume import begun, check_same, checked_count, described, is_done, renewed, unforeseen
from .run import TRAINING_SEED

__all__ = [
    "AIM_AUC",
    "AIM_CAUGHT",
    "CONDITIONS",
    "FITS",
    "PROBABLE",
    "RIGS",
    "counted_joints",
    "starts_bench",
    "starts_scan",
    "starts_table",
]

RIGS = ("hand", "body")
FITS = {"own": "own segmenter", "plain": "plain Chamfer", "oracle": "true labels"}
# To be reached by the fits' own probability of being right, over all rows: area under the ROC curve for telling failures, …
AIM_AUC = 0.97
# … and the share of failures that a threshold catches which calls this share of the right fits failures.
AIM_CAUGHT = 0.80
_FALSE_ALARMS = 0.01
# What FitResult.probability is the probability of: an error below this share of the size.
PROBABLE = 0.015
_BINS = 5
# A joint further off than this share of the size is wrong; fits are to say of it that it is a guess.
_WRONG = 0.05


def starts_bench(
    names=RIGS,
    *,
    rows=None,
    fits=("own",),
    n_scans=100,
    seed=200,
    effort="balanced",
    training_scans=4000,
    jobs=1,
    before=None,
    progress=None,
    on_scan=None,
    on_row=None,
):
    """Fit the scans of every row for every rig, and compare with the truth.

    Parameters
    ----------
    names : sequence of str
        Rigs, as for ``load_rig``; each needs a library of natural poses.
    rows : sequence of str, optional
        Of ``CONDITIONS``; all by default. A rig takes part in the rows that are for it.
    fits : sequence of str
        Of ``FITS``. Scans with points that are of no part have no true labels to give: there "oracle" is left out.
    n_scans : int, default 100
        A row.
    seed : int, default 200
        Of the scans; what is trained has seed 0. Scans do not depend on the other arguments.
    effort : str, default "balanced"
        Of ``LBSFitter``.
    training_scans : int, default 4000
    jobs : int, default 1
        Worker processes; errors do not depend on it.
    before : dict, optional
        A report of the same settings: what it has is not done again, unless scans failed as nobody foresaw.
    progress : callable (share), optional
        Of training.
    on_scan : callable (name, row, fit, done, total), optional
    on_row : callable (report, name, row, fit), optional
        After each row of each rig and way of fitting that was done, with the report so far.

    Returns
    -------
    dict
        Plain data for JSON. Errors are mean joint errors in shares of the rig's size, times the scan's true scale.

    Raises
    ------
    InputError, FileError
        A rig that is not there or lacks what the rows need; arguments that cannot be used; a report of other settings or rigs.
    """
    from ..learning.fitter import LBSFitter

    n_scans = checked_count("n_scans", n_scans)
    rigs = {name: load_rig(name) for name in names}
    todo = _plan(rigs, rows, fits)
    settings = {"seed": seed, "scans_a_row": n_scans, "effort": effort, "training_scans": training_scans}
    empty = {"benchmark": "starts", "settings": settings, "rigs": {}, "confidence": None}
    report = renewed(begun(before, empty), empty) | {"complete": False}
    for name, rig in rigs.items():
        _check_rig(report, name, rig)
    if report["rigs"]:
        report["confidence"] = _confidence(report)
    for name, row, fit in todo:
        rig, condition = rigs[name], CONDITIONS[row]
        entry = _row_entry(report, name, rig, row, condition)
        if is_done(entry["fits"].get(fit)):
            continue
        parameters = {"training_scans": training_scans, "effort": effort, "n_jobs": jobs, "random_state": TRAINING_SEED}
        fitter = LBSFitter(rig, **parameters | condition.fitter)
        if fit == "own":
            fitter.pretrain(cache=True, progress=progress)
        one = _OneScan(rig, row, seed, fit, PlainChamfer(rig) if fit == "plain" else fitter)
        say = None if on_scan is None else (lambda done, at=(name, row, fit): on_scan(*at, done, n_scans))
        entry["fits"][fit] = _fit_row(one, n_scans, condition.close, jobs, say)
        report["confidence"] = _confidence(report)
        if on_row is not None:
            on_row(report, name, row, fit)
    report["complete"] = True
    return report


def _plan(rigs, rows, fits):
    """Triples (rig, row, fit) in the order of the table, once all that is asked for is known to be possible."""
    if not fits or not set(fits) <= set(FITS):
        raise InputError("fits", repr(fits), f"some of {', '.join(FITS)}")
    if rows is not None and (not rows or not set(rows) <= set(CONDITIONS)):
        raise InputError("rows", repr(rows), f"some of {', '.join(CONDITIONS)}")
    possible = {name: conditions_of(rig) for name, rig in rigs.items()}
    todo = [
        (name, row, fit)
        for fit in FITS
        for row in CONDITIONS
        for name in rigs
        if fit in fits and row in possible[name] and (rows is None or row in rows)
        if fit != "oracle" or CONDITIONS[row].labelled
    ]
    if not todo:
        got = f"{', '.join(rows or ())} with fits {', '.join(fits)} for {', '.join(rigs)}"
        raise InputError("rows", got, "a row that applies to one of the rigs; for the fit oracle, one with labels")
    return todo


def _facts(rig):
    """What the entry of a rig says of it."""
    return described(rig) | {"size": rig.size, "vertices": len(rig.vertices)}


def _check_rig(report, name, rig):
    """Raise where the report has rows of a rig of that name with another mesh or card; earlier reports say less of it."""
    kept = report["rigs"].get(name, {})
    check_same(kept, {key: value for key, value in _facts(rig).items() if key in kept}, name)


def _row_entry(report, name, rig, row, condition):
    """Where the figures of a row are kept; emptied where they are of another condition."""
    asked = {key: getattr(condition, key) for key in ("what", "goal", "close", "fitter", "unit", "subjects")}
    asked["scan"] = asdict(condition.scan)
    kept = report["rigs"].setdefault(name, {"rows": {}})
    kept |= _facts(rig)
    entry = kept["rows"].get(row, {})
    if entry.get("condition") != asked:
        entry = kept["rows"][row] = {"condition": asked, "fits": {}}
    return entry


# ---- one row ----


@dataclass(frozen=True)
class _OneScan:
    """i → the figures of one scan's fit; made to be sent to another process."""

    rig: object
    row: str
    seed: int
    fit: str
    fitter: object

    def __call__(self, i):
        scan = starts_scan(self.rig, self.row, i, self.seed)
        counted = counted_joints(self.rig, CONDITIONS[self.row], scan)
        if not counted.any():
            return {"scan": i, "failed": f"no joint counts: no part that moves has {SEEN} points", "seconds": 0.0}
        started = time.perf_counter()
        try:
            result = self._fitted(scan)
        except Exception as error:  # noqa: BLE001 (whatever is wrong with one scan is that scan's failure)
            return {"scan": i, "failed": in_words(error), "seconds": time.perf_counter() - started}
        if not np.isfinite(result.joints).all():
            return {"scan": i, "failed": result.message, "seconds": result.seconds}
        return {
            "scan": i,
            "joint_error": joint_error(result.joints, scan.joints, counted) / (self.rig.size * scan.scale),
            "joints": int(counted.sum()),
            **self._each_joint(result, scan),
            "scale_error": float(result.scale / scan.scale - 1),
            "probability": result.probability,
            "evidence": result.evidence,
            "status": result.status,
            "message": result.message,
            "seconds": result.seconds,
        }

    def _each_joint(self, result, scan):
        """Of the joints that move, hidden ones too, in shares of the size; nothing where no ``joint_std`` is known."""
        lengths = {"each_error": np.linalg.norm(result.joints - scan.joints, axis=1), "each_std": result.joint_std}
        if not np.isfinite(result.joint_std).all():
            return {}
        return {key: (of[self.rig.moving] / (self.rig.size * scan.scale)).round(6).tolist() for key, of in lengths.items()}

    def _fitted(self, scan):
        if self.fit == "oracle":
            return self.fitter.fit_scan(scan.points, labels=scan.labels)
        return self.fitter.fit_scan(scan if self.fit == "plain" else scan.points)


def counted_joints(rig, condition, scan):
    """(J,) bool: the joints that count: those that move, and of a scan that does not show all those whose part it shows."""
    if not (condition.scan.one_sided or condition.scan.cropped):
        return rig.moving
    points = np.bincount(scan.labels[scan.labels >= 0], minlength=len(rig.parts))
    return rig.moving & (points[rig.part_of_joint] >= SEEN)


def _fit_row(one, n_scans, close, jobs, on_scan):
    from ..workers import each

    started = time.perf_counter()
    done = None if on_scan is None else (lambda share: on_scan(round(share * n_scans)))
    scans = each(one, range(n_scans), jobs=jobs, done=done)
    errors = np.array([e["joint_error"] for e in scans if "failed" not in e])
    return {
        "success": float((errors <= close).sum() / n_scans),
        "median": float(np.median(errors)) if len(errors) else None,
        "p95": float(np.percentile(errors, 95)) if len(errors) else None,
        "seconds": float(np.mean([e["seconds"] for e in scans])),
        "failed": n_scans - len(errors),
        **unforeseen({e["scan"]: e.get("failed") for e in scans}),
        "wall_seconds": round(time.perf_counter() - started, 2),
        "jobs": jobs,
        "environment": environment(),
        "scans": scans,
    }


def _error(scan):
    """Of a scan, infinite where it has none; JSON has None for what is not a number."""
    error = scan.get("joint_error")
    return error if error is not None and np.isfinite(error) else np.inf


# ---- do fits know when they failed? ----


def _confidence(report):
    """How well the own fits' probability tells failures from successes, all rows and rigs together.

    A fit that raised has said that it failed: its probability is 0. A failure is what the row calls one.
    """
    wrong, p, exact = [], [], []
    for entry in report["rigs"].values():
        for row in entry["rows"].values():
            for scan in row["fits"].get("own", {}).get("scans", ()):
                error = _error(scan)
                wrong.append(error > row["condition"]["close"])
                exact.append(error <= PROBABLE)
                p.append(scan.get("probability", 0.0))
    wrong, p, exact = np.array(wrong, dtype=bool), np.array(p, dtype=float), np.array(exact, dtype=bool)
    out = {"scans": len(p), "failures": int(wrong.sum()), "auc": None, "caught": None, "calibration": _calibration(p, exact)}
    if 0 < wrong.sum() < len(wrong):
        from sklearn.metrics import roc_auc_score, roc_curve

        out["auc"] = float(roc_auc_score(wrong, -p))
        false_alarms, caught, _ = roc_curve(wrong, -p, drop_intermediate=False)
        out["caught"] = float(caught[false_alarms <= _FALSE_ALARMS].max())
    return out | {"joints": _joint_confidence(report)}


def _joint_confidence(report):
    """Of the joints of fits that call themselves right: whether ``joint_std`` tells those that are wrong; None without any."""
    rows = [row["fits"].get("own", {}).get("scans", ()) for entry in report["rigs"].values() for row in entry["rows"].values()]
    sure = [scan for scans in rows for scan in scans if scan.get("status") == "ok" and "each_std" in scan]
    if not sure:
        return None
    error, std = (np.concatenate([scan[key] for scan in sure]) for key in ("each_error", "each_std"))
    wrong, guess = error > _WRONG, std > GUESS
    return {
        "joints": len(error),
        "wrong": int(wrong.sum()),
        "wrong_told": float(guess[wrong].mean()) if wrong.any() else None,
        "right_called_guesses": float(guess[~wrong].mean()) if not wrong.all() else None,
        "within_two_std": float((error <= 2 * std).mean()),
    }


def _calibration(p, exact):
    """Of fits whose probability is in one range: how many, their mean probability, and the share that is right."""
    place = np.minimum((p * _BINS).astype(int), _BINS - 1)
    bins = [place == k for k in range(_BINS) if (place == k).any()]
    return [{"scans": int(b.sum()), "probability": float(p[b].mean()), "right": float(exact[b].mean())} for b in bins]


# ---- the table ----


def starts_table(report, *, markdown=False):
    """The figures of a report of :func:`starts_bench`: a row for each condition and rig, and what fits know about themselves."""
    from .table import layout, of_states

    others = [fit for fit in FITS if fit != "own" and _any_fit(report, fit)]
    lines = [("condition", "rig", "goal", "reached", "median", "95th", "s a scan", *(FITS[fit] for fit in others))]
    for row, condition in CONDITIONS.items():
        for name, entry in report["rigs"].items():
            if row in entry["rows"]:
                figures = entry["rows"][row]["fits"]
                star = "" if condition.close == PROBABLE else "*"
                goal = f"{100 * condition.goal:.0f} %"
                lines.append((condition.what + star, name, goal, *_cells(figures.get("own")), *_shares(figures, others)))
    states = of_states(
        (f"{name} {row} {fit}", figures)
        for name, entry in report["rigs"].items()
        for row, content in entry["rows"].items()
        for fit, figures in content["fits"].items()
    )
    return f"{layout(lines, markdown=markdown)}\n\n{_legend(report)}{states}"


def _any_fit(report, fit):
    return any(fit in row["fits"] for entry in report["rigs"].values() for row in entry["rows"].values())


def _cells(figures):
    if figures is None:
        return ("–",) * 4
    errors = ("–" if figures[key] is None else f"{100 * figures[key]:.2f}" for key in ("median", "p95"))
    return (f"{100 * figures['success']:.1f} %", *errors, f"{figures['seconds']:.2f}")


def _shares(figures, fits):
    return (f"{100 * figures[fit]['success']:.1f} %" if fit in figures else "–" for fit in fits)


def _legend(report):
    settings = report["settings"]
    trained = f"; segmenter trained on {settings['training_scans']} synthetic scans" if _any_fit(report, "own") else ""
    lines = [
        f"{settings['scans_a_row']} scans a row, seed {settings['seed']}, effort {settings['effort']}{trained}.",
        "Reached: share of the scans whose mean joint error is at most 1.5 % (* 3 %) of the rig's size. Median and 95th",
        "percentile: of these errors, in % of the size. Further columns: the same share for other ways of fitting.",
    ]
    if failed := sum(f["failed"] for e in report["rigs"].values() for r in e["rows"].values() for f in r["fits"].values()):
        lines.append(f"Without scans that could not be fitted: {failed} in all rows; they count as not reached.")
    known = report["confidence"] or {"auc": None}
    if known["auc"] is not None:
        lines += [
            f"{known['failures']} of {known['scans']} fits failed. Told by the fits' own probability: area under the ROC curve "
            f"{known['auc']:.3f} (goal {AIM_AUC:g}),",
            f"{100 * known['caught']:.0f} % of the failures caught at {100 * _FALSE_ALARMS:g} % false alarms "
            f"(goal {100 * AIM_CAUGHT:.0f} %).",
        ]
    joints = known.get("joints")
    if joints is not None:
        called = "called guesses by joint_std"
        told = "" if not joints["wrong"] else f", {100 * joints['wrong_told']:.0f} % of them {called}"
        others = joints["right_called_guesses"]
        if others is not None:
            told += f";\nof the others {100 * others:.1f} % are" if told else f";\n{100 * others:.1f} % are {called}"
        told += "."
        lines += [
            f"Of {joints['joints']} joints, hidden ones too, of fits that call themselves right {joints['wrong']} are off by",
            f"more than {100 * _WRONG:g} % of the size{told} Within twice their joint_std are "
            f"{100 * joints['within_two_std']:.0f} % of all.",
        ]
    return "\n".join(lines)
