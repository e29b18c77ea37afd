"""BVH motion and hand pose files: what is written comes back, what is broken gives one error that says where."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io.bvh import read_bvh
from lbsfit_np.io.handpose import WEBXR_JOINTS, read_handpose

HIERARCHY = """HIERARCHY
ROOT Hips
{
  OFFSET 1.0 2.0 3.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Left Arm
  {
    OFFSET 0.5 0 0
    CHANNELS 3 Xrotation Yrotation Zrotation
    JOINT Hand
    {
      OFFSET 0.25 0 -0.125
      CHANNELS 2 Yrotation Xrotation
      End Site
      {
        OFFSET 0.1 0 0
      }
    }
  }
  JOINT Tail
  {
    OFFSET 0 -1 0
    CHANNELS 6 Zposition Xposition Yposition Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 0 -2 0
    }
  }
}
"""
N = 6 + 3 + 2 + 6


def bvh(values, hierarchy=HIERARCHY, n_frames=None, frame_time="0.04"):
    rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in values)
    return f"{hierarchy}MOTION\nFrames: {len(values) if n_frames is None else n_frames}\nFrame Time: {frame_time}\n{rows}\n"


def values(n_frames=4):
    return np.random.default_rng(0).uniform(-170, 170, (n_frames, N))


def write(tmp_path, text):
    path = tmp_path / "walk.bvh"
    path.write_text(text)
    return path


def test_skeleton_and_motion_come_back(tmp_path):
    v = values()
    m = read_bvh(write(tmp_path, bvh(v)))
    assert m.joint_names == ("Hips", "Left Arm", "Hand", "Tail")
    np.testing.assert_array_equal(m.parents, [-1, 0, 1, 0])
    np.testing.assert_array_equal(m.offsets, [[1, 2, 3], [0.5, 0, 0], [0.25, 0, -0.125], [0, -1, 0]])
    np.testing.assert_array_equal(m.end_offsets, [[np.nan] * 3, [np.nan] * 3, [0.1, 0, 0], [0, -2, 0]])
    assert m.channels[2] == ("Yrotation", "Xrotation")
    assert m.frame_time == 0.04
    np.testing.assert_array_equal(m.translation, v[:, :3] + [1, 2, 3])
    # scipy's upper-case letters are rotations about the moved axes, in the order of the channels
    for j, (order, first, last) in enumerate([("ZYX", 3, 6), ("XYZ", 6, 9), ("YX", 9, 11), ("YZX", 14, 17)]):
        want = Rotation.from_euler(order, v[:, first:last], degrees=True).as_matrix()
        np.testing.assert_allclose(m.rotations[:, j], want, atol=1e-14)
    assert len(m.notes) == 1 and "Tail" in m.notes[0] and "position" in m.notes[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.replace("\n", "\r\n"),
        lambda t: "\ufeff" + t,
        lambda t: t.replace("rotation", "ROTATION").replace("JOINT", "Joint"),
        lambda t: t.replace("\n{", " {"),
        lambda t: t.replace("\nFrames: ", "\n\nFrames:\t") + "\n\n",
    ],
)
def test_ways_of_writing_the_same(tmp_path, change):
    plain = read_bvh(write(tmp_path, bvh(values())))
    other = read_bvh(write(tmp_path, change(bvh(values()))))
    assert other.joint_names == plain.joint_names
    np.testing.assert_array_equal(other.rotations, plain.rotations)


def test_motion_of_a_person(shared_rigs):
    m = read_bvh(shared_rigs / "motion" / "01_01.bvh")
    assert m.rotations.shape == (2752, 31, 3, 3) and len(set(m.joint_names)) == 31 and not m.notes
    gram = m.rotations @ m.rotations.swapaxes(-1, -2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-12)
    np.testing.assert_array_equal(m.translation[0], [9.3722, 17.8693, -17.3198])
    leg = m.rotations[0, m.joint_names.index("LeftUpLeg")]  # the first frame has -17 about z alone there
    np.testing.assert_allclose(Rotation.from_matrix(leg).as_euler("ZYX", degrees=True), [-17, 0, 0], atol=1e-12)


LINE_OF = {text: HIERARCHY.splitlines().index(line) + 1 for text, line in (("hand", "      CHANNELS 2 Yrotation Xrotation"),)}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.replace("HIERARCHY", "hierarchies"), "'hierarchies' on line 1; expected HIERARCHY"),
        (lambda t: "", "end of the file on line 0; expected HIERARCHY"),
        (lambda t: t.replace("2 Yrotation Xrotation", "2 Yrotation Wrotation"), f"channel 'Wrotation' on line {LINE_OF['hand']}"),
        (lambda t: t.replace("2 Yrotation Xrotation", "2 Yrotation Yrotation"), f"channel 'Yrotation' on line {LINE_OF['hand']}"),
        (lambda t: t.replace("2 Yrotation Xrotation", "two"), f"'two' channels on line {LINE_OF['hand']}"),
        (lambda t: t.replace("2 Yrotation Xrotation", "3 Yrotation Xrotation"), "channel 'End' on line"),
        (lambda t: t.replace("2 Yrotation Xrotation", "1 Yrotation Xrotation"), "'Xrotation' on line 13; expected OFFSET"),
        (lambda t: t.replace("OFFSET 0.5 0 0", "OFFSET 0.5 x 0"), "'x' after OFFSET on line 8"),
        (lambda t: t.replace("OFFSET 0.5 0 0", "OFFSET 0.5 nan 0"), "'nan' after OFFSET on line 8"),
        (lambda t: t.replace("    OFFSET 0.5 0 0\n", ""), "Left Arm without an OFFSET"),
        (lambda t: t.replace("JOINT Tail", "JOINT Hand"), "a second joint 'Hand' on line"),
        (lambda t: t.replace("JOINT Tail\n  {", "JOINT Tail"), "'OFFSET' on line 21; expected { after"),
        (lambda t: t.replace("2 Yrotation Xrotation", "1" * 5000), f"… channels on line {LINE_OF['hand']}"),
        (lambda t: t.replace("Frames: 4", f"Frames: {'1' * 5000}"), "… frames on line 31; expected a whole number"),
        (lambda t: t.replace("MOTION", "ROOT Other"), "a second ROOT on line 30"),
        (lambda t: t.replace("MOTION", "MOVES"), "'MOVES' on line 30; expected MOTION"),
        (lambda t: t.replace("Frames: 4", "Frames: many"), "'many' frames on line 31"),
        (lambda t: t.replace("Time: 0.04", "Time: 0"), "frame time of 0 on line 32"),
        (lambda t: t.replace("Time: 0.04", "Time:"), "nothing after Frame Time: on line 32"),
        (lambda t: t.replace("Frames: 4", "Frames: 5"), "4 frames, the last on line 36; expected the 5"),
        (lambda t: t.replace("Frames: 4", "Frames: 3"), "4 frames, the last on line 36; expected the 3"),
        (lambda t: t[: t.index("Frame Time")], "end of the file on line 31"),
        (lambda t: t.rstrip().rpartition(" ")[0], f"{N - 1} values on line 36; expected {N}.*truncated"),
        (lambda t: t + "1.0\n", "1 values on line 37"),
        (lambda t: t.rstrip().rpartition(" ")[0] + " nan", "not finite numbers on line 36"),
        (lambda t: t.rstrip().rpartition(" ")[0] + " twelve", "not finite numbers on line 36"),
    ],
)
def test_broken_files_say_where(tmp_path, change, words):
    path = write(tmp_path, change(bvh(values())))
    with pytest.raises(FileError, match=words) as e:
        read_bvh(path)
    assert e.value.argument == str(path)


def test_no_frames(tmp_path):
    with pytest.raises(FileError, match="0 frames.*at least one"):
        read_bvh(write(tmp_path, bvh(values(0))))


def test_truncation_anywhere_is_one_error(tmp_path):
    text = bvh(np.round(values(2)))
    whole = text.rstrip()
    for n in range(0, len(whole) - 4, 3):  # without the last digits, the last number is merely another one
        with pytest.raises(FileError, match="line"):
            read_bvh(write(tmp_path, text[:n]))


def test_missing_bvh(tmp_path):
    with pytest.raises(FileError, match="No such file"):
        read_bvh(tmp_path / "nowhere.bvh")


# ---- hand poses ----


def handpose(seed=0):
    """(2, 25, 4, 4) rigid motions, and the bytes of their file."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (2, 25, 1, 1))
    T[..., :3, :3] = Rotation.random(50, random_state=seed).as_matrix().reshape(2, 25, 3, 3)
    T[..., :3, 3] = rng.normal(size=(2, 25, 3))
    raw = np.concatenate([[25], T.swapaxes(-1, -2).ravel(), np.zeros(50)]).astype("<f4").tobytes()
    return T, raw


def test_hand_poses_come_back(tmp_path):
    T, raw = handpose()
    path = tmp_path / "a.handpose"
    path.write_bytes(raw)
    np.testing.assert_allclose(read_handpose(path), T[0], atol=1e-6)
    np.testing.assert_allclose(read_handpose(path, "left"), T[0], atol=1e-6)
    np.testing.assert_allclose(read_handpose(path, hand="right"), T[1], atol=1e-6)
    assert len(WEBXR_JOINTS) == 25


def test_real_hand_poses(shared_rigs):
    poses = sorted((shared_rigs / "hand_poses").glob("*.handpose"))
    assert len(poses) == 7
    for path in poses:
        left, right = read_handpose(path), read_handpose(path, "right")
        np.testing.assert_allclose(left[0], np.eye(4), atol=1e-6)  # relative to the wrist
        thumb, pinky = WEBXR_JOINTS.index("thumb-metacarpal"), WEBXR_JOINTS.index("pinky-finger-metacarpal")
        assert left[thumb, 0, 3] > 0 > left[pinky, 0, 3]
        assert right[thumb, 0, 3] < 0 < right[pinky, 0, 3]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda raw: raw[:-1], "3403 bytes.*3404.*truncated"),
        (lambda raw: b"", "0 bytes"),
        (lambda raw: raw + b"\0", "more than 3404 bytes"),
        (lambda raw: np.float32(21).tobytes() + raw[4:], "21 joints"),
        (lambda raw: raw[:4] + np.float32(np.nan).tobytes() + raw[8:], r"not a rotation.*wrist"),
        (lambda raw: raw[:4] + np.float32(9).tobytes() + raw[8:], r"not a rotation.*wrist"),
        (lambda raw: raw[: 4 + 64] + bytes(64) + raw[4 + 128 :], r"not a rotation.*thumb-metacarpal"),
    ],
)
def test_broken_hand_poses(tmp_path, change, words):
    path = tmp_path / "a.handpose"
    path.write_bytes(change(handpose()[1]))
    with pytest.raises(FileError, match=words):
        read_handpose(path)


def test_hand_that_is_not_there(tmp_path):
    path = tmp_path / "a.handpose"
    path.write_bytes(handpose()[1])
    with pytest.raises(InputError, match="hand.*'both'.*'left' or 'right'"):
        read_handpose(path, "both")
    with pytest.raises(FileError, match="No such file"):
        read_handpose(tmp_path / "nowhere.handpose")
