"""``summary.json``: what a run did with each scan, with which settings and versions."""

import json
import os
import platform
import time

from ..errors import listed
from .progress import in_digits, say

__all__ = ["SUMMARY", "counts_of", "doubts_of", "earlier_fits", "is_of_others", "say_doubtful", "write_summary", "written_of"]

SUMMARY = "summary.json"
# Below this probability a fit is named even if it is ok; so many names.
_SURE, _NAMED = 0.8, 5


def counts_of(entries):
    """How many scans came out how, how many of the failed ones have no fit, how many of all were kept.

    ``entries`` as in :func:`write_summary`.
    """
    counts = {s: sum(e["status"] == s for e in entries.values()) for s in ("ok", "suspect", "failed")}
    unfitted = sum(e["status"] == "failed" and "files" not in e for e in entries.values())
    return counts | {"unfitted": unfitted, "kept": sum(e.get("kept", False) for e in entries.values())}


def doubts_of(counts):
    """How many scans have no fit, and in brackets how many fits have which status; nothing where all are well."""
    fits = {"ok": counts["ok"], "suspect": counts["suspect"], "failed": counts["failed"] - counts["unfitted"]}
    unfitted = f", {counts['unfitted']} could not be fitted" if counts["unfitted"] else ""
    if not fits["suspect"] + fits["failed"]:
        return unfitted
    return f"{unfitted} (status: {', '.join(f'{n} {status}' for status, n in fits.items() if n)})"


def written_of(entries):
    """How many of this run's scans have their files."""
    return sum("files" in e for e in entries.values())


def doubtful_first(entries):
    """Entries, those that failed first, then suspects, the least probable first; the others in their order."""

    def rank(e):
        doubt = {"failed": 0, "suspect": 1}.get(e["status"], 2)
        return doubt, e.get("probability", 0.0) if doubt < 2 else 0.0

    return sorted(entries, key=rank)


def say_doubtful(entries):
    """What to look at, on standard output; nothing where all are well.

    A table of the scans that failed or are suspect, a line for each reason, and then a line of fits that are hardly better.
    """
    _say_suspects(entries)
    unsure = sorted((e for e in entries if e["status"] == "ok" and _is_unsure(e)), key=lambda e: e["probability"])
    if unsure:
        named = listed([f"{e['name']} ({in_digits(e['probability'], _SURE)})" for e in unsure], _NAMED)
        are = "fit is ok, but" if len(unsure) == 1 else "fits are ok, but each"
        say(f"note: {len(unsure)} {are} right with a probability below {_SURE} only: {named}")


def _is_unsure(entry):
    """Whether a fit is that nothing is told against; free-form ones have no evidence, and no probability."""
    return bool(entry.get("evidence")) and entry["probability"] < _SURE


def _say_suspects(entries):
    doubtful = [e for e in doubtful_first(entries) if e["status"] in ("failed", "suspect")]
    if not doubtful:
        return
    rows = [("scan", "status", "probability", "why")]
    for e in doubtful:
        probability = in_digits(e["probability"]) if "probability" in e else "–"
        first, *others = e["message"].split("; ") if "probability" in e else [e["message"]]  # errors are one line
        rows += [(e["name"], e["status"], probability, first), *(("", "", "", why) for why in others)]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    for row in rows:
        say("  ".join([*(cell.ljust(width) for cell, width in zip(row, widths)), row[3]]))


def is_of_others(path):
    """Whether there is a file in the summary's place that this package has not written, as far as it can be read."""
    return os.path.isfile(path) and _read(path) is None  # one that cannot be read is not for writing over


def earlier_fits(folder):
    """Names of the files of fits that are older than the last run in a folder, which could not fit their scans."""
    scans = (_read(os.path.join(folder, SUMMARY)) or {}).get("scans")
    return {e["earlier"] for e in (scans if isinstance(scans, list) else ()) if isinstance(e, dict) and "earlier" in e}


def _read(path):
    """A summary that this package has written; None where there is none."""
    try:
        with open(path, encoding="utf-8") as file:
            found = json.load(file)
    except (OSError, ValueError, RecursionError):
        return None
    ours = isinstance(found, dict) and isinstance(found.get("versions"), dict) and "lbsfit_np" in found["versions"]
    return found if ours else None


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
        Of the scans that were dealt with, see ``scan_results.entry``.
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
        "scans": doubtful_first([entries[f.name] for f in files if f.name in entries]),
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
