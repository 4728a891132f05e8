"""Directives made from the table of patterns.

``pattern`` says cause and cure of one, ``pattern-table`` lists the rules of all. ``cures`` lists
what helps in the words of a renderer, ``renderer-settings`` what its settings do and cost.
"""

from __future__ import annotations

import re
import string
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from chdstat.patterns import PATTERNS, Label, Pattern, Thresholds
from chdstat.patterns.cures import CURES, SETTINGS, cure_in

__all__ = ["Cures", "PatternTable", "PatternText", "RendererSettings"]


class PatternTable(SphinxDirective):
    """List what sets each flag, with the default thresholds, and the sources below."""

    def run(self) -> list[nodes.Node]:
        rows = [("flag", "statistic", "set where", "defaults"), *map(_row, PATTERNS)]
        lines = _table("18 26 34 22", rows)
        lines += ["", *(f"- ``{p.name}``: {_linked(p.source)}." for p in PATTERNS)]
        return self.parse_text_to_nodes("\n".join(lines))


class PatternText(SphinxDirective):
    """Say why pixels show a pattern, and what helps."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        (pattern,) = (p for p in PATTERNS if p.name == self.arguments[0])
        text = f"**Cause:** {pattern.meaning}.\n\n**What helps:** {pattern.cure}."
        return self.parse_text_to_nodes(text)


class Cures(SphinxDirective):
    """List cause and cure of every pattern, in the words of a renderer."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        (renderer,) = self.arguments
        rows = [("your pixels are", "why", f"what helps in {renderer}")]
        for name in CURES[renderer]:
            label = Label[name.upper()]
            cells = label.meaning, cure_in(renderer, name)
            link = f":ref:`{label.words} <{label.words}>`"
            rows.append((link, *(f"{text[0].upper()}{text[1:]}." for text in cells)))
        return self.parse_text_to_nodes("\n".join(_table("18 30 52", rows)))


class RendererSettings(SphinxDirective):
    """List what the settings of a renderer do against noise, and what they cost."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        rows = [("setting", "what it does", "what it costs")]
        for setting in SETTINGS[self.arguments[0]].values():
            where = f" *{setting.where}*" if setting.where else ""
            cells = setting.does, setting.cost
            sentences = (f"{text[0].upper()}{text[1:]}." for text in cells)
            rows.append((f"**{setting.name}**{where}", *sentences))
        return self.parse_text_to_nodes("\n".join(_table("34 32 34", rows)))


def _table(widths: str, rows: list[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table whose first row is its head."""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", ""]
    for row in rows:
        starts = ("   * - ", *["     - "] * (len(row) - 1))
        lines += [start + cell for start, cell in zip(starts, row, strict=True)]
    return lines


def _row(pattern: Pattern) -> tuple[str, str, str, str]:
    defaults = Thresholds()
    names = [name for _, name, _, _ in string.Formatter().parse(pattern.limit) if name]
    names += ["alpha"] * pattern.decisive
    values = ", ".join(f"``{name}`` {getattr(defaults, name):g}" for name in names)
    return f"``{pattern.name}``", pattern.statistic, pattern.rule, values


def _linked(source: str) -> str:
    return re.sub(r"doi:(10\.[^\s;,]+)", r":doi:`\1`", source)


def setup(app: Any) -> dict[str, bool]:
    """Let Sphinx load this module as an extension."""
    app.add_directive("cures", Cures)
    app.add_directive("pattern", PatternText)
    app.add_directive("pattern-table", PatternTable)
    app.add_directive("renderer-settings", RendererSettings)
    return {"parallel_read_safe": True}
