"""build_rig: what it accepts, derives and notes, and what the rigs that it makes promise."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import NAMES, make_tube_data, with_joint

from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.describe import describe

# ---- a good rig ----


def test_rest_pose_is_the_template_to_the_last_bit(tube_rig):
    assert (tube_rig.pose(np.zeros((4, 3))) == tube_rig.vertices).all()
    assert (tube_rig.pose_joints(np.zeros((4, 3))) == tube_rig.joints).all()


def test_rows_order_and_settings_are_the_files(tube_rig):
    data = make_tube_data()
    assert tube_rig.joint_names == NAMES
    np.testing.assert_array_equal(tube_rig.parents, data.parents)
    np.testing.assert_array_equal(tube_rig.lower, data.lower)
    np.testing.assert_array_equal(tube_rig.vertices, data.vertices)
    assert (tube_rig.metres_per_unit, tube_rig.up, tube_rig.forward) == (0.25, "+y", "+z")
    assert tube_rig.notes == ()
    assert abs(tube_rig.weights.sum(axis=1) - 1).max() < 1e-12


def test_rig_is_immutable_and_leaves_the_data_alone():
    data = make_tube_data()
    rig = build_rig(data)
    for array in (rig.vertices, rig.lower, rig.weights.data, rig.regressor.indices, rig.vertex_labels, rig.part_of_joint):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    before = rig.vertices.copy()
    data.vertices += 1.0
    data.weights.data[:] = 0.5
    np.testing.assert_array_equal(rig.vertices, before)
    assert abs(rig.weights.sum(axis=1) - 1).max() < 1e-12


@pytest.mark.parametrize(
    "poses, words",
    [
        ({"mine": np.zeros((3, 3))}, r"pose 'mine': got shape \(3, 3\); expected shape \(4, 3\)"),
        ({"mine": np.full((4, 3), np.nan)}, "pose 'mine': got 12 values that are NaN or infinite"),
        ({"mine": np.full((4, 3), 90)}, "pose 'mine': got an angle of 90; expected radians, of two turns at most. Multiply d"),
        ({"mine": "sitting"}, "pose 'mine': got an array of type <U7"),
        ({"": np.zeros((4, 3))}, "poses: got names that are empty or not text"),
        ({1: np.zeros((4, 3))}, "poses: got names that are empty or not text"),
        ([np.zeros((4, 3))], "poses: got list; expected a mapping of names to poses"),
    ],
)
def test_poses_of_ones_own_are_checked(poses, words, tube_rig):
    with pytest.raises(InputError, match=words):
        replace(tube_rig, poses=poses)


def test_templates_leave_their_givers_arrays_alone(tube_rig):
    vertices, joints, theta = tube_rig.vertices + 0.1, tube_rig.joints + 0.1, np.zeros((4, 3))
    rig = replace(tube_rig.with_template(vertices, joints), poses={"mine": theta})
    before = rig.vertices.copy()
    vertices += 1.0
    joints += 1.0
    theta += 1.0
    np.testing.assert_array_equal(rig.vertices, before)
    view = vertices.view()
    view.flags.writeable = False
    other, before = replace(rig, vertices=view), vertices.copy()
    vertices += 1.0  # by way of what it is a view of
    np.testing.assert_array_equal(other.vertices, before)
    assert not rig.poses["mine"].any() and not rig.poses["mine"].flags.writeable
    for one in (rig, pickle.loads(pickle.dumps(rig, protocol=5))):  # what nobody can write to is not copied
        other = one.with_parts("joints")
        assert other.vertices is one.vertices and other.weights is one.weights and other.regressor is one.regressor


def test_loose_vertices_are_no_measure_of_the_size(tube_rig):
    data = make_tube_data()
    weights = sparse.csr_array(sparse.vstack([data.weights, data.weights[[0]]]))
    loose = build_rig(replace(data, vertices=np.vstack([data.vertices, [[0, 99, 0]]]), weights=weights, regressor=None))
    assert loose.size == tube_rig.size and "1 vertices belong to no face" in loose.notes
    line = replace(loose, faces=np.vstack([loose.faces, [[242, 242, 0]]]))
    assert line.size == line.welded.size == tube_rig.size


def test_rig_travels_to_other_processes(tube_rig):
    tube_rig.welded.vertex_labels  # noqa: B018 - what has been computed goes along
    again = pickle.loads(pickle.dumps(tube_rig))
    assert again.digest == tube_rig.digest and again.parts == tube_rig.parts


@pytest.mark.parametrize("protocol", [2, pickle.HIGHEST_PROTOCOL])
def test_rig_is_immutable_in_other_processes_too(tube_rig, protocol):
    again = pickle.loads(pickle.dumps(tube_rig, protocol=protocol))
    sparse_arrays = [getattr(rig, name) for rig in (tube_rig, again) for name in ("weights", "regressor")]
    arrays = [getattr(again, name) for name in ("vertices", "faces", "parents", "joints", "frames", "lower", "upper", "merged")]
    arrays += [getattr(a, name) for a in sparse_arrays for name in ("data", "indices", "indptr")]
    assert not any(array.flags.writeable for array in [*arrays, again.locked])
    with pytest.raises(ValueError, match="read-only"):
        again.vertices[0] = 0
    with pytest.raises(AttributeError):
        again.vertices = tube_rig.vertices
    theta = np.full(again.lower.shape, 0.2)
    np.testing.assert_array_equal(again.pose(theta), tube_rig.pose(theta))
    np.testing.assert_array_equal(again.scaled(2.0).vertices, 2 * tube_rig.vertices)
    np.testing.assert_array_equal(again.scaled(np.float32(2)).vertices, 2 * tube_rig.vertices)


@pytest.mark.parametrize("factor", [0, 0.0, -1, np.nan, np.inf, -np.inf, True, None, "2", [2.0], 2j, 10**400, 1e-320])
def test_a_rig_is_scaled_by_a_positive_number(factor, tube_rig):
    with pytest.raises(InputError, match="factor: got .*; expected a positive number, from 1e-100 to 1e\\+100"):
        tube_rig.scaled(factor)


def test_partitions(tube_rig):
    assert tube_rig.parts == NAMES
    assert set(np.unique(tube_rig.vertex_labels)) == {0, 1, 2, 3}
    leads = tube_rig.weights.toarray().argmax(axis=1)
    np.testing.assert_array_equal(tube_rig.vertex_labels, leads)
    coarse = tube_rig.with_parts("arm and fingers")
    assert coarse.parts == ("arm", "fingers")
    np.testing.assert_array_equal(coarse.vertex_labels, (leads >= 2).astype(int))
    assert build_rig(make_tube_data(), parts="arm and fingers").parts == ("arm", "fingers")
    with pytest.raises(InputError, match="'toes'.*joints, arm and fingers"):
        build_rig(make_tube_data(), parts="toes")
    for parts in (np.array(["joints", "toes"]), ["joints"]):
        for use in (tube_rig.with_parts, lambda parts: build_rig(make_tube_data(), parts=parts)):
            with pytest.raises(InputError, match="parts: got .*; expected one of joints, arm and fingers"):
                use(parts)


@pytest.mark.parametrize("built", [True, False])
@pytest.mark.parametrize(
    "name, remedy",
    [("jionts", "Did you mean 'joints'?"), ("toes", "Name further partitions in the rig's card, in [parts.NAME].")],
)
def test_a_partition_that_is_none_may_be_a_misspelled_one(built, name, remedy, tube_rig):
    with pytest.raises(InputError) as caught:
        build_rig(make_tube_data(), parts=name) if built else tube_rig.with_parts(name)
    assert str(caught.value) == f"parts: got {name!r}; expected one of joints, arm and fingers. {remedy}"


def test_the_rigs_own_partition_may_be_none():
    with pytest.raises(InputError, match="parts of the file: got 'toes'"):
        build_rig(replace(make_tube_data(), parts="toes"))


def test_partition_needs_a_part_for_every_vertex():
    data = replace(make_tube_data(), partitions={"odd": {"finger": ("long",)}})
    with pytest.raises(InputError, match="odd.*root"):
        build_rig(data)


def test_part_without_vertices_is_left_out_and_noted():
    data = with_joint(make_tube_data(), partitions={"p": {"all": ("root",), "ghost": ("tip",)}})
    rig = build_rig(data, parts="p")
    assert rig.parts == ("all",)
    assert (rig.part_of_joint == 0).all()
    assert any("ghost" in note for note in rig.notes)


def test_smallest_rig():
    data = RigData(
        name="one", vertices=np.eye(3), faces=np.array([[0, 1, 2]]), weights=np.ones((3, 1)), joint_names=["only"],
        parents=np.array([-1]), joints=np.zeros((1, 3)), frames=np.eye(3)[None],
    )  # fmt: skip
    rig = build_rig(data)
    assert rig.parts == ("only",) and (rig.pose(np.zeros((1, 3))) == np.eye(3)).all()
    assert any("open" in note for note in rig.notes)
    assert "only" in describe(rig)


# ---- weights ----


def test_weights_close_to_one_are_put_right_with_a_note():
    data = make_tube_data()
    factor = np.ones(len(data.vertices))
    factor[:10] = 1.009
    rig = build_rig(replace(data, weights=sparse.csr_array(sparse.diags_array(factor) @ data.weights)))
    assert abs(rig.weights.sum(axis=1) - 1).max() < 1e-12
    assert any("10 weight rows" in note and "1.009" in note for note in rig.notes)


@pytest.mark.parametrize("factor", [0.989, 1.011])
def test_one_per_cent_is_the_limit(factor):
    data = make_tube_data()
    with pytest.raises(InputError, match=f"242 of 242 weight rows.*{factor}"):
        build_rig(replace(data, weights=data.weights * factor))


def test_weights_far_from_one_are_an_error_that_says_how_far_unless_asked():
    data = make_tube_data()
    factor = np.ones(len(data.vertices))
    factor[[3, 7]] = [1.02, 0.2]
    bad = replace(data, weights=sparse.csr_array(sparse.diags_array(factor) @ data.weights))
    with pytest.raises(InputError, match=r"2 of 242 weight rows.*0\.2 to 1\.02.*vertex 7 with 0\.2.*normalize"):
        build_rig(bad)
    rig = build_rig(bad, normalize_weights=True)
    np.testing.assert_allclose(rig.weights.toarray(), data.weights.toarray(), atol=1e-12)
    assert any("2 weight rows" in note for note in rig.notes)


def test_single_precision_weights_are_not_worth_a_note():
    data = make_tube_data()
    rig = build_rig(replace(data, weights=data.weights.astype(np.float32)))
    assert rig.notes == ()


# ---- joints that could only confuse a fit ----


def test_joint_without_weight_below_is_locked():
    rig = build_rig(with_joint(make_tube_data()))
    np.testing.assert_array_equal(rig.locked, [False] * 4 + [True])
    assert any("1 joint locked for moving no vertex: tip" in note for note in rig.notes)
    assert any("1 joint without weight: tip" in note for note in rig.notes)


def test_joint_that_turns_everything_is_locked_unless_a_card_limits_it():
    data = with_joint(make_tube_data(), "world", 0)
    data = replace(data, parents=np.array([4, 0, 1, 1, -1]))
    rig = build_rig(data)
    assert rig.joint_names[rig.root] == "world"
    np.testing.assert_array_equal(rig.locked, [True, False, False, False, False])
    assert any("like the root: root" in note for note in rig.notes)
    free = build_rig(data, Card(limits=(("root", (-0.1,) * 3, (0.1,) * 3),)))
    assert not free.locked.any()


# ---- the file's own regressor ----


def test_files_regressor_is_used_and_made_exact(tube_rig):
    data = make_tube_data()
    given = tube_rig.regressor.copy()
    given.data = np.round(given.data, 5)
    rig = build_rig(replace(data, regressor=given))
    assert np.abs(rig.regressor @ rig.vertices - rig.joints).max() < 1e-12
    np.testing.assert_array_equal(rig.regressor.indices, given.indices)
    assert np.abs(rig.regressor.data - given.data).max() < 1e-3
    assert rig.notes == ()


def test_files_regressor_that_misses_the_joints_is_noted(tube_rig):
    data = make_tube_data()
    joints = data.joints.copy()
    joints[1, 0] += 0.02
    rig = build_rig(replace(data, joints=joints, regressor=tube_rig.regressor))
    np.testing.assert_array_equal(rig.joints, joints)
    assert np.abs(rig.regressor @ rig.vertices - joints).max() < 1e-12
    assert any("misses the file's joints by up to 2 %" in note and "elbow" in note for note in rig.notes)


def test_empty_rows_of_the_files_regressor_are_derived(tube_rig):
    given = tube_rig.regressor.tolil()
    given[2] = 0
    rig = build_rig(replace(make_tube_data(), regressor=sparse.csr_array(given)))
    assert np.abs(rig.regressor @ rig.vertices - rig.joints).max() < 1e-12
    assert any("derived from the weights" in note and "long" in note for note in rig.notes)


# ---- describe ----


def test_describe_shows_tree_limits_states_and_notes():
    data = with_joint(make_tube_data())
    rig = build_rig(data, Card(merge=("short",)))
    text = describe(rig)
    assert "242" in text and "up +y, forward +z" in text and "0.25 m" in text
    lines = {line.split()[0]: line for line in text.splitlines() if line.strip()}
    assert "root" in lines["root"] and "-0.60..+0.60" in lines["root"]
    assert lines["elbow"].startswith("  elbow") or "  elbow" in text
    assert "merged" in lines["short"] and "locked" in lines["tip"]
    assert "moving no vertex: tip" in text
    assert "-11..+80" in describe(rig, degrees=True)
    assert "No anomalies." in describe(build_rig(make_tube_data()))


def test_describe_tells_how_a_rig_stands():
    """A hand that hangs from its wrist by one whose fingers point up."""
    data = make_tube_data()
    low, high = data.vertices[:, 1].min(), data.vertices[:, 1].max()
    below = (data.joints[0, 1] - low) / (high - low)
    for up, above in (("+y", 1 - below), ("-y", below)):
        text = describe(build_rig(replace(data, up=up)))
        assert f"stands    {above:.0%} of its height above the root joint, {1 - above:.0%} below" in text
    assert "stands" not in describe(build_rig(replace(data, up=None, forward=None)))
