"""build_rig: what it accepts, derives, notes and refuses."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import NAMES, make_tube_data

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.describe import describe
from lbsfit_np.rig.frames import bone_frames
from lbsfit_np.rig.limits import derived_limits
from lbsfit_np.rotations import matrix_from_rotvec


def with_joint(data, name="tip", parent=2, **changes):
    """The data with one more joint, which carries no weight."""
    m = len(data.vertices)
    return replace(
        data,
        joint_names=[*data.joint_names, name],
        parents=np.append(data.parents, parent),
        joints=np.vstack([data.joints, data.joints[parent] + [0.0, 0.1, 0.0]]),
        frames=np.concatenate([data.frames, np.eye(3)[None]]),
        weights=sparse.csr_array(sparse.hstack([data.weights, sparse.csr_array((m, 1))])),
        lower=np.vstack([data.lower, np.full((1, 3), -1.0)]),
        upper=np.vstack([data.upper, np.full((1, 3), 1.0)]),
        **changes,
    )


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


# ---- bad input: one clear error each ----


def broken(**changes):
    def make(data):
        return replace(
            data, **{key: change(getattr(data, key)) if callable(change) else change for key, change in changes.items()}
        )

    return make


def put(index, value):
    def change(array):
        array = array.toarray() if sparse.issparse(array) else np.array(array)
        array[index] = value
        return array

    return change


BAD = {
    "vertices of a wrong shape": (broken(vertices=np.zeros((5, 2))), r"vertices.*\(5, 2\).*\(any, 3\)"),
    "vertices that are text": (broken(vertices=np.array([["a", "b", "c"]])), "vertices.*array of numbers"),
    "ragged vertices": (broken(vertices=[[1, 2, 3], [1, 2]]), "vertices.*array of numbers"),
    "infinite vertices": (broken(vertices=put((4, 1), np.inf)), r"vertices.*1 values.*NaN or infinite.*\[4, 1\]"),
    "all vertices at one point": (broken(vertices=lambda v: v * 0 + 1), "all at one point"),
    "no faces": (broken(faces=np.zeros((0, 3), dtype=int)), "no faces.*triangle"),
    "degenerate faces only": (broken(faces=np.array([[1, 1, 2], [3, 4, 3]])), "2 faces, each with two corners at one point"),
    "quads": (broken(faces=np.zeros((4, 4), dtype=int)), r"faces.*\(4, 4\)"),
    "faces of floats": (broken(faces=np.zeros((4, 3))), "faces.*float64.*integers"),
    "faces out of range": (broken(faces=put((2, 1), 242)), r"1 faces out of range.*face 2.*0 to 241"),
    "negative faces": (broken(faces=put((0, 0), -1)), "out of range.*face 0"),
    "weights of a wrong shape": (broken(weights=np.ones((242, 3))), r"weights.*\(242, 3\).*\(242, 4\)"),
    "weights that are NaN": (broken(weights=put((5, 0), np.nan)), r"weights.*1 values.*\[5, 0\]"),
    "sparse weights that are NaN": (
        broken(weights=lambda w: sparse.csr_array(put((5, 0), np.nan)(w))),
        "weights.*1 values.*row 5",
    ),
    "negative weights": (
        broken(weights=put(([3, 8], [1, 0]), [-0.25, -0.5])),
        r"2 negative weights.*-0.5 \(vertex 8, joint 'root'\)",
    ),
    "vertices without weight": (broken(weights=put(([6, 9],), 0.0)), "2 of 242 vertices without any weight.*vertex 6"),
    "no joints": (broken(joint_names=[]), "joint_names.*no joints"),
    "names twice": (broken(joint_names=["root", "elbow", "long", "long"]), "more than once: 'long'"),
    "empty name": (broken(joint_names=["root", "", "long", "short"]), "empty"),
    "too few parents": (broken(parents=np.array([-1, 0])), r"parents.*\(2,\).*\(4,\)"),
    "parent out of range": (broken(parents=np.array([-1, 0, 1, 4])), "parent 4 of joint 'short', out of range"),
    "parent below -1": (broken(parents=np.array([-2, 0, 1, 1])), "parent -2 of joint 'root'"),
    "cycle": (broken(parents=np.array([-1, 2, 3, 1])), "cycle.*elbow → long → short → elbow"),
    "own parent": (broken(parents=np.array([-1, 1, 1, 1])), "cycle.*elbow → elbow"),
    "two roots": (
        broken(parents=np.array([-1, 0, 1, -1])),
        r"2 root joints: root, short.*one root.*lbsfit rig card.*\[hierarchy\]",
    ),
    "joints that are NaN": (broken(joints=put((1, 1), np.nan)), "joints.*NaN"),
    "joints of a wrong shape": (broken(joints=np.zeros((3, 3))), r"joints.*\(3, 3\).*\(4, 3\)"),
    "stretched frames": (broken(frames=lambda f: f * 1.1), "frames.*'root'.*not orthonormal"),
    "left-handed frames": (broken(frames=lambda f: f * np.array([1, 1, -1.0])), "left-handed.*'root'"),
    "limits reversed": (broken(lower=put((2, 1), 0.9)), r"limits of joint 'long' reversed about y: lower 0\.9, upper 0\.2"),
    "only lower limits": (broken(upper=None), "only one of lower and upper"),
    "limits that are NaN": (broken(lower=put((0, 0), np.nan)), "lower.*NaN"),
    "regressor of a wrong shape": (broken(regressor=sparse.csr_array((4, 5))), r"regressor.*\(4, 5\).*\(4, 242\)"),
    "unknown up": (broken(up="y"), r"up: got 'y'; expected one of \+x"),
    "forward along up": (broken(forward="-y"), "forward.*along the up axis"),
    "negative unit": (broken(metres_per_unit=-1.0), "metres_per_unit.*-1.0.*positive"),
    "partition of strangers": (broken(partitions={"p": {"a": ("root", "leg")}}), "'leg', which is no joint"),
    "animation of a wrong shape": (broken(lower=None, upper=None, animated=np.zeros((5, 3, 3))), r"animated.*\(5, 3, 3\)"),
    "locked that are no booleans": (broken(locked=np.zeros(4)), "locked.*true or false"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case):
    breaks, words = BAD[case]
    with pytest.raises(InputError, match=words) as error:
        build_rig(breaks(make_tube_data()))
    assert not isinstance(error.value, FileError)


def test_errors_name_the_file(tmp_path):
    data = replace(make_tube_data(), faces=np.array([[0, 1, 999]]), path=tmp_path / "arm.glb")
    with pytest.raises(FileError, match=r"arm\.glb: got faces: 1 faces out of range"):
        build_rig(data)


def test_card_must_be_a_card():
    with pytest.raises(InputError, match="card.*int.*Card, or the path"):
        build_rig(make_tube_data(), 3)


# ---- the card applied ----


def test_card_gives_a_hierarchy_to_loose_joints():
    loose = replace(make_tube_data(), parents=np.full(4, -1))
    card = Card(root="root", chains=(("root", "elbow", "long"), ("elbow", "short")))
    np.testing.assert_array_equal(build_rig(loose, card).parents, [-1, 0, 1, 1])
    by_table = Card(parents=(("elbow", "root"), ("*", "elbow")), root="root")  # the glob matches its own parent, too
    np.testing.assert_array_equal(build_rig(loose, by_table).parents, [-1, 0, 1, 1])


def test_card_can_change_the_root():
    card = Card(root="elbow", parents=(("root", "elbow"),))
    rig = build_rig(make_tube_data(), card)
    assert rig.joint_names[rig.root] == "elbow"
    assert (rig.pose(np.zeros((4, 3))) == rig.vertices).all()


@pytest.mark.parametrize(
    ("card", "words"),
    [
        (Card(chains=(("root", "elbow"),)), r"3 root joints: root, long, short.*card's \[hierarchy\]"),
        (Card(chains=(("root", "elbow"), ("long", "elbow"))), r"\[hierarchy\].*two parents for joint 'elbow': 'root' and 'long'"),
        (Card(root="elbow", chains=(("root", "elbow"),)), "the root 'elbow' hanging on 'root'"),
        (Card(chains=(("root", "elbw"),)), r"\[hierarchy\].*'elbw'.*no joint.*Did you mean 'elbow'"),
        (Card(chains=(("root", "elbow", "long", "root"),)), "cycle"),
        (Card(chains=(("root", "*o*"),)), "matches 4 joints.*one joint"),
        (Card(parents=(("short", "*o*"),)), r"\[hierarchy\]: got '\*o\*', which matches 4 joints.*one joint"),
    ],
)
def test_card_hierarchy_errors(card, words):
    with pytest.raises(InputError, match=words):
        build_rig(replace(make_tube_data(), parents=np.full(4, -1)), card)


def test_merging_moves_weights_up_and_keeps_the_rest_shape(tube_rig):
    data = make_tube_data()
    rig = build_rig(data, Card(merge=("long", "elbow")))
    w = data.weights.toarray()
    np.testing.assert_allclose(
        rig.weights.toarray(), np.stack([w[:, 0] + w[:, 1] + w[:, 2], 0 * w[:, 1], 0 * w[:, 2], w[:, 3]], axis=1)
    )
    assert rig.joint_names == NAMES
    np.testing.assert_array_equal(rig.merged, [False, True, True, False])
    np.testing.assert_array_equal(rig.moving, [True, False, False, True])
    assert (rig.lower[1:3] == 0).all() and (rig.upper[1:3] == 0).all()
    assert (rig.pose(np.zeros((4, 3))) == rig.vertices).all()
    assert rig.parts == ("root", "short")
    assert any("2 joints merged" in note and "elbow, long" in note for note in rig.notes)
    # a merged joint moves as if it were stiff
    theta = np.zeros((4, 3))
    theta[[0, 3]] = [[0.3, 0.2, -0.5], [0.7, 0.1, 0.0]]
    np.testing.assert_allclose(rig.pose(theta), tube_rig.pose(theta), atol=1e-12)


def test_locked_joints_keep_their_skin_and_never_turn():
    rig = build_rig(make_tube_data(), Card(lock=("sh?rt",)))
    np.testing.assert_array_equal(rig.locked, [False, False, False, True])
    np.testing.assert_array_equal(rig.weights.toarray(), make_tube_data().weights.toarray())
    assert (rig.lower[3] == 0).all()
    assert rig.parts == ("root", "elbow", "long")
    assert any("1 joints locked: short" in note for note in rig.notes)
    both = build_rig(make_tube_data(), Card(lock=("short", "long"), merge=("short",)))
    assert both.locked.tolist() == [False, False, True, False] and both.merged.tolist() == [False, False, False, True]


@pytest.mark.parametrize("field", ["merge", "lock"])
def test_root_cannot_be_merged_or_locked(field):
    with pytest.raises(InputError, match="root joint 'root'"):
        build_rig(make_tube_data(), Card(**{field: ("*",)}))


@pytest.mark.parametrize("field", ["merge", "lock", "limits", "frames"])
def test_card_names_a_joint_that_is_not_there(field):
    value = {
        "merge": ("elbwo",),
        "lock": ("elbwo",),
        "limits": (("elbwo", (0, 0, 0), (1, 1, 1)),),
        "frames": (("elbwo", "rig"),),
    }[field]
    with pytest.raises(InputError, match=rf"\[{field}\].*'elbwo', which is no joint.*Did you mean 'elbow'"):
        build_rig(make_tube_data(), Card(**{field: value}))


def test_later_limits_override_earlier_ones():
    card = Card(limits=(("*", (-1, -1, -1), (1, 1, 1)), ("long", (-2, 0, 0), (0.5, 0, 0))))
    rig = build_rig(replace(make_tube_data(), lower=None, upper=None), card)
    np.testing.assert_array_equal(rig.lower[2], [-2, 0, 0])
    np.testing.assert_array_equal(rig.upper[1], [1, 1, 1])
    assert not any("limits" in note for note in rig.notes)


def test_card_partition_expands_globs():
    card = Card(partitions={"tips": {"hand": ("*o*w", "root"), "tips": ("long", "sh*")}}, use_parts="tips")
    rig = build_rig(make_tube_data(), card)
    assert rig.parts == ("hand", "tips")
    assert rig.partitions["tips"] == {"hand": ("root", "elbow"), "tips": ("long", "short")}
    twice = Card(partitions={"p": {"a": ("*",), "b": ("long",)}})
    with pytest.raises(InputError, match="'long' in both 'a' and 'b'"):
        build_rig(make_tube_data(), twice)
    with pytest.raises(InputError, match="use_parts.*'nails'"):
        build_rig(make_tube_data(), Card(use_parts="nails"))


def test_unit_and_axes_of_the_card_win_and_unknown_ones_are_noted():
    rig = build_rig(make_tube_data(), Card(metres_per_unit=0.01, up="+z", forward="-y"))
    assert (rig.metres_per_unit, rig.up, rig.forward) == (0.01, "+z", "-y")
    assert any("0.00985 m long" in note for note in rig.notes)
    unknown = build_rig(replace(make_tube_data(), metres_per_unit=None, up=None))
    assert any("unknown: unit, up axis" in note for note in unknown.notes)


# ---- frames ----


def test_rounded_frames_become_rotations():
    turn = matrix_from_rotvec(np.array([0.3, -0.2, 0.9])).astype(np.float32).astype(float)
    rig = build_rig(replace(make_tube_data(), frames=np.tile(turn, (4, 1, 1))))
    np.testing.assert_allclose(rig.frames[0].T @ rig.frames[0], np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rig.frames[0], turn, atol=1e-6)


def test_card_frames_follow_bones():
    rig = build_rig(make_tube_data(), Card(frames=(("*", "bone"), ("root", "rig"))))
    np.testing.assert_array_equal(rig.frames[0], np.eye(3))
    to_knuckles = rig.joints[[2, 3]].mean(axis=0) - rig.joints[1]
    np.testing.assert_allclose(rig.frames[1, :, 1], to_knuckles / np.linalg.norm(to_knuckles), atol=1e-12)
    assert rig.frames[1, 2, 2] > 0.9  # z towards the front
    np.testing.assert_allclose(np.linalg.det(rig.frames), 1.0)
    with pytest.raises(InputError, match="'bone'.*no up and forward"):
        build_rig(replace(make_tube_data(), forward=None), Card(frames=(("*", "bone"),)))


def test_bone_frames_point_up_for_feet_and_mirror_left_and_right():
    foot, left, right = bone_frames([[0.1, -0.3, 1.2], [0.7, -0.7, 0.2], [-0.7, -0.7, 0.2]], "+y", "+z")
    assert foot[1, 2] > 0.9  # z up
    mirror = np.diag([-1.0, 1.0, 1.0])
    for angles in np.eye(3):
        there = matrix_from_rotvec(left @ angles)
        here = matrix_from_rotvec(right @ (angles * [1, -1, -1]))
        np.testing.assert_allclose(mirror @ there @ mirror, here, atol=1e-12)
    turned = bone_frames([[0.1, 1.2, 0.3]], "+z", "+y")[0]  # z up, facing y: a bone that points forward
    assert turned[2, 2] > 0.9


def test_changed_frames_carry_animations_over_and_drop_the_files_limits():
    data = make_tube_data()
    wide = np.zeros((3, 4, 3))
    wide[1, 1] = [0.5, 0.0, 0.0]
    turn = matrix_from_rotvec(np.array([0.0, 0.0, np.pi / 2]))
    turned = replace(data, lower=None, upper=None, animated=wide, frames=np.tile(turn, (4, 1, 1)))
    rig = build_rig(turned, Card(frames=(("*", "rig"),)))
    # about the file's x axis, which is the rig's y
    np.testing.assert_allclose(rig.upper[1], [0.1, 0.625, 0.1], atol=1e-12)
    limited = build_rig(replace(data, frames=np.tile(turn, (4, 1, 1))), Card(frames=(("long", "rig"),)))
    np.testing.assert_array_equal(limited.upper[2], [0.8, 0.8, 0.8])
    np.testing.assert_array_equal(limited.upper[3], data.upper[3])
    assert any("1 of 4 moving joints" in note for note in limited.notes)


# ---- limits that are missing ----


def test_missing_limits_get_defaults_and_a_note():
    rig = build_rig(replace(make_tube_data(), lower=None, upper=None))
    np.testing.assert_array_equal(rig.upper[1:], 0.8)
    np.testing.assert_array_equal(rig.lower[0], -0.6)
    assert any("4 of 4 moving joints" in note and "±0.8" in note and "±0.6" in note for note in rig.notes)


def test_limits_from_animations():
    animated = np.zeros((5, 3, 3))
    animated[:, 1, 0] = [0.2, 0.4, 1.0, 0.6, 0.2]
    animated[:, 2, 2] = [-3.0, 0, 0, 0, 0]
    animated[:, 0, 1] = [0, 1, 2, 3, 3]  # the root walks in a circle: no matter
    lower, upper, seen = derived_limits(0, 3, animated)
    np.testing.assert_array_equal(seen, [False, True, True])
    np.testing.assert_allclose(upper[1], [1.0 + 0.25 * 0.8, 0.1, 0.1])
    np.testing.assert_allclose(lower[1], [0.0, -0.1, -0.1])  # 0.2 - 0.2 would be 0 as well: the rest pose is inside
    np.testing.assert_allclose(lower[2], [-0.1, -0.1, -np.pi])
    np.testing.assert_array_equal(upper[0], 0.6)
    animated[:, 1] = [0.4, 0.0, 0.0]  # turned, but the same in all frames
    assert not derived_limits(0, 3, animated)[2][1]
    np.testing.assert_array_equal(derived_limits(0, 3, animated)[1][1], 0.8)


def test_rest_pose_stays_inside_limits_from_animations():
    animated = np.zeros((2, 2, 3))
    animated[:, 1, 0] = [1.0, 1.2]
    lower, upper, _ = derived_limits(0, 2, animated)
    assert lower[1, 0] == 0.0 and upper[1, 0] == pytest.approx(1.3)


# ---- joints that could only confuse a fit ----


def test_joint_without_weight_below_is_locked():
    rig = build_rig(with_joint(make_tube_data()))
    np.testing.assert_array_equal(rig.locked, [False] * 4 + [True])
    assert any("move no vertex: tip" in note for note in rig.notes)
    assert any("carry no weight: tip" in note for note in rig.notes)


def test_joint_that_turns_everything_is_locked_unless_a_card_limits_it():
    data = with_joint(make_tube_data(), "world", 0)
    data = replace(data, parents=np.array([4, 0, 1, 1, -1]))
    rig = build_rig(data)
    assert rig.joint_names[rig.root] == "world"
    np.testing.assert_array_equal(rig.locked, [True, False, False, False, False])
    assert any("like the root: root" in note for note in rig.notes)
    free = build_rig(data, Card(limits=(("root", (-0.1,) * 3, (0.1,) * 3),)))
    assert not free.locked.any()


# ---- anomalies ----


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


def test_turned_faces_are_noted():
    data = make_tube_data()
    assert any("inside out" in note for note in build_rig(replace(data, faces=data.faces[:, ::-1])).notes)
    some = data.faces.copy()
    some[0] = some[0, ::-1]
    assert any("turned opposite ways at 3 edges" in note for note in build_rig(replace(data, faces=some)).notes)


def test_non_manifold_and_degenerate_faces_are_noted():
    data = make_tube_data()
    a, b, _ = data.faces[0]
    fin = next(int(v) for v in data.faces[-1] if v not in data.faces[0])
    more = replace(data, faces=np.vstack([data.faces, [[a, b, fin], [a, a, b]]]))
    notes = "\n".join(build_rig(more).notes)
    assert "not manifold: 1 edges" in notes
    assert "1 faces are degenerate" in notes


def test_many_influences_are_noted():
    rng = np.random.default_rng(0)
    data = with_joint(make_tube_data(), "fifth", 1)
    w = rng.random((242, 5))
    notes = "\n".join(build_rig(replace(data, weights=w / w.sum(axis=1, keepdims=True))).notes)
    assert "up to 5 joints share a vertex (242 vertices" in notes


# ---- welding ----


def seamed(data, copies, weight_change=0.0):
    """The data with some vertices split: later faces use the copies."""
    m = len(data.vertices)
    faces = data.faces.copy()
    for k, v in enumerate(copies):
        f, c = np.argwhere(faces == v)[-1]
        faces[f, c] = m + k
    w = data.weights.toarray()
    w_copies = w[copies]
    w_copies[:, :2] += [weight_change, -weight_change]
    return replace(
        data, vertices=np.vstack([data.vertices, data.vertices[copies]]), faces=faces, weights=np.vstack([w, w_copies])
    )


def test_seams_are_welded_for_the_geometry_only(tube_rig):
    rig = build_rig(seamed(make_tube_data(), [5, 60, 200]))
    assert len(rig.vertices) == 245 and len(rig.welded.vertices) == 242
    np.testing.assert_array_equal(rig.weld, [*range(242), 5, 60, 200])
    np.testing.assert_array_equal(rig.welded.vertices[rig.weld], rig.vertices)
    np.testing.assert_array_equal(rig.welded.faces, tube_rig.faces)
    np.testing.assert_allclose(rig.welded.regressor @ rig.welded.vertices, rig.joints, atol=1e-12)
    assert any("245 vertices are 242 distinct" in note for note in rig.notes)
    assert not any("open" in note for note in rig.notes)


def test_sheets_that_touch_but_move_apart_are_not_welded():
    data = seamed(make_tube_data(), [5])
    w = data.weights.copy()
    w[-1] = [0, 0, 0, 1]
    rig = build_rig(replace(data, weights=w))
    assert len(rig.welded.vertices) == 243


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
    assert "move no vertex: tip" in text
    assert "-11..+80" in describe(rig, degrees=True)
    assert "No anomalies." in describe(build_rig(make_tube_data()))


def test_smallest_rig():
    data = RigData(
        name="one", vertices=np.eye(3), faces=np.array([[0, 1, 2]]), weights=np.ones((3, 1)), joint_names=["only"],
        parents=np.array([-1]), joints=np.zeros((1, 3)), frames=np.eye(3)[None],
    )  # fmt: skip
    rig = build_rig(data)
    assert rig.parts == ("only",) and (rig.pose(np.zeros((1, 3))) == np.eye(3)).all()
    assert any("open" in note for note in rig.notes)
    assert "only" in describe(rig)
