"""NPZ files with points and a mesh: which of the two a scan is, and what its normals and labels belong to."""

import numpy as np
import pytest
from scan_files import FACES, LABELS, NORMALS, POINTS, on_tetrahedron

from lbsfit_np.errors import FileError
from lbsfit_np.io.scans import load_mesh, load_scan

CLOUD = np.random.default_rng(0).random((9, 3)) + 20


@pytest.mark.parametrize("vertices", ["vertices", "verts", "v", "Vertices"])
@pytest.mark.parametrize("points", ["points", "xyz"])
def test_faces_are_of_the_vertices_where_there_are_points_beside_them(tmp_path, points, vertices):
    path = tmp_path / "a.npz"
    np.savez(path, **{points: CLOUD, vertices: POINTS}, faces=FACES)
    scan = load_scan(path)
    np.testing.assert_array_equal(scan.points, CLOUD)
    assert scan.notes == (
        f"The faces are of {vertices!r}, the points {points!r}: n_samples (--samples) samples that mesh instead.",
    )
    sampled = load_scan(path, n_samples=50)
    assert len(sampled.points) == 50 and on_tetrahedron(sampled.points) < 1e-9
    assert sampled.notes[0] == f"The faces are of {vertices!r}: that mesh was taken, and the points {points!r} were left out."
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh[0], POINTS)
    np.testing.assert_array_equal(mesh[1], FACES)


def test_coordinates_in_three_arrays_may_have_a_mesh_beside_them(tmp_path):
    np.savez(tmp_path / "a.npz", **dict(zip("xyz", CLOUD.T)), vertices=POINTS, faces=FACES)
    scan = load_scan(tmp_path / "a.npz")
    np.testing.assert_array_equal(scan.points, CLOUD)
    assert "the points 'x, y, z'" in scan.notes[0]
    assert on_tetrahedron(load_scan(tmp_path / "a.npz", n_samples=50).points) < 1e-9


def test_normals_and_labels_are_of_what_has_as_many_rows(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=CLOUD, vertices=POINTS, faces=FACES, normals=NORMALS, labels=LABELS)
    scan, sampled = load_scan(path), load_scan(path, n_samples=50)
    assert scan.normals is None and scan.labels is None
    assert sampled.normals.shape == (50, 3) and set(sampled.labels) <= set(LABELS)
    np.savez(path, points=CLOUD, vertices=POINTS, faces=FACES, normals=CLOUD, labels=np.arange(9))
    scan, sampled = load_scan(path), load_scan(path, n_samples=50)
    np.testing.assert_array_equal(scan.normals, CLOUD)
    assert scan.labels.tolist() == list(range(9)) and sampled.normals is None and sampled.labels is None
    np.savez(path, points=CLOUD, vertices=POINTS, faces=FACES, labels=np.arange(7))
    with pytest.raises(FileError, match=r"labels of shape \(7,\)"):
        load_scan(path)


def test_without_faces_or_points_vertices_are_what_they_were(tmp_path):
    path = tmp_path / "a.npz"
    for faces in ({}, {"faces": np.empty((0, 3), int)}):
        np.savez(path, points=CLOUD, vertices=POINTS, **faces)
        scan = load_scan(path, n_samples=5)
        assert scan.notes == ("A random subset of 5 of its 9 points.",) and scan.points.min() >= 20
    for faces, v in ((np.array([[0, 1, 2]]), 0.01 * CLOUD), (FACES, np.array([{}], dtype=object)), (FACES, np.arange(4))):
        np.savez(path, points=CLOUD, v=v, faces=faces)  # velocities, or nothing that could be vertices
        assert load_scan(path).notes == () and load_mesh(path)[0].min() >= 20
    for others in ({"vertices": POINTS, "v": CLOUD}, {"points": POINTS}):
        np.savez(path, **others, faces=FACES)
        np.testing.assert_array_equal(load_scan(path).points, POINTS)
        assert load_scan(path, n_samples=50).notes == ("50 points sampled from the surface of 4 triangles.",)
