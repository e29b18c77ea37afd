"""Fits as an animated glTF: what a viewer would draw from the file alone is the registered mesh."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from animated_files import Viewer, a_fit, closeness, save
from scipy import sparse
from scipy.spatial.transform import Rotation
from small_rigs import make_tube_data, make_tube_rig

import lbsfit_np as lbs
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.fitting.several import unit_of
from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.data import RigData


@pytest.fixture(scope="module", params=["tube", "hand-coarse", "body-coarse"])
def rig(request, tube_rig):
    return tube_rig if request.param == "tube" else lbs.load_rig(request.param)


def test_one_fit_stands_in_its_pose(rig, tmp_path):
    result = a_fit(rig, 0)
    errors = save(tmp_path / "a.glb", rig, result)
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.draw(), result.vertices, rtol=0, atol=closeness(rig))
    np.testing.assert_allclose(errors, [0.0], atol=1e-12)
    assert "targets" not in viewer.primitive and viewer.animation is None
    np.testing.assert_array_equal(viewer.array(viewer.primitive["indices"]).reshape(-1, 3), rig.faces)
    names = [viewer.root["nodes"][j]["name"] for j in viewer.skin["joints"]]
    assert tuple(names) == rig.joint_names
    assert [viewer.parents.get(j, -1) for j in viewer.skin["joints"]] == rig.parents.tolist()


def test_each_key_frame_is_its_registered_mesh(rig, tmp_path):
    results = [a_fit(rig, k) for k in range(4)]
    errors = save(tmp_path / "a.glb", rig, results, offsets="each", frames_per_second=10)
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.times, [0, 0.1, 0.2, 0.3], rtol=1e-6)
    for time, result in zip(viewer.times, results, strict=True):
        np.testing.assert_allclose(viewer.draw(time), result.vertices, rtol=0, atol=closeness(rig))
    np.testing.assert_allclose(viewer.draw(), results[0].vertices, rtol=0, atol=closeness(rig))
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)


def test_the_mean_template_keeps_bones_as_long_as_they_are(rig, tmp_path):
    """In one size, with the vertices' centre where the fit has it."""
    results = [a_fit(rig, k) for k in range(3)]
    errors = save(tmp_path / "a.glb", rig, results)
    scale = np.prod([r.scale for r in results]) ** (1 / 3)
    viewer = Viewer(tmp_path / "a.glb")
    mean = np.mean([r.offsets for r in results], axis=0)
    joints = np.mean([r.rest_joints for r in results], axis=0)
    for time, result, error in zip(viewer.times, results, errors, strict=True):
        expected = rig.pose(result.pose, np.zeros(3), scale, mean, joints=joints)
        expected += result.vertices.mean(axis=0) - expected.mean(axis=0)
        np.testing.assert_allclose(viewer.draw(time), expected, rtol=0, atol=closeness(rig))
        assert error == pytest.approx(np.linalg.norm(expected - result.vertices, axis=1).mean()) and error > 1e-3 * rig.size
    moved = {(c["target"]["node"], c["target"]["path"]) for c in viewer.animation["channels"]}
    assert {(node, path) for node, path in moved if path != "rotation"} == {(rig.root, "translation")}
    assert {node for node, path in moved if path == "rotation"} == set(np.flatnonzero(rig.moving))
    assert "targets" not in viewer.primitive


def test_frames_of_one_scale_are_where_the_fits_are_too(tube_rig, tmp_path):
    """As all are with a fixed scale; the mean template alone would move each."""
    results = [replace(a_fit(tube_rig, k), scale=1.0) for k in range(3)]
    posed = [(r.pose, r.translation, r.scale, r.offsets) for r in results]
    results = [replace(r, vertices=tube_rig.pose(*p, joints=r.rest_joints)) for r, p in zip(results, posed, strict=True)]
    save(tmp_path / "a.glb", tube_rig, results)
    viewer = Viewer(tmp_path / "a.glb")
    for time, result in zip(viewer.times, results, strict=True):
        centre = result.vertices.mean(axis=0)
        np.testing.assert_allclose(viewer.draw(time).mean(axis=0), centre, rtol=0, atol=closeness(tube_rig))


@pytest.mark.parametrize("subjects, factor", [(("ann", "bob"), 1.0), (("", ""), 1.5)])
def test_of_people_of_several_sizes_each_has_its_own(subjects, factor, tube_rig, tmp_path):
    results = [a_fit(tube_rig, k, subject=subject) for k, subject in enumerate(subjects)]
    results[1] = replace(results[1], scale=factor * results[1].scale)
    scale = np.sqrt(results[0].scale * results[1].scale)
    save(tmp_path / "a.glb", tube_rig, results)
    viewer = Viewer(tmp_path / "a.glb")
    found = [viewer.properties(time)[tube_rig.root, "scale"][0] for time in viewer.times]
    np.testing.assert_allclose(found, [r.scale / scale for r in results], rtol=1e-6)


@pytest.mark.parametrize("n", [2, 3, 7])
def test_what_all_fits_share_is_no_morph_target(tube_rig, tmp_path, n):
    """As of one subject of a learned model, without residuals."""
    first, results = a_fit(tube_rig, 0), []
    for k in range(n):
        posed = first.pose, first.translation + k, first.scale, first.offsets
        results.append(replace(first, translation=posed[1], vertices=tube_rig.pose(*posed, joints=first.rest_joints)))
    away = save(tmp_path / "a.glb", tube_rig, results, offsets="each")
    viewer = Viewer(tmp_path / "a.glb")
    changing = {(c["target"]["node"], c["target"]["path"]) for c in viewer.animation["channels"]}
    assert "targets" not in viewer.primitive and changing == {(tube_rig.root, "rotation"), (tube_rig.root, "translation")}
    np.testing.assert_allclose(viewer.draw(viewer.times[-1]), results[-1].vertices, atol=n * closeness(tube_rig))
    np.testing.assert_array_equal(away, 0.0)


def test_what_lies_between_key_frames_takes_the_short_way(tube_rig, tmp_path):
    """A quaternion and its negative are one rotation, but not for what is interpolated."""
    fits = []
    for angle in (3.0, 4.4, 5.2, 6.0):
        fit = a_fit(tube_rig, 0)
        pose = fit.pose.copy()
        pose[tube_rig.root] = 0.0, angle, 0.0
        fits.append(replace(fit, pose=pose, vertices=tube_rig.pose(pose, fit.translation, fit.scale, fit.offsets)))
    save(tmp_path / "a.glb", tube_rig, fits)
    viewer = Viewer(tmp_path / "a.glb")
    root = [viewer.properties(time)[tube_rig.root, "rotation"] for time in viewer.times]
    assert (np.einsum("ka,ka->k", root[1:], root[:-1]) > 0.7).all()


def test_the_package_reads_it_as_a_rig(rig, tmp_path):
    """Joints, weights, faces; and of an animation the angles."""
    results = [replace(a_fit(rig, k, amount=0.0, rest_joints=rig.joints), scale=1.0) for k in range(3)]
    save(tmp_path / "a.glb", rig, results)
    data = read_gltf(tmp_path / "a.glb")
    assert not [note for note in data.notes if "animations move" in note], data.notes
    assert tuple(data.joint_names) == rig.joint_names and data.parents.tolist() == rig.parents.tolist()
    np.testing.assert_array_equal(data.faces, rig.faces)
    np.testing.assert_allclose(data.weights.toarray(), rig.weights.toarray(), atol=1e-6)
    moving = np.ones(len(rig.parents), bool)
    moving[rig.root] = False
    for k, result in enumerate(results):
        found = Rotation.from_rotvec(data.animated[2 * k][moving])
        assert (found * Rotation.from_rotvec(result.pose[moving]).inv()).magnitude().max() < 1e-5


def test_more_than_four_joints_a_vertex_go_to_further_sets(tmp_path):
    rig = lbs.load_rig("hand-coarse")
    weights = rig.weights.toarray() + 0.02
    rig = replace(rig, weights=type(rig.weights)(weights / weights.sum(axis=1, keepdims=True)))
    result = a_fit(rig, 1)
    save(tmp_path / "a.glb", rig, result)
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.draw(), result.vertices, rtol=0, atol=closeness(rig))
    sets = [viewer.attribute(f"WEIGHTS_{k}") for k in range(-(-len(rig.parents) // 4))]
    np.testing.assert_allclose(np.sum(sets, axis=(0, 2)), 1.0, atol=2e-7)
    assert sets[0].min() >= sets[1].max(axis=1).min() and (np.diff(np.hstack(sets), axis=1) <= 1e-6).all()


def test_normals_point_out_and_are_of_length_one(rig, tmp_path):
    save(tmp_path / "a.glb", rig, a_fit(rig, 0, amount=0.0))
    viewer = Viewer(tmp_path / "a.glb")
    normals, v = viewer.attribute("NORMAL"), viewer.attribute("POSITION")
    assert viewer.root["materials"][viewer.primitive["material"]]["pbrMetallicRoughness"]["metallicFactor"] == 0
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    a, b, c = v[rig.faces[:, 0]], v[rig.faces[:, 1]], v[rig.faces[:, 2]]
    assert (np.einsum("ia,ia->i", normals[rig.faces[:, 0]], np.cross(b - a, c - a)) > 0).mean() > 0.98


def test_rest_pose_bones_and_fits_are_of_one_size_in_metres(tube_rig, tmp_path):
    """Also of scans in millimetres, of which the rig's unit tells. Programs show the rest pose, and draw bones in its size."""
    fits = [a_fit(tube_rig, k, amount=0.001) for k in range(2)]
    fits = [replace(f, scale=f.scale * 250, translation=f.translation * 250) for f in fits]  # the tube's unit is 0.25 m
    fits = [replace(f, vertices=tube_rig.pose(f.pose, f.translation, f.scale, f.offsets, joints=f.rest_joints)) for f in fits]
    lbs.save_animation(tmp_path / "a.glb", tube_rig, fits)
    viewer = Viewer(tmp_path / "a.glb")
    scale = np.sqrt(fits[0].scale * fits[1].scale)
    assert 1.01 < max(f.scale for f in fits) / scale < 1.1
    assert np.ptp(viewer.attribute("POSITION"), axis=0).max() == pytest.approx(0.001 * scale * tube_rig.size, rel=0.02)
    for time, fit in zip(viewer.times, fits, strict=True):
        drawn, own = 1000 * viewer.draw(time), fit.vertices - fit.vertices.mean(axis=0)
        np.testing.assert_allclose(drawn - drawn.mean(axis=0), scale / fit.scale * own, atol=0.02 * fit.scale)
        np.testing.assert_allclose(drawn.mean(axis=0), fit.vertices.mean(axis=0), atol=1e-4 * fit.scale)
    assert len(viewer.root["nodes"]) == 1 + len(tube_rig.parents)
    same = [replace(f, scale=250.0) for f in fits]
    lbs.save_animation(tmp_path / "b.glb", tube_rig, same)
    viewer = Viewer(tmp_path / "b.glb")
    np.testing.assert_array_equal(viewer.properties(0.0)[tube_rig.root, "scale"], 1.0)
    assert all(channel["target"]["path"] != "scale" for channel in viewer.animation["channels"])


@pytest.mark.parametrize(
    ("metres", "scales", "name", "expected"),
    [
        (1.0, [1.0], "metres", 1.0),
        (1.0, [990.0, 1100.0, 20.0], "millimetres", 0.001),
        (1.0, [1.0, 990.0, 1100.0], "millimetres", 0.001),
        (0.01, [0.9], "centimetres", 0.01),
        (0.01, [0.012], "metres", 1.0),
        (0.25, [1.1], "the rig's unit", 0.25),
        (1.0, [7.0], None, 1.0),
        (None, [1.0], None, 1.0),
    ],
)
def test_the_unit_is_told_by_the_rig_and_the_scales(tube_rig, metres, scales, name, expected):
    fit = a_fit(tube_rig, 0)
    rig = replace(tube_rig, metres_per_unit=metres)
    assert unit_of(rig, [replace(fit, scale=scale) for scale in scales]) == (name, expected)


def test_four_influences_are_what_many_programs_show(tmp_path):
    rig = lbs.load_rig("hand-coarse")
    weights = rig.weights.toarray() + np.linspace(0.01, 0.05, len(rig.parents))
    rig = replace(rig, weights=type(rig.weights)(weights / weights.sum(axis=1, keepdims=True)))
    result = a_fit(rig, 1, amount=0.0)
    away = save(tmp_path / "a.glb", rig, result, influences=4)
    viewer = Viewer(tmp_path / "a.glb")
    assert [name for name in viewer.primitive["attributes"] if name.startswith("JOINTS")] == ["JOINTS_0"]
    np.testing.assert_allclose(viewer.attribute("WEIGHTS_0").sum(axis=1), 1.0, atol=2e-7)
    assert away[0] == pytest.approx(np.linalg.norm(viewer.draw() - result.vertices, axis=1).mean(), rel=1e-4) and away[0] > 0
    least = np.sort(rig.weights.toarray(), axis=1)[:, -4]
    kept = np.take_along_axis(rig.weights.toarray(), viewer.attribute("JOINTS_0").astype(int), axis=1)
    assert (kept >= least[:, None]).all()
    assert save(tmp_path / "b.glb", rig, result, influences=len(rig.parents))[0] < 1e-12 * rig.size


def test_a_root_that_is_not_the_first_row_and_a_seam(tmp_path):
    data = make_tube_data()
    order = [2, 3, 0, 1]
    back = np.argsort(order)
    m = len(data.vertices)
    data = replace(
        data,
        vertices=np.vstack([data.vertices, data.vertices]),  # upper faces have vertices of their own
        faces=data.faces + m * (np.arange(len(data.faces)) % 2)[:, None],
        weights=sparse.vstack([data.weights, data.weights]).tocsr()[:, order],
        joint_names=[data.joint_names[j] for j in order],
        parents=np.array([-1 if data.parents[j] < 0 else back[data.parents[j]] for j in order]),
        joints=data.joints[order],
        lower=data.lower[order],
        upper=data.upper[order],
    )
    rig = build_rig(data)
    assert rig.root == 2 and len(rig.welded.vertices) == m
    result = a_fit(rig, 0, amount=0.0)
    save(tmp_path / "a.glb", rig, result)
    viewer = Viewer(tmp_path / "a.glb")
    np.testing.assert_allclose(viewer.draw(), result.vertices, atol=closeness(rig))
    assert viewer.root["scenes"][0]["nodes"] == [2, 4]
    normals = viewer.attribute("NORMAL")
    np.testing.assert_array_equal(normals[:m], normals[m:])


def test_a_vertex_without_a_face_has_a_normal(tmp_path):
    data = make_tube_data()
    weights = sparse.vstack([data.weights, data.weights[[5]]]).tocsr()
    loose = build_rig(replace(data, vertices=np.vstack([data.vertices, [[0.0, 0.0, 2.0]]]), weights=weights))
    save(tmp_path / "a.glb", loose, a_fit(loose, 0))
    np.testing.assert_allclose(np.linalg.norm(Viewer(tmp_path / "a.glb").attribute("NORMAL"), axis=1), 1.0, atol=1e-6)


def test_a_rig_of_one_joint(tmp_path):
    solid = trimesh.creation.icosphere(1)
    rig = build_rig(
        RigData(
            name="bäll",
            vertices=np.array(solid.vertices),
            faces=np.array(solid.faces),
            weights=sparse.csr_array(np.ones((len(solid.vertices), 1))),
            joint_names=["one"],
            parents=np.array([-1]),
            joints=np.zeros((1, 3)),
            frames=np.eye(3)[None],
        )
    )
    results = [a_fit(rig, k) for k in range(2)]
    save(tmp_path / "a.glb", rig, results, offsets="each")
    viewer = Viewer(tmp_path / "a.glb")
    for time, result in zip(viewer.times, results, strict=True):
        np.testing.assert_allclose(viewer.draw(time), result.vertices, atol=closeness(rig))
    assert viewer.root["skins"][0]["name"] == "bäll"


@pytest.mark.parametrize("up", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_the_axis_that_is_up_becomes_y(tube_rig, tmp_path, up):
    result = a_fit(tube_rig, 0)
    save(tmp_path / "a.glb", tube_rig, result, up=up, metres_per_unit=0.001)
    drawn = Viewer(tmp_path / "a.glb").draw()
    axis = "xyz".index(up[1])
    np.testing.assert_allclose(1000 * drawn[:, 1], float(up[0] + "1") * result.vertices[:, axis], atol=closeness(tube_rig))
    turn, _ = Rotation.align_vectors(drawn - drawn.mean(axis=0), result.vertices - result.vertices.mean(axis=0))
    np.testing.assert_allclose(turn.apply(result.vertices) * 0.001, drawn, atol=0.001 * closeness(tube_rig))  # no mirror image


@pytest.mark.parametrize(("up", "front"), [("+z", "-y"), ("+z", "+y"), ("-x", "+z"), ("+y", "-z"), ("+y", "+z")])
def test_the_rigs_front_becomes_that_of_gltf(tube_rig, tmp_path, up, front):
    """+z, where scans stand as the rig does."""
    rig, result = replace(tube_rig, up=up, forward=front), a_fit(tube_rig, 0)
    for given in (None, up):
        save(tmp_path / "a.glb", rig, result, up=given)
        drawn = Viewer(tmp_path / "a.glb").draw()
        for row, axis in ((1, up), (2, front)):
            along = float(axis[0] + "1") * result.vertices[:, "xyz".index(axis[1])]
            np.testing.assert_allclose(drawn[:, row], along, atol=closeness(tube_rig))
        turn, _ = Rotation.align_vectors(drawn - drawn.mean(axis=0), result.vertices - result.vertices.mean(axis=0))
        np.testing.assert_allclose(turn.apply(result.vertices), drawn, atol=closeness(tube_rig))


def test_the_rigs_own_axis_is_taken_where_none_is_given(tube_rig, tmp_path):
    result = a_fit(tube_rig, 0)
    save(tmp_path / "a.glb", replace(tube_rig, up="+z", forward=None), result)
    save(tmp_path / "b.glb", tube_rig, result, up="+z")
    np.testing.assert_allclose(Viewer(tmp_path / "a.glb").draw(), Viewer(tmp_path / "b.glb").draw(), atol=1e-9)


def _wrong(rig):
    fit = a_fit(rig, 0)
    pose = fit.pose.copy()
    pose[1, 0] = np.nan
    return {
        "no .glb": ("path", "a.gltf", fit, {}),
        "no fits": ("results", "a.glb", [], {}),
        "no sequence": ("results", "a.glb", 3, {}),
        "no fit": ("results[1]", "a.glb", [fit, "fit"], {}),
        "another rig": ("results[0]", "a.glb", [replace(fit, rig_digest="other")], {}),
        "a NaN": ("results[0]", "a.glb", [replace(fit, pose=pose)], {}),
        "vertices of NaN": ("results", "a.glb", replace(fit, vertices=np.nan * fit.vertices), {}),
        "beyond single precision": ("results", "a.glb", replace(fit, translation=np.full(3, 1e39)), {}),
        "products beyond single precision": ("results", "a.glb", replace(fit, scale=1e29, offsets=1e29 + fit.offsets), {}),
        "next to no scale": ("results", "a.glb", replace(fit, scale=1e-300), {}),
        "a negative scale": ("results", "a.glb", replace(fit, scale=-1.0), {}),
        "another shape": ("results", "a.glb", replace(fit, offsets=fit.offsets[1:]), {}),
        "offsets": ("offsets", "a.glb", fit, {"offsets": "both"}),
        "an array": ("offsets", "a.glb", fit, {"offsets": np.zeros(3)}),
        "no axis": ("up", "a.glb", fit, {"up": "y"}),
        "a list": ("up", "a.glb", fit, {"up": ["+y"]}),
        "no time": ("frames_per_second", "a.glb", fit, {"frames_per_second": 0}),
        "infinite": ("metres_per_unit", "a.glb", fit, {"metres_per_unit": np.inf}),
        "no influence": ("influences", "a.glb", fit, {"influences": 0}),
        "half of one": ("influences", "a.glb", fit, {"influences": 0.5}),
    }


@pytest.mark.parametrize("wrong", [*_wrong(make_tube_rig())])
def test_bad_arguments_are_named_and_nothing_is_written(wrong, tube_rig, tmp_path):
    argument, name, results, options = _wrong(tube_rig)[wrong]
    with pytest.raises(InputError) as error:
        save(tmp_path / name, tube_rig, results, **options)
    assert error.value.argument == argument
    assert not list(tmp_path.iterdir())


def test_a_rig_that_is_none(tmp_path, tube_rig):
    with pytest.raises(InputError, match="rig"):
        save(tmp_path / "a.glb", "hand", a_fit(tube_rig, 0))


def test_a_folder_that_does_not_exist(tmp_path, tube_rig):
    with pytest.raises(FileError, match="does not exist"):
        save(tmp_path / "no" / "a.glb", tube_rig, a_fit(tube_rig, 0))


def test_far_from_the_origin_frames_still_move(tube_rig, tmp_path):
    """By centimetres, where single precision's numbers are half a metre apart."""
    far = np.array([650_000.37, 5_200_000.27, 300.0])
    near = [replace(a_fit(tube_rig, 0, amount=0.0), translation=np.array([0.0, 0.05 * k, 0.0])) for k in range(3)]
    for results, place in ((near, None), ([replace(r, translation=r.translation + far) for r in near], far)):
        results = [replace(r, vertices=tube_rig.pose(r.pose, r.translation, r.scale)) for r in results]
        save(tmp_path / "a.glb", tube_rig, results)
        viewer = Viewer(tmp_path / "a.glb")
        drawn = [viewer.draw(time) for time in viewer.times]
        for k, vertices in enumerate(drawn):
            np.testing.assert_allclose(vertices - drawn[0], [[0.0, 0.05 * k, 0.0]] * len(vertices), atol=1e-5)
            np.testing.assert_allclose(vertices, results[k].vertices, atol=1e-5)
        (top,) = [viewer.root["nodes"][n] for n in viewer.root["scenes"][0]["nodes"] if "mesh" not in viewer.root["nodes"][n]]
        assert (top["name"] == "place of the scans") == (place is not None)
        assert tuple(read_gltf(tmp_path / "a.glb").joint_names) == tube_rig.joint_names
