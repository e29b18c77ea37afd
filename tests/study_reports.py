"""Reports of the study with made-up figures."""

from dataclasses import asdict

from lbsfit_np.bench.environment import environment
from lbsfit_np.bench.study.data import SCAN, SIZES

# No two figures of a cell are alike, so that none can stand in another's place.
CELL = {
    "recon": 0.042,
    "recon_truth": 0.040,
    "pose": 0.011,
    "pose_median": 0.012,
    "pose_truth": 0.013,
    "vertices": 0.014,
    "corre": {"mean": 0.021, "p50": 0.022, "p90": 0.023, "p95": 0.024},
    "corre_snapped": {"mean": 0.031, "p50": 0.032, "p90": 0.033, "p95": 0.034},
    "unfitted": 0,
    "seconds": 77.0,
    "jobs": 2,
    "accuracy": [],
    "kept_accuracy": None,
    "gap": {},
    "kept_accuracy_scans": [],
    "history": [],
    "environment": environment(),
}


def report_of(kind="hand", **rows):
    """A report of one rig, its rows by name with "_" for "-": a cell, or one for each seed."""
    rows = {name.replace("_", "-"): cells if isinstance(cells, list) else [cells] for name, cells in rows.items()}
    seeds = {}
    for row, cells in rows.items():
        for k, cell in enumerate(cells):
            seeds.setdefault(str(300 + k), {})[row] = CELL | cell
    size = asdict(SIZES["small"]) | {"test": 20}  # enough to tell an order
    entry = {"kind": kind, "digest": "", "poses": "", "size": size, "seeds": seeds, "local_optimum": None}
    return {
        "benchmark": "study",
        "size": "small",
        "scan": asdict(SCAN),
        "training_seed": 0,
        "rigs": {kind: entry},
        "complete": True,
    }
