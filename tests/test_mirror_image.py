"""Scans in doubt are looked at in the mirror: of which rigs, which fits, how, and what is said."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from slow_tests import slow

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.fitting import scan_fit
from lbsfit_np.fitting.mirror_image import looked_at_in_the_mirror, one_sided
from lbsfit_np.learning import new_scan
from lbsfit_np.starts.turns import facing_of

ASKS = "is it of the other side, such as a left hand?"


@pytest.fixture
def failed(tube_result):
    return replace(tube_result, status="failed", message="it does not fit", probability=0.1, seconds=2.0, evaluations=10)


def _looked_at(result, seen, rig, *, facing=None, **known):
    """What comes of it, and the reflections whose fit was asked for."""
    asked = []

    def fit(S):
        asked.append(S)
        if isinstance(seen, Exception):
            raise seen
        return seen

    return looked_at_in_the_mirror(result, fit, rig=rig, facing=facing or facing_of(rig, "upright"), **known), asked


@pytest.mark.parametrize(
    "learned, forward, remedy",
    [
        (False, "+z", "Fit it with the mirror image of the rig (lbsfit rig mirror, Rig.mirrored"),
        (False, "+x", "Fit it with the mirror image of the rig (lbsfit rig mirror --axis z, Rig.mirrored(axis='z')"),
        (True, "+z", "Mirror the scan, or learn with the mirror image of the rig (lbsfit rig mirror, Rig.mirrored"),
    ],
)
def test_a_scan_whose_mirror_image_fits_is_asked_about(learned, forward, remedy, failed, coarse_hand):
    seen = replace(failed, status="ok", message="all well", probability=0.97, seconds=3.0, evaluations=5)
    found, (S,) = _looked_at(failed, seen, replace(coarse_hand, forward=forward), learned=learned)
    asks = f"the mirror image of the scan fits, with probability 0.97: {ASKS} "
    assert found.message == f"{asks}{remedy}, or of hand and hand-left the other one); it does not fit"
    assert (found.status, found.probability, found.seconds, found.evaluations) == ("failed", 0.1, 3.0, 15)
    np.testing.assert_array_equal(found.vertices, failed.vertices)
    np.testing.assert_allclose(S, np.diag([-1.0, 1.0, 1.0] if forward == "+z" else [1.0, 1.0, -1.0]), atol=1e-12)


def test_a_reflected_scan_that_cannot_be_worked_with_costs_nothing(failed, coarse_hand):
    found, asked = _looked_at(failed, InputError("points", "few", "many"), coarse_hand)
    assert found is failed and len(asked) == 1


@pytest.mark.parametrize("change", [{"status": "suspect"}, {"probability": 0.05}])
def test_nothing_is_said_of_one_that_does_not_fit_or_is_no_more_probable(change, failed, coarse_hand):
    seen = replace(failed, **({"status": "ok", "probability": 0.97} | change), seconds=3.0, evaluations=5)
    found, asked = _looked_at(failed, seen, coarse_hand)
    assert found.message == "it does not fit" and (found.seconds, found.evaluations) == (3.0, 15) and len(asked) == 1


def test_right_fits_known_scans_and_rigs_of_both_sides_are_not_looked_at(failed, coarse_hand):
    """Nor what nothing speaks for or against."""
    seen = replace(failed, status="ok", probability=0.97)
    names = ("left_wrist", "right_wrist", *coarse_hand.joint_names[2:])
    both = replace(coarse_hand, joint_names=names, partitions={})
    for result, rig, known in (
        (replace(failed, status="ok"), coarse_hand, {}),
        (failed, coarse_hand, {"given": ["labels"]}),
        (failed, coarse_hand, {"given": ["theta0"]}),
        (replace(failed, evidence={}), coarse_hand, {}),
        (failed, both, {}),
    ):
        found, asked = _looked_at(result, seen, rig, **known)
        assert found is result and not asked


def test_hands_are_one_sided_and_bodies_are_not(tube_rig, coarse_hand):
    sides = {rig.name: one_sided(rig) for rig in (tube_rig, coarse_hand, coarse_hand.mirrored(), lbs.load_rig("body-coarse"))}
    assert list(sides.values()) == [False, True, True, False], sides  # of the tube most mirror images are explained


def test_a_body_without_sides_in_its_names_is_known_by_its_shape(tmp_path):
    """However many vertices one of its sides has, or none of its faces."""
    body = lbs.load_rig("body-coarse")
    nameless = replace(body, joint_names=tuple(f"j{k}" for k in range(24)), partitions={}, poses={})
    V, F = body.vertices, body.faces
    left = F[(V[F, 0] > 0.3 * V[:, 0].max()).all(axis=1)]
    middles = V[left].mean(axis=1)
    new = len(V) + np.arange(len(left))
    finer = np.concatenate([F, *(np.stack([left[:, k], left[:, k - 2], new], axis=1) for k in range(3))])
    for vertices, faces in ((V, F), (np.vstack([V, middles]), finer), (np.vstack([V, [[9.0, 9.0, 9.0]]]), F)):
        assert not one_sided(SimpleNamespace(joint_names=nameless.joint_names, vertices=vertices, faces=faces, size=body.size))


@pytest.mark.parametrize(
    "orientation, up", [("aligned", None), ("upright", None), ("upright", "+z"), ("aligned", "-y"), ("any", None)]
)
@pytest.mark.parametrize("forward", ["+z", "-x", "+y", None])
def test_the_reflection_is_from_side_to_side(orientation, up, forward, failed, coarse_hand):
    """Up stays, as it is known in scans, and so does the front where it is."""
    rig = replace(coarse_hand, forward=forward, up=None if forward == "+y" else "+y")
    facing = facing_of(rig, orientation, up)
    _, (S,) = _looked_at(failed, failed, rig, facing=facing)
    np.testing.assert_allclose(S @ S, np.eye(3), atol=1e-12)
    assert np.linalg.det(S) == pytest.approx(-1.0)
    turn = facing.turns[0]
    kept = [[0.0, 1.0, 0.0], *({"+z": [[0.0, 0.0, 1.0]], "-x": [[-1.0, 0.0, 0.0]]}.get(forward, []))]
    for direction in kept:
        np.testing.assert_allclose(S @ turn @ direction, turn @ direction, atol=1e-12)


@pytest.mark.parametrize("owner", [scan_fit, new_scan])
def test_reflected_points_keep_their_weights_and_are_looked_at_once(owner, coarse_hand, failed, monkeypatch):
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (300, 3))
    weights, fits, flip = 1.0 + np.arange(300), [], np.diag([-1.0, 1.0, 1.0])
    fitter = lbs.LBSFitter(coarse_hand, effort="fast", random_state=0)
    monkeypatch.setattr(owner, "looked_at_in_the_mirror", lambda result, fit, **known: fit(flip))
    if owner is scan_fit:
        fit = new_scan.scan_fit(fitter)
        monkeypatch.setattr(fit, "_fit", lambda x, theta0, labels, a, *_, once: fits.append((x, a, once)) or failed)
        fit.fit(points, point_weights=weights, random_state=0)
    else:
        known, fitter.regressor_ = {"theta0": None, "labels": None, "point_weights": weights}, object()
        monkeypatch.setattr(new_scan, "_fit_new", lambda *given, once: fits.append((given[1], given[6], once)) or failed)
        new_scan.fit_new(fitter, points, ("ann",), **known)
    (_, a, once), (x, b, last) = fits
    assert a is weights and (once, last) == (False, True) and len(x) > 200
    np.testing.assert_array_equal(x, points[(b - 1).astype(int)] @ flip)


@pytest.mark.parametrize("weighted", [slow(False), True])
@pytest.mark.parametrize("owner", [scan_fit, slow(new_scan)])
def test_fits_with_and_without_what_was_learned_are_looked_at(
    owner, weighted, quick_fitter, learned_people, people_scans, monkeypatch
):
    """The reflected points are fitted as the scan itself was: as they are, they give the same fit."""
    fitter, points = (quick_fitter if owner is scan_fit else learned_people), people_scans[11].points
    weights = {}
    if weighted:  # half of them are elsewhere, and weigh nothing
        points, weights = np.vstack([points, points + [0.3, 0.0, 0.2]]), {"point_weights": np.repeat([1.0, 0.0], len(points))}
    known, before = [], fitter.fit_scan(points, **weights)

    def spy(result, fit, **given):
        known.append(given)
        return fit(np.eye(3))

    monkeypatch.setattr(owner, "looked_at_in_the_mirror", spy)
    seen = fitter.fit_scan(points, **weights)
    np.testing.assert_allclose(seen.vertices, before.vertices, atol=0.02)
    ((given,),) = [known]
    assert (given["rig"], given["given"], given.get("learned", False)) == (fitter.rig, [], owner is new_scan)
    np.testing.assert_array_equal(given["facing"].turns, facing_of(fitter.rig, fitter.orientation).turns)
