"""``lbsfit rig`` and ``lbsfit demo``."""

from dataclasses import replace

import numpy as np
import pytest
from cli_runs import TRAINING, one_line
from learning_runs import learning_is_hurried
from small_rigs import make_tube_data

import lbsfit_np as lbs
from lbsfit_np.cli import demo
from lbsfit_np.cli.fit import fit_files
from lbsfit_np.rig.build import build_rig

pytestmark = pytest.mark.usefixtures("own_cache")


def test_rig_show(made, tmp_path, run):
    (tmp_path / "c.toml").write_text('[lock]\njoints = ["short"]\n')
    code, text, err = run("rig", "show", made / "tube.npz", "--card", tmp_path / "c.toml", "--degrees")
    assert (code, err) == (0, "")
    assert "elbow" in text and "locked" in text and "degrees" in text


def test_rig_show_of_derived_limits_in_degrees(tmp_path, run):
    build_rig(replace(make_tube_data(), lower=None, upper=None)).save(tmp_path / "tube.npz")
    noted = [run("rig", "show", tmp_path / "tube.npz", *more)[1].split("Noted:")[1] for more in ((), ("--degrees",))]
    assert "±0.8 rad about each axis (46°) for 3" in noted[0] and "±0.6 rad for sampling the root (34°)" in noted[0]
    assert noted[1] == noted[0]  # which has both units


@pytest.mark.parametrize("metres, name, shown", [(0.1 * 0.1, '"cm"', "cm"), (0.03, "0.03", "0.03 m")])
def test_show_and_card_name_a_unit_alike_but_for_rounding(metres, name, shown, tmp_path, run):
    assert metres != 0.01
    build_rig(replace(make_tube_data(), metres_per_unit=metres)).save(tmp_path / "tube.npz")
    assert run("rig", "card", tmp_path / "tube.npz", "-o", tmp_path / "c.toml")[0] == 0
    assert f"unit = {name}" in (tmp_path / "c.toml").read_text()
    (line,) = [line for line in run("rig", "show", tmp_path / "tube.npz")[1].splitlines() if line.split()[:1] == ["unit"]]
    assert line.split(maxsplit=1)[1] == shown


def test_rig_mirror(made, tmp_path, run):
    """With what a rig file may need; an angle gives the mirrored pose."""
    (tmp_path / "c.toml").write_text('[lock]\njoints = ["short"]\n')
    out = tmp_path / "other.npz"
    code, text, err = run("rig", "mirror", made / "tube.npz", "-o", out, "--axis", "z", "--card", tmp_path / "c.toml")
    assert (code, err) == (0, "") and text.endswith(f"{out} written: 'tube-mirrored'\n")
    rig, mirrored = lbs.load_rig(made / "tube.npz", card=tmp_path / "c.toml"), lbs.load_rig(out)
    theta = 0.1 * np.arange(12.0).reshape(4, 3)
    np.testing.assert_allclose(mirrored.pose(theta), rig.pose(theta) * [1.0, 1.0, -1.0], atol=1e-12)
    for arguments, words in (
        ((made / "tube.npz",), "-o/--output: got nothing; expected the rig to write. Add -o NAME.npz."),
        ((made / "tube.npz", "-o", out), "a file that exists already"),
        ((made / "tube.npz", "-o", tmp_path / "other.glb"), "a name that ends in .npz"),
        ((out, "-o", out, "--existing", "replace"), "which is the rig itself"),
    ):
        code, _, err = run("rig", "mirror", *arguments)
        assert code == 2 and words in one_line(err)


def test_rig_card(made, tmp_path, run):
    card = tmp_path / "tube.toml"
    assert run("rig", "card", made / "tube.npz", "-o", card)[0] == 0
    assert run("rig", "show", made / "tube.npz", "--card", card)[0] == 0
    card.write_text("mine")
    code, _, err = run("rig", "card", made / "tube.npz", "-o", card)
    assert code == 2 and "exists already" in one_line(err) and card.read_text() == "mine"
    assert run("rig", "card", made / "tube.npz", "-o", card, "--existing", "replace")[0] == 0 and "[limits]" in card.read_text()
    rig = tmp_path / "tube.npz"
    rig.write_bytes((made / "tube.npz").read_bytes())
    elsewhere = f"pass it with --card {tmp_path}"
    for name, words in (("b.toml", elsewhere), ("tube.card.toml", f"it is used automatically with {rig}"), ("a.toml", elsewhere)):
        code, text, _ = run("rig", "card", rig, "-o", tmp_path / name)
        assert code == 0 and words in text
        assert ("note: the card describes tube.npz without tube.card.toml, which was not read" in text) == (name == "a.toml")
    assert "tube.card.toml beside tube.npz was used" in run("rig", "show", rig)[1]
    (tmp_path / "tube.card.toml").rename(tmp_path / "Tube.card.toml")
    if not (tmp_path / "tube.card.toml").exists():  # as it does where capitals make no difference
        shown = run("rig", "show", rig)[1]
        assert "Tube.card.toml beside tube.npz was not used: a card of this rig is called tube.card.toml" in shown
    (tmp_path / "Tube.card.toml").rename(tmp_path / "tube.card.toml")
    code, _, err = run("rig", "card", rig, "-o", rig, "--existing", "replace")
    assert code == 2 and "which is the rig itself" in one_line(err) and rig.read_bytes() == (made / "tube.npz").read_bytes()
    code, _, err = run("rig", "card", rig, "-o", tmp_path)
    assert code == 2 and "a folder" in one_line(err)


@pytest.mark.parametrize("parents", [[-1, -1, -1, -1], [3, 0, 1, 2], [-1, 2, 1, 0]])
def test_a_card_of_joints_that_are_no_tree_is_to_be_checked(parents, made, tmp_path, run):
    with np.load(made / "tube.npz") as z:
        np.savez(tmp_path / "loose.npz", **{key: z[key] for key in z.files} | {"parents": np.array(parents)})
    code, _, err = run("rig", "show", tmp_path / "loose.npz")
    words = "check its [hierarchy], which is a guess"
    assert code == 2 and f"-o CARD, {words}, and pass it with --card" in one_line(err)
    code, text, _ = run("rig", "card", tmp_path / "loose.npz", "-o", tmp_path / "c.toml")
    assert (code, text) == (0, f"{tmp_path / 'c.toml'} written; {words}; pass it with --card {tmp_path / 'c.toml'}\n")
    assert run("rig", "show", tmp_path / "loose.npz", "--card", tmp_path / "c.toml")[0] == 0


def test_a_card_of_parents_of_a_wrong_shape_is_an_error(made, tmp_path, run):
    with np.load(made / "tube.npz") as z:
        np.savez(tmp_path / "odd.npz", **{key: z[key] for key in z.files} | {"parents": z["parents"][:, None]})
    code, _, err = run("rig", "card", tmp_path / "odd.npz", "-o", tmp_path / "c.toml")
    assert code == 2 and "parents: shape (4, 1); expected shape (4,)" in one_line(err)


def test_rig_list(run):
    code, text, _ = run("rig", "list")
    assert code == 0
    heading, *lines = text.splitlines()
    assert heading.split() == ["name", "vertices", "joints", "poses", "what", "it", "is"]
    rows = {line.split()[0]: line.split(maxsplit=4)[1:] for line in lines}
    assert list(rows) == lbs.bundled_rigs()
    assert rows["hand"] == ["1585", "16", "42", "a right hand, MANO's 16 joints"]
    assert rows["hand-left-coarse"][3].startswith("a left hand") and "fewer vertices" in rows["hand-left-coarse"][3]


def test_rig_show_of_a_bundled_rig(run):
    code, text, _ = run("rig", "show", "hand-left")
    assert code == 0
    for words in (
        "42 natural: flat, spread",
        "length 0.155 to 0.215 m, here 0.187",
        "thumb 0.85 to 1.15, here 1",
        "to_smpl_pose and from_smpl_pose",
    ):
        assert words in text, words


def test_demo(made, tmp_path, run):
    out = tmp_path / "demo"
    arguments = ("demo", "-o", out, "--rig", made / "tube.npz", "--points", 500, *TRAINING)
    code, text, err = run(*arguments)
    assert (code, err) == (0, "")
    names = {"rig.npz", "scan.ply", "scan.fit.npz", "scan.mesh.ply", "scan.labels.ply", "summary.json", "truth.npz", "demo.png"}
    assert {p.name for p in out.iterdir()} == names and all(name in text for name in names)
    with np.load(out / "truth.npz") as truth:
        result = lbs.FitResult.load(out / "scan.fit.npz")
        error = np.linalg.norm(result.joints - truth["joints"], axis=1).mean()
        assert error < 0.05 and (result.labels == truth["labels"]).mean() > 0.85
        rig = lbs.load_rig(out / "rig.npz").with_template(truth["template"], truth["template_joints"])
        posed = rig.pose(truth["pose"], truth["translation"], float(truth["scale"]))
        np.testing.assert_allclose(posed, truth["vertices"], atol=1e-9)
    assert f"{250 * error:.1f} mm" in text and "% of the rig's size" in text  # one unit of this rig is 250 mm
    assert (out / "demo.png").read_bytes().startswith(b"\x89PNG")

    code, _, err = run(*arguments)
    assert code == 2 and "exist already" in one_line(err)
    code, _, err = run("demo", "-o", out, "--rig", out / "rig.npz", "--existing", "replace", *TRAINING)
    assert code == 2 and "never overwritten" in one_line(err)


@pytest.mark.slow
def test_a_demo_of_a_rig_that_needs_options(made, tmp_path, run, monkeypatch):
    """Those that the errors of rigs name, as other commands take them."""
    card, out = tmp_path / "other.toml", tmp_path / "out"
    card.write_text('[limits]\nelbow = [[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]]\n')
    given = ("demo", "-o", out, "--rig", made / "tube.npz", "--parts", "arm and fingers", "--points", 500, *TRAINING)
    code, _, err = run(*given, "--card", card)
    assert (code, err) == (0, "")
    rig = lbs.load_rig(out / "rig.npz")
    assert rig.parts == ("arm", "fingers") and rig.upper[1].tolist() == [0.7, 0, 0]
    with np.load(out / "truth.npz") as truth:
        assert 0 <= truth["pose"][1, 0] <= 0.7 and set(truth["labels"]) == {0, 1}
        assert (lbs.FitResult.load(out / "scan.fit.npz").labels == truth["labels"]).mean() > 0.85
    (out / "demo.png").write_bytes(card.read_bytes())
    code, _, err = run(*given, "--card", out / "demo.png", "--existing", "replace")
    assert code == 2 and "never overwritten" in one_line(err)
    taken = []
    monkeypatch.setattr("lbsfit_np.io.rigs.load_rig", lambda path, **options: taken.append(options) or 1 / 0)
    for flags in (("--normalize-weights",), ("--shape", "b"), ("--skin", "c")):
        with pytest.raises(ZeroDivisionError):
            run(*given, *flags)
    wanted = [{"normalize_weights": True}, {"shape": "b"}, {"skin": "c"}]
    assert all(options.items() >= those.items() for options, those in zip(taken, wanted, strict=True))


@pytest.mark.parametrize("code, shown", [(1, True), (130, False)])
def test_a_demo_shows_a_fit_that_has_failed_and_ends_where_it_is_stopped(code, shown, made, tmp_path, run, monkeypatch):
    learning_is_hurried(monkeypatch, "balanced")
    monkeypatch.setattr(demo, "fit_files", lambda *given: fit_files(*given) or code)  # which is how it says so
    out = tmp_path / "demo"
    found, text, _ = run("demo", "-o", out, "--rig", made / "tube.npz", "--points", 500, *TRAINING)
    assert found == code and ("Mean errors against the truth" in text) == ("demo.png" in text) == shown
    assert (out / "demo.png").is_file() == shown and (out / "scan.fit.npz").is_file()


def test_a_demo_without_a_fit_leaves_nothing_in_the_way_of_the_next(made, tmp_path, run, monkeypatch):
    learning_is_hurried(monkeypatch, "balanced")
    arguments = ("demo", "-o", tmp_path / "a demo", "--rig", made / "tube.npz", *TRAINING)
    code, text, _ = run(*arguments, "--points", 3)
    assert code == 1 and not (tmp_path / "a demo").exists() and "the scan was not fitted, so the demo's files in" in text
    with monkeypatch.context() as patched:
        patched.setattr("lbsfit_np.learning.batch.fit_scans", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
        code, text, _ = run(*arguments)
        assert code == 130 and "run the same command to start again" in text and not (tmp_path / "a demo").exists()
    code, text, _ = run(*arguments, "--points", 500)
    again = f"lbsfit fit '{tmp_path}/a demo/rig.npz' '{tmp_path}/a demo/scan.ply' -o OUT {' '.join(TRAINING)}\n"
    assert code == 0 and again in text  # with what the segmenter was trained with


def test_a_demo_of_a_learned_model_says_what_it_takes_of_it(tube_model, tmp_path, run, monkeypatch):
    monkeypatch.setattr(demo, "fit_files", lambda *given: 1)
    _, text, _ = run("demo", "-o", tmp_path / "demo", "--rig", tube_model[0])
    assert f"of the learned model {tube_model[0]}, the demo takes the rig alone" in text


def test_the_demos_default_is_the_bundled_hand():
    assert {o.name: o.default for o in demo._OPTIONS}["rig"] in lbs.io.rigs.bundled_rigs()
