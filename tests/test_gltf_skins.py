"""The joints of glTF files, and the choice among several skins."""

import numpy as np
import pytest
from gltf_files import (
    ARM,
    check_arm,
    save,
    trs,
    write_arm,
)

from lbsfit_np.errors import InputError
from lbsfit_np.io.gltf import read_gltf
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card_text import card_text


def test_children_before_parents(tmp_path):
    data = read_gltf(save(write_arm(ARM, order=[3, 4, 2, 0, 1]), tmp_path))
    assert data.joint_names == list(ARM.names) and np.array_equal(data.parents, ARM.parents)
    assert data.notes == []  # the nodes stand in the bind pose
    check_arm(data, np.eye(4))


def test_the_skins_own_order_is_kept(tmp_path):
    writer = write_arm(ARM)
    order = np.array([3, 1, 4, 0, 2])
    writer.json["skins"][0]["joints"] = order.tolist()
    writer.json["skins"][0]["inverseBindMatrices"] = writer.accessor(np.linalg.inv(ARM.matrices[order]))
    data = read_gltf(save(writer, tmp_path))
    assert data.joint_names == [ARM.names[j] for j in order]
    assert np.array_equal(data.parents, [4, 3, 1, -1, 1])
    assert np.allclose(data.joints, ARM.matrices[order, :3, 3], atol=1e-6)


def test_nodes_between_joints_and_several_roots(tmp_path):
    writer = write_arm(ARM)
    nodes = writer.json["nodes"]
    inserted = writer.add("nodes", name="helper", children=[2])  # between upper and lower
    nodes[1]["children"] = [inserted, 4]
    nodes[0].pop("children")
    top = next(n for n in nodes if n.get("name") == "Armature")
    top["children"].append(1)  # upper hangs on the armature: a second root
    nodes[1].update(trs(ARM.matrices[1]))
    data = read_gltf(save(writer, tmp_path))
    assert np.array_equal(data.parents, [-1, -1, 1, 2, 1])
    check_arm(data, np.eye(4))


def test_joint_names_are_made_unique(tmp_path):
    writer = write_arm(ARM)
    nodes = writer.json["nodes"]
    nodes[1]["name"] = nodes[2]["name"] = "bone"
    nodes[3]["name"] = "bone#2"
    nodes[4].pop("name")
    nodes[0]["name"] = "node4"
    data = read_gltf(save(writer, tmp_path))
    assert data.joint_names == ["node4", "bone", "bone#3", "bone#2", "node4#2"]
    assert "without a name" in data.notes[0] and "bone#3" in data.notes[1]


def test_halves_of_characters_and_nul_in_names_are_replaced(tmp_path):
    """JSON allows them, and nothing else: a rig with them has no digest, or cannot be saved, and no card can name its joints."""
    writer = write_arm(ARM)
    writer.json["nodes"][1]["name"], writer.json["nodes"][2]["name"] = "arm\ud83d", "arm\0"
    writer.json["nodes"][3]["name"], writer.json["skins"][0]["name"] = "tip \U0001f600", "skin\ud83d"
    rig = build_rig(read_gltf(save(writer, tmp_path)))
    assert rig.joint_names == ("root", "arm\ufffd", "arm\ufffd#2", "tip \U0001f600", "side")
    assert rig.notes[0] == "2 joint(s) with \ufffd in the name, for what is no character: arm\ufffd, arm\ufffd#2"
    assert "made unique by a number: arm\ufffd#2" in rig.notes[1]
    assert len(rig.digest) == 64 and '"arm\ufffd#2"' in card_text(rig)
    with pytest.raises(InputError, match="0 \\('skin\ufffd'\\)"):
        read_gltf(save(writer, tmp_path), skin=3)


# ---- several skins ----


def two_skins(tmp_path, both_used=True, names=("arm", "other"), scene=(6, 7)):
    writer = write_arm(ARM)
    skin = dict(writer.json["skins"][0])
    writer.json["skins"] = [{**skin, "name": names[0]}, {**skin, "joints": skin["joints"][::-1], "name": names[1]}]
    matrices = np.linalg.inv(ARM.matrices)[::-1]
    writer.json["skins"][1]["inverseBindMatrices"] = writer.accessor(matrices)
    if both_used:
        writer.add("nodes", name="Second", mesh=0, skin=1)
    writer.json["scenes"][0]["nodes"] = [i for i in scene if i < len(writer.json["nodes"])]
    return save(writer, tmp_path)


def test_skin_by_name_or_index(tmp_path):
    path = two_skins(tmp_path)
    for choice, first in (("arm", "root"), (0, "root"), ("0", "root"), ("other", "side"), (1, "side"), (np.int64(1), "side")):
        assert read_gltf(path, skin=choice).joint_names[0] == first
    assert "several skins" in read_gltf(path, skin=0).notes[0]


def test_the_one_skin_in_use_needs_no_choice(tmp_path):
    assert read_gltf(two_skins(tmp_path, both_used=False)).joint_names[0] == "root"


@pytest.mark.parametrize(
    "choice, names, words",
    [
        (None, ("arm", "other"), ["skin", "no choice", "0 ('arm'), 1 ('other')"]),
        ("leg", ("arm", "other"), ["skin", "'leg'", "'arm'", "'other'"]),
        (2, ("arm", "other"), ["skin", "2", "'arm'"]),
        (True, ("arm", "other"), ["skin", "True"]),
        pytest.param("1" * 5000, ("arm", "other"), ["skin", "…", "'arm'"], id="long text"),
        pytest.param(10**5000, ("arm", "other"), ["skin", "several thousand digits"], id="long number"),
        ("arm", ("arm", "arm"), ["the name of 2 skins", "index"]),
    ],
)
def test_bad_choice_of_skin(tmp_path, choice, names, words):
    with pytest.raises(InputError) as error:
        read_gltf(two_skins(tmp_path, names=names), skin=choice)
    assert error.value.argument == "skin"
    assert all(w in str(error.value) for w in words)


def test_a_skin_that_no_mesh_uses_cannot_be_chosen(tmp_path):
    with pytest.raises(InputError, match="No mesh uses 'other'"):
        read_gltf(two_skins(tmp_path, both_used=False), skin="other")


@pytest.mark.parametrize(("scene", "first", "hidden"), [([6], "root", "'Second'"), ([7], "side", "'Mesh'")])
def test_a_skin_outside_the_scene_has_to_be_asked_for(tmp_path, scene, first, hidden):
    path = two_skins(tmp_path, scene=scene)
    data = read_gltf(path)
    assert data.joint_names[0] == first
    assert data.notes[0] == f"1 skinned mesh(es) outside the file's scene left out: {hidden}"
    assert [read_gltf(path, skin=s).joint_names[0] for s in (0, "other")] == ["root", "side"]
    with pytest.raises(InputError, match="no choice"):
        read_gltf(two_skins(tmp_path, scene=[]))
