"""The benchmarks: each row fits the same scans in another way; figures against the truth, by scan, by seed, over seeds."""

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError
from ..scan import Scan
from .environment import environment
from .measure import joint_error, label_accuracy, recon, vertex_error
from .resume import begun, check_same, checked_count, checked_seeds, counted_by, described, is_done, renewed, unforeseen
from .subjects import files_digest, scans_digest

__all__ = ["BENCHES", "MEASURES", "ROWS", "TRAINING_SEED", "Bench", "run_bench", "with_segmenter"]

# Of everything that the package learns; the test's seeds are others, and their streams have keys of their own besides.
TRAINING_SEED = 0


@dataclass(frozen=True)
class Bench:
    """One benchmark set.

    Attributes
    ----------
    name : str
    module : str
        Of this package; has a function NAME_rig(data), a function NAME_scans(rig, data, n, seed=) and SCAN.
    n_scans : int
        Scans a seed, by default.
    unit : str
        Of the lengths in the results.
    aims : dict of str to float
        Measure → the figure to reach.
    files : tuple of str
        What the data folder must hold, as patterns.
    kinds : tuple of str
        Scan i of a seed is of kind i modulo their number.
    """

    name: str
    module: str
    n_scans: int
    unit: str
    aims: dict
    files: tuple
    kinds: tuple

    def load(self):
        """(rig function, scans function, how scans are made)."""
        from importlib import import_module

        home = import_module(f".{self.module}", __package__)
        return getattr(home, f"{self.name}_rig"), getattr(home, f"{self.name}_scans"), home.SCAN

    def rig_units(self, rig):
        """What one unit of the results is, in rig units."""
        return rig.size / 2 if self.unit == "half sizes" else 0.01 / rig.metres_per_unit

    def check_data(self, data):
        """Raise unless the folder is there with all that this benchmark reads."""
        folder = Path(data)
        expected = f"a folder that holds {', '.join(sorted({f.split('/')[0] for f in self.files}))}"
        if not folder.is_dir():
            raise FileError(str(data), "a file" if folder.exists() else "no such folder", expected)
        missing = [f for f in self.files if not any(folder.glob(f))]
        if missing:
            raise FileError(str(data), f"a folder without {' and '.join(missing)}", expected)

    def data_digest(self, data):
        """Hex digest of the files that this benchmark reads."""
        return files_digest(path for f in self.files for path in sorted(Path(data).glob(f)))


BENCHES = {
    "hand": Bench(
        "hand",
        "hand",
        40,
        "half sizes",
        {"labels": 0.85, "joint_error": 0.045, "vertex_error": 0.05},
        ("webxr_hand/left.glb", "hand_poses/*.handpose"),
        ("uniform pose", "natural pose"),
    ),
    "body": Bench(
        "body",
        "body",
        20,
        "cm",
        {"joint_error": 3.0},
        ("mpfb2_body/mpfb2_cmu_mb.npz", "motion/01_01.bvh"),
        ("male_avg", "male_heavy"),
    ),
}

ROWS = {
    "own": "own segmenter",
    "plain": "plain Chamfer from rest",
    "oracle": "true labels given",
    "paper": "own segmenter, the paper's weights, no registration",
}
# Those that are fitted with the segmenter that pretraining gives.
_WITH_SEGMENTER = ("own", "paper")
# What runs unless other rows are asked for.
USUAL_ROWS = ("own", "plain", "oracle")

# Each figure of a scan; lengths in the benchmark's unit.
MEASURES = {
    "joint_error": "mean distance of the unlocked joints from the true ones",
    "vertex_error": "mean distance of the registered vertices from the true ones",
    "segmenter_labels": "share of points that the segmenter alone labels right, before any fit",
    "labels": "share of the scan's points that the result labels right",
    "recon": "√L_c between the scan and the registered vertices",
    "recon_truth": "the same at the true vertices",
    "seconds": "for the fit of the scan, the segmenter's share included",
    "evaluations": "evaluations of an objective, all stages together",
}


def run_bench(
    bench,
    data,
    *,
    seeds=(100, 101, 102),
    n_scans=None,
    training_scans=4000,
    jobs=1,
    cache=True,
    rows=USUAL_ROWS,
    before=None,
    training_progress=None,
    on_scan=None,
    on_row=None,
):
    """Run one benchmark.

    Parameters
    ----------
    bench : Bench
    data : str or Path
        The folder of real rigs, poses and motion.
    seeds : sequence of int
        Of the test's scans; what is trained has seed 0 whatever these are.
    n_scans : int, optional
        A seed; the benchmark's own number by default.
    training_scans : int, default 4000
    jobs : int, default 1
        Worker processes. Errors do not depend on it; seconds may, where processes share cores.
    cache : bool, default True
        Whether to use the cache of segmenters.
    rows : sequence of str
        Of ``ROWS``.
    before : dict, optional
        A report of the same settings, rig, data and scans: the rows that it has of a seed are not done again, unless scans of
        theirs failed as nobody foresaw.
    training_progress : callable (share), optional
    on_scan : callable (row, seed, done, total), optional
    on_row : callable (report, row, seed, fits), optional
        After each row of each seed that was done, with the report so far, and the fits as below.

    Returns
    -------
    report : dict
        Plain data for JSON. "complete": all rows, these and those of ``before``, have the same seeds.
    fits : dict of int to list of (SyntheticScan, FitResult or None, dict)
        The fits of row "own" that were done, with their truth and figures, by seed.

    Raises
    ------
    FileError, InputError
        The data folder lacks something; arguments that cannot be used; a report of something else.
    """
    from ..learning.fitter import LBSFitter

    bench.check_data(data)
    seeds = checked_seeds(seeds)
    if not rows or not set(rows) <= set(ROWS):
        raise InputError("rows", repr(rows), f"some of {', '.join(ROWS)}")
    make_rig, make_scans, synthesis = bench.load()
    n_scans = bench.n_scans if n_scans is None else checked_count("n_scans", n_scans)
    rig = make_rig(data)
    # All scans face the rig's way.
    fitter = LBSFitter(rig, orientation="aligned", training_scans=training_scans, n_jobs=jobs, random_state=TRAINING_SEED)
    read = {"data": bench.data_digest(data), "scans": scans_digest(rig, make_scans(rig, data, 2, seed=0))}
    empty = _report(bench, rig, fitter, synthesis, seeds, n_scans) | read
    report = begun(before, empty, same=("unit", "scans_a_seed", "settings"))
    check_same(report["rig"], described(rig))
    check_same(report, read)
    report = renewed(report, empty) | {"complete": False}
    report["seeds"] = sorted({*report["seeds"], *seeds})
    there = {row: content["seeds"] for row, content in report["rows"].items()}
    todo = {seed: [row for row in rows if not is_done(there.get(row, {}).get(str(seed)))] for seed in seeds}
    fits = {}
    if any(with_segmenter(left) for left in todo.values()):
        started = time.perf_counter()
        fitter.pretrain(cache=cache, progress=training_progress)
        report.setdefault("training_seconds", round(time.perf_counter() - started, 2))  # later runs find it in the cache
    for seed, left in todo.items():
        scans = make_scans(rig, data, n_scans, seed=seed) if left else []
        for row in left:
            say = None if on_scan is None else (lambda done, row=row, seed=seed: on_scan(row, seed, done, n_scans))
            started = time.perf_counter()
            entries, results = _fit_row(_method(row, rig, fitter), scans, bench, rig, jobs, say)
            wall = round(time.perf_counter() - started, 2)
            made = {"wall_seconds": wall, "jobs": jobs, "environment": environment()}
            content = report["rows"].setdefault(row, {"what": ROWS[row], "seeds": {}})
            content["seeds"][str(seed)] = _seed_entry(entries) | made
            content["over_seeds"] = _over_seeds(content["seeds"].values())
            found = list(zip(scans, results, entries, strict=True))
            if row == "own":
                fits[seed] = found
            if on_row is not None:
                on_row(report, row, seed, found)
    report["complete"] = len({frozenset(content["seeds"]) for content in report["rows"].values()}) == 1
    return report, fits


def with_segmenter(rows):
    """Whether any of these rows takes a segmenter."""
    return not set(rows).isdisjoint(_WITH_SEGMENTER)


# ---- the ways to fit ----


@dataclass(frozen=True)
class _Own:
    """As users fit."""

    rig: object
    fitter: object

    def fit_scan(self, scan):
        return self.fitter.fit_scan(scan.points)

    def segmenter_labels(self, scan):
        """(true labels, the segmenter's) of as many points as a fit looks at, as density counts for descriptors."""
        rows = Scan(scan.points).thinned(self.fitter.max_points)
        points = scan.points[rows]
        return scan.labels[rows], self.fitter.segmenter_.predict(points)


@dataclass(frozen=True)
class _Oracle:
    """Every point's true label is given: what the labels cost."""

    rig: object
    fitter: object

    def fit_scan(self, scan):
        return self.fitter.fit_scan(scan.points, labels=scan.labels)


def _method(row, rig, fitter):
    from sklearn.base import clone

    from ..learning.pretraining import share_pretraining

    if row == "own":
        return _Own(rig, fitter)
    if row == "paper":
        other = clone(fitter).set_params(weights="paper", registration=False)
        share_pretraining(fitter, other)
        return _Own(rig, other)
    if row == "oracle":
        return _Oracle(rig, clone(fitter))  # without the segmenter
    from .baseline import PlainChamfer

    return PlainChamfer(rig)


# ---- from fits to figures ----


@dataclass(frozen=True)
class _Measured:
    """``finish`` of ``each_scan``: figures and the fit itself."""

    method: object
    unit: float

    def __call__(self, index, scan, result):
        u = self.unit
        figures = {
            "joint_error": joint_error(result.joints, scan.joints, self.method.rig.moving) / u,
            "vertex_error": vertex_error(result.vertices, scan.vertices) / u,
            "recon": recon(scan.points, result.vertices) / u,
            "recon_truth": recon(scan.points, scan.vertices) / u,
            "seconds": result.seconds,
            "evaluations": result.evaluations,
        }
        if not isinstance(self.method, _Oracle):
            figures["labels"] = label_accuracy(result.labels, scan.labels)
        if isinstance(self.method, _Own):
            true, found = self.method.segmenter_labels(scan)
            figures["segmenter_labels"] = label_accuracy(found, true)
        return figures, result


def _fit_row(method, scans, bench, rig, jobs, on_scan):
    """(entries, results) of all scans, in order."""
    from ..learning.batch import each_scan

    finish = _Measured(method, bench.rig_units(rig))
    outcomes = each_scan(method, scans, n_jobs=jobs, finish=finish, on_result=counted_by(on_scan))
    entries, results = [], []
    for i, outcome in enumerate(outcomes):
        entry = {"scan": i, "kind": bench.kinds[i % len(bench.kinds)]}
        if outcome.error is None:
            figures, result = outcome.result
            entries.append(entry | figures | {"converged": result.converged, "message": result.message})
            results.append(result)
        else:
            entries.append(entry | {"failed": outcome.error})
            results.append(None)
    return entries, results


def _seed_entry(entries):
    good = [e for e in entries if "failed" not in e]
    kinds = sorted({e["kind"] for e in good})
    return {
        "mean": _figures(good, np.mean),
        "median": _figures(good, np.median),
        "mean_by_kind": {kind: _figures([e for e in good if e["kind"] == kind], np.mean) for kind in kinds},
        "failed": len(entries) - len(good),
        **unforeseen({e["scan"]: e.get("failed") for e in entries}),
        "scans": entries,
    }


def _figures(entries, average):
    """Measure → average, over those that have it."""
    out = {}
    for measure in MEASURES:
        values = [e[measure] for e in entries if measure in e]
        if values:
            out[measure] = float(average(values))
    return out


def _over_seeds(seeds):
    """The median over the seeds of their means, and of their medians."""
    seeds = list(seeds)
    return {
        "mean": _figures([s["mean"] for s in seeds], np.median),
        "median": _figures([s["median"] for s in seeds], np.median),
        "failed": sum(s["failed"] for s in seeds),
    }


def _report(bench, rig, fitter, synthesis, seeds, n_scans):
    """A report without rows."""
    from ..fitting.scan_fit import FitSettings
    from ..losses.objective import as_weights
    from .baseline import PlainChamfer

    parameters = {name: value for name, value in fitter.get_params(deep=False).items() if name not in ("rig", "n_jobs")}
    fit = FitSettings(weights=as_weights(fitter.weights), scale=fitter.scale, max_points=fitter.max_points)
    plain = PlainChamfer(rig)
    settings = {
        "fitter": parameters,
        "fit": asdict(fit),
        "plain": {"pose_iterations": plain.pose_iterations, "full_iterations": plain.full_iterations},
        "test_scans": asdict(synthesis),
    }
    return {
        "benchmark": bench.name,
        "unit": bench.unit,
        "rig_units_in_a_unit": bench.rig_units(rig),
        "measures": MEASURES,
        "aims": bench.aims,
        "rig": {
            "name": rig.name,
            **described(rig),
            "size": rig.size,
            "vertices": len(rig.vertices),
            "moving_joints": int(rig.moving.sum()),
            "parts": rig.parts,
        },
        "seeds": seeds,
        "scans_a_seed": n_scans,
        "settings": json.loads(json.dumps(settings)),  # as a file has them
        "rows": {},
    }
