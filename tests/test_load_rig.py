"""load_rig: picks the reader, finds cards and bundled rigs; all rigs of the shared folder load."""

from itertools import pairwise

import numpy as np
import pytest

import lbsfit_np
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.io import rigs
from lbsfit_np.io.npz import read_npz
from lbsfit_np.io.rigs import bundled_rigs, load_rig, read_rig_data, rig_for_card
from lbsfit_np.rig.card import write_card
from lbsfit_np.rig.data import RigData
from lbsfit_np.rig.describe import describe

CARDS = rigs.Path(lbsfit_np.__file__).parent / "bench" / "cards"


# ---- finding the file ----


@pytest.fixture
def two_bundled(tmp_path, monkeypatch, tube_rig):
    folder = tmp_path / "bundled"
    folder.mkdir()
    for name in ("tube", "other"):
        tube_rig.save(folder / f"{name}.npz")
    monkeypatch.setattr(rigs, "bundled_files", lambda pattern: {p.stem: p for p in folder.glob(pattern)})


def test_bundled_rigs_by_name(two_bundled, tube_rig):
    assert bundled_rigs() == ["other", "tube"]
    np.testing.assert_array_equal(load_rig("tube").vertices, tube_rig.vertices)


def test_a_file_comes_before_a_bundled_name(two_bundled, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tube").write_text("no rig")
    with pytest.raises(FileError, match="without an ending"):
        load_rig("tube")


@pytest.mark.parametrize(("name", "hint"), [("tub", "Did you mean 'tube'"), ("folder/tube", ""), ("nowhere.glb", "")])
def test_unknown_name_lists_the_bundled_ones(two_bundled, name, hint):
    with pytest.raises(FileError, match=rf"{name}: got no such file.*bundled rig: other, tube.*{hint}"):
        load_rig(name)


def test_every_bundled_rig_loads():
    for name in bundled_rigs():
        rig = load_rig(name)
        assert np.abs(rig.regressor @ rig.vertices - rig.joints).max() < 1e-9 * rig.size


def test_wrong_kinds_of_files(tmp_path):
    (tmp_path / "rig.fbx").write_text("x")
    with pytest.raises(FileError, match=r"'\.fbx'.*\.npz, \.glb.*glTF"):
        load_rig(tmp_path / "rig.fbx")
    with pytest.raises(FileError, match="a folder"):
        load_rig(tmp_path)
    with pytest.raises(InputError, match="path_or_name: got int"):
        load_rig(3)
    with pytest.raises(InputError, match="path_or_name: got an empty text"):
        load_rig("")
    (tmp_path / "scan.ply").write_text("x")
    with pytest.raises(FileError, match=r"'\.ply'.*glTF.*If this is a scan, give the rig before the scans"):
        load_rig(tmp_path / "scan.ply")
    with pytest.raises(InputError, match="path: got a int; expected the path of an NPZ file"):
        read_npz(3)
    np.savez(tmp_path / "cloud.npz", points=np.zeros((4, 3)))
    with pytest.raises(FileError, match="an NPZ with points; expected a rig.*lbsfit_np_rig.*v_template.*verts"):
        load_rig(tmp_path / "cloud.npz")


def test_options_of_other_formats_are_refused(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "rig.npz")
    with pytest.raises(InputError, match="shape: got 'tall'.*holds only one"):
        load_rig(tmp_path / "rig.npz", shape="tall")
    with pytest.raises(InputError, match="skin: got 'body'.*not a glTF"):
        load_rig(tmp_path / "rig.npz", skin="body")


def test_smpl_files_go_to_their_reader(tmp_path, monkeypatch):
    class Reader:
        read_smpl = staticmethod(lambda path: ("smpl", path))

    monkeypatch.setattr(rigs, "_reader", lambda module: {"smpl": Reader}[module])
    np.savez(tmp_path / "m.npz", v_template=np.zeros((4, 3)))
    (tmp_path / "m.PKL").write_bytes(b"")
    assert read_rig_data(tmp_path / "m.npz")[0] == "smpl"
    assert read_rig_data(tmp_path / "m.PKL")[0] == "smpl"


def test_gltf_files_go_to_their_reader(tmp_path, monkeypatch):
    class Reader:
        read_gltf = staticmethod(lambda path, skin: (path, skin))

    monkeypatch.setattr(rigs, "_reader", lambda module: {"gltf": Reader}[module])
    for ending in (".glb", ".gltf", ".GLB"):
        path = tmp_path / f"m{ending}"
        path.write_bytes(b"")
        assert read_rig_data(path, skin="s") == (path, "s")


# ---- cards ----


def test_card_beside_the_file_is_used(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "arm.npz")
    (tmp_path / "arm.card.toml").write_text('[lock]\njoints = ["long"]\n')
    (tmp_path / "other.toml").write_text('[lock]\njoints = ["short"]\n')
    beside = load_rig(tmp_path / "arm.npz")
    assert beside.locked.tolist() == [False, False, True, False]
    assert any("arm.card.toml" in note for note in beside.notes)
    assert not load_rig(tmp_path / "arm.npz", card="none").locked.any()
    assert load_rig(tmp_path / "arm.npz", card=tmp_path / "other.toml").locked.tolist() == [False, False, False, True]
    assert load_rig(tmp_path / "arm.npz", card=str(tmp_path / "other.toml"), parts="arm and fingers").parts == ("arm", "fingers")


def test_missing_card_is_an_error(tmp_path, tube_rig):
    tube_rig.save(tmp_path / "arm.npz")
    with pytest.raises(FileError, match=r"nope\.toml.*no such file"):
        load_rig(tmp_path / "arm.npz", card="nope.toml")


def test_public_name():
    assert lbsfit_np.load_rig is load_rig


# ---- the real rigs ----

REAL = {
    "webxr_left": ("webxr_hand/left.glb", {}, 1360, 1159, 25, 16),
    "mpfb2_cmu_mb": ("mpfb2_body/mpfb2_cmu_mb.npz", {}, 13380, 13380, 31, 19),
    "mpfb2_mixamo": ("mpfb2_body/mpfb2_mixamo.npz", {"normalize_weights": True}, 13380, 13380, 52, 19),
    "mpfb2_default": ("mpfb2_body/mpfb2_default.npz", {}, 13380, 13380, 163, 19),
    "fox": ("fox/Fox.glb", {}, 1728, 290, 24, 22),
}


@pytest.fixture(scope="module")
def real(shared_rigs):
    loaded = {}

    def load(name):
        if name not in loaded:
            file, options, *_ = REAL[name]
            if file.endswith(".glb"):
                pytest.importorskip("lbsfit_np.io.gltf")
            loaded[name] = load_rig(shared_rigs / file, card=CARDS / f"{name}.toml", **options)
        return loaded[name]

    return load


@pytest.mark.parametrize("name", REAL)
def test_real_rigs_load_with_their_cards(real, name):
    rig = real(name)
    _, _, m, distinct, J, moving = REAL[name]
    assert (len(rig.vertices), len(rig.welded.vertices), len(rig.parents), rig.moving.sum()) == (m, distinct, J, moving)
    assert (rig.pose(np.zeros((J, 3))) == rig.vertices).all()
    assert (rig.welded.pose(np.zeros((J, 3))) == rig.welded.vertices).all()
    for r in (rig, rig.welded):
        assert np.abs(r.regressor @ r.vertices - r.joints).max() < 1e-9 * r.size
        assert np.abs(r.weights.sum(axis=1) - 1).max() < 1e-12
    assert (rig.up, rig.forward) == ("+y", "+z")
    assert not any("limits" in note or "open" in note or "manifold" in note for note in rig.notes)
    assert rig.joint_names[rig.root] in describe(rig)


@pytest.mark.parametrize("name", REAL)
def test_real_rigs_round_trip(real, name, tmp_path):
    from test_rig_npz import assert_same

    real(name).save(tmp_path / "rig.npz")
    assert_same(real(name), load_rig(tmp_path / "rig.npz"))


@pytest.mark.parametrize("name", REAL)
def test_real_rigs_partitions(real, name):
    rig = real(name)
    assert set(rig.parts) <= {rig.joint_names[j] for j in np.flatnonzero(rig.moving)}
    (coarse,) = rig.partitions
    fewer = rig.with_parts(coarse)
    assert fewer.parts == tuple(rig.partitions[coarse])  # each leads some vertices
    # each fine part lies in one coarse part
    for part in range(len(rig.parts)):
        assert len(np.unique(fewer.vertex_labels[rig.vertex_labels == part])) == 1


def test_left_hand_says_what_limits_toml_says(real, shared_rigs):
    import tomllib
    from fnmatch import fnmatchcase

    rig = real("webxr_left")
    told = tomllib.loads((shared_rigs / "webxr_hand" / "limits.toml").read_text())
    for j, name in enumerate(rig.joint_names):
        merged = any(fnmatchcase(name, pattern) for pattern in told["merge"]["into_parent"])
        assert rig.merged[j] == merged
        limits = [pair for pattern, pair in told["limits"].items() if fnmatchcase(name, pattern) and not merged]
        np.testing.assert_array_equal([rig.lower[j], rig.upper[j]], limits[-1] if limits else np.zeros((2, 3)))
    assert len(rig.parts) == 16
    # -z points to the next joint of the finger
    for finger in ("index", "middle", "ring", "pinky"):
        rows = [rig.joint_names.index(f"{finger}-finger-phalanx-{bone}") for bone in ("proximal", "intermediate", "distal")]
        for near, far in pairwise(rows):
            assert rig.parents[far] == near
            bone = rig.joints[far] - rig.joints[near]
            assert -rig.frames[near, :, 2] @ bone > 0.95 * np.linalg.norm(bone)


def test_left_hand_needs_a_card(shared_rigs):
    pytest.importorskip("lbsfit_np.io.gltf")
    with pytest.raises(FileError, match=r"25 root joints: .* and 17 more.*lbsfit rig card"):
        load_rig(shared_rigs / "webxr_hand" / "left.glb")


def test_guessed_card_of_the_left_hand_is_its_hierarchy(shared_rigs, real, tmp_path):
    pytest.importorskip("lbsfit_np.io.gltf")
    file = shared_rigs / "webxr_hand" / "left.glb"
    source = rig_for_card(file)
    assert isinstance(source, RigData)
    write_card(source, tmp_path / "hand.toml")
    rig = load_rig(file, card=tmp_path / "hand.toml")
    np.testing.assert_array_equal(rig.parents, real("webxr_left").parents)
    assert {name for name, locked in zip(rig.joint_names, rig.locked) if locked} == {
        n for n in rig.joint_names if n.endswith("-tip")
    }


def test_mixamo_weights_are_refused_unless_asked(shared_rigs):
    with pytest.raises(FileError, match=r"5915 of 13380 weight rows.*0\.2 to 1\.498.*normalize"):
        load_rig(shared_rigs / "mpfb2_body" / "mpfb2_mixamo.npz")


def test_a_card_of_such_a_rig_can_be_written(shared_rigs, real, tmp_path):
    file = shared_rigs / "mpfb2_body" / "mpfb2_mixamo.npz"
    write_card(rig_for_card(file), tmp_path / "c.toml")
    rig = load_rig(file, card=tmp_path / "c.toml", normalize_weights=True)
    np.testing.assert_array_equal(rig.parents, real("mpfb2_mixamo").parents)
    assert any("2 moving joints without a part, as no vertex" in note for note in real("mpfb2_mixamo").notes)


def test_fox_limits_come_from_its_animations(shared_rigs):
    pytest.importorskip("lbsfit_np.io.gltf")
    rig = load_rig(shared_rigs / "fox" / "Fox.glb")
    assert any("from the animations with a margin for 19" in note for note in rig.notes)
    assert any("154 m long" in note or "155 m long" in note for note in rig.notes)
    elbow = rig.joint_names.index("b_LeftForeArm_010")
    assert rig.upper[elbow, 2] > 1.6 and rig.upper[elbow, 0] == pytest.approx(0.1, abs=0.01)


def test_motion_stays_inside_the_bodys_limits(real, shared_rigs):
    retarget = pytest.importorskip("lbsfit_np.bench.retarget")
    from lbsfit_np.io.bvh import read_bvh

    rig = real("mpfb2_cmu_mb")
    theta = retarget.bvh_thetas(rig, read_bvh(shared_rigs / "motion" / "01_01.bvh"), range(0, 2752, 8))
    assert np.abs(retarget.limit_excess(rig, theta)).max() == 0.0


@pytest.mark.parametrize("name", ["a" * 300 + ".npz", "a\0b.npz", "a" * 300, "a\0b"])
def test_names_that_cannot_be(name):
    with pytest.raises(FileError, match="no such file"):
        load_rig(name)


def test_a_name_too_long_for_a_card_beside_it_has_none(tmp_path, tube_rig):
    path = tmp_path / ("r" * 250 + ".npz")
    tube_rig.save(path)
    assert load_rig(path).digest == tube_rig.digest


@pytest.mark.parametrize("name", ["hand-left-coarse", "hand-coarse"])
def test_a_bundled_rig_by_a_path_object(name):
    assert load_rig(rigs.Path(name)).digest == load_rig(name).digest
