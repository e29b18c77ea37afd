"""What the angles of a joint do, as a picture, and ``lbsfit rig turn``, which writes it."""

from dataclasses import replace

import numpy as np
import pytest

import lbsfit_np as lbs
from lbsfit_np.errors import InputError
from lbsfit_np.report.turn_picture import turn_picture

SIZE = (60, 80)


@pytest.fixture(scope="module")
def hand():
    return lbs.load_rig("hand-coarse")


def _cells(image):
    """The nine pictures, line by line."""
    w, h = SIZE
    return [[image[y * (h + 8) : y * (h + 8) + h, x * (w + 8) : x * (w + 8) + w] for x in range(3)] for y in range(3)]


def test_each_axis_has_its_limits_beside_the_rest_pose(hand):
    lines = _cells(turn_picture(hand, "index1", size=SIZE))
    j = hand.joint_names.index("index1")
    for axis, (lower, rest, upper) in enumerate(lines):
        np.testing.assert_array_equal(rest, lines[0][1])
        if hand.upper[j, axis] == hand.lower[j, axis]:
            assert (lower == 255).all() and (upper == 255).all()
        else:
            assert (lower != rest).any() and (upper != rest).any() and (lower != upper).any()
    assert hand.upper[j, 2] == hand.lower[j, 2] and hand.upper[j, 0] > hand.lower[j, 0]


@pytest.mark.parametrize("joint, orange", [("wrist", (0.9, 1.0)), ("index1", (0.02, 0.2)), ("index3", (0.002, 0.05))])
def test_what_moves_with_a_joint_is_orange(hand, joint, orange):
    """By its weights: of the root all, of a finger that, and of its end no more than that."""
    rest = _cells(turn_picture(hand, joint, view="front", size=SIZE))[0][1].astype(int)
    body = (rest != 255).any(axis=2)
    share = np.mean(rest[body][:, 0] - rest[body][:, 2] > 60)
    assert orange[0] <= share <= orange[1]


def test_a_limit_of_zero_is_the_rest_pose(hand):
    j = hand.joint_names.index("index1")
    lower = hand.lower.copy()
    lower[j, 0] = 0.0
    (low, rest, _), *_ = _cells(turn_picture(replace(hand, lower=lower), "index1", size=SIZE))
    np.testing.assert_array_equal(low, rest)


def test_other_axes_are_held_where_limits_hold_them(hand):
    """A finger that cannot be straight is not drawn straight at its limits."""
    j = hand.joint_names.index("index1")
    lower, upper = hand.lower.copy(), hand.upper.copy()
    lower[j, 0] = upper[j, 0] = 0.8
    held = _cells(turn_picture(replace(hand, lower=lower, upper=upper), "index1", size=SIZE))
    theta = np.zeros_like(lower)
    theta[j] = 0.8, lower[j, 1], 0.0
    bent = hand.pose(theta)
    seen = np.linalg.norm(hand.pose(np.zeros_like(theta)) - bent, axis=1).max()
    assert seen > 0.1 * hand.size and (held[1][0] != held[1][1]).mean() > 0.02
    assert (held[0][0] == 255).all()


def test_joints_that_are_not_there_or_do_not_turn_are_named(hand):
    with pytest.raises(InputError, match="joint: got 'indx1'; expected one of the 16 joints of 'hand-coarse'.*'index1'"):
        turn_picture(hand, "indx1")
    with pytest.raises(InputError, match="They are wrist, .*index1"):
        turn_picture(hand, "knee")
    with pytest.raises(InputError, match=r"joint: got array\(\['index1', 'knee'\].*expected one of the 16 joints"):
        turn_picture(hand, np.array(["index1", "knee"]))
    for view in (None, []):
        with pytest.raises(InputError, match=r"view: got .*; expected one of front, .*, or \(azimuth, elevation\) in degrees"):
            turn_picture(hand, "index1", view=view, size=(16, 18))
    locked, lower, upper = hand.locked.copy(), hand.lower.copy(), hand.upper.copy()
    j = hand.joint_names.index("index2")
    locked[j], lower[j], upper[j] = True, 0.0, 0.0
    with pytest.raises(InputError, match="joint: got 'index2', which is locked and never turns; expected one that turns"):
        turn_picture(replace(hand, locked=locked, lower=lower, upper=upper), "index2")


def test_the_command_writes_it_and_says_what_is_where(hand, tmp_path, run):
    path = tmp_path / "index1.png"
    code, out, _ = run("rig", "turn", "hand-coarse", "index1", "-o", path, "--view", "front")
    assert code == 0 and path.read_bytes().startswith(b"\x89PNG")
    assert out.splitlines()[:3] == ["x: -30 to 90 degrees", "y: -21 to 15 degrees", "z: does not turn"]
    assert "rows x, y, z; from left to right the lower limit, the rest pose, the upper limit" in out
    before = path.read_bytes()
    card = tmp_path / "card.png"
    card.write_text("")
    for name, more, words in (
        (path, (), "exists already"),
        (tmp_path / "index1.jpg", (), f"a name that ends in .png. Call it {tmp_path}/index1.jpg.png"),
        (".", (), "a folder"),
        (card, ("--card", card, "--existing", "replace"), "which is the card"),
    ):
        code, _, err = run("rig", "turn", "hand-coarse", "index1", "-o", name, *more)
        assert code == 2 and words in err and path.read_bytes() == before and card.read_text() == ""
    card.write_text('[limits]\nunit = "deg"\nindex1 = [[30, -20, 0], [30, 20, 0]]\n')
    out = run("rig", "turn", "hand-coarse", "index1", "-o", path, "--card", card, "--existing", "replace")[1]
    assert "x: held at 30 degrees" in out and "the rest pose is outside these limits" in out
    out = run("rig", "turn", "hand-coarse", "wrist", "-o", path, "--existing", "replace")[1]
    assert "fits turn it freely" in out and "outside" not in out
    code, _, err = run("rig", "turn", "hand-coarse", "index1")
    assert code == 2 and "-o NAME.png" in err
