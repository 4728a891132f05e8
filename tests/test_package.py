"""What holds for the package as a whole: its names, the direction of its imports, its weight."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import chdstat as chd

ROOT = Path(chd.__file__).parent

ORDER = (
    "errors",
    "_core",
    "_arrays _code _image_scales _interrupts _reasons _workers progress",
    "scenes",
    "_store _streams",
    "backend",
    "samples _asked",
    "_renderer",
    "_sinks",
    "_crew",
    "renderings",
    "capture",
    "_batches _moments _multiplicity _null_quantiles _positive _rows _streaming",
    "_binning",
    "histograms",
    "summary _binned",
    "_routes",
    "fit",
    "normality",
    "modes",
    "patterns",
    "_fitted",
    "differences",
    "simulation atlases",
    "metrics",
    "estimators",
    "io",
    "comparison",
    "models",
    "estimates",
    "analysis",
    "overviews",
    "recipes",
    "findings",
    "viz",
    "reporting",
    "studies",
    "explorer",
    "doctor",
    "cli",
    "__main__",
)
"""Modules and packages of chdstat, upstream first: each imports only from earlier lines.

Those on one line are helpers that may import each other, as long as no cycle arises.
"""

RANK = {name: rank for rank, line in enumerate(ORDER) for name in line.split()}

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

RENDERING = {"_asked", "_crew", "_renderer", "backend", "capture", "renderings", "scenes"}
"""What may import Mitsuba."""


def modules() -> list[str]:
    """Return the dotted names of all modules, the package itself left out."""
    return [m.name for m in pkgutil.walk_packages([str(ROOT)], "chdstat.")]


def syntax(name: str) -> ast.Module:
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    return ast.parse(Path(spec.origin).read_text(encoding="utf-8"))


def part(name: str) -> str:
    """Return the module or subpackage directly below chdstat that a dotted name lies in."""
    return name.split(".")[1] if "." in name else ""


def imported(tree: ast.Module) -> Iterator[str]:
    """Yield the dotted names that a module imports, inside functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def upstream_only(rank: dict[str, int], importer: str, names: Iterator[str]) -> list[str]:
    """Return the imports of a part that do not come from an earlier line, or its own."""
    own = [name for name in names if name.split(".")[0] == "chdstat" and part(name) != ""]
    return [name for name in own if rank.get(part(name), -1) > rank[importer]]


# --- names --------------------------------------------------------------------------------------


def test_every_public_name_resolves():
    for name in chd.__all__:
        assert getattr(chd, name) is not None
    assert dir(chd) == sorted(chd.__all__)


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="'chdstat' has no attribute 'renderer_of_dreams'"):
        _ = chd.renderer_of_dreams


def test_no_public_function_shares_its_name_with_a_submodule():
    below = {m.name for m in pkgutil.iter_modules([str(ROOT)])}
    assert not below & {name for name in chd.__all__ if not inspect.ismodule(getattr(chd, name))}


def test_public_names_stay_what_they_are_whatever_is_imported():
    names = {name: getattr(chd, name) for name in chd.__all__}
    for module in modules():
        if not module.endswith("__main__"):
            importlib.import_module(module)
    assert {name: getattr(chd, name) for name in chd.__all__} == names


@pytest.mark.parametrize("name", modules())
def test_every_module_says_what_it_offers(name):
    tree = syntax(name)
    assert ast.get_docstring(tree)
    if name.endswith("__main__"):
        return
    module = importlib.import_module(name)
    assert all(hasattr(module, public) for public in module.__all__)


# --- weight -------------------------------------------------------------------------------------


def test_importing_loads_nothing_heavy():
    code = "import sys, chdstat; dir(chdstat); chdstat.errors; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "chdstat.errors" in loaded
    assert not set(HEAVY) & set(loaded)


def test_statistics_need_no_renderer():
    code = (
        "import sys, numpy as np, chdstat as chd\n"
        "chd.summarize(chd.Samples.from_array(np.ones((2, 2, 3, 64))))\n"
        "chd.histogram(np.ones(64)), chd.fit\n"
        "print(*sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "chdstat.summary" in loaded
    assert not {"mitsuba", "drjit", "torch", "matplotlib", "zarr"} & set(loaded)


# --- imports ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", modules())
def test_imports_only_go_upstream(name):
    assert part(name) in RANK, f"give {name} its place in ORDER"
    assert upstream_only(RANK, part(name), imported(syntax(name))) == []


def test_an_import_downstream_would_be_found():
    tree = ast.parse("def f():\n    from chdstat import capture\n    from chdstat.errors import X")
    assert upstream_only(RANK, "samples", imported(tree)) == ["chdstat.capture"]


def test_helpers_on_one_line_import_each_other_in_no_circle():
    for line in ORDER:
        below = {name: set() for name in line.split() if f"chdstat.{name}" in modules()}
        for name, found in below.items():
            found |= {part(i) for i in imported(syntax(f"chdstat.{name}"))} & (set(below) - {name})
        while free := {name for name, found in below.items() if not found & set(below)}:
            below = {name: found for name, found in below.items() if name not in free}
        assert not below, f"{' and '.join(below)} import each other"


@pytest.mark.parametrize("name", modules())
def test_only_the_capture_side_imports_mitsuba(name):
    roots = {i.split(".")[0] for i in imported(syntax(name))}
    assert not {"mitsuba", "drjit"} & roots or part(name) in RENDERING


@pytest.mark.parametrize("name", modules())
def test_nothing_prints(name):
    calls = [n.func for n in ast.walk(syntax(name)) if isinstance(n, ast.Call)]
    printing = [f for f in calls if isinstance(f, ast.Name) and f.id == "print"]
    assert printing == []
