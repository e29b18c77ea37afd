"""Rows of benchmarks with failures that may be no fault of the scans are done again; scans' own failures stay."""

import json

import pytest

from lbsfit_np.bench.baseline import PlainChamfer
from lbsfit_np.bench.run import BENCHES, run_bench
from lbsfit_np.bench.starts import starts_bench
from lbsfit_np.errors import InputError

ERRORS = {"unforeseen": MemoryError("no more"), "the scan's": InputError("points", "nothing", "something")}


@pytest.fixture(params=ERRORS)
def failing(request, monkeypatch):
    """PlainChamfer, the first fit of which fails, and whether that is done again."""
    fit, asked = PlainChamfer.fit_scan, []

    def sometimes(self, scan):
        asked.append(scan)
        if len(asked) == 1:
            raise ERRORS[request.param]
        return fit(self, scan)

    monkeypatch.setattr(PlainChamfer, "fit_scan", sometimes)
    return asked, request.param == "unforeseen"


def _again(report):
    return json.loads(json.dumps(report))  # as read from its file


def test_hand(shared_rigs, failing):
    asked, again = failing
    how = {"seeds": [7], "n_scans": 2, "training_scans": 60, "rows": ("plain",)}
    first, _ = run_bench(BENCHES["hand"], shared_rigs, **how)
    assert first["rows"]["plain"]["seeds"]["7"]["failed"] == 1 and len(asked) == 2
    second, _ = run_bench(BENCHES["hand"], shared_rigs, before=_again(first), **how)
    assert second["rows"]["plain"]["seeds"]["7"]["failed"] == (0 if again else 1)
    assert len(asked) == (4 if again else 2)


def test_starts(failing):
    asked, again = failing
    how = {"rows": ["0.3"], "fits": ("plain",), "n_scans": 2, "seed": 3, "training_scans": 60}
    first = starts_bench(["hand-coarse"], **how)
    second = starts_bench(["hand-coarse"], before=_again(first), **how)
    found = [r["rigs"]["hand-coarse"]["rows"]["0.3"]["fits"]["plain"]["failed"] for r in (first, second)]
    assert found == [1, 0 if again else 1] and len(asked) == (4 if again else 2)
