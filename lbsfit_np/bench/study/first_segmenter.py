"""What the segmenters of the study's rows begin with.

A size that trains on fewer synthetic scans than LBSFitter does by default takes the segmenter that comes with the package, if the
rig has one: it costs no time, and whoever fits that rig begins with it, too.
"""

from ...learning.pretraining import shipped_path
from ...segmentation.segmenter import Segmenter
from ..run import TRAINING_SEED

__all__ = ["first_scans", "first_segmenter"]


def first_scans(rig, size):
    """The number of synthetic scans that the segmenter has been trained on before learning.

    Parameters
    ----------
    rig : Rig
    size : Size
    """
    default, path = _shipped(rig)
    return default if path is not None and size.training_scans < default else size.training_scans


def first_segmenter(rig, size):
    """The segmenter to begin with, None where it is to be trained on the size's scans.

    Raises
    ------
    FileError
        The package's file is broken.
    """
    return None if first_scans(rig, size) == size.training_scans else Segmenter.load(_shipped(rig)[1])


def _shipped(rig):
    """The scans of a segmenter of the default settings, and the package's file of it for a rig, or None."""
    from ...learning.fitter import LBSFitter
    from ...learning.training import training_settings

    default = LBSFitter(rig)
    made_of = rig, training_settings(default.training), default.training_scans
    return default.training_scans, shipped_path(*made_of, random_state=TRAINING_SEED)
