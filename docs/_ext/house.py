"""The package as its code shows it: its folders, their imports, the way of a call through them."""

from __future__ import annotations

import ast
import functools
import itertools
import sys
import threading
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import grimp
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import chdstat

__all__ = ["draw", "draw_imports", "life", "rings"]

ROOT = Path(chdstat.__file__).parent
COLOURS = ("#0072B2", "#009E73", "#E69F00", "#CC79A7")
"""Of the rings, from the inside out."""
_SHOWN = 3
"""Functions of a visit that are named."""


@functools.cache
def rings() -> dict[str, list[str]]:
    """Return the folders of each ring, from the inside out and in the order of the flow."""
    tools = tomllib.loads((ROOT.parent / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    inwards = tools["importlinter"]["contracts"][0]["layers"]
    outwards = iter([*reversed(inwards)])
    return {ring["name"]: _up_to(outwards, ring["outermost"]) for ring in tools["chdstat"]["rings"]}


def _up_to(folders: Iterator[str], last: str) -> list[str]:
    return [*itertools.takewhile(lambda folder: folder != last, folders), last]


def folders() -> list[str]:
    """Return all folders in the order of the flow."""
    return [folder for ring in rings().values() for folder in ring if folder != "__main__"]


def colours() -> dict[str, str]:
    """Return the colour of each folder, which is that of its ring."""
    pairs = zip(rings().values(), COLOURS, strict=True)
    return {folder: colour for ring, colour in pairs for folder in ring}


def statements() -> Counter[str]:
    """Return the statements of each folder."""
    found: Counter[str] = Counter()
    for path in ROOT.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found[_folder(path)] += sum(isinstance(node, ast.stmt) for node in ast.walk(tree))
    return found


def imports() -> Counter[tuple[str, str]]:
    """Return how many imports go from one folder to another."""
    graph = grimp.build_graph("chdstat", cache_dir=None)
    found: Counter[tuple[str, str]] = Counter()
    for module in graph.modules:
        for other in graph.find_modules_directly_imported_by(module):
            parts = [name.split(".")[1] for name in (module, other) if "." in name]
            if len(parts) == 2 and parts[0] != parts[1]:
                found[parts[0], parts[1]] += 1
    return found


@dataclass(frozen=True)
class Visit:
    """Functions of a folder that a call enters one after the other, coming from other folders."""

    folder: str
    functions: tuple[str, ...]

    def __str__(self) -> str:
        more = [f"and {len(self.functions) - _SHOWN} more"] if len(self.functions) > _SHOWN else []
        return ", ".join([*self.functions[:_SHOWN], *more])


def life(call: Callable[[], Any], *, passed_over: tuple[str, ...] = ()) -> list[Visit]:
    """Return what a call visits on its way through the folders, in order and each function once."""
    found: dict[tuple[str, str], None] = {}

    def entered(frame: FrameType, event: str, _argument: object) -> None:
        path, function = Path(frame.f_code.co_filename), frame.f_code.co_qualname
        if event != "call" or not path.is_relative_to(ROOT) or path.stem.startswith("__"):
            return
        callers = (Path(f.f_code.co_filename) for f in _callers(frame))
        caller = next((p for p in callers if p.is_relative_to(ROOT)), None)
        private = any(part[0] in "_<" for part in function.split("."))
        outside = caller is None or _folder(caller) != _folder(path)
        if outside and not private and _folder(path) not in passed_over:
            found.setdefault((_folder(path), f"{path.stem}.{function}"))

    sys.setprofile(entered)
    threading.setprofile(entered)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    runs = itertools.groupby(found, key=lambda visit: visit[0])
    return [Visit(folder, tuple(name for _, name in run)) for folder, run in runs]


def draw(visits: list[Visit]) -> Figure:
    """Draw visits from top to bottom, with the folders side by side."""
    shown = [folder for folder in folders() if any(visit.folder == folder for visit in visits)]
    figure = Figure(figsize=(6.7, 0.2 * len(visits) + 0.5), layout="constrained")
    ax = figure.subplots()
    places = [shown.index(visit.folder) for visit in visits]
    ax.plot(places, range(len(visits)), color="#bbbbbb", linewidth=0.8)
    for row, (visit, place) in enumerate(zip(visits, places, strict=True)):
        ax.plot(place, row, "o", color=colours()[visit.folder], markersize=4)
        right = place < len(shown) / 2
        ax.annotate(
            str(visit),
            (place, row),
            (6 if right else -6, 0),
            textcoords="offset points",
            ha="left" if right else "right",
            va="center",
            fontsize=7,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.9},
        )
    _label(ax, shown)
    ax.set(ylim=(len(visits) - 0.5, -0.5), xlim=(-0.5, len(shown) - 0.5), yticks=[])
    ax.spines[["left", "right", "bottom", "top"]].set_visible(False)
    return figure


def draw_imports() -> Figure:
    """Draw how many imports go from each folder to each other, with a frame around each ring."""
    names, found, sizes = folders(), imports(), statements()
    figure = Figure(figsize=(6.7, 4.6), layout="constrained")
    ax, bars = figure.subplots(1, 2, width_ratios=[3, 1], sharey=True)
    for (importer, imported), count in found.items():
        if importer in names and imported in names:
            ax.text(
                names.index(imported),
                names.index(importer),
                count,
                ha="center",
                va="center",
                fontsize=6.5,
                color=colours()[imported],
            )
    start = 0
    for ring in rings().values():
        stop = start + len(ring)
        frame = {"facecolor": colours()[ring[0]], "alpha": 0.12, "edgecolor": "none"}
        ax.axhspan(start - 0.5, stop - 0.5, xmax=stop / len(names), **frame)
        start = stop
    _label(ax, names, rotation=90)
    ax.set(ylim=(len(names) - 0.5, -0.5), xlim=(-0.5, len(names) - 0.5), yticks=range(len(names)))
    ax.set_yticklabels(names)
    for label, name in zip(ax.get_yticklabels(), names, strict=True):
        label.set_color(colours()[name])
    ax.set(xlabel="is imported by the folder at the left, so many times")
    bars.barh(range(len(names)), [sizes[n] for n in names], color=[colours()[n] for n in names])
    bars.tick_params(axis="y", length=0)
    bars.set(xlabel="statements")
    return figure


def _label(ax: Axes, names: list[str], **options: Any) -> None:
    ax.xaxis.tick_top()
    ax.set_xticks(range(len(names)), names, **options)
    ax.tick_params(length=0)
    for label, name in zip(ax.get_xticklabels(), names, strict=True):
        label.set(color=colours()[name], fontweight="bold")


def _folder(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def _callers(frame: FrameType) -> Iterator[FrameType]:
    back = frame.f_back
    while back is not None:
        yield back
        back = back.f_back
