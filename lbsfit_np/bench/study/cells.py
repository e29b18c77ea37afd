"""The report's cells: those of a row over the seeds, their measures, means and ranges."""

import numpy as np

__all__ = ["cells_of", "compared", "kept_round", "mean", "number", "over", "value", "with_measure"]


def cells_of(report, name, row):
    """The cells of a rig's row, of the seeds that have it."""
    return [rows[row] for rows in report["rigs"][name]["seeds"].values() if row in rows]


def compared(report, name, rows, key):
    """Row → its cells of the seeds in which all of these rows have a measure: only these can be compared.

    Rows that have it in no seed are left out first; empty where no seed is left.
    """
    rows = [row for row in rows if with_measure(cells_of(report, name, row), key)]
    found = [[with_measure([done.get(row, {})], key) for row in rows] for done in report["rigs"][name]["seeds"].values()]
    seeds = [cells for cells in found if all(cells)]
    return {row: [cells[k][0] for cells in seeds] for k, row in enumerate(rows)} if seeds else {}


def value(cell, key):
    """A measure of a cell, None where it has none; of one with percentiles, its mean."""
    if key == "label errors":
        return None if cell.get("kept_accuracy") is None else 1.0 - cell["kept_accuracy"]
    if key == "recon above the truth":  # below it a fit only follows noise and missing areas
        return max(cell["recon"] / cell["recon_truth"], 1.0) if "recon" in cell else None
    if key == "corre median":
        return (cell.get("corre") or {}).get("p50")
    found = cell.get(key)
    return found["mean"] if isinstance(found, dict) else found


def with_measure(cells, key):
    """Those that have it: nothing fitted has none, a single fit no correspondences."""
    return [c for c in cells if value(c, key) is not None]


def mean(cells, key):
    """Over the seeds."""
    return np.mean([value(c, key) for c in with_measure(cells, key)])


def over(cells, *keys, style=".4f"):
    """Mean and range of what the keys lead to, in words."""
    return number([found for cell in cells if (found := _at(cell, keys)) is not None], style)


def _at(cell, keys):
    for key in keys:
        cell = None if cell is None else cell.get(key)
    return cell


def number(values, style):
    """Mean, and the range where there are several."""
    if not values:
        return "–"
    text = format(np.mean(values), style)
    return text if len(values) == 1 else f"{text} ({format(min(values), style)}–{format(max(values), style)})"


def kept_round(cell):
    """The round whose segmenter was kept."""
    return next(entry["round"] for entry in cell["history"] if entry["kept"])
