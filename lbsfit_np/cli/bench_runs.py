"""What the commands of ``lbsfit bench`` run, and what they say while they do."""

import json
from contextlib import contextmanager
from pathlib import Path

from ..errors import FileError, InputError, in_words
from ..interrupts import held
from .earlier_results import drawn_by_others
from .outputs import check_outputs, out_folder
from .progress import LearningProgress, Progress, bar, say
from .scan_results import remove
from .stopping import say_steps, terminable

__all__ = [
    *("RESULTS", "checked_data", "failures_code", "made_results", "numbers", "read_results"),
    *("run_data", "run_learn", "run_roundtrip", "run_starts"),
]

RESULTS = "results.json"
_ROUNDS = 4  # LBSFitter's own, which the benchmark takes


def run_starts(rigs, values):
    """``lbsfit bench starts``: fits under many conditions; the exit code."""
    from ..bench.starts import RIGS, starts_bench, starts_table
    from ..io.write import write_json

    results = made_results(values)
    before, made, progress = _earlier(results, values), [], _BenchProgress()

    def on_row(report, name, row, fit):
        if results is not None:
            with held():
                write_json(results, report)
                made.append((name, row, fit))
        figures = report["rigs"][name]["rows"][row]["fits"][fit]
        progress.close()
        progress.line(f"{name}, {row}, {fit}: {100 * figures['success']:.1f} %, in {figures['wall_seconds']:.0f} s")

    def on_scan(name, row, fit, done, total):
        progress.one_fit(f"{name}, {row}, {fit}", values["seed"], done, total)

    with _stoppable(values, progress, lambda: made or before):
        report = starts_bench(
            rigs or RIGS,
            rows=values["rows"].split(","),
            fits=values["fits"].split(","),
            n_scans=values["scans"],
            seed=values["seed"],
            effort=values["effort"],
            training_scans=values["training_scans"],
            jobs=values["jobs"],
            before=before,
            progress=progress.training,
            on_scan=on_scan,
            on_row=on_row,
        )
    if results is not None:
        write_json(results, report)
    say("")
    say(starts_table(report, markdown=values["markdown"]))
    return failures_code(
        (f"{name}, {row}, {fit}, scan {scan['scan']}", scan["failed"])
        for name, entry in report["rigs"].items()
        for row, content in entry["rows"].items()
        for fit, figures in content["fits"].items()
        for scan in figures["scans"]
        if "failed" in scan
    )


def run_learn(name, values):
    """``lbsfit bench learn``: the loop and its ablations; the exit code."""
    from ..bench.learn import learn_bench, learn_table, steps_of
    from ..io.write import write_json
    from ..learning.checkpoint import checkpoint_of, remove_checkpoint, steps_in

    checked_data(name, values)
    results = made_results(values)
    before, made = _earlier(results, values), []
    progress, steps = _VariantsProgress(), checkpoint_of(results)
    for seed in numbers(values["seeds"]):
        if values["existing"] == "replace":
            remove_checkpoint(steps_of(steps, seed))
        say_steps(steps_of(steps, seed))

    def kept():
        return made or before or any(steps_in(steps_of(steps, seed)) for seed in numbers(values["seeds"]))

    def on_row(report, variant, seed):
        write_json(results, report)
        made.append((variant, seed))
        progress.close()
        entry = report["rows"][variant][str(seed)]
        error = f"joints {entry['joint_error']:.4f}, vertices {entry['vertex_error']:.4f} {report['unit']}"
        say(f"seed {seed}, {variant}: {error}" + ("" if entry["seconds"] is None else f", {entry['seconds']:.0f} s"))

    with _stoppable(values, progress, kept):
        report = learn_bench(
            name,
            values["data"],
            n_scans=values["scans"],
            seeds=numbers(values["seeds"]),
            variants=values["variants"].split(","),
            training_scans=values["training_scans"],
            jobs=values["jobs"],
            before=before,
            steps=steps,
            progress=progress,
            on_row=on_row,
        )
    write_json(results, report)
    say("")
    say(learn_table(report, markdown=values["markdown"]))
    return failures_code(
        (f"seed {seed}, {row}, scan {scan}", why)
        for row, of in report["rows"].items()
        for seed, entry in of.items()
        for scan, why in entry.get("failures", {}).items()
    )


def run_roundtrip(rigs, values):
    """``lbsfit bench roundtrip``: bundled rigs scanned and fitted again; the exit code."""
    from ..bench.roundtrip import RIGS, roundtrip, roundtrip_table
    from ..io.write import write_json

    results = made_results(values)
    before, made, progress = _earlier(results, values), [], _BenchProgress()

    def on_seed(report, name, seed):
        progress.close()
        if results is not None:
            with held():
                write_json(results, report)
                made.append((name, seed))

    with _stoppable(values, progress, lambda: made or before):
        report = roundtrip(
            rigs or RIGS,
            n_scans=values["scans"],
            seeds=numbers(values["seeds"]),
            training_scans=values["training_scans"],
            jobs=values["jobs"],
            before=before,
            progress=progress.training,
            on_scan=progress.one_fit,
            on_seed=on_seed,
        )
    if results is not None:
        write_json(results, report)
    say(roundtrip_table(report, markdown=values["markdown"]))
    return failures_code(
        (f"{name}, seed {seed}, scan {scan['scan']}", scan["failed"])
        for name, entry in report["rigs"].items()
        for seed, run in entry["seeds"].items()
        for scan in run["scans"]
        if "failed" in scan
    )


def run_data(name, values):
    """``lbsfit bench hand`` and ``body``: rigs of the data folder; the exit code."""
    from ..bench.run import run_bench
    from ..io.write import write_json

    bench = checked_data(name, values)
    seeds, out = numbers(values["seeds"]), Path(values["output"])
    pictures = {seed: out / f"seed-{seed}.png" for seed in seeds} if "own" in values["rows"].split(",") else {}
    results = made_results(values)
    before, made, progress = _earlier(results, values), [], _BenchProgress()
    if values["pictures"]:
        _check_pictures(pictures.values(), out, values["existing"], named=(before or {}).get("pictures", ()))

    def on_row(report, row, seed, fits):
        notes = []
        with held():  # as fits are not kept, a row that is has its picture, if one can be drawn
            write_json(results, report)
            made.append((row, seed))
            if row == "own":
                notes = _draw(report, pictures[seed], lambda: bench.load()[0](values["data"]), fits, values)
                write_json(results, report)
        progress.row(report, row, seed)
        for note in notes:
            progress.line(f"seed {seed}: {note}")

    with _stoppable(values, progress, lambda: made or before):
        report, _ = run_bench(
            bench,
            values["data"],
            seeds=seeds,
            n_scans=values["scans"],
            training_scans=values["training_scans"],
            jobs=values["jobs"],
            rows=values["rows"].split(","),
            before=before,
            training_progress=progress.training,
            on_scan=progress.one_scan,
            on_row=on_row,
        )
    write_json(results, report)
    _note_pictures(report, {seed: path for seed, path in pictures.items() if ("own", seed) not in made}, values["pictures"])
    return _farewell(report, values, out)


def _check_pictures(paths, out, existing, *, named):
    """Raise where pictures cannot be written, or would be drawn over those of others; ``named``: in the earlier report."""
    check_outputs(paths, out, inputs=[], existing="replace")
    if existing != "replace":  # pictures of a run that was replaced are drawn over as well
        others = [path for path in paths if path.name not in named and drawn_by_others(path)]
        check_outputs(others, out, inputs=[], existing="error")


def _draw(report, path, load_rig, fits, values):
    """Draw fits of a seed and say in the report which; notes, one where they cannot be drawn: no figure is lost for a picture."""
    from ..bench.pictures import picture, shown
    from ..report.render import write_png

    rows, notes = shown(fits, values["pictures"]), []
    if rows:
        try:
            write_png(path, picture(load_rig(), fits, rows))
            report.setdefault("pictures", {})[path.name] = rows
            return notes
        except Exception as error:  # noqa: BLE001 (whatever is wrong with a picture, the figures are right)
            notes.append(f"no picture: {in_words(error)}")
    if (values["pictures"] or values["existing"] == "replace") and not drawn_by_others(path):
        notes += remove([path])  # an earlier run's, which would then pass for this one's
    return notes


def _note_pictures(report, kept, k):
    """Say where pictures are not as asked for, of seeds whose fits an earlier run has made: seed → path."""
    from ..bench.pictures import shown

    missing, other = [], []
    for seed, path in kept.items():
        scans = report["rows"]["own"]["seeds"][str(seed)]["scans"]
        asked = shown([(None, None if "failed" in scan else scan, scan) for scan in scans], k)
        drawn = report.get("pictures", {}).get(path.name, []) if path.exists() else []
        if asked and not drawn:
            missing.append(str(seed))
        elif drawn != asked:
            other.append(f"{len(drawn)} of seed {seed}")
    again = "--existing replace makes them again"
    if missing:
        say(f"note: no picture of seed {', '.join(missing)}, whose fits an earlier run has made; {again}")
    if other:
        say(f"note: pictures show as many fits as an earlier run has drawn, not --pictures {k}: {', '.join(other)}; {again}")


def _farewell(report, values, out):
    from ..bench.table import table

    say("")
    say(table(report, markdown=values["markdown"]))
    say(f"\nresults in {out}")
    return failures_code(
        (f"{row}, seed {seed}, scan {scan['scan']}", scan["failed"])
        for row, content in report["rows"].items()
        for seed, entry in content["seeds"].items()
        for scan in entry["scans"]
        if "failed" in scan
    )


class _BenchProgress(Progress):
    """Training as in every command; then a bar a row on a terminal, and a line when it is done."""

    def __init__(self):
        super().__init__(0)

    def one_scan(self, row, seed, done, total):
        """``done`` of the ``total`` scans of a row are fitted."""
        from ..bench.run import ROWS

        self.one_fit(ROWS[row], seed, done, total)

    def one_fit(self, what, seed, done, total):
        """``done`` of the ``total`` scans of one thing and seed are fitted."""
        if not self.terminal:
            return
        if self._bar is None:
            self._bar = bar(total=total, desc=f"seed {seed}, {what}", unit="scan", leave=False)
        self._bar.update(done - self._bar.n)

    def row(self, report, row, seed):
        """A row of a seed is complete."""
        self.close()
        content = report["rows"][row]
        entry = content["seeds"][str(seed)]
        error = entry["mean"].get("joint_error")
        words = "all failed" if error is None else f"mean joint error {error:.4g} {report['unit']}"
        self.line(f"seed {seed}, {content['what']}: {len(entry['scans'])} scans in {entry['wall_seconds']:.0f} s, {words}")


class _VariantsProgress:
    """Learning as in ``lbsfit learn``, once for each variant and seed."""

    def __init__(self):
        self._what, self._shown = None, None

    def __call__(self, variant, seed, stage, share, figures=None):
        """What ``LBSFitter.fit`` says while it learns."""
        if self._what != (variant, seed):
            self.close()
            self._what, self._shown = (variant, seed), LearningProgress(_ROUNDS)
            if variant is not None:
                say(f"seed {seed}, {variant}:")
        self._shown(stage, share, figures)

    def close(self):
        """Leave the terminal in order."""
        if self._shown is not None:
            self._shown.close()


# ---- what runs share ----


def checked_data(name, values):
    """The benchmark of real rigs of that name, once its data and the folder for its results are known."""
    from ..bench.run import BENCHES

    for key, option, example in (("data", "--data", "--data DIR"), ("output", "-o/--output", "-o OUT")):
        if values[key] is None:
            raise InputError(option, "nothing", "a folder", f"Add {example}.")
    BENCHES[name].check_data(values["data"])
    return BENCHES[name]


def made_results(values):
    """Path of the results, in a folder that is there and may be written to; None where none are asked for."""
    if values["output"] is None:
        return None
    out = Path(values["output"])
    check_outputs([out / RESULTS], out, inputs=[], existing=values["existing"])
    out_folder(out)
    return out / RESULTS


def _earlier(results, values):
    """The report of an earlier run to go on with; None where there is none, or where it is to be replaced."""
    resumed = results is not None and values["existing"] == "resume" and results.exists()
    return read_results(results) if resumed else None


@contextmanager
def _stoppable(values, progress, kept):
    """Within it SIGTERM is as Ctrl-C; after either it is said how to go on, where ``kept`` () is true: something is kept."""
    try:
        with terminable():
            yield
    except KeyboardInterrupt:
        progress.close()
        if kept():
            again = "run the same command" + " without --existing replace" * (values["existing"] == "replace")
            say(f"stopped: finished work is kept in {values['output']}; {again} to continue")
        raise
    finally:
        progress.close()


def failures_code(failures):
    """Print what failed, pairs (where, why); the exit code."""
    code = 0
    for where, why in failures:
        say(f"failed: {where}: {why}")
        code = 1
    return code


def numbers(seeds):
    """The whole numbers of a text with commas between them."""
    return [int(s) for s in seeds.split(",")]


def read_results(path):
    """The report that an earlier run has written."""
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(report, dict):
            return report
    except (OSError, ValueError):
        pass
    raise FileError(str(path), "a file that cannot be read as results", "results of a benchmark", "Pass --existing replace.")
