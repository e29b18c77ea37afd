"""Numbers of scans that the benchmarks cannot take are named before anything is trained or made."""

from functools import partial

import numpy as np
import pytest

from lbsfit_np.bench.learn import learn_bench
from lbsfit_np.bench.people import people_scans
from lbsfit_np.bench.resume import checked_count
from lbsfit_np.bench.roundtrip import roundtrip
from lbsfit_np.bench.run import BENCHES, run_bench
from lbsfit_np.bench.starts import starts_bench
from lbsfit_np.errors import InputError


@pytest.mark.parametrize("n", [0, -1, 2.5, 3.0, True, "3", None, np.array([3, 4])])
def test_what_is_no_number_of_scans(n):
    with pytest.raises(InputError, match="^n_scans: got .*; expected (a whole number of )?at least 1.$"):
        checked_count("n_scans", n)


def test_numbers_of_scans():
    assert type(checked_count("n_scans", np.int8(3))) is int and checked_count("n_scans", 3, 3) == 3
    with pytest.raises(InputError, match="people: got 1; expected at least 2, as pairs.$"):
        checked_count("people", 1, 2, ", as pairs")


@pytest.mark.parametrize(
    "bench",
    [
        lambda data: partial(roundtrip, ["hand-coarse"]),
        lambda data: partial(starts_bench, ["hand-coarse"]),
        lambda data: partial(run_bench, BENCHES["hand"], data),
        lambda data: partial(learn_bench, "hand", data),
        lambda data: partial(people_scans, "hand", data, seed=1),
    ],
    ids=["roundtrip", "starts", "hand", "learn", "people"],
)
def test_benchmarks_name_them_before_any_work(bench, shared_rigs, monkeypatch):
    monkeypatch.setattr("lbsfit_np.LBSFitter.pretrain", lambda *a, **k: pytest.fail("trained first"))
    monkeypatch.setattr("lbsfit_np.bench.people.hand_rig", lambda data: pytest.fail("made scans first"))
    for n in (0, -1, 2.5, "3", 3.5):
        with pytest.raises(InputError, match=r"^n_scans: got .*; expected (a whole number of )?at least [13]"):
            bench(shared_rigs)(n_scans=n)


def test_people_are_counted_in_whole_numbers(shared_rigs):
    for n in (1, 2.5, "3"):
        with pytest.raises(InputError, match="people: got .*; expected a whole number of at least two people"):
            people_scans("hand", shared_rigs, n_people=n, seed=1)
