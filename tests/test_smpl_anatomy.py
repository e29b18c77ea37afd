"""Models of the SMPL family get limits and natural poses from the bundled rigs: the same ones, about their own axes."""

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.io.rigs import load_rig, read_rig_data
from lbsfit_np.rig.card import Card
from lbsfit_np.rotations import matrix_from_rotvec, rotvec_from_matrix

BUNDLED = ["body-coarse", "hand-coarse", "hand-left-coarse"]


def at_zero(rig):
    """Vertices and joints of a bundled rig where SMPL's and MANO's angles are 0."""
    theta = rig.from_smpl_pose(np.zeros(rig.lower.shape))
    return rig.pose(theta), rig.pose_joints(theta)


def write(tmp_path, vertices, faces, weights, parents, joints):
    path = tmp_path / "model.npz"
    tree = np.array([np.where(np.asarray(parents) < 0, 2**32 - 1, parents), np.arange(len(parents))], dtype=np.uint32)
    np.savez(path, v_template=vertices, f=faces, weights=weights, kintree_table=tree, J=joints)
    return path


@pytest.fixture
def file_of(tmp_path):
    """Writes a bundled rig as a file of the SMPL family, its points taken through a function."""

    def make(name, moved=lambda points: points):
        rig = load_rig(name)
        vertices, joints = at_zero(rig)
        return write(tmp_path, moved(vertices), rig.faces, rig.weights.toarray(), rig.parents, moved(joints)), rig

    return make


@pytest.mark.parametrize("name", BUNDLED)
def test_natural_poses_are_those_of_the_bundled_rig(file_of, name):
    """Joints come to the same places, but for the root's turn, which is from the model's own rest."""
    path, rig = file_of(name)
    model = load_rig(path)
    assert list(model.poses) == list(rig.poses) and len(model.poses) > 40
    for pose, theta in model.poses.items():
        assert ((theta >= model.lower) & (theta <= model.upper)).all()
        given = rig.poses[pose].copy()
        wanted = rig.to_smpl_pose(given)
        np.testing.assert_allclose(theta[1:], wanted[1:], atol=1e-12)
        at_rest = given.copy()
        at_rest[rig.root] = 0.0
        turn = matrix_from_rotvec(rotvec_from_matrix(rig.smpl_rest[0]))
        still = theta.copy()
        still[model.root] = 0.0
        theirs, ours = model.pose_joints(still), rig.pose_joints(at_rest)
        np.testing.assert_allclose(theirs - theirs[0], (ours - ours[0]) @ turn.T, atol=1e-6)


@pytest.mark.parametrize("name", BUNDLED)
def test_limits_hold_every_pose_of_the_bundled_rig(file_of, name):
    """But for shoulders, whose rest poses differ too much for a box; there they hold most."""
    path, rig = file_of(name)
    model, rng = load_rig(path), np.random.default_rng(0)
    theta = rng.uniform(rig.lower, rig.upper, (300, *rig.lower.shape))
    theta[:, rig.root] = 0.0
    angles = np.array([rig.to_smpl_pose(t) for t in theta])[:, 1:]
    within = ((angles >= model.lower[1:]) & (angles <= model.upper[1:])).all(axis=2)
    shoulders = np.array(["shoulder" in joint for joint in model.joint_names[1:]])
    assert within[:, ~shoulders].all()
    assert within[:, shoulders].mean() > 0.4 if shoulders.any() else True
    assert ((model.lower <= 0) & (model.upper >= 0)).all()
    assert np.prod(model.upper[1:] - model.lower[1:], axis=1).mean() < np.prod([1.6, 1.6, 1.6])


def test_knees_and_elbows_bend_one_way(file_of):
    body = load_rig(file_of("body-coarse")[0])
    limits = {name: (body.lower[j], body.upper[j]) for j, name in enumerate(body.joint_names)}
    low, high = limits["left_knee"]
    assert low[0] > -0.2 and high[0] > 2.2 and (np.abs([low[1:], high[1:]]) < 0.25).all()
    (low, high), (right_low, right_high) = limits["left_elbow"], limits["right_elbow"]
    assert low[1] < -2.4 and high[1] < 0.3
    np.testing.assert_allclose(right_high[1], -low[1], atol=0.02)  # the mirror image
    np.testing.assert_allclose(right_low[1], -high[1], atol=0.02)


@pytest.mark.parametrize(("name", "up", "forward"), [("hand-coarse", "-x", "-y"), ("hand-left-coarse", "+x", "-y")])
def test_axes_of_hands_are_told_by_their_joints(file_of, name, up, forward):
    """Fingers towards −x, or +x of the left hand, palm down: the bundled hand has its fingers up and its palm in front."""
    path, _ = file_of(name)
    hand = load_rig(path)
    assert (hand.up, hand.forward) == (up, forward)
    assert any(f"those of the bundled {'left ' * ('left' in name)}hand" in note for note in hand.notes)


def with_fingers(tmp_path, n_joints, moved=lambda fingers: fingers, of="left"):
    """A file of SMPL-H, or SMPL-X with its face, the fingers of whose one hand are taken through a function."""
    body, hands = load_rig("body-coarse"), {"left": load_rig("hand-left-coarse"), "right": load_rig("hand-coarse")}
    _, joints = at_zero(body)
    places, parents, names = list(joints[:22]), list(body.parents[:22]), list(body.joint_names[:22])
    if n_joints == 55:
        names += ["jaw", "left_eye", "right_eye"]
        parents += [names.index("head")] * 3
        places += [places[names.index("head")] + step for step in ([0, 0, 0.05], [0.03, 0.05, 0.08], [-0.03, 0.05, 0.08])]
    for side in ("left", "right"):
        _, fingers = at_zero(hands[side])
        fingers = moved(fingers) if side == of else fingers
        wrist, first = names.index(f"{side}_wrist"), len(names) - 1
        places += list(fingers[1:] - fingers[0] + joints[wrist])
        parents += [wrist if p == 0 else first + p for p in hands[side].parents[1:]]
        names += [f"{side}_{name}" for name in hands[side].joint_names[1:]]
    rng = np.random.default_rng(0)
    weights, faces = rng.random((60, n_joints)), rng.integers(0, 60, (100, 3))
    return write(tmp_path, rng.normal(size=(60, 3)), faces, weights, parents, np.array(places)), names


@pytest.mark.parametrize("n_joints", [52, 55])
def test_bodies_with_fingers_have_the_limits_of_both(tmp_path, n_joints):
    path, names = with_fingers(tmp_path, n_joints)
    data, body = read_rig_data(path), load_rig("body-coarse")
    assert data.joint_names == names and "those of the bundled body and hands" in data.notes[0]
    for side, hand in (("left", "hand-left-coarse"), ("right", "hand-coarse")):
        own = load_rig(write(tmp_path, *_arrays(load_rig(hand))))
        fingers = slice(names.index(f"{side}_index1"), names.index(f"{side}_index1") + 15)
        np.testing.assert_array_equal(data.lower[fingers], own.lower[1:])
        np.testing.assert_array_equal(data.upper[fingers], own.upper[1:])
    np.testing.assert_array_equal(data.poses["walking"][22:], 0.0)
    np.testing.assert_allclose(data.poses["walking"][1:22], body.to_smpl_pose(body.poses["walking"])[1:22], atol=1e-12)
    if n_joints == 55:
        assert data.upper[names.index("jaw"), 0] == 0.5 and data.lower[names.index("left_eye"), 1] == -0.4


@pytest.mark.parametrize("side", ["left", "right"])
def test_fingers_that_lie_otherwise_get_plain_limits(tmp_path, side):
    path, _ = with_fingers(tmp_path, 52, lambda fingers: fingers[:, [2, 1, 0]], side)
    assert read_rig_data(path).lower is None


def _arrays(rig):
    vertices, joints = at_zero(rig)
    return vertices, rig.faces, rig.weights.toarray(), rig.parents, joints


@pytest.mark.parametrize(
    ("name", "moved"),
    [
        ("body-coarse", lambda points: points[:, [2, 0, 1]]),  # z up
        ("body-coarse", lambda points: points * [1, 1, -1]),  # its feet point back, as would its knees
        ("hand-coarse", lambda points: points * [1, 1, -1]),  # the other hand, lying otherwise
    ],
)
def test_models_that_lie_otherwise_get_plain_limits_with_a_note(file_of, name, moved):
    model = load_rig(file_of(name, moved)[0])
    assert not model.poses and any("neither file nor card has limits" in note for note in model.notes)


@pytest.mark.parametrize(
    ("name", "joints", "turn", "known"),
    [
        ("body-coarse", ["left_shoulder"], (0, 0, -0.2), True),
        ("body-coarse", ["left_shoulder"], (0, 0, -0.6), False),  # towards the A-pose
        ("body-coarse", ["left_elbow", "right_elbow"], (0, 0.8, 0), False),
        ("body-coarse", ["right_knee"], (0.7, 0, 0), False),
        ("body-coarse", ["left_collar", "left_shoulder"], ((0, 0, 0.6), (0, 0, -0.6)), True),  # models put these elsewhere
        ("hand-coarse", ["wrist"], (0.3, 0, 0), True),
        ("hand-coarse", ["wrist"], (0.7, 0, 0), False),  # about the fingers
        ("hand-coarse", ["index1", "middle1", "ring1", "pinky1"], (0, 0, 0.3), True),
        ("hand-coarse", ["index1", "middle1", "ring1", "pinky1"], (0, 0, 0.6), False),
    ],
)
def test_other_rest_poses_get_plain_limits(tmp_path, name, joints, turn, known):
    """What is in about T-pose, or flat, is as good as that."""
    rig = load_rig(name)
    pose = np.zeros(rig.lower.shape)
    pose[[rig.joint_names.index(joint) for joint in joints]] = turn
    theta = rig.from_smpl_pose(pose)
    path = write(tmp_path, rig.pose(theta), rig.faces, rig.weights.toarray(), rig.parents, rig.pose_joints(theta))
    assert bool(load_rig(path).poses) == known


def test_limits_of_a_card_win(file_of):
    path, _ = file_of("body-coarse")
    model, plain = load_rig(path, card=Card(limits=(("left_knee", (0, 0, 0), (1, 0, 0)),))), load_rig(path)
    knee = model.joint_names.index("left_knee")
    np.testing.assert_array_equal(model.upper[knee], [1, 0, 0])
    others = np.arange(24) != knee
    np.testing.assert_array_equal(model.lower[others], plain.lower[others])


def test_smpl_pose_of_a_model_is_its_own(file_of):
    model = load_rig(file_of("body-coarse")[0])
    theta = model.poses["walking"]
    np.testing.assert_allclose(model.to_smpl_pose(theta), theta, atol=1e-12)
    assert isinstance(model, lbs.Rig)


def test_files_in_the_working_folder_are_no_bundled_rigs(file_of, tmp_path, monkeypatch):
    path, _ = file_of("body-coarse")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "body-coarse").touch()
    assert load_rig(path).poses
