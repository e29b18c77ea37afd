"""Gauss–Newton steps on many poses and the template that they share."""

import numpy as np
import pytest
from posed_samples import joint_error, near, sampled, state_within

from lbsfit_np.optimize import gauss_newton
from lbsfit_np.optimize.gauss_newton import GaussNewton
from lbsfit_np.optimize.model import Model
from lbsfit_np.optimize.state import Layout

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def shifting(tube_rig):
    return Model(tube_rig, shifts=0.3)


@pytest.fixture(scope="module")
def subject(shifting):
    """Coefficients of a changed template, five poses of it, and their problems with parts."""
    c = np.zeros(shifting.n_coefficients)
    k = shifting.n_coefficients - shifting._shifts.shape[1]
    rng = np.random.default_rng(1)
    c[:k] = 0.12 * rng.uniform(-1, 1, k)
    truths = [state_within(shifting, seed).replace(coefficients=c) for seed in range(5)]
    problems, labels = zip(*(sampled(shifting, t, 700, seed) for seed, t in enumerate(truths)))
    return c, truths, list(problems), list(labels)


def _template_error(model, c, true):
    """Mean distance of the template's vertices, the templates laid on each other."""
    away = (model.basis @ (c - true)).reshape(-1, 3)
    return np.linalg.norm(away - away.mean(axis=0), axis=1).mean()


def test_many_poses_find_their_template_where_one_cannot(shifting, subject):
    c, truths, problems, labels = subject
    steps = GaussNewton(shifting, reach=0.05, tangential=0.02)
    zero = np.zeros_like(c)
    starts = [near(shifting, t, seed, angle=0.1).replace(coefficients=zero) for seed, t in enumerate(truths)]
    together, values = steps.shared(problems, starts, iterations=40)
    assert all(np.array_equal(s.coefficients, together[0].coefficients) for s in together)
    assert values.shape == (5,) and (values < 2e-4).all()
    alone = [steps.shared([p], [s], iterations=40)[0][0] for p, s in zip(problems, starts)]
    before, shared = (_template_error(shifting, x, c) for x in (zero, together[0].coefficients))
    single = np.mean([_template_error(shifting, s.coefficients, c) for s in alone])
    assert shared < 0.3 * before and shared < 0.6 * single
    joints = [np.mean([joint_error(shifting, s, t) for s, t in zip(found, truths)]) for found in (together, alone)]
    assert joints[0] < 0.02 and joints[0] < 0.6 * joints[1]
    labelled, _ = steps.shared(problems, starts, labels=labels, iterations=40)
    assert _template_error(shifting, labelled[0].coefficients, c) < 0.5 * before


def test_eliminated_unknowns_are_those_of_the_whole_system(shifting, subject, monkeypatch):
    """One step, and a longer one, against the solution of all unknowns at once: poses of three scans, and their one template.

    Where coefficients reach their bounds, poses go along with the step that these really take.
    """
    c, truths, problems, _ = subject
    steps = GaussNewton(shifting, ridge=1e-4)
    layout = Layout(shifting.rig, ("pose", "translation"), len(c))
    states = [t.replace(coefficients=0.5 * c) for t in truths[:3]]
    w, damping, n = 1 / 3, 1e-2, layout.size
    made = [steps._normal_equations(p, s, None, layout, True) for p, s in zip(problems, states)]
    H, g = np.zeros((3 * n + len(c),) * 2), np.zeros(3 * n + len(c))
    for k, m in enumerate(made):
        own, shared = slice(k * n, (k + 1) * n), slice(3 * n, None)
        H[own, own] = w * (m.H[:n, :n] + np.diag(damping * np.diag(m.H)[:n] + 1e-5))
        H[own, shared], H[shared, own] = w * m.H[:n, n:], w * m.H[n:, :n]
        H[shared, shared] += w * m.H[n:, n:]
        g[own], g[shared] = w * m.g[:n], g[shared] + w * m.g[n:]
    reduced = H[3 * n :, 3 * n :] - H[3 * n :, : 3 * n] @ np.linalg.solve(H[: 3 * n, : 3 * n], H[: 3 * n, 3 * n :])
    H[3 * n :, 3 * n :] += np.diag(damping * np.diag(reduced)) + 1e-4 * np.eye(len(c))
    g[3 * n :] -= 1e-4 * states[0].coefficients
    x = np.linalg.solve(H, g)
    start = states[0].coefficients
    for stretch, most in ((1.0, 0.5), (1.5, 0.5), (1.5, 0.7 * np.abs(start + x[3 * n :]).max())):
        monkeypatch.setattr("lbsfit_np.optimize.gauss_newton.MOST_PROPORTION", most)
        found = steps._step(states, made, layout, True, damping, stretch)
        dc = np.clip(start + stretch * x[3 * n :], -most, most) - start
        assert np.allclose(dc, stretch * x[3 * n :]) == (most == 0.5)
        np.testing.assert_allclose(found[0].coefficients - start, dc, atol=1e-9)
        for k, (before, after) in enumerate(zip(states, found)):
            own = slice(k * n, (k + 1) * n)
            dx = np.linalg.solve(H[own, own], stretch * g[own] - H[own, 3 * n :] @ dc)
            np.testing.assert_allclose(layout.pack(after), np.clip(layout.pack(before) + dx, *layout.bounds()), atol=1e-8)


def test_of_many_scans_no_more_is_held_than_their_equations(shifting, subject, monkeypatch):
    """With the same template to the last bit; what equations are made of is let go of as soon as they are there."""
    c, truths, problems, _ = subject
    steps = GaussNewton(shifting, reach=0.05, tangential=0.02)
    starts = [near(shifting, t, seed, angle=0.1).replace(coefficients=np.zeros_like(c)) for seed, t in enumerate(truths)]
    expected, values = steps.shared(problems, starts, iterations=6)
    made, make = [], gauss_newton._Normal.__init__

    def watched(self, *given):
        assert all(m._made_of is None for m in made)
        make(self, *given)
        made.append(self)

    monkeypatch.setattr(gauss_newton, "_MANY", 2)
    monkeypatch.setattr(gauss_newton._Normal, "__init__", watched)
    found, found_values = steps.shared(problems, starts, iterations=6)
    np.testing.assert_array_equal(found_values, values)
    for a, b in zip(found, expected):
        np.testing.assert_array_equal(a.theta, b.theta)
        np.testing.assert_array_equal(a.coefficients, b.coefficients)


def test_what_holds_a_pose_holds_that_one_alone(shifting, subject):
    """Angles go where they are held, values tell it, the template follows."""
    c, truths, problems, _ = subject
    starts, steps = [t.replace(coefficients=np.zeros_like(c)) for t in truths[:3]], GaussNewton(shifting)
    turning = Layout(shifting.rig, ("pose",), 0).turning
    wanted = np.where(turning, 0.9 * truths[1].theta, 0.0)
    free, _ = steps.shared(problems[:3], starts, iterations=20)
    found, values = steps.shared(problems[:3], starts, priors=[None, (wanted, 1e3), None], iterations=20)
    np.testing.assert_allclose(found[1].theta[turning], wanted[turning], atol=1e-3)
    assert np.abs(free[1].theta - wanted)[turning].max() > 0.02
    assert not np.array_equal(found[2].coefficients, free[2].coefficients)
    away = (found[1].theta - wanted)[turning]
    _, without = steps.shared(problems[:3], found, iterations=0)
    np.testing.assert_allclose(values, without + [0.0, 1e3 * away @ away, 0.0], rtol=1e-9)


def test_the_ridge_holds_the_coefficients(shifting, subject):
    c, truths, problems, _ = subject
    starts = [t.replace(coefficients=np.zeros_like(c)) for t in truths[:3]]
    sizes = [
        np.linalg.norm(GaussNewton(shifting, ridge=ridge).shared(problems[:3], starts, iterations=10)[0][0].coefficients)
        for ridge in (1e-6, 1e-3, 10.0)
    ]
    assert sizes[0] > sizes[1] > sizes[2] and sizes[2] < 1e-3


def test_coefficients_stay_within_their_bounds(shifting):
    """A scan twice the size would want factors of 2."""
    big = shifting.rest().replace(scale=2.0)
    problem, labels = sampled(shifting, big)
    found, _ = GaussNewton(shifting, reach=1.0).shared([problem], [shifting.rest()], labels=[labels], iterations=30)
    assert np.abs(found[0].coefficients).max() == pytest.approx(0.5)
