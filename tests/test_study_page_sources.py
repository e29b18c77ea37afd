"""What the study's page says of where its figures and pictures come from."""

import re

from study_reports import report_of

from lbsfit_np.bench.environment import environment
from lbsfit_np.bench.study.page import page, rows_digest


def test_the_foot_names_machines_and_time():
    there = environment() | {"cpus": 2, "processor": "A Processor", "commit": "a" * 40}
    report = report_of(joint={"seconds": 90.0, "environment": there}, cd={"seconds": 30.0, "environment": there})
    text = page(report, {})
    assert f"Commit {'a' * 12}; lbsfit_np" in text
    assert ", 2 CPUs (A Processor); 2.0 min for all rows, with 2 processes. `results.json`" in text
    beside = {"seconds": 90.0, "jobs": 1, "at_once": 2, "environment": there | {"commit": f"{'a' * 40}+changes"}}
    text = page(report_of(joint=beside, cd=beside), {})
    assert f"Commit {'a' * 12}+changes; lbsfit_np" in text
    assert "; 3.0 min for all rows, added up, with 1 process each, 2 rows at once. `results.json`" in text
    text = page(report_of(joint=beside, cd=beside | {"jobs": 2, "at_once": 1}), {})
    assert "; 3.0 min for all rows, added up, with 1 process each, 2 rows at once or 2 processes. `results.json`" in text
    elsewhere = there | {"numpy": "1.0", "cpus": 8, "processor": None, "commit": "b" * 40}
    report = report_of(joint={"environment": there}, cd={"environment": elsewhere})
    text = page(report, {})
    of = f"Rows are of several states of the code, by commit: {'a' * 12}: hand 300 joint; {'b' * 12}: hand 300 cd. lbsfit_np"
    assert of in text
    assert re.search(r"2 CPUs \(A Processor\); and lbsfit_np \S+, Python \S+, numpy 1\.0, .*, 8 CPUs; 2\.6 min", text)


def test_rows_of_code_that_is_not_known_are_not_given_to_a_commit_that_is():
    known, unknown = (environment() | {"commit": commit} for commit in ("a" * 40, None))
    said = page(report_of(joint={"environment": known}, cd={"environment": unknown}), {})
    assert f"by commit: unknown: hand 300 cd; {'a' * 12}: hand 300 joint. lbsfit_np" in said
    assert "ommit" not in page(report_of(joint={"environment": unknown}), {}).split("---\n\n")[1]
    changed = environment() | {"commit": "a" * 40 + "+changes"}
    for there, called in ((changed, f"{'a' * 12}+changes"), (unknown, "unknown")):
        cells = {"joint": {"environment": there, "code": "1" * 64}, "cd": {"environment": there, "code": "2" * 64}}
        said = page(report_of(**cells), {})
        assert f"{called} (code 11111111): hand 300 joint; {called} (code 22222222): hand 300 cd." in said
    cells = {row: cell | {"environment": known} for row, cell in cells.items()}  # of one commit, with other libraries
    assert f"Commit {'a' * 12}; lbsfit_np" in page(report_of(**cells), {})


def test_what_trained_and_what_drew_is_said():
    report = report_of(joint={}) | {"training_seed": 7, "drawn_by": {"matplotlib": "3.9.1"}}
    text = page(report, {"a.png": "A picture."})
    assert "All training has one seed, 7, so ranges" in text and "Pictures by matplotlib 3.9.1. `results.json`" in text
    assert "matplotlib" not in page(report, {})


def test_pictures_of_earlier_rows_are_said_to_be():
    report, captions = report_of(joint={"arrays": "a"}), {"gallery-hand.png": "A picture."}
    report["drawn_by"] = {"matplotlib": "3.9.1", "of": {"hand": rows_digest(report["rigs"]["hand"]), "gone": ""}}
    assert "of earlier rows" not in page(report, captions)
    report["rigs"]["hand"]["seeds"]["300"]["joint"] |= {"arrays": "b"}
    assert "## Figures\n\nThese pictures are of earlier rows than those above: hand." in page(report, captions)
    assert "of earlier rows" not in page(report, {})
