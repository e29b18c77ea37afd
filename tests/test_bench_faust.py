"""The benchmark of MPI-FAUST on folders of its layout, made with the bundled body: what is read, measured, written, left out."""

import json
import os
import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from cli_runs import one_line
from learning_runs import learning_is_hurried
from registered_sets import fits_are_given, learning_is_given, what_fits_are_told

import lbsfit_np as lbs
from lbsfit_np.bench.faust import PAPER, faust_table, read_faust
from lbsfit_np.bench.pairs import KINDS, choose_pairs, measure_pairs
from lbsfit_np.correspondence import at_places, surface_places
from lbsfit_np.errors import FileError
from lbsfit_np.io.write import write_mesh_ply, write_points_ply
from lbsfit_np.neighbors import PointIndex
from lbsfit_np.synthesis import sample_surface

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]

TRAINING, TEST = (0, 1, 2, 10, 11), (0, 1, 19, 20)
UNRELIABLE = 7


@pytest.fixture(scope="module")
def body():
    return lbs.load_rig("body-coarse")


def _truth_of(rig, names, **options):
    """Scan name → vertices, all turned about up."""
    rng, found = np.random.default_rng(0), {}
    poses = lbs.synthesize(rig, len(names), random_state=3, n_points=50, **options)
    for name, pose, angle in zip(names, poses, rng.uniform(-3, 3, len(names)), strict=True):
        c, s = np.cos(angle), np.sin(angle)
        found[name] = pose.vertices @ [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    return found


def _written(folder, truth, faces, intra, inter):
    """MPI-FAUST in a folder, with these pairs."""
    root = folder / "MPI-FAUST"
    for name in ("training/scans", "training/registrations", "training/ground_truth_vertices", "test/scans"):
        (root / name).mkdir(parents=True)
    (root / "test" / "challenge_pairs").mkdir()
    for k, (name, vertices) in enumerate(truth.items()):
        points = sample_surface(vertices, faces, 900, np.random.default_rng(k))[0]
        number = name[-3:]
        if name.startswith("test"):
            write_points_ply(root / "test" / "scans" / f"{name}.ply", points)
            continue
        points[:UNRELIABLE] += 0.01  # off the registration: no truth there
        write_points_ply(root / "training" / "scans" / f"{name}.ply", points)
        write_mesh_ply(root / "training" / "registrations" / f"tr_reg_{number}.ply", vertices, faces)
        flags = ["0"] * UNRELIABLE + ["1"] * (900 - UNRELIABLE)
        (root / "training" / "ground_truth_vertices" / f"tr_gt_{number}.txt").write_text("\n".join(flags) + "\n")
    (root / "test" / "challenge_pairs" / "intra_challenge.txt").write_text(intra)
    (root / "test" / "challenge_pairs" / "inter_challenge.txt").write_text(inter)
    return folder


@pytest.fixture(scope="module")
def truth(body):
    names = [f"tr_scan_{i:03d}" for i in TRAINING] + [f"test_scan_{i:03d}" for i in TEST]
    return _truth_of(body, names, poses="natural")


@pytest.fixture(scope="module")
def made(body, truth, tmp_path_factory):
    """DIR with MPI-FAUST in it."""
    return _written(tmp_path_factory.mktemp("faust"), truth, body.faces, "000_001\n019_000\n", "000_020\n")


@pytest.fixture
def own(made, tmp_path):
    """A copy that a test may take pieces from."""
    shutil.copytree(made, tmp_path / "data")
    return tmp_path / "data" / "MPI-FAUST"


def _points(made, name):
    return lbs.load_scan(made / "MPI-FAUST" / "test" / "scans" / f"{name}.ply").points


# ---- the layout ----


def test_the_folder_or_its_parent(made):
    for folder in (made, made / "MPI-FAUST"):
        found = read_faust(folder)
        assert [s.name for s in found.training] == [f"tr_scan_{i:03d}" for i in TRAINING]
        assert [s.subject for s in found.training] == ["0", "0", "0", "1", "1"]
        assert [(s.name[-3:], s.subject) for s in found.test] == [("000", "0"), ("001", "0"), ("019", "0"), ("020", "1")]
        assert found.challenges == {"intra": [(0, 1), (2, 0)], "inter": [(0, 3)]} and all(found.complete.values())
        assert found.notes == [] and found.truth.reliable[0].sum() == 900 - UNRELIABLE


def test_the_first_scans_of_each_subject(made):
    found = read_faust(made, most=2)
    assert [s.name[-3:] for s in found.training] == ["000", "001", "010", "011"]
    assert found.challenges == {"intra": [(0, 1)], "inter": [(0, 2)]} and found.complete == {"intra": False, "inter": True}
    assert ["1 of 2 intra-subject pairs" in n for n in found.notes] == [True]


@pytest.mark.parametrize(
    "gone, note",
    [
        ("training/registrations", "training/registrations: no such folder; errors cannot be measured"),
        ("training/registrations/tr_reg_001.ply", "registrations: no registrations of tr_scan_001, whose errors are not"),
        ("training/ground_truth_vertices", "ground_truth_vertices: no such folder; all vertices of the scans count"),
        ("training/ground_truth_vertices/tr_gt_001.txt", "no file for tr_scan_001; all vertices count there"),
        ("test/scans", "test/scans: no such folder; no files for the challenge"),
        ("test/scans/test_scan_020.ply", "1 of 1 inter-subject pairs"),
        ("test/scans/test_scan_020.ply", "test/scans: no file for test_scan_020"),
        ("test/challenge_pairs", "test/challenge_pairs: no such folder"),
        ("test/challenge_pairs/intra_challenge.txt", "no intra_challenge.txt"),
        ("test", "test/challenge_pairs: no such folder"),
    ],
)
def test_what_is_missing_is_left_out_and_named(own, gone, note):
    shutil.rmtree(own / gone) if (own / gone).is_dir() else (own / gone).unlink()
    found = read_faust(own)
    assert any(note in n for n in found.notes), found.notes
    assert (found.truth is None) == (gone == "training/registrations")
    if gone in ("test", "test/scans"):
        assert found.test == []
    elif gone != "test/scans/test_scan_020.ply":  # those that no list asks for, too
        assert [s.name[-3:] for s in found.test] == ["000", "001", "019", "020"]
    if gone.startswith("test/challenge_pairs"):
        assert len(found.challenges) == (gone != "test/challenge_pairs")


@pytest.mark.parametrize("also", ["training/registrations/tr_reg_010.ply", "training/ground_truth_vertices/tr_gt_010.txt", None])
@pytest.mark.parametrize("most", [None, 1])
def test_training_scans_that_are_not_there_are_named(also, most, own):
    """Their registrations or flags tell of them; those that are not asked for are not missing."""
    for gone in ("training/scans/tr_scan_010.ply", *([also] if also else [])):
        (own / gone).unlink()
    found = read_faust(own, most=most)
    assert [n for n in found.notes if "challenge" not in n] == [f"{own / 'training' / 'scans'}: no file for tr_scan_010"]
    assert [s.name[-3:] for s in found.training] == (["000", "011"] if most else ["000", "001", "002", "011"])


def test_without_training_scans_nothing_is_learned(own):
    shutil.rmtree(own / "training" / "scans")
    with pytest.raises(FileError, match="training/scans: got no such folder; .*--no-learn"):
        read_faust(own)
    found = read_faust(own, learn=False)
    assert found.training == [] and found.truth is None and len(found.test) == 4 and "only the challenge's" in found.notes[0]


def test_a_registration_alone_is_no_truth(own):
    for path in (own / "training" / "registrations").glob("*.ply"):
        if path.stem != "tr_reg_000":
            path.unlink()
    found = read_faust(own)
    assert found.truth is None and "a registration of one scan alone; errors are of pairs" in found.notes[0] and found.challenges


def test_a_list_without_pairs_is_no_challenge(own):
    """Its archive would be empty, and complete."""
    (own / "test" / "challenge_pairs" / "intra_challenge.txt").write_text("\n")
    with pytest.raises(FileError, match="intra_challenge.txt: got no pairs; expected pairs of scan numbers.* Remove the file"):
        read_faust(own)


def test_a_folder_without_lists_hides_no_other(own):
    (own / "test" / "challenge_pairs").rename(own / "challenge_pairs")
    (own / "test" / "challenge_pairs").mkdir()
    assert set(read_faust(own).challenges) == {"intra", "inter"}


def test_the_lists_may_stand_beside_training_and_test(own):
    (own / "test" / "challenge_pairs").rename(own / "challenge_pairs")
    (own / "challenge_pairs" / "intra_challenge.txt").rename(own / "challenge_pairs" / "FAUST_challenge_intra.txt")
    assert read_faust(own).challenges == {"intra": [(0, 1), (2, 0)], "inter": [(0, 3)]}


def test_what_is_broken_is_named(own, tmp_path, body):
    with pytest.raises(FileError, match="no such folder; expected the folder MPI-FAUST"):
        read_faust(tmp_path / "none")
    with pytest.raises(FileError, match="with neither training nor test"):
        read_faust(own / "training")
    lists = own / "test" / "challenge_pairs" / "inter_challenge.txt"
    lists.write_bytes(b"\xef\xbb\xbf000_020\n019_001\n000_020\n020_000\n")  # one that stands there twice has one file
    assert read_faust(own).challenges["inter"] == [(0, 3), (2, 1), (3, 0)]
    for line, words in (("1-2", "'1-2'"), (f"000_{'1' * 5000}", "'000_111.*…")):
        lists.write_text(f"000_020\n\n{line}\n")
        with pytest.raises(FileError, match=f"inter_challenge.txt: got {words} in line 3; expected pairs of scan numbers"):
            read_faust(own)
    lists.write_text("000_020\n")
    (own / "training" / "ground_truth_vertices" / "tr_gt_000.txt").write_text("1\n2\n")
    with pytest.raises(FileError, match="tr_gt_000.txt: got 2 words"):
        read_faust(own)
    (own / "training" / "ground_truth_vertices" / "tr_gt_000.txt").unlink()
    assert read_faust(own).truth.reliable[0] is None
    write_mesh_ply(own / "training" / "registrations" / "tr_reg_010.ply", body.vertices, body.faces[:-3])
    with pytest.raises(FileError, match="tr_reg_010.ply: .* registrations of FAUST of one mesh"):
        read_faust(own)
    shutil.rmtree(own / "training" / "registrations")
    for kind in KINDS:  # pairs of scans that are not used are none
        (own / "test" / "challenge_pairs" / f"{kind}_challenge.txt").write_text("000_001\n")
    with pytest.raises(FileError, match="nor pairs of test scans among the first of each subject; .* Leave out --scans"):
        read_faust(own, most=1)
    assert read_faust(own).challenges["intra"] == [(0, 1)]
    shutil.rmtree(own / "test")
    with pytest.raises(FileError, match="neither registrations of training scans nor pairs of test scans"):
        read_faust(own)


# ---- the command ----


def _command(folder, out, *more):
    return ("bench", "faust", folder, "-o", out, "--rig", "body-coarse", "--samples", 300, "--pictures", 1, *more)


def test_exact_fits_have_no_error_and_write_what_the_challenge_asks_for(made, truth, tmp_path, run, monkeypatch):
    fits_are_given(monkeypatch, truth)
    code, out, err = run(*_command(made, tmp_path, "--no-learn"))
    assert (code, err) == (0, "") and "5 training scans of 2 subjects, 4 test scans" in out
    report = json.loads((tmp_path / "results.json").read_text())
    assert report["benchmark"] == "faust" and report["unit"] == "m" and len(report["scans"]) == 9
    for kind, pairs in (("intra", 8), ("inter", 12)):
        assert report["figures"][kind]["pairs"] == pairs and report["figures"][kind]["before"]["p95"] < 1e-9
    faces, scans = lbs.load_rig("body-coarse").faces, made / "MPI-FAUST" / "training" / "scans"
    points = {name: lbs.load_scan(scans / f"{name}.ply").points for name in truth if name.startswith("tr")}
    for e in report["pairs"]:  # those that are reliable, and lie where the other's are, too
        places = at_places(*surface_places(points[e["a"]][UNRELIABLE:], truth[e["a"]], faces), truth[e["b"]])
        reliable = PointIndex(points[e["b"]]).nearest(places) >= UNRELIABLE
        assert e["points"] == reliable.sum() and 870 < e["points"] <= 900 - UNRELIABLE
    for name, inter, intra in PAPER:
        row = next(line for line in out.splitlines() if line.startswith(name))
        assert f"{inter:g}" in row and f"{'–' if intra is None else intra}" in row
    theirs = next(line for line in out.splitlines() if line.startswith("LBS-AE (23K)"))
    assert theirs.split() == ["LBS-AE", "(23K)", "test", "4.08", "–", "–", "–", "2.161", "–", "–", "–"]
    assert out.index("inter ") < out.index("intra ") and "0.00" in out and "another set" in out
    assert "measuring errors: 20 pairs\n" in out and "writing the challenge files: 3 pairs\n" in out
    a, b = "test_scan_000", "test_scan_020"
    found = np.loadtxt(tmp_path / "challenge-inter" / "000_020.txt")
    faces = lbs.load_rig("body-coarse").faces
    expected = lbs.transfer(_points(made, a), truth[a], truth[b], faces, snap_to=_points(made, b))
    np.testing.assert_allclose(found, expected, atol=6e-7)
    assert sorted(p.name for p in (tmp_path / "challenge-intra").iterdir()) == ["000_001.txt", "019_000.txt"]
    with zipfile.ZipFile(tmp_path / "challenge-intra.zip") as archive:
        assert sorted(archive.namelist()) == ["000_001.txt", "019_000.txt"]
        first = archive.read("019_000.txt").decode().splitlines()
    assert len(first) == 900 and len(first[0].split()) == 3
    assert report["challenge"]["inter"] == {"written": 1, "missing": 0, "archive": "challenge-inter.zip"}


def test_a_shift_of_the_fits_is_the_error(made, truth, tmp_path, run, monkeypatch):
    """All onto one scan whose registration is off by 2 cm."""
    fits_are_given(monkeypatch, truth | {"tr_scan_001": truth["tr_scan_001"] + [0.0, 0.02, 0.0]})
    _, out, _ = run(*_command(made, tmp_path, "--no-learn"))
    report = json.loads((tmp_path / "results.json").read_text())
    row = next(line for line in out.splitlines() if line.startswith("lbsfit, before the snap")).split()
    figures = [report["figures"][kind]["before"][key] for kind in ("inter", "intra") for key in ("mean", "median", "p90", "p95")]
    assert row[-8:] == [f"{100 * value:.2f}" for value in figures]
    onto = [e["before"]["mean"] for e in report["pairs"] if e["b"] == "tr_scan_001"]
    assert onto == pytest.approx([0.02] * 4)


def test_a_scan_without_a_fit_is_missing_everywhere(made, truth, tmp_path, run, monkeypatch):
    fits_are_given(monkeypatch, truth | {name: ValueError("bad") for name in ("tr_scan_001", "test_scan_019")})
    code, out, _ = run(*_command(made, tmp_path, "--no-learn", "--markdown"))
    assert code == 1 and "failed: tr_scan_001: ValueError: bad" in out and "failed: test_scan_019" in out
    assert "1 file in challenge-intra, 1 pair missing" in out and "| method | scans |" in out
    report = json.loads((tmp_path / "results.json").read_text())
    assert (report["figures"]["intra"]["pairs"], report["figures"]["intra"]["missing"]) == (4, 4)
    assert not (tmp_path / "challenge-intra.zip").exists() and (tmp_path / "challenge-inter.zip").exists()


@pytest.mark.slow
def test_a_challenge_of_which_scans_are_left_out_has_no_archive(made, truth, tmp_path, run, monkeypatch):
    fits_are_given(monkeypatch, truth)
    (tmp_path / "challenge-intra").mkdir()
    (tmp_path / "challenge-intra" / "mine.txt").write_text("keep")
    assert run(*_command(made, tmp_path, "--no-learn"))[0] == 0 and (tmp_path / "challenge-intra.zip").exists()
    code, out, _ = run(*_command(made, tmp_path, "--no-learn", "--scans", 2))
    assert code == 0 and "1 file in challenge-intra; no archive" in out and "to submit: challenge-inter.zip" in out
    assert "1 of 2 intra-subject pairs" in out
    assert sorted(p.name for p in (tmp_path / "challenge-intra").iterdir()) == ["000_001.txt", "mine.txt"]
    note = "challenge-intra.zip is of an earlier run, with 2 pairs, and is kept; --existing replace removes it"
    assert f"note: {note}\n" in out and note in json.loads((tmp_path / "results.json").read_text())["notes"]
    with zipfile.ZipFile(tmp_path / "challenge-intra.zip") as archive:
        assert sorted(archive.namelist()) == ["000_001.txt", "019_000.txt"]
    (tmp_path / "challenge-intra.zip").write_text("not one")  # has no pairs to lose
    assert run(*_command(made, tmp_path, "--no-learn", "--scans", 2))[0] == 0
    assert not (tmp_path / "challenge-intra.zip").exists()
    assert run(*_command(made, tmp_path, "--no-learn"))[0] == 0 and (tmp_path / "challenge-intra.zip").exists()
    assert "earlier run" not in run(*_command(made, tmp_path, "--no-learn", "--scans", 2, "--existing", "replace"))[1]
    assert not (tmp_path / "challenge-intra.zip").exists()


def test_earlier_files_for_the_challenge_stay_until_the_new_ones_are_there(made, truth, tmp_path, run, monkeypatch):
    fits_are_given(monkeypatch, truth)
    assert run(*_command(made, tmp_path, "--no-learn"))[0] == 0
    there = {path: path.read_bytes() for kind in KINDS for path in tmp_path.glob(f"challenge-{kind}*/*")}
    there |= {path: path.read_bytes() for path in tmp_path.glob("challenge-*.zip")}

    def stopped(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("lbsfit_np.bench.faust._write_points", stopped)
    assert run(*_command(made, tmp_path, "--no-learn"))[0] == 130
    assert len(there) == 5 and all(path.read_bytes() == content for path, content in there.items())


def test_without_registrations_the_challenge_is_written_all_the_same(own, truth, tmp_path, run, monkeypatch):
    shutil.rmtree(own / "training" / "registrations")
    fits_are_given(monkeypatch, truth)
    code, out, _ = run(*_command(own, tmp_path / "out", "--no-learn"))
    assert code == 0 and "note: " in out and "errors cannot be measured" in out and "lbsfit, before" not in out and "FMNet" in out
    assert (tmp_path / "out" / "challenge-intra.zip").exists()


@pytest.mark.slow
def test_only_training_scans_are_learned_from(made, truth, tmp_path, run, monkeypatch):
    """What learning leaves is fitted as its subject's; test scans have numbers of subjects, too, but are other people."""
    fits_are_given(monkeypatch, truth)
    told = what_fits_are_told(monkeypatch)
    learned = learning_is_given(monkeypatch, truth | {"tr_scan_001": None})
    code, out, err = run(*_command(made, tmp_path, "--scans", 2, "--pictures", 3))
    assert (code, err) == (0, "") and "learned together" in out
    assert learned == [[("tr_scan_000", "0"), ("tr_scan_001", "0"), ("tr_scan_010", "1"), ("tr_scan_011", "1")]]
    subjects = {name: subject for name, (subject, _) in told.items()}
    assert subjects == {"tr_scan_001": "0"} | dict.fromkeys(("test_scan_000", "test_scan_001", "test_scan_020"))
    assert list(json.loads((tmp_path / "fits.json").read_text())["learned_from"]) == [name for name, _ in learned[0]]
    assert set(lbs.LBSFitter.load(tmp_path / "model.npz").template_) == {"0", "1"}
    gallery = json.loads((tmp_path / "results.json").read_text())["gallery"]
    assert len(gallery) == 3 and f"gallery.png, from top to bottom: {', '.join(gallery)}" in out
    told.clear()
    assert run(*_command(made, tmp_path, "--scans", 2))[0] == 0 and len(learned) == 1 and told == {}


def test_the_options_reach_what_they_are_for(made, truth, body, tmp_path, run, monkeypatch):
    rng, out = np.random.default_rng(0), tmp_path / "out"
    given = {name: v + 0.01 * rng.standard_normal(v.shape) for name, v in truth.items()}
    asked = fits_are_given(monkeypatch, given)
    told = what_fits_are_told(monkeypatch)
    options = ("--no-learn", "--pictures", 0, "--pairs", 3, "--points", 7, "--seed", 4)
    assert run(*_command(made, out, *options))[0] == 0
    assert {f.random_state for _, f in told.values()} == {4}
    assert {len(lbs.FitResult.load(path).labels) for path in (out / "fits").iterdir()} == {300}
    report, found = json.loads((out / "results.json").read_text()), read_faust(made)
    pairs = choose_pairs(found.training, found.truth, 3, 4)
    of_training = {s.name: given[s.name] for s in found.training}
    measured = measure_pairs(found.training, found.truth, of_training, body.faces, pairs, points=7, seed=4)
    assert report["pairs"] == measured["pairs"] and len(report["pairs"]) == 6 and {e["points"] for e in report["pairs"]} == {7}
    code, _, err = run(*_command(made, out, *options, "--samples", 200))
    assert code == 2 and "fits made with samples 300; expected samples 200" in one_line(err)
    asked.clear()
    assert run(*_command(made, out, *options))[0] == 0 and asked == []
    assert run(*_command(made, out, *options, "--existing", "replace"))[0] == 0 and len(asked) == 9
    (out / "challenge-intra" / "mine.txt").write_text("of somebody else")
    assert (out / "challenge-intra.zip").exists() and len(list((out / "challenge-intra").iterdir())) > 1
    fits_are_given(monkeypatch, given | {found.training[1].name: KeyboardInterrupt()})
    assert run(*_command(made, out, *options, "--existing", "replace"))[0] == 130
    assert {path.name for path in out.iterdir()} == {"fits", "fits.json", "challenge-intra", "challenge-inter"}
    assert [path.name for kind in KINDS for path in (out / f"challenge-{kind}").iterdir()] == ["mine.txt"]


def test_files_for_the_challenge_that_cannot_be_written_lose_no_figure(made, truth, tmp_path, run, monkeypatch):
    def write(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lbsfit_np.bench.faust._write_points", write)
    fits_are_given(monkeypatch, truth)
    code, _, err = run(*_command(made, tmp_path, "--no-learn"))
    assert code == 2 and "No space left" in one_line(err)
    report = json.loads((tmp_path / "results.json").read_text())
    assert report["benchmark"] == "faust" and len(report["pairs"]) == 20 and report["challenge"] == {}


def test_bad_usage(made, tmp_path, run):
    code, _, err = run("bench", "faust", made)
    assert code == 2 and "-o/--output: got nothing" in one_line(err)
    code, _, err = run("bench", "faust", tmp_path, "-o", tmp_path / "out")
    assert code == 2 and "with neither training nor test" in one_line(err) and not (tmp_path / "out").exists()
    code, _, err = run("bench", "faust", made, "-o", tmp_path / "out", "--rig", "none.npz")
    assert code == 2 and "none.npz" in one_line(err) and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["results.json", "challenge-inter/000_020.txt"])
@pytest.mark.parametrize("source", ["test/challenge_pairs/inter_challenge.txt", "training/scans/tr_scan_001.ply"])
def test_an_input_is_never_overwritten(own, tmp_path, run, monkeypatch, name, source):
    """One file by two names."""
    fits_are_given(monkeypatch, {})
    before = (own / source).read_bytes()
    (tmp_path / "out" / name).parent.mkdir(parents=True)
    os.link(own / source, tmp_path / "out" / name)
    code, _, err = run(*_command(own, tmp_path / "out", "--no-learn"))
    assert code == 2 and "never overwritten" in one_line(err) and (own / source).read_bytes() == before


def test_the_table_without_pairs_of_a_kind():
    nothing = {"pairs": 0, "missing": 3, "before": dict.fromkeys(("mean", "median", "p90", "p95"))}
    nothing["after"] = nothing["before"]
    text = faust_table({"figures": {"intra": nothing, "inter": nothing}, "settings": {"learn": True}})
    assert "0 intra pairs (3 missing)" in text


@pytest.mark.slow
def test_all_of_it_with_fits_of_its_own(tube_rig, tmp_path, run, monkeypatch):
    """Learning, fits, errors and what the challenge asks for, of people as simple as can be, and in a hurry."""
    learning_is_hurried(monkeypatch)
    rig = replace(tube_rig.scaled(1.7 / np.ptp(tube_rig.vertices, axis=0).max()), metres_per_unit=1.0)
    rig.save(tmp_path / "tube.npz")
    names = [f"tr_scan_{i:03d}" for i in (0, 1, 10)] + [f"test_scan_{i:03d}" for i in (0, 1, 20)]
    folder = _written(tmp_path, _truth_of(rig, names), rig.faces, "000_001\n", "000_020\n")
    quick = ("--training-scans", 40, "--rounds", 1, "--max-points", 400, "--effort", "fast", "--points", 100)
    report = _done_twice_the_same(run, folder, tmp_path / "out", "--rig", tmp_path / "tube.npz", *quick)
    assert all(0 < report["figures"][kind]["before"]["mean"] < 1 for kind in KINDS)
    assert sorted(e["name"] for e in report["scans"]) == sorted(names) and not any("failed" in e for e in report["scans"])


@pytest.mark.study
def test_fits_of_its_own_are_near(own, tmp_path, run):
    """Nobody has said where anything is."""
    for gone in ("training/scans/tr_scan_002.ply", "training/scans/tr_scan_011.ply", "test/scans/test_scan_019.ply"):
        (own / gone).unlink()  # fits are slow, and two scans of a person are as many as pairs need
    (own / "test" / "challenge_pairs" / "intra_challenge.txt").write_text("000_001\n")
    quick = ("--training-scans", 240, "--rounds", 1, "--max-points", 1000, "--effort", "fast")
    report = _done_twice_the_same(run, own, tmp_path / "out", "--rig", "body-coarse", *quick)
    for kind in ("intra", "inter"):  # metres; the bodies are 1.7 high, and other people each
        assert 0.002 < report["figures"][kind]["before"]["mean"] < 0.05
        assert report["figures"][kind]["before"]["median"] < 0.03


def _done_twice_the_same(run, folder, out, *options):
    """The report of the command, whose results are written and kept."""
    command = ("bench", "faust", folder, "-o", out, "--pictures", 1, *options)
    code, said, err = run(*command)
    assert code == 0 and "error" not in err, said
    report = json.loads((out / "results.json").read_text())
    assert all(report["challenge"][kind]["missing"] == 0 for kind in KINDS)
    assert {path.name for path in (out / "fits").iterdir()} == {f"{scan['name']}.npz" for scan in report["scans"]}
    again, said, _ = run(*command)
    assert again == 0 and "kept existing fits of 6 scans" in said
    assert json.loads((out / "results.json").read_text())["pairs"] == report["pairs"]
    return report
