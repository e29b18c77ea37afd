"""Natural poses for a rig: Θ from global rotations, hand poses and motion capture."""

import logging

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial.transform import Rotation

from lbsfit_np.bench.retarget import bvh_thetas, handpose_theta, limit_excess, theta_from_globals, theta_residual
from lbsfit_np.errors import InputError
from lbsfit_np.io.bvh import Motion, read_bvh
from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.io.handpose import WEBXR_JOINTS, read_handpose
from lbsfit_np.rig.rig import Rig
from lbsfit_np.skinning import skin


def bare_rig(names, parents, joints, *, frames=None, locked=(), limit=3.0, **more):
    """A skeleton with one vertex at each joint."""
    J = len(names)
    lower, upper = np.full((J, 3), -limit), np.full((J, 3), limit)
    mask = np.isin(names, locked)
    lower[mask] = upper[mask] = 0.0
    return Rig(
        name="bare",
        vertices=np.array(joints, dtype=float),
        faces=np.empty((0, 3), dtype=int),
        weights=sparse.csr_array(np.eye(J)),
        parents=np.array(parents),
        joint_names=tuple(names),
        joints=np.array(joints, dtype=float),
        frames=np.tile(np.eye(3), (J, 1, 1)) if frames is None else frames,
        lower=lower,
        upper=upper,
        regressor=sparse.csr_array(np.eye(J)),
        merged=np.zeros(J, dtype=bool),
        locked=mask,
        **more,
    )


def random_frames(n, seed=0):
    return Rotation.random(n, random_state=seed).as_matrix()


# ---- from global rotations ----

# children before parents, as real files have them
TREE = {"tip": 1, "low": 3, "side": 3, "mid": 4, "root": -1}


def tree_rig(**more):
    joints = np.random.default_rng(1).normal(size=(5, 3))
    return bare_rig(list(TREE), list(TREE.values()), joints, frames=random_frames(5), **more)


def test_theta_is_recovered_from_its_own_globals():
    rig = tree_rig()
    theta = np.random.default_rng(2).uniform(-1.5, 1.5, (5, 3))
    A = skin(rig, theta).A
    np.testing.assert_allclose(theta_from_globals(rig, A), theta, atol=1e-12)
    np.testing.assert_allclose(theta_residual(rig, theta, A), 0, atol=1e-7)
    np.testing.assert_allclose(theta_from_globals(rig, np.stack([A, A]))[1], theta, atol=1e-12)


def test_joints_that_cannot_move_take_their_parents_rotation():
    rig = tree_rig(locked=["mid"])
    wanted = random_frames(5, seed=3)
    theta = theta_from_globals(rig, wanted)
    assert not theta[3].any()
    A = skin(rig, theta).A
    np.testing.assert_allclose(A[3], wanted[4], atol=1e-12)
    np.testing.assert_allclose(A[[0, 1, 2, 4]], wanted[[0, 1, 2, 4]], atol=1e-12)
    lost = theta_residual(rig, theta, wanted)
    assert lost[3] == pytest.approx(Rotation.from_matrix(wanted[4].T @ wanted[3]).magnitude())
    np.testing.assert_allclose(lost[[0, 1, 2, 4]], 0, atol=1e-7)


def test_limit_excess_has_a_sign_and_spares_the_root():
    rig = tree_rig(limit=1.0)
    theta = np.zeros((2, 5, 3))
    theta[0, 0] = [1.5, -1.25, 0.5]
    theta[1, 4] = 2.0
    want = np.zeros_like(theta)
    want[0, 0] = [0.5, -0.25, 0]
    np.testing.assert_allclose(limit_excess(rig, theta), want)


# ---- hand poses ----

METACARPAL = [name.endswith("metacarpal") for name in WEBXR_JOINTS]
HAND_PARENTS = [-1] + [0 if METACARPAL[k] else k - 1 for k in range(1, 25)]


def test_hand_pose_is_recovered_whatever_the_proportions():
    order = np.random.default_rng(4).permutation(25)
    place = np.argsort(order)
    parents = [-1 if HAND_PARENTS[k] < 0 else place[HAND_PARENTS[k]] for k in order]
    joints = np.random.default_rng(5).normal(size=(25, 3))
    rig = bare_rig([WEBXR_JOINTS[k] for k in order], parents, joints, frames=random_frames(25, seed=6))
    theta = np.random.default_rng(7).uniform(-1, 1, (25, 3))
    theta[rig.root] = 0
    A, F = skin(rig, theta).A, rig.frames
    T = np.tile(np.eye(4), (25, 1, 1))
    T[:, :3, :3] = (F[rig.root].T @ A @ F)[place]
    T[:, :3, 3] = np.random.default_rng(8).normal(size=(25, 3))  # another hand's proportions
    np.testing.assert_allclose(handpose_theta(rig, T), theta, atol=1e-12)


def test_angles_outside_the_limits_are_kept_and_reported(caplog):
    rig = bare_rig(WEBXR_JOINTS, HAND_PARENTS, np.random.default_rng(0).normal(size=(25, 3)), limit=0.2)
    T = np.tile(np.eye(4), (25, 1, 1))
    T[8:10, :3, :3] = Rotation.from_rotvec([-0.5, 0, 0]).as_matrix()  # the index finger's last phalanx and tip
    with caplog.at_level(logging.INFO):
        theta = handpose_theta(rig, T)
    np.testing.assert_allclose(theta[8], [-0.5, 0, 0])
    assert "1 joints outside the limits, most index-finger-phalanx-distal about x by 0.30 rad" in caplog.text


def test_rig_without_the_hands_joints():
    rig = tree_rig()
    with pytest.raises(InputError, match="no joint wrist"):
        handpose_theta(rig, np.tile(np.eye(4), (25, 1, 1)))


@pytest.fixture
def webxr_hand(shared_rigs):
    data = read_gltf(shared_rigs / "webxr_hand" / "left.glb")
    row = {name: j for j, name in enumerate(data.joint_names)}
    parents = np.full(25, -1)
    for k in range(1, 25):
        parents[row[WEBXR_JOINTS[k]]] = row[WEBXR_JOINTS[HAND_PARENTS[k]]]
    tips = [n for n in row if n.endswith("tip") or (n.endswith("metacarpal") and n != "thumb-metacarpal")]
    return bare_rig(data.joint_names, parents, data.joints, frames=data.frames, locked=tips)


def test_frames_of_the_real_hand_and_its_poses_agree(webxr_hand, shared_rigs):
    """x is flexion in both: a finger that bends turns about x and hardly about y and z, and the open hand is near the rest."""
    rig = webxr_hand
    row = {name: j for j, name in enumerate(rig.joint_names)}
    middle = [row[f"{f}-finger-phalanx-intermediate"] for f in ("index", "middle", "ring", "pinky")]
    tips = [row[f"{f}-finger-tip"] for f in ("index", "middle", "ring", "pinky")]
    poses = {p.stem: handpose_theta(rig, read_handpose(p)) for p in (shared_rigs / "hand_poses").glob("*.handpose")}
    assert np.abs(poses["relax"]).max() < 0.15 and np.abs(poses["flat"]).max() < 0.75
    assert np.all(poses["fist"][middle, 0] < -1.5)
    for theta in poses.values():
        assert np.abs(theta[middle][:, 1:]).max() < 0.1
    reach = {name: np.linalg.norm(rig.pose_joints(theta)[tips] - rig.joints[rig.root], axis=1) for name, theta in poses.items()}
    rest = np.linalg.norm(rig.joints[tips] - rig.joints[rig.root], axis=1)
    assert np.all(reach["flat"] > 0.95 * rest) and np.all(reach["fist"] < 0.7 * rest)
    assert list(reach["horns"] < 0.75 * rest) == [False, True, True, False]
    assert list(reach["point"] < 0.75 * rest) == [False, True, True, True]


# ---- motion capture ----

BODY = {
    "Hips": (-1, [0, 1, 0]),
    "Spine": (0, [0, 0.3, 0.02]),
    "LeftArm": (1, [0.2, 0.2, 0]),
    "LeftForeArm": (2, [0.3, 0, 0]),
    "LeftHand": (3, [0.25, 0, 0]),
    "LeftUpLeg": (0, [0.1, 0, 0]),
    "LeftLeg": (5, [0.1, -0.4, 0]),
    "LeftFoot": (6, [0.1, -0.4, 0]),
}


def body_motion(n_frames=3, seed=0):
    J = len(BODY)
    rotations = Rotation.from_rotvec(np.random.default_rng(seed).uniform(-0.8, 0.8, (n_frames * J, 3))).as_matrix()
    return Motion(
        joint_names=tuple(BODY),
        parents=np.array([p for p, _ in BODY.values()]),
        offsets=np.array([o for _, o in BODY.values()], dtype=float),
        end_offsets=np.full((J, 3), np.nan),
        channels=((),) * J,
        rotations=rotations.reshape(n_frames, J, 3, 3),
        translation=np.zeros((n_frames, 3)),
        frame_time=0.01,
    )


def motion_globals(motion):
    Q, P = motion.rotations.copy(), np.zeros(motion.rotations.shape[:2] + (3,))
    for k in range(1, Q.shape[1]):
        p = motion.parents[k]
        P[:, k] = P[:, p] + Q[:, p] @ motion.offsets[k]
        Q[:, k] = Q[:, p] @ Q[:, k]
    return Q, P


def body_rig(motion, turned=None, **more):
    """The motion's skeleton with other bone lengths; ``turned``: global rotations of its rest pose, by name."""
    Q = np.tile(np.eye(3), (len(BODY), 1, 1))
    joints = np.zeros((len(BODY), 3))
    for k, (name, (p, offset)) in enumerate(BODY.items()):
        if p >= 0:
            joints[k] = joints[p] + Q[p] @ np.array(offset) * 1.3
            Q[k] = Q[p]
        if turned and name in turned:
            Q[k] = Rotation.from_rotvec(turned[name]).as_matrix()
    return bare_rig(list(BODY), [p for p, _ in BODY.values()], joints, **more)


def test_same_rest_pose_takes_the_rotations_as_they_are():
    motion = body_motion()
    rig = body_rig(motion, frames=random_frames(len(BODY)))
    thetas = bvh_thetas(rig, motion)
    Q, _ = motion_globals(motion)
    for theta, G in zip(thetas, Q, strict=True):
        np.testing.assert_allclose(skin(rig, theta).A, G, atol=1e-12)


def test_limbs_point_where_the_motions_do():
    motion = body_motion()
    turned = {"LeftArm": [0, 0, -0.8], "LeftForeArm": [0.3, -0.7, -0.4], "LeftUpLeg": [0.1, 0, -0.2], "LeftLeg": [0.2, 0, -0.2]}
    rig = body_rig(motion, turned)
    _, P = motion_globals(motion)
    thetas = bvh_thetas(rig, motion, [2, 0])
    for theta, frame in zip(thetas, [2, 0], strict=True):
        posed = rig.pose_joints(theta)
        for k, joint in enumerate(BODY):
            p = rig.parents[k]
            if joint in ("LeftForeArm", "LeftHand", "LeftLeg", "LeftFoot"):  # the ends of the limbs' bones
                a, b = posed[k] - posed[p], P[frame, k] - P[frame, p]
                np.testing.assert_allclose(a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-12)


def test_an_elbow_bent_in_the_rest_pose_opens_like_a_hinge():
    """At the motion's rest the arm is straight: the forearm turns about the elbow's axis only, without twist."""
    motion = body_motion(1)
    motion.rotations[:] = np.eye(3)
    rig = body_rig(motion, {"LeftArm": [0, 0, -0.8], "LeftForeArm": [0, 0, -0.3]})
    theta = bvh_thetas(rig, motion)[0]
    np.testing.assert_allclose(theta[2], [0, 0, 0.8], atol=1e-12)
    np.testing.assert_allclose(theta[3], [0, 0, -0.5], atol=1e-12)
    np.testing.assert_allclose(theta[[0, 1, 4]], 0, atol=1e-12)


def test_joints_without_a_namesake_ride_along():
    motion = body_motion()
    plain = body_rig(motion)
    renamed = bare_rig(["Chest" if n == "Spine" else n for n in BODY], plain.parents, plain.joints)
    theta, want = bvh_thetas(renamed, motion), bvh_thetas(plain, motion)
    assert not theta[:, 1].any()
    np.testing.assert_allclose(skin(renamed, theta[0]).A[2:], skin(plain, want[0]).A[2:], atol=1e-12)


@pytest.mark.parametrize(("up", "forward"), [("+z", "-y"), ("-x", "+z"), (None, None)])
def test_rigs_with_other_axes_move_alike(up, forward):
    motion = body_motion()
    plain = body_rig(motion, {"LeftArm": [0, 0, -0.8]})
    basis = np.eye(3)
    if up:
        axis = {"+x": [1, 0, 0], "-x": [-1, 0, 0], "-y": [0, -1, 0], "+z": [0, 0, 1]}
        basis = np.column_stack([np.cross(axis[up], axis[forward]), axis[up], axis[forward]])
    rig = bare_rig(list(BODY), plain.parents, plain.joints @ basis.T, up=up, forward=forward)
    for face_forward in (False, True):
        theta = bvh_thetas(rig, motion, face_forward=face_forward)
        want = bvh_thetas(plain, motion, face_forward=face_forward)
        for t in range(len(theta)):
            np.testing.assert_allclose(rig.pose_joints(theta[t]), plain.pose_joints(want[t]) @ basis.T, atol=1e-12)


def test_face_forward_removes_the_turn_and_nothing_else():
    motion = body_motion()
    rig = body_rig(motion)
    turn = Rotation.from_rotvec([0, 2.5, 0]).as_matrix()
    motion.rotations[1] = motion.rotations[0]
    motion.rotations[1, 0] = turn @ motion.rotations[0, 0]
    kept, removed = bvh_thetas(rig, motion), bvh_thetas(rig, motion, face_forward=True)
    np.testing.assert_allclose(removed[1], removed[0], atol=1e-12)
    np.testing.assert_allclose(kept[:, 1:], removed[:, 1:], atol=1e-12)
    np.testing.assert_allclose(skin(rig, kept[1]).A[0], turn @ skin(rig, kept[0]).A[0], atol=1e-12)
    facing = skin(rig, removed[0]).A[0][:, 2]
    assert abs(facing[0]) < 1e-12 and facing[2] > 0


def test_motion_of_another_skeleton():
    motion = body_motion()
    plain = body_rig(motion)
    rig = bare_rig(["Pelvis", *list(BODY)[1:]], plain.parents, plain.joints)
    with pytest.raises(InputError, match="motion: got a skeleton whose root is Hips; expected the rig's root, Pelvis"):
        bvh_thetas(rig, motion)


def test_a_real_person_on_a_real_body(shared_rigs):
    """Upright, feet flat where they stand still, knees bending backward only; the clip turns round once."""
    motion = read_bvh(shared_rigs / "motion" / "01_01.bvh")
    with np.load(shared_rigs / "mpfb2_body" / "mpfb2_cmu_mb.npz", allow_pickle=False) as body:
        names = [str(n) for n in body["joint_names"]]
        rig = bare_rig(names, body["parents"], body["joints"][0], up="+y", forward="+z")
    row = {name: j for j, name in enumerate(names)}
    frames = np.arange(1, 2752, 10)
    thetas = bvh_thetas(rig, motion, frames)
    A = np.array([skin(rig, theta).A for theta in thetas])
    posed = np.array([rig.pose_joints(theta) for theta in thetas])
    assert np.all(posed[:, row["Head"], 1] > posed[:, row["LeftUpLeg"], 1] + 0.3)
    facing = np.unwrap(np.arctan2(A[:, 0, 0, 2], A[:, 0, 2, 2]))
    assert 3.0 < np.ptp(facing) < 3.5
    _, P = motion_globals(motion)
    for side in ("Left", "Right"):
        ankle = P[:, motion.joint_names.index(f"{side}Foot")] + motion.translation
        still = np.linalg.norm(np.gradient(ankle, axis=0), axis=1)[frames] < 0.01
        assert still.sum() > 30
        sole = A[still, row[f"{side}Foot"], :, 1]  # the sole's normal
        assert np.degrees(np.arccos(np.median(sole[:, 1]))) < 6
        thigh, shin = (posed[:, row[f"{side}{b}"]] - posed[:, row[f"{side}{a}"]] for a, b in (("UpLeg", "Leg"), ("Leg", "Foot")))
        bend = np.einsum("ti,ti->t", np.cross(thigh, shin), A[:, 0, :, 0])
        assert np.all(bend > -0.005)
