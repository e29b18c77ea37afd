"""The table of ``lbsfit bench pairs --truth``: its forms, what it takes for what, and what is wrong with it."""

from dataclasses import replace

import numpy as np
import pytest
from registered_sets import posed_meshes, write_meshes

from lbsfit_np.bench.truth import Landmarks, Registrations, VertexOrder
from lbsfit_np.bench.truth_file import read_truth
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.neighbors import PointIndex


@pytest.fixture(scope="module")
def meshes(tube_rig):
    return posed_meshes(tube_rig, 3)


@pytest.fixture
def folder(tube_rig, meshes, tmp_path):
    return write_meshes(tmp_path / "scans", tube_rig, meshes)


def _read(folder, text, **options):
    (folder.parent / "truth.csv").write_text(text, encoding="utf-8")
    return read_truth(folder.parent / "truth.csv", folder, **options)


def _asked(truth, i, points, most=10**6):
    return truth.asked(i, points, most, np.random.default_rng(0))


def test_scans_and_subjects_alone_mean_the_vertex_order(folder, meshes):
    scans, truth, notes = _read(folder, "scan,subject\ns0,ann\ns2.ply,bob\n")
    assert [(s.name, s.path, s.subject) for s in scans] == [("s0", folder / "s0.ply", "ann"), ("s2", folder / "s2.ply", "bob")]
    assert truth == VertexOrder(meshes.shape[1])
    assert notes == [f"1 of 3 scan files in {folder} are not in truth.csv and are left out"]
    asked = _asked(truth, 0, meshes[0], 20)
    rows, true = truth.true(asked, 1, PointIndex(meshes[2]))
    assert len(rows) == 20 == len(set(asked.keys.tolist()))
    np.testing.assert_array_equal(asked.points, meshes[0][asked.keys])
    np.testing.assert_array_equal(true, meshes[2][asked.keys])
    with pytest.raises(InputError, match="242 and 7 vertices"):
        truth.check(1, meshes[0][:7])


def test_places_by_vertices(folder, meshes):
    text = "Scan;Subject;Name;Vertex\ns0;ann;tip;5\ns0;ann;end;7\n\n# a comment\ns1;ann;end;9\ns1;ann;other;1\ns2;ann;none;0\n"
    _, truth, _ = _read(folder, text)
    assert isinstance(truth, Landmarks) and truth.places == ({"tip": 5, "end": 7}, {"end": 9, "other": 1}, {"none": 0})
    assert truth.linked(0, 1) and not truth.linked(0, 2)
    rows, true = truth.true(_asked(truth, 0, meshes[0]), 1, PointIndex(meshes[1]))
    np.testing.assert_array_equal(rows, [0])
    np.testing.assert_array_equal(true, meshes[1][[9]])
    np.testing.assert_array_equal(_asked(truth, 0, meshes[0]).points, meshes[0][[7]])  # no other scan has a tip
    shared = replace(truth, places=(truth.places[0], truth.places[1] | {"tip": 3}, {}))
    np.testing.assert_array_equal(_asked(shared, 0, meshes[0]).points, meshes[0][[5, 7]])
    assert len(_asked(shared, 0, meshes[0], 1).points) == 1
    truth.check(0, meshes[0])
    with pytest.raises(InputError, match="vertex 7 for 'end' in line 3; expected .* 0 to 5.*count from 0"):
        truth.check(0, meshes[0][:6])


def test_places_by_coordinates_and_another_column_of_subjects(folder, meshes):
    text = "scan,person,name,x,y,z,remark\ns0,ann,tip,1,2,3,good\ns1,bob,tip,4,5,6e-1,\n"
    scans, truth, _ = _read(folder, text, subject_column="Person")
    assert [s.subject for s in scans] == ["ann", "bob"]
    _, true = truth.true(_asked(truth, 0, meshes[0]), 1, PointIndex(meshes[1]))
    np.testing.assert_array_equal(true, [[4, 5, 0.6]])


def test_registrations(folder, tube_rig, meshes):
    """A place between vertices of one registration is the same place of the other."""
    write_meshes(folder.parent / "reg", tube_rig, meshes + 0.01, "r{}.ply")
    _, truth, _ = _read(folder, "scan,subject,registration\ns0,a,reg/r0.ply\ns1,a,reg/r1.ply\n")
    assert isinstance(truth, Registrations)
    middle = meshes[:2, tube_rig.faces[:6]].mean(axis=2) + 0.01
    _, true = truth.true(_asked(truth, 0, middle[0]), 1, PointIndex(meshes[1]))
    np.testing.assert_allclose(true, middle[1], atol=1e-9)


def test_what_the_table_uses_is_not_said_to_be_left_out(folder, tube_rig, meshes):
    """The table itself and registrations, where they lie among the scans; the scan that it does not name is."""
    write_meshes(folder, tube_rig, meshes[:2] + 0.01, "r{}.ply")
    (folder / "truth.csv").write_text("scan,subject,registration\ns0,a,r0.ply\ns1,a,r1.ply\n", encoding="utf-8")
    _, _, notes = read_truth(folder / "truth.csv", folder)
    assert notes == [f"1 of 3 scan files in {folder} are not in truth.csv and are left out"]


def test_only_reliable_points_are_asked_for(tube_rig, meshes):
    flags = np.zeros(242, dtype=bool)
    flags[[3, 9]] = True
    truth = Registrations((meshes[0], meshes[1], None), tube_rig.faces, (flags, flags, None))
    np.testing.assert_array_equal(_asked(truth, 0, meshes[0]).points, meshes[0][[3, 9]])
    assert truth.linked(0, 1) and not truth.linked(0, 2)
    on_b = np.ones(242, dtype=bool)
    on_b[9] = False
    one_way = Registrations(truth.vertices, tube_rig.faces, (flags, on_b, None))
    rows, true = one_way.true(_asked(one_way, 0, meshes[0]), 1, PointIndex(meshes[1]))
    np.testing.assert_array_equal(rows, [0])  # of 3 and 9: the other's registration is not to be relied on at 9
    np.testing.assert_allclose(true, meshes[1][[3]], atol=1e-12)
    with pytest.raises(InputError, match="242 flags"):
        truth.check(0, meshes[0][:7])
    with pytest.raises(InputError, match="no reliable point"):
        Registrations(truth.vertices, tube_rig.faces, (flags & False, None, None)).check(0, meshes[0])


def test_a_truth_that_lies_elsewhere(tube_rig, meshes):
    """In another unit, or with a slip of the pen; not where a scan shows a part alone, or a floor as well."""
    truth = Registrations(tuple(meshes), tube_rig.faces)
    truth.check(0, meshes[0][:20])
    truth.check(0, np.concatenate([meshes[0], meshes[0][:200] + [0, 0, 50 * tube_rig.size]]))
    for unit in (1e-3, 0.01, 100, 1e3):
        with pytest.raises(InputError, match="a registration from .* while the scan goes from .*in the scan's own"):
            truth.check(0, unit * meshes[0])
    places = {name: tuple(meshes[0][i]) for name, i in {"a": 0, "b": 100, "c": 241}.items()}
    lines = {"a": 2, "b": 3, "c": 4}
    Landmarks((places,), (lines,)).check(0, meshes[0][:20])
    for unit in (1e-3, 0.01, 100, 1e3):
        words = r"'[ab]' at \(.*\) in line [23], while the scan goes from .*expected places on the scan"
        with pytest.raises(InputError, match=words):
            Landmarks((places,), (lines,)).check(0, unit * meshes[0])
    with pytest.raises(InputError, match=r"'b' at \(500, 0, 0\) in line 3"):
        Landmarks((places | {"b": (500.0, 0.0, 0.0)},), (lines,)).check(0, meshes[0])


def test_places_near_each_other_are_right_where_they_lie_on_the_scan(tube_rig, meshes):
    """As in a face; also where a stray point makes the scan a hundred times as large. One or two places span nothing."""
    scan = meshes[0]
    near = np.linalg.norm(scan - scan[50], axis=1).argsort()[:3]
    small = scan[50] + 0.05 * (scan[near] - scan[50])
    stray = np.concatenate([scan, [scan[0] + [0, 0, 100 * np.linalg.norm(np.ptp(scan, axis=0))]]])
    for places, points in ((small, scan), (scan[[0, 100, 241]], stray), (small[:2] + 0.3, scan), (small[:1] + 0.3, scan)):
        given = {f"p{i}": tuple(place) for i, place in enumerate(places)}
        Landmarks((given,), ({},)).check(0, points)
    with pytest.raises(InputError, match="'p0' at .* in line 2"):
        Landmarks(({f"p{i}": tuple(place + 0.3) for i, place in enumerate(small)},), ({"p0": 2},)).check(0, scan)


def test_a_scan_without_a_registration_is_taken(tube_rig, meshes):
    Registrations((None, meshes[1]), tube_rig.faces).check(0, meshes[0])


def test_names_and_scans_that_are_in_no_pair_are_named(folder):
    """A name that is misspelt once would be measured nowhere, without a word."""
    rows = [("s0", "a", "nose", 1), ("s1", "a", "nose", 1), ("s0", "a", "chin", 2), ("s1", "a", "chim", 2), ("s2", "b", "toe", 3)]
    _, truth, notes = _read(folder, "\n".join(["scan,subject,name,vertex", *(",".join(map(str, row)) for row in rows)]))
    assert truth.alone() == {"chin": 0, "chim": 1, "toe": 2}
    assert notes == [
        "3 names are of one scan each, which no pair has: 'chin' (s0; did you mean 'chim'?), 'chim' (s1; did you mean 'chin'?), "
        "'toe' (s2)",
        "1 of 3 scans is in no pair: s2",
    ]


def test_files_in_subfolders_and_the_table_among_them(folder, meshes, tube_rig):
    write_meshes(folder / "more", tube_rig, meshes)
    (folder / "truth.csv").write_text("scan,subject\nmore/s0,a\ns0.ply,b\nmore/s1.ply,a\n")
    scans, _, notes = read_truth(folder / "truth.csv", folder)
    assert [s.name for s in scans] == ["more-s0", "s0", "more-s1"]
    assert "3 of 6 scan files" in notes[0]


def test_names_are_the_same_however_their_letters_are_put_together(folder, meshes, tube_rig):
    """As macOS and spreadsheets have them."""
    write_meshes(folder, tube_rig, meshes[:1], "zoe\u0301.ply")
    (folder / "truth.csv").write_text("scan,subject\nzo\u00e9,zo\u00e9\ns0.ply,zoe\u0301\n", encoding="utf-8")
    scans, _, _ = read_truth(folder / "truth.csv", folder)
    assert len(scans) == 2 and scans[0].subject == scans[1].subject == "zo\u00e9"


def test_without_subjects_all_are_one(folder):
    scans, _, notes = _read(folder, "scan\ns0\ns1\ns2\n")
    assert {s.subject for s in scans} == {"0"}
    assert notes == ["truth.csv has no column subject: all scans are assumed to be of one subject"]


@pytest.mark.parametrize(
    "text, words",
    [
        ("", ["0 lines", "heading"]),
        ("scan,subject\n", ["1 line;"]),
        ("scan,subject\ns0,a\n", ["1 scan", "two scans"]),
        ("scan,subject,vertx\ns0,a,5\n", ["scan, subject, vertx", "(name, vertex)"]),
        ("scan,subject,name\ns0,a,b\n", ["(name, vertex), (name, x, y, z)"]),
        ("scan,subject,name,vertex,x,y,z\ns0,a,t,1,1,1,1\n", ["scan, subject, name, vertex"]),
        ("file,subject\ns0,a\n", ["file, subject"]),
        ("scan,scan\ns0,a\n", ["scan, scan", "each column once"]),
        ("scan,subject\ns0,a\ns1\n", ["1 columns in line 3", "2, as in the heading"]),
        ("scan,subject\ns0,a\ns1,\n", ["no subject in line 3"]),
        ("scan,subject\ns0,a\ns0,a\n", ["'s0' again in line 3"]),
        ("scan,subject\ns0,a\nx1,a\n", ["'x1' in line 3", "not a scan file"]),
        ("scan,subject\ns0,a\ns1.pyl,a\n", ["'s1.pyl'", "Did you mean 's1.ply'?"]),
        ("scan,subject,name,vertex\ns0,a,t,1\ns0,b,u,2\n", ["'b' in line 3", "'a' above"]),
        ("scan,subject,name,vertex\ns0,a,t,1\ns0,a,t,2\ns1,a,t,1\n", ["'t' of s0.ply twice, in lines 2 and 3"]),
        ("scan,subject,name,vertex\ns0,a,t,-1\ns1,a,t,1\n", ["'-1' in line 2"]),
        pytest.param(f"scan,name,vertex\ns0,t,1\ns1,t,{'1' * 5000}\n", ["…", "in line 3", "whole number"], id="long"),
        ("scan,subject,name,vertex\ns0,a,,1\ns1,a,t,1\n", ["no name in line 2"]),
        ("scan,subject,name,x,y,z\ns0,a,t,1,2,nan\ns1,a,t,1,1,1\n", ["1, 2, nan in line 2", "finite"]),
        ("scan,subject,registration\ns0,a,\ns1,a,x.ply\n", ["no registration in line 2"]),
        ("scan,subject,registration\ns0,a,no.ply\ns1,a,x.ply\n", ["no.ply", "no such file"]),
        ('scan,subject\n"s0,a\ns1,a\n', ["line 2", "cannot be read"]),
    ],
)
def test_bad_tables_are_named(folder, text, words):
    with pytest.raises(FileError) as error:
        _read(folder, text)
    for word in words:
        assert word in str(error.value)


def test_other_things_that_are_wrong(folder, tube_rig, meshes, tmp_path):
    with pytest.raises(FileError, match="no such file"):
        read_truth(tmp_path / "none.csv", folder)
    (tmp_path / "bytes.csv").write_bytes(b"scan\n\xff\xfe")
    with pytest.raises(FileError, match="UTF-8"):
        read_truth(tmp_path / "bytes.csv", folder)
    with pytest.raises(FileError, match="no such folder"):
        read_truth(tmp_path / "bytes.csv", tmp_path / "none")
    with pytest.raises(FileError, match="a column 'person'"):
        _read(folder, "scan,subject\ns0,a\ns1,a\n", subject_column="person")
    write_meshes(tmp_path / "scans" / "b", tube_rig, meshes[:1], "t{}.ply")
    write_meshes(tmp_path / "scans" / "c", tube_rig, meshes[:1], "t{}.ply")
    with pytest.raises(FileError, match="'t0' in line 2, which matches b/t0.ply, c/t0.ply"):
        _read(folder, "scan,subject\nt0,a\ns1,a\n")
    np.savetxt(folder / "s0.xyz", meshes[0])
    with pytest.raises(FileError, match="the same name"):
        _read(folder, "scan,subject\ns0.ply,a\ns0.xyz,a\n")
    with pytest.raises(FileError, match="points without faces"):
        _read(folder, "scan,subject,registration\ns0.ply,a,scans/s0.xyz\ns1,a,scans/s1.ply\n")


def test_registrations_are_of_one_mesh(folder, tube_rig, meshes):
    from lbsfit_np.io.write import write_mesh_ply

    write_mesh_ply(folder / "s2.ply", meshes[2], tube_rig.faces[:-1])
    with pytest.raises(FileError, match="479 triangles that are not those of .*s0.ply|not those of"):
        _read(folder, "scan,subject,registration\ns0,a,scans/s0.ply\ns1,a,scans/s2.ply\n")
