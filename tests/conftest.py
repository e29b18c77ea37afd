"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_rigs():
    """The folder of real rigs, poses and motion; absent on a user's machine."""
    named = os.environ.get("LBSFIT_SHARED_RIGS")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "rigs"
    if not folder.is_dir():
        pytest.skip("the folder of real rigs is not here (set LBSFIT_SHARED_RIGS to where it is)")
    return folder


@pytest.fixture(scope="session")
def tube_rig():
    """A small watertight rig of four joints; see ``small_rigs.py``. Rigs are immutable, so that all tests share it."""
    from small_rigs import make_tube_rig

    return make_tube_rig()


@pytest.fixture(scope="session")
def tube_fitter(tube_rig):
    """A fitter of the tube rig with a segmenter of its own, trained for a few seconds."""
    from lbsfit_np import LBSFitter

    return LBSFitter(tube_rig, training_scans=300, random_state=0).pretrain()
