"""Joints that are guesses: which they are, and how many of those that a scan could tell."""

from dataclasses import replace

import numpy as np
import pytest
from made_fits import MadeFits, hands_with_arms
from scipy import sparse

import lbsfit_np as lbs
from lbsfit_np.fitting.assemble import _guessed, guesses

_HARDLY = "the scan hardly tells where these joints are (see joint_std): "


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


def test_joints_without_skin_are_not_named_as_guesses(hand):
    """No scan could tell where they are, such as a root on the ground between the feet."""
    skinned = np.arange(16) != 5
    bare = replace(hand, weights=sparse.csr_array(hand.weights @ sparse.diags_array(skinned.astype(float))))
    found = [guesses(r, np.where(skinned, 0.0, 0.1) * hand.size, 1.0)[0] for r in (hand, bare)]
    named = [_guessed([hand.joint_names[j] for j in rows]) for rows in found]
    assert [rows.tolist() for rows in found] == [[5], []] and named == [f"{_HARDLY}{hand.joint_names[5]}", ""]
    rows, _ = guesses(bare, np.linspace(0.1, 0.2, 16)[::-1] * hand.size, 1.0)
    assert len(rows) and 5 not in rows


def test_guesses_are_counted_among_joints_that_a_scan_could_tell(hand):
    """Those that turn and have skin, by their places in shares of the result's size."""
    J = np.arange(16)
    weights = sparse.csr_array(hand.weights @ sparse.diags_array((J != 5).astype(float)))
    some = replace(hand, weights=weights, locked=np.isin(J, [2, 3, 4]))
    assert guesses(hand, np.full(16, 0.021 * hand.size), 1.0)[1] == 1.0
    std = np.where(np.isin(J, [2, 3, 5, 7, 8, 9]), 0.021, 0.019) * hand.size
    std[8] += 1e-3
    for scale in (1.0, 40.0):
        rows, share = guesses(some, scale * std, scale)
        assert rows.tolist() == [8, 7, 9] and share == 3 / 12
    assert guesses(some, std, 2.0)[1] == 0.0 and guesses(some, np.full(16, np.nan), 1.0)[1] == 0.0
    none = replace(hand, weights=sparse.csr_array(0 * hand.weights))
    assert guesses(none, std, 1.0)[1] == 0.0


def test_a_second_look_counts_them_as_results_do(hand):
    """Among the twelve joints that turn and have skin here."""
    scan = max(hands_with_arms(hand), key=lambda s: len(s.points))
    ends = {"hand_end": ("true", 0.3), "arm_end": ("turned", 0.1), "hand": ("true", 0.9)}
    J = np.arange(16)
    weights = sparse.csr_array(hand.weights @ sparse.diags_array((J != 15).astype(float)))
    rig = replace(hand, weights=weights, locked=np.isin(J, [12, 13, 14]))
    for n, looked in ((4, True), (5, False)):
        fits = MadeFits(rig, scan, all=("true", 0.2, n), **ends)
        fits()
        assert (fits.of[1] == "hand") == looked
