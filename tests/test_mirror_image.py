"""Scans in doubt are looked at in the mirror: of which rigs, which fits, how, and what is said."""

from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.fitting import scan_fit
from lbsfit_np.fitting.mirror_image import looked_at_in_the_mirror, one_sided
from lbsfit_np.learning import new_scan
from lbsfit_np.rig.build import build_rig
from lbsfit_np.starts.turns import facing_of

ASKS = "is it of the other side, such as a left hand?"
FLIP = np.diag([-1.0, 1.0, 1.0])


@pytest.fixture
def failed(tube_result):
    return replace(tube_result, status="failed", message="it does not fit", probability=0.1, seconds=2.0, evaluations=10)


def _looked_at(result, seen, rig, scan, *, facing=None, **known):
    """What comes of it, and the points whose fit was asked for."""
    asked = []
    fit = lambda points: asked.append(points) or seen  # noqa: E731
    return looked_at_in_the_mirror(result, scan.points, fit, rig=rig, facing=facing or facing_of(rig, "upright"), **known), asked


def test_a_scan_whose_mirror_image_fits_is_asked_about(failed, tube_rig, tube_scan):
    seen = replace(failed, status="ok", message="all well", probability=0.97, seconds=3.0, evaluations=5)
    found, (points,) = _looked_at(failed, seen, tube_rig, tube_scan)
    assert found.message.startswith("it does not fit; the mirror image of the scan fits, with probability 0.97: ")
    assert ASKS in found.message and "(lbsfit rig mirror, Rig.mirrored; of hand that is hand-left)" in found.message
    assert (found.status, found.probability, found.seconds, found.evaluations) == ("failed", 0.1, 3.0, 15)
    np.testing.assert_array_equal(found.vertices, failed.vertices)
    np.testing.assert_allclose(points, tube_scan.points @ FLIP)


@pytest.mark.parametrize("change", [{"status": "suspect"}, {"probability": 0.05}])
def test_nothing_is_said_of_one_that_does_not_fit_or_is_no_more_probable(change, failed, tube_rig, tube_scan):
    seen = replace(failed, **({"status": "ok", "probability": 0.97} | change), seconds=3.0, evaluations=5)
    found, asked = _looked_at(failed, seen, tube_rig, tube_scan)
    assert found.message == "it does not fit" and (found.seconds, found.evaluations) == (3.0, 15) and len(asked) == 1


def test_right_fits_known_scans_and_rigs_of_both_sides_are_not_looked_at(failed, tube_rig, tube_scan):
    """Nor what nothing speaks for or against."""
    seen = replace(failed, status="ok", probability=0.97)
    names = ["root", "elbow", "left_finger", "right_finger"]
    both = build_rig(replace(make_tube_data(), joint_names=names, partitions={}))
    for result, rig, known in (
        (replace(failed, status="ok"), tube_rig, {}),
        (failed, tube_rig, {"given": ["labels"]}),
        (replace(failed, evidence={}), tube_rig, {}),
        (failed, both, {}),
    ):
        found, asked = _looked_at(result, seen, rig, tube_scan, **known)
        assert found is result and not asked


def test_hands_are_one_sided_and_bodies_are_not(tube_rig, coarse_hand):
    sides = {rig.name: one_sided(rig) for rig in (tube_rig, coarse_hand, coarse_hand.mirrored(), lbs.load_rig("body-coarse"))}
    assert list(sides.values()) == [True, True, True, False], sides
    nameless = replace(lbs.load_rig("body-coarse"), joint_names=tuple(f"j{k}" for k in range(24)), partitions={}, poses={})
    assert not one_sided(nameless)


@pytest.mark.parametrize(
    "orientation, up", [("aligned", None), ("upright", None), ("upright", "+z"), ("aligned", "-y"), ("any", None)]
)
@pytest.mark.parametrize("forward", ["+z", "-x", None])
def test_the_reflection_is_from_side_to_side(orientation, up, forward, failed, tube_rig, tube_scan):
    """Up stays, as it is known in scans, and so does the front where it is."""
    rig = replace(tube_rig, forward=forward)
    facing = facing_of(rig, orientation, up)
    _, (points,) = _looked_at(failed, failed, rig, tube_scan, facing=facing)
    S = np.linalg.lstsq(tube_scan.points, points, rcond=None)[0]
    np.testing.assert_allclose(S @ S, np.eye(3), atol=1e-12)
    assert np.linalg.det(S) == pytest.approx(-1.0)
    turn = facing.turns[0]
    kept = [[0.0, 1.0, 0.0], *({"+z": [[0.0, 0.0, 1.0]], "-x": [[-1.0, 0.0, 0.0]]}.get(forward, []))]
    for direction in kept:
        np.testing.assert_allclose(S @ turn @ direction, turn @ direction, atol=1e-12)


@pytest.mark.parametrize("owner", [scan_fit, new_scan])
def test_fits_with_and_without_what_was_learned_are_looked_at(owner, quick_fitter, learned_people, people_scans, monkeypatch):
    """The reflected points are fitted as the scan itself was."""
    fitter, scan = (quick_fitter if owner is scan_fit else learned_people), people_scans[11].points
    known, before = [], fitter.fit_scan(scan)

    def spy(result, points, fit, **given):
        known.append(given)
        return fit(points)

    monkeypatch.setattr(owner, "looked_at_in_the_mirror", spy)
    seen = fitter.fit_scan(scan)
    np.testing.assert_allclose(seen.vertices, before.vertices, atol=0.02)
    assert [(given["rig"], given["given"]) for given in known] == [(fitter.rig, [])]
    np.testing.assert_array_equal(known[0]["facing"].turns, facing_of(fitter.rig, fitter.orientation).turns)
