"""Correspondence between scans whose truth is known: ‖found − true‖ over pairs of scans, by fits of a rig.

A place of scan A goes through the registrations to scan B, see ``correspondence.transfer``. Pairs are ordered: (A, B) and (B, A)
ask for different places.
"""

import time

import numpy as np

from ..correspondence import at_places, surface_places
from ..errors import InputError, LbsfitError, as_floats, check_array, counted, did_you_mean, listed
from ..neighbors import PointIndex
from ..seeds import generator
from .environment import environment
from .pair_fits import fit_scans_of
from .truth import note_on_truth

__all__ = [
    *("KINDS", "choose_pairs", "in_another_unit", "measure_pairs", "pairs_bench"),
    *("pairs_table", "read_all", "summary", "unit_of"),
]

# Pairs of scans of one subject, and of different ones.
KINDS = ("intra", "inter")
_PERCENTILES = (50, 90, 95)


def pairs_bench(
    fitter,
    scans,
    truth,
    folder,
    *,
    also=(),
    learn=True,
    most_pairs=500,
    points=5000,
    seed=0,
    unit="auto",
    settings=None,
    jobs=1,
    reporter=None,
    **options,
):
    """Fit scans and measure correspondences between them.

    Parameters
    ----------
    fitter : LBSFitter
    scans : sequence of PairScan
    truth : of ``bench.truth``, or None
        Where nothing is known, nothing is measured.
    folder : Path
        There already; for the fits.
    also : sequence of PairScan
        Scans to fit, too, after those that are learned from.
    learn : bool, default True
        Whether ``LBSFitter.fit`` learns from all of ``scans`` first; else they are fitted one by one.
    most_pairs : int, default 500
        Pairs of each kind, at most: a random choice where there are more.
    points : int, default 5000
        Places of a scan that are asked for, at most: a random choice, the same in all its pairs.
    seed : int, default 0
        Of both.
    unit : {"auto", "m", "cm", "mm", "in", "ft"}
        Of the scans; "auto": what the scale of the fits says.
    settings, jobs, reporter, **options
        As for ``pair_fits.fit_scans_of``; ``reporter.measured(done, total)`` and ``reporter.noted(words)`` as well.

    Returns
    -------
    report : dict
        Plain data for JSON. "notes": what people should know of the figures.
    fits : Fits

    Raises
    ------
    InputError, FileError
        As ``fit_scans_of``; a truth that does not fit the scans; scans in so many units that no pair is in one.
    """
    started = time.perf_counter()
    tell = getattr(reporter, "noted", lambda words: None)
    readable, notes = read_all(scans, truth)
    for note in notes:  # before hours of work
        tell(note)
    pairs = {} if truth is None else choose_pairs(scans, truth, most_pairs, seed)
    if truth is not None and not any(pairs.values()):
        raise InputError("truth", "no two scans with places in common", "names that occur on several scans")
    learn_from, everyone = readable if learn else (), [*scans, *also]
    options |= {"settings": settings, "jobs": jobs, "reporter": reporter}
    fits = fit_scans_of(fitter, everyone, folder, learn_from=learn_from, **options)
    later = _not_learned(fits, learn_from)
    odd = {} if truth is None else in_another_unit(scans, fits)
    pairs, apart = _without(pairs, {i for i, s in enumerate(scans) if s.name in odd})
    if odd and not any(pairs.values()):
        got = f"{listed(list(odd), 5)} in another unit than the others, and no pair without {'it' if len(odd) == 1 else 'them'}"
        raise InputError("scans", got, "scans in one unit", "Convert them and run again; fits of the others are kept.")
    if odd:
        later.append(_apart(odd, sum(apart.values()), learn))
    for note in later:
        tell(note)
    registered = {s.name: fits.load(s.name).vertices for s in scans if truth is not None and fits.has(s.name)}
    how = {"points": points, "seed": seed, "on_pair": getattr(reporter, "measured", None)}
    measured = measure_pairs(scans, truth, registered, fitter.rig.faces, pairs, **how)
    for kind, n in apart.items():
        measured["figures"][kind]["other_unit"] = n
    name, cm = unit_of(fitter.rig, fits, unit, without=odd)
    report = {
        "benchmark": "pairs",
        "environment": environment(),
        "settings": {**(settings or {}), "learn": learn, "pairs": most_pairs, "points": points, "seed": seed, "jobs": jobs},
        "rig": {"name": fitter.rig.name, "digest": fitter.rig.digest, "vertices": len(fitter.rig.vertices)},
        "truth": None if truth is None else truth.what,
        "unit": name,
        "cm_per_unit": cm,
        "history": fits.history,
        "notes": notes + later,
        "scans": [_told(s, fits) for s in everyone],
        **measured,
        "seconds": round(time.perf_counter() - started, 2),
    }
    return report, fits


def read_all(scans, truth):
    """The scans that can be read, once the truth is known to fit them; others are left to the fits, which say what is wrong.

    And notes on a truth that lies beside its scans.
    """
    readable, off = [], {}
    for i, scan in enumerate(scans):
        points = _points(scan)
        if points is None:
            continue
        try:
            if truth is not None:
                truth.check(i, points)
                off[scan.name] = truth.off(i, points)
        except InputError as error:
            raise InputError(f"{error.argument} of {scan.path}", error.got, error.expected, error.remedy) from None
        readable.append(scan)
    return readable, [] if truth is None else note_on_truth(truth.what, off)


def choose_pairs(scans, truth, most, seed):
    """Ordered pairs of scans of which something is known, at most so many of a kind: kind → list of (a, b), indices of scans."""
    found = {kind: [] for kind in KINDS}
    for a in range(len(scans)):
        for b in range(len(scans)):
            if a != b and truth.linked(a, b):
                found["intra" if scans[a].subject == scans[b].subject else "inter"].append((a, b))
    for kind, pairs in found.items():
        if len(pairs) > most:
            rows = np.sort(generator(seed, "pairs", kind).choice(len(pairs), most, replace=False))
            found[kind] = [pairs[k] for k in rows]
    return found


def measure_pairs(scans, truth, registered, faces, pairs, *, points=5000, seed=0, on_pair=None):
    """How far what is found is from the truth.

    Parameters
    ----------
    scans, truth
        As of :func:`pairs_bench`.
    registered : mapping of str to (m, 3) array
        By the scan's name, whatever has found it, in the scan's frame; scans that are not there, None, or NaN have none.
    faces : (F, 3) int array
        Of all registrations.
    pairs : dict
        Of :func:`choose_pairs`.
    points, seed
        As of :func:`pairs_bench`.
    on_pair : callable (done, total), optional
        Called before the first pair, too.

    Returns
    -------
    dict
        "pairs": for each one that could be measured "a", "b", "kind", "points", and "before" and "after" the snap a
        :func:`summary`; "figures": kind → the same over all points of all its pairs, "pairs" of them, and how many are "missing"
        as one of the scans has no registration, or no place that was drawn is known on both. Lengths in the scans' unit.

    Raises
    ------
    InputError
        Registrations of no scan, or not of the mesh of the faces.
    """
    known = {(a, b): kind for kind, chosen in pairs.items() for a, b in chosen}
    there = _checked(scans, registered, faces)
    todo = sorted((p for p in known if there.keys() >= set(p)), key=lambda p: (p[1], p[0]))
    told = on_pair or (lambda done, total: None)
    if todo:
        told(0, len(todo))
    asked = {a: _Places.of(scans[a], a, truth, there[a], faces, points, seed) for a in sorted({a for a, _ in todo})}
    entries, errors, target = [], {kind: {"before": [], "after": []} for kind in KINDS}, (None, None)
    for done, (a, b) in enumerate(todo, 1):
        if target[0] != b:
            target = b, PointIndex(_points(scans[b]))
        on_b = target[1]
        rows, true = truth.true(asked[a].asked, b, on_b)
        if len(rows):  # else the places that were drawn are not known on both
            found = asked[a].on(there[b], rows)
            away = {"before": _distances(found, true), "after": _distances(on_b.points[on_b.nearest(found)], true)}
            kind = known[a, b]
            entry = {"a": scans[a].name, "b": scans[b].name, "kind": kind, "points": len(rows)}
            entries.append(entry | {when: summary(values) for when, values in away.items()})
            for when, values in away.items():
                errors[kind][when].append(values)
        told(done, len(todo))
    figures = {}
    for kind, chosen in pairs.items():
        measured = errors[kind]
        count = len(measured["before"])
        figures[kind] = {"pairs": count, "missing": len(chosen) - count}
        figures[kind] |= {when: summary(np.concatenate([*values, []])) for when, values in measured.items()}
    return {"pairs": entries, "figures": figures}


def _checked(scans, registered, faces):
    """Scan → its registration as an array, of those that have one; all of one mesh, whose last vertices may be of no face."""
    names, found = {s.name: i for i, s in enumerate(scans)}, {}
    for name, V in registered.items():
        what = f"registered[{name!r}]"
        if name not in names:
            raise InputError(what, "the name of no scan", f"names such as {scans[0].name!r}", did_you_mean(name, names))
        if V is None:
            continue
        V = as_floats(what, V, "numbers of shape (m, 3)")
        m = len(next(iter(found.values()), V))
        if V.shape != (m, 3) or m <= faces.max():
            m = max(m, int(faces.max()) + 1)
            raise InputError(what, f"shape {V.shape}", f"shape ({m}, 3), the vertices of one mesh with these faces")
        if np.isnan(V).all():
            continue
        found[names[name]] = check_array(what, V, V.shape)
    return found


def summary(errors):
    """Mean and percentiles of distances; None each where there are none."""
    if not len(errors):
        return dict.fromkeys(("mean", "median", "p90", "p95"))
    median, p90, p95 = np.percentile(errors, _PERCENTILES)
    return {"mean": float(np.mean(errors)), "median": float(median), "p90": float(p90), "p95": float(p95)}


def in_another_unit(scans, fits):
    """Scans whose unit is another than that of the others: name → its fit's scale, in the median of the others'.

    Both its fit's scale and its extent are unlike the others' by more than subjects of one rig are: a fit may be of a wrong
    scale, and a scan may show a small part.
    """
    from ..learning.reading import odd_ones
    from ..starts.scale import SUBJECTS, extent

    fitted = [s for s in scans if "scale" in fits.entries.get(s.name, ())]
    scales = np.array([fits.entries[s.name]["scale"] for s in fitted])
    if not len(scales) or not len(odd := odd_ones(scales, SUBJECTS)):
        return {}
    extents = {k: extent(points) for k, scan in enumerate(fitted) if (points := _points(scan)) is not None}
    there = [k for k in extents if extents[k] > 0]
    odd = sorted({*odd.tolist()} & {there[k] for k in odd_ones(np.array([extents[k] for k in there]), SUBJECTS)})
    usual = np.median(np.delete(scales, odd))
    return {fitted[k].name: float(scales[k] / usual) for k in odd}


def _without(pairs, odd):
    """The pairs without those of odd scans, and how many those are: kind → number, empty where no scan is odd."""
    kept = {kind: [p for p in chosen if odd.isdisjoint(p)] for kind, chosen in pairs.items()}
    return kept, {kind: len(pairs[kind]) - len(kept[kind]) for kind in pairs} if odd else {}


def _apart(odd, n, learned):
    """The note on scans in another unit."""
    one, ratios = len(odd) == 1, sorted(odd.values())
    factors = " to ".join(dict.fromkeys(f"{ratio:.4g}" for ratio in (ratios[0], ratios[-1])))
    whose = f"the scale of its fit is {factors} times" if one else f"the scales of their fits are {factors} times"
    again = f"convert {'it' if one else 'them'} and run again" + " with --existing replace" * learned
    words = f"{listed(list(odd), 5)} {'seems' if one else 'seem'} to be in another unit than the other scans ({whose} theirs)"
    return f"{words}: {counted(n, 'pair')} left out of the figures; {again}"


def _told(scan, fits):
    """What the report says of a scan."""
    why = {"not_learned": fits.not_learned[scan.name]} if scan.name in fits.not_learned else {}
    return {"name": scan.name, "file": scan.path.name, "subject": scan.subject, **fits.entries[scan.name], **why}


def _not_learned(fits, learn_from):
    """A note, in a list, on scans of which learning has no result, but that have a fit all the same; others fail anyway."""
    left = {name: fits.not_learned[name] for name in fits.not_learned if fits.has(name)}
    if not left:
        return []
    name = next(iter(left))
    more = f"; also {listed(list(left)[1:], 5)}, see results.json" if len(left) > 1 else ""
    return [f"{len(left)} of {counted(len(learn_from), 'scan')} without a result of learning: {name}: {left[name]}{more}"]


def unit_of(rig, fits, given="auto", *, without=()):
    """The scans' unit, and centimetres in it: (name, number), or ("unknown", None).

    What the fits were told, else by their median scale, where the rig's own unit is known: people differ less than units do.
    ``without`` has names of scans that do not count.
    """
    from ..rig.units import METRES
    from ..starts.scale import likely_unit

    scales = [entry["scale"] for name, entry in fits.entries.items() if "scale" in entry and name not in without]
    said = {entry["unit"] for entry in fits.entries.values() if entry.get("unit")}
    if given == "auto" and len(said) == 1:
        (given,) = said
    elif given == "auto":
        given = likely_unit(float(np.median(scales)), rig) if scales else None
    return (given, METRES[given] / METRES["cm"]) if given else ("unknown", None)


class _Places:
    """What is asked of a scan, and where that is on its registration."""

    def __init__(self, asked, corners, barycentric):
        self.asked, self.corners, self.barycentric = asked, corners, barycentric

    @classmethod
    def of(cls, scan, i, truth, registration, faces, most, seed):
        asked = truth.asked(i, _points(scan), most, generator(seed, "places", scan.name))
        return cls(asked, *surface_places(asked.points, registration, faces))

    def on(self, registration, rows):
        """(k, 3) the same places of another registration."""
        return at_places(self.corners[rows], self.barycentric[rows], registration)


def _points(scan):
    """Of its file, all of them; None where it cannot be read."""
    from ..io.scans import load_scan

    try:
        return load_scan(scan.path).points
    except LbsfitError:
        return None


def _distances(a, b):
    return np.linalg.norm(a - b, axis=1)


# ---- the table ----


def pairs_table(report, *, markdown=False):
    """The figures of a report of :func:`pairs_bench`: intra and inter, before and after the snap."""
    from .table import layout

    unit, cm = report["unit"], report["cm_per_unit"]
    both = cm not in (None, 1.0)
    heads = ("mean", "median", "90 %", "95 %")
    lines = [("pairs", "", "measured", "missing", *heads, *(f"{h} (cm)" for h in heads if both))]
    for kind, figures in report["figures"].items():
        if not figures["pairs"] + figures["missing"]:
            continue
        for when, words in (("before", "before the snap"), ("after", "after the snap")):
            values = [figures[when][key] for key in ("mean", "median", "p90", "p95")]
            cells = [_cell(v, ".4g") for v in values] + [_cell(v and v * cm, ".2f") for v in values if both]
            lines.append((kind, words, str(figures["pairs"]), str(figures["missing"]), *cells))
    return f"{layout(lines, markdown=markdown)}\n\n{_legend(report, unit, cm)}"


def _cell(value, style):
    return "–" if value is None else format(value, style)


def _legend(report, unit, cm):
    settings, env = report["settings"], report["environment"]
    n, failed = len(report["scans"]), sum("failed" in s for s in report["scans"])
    lengths = "the scans' unit, which is not known" if cm is None else f"the scans' unit ({unit})"
    fitted = "learned together" if settings["learn"] else "fitted one by one"
    missing = f", {failed} of them without a fit" if failed else ""
    return "\n".join(
        (
            f"‖found − true‖ over all points of all pairs, at most {settings['points']} points a pair and {settings['pairs']} "
            f"pairs of a kind; lengths in {lengths}.",
            f"{n} scans {fitted}{missing}; rig {report['rig']['name']}, truth: {report['truth']}, seed {settings['seed']}; "
            f"lbsfit_np {env['lbsfit_np']}.",
        )
    )
