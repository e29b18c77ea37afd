"""Rules of the evidence, and of what is compared for it, each by an exact case."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import lbsfit_np as lbs
from lbsfit_np.fitting.confidence import evidence_of, shown_problem
from lbsfit_np.fitting.exchanges import Exchanges
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.optimize.visibility import WHOLE

# Ten by ten points, so far apart as their third neighbours are.
STEP = 0.01
GRID = STEP * np.stack(np.meshgrid(np.arange(10), np.arange(10), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def hand():
    return Model(lbs.load_rig("hand-coarse"))


@pytest.fixture(scope="module")
def at_rest(hand):
    return hand.pose(hand.rest())[0].vertices


def _parts(model, V, X):
    """What the mesh says of points."""
    return model.labels[cdist(X, V).argmin(axis=1)]


@pytest.mark.parametrize("steps, counts", [(3.9, True), (4.1, False)])
def test_points_whose_third_neighbour_is_over_four_times_as_far_as_usual_count_for_nothing(hand, at_rest, steps, counts):
    """Three beside each other, of which the labels and the mesh disagree."""
    three = GRID[-1] + [steps * STEP, 0.0, 0.0] + 1e-7 * np.eye(3)
    X = at_rest[0] + np.vstack([GRID, three])
    parts = _parts(hand, at_rest, X)
    parts[-3:] += 1
    evidence, _ = evidence_of(hand, at_rest, X, proba=np.eye(len(hand.source.parts) + 1)[parts])
    assert evidence["disagreement"] == pytest.approx(3 / 103 if counts else 0.0, abs=1e-12)


def test_points_of_which_nothing_is_said_do_not_disagree(hand, at_rest):
    """Rows of zeros, as of labels that are not known."""
    X, n = at_rest[0] + GRID, len(GRID)
    told = np.random.default_rng(0).uniform(0.1, 0.9, n)
    proba = np.zeros((n, len(hand.source.parts)))
    proba[np.arange(n), _parts(hand, at_rest, X)] = told
    known = np.arange(n) % 3 > 0
    evidence, _ = evidence_of(hand, at_rest, X, proba=proba * known[:, None])
    assert evidence["disagreement"] == pytest.approx(1 - told[known].mean(), abs=1e-12)
    evidence, _ = evidence_of(hand, at_rest, X, proba=0 * proba)
    assert evidence["disagreement"] == 0.0


def test_surface_between_sparse_points_has_a_partner(hand, at_rest):
    """It has up to where points are apart; what lies further, of fingers that are not there, has none."""
    low = np.flatnonzero(at_rest[:, 1] < np.quantile(at_rest[:, 1], 0.6))
    X = at_rest[np.random.default_rng(0).permutation(low)[:40]]
    between = cdist(at_rest, X).min(axis=1)
    third = np.sort(cdist(X, X), axis=1)[:, 3]
    apart = 2 * np.median(third)
    problem = shown_problem(hand, Problem(X), hand.rest(), WHOLE)
    assert 0.1 < apart < 0.5 and ((between > 0.08) & (between < apart)).sum() > 50
    np.testing.assert_array_equal(problem.v_weights, between < apart)
    assert (problem.shares > 0).all()


def test_of_limbs_the_nearest_pairs_are_exchanged(hand, at_rest, monkeypatch):
    """Five of the ten pairs of fingers, the nearest first."""
    exchanges = Exchanges(hand, ("pose", "translation"))
    state = hand.rest()
    monkeypatch.setattr(exchanges._steps, "pose", lambda problem, state, **options: (state, 0.0))
    moves = exchanges.of(Problem(at_rest), state, np.ones(len(hand.rig.parents), dtype=bool))
    last = [joints[-1] for joints, _ in exchanges._limbs]
    ends = np.array([at_rest[hand.rig.leading_joint == j].mean(axis=0) for j in last])
    away, (i, k) = cdist(ends, ends), np.triu_indices(5, 1)
    nearest = np.argsort(away[i, k])[:5]
    pairs = [tuple(sorted({*joints} & {*last})) for joints, _ in moves]
    expected = [tuple(sorted((last[i[n]], last[k[n]]))) for n in nearest]
    assert list(dict.fromkeys(pairs)) == expected and len(moves) == 10
