"""Of things that stand apart in a scan, one is fitted, where a fit of all is in doubt."""

import copy
from dataclasses import make_dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting.one_thing import APART, looked_at_apart
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.starts.apart import things_apart
from lbsfit_np.starts.clean import TakingPart

# ---- what stands apart ----


def _beside(points, other, gap):
    """Another set of points, a gap to the right of the first ones."""
    return other + [points[:, 0].max() - other[:, 0].min() + gap, 0.0, 0.0]


@pytest.mark.parametrize("name", ["hand-coarse", "body-coarse"])
def test_two_bodies_are_two_things_and_one_is_one(name):
    rig = lbs.load_rig(name)
    a, b, c, d = (s.points for s in lbs.synthesize(rig, 4, poses="natural", random_state=1, noise=0.004))
    size = np.ptp(a, axis=0).max()
    for one, two in ((a, b), (c, d)):
        points = np.vstack([one, _beside(one, two[: len(two) * 2 // 3], 0.2 * size)])
        first, second = things_apart(points, np.arange(len(points)))
        assert first[: len(one)].mean() > 0.99 and not first[len(one) :].any()
        np.testing.assert_array_equal(second, ~first)
    for x in (a, b, c, d):
        assert things_apart(x, np.arange(len(x))) == []


def test_other_points_are_of_the_nearest_thing_and_small_ones_are_none():
    rng = np.random.default_rng(0)
    sizes, places = (400, 700, 100, 320), np.array([[0.0, 0, 0], [4.0, 0, 0], [8.0, 0, 0], [12.0, 0, 0]])
    points = np.vstack([rng.random((n, 3)) + p for n, p in zip(sizes, places)])
    of = np.repeat(np.arange(4), sizes)
    rows = np.sort(rng.choice(len(points), 900, replace=False))
    things = things_apart(points, rows)
    assert [t[of == k].all() for t, k in zip(things, (1, 0, 3), strict=True)] == [True] * 3
    assert sum(t.sum() for t in things) == len(points) - 100
    assert things_apart(points[of == 0], np.arange(400)) == [] and things_apart(points, np.arange(9)) == []
    assert things_apart(np.zeros((50, 3)), np.arange(50)) == []


def test_points_that_are_there_several_times_are_as_far_apart_as_their_places():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(600, 3))
    x /= np.linalg.norm(x, axis=1)[:, None]
    points = np.repeat(np.vstack([x[:300], x[300:] + [3.0, 0, 0]]), 6, axis=0)  # as triangles have them
    first, second = things_apart(points, np.arange(len(points)))
    np.testing.assert_array_equal(first, np.arange(len(points)) < 1800)
    np.testing.assert_array_equal(second, ~first)


@pytest.mark.parametrize("far", [1e3, 1e100, 1e160, np.finfo(float).max])
def test_a_point_that_is_very_far_away_is_no_error(far):
    rng = np.random.default_rng(0)
    points = np.vstack([rng.random((600, 3)), rng.random((500, 3)) + [4.0, 0, 0], [[far, 0.0, 0.0]]])
    first, second = things_apart(points, np.arange(1100))
    np.testing.assert_array_equal(first, np.arange(1101) < 600)
    np.testing.assert_array_equal(second[:1100], ~first[:1100])


def test_of_very_many_points_some_are_linked(monkeypatch):
    monkeypatch.setattr("lbsfit_np.starts.apart._LINKED", 500)
    rng = np.random.default_rng(0)
    points = rng.random((4000, 3)) + np.where(np.arange(4000) < 2400, 0.0, 4.0)[:, None]
    first, second = things_apart(points, np.arange(len(points)))
    np.testing.assert_array_equal(first, np.arange(len(points)) < 2400)
    np.testing.assert_array_equal(second, ~first)


def test_a_floor_that_was_not_looked_at_is_clutter_beside_one_of_several_things():
    known = np.array([1, 0, -1, -2, -3], dtype=np.int8)  # of the body, a floor, not looked at, another thing, without weight
    part = TakingPart(np.array([0]), np.zeros(0, int), "", 1.0, None, known, known != -2)
    assert part.is_clutter(known != 1).tolist() == [False, True, True, True, False]
    part = replace(part, among=np.array([True, False, True, False, True]))  # only what is of another thing was left out
    assert part.is_clutter(known != 1).tolist() == [False, True, False, True, False]


# ---- which is fitted ----


class _Fits:
    """Fits whose ends are given: of the whole at a first look, of the whole, of each thing."""

    def __init__(self, once, whole, *things, few=False, broken=()):
        self.ends = {"once": once, "whole": whole} | {f"thing {k}": end for k, end in enumerate(things)}
        rng, n = np.random.default_rng(0), (500, 100 if few else 400)
        self.points = np.vstack([rng.random((m, 3)) + [4.0 * k, 0, 0] for k, m in enumerate(n)])
        self.evidence = {"unexplained": 0.1}
        self.part, self.of, self.broken = SimpleNamespace(rows=np.arange(len(self.points)), among=None), [], broken

    def result(self, name):
        self.of.append(name)
        p = self.ends[name]
        status = "ok" if p >= 0.5 else "suspect"
        return _Result(name, status, p, self.evidence, float(len(self.of)), 10)

    def fit(self, part):
        return self.result("once" if part.among is None else f"thing {int(not part.among[0])}")

    def taking_part(self, among):
        if int(not among[0]) in self.broken:
            raise InputError("points", "few", "more")
        return SimpleNamespace(among=among)

    def __call__(self, given=(), **settings):
        known = {"settings": FitSettings(**settings), "given": given}
        return looked_at_apart(self.part, lambda: self.result("whole"), self.taking_part, self.fit, self.points, **known)


def _Result(*values):
    fields = "name", "status", "probability", "evidence", "seconds", "evaluations"
    return make_dataclass("Result", fields, frozen=True)(*values)


@pytest.mark.parametrize(
    "fits, kept, tries",
    [
        (_Fits(0.9, 0.9, 0.99, 0.99), "once", ["once"]),  # all of it is the body
        (_Fits(0.2, 0.3, 0.9, 0.95), "thing 1", ["once", "thing 0", "thing 1"]),
        (_Fits(0.2, 0.3, 0.6, 0.4), "thing 0", ["once", "thing 0", "thing 1", "whole"]),
        (_Fits(0.2, 0.7, 0.6, 0.75), "whole", ["once", "thing 0", "thing 1", "whole"]),
        (_Fits(0.2, 0.3, 0.4, 0.45), "whole", ["once", "thing 0", "thing 1", "whole"]),
        (_Fits(0.2, 0.3, 0.9, 0.4, broken=[1]), "thing 0", ["once", "thing 0"]),
        (_Fits(0.2, 0.3, 0.9, 0.4, few=True), "whole", ["whole"]),  # a limb that a view shows by itself
    ],
)
def test_the_likeliest_thing_is_kept_where_the_whole_is_in_doubt(fits, kept, tries):
    result = fits()
    assert result.name == kept and fits.of == tries
    assert (result.seconds, result.evaluations) == (float(len(tries)), 10 * len(tries))


@pytest.mark.parametrize("how", [{"effort": "fast"}, {"cropped": True}, {"given": ["labels"]}])
def test_nothing_is_looked_for_in_haste_or_where_labels_say_what_is_of_the_body_or_that_may_be_in_pieces(how):
    fits = _Fits(0.2, 0.3, 0.9, 0.9)
    assert fits(**how).name == "whole" and fits.of == ["whole"]


def test_a_fit_that_nothing_speaks_for_or_against_is_kept():
    """As one without skinning, which lays the mesh on all."""
    fits = _Fits(0.0, 0.0, 0.9, 0.9)
    fits.evidence = {}
    assert fits().name == "once" and fits.of == ["once"]


@pytest.mark.parametrize("learned", [False, slow(True)])
def test_one_of_two_bodies_is_fitted(tube_rig, fitter, tube_scan, learned_people, people_scans, learned):
    """The message says so; points of the other are left out."""
    fitter, one = (learned_people, people_scans[12].points) if learned else (fitter, tube_scan.points)
    fitter = copy.copy(fitter).set_params(effort="balanced")
    points = np.vstack([one, _beside(one, 0.97 * one[::2], 0.5 * np.ptp(one, axis=0).max())])
    known = {"subject": "ann"} if learned else {}
    r, alone = fitter.fit_scan(points, **known), fitter.fit_scan(one, **known)
    assert alone.status == "ok"
    assert r.status == "ok" and APART in r.message
    other = r.left_out[: len(one)].mean() > 0.5  # either may be fitted
    assert r.left_out[len(one) :].mean() == (0.0 if other else 1.0) and r.left_out[: len(one)].mean() == float(other)
    if not other:
        assert np.linalg.norm(r.joints - alone.joints, axis=1).max() < 0.02 * tube_rig.size
