"""Flaws of a rig's mesh and weights: what is noted, and seams that are welded."""

import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import sparse, spatial
from small_rigs import make_tube_data, seamed, with_joint, with_loose_vertices

from lbsfit_np import load_rig, synthesize
from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.describe import describe
from lbsfit_np.rig.regressor import regressor_from_weights
from lbsfit_np.starts.beyond import end_of
from lbsfit_np.starts.scale import extent_doubt, reference_scale

# ---- notes ----


def test_open_mesh_pieces_and_unused_vertices_are_noted():
    data = make_tube_data()
    far = data.vertices[:3] + 3.0
    more = replace(
        data,
        vertices=np.vstack([data.vertices, far, far[:1] + 1]),
        faces=np.vstack([data.faces[1:], [[242, 243, 244]]]),
        weights=sparse.csr_array(sparse.vstack([data.weights, data.weights[[0, 0, 0, 0]]])),
    )
    notes = "\n".join(build_rig(more).notes)
    assert "open: 6 boundary edges" in notes
    assert "2 separate pieces" in notes
    assert "1 vertices belong to no face" in notes


@pytest.mark.parametrize("far", [100.0 * np.eye(3), np.eye(3)[[1, 2, 0]], None])
def test_joints_away_from_the_mesh_are_noted(far):
    """As of a file whose joints are in another unit, or stand up another way, than its vertices."""
    data = make_tube_data()
    joints = data.joints if far is None else data.joints @ far
    notes = [note for note in build_rig(replace(data, joints=joints, regressor=None)).notes if "outside the mesh" in note]
    assert len(notes) == (far is not None)
    if far is not None:
        assert "are joints in another unit than vertices, or is another of their axes up?" in notes[0] and "root" in notes[0]


def test_the_angle_of_a_joint_that_is_held_is_shown():
    data = make_tube_data()
    lower = data.lower.copy()
    lower[1] = data.upper[1] = [0.2, 0.0, 0.0]
    lines = describe(build_rig(replace(data, lower=lower))).splitlines()
    (line,) = [line for line in lines if "elbow" in line and "still" in line]
    assert "+0.20..+0.20" in line


def test_turned_faces_are_noted():
    data = make_tube_data()
    assert any("inside out" in note for note in build_rig(replace(data, faces=data.faces[:, ::-1])).notes)
    some = data.faces.copy()
    some[0] = some[0, ::-1]
    assert any("have opposite orientations at 3 edges" in note for note in build_rig(replace(data, faces=some)).notes)


def test_non_manifold_and_degenerate_faces_are_noted():
    data = make_tube_data()
    a, b, _ = data.faces[0]
    fin = next(int(v) for v in data.faces[-1] if v not in data.faces[0])
    more = replace(data, faces=np.vstack([data.faces, [[a, b, fin], [a, a, b]]]))
    notes = "\n".join(build_rig(more).notes)
    assert "not manifold: 1 edges" in notes
    assert "1 faces are degenerate" in notes


def test_many_influences_are_told_and_are_no_anomaly():
    rng = np.random.default_rng(0)
    data = with_joint(make_tube_data(), "fifth", 1)
    w = rng.random((242, 5))
    rig = build_rig(replace(data, weights=w / w.sum(axis=1, keepdims=True)))
    assert "skin      up to 5 joints per vertex, more than 4 at 242 vertices" in describe(rig)
    assert not any("per vertex" in note for note in rig.notes)
    assert "joints per vertex\n" in describe(build_rig(make_tube_data()))


# ---- welding ----


def test_seams_are_welded_for_the_geometry_only(tube_rig):
    rig = build_rig(seamed(make_tube_data(), [5, 60, 200]))
    assert len(rig.vertices) == 245 and len(rig.welded.vertices) == 242
    np.testing.assert_array_equal(rig.weld, [*range(242), 5, 60, 200])
    np.testing.assert_array_equal(rig.welded.vertices[rig.weld], rig.vertices)
    np.testing.assert_array_equal(rig.welded.faces, tube_rig.faces)
    np.testing.assert_allclose(rig.welded.regressor @ rig.welded.vertices, rig.joints, atol=1e-12)
    assert any("245 vertices lie at 242 distinct" in note for note in rig.notes)
    assert not any("open" in note for note in rig.notes)


def test_vertices_of_no_face_are_no_part_of_the_surface(tube_rig):
    data = make_tube_data()
    near = data.vertices[[7, 100]] + [0.001, 0, 0]
    rig = build_rig(with_loose_vertices(seamed(data, [5]), [near[0], [9.0, 9, 9], near[1]]))
    assert rig.loose.tolist() == [True] * 3 + [False] * 243 and rig.size == tube_rig.size
    np.testing.assert_array_equal(rig.welded.vertices, tube_rig.vertices)
    np.testing.assert_array_equal(rig.welded.faces, tube_rig.faces)
    np.testing.assert_array_equal(rig.welded.weights.toarray(), tube_rig.weights.toarray())
    assert rig.weld[[0, 2]].tolist() == [7, 100] and rig.weld[3:].tolist() == [*range(242), 5]
    assert rig.welded_from.tolist() == list(range(3, 245))
    assert {"243 vertices lie at 242 distinct points: duplicates at seams are welded for the geometry"} < set(rig.notes)
    assert "3 vertices belong to no face" in rig.notes and "vertices  246 (242 distinct, 3 loose)" in describe(rig)
    moved = rig.welded.vertices + np.arange(242)[:, None] * [0.0, 0.001, 0]
    again = pickle.loads(pickle.dumps(rig))
    assert not any(a.flags.writeable for a in (again.weld, again.welded_from, again.loose))
    unwelded = rig.unwelded(moved)
    np.testing.assert_array_equal(unwelded[3:245], moved)
    np.testing.assert_allclose(unwelded[:3] - rig.vertices[:3], (moved - rig.welded.vertices)[rig.weld[:3]], atol=1e-12)
    np.testing.assert_array_equal(rig.unwelded(rig.welded.vertices), rig.vertices)


@pytest.mark.parametrize("own", [False, True])
def test_joints_do_not_follow_vertices_of_no_face(own):
    """Whatever these are bound to, as guides are to the root; nor where the file's own regressor says so."""
    data = make_tube_data()
    places = np.array([[0.0, -1, 0], [5, 9, 0], [-5, 9, 0]])
    weights = sparse.vstack([data.weights, sparse.csr_array(np.eye(4)[[0, 0, 0]])]).tocsr()
    more = replace(data, vertices=np.vstack([data.vertices, places]), weights=weights, regressor=None)
    if own:
        more = replace(more, regressor=regressor_from_weights(more.vertices, weights, data.parents, data.joints))
    rig = build_rig(more)
    assert own == bool(abs(rig.regressor[:, 242:]).sum() > 0)
    np.testing.assert_allclose(rig.regressor @ rig.vertices, rig.joints, atol=1e-12)
    np.testing.assert_allclose(rig.welded.regressor @ rig.welded.vertices, rig.joints, atol=1e-12)


def test_vertices_of_no_face_free_no_joint():
    """A joint that turns all of the surface is locked, whatever else hangs on the root; so is one that moves nothing of it."""
    data = with_joint(with_joint(make_tube_data(), "world", 0), "guide", 0)
    data = replace(data, parents=np.array([4, 0, 1, 1, -1, 0]))
    loose = sparse.csr_array(np.eye(6)[[4, 5]])
    vertices, weights = np.vstack([data.vertices, [[0, 5, 0], [0, 6, 0]]]), sparse.vstack([data.weights, loose]).tocsr()
    more = replace(data, vertices=vertices, weights=weights)
    rig = build_rig(more)
    assert rig.locked.tolist() == build_rig(data).locked.tolist() == [True, False, False, False, False, True]
    assert any("2 joints without weight: world, guide" in note for note in rig.notes)


def test_a_joint_that_leads_vertices_of_no_face_alone_has_no_part():
    """Parts of the surface are numbered alike, with these vertices and without."""
    data = make_tube_data()
    order = [0, 1, 3, 2]  # "short" stands before "long"
    data = replace(
        data,
        joint_names=[data.joint_names[j] for j in order],
        joints=data.joints[order],
        frames=data.frames[order],
        weights=sparse.csr_array(data.weights)[:, order],
        lower=data.lower[order],
        upper=data.upper[order],
    )
    weights = data.weights.toarray()
    weights[:, 1] += 0.9 * weights[:, 2]
    weights[:, 2] *= 0.1  # "short" moves some of the surface, and leads nothing of it
    loose = np.eye(4)[[2, 2]]
    data = replace(data, vertices=np.vstack([data.vertices, data.vertices[:2]]), weights=np.vstack([weights, loose]))
    rig = build_rig(replace(data, partitions={}))
    assert rig.parts == rig.welded.parts == ("root", "elbow", "long")
    np.testing.assert_array_equal(rig.vertex_labels[:242], rig.welded.vertex_labels)


def test_vertices_of_no_face_are_no_measure_of_scans_and_no_end(tube_rig):
    places = [0.0, 7, 0] + np.random.default_rng(0).normal(size=(20, 3))
    rig = build_rig(with_loose_vertices(make_tube_data(), places))
    assert reference_scale(tube_rig.vertices, rig, "fixed").scale == 1.0
    small = 0.3 * tube_rig.vertices
    assert reference_scale(small, rig, "estimate") == reference_scale(small, tube_rig, "estimate")
    assert extent_doubt(tube_rig.vertices, rig, 1.0) == ""
    hand = load_rig("hand-coarse")
    guide = RigData(**{f.name: getattr(hand, f.name) for f in fields(RigData) if hasattr(hand, f.name)})
    guide = replace(guide, parents=np.array(hand.parents), shapes=None, parts=None)
    end, own = end_of(build_rig(with_loose_vertices(guide, hand.joints[:1] + [0.0, 0, 9 * hand.size]))), end_of(hand)
    assert end.reach == pytest.approx(own.reach) and end.length == pytest.approx(own.length)


@pytest.mark.parametrize("how", [{"floor": 0.3}, {"one_sided": True, "density": 0.5}])
def test_vertices_of_no_face_are_in_no_scan(tube_rig, how):
    rig = build_rig(with_loose_vertices(make_tube_data(), [[0.0, -50, 0], [1000, 0, 0]]))
    for a, b in zip(synthesize(rig, 2, random_state=3, **how), synthesize(tube_rig, 2, random_state=3, **how), strict=True):
        np.testing.assert_allclose(a.points, b.points, atol=1e-12)
        np.testing.assert_array_equal(a.labels, b.labels)
        np.testing.assert_allclose(a.vertices[2:], b.vertices, atol=1e-12)


def test_sheets_that_touch_but_move_apart_are_not_welded():
    data = seamed(make_tube_data(), [5])
    w = data.weights.copy()
    w[-1] = [0, 0, 0, 1]
    rig = build_rig(replace(data, weights=w))
    assert len(rig.welded.vertices) == 243


def test_a_seam_of_other_weights_loses_no_part(tube_rig):
    """A joint that leads but one copy of a vertex: rig and surface have the same parts, of the same joints."""
    data = with_joint(seamed(make_tube_data(), [5]))
    w = data.weights.toarray()
    w[[5, 242]] = 0.0
    w[5, [0, 4]], w[242, [0, 4]] = (0.503, 0.497), (0.494, 0.506)
    for copies in (w, w[[*range(5), 242, *range(6, 242), 5]]):
        rig = build_rig(replace(data, weights=copies))
        assert rig.parts == rig.welded.parts and rig.digest != rig.welded.digest
        np.testing.assert_array_equal(rig.part_of_joint, rig.welded.part_of_joint)
        np.testing.assert_array_equal(rig.vertex_labels[rig.welded_from], rig.welded.vertex_labels)
        moved = rig.with_template(rig.vertices * 1.1)
        assert moved.parts == moved.welded.parts == rig.parts


def test_vertices_of_no_face_weld_nothing(tube_rig):
    """Very many at one place, and one so far away that the whole surface is small beside it."""
    places = np.zeros((20_000, 3))
    places[0] = 1e6
    rig = build_rig(with_loose_vertices(make_tube_data(), places))
    np.testing.assert_array_equal(rig.welded.vertices, tube_rig.vertices)
    np.testing.assert_array_equal(rig.welded.faces, tube_rig.faces)
    assert rig.loose.sum() == 20_000 and not any("seams" in note or "degenerate" in note for note in rig.notes)


def test_vertices_of_no_face_need_no_weights(tube_rig):
    data = with_loose_vertices(make_tube_data(), [[9.0, 9, 9], [0.1, 0.2, 0.3]])
    w = data.weights.toarray()
    w[0] = 0.0
    rig = build_rig(replace(data, weights=w))
    assert "1 vertex of no face has no weight, and follows 'root'" in rig.notes
    np.testing.assert_array_equal(rig.weights.toarray()[0], [1.0, 0, 0, 0])
    np.testing.assert_array_equal(rig.welded.weights.toarray(), tube_rig.weights.toarray())
    w[1] = w[7] = 0.0
    with pytest.raises(InputError, match="weights: got 1 of 244 vertices without any weight, the first is vertex 7"):
        build_rig(replace(data, weights=w))


def test_what_is_known_of_seams_goes_on_to_other_parts(tube_rig, monkeypatch):
    rig = build_rig(seamed(make_tube_data(), [5]))
    assert rig.weld is not None
    monkeypatch.setattr("lbsfit_np.rig.rig.weld_of", None)
    assert rig.with_parts("arm and fingers").parts == ("arm", "fingers")


def test_collapsed_faces_weld_nothing(tube_rig, monkeypatch):
    """Very many vertices at one place, of faces that are points: each would be a pair with each."""
    data = make_tube_data()
    faces = np.arange(6000).reshape(-1, 3)
    more = with_loose_vertices(data, np.zeros((6000, 3)))
    searched = []

    class Tree(spatial.cKDTree):
        def query_pairs(self, *arguments, **options):
            searched.append(self.n)
            return super().query_pairs(*arguments, **options)

    monkeypatch.setattr(spatial, "cKDTree", Tree)
    rig = build_rig(replace(more, faces=np.vstack([faces, more.faces])))
    monkeypatch.undo()
    assert searched and max(searched) == len(data.vertices)
    np.testing.assert_array_equal(rig.welded.vertices, tube_rig.vertices)
    np.testing.assert_array_equal(rig.welded.faces, tube_rig.faces)


def test_the_digest_does_not_depend_on_how_entries_are_stored(tube_rig):
    """Which versions of SciPy may differ in; what was trained on a rig has to be of it still."""
    assert _with_entries_reversed(tube_rig).digest == tube_rig.digest
    rig = build_rig(seamed(make_tube_data(), [5, 60, 200]))
    assert _with_entries_reversed(rig).digest == rig.digest
    assert _with_entries_reversed(rig.welded).digest == rig.welded.digest == _with_entries_reversed(rig).welded.digest


def _with_entries_reversed(rig):
    """The same rig, each row of its matrices stored from the last entry to the first."""

    def reversed_rows(matrix):
        pieces = [np.arange(b - 1, a - 1, -1) for a, b in zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True)]
        order = np.concatenate(pieces)
        return sparse.csr_array((matrix.data[order], matrix.indices[order], matrix.indptr), shape=matrix.shape)

    return replace(rig, weights=reversed_rows(rig.weights), regressor=reversed_rows(rig.regressor))


def test_vertices_of_no_face_without_weights_follow_the_root_wherever_it_stands():
    data = with_loose_vertices(make_tube_data(), [[9.0, 9, 9]])
    order = [3, 0, 1, 2]  # the root is second
    w = data.weights.toarray()[:, order]
    w[0] = 0.0
    picked = {name: np.asarray(getattr(data, name))[order] for name in ("joints", "frames", "lower", "upper")}
    names = [data.joint_names[j] for j in order]
    parents = np.array([order.index(p) if p >= 0 else -1 for p in np.asarray(data.parents)[order]])
    rig = build_rig(replace(data, weights=w, joint_names=names, parents=parents, regressor=None, **picked))
    np.testing.assert_array_equal(rig.weights.toarray()[0], [0.0, 1, 0, 0])
    assert rig.root == 1 and any("follows 'root'" in note for note in rig.notes)
