"""``lbsfit fit``: the files and the summary that it writes, and scans read in other ways."""

import json
import re

import numpy as np
import pytest
import trimesh
from cli_runs import QUICK, one_line, program
from docs_tables import needs_documents, summary_keys

import lbsfit_np as lbs
from lbsfit_np.io.write import write_mesh_ply
from lbsfit_np.report.colors import label_colors

pytestmark = pytest.mark.usefixtures("own_cache", "hurried")

# Of a scan that could not be read, in the summary; details are for errors that nobody foresaw.
UNFITTED = {"name", "input", "status", "message", "seconds"}


def test_fit_writes_every_file(fitted, made, tube_rig):
    out, text = fitted
    assert sorted(p.name for p in out.iterdir()) == [
        "one.fit.npz", "one.labels.ply", "one.mesh.ply", "summary.json", "two.fit.npz", "two.labels.ply", "two.mesh.ply",
    ]  # fmt: skip
    result = lbs.FitResult.load(out / "one.fit.npz")
    scan = lbs.load_scan(made / "one.ply")
    assert result.rig_digest == tube_rig.digest and len(result.labels) == len(scan) == 400
    mesh = lbs.load_scan(out / "one.mesh.ply")
    np.testing.assert_array_equal(mesh.points, result.vertices)
    np.testing.assert_array_equal(mesh.labels, tube_rig.vertex_labels)
    labelled = lbs.load_scan(out / "one.labels.ply")
    np.testing.assert_array_equal(labelled.points, scan.points)
    np.testing.assert_array_equal(labelled.labels, result.labels)
    colors = label_colors(result.labels, result.confidence, 4)
    np.testing.assert_array_equal(trimesh.load(out / "one.labels.ply").colors[:, :3], colors)
    header = (out / "one.labels.ply").read_bytes().split(b"end_header")[0].decode()
    assert "float confidence" in header and "uchar red" in header and "part 2 long" in header
    assert text.index("fitting 2 scans\n") < text.index("[1/2] one: fitted")
    assert "[2/2] two: fitted" in text and "2 of 2 scans fitted" in text
    assert "\r" not in text  # no bar where there is no terminal


def test_the_summary_tells_all(fitted, made, tube_rig):
    out, _ = fitted
    summary = json.loads((out / "summary.json").read_text())
    assert summary["counts"] == {"ok": 2, "suspect": 0, "failed": 0, "unfitted": 0, "kept": 0} and summary["not_done"] == []
    assert summary["rig"]["digest"] == tube_rig.digest and summary["rig"]["parts"] == list(tube_rig.parts)
    assert summary["seed"] == 0 and summary["settings"]["training_scans"] == 40
    assert summary["versions"]["lbsfit_np"] == lbs.__version__ and summary["versions"]["numpy"] == np.__version__
    for name, scan in zip(("one", "two"), summary["scans"]):
        result = lbs.FitResult.load(out / scan["files"]["fit"])
        assert (scan["name"], scan["status"], scan["message"]) == (name, "ok", result.message)
        assert scan["terms"] == result.terms and scan["evaluations"] == result.evaluations
        assert set(scan["files"].values()) <= {p.name for p in out.iterdir()}
        assert scan["subject"] is None and result.subject == ""
    assert summary["scans"][0]["input"] == str(made / "one.ply")


@needs_documents
def test_the_keys_of_the_summary_are_those_that_the_documents_list(fitted):
    summary = json.loads((fitted[0] / "summary.json").read_text())
    assert (set(summary), set(summary["scans"][0]), UNFITTED) == summary_keys("fit")


def test_jobs_do_not_change_the_results_and_need_no_scikit_learn_for_what_is_trained(fitted, made, cli_cache, tmp_path):
    """Each process would take a second to import it."""
    none, out = tmp_path / "none", tmp_path / "out"
    none.mkdir()
    (none / "sklearn.py").write_text("raise ImportError('it is not needed')")
    given = made / "tube.npz", made / "one.ply", made / "two.xyz", "-o", out, "--jobs", 2, *QUICK
    done = program("fit", *given, cache=cli_cache, hurried=True, before=[none])
    assert (done.returncode, done.stderr) == (0, "")
    for name in ("one", "two"):
        ours, theirs = (lbs.FitResult.load(folder / f"{name}.fit.npz") for folder in (out, fitted[0]))
        for field in ("pose", "translation", "scale", "offsets", "vertices", "joints", "labels", "confidence", "terms"):
            np.testing.assert_equal(getattr(ours, field), getattr(theirs, field), err_msg=field)
        for kind in ("mesh", "labels"):
            assert (out / f"{name}.{kind}.ply").read_bytes() == (fitted[0] / f"{name}.{kind}.ply").read_bytes()


def test_failed_scans_are_named_and_the_others_written(made, tmp_path, run):
    (tmp_path / "empty.ply").write_bytes(b"")
    code, text, err = run("fit", made / "tube.npz", tmp_path / "empty.ply", made / "one.ply", "-o", tmp_path / "out", *QUICK)
    assert code == 1
    assert "empty: failed: " in err and "an empty file (0 bytes)" in err and "1 of 2 scans fitted, 1 could not be fitted;" in text
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "one.fit.npz",
        "one.labels.ply",
        "one.mesh.ply",
        "summary.json",
    ]
    scans = json.loads((tmp_path / "out" / "summary.json").read_text())["scans"]
    assert [s["status"] for s in scans] == ["failed", "ok"]
    assert "an empty file (0 bytes)" in scans[0]["message"]
    assert set(scans[0]) == UNFITTED


def test_drop_invalid_keeps_the_good_points(made, tmp_path, run):
    points = lbs.load_scan(made / "one.ply").points.copy()
    points[[3, 7]] = np.nan
    np.save(tmp_path / "holes.npy", points)
    code, _, _ = run("fit", made / "tube.npz", tmp_path / "holes.npy", "-o", tmp_path / "out", "--drop-invalid", *QUICK)
    assert code == 0 and len(lbs.FitResult.load(tmp_path / "out" / "holes.fit.npz").labels) == 398
    assert "2 of 400" in json.loads((tmp_path / "out" / "summary.json").read_text())["scans"][0]["notes"][0]


def test_row_numbers_taken_for_x_are_told_of_each_scan_and_why_its_fit_is_wrong(made, tmp_path, run):
    for name, scan, rows in (("filtered", "one.ply", np.arange(400) * 2), ("shuffled", "two.xyz", np.arange(400)[::-1])):
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([rows, lbs.load_scan(made / scan).points]), delimiter=",")
    scans, out = sorted(tmp_path.glob("*.csv")), tmp_path / "out"
    code, text, err = run("fit", made / "tube.npz", *scans, made / "one.ply", "-o", out, *QUICK)
    assert code == 1 and err.count(": failed: Columns 1 to 3 were read as x, y, z, but the first (") == 2
    entries = {e["name"]: e for e in json.loads((out / "summary.json").read_text())["scans"]}
    assert entries["one"]["status"] == "ok" and entries["one"]["message"] == lbs.FitResult.load(out / "one.fit.npz").message
    for name, rows in (("filtered", "0, 2, 4"), ("shuffled", "399, 398, 397")):
        note = f"Columns 1 to 3 were read as x, y, z, but the first ({rows}, …) looks like row numbers"
        why = f"{note}: leave it out, or name the columns in a header line (row x y z)"
        first, *others = entries[name]["message"].split("; ")
        assert text.count(f"note: {name}: {note}") == 1 and first == why and others
        row = re.search(rf"^{name} +failed +0\.\d\d +", text, flags=re.MULTILINE)
        reasons = ("\n" + " " * len(row[0])).join([why, *others])  # each has a line, one below the other
        assert text[row.end() :].startswith(f"{reasons}\n")
    kept = run("fit", made / "tube.npz", *scans, "-o", out, "--existing", "skip", *QUICK)[1]
    assert kept.count(" Columns 1 to 3 were read as x") == 2  # in the table: nothing is read again


def test_samples_of_a_mesh(made, tube_rig, tmp_path, run):
    write_mesh_ply(tmp_path / "mesh.ply", tube_rig.vertices, tube_rig.faces)
    code, _, _ = run("fit", made / "tube.npz", tmp_path / "mesh.ply", "-o", tmp_path / "out", "--samples", 300, *QUICK)
    assert code == 0 and len(lbs.FitResult.load(tmp_path / "out" / "mesh.fit.npz").labels) == 300


def test_a_saved_segmenter(fitted, made, tube_rig, tmp_path, run, monkeypatch):
    fitter = lbs.LBSFitter(tube_rig, training_scans=40, random_state=0).pretrain(cache=True)
    fitter.segmenter_.save(tmp_path / "s.npz")
    monkeypatch.setattr("lbsfit_np.learning.pretraining.train_segmenter", None)  # not needed any more
    arguments = ("fit", made / "tube.npz", made / "one.ply", "-o", tmp_path / "out", "--segmenter", tmp_path / "s.npz", *QUICK)
    monkeypatch.setenv("LBSFIT_CACHE", str(tmp_path / "empty"))
    monkeypatch.setattr("lbsfit_np.segmentation.cache._MEMORY", {})
    code, out, _ = run(*arguments)
    assert code == 0 and "training on synthetic scans" in out  # the library of starts
    assert (tmp_path / "out" / "one.mesh.ply").read_bytes() == (fitted[0] / "one.mesh.ply").read_bytes()
    code, _, err = run(*arguments[:4], tmp_path / "other", *arguments[5:], "--parts", "arm and fingers")
    assert code == 2 and "segmenter: got one that was trained on another rig" in one_line(err)
