"""Where the files lie that come with the package: its rigs, and the segmenters that were trained for them."""

from pathlib import Path

__all__ = ["bundled_files"]


def bundled_files(pattern):
    """Stem → path of the package's own files that match; in a checkout they lie in rigs/ beside the package.

    Parameters
    ----------
    pattern : str
        Of the path within that folder, such as ``*.npz``.
    """
    package = Path(__file__).resolve().parent
    installed = package / "rigs"
    folder = installed if installed.is_dir() else package.parent / "rigs"
    return {p.stem: p for p in folder.glob(pattern)}
