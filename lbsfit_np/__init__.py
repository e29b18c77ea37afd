"""Fit rigged meshes to point clouds: joint angles, a registered mesh and part labels. NumPy, SciPy, scikit-learn, trimesh."""

import importlib as _importlib

__version__ = "0.1.0"

# Public names and where they live; loaded on first use, so that importing the package stays fast.
_HOMES = {
    "Rig": "rig.rig",
    "bundled_rigs": "io.rigs",
    "load_rig": "io.rigs",
    "Scan": "scan",
    "load_scan": "io.scans",
    "losses": None,
    "natural_poses": "synthesis",
    "synthesize": "synthesis",
    "LBSFitter": "learning.fitter",
    "fit_scan": "learning.one_call",
    "fit_scans": "learning.batch",
    "FitResult": "fitting.result",
    "write_mesh_ply": "io.write",
    "write_points_ply": "io.write",
    "save_animation": "report.animation",
    "transfer": "correspondence",
    "LbsfitError": "errors",
    "InputError": "errors",
    "FileError": "errors",
    "MissingExtraError": "errors",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _HOMES[name]
    if home is None:
        return _importlib.import_module(f".{name}", __name__)
    value = getattr(_importlib.import_module(f".{home}", __name__), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted({*globals(), *_HOMES})
