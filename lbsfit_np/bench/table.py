"""A benchmark's report as a table, plain or in Markdown."""

from .environment import commits, libraries, several
from .resume import in_order
from .run import ROWS, with_segmenter

__all__ = ["layout", "of_states", "table"]

# Heading, measure, average, and format of each column.
_COLUMNS = (
    ("joints", "joint_error", "mean", "length"),
    ("(median)", "joint_error", "median", "length"),
    ("vertices", "vertex_error", "mean", "length"),
    ("segmenter", "segmenter_labels", "mean", ".3f"),
    ("labels", "labels", "mean", ".3f"),
    ("recon", "recon", "mean", "length"),
    ("at truth", "recon_truth", "mean", "length"),
    ("s a scan", "seconds", "mean", ".2f"),
    ("evaluations", "evaluations", "mean", ".0f"),
    ("failed", "failed", None, "d"),
)


def table(report, *, markdown=False):
    """The figures of a report in rows: each way of fitting by seed, and over the seeds.

    Parameters
    ----------
    report : dict
        Of :func:`lbsfit_np.bench.run.run_bench`, complete or not.
    markdown : bool, default False

    Returns
    -------
    str
    """
    rows = [("fit", "seed", *(heading for heading, *_ in _COLUMNS))]
    for row, content in _in_order(report):
        for seed, entry in in_order(content["seeds"]).items():
            rows.append((ROWS[row], seed, *_cells(entry, report["unit"])))
        if len(content["seeds"]) > 1:
            rows.append((ROWS[row], "all", *_cells(content["over_seeds"], report["unit"])))
    return f"{layout(rows, markdown=markdown)}\n\n{_legend(report)}"


def layout(rows, *, markdown=False):
    """Rows of texts, the first a heading, as a table; the first column to the left, the others to the right."""
    return _markdown(rows) if markdown else _plain(rows)


def _in_order(report):
    return [(row, report["rows"][row]) for row in ROWS if row in report["rows"]]


def of_states(made):
    """The states of the code, by commit, where rows are of several: they are not to be compared as if they were of one.

    Parameters
    ----------
    made : iterable of (str, dict)
        What each row is called, and its entry of a report; those of earlier versions have the commit without the environment.

    Returns
    -------
    str
        A line that follows others, or nothing.
    """
    states = commits((called, entry.get("environment", entry)) for called, entry in made)
    return f"\n{several(states)}" if len(states) > 1 else ""


def _cells(entry, unit):
    for _, measure, average, style in _COLUMNS:
        value = entry[measure] if average is None else entry[average].get(measure)
        if style == "length":
            style = ".2f" if unit == "cm" else ".4f"
        yield "–" if value is None else format(value, style)


def _legend(report):
    unit = "cm" if report["unit"] == "cm" else "half sizes of the rig ([−1, 1]³)"
    entries = [(f"{row} {seed}", e) for row, content in _in_order(report) for seed, e in in_order(content["seeds"]).items()]
    made = "; and ".join(dict.fromkeys(_made_on(entry) for _, entry in entries))
    of_seeds = "; all: the median over the seeds" if len(report["seeds"]) > 1 else ""
    aims = {name: f"{'≥' if name == 'labels' else '≤'} {aim:g}" for name, aim in report["aims"].items()}
    trained = f"Segmenter trained on {report['settings']['fitter']['training_scans']} synthetic scans; "
    return "\n".join(
        (
            f"{report['scans_a_seed']} scans a seed, means over them{of_seeds}. Lengths in {unit}.",
            f"Aims with the own segmenter: {', '.join(f'{name} {aim}' for name, aim in aims.items())}.",
            f"{trained if with_segmenter(report['rows']) else ''}{made}.{of_states(entries)}",
        )
    )


def _made_on(entry):
    """Versions, machine and processes of a row."""
    env = entry["environment"]
    return f"lbsfit_np {env['lbsfit_np']}, {libraries(env)}, Python {env['python']}, {env['cpus']} CPUs, jobs {entry['jobs']}"


def _plain(rows):
    widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:]))]
        lines.append("  ".join(cells))
    return "\n".join(lines)


def _markdown(rows):
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(rows[0]) - 1))
    return "\n".join(lines)
