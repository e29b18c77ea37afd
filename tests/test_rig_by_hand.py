"""Rigs put together by hand, by ``dataclasses.replace``: what no rig can have is refused, and nobody can write to one."""

import copy
import json
import pickle
from dataclasses import asdict, replace

import numpy as np
import pytest

from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.synthesis import synthesize


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda rig: {"lower": rig.upper, "upper": rig.lower}, ["limits", "reversed", "Swap"]),
        (lambda rig: {"upper": np.full(rig.upper.shape, 90.0)}, ["limits", "up to 90", "pi / 180"]),
        (lambda rig: {"lower": rig.lower[0], "upper": rig.upper[0]}, ["lower", "(3,)", "(4, 3)"]),
        (lambda rig: {"lower": rig.lower.tolist()}, ["lower", "list", "NumPy array"]),
        (lambda rig: {"vertices": rig.vertices[:10]}, ["faces", "0 to 9"]),
        (lambda rig: {"vertices": np.full(rig.vertices.shape, np.nan)}, ["vertices", "NaN"]),
        (lambda rig: {"weights": rig.weights[:5]}, ["weights", "(5, 4)"]),
        (lambda rig: {"weights": rig.weights.toarray()}, ["weights", "ndarray", "csr_array"]),
        (lambda rig: {"weights": rig.weights.tocsc()}, ["weights", "csc_array", "csr_array"]),
        (lambda rig: {"regressor": rig.regressor[:1]}, ["regressor", "(4, "]),
        (lambda rig: {"joint_names": rig.joint_names[:2]}, ["parents", "(4,)", "(2,)"]),
        (lambda rig: {"joint_names": list(rig.joint_names)}, ["joint_names", "a tuple of names"]),
        (lambda rig: {"joint_names": ("a\ud83d", "b", "c", "d")}, ["joint_names", r"'a\ud83d'", "UTF-8", "Rename"]),
        (lambda rig: {"partitions": {"own": {"a\ud83d": rig.joint_names}}}, ["partitions", r"'a\ud83d'", "UTF-8"]),
        (lambda rig: {"parents": np.array([-1, 0, 1, 4])}, ["parents", "[-1, 0, 1, 4]", "one tree"]),
        (lambda rig: {"parents": np.array([-1, 2, 1, 0])}, ["parents", "one tree"]),
        (lambda rig: {"parents": np.array([-1, -1, 1, 0])}, ["parents", "one tree"]),
        (lambda rig: {"granularity": "fingers"}, ["granularity", "'fingers'", "joints"]),
        (lambda rig: {"locked": np.zeros(2, dtype=bool)}, ["locked", "(2,)", "4 joints"]),
        (lambda rig: {"metres_per_unit": "cm"}, ["metres_per_unit", "'cm'", "positive number"]),
        (lambda rig: {"up": "z"}, ["up", "'z'", "+z"]),
        (lambda rig: {"up": ["+z"]}, ["up", "['+z']"]),
        (lambda rig: {"up": "+y", "forward": "-y"}, ["forward", "-y"]),
        (lambda rig: {"partitions": {"own": ["a"]}}, ["partitions", "mapping"]),
        (lambda rig: {"partitions": {"own": {"one": rig.joint_names[0]}}}, ["partition 'own'", "part 'one'", "names"]),
        (lambda rig: {"partitions": {"own": {"one": None}}}, ["partition 'own'", "None in part 'one'"]),
        (lambda rig: {"weights": rig.weights * np.nan}, ["weights", "NaN"]),
        (lambda rig: {"partitions": {"own": {"one": ["nose"]}}}, ["partition 'own'", "'nose' in part 'one'"]),
    ],
)
def test_what_no_rig_can_have_is_one_clear_error(change, words, tube_rig):
    with pytest.raises(InputError) as raised:
        replace(tube_rig, **change(tube_rig))
    assert all(word in str(raised.value) for word in words), raised.value


def test_other_limits_make_another_rig(tube_rig):
    narrow = replace(tube_rig, lower=0.5 * tube_rig.lower, upper=0.5 * tube_rig.upper)
    assert narrow.digest != tube_rig.digest
    np.testing.assert_array_equal(narrow.lower, 0.5 * tube_rig.lower)


@pytest.mark.parametrize("mask", ["locked", "merged"])
def test_a_joint_that_is_locked_afterwards_never_turns(mask, tube_rig, tmp_path):
    """Its limits are 0, so that no segmenter of the rig in which it turned passes for this one's."""
    rig = replace(tube_rig.with_parts("arm and fingers"), poses={"bent": 0.5 * tube_rig.upper})
    held = replace(rig, **{mask: np.arange(4) == 3})
    others = [0, 1, 2]
    for name in ("lower", "upper"):
        assert not getattr(held, name)[3].any() and getattr(rig, name)[3].any()
        np.testing.assert_array_equal(getattr(held, name)[others], getattr(rig, name)[others])
        assert not getattr(held, name).flags.writeable
    assert not held.poses["bent"][3].any() and held.poses["bent"][others].any() and held.poses_digest != rig.poses_digest
    assert held.parts == rig.parts and held.digest != rig.digest
    assert replace(held, **{mask: np.zeros(4, dtype=bool)}).digest == held.digest  # limits that are gone do not come back
    for poses in ("natural", "uniform", "mixed"):
        assert not any(scan.pose[3].any() for scan in synthesize(held, 3, poses=poses, random_state=0))
    held.save(tmp_path / "held.npz")
    again = load_rig(tmp_path / "held.npz")
    assert (again.digest, again.poses_digest) == (held.digest, held.poses_digest)
    for other in (held.mirrored(), held.scaled(2.0), held.with_template(held.vertices), held.welded, held.subject(0)):
        assert not other.lower[3].any() and not other.upper[3].any() and other.turning.sum() == held.turning.sum()


def test_limits_of_a_locked_joint_are_none(tube_rig):
    rig = tube_rig.with_parts("arm and fingers")
    held = replace(rig, locked=np.arange(4) == 3)
    again = replace(held, lower=rig.lower, upper=rig.upper)
    assert again.digest == held.digest != rig.digest
    free = replace(held, locked=np.zeros(4, dtype=bool), lower=rig.lower, upper=rig.upper)
    assert free.digest == rig.digest


@pytest.mark.parametrize(
    "name, kind",
    [*((name, np.float32) for name in ("lower", "vertices", "joints", "regressor")), ("upper", int), ("joints", int)],
)
def test_a_rig_of_other_numbers_is_the_same_once_saved(name, kind, tube_rig, tmp_path):
    """As what was fitted with it, and its segmenter, belong to its digest."""
    rig = replace(tube_rig, **{name: (getattr(tube_rig, name) * 1.7).astype(kind)})
    rig.save(tmp_path / "rig.npz")
    assert load_rig(tmp_path / "rig.npz").digest == rig.digest != tube_rig.digest


@pytest.mark.parametrize("of", [lambda rig: rig, copy.copy, copy.deepcopy, lambda rig: pickle.loads(pickle.dumps(rig))])
def test_nobody_can_write_to_one(of, tube_rig):
    rig = of(replace(tube_rig, poses={"bent": 0.5 * tube_rig.upper}, partitions={"all": {"one": tube_rig.joint_names}}))
    for mapping in (rig.poses, rig.partitions, rig.partitions["all"]):
        for write in (lambda m: m.update(more=()), lambda m: m.clear(), lambda m: m.pop("bent"), lambda m: m.setdefault("k", ())):
            with pytest.raises(TypeError, match="dataclasses.replace"):
                write(mapping)
        with pytest.raises(TypeError, match="immutable"):
            mapping["more"] = ()
        with pytest.raises(TypeError, match="immutable"):
            mapping |= {"more": ()}
    for array in (rig.vertices, rig.weights.data, rig.poses["bent"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_what_a_rig_was_made_of_can_change_afterwards(tube_rig):
    poses, groups = {"bent": 0.5 * tube_rig.upper}, {"all": {"one": tube_rig.joint_names}}
    rig = replace(tube_rig, poses=poses, partitions=groups)
    poses["bent"][:] = 9.0
    groups["all"]["two"] = ()
    poses.clear()
    np.testing.assert_array_equal(rig.poses["bent"], 0.5 * tube_rig.upper)
    assert dict(rig.partitions["all"]) == {"one": tube_rig.joint_names}


def test_its_mappings_are_dicts_to_whoever_reads_them(tube_rig):
    rig = replace(tube_rig, poses={"bent": 0.5 * tube_rig.upper}, partitions={"all": {"one": list(tube_rig.joint_names)}})
    assert rig.partitions == {"all": {"one": tube_rig.joint_names}}  # tuples, which nobody can add to
    assert json.loads(json.dumps(rig.partitions)) == {"all": {"one": list(tube_rig.joint_names)}}
    for copied in (pickle.loads(pickle.dumps(rig.poses)), copy.copy(rig.poses)):
        assert list(copied) == ["bent"] and type(copied) is type(rig.poses)
    own = copy.deepcopy(rig.poses)
    own["more"] = 0.0
    assert asdict(rig)["poses"].keys() == {"bent"} and "more" not in rig.poses


def test_a_scale_may_be_an_array_without_axes(tube_rig):
    """As ``np.load`` gives the scale of a result."""
    rest = np.zeros((4, 3))
    np.testing.assert_array_equal(tube_rig.pose(rest, scale=np.array(2.0)), tube_rig.pose(rest, scale=2.0))
    for scale in (True, np.array([2.0]), np.array(0.0), np.array("2")):
        with pytest.raises(InputError, match="scale: got"):
            tube_rig.pose(rest, scale=scale)


def test_the_leading_joint_is_the_first_of_the_heaviest(tube_rig):
    dense = tube_rig.weights.toarray()
    np.testing.assert_array_equal(tube_rig.leading_joint, dense.argmax(axis=1))
    tied = np.zeros_like(dense)
    tied[:, [1, 2]] = 0.5
    rig = replace(tube_rig, weights=type(tube_rig.weights)(tied))
    assert (rig.leading_joint == 1).all() and not rig.leading_joint.flags.writeable
