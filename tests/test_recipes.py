"""What is trained is what it was when its recipe got its number: results of an earlier state of the code are never taken for it.

Where one of these fails, and is meant to: raise that kind's number in ``segmentation.cache.RECIPES``, put the new numbers here,
and for segmenters run ``python -m rigs.train``.
"""

import numpy as np
import pytest
from segmenter_training import train_small

import lbsfit_np as lbs
from lbsfit_np.learning.training import StartScans, TrainingScans, training_settings
from lbsfit_np.segmentation import cache
from lbsfit_np.starts import library
from lbsfit_np.starts.library import build_library

KINDS = {"whole": {}, "one side": {"partial": True}, "cropped": {"cropped": True}, "both": {"partial": True, "cropped": True}}
# Of the first two scans: points by 1, 2, 3 in all, and labels by 0, 1, 2, ….
SCANS = {
    (TrainingScans, "whole"): (327.5016003074849, 12210147, 345.6111319677017, 14633472),
    (TrainingScans, "one side"): (168.51973436518108, 6843186, 421.6398817232722, 15661070),
    (TrainingScans, "cropped"): (317.5697264021435, 12090570, 347.025327452105, 19316409),
    (TrainingScans, "both"): (516.3091842299664, 13518418, 65.91935875203943, 1822195),
    (StartScans, "whole"): (570.7560187632595, 17775123, 151.08161397903874, 12393450),
    (StartScans, "one side"): (505.89344062698575, 20067139, 257.8157896072098, 17084885),
    (StartScans, "cropped"): (511.8711117819599, 26391432, 223.27037720981073, 23082445),
    (StartScans, "both"): (582.311914148659, 22972690, 30.726551110440255, 12446622),
}


def test_the_numbers_are_of_these_recipes():
    assert cache.RECIPES == {"segmenter": 4, "library": 4}


@pytest.mark.parametrize("scans, kind", SCANS)
def test_scans_to_train_on(scans, kind):
    made = scans(lbs.load_rig("hand-coarse").welded, training_settings(None, **KINDS[kind]), 0)
    numbers = []
    for i in range(2):
        points, labels = made(i)[:2] if scans is TrainingScans else (made(i).points, made(i).labels)
        numbers += [(points * [1, 2, 3]).sum(), (labels * np.arange(len(labels))).sum()]
    assert numbers == pytest.approx(SCANS[scans, kind], rel=1e-9)


def test_a_segmenter(tube_rig, tube_scan):
    proba = train_small(tube_rig).predict_proba(tube_scan.points)
    numbers = (proba * np.arange(1, proba.shape[1] + 1)).sum(), (proba**2).sum()
    assert numbers == pytest.approx((1909.2886133941033, 890.0490139915076), rel=1e-4)


def test_a_library_and_its_f(tube_rig, monkeypatch):
    monkeypatch.setattr(library, "_SO_MANY", 12)  # of more, f takes fewer epochs
    scans = StartScans(tube_rig, training_settings(None), 0)
    theta = build_library(scans, 24, random_state=0).regress(scans(30).points)
    numbers = np.abs(theta).sum(), (theta * np.arange(theta.size).reshape(theta.shape)).sum()
    assert numbers == pytest.approx((3.348581302911043, -1.6623148284852505), rel=1e-3)
