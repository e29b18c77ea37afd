"""Threads of one process that share a fitter, as in a web service."""

import copy
import sys
from concurrent.futures import ThreadPoolExecutor

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

    class Fitter:
        template_ = dict.fromkeys(range(60))

    fitter, made = Fitter(), []

    def ask(k):
        subject = k % 60
        return _kept(fitter, (subject, "fit"), (float(subject),), lambda: made.append(subject) or f"of {subject}")

    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(ask, range(3000))) == [f"of {k % 60}" for k in range(3000)]
    made.clear()
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(ask, [7] * 200))
    assert made in ([], [7])
