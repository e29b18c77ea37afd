"""Round trip: bundled rigs in natural poses, scanned with their own shape, and fitted again.

The least that a rig that ships has to do: pose → scan → fit has to come back to where it started.
"""

import time
from dataclasses import asdict

import numpy as np

from ..errors import InputError
from ..io.rigs import load_rig
from ..seeds import generator
from ..synthesis import Synthesis, natural_poses, synthesize_one
from .environment import environment
from .measure import joint_error, label_accuracy
from .resume import (
    begun,
    check_same,
    checked_count,
    checked_seeds,
    counted_by,
    described,
    in_order,
    is_done,
    renewed,
    unforeseen,
)
from .run import TRAINING_SEED
from .subjects import scans_digest

__all__ = ["AIM", "CLOSE", "RIGS", "SCAN", "roundtrip", "roundtrip_scans", "roundtrip_table"]

RIGS = ("hand", "body")
# A scan has come back if its mean joint error is at most this share of the rig's size, …
CLOSE = 0.02
# … and this share of the scans has to.
AIM = 0.95

# Noise, holes and uneven density as in training, no changed shape.
SCAN = Synthesis(n_points=5000, shape=0.0)


def roundtrip_scans(rig, n=40, *, seed):
    """``n`` scans of the rig's own shape with their truth, in poses near its library.

    The rig faces its own way but for turns within the root's limits (``synthesis.natural_poses``); :data:`SCAN` says the rest.
    """
    scans = []
    for i in range(n):
        rng = generator(seed, "roundtrip", i)
        scans.append(synthesize_one(rig, natural_poses(rig, 1, rng)[0], (rig.vertices, rig.joints), SCAN, rng))
    return scans


def roundtrip(
    names=RIGS,
    *,
    n_scans=40,
    seeds=(100,),
    training_scans=4000,
    jobs=1,
    before=None,
    progress=None,
    on_scan=None,
    on_seed=None,
):
    """Fit every rig's scans with the segmenter that pretraining gives, and compare with the truth.

    Parameters
    ----------
    names : sequence of str
        Rigs, as for ``load_rig``; each needs a library of natural poses.
    n_scans : int, default 40
        A seed.
    seeds : sequence of int, default (100,)
        Of the scans; what is trained has seed 0.
    training_scans : int, default 4000
    jobs : int, default 1
        Worker processes; errors do not depend on it.
    before : dict, optional
        A report of the same settings and rigs: the seeds that it has of a rig are not done again, unless scans failed as nobody
        foresaw.
    progress : callable (share), optional
        Of training.
    on_scan : callable (name, seed, done, total), optional
    on_seed : callable (report, name, seed), optional
        After each seed of each rig that was done, with the report so far.

    Returns
    -------
    dict
        Plain data for JSON. Of each rig and seed: each scan's mean joint error over the joints that move, in shares of the
        rig's size; their median, 95th percentile, and the share of at most :data:`CLOSE`, where a scan that failed counts
        as not close. "complete": all rigs, these and those of ``before``, have the same seeds.

    Raises
    ------
    InputError, FileError
        A rig that is not there or has no natural poses; arguments that cannot be used; a report of other settings or rigs.
    """
    from ..learning.fitter import LBSFitter

    n_scans, seeds = checked_count("n_scans", n_scans), checked_seeds(seeds)
    rigs = {name: load_rig(name) for name in names}
    for name, rig in rigs.items():
        if not rig.poses:
            raise InputError("rig", f"{name}, which has no library of natural poses", "a rig with one", "See: lbsfit rig list")
    settings = {"training_scans": training_scans, "scans_a_seed": n_scans, "test_scans": asdict(SCAN)}
    empty = {"benchmark": "roundtrip", "close": CLOSE, "aim": AIM, "settings": settings, "rigs": {}}
    report = renewed(begun(before, empty, same=("close", "settings")), empty) | {"complete": False}
    known = {name: _described(rig) for name, rig in rigs.items()}
    for name in known:
        check_same(report["rigs"].get(name, known[name]), known[name], name)
    for name, rig in rigs.items():
        entry = report["rigs"].get(name, known[name] | {"seeds": {}})
        todo = [seed for seed in seeds if not is_done(entry["seeds"].get(str(seed)))]
        if not todo:
            continue
        parameters = {"training_scans": training_scans, "n_jobs": jobs, "random_state": TRAINING_SEED}
        fitter = LBSFitter(rig, orientation="aligned", **parameters)  # the root is turned within its limits
        fitter.pretrain(cache=True, progress=progress)
        for seed in todo:
            say = None if on_scan is None else (lambda done, name=name, seed=seed: on_scan(name, seed, done, n_scans))
            entry["seeds"][str(seed)] = _fit_seed(fitter, rig, roundtrip_scans(rig, n_scans, seed=seed), jobs, say)
            entry["all"] = _figures([e for s in in_order(entry["seeds"]).values() for e in s["scans"]])
            report["rigs"][name] = entry
            if on_seed is not None:
                on_seed(report, name, seed)
    report["rigs"] = {name: report["rigs"][name] for name in (*rigs, *report["rigs"])}  # files have the order of the alphabet
    report["complete"] = len({frozenset(entry["seeds"]) for entry in report["rigs"].values()}) == 1
    return report


def _described(rig):
    """What the entry of a rig begins with; by the scans it shows that they are made as they were."""
    scans = scans_digest(rig, roundtrip_scans(rig, 1, seed=0))
    return described(rig) | {"scans": scans, "size": rig.size, "vertices": len(rig.vertices)}


class _Measured:
    """``finish`` of ``each_scan``: figures in place of the fit."""

    def __init__(self, rig, scans):
        self.rig, self.truth = rig, [(s.joints, s.labels) for s in scans]

    def __call__(self, index, scan, result):
        joints, labels = self.truth[index]
        return {
            "joint_error": joint_error(result.joints, joints, self.rig.moving) / self.rig.size,
            "labels": label_accuracy(result.labels, labels),
            "seconds": result.seconds,
            "converged": result.converged,
        }


def _fit_seed(fitter, rig, scans, jobs, on_scan):
    from ..learning.batch import each_scan

    started = time.perf_counter()
    points = [scan.points for scan in scans]
    outcomes = each_scan(fitter, points, n_jobs=jobs, finish=_Measured(rig, scans), on_result=counted_by(on_scan))
    wall = time.perf_counter() - started
    entries = [{"scan": o.index} | ({"failed": o.error} if o.result is None else o.result) for o in outcomes]
    made = {"jobs": jobs, "environment": environment(), **unforeseen({e["scan"]: e.get("failed") for e in entries})}
    return _figures(entries) | {"wall_seconds": round(wall, 2), **made, "scans": entries}


def _figures(entries):
    good = [e for e in entries if "failed" not in e]
    errors = np.array([e["joint_error"] for e in good])
    return {
        "median": float(np.median(errors)) if good else None,
        "p95": float(np.percentile(errors, 95)) if good else None,
        "close": float((errors <= CLOSE).sum() / len(entries)),
        "labels": float(np.mean([e["labels"] for e in good])) if good else None,
        "seconds": float(np.mean([e["seconds"] for e in good])) if good else None,
        "failed": len(entries) - len(good),
    }


def roundtrip_table(report, *, markdown=False):
    """The figures of a report of :func:`roundtrip` in rows, one for each rig and seed, and what was to be reached."""
    from .table import layout, of_states

    close = f"≤ {100 * report['close']:g} %"
    rows = [("rig", "seed", "median", "95th", close, "labels", "s a scan", "failed")]
    for name, entry in report["rigs"].items():
        seeds = list(in_order(entry["seeds"]).items())
        for seed, figures in [*seeds, *([("all", entry["all"])] if len(seeds) > 1 else [])]:
            rows.append((name, seed, *_cells(figures)))
    n, training = (report["settings"][key] for key in ("scans_a_seed", "training_scans"))
    legend = (
        f"{n} scans a seed in natural poses, the rig's own shape. Mean joint errors in % of the rig's size: median, 95th\n"
        f"percentile, and the share of scans with at most {100 * report['close']:g} % (aim: at least "
        f"{100 * report['aim']:g} %). Segmenter trained on {training} synthetic scans."
    )
    made = [(name, in_order(entry["seeds"])) for name, entry in report["rigs"].items()]
    states = of_states((f"{name} {seed}", run) for name, seeds in made for seed, run in seeds.items())
    return f"{layout(rows, markdown=markdown)}\n\n{legend}{states}"


def _cells(figures):
    def cell(key, factor, style):
        return "–" if figures[key] is None else format(factor * figures[key], style)

    yield from (cell("median", 100, ".2f"), cell("p95", 100, ".2f"), cell("close", 100, ".1f") + " %")
    yield from (cell("labels", 1, ".3f"), cell("seconds", 1, ".2f"), str(figures["failed"]))
