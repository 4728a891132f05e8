"""Scenes of Mitsuba: tables of its plugins and of its own scenes, each compared or refused.

Run with ``pytest -n0 -s --benchmark-only tests/benchmarks/test_scenes.py``: plugins take three
minutes; the scenes need ``CHDSTAT_MITSUBA_DATA=FOLDER``, a checkout of Mitsuba's data repository,
and take ten. Each line gives the p-value of equal means in all pixels, or why a scene is refused.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
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


def test_plugins(as_benchmark, backend, tmp_path):
    names = plain.SCENES.keys() - ({"timed_sunsky"} if backend != "scalar" else set())
    found = {}
    for name in sorted(names):  # Dr.Jit does not recover from timed_sunsky, which it cannot record
        found[name] = plain.fate_of(name, tmp_path, backend)
        print(f"{name:22}{found[name][:150]}", flush=True)
    summed(found)


def small(mi: Any, path: Path, parameters: dict[str, str]) -> Any:
    """Return a scene as Mitsuba loads it, but for small films with box filters."""
    resolver = mi.FileResolver(mi.file_resolver())
    resolver.prepend(str(path.parent))
    previous = mi.file_resolver()
    mi.set_file_resolver(resolver)
    try:
        config = mi.parser.ParserConfig(mi.variant())
        state = mi.parser.parse_file(config, str(path), **parameters)
        box = mi.parser.parse_dict(config, {"type": "box"}).nodes[0]
        for node in [n for n in state.nodes if n.type == mi.ObjectType.Film]:
            one = node.props.get("width", 2) == 1
            node.props["width"], node.props["height"] = (1, 1) if one else SIZE
            held = mi.Properties.Type.ResolvedReference
            for key in [k for k in node.props.keys() if node.props.type(k) == held]:  # noqa: SIM118
                del node.props[key]  # its filter
            node.props["rfilter"] = mi.Properties.ResolvedReference(len(state.nodes))
            state.nodes.append(box)
        mi.parser.transform_all(config, state)
        return mi.parser.instantiate(config, state)
    finally:
        mi.set_file_resolver(previous)


def fate_of_file(path: Path, backend: str) -> str:
    """Return what becomes of a scene of Mitsuba's."""
    text = path.read_text(encoding="utf-8")
    parameters = {"spp": "16"} if "$spp" in text else {}
    options = {} if "distant" in text else {"size": SIZE}
    scene = chd.load_scene(path, **parameters)
    return plain.fate(scene, lambda mi: small(mi, path, parameters), backend, **options)


def alone(path: Path, backend: str) -> str:
    """Return the same from a process of its own, as Mitsuba itself ends that with some scenes."""
    code = f"import test_scenes as t, pathlib; print(t.fate_of_file(pathlib.Path({str(path)!r}), "
    done = subprocess.run(
        [sys.executable, "-c", f"{code}{backend!r}))"],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parent,
    )
    if done.returncode < 0:
        return "ended"
    return done.stdout.strip().splitlines()[-1] if done.stdout else f"FAILED: {done.stderr[-300:]}"


@pytest.mark.skipif(not Path(DATA).is_dir() or not DATA, reason="CHDSTAT_MITSUBA_DATA: no folder")
def test_scenes_of_mitsuba(as_benchmark, llvm):
    """All scenes at 12 x 9 pixels, with llvm, and where that ends the process, with scalar."""
    found = {}
    for path in sorted(Path(DATA).absolute().rglob("*.xml")):
        if not {"include", "fragments"}.isdisjoint(path.parts):  # parts of scenes
            continue
        name = str(path.relative_to(Path(DATA).absolute()).with_suffix(""))
        found[name] = alone(path, llvm)
        if found[name] == "ended":
            found[name] = alone(path, "scalar")
            name += " (scalar)"
        told = found[name.removesuffix(" (scalar)")]
        print(f"{name:70}{told[:200]}", flush=True)
    summed(found)
    assert not [name for name, fate in found.items() if fate.startswith(("FAILED", "ended"))]
