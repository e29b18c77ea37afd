"""Where the files lie that come with the package: its rigs, and the segmenters that were trained for them."""

import importlib.resources
from pathlib import Path

__all__ = ["bundled_files"]


def bundled_files(pattern):
    """Stem → path of the package's own files that match; in a checkout they lie in rigs/ beside the package.

    Parameters
    ----------
    pattern : str
        Of the path within that folder, such as ``*.npz``.
    """
    beside = Path(__file__).resolve().parents[1]
    folder = beside / "rigs"
    if not (beside / "setup.cfg").is_file():  # installed; of two checkouts, each has its own
        try:
            folder = Path(str(importlib.resources.files("lbsfit_np.rigs")))
        except (ModuleNotFoundError, TypeError):
            pass
    return {p.stem: p for p in folder.glob(pattern)}
