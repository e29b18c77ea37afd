"""The card applied by build_rig: hierarchy, merged and locked joints, limits, partitions, unit and axes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from small_rigs import NAMES, make_tube_data, with_joint

from lbsfit_np.errors import InputError
from lbsfit_np.io.rigs import load_rig
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card


def test_card_gives_a_hierarchy_to_loose_joints():
    loose = replace(make_tube_data(), parents=np.full(4, -1))
    card = Card(root="root", chains=(("root", "elbow", "long"), ("elbow", "short")))
    np.testing.assert_array_equal(build_rig(loose, card).parents, [-1, 0, 1, 1])
    by_table = Card(parents=(("elbow", "root"), ("*", "elbow")), root="root")  # the glob matches its own parent, too
    np.testing.assert_array_equal(build_rig(loose, by_table).parents, [-1, 0, 1, 1])
    gives_way = replace(card, parents=(("elbow", "root"), ("*", "root")))
    np.testing.assert_array_equal(build_rig(loose, gives_way).parents, [-1, 0, 1, 1])
    for order in (1, -1):  # a name is meant where a glob matches it, too
        both = Card(parents=(("short", "elbow"), ("long", "elbow"), ("*", "root"))[::order], root="root")
        np.testing.assert_array_equal(build_rig(loose, both).parents, [-1, 0, 1, 1])


def test_card_can_change_the_root():
    card = Card(root="elbow", parents=(("root", "elbow"),))
    rig = build_rig(make_tube_data(), card)
    assert rig.joint_names[rig.root] == "elbow"
    assert (rig.pose(np.zeros((4, 3))) == rig.vertices).all()


@pytest.mark.parametrize(
    ("card", "words"),
    [
        (Card(chains=(("root", "elbow"),)), r"3 root joints: root, long, short.*card's \[hierarchy\]"),
        (Card(chains=(("root", "elbow"), ("long", "elbow"))), r"\[hierarchy\].*two parents for joint 'elbow': 'root' and 'long'"),
        (Card(parents=(("elbow", "long"),), chains=(("root", "elbow"),)), "two parents for joint 'elbow': 'long' and 'root'"),
        (Card(parents=(("elbow", "long"), ("elbow", "root"))), "two parents for joint 'elbow': 'long' and 'root'"),
        (Card(root="elbow", chains=(("root", "elbow"),)), "the root 'elbow' as a child of 'root'"),
        (Card(root="elbow", parents=(("elbow", "root"),)), "the root 'elbow' as a child of 'root'.*nor parents put below"),
        (Card(chains=(("root", "elbw"),)), r"\[hierarchy\].*'elbw'.*no joint.*Did you mean 'elbow'"),
        (Card(chains=(("root", "elbow", "long", "root"),)), "cycle"),
        (Card(chains=(("root", "*o*"),)), "matches 4 joints.*one joint"),
        (Card(parents=(("short", "*o*"),)), r"\[hierarchy\]: got '\*o\*', which matches 4 joints.*one joint"),
    ],
)
def test_card_hierarchy_errors(card, words):
    with pytest.raises(InputError, match=words):
        build_rig(replace(make_tube_data(), parents=np.full(4, -1)), card)


def test_merging_moves_weights_up_and_keeps_the_rest_shape(tube_rig):
    data = make_tube_data()
    rig = build_rig(data, Card(merge=("long", "elbow")))
    w = data.weights.toarray()
    np.testing.assert_allclose(
        rig.weights.toarray(), np.stack([w[:, 0] + w[:, 1] + w[:, 2], 0 * w[:, 1], 0 * w[:, 2], w[:, 3]], axis=1)
    )
    assert rig.joint_names == NAMES
    np.testing.assert_array_equal(rig.merged, [False, True, True, False])
    np.testing.assert_array_equal(rig.moving, [True, False, False, True])
    assert (rig.lower[1:3] == 0).all() and (rig.upper[1:3] == 0).all()
    assert (rig.pose(np.zeros((4, 3))) == rig.vertices).all()
    assert rig.parts == ("root", "short")
    assert any("2 joints merged into parents" in note and "elbow, long" in note for note in rig.notes)
    # a merged joint moves as if it were stiff
    theta = np.zeros((4, 3))
    theta[[0, 3]] = [[0.3, 0.2, -0.5], [0.7, 0.1, 0.0]]
    np.testing.assert_allclose(rig.pose(theta), tube_rig.pose(theta), atol=1e-12)


@pytest.mark.parametrize(("most", "asked"), [(0.014, True), (0.1, False)])
def test_limits_that_hardly_let_anything_turn_are_asked_about(most, asked):
    """As of a card in radians that says degrees."""
    rig = build_rig(make_tube_data(), Card(limits=(("*", (-most,) * 3, (most,) * 3),)))
    assert any("are these radians, with unit = \"deg\"?" in note for note in rig.notes) == asked
    one = build_rig(make_tube_data(), Card(limits=(("long", (-most,) * 3, (most,) * 3),)))
    assert not any("are these radians" in note for note in one.notes)


def test_locked_joints_keep_their_skin_and_never_turn():
    rig = build_rig(make_tube_data(), Card(lock=("sh?rt",)))
    np.testing.assert_array_equal(rig.locked, [False, False, False, True])
    np.testing.assert_array_equal(rig.weights.toarray(), make_tube_data().weights.toarray())
    assert (rig.lower[3] == 0).all()
    assert rig.parts == ("root", "elbow", "long")
    assert any("1 joint locked: short" in note for note in rig.notes)
    both = build_rig(make_tube_data(), Card(lock=("short", "long"), merge=("short",)))
    assert both.locked.tolist() == [False, False, True, False] and both.merged.tolist() == [False, False, False, True]


def test_limits_of_a_joint_that_stays_still_are_noted():
    card = Card(lock=("long",), limits=(("*", (-1, -1, -1), (1, 1, 1)), ("long", (-1, 0, 0), (1, 0, 0))), path="a.toml")
    notes = [note for note in build_rig(make_tube_data(), card).notes if "no effect" in note]
    no_effect = "card a.toml, [limits]: limits of 'long' have no effect, because that joint is "
    assert notes == [f"{no_effect}locked ([lock], or it moves no vertex)"]
    merged = build_rig(make_tube_data(), replace(card, lock=(), merge=("long",))).notes
    assert [note for note in merged if "no effect" in note] == [f"{no_effect}merged"]
    assert not any("no effect" in note for note in build_rig(make_tube_data(), replace(card, lock=())).notes)
    globs = replace(card, limits=(("lon*", (-1, 0, 0), (1, 0, 0)),))  # which mean no joint in particular
    assert not any("no effect" in note for note in build_rig(make_tube_data(), globs).notes)


@pytest.mark.parametrize("field", ["merge", "lock"])
def test_root_cannot_be_merged_or_locked(field):
    with pytest.raises(InputError, match="root joint 'root'"):
        build_rig(make_tube_data(), Card(**{field: ("*",)}))


@pytest.mark.parametrize("field", ["merge", "lock", "limits", "frames"])
def test_card_names_a_joint_that_is_not_there(field):
    value = {
        "merge": ("elbwo",),
        "lock": ("elbwo",),
        "limits": (("elbwo", (0, 0, 0), (1, 1, 1)),),
        "frames": (("elbwo", "rig"),),
    }[field]
    with pytest.raises(InputError, match=rf"\[{field}\].*'elbwo', which is no joint.*Did you mean 'elbow'"):
        build_rig(make_tube_data(), Card(**{field: value}))


def test_later_limits_override_earlier_ones():
    card = Card(limits=(("*", (-1, -1, -1), (1, 1, 1)), ("long", (-2, 0, 0), (0.5, 0, 0))))
    rig = build_rig(replace(make_tube_data(), lower=None, upper=None), card)
    np.testing.assert_array_equal(rig.lower[2], [-2, 0, 0])
    np.testing.assert_array_equal(rig.upper[1], [1, 1, 1])
    assert not any("limits" in note for note in rig.notes)


def test_card_partition_expands_globs():
    card = Card(partitions={"tips": {"hand": ("*o*w", "root"), "tips": ("long", "sh*")}}, use_parts="tips")
    rig = build_rig(make_tube_data(), card)
    assert rig.parts == ("hand", "tips")
    assert rig.partitions["tips"] == {"hand": ("root", "elbow"), "tips": ("long", "short")}
    twice = Card(partitions={"p": {"a": ("*",), "b": ("long",)}})
    with pytest.raises(InputError, match="'long' in both 'a' and 'b'"):
        build_rig(make_tube_data(), twice)
    with pytest.raises(InputError, match="use_parts.*'nails'"):
        build_rig(make_tube_data(), Card(use_parts="nails"))


def test_axes_of_a_card_that_contradict_each_other_name_the_card(tmp_path):
    (tmp_path / "odd.toml").write_text("[rig]\nup = '+z'\nforward = '+z'\n")
    with pytest.raises(InputError, match=r"forward: got \+z, along the up axis .*See card .*odd\.toml"):
        build_rig(make_tube_data(), tmp_path / "odd.toml")


def test_unit_and_axes_of_the_card_win_and_unknown_ones_are_noted():
    rig = build_rig(make_tube_data(), Card(metres_per_unit=0.01, up="+z", forward="-y"))
    assert (rig.metres_per_unit, rig.up, rig.forward) == (0.01, "+z", "-y")
    assert any("0.00985 m long" in note for note in rig.notes)
    unknown = build_rig(replace(make_tube_data(), metres_per_unit=None, up=None))
    assert any("unknown: unit, up axis" in note for note in unknown.notes)


def test_notes_of_a_saved_rig_that_a_card_answers_are_gone(tmp_path):
    data = with_joint(make_tube_data(), "tip", 3)
    joints, weights = data.joints.copy(), data.weights.toarray()
    joints[2, 0] += 10.0
    weights[:, 1] += 0.9 * weights[:, 3]
    weights[:, 3] *= 0.1
    data = replace(
        data,
        joints=joints,
        weights=sparse.csr_array(weights),
        metres_per_unit=100.0,
        up=None,
        forward=None,
        partitions={"own": {"nail": ("short",), "rest": ("root", "elbow", "long", "tip")}},
        notes=["made by hand"],
    )
    rig = build_rig(data)
    rig.save(tmp_path / "rig.npz")
    assert load_rig(tmp_path / "rig.npz").notes == rig.notes
    words = {
        "1 joint with weight outside the mesh, by up to",
        "the rig is 98.5 m long if its unit is 100 m",
        "unknown: up axis, forward axis (can be set in a card's [rig])",
        "1 joint without weight: tip",
        "1 moving joint without a part, as no vertex belongs mostly to any: short",
        "partition 'own': no vertex belongs mostly to nail",
    }

    def said(notes):
        return {what for what in words if any(note.startswith(what) for note in notes)}

    assert said(rig.notes) == words
    card = Card(metres_per_unit=1.0, up="+y", merge=("tip", "short", "long"), partitions={"own": {"all": ("*",)}})
    notes = load_rig(tmp_path / "rig.npz", card=card).notes
    assert not said(notes) and "unknown: forward axis (can be set in a card's [rig])" in notes
    assert notes[0] == "made by hand" and any(note.startswith("3 joints merged into parents") for note in notes)
    whole = load_rig(tmp_path / "rig.npz", card=Card(up="+y", forward="+z")).notes
    assert said(whole) == {what for what in words if not what.startswith("unknown")} and not any("unknown" in n for n in whole)
