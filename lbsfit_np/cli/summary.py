"""``summary.json``: what a run did with each scan, with which settings and versions."""

import platform
import time

from .outputs import SUMMARY

__all__ = ["counts_of", "write_summary"]


def counts_of(entries):
    """How many scans came out how; ``entries`` as in :func:`write_summary`."""
    return {s: sum(e["status"] == s for e in entries.values()) for s in ("ok", "skipped", "failed")}


def write_summary(out, rig_path, rig, files, entries, values, *, started, stopped, **more):
    """Write ``summary.json``.

    Parameters
    ----------
    out : Path
        The folder.
    rig_path : str
    rig : Rig
    files : sequence of ScanFiles
        Of all scans.
    entries : dict of name to entry
        Of the scans that were dealt with, see ``outputs.entry``.
    values : dict
        The settings.
    started : float
        ``time.perf_counter`` at the start.
    stopped : bool
        Whether the run was ended before its end.
    **more
        Further keys.
    """
    from ..io.write import write_json

    summary = {
        "rig": {"path": str(rig_path), "name": rig.name, "digest": rig.digest, "parts": rig.parts, "notes": rig.notes},
        "scans": [entries[f.name] for f in files if f.name in entries],
        "not_done": [f.name for f in files if f.name not in entries],
        "counts": counts_of(entries),
        "stopped": stopped,
        "seconds": round(time.perf_counter() - started, 3),
        "seed": values["seed"],
        "settings": values,
        "versions": _versions(),
        **more,
    }
    write_json(out / SUMMARY, summary)


def _versions():
    from importlib.metadata import version

    from .. import __version__

    libraries = ("numpy", "scipy", "scikit-learn", "trimesh")
    return {"lbsfit_np": __version__, "python": platform.python_version(), **{name: version(name) for name in libraries}}
