"""What holds for the package as a whole: its names, the direction of its imports, its size."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import sysconfig
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import grimp
import networkx as nx
import pytest

import chdstat as chd

ROOT = Path(chd.__file__).parent
API = Path(__file__).parent.parent / "docs/reference/index.rst"

PROJECT = tomllib.loads((ROOT.parent / "pyproject.toml").read_text("utf-8"))["tool"]
LAYERS = [*reversed(PROJECT["importlinter"]["contracts"][0]["layers"])]
"""Folders and modules of chdstat, each of which imports only from earlier ones."""

FOLDERS = sorted(m for m in chd.__all__ if m in LAYERS and m != "errors")
"""Folders that users see."""

SAME_MODULES = {"selection"}
"""Names that two modules still share. Take out what is renamed; add none."""

HEAVY = (
    "mitsuba",
    "drjit",
    "torch",
    "matplotlib",
    "xarray",
    "zarr",
    "dask",
    "sklearn",
    "scipy",
    "OpenEXR",
    "bokeh",
)


RENDERING = {"scenes", "rendering"}
"""What may import Mitsuba."""


@functools.cache
def modules() -> list[str]:
    """Return the dotted names of all modules, the package itself left out."""
    return [m.name for m in pkgutil.walk_packages([str(ROOT)], "chdstat.")]


@pytest.fixture(scope="module", autouse=True)
def forgotten() -> Iterator[None]:
    """Let no later garbage collection go through the syntax of all modules, a million objects."""
    yield
    syntax.cache_clear()


@functools.cache
def syntax(name: str) -> ast.Module:
    base = ROOT.joinpath(*name.split(".")[1:])
    path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8"))


def loaded_by(code: str) -> set[str]:
    """Return the modules that are loaded when a fresh process has run some code."""
    code = f"import sys\n{code}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def part(name: str) -> str:
    """Return the module or subpackage directly below chdstat that a dotted name lies in."""
    return name.split(".")[1] if "." in name else ""


def imported(tree: ast.Module, *, inside_functions: bool = True) -> Iterator[str]:
    """Yield the dotted names that a module imports."""
    for node in ast.walk(tree) if inside_functions else tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


# --- names --------------------------------------------------------------------------------------


def test_every_public_name_resolves():
    for name in chd.__all__:
        assert getattr(chd, name) is not None
    assert dir(chd) == sorted(chd.__all__)


def test_the_names_are_few_and_each_is_described():
    row = r"^   \* - (?::doc:)?`(\w+)(?: <.*>)?`\n     - [A-Z].*\.$"
    described = re.findall(row, API.read_text("utf-8"), re.MULTILINE)
    assert sorted(described) == sorted({*chd.__all__} - {"__version__"})
    assert len(dir(chd)) <= 33


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_shows_no_helper_modules(name):
    module = getattr(chd, name)
    below = {m.name for m in pkgutil.iter_modules(module.__path__)}
    assert dir(module) == sorted(module.__all__)
    assert not [n for n in dir(module) if n in below and inspect.ismodule(getattr(module, n))]


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="'chdstat' has no attribute 'renderer_of_dreams'"):
        _ = chd.renderer_of_dreams


@pytest.mark.parametrize("folder", ["chdstat", *(f"chdstat.{m}" for m in FOLDERS)])
def test_no_function_is_called_like_a_module(folder):
    package = importlib.import_module(folder)
    below = {m.name for m in pkgutil.iter_modules(package.__path__)}
    offered = {n for n in package.__all__ if not inspect.ismodule(getattr(package, n))}
    assert not below & offered


def test_public_names_stay_what_they_are():
    names = {name: getattr(chd, name) for name in chd.__all__}
    for module in modules():
        if not module.endswith("__main__"):
            importlib.import_module(module)
    assert {name: getattr(chd, name) for name in chd.__all__} == names


def test_every_module_says_what_it_offers():
    for name in modules():
        assert ast.get_docstring(syntax(name)), name


def defined(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a module itself defines; commands and claims are found by decorators."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if not any(isinstance(found, ast.Call) for found in node.decorator_list):
                yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name))


def test_only_faces_list_their_names():
    listing = [name for name in modules() if "__all__" in defined(syntax(name))]
    assert [n for n in listing if not hasattr(importlib.import_module(n), "__path__")] == []


def test_a_name_that_one_file_uses_has_an_underscore():
    """Formats and hooks of pytest are found by their names: `open_exr` and the like."""
    folders = (ROOT, *(ROOT.parent / name for name in ("tests", "benchmarks", "docs", "tools")))
    paths = [p for folder in folders for kind in ("py", "rst") for p in folder.rglob(f"*.{kind}")]
    texts = (p.read_text("utf-8") for p in paths)
    users = Counter(word for text in texts for word in set(re.findall(r"\w+", text)))
    names = [n for module in modules() for n in defined(syntax(module)) if not n.startswith("_")]
    assert [n for n in names if users[n] < 2 and not n.startswith(("open_", "pytest_"))] == []


def names_of_types(tree: ast.Module) -> Iterator[str]:
    """Yield the public classes and type aliases of a module; type variables are none."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            variable = re.match("TypeVar|ParamSpec", ast.unparse(node.value))
            if isinstance(target, ast.Name) and not target.id.isupper() and not variable:
                yield target.id


def twice(names: Iterable[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if count > 1}


def test_a_class_or_alias_has_a_name_of_its_own():
    found = [n for m in modules() for n in names_of_types(syntax(m)) if n[0].isupper()]
    assert len(found) > 100
    assert not twice(found)


def test_a_module_has_a_name_of_its_own():
    found = [p.stem.lstrip("_") for p in ROOT.rglob("*.py") if p.name != "__init__.py"]
    assert twice(found) <= SAME_MODULES


@pytest.mark.parametrize("ring", PROJECT["chdstat"]["rings"], ids=lambda ring: ring["name"])
def test_a_ring_does_not_grow(ring):
    """The number may fall. A commit that raises it says what users gain from it."""
    rings = PROJECT["chdstat"]["rings"]
    ends = [0, *(LAYERS.index(one["outermost"]) + 1 for one in rings)]
    assert ends[-1] == len(LAYERS)
    number = rings.index(ring)
    parts = LAYERS[ends[number] : ends[number + 1]]
    paths = [p for part in parts for p in (ROOT / f"{part}.py", *(ROOT / part).rglob("*.py"))]
    texts = (path.read_text(encoding="utf-8") for path in paths if path.exists())
    count = sum(isinstance(node, ast.stmt) for text in texts for node in ast.walk(ast.parse(text)))
    assert 0 < count <= ring["most_statements"]


# --- weight -------------------------------------------------------------------------------------


def test_importing_loads_nothing_heavy():
    loaded = loaded_by("import chdstat; dir(chdstat); chdstat.errors")
    assert "chdstat.errors" in loaded
    assert not set(HEAVY) & loaded


def test_the_plugin_of_pytest_loads_nothing_heavy():
    loaded = loaded_by("import chdstat.render_tests.plugin")
    assert not {*HEAVY, "numpy"} & loaded


def test_statistics_need_no_renderer():
    loaded = loaded_by(
        "import numpy as np, chdstat as chd\n"
        "chd.summarize(chd.Samples.from_array(np.ones((2, 2, 3, 64))))\n"
        "chd.histogram(np.ones(64)), chd.fit, chd.estimators.mean(np.ones(8))"
    )
    assert "chdstat.summary.statistics" in loaded
    assert not {"mitsuba", "drjit", "torch", "matplotlib", "zarr"} & loaded


def test_mitsuba_is_loaded_late():
    loaded = loaded_by(
        "import chdstat as chd; chd.patterns.Thresholds, chd.inference.gaussianity_of_means\n"
        "import chdstat.cli, chdstat.explorer, chdstat.rendering"
    )
    assert not {"mitsuba", "drjit", "torch"} & loaded


# --- imports ------------------------------------------------------------------------------------


def contracts(folder: Path) -> str:
    """Return what the contracts of `pyproject.toml` say of the package in a folder; "" if kept."""
    linter = Path(sysconfig.get_path("scripts"), "lint-imports")
    given = [linter, "--no-cache", "--config", ROOT.parent / "pyproject.toml"]
    done = subprocess.run(given, cwd=folder, capture_output=True, text=True, check=False)
    return " ".join(done.stdout.split()) if done.returncode else ""


def test_imports_go_inwards():
    assert contracts(ROOT.parent) == ""


@pytest.mark.parametrize(
    "code",
    [
        "def draw():\n    from chdstat import viz",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import chdstat.viz",
    ],
)
def test_an_import_outwards_is_refused_with_what_to_do(code, tmp_path):
    package = tmp_path / "chdstat"
    package.mkdir()
    for name in ("__init__", *LAYERS):
        (package / f"{name}.py").touch()
    (package / "viz.py").write_text("from chdstat.samples import x")
    assert contracts(tmp_path) == ""
    (package / "samples.py").write_text(code)
    found = contracts(tmp_path)
    assert "chdstat.samples -> chdstat.viz" in found
    assert "move what stands in the wrong room, pass it in, or ask through a door" in found


@functools.cache
def imports() -> nx.DiGraph:
    """Return which modules import which; those of type checkers and inside functions count."""
    graph = grimp.build_graph("chdstat", cache_dir=None)
    return nx.DiGraph({name: graph.find_modules_directly_imported_by(name) for name in modules()})


def test_modules_import_each_other_in_no_circle():
    """At the top of modules; a folder stands for what its modules offer to others."""
    known = {name for name in modules() if not hasattr(importlib.import_module(name), "__path__")}
    graph = {
        name: {
            module
            for found in imported(syntax(name), inside_functions=False)
            for module in (found, found.rpartition(".")[0])
            if module in known - {name}
        }
        for name in known
    }
    while free := {name for name, found in graph.items() if not found & set(graph)}:
        graph = {name: found for name, found in graph.items() if name not in free}
    assert graph == {}


def test_imports_inside_functions_make_small_circles():
    circles = nx.strongly_connected_components(imports())
    assert [sorted(found) for found in circles if len(found) > 5] == []


def test_only_scenes_and_rendering_import_mitsuba():
    for name in modules():
        roots = {i.split(".")[0] for i in imported(syntax(name))}
        assert not {"mitsuba", "drjit"} & roots or part(name) in RENDERING, name


def test_nothing_prints():
    for name in modules():
        calls = [n.func for n in ast.walk(syntax(name)) if isinstance(n, ast.Call)]
        assert not [f for f in calls if isinstance(f, ast.Name) and f.id == "print"], name
