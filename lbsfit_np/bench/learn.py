"""Learning from a collection: the loop and its ablations on subjects with known truth, against scans fitted one by one.

Three changed shapes of a rig, the same number of scans of each, and a third as many more of the same people, which nobody
learns from, and on which the segmenter's labels are judged.
"""

import time
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ..errors import InputError
from ..learning.checkpoint import remove_checkpoint, steps_in
from ..seeds import generator
from ..skinning import skin
from ..synthesis import synthesize_one, uniform_poses
from . import body, hand
from .environment import environment
from .measure import joint_error, label_accuracy, vertex_error
from .resume import REMEDY, begun, check_same, checked_count, checked_seeds, is_done, renewed, unforeseen
from .run import BENCHES, TRAINING_SEED
from .subjects import files_digest, people_digest, scans_digest, subject
from .templates import learned_templates, template_gap, templates_of

__all__ = ["MEASURES", "VARIANT_ROWS", "collection", "learn_bench", "learn_table", "steps_of", "touching_pose"]

N_SUBJECTS = 3
VARIANT_ROWS = ("joint", "pose-only", "rand", "cd", "free-form")
# The row without learning: what is pretrained, and the rig's own template with proportions of each scan's own.
_ONE_BY_ONE = "one by one"
MEASURES = {
    "joint_error": "joints",
    "joint_error_median": "median",
    "vertex_error": "vertices",
    "template_gap": "template gap",
    "label_error": "label error, held out",
    "seconds": "s in all",
}
# By their names in ``template_gap``. Before is the rig's own.
_GAPS = {"template_gap": "after, up to a shift", "template_gap_in_place": "after", "template_gap_before": "before, up to a shift"}
# How far apart the middles of two fingertips are that touch, in half sizes of the hand.
_TOUCH = 0.13
_TRIES = 30


def collection(name, data, n_scans, *, seed):
    """The scans of a benchmark, those for judging labels, and the truth.

    Hand: a third of the poses uniform, a third natural ± 0.1 rad, a third with fingers that touch; the root turned up to
    ±0.6 rad an axis. Body: poses from motion, facing the rig's way.

    Parameters
    ----------
    name : {"hand", "body"}
    data : path-like
    n_scans : int
        Of all subjects together, to learn from; a third as many more for the labels.
    seed : int

    Returns
    -------
    rig : Rig
    scans : list of SyntheticScan
    subjects : list of int
    others : list of SyntheticScan
    """
    rig = hand.hand_rig(data) if name == "hand" else body.body_rig(data).welded
    settings = hand.SCAN if name == "hand" else body.SCAN
    templates = [subject(rig, generator(seed, "learn subject", k)) for k in range(N_SUBJECTS)]
    poses = _hand_poses(rig, data) if name == "hand" else _body_poses(rig, data, seed, n_scans)
    scans = []
    for i in range(n_scans + n_scans // 3):
        rng = generator(seed, "learn scan", i)
        scans.append(synthesize_one(rig, poses(i, rng), templates[i % N_SUBJECTS], settings, rng))
    return rig, scans[:n_scans], [i % N_SUBJECTS for i in range(n_scans)], scans[n_scans:]


def _hand_poses(rig, data):
    natural = hand.natural_poses(rig, data)

    def pose(i, rng):
        kind = i // N_SUBJECTS % 3
        if kind == 0:
            theta = uniform_poses(rig, 1, rng)[0]
        elif kind == 1:
            theta = natural[rng.integers(len(natural))] + 0.1 * rng.uniform(-1, 1, rig.lower.shape) * rig.turning
        else:
            theta = touching_pose(rig, natural, rng)
        theta[rig.root] = rng.uniform(-0.6, 0.6, 3)
        return theta

    return pose


def _body_poses(rig, data, seed, n_scans):
    from ..io.bvh import read_bvh
    from .retarget import bvh_thetas

    motion = read_bvh(_motion(data))
    body.check_frames(motion, n_scans, more=lambda n: n // 3)
    n = n_scans + n_scans // 3
    frames = generator(seed, "learn frames").choice(np.arange(1, len(motion.rotations)), n, replace=False)
    thetas = bvh_thetas(rig, motion, [int(f) for f in frames], face_forward=True)
    return lambda i, rng: thetas[i]


def _motion(data):
    return Path(data) / "motion" / "01_01.bvh"


def touching_pose(rig, natural, rng):
    """A pose between two natural ones in which two ends of limbs all but touch: the closest of some tries.

    Parameters
    ----------
    rig : Rig
    natural : (k, J, 3) array
    rng : numpy.random.Generator

    Returns
    -------
    (J, 3) array
    """
    moving = np.flatnonzero(rig.moving)
    ends = [j for j in moving if not any(rig.parents[c] == j for c in moving)]
    skins = [rig.weights[:, [j]].toarray().ravel() > 0.5 for j in ends]
    best = np.inf, None
    for _ in range(_TRIES):
        a, b = natural[rng.integers(len(natural), size=2)]
        t = rng.random()
        theta = (1 - t) * a + t * b + 0.25 * rng.uniform(-1, 1, rig.lower.shape) * rig.turning
        theta = np.clip(theta, rig.lower, rig.upper)
        theta[rig.root] = 0.0
        V = skin(rig, theta).vertices / (rig.size / 2)
        tips = np.array([V[rows].mean(axis=0) for rows in skins if rows.any()])
        apart = np.linalg.norm(tips[:, None] - tips, axis=2)[np.triu_indices(len(tips), 1)].min()
        best = min(best, (abs(apart - _TOUCH), theta), key=lambda found: found[0])
    return best[1]


def learn_bench(
    name,
    data,
    *,
    n_scans=60,
    seeds=(100, 101, 102),
    variants=VARIANT_ROWS[:4],
    training_scans=4000,
    jobs=1,
    before=None,
    steps=None,
    progress=None,
    on_row=None,
):
    """Learn from the collections with each variant, and compare with the truth.

    Parameters
    ----------
    name : {"hand", "body"}
    data : path-like
    n_scans : int, default 60
        Of all subjects together; one of each at least.
    seeds : sequence of int
        Of the collections; what is trained has its own.
    variants : sequence of str
        Of ``VARIANT_ROWS``.
    training_scans : int, default 4000
    jobs : int, default 1
    before : dict, optional
        A report of the same settings: what it has is not done again, unless scans failed as nobody foresaw.
    steps : path-like, optional
        Folder for the steps of each seed until all of it is done: a run that was stopped goes on within a variant, too. What is
        then made of the seed has None as its seconds. By default a temporary one.
    progress : callable (variant, seed, stage, share, figures), optional
        As for ``LBSFitter.fit``; variant and seed are None while what all share is trained.
    on_row : callable (report, variant, seed), optional
        After each variant of each seed, with the report so far; of each seed first "one by one".

    Returns
    -------
    dict
        Plain data for JSON. Lengths in half sizes of the rig (hand) or cm (body). "complete": all seeds, these and those of
        ``before``, have the same variants.

    Raises
    ------
    InputError
        Arguments that cannot be used; a report of other settings, of another rig or of other poses.
    """
    from sklearn.base import clone

    from ..learning.fitter import LBSFitter
    from ..learning.pretraining import share_pretraining

    seeds = checked_seeds(seeds)
    # With fewer, none is left to judge labels on, nor one to learn from beside the one held out.
    n_scans = checked_count("n_scans", n_scans, N_SUBJECTS, ", one of each person")
    if not variants or not set(variants) <= set(VARIANT_ROWS):
        raise InputError("variants", repr(variants), f"some of {', '.join(VARIANT_ROWS)}")
    collection(name, data, n_scans, seed=seeds[0])  # before the training, as there may be too few frames
    rig, some, *_ = collection(name, data, 3, seed=0)
    read = {"rig": rig.digest, "poses": _poses_digest(name, data), "people": people_digest(rig), "scans": scans_digest(rig, some)}
    empty = {
        "benchmark": f"learn {name}",
        "unit": "half size" if name == "hand" else "cm",
        "settings": {"n_scans": n_scans, "subjects": N_SUBJECTS, "training_scans": training_scans},
        "test_scans": asdict(hand.SCAN if name == "hand" else body.SCAN),
        **read,
        "rows": {},
    }
    report = begun(before, empty, same=("settings", "test_scans"))
    check_same(report, read)
    report = renewed(report, empty) | {"complete": False}
    if not set(report["rows"]) <= {_ONE_BY_ONE, *VARIANT_ROWS}:
        raise InputError("before", "results by an earlier version", "results of this version", REMEDY)
    # All scans face the rig's way.
    fitter = LBSFitter(rig, orientation="aligned", training_scans=training_scans, n_jobs=jobs, random_state=TRAINING_SEED)
    lacking = {seed: _lacking(report, seed, variants) for seed in seeds}
    if any(lacking.values()):
        fitter.pretrain(cache=True, progress=None if progress is None else lambda p: progress(None, None, "pretraining", p))
        first = fitter.segmenter_
    unit = BENCHES[name].rig_units(rig)
    for seed, todo in lacking.items():
        if not todo:
            _forget(steps, seed)
            continue
        _, scans, subjects, others = collection(name, data, n_scans, seed=seed)
        points, people = [scan.points for scan in scans], dict(zip(subjects, (scan.template for scan in scans)))
        singles = report["rows"].setdefault(_ONE_BY_ONE, {})
        if todo[0] == _ONE_BY_ONE:
            todo = todo[1:]
            started = time.perf_counter()
            outcomes = _one_by_one(fitter, points, jobs, None if progress is None else partial(progress, _ONE_BY_ONE, seed))
            entry = {"seconds": time.perf_counter() - started, "jobs": jobs, "environment": environment()}
            fitted = {i: o.result for i, o in enumerate(outcomes) if o.result is not None}
            own = zip(templates_of(rig, fitted.values()), [scans[i].template for i in fitted], strict=True)
            entry |= _measured(rig, [o.result for o in outcomes], scans, own, unit)
            entry["failures"] = {str(i): o.error for i, o in enumerate(outcomes) if o.result is None}
            singles[str(seed)] = entry | unforeseen(entry["failures"]) | {"label_error": _wrong(first, others)}
            if on_row is not None:
                on_row(report, _ONE_BY_ONE, seed)
        # Where variants that learn from labels find each other's first fits.
        with _kept_until_done(steps, seed) as (kept, gone_on):
            for variant in todo:
                one = clone(fitter).set_params(variant=variant)
                share_pretraining(fitter, one)
                say = None if progress is None else partial(progress, variant, seed)
                wrong = []
                started = time.perf_counter()
                one.fit(points, subjects, checkpoint=kept, progress=say, on_round=partial(_note_wrong, wrong, others))
                seconds = None if gone_on else time.perf_counter() - started
                entry = {"seconds": seconds, "jobs": jobs, "environment": environment()}
                learned = learned_templates(one)
                entry |= _measured(rig, one.results_, scans, [(V, people[k]) for k, V in learned.items()], unit)
                entry["unlearned"] = len(people) - len(learned)
                entry["failures"] = {str(i): why for i, why in one.failures_.items()}
                entry |= unforeseen(entry["failures"])
                entry |= {"rounds": max(0, len(one.history_) - 1), "history": one.history_, "label_error_of_rounds": wrong}
                if one.segmenter_ is not None:
                    entry["label_error"] = _wrong(one.segmenter_, others)
                report["rows"].setdefault(variant, {})[str(seed)] = entry
                if on_row is not None:
                    on_row(report, variant, seed)
    ran = {s for row in report["rows"].values() for s in row}
    report["complete"] = all(set(row) == ran for row in report["rows"].values())
    return report


def _lacking(report, seed, variants):
    """The rows that a seed has yet to get, that without learning first."""
    return [row for row in (_ONE_BY_ONE, *variants) if not is_done(report["rows"].get(row, {}).get(str(seed)))]


def steps_of(steps, seed):
    """The folder for the steps of a seed."""
    return Path(steps) / str(seed)


@contextmanager
def _kept_until_done(steps, seed):
    """A folder for steps, and whether a run that was stopped has left some there; it goes once all is done."""
    if steps is None:
        with TemporaryDirectory() as made:
            yield made, False
        return
    folder = steps_of(steps, seed)
    yield folder, steps_in(folder) > 0
    _forget(steps, seed)


def _forget(steps, seed):
    """Remove what is kept of a seed, and the folder of all where nothing is left in it."""
    if steps is not None:
        remove_checkpoint(steps_of(steps, seed))
        with suppress(OSError):
            Path(steps).rmdir()


def _one_by_one(fitter, points, jobs, progress):
    """The outcomes of scans that are fitted by themselves."""
    from ..learning.batch import fit_scans

    done = count(1)
    tell = None if progress is None else lambda outcome: progress("fits", next(done) / len(points))
    return fit_scans(fitter, points, n_jobs=jobs, on_result=tell)


def _poses_digest(name, data):
    """Of the files in the data folder that the scans' poses are made of."""
    return files_digest(sorted((Path(data) / "hand_poses").glob("*.handpose")) if name == "hand" else [_motion(data)])


def _measured(rig, results, scans, templates, unit):
    """The measures of fits and of templates, pairs of (U^d, U^gt) in the scans' unit.

    Scans cannot show where a template stands: a shift of all its vertices and joints is a shift of each scan's translation.
    """
    fitted = [(r, s) for r, s in zip(results, scans, strict=True) if r is not None]
    joints = [joint_error(r.joints, s.joints, rig.moving) / unit for r, s in fitted]
    vertices = [vertex_error(r.vertices, s.vertices) / unit for r, s in fitted]
    found, true = zip(*templates) if (templates := list(templates)) else ((), ())
    gaps = template_gap(rig, found, true) if templates else {}
    return {
        "unfitted": len(scans) - len(fitted),
        "joint_error": float(np.mean(joints)) if fitted else np.nan,
        "joint_error_median": float(np.median(joints)) if fitted else np.nan,
        "vertex_error": float(np.mean(vertices)) if fitted else np.nan,
        "joints": joints,
        "vertices": vertices,
    } | {name: gaps[of] * rig.size / 2 / unit for name, of in _GAPS.items() if gaps}


def _note_wrong(errors, scans, k, segmenter):
    """Add the label errors after round k to the list; variants without labels have none."""
    if segmenter is not None:
        errors.append(_wrong(segmenter, scans))


def _wrong(segmenter, scans):
    """Share of the points with a wrong label."""
    return float(np.mean([1.0 - label_accuracy(segmenter.predict(scan.points), scan.labels) for scan in scans]))


def learn_table(report, *, markdown=False):
    """Means of a report of :func:`learn_bench`, one row a variant: over the seeds that all rows have, what is left out below.

    Where nothing could be fitted, a measure is missing; its seed is left out of that column in all rows.
    """
    from .table import layout, of_states

    rows = {row: report["rows"][row] for row in (_ONE_BY_ONE, *VARIANT_ROWS) if row in report["rows"]}
    every = list(dict.fromkeys(seed for seeds in rows.values() for seed in seeds))
    seeds = [seed for seed in every if all(seed in of for of in rows.values())]
    lines, columns, few = [("", *MEASURES.values())], [], {}
    lengths = ".2f" if report["unit"] == "cm" else ".4f"
    for measure, head in MEASURES.items():
        values = {row: {s: of[s][measure] for s in seeds if _is_known(of[s].get(measure))} for row, of in rows.items()}
        common = [s for s in seeds if all(s in known for known in values.values() if known)]
        style = {"seconds": ".0f", "label_error": ".4f"}.get(measure, lengths)
        means = {row: np.mean([known[s] for s in common]) for row, known in values.items() if known and common}
        columns.append([format(means[row], style) if row in means else "–" for row in rows])
        lost = [s for s in seeds if s not in common]
        if lost and any(values.values()):
            few.setdefault(f"without seed{'s' if len(lost) > 1 else ''} {', '.join(lost)}", []).append(head)
    lines += [(row, *cells) for row, *cells in zip(rows, *columns, strict=True)]
    n, people = (report["settings"][key] for key in ("n_scans", "subjects"))
    unit = "cm" if report["unit"] == "cm" else "half sizes of the rig"
    legend = (
        f"Mean over seeds ({len(seeds)}), {n} scans of {people} subjects each. Lengths in {unit}; label errors\n"
        f"of the segmenter alone on {n // 3} other scans of these subjects. For each seed, the seconds of the first fits are\n"
        "counted for the first variant with labels that a run fits; the others reuse these fits."
    )
    before = [of[s]["template_gap_before"] for of in list(rows.values())[:1] for s in seeds if "template_gap_before" in of[s]]
    if before:
        legend += f"\nTemplate gaps are up to a shift; that of the rig's own template is {np.mean(before):{lengths}}."
    for seed in every:
        lacking = [row for row, of in rows.items() if seed not in of]
        if lacking:
            legend += f"\nSeed {seed} is left out: it has no {', no '.join(lacking)}."
    for without, heads in few.items():
        legend += f"\n{', '.join(heads)}: {without}, for which a row has no value."
    for row, of in rows.items():
        if lost := sum(of[seed].get("unfitted", 0) for seed in seeds):
            legend += f"\n{row}: {lost} of {n * len(seeds)} scans could not be fitted, and count in no measure of fits."
        if lost := sum(of[seed].get("unlearned", 0) for seed in seeds):  # in earlier reports not told
            legend += f"\n{row}: of {lost} of {people * len(seeds)} subjects nothing was learned; these count in no template gap."
    legend += _of_rounds(rows, seeds)
    legend += of_states((f"{row} {seed}", entry) for row, of in rows.items() for seed, entry in of.items())
    return f"{layout(lines, markdown=markdown)}\n\n{legend}"


def _of_rounds(rows, seeds):
    """Label errors after as many rounds, and so as many training scans, for all; and which round each seed kept."""
    told = {row: [of[s].get("label_error_of_rounds") or [] for s in seeds] for row, of in rows.items()}
    told = {row: errors for row, errors in told.items() if errors and all(errors)}
    lines = []
    for k in range(min((len(e) for errors in told.values() for e in errors), default=0)):
        means = ", ".join(f"{row} {np.mean([e[k] for e in errors]):.4f}" for row, errors in told.items())
        lines.append(f"Label errors after round {k + 1} of all: {means}.")
    for row in told:
        kept = [entry["round"] for s in seeds for entry in rows[row][s].get("history", ()) if entry.get("kept")]
        lines += [f"Rounds kept by {row}: {', '.join(map(str, kept))}."] if kept else []
    return "".join(f"\n{line}" for line in lines)


def _is_known(value):
    """Whether there is a figure: NaN is written as null."""
    return value is not None and np.isfinite(value)
