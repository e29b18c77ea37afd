"""build_rig with content that makes no rig: one clear error each."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import make_tube_data

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.rig.build import build_rig


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
    "half of a character in a joint's name": (
        broken(joint_names=["root", "elbow", "long", "b\ud83d"]),
        r"joint_names: got 'b\\ud83d', which has what UTF-8 cannot hold; expected names of Unicode characters\. Rename",
    ),
    "NUL in a joint's name": (
        broken(joint_names=["root", "elbow", "long", "b\0"]),
        r"joint_names: got 'b\\x00', which has a NUL; expected names without one\. Rename",
    ),
    "half of a character in a part's name": (
        broken(partitions={"own": {"b\ud83d": ("root",)}}),
        r"partitions: got 'b\\ud83d', which has what UTF-8 cannot hold",
    ),
    "vertices of a wrong shape": (broken(vertices=np.zeros((5, 2))), r"vertices.*\(5, 2\).*\(any, 3\)"),
    "vertices that are text": (broken(vertices=np.array([["a", "b", "c"]])), "vertices.*array of numbers"),
    "ragged vertices": (broken(vertices=[[1, 2, 3], [1, 2]]), "vertices.*array of numbers"),
    "infinite vertices": (broken(vertices=put((4, 1), np.inf)), r"vertices.*1 value that is NaN or infinite.*\[4, 1\]"),
    "vertices too large to square": (broken(vertices=lambda v: v * 1e160), r"vertices: got coordinates of .*at most 1e\+100"),
    "joints too far away to square": (broken(joints=put((2, 0), 1e200)), r"joints: got coordinates of .*at most 1e\+100"),
    "masked vertices": (broken(vertices=lambda v: np.ma.masked_less(v, 0.1)), "vertices: got a masked array"),
    "all vertices at one point": (broken(vertices=lambda v: v * 0 + 1), "all at one point"),
    "no faces": (broken(faces=np.zeros((0, 3), dtype=int)), "no faces.*triangle"),
    "degenerate faces only": (broken(faces=np.array([[1, 1, 2], [3, 4, 3]])), "2 faces, each with two corners at one point"),
    "faces without an area": (
        broken(vertices=lambda v: np.where(np.arange(3) < 1, v, 0.0)),
        r"480 faces, none of which has an area; expected a surface",
    ),
    "quads": (broken(faces=np.zeros((4, 4), dtype=int)), r"faces.*\(4, 4\)"),
    "faces of floats": (broken(faces=np.zeros((4, 3))), "faces.*float64.*integers"),
    "faces out of range": (broken(faces=put((2, 1), 242)), r"1 faces out of range.*face 2.*0 to 241"),
    "negative faces": (broken(faces=put((0, 0), -1)), "out of range.*face 0"),
    "weights of a wrong shape": (broken(weights=np.ones((242, 3))), r"weights.*\(242, 3\).*\(242, 4\)"),
    "weights that are NaN": (broken(weights=put((5, 0), np.nan)), r"weights.*1 value that is NaN.*\[5, 0\]"),
    "sparse weights that are NaN": (
        broken(weights=lambda w: sparse.csr_array(put((5, 0), np.nan)(w))),
        "weights.*1 value that is NaN.*row 5",
    ),
    "negative weights": (
        broken(weights=put(([3, 8], [1, 0]), [-0.25, -0.5])),
        r"2 negative weights.*-0.5 \(vertex 8, joint 'root'\)",
    ),
    "one negative weight": (broken(weights=put(([3], [1]), [-0.25])), r"1 negative weight, the worst"),
    "weights of one sum": (broken(weights=lambda w: w * 0.9), "weight rows that do not sum to 1: they sum to 0.9, the worst"),
    "weights of two sums": (
        broken(weights=lambda w: w * np.r_[0.8, np.ones(241)][:, None]),
        "1 of 242 weight rows that do not sum to 1: they sum to 0.8 to 1, the worst is vertex 0 with 0.8",
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
        r"2 root joints: root, short.*one root.*lbsfit rig card RIG -o CARD.*\[hierarchy\]",
    ),
    "joints that are NaN": (broken(joints=put((1, 1), np.nan)), "joints.*NaN"),
    "joints of a wrong shape": (broken(joints=np.zeros((3, 3))), r"joints.*\(3, 3\).*\(4, 3\)"),
    "stretched frames": (broken(frames=lambda f: f * 1.1), "frames.*'root'.*not orthonormal"),
    "left-handed frames": (broken(frames=lambda f: f * np.array([1, 1, -1.0])), "left-handed.*'root'"),
    "limits reversed": (broken(lower=put((2, 1), 0.9)), r"limits of joint 'long' reversed about y: lower 0\.9, upper 0\.2"),
    "limits in degrees": (broken(upper=put((1, 0), 90.0)), r"limits of joint 'elbow' of up to 90.*at most one turn.*pi / 180"),
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


def test_several_roots_of_a_file_say_how_its_card_is_made(tmp_path):
    data = replace(make_tube_data(), parents=np.array([-1, 0, 1, -1]), path=tmp_path / "my arm.glb")
    with pytest.raises(FileError, match=re.escape(f"lbsfit rig card '{tmp_path / 'my arm.glb'}' -o CARD, check its [hierarchy]")):
        build_rig(data)


def test_card_must_be_a_card():
    with pytest.raises(InputError, match="card.*int.*Card, or the path"):
        build_rig(make_tube_data(), 3)
