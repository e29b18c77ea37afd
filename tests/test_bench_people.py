"""``lbsfit bench people``: the scans, what is written of them, the command."""

import json

import numpy as np
import pytest
from cli_runs import one_line
from registered_sets import fits_are_given

import lbsfit_np as lbs
from lbsfit_np.bench.body import SHAPES, body_rig
from lbsfit_np.bench.hand import hand_rig
from lbsfit_np.bench.people import people_scans
from lbsfit_np.correspondence import at_places, surface_places

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


def test_points_lie_on_the_true_mesh_and_every_second_pose_is_bent_further(people, shared_rigs):
    scans, faces = people
    rig = body_rig(shared_rigs)
    turned = []
    for name, _, scan in scans:
        assert len(scan.points) == 12_000 and np.ptp(scan.vertices[:, 1]) > 0.9  # metres, y up
        places = at_places(*surface_places(scan.points[:50], scan.vertices, faces), scan.vertices)
        assert 0 < np.linalg.norm(scan.points[:50] - places, axis=1).max() < 0.006, name
        turned.append(np.linalg.norm(np.delete(scan.pose, rig.root, axis=0), axis=1).mean())
    assert np.mean(turned[1::2]) > 1.1 * np.mean(turned[::2])
    assert len({scan.pose.tobytes() for _, _, scan in scans}) == len(scans)


def test_hands_point_up_and_differ_from_person_to_person(shared_rigs):
    scans, faces = people_scans("hand", shared_rigs, n_people=3, n_scans=2, seed=3)
    rig = hand_rig(shared_rigs)
    assert np.array_equal(faces, rig.faces)
    np.testing.assert_array_equal(scans[0][2].template, rig.vertices)
    assert all(np.abs(scan.template - rig.vertices).max() > 0.002 for _, _, scan in scans[2:])
    tips = [j for j, name in enumerate(rig.joint_names) if name.endswith("middle-finger-phalanx-proximal")]
    for _, _, scan in scans:
        along = scan.joints[tips[0]] - scan.joints[rig.root]
        assert along[1] > 0.85 * np.linalg.norm(along) and len(scan.points) == 4_000


def test_a_scan_is_the_same_however_many_there_are(people, shared_rigs):
    fewer, _ = people_scans("body", shared_rigs, n_people=4, n_scans=1, seed=5)
    by_name = {name: scan for name, _, scan in people[0]}
    assert all(np.array_equal(scan.points, by_name[name].points) for name, _, scan in fewer)
    other, _ = people_scans("body", shared_rigs, n_people=4, n_scans=1, seed=4)
    assert not np.array_equal(other[0][2].points, fewer[0][2].points)


def test_the_command_measures_between_people(shared_rigs, tmp_path, run, monkeypatch):
    made, _ = people_scans("body", shared_rigs, n_people=2, n_scans=2, seed=7)
    rig = body_rig(shared_rigs)
    fits_are_given(monkeypatch, {name: scan.vertices for name, _, scan in made})
    rig.save(tmp_path / "same.npz")
    command = ("bench", "people", "body", "--data", shared_rigs, "--people", 2, "--scans", 2, "--scan-seed", 7, "--no-learn")
    command += ("--rig", tmp_path / "same.npz", "--points", 200, "--pictures", 1, "-o", tmp_path / "out")
    code, text, err = run(*command)
    assert code == 0, err
    assert "4 scans of 2 people" in text and "inter" in text and "gallery.png" in text
    report = json.loads((tmp_path / "out" / "results.json").read_text())
    assert report["benchmark"] == "people" and report["people"] == {"kind": "body", "people": 2, "scans": 2, "scan_seed": 7}
    assert report["unit"] == "m" and report["cm_per_unit"] == 100
    assert len(report["pairs"]) == 12 and report["figures"]["inter"]["before"]["mean"] < 0.01  # noise alone
    assert {path.stem for path in (tmp_path / "out" / "fits").iterdir()} == {name for name, _, _ in made}
    for name, _, scan in made:
        np.testing.assert_array_equal(lbs.load_scan(tmp_path / "out" / "scans" / f"{name}.ply").points, scan.points)
        mesh = lbs.load_scan(tmp_path / "out" / "registrations" / f"{name}.ply")
        np.testing.assert_array_equal(mesh.points, scan.vertices)
    code, text, _ = run(*command)
    assert code == 0 and "4 scans are fitted already and kept" in text
    # What it has written is a folder for bench pairs.
    pairs = ("bench", "pairs", tmp_path / "out" / "scans", "--truth", tmp_path / "out" / "truth.csv", "--no-learn")
    code, text, err = run(*pairs, "--rig", tmp_path / "same.npz", "--points", 200, "--pictures", 0, "-o", tmp_path / "again")
    assert code == 0, err
    again = json.loads((tmp_path / "again" / "results.json").read_text())
    assert again["figures"] == report["figures"]


def test_bad_usage_is_told_before_any_work(shared_rigs, tmp_path, run):
    command = ("bench", "people", "body", "-o", tmp_path / "out")
    code, _, err = run(*command)
    assert code == 2 and "--data" in one_line(err)
    code, _, err = run(*command, "--data", tmp_path)
    assert code == 2 and "mpfb2_body" in one_line(err)
    code, _, err = run(*command, "--data", shared_rigs, "--people", 1)
    assert code == 2 and "two people at least" in one_line(err)
    code, _, err = run("bench", "people", "feet", "--data", shared_rigs, "-o", tmp_path / "out")
    assert code == 2 and "'hand', 'body'" in one_line(err)
    (tmp_path / "out" / "scans").mkdir(parents=True)
    (tmp_path / "out" / "scans" / "person1-0.ply").write_bytes(b"of somebody else")
    code, _, err = run(*command, "--data", shared_rigs, "--people", 2, "--scans", 1)
    assert code == 2 and "person1-0.ply exists already" in one_line(err)
    assert [p.name for p in (tmp_path / "out").rglob("*.ply")] == ["person1-0.ply"]
