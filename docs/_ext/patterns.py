"""Directives made from the table of patterns.

``pattern`` says cause and cure of one, ``pattern-table`` lists the rules of all.
"""

from __future__ import annotations

import re
import string
from typing import Any

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from chdstat.patterns import PATTERNS, Pattern, Thresholds

__all__ = ["PatternTable", "PatternText"]


class PatternTable(SphinxDirective):
    """List what sets each flag, with the default thresholds, and the sources below."""

    def run(self) -> list[nodes.Node]:
        rows = [("flag", "statistic", "set where", "defaults"), *map(_row, PATTERNS)]
        lines = [".. list-table::", "   :header-rows: 1", "   :widths: 18 26 34 22", ""]
        for row in rows:
            starts = ("   * - ", *["     - "] * (len(row) - 1))
            lines += [start + cell for start, cell in zip(starts, row, strict=True)]
        lines += ["", *(f"- ``{p.name}``: {_linked(p.source)}." for p in PATTERNS)]
        return self.parse_text_to_nodes("\n".join(lines))


class PatternText(SphinxDirective):
    """Say why pixels show a pattern, and what helps."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        (pattern,) = (p for p in PATTERNS if p.name == self.arguments[0])
        text = f"**Cause:** {pattern.meaning}.\n\n**What helps:** {pattern.cure}."
        return self.parse_text_to_nodes(text)


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
    app.add_directive("pattern", PatternText)
    app.add_directive("pattern-table", PatternTable)
    return {"parallel_read_safe": True}
