"""Tables of the documents, which lie in the checkout, not in the wheel."""

import re
from pathlib import Path

import pytest

__all__ = ["ROOT", "codes", "document", "listed_keys", "needs_documents", "summary_keys", "table_rows"]

ROOT = Path(__file__).resolve().parents[1]
needs_documents = pytest.mark.skipif(not (ROOT / "README.md").is_file(), reason="the documents lie in the checkout")


def document(name):
    return (ROOT / name).read_text(encoding="utf-8")


def table_rows(text, marker):
    """Rows of the table below an HTML comment, as lists of cells."""
    after = text.split(f"<!-- {marker} -->\n", 1)[1].splitlines()
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in after[: next(k for k, line in enumerate(after) if line[:1] != "|")]]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def codes(cell):
    return re.findall(r"`([^`]*)`", cell)


def listed_keys(name, marker, wanted=lambda row: True):
    return {key for row in table_rows(document(name), marker) if wanted(row) for key in codes(row[0])}


def summary_keys(command):
    """Keys of ``summary.json`` as docs/fitting.md lists them of a command: of the whole, of a scan, of one without a fit.

    Without ``details``, which only errors have that nobody foresaw, and those that only some fits of earlier runs may have.
    """
    other = {"fit": "`lbsfit learn` alone", "learn": "`lbsfit fit` alone"}[command]
    name, of_scans = "docs/fitting.md", "summary keys of scans"
    whole = listed_keys(name, "summary keys", lambda row: other not in row[1])
    without = listed_keys(name, of_scans, lambda row: row[1] and other not in row[1])
    some = {"details", "earlier", "other_settings", "other_points"}
    return whole, listed_keys(name, of_scans) - some, without - some
