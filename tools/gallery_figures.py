"""Save every figure of the gallery as PDF and PNG, and print its size and kinds of fonts.

Usage: ``python tools/gallery_figures.py FOLDER [NAME ...]``, with names such as ``plot_2_look``.
It ends with 1 if a figure holds a Type 3 font, which publishers refuse, or more than 500 KB.
"""

from __future__ import annotations

import ast
import re
import sys
import time
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
LARGEST = 500_000
FONTS = {b"/FontFile2": "TrueType", b"/FontFile3": "OpenType", b"/Type3": "Type 3"}
"""Kinds of embedded fonts by what a PDF writes of them."""


def figures_of(script: Path) -> list[Figure]:
    """Run an example cell by cell, and return the figures that are values of its cells."""
    variables: dict[str, Any] = {"__name__": "__main__"}
    found: list[Figure] = []
    for cell in re.split(r"^# %%.*$", script.read_text("utf-8"), flags=re.MULTILINE):
        tree = ast.parse(cell)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, script.name, "exec"), variables)  # noqa: S102 - our own examples
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "", "eval"), variables)  # noqa: S307
            value = value.figure if isinstance(value, Axes) else value
            if isinstance(value, Figure) and value not in found:
                found.append(value)
    return found


def main() -> int:
    """Print a line for each figure; return how many are not fit for a paper."""
    folder, names = Path(sys.argv[1]), sys.argv[2:]
    folder.mkdir(parents=True, exist_ok=True)
    refused = 0
    for script in sorted(EXAMPLES.rglob("plot_*.py")):
        if names and script.stem not in names:
            continue
        begin = time.monotonic()
        for number, figure in enumerate(figures_of(script), 1):
            file = folder / f"{script.stem}-{number}.pdf"
            figure.savefig(file)
            figure.savefig(file.with_suffix(".png"), dpi=130)
            held = file.read_bytes()
            kinds = [kind for mark, kind in FONTS.items() if mark in held]
            refused += "Type 3" in kinds or len(held) > LARGEST
            size = f"{len(held) / 1000:.0f} KB"
            sys.stdout.write(f"{file.name:32} {size:>8}  {', '.join(kinds) or 'no fonts'}\n")
        sys.stdout.write(f"{script.stem:32} {time.monotonic() - begin:6.0f} s\n")
        sys.stdout.flush()
    return refused


if __name__ == "__main__":
    sys.exit(bool(main()))
