"""Rigs in NPZ files: bit-exact round trips, the bodies' format, and every way of being broken."""

import gc
import itertools
import json
import warnings
from contextlib import nullcontext
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import make_tube_data, with_joint

from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io import npz_rig
from lbsfit_np.io.npz import npz_keys, read_npz
from lbsfit_np.io.npz_rig import read_body_npz, read_rig_npz, save_rig
from lbsfit_np.io.rigs import load_rig, read_rig_data, rig_for_card
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card, read_card, write_card
from lbsfit_np.rig.card_text import card_text
from lbsfit_np.rig.mirror import mirrored
from lbsfit_np.rig.shapes import ShapeSpace


def assert_same(a, b):
    """Equal in every field, every bit and every type."""
    for field in fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        arrays = [(x.data, y.data), (x.indices, y.indices), (x.indptr, y.indptr)] if sparse.issparse(x) else [(x, y)]
        if field.name == "poses":
            assert list(x) == list(y)
            arrays = list(zip(x.values(), y.values()))
        if isinstance(x, ShapeSpace):
            arrays = [(getattr(x, f.name), getattr(y, f.name)) for f in fields(x)]
        for p, q in arrays:
            if isinstance(p, np.ndarray):
                assert p.dtype == q.dtype and p.shape == q.shape and p.tobytes() == q.tobytes(), field.name
            else:
                assert p == q, field.name
    assert a.digest == b.digest


def furnished(data):
    """With all that a bundled rig has besides: poses, shape parameters, the relation to SMPL."""
    rng = np.random.default_rng(0)
    frames = np.linalg.qr(rng.standard_normal((4, 3, 3)))[0]
    frames *= np.linalg.det(frames)[:, None, None]
    return replace(
        data,
        poses={"ä": rng.standard_normal((4, 3)), "b": np.zeros((4, 3))},
        shapes=ShapeSpace(
            names=("height", "girth"),
            units=("m", ""),
            lower=np.array([0.5, -1.0]),
            upper=np.array([2.0, 1.0]),
            default=np.array([1.0, 0.0]),
            spread=np.array([0.1, 0.5]),
            vertices=rng.standard_normal((2, 242, 3)),
            joints=rng.standard_normal((2, 4, 3)),
        ),
        smpl_rest=frames,
    )


RIGS = {
    "plain": lambda data: build_rig(data),
    "merged, locked, with notes": lambda data: build_rig(
        replace(data, lower=None, upper=None, metres_per_unit=None, up=None, forward=None, notes=["ein Wörtchen"]),
        Card(merge=("short",), lock=("long",), partitions={"ä": {"alles": ("*",)}}, use_parts="ä"),
    ),
    "flat, so that joints are out of the regressor's reach": lambda data: build_rig(
        replace(data, vertices=data.vertices * [1, 1, 0], joints=data.joints + [0, 0, 0.3])
    ),
    "uneven weights": lambda data: build_rig(replace(data, weights=data.weights.toarray() * 1.003)),
    "with seams": lambda data: build_rig(
        replace(
            data,
            vertices=np.vstack([data.vertices, data.vertices[:9]]),
            weights=np.vstack([data.weights.toarray()] + [data.weights.toarray()[:9]]),
        )
    ),
    "furnished": lambda data: build_rig(furnished(data)),
    "furnished, rounded directions": lambda data: build_rig(replace(furnished(data), shapes=furnished(data).shapes.rounded())),
    "furnished, in another unit": lambda data: build_rig(
        replace(furnished(data), shapes=furnished(data).shapes.rounded())
    ).scaled(39.37),
    "a joint locked by itself": lambda data: build_rig(
        replace(data, weights=data.weights.toarray() * [1, 1, 1, 0] + data.weights.toarray()[:, [3]] * [0, 1, 0, 0])
    ),
}


@pytest.mark.parametrize("kind", RIGS)
def test_round_trip_is_exact(tmp_path, kind):
    rig = RIGS[kind](make_tube_data())
    rig.save(tmp_path / "rig.npz")
    again = load_rig(tmp_path / "rig.npz")
    assert_same(rig, again)
    again.save(tmp_path / "again.npz")
    assert (tmp_path / "rig.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_joint_that_a_card_has_freed_stays_free(tmp_path):
    data = replace(
        make_tube_data(), parents=np.array([-1, 0, 1, 1]), joint_names=["world", "arm", "long", "short"], partitions={}
    )
    w = data.weights.toarray()
    data.weights = sparse.csr_array(w[:, [0, 1, 2, 3]] * [0, 1, 1, 1] + w[:, [0]] * [0, 1, 0, 0])  # all hangs on the arm
    assert build_rig(data).locked[1]
    rig = build_rig(data, Card(limits=(("arm", (-1, 0, 0), (1, 0, 0)),)))
    rig.save(tmp_path / "rig.npz")
    assert_same(rig, load_rig(tmp_path / "rig.npz"))


def test_limits_by_name_free_joints_that_the_file_locks(tmp_path):
    """As the note of such joints, which the file keeps, and the text of cards say."""
    data = with_joint(with_joint(make_tube_data(), "world", 0), "tip", 3)
    data = replace(data, parents=np.array([4, 0, 1, 1, -1, 3]))
    rig = build_rig(data, Card(lock=("long",)))
    assert rig.locked.tolist() == [True, False, True, False, False, True]
    rig.save(tmp_path / "rig.npz")
    small = (-0.1,) * 3, (0.1,) * 3

    def locked(*limits, lock=()):
        made = load_rig(tmp_path / "rig.npz", card=Card(limits=tuple((name, *small) for name in limits), lock=lock))
        return [name for name, on in zip(made.joint_names, made.locked) if on], made

    assert locked()[0] == locked("*")[0] == ["root", "long", "tip"]
    names, freed = locked("root", "long")
    assert names == ["tip"] and np.array_equal(freed.upper[[0, 2]], np.full((2, 3), 0.1)) and freed.moving[[0, 2]].all()
    assert any("2 joints locked in the file but free, as limits name them: root, long" in note for note in freed.notes)
    assert locked("root", "long", lock=("long",))[0] == ["long", "tip"]
    names, rig = locked("tip")  # which moves no vertex
    assert names == ["root", "long", "tip"] and any("1 joint locked for moving no vertex: tip" in note for note in rig.notes)
    assert not any("free, as limits name them" in note for note in rig.notes)
    (tmp_path / "card.toml").write_text(card_text(freed))
    again = load_rig(tmp_path / "rig.npz", card=tmp_path / "card.toml")
    np.testing.assert_array_equal(again.locked, freed.locked)
    np.testing.assert_allclose(again.upper, freed.upper)


def test_saved_rig_takes_a_card(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "rig.npz")
    rig = load_rig(tmp_path / "rig.npz", card=Card(lock=("long",), limits=(("short", (0, 0, 0), (1, 0, 0)),)))
    assert rig.locked.tolist() == [False, False, True, False]
    np.testing.assert_array_equal(rig.upper[3], [1, 0, 0])
    np.testing.assert_array_equal(rig.upper[1], tube_rig.upper[1])


def test_file_has_documented_keys_and_no_objects(tmp_path, tube_rig):
    save_rig(tube_rig, tmp_path / "rig.npz")
    table = npz_rig.__doc__.split("=\n")[2].splitlines()
    documented = {key for line in table if line[0] != "=" for key in line[:21].strip().split(", ")}
    assert npz_keys(tmp_path / "rig.npz") == documented
    assert len(documented) == 36
    with np.load(tmp_path / "rig.npz", allow_pickle=False) as file:
        assert file["joint_names"].tolist() == ["root", "elbow", "long", "short"]
        assert file["lbsfit_np_rig"] == 1


def test_rounded_directions_take_two_bytes_a_number(tmp_path):
    data = furnished(make_tube_data())
    exact, rounded = (build_rig(replace(data, shapes=s)) for s in (data.shapes, data.shapes.rounded()))
    for rig, kind in ((exact, "float64"), (rounded, "int16")):
        rig.save(tmp_path / "rig.npz")
        with np.load(tmp_path / "rig.npz", allow_pickle=False) as file:
            assert file["shapes_vertices"].dtype == kind
    assert np.abs(exact.shapes.vertices - rounded.shapes.vertices).max() < np.abs(exact.shapes.vertices).max() / 32767


def test_files_of_before_poses_and_shapes_load(tmp_path, tube_rig):
    later = ("poses_", "shapes_", "smpl_")
    path = changed(tmp_path, tube_rig, **{k: None for k in read_saved(tmp_path, tube_rig) if k.startswith(later)})
    assert_same(load_rig(path), tube_rig)


def read_saved(tmp_path, rig):
    rig.save(tmp_path / "saved.npz")
    return read_npz(tmp_path / "saved.npz")


def test_saving_wants_the_ending_and_a_folder(tmp_path, tube_rig):
    with pytest.raises(FileError, match=r"'\.rig'.*\.npz"):
        tube_rig.save(tmp_path / "a.rig")
    with pytest.raises(FileError, match="nowhere"):
        tube_rig.save(tmp_path / "nowhere" / "a.npz")


def changed(tmp_path, tube_rig, **changes):
    """A saved rig with some arrays changed or (None) left out."""
    tube_rig.save(tmp_path / "good.npz")
    arrays = read_npz(tmp_path / "good.npz") | changes
    path = tmp_path / "bad.npz"
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


BAD = {
    "a newer version": ({"lbsfit_np_rig": np.array(2)}, "version 2.*version 1.*Update"),
    "a version of text": ({"lbsfit_np_rig": np.array("one")}, "'lbsfit_np_rig' of type <U3.*one number"),
    "no lower": ({"lower": None, "notes": None}, "no 'lower', 'notes'.*keys"),
    "text for a name list": ({"joint_names": np.array(3)}, "'joint_names'.*list of texts"),
    "vertices of no shape": ({"vertices": np.array(3.0)}, "'vertices' of type float64 and shape .*2 dimensions"),
    "one name less": ({"joint_names": np.array(["a", "b", "c"])}, "not a sparse matrix of shape|shape"),
    "a name of numbers": ({"name": np.arange(3)}, "'name' of type.*one text"),
    "broken JSON": ({"partitions": np.array("{")}, "'partitions'.*JSON"),
    "a number too long for JSON": ({"partitions": np.array("1" * 5000)}, "'partitions'.*JSON"),
    "another JSON": ({"partitions": np.array(json.dumps({"p": ["root"]}))}, "'partitions' in another form"),
    "weights cut short": ({"weights_data": np.ones(3)}, "'weights' that is not a sparse matrix"),
    "weights of strange columns": (
        {"weights_indices": np.full(10, 99), "weights_data": np.ones(10)},
        "'weights' that is not a sparse matrix",
    ),
    "weights of ints": ({"weights_data": np.arange(3)}, "'weights' that is not a sparse matrix"),
    "row pointers that go back": ({"regressor_indptr": np.array([0, 50, 20, 60, 70])}, "'regressor' that is not a sparse matrix"),
    "faces out of range": ({"faces": np.array([[0, 1, 5000]])}, "faces out of range"),
    "merged of another type": ({"merged": np.zeros(4)}, "merged.*true or false"),
    "root merged": ({"merged": np.array([True, False, False, False])}, "root joint 'root' among the merged"),
    "poses without names": ({"poses_names": None}, "no 'poses_names'.*keys poses_names, poses_theta"),
    "more names than poses": ({"poses_names": np.array(["a"])}, "1 different names.*0 poses.*name for each"),
    "two poses of a name": (
        {"poses_names": np.array(["a", "a"]), "poses_theta": np.zeros((2, 4, 3))},
        "1 different names.*2 poses.*name for each",
    ),
    "poses of other joints": ({"poses_names": np.array(["a"]), "poses_theta": np.zeros((1, 5, 3))}, r"pose 'a': shape \(5, 3\)"),
    "poses of NaN": ({"poses_names": np.array(["a"]), "poses_theta": np.full((1, 4, 3), np.nan)}, "pose 'a'.*NaN"),
    "shapes without names": ({"shapes_names": None}, "no 'shapes_names'"),
    "a step too many": ({"shapes_step": np.ones(1)}, "1 steps.*0 directions"),
    "a parameter without numbers": ({"shapes_names": np.array(["tall"])}, "shapes, units: .*text for each of the 1"),
    "no rotations to SMPL": ({"smpl_rest": np.ones((4, 3, 3))}, "smpl_rest: axes of joint 'root' that are not orthonormal"),
    "rotations of other joints": ({"smpl_rest": np.tile(np.eye(3), (5, 1, 1))}, r"smpl_rest: shape \(5, 3, 3\)"),
    "objects": ({"notes": np.array([{}], dtype=object)}, "Python objects in 'notes'.*plain arrays"),
}


@pytest.mark.parametrize("case", BAD)
def test_broken_own_files(tmp_path, tube_rig, case):
    changes, words = BAD[case]
    with pytest.raises(InputError, match=words):
        load_rig(changed(tmp_path, tube_rig, **changes))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_file(tmp_path, tube_rig, share):
    tube_rig.save(tmp_path / "rig.npz")
    whole = (tmp_path / "rig.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(FileError, match=r"cut\.npz.*broken or not NPZ.*again"):
        load_rig(tmp_path / "cut.npz")


def test_a_file_that_is_no_archive_is_closed(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "rig.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "rig.npz").read_bytes()[:900])
    np.save(tmp_path / "one.npy", np.zeros(3))
    (tmp_path / "one.npy").rename(tmp_path / "one.npz")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for name, read in itertools.product(("rig", "cut", "one"), (read_npz, npz_keys)):
            with nullcontext() if name == "rig" else pytest.raises(FileError):
                read(tmp_path / f"{name}.npz")
        gc.collect()
    assert not told


def test_damaged_file(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "rig.npz")
    damaged = bytearray((tmp_path / "rig.npz").read_bytes())
    for k in range(len(damaged) // 3, len(damaged) // 3 + 40):
        damaged[k] ^= 0xFF
    (tmp_path / "rig.npz").write_bytes(bytes(damaged))
    with pytest.raises(FileError, match="cannot be unpacked"):
        load_rig(tmp_path / "rig.npz")


def test_not_an_npz(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(FileError, match="broken or not NPZ"):
        load_rig(tmp_path / "text.npz")
    np.save(tmp_path / "one.npy", np.zeros(3))
    (tmp_path / "one.npy").rename(tmp_path / "one.npz")
    with pytest.raises(FileError, match="single array"):
        load_rig(tmp_path / "one.npz")


# ---- the bodies' format ----


def body(tmp_path, **changes):
    data = make_tube_data()
    arrays = {
        "verts": np.stack([data.vertices, data.vertices * 1.1]).astype(np.float32),
        "shape_names": np.array(["slim", "tall"]),
        "faces": data.faces.astype(np.int32),
        "weights": data.weights.toarray().astype(np.float32),
        "joints": np.stack([data.joints, data.joints * 1.1]).astype(np.float32),
        "tails": np.stack([data.joints + [0, 0.2, 0.1], data.joints + [0, 0.3, 0]]).astype(np.float32),
        "joint_names": np.array(data.joint_names),
        "parents": data.parents,
    } | changes
    path = tmp_path / "body.npz"
    np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
    return path


def test_body_shapes_by_name_number_and_default(tmp_path):
    path = body(tmp_path)
    slim, tall = load_rig(path), load_rig(path, shape="tall")
    np.testing.assert_allclose(tall.vertices, 1.1 * slim.vertices, rtol=1e-6)
    np.testing.assert_allclose(tall.joints, 1.1 * slim.joints, rtol=1e-6)
    for shape in (1, np.int64(1), "1"):
        np.testing.assert_array_equal(load_rig(path, shape=shape).vertices, tall.vertices)
    assert (slim.metres_per_unit, slim.up, slim.forward) == (1.0, "+y", "+z")
    assert slim.vertices.dtype == float


def test_the_first_of_several_shapes_is_told_where_none_is_asked_for(tmp_path):
    said = "the file has 2 shapes, 'slim', 'tall'; the first is taken (shape=... and --shape take another)"
    assert said in load_rig(body(tmp_path)).notes
    assert said.replace(", 'slim', 'tall'", "") in load_rig(body(tmp_path, shape_names=None)).notes
    assert not any("shapes" in note for note in load_rig(body(tmp_path), shape="slim").notes)
    one = {key: np.load(body(tmp_path))[key][:1] for key in ("verts", "joints", "tails", "shape_names")}
    assert not any("shapes" in note for note in load_rig(body(tmp_path, **one)).notes)


def test_shape_names_are_one_for_each_shape(tmp_path):
    path = body(tmp_path, shape_names=np.array(["slim", "tall", "wide"]))
    for shape in (None, "wide", 0):
        with pytest.raises(FileError, match="3 shape_names for 2 shapes of verts; expected one name for each"):
            load_rig(path, shape=shape)


def test_axes_along_bones_go_by_the_tails(tmp_path):
    """As those of the file do: a card that asks for them changes nothing but the root's, which are the rig's."""
    rig = load_rig(body(tmp_path))
    along = build_rig(read_rig_data(body(tmp_path)), Card(frames=(("*", "bone"),)))
    np.testing.assert_allclose(along.frames[1:], rig.frames[1:], atol=1e-12)
    other = build_rig(mirrored(read_rig_data(body(tmp_path))), Card(frames=(("*", "bone"),)))
    np.testing.assert_allclose(other.frames[:, :, 1], along.frames[:, :, 1] * [-1, 1, 1], atol=1e-12)


@pytest.mark.parametrize(
    "shape", ["tal", 2, -1, 1.5j, "7", 0.9, True, *(pytest.param(n, id="long") for n in ("1" * 5000, 10**5000))]
)
def test_unknown_shape_lists_the_names(tmp_path, shape):
    with pytest.raises(InputError, match=r"shape.*'slim', 'tall'.*0 to 1"):
        load_rig(body(tmp_path), shape=shape)


def test_body_frames_follow_the_bones(tmp_path):
    data = read_body_npz(body(tmp_path))
    np.testing.assert_array_equal(data.frames[0], np.eye(3))  # the root turns about the rig's axes
    np.testing.assert_allclose(data.frames[1:, :, 1], np.tile(np.array([0, 2, 1]) / np.sqrt(5), (3, 1)), atol=1e-6)
    np.testing.assert_allclose(data.frames[1, :, 0], [1, 0, 0], atol=1e-6)
    without = read_body_npz(body(tmp_path, tails=None))
    tip = without.joints[2] - without.joints[1] + without.joints[3] - without.joints[1]
    np.testing.assert_allclose(without.frames[2, :, 1], tip / np.linalg.norm(tip), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"parents": None, "faces": None}, "no 'faces', 'parents'.*keys verts, faces"),
        ({"verts": np.zeros((5, 3))}, r"'verts' of type float64 and shape \(5, 3\).*3 dimensions"),
        ({"verts": np.zeros((1, 5, 2))}, r"'verts' of shape \(1, 5, 2\).*\(shapes, m, 3\)"),
        ({"verts": np.zeros((0, 5, 3))}, "'verts' of shape"),
        ({"joints": np.zeros((1, 4, 3))}, r"'joints' of shape \(1, 4, 3\).*\(2, 4, 3\)"),
        ({"tails": np.zeros((2, 3, 3))}, "'tails' of shape"),
        ({"tails": np.full((2, 4, 3), np.nan)}, "'tails'.*NaN"),
        ({"weights": np.zeros((7, 4))}, "'weights' of shape"),
        ({"weights": np.full((242, 4), "x")}, "'weights'.*numbers"),
        ({"joint_names": np.arange(4)}, "'joint_names'.*list of texts"),
        ({"parents": np.array([-1, 2, 1, 1])}, "cycle"),
        ({"parents": np.array([-1, 0, 1, 9])}, "parent 9 of joint 'short', out of range"),
        ({"parents": np.array([-1, 0])}, "parents"),
        ({"faces": np.array([[0, 1, 242]])}, "faces out of range"),
        ({"joint_names": np.array([{}, 1, 2, 3], dtype=object)}, "Python objects"),
    ],
)
def test_broken_bodies(tmp_path, changes, words):
    with pytest.raises(FileError, match=words):
        load_rig(body(tmp_path, **changes))


def test_names_may_be_bytes(tmp_path):
    assert load_rig(body(tmp_path, joint_names=np.array([b"a", b"b", b"c", b"d"]))).joint_names == ("a", "b", "c", "d")


def test_reading_own_format_checks_nothing_twice(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "rig.npz")
    data = read_rig_npz(tmp_path / "rig.npz")
    assert data.parts == "joints" and data.path == tmp_path / "rig.npz"


@pytest.mark.parametrize("of_file", [[-1, -1, -1, -1], [-1, 0, 1, -1], [3, 0, 1, 1]])
def test_a_written_card_gives_axes_along_the_bones_that_a_body_file_does_not_say(tmp_path, of_file):
    parents, names = make_tube_data().parents, make_tube_data().joint_names
    whole = load_rig(body(tmp_path, tails=None))
    path = body(tmp_path, tails=None, parents=np.array(of_file))
    write_card(rig_for_card(path), tmp_path / "c.toml")
    pairs = tuple((names[k], names[p]) for k, p in enumerate(parents) if p >= 0)  # the guess, put right
    card = replace(read_card(tmp_path / "c.toml"), root=names[0], chains=(), parents=pairs)
    rig = load_rig(path, card=card)
    np.testing.assert_array_equal(rig.parents, whole.parents)
    np.testing.assert_allclose(rig.frames, whole.frames, atol=1e-9)


def test_body_frames_follow_the_axes_of_a_card(tmp_path):
    """Of a body that stands along z the same joints bend about the same axes of the body."""
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    upright, data = load_rig(body(tmp_path)), dict(np.load(body(tmp_path)))
    along_z = body(tmp_path, **{key: data[key] @ turn.T for key in ("verts", "joints", "tails")})
    frames = load_rig(along_z, card=Card(up="+z", forward="-y")).frames
    np.testing.assert_allclose(frames[1:], turn @ upright.frames[1:], atol=1e-6)
    np.testing.assert_array_equal(frames[0], np.eye(3))
