"""Scenes of Mitsuba: tables of its plugins and of its own scenes, each compared or refused.

Run with ``pytest -n0 -s --benchmark-only tests/benchmarks/test_scenes.py``: plugins take three
minutes; the scenes need ``CHDSTAT_MITSUBA_DATA=FOLDER``, a checkout of Mitsuba's data repository,
and take ten. Each line gives the p-value of equal means in all pixels, or why a scene is refused.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import pytest

import chdstat as chd

_spec = importlib.util.spec_from_file_location(
    "scenes_of_mitsuba", Path(__file__).parents[1] / "rendering/test_scenes_of_mitsuba.py"
)
assert _spec is not None
assert _spec.loader is not None
plain = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(plain)

DATA = os.environ.get("CHDSTAT_MITSUBA_DATA", "")
SIZE = (12, 9)


def summed(found: dict[str, str]) -> None:
    """Print how many scenes are equal, and the smallest of as many p-values."""
    p = [float(f.removeprefix("p ")) for f in found.values() if f.startswith("p ")]
    refused = len(found) - len(p)
    print(f"\n{len(p)} scenes have Mitsuba's mean, least p {min(p):.2g}; {refused} are refused")
    assert min(p) > plain.LEVEL / len(p)


@pytest.mark.parametrize("backend", ["scalar", "llvm"])
def test_plugins(as_benchmark, backend, tmp_path, request):
    if backend == "llvm":
        request.getfixturevalue("llvm")
    names = plain.SCENES.keys() - ({"timed_sunsky"} if backend == "llvm" else set())
    found = {}
    for name in sorted(names):  # Dr.Jit does not recover from timed_sunsky, which it cannot record
        found[name] = plain.fate_of(name, tmp_path, backend)
        print(f"{name:22}{found[name][:150]}", flush=True)
    summed(found)


def small(mi: Any, path: Path) -> Any:
    """Return a scene as Mitsuba loads it, but for small films with box filters."""
    resolver = mi.FileResolver(mi.file_resolver())
    resolver.prepend(str(path.parent))
    previous = mi.file_resolver()
    mi.set_file_resolver(resolver)
    try:
        config = mi.parser.ParserConfig(mi.variant())
        state = mi.parser.parse_file(config, str(path), **PARAMETERS)
        for node in state.nodes:
            if node.type == mi.ObjectType.Film:
                one = node.props.get("width", 2) == 1
                node.props["width"], node.props["height"] = (1, 1) if one else SIZE
            if node.type == mi.ObjectType.ReconstructionFilter:
                for key in list(node.props.keys()):
                    del node.props[key]
                node.props.set_plugin_name("box")
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)
    finally:
        mi.set_file_resolver(previous)


PARAMETERS: dict[str, str] = {}


@pytest.mark.skipif(not Path(DATA).is_dir() or not DATA, reason="CHDSTAT_MITSUBA_DATA: no folder")
def test_scenes_of_mitsuba(as_benchmark, llvm):
    """All scenes that have a sensor, at 12 x 9 pixels; parts of scenes are left out."""
    found = {}
    for path in sorted(Path(DATA).rglob("*.xml")):
        text = path.read_text(encoding="utf-8")
        if not {"include", "fragments"}.isdisjoint(path.parts):  # parts of scenes
            continue
        PARAMETERS.clear()
        PARAMETERS.update({"spp": "16"} if "$spp" in text else {})
        scene = chd.load_scene(path, **PARAMETERS)
        name = str(path.relative_to(DATA).with_suffix(""))
        options = {} if "distant" in text else {"size": SIZE}
        # Mitsuba itself ends the process where its aov integrator renders one of them with llvm.
        backend = "scalar" if '"aov"' in text else llvm
        try:
            found[name] = plain.fate(scene, lambda mi, p=path: small(mi, p), backend, **options)
        except Exception as error:  # noqa: BLE001 - a line of the table, too
            found[name] = f"FAILED: {type(error).__name__}: {error}"
        print(f"{name:70}{' '.join(found[name].split())[:200]}", flush=True)
    summed(found)
    assert not [name for name, fate in found.items() if fate.startswith("FAILED")]
