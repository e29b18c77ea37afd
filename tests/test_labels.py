"""Labels from a fitted mesh and the segmenter's word: the formula, its doubt, and votes with confidence."""

import numpy as np
import pytest

from lbsfit_np.fitting import refit, search, template
from lbsfit_np.fitting.labels import LEANS, labels_from_mesh, refined_labels, said_of
from lbsfit_np.fitting.scan_fit import FitSettings
from lbsfit_np.fitting.template import SHIFTS, TemplateSettings, shared_template
from lbsfit_np.losses import structured_chamfer
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.problem import Problem
from lbsfit_np.skinning import skin

# Two parts of one vertex each, two units apart, and a third part without vertices.
V = np.array([[0.0, 0, 0], [2.0, 0, 0]])
V_LABELS = np.array([0, 1])


def _posterior(X, proba, V, v_labels, sigma):
    """q of the docstring, by loops, normalised."""
    q = np.zeros(proba.shape)
    for i, x in enumerate(X):
        for p in range(proba.shape[1]):
            part = V[v_labels == p]
            if len(part):
                d = min(np.linalg.norm(x - v) for v in part)
                q[i, p] = np.sqrt(proba[i, p] + 1e-3) * np.exp(-(d**2) / (2 * sigma**2))
    return q / q.sum(axis=1, keepdims=True)


@pytest.fixture
def case():
    rng = np.random.default_rng(0)
    X, proba = rng.standard_normal((300, 3)), rng.dirichlet(np.full(4, 0.5), 300)
    return X, proba, rng.standard_normal((60, 3)), rng.integers(4, size=60)


@pytest.mark.parametrize("sigma", [0.2, 0.5, 5.0])
def test_labels_are_the_most_probable_parts(case, sigma):
    X, proba, V, v_labels = case
    expected = _posterior(X, proba, V, v_labels, sigma).argmax(axis=1)
    np.testing.assert_array_equal(refined_labels(X, proba, V, v_labels, sigma), expected)


@pytest.mark.parametrize("doubt", [0.3, 0.5, 0.8, 0.99])
def test_doubtful_points_get_a_label_that_no_vertex_has(case, doubt):
    X, proba, V, v_labels = case
    q = _posterior(X, proba, V, v_labels, 0.5)
    labels = refined_labels(X, proba, V, v_labels, 0.5, doubt=doubt)
    sure = q.max(axis=1) >= doubt
    assert 0 < sure.sum() < len(X)
    np.testing.assert_array_equal(labels, np.where(sure, q.argmax(axis=1), 4))


def test_doubtful_points_take_no_part_in_the_structured_term(case):
    X, proba, V, v_labels = case
    labels = refined_labels(X, proba, V, v_labels, 0.5, doubt=0.8)
    doubtful = labels == 4
    value, grad = structured_chamfer(X, V, labels, v_labels)
    moved = X.copy()
    moved[doubtful] += 3.0
    again, grad_again = structured_chamfer(moved, V, labels, v_labels)
    assert doubtful.any() and value == again
    np.testing.assert_array_equal(grad, grad_again)


def test_near_the_distance_decides_and_far_the_segmenter():
    X = np.array([[0.9, 0.0, 0.0]])
    against = np.array([[0.2, 0.8, 0.0]])  # √(0.8 / 0.2) = 2; the distances speak for part 0 by exp(0.2 / σ²)
    assert refined_labels(X, against, V, V_LABELS, 0.3) == 0
    assert refined_labels(X, against, V, V_LABELS, 3.0) == 1


def test_a_part_that_the_segmenter_excludes_is_not_impossible():
    excluded = np.array([[0.0, 1.0, 0.0]])
    assert refined_labels(np.array([[0.1, 0, 0]]), excluded, V, V_LABELS, 0.3) == 0
    assert refined_labels(np.array([[0.9, 0, 0]]), excluded, V, V_LABELS, 0.3) == 1


@pytest.mark.parametrize("doubt", [0.0, 0.8])
def test_a_part_without_vertices_is_nobodys(doubt):
    certain = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 0.5]])
    labels = refined_labels(np.array([[0.0, 0, 0], [0.0, 0, 0]]), certain, V, V_LABELS, 0.1, doubt=doubt)
    assert labels.tolist() == [0, 0]


def test_without_doubt_every_point_has_a_part():
    X = np.array([[1.0, 0.0, 0.0], [1.0, 5.0, 0.0]])  # as far from either
    even = np.full((2, 3), 1 / 3)
    assert set(refined_labels(X, even, V, V_LABELS, 0.3)) <= {0, 1}
    assert refined_labels(X, even, V, V_LABELS, 0.3, doubt=0.6).tolist() == [3, 3]


def test_far_from_everything_nothing_overflows():
    X = np.array([[1e3, 0.0, 0.0], [1e3, 1e3, 0.0]])
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        labels = refined_labels(X, np.full((2, 3), 1 / 3), V, V_LABELS, 0.01, doubt=0.8)
    assert labels.tolist() == [1, 1]


def test_nothing_that_is_given_changes(case):
    kept = [a.copy() for a in case]
    refined_labels(*case, 0.3, doubt=0.8)
    labels_from_mesh(case[0], case[2], case[3], 4, 0.3, proba=case[1], proba_points=case[0])
    for a, b in zip(case, kept, strict=True):
        np.testing.assert_array_equal(a, b)


# ---- labels of all points ----


def _votes(x, V, v_labels, n_parts, sigma, word):
    d = np.linalg.norm(V - x, axis=1)
    score = np.zeros(n_parts)
    for k in np.argsort(d)[:8]:
        score[v_labels[k]] += np.exp(-(d[k] ** 2) / (2 * sigma**2))
    return score * np.sqrt(word + 1e-3)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("chunk", [7, 200_000])
def test_the_nearest_vertices_vote(case, known, chunk):
    X, proba, V, v_labels = case
    asked = X[::3] if known else None
    given = {"proba": proba[::3], "proba_points": asked} if known else {}
    labels, confidence = labels_from_mesh(X, V, v_labels, 4, 0.5, chunk=chunk, **given)
    for i, x in enumerate(X):
        word = proba[::3][np.linalg.norm(asked - x, axis=1).argmin()] if known else np.full(4, 0.999)
        score = _votes(x, V, v_labels, 4, 0.5, word)
        assert labels[i] == score.argmax()
        spacing = np.median([np.sort(np.linalg.norm(V - v, axis=1))[1] for v in V])
        off = (np.linalg.norm(V - x, axis=1).min() ** 2 - max(4 * 0.5, 3 * spacing) ** 2) / (2 * 0.5**2)
        assert confidence[i] == pytest.approx(score.max() / score.sum() / (1 + np.exp(off)), rel=1e-9)


def test_votes_of_a_mesh_of_few_vertices():
    labels, confidence = labels_from_mesh(np.array([[0.1, 0, 0], [2.1, 0, 0], [50.0, 0, 0]]), V, V_LABELS, 3, 0.2)
    assert labels.tolist() == [0, 1, 1]
    np.testing.assert_allclose(confidence, [1.0, 1.0, 0.0], atol=1e-6)
    labels, confidence = labels_from_mesh(np.array([[1.0, 0, 0]]), V, V_LABELS, 3, 0.2)
    assert confidence == pytest.approx(0.5)


def test_points_off_the_mesh_have_no_confidence():
    """Of clutter and floors it would look as if they were known."""
    V = np.stack(np.meshgrid(*[np.linspace(0, 1, 11)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    above = np.column_stack([np.full(6, 0.5), np.full(6, 0.5), [0.0, 0.1, 0.25, 0.35, 0.6, 1e9]])
    with np.errstate(over="raise", invalid="raise"):
        _, confidence = labels_from_mesh(above, V, np.zeros(len(V), dtype=int), 2, 0.02)  # vertices are 0.1 apart: off from 0.3
    np.testing.assert_allclose(confidence, [1, 1, 1, 0, 0, 0], atol=1e-3)
    _, confidence = labels_from_mesh(above, V, np.zeros(len(V), dtype=int), 2, 0.1)  # off from 4 sigma
    np.testing.assert_allclose(confidence[[0, 1, 2, 4, 5]], [1, 1, 1, 0, 0], atol=0.01)
    assert 0.5 < confidence[3] < 1


@pytest.mark.parametrize("lean, back", [(0.0, False), (LEANS - 0.1, False), (LEANS + 0.1, True), (3.0, True)])
@pytest.mark.parametrize("size", [1.0, 1.25])
def test_a_scan_that_leans_is_turned_back_before_the_segmenter_sees_it(lean, back, size, tube_rig):
    """And is of the size of what that has learned from."""
    seen = []

    class Segmenter:
        half = tube_rig.size / 2

        def predict_proba(self, points, *, scale, views):
            seen.append(points / scale)

    theta = np.zeros(tube_rig.lower.shape)
    upright = skin(tube_rig, theta).vertices - tube_rig.joints[0]
    theta[0] = lean * np.array([0.6, 0.0, 0.8])
    leaning = skin(tube_rig, theta).vertices - tube_rig.joints[0]
    said_of(Segmenter(), tube_rig, leaning / Segmenter.half, theta, size)
    np.testing.assert_allclose(seen[0], (upright if back else leaning) / size, atol=1e-12)


def test_labels_are_doubted_alike_in_all_stages(coarse_hand, monkeypatch):
    """In the search, in starts from labels and where a template is found."""
    model, doubts = Model(coarse_hand, shifts=SHIFTS), []

    def refined(X, proba, *more, doubt=0.0):
        doubts.append(doubt)
        return proba.argmax(axis=1)

    for module in (search, refit, template):
        monkeypatch.setattr(module, "refined_labels", refined)
    problem, proba = Problem(model.rig.vertices), np.eye(len(coarse_hand.parts))[model.labels]
    settings = FitSettings(full_iterations=1)
    search.Search(model, problem, proba, False, settings).full(model.rest())
    refit.Refit(model).from_parts(problem, proba)
    few = TemplateSettings(sigmas=(0.05,), labelled_steps=0, steps=0, rounds=0)
    shared_template(model, [problem], [model.rest()], np.ones(1), proba=[proba], settings=few)
    assert doubts == [settings.doubt] * 4
