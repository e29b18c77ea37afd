"""Rig cards: reading, writing, and an error for everything that a person can mistype."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_rigs import make_tube_data

import lbsfit_np
from lbsfit_np.errors import FileError, InputError
from lbsfit_np.rig.build import build_rig
from lbsfit_np.rig.card import Card, card_text, matching, read_card, write_card
from lbsfit_np.rig.card_text import guessed_chains
from lbsfit_np.rotations import matrix_from_rotvec

FULL = """
[rig]
unit = "cm"
up = "+z"
forward = "-y"
use_parts = "fingers"

[hierarchy]
root = "root"
chains = [["root", "elbow", "long"], ["elbow", "short"]]
parents = { "l*" = "elbow" }

[merge]
into_parent = ["short"]

[lock]
joints = ["lo?g"]

[frames]
"*" = "bone"
"root" = "rig"

[limits]
unit = "deg"
"*" = [[-90, -45, 0], [90, 45, 0]]
"elbow" = [[0.0, 0.0, 0.0], [180, 0.0, 0.0]]

[parts.fingers]
arm = ["root", "elbow"]
finger = ["long", "short"]
"""


@pytest.fixture
def card_file(tmp_path):
    def write(text):
        path = tmp_path / "rig.card.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_everything_a_card_can_say(card_file):
    card = read_card(card_file(FULL))
    assert (card.metres_per_unit, card.up, card.forward, card.use_parts) == (0.01, "+z", "-y", "fingers")
    assert (card.root, card.chains) == ("root", (("root", "elbow", "long"), ("elbow", "short")))
    assert (card.parents, card.merge, card.lock) == ((("l*", "elbow"),), ("short",), ("lo?g",))
    assert card.frames == (("*", "bone"), ("root", "rig"))
    assert [name for name, *_ in card.limits] == ["*", "elbow"]
    np.testing.assert_allclose(card.limits[0][1], [-np.pi / 2, -np.pi / 4, 0])
    np.testing.assert_allclose(card.limits[1][2], [np.pi, 0, 0])
    assert card.partitions == {"fingers": {"arm": ("root", "elbow"), "finger": ("long", "short")}}
    rig = build_rig(replace(make_tube_data(), parents=np.full(4, -1)), card_file(FULL))
    assert rig.parts == ("arm", "finger")
    assert rig.upper[1, 0] == pytest.approx(np.pi)


def test_empty_card_says_nothing(card_file):
    card = read_card(card_file("# nothing\n"))
    assert replace(card, path=None) == Card()


def test_byte_order_mark_is_read_past(card_file):
    assert read_card(card_file("\ufeff[rig]\nup = '+y'\n")).up == "+y"


@pytest.mark.parametrize(("unit", "metres"), [('"mm"', 0.001), ('"in"', 0.0254), ("0.3", 0.3), ("2", 2.0)])
def test_units(card_file, unit, metres):
    assert read_card(card_file(f"[rig]\nunit = {unit}")).metres_per_unit == metres


BAD = {
    "broken TOML": ("[rig]\nup = +y\n", r"not TOML.*line 2"),
    "names without quotes": ("[limits]\n*-tip = 1", "not TOML.*line 2.*in quotes"),
    "key twice": ("[rig]\nup = '+y'\nup = '+z'\n", "not TOML.*line 3.*Keep one of the lines or tables of that name"),
    "table twice": ("[rig]\n[lock]\n[rig]\n", "not TOML.*line 3.*Keep one"),
    "name twice in a line": ('[hierarchy]\nparents = { "a" = "b", "a" = "c" }', "not TOML.*Keep one"),
    "bracket left open": ("[rig\n", r"not TOML: Expected.*line 1, column 5\); expected a rig card in TOML.$"),
    "unknown table": ("[limit]\nx = 1", r"unknown table 'limit'.*rig, hierarchy.*Did you mean 'limits'"),
    "unknown key": ("[merge]\nin_parent = []", r"unknown key 'in_parent' in \[merge\].*Did you mean 'into_parent'"),
    "a value for a table": ("limits = 3", r"limits = 3.*a table, written \[limits\]"),
    "unknown unit": ("[rig]\nunit = 'yard'", "unit = 'yard'.*'m', 'cm'"),
    "unit 0": ("[rig]\nunit = 0", "unit = 0; .*, above 0"),
    "boolean unit": ("[rig]\nunit = true", "unit = True"),
    "unit NaN": ("[rig]\nunit = nan", "unit = nan"),
    "unit beyond double precision": ("[rig]\nunit = 1" + "0" * 400, r"unit = 10+….*metres in one unit"),
    "unit of too many digits": ("[rig]\nunit = " + "1" * 5000, "a number of several thousand digits.*rig card"),
    "unit of too many digits for text": ("[rig]\nunit = 0x" + "f" * 5000, "unit = a number of several thousand digits"),
    "limits beyond double precision": ("[limits]\na = [[0, 0, 0], [1" + "0" * 400 + ", 1, 1]]", "six finite numbers"),
    "unknown axis": ("[rig]\nup = 'y'", r"up = 'y'.*'\+x'"),
    "axis of a wrong kind": ("[rig]\nup = [1]", r"up = \[1\]"),
    "root that is no text": ("[hierarchy]\nroot = 1", r"\[hierarchy\] root = 1.*text in quotes"),
    "chain that is no list": ("[hierarchy]\nchains = ['a', 'b']", "chains.*list of chains"),
    "chain of one": ("[hierarchy]\nchains = [['a']]", "at least two joints"),
    "chain of numbers": ("[hierarchy]\nchains = [[1, 2]]", "chain.*joint names"),
    "parents that are a list": ("[hierarchy]\nparents = ['a']", "child = parent"),
    "parents of a wrong kind": ("[hierarchy]\nparents = { a = 1 }", "child = parent"),
    "merge that is one text": ("[merge]\ninto_parent = '*-tip'", r"into_parent = '\*-tip'.*a list"),
    "lock of numbers": ("[lock]\njoints = [1]", "joints = .*a list"),
    "unknown frames": ("[frames]\n'*' = 'bones'", r"\[frames\] '\*' = 'bones'.*'bone' or 'rig'"),
    "frames of a wrong kind": ("[frames]\n'*' = [1]", r"\[frames\] '\*' = \[1\]"),
    "unknown angle unit": ("[limits]\nunit = 'grad'", r"\[limits\] unit = 'grad'.*'rad' or 'deg'"),
    "limits of one number": ("[limits]\na = 1", r"\[limits\] 'a' = 1.*six finite numbers"),
    "limits of two axes": ("[limits]\na = [[0, 0], [1, 1]]", "six finite numbers"),
    "limits of text": ("[limits]\na = [[0, 0, 'x'], [1, 1, 1]]", "six finite numbers"),
    "infinite limits": ("[limits]\na = [[0, 0, 0], [inf, 1, 1]]", "six finite numbers"),
    "limits reversed": ("[limits]\na = [[0, 2, 0], [1, 1, 1]]", r"\[limits\] 'a'.*reversed about y"),
    "limits of a name with a dot": ("[limits]\nBip.L = [[0, 0, 0], [1, 1, 1]]", 'six finite.* quotes: write "Bip.L"'),
    "limits of a name with two dots": ("[limits]\nBip.L.001 = [[0, 0, 0], [1, 1, 1]]", 'quotes: write "Bip.L.001"'),
    "frames of a name with a dot": ("[frames]\nBip.L = 'bone'", 'quotes: write "Bip.L"'),
    "parents of a name with a dot": ("[hierarchy]\nparents = { a = 'b', Bip.L = 'Bip' }", 'quotes: write "Bip.L"'),
    "parts of a name with a dot": ("[parts.p]\nArm.L = ['x']", 'quotes: write "Arm.L"'),
    "more than a turn in degrees": ("[limits]\nunit = 'deg'\na = [[-400, 0, 0], [0, 0, 0]]", r"at most one turn, 360\.$"),
    "degrees for radians": ("[limits]\na = [[0, 0, 0], [90, 1, 1]]", 'at most one turn.*unit = "deg"'),
    "partition called joints": ("[parts.joints]\na = ['x']", "another name.*one part per moving joint"),
    "partition that is a list": ("[parts]\np = ['x']", r"\[parts\] p.*\[parts\.p\]"),
    "empty partition": ("[parts.p]", r"\[parts\] p = {}"),
    "part that is one text": ("[parts.p]\na = 'x'", r"\[parts\.p\] a = 'x'.*a list"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_cards(card_file, case):
    text, words = BAD[case]
    path = card_file(text)
    with pytest.raises(FileError, match=words) as error:
        read_card(path)
    assert error.value.argument == str(path)


def test_missing_card(tmp_path):
    with pytest.raises(FileError, match=r"nowhere\.toml.*no such file.*lbsfit rig card"):
        read_card(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(("name", "words"), [("a\0b.toml", "no file can have"), ("a" * 300 + ".toml", "too long")])
def test_card_of_an_impossible_name(tmp_path, tube_rig, name, words):
    with pytest.raises(FileError, match=words):
        read_card(tmp_path / name)
    with pytest.raises(FileError, match="a path that cannot be written to"):
        write_card(tube_rig, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_card_that_is_no_text(tmp_path):
    path = tmp_path / "c.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FileError, match="not UTF-8"):
        read_card(path)
    with pytest.raises(FileError, match="cannot be read"):
        read_card(tmp_path)


def test_names_in_errors_say_where_they_stand(card_file):
    path = card_file("[merge]\ninto_parent = ['shrot']")
    with pytest.raises(InputError, match=r"rig\.card\.toml, \[merge\] into_parent: got 'shrot'.*Did you mean 'short'"):
        build_rig(make_tube_data(), path)
    with pytest.raises(InputError, match=r"'\*-tip', which matches no joint.*There are: root, elbow, long, short"):
        build_rig(make_tube_data(), card_file("[merge]\ninto_parent = ['*-tip']"))


def test_matching_prefers_names_to_the_letter():
    names = ["a[1]", "a1", "b*", "bc"]
    assert matching("a[1]", names, "x") == [0]
    assert matching("b*", names, "x") == [2]
    assert matching("a?", names, "x") == [1]
    assert matching("[ab]?", names, "x") == [1, 2, 3]


def test_a_name_that_is_none_is_answered_by_the_likeliest_or_by_all():
    names = ["LeftUpLeg", "LeftLeg", "RightUpLeg", "Head"]
    with pytest.raises(InputError, match="Did you mean 'LeftUpLeg'"):
        matching("leftupleg", names, "x")
    with pytest.raises(InputError, match="There are: LeftUpLeg, LeftLeg"):
        matching("zzz", names, "x")
    with pytest.raises(InputError, match="and 8 more"):
        matching("zzz", [f"q{k}" for k in range(20)], "x")


# ---- writing ----


def settings(rig):
    return {
        "parents": rig.parents.tolist(), "lower": rig.lower.tolist(), "upper": rig.upper.tolist(), "merged": rig.merged.tolist(),
        "locked": rig.locked.tolist(), "unit": rig.metres_per_unit, "axes": (rig.up, rig.forward), "parts": rig.parts,
        "partitions": rig.partitions, "granularity": rig.granularity,
    }  # fmt: skip


def test_written_card_gives_the_rigs_settings_back(tmp_path, card_file):
    loose = replace(make_tube_data(), parents=np.full(4, -1), partitions={})
    rig = build_rig(loose, read_card(card_file(FULL)))
    path = tmp_path / "written.toml"
    write_card(rig, path)
    again = build_rig(loose, path)
    assert settings(again) == settings(rig) and again.digest == rig.digest
    assert not list(tmp_path.glob("*.tmp"))


def test_written_card_of_a_plain_rig(tmp_path):
    data = make_tube_data()
    rig = build_rig(data)
    write_card(rig, tmp_path / "c.toml")
    bare = replace(data, lower=None, upper=None, partitions={}, metres_per_unit=None, up=None, forward=None)
    assert settings(build_rig(bare, tmp_path / "c.toml")) == settings(rig)


@pytest.mark.parametrize("frames", ['"*" = "bone"', '"*" = "rig"', '"elbow" = "rig"\n"long" = "bone"'])
def test_written_card_gives_the_axes_back(tmp_path, card_file, frames):
    """Limits about other axes would mean something else."""
    turned = replace(make_tube_data(), frames=np.tile(matrix_from_rotvec([[0.3, -0.2, 0.5]]), (4, 1, 1)))
    rig = build_rig(turned, card_file(f'[frames]\n{frames}\n[limits]\n"*" = [[0, 0, -0.2], [0.5, 0, 0.2]]'))
    write_card(rig, tmp_path / "c.toml")
    assert build_rig(turned, tmp_path / "c.toml").digest == rig.digest
    assert not read_card(path_of_card(build_rig(turned), tmp_path)).frames  # the file's own, which no card can give


def path_of_card(rig, folder):
    write_card(rig, folder / "plain.toml")
    return folder / "plain.toml"


def test_written_card_survives_odd_names(tmp_path):
    odd = ['quote " and \\ slash', "unit", "tab\there", "*-[x]"]
    data = replace(make_tube_data(), joint_names=odd, partitions={'p "q"': {"a = b": (odd[0],)}})
    rig = build_rig(replace(data, name="two\nlines = 3"))
    write_card(rig, tmp_path / "c.toml")
    bare = replace(data, lower=None, upper=None, partitions={})
    assert settings(build_rig(bare, tmp_path / "c.toml")) == settings(rig)


def test_limits_that_nobody_has_given_are_written_as_comments(tmp_path, card_file):
    """As the user's own they would silence the note."""
    bare = replace(make_tube_data(), lower=None, upper=None)
    path = tmp_path / "c.toml"
    write_card(build_rig(bare), path)
    assert read_card(path).limits == () and '# "elbow" = [[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]]' in path.read_text()
    again = build_rig(bare, path)
    assert settings(again) == settings(build_rig(bare))
    assert any("neither file nor card has limits for 4 of 4 moving joints" in note for note in again.notes)

    path.write_text(re.sub(r'^# (".*" = \[\[)', r"\1", path.read_text(), flags=re.MULTILINE))
    assert not any("neither file nor card" in note for note in build_rig(bare, path).notes)
    write_card(build_rig(bare, card_file('[limits]\n"elbow" = [[0, 0, 0], [1, 0, 0]]')), path)  # some are the user's own
    assert len(read_card(path).limits) == 4


def test_a_card_for_a_saved_rig_takes_back_what_its_notes_say_of_limits(tmp_path, card_file):
    """The saved rig says that nobody gave any; the card gives some, or all."""
    bare = replace(make_tube_data(), lower=None, upper=None)
    lbsfit_np.rig.build.build_rig(bare).save(tmp_path / "a.npz")
    saved = lbsfit_np.load_rig(tmp_path / "a.npz")
    assert any("limits for 4 of 4" in note for note in saved.notes)
    for pattern, left in (("*", []), (saved.joint_names[1], ["neither file nor card has limits for some of the moving joints"])):
        card = card_file(f'[limits]\n"{pattern}" = [[-1.0, -0.5, -0.1], [1.0, 0.5, 0.1]]\n')
        rig = lbsfit_np.load_rig(tmp_path / "a.npz", card=card)
        told = [note for note in rig.notes if note.startswith("neither file nor card")]
        assert [note.partition(";")[0] for note in told] == left
        assert not re.search(r'^# ".*" = \[\[', card_text(rig), flags=re.MULTILINE)


@pytest.mark.parametrize("parents", [[-1, -1, -1, -1], [3, 0, 1, 2], [-1, 2, 1, 2]])
def test_card_of_loose_joints_or_of_circles_guesses_a_hierarchy(tmp_path, parents):
    data = replace(
        make_tube_data(),
        joint_names=["wrist", "index-base", "index-tip", "thumb"],
        parents=np.array(parents),
        lower=None,
        upper=None,
    )
    data.partitions = {}
    text = card_text(data)
    assert "The file has 4 joints without a parent" in text and ("circles" in text) == (max(parents) >= 0)
    assert "GUESS" in text and '# "thumb" = [[-0.8' in text
    (tmp_path / "c.toml").write_text(text)
    np.testing.assert_array_equal(build_rig(data, tmp_path / "c.toml").parents, [-1, 0, 1, 0])


def test_the_partition_that_a_card_suggests_gives_every_vertex_a_part(tmp_path):
    """As soon as its # are removed, wherever the root stands among the joints."""
    data = make_tube_data()
    data.partitions = {}
    last, rows = len(data.parents) - 1, np.arange(len(data.parents))[::-1]  # of a joint, where it was
    turned = replace(
        data, joint_names=[data.joint_names[j] for j in rows], parents=np.where(data.parents < 0, -1, last - data.parents)[rows],
        joints=data.joints[rows], frames=data.frames[rows], weights=data.weights[:, rows], regressor=None,
        lower=data.lower[rows], upper=data.upper[rows],
    )  # fmt: skip
    for known in (turned, replace(turned, parents=np.full(last + 1, -1))):
        text = card_text(known).replace("# [parts.NAME] ", "[parts.NAME] ").replace("# body", "body")
        (tmp_path / "c.toml").write_text(text)
        assert build_rig(known, tmp_path / "c.toml").with_parts("NAME").parts == ("body",)


def test_guess_without_a_telling_name_starts_in_the_middle():
    names = ["LegLeft1", "LegLeft2", "Body", "ArmLeft1"]
    root, chains = guessed_chains(names, [[0, -1, 0], [0, -2, 0], [0, -0.4, 0], [0, 2, 0]])
    assert root == "Body"
    assert sorted(chains) == [["Body", "ArmLeft1"], ["Body", "LegLeft1", "LegLeft2"]]


def test_card_that_cannot_be_written(tmp_path, tube_rig):
    with pytest.raises(FileError, match="nowhere"):
        write_card(tube_rig, tmp_path / "nowhere" / "c.toml")
    for folder in (tmp_path, "."):
        with pytest.raises(FileError, match="a folder"):
            write_card(tube_rig, folder)
    write_card(tube_rig, tmp_path / ("c" * 250 + ".toml"))
    assert [len(p.name) for p in tmp_path.iterdir()] == [255]


@pytest.mark.parametrize(
    "error, words",
    [(KeyboardInterrupt("pressed"), "pressed"), (OSError(28, "No space left"), r"cannot be written to \(No space left")],
)
def test_a_card_is_replaced_whole_or_not_at_all(tmp_path, tube_rig, monkeypatch, error, words):
    def stop(*args):
        raise error

    path = tmp_path / "c.toml"
    path.write_text("edited = true")
    monkeypatch.setattr(os, "replace", stop)
    with pytest.raises((KeyboardInterrupt, FileError), match=words):
        write_card(tube_rig, path)
    assert path.read_text() == "edited = true" and [p.name for p in tmp_path.iterdir()] == ["c.toml"]


def test_a_card_is_on_the_disk_before_it_has_its_name(tmp_path, tube_rig, monkeypatch):
    seen = []
    monkeypatch.setattr(os, "fsync", lambda handle: seen.append((os.fstat(handle).st_size, (tmp_path / "c.toml").exists())))
    write_card(tube_rig, tmp_path / "c.toml")
    assert seen == [((tmp_path / "c.toml").stat().st_size, False)]


@pytest.mark.parametrize("unit", [np.float64(0.45), np.float32(0.5)])
def test_a_unit_may_be_a_number_of_numpys(tmp_path, tube_rig, unit):
    write_card(replace(tube_rig, metres_per_unit=unit), tmp_path / "c.toml")
    assert read_card(tmp_path / "c.toml").metres_per_unit == unit


# ---- the project's own cards ----

CARDS = sorted((Path(lbsfit_np.__file__).parent / "bench" / "cards").glob("*.toml"))


@pytest.mark.parametrize("path", CARDS, ids=lambda path: path.stem)
def test_own_cards_read(path):
    card = read_card(path)
    assert card.limits and card.merge and card.partitions


def test_there_are_cards_for_all_shared_rigs():
    assert {path.stem for path in CARDS} >= {"webxr_left", "mpfb2_cmu_mb", "mpfb2_mixamo", "mpfb2_default", "fox"}


def test_names_that_utf_8_cannot_hold_are_not_blamed_on_the_path(tmp_path):
    data = make_tube_data()
    data = replace(data, joint_names=["root", "elbow", "\ud800", "short"], partitions={})
    with pytest.raises(FileError, match=r"in which a name has what UTF-8 cannot hold; .* Rename the joint or part"):
        write_card(data, tmp_path / "c.toml")  # build_rig refuses them, but a card may come before a rig
    assert not list(tmp_path.iterdir())
