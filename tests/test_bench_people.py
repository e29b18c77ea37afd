"""``lbsfit bench people``: the scans, what is written of them, the command."""

import json
import os

import numpy as np
import pytest
from cli_runs import one_line
from registered_sets import fits_are_given
from scipy.spatial import cKDTree

import lbsfit_np as lbs
from lbsfit_np.bench.body import SHAPES, body_rig
from lbsfit_np.bench.hand import hand_rig, natural_poses
from lbsfit_np.bench.people import people_scans
from lbsfit_np.bench.retarget import bvh_thetas
from lbsfit_np.correspondence import at_places, surface_places
from lbsfit_np.io.bvh import read_bvh
from lbsfit_np.io.write import write_mesh_ply

pytestmark = [pytest.mark.usefixtures("own_cache"), pytest.mark.usefixtures("one_thread")]


@pytest.fixture(scope="module")
def people(shared_rigs):
    """Bodies."""
    return people_scans("body", shared_rigs, n_people=5, n_scans=2, seed=5)


def test_the_first_three_are_the_rigs_shapes_and_others_mixtures_of_them(people, shared_rigs):
    scans, faces = people
    shapes = [body_rig(shared_rigs), *(body_rig(shared_rigs, shape) for shape in SHAPES)]
    assert np.array_equal(faces, shapes[0].faces)
    templates = {subject: scan.template for _, subject, scan in scans}
    assert list(templates) == [f"person{k}" for k in range(5)]
    for shape, own in zip(shapes, templates.values()):
        np.testing.assert_allclose(own, shape.vertices, atol=1e-12)
    apart = np.array([(s.vertices - shapes[0].vertices).ravel() for s in shapes[1:]]).T
    for own in (templates["person3"], templates["person4"]):
        of = own.ravel() - shapes[0].vertices.ravel()
        weights, left, *_ = np.linalg.lstsq(apart, of)
        assert left[0] < 1e-16 and (np.array([1 - weights.sum(), *weights]) > -0.143).all()
    assert np.abs(templates["person3"] - templates["person4"]).max() > 0.005


def test_points_lie_near_the_true_mesh_with_noise_and_holes(people):
    (scans, faces), bare = people, []
    for name, _, scan in scans:
        assert len(scan.points) == 12_000 and np.ptp(scan.vertices[:, 1]) > 0.9  # metres, y up
        places = at_places(*surface_places(scan.points[:50], scan.vertices, faces), scan.vertices)
        assert 0.0005 < np.linalg.norm(scan.points[:50] - places, axis=1).mean() < 0.002, name
        assert np.linalg.norm(scan.points[:50] - places, axis=1).max() < 0.006, name
        bare.append(cKDTree(scan.points).query(scan.vertices[::10])[0].max())
    assert np.median(bare) > 0.04  # 12,000 points are 1 cm apart


def test_bodies_face_the_same_way_and_every_second_pose_is_turned_besides_within_limits(people, shared_rigs):
    rig = body_rig(shared_rigs)
    motion = read_bvh(shared_rigs / "motion" / "01_01.bvh")
    frames = bvh_thetas(rig, motion, list(range(1, len(motion.rotations))), face_forward=True)
    below = np.arange(len(rig.parents)) != rig.root
    for name, _, scan in people[0]:
        away = np.abs(frames - scan.pose)
        assert away[:, rig.root].max(axis=1).min() < 1e-9  # of some frame that faces forward, the calibration pose left out
        same = frames[away[:, rig.root].max(axis=1).argmin()]
        if name.endswith("0"):
            np.testing.assert_allclose(scan.pose, same, atol=1e-9)
            continue
        turned = np.abs(scan.pose - same)[below]
        assert turned.mean() > 0.02 and (turned <= 0.3 * np.maximum(-rig.lower, rig.upper)[below] + 1e-9).all()
        low, high = np.minimum(rig.lower, same), np.maximum(rig.upper, same)
        assert ((scan.pose >= low - 1e-9) & (scan.pose <= high + 1e-9))[below].all()
    assert len({scan.pose.tobytes() for _, _, scan in people[0]}) == len(people[0])


def test_hands_point_up_near_natural_poses_and_differ_from_person_to_person(shared_rigs):
    scans, faces = people_scans("hand", shared_rigs, n_people=3, n_scans=6, seed=5)
    rig = hand_rig(shared_rigs)
    natural, below = natural_poses(rig, shared_rigs), np.arange(len(rig.parents)) != rig.root
    least, most = natural.min(axis=0) - 0.1, natural.max(axis=0) + 0.1
    assert np.array_equal(faces, rig.faces)
    np.testing.assert_array_equal(scans[0][2].template, rig.vertices)
    assert all(np.abs(scan.template - rig.vertices).max() > 0.002 for _, _, scan in scans[6:])
    middle = rig.joint_names.index("middle-finger-phalanx-proximal")
    for name, _, scan in scans:
        along = scan.joints[middle] - scan.joints[rig.root]
        assert along[1] > 0.85 * np.linalg.norm(along) and len(scan.points) == 4_000
        places = at_places(*surface_places(scan.points[:50], scan.vertices, faces), scan.vertices)
        assert 0.0001 < np.linalg.norm(scan.points[:50] - places, axis=1).mean() < 0.001
        away = np.abs(natural - scan.pose)[:, below].max(axis=(1, 2)).min()
        assert (0.01 < away < 0.1 + 1e-9) == name.endswith(("0", "2", "4"))
        beyond = np.maximum(scan.pose - np.maximum(rig.upper, most), np.minimum(rig.lower, least) - scan.pose)
        assert beyond[below].max() < 1e-9  # natural poses are beyond limits in places, but nothing is turned further there


def test_a_scan_is_the_same_however_many_there_are(people, shared_rigs):
    fewer, _ = people_scans("body", shared_rigs, n_people=4, n_scans=1, seed=5)
    by_name = {name: scan for name, _, scan in people[0]}
    assert all(np.array_equal(scan.points, by_name[name].points) for name, _, scan in fewer)
    other, _ = people_scans("body", shared_rigs, n_people=4, n_scans=1, seed=4)
    assert not np.array_equal(other[0][2].points, fewer[0][2].points)


def _command(shared_rigs, out, *more, kind="hand"):
    return ("bench", "people", kind, "--data", shared_rigs, "-o", out, "--people", 2, "--scans", 2, "--no-learn", *more)


@pytest.fixture(scope="module")
def same_rig(shared_rigs, tmp_path_factory):
    """The rig that hands are of, as a file."""
    path = tmp_path_factory.mktemp("rig") / "same.npz"
    hand_rig(shared_rigs).save(path)
    return path


def _given(monkeypatch, shared_rigs, seed, n_people=2):
    """Fits that are exact, and the scans."""
    made, _ = people_scans("hand", shared_rigs, n_people=n_people, n_scans=2, seed=seed)
    return made, fits_are_given(monkeypatch, {name: scan.vertices for name, _, scan in made})


def test_the_command_measures_between_people(shared_rigs, same_rig, tmp_path, run, monkeypatch):
    made, asked = _given(monkeypatch, shared_rigs, 7)
    out = tmp_path / "out"
    command = _command(shared_rigs, out, "--scan-seed", 7, "--rig", same_rig, "--points", 200, "--pictures", 1)
    code, text, err = run(*command)
    assert code == 0, err
    assert text.count("scans of 2 hands, 2 each, --scan-seed 7") == 1 and "Scans of 2 hands" in text and "gallery.png" in text
    report = json.loads((out / "results.json").read_text())
    whose = {"kind": "hand", "people": 2, "scans": 2, "scan_seed": 7}
    assert report["benchmark"] == "people" and report["people"] == json.loads((out / "people.json").read_text()) == whose
    assert report["unit"] == "m" and report["cm_per_unit"] == 100
    assert len(report["pairs"]) == 12 and report["figures"]["inter"]["before"]["mean"] < 0.01  # noise alone
    assert {path.stem for path in (out / "fits").iterdir()} == {name for name, _, _ in made} == set(asked)
    for name, _, scan in made:
        np.testing.assert_array_equal(lbs.load_scan(out / "scans" / f"{name}.ply").points, scan.points)
        np.testing.assert_array_equal(lbs.load_scan(out / "registrations" / f"{name}.ply").points, scan.vertices)
    code, text, _ = run(*command)
    assert code == 0 and "kept existing fits of 4 scans" in text
    # What it has written is a folder for bench pairs.
    pairs = ("bench", "pairs", out / "scans", "--truth", out / "truth.csv", "--no-learn")
    code, text, err = run(*pairs, "--rig", same_rig, "--points", 200, "--pictures", 0, "-o", tmp_path / "again")
    assert code == 0, err
    assert json.loads((tmp_path / "again" / "results.json").read_text())["figures"] == report["figures"]


@pytest.mark.parametrize("kind, rig", [("hand", "hand-left"), ("body", "body")])
def test_a_bundled_rig_is_fitted_to_either(kind, rig, shared_rigs, tmp_path, run, monkeypatch):
    vertices = lbs.load_rig(rig).vertices
    fits_are_given(monkeypatch, {f"person{k}-{i}": (vertices, {"scale": 1000.0}) for k in range(2) for i in range(2)})
    code, text, err = run(*_command(shared_rigs, tmp_path / "out", "--points", 50, "--pictures", 0, kind=kind))
    assert code == 0, err
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert report["rig"]["name"] == rig and report["people"]["kind"] == kind and "--scan-seed 600" in text
    assert report["unit"] == "m"  # whatever the fits' scales say


def test_other_people_are_not_mixed_with_those_of_before(shared_rigs, same_rig, tmp_path, run, monkeypatch):
    out = tmp_path / "out"
    options = ("--rig", same_rig, "--points", 50, "--pictures", 0)
    _given(monkeypatch, shared_rigs, 5, n_people=3)
    assert run(*_command(shared_rigs, out, "--scan-seed", 5, *options, "--people", 3))[0] == 0
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    _given(monkeypatch, shared_rigs, 6)
    code, _, err = run(*_command(shared_rigs, out, "--scan-seed", 6, *options))
    assert code == 2 and "3 hands, 2 each, --scan-seed 5; expected scans of 2 hands, 2 each, --scan-seed 6" in one_line(err)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    code, text, err = run(*_command(shared_rigs, out, "--scan-seed", 6, *options, "--existing", "replace"))
    assert code == 0 and "left out" not in text, err
    names = {f"person{k}-{i}" for k in range(2) for i in range(2)}
    for folder in ("scans", "registrations", "fits"):
        assert {path.stem for path in (out / folder).iterdir()} == names
    assert json.loads((out / "people.json").read_text())["scan_seed"] == 6


def test_stopped_while_scans_are_written_the_same_command_goes_on(shared_rigs, same_rig, tmp_path, run, monkeypatch):
    made, asked = _given(monkeypatch, shared_rigs, 7)
    command = _command(shared_rigs, tmp_path / "out", "--scan-seed", 7, "--rig", same_rig, "--points", 50, "--pictures", 0)

    def stop(path, *rest, **more):
        if path.name == "person1-0.ply":
            raise KeyboardInterrupt
        return write_mesh_ply(path, *rest, **more)

    with monkeypatch.context() as patch:
        patch.setattr("lbsfit_np.bench.people.write_mesh_ply", stop)
        assert run(*command)[0] == 130
    assert not (tmp_path / "out" / "truth.csv").exists() and not asked
    assert run(*command)[0] == 0 and len(asked) == len(made)


def test_bad_usage_is_told_before_any_work(shared_rigs, tmp_path, run):
    command = ("bench", "people", "body", "-o", tmp_path / "out")
    code, _, err = run(*command)
    assert code == 2 and "--data" in one_line(err)
    (tmp_path / "mpfb2_body").mkdir()
    code, _, err = run(*command, "--data", tmp_path)
    assert code == 2 and "mpfb2_body" in one_line(err) and "motion" in one_line(err)
    code, _, err = run(*command, "--data", shared_rigs, "--people", 1)
    assert code == 2 and "at least two people" in one_line(err)
    code, _, err = run("bench", "people", "feet", "--data", shared_rigs, "-o", tmp_path / "out")
    assert code == 2 and "'hand', 'body'" in one_line(err)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", ["scans/person1-0.ply", "registrations/person0-1.ply", "truth.csv", "people.json"])
def test_files_of_others_are_replaced_where_people_say_so_alone(file, shared_rigs, same_rig, tmp_path, run, monkeypatch):
    _given(monkeypatch, shared_rigs, 7)
    path = tmp_path / "out" / file
    path.parent.mkdir(parents=True)
    path.write_bytes(b"of somebody else")
    (tmp_path / "out" / "fits.json").write_text("{}")  # as bench pairs may have left there
    command = _command(shared_rigs, tmp_path / "out", "--scan-seed", 7)
    code, _, err = run(*command)
    assert code == 2 and f"{file} exists already" in one_line(err)
    assert path.read_bytes() == b"of somebody else"
    assert {p.name for p in (tmp_path / "out").rglob("*") if p.is_file()} == {"fits.json", path.name}
    options = ("--rig", same_rig, "--points", 50, "--pictures", 0, "--existing", "replace")
    code, _, err = run(*command, *options)
    assert code == 0 and path.read_bytes() != b"of somebody else", err


@pytest.mark.parametrize(
    "record", ["[]", '{"kind": "feet", "people": 2, "scans": 2, "scan_seed": 7}', '{"kind": "body", "people": Infinity}']
)
def test_a_record_that_is_none_counts_as_a_file_of_others(record, shared_rigs, tmp_path, run):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "people.json").write_text(record)
    code, _, err = run(*_command(shared_rigs, tmp_path / "out"))
    assert code == 2 and "people.json exists already" in one_line(err)


@pytest.mark.parametrize("file", ["truth.csv", "scans/person0-0.ply"])
def test_an_input_is_never_overwritten(file, shared_rigs, same_rig, tmp_path, run):
    path = tmp_path / "out" / file
    path.parent.mkdir(parents=True)
    os.link(same_rig, path.parent / "same.npz")
    os.link(same_rig, path)
    command = _command(shared_rigs, tmp_path / "out", "--rig", path.parent / "same.npz", "--existing", "replace")
    code, _, err = run(*command)
    assert code == 2 and "never overwritten" in one_line(err) and path.read_bytes() == same_rig.read_bytes()
