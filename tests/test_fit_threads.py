"""Threads of one process that share a fitter, as in a web service."""

import copy
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.learning.new_scan import _kept


@pytest.fixture(autouse=True)
def restless():
    """Threads take turns as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("hurried")
def test_fits_in_threads_are_those_of_one_after_the_other(tube_rig, quick_fitter):
    scans = [s.points for s in lbs.synthesize(tube_rig, 4, random_state=3, n_points=300)]
    expected = [copy.copy(quick_fitter).fit_scan(points) for points in scans]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(copy.copy(quick_fitter).fit_scan, scans))
    for a, b in zip(found, expected):
        np.testing.assert_array_equal(a.vertices, b.vertices)
        np.testing.assert_array_equal(a.labels, b.labels)


def test_what_a_fitter_keeps_ready_is_made_once_for_all_threads():
    """And is put in order by one at a time."""
    made, at_once = [], threading.Barrier(8)

    class Fitter:
        template_ = dict.fromkeys(range(60))

    def ask(fitter, k, wait=False):
        def make():
            time.sleep(1e-3)  # others come meanwhile
            made.append(k)
            return f"of {k}"

        if wait:
            at_once.wait(10)
        return _kept(fitter, (k, "fit"), (float(k),), make)

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(partial(ask, Fitter(), wait=True), [7] * 8)) == ["of 7"] * 8
        assert made == [7]
        assert list(pool.map(partial(ask, Fitter()), [*range(60)] * 5)) == [f"of {k}" for k in range(60)] * 5
