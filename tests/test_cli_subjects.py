"""Tables of subjects: the forms that are read, and the mistakes that are named."""

import os

import pytest

from lbsfit_np.cli.subjects import _ALIKE, _folders_likeness, check_no_table, read_subjects, who_words
from lbsfit_np.errors import FileError, InputError

SCANS = ["in/a1.ply", "in/a2.ply", "in/b 1.xyz"]
_ONE_PLACE = " Put all names at the top, or all in [subjects]."


@pytest.mark.parametrize(
    "name, text",
    [
        ("who.csv", "a1.ply,anna\na2.ply,anna\nb 1.xyz,ben\n"),
        ("who.csv", "\ufeffscan, subject\r\na1, anna\r\n\r\n# b\r\na2, anna\r\n'b 1',ben".replace("'", '"')),
        ("who.csv", "File;Who\nb 1;ben\na1;anna;\na2;anna;;\n"),
        ("who.tsv", "a1\tanna\na2\tanna\nb 1.xyz\tben\n"),
        ("who.txt", "a1 anna\t\na2 anna\nb 1 ben\n"),
        ("who.txt", "a1.ply  anna\nin/a2.ply\tanna\nb 1.xyz ben\n".replace("\t", " ")),
        ("who", "in/a1.ply,anna\n./in/a2.ply,anna\nb 1,ben\n"),
        ("who.toml", '"a1.ply" = "anna"\na2 = "anna"\n"b 1" = "ben"\n'),
        ("who.toml", '[subjects]\n"in/a1.ply" = "anna"\na2 = " anna "\n\'b 1\' = "ben"\n'),
    ],
)
def test_tables_of_subjects(name, text, tmp_path):
    (tmp_path / name).write_text(text, encoding="utf-8", newline="")
    assert read_subjects(tmp_path / name, SCANS) == ["anna", "anna", "ben"]


def test_ids_that_are_numbers_are_text(tmp_path):
    (tmp_path / "who.toml").write_text("a1 = 1\na2 = 2\n'b 1' = \"1\"\n")
    assert read_subjects(tmp_path / "who.toml", SCANS) == ["1", "2", "1"]


def test_a_scan_may_be_called_as_headings_are(tmp_path):
    (tmp_path / "who.csv").write_text("scan,anna\nfile,ben\n")
    assert read_subjects(tmp_path / "who.csv", ["scan.ply", "file.ply"]) == ["anna", "ben"]


def test_scans_of_one_name_are_told_apart_by_path(tmp_path):
    scans = ["a/1.ply", "b/1.ply"]
    (tmp_path / "who.csv").write_text("b/1.ply,ben\na/1.ply,anna\n")
    assert read_subjects(tmp_path / "who.csv", scans) == ["anna", "ben"]
    (tmp_path / "who.csv").write_text("1.ply,ben\na/1.ply,anna\n")
    with pytest.raises(FileError, match=r"'1.ply' in line 1, which is the name of 2 scans.*Write its path, such as a/1.ply"):
        read_subjects(tmp_path / "who.csv", scans)
    (tmp_path / "who.csv").write_text("b/1.ply,ben\n1.plx,anna\n")  # of whose names one is still free
    with pytest.raises(FileError, match=r"'1.plx' in line 2, which is none of the scans given.*Did you mean '1.ply'\?"):
        read_subjects(tmp_path / "who.csv", scans)


@pytest.mark.parametrize(
    "name, text", [("who.csv", "a2,\nz,zoe\na1,anna\nb 1,\n"), ("who.toml", "a2 = ''\na1 = 'anna'\n'b 1' = ' '\n")]
)
def test_empty_ids_and_other_scans_where_both_may_be(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    assert read_subjects(tmp_path / name, SCANS, others=True) == ["anna", None, None]
    with pytest.raises(FileError, match="no id for 'a2' in line 1"):
        read_subjects(tmp_path / name, SCANS)


@pytest.mark.parametrize(
    "content, got, remedy",
    [
        ("a1,anna\nb 1,\n", "no id for 1 of 3 scans: in/a2.ply", "Add them, with an empty id where the subject is unknown"),
        (
            "a1,anna\nb 1,\naa2,anna\n",
            "no id for 1 of 3 scans: in/a2.ply",
            "If 'aa2' in line 3 means 'in/a2.ply', write it that way",
        ),
        ("a1,anna\nb 1,\nA02.ply,anna\n", "no id for 1 of 3 scans: in/a2.ply", "If 'A02.ply' in line 3 means 'in/a2.ply', write"),
        ("a1,anna\nb_1,ben\n", "no id for 2 of 3 scans: in/a2.ply, in/b 1.xyz", "If 'b_1' in line 2 means 'in/b 1.xyz', write"),
        ("a1,anna\nb 1,\na3,anna\n", "no id for 1 of 3 scans: in/a2.ply", "Add them"),  # another of the series
        ("z,anna\n", "a file that names none of these scans: 'in/a1.ply', 'in/a2.ply', 'in/b 1.xyz'", "Add them"),
        ("o1.ply,anna\n", "a file that names none of these scans: ", "Add them"),  # alike in its ending alone
        ("../in/a1.ply,anna\n", "a file that names none of these scans: ", "If '../in/a1.ply' in line 1 means 'in/a1.ply'"),
        ("../a1.ply,anna\n", "a file that names none of these scans: ", "If '../a1.ply' in line 1 means 'in/a1.ply'"),
        # Where each person has a folder, the row of another one's scan is none of these.
        ("ben/a1.ply,ben\n", "a file that names none of these scans: ", "Add them"),
        ("in2/a1.ply,ben\n", "a file that names none of these scans: ", "Add them"),  # numbers differ
        ("/mnt/data/in/a1.ply,anna\n", "a file that names none of these scans: ", "If '/mnt/data/in/a1.ply' in line 1 means"),
        ("ben/a1.ply,ben\ninn/a1.ply,anna\n", "a file that names none of these scans: ", "If 'inn/a1.ply' in line 2 means"),
        ("anna,a1\nben,b 1\n", "a file that names none of these scans: ", "The columns seem to be swapped"),
        ("", "no id for 3 of 3 scans", "Add them"),
    ],
)
def test_scans_that_a_table_with_others_lacks(content, got, remedy, tmp_path):
    (tmp_path / "who.csv").write_text(content)
    with pytest.raises(FileError) as error:
        read_subjects(tmp_path / "who.csv", SCANS, others=True)
    assert error.value.got.startswith(got) and error.value.remedy.startswith(remedy), str(error.value)


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("who.csv", "a1,anna\na3.ply,anna\nb 1,ben\n", ["'a3.ply' in line 2", "none of the scans", "Did you mean 'a2"]),
        ("who.csv", "a1,anna\na2,anna\na3,anna\nb 1,ben\n", ["'a3' in line 3", "none of the scans", "Leave out scans"]),
        ("who.csv", "a1,anna\nzzzz,anna\n", ["'zzzz' in line 2", "Leave out scans"]),
        ("who.csv", "id,person\na1,anna\na2,anna\nb 1,ben\n", ["'id' in line 1", 'If it is a heading, write "scan"']),
        ("who.csv", "zzzz,anna\na1,anna\nyyyy,anna\n", ["'zzzz' in line 1", "Leave out scans"]),
        ("who.csv", "a1,anna\n", ["no id for 2 of 3 scans: in/a2.ply, in/b 1.xyz", "Add them"]),
        ("who.csv", "", ["no id for 3 of 3 scans"]),
        ("who.csv", "a1,anna\na2,anna\n\na1.ply,ben\n", ["'a1.ply' twice, in lines 1 and 4"]),
        ("who.csv", "a1,anna\na2,\n", ["no id for 'a2' in line 2"]),
        ("who.csv", "a1,anna\na2\n", ["'a2' in line 2", "has 1 column (separated by commas, as in line 1);"]),
        ("who.csv", "# who\na1,anna\na2;anna\n", ["'a2;anna' in line 3", "1 column (separated by commas, as in line 2)"]),
        ("who.csv", "a1;anna\na2,anna\n", ["line 2", "1 column (separated by semicolons, as in line 1)"]),
        ("who.csv", "a1,anna\na2,anna,left\n", ["line 2", "3 columns (separated by commas, as", "Leave out the other columns"]),
        ("who.csv", "scan,subject,age\na1,anna,9\n", ["in line 1, which has 3 columns;", "Leave out the other columns"]),
        ("who.csv", "a1\na2\n", ["'a1' in line 1, which has 1 column;", "Put a comma in all lines, or a blank, between"]),
        ("who.csv", "a1;anna\na2\n", ["'a2' in line 2", "Put a semicolon between name and id."]),
        ("who.csv", 'a1,anna\n"a2,anna\n', ["line 2", "cannot be read"]),
        ("who.csv", b"a1,anna\n\xff\xfe\n", ["not UTF-8", "Save it as CSV in UTF-8"]),
        ("who.txt", "a1 anna\na2\n", ["'a2' in line 2", "1 column (separated by blanks, as in line 1)"]),
        ("who.toml", "a1 = 'anna'\na3 = 'anna'\n", ["'a3' in line 2"]),
        ("who.toml", "a1.ply = 'anna'\n", ["line 1", "names with dots in quotes"]),
        ("who.toml", "a1 = 'anna'\n\na2 = ['anna']\n", ["a2 = ['anna'] in line 3"]),
        ("who.toml", "a1 = 'anna'\na2 = true\n", ["a2 = true in line 2", "Ids are text, in quotes, or whole numbers."]),
        ("who.toml", "a1 = 'anna'\n\n[subjects]\na2 = 'ben'\n", ["got subjects = {'a2': 'ben'} in line 3; ", _ONE_PLACE]),
        ("who.toml", "[people]\na1 = 'anna'\n", ["got people = {'a1': 'anna'} in line 1; ", _ONE_PLACE]),
        ("who.toml", "a1 = 'anna'\n\n[[people]]\na1 = 1\n", ["got people = [{'a1': 1}] in line 3; ", _ONE_PLACE]),
        ("who.toml", "a1 = 'anna'\na2 = [{ b = 1 }]\n", ["got a2 = [{'b': 1}] in line 2; ", "Ids are text, in quotes"]),
        ("who.toml", "a1 = 'anna'\na2 = 'ben'\n", ["got no id for 1 of 3 scans: in/b 1.xyz", 'such as "anna_01.ply" = "anna".']),
        ("who.toml", "a1 = 'anna'\na2 = ''\n", ["got no id for 'a2' in line 2; ", ' such as "anna_01.ply" = "anna".']),
        ("who.csv", "a1,anna\na2,ben\n", ["got no id for 1 of 3 scans: in/b 1.xyz; ", "name, a comma, the subject's id."]),
        ("who.toml", "a1 = 'anna'\na1 = 'ben'\n", ["not TOML", "line 2"]),
        ("who.toml", "a1 = 'anna'\n'a1.ply' = 'ben'\n", ["'a1.ply' twice, in lines 1 and 2"]),
        ("who.toml", "a1 = ", ["not TOML"]),
    ],
)
def test_bad_tables_of_subjects(name, content, words, tmp_path):
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FileError) as error:
        read_subjects(tmp_path / name, SCANS)
    message = str(error.value)
    assert message.startswith(f"{tmp_path / name}: got ") and all(word in message for word in words), message


_MANY = "".join(f"{name},Zoë\n" for name in ("a1", "a2", "b 1")) * 200  # longer than what is looked at, cut in a letter


@pytest.mark.parametrize(
    "name, content",
    [
        ("who.csv", "scan,subject\na1.ply,anna\n"),
        ("who.csv", "\ufeffa1.ply,anna"),
        ("who.csv", "scan,subject,,\na1,anna,,\n"),
        ("who.csv", "anna,a1\nben,b 1\n"),  # which is told so when it is read as a table
        ("who.txt", "# whose they are\n" * 30 + "\na1;anna\n"),
        ("who.txt", "a1 anna\na2.ply  ben\n"),
        ("who.csv", "\"b 1.xyz\"\tben\n"),
        ("who.toml", "'a2.ply' = 'anna'\n"),
        *((f"who{k}.csv", "é" * k + "\n" + _MANY) for k in (1, 2)),
    ],
)
def test_a_table_among_the_scans_is_told_from_them(name, content, tmp_path):
    table = tmp_path / name
    table.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=f"SCAN: got .*{name}, a table that names other scans; expected scans. It is .*{name}"):
        check_no_table([*SCANS, str(table)], "It is {}.")


@pytest.mark.parametrize(
    "content",
    [
        *("1,2,3\n4,5,6\n", "a1,2,3\n", "1 2 3\n", "0.1 0.2 0.3 2\n", "0.1 0.2 a1\n", "", "\udcff", "# a1,anna\n"),
        *("2,\n1,2,3\n4,5,6\n", "a1,scanned\nx,y,z\n1,2,3\n"),  # titles
    ],
)
def test_clouds_are_no_tables_of_subjects(content, tmp_path):
    cloud = tmp_path / "1.csv"
    cloud.write_bytes(content.encode("utf-8", "surrogateescape"))
    check_no_table([*SCANS, str(tmp_path / "2.csv"), str(cloud)], "")


def test_a_line_that_is_cut_says_nothing_of_what_a_file_is(tmp_path):
    """One of two whole lines names a scan, as tables' lines do; the third is cut within its name."""
    head, cut = "a1,anna\nnobody knows whose these are\n", "b 1.xyz,ben\n"
    (tmp_path / "who.csv").write_text(head + "#" * (4096 - len(head) - len("\nb ")) + "\n" + cut)
    with pytest.raises(InputError, match="a table that names other scans"):
        check_no_table([*SCANS, str(tmp_path / "who.csv")], "")


def test_files_that_name_others_do_not_make_many_scans_slow(tmp_path, monkeypatch):
    """OBJ names its materials by two words, the second a path: each is looked up, not compared with each scan."""
    scans, looked, stat = [], [], os.stat
    for i in range(60):
        (tmp_path / f"s{i}.obj").write_text(f"mtllib ./s{i}.obj.mtl\nmtllib {tmp_path}/sub/../s{i}.obj\nv 0 0 0\nv 1 0 0\n")
        scans.append(str(tmp_path / f"s{i}.obj"))
    (tmp_path / "sub").mkdir()
    monkeypatch.setattr(os, "stat", lambda *given, **more: looked.append(given) or stat(*given, **more))
    check_no_table(scans, "")
    assert 60 <= len(looked) <= 4 * 60


def test_a_file_may_be_named_by_another_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a1.ply").write_text("ply")
    (tmp_path / "in" / "link.ply").symlink_to("a1.ply")
    (tmp_path / "who.csv").write_text(f"{tmp_path}/in/link.ply,anna\n./in/A2.ply,ben\nin/../in/b 1.xyz,carl\n")
    assert read_subjects(tmp_path / "who.csv", SCANS) == ["anna", "ben", "carl"]  # the others do not exist
    (tmp_path / "who.csv").write_text("in/a1.ply,anna\n./in/a1.ply,anna\n")
    with pytest.raises(FileError, match="the scan './in/a1.ply' twice, in lines 1 and 2"):
        read_subjects(tmp_path / "who.csv", SCANS)


def test_columns_that_are_exchanged(tmp_path):
    for content in ("anna,a1\n", "anna,a1\na2,anna\n", "subject,scan\nanna,a1\n"):
        (tmp_path / "who.csv").write_text(content)
        with pytest.raises(FileError, match=" in line 1, which is none .* The columns seem to be swapped: put the file name"):
            read_subjects(tmp_path / "who.csv", SCANS)


def test_one_line_that_is_no_scan_is_no_heading(tmp_path):
    for content, remedy in (("zoe,anna\n", "Leave out scans"), ("zoe,anna\na1,anna\n", "If it is a heading, write")):
        (tmp_path / "who.csv").write_text(content)
        with pytest.raises(FileError, match=f"'zoe' in line 1, which is none .* {remedy}"):
            read_subjects(tmp_path / "who.csv", SCANS)


def test_accents_in_either_way_of_writing_them(tmp_path):
    (tmp_path / "who.csv").write_text("Mu\u0308ller,Jos\u00e9\nIs\u00e9e,Jose\u0301\n", encoding="utf-8")
    assert read_subjects(tmp_path / "who.csv", ["M\u00fcller.ply", "Ise\u0301e.ply"]) == ["Jos\u00e9"] * 2


@pytest.mark.parametrize(
    "ids, lines",
    [
        (None, []),
        (["a", "a"], []),
        (["b", "a", "b"], ["2 subjects, with these numbers of scans: a 1, b 2"]),
        (
            ["rex", "Rex", "ben"],
            [
                "3 subjects, with these numbers of scans: rex 1, Rex 1, ben 1",
                "note: 'rex' and 'Rex' differ only in upper and lower case: are they one person?",
            ],
        ),
        (
            ["anna", "ben", "anna", "anan", "ben", "p01", "p02", "p02"],  # numbers are no typing errors
            [
                "5 subjects, with these numbers of scans: anan 1, p01 1, anna 2, ben 2, p02 2",
                "note: 'anan' has one scan, and is like 'anna': are they one person?",
            ],
        ),
    ],
)
def test_whose_scans_they_are_is_said_before_work(ids, lines):
    assert list(who_words(ids)) == lines


def test_of_many_subjects_those_of_few_scans_are_named():
    (line,) = who_words([str(k) for k in range(40)] * 2 + ["3o"])
    assert line == f"41 subjects, with these numbers of scans: 3o 1, {', '.join(f'{k} 2' for k in range(11))}, …"


@pytest.mark.parametrize(
    "scan, name, alike",
    [
        ("scans/anna/1.ply", "/mnt/data/anna/1.ply", True),  # another root
        ("/home/me/scans/anna/1.ply", "/data/scans/anna/1.ply", True),
        ("scans/anna/1.ply", "/mnt/v2/anna/1.ply", True),
        ("p1/raw/1.ply", "p2/raw/1.ply", False),  # another person's
        ("data/p1/raw/1.ply", "p2/raw/1.ply", False),
        ("anna/raw/1.ply", "ben/raw/1.ply", False),
        ("scans/anna/1.ply", "/mnt/data/ben/1.ply", False),
    ],
)
def test_paths_may_have_another_root_but_no_other_persons_folder(scan, name, alike):
    assert (_folders_likeness(scan, name) >= _ALIKE) == alike
