"""Shape parameters: what they do, how they travel with a rig, and what is refused."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from small_rigs import make_tube_data

from lbsfit_np.errors import InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card
from lbsfit_np.rig.shapes import ShapeSpace, from_counts, to_counts


def space(m=242, J=4, **changes):
    """Two parameters: a height in metres that stretches y, and a girth that widens x."""
    rng = np.random.default_rng(1)
    content = {
        "names": ("height", "girth"),
        "units": ("m", ""),
        "lower": np.array([0.5, -1.0]),
        "upper": np.array([2.0, 1.0]),
        "default": np.array([1.0, 0.0]),
        "spread": np.array([0.1, 0.5]),
        "vertices": 0.1 * rng.standard_normal((2, m, 3)),
        "joints": 0.1 * rng.standard_normal((2, J, 3)),
    }
    return ShapeSpace(**content | changes)


@pytest.fixture(scope="module")
def shaped():
    data = make_tube_data()
    frames = np.tile(np.eye(3), (4, 1, 1))
    poses = {"rest": np.zeros((4, 3)), "bent": np.full((4, 3), 0.3)}
    return build_rig(replace(data, shapes=space(), poses=poses, smpl_rest=frames))


# ---- the linear family ----


def test_values_offsets_and_joints():
    s = space()
    v = s.values({"girth": -0.5, "height": 1})
    np.testing.assert_array_equal(v, [1.0, -0.5])
    np.testing.assert_allclose(s.offsets(v), -0.5 * s.vertices[1])
    np.testing.assert_allclose(s.moved_joints(v), -0.5 * s.joints[1])
    np.testing.assert_array_equal(s.offsets(s.values({})), 0)
    moved = s.at(v)
    np.testing.assert_array_equal(moved.offsets(v), 0)
    np.testing.assert_allclose(moved.offsets(s.default), -s.offsets(v))


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"hight": 1.0}, r"hight.*does not have.*height 0\.5 to 2 m; girth -1 to 1\."),
        ({"height": 2.5}, r"height: got 2\.5; expected a number from 0\.5 to 2 m"),
        ({"height": 0}, r"height: got 0; expected a number from 0\.5 to 2 m"),
        ({"girth": np.nan}, "girth: got nan; expected a number from -1 to 1"),
        ({"girth": "wide"}, "girth: got 'wide'"),
        ({"girth": True}, "girth: got True"),
    ],
)
def test_wrong_values_say_the_range(parameters, words):
    with pytest.raises(InputError, match=words):
        space().values(parameters)


def test_words_and_repr_name_the_ranges():
    assert space().words(0) == "height 0.5 to 2 m"
    assert repr(space()) == "<ShapeSpace: height 0.5 to 2 m, girth -1 to 1>"
    assert len(space()) == 2


def test_immutable_and_stays_so_in_a_pickle():
    for s in (space(), pickle.loads(pickle.dumps(space()))):
        with pytest.raises(ValueError, match="read-only"):
            s.vertices[0] = 0


# ---- rounding ----


@pytest.mark.parametrize("factor", [1e-9, 1.0, 3.7e5])
def test_rounded_directions_are_counts_exactly(factor):
    s = space(vertices=factor * space().vertices)
    s = replace(s, vertices=s.vertices * np.array([1, 1e-3])[:, None, None]).rounded()
    counts, steps = to_counts(s.vertices)
    assert counts.dtype == np.int16 and np.array_equal(np.log2(steps), np.round(np.log2(steps)))
    assert np.array_equal(from_counts(counts, steps), s.vertices)
    assert np.array_equal(s.rounded().vertices, s.vertices)
    assert (np.abs(counts).max(axis=(1, 2)) > 16000).all()


def test_what_is_not_on_a_grid_stays_as_it_is():
    s = space()
    counts, steps = to_counts(s.vertices)
    assert counts is s.vertices and np.array_equal(steps, [1, 1])
    zero = space(vertices=np.zeros((2, 242, 3)))
    assert to_counts(zero.vertices)[0].dtype == np.int16 and np.array_equal(zero.rounded().vertices, zero.vertices)


def test_error_of_rounding_is_as_asked():
    s, error = space(), 2e-4
    r = s.rounded(error)
    miss = 4 * s.spread[:, None, None] * np.abs(r.vertices - s.vertices)
    assert miss.max() <= error and miss.max() > error / 4
    assert len(np.unique(r.vertices[0])) < len(np.unique(s.rounded().vertices[0]))


# ---- with a rig ----


def test_rig_keeps_them_through_its_changes(shaped):
    s = shaped.shapes
    for same in (shaped.with_parts("arm and fingers"), shaped.with_template(shaped.vertices * 1.01), shaped.welded):
        assert same.shapes is s and same.smpl_rest is shaped.smpl_rest
        assert list(same.poses) == list(shaped.poses) and all(pose is shaped.poses[name] for name, pose in same.poses.items())
    inches = shaped.scaled(39.37)
    np.testing.assert_allclose(inches.shapes.vertices, 39.37 * s.vertices)
    np.testing.assert_allclose(inches.shapes.joints, 39.37 * s.joints)
    assert inches.shapes.units == s.units and np.array_equal(inches.shapes.upper, s.upper)


def test_welding_takes_their_rows():
    data = make_tube_data()
    rows = np.r_[0:242, 0:9]
    split = replace(data, vertices=data.vertices[rows], weights=data.weights.toarray()[rows], shapes=space(251))
    split.shapes = replace(space(), vertices=space().vertices[:, rows])
    welded = build_rig(split).welded
    assert len(welded.vertices) == 242
    np.testing.assert_array_equal(welded.shapes.vertices, space().vertices)


def test_they_are_no_part_of_the_digest(shaped):
    assert shaped.digest == build_rig(make_tube_data()).digest


def test_arrays_are_the_rigs_own_and_locked(shaped):
    data = replace(make_tube_data(), shapes=space(), poses={"a": np.zeros((4, 3))}, smpl_rest=np.tile(np.eye(3), (4, 1, 1)))
    rig = build_rig(data)
    data.poses["a"][:] = 1
    data.smpl_rest[:] = 0
    assert not rig.poses["a"].any() and rig.smpl_rest.any()
    for array in (rig.poses["a"], rig.smpl_rest, rig.shapes.joints):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    again = pickle.loads(pickle.dumps(rig))
    with pytest.raises(ValueError, match="read-only"):
        again.poses["a"][0] = 0


def test_empty_space_is_none():
    none = space(
        names=(), units=(), vertices=np.zeros((0, 242, 3)), joints=np.zeros((0, 4, 3)),
        **dict.fromkeys(("lower", "upper", "default", "spread"), np.zeros(0)),
    )  # fmt: skip
    assert build_rig(replace(make_tube_data(), shapes=none)).shapes is None


# ---- cards ----


def test_card_with_other_axes_keeps_what_poses_do(shaped):
    data = make_tube_data()
    data = replace(data, poses=shaped.poses, smpl_rest=shaped.smpl_rest, joints=data.joints)
    other = build_rig(data, Card(frames=(("*", "bone"),)))
    assert not np.allclose(other.frames, shaped.frames)
    np.testing.assert_allclose(other.pose(other.poses["bent"]), shaped.pose(shaped.poses["bent"]), atol=1e-12)


def test_card_that_merges_or_locks_stills_the_poses_there(shaped):
    data = replace(make_tube_data(), poses=shaped.poses)
    rig = build_rig(data, Card(merge=("short",), lock=("long",)))
    assert np.array_equal(rig.poses["bent"], [[0.3] * 3, [0.3] * 3, [0] * 3, [0] * 3])


def test_card_with_another_hierarchy_leaves_them_out(shaped):
    data = replace(make_tube_data(), poses=shaped.poses, smpl_rest=shaped.smpl_rest)
    rig = build_rig(data, Card(parents=(("short", "long"),)))
    assert rig.poses == {} and rig.smpl_rest is None
    assert any("natural poses" in note and "hierarchy" in note for note in rig.notes)
    same = build_rig(data, Card(parents=(("short", "elbow"),)))
    assert list(same.poses) == ["rest", "bent"] and same.smpl_rest is not None


# ---- what is refused ----


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"names": ("height", "height")}, "shapes, names.*different names"),
        ({"names": ("height", "arm length")}, "shapes, names.*keyword"),
        ({"names": ("height", "amount")}, "'amount'.*another name.*Rig.subject"),
        ({"units": ("m",)}, "shapes, units.*text for each of the 2"),
        ({"lower": np.zeros(3)}, r"shapes, lower: got shape \(3,\)"),
        ({"default": np.array([1.0, 2.0])}, "lower -1, default 2, upper 1 of 'girth'.*default between"),
        ({"upper": np.array([0.5, 1.0]), "default": np.array([0.5, 0.0])}, "lower 0.5, default 0.5, upper 0.5 of 'height'"),
        ({"spread": np.array([0.1, -0.5])}, "spread.*-0.5.*0 and more"),
        ({"vertices": np.zeros((2, 241, 3))}, r"shapes, vertices: got shape \(2, 241, 3\).*\(2, 242, 3\)"),
        ({"joints": np.full((2, 4, 3), np.nan)}, "shapes, joints.*NaN"),
    ],
)
def test_bad_spaces(changes, words):
    with pytest.raises(InputError, match=words):
        build_rig(replace(make_tube_data(), shapes=space(**changes)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shapes": 3}, "shapes: got int; expected a ShapeSpace"),
        ({"poses": [np.zeros((4, 3))]}, "poses: got list; expected a mapping"),
        ({"poses": {"": np.zeros((4, 3))}}, "poses: got names that are empty"),
        ({"poses": {"a": np.zeros((3, 3))}}, r"pose 'a': got shape \(3, 3\); expected shape \(4, 3\)"),
        ({"poses": {"a": np.full((4, 3), np.inf)}}, "pose 'a'.*NaN or infinite"),
        ({"smpl_rest": np.tile(-np.eye(3), (4, 1, 1))}, "smpl_rest.*left-handed frame of joint 'root'"),
    ],
)
def test_bad_additions(changes, words):
    with pytest.raises(InputError, match=words):
        build_rig(replace(make_tube_data(), **changes))
