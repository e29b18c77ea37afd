"""The documents: their snippets run, their links lead somewhere, and the defaults and keys that they list are the code's."""

import dataclasses
import importlib
import inspect
import json
import re
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from docs_tables import ROOT, codes, document, listed_keys, table_rows
from learning_runs import learning_is_hurried
from scipy import sparse
from small_rigs import make_tube_data
from study_sizes import small_is_few_and_fast

import lbsfit_np as lbs
from lbsfit_np.rig.build import build_rig

if not (ROOT / "README.md").is_file():
    pytest.skip("the documents lie in the checkout, not in the wheel", allow_module_level=True)

DOCS = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "rigs" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
IDS = [str(p.relative_to(ROOT)) for p in DOCS]
COMMANDS = ("python -m pip install . && lbsfit demo -o demo", "python -m pip install '.[test]' && python -m pytest")


def _blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


# ---- snippets ----

WITH_SNIPPETS = [path for path in DOCS if _blocks(path, "python")]


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """A folder with demo/rig.npz, scan.ply, scan.fit.npz and scan.mesh.ply, as ``lbsfit demo -o demo`` leaves them."""
    from lbsfit_np.io.write import write_mesh_ply, write_points_ply

    folder = tmp_path_factory.mktemp("docs")
    (folder / "demo").mkdir()
    rig = lbs.load_rig("hand")
    scan = lbs.synthesize(rig, 1, random_state=0, n_points=800)[0]
    with pytest.MonkeyPatch.context() as patch:
        learning_is_hurried(patch)
        result = lbs.LBSFitter(rig, effort="fast", random_state=0).fit_scan(scan.points, labels=scan.labels)
    rig.save(folder / "demo" / "rig.npz")
    write_points_ply(folder / "demo" / "scan.ply", scan.points)
    write_mesh_ply(folder / "demo" / "scan.mesh.ply", result.vertices, rig.faces, vertex_labels=rig.vertex_labels)
    result.save(folder / "demo" / "scan.fit.npz")
    return folder


@pytest.mark.parametrize("path", WITH_SNIPPETS, ids=lambda path: path.name)
def test_snippets_run(path, demo, monkeypatch):
    """All ```python blocks of a document one after the other, as a reader would; with few small scans, and in a hurry."""
    from lbsfit_np.learning.fitter import LBSFitter

    small_is_few_and_fast(monkeypatch)  # "balanced", as fits of documents are
    learning_is_hurried(monkeypatch)
    monkeypatch.setitem(LBSFitter.__init__.__kwdefaults__, "training", {"n_points": 200})
    monkeypatch.chdir(demo)
    monkeypatch.setenv("LBSFIT_CACHE", str(demo / "cache"))
    pretrain = LBSFitter.pretrain

    def quick(self, **options):
        self.training_scans = min(self.training_scans, 40)
        return pretrain(self, **options)

    monkeypatch.setattr(LBSFitter, "pretrain", quick)
    names = {}
    for k, snippet in enumerate(_blocks(path, "python")):
        exec(compile(snippet, f"{path.name}, snippet {k}", "exec"), names)


def test_skinning_is_shown_for_joints_in_any_order(monkeypatch):
    """Files may have children before their parents, as the bundled rigs do not."""
    data = make_tube_data()
    order = np.array([2, 3, 1, 0])  # the root last
    where = np.argsort(order)
    rows = {name: getattr(data, name)[order] for name in ("joints", "frames", "lower", "upper")}
    parents = np.append(where, -1)[data.parents[order]]
    names = [data.joint_names[j] for j in order]
    weights = sparse.csr_array(data.weights.toarray()[:, order])
    rig = build_rig(replace(data, joint_names=names, parents=parents, weights=weights, **rows))
    assert rig.root == 3
    monkeypatch.setattr(lbs, "load_rig", lambda name: rig)
    known = {}
    (local,) = (block for block in _blocks(ROOT / "docs" / "conventions.md", "python") if "world[j]" in block)
    exec(_blocks(ROOT / "docs" / "comparing.md", "python")[0], known)
    known["theta"] = np.zeros_like(rig.lower)
    exec(local, known)
    assert all(np.allclose(world.as_matrix(), frame) for world, frame in zip(known["world"], rig.frames, strict=True))


def test_cards_load(tmp_path):
    """The card in docs/rigs.md fits the bundled hand and does what its comments say."""
    (text,) = _blocks(ROOT / "docs" / "rigs.md", "toml")
    card = tmp_path / "example.card.toml"
    card.write_text(text, encoding="utf-8")
    rig = lbs.load_rig("hand", card=card)
    row = {name: j for j, name in enumerate(rig.joint_names)}
    assert rig.parts == ("palm", "thumb", "fingers")
    assert rig.merged[row["pinky3"]] and rig.locked[row["ring3"]]
    np.testing.assert_array_equal(rig.frames[row["thumb2"]], np.eye(3))
    np.testing.assert_allclose(np.degrees(rig.upper[row["index1"]]), [80, 20, 0])


def test_configurations_are_read(tmp_path):
    from lbsfit_np.cli.fit import OPTIONS
    from lbsfit_np.cli.parsing import settings

    (text,) = _blocks(ROOT / "docs" / "fitting.md", "toml")
    config = tmp_path / "fit.toml"
    config.write_text(text, encoding="utf-8")
    values = settings(Namespace(), OPTIONS, str(config))
    assert values["jobs"] == 4 and values["drop_invalid"] and values["orientation"] == "any"
    assert values["training"] == {"noise": 0.01, "scale": 0.2}


# ---- defaults and keys ----

TABLES = [
    pytest.param(path, name, id=f"{path.name}-{name.rpartition('.')[2]}")
    for path in DOCS
    for name in re.findall(r"<!-- defaults: (\S+) -->", path.read_text(encoding="utf-8"))
]


def _defaults(of):
    """Field or parameter → default."""
    if dataclasses.is_dataclass(of):
        return {f.name: getattr(of(), f.name) for f in dataclasses.fields(of)}
    found = inspect.signature(of).parameters.values()
    return {p.name: p.default for p in found if p.default is not inspect.Parameter.empty}


@pytest.mark.parametrize("path, name", TABLES)
def test_defaults_are_the_codes(path, name):
    module, _, attribute = name.rpartition(".")
    expected = {
        key: 'PRESETS["default"]' if value == lbs.losses.PRESETS["default"] else repr(value)
        for key, value in _defaults(getattr(importlib.import_module(module), attribute)).items()
    }
    rows = table_rows(path.read_text(encoding="utf-8"), f"defaults: {name}")
    assert {codes(row[0])[0]: codes(row[1])[0] for row in rows} == expected


def test_presets_are_the_codes():
    rows = table_rows(document("docs/losses.md"), "presets")
    for column, preset in ((2, "paper"), (3, "default")):
        listed = {codes(row[0])[0]: codes(row[column])[0] for row in rows}
        assert listed == {key: repr(value) for key, value in dataclasses.asdict(lbs.losses.PRESETS[preset]).items()}


def test_efforts_are_the_codes():
    from lbsfit_np.fitting.effort import EFFORTS

    text = document("docs/fitting.md")
    names = [codes(cell)[0].strip('"') for cell in text.split("<!-- efforts -->\n", 1)[1].splitlines()[0].split("|")[2:-2]]
    assert names == list(EFFORTS)
    rows = table_rows(text, "efforts")
    for column, effort in enumerate(EFFORTS.values(), start=1):
        listed = {codes(row[0])[0]: codes(row[column])[0] for row in rows}
        assert listed == {key: repr(value) for key, value in dataclasses.asdict(effort).items()}


def test_keys_of_rigs_are_the_files(demo):
    with np.load(demo / "demo" / "rig.npz", allow_pickle=False) as file:
        assert listed_keys("docs/rigs.md", "rig keys") == set(file.files)


def test_keys_of_results_are_the_files(demo):
    with np.load(demo / "demo" / "scan.fit.npz", allow_pickle=False) as file:
        assert listed_keys("docs/fitting.md", "result keys") == set(file.files)


def test_every_loss_is_described():
    text = document("docs/losses.md")
    for name in lbs.losses.__all__:
        assert name in text, name


def test_scan_formats_are_listed():
    from lbsfit_np.io.scans import SCAN_EXTENSIONS

    for ending in SCAN_EXTENSIONS:
        assert f"`{ending}`" in document("docs/scans.md"), ending


def test_public_names_are_listed():
    text = document("docs/api.md")
    rows = {codes(line)[0] for line in text.splitlines() if line.startswith("| `")}
    assert rows | {"__version__"} == set(lbs.__all__) and "`__version__`" in text


def test_every_room_is_described():
    text = document("docs/architecture.md")
    package = Path(lbs.__file__).parent
    for room in package.iterdir():
        if not room.name.startswith("__") and room.name != "rigs":
            assert f"`{room.name}{'/' if room.is_dir() else ''}`" in text, room.name


def test_every_extra_and_dependency_is_explained():
    text = document("docs/architecture.md")
    setup = document("setup.cfg")
    required = re.search(r"install_requires =\n((?:    .*\n)+)", setup)[1]
    for library in re.findall(r"    ([\w-]+)", required):
        assert f"| {library} |" in text, library
    extras = setup.split("[options.extras_require]\n")[1].split("\n[")[0]
    for extra in re.findall(r"^(\w+) =", extras, re.MULTILINE):
        assert f"| `{extra}` |" in text, extra


# ---- words and links ----


@pytest.mark.parametrize("command", COMMANDS)
def test_readme_has_the_two_commands(command):
    assert command in (line.strip() for line in document("README.md").splitlines())


def _anchors(text):
    """Anchors of the headings, as GitHub makes them, and those that are set by hand."""
    heads = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    made = {re.sub(r"[^\w\- ]", "", h.replace("`", "").lower()).replace(" ", "-") for h in heads}
    return made | set(re.findall(r'<a id="([^"]+)">', text))


@pytest.mark.parametrize("path", DOCS, ids=IDS)
def test_links_resolve(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        found = (path.parent / file).resolve() if file else path
        assert found.exists(), target
        if anchor:
            assert anchor in _anchors(found.read_text(encoding="utf-8")), target


@pytest.mark.parametrize("path", DOCS, ids=IDS)
def test_no_paths_of_one_machine(path):
    assert not re.search(r"(/home/|/tmp/|[A-Z]:\\)", path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("folder", ["study", "study/medium-hand", "study/medium-body"])
def test_the_studys_page_is_what_its_results_say(folder):
    """Nobody has changed the page by hand, or the command without it."""
    from lbsfit_np.bench.study.page import page

    report = json.loads((ROOT / "docs" / folder / "results.json").read_text(encoding="utf-8"))
    assert (ROOT / "docs" / folder / "README.md").read_text(encoding="utf-8") == page(report, report["captions"])
    assert all((ROOT / "docs" / folder / name).is_file() for name in report["captions"])
