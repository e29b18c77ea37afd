"""The house: imports go one way, heavy libraries stay outside the door, every room says what it is for."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import lbsfit_np

PACKAGE = Path(lbsfit_np.__file__).parent
# The scripts that built the bundled rigs travel with their data in the wheel; nothing in the package imports them.
MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p.relative_to(PACKAGE).parts[0] != "rigs")
NAMES = [str(p.relative_to(PACKAGE)) for p in MODULES]

# The rooms from left to right: each may import what stands to its left.
ROOMS = (
    "errors",
    "bundled",
    "seeds",
    "threads",
    "interrupts",
    "processes",
    "workers",
    "rotations",
    "medians",
    "triangles",
    "rig",
    "scan",
    "skinning",
    "neighbors",
    "losses",
    "raster",
    "sensor",
    "synthesis",
    "segmentation",
    "optimize",
    "starts",
    "fitting",
    "correspondence",
    "learning",
)
# The rooms at the edge, and what each may import besides itself.
EDGE = {
    "io": {"errors", "bundled", "seeds", "rotations", "medians", "triangles", "rig", "scan"},
    "report": {*ROOMS, "io"},
    "bench": {*ROOMS, "io", "report"},
    "cli": {*ROOMS, "io", "report", "bench"},
    "__main__": {"cli"},
    "__init__": set(),  # its names are loaded on first use, by text
}
# Imports against the direction, each within a function: file → rooms, and why.
EXEMPT = {
    "rig/rig.py": {"skinning", "io"},  # rig.pose and rig.save, the doors that people use
    "segmentation/segmenter.py": {"io"},  # save and load
    "starts/library.py": {"io"},  # save and load
    "fitting/result.py": {"io"},  # save and load
    "learning/archive.py": {"io"},  # save and load
    "learning/checkpoint.py": {"io"},  # steps that are kept
    "io/scans.py": {"synthesis"},  # points sampled from a mesh's surface
}
# Libraries that a module may import at its top; all others only within functions.
LIGHT = {"numpy", "scipy.sparse"}
HEAVY_AT_THE_TOP = {"learning/not_learned.py": {"sklearn.exceptions"}}  # a base class

_LONGEST = 450


def _tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def _room(parts):
    return parts[0].removesuffix(".py")


def _own_imports(path):
    """Pairs (room, whether within a function) of all imports of the package's own modules; public names are no room."""
    here = path.relative_to(PACKAGE).parts
    found = []

    def visit(node, inside):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ImportFrom) and child.level:
                base = list(here[: len(here) - child.level])
                targets = [child.module.split(".")] if child.module else [[a.name] for a in child.names]
                found.extend((_room([*base, *t]), inside) for t in targets if base or t[0] not in lbsfit_np.__all__)
            elif isinstance(child, ast.ImportFrom) and (child.module or "").split(".")[0] == "lbsfit_np":
                rest = child.module.split(".")[1:]
                found.extend((_room(rest or [a.name]), inside) for a in child.names)
            elif isinstance(child, ast.Import):
                found.extend((_room(a.name.split(".")[1:]), inside) for a in child.names if a.name.startswith("lbsfit_np."))
            visit(child, inside or isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)))

    visit(_tree(path), False)
    return found


def _allowed(room):
    if room in EDGE:
        return EDGE[room] | {room}
    return set(ROOMS[: ROOMS.index(room) + 1])


def test_every_room_has_its_place():
    rooms = {_room(p.relative_to(PACKAGE).parts) for p in MODULES}
    assert rooms <= {*ROOMS, *EDGE}, "a new room wants its place in ROOMS or EDGE"


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_imports_go_one_way(path):
    name = path.relative_to(PACKAGE).as_posix()
    exempt = EXEMPT.get(name, set())
    for room, inside in _own_imports(path):
        assert room in _allowed(_room(path.relative_to(PACKAGE).parts)) or (inside and room in exempt), f"{name} imports {room}"


@pytest.mark.parametrize("name", EXEMPT)
def test_exemptions_are_still_needed(name):
    used = {room for room, inside in _own_imports(PACKAGE / name) if inside}
    assert EXEMPT[name] <= used


def test_the_direction_test_sees_what_it_should(tmp_path):
    """The parser that the tests above rest on."""
    assert ("errors", False) in _own_imports(PACKAGE / "rig" / "rig.py")
    assert ("skinning", True) in _own_imports(PACKAGE / "rig" / "rig.py")
    assert ("neighbors", False) in _own_imports(PACKAGE / "losses" / "chamfer.py")
    assert ("losses", False) in _own_imports(PACKAGE / "losses" / "composite.py")


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_heavy_libraries_are_imported_where_they_are_used(path):
    name = path.relative_to(PACKAGE).as_posix()
    allowed = LIGHT | HEAVY_AT_THE_TOP.get(name, set())
    imported = set()
    for node in _tree(path).body:
        if isinstance(node, ast.Import):
            imported |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            imported |= {f"{node.module}.{a.name}" if node.module == "scipy" else node.module for a in node.names}
    heavy = {m for m in imported if m.split(".")[0] not in sys.stdlib_module_names | {"lbsfit_np"}}
    assert heavy <= allowed, f"{name} imports {heavy - allowed} at its top"


def _modules_after(code):
    script = f"import sys\n{code}\nprint('\\n'.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    return set(done.stdout.split())


def test_importing_the_package_loads_nothing_heavy():
    loaded = _modules_after("import lbsfit_np")
    assert "lbsfit_np" in loaded
    for library in ("scipy.optimize", "scipy.spatial", "scipy.ndimage", "sklearn", "trimesh", "tqdm", "matplotlib", "joblib"):
        assert library not in loaded


def test_losses_and_rigs_need_no_learning():
    loaded = _modules_after("import lbsfit_np as lbs; lbs.losses.chamfer; lbs.load_rig; lbs.load_scan; lbs.Rig; lbs.synthesize")
    for library in ("scipy.optimize", "sklearn", "trimesh", "tqdm", "matplotlib"):
        assert library not in loaded


# ---- names ----


def test_public_names_resolve():
    assert {"load_rig", "load_scan", "losses", "synthesize", "LBSFitter", "fit_scan"} <= set(lbsfit_np.__all__)
    for name in lbsfit_np.__all__:
        assert getattr(lbsfit_np, name) is not None
        assert name in dir(lbsfit_np)
    with pytest.raises(AttributeError, match="fit_scams"):
        getattr(lbsfit_np, "fit_scams")  # noqa: B009 (a plain attribute looks useless to the linter)


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_every_module_lists_what_it_offers(path):
    defined, offered = set(), None
    for node in _tree(path).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            defined.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            defined |= {t.id for t in targets if isinstance(t, ast.Name)}
            if any(isinstance(t, ast.Name) and t.id == "__all__" for t in targets) and isinstance(node.value, ast.List):
                offered = [e.value for e in node.value.elts if isinstance(e, ast.Constant)]
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            defined |= {(a.asname or a.name).split(".")[0] for a in node.names}
    if path.name in ("__init__.py", "__main__.py") and offered is None:
        return
    assert offered is not None, "no __all__"
    if path != PACKAGE / "__init__.py":
        assert set(offered) <= defined
    assert len(offered) == len(set(offered))


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_what_is_imported_is_offered(path):
    package, hidden = ["lbsfit_np", *path.relative_to(PACKAGE).parts[:-1]], []
    for node in ast.walk(_tree(path)):
        if not isinstance(node, ast.ImportFrom) or not node.level:
            continue
        home = import_module(".".join([*package[: len(package) - node.level + 1], *([node.module] if node.module else [])]))
        if not hasattr(home, "__path__"):  # of packages, modules are imported
            hidden += [f"{home.__name__}.{a.name}" for a in node.names if a.name not in home.__all__]
    assert not hidden, "what others use is named in __all__"


# ---- words ----


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_every_module_says_its_idea(path):
    text = ast.get_docstring(_tree(path)) or ""
    assert len(text) > 20, "a module wants a docstring that says its one idea"


def _public(tree):
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            yield node.name, node
            if isinstance(node, ast.ClassDef):
                for member in node.body:
                    if isinstance(member, ast.FunctionDef) and not member.name.startswith("_"):
                        yield f"{node.name}.{member.name}", member


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_everything_public_has_a_docstring(path):
    mute = [name for name, node in _public(_tree(path)) if not ast.get_docstring(node)]
    assert not mute


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_no_module_holds_two_ideas(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= _LONGEST


@pytest.mark.parametrize("path", MODULES, ids=NAMES)
def test_habits(path):
    """No assert as an input check, no print in library code, no pickled arrays, no paths of one machine."""
    text, tree = path.read_text(encoding="utf-8"), _tree(path)
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call)]
    assert not [n.lineno for n in ast.walk(tree) if isinstance(n, ast.Assert)]
    if _room(path.relative_to(PACKAGE).parts) not in ("cli", "bench", "__main__"):
        assert not [n.lineno for n in calls if isinstance(n.func, ast.Name) and n.func.id == "print"]
    for call in calls:
        for keyword in call.keywords:
            if keyword.arg == "allow_pickle":
                assert isinstance(keyword.value, ast.Constant) and keyword.value.value is False, call.lineno
    assert not re.search(r"(/home/|/tmp/|[A-Z]:\\\\)", text)
