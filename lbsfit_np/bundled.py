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
    folders = []
    try:
        folders.append(Path(str(importlib.resources.files("lbsfit_np.rigs"))))
    except (ModuleNotFoundError, TypeError):
        pass
    folders.append(Path(__file__).resolve().parents[1] / "rigs")
    for folder in folders:
        if folder.is_dir() and (found := {p.stem: p for p in folder.glob(pattern)}):
            return found
    return {}
