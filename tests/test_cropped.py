"""Scans that end before the body does, fitted as such: what they show comes as near as in whole ones."""

import copy

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.learning.reading import read_collection
from lbsfit_np.starts.clean import taking_part
from lbsfit_np.starts.scale import reference_scale

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


def _scans(rig, n, **settings):
    made = {"poses": "natural", "n_points": 1500, "holes": 0, "cropped": 0.5, "random_state": 11} | settings
    return lbs.synthesize(rig, n, **made)


def _off(rig, scan, result):
    """How far each joint that moves is off whose part has points, in shares of the size."""
    shown = np.bincount(scan.labels, minlength=len(rig.parts))[rig.part_of_joint] >= 20
    return np.linalg.norm(result.joints - scan.joints, axis=1)[shown & rig.moving] / (rig.size * scan.scale)


@pytest.mark.slow
def test_with_known_labels_what_is_shown_is_right(hand):
    fitter = lbs.LBSFitter(hand, cropped=True, orientation="aligned", random_state=0)
    off = [_off(hand, s, fitter.fit_scan(s.points, labels=s.labels)) for s in _scans(hand, 3)]
    assert max(o.mean() for o in off) < 0.01 and max(o.max() for o in off) < 0.03


@pytest.mark.slow
def test_a_start_that_is_right_stays_right_at_its_size(tube_rig, tube_fitter, fitter):
    """Unless it is said, surface beyond the edge draws what is shown."""
    off, sizes = [], []
    fitter.segmenter_, fitter.regressor_ = tube_fitter.segmenter_, tube_fitter.regressor_
    for cropped in (False, True):
        fitter.set_params(cropped=cropped)
        for scan in _scans(tube_rig, 4, poses="uniform", n_points=700, shape=0.0):
            result = fitter.fit_scan(scan.points, theta0=scan.pose)
            off.append(_off(tube_rig, scan, result).max())
            sizes.append(result.scale / scan.scale)
    assert max(off[4:]) < 0.03 and np.median(off[4:]) < 0.5 * np.median(off[:4]), off
    np.testing.assert_allclose(sizes[4:], 1.0, atol=0.05)


@pytest.mark.parametrize("scale", ["fixed", "estimate"])
def test_a_small_part_may_be_in_the_rigs_unit(scale, tube_rig):
    """Unless it is said, a quarter of the rig's extent is none that a scan may have."""
    points = tube_rig.vertices[tube_rig.vertices[:, 1] < tube_rig.vertices[:, 1].min() + 0.25 * tube_rig.size]
    assert reference_scale(points, tube_rig, scale, cropped=True).scale == 1.0
    known = {"most": 100, "rng": np.random.default_rng(0), "scale": scale}
    assert taking_part(points, tube_rig, cropped=True, **known).scale == 1.0
    if scale == "fixed":
        with pytest.raises(InputError, match="a scan in the rig's unit"):
            reference_scale(points, tube_rig, scale)
    else:
        assert reference_scale(points, tube_rig, scale).scale != 1.0
    with pytest.raises(InputError, match="scale: got 'fixed' for a scan whose extent is 0.03.* times the rig's"):
        reference_scale(0.1 * points, tube_rig, "fixed", cropped=True)


@pytest.mark.usefixtures("hurried")
@pytest.mark.filterwarnings("ignore:.*fit:UserWarning")  # in a hurry most are wrong
@pytest.mark.slow
def test_what_takes_part_is_looked_at_as_of_a_part(tube_rig, quick_fitter):
    """Everywhere: in fits of single scans, in collections, and after learning; not where vertices move freely."""
    points = tube_rig.vertices[tube_rig.vertices[:, 1] < tube_rig.vertices[:, 1].min() + 0.25 * tube_rig.size]
    fixed = {"scale": "fixed", "training_scans": 2, "training": {"n_points": 100}, "effort": "fast", "rounds": 1, "held_out": 0}
    fitter = copy.copy(quick_fitter).set_params(cropped=True, **fixed)
    whole = lbs.synthesize(tube_rig, 3, random_state=3, n_points=300, shape=0.0)
    assert np.isfinite(fitter.fit_scan(points).vertices).all()
    learned = fitter.fit([*(s.points for s in whole), points])
    assert learned.failures_ == {} and np.isfinite(learned.fit_scan(points).vertices).all()
    with pytest.raises(InputError, match="scale: got 'fixed'"):
        copy.copy(quick_fitter).set_params(cropped=False, **fixed).fit_scan(points)
    with pytest.raises(InputError, match="scale: got 'fixed'"):
        lbs.LBSFitter(tube_rig, cropped=True, variant="free-form", scale="fixed").fit_scan(points)


def test_scans_of_parts_are_not_taken_for_those_in_another_unit(tube_rig):
    low = tube_rig.vertices[:, 1].min()
    scans = [tube_rig.vertices[tube_rig.vertices[:, 1] < low + share * tube_rig.size] for share in (1.0, 1.0, 1.0, 0.15)]
    known = {"max_points": 300, "held_out": 0.0, "scale": "estimate", "random_state": 0}
    with pytest.raises(InputError, match="different units"):
        read_collection(tube_rig, [s * size for s, size in zip(scans, (7.0, 1.0, 7.0, 1.0))], None, **known)
    found = read_collection(tube_rig, scans, None, cropped=True, **known)
    assert found.failures == {} and len({m.unit for m in found.members}) == 1


def test_training_is_on_cropped_scans(tube_rig):
    for given, share in (({"cropped": True}, 0.6), ({"cropped": True, "training": {"cropped": 0.2}}, 0.2), ({}, 0.0)):
        assert lbs.LBSFitter(tube_rig, **given)._synthesis().cropped == share


def test_what_is_no_flag_is_refused(tube_rig):
    with pytest.raises(InputError, match="cropped: got 0.5; expected True or False"):
        lbs.fit_scan(tube_rig, np.zeros((10, 3)), cropped=0.5)


@pytest.mark.study
@pytest.mark.parametrize("shape, most", [(0.0, 0.005), (0.08, 0.03)])
def test_parts_of_hands_are_fitted_without_labels(shape, most, hand):
    """Of the rig's own shape, and of other people's."""
    fitter = lbs.LBSFitter(hand, cropped=True, training_scans=1000, random_state=0).pretrain()
    off = [_off(hand, s, fitter.fit_scan(s.points)).mean() for s in _scans(hand, 6, holes=2, shape=shape)]
    assert np.median(off) < most and sum(o < 0.03 for o in off) >= 5, off
